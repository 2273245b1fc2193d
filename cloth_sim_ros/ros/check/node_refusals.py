# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node's checks of a parameter file, without ROS."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from cloth_sim_ros.ros.io import qos_rules
from cloth_sim_ros.scene import files, frame_ids
from cloth_sim_ros.scene.parameters.declare import Faults, ParameterError
from cloth_sim_ros.scene.scene import Scene

_SIM_TIME = "use_sim_time"
#: Longest full name of a topic in ROS 2 (rmw's RMW_TOPIC_MAX_NAME_LENGTH).
MAX_TOPIC_LENGTH = 247
#: The longest topic names below that of a gripper or obstacle: of all, of a sensor, of an action; and of a camera.
_LONGEST_LEAF, _SENSOR_LEAF, _ACTION_LEAF = "/wrench", "/ft_sensor_wrench", "/gripper_cmd/_action/cancel_goalRequest"
_LONGEST_CAMERA_LEAF = f"/{qos_rules.DEPTH}"


def refuse_values(values: Mapping[str, Any]) -> None:
    """Raise one ParameterError that names all invalid values of parameters, before a scene is built from them.

    Raises:
        ParameterError: names each fault.
    """
    empty = [name for name, value in values.items() if value == [] and isinstance(value, list)]
    refused = Faults()
    refused.add(empty_lists(empty, values))
    follows = values.get(_SIM_TIME, False)
    if not isinstance(follows, bool) and _SIM_TIME not in empty:
        refused.add([f"{_SIM_TIME} is {follows!r}; it must be true or false, without quotes"])
    check_values(values, refused, empty)
    refused.refuse()


def empty_lists(empty: Iterable[str], values: Iterable[str]) -> Iterator[str]:
    """Yield an error sentence with the remedy for each parameter that is set to [], whose type ROS can't infer."""
    kinds = {entry.name: entry.kind for entry in Scene.declared_for(values)} | {_SIM_TIME: "bool"}
    for name in empty:
        remedy = f"it must be {kinds[name]}" if name in kinds else "leave it out"
        if kinds.get(name) == "string[]":
            remedy = "for none write ['']"
        yield f"{name} is an empty list, [], whose type ROS can't know; {remedy}"


def check_values(
    values: Mapping[str, Any], refused: Faults, empty: Collection[str] = (), convert: Callable[[Any], Any] | None = None
) -> dict[str, Any]:
    """Return the scene's parameters among `values`, converted, by name; add faults to `refused` instead of raising.

    Args:
        values: parameters by full name.
        refused: receives the faults.
        empty: names of parameters of the scene that are not checked.
        convert: converts each value before its check; None for none.
    """
    checked: dict[str, Any] = {}
    for entry in Scene.declared_for(values):
        if entry.name in values and entry.name not in empty:
            raw = values[entry.name]
            checked[entry.name] = refused.collect(partial(entry.check, raw if convert is None else convert(raw)))
    if values.get(_SIM_TIME) is True and checked.get("publish_clock"):
        refused.add(
            [f"{_SIM_TIME} and publish_clock are true: a node can't follow the /clock that it publishes; set one"]
        )
    refused.add(frame_ids.faults(values))
    refused.add(qos_rules.faults(values))
    return checked


def refuse_scene(scene: Scene, *, node: str) -> None:
    """Raise ParameterError for a scene with names too long for topics, or a recording folder that can't be written.

    Raises:
        ParameterError: names the parameter or the folder.
    """
    refuse_long_names(scene, node=node)
    if scene.record.enabled:
        _refuse_folder(Path(scene.record.folder).expanduser())


def refuse_long_names(scene: Scene, *, node: str) -> None:
    """Raise ParameterError for a scene with a name that is too long for the topics below a node's full name.

    Raises:
        ParameterError: names the parameter.
    """
    gripper_leaf = _SENSOR_LEAF if scene.gripper.sensor_frame else _LONGEST_LEAF
    for kind, names, leaf in (
        ("gripper", scene.gripper_names, _ACTION_LEAF if scene.has_actions else gripper_leaf),
        ("obstacle", [*scene.obstacle_names, *scene.described], _LONGEST_LEAF),
        ("camera", scene.camera_names, _LONGEST_CAMERA_LEAF),
    ):
        max_length = MAX_TOPIC_LENGTH - len(f"/{node.strip('/')}/{leaf}")
        for name in names:
            if len(name) > max_length:
                raise ParameterError(
                    f"{kind} name '{name[:20]}...' has {len(name)} letters; the topics of /{node.strip('/')} leave "
                    f"room for {max_length}: shorten it"
                )


def _refuse_folder(folder: Path) -> None:
    """Raise ParameterError if a recording folder can't be created or written; create nothing."""
    try:
        existing = next(candidate for candidate in (folder, *folder.absolute().parents) if candidate.exists())
    except (OSError, ValueError) as error:
        raise ParameterError(f"cannot record into {str(folder)!r}: {error}; set record.folder") from error
    if not existing.is_dir():
        raise ParameterError(f"cannot record into {folder}: it is, or lies under, a file; set record.folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise ParameterError(f"cannot write into {existing}: permission denied; set record.folder")


def hint_at_folder(error: str, values: Mapping[str, Any], path: str | Path) -> str:
    """Return a hint on the working directory if an error names a missing relative file; otherwise an empty text."""
    for parameter, value in values.items():
        is_file = parameter in (*files.FILE_PARAMETERS, "robot.description_file") or parameter.endswith(".mesh")
        is_file = is_file or (parameter == files.FABRIC and files.is_fabric_file(str(value)))
        named = is_file and isinstance(value, str) and value
        if not named or os.path.isabs(value) or f"'{value}'" not in error:
            continue
        name = value.rpartition("@")[0] if ".mcap@" in value else value
        if os.path.exists(name):
            continue
        start = f"; the node resolves relative names in its working directory, {Path.cwd()}"
        file_folder = Path(path).absolute().parent
        if os.path.exists(file_folder / name):
            return f"{start}: start it in {file_folder}, or give {parameter} as {file_folder / value}"
        return f"{start}: give the whole path"
    return ""
