# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ensemble process: advances the members of an ensemble by the frames of a live cloth.

Usage: `python -m cloth_sim_ros.ros.ensemble.ensemble_worker PARENT`. Reads pickled lists of `EnsembleStep` from
standard input. Ends with its input, or when the process PARENT ends.

Answers each list with a line of JSON:

- `steps`: number of frames in the list.
- `trouble`: the reason if a member cannot go on. The process then waits for a frame with a start.
- `index`, `stamp`, `cloud`, `largest`, `members`, `seconds`: the newest frame, its message (base64), its largest
  deviation [m], and the time of the whole list [s]. Absent without a frame.
"""

from __future__ import annotations

import base64
import json
import os
import pickle
import sys
import time
from collections.abc import Sequence
from typing import Any

from cloth_sim_ros.ros.ensemble.ensemble_jobs import EnsembleStart, EnsembleStep
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.child_process import exit_with_parent
from cloth_sim_ros.session.messages import CloudEncoder
from cloth_sim_ros.simulation.ensemble import Ensemble, EnsembleFrame

#: Niceness, so that the simulation has priority.
_NICENESS = 10


class EnsembleWorker:
    """Ensemble of one node in the ensemble process; `advance` creates it at the first frame with a start."""

    def __init__(self) -> None:
        self._ensemble: Ensemble | None = None

    def advance(self, steps: Sequence[EnsembleStep]) -> dict[str, Any]:
        """Advance the members by frames; return the answer to the node, with the newest cloud or the `trouble`."""
        answer: dict[str, Any] = {"steps": len(steps)}
        start_time, frame = time.perf_counter(), None
        for step in steps:
            try:
                if step.start is not None:
                    self._start(step.start)
                if self._ensemble is not None:
                    frame, newest = self._ensemble.advance(step.events), step
            except ValueError as error:
                self._close()
                return answer | {"trouble": str(error)}
        if frame is not None:
            answer |= {"index": newest.index, "stamp": newest.stamp, "cloud": self._cloud(frame, newest.stamp)}
            answer |= {"largest": frame.largest, "members": self._size}
        return answer | {"seconds": time.perf_counter() - start_time}

    def _start(self, start: EnsembleStart) -> None:
        self._close()
        scene = Scene.from_parameters(start.parameters, files=start.files)
        options = scene.ensemble
        self._ensemble = Ensemble(
            scene, scene.distribution(), state=start.state, members=options.members, seed=options.seed
        )
        self._size = self._ensemble.size
        height, width = scene.shape
        self._encoder = CloudEncoder(frame_id=scene.frame_id, height=height, width=width, deviation=True)

    def _cloud(self, frame: EnsembleFrame, stamp: int) -> str:
        data = self._encoder.encode(frame.mean.T, stamp, deviation=frame.deviation)
        return base64.b64encode(data).decode()

    def _close(self) -> None:
        if self._ensemble is not None:
            self._ensemble.close()
            self._ensemble = None


def main(arguments: Sequence[str]) -> int:
    """Run the ensemble process: advance members by frames from standard input, until its or the parent's end."""
    exit_with_parent(int(arguments[0]))
    os.nice(_NICENESS)
    worker = EnsembleWorker()
    try:
        while True:
            print(json.dumps(worker.advance(pickle.load(sys.stdin.buffer))), flush=True)
    except (EOFError, pickle.UnpicklingError, BrokenPipeError):
        # The node has ended, or was killed while it sent a frame.
        return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
