# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Generator whose draws are the coordinates of a vector, so that a search can climb over random scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class VectorGenerator(np.random.Generator):
    """Generator that draws from a vector of numbers in [0, 1], one coordinate a number.

    Draws beyond the vector's end are pseudorandom, the same for every vector.
    """

    def __init__(self, vector: Sequence[float]) -> None:
        bits = np.random.PCG64(0)
        super().__init__(bits)
        self._vector, self._n_drawn, self._fallback = vector, 0, np.random.Generator(bits)

    def random(self, size: Any = None, *_arguments: Any) -> Any:  # type: ignore[override]
        """Return the next coordinates."""
        if size is not None:
            return np.array([self.random() for _ in range(int(np.prod(size)))]).reshape(size)
        self._n_drawn += 1
        if self._n_drawn > len(self._vector):
            return float(self._fallback.random())
        # 1 is excluded, as in numpy.
        return min(float(self._vector[self._n_drawn - 1]), 1.0 - 1e-12)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:  # type: ignore[override]
        """Return numbers between two limits."""
        return low + (high - low) * self.random(size)

    def integers(self, low: int, high: int | None = None, size: Any = None) -> Any:  # type: ignore[override]
        """Return integers from a lower limit (0 without an upper one) to below the upper limit."""
        first, end = (0, low) if high is None else (low, high)
        drawn = np.floor(self.uniform(first, end, size)).astype(np.int64)
        return int(drawn) if size is None else drawn

    def choice(self, a: Any, size: Any = None, *, p: Any = None) -> Any:  # type: ignore[override]
        """Return one of several alternatives."""
        if size is not None:
            # Random scenes draw one alternative at a time.
            raise NotImplementedError(f"a choice of {size} alternatives; draw one at a time")
        options = np.arange(a) if np.ndim(a) == 0 else np.asarray(a)
        weights = np.full(len(options), 1.0 / len(options)) if p is None else np.asarray(p)
        index = int(np.searchsorted(np.cumsum(weights), self.random(), side="right"))
        return options[min(index, len(options) - 1)]

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:  # type: ignore[override]
        """Return normally distributed numbers, within five standard deviations."""
        from scipy.special import ndtri

        quantiles = np.clip(self.random(size), 3e-7, 1.0 - 3e-7)
        return loc + scale * ndtri(quantiles)
