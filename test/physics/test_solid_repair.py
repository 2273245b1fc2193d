# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Solids with T-junctions, triangles without area and vertices that differ in their last digits."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import trimesh

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.contact.solid_repair import is_closed
from cloth_sim_ros.scene import mesh_file

#: A rotation about no coordinate axis: points in the middle of an edge are rounded.
TURN = trimesh.transformations.euler_matrix(0.3, 0.7, 1.1)


def solid(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a closed solid."""
    mesh = {
        "box": lambda: trimesh.creation.box((0.2, 0.3, 0.5)),
        "cylinder": lambda: trimesh.creation.cylinder(0.1, 0.3, sections=9),
        "ring": lambda: trimesh.creation.annulus(0.1, 0.2, 0.1, segments=12),
    }[kind]()
    mesh.merge_vertices()
    mesh.apply_transform(TURN)
    return np.array(mesh.vertices), np.array(mesh.faces)


def with_junctions(kind: str, edges: int, corners: int, *, filled: bool) -> tuple[np.ndarray, np.ndarray]:
    """The solid with vertices on some edges that one of an edge's two triangles alone knows.

    Args:
        kind: the solid.
        edges: how many edges.
        corners: vertices on each.
        filled: whether triangles without area fill the gap.
    """
    points, triangles = solid(kind)
    vertices, faces = points.tolist(), [tuple(t) for t in triangles.tolist()]
    used: set[tuple[int, int, int]] = set()
    done = 0
    for face in list(faces):
        a, c, d = face
        twin = next(t for t in faces if any((t[k], t[(k + 1) % 3]) == (c, a) for k in range(3)))
        if done == edges or face in used or twin in used:
            continue
        used |= {face, twin}
        done += 1
        shares = np.linspace(0.0, 1.0, corners + 2)[1:-1]
        chain = [a, *range(len(vertices), len(vertices) + corners), c]
        vertices += [((1.0 - s) * points[a] + s * points[c]).tolist() for s in shares]
        faces.remove(face)
        faces += [(first, second, d) for first, second in pairwise(chain)]
        if filled:
            faces += [(a, chain[k + 1], chain[k]) for k in range(1, len(chain) - 1)]
    assert done == edges
    return np.array(vertices), np.array(faces)


def stl(points: np.ndarray, triangles: np.ndarray) -> bytes:
    return bytes(trimesh.Trimesh(points, triangles, process=False).export(file_type="stl"))


def obj(points: np.ndarray, triangles: np.ndarray) -> bytes:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    return "\n".join(lines + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles.tolist()]).encode()


def obstacle(data: bytes, name: str) -> Obstacle:
    mesh = mesh_file.parse_solid(data, name=name)
    return Obstacle(name="o", shape="mesh", vertices=mesh.vertices, triangles=mesh.triangles)


@pytest.mark.parametrize("filled", [True, False])
@pytest.mark.parametrize("corners", [1, 2, 7])
@pytest.mark.parametrize("kind", ["box", "cylinder", "ring"])
def test_solid_with_junctions_equals_the_one_without(kind: str, corners: int, filled: bool) -> None:
    points, triangles = solid(kind)
    clean = Obstacle(name="o", shape="mesh", vertices=points, triangles=triangles)
    around = np.random.default_rng(1).uniform(-0.4, 0.4, (60, 3))
    broken = with_junctions(kind, 4, corners, filled=filled)
    assert not is_closed(*broken)
    for name, data in (("solid.stl", stl(*broken)), ("solid.obj", obj(*broken))):
        gaps, _ = obstacle(data, name).distance(around)
        assert gaps == pytest.approx(clean.distance(around)[0], abs=1e-6)


def test_notes_tell_what_was_joined() -> None:
    mesh = mesh_file.parse_solid(obj(*with_junctions("box", 3, 2, filled=True)), name="box.obj")
    assert mesh.notes == (
        "6 triangles without area joined to the neighbours",
        "3 edges split at vertices that lie on it",
    )


def test_flat_triangles_back_to_back_are_left_out() -> None:
    points, triangles = solid("box")
    a, c = triangles[0, :2]
    points = np.concatenate((points, [0.5 * (points[a] + points[c])]))
    flap = [[a, c, len(points) - 1], [c, a, len(points) - 1]]
    mesh = mesh_file.parse_solid(obj(points, np.concatenate((triangles, flap))), name="box.obj")
    assert len(mesh.triangles) == len(triangles)
    assert is_closed(mesh.vertices, mesh.triangles)


@pytest.mark.parametrize("distance", [1e-9, 3e-7])
def test_needles_are_closed_by_joining_their_short_side(distance: float) -> None:
    points, triangles = solid("box")
    # The first corner of one triangle is a vertex of its own, joined by needles to the next.
    a, b, c = triangles[0]
    points = np.concatenate((points, [points[a] + distance * (points[c] - points[a])]))
    new = len(points) - 1
    triangles = triangles.copy()
    triangles[0] = [new, b, c]
    needles = [[a, b, new], [a, new, c]]
    mesh = mesh_file.parse_solid(obj(points, np.concatenate((triangles, needles))), name="box.obj")
    assert len(mesh.vertices) == 8
    assert is_closed(mesh.vertices, mesh.triangles)


@pytest.mark.parametrize("shift", [0.0, 0.4, 1.0])
def test_stl_off_by_its_last_digit_is_a_solid(shift: float) -> None:
    points, triangles = solid("cylinder")
    corners = (points[triangles] + shift).astype(np.float32)
    up = np.random.default_rng(2).integers(-1, 2, corners.shape)
    corners = np.where(
        up > 0, np.nextafter(corners, np.float32(9)), np.where(up < 0, np.nextafter(corners, np.float32(-9)), corners)
    )
    data = stl(corners.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    mesh = mesh_file.parse_solid(data, name="cylinder.stl")
    assert len(mesh.vertices) == len(points)
    assert is_closed(mesh.vertices, mesh.triangles)
    assert "to another merged with it" in mesh.notes[0]


def test_closed_mesh_stays_as_it_is() -> None:
    # A facet of 1e-8 m is closer than the limit, and no fault of a solid that is closed.
    points, triangles = solid("box")
    middle = points[triangles[0]].mean(axis=0)
    for _ in range(4):
        a, b, c = triangles[0]
        p, q, r = range(len(points), len(points) + 3)
        points = np.concatenate((points, middle + 0.01 * (points[[a, b, c]] - middle)))
        ring = [[a, b, q], [a, q, p], [b, c, r], [b, r, q], [c, a, p], [c, p, r]]
        triangles = np.concatenate(([[p, q, r]], triangles[1:], ring))
    mesh = mesh_file.parse_solid(obj(points, triangles), name="box.obj")
    assert mesh.notes == ()
    assert len(mesh.vertices) == len(points)


def test_open_solid_tells_its_narrowest_gap() -> None:
    points, triangles = solid("box")
    corners = points[triangles].copy()
    corners[0] += 1e-4
    data = stl(corners.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    with pytest.raises(ValueError, match=r"the mesh is open: .*nearly meet, the closest 0.000\d+ m apart.*by distance"):
        obstacle(data, "box.stl")


def test_rounded_junctions_off_the_origin_are_closed() -> None:
    # Single precision leaves triangles that are thin beside others that are flat.
    random = np.random.default_rng(0)
    for _ in range(40):
        kind = str(random.choice(["box", "cylinder", "ring"]))
        edges, corners, filled = int(random.integers(1, 5)), int(random.integers(1, 12)), bool(random.integers(2))
        points, triangles = with_junctions(kind, edges, corners, filled=filled)
        shift, scale = random.uniform(-5.0, 5.0, 3), 10.0 ** random.uniform(-3.0, 3.0)
        mesh = mesh_file.parse_solid(stl((points + shift) * scale, triangles), name="solid.stl")
        assert is_closed(mesh.vertices, mesh.triangles), (kind, edges, corners, filled, shift, scale)
