# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Opposite springs (S7): bending springs between the opposite vertices of two triangles.

The triangles share an edge. S7 is the lecture's bending spring.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import checked_floats, checked_indices
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings


class OppositeSprings(PairSprings):
    """Bending springs (S7): pair springs between the wings, the two opposite vertices, of each hinge.

    Let L be the distance of the wings of two equal triangles when flat. A fold θ then has the energy k L θ⁴/128 and the
    moment k L θ³/32. Therefore these springs do not resist small folds and have no bending modulus. With a rest angle
    that is not flat they push neither way when the wings are coplanar. S8 and S9 cure both.

    Args:
        wings: opposite vertices, shape (m, 2); see `surface.opposite_pairs`.
        rest_length: rest lengths [m], shape (m,) or one number, above 0.
        stiffness: k_s [N], force per strain, shape (m,) or one number.
        damping: k_d [N s/m], shape (m,) or one number.
        name: the force's name in a model.

    Raises:
        ValueError: for a rest length of 0, and as `PairSprings` does.
    """

    def __init__(
        self,
        wings: ArrayLike,
        rest_length: ArrayLike,
        stiffness: ArrayLike,
        damping: ArrayLike = 0.0,
        *,
        name: str = "opposite",
    ) -> None:
        pairs = checked_indices(f"wings of '{name}'", wings, 2, np.iinfo(np.int64).max)
        rest_lengths = checked_floats(f"rest_length of '{name}'", rest_length, (len(pairs),))
        wrong = np.flatnonzero(~(rest_lengths > 0.0))
        if wrong.size:
            raise ValueError(
                f"rest_length of bending spring {wrong[0]} (particles {pairs[wrong[0]].tolist()}) is "
                f"{rest_lengths[wrong[0]]}; it must be above 0: a pair folded shut at rest has no such spring"
            )
        super().__init__(pairs, rest_lengths, stiffness, damping, name=name)
