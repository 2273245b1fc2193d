# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""State `failed`: an exception in a frame stops time at the last good frame until a reset."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import State
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool, Trigger
from support.clocked_cloth import ClockedCloth
from support.ros_client import Client, pose

from cloth_sim_ros.physics.integrators.symplectic_euler import SymplecticEuler
from cloth_sim_ros.ros.io.outputs import ClothTopics
from cloth_sim_ros.ros.io.states import States
from cloth_sim_ros.ros.node import ClothNode
from cloth_sim_ros.ros.process.failure import RAISE_VARIABLE
from cloth_sim_ros.simulation.bodies.grippers import Grippers
from cloth_sim_ros.simulation.simulation import Simulation

pytest.importorskip("mcap")

from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.recorder import Recorder
from cloth_sim_ros.verify.run import verify

SMALL = {"cloth.resolution": [5, 6], "integrator": "symplectic_euler", "tolerance": 0.0}
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
#: Methods that a frame calls, by stage of the frame.
PLACES = {
    "integrate": (SymplecticEuler, "advance"),
    "event": (Grippers, "set_target"),
    "record": (Recorder, "record"),
    "publish": (ClothTopics, "send"),
    "state": (States, "send"),
}


@pytest.fixture(autouse=True)
def _failures_are_not_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(RAISE_VARIABLE)


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


