# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reduced thickness of contacts that an event finds compressed, and how they regain it (docs/contact.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.physics.forces.force import Array

#: Speeds at which contacts regain their thickness [m/s], with obstacles and of the cloth with itself. A surface that
#: begins to move at a speed u throws a mass at no more than 2 u. Each layer of a stack adds to that of the one below.
RECOVERY_SPEED, LAYER_RECOVERY_SPEED = 0.01, 0.005
#: Gap over thickness above which an event leaves a contact as it is. It holds the energy of 0.05 m/s there; under its
#: own weight a cloth rests at 0.98.
REST_GAP = 0.96
#: Gap over the reduced thickness with which contacts go on: there they hold the energy of 0.014 m/s.
START_GAP = 0.98
#: Push on a mass [m/s^2] from which on a contact does not regain more: the cloth has to follow first. The lowest of
#: twenty layers bears as much.
MAX_PUSH = 200.0
#: U of the law [m/s], see engine/contact_law.hpp.
_SPEED = 35.0
#: Least gap over thickness that a start or a parameter may leave.
MIN_GAP = 0.02


def reduced_thickness(gaps: Array, thickness: float) -> Array | None:
    """Return the thickness [m] with which contacts go on after an event: that of the start gap if they hold more energy
    than at the rest gap, else the whole one. None if all have the whole one.

    Args:
        gaps: of each contact [m], see `Touching.gap_rows`.
        thickness: the whole one [m].
    """
    compressed = gaps < REST_GAP * thickness
    return np.where(compressed, np.maximum(gaps, 0.0) / START_GAP, thickness) if compressed.any() else None


def regained(reduced: Array, gaps: Array, thickness: float, duration: float) -> Array | None:
    """Return the thickness [m] of contacts a duration [s] later; None if none grows.

    Args:
        reduced: their thickness [m].
        gaps: of each contact [m], see `Touching.gap_rows`.
        thickness: the whole one [m].
        duration: in which they grow at the recovery speed, where the cloth has followed so far [s].
    """
    s = np.clip(gaps / reduced, 1e-3, 1.0)
    steep = (1.0 - s) * (1.0 - s) * (1.0 - s) * (1.0 + 3.0 * s) / (s * s)
    push = (0.5 * _SPEED * _SPEED / (thickness * thickness)) * reduced * steep
    followed = (push <= MAX_PUSH) & (reduced < thickness)
    if not followed.any():
        return None
    return np.where(followed, np.minimum(reduced + duration * _speeds(reduced), thickness), reduced)


def recovery_time(reduced: Array, thickness: float) -> float:
    """Return how long contacts take until all have regained the whole thickness [s], if the cloth can follow."""
    return float(((thickness - reduced) / _speeds(reduced)).max())


def _speeds(reduced: Array) -> Array:
    """Recovery speeds of the rows of contacts [m/s], shape (rows, 1)."""
    speeds = np.full((len(reduced), 1), RECOVERY_SPEED)
    speeds[-1] = LAYER_RECOVERY_SPEED
    return speeds


def relative_growth(reduced: Array, after: Array) -> float:
    """Return the largest growth of a thickness, relative to that thickness."""
    return float((after / reduced).max()) - 1.0


def check_gaps(gaps: Array, thickness: float, names: Sequence[str]) -> None:
    """Refuse contacts that are too narrow for any thickness.

    Args:
        gaps: of each contact [m], see `Touching.gap_rows`.
        thickness: the whole one [m].
        names: of obstacles, pads included.

    Raises:
        ValueError: naming the obstacle, the gap, the limit and the remedy; the end of a sentence about the cloth.
    """
    least = MIN_GAP * thickness
    for name, row in zip((*names, ""), gaps, strict=True):
        gap = float(row.min())
        if gap >= least:
            continue
        where = f"obstacle '{name}'" if name else "itself"
        count = int(np.count_nonzero(row[:-1] < least))
        particles = f" at particle {int(np.argmin(row[:-1]))}" if count else ""
        particles += f" and {count - 1} more" if count > 1 else ""
        raise ValueError(
            f"is {gap:.3g} m from {where}{particles}; it must be {least:.3g} m at least, {MIN_GAP:g} of "
            f"contact.thickness: move them {thickness - gap:.3g} m apart"
        )
