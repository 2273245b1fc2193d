# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Node in its own process, and its processor time."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import rclpy

from cloth_sim_ros.session.child_process import child_environment, module_command
from validation.command import child_process_arguments


@contextlib.contextmanager
def node_process(
    arguments: Sequence[str], parameters: Sequence[str] = (), *, log: Path | None = None, patience: float = 10.0
) -> Iterator[subprocess.Popen[str]]:
    """Run a node; at the end interrupt it, and kill it after a timeout.

    Args:
        arguments: for ROS, e.g. ``-r __node:=name``.
        parameters: ``name:=value``.
        log: file for its output. Without it standard error is a pipe and standard output is discarded.
        patience: longest wait for its end [s].
    """
    command = module_command("cloth_sim_ros.ros.main", "--ros-args", *arguments)
    for parameter in parameters:
        command += ["-p", parameter]
    with contextlib.ExitStack() as stack:
        stream = None if log is None else stack.enter_context(log.open("wb"))
        process = subprocess.Popen(
            command,
            env=child_environment(),
            stdin=subprocess.DEVNULL,
            stdout=stream or subprocess.DEVNULL,
            stderr=stream or subprocess.PIPE,
            text=True,
        )
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=patience)
            process.kill()


@contextlib.contextmanager
def subscriber_process(module: str, topic: str, *arguments: str) -> Iterator[None]:
    """Run a module of this package as subscriber of a topic, in its own process."""
    # The subscriber must not inherit standard output: a reader would wait until all writers have closed it.
    process = subprocess.Popen(
        **child_process_arguments(module, "--listen", topic, *arguments),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        # It has nothing to clean up, and rclpy may hang after a signal.
        process.kill()
        process.wait()


@contextlib.contextmanager
def ros_context() -> Iterator[None]:
    """Run ROS on this host only, so that other machines do not interfere."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(args=[])
    try:
        yield
    finally:
        rclpy.try_shutdown()


def processor_time(pid: int) -> float:
    """Return the processor time of a process so far [s]."""
    # After the name in brackets, which may contain any character: user and system time are fields 12 and 13.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
