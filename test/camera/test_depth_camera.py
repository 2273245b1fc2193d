# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth cameras: depths against analytic surfaces, labels, range and noise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import trimesh

from cloth_sim_ros.camera.depth_camera import DepthCamera, intrinsics, label_numbers
from cloth_sim_ros.engine.binding import EngineError
from cloth_sim_ros.engine.camera import DepthImage
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.plan.gripper_path import normalized, quaternion_product, rotation_matrix
from cloth_sim_ros.scene.camera_section import CameraParameters

#: A camera at the origin that looks along z, and a turned one elsewhere.
ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
TURNED = (0.4, -0.3, 0.2, *normalized([0.1, -0.2, 0.3, 0.9]).tolist())
NO_CLOTH = np.zeros((0, 3), np.int64)
NO_POINTS = np.zeros((3, 0))
#: Largest error of a depth [m].
LIMIT = 5e-4


def camera(triangles: np.ndarray = NO_CLOTH, name: str = "wrist", **values: Any) -> DepthCamera:
    """A small camera."""
    parameters = CameraParameters(**{"width": 48, "height": 36, "min_depth": 0.001, **values})
    return DepthCamera(name, parameters, triangles)


def rays_of(view: DepthCamera) -> np.ndarray:
    """Directions of the pixels at depth 1 in the camera's frame, shape (height, width, 3)."""
    fx, fy, cx, cy = view.intrinsics
    u, v = np.meshgrid(np.arange(view.parameters.width), np.arange(view.parameters.height))
    return np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1)


def solid_mesh() -> Obstacle:
    """A closed mesh that is not convex."""
    ring = trimesh.creation.torus(0.25, 0.1, major_sections=8, minor_sections=5)
    return Obstacle(name="mesh", shape="mesh", vertices=ring.vertices, triangles=ring.faces)


SOLIDS = {
    "plane": Obstacle(name="plane", shape="plane"),
    "box": Obstacle(name="box", shape="box", size=(0.4, 0.3, 0.5)),
    "sphere": Obstacle(name="sphere", shape="sphere", size=(0.3,)),
    "capsule": Obstacle(name="capsule", shape="capsule", size=(0.15, 0.4)),
    "cylinder": Obstacle(name="cylinder", shape="cylinder", size=(0.2, 0.5)),
    "mesh": solid_mesh(),
}


