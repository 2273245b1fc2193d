# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Overhead of studies: Dask per task, sessions and clouds."""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from pathlib import Path
from typing import Any

import attrs

from cloth_sim_ros.studies import study_file
from cloth_sim_ros.studies.cluster import SchedulerAddress, connect, local_scheduler
from cloth_sim_ros.studies.folder import StudyFolder
from cloth_sim_ros.studies.sampling import sample
from cloth_sim_ros.studies.study import Study
from cloth_sim_ros.studies.study_run import CommandedSimulation
from cloth_sim_ros.studies.study_runner import StudyRunner
from validation.report import Report, Table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("--resolution", type=int, default=30, help="particles a side")
    parser.add_argument("--runs", type=int, default=8, help="of each study")
    parser.add_argument("--seconds", type=float, default=4.0, help="simulated, of each run")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--tasks", type=int, default=3000, help="empty tasks for Dask's own cost")


def run(options: argparse.Namespace) -> Report:
    """Measure a study."""
    study = _study(options)
    report = Report("Studies")
    with local_scheduler(options.workers, lambda _text: None) as address:
        task = _task_cost(address, options.tasks)
        rows: list[list[Any]] = [["simulations alone, in processes", *_plain(study, options.workers), 0.0]]
        _through_cloth_batch(
            address, attrs.evolve(study, runs=options.workers)
        )  # Warm-up: workers import their modules.
        for clouds in (False, True):
            label = f"cloth_batch {'with' if clouds else 'without'} clouds"
            rows.append([label, *_through_cloth_batch(address, attrs.evolve(study, clouds=clouds))])
    simulated = options.runs * options.seconds
    columns = ["what", "wall s", "core s", "times real time", "a core", "of plain %", "a core %"]
    columns.append("kB a simulated second")
    table = report.add_table("throughput", columns)
    _, plain, plain_work, _ = rows[0]
    for label, wall, work, size in rows:
        shares = [simulated / wall, simulated / work, 100.0 * plain / wall, 100.0 * plain_work / work]
        table.rows.append([label, wall, work, *shares, size / simulated / 1e3])
    costs = [options.tasks, 1e3 * task[0], 1e3 * task[1]]
    report.tables.append(Table("Dask", ["tasks", "wall ms a task", "core ms of scheduler and client a task"], [costs]))
    report.note(
        f"a cloth of {options.resolution} x {options.resolution} particles, a corner carried by a gripper all the "
        f"time, tolerance 1 mm; {options.workers} processes with a thread each. Dask's cost is that of empty tasks "
        "through one scheduler, client and workers on the same cores: an upper bound. Core seconds are the processes' "
        "own; on a machine that does other things they tell more than wall seconds"
    )
    return report


def _study(options: argparse.Namespace) -> Study:
    """Return a study in which a gripper grasps a corner at once and never stops."""
    content = {
        "scene": "cloth_sim.yaml",
        "parameters": {
            "cloth.resolution": [options.resolution, options.resolution],
            "tolerance": 1e-3,
            "gripper.radius": 0.1,
        },
        "scripts": "grasp.yaml",
        "duration": options.seconds,
        "runs": options.runs,
        "vary": {"material.density": {"uniform": [0.18, 0.22]}},
    }
    study = study_file.from_dict(content, folder=Path())
    (script,) = study.scripts
    # The approach is cut off: the cloth moves from the grasp on.
    grasp = script.grasps[0].time
    begun = [attrs.evolve(w, time=w.time - grasp) for w in script.waypoints if w.time >= grasp]
    grasps = (attrs.evolve(script.grasps[0], time=0.0),)
    return attrs.evolve(study, scripts=(attrs.evolve(script, waypoints=tuple(begun), grasps=grasps),))


def _task_cost(address: SchedulerAddress, tasks: int) -> tuple[float, float]:
    """Return wall time and core time per empty task [s]. This process is scheduler and client."""
    with connect(address, wait=30.0) as client:
        client.gather(client.map(abs, range(100), pure=False))
        begun, worked = time.perf_counter(), time.process_time()
        client.gather(client.map(abs, range(tasks), pure=False))
        return (time.perf_counter() - begun) / tasks, (time.process_time() - worked) / tasks


def _plain(study: Study, workers: int) -> tuple[float, float]:
    """Return wall time and core time [s] of the same runs as plain simulations in independent processes."""
    samples = sample(study.factors, runs=study.runs, seed=study.seed, sampling=study.sampling)
    name = study.factors[0].name
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        # Each process imports and builds once before the clock runs.
        warm = attrs.evolve(study, duration=0.1)
        pool.starmap(_simulate, [(warm, run, {name: samples[run][0]}) for run in range(workers)], chunksize=1)
        begun = time.perf_counter()
        work = pool.starmap(_simulate, [(study, run, {name: v[0]}) for run, v in enumerate(samples)], chunksize=1)
        return time.perf_counter() - begun, sum(work)


def _simulate(study: Study, run: int, named: dict[str, Any]) -> float:
    """Run a simulation; return its core time [s]."""
    begun = time.process_time()
    motion = CommandedSimulation.create(study, run, named)
    for _ in range(motion.n_frames):
        motion.advance()
    return time.process_time() - begun


def _through_cloth_batch(address: SchedulerAddress, study: Study) -> tuple[float, float, float]:
    """Return wall time [s], core time [s] and bytes of the study's sessions on a running cluster."""
    samples = sample(study.factors, runs=study.runs, seed=study.seed, sampling=study.sampling)
    rows: dict[int, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        study_folder = StudyFolder(Path(folder) / "study")
        study_folder.create(study, samples, "")
        runner = StudyRunner(study_folder, study, samples, 10.0, rows.__setitem__)
        begun = time.perf_counter()
        runner.run(address, range(study.runs), wait=30.0)
        wall = time.perf_counter() - begun
    return wall, sum(row["cpu_time"] for row in rows.values()), float(sum(row["bytes"] for row in rows.values()))
