# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Friction between layers: forces at one moment, with chosen anchors."""

import numpy as np
import pytest
from support import self_scenes as own
from support.alone import NO_MEMORY

from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY

THICKNESS = 4e-3
MU = (0.6, 0.4)


def stacked(friction=MU, *, heights=(0.0, 0.7 * THICKNESS), rough=2e-4, damping=10.0, **options):
    """Return the plan of layers with contact alone, positions (3, n) and masses."""
    triangles, rest_positions, x, masses = own.sheets(*heights, rough=rough, shift=(0.0061, 0.0037), seed=4)
    surface = ContactSurface(triangles, rest_positions, thickness=THICKNESS, friction=friction)
    force = Contact(thickness=THICKNESS, damping=damping, surface=surface)
    return compile(Model(masses, [force], **options)), np.ascontiguousarray(x.T), masses


def anchored_at(plan, x):
    """Return a memory with anchors at the particles' positions."""
    none = np.zeros((1, *plan.contact.anchors_shape))
    return {ANCHORS_KEY: plan.contact.combine_anchors(0.0, x, np.zeros_like(x), none, [1.0], {})}


def forces(plan, x, v, masses, memory=NO_MEMORY):
    a = np.empty_like(x)
    plan.accelerations(0.0, x, v, a, memory)
    return masses * a


def friction(x, v, *, moved=0.0, anchored=True, seed=3):
    """Return forces with friction minus those without, after particles moved from their anchors by some noise [m]."""
    plan, _, masses = stacked()
    memory = anchored_at(plan, x) if anchored else NO_MEMORY
    away = x + moved * np.random.default_rng(seed).normal(size=x.shape)
    without, _, _ = stacked((0.0, 0.0))
    return forces(plan, away, v, masses, memory) - forces(without, away, v, masses), away


@pytest.mark.parametrize("moved", [2e-8, 1e-3])
def test_self_friction_keeps_linear_and_angular_momentum(moved):
    _, x, _ = stacked()
    v = 0.05 * np.random.default_rng(1).normal(size=x.shape)
    f, away = friction(x, v, moved=moved)
    size = np.abs(f).sum()
    assert size > 1e-3
    assert np.abs(f.sum(axis=1)).max() < 1e-12 * size
    assert np.abs(np.cross(away.T, f.T).sum(axis=0)).max() < 1e-12 * size


def test_sticking_force_is_minus_the_energy_gradient():
    plan, x, masses = stacked(damping=0.0)
    memory = anchored_at(plan, x)
    x = x + 2e-8 * np.random.default_rng(2).normal(size=x.shape)
    without, _, _ = stacked((0.0, 0.0), damping=0.0)
    none = np.zeros_like(x)
    f = forces(plan, x, none, masses, memory) - forces(without, x, none, masses)
    assert np.abs(f).max() > 1e-5

    def energy(y):
        return plan.energy(0.0, y, none, memory) - without.energy(0.0, y, none, {})

    step = 1e-8
    for c, i in [(0, 7), (1, 30), (2, 12), (2, 33), (0, 41), (1, 18)]:
        up, down = x.copy(), x.copy()
        up[c, i] += step
        down[c, i] -= step
        slopes = (energy(down) - energy(up)) / (2 * step)
        assert slopes == pytest.approx(f[c, i], abs=2e-7)


def test_bounds_include_the_friction_spring():
    plan, x, masses = stacked()
    without, _, _ = stacked((0.0, 0.0))
    memory = anchored_at(plan, x)
    friction_bounds, bare = (
        checked_plan.contact.predict_surface_contact(0.0, 0.0, x, 0 * x, memory) for checked_plan in (plan, without)
    )
    # Derivative of the forces by differences, in directions of the largest growth.
    none, rng = np.zeros_like(x), np.random.default_rng(5)
    u = rng.normal(size=x.shape)
    for _ in range(30):
        u /= np.sqrt((masses * u * u).sum())
        step = 1e-10
        with_ = forces(plan, x + step * u, none, masses, memory) - forces(plan, x - step * u, none, masses, memory)
        off = forces(without, x + step * u, none, masses) - forces(without, x - step * u, none, masses)
        k = -(with_ - off) / (2 * step)
        omega2, u = float((u * k).sum()), k / masses
    assert omega2 > 0.2 * 2000.0**2
    assert omega2 < friction_bounds[0] - bare[0]


