# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What one frame did."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import attrs

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.grippers import GraspResult

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.contact_recovery import ContactRecovery


# Without slots: then attrs sets a frozen class's members in half the time.
@attrs.frozen(kw_only=True, slots=False)
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
    #: One for each gripper that pinches whose pads came to rest, closed, in this frame.
    pinches: tuple[GraspResult, ...] = ()
    #: Obstacles, and grippers that pinch, that would have left the cloth no room: they stand still where they were at
    #: the frame's begin until they are commanded anew.
    halted: tuple[str, ...] = ()
    #: Name and pose at the frame's end, position [m] and quaternion x, y, z, w, of each gripper that did not reach its
    #: target: its limit of speed held it back, or it is among `halted`.
    lagging: tuple[tuple[str, tuple[float, ...]], ...] = ()
    #: Contacts with a reduced thickness as the frame's events left them; None without such contacts or events.
    recovery: ContactRecovery | None = None
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
    #: The same of the cloth on each obstacle about its place, shape (obstacle_count, 6).
    loads: Array

    def extras(self) -> dict[str, Any]:
        """Return additional entries of the frame's record, plain JSON values; none in a frame that went as commanded.

        Returns:
            `poses`: `lagging` as lists by name; `halted`: names. Either is absent if empty.
        """
        extras: dict[str, Any] = {}
        if self.lagging:
            extras["poses"] = {name: list(pose) for name, pose in self.lagging}
        if self.halted:
            extras["halted"] = list(self.halted)
        return extras

    def again(self, index: int, time: float) -> Frame:
        """Return the frame that a sleeping cloth repeats, without the events that this one had."""
        now = attrs.evolve(self, index=index, time=time, events=(), grasps=(), pinches=(), recovery=None)
        return attrs.evolve(now, moved=True, wrenches=self.wrenches.copy(), loads=self.loads.copy())
