# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reduced contact thickness after events, and its recovery (docs/derivations/contact_thickness.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array

#: Speeds of recovery of the thickness [m/s], of contacts with obstacles and of the cloth with itself. A surface that
#: starts to move at a speed u throws a mass at no more than 2 u. Each layer of a stack adds to the speed of the one
#: below.
RECOVERY_SPEED, LAYER_RECOVERY_SPEED = 0.01, 0.005
#: Gap over thickness above which an event leaves a contact as it is. The contact holds the energy of 0.05 m/s there. A
#: cloth under its own weight rests at 0.98.
REST_GAP = 0.96
#: Gap over the reduced thickness after an event. A contact holds the energy of 0.014 m/s there.
START_GAP = 0.98
#: Contact acceleration [m/s^2] above which the thickness does not grow: the cloth has to follow first. The lowest of
#: twenty layers bears as much.
MAX_PUSH = 200.0
#: Speed U of the contact law [m/s], see engine/laws/contact.hpp.
_SPEED = 35.0
#: Least gap over thickness of a start or after a change of parameters.
MIN_GAP = 0.02


def reduced_thickness(gaps: Array, thickness: float) -> Array | None:
    """Return each contact's thickness [m], reduced if its gap is below the rest gap; None if all are full.

    A contact with a gap below the rest gap gets the thickness for which its gap is the start gap.

    Args:
        gaps: gap of each contact [m], see `ContactBinding.contact_gaps`.
        thickness: full thickness [m].
    """
    compressed = gaps < REST_GAP * thickness
    return np.where(compressed, np.maximum(gaps, 0.0) / START_GAP, thickness) if compressed.any() else None


def grown_thickness(reduced: Array, gaps: Array, thickness: float, duration: float) -> Array | None:
    """Return the thickness [m] of each contact, grown for a duration [s] if the cloth follows; None if none grows.

    Args:
        reduced: present thickness of each contact [m].
        gaps: gap of each contact [m], see `ContactBinding.contact_gaps`.
        thickness: full thickness [m].
        duration: time of growth at the recovery speed [s]; only contacts grow that the cloth has followed so far.
    """
    s = np.clip(gaps / reduced, 1e-3, 1.0)
    slope = (1.0 - s) * (1.0 - s) * (1.0 - s) * (1.0 + 3.0 * s) / (s * s)
    push = (0.5 * _SPEED * _SPEED / (thickness * thickness)) * reduced * slope
    is_followed = (push <= MAX_PUSH) & (reduced < thickness)
    if not is_followed.any():
        return None
    return np.where(is_followed, np.minimum(reduced + duration * _recovery_speeds(reduced), thickness), reduced)


def recovery_time(reduced: Array, thickness: float) -> float:
    """Return the time [s] until reduced contacts have the full thickness, if the cloth can follow."""
    return float(((thickness - reduced) / _recovery_speeds(reduced)).max())


def _recovery_speeds(reduced: Array) -> Array:
    """Return the speed [m/s] at which the thickness of each row of contacts grows, shape (rows, 1)."""
    speeds = np.full((len(reduced), 1), RECOVERY_SPEED)
    speeds[-1] = LAYER_RECOVERY_SPEED
    return speeds


def relative_growth(reduced: Array, after: Array) -> float:
    """Return the largest growth of a contact's thickness relative to its value before, after / reduced - 1."""
    return float((after / reduced).max()) - 1.0


def check_gaps(gaps: Array, thickness: float, names: Sequence[str]) -> None:
    """Raise ValueError if a contact's gap is below the least gap, a fraction of the full thickness.

    Args:
        gaps: gap of each contact [m], see `ContactBinding.contact_gaps`.
        thickness: full thickness [m].
        names: names of obstacles, jaws included.

    Raises:
        ValueError: naming obstacle, gap, limit and remedy. The text is the end of a sentence about the cloth.
    """
    min_gap = MIN_GAP * thickness
    for name, row in zip((*names, ""), gaps, strict=True):
        gap = float(row.min())
        if gap >= min_gap:
            continue
        partner = f"obstacle '{name}'" if name else "itself"
        count = int(np.count_nonzero(row[:-1] < min_gap))
        particles = f" at particle {int(np.argmin(row[:-1]))}" if count else ""
        particles += f" and {count - 1} more" if count > 1 else ""
        raise ValueError(
            f"is {gap:.3g} m from {partner}{particles}; it must be {min_gap:.3g} m at least, {MIN_GAP:g} of "
            f"contact.thickness: move them {thickness - gap:.3g} m apart"
        )
