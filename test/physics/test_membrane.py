# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Membrane triangles of sheets: moduli, thread directions, energy, bounds and implicit matrix."""

import math
import warnings

import attrs
import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation
from support.alone import alone, blocks, force, full, matrix, of_blocks

from cloth_sim_ros.physics.integrators.stage_matrix import StageMatrix
from cloth_sim_ros.physics.model.forces.membrane_triangles import MembraneTriangles
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.membrane import FabricModuli, membrane, thread_coordinates
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

MODULI = FabricModuli(warp=400.0, weft=150.0, shear=30.0, poisson_ratio=0.3)
SHEET = GridSheet(height=0.4, width=0.5, rows=5, columns=6, layout="alternating")


def sheet_membrane(moduli=MODULI, warp=(0.3, 1.0, 0.0), **options):
    settings = {"k_d0": 0.1, "density": 0.2, **options}
    return membrane(SHEET.positions(), SHEET.triangles(), moduli, warp=warp, **settings)


def stiffness_tensor(moduli):
    """C by the inverse of the compliance of a pull along warp, along weft, and of a shear."""
    nu = moduli.poisson_ratio
    rows = [
        [1 / moduli.warp, -nu / moduli.warp, 0],
        [-nu / moduli.warp, 1 / moduli.weft, 0],
        [0, 0, 1 / moduli.shear],
    ]
    return np.linalg.inv(rows)


def test_moduli_are_the_inverse_of_the_compliance():
    c11, c12, c22, c33 = MODULI.stiffness()
    assert np.array([[c11, c12, 0], [c12, c22, 0], [0, 0, c33]]) == pytest.approx(stiffness_tensor(MODULI), rel=1e-12)


