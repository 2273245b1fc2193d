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
class SceneTotals:
    """Totals over all runs of a scene."""

    runs: int = 0
    frames: int = 0
    steps: int = 0
    contacts: int = 0
    min_gap: float = math.inf
    flagged: int = 0
    implicit: int = 0
    stopped: int = 0
    n_penetrating: int = 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(description="Check that cloths do not intersect themselves.")
    parser.add_argument("--steps", type=int, default=1_000_000, help="number of steps of all scenes (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scenes", nargs="+", choices=list(RUNS), default=list(RUNS), metavar="SCENE")
    options = parser.parse_args(arguments)
    sums = {name: SceneTotals() for name in options.scenes}
    repetition = 0
    with tqdm(total=options.steps, unit="step", disable=None) as bar:
        while not repetition or sum(totals.steps for totals in sums.values()) < options.steps:
            for index, name in enumerate(options.scenes):
                _follow(name, np.random.default_rng((options.seed, repetition, index)), sums[name], bar)
            repetition += 1
    return _print_table(sums)


def _follow(name: str, rng: np.random.Generator, totals: SceneTotals, bar: tqdm) -> None:
    run = RUNS[name](rng)
    simulation, oracle = run.simulation, Oracle(run.simulation.scene)
    totals.runs += 1
    for events in run.events:
        frame = simulation.advance(events)
        if oracle.observe(simulation):
            totals.n_penetrating += 1
            print(f"{name}, run {totals.runs - 1}: passes through itself in frame {frame.index}", file=sys.stderr)
        steps = frame.advance.steps if frame.advance else 0
        totals.frames, totals.steps, totals.stopped = (
            totals.frames + 1,
            totals.steps + steps,
            totals.stopped + bool(frame.stopped),
        )
        totals.flagged += bool(frame.advance and frame.advance.flagged)
        totals.implicit += bool(frame.advance and ("implicit" in frame.advance.reason and frame.advance.flagged))
        bar.update(steps)
    totals.contacts, totals.min_gap = totals.contacts + oracle.n_contacts, min(totals.min_gap, oracle.min_gap)


def _print_table(sums: dict[str, SceneTotals]) -> int:
    print("| scene | runs | frames | steps | contacts at frames' ends | smallest gap mm | frames flagged | of these"
          " finished by implicit steps | halted | pass through |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, totals in sums.items():
        row = [name, totals.runs, totals.frames, totals.steps, totals.contacts, f"{1e3 * totals.min_gap:.3g}"]
        print(
            "|",
            " | ".join(map(str, [*row, totals.flagged, totals.implicit, totals.stopped, totals.n_penetrating])),
            "|",
        )
    passing = sum(totals.n_penetrating for totals in sums.values())
    steps, frames = (sum(getattr(totals, field) for totals in sums.values()) for field in ("steps", "frames"))
    print(f"{steps:,} steps, {frames} frames: {passing} in which a cloth passes through itself")
    return 1 if passing else 0


if __name__ == "__main__":
    sys.exit(main())
