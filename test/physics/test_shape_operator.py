# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Shape operators of triangles: curvatures, plates, damping, bounds, and what a scene refuses."""

import itertools
import math

import numpy as np
import pytest
from scipy.spatial import Delaunay
from support.alone import alone, matrix
from support.alone import force as force_of

from cloth_sim_ros.physics.model.forces.couplings import Couplings
from cloth_sim_ros.physics.model.sheets.shape_operator import ShapeOperator
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

SHEET = {"bending.model": "shape_operator", "material.bending_modulus": 1e-4, "cloth.resolution": [8, 9]}


def doubled_areas(a, b, c):
    first, second = b - a, c - a
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def square_mesh(size, jitter, seed=1):
    """A unit square of nearly regular triangles; inner corners are moved by up to half of `jitter` edges."""
    rows = [np.linspace(0.0, 1.0, size + 1), np.r_[0.0, (np.arange(size) + 0.5) / size, 1.0]]
    points = np.array([(x, j / size) for j in range(size + 1) for x in rows[j % 2]])
    inner = ((points > 1e-9) & (points < 1.0 - 1e-9)).all(axis=1)
    points[inner] += jitter / size * np.random.default_rng(seed).uniform(-0.5, 0.5, (inner.sum(), 2))
    faces = Delaunay(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    doubled = doubled_areas(a, b, c)
    faces, doubled = faces[np.abs(doubled) > 1e-9], doubled[np.abs(doubled) > 1e-9]
    faces[doubled < 0.0] = faces[doubled < 0.0][:, [0, 2, 1]]
    return points, faces


def operator_of(points, faces, warp=(1.0, 0.0, 0.0)):
    return ShapeOperator.of(faces, np.column_stack([points, np.zeros(len(points))]), warp=warp)


def curvatures(operator, heights):
    """Return the curvatures of triangles for heights of the particles, shape (m, 3)."""
    return np.where(operator.particles[:, None] >= 0, operator.weights * heights[operator.particles][:, None], 0).sum(2)


def energy_matrix(operator, moduli, count):
    couplings = operator.couplings(moduli, damping=0.0, masses=np.ones(count))
    full = np.zeros((count, count))
    np.add.at(full, tuple(couplings.pairs.T), -couplings.constants)
    full += full.T
    return full - np.diag(full.sum(axis=1))


@pytest.mark.parametrize("jitter", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("curvature", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.3, -0.7, 0.9)])
def test_curvature_of_a_quadratic_surface_is_exact(jitter, curvature):
    points, faces = square_mesh(12, jitter)
    angle = 0.4
    warp = np.array([math.cos(angle), math.sin(angle), 0.0])
    u, v = points @ warp[:2], points @ [-warp[1], warp[0]]
    heights = 0.5 * (curvature[0] * u * u + curvature[1] * v * v + curvature[2] * u * v) + 0.3 * u - v + 2.0
    operator = operator_of(points, faces, warp)
    inner = ((points[faces] > 0.25) & (points[faces] < 0.75)).all(axis=(1, 2))
    assert inner.sum() > 30
    assert curvatures(operator, heights)[inner] == pytest.approx(np.tile(curvature, (inner.sum(), 1)), abs=1e-9)


@pytest.mark.parametrize(("jitter", "error"), [(0.0, 0.01), (0.5, 0.01), (0.9, 0.015)])
def test_supported_plate_sags_as_navier_says(jitter, error):
    """A square plate of modulus 1 on four edges sags by 0.00406235 under a uniform load of 1 (Timoshenko, table 8)."""
    points, faces = square_mesh(14, jitter)
    stiffness = energy_matrix(operator_of(points, faces), (1.0, 1.0, 0.5), len(points))
    a, b, c = (points[faces[:, k]] for k in range(3))
    load = np.bincount(faces.ravel(), np.repeat(doubled_areas(a, b, c) / 6.0, 3))
    free = ((points > 1e-9) & (points < 1.0 - 1e-9)).all(axis=1)
    sag = np.linalg.solve(stiffness[np.ix_(free, free)], load[free]).max()
    assert sag == pytest.approx(0.00406235, rel=error)


