# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled model: forces, runs, energies and bounds.

A plan consists of parts: a grid's springs, listed springs and hinges, panels, grips, contact, uniform forces and Python
forces. Forces, bounds, energies and costs are sums over the parts. The parts follow from the model alone. `compile`
makes a plan; integrators, the node and tests all use it.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Sequence
from ctypes import addressof
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np
from numpy import empty, zeros

from cloth_sim_ros.engine.binding import (
    CONTACT_SUMMARY_NUMBERS,
    FRAME,
    MAX_RUNS,
    SUMMARY_NUMBERS,
    Frame,
    address,
    check,
    doubles,
    library,
    writable,
)
from cloth_sim_ros.physics.assembly import HINGES, Assembly
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.cores import available
from cloth_sim_ros.physics.forces.force import Array, Force
from cloth_sim_ros.physics.forces.grips import Grips
from cloth_sim_ros.physics.gripping import Gripping
from cloth_sim_ros.physics.measures import Measures
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.own_forces import OwnForces
from cloth_sim_ros.physics.owner import Owner
from cloth_sim_ros.physics.runs import Run, Told, booked_size
from cloth_sim_ros.physics.turn import one_at_a_time
from cloth_sim_ros.physics.uncopyable import Uncopyable

if TYPE_CHECKING:
    from cloth_sim_ros.physics.state import State
    from cloth_sim_ros.physics.touching import Touching

#: End buffers of runs without contact.
_NO_ENDS: tuple[Array | None, Array | None] = (None, None)
_NOWHERE: Sequence[int] = (0, 0)
#: Runs that take longer than this number of engine calls are worth waking a thread.
_WAKING = 2.0
#: Largest number of steps of one run.
MOST_STEPS = 2**31 - 1


def compile(model: Model) -> Plan:
    """Compile a model to a plan.

    Raises:
        ValueError: if a force does not fit the model.
    """
    return Plan(model)


