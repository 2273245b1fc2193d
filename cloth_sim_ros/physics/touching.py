# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A plan's contact with obstacles: what the engine is told of them, and what it is asked."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import (
    ANCHOR_NUMBERS,
    BOOKED_NUMBERS,
    PATH_NUMBERS,
    SHAPES,
    address,
    check,
    doubles,
    library,
    writable,
)
from cloth_sim_ros.physics.forces.contact import Contact
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.remembered import ANCHORS
from cloth_sim_ros.physics.state import State

#: A part is stepped for so many times the energy that contact is expected to take up: neighbours may push, too.
_EXPECTED = 1.5


class Touching:
    """The contact of one plan.

    Args:
        handle: the engine's plan.
        contact: the force.
        particle_count: of the model.
    """

    def __init__(self, handle: int, contact: Contact, particle_count: int) -> None:
        self._library, self._handle, self.force = library(), handle, contact
        self._shape = (3, particle_count)
        self._seen = self._moved = -1
        self._taken: Array | None = None

    @property
    def count(self) -> int:
        """Number of obstacles."""
        return len(self.force.obstacles)

    def sync(self) -> None:
        """Tell the engine what obstacles there are and how they move, where that changed."""
        force = self.force
        if force.changes == self._seen and force.moves == self._moved:
            return
        paths = np.ascontiguousarray(force.paths, dtype=np.float64)
        if paths.shape != (self.count, PATH_NUMBERS):
            raise ValueError(f"paths have shape {paths.shape}; they must be {(self.count, PATH_NUMBERS)}")
        if not np.isfinite(paths).all():
            raise ValueError(f"paths of obstacles are {paths.tolist()}; all numbers must be finite")
        if force.changes != self._seen:
            shapes = np.array([SHAPES[obstacle.shape] for obstacle in force.obstacles], dtype=np.int64)
            sizes = np.zeros((self.count, 3))
            for row, obstacle in zip(sizes, force.obstacles, strict=True):
                row[: len(obstacle.size)] = obstacle.size
            radii = np.array([obstacle.reach for obstacle in force.obstacles], dtype=np.float64)
            frictions = np.array([obstacle.friction for obstacle in force.obstacles], dtype=np.float64)
            arrays = (array.ctypes.data for array in (shapes, sizes, radii, frictions, paths))
            numbers = force.thickness, force.damping, force.frequency
            self._taken = None
            check(self._library.cloth_plan_contact(self._handle, self.count, *arrays, *numbers))
        else:
            check(self._library.cloth_plan_contact_paths(self._handle, paths.ctypes.data))
        self._seen, self._moved = force.changes, force.moves

    @property
    def anchors_shape(self) -> tuple[int, int, int]:
        """Shape of anchors: obstacles; place in the obstacle's frame [m] and bond (none, sticks, slides); particles."""
        return (self.count, ANCHOR_NUMBERS, self._shape[1])

    def take(self, state: State) -> None:
        """Let what follows start with the anchors of a state; a state without any, or of other obstacles, has none."""
        anchors = state.memory.get(ANCHORS)
        self.lay(anchors if anchors is not None and anchors.shape == self.anchors_shape else None)

    def lay(self, anchors: Array | None) -> Array | None:
        """Let what follows start with anchors, none where left out; return them, None where there is no friction."""
        self.sync()
        if not self.force.rough:
            return None
        if anchors is None:
            anchors = np.zeros(self.anchors_shape)
        if anchors is not self._taken:
            check(self._library.cloth_contact_anchors(self._handle, doubles(ANCHORS, anchors, self.anchors_shape)))
            self._taken = anchors
        return anchors

    def settle(self, t: float, x: Array, v: Array, ends: Array, weights: Sequence[float]) -> Array:
        """Return the anchors of a state that combines runs by weights, from those that each run ended with.

        Args:
            t: time of the state [s].
            x: its positions.
            v: its velocities.
            ends: anchors of each run, shape (runs, *anchors_shape).
            weights: of the runs.
        """
        out, factors = np.empty(self.anchors_shape), np.array(weights, dtype=np.float64)
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape)
        places = factors.ctypes.data, doubles("ends", ends, (len(weights), *self.anchors_shape)), address(out)
        check(self._library.cloth_contact_settle(self._handle, t, *addresses, len(weights), *places))
        return out

    def follow(self, t: float, state: State) -> None:
        """Let the anchors of a state that has moved follow it."""
        if self.force.rough and self._taken is not None:
            state.memory[ANCHORS] = self.settle(t, state.x, state.v, self._taken[None], [1.0])

    def ahead(self, t: float, duration: float, x: Array, v: Array) -> tuple[float, float]:
        """Return squared frequency [1/s^2] and damping rate [1/s] that contact may come to within a duration [s]: where
        it has taken up the energy of what is in contact, and of what comes into contact by then.
        """
        return self.limits(_EXPECTED * self.energy_ahead(t, duration, x, v))

    def energy_ahead(self, t: float, duration: float, x: Array, v: Array) -> float:
        """Return the energy per mass that contact may have to take up within a duration [s], in U^2/2."""
        self.sync()
        out = np.empty(1)
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape), address(out)
        check(self._library.cloth_contact_ahead(self._handle, t, duration, *addresses))
        return float(out[0])

    def limits(self, energy: float) -> tuple[float, float]:
        """Return squared frequency and damping rate of contact that has taken up an energy per mass, in U^2/2."""
        out = np.empty(2)
        check(self._library.cloth_contact_limits(self._handle, energy, address(out)))
        return float(out[0]), float(out[1])

    def held(self, gap: float) -> float:
        """Return the energy per mass that contact holds at a gap [m], in U^2/2; infinite at none."""
        s = min(max(gap / self.force.thickness, 0.0), 1.0)
        square = (1.0 - s) * (1.0 - s)
        return square * square / s if s else math.inf

    def rates(self, t: float, x: Array, v: Array, weight: float = 1.0) -> Array:
        """Return for each obstacle force, torque about its place, power on the cloth and power lost in contact, times a
        weight, shape (obstacles, BOOKED_NUMBERS).
        """
        self.sync()
        out = np.zeros((self.count, BOOKED_NUMBERS))
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape)
        check(self._library.cloth_contact_rates(self._handle, t, *addresses, weight, out.ctypes.data))
        return out

    def gaps(self, t: float, x: Array) -> Array:
        """Return for each obstacle how many particles are nearer than the thickness, and the least gap [m], infinite
        where no particle is free: shape (obstacles, 2).
        """
        self.sync()
        out = np.empty((self.count, 2))
        check(self._library.cloth_contact_gaps(self._handle, t, doubles("x", x, self._shape), out.ctypes.data))
        return out

    def add_bounds(self, t: float, x: Array, stiff: Array, damped: Array) -> None:
        """Add blocks (6, n) of stiffness [N/m] and damping [N s/m] across the gaps."""
        self.sync()
        shape = (6, self._shape[1])
        addresses = writable("stiff", stiff, shape), writable("damped", damped, shape)
        check(self._library.cloth_contact_bounds(self._handle, t, doubles("x", x, self._shape), *addresses))

    def crosses(self, t: float, duration: float, start: Array, end: Array) -> bool:
        """Return whether a particle meets an obstacle's surface on its straight way from one place to another."""
        self.sync()
        out = np.empty(1, dtype=np.int64)
        addresses = doubles("start", start, self._shape), doubles("end", end, self._shape), address(out)
        check(self._library.cloth_contact_crosses(self._handle, t, duration, *addresses))
        return bool(out[0])
