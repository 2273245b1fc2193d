# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One cloth: `ros2 launch cloth_sim_ros cloth_sim.launch.py scene:=... params_file:=... namespace:=... name:=...`."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackagePrefix, FindPackageShare

_CONFIG = PathJoinSubstitution([FindPackageShare("cloth_sim_ros"), "config"])
#: Name, default, meaning and choices of each argument.
_ARGUMENTS: list[tuple[str, Any, str, list[str] | None]] = [
    (
        "scene",
        "cloth_sim",
        "scene of the package: a hung sheet, a flag in the wind, a towel that falls over a ball, a sheet over "
        "the edge of a box, a towel on a table, a sheet that a gripper pinches, by a service or as a robot's gripper, "
        "a towel that two grippers fold, three towels in a stack, a strip that two grippers twist, a sheet before a "
        "depth camera, a sheet beside an arm, a towel of uncertain parameters",
        [
            *("cloth_sim", "flag", "drape", "edge", "table", "pinch", "fold", "stack", "twist", "camera"),
            *("pinch_action", "robot_arm", "uncertain"),
        ],
    ),
    ("params_file", "", "ROS parameter file of the cloth, in place of a scene of the package", None),
    ("namespace", "", "namespace of the node", None),
    ("name", "cloth_sim", "name of the node", None),
    (
        "use_sim_time",
        "",
        "use the time of /clock (true, false); default: the value in the parameter file",
        ["", "true", "false", "True", "False"],
    ),
    ("log_level", "info", "minimum severity of logged messages", ["debug", "info", "warn", "error", "fatal"]),
    (
        "viewer",
        "none",
        "show the cloth in Rerun (needs cloth_sim_ros[replay]), Foxglove (needs foxglove_bridge) or RViz (needs rviz2)",
        ["none", "rerun", "foxglove", "rviz"],
    ),
    ("rviz", "false", "former name of viewer:=rviz", ["true", "false", "True", "False"]),
    ("rviz_config", PathJoinSubstitution([_CONFIG, "cloth_sim.rviz"]), "configuration of RViz", None),
]
#: Files of scenes, which a node gets by absolute path: parameter and name.
_FILES = {
    "stack": ("cloth.mesh", "stack.obj"),
    "robot_arm": ("robot.description_file", "arm.urdf"),
    "uncertain": ("ensemble.file", "uncertain.distribution.yaml"),
}
#: Topics of the RViz configuration, written for a node /cloth_sim with a gripper `gripper`.
_RVIZ_TOPICS = ("points", "mesh", "obstacles", "gripper/point")


