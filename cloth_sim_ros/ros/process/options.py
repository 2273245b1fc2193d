# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command-line options of `cloth_sim` besides ROS arguments; parsed without ROS for `--check`."""

from __future__ import annotations

import argparse

from cloth_sim_ros.engine import __version__


def parser() -> argparse.ArgumentParser:
    """Return the parser of the options of `cloth_sim`: --version, --check and --node."""
    command_parser = argparse.ArgumentParser(
        prog="cloth_sim",
        description="A live cloth in a ROS 2 graph. Parameters: --ros-args -p name:=value, or --params-file file.yaml; "
        "ros2 param describe explains them.",
        allow_abbrev=False,
    )
    command_parser.add_argument("--version", action="version", version=__version__)
    command_parser.add_argument(
        "--check",
        metavar="FILE",
        help="print the cloth of a parameter file, its expected speed and its step limit, without joining the graph; "
        "the exit status is 1 if the node would refuse it",
    )
    command_parser.add_argument(
        "--node",
        default="cloth_sim",
        metavar="NAME",
        help="with --check: name of the node whose parameters are read (default: %(default)s)",
    )
    return command_parser
