# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The fused plan of a regular sheet: its spring terms in one vectorised pass, and whole leapfrog runs in one compiled
loop.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from cloth_sim_ros.physics.alternation import STIFFER, stable_share
from cloth_sim_ros.physics.dynamics import TERM_STEP, THOROUGH, Economy
from cloth_sim_ros.physics.integrators.march import leapfrog_by_terms
from cloth_sim_ros.physics.kernels.grid_bounds import GridBounds
from cloth_sim_ros.physics.kernels.grid_forces import GridForces
from cloth_sim_ros.physics.kernels.grid_leapfrog import GridGrips, GridLeapfrog, GridTurns
from cloth_sim_ros.physics.kernels.grid_springs import GridSprings
from cloth_sim_ros.physics.kernels.held_points import BOOKED_NUMBERS, POSE_NUMBERS, tabulate_poses
from cloth_sim_ros.physics.terms.drag import Drag
from cloth_sim_ros.physics.terms.gravity import Gravity
from cloth_sim_ros.physics.terms.grips import Grips, WrenchObserver
from cloth_sim_ros.physics.terms.wind import Wind

if TYPE_CHECKING:
    from cloth_sim_ros.physics.dynamics import Dynamics
    from cloth_sim_ros.physics.integrators.base import Observer
    from cloth_sim_ros.physics.terms.base import Array


#: Cost of a step for one particle [ns].
_STEP = 6.0


