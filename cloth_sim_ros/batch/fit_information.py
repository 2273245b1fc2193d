# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the information matrix says: combinations of parameters that the clouds do not tell; and correlation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.batch.fit_parameters import Fitted
from cloth_sim_ros.batch.fit_recording import Recording, visible
from cloth_sim_ros.physics.forces.force import Array

#: A parameter belongs to a combination where its part is at least this of the largest.
PART = 0.3


@attrs.frozen(kw_only=True)
class Tie:
    """A direction in which parameters may change together, and the clouds hardly tell."""

    parameters: tuple[Fitted, ...]
    #: By how much their logarithms change together, the largest is 1; a parameter each.
    parts: tuple[float, ...]
    #: Deviation along it: how uncertain the first one's relative value is when the others follow.
    bound: float

    @property
    def single(self) -> bool:
        """Whether it is one parameter alone."""
        return len(self.parameters) == 1


def ties(fitted: Sequence[Fitted], fisher: Array, within: float) -> Iterator[Tie]:
    """Yield the combinations whose deviation is beyond what was asked for, the least known first.

    Args:
        fitted: the parameters.
        fisher: Fisher's matrix of their logarithms, (p, p).
        within: largest relative deviation that counts as told.
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
    """Return the correlation of a particle's residuals in one cloud and the next; 0 where clouds are bare points."""
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
