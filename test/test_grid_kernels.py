# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The regular-grid kernels against plain numpy on an index list."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.bench.reference_kernel import ReferenceKernel, find_compiler
from cloth_sim_ros.physics.kernels import grid_leapfrog
from cloth_sim_ros.physics.kernels.grid_forces import GridForces, grid_forces
from cloth_sim_ros.physics.kernels.grid_leapfrog import GridGrips, GridLeapfrog
from cloth_sim_ros.physics.kernels.grid_springs import GridFamily, GridSprings, constants

# Offsets (rows, columns) of the far end from the near one, written down again so that the kernel's own table is under
# test.
OFFSETS = {
    "right": (0, 1),
    "down": (1, 0),
    "diagonal": (1, 1),
    "antidiagonal": (1, -1),
    "right2": (0, 2),
    "down2": (2, 0),
}
SPACING = 0.05
MASS = 2e-3
GRAVITY = np.array([0.3, -0.2, -9.81])

ALL = (
    GridFamily("right", 30.0, SPACING, 0.02, border=0.5),
    GridFamily("down", 31.0, SPACING, 0.021, border=0.5),
    GridFamily("diagonal", 12.0, SPACING * np.sqrt(2.0), 0.01),
    GridFamily("antidiagonal", 13.0, SPACING * np.sqrt(2.0), 0.011),
    GridFamily("right2", 3.0, 2 * SPACING, 0.004, border=0.5),
    GridFamily("down2", 3.1, 2 * SPACING, 0.005, border=0.5),
)
CHOICES = {
    "all": ALL,
    "undamped": tuple(family._replace(damping=0.0) for family in ALL),
    "edges": ALL[:2],
    "alternating": (*ALL[:2], ALL[2]._replace(parity=0), ALL[3]._replace(parity=1)),
    "rows only": ALL[:1],
    "mixed damping": (ALL[0], ALL[1]._replace(damping=0.0), ALL[5]),
}


def pairs(springs, family):
    """Ends and factors of a family's springs, one at a time from its definition."""
    down, right = OFFSETS[family.name]
    ends, factors = [], []
    for row in range(springs.rows):
        for column in range(springs.columns):
            if not (row + down < springs.rows and 0 <= column + right < springs.columns):
                continue
            if family.parity is not None and (row + min(column, column + right)) % 2 != family.parity:
                continue
            along_border = (down == 0 and row in (0, springs.rows - 1)) or (
                right == 0 and column in (0, springs.columns - 1)
            )
            ends.append((row * springs.columns + column, (row + down) * springs.columns + column + right))
            factors.append(family.border if along_border else 1.0)
    return np.array(ends, dtype=np.int64).reshape(-1, 2).T, np.array(factors)


def plain_forces(x, v, springs):
    """S1 for each spring, scattered."""
    f = np.zeros_like(x)
    for family in springs.families:
        (i, j), factor = pairs(springs, family)
        d, approach = x[:, j] - x[:, i], v[:, j] - v[:, i]
        length = np.linalg.norm(d, axis=0)
        unit = d / length
        pull = factor * (
            family.stiffness * (length / family.rest_length - 1.0) + family.damping * (approach * unit).sum(axis=0)
        )
        for c in range(3):
            np.add.at(f[c], i, pull * unit[c])
            np.add.at(f[c], j, -pull * unit[c])
    return f


def crumpled(rows, columns, seed=1):
    """Positions and velocities well away from rest."""
    random = np.random.default_rng(seed)
    down, right = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    x = SPACING * np.stack([right.ravel(), down.ravel(), 0.0 * down.ravel()]) + 0.3 * SPACING * random.standard_normal(
        (3, rows * columns)
    )
    return np.ascontiguousarray(x), 0.5 * random.standard_normal((3, rows * columns))


def close(actual, expected, relative):
    return np.abs(actual - expected).max() <= relative * np.abs(expected).max()


@pytest.mark.parametrize("choice", CHOICES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 2), (3, 17), (19, 16), (5, 33)])
def test_forces_equal_the_plain_sum_over_pairs(choice, shape):
    springs = GridSprings(*shape, CHOICES[choice])
    x, v = crumpled(*shape)
    f = np.ones_like(x)
    grid_forces(x, v, springs, f)
    assert np.abs(f - 1.0 - plain_forces(x, v, springs)).max() <= 1e-12 * max(np.abs(f).max(), 1.0)