class GridPlan:
    """Takes over the spring terms of a grid; equal to their sum to rounding.

    The leapfrog is fused where the model has no other terms than these, gravity, drag, wind and grips. That is
    decided by the scene alone. Wrenches come out of the compiled loop; any other observer watches a copy of the run
    that goes by terms beside it, so that it changes no bit of this one.

    Args:
        dynamics: the equations whose terms are taken over; it gets the plan.
        springs: its springs as families of a grid.
        names: names of the terms that `springs` stands for.
    """

    def __init__(self, dynamics: Dynamics, springs: GridSprings, names: frozenset[str]) -> None:
        self.names = names
        self._dynamics = dynamics
        dynamics.forces = dynamics.plan = self
        model = dynamics.model
        self._forces = GridForces(springs)
        self._bounds = GridBounds(springs, model.inverse_masses)
        #: The largest rates of these terms alone, and the blocks of some particles: see `stability.Bounds`.
        self.rates, self.blocks = self._bounds.rates, self._bounds.blocks
        self._loop: Callable[[Any], GridLeapfrog] | None = None
        self._grips: Grips | None = None
        drag, pushes = 0.0, []
        for term in model.terms:
            if term.name in names:
                continue
            if isinstance(term, Gravity | Wind):
                pushes.append(term.acceleration)
            elif isinstance(term, Drag):
                drag = term.rate
            elif isinstance(term, Grips):
                self._grips = term
            else:
                return
        gravity = sum(pushes[1:], pushes[0]) if pushes else None
        threads = _threads(springs)

        # Each precision has a loop of its own, made when it is first asked for.
        @cache
        def loop(dtype: Any) -> GridLeapfrog:
            beside = None if dtype == np.float64 else loop(np.float64)
            return GridLeapfrog(
                *(springs, model.inverse_masses),
                gravity=gravity,
                drag=drag,
                dtype=dtype,
                threads=threads,
                beside=beside,
            )

        self._loop = loop

    def add_forces(self, x: Array, v: Array, f: Array) -> None:
        """Add the forces [N] of the terms that are taken over to f (3, n)."""
        self._forces.add(x, v, f)

    def add_bounds(self, x: Array, stiff: Array, damped: Array) -> None:
        """Add the blocks of the terms that are taken over: stiff [N/m], damped [N s/m], each (6, n)."""
        self._bounds.add(x, stiff, damped)

    def leapfrog(
        self,
        t: float,
        x: Array,
        v: Array | None,
        step: float,
        steps: int,
        observer: Observer | None,
        weight: float,
        *,
        economy: Economy = THOROUGH,
        start: tuple[Array, Array] | None = None,
    ) -> None:
        """Advance x, v (3, n) in place, or from `start`, see `integrators.march.leapfrog`, from time t by so many steps
        [s]; the observer's weights are multiplied by weight. Single precision is about the first particle; what changes
        is added in double.
        """
        wrenches = observer if observer is not None and isinstance(observer, WrenchObserver) else None
        if self._loop is None:
            leapfrog_by_terms(self._dynamics, t, x, v, step, steps, observer, weight, start=start)
            return
        if observer is not None and wrenches is None:
            x0, v0 = (x, v) if start is None else start
            assert v0 is not None
            leapfrog_by_terms(self._dynamics, t, x0.copy(), v0.copy(), step, steps, observer, weight)
        grips, order = self._held(t, step, steps)
        loop = self._loop(np.float32 if economy.narrow else np.float64)
        loop.advance(x, v, steps, step, grips=grips, alternate=economy.alternate, start=start)
        if wrenches is not None:
            back, duration = np.argsort(order), weight * step * steps
            if grips is not None and grips.turns is not None:
                wrenches.add_booked(grips.turns.booked[back], duration, weight)
            else:
                booked = None if grips is None else np.column_stack([grips.impulses, grips.work])[back]
                wrenches.add_run(booked, duration, weight)

    @property
    def fused(self) -> bool:
        """Whether the leapfrog is taken over."""
        return self._loop is not None

    @property
    def step_cost(self) -> float:
        """Estimated cost of a step for one particle [ns]."""
        return _STEP if self.fused else TERM_STEP

    def narrows(self) -> bool:
        """Whether single precision would make a difference to the next run."""
        return self.fused

    @cached_property
    def alternate_share(self) -> float:
        """Share of the step limit up to which weak springs may be taken at every second step; 0 where they may not."""
        masses = self._dynamics.model.masses
        return stable_share(self._bounds.springs.families, float(np.median(masses))) if self.fused else 0.0

    def alternate_stiffest(self) -> float:
        """Bound of the squared frequency [1/s^2] up to which that holds, held as the sheet is held now."""
        springs, count = self._bounds.springs, self._dynamics.model.particle_count
        lengths = {family.name: family.rest_length for family in springs.families}
        rows, columns = np.divmod(np.arange(count), springs.columns)
        flat = np.stack([lengths["right"] * columns, lengths["down"] * rows, np.zeros(count)])
        return STIFFER * self._dynamics.rates(flat)[0]

    def _turns(self, grips: Grips, order: np.ndarray, t: float, step: float, steps: int) -> GridTurns | None:
        """Poses at each step, where a gripper that holds something turns; else points follow cubics."""
        if not grips.paths[np.diff(grips.starts) > 0, 17:26].any():
            return None
        # Zeros: of a gripper that holds nothing no pose is set, and all are moved to the run's origin.
        poses = np.zeros((steps + 1, len(grips.paths), POSE_NUMBERS))
        tabulate_poses(grips.paths, grips.starts, t, step, poses)
        booked = np.zeros((len(order), BOOKED_NUMBERS))
        return GridTurns(grips.owners()[order], grips.offsets[order], poses, booked)

    def _held(self, t: float, step: float, steps: int) -> tuple[GridGrips | None, np.ndarray]:
        """The grips in order of particles, their points as cubics of the time since t or with their turns, and that
        order.
        """
        grips = self._grips
        if grips is None or not grips.particles.size:
            return None, np.empty(0, dtype=np.int64)
        order = np.argsort(grips.particles, kind="stable")
        owner = grips.owners()[order]
        path = grips.paths[owner]
        p0, p1, p2, p3 = (path[:, first : first + 3] for first in (1, 4, 7, 10))
        s = (t - path[:, 0])[:, None]
        shifted = np.stack(
            [p0 + s * (p1 + s * (p2 + s * p3)), p1 + s * (2 * p2 + 3 * s * p3), p2 + 3 * s * p3, p3], axis=-1
        )
        shifted[:, :, 0] += grips.arms()[order]
        count = len(order)
        return GridGrips(
            grips.particles[order],
            np.ascontiguousarray(shifted),
            grips.stiffness[order],
            grips.damping[order],
            np.zeros((count, 3)),
            np.zeros(count),
            self._turns(grips, order, t, step, steps),
        ), order


#: Particles from which a second thread gains more than meeting it costs. The bits do not depend on it.
_WORTH_A_THREAD = 3000


def _threads(springs: GridSprings) -> int:
    """How many threads take the steps of a sheet."""
    cores = len(os.sched_getaffinity(0))
    return 2 if cores > 1 and springs.rows * springs.columns >= _WORTH_A_THREAD and springs.rows >= 16 else 1
