# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command lines that mix ROS arguments and the package's own."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from cloth_sim_ros.ros.process.environment_checks import EnvironmentFaultError, check_environment, explain


class ArgumentsError(ValueError):
    """ROS arguments that rclpy can't read; the message names them."""


def read_and_start(parser: argparse.ArgumentParser, argv: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments that are not for ROS, and start rclpy with the others, without signal handlers.

    Raises:
        ArgumentsError: if rclpy refuses the ROS arguments or can't start in this environment.
        SystemExit: raised by argparse.
    """
    try:
        options = parser.parse_args(remove_ros_args(list(argv))[1:])
        check_environment(os.environ, argv)
        rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
    except EnvironmentFaultError as error:
        raise ArgumentsError(str(error)) from error
    except RuntimeError as error:
        raise ArgumentsError(readable(error)) from error
    return options


def readable(error: Exception) -> str:
    """Return the message of an rclpy error without its source locations, or an explanation if one is known."""
    parts = [part for part in str(error).replace("\n", ", ").split(", at ") if not part.startswith(("/", "./"))]
    message = ", at ".join(parts).strip() if parts else str(error)
    return explain(message) or message
