# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services and the action of simulation_interfaces, the standard of simulators: features, reset, steps and state."""

from __future__ import annotations

import importlib
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from cloth_sim_ros.engine import __version__
from cloth_sim_ros.ros.io.services import Services
from cloth_sim_ros.ros.timing.event_queue import EventResult
from cloth_sim_ros.simulation.events import Event, Pause, Reset, Step

PACKAGE = "simulation_interfaces"
#: Names of the supported features; a version of the package that lacks one of them does not list it.
FEATURES = (
    "SIMULATION_RESET",
    "SIMULATION_RESET_STATE",
    "SIMULATION_STATE_GETTING",
    "SIMULATION_STATE_SETTING",
    "SIMULATION_STATE_PAUSE",
    "STEP_SIMULATION_SINGLE",
    "STEP_SIMULATION_MULTIPLE",
    "STEP_SIMULATION_ACTION",
)
_RUNNING = "the cloth is running; pause it first"


class SimulationInterfaces:
    """Servers of the services and the action of simulation_interfaces for one cloth; `serve` creates them.

    Args:
        node: the node.
        services: queues the events and waits for their frames.
    """

    def __init__(self, node: Node, services: Services) -> None:
        self._node, self._services = node, services
        self._messages: Any = None
        self._action: ActionServer | None = None

    def serve(self) -> None:
        """Create the service and action servers, or log that the package is missing."""
        try:
            self._messages = importlib.import_module(f"{PACKAGE}.msg")
            services = importlib.import_module(f"{PACKAGE}.srv")
            actions = importlib.import_module(f"{PACKAGE}.action")
        except ImportError:
            self._node.get_logger().error(
                f"simulation_interfaces is set, and the package {PACKAGE} is not installed: its services are missing; "
                "sudo apt install ros-jazzy-simulation-interfaces"
            )
            return
        group = ReentrantCallbackGroup()
        for kind, name, callback in (
            (services.GetSimulatorFeatures, "get_simulator_features", self._on_features),
            (services.GetSimulationState, "get_simulation_state", self._on_get_state),
            (services.SetSimulationState, "set_simulation_state", self._on_set_state),
            (services.ResetSimulation, "reset_simulation", self._on_reset),
            (services.StepSimulation, "step_simulation", self._on_step),
        ):
            self._node.create_service(kind, f"~/{name}", callback, callback_group=group)
        self._action = ActionServer(
            self._node,
            actions.SimulateSteps,
            "~/simulate_steps",
            self._simulate_steps,
            callback_group=group,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def close(self) -> None:
        """Destroy the action server, which rclpy's node would keep."""
        if self._action is not None:
            self._action.destroy()
            self._action = None

    def _on_features(self, _request: Any, response: Any) -> Any:
        kind = self._messages.SimulatorFeatures
        response.features.features = [getattr(kind, name) for name in FEATURES if hasattr(kind, name)]
        response.features.custom_info = f"cloth_sim_ros {__version__}: one cloth, whose entities are topics of its node"
        return response

    def _on_get_state(self, _request: Any, response: Any) -> Any:
        state = self._messages.SimulationState
        response.state.state = self._state(state)
        response.result.result = self._messages.Result.OK
        return response

    async def _on_set_state(self, request: Any, response: Any) -> Any:
        state, requested = self._messages.SimulationState, request.state.state
        if requested not in (_constant(state, "PLAYING"), _constant(state, "PAUSED")):
            response.result.result = self._messages.Result.FEATURE_UNSUPPORTED
            response.result.error_message = (
                "the state can be playing or paused; to restart call reset_simulation, to quit send SIGINT to the node"
            )
        elif requested == self._state(state):
            response.result.result = type(response).ALREADY_IN_TARGET_STATE
        else:
            await self._run(Pause(requested == _constant(state, "PAUSED")), response.result)
        return response

    async def _on_reset(self, request: Any, response: Any) -> Any:
        kind = type(request)
        if request.scope and not request.scope & kind.SCOPE_STATE:
            response.result.result = self._messages.Result.FEATURE_UNSUPPORTED
            response.result.error_message = "only SCOPE_STATE is supported; time goes on, and nothing is spawned"
            return response
        if await self._run(Reset(), response.result) and request.scope != kind.SCOPE_STATE:
            response.result.error_message = "the state is reset; time goes on"
        return response

    async def _on_step(self, request: Any, response: Any) -> Any:
        if not self._services.user_paused:
            response.result.result = self._messages.Result.INCORRECT_STATE
            response.result.error_message = _RUNNING
            return response
        response.result.result = self._messages.Result.OK
        begun = self._services.n_interrupting
        for completed in range(request.steps):
            if self._is_interrupted(begun, completed, request.steps, response.result):
                break
            if not await self._run(Step(), response.result):
                break
        return response

    async def _simulate_steps(self, handle: Any) -> Any:
        kind = self._action.action_type if self._action is not None else None
        assert kind is not None
        answer, steps = kind.Result(), handle.request.steps
        answer.result.result = self._messages.Result.OK
        if not self._services.user_paused:
            answer.result.result = self._messages.Result.OPERATION_FAILED
            answer.result.error_message = _RUNNING
            handle.abort()
            return answer
        begun = self._services.n_interrupting
        for completed in range(1, steps + 1):
            if self._is_interrupted(begun, completed - 1, steps, answer.result):
                handle.abort()
                return answer
            if handle.is_cancel_requested:
                answer.result.result = self._messages.Result.OPERATION_FAILED
                answer.result.error_message = f"canceled after {completed - 1} of {steps} steps"
                handle.canceled()
                return answer
            if not await self._run(Step(), answer.result):
                handle.abort()
                return answer
            handle.publish_feedback(kind.Feedback(completed_steps=completed, remaining_steps=steps - completed))
        handle.succeed()
        return answer

    def _is_interrupted(self, begun: int, completed: int, steps: int, result: Any) -> bool:
        """Return true if further steps are no longer requested, and write the reason into `result`.

        Args:
            begun: number of requests to pause, resume or reset when the steps began.
            completed: number of completed steps.
            steps: number of requested steps.
            result: receives the reason.
        """
        if not self._services.user_paused:
            result.result, result.error_message = self._messages.Result.INCORRECT_STATE, _RUNNING
        elif self._services.n_interrupting != begun:
            result.result = self._messages.Result.OPERATION_FAILED
            result.error_message = f"stopped after {completed} of {steps} steps by a pause or a reset"
        else:
            return False
        return True

    async def _run(self, event: Event, result: Any) -> bool:
        """Queue an event and await its frame; write the outcome into `result`; return true if it took effect."""
        outcome: EventResult = await self._services.enqueue(event)
        has_succeeded = outcome.frame is not None
        kind = self._messages.Result
        result.result = kind.OK if has_succeeded else kind.OPERATION_FAILED
        result.error_message = outcome.reason
        return has_succeeded

    def _state(self, kind: Any) -> int:
        return _constant(kind, "PAUSED" if self._services.user_paused else "PLAYING")


def _constant(kind: Any, name: str) -> int:
    """Return a message type's integer constant by name; later versions of the package have the prefix STATE_."""
    return int(getattr(kind, f"STATE_{name}") if hasattr(kind, f"STATE_{name}") else getattr(kind, name))
