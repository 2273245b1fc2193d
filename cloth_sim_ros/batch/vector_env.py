# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cloths for learning: a `gymnasium.vector.VectorEnv` of N cloths in one process, stepped on all cores.

Each cloth moves to the last bit as a `Simulation` of its own does, whatever the number of threads and of cloths.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.batch import registered as registered
from cloth_sim_ros.batch.actions import Commands
from cloth_sim_ros.batch.crew import Crew
from cloth_sim_ros.batch.future import particles_of, put
from cloth_sim_ros.batch.herd import Herd, Prepare, Randomise
from cloth_sim_ros.batch.outcome import Judge, Outcome, judged
from cloth_sim_ros.batch.seeds import Generators
from cloth_sim_ros.batch.spaces import (
    action_space,
    mask_of,
    mode_of,
    observation_space,
    scene_of,
    whole_number,
    workspace_of,
)
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.uncopyable import Uncopyable
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot

#: Most speed of a gripper's target where nothing else is asked for [m/s].
SPEED = 1.0


class ClothVectorEnv(Uncopyable, VectorEnv[Any, Any, Any]):
    """N cloths that grippers move.

    The action of a cloth has for each gripper its target's position [m], a quaternion x, y, z, w if `orientations`, and
    a grasp from 0 to 1, closed from 0.5 on: shape (grippers, 4 or 8), float32. Its observation has the positions [m] of
    particles, and their velocities [m/s] if `velocities`: shape (m, 3 or 6), float32.

    `infos` has of each cloth under ``flagged`` in how many frames of the step the tolerance was missed.

    Args:
        num_envs: number of cloths.
        scene: what each is: a `Scene`, a ROS parameter file, or values of parameters by full name. The default scene,
            at a tolerance of a millimetre, where left out.
        reward: takes an `Outcome`, gives a number for each cloth; 0 where left out.
        terminated: takes an `Outcome`, says of each cloth whether its episode is over; never where left out.
        max_episode_steps: after which an episode is truncated; None for never.
        prepare: takes a fresh `Simulation` and brings it to where episodes begin, e.g. lets a gripper take a corner.
        randomise: takes a `numpy.random.Generator`, each cloth's own, and the scene, at each reset; gives another
            scene, values of parameters to change, or None. A cloth that was changed is made anew, which takes
            milliseconds; others are put back.
        frames_per_step: frames that an action lasts.
        particles: which particles are observed; all where left out.
        velocities: whether velocities are observed.
        orientations: whether actions have orientations.
        workspace: where targets may be [m], lowest and highest corner, shape (2, 3); where left out, twice the cloth's
            size beyond where it starts.
        speed: most speed of a gripper's target [m/s]: it is reached over several frames where it is far. A gripper's
            first target places it at once.
        autoreset_mode: ``NextStep``, ``SameStep`` or ``Disabled``, see gymnasium.vector.AutoresetMode.
        threads: None takes the cores that this process may use.
        copy: whether observations are copies; else all are one array, which the next step writes into.

    Raises:
        ValueError: for a value out of range; the message names it.
    """

    copy_refusal = (
        "an environment's cloths own memory of the engine, and can't be copied or pickled; make another environment, "
        "or try futures of its snapshots by rollouts()"
    )

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scene: Scene | str | Path | Mapping[str, Any] | None = None,
        reward: Judge | None = None,
        terminated: Judge | None = None,
        max_episode_steps: int | None = None,
        prepare: Prepare | None = None,
        randomise: Randomise | None = None,
        frames_per_step: int = 1,
        particles: ArrayLike | None = None,
        velocities: bool = False,
        orientations: bool = False,
        workspace: ArrayLike | None = None,
        speed: float = SPEED,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        copy: bool = True,
    ) -> None:
        self.num_envs = whole_number("num_envs", num_envs)
        self._frames = whole_number("frames_per_step", frames_per_step)
        self._most = None if max_episode_steps is None else whole_number("max_episode_steps", max_episode_steps)
        self.autoreset_mode = mode_of(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self._reward, self._terminated, self._randomise, self._copy = reward, terminated, randomise, copy
        #: The scene of all cloths that are not randomised.
        self.scene = scene_of(scene)
        self._commands = Commands(self.scene, turned=orientations, speed=speed)
        start = self.scene.initial_positions()
        self._chosen, count = particles_of(particles, len(start))
        self._box = self.single_action_space = action_space(self._commands, workspace_of(workspace, start))
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        shape = (count, 6 if velocities else 3)
        self.single_observation_space = observation_space(shape)
        self.observation_space = observation_space((self.num_envs, *shape))
        self._crew = Crew(threads)
        self._herd = Herd(self.num_envs, self.scene, self._crew, prepare=prepare)
        self._observations = np.zeros((self.num_envs, *shape), dtype=np.float32)
        self._wrenches = np.zeros((self.num_envs, len(self._commands.names), 6))
        self._flagged = np.zeros(self.num_envs, dtype=np.int64)
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)
        #: Whether each cloth's episode is over, and whether it has begun at all.
        self._over = np.zeros(self.num_envs, dtype=bool)
        self._begun = np.zeros(self.num_envs, dtype=bool)
        self._generators = Generators(self.num_envs)

    @property
    def snapshots(self) -> tuple[Snapshot, ...]:
        """Where each cloth is: to be rolled out, or restored in a `Simulation` of its scene."""
        return tuple(self._herd.snapshots)

    @property  # type: ignore[misc]
    def np_random(self) -> Any:
        """Each cloth's random generator."""
        return self._generators.all()

    @property
    def np_random_seed(self) -> Any:
        """What each cloth's random generator was seeded with."""
        return self._generators.seeds()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Let all cloths begin anew, or those that ``options["reset_mask"]``, shape (num_envs,), names.

        Args:
            seed: of the first cloth's generator, the next having the next number; or one for each. Generators go on
                where it is left out.
            options: may have ``reset_mask``.

        Returns:
            Observations, shape (num_envs, m, 3 or 6), and nothing else.

        Raises:
            ValueError: for seeds or a mask of another shape.
        """
        indices = np.flatnonzero(mask_of(options, self.num_envs)).tolist()
        self._generators.seed(seed, indices)
        self._begin(indices)
        return self._told(), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Let all cloths go on, each by its action; actions have shape (num_envs, grippers, 4 or 8).

        Returns:
            Observations, rewards, terminations, truncations and infos.

        Raises:
            ValueError: for actions of another shape, not finite, or outside `action_space`; no cloth has moved then.
            RuntimeError: before the first reset; after `close`; with autoreset disabled, for an episode that is over.
        """
        acts = self._checked(actions)
        again = np.flatnonzero(self._over).tolist() if self.autoreset_mode is AutoresetMode.NEXT_STEP else []
        moved, before = ~self._over, self.snapshots
        try:
            self._herd.step(np.flatnonzero(moved).tolist(), acts, self._commands, self._frames, self._tell)
            outcome = self._outcome(acts, moved)
            rewards = np.where(moved, judged("reward", self._reward, outcome, np.float64), 0.0)
            terminations = judged("terminated", self._terminated, outcome, bool) & moved
        except BaseException:
            self._herd.snapshots[:] = before
            self._look(range(self.num_envs))
            raise
        self._elapsed = outcome.elapsed
        truncations = np.zeros(self.num_envs, dtype=bool) if self._most is None else (self._elapsed >= self._most)
        truncations &= moved
        self._over = terminations | truncations
        self._begin(again)
        infos: dict[str, Any] = {}
        told = moved
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._over.any():
            over, told = np.flatnonzero(self._over).tolist(), moved & ~self._over
            for i in over:
                last = {"final_obs": self._observations[i].copy(), "final_info": {"flagged": int(self._flagged[i])}}
                infos = self._add_info(infos, last, i)
            self._begin(over)
        if told.any():
            infos.update({"flagged": np.where(told, self._flagged, 0), "_flagged": told.copy()})
        return self._told(), rewards, terminations, truncations, infos

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._crew.close()

    def _checked(self, actions: ArrayLike) -> NDArray[np.float32]:
        if self.closed:
            raise RuntimeError("the environment is closed: make another one")
        if not self._begun.all():
            raise RuntimeError("the cloths have not begun yet: call reset() before the first step()")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._over.any():
            over = np.flatnonzero(self._over)
            raise RuntimeError(
                f"the episode of cloth {over[0]} is over, and autoreset is disabled: begin it anew by "
                'reset(options={"reset_mask": terminations | truncations})'
            )
        acts = self._commands.checked(actions, (self.num_envs,), dtype=np.float32)
        low, high = self._box.low, self._box.high
        outside = np.argwhere((acts < low) | (acts > high))
        if len(outside):
            at = tuple(outside[0].tolist())
            raise ValueError(
                f"actions{list(at)} is {acts[at]}; it must be from {low[at[1:]]} to {high[at[1:]]}: clip actions by "
                "gymnasium.wrappers.vector.ClipAction, or make `workspace` larger"
            )
        return acts

    def _tell(self, i: int, simulation: Simulation, wrenches: Array, missed: int) -> None:
        """Write down what became of a cloth; called by its worker."""
        self._put(i, simulation.state)
        self._wrenches[i], self._flagged[i] = wrenches, missed

    def _put(self, i: int, state: Any) -> None:
        row = self._observations[i]
        put(row.reshape(len(row), -1, 3).transpose(1, 0, 2), self._chosen, state)

    def _look(self, indices: Sequence[int] | range) -> None:
        """Observe cloths where they are."""
        for i in indices:
            self._put(i, self._herd.snapshots[i].state)

    def _outcome(self, acts: NDArray[np.float32], moved: NDArray[np.bool_]) -> Outcome:
        return Outcome(
            observations=self._observations,
            actions=acts,
            wrenches=self._wrenches,
            elapsed=self._elapsed + moved,
            states=[snapshot.state for snapshot in self._herd.snapshots],
        )

    def _begin(self, indices: list[int]) -> None:
        if not indices:
            return
        scenes = [self._scene(i) for i in indices]
        self._herd.begin(indices, scenes)
        self._look(indices)
        self._elapsed[indices] = 0
        self._wrenches[indices] = 0.0
        self._over[indices], self._begun[indices] = False, True

    def _scene(self, i: int) -> Scene:
        if self._randomise is None:
            return self.scene
        found = self._randomise(self._generators.of(i), self.scene)
        if found is None or isinstance(found, Scene):
            return found or self.scene
        return scene_of(found, self.scene)

    def _told(self) -> NDArray[np.float32]:
        return self._observations.copy() if self._copy else self._observations
