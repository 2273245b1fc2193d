# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_gripper`: plays a scripted grasp into the command topics of a cloth."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import attrs
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from cloth_sim_ros.ros.arguments import ArgumentsError, read_and_start
from cloth_sim_ros.ros.gripper_player import GripperError, GripperPlayer, Hold
from cloth_sim_ros.ros.gripper_script import GripperScript, ScriptError
from cloth_sim_ros.ros.locations import config_file
from cloth_sim_ros.ros.stopping import StopSignals
from cloth_sim_ros.session.words import counted


def main(arguments: Sequence[str] | None = None) -> int:
    """Play a script.

    Returns:
        Exit status: 0 when it was played, 1 if it could not be or a grasp held nothing, 130 if a signal ended it.
    """
    argv = list(sys.argv if arguments is None else ["cloth_gripper", *arguments])
    try:
        options = read_and_start(_parser(), argv)
    except ArgumentsError as error:
        return _refuse(str(error))
    try:
        return _play(options)
    finally:
        rclpy.try_shutdown()


def _play(options: argparse.Namespace) -> int:
    try:
        script = GripperScript.from_file(options.script or config_file("grasp.yaml"))
    except ScriptError as error:
        return _refuse(str(error))
    if options.gripper:
        script = attrs.evolve(script, gripper=options.gripper)
    if not script.gripper.isidentifier():
        return _refuse(f"gripper name '{script.gripper}' is no ROS name; use letters, digits and _, a letter first")
    signals = StopSignals()
    signals.install()
    node = Node("cloth_gripper")
    player = GripperPlayer(node, script, target=options.node, proceed=lambda: signals.requested is None)
    try:
        node.get_logger().info(f"waiting for gripper '{script.gripper}' of {options.node}")
        if not player.wait_for_gripper(options.wait):
            return 130
        node.get_logger().info(f"playing {script.duration:g} s to gripper '{script.gripper}' of {options.node}")
        if not player.play():
            return 130
        node.get_logger().info(f"played; {player.targets_sent} targets sent; {describe_holds(player.holds)}")
        if not all(hold.held for hold in player.holds):
            return _refuse(f"gripper '{script.gripper}' of {options.node}: {describe_holds(player.holds)}")
    except GripperError as error:
        return _refuse(str(error))
    except ExternalShutdownException:
        return 130
    finally:
        node.destroy_node()
    return 0


def describe_holds(holds: Sequence[Hold]) -> str:
    """Return in words what was held, one grasp after the other."""
    if not holds:
        return "the script closes nothing"
    return "; ".join(_in_words(hold) for hold in holds)


def _in_words(hold: Hold) -> str:
    if hold.held is None:
        return f"what it held is not known: {hold.words}"
    return f"held {counted(hold.held, 'particle')}" if hold.held else "held nothing (the node's log says why)"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cloth_gripper",
        description="Plays a scripted grasp (YAML: times, poses, close, open) into a cloth's command topics.",
    )
    parser.add_argument("script", nargs="?", help="the script; config/grasp.yaml where left out")
    parser.add_argument("--gripper", help="name of the gripper, instead of the script's")
    parser.add_argument("--node", default="/cloth_sim", help="full name of the cloth's node (default: %(default)s)")
    parser.add_argument(
        "--wait",
        type=float,
        default=30.0,
        metavar="SECONDS",
        help="how long to wait for the node (default: %(default)s)",
    )
    return parser


def _refuse(reason: str) -> int:
    print(f"cloth_gripper: {reason}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
