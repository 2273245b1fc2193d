# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine binding of a plan's contact with obstacles and with itself.

It uploads geometry, controls and the memory of a state, and queries forces, energies and bounds.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine import binding
from cloth_sim_ros.engine.binding import PATH_NUMBERS, address, check, float64_address, library, writable_address
from cloth_sim_ros.physics.arithmetic.arrays import combine
from cloth_sim_ros.physics.contact import self_contact_binding
from cloth_sim_ros.physics.contact.feature_binding import FeatureBinding, upload_meshes
from cloth_sim_ros.physics.contact.implicit_jaws import step_jaws
from cloth_sim_ros.physics.contact.parallel_jaw import NO_SETPOINT
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.model.controls import ThicknessRecovery
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.physics.plan.runs import Run
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable
from cloth_sim_ros.physics.state.controller_state import (
    ANCHORS_KEY,
    JAWS_KEY,
    LAYER_SIDES,
    MISSING_MEMORY,
    THICKNESS_KEY,
    StateMemory,
    with_jaws,
)
from cloth_sim_ros.physics.state.state import State

#: Operations of a force evaluation: of a particle in reach of an obstacle; of its friction; of a pair in reach. A pair
#: is a particle or point with a triangle, or two edges.
PARTICLE_OPERATIONS, FRICTION_OPERATIONS, PAIR_OPERATIONS = 60, 150, 150


