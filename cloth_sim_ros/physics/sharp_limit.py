# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The leapfrog's step limit at one state, sharper than particle blocks tell it, for fixed steps close to it.

The leapfrog is stable while the largest eigenvalue of M^-1 (h^2/4 K + h/2 D) is below 1. Blocks bound stiffness and
damping one by one, as if the same motion had the most of both and moved every spring's ends oppositely: 8 to 14 % too
small a limit on a stretched sheet. Here the eigenvalue is found by Lanczos' method, from below to about a hundredth.
"""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.terms.base import Array

#: Force derivatives that one eigenvalue takes.
_ITERATIONS = 40
#: Corrections of the step.
_CORRECTIONS = 3
#: What is left of the limit found, for what the eigenvalue lacks.
_MARGIN = 0.98


def sharp_step_limit(dynamics: Dynamics, t: float, x: Array, below: float) -> float:
    """Return the largest stable step of the leapfrog about a state [s], at least ``below``.

    Args:
        dynamics: equations of motion.
        t: time [s].
        x: positions (3, n) [m].
        below: a step that is known to be stable [s].
    """
    if not (math.isfinite(below) and np.isfinite(x).all()):
        return below
    step = below
    for _ in range(_CORRECTIONS):
        stiff, damped = _largest(dynamics, t, x, step)
        # With that motion's shares of stiffness and damping: stiff (h / step)^2 + damped h / step = 1.
        if not stiff + damped > 0.0:
            return below
        scale = 2.0 / (damped + math.sqrt(damped * damped + 4.0 * max(stiff, 0.0)))
        step *= scale
        if abs(scale - 1.0) < 1e-3:
            break
    return max(below, _MARGIN * step)


def _largest(dynamics: Dynamics, t: float, x: Array, step: float) -> tuple[float, float]:
    """The largest eigenvalue of M^-1 (h^2/4 K + h/2 D) in parts, that of the stiffness and that of the damping."""
    scale = np.sqrt(dynamics.model.inverse_masses)
    still = np.zeros_like(x)

    def product(u: Array, stiffness: float, damping: float) -> Array:
        out, moved = np.zeros_like(x), scale * u
        for term in dynamics.model.terms:
            term.add_jacobian_product(t, x, still, stiffness * moved, damping * moved, out)
        return np.asarray(-scale * out)

    # Any start serves that has a part of every motion; always the same one, so that a run can be repeated.
    u = np.random.default_rng(0).normal(size=x.shape) * (scale > 0.0)
    basis = [u / math.sqrt(float(np.sum(u * u)))]
    diagonal: list[float] = []
    beside: list[float] = []
    for _ in range(min(_ITERATIONS, x.size)):
        w = product(basis[-1], 0.25 * step * step, 0.5 * step)
        diagonal.append(float(np.sum(w * basis[-1])))
        # Against all of them: rounding would else bring back what was found.
        for known in basis:
            w -= float(np.sum(w * known)) * known
        size = math.sqrt(float(np.sum(w * w)))
        if size < 1e-12 * max(map(abs, diagonal)):
            break
        beside.append(size)
        basis.append(w / size)
    top, weights = _top(diagonal, beside[: len(diagonal) - 1])
    vector = sum((weight * known for weight, known in zip(weights, basis, strict=False)), np.zeros_like(x))
    vector /= math.sqrt(float(np.sum(vector * vector)))
    damped = float(np.sum(vector * product(vector, 0.0, 0.5 * step)))
    return top - damped, damped


def _top(diagonal: list[float], beside: list[float]) -> tuple[float, list[float]]:
    """Largest eigenvalue of a symmetric tridiagonal matrix, by bisection, and its vector, by its recurrence."""
    reach = [abs(a) + abs(b) for a, b in zip([0.0, *beside], [*beside, 0.0], strict=True)]
    low = max(diagonal)
    high = max(d + r for d, r in zip(diagonal, reach, strict=True))
    for _ in range(60):
        middle = 0.5 * (low + high)
        if _all_below(diagonal, beside, middle):
            high = middle
        else:
            low = middle
    vector = [1.0]
    for k, off in enumerate(beside):
        before = beside[k - 1] * vector[k - 1] if k else 0.0
        vector.append(((high - diagonal[k]) * vector[k] - before) / off)
        if abs(vector[-1]) > 1e100:
            # It is normed later; rounding drives it up where the last of many vectors hardly matter.
            vector = [1e-100 * weight for weight in vector]
    return high, vector


def _all_below(diagonal: list[float], beside: list[float], value: float) -> bool:
    """Whether every eigenvalue is below a value: no pivot of the elimination of T - value I is positive."""
    pivot = -1.0
    for k, entry in enumerate(diagonal):
        pivot = entry - value - (beside[k - 1] ** 2 / pivot if k else 0.0)
        if pivot >= 0.0:
            return False
    return True
