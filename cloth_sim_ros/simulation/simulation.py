# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulation of one cloth: advance a frame with an ordered list of events.

Every change of the cloth's state goes through this class.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator, accumulate
from cloth_sim_ros.physics.integrators.base import Advance, UnstableError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.old_names import with_old_names
from cloth_sim_ros.physics.state.controller_state import (
    PLASTIC_LENGTHS_KEY,
    count_force_change,
    reset_step_control,
)
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene import relaxation
from cloth_sim_ros.scene.plan_cache import PlanCache
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation import contact_recovery as recoveries
from cloth_sim_ros.simulation.bodies import bodies
from cloth_sim_ros.simulation.bodies.grippers import GraspResult
from cloth_sim_ros.simulation.contact_recovery import ContactRecovery, contact_recovery, pad_rows, reduce_contacts
from cloth_sim_ros.simulation.event_checks import check, check_all, check_new_scene, check_stops
from cloth_sim_ros.simulation.events import (
    Event,
    Grasp,
    Move,
    MoveObstacles,
    Pause,
    Relax,
    Reset,
    SetParameters,
    Step,
    Target,
)
from cloth_sim_ros.simulation.exclusive import ExclusiveAccess, between_frames, exclusive
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.initial_state import (
    apply_grasp,
    names_of_bodies,
    starting_states,
    stop_anchored,
    stop_particles,
)
from cloth_sim_ros.simulation.parameter_change import MAX_VELOCITY_CHANGE, acceleration_change
from cloth_sim_ros.simulation.sleep import SleepRule, is_asleep, sleeps_until, wake
from cloth_sim_ros.simulation.snapshot import Snapshot

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.energy_watch import EnergyReport, EnergyWatch


#: Events that may compress or relieve contacts.
_CONTACT_EVENTS = (Grasp, SetParameters, Reset)


