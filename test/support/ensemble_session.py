# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A session with an ensemble, without ROS and clock."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.ensemble import Ensemble
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.studies.run_recording import RunRecording

VALUES: dict[str, Any] = {
    "cloth.resolution": [5, 6],
    "cloth.anchors": ["top_left"],
    "rate": 30.0,
    "ensemble.file": "distribution.yaml",
}


def record_ensemble(
    folder: Path, n_frames: int, *, events: Mapping[int, list[Event]] | None = None, every: int = 1
) -> Path:
    """Record a swinging sheet whose drag is uncertain.

    Args:
        folder: folder of the session.
        n_frames: number of frames.
        events: events by index of the frame, from 0.
        every: the ensemble leaves out all but every n-th frame.
    """
    (folder / "distribution.yaml").write_text("parameters: [{name: air.drag, deviation: 0.4}]")
    scene = Scene.from_parameters(VALUES, folder=folder)
    simulation = Simulation(scene)
    recording = RunRecording(folder, simulation, name="run", clouds=True)
    with Ensemble(scene, scene.distribution(), state=simulation.state, threads=1) as ensemble:
        for k in range(n_frames):
            frame = simulation.advance((events or {}).get(k, []))
            ensemble_frame = ensemble.advance(frame.events)
            recording.add(frame.events, frame, ensemble_frame if k % every == 0 else None)
    return recording.finish(reason="stopped")
