# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Action servers `~/<gripper>/gripper_cmd` of control_msgs, as gripper controllers of ros2_control have them.

A goal becomes a grasp event. Its result comes with the frame in which the pads rest, so in simulated time.
"""

from __future__ import annotations

import functools
import importlib
import math
import time
from collections.abc import Sequence
from typing import Any

import attrs
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future

from cloth_sim_ros.ros.io.services import FRAME_TIMEOUT
from cloth_sim_ros.ros.process.failure import FailureGuard
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.event_queue import EventQueue, EventResult, QueueFullError
from cloth_sim_ros.scene.gripper_section import NO_ACTION, PARALLEL_GRIPPER_COMMAND
from cloth_sim_ros.simulation.bodies.grippers import GraspResult
from cloth_sim_ros.simulation.event_checks import MIN_PAD_SPEED, EventError
from cloth_sim_ros.simulation.events import Grasp, Reset
from cloth_sim_ros.simulation.simulation import Frame, Simulation

#: Name of the action below that of its gripper.
TOPIC = "gripper_cmd"
#: Positions beyond the range of the joint by at most this fraction of it are at its end.
_POSITION_TOLERANCE = 0.01
_SUCCEEDED, _ABORTED, _CANCELED = "succeeded", "aborted", "canceled"


class GoalError(ValueError):
    """Error: a goal of a gripper's action is rejected; the message says why."""


@attrs.frozen
class Command:
    """Goal of a gripper's action: fraction of its opening, limits of force [N] and speed, and names of its joints."""

    #: Position of the joint [rad or m], as a fraction of its way from closed (0) to open (1).
    fraction: float
    #: Largest force of each pad [N]; 0 for none.
    force: float
    #: Largest speed of the joint [rad/s or m/s]; 0 for none.
    speed: float
    #: Names of the joints; the state has one position for each.
    joints: tuple[str, ...]


@attrs.frozen
class GripperJointState:
    """Position, velocity and force of a gripper's joint, for feedback and results of its action."""

    #: Position [rad or m], velocity, and force of each pad [N].
    position: float
    velocity: float
    effort: float


@attrs.define(eq=False)
class _Goal:
    """Accepted goal of a gripper's action that has not ended."""

    server_handle: Any
    gripper: str
    command: Command
    #: Status and result message.
    done: Future
    #: Its newest event.
    event: Grasp
    is_canceled: bool = False
    #: Steady time of the request to cancel [s].
    cancel_time: float = math.inf


