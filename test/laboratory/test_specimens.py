# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Meshes of circular specimens and their shadows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
from cloth_sim_ros.laboratory.silhouette import silhouette
from cloth_sim_ros.laboratory.specimens import PATTERNS, annulus, disc_mesh, is_on_plate

RADIUS, PLATE, EDGE_LENGTH = 0.15, 0.09, 0.01


@pytest.mark.parametrize("pattern", PATTERNS)
def test_disc_has_regular_triangles_over_its_area(pattern: str) -> None:
    mesh = disc_mesh(RADIUS, PLATE, EDGE_LENGTH, pattern=pattern)
    a, b, c = (mesh.points[corner] for corner in mesh.triangles.T)
    areas = 0.5 * np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2]
    assert areas.min() > 0.0
    assert areas.sum() == pytest.approx(math.pi * RADIUS**2, rel=0.002)
    assert mesh.min_quality() > 0.6
    edges = np.linalg.norm(b - a, axis=1)
    assert 0.5 * EDGE_LENGTH < edges.min() < edges.max() < 1.6 * EDGE_LENGTH


@pytest.mark.parametrize("pattern", PATTERNS)
def test_ring_of_particles_follows_the_plate(pattern: str) -> None:
    mesh = disc_mesh(RADIUS, PLATE, EDGE_LENGTH, pattern=pattern)
    on_ring = np.isclose(np.hypot(*mesh.points.T), PLATE, rtol=1e-12)
    assert on_ring.sum() == round(2.0 * math.pi * PLATE / EDGE_LENGTH)


def test_annulus_keeps_the_overhang_and_one_row_inside() -> None:
    mesh = disc_mesh(RADIUS, PLATE, EDGE_LENGTH)
    part = annulus(mesh, PLATE)
    distance, inside = np.hypot(*part.points.T), is_on_plate(part.points, PLATE)
    assert (~inside).sum() == (np.hypot(*mesh.points.T) > PLATE * (1.0 + 1e-9)).sum()
    assert distance.min() > PLATE - 1.2 * EDGE_LENGTH
    assert distance[inside].min() < PLATE - 0.5 * EDGE_LENGTH


@pytest.mark.parametrize("pattern", PATTERNS)
def test_seed_turns_the_mesh(pattern: str) -> None:
    first, again, turned = (disc_mesh(RADIUS, PLATE, EDGE_LENGTH, pattern=pattern, seed=seed) for seed in (1, 1, 2))
    assert first.obj() == again.obj()
    assert first.obj() != turned.obj()


@pytest.mark.parametrize("edge_length", [0.0, 0.05, 1e-4])
def test_edge_length_that_does_not_fit_is_refused(edge_length: float) -> None:
    with pytest.raises(LaboratoryError, match="edges"):
        disc_mesh(RADIUS, PLATE, edge_length)


def test_shadow_of_a_flat_disc_is_its_area() -> None:
    mesh = disc_mesh(RADIUS, PLATE, EDGE_LENGTH)
    flat = np.c_[mesh.points, np.zeros(len(mesh.points))]
    shadow = silhouette(flat, mesh.triangles, PLATE)
    assert shadow.area == pytest.approx(math.pi * RADIUS**2, rel=0.002)
    assert shadow.nodes in (0, 1)


@pytest.mark.parametrize("nodes", [3, 8, 14])
def test_shadow_counts_waves_of_the_contour(nodes: int) -> None:
    mesh = disc_mesh(RADIUS, PLATE, EDGE_LENGTH)
    angle = np.arctan2(mesh.points[:, 1], mesh.points[:, 0])
    wavy = np.c_[mesh.points * (0.8 + 0.1 * np.cos(nodes * angle))[:, None], np.zeros(len(angle))]
    shadow = silhouette(wavy, mesh.triangles, PLATE)
    assert shadow.nodes == nodes
    # Mean square of the radius.
    assert shadow.area == pytest.approx(math.pi * RADIUS**2 * (0.64 + 0.005), rel=0.02)


def test_shadow_contains_the_plate() -> None:
    mesh = disc_mesh(RADIUS, PLATE, EDGE_LENGTH)
    shrunk = np.c_[0.3 * mesh.points, np.zeros(len(mesh.points))]
    shadow = silhouette(shrunk, mesh.triangles, PLATE)
    assert shadow.area == pytest.approx(math.pi * PLATE**2, rel=1e-4)
    assert shadow.nodes == 0
