# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sine and cosine with the same bits on every machine.

They use additions, multiplications and divisions alone: mathematical libraries differ in the last bit between machines.
"""

from __future__ import annotations

#: Terms of the series that suffice for full precision up to pi.
_TERMS = 16


def sine_and_cosine(angle: float) -> tuple[float, float]:
    """Return sine and cosine of an angle from -pi to pi [rad], accurate to a few roundings, by their power series."""
    square, sine, cosine = angle * angle, 1.0, 1.0
    for k in range(_TERMS, 0, -1):
        cosine = 1.0 - square / ((2.0 * k - 1.0) * (2.0 * k)) * cosine
        sine = 1.0 - square / (2.0 * k * (2.0 * k + 1.0)) * sine
    return angle * sine, cosine