class GripperActions:
    """Server of the action ~/<gripper>/gripper_cmd of grippers that have one; `serve` creates it.

    Args:
        node: the node.
        simulation: the cloth.
        queue: receives the events.
        failure: gives the reason why only a reset is possible; its lock is held during each callback.
        log: receives rejected and aborted goals.
    """

    def __init__(
        self, node: Node, simulation: Simulation, queue: EventQueue, failure: FailureGuard, log: ThrottledLog
    ) -> None:
        self._node, self._simulation, self._queue, self._failure, self._log = node, simulation, queue, failure, log
        self._servers: list[ActionServer] = []
        self._types: dict[str, Any] = {}
        #: The goal in progress, by gripper.
        self._goals: dict[str, _Goal] = {}
        #: Goals by id until their result is sent.
        self._results: dict[bytes, _Goal] = {}
        #: Force of the cloth on each gripper in the newest frame [N].
        self._wrench_forces: list[float] = [0.0] * len(simulation.scene.gripper_names)

    def serve(self) -> None:
        """Create the action servers, or log that control_msgs is missing."""
        scene = self._simulation.scene
        kinds = {name: scene.of_gripper(name, "action") for name in scene.gripper_names}
        requested = {name: kind for name, kind in kinds.items() if kind != NO_ACTION}
        try:
            types = importlib.import_module("control_msgs.action") if requested else None
        except ImportError:
            self._node.get_logger().error(
                "gripper.action is set, and control_msgs is not installed: no goals are taken for "
                f"{', '.join(requested)}; sudo apt install ros-jazzy-control-msgs"
            )
            return
        for name, kind in requested.items():
            self._types[name] = getattr(types, kind)
            server = ActionServer(
                self._node,
                self._types[name],
                f"~/{name}/{TOPIC}",
                self._execute,
                callback_group=ReentrantCallbackGroup(),
                goal_callback=functools.partial(self._on_goal, name),
                handle_accepted_callback=functools.partial(self._on_accepted, name),
                cancel_callback=functools.partial(self._on_cancel, name),
            )
            self._servers.append(server)

    def close(self) -> None:
        """Destroy the action servers."""
        for server in self._servers:
            server.destroy()
        self._servers.clear()

    def answer(self, frame: Frame) -> None:
        """Publish, after a frame, the feedback of goals in progress, and the results of those that ended."""
        if not self._goals:
            return
        self._wrench_forces = [math.hypot(*wrench[:3]) for wrench in frame.wrenches.tolist()]
        for goal in list(self._goals.values()):
            self._advance(goal, frame)

    def fail(self, reason: str, _stamp: int) -> None:
        """Abort all goals in progress with the reason of a failed frame."""
        for goal in list(self._goals.values()):
            self._end(goal, _ABORTED, f"failed: {reason}")

    def expire(self) -> None:
        """End canceled goals that have waited more than 5 s for a frame. Call it periodically."""
        for goal in list(self._goals.values()):
            if time.monotonic() - goal.cancel_time > FRAME_TIMEOUT:
                self._end(goal, _CANCELED)

    def _on_goal(self, gripper: str, request: Any) -> GoalResponse:
        with self._failure.callback_lock:
            try:
                if self._failure.refusal:
                    raise GoalError(self._failure.refusal)
                self._simulation.check(self._grasp(gripper, self._to_command(gripper, request)))
            except (GoalError, EventError) as error:
                self._log.warn(f"goal {gripper}", f"goal for gripper '{gripper}' is rejected: {error}")
                return GoalResponse.REJECT
            return GoalResponse.ACCEPT
        return GoalResponse.REJECT

    def _on_accepted(self, gripper: str, handle: Any) -> None:
        with self._failure.callback_lock:
            if (previous := self._goals.get(gripper)) is not None:
                self._end(previous, _ABORTED, "a newer goal replaces it")
            command, done = self._to_command(gripper, handle.request), Future()
            goal = _Goal(handle, gripper, command, done, self._grasp(gripper, command))
            self._goals[gripper] = self._results[bytes(handle.goal_id.uuid)] = goal
            self._queue_grasp(goal)
        handle.execute()

    def _on_cancel(self, gripper: str, handle: Any) -> CancelResponse:
        with self._failure.callback_lock:
            goal = self._goals.get(gripper)
            if goal is None or goal.server_handle.goal_id != handle.goal_id:
                return CancelResponse.REJECT
            goal.is_canceled, goal.cancel_time = True, time.monotonic()
            if self._simulation.scene.pinches(gripper):
                goal.event = self._hold_event(gripper)
                self._queue_grasp(goal)
            else:
                # Its grasp takes one frame, which has not come yet.
                self._queue.withdraw(goal.event)
            return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    async def _execute(self, handle: Any) -> Any:
        """Await the end of an accepted goal, set its final status, and return the result message to rclpy."""
        status, result = await self._results.pop(bytes(handle.goal_id.uuid)).done
        if status == _CANCELED and handle.is_cancel_requested:
            handle.canceled()
        elif status == _SUCCEEDED:
            handle.succeed()
        else:
            handle.abort()
        return result

    def _queue_grasp(self, goal: _Goal) -> None:
        """Queue the newest grasp event of a goal; abort the goal if the event is refused, now or later."""
        event = goal.event

        def answer(outcome: EventResult) -> None:
            if outcome.frame is None and goal.event is event:
                self._end(goal, _ABORTED, outcome.reason)

        try:
            self._queue.put(event, answer=answer)
        except QueueFullError as error:
            self._end(goal, _ABORTED, str(error))

    def _advance(self, goal: _Goal, frame: Frame) -> None:
        """End a goal if a frame decided it; otherwise publish its feedback."""
        gripper, grasps = goal.gripper, [event for event in frame.events if isinstance(event, Grasp)]
        newest = [event for event in grasps if event.gripper == gripper][-1:]
        if goal.is_canceled and not self._simulation.scene.pinches(gripper):
            self._end(goal, _CANCELED)
        elif newest and newest[0] is not goal.event:
            self._end(goal, _ABORTED, "another command moved the gripper")
        elif any(isinstance(event, Reset) for event in frame.events):
            self._end(goal, _ABORTED, "reset before its end")
        elif newest and goal.is_canceled:
            self._end(goal, _CANCELED)
        elif (result := self._result(goal, frame, bool(newest))) is not None:
            self._end_grasp(goal, result)
        elif frame.moved:
            feedback = self._types[gripper].Feedback()
            self._fill(feedback, goal, stalled=False, reached=False)
            goal.server_handle.publish_feedback(feedback)

    def _result(self, goal: _Goal, frame: Frame, has_begun: bool) -> GraspResult | None:
        """Return the result of a goal's grasp if a frame completed it; otherwise None."""
        results = [result for result in frame.pinches if result.gripper == goal.gripper]
        if has_begun:
            results = [result for result in frame.grasps if result.gripper == goal.gripper and not result.pending]
            results += [result for result in frame.pinches if result.gripper == goal.gripper]
        return results[-1] if results else None

    def _end_grasp(self, goal: _Goal, grasp: GraspResult) -> None:
        """End a goal as succeeded or aborted, by the result of its grasp."""
        scene, grippers = self._simulation.scene, self._simulation.grippers
        if grasp.closed and not grippers.is_placed(grippers.names.index(goal.gripper)):
            self._end(goal, _ABORTED, grasp.reason)
            return
        is_pinching = scene.pinches(goal.gripper)
        reached = grasp.reached if is_pinching else not (grasp.closed and grasp.grasped_count)
        if reached or scene.gripper.allow_stalling:
            self._end(goal, _SUCCEEDED, reached=reached, stalled=not reached)
        else:
            self._end(goal, _ABORTED, "cloth stalls it (gripper.allow_stalling)", stalled=True)

    def _end(self, goal: _Goal, status: str, reason: str = "", *, stalled: bool = False, reached: bool = False) -> None:
        if self._goals.get(goal.gripper) is goal:
            del self._goals[goal.gripper]
        if goal.done.done():
            return
        result = self._types[goal.gripper].Result()
        self._fill(result, goal, stalled=stalled, reached=reached)
        goal.done.set_result((status, result))
        if reason:
            self._log.info(f"goal {goal.gripper} {reason}", f"goal of gripper '{goal.gripper}' is {status}: {reason}")

    def _fill(self, message: Any, goal: _Goal, *, stalled: bool, reached: bool) -> None:
        """Write the present state of a gripper into a feedback or result message of its action."""
        state = self._state(goal)
        if hasattr(message, "state"):
            joints = goal.command.joints
            message.state.header.stamp = self._node.get_clock().now().to_msg()
            message.state.name = list(joints)
            message.state.position = [state.position] * len(joints)
            message.state.velocity = [state.velocity] * len(joints)
            message.state.effort = [state.effort] * len(joints)
        else:
            message.position, message.effort = state.position, state.effort
        if hasattr(message, "stalled"):
            message.stalled, message.reached_goal = stalled, reached

    def _state(self, goal: _Goal) -> GripperJointState:
        simulation, gripper = self._simulation, goal.gripper
        closed, opened = joint_range(simulation, gripper)
        if simulation.pinching is not None and simulation.scene.pinches(gripper):
            gap, rate, force = simulation.pinching.drive_state(gripper)
            scale = (opened - closed) / simulation.scene.gripper.opening
            return GripperJointState(closed + scale * gap, scale * rate, abs(force))
        index = simulation.grippers.names.index(gripper)
        is_closed = simulation.grippers.is_closed(index)
        return GripperJointState(closed if is_closed else opened, 0.0, self._wrench_forces[index])

    def _to_command(self, gripper: str, request: Any) -> Command:
        """Convert a goal message of either action type to a command.

        Raises:
            GoalError: for a goal that the gripper can't follow.
        """
        limits = joint_range(self._simulation, gripper)
        kind = self._simulation.scene.of_gripper(gripper, "action")
        command = request.command
        if kind != PARALLEL_GRIPPER_COMMAND:
            return read_command([command.position], [command.max_effort], [], [gripper], limits)
        return read_command(command.position, command.effort, command.velocity, command.name or [gripper], limits)

    def _grasp(self, gripper: str, command: Command) -> Grasp:
        """Return the grasp event that executes a command."""
        scene, pinching = self._simulation.scene, self._simulation.pinching
        if pinching is None or not scene.pinches(gripper):
            return Grasp(gripper, command.fraction < 0.5)
        closed, opened = joint_range(self._simulation, gripper)
        opening = command.fraction * scene.gripper.opening
        # Half of the rate of the opening: each pad moves half of the way.
        speed = 0.5 * command.speed * scene.gripper.opening / abs(opened - closed)
        gap = pinching.drive_state(gripper)[0]
        if command.fraction in (0.0, 1.0):
            closes = not command.fraction
        elif opening == 2.0 * pinching.setpoint(gripper)[0]:
            closes = self._is_closed(gripper)
        else:
            closes = opening < gap
        return Grasp(gripper, closes, opening, command.force, max(speed, MIN_PAD_SPEED) if speed else 0.0)

    def _hold_event(self, gripper: str) -> Grasp:
        """Return the grasp event that stops pads at their present opening."""
        pinching, scene = self._simulation.pinching, self._simulation.scene
        assert pinching is not None
        _, force, speed = pinching.setpoint(gripper)
        gap = min(max(pinching.drive_state(gripper)[0], 0.0), scene.gripper.opening)
        return Grasp(gripper, self._is_closed(gripper), gap, force, speed)

    def _is_closed(self, gripper: str) -> bool:
        grippers = self._simulation.grippers
        return grippers.is_closed(grippers.names.index(gripper))


