# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Normals at the particles of a surface."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.physics.model.sheets.normals import vertex_normals

SQUARE = np.array([[0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def test_flat_square_has_the_normal_of_the_right_hand_rule() -> None:
    assert vertex_normals(SQUARE, TRIANGLES).T.tolist() == [[0.0, 0.0, 1.0]] * 4
    assert vertex_normals(SQUARE, TRIANGLES[:, ::-1]).T.tolist() == [[0.0, 0.0, -1.0]] * 4


def test_normal_is_weighted_by_area() -> None:
    # A unit square in z = 0, and a triangle of area 1 in x = 0 at its left edge.
    x = np.concatenate([SQUARE, [[0.0], [0.0], [2.0]]], axis=1)
    normals = vertex_normals(x, np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]]))
    assert normals[:, 0] == pytest.approx(np.array([1.0, 0.0, 0.5 + 0.5]) / np.sqrt(2.0))
    # Particle 3 is in half of the square and in the whole triangle.
    assert normals[:, 3] == pytest.approx(np.array([1.0, 0.0, 0.5]) / np.sqrt(1.25))
    assert np.linalg.norm(normals, axis=0) == pytest.approx(np.ones(5))


def test_sphere_has_radial_normals() -> None:
    u, w = np.meshgrid(np.linspace(0.3, 2.8, 60), np.linspace(0.0, 1.5, 60), indexing="ij")
    x = np.stack([np.sin(u) * np.cos(w), np.sin(u) * np.sin(w), np.cos(u)]).reshape(3, -1)
    index = np.arange(3600).reshape(60, 60)
    corners = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    a, b, c, d = (corner.ravel() for corner in corners)
    normals = vertex_normals(x, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    inner = index[1:-1, 1:-1].ravel()
    assert np.abs(normals - x)[:, inner].max() < 1e-3


def test_particle_without_a_triangle_has_no_normal() -> None:
    flat = np.concatenate([SQUARE, [[5.0], [5.0], [5.0]]], axis=1)
    assert vertex_normals(flat, TRIANGLES)[:, 4].tolist() == [0.0, 0.0, 0.0]
    point = np.zeros((3, 4))
    assert not vertex_normals(point, TRIANGLES).any()
    assert vertex_normals(SQUARE, np.zeros((0, 3), np.int64)).shape == (3, 4)
