# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Added mass on a grid's cells, which the engine evaluates by rows, against the same panels from lists."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from support.instruction_sets import check_digest

from cloth_sim_ros.engine.instruction_set import libraries
from cloth_sim_ros.physics.model.forces.added_mass import AddedMass
from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.model.sheets.surface import grid_cells, grid_hinges
from cloth_sim_ros.physics.plan.plan import compile

SPACING, MASS, DENSITY = 0.05, 2e-3, 0.5
#: The narrowest ones, and rows that end within, with and just before a vector or a cache line.
SHAPES = [(2, 2), (2, 9), (9, 2), (3, 3), (7, 38), (8, 40), (19, 16), (33, 37)]
every_shape = pytest.mark.parametrize("shape", SHAPES)


def scene(shape, *, wind=(3.0, -1.0, 0.5), left_out=0.0, as_lists=False, damped=True, hinges=False, drag=0.3):
    """A creased sheet of springs that carries air, and its start; without a grid all is taken from lists."""
    rows, columns = shape
    random = np.random.default_rng(3)
    cells = grid_cells(rows, columns)
    cells = cells[(random.random(len(cells)) >= left_out) | (np.arange(len(cells)) == 0)]
    families = [
        GridFamily(name=name, stiffness=3.0, rest_length=reach * SPACING, damping=2e-3 * damped)
        for name, reach in (("right", 1.0), ("down", 1.0), ("diagonal", 2.0**0.5), ("antidiagonal", 2.0**0.5))
    ]
    springs = GridSprings(rows, columns, families)
    forces = [springs.pair_springs if as_lists else springs, AddedMass(cells, density=DENSITY, wind=wind)]
    forces.append(Gravity((0.0, 0.0, -9.81)))
    if drag:
        forces.append(AirPanels(cells, normal=drag, tangential=0.0, wind=wind))
    if hinges:
        forces.append(AltitudeSprings(grid_hinges(rows, columns), 0.0, 1.0, 1e-3))
    x = np.zeros((3, rows, columns))
    x[0], x[1] = SPACING * np.arange(columns), -SPACING * np.arange(rows)[:, None]
    x = x.reshape(3, -1) + random.uniform(-0.2, 0.2, (3, rows * columns)) * SPACING
    v = random.uniform(-0.5, 0.5, x.shape)
    v[:, [0, columns - 1]] = 0.0
    plan = compile(Model(np.full(rows * columns, MASS), forces, anchors=[0, columns - 1]))
    return plan, np.ascontiguousarray(x), v


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


@pytest.mark.parametrize("left_out", [0.0, 0.2, 0.7])
@pytest.mark.parametrize("damped", [True, False])
@every_shape
def test_rows_equal_lists(shape, left_out, damped):
    options = {"left_out": left_out, "damped": damped, "drag": 0.3 * damped}
    rows, lists = (scene(shape, as_lists=as_lists, **options) for as_lists in (False, True))
    assert_close(accelerations(rows), accelerations(lists), 1e-13)
    exact = run(rows)
    for case, single, rounding in ((lists, False, 1e-13), (rows, True, 2e-6), (lists, True, 2e-5)):
        for a, b in zip(run(case, single_precision=single).end_state, exact.end_state, strict=True):
            assert_close(a, b, rounding)


@every_shape
def test_anchored_particles_stay(shape):
    case = scene(shape)
    end = run(case)
    assert np.array_equal(end.x[:, [0, shape[1] - 1]], case[1][:, [0, shape[1] - 1]])


@pytest.mark.parametrize("hinges", [False, True])
@pytest.mark.parametrize("single", [False, True])
def test_bits_ignore_threads_and_recorded_powers(single, hinges):
    case = scene((130, 97), hinges=hinges)
    alone = run(case, single_precision=single, threads=1).end_state
    for threads in (2, 5, 8, 16):
        np.testing.assert_array_equal(run(case, single_precision=single, threads=threads).end_state, alone)
    np.testing.assert_array_equal(run(case, single_precision=single, record_power=True).end_state, alone)


@pytest.mark.parametrize("as_lists", [False, True])
def test_bits_of_lists_ignore_threads(as_lists):
    case = scene((40, 37), hinges=True, as_lists=as_lists)
    alone = run(case, multirate=3, threads=1).end_state
    np.testing.assert_array_equal(run(case, multirate=3, threads=2).end_state, alone)


def test_multirate_rows_equal_lists():
    rows, lists = (scene((19, 16), hinges=True, as_lists=as_lists) for as_lists in (False, True))
    assert_close(run(rows, multirate=3).end_state[0], run(lists, multirate=3).end_state[0], 1e-13)


def test_panels_off_cells_carry_air():
    cells = grid_cells(6, 7)
    plan, x, v = scene((6, 7))
    panels = AddedMass([*cells, [0, 1, 9, 2]], density=DENSITY, wind=(1.0, 2.0, 3.0))
    springs = plan.model.forces[0]
    actual, expected = (compile(Model(np.full(42, MASS), [part, panels])) for part in (springs, springs.pair_springs))
    assert_close(accelerations((actual, x, v)), accelerations((expected, x, v)), 1e-13)
    assert_close(run((actual, x, v)).end_state, run((expected, x, v)).end_state, 1e-13)


def test_second_force_of_added_mass_is_refused():
    plan, _, _ = scene((6, 7))
    more = AddedMass(grid_cells(6, 7), density=1.0)
    more.name = "more air"
    with pytest.raises(ValueError, match="two forces of a model have added mass"):
        compile(Model(np.full(42, MASS), [*plan.model.forces, more]))


def test_still_air_leaves_bounds_unchanged():
    plan, x, _ = scene((7, 38), wind=(0.0, 0.0, 0.0))
    other_forces = [force for force in plan.model.forces if not isinstance(force, AddedMass)]
    without = compile(Model(plan.model.masses, other_forces, anchors=plan.model.anchors))
    assert plan.spectral_bounds(x) == without.spectral_bounds(x)
    assert scene((7, 38), wind=(30.0, 0.0, 0.0))[0].spectral_bounds(x)[1] > 1.01 * plan.spectral_bounds(x)[1]


def test_new_wind_acts_in_rows():
    plan, x, v = scene((7, 9), wind=(0.0, 0.0, 0.0))
    wind = (4.0, 2.0, 1.0)
    forces = [f.in_wind(wind) if isinstance(f, (AddedMass, AirPanels)) else f for f in plan.model.forces]
    uniform = [force for force in forces if isinstance(force, Gravity)]
    plan.change_uniform(forces, uniform, air_coefficients=np.array([0.3, 0.0, *wind]))
    assert np.array_equal(accelerations((plan, x, v)), accelerations(scene((7, 9), wind=wind)))


def digest() -> str:
    """Of runs by the engine that the process has."""
    sha = hashlib.sha256()
    for shape in SHAPES:
        for as_lists in (False, True):
            case = scene(shape, as_lists=as_lists)
            plan, x, v = case
            sha.update(accelerations(case).tobytes() + plan.mass_blocks(x).tobytes())
            sha.update(np.array([*plan.spectral_bounds(x), plan.energy(0.0, x, v)]).tobytes())
            for single in (False, True):
                done = run(case, single_precision=single, record_power=True)
                sha.update(done.end_state.tobytes() + done.integrals.tobytes())
    return sha.hexdigest()


@pytest.mark.parametrize("name", libraries())
def test_no_bit_depends_on_the_instruction_set(name):
    check_digest(__file__, name, digest())
