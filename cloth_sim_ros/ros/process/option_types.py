# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Types of command-line options for argparse."""

from __future__ import annotations

import argparse
import math
import re

#: Full names of nodes in ROS: no part begins with a digit.
_NODE = re.compile(r"/?([A-Za-z_][A-Za-z0-9_]*/)*[A-Za-z_][A-Za-z0-9_]*")


def node_name(text: str) -> str:
    """Return the full name of a node; raise ArgumentTypeError for a text that is none."""
    if not _NODE.fullmatch(text):
        raise argparse.ArgumentTypeError(
            f"'{text}' is no name of a node; it is of letters, digits, _ and /, and no part begins with a digit"
        )
    return text


def waiting_time(text: str) -> float:
    """Return a time to wait [s]; raise ArgumentTypeError for one that is negative, infinite or no number."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 <= seconds < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is no time to wait; give a number of seconds, at least 0")
    return seconds
