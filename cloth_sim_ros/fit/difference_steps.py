# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Difference steps of successive linearizations, so that their short waves are independent."""

from __future__ import annotations

import attrs
import numpy as np

from cloth_sim_ros.fit.joint import Derivatives
from cloth_sim_ros.physics.model.forces.force import Array

#: Limits of the difference steps of a logarithm.
MIN_STEP, MAX_STEP = 0.02, 0.1
#: Share of short waves in the differences above which a step is doubled, and its limit.
_MAX_ROUGHNESS, ROUGH_STEP = 0.1, 0.4
#: Ratio of the steps of two linearizations below which they are alike (logarithm), and reduction of such steps.
_OTHER_STEP, _SHORTER = 0.25, 0.7


@attrs.frozen(kw_only=True, eq=False)
class DifferenceSteps:
    """Difference steps of the parameters' logarithms for a linearization; `next_steps` returns those of the next."""

    #: Shape (p,).
    steps: Array
    #: Steps that average over short waves do not become shorter again, shape (p,).
    min_steps: Array
    #: True if short waves made a step longer.
    is_rough: bool

    @classmethod
    def initial(cls, p: int) -> DifferenceSteps:
        """Return the steps of the first linearization by p parameters."""
        return cls(steps=np.full(p, MAX_STEP), min_steps=np.zeros(p), is_rough=False)

    def next_steps(self, derivatives: Derivatives, sigmas: Array) -> DifferenceSteps:
        """Return the steps for the next linearization, from the result of the last one.

        Short waves of two linearizations are independent if their steps differ.

        Args:
            derivatives: result of the linearization.
            sigmas: standard deviations of the logarithms, shape (p,).
        """
        used = derivatives.steps
        is_rough = (roughness(derivatives) > _MAX_ROUGHNESS) & (used < ROUGH_STEP)
        min_steps = np.where(is_rough, np.minimum(2.0 * used, ROUGH_STEP), self.min_steps)
        steps = np.maximum(step_bounds(sigmas), min_steps)
        steps = np.where(np.abs(np.log(steps / used)) < _OTHER_STEP, _SHORTER * used, steps)
        return DifferenceSteps(steps=steps, min_steps=min_steps, is_rough=bool(is_rough.any()))


def step_bounds(sigmas: Array) -> Array:
    """Return standard deviations of logarithms, clipped to the limits of difference steps (0.02 to 0.1), shape (p,)."""
    return np.clip(sigmas, MIN_STEP, MAX_STEP)


def roughness(derivatives: Derivatives) -> Array:
    """Return the fraction of short waves in each parameter's difference quotients, from 0 to 1, shape (p,).

    Folds that come and go change the residuals by amounts that do not grow with the difference step. If these are alike
    at three points, the square sum of the second difference is three times that of the central one.
    """
    shares = []
    for i, step in enumerate(derivatives.steps):
        second = sum(float(np.square(2.0 * c).sum()) for row in derivatives.curvatures for c in row[i])
        first = sum(float(np.square(2.0 * step * s).sum()) for row in derivatives.slopes for s in row[i])
        shares.append(min(second / (3.0 * first), 1.0) if first > 0.0 else 0.0)
    return np.array(shares)
