# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The only door through which a cloth's state changes: advance one frame with an ordered list of events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from cloth_sim_ros.physics.book import Book, note
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import normalised
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.remembered import restart
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene import relaxation
from cloth_sim_ros.scene.identity import difference
from cloth_sim_ros.scene.rebuild import Plans
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Pause, Relax, Reset, SetParameters, Step, Target, ordered
from cloth_sim_ros.simulation.grippers import GraspResult, Grippers
from cloth_sim_ros.simulation.holding import hold, stop
from cloth_sim_ros.simulation.loads import JUMP, is_gentle
from cloth_sim_ros.simulation.sleep import Sleep, is_asleep, sleeps_until, wake

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.energy_watch import EnergyReport, EnergyWatch

#: Furthest coordinate that a target may have [m]: beyond it a command is a mistake, not a place that a gripper can be.
REACH = 1e4
#: Parameters whose change leaves the motion as it is.
_OBSERVING = frozenset(entry.name for entry in Scene.declared() if entry.observes)


class EventError(ValueError):
    """An event that can't take effect; the message says why."""


@attrs.frozen(kw_only=True)
class Frame:
    """What one call of `Simulation.advance` did."""

    #: Number of the frame that the state stands at now.
    index: int
    #: Simulated time of it [s].
    time: float
    #: The events that took effect, in the order in which they did.
    events: tuple[Event, ...]
    #: One for each grasp event, in order.
    grasps: tuple[GraspResult, ...]
    #: Whether simulated time passed.
    moved: bool
    #: Name of the integrator that ran; of the one that is chosen where no time passed.
    integrator: str
    #: Tolerance in force [m]; None where the step is fixed or none is set.
    tolerance: float | None
    #: Steps, evaluations, step sizes, error estimate and what bound the step; None where no time passed.
    advance: Advance | None
    #: Force [N] and torque [N m] of the cloth on each gripper about its pose, mean over the frame, shape
    #: (gripper_count, 6).
    wrenches: Array