def test_spring_count_is_that_of_the_pairs():
    for families in CHOICES.values():
        springs = GridSprings(6, 9, families)
        assert springs.spring_count() == sum(pairs(springs, family)[0].shape[1] for family in families)


def test_float32_forces_round_as_single_precision_does():
    springs = GridSprings(19, 16, ALL)
    x, v = crumpled(19, 16)
    x += 100.0  # a map frame far away must not cost digits
    f = np.zeros_like(x)
    GridForces(springs, dtype=np.float32).add(x, v, f)
    assert close(f, plain_forces(x, v, springs), 3e-6)


def test_weak_and_other_families_add_up():
    springs = GridSprings(9, 11, tuple(family._replace(weak="2" in family.name) for family in ALL))
    x, v = crumpled(9, 11)
    f = np.zeros_like(x)
    for weak in (True, False):
        GridForces(springs, weak=weak).add(x, v, f)
    assert close(f, plain_forces(x, v, springs), 1e-12)


def test_coincident_particles_stay_finite():
    springs = GridSprings(4, 5, ALL)
    for dtype in (np.float64, np.float32):
        f = np.zeros((3, 20))
        GridForces(springs, dtype=dtype).add(np.zeros((3, 20)), np.ones((3, 20)), f)
        assert np.array_equal(f, np.zeros((3, 20)))


def plain_leapfrog(x, v, springs, inverse_mass, steps, dt, *, gravity=None, drag=0.0, grips=None):
    """The scheme as written in the documentation."""
    free = (inverse_mass > 0.0).astype(float)
    x, v = x.copy(), v.copy()
    impulses = None if grips is None else np.zeros_like(grips.impulses)

    def acceleration(t, position, velocity, book):
        f = plain_forces(position, velocity, springs)
        for g in range(0 if grips is None else len(grips.particles)):
            i = grips.particles[g]
            path = grips.paths[g]
            point, speed = path @ [1.0, t, t**2, t**3], path @ [0.0, 1.0, 2.0 * t, 3.0 * t**2]
            pull = grips.stiffness[g] * (position[:, i] - point) + grips.damping[g] * (velocity[:, i] - speed)
            f[:, i] -= pull
            if book:
                impulses[g] += dt * pull
        a = inverse_mass * f - drag * free * velocity
        return a if gravity is None else a + free * gravity[:, None]

    before = a = acceleration(0.0, x, v, False)
    for step in range(steps):
        x += 0.5 * dt * v
        a, before = acceleration((step + 0.5) * dt, x, v + 0.25 * dt * (a + before), True), a
        v += dt * a
        x += 0.5 * dt * v
    return x, v, impulses


def some_masses(count):
    inverse = np.full(count, 1.0 / MASS)
    inverse[::7] = 0.5 / MASS
    inverse[[0, count - 1]] = 0.0
    return inverse


def some_grips():
    random = np.random.default_rng(4)
    return GridGrips(
        particles=np.array([3, 18, 19, 130]),
        paths=0.1 * random.standard_normal((4, 3, 4)),
        stiffness=np.array([20.0, 10.0, 30.0, 25.0]),
        damping=np.array([0.1, 0.2, 0.0, 0.1]),
        impulses=np.full((4, 3), 7.0),
        work=np.full(4, 7.0),
    )


@pytest.mark.parametrize(
    ("choice", "extras"),
    [
        ("all", {"gravity": GRAVITY, "drag": 1.5}),
        ("undamped", {}),
        ("undamped", {"drag": 1.5}),
        ("edges", {"gravity": GRAVITY}),
    ],
)
def test_fused_leapfrog_equals_the_plain_scheme(choice, extras):
    springs = GridSprings(11, 13, CHOICES[choice])
    inverse = some_masses(143)
    x, v = crumpled(11, 13)
    expected_x, expected_v, _ = plain_leapfrog(x, v, springs, inverse, 20, 2e-4, **extras)
    GridLeapfrog(springs, inverse, **extras).advance(x, v, 20, 2e-4)
    assert close(x, expected_x, 1e-12)
    assert close(v, expected_v, 1e-11)


