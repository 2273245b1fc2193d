# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Words on parameters that nothing looks at: a typing error in a parameter file is easily overlooked."""

from __future__ import annotations

import difflib
from collections.abc import Collection

#: What rclpy declares by itself.
FOREIGN = ("use_sim_time", "start_type_description_service")
#: Begin the names of quality of service profiles.
PROFILES = "qos_overrides."


def is_of_ros(name: str) -> bool:
    """Return True for a parameter of ROS itself, which is none of a scene."""
    return name in FOREIGN or name.startswith(PROFILES)


def suggestion(name: str, known: Collection[str]) -> str:
    """Return the end of a sentence that names the nearest name that there is, if one is near."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""