class Simulation:
    """A cloth that moves frame by frame.

    Args:
        scene: configuration.
        state: where to start; the scene's initial state where left out.

    Raises:
        ValueError: if the state does not fit the scene.
    """

    def __init__(self, scene: Scene, state: State | None = None) -> None:
        initial = scene.starting_state()
        other = difference(state, initial.cloth) if state is not None and initial.cloth is not None else ""
        if other:
            raise ValueError(f"the state {other}: a state only continues the cloth that it was saved from")
        # It may have been saved asleep, under other parameters.
        wake(initial)
        hold(scene, initial)
        self._initial = initial
        self.state = initial.copy() if state is None else state.copy()
        if not initial.v.any():
            # The initial state is usually at rest: a single zero then takes the place of the whole array.
            initial.v = np.broadcast_to(0.0, initial.v.shape)
        self.state.cloth = initial.cloth
        self.state.memory.setdefault("paused", np.zeros(1, dtype=bool))
        self.grippers = Grippers(scene.gripper_names, self.state)
        if len(self.state.memory["gripper.pose"]) != len(scene.gripper_names):
            raise ValueError(
                f"the state has {len(self.state.memory['gripper.pose'])} grippers, "
                f"the scene {len(scene.gripper_names)} ({', '.join(scene.gripper_names) or 'none'})"
            )
        #: Energy balance since it was asked for or parameters changed; None where it is not asked for.
        self.energy_report: EnergyReport | None = None
        # Two shortcuts, both derived from the state. The first: the sheet sleeps, the scene in force allows it, and the
        # book has its wrenches. The second: the last frame, kept if the next one without events must equal it.
        self._known_to_rest = False
        self._slept: Frame | None = None
        self._plans = Plans(scene)
        self._apply_scene(scene)

    @property
    def scene(self) -> Scene:
        """The configuration in force."""
        return self._scene

    @property
    def frame(self) -> int:
        """Number of the frame that the state stands at."""
        return self.state.frame

    @property
    def time(self) -> float:
        """Simulated time [s]: frame number times period."""
        return self.state.frame * self._scene.period

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        return bool(self.state.memory["paused"][0])

    @property
    def asleep(self) -> bool:
        """Whether the cloth is at rest, so that its frames are not computed until something touches it."""
        return is_asleep(self.state)

    @property
    def sleeps_on(self) -> bool:
        """Whether the next frame, unless events come, costs nothing: it can only be the last one again."""
        return self._slept is not None and self.frame < sleeps_until(self.state)

    @property
    def positions(self) -> Array:
        """Particle positions [m], a copy of shape (particle_count, 3)."""
        return self.state.positions

    @property
    def velocities(self) -> Array:
        """Particle velocities [m/s], a copy of shape (particle_count, 3)."""
        return self.state.velocities

    def rests(self) -> bool:
        """Whether the cloth would stay where it is, let go at rest here, by the rule by which it falls asleep."""
        return self._sleep.rests(self.state, self.time)

    def energy(self) -> float:
        """Kinetic plus potential energy [J] at the present state."""
        return self.plan.energy(self.time, self.state.x, self.state.v)

    def rates(self, scene: Scene) -> tuple[float, float]:
        """Bounds of the squared highest frequency [1/s^2] and of the damping rate [1/s] with another scene in force."""
        return self._plans.rates(scene, self.state.x)

    def check(self, event: Event) -> None:
        """Refuse an event that can't take effect.

        Raises:
            EventError: naming the value, the limit and the remedy.
        """
        if not isinstance(event, Event):
            raise EventError(f"{event!r} is no event; see cloth_sim_ros.simulation.events")
        if isinstance(event, Target | Grasp) and event.gripper not in self.grippers.names:
            known = ", ".join(self.grippers.names) or "none"
            raise EventError(f"there is no gripper '{event.gripper}'; this cloth has {known}")
        if isinstance(event, Target):
            _check_target(event)
        elif isinstance(event, SetParameters):
            if not isinstance(event.values, dict) or not all(isinstance(name, str) for name in event.values):
                raise EventError(f"parameters {event.values!r} must be values by full name, e.g. {{'air.drag': 0.5}}")
            try:
                self._scene.changed(event.values)
            except ValueError as error:
                raise EventError(str(error)) from error
        elif isinstance(event, Relax) and not 1.0 <= event.factor <= relaxation.MOST_FACTOR:
            raise EventError(
                f"a tolerance is relaxed {event.factor} times; it must be from 1 to {relaxation.MOST_FACTOR:g}"
            )

    def advance(self, events: Sequence[Event] = ()) -> Frame:
        """Apply events at the frame's boundary, then let one frame of time pass, unless paused.

        Either all of it happens, or the state stays as it was.

        Raises:
            EventError: for an event that can't take effect.
            UnstableError: if the motion does not stay finite.
        """
        if self._slept is not None and not events and self.sleeps_on:
            return self._sleep_on(self._slept)
        self._slept = None
        in_order = ordered(list(events))
        for event in in_order:
            self.check(event)
        before, scene = self.state.share(), self._scene
        try:
            return self._advance(in_order)
        except BaseException:
            self.state.restore(before)
            if self._scene is not scene:
                self._apply_scene(scene)
            else:
                self._hold_tolerance()
            raise

    def _advance(self, events: list[Event]) -> Frame:
        grasps: list[GraspResult] = []
        stepped = False
        for event in events:
            match event:
                case Target():
                    self.grippers.set_target(event)
                case Grasp():
                    grasps.append(self._grasp(event))
                case SetParameters(values=values):
                    self._set_parameters(values)
                case Relax(factor=factor):
                    relaxation.set_factor(self.state, factor)
                    self._hold_tolerance()
                    wake(self.state)
                case Pause(paused=paused):
                    self.state.memory["paused"] = np.array([paused])
                case Step():
                    stepped = True
                case Reset():
                    self._reset()
        moved = stepped or not self.paused
        done = self._move() if moved else None
        frame = Frame(
            index=self.frame,
            time=self.time,
            events=tuple(events),
            grasps=tuple(grasps),
            moved=moved,
            integrator=done.integrator if done else self._integrator.name,
            tolerance=self._tolerance,
            advance=done,
            wrenches=self._book.wrenches if moved and self._book else np.zeros((len(self.grippers.names), 6)),
        )
        if done and not done.steps and not self.paused and self.grippers.settled:
            self._slept = frame
        return frame

    def _set_parameters(self, values: dict[str, Any]) -> None:
        before, scene, anchors = self._scene, self._scene.changed(values), self.model.anchors
        observing = values.keys() <= _OBSERVING
        # A motion beyond the fixed step already is none of the parameters' doing.
        stable = observing or self._holds_step()
        self._apply_scene(scene)
        if observing:
            return
        if not is_gentle(values, before, scene, self.state.v):
            restart(self.state, entirely=stable)
        wake(self.state)
        stop(self.state, np.setdiff1d(self.model.anchors, anchors))

    def _grasp(self, event: Grasp) -> GraspResult:
        index = self.grippers.names.index(event.gripper)
        before = self.grippers.held(index).size
        if event.closed:
            result = self.grippers.close(event.gripper, self.model, self._scene.gripper.radius)
        else:
            result = self.grippers.open(event.gripper)
        restart(self.state)
        if result.held != before:
            wake(self.state)
        return result

    def _move(self) -> Advance:
        state, start, period = self.state, self.time, self._scene.period
        done: Advance | None = None
        if is_asleep(state) and self._known_to_rest and self.grippers.settled and self.frame < sleeps_until(state):
            done = self._sleep.frame(self._integrator.name)
        else:
            self._plan_grippers(start)
            if is_asleep(state) and self._sleeps_on(start):
                done = self._sleep.frame(self._integrator.name)
        if done is None:
            self._known_to_rest = False
            if self._energy is not None:
                self._energy.begin(state, start)
            done = self._integrator.advance(self.plan, state, start, period, self._book)
            if self._energy is not None and self._book is not None:
                self.energy_report = self._energy.end(state, start + period, self._book)
            moving = state.share()
            if self._sleep.follow(state, start + period) and self._energy is not None:
                self.energy_report = self._energy.stop(moving)
        state.frame += 1
        return done

    def _plan_grippers(self, t: float) -> None:
        grips = self.plan.grips
        if grips is None:
            return
        state, period, gripper = self.state, self._scene.period, self._scene.gripper
        jerk = self.grippers.plan_frame(grips, self.model, t, period, gripper.stiffness, gripper.damping)
        if jerk > JUMP * period:
            restart(state)

    def _sleeps_on(self, t: float) -> bool:
        """Whether a sleeping cloth may sleep on; if so, the book gets its wrenches."""
        # A loaded state may have fallen asleep under other parameters, so the rule is checked once. A state that fell
        # asleep under these parameters always passes: the rule and the positions are the same.
        if not self._known_to_rest and not self._sleep.rests(self.state, t):
            wake(self.state)
        if not is_asleep(self.state) or not self._sleep.goes_on(self.state):
            return False
        self._known_to_rest = True
        if self._book is not None:
            self._book.restart()
            note(self._book, self.plan, t, self.state.x, self.state.v, self._scene.period)
        return True

    def _sleep_on(self, last: Frame) -> Frame:
        """Return a frame of a sleeping cloth: the last one with the next number."""
        self.state.frame += 1
        return Frame(
            index=self.frame,
            time=self.time,
            events=(),
            grasps=(),
            moved=True,
            integrator=last.integrator,
            tolerance=last.tolerance,
            advance=last.advance,
            wrenches=last.wrenches.copy(),
        )

    def _reset(self) -> None:
        frame, paused, factor = self.state.frame, self.paused, relaxation.factor_of(self.state)
        self.state.restore(self._initial)
        hold(self._scene, self.state)
        relaxation.set_factor(self.state, factor)
        self.state.frame = frame
        self.state.memory["paused"] = np.array([paused])
        self.grippers = Grippers(self._scene.gripper_names, self.state)

    def _apply_scene(self, scene: Scene) -> None:
        self._scene = scene
        self.plan = self._plans.change(scene)
        self.model = self.plan.model
        watches = scene.diagnostics.energy
        self._book = Book(self.plan.gripper_count, powers=watches) if self.plan.gripper_count or watches else None
        self._energy: EnergyWatch | None = None
        if scene.diagnostics.energy:
            from cloth_sim_ros.simulation.energy_watch import EnergyWatch

            self._energy = EnergyWatch(self.plan)
        self.energy_report = None
        self._hold_tolerance()

    def _holds_step(self) -> bool:
        """Whether a fixed step is within the stability limit of the motion as it is; true where none is set."""
        step, x = self._scene.step, self.state.x
        if not step:
            return True
        return step <= self._integrator.step_limit(*self.plan.rates(x))

    def _hold_tolerance(self) -> None:
        """Let integrator and sleep follow the tolerance in force: the scene's, relaxed by what the state says."""
        scene, factor = self._scene, relaxation.factor_of(self.state)
        self._integrator = scene.build_integrator(factor=factor)
        #: Tolerance in force [m], None where the step is fixed or none is set.
        self._tolerance = (relaxation.relaxed(scene.tolerance, factor) or None) if not scene.step else None
        self._sleep = Sleep(self.plan, tolerance=self._tolerance, period=scene.period)
        self._known_to_rest, self._slept = False, None


def _check_target(event: Target) -> None:
    if len(event.position) != 3 or not all(math.isfinite(value) for value in event.position):
        raise EventError(f"target of '{event.gripper}' is {list(event.position)}; it must be 3 finite numbers")
    if max(abs(value) for value in event.position) > REACH:
        raise EventError(
            f"target of '{event.gripper}' is {list(event.position)} m; no coordinate may be beyond {REACH:g} m"
        )
    if event.orientation is not None:
        try:
            normalised(event.orientation)
        except ValueError as error:
            raise EventError(f"target of '{event.gripper}': {error}") from error
