# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start of rclpy with the ROS arguments of a command line, in an environment where it can start."""

from __future__ import annotations

import argparse
import itertools
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

_SECURE = "ROS_SECURITY_ENABLE"
_UNSET = f"or unset {_SECURE}"


class ArgumentsError(ValueError):
    """Error: rclpy can't read the ROS arguments, or can't start in the environment; the message says why."""


def read_and_start(parser: argparse.ArgumentParser, argv: Sequence[str]) -> argparse.Namespace:
    """Start rclpy with the ROS arguments, without signal handlers; return the others, parsed, or ArgumentsError.

    Raises:
        ArgumentsError: if rclpy refuses the ROS arguments or can't start in this environment.
        SystemExit: raised by argparse.
    """
    try:
        options = parser.parse_args(remove_ros_args(list(argv))[1:])
        check_environment(os.environ, argv)
        rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise ArgumentsError(error_text(error)) from error
    return options


def error_text(error: Exception) -> str:
    """Return the message of an rclpy error without its source locations, or an explanation if one is known."""
    parts = [part for part in str(error).replace("\n", ", ").split(", at ") if not part.startswith(("/", "./"))]
    message = ", at ".join(parts).strip() if parts else str(error)
    return explain_error(message) or message


def check_environment(environment: Mapping[str, str], arguments: Sequence[str]) -> None:
    """Raise ArgumentsError if rclpy can't start: log folder, made if missing, or with security its keystore.

    With security, the RuntimeWarning that accompanies an error known to `explain_error` is switched off.

    Args:
        environment: environment variables by name.
        arguments: the command line, ROS arguments included.

    Raises:
        ArgumentsError: names the variable and the remedy.
    """
    if "--disable-external-lib-logs" not in arguments:
        _check_log_folder(environment)
    if environment.get(_SECURE) != "true":
        return
    warnings.filterwarnings("ignore", "Failed to fini rosout publisher", RuntimeWarning)
    if environment.get("ROS_SECURITY_STRATEGY") == "Enforce":
        _check_keystore(environment, arguments)


def explain_error(message: str) -> str:
    """Return one sentence for an rclpy error that needs a remedy; empty for others."""
    if "security libraries" in message:
        return (
            f"{_SECURE} is true, and the Fast DDS of this environment was built without security, as ROS's wheels on "
            f"PyPI are: use the distribution's packages, {_UNSET}"
        )
    if message.startswith("["):
        # rclpy gives their list alone.
        return f"{message} are no ROS arguments: see 'ros2 run' for those after --ros-args"
    if "failed to initialize logging" in message:
        return f"{message}: set ROS_LOG_DIR to a folder that can be written"
    return ""


def _check_log_folder(environment: Mapping[str, str]) -> None:
    """Create the log folder that rcl would use; raise ArgumentsError if it can't be created or written."""
    remedy = "set ROS_LOG_DIR to a folder that can be written"
    named = environment.get("ROS_LOG_DIR") or f"{environment.get('ROS_HOME') or '~/.ros'}/log"
    if named.startswith("~") and not environment.get("HOME"):
        raise ArgumentsError(f"HOME is not set, so the log has no folder {named}: {remedy}")
    folder = Path(environment["HOME"] + named.removeprefix("~")) if named.startswith("~") else Path(named)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArgumentsError(f"the log's folder {folder} can't be made, {error.strerror}: {remedy}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ArgumentsError(f"the log's folder {folder} can't be written: {remedy}")


def _check_keystore(environment: Mapping[str, str], arguments: Sequence[str]) -> None:
    """Raise ArgumentsError if only secured nodes may start and the keystore lacks the node's enclave."""
    keystore = environment.get("ROS_SECURITY_KEYSTORE", "")
    if not keystore:
        raise ArgumentsError(
            f"{_SECURE} is true and ROS_SECURITY_STRATEGY is Enforce, but ROS_SECURITY_KEYSTORE is not set: set it to "
            f"the folder that 'ros2 security create_keystore' made, {_UNSET}"
        )
    argument = dict(itertools.pairwise(arguments)).get("--enclave", "/")
    enclave = environment.get("ROS_SECURITY_ENCLAVE_OVERRIDE") or argument
    folder = Path(keystore) / "enclaves" / enclave.strip("/")
    if not folder.is_dir():
        raise ArgumentsError(
            f"ROS_SECURITY_STRATEGY is Enforce, and there is no enclave '{enclave}', which would be in {folder}: make "
            f"it by 'ros2 security create_enclave {keystore} {enclave}', name another by --enclave, {_UNSET}"
        )