@pytest.mark.parametrize("ratio", [1.0, 20.0])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0])
def test_cylinder_has_the_energy_of_its_direction(ratio, degrees):
    """A cylinder across the angle a to the warp costs ½ (D11 cos⁴ a + D22 sin⁴ a + 4 D66 cos² a sin² a) per area."""
    points, faces = square_mesh(12, 0.5)
    operator = operator_of(points, faces)
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    along = points @ [c, s]
    moduli = (ratio, 1.0, 0.5 * math.sqrt(ratio))
    inner = ((points[faces] > 0.2) & (points[faces] < 0.8)).all(axis=(1, 2))
    k = curvatures(operator, 0.5 * along * along)[inner]
    energy = 0.5 * (k * k) @ moduli
    expected = 0.5 * (moduli[0] * c**4 + moduli[1] * s**4 + 4.0 * moduli[2] * (c * s) ** 2)
    assert energy == pytest.approx(np.full(len(k), expected), rel=1e-9)


@pytest.mark.parametrize("size", [1, 2, 3, 8])
@pytest.mark.parametrize("jitter", [0.0, 0.9])
def test_flat_sheet_is_the_only_rest(size, jitter):
    points, faces = square_mesh(size, jitter)
    eigenvalues = np.linalg.eigvalsh(energy_matrix(operator_of(points, faces), (2.0, 1.0, 0.7), len(points)))
    assert (eigenvalues > -1e-10 * eigenvalues[-1]).all()
    # Heights that are linear in the plane cost nothing. All others do.
    assert (eigenvalues < 1e-9 * eigenvalues[-1]).sum() == 3


def test_neighbours_on_a_conic_leave_weights_finite():
    # The corners of a regular hexagon lie on a circle, and determine no quadratic function.
    angles = np.pi / 3.0 * np.arange(6)
    points = np.column_stack([np.cos(angles), np.sin(angles)])
    operator = operator_of(points, np.array([[0, 2, 4], [0, 1, 2], [2, 3, 4], [4, 5, 0]]))
    assert np.abs(operator.weights).max() < 20.0
    k = curvatures(operator, 0.5 * points[:, 0] ** 2)
    assert (k[:, 0] > 0.0).all()


def test_single_triangle_does_not_bend():
    operator = operator_of(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.array([[0, 1, 2]]))
    assert np.abs(operator.weights).max() < 1e-12
    assert not len(operator.couplings((1.0, 1.0, 0.5), damping=0.1, masses=np.ones(3)).pairs)


def couplings_of(damping=0.0, moduli=(2e-4, 1e-4, 5e-5)):
    points, faces = square_mesh(5, 0.6)
    masses = np.full(len(points), 0.01)
    return operator_of(points, faces).couplings(moduli, damping=damping, masses=masses), len(points)


def test_forces_are_the_gradient_without_resultant_and_torque():
    random = np.random.default_rng(1)
    couplings, count = couplings_of()
    plan, x = alone(couplings, count=count), random.standard_normal((3, count))
    f = force_of(plan, x)
    scale = np.abs(f).max()
    assert f.sum(axis=1) == pytest.approx(np.zeros(3), abs=1e-12 * scale)
    assert np.cross(x.T, f.T).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-11 * scale)
    dx = 1e-6 * random.standard_normal((3, count))
    up, down = (plan.energies(0.0, np.ascontiguousarray(x + sign * dx), None)[1] for sign in (1, -1))
    assert up - down == pytest.approx(-2.0 * np.sum(f * dx), rel=1e-6)


def test_damping_is_the_matrix_times_the_time():
    elastic, count = couplings_of()
    damped, _ = couplings_of(damping=0.5)
    x, v = np.random.default_rng(3).standard_normal((2, 3, count))
    moved = np.ascontiguousarray(x + damped.damping_time * v)
    plans = [alone(force, count=count) for force in (damped, elastic)]
    assert force_of(plans[0], x, v) == pytest.approx(force_of(plans[1], moved), rel=1e-9)
    assert plans[0].dissipation(0.0, x, v) >= 0.0


def test_damping_time_is_that_of_the_stiffest_triangle():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    operator = operator_of(points, np.array([[0, 1, 2], [3, 2, 1]]))
    masses = np.array([0.1, 0.2, 0.3, 0.4])
    moduli = np.array([3.0, 2.0, 1.0])
    squares = np.where(operator.particles[:, None] >= 0, operator.weights**2 / masses[operator.particles][:, None], 0.0)
    highest = (moduli[:, None] * operator.areas[:, None, None] * squares).sum(axis=(1, 2)).max()
    couplings = operator.couplings(tuple(moduli), damping=0.3, masses=masses)
    assert couplings.damping_time == pytest.approx(0.3 * math.sqrt(2.0 / highest))
    # The frequency of the smallest modulus underflows to 0.
    assert operator.couplings((5e-324, 0.0, 0.0), damping=0.3, masses=1e3 * masses).damping_time == 0.0


