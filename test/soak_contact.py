# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Self-contact over a million steps: `python test/soak_contact.py [--steps 1000000] [--seed 1]`.

No frame may have a self-intersection, by ipctk's exact test. The scenes run in turn with new random numbers, up to the
number of steps. Exit status 1 after an intersection; scene and index reproduce it.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

import attrs
import numpy as np
from support.self_runs import RUNS, Oracle
from tqdm import tqdm


@attrs.define
class Sum:
    """Totals over all runs of a scene."""

    runs: int = 0
    frames: int = 0
    steps: int = 0
    contacts: int = 0
    least: float = math.inf
    flagged: int = 0
    implicit: int = 0
    halted: int = 0
    passing: int = 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(description="Check that cloths do not intersect themselves.")
    parser.add_argument("--steps", type=int, default=1_000_000, help="number of steps of all scenes (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scenes", nargs="+", choices=list(RUNS), default=list(RUNS), metavar="SCENE")
    options = parser.parse_args(arguments)
    sums = {name: Sum() for name in options.scenes}
    number = 0
    with tqdm(total=options.steps, unit="step", disable=None) as bar:
        while not number or sum(each.steps for each in sums.values()) < options.steps:
            for index, name in enumerate(options.scenes):
                _follow(name, np.random.default_rng((options.seed, number, index)), sums[name], bar)
            number += 1
    return _told(sums)


def _follow(name: str, rng: np.random.Generator, into: Sum, bar: tqdm) -> None:
    run = RUNS[name](rng)
    simulation, oracle = run.simulation, Oracle(run.simulation.scene)
    into.runs += 1
    for events in run.events:
        frame = simulation.advance(events)
        if oracle.look(simulation):
            into.passing += 1
            print(f"{name}, run {into.runs - 1}: passes through itself in frame {frame.index}", file=sys.stderr)
        steps = frame.advance.steps if frame.advance else 0
        into.frames, into.steps, into.halted = into.frames + 1, into.steps + steps, into.halted + bool(frame.halted)
        into.flagged += bool(frame.advance and frame.advance.flagged)
        into.implicit += bool(frame.advance and ("implicit" in frame.advance.reason and frame.advance.flagged))
        bar.update(steps)
    into.contacts, into.least = into.contacts + oracle.met, min(into.least, oracle.least)


def _told(sums: dict[str, Sum]) -> int:
    print("| scene | runs | frames | steps | contacts at frames' ends | smallest gap mm | frames flagged | of these"
          " finished by implicit steps | halted | pass through |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, each in sums.items():
        row = [name, each.runs, each.frames, each.steps, each.contacts, f"{1e3 * each.least:.3g}"]
        print("|", " | ".join(map(str, [*row, each.flagged, each.implicit, each.halted, each.passing])), "|")
    passing = sum(each.passing for each in sums.values())
    steps, frames = (sum(getattr(each, what) for each in sums.values()) for what in ("steps", "frames"))
    print(f"{steps:,} steps, {frames} frames: {passing} in which a cloth passes through itself")
    return 1 if passing else 0


if __name__ == "__main__":
    sys.exit(main())
