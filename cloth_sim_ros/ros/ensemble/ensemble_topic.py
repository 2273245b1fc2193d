# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node's part of its ensemble: passes frames on to the ensemble process, and publishes ~/ensemble.

No call waits for the process. It answers with the newest frame that it has reached, so that a slow one leaves frames
out.
"""

from __future__ import annotations

import base64
import collections
import contextlib
import queue
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.ros.ensemble.ensemble_jobs import EnsembleStart, EnsembleStep
from cloth_sim_ros.ros.io.output import NEWEST_QOS, Output, RecordSink
from cloth_sim_ros.ros.process.worker_process import WorkerProcess
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Frame, Simulation

_WORKER_MODULE = "cloth_sim_ros.ros.ensemble.ensemble_worker"
#: Age of a frame from which it is not published any more [ns]: below the second that a recorder takes for a clock's
#: jump.
_MAX_AGE = 900_000_000
#: Simulated time of the frames that may wait for the process; then the ensemble restarts [s].
_MAX_BACKLOG = 60.0
#: Simulated time until the ensemble restarts after a member failed [s].
_RESTART_DELAY = 1.0


class EnsembleTopic:
    """Publisher of ~/ensemble: mean and deviation of an ensemble that a child process runs beside the cloth.

    Args:
        node: the node.
        simulation: the cloth.
        sink: records the messages.
        log: receives warnings.

    Raises:
        ParameterError: if the distribution does not fit the scene.
    """

    def __init__(self, node: Node, simulation: Simulation, sink: RecordSink, log: ThrottledLog) -> None:
        self._simulation, self._log = simulation, log
        scene = simulation.scene
        distribution = scene.distribution()
        distribution.check_members(scene, scene.ensemble.members, scene.ensemble.seed)
        for note in (*distribution.notes, *distribution.differences(scene)):
            log.info(f"ensemble {note}", f"ensemble.file '{scene.ensemble.file}': {note}")
        self._output = Output(node, PointCloud2, "~/ensemble", sink, qos=NEWEST_QOS, droppable=True)
        self._process: WorkerProcess[bool] | None = None
        #: Frames for the process; its sending thread takes them.
        self._steps: collections.deque[EnsembleStep] = collections.deque()
        #: True if the members start in the next frame; the cloth before that frame.
        self._must_start = True
        self._before: tuple[Scene, State] | None = None
        self._next_start = 0
        #: Index of the newest frame, and of the one at which the members started.
        self._newest = self._started = 0
        self._n_starts = self._n_published = self._n_skipped = 0
        #: Number of answers since the last one that was published.
        self._n_late = 0
        # Each is written by one of the process's threads and read by others.
        self._state = "starting"
        self._latest: dict[str, Any] = {}
        self._answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._ends: queue.SimpleQueue[str] = queue.SimpleQueue()

    def start(self) -> None:
        """Start the ensemble process without waiting for it."""
        self._process = WorkerProcess(
            _WORKER_MODULE, name="ensemble", encode=self._encode, on_answer=self._receive, on_end=self._end
        )

    def before_frame(self) -> None:
        """Copy the cloth's state if the members may start in the next frame."""
        simulation = self._simulation
        if self._must_start and self._is_alive and simulation.frame >= self._next_start:
            self._before = simulation.scene, simulation.state.shallow_copy()

    def record_extras(self, frame: Frame) -> dict[str, Any]:
        """Return {'ensemble': 'start'} for a frame's record if the members start with this frame; otherwise {}."""
        starts = self._before is not None and self._is_alive and _has_effect(frame)
        return {"ensemble": "start"} if starts else {}

    def add(self, frame: Frame, stamp: int) -> None:
        """Queue a frame due at a ROS time [ns] for the process; restart the ensemble if over 60 s of frames wait."""
        if self._process is None or not _has_effect(frame) or not self._is_alive:
            return
        start, self._before, self._newest = self._before, None, frame.index
        if start is None and self._must_start:
            self._n_skipped += 1
            return
        if start is not None:
            self._must_start, self._started = False, frame.index - frame.moved
            self._n_starts += 1
        if len(self._steps) * self._simulation.scene.period > _MAX_BACKLOG:
            self._n_skipped += len(self._steps)
            self._steps.clear()
            self._restart(frame.index, f"it lags by more than {_MAX_BACKLOG:g} s")
            return
        scene_and_state = None
        if start is not None:
            scene, state = start
            scene_and_state = EnsembleStart(scene.parameters(), dict(scene.files), state)
        self._steps.append(EnsembleStep(frame.index, stamp, frame.events, scene_and_state))
        self._process.put(True)

    def send(self, stamp: int) -> None:
        """Publish and record the clouds that the process has finished; drop those 0.9 s older than `stamp` [ns]."""
        while not self._answers.empty():
            answer = self._answers.get_nowait()
            self._n_skipped += answer["steps"]
            if "trouble" in answer:
                self._restart(self._newest, answer["trouble"])
            elif "cloud" in answer and 0 <= stamp - answer["stamp"] <= _MAX_AGE:
                self._n_skipped -= 1
                self._n_published += 1
                self._n_late = 0
                self._output.send(base64.b64decode(answer["cloud"]), answer["stamp"])
            elif "cloud" in answer:
                self._n_late += 1
                self._warn_of_lag((stamp - answer["stamp"]) / 1e9, answer["members"])

    def report(self) -> None:
        """Log a warning if the ensemble process has ended. Call it periodically."""
        while not self._ends.empty():
            self._log.warn(
                "ensemble", f"~/ensemble ends: its process {self._ends.get_nowait()}; the cloth goes on. Restart "
                "the node for an ensemble",
            )  # fmt: skip

    def describe(self) -> dict[str, str]:
        """Return diagnostics entries: state of the process, counts of frames, deviation [m] and lag [s]."""
        period, latest = self._simulation.scene.period, self._latest
        values = {
            "ensemble": self._state,
            "ensemble_frames": str(self._n_published),
            "ensemble_frames_skipped": str(self._n_skipped),
            "ensemble_starts": str(self._n_starts),
            "ensemble_since_s": f"{self._started * period:.3f}",
        }
        if latest:
            values |= {
                "ensemble_members": str(latest["members"]),
                "ensemble_deviation_m": f"{latest['largest']:.3g}",
                "ensemble_lag_s": f"{max(0, self._newest - latest['index']) * period:.3f}",
                "ensemble_time_s": f"{latest['seconds']:.6g}",
            }
        return values

    def close(self) -> None:
        """Kill the ensemble process, and wait at most 1 s for its end."""
        if self._process is not None:
            self._process.close()
            self._process = None

    @property
    def _is_alive(self) -> bool:
        return self._state in ("starting", "running")

    def _restart(self, index: int, reason: str) -> None:
        period = self._simulation.scene.period
        self._must_start, self._next_start = True, index + round(_RESTART_DELAY / period)
        self._log.warn("ensemble", f"the ensemble restarts at the cloth's state: {reason}")

    def _warn_of_lag(self, lag: float, members: int) -> None:
        # The first answer is always late: the process has just started.
        if self._n_late > 1:
            self._log.warn(
                "ensemble lag",
                f"~/ensemble lags by {lag:.1f} s and is not published: its {members} cloths take longer than the "
                "cloth's frames; take fewer uncertain parameters, or a coarser cloth",
            )

    def _encode(self, _: bool) -> list[EnsembleStep]:
        """Remove all waiting frames from the queue, and return them as one job of the process."""
        steps = []
        # The node's thread may clear them meanwhile.
        with contextlib.suppress(IndexError):
            while True:
                steps.append(self._steps.popleft())
        return steps

    def _receive(self, answer: dict[str, Any]) -> bool:
        self._state = "running"
        if "cloud" in answer:
            self._latest = answer
        self._answers.put(answer)
        return True

    def _end(self, reason: str) -> None:
        self._state = reason
        self._ends.put(reason)


def _has_effect(frame: Frame) -> bool:
    return frame.moved or bool(frame.events)
