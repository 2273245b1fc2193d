# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Self-contact: energy of every pair, forces, flat layers, bounds and derivatives."""

import numpy as np
import pytest
from support import self_scenes as own

from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile

THICKNESS = 4e-3


def layers(**options):
    """Return two rough layers deep in contact: the triangles, the plan, positions (3, n) and masses."""
    options_with_defaults = {"rough": 5e-4, "shift": (0.0031, 0.0057), **options}
    triangles, rest_positions, x, masses = own.sheets(0.0, 0.6 * THICKNESS, **options_with_defaults)
    return (
        triangles,
        compile(own.alone(triangles, rest_positions, masses, THICKNESS)),
        np.ascontiguousarray(x.T),
        masses,
    )


def forces(plan, x, v=None):
    x = np.ascontiguousarray(x)
    out = np.zeros_like(x)
    plan.add_force(0.0, x, np.zeros_like(x) if v is None else np.ascontiguousarray(v), out, {})
    return out


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_energy_is_that_of_every_pair(seed):
    triangles, plan, x, masses = layers(rows=3, columns=4, seed=seed)
    assert plan.energies(0.0, x, None, memory={})[1] == pytest.approx(
        own.energy(triangles, x.T, masses, THICKNESS), rel=1e-9
    )


def test_the_force_is_minus_the_gradient_of_the_energy():
    _, plan, x, _ = layers()
    calculated, expected, step = forces(plan, x), np.zeros_like(x), 1e-7
    for c in range(3):
        for i in range(x.shape[1]):
            ends = []
            for sign in (1.0, -1.0):
                y = x.copy()
                y[c, i] += sign * step
                ends.append(plan.energies(0.0, y, None, memory={})[1])
            expected[c, i] = -(ends[0] - ends[1]) / (2.0 * step)
    assert calculated == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("seed", [3, 4])
def test_forces_keep_linear_and_angular_momentum(seed):
    _, plan, x, _ = layers(seed=seed)
    v = np.random.default_rng(seed).normal(size=x.shape)
    f = forces(plan, x, v)
    size = np.abs(f).max()
    assert f.sum(axis=1) == pytest.approx(np.zeros(3), abs=1e-13 * f.shape[1] * size)
    assert np.cross(x.T, f.T).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-14 * f.shape[1] * size)


def test_a_flat_layer_has_no_ripples():
    # A layer slides over another one, across edges and particles: the force is that of one plane. The lower one has no
    # weight; therefore its border, which moves along below the upper one, does not count.
    triangles, rest_positions, lower, _ = own.sheets(0.0, rows=9, columns=9)
    more, _, upper, _ = own.sheets(0.7 * THICKNESS, rows=4, columns=4)
    count = len(lower)
    masses = np.concatenate([np.full(count, 1e-30), np.full(len(upper), 1e-3)])
    triangles, rest_positions = (
        np.concatenate([triangles, more + count]),
        np.concatenate([rest_positions, upper + 10.0]),
    )
    plan = compile(own.alone(triangles, rest_positions, masses, THICKNESS))
    push = 0.5e-3 * own.U**2 / (2.0 * THICKNESS) * 0.3**3 * (1.0 + 3.0 * 0.7) / 0.7**2
    offsets = np.random.default_rng(0).uniform(0.03, 0.07, (100, 2))
    for offset in [*offsets, [0.04, 0.04], [0.05, 0.05], [0.05, 0.04], [0.043, 0.04], [0.045, 0.045]]:
        layer_forces = forces(plan, np.concatenate([lower, upper + np.append(offset, 0.0)]).T)[:, count:]
        expected = np.zeros_like(layer_forces)
        expected[2] = push
        assert layer_forces == pytest.approx(expected, abs=1e-12 * push)


def test_flat_sheet_squeezed_in_its_plane_has_no_self_contact():
    triangles, rest_positions, x, masses = own.sheets(0.0)
    plan = compile(own.alone(triangles, rest_positions, masses, THICKNESS))
    squeezed = x * [0.15, 1.0, 1.0]
    # The scale: about the force [N] between two such layers in contact.
    scale = 0.5 * masses.max() * own.U**2 / THICKNESS
    assert np.abs(forces(plan, squeezed.T)).max() < 1e-10 * scale
    assert plan.energies(0.0, np.ascontiguousarray(squeezed.T), None, memory={})[1] == pytest.approx(0.0, abs=1e-12)


