# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text of grasp reports for the gripper client."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cloth_sim_ros.session.words import counted

if TYPE_CHECKING:
    from cloth_sim_ros.ros.gripper_hand import Hold


def describe_holds(holds: Sequence[Hold]) -> str:
    """Return the results of grasps as text, in order."""
    if not holds:
        return "the script closes nothing"
    return "; ".join(_in_words(hold) for hold in holds)


def _in_words(hold: Hold) -> str:
    if hold.held is None:
        return f"the result of a grasp is not known: {hold.words}"
    return f"held {counted(hold.held, 'particle')}" if hold.held else "held nothing (the node's log says why)"
