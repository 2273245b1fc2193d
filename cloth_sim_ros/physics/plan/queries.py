# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Queries of a plan: spectral bounds, energies, powers and derivatives."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import RECORD_NUMBERS, address, check, float64_address, writable_address
from cloth_sim_ros.physics.arithmetic.arrays import weighted_dot
from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.grip_binding import GripBinding
from cloth_sim_ros.physics.plan.plastic_lengths import PlasticLengths
from cloth_sim_ros.physics.plan.python_forces import PythonForces
from cloth_sim_ros.physics.state.controller_state import MISSING_MEMORY, StateMemory

if TYPE_CHECKING:
    from cloth_sim_ros.physics.contact.binding import ContactBinding


_NO_PARTICLES: NDArray[np.int64] = np.empty(0, dtype=np.int64)


class PlanQueries:
    """Base class of `Plan` with its queries at positions [m] and velocities [m/s], shape (3, particle_count), float64.

    Contact and friction of bending also depend on the memory of the state, `State.memory`. A plan without them does not
    need it.
    """

    model: Model
    contact: ContactBinding | None
    plastic: PlasticLengths | None
    carries_air: bool
    _library: ctypes.CDLL
    _handle: int
    _shape: tuple[int, int]
    _python_forces: list[Force]
    _python_callback: PythonForces | None
    _drag: float
    _grip_binding: GripBinding | None
    _pair_counts: list[int]
    _membrane_lists: list[bool]
    _min_damping_time: float
    _query_out: ctypes.Array[ctypes.c_double]
    _query_address: int

    def _raise_for_status(self, status: int) -> None:
        """Raise the error of an engine call's status unless it is 0, or a Python force's exception."""
        if status == 3 and self._python_callback is not None:
            self._python_callback.raise_pending()
        check(status)

    def _upload(self, memory: StateMemory) -> None:
        """Upload the controls and a state's memory to the engine, unless it has them already."""
        if self.contact is not None:
            self.contact.upload(memory)
        if self.plastic is not None:
            self.plastic.upload(memory)
        if self._grip_binding is not None:
            self._grip_binding.upload()

    def spectral_bounds(self, x: Array) -> tuple[float, float]:
        """Return upper bounds, without contact, of squared angular frequency [1/s^2] and damping rate c/m [1/s] at x.

        Contact is not included: its bounds depend on the motion, see `predict_contact`.
        """
        omega2, damping, *_ = self.detailed_spectral_bounds(x)
        return omega2, damping

    def detailed_spectral_bounds(self, x: Array, *, hinges: bool = False) -> list[float]:
        """Return bounds without contact: omega2 and damping of all, of hinges alone, and omega2 across springs.

        Args:
            x: positions [m], shape (3, n).
            hinges: true to calculate the bounds of hinges, as in `RunSummary.hinge_bounds`; they are zeros otherwise.

        Returns:
            Squared frequency [1/s^2] and damping rate [1/s] of the whole; squared frequency and damping rate of hinges;
            squared frequency across springs.
        """
        addresses: list[int | None] = [float64_address("x", x, self._shape), None, None]
        if self._grip_binding is not None:
            self._grip_binding.upload()
        if self._python_forces:
            blocks = np.zeros((2, 6, self.model.particle_count))
            for force in self._python_forces:
                force.add_stiffness(x, blocks[0])
                force.add_damping(x, blocks[1])
            addresses[1:] = address(blocks[0]), address(blocks[1])
        out = np.empty(5)
        check(self._library.cloth_spectral_bounds(self._handle, *addresses, hinges, address(out)))
        bounds: list[float] = out.tolist()
        return bounds

    def turn_in_step(self, x0: Array, x: Array, steps: int, n_runs: int = 1) -> float:
        """Return the largest angle [rad] by which a spring turns in one of an interval's steps.

        Each spring's vector is assumed to change steadily over the interval, and half a step before and after. The
        angle is the one at its shortest length. A spring (S1) turns its force round as its ends pass each other.
        Normals of panels, and the vectors by whose length hinges divide, count for combined runs where they nearly
        vanish.

        Args:
            x0: positions at the start [m], shape (3, n).
            x: positions at the end [m], shape (3, n).
            steps: number of steps.
            n_runs: number of combined runs.
        """
        out = np.empty(1)
        addresses = float64_address("x0", x0, self._shape), float64_address("x", x, self._shape)
        check(self._library.cloth_turn_in_step(self._handle, *addresses, steps, n_runs, address(out)))
        return float(out[0])

    def velocity_displacement(self, t: float, x: Array, errors: Array, time: float) -> tuple[float, int]:
        """Return the largest displacement [m] that velocity errors cause within a time [s], and the evaluations spent.

        It is the largest particle of (A + 1/time^2)^(-1/2) e with A = M^-1 K, by the Lanczos method
        (docs/derivations/time_stepping.md). Contact, friction of bending, grips and forces in Python are left out,
        which makes it larger.

        Args:
            t: time [s].
            x: positions [m], shape (3, n).
            errors: e [m/s], shape (3, n).
            time: time within which the displacement is observed [s].

        Returns:
            The displacement, and the number of force evaluations.
        """
        if self._grip_binding is not None:
            self._grip_binding.upload()
        addresses = (
            float64_address("x", x, self._shape),
            float64_address("errors", errors, self._shape),
            time,
            self._query_address,
        )
        check(self._library.cloth_velocity_displacement(self._handle, t, *addresses))
        displacement, evaluations = self._query_out
        return displacement, int(evaluations)

    def min_damping_time(self, soft: float = 0.0) -> float:
        """Return the least c / k [s] of springs, membranes and grips; 0 if one is undamped, infinity without any.

        Args:
            soft: stiffness over mass [1/s^2] up to which a grip does not count.
        """
        grips = self._grip_binding
        if grips is None:
            return self._min_damping_time
        return min(self._min_damping_time, grips.min_damping_time(soft, self.model.inverse_masses))

    def energies(
        self, t: float, x: Array, v: Array | None, memory: StateMemory = MISSING_MEMORY
    ) -> tuple[float, float]:
        """Return kinetic and potential energy [J] at time t [s]; the kinetic energy is 0 without velocities."""
        self._upload(memory)
        out = np.empty(2)
        velocity_address = None if v is None else float64_address("v", v, self._shape)
        check(
            self._library.cloth_energy(
                self._handle, t, float64_address("x", x, self._shape), velocity_address, address(out)
            )
        )
        return float(out[0]), ordered_sum((force.energy(t, x) for force in self._python_forces), float(out[1]))

    def energy(self, t: float, x: Array, v: Array, memory: StateMemory = MISSING_MEMORY) -> float:
        """Return kinetic plus potential energy [J] at time t [s]."""
        kinetic, potential = self.energies(t, x, v, memory)
        return kinetic + potential

    def mass_blocks(self, x: Array) -> Array:
        """Return 3x3 mass blocks of the air that each particle carries along (added mass) at x [kg], shape (6, n)."""
        blocks = np.empty((6, self.model.particle_count))
        check(self._library.cloth_mass_blocks(self._handle, float64_address("x", x, self._shape), address(blocks)))
        return blocks

    def momenta(self, x: Array, v: Array) -> Array:
        """Return the momenta ``M v`` [kg m/s] of particles and their added mass; v relative to air, shape (3, n)."""
        momenta = self.model.masses * v
        if self.carries_air:
            xx, yy, zz, xy, xz, yz = self.mass_blocks(x)
            momenta[0] += xx * v[0] + xy * v[1] + xz * v[2]
            momenta[1] += xy * v[0] + yy * v[1] + yz * v[2]
            momenta[2] += xz * v[0] + yz * v[1] + zz * v[2]
        return momenta

    def air_energy(self, x: Array, v: Array) -> float:
        """Return the kinetic energy [J] of the air that the cloth carries along (added mass)."""
        if not self.carries_air:
            return 0.0
        masses = self.model.masses
        return 0.5 * weighted_dot(np.ones_like(masses), self.momenta(x, v) - masses * v, v)

    def powers(self, t: float, x: Array, v: Array, memory: StateMemory = MISSING_MEMORY) -> tuple[float, float]:
        """Return two powers [W]: dissipated by springs and drag, without grips and contact; and external."""
        self._upload(memory)
        out = np.empty(2)
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape)
        check(self._library.cloth_powers(self._handle, t, *addresses, address(out)))
        dissipated = ordered_sum((force.dissipation(t, x, v) for force in self._python_forces), float(out[0]))
        return dissipated, ordered_sum((force.external_power(t, x, v) for force in self._python_forces), float(out[1]))

    def prescribed_particles(self) -> NDArray[np.int64]:
        """Return the particles whose motion a gripper prescribes, ascending."""
        return _NO_PARTICLES if self._grip_binding is None else self._grip_binding.prescribed_particles

    def free_particles(self) -> NDArray[np.bool_]:
        """Return a mask of the particles that are neither anchored nor prescribed by a gripper, shape (n,)."""
        is_free = self.model.inverse_masses > 0.0
        is_free[self.prescribed_particles()] = False
        return is_free

    def grip_jerk_change(self, t: float, duration: float, rates: tuple[float, float], error_time: float) -> float:
        """Return the largest change of a particle's jerk by a gripper's path, see `GripBinding.jerk_change` [m/s]."""
        if self._grip_binding is None:
            return 0.0
        return self._grip_binding.jerk_change(t, duration, self.model.inverse_masses, rates, error_time)

    def grip_acceleration_change(self, t: float, duration: float) -> float:
        """Return what a gripper's path changes its particles' acceleration by [m/s^2], see `GripBinding`."""
        if self._grip_binding is None:
            return 0.0
        return self._grip_binding.acceleration_change(t, duration, self.model.inverse_masses)

    def hinge_jerk(self, x: Array, v: Array) -> Array:
        """Return the jerk by hinges at constant velocities [m/s^3], shape (3, n)."""
        out = np.empty(self._shape)
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape)
        check(self._library.cloth_hinge_jerk(self._handle, *addresses, address(out)))
        return out

    def kink_velocities(
        self,
        start: tuple[Array, Array],
        end: tuple[Array, Array],
        plastic_lengths: tuple[Array, Array] | None,
        duration: float,
        step: float,
    ) -> Array:
        """Return the largest velocity changes [m/s] that runs miss at kinks near the ends of an interval, (3, n).

        All runs miss a kink within half a step of the ends. There a strain meets a limit of stiffening, or a hinge with
        friction begins or ceases to yield. Changes of a particle add up in size.

        Args:
            start: positions [m] and velocities [m/s] at the start, (3, n) each.
            end: the same at the end.
            plastic_lengths: at start and end [m], (hinges,) each; None without friction of bending.
            duration: of the interval [s].
            step: of runs [s].
        """
        out = np.empty(self._shape)
        addresses = (float64_address(name, array, self._shape) for name, array in zip("xvxv", start + end, strict=True))
        lengths = (0, 0) if plastic_lengths is None else [address(lengths) for lengths in plastic_lengths]
        check(self._library.cloth_kink_velocities(self._handle, *addresses, *lengths, duration, step, address(out)))
        return out

    def prescribe(self, t: float, x: Array, v: Array) -> Array:
        """Set x, v of prescribed particles to their gripper's; return impulses, work, dissipation, (grippers, 8)."""
        if self._grip_binding is None:
            return np.zeros((0, RECORD_NUMBERS))
        return self._grip_binding.prescribe(t, x, v)

    def grip_wrench_rates(
        self, t: float, x: Array, v: Array, weight: float = 1.0, memory: StateMemory = MISSING_MEMORY
    ) -> Array:
        """Return per gripper, (grippers, 8): wrench of the cloth on it, its power on the cloth, dissipation of grips.

        Args:
            t: time [s].
            x: positions [m], shape (3, n).
            v: velocities [m/s], shape (3, n).
            weight: factor on the result.
            memory: `State.memory`; contact and friction act on prescribed particles too.

        Returns:
            Force [N] (3), torque [N m] (3), power [W], dissipated power [W], shape (grippers, RECORD_NUMBERS).
        """
        if self._grip_binding is None:
            return np.zeros((0, RECORD_NUMBERS))
        if self.prescribed_particles().size:
            if self.contact is not None:
                self.contact.upload(memory)
            if self.plastic is not None:
                self.plastic.upload(memory)
        status, rates = self._grip_binding.wrench_rates(t, x, v, weight)
        self._raise_for_status(status)
        return rates

    def dissipation(self, t: float, x: Array, v: Array, memory: StateMemory = MISSING_MEMORY) -> float:
        """Return the power that all damping dissipates [W], grips and contact included."""
        dissipated = ordered_sum(
            self.grip_wrench_rates(t, x, v, 1.0, memory)[:, 7].tolist(), self.powers(t, x, v, memory)[0]
        )
        if self.contact is None:
            return dissipated
        return ordered_sum(self.contact.wrench_rates(t, x, v, memory)[:, 7].tolist(), dissipated)

    def external_power(self, t: float, x: Array, v: Array, memory: StateMemory = MISSING_MEMORY) -> float:
        """Return the external power [W], of wind and Python forces together."""
        return self.powers(t, x, v, memory)[1]

    def add_bounds(
        self, x: Array, stiff: Array, damped: Array, t: float = 0.0, memory: StateMemory = MISSING_MEMORY
    ) -> None:
        """Add blocks B (6, n) that bound stiffness [N/m] and damping [N s/m] to `stiff`, `damped`: u'Ku <= u'Bu."""
        self._upload(memory)
        shape = (6, self.model.particle_count)
        addresses = writable_address("stiff", stiff, shape), writable_address("damped", damped, shape)
        check(self._library.cloth_bounds(self._handle, float64_address("x", x, self._shape), *addresses))
        damped[:3] += self._drag * self.model.masses
        if self._grip_binding is not None:
            self._grip_binding.add_bounds(stiff, damped)
        if self.contact is not None:
            self.contact.add_bounds(t, x, stiff, damped, memory)
        for force in self._python_forces:
            force.add_stiffness(x, stiff)
            force.add_damping(x, damped)

    def add_jacobian_product(
        self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array, memory: StateMemory = MISSING_MEMORY
    ) -> None:
        """Add the derivative of the forces along (dx, dv), ``(df/dx) dx + (df/dv) dv`` [N], to ``out`` (3, n)."""
        self._upload(memory)
        arrays = {"x": x, "v": v, "dx": dx, "dv": dv}
        addresses = [float64_address(name, array, self._shape) for name, array in arrays.items()]
        addresses.append(writable_address("out", out, self._shape))
        check(self._library.cloth_derivative_product(self._handle, t, *addresses))
        for force in self._python_forces:
            force.add_jacobian_product(t, x, v, dx, dv, out)

    def pair_blocks(self, list_index: int, count: int, x: Array, stiffness: float, damping: float) -> Array:
        """Return 3x3 blocks ``stiffness`` K + ``damping`` C of each element of a list of springs, joints or membranes.

        `StageMatrix` uses them.

        Args:
            list_index: index of the list.
            count: number of its blocks: one an element, three a membrane.
            x: positions [m], shape (3, n).
            stiffness: factor on the stiffness.
            damping: factor on the damping.

        Returns:
            Shape (count, 6) for springs and joints: xx, yy, zz, xy, xz, yz; (count, 9) for membranes, by rows.

        Raises:
            ValueError: if the plan has no such list.
        """
        if not 0 <= list_index < len(self._pair_counts) or self._pair_counts[list_index] != count:
            raise ValueError(f"list {list_index} of {count} blocks; the plan has lists of {self._pair_counts}")
        is_membrane = self._membrane_lists[list_index]
        out, x_address = np.empty((count, 9 if is_membrane else 6)), float64_address("x", x, self._shape)
        coefficients = stiffness, damping
        function = self._library.cloth_membrane_blocks if is_membrane else self._library.cloth_pair_blocks
        check(function(self._handle, list_index, x_address, *coefficients, out.ctypes.data))
        return out
