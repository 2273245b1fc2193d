# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reference page of the parameters, in Markdown, from their declarations.

`python -m cloth_sim_ros.scene.parameter_page` prints it.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from typing import Any

from cloth_sim_ros.scene.parameters.declare import Parameter
from cloth_sim_ros.scene.scene import Scene

_HEAD = """# Parameters

Every parameter of the node `cloth_sim`, made from the code that declares them. `ros2 param describe /cloth_sim <name>`
prints the same of a running node. Units are SI. A parameter marked *live* may change while the cloth runs and takes
effect with the next frame; any other is read-only after start. A value of the wrong type, outside its range, or that
makes no cloth is refused with the reason, both at start and by `ros2 param set`.

The same names stand in [parameter files](../node/parameters.md#parameter-files) and in `Scene.from_parameters`.
"""

_TAIL = """## Of ROS itself

`use_sim_time`: time is that of `/clock`; set at start ([simulated time](../node/time.md#simulated-time)).

`qos_overrides.<topic>.publisher.<policy>` and `qos_overrides.<topic>.subscription.<policy>`: `reliability`,
`durability`, `history` or `depth` of one topic; set at start ([quality of
service](../node/topics.md#quality-of-service)).
"""

#: Stands for the name of an obstacle.
OBSTACLE = "<obstacle>"
#: Stands for the name of a camera.
CAMERA = "<camera>"
#: Names with a placeholder, topics, options and the empty list. Markdown would take a placeholder as a tag of HTML.
_LITERAL = re.compile(r"[~/\w.]*<\w+>(?:[./=]?[\w<>]+)*|~/\w+|--\w+|\[''\]")
#: Headings of the groups, in the order of the page; "" is the group of names without one.
_GROUPS = {
    "": "Node and time stepping",
    "cloth": "Cloth",
    "material": "Material",
    "bending": "Bending",
    "air": "Air",
    "wind": "Wind",
    "gripper": "Grippers",
    "contact": "Contact with obstacles and of the cloth with itself",
    OBSTACLE: "Each obstacle, under its own name",
    CAMERA: "Each depth camera, under its own name",
    "points": "Point cloud",
    "record": "Recording",
    "diagnostics": "Diagnostics",
}


def page() -> str:
    """Return the reference page of all parameters in Markdown, from their declarations."""
    declared = Scene.declared([OBSTACLE], cameras=[CAMERA])
    groups = dict.fromkeys([*_GROUPS, *(_group(entry) for entry in declared)])
    parts = [_HEAD]
    for group in groups:
        members = [entry for entry in declared if _group(entry) == group]
        parts.append(f"## {_GROUPS.get(group, group.capitalize())}\n\n{_table(members)}")
    return "\n".join([*parts, _TAIL])


def _group(entry: Parameter) -> str:
    return entry.name.partition(".")[0] if "." in entry.name else ""


def _table(entries: Iterable[Parameter]) -> str:
    lines = ["| name | type | unit | default | range | live | |", "|---|---|---|---|---|---|---|"]
    for entry in entries:
        cells = [f"`{entry.name}`", entry.kind, entry.unit, _value(entry.default), _range(entry)]
        cells += ["live" if entry.live else "", _LITERAL.sub(r"`\g<0>`", entry.description)]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    """Return a parameter's value in Markdown, written as in a parameter file."""
    if isinstance(value, tuple):
        return f"`[{', '.join(_bare(entry) for entry in value)}]`"
    return f"`{_bare(value)}`"


def _bare(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    # A double keeps its point or exponent, because ROS would read it as an integer otherwise.
    return repr(value)


def _range(entry: Parameter) -> str:
    parts = []
    if entry.choices:
        parts.append(", ".join(f"`{choice}`" for choice in entry.choices))
    if entry.length is not None:
        parts.append(f"{entry.length} entries")
    if entry.min is not None and entry.max is not None:
        bound = "above " if entry.excludes_min else ""
        parts.append(f"{bound}{_bare(entry.min)} to {_bare(entry.max)}")
    if entry.constraint:
        parts.append(entry.constraint)
    return "; ".join(parts)


if __name__ == "__main__":
    sys.stdout.write(page())