@with_old_names(held="grasped_count", rates="spectral_bounds", rests="is_in_equilibrium", sleeps_on="will_stay_asleep")
class Simulation(ExclusiveAccess):
    """Simulation of one cloth, which `advance` moves frame by frame.

    Several threads may call its methods; the calls run one at a time. `state` is the live state, which changes during a
    frame. Other threads read `positions`, or take a `snapshot`.

    Args:
        scene: configuration.
        state: initial state; by default the scene's.

    Raises:
        ValueError: if the state does not fit the scene.
    """

    def __init__(self, scene: Scene, state: State | None = None) -> None:
        super().__init__()
        if not isinstance(scene, Scene):
            raise ValueError(f"scene is {scene!r}; give a Scene, e.g. by Scene.from_file or Scene.from_parameters")
        if not isinstance(state, State | None):
            raise ValueError(f"state is {state!r}; give a State, or None for the scene's")
        self._initial, self.state = starting_states(scene, state)
        self.grippers = bodies.build_grippers(scene, self.state)
        self.obstacles = bodies.build_obstacles(scene, self.state)
        if state is None and self.obstacles is not None:
            try:
                self.obstacles.check_outside(self.obstacles.names, scene.anchored_particles())
            except ValueError as error:
                raise ValueError(f"the cloth {error}") from error
        #: Energy balance since it was requested or parameters changed; None if it is off.
        self.energy_report: EnergyReport | None = None
        # Two shortcuts for a sleeping sheet. Both follow from the state and are not part of it.
        # First: the criterion of sleep was checked under the present parameters, and wrenches are accumulated.
        # Second: the last frame, kept as long as a next frame without events can only repeat it.
        self._is_rest_verified = False
        self._repeatable_frame: Frame | None = None
        self._plan_cache = PlanCache(scene)
        self._apply_scene(scene)
        for start in (self._initial, self.state):
            # Later states are on the yield surface, and mapping would round their lengths.
            if PLASTIC_LENGTHS_KEY not in start.memory:
                self.plan.return_hinges(start)
        # Only frame 0 and a new thickness need the check: later states are reached from a collision-free start.
        if self.plan.contact is not None:
            thickness = scene.contact.thickness
            if not self.state.frame or self.state.thickness not in (None, thickness):
                if scene.initial_state or state is not None:
                    subject = f"gripper.opening is {scene.gripper.opening:.4g} m; the state"
                    check_stops(scene, self.state, subject, "save one with closed pads")
                self.plan.contact.check_initial_penetration(self.time, self.state.x, self.state.memory)
                reduce_contacts(self.plan, self.state, self.time, "the cloth")
            self.state.thickness = thickness

    @property
    def scene(self) -> Scene:
        """Scene with the parameters in force."""
        return self._scene

    @property
    def frame(self) -> int:
        """Index of the frame that the state has reached."""
        return self.state.frame

    @property
    def time(self) -> float:
        """Simulated time [s]: frame index times period."""
        return self.state.frame * self._period

    @property
    def paused(self) -> bool:
        """True while time stands still, after the event `Pause`."""
        return bool(self.state.memory["paused"][0])

    @property
    def asleep(self) -> bool:
        """True if the cloth is at rest. Its frames are then not computed until an event or contact wakes it."""
        return is_asleep(self.state)

    @property
    def will_stay_asleep(self) -> bool:
        """True if the next frame costs nothing: without events it can only repeat the last one."""
        return self._repeatable_frame is not None and self.frame < sleeps_until(self.state)

    @between_frames
    def grasped_count(self, index: int) -> int:
        """Return the number of particles that the gripper of an index grasps, or has between its pads.

        Raises:
            ValueError: for an index without a gripper.
        """
        if not 0 <= index < len(self.grippers.names):
            raise ValueError(f"there is no gripper {index}; there are {len(self.grippers.names)}, counted from 0")
        name = self.grippers.names[index]
        if self.pinching is not None and name in self.pinching.names:
            return self.pinching.grasped_count(self.plan, self.time, name)
        return int(self.grippers.grasped_particles(index).size)

    @property
    @between_frames
    def positions(self) -> Array:
        """Particle positions [m], a copy of shape (particle_count, 3)."""
        return self.state.positions

    @property
    @between_frames
    def velocities(self) -> Array:
        """Particle velocities [m/s], a copy of shape (particle_count, 3)."""
        return self.state.velocities

    @exclusive
    def is_in_equilibrium(self) -> bool:
        """Return True if the cloth, released at rest, would stay in place by the criterion of sleep."""
        return self._sleep.is_in_equilibrium(self.state, self.time)

    @exclusive
    def energy(self) -> float:
        """Return kinetic plus potential energy [J] of the present state."""
        return self.plan.energy(self.time, self.state.x, self.state.v, self.state.memory)

    @exclusive
    def gaps(self) -> Array | None:
        """Return number of touching particles and smallest gap [m] by obstacle, then pad, (count, 2).

        None in a scene without contact; an array of no rows with self-contact alone.
        """
        contact = self.plan.contact
        return None if contact is None else contact.obstacle_gaps(self.time, self.state.x, self.state.memory)

    @exclusive
    def spectral_bounds(self, scene: Scene) -> tuple[float, float]:
        """Return upper bounds of squared angular frequency [1/s^2] and damping rate [1/s] with another scene."""
        return self._plan_cache.spectral_bounds(scene, self.state.x)

    @between_frames
    def check(self, event: Event) -> None:
        """Raise EventError if an event can't take effect at the next frame; change nothing.

        Raises:
            EventError: naming the value, the limit and the remedy.
        """
        check(event, self._scene, self.state, self._initial)

    @between_frames
    def check_scene(self, scene: Scene) -> None:
        """Raise EventError if a future scene has obstacles in the present cloth, or stops that pads are beyond.

        Raises:
            EventError: naming the obstacle and the location, or the gripper.
        """
        check_new_scene(self._scene, scene, self.state)

    @exclusive
    def advance(self, events: Sequence[Event] = ()) -> Frame:
        """Apply events at the frame's boundary, then advance by one frame unless paused; on an error nothing changes.

        Raises:
            EventError: for an event that can't take effect.
            UnstableError: if the motion does not stay finite.
        """
        if self._repeatable_frame is not None and not events and self.will_stay_asleep:
            self.state.frame += 1
            return self._repeatable_frame.repeated(self.frame, self.time)
        self._repeatable_frame = None
        in_order = check_all(events, self._scene, self.state, self._initial)
        before = self._snapshot()
        try:
            return self._advance(in_order)
        except BaseException:
            self._assign(before)
            raise

    @exclusive
    def restart(self, event: Reset) -> None:
        """Reset the cloth between frames, as `advance` does at the beginning of one; no time passes.

        Raises:
            EventError: for a reset that can't take effect.
        """
        check(event, self._scene, self.state, self._initial)
        self._is_rest_verified, self._repeatable_frame = False, None
        self._reset(event)

    def play(
        self, times: ArrayLike, poses: ArrayLike | Mapping[str, ArrayLike], *, closed: Any = None
    ) -> Iterator[Frame]:
        """Check recorded poses; return an iterator that moves grippers along them, a frame at each step.

        The first frame moves the grippers to their first poses. The k-th frame after it ends k periods after
        `times[0]`, with each gripper at its pose of that time, straight between two poses. A gripper that closes or
        opens at the last pose does so in one more frame.

        Args:
            times: increasing times [s], shape (count,).
            poses: position [m], and optionally quaternion x, y, z, w, in the scene's frame, shape (count, 3) or
                (count, 7); for several grippers, such an array by name.
            closed: whether the gripper is closed, for all times or for each one, shape () or (count,), or such by name;
                None leaves it as it is.

        Raises:
            ValueError: for other shapes, a value that is not finite, times that do not increase, an unknown gripper,
                or a paused simulation.
            EventError: during the iteration, for a pose that can't take effect.
        """
        from cloth_sim_ros.simulation.script_events import frame_events, pose_scripts

        if self.paused:
            raise ValueError("the simulation is paused; resume it by Pause(False)")
        scripts = pose_scripts(self.grippers.names, times, poses, closed)
        return (self.advance(events) for events in frame_events(scripts, self._period))

    @exclusive
    def snapshot(self) -> Snapshot:
        """Return the full content, for `restore`, in microseconds; the same events then give the same bits."""
        return self._snapshot()

    def _snapshot(self) -> Snapshot:
        accumulator, watch = self._accumulator, self._energy_watch
        return Snapshot(
            scene=self._scene,
            state=self.state.shallow_copy(),
            initial=self._initial,
            controls=self.plan.controls,
            accumulator=None if accumulator is None else accumulator.save(),
            energy=None if watch is None else (watch.save(), self.energy_report),
            sleep=(self._is_rest_verified, self._repeatable_frame),
        )

    @exclusive
    def restore(self, snapshot: Snapshot) -> None:
        """Restore a snapshot of the same scene, its live parameters included; raise ValueError for another scene.

        Raises:
            ValueError: for a snapshot of another scene; the message names a parameter that differs.
        """
        snapshot.check_fits(self._scene)
        self._assign(snapshot)

    def _advance(self, events: list[Event]) -> Frame:
        grasps: list[GraspResult] = []
        is_stepped = False
        for event in events:
            match event:
                case Target(gripper=name):
                    is_first = self.grippers.set_target(event)
                    if is_first and self.pinching is not None and name in self.pinching.names:
                        self._place_bodies()
                        rows = pad_rows(self.plan, name)
                        reduce_contacts(self.plan, self.state, self.time, f"target of '{name}': the cloth", rows=rows)
                case Move():
                    assert self.obstacles is not None
                    self.obstacles.set_target(event)
                case MoveObstacles() if self.obstacles is not None:
                    self.obstacles.set_targets(event)
                case Grasp():
                    grasped = np.empty(0, dtype=np.int64) if event.closed else self._grasped_particles(event.gripper)
                    grasps.append(apply_grasp(event, self.state, self._scene, self.model, self.grippers, self.pinching))
                    if grasped.size:
                        reduce_contacts(self.plan, self.state, self.time, relieved=grasped)
                case SetParameters(values=values):
                    self._set_parameters(values)
                case Relax(factor=factor):
                    relaxation.set_factor(self.state, factor)
                    self._apply_tolerance()
                    wake(self.state)
                case Pause(paused=paused):
                    self.state.memory["paused"] = np.array([paused])
                case Step():
                    is_stepped = True
                case Reset():
                    self._reset(event)
        may_reduce = any(isinstance(event, _CONTACT_EVENTS) for event in events)
        recovery = contact_recovery(self.plan, self.state) if may_reduce else None
        is_moved = is_stepped or not self.paused
        done = self._advance_time() if is_moved else None
        pinches = self.pinching.rest_results(self.plan, self.time) if is_moved and self.pinching is not None else []
        stopped = self._stopped if is_moved else ()
        is_lagging = is_moved and (stopped or self.grippers.speed_limited)
        sums = self._accumulator if is_moved else None
        wrenches, obstacle_wrenches = bodies.frame_wrenches(sums, self.plan, self.grippers, self.pinching, self.joints)
        frame = Frame(
            index=self.frame,
            time=self.time,
            events=tuple(events),
            grasps=tuple(grasps),
            pinches=tuple(pinches),
            stopped=stopped,
            lagging=self.grippers.lagging_poses(stopped) if is_lagging else (),
            recovery=recovery,
            moved=is_moved,
            integrator=done.integrator if done else self._integrator.name,
            tolerance=self._tolerance,
            advance=done,
            wrenches=wrenches,
            obstacle_wrenches=obstacle_wrenches,
        )
        if done and not done.steps and not self.paused and self._is_at_rest:
            self._repeatable_frame = frame
        return frame

    def _grasped_particles(self, gripper: str) -> NDArray[np.int64]:
        """Return the particles that a gripper grasps, or that touch its pads; place bodies at present poses for it."""
        if self.plan.contact is not None:
            # Poses come from the state: a path's end rounds differently, and a run from a saved state has no path.
            self._place_bodies()
        if self.pinching is not None and gripper in self.pinching.names:
            rows = pad_rows(self.plan, gripper).tolist()[:-1]
            return recoveries.particles_in_contact(self.plan, self.state, self.time, rows)
        return self.grippers.grasped_particles(self.grippers.names.index(gripper))

    def _set_parameters(self, values: dict[str, Any]) -> None:
        before, scene, anchors = self._scene, self._scene.changed(values), self.model.anchors
        if self.plan.contact is not None:
            self._place_bodies()  # see `_grasped_particles`
        relieved = recoveries.relieved_particles(self.plan, self.state, self.time, before, scene)
        affects_no_motion = all(entry.observes for entry in scene.entries if entry.name in values)
        # A motion that was already beyond the fixed step is not caused by the parameters.
        is_step_stable = affects_no_motion or self._is_step_stable()
        self._initial = self._initial.shallow_copy()  # snapshots share the old one
        bodies.adapt_states(before, scene, (self.state, self._initial))
        self.obstacles = bodies.build_obstacles(scene, self.state)
        self._apply_scene(scene)
        if affects_no_motion:
            return
        self.plan.return_hinges(self.state)
        change = acceleration_change(values, before, scene, self.model, self.state)
        if change <= MAX_VELOCITY_CHANGE / scene.period:
            count_force_change(self.state, change, self._tolerance)
        else:
            reset_step_control(self.state, entirely=is_step_stable)
        wake(self.state)
        stop_particles(self.state, np.setdiff1d(self.model.anchors, anchors))
        self.state.thickness = None if self.plan.contact is None else scene.contact.thickness
        self.state.bodies = names_of_bodies(scene)
        rows = recoveries.compressed_rows(before, scene)
        if rows.any() or relieved.size:
            reduce_contacts(self.plan, self.state, self.time, "the cloth", rows=rows, relieved=relieved)

    def _advance_time(self) -> Advance:
        state, start, period = self.state, self.time, self._period
        done: Advance | None = None
        self._stopped: tuple[str, ...] = ()
        if is_asleep(state) and self._is_rest_verified and self._is_at_rest and self.frame < sleeps_until(state):
            done = self._sleep.sleeping_advance(self._integrator.name)
        else:
            before = None if self.plan.contact is None else state.shallow_copy()
            self._plan_paths(start)
            if before is not None and (
                blocked := bodies.blocked_grippers(self.plan, self.grippers, state, start, period)
            ):
                state.restore(before)
                self._stopped = tuple(self.grippers.hold_position(blocked))
                self._plan_paths(start)
            if is_asleep(state) and self._may_stay_asleep(start):
                done = self._sleep.sleeping_advance(self._integrator.name)
        if done is None:
            self._is_rest_verified = False
            if self._energy_watch is not None:
                self._energy_watch.begin(state, start)
            try:
                done = self._integrator.advance(self.plan, state, start, period, self._accumulator)
            except UnstableError:
                if before is not None:
                    state.restore(before)
                    stopped = bodies.stop_bodies(self.obstacles, self.grippers)
                    self._stopped = (*self._stopped, *(name for name in stopped if name not in self._stopped))
                if before is None or not stopped:
                    raise
                # With stopped bodies a solution always exists: the cloth at rest.
                self._plan_paths(start)
                done = self._integrator.advance(self.plan, state, start, period, self._accumulator)
            if self._energy_watch is not None and self._accumulator is not None:
                self.energy_report = self._energy_watch.end(state, start + period, self._accumulator)
            state_before_sleep = None if self._energy_watch is None else state.shallow_copy()
            falls_asleep = self._sleep.update(state, start + period)
            if falls_asleep and self._energy_watch is not None and state_before_sleep is not None:
                self.energy_report = self._energy_watch.add_sleep_loss(state_before_sleep)
        state.frame += 1
        #: Controls of the last frame.
        self.frame_controls = self.plan.controls
        recoveries.end_recovery(self.plan, state, self.time)
        return done

    @property
    def _is_at_rest(self) -> bool:
        """True if grippers and obstacles are at rest."""
        return self.grippers.is_at_rest and (self.obstacles is None or self.obstacles.is_at_rest)

    def _plan_paths(self, t: float) -> None:
        """Move bodies over the frame from time t [s] on, and set the plan's controls and contact recovery for it."""
        self.plan.controls, change = bodies.move_bodies(
            self.plan, self._scene, self.obstacles, self.pinching, self.grippers, self.joints, t
        )
        recoveries.begin_recovery(self.plan, self.state, t, self._period)
        if change > MAX_VELOCITY_CHANGE * self._period:
            reset_step_control(self.state)

    def _may_stay_asleep(self, t: float) -> bool:
        """Return True if a sleeping cloth stays asleep, with its wrenches accumulated; else wake it."""
        # A loaded state may have fallen asleep under other parameters, so the criterion is checked once. A state that
        # fell asleep under these parameters always passes, because criterion and positions are the same.
        if not self._is_rest_verified and not self._sleep.is_in_equilibrium(self.state, t):
            wake(self.state)
        if not is_asleep(self.state) or not self._sleep.may_stay_asleep(self.state):
            return False
        self._is_rest_verified = True
        if self._accumulator is not None:
            self._accumulator.reset()
            state = self.state
            accumulate(self._accumulator, self.plan, t, state.x, state.v, self._period, state.memory)
        return True

    def _reset(self, event: Reset) -> None:
        frame, paused, factor = self.state.frame, self.paused, relaxation.factor_of(self.state)
        self.state.restore(self._initial)
        stop_anchored(self._scene, self.state)
        relaxation.set_factor(self.state, factor)
        self.state.frame = frame
        self.state.memory["paused"] = np.array([paused])
        self.grippers = bodies.build_grippers(self._scene, self.state)
        self.obstacles = bodies.build_obstacles(self._scene, self.state)
        self.joints = bodies.build_joints(self._scene, self.model, self.state)
        if self.obstacles is not None:
            self.obstacles.set_poses(event)
        self._place_bodies()
        reduce_contacts(self.plan, self.state, self.time, "the cloth as it starts")

    @property
    @between_frames
    def contact_recovery(self) -> ContactRecovery | None:
        """Contacts with a reduced thickness and their recovery time; None if every contact has the full one."""
        return contact_recovery(self.plan, self.state)

    def _place_bodies(self) -> None:
        """Place obstacles and pads at their present poses for contact, until the next frame moves them."""
        #: Pinching grippers; None without any.
        self.pinching = bodies.build_parallel_grippers(self.plan, self.grippers, self.state)
        contact = bodies.standing_controls(self.plan, self.obstacles, self.pinching, self.grippers, self.time)
        self.plan.controls = self.plan.controls._replace(contact=contact)

    def _apply_scene(self, scene: Scene) -> None:
        self._scene, self._period = scene, scene.period
        self.plan = self._plan_cache.change(scene)
        self.model = self.plan.model
        #: Joints between particles and obstacles; None without any.
        self.joints = bodies.build_joints(scene, self.model, self.state)
        is_energy_watched = scene.diagnostics.energy
        grippers, obstacles = self.plan.gripper_count, self.plan.obstacle_count
        self._accumulator: WorkAccumulator | None = None
        if grippers or obstacles or is_energy_watched:
            self._accumulator = WorkAccumulator(grippers, record_power=is_energy_watched, obstacle_count=obstacles)
        self._place_bodies()
        self._energy_watch: EnergyWatch | None = None
        if is_energy_watched:
            from cloth_sim_ros.simulation.energy_watch import EnergyWatch

            self._energy_watch = EnergyWatch(self.plan)
        self.energy_report = None
        self._apply_tolerance()

    def _is_step_stable(self) -> bool:
        """Return True if the fixed step is within the present stability limit, or no step is set."""
        step = self._scene.step
        return not step or step <= self._integrator.step_limit(*self.plan.spectral_bounds(self.state.x))

    def _apply_tolerance(self) -> None:
        """Build integrator and sleep rule for the tolerance in force: the scene's times the relaxation factor."""
        scene, self._relaxation_factor = self._scene, relaxation.factor_of(self.state)
        self._integrator = scene.build_integrator(factor=self._relaxation_factor)
        #: Tolerance in force [m]; None if the step is fixed or no tolerance is set.
        tolerance = relaxation.relaxed_tolerance(scene.tolerance, self._relaxation_factor)
        self._tolerance = None if scene.step else tolerance or None
        self._sleep = SleepRule(self.plan, tolerance=self._tolerance, period=scene.period)
        self._is_rest_verified, self._repeatable_frame = False, None

    def _assign(self, snapshot: Snapshot) -> None:
        scene = snapshot.scene
        self.state.assign(snapshot.state)
        self._initial = snapshot.initial
        if scene is not self._scene and scene != self._scene:
            self.obstacles = bodies.build_obstacles(scene, self.state)
            self._apply_scene(scene)
        elif relaxation.factor_of(self.state) != self._relaxation_factor:
            self._apply_tolerance()
        self._scene = scene
        self.plan.controls = snapshot.controls
        if self._accumulator is not None and snapshot.accumulator is not None:
            self._accumulator.restore(snapshot.accumulator)
        if self._energy_watch is not None and snapshot.energy is not None:
            balance, self.energy_report = snapshot.energy
            self._energy_watch.restore(balance)
        self._is_rest_verified, self._repeatable_frame = snapshot.sleep
