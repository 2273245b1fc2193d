# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine binding of a plan's contact with obstacles and with itself.

It uploads geometry and state, and queries forces, energies and bounds.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine import binding
from cloth_sim_ros.engine.binding import PATH_NUMBERS, address, check, doubles, library, writable
from cloth_sim_ros.physics.arithmetic.arrays import combine
from cloth_sim_ros.physics.contact import implicit_jaws, self_contact_binding
from cloth_sim_ros.physics.contact.feature_binding import FeatureBinding, upload_meshes
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.physics.plan.runs import Run
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, JAWS_KEY, LAYER_SIDES, THICKNESS_KEY
from cloth_sim_ros.physics.state.state import State

#: Operations of a force evaluation: of a particle in reach of an obstacle; of its friction; of a pair in reach. A pair
#: is a particle or point with a triangle, or two edges.
PARTICLE_OPERATIONS, FRICTION_OPERATIONS, PAIR_OPERATIONS = 60, 150, 150


class ContactBinding(Uncopyable):
    """Engine binding of the contact of one plan.

    Args:
        engine_plan: handle of the engine's plan.
        contact: the force.
        particle_count: number of particles of the model.
    """

    def __init__(self, engine_plan: PlanHandle, contact: Contact, particle_count: int) -> None:
        self._engine_plan, self.force = engine_plan, contact
        self._library, self._handle = library(), engine_plan.pointer
        self._shape = (3, particle_count)
        # Paths and jaw commands that the engine has.
        self._paths: Array | None = None
        self._jaw_commands: NDArray[np.bool_] = np.zeros((0, 2), dtype=bool)
        self._time_offset = 0.0
        self._anchors: Array | None = None
        # Reduced thickness in the engine, the start of its recovery, and the target thickness.
        self._recovery: tuple[Array, float, Array | None] | None = None
        #: Output buffer of the engine's predictions, allocated once.
        self._out = (ctypes.c_double * 8)()
        self._out_address = ctypes.addressof(self._out)
        self_contact_binding.upload_surface(self._handle, contact)
        faces = contact.faces
        self._features = None if faces is None else FeatureBinding(engine_plan, faces, particle_count)
        self._upload_obstacles()

    @property
    def count(self) -> int:
        """Number of obstacles, jaws included."""
        return len(self.force.obstacles)

    def _upload_obstacles(self) -> None:
        """Upload obstacles and the law; `sync` uploads their paths."""
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

    def sync(self) -> None:
        """Upload the paths of obstacles and the jaw commands if they changed."""
        force, (controlled_paths, commands, _) = self.force, self.force.controls
        if controlled_paths is not self._paths:
            paths = np.array(controlled_paths, dtype=np.float64)
            if paths.shape != (self.count, PATH_NUMBERS):
                raise ValueError(f"paths have shape {paths.shape}; they must be {(self.count, PATH_NUMBERS)}")
            if not np.isfinite(paths).all():
                raise ValueError(f"paths of obstacles are {paths.tolist()}; all numbers must be finite")
            paths[:, :1] -= self._time_offset
            check(self._library.cloth_plan_contact_paths(self._handle, paths.ctypes.data))
            self._paths = controlled_paths
        if commands is self._jaw_commands:
            return
        if not np.array_equal(commands, self._jaw_commands):
            boxes = np.arange(force.n_solids, self.count, dtype=np.int64)
            rows = [jaw.engine_row(*flags) for jaw, flags in zip(force.jaws, commands.tolist(), strict=True)]
            drives = np.array(rows).reshape(len(rows), binding.DRIVE_NUMBERS)
            check(self._library.cloth_plan_jaws(self._handle, len(rows), boxes.ctypes.data, drives.ctypes.data))
        self._jaw_commands = commands

    def offset_time(self, duration: float) -> None:
        """Shift obstacle paths and thickness recovery by a duration [s]: at time t they are as at t plus duration."""
        self._time_offset, self._paths = duration, None
        if self._recovery is not None:
            self.set_thickness(self._recovery[0])

    @property
    def anchors_shape(self) -> tuple[int, int, int]:
        """Shape of anchors: obstacles; position in the obstacle's frame [m] and bond (none, sticks, slides); particles.

        With friction between layers there are two more rows: triangle, weights of its second and third corner, bond.
        """
        return (self.count + LAYER_SIDES * self.force.has_self_friction, binding.ANCHOR_NUMBERS, self._shape[1])

    @property
    def jaws_shape(self) -> tuple[int, int]:
        """Shape of jaw states: pinches; half opening between the faces [m] and jaw speed [m/s]."""
        return (len(self.force.jaws), binding.JAW_NUMBERS)

    def load_state(self, state: State) -> None:
        """Load the anchors, jaws and contact thickness of a state into the engine.

        If the state has none, or those of other obstacles, there are no anchors and the jaws are open.
        """
        self.sync()
        self.set_thickness(state.memory.get(THICKNESS_KEY))
        if not self.force.has_memory:
            return
        anchors, jaws = state.memory.get(ANCHORS_KEY), state.memory.get(JAWS_KEY)
        self.set_anchors(anchors if anchors is not None and anchors.shape == self.anchors_shape else None)
        self.set_jaws(jaws if jaws is not None and jaws.shape == self.jaws_shape else None)

    @property
    def thickness_shape(self) -> tuple[int, int]:
        """Shape of contact thickness: obstacles, then the cloth itself; particles, then an obstacle's edges."""
        return (self.count + 1, self._shape[1] + 1)

    @property
    def thickness(self) -> Array | None:
        """Contact thickness [m] in the engine; None if all contacts have the full one."""
        return None if self._recovery is None else self._recovery[0]

    @property
    def target_thickness(self) -> Array | None:
        """Target of the thickness recovery [m], see `Contact.start_recovery`; None if none grows."""
        return None if self._recovery is None else self._recovery[2]

    def set_thickness(self, reduced: Array | None) -> None:
        """Set the contact thickness [m] at the start of its recovery; None sets the full one."""
        if reduced is None:
            if self._recovery is not None:
                check(self._library.cloth_contact_thickness(self._handle, None, None, 0.0))
                self._recovery = None
            return
        start, duration, target = self.force.controls.recovery
        start -= self._time_offset
        previous = self._recovery
        if previous is not None and previous[0] is reduced and previous[1] == start and previous[2] is target:
            return
        rates = np.zeros_like(reduced) if target is None else (target - reduced) / duration
        addresses = doubles(THICKNESS_KEY, reduced, self.thickness_shape), address(rates)
        check(self._library.cloth_contact_thickness(self._handle, *addresses, start))
        self._recovery = reduced, start, target

    def set_jaws(self, jaws: Array | None) -> Array | None:
        """Set the jaw states; None opens the jaws.

        Returns:
            The jaw states, shape `jaws_shape`; None if no gripper pinches.
        """
        self.sync()
        if not self.force.jaws:
            return None
        if jaws is None:
            jaws = np.array([jaw.initial_state for jaw in self.force.jaws])
        check(self._library.cloth_plan_jaw_states(self._handle, doubles(JAWS_KEY, jaws, self.jaws_shape)))
        return jaws

    def supports_single_precision(self, duration: float, x: Array, v: Array) -> bool:
        """Return true if runs over a duration [s] from a state may calculate in single precision.

        Single precision resolves neither the stretch of an anchor's spring nor a gap within the cloth.
        """
        if self.force.has_friction or self.force.jaws or self._recovery is not None:
            return False
        if not self.is_clear_of_itself(duration, x, v):
            return False
        start = float(self.force.paths[0, 0]) if self.count else 0.0
        return self._features is None or self._features.is_out_of_reach(start, duration, x, v)

    def end_buffers(self, runs: int) -> tuple[Array | None, Array | None]:
        """Return buffers for the anchors and jaws at the ends of runs; None for those that do not exist."""
        anchors = np.empty((runs, *self.anchors_shape)) if self.force.has_anchors else None
        return anchors, np.empty((runs, *self.jaws_shape)) if self.force.jaws else None

    def combine_jaws(self, runs: Sequence[Run], weights: Sequence[float]) -> Array | None:
        """Return the weighted combination of the runs' jaw states; None if no gripper pinches."""
        ends = [run.jaw_states for run in runs if run.jaw_states is not None]
        return combine(ends, weights) if ends else None

    def jaw_accelerations(self, t: float, x: Array, v: Array) -> Array:
        """Return the accelerations [m/s^2] of the jaws' half openings, shape (pinches,)."""
        out = np.empty(len(self.force.jaws))
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape), address(out)
        check(self._library.cloth_jaw_accelerations(self._handle, t, *addresses))
        return out

    def combine_ends(
        self, t: float, x: Array, v: Array, runs: Sequence[Run], weights: Sequence[float]
    ) -> tuple[Array | None, Array | None]:
        """Return anchors and jaws of a weighted combination of runs; None for those that do not exist.

        Args:
            t: time at the end [s].
            x: combined positions [m], shape (3, n).
            v: combined velocities [m/s], shape (3, n).
            runs: the runs.
            weights: dimensionless weight of each run.
        """
        jaws = self.combine_jaws(runs, weights)
        self.set_jaws(jaws)
        if not self.force.has_anchors:
            return None, jaws
        ends = np.array([run.anchors for run in runs])
        return self.combine_anchors(t, x, v, ends, weights), jaws

    def commit(self, state: State, t: float, runs: Sequence[Run], weights: Sequence[float]) -> None:
        """Commit the anchors and jaws of a weighted combination of runs to its state.

        Args:
            state: state with the combined positions and velocities.
            t: time of the state [s].
            runs: the runs.
            weights: dimensionless weight of each run.
        """
        if not self.force.has_memory:
            return
        anchors, jaws = self.combine_ends(t, state.x, state.v, runs, weights)
        for name, array in ((ANCHORS_KEY, anchors), (JAWS_KEY, jaws)):
            if array is not None:
                state.memory[name] = array

    def set_anchors(self, anchors: Array | None) -> Array | None:
        """Set friction anchors; None sets none.

        Returns:
            The anchors, shape `anchors_shape`; None without friction.
        """
        self.sync()
        if not self.force.has_anchors:
            return None
        anchors = np.zeros(self.anchors_shape) if anchors is None else anchors
        if anchors is not self._anchors:
            self_contact_binding.check_anchors(self.force, anchors)
            check(self._library.cloth_contact_anchors(self._handle, doubles(ANCHORS_KEY, anchors, self.anchors_shape)))
            self._anchors = anchors
        return anchors

    def friction_power(self, t: float, x: Array, v: Array) -> float:
        """Return the power that friction between layers dissipates at time t [W], with the present anchors."""
        return self_contact_binding.friction_power(self._handle, t, x, v) if self.force.has_self_friction else 0.0

    def recovery_power(self, t: float, x: Array, v: Array) -> float:
        """Return the power of contacts that regain their thickness at time t [W]."""
        if self._recovery is None:
            return 0.0
        out = np.empty(1)
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape), address(out)
        check(self._library.cloth_contact_growth_power(self._handle, t, *addresses))
        return float(out[0])

    def combine_anchors(self, t: float, x: Array, v: Array, ends: Array, weights: Sequence[float]) -> Array:
        """Return the anchors of a weighted combination of runs, from the anchors at the end of each run.

        Args:
            t: time of the combined state [s].
            x: combined positions [m], shape (3, n).
            v: combined velocities [m/s], shape (3, n).
            ends: anchors of each run, shape (runs, *anchors_shape).
            weights: dimensionless weight of each run.
        """
        out, weight_array = np.empty(self.anchors_shape), np.array(weights, dtype=np.float64)
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape)
        ends_address = doubles("ends", ends, (len(weights), *self.anchors_shape))
        weighted_ends = len(weights), weight_array.ctypes.data, ends_address
        check(self._library.cloth_combine_anchors(self._handle, t, *addresses, *weighted_ends, address(out)))
        return out

    def update_after_step(self, t: float, h: float, state: State) -> None:
        """Update jaws and anchors of a state after an implicit step during which the jaws stood still.

        Args:
            t: time at the end of the step [s].
            h: length of the step [s].
            state: state at the end of the step.
        """
        if self.force.jaws:
            jaws, features, set_jaws = state.memory.get(JAWS_KEY), self._features, self.set_jaws
            loads = partial(self.jaw_accelerations, t, state.x, state.v)
            hits = None if features is None else partial(features.ccd_jaw_hits, t, state.x)
            jaws = implicit_jaws.step_jaws(self.force, jaws, h, set_jaws=set_jaws, accelerations=loads, find_hits=hits)
            state.memory[JAWS_KEY] = jaws
            self.set_jaws(jaws)
        if self.force.has_anchors and self._anchors is not None:
            state.memory[ANCHORS_KEY] = self.combine_anchors(t, state.x, state.v, self._anchors[None], [1.0])

    def predict_contact(self, t: float, duration: float, x: Array, v: Array) -> tuple[float, float, float]:
        """Predict the bounds and the cost of contact within a duration.

        The bounds hold after contact has taken up the energy of all present contacts, and of those that begin by then.

        Args:
            t: time [s].
            duration: duration [s]; 0 for present contacts alone.
            x: positions [m], shape (3, n).
            v: velocities [m/s], shape (3, n).

        Returns:
            Squared angular frequency [1/s^2], damping rate [1/s], and operations of a force evaluation in reach.

        Raises:
            ValueError: if a particle is inside an obstacle, naming the obstacle.
        """
        self.sync()
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape), self._out_address
        # Neighbours may push, too. The energy of present contacts is known exactly.
        trust_factors = CONSTANTS.estimate_trust_factor, CONSTANTS.estimate_trust_factor if duration > 0.0 else 1.0
        check(self._library.cloth_predict_contact(self._handle, t, duration, *trust_factors, *addresses))
        energy, n_particles, n_friction, omega2, damping, self_omega2, self_damping, n_pairs = self._out
        if not math.isfinite(energy):
            from cloth_sim_ros.physics.contact.initial_penetration import check_outside

            check_outside(t, self.force.obstacles, self.obstacle_gaps(t, x)[:, 1].tolist())
        if not math.isfinite(self_omega2):
            self.check_initial_penetration(t, x)
        operations = PARTICLE_OPERATIONS * n_particles + FRICTION_OPERATIONS * n_friction + PAIR_OPERATIONS * n_pairs
        return omega2 + self_omega2, damping + self_damping, operations

    def predict_surface_contact(self, t: float, duration: float, x: Array, v: Array) -> tuple[float, float]:
        """Predict the bounds of contact of the cloth's triangles and edges, with the cloth and with obstacles.

        Returns:
            Squared angular frequency [1/s^2] and damping rate [1/s].
        """
        return self._predict_surface_contact(t, duration, x, v)[:2]

    def operation_count(self, t: float, duration: float, state: State) -> float:
        """Return the operations that contact adds to a force evaluation within a duration [s] from a state at time t
        [s].
        """
        self.set_jaws(state.memory.get(JAWS_KEY))
        _, n_particles, n_friction = self._predict_obstacle_contact(t, duration, state.x, state.v)
        n_pairs = self._predict_surface_contact(t, duration, state.x, state.v)[2]
        return PARTICLE_OPERATIONS * n_particles + FRICTION_OPERATIONS * n_friction + PAIR_OPERATIONS * n_pairs

    def _predict_surface_contact(self, t: float, duration: float, x: Array, v: Array) -> tuple[float, float, float]:
        """Predict as `predict_surface_contact`; return the number of candidate pairs, too."""
        self.sync()
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape), self._out_address
        trust_factor = CONSTANTS.estimate_trust_factor if duration > 0.0 else 1.0
        check(self._library.cloth_predict_surface_contact(self._handle, t, duration, trust_factor, *addresses))
        return self._out[0], self._out[1], self._out[2]

    def is_clear_of_itself(self, duration: float, x: Array, v: Array) -> bool:
        """Return true if the cloth stays clear of itself for a duration [s], so that runs may skip self-contact."""
        if self.force.surface is None:
            return True
        self.sync()
        out = np.empty(1, dtype=np.int64)
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape), address(out)
        check(self._library.cloth_self_culled(self._handle, duration, *addresses))
        return bool(out[0])

    def reuse_pairs(self, enabled: bool) -> None:
        """Set whether candidate pairs of the cloth are reused between evaluations; no bit depends on it."""
        check(self._library.cloth_self_cache_pairs(self._handle, enabled))

    def predict_energy(self, t: float, duration: float, x: Array, v: Array) -> float:
        """Predict the energy per mass that contact may take up within a duration [s], in U^2/2; infinite inside an
        obstacle.
        """
        return self._predict_obstacle_contact(t, duration, x, v)[0]

    def _predict_obstacle_contact(self, t: float, duration: float, x: Array, v: Array) -> tuple[float, float, float]:
        """Predict the energy; return the numbers of candidate particles for all and for rough obstacles, too."""
        if not self.count:
            return 0.0, 0.0, 0.0
        self.sync()
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape), self._out_address
        check(self._library.cloth_predict_obstacle_contact(self._handle, t, duration, *addresses))
        return self._out[0], self._out[1], self._out[2]

    def bounds_at_energy(self, energy: float) -> tuple[float, float]:
        """Return squared frequency [1/s^2] and damping rate [1/s] of contact that has taken up an energy per mass, in
        U^2/2.
        """
        if not self.count or (energy == 0.0 and not self.force.jaws):
            return 0.0, 0.0
        check(self._library.cloth_contact_limits(self._handle, energy, self._out_address))
        return self._out[0], self._out[1]

    def contact_energy(self, gap: float) -> float:
        """Return the energy per mass of contact at a gap [m], in U^2/2; infinite without a gap."""
        s = min(max(gap / self.force.thickness, 0.0), 1.0)
        squared = (1.0 - s) * (1.0 - s)
        return squared * squared / s if s else math.inf

    def wrench_rates(self, t: float, x: Array, v: Array, weight: float = 1.0) -> Array:
        """Return force, torque and power of each obstacle on the cloth, and the power that its contact dissipates.

        Args:
            t: time [s].
            x: positions [m], shape (3, n).
            v: velocities [m/s], shape (3, n).
            weight: factor on the result.

        Returns:
            Force [N] (3), torque about the obstacle's position [N m] (3), power [W], dissipated power [W], shape
            (obstacles, RECORD_NUMBERS).
        """
        self.sync()
        out = np.zeros((self.count, binding.RECORD_NUMBERS))
        addresses = doubles("x", x, self._shape), doubles("v", v, self._shape)
        check(self._library.cloth_contact_wrenches(self._handle, t, *addresses, weight, out.ctypes.data))
        return out

    def obstacle_gaps(self, t: float, x: Array) -> Array:
        """Return for each obstacle the number of particles within the thickness and the least gap [m], (obstacles, 2).

        The gap is infinite if no particle is free.
        """
        self.sync()
        out = np.empty((self.count, 2))
        check(self._library.cloth_contact_gaps(self._handle, t, doubles("x", x, self._shape), out.ctypes.data))
        return out

    def contact_gaps(self, t: float, x: Array) -> Array:
        """Return the gap of each contact at time t [m], shape `thickness_shape`; infinite without contact.

        Gaps of edges are doubled, because edges have half the thickness.
        """
        self.sync()
        out = np.empty(self.thickness_shape)
        check(self._library.cloth_contact_gap_rows(self._handle, t, doubles("x", x, self._shape), address(out)))
        return out

    def contact_gaps_of(self, state: State, t: float) -> Array:
        """Return `contact_gaps` of a state at time t [s]."""
        self.load_state(state)
        return self.obstacle_gaps(t, state.x)

    def self_gaps(self, x: Array) -> tuple[int, float]:
        """Return the number of self-contacts and their least gap [m], infinite if there are none."""
        if self.force.surface is None:
            return 0, math.inf
        self.sync()
        out = np.empty(2)
        check(self._library.cloth_self_gaps(self._handle, doubles("x", x, self._shape), address(out)))
        return int(out[0]), float(out[1])

    def add_bounds(self, t: float, x: Array, stiff: Array, damped: Array) -> None:
        """Add blocks (6, n) of stiffness [N/m] and damping [N s/m] across the gaps."""
        self.sync()
        shape = (6, self._shape[1])
        position_address = doubles("x", x, self._shape)
        addresses = writable("stiff", stiff, shape), writable("damped", damped, shape)
        check(self._library.cloth_contact_bounds(self._handle, t, position_address, *addresses))
        if self.force.surface is not None:
            check(self._library.cloth_self_bounds(self._handle, t, position_address, *addresses))

    def ccd_hits(self, t: float, duration: float, start: Array, end: Array) -> bool:
        """Return true if a straight motion hits an obstacle or the cloth itself.

        Args:
            t: time at the start [s].
            duration: duration of the motion [s].
            start: positions at the start [m], shape (3, n).
            end: positions at the end [m], shape (3, n).
        """
        self.sync()
        out = np.empty(1, dtype=np.int64)
        addresses = doubles("start", start, self._shape), doubles("end", end, self._shape), address(out)
        check(self._library.cloth_ccd_obstacles(self._handle, t, duration, *addresses))
        return bool(out[0]) or self.ccd_surface_hits(t, duration, start, end)

    def check_initial_penetration(self, t: float, x: Array) -> None:
        """Refuse a cloth that an obstacle penetrates between its particles, or that penetrates itself.

        See `initial_penetration`.
        """
        self.sync()
        if self._features is not None:
            self._features.check_initial_penetration(t, x, [obstacle.name for obstacle in self.force.obstacles])
        if self.force.surface is not None:
            from cloth_sim_ros.physics.contact.initial_penetration import check_initial_penetration

            check_initial_penetration(self._engine_plan, self.force.surface, self.force.thickness, x)

    def ccd_surface_hits(self, t: float, duration: float, start: Array, end: Array) -> bool:
        """Return true if the surface hits itself or an obstacle's features in a straight motion.

        Args:
            t: time at the start [s].
            duration: duration of the motion [s].
            start: positions at the start [m], shape (3, n).
            end: positions at the end [m], shape (3, n).
        """
        if self._features is not None and self._features.ccd_hits(t, duration, start, end):
            return True
        if self.force.surface is None:
            return False
        self.sync()
        out = np.empty(1, dtype=np.int64)
        addresses = doubles("start", start, self._shape), doubles("end", end, self._shape), address(out)
        check(self._library.cloth_ccd_self(self._handle, *addresses))
        return bool(out[0])
