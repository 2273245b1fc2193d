# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quadratic hinges: energy, forces, modulus, damping, bounds and what a scene refuses."""

import math

import numpy as np
import pytest
from support.alone import alone, matrix
from support.alone import force as force_of

from cloth_sim_ros.physics.model.forces.quadratic import QuadraticHinges
from cloth_sim_ros.physics.model.sheets.bending import (
    bending_terms,
    grid_hinge_constants,
    grid_hinge_weights,
    hinge_weights,
)
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape
from cloth_sim_ros.physics.model.sheets.surface import grid_hinges
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation
from validation.bending.recovery import REST_TRIANGLES, rest_shape

PAIR = np.array([[0, 1, 2, 3]])
SHEET = {"bending.model": "quadratic", "material.bending_modulus": 1e-4, "cloth.resolution": [8, 9]}


def pair(name="scalene", damping_time=0.0):
    weights = hinge_weights(HingeShape.of(PAIR, rest_shape(name, 0.0)))
    return QuadraticHinges(PAIR, weights, 2e-3, damping_time)


def plan_of(force, count=4):
    return alone(force, count=count)


def rows(x):
    return np.ascontiguousarray(np.asarray(x, dtype=float).T)


@pytest.mark.parametrize("name", REST_TRIANGLES)
@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 0.02, 1.0, 2.5])
def test_energy_of_rigid_triangles_is_one_minus_cosine(name, angle):
    _, energy = plan_of(pair(name)).energies(0.0, rows(rest_shape(name, angle)), None)
    assert energy == pytest.approx(2e-3 * (1.0 - math.cos(angle)), rel=1e-9, abs=1e-17)


def test_weights_are_those_of_bergou():
    p = rest_shape("scalene", 0.0)

    def cotangent(at, i, j):
        a, b = p[i] - p[at], p[j] - p[at]
        return a @ b / np.linalg.norm(np.cross(a, b))

    # Bergou et al.: angles between the edge and the sides to wing 0 and wing 1, at both ends.
    c01, c02, c03, c04 = cotangent(0, 1, 2), cotangent(0, 1, 3), cotangent(1, 0, 2), cotangent(1, 0, 3)
    expected = np.array([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04])
    weights = hinge_weights(HingeShape.of(PAIR, p))[0] * np.linalg.norm(p[1] - p[0])
    assert -weights == pytest.approx(expected, rel=1e-12)


def test_forces_are_the_gradient_without_resultant_and_torque():
    random = np.random.default_rng(1)
    plan, x = plan_of(pair()), random.standard_normal((3, 4))
    f = force_of(plan, x)
    assert f.sum(axis=1) == pytest.approx(np.zeros(3), abs=1e-15)
    assert np.cross(x.T, f.T).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-15)
    dx = 1e-6 * random.standard_normal((3, 4))
    up, down = (plan.energies(0.0, np.ascontiguousarray(x + sign * dx), None)[1] for sign in (1, -1))
    assert up - down == pytest.approx(-2.0 * np.sum(f * dx), rel=1e-7)


def test_flat_pair_is_the_only_rest():
    # The energy is convex: its matrix has no negative eigenvalue at any shape.
    plan, x = plan_of(pair()), np.random.default_rng(2).standard_normal((3, 4))
    eigenvalues = np.linalg.eigvalsh(matrix(plan, x, np.zeros_like(x), "x"))
    assert eigenvalues[0] >= -1e-12 * eigenvalues[-1]


@pytest.mark.parametrize("direction", ["x", "y"])
def test_cylinder_has_the_energy_of_its_modulus(direction):
    columns, n_rows, spacing, moduli, radius = 60, 50, (0.01, 0.008), (3e-5, 1e-5), 0.4
    hinges = grid_hinges(n_rows, columns)
    constants = grid_hinge_constants(hinges, columns=columns, spacing=spacing, bending_modulus=moduli)
    weights = grid_hinge_weights(hinges, columns=columns, spacing=spacing)
    row, column = np.divmod(np.arange(n_rows * columns), columns)
    a, b = column * spacing[0], row * spacing[1]
    if direction == "y":
        a, b = b, a
    x = np.stack([radius * np.sin(a / radius), b, radius * (1.0 - np.cos(a / radius))])
    energy = plan_of(QuadraticHinges(hinges, weights, constants), len(a)).energies(0.0, x, None)[1]
    # Hinges lie inside: half of the border columns have none, and border rows count half.
    modulus = moduli[0 if direction == "x" else 1]
    size = ((columns - 2) * (n_rows - 1), (columns - 1) * (n_rows - 2))[direction == "y"]
    assert energy == pytest.approx(0.5 * modulus / radius**2 * size * spacing[0] * spacing[1], rel=1e-3)


def test_grid_weights_are_exact_weights_of_the_shape():
    hinges, spacing = grid_hinges(5, 6), (0.03, 0.05)
    row, column = np.divmod(np.arange(30), 6)
    x = np.stack([spacing[0] * column, spacing[1] * row, 0.0 * row], axis=1)
    exact = grid_hinge_weights(hinges, columns=6, spacing=spacing)
    assert exact == pytest.approx(hinge_weights(HingeShape.of(hinges, x)), abs=1e-11)
    assert (exact.sum(axis=1) == 0.0).all()


