# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Crossed springs (S8): bending springs between a hinge's edge and its wings' line.

S8 is the lecture's second bending spring.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import checked_indices
from cloth_sim_ros.physics.model.forces.hinge_springs import HingeSprings


class CrossedSprings(HingeSprings):
    """Bending springs (S8) on the signed distance h between a hinge's shared edge a and the line b between its wings.

    The distance is 6V divided by the norm of a × b. It is positive if the wings rise to the side of the surface's
    normal. Parallel lines, as in a symmetric pair folded by exactly 180°, have no common normal: there the force would
    grow without limit. Therefore h = 6V/M with M² = (a × b)² + (0.1 a²)². It is bounded for every angle, and within
    some 6° of 180° the spring lets go. Where the shared edge shrinks to nothing, h stays bounded. The force
    then grows as the inverse of its length, and the stiffness as the inverse square.

    Args:
        edges: the shared edges, shape (m, 2).
        wings: the opposite vertices, shape (m, 2); wing 0 lies in the triangle that runs along the edge as given.
        rest_length: signed rest lengths [m], shape (m,) or one number; 0 is flat.
        stiffness: κ̂ [N/m], shape (m,) or one number.
        damping: k_d [N s/m], shape (m,) or one number.
        name: the force's name in a model.

    Raises:
        ValueError: as `HingeSprings` does.
    """

    kind = "crossed"

    def __init__(
        self,
        edges: ArrayLike,
        wings: ArrayLike,
        rest_length: ArrayLike,
        stiffness: ArrayLike,
        damping: ArrayLike = 0.0,
        *,
        name: str = "crossed",
    ) -> None:
        first = checked_indices(f"edges of '{name}'", edges, 2, np.iinfo(np.int64).max)
        second = checked_indices(f"wings of '{name}'", wings, 2, np.iinfo(np.int64).max)
        if len(first) != len(second):
            raise ValueError(f"'{name}' has {len(first)} edges and {len(second)} pairs of wings; give one pair an edge")
        hinges = np.concatenate((first, second), axis=1)
        super().__init__(hinges, rest_length, stiffness, damping, name=name)
