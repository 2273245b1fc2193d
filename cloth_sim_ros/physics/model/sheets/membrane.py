# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Membrane of a sheet from the moduli of a fabric and the direction of its threads.

A strip cut along the warp has Young's modulus E1 and narrows by ν times its strain. One along the weft has E2. The law
of plane stress is symmetric, E1 ν21 = E2 ν12 with ν = ν12.

    C11 = E1 / (1 - ν² E2/E1),   C22 = E2 / (1 - ν² E2/E1),   C12 = ν C22.

It is positive definite if ν² < E1/E2.

A modulus may grow to R times its value at the strain s of a pull. Its growth there is (r - 1) E, with

    r = (R - 2 e/3) / (1 + 7 e/3),   e = s + s²/2.

For the force over the width at rest is P = λ S(e) with the stretch λ. At that strain S = E e (1 + (r - 1)/3), hence
dP/dλ = S + λ² r E = R E. For shear e is γ and r is R.

Damping with the dimensionless k_d0 is that of springs of the same sheet. A thread of modulus C on cells of size l has
the viscosity k_d0 l sqrt(ρ C), ρ the mass per area. The coupling has the geometric mean, so that D = S C S with a
diagonal S is as definite as C.
"""

from __future__ import annotations

import math

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.membrane_triangles import MembraneTriangles

#: Sine of the angle between a triangle's normal and the warp, below which the triangle shows no direction of the warp.
MIN_SINE = 0.01
#: Smallest strain at which a modulus stops growing: the square of a much smaller one underflows.
MIN_STIFFENING_STRAIN = 1e-12
#: Largest product of the two Poisson's ratios. The stiffness of plane stress is then at most a million times a modulus;
#: at a product of 1 it is infinite.
_MAX_POISSON_PRODUCT = 1.0 - 1e-6


@attrs.frozen(kw_only=True)
class FabricModuli:
    """Moduli of a fabric in its plane, and their growth with strain.

    Raises:
        ValueError: if strain energy would be negative for some strain.
    """

    #: Young's moduli along warp and weft, and shear modulus [N/m].
    warp: float
    weft: float
    shear: float
    #: Contraction along the weft over strain, in a pull along the warp.
    poisson_ratio: float = 0.0
    #: Strain at which a modulus stops growing, and its factor there. Strain is elongation over length at rest, or in
    #: shear the cosine of the threads' angle. A factor of 1 is a constant modulus.
    warp_stiffening: tuple[float, float] = (0.0, 1.0)
    weft_stiffening: tuple[float, float] = (0.0, 1.0)
    shear_stiffening: tuple[float, float] = (0.0, 1.0)

    def __attrs_post_init__(self) -> None:
        for name in ("warp_stiffening", "weft_stiffening", "shear_stiffening"):
            strain, factor = getattr(self, name)
            least = 1.0 if name == "shear_stiffening" else 1.0 + 3.0 * _green_strain(strain)
            if not strain >= 0.0 or (factor != 1.0 and not (strain >= MIN_STIFFENING_STRAIN and factor >= least)):
                raise ValueError(
                    f"{name} is {[strain, factor]}; the strain must be at least {MIN_STIFFENING_STRAIN:g} and the "
                    f"factor at least {least:.4g}, which the geometry alone gives at that strain; [0.0, 1.0] is a "
                    "constant modulus"
                )
        if not self.poisson_product <= _MAX_POISSON_PRODUCT:
            limit = math.sqrt(_MAX_POISSON_PRODUCT * (self.warp / self.weft))
            raise ValueError(
                f"poisson_ratio is {self.poisson_ratio}; it must be between {-limit:.8g} and {limit:.8g}, just below "
                "the root of the modulus along the warp over that along the weft, where the stiffness would be infinite"
            )

    @property
    def poisson_product(self) -> float:
        """Product ν12 ν21 of Poisson's ratios along warp and weft; more than 1 - 1e-6 is refused."""
        return self.poisson_ratio * self.poisson_ratio * (self.weft / self.warp)

    def stiffness(self) -> tuple[float, float, float, float]:
        """Return the stiffness of plane stress at small strain: C11, C12, C22 and G [N/m]."""
        weft = self.weft / (1.0 - self.poisson_product)
        return self.warp / (1.0 - self.poisson_product), self.poisson_ratio * weft, weft, self.shear

    def growth(self) -> Array | None:
        """Return Green's strains at which C11, C22 and G stop growing, and their increase [N/m], (3, 2), or None.

        None if they are constant.
        """
        threads = (self.warp, self.warp_stiffening), (self.weft, self.weft_stiffening)
        if all(factor == 1.0 for _, factor in (self.warp_stiffening, self.weft_stiffening, self.shear_stiffening)):
            return None
        rows = []
        for modulus, (strain, factor) in threads:
            limit = _green_strain(strain)
            ratio = 1.0 if factor == 1.0 else (factor - 2.0 * limit / 3.0) / (1.0 + 7.0 * limit / 3.0)
            rows.append((limit, (ratio - 1.0) * modulus))
        rows.append((self.shear_stiffening[0], (self.shear_stiffening[1] - 1.0) * self.shear))
        return np.array(rows)


def _green_strain(strain: float) -> float:
    """Return Green's strain of a thread from its elongation over its length at rest."""
    return strain + 0.5 * strain * strain