@pytest.mark.parametrize(
    ("choice", "dtype", "relative"),
    [("all", np.float64, 1e-11), ("undamped", np.float64, 1e-11), ("all", np.float32, 2e-5)],
)
def test_grips_pull_and_feel_the_pull(choice, dtype, relative):
    springs = GridSprings(11, 13, CHOICES[choice])
    inverse = some_masses(143)
    x, v = crumpled(11, 13)
    grips = some_grips()
    expected_x, expected_v, impulses = plain_leapfrog(x, v, springs, inverse, 20, 2e-4, gravity=GRAVITY, grips=grips)
    GridLeapfrog(springs, inverse, gravity=GRAVITY, dtype=dtype).advance(x, v, 20, 2e-4, grips=grips)
    assert close(x, expected_x, relative)
    assert close(v, expected_v, relative)
    assert close(grips.impulses, impulses, 10 * relative)


def test_work_of_a_grip_is_force_times_the_way_of_its_point():
    """A point that moves steadily does the work impulse times velocity, with the sign of what the cloth gains."""
    springs = GridSprings(1, 2, ())
    velocity = np.array([0.5, -2.0, 1.0])
    for dtype in (np.float64, np.float32):
        grips = GridGrips(
            np.array([1]), np.zeros((1, 3, 4)), np.array([10.0]), np.array([0.1]), np.zeros((1, 3)), np.zeros(1)
        )
        grips.paths[0, :, 1] = velocity
        x = np.array([[5.0, 0.0, 0.0], [0.0, 0.1, 0.2]]).T.copy()
        GridLeapfrog(springs, np.full(2, 100.0), dtype=dtype).advance(x, np.zeros((3, 2)), 10, 1e-3, grips=grips)
        assert np.abs(grips.impulses).max() > 1e-3
        assert close(grips.work[0], -velocity @ grips.impulses[0], 1e-5 if dtype == np.float32 else 1e-13)


def test_anchored_particles_keep_their_velocity():
    springs = GridSprings(5, 5, ALL)
    inverse = some_masses(25)
    x, v = crumpled(5, 5)
    start, speed = x.copy(), v.copy()
    GridLeapfrog(springs, inverse, gravity=GRAVITY, drag=1.0).advance(x, v, 10, 1e-4)
    assert np.array_equal(v[:, [0, 24]], speed[:, [0, 24]])
    assert np.allclose(x[:, [0, 24]], start[:, [0, 24]] + 1e-3 * speed[:, [0, 24]], rtol=0.0, atol=1e-15)


def test_errors_name_the_value():
    with pytest.raises(ValueError, match="no spring family 'left'"):
        GridSprings(2, 2, [GridFamily("left", 1.0, 1.0)])
    with pytest.raises(ValueError, match=r"rest length of 'down' is 0\.0 m"):
        GridSprings(2, 2, [GridFamily("down", 1.0, 0.0)])
    with pytest.raises(ValueError, match=r"x has shape \(3, 5\)"):
        grid_forces(np.zeros((3, 5)), np.zeros((3, 4)), GridSprings(2, 2, ALL), np.zeros((3, 4)))


def weak(families):
    """The same families, all but the edges marked as weak."""
    return tuple(family._replace(weak=family.name not in ("right", "down")) for family in families)


def plain_alternating_leapfrog(x, v, springs, inverse_mass, steps, dt):
    """Weak families at even steps only, twice as strong, 1.5 times at the first and the last step."""
    x, v = x.copy(), v.copy()

    def acceleration(position, velocity, factor):
        families = [family for family in springs.families if factor or not family.weak]
        scaled = [
            family._replace(stiffness=factor * family.stiffness, damping=factor * family.damping)
            if family.weak
            else family
            for family in families
        ]
        return inverse_mass * plain_forces(position, velocity, GridSprings(springs.rows, springs.columns, scaled))

    before = a = acceleration(x, v, 1.0)
    for step in range(steps):
        x += 0.5 * dt * v
        factor = 0.0 if step % 2 else (2.0 if 0 < step < steps - 1 else 1.5)
        factor = 1.0 if steps == 1 else factor
        a, before = acceleration(x, v + 0.25 * dt * (a + before), factor), a
        v += dt * a
        x += 0.5 * dt * v
    return x, v


