# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Identifiability by Fisher's information matrix, and correlation of residuals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.batch.fit_parameters import Fitted
from cloth_sim_ros.batch.fit_recording import Recording, visible
from cloth_sim_ros.physics.forces.force import Array

#: Least component of a parameter that belongs to a direction, relative to the largest component.
PART = 0.3


@attrs.frozen(kw_only=True)
class Tie:
    """Direction of joint parameter changes to which the clouds are insensitive."""

    parameters: tuple[Fitted, ...]
    #: Change of each parameter's logarithm, relative to the largest.
    parts: tuple[float, ...]
    #: Relative standard deviation of the first parameter if the others change with it.
    bound: float

    @property
    def single(self) -> bool:
        """True if the direction has only one parameter."""
        return len(self.parameters) == 1


def ties(fitted: Sequence[Fitted], fisher: Array, within: float) -> Iterator[Tie]:
    """Yield the directions with a standard deviation above a limit, the most uncertain first.

    Args:
        parameters: the parameters.
        fisher: Fisher's information matrix of their logarithms, shape (p, p).
        within: largest relative standard deviation of an identified parameter.
    """
    values, vectors = np.linalg.eigh(fisher)
    floor = 1e-12 * max(float(values[-1]), 1e-300)
    for value, vector in zip(values, vectors.T, strict=True):
        largest = float(np.abs(vector).max())
        bound = largest / np.sqrt(value) if value > floor else np.inf
        if bound <= within:
            return
        parts = vector / vector[int(np.argmax(np.abs(vector)))]
        chosen = [i for i in np.argsort(-np.abs(parts), kind="stable") if abs(parts[i]) >= PART]
        yield Tie(
            parameters=tuple(fitted[i] for i in chosen),
            parts=tuple(float(parts[i]) for i in chosen),
            bound=float(bound),
        )


def correlation(recording: Recording, r: Array, clouds: int) -> float:
    """Return the correlation between a particle's residuals in successive clouds; 0 for bare points."""
    if not recording.matched or not r.size:
        return 0.0
    at = 0
    together = own = 0.0
    pairs = 0
    before: NDArray[np.float64] | None = None
    for cloud in recording.clouds[:clouds]:
        seen = visible(cloud)
        whole = np.full(cloud.shape, np.nan)
        count = 3 * int(seen.sum())
        whole[seen] = r[at : at + count].reshape(-1, 3)
        at += count
        if before is not None:
            both = np.isfinite(before) & np.isfinite(whole)
            together += float((before[both] * whole[both]).sum())
            own += 0.5 * float((before[both] ** 2 + whole[both] ** 2).sum())
            pairs += int(both.sum())
        before = whole
    return min(max(together / own, 0.0), 0.99) if pairs > 30 and own > 0.0 else 0.0
