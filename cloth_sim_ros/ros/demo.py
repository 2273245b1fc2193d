# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demonstration of `make run`.

Two grippers of another process fold a towel. The demonstration records the session and ends when the scripts have been
played.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from tqdm import tqdm

from cloth_sim_ros.ros.io.messages import read_stamp
from cloth_sim_ros.ros.process.stopping import StopSignals
from cloth_sim_ros.scene.config_files import config_file
from cloth_sim_ros.session.child_process import child_environment, module_command
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError

_NODE = "/cloth_sim"
#: Longest wait for the first cloud: a busy machine loads slowly [s].
_START_TIMEOUT = 60.0
#: Settling time of the cloth after the script has ended [s].
_SETTLE_TIME = 1.0
_STOP_TIMEOUT = 10.0


class DemoError(RuntimeError):
    """Error: the demonstration failed; the message says why."""


@attrs.define
class Received:
    """Number of clouds, first stamp and newest diagnostics that the demonstration received."""

    clouds: int = 0
    #: Stamp of the first one [ns].
    first: int = 0
    values: dict[str, str] = attrs.field(factory=dict)


def main(arguments: Sequence[str] | None = None) -> int:
    """Fold a towel by scripted grippers, live and recorded; return 0, 1 on failure, or 130 after a signal."""
    options = _read(arguments)
    signals = StopSignals()
    signals.install()
    try:
        scripts = [GripperScript.from_file(path) for path in options.script]
        with reserved_domain():
            rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
            try:
                return _play(options, max(script.duration for script in scripts), signals)
            finally:
                rclpy.try_shutdown()
    except (DemoError, ScriptError) as error:
        print(f"\ndemo: {error}", file=sys.stderr)
        return 1


