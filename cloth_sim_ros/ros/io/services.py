# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services of the node.

Requests that change the cloth are queued as events and answered after their frame.
"""

from __future__ import annotations

import functools
import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from cloth_sim_ros.ros.process.failure import FailureGuard
from cloth_sim_ros.ros.recording.recording import RecordingUnavailableError
from cloth_sim_ros.ros.recording.recording_control import RecordingControl
from cloth_sim_ros.ros.timing.event_queue import EventResult, QueueFullError
from cloth_sim_ros.ros.timing.frame_timing import FrameTiming
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.bodies.grippers import GraspResult
from cloth_sim_ros.simulation.events import Event, Grasp, Pause, Reset, Step
from cloth_sim_ros.simulation.simulation import Frame

#: Longest wait of a request for its frame [s], besides a period of wall time.
FRAME_TIMEOUT = 5.0
#: Longest wait of a request for closing pads [s].
CLOSING_TIMEOUT = 30.0


class Services:
    """Servers of reset, pause, step, record, save_state and the grippers' close; `serve` creates them.

    Args:
        node: the node.
        timing: its stepper's queue receives the events.
        recording: starts and ends recordings, and saves states.
        failure: gives the reason why only a reset is possible. Its lock protects the cloth: with several executor
            threads, services run concurrently with frames.
    """

    def __init__(self, node: Node, timing: FrameTiming, recording: RecordingControl, failure: FailureGuard) -> None:
        self._node, self._recording, self._failure, self._lock = node, recording, failure, failure.lock
        self._queue, self._clock_pause = timing.stepper.queue, timing.clock_pause
        #: Longest wait of a request for its frame [s], and the cause of a longer one with the result.
        self._frame_timeout, self._delay_cause = FRAME_TIMEOUT, "/clock stands still; the next one applies it"
        if not timing.follows_clock:
            self._frame_timeout += timing.stepper.simulation.scene.period
            self._delay_cause = "frames are late; the next one applies it"
        self._grippers = timing.stepper.simulation.scene.gripper_names
        self._pending: list[tuple[float, Future]] = []
        #: Number of requests to pause, resume or reset; each ends a request of several steps.
        self.n_interrupting = 0
        #: Grippers whose pads are closing: name, start time [s], and the future of the result.
        self._closing: list[tuple[str, float, Future]] = []

    def serve(self) -> None:
        """Create the services. From then on every request is answered."""
        # A request that waits for its frame must not block the frame.
        group = ReentrantCallbackGroup()
        for kind, name, callback in (
            (Trigger, "~/reset", self._on_reset),
            (SetBool, "~/pause", self._on_pause),
            (Trigger, "~/step", self._on_step),
            (SetBool, "~/record", self._on_record),
            (Trigger, "~/save_state", self._on_save_state),
        ):
            self._node.create_service(kind, name, callback, callback_group=group)
        for gripper in self._grippers:
            self._node.create_service(
                SetBool, f"~/{gripper}/close", functools.partial(self._on_close, gripper), callback_group=group
            )

    @property
    def user_paused(self) -> bool:
        """True if the user paused the cloth, regardless of /clock."""
        return self._clock_pause.user_paused

    def expire_requests(self) -> None:
        """Answer requests that waited too long, about 5 s for a frame or 30 s for pads. Call it periodically."""
        now = time.monotonic()
        for start, future in self._pending:
            if now - start > self._frame_timeout and not future.done():
                reason = f"no frame was due within {self._frame_timeout:g} s: {self._delay_cause}"
                future.set_result(EventResult(frame=None, reason=reason))
        self._pending = [entry for entry in self._pending if not entry[1].done()]
        for gripper, start, future in self._closing:
            if now - start > CLOSING_TIMEOUT:
                reason = f"its pads still close after {CLOSING_TIMEOUT:g} s; ~/{gripper}/state reports their grasp"
                future.set_result(GraspResult(gripper, True, 0, reason))
        self._closing = [entry for entry in self._closing if not entry[2].done()]

    def answer_grasps(self, frame: Frame) -> None:
        """Answer requests to close pads that came to rest in a frame, or were opened or reset."""
        if not self._closing:
            return
        grasps = {grasp.gripper: grasp for grasp in frame.grasps}
        stopped = {name: "opened" for name, grasp in grasps.items() if not grasp.closed}
        if any(isinstance(event, Reset) for event in frame.events):
            stopped |= {name: "reset" for name in self._grippers if name not in grasps}
        results = {
            name: GraspResult(name, True, 0, f"{cause} before its pads came to rest") for name, cause in stopped.items()
        }
        results |= {result.gripper: result for result in frame.pinches}
        for gripper, _, future in self._closing:
            if gripper in results:
                future.set_result(results[gripper])
        self._closing = [entry for entry in self._closing if not entry[2].done()]

    def fail(self, reason: str, _stamp: int) -> None:
        """Answer the requests that wait for pads with the reason why a frame failed."""
        closing, self._closing = self._closing, []
        for gripper, _, future in closing:
            future.set_result(GraspResult(gripper, True, 0, f"failed: {reason}"))

    async def enqueue(self, event: Event, *, pads_result: Future | None = None) -> EventResult:
        """Queue an event and await its frame; return its result, or why it took no effect, without raising.

        Args:
            event: the event.
            pads_result: future of the result if the event starts to close pads.
        """
        future: Future = Future()

        def answer(outcome: EventResult) -> None:
            if pads_result is not None and outcome.grasp is not None and outcome.grasp.pending:
                self._closing.append((outcome.grasp.gripper, time.monotonic(), pads_result))
            if not future.done():
                future.set_result(outcome)

        with self._lock:
            if isinstance(event, Pause | Reset):
                self.n_interrupting += 1
            refusal = "" if isinstance(event, Reset) else self._failure.refusal
            if refusal:
                return EventResult(frame=None, reason=refusal)
            try:
                self._queue.put(event, answer=answer)
            except QueueFullError as error:
                return EventResult(frame=None, reason=str(error))
            self._pending.append((time.monotonic(), future))
        result: EventResult = await future
        return result

    async def _on_reset(self, _request: Any, response: Any) -> Any:
        return _fill_response(response, await self.enqueue(Reset()), "reset")

    async def _on_pause(self, request: Any, response: Any) -> Any:
        done = "paused" if request.data else "running"
        return _fill_response(response, await self.enqueue(Pause(bool(request.data))), done)

    async def _on_step(self, _request: Any, response: Any) -> Any:
        with self._lock:
            refusal = self._failure.refusal or (
                "" if self._clock_pause.user_paused else "the cloth is running; pause it first"
            )
        if refusal:
            response.success, response.message = False, refusal
            return response
        return _fill_response(response, await self.enqueue(Step()), "one frame passed")

    async def _on_close(self, gripper: str, request: Any, response: Any) -> Any:
        pads_result: Future = Future()
        result = await self.enqueue(Grasp(gripper, bool(request.data)), pads_result=pads_result)
        grasp = result.grasp
        if grasp is None:
            return _fill_response(response, result, "")
        if grasp.pending:
            grasp = await pads_result
        # Closing on nothing is no success.
        response.success = bool(grasp.grasped_count) if grasp.closed else True
        cause = f": {grasp.reason}" if grasp.reason else ""
        response.message = f"holds {pluralize(grasp.grasped_count, 'particle')}{cause}"
        return response

    async def _on_record(self, request: Any, response: Any) -> Any:
        future: Future = Future()
        with self._lock:
            self._recording.switch(bool(request.data), lambda success, message: future.set_result((success, message)))
        response.success, response.message = await future
        return response

    def _on_save_state(self, _request: Any, response: Any) -> Any:
        try:
            with self._lock:
                response.message = str(self._recording.session.save_state())
        except RecordingUnavailableError as error:
            response.success, response.message = False, f"cannot save the state: {error}"
        else:
            response.success = True
        return response


def _fill_response(response: Any, result: EventResult, done: str) -> Any:
    response.success = result.frame is not None
    response.message = result.reason if result.frame is None else f"{done}, frame {result.frame.index}"
    return response
