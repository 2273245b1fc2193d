# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of a single gripper, which override those of the section `gripper`.

An example is `<gripper>.frame`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import attrs

from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.parameters import declare as parameters
from cloth_sim_ros.scene.parameters.declare import NAME, Parameter, ParameterError

#: Last parts of the names of these parameters.
LEAVES = ("mode", "model", "frame", "max_speed", "action", "joint_range")
_SECTION_PREFIX = "gripper."


def declaration(name: str) -> Parameter:
    """Return the declaration of one gripper's parameter, e.g. `left.frame`, derived from that of `gripper.frame`."""
    leaf = name.rpartition(".")[2]
    common = next(
        entry
        for entry in parameters.declarations(sections.GripperParameters, _SECTION_PREFIX)
        if entry.name == f"{_SECTION_PREFIX}{leaf}"
    )
    return attrs.evolve(common, name=name, description=f"Overrides {_SECTION_PREFIX}{leaf} for this gripper")


def individual_names(names: Iterable[str], groups: Collection[str], described: Collection[str]) -> list[str]:
    """Return those of the full names that are parameters of a single gripper, in their order.

    Args:
        names: full names.
        groups: first parts of the names of all other parameters.
        described: names of obstacles, which have a parameter `frame` too.
    """
    split = [(name, *name.rpartition(".")[::2]) for name in names]
    return [
        name
        for name, gripper, leaf in split
        if leaf in LEAVES
        and NAME.fullmatch(gripper)
        and gripper not in groups
        and not (leaf == "frame" and gripper in described)
    ]


def check_grippers(names: Iterable[str], grippers: Sequence[str]) -> None:
    """Raise ParameterError for a parameter of a single gripper, such as `left.frame`, whose gripper does not exist.

    Args:
        names: full names of parameters of single grippers.
        grippers: names of the grippers.

    Raises:
        ParameterError: naming the parameter.
    """
    for name in names:
        gripper = name.rpartition(".")[0]
        if gripper not in grippers:
            raise ParameterError(
                f"{name} is set, and there is no gripper '{gripper}'; there are {', '.join(grippers) or 'none'}"
            )


def value(values: Mapping[str, Any], section: sections.GripperParameters, gripper: str, leaf: str) -> Any:
    """Return a parameter's value for a gripper: its own in `values` if set, otherwise that of the section `gripper`.

    Args:
        values: parameters of single grippers by full name.
        section: values for grippers without their own.
        gripper: name of the gripper.
        leaf: last part of the parameter's name, one of `LEAVES`.
    """
    return values[full_name] if (full_name := f"{gripper}.{leaf}") in values else getattr(section, leaf)
