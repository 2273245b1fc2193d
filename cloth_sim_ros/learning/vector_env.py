# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Learning environment of N cloths: a `gymnasium.vector.VectorEnv` on all cores.

Each cloth has the same bits as a separate `Simulation`, independent of the number of threads and cloths.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.learning import registered as registered
from cloth_sim_ros.learning.actions import ActionDecoder
from cloth_sim_ros.learning.outcome import Outcome, OutcomeFunction, evaluate_outcome
from cloth_sim_ros.learning.rollout import select_particles, store_particles
from cloth_sim_ros.learning.seeds import Generators
from cloth_sim_ros.learning.simulation_pool import Prepare, Randomise, SimulationPool
from cloth_sim_ros.learning.spaces import (
    action_space,
    check_positive_integer,
    make_workspace,
    observation_space,
    parse_autoreset_mode,
    reset_mask,
    scene_of,
)
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot
from cloth_sim_ros.simulation.thread_pool import ThreadPool

#: Default speed limit of a gripper's target [m/s].
SPEED = 1.0


class ClothVectorEnv(Uncopyable, VectorEnv[Any, Any, Any]):
    """Gymnasium vector environment of N cloths that grippers move.

    Actions have the shape (num_envs, grippers, 4 or 8), float32. The row of a gripper holds its target position [m] and
    a grasp from 0 to 1. A grasp of 0.5 or more closes the gripper. If `orientations` is true, a quaternion x, y, z, w
    stands between them.

    Observations have the shape (num_envs, m, 3 or 6), float32. The row of a particle holds its position [m], and its
    velocity [m/s] if `velocities` is true.

    ``infos["flagged"]`` is the number of frames of the step that missed the tolerance, for each cloth.

    Args:
        num_envs: number of cloths.
        scene: a `Scene`, a ROS parameter file, or values of parameters by full name; by default, the default scene with
            a tolerance of 1 mm.
        reward: takes an `Outcome` and returns a number for each cloth; 0 by default.
        terminated: takes an `Outcome` and returns a bool for each cloth, true at the end of its episode; by default,
            always false.
        max_episode_steps: number of steps after which an episode is truncated; None for no limit.
        prepare: takes a new `Simulation` and advances it to the start of an episode, e.g. grasps a corner.
        randomise: takes a cloth's `numpy.random.Generator` and the scene at each reset. It returns another scene,
            values of parameters, or None. A changed cloth is rebuilt in milliseconds; others are restored.
        frames_per_step: number of frames per action.
        particles: indices of the observed particles; all by default.
        velocities: true to observe velocities.
        orientations: true if actions have orientations.
        workspace: box of the targets [m], lowest and highest corner, shape (2, 3); by default, the box of the initial
            cloth, extended by twice its size.
        speed: speed limit of a gripper's target [m/s]. A gripper reaches a distant target over several frames. Its
            first target places it immediately.
        autoreset_mode: ``NextStep``, ``SameStep`` or ``Disabled``, see gymnasium.vector.AutoresetMode.
        threads: number of threads; None takes one per core that this process may use.
        copy: true to return copies of the observations; false to return one array that the next step overwrites.

    Raises:
        ValueError: if an option is out of range; the message names it.
    """

    copy_refusal = (
        "an environment's cloths own memory of the engine, and can't be copied or pickled; make another environment, "
        "or roll out its snapshots by rollouts()"
    )

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scene: Scene | str | Path | Mapping[str, Any] | None = None,
        reward: OutcomeFunction | None = None,
        terminated: OutcomeFunction | None = None,
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
        self.num_envs = check_positive_integer("num_envs", num_envs)
        self._frames_per_step = check_positive_integer("frames_per_step", frames_per_step)
        self._max_steps = (
            None if max_episode_steps is None else check_positive_integer("max_episode_steps", max_episode_steps)
        )
        self.autoreset_mode = parse_autoreset_mode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self._reward, self._terminated, self._randomise, self._copy = reward, terminated, randomise, copy
        #: Common scene of all cloths that are not randomised.
        self.scene = scene_of(scene)
        self._decoder = ActionDecoder(self.scene, has_orientations=orientations, speed=speed)
        start = self.scene.initial_positions()
        self._particles, count = select_particles(particles, len(start))
        self._action_box = self.single_action_space = action_space(self._decoder, make_workspace(workspace, start))
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        shape = (count, 6 if velocities else 3)
        self.single_observation_space = observation_space(shape)
        self.observation_space = observation_space((self.num_envs, *shape))
        self._thread_pool = ThreadPool(threads)
        self._simulations = SimulationPool(self.num_envs, self.scene, self._thread_pool, prepare=prepare)
        self._observations = np.zeros((self.num_envs, *shape), dtype=np.float32)
        self._wrenches = np.zeros((self.num_envs, len(self._decoder.names), 6))
        self._flagged = np.zeros(self.num_envs, dtype=np.int64)
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)
        # Masks of the cloths whose episode is over, and of those that were reset at least once.
        self._is_over = np.zeros(self.num_envs, dtype=bool)
        self._has_begun = np.zeros(self.num_envs, dtype=bool)
        self._generators = Generators(self.num_envs)

    @property
    def snapshots(self) -> tuple[Snapshot, ...]:
        """Snapshot of each cloth, for rollouts or for a `Simulation` of its scene."""
        return tuple(self._simulations.snapshots)

    @property  # type: ignore[misc]
    def np_random(self) -> Any:
        """Random generator of each cloth, a tuple; those without a seed are created at the first access."""
        return self._generators.generators()

    @property
    def np_random_seed(self) -> Any:
        """Seed of each cloth's random generator, a tuple."""
        return self._generators.seeds()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode of the cloths in ``options["reset_mask"]``, by default all; return observations and {}.

        Args:
            seed: seed of the first cloth's generator, which increases by 1 per cloth; or one seed for each cloth. None
                keeps the generators' states.
            options: may have ``reset_mask``, bool, shape (num_envs,).

        Returns:
            Observations, shape (num_envs, m, 3 or 6), and an empty dictionary.

        Raises:
            ValueError: if seeds or mask have another shape.
            RuntimeError: after `close`.
        """
        self._check_open()
        indices = np.flatnonzero(reset_mask(options, self.num_envs)).tolist()
        self._generators.seed(seed, indices)
        self._begin(indices)
        return self._returned_observations(), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step all cloths, each by its action; return observations, rewards, terminations, truncations, infos.

        Args:
            actions: shape (num_envs, grippers, 4 or 8).

        Returns:
            Observations, rewards, terminations, truncations and infos.

        Raises:
            ValueError: if actions have another shape, are not finite, or lie outside `action_space`. No cloth moves.
            RuntimeError: before the first reset, after `close`, or if an episode is over and autoreset is disabled.
        """
        checked = self._check_actions(actions)
        cloths = self._simulations.save()
        arrays = self._elapsed.copy(), self._is_over.copy(), self._wrenches.copy(), self._flagged.copy()
        try:
            return self._step(checked)
        except BaseException:
            self._simulations.restore(cloths)
            self._elapsed, self._is_over, self._wrenches, self._flagged = arrays
            self._observe(range(self.num_envs))
            raise

    def _step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step all cloths by checked actions; an exception leaves some of them stepped."""
        reset_indices = np.flatnonzero(self._is_over).tolist() if self.autoreset_mode is AutoresetMode.NEXT_STEP else []
        is_stepped = ~self._is_over
        indices, decoder = np.flatnonzero(is_stepped).tolist(), self._decoder
        self._simulations.step(indices, actions, decoder, self._frames_per_step, self._store_step)
        outcome = self._outcome(actions, is_stepped)
        rewards = np.where(is_stepped, evaluate_outcome("reward", self._reward, outcome, np.float64), 0.0)
        terminations = evaluate_outcome("terminated", self._terminated, outcome, bool) & is_stepped
        self._elapsed = self._elapsed + is_stepped
        truncations = np.zeros(self.num_envs, dtype=bool)
        if self._max_steps is not None:
            truncations = (self._elapsed >= self._max_steps) & is_stepped
        self._is_over = terminations | truncations
        self._begin(reset_indices)
        infos: dict[str, Any] = {}
        is_reported = is_stepped
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._is_over.any():
            over_indices, is_reported = np.flatnonzero(self._is_over).tolist(), is_stepped & ~self._is_over
            for i in over_indices:
                last = {"final_obs": self._observations[i].copy(), "final_info": {"flagged": int(self._flagged[i])}}
                infos = self._add_info(infos, last, i)
            self._begin(over_indices)
        if is_reported.any():
            infos.update({"flagged": np.where(is_reported, self._flagged, 0), "_flagged": is_reported.copy()})
        return self._returned_observations(), rewards, terminations, truncations, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the threads; `close` calls it."""
        self._thread_pool.close()

    def _check_open(self) -> None:
        if self.closed:
            raise RuntimeError("the environment is closed: make another environment")

    def _check_actions(self, actions: ArrayLike) -> NDArray[np.float32]:
        self._check_open()
        if not self._has_begun.all():
            raise RuntimeError("the cloths have no episode yet: call reset() before the first step()")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._is_over.any():
            over = np.flatnonzero(self._is_over)
            remedy = 'start a new one by reset(options={"reset_mask": terminations | truncations})'
            raise RuntimeError(f"the episode of cloth {over[0]} is over, and autoreset is disabled: {remedy}")
        checked = self._decoder.validate(actions, (self.num_envs,), dtype=np.float32)
        low, high = self._action_box.low, self._action_box.high
        outside = np.argwhere((checked < low) | (checked > high))
        if len(outside):
            at = tuple(outside[0].tolist())
            raise ValueError(
                f"actions{list(at)} is {checked[at]}; it must be from {low[at[1:]]} to {high[at[1:]]}: clip actions by "
                "gymnasium.wrappers.vector.ClipAction, or make `workspace` larger"
            )
        return checked

    def _store_step(self, i: int, simulation: Simulation, wrenches: Array, n_missed: int) -> None:
        """Store observation, wrenches and flags of a stepped cloth; called by its worker."""
        self._store_state(i, simulation.state)
        self._wrenches[i], self._flagged[i] = wrenches, n_missed

    def _store_state(self, i: int, state: Any) -> None:
        row = self._observations[i]
        store_particles(row.reshape(len(row), -1, 3).transpose(1, 0, 2), self._particles, state)

    def _observe(self, indices: Sequence[int] | range) -> None:
        """Store the observations of cloths from their snapshots."""
        for i in indices:
            self._store_state(i, self._simulations.snapshots[i].state)

    def _outcome(self, actions: NDArray[np.float32], is_stepped: NDArray[np.bool_]) -> Outcome:
        # Functions of the user must not write into the environment's arrays, nor into the caller's actions.
        return Outcome(
            observations=_read_only(self._observations),
            actions=_read_only(actions),
            wrenches=_read_only(self._wrenches),
            elapsed=_read_only(self._elapsed + is_stepped),
            states=[snapshot.state for snapshot in self._simulations.snapshots],
        )

    def _begin(self, indices: list[int]) -> None:
        if not indices:
            return
        scenes = [self._scene(i) for i in indices]
        self._simulations.reset(indices, scenes)
        self._observe(indices)
        self._elapsed[indices] = 0
        self._wrenches[indices] = 0.0
        self._is_over[indices], self._has_begun[indices] = False, True

    def _scene(self, i: int) -> Scene:
        if self._randomise is None:
            return self.scene
        randomised = self._randomise(self._generators.generator(i), self.scene)
        if randomised is None or isinstance(randomised, Scene):
            return randomised or self.scene
        return scene_of(randomised, self.scene)

    def _returned_observations(self) -> NDArray[np.float32]:
        return self._observations.copy() if self._copy else self._observations


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view of an array that can't be written."""
    view = array.view()
    view.setflags(write=False)
    return view
