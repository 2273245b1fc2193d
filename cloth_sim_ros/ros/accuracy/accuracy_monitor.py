# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Accuracy monitor.

A worker process integrates windows of a second again with finer steps. The node keeps the state at the start of a
window and its events. Threads send the windows and receive the errors. If the worker lags, whole windows are skipped
and counted.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import queue
import subprocess
import threading
from typing import IO, Any

import attrs

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.child_process import child_environment, module_command
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.simulation import Frame, Simulation

_WORKER_MODULE = "cloth_sim_ros.verify.accuracy_worker"
#: Length of a window [s].
_WINDOW_LENGTH = 1.0
#: Longest wait for the end of a killed process [s].
_KILL_TIMEOUT = 1.0


@attrs.frozen(eq=False)
class _WindowJob:
    """A window: scene, start state, events and end state."""

    scene: Scene
    start: State
    events: list[tuple[Event, ...]]
    end: State


class AccuracyMonitor:
    """Starts the worker process without waiting for it, sends it windows and collects their errors."""

    def __init__(self) -> None:
        self._jobs: queue.Queue[_WindowJob | None] = queue.Queue(maxsize=1)
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = threading.Event()
        self._scene: Scene | None = None
        self._start: State | None = None
        self._events: list[tuple[Event, ...]] = []
        self._n_moved = 0
        # Each is written by one of the threads and read by others.
        self._ended = ""
        self._latest: dict[str, Any] = {}
        self._n_windows = self._n_violated = 0
        self._warnings: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._n_skipped = 0
        #: A window is sent after the previous one was answered; a pipe would buffer a minute of them.
        self._ready = threading.Semaphore(1)
        threading.Thread(target=self._run_worker, name="accuracy", daemon=True).start()

    def before_frame(self, simulation: Simulation) -> None:
        """Start a window if none is open."""
        if self._start is None and not self._ended:
            self._scene, self._start = simulation.scene, simulation.state.shallow_copy()
            self._events, self._n_moved = [], 0

    def after_frame(self, simulation: Simulation, frame: Frame) -> None:
        """Add a frame to the window, and pass the window on when it is complete."""
        if self._start is None or self._scene is None or not (frame.moved or frame.events):
            return
        self._events.append(frame.events)
        self._n_moved += frame.moved
        if self._n_moved * self._scene.period < _WINDOW_LENGTH * (1.0 - 1e-9):
            return
        job = _WindowJob(self._scene, self._start, self._events, simulation.state.shallow_copy())
        self._start = None
        # At most one window waits for the process. A new one replaces an older one that still waits.
        with contextlib.suppress(queue.Empty):
            self._jobs.get_nowait()
            self._n_skipped += 1
        self._jobs.put_nowait(job)

    def describe(self, now: float) -> dict[str, str]:
        """Return the entries for diagnostics at a simulated time [s]."""
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
        """Return and clear the warnings since the last call."""
        warnings = []
        while not self._warnings.empty():
            warnings.append(self._warnings.get_nowait())
        return warnings

    def close(self) -> None:
        """End the process."""
        self._closed.set()
        process = self._process
        if process is not None:
            process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_KILL_TIMEOUT)
        # No frame comes any more: only the thread takes from the queue.
        with contextlib.suppress(queue.Empty):
            self._jobs.get_nowait()
        self._jobs.put_nowait(None)

    def _run_worker(self) -> None:
        """Start the process and send it windows, in a thread because both may block."""
        # Not in the terminal's process group: Ctrl-C ends the node, and the node ends the process.
        try:
            process = subprocess.Popen(
                module_command(_WORKER_MODULE, str(os.getpid())),
                env=child_environment(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:
            self._end(f"could not be started: {error}")
            return
        self._process = process
        if self._closed.is_set():
            process.kill()
        assert process.stdin is not None and process.stdout is not None
        threading.Thread(
            target=self._read_verdicts, args=(process, process.stdout), name="accuracy", daemon=True
        ).start()
        # If the process has ended, the reading thread reports it.
        with contextlib.suppress(OSError), process.stdin:
            self._send_windows(process.stdin)

    def _send_windows(self, windows: IO[bytes]) -> None:
        """Send windows until the monitor is closed."""
        sent_scene: Scene | None = None
        while True:
            self._ready.acquire()
            job = self._jobs.get()
            if job is None or self._ended:
                return
            new = job.scene is not sent_scene
            sent_scene = job.scene
            values, files = (sent_scene.parameters(), dict(sent_scene.files)) if new else (None, None)
            pickle.dump((values, files, job.start, job.events, job.end.digest()), windows)
            windows.flush()

    def _read_verdicts(self, process: subprocess.Popen[bytes], lines: IO[bytes]) -> None:
        with lines:
            for line in lines:
                self._receive(json.loads(line))
                self._ready.release()
        self._end(f"ended by itself (status {process.wait()})")
        self._ready.release()

    def _receive(self, verdict: dict[str, Any]) -> None:
        if "trouble" in verdict:
            self._warnings.put(f"the accuracy of a window is not known: {verdict['trouble']}")
            return
        self._n_windows += 1
        if verdict["verdict"] == "not kept":
            self._n_violated += 1
            self._warnings.put(
                f"from {verdict['start']:.3f} to {verdict['end']:.3f} s the error of positions is "
                f"{verdict['error']:.3g} m, above the bound of {verdict['allowed']:.3g} m that the tolerance guarantees"
            )
        self._latest = verdict

    def _end(self, reason: str) -> None:
        if not self._closed.is_set():
            self._ended = f"{reason}; set diagnostics.accuracy to false and true again to restart it"
            self._warnings.put(f"the process that measures accuracy {self._ended}")
