# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of coordinate frames, as tf2 takes them.

A live node and its parameter files are checked, a `Scene` is not: it may be that of an older session with another name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any


def fault(frame_id: str) -> str:
    """Return what is wrong with the name of a frame and what to write, as the end of a sentence; empty if nothing is.

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
    """Yield a sentence for each parameter that names a frame as tf2 does not take it.

    Args:
        values: parameters by full name; those that name no frame are passed over.
    """
    for name, value in values.items():
        is_frame = name == "frame_id" or name.endswith(".frame")
        if is_frame and isinstance(value, str) and value and (words := fault(value)):
            yield f"{name} is {value!r}; {words}"
