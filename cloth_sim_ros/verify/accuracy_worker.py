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
import time
from collections.abc import Sequence
from typing import Any

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.child_process import exit_with_parent
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.certificate import AccuracyWindow, FrameAccuracy
from cloth_sim_ros.verify.reference_integrator import max_distance
from cloth_sim_ros.verify.reference_motion import Equations, FrameCapture, SimulatedFrame, starting_state
from cloth_sim_ros.verify.reference_solution import ReferenceSolution, later_amplification

#: Niceness, so that the simulation has priority.
_NICENESS = 10


def main(arguments: Sequence[str]) -> int:
    """Print a line of JSON for each pickled window on standard input; return 0 when it ends, exit with the parent."""
    exit_with_parent(int(arguments[0]))
    os.nice(_NICENESS)
    scene: Scene | None = None
    try:
        while True:
            values, files, state, events, digest = pickle.load(sys.stdin.buffer)
            if values is not None:
                scene = Scene.from_parameters(values, files=files)
            assert scene is not None
            print(json.dumps(assess_window(scene, state, events, digest)), flush=True)
    except (EOFError, pickle.UnpicklingError, BrokenPipeError):
        # The node has ended, or was killed during a window.
        return 0


def assess_window(scene: Scene, state: State, events: Sequence[Sequence[Event]], digest: str) -> dict[str, Any]:
    """Run a live simulation's window again; return its error against a reference as a JSON object, or `trouble`.

    Args:
        scene: effective at its beginning.
        state: full state at its beginning.
        events: events of each frame.
        digest: digest of the state at its end.

    Returns:
        JSON object: numbers of an `AccuracyWindow`, or `trouble` with the reason if they are unknown.
    """
    start_time, simulation, capture = time.perf_counter(), Simulation(scene, state), FrameCapture()
    frames = []
    try:
        for frame_events in events:
            scene_before, state_before = simulation.scene, simulation.state.shallow_copy()
            frames.append(capture.capture(simulation, scene_before, state_before, simulation.advance(frame_events)))
    except (ValueError, UnstableError) as error:
        return {"trouble": f"it cannot be run again: {error}"}
    if simulation.state.digest() != digest:
        return {"trouble": "it came out otherwise when it was run again"}
    simulated = [frame for frame in frames if frame is not None]
    window = _window(simulated, measure_amplification=False)
    if window.tolerance is not None and not window.error <= window.tolerance:
        # The amplification matters only if the error exceeds the tolerance.
        window = _window(simulated, measure_amplification=True)
        if window.verdict == "not kept":
            window.later_amplification = later_amplification(Equations(), simulated)
    return {
        "start": window.start,
        "end": window.end,
        "error": window.error,
        "allowed": None if math.isnan(window.error_bound) else window.error_bound,
        "uncertainty": window.uncertainty,
        "verdict": window.verdict,
        "seconds": time.perf_counter() - start_time,
    }


def _window(frames: Sequence[SimulatedFrame], *, measure_amplification: bool) -> AccuracyWindow:
    window, equations = AccuracyWindow(index=0, start=frames[0].t), Equations()
    start, seed, amplification = frames[0].before, frames[0].index, 0.0
    reference = ReferenceSolution(start, seed=seed, measure_amplification=measure_amplification)
    for frame in frames:
        if frame.reset:
            start = starting_state(frame)
            reference = ReferenceSolution(start, seed=frame.index, measure_amplification=measure_amplification)
        result = reference.advance(equations, frame)
        amplification = max(amplification, result.amplification) if measure_amplification else 0.0
        window.add(
            FrameAccuracy(
                frame=frame.index,
                time=frame.t + frame.duration,
                window=0,
                tolerance=frame.tolerance,
                flagged=frame.flagged,
                exact=True,
                error_of_frame=math.nan,
                error_bound_of_frame=math.nan,
                error=max_distance(frame.after.x, result.x),
                amplification=amplification,
                uncertainty=result.uncertainty,
                floor=result.rounding_floor,
                session_error=math.nan,
                session_amplification=math.nan,
                session_uncertainty=math.nan,
            )
        )
    return window


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
