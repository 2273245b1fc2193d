# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Springs whose lists are made when they are first asked for: a fused plan that stands for them never asks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cloth_sim_ros.physics.terms.pair_springs import PairSprings

_LISTS = ("pairs", "rest_length", "stiffness", "damping")


class DeferredSprings(PairSprings):
    """As `PairSprings`, made by a function at the first use of one of its lists.

    Args:
        make: makes the springs.
        name: the term's name in a model.
        weak: whether it may be evaluated less often than every step.
        damped: whether the force depends on velocities.
    """

    def __init__(self, make: Callable[[], PairSprings], *, name: str, weak: bool, damped: bool) -> None:
        self._make = make
        self.name, self.weak, self.damped = name, weak, damped

    def made(self) -> PairSprings:
        """The springs; made for the caller alone where the lists were not asked for yet."""
        return self if "pairs" in vars(self) else self._make()

    def __getattr__(self, name: str) -> Any:
        """Make the lists; asked by Python for an attribute that is not there yet."""
        if name not in _LISTS:
            raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")
        made = self._make()
        for what in _LISTS:
            setattr(self, what, getattr(made, what))
        return getattr(self, name)
