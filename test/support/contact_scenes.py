# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sheets and obstacles for tests of contact."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene

#: One of each shape; none is larger than 0.5 m.
SHAPES = {
    "plane": Obstacle(name="table", shape="plane"),
    "box": Obstacle(name="box", shape="box", size=(0.5, 0.3, 0.2)),
    "sphere": Obstacle(name="ball", shape="sphere", size=(0.2,)),
    "capsule": Obstacle(name="finger", shape="capsule", size=(0.1, 0.4)),
    "cylinder": Obstacle(name="drum", shape="cylinder", size=(0.2, 0.4)),
}
THICKNESS = 2e-3


def still(position=(0.0, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 1.0)):
    """Return the path of an obstacle at rest."""
    row = np.zeros(26)
    row[1:4], row[13:17] = position, orientation
    return row


def moving(seed):
    """Return a path with all coefficients."""
    rng = np.random.default_rng(seed)
    row = rng.normal(size=26)
    row[0] = 0.0
    row[13:17] /= np.linalg.norm(row[13:17])
    return row


def contact(*shapes, paths=None, thickness=THICKNESS, damping=10.0):
    """Return the contact force of obstacles, given by their shapes' names or as objects."""
    obstacles = [SHAPES[shape] if isinstance(shape, str) else shape for shape in shapes]
    force = Contact(obstacles, thickness=thickness, damping=damping)
    if paths is not None:
        force.set_paths(np.array(paths))
    return force


def points_near(obstacle, path, t, count, rng, thickness=THICKNESS, deepest=0.2, farthest=1.3):
    """Return points (3, n) at random positions near an obstacle, from deep in contact to outside."""
    from support.laws import pose

    points = rng.normal(size=(4 * count, 3)) * 0.3
    if obstacle.shape == "box":
        # Faces, edges and corners.
        points = (
            0.5
            * np.array(obstacle.size)
            * rng.choice([-1.0, 1.0, 0.3], (4 * count, 3))
            * rng.uniform(0.9, 1.1, (4 * count, 3))
        )
    for _ in range(60):
        gap, normal = obstacle.distance(points)
        gaps = thickness * np.linspace(deepest, farthest, len(points))
        points = points + (gaps - gap)[:, None] * normal
    gap, _ = obstacle.distance(points)
    good = points[np.abs(gap - thickness * np.linspace(deepest, farthest, len(points))) < 1e-9]
    position, _, rotation, _ = pose(path, t)
    chosen = good[rng.permutation(len(good))[:count]]
    assert len(chosen) == count
    return np.ascontiguousarray((position + chosen @ rotation.T).T)


def flat_sheet(rows, columns, *forces, size=1.0, gravity=True, drag=True, listed=False, anchors=(), **material):
    """Return the model of a free flat grid, without air, and its positions (n, 3) around the origin, z = 0."""
    values = {"cloth.resolution": [rows, columns], "cloth.size": [size * (rows - 1) / (columns - 1), size], **material}
    scene_model = Scene.from_parameters({"cloth.anchors": [""], "wind.normal_drag": 0.0, **values}).plan().model
    other_forces = [
        force.pair_springs if listed and isinstance(force, GridSprings) else force
        for force in scene_model.forces
        if (gravity or not isinstance(force, Gravity)) and (drag or not isinstance(force, Drag))
    ]
    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2)
    flat = (grid - 0.5 * np.array([rows - 1, columns - 1])) * size / (columns - 1)
    places = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)
    return Model(scene_model.masses, [*other_forces, *forces], anchors=anchors), places


def drop(model, places, velocity=(0.0, 0.0, 0.0), **options):
    """Return the plan, the state and the integrator of a sheet that starts at positions (n, 3) with one velocity."""
    plan = compile(model)
    speeds = np.broadcast_to(np.asarray(velocity, dtype=float), places.shape).copy()
    speeds[model.inverse_masses == 0.0] = 0.0
    return plan, State(places, speeds), make_integrator(options.pop("integrator", "auto"), **options)