def thread_coordinates(positions: ArrayLike, triangles: NDArray[np.int64], warp: ArrayLike) -> Array:
    """Return coordinates along warp and weft of triangles' corners, relative to the first corner [m], shape (m, 3, 2).

    The warp of a triangle is the projection of `warp` onto its plane, see `along_plane`.

    Args:
        positions: rest positions [m], shape (n, 3).
        triangles: particles of each triangle, shape (m, 3).
        warp: direction of the warp, shape (3,).

    Raises:
        ValueError: if every triangle is perpendicular to the warp, or one has no area.
    """
    x = np.asarray(positions, dtype=np.float64)
    first, second = x[triangles[:, 1]] - x[triangles[:, 0]], x[triangles[:, 2]] - x[triangles[:, 0]]
    along, normal = along_plane(cross_rows(first, second), warp)
    across = cross_rows(normal, along)
    corners = np.zeros((len(triangles), 3, 2))
    for corner, edge in ((1, first), (2, second)):
        corners[:, corner, 0], corners[:, corner, 1] = dot_rows(edge, along), dot_rows(edge, across)
    return corners


def along_plane(normals: Array, warp: ArrayLike) -> tuple[Array, Array]:
    """Project the warp onto planes; return its direction in each, and the planes' normals, as unit vectors (m, 3).

    A plane may be perpendicular to the warp, such as at a pole of a closed surface. It takes the projection of another
    direction, with the components of the warp moved by one.

    Args:
        normals: normals of the planes, of any length, shape (m, 3).
        warp: direction of the warp, shape (3,).

    Raises:
        ValueError: if every plane is perpendicular to the warp, or a normal is zero.
    """
    length = np.sqrt(dot_rows(normals, normals))
    flat = np.flatnonzero(~(length > 0.0))
    if flat.size:
        raise ValueError(f"triangle {flat[0]} has no area")
    unit = normals / length[:, None]
    direction = np.asarray(warp, dtype=np.float64)
    along, is_perpendicular = _projection(direction, unit)
    if is_perpendicular.all() and len(is_perpendicular):
        raise ValueError(
            f"the sheet is perpendicular to material.warp_direction {direction.tolist()}; choose a direction in its "
            "plane"
        )
    if is_perpendicular.any():
        along[is_perpendicular] = _projection(np.roll(direction, 1), unit[is_perpendicular])[0]
    return along, unit


def _projection(direction: Array, normals: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Project a direction onto planes; return unit vectors, (m, 3), and a mask of planes perpendicular to it, (m,)."""
    rows = np.broadcast_to(direction, normals.shape)
    along = rows - dot_rows(rows, normals)[:, None] * normals
    length, full_length = np.sqrt(dot_rows(along, along)), np.sqrt(dot_rows(rows, rows))
    is_perpendicular = ~(length > MIN_SINE * full_length)
    return along / np.where(is_perpendicular, 1.0, length)[:, None], is_perpendicular


def membrane(
    positions: ArrayLike,
    triangles: NDArray[np.int64],
    moduli: FabricModuli,
    *,
    warp: ArrayLike,
    k_d0: float,
    density: float,
    viscosity: float = 0.0,
    subtracted: tuple[float, float] = (0.0, 0.0),
    share: float = 1.0,
    grid: tuple[int, int] | None = None,
) -> MembraneTriangles:
    """Return the membrane (in-plane) force of a sheet from the moduli of its fabric and its damping.

    Args:
        positions: rest positions [m], shape (n, 3).
        triangles: particles of each triangle, shape (m, 3).
        moduli: moduli of the fabric.
        warp: direction of the warp, shape (3,).
        k_d0: dimensionless damping.
        density: mass per area [kg/m^2].
        viscosity: viscosity along the warp [N s/m], all others in proportion to the stiffness; 0 uses k_d0.
        share: fraction of its area that a triangle stands for.
        grid: rows and columns of a grid; None for a mesh.
        subtracted: stiffness along warp and weft that other springs of the sheet add [N/m].

    Raises:
        ValueError: as `thread_coordinates`, or if no stiffness is left.
    """
    warp_stiffness, coupling, weft_stiffness, shear = moduli.stiffness()
    warp_stiffness, weft_stiffness = warp_stiffness - subtracted[0], weft_stiffness - subtracted[1]
    if not min(warp_stiffness, weft_stiffness) > 0.0 or not coupling * coupling < warp_stiffness * weft_stiffness:
        raise ValueError(
            f"no stiffness is left along warp and weft: the springs of bending add {subtracted[0]} and "
            f"{subtracted[1]} N/m to {moduli.warp} and {moduli.weft} N/m; raise the moduli or lower the bending "
            "stiffness"
        )
    stiffness = np.array([warp_stiffness, coupling, weft_stiffness, shear])
    if viscosity:
        viscosities = stiffness * (viscosity / moduli.warp)
    else:
        unit = k_d0 * math.sqrt(density)
        # The coupling is negative for a negative Poisson's ratio.
        viscosities = unit * np.sqrt(np.array([warp_stiffness, 0.0, weft_stiffness, shear]))
        viscosities[1] = unit * coupling / math.sqrt(math.sqrt(warp_stiffness * weft_stiffness))
    corners = thread_coordinates(positions, triangles, warp)
    return MembraneTriangles(
        triangles,
        corners,
        moduli=stiffness,
        viscosities=viscosities,
        sized=not viscosity,
        growth=moduli.growth(),
        share=share,
        grid=grid,
    )


def dot_rows(a: Array, b: Array) -> Array:
    """Return the scalar products of corresponding rows (m, 3), shape (m,)."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def cross_rows(a: Array, b: Array) -> Array:
    """Return the vector products of corresponding rows, shape (m, 3)."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=1)