class Plan(Measures, Uncopyable):
    """Accelerations, runs, energies and bounds of a model, as sums over its parts.

    Positions ``x`` [m] and velocities ``v`` [m/s] are (3, particle_count) float64, C-contiguous. A plan is not
    re-entrant: it allows one call at a time.
    """

    copy_refusal = "a plan owns memory of the engine, and can't be copied or pickled; compile its model once more"

    def __init__(self, model: Model) -> None:
        self.model = model
        self._library = library()
        self._shape = (3, model.particle_count)
        parts = Assembly.of(model)
        self._own, self._drag, self._decay = parts.own, parts.drag, parts.decay()
        #: True if the model has hinges, which multirate runs evaluate less often.
        self.bends = any(part.kind in HINGES for part in parts.listed)
        #: Estimated time of a step for one particle, and the part of it for hinges [ns].
        self.step_cost, self._hinge_cost = parts.step_cost(), parts.hinge_cost()
        #: True if the parts can be shared by two threads: a grid needs enough rows.
        self._wide = parts.gridded is None or parts.gridded.rows >= 16
        self._pair_counts = parts.pair_counts()
        self.turn = threading.Lock()
        # The engine's request is allocated once; each frame writes into it.
        self._steps, self._weights = (ctypes.c_int64 * MAX_RUNS)(), (ctypes.c_double * MAX_RUNS)()
        self._told = (ctypes.c_double * SUMMARY_NUMBERS)()
        self._steps_at, self._weights_at = addressof(self._steps), addressof(self._weights)
        self._frame = Frame()
        #: Numbers of steps in the request.
        self._asked: tuple[int, ...] | None = None
        #: The newest combination of runs; the reference keeps its address valid.
        self._newest: tuple[Array | None, Array | None] = (None, None)
        self._newest_at = 0
        self._frame_at = ctypes.byref(self._frame)
        count = model.particle_count
        self._owner = Owner(model)
        self._handle = self._owner.handle
        parts.hand_over(self._handle)
        self._gripping = None if parts.grips is None else Gripping(self._owner, parts.grips, count)
        #: The force of grips, if the model has one.
        self.grips: Grips | None = parts.grips
        #: Number of grippers of the model.
        self.gripper_count = 0 if self._gripping is None else self._gripping.count
        self.contact: Touching | None = None
        if parts.contact is not None:
            from cloth_sim_ros.physics.touching import Touching

            self.contact = Touching(self._owner, parts.contact, count)
        self._called = OwnForces(self._own, self._shape) if self._own else None
        if self._called is not None:
            check(self._library.cloth_plan_callback(self._handle, self._called.callback))

    def change_uniform(self, forces: Sequence[Force], uniform: Sequence[Force], *, air: Array | None = None) -> None:
        """Replace forces by others that differ only in gravity, drag and wind.

        Args:
            forces: all forces of the model.
            uniform: those of them that act on all particles alike.
            air: new `AirPanels.coefficients`; None if there are no panels.
        """
        found = Assembly.of(Model([1.0], uniform))
        if air is not None or found.drag != self._drag:
            # A new model tells caches, such as the matrix of implicit steps, that the damping changed.
            self.model = Model(self.model.masses, forces, anchors=self.model.anchors)
        self.model.forces, self._drag = tuple(forces), found.drag
        found.uniform_to(self._handle)
        if air is not None:
            check(self._library.cloth_plan_air(self._handle, air.ctypes.data))

    # The methods below are called in every frame.

    @property
    def obstacle_count(self) -> int:
        """Number of obstacles."""
        return 0 if self.contact is None else self.contact.count

    @property
    def drag(self) -> float:
        """Rate of linear drag on every particle [1/s]."""
        return self._drag

    @one_at_a_time
    def runs(
        self,
        t: float,
        duration: float,
        start: tuple[Array, Array],
        steps: Sequence[int],
        *,
        weights: Sequence[float] | None = None,
        narrow: bool = False,
        powers: bool = False,
        touches: bool = False,
        threads: int | None = None,
        abreast: int = 1,
        every: int = 1,
    ) -> tuple[list[Run], tuple[Array, Array, Told] | None]:
        """Run the leapfrog over an interval several times from one start, each with its own number of equal steps.

        Args:
            t: time at the start [s].
            duration: length of the interval [s].
            start: positions [m] and velocities [m/s], each (3, n); they are not changed.
            steps: number of steps of each run, at least 1.
            weights: weights of the first runs in a combination; None for no combination.
            narrow: true to calculate in single precision.
            powers: true to integrate powers.
            touches: true to integrate wrenches and powers of obstacles.
            threads: threads of a run; None chooses. No bit depends on it.
            abreast: runs that are calculated at once, each by one thread, if possible. No bit depends on it.
            every: multirate ratio: hinges are evaluated once in this number of steps, in the middle one. It is odd and
                divides all ``steps``.

        Returns:
            The runs; and positions, velocities and the summary of their combination, None without weights.

        Raises:
            ValueError: for steps, weights or a ratio out of range.
            RuntimeError: if another call is running.
            Exception: an exception of a Python force.
        """
        self._sync()
        count, grippers, obstacles = len(steps), self.gripper_count, 0
        if steps != self._asked:
            self._ask(steps)
        if every != 1 and (type(every) is not int or every < 1 or every % 2 == 0 or any(one % every for one in steps)):
            raise ValueError(
                f"hinges every {every} steps of {list(steps)}; give an odd number that divides each of them"
            )
        if not (isfinite(t) and isfinite(duration)):
            raise ValueError(f"a run from time {t} s over {duration} s; both must be finite")
        x0, v0 = self._places(*start)
        out = empty((count, 2, *self._shape))
        out_at = address(out)
        result, result_at, told_at = out[0], 0, 0
        met, ends, ends_at = 0, _NO_ENDS, _NOWHERE
        if self.contact is not None:
            obstacles, met = self.contact.count, CONTACT_SUMMARY_NUMBERS if self.contact.force.acts else 0
            ends = self.contact.ends(count)
            ends_at = [0 if array is None else address(array) for array in ends]
        notes = zeros((count, booked_size(grippers, obstacles) + met))
        combined = count
        if weights is not None:
            combined = len(weights)
            if not 1 <= combined <= count:
                raise ValueError(f"{combined} weights for {count} runs; give one for each run of the combination")
            told_at = addressof(self._told)
            if combined > 1:
                self._weights[:combined] = list(weights)
                result = empty((2, *self._shape))
                result_at = address(result)
        FRAME.pack_into(
            self._frame,
            0,
            t,
            duration,
            count,
            self._steps_at,
            self._weights_at,
            narrow,
            self.threads(every) if threads is None else threads,
            x0,
            v0,
            out_at,
            result_at,
            address(notes),
            powers,
            told_at,
            0 if self._own else 1 + (every > 1),
            touches,
            *ends_at,
            every,
            combined,
            abreast,
        )
        status = self._library.cloth_frame(self._handle, self._frame_at)
        if status:
            self._checked(status)
        if ends is _NO_ENDS:
            runs = [Run(out[k], notes[k], grippers, obstacles) for k in range(count)]
        else:
            anchors, pinched = ([None] * count if array is None else array for array in ends)
            runs = [Run(out[k], notes[k], grippers, obstacles, anchors[k], pinched[k]) for k in range(count)]
        if weights is None:
            return runs, None
        activity, omega2, damping, held, stiff, damped, *hinges = self._told[:]
        x, v = result[0], result[1]
        self._newest, self._newest_at = (x, v), result_at or out_at
        if self._own:
            omega2, damping, *hinges = self.bounds(x, hinges=every > 1)
        return runs, (x, v, Told(activity, omega2, damping, held, (stiff, damped), hinges))

    def _places(self, x: Array, v: Array) -> tuple[int, int]:
        """Return the addresses of positions and velocities; those of the newest combination are known."""
        if x is self._newest[0] and v is self._newest[1]:
            return self._newest_at, self._newest_at + x.nbytes
        return doubles("x", x, self._shape), doubles("v", v, self._shape)

    def _ask(self, steps: Sequence[int]) -> None:
        """Write new numbers of steps into the request."""
        self._asked = None
        count = len(steps)
        if not (1 <= count <= MAX_RUNS and min(steps) >= 1 and max(steps) <= MOST_STEPS):
            raise ValueError(
                f"runs of {list(steps)} steps; there must be 1 to {MAX_RUNS}, each of 1 to {MOST_STEPS} steps"
            )
        try:
            self._steps[:count] = list(steps)
        except TypeError as error:
            raise ValueError(f"runs of {list(steps)} steps; they must be whole numbers") from error
        self._asked = tuple(steps)

    def contact_cost(self, t: float, duration: float, state: State) -> float:
        """Return the estimated time [ns] that contact adds to a force evaluation within a duration [s] from time t [s]
        on.
        """
        return 0.0 if self.contact is None else CONSTANTS.operation * self.contact.work(t, duration, state)

    def cost(self, every: int) -> float:
        """Return the estimated time of a step for one particle [ns] at a multirate ratio."""
        return self.step_cost - (every - 1) / every * self._hinge_cost

    def threads(self, every: int) -> int:
        """Return the number of threads that share each step of a run."""
        # A second thread pays only if a step is long enough.
        long = self.cost(every) * self._shape[1] >= 1e3 * CONSTANTS.call
        return available() if long and self._wide else 1

    def abreast(self, runs: int, steps: int, every: int) -> int:
        """Return the number of runs to calculate at once.

        It is above 1 if the engine calculates alone and the runs are long enough to wake a thread. Sharing each run
        between threads must not be better.

        Args:
            runs: number of runs.
            steps: number of steps of all runs together.
            every: multirate ratio.
        """
        if self.contact is not None or self._own or (runs % 2 and self.threads(every) > 1):
            return 1
        time = self.cost(every) * self._shape[1] * steps
        return available() if time >= _WAKING * 1e3 * CONSTANTS.call else 1

    def accelerations(self, t: float, x: Array, v: Array, out: Array) -> None:
        """Set ``out`` (3, n) to the accelerations [m/s^2] at time t [s]; they are zero for anchored particles."""
        self._sync()
        shape = self._shape
        places = doubles("x", x, shape), doubles("v", v, shape), writable("out", out, shape)
        status = self._library.cloth_accelerations(self._handle, t, *places)
        if status:
            self._checked(status)

    def _checked(self, status: int) -> None:
        if status == 3 and self._called is not None:
            self._called.raise_trouble()
        check(status)

    def ahead(self, t: float, duration: float, x: Array, v: Array) -> tuple[float, float]:
        """Return what contact may add to `spectral_bounds` within a duration [s] from time t [s] on.

        Returns:
            Squared angular frequency [1/s^2] and damping rate [1/s].
        """
        return (0.0, 0.0) if self.contact is None else self.contact.ahead(t, duration, x, v)[:2]

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        """Add the forces [N] on free particles at time t [s] to ``f`` (3, n)."""
        out = np.empty(self._shape)
        self.accelerations(t, x, v, out)
        f += out * self.model.masses

    def steady(self) -> bool:
        """Return true if all forces at given positions and velocities are constant until the next event."""
        return all(force.steady() for force in self.model.forces)

    def narrows(self, duration: float, x: Array, v: Array) -> bool:
        """Return true if runs over a duration [s] from a state may calculate in single precision."""
        return not self._own and (self.contact is None or self.contact.narrows(duration, x, v))