def test_damping_and_sliding_only_take_energy():
    plan, x, _ = stacked()
    rng = np.random.default_rng(6)
    for moved, speed in ((0.0, 1e-3), (1e-7, 0.05), (1e-3, 0.5)):
        memory = anchored_at(plan, x)
        away, v = x + moved * rng.normal(size=x.shape), speed * rng.normal(size=x.shape)
        anchors = plan.contact.combine_anchors(0.0, away, v, memory[ANCHORS_KEY][None], [1.0], memory)
        assert plan.contact.friction_power(0.0, away, v, {ANCHORS_KEY: anchors}) > 0.0


def test_friction_stays_within_the_cone_and_follows_both_sides():
    # The normal forces on the middle layer cancel; friction does not.
    heights = (0.0, 0.98 * THICKNESS, 1.96 * THICKNESS)
    plan, x, masses = stacked(heights=heights, rough=0.0)
    without, _, _ = stacked((0.0, 0.0), heights=heights, rough=0.0)
    memory = anchored_at(plan, x)
    v = np.zeros_like(x)
    v[0, 25:50] = 0.5
    a, b = forces(plan, x, v, masses, memory), forces(without, x, v, masses)
    friction_force = (a - b)[0]
    push = b[2, 50:].sum()
    assert friction_force[25:50].sum() < 0.0
    assert (memory[ANCHORS_KEY][:, 3, 25:50] > 0.0).any(axis=1).all()
    # Damping uses the rest of the cone.
    assert abs(friction_force[25:50].sum()) == pytest.approx(2 * MU[1] * push, rel=0.05)


def test_derivative_product_is_the_difference_of_forces():
    plan, x, masses = stacked()
    memory = anchored_at(plan, x)
    rng = np.random.default_rng(8)
    x = x + 2e-8 * rng.normal(size=x.shape)
    v = 1e-4 * rng.normal(size=x.shape)
    dx, dv = rng.normal(size=x.shape), rng.normal(size=x.shape)
    out, step = np.zeros_like(x), 1e-10
    plan.add_jacobian_product(0.0, x, v, dx, dv, out, memory)
    both = [forces(plan, x + sign * step * dx, v + sign * step * dv, masses, memory) for sign in (1, -1)]
    assert (both[0] - both[1]) / (2 * step) == pytest.approx(out, rel=1e-4, abs=1e-3 * np.abs(out).max())


def test_invalid_coefficients_and_anchors_are_refused():
    with pytest.raises(ValueError, match=r"friction 0\.2 at rest and 0\.4 in motion"):
        stacked((0.2, 0.4))
    plan, x, _ = stacked()
    anchors = anchored_at(plan, x)[ANCHORS_KEY].copy()
    anchors[0, 0, :], anchors[0, 3, :] = 1e6, 1.0
    with pytest.raises(ValueError, match=r"in triangle 1000000\.0; it must be a whole number from 0 to 63"):
        plan.contact.upload({ANCHORS_KEY: anchors})


def test_the_change_of_jerk_is_that_of_flat_layers():
    plan, x, masses = stacked((0.0, 0.0), rough=0.0, damping=0.0)
    v, h = np.zeros_like(x), 1e-8
    v[2, x[2] > 0.5 * x[2].max()] = -0.3
    still = np.zeros_like(x)
    jerks = (forces(plan, x + h * v, still, masses) - forces(plan, x - h * v, still, masses)) / (2.0 * h * masses)
    assert np.abs(jerks).max() > 1.0
    assert plan.contact.jerk_change(0.0, 0.0, (x, still, x, v), {}) == pytest.approx(
        jerks, abs=1e-5 * np.abs(jerks).max()
    )


