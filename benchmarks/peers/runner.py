# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runner of one other engine, in the peers' own Python.

The script imports nothing of this package. `python -I runner.py` reads a job as JSON from its input and writes the
result as one line of JSON to its output.

A job names the `script`, a file beside this one, and the `variant`, a solver of it. The first class of the file whose
name ends with `Engine` runs the sheet.
`sheet` is an npz file (see `jobs.sheet_tables`). There are `frames` of length `frame` [s] with `steps` each. `seconds`
limits the wall time. A sheet with a stretch above `whole` counts as torn.

A job with `record` is a scene with contact (see `contact_scenes`) for a class with `ContactEngine` in its place. The
runner then writes the positions of particles and pads at every whole frame to the npz file `record`. `hold` is the
number of frames in which particles are held.

The constructor `Engine(sheet, step, variant)` compiles everything. An engine has `advance(steps)`, `positions()` [m]
of shape (particle_count, 3), and `distributions`, the names of its packages. It may have `remarks()`. A
`ContactEngine` also has `pads()`, the centres of the pads [m], shape (2, 3), or (0, 3) without pads. Its
`lead(begin, end, steps)` moves held particles between positions [m] in the next steps, and `let_go()` releases them.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import runpy
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

#: Readings of the clock per frame.
_SLICES = 16
#: Largest error of an initial position [m]; engines in single precision round.
_SAME_PLACE = 1e-5


def largest_stretch(positions: Any, edges: Any, rest_lengths: Any) -> float:
    """Return the largest ratio of an edge to its rest length; nan if a position is nan."""
    away = positions[edges[:, 1]] - positions[edges[:, 0]]
    # A diverged sheet overflows, which shows in the result.
    with np.errstate(all="ignore"):
        return float((np.sqrt((away * away).sum(axis=1)) / rest_lengths).max())


def check_start(engine: Any, sheet: dict[str, Any]) -> None:
    """Check that the engine has the given particles in the given order.

    Raises:
        ValueError: if they are off; the message names the distance.
    """
    off = float(np.abs(engine.positions() - sheet["positions"]).max())
    if not off <= _SAME_PLACE:
        raise ValueError(f"the engine's sheet starts {off:g} m off; particles are in another order, or missing")


def measure(engine: Any, sheet: dict[str, Any], job: dict[str, Any]) -> dict[str, Any]:
    """Advance until the end, the time limit, or a torn sheet; return the result."""
    check_start(engine, sheet)
    wall = cpu = largest = 0.0
    n_steps, steps, hold, recorded = 0, job["steps"], job.get("hold", 0), "record" in job
    frames, pads = ([engine.positions()], [engine.pads()]) if recorded else ([], [])
    for frame in range(job["frames"]):
        if frame < hold:
            engine.lead(sheet["path"][frame], sheet["path"][frame + 1], steps)
        elif frame == hold > 0:
            engine.let_go()
        done, frame_wall, frame_cpu = advance_frame(engine, steps, job["seconds"] - wall)
        n_steps, wall, cpu = n_steps + done, wall + frame_wall, cpu + frame_cpu
        positions = engine.positions()
        stretch = largest_stretch(positions, sheet["edges"], sheet["edge_lengths"])
        # A nan position makes the stretch nan, which does not count as whole.
        whole = stretch <= job["whole"]
        largest = max(largest, stretch) if np.isfinite(stretch) else float("inf")
        if recorded and whole and done == steps:
            frames.append(positions)
            pads.append(engine.pads())
        if not whole or wall >= job["seconds"]:
            break
    if recorded:
        np.savez(job["record"], frames=np.array(frames), pads=np.array(pads))
    result = {"whole": whole, "stretch": largest, "n_steps": n_steps, "wall": wall, "cpu": cpu}
    return result | {"remarks": engine.remarks() if hasattr(engine, "remarks") else []}


def advance_frame(engine: Any, steps: int, seconds: float) -> tuple[int, float, float]:
    """Take the steps of a frame within a wall time [s]; return their number, wall time and processor time [s]."""
    n_steps, wall, cpu = 0, 0.0, 0.0
    while n_steps < steps and wall < seconds:
        # A frame of a slow engine may take minutes, so the clock is also read within it.
        slice_steps = min(-(-steps // _SLICES), steps - n_steps)
        begin, cpu_begin = time.perf_counter(), time.process_time()
        engine.advance(slice_steps)
        wall, cpu = wall + time.perf_counter() - begin, cpu + time.process_time() - cpu_begin
        n_steps += slice_steps
    return n_steps, wall, cpu


def main() -> None:
    """Run the job."""
    # Standard output of the engine is redirected to standard error, so that the result stays clean.
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    job = json.load(sys.stdin)
    with np.load(job["sheet"]) as tables:
        sheet = {name: tables[name] for name in tables.files}
    kind = "ContactEngine" if "record" in job else "Engine"
    defined = runpy.run_path(str(Path(__file__).parent / job["script"]))
    make_engine = next(value for name, value in defined.items() if name.endswith(kind))
    engine = make_engine(sheet, job["frame"] / job["steps"], job["variant"])
    result = measure(engine, sheet, job)
    result["versions"] = {name: importlib.metadata.version(name) for name in engine.distributions}
    output.write(json.dumps(result) + "\n")
    output.flush()
    # Some engines crash while the interpreter shuts down; the result is written by now.
    os._exit(0)


if __name__ == "__main__":
    main()