def test_bounds_hold_at_any_shape():
    couplings, count = couplings_of(damping=0.5)
    plan, random = alone(couplings, count=count), np.random.default_rng(2)
    for x in random.standard_normal((3, 3, count)):
        for part, rate in zip("xv", plan.spectral_bounds(x), strict=True):
            true = np.linalg.eigvalsh(matrix(plan, x, np.zeros_like(x), part))[-1]
            assert true <= rate * (1.0 + 1e-9)
            assert rate <= 2.0 * true


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (([[0, 0]], 1.0), "pair 0 of 'couplings' joins particle 0 to itself"),
        (([[0, 1]], math.nan), "constants of 'couplings'"),
        (([[0, 1]], 1.0, -1.0), "damping_time of 'couplings' is -1.0 s"),
    ],
)
def test_wrong_couplings_are_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        Couplings(*arguments)


def arc_file():
    """A mesh that is a part of a cylinder."""
    angles = np.linspace(0.0, 1.0, 4)
    lines = [f"v {math.cos(a)} {y} {math.sin(a)}" for a in angles for y in (0.0, 0.4)]
    lines += [f"f {2 * i + 1} {2 * i + 2} {2 * i + 3}\nf {2 * i + 2} {2 * i + 4} {2 * i + 3}" for i in range(3)]
    return {"arc.obj": "\n".join(lines).encode()}


def test_curved_mesh_needs_flat_rest():
    values = {key: value for key, value in SHEET.items() if key != "cloth.resolution"}
    values |= {"cloth.mesh": "arc.obj", "cloth.anchors": [""]}
    with pytest.raises(ParameterError, match=r"shape operators are flat at rest; set bending\.flat to true"):
        Scene.from_parameters(values, files=arc_file())
    scene = Scene.from_parameters({**values, "bending.flat": True}, files=arc_file())
    plan = alone(scene.model().force("shape_operator"), count=8)
    assert plan.energies(0.0, np.ascontiguousarray(scene.initial_positions().T), None)[1] > 0.0


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"bending.rest_angle": 0.5}, "bending.rest_angle is 0.5, and shape operators are flat at rest"),
        ({"material.bending_modulus": 0.0}, "bending model 'shape_operator' needs material.bending_modulus above 0"),
        ({"material.warp_direction": [0.0, 0.0, 1.0]}, "the sheet is perpendicular to material.warp_direction"),
    ],
)
def test_scene_refuses_what_shape_operators_lack(values, text):
    with pytest.raises(ParameterError, match=text):
        Scene.from_parameters({**SHEET, **values})


def test_oblique_threads_bend_by_their_own_moduli_on_a_grid():
    values = {**SHEET, "material.bending_modulus_weft": 5e-6, "material.warp_direction": [1.0, 1.0, 0.0]}
    scene = Scene.from_parameters(values)
    force, x = scene.model().force("shape_operator"), scene.sheet.positions()
    energies = []
    for direction in ([1.0, 1.0], [1.0, -1.0]):
        bent = np.column_stack([x[:, :2], 0.5 * (x[:, :2] @ direction) ** 2])
        energies.append(alone(force, count=len(x)).energies(0.0, np.ascontiguousarray(bent.T), None)[1])
    assert max(energies) > 3.0 * min(energies)


@pytest.mark.parametrize("integrator", ["auto", "implicit"])
def test_hanging_sheet_loses_energy(integrator):
    simulation = Simulation(Scene.from_parameters({**SHEET, "integrator": integrator}))
    energies = [simulation.energy()]
    for _ in range(10):
        assert simulation.advance().advance.flagged == 0
        energies.append(simulation.energy())
    assert (np.diff(energies) < 1e-4 * np.ptp(energies)).all()


def test_snapshot_continues_with_the_same_bits():
    simulation = Simulation(Scene.from_parameters(SHEET))
    for _ in range(3):
        simulation.advance()
    snapshot = simulation.snapshot()
    ends = []
    for _ in range(2):
        simulation.restore(snapshot)
        for _ in range(3):
            simulation.advance()
        ends.append(simulation.state.digest())
    assert len(set(ends)) == 1


def test_order_of_triangles_changes_little():
    points, faces = square_mesh(6, 0.5)
    full = [
        energy_matrix(operator_of(points, order), (1.0, 1.0, 0.5), len(points))
        for order in itertools.islice((faces, faces[::-1], np.roll(faces, 1, axis=1)), 3)
    ]
    for turned in full[1:]:
        assert turned == pytest.approx(full[0], abs=1e-9 * np.abs(full[0]).max())
