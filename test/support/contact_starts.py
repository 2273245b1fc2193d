# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Events that leave contacts compressed: largest speed, rise and energy balance of the cloth in the second after them.

Sheets of 0.3 m and 11 x 11 particles lie on an obstacle or on another sheet; contact.thickness 2 mm, no air. Sheets
that gravity would drape have none: on a sphere, on what became smaller than they are, hovering, and folded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation
from support import garment
from support.layer_stacks import stack_geometry
from support.obstacle_sheets import BORNE, SHEET, THICKNESS

#: Frames in a second, so that speeds are seen between the frames of a node.
RATE = 240
#: Largest speed [m/s], rise of a corner after a press [m], and share of what is turned over that the balance may leave.
FASTEST, HIGHEST, OPEN = 0.1, 5e-3, 1e-3
#: Tolerances [m] at which speeds, and at which the energy balance is measured: it closes as steps become finer.
COARSE, FINE = 1e-3, 1e-5

_WEIGHTLESS: dict[str, Any] = {"gravity": [0.0, 0.0, 0.0]}
#: What a sheet lies on; its top is at z = 0.
_ON: dict[str, dict[str, Any]] = {
    "plane": {"it.shape": "plane"},
    "box": {"it.shape": "box", "it.size": [0.6, 0.6, 0.1], "it.position": [0.0, 0.0, -0.05]},
    "sphere": {"it.shape": "sphere", "it.size": [0.1], "it.position": [0.0, 0.0, -0.1], **_WEIGHTLESS},
    "mesh": {"it.shape": "mesh", "it.mesh": "block.obj", "it.scale": 0.6, "it.position": [0.0, 0.0, -0.3]},
}
#: What is added below a sheet that lies on a plane, or takes the place of what it lies on, and how far below its frame
#: its top is [m].
_ADDED: dict[str, tuple[dict[str, Any], float]] = {
    "plane": ({"shape": "plane"}, 0.0),
    "box": ({"shape": "box", "size": [0.1, 0.1, 0.1]}, 0.05),
    "sphere": ({"shape": "sphere", "size": [0.05]}, 0.05),
    "mesh": ({"shape": "mesh", "mesh": "block.obj", "scale": 0.1}, 0.05),
}


@attrs.frozen
class Watched:
    """Largest speed [m/s] and rise [m] of a particle in the second after an event; share of the energy left over."""

    speed: float
    rise: float
    left_over: float


@attrs.frozen
class Start:
    """A cloth and the events that compress its contacts; without any, its start does."""

    simulation: Simulation
    events: Sequence[Event] = ()
    #: Positions from which a rise counts; None takes those at the event.
    rest_positions: Array | None = None


