# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command line of `cloth_sim`, ROS arguments aside; read without ROS where a file is only to be checked."""

from __future__ import annotations

import argparse

from cloth_sim_ros import __version__


def parser() -> argparse.ArgumentParser:
    """Return the parser."""
    found = argparse.ArgumentParser(
        prog="cloth_sim",
        description="A live cloth in a ROS 2 graph. Parameters: --ros-args -p name:=value, or --params-file file.yaml; "
        "ros2 param describe tells what they mean.",
        allow_abbrev=False,
    )
    found.add_argument("--version", action="version", version=__version__)
    found.add_argument(
        "--check",
        metavar="FILE",
        help="say what a parameter file would let run, how fast, and what sets its step, without joining the graph; "
        "the exit status is 1 where the node would refuse it",
    )
    found.add_argument(
        "--node",
        default="cloth_sim",
        metavar="NAME",
        help="of --check: whose parameters are read (default: %(default)s)",
    )
    return found
