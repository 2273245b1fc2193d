# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A grid's springs and its runs against plain numpy on an index list."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from support.reference_kernel import ReferenceKernel, find_compiler

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.plan import compile

# Offsets (rows, columns) of the far end from the near one, written down again so that the engine's own table is under
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


def family(name, stiffness, reach, damping, border=1.0):
    return GridFamily(name=name, stiffness=stiffness, rest_length=reach * SPACING, damping=damping, border=border)


ALL = (
    family("right", 30.0, 1.0, 0.02, 0.5),
    family("down", 31.0, 1.0, 0.021, 0.5),
    family("diagonal", 12.0, np.sqrt(2.0), 0.01),
    family("antidiagonal", 13.0, np.sqrt(2.0), 0.011),
    family("right2", 3.0, 2.0, 0.004, 0.5),
    family("down2", 3.1, 2.0, 0.005, 0.5),
)
evolve = attrs.evolve
CHOICES = {
    "all": ALL,
    "undamped": tuple(evolve(family, damping=0.0) for family in ALL),
    "edges": ALL[:2],
    "alternating": (*ALL[:2], evolve(ALL[2], parity=0), evolve(ALL[3], parity=1)),
    "rows only": ALL[:1],
    "mixed damping": (ALL[0], evolve(ALL[1], damping=0.0), ALL[5]),
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


def sheet(springs, inverse_mass=None, *, lists=(), gravity=None, drag=0.0, grips=None):
    """The plan of a sheet; particles without an inverse mass are anchored."""
    inverse = np.ones(springs.rows * springs.columns) if inverse_mass is None else inverse_mass
    forces = [springs, *lists]
    forces += [Gravity(gravity)] if gravity is not None else []
    forces += [Drag(drag)] if drag else []
    forces += [grips] if grips is not None else []
    masses = 1.0 / np.where(inverse > 0.0, inverse, 1.0)
    return compile(Model(masses, forces, anchors=np.flatnonzero(inverse == 0.0)))


def run(plan, x, v, steps, dt, **options):
    (done,), _ = plan.runs(0.0, steps * dt, (x, v), [steps], **options)
    return done


def forces(springs, x, v):
    f = np.empty_like(x)
    sheet(springs).accelerations(0.0, x, v, f)
    return f


@pytest.mark.parametrize("choice", CHOICES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 2), (3, 17), (19, 16), (5, 33)])
def test_forces_equal_sum_over_pairs(choice, shape):
    springs = GridSprings(*shape, CHOICES[choice])
    x, v = crumpled(*shape)
    actual, expected = forces(springs, x, v), plain_forces(x, v, springs)
    assert np.abs(actual - expected).max() <= 1e-12 * max(np.abs(expected).max(), 1.0)


@pytest.mark.parametrize("choice", CHOICES)
def test_listed_springs_equal_their_definition(choice):
    springs = GridSprings(6, 9, CHOICES[choice])
    listed, defined = springs.pair_springs, []
    for family in springs.families:
        ends, factor = pairs(springs, family)
        numbers = np.outer(factor, [1.0, family.stiffness, family.damping])
        rest_lengths = np.full(len(factor), family.rest_length)
        defined.append(np.column_stack([np.sort(ends.T, axis=1), rest_lengths, numbers[:, 1:]]))
    actual = np.column_stack([np.sort(listed.pairs, axis=1), listed.rest_length, listed.stiffness, listed.damping])
    expected = np.concatenate(defined)
    by_ends = [np.lexsort(rows[:, :3].T[::-1]) for rows in (actual, expected)]
    assert actual[by_ends[0]] == pytest.approx(expected[by_ends[1]], rel=1e-15)


def test_coincident_particles_stay_finite():
    plan = sheet(GridSprings(4, 5, ALL))
    for single in (False, True):
        done = run(plan, np.zeros((3, 20)), np.ones((3, 20)), 3, 1e-3, single_precision=single)
        assert np.array_equal(done.v, np.ones((3, 20)))


