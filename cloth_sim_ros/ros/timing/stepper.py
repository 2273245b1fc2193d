# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stepper: advances the simulation by frames with the due events.

A failure is reported and does not end the node.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import attrs

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.ros.process.stopping import StopRequestedError
from cloth_sim_ros.ros.process.worker_thread import run_inline
from cloth_sim_ros.ros.timing.event_queue import EventQueue, EventResult, QueuedEvent
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Pause, Reset, SetParameters, Step
from cloth_sim_ros.simulation.simulation import Frame, Simulation


class Stepper:
    """Computation of the simulation's frames with the events that wait in a queue.

    Args:
        simulation: the cloth.
        queue: events that wait for a frame.
        run_job: runs a long computation and returns its result; may raise StopRequestedError and abandon it.
    """

    def __init__(
        self, simulation: Simulation, queue: EventQueue, *, run_job: Callable[[Callable[[], Any]], Any] = run_inline
    ) -> None:
        self.simulation, self.queue, self.run_job = simulation, queue, run_job
        #: True if a signal came before a frame ended. The frame goes on, and the cloth must not be read.
        self.aborted = False
        #: The reason if time is stopped; otherwise empty.
        self.trouble = ""
        #: The reason if accepted parameters could not take effect in the newest frame; otherwise empty.
        self.refused_parameters = ""
        #: Events of the frame without an answer yet.
        self._entries: list[QueuedEvent] = []
        self._results: list[tuple[QueuedEvent, EventResult]] = []

    def advance(
        self,
        stamp: int,
        first: Sequence[Event] = (),
        *,
        last: Sequence[Event] = (),
        build_reset: Callable[[Scene, bool], Reset] | None = None,
    ) -> Frame | None:
        """Compute the frame due at a ROS time [ns] with its queued events; None if aborted. Instability sets `trouble`.

        Args:
            stamp: ROS time [ns]; events with later stamps stay in the queue.
            first: events of the node itself, applied first.
            last: events of the node itself, applied last.
            build_reset: returns the event that replaces a queued reset, by the scene at the reset and whether it must
                succeed; None applies resets as they are.

        If the motion becomes unstable, the commands take effect but no time passes. `trouble` holds the reason, and so
        does the answer to a service that requested time to pass.
        """
        self._results = []
        self._entries = entries = self.queue.pop_ready(stamp)
        if build_reset is not None:
            self._entries = entries = self._replace_resets(entries, build_reset)
        if first or last:
            before, after = ([QueuedEvent(event=event) for event in events] for events in (first, last))
            entries = [*before, *entries, *after]
        self.refused_parameters = ""
        refused: list[tuple[QueuedEvent, str]] = []
        stopped = False
        while True:
            try:
                frame = self._advance(entries)
                break
            except StopRequestedError:
                self.aborted = True
                return None
            except (UnstableError, ValueError) as error:
                changes = [entry for entry in entries if isinstance(entry.event, SetParameters)]
                without_changes = [entry for entry in entries if not isinstance(entry.event, SetParameters)]
                event = error.event if isinstance(error, EventError) else None
                if any(entry.event is event for entry in without_changes):
                    # For example, an accepted event addresses an obstacle that was removed meanwhile.
                    refused += [(entry, str(error)) for entry in without_changes if entry.event is event]
                    entries = [entry for entry in entries if entry.event is not event]
                elif changes and (stopped or isinstance(error, ValueError)):
                    # Each value passed its own check, but together, or with this motion, they fail. The parameters
                    # are refused; the other events take effect.
                    self.refused_parameters = str(error)
                    refused += [(entry, str(error)) for entry in changes]
                    entries = without_changes
                elif isinstance(error, UnstableError) and not stopped:
                    stopped, self.trouble = True, str(error)
                    # Drop events that let time pass: the same step would fail again within this frame.
                    refused += [(entry, f"time is stopped: {error}") for entry in entries if _lets_time_pass(entry)]
                    entries = [entry for entry in entries if not _lets_time_pass(entry)]
                    entries.append(QueuedEvent(event=Pause(True)))
                else:
                    raise
        if frame.moved:
            self.trouble = ""
        self._results = _event_results(entries, frame)
        self._results += [(entry, EventResult(frame=None, reason=reason)) for entry, reason in refused]
        return None if self.aborted else frame

    def answer(self) -> None:
        """Call the answer callbacks of the newest frame's events with their results, once."""
        results, self._results, self._entries = self._results, [], []
        for entry, result in results:
            if entry.answer is not None:
                entry.answer(result)

    def refuse(self, reason: str) -> None:
        """Call the answer callbacks of the newest frame's events, once, with the reason why the frame failed."""
        self._results = [(entry, EventResult(frame=None, reason=reason)) for entry in self._entries]
        self.answer()

    def _replace_resets(
        self, entries: list[QueuedEvent], build_reset: Callable[[Scene, bool], Reset]
    ) -> list[QueuedEvent]:
        """Return queued events, each reset replaced by the one for the scene at that time."""
        if not any(isinstance(entry.event, Reset) for entry in entries):
            return entries
        scene, result = self.simulation.scene, list[QueuedEvent]()
        for entry in entries:
            event = entry.event
            if isinstance(event, SetParameters):
                # A value that does not fit is refused later.
                with suppress(ValueError):
                    scene = scene.changed(event.values)
            elif isinstance(event, Reset):
                # Nobody hears that a reset of the node itself is refused.
                event = build_reset(scene, entry.answer is None)
            result.append(attrs.evolve(entry, event=event))
        return result

    def _advance(self, entries: list[QueuedEvent]) -> Frame:
        if not entries and self.simulation.will_stay_asleep:
            return self.simulation.advance()
        frame: Frame = self.run_job(lambda: self.simulation.advance([entry.event for entry in entries]))
        return frame


def _lets_time_pass(entry: QueuedEvent) -> bool:
    return isinstance(entry.event, Step) or (isinstance(entry.event, Pause) and not entry.event.paused)


def _event_results(entries: list[QueuedEvent], frame: Frame) -> list[tuple[QueuedEvent, EventResult]]:
    # Grasps keep their order through the frame: the k-th result belongs to the k-th grasp.
    results = iter(frame.grasps)
    return [
        (entry, EventResult(frame=frame, grasp=next(results) if isinstance(entry.event, Grasp) else None))
        for entry in entries
    ]