def test_alternating_families_equal_the_plain_scheme():
    springs = GridSprings(11, 13, weak(ALL))
    inverse = some_masses(143)
    plan = GridLeapfrog(springs, inverse)
    x, v = crumpled(11, 13)
    for steps, dt in ((9, 2e-4), (1, 2e-4), (3, 1e-4)):
        expected_x, expected_v = plain_alternating_leapfrog(x, v, springs, inverse, steps, dt)
        plan.advance(x, v, steps, dt, alternate=True)
        assert close(x, expected_x, 1e-12)
        assert close(v, expected_v, 1e-11)
    with pytest.raises(ValueError, match="10 steps; weak families"):
        plan.advance(x, v, 10, 2e-4, alternate=True)


def smooth(rows, columns):
    """A gently bent sheet in slow motion."""
    down, right = np.meshgrid(np.linspace(0.0, 1.0, rows), np.linspace(0.0, 1.0, columns), indexing="ij")
    x = SPACING * np.stack([(columns - 1) * right, (rows - 1) * down, 2.0 * np.sin(2.0 * right) * down**2])
    v = np.stack([0.0 * right, 0.1 * down * right, 0.2 * down])
    return np.ascontiguousarray(x.reshape(3, -1)), np.ascontiguousarray(v.reshape(3, -1))


def observed_order(springs, *, drag=0.0, alternate=False):
    """Order from three step counts, each against a much finer one."""
    inverse = np.full(springs.rows * springs.columns, 1.0 / MASS)

    def end(steps, alternate):
        x, v = smooth(springs.rows, springs.columns)
        GridLeapfrog(springs, inverse, gravity=GRAVITY, drag=drag).advance(
            x, v, steps, 0.05 / steps, alternate=alternate
        )
        return x

    finest = end(12801, alternate=False)
    errors = [np.abs(end(steps, alternate) - finest).max() for steps in (201, 401, 801)]
    return np.log2(errors[0] / errors[1]), np.log2(errors[1] / errors[2])


def test_damped_leapfrog_is_of_second_order():
    orders = observed_order(GridSprings(8, 9, weak(ALL)), drag=1.5)
    assert all(1.9 < order < 2.1 for order in orders), orders


def test_alternating_undamped_families_are_of_second_order():
    orders = observed_order(GridSprings(8, 9, weak(CHOICES["undamped"])), alternate=True)
    assert all(1.9 < order < 2.15 for order in orders), orders


@pytest.mark.parametrize(
    ("choice", "dtype", "alternate"),
    [("all", np.float32, True), ("all", np.float64, False), ("undamped", np.float64, False)],
)
def test_any_number_of_threads_gives_the_same_bits(choice, dtype, alternate):
    springs = GridSprings(11, 13, weak(CHOICES[choice]))
    results = []
    for threads in (1, 2, 3, 5):
        x, v = crumpled(11, 13)
        grips = some_grips()
        options = {"gravity": GRAVITY, "drag": 1.5, "dtype": dtype}
        plan = GridLeapfrog(springs, some_masses(143), threads=threads, **options)
        for _ in range(3):
            plan.advance(x, v, 7, 2e-4, grips=grips, alternate=alternate)
        results.append((x, v, grips.impulses, grips.work))
    for other in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(results[0], other, strict=True))
    assert np.abs(results[0][0] - crumpled(11, 13)[0]).max() > 1e-4


def test_any_number_of_steps_in_one_sweep_gives_the_same_bits(monkeypatch):
    springs = GridSprings(40, 5, ALL)
    results = []
    for levels, threads in ((1, 1), (3, 1), (2, 2), (4, 2)):
        monkeypatch.setattr(grid_leapfrog, "_levels", lambda *_, levels=levels: levels)
        x, v = crumpled(40, 5)
        plan = GridLeapfrog(springs, some_masses(200), gravity=GRAVITY, drag=1.5, threads=threads)
        plan.advance(x, v, 11, 2e-4, grips=some_grips())
        results.append((x, v))
    for other in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_single_precision_does_not_lose_small_motion():
    """Ten thousand steps, each far below the rounding of the position, add up."""
    springs = GridSprings(1, 2, ())
    x = np.array([[0.0, 3.0], [0.0, 0.0], [0.0, 0.0]])
    v = np.full((3, 2), 1e-4)
    GridLeapfrog(springs, np.ones(2), dtype=np.float32).advance(x, v, 10_000, 1e-4)
    assert np.allclose(x, np.array([[0.0, 3.0], [0.0, 0.0], [0.0, 0.0]]) + 1e-4, rtol=0.0, atol=1e-10)


