# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pool of cloths, stored as snapshots and stepped by threads.

Each worker of the thread pool has one simulation of the common scene. Therefore a cloth takes only the memory of its
state. A cloth with a randomised scene has its own simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.learning.actions import ActionDecoder
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot
from cloth_sim_ros.simulation.thread_pool import ThreadPool

#: Takes a random generator and the scene; returns another scene, values of parameters by full name, or None.
Randomise = Callable[[np.random.Generator, Scene], Scene | Mapping[str, Any] | None]
#: Advances a new simulation to the start of an episode.
Prepare = Callable[[Simulation], None]


class SimulationPool:
    """Cloths that threads step together; between steps each is stored as a snapshot.

    Args:
        count: number of cloths.
        scene: the common scene.
        thread_pool: thread pool that steps the cloths.
        prepare: advances a simulation to the start of an episode.
    """

    def __init__(self, count: int, scene: Scene, thread_pool: ThreadPool, *, prepare: Prepare | None = None) -> None:
        self.scene, self.thread_pool, self._prepare = scene, thread_pool, prepare
        first = self._create_simulation(scene)
        self._initial_snapshot = first.snapshot()
        self._worker_simulations: list[Simulation | None] = [first, *[None] * (thread_pool.threads - 1)]
        self._randomised: list[Simulation | None] = [None] * count
        #: Snapshot of each cloth.
        self.snapshots: list[Snapshot] = [self._initial_snapshot] * count

    def _create_simulation(self, scene: Scene) -> Simulation:
        simulation = Simulation(scene)
        if self._prepare is not None:
            self._prepare(simulation)
        if simulation.paused:
            raise ValueError("prepare left the simulation paused, so no cloth would move; end it by Pause(False)")
        return simulation

    def save(self) -> tuple[list[Snapshot], list[Simulation | None]]:
        """Return the snapshots of all cloths and the simulations of randomised ones, for `restore`."""
        return list(self.snapshots), list(self._randomised)

    def restore(self, saved: tuple[list[Snapshot], list[Simulation | None]]) -> None:
        """Restore all cloths as `save` returned them."""
        self.snapshots[:], self._randomised[:] = saved

    def reset(self, indices: list[int], scenes: list[Scene]) -> None:
        """Start a new episode of some cloths, each from its scene; changes `snapshots`. Raises ValueError.

        Args:
            indices: indices of the cloths.
            scenes: scene of each.

        Raises:
            ValueError: if a scene has other particles, grippers or rate than the common scene.
        """
        for scene in scenes:
            self._check_compatible(scene)
        results: list[tuple[Simulation | None, Snapshot]] = [(None, self._initial_snapshot)] * len(indices)

        def start(_: int, k: int) -> None:
            if scenes[k] is not self.scene and scenes[k] != self.scene:
                simulation = self._create_simulation(scenes[k])
                results[k] = simulation, simulation.snapshot()

        self.thread_pool.run(len(indices), start)
        for i, (simulation, snapshot) in zip(indices, results, strict=True):
            self._randomised[i], self.snapshots[i] = simulation, snapshot

    def _check_compatible(self, scene: Scene) -> None:
        if scene is self.scene:
            return
        properties = {"particles": scene.shape, "grippers": scene.gripper_names, "rate": scene.rate}
        common = {"particles": self.scene.shape, "grippers": self.scene.gripper_names, "rate": self.scene.rate}
        for name, value in properties.items():
            if value != common[name]:
                cause = f"a randomised scene has {name} {value}, the environment's scene {common[name]}"
                raise ValueError(f"{cause}; actions and observations of all cloths must be alike")

    def step(
        self,
        indices: list[int],
        actions: NDArray[Any],
        decoder: ActionDecoder,
        frames: int,
        on_step: Callable[[int, Simulation, Array, int], None],
    ) -> None:
        """Step some cloths for some frames in threads; call `on_step` for each, in its thread. Changes `snapshots`.

        If one cloth fails, none is changed.

        Args:
            indices: indices of the cloths.
            actions: actions of all cloths, shape (N, grippers, 4 or 8).
            decoder: decoder of the actions.
            frames: number of frames.
            on_step: called with index, simulation, wrenches of the last frame and number of frames that missed the
                tolerance.

        Raises:
            UnstableError: if the motion of a cloth does not stay finite.
        """
        snapshots: list[Snapshot] = [self._initial_snapshot] * len(indices)

        def go(worker: int, k: int) -> None:
            i, n_missed = indices[k], 0
            simulation = self._randomised[i] or self._worker_simulations[worker]
            if simulation is None:
                simulation = self._worker_simulations[worker] = Simulation(self.scene, self._initial_snapshot.state)
            simulation.restore(self.snapshots[i])
            action = actions[i]
            for _ in range(frames):
                frame = simulation.advance(decoder.to_events(action, simulation))
                n_missed += bool(frame.advance and frame.advance.flagged)
            on_step(i, simulation, frame.wrenches, n_missed)
            snapshots[k] = simulation.snapshot()

        self.thread_pool.run(len(indices), go)
        for i, snapshot in zip(indices, snapshots, strict=True):
            self.snapshots[i] = snapshot
