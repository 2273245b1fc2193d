# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""No frame of a cloth that touches itself passes through itself, by ipctk's test and by one in exact arithmetic."""

import math

import numpy as np
import pytest
from support.self_scenes import folded, intersections

from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

ipctk = pytest.importorskip("ipctk")

THICKNESS = 0.003
TABLE = {"obstacles": ["table"], "table.shape": "plane", "table.friction": [0.5], "table.position": [0.0, 0.0, -0.003]}


def scene(rows, columns, size, **values):
    given = {
        "cloth.resolution": [rows, columns],
        "cloth.size": list(size),
        "cloth.anchors": [""],
        "contact.self": True,
        "contact.thickness": THICKNESS,
    }
    return Scene.from_parameters({**given, **values})


class Oracle:
    """ipctk's test of a scene's surface, and how near it came to itself in the frames that were looked at."""

    def __init__(self, wanted):
        rest, self.triangles = wanted.sheet.positions(), wanted.sheet.triangles()
        edges = wanted.sheet.surface.edges
        whole = [np.asfortranarray(a, dtype=np.int32) for a in (edges, self.triangles)]
        self._mesh = ipctk.CollisionMesh(np.asfortranarray(rest), *whole)
        self.least, self.met = math.inf, 0

    def passes(self, x):
        """Whether the surface passes through itself at x (n, 3)."""
        return ipctk.has_intersections(self._mesh, np.asfortranarray(x))

    def look(self, simulation):
        """Look at a frame, in which nothing may pass through anything."""
        assert not self.passes(simulation.positions)
        count, gap = simulation.plan.contact.own_gaps(simulation.state.x)
        self.met, self.least = self.met + count, min(self.least, gap)


def start(wanted, places, velocities):
    """A simulation that starts at places with velocities (n, 3)."""
    state = Simulation(wanted).state.copy()
    given = State(places, velocities)
    state.x, state.v = given.x, given.v
    return Simulation(wanted, state)


def test_the_oracles_see_what_passes():
    wanted = scene(12, 12, (0.3, 0.3))
    _, places, velocities = folded(12)
    oracle, upper = Oracle(wanted), velocities[:, 2] < 0.0
    for tilt, passes in ((0.0, False), (0.1, False), (0.5, True)):
        tilted = places.copy()
        tilted[upper, 2] += tilt * places[upper, 1]
        assert oracle.passes(tilted) == passes
        assert bool(intersections(oracle.triangles, tilted)) == passes


def test_a_fold_that_comes_down():
    wanted = scene(16, 16, (0.3, 0.3), **TABLE)
    _, places, velocities = folded(16)
    simulation, oracle = start(wanted, places, velocities), Oracle(wanted)
    for _ in range(40):
        simulation.advance()
        oracle.look(simulation)
    assert oracle.met > 50
    assert not intersections(oracle.triangles, simulation.positions)


def test_three_layers():
    n, size, radius = 12, 0.3, 0.012
    wanted = scene(n, n, (size, size), **TABLE)
    flat = (size - 2.0 * math.pi * radius) / 3.0
    s = np.repeat(np.linspace(0.0, size, n), n)
    # Flat, up around, back, up around the other way, flat: the middle lines of the arcs.
    first = np.clip((s - flat) / radius, 0.0, math.pi)
    second = np.clip((s - 2.0 * flat - math.pi * radius) / radius, 0.0, math.pi)
    back = np.clip(s - flat - math.pi * radius, 0.0, flat)
    forth = np.clip(s - 2.0 * flat - 2.0 * math.pi * radius, 0.0, None)
    x = np.minimum(s, flat) - back + forth + radius * (np.sin(first) - np.sin(second))
    z = radius * (2.0 - np.cos(first) - np.cos(second))
    places = np.column_stack([x, np.tile(np.linspace(0.0, size, n), n), z])
    simulation, oracle = start(wanted, places, np.zeros_like(places)), Oracle(wanted)
    for _ in range(60):
        simulation.advance()
        oracle.look(simulation)
    assert oracle.met > 300
    assert oracle.least > 0.4 * THICKNESS
    assert not intersections(oracle.triangles, simulation.positions)


def test_a_sheet_that_falls_on_its_edge_at_20_metres_per_second():
    wanted = scene(12, 12, (0.3, 0.3), **TABLE, rate=240.0)
    across, up = np.repeat(np.linspace(0.0, 0.3, 12), 12), np.tile(np.linspace(0.0, 0.3, 12), 12)
    # Ripples, so that it folds over itself, and does not only become narrower.
    places = np.column_stack([across, 3e-3 * np.sin(80.0 * up) + 1e-3 * np.sin(40.0 * across), up + 0.05])
    velocities = np.zeros_like(places)
    velocities[:, 2] = -20.0
    simulation, oracle = start(wanted, places, velocities), Oracle(wanted)
    for _ in range(20):
        simulation.advance()
        oracle.look(simulation)
    assert oracle.met > 50


@pytest.mark.parametrize("turns", [1.5, pytest.param(4.0, marks=pytest.mark.soak)])
def test_a_twist(turns):
    held = {"cloth.anchors": ["top"], "grippers": ["hand"], "gripper.radius": 0.11}
    wanted = scene(12, 6, (0.3, 0.15), **{**held, "gravity": [0.0, 0.0, 0.0]})
    simulation, oracle = Simulation(wanted), Oracle(wanted)
    x = simulation.positions
    place = [*x.mean(axis=0)[:2].tolist(), x[:, 2].min() - 0.07]
    simulation.advance([Target("hand", place, [0.0, 0.0, 0.0, 1.0])])
    for _ in range(4):
        simulation.advance()
    assert simulation.advance([Grasp("hand", True)]).grasps[0].held > 2
    frames = round(30 * turns)
    for k in range(1, frames + 1):
        half = math.pi * turns * k / frames
        place[2] += 0.0375 * turns / frames
        simulation.advance([Target("hand", place, [0.0, 0.0, math.sin(half), math.cos(half)])])
        oracle.look(simulation)
    assert oracle.met > 20
    assert not intersections(oracle.triangles, simulation.positions)
