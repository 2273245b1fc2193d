# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bending springs from a sheet's bending modulus, calibrated for each mesh pattern.

The modulus D [N m] is what a cantilever test measures: moment per width over curvature of a strip with free long edges.
A fold θ of a hinge has the energy k_θ θ²/2. The hinge constant k_θ [N m] follows from D and the pattern of the mesh.

*Grid.* The hinges are those of both checkerboards (`surface.grid_hinges`), each at half strength. Therefore all
particles are alike, and a smooth bending leaves each on the smooth surface. Let the curvatures be κ. The hinge of an
edge along the columns (length hy) folds by κ_xx hx. One along the rows folds by κ_yy hy, a diagonal (length l) by κ_xy
l. The energy per cell is ½ D hx hy (κ_xx² + κ_yy² + 2 κ_xy²), a plate without Poisson's ratio, for these constants.

    k_θ = D hy/hx,   D hx/hy,   2 D hx hy/l².

Threads make D_x along rows and D_y along columns differ. The three constants then have D_x, D_y and sqrt(D_x D_y).
The last one is the usual torsional stiffness of an orthotropic plate (Timoshenko and Woinowsky-Krieger, Theory of
Plates and Shells, 1959, section 86).

*One triangulation of a grid.* Take a strip along the rows under the moment M per width. By statics the hinge of an edge
across it has the moment M hy, that of a diagonal M hy²/l. Each turns by its moment over k_θ. Over one cell hx/(D hy) =
1/k_across + (hy/l)²/k_diagonal. The diagonals' share is free: k_diagonal = 1.5 D (l²/(2 hx hy))². With it a square
checkerboard is isotropic with Poisson's ratio -1/3. One family of diagonals still twists when bent.

