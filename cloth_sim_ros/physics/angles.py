# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sine, cosine and arctangent by arithmetic alone: libraries' own differ in the last bit from machine to machine."""

from __future__ import annotations

import math

#: Terms of the series that meet rounding: of sine and cosine up to pi, of the arctangent up to tan(pi / 32).
_TERMS, _ARCTANGENT_TERMS = 16, 12
PI = 3.141592653589793


def sine_and_cosine(angle: float) -> tuple[float, float]:
    """Return sine and cosine of an angle between -pi and pi [rad], to a few roundings, by their power series."""
    square, sine, cosine = angle * angle, 1.0, 1.0
    for k in range(_TERMS, 0, -1):
        cosine = 1.0 - square / ((2.0 * k - 1.0) * (2.0 * k)) * cosine
        sine = 1.0 - square / (2.0 * k * (2.0 * k + 1.0)) * sine
    return angle * sine, cosine


def arctangent(y: float, x: float) -> float:
    """Return the angle [rad] of the point (x, y), x at least 0 and not both 0, to a few roundings.

    Three times atan(t) = 2 atan(t / (1 + sqrt(1 + t^2))), then the power series.
    """
    swapped = abs(y) > x
    t, doubled = (x / y if swapped else y / x), 1.0
    for _ in range(3):
        t, doubled = t / (1.0 + math.sqrt(1.0 + t * t)), 2.0 * doubled
    square, total = t * t, 0.0
    for k in range(_ARCTANGENT_TERMS, 0, -1):
        total = square * (1.0 / (2.0 * k + 1.0) - total)
    angle = doubled * t * (1.0 - total)
    if not swapped:
        return angle
    return (0.5 * PI if y > 0.0 else -0.5 * PI) - angle
