# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ensemble of cloths with uncertain parameters: mean and deviation of the motion under the same events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import attrs
import numpy as np

from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum, row_sum
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.distribution import Distribution, describe_member
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, SetParameters
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.snapshot import Snapshot
from cloth_sim_ros.simulation.thread_pool import ThreadPool


class EnsembleError(ValueError):
    """Error: a member of an ensemble cannot go on; the message names it and its parameters."""


@attrs.frozen(kw_only=True, eq=False)
class EnsembleFrame:
    """Mean and deviation of the members' positions at the end of a frame."""

    #: Index of the frame that the members have reached.
    index: int
    #: Simulated time at its end [s].
    time: float
    #: Mean position of each particle over the members [m], shape (particle_count, 3).
    mean: Array
    #: Root mean square distance of each particle from its mean [m], shape (particle_count,).
    deviation: Array

    @property
    def largest(self) -> float:
        """Largest deviation of a particle from the mean motion [m]."""
        return float(self.deviation.max())

    @property
    def root_mean_square(self) -> float:
        """Root mean square of the particles' deviations from the mean motion [m]."""
        squares = np.square(self.deviation).tolist()
        return math.sqrt(ordered_sum(squares) / len(squares))


@attrs.frozen(kw_only=True, eq=False)
class EnsembleSnapshot:
    """Full contents of all members between two frames, for `Ensemble.restore`; it can be pickled."""

    members: tuple[Snapshot, ...]
    #: Distributed parameters by full name, and the factors of each member.
    names: tuple[str, ...]
    factors: list[tuple[float, ...]]
    #: True if the members have their own parameters: after the first frame.
    varied: bool


class Ensemble:
    """Cloths that differ in uncertain parameters, and advance together under the same events.

    The members have the scene's values times their factors, see `Distribution.factors`. They begin at one state, and
    take their own parameters with the events of their first frame. An event `SetParameters` of a distributed parameter
    gives each member that value times its factor. A gripper that closes grasps in each member what it reaches there.
    No bit depends on the number of threads.

    Args:
        scene: configuration that the parameters are uncertain about.
        distribution: the uncertain parameters.
        state: initial state of all members; by default the scene's.
        members: 0 for sigma points, two for each parameter; at least 2 for a random sample of that size.
        seed: seed of the sample.
        threads: number of threads; None takes one per core that this process may use.

    Raises:
        DistributionError: if a parameter cannot vary in this scene, or a member's value is out of range.
        ValueError: if the number of members is invalid, or the state does not fit the scene.
    """

    def __init__(
        self,
        scene: Scene,
        distribution: Distribution,
        *,
        state: State | None = None,
        members: int = 0,
        seed: int = 0,
        threads: int | None = None,
    ) -> None:
        if isinstance(members, bool) or not isinstance(members, int | np.integer) or members < 0 or members == 1:
            raise ValueError(f"members is {members!r}; it must be 0 for sigma points, or at least 2")
        distribution.check_members(scene, members, seed)
        self._distribution, self._factors = distribution, distribution.factors(members, seed)
        self._start_values = [distribution.member_values(scene, factors) for factors in self._factors]
        self._pool = ThreadPool(threads)
        self._members = [Simulation(scene, state) for _ in self._factors]
        self._is_varied = False

    @property
    def size(self) -> int:
        """Number of members."""
        return len(self._members)

    @property
    def frame(self) -> int:
        """Index of the frame that the members have reached."""
        return self._members[0].frame

    @property
    def positions(self) -> Array:
        """Positions of all members [m], shape (size, particle_count, 3)."""
        return np.stack([member.positions for member in self._members])

    def advance(self, events: Sequence[Event] = ()) -> EnsembleFrame:
        """Apply events and advance all members by one frame, unless paused; raise EnsembleError with no member changed.

        If one member fails, all stay as they were.

        Raises:
            EnsembleError: if an event can't take effect in a member, or its motion does not stay finite.
        """
        before = [member.snapshot() for member in self._members]

        def go(_: int, k: int) -> None:
            try:
                self._members[k].advance(self._member_events(k, events))
            except (ValueError, UnstableError) as error:
                raise EnsembleError(f"{describe_member(k, self._start_values[k])}: {error}") from error

        try:
            self._pool.run(len(self._members), go)
        except BaseException:
            self._restore(before)
            raise
        self._is_varied = True
        return self.statistics()

    def statistics(self) -> EnsembleFrame:
        """Return mean and deviation of the members' present positions."""
        states = [member.state for member in self._members]
        # About the first member, so that particles that all members share have no deviation.
        origin, size = states[0].x, float(len(states))
        offsets = np.stack([state.x - origin for state in states])
        mean_offset = row_sum(offsets) / size
        squares = np.square(offsets - mean_offset)
        variance = row_sum(squares[:, 0] + squares[:, 1] + squares[:, 2]) / size
        return EnsembleFrame(
            index=states[0].frame,
            time=self._members[0].time,
            mean=np.ascontiguousarray((origin + mean_offset).T),
            deviation=np.sqrt(variance),
        )

    def snapshot(self) -> EnsembleSnapshot:
        """Return the full contents of all members, in microseconds a member, for `restore`."""
        return EnsembleSnapshot(
            members=tuple(member.snapshot() for member in self._members),
            names=self._distribution.names,
            factors=self._factors,
            varied=self._is_varied,
        )

    def restore(self, snapshot: EnsembleSnapshot) -> None:
        """Restore a snapshot of an ensemble of the same scene and distribution; raise ValueError for another.

        Raises:
            ValueError: for a snapshot of another scene, distribution, sample or number of members.
        """
        if len(snapshot.members) != self.size:
            raise ValueError(f"the snapshot has {len(snapshot.members)} members, the ensemble {self.size}")
        if (snapshot.names, snapshot.factors) != (self._distribution.names, self._factors):
            raise ValueError(
                f"the snapshot's members vary {', '.join(snapshot.names)} by other factors than this ensemble's; "
                "restore it in an ensemble of the same distribution, members and seed"
            )
        for member, saved in zip(self._members, snapshot.members, strict=True):
            saved.check_fits(member.scene)
        self._restore(snapshot.members)
        self._is_varied = snapshot.varied

    def close(self) -> None:
        """Stop the threads of the pool; `advance` must not follow."""
        self._pool.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _restore(self, snapshots: Sequence[Snapshot]) -> None:
        for member, saved in zip(self._members, snapshots, strict=True):
            member.restore(saved)

    def _member_events(self, k: int, events: Sequence[Event]) -> list[Event]:
        factors = self._factors[k]
        scaled = [
            SetParameters(self._distribution.scaled(event.values, factors))
            if isinstance(event, SetParameters)
            else event
            for event in events
        ]
        return scaled if self._is_varied else [SetParameters(self._start_values[k]), *scaled]
