# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact with obstacles: forces, energy, bounds and recorded wrenches against independent formulas."""

import numpy as np
import pytest
from support import laws
from support.alone import alone, blocks, force, gradient, matrix, product
from support.contact_scenes import SHAPES, THICKNESS, contact, moving, points_near, still

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile

COUNT = 60
every_shape = pytest.mark.parametrize("shape", SHAPES)


def about(shape, seed=0, damping=10.0, path=None, **where):
    """Return a force with one moving obstacle, its plan with random masses, and nearby particles with random
    velocities.
    """
    rng = np.random.default_rng(seed)
    path = moving(seed) if path is None else path
    contact_force = contact(shape, paths=[path], damping=damping)
    x = points_near(SHAPES[shape], path, 0.3, COUNT, rng, **where)
    masses = rng.uniform(0.5, 2.0, COUNT)
    return contact_force, alone(contact_force, masses=masses), masses, x, 3.0 * rng.normal(size=x.shape)


@every_shape
@pytest.mark.parametrize("damping", [0.0, 0.1, 10.0])
def test_forces_energies_and_powers_are_those_of_the_formulas(shape, damping):
    contact_force, plan, masses, x, v = about(shape, damping=damping)
    expected, booked = laws.contact(0.3, x, v, contact_force, masses)
    assert np.abs(expected.force).max() > 1e4
    # Positions are accurate to 1e-16 m, which is 1e-13 of a thickness of 2 mm.
    scale = np.abs(expected.force).max()
    assert force(plan, x, v, 0.3) == pytest.approx(expected.force, rel=1e-9, abs=1e-10 * scale)
    assert plan.energies(0.3, x, v, memory={})[1] == pytest.approx(expected.energy, rel=1e-9)
    assert plan.dissipation(0.3, x, v, memory={}) == pytest.approx(expected.dissipation, rel=1e-9)
    assert plan.contact.wrench_rates(0.3, x, v, memory={}) == pytest.approx(
        booked, rel=1e-9, abs=1e-9 * np.abs(booked).max()
    )
    assert plan.contact.obstacle_gaps(0.3, x, memory={})[0, 0] == np.count_nonzero(np.abs(expected.force).any(axis=0))


@every_shape
def test_static_force_is_minus_the_energy_gradient(shape):
    _, plan, _, x, _ = about(shape, damping=0.0, path=still((0.3, -0.2, 0.1), (0.5, -0.5, 0.1, 0.7)), deepest=0.6)
    slopes = gradient(lambda places: plan.energies(0.3, places, None, memory={})[1], x, step=1e-7)
    assert force(plan, x, t=0.3) == pytest.approx(-slopes, abs=1e-5 * np.abs(slopes).max())


@every_shape
def test_damping_never_gives_energy_and_never_pulls(shape):
    contact_force, plan, masses, x, v = about(shape)
    undamped_plan = compile(Model(masses, [contact_force]))
    for speed in (1e-3, 0.1, 10.0, 1e3):
        damped_force = force(plan, x, speed * v, 0.3)
        static_force = force(undamped_plan, x, np.zeros_like(x), 0.3)
        assert plan.dissipation(0.3, x, speed * v, memory={}) >= 0.0
        # Each along one normal: the force never pulls.
        assert (np.sum(damped_force * static_force, axis=0) >= 0.0).all()


@every_shape
def test_the_change_of_jerk_is_that_of_the_pushes(shape):
    path = still((0.3, -0.2, 0.1), (0.5, -0.5, 0.1, 0.7))
    _, plan, masses, x, v = about(shape, damping=0.0, path=path, deepest=0.6, farthest=0.95)
    push, h = force(plan, x, t=0.3), 1e-8
    normals = push / np.linalg.norm(push, axis=0)
    slopes = (force(plan, x + h * v, t=0.3) - force(plan, x - h * v, t=0.3)) / (2.0 * h)
    # A normal that turns does not count.
    jerks = normals * np.sum(normals * slopes, axis=0) / masses
    changes = plan.contact.jerk_change(0.3, 0.0, (x, np.zeros_like(x), x, v), {})
    assert changes == pytest.approx(jerks, abs=1e-4 * np.abs(jerks).max())
    assert plan.contact.jerk_change(0.3, 0.0, (x, v, x, np.zeros_like(x)), {}) == pytest.approx(-changes)


