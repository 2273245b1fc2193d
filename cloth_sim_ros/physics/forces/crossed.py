# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""S8: the lecture's second bending spring, between the shared edge and the bending spring."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import indices
from cloth_sim_ros.physics.forces.hinge_springs import HingeSprings


class CrossedSprings(HingeSprings):
    """Edge-edge springs (S8): h is the signed distance of the lines of the shared edge and of the wings.

    h = n·(point of the wings' line - point of the edge's line), n their common normal on the side of the surface's
    normal; the force is shared by the four particles with the weights of the feet of the common normal, which are not
    clamped. With the lines parallel, as in a symmetric pair folded by exactly 180°, there is no such normal and no
    force (sine below 1e-6); S9 has no such gap.

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
    #: Next to parallel lines.
    boundless = True

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
        first = indices(f"edges of '{name}'", edges, 2, np.iinfo(np.int64).max)
        second = indices(f"wings of '{name}'", wings, 2, np.iinfo(np.int64).max)
        if len(first) != len(second):
            raise ValueError(f"'{name}' has {len(first)} edges and {len(second)} pairs of wings; give one pair an edge")
        hinges = np.concatenate((first, second), axis=1)
        super().__init__(hinges, rest_length, stiffness, damping, name=name)
