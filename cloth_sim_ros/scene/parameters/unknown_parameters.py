# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages on unknown parameters, which are often typing errors."""

from __future__ import annotations

import difflib
from collections.abc import Collection

#: Parameters that rclpy declares by itself.
ROS_PARAMETERS = ("use_sim_time", "start_type_description_service")
#: Prefix of the names of quality of service parameters.
QOS_PREFIX = "qos_overrides."


def is_ros_parameter(name: str) -> bool:
    """Return True for a parameter of ROS itself, which belongs to no scene."""
    return name in ROS_PARAMETERS or name.startswith(QOS_PREFIX)


def suggestion(name: str, known: Collection[str]) -> str:
    """Return the end of a sentence that suggests the most similar known name; empty if none is similar."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""