@pytest.mark.parametrize("speed", [0.1, 1.0, 5.0])
def test_contact_within_an_interval_counts_where_it_stops(speed):
    plan = alone(contact("plane", paths=[still()], damping=0.0), count=1)
    down, zeros = np.array([[0.0], [0.0], [-speed]]), np.zeros((3, 1))

    def at(gap):
        return np.array([[0.0], [0.0], [gap]])

    # The gap at which contact has absorbed the kinetic energy, by bisection.
    low, high = 1e-9 * THICKNESS, THICKNESS
    for _ in range(100):
        middle = 0.5 * (low + high)
        stops_later = plan.energies(0.0, at(middle), None, memory={})[1] < 0.5 * speed**2
        low, high = (low, middle) if stops_later else (middle, high)
    expected = plan.contact.jerk_change(0.0, 0.0, (at(low), down, at(1.0), zeros), {})
    assert expected[2, 0] < 0.0
    distant, duration = at(THICKNESS + 0.5 * speed), 0.51
    assert plan.contact.jerk_change(0.0, duration, (distant, down, at(1e3), zeros), {}) == pytest.approx(expected)
    # A particle that leaves has met it; one that does not get there in time has not.
    assert plan.contact.jerk_change(0.0, duration, (at(1e3), zeros, distant, -down), {}) == pytest.approx(expected)
    assert not plan.contact.jerk_change(0.0, 0.49, (distant, down, distant, -down), {}).any()


@every_shape
def test_the_derivative_product_is_that_of_the_force(shape):
    _, plan, _, x, v = about(shape, deepest=0.6, farthest=0.95)
    rng = np.random.default_rng(2)
    dx, dv = rng.normal(size=x.shape), rng.normal(size=x.shape)
    h = 1e-8
    by_place = (force(plan, x + h * dx, v, 0.3) - force(plan, x - h * dx, v, 0.3)) / (2 * h)
    by_speed = (force(plan, x, v + 1e-5 * dv, 0.3) - force(plan, x, v - 1e-5 * dv, 0.3)) / 2e-5
    zero = np.zeros_like(x)
    products = product(plan, x, v, dx, zero, 0.3), product(plan, x, v, zero, dv, 0.3)
    assert products[0] == pytest.approx(by_place, abs=1e-4 * np.abs(by_place).max())
    assert products[1] == pytest.approx(by_speed, abs=1e-6 * np.abs(by_speed).max())


@every_shape
def test_bounds_hold_at_rest(shape):
    path = still((0.3, -0.2, 0.1), (0.5, -0.5, 0.1, 0.7))
    _, plan, _, x, v = about(shape, path=path)
    stiff, damped = blocks(plan, x)
    zero = np.zeros_like(x)
    for part, bound in (("x", stiff), ("v", damped)):
        whole = matrix(plan, x, zero, part)
        whole = 0.5 * (whole + whole.T)
        particle_matrix = whole.reshape(3, COUNT, 3, COUNT)
        for i in range(COUNT):
            xx, yy, zz, xy, xz, yz = bound[:, i]
            block = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            least = np.linalg.eigvalsh(block - particle_matrix[:, i, :, i])[0]
            assert least >= -1e-9 * np.abs(bound).max()
    # Damping grows with speed to at most the bound.
    whole = matrix(plan, x, v, "v")
    assert np.linalg.eigvalsh(0.5 * (whole + whole.T))[-1] <= damped[:3].sum(axis=0).max() * (1.0 + 1e-9)


def test_force_starts_smoothly_at_the_thickness():
    plan = alone(contact("plane", damping=0.0), count=1)
    gaps = THICKNESS * np.array([1.0, 1.0 - 1e-3, 1.0 - 2e-3, 1.5, 100.0])
    push = [force(plan, np.array([[0.0], [0.0], [gap]]))[2, 0] for gap in gaps]
    assert push[0] == push[3] == push[4] == 0.0
    # As the third power of the depth: the first two derivatives are continuous.
    assert push[2] / push[1] == pytest.approx(8.0, rel=1e-2)


