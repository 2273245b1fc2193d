# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Identifiability by Fisher's information matrix, and correlation of residuals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitParameter
from cloth_sim_ros.fit.recording import FitRecording, visible_mask
from cloth_sim_ros.physics.model.forces.force import Array

#: Least component of a parameter that belongs to a direction, relative to the largest component.
MIN_COMPONENT = 0.3


@attrs.frozen(kw_only=True)
class ConfoundedDirection:
    """Joint change of parameters to which the clouds are insensitive, with its standard deviation."""

    parameters: tuple[FitParameter, ...]
    #: Change of each parameter's logarithm, relative to the largest.
    components: tuple[float, ...]
    #: Relative standard deviation of the first parameter if the others change with it.
    bound: float

    @property
    def is_single(self) -> bool:
        """True if the direction has only one parameter."""
        return len(self.parameters) == 1


def confounded_directions(
    parameters: Sequence[FitParameter], fisher: Array, within: float
) -> Iterator[ConfoundedDirection]:
    """Yield the joint changes of parameters whose standard deviation exceeds `within`, the most uncertain first.

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
        components = vector / vector[int(np.argmax(np.abs(vector)))]
        indices = [i for i in np.argsort(-np.abs(components), kind="stable") if abs(components[i]) >= MIN_COMPONENT]
        confounded = tuple(parameters[i] for i in indices)
        shares = tuple(float(components[i]) for i in indices)
        yield ConfoundedDirection(parameters=confounded, components=shares, bound=float(bound))


def correlation(recording: FitRecording, r: Array, n_clouds: int) -> float:
    """Return the correlation of a particle's residuals in successive clouds, from 0 to 0.99; 0 for bare points."""
    if not recording.matched or not r.size:
        return 0.0
    offset = 0
    covariance_sum = variance_sum = 0.0
    n_pairs = 0
    previous: NDArray[np.float64] | None = None
    for cloud in recording.clouds[:n_clouds]:
        seen = visible_mask(cloud)
        residuals = np.full(cloud.shape, np.nan)
        count = 3 * int(seen.sum())
        residuals[seen] = r[offset : offset + count].reshape(-1, 3)
        offset += count
        if previous is not None:
            is_paired = np.isfinite(previous) & np.isfinite(residuals)
            covariance_sum += float((previous[is_paired] * residuals[is_paired]).sum())
            variance_sum += 0.5 * float((previous[is_paired] ** 2 + residuals[is_paired] ** 2).sum())
            n_pairs += int(is_paired.sum())
        previous = residuals
    return min(max(covariance_sum / variance_sum, 0.0), 0.99) if n_pairs > 30 and variance_sum > 0.0 else 0.0
