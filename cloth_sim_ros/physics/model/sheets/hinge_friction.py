# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Friction of hinges from a sheet's friction moment.

The friction moment M_f [N] is a moment per width: half of the width 2HB of the loop of moment over curvature. Up to the
yield curvature κ_y the friction of a hinge is elastic. Its hinge constant is that of the bending modulus M_f / κ_y, and
its largest moment M_f times the length of its edge. docs/derivations/bending_friction.md derives both.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cloth_sim_ros.physics.model.forces.bending_friction import BendingFriction
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape

#: Smallest slope dh/dθ at the rest fold, relative to that of a flat hinge: the length of a nearly shut hinge hardly
#: changes with its fold.
_MIN_SLOPE_FRACTION = 0.1


def hinge_friction(hinges: Any, shape: HingeShape, *, hinge_constants: Array, moments: Array) -> BendingFriction:
    """Return the force of bending friction of hinges, from their elastic constants and largest friction moments.

    Args:
        hinges: particles (edge0, edge1, wing0, wing1), shape (m, 4).
        shape: the hinges at rest.
        hinge_constants: k_θ of the elastic part [N m], shape (m,).
        moments: largest friction moment of each hinge [N m], shape (m,).

    Raises:
        ValueError: for a hinge that is nearly shut at rest.
    """
    slope = shape.length_slope("crossed")
    flat_slope = shape.folded(0.0).length_slope("crossed")
    shut = np.flatnonzero(~(slope >= _MIN_SLOPE_FRACTION * flat_slope))
    if shut.size:
        raise ValueError(
            f"hinge {shut[0]} rests at a fold of cosine {shape.cosine[shut[0]]:.3g}, too close to shut for friction; "
            "set bending.friction_moment to 0, or a rest angle of at most 2.9 rad"
        )
    stiffness = hinge_constants / (slope * slope)
    reach = moments / hinge_constants * slope
    return BendingFriction(hinges, shape.length("crossed"), stiffness, reach)
