# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_gripper` after ROS is loaded."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import attrs
import rclpy
from rclpy.executors import ExternalShutdownException

from cloth_sim_ros.ros.client.gripper_client import describe_holds
from cloth_sim_ros.ros.client.gripper_player import GripperError, GripperPlayer
from cloth_sim_ros.ros.process.arguments import ArgumentsError, error_text, read_and_start
from cloth_sim_ros.ros.process.option_types import node_name, waiting_time
from cloth_sim_ros.ros.process.stopping import StopSignals
from cloth_sim_ros.ros.timing.cloth_clock import ClothTime
from cloth_sim_ros.ros.timing.sim_time import SimTimeNode
from cloth_sim_ros.scene.config_files import config_file
from cloth_sim_ros.scene.parameters.declare import NAME
from cloth_sim_ros.session.command_runner import INTERRUPTED
from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError

#: Endings of the files of bags and sessions.
_BAG_ENDINGS = (".mcap", ".db3", ".bag")


def run(argv: Sequence[str], signals: StopSignals) -> int:
    """Run `cloth_gripper`: parse the command line, start rclpy, and play the scripts; return the exit status.

    Args:
        argv: the command line, the program's name first.
        signals: the installed signal handlers; polled between long operations.

    Returns:
        The exit status, see `gripper_main.main`.
    """
    try:
        options = read_and_start(_parser(), argv)
    except ArgumentsError as error:
        return _refuse(str(error))
    try:
        return INTERRUPTED if signals.requested else _play(options, signals)
    finally:
        rclpy.try_shutdown()


def _play(options: argparse.Namespace, signals: StopSignals) -> int:
    try:
        scripts = _read_scripts(options)
    except ScriptError as error:
        return _refuse(str(error))
    names = [script.gripper for script in scripts]
    for name in names:
        if not NAME.fullmatch(name):
            return _refuse(f"gripper name '{name}' is no ROS name; use letters, digits and _, a letter first")
        if names.count(name) > 1:
            return _refuse(f"{names.count(name)} scripts are for the gripper '{name}'; a gripper plays one")
    try:
        node = SimTimeNode("cloth_gripper")
    except (ValueError, RuntimeError) as error:
        return _refuse(error_text(error))
    log = node.get_logger()
    player = GripperPlayer(
        node,
        scripts,
        target=options.node,
        should_continue=lambda: signals.requested is None,
        script_time=ClothTime(node, "/" + options.node.strip("/")),
        on_standing=log.info,
    )
    named = f"gripper{'s' if names[1:] else ''} {', '.join(map(repr, names))} of {options.node}"
    try:
        log.info(f"waiting for {named}")
        if not player.wait_for_grippers(options.wait):
            return INTERRUPTED
        log.info(f"playing {max(script.duration for script in scripts):g} s to {named}")
        if not player.play(standing=options.wait):
            return INTERRUPTED
        for hand in player.grippers:
            summary = f"{hand.targets_sent} targets sent"
            if all(hold.held for hold in hand.reports):
                summary += f"; {describe_holds(hand.reports)}"
            log.info(f"played; {summary}" if not names[1:] else f"played '{hand.script.gripper}'; {summary}")
        failed = [hand for hand in player.grippers if not all(hold.held for hold in hand.reports)]
        for hand in failed:
            _refuse(f"gripper '{hand.script.gripper}' of {options.node}: {describe_holds(hand.reports)}")
        if failed:
            return 1
    except GripperError as error:
        return _refuse(str(error))
    except ExternalShutdownException:
        return INTERRUPTED
    finally:
        node.destroy_node()
    return 0


def _read_scripts(options: argparse.Namespace) -> list[GripperScript]:
    """Read the scripts that the command line names, as YAML, CSV, bag or session; ScriptError if it can't be done.

    Raises:
        ScriptError: for a file that can't be played, or options that do not fit it.
    """
    paths = [Path(path) for path in options.scripts] or [config_file("grasp.yaml")]
    if len(paths) > 1 and (options.gripper or options.topic):
        option = "--gripper" if options.gripper else "--topic"
        raise ScriptError(f"{option} is for one file; {len(paths)} files name their own grippers")
    if paths[0].is_dir() or paths[0].suffix in _BAG_ENDINGS:
        if len(paths) > 1:
            raise ScriptError(f"'{paths[0]}' is a bag; it is played alone")
        from cloth_sim_ros.ros.client.gripper_bag import bag_scripts

        return bag_scripts(paths[0], gripper=options.gripper, topic=options.topic)
    if options.topic:
        raise ScriptError(f"--topic is for bags, and '{paths[0]}' is none")
    scripts = [GripperScript.from_file(path) for path in paths]
    return [attrs.evolve(scripts[0], gripper=options.gripper)] if options.gripper else scripts


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cloth_gripper",
        description="Plays scripted grasps (YAML), or recorded poses (CSV, bags), into a cloth's command topics.",
    )
    parser.add_argument(
        "scripts",
        nargs="*",
        metavar="script",
        help="a script (YAML), a table of poses (CSV), or one of these for each of several grippers, which start "
        "together; or a bag (folder, MCAP, SQLite, ROS 1), or a session (default: config/grasp.yaml)",
    )
    parser.add_argument("--gripper", help="name of the gripper, instead of the script's; of a bag, the only one played")
    parser.add_argument("--topic", help="topic of a bag's poses (PoseStamped); default: those named <gripper>/target")
    parser.add_argument(
        "--node",
        type=node_name,
        default="/cloth_sim",
        help="full name of the cloth's node (default: %(default)s)",
    )
    parser.add_argument(
        "--wait",
        type=waiting_time,
        default=30.0,
        metavar="SECONDS",
        help="how long to wait for the node, and while a cloth's time stands (default: %(default)s)",
    )
    return parser


def _refuse(reason: str) -> int:
    print(f"cloth_gripper: {reason}", file=sys.stderr)
    return 1
