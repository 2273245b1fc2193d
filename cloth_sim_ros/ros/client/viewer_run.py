# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_viewer` after ROS is loaded."""

from __future__ import annotations

import argparse
import os
import select
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from cloth_sim_ros.ros.client.viewer_feed import ViewerFeed
from cloth_sim_ros.ros.process.arguments import ArgumentsError, check_environment, read_and_start, readable
from cloth_sim_ros.ros.process.stopping import StopSignals
from cloth_sim_ros.session.child_process import child_environment, module_command
from cloth_sim_ros.session.message_pipe import pack

#: Longest wait for the drawing process to finish its file [s].
_FINISH_TIMEOUT = 10.0
_POLL = 0.1


def run(argv: Sequence[str], signals: StopSignals) -> int:
    """Run the command.

    Args:
        argv: the command line, the program's name first.
        signals: the installed signal handlers.

    Returns:
        The exit status, see `viewer_main.main`.
    """
    parser = _parser()
    options = parser.parse_args(remove_ros_args(list(argv))[1:])
    _check(parser, options)
    target = "/" + options.node.strip("/")
    try:
        check_environment(os.environ, argv)
        # First, because a window needs a second to open.
        # In a session of its own: Ctrl-C ends this process, which ends its input.
        child = subprocess.Popen(
            _command(options, target), stdin=subprocess.PIPE, env=child_environment(), start_new_session=True
        )
    except (ArgumentsError, OSError) as error:
        return _refuse(str(error))
    try:
        read_and_start(parser, argv)
        _forward(child, target, lambda: signals.requested is None and child.poll() is None)
    except ArgumentsError as error:
        return _refuse(str(error))
    except (ValueError, RuntimeError) as error:
        return _refuse(readable(error))
    except ExternalShutdownException:
        pass
    finally:
        _finish(child)
        rclpy.try_shutdown()
    return 0 if signals.requested else child.returncode


def _forward(child: subprocess.Popen[bytes], target: str, should_continue: Callable[[], bool]) -> None:
    """Forward the messages of a node until the drawing process ends, or the user ends this one."""
    assert child.stdin is not None
    pipe = child.stdin.fileno()
    os.set_blocking(pipe, False)

    def send(topic: str, data: bytes) -> None:
        unsent = memoryview(pack(topic, data))
        # A slow viewer makes this wait. Meanwhile the middleware keeps the newest cloud alone.
        while unsent and should_continue():
            if select.select([], [pipe], [], _POLL)[1]:
                try:
                    unsent = unsent[os.write(pipe, unsent) :]
                except BlockingIOError:
                    continue
                except BrokenPipeError:
                    return

    node = Node("cloth_viewer")
    try:
        ViewerFeed(node, target, send)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while should_continue():
            executor.spin_once(timeout_sec=_POLL)
    finally:
        node.destroy_node()


def _finish(child: subprocess.Popen[bytes]) -> None:
    """End the input of the drawing process, and wait for its end."""
    assert child.stdin is not None
    child.stdin.close()
    try:
        child.wait(_FINISH_TIMEOUT)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def _command(options: argparse.Namespace, target: str) -> list[str]:
    arguments = ["--node", target, "--every", str(options.every), "--strain-limit", str(0.01 * options.strain_limit)]
    for name in ("save", "connect", "serve"):
        if getattr(options, name) is not None:
            arguments += [f"--{name}", str(getattr(options, name))]
    _, *module = module_command("cloth_sim_ros.replay.live_main", *arguments)
    return [str(options.python), *module]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cloth_viewer", description="Shows a running cloth in the Rerun viewer.")
    parser.add_argument("--node", default="/cloth_sim", help="full name of the cloth's node (default: %(default)s)")
    output = parser.add_mutually_exclusive_group()
    output.add_argument("--save", metavar="OUT.rrd", type=Path, help="write a Rerun recording instead of showing it")
    output.add_argument("--connect", metavar="URL", help="show it in a viewer that runs, e.g. on another machine")
    output.add_argument(
        "--serve", metavar="PORT", type=int, nargs="?", const=9090, help="serve a page for browsers (default port 9090)"
    )
    parser.add_argument("--every", metavar="N", type=int, default=1, help="show every Nth cloud; default: all")
    parser.add_argument(
        "--strain-limit", metavar="PERCENT", type=float, default=5.0, help="strain of the last colour; default: 5"
    )
    parser.add_argument(
        "--python", metavar="PATH", type=Path, default=sys.executable,
        help="Python that has cloth_sim_ros[replay]; default: the one that runs this command",
    )  # fmt: skip
    return parser


def _check(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    if options.every < 1:
        parser.error(f"--every {options.every}: it must be at least 1")
    if not 0.0 < options.strain_limit <= 1e4:
        parser.error(f"--strain-limit {options.strain_limit:g}: it must be within (0, 10000] per cent")
    if options.serve is not None and not 0 < options.serve < 65536:
        parser.error(f"--serve {options.serve}: a port is from 1 to 65535")


def _refuse(reason: str) -> int:
    print(f"cloth_viewer: {reason}", file=sys.stderr)
    return 1
