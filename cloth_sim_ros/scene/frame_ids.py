# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of the names of coordinate frames by the rules of tf2.

Parameters of a live node are checked. A `Scene` is not, because it may come from an older session with another name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any


def fault(frame_id: str) -> str:
    """Return the fault of a frame_id and its remedy as the end of a sentence; an empty text if the frame_id is valid.

    Args:
        frame_id: the name, not empty.
    """
    plain = "".join(letter for letter in frame_id if letter.isprintable()).strip().lstrip("/").strip()
    remedy = f"write '{plain}'" if plain else "write a name, e.g. 'world'"
    if frame_id.startswith("/"):
        return f"tf2 takes no name that begins with '/': {remedy}"
    if not frame_id.isprintable():
        return f"a frame's name has no control characters: {remedy}"
    if frame_id != frame_id.strip():
        return f"a frame's name has no blanks around it: {remedy}"
    return ""


def faults(values: Mapping[str, Any]) -> Iterable[str]:
    """Yield a sentence for each parameter by full name whose value is an invalid name of a frame.

    Args:
        values: parameters by full name; parameters without a frame's name are ignored.
    """
    for name, value in values.items():
        is_frame = name == "frame_id" or name.endswith((".frame", ".sensor_frame"))
        if is_frame and isinstance(value, str) and value and (words := fault(value)):
            yield f"{name} is {value!r}; {words}"
