# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Internal friction of bending: elasto-plastic springs on the signed lengths of hinges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.binding import checked_floats, checked_indices
from cloth_sim_ros.physics.model.forces.force import EngineForce
from cloth_sim_ros.physics.model.parts import ElementList, Part


class BendingFriction(EngineForce):
    """Internal friction of bending: elasto-plastic springs on S8's length h, force -k (h - h_p), at most k reach [N].

    Beyond the reach the plastic length h_p follows h, and the spring dissipates. Plastic lengths belong to the state
    (`State.memory`, key `bending.plastic_lengths`); docs/derivations/bending_friction.md derives the force. It has no
    resultant and no torque.

    Args:
        hinges: particles (edge0, edge1, wing0, wing1) as in `surface`, shape (m, 4).
        rest_length: plastic lengths h_p of a state without memory [m], shape (m,) or one number.
        stiffness: k [N/m], shape (m,) or one number, at least 0.
        reach: largest deflection from the plastic length [m], shape (m,) or one number, at least 0.
        name: the force's name in a model.

    Raises:
        ValueError: for a shape that does not fit, a particle that a hinge names twice, or an entry that is negative or
            not finite.
    """

    def __init__(
        self,
        hinges: ArrayLike,
        rest_length: ArrayLike,
        stiffness: ArrayLike,
        reach: ArrayLike,
        *,
        name: str = "bending_friction",
    ) -> None:
        self.name = name
        self.hinges: NDArray[np.int64] = checked_indices(f"hinges of '{name}'", hinges, 4, np.iinfo(np.int64).max)
        count = len(self.hinges)
        ordered = np.sort(self.hinges, axis=1)
        wrong = np.flatnonzero((ordered[:, :-1] == ordered[:, 1:]).any(axis=1))
        if wrong.size:
            raise ValueError(
                f"hinge {wrong[0]} of '{name}' is {self.hinges[wrong[0]].tolist()}; it needs four different particles"
            )
        self.rest_length = checked_floats(f"rest_length of '{name}'", rest_length, (count,))
        self.stiffness = checked_floats(f"stiffness of '{name}'", stiffness, (count,), lower=0.0)
        self.reach = checked_floats(f"reach of '{name}'", reach, (count,), lower=0.0)

    def parts(self, particle_count: int) -> Sequence[Part]:
        hinges = checked_indices(f"hinges of '{self.name}'", self.hinges, 4, particle_count)
        if not len(hinges):
            return ()
        coefficients = np.stack([self.rest_length, self.stiffness, self.reach], axis=1)
        return (ElementList(kind="bending_friction", particles=hinges, coefficients=coefficients),)
