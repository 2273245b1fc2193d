# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reduced thickness of contacts that an event finds compressed, and how they regain it (docs/contact.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.physics.forces.force import Array

#: Speed at which a contact regains its thickness [m/s]. A surface that begins to move at a speed u throws a mass at no
#: more than 2 u, and each of a stack's layers adds u.
RECOVERY_SPEED = 0.02
#: Gap over thickness above which an event leaves a contact as it is. It holds the energy of 0.05 m/s there; under its
#: own weight a cloth rests at 0.98.
REST_GAP = 0.96
#: Gap over the reduced thickness with which contacts go on: there they hold the energy of 0.014 m/s.
START_GAP = 0.98
#: Least gap over thickness that a start or a parameter may leave.
LEAST_GAP = 0.02


def reduced_thickness(gaps: Array, thickness: float) -> Array | None:
    """Return the thickness [m] with which contacts go on after an event: that of the start gap if they hold more energy
    than at the rest gap, else the whole one. None if all have the whole one.

    Args:
        gaps: of each contact [m], see `Touching.gap_rows`.
        thickness: the whole one [m].
    """
    compressed = gaps < REST_GAP * thickness
    return np.where(compressed, np.maximum(gaps, 0.0) / START_GAP, thickness) if compressed.any() else None


def regained(reduced: Array, thickness: float, duration: float) -> Array | None:
    """Return the thickness of contacts a duration [s] later; None where all have regained the whole one [m]."""
    after = np.minimum(reduced + RECOVERY_SPEED * duration, thickness)
    return after if (after < thickness).any() else None


def recovery_time(reduced: Array, thickness: float) -> float:
    """Return how long contacts take until all have regained the whole thickness [s]."""
    return (thickness - float(reduced.min())) / RECOVERY_SPEED


def relative_growth(reduced: Array, thickness: float, duration: float) -> float:
    """Return the largest growth of a thickness over a duration [s], relative to that thickness."""
    least = float(reduced.min())
    return min(RECOVERY_SPEED * duration, thickness - least) / least


def check_gaps(gaps: Array, thickness: float, names: Sequence[str]) -> None:
    """Refuse contacts that are too narrow for any thickness.

    Args:
        gaps: of each contact [m], see `Touching.gap_rows`.
        thickness: the whole one [m].
        names: of obstacles, pads included.

    Raises:
        ValueError: naming the obstacle, the gap, the limit and the remedy; the end of a sentence about the cloth.
    """
    least = LEAST_GAP * thickness
    for name, row in zip((*names, ""), gaps, strict=True):
        gap = float(row.min())
        if gap >= least:
            continue
        where = f"obstacle '{name}'" if name else "itself"
        count = int(np.count_nonzero(row[:-1] < least))
        particles = f" at particle {int(np.argmin(row[:-1]))}" if count else ""
        particles += f" and {count - 1} more" if count > 1 else ""
        raise ValueError(
            f"is {gap:.3g} m from {where}{particles}; it must be {least:.3g} m at least, {LEAST_GAP:g} of "
            f"contact.thickness: move them {thickness - gap:.3g} m apart"
        )