@every_shape
def test_energy_and_force_are_not_finite_without_a_gap(shape):
    contact_force, plan, *_ = about(shape)
    position, _, rotation, _ = laws.pose(contact_force.paths[0], 0.3)
    inside = (position + 0.05 * rotation @ [0.1, 0.2, -1.0])[:, None]
    single_plan = alone(contact_force, count=1)
    assert plan.contact.obstacle_gaps(0.3, np.repeat(inside, COUNT, axis=1), memory={})[0, 1] < 0.0
    assert not np.isfinite(force(single_plan, inside, t=0.3)).all()
    assert not np.isfinite(single_plan.energies(0.3, inside, None, memory={})[1])


def test_forces_of_several_obstacles_add_up():
    rng = np.random.default_rng(3)
    paths = [moving(k) for k in range(5)]
    paths[0][1:4], paths[0][13:26] = [0.0, 0.0, -9.0], still()[13:26]
    for k, path in enumerate(paths):
        path[1] += 30.0 * k
    places = [points_near(SHAPES[shape], path, 0.1, 9, rng) for shape, path in zip(SHAPES, paths, strict=True)]
    x = np.concatenate(places, axis=1)
    v = rng.normal(size=x.shape)
    masses = rng.uniform(0.5, 2.0, x.shape[1])
    contact_force = contact(*SHAPES, paths=paths)
    plan = compile(Model(masses, [contact_force], anchors=[3, 20]))
    free = plan.model.inverse_masses > 0.0
    expected = laws.contact(0.1, x, v, contact_force, masses)[0].force * free
    assert force(plan, x, v, 0.1) == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())
    booked = plan.contact.wrench_rates(0.1, x, v, memory={})
    assert booked[:, :3].sum(axis=0) == pytest.approx(-expected.sum(axis=1), rel=1e-9)


def test_predicted_bounds_are_those_of_the_stopping_gap():
    plan = alone(contact("plane", damping=0.0), count=1)
    for speed in (0.5, 3.0, 20.0):
        x, v = np.array([[0.0], [0.0], [0.01]]), np.array([[1.0], [0.0], [-speed]])
        omega2, _ = plan.predict_contact(0.0, 0.05, x, v, memory={})
        # The slope of the force at (1 - s)^4 / s = (speed / U)^2, with a margin of the same energy again.
        gaps = np.linspace(1e-3, 1.0, 100_001)
        s = gaps[np.argmin(np.abs((1.0 - gaps) ** 4 / gaps - (speed / laws.STOPPING_SPEED) ** 2))]
        slope = laws.STOPPING_SPEED**2 / 2.0 / THICKNESS**2 * (2.0 / s**3 - 8.0 + 6.0 * s)
        assert slope <= omega2 <= 2.5 * slope
        # It moves away, or does not arrive.
        assert plan.predict_contact(0.0, 0.05, x, -v, memory={}) == (0.0, 0.0)
        assert plan.predict_contact(0.0, 0.001 / speed, x, v, memory={}) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"thickness": 0.0}, "thickness is 0.0 m; it must be above 0"),
        ({"thickness": np.nan}, "contact thickness is nan; it must be finite"),
        ({"thickness": 1e-3, "damping": -1.0}, "contact damping is -1.0; it must be finite and at least 0"),
        ({"thickness": 1e-3, "obstacles": [SHAPES["box"]] * 2}, "two obstacles are named 'box'"),
    ],
)
def test_invalid_contact_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Contact(values.pop("obstacles", ()), **values)


def test_two_contact_forces_and_wrong_paths_are_refused():
    first, second = contact("plane"), contact(Obstacle(name="other", shape="plane"))
    second.name = "more"
    with pytest.raises(ValueError, match="merge them into one"):
        compile(Model([1.0], [first, second]))
    plan = alone(first, count=1)
    for paths, message in ((np.zeros((2, 26)), "paths have shape"), (np.full((1, 26), np.nan), "must be finite")):
        first.set_paths(paths)
        with pytest.raises(ValueError, match=message):
            plan.contact.obstacle_gaps(0.0, np.zeros((3, 1)), memory={})
