# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services and action of simulation_interfaces: features, reset, steps and state."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from std_srvs.srv import SetBool, Trigger
from support.clocked_cloth import ClockedCloth
from support.interface_packages import importable
from support.ros_client import Client

REQUESTED = {"simulation_interfaces": True}


@pytest.fixture(scope="session")
def interfaces() -> Iterator[Any]:
    """The modules msg, srv and action of simulation_interfaces: installed ones, or built ones."""
    with importable("simulation_interfaces", "msg", "srv", "action") as modules:
        yield modules


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


class Caller:
    """A client of the services on a cloth whose frames the test runs."""

    def __init__(self, client: Client, cloth: ClockedCloth, services: Any) -> None:
        self._client, self._cloth, self._services = client, cloth, services

    def run(self, future: Any) -> Any:
        """Run frames until a future is done; return its result."""
        for _ in range(100):
            if future.done():
                break
            self._cloth.publish_clock(self._cloth.now)
            self._cloth.tick_index += 1
            for _ in range(6):
                self._client.executor.spin_once(timeout_sec=0.005)
        self._client.spin_until(future.done, description="an answer", limit=5.0)
        return future.result()

    def call(self, kind: str, name: str, **fields: Any) -> Any:
        service = getattr(self._services, kind)
        caller = self._client.node.create_client(service, f"/cloth_sim/{name}")
        self._client.spin_until(caller.service_is_ready, description=f"the service {name}")
        return self.run(caller.call_async(service.Request(**fields)))

    def set_state(self, message: Any) -> Any:
        return self.call("SetSimulationState", "set_simulation_state", state=message)


def test_features_are_those_that_work(client: Client, interfaces: Any) -> None:
    msg, srv, _ = interfaces
    with ClockedCloth(client, REQUESTED) as cloth:
        answer = Caller(client, cloth, srv).call("GetSimulatorFeatures", "get_simulator_features").features
        kind = msg.SimulatorFeatures
        assert set(answer.features) >= {kind.SIMULATION_RESET, kind.SIMULATION_STATE_PAUSE, kind.STEP_SIMULATION_ACTION}
        assert not {kind.SPAWNING, kind.SIMULATION_RESET_TIME} & set(answer.features)
        assert answer.custom_info.startswith("cloth_sim_ros ")


def test_state_is_set_and_returned(client: Client, interfaces: Any) -> None:
    msg, srv, _ = interfaces
    state, result = msg.SimulationState, msg.Result
    with ClockedCloth(client, REQUESTED) as cloth:
        caller = Caller(client, cloth, srv)
        assert caller.call("GetSimulationState", "get_simulation_state").state.state == state.STATE_PLAYING
        assert caller.set_state(state(state=state.STATE_PAUSED)).result.result == result.OK
        assert cloth.simulation.paused
        assert caller.call("GetSimulationState", "get_simulation_state").state.state == state.STATE_PAUSED
        again = caller.set_state(state(state=state.STATE_PAUSED))
        assert again.result.result == srv.SetSimulationState.Response.ALREADY_IN_TARGET_STATE
        for unsupported in (state.STATE_STOPPED, state.STATE_QUITTING):
            refused = caller.set_state(state(state=unsupported)).result
            assert refused.result == result.FEATURE_UNSUPPORTED
            assert "playing or paused" in refused.error_message
        assert caller.set_state(state(state=state.STATE_PLAYING)).result.result == result.OK
        assert not cloth.simulation.paused


def test_steps_pass_while_paused(client: Client, interfaces: Any) -> None:
    msg, srv, action = interfaces
    with ClockedCloth(client, REQUESTED) as cloth:
        caller = Caller(client, cloth, srv)
        refused = caller.call("StepSimulation", "step_simulation", steps=3).result
        assert (refused.result, refused.error_message) == (
            msg.Result.INCORRECT_STATE,
            "the cloth is running; pause it first",
        )
        caller.set_state(msg.SimulationState(state=msg.SimulationState.STATE_PAUSED))
        begun = cloth.simulation.frame
        assert caller.call("StepSimulation", "step_simulation", steps=3).result.result == msg.Result.OK
        assert cloth.simulation.frame == begun + 3
        client_of_steps = ActionClient(client.node, action.SimulateSteps, "/cloth_sim/simulate_steps")
        client.spin_until(client_of_steps.server_is_ready, description="the action")
        feedback: list[Any] = []
        sent = client_of_steps.send_goal_async(
            action.SimulateSteps.Goal(steps=4), feedback_callback=lambda m: feedback.append(m.feedback)
        )
        client.spin_until(sent.done, description="an answer")
        done = caller.run(sent.result().get_result_async())
        assert (done.status, done.result.result.result) == (GoalStatus.STATUS_SUCCEEDED, msg.Result.OK)
        assert cloth.simulation.frame == begun + 7
        assert cloth.simulation.paused
        assert [(f.completed_steps, f.remaining_steps) for f in feedback][-1] in ((4, 0), (3, 1))
        caller.set_state(msg.SimulationState(state=msg.SimulationState.STATE_PLAYING))
        sent = client_of_steps.send_goal_async(action.SimulateSteps.Goal(steps=4))
        client.spin_until(sent.done, description="an answer")
        done = caller.run(sent.result().get_result_async())
        assert (done.status, done.result.result.result) == (GoalStatus.STATUS_ABORTED, msg.Result.OPERATION_FAILED)
        client_of_steps.destroy()


