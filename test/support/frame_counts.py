# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Proof that what a scene does not use is not run: calls of the engine, memory and modules, counted."""

from __future__ import annotations

import contextlib
import gc
import json
import subprocess
import sys
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from cloth_sim_ros.engine import binding
from cloth_sim_ros.simulation.simulation import Simulation

#: What a scene that uses a feature loads, and others do not.
MARKERS = {
    "mesh files": ("cloth_sim_ros.scene.mesh_file", "plyfile", "trimesh"),
    "raw springs": ("cloth_sim_ros.scene.springs_file",),
    "bending springs across hinges": ("cloth_sim_ros.physics.model.sheets.bending",),
    "implicit steps": (
        "cloth_sim_ros.physics.integrators.implicit",
        "cloth_sim_ros.physics.integrators.implicit_advance",
    ),
    "energy balance": ("cloth_sim_ros.simulation.energy_watch", "cloth_sim_ros.physics.accounting.energy_balance"),
    "recording": ("cloth_sim_ros.session", "mcap", "rosbags"),
    "ROS": ("rclpy", "sensor_msgs"),
    "plots, viewer": ("matplotlib", "rerun"),
}


@contextlib.contextmanager
def counted_calls() -> Iterator[Counter[str]]:
    """Count the calls from Python into the engine, by name, while the context lasts."""
    calls: Counter[str] = Counter()
    engine = binding.library()
    functions = {name: value for name, value in vars(engine).items() if name.startswith("cloth_")}

    def counted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            calls[name.removeprefix("cloth_")] += 1
            return function(*arguments)

        return call

    for name, function in functions.items():
        setattr(engine, name, counted(name, function))
    try:
        yield calls
    finally:
        for name, function in functions.items():
            setattr(engine, name, function)


def calls_of_a_frame(simulation: Simulation, *, frames: int = 1) -> dict[str, int]:
    """Return the calls of the engine of the next frames together, by name, after one that is not counted."""
    simulation.advance()
    with counted_calls() as calls:
        for _ in range(frames):
            simulation.advance()
    return dict(sorted(calls.items()))


def bytes_of_a_frame(simulation: Simulation) -> tuple[int, int]:
    """Return how much memory [B] the next frame needs at most beyond what there is, and how much it keeps.

    A frame before it is not counted: what is made once is made then.
    """
    simulation.advance()
    gc.collect()
    tracemalloc.start()
    try:
        frame = simulation.advance()
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        again = simulation.advance()
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    del frame, again
    return peak - before, after - before


def modules_of(values: Mapping[str, Any], *, frames: int = 2) -> set[str]:
    """Return the names of all modules that a fresh interpreter has loaded after some frames of a scene.

    Args:
        values: parameters of the scene.
        frames: how many frames are run.

    Raises:
        RuntimeError: if the scene can't be run.
    """
    script = (
        "import json, sys\n"
        "from cloth_sim_ros.scene.scene import Scene\n"
        "from cloth_sim_ros.simulation.simulation import Simulation\n"
        f"simulation = Simulation(Scene.from_parameters(json.loads({json.dumps(dict(values))!r})))\n"
        f"for _ in range({frames}): simulation.advance()\n"
        "print(json.dumps(sorted(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-P", "-c", script], check=False, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the scene {dict(values)} can't be run: {done.stderr[-2000:]}")
    return set(json.loads(done.stdout.splitlines()[-1]))
