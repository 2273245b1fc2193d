# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time per particle and step, and memory, from 10^3 to 10^6 particles.

Each sheet has its own process, because a process seldom returns memory to the system.
`python -m benchmarks.scale.sheet grid 1000 3.0` is such a process and prints JSON. Its arguments are kind, particles a
side, timing [s].
"""

from __future__ import annotations

import argparse
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
from validation.command import at_least, run_module
from validation.report import Report

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


#: Largest ratio of the time per particle and step to that of a sheet of about 10^4 particles.
MAX_TIME_RATIO = 2.0
#: Largest ratio of memory to the sum of state, one set of forces and the scene's tables.
MAX_MEMORY_RATIO = 2.0
#: Particles a side: 10^3 to 10^6.
SIZES = (32, 64, 100, 180, 320, 560, 1000)
_LARGE = 100_000
KINDS = ("grid", "mesh")
_MEGA = 1e6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, help="of sheets")
    parser.add_argument("--sizes", type=int, nargs="+", default=[*SIZES], metavar="N", help="particles a side")
    parser.add_argument("--seconds", type=float, default=3.0, help="timing of each sheet [s]")
    parser.add_argument("--rounds", type=at_least(1), default=2, help="processes for each sheet; the fastest counts")


def run(options: argparse.Namespace) -> Report:
    """Measure all sheets, each in separate processes."""
    report = Report("From a thousand particles to a million")
    columns = ["sheet", "particles", "build s", "frame ms", "ns a particle and step", "to 10^4"]
    times = report.add_table("Time", columns)
    columns = ["sheet", "particles", "most while built", "most while run", "state", "forces", "tables"]
    columns.append("run to their sum")
    memory = report.add_table("Memory, MB", columns)
    for kind in options.kinds:
        sheets = _sheets(kind, options, report)
        if not sheets:
            continue
        reference = min(sheets, key=lambda sheet: abs(sheet["particles"] - 1e4))
        for sheet in sheets:
            ratio = sheet["ns"] / reference["ns"]
            row = [kind, sheet["particles"], sheet["build_s"], 1e3 * sheet["frame_s"], sheet["ns"], ratio]
            times.rows.append(row)
            sizes = [sheet[f"{quantity}_bytes"] for quantity in ("build_peak", "peak", "state", "force", "table")]
            share = sizes[1] / sum(sizes[2:])
            memory.rows.append([kind, sheet["particles"], *(size / _MEGA for size in sizes), share])
            if sheet["particles"] >= _LARGE and ratio > MAX_TIME_RATIO:
                report.fail(f"{kind} of {sheet['particles']}: {ratio:.2f} times the time of 10^4")
            if sheet["particles"] >= _LARGE and share > MAX_MEMORY_RATIO:
                report.fail(f"{kind} of {sheet['particles']}: {share:.2f} times the memory of what it must hold")
    report.note("each sheet in separate processes, sizes in turns; shortest median frame of several")
    report.note("memory beyond that of a process that has run a sheet of 3136 particles of the same kind")
    return report


def _sheets(kind: str, options: argparse.Namespace, report: Report) -> list[dict[str, Any]]:
    best: dict[int, dict[str, Any]] = {}
    for _ in range(options.rounds):
        for size in options.sizes:
            done = run_module("benchmarks.scale.sheet", kind, str(size), str(options.seconds))
            if done.returncode:
                last = (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1]
                report.fail(f"{kind}, {size} a side, could not be run: {last}")
                continue
            figures = json.loads(done.stdout.splitlines()[-1])
            best[size] = min(figures, best.get(size, figures), key=lambda sheet: sheet["ns"])
    return [best[size] for size in sorted(best)]


if __name__ == "__main__":
    sys.stdout.write(json.dumps(measure_sheet(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))) + "\n")