def block() -> bytes:
    """A cube of triangles with edges of 1 m, as an OBJ file."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))]
    return garment.as_obj(corners, np.array(triangles))


def simulation(values: dict[str, Any], state: bytes = b"", sheets: bytes = b"") -> Simulation:
    """The simulation of a sheet, or of sheets of a mesh file, from a state where one is given."""
    files = {"block.obj": block(), "state.npz": state, "sheets.obj": sheets}
    used = {name for value in values.values() for name in files if value == name}
    named: dict[str, Any] = {"initial_state": "state.npz"} if state else {}
    return Simulation(
        Scene.from_parameters(
            {
                **{name: value for name, value in SHEET.items() if not (sheets and name == "cloth.size")},
                "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
                "rate": float(RATE),
                "diagnostics.energy": True,
                **values,
                **named,
            },
            files={name: files[name] for name in {*used, *named.values()}},
        )
    )


def sheet_on(support: str, height: float, tolerance: float, **more: Any) -> dict[str, Any]:
    """Parameters of a sheet above an obstacle, at a height above its top [m]."""
    return {
        "cloth.resolution": [11, 11],
        "cloth.position": [0.0, 0.0, height],
        "obstacles": ["it"],
        "tolerance": tolerance,
        **_ON[support],
        **more,
    }


def sheets(height: float) -> bytes:
    """A held sheet and a smaller one at a height above it [m], as an OBJ file."""
    places, triangles, held = stack_geometry(7, 13, 0.3)
    places[len(held) :, 2] = height
    return garment.as_obj(places, triangles)


def stacked(height: float, tolerance: float, **more: Any) -> tuple[dict[str, Any], bytes]:
    """Parameters and mesh file of the same."""
    values = {
        "cloth.mesh": "sheets.obj",
        "cloth.position": [0.0, 0.0, 0.0],
        "cloth.anchors": [str(i) for i in range(13 * 13)],
        "contact.self": True,
        "bending.model": "opposite",
        "tolerance": tolerance,
        **more,
    }
    return values, sheets(height)


def folded(gap: float, tolerance: float) -> Simulation:
    """A sheet folded around a loop of three cells, its halves at a gap [m]; without gravity and bending."""
    values = {
        "cloth.resolution": [14, 11],
        "cloth.size": [0.39, 0.3],
        "cloth.position": [0.0, 0.0, 0.0],
        "contact.self": True,
        "bending.model": "none",
        "tolerance": tolerance,
        **_WEIGHTLESS,
    }
    flat = Scene.from_parameters({**SHEET, "cloth.orientation": [0.0, 0.0, 0.0, 1.0], **values})
    state, cell = flat.starting_state(), 0.03
    rows = np.unique(np.round(state.x[1], 9))
    half_width = math.sqrt(cell**2 - 0.25 * (cell - gap) ** 2)
    for row_index, row in enumerate(rows):
        row_particles = np.abs(state.x[1] - row) < 1e-6
        along = -cell * (5 - row_index) if row_index <= 5 else -cell * (row_index - 8)
        height = 0.0 if row_index <= 5 else gap
        if row_index in (6, 7):
            along, height = half_width, 0.5 * gap + (0.5 if row_index == 7 else -0.5) * cell
        state.x[1, row_particles], state.x[2, row_particles] = along, height
    return simulation(values, state.to_bytes())


def start(support: str, gap: float, tolerance: float) -> Start:
    """A start above an obstacle, above another sheet, or folded."""
    if support == "cloth":
        values, mesh = stacked(gap, tolerance)
        return Start(simulation(values, sheets=mesh))
    return Start(folded(gap, tolerance) if support == "fold" else simulation(sheet_on(support, gap, tolerance)))


def _thin(support: str, gap: float, tolerance: float) -> tuple[Simulation, dict[str, Any], bytes]:
    """A sheet that lies at a gap by a thickness of its own; its parameters and mesh file."""
    share = 1.0 if support == "sphere" else BORNE
    if support == "cloth":
        values, mesh = stacked(gap, tolerance)
    else:
        values, mesh = sheet_on(support, gap, tolerance), b""
    lying = simulation({**values, "contact.thickness": gap / share}, sheets=mesh)
    for _ in range(10):
        lying.advance()
    return lying, values, mesh


def thickened(support: str, gap: float, tolerance: float) -> Start:
    """contact.thickness raised under a sheet that lies."""
    return Start(_thin(support, gap, tolerance)[0], [SetParameters({"contact.thickness": THICKNESS})])


def loaded(support: str, gap: float, tolerance: float) -> Start:
    """A state that was saved with another thickness."""
    lying, values, mesh = _thin(support, gap, tolerance)
    return Start(simulation(values, lying.state.to_bytes(), mesh))


def added(support: str, gap: float, tolerance: float) -> Start:
    """An obstacle added below a sheet that lies on a plane, or hovers."""
    hovers = support == "box, hovering"
    shape, below = _ADDED["box" if hovers else support]
    more = {f"new.{name}": value for name, value in shape.items()}
    values = sheet_on("plane", BORNE * THICKNESS, tolerance, **(_WEIGHTLESS if hovers else {}))
    if hovers:
        values |= {"obstacles": [""]}
    cloth = simulation({**values, "new.position": [0.0, 0.0, BORNE * THICKNESS - gap - below], **more})
    cloth.advance()
    return Start(cloth, [SetParameters({"obstacles": [*filter(None, values["obstacles"]), "new"]})])


def changed(support: str, gap: float, tolerance: float) -> Start:
    """Change the shape or size of the support while it is not in `obstacles`."""
    small = support not in ("plane", "box, its size")
    lying = simulation(sheet_on("box", BORNE * THICKNESS, tolerance, **(_WEIGHTLESS if small else {})))
    lying.advance()
    top = BORNE * THICKNESS - gap
    if support == "box, its size":
        shape, below = {"size": [0.6, 0.6, 0.1 + 2.0 * top]}, 0.05 + top
    else:
        shape, below = _ADDED[support]
    values = {f"it.{name}": value for name, value in shape.items() if name != "mesh"}
    values["it.position"] = [0.0, 0.0, top - below]
    return Start(
        lying,
        [SetParameters({"obstacles": [""]}), SetParameters(values), SetParameters({"obstacles": ["it"]})],
    )


def released(support: str, depth: float, tolerance: float) -> Start:
    """Open a gripper that pressed a corner (on a sphere: the centre) by a depth [m] for a quarter of a second."""
    extra_values = {"gripper.radius": 0.01, "grippers": ["gripper"]}
    if support == "cloth":
        values, mesh = stacked(BORNE * THICKNESS, tolerance, **extra_values)
        cloth = simulation(values, sheets=mesh)
    else:
        thickness_fraction = 1.0 if support == "sphere" else BORNE
        cloth = simulation(sheet_on(support, thickness_fraction * THICKNESS, tolerance, **extra_values))
    resting = cloth.positions
    grasp_position = resting[60 if support == "sphere" else -1]
    cloth.advance([Target("gripper", tuple(grasp_position)), Grasp("gripper", True)])
    depth_steps = np.minimum(np.arange(1, RATE // 2 + 1) / (RATE // 4), 1.0) * depth
    for depth_step in depth_steps.tolist():
        cloth.advance([Target("gripper", (grasp_position[0], grasp_position[1], grasp_position[2] - depth_step))])
    return Start(cloth, [Grasp("gripper", False)], resting)


def watch(begun: Start, seconds: float = 1.0) -> Watched:
    """Let the events happen and a time pass."""
    cloth, events = begun.simulation, begun.events
    resting = cloth.positions if begun.rest_positions is None else begun.rest_positions
    before, speed, rise = cloth.energy_report, 0.0, 0.0
    for _ in range(round(seconds * RATE)):
        cloth.advance(events)
        events = ()
        speed = max(speed, float(np.linalg.norm(cloth.velocities, axis=1).max()))
        rise = max(rise, float((cloth.positions - resting)[:, 2].max()))
    after = cloth.energy_report
    assert after is not None
    residual, energy_turned_over = after.residual, after.turned_over
    if before is not None and begun.rest_positions is not None:
        # A change of parameters resets the sums, a gripper that opens does not.
        residual, energy_turned_over = residual - before.residual, energy_turned_over - before.turned_over
    return Watched(speed, rise, abs(residual) / energy_turned_over if energy_turned_over else 0.0)
