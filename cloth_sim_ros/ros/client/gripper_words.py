# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text of grasp reports for the gripper client."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cloth_sim_ros.session.plurals import pluralize

if TYPE_CHECKING:
    from cloth_sim_ros.ros.client.gripper_client import GraspReport


def describe_holds(holds: Sequence[GraspReport]) -> str:
    """Return the results of grasps as text, in order."""
    if not holds:
        return "the script closes nothing"
    return "; ".join(_describe_report(hold) for hold in holds)


def _describe_report(hold: GraspReport) -> str:
    if hold.held is None:
        return f"the result of a grasp is not known: {hold.text}"
    return f"held {pluralize(hold.held, 'particle')}" if hold.held else "held nothing (the node's log says why)"