def test_no_force_acts_beyond_the_thickness():
    for height, acts in ((1.0, False), (1.0 - 1e-4, True)):
        triangles, rest_positions, x, masses = own.sheets(0.0, height * THICKNESS)
        plan = compile(own.alone(triangles, rest_positions, masses, THICKNESS))
        assert forces(plan, x.T).any() == acts
        assert (plan.contact.self_gaps(np.ascontiguousarray(x.T))[0] > 0) == acts


def test_anchored_particles_push_and_are_not_pushed():
    triangles, rest_positions, x, masses = own.sheets(0.0, 0.6 * THICKNESS, shift=(0.003, 0.004))
    plan = compile(own.alone(triangles, rest_positions, masses, THICKNESS, anchors=range(25)))
    free = compile(own.alone(triangles, rest_positions, masses, THICKNESS))
    ends = [np.empty_like(x.T, order="C") for _ in range(2)]
    for checked_plan, out in zip((plan, free), ends, strict=True):
        checked_plan.accelerations(0.0, np.ascontiguousarray(x.T), np.zeros((3, len(x))), out, memory={})
    assert not ends[0][:, :25].any()
    assert np.array_equal(ends[0][:, 25:], ends[1][:, 25:])
    assert ends[0][2, 25:].max() > 0.0


@pytest.mark.parametrize("slip", [0.0, 0.5, 3.0])
def test_layers_that_meet_within_an_interval_change_the_jerk(slip):
    triangles, rest_positions, x, masses = own.sheets(0.0, 2.0 * THICKNESS, shift=(0.003, 0.004))
    plan = compile(own.alone(triangles, rest_positions, masses, THICKNESS))
    away, v, speed = x + [0.0, 0.0, 1.0] * (x[:, 2:] > 0.0), np.zeros_like(x), 1.2
    v[25:] = slip, 0.0, -speed
    x, away, v = (np.ascontiguousarray(array.T) for array in (x, away, v))
    for ends in ((x, v, away, v), (away, v, x, -v)):
        early, late = (
            plan.contact.jerk_change(0.0, factor * THICKNESS / speed, ends, {})[:, 25:] for factor in (0.99, 1.01)
        )
        least = np.linalg.norm(late, axis=0).min()
        assert least > 0.0
        assert np.abs(early).max() < 1e-6 * least


@pytest.mark.parametrize("slip", [0.0, 2.0])
def test_edges_that_meet_within_an_interval_change_the_jerk(slip):
    # Two edges across each other, 29.7 mm apart: edges have half the thickness.
    rods = np.array([[0, 1, 2], [3, 4, 5]])
    x = np.array([[-1, 0, 0], [1, 0, 0], [0, 0, -9], [0, -1, 0.0297], [0, 1, 0.0297], [0, 0, 9]], dtype=float)
    plan, v, speed = compile(own.alone(rods, x, np.ones(6), 0.05)), np.zeros_like(x), 2.0
    v[3:] = 0.0, slip, -speed
    x, v = np.ascontiguousarray(x.T), np.ascontiguousarray(v.T)
    away = x + np.array([[0.0], [0.0], [10.0]]) * (np.arange(6) > 2)
    assert not plan.contact.jerk_change(0.0, 2.3e-3, (x, v, away, v), {}).any()
    assert plan.contact.jerk_change(0.0, 5e-3, (x, v, away, v), {})[2, 3:5].all()


@pytest.mark.parametrize("seed", range(4))
def test_jerk_of_a_grid_is_that_of_its_triangles(seed):
    rng = np.random.default_rng(seed)
    plans, arrays = [], []
    for listed in (False, True):
        model, places, velocities = own.folded(10, radius=0.003 + 0.001 * seed, speed=0.5, listed=listed)
        plans.append(compile(model))
        arrays.append((places, velocities))
    (x, v), _ = arrays
    v = v + rng.normal(scale=0.3, size=v.shape)
    x, v = np.ascontiguousarray(x.T), np.ascontiguousarray(v.T)
    n_changed = []
    for duration in (1e-4, 2e-3, 5e-3, 1e-2, 2e-2, 4e-2):
        changes = [plan.contact.jerk_change(0.0, duration, (x, v, x, -v), {}) for plan in plans]
        assert changes[0] == pytest.approx(changes[1], rel=1e-9, abs=1e-9 * np.abs(changes[1]).max())
        n_changed.append(np.count_nonzero(changes[0].any(axis=0)))
    assert n_changed == sorted(n_changed)
    assert n_changed[0] == 0 < n_changed[-1]


