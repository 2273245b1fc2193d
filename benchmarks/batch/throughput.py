# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many cloths in one process: speed, threads, memory, rollouts, random steps."""

from __future__ import annotations

import argparse
import os
import statistics

import attrs

from benchmarks.batch import cloths as batch_cloths
from benchmarks.timing import run_interleaved, time_interleaved
from validation.report import Report

#: Smallest total of simulated seconds per wall second, on two cores.
MIN_THROUGHPUT = 32.0
#: Smallest gain of two threads over one, or relative margin below the gain of two independent processes.
MIN_THREAD_GAIN, PROCESS_PAIR_MARGIN = 1.9, 0.03
#: Largest ratio of a cloth's memory to its state.
MAX_MEMORY_RATIO = 4.0
#: Largest wall time of the rollouts on two cores [s].
MAX_ROLLOUT_TIME = 1.0
#: Largest growth of memory over the soak after warm-up [MB].
LEAK = 8.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    usual = [part for part in PARTS if part != "soak"]
    parts = f"of {', '.join(PARTS)}; all but soak"
    parser.add_argument("--only", nargs="+", choices=PARTS, default=usual, metavar="PART", help=parts)
    parser.add_argument("--envs", type=int, default=64, metavar="N", help="cloths of an environment")
    parser.add_argument("--resolution", type=int, default=30, metavar="N", help="particles a side of a cloth")
    parser.add_argument("--rollouts", type=int, default=64, metavar="K", help="number of rollouts")
    parser.add_argument("--rollout-resolution", type=int, default=20, metavar="N", help="particles a side in rollouts")
    parser.add_argument("--steps", type=int, default=100_000, help="of the soak, over all cloths")
    parser.add_argument("--seconds", type=float, default=20.0, help="of timing for each table")


def run(options: argparse.Namespace) -> Report:
    """Measure the selected parts."""
    for name in ("envs", "resolution", "rollouts", "rollout_resolution", "steps"):
        if getattr(options, name) < 2:
            raise ValueError(f"--{name.replace('_', '-')} is {getattr(options, name)}; it must be at least 2")
    report = Report("Many cloths", "python -m benchmarks batch")
    for part in options.only:
        PARTS[part](options, report)
    return report


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def _throughput(options: argparse.Namespace, report: Report) -> None:
    columns = ["cloths", "particles", "threads", "x real time", "least", "most", "evaluations a frame"]
    columns.append("core ms a frame")
    table = report.add_table(
        "A vector environment, each cloth carried by a gripper on a circle, tolerance 1e-3 m", columns
    )
    with batch_cloths.CarriedCloths(options.envs, options.resolution) as carried:
        evaluations = carried.evaluations()
        times = run_interleaved({"cloths": carried.timed}, seconds=options.seconds)["cloths"]
    factors = [options.envs * carried.period / wall for wall, _ in times]
    factor, milliseconds = statistics.median(factors), statistics.median(1e3 * core / options.envs for _, core in times)
    speeds = [factor, min(factors), max(factors)]
    table.rows.append([options.envs, options.resolution**2, _cores(), *speeds, evaluations, milliseconds])
    report.require(factor >= MIN_THROUGHPUT, f"{factor:.3g} x real time; target {MIN_THROUGHPUT:g} on two cores")
    report.note("core ms a frame: processor time of all threads, gymnasium's part included")


def _threads(options: argparse.Namespace, report: Report) -> None:
    if _cores() < 2:
        report.note("one core alone is allowed here: two threads are not timed")
        return
    columns = ["cloths", "one thread ms", "two ms", "gain", "two processes"]
    table = report.add_table("A step of the vector environment on two threads against one", columns)
    count = options.envs
    with (
        batch_cloths.CarriedCloths(count, options.resolution, threads=1) as one_thread,
        batch_cloths.CarriedCloths(count, options.resolution, threads=2) as two_threads,
        batch_cloths.ProcessPair(count, options.resolution) as apart,
    ):
        steps = {"one": one_thread.step, "two": two_threads.step, "apart": apart.step}
        turns = time_interleaved(steps, seconds=options.seconds)
        report.require(one_thread.digests() == two_threads.digests(), "two threads gave other bits than one")
    gain = turns.ratio("one", "two")
    # Two processes step twice as many cloths.
    process_gain = 2.0 * turns.ratio("one", "apart")
    table.rows.append([count, 1e3 * turns.median("one"), 1e3 * turns.median("two"), gain, process_gain])
    report.note("two processes: gain in throughput of two independent processes over one")
    if gain < min(MIN_THREAD_GAIN, (1.0 - PROCESS_PAIR_MARGIN) * process_gain):
        report.fail(f"two threads: {gain:.2f} times one; target {MIN_THREAD_GAIN:g} (apart {process_gain:.2f})")


def _memory(options: argparse.Namespace, report: Report) -> None:
    columns = ["cloths", "particles", "state kB", "a cloth kB", "to its state"]
    table = report.add_table("Memory that a further cloth of a vector environment takes", columns)
    state, per_cloth = batch_cloths.memory(options.envs, options.resolution)
    table.rows.append([options.envs, options.resolution**2, state / 1e3, per_cloth / 1e3, per_cloth / state])
    if per_cloth > MAX_MEMORY_RATIO * state:
        report.fail(f"a cloth takes {per_cloth / state:.2f} times its state; target {MAX_MEMORY_RATIO:g}")


def _rollouts(options: argparse.Namespace, report: Report) -> None:
    columns = ["futures", "frames", "particles", "contact with itself", "by", "wall s", "least", "most"]
    table = report.add_table("Rollouts of one second, the gripper moving", columns)
    methods = {}
    for self_contact in (False, True):
        batch = batch_cloths.RolloutBatch(options.rollouts, options.rollout_resolution, self_contact)
        batch.in_processes()  # Warm-up: processes start and import.
        methods[self_contact, "threads"], methods[self_contact, "processes"] = batch.in_threads, batch.in_processes
    runs = {f"{self_contact} {by}": run_rollouts for (self_contact, by), run_rollouts in methods.items()}
    turns = time_interleaved(runs, seconds=options.seconds)
    for self_contact, by in methods:
        seconds = turns.seconds[f"{self_contact} {by}"]
        row = [options.rollouts, batch.frames, options.rollout_resolution**2, "yes" if self_contact else "no", by]
        table.rows.append([*row, turns.median(f"{self_contact} {by}"), min(seconds), max(seconds)])
    best = min(turns.median("False threads"), turns.median("False processes"))
    report.require(best <= MAX_ROLLOUT_TIME, f"rollouts took {best:.2f} s; target {MAX_ROLLOUT_TIME:g} on two cores")


def _soak(options: argparse.Namespace, report: Report) -> None:
    columns = ["steps", "cloths", "episodes", "MB when warm", "MB at the end", "growth MB"]
    table = report.add_table("Random steps, with new episodes and some new cloths", columns)
    done = batch_cloths.soak(options.steps, options.envs)
    table.rows.append([*attrs.astuple(done), done.last - done.warm])
    if done.last - done.warm > LEAK:
        report.fail(f"memory grew by {done.last - done.warm:.1f} MB over {done.steps} steps")


PARTS = {"throughput": _throughput, "threads": _threads, "memory": _memory, "rollouts": _rollouts, "soak": _soak}
