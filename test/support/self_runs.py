# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Motions of cloths into themselves, frame by frame, with ipctk's exact intersection test."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import attrs
import ipctk
import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target
from cloth_sim_ros.simulation.gripper_script import GripperScript
from cloth_sim_ros.simulation.script_events import ScriptEvents
from cloth_sim_ros.simulation.simulation import Simulation
from support.random_meshes import outline_with_a_hole
from support.self_scenes import folded

THICKNESS = 0.003
TABLE = {"obstacles": ["table"], "table.shape": "plane", "table.friction": [0.5], "table.position": [0.0, 0.0, -0.003]}
CONFIG = Path(__file__).resolve().parents[2] / "config"


class Oracle:
    """ipctk's intersection test of a scene's surface, and the least gap of the observed frames."""

    def __init__(self, cloth_scene: Scene) -> None:
        rest_positions, self.triangles = cloth_scene.sheet.positions(), cloth_scene.sheet.triangles()
        edges = cloth_scene.sheet.surface.edges
        whole = [np.asfortranarray(a, dtype=np.int32) for a in (edges, self.triangles)]
        self._mesh = ipctk.CollisionMesh(np.asfortranarray(rest_positions), *whole)
        self.min_gap, self.n_contacts = math.inf, 0

    def is_intersecting(self, x: Array) -> bool:
        """Return true if the surface intersects itself at x (n, 3)."""
        return bool(ipctk.has_intersections(self._mesh, np.asfortranarray(x)))

    def observe(self, simulation: Simulation) -> bool:
        """Return true if the surface intersects itself now; add up the contacts and the least gap [m]."""
        contact = simulation.plan.contact
        assert contact is not None
        count, gap = contact.self_gaps(simulation.state.x)
        self.n_contacts, self.min_gap = self.n_contacts + count, min(self.min_gap, gap)
        return self.is_intersecting(simulation.positions)


@attrs.frozen
class SelfRun:
    """A simulation at its start, and the events of each frame to come."""

    simulation: Simulation
    events: Iterator[list[Event]]


def scene(rows: int, columns: int, size: tuple[float, float], **values: object) -> Scene:
    """A sheet in contact with itself, without anchors."""
    parameters = {
        "cloth.resolution": [rows, columns],
        "cloth.size": list(size),
        "cloth.anchors": [""],
        "contact.self": True,
        "contact.thickness": THICKNESS,
    }
    return Scene.from_parameters({**parameters, **values})


def start(cloth_scene: Scene, places: Array, velocities: Array) -> Simulation:
    """Return a simulation that starts at positions with velocities (n, 3)."""
    state = Simulation(cloth_scene).state.copy()
    start_state = State(places, velocities)
    state.x, state.v = start_state.x, start_state.v
    return Simulation(cloth_scene, state)


def untouched(frames: int) -> Iterator[list[Event]]:
    """Frames without events."""
    return iter([[]] * frames)


def fold(rng: np.random.Generator, n: int = 16, frames: int = 40) -> SelfRun:
    """A fold whose upper half comes down."""
    _, places, velocities = folded(n, speed=rng.uniform(1.0, 4.0))
    return SelfRun(start(scene(n, n, (0.3, 0.3), **TABLE), places, velocities), untouched(frames))


def three_layers(rng: np.random.Generator, n: int = 12, frames: int = 60) -> SelfRun:
    """Flat, up around, back, up around the other way, flat; the arcs' middle lines."""
    size, radius = 0.3, 0.012
    flat = (size - 2.0 * math.pi * radius) / 3.0
    s = np.repeat(np.linspace(0.0, size, n), n)
    first = np.clip((s - flat) / radius, 0.0, math.pi)
    second = np.clip((s - 2.0 * flat - math.pi * radius) / radius, 0.0, math.pi)
    back = np.clip(s - flat - math.pi * radius, 0.0, flat)
    forth = np.clip(s - 2.0 * flat - 2.0 * math.pi * radius, 0.0, None)
    x = np.minimum(s, flat) - back + forth + radius * (np.sin(first) - np.sin(second))
    z = radius * (2.0 - np.cos(first) - np.cos(second))
    places = np.column_stack([x, np.tile(np.linspace(0.0, size, n), n), z])
    # Limp, so that it stays folded.
    limp = {**TABLE, "bending.model": "none"}
    velocities = rng.normal(0.0, 0.02, places.shape)
    return SelfRun(start(scene(n, n, (size, size), **limp), places, velocities), untouched(frames))


