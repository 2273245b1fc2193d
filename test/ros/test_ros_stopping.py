# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signals: the node ends in order and closes its recording."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.parameter import Parameter
from std_msgs.msg import Bool
from support.ros_client import start_cloth

from cloth_sim_ros.ros.node import ClothNode
from cloth_sim_ros.ros.process.failure import ignore_errors_after_shutdown
from cloth_sim_ros.ros.process.stopping import StopRequestedError, StopSignals
from cloth_sim_ros.ros.process.worker_thread import WorkerThread
from cloth_sim_ros.ros.timing.pacer import FrameTick

#: The launch file allows 2 s; the remainder is for a busy machine.
LIMIT = 10.0


@pytest.mark.parametrize(
    "numbers",
    [[signal.SIGTERM], [signal.SIGINT, signal.SIGINT]],
    ids=lambda numbers: "+".join(signum.name for signum in numbers),
)
def test_a_signal_closes_the_recording(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, numbers: list[signal.Signals]
) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.session.reader import SessionReader

    process = start_cloth(start_process, "record.enabled:=true", f"record.folder:={tmp_path}")
    for signum in numbers:
        process.send_signal(signum)
        process.wait_for_output(": stopping")
    assert process.wait(limit=LIMIT) == 0, process.output
    assert "Traceback" not in process.output
    (path,) = tmp_path.glob("*.mcap")
    with SessionReader(path, strict=True) as reader:
        list(reader.messages())
        assert reader.complete


def test_context_shutdown_during_a_frame_is_no_error(ros_domain: int) -> None:
    # Like rclpy's signal handlers in a process with several nodes.
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("speaks", context=context)
    publisher = node.create_publisher(Bool, "~/spoken", 1)
    with pytest.raises(RuntimeError, match="of its own"), ignore_errors_after_shutdown(node):
        raise RuntimeError("of its own")
    with ignore_errors_after_shutdown(node):
        rclpy.shutdown(context=context)
        publisher.get_subscription_count()
        raise AssertionError("a publisher without a context speaks")


#: A node whose frames never return from the engine, from the twentieth on.
ENDLESS = """
import sys
import numpy as np
from cloth_sim_ros import Model, PairSprings, compile
from cloth_sim_ros.ros.main import main
from cloth_sim_ros.simulation.simulation import Simulation

many = np.arange(2000)
plan = compile(Model(np.ones(2000), [PairSprings(many.reshape(-1, 2), rest_length=1.0, stiffness=1.0, damping=0.0)]))
x = np.stack([1.0 * many, 0.0 * many, 0.0 * many])
advance = Simulation.advance

def endless(self, events=()):
    frame = advance(self, events)
    if frame.index == 20:
        print("amid a frame", flush=True)
        plan.runs(0.0, 1.0, (x, 0.0 * x), [2**31 - 1])  # some hours
    return frame

Simulation.advance = endless
sys.exit(main(sys.argv[1:]))
"""