@pytest.mark.parametrize("angle", [0.0, 25.0, 90.0])
def test_energy_of_a_strain_is_that_of_the_turned_tensor(angle):
    """Small strain in the sheet's own axes, turned into those of the threads."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    plan = alone(sheet_membrane(warp=(c, s, 0.0)), masses=SHEET.masses(0.2))
    strain = np.array([[2e-5, 0.5e-5], [0.5e-5, -1e-5]])
    x = SHEET.positions().T.copy()
    x[:2] += strain @ x[:2]
    turn = np.array([[c, s], [-s, c]])
    warp, weft, shear = (lambda e: (e[0, 0], e[1, 1], 2.0 * e[0, 1]))(turn @ strain @ turn.T)
    vector = np.array([warp, weft, shear])
    expected = 0.5 * vector @ stiffness_tensor(MODULI) @ vector * SHEET.height * SHEET.width
    assert plan.energies(0.0, np.ascontiguousarray(x), None)[1] == pytest.approx(expected, rel=1e-3)


def test_affine_stretch_leaves_no_force_inside():
    plan = alone(sheet_membrane(), masses=SHEET.masses(0.2))
    x = np.ascontiguousarray(np.array([[1.2, 0.1, 0.0], [-0.1, 0.9, 0.0], [0.3, 0.2, 1.0]]) @ SHEET.positions().T)
    inside = np.zeros((SHEET.rows, SHEET.columns), dtype=bool)
    inside[1:-1, 1:-1] = True
    f = force(plan, x)
    assert np.abs(f[:, inside.ravel()]).max() < 1e-12 * np.abs(f).max()


def test_warp_is_projected_onto_each_triangle():
    turn = Rotation.from_rotvec([0.4, -0.2, 1.1]).as_matrix()
    positions = SHEET.positions() @ turn.T
    # A part across the plane changes nothing.
    warp = turn @ [0.6, 0.8, 0.0] + 0.5 * turn[:, 2]
    expected = thread_coordinates(SHEET.positions(), SHEET.triangles(), (0.6, 0.8, 0.0))
    assert thread_coordinates(positions, SHEET.triangles(), warp) == pytest.approx(expected, abs=1e-14)


def test_pole_of_a_closed_surface_takes_another_direction():
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    triangles = np.array([[0, 2, 1], [0, 1, 3]])
    corners = thread_coordinates(x, triangles, (0.0, 0.0, 1.0))
    assert corners[0, 1:] == pytest.approx(np.array([[0.0, -1.0], [1.0, 0.0]])), "z moved by one is x"
    assert corners[1, 2] == pytest.approx([1.0, 0.0])
    with pytest.raises(ValueError, match=r"perpendicular to material\.warp_direction"):
        thread_coordinates(x, triangles[:1], (0.0, 0.0, 1.0))


def test_damping_is_that_of_springs_of_the_same_modulus():
    """k_d0 sqrt(C ρ) l: a thread of modulus E on cells h has k_d = k_d0 sqrt(E ρ) h."""
    moduli = FabricModuli(warp=100.0, weft=100.0, shear=0.0)
    built = sheet_membrane(moduli, warp=(0.0, 1.0, 0.0), k_d0=0.3, density=0.5)
    assert built.viscosities == pytest.approx([0.3 * math.sqrt(50.0), 0.0, 0.3 * math.sqrt(50.0), 0.0])
    assert built.coefficients[:, 5] == pytest.approx(built.areas * 0.1), "cells of 0.1 m"
    by_viscosity = sheet_membrane(MODULI, viscosity=2.0)
    assert by_viscosity.viscosities == pytest.approx(np.array(MODULI.stiffness()) * (2.0 / 400.0))
    assert by_viscosity.coefficients[:, 5] == pytest.approx(by_viscosity.areas)


def test_bounds_of_a_flat_grid_are_tight():
    moduli = FabricModuli(warp=400.0, weft=150.0, shear=1e-6)
    plan = alone(sheet_membrane(moduli, warp=(0.0, 1.0, 0.0)), masses=SHEET.masses(0.2))
    x = np.ascontiguousarray(SHEET.positions().T)
    inverse, still = np.tile(1.0 / np.sqrt(SHEET.masses(0.2)), 3), np.zeros_like(x)
    for part, rate, even in zip("xv", plan.spectral_bounds(x), of_blocks(plan, x), strict=True):
        whole = inverse[:, None] * matrix(plan, x, still, part) * inverse
        true = np.linalg.eigvalsh(0.5 * (whole + whole.T))[-1]
        assert true <= rate * (1.0 + 1e-9) <= even * (1.0 + 1e-8)
        assert rate <= 1.5 * true


@pytest.mark.parametrize("crumpled", [0.0, 0.01])
def test_bounds_of_an_irregular_mesh_are_tight(crumpled):
    rng = np.random.default_rng(4)
    points = rng.uniform(size=(60, 2))
    triangles = Delaunay(points).simplices.astype(np.int64)
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    triangles = triangles[np.abs(np.linalg.det(sides)) > 1e-3]
    flat = np.concatenate((points, np.zeros((len(points), 1))), axis=1)
    built = membrane(flat, triangles, MODULI, warp=(1.0, 2.0, 0.0), k_d0=0.1, density=0.2)
    masses = np.bincount(triangles.ravel(), np.repeat(built.areas, 3), minlength=len(points)) * 0.2 / 3.0 + 1e-4
    plan = alone(built, masses=masses)
    x = np.ascontiguousarray(flat.T) + crumpled * rng.standard_normal((3, len(points)))
    inverse, still = np.tile(1.0 / np.sqrt(masses), 3), np.zeros_like(x)
    for part, rate in zip("xv", plan.spectral_bounds(x), strict=True):
        whole = inverse[:, None] * matrix(plan, x, still, part) * inverse
        true = np.linalg.eigvalsh(0.5 * (whole + whole.T))[-1]
        assert true <= rate * (1.0 + 1e-9)
        assert rate <= 1.5 * true


@pytest.mark.parametrize("crumpled", [0.0, 0.03])
def test_implicit_matrix_is_the_stiffness_without_compression(crumpled):
    model = Model(SHEET.masses(0.2), [sheet_membrane()])
    plan = alone(*model.forces, masses=model.masses)
    x = np.ascontiguousarray(1.2 * SHEET.positions().T)
    x += crumpled * np.random.default_rng(2).standard_normal(x.shape)
    pairs = StageMatrix(model)._pairs[0]  # private: the order of the blocks under test
    still = np.zeros_like(x)
    for part, stiffness, damping in (("x", 1.0, 0.0), ("v", 0.0, 1.0)):
        whole = np.zeros((3, x.shape[1], 3, x.shape[1]))
        for (i, j), block in zip(pairs, plan.pair_blocks(0, len(pairs), x, stiffness, damping), strict=True):
            b = block.reshape(3, 3)
            whole[:, i, :, i] += b
            whole[:, j, :, j] += b.T
            whole[:, i, :, j] -= b
            whole[:, j, :, i] -= b.T
        assembled = whole.reshape(3 * x.shape[1], -1)
        assert np.linalg.eigvalsh(assembled)[0] > -1e-9 * np.abs(assembled).max()
        if part == "v" or not crumpled:
            expected = matrix(plan, x, still, part)
            assert assembled == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


def test_implicit_matrix_of_a_long_strip_solves_exactly():
    """A strip that is long enough for a factorisation from both ends."""
    sheet = GridSheet(height=2.0, width=0.1, rows=25, columns=3, layout="alternating")
    built = membrane(sheet.positions(), sheet.triangles(), MODULI, warp=(0.3, 1.0, 0.0), k_d0=0.1, density=0.2)
    model = Model(sheet.masses(0.2), [built], anchors=[0, 1])
    x = np.ascontiguousarray(1.1 * sheet.positions().T)
    d, right = 0.02, np.random.default_rng(1).standard_normal(x.shape)
    solved, stage = right.copy(), StageMatrix(model)
    stage.update(0.0, x, d, {})
    stage.solve(solved)
    plan, still = alone(built, masses=model.masses), np.zeros_like(x)
    whole = np.diag(np.tile(model.masses, 3)) + d * d * matrix(plan, x, still, "x") + d * matrix(plan, x, still, "v")
    free = np.tile(model.inverse_masses > 0.0, 3)
    expected = np.zeros(right.size)
    expected[free] = np.linalg.solve(whole[np.ix_(free, free)], right.ravel()[free])
    assert solved.ravel() == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


def test_implicit_steps_agree_with_explicit_ones():
    values = {
        "cloth.resolution": [9, 8],
        "cloth.orientation": [0.61, 0.07, -0.13, 0.77],
        "membrane.model": "triangles",
        "material.stretch_modulus_weft": 400.0,
        "material.poisson_ratio": 0.3,
        "bending.model": "none",
        "tolerance": 1e-4,
    }
    ends = []
    for integrator in ("leapfrog", "implicit"):
        simulation = Simulation(Scene.from_parameters({**values, "integrator": integrator}))
        for _ in range(10):
            simulation.advance([])
        ends.append(simulation.positions)
    assert ends[1] == pytest.approx(ends[0], abs=1e-3)


@pytest.mark.parametrize("start", ["crumpled", "inverted", "collapsed"])
def test_energy_never_rises_without_a_source(start):
    values = {
        "cloth.resolution": [6, 6],
        "cloth.size": [0.3, 0.3],
        "cloth.anchors": [""],
        "gravity": [0.0, 0.0, 0.0],
        "membrane.model": "triangles",
        "material.stretch_modulus": 100.0,
        "material.stretch_modulus_weft": 30.0,
        "material.shear_modulus": 5.0,
        "material.poisson_ratio": 0.4,
        "material.warp_direction": [1.0, 2.0, 0.0],
        "bending.model": "none",
        "wind.normal_drag": 0.0,
        "air.drag": 0.0,
    }
    simulation = Simulation(Scene.from_parameters(values))
    rng = np.random.default_rng(5)
    x = simulation.state.x
    if start == "crumpled":
        x += 0.01 * rng.standard_normal(x.shape)
    elif start == "inverted":
        x[0] *= -0.9
        x[2] += 1e-3 * rng.standard_normal(x.shape[1])
    else:
        x[0] *= 0.05
        x[1] += 1e-3 * rng.standard_normal(x.shape[1])
    energies = [simulation.plan.energy(0.0, x, simulation.state.v)]
    for _ in range(30):
        simulation.advance([])
        state = simulation.state
        energies.append(simulation.plan.energy(0.0, state.x, state.v))
    assert np.isfinite(energies).all()
    assert np.diff(energies).max() < 1e-3 * energies[0]
    assert energies[-1] < energies[0]


def test_bounds_of_random_sheets_hold():
    rng = np.random.default_rng(8)
    plan = alone(sheet_membrane(), masses=SHEET.masses(0.2))
    for _ in range(5):
        x = np.ascontiguousarray(SHEET.positions().T + 0.08 * rng.standard_normal((3, SHEET.rows * SHEET.columns)))
        for part, bound in zip("xv", blocks(plan, x), strict=True):
            whole = matrix(plan, x, np.zeros_like(x), part)
            assert np.linalg.eigvalsh(full(bound) - 0.5 * (whole + whole.T))[0] > -1e-9 * np.abs(whole).max()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"triangles": [[0, 1, 1]]}, "needs three different particles"),
        ({"corners": [[[0, 0], [1, 0], [2, 0]]]}, "has no area at rest"),
        ({"moduli": [1.0, 2.0, 1.0, 1.0]}, "energy comes from nowhere"),
        ({"moduli": [-1.0, 0.0, 1.0, 1.0]}, "must be at least 0"),
        ({"viscosities": [1.0, 0.0, 1.0, np.nan]}, "is nan"),
        ({"corners": [[[0, 0], [1, 0]]]}, "has shape"),
    ],
)
def test_invalid_triangles_are_refused(changes, words):
    arguments = {"triangles": [[0, 1, 2]], "corners": [[[0, 0], [1, 0], [0, 1]]], "moduli": [1.0, 0.0, 1.0, 1.0]}
    arguments |= changes
    with pytest.raises(ValueError, match=words):
        MembraneTriangles(arguments.pop("triangles"), arguments.pop("corners"), **arguments)


def test_grid_of_another_size_is_refused():
    with pytest.raises(ValueError, match="sheet of 5 x 6 particles, and the model has 31"):
        alone(sheet_membrane(grid=(5, 6)), count=31)


def test_poisson_ratio_beyond_the_moduli_is_refused():
    with pytest.raises(ValueError, match=r"must be between -0\.49999975 and 0\.49999975"):
        FabricModuli(warp=100.0, weft=400.0, shear=1.0, poisson_ratio=0.5)


def test_negative_poisson_ratio_has_a_negative_coupled_viscosity():
    options = {"warp": [1.0, 0.0, 0.0], "k_d0": 0.2, "density": 0.3}
    positions, triangles = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]), np.array([[0, 1, 2]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        forces = [
            membrane(positions, triangles, attrs.evolve(MODULI, poisson_ratio=ratio), **options)
            for ratio in (-0.3, 0.3)
        ]
    assert forces[0].viscosities == pytest.approx(forces[1].viscosities * [1.0, -1.0, 1.0, 1.0])


def test_grid_of_both_diagonals_has_two_layers():
    energies, areas = [], []
    x = None
    for layout in ("both", "alternating"):
        scene = Scene.from_parameters({"membrane.model": "triangles", "cloth.shear_layout": layout})
        model = scene.model()
        if x is None:
            x = np.ascontiguousarray(np.diag([1.02, 0.97, 1.0]) @ scene.sheet.positions().T)
        energies.append(alone(model.force("membrane"), masses=model.masses).energies(0.0, x, None)[1])
        areas.append(model.force("membrane").areas.sum())
    assert energies[0] == pytest.approx(energies[1], rel=1e-9)
    assert areas == pytest.approx([1.0, 1.0])


def test_bending_springs_leave_stiffness_to_the_triangles():
    with pytest.raises(ValueError, match="no stiffness is left"):
        sheet_membrane(subtracted=(400.0, 400.0))
