# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Snapshots of a simulation, taken in microseconds.

A snapshot holds everything that later frames read. Planners use it for rollouts, and a failed frame is undone with it.
Nothing is copied, because a frame replaces arrays and never writes to them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation import grippers
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.grippers import Grippers

if TYPE_CHECKING:
    from cloth_sim_ros.simulation import energy_watch
    from cloth_sim_ros.simulation.energy_watch import EnergyReport, EnergyWatch


# Without slots: then attrs sets a frozen class's members in half the time.
@attrs.frozen(kw_only=True, eq=False, slots=False)
class Snapshot:
    """Result of `Simulation.snapshot` and argument of `Simulation.restore`; it can be pickled.

    Do not change it: other snapshots and later frames share its arrays.
    """

    #: The configuration in force.
    scene: Scene
    #: The state, and the one that a reset restores.
    state: State
    initial: State
    #: Inputs of the plan for the last frame: grips and gripper paths; paths of obstacles and pads, and drives of pads.
    grips: grippers.Noted
    contact: tuple[Array, NDArray[np.bool_]] | None
    #: Integrals of the last frame, and the energy balance.
    book: tuple[Array, float, float, float] | None
    energy: tuple[energy_watch.Noted, EnergyReport | None] | None
    #: True if the rest of a sleeping cloth was verified, and the frame that it repeats.
    rest: tuple[bool, Frame | None]

    @property
    def frame(self) -> int:
        """Index of the frame that the state has reached."""
        return self.state.frame

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.state.frame * self.scene.period

    @property
    def positions(self) -> Array:
        """Particle positions [m], a copy of shape (particle_count, 3)."""
        return self.state.positions

    def check_fits(self, scene: Scene) -> None:
        """Refuse a restore if the scene in force differs in a parameter that is not live.

        Raises:
            ValueError: naming a parameter that differs.
        """
        if self.scene is scene or self.scene == scene:
            return
        live = {entry.name for entry in (*self.scene.entries, *scene.entries) if entry.live}
        mine, theirs = self.scene.parameters(), scene.parameters()
        for name in (name for name in mine if name not in live):
            here, there = theirs.get(name), mine[name]
            if here != there or self._content(self.scene, there) != self._content(scene, here):
                told = "its file has other content" if here == there else f"{name} is {there!r} there, {here!r} here"
                raise ValueError(
                    f"the snapshot is of another scene: {told}; restore it in a simulation of its own scene"
                )

    @staticmethod
    def _content(scene: Scene, name: Any) -> bytes | None:
        return scene.files.get(name) if isinstance(name, str) else None


def taken(
    *,
    scene: Scene,
    state: State,
    initial: State,
    plan: Plan,
    gripped: Grippers,
    book: Book | None,
    watched: EnergyWatch | None,
    report: EnergyReport | None,
    rest: tuple[bool, Frame | None],
) -> Snapshot:
    """Take a snapshot from the parts of a simulation.

    Args:
        scene: configuration in force.
        state: present state.
        initial: state that a reset restores.
        plan: compiled model.
        gripper_set: grippers.
        accumulator: wrench and work integrals of the last frame; None without.
        balance: energy watch; None if it is off.
        report: last energy report; None without.
        sleep: True if rest was verified, and the frame that a sleeping cloth repeats.
    """
    contact = plan.contact
    return Snapshot(
        scene=scene,
        state=state.share(),
        initial=initial,
        grips=gripped.noted(plan.grips),
        contact=None if contact is None else (contact.force.paths, contact.force.driven),
        book=None if book is None else book.noted(),
        energy=None if watched is None else (watched.noted(), report),
        rest=rest,
    )


def give_back(
    snapshot: Snapshot, *, plan: Plan, gripped: Grippers, book: Book | None, watched: EnergyWatch | None
) -> None:
    """Restore the inputs and integrals of a snapshot in a simulation of the same scene. The state must be restored
    before.
    """
    gripped.go_back(snapshot.grips, plan.grips)
    if plan.contact is not None and snapshot.contact is not None:
        paths, driven = snapshot.contact
        plan.contact.force.move(paths)
        plan.contact.force.drive(driven)
        plan.contact.force.recover(snapshot.time)
    if book is not None and snapshot.book is not None:
        book.go_back(snapshot.book)
    if watched is not None and snapshot.energy is not None:
        watched.go_back(snapshot.energy[0])