def test_a_signal_amid_a_frame_of_the_engine(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.session.reader import SessionReader

    parameters = ["cloth.resolution:=[5, 5]", "record.enabled:=true", f"record.folder:={tmp_path / 'sessions'}"]
    arguments = [argument for parameter in parameters for argument in ("-p", parameter)]
    process = start_process([sys.executable, "-c", ENDLESS, "--ros-args", *arguments])
    process.wait_for_output("amid a frame")
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    assert process.wait(limit=LIMIT) == 0, process.output
    assert "Traceback" not in process.output
    (path,) = (tmp_path / "sessions").glob("*.mcap")
    with SessionReader(path, strict=True) as reader:
        assert len([message for message in reader.messages() if message.topic.endswith("/frame")]) == 19
        assert reader.complete


@pytest.mark.parametrize(
    "loaded",
    ["cloth_sim_ros.ros.process.stopping", "rclpy.node", "numpy.linalg", "cloth_sim_ros.simulation.simulation"],
)
def test_a_signal_while_starting_ends_in_order(ros_domain: int, start_process: Callable[..., Any], loaded: str) -> None:
    # Python prints loaded modules: a reproducible moment of the start.
    environment = {"PYTHONPROFILEIMPORTTIME": "1"}
    process = start_process(["-m", "cloth_sim_ros.ros.main"], env=environment)
    process.wait_for_output(f" {loaded}\n")
    assert process.interrupt(limit=LIMIT) == 0, process.output
    assert "Traceback" not in process.output
    said = [line for line in process.output.splitlines() if not line.startswith("import time:")]
    assert said == ["cloth_sim: SIGINT: stopped while starting"]


@pytest.fixture
def signals() -> Iterator[StopSignals]:
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signals = StopSignals()
    signals.install()
    yield signals
    for signum, handler in before.items():
        signal.signal(signum, handler)


def test_signal_raises_nothing_in_a_job(signals: StopSignals) -> None:
    worker = WorkerThread(signals.name)

    def interrupted() -> str:
        os.kill(os.getpid(), signal.SIGINT)
        return "done"

    # A job that ends soon is completed; no further job starts.
    assert worker.run(interrupted) == "done"
    assert not worker.is_abandoned
    with pytest.raises(StopRequestedError, match="SIGINT"):
        worker.run(lambda: pytest.fail("it began"))


def test_running_job_is_abandoned_on_signal(signals: StopSignals) -> None:
    worker, ended = WorkerThread(signals.name), threading.Event()

    def endless() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        ended.wait()

    with pytest.raises(StopRequestedError, match="SIGTERM"):
        worker.run(endless)
    assert worker.is_abandoned
    ended.set()


def test_no_frame_starts_beside_an_abandoned_one(ros_domain: int, wait_until: Callable[..., object]) -> None:
    context = rclpy.Context()
    rclpy.init(context=context)
    begun: list[Callable[[], Any]] = []

    def left(job: Callable[[], Any]) -> Any:
        begun.append(job)
        raise StopRequestedError("SIGINT")

    overrides = [Parameter("cloth.resolution", value=[5, 5]), Parameter("rate", value=1000.0)]
    cloth = ClothNode(context=context, parameter_overrides=overrides, run_job=left, signal_name=str)
    ticks: list[FrameTick] = []
    # Private: the pacer's thread alone calls it, and a frame that is not run leaves no other trace.
    # private: the tick is counted
    on_tick = cloth._on_tick
    cloth._on_tick = lambda one: (on_tick(one), ticks.append(one))  # type: ignore[method-assign, assignment]
    try:
        cloth.start()
        wait_until(lambda: len(ticks) > 5, description="further frames that are due")
        assert cloth.frame_aborted
        assert len(begun) == 1
    finally:
        cloth.close()
        cloth.node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("rate", [60.0, 1000.0])
def test_signals_at_any_moment_end_it_with_one_line(
    ros_domain: int, start_process: Callable[..., Any], rate: float
) -> None:
    for _ in range(3):
        process = start_cloth(start_process, f"rate:={rate}", "cloth.resolution:=[12, 12]")
        assert process.interrupt(limit=LIMIT) == 0, process.output
        assert process.output.count("SIGINT") == 1
        assert process.output.splitlines()[-1].endswith("[cloth_sim]: SIGINT: stopping")


def test_a_gripper_that_waits_ends_at_once(ros_domain: int, start_process: Callable[..., Any]) -> None:
    process = start_process(["-m", "cloth_sim_ros.ros.gripper_main"])
    process.wait_for_output("waiting for")
    assert process.interrupt(limit=LIMIT) == 130
    assert "Traceback" not in process.output


def test_context_shutdown_during_closing_is_no_error(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The context is shut down as by rclpy's signal handler; the recording is closed nevertheless."""
    context = rclpy.Context()
    context.init()
    cloth = ClothNode(context=context)
    cloth.start()
    clock = cloth.node.get_clock()

    def late() -> Any:
        context.shutdown()
        return clock

    monkeypatch.setattr(cloth.node, "get_clock", late)
    assert cloth.close()
    assert not context.ok()
    cloth.node.destroy_node()


def test_stopping_node_logs_no_warning(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A duplicate node name that only the last report would detect causes no warning."""
    context = rclpy.Context()
    context.init()
    cloth = ClothNode(context=context)
    cloth.start()
    full_name = (cloth.node.get_name(), cloth.node.get_namespace())
    monkeypatch.setattr(cloth.node, "get_node_names_and_namespaces", lambda: [full_name, full_name])
    assert cloth.close()
    cloth.node.destroy_node()
    context.shutdown()
    assert "[WARN]" not in capfd.readouterr().err
