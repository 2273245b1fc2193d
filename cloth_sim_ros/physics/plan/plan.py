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

from cloth_sim_ros.engine import binding
from cloth_sim_ros.engine.binding import (
    FRAME,
    MAX_RUNS,
    REENTRY_REFUSAL,
    address,
    check,
    float64_address,
    library,
    writable_address,
)
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.model.controls import Controls
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.old_names import with_old_names
from cloth_sim_ros.physics.plan.assembly import HINGE_KINDS, MASS_KINDS, Assembly
from cloth_sim_ros.physics.plan.grip_binding import GripBinding
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.physics.plan.plastic_lengths import PlasticLengths
from cloth_sim_ros.physics.plan.python_forces import PythonForces
from cloth_sim_ros.physics.plan.queries import PlanQueries
from cloth_sim_ros.physics.plan.runs import VIOLATION_INDEX, Run, RunSummary, activity_of, n_integrals
from cloth_sim_ros.physics.plan.thread_limit import available_threads
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable
from cloth_sim_ros.physics.state.controller_state import MISSING_MEMORY, PLASTIC_LENGTHS_KEY, StateMemory

if TYPE_CHECKING:
    from cloth_sim_ros.physics.contact.binding import ContactBinding
    from cloth_sim_ros.physics.state.state import State

#: End buffers of runs without contact.
_NO_END_BUFFERS: tuple[Array | None, Array | None] = (None, None)
_NO_ADDRESSES: Sequence[int] = (0, 0)
#: Runs that take longer than this number of engine calls are worth waking a thread.
_THREAD_WAKE_CALLS = 2.0
#: Largest number of steps of one run.
MAX_STEPS = 2**31 - 1


def compile(model: Model) -> Plan:
    """Return a model compiled to a plan, through which the engine computes its motion; refuse forces that do not fit.

    Raises:
        ValueError: if a force does not fit the model.
    """
    return Plan(model)


