# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command lines of the package's commands: ROS arguments and our own, side by side."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from cloth_sim_ros.ros.environment_checks import EnvironmentFaultError, check_environment, explain


class ArgumentsError(ValueError):
    """ROS arguments that can't be read; the message says which."""


def read_and_start(parser: argparse.ArgumentParser, argv: Sequence[str]) -> argparse.Namespace:
    """Parse what is not for ROS, and start rclpy with the rest, without signal handlers.

    Raises:
        ArgumentsError: for ROS arguments that rclpy does not take, and for an environment in which it can't start.
        SystemExit: as argparse does.
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
    """Return the message of one of rclpy's errors without the places in its sources, or what explains it."""
    parts = [part for part in str(error).replace("\n", ", ").split(", at ") if not part.startswith(("/", "./"))]
    message = ", at ".join(parts).strip() if parts else str(error)
    return explain(message) or message
