# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Air on a grid's cells, which the engine takes by rows, against the reference law and the same panels from lists."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from support import laws
from support.alone import of_blocks
from support.instruction_sets import check_digest

from cloth_sim_ros.engine.instruction_set import libraries
from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.model.sheets.surface import grid_cells, grid_hinges
from cloth_sim_ros.physics.plan.plan import compile

SPACING, MASS = 0.05, 2e-3
#: The narrowest ones, and rows that end within, with and just before a vector or a cache line.
SHAPES = [(2, 2), (2, 9), (9, 2), (3, 3), (7, 38), (8, 40), (19, 16), (33, 37)]
#: Largest error of rows in single precision, relative to the largest component.
ROW_ROUNDING = 4e-7
COEFFICIENTS = [(0.45, 0.0), (0.3, 0.1), (0.0, 0.2)]
every_shape = pytest.mark.parametrize("shape", SHAPES)
every_coefficients = pytest.mark.parametrize("coefficients", COEFFICIENTS)


def scene(
    shape,
    coefficients=(0.3, 0.1),
    *,
    wind=(3.0, -1.0, 0.5),
    left_out=0.0,
    as_lists=False,
    collapsed=False,
    damped=True,
    hinges=False,
    order=0,
):
    """A creased sheet of springs and panels, its start, and the panels.

    Without a grid all is taken from lists. `order` is that of the panels in their list and of the corners in them.
    """
    rows, columns = shape
    random = np.random.default_rng(3)
    count = rows * columns
    cells = grid_cells(rows, columns)
    cells = cells[(random.random(len(cells)) >= left_out) | (np.arange(len(cells)) == 0)]
    shuffled = np.random.default_rng(order)
    cells = np.array([np.roll(cell, shuffled.integers(4))[:: shuffled.choice([1, -1])] for cell in cells])
    cells = shuffled.permutation(cells) if order else cells
    families = [
        GridFamily(name=name, stiffness=3.0, rest_length=reach * SPACING, damping=2e-3 * damped)
        for name, reach in (("right", 1.0), ("down", 1.0), ("diagonal", 2.0**0.5), ("antidiagonal", 2.0**0.5))
    ]
    springs = GridSprings(rows, columns, families)
    normal, tangential = coefficients
    air = AirPanels(cells, normal=normal, tangential=tangential, wind=wind)
    forces = [springs.pair_springs if as_lists else springs, air, Gravity((0.0, 0.0, -9.81))]
    if hinges:
        forces.append(AltitudeSprings(grid_hinges(rows, columns), 0.0, 1.0, 1e-3))
    x = np.zeros((3, rows, columns))
    x[0], x[1] = SPACING * np.arange(columns), -SPACING * np.arange(rows)[:, None]
    x = x.reshape(3, -1) + random.uniform(-0.2, 0.2, (3, count)) * SPACING
    if collapsed:
        x[:, cells[0]] = x[:, cells[0][:1]]  # to a point
        x[1:, cells[-1]] = 0.25  # to a line
    v = random.uniform(-0.5, 0.5, (3, count))
    plan = compile(Model(np.full(count, MASS), forces, anchors=[0, columns - 1]))
    return plan, np.ascontiguousarray(x), v


def air_of(plan):
    return next(force for force in plan.model.forces if isinstance(force, AirPanels))


def run(case, steps=24, **options):
    plan, x, v = case
    (done,), _ = plan.runs(0.0, 2e-4 * steps, (x, v), [steps], **options)
    return done


def accelerations(case):
    plan, x, v = case
    out = np.empty_like(x)
    plan.accelerations(0.0, x, v, out)
    return out


def assert_close(actual, expected, rounding):
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=rounding * np.abs(expected).max())


@pytest.mark.parametrize("collapsed", [False, True])
@every_coefficients
@every_shape
def test_forces_of_rows_follow_the_law(shape, coefficients, collapsed):
    case = plan, x, v = scene(shape, coefficients, collapsed=collapsed)
    still = scene(shape, (0.0, 0.0), collapsed=collapsed)
    air = air_of(plan)
    force = laws.air_panels(x, v, air.panels, air.normal, air.tangential, air.wind).force * (
        plan.model.inverse_masses > 0
    )
    assert np.abs(force).max() > 0.0 or shape == (2, 2)
    difference = MASS * (accelerations(case) - accelerations(still))
    np.testing.assert_allclose(difference, force, rtol=0.0, atol=1e-12 * MASS * np.abs(accelerations(case)).max())


@pytest.mark.parametrize("left_out", [0.0, 0.2, 0.7])
@every_coefficients
@every_shape
def test_rows_equal_lists(shape, coefficients, left_out):
    rows, lists = (scene(shape, coefficients, left_out=left_out, as_lists=as_lists) for as_lists in (False, True))
    assert_close(accelerations(rows), accelerations(lists), 1e-13)
    # In single precision rows round less than lists, so that each is compared with double precision.
    exact = run(rows)
    for case, single, rounding in ((lists, False, 1e-13), (rows, True, ROW_ROUNDING), (lists, True, 2e-5)):
        actual = run(case, single_precision=single)
        for a, b in zip(actual.end_state, exact.end_state, strict=True):
            assert_close(a, b, rounding)
    for single in (False, True):
        actual, expected = (
            run(case, single_precision=single, record_power=True).power_integrals for case in (rows, lists)
        )
        np.testing.assert_allclose(
            actual, expected, rtol=0.0, atol=(1e-5 if single else 1e-12) * np.abs(expected).max()
        )
        assert expected[0] > 0.0


