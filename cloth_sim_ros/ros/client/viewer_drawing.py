# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options of `cloth_viewer`, and its drawing process.

Imports no rclpy: the process starts before rclpy is loaded, because Rerun and its window take longer to load.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.ros.process.option_types import node_name
from cloth_sim_ros.session.child_process import child_environment, module_command

#: Longest wait for the drawing process to finish its file [s].
_FINISH_TIMEOUT = 10.0


def read_options(argv: Sequence[str]) -> argparse.Namespace:
    """Parse the options of `cloth_viewer` in a command line, without ROS arguments; argparse exits for invalid ones.

    Raises:
        SystemExit: raised by argparse.
    """
    parser = _parser()
    options = parser.parse_args(_without_ros(argv[1:]))
    _check(parser, options)
    options.node = "/" + options.node.strip("/")
    return options


def start_drawing(options: argparse.Namespace) -> subprocess.Popen[bytes]:
    """Start the child process that draws in Rerun, and return it; it reads messages from its standard input.

    Raises:
        OSError: if its Python cannot be started.
    """
    arguments = ["--node", options.node, "--every", str(options.every)]
    arguments += ["--strain-limit", str(0.01 * options.strain_limit)]
    for name in ("save", "connect", "serve"):
        if getattr(options, name) is not None:
            arguments += [f"--{name}", str(getattr(options, name))]
    _, *module = module_command("cloth_sim_ros.replay.live_main", *arguments)
    # In a session of its own: Ctrl-C ends this process, which ends the pipe.
    return subprocess.Popen(
        [str(options.python or sys.executable), *module],
        stdin=subprocess.PIPE,
        env=child_environment(),
        start_new_session=True,
    )


def finish_drawing(drawing: subprocess.Popen[bytes]) -> None:
    """Close the input of the drawing process, and wait for its end; kill it after 10 s."""
    assert drawing.stdin is not None
    drawing.stdin.close()
    try:
        drawing.wait(_FINISH_TIMEOUT)
    except subprocess.TimeoutExpired:
        drawing.kill()
        drawing.wait()


def _without_ros(arguments: Sequence[str]) -> list[str]:
    """Return the arguments outside of `--ros-args ... --`."""
    outside, is_ros = [], False
    for argument in arguments:
        if argument == "--ros-args":
            is_ros = True
        elif is_ros and argument == "--":
            is_ros = False
        elif not is_ros:
            outside.append(argument)
    return outside


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cloth_viewer", description="Shows a running cloth in the Rerun viewer.")
    parser.add_argument(
        "--node",
        type=node_name,
        default="/cloth_sim",
        help="full name of the cloth's node (default: %(default)s)",
    )
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
        "--python", metavar="PATH", type=Path, default=None,
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
