# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many cloths in one process: speed, threads, memory, rollouts, random steps."""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any, Self

import numpy as np

from benchmarks.timing import run_interleaved, time_interleaved
from cloth_sim_ros import Grasp, Scene, Simulation, Target
from cloth_sim_ros.learning.parallel_rollouts import rollouts
from validation.command import at_least
from validation.report import Report

#: The gripper's circle: radius [m] and angular frequency [rad/s]; a speed of 0.3 m/s.
RADIUS, FREQUENCY = 0.1, 3.0
#: Frames before the timing, in which the motion from the grasp decays.
WARM_UP_FRAMES = 30


def hung(resolution: int, **values: Any) -> Scene:
    """Return a 1 m x 1 m sheet hung by its upper edge, as in `config/cloth_sim.yaml`; tolerance 1 mm."""
    still = {"tolerance": 1e-3, "wind.normal_drag": 0.0}
    return Scene.from_parameters({"cloth.resolution": [resolution, resolution], **still, **values})


def take_corner(simulation: Simulation) -> None:
    """Close the gripper on the last corner."""
    corner = simulation.positions[-1]
    simulation.advance([Target("gripper", corner), Grasp("gripper", True)])


class CarriedCloths:
    """Vector environment whose grippers carry the last corners on circles with different phases.

    Args:
        count: number of cloths.
        resolution: particles a side.
        threads: None takes all cores.
    """

    def __init__(self, count: int, resolution: int, threads: int | None = None) -> None:
        from cloth_sim_ros.learning.vector_env import ClothVectorEnv

        self.cloths = ClothVectorEnv(count, scene=hung(resolution), prepare=take_corner, threads=threads)
        self.period = self.cloths.scene.period
        self._corner = self.cloths.reset(seed=0)[0][0, -1].astype(np.float64)
        self._phases = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        self._frame = 0
        for _ in range(WARM_UP_FRAMES):
            self.step()

    def step(self) -> None:
        """Advance all cloths by one frame."""
        self._frame += 1
        t = self._frame * self.period
        # The radius ramps up within half a second.
        angle, size = FREQUENCY * t + self._phases, RADIUS * min(1.0, 2.0 * t)
        actions = np.ones((len(angle), 1, 4), dtype=np.float32)
        actions[:, 0, :3] = self._corner
        actions[:, 0, 0] -= size * (1.0 - np.cos(angle))
        actions[:, 0, 1] += size * np.sin(angle)
        self.cloths.step(actions)

    def timed(self) -> tuple[float, float]:
        """Advance all cloths by one frame; return wall time and processor time of all threads [s]."""
        wall, core = time.perf_counter(), time.process_time()
        self.step()
        return time.perf_counter() - wall, time.process_time() - core

    def evaluations(self, frames: int = 20) -> float:
        """Return the mean number of force evaluations per frame of the first cloth, over its next frames."""
        simulation = Simulation(self.cloths.scene)
        simulation.restore(self.cloths.snapshots[0])
        done = 0
        for k in range(1, frames + 1):
            angle = FREQUENCY * (self._frame + k) * self.period
            displacement = np.array([RADIUS * (np.cos(angle) - 1.0), RADIUS * np.sin(angle), 0.0])
            advance = simulation.advance([Target("gripper", self._corner + displacement)]).advance
            done += advance.evaluations if advance is not None else 0
        return done / frames

    def digests(self) -> list[str]:
        """Return the digests of all cloths' states."""
        return [snapshot.state.digest() for snapshot in self.cloths.snapshots]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.cloths.close()


#: Cloths of a process of `process_pair`.
_process_cloths: list[CarriedCloths] = []


@contextlib.contextmanager
def process_pair(count: int, resolution: int) -> Iterator[Callable[[], None]]:
    """Run two processes, each with a single-threaded environment; yield the function that steps both and waits.

    Args:
        count: cloths per process.
        resolution: particles a side.
    """
    pool = partial(ProcessPoolExecutor, 1, get_context("spawn"), _make_cloths, (count, resolution))
    with pool() as first, pool() as second:

        def step() -> None:
            for stepped in [pool.submit(_step_cloths) for pool in (first, second)]:
                stepped.result()

        step()
        yield step


def _make_cloths(count: int, resolution: int) -> None:
    _process_cloths.append(CarriedCloths(count, resolution, threads=1))


def _step_cloths() -> None:
    _process_cloths[0].step()


class RolloutBatch:
    """Rollouts of 1 s of a cloth whose corner a gripper moves.

    Args:
        count: number of rollouts.
        resolution: particles a side.
        self_contact: whether self-contact is on.
    """

    def __init__(self, count: int, resolution: int, self_contact: bool) -> None:
        simulation = Simulation(hung(resolution, **{"contact.self": self_contact}))
        take_corner(simulation)
        self.frames = round(simulation.scene.rate)
        self._snapshot = simulation.snapshot()
        start = simulation.grippers.poses()[0, :3]
        t = np.arange(1, self.frames + 1) * simulation.scene.period
        displacements = np.random.default_rng(0).uniform(-0.2, 0.2, (count, 3))
        self._actions = np.ones((count, self.frames, 1, 4))
        # A smooth path: the speed is zero at both ends.
        self._actions[:, :, 0, :3] = start + displacements[:, None] * (t * t * (3.0 - 2.0 * t))[None, :, None]

    def in_threads(self) -> None:
        """Run all rollouts in threads on all cores."""
        rollouts(self._snapshot, self._actions)

    def in_processes(self) -> None:
        """Run all rollouts with one process per core."""
        rollouts(self._snapshot, self._actions, processes=len(os.sched_getaffinity(0)))


