# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Step time and memory of one sheet, in its own process.

`python -m benchmarks.scale.sheet grid 1000 3.0` prints JSON. Its arguments are kind, particles a side, timing [s].
Each sheet has its own process, because a process seldom returns memory to the system.
"""

from __future__ import annotations

import contextlib
import gc
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.physics.model.sheets.surface import grid_triangles

#: Steps per frame: enough to make the cost per frame negligible at any size.
STEPS = 40
#: Particles a side of a warm-up sheet that loads the code of larger ones.
_WARM = 56
_MESH = "sheet.ply"


def measure_sheet(kind: str, resolution: int, seconds: float) -> dict[str, Any]:
    """Return the figures of one sheet, which are timed for some seconds."""
    # A warm-up sheet, large enough for all threads, excludes the memory of the code from the measurement.
    warm = Simulation(_scene(kind, _WARM))
    for _ in range(3):
        warm.advance()
    del warm
    gc.collect()
    _forget_peak()
    before = _peak()
    begun = time.perf_counter()
    scene = _scene(kind, resolution)
    simulation = Simulation(scene)
    built = time.perf_counter() - begun
    figures: dict[str, Any] = {"build_s": built, "build_peak_bytes": _peak() - before}
    gc.collect()
    _forget_peak()
    figures |= _measure(simulation, seconds=seconds)
    return figures | {"peak_bytes": _peak() - before, **_needed(simulation)}


def _scene(kind: str, resolution: int) -> Scene:
    # At a fixed rate the largest sheets would need a thousand steps per frame. The rate is set so that each sheet needs
    # `STEPS`. The integrator is the one that `auto` chooses for them at the default tolerance.
    values: dict[str, Any] = {"cloth.resolution": [resolution, resolution], "integrator": "extrapolated"}
    values["wind.normal_drag"] = 0.0
    files = {}
    if kind == "mesh":
        values |= {"cloth.mesh": _MESH, "cloth.anchors": ["0", str(resolution - 1)], "bending.model": "none"}
        values["cloth.resolution"] = [2, 2]
        files[_MESH] = _ply(resolution)
    trial = Scene.from_parameters(values, files=files)
    plan = trial.plan()
    x = np.ascontiguousarray(trial.initial_positions().T)
    limit = trial.build_integrator().step_limit(*plan.spectral_bounds(x))
    return Scene.from_parameters({**values, "rate": 1.0 / (0.9 * STEPS * limit)}, files=files)


def _ply(resolution: int) -> bytes:
    """Return a square sheet as PLY, with vertices and triangles in random order."""
    import trimesh

    random = np.random.default_rng(1)
    line, order = np.linspace(-0.5, 0.5, resolution), random.permutation(resolution**2)
    points = np.empty((resolution**2, 3))
    points[order] = np.stack([np.tile(line, resolution), np.repeat(line, resolution), np.zeros(resolution**2)], axis=1)
    triangles = random.permutation(order[grid_triangles(resolution, resolution, "alternating")])
    content: bytes = trimesh.Trimesh(points, triangles, process=False).export(file_type="ply")
    return content


def _measure(simulation: Simulation, *, seconds: float) -> dict[str, Any]:
    """Return frame times [s], steps per frame, and times per particle and step [ns]."""
    simulation.advance()
    walls: list[float] = []
    steps: list[int] = []
    end = time.perf_counter() + seconds
    while len(walls) < 3 or time.perf_counter() < end:
        begun = time.perf_counter()
        frame = simulation.advance()
        walls.append(time.perf_counter() - begun)
        assert frame.advance is not None
        steps.append(frame.advance.evaluations)
    count = simulation.state.particle_count
    return {
        "particles": count,
        "frame_s": statistics.median(walls),
        "ns": 1e9 * statistics.median(walls) / statistics.median(steps) / count,
    }


def _needed(simulation: Simulation) -> dict[str, int]:
    """Return the bytes of the state, of one set of forces, and of the scene's tables.

    The tables are masses, their inverses, and the initial state. A mesh adds its file, vertices, triangles, and the
    pairs, rest lengths, stiffness and damping of its springs. A grid has no lists.
    """
    state = sum(array.nbytes for array in simulation.state.arrays().values())
    model, scene = simulation.model, simulation.scene
    tables = model.masses.nbytes + model.inverse_masses.nbytes + state
    for force in model.forces:
        tables += sum(value.nbytes for value in vars(force).values() if isinstance(value, np.ndarray))
    if scene.cloth.mesh:
        sheet = scene.sheet
        tables += sheet.triangles().nbytes + sheet.positions().nbytes + len(scene.files[_MESH])
    return {"state_bytes": state, "force_bytes": simulation.state.x.nbytes, "table_bytes": tables}


def _forget_peak() -> None:
    """Reset the peak to the current memory, if the system supports it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    """Return the peak memory of the process since the reset [bytes]."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])


if __name__ == "__main__":
    sys.stdout.write(json.dumps(measure_sheet(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))) + "\n")