@with_old_names(
    abreast="concurrent_runs",
    ahead="predict_contact",
    bounds="detailed_spectral_bounds",
    cost="multirate_step_cost",
    decay="min_damping_time",
    grip_rates="grip_wrench_rates",
    narrows="supports_single_precision",
    rates="spectral_bounds",
    supply="external_power",
    threads="threads_per_run",
)
class Plan(PlanQueries, Uncopyable):
    """Model compiled for the engine: accelerations, runs, energies, bounds. A call during another one is refused.

    Positions ``x`` [m] and velocities ``v`` [m/s] are (3, particle_count) float64, C-contiguous. A call
    while another one runs raises RuntimeError.
    """

    copy_refusal = "a plan owns memory of the engine, and can't be copied or pickled; compile its model once more"

    def __init__(self, model: Model) -> None:
        self.model = model
        self._library = library()
        self._shape = (3, model.particle_count)
        assembly = Assembly.of(model)
        self._python_forces, self._drag = assembly.python_forces, assembly.drag
        self._min_damping_time = assembly.min_damping_time()
        #: True if a force damps the sheet's waves; grips and contact act locally, and air damps weakly.
        self.damps_waves = any(force.damped and force.damps_waves for force in model.forces)
        #: True if the model has hinges, which multirate runs evaluate less often.
        self.has_hinges = any(elements.kind in HINGE_KINDS for elements in assembly.element_lists)
        #: True if the cloth carries air along, whose mass depends on the direction.
        self.carries_air = any(elements.kind in MASS_KINDS for elements in assembly.element_lists)
        #: Estimated time of a step for one particle, and the part of it for hinges [ns].
        self.step_cost, self._hinge_cost = assembly.step_cost(), assembly.hinge_cost()
        #: True if the parts can be shared by two threads: a grid needs enough rows.
        self._is_shareable = assembly.grid is None or assembly.grid.rows >= 16
        #: Number of force evaluations that take as long as a call of the engine; 0 with contact or forces in Python.
        self.evaluations_per_call = 0.0
        if not (assembly.contact or self._python_forces):
            self.evaluations_per_call = 1e3 * CONSTANTS.engine_call_time / (self.step_cost * model.particle_count)
        self._pair_counts = assembly.pair_counts()
        self._membrane_lists = [part.is_membrane for part in assembly.element_lists]
        self._call_lock = threading.Lock()
        #: Results of a query, allocated once.
        self._query_out = (ctypes.c_double * 2)()
        self._query_address = addressof(self._query_out)
        # The engine's request is allocated once; each frame writes into it.
        self._steps, self._weights = (ctypes.c_int64 * MAX_RUNS)(), (ctypes.c_double * (2 * MAX_RUNS))()
        self._summary_out = (ctypes.c_double * binding.SUMMARY_NUMBERS)()
        self._activities = (ctypes.c_double * (2 * MAX_RUNS))()
        self._steps_address, self._weights_address = addressof(self._steps), addressof(self._weights)
        self._summary_address, self._activities_address = addressof(self._summary_out), addressof(self._activities)
        self._frame = binding.FrameRequest()
        #: Numbers of steps in the request.
        self._requested_steps: tuple[int, ...] | None = None
        #: The newest combination of runs; the reference keeps its address valid.
        self._last_result: tuple[Array | None, Array | None] = (None, None)
        self._last_address = 0
        self._frame_address = ctypes.byref(self._frame)
        count = model.particle_count
        self._owner = PlanHandle(model)
        self._handle = self._owner.pointer
        assembly.upload(self._handle)
        self._grip_binding = None if assembly.grips is None else GripBinding(self._owner, assembly.grips, count)
        #: The force of grips, if the model has one.
        self.grips: Grips | None = assembly.grips
        #: Number of grippers of the model.
        self.gripper_count = 0 if self._grip_binding is None else self._grip_binding.count
        self.contact: ContactBinding | None = None
        if assembly.contact is not None:
            from cloth_sim_ros.physics.contact.binding import ContactBinding

            self.contact = ContactBinding(self._owner, assembly.contact, count)
        #: Plastic lengths of hinges with friction; None without any.
        self.plastic: PlasticLengths | None = None
        if assembly.plastic is not None:
            self.plastic = PlasticLengths(self._owner, assembly.plastic, model.inverse_masses)
        #: True if forces other than contact have kinks, see `kink_velocities`.
        self.has_kinks = assembly.stiffens or self.plastic is not None
        self._python_callback = PythonForces(self._python_forces, self._shape) if self._python_forces else None
        if self._python_callback is not None:
            check(self._library.cloth_plan_callback(self._handle, self._python_callback.callback))

    def change_uniform(
        self, forces: Sequence[Force], uniform: Sequence[Force], *, air_coefficients: Array | None = None
    ) -> None:
        """Replace the model's forces, in place, by others that differ only in gravity, drag and wind.

        Args:
            forces: all forces of the model.
            uniform: those of them that act on all particles alike.
            air_coefficients: new `AirPanels.coefficients`; None if there are no panels.
        """
        assembly = Assembly.of(Model([1.0], uniform))
        if air_coefficients is not None or assembly.drag != self._drag:
            # A new model tells caches, such as the matrix of implicit steps, that the damping changed.
            self.model = Model(self.model.masses, forces, anchors=self.model.anchors)
        self.model.forces, self._drag = tuple(forces), assembly.drag
        assembly.upload_uniform(self._handle)
        if air_coefficients is not None:
            check(self._library.cloth_plan_air(self._handle, air_coefficients.ctypes.data))

    # The methods below are called in every frame.

    @property
    def controls(self) -> Controls:
        """Inputs of the frame, settable: grasps, paths, jaws; the next run or query uploads those that changed."""
        contact = self.contact
        return Controls(
            None if self.grips is None else self.grips.controls, None if contact is None else contact.force.controls
        )

    @controls.setter
    def controls(self, controls: Controls) -> None:
        if self.grips is not None and controls.grips is not None:
            self.grips.controls = controls.grips
        if self.contact is not None and controls.contact is not None:
            self.contact.force.controls = controls.contact

    @property
    def obstacle_count(self) -> int:
        """Number of obstacles, two jaws of each pinching gripper included."""
        return 0 if self.contact is None else self.contact.count

    @property
    def drag(self) -> float:
        """Rate of linear drag on every particle [1/s]."""
        return self._drag

    def runs(
        self,
        t: float,
        duration: float,
        start: tuple[Array, Array],
        steps: Sequence[int],
        *,
        weights: Sequence[float] | None = None,
        single_precision: bool = False,
        record_power: bool = False,
        record_obstacles: bool = False,
        threads: int | None = None,
        concurrency: int = 1,
        multirate: int = 1,
        memory: StateMemory = MISSING_MEMORY,
        before: tuple[Array, float] | None = None,
    ) -> tuple[list[Run], tuple[Array, Array, RunSummary] | None]:
        """Return leapfrog runs over an interval from one start, one for each step count, and their combination or None.

        Args:
            t: time at the start [s].
            duration: length of the interval [s].
            start: positions [m] and velocities [m/s], each (3, n); they are not changed.
            steps: number of steps of each run, at least 1.
            weights: weights of the first runs in a combination; None for no combination.
            single_precision: true to calculate in single precision.
            record_power: true to integrate powers.
            record_obstacles: true to integrate wrenches and powers of obstacles.
            threads: threads of a run; None chooses. No bit depends on it.
            concurrency: runs that are calculated at once, each by one thread, if possible. No bit depends on it.
            before: velocities [m/s] at the start of the interval before, (3, n), and its length [s]; None for none.
            multirate: multirate ratio: hinges are evaluated once in this number of steps, in the middle one. It is
                odd and divides all ``steps``.
            memory: `State.memory` at the start; a plan without contact and friction of bending does not need it.

        Returns:
            The runs; and positions, velocities and the summary of their combination, None without weights. Runs beyond
            the combination are missing if one of the runs violates the culling of contact.

        Raises:
            ValueError: for steps, weights or a ratio out of range.
            RuntimeError: if another call is running.
            Exception: an exception of a Python force.
        """
        # Calls of two threads, or of a Python force that runs its own plan, would write into the same memory.
        if not self._call_lock.acquire(False):
            raise RuntimeError(REENTRY_REFUSAL)
        try:
            self._upload(memory)
            count, grippers, obstacles = len(steps), self.gripper_count, 0
            if steps != self._requested_steps:
                self._request_steps(steps)
            if multirate != 1:
                _check_multirate(multirate, steps)
            if not (isfinite(t) and isfinite(duration)):
                raise ValueError(f"a run from time {t} s over {duration} s; both must be finite")
            x_address, v_address = self._addresses(*start)
            out = empty((count, 2, *self._shape))
            out_address = address(out)
            result, result_address, summary_address = out[0], 0, 0
            n_contact_numbers, end_buffers, end_addresses = 0, _NO_END_BUFFERS, _NO_ADDRESSES
            if self.contact is not None:
                obstacles = self.contact.count
                n_contact_numbers = binding.CONTACT_SUMMARY_NUMBERS if self.contact.force.is_active else 0
                if self.contact.force.has_memory:
                    end_buffers = self.contact.end_buffers(count)
                    end_addresses = [0 if array is None else address(array) for array in end_buffers]
            plastic_ends = None if self.plastic is None else self.plastic.end_buffer(count)
            integrals = zeros((count, n_integrals(grippers, obstacles) + n_contact_numbers))
            n_combined = count
            if weights is not None:
                n_combined = len(weights)
                if not 1 <= n_combined <= count:
                    raise ValueError(f"{n_combined} weights for {count} runs; give one for each run of the combination")
                summary_address = self._summary_address
                if n_combined > 1:
                    self._weights[:n_combined] = list(weights)
                    result = empty((2, *self._shape))
                    result_address = address(result)
            FRAME.pack_into(
                self._frame,
                0,
                t,
                duration,
                count,
                self._steps_address,
                self._weights_address,
                single_precision,
                self.threads_per_run(multirate) if threads is None else threads,
                x_address,
                v_address,
                out_address,
                result_address,
                address(integrals),
                record_power,
                summary_address,
                0 if self._python_forces else 1 + (multirate > 1),
                record_obstacles,
                *end_addresses,
                multirate,
                n_combined,
                concurrency,
                self._activities_address,
                0 if before is None else float64_address("before", before[0], self._shape),
                0.0 if before is None else duration / before[1],
                0 if plastic_ends is None else address(plastic_ends),
            )
            status = self._library.cloth_frame(self._handle, self._frame_address)
            if status:
                self._raise_for_status(status)
            activities = self._activities
            if n_contact_numbers and n_combined < count and integrals[-1, VIOLATION_INDEX]:
                count = n_combined
            if end_buffers is _NO_END_BUFFERS:
                runs = [
                    Run(out[k], integrals[k], grippers, obstacles, activities[2 * k], activities[2 * k + 1])
                    for k in range(count)
                ]
            else:
                anchors, jaw_states = ([None] * count if array is None else array for array in end_buffers)
                runs = [
                    Run(
                        out[k],
                        integrals[k],
                        grippers,
                        obstacles,
                        activities[2 * k],
                        activities[2 * k + 1],
                        anchors[k],
                        jaw_states[k],
                    )
                    for k in range(count)
                ]
            if plastic_ends is not None:
                runs = [run._replace(plastic_lengths=ends) for run, ends in zip(runs, plastic_ends, strict=False)]
            if weights is None:
                return runs, None
            summary_out = self._summary_out[:]
            size, omega2, damping, contact_energy, self_omega2, self_damping, *hinges, turn, change = summary_out
            activity = activity_of(size, activities[2 * n_combined - 2])
            x, v = result[0], result[1]
            self._last_result, self._last_address = (x, v), result_address or out_address
            if self._python_forces:
                omega2, damping, *hinges = self.detailed_spectral_bounds(x, hinges=multirate > 1)
            contact_rates = self_omega2, self_damping
            summary = RunSummary(activity, change, turn, omega2, damping, contact_energy, contact_rates, hinges)
            return runs, (x, v, summary)
        finally:
            self._call_lock.release()

    def _addresses(self, x: Array, v: Array) -> tuple[int, int]:
        """Return the addresses of positions and velocities, without a check for those of the newest combination."""
        if x is self._last_result[0] and v is self._last_result[1]:
            return self._last_address, self._last_address + x.nbytes
        return float64_address("x", x, self._shape), float64_address("v", v, self._shape)

    def _request_steps(self, steps: Sequence[int]) -> None:
        """Check the numbers of steps of runs and write them into the engine's request, or raise ValueError."""
        self._requested_steps = None
        count = len(steps)
        if not (1 <= count <= MAX_RUNS and min(steps) >= 1 and max(steps) <= MAX_STEPS):
            raise ValueError(
                f"runs of {list(steps)} steps; there must be 1 to {MAX_RUNS}, each of 1 to {MAX_STEPS} steps"
            )
        try:
            self._steps[:count] = list(steps)
        except TypeError as error:
            raise ValueError(f"runs of {list(steps)} steps; they must be whole numbers") from error
        self._requested_steps = tuple(steps)

    def contact_cost(self, t: float, duration: float, state: State) -> float:
        """Return the estimated time [ns] that contact adds to each force evaluation from t to t + duration [s]."""
        contact = self.contact
        return 0.0 if contact is None else CONSTANTS.operation_time * contact.operation_count(t, duration, state)

    def multirate_step_cost(self, multirate: int) -> float:
        """Return the estimated time of a step for one particle [ns] at a multirate ratio."""
        return self.step_cost - (multirate - 1) / multirate * self._hinge_cost

    def threads_per_run(self, multirate: int) -> int:
        """Return the number of threads, 1 or 2, that share each step of a run at a multirate ratio."""
        # A second thread pays only if a step is long enough.
        is_long = self.multirate_step_cost(multirate) * self._shape[1] >= 1e3 * CONSTANTS.engine_call_time
        return available_threads() if is_long and self._is_shareable else 1

    def concurrent_runs(self, runs: int, steps: int, multirate: int) -> int:
        """Return the number of runs to calculate at once, each by one thread; 1 if more do not pay.

        It is above 1 if the engine calculates alone and the runs are long enough to wake a thread. Sharing each run
        between threads must not be better. Runs with contact of the surface do not share their steps.

        Args:
            runs: number of runs.
            steps: number of steps of all runs together.
            multirate: multirate ratio.
        """
        force = None if self.contact is None else self.contact.force
        has_surface = force is not None and (force.surface is not None or force.faces is not None)
        is_shared = not has_surface and self.threads_per_run(multirate) > 1
        if self._python_forces or (runs % 2 and is_shared):
            return 1
        time = self.multirate_step_cost(multirate) * self._shape[1] * steps
        return available_threads() if time >= _THREAD_WAKE_CALLS * 1e3 * CONSTANTS.engine_call_time else 1

    def accelerations(self, t: float, x: Array, v: Array, out: Array, memory: StateMemory = MISSING_MEMORY) -> None:
        """Set ``out`` (3, n) to the accelerations [m/s^2] at time t [s].

        They are zero for anchored particles, and for those whose motion a gripper prescribes.
        """
        self._upload(memory)
        shape = self._shape
        addresses = float64_address("x", x, shape), float64_address("v", v, shape), writable_address("out", out, shape)
        status = self._library.cloth_accelerations(self._handle, t, *addresses)
        if status:
            self._raise_for_status(status)

    def predict_contact(
        self, t: float, duration: float, x: Array, v: Array, memory: StateMemory = MISSING_MEMORY
    ) -> tuple[float, float]:
        """Predict bounds of squared frequency and damping rate that contact may add within a duration [s] from t [s].

        Returns:
            Squared angular frequency [1/s^2] and damping rate [1/s].
        """
        return (0.0, 0.0) if self.contact is None else self.contact.predict_contact(t, duration, x, v, memory)[:2]

    def add_force(self, t: float, x: Array, v: Array, f: Array, memory: StateMemory = MISSING_MEMORY) -> None:
        """Add the forces [N] on free particles at time t [s] to ``f`` (3, n), in place."""
        out = np.empty(self._shape)
        self.accelerations(t, x, v, out, memory)
        f += self.momenta(x, out)

    @property
    def has_end_memory(self) -> bool:
        """True if runs change a state's memory: friction anchors, jaws or plastic lengths."""
        return self.plastic is not None or (self.contact is not None and self.contact.force.has_memory)

    def combine_ends(
        self, t: float, x: Array, v: Array, runs: Sequence[Run], weights: Sequence[float], memory: StateMemory
    ) -> dict[str, Array]:
        """Return friction anchors, jaws and plastic lengths at the end of combined runs, by key of the state's memory.

        Args:
            t: time at the end [s].
            x: combined positions [m], shape (3, n).
            v: combined velocities [m/s], shape (3, n).
            runs: the runs.
            weights: dimensionless weight of each run.
            memory: of the state at the start of the runs.
        """
        ends: dict[str, Array] = {}
        if self.contact is not None and self.contact.force.has_memory:
            ends = self.contact.combine_ends(t, x, v, runs, weights, memory)
        if self.plastic is not None:
            plastic_ends = np.array([run.plastic_lengths for run in runs])
            ends[PLASTIC_LENGTHS_KEY], _ = self.plastic.combine(x, plastic_ends, weights)
        return ends

    def update_after_step(self, t: float, h: float, state: State) -> float:
        """Replace jaws, anchors, plastic lengths in a state's memory after a step; return bending friction's work [J].

        The step held them constant.

        Args:
            t: time at the end of the step [s].
            h: length of the step [s].
            state: state at the end of the step.

        Returns:
            Work that friction of bending dissipated [J].
        """
        if self.contact is not None:
            self.contact.update_after_step(t, h, state)
        if self.plastic is None:
            return 0.0
        state.memory[PLASTIC_LENGTHS_KEY], work = self.plastic.return_mapping(state.x, state.memory)
        return work

    def return_hinges(self, state: State) -> None:
        """Map a state's plastic lengths to the yield surface; hinges of a folded start are beyond it.

        A run maps them at the end of its first step. Its error would be of first order then.
        """
        if self.plastic is not None:
            state.memory[PLASTIC_LENGTHS_KEY], _ = self.plastic.return_mapping(state.x, state.memory)

    def steady(self) -> bool:
        """Return true if no force depends explicitly on time until the next event."""
        return all(force.steady() for force in self.model.forces)

    def supports_single_precision(
        self, duration: float, x: Array, v: Array, memory: StateMemory = MISSING_MEMORY
    ) -> bool:
        """Return true if the model's forces allow runs in single precision over a duration [s] from a state."""
        if self._python_forces or self.plastic is not None:
            return False
        return self.contact is None or self.contact.supports_single_precision(duration, x, v, memory)


def _check_multirate(multirate: int, steps: Sequence[int]) -> None:
    """Raise ValueError if a multirate ratio is not odd, or does not divide all numbers of steps."""
    is_odd = type(multirate) is int and multirate > 0 and multirate % 2 == 1
    if not is_odd or any(n_steps % multirate for n_steps in steps):
        raise ValueError(
            f"hinges every {multirate} steps of {list(steps)}; give an odd number that divides each of them"
        )