*Other meshes.* k_θ = (9/8) D e/h̄, h̄ the mean height of the two triangles. This is exact for regular triangles
(isotropic, Poisson's ratio -1/3). Irregular ones make the sheet stiffer, because its vertices lock one another;
docs/bending.md has the measured figures.

*Springs.* With h(θ) and L(θ) of `HingeShape`, a fold from rest has the energy ½ (κ̂ h'² + κ7 L'²) Δθ². S7 has κ7 = κ̂
(h_max / ½ΔL)² / ρ [N/m] with the stiffness ratio ρ. This fixes κ̂.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.band import fixed_sum
from cloth_sim_ros.physics.arithmetic.angles import sine_and_cosine
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.crossed import CrossedSprings
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.hinge_springs import HingeSprings, gradient_squares
from cloth_sim_ros.physics.model.forces.opposite import OppositeSprings
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.forces.quadratic import QuadraticHinges
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape
from cloth_sim_ros.physics.model.sheets.surface import needs_opposite_spring

BendingModel = Literal["opposite", "crossed", "altitude", "quadratic"]

#: Largest sine of a rest fold that counts as flat.
_FLAT_SINE = 1e-3
#: Stiffness ratio ρ of S8 or S9 to S7, the rest fold [rad] above which another ratio holds, and that ratio. Each is the
#: middle of the range in which a pair finds its rest shape again (docs/bending.md has the map).
RATIOS = {"crossed": (2.0, math.pi, 2.0), "altitude": (0.5, math.radians(80.0), 1.4)}


def mesh_hinge_constants(hinges: ArrayLike, positions: ArrayLike, *, bending_modulus: float) -> Array:
    """Return hinge constants k_θ [N m] of hinges (m, 4) of a triangle mesh at rest at `positions` (n, 3), shape (m,).

    Raises:
        ValueError: for a modulus that is not finite and at least 0, or a triangle without area.
    """
    return shape_hinge_constants(HingeShape.of(hinges, positions), bending_modulus=bending_modulus)


def shape_hinge_constants(shape: HingeShape, *, bending_modulus: float) -> Array:
    """Return hinge constants k_θ [N m] of a triangle mesh from its hinges' rest shape, shape (m,).

    Raises:
        ValueError: for a modulus that is not finite and at least 0.
    """
    _check_modulus(bending_modulus)
    return 1.125 * bending_modulus * shape.edge / (0.5 * (shape.height0 + shape.height1))


def grid_hinge_constants(
    hinges: ArrayLike, *, columns: int, spacing: tuple[float, float], bending_modulus: float | tuple[float, float]
) -> Array:
    """Return hinge constants k_θ [N m] of hinges (m, 4) of a grid, from bending moduli, shape (m,).

    Args:
        hinges: those of `surface.grid_hinges`, which bend best, or those of the grid's one surface.
        columns: number of particles in a row.
        spacing: distances hx of neighbours in a row and hy in a column [m].
        bending_modulus: D [N m], one number, or D_x along rows and D_y along columns for both checkerboards.

    Raises:
        ValueError: for a modulus that is not finite and at least 0, a spacing that is not above 0, or two moduli for
            one surface.
    """
    along_x, along_y = bending_modulus if isinstance(bending_modulus, tuple) else (bending_modulus, bending_modulus)
    _check_modulus(along_x)
    _check_modulus(along_y)
    hx, hy = spacing
    if not (math.isfinite(hx * hy) and min(hx, hy) > 0.0):
        raise ValueError(f"spacing is ({hx}, {hy}) m; both must be finite and above 0")
    quads = np.asarray(hinges, dtype=np.int64).reshape(-1, 4)
    row, column = np.divmod(quads[:, :2], columns)
    along_column, along_row = column[:, 0] == column[:, 1], row[:, 0] == row[:, 1]
    square = hx * hx + hy * hy
    diagonals = quads[~(along_column | along_row)]
    cells = np.unique(np.sort(diagonals, axis=1), axis=0)
    if len(diagonals) == 2 * len(cells):  # both diagonals of every cell: both checkerboards
        across, along, diagonal = 0.5 * hy / hx, 0.5 * hx / hy, hx * hy / square
    else:
        diagonal = 1.5 * (square / (2.0 * hx * hy)) * (square / (2.0 * hx * hy))
        across = 1.0 / (hx / hy - hy * hy / (square * diagonal))
        along = 1.0 / (hy / hx - hx * hx / (square * diagonal))
        if along_x != along_y:
            raise ValueError(
                f"bending_modulus is {along_x} N m along rows and {along_y} N m along columns; one surface has one "
                "modulus: give the hinges of grid_hinges, or one modulus"
            )
    twist = along_x if along_x == along_y else math.sqrt(along_x * along_y)
    return np.select([along_column, along_row], [along_x * across, along_y * along], twist * diagonal)


def bending_terms(
    model: BendingModel,
    hinges: ArrayLike,
    positions: ArrayLike,
    *,
    hinge_constants: ArrayLike | None = None,
    spring_stiffness: ArrayLike | None = None,
    rest_angle: ArrayLike | None = None,
    ratio: float | None = None,
    damping: float = 0.0,
    masses: ArrayLike | None = None,
    existing: ArrayLike | None = None,
    shape: HingeShape | None = None,
    weights: Array | None = None,
) -> list[PairSprings | HingeSprings | QuadraticHinges]:
    """Return the forces of a bending model as a list: S7 alone, S7 and then S8 or S9, or quadratic hinges.

    `opposite` is S7 alone, `crossed` S7 and S8, `altitude` S7 and S9, `quadratic` has quadratic hinges alone.

    Args:
        model: the bending model.
        hinges: hinges of the surface, shape (m, 4).
        positions: particles of the surface at rest [m], shape (n, 3).
        hinge_constants: k_θ [N m], shape (m,), for all models but `opposite`; see `grid_hinge_constants`,
            `mesh_hinge_constants`.
        spring_stiffness: k_s [N] of S7, one number or shape (m,), for `opposite` alone.
        rest_angle: fold at rest [rad], positive to the side of the normal, one number or shape (m,). None, or NaN in an
            array, takes the fold of `positions`.
        ratio: stiffness ratio ρ; None is the one that docs/bending.md recommends.
        damping: the dimensionless k_d0 of every bending spring.
        masses: particle masses [kg], shape (n,); required with damping.
        existing: pairs of existing springs, (s, 2); S7 leaves them out.
        shape: hinges at rest; None measures those of `positions`.
        weights: weights of quadratic hinges [1/m], shape (m, 4); None takes those of `shape`.

    Raises:
        ValueError: for a parameter that does not belong to the model or is out of range.
    """
    quads = np.ascontiguousarray(hinges, dtype=np.int64).reshape(-1, 4)
    shape = HingeShape.of(quads, positions) if shape is None else shape
    if rest_angle is not None:
        angles = np.array(np.broadcast_to(np.asarray(rest_angle, dtype=np.float64), shape.edge.shape))
        is_missing = np.isnan(angles) & (np.ndim(rest_angle) > 0)
        wrong = np.flatnonzero(~(is_missing | (np.abs(angles) < math.pi)))
        if wrong.size:
            raise ValueError(f"rest_angle is {angles[wrong[0]]} rad; it must lie between -π and π, both excluded")
        shape = shape.folded(angles)
    if damping and masses is None:
        raise ValueError(f"damping is {damping} without masses; critical damping depends on them, so give both")
    mass = np.ones(quads.max(initial=-1) + 1) if masses is None else np.asarray(masses, dtype=np.float64)
    distance = shape.wing_distance()
    has_spring = needs_opposite_spring(quads, existing) & (distance > 0.0)
    if model == "opposite":
        if hinge_constants is not None:
            refuse_bending_modulus(model)
        if spring_stiffness is None:
            raise ValueError("bending model 'opposite' needs spring_stiffness, k_s in N")
        k_s = np.array(np.broadcast_to(np.asarray(spring_stiffness, dtype=np.float64), distance.shape))
        return [_opposite_springs(quads, distance, k_s, has_spring, damping, mass)]
    if spring_stiffness is not None or hinge_constants is None:
        raise ValueError(f"bending model '{model}' takes hinge_constants (k_θ in N m), not spring_stiffness")
    if model == "quadratic":
        constants = np.asarray(hinge_constants, dtype=np.float64)
        check_flat(quads, shape, "quadratic hinges")
        weights = hinge_weights(shape) if weights is None else weights
        return [QuadraticHinges(quads, weights, constants, _damping_time(damping, constants, weights, mass[quads]))]
    stiffness, opposite_stiffness = spring_constants(model, shape, hinge_constants, ratio=ratio)
    is_altitude = model == "altitude"
    rest_length = shape.length("altitude" if is_altitude else "crossed")
    k_d = _hinge_damping(damping, stiffness, shape, quads, mass, is_altitude)
    if is_altitude:
        hinge_springs: HingeSprings = AltitudeSprings(quads, rest_length, stiffness, k_d)
    else:
        hinge_springs = CrossedSprings(quads[:, :2], quads[:, 2:], rest_length, stiffness, k_d)
    return [_opposite_springs(quads, distance, opposite_stiffness * distance, has_spring, damping, mass), hinge_springs]


def check_flat(hinges: NDArray[np.int64], shape: HingeShape, subject: str) -> None:
    """Raise ValueError if a hinge (m, 4) is folded at rest, for bending models that are flat at rest.

    Args:
        hinges: particles of the hinges.
        shape: hinges at rest.
        subject: what is flat at rest, for the error.

    Raises:
        ValueError: naming the first hinge with a fold.
    """
    bent = np.flatnonzero((np.abs(shape.sine) > _FLAT_SINE) | (shape.cosine < 0.0))
    if bent.size:
        raise ValueError(
            f"hinge {bent[0]} {hinges[bent[0]].tolist()} rests at a fold of sine {shape.sine[bent[0]]:.3g}, "
            f"cosine {shape.cosine[bent[0]]:.3g}, and {subject} are flat at rest; set "
            "bending.flat to true and no rest angle, or choose 'crossed' or 'altitude'"
        )


def hinge_weights(shape: HingeShape) -> Array:
    """Return the weights w_i [1/m] of the particles of quadratic hinges, from flat triangles, shape (m, 4).

    The vector Σ w_i x_i is the sum of the unit vectors from the edge to both wings, at right angles to it.
    """
    at_end = shape.foot0 / shape.edge / shape.height0 + shape.foot1 / shape.edge / shape.height1
    first, second = 1.0 / shape.height0, 1.0 / shape.height1
    return np.stack([at_end - first - second, -at_end, first, second], axis=1)


def grid_hinge_weights(hinges: ArrayLike, *, columns: int, spacing: tuple[float, float]) -> Array:
    """Return the weights w_i [1/m] of the particles of a grid's quadratic hinges, without rounding, shape (m, 4).

    They are those of `hinge_weights`. The hinges of an edge along a column have second differences along a row, those
    of a diagonal twists of a cell.

    Args:
        hinges: those of `surface.grid_hinges`, shape (m, 4).
        columns: number of particles in a row.
        spacing: distances hx of neighbours in a row and hy in a column [m].
    """
    quads = np.asarray(hinges, dtype=np.int64).reshape(-1, 4)
    hx, hy = spacing
    row, column = np.divmod(quads, columns)
    along_column, along_row = column[:, 0] == column[:, 1], row[:, 0] == row[:, 1]
    wing = np.select([along_column, along_row], [1.0 / hx, 1.0 / hy], math.sqrt(hx * hx + hy * hy) / (hx * hy))
    # The second difference passes through the end of the edge that is in line with the wings.
    is_first = np.where(along_column, row[:, 0] == row[:, 2], column[:, 0] == column[:, 2])
    share = np.where(along_column | along_row, np.where(is_first, 2.0, 0.0), 1.0)
    return np.stack([-share * wing, (share - 2.0) * wing, wing, wing], axis=1)


def _damping_time(damping: float, constants: Array, weights: Array, masses: Array) -> float:
    """Return the damping time of quadratic hinges [s]: the least k_d / k over hinges; 0 without damping."""
    is_stiff = constants > 0.0
    if not damping or not is_stiff.any():
        return 0.0
    first, second, third, fourth = (weights * weights / masses).T
    squares = first + second + third + fourth
    return damping * float(np.sqrt(2.0 / (constants[is_stiff] * squares[is_stiff])).min())


def spring_constants(
    model: Literal["crossed", "altitude"], shape: HingeShape, hinge_constants: ArrayLike, *, ratio: float | None = None
) -> tuple[Array, Array]:
    """Return spring constants κ̂ of S8 or S9 and κ7 of S7 [N/m], (m,) each, that give folds the energy k_θ Δθ²/2.

    Raises:
        ValueError: for a hinge constant or ratio out of range.
    """
    constants = np.asarray(hinge_constants, dtype=np.float64)
    wrong = np.flatnonzero(~(np.isfinite(constants) & (constants >= 0.0)))
    if constants.shape != shape.edge.shape or wrong.size:
        problem = f"{constants[wrong[0]]} at hinge {wrong[0]}" if wrong.size else f"of shape {constants.shape}"
        raise ValueError(f"hinge constants are {problem}; give {shape.edge.shape[0]} finite numbers of at least 0 N m")
    if ratio is None:
        flat, angle, folded = RATIOS[model]
        ratios = np.where(shape.cosine < sine_and_cosine(angle)[1], folded, flat)
    elif not (math.isfinite(ratio) and ratio > 0.0):
        raise ValueError(f"ratio is {ratio}; it must be finite and above 0")
    else:
        ratios = np.full_like(constants, ratio)
    opposite_per_second = _square(shape.half_range_ratio(model)) / ratios
    slope = _square(shape.length_slope(model)) + opposite_per_second * _square(shape.wing_distance_slope())
    stiffness = constants / slope
    return stiffness, opposite_per_second * stiffness


def _square(a: Array) -> Array:
    return a * a


def added_membrane_stiffness(springs: PairSprings, positions: ArrayLike, *, area: float) -> Array:
    """Return the in-plane stiffness (C11, C22, C66) [N/m] that bending springs S7 add to a flat sheet, shape (3,).

    It is the sum over springs of k L² d d d d over the area. S7's stiffness in `crossed` and `altitude` is proportional
    to D/h². On fine meshes the edge springs have to be weakened by it (docs/bending.md has the figures).

    Args:
        springs: the bending springs.
        positions: particles at rest in the plane of their first two coordinates [m], shape (n, 2) or (n, 3).
        area: area of the sheet [m²].
    """
    x = np.asarray(positions, dtype=np.float64)[:, :2]
    along = x[springs.pairs[:, 1]] - x[springs.pairs[:, 0]]
    square, product = along * along, along[:, 0] * along[:, 1]
    per_length2 = springs.rigidity / (square[:, 0] + square[:, 1]) / area
    parts = (square[:, 0] * square[:, 0], square[:, 1] * square[:, 1], product * product)
    return np.array([fixed_sum(np.ascontiguousarray(part * per_length2)) for part in parts])


def refuse_bending_modulus(model: str) -> None:
    """Raise ValueError, always: the bending models `axial` and `opposite` have no bending modulus.

    Raises:
        ValueError: always.
    """
    raise ValueError(
        f"bending model '{model}' has no bending modulus: near flat its energy grows with the fourth power of the "
        "fold, so its modulus there is zero. "
        "Give the stiffness of its springs instead, or choose 'crossed' or 'altitude'"
    )


def _opposite_springs(
    quads: np.ndarray, distance: Array, k_s: Array, has_spring: np.ndarray, damping: float, mass: Array
) -> OppositeSprings:
    """Return springs S7 between the wings of masked hinges; springs of the same pair and rest length are merged."""
    wings, lengths = quads[has_spring][:, 2:], distance[has_spring]
    pairs, rows, pair_indices = np.unique(np.sort(wings, axis=1), axis=0, return_index=True, return_inverse=True)
    rest_lengths, pair_indices = lengths[rows], pair_indices.ravel()
    max_difference = np.abs(lengths - rest_lengths[pair_indices]).max(initial=0.0)
    if max_difference > 1e-9 * rest_lengths.max(initial=0.0):
        pairs, rest_lengths, pair_indices = wings, lengths, np.arange(len(wings))
    stiffness = np.zeros(len(pairs))
    np.add.at(stiffness, pair_indices, k_s[has_spring])
    inverse_masses = 1.0 / mass[pairs[:, 0]] + 1.0 / mass[pairs[:, 1]]
    # the lecture's m of two unequal ends is the reduced mass times two
    k_d = damping * np.sqrt(2.0 / inverse_masses * stiffness / rest_lengths)
    return OppositeSprings(pairs, rest_lengths, stiffness, k_d)


def _hinge_damping(
    damping: float, stiffness: Array, shape: HingeShape, quads: np.ndarray, mass: Array, is_altitude: bool
) -> Array:
    """Return k_d = k_d0 sqrt(m κ̂) [N s/m] of S8 or S9; m is twice the reduced mass 1 / Σ |∇_i h|²/m_i at rest."""
    if not damping:
        return np.zeros_like(stiffness)
    c = np.sqrt(np.maximum(0.5 * (1.0 + shape.cosine), 0.0))
    s = np.copysign(np.sqrt(np.maximum(0.5 * (1.0 - shape.cosine), 0.0)), shape.sine)
    zero = np.zeros_like(c)
    points = np.array(
        [
            [zero, zero, -shape.height0 * c, shape.height1 * c],
            [zero, shape.edge, shape.foot0, shape.foot1],
            [zero, zero, shape.height0 * s, shape.height1 * s],
        ]
    )
    x = np.ascontiguousarray(points.transpose(0, 2, 1).reshape(3, -1))
    kind = "altitude" if is_altitude else "crossed"
    squares = gradient_squares(np.arange(4 * len(quads)).reshape(-1, 4), x, kind=kind)
    first, second, third, fourth = (squares / mass[quads]).T
    return damping * np.sqrt(2.0 * stiffness / (first + second + third + fourth))


def _check_modulus(bending_modulus: float) -> None:
    if not (math.isfinite(bending_modulus) and bending_modulus >= 0.0):
        raise ValueError(f"bending_modulus is {bending_modulus} N m; it must be finite and at least 0")