class ContactBinding(Uncopyable):
    """Engine binding of a plan's contact: uploads obstacles and controls, queries forces, gaps and bounds.

    Friction anchors, jaw states and reduced thickness belong to a state. Therefore queries take its memory. If it has
    none of them, there are no anchors, the jaws are open and contacts have the full thickness. The same holds for
    anchors and jaws of other obstacles.

    Args:
        engine_plan: handle of the engine's plan.
        contact: the force.
        particle_count: number of particles of the model.
    """

    def __init__(self, engine_plan: PlanHandle, contact: Contact, particle_count: int) -> None:
        self._engine_plan, self.force = engine_plan, contact
        self._library, self._handle = library(), engine_plan.pointer
        self._shape = (3, particle_count)
        #: Number of obstacles, jaws included.
        self.count = len(contact.obstacles)
        #: Shape of anchors: obstacles; position in the obstacle's frame [m] and bond (none, sticks, slides); particles.
        #: With friction between layers there are two more rows: triangle, weights of its second and third corner, bond.
        self.anchors_shape = (
            self.count + LAYER_SIDES * contact.has_self_friction,
            binding.ANCHOR_NUMBERS,
            particle_count,
        )
        #: Shape of jaw states: pinches; half opening between the faces [m] and jaw speed [m/s].
        self.jaws_shape = (len(contact.jaws), binding.JAW_NUMBERS)
        # Controls and arrays of a state's memory that the engine has.
        self._paths: Array | None = None
        self._jaw_commands: NDArray[np.bool_] = np.zeros((0, 2), dtype=bool)
        self._anchors: Array | None = None
        self._jaws: Array | None = None
        self._thickness: Array | None = None
        self._recovery: ThicknessRecovery | None = None
        self._time_offset = 0.0
        #: Output buffer of the engine's predictions, allocated once.
        self._out = (ctypes.c_double * 8)()
        self._out_address = ctypes.addressof(self._out)
        self_contact_binding.upload_surface(self._handle, contact)
        faces = contact.faces
        self._features = None if faces is None else FeatureBinding(engine_plan, faces, particle_count)
        self._upload_obstacles()

    def _upload_obstacles(self) -> None:
        """Upload obstacles (shapes, sizes, friction, meshes) and the parameters of the contact law."""
        force = self.force
        shapes = np.array([binding.SHAPES[obstacle.shape] for obstacle in force.obstacles], dtype=np.int64)
        sizes, paths = np.zeros((self.count, 3)), np.zeros((self.count, PATH_NUMBERS))
        for row, obstacle in zip(sizes, force.obstacles, strict=True):
            row[: len(obstacle.size)] = obstacle.size
        bounding_radii = [obstacle.bounding_radius for obstacle in force.obstacles[: force.n_solids]]
        bounding_radii += [jaw.bounding_radius for jaw in force.jaws for _ in range(2)]
        radii = np.array(bounding_radii, dtype=np.float64)
        frictions = np.array([obstacle.friction for obstacle in force.obstacles], dtype=np.float64)
        arrays = (array.ctypes.data for array in (shapes, sizes, radii, frictions, paths))
        law_parameters = force.thickness, force.damping, force.frequency
        check(self._library.cloth_plan_contact(self._handle, self.count, *arrays, *law_parameters))
        upload_meshes(self._handle, force.obstacles)
        if self._features is not None:
            self._features.upload(force.obstacles, force.thickness)

    def upload(self, memory: StateMemory) -> None:
        """Upload to the engine the controls, and a memory's anchors, jaws and contact thickness, if they changed.

        Arrays are never changed, but replaced. Therefore their identity tells if the engine has them.

        Raises:
            ValueError: for `MISSING_MEMORY`, and for arrays that do not fit.
        """
        if memory is MISSING_MEMORY:
            raise ValueError("contact depends on the memory of the state; pass State.memory, or {} for an empty one")
        force, (controlled_paths, commands, recovery, setpoints, _) = self.force, self.force.controls
        if controlled_paths is not self._paths:
            paths = np.array(controlled_paths, dtype=np.float64)
            if paths.shape != (self.count, PATH_NUMBERS):
                raise ValueError(f"paths have shape {paths.shape}; they must be {(self.count, PATH_NUMBERS)}")
            if not np.isfinite(paths).all():
                raise ValueError(f"paths of obstacles are {paths.tolist()}; all numbers must be finite")
            paths[:, :1] -= self._time_offset
            check(self._library.cloth_plan_contact_paths(self._handle, paths.ctypes.data))
            self._paths = controlled_paths
        if commands is not self._jaw_commands:
            boxes = np.arange(force.n_solids, self.count, dtype=np.int64)
            targets = [NO_SETPOINT] * len(force.jaws) if setpoints is None else setpoints.tolist()
            rows = [
                jaw.engine_row(present, closed, target, force.thickness)
                for jaw, (present, closed), target in zip(force.jaws, commands.tolist(), targets, strict=True)
            ]
            drives = np.array(rows).reshape(len(rows), binding.DRIVE_NUMBERS)
            check(self._library.cloth_plan_jaws(self._handle, len(rows), boxes.ctypes.data, drives.ctypes.data))
            self._jaw_commands = commands
        thickness = memory.get(THICKNESS_KEY)
        if thickness is not self._thickness or (thickness is not None and recovery is not self._recovery):
            self._upload_thickness(thickness, recovery)
        if force.has_memory:
            self._upload_anchors_and_jaws(memory)

    def _upload_thickness(self, thickness: Array | None, recovery: ThicknessRecovery) -> None:
        """Upload a reduced contact thickness [m] and the rates of its recovery; None stands for the full thickness."""
        addresses: list[int | None] = [None, None]
        if thickness is not None:
            target = recovery.target
            rates = np.zeros_like(thickness) if target is None else (target - thickness) / recovery.duration
            addresses = [float64_address(THICKNESS_KEY, thickness, self.thickness_shape), address(rates)]
        check(self._library.cloth_contact_thickness(self._handle, *addresses, recovery.t - self._time_offset))
        self._thickness, self._recovery = thickness, recovery

    def _upload_anchors_and_jaws(self, memory: StateMemory) -> None:
        anchors, jaws = memory.get(ANCHORS_KEY), memory.get(JAWS_KEY)
        if self.force.has_anchors and anchors is not self._anchors:
            fitting = self.anchors_of(memory)
            self_contact_binding.check_anchors(self.force, fitting)
            check(
                self._library.cloth_contact_anchors(self._handle, float64_address(ANCHORS_KEY, fitting, fitting.shape))
            )
            self._anchors = anchors
        if self.force.jaws and jaws is not self._jaws:
            fitting = self.jaws_of(memory)
            check(self._library.cloth_plan_jaw_states(self._handle, float64_address(JAWS_KEY, fitting, fitting.shape)))
            self._jaws = jaws

    def anchors_of(self, memory: StateMemory) -> Array:
        """Return the friction anchors of a state's memory, zeros if it has none that fit, shape `anchors_shape`."""
        anchors = memory.get(ANCHORS_KEY)
        return anchors if anchors is not None and anchors.shape == self.anchors_shape else np.zeros(self.anchors_shape)

    def jaws_of(self, memory: StateMemory) -> Array:
        """Return the jaw states of a state's memory, open jaws if it has none that fit, shape `jaws_shape`."""
        jaws = memory.get(JAWS_KEY)
        if jaws is not None and jaws.shape == self.jaws_shape:
            return jaws
        return np.array([jaw.initial_state for jaw in self.force.jaws]).reshape(self.jaws_shape)

    def set_time_offset(self, duration: float) -> None:
        """Set the time offset [s] of obstacle paths and thickness recovery: at t they are as at t plus the offset."""
        self._time_offset, self._paths, self._recovery = duration, None, None

    @property
    def thickness_shape(self) -> tuple[int, int]:
        """Shape (obstacles + 1, particles + 1) of contact arrays: last row self-contact, last column obstacle edges."""
        return (self.count + 1, self._shape[1] + 1)

    def supports_single_precision(self, duration: float, x: Array, v: Array, memory: StateMemory) -> bool:
        """Return true if contact allows runs in single precision over a duration [s] from a state.

        Single precision resolves neither the stretch of an anchor's spring nor a gap within the cloth.
        """
        self.upload(memory)
        if self.force.has_friction or self.force.jaws or THICKNESS_KEY in memory:
            return False
        if not self.is_clear_of_itself(duration, x, v):
            return False
        start = float(self.force.paths[0, 0]) if self.count else 0.0
        return self._features is None or self._features.is_out_of_reach(start, duration, x, v)

    def end_buffers(self, runs: int) -> tuple[Array | None, Array | None]:
        """Return uninitialised arrays for anchors and jaws at the ends of runs, None for those that contact lacks."""
        anchors = np.empty((runs, *self.anchors_shape)) if self.force.has_anchors else None
        return anchors, np.empty((runs, *self.jaws_shape)) if self.force.jaws else None

    def combine_jaws(self, runs: Sequence[Run], weights: Sequence[float]) -> Array | None:
        """Return the weighted combination of the runs' jaw states, shape (pinches, 2); None if no gripper pinches."""
        ends = [run.jaw_states for run in runs if run.jaw_states is not None]
        return combine(ends, weights) if ends else None

    def jaw_accelerations(self, t: float, x: Array, v: Array, memory: StateMemory) -> Array:
        """Return the accelerations [m/s^2] of the jaws' half openings at time t [s], shape (pinches,)."""
        self.upload(memory)
        out = np.empty(len(self.force.jaws))
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape), address(out)
        check(self._library.cloth_jaw_accelerations(self._handle, t, *addresses))
        return out

    def combine_ends(
        self, t: float, x: Array, v: Array, runs: Sequence[Run], weights: Sequence[float], memory: StateMemory
    ) -> dict[str, Array]:
        """Return friction anchors and jaw states at the end of combined runs, by key of the state's memory.

        Args:
            t: time at the end [s].
            x: combined positions [m], shape (3, n).
            v: combined velocities [m/s], shape (3, n).
            runs: the runs.
            weights: dimensionless weight of each run.
            memory: of the state at the start of the runs.
        """
        jaws = self.combine_jaws(runs, weights)
        ends = {} if jaws is None else {JAWS_KEY: jaws}
        if self.force.has_anchors:
            anchors = np.array([run.anchors for run in runs])
            ends[ANCHORS_KEY] = self.combine_anchors(t, x, v, anchors, weights, {**memory, **ends})
        return ends

    def friction_change(
        self, t: float, duration: float, states: Sequence[Array], ends: Array, memory: StateMemory
    ) -> tuple[Array, Array]:
        """Return what friction with obstacles and layers may have changed in an interval.

        Args:
            t: start of the interval [s].
            duration: its length [s].
            states: positions at its start, and positions [m] and velocities [m/s] at its end, shape (3, n) each.
            ends: friction anchors at its end.
            memory: of the state at its start.

        Returns:
            Changes of friction per mass where particles slid [m/s^2], and velocities of vibrations where they stick
            [m/s], shape (3, n) each.
        """
        self.upload(memory)
        out = np.empty((2, *self._shape))
        arrays = [float64_address("state", array, self._shape) for array in states]
        anchors = float64_address("anchors", ends, self.anchors_shape)
        check(self._library.cloth_friction_change(self._handle, t, duration, *arrays, anchors, address(out)))
        return out[0], out[1]

    def stretch_difference(self, t: float, ends: Sequence[tuple[Array, StateMemory]]) -> Array:
        """Return differences of the stretches of anchor springs [m], (3, n), between two states of one time.

        Springs that slide in both are left out, because the cone limits them.

        Args:
            t: the time [s].
            ends: positions [m], shape (3, n), and memory of both.
        """
        (x, memory), (y, other_memory) = ends
        self.upload(memory)
        out, anchors = np.empty(self._shape), float64_address("anchors", other_memory[ANCHORS_KEY], self.anchors_shape)
        addresses = float64_address("x", x, self._shape), float64_address("x", y, self._shape)
        check(self._library.cloth_stretch_difference(self._handle, t, *addresses, anchors, address(out)))
        return out

    def jerk_change(self, t: float, duration: float, states: Sequence[Array], memory: StateMemory) -> Array:
        """Return changes of the jerk by pushes of contact in an interval [m/s^3], (3, n), without damping.

        Args:
            t: start of the interval [s].
            duration: its length [s].
            states: positions [m] and velocities [m/s] at its start, then at its end, shape (3, n) each.
            memory: of the state at its start.
        """
        self.upload(memory)
        out = np.empty(self._shape)
        arrays = [float64_address("state", array, self._shape) for array in states]
        check(self._library.cloth_contact_jerk_change(self._handle, t, duration, *arrays, address(out)))
        return out

    def friction_power(self, t: float, x: Array, v: Array, memory: StateMemory) -> float:
        """Return the power [W] that friction between layers of the cloth dissipates at time t [s]; 0 without it."""
        if not self.force.has_self_friction:
            return 0.0
        self.upload(memory)
        return self_contact_binding.friction_power(self._handle, t, x, v)

    def recovery_power(self, t: float, x: Array, v: Array, memory: StateMemory) -> float:
        """Return the power [W] on the cloth, at time t [s], of contacts that regain their thickness; 0 if none does."""
        if THICKNESS_KEY not in memory:
            return 0.0
        self.upload(memory)
        out = np.empty(1)
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape), address(out)
        check(self._library.cloth_contact_growth_power(self._handle, t, *addresses))
        return float(out[0])

    def combine_anchors(
        self, t: float, x: Array, v: Array, ends: Array, weights: Sequence[float], memory: StateMemory
    ) -> Array:
        """Return friction anchors of combined runs: weighted means, projected onto the cone of friction.

        Args:
            t: time of the combined state [s].
            x: combined positions [m], shape (3, n).
            v: combined velocities [m/s], shape (3, n).
            ends: anchors of each run, shape (runs, *anchors_shape).
            weights: dimensionless weight of each run.
            memory: memory with the combined jaws.
        """
        self.upload(memory)
        out, weight_array = np.empty(self.anchors_shape), np.array(weights, dtype=np.float64)
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape)
        ends_address = float64_address("ends", ends, (len(weights), *self.anchors_shape))
        weighted_ends = len(weights), weight_array.ctypes.data, ends_address
        check(self._library.cloth_combine_anchors(self._handle, t, *addresses, *weighted_ends, address(out)))
        return out

    def update_after_step(self, t: float, h: float, state: State) -> None:
        """Replace jaws and anchors in a state's memory after an implicit step that held them constant.

        Args:
            t: time at the end of the step [s].
            h: length of the step [s].
            state: state at the end of the step.
        """
        x, v, memory, features = state.x, state.v, state.memory, self._features
        if self.force.jaws:

            def accelerations(jaws: Array) -> Array:
                return self.jaw_accelerations(t, x, v, with_jaws(memory, jaws))

            def find_hits(jaws: Array, half_openings: Array) -> NDArray[np.bool_]:
                assert features is not None
                self.upload(with_jaws(memory, jaws))
                return features.ccd_jaw_hits(t, x, half_openings)

            hits = None if features is None else find_hits
            start = self.jaws_of(memory)
            memory[JAWS_KEY] = step_jaws(self.force, start, h, accelerations=accelerations, find_hits=hits)
        if self.force.has_anchors:
            memory[ANCHORS_KEY] = self.combine_anchors(t, x, v, self.anchors_of(memory)[None], [1.0], memory)

    def predict_contact(
        self, t: float, duration: float, x: Array, v: Array, memory: StateMemory
    ) -> tuple[float, float, float]:
        """Predict contact's bounds (squared frequency, damping rate) and its operations; refuse cloth inside obstacles.

        The bounds hold after contact has taken up the energy of all present contacts, and of those that begin by then.

        Args:
            t: time [s].
            duration: duration [s]; 0 for present contacts alone.
            x: positions [m], shape (3, n).
            v: velocities [m/s], shape (3, n).
            memory: memory of the state.

        Returns:
            Squared angular frequency [1/s^2], damping rate [1/s], and operations of a force evaluation in reach.

        Raises:
            ValueError: if a particle is inside an obstacle, naming the obstacle.
        """
        self.upload(memory)
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape), self._out_address
        # Neighbours may push, too. The energy of present contacts is known exactly.
        trust_factors = CONSTANTS.estimate_trust_factor, CONSTANTS.estimate_trust_factor if duration > 0.0 else 1.0
        check(self._library.cloth_predict_contact(self._handle, t, duration, *trust_factors, *addresses))
        energy, n_particles, n_friction, omega2, damping, self_omega2, self_damping, n_pairs = self._out
        if not math.isfinite(energy):
            from cloth_sim_ros.physics.contact.initial_penetration import check_outside

            check_outside(t, self.force.obstacles, self.obstacle_gaps(t, x, memory)[:, 1].tolist())
        if not math.isfinite(self_omega2):
            self.check_initial_penetration(t, x, memory)
        operations = PARTICLE_OPERATIONS * n_particles + FRICTION_OPERATIONS * n_friction + PAIR_OPERATIONS * n_pairs
        return omega2 + self_omega2, damping + self_damping, operations

    def predict_surface_contact(
        self, t: float, duration: float, x: Array, v: Array, memory: StateMemory
    ) -> tuple[float, float]:
        """Predict bounds (squared frequency, damping rate) of contact of the cloth's triangles and edges alone.

        Returns:
            Squared angular frequency [1/s^2] and damping rate [1/s].
        """
        return self._predict_surface_contact(t, duration, x, v, memory)[:2]

    def operation_count(self, t: float, duration: float, state: State) -> float:
        """Predict the number of operations that contact adds to each force evaluation within a duration [s]."""
        _, n_particles, n_friction = self._predict_obstacle_contact(t, duration, state.x, state.v, state.memory)
        n_pairs = self._predict_surface_contact(t, duration, state.x, state.v, state.memory)[2]
        return PARTICLE_OPERATIONS * n_particles + FRICTION_OPERATIONS * n_friction + PAIR_OPERATIONS * n_pairs

    def _predict_surface_contact(
        self, t: float, duration: float, x: Array, v: Array, memory: StateMemory
    ) -> tuple[float, float, float]:
        """Predict squared frequency, damping rate and number of pairs of contact of triangles and edges."""
        self.upload(memory)
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape), self._out_address
        trust_factor = CONSTANTS.estimate_trust_factor if duration > 0.0 else 1.0
        check(self._library.cloth_predict_surface_contact(self._handle, t, duration, trust_factor, *addresses))
        return self._out[0], self._out[1], self._out[2]

    def is_clear_of_itself(self, duration: float, x: Array, v: Array) -> bool:
        """Return true if layers of the cloth can't meet within a duration [s], so that runs may skip self-contact."""
        if self.force.surface is None:
            return True
        out = np.empty(1, dtype=np.int64)
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape), address(out)
        check(self._library.cloth_self_culled(self._handle, duration, *addresses))
        return bool(out[0])

    def reuse_pairs(self, enabled: bool) -> None:
        """Enable or disable reuse of self-contact's candidate pairs between evaluations; no bit depends on it."""
        check(self._library.cloth_self_cache_pairs(self._handle, enabled))

    def predict_energy(self, t: float, duration: float, x: Array, v: Array, memory: StateMemory) -> float:
        """Predict the largest energy per mass that contact with obstacles may absorb within a duration [s].

        Its unit is U^2/2 of the contact law; it is infinite inside an obstacle.
        """
        return self._predict_obstacle_contact(t, duration, x, v, memory)[0]

    def _predict_obstacle_contact(
        self, t: float, duration: float, x: Array, v: Array, memory: StateMemory
    ) -> tuple[float, float, float]:
        """Predict energy per mass at obstacles, and numbers of particles that reach one, and one with friction."""
        if not self.count:
            return 0.0, 0.0, 0.0
        self.upload(memory)
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape), self._out_address
        check(self._library.cloth_predict_obstacle_contact(self._handle, t, duration, *addresses))
        return self._out[0], self._out[1], self._out[2]

    def bounds_at_energy(self, energy: float) -> tuple[float, float]:
        """Return squared frequency [1/s^2] and damping rate [1/s] of obstacle contact at an energy per mass (U^2/2)."""
        if not self.count or (energy == 0.0 and not self.force.jaws):
            return 0.0, 0.0
        check(self._library.cloth_contact_limits(self._handle, energy, self._out_address))
        return self._out[0], self._out[1]

    def contact_energy(self, gap: float) -> float:
        """Return the energy per mass (unit U^2/2 of the contact law) of a contact at a gap [m]; infinite if <= 0."""
        s = min(max(gap / self.force.thickness, 0.0), 1.0)
        squared = (1.0 - s) * (1.0 - s)
        return squared * squared / s if s else math.inf

    def wrench_rates(self, t: float, x: Array, v: Array, memory: StateMemory, weight: float = 1.0) -> Array:
        """Return per obstacle, (obstacles, 8): wrench of the cloth on it, its power on the cloth, and the dissipation.

        Args:
            t: time [s].
            x: positions [m], shape (3, n).
            v: velocities [m/s], shape (3, n).
            memory: memory of the state.
            weight: factor on the result.

        Returns:
            Force [N] (3), torque about the obstacle's position [N m] (3), power [W], dissipated power [W], shape
            (obstacles, RECORD_NUMBERS).
        """
        self.upload(memory)
        out = np.zeros((self.count, binding.RECORD_NUMBERS))
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape)
        check(self._library.cloth_contact_wrenches(self._handle, t, *addresses, weight, out.ctypes.data))
        return out

    def obstacle_gaps(self, t: float, x: Array, memory: StateMemory) -> Array:
        """Return per obstacle the number of particles within the thickness and the least gap [m], (obstacles, 2).

        The gap is infinite if no particle is free.
        """
        self.upload(memory)
        out = np.empty((self.count, 2))
        check(self._library.cloth_contact_gaps(self._handle, t, float64_address("x", x, self._shape), out.ctypes.data))
        return out

    def contact_gaps(self, t: float, x: Array, memory: StateMemory) -> Array:
        """Return the gap [m] of each contact, in shape `thickness_shape`; infinite without contact.

        Gaps of edges are doubled, because edges have half the thickness.
        """
        self.upload(memory)
        out = np.empty(self.thickness_shape)
        check(self._library.cloth_contact_gap_rows(self._handle, t, float64_address("x", x, self._shape), address(out)))
        return out

    def self_gaps(self, x: Array) -> tuple[int, float]:
        """Return the number of self-contacts and their least gap [m], infinite if there are none."""
        if self.force.surface is None:
            return 0, math.inf
        out = np.empty(2)
        check(self._library.cloth_self_gaps(self._handle, float64_address("x", x, self._shape), address(out)))
        return int(out[0]), float(out[1])

    def add_bounds(self, t: float, x: Array, stiff: Array, damped: Array, memory: StateMemory) -> None:
        """Add blocks (6, n) that bound stiffness [N/m] and damping [N s/m] of contact to `stiff` and `damped`."""
        self.upload(memory)
        shape = (6, self._shape[1])
        position_address = float64_address("x", x, self._shape)
        addresses = writable_address("stiff", stiff, shape), writable_address("damped", damped, shape)
        check(self._library.cloth_contact_bounds(self._handle, t, position_address, *addresses))
        if self.force.surface is not None:
            check(self._library.cloth_self_bounds(self._handle, t, position_address, *addresses))

    def ccd_hits(self, t: float, duration: float, start: Array, end: Array, memory: StateMemory) -> bool:
        """Return true if straight paths of the particles lead through an obstacle or the cloth itself.

        Args:
            t: time at the start [s].
            duration: duration of the motion [s].
            start: positions at the start [m], shape (3, n).
            end: positions at the end [m], shape (3, n).
            memory: memory of the state.
        """
        self.upload(memory)
        out = np.empty(1, dtype=np.int64)
        addresses = float64_address("start", start, self._shape), float64_address("end", end, self._shape), address(out)
        check(self._library.cloth_ccd_obstacles(self._handle, t, duration, *addresses))
        return bool(out[0]) or self.ccd_surface_hits(t, duration, start, end, memory)

    def check_initial_penetration(self, t: float, x: Array, memory: StateMemory) -> None:
        """Raise ValueError if an obstacle comes through the cloth between particles, or the cloth through itself.

        See `initial_penetration`.
        """
        self.upload(memory)
        if self._features is not None:
            self._features.check_initial_penetration(t, x, [obstacle.name for obstacle in self.force.obstacles])
        if self.force.surface is not None:
            from cloth_sim_ros.physics.contact.initial_penetration import check_initial_penetration

            check_initial_penetration(self._engine_plan, self.force.surface, self.force.thickness, x)

    def ccd_surface_hits(self, t: float, duration: float, start: Array, end: Array, memory: StateMemory) -> bool:
        """Return true if straight paths lead the cloth's surface through itself or through obstacle features.

        Args:
            t: time at the start [s].
            duration: duration of the motion [s].
            start: positions at the start [m], shape (3, n).
            end: positions at the end [m], shape (3, n).
            memory: memory of the state.
        """
        self.upload(memory)
        if self._features is not None and self._features.ccd_hits(t, duration, start, end):
            return True
        if self.force.surface is None:
            return False
        out = np.empty(1, dtype=np.int64)
        addresses = float64_address("start", start, self._shape), float64_address("end", end, self._shape), address(out)
        check(self._library.cloth_ccd_self(self._handle, *addresses))
        return bool(out[0])