class Witness:
    """States and diagnostics that a node publishes."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.states: list[State] = []
        self.reports: list[DiagnosticStatus] = []
        client.node.create_subscription(State, "/cloth_sim/state", self.states.append, LATCHED)
        client.node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: self.reports.extend(m.status), 100)

    @property
    def label(self) -> str:
        return self.states[-1].label if self.states else ""

    def wait_for_label(self, start: str) -> str:
        self.client.spin_until(
            lambda: self.label.startswith(start), description=f"the state '{start}', not '{self.label}'"
        )
        return self.label

    def wait_for_report(self, level: bytes, text: str) -> None:
        self.client.spin_until(
            lambda: self.reports and (self.reports[-1].level, self.reports[-1].message) == (level, text),
            description=f"diagnostics '{text}'",
        )


@contextlib.contextmanager
def running(client: Client, concurrent: bool = False, **values: Any) -> Iterator[ClothNode]:
    overrides = [Parameter(name, value=value) for name, value in (SMALL | values).items()]
    cloth = ClothNode(context=client.context, parameter_overrides=overrides, signal_name=str if concurrent else None)
    client.executor.add_node(cloth.node)
    cloth.warm_up()
    cloth.start()
    try:
        client.watch()
        yield cloth
    finally:
        client.executor.remove_node(cloth.node)
        cloth.close()
        cloth.node.destroy_node()


def broken(*_: Any, **__: Any) -> Any:
    raise ZeroDivisionError("a bug\nof the test")


REASON = "ZeroDivisionError: a bug of the test"


def poke(client: Client) -> None:
    """Add an event to the next frame."""
    client.publisher(PoseStamped, "/cloth_sim/gripper/target").publish(pose(0.3, -0.2, 0.4))


@pytest.mark.parametrize(
    ("point", "concurrent"),
    [("integrate", False), ("event", False), ("record", False), ("publish", True), ("state", False)],
)
def test_exception_in_a_frame_is_a_state_left_by_reset(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], point: str,
    concurrent: bool,
) -> None:  # fmt: skip
    witness = Witness(client)
    with running(client, concurrent, **{"record.enabled": True, "record.folder": str(tmp_path)}) as cloth:
        witness.wait_for_label("active")
        for attempt in range(2):
            client.wait_for_clouds(3)
            with monkeypatch.context() as patch:
                patch.setattr(*PLACES[point], broken)
                poke(client)
                assert witness.wait_for_label("failed") == f"failed: {REASON}"
            check_it_is_reported(client, witness, cloth, tmp_path)
            answer = client.call(Trigger, "/cloth_sim/reset")
            assert answer.success, answer.message
            witness.wait_for_label("active")
            client.wait_for_clouds(1)
            sessions = attempt + 2
            client.spin_until(lambda n=sessions: len(list(tmp_path.glob("*.mcap"))) == n, description="a new recording")
        witness.wait_for_report(DiagnosticStatus.OK, "running")
    said = capfd.readouterr().err
    assert said.count(f"failed: {REASON}; time is stopped at frame") == 2
    assert said.count("in broken") == 2
    assert "Exception in thread" not in said
    *failed, last = sorted(tmp_path.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    assert len(failed) == 2
    for path in failed:
        with SessionReader(path, strict=True) as reader:
            assert reader.parts[-1].end_notes["reason"] == f"node failed: {REASON}"
    for path in (*failed, last):
        assert verify([path]).same


def check_it_is_reported(client: Client, witness: Witness, cloth: ClothNode, folder: Path) -> None:
    """Check reports, answers, the state of the last good frame, and that no clouds are published."""
    assert witness.states[-1].id == State.TRANSITION_STATE_ERRORPROCESSING
    witness.wait_for_report(DiagnosticStatus.ERROR, f"failed: {REASON}")
    client.spin_until(lambda: not cloth.recording.session.busy, description="the end of the recording")
    newest = max(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    with SessionReader(newest, strict=True) as reader:
        *_, record = reader.frames()
    assert (cloth.simulation.frame, cloth.simulation.state.digest()) == (record.frame, record.digest)
    # The last clouds arrive until now.
    assert client.call(Trigger, "/cloth_sim/save_state").success
    before = len(client.clouds)
    for kind, name, request in (
        (SetBool, "pause", SetBool.Request(data=True)),
        (Trigger, "step", None),
        (SetBool, "gripper/close", SetBool.Request(data=True)),
        (SetBool, "record", SetBool.Request(data=True)),
    ):
        answer = client.call(kind, f"/cloth_sim/{name}", request)
        assert (answer.success, answer.message) == (False, f"failed: {REASON}; call ~/reset")
    assert cloth.simulation.frame == record.frame
    assert len(client.clouds) == before


def test_parameters_of_a_failed_frame_are_set_back(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    witness = Witness(client)
    with running(client) as cloth:
        monkeypatch.setattr(ClothTopics, "send", broken)
        cloth.node.set_parameters([Parameter("gravity", value=[0.0, 0.0, -1.0])])
        witness.wait_for_label("failed")
        client.spin_until(lambda: cloth.node.get_parameter("gravity").value[2] == -9.81, description="the old gravity")
        assert cloth.simulation.scene.gravity[2] == -9.81
        monkeypatch.undo()
        # A parameter may be set while failed; it takes effect with the reset.
        cloth.node.set_parameters([Parameter("gravity", value=[0.0, 0.0, -2.0])])
        assert client.call(Trigger, "/cloth_sim/reset").success
        assert cloth.simulation.scene.gravity[2] == -2.0


@pytest.mark.parametrize("kind", ["paused", "asleep"])
def test_exception_without_motion_is_a_failure_too(client: Client, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    witness = Witness(client)
    still = {"gravity": [0.0, 0.0, 0.0], "integrator": "auto", "tolerance": 1e-3} if kind == "asleep" else {}
    with running(client, **still) as cloth:
        if kind == "paused":
            assert client.call(SetBool, "/cloth_sim/pause", SetBool.Request(data=True)).success
        else:
            client.spin_until(lambda: cloth.simulation.will_stay_asleep, description="sleep")
        with monkeypatch.context() as patch:
            patch.setattr(ClothTopics, "send", broken)
            witness.wait_for_label("failed")
        frame = cloth.simulation.frame
        assert client.call(Trigger, "/cloth_sim/reset").success
        witness.wait_for_label("inactive" if kind == "paused" else "active")
        assert cloth.simulation.frame == frame if kind == "paused" else cloth.simulation.frame > frame


def test_waiting_requests_are_answered_when_a_frame_fails(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    with ClockedCloth(client, SMALL) as cloth:
        cloth.tick(2)
        monkeypatch.setattr(SymplecticEuler, "advance", broken)
        requests = []
        for kind, name, request in (
            (Trigger, "reset", Trigger.Request()),
            (SetBool, "pause", SetBool.Request(data=False)),
            (SetBool, "gripper/close", SetBool.Request(data=True)),
        ):
            caller = client.node.create_client(kind, f"/cloth_sim/{name}")
            client.spin_until(caller.service_is_ready, description=name)
            requests.append(caller.call_async(request))
        client.spin_until(lambda: len(cloth.node.stepper.queue) == 3, description="three requests that wait")
        cloth.publish_clock(cloth.now)
        client.spin_until(lambda: all(request.done() for request in requests), description="answers", limit=4.0)
        assert {request.result().message for request in requests} == {f"failed: {REASON}; call ~/reset"}
        assert cloth.simulation.frame == 2


def test_jump_back_of_the_clock_recovers(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    witness = Witness(client)
    with ClockedCloth(client, SMALL) as cloth:
        cloth.tick(2)
        with monkeypatch.context() as patch:
            patch.setattr(SymplecticEuler, "advance", broken)
            cloth.publish_clock(cloth.now)
            witness.wait_for_label("failed")
        cloth.publish_clock(10_000_000_000)
        client.spin_until(lambda: cloth.simulation.frame == 3, description="a frame")
        witness.wait_for_label("active")


@pytest.mark.parametrize("error", [MemoryError, KeyboardInterrupt, SystemExit])
def test_memory_and_stop_errors_propagate(
    client: Client, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    def raises(*_: Any) -> None:
        raise error("of the test")

    with running(client):
        monkeypatch.setattr(Simulation, "advance", raises)
        with pytest.raises(error):
            client.wait_for_clouds(3)
        monkeypatch.undo()


#: A node whose tenth frame has a bug.
BROKEN = """
import sys
from cloth_sim_ros.ros.main import main
from cloth_sim_ros.simulation.simulation import Simulation

advance = Simulation.advance

def broken(self, events=()):
    frame = advance(self, events)
    if frame.index == 10:
        raise ZeroDivisionError("a bug of the test")
    return frame

Simulation.advance = broken
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize(("on_failure", "status"), [("stop", 0), ("exit", 1)])
def test_on_failure_says_whether_the_node_ends(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path, on_failure: str, status: int
) -> None:
    values = [f"on_failure:={on_failure}", "cloth.resolution:=[5, 5]", "record.enabled:=true"]
    arguments = [part for value in (*values, f"record.folder:={tmp_path}") for part in ("-p", value)]
    process = start_process([sys.executable, "-c", BROKEN, "--ros-args", *arguments], env={RAISE_VARIABLE: ""})
    process.wait_for_output(f"failed: {REASON}; time is stopped at frame")
    if on_failure == "stop":
        process.send_signal(signal.SIGTERM)
    assert process.wait() == status, process.output
    assert process.output.count("Traceback") == 1
    (path,) = tmp_path.glob("*.mcap")
    with SessionReader(path, strict=True) as reader:
        assert reader.complete
        assert reader.parts[-1].end_notes["reason"] == f"node failed: {REASON}"
        assert [record.frame for record in reader.frames()] == list(range(1, 10))
    assert verify([path]).same