def plain_leapfrog(x, v, springs, inverse_mass, steps, dt, *, gravity=None, drag=0.0, grips=None):
    """The scheme as written in the documentation; impulses [N s] on grips and work [J] besides."""
    free = (inverse_mass > 0.0).astype(float)
    x, v = x.copy(), v.copy()
    booked = None if grips is None else np.zeros((grips.gripper_count, 4))

    def acceleration(t, position, velocity, book):
        f = plain_forces(position, velocity, springs)
        for g in range(0 if grips is None else grips.gripper_count):
            i, path = grips.particles[g], grips.paths[g, 1:13].reshape(4, 3)
            point, speed = path.T @ [1.0, t, t**2, t**3], path.T @ [0.0, 1.0, 2.0 * t, 3.0 * t**2]
            pull = grips.stiffness[g] * (position[:, i] - point) + grips.damping[g] * (velocity[:, i] - speed)
            f[:, i] -= pull
            if book:
                booked[g] += dt * np.append(pull, -pull @ speed)
        a = inverse_mass * f - drag * free * velocity
        return a if gravity is None else a + free * gravity[:, None]

    before = a = acceleration(0.0, x, v, False)
    for step in range(steps):
        x += 0.5 * dt * v
        a, before = acceleration((step + 0.5) * dt, x, v + 0.25 * dt * (a + before), True), a
        v += dt * a
        x += 0.5 * dt * v
    return x, v, booked


def some_masses(count):
    inverse = np.full(count, 1.0 / MASS)
    inverse[::7] = 0.5 / MASS
    inverse[[0, count - 1]] = 0.0
    return inverse


def some_grips():
    """Four grippers, each on a path of its own, hold a particle each."""
    random = np.random.default_rng(4)
    paths = np.zeros((4, PATH_NUMBERS))
    paths[:, 1:13] = 0.1 * random.standard_normal((4, 12))
    paths[:, 16] = 1.0
    grips = Grips(4)
    grips.set_grips(
        paths,
        np.arange(5),
        np.array([3, 18, 19, 130]),
        np.zeros((4, 3)),
        np.array([20.0, 10.0, 30.0, 25.0]),
        np.array([0.1, 0.2, 0.0, 0.1]),
    )
    return grips


@pytest.mark.parametrize(
    ("choice", "extras"),
    [
        ("all", {"gravity": GRAVITY, "drag": 1.5}),
        ("alternating", {}),
        ("undamped", {}),
        ("undamped", {"drag": 1.5}),
        ("edges", {"gravity": GRAVITY}),
    ],
)
def test_run_equals_reference_leapfrog(choice, extras):
    springs, inverse = GridSprings(11, 13, CHOICES[choice]), some_masses(143)
    x, v = crumpled(11, 13)
    expected_x, expected_v, _ = plain_leapfrog(x, v, springs, inverse, 20, 2e-4, **extras)
    done = run(sheet(springs, inverse, **extras), x, v, 20, 2e-4)
    assert close(done.x, expected_x, 1e-12)
    assert close(done.v, expected_v, 1e-11)


@pytest.mark.parametrize(
    ("choice", "single", "relative"), [("all", False, 1e-11), ("undamped", False, 1e-11), ("all", True, 2e-5)]
)
def test_grips_exert_equal_and_opposite_forces(choice, single, relative):
    springs, inverse, grips = GridSprings(11, 13, CHOICES[choice]), some_masses(143), some_grips()
    x, v = crumpled(11, 13)
    expected_x, expected_v, booked = plain_leapfrog(x, v, springs, inverse, 20, 2e-4, gravity=GRAVITY, grips=grips)
    done = run(sheet(springs, inverse, gravity=GRAVITY, grips=grips), x, v, 20, 2e-4, single_precision=single)
    assert close(done.x, expected_x, relative)
    assert close(done.v, expected_v, relative)
    assert close(done.gripper_integrals[:, [0, 1, 2]], booked[:, :3], 10 * relative)
    assert close(done.gripper_integrals[:, 6], booked[:, 3], 10 * relative)


def test_single_precision_independent_of_origin():
    springs, inverse = GridSprings(19, 16, ALL), np.full(304, 1.0 / MASS)
    x, v = crumpled(19, 16)
    plan = sheet(springs, inverse)
    at_origin, at_100_m = (
        run(plan, x, v, 20, 2e-4, single_precision=True),
        run(plan, x + 100.0, v, 20, 2e-4, single_precision=True),
    )
    exact = run(plan, x, v, 20, 2e-4)
    # A map frame far away must not cost digits, but those of the coordinates themselves.
    assert close(at_origin.x, exact.x, 1e-6)
    assert close(at_100_m.x - 100.0, exact.x, 1e-6)


def test_anchored_particles_keep_their_velocity():
    x, v = crumpled(5, 5)
    done = run(sheet(GridSprings(5, 5, ALL), some_masses(25), gravity=GRAVITY, drag=1.0), x, v, 10, 1e-4)
    assert np.array_equal(done.v[:, [0, 24]], v[:, [0, 24]])
    assert np.allclose(done.x[:, [0, 24]], (x + 1e-3 * v)[:, [0, 24]], rtol=0.0, atol=1e-15)