@pytest.mark.parametrize("seed", [5, 6])
def test_derivative_products_are_those_of_differences(seed):
    _, plan, x, _ = layers(seed=seed)
    rng, step = np.random.default_rng(seed), 1e-8
    v, dx, dv = 0.5 * rng.normal(size=x.shape), rng.normal(size=x.shape), rng.normal(size=x.shape)
    out = np.zeros_like(x)
    plan.add_jacobian_product(0.0, x, v, dx, dv, out, memory={})
    ends = [forces(plan, x + sign * step * dx, v + sign * step * dv) for sign in (1.0, -1.0)]
    assert out == pytest.approx((ends[0] - ends[1]) / (2.0 * step), abs=1e-6 * np.abs(out).max())


@pytest.mark.parametrize("seed", [7, 8])
def test_damping_dissipates_what_it_reports(seed):
    _, plan, x, _ = layers(seed=seed)
    v = np.random.default_rng(seed).normal(size=x.shape)
    dissipation = plan.dissipation(0.0, x, v, memory={})
    assert dissipation == pytest.approx(-float(((forces(plan, x, v) - forces(plan, x)) * v).sum()), rel=1e-9)
    assert dissipation > 0.0
    assert plan.dissipation(0.0, x, -v, memory={}) > 0.0


@pytest.mark.parametrize("turning", [-1.0, 1.0])
def test_damping_of_nearly_parallel_edges_matches_its_report(turning):
    # Two edges 10 mm apart, a hundredth of a radian from parallel: their energy fades with the angle.
    rods = np.array([[0, 1, 2], [3, 4, 5]])
    x = np.array([[-1, 0, 0], [1, 0, 0], [0, 0, -9], [-1, -0.01, 0.01], [1, 0.01, 0.01], [0, 0, 9]], dtype=float)
    plan = compile(own.alone(rods, x, np.ones(6), 0.05))
    v = np.zeros_like(x)
    v[3:5, 1] = turning * x[3:5, 0]
    x, v = np.ascontiguousarray(x.T), np.ascontiguousarray(v.T)
    dissipation = plan.dissipation(0.0, x, v, memory={})
    assert dissipation == pytest.approx(-float(((forces(plan, x, v) - forces(plan, x)) * v).sum()), rel=1e-9)
    assert dissipation > 0.0


@pytest.mark.parametrize("seed", [9, 10])
def test_bounds_are_above_the_largest_eigenvalue(seed):
    _, plan, x, _ = layers(seed=seed, rows=3, columns=3)
    blocks, damping_blocks = np.zeros((2, 6, x.shape[1]))
    plan.add_bounds(x, blocks, damping_blocks, memory={})
    size = x.size
    stiffness, bound = np.zeros((size, size)), np.zeros((size, size))
    for k in range(size):
        dx, out = np.zeros(size), np.zeros_like(x)
        dx[k] = 1.0
        plan.add_jacobian_product(0.0, x, np.zeros_like(x), dx.reshape(x.shape), np.zeros_like(x), out, memory={})
        stiffness[:, k] = -out.ravel()
    for entry, (row, column) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        for i in range(x.shape[1]):
            a, b = row * x.shape[1] + i, column * x.shape[1] + i
            bound[a, b] = bound[b, a] = blocks[entry, i]
    # The bound covers the stiffness along each pair's direction. It ignores the stiffness of that direction's rotation,
    # which is small and of either sign.
    largest = np.linalg.eigvalsh(stiffness).max()
    assert np.linalg.eigvalsh(bound - stiffness).min() > -1e-2 * largest
    assert largest < np.linalg.eigvalsh(bound).max() < 4.0 * largest


def test_refusals_name_the_value_the_limit_and_the_remedy():
    triangles, rest_positions, *_ = own.sheets(0.0)
    with pytest.raises(
        ValueError, match=r"0\.011 m, more than half the cloth's shortest edge, 0\.02 m.*take 0\.0098 m"
    ):
        ContactSurface(triangles, rest_positions, thickness=0.011)
    with pytest.raises(ValueError, match="without triangles"):
        ContactSurface(np.zeros((0, 3), dtype=int), rest_positions, thickness=1e-3)
    surface = ContactSurface(triangles, rest_positions, thickness=1e-3)
    with pytest.raises(ValueError, match="has 25 particles, the model 30"):
        compile(Model(np.ones(30), [Contact(thickness=1e-3, surface=surface)]))
