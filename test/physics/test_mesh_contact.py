# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Closed meshes as obstacles: particles, their edges and points, and balls compared with spheres."""

import numpy as np
import pytest
import trimesh
from support import laws
from support.alone import alone, force, gradient, product
from support.contact_scenes import contact, drop, moving, still
from support.feature_scenes import CORNER, CORNER_UP, THICKNESS, coarse_scene, intersected_triangles

from cloth_sim_ros.physics.contact.obstacle_features import obstacle_features
from cloth_sim_ros.physics.contact.obstacles import Obstacle

FRAME = 1.0 / 60.0


def mesh(body, name="it", **options):
    return Obstacle(name=name, shape="mesh", vertices=body.vertices, triangles=np.array(body.faces), **options)


def angular():
    """A body with convex and concave edges and corners: two bricks in the form of an L."""
    outline = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.1], [0.1, 0.1], [0.1, 0.3], [0.0, 0.3]])
    count = len(outline)
    vertices = np.concatenate([np.column_stack([outline, np.full(count, z)]) for z in (-0.05, 0.05)])
    flat = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = [(a, c, b) for a, b, c in flat] + [(a + count, b + count, c + count) for a, b, c in flat]
    for k in range(count):
        after = (k + 1) % count
        faces += [(k, after, after + count), (k, after + count, k + count)]
    return Obstacle(name="angle", shape="mesh", vertices=vertices - [0.1, 0.1, 0.0], triangles=np.array(faces))


BODIES = {"angle": angular(), "ball": mesh(trimesh.creation.icosphere(2, 0.2))}
every_body = pytest.mark.parametrize("body", BODIES)


def about(body, seed=0, damping=10.0, outside=True):
    """Return a force with one moving mesh, its plan, and particles near its faces, edges and corners."""
    rng = np.random.default_rng(seed)
    obstacle, path = BODIES[body], moving(seed)
    contact_force = contact(obstacle, paths=[path], damping=damping)
    points = obstacle.vertices[obstacle.triangles[rng.integers(len(obstacle.triangles), size=60)]]
    weights = rng.dirichlet([0.4] * 3, 60)
    weights[:20] = np.eye(3)[rng.integers(3, size=20)]
    weights[20:40, 0], weights[20:40, 1] = 0.0, 1.0 - weights[20:40, 2]
    places = (weights[..., None] * points).sum(axis=1)
    directions = rng.normal(size=places.shape)
    places = places + 1e-3 * directions / np.linalg.norm(directions, axis=1)[:, None]
    gap = obstacle.distance(places)[0]
    keep = (gap > 2e-4) if outside else np.abs(gap) > 1e-6
    position, _, rotation, _ = laws.pose(path, 0.3)
    x = np.ascontiguousarray((position + places[keep] @ rotation.T).T)
    assert x.shape[1] > 20
    masses = rng.uniform(0.5, 2.0, x.shape[1])
    return contact_force, alone(contact_force, masses=masses), masses, x, rng.normal(size=x.shape)


@every_body
@pytest.mark.parametrize("seed", range(4))
def test_gaps_agree_with_the_winding_number_also_inside(body, seed):
    contact_force, _, _, x, _ = about(body, seed, outside=False)
    position, _, rotation, _ = laws.pose(contact_force.paths[0], 0.3)
    expected = BODIES[body].distance((x.T - position) @ rotation)[0]
    assert (expected < 0.0).any()
    single_plan = alone(contact_force, count=1)
    gaps = [single_plan.contact.obstacle_gaps(0.3, x[:, k : k + 1].copy(), memory={})[0, 1] for k in range(x.shape[1])]
    assert gaps == pytest.approx(expected, abs=1e-12)


@every_body
def test_forces_energies_and_powers_are_those_of_the_formulas(body):
    contact_force, plan, masses, x, v = about(body)
    expected, booked = laws.contact(0.3, x, v, contact_force, masses)
    scale = np.abs(expected.force).max()
    assert scale > 1e4
    assert force(plan, x, v, 0.3) == pytest.approx(expected.force, rel=1e-8, abs=1e-9 * scale)
    assert plan.energies(0.3, x, v, memory={})[1] == pytest.approx(expected.energy, rel=1e-9)
    assert plan.contact.wrench_rates(0.3, x, v, memory={}) == pytest.approx(
        booked, rel=1e-8, abs=1e-9 * np.abs(booked).max()
    )


