# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random generators of many cloths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class Generators:
    """Random generators, one per cloth, created when they are seeded or first used.

    Args:
        count: number of generators.
    """

    def __init__(self, count: int) -> None:
        self._generators: list[tuple[np.random.Generator, int] | None] = [None] * count

    def seed(self, seed: int | Sequence[int | None] | None, indices: Sequence[int]) -> None:
        """Seed the random generators of some cloths, or keep their states (None). Raises ValueError.

        Args:
            seed: seed of generator 0, which increases by 1 per generator; or one seed for each of them. None keeps a
                generator's state.
            indices: indices of the seeded generators.

        Raises:
            ValueError: if the number of seeds is wrong, or a seed is no whole number of at least 0.
        """
        if seed is None:
            return
        seeds = self._checked_seeds(seed)
        for i in indices:
            if (entry := seeds[i]) is not None:
                self._make(i, entry)

    def generator(self, index: int) -> np.random.Generator:
        """Return the random generator of one cloth; one without a seed gets a random seed at its first use."""
        entry = self._generators[index]
        return self._make(index, None) if entry is None else entry[0]

    def generators(self) -> tuple[np.random.Generator, ...]:
        """Return the random generators of all cloths, those without a seed randomly seeded."""
        return tuple(self.generator(i) for i in range(len(self._generators)))

    def seeds(self) -> tuple[int, ...]:
        """Return the seeds of all cloths' random generators; those without a seed get a random one."""
        self.generators()
        return tuple(entry[1] for entry in self._generators if entry is not None)

    def _checked_seeds(self, seed: Any) -> list[int | None]:
        """Return the seed of each generator, checked before any is seeded."""
        count = len(self._generators)
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + i for i in range(count)]
        if isinstance(seed, str) or not np.iterable(seed):
            raise ValueError(f"seed is {seed!r}; it must be a whole number, or one for each cloth")
        seeds = list(seed)
        if len(seeds) != count:
            raise ValueError(f"seed has {len(seeds)} numbers; give one for each of the {count} cloths, or one number")
        for i, entry in enumerate(seeds):
            if entry is not None and (isinstance(entry, bool) or not isinstance(entry, int | np.integer) or entry < 0):
                raise ValueError(f"seed of cloth {i} is {entry!r}; it must be a whole number of at least 0, or None")
        return [None if entry is None else int(entry) for entry in seeds]

    def _make(self, index: int, seed: int | None) -> np.random.Generator:
        from gymnasium.utils import seeding

        generator, used = seeding.np_random(seed)
        self._generators[index] = generator, used
        return generator