def test_friction_changes_where_layers_slid_or_vibrate():
    plan, x, masses = stacked()
    memory, rng = anchored_at(plan, x), np.random.default_rng(7)
    anchors, triangles = memory[ANCHORS_KEY], plan.contact.force.surface.triangles
    # The layers move as rigid bodies. Half of the anchors slide, some of them without a bond at the end.
    ends = anchors.copy()
    ends[:, 1:3, ::2] += 1e-4 * rng.normal(size=ends[:, 1:3, ::2].shape)
    ends[:, 3, ::6] = 0.0
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    y = np.ascontiguousarray(turn @ x + rng.normal(size=(3, 1)))
    v = rng.normal(size=x.shape)
    expected, expected_vibrations, n_slid, n_stuck = np.zeros_like(x), np.zeros_like(x), 0, 0
    for face, i in np.argwhere((anchors[:, 3] > 0.0) & (ends[:, 3] > 0.0)):
        (triangle, b, c, _), (_, before_b, before_c, _) = ends[face, :, i], anchors[face, :, i]
        corners = triangles[int(triangle)]
        sides = y[:, corners[1:]] - y[:, corners[:1]]
        force = 0.5 * masses[i] * 2000.0**2 * sides @ [b - before_b, c - before_c]
        if i % 2:
            slip = v[:, i] - v[:, corners] @ [1.0 - b - c, b, c]
            normal = np.cross(*sides.T)
            normal /= np.linalg.norm(normal)
            expected_vibrations[:, i] += slip - (slip @ normal) * normal
            n_stuck += 1
            continue
        n_slid += 1
        if ends[face, 3, i] == 1.0:
            # It sticks at the end. Its stretch makes it vibrate.
            weights = np.linalg.lstsq(sides, y[:, i] - y[:, corners[0]])[0]
            expected_vibrations[:, i] += 2000.0 * sides @ (weights - [b, c])
        for particle, weight in zip((i, *corners), (1.0, b + c - 1.0, -b, -c), strict=True):
            expected[:, particle] += weight * force / masses[particle]
    changes, vibrations = plan.contact.friction_change(0.0, 0.01, (x, y, v), ends, memory)
    assert n_slid > 3
    assert n_stuck > 3
    assert vibrations == pytest.approx(expected_vibrations, rel=1e-6, abs=1e-9)
    size = np.abs(expected).max()
    assert changes == pytest.approx(expected, rel=1e-6, abs=1e-6 * size)
    assert np.abs((masses * changes).sum(axis=1)).max() < 1e-9 * size


def test_stretch_difference_of_layers_that_stick():
    plan, x, _ = stacked()
    memory, rng = anchored_at(plan, x), np.random.default_rng(7)
    anchors, triangles = memory[ANCHORS_KEY].copy(), plan.contact.force.surface.triangles
    anchors[:, 3, 1::3] *= 2.0
    anchors[:, 1:3] += 1e-4 * rng.normal(size=anchors[:, 1:3].shape)
    moved_anchors, y = anchors.copy(), x + 1e-6 * rng.normal(size=x.shape)
    moved_anchors[:, 1:3] += 1e-4 * rng.normal(size=moved_anchors[:, 1:3].shape)
    ends = [(x, {**memory, ANCHORS_KEY: anchors}), (y, {**memory, ANCHORS_KEY: moved_anchors})]
    differences = plan.contact.stretch_difference(0.0, ends)
    expected = np.zeros_like(x)
    for face, i in np.argwhere(anchors[:, 3] == 1.0):
        corners, stretches = triangles[int(anchors[face, 0, i])], []
        for places, bonds in ((x, anchors), (y, moved_anchors)):
            weights = np.linalg.lstsq(
                places[:, corners[1:]] - places[:, corners[:1]], places[:, i] - places[:, corners[0]]
            )[0]
            stretches.append((y[:, corners[1:]] - y[:, corners[:1]]) @ (weights - bonds[face, 1:3, i]))
        expected[:, i] += stretches[1] - stretches[0]
    assert np.count_nonzero(expected.any(axis=0)) > 3
    assert differences == pytest.approx(expected, rel=1e-6, abs=1e-9)