@every_body
def test_forces_and_derivatives_fit_the_energy(body):
    _, plan, _, x, _ = about(body, damping=0.0)
    slopes = gradient(lambda places: plan.energies(0.3, places, None, memory={})[1], x, step=1e-9)
    assert force(plan, x, t=0.3) == pytest.approx(-slopes, abs=1e-4 * np.abs(slopes).max())
    dx = np.random.default_rng(1).normal(size=x.shape)
    ends = [force(plan, x + h * dx, t=0.3) for h in (1e-9, -1e-9)]
    zero = np.zeros_like(x)
    assert product(plan, x, zero, dx, zero, 0.3) == pytest.approx((ends[0] - ends[1]) / 2e-9, rel=1e-4, abs=1e2)


def test_features_of_a_mesh_are_the_edges_that_bulge():
    # Features of an L: six corners above and six below, all edges but the concave one, and no edge within a flat side.
    feature_set = obstacle_features(BODIES["angle"], THICKNESS)
    ends = feature_set.points[feature_set.edges]
    hollow = np.abs(ends[..., :2]).max(axis=(1, 2)) < 1e-12
    assert (len(feature_set.points), len(feature_set.edges)) == (12, 17)
    assert not hollow.any()
    ball = obstacle_features(BODIES["ball"], THICKNESS)
    assert (len(ball.points), len(ball.edges)) == (162, 480)


def falls(obstacle, path, frames=8, **options):
    """Drop a coarse sheet on an obstacle at 2 m/s; return the state, and whether anything passed through."""
    model, places, triangles = coarse_scene(obstacle, paths=[path], **options)
    plan, state, integrator = drop(model, places, (0.0, 0.0, -2.0), tolerance=1e-5)
    through = False
    for k in range(frames):
        integrator.advance(plan, state, k * FRAME, FRAME)
        through = through or bool(intersected_triangles(obstacle, path, (k + 1) * FRAME, triangles, state.positions))
    return plan, state, through


def test_a_box_of_triangles_behaves_as_the_box():
    cube = trimesh.creation.box((0.2, 0.2, 0.2))
    path = still((0.05, 0.03, -CORNER - 0.01), CORNER_UP)
    box = falls(Obstacle(name="it", shape="box", size=(0.2, 0.2, 0.2)), path)
    mesh_motion = falls(mesh(cube), path)
    assert not box[2]
    assert not mesh_motion[2]
    assert np.abs(box[1].x[2]).max() > 0.1
    assert mesh_motion[1].x == pytest.approx(box[1].x, abs=1e-5)


def test_ball_of_triangles_behaves_as_the_sphere():
    # A sheet that hangs on its corners comes to rest on it.
    path, ends = still((0.05, 0.03, -0.103)), []
    icosphere = trimesh.creation.icosphere(2, 0.1)
    inward = 0.1 - np.linalg.norm(icosphere.triangles_center, axis=1).min()
    for ball in (Obstacle(name="it", shape="sphere", size=(0.1,)), mesh(icosphere)):
        model, places, triangles = coarse_scene(ball, paths=[path], anchors=[0, 4, 20, 24], **{"air.drag": 10.0})
        plan, state, integrator = drop(model, places, tolerance=1e-4)
        for k in range(60):
            integrator.advance(plan, state, k * FRAME, FRAME)
        assert not intersected_triangles(ball, path, 1.0, triangles, state.positions)
        ends.append((state.x, plan.contact.wrench_rates(1.0, state.x, state.v, memory=state.memory)[0, 2]))
    assert inward < 2e-3
    assert np.abs(ends[1][0] - ends[0][0]).max() < 2.0 * inward
    assert ends[1][1] == pytest.approx(ends[0][1], rel=0.05)
    assert ends[0][1] < -0.05


def test_no_bit_depends_on_threads():
    ball = mesh(trimesh.creation.icosphere(2, 0.1))
    path = still((0.05, 0.03, -0.101))
    path[17:20], path[6] = [0.3, -0.4, 1.0], 0.5
    for faces in (False, True):
        model, places, _ = coarse_scene(ball, paths=[path], n=9, faces=faces)
        x, v = np.ascontiguousarray(places.T), np.zeros((3, len(places)))
        v[2] = -2.0
        plan, _, _ = drop(model, places)
        runs = [plan.runs(0.0, 0.01, (x, v), [500], record_obstacles=True, threads=k, memory={})[0][0] for k in (1, 3)]
        assert max(runs[0].encountered_energy, runs[0].self_contact[0]) > 0.0
        assert np.array_equal(runs[0].x, runs[1].x)
        assert np.array_equal(runs[0].obstacle_integrals, runs[1].obstacle_integrals)