def _read(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make run", description="A live towel, folded through topics and recorded.")
    parser.add_argument("--folder", default="sessions", help="where the session is recorded (default: %(default)s)")
    parser.add_argument(
        "--params", default=config_file("fold.yaml"), help="parameter file of the cloth (default: the folded towel)"
    )
    parser.add_argument(
        "--script",
        nargs="+",
        default=[config_file("fold_left.yaml"), config_file("fold_right.yaml")],
        help="a script for each gripper",
    )
    return parser.parse_args(arguments)


@contextlib.contextmanager
def reserved_domain() -> Iterator[None]:
    """Context that sets discovery to this machine and a reserved ROS_DOMAIN_ID, unless the environment has them."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if "ROS_DOMAIN_ID" in os.environ:
        yield
        return
    # As ROS 2's domain_coordinator does: the process that holds port 32768 + id owns domain id.
    for domain in range(1, 101):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as reservation:
            try:
                reservation.bind(("", 32768 + domain))
            except OSError:
                continue
            os.environ["ROS_DOMAIN_ID"] = str(domain)
            yield
            return
    raise DemoError("ROS domains 1 to 100 are all taken on this machine; set ROS_DOMAIN_ID")


def _play(options: argparse.Namespace, duration: float, signals: StopSignals) -> int:
    node = Node("cloth_demo")
    received = Received()

    def count(data: bytes) -> None:
        if received.clouds == 0:
            received.first = read_stamp(deserialize_message(data, PointCloud2).header.stamp)
        received.clouds += 1

    def note(message: Any) -> None:
        for status in message.status:
            if status.name.startswith(_NODE.strip("/")):
                received.values = {entry.key: entry.value for entry in status.values}

    node.create_subscription(PointCloud2, f"{_NODE}/points", count, QoSProfile(depth=100), raw=True)
    node.create_subscription(DiagnosticArray, "/diagnostics", note, QoSProfile(depth=10))
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> bool:
        executor.spin_once(timeout_sec=0.05)
        return signals.requested is None

    with tempfile.TemporaryDirectory() as logs, contextlib.ExitStack() as children:
        print(f"starting the cloth, recording into {options.folder}/ ...", flush=True)
        arguments = ["--ros-args", "--params-file", str(options.params)]
        arguments += ["-p", "record.enabled:=true", "-p", f"record.folder:={options.folder}"]
        cloth = children.enter_context(_Child("cloth_sim", Path(logs), "cloth_sim_ros.ros.main", *arguments))
        begun = time.monotonic()
        while received.clouds == 0:
            cloth.check_alive()
            if time.monotonic() - begun > _START_TIMEOUT:
                raise DemoError(f"no cloud came within {_START_TIMEOUT:g} s\n{cloth.log()}")
            if not spin():
                return 130
        print(f"first cloud after {time.monotonic() - begun:.1f} s; grasping ...", flush=True)
        arguments = [*map(str, options.script), "--node", _NODE]
        gripper = children.enter_context(
            _Child("cloth_gripper", Path(logs), "cloth_sim_ros.ros.gripper_main", *arguments)
        )
        if not _watch(cloth, gripper, duration, received, spin):
            return 130
        status = cloth.stop(spin)
        if status != 0:
            raise DemoError(f"cloth_sim ended with status {status}\n{cloth.log()}")
    return report(received)


def _watch(cloth: _Child, gripper: _Child, duration: float, received: Received, spin: Any) -> bool:
    """Spin until scripts and cloth have settled; false after a signal. DemoError if a process fails."""
    begun = time.monotonic()
    total = duration + _SETTLE_TIME
    bar = tqdm(
        total=round(total, 1), unit="s", leave=False, disable=None, bar_format="{desc} {bar} {n:.1f}/{total:.1f} s"
    )
    ended: float | None = None
    with bar:
        while ended is None or time.monotonic() - ended < _SETTLE_TIME:
            if not spin():
                return False
            cloth.check_alive()
            status = gripper.poll()
            if ended is None and status is not None:
                if status != 0:
                    raise DemoError(f"cloth_gripper ended with status {status}\n{gripper.log()}")
                ended = time.monotonic()
            bar.n = min(time.monotonic() - begun, total)
            bar.set_description_str(pluralize(received.clouds, "frame"), refresh=False)
            bar.refresh()
    return True


def report(received: Received) -> int:
    """Print the numbers of published, lost and late frames; raise DemoError if any was lost, otherwise return 0."""
    values = received.values
    path = values.get("recording_file", "")
    # The last diagnostics are up to a second older than the last cloud. The session holds every published cloud.
    published = _published_since(path, 0)
    n_missing = _published_since(path, received.first) - received.clouds
    print(f"frames published  {published}, received {received.clouds}, lost since the first one {n_missing}")
    print(f"late frames       {values.get('late_frames')}")
    print(f"real-time factor  {float(values.get('real_time_factor_overall', 'nan')):.3f}")
    print(f"session           {path}")
    # The console script in this Python's folder; the user types it next.
    command = Path(sys.executable).parent / "cloth_replay"
    with contextlib.suppress(ValueError):
        command = command.relative_to(Path.cwd())
    print(f"look at it        {command} {path}")
    if n_missing:
        raise DemoError(f"{pluralize(n_missing, 'frame')} lost on the way")
    return 0


def _published_since(path: str, stamp: int) -> int:
    """Return the number of clouds in a recorded session from a stamp [ns] on; DemoError if it can't be read."""
    from cloth_sim_ros.session.errors import SessionError
    from cloth_sim_ros.session.reader import SessionReader

    try:
        with SessionReader(path) as session:
            return sum(1 for _ in session.messages([f"{_NODE}/points"], start=stamp))
    except SessionError as error:
        raise DemoError(f"the session can't be read: {error}") from error


class _Child:
    """A child process, started at once, whose output is stored for error messages; its context ends it."""

    def __init__(self, name: str, folder: Path, module: str, *arguments: str) -> None:
        self._name = name
        self._output = folder / f"{name}.log"
        with self._output.open("wb") as stream:
            # In a process group of its own: Ctrl-C reaches the demonstration, which ends the child in order.
            self._process = subprocess.Popen(
                module_command(module, *arguments),
                env=child_environment(),
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def __enter__(self) -> _Child:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(_STOP_TIMEOUT)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def poll(self) -> int | None:
        """Return the exit status, or None while the process runs."""
        return self._process.poll()

    def log(self) -> str:
        """Return the output of the process so far, for an error message."""
        return self._output.read_text(errors="replace")

    def check_alive(self) -> None:
        """Raise DemoError if the process has ended."""
        status = self._process.poll()
        if status is not None:
            raise DemoError(f"{self._name} ended with status {status}\n{self.log()}")

    def stop(self, spin: Any) -> int:
        """Interrupt the process and call `spin` until it ends; return its exit status. DemoError after 10 s."""
        self._process.send_signal(signal.SIGINT)
        begun = time.monotonic()
        while self._process.poll() is None:
            spin()
            if time.monotonic() - begun > _STOP_TIMEOUT:
                raise DemoError(f"{self._name} did not stop within {_STOP_TIMEOUT:g} s\n{self.log()}")
        return self._process.returncode


if __name__ == "__main__":
    sys.exit(main())