def march(body: Obstacle, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depths along rays by steps of the obstacle's own distance, and the smallest gap on the way, (m,) each."""
    depths, smallest = np.zeros(len(directions)), np.full(len(directions), np.inf)
    lengths = np.linalg.norm(directions, axis=1)
    going = np.arange(len(directions))
    for _ in range(150):
        gaps, _ = body.distance(origin + depths[going, None] * directions[going])
        smallest[going] = np.minimum(smallest[going], gaps)
        depths[going] += gaps / lengths[going]
        going = going[(np.abs(gaps) > 1e-9) & (depths[going] < 30.0)]
        if not len(going):
            break
    return depths, smallest


@pytest.mark.parametrize("shape", SOLIDS)
@pytest.mark.parametrize("pose", [ORIGIN, TURNED], ids=["origin", "turned"])
def test_depth_of_each_shape_is_exact(shape: str, pose: tuple[float, ...]) -> None:
    # The reference of a mesh is slow.
    body, view = SOLIDS[shape], camera(max_depth=20.0, **({"width": 24, "height": 18} if shape == "mesh" else {}))
    turned, at = rotation_matrix(np.array(pose[3:])), np.array(pose[:3])
    orientation = quaternion_product(pose[3:], normalized([0.9, 0.3, -0.2, 0.3]).tolist())
    body_pose = np.array([*(at + turned @ [0.05, 0.1, 1.3]), *orientation])
    depths, labels = view.render(pose, NO_POINTS, [(body, body_pose, 7)])
    body_turned = rotation_matrix(body_pose[3:])
    directions = rays_of(view).reshape(-1, 3) @ turned.T @ body_turned
    expected, smallest = march(body, (at - body_pose[:3]) @ body_turned, directions)
    seen, depths = (labels == 7).ravel(), depths.ravel()
    is_hit = (smallest < 1e-6) & (expected < 20.0)
    assert is_hit.sum() > 30
    # Rays that graze the surface may hit or miss it.
    assert not np.any(seen & (smallest > LIMIT))
    both = seen & is_hit
    assert both.sum() >= 0.99 * is_hit.sum()
    assert np.abs(depths[both] - expected[both]).max() < LIMIT
    assert np.all(np.isnan(depths[~seen]))


def sheet(slope: tuple[float, float], distance: float, n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Positions (3, n^2) and triangles of a plane sheet z = distance + slope . (x, y), larger than the view."""
    x, y = np.meshgrid(np.linspace(-2.0, 2.0, n), np.linspace(-2.0, 2.0, n))
    z = distance + slope[0] * x + slope[1] * y
    cells = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    return np.ascontiguousarray(np.stack([x.ravel(), y.ravel(), z.ravel()])), triangles


@pytest.mark.parametrize("flipped", [False, True])
def test_depth_of_slanted_cloth_is_exact_from_both_sides(flipped: bool) -> None:
    x, triangles = sheet((0.5, -0.3), 1.0)
    view = camera(triangles[:, ::-1] if flipped else triangles)
    depths, labels = view.render(ORIGIN, x, [])
    rays = rays_of(view)
    expected = 1.0 / (1.0 - 0.5 * rays[..., 0] + 0.3 * rays[..., 1])
    assert np.all(labels == 1), "a sheet has no holes between its triangles"
    assert np.abs(depths - expected).max() < 1e-6


def test_sheet_through_camera_plane_is_clipped() -> None:
    # A floor of two triangles below the camera reaches from behind it into the view; v points down.
    x, triangles = sheet((0.0, 0.0), 0.0, n=2)
    floor = np.ascontiguousarray(np.stack([x[0], np.full(x.shape[1], 0.5), x[1]]))
    view = camera(triangles)
    depths, labels = view.render(ORIGIN, floor, [])
    down = rays_of(view)[..., 1]
    with np.errstate(divide="ignore"):
        expected = 0.5 / down
    reached = (expected > 0.0) & (expected < 1.9)
    assert reached.sum() > 100
    assert np.abs(depths[reached] - expected[reached]).max() < 1e-6
    assert np.all(labels[down < 0.0] == 0)


def test_nearest_surface_hides_others() -> None:
    x, triangles = sheet((0.0, 0.0), 1.0)
    view = camera(triangles)
    ball, wall = SOLIDS["sphere"], SOLIDS["box"]
    before, behind = np.array([0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0])
    depths, labels = view.render(ORIGIN, x, [(ball, before, 2), (wall, behind, 3)])
    assert set(np.unique(labels)) == {1, 2}
    assert labels[18, 24] == 2 and depths[18, 24] == pytest.approx(0.5, abs=1e-3)
    assert labels[0, 0] == 1 and depths[0, 0] == pytest.approx(1.0, abs=1e-6)
    _, labels = camera().render(ORIGIN, NO_POINTS, [(wall, behind, 3), (ball, before, 2)])
    assert labels[18, 24] == 2


@pytest.mark.parametrize("shape", sorted(set(SOLIDS) - {"mesh"}))
def test_camera_inside_a_solid_sees_through_it(shape: str) -> None:
    x, triangles = sheet((0.0, 0.0), 1.0)
    inside = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0])
    _, labels = camera(triangles).render(ORIGIN, x, [(SOLIDS[shape], inside, 2)])
    assert np.all(labels == 1)


def test_mesh_of_a_box_looks_like_the_box() -> None:
    box = trimesh.creation.box((0.4, 0.3, 0.5))
    mesh = Obstacle(name="mesh", shape="mesh", vertices=box.vertices, triangles=box.faces)
    for distance in (0.05, 1.2):
        pose = np.array([0.05, 0.02, distance, *normalized([0.3, 0.1, -0.2, 0.9])])
        images = [camera().render(ORIGIN, NO_POINTS, [(body, pose, 2)]) for body in (mesh, SOLIDS["box"])]
        (depths, labels), (exact_depths, exact_labels) = [(depths, labels.copy()) for depths, labels in images]
        assert np.count_nonzero(labels != exact_labels) <= 0.02 * np.count_nonzero(labels)
        both = (labels == 2) & (exact_labels == 2)
        assert both.any() == (distance > 1.0), "the camera looks out of the box that contains it"
        assert np.abs(depths[both] - exact_depths[both]).max(initial=0.0) < 1e-6


def test_pixels_out_of_range_have_no_depth_and_hide_others() -> None:
    x, triangles = sheet((1.0, 0.0), 1.0)
    view = camera(triangles, min_depth=0.9, max_depth=1.2)
    rays = rays_of(view)
    behind = np.array([0.0, 0.0, 1.15, *normalized([1.0, 0.0, 0.0, 0.0])])
    depths, labels = view.render(ORIGIN, x, [(SOLIDS["plane"], behind, 2)])
    expected = 1.0 / (1.0 - rays[..., 0])
    assert np.all(np.isnan(depths[expected < 0.899])), "a near surface hides the plane behind it"
    assert np.array_equal(np.isnan(depths), labels == 0)
    assert np.nanmin(depths) >= 0.9 and np.nanmax(depths) <= 1.2


def test_points_lie_on_the_rays_of_pixels() -> None:
    x, triangles = sheet((0.5, -0.3), 1.0)
    view = camera(triangles)
    depths, _ = view.render(ORIGIN, x, [])
    points = view.points(depths)
    assert np.abs(points - depths[..., None] * rays_of(view)).max() < 1e-6
    assert np.abs(points[..., 2] - 1.0 - 0.5 * points[..., 0] + 0.3 * points[..., 1]).max() < 1e-6


def test_intrinsics_follow_the_field_of_view() -> None:
    fx, fy, cx, cy = intrinsics(CameraParameters(width=64, height=48, fov=1.0))
    assert (cx, cy) == (31.5, 23.5), "centres of pixels are whole numbers"
    # The outer edges of the outermost pixels span the field of view.
    assert 2.0 * math.atan(32.0 / fx) == pytest.approx(1.0)
    assert fx == fy
    calibrated = (500.0, 510.0, 30.0, 20.0)
    assert intrinsics(CameraParameters(width=64, height=48, intrinsics=calibrated)) == calibrated


def test_noise_grows_with_squared_depth_and_repeats() -> None:
    deviations = []
    for distance in (1.0, 2.0):
        x, triangles = sheet((0.0, 0.0), distance)
        x[:2] *= 2.0
        values = {"disparity_noise": 0.1, "baseline": 0.05, "fov": 1.0, "max_depth": 5.0}
        view = camera(triangles, **values)
        depths, _ = view.render(ORIGIN, x, [], frame=3)
        deviations.append(float(np.std(depths - distance)))
        expected = 0.1 * distance**2 / (view.intrinsics[0] * 0.05)
        assert deviations[-1] == pytest.approx(expected, rel=0.1)
        assert np.array_equal(view.render(ORIGIN, x, [], frame=3)[0], depths)
        assert not np.array_equal(view.render(ORIGIN, x, [], frame=4)[0], depths)
        assert not np.array_equal(camera(triangles, **values, seed=1).render(ORIGIN, x, [], frame=3)[0], depths)
        assert not np.array_equal(camera(triangles, "other", **values).render(ORIGIN, x, [], frame=3)[0], depths)


@pytest.mark.parametrize("noise", [{"disparity_noise": 20.0}, {"disparity_step": 100.0}], ids=["noise", "step"])
def test_noise_out_of_range_leaves_neither_depth_nor_label(noise: dict[str, float]) -> None:
    x, triangles = sheet((0.5, -0.3), 1.0)
    depths, labels = camera(triangles, min_depth=0.9, max_depth=1.2, **noise).render(ORIGIN, x, [])
    assert np.isnan(depths).any() and np.array_equal(np.isnan(depths), labels == 0)
    assert not np.any((depths < 0.9) | (depths > 1.2))


def test_disparity_step_gives_steps_of_depth() -> None:
    x, triangles = sheet((0.5, -0.3), 1.0)
    view = camera(triangles, disparity_step=0.25)
    depths, _ = view.render(ORIGIN, x, [])
    disparities = view.intrinsics[0] * view.parameters.baseline / depths
    assert np.abs(disparities / 0.25 - np.rint(disparities / 0.25)).max() < 1e-4
    exact, _ = camera(triangles).render(ORIGIN, x, [])
    step = 0.25 * exact**2 / (view.intrinsics[0] * view.parameters.baseline)
    assert np.abs(depths - exact).max() > LIMIT
    assert np.all(np.abs(depths - exact) < 0.6 * step)


def test_vertex_without_position_leaves_out_its_triangles() -> None:
    x, triangles = sheet((0.0, 0.0), 1.0)
    x[:, 65] = np.nan, np.inf, -np.inf
    depths, labels = camera(triangles).render(ORIGIN, x, [])
    assert 0 < np.isnan(depths).sum() < depths.size
    assert np.array_equal(np.isnan(depths), labels == 0)


def test_labels_stay_with_their_bodies() -> None:
    labels = label_numbers(["table", "ball"], {})
    assert labels == {"cloth": 1, "table": 2, "ball": 3}
    assert label_numbers(["ball", "cup"], labels) == {**labels, "cup": 4}
    assert label_numbers(["ball"], labels) is labels


def test_depth_image_refuses_bad_input() -> None:
    with pytest.raises(ValueError, match="0 x 5 pixels"):
        DepthImage(0, 5, (1.0, 1.0, 0.0, 0.0))
    image, placement = DepthImage(4, 4, (1.0, 1.0, 0.0, 0.0)), np.array([1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0], float)
    x = np.ones((3, 3))
    with pytest.raises(EngineError):
        image.draw_triangles(placement, x, np.array([[0, 1, 3]]), 1, solid=False)
    with pytest.raises(EngineError):
        image.draw_triangles(placement, x, np.array([[0, 1, -1]]), 1, solid=False)
    with pytest.raises(ValueError, match="triangles is int32"):
        image.draw_triangles(placement, x, np.zeros((1, 3), np.int32), 1, solid=False)
    with pytest.raises(ValueError, match="placement has shape"):
        image.draw_solid(placement[:9], "sphere", np.ones(3), 1.0, 1)
    assert not image.labels.any()


def test_triangles_around_a_corner_leave_no_hole() -> None:
    # The corner projects onto the centre of a pixel, or beside it by rounding.
    random = np.random.default_rng(0)
    angles = np.arange(5) * (2.0 * math.pi / 5.0)
    triangles = np.array([[0, 1 + k, 1 + (k + 1) % 5] for k in range(5)])
    for _ in range(300):
        width, height, focal_length = 31, 21, random.uniform(20.0, 100.0)
        u, v = random.integers(10, 20), random.integers(6, 14)
        view = camera(
            triangles, width=width, height=height, intrinsics=(focal_length, focal_length, 15.0, 10.0), max_depth=9.0
        )
        depth = random.uniform(0.5, 3.0)
        corner = np.array([(u - 15) * depth / focal_length, (v - 10) * depth / focal_length, depth])
        around = angles + random.uniform(0.0, 1.0, 5)
        ring = np.stack([np.cos(around), np.sin(around), random.uniform(-0.1, 0.1, 5)], axis=1)
        x = np.ascontiguousarray(np.vstack([corner, corner + 0.2 * ring]).T)
        depths, labels = view.render(ORIGIN, x, [])
        assert labels[v, u] == 1 and depths[v, u] == pytest.approx(depth, rel=1e-6)
