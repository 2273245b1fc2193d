# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sampling of a study's factors: values for each run.

The client computes the values once and stores them in the study's folder.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.factors import Factor

#: Limit of the number of runs of a study.
MAX_RUNS = 10_000_000
#: Sampling methods.
SAMPLINGS = ("sobol", "latin_hypercube", "random", "grid")


def grid_size(factors: Sequence[Factor]) -> int:
    """Return the number of combinations of all values of the factors. Raises StudyError for a continuous one.

    Raises:
        StudyError: if a factor is continuous.
    """
    for factor in factors:
        if factor.count is None:
            remedy = "give a list, integers or steps, or sample by sobol, latin_hypercube or random"
            raise StudyError(f"sampling is grid, and '{factor.name}' varies continuously ({factor.kind}); {remedy}")
    return math.prod(factor.count or 1 for factor in factors)


def sample(factors: Sequence[Factor], *, runs: int, seed: int, sampling: str) -> list[tuple[Any, ...]]:
    """Return the tuple of factor values of each run, by a grid or by (quasi-)random samples.

    Args:
        factors: the factors.
        runs: number of runs.
        seed: seed of the random sequence.
        sampling: one of `SAMPLINGS`; in a grid the last factor varies fastest.
    """
    if not factors:
        return [()] * runs
    if sampling == "grid":
        shape = [factor.count or 1 for factor in factors]
        grid_indices = (np.unravel_index(k, shape) for k in range(runs))
        return [tuple(f.at(int(i)) for f, i in zip(factors, indices, strict=True)) for indices in grid_indices]
    unit_samples = _unit_samples(len(factors), runs, seed, sampling)
    columns = [[factor.value(float(quantile)) for quantile in unit_samples[:, k]] for k, factor in enumerate(factors)]
    return list(zip(*columns, strict=True))


def _unit_samples(dimensions: int, runs: int, seed: int, sampling: str) -> NDArray[np.float64]:
    """Return random, Latin hypercube or Sobol samples of the unit cube, shape (runs, dimensions)."""
    from scipy.stats import qmc

    generator = np.random.default_rng(seed)
    if sampling == "random":
        return generator.random((runs, dimensions))
    with warnings.catch_warnings():
        # scipy warns if the number of Sobol points is no power of two, and about the seed's old name, which its older
        # releases need.
        warnings.simplefilter("ignore")
        engine: Any = qmc.Sobol if sampling == "sobol" else qmc.LatinHypercube
        return np.asarray(engine(dimensions, seed=generator).random(runs))
