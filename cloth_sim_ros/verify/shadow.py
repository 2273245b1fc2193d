# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Accuracy worker: measures windows of a live simulation in a separate process.

Usage: `python -m cloth_sim_ros.verify.accuracy_worker PARENT`. Reads windows from standard input, one pickled tuple
each: parameters, files, state, events, digest. Parameters and files of the scene are None if unchanged since the last
window. The state is the full one at the window's beginning, the digest that at its end; the events come by frame.

Answers each window with a line of JSON. Ends with its input, or when the process PARENT ends.
"""

from __future__ import annotations

import json
import math
import os
import pickle
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.certificate import FrameAccuracy, Window
from cloth_sim_ros.verify.fine import distance
from cloth_sim_ros.verify.motion import Equations, FrameWatch, RunFrame, starting_state
from cloth_sim_ros.verify.truth import Truth, later_growth

#: Niceness, so that the simulation has priority.
_NICENESS = 10
#: Poll interval of the parent process [s].
_LOOK = 0.25


def main(arguments: Sequence[str]) -> int:
    """Assess windows until the input ends; return the exit status."""
    threading.Thread(target=_end_with, args=(int(arguments[0]),), daemon=True).start()
    os.nice(_NICENESS)
    scene: Scene | None = None
    try:
        while True:
            values, files, state, events, digest = pickle.load(sys.stdin.buffer)
            if values is not None:
                scene = Scene.from_parameters(values, files=files)
            assert scene is not None
            print(json.dumps(judge(scene, state, events, digest)), flush=True)
    except (EOFError, pickle.UnpicklingError, BrokenPipeError):
        # The node has ended, or was killed during a window.
        return 0


def judge(scene: Scene, state: State, events: Sequence[Sequence[Event]], digest: str) -> dict[str, Any]:
    """Run a window again and compare it with a reference solution.

    Args:
        scene: effective at its beginning.
        state: full state at its beginning.
        events: events of each frame.
        digest: digest of the state at its end.

    Returns:
        JSON object: numbers of an `AccuracyWindow`, or `trouble` with the reason if they are unknown.
    """
    begun, simulation, watch = time.perf_counter(), Simulation(scene, state), FrameWatch()
    frames = []
    try:
        for these in events:
            was, before = simulation.scene, simulation.state.share()
            frames.append(watch.after(simulation, was, before, simulation.advance(these)))
    except (ValueError, UnstableError) as error:
        return {"trouble": f"it cannot be run again: {error}"}
    if simulation.state.digest() != digest:
        return {"trouble": "it came out otherwise when it was run again"}
    ran = [frame for frame in frames if frame is not None]
    window = _window(ran, kicks=False)
    if window.tolerance is not None and not window.error <= window.tolerance:
        # The amplification matters only if the error exceeds the tolerance.
        window = _window(ran, kicks=True)
        if window.verdict == "not kept":
            window.later = later_growth(Equations(), ran)
    return {
        "start": window.start,
        "end": window.end,
        "error": window.error,
        "allowed": None if math.isnan(window.promise) else window.promise,
        "own": window.own,
        "verdict": window.verdict,
        "seconds": time.perf_counter() - begun,
    }


def _window(frames: Sequence[RunFrame], *, kicks: bool) -> Window:
    window, equations = Window(number=0, start=frames[0].t), Equations()
    truth, growth = Truth(frames[0].before, seed=frames[0].index, kicks=kicks), 0.0
    for frame in frames:
        if frame.reset:
            truth = Truth(starting_state(frame), seed=frame.index, kicks=kicks)
        told = truth.frame(equations, frame)
        growth = max(growth, told.growth) if kicks else 0.0
        window.add(
            FrameAccuracy(
                frame=frame.index,
                time=frame.t + frame.duration,
                window=0,
                tolerance=frame.tolerance,
                flagged=frame.flagged,
                exact=True,
                error_of_frame=math.nan,
                promise_of_frame=math.nan,
                error=distance(frame.after.x, told.x),
                growth=growth,
                own=told.own,
                floor=told.floor,
                session_error=math.nan,
                session_growth=math.nan,
                session_own=math.nan,
            )
        )
    return window


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_LOOK)
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