def test_damping_is_the_matrix_times_the_time():
    random = np.random.default_rng(3)
    x, v = random.standard_normal((2, 3, 4))
    elastic, damped = plan_of(pair()), plan_of(pair(damping_time=0.03))
    moved = np.ascontiguousarray(x + 0.03 * v)
    assert force_of(damped, x, v) == pytest.approx(force_of(elastic, moved), rel=1e-12)


def test_damping_time_is_that_of_the_stiffest_hinge():
    hinges = grid_hinges(4, 4)
    row, column = np.divmod(np.arange(16), 4)
    x = 0.1 * np.stack([column, row, 0 * row], axis=1).astype(float)
    constants = grid_hinge_constants(hinges, columns=4, spacing=(0.1, 0.1), bending_modulus=1e-3)
    options = {"hinge_constants": constants, "damping": 0.5, "masses": np.full(16, 0.01)}
    (springs,) = bending_terms("quadratic", hinges, x, **options)
    # Diagonals: |w|^2 = 8 / h^2 and k = D / 2.
    assert springs.damping_time == pytest.approx(0.5 * math.sqrt(2.0 * 0.01 / (0.5e-3 * 8.0 / 0.01)))
    (stiff,) = bending_terms("quadratic", hinges, x, **{**options, "hinge_constants": 0.0 * constants})
    assert stiff.damping_time == 0.0


@pytest.mark.parametrize("crumpled", [0.0, 0.02])
@pytest.mark.parametrize("as_mesh", [False, True])
def test_bounds_hold_and_are_tight(crumpled, as_mesh):
    scene = Scene.from_parameters({**SHEET, "material.stretch_modulus": 1e-3, "material.shear_modulus": 1e-4})
    force = scene.model().force("quadratic")
    if as_mesh:
        force = QuadraticHinges(force.hinges, force.weights, force.stiffness, force.damping_time)
    plan = alone(force, count=72)
    x = rows(scene.initial_positions()) + crumpled * np.random.default_rng(1).standard_normal((3, 72))
    for part, rate in zip("xv", plan.spectral_bounds(x), strict=True):
        true = np.linalg.eigvalsh(matrix(plan, x, np.zeros_like(x), part))[-1]
        assert true <= rate * (1.0 + 1e-9)
        assert rate <= 1.3 * true


@pytest.mark.parametrize("precision", ["explicit", "implicit"])
def test_sheet_swings_in_both_kinds_of_integrators(precision):
    values = {**SHEET, "integrator": "implicit" if precision == "implicit" else "auto", "diagnostics.energy": True}
    simulation = Simulation(Scene.from_parameters(values))
    for _ in range(5):
        done = simulation.advance()
    assert done.advance.flagged == 0
    assert np.isfinite(simulation.positions).all()


def test_wrong_hinges_are_refused():
    weights = [[-1.0, -1.0, 1.0, 1.0]]
    for arguments, text in (
        (([[0, 1, 2, 2]], weights, 1.0), r"hinge 0 of 'quadratic' is \[0, 1, 2, 2\]"),
        ((PAIR, [[1.0, 1.0, 1.0, 1.0]], 1.0), "weights of hinge 0 of 'quadratic'"),
        ((PAIR, weights, -1.0), "stiffness of 'quadratic'"),
        ((PAIR, weights, 1.0, math.inf), "damping_time of 'quadratic' is inf s"),
    ):
        with pytest.raises(ValueError, match=text):
            QuadraticHinges(*arguments)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"bending.rest_angle": 0.5}, r"bending.model is 'quadratic': hinge 0 .* rests at a fold of sine 0.479"),
        ({"material.bending_modulus": 0.0}, "bending model 'quadratic' needs material.bending_modulus above 0"),
    ],
)
def test_scene_refuses_what_quadratic_hinges_lack(values, text):
    with pytest.raises(ParameterError, match=text):
        Scene.from_parameters({**SHEET, **values})


def test_curved_mesh_needs_flat_rest():
    angles = np.linspace(0.0, 1.0, 4)
    lines = [f"v {math.cos(a)} {y} {math.sin(a)}" for a in angles for y in (0.0, 0.4)]
    lines += [f"f {2 * i + 1} {2 * i + 2} {2 * i + 3}\nf {2 * i + 2} {2 * i + 4} {2 * i + 3}" for i in range(3)]
    files = {"arc.obj": "\n".join(lines).encode()}
    values = {**SHEET, "cloth.mesh": "arc.obj", "cloth.anchors": [""]}
    del values["cloth.resolution"]
    with pytest.raises(ParameterError, match=r"set bending\.flat to true"):
        Scene.from_parameters(values, files=files)
    force = Scene.from_parameters({**values, "bending.flat": True}, files=files).model().force("quadratic")
    assert len(force.hinges) == 5


def test_warp_and_weft_bend_by_their_own_moduli():
    values = {**SHEET, "cloth.resolution": [5, 5], "material.bending_modulus_weft": 2e-5}
    stiffness = Scene.from_parameters(values).model().force("quadratic").stiffness
    assert sorted(set(np.round(stiffness / 1e-4, 6))) == pytest.approx([0.1, 0.2**0.5 / 2.0, 0.5])