def test_a_state_that_is_not_finite_leaves_no_trace():
    springs = GridSprings(6, 5, ALL)
    plan = GridLeapfrog(springs, some_masses(30), drag=1.5, gravity=GRAVITY)
    x, v = crumpled(6, 5)
    plan.advance(x, v, 3, 1e-4)
    broken_x, broken_v = crumpled(6, 5)
    broken_x[0, 7] = np.nan
    plan.advance(broken_x, broken_v, 3, 1e-4)
    again_x, again_v = crumpled(6, 5)
    plan.advance(again_x, again_v, 3, 1e-4)
    assert np.array_equal(x, again_x)
    assert np.array_equal(v, again_v)


def test_only_what_the_scene_has_is_in_the_type():
    springs = GridSprings(3, 3, (ALL[0], ALL[1]._replace(damping=0.0)))
    shape = constants(springs, {False: 1.0}, np.float64).shape
    assert isinstance(shape.right, float)  # damped
    assert isinstance(shape.down, int)  # not damped
    assert shape[2:10] == (None,) * 8


def test_c_kernel_computes_the_same_forces():
    compiler = find_compiler()
    if compiler is None:
        pytest.skip("no C compiler")
    springs = GridSprings(19, 23, ALL)
    x, v = crumpled(19, 23)
    for dtype, relative in ((np.float64, 1e-12), (np.float32, 1e-5)):
        kernel = ReferenceKernel(springs, dtype, compiler=compiler)
        kernel.set_state(x, v)
        kernel.evaluate(2)
        assert close(kernel.forces(), plain_forces(x, v, springs), relative)


def test_arrays_that_a_kernel_would_misread_are_refused():
    springs = GridSprings(2, 2, ALL)
    good = np.zeros((3, 4))
    with pytest.raises(ValueError, match="f is float64, not C-contiguous"):
        GridForces(springs).add(good, good, np.zeros((4, 3)).T)
    with pytest.raises(ValueError, match="v is float32; it must be"):
        GridLeapfrog(springs, np.ones(4)).advance(good, good.astype(np.float32), 1, 1e-3)


def test_two_loops_of_a_sheet_share_their_room_and_keep_their_bits():
    springs, inverse = GridSprings(11, 40, weak(CHOICES["all"])), some_masses(440)
    plan = GridLeapfrog(springs, inverse, drag=1.5)
    beside = GridLeapfrog(springs, inverse, drag=1.5, dtype=np.float32, beside=plan)
    assert np.shares_memory(plan._sheet.state, beside._sheet.state)
    results = []
    for double, single in (
        (plan, beside),
        [GridLeapfrog(springs, inverse, drag=1.5, dtype=t) for t in (float, np.float32)],
    ):
        x, v = crumpled(11, 40)
        for loop in (double, single, double, single):
            loop.advance(x, v, 7, 2e-4)
        results.append((x, v))
    assert np.array_equal(results[0], results[1])


@pytest.mark.parametrize("columns", [16, 40])
def test_what_lay_in_the_room_before_changes_no_bit(columns):
    springs, inverse = GridSprings(11, columns, weak(CHOICES["all"])), some_masses(11 * columns)
    for dtype in (np.float64, np.float32):
        results = []
        for byte in (0, 255):
            loop = GridLeapfrog(springs, inverse, drag=1.5, dtype=dtype)
            loop._sheet.state.view(np.uint8)[:] = byte
            x, v = crumpled(11, columns)
            loop.advance(x, v, 7, 2e-4)
            results.append((x, v))
        assert np.isfinite(results[0]).all()
        assert np.array_equal(*results)
