# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services of the node.

Requests that change the cloth are queued as events and answered after their frame.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from cloth_sim_ros.ros.event_queue import EventQueue, Outcome, QueueFullError
from cloth_sim_ros.ros.recording import RecordingUnavailableError
from cloth_sim_ros.session.words import counted
from cloth_sim_ros.simulation.events import Event, Grasp, Pause, Reset, Step
from cloth_sim_ros.simulation.grippers import GraspResult
from cloth_sim_ros.simulation.simulation import Frame

#: Longest wait of a request for its frame [s].
PATIENCE = 5.0
#: Longest wait of a request for closing pads [s].
CLOSING_PATIENCE = 30.0


class Services:
    """Services of one cloth; `serve` creates them.

    Args:
        node: the node.
        grippers: names of the grippers.
        queue: receives the events.
        paused: returns true while time is paused.
        record: starts (True) or ends a recording, and calls a function with success and a message.
        save_state: writes the state and returns its file, or raises RecordingUnavailableError.
        seconds: monotonic clock [s].
        lock: protects the cloth; with several executor threads, services run concurrently with frames.
        refusal: returns why only a reset is possible; empty if all requests are.
    """

    def __init__(
        self,
        node: Node,
        *,
        grippers: list[str],
        queue: EventQueue,
        paused: Callable[[], bool],
        record: Callable[[bool, Callable[[bool, str], None]], None],
        save_state: Callable[[], Path],
        seconds: Callable[[], float],
        turn: AbstractContextManager[Any],
        refusal: Callable[[], str] = str,
    ) -> None:
        self._node = node
        self._refusal = refusal
        self._grippers = grippers
        self._queue = queue
        self._paused = paused
        self._record = record
        self._save_state = save_state
        self._seconds = seconds
        self._turn = turn
        self._waiting: list[tuple[float, Future]] = []
        #: Grippers whose pads are closing: name, start time [s], and the future of the result.
        self._closing: list[tuple[str, float, Future]] = []

    def serve(self) -> None:
        """Create the services. From then on every request is answered."""
        # A request that waits for its frame must not block the frame.
        group = ReentrantCallbackGroup()
        for kind, name, handle in (
            (Trigger, "~/reset", self._on_reset),
            (SetBool, "~/pause", self._on_pause),
            (Trigger, "~/step", self._on_step),
            (SetBool, "~/record", self._on_record),
            (Trigger, "~/save_state", self._on_save_state),
        ):
            self._node.create_service(kind, name, handle, callback_group=group)
        for gripper in self._grippers:
            self._node.create_service(
                SetBool, f"~/{gripper}/close", functools.partial(self._on_close, gripper), callback_group=group
            )

    def give_up_waiting(self) -> None:
        """Answer requests that have waited too long. Call it periodically."""
        now = self._seconds()
        for asked, future in self._waiting:
            if now - asked > PATIENCE and not future.done():
                future.set_result(
                    Outcome(
                        frame=None,
                        reason=f"no frame was due within {PATIENCE:g} s: /clock stands still; the next one applies it",
                    )
                )
        self._waiting = [entry for entry in self._waiting if not entry[1].done()]
        for gripper, asked, future in self._closing:
            if now - asked > CLOSING_PATIENCE:
                reason = f"its pads still close after {CLOSING_PATIENCE:g} s; ~/{gripper}/state reports their grasp"
                future.set_result(GraspResult(gripper, True, 0, reason))
        self._closing = [entry for entry in self._closing if not entry[2].done()]

    def show(self, frame: Frame) -> None:
        """Answer requests whose pads came to rest in a frame, or were opened or reset."""
        if not self._closing:
            return
        became = {grasp.gripper: grasp for grasp in frame.grasps}
        stopped = {name: "opened" for name, grasp in became.items() if not grasp.closed}
        if any(isinstance(event, Reset) for event in frame.events):
            stopped |= {name: "reset" for name in self._grippers if name not in became}
        done = {
            name: GraspResult(name, True, 0, f"{what} before its pads came to rest") for name, what in stopped.items()
        }
        done |= {result.gripper: result for result in frame.pinches}
        for gripper, _, future in self._closing:
            if gripper in done:
                future.set_result(done[gripper])
        self._closing = [entry for entry in self._closing if not entry[2].done()]

    def fail(self, reason: str, _stamp: int) -> None:
        """Answer the requests that wait for pads, because a frame failed."""
        closing, self._closing = self._closing, []
        for gripper, _, future in closing:
            future.set_result(GraspResult(gripper, True, 0, f"failed: {reason}"))

    async def _ask(self, event: Event, *, rest: Future | None = None) -> Outcome:
        """Queue an event and wait for its frame.

        Args:
            event: the event.
            rest: future of the result if the event starts to close pads.
        """
        future: Future = Future()

        def answer(outcome: Outcome) -> None:
            if rest is not None and outcome.grasp is not None and outcome.grasp.pending:
                self._closing.append((outcome.grasp.gripper, self._seconds(), rest))
            if not future.done():
                future.set_result(outcome)

        with self._turn:
            refusal = "" if isinstance(event, Reset) else self._refusal()
            if refusal:
                return Outcome(frame=None, reason=refusal)
            try:
                self._queue.put(event, answer=answer)
            except QueueFullError as error:
                return Outcome(frame=None, reason=str(error))
            self._waiting.append((self._seconds(), future))
        outcome: Outcome = await future
        return outcome

    async def _on_reset(self, _request: Any, response: Any) -> Any:
        return _answered(response, await self._ask(Reset()), "reset")

    async def _on_pause(self, request: Any, response: Any) -> Any:
        done = "paused" if request.data else "running"
        return _answered(response, await self._ask(Pause(bool(request.data))), done)

    async def _on_step(self, _request: Any, response: Any) -> Any:
        with self._turn:
            refusal = self._refusal() or ("" if self._paused() else "the cloth is running; pause it first")
        if refusal:
            response.success, response.message = False, refusal
            return response
        return _answered(response, await self._ask(Step()), "one frame passed")

    async def _on_close(self, gripper: str, request: Any, response: Any) -> Any:
        rest: Future = Future()
        outcome = await self._ask(Grasp(gripper, bool(request.data)), rest=rest)
        grasp = outcome.grasp
        if grasp is None:
            return _answered(response, outcome, "")
        if grasp.pending:
            grasp = await rest
        # Closing on nothing is no success.
        response.success = bool(grasp.held) if grasp.closed else True
        response.message = f"holds {counted(grasp.held, 'particle')}" + (f": {grasp.reason}" if grasp.reason else "")
        return response

    async def _on_record(self, request: Any, response: Any) -> Any:
        future: Future = Future()
        with self._turn:
            self._record(bool(request.data), lambda success, message: future.set_result((success, message)))
        response.success, response.message = await future
        return response

    def _on_save_state(self, _request: Any, response: Any) -> Any:
        try:
            with self._turn:
                response.message = str(self._save_state())
        except RecordingUnavailableError as error:
            response.success, response.message = False, f"cannot save the state: {error}"
        else:
            response.success = True
        return response


def _answered(response: Any, outcome: Outcome, done: str) -> Any:
    response.success = outcome.frame is not None
    response.message = outcome.reason if outcome.frame is None else f"{done}, frame {outcome.frame.index}"
    return response