@pytest.mark.parametrize(
    ("request_type", "name", "fields", "reason"),
    [
        (SetBool, "pause", {"data": True}, r"stopped after \d+ of 1000 steps by a pause or a reset"),
        (SetBool, "pause", {"data": False}, "the cloth is running; pause it first"),
        (Trigger, "reset", {}, r"stopped after \d+ of 1000 steps by a pause or a reset"),
    ],
)
def test_other_requests_end_steps(
    client: Client, interfaces: Any, request_type: Any, name: str, fields: dict[str, Any], reason: str
) -> None:
    msg, srv, action = interfaces
    with ClockedCloth(client, REQUESTED) as cloth:
        caller = Caller(client, cloth, srv)
        caller.set_state(msg.SimulationState(state=msg.SimulationState.STATE_PAUSED))
        service = client.node.create_client(srv.StepSimulation, "/cloth_sim/step_simulation")
        steps = ActionClient(client.node, action.SimulateSteps, "/cloth_sim/simulate_steps")
        interrupting = client.node.create_client(request_type, f"/cloth_sim/{name}")
        client.spin_until(
            lambda: service.service_is_ready() and steps.server_is_ready() and interrupting.service_is_ready(),
            description="the services",
        )

        def interrupted(future: Any) -> str:
            for _ in range(10):
                client.executor.spin_once(timeout_sec=0.005)
            cloth.tick(2)
            done = interrupting.call_async(request_type.Request(**fields))
            for _ in range(10):
                client.executor.spin_once(timeout_sec=0.005)
            assert caller.run(done).success
            result = caller.run(future).result
            return str(getattr(result.result, "error_message", "") or result.error_message)

        begun = cloth.simulation.frame
        assert re.fullmatch(reason, interrupted(service.call_async(srv.StepSimulation.Request(steps=1000))))
        assert cloth.simulation.frame < begun + 100
        caller.set_state(msg.SimulationState(state=msg.SimulationState.STATE_PAUSED))
        sent = steps.send_goal_async(action.SimulateSteps.Goal(steps=1000))
        client.spin_until(sent.done, description="an answer")
        assert re.fullmatch(reason, interrupted(sent.result().get_result_async()))
        steps.destroy()


def test_reset_restores_state(client: Client, interfaces: Any) -> None:
    msg, srv, _ = interfaces
    scopes = srv.ResetSimulation.Request
    with ClockedCloth(client, REQUESTED) as cloth:
        caller = Caller(client, cloth, srv)
        for scope in (scopes.SCOPE_DEFAULT, scopes.SCOPE_STATE):
            cloth.target("gripper", (0.0, 0.0, 0.0))
            cloth.tick()
            assert cloth.simulation.grippers.is_placed(0)
            answer = caller.call("ResetSimulation", "reset_simulation", scope=scope).result
            assert answer.result == msg.Result.OK
            assert ("time goes on" in answer.error_message) == (scope == scopes.SCOPE_DEFAULT)
            assert not cloth.simulation.grippers.is_placed(0)
        answer = caller.call("ResetSimulation", "reset_simulation", scope=scopes.SCOPE_TIME).result
        assert answer.result == msg.Result.FEATURE_UNSUPPORTED


def test_missing_package_is_logged_once(
    client: Client, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "simulation_interfaces.msg", None)
    with ClockedCloth(client, REQUESTED) as cloth:
        cloth.tick(2)
    assert capfd.readouterr().err.count("the package simulation_interfaces is not installed") == 1


def test_interfaces_are_not_loaded_unless_requested() -> None:
    program = "import sys, cloth_sim_ros.ros.node as n; sys.exit('simulation_interfaces' in ' '.join(sys.modules))"
    subprocess.run([sys.executable, "-c", program], check=True)