def joint_range(simulation: Simulation, gripper: str) -> tuple[float, float]:
    """Return a gripper's joint positions, closed and open [rad or m]; 0 and the opening if `joint_range` is not set."""
    closed, opened = simulation.scene.of_gripper(gripper, "joint_range")
    return (closed, opened) if closed != opened else (0.0, simulation.scene.gripper.opening)


def read_command(
    positions: Sequence[float],
    efforts: Sequence[float],
    velocities: Sequence[float],
    joints: Sequence[str],
    limits: tuple[float, float],
) -> Command:
    """Convert positions, efforts and velocities of a goal to a command; GoalError if they are invalid.

    Args:
        positions: position of each joint, all equal.
        efforts: largest force of each [N]; none, 0 or less for no limit.
        velocities: largest speed of each; none or 0 for no limit.
        joints: names of the joints; the last one counts for further positions.
        limits: position of the closed and of the open gripper.

    Raises:
        GoalError: for positions that are missing, differ or are out of range, and for numbers that are not finite.
    """
    closed, opened = limits
    if not len(positions):
        raise GoalError("it has no position; give one for each joint")
    if not all(map(math.isfinite, (*positions, *efforts, *velocities))):
        raise GoalError("it has numbers that are not finite")
    position, tolerance = float(positions[0]), _POSITION_TOLERANCE * abs(opened - closed)
    if any(abs(p - position) > tolerance for p in positions):
        raise GoalError(f"its positions {list(positions)} differ; the pads of a parallel gripper move alike")
    if not min(limits) - tolerance <= position <= max(limits) + tolerance:
        raise GoalError(
            f"its position is {position:g}; it must be from {closed:g} (closed) to {opened:g} (open): set "
            "gripper.joint_range to the range of the robot's joint"
        )
    fraction = min(max((position - closed) / (opened - closed), 0.0), 1.0)
    names = [joints[min(k, len(joints) - 1)] for k in range(len(positions))]
    force = max(map(float, efforts), default=0.0)
    return Command(fraction, max(force, 0.0), max((abs(float(v)) for v in velocities), default=0.0), tuple(names))
