# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Altitude springs (S9): seven candidate springs of a tetrahedron, blended into one."""

from __future__ import annotations

from numpy.typing import ArrayLike

from cloth_sim_ros.physics.model.forces.hinge_springs import HingeSprings


class AltitudeSprings(HingeSprings):
    """Bending springs (S9): one per hinge, on a blend of its tetrahedron's seven edge-edge and point-face distances.

    Candidate c has the signed length h_c = 6V/M_c, with ``M_c = |a × b|`` of its face or its pair of edges. The blend
    has the length h.

        1/h² = ½ Σ 1/h_c².
        h = 6V / √(½ Σ M_c²) = 6V / √(Σ over the faces of M_f²).

    The squares of the three edge-edge M_c sum to those of the four faces. The gradient is Σ ½ (M_c/M)³ ∇h_c: all seven
    springs pull at once, the shortest most. Therefore there is no switch and no memory. Force and energy are smooth
    until all four points are collinear; there the force is zero (thinner than 1e-12).

    Args:
        quads: particles (edge0, edge1, wing0, wing1) as in `surface`, shape (m, 4).
        rest_length: signed rest lengths of the blend [m], shape (m,) or one number; 0 is flat.
        stiffness: κ̂ [N/m], shape (m,) or one number.
        damping: k_d [N s/m], shape (m,) or one number.
        name: the force's name in a model.

    Raises:
        ValueError: as `HingeSprings` does.
    """

    kind = "altitude"

    def __init__(
        self,
        quads: ArrayLike,
        rest_length: ArrayLike,
        stiffness: ArrayLike,
        damping: ArrayLike = 0.0,
        *,
        name: str = "altitude",
    ) -> None:
        super().__init__(quads, rest_length, stiffness, damping, name=name)
