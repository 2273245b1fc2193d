# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Words of the gripper client on what was held."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cloth_sim_ros.session.words import counted

if TYPE_CHECKING:
    from cloth_sim_ros.ros.gripper_hand import Hold


def describe_holds(holds: Sequence[Hold]) -> str:
    """Return in words what was held, one grasp after the other."""
    if not holds:
        return "the script closes nothing"
    return "; ".join(_in_words(hold) for hold in holds)


def _in_words(hold: Hold) -> str:
    if hold.held is None:
        return f"what it held is not known: {hold.words}"
    return f"held {counted(hold.held, 'particle')}" if hold.held else "held nothing (the node's log says why)"
