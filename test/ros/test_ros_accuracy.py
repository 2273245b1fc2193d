# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The accuracy monitor: correct verdicts, no delays, and a common end of node and worker."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters as SetParametersService
from support.ros_client import STARTED, Client, start_cloth

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.ros.accuracy.accuracy_monitor import AccuracyMonitor
from cloth_sim_ros.ros.accuracy.accuracy_switch import AccuracySwitch
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Pause, Reset, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.accuracy_worker import assess_window

SMALL = {"cloth.resolution": [5, 5], "cloth.size": [0.4, 0.4], "rate": 30.0, "material.stretch_modulus": 100.0,
         "tolerance": 1e-4}  # fmt: skip
MODULE = "cloth_sim_ros.verify.accuracy_worker"


@pytest.fixture
def monitor() -> Iterator[AccuracyMonitor]:
    monitor = AccuracyMonitor()
    yield monitor
    monitor.close()


def _frame(monitor: AccuracyMonitor, simulation: Simulation, events: list[Event] | None = None) -> None:
    monitor.before_frame(simulation)
    monitor.after_frame(simulation, simulation.advance(events or []))


def _shadows_of(pid: int) -> list[psutil.Process]:
    return [child for child in psutil.Process(pid).children() if MODULE in child.cmdline()]


def _script(simulation: Simulation) -> list[list[Event]]:
    corner = tuple(simulation.positions[24].tolist())
    away = (corner[0], corner[1] - 0.05, corner[2])
    script: list[list[Event]] = [[] for _ in range(65)]
    script[3] = [Target("gripper", corner)]
    script[4] = [Grasp("gripper", True)]
    script[6:12] = [[Target("gripper", away)]] * 6
    script[20], script[22], script[24] = [Pause(True)], [Grasp("gripper", False)], [Pause(False)]
    script[40] = [SetParameters({"gravity": [0.0, 1.0, -3.0]})]
    script[50] = [Reset()]
    return script


def test_accuracy_diagnostics_match_the_windows(monitor: AccuracyMonitor, wait_until: Callable[..., Any]) -> None:
    simulation = Simulation(Scene.from_parameters(SMALL))
    assert monitor.describe(0.0)["accuracy"] == "starting"
    start, ends, moved = simulation.state.copy(), [], 0
    script = _script(simulation)
    for k, events in enumerate(script):
        if moved == 30:
            # The second window waits for the verdict of the first, so that none is skipped.
            wait_until(lambda: monitor.describe(0.0)["accuracy_windows"] == "1", description="the first window")
            ends.append((k, simulation.state.copy()))
        before = simulation.frame
        _frame(monitor, simulation, events)
        moved += simulation.frame - before
    wait_until(lambda: monitor.describe(0.0)["accuracy_windows"] == "2", description="the second window")
    ((length, end),) = ends
    first = assess_window(Scene.from_parameters(SMALL), start, script[:length], end.digest())
    assert first["verdict"] == "kept"
    assert 0.0 < first["uncertainty"] < 0.01 * first["error"]
    entries = monitor.describe(simulation.time)
    assert entries["accuracy"] == "running"
    assert entries["accuracy_window_s"] == "1.000 to 2.000"
    assert entries["accuracy_windows_skipped"] == "0"
    assert 0.0 < float(entries["accuracy_error_m"]) < 1e-4
    assert float(entries["accuracy_lag_s"]) == pytest.approx(simulation.time - 2.0, abs=1e-3)
    assert monitor.take_warnings() == []
    page = (Path(__file__).resolve().parents[2] / "docs" / "node" / "accuracy.md").read_text()
    rows = [line.split("|") for line in page.split("## Entries\n")[1].split("\n## ")[0].splitlines()]
    assert set(entries) == {name for row in rows if len(row) > 2 for name in re.findall(r"`(\w+)`", row[1])}


def test_verdict_equals_certificate_of_the_window() -> None:
    scene = Scene.from_parameters(SMALL | {"tolerance": 1e-6})
    simulation = Simulation(scene)
    start = State.from_bytes(simulation.state.to_bytes())
    for _ in range(30):
        simulation.advance([])
    verdict = assess_window(scene, start, [()] * 30, simulation.state.digest())
    assert verdict["verdict"] == "kept"
    assert (verdict["start"], verdict["end"]) == (0.0, pytest.approx(1.0))
    # If the worker's run does not end in the state of the simulation, there is no verdict.
    assert "otherwise" in assess_window(scene, start, [()] * 30, "0" * 32)["trouble"]


def test_amplification_is_computed_above_tolerance_only(monkeypatch: pytest.MonkeyPatch) -> None:
    from cloth_sim_ros.scene import scene as scene_module

    real = scene_module.make_integrator
    monkeypatch.setattr(
        scene_module, "make_integrator", lambda name, *, tolerance, **more: real(name, tolerance=1e-2, **more)
    )
    scene = Scene.from_parameters(SMALL | {"tolerance": 1e-7})
    simulation = Simulation(scene)
    start = simulation.state.copy()
    for _ in range(30):
        simulation.advance([])
    verdict = assess_window(scene, start, [()] * 30, simulation.state.digest())
    assert verdict["verdict"] == "not kept"
    assert verdict["allowed"] > 1e-7
    assert verdict["error"] > verdict["allowed"]