def test_rows_ignore_order_of_panels_and_corners():
    actual, expected = accelerations(scene((7, 9))), accelerations(scene((7, 9), order=1))
    assert np.array_equal(actual, expected)


def test_panels_off_cells_and_duplicates_act():
    rows, columns = 6, 7
    cells = grid_cells(rows, columns)
    for odd in ([0, 1, 9, 2], cells[3], [0, 1, columns, columns + 1]):
        plan, x, v = scene((rows, columns))
        panels = AirPanels([*cells, odd], normal=0.3, tangential=0.1, wind=(1.0, 2.0, 3.0))
        plan = compile(Model(np.full(rows * columns, MASS), [plan.model.forces[0], panels]))
        expected = compile(Model(np.full(rows * columns, MASS), [plan.model.forces[0].pair_springs, panels]))
        assert_close(accelerations((plan, x, v)), accelerations((expected, x, v)), 1e-13)


def test_second_list_of_cells_acts():
    plan, x, v = scene((6, 7))
    more = AirPanels(grid_cells(6, 7), normal=0.9, tangential=0.1)
    more.name = "more air"
    actual, expected = (
        compile(Model(np.full(42, MASS), [springs, *plan.model.forces[1:], more]))
        for springs in (plan.model.forces[0], plan.model.forces[0].pair_springs)
    )
    assert_close(accelerations((actual, x, v)), accelerations((expected, x, v)), 1e-13)
    assert actual.spectral_bounds(x) == pytest.approx(of_blocks(expected, x), rel=1e-5)


@pytest.mark.parametrize("wind", [(0.0, 0.0, 0.0), (30.0, -1.0, 0.5)])
@pytest.mark.parametrize("damped", [True, False])
@every_coefficients
@every_shape
def test_row_bounds_equal_law_bounds(shape, coefficients, damped, wind):
    scaled = tuple(1e3 * coefficient for coefficient in coefficients)
    plan, x, _ = scene(shape, scaled, damped=damped, wind=wind)
    # With drag along the surface alone the two largest eigenvalues may be alike: single precision knows them less well.
    assert plan.spectral_bounds(x) == pytest.approx(of_blocks(plan, x), rel=1e-5 if coefficients[0] else 1e-3)
    assert plan.spectral_bounds(x)[1] > scene(shape, (0.0, 0.0), damped=damped)[0].spectral_bounds(x)[1]


@pytest.mark.parametrize("hinges", [False, True])
@pytest.mark.parametrize("single", [False, True])
def test_bits_ignore_threads_and_recorded_powers(single, hinges):
    case = scene((130, 97), hinges=hinges)
    alone = run(case, single_precision=single, threads=1).end_state
    for threads in (2, 5, 8, 16):
        np.testing.assert_array_equal(run(case, single_precision=single, threads=threads).end_state, alone)
    np.testing.assert_array_equal(run(case, single_precision=single, record_power=True).end_state, alone)


def test_multirate_hinges_leave_air_unchanged():
    rows, lists = (scene((19, 16), hinges=True, as_lists=as_lists) for as_lists in (False, True))
    assert_close(run(rows, multirate=3).end_state[0], run(lists, multirate=3).end_state[0], 1e-13)


def test_new_wind_acts_in_rows():
    plan, x, v = scene((7, 9), wind=(0.0, 0.0, 0.0))
    blown = air_of(plan).in_wind((4.0, 2.0, 1.0))
    before = accelerations((plan, x, v))
    forces = [blown if isinstance(force, AirPanels) else force for force in plan.model.forces]
    uniform = [force for force in forces if isinstance(force, Gravity)]
    plan.change_uniform(forces, uniform, air_coefficients=blown.coefficients)
    after = accelerations((plan, x, v))
    assert np.abs(after - before).max() > 0.1
    assert np.array_equal(after, accelerations(scene((7, 9), wind=(4.0, 2.0, 1.0))))


def digest() -> str:
    """Of runs by the engine that the process has."""
    sha = hashlib.sha256()
    for shape in SHAPES:
        for coefficients in COEFFICIENTS:
            case = scene(shape, coefficients)
            sha.update(accelerations(case).tobytes())
            sha.update(np.array(case[0].spectral_bounds(case[1])).tobytes())
            for single in (False, True):
                done = run(case, single_precision=single, record_power=True)
                sha.update(done.end_state.tobytes() + done.integrals.tobytes())
    return sha.hexdigest()


@pytest.mark.parametrize("name", libraries())
def test_no_bit_depends_on_the_instruction_set(name):
    check_digest(__file__, name, digest())
