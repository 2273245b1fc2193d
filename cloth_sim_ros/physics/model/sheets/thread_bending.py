# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hinge constants of a mesh with different bending moduli along warp and weft.

The isotropic constants (`bending.shape_hinge_constants`) get the factor u c² + v s². The direction of the fold has the
components c and s along warp and weft. A flat sheet with the curvatures κ = (κ11, κ22, 2 κ12) along warp and weft folds
hinge i by F_i κ. The energy per area is ½ κ'C κ with C = Σ k_i F_i F_i' / area. A strip along the warp with free edges
has the modulus 1 / (C⁻¹)11, one along the weft 1 / (C⁻¹)22. The factors u and v make these two those of the fabric,
relative to the isotropic ones. C is linear in u and v. This iteration converges, with C0 = C at u = v = 1.

    u ← u D1 (C⁻¹)11 / (C0⁻¹)11,   v ← v D2 (C⁻¹)22 / (C0⁻¹)22

Two factors leave the twist as it comes out. Independent hinges represent a ratio of about 3;
docs/bending.md has the measured figures.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.band import fixed_sum
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape
from cloth_sim_ros.physics.model.sheets.membrane import along_plane, cross_rows, dot_rows

_ITERATIONS = 200
#: Smallest factor over the largest one.
_MIN_FRACTION = 1e-3
#: Smallest determinant of a tensor over the product of its diagonal; that of a singular one is a rounding error.
_MIN_DETERMINANT = 1e-12
#: Largest deviation of a modulus from the requested one.
MAX_DEVIATION = 0.2


def thread_factors(
    hinges: ArrayLike, positions: ArrayLike, constants: Array, *, moduli: tuple[float, float], warp: ArrayLike
) -> Array:
    """Return the factors on isotropic hinge constants that give a mesh its bending moduli along warp and weft, (m,).

    Args:
        hinges: hinges of the mesh, shape (m, 4).
        positions: rest positions [m], shape (n, 3).
        constants: k_θ for the modulus 1 N m, shape (m,).
        moduli: bending moduli along warp and weft [N m], above 0.
        warp: direction of the warp, shape (3,).

    Raises:
        ValueError: if the hinges can't represent the moduli.
    """
    quads = np.asarray(hinges, dtype=np.int64).reshape(-1, 4)
    shape = HingeShape.of(quads, positions)
    cosine, sine = _fold_directions(quads, np.asarray(positions, dtype=np.float64), warp)
    folds = _folds(shape, cosine, sine)
    along_warp, along_weft = (_tensor(folds, constants * part * part) for part in (cosine, sine))
    reference = _strip_compliances([a + b for a, b in zip(along_warp, along_weft, strict=True)])
    factors = list(moduli)
    reached = [0.0, 0.0]
    for _ in range(_ITERATIONS):
        tensor = [factors[0] * a + factors[1] * b for a, b in zip(along_warp, along_weft, strict=True)]
        compliances = _strip_compliances(tensor)
        reached = [r / c for r, c in zip(reference, compliances, strict=True)]
        factors = [f * d / m for f, d, m in zip(factors, moduli, reached, strict=True)]
        lowest = _MIN_FRACTION * max(factors)
        factors = [max(factor, lowest) for factor in factors]
    for thread, modulus, requested in zip(("warp", "weft"), reached, moduli, strict=True):
        if not abs(modulus - requested) <= MAX_DEVIATION * requested:
            raise ValueError(
                f"along the {thread} the hinges of this mesh reach {modulus:.3g} N m; choose a ratio of at most about "
                "3, a grid, or bending.model 'shape_operator'"
            )
    return np.asarray(factors[0] * cosine * cosine + factors[1] * sine * sine)


def _fold_directions(quads: NDArray[np.int64], x: Array, warp: ArrayLike) -> tuple[Array, Array]:
    """Return the components along warp and weft of the unit vector across each hinge's edge, (m,) each."""
    first, second, wing0, wing1 = (x[quads[:, i]] for i in range(4))
    edge = second - first
    normal = cross_rows(edge, wing0 - first) - cross_rows(edge, wing1 - first)
    along, unit = along_plane(normal, warp)
    edge = edge / np.sqrt(dot_rows(edge, edge))[:, None]
    across = cross_rows(edge, unit)
    return dot_rows(across, along), dot_rows(across, cross_rows(unit, along))


def _folds(shape: HingeShape, cosine: Array, sine: Array) -> list[Array]:
    """Return the fold angle of each hinge per curvature κ11, κ22 and 2 κ12 of the sheet [m], three arrays (m,)."""
    across = 0.5 * (shape.height0 + shape.height1)
    along = 0.5 * (
        shape.foot0 * (shape.foot0 - shape.edge) / shape.height0
        + shape.foot1 * (shape.foot1 - shape.edge) / shape.height1
    )
    twist = shape.foot1 - shape.foot0
    c2, s2, cs = cosine * cosine, sine * sine, cosine * sine
    return [
        across * c2 + along * s2 - twist * cs,
        across * s2 + along * c2 + twist * cs,
        (across - along) * cs + 0.5 * twist * (c2 - s2),
    ]


def _tensor(folds: list[Array], constants: Array) -> list[float]:
    """Return the entries 11, 12, 13, 22, 23, 33 of the sheet's bending stiffness Σ k F F', F the folds of hinges."""
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    return [fixed_sum(np.ascontiguousarray(constants * folds[i] * folds[j])) for i, j in pairs]


def _strip_compliances(tensor: list[float]) -> tuple[float, float]:
    """Return the entries 11 and 22 of the inverse of a symmetric 3x3 matrix, given by its six entries."""
    c11, c12, c13, c22, c23, c33 = tensor
    determinant = c11 * (c22 * c33 - c23 * c23) - c12 * (c12 * c33 - c13 * c23) + c13 * (c12 * c23 - c13 * c22)
    if not determinant > _MIN_DETERMINANT * c11 * c22 * c33:
        raise ValueError("the hinges of this mesh do not resist every curvature; use a finer mesh, or one modulus")
    return (c22 * c33 - c23 * c23) / determinant, (c11 * c33 - c13 * c13) / determinant
