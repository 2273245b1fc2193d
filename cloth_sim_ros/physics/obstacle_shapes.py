# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The shapes of obstacles by name; on a page of its own, for who declares parameters and needs no obstacle."""

from __future__ import annotations

#: Shapes, and what their sizes are called, in order.
SHAPES: dict[str, tuple[str, ...]] = {
    "plane": (),
    "box": ("x", "y", "z"),
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
    "cylinder": ("radius", "length"),
    "mesh": (),
}
#: Most that a size, or a coordinate of a mesh, may be [m].
MOST_SIZE = 1e4
