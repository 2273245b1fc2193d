# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs one other engine on a given sheet: a script for the peers' own Python, without anything of this package.

`python -I runner.py` reads a job from its input as JSON and writes what came of it to its output as one line of
JSON. The job: `script`, the file beside this one whose `Engine` runs the sheet; `sheet`, an npz file (see
`jobs.sheet_tables`); `variant`, which solver of the engine; `steps`, steps in a frame; `frame` [s]; `frames`;
`seconds`, wall time after which it ends early; `whole`, the stretch above which the sheet counts as torn.

A job with `record` is a scene with contact (see `contact_scenes`), for the file's `ContactEngine`: no stretch is
judged, and the positions at every frame, with those of the pads, go to the npz file of that name. `hold` then is the
number of frames in which particles are held.

An `Engine(sheet, step, variant)` is made with nothing left to compile. It has `advance(steps)`, `positions()` [m] of
shape (particle_count, 3), `distributions`, the names of the packages that it runs on, and `remarks()`.
For scenes with contact it also has `pads()`, places [m] of the pads' centres, shape (2, 3), or (0, 3) where the scene
has none; `lead(begin, end, steps)`, which lets held particles move from places [m] to others in the steps that follow;
and `let_go()`.
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

#: The clock is read about so often within a frame.
_SLICES = 16
#: Furthest that a particle may start from where it should [m]: engines in single precision round.
_SAME_PLACE = 1e-5


def largest_stretch(positions: Any, edges: Any, rest_lengths: Any) -> float:
    """Largest length of an edge over its rest length; nan where a position is none."""
    away = positions[edges[:, 1]] - positions[edges[:, 0]]
    # A sheet that has blown up overflows; that is seen in the result.
    with np.errstate(all="ignore"):
        return float((np.sqrt((away * away).sum(axis=1)) / rest_lengths).max())


def check_start(engine: Any, sheet: dict[str, Any]) -> None:
    """Refuse an engine whose particles are not where, or not in the order in which, they were given.

    Raises:
        ValueError: saying how far off they are.
    """
    off = float(np.abs(engine.positions() - sheet["positions"]).max())
    if not off <= _SAME_PLACE:
        raise ValueError(f"the engine's sheet starts {off:g} m off; particles are in another order, or missing")


def measure(engine: Any, sheet: dict[str, Any], job: dict[str, Any]) -> dict[str, Any]:
    """Advance until the end, the time limit, or a frame at which the sheet is torn; return what was seen."""
    check_start(engine, sheet)
    wall, largest, taken, whole = 0.0, 0.0, 0, True
    last = job["frames"] * job["steps"]
    while taken < last and whole and wall < job["seconds"]:
        done, spent = advance_frame(engine, job["steps"], job["seconds"] - wall)
        taken, wall = taken + done, wall + spent
        stretch = largest_stretch(engine.positions(), sheet["edges"], sheet["edge_lengths"])
        # A position that is no number makes the stretch none, which is not whole either.
        whole = stretch <= job["whole"]
        largest = max(largest, stretch) if np.isfinite(stretch) else float("inf")
    return {"whole": whole, "stretch": largest, "n_steps": taken, "wall": wall, "remarks": engine.remarks()}


def advance_frame(engine: Any, steps: int, seconds: float) -> tuple[int, float]:
    """Take the steps of a frame, or as many as the time allows; return how many, and the wall time that they took."""
    taken, wall = 0, 0.0
    while taken < steps and wall < seconds:
        # A frame of a slow engine may take minutes: the clock is read within it too.
        few = min(-(-steps // _SLICES), steps - taken)
        begin = time.perf_counter()
        engine.advance(few)
        wall += time.perf_counter() - begin
        taken += few
    return taken, wall


def record(engine: Any, sheet: dict[str, Any], job: dict[str, Any]) -> dict[str, Any]:
    """Advance until the end, the time limit, or a position that is no number; write what was at every whole frame."""
    check_start(engine, sheet)
    frames, pads, wall, taken = [engine.positions()], [engine.pads()], 0.0, 0
    finite = True
    for frame in range(job["frames"]):
        if frame < job["hold"]:
            engine.lead(sheet["path"][frame], sheet["path"][frame + 1], job["steps"])
        elif frame == job["hold"] > 0:
            engine.let_go()
        done, spent = advance_frame(engine, job["steps"], job["seconds"] - wall)
        taken, wall = taken + done, wall + spent
        if done < job["steps"]:
            break
        now = engine.positions()
        finite = bool(np.isfinite(now).all())
        if not finite:
            break
        frames.append(now)
        pads.append(engine.pads())
        if wall >= job["seconds"]:
            break
    np.savez(job["record"], frames=np.array(frames), pads=np.array(pads))
    return {"n_steps": taken, "wall": wall, "finite": finite, "remarks": engine.remarks()}


def main() -> None:
    """Run the job."""
    # Engines write to standard output whatever they like: that goes to the error output, and ours stays clean.
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    job = json.load(sys.stdin)
    with np.load(job["sheet"]) as tables:
        sheet = {name: tables[name] for name in tables.files}
    kind = "ContactEngine" if "record" in job else "Engine"
    Engine = runpy.run_path(str(Path(__file__).parent / job["script"]))[kind]
    engine = Engine(sheet, job["frame"] / job["steps"], job["variant"])
    result = record(engine, sheet, job) if "record" in job else measure(engine, sheet, job)
    result["versions"] = {name: importlib.metadata.version(name) for name in engine.distributions}
    output.write(json.dumps(result) + "\n")
    output.flush()
    # Some engines crash when the interpreter takes them apart; all is said by now.
    os._exit(0)


if __name__ == "__main__":
    main()