def resident() -> float:
    """Return the private resident memory of this process [bytes]."""
    gc.collect()
    with open("/proc/self/smaps_rollup", encoding="ascii") as file:
        return sum(1024.0 * float(line.split()[1]) for line in file if line.startswith("Private_"))


def memory(count: int, resolution: int) -> tuple[float, float]:
    """Return the size of a cloth's state and the memory per further cloth of an environment [bytes].

    Args:
        count: number of cloths.
        resolution: particles a side.
    """
    cases = [(cloths, resolution) for cloths in (count, 3 * count)]
    # In separate processes: a process returns little memory to the system and reuses it for the next cloths.
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        (state, less), (_, more) = pool.starmap(_memory_use, cases, chunksize=1)
    return state, (more - less) / (2 * count)


def _memory_use(count: int, resolution: int) -> tuple[float, float]:
    """Return the size of a cloth's state and of a process with `count` cloths [bytes]."""
    with CarriedCloths(count, resolution) as some:
        state = sum(array.nbytes for array in some.cloths.snapshots[0].state.arrays().values())
        return float(state), resident()


def soak(steps: int, count: int) -> list[float]:
    """Run random steps of cloths of 6 x 6 particles.

    Episodes last 50 steps, a quarter of them with another density.

    Returns:
        Steps, cloths, episodes, and memory after a quarter of the steps and at the end [MB].
    """
    from cloth_sim_ros.learning.vector_env import ClothVectorEnv

    def randomise(random: np.random.Generator, _: Scene) -> dict[str, float] | None:
        return {"material.density": float(random.uniform(0.1, 0.3))} if random.random() < 0.25 else None

    cloths = ClothVectorEnv(count, scene=hung(6), randomise=randomise, max_episode_steps=50, frames_per_step=2)
    cloths.reset(seed=0)
    cloths.action_space.seed(0)
    rounds, episodes, warm = -(-steps // count), 0, 0.0
    for k in range(rounds):
        *_, truncations, _ = cloths.step(cloths.action_space.sample())
        episodes += int(truncations.sum())
        if k == rounds // 4:
            warm = resident()
    last = resident()
    cloths.close()
    return [rounds * count, count, episodes, warm / 1e6, last / 1e6]


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
    parser.add_argument("--envs", type=at_least(2), default=64, metavar="N", help="cloths of an environment")
    parser.add_argument("--resolution", type=at_least(2), default=30, metavar="N", help="particles a side of a cloth")
    parser.add_argument("--rollouts", type=at_least(2), default=64, metavar="K", help="number of rollouts")
    parser.add_argument(
        "--rollout-resolution", type=at_least(2), default=20, metavar="N", help="particles a side in rollouts"
    )
    parser.add_argument("--steps", type=at_least(2), default=100_000, help="of the soak, over all cloths")
    parser.add_argument("--seconds", type=float, default=20.0, help="of timing for each table")


def run(options: argparse.Namespace) -> Report:
    """Measure the selected parts."""
    report = Report("Many cloths")
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
    with CarriedCloths(options.envs, options.resolution) as carried:
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
        CarriedCloths(count, options.resolution, threads=1) as one_thread,
        CarriedCloths(count, options.resolution, threads=2) as two_threads,
        process_pair(count, options.resolution) as step_apart,
    ):
        steps = {"one": one_thread.step, "two": two_threads.step, "apart": step_apart}
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
    state, per_cloth = memory(options.envs, options.resolution)
    table.rows.append([options.envs, options.resolution**2, state / 1e3, per_cloth / 1e3, per_cloth / state])
    ratio = per_cloth / state
    report.require(ratio <= MAX_MEMORY_RATIO, f"a cloth takes {ratio:.2f} times its state; target {MAX_MEMORY_RATIO:g}")


def _rollouts(options: argparse.Namespace, report: Report) -> None:
    columns = ["futures", "frames", "particles", "contact with itself", "by", "wall s", "least", "most"]
    table = report.add_table("Rollouts of one second, the gripper moving", columns)
    runs = {}
    for self_contact, name in ((False, "no"), (True, "yes")):
        batch = RolloutBatch(options.rollouts, options.rollout_resolution, self_contact)
        batch.in_processes()  # Warm-up: processes start and import.
        runs[f"{name} threads"], runs[f"{name} processes"] = batch.in_threads, batch.in_processes
    turns = time_interleaved(runs, seconds=options.seconds)
    for name, seconds in turns.seconds.items():
        row = [options.rollouts, batch.frames, options.rollout_resolution**2, *name.split()]
        table.rows.append([*row, turns.median(name), min(seconds), max(seconds)])
    best = min(turns.median("no threads"), turns.median("no processes"))
    report.require(best <= MAX_ROLLOUT_TIME, f"rollouts took {best:.2f} s; target {MAX_ROLLOUT_TIME:g} on two cores")


def _soak(options: argparse.Namespace, report: Report) -> None:
    columns = ["steps", "cloths", "episodes", "MB when warm", "MB at the end", "growth MB"]
    table = report.add_table("Random steps, with new episodes and some new cloths", columns)
    row = soak(options.steps, options.envs)
    growth = row[-1] - row[-2]
    table.rows.append([*row, growth])
    report.require(growth <= LEAK, f"memory grew by {growth:.1f} MB over {row[0]} steps")


PARTS = {"throughput": _throughput, "threads": _threads, "memory": _memory, "rollouts": _rollouts, "soak": _soak}
