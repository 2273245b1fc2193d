# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A random generator for each of many cloths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class Generators:
    """Made when they are first asked for, or seeded.

    Args:
        count: how many.
    """

    def __init__(self, count: int) -> None:
        self._made: list[tuple[np.random.Generator, int] | None] = [None] * count

    def seed(self, seed: int | Sequence[int | None] | None, indices: Sequence[int]) -> None:
        """Seed some of them: with a number and the next ones, or with one each; with None they go on.

        Raises:
            ValueError: for another number of seeds, or one that is no whole number of at least 0.
        """
        count = len(self._made)
        if seed is None:
            return
        seeds = [int(seed) + i for i in range(count)] if isinstance(seed, int | np.integer) else list(seed)
        if len(seeds) != count:
            raise ValueError(f"seed has {len(seeds)} numbers; give one for each of the {count} cloths, or one number")
        for i in indices:
            if seeds[i] is not None:
                self._make(i, seeds[i])

    def of(self, index: int) -> np.random.Generator:
        """Return one of them."""
        made = self._made[index]
        return self._make(index, None) if made is None else made[0]

    def all(self) -> tuple[np.random.Generator, ...]:
        """Return all of them."""
        return tuple(self.of(i) for i in range(len(self._made)))

    def seeds(self) -> tuple[int, ...]:
        """Return what each was seeded with."""
        self.all()
        return tuple(made[1] for made in self._made if made is not None)

    def _make(self, index: int, seed: int | None) -> np.random.Generator:
        from gymnasium.utils import seeding

        generator, used = seeding.np_random(seed)
        self._made[index] = generator, used
        return generator
