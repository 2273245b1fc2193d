# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A sheet of triangles: mass, moduli on regular triangles."""

import numpy as np
import pytest
from scipy.spatial import Delaunay
from support.alone import alone

from cloth_sim_ros.physics.model.sheets.mesh import POISSON_RATIO, SHEAR_OVER_STRETCH, MeshSheet
from cloth_sim_ros.physics.model.sheets.surface import Surface, grid_triangles

Y = 1000.0


def regular(count=12):
    rest_positions = (
        np.array([[j + 0.5 * i, i * np.sqrt(3) / 2, 0.0] for i in range(count) for j in range(count)]) * 0.05
    )
    return MeshSheet(
        rest_positions=rest_positions, surface=Surface.from_triangles(grid_triangles(count, count, "right"))
    )


def irregular(shake, count=20, seed=0):
    """Return a grid with its inner particles moved by up to `shake` of a cell, triangulated again."""
    plane = np.stack(np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count)), axis=-1).reshape(-1, 2)
    inner = ((plane > 0) & (plane < 1)).all(axis=1)
    rng = np.random.default_rng(seed)
    plane[inner] += rng.uniform(-shake, shake, (inner.sum(), 2)) / (count - 1)
    rest_positions = np.concatenate([plane, np.zeros((len(plane), 1))], axis=1)
    return MeshSheet(rest_positions=rest_positions, surface=Surface.from_triangles(Delaunay(plane).simplices))


def moduli(sheet):
    plan = alone(sheet.springs(stretch_modulus=Y, k_d0=0.1, density=0.2), count=len(sheet.rest_positions))
    rest_positions, area, h, c = sheet.rest_positions.T, sheet.areas().sum(), 1e-4, np.zeros((3, 3))

    def energy(strain):
        xx, yy, xy = strain
        deformed = np.eye(3) + np.array([[xx, xy / 2, 0], [xy / 2, yy, 0], [0, 0, 0]])
        return plan.energies(0.0, np.ascontiguousarray(deformed @ rest_positions), None)[1] / area

    for i in range(3):
        for j in range(3):
            a, b = h * np.eye(3)[i], h * np.eye(3)[j]
            c[i, j] = (energy(a + b) - energy(a - b) - energy(b - a) + energy(-a - b)) / (4 * h * h)
    return c


def test_equilateral_triangles_are_isotropic_with_given_modulus():
    c = moduli(regular())
    compliance = np.linalg.inv(c)
    assert 1 / compliance[0, 0] == pytest.approx(Y, rel=1e-6)
    assert 1 / compliance[1, 1] == pytest.approx(Y, rel=1e-6)
    assert -compliance[0, 1] / compliance[0, 0] == pytest.approx(POISSON_RATIO, rel=1e-6)
    assert c[2, 2] == pytest.approx(SHEAR_OVER_STRETCH * Y, rel=1e-6)
    assert c[0, 2] == pytest.approx(0.0, abs=1e-6 * Y)


@pytest.mark.parametrize("sheet", [regular(), irregular(0.3)], ids=["regular", "irregular"])
def test_mass_is_density_times_area(sheet):
    assert sheet.masses(0.3).sum() == pytest.approx(0.3 * sheet.areas().sum(), rel=1e-12)
    assert (sheet.masses(0.3) > 0).all()


def test_border_edges_carry_half_and_viscosity_follows_stiffness():
    sheet = regular()
    springs = sheet.springs(stretch_modulus=Y, k_d0=0.0, density=0.2, viscosity=3.0)
    border = sheet.surface.edge_triangles.min(axis=1) < 0
    assert springs.rigidity[border] == pytest.approx(0.5 * np.sqrt(3) / 2 * Y)
    assert springs.rigidity[~border] == pytest.approx(np.sqrt(3) / 2 * Y)
    assert springs.damping == pytest.approx(springs.rigidity * 3.0 / Y)
