# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of obstacle shapes and of their sizes.

The module has no imports: parameter declarations need it without the obstacles.
"""

from __future__ import annotations

#: Shapes and the names of their sizes, in order.
SHAPES: dict[str, tuple[str, ...]] = {
    "plane": (),
    "box": ("x", "y", "z"),
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
    "cylinder": ("radius", "length"),
    "mesh": (),
}
#: Largest size, or coordinate of a mesh [m].
MAX_SIZE = 1e4