def generate_launch_description() -> LaunchDescription:
    """Describe the node `cloth_sim` with its parameters, name, clock and log level, and a viewer on request."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=meaning, **({"choices": some} if some else {}))
        for name, default, meaning, some in _ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_actions)])


def _actions(context: LaunchContext) -> list[Any]:
    arguments = {name: LaunchConfiguration(name).perform(context) for name, *_ in _ARGUMENTS}
    params_file = Path(arguments["params_file"]).expanduser()
    if arguments["params_file"]:
        # launch_ros would start the node without the file's parameters.
        if not params_file.is_file():
            raise FileNotFoundError(f"params_file:={arguments['params_file']} is not a file ({params_file.absolute()})")
        arguments["params_file"] = str(params_file)
    clock = [{"use_sim_time": arguments["use_sim_time"].lower() == "true"}] if arguments["use_sim_time"] else []
    scene = [arguments["params_file"] or PathJoinSubstitution([_CONFIG, f"{arguments['scene']}.yaml"])]
    if not arguments["params_file"] and arguments["scene"] in _FILES:
        parameter, file = _FILES[arguments["scene"]]
        scene.append({parameter: PathJoinSubstitution([_CONFIG, file])})
    cloth = Node(
        package="cloth_sim_ros",
        executable="cloth_sim",
        name=arguments["name"],
        namespace=arguments["namespace"],
        parameters=[*scene, *clock],
        ros_arguments=["--log-level", arguments["log_level"]],
        output="screen",
        emulate_tty=True,
        # The node closes its recording within two seconds of a signal; leave it the time.
        sigterm_timeout="10",
        sigkill_timeout="10",
    )
    actions = [*_misspelt_arguments(context, list(arguments)), cloth]
    viewer = arguments["viewer"]
    if arguments["rviz"].lower() == "true":
        actions.append(LogInfo(msg="rviz:=true is the former name of viewer:=rviz, and works for one release"))
        viewer = "rviz" if viewer == "none" else viewer
    if viewer != "none":
        _check_viewer(context, viewer)
        full = "/".join(["", *arguments["namespace"].strip("/").split("/"), arguments["name"]]).replace("//", "/")
        actions += _VIEWERS[viewer](arguments, full, clock)
    return actions


def _rerun(arguments: dict[str, str], full: str, clock: list[Any]) -> list[Any]:
    return [
        Node(
            package="cloth_sim_ros",
            executable="cloth_viewer",
            name=f"{arguments['name']}_viewer",
            namespace=arguments["namespace"],
            arguments=["--node", full],
            output="screen",
            sigterm_timeout="10",
            sigkill_timeout="10",
        )
    ]


def _foxglove(arguments: dict[str, str], full: str, clock: list[Any]) -> list[Any]:
    layout = PathJoinSubstitution([_CONFIG, "cloth_sim.foxglove.json"])
    renamed = "" if full == "/cloth_sim" else f", with /cloth_sim replaced by {full},"
    return [
        LogInfo(msg=["Foxglove: open the connection ws://localhost:8765, and import the layout ", layout, renamed]),
        Node(
            package="foxglove_bridge",
            executable="foxglove_bridge",
            name=f"{arguments['name']}_bridge",
            namespace=arguments["namespace"],
            # By default the bridge serves every topic, to every machine.
            parameters=[
                *clock,
                {
                    "address": "127.0.0.1",
                    "topic_whitelist": [f"{re.escape(full)}/.*", "/tf.*", "/rosout", "/diagnostics"],
                },
            ],
            output="screen",
        ),
    ]


def _rviz(arguments: dict[str, str], full: str, clock: list[Any]) -> list[Any]:
    return [
        Node(
            package="rviz2",
            executable="rviz2",
            name=f"{arguments['name']}_rviz",
            namespace=arguments["namespace"],
            arguments=["-d", arguments["rviz_config"]],
            parameters=clock,
            remappings=[(f"/cloth_sim/{topic}", f"{full}/{topic}") for topic in _RVIZ_TOPICS],
            output="screen",
        )
    ]


_VIEWERS: dict[str, Callable[[dict[str, str], str, list[Any]], list[Any]]] = {
    "rerun": _rerun,
    "foxglove": _foxglove,
    "rviz": _rviz,
}
#: Packages of viewers, which may be missing.
_VIEWER_PACKAGES = {"foxglove": "foxglove_bridge", "rviz": "rviz2"}


def _check_viewer(context: LaunchContext, viewer: str) -> None:
    """Refuse a viewer whose package is missing before the cloth starts: launch ends, but its nodes run on."""
    if viewer not in _VIEWER_PACKAGES:
        return
    package = _VIEWER_PACKAGES[viewer]
    try:
        FindPackagePrefix(package).perform(context)
    except LookupError as error:
        raise RuntimeError(
            f"viewer:={viewer} needs the package {package}: apt install ros-jazzy-{package.replace('_', '-')}, or "
            "choose viewer:=rerun, which needs cloth_sim_ros[replay]"
        ) from error


def _misspelt_arguments(context: LaunchContext, known: list[str]) -> list[Any]:
    """Warn of arguments similar to one of this file, because launch itself accepts any name silently."""
    close = {name: difflib.get_close_matches(name, known, n=1, cutoff=0.85) for name in context.launch_configurations}
    return [
        LogInfo(msg=f"cloth_sim.launch.py has no argument '{name}'; did you mean '{matches[0]}'?")
        for name, matches in sorted(close.items())
        if matches and name not in known
    ]