def test_whole_windows_are_skipped_when_worker_lags(monitor: AccuracyMonitor, wait_until: Callable[..., Any]) -> None:
    (child,) = wait_until(lambda: _shadows_of(os.getpid()), description="the process")
    child.send_signal(signal.SIGSTOP)
    simulation = Simulation(Scene.from_parameters(SMALL))
    # None of these calls may wait, or the test would never end.
    for _ in range(30 * 8):
        _frame(monitor, simulation)
    assert int(monitor.describe(simulation.time)["accuracy_windows_skipped"]) >= 5
    child.send_signal(signal.SIGCONT)
    wait_until(lambda: monitor.describe(simulation.time)["accuracy"] == "running", description="an answer")
    # The newest window waited.
    wait_until(
        lambda: monitor.describe(simulation.time).get("accuracy_window_s") == "7.000 to 8.000",
        description="the newest window",
    )
    assert monitor.describe(simulation.time)["accuracy_lag_s"] == "0.000"
    assert monitor.take_warnings() == []
    child.send_signal(signal.SIGSTOP)
    monitor.close()
    wait_until(lambda: not psutil.pid_exists(child.pid), description="its end")


def test_accuracy_off_loads_and_starts_nothing(ros_domain: int, start_process: Callable[..., Any]) -> None:
    script = (
        "import atexit, os, sys\n"
        "from cloth_sim_ros.ros.main import main\n"
        "def report():\n"
        "    late = ('cloth_sim_ros.verify', 'cloth_sim_ros.ros.accuracy.accuracy_monitor')\n"
        "    extra = [name for name in sys.modules if name.startswith(late)]\n"
        "    print('LOADED', extra, flush=True)\n"
        "atexit.register(report)\n"
        "leave = os._exit\n"  # an interrupt within a long call ends the process without `atexit`
        "os._exit = lambda code: (report(), leave(code))\n"
        "sys.exit(main())\n"
    )
    process = start_process([sys.executable, "-c", script])
    process.wait_for_output(STARTED)
    assert _shadows_of(process.pid) == []
    assert process.interrupt() == 0
    assert "LOADED []" in process.output
    simulation = Simulation(Scene.from_parameters(SMALL))
    accuracy = AccuracySwitch(simulation, ThrottledLog(None))
    accuracy.before_frame()
    accuracy.after_frame(simulation.advance([]))
    accuracy.update()
    assert accuracy.describe() == {"accuracy": "off"}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def _listen(client: Client) -> Callable[[], dict[str, str]]:
    seen: list[Any] = []
    client.node.create_subscription(DiagnosticArray, "/diagnostics", lambda message: seen.extend(message.status), 10)
    return lambda: {pair.key: pair.value for pair in seen[-1].values} if seen else {}


PARAMETERS = [f"{name}:={value}" for name, value in SMALL.items()]


def _set_accuracy(client: Client, on: bool) -> None:
    value = ParameterValue(type=1, bool_value=on)
    request = SetParametersService.Request(parameters=[Parameter(name="diagnostics.accuracy", value=value)])
    (result,) = client.call(SetParametersService, "/cloth_sim/set_parameters", request).results
    assert result.successful, result.reason


def test_node_reports_error_and_survives_worker_death(client: Client, start_process: Callable[..., Any]) -> None:
    latest = _listen(client)
    process = start_cloth(start_process, *PARAMETERS, "diagnostics.accuracy:=true")
    client.spin_until(lambda: latest().get("accuracy_verdict") == "kept", description="a window that is judged")
    assert 0.0 < float(latest()["accuracy_error_m"]) < float(latest()["accuracy_bound_m"])
    assert float(latest()["accuracy_lag_s"]) >= 0.0
    (child,) = _shadows_of(process.pid)
    child.send_signal(signal.SIGKILL)
    client.spin_until(lambda: "ended by itself (status -9)" in latest().get("accuracy", ""), description="its end told")
    frame = int(latest()["frame"])
    client.spin_until(lambda: int(latest()["frame"]) > frame, description="further frames")
    _set_accuracy(client, False)
    client.spin_until(lambda: latest()["accuracy"] == "off", description="off")
    _set_accuracy(client, True)
    client.spin_until(lambda: latest()["accuracy"] == "running", description="another one")
    (child,) = _shadows_of(process.pid)
    assert process.interrupt() == 0
    assert "Traceback" not in process.output
    client.spin_until(lambda: not psutil.pid_exists(child.pid), description="its end with the node")


def test_worker_ends_when_node_is_killed(client: Client, start_process: Callable[..., Any]) -> None:
    latest = _listen(client)
    process = start_cloth(start_process, *PARAMETERS, "diagnostics.accuracy:=true")
    client.spin_until(lambda: "accuracy_verdict" in latest(), description="a window that is judged")
    (child,) = _shadows_of(process.pid)
    os.kill(process.pid, signal.SIGKILL)
    client.spin_until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE, description="its end")
