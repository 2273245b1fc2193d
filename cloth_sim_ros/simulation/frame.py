# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Result of one frame: time, events, wrenches, and what bodies and integrator did."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import attrs

from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.old_names import with_old_names
from cloth_sim_ros.simulation.bodies.grippers import GraspResult
from cloth_sim_ros.simulation.events import Event

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.contact_recovery import ContactRecovery


# Without slots: then attrs sets a frozen class's members in half the time.
@with_old_names(halted="stopped", loads="obstacle_wrenches", again="repeated")
@attrs.frozen(kw_only=True, slots=False)
class Frame:
    """Result of one call of `Simulation.advance`: time, events, grasps, wrenches, and the report of the steps."""

    #: Index of the frame that the state has reached.
    index: int
    #: Simulated time at its end [s].
    time: float
    #: Applied events, in the order in which they took effect.
    events: tuple[Event, ...]
    #: Result of each grasp event, in order.
    grasps: tuple[GraspResult, ...]
    #: Result of each pinching gripper whose closed pads came to rest in this frame.
    pinches: tuple[GraspResult, ...] = ()
    #: Names of obstacles and grippers that stopped because they would have crushed the cloth: pinching ones, and those
    #: with prescribed particles. A stopped body keeps its pose of the frame's start until its next target.
    stopped: tuple[str, ...] = ()
    #: Name and end pose, position [m] and quaternion x, y, z, w, of each gripper that did not reach its target because
    #: of its speed limit or a stop.
    lagging: tuple[tuple[str, tuple[float, ...]], ...] = ()
    #: Contacts with a reduced thickness after the frame's events; None without such contacts or events.
    recovery: ContactRecovery | None = None
    #: Whether simulated time passed.
    moved: bool
    #: Name of the integrator that ran, or of the chosen one if no time passed.
    integrator: str
    #: Tolerance in force [m]; None if the step is fixed or no tolerance is set.
    tolerance: float | None
    #: Steps, evaluations, step sizes, error estimate and active limit of the step; None if no time passed.
    advance: Advance | None
    #: Force [N] and torque [N m] of the cloth on each gripper about its pose, mean over the frame, shape
    #: (gripper_count, 6).
    wrenches: Array
    #: Force [N] and torque [N m] of the cloth on each obstacle about its position, mean over the frame, shape
    #: (obstacle_count, 6).
    obstacle_wrenches: Array

    def extras(self) -> dict[str, Any]:
        """Return additional entries of the frame's record, plain JSON values; empty if it went as commanded.

        Returns:
            Poses of `lagging` by name under "poses", names of stopped bodies under "halted". Either is absent if empty.
        """
        extras: dict[str, Any] = {}
        if self.lagging:
            extras["poses"] = {name: list(pose) for name, pose in self.lagging}
        if self.stopped:
            extras["halted"] = list(self.stopped)
        return extras

    def repeated(self, index: int, time: float) -> Frame:
        """Return the frame that a sleeping cloth repeats, at another index and time [s], without events."""
        frame = attrs.evolve(self, index=index, time=time, events=(), grasps=(), pinches=(), recovery=None)
        wrenches, obstacle_wrenches = self.wrenches.copy(), self.obstacle_wrenches.copy()
        return attrs.evolve(frame, moved=True, wrenches=wrenches, obstacle_wrenches=obstacle_wrenches)