def test_errors_name_the_value():
    with pytest.raises(ValueError, match="no spring family 'left'"):
        GridSprings(2, 2, [family("left", 1.0, 1.0, 0.0)])
    with pytest.raises(ValueError, match=r"rest length of 'down' is 0\.0 m"):
        GridSprings(2, 2, [family("down", 1.0, 0.0, 0.0)])


def smooth(rows, columns):
    """A gently bent sheet in slow motion."""
    down, right = np.meshgrid(np.linspace(0.0, 1.0, rows), np.linspace(0.0, 1.0, columns), indexing="ij")
    x = SPACING * np.stack([(columns - 1) * right, (rows - 1) * down, 2.0 * np.sin(2.0 * right) * down**2])
    v = np.stack([0.0 * right, 0.1 * down * right, 0.2 * down])
    return np.ascontiguousarray(x.reshape(3, -1)), np.ascontiguousarray(v.reshape(3, -1))


def observed_order(springs, drag):
    """Order from three step counts, each against a much finer one."""
    inverse = np.full(springs.rows * springs.columns, 1.0 / MASS)
    plan = sheet(springs, inverse, gravity=GRAVITY, drag=drag)

    def end(steps):
        return run(plan, *smooth(springs.rows, springs.columns), steps, 0.05 / steps).x

    finest = end(12801)
    errors = [np.abs(end(steps) - finest).max() for steps in (201, 401, 801)]
    return np.log2(errors[0] / errors[1]), np.log2(errors[1] / errors[2])


@pytest.mark.parametrize(("choice", "drag"), [("all", 1.5), ("undamped", 0.0)])
def test_leapfrog_is_of_second_order(choice, drag):
    orders = observed_order(GridSprings(8, 9, CHOICES[choice]), drag)
    assert all(1.9 < order < 2.1 for order in orders), orders


def crosswise(rows, columns):
    """Springs between particles far apart, which are a list besides the sheet."""
    first = np.arange(0, rows * columns // 2, 5)
    return PairSprings(np.column_stack([first, rows * columns - 1 - first]), 0.3, 0.5, 0.01)


@pytest.mark.parametrize("shape", [(11, 13), (40, 13), (70, 300)], ids=str)
@pytest.mark.parametrize(
    ("choice", "single"), [("all", True), ("all", False), ("undamped", False), ("alternating", True)]
)
@pytest.mark.parametrize("kind", ["sheet", "sheet and list", "list"])
def test_bits_ignore_number_of_threads(kind, choice, single, shape):
    springs, inverse = GridSprings(*shape, CHOICES[choice]), some_masses(shape[0] * shape[1])
    lists = [crosswise(*shape)] if kind == "sheet and list" else []
    x, v = crumpled(*shape)
    springs = springs.pair_springs if kind == "list" else springs
    plan = sheet(springs, inverse, lists=lists, gravity=GRAVITY, drag=1.5, grips=some_grips())
    for steps in (1, 7, 33):
        # Noted powers would keep all to one thread.
        alone = run(plan, x, v, steps, 1e-4, single_precision=single, threads=1)
        for threads in (2, 3, 16):
            done = run(plan, x, v, steps, 1e-4, single_precision=single, threads=threads)
            for name, actual, expected in zip(done._fields, done, alone, strict=True):
                assert np.array_equal(actual, expected), f"{name} of {steps} steps by {threads} threads"
    assert np.abs(alone.x - x).max() > 1e-4


def test_single_precision_does_not_lose_small_motion():
    """Ten thousand steps, each far below the rounding of the position, add up."""
    x = np.array([[0.0, 3.0], [0.0, 0.0], [0.0, 0.0]])
    done = run(sheet(GridSprings(1, 2, ())), x, np.full((3, 2), 1e-4), 10_000, 1e-4, single_precision=True)
    assert np.allclose(done.x, x + 1e-4, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
def test_non_finite_state_leaves_no_trace(single):
    plan = sheet(GridSprings(6, 5, ALL), some_masses(30), drag=1.5, gravity=GRAVITY)
    x, v = crumpled(6, 5)
    first = run(plan, x, v, 3, 1e-4, single_precision=single)
    broken = x.copy()
    broken[0, 7] = np.nan
    run(plan, broken, v, 3, 1e-4, single_precision=single)
    again = run(plan, x, v, 3, 1e-4, single_precision=single)
    assert np.array_equal(first.x, again.x)
    assert np.array_equal(first.v, again.v)


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
