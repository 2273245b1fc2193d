# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sheets that hang between the jaws of a gripper."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.contact.parallel_jaw import ParallelJaw, drive_inertia
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.state.controller_state import JAWS_KEY
from support.contact_scenes import THICKNESS, drop, flat_sheet, still

FRAME = 1.0 / 60.0

ROWS, COLUMNS, SIZE = 7, 4, 0.09
SPACING = SIZE / (COLUMNS - 1)
#: Frames after which the sheet of `held` bears all of its weight, and has come to rest.
HELD = 70
#: Mass of the sheet, its density times its area [kg].
MASS = 0.2 * SIZE * SPACING * (ROWS - 1)


def make_jaw(force=1.0, *, speed=0.05, friction=(0.5, 0.5), opening=0.02, **options):
    """Return jaws that are wider than the sheet, and reach over its two upper rows."""
    values = {"size": (2.0 * SIZE, 0.01, 3.0 * SPACING), **options}
    values.setdefault("inertia", drive_inertia(MASS, force, speed or 1.0))
    return ParallelJaw(gripper="hand", force=force, speed=speed, friction=friction, opening=opening, **values)


def hanging(jaw=None, *, listed=False, anchored=True, **options):
    """Return plan, state, integrator and contact of a sheet between open jaws, its upper row at the origin."""
    jaw = jaw or make_jaw()
    force = Contact([], thickness=THICKNESS, jaws=[jaw])
    model, places = flat_sheet(
        ROWS,
        COLUMNS,
        force,
        size=SIZE,
        listed=listed,
        anchors=list(range(COLUMNS)) if anchored else (),
        **options.pop("sheet", {}),
    )
    down = np.stack([places[:, 1], np.zeros(len(places)), -(places[:, 0] - places[:, 0].min())], axis=1)
    # Jaws end halfway between two rows.
    force.set_paths(np.array([still(), still()]))
    plan, state, integrator = drop(model, down, **{"tolerance": 1e-5, **options})
    return plan, state, integrator, force


def close(force, closed=True):
    """Close or open the jaws."""
    force.set_jaw_commands(np.array([[True, closed]]))


def gravity(plan, strength, drag=0.2):
    """Set gravity downward [m/s^2] and drag [1/s] of a plan."""
    uniform = [*([Gravity((0.0, 0.0, -strength))] if strength else []), Drag(drag)]
    forces = [force for force in plan.model.forces if force.name not in ("gravity", "drag")]
    plan.change_uniform([*forces, *uniform], uniform)


def grasped_sheet(share, mu=0.5, **options):
    """Return a sheet that hangs from jaws alone, with a fraction of the least force that bears it, m g / (2 mu).

    Its weight grows within half a second, in thick air; therefore it does not fall into the jaws.
    """
    jaw = make_jaw(share * MASS * 9.81 / (2.0 * mu), friction=(mu, mu))
    material = {"gravity": False, "air.drag": 5.0}
    plan, state, integrator, force = hanging(jaw, anchored=False, sheet=material, **options)
    state.memory[JAWS_KEY] = np.array([[1.2 * THICKNESS, 0.0]])
    close(force)
    for k in range(HELD):
        gravity(plan, 9.81 * min(1.0, max(0.0, (k - 10) / 30)), drag=5.0)
        integrator.advance(plan, state, k * FRAME, FRAME)
    return plan, state, integrator, force
