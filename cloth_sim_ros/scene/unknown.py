# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Words on parameters that nothing looks at: a typing error in a parameter file is easily overlooked."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable

#: What rclpy declares by itself.
FOREIGN = ("use_sim_time", "start_type_description_service")
#: Begin the names of quality of service profiles.
PROFILES = "qos_overrides."


def suggestion(name: str, known: Collection[str]) -> str:
    """Return the end of a sentence that names the nearest name that there is, if one is near."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def unknown(names: Iterable[str], known: Collection[str]) -> list[str]:
    """Return a sentence for each name that is not known, and is none of rclpy's or of a profile's."""
    return [
        f"there is no parameter '{name}', what sets it has no effect{suggestion(name, known)}"
        for name in names
        if name not in known and name not in FOREIGN and not name.startswith(PROFILES)
    ]
