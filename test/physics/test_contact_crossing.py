# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Continuous collision detection against moving, turning obstacles, compared with dense sampling."""

import numpy as np
import pytest
import trimesh
from support.contact_scenes import SHAPES, THICKNESS, contact, moving, points_near, still
from support.laws import pose

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.gripper_path import rigid_velocities
from cloth_sim_ros.physics.plan.plan import compile

START, DURATION = 0.02, 0.05
#: Shallower penetration may be missed: a thousandth of the thickness [m].
SHALLOW = 1e-3 * THICKNESS


def min_gap(obstacle, path, start, end):
    """Return the least gap [m] of a particle that moves straight from one position to another."""
    points = []
    for part in np.linspace(0.0, 1.0, 201):
        position, _, rotation, _ = pose(path, START + part * DURATION)
        points.append(rotation.T @ (start + part * (end - start) - position))
    return obstacle.distance(points)[0].min()


@pytest.mark.parametrize("shape", SHAPES)
def test_particle_hits_an_obstacle_on_its_path(shape):
    rng = np.random.default_rng(len(shape))
    met = 0
    for seed in range(16):
        path = moving(seed)
        plan = compile(Model([1.0], [contact(shape, paths=[path])]))
        start = points_near(SHAPES[shape], path, START, 1, rng, deepest=0.05, farthest=2.0)
        # It moves with the obstacle or stands, with a gap below or above the given one.
        along = start + (seed % 2) * DURATION * rigid_velocities(path, START, DURATION, start)
        end = along + rng.normal(size=(3, 1)) * THICKNESS * 10.0 ** rng.uniform(-1.5, 1.0)
        gap = min_gap(SHAPES[shape], path, start[:, 0], end[:, 0])
        if abs(gap) < SHALLOW:
            continue
        assert plan.contact.ccd_hits(START, DURATION, start, end, memory={}) == (gap < 0.0), (seed, gap)
        met += gap < 0.0
    assert 0 < met < 16


def block():
    """Return a mesh of the shape "box"."""
    body = trimesh.creation.box(SHAPES["box"].size)
    return Obstacle(name="block", shape="mesh", vertices=body.vertices, triangles=np.array(body.faces))


@pytest.mark.parametrize("name", [*SHAPES, "mesh"])
def test_particles_together_hit_as_each_alone(name):
    rng, count, shape = np.random.default_rng(len(name)), 24, SHAPES.get(name) or block()
    met = 0
    for seed in range(16):
        path = moving(seed)
        together = compile(Model(np.ones(count), [contact(shape, paths=[path])]))
        alone = compile(Model([1.0], [contact(shape, paths=[path])]))
        start = points_near(SHAPES.get(name, SHAPES["box"]), path, START, count, rng, deepest=1.5, farthest=20.0)
        sizes = THICKNESS * 10.0 ** rng.uniform(-1.5, 0.8 + 0.01 * seed, size=count)
        along = start + DURATION * rigid_velocities(path, START, DURATION, start)
        end = along + rng.normal(size=(3, count)) * sizes
        hits = [
            alone.contact.ccd_hits(START, DURATION, start[:, [i]].copy(), end[:, [i]].copy(), memory={})
            for i in range(count)
        ]
        assert together.contact.ccd_hits(START, DURATION, start, end, memory={}) == any(hits), seed
        # A path that is no number counts as a hit.
        end[1, seed] = np.nan
        assert together.contact.ccd_hits(START, DURATION, start, end, memory={})
        met += any(hits)
    assert 0 < met < 16


def ball(*, velocity=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, 0.0)):
    """Return the path of a ball of 0.2 m around the origin at the start of the step, without rotation."""
    path = still()
    path[0], path[4:7], path[7:10] = START, velocity, 0.5 * np.array(acceleration)
    return path


def meets(path, start, end, obstacle="sphere"):
    plan = compile(Model([1.0], [contact(obstacle, paths=[path])]))
    return plan.contact.ccd_hits(
        START, DURATION, *(np.array([position]).T.copy() for position in (start, end)), memory={}
    )


def test_particle_moving_with_a_fast_obstacle_does_not_hit_it():
    away = np.array([10.0, -3.0, 5.0])
    start = np.array([0.0, 0.0, 0.2 + 1e-2 * THICKNESS])
    assert not meets(ball(velocity=away), start, start + DURATION * away)
    assert meets(ball(velocity=away), start, start + DURATION * away - [0.0, 0.0, THICKNESS])
    assert meets(ball(velocity=[0.0, 0.0, 1.0]), start, start)


def test_obstacle_that_reverses_on_its_path_is_hit():
    start = np.array([0.0, 0.0, 0.21])
    # It approaches by v^2 / 2 a, halfway, and returns in the end.
    for nearest, met in ((0.012, True), (0.008, False)):
        rise = 4.0 * nearest / DURATION
        turning = ball(velocity=[0.0, 0.0, rise], acceleration=[0.0, 0.0, -2.0 * rise / DURATION])
        assert meets(turning, start, start) == met


def test_edge_that_sweeps_over_a_particle_hits_it():
    # A box of 0.5 m x 0.3 m x 0.2 m that turns about z: its corner, 0.292 m off, passes through the x axis.
    path = still()
    path[0], path[19] = START, -1.0 / DURATION
    for position, is_hit in ((0.27, True), (0.3, False)):
        assert meets(path, [position, 0.0, 0.0], [position, 0.0, 0.0], "box") == is_hit
