# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Accuracy monitor.

A worker process integrates windows of a second again with finer steps. The node keeps the state at the start of a
window and its events. Threads send the windows and receive the errors. If the worker lags, whole windows are skipped
and counted.
"""

from __future__ import annotations

import queue
from typing import Any

import attrs

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.ros.process.worker_process import WorkerProcess
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.simulation import Frame, Simulation

_WORKER_MODULE = "cloth_sim_ros.verify.accuracy_worker"
#: Length of a window [s].
_WINDOW_LENGTH = 1.0


@attrs.frozen(eq=False)
class _WindowJob:
    """Job of the worker process: scene, start state, events of each frame and end state of one simulated window."""

    scene: Scene
    start: State
    events: list[tuple[Event, ...]]
    end: State


class AccuracyMonitor:
    """Monitor of a live cloth's true error: its worker process integrates windows of 1 s again with finer steps."""

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._start: State | None = None
        self._events: list[tuple[Event, ...]] = []
        self._n_moved = 0
        #: Scene that the process has; used by the sending thread.
        self._sent_scene: Scene | None = None
        # Each is written by one of the process's threads and read by others.
        self._ended = ""
        self._latest: dict[str, Any] = {}
        self._n_windows = self._n_violated = 0
        self._warnings: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._n_skipped = 0
        self._process: WorkerProcess[_WindowJob] = WorkerProcess(
            _WORKER_MODULE, name="accuracy", encode=self._encode, on_answer=self._receive, on_end=self._end
        )

    def before_frame(self, simulation: Simulation) -> None:
        """Copy the cloth's state as the start of a new window, unless one is open or the worker has ended."""
        if self._start is None and not self._ended:
            self._scene, self._start = simulation.scene, simulation.state.shallow_copy()
            self._events, self._n_moved = [], 0

    def after_frame(self, simulation: Simulation, frame: Frame) -> None:
        """Add a frame's events to the open window; queue it for the worker at 1 s of motion; replace an unsent one."""
        if self._start is None or self._scene is None or not (frame.moved or frame.events):
            return
        self._events.append(frame.events)
        self._n_moved += frame.moved
        if self._n_moved * self._scene.period < _WINDOW_LENGTH * (1.0 - 1e-9):
            return
        job = _WindowJob(self._scene, self._start, self._events, simulation.state.shallow_copy())
        self._start = None
        if self._process.put(job) is not None:
            self._n_skipped += 1

    def describe(self, now: float) -> dict[str, str]:
        """Return diagnostics entries: worker state, window counts, newest error and bound [m], lag behind `now` [s]."""
        latest = self._latest
        state = self._ended or ("running" if latest else "starting")
        values = {
            "accuracy": state,
            "accuracy_windows": str(self._n_windows),
            "accuracy_windows_violated": str(self._n_violated),
            "accuracy_windows_skipped": str(self._n_skipped),
        }
        if latest:
            allowed = latest["allowed"]
            values |= {
                "accuracy_window_s": f"{latest['start']:.3f} to {latest['end']:.3f}",
                "accuracy_error_m": f"{latest['error']:.3g}",
                "accuracy_bound_m": "none" if allowed is None else f"{allowed:.3g}",
                "accuracy_uncertainty_m": f"{latest['uncertainty']:.3g}",
                "accuracy_verdict": latest["verdict"],
                "accuracy_lag_s": f"{max(0.0, now - latest['end']):.3f}",
            }
        return values

    def take_warnings(self) -> list[str]:
        """Return the warnings since the last call, e.g. of windows above the error bound, and clear them."""
        warnings = []
        while not self._warnings.empty():
            warnings.append(self._warnings.get_nowait())
        return warnings

    def close(self) -> None:
        """Kill the worker process that measures the error, and wait at most 1 s for its end."""
        self._process.close()

    def _encode(self, job: _WindowJob) -> tuple[Any, ...]:
        """Return what is pickled for the worker: scene values and files (None if known), start, events, end digest."""
        new = job.scene is not self._sent_scene
        self._sent_scene = job.scene
        values, files = (job.scene.parameters(), dict(job.scene.files)) if new else (None, None)
        return values, files, job.start, job.events, job.end.digest()

    def _receive(self, verdict: dict[str, Any]) -> bool:
        """Store and count a window's verdict, or its failure, from the worker; return true: the worker is ready."""
        if "trouble" in verdict:
            self._warnings.put(f"the accuracy of a window is not known: {verdict['trouble']}")
            return True
        self._n_windows += 1
        if verdict["verdict"] == "not kept":
            self._n_violated += 1
            self._warnings.put(
                f"from {verdict['start']:.3f} to {verdict['end']:.3f} s the error of positions is "
                f"{verdict['error']:.3g} m, above the bound of {verdict['allowed']:.3g} m that the tolerance guarantees"
            )
        self._latest = verdict
        return True

    def _end(self, reason: str) -> None:
        self._ended = f"{reason}; set diagnostics.accuracy to false and true again to restart it"
        self._warnings.put(f"the process that measures accuracy {self._ended}")