def fall_on_an_edge(rng: np.random.Generator, n: int = 12, frames: int = 20) -> SelfRun:
    """Falls at 20 m/s with ripples; therefore it folds over itself instead of becoming narrower."""
    across, up = np.repeat(np.linspace(0.0, 0.3, n), n), np.tile(np.linspace(0.0, 0.3, n), n)
    ripples = 3e-3 * np.sin(rng.uniform(60.0, 100.0) * up) + 1e-3 * np.sin(rng.uniform(20.0, 60.0) * across)
    places = np.column_stack([across, ripples, up + 0.05])
    velocities = np.zeros_like(places)
    velocities[:, 2] = -20.0
    return SelfRun(start(scene(n, n, (0.3, 0.3), **TABLE, rate=240.0), places, velocities), untouched(frames))


def twist(rng: np.random.Generator, turns: float = 4.0) -> SelfRun:
    """A weightless strip with a fixed upper end; its lower end turns and may come nearer."""
    held = {"cloth.anchors": ["top"], "grippers": ["hand"], "gripper.radius": 0.11, "gravity": [0.0, 0.0, 0.0]}
    simulation = Simulation(scene(12, 6, (0.3, 0.15), **held))
    x = simulation.positions
    low = [*x.mean(axis=0)[:2].tolist(), float(x[:, 2].min()) - 0.07]
    frames, nearer = round(30 * turns), 0.15 * rng.uniform(0.8, 1.1)

    def events() -> Iterator[list[Event]]:
        yield [Target("hand", low, [0.0, 0.0, 0.0, 1.0])]
        yield from untouched(4)
        yield [Grasp("hand", True)]
        for k in range(1, frames + 1):
            half, position = math.pi * turns * k / frames, [*low[:2], low[2] + nearer * k / frames]
            yield [Target("hand", position, [0.0, 0.0, math.sin(half), math.cos(half)])]

    return SelfRun(simulation, events())


def crush(rng: np.random.Generator, n: int = 12) -> SelfRun:
    """A fold between two plates that approach until three and a half thicknesses remain for its two layers."""
    plates = {"obstacles": ["table", "press"], "press.shape": "box", "press.size": [0.8, 0.8, 0.02]}
    high, low, speed = 0.12, 3.5 * THICKNESS - 0.003, rng.uniform(0.2, 1.0)
    crushed_scene = scene(n, n, (0.3, 0.3), **{**TABLE, **plates, "press.position": [0.0, 0.0, high + 0.01]})
    _, places, velocities = folded(n, speed=0.5)
    simulation = start(crushed_scene, places, velocities)

    def events() -> Iterator[list[Event]]:
        height = high
        while height > low:
            height = max(low, height - speed * crushed_scene.period)
            yield [Move("press", [0.0, 0.0, height + 0.01])]
        yield from untouched(20)

    return SelfRun(simulation, events())


def mesh_with_a_hole(rng: np.random.Generator, count: int = 250, frames: int = 90) -> SelfRun:
    """An irregular outline with a hole falls over a ball and a table, and hangs together below it."""
    values = {
        "cloth.mesh": "hole.obj",
        "cloth.position": [*rng.uniform(-0.02, 0.02, 2).tolist(), 0.16],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "cloth.anchors": [""],
        "material.bending_modulus": 1e-6,
        "bending.model": "altitude",
        "contact.self": True,
        "contact.thickness": 0.002,
        "obstacles": ["table", "ball"],
        "table.shape": "plane",
        "ball.shape": "sphere",
        "ball.size": [0.06],
        "ball.position": [0.12, 0.0, 0.07],
    }
    while True:
        try:
            files = {"hole.obj": outline_with_a_hole(rng, count, 0.4)[0]}
            return SelfRun(Simulation(Scene.from_parameters(values, files=files)), untouched(frames))
        except ParameterError as error:
            if "single point" not in str(error):  # Some outlines fall into parts.
                raise


def towel(rng: np.random.Generator, seconds: float = 7.0) -> SelfRun:
    """The towel of config/fold.yaml, folded by two grippers."""
    values = parameter_file.read(CONFIG / "fold.yaml")
    values["contact.thickness"] = rng.uniform(0.003, 0.005)
    simulation = Simulation(Scene.from_parameters(values))
    scripts = [GripperScript.from_file(CONFIG / f"fold_{corner}.yaml") for corner in ("left", "right")]
    played = ScriptEvents(scripts, simulation.scene.period)
    return SelfRun(simulation, map(played.at, range(round(seconds * simulation.scene.rate))))


RUNS = {
    "fold": fold,
    "towel folded by grippers": towel,
    "twist by four turns": twist,
    "crush between plates": crush,
    "fall on an edge at 20 m/s": fall_on_an_edge,
    "three layers": three_layers,
    "mesh with a hole": mesh_with_a_hole,
}
