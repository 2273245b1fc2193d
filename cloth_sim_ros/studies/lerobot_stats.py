# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of a dataset's features for LeRobot's normalisation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

#: Quantiles by name in the format.
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Statistics = dict[str, NDArray[np.float64]]


def statistics(values: NDArray[np.generic]) -> Statistics:
    """Return min, max, mean, std, count and quantiles by name, arrays (width,), of a feature over an episode.

    Args:
        values: shape (T, width) or (T,).

    Returns:
        Arrays of shape (width,); `count` is the number of frames, shape (1,).
    """
    wide = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
    summary = {"min": wide.min(axis=0), "max": wide.max(axis=0), "mean": wide.mean(axis=0), "std": wide.std(axis=0)}
    summary["count"] = np.array([len(wide)])
    quantiles = np.quantile(wide, list(QUANTILES.values()), axis=0)
    return summary | dict(zip(QUANTILES, quantiles, strict=True))


def aggregate(episodes: Sequence[dict[str, Statistics]]) -> dict[str, Statistics]:
    """Pool the statistics of episodes into those of the dataset, by feature.

    Quantiles are means over the episodes, weighted by their frames, as in LeRobot. All others are exact.
    """
    total: dict[str, Statistics] = {}
    for name in episodes[0]:
        stacked = {key: np.array([episode[name][key] for episode in episodes]) for key in episodes[0][name]}
        frames = stacked["count"].sum()
        weights = (stacked["count"] / frames).reshape(-1, *(1,) * (stacked["mean"].ndim - 1))
        mean = (stacked["mean"] * weights).sum(axis=0)
        variance = ((stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2) * weights).sum(axis=0)
        total[name] = {
            "min": stacked["min"].min(axis=0),
            "max": stacked["max"].max(axis=0),
            "mean": mean,
            "std": np.sqrt(variance),
            "count": np.array([frames]),
            **{key: (stacked[key] * weights).sum(axis=0) for key in QUANTILES},
        }
    return total
