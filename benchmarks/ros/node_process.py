# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Node in its own process, its processor time, and a client that waits for it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import attrs
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from validation.command import child_process_arguments

#: Longest wait for the start of a node, its end, an answer, or a cloud [s].
PATIENCE = 120.0


@attrs.frozen
class NodeProcess:
    """A running node and the file of its output."""

    process: subprocess.Popen[bytes]
    log: Path

    def check_alive(self) -> None:
        """Raise RuntimeError if the node has ended."""
        if self.process.poll() is not None:
            raise RuntimeError(f"the node ended with status {self.process.returncode}:\n{self._output()[-2000:]}")

    def wait_until(self, condition: Callable[[], Any], awaited: str) -> None:
        """Wait until a condition holds.

        Raises:
            RuntimeError: if the process ends before, or there is no `awaited` within `PATIENCE`.
        """
        end = time.monotonic() + PATIENCE
        while not condition():
            self.check_alive()
            if time.monotonic() > end:
                raise RuntimeError(f"no {awaited} came in {PATIENCE:g} s")
            time.sleep(0.02)

    def wait_for_output(self, text: str) -> None:
        """Wait until the process has written a text; raise RuntimeError as `wait_until`."""
        self.wait_until(lambda: text in self._output(), f"output '{text}'")

    def processor_time(self) -> float:
        """Return the processor time of the process so far [s]."""
        # After the name in brackets, which may contain any character: user and system time are fields 12 and 13.
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def _output(self) -> str:
        return self.log.read_text(errors="replace")


def node_process(
    arguments: Sequence[str], parameters: Sequence[str] = ()
) -> contextlib.AbstractContextManager[NodeProcess]:
    """Run `cloth_sim` as `module_process`.

    Args:
        arguments: for ROS, e.g. ``-r __node:=name``.
        parameters: ``name:=value``.
    """
    options = [word for parameter in parameters for word in ("-p", parameter)]
    return module_process("cloth_sim_ros.ros.main", "--ros-args", *arguments, *options)


@contextlib.contextmanager
def module_process(module: str, *arguments: str, patience: float = PATIENCE) -> Iterator[NodeProcess]:
    """Run a module of this repository with a node; at the end interrupt it, and kill it after `patience` [s]."""
    with tempfile.NamedTemporaryFile(suffix=".log") as log:
        process = subprocess.Popen(
            **child_process_arguments(module, *arguments),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        try:
            yield NodeProcess(process, Path(log.name))
        finally:
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=patience)
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


#: Position of the lower corner of the default cloth [m].
CORNER = np.array([0.5, 0.0, 0.5])


class Probe:
    """Client that processes messages while it waits.

    Args:
        name: name of its node.
        measured: the measured node.
        namespace: namespace of its node.
    """

    def __init__(self, name: str, measured: NodeProcess, *, namespace: str = "") -> None:
        self.node = Node(name, namespace=namespace)
        self._measured = measured
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def spin_until(self, condition: Callable[[], Any], *, limit: float = PATIENCE) -> None:
        """Process messages until a condition holds.

        Raises:
            RuntimeError: if it does not hold within `limit` [s], or the measured node has ended.
        """
        end = time.monotonic() + limit
        while not condition():
            self._measured.check_alive()
            if time.monotonic() > end:
                raise RuntimeError(f"the condition did not hold within {limit:g} s")
            self.spin_once()

    def spin_once(self) -> None:
        """Process the messages that have arrived, or wait a moment for one."""
        self._executor.spin_once(timeout_sec=0.01)

    def request(self, client: Any, request: Any) -> Any:
        """Return a service's answer.

        Raises:
            RuntimeError: if the service refuses the request.
        """
        future = client.call_async(request)
        self.spin_until(future.done)
        answer = future.result()
        if not getattr(answer, "success", True):
            raise RuntimeError(f"{client.srv_name}: {answer.message}")
        return answer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()


def stamp_ns(cloud: PointCloud2) -> int:
    """Return the stamp of a cloud [ns]."""
    stamp = cloud.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
