# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cloths of the batch benchmark: environments, process pairs, rollouts, random steps."""

from __future__ import annotations

import gc
import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from typing import Any, Self

import attrs
import numpy as np

from cloth_sim_ros.learning.parallel_rollouts import rollouts
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

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


class ProcessPair:
    """Two processes, each with its own single-threaded environment, stepped concurrently.

    Args:
        count: cloths per process.
        resolution: particles a side.
    """

    def __init__(self, count: int, resolution: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipes: list[Connection] = []
        self._processes = []
        for _ in range(2):
            parent_end, child_end = context.Pipe()
            process = context.Process(target=_steps, args=(child_end, count, resolution), daemon=True)
            process.start()
            self._pipes.append(parent_end)
            self._processes.append(process)
        for pipe in self._pipes:
            pipe.recv()

    def step(self) -> None:
        """Step both environments once and wait for both."""
        for pipe in self._pipes:
            pipe.send(True)
        for pipe in self._pipes:
            pipe.recv()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for pipe, process in zip(self._pipes, self._processes, strict=True):
            pipe.send(False)
            process.join()


def _steps(pipe: Any, count: int, resolution: int) -> None:
    with CarriedCloths(count, resolution, threads=1) as carried:
        pipe.send(True)
        while pipe.recv():
            carried.step()
            pipe.send(True)


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
    # In separate processes: a process returns little memory to the system and reuses it for the next cloths.
    (state, less), (_, more) = (_in_a_process(cloths, resolution) for cloths in (count, 3 * count))
    return state, (more - less) / (2 * count)


def _in_a_process(count: int, resolution: int) -> tuple[float, float]:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_memory_use, (count, resolution))


def _memory_use(count: int, resolution: int) -> tuple[float, float]:
    """Return the size of a cloth's state and of a process with `count` cloths [bytes]."""
    with CarriedCloths(count, resolution) as some:
        state = sum(array.nbytes for array in some.cloths.snapshots[0].state.arrays().values())
        return float(state), resident()


@attrs.frozen
class Soak:
    """A long run of random steps."""

    steps: int
    cloths: int
    episodes: int
    #: Memory after a quarter of the steps, and at the end [MB].
    warm: float
    last: float


def soak(steps: int, count: int) -> Soak:
    """Run random steps of cloths of 6 x 6 particles; episodes last 50 steps, a quarter of them with another density."""
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
    return Soak(rounds * count, count, episodes, warm / 1e6, last / 1e6)
