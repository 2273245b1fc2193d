# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quadratic hinges of a grid, which the engine evaluates by rows, against the same hinges from lists."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from support.instruction_sets import check_digest

from cloth_sim_ros.engine.instruction_set import libraries
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.quadratic import QuadraticHinges
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.model.sheets.bending import grid_hinge_weights
from cloth_sim_ros.physics.model.sheets.surface import grid_hinges
from cloth_sim_ros.physics.plan.plan import compile

HX, HY, MASS = 0.05, 0.04, 2e-3
SHAPES = [(2, 2), (2, 9), (9, 2), (3, 3), (7, 38), (8, 40), (19, 16), (33, 37)]
every_shape = pytest.mark.parametrize("shape", SHAPES)


def scene(shape, *, damped=True, left_out=0.0, as_lists=False, order=0, altitude=False):
    """A creased sheet whose hinges differ from each other, and its start.

    One weight with a rounding error leaves the rows: then the engine takes all hinges from a list.
    """
    rows, columns = shape
    random = np.random.default_rng(3)
    count = rows * columns
    hinges = grid_hinges(rows, columns)
    hinges = hinges[random.random(len(hinges)) >= left_out]
    stiffness = random.uniform(0.5e-3, 2e-3, len(hinges))
    shuffled = np.random.default_rng(order).permutation(len(hinges))
    hinges, stiffness = hinges[shuffled], stiffness[shuffled]
    weights = grid_hinge_weights(hinges, columns=columns, spacing=(HX, HY))
    if as_lists and len(weights):
        weights[0] *= [1.0 + 4e-16, 1.0, 1.0 + 4e-16, 1.0]
    families = [
        GridFamily(name=name, stiffness=3.0, rest_length=length, damping=2e-3 * damped)
        for name, length in (("right", HX), ("down", HY), ("diagonal", 0.064), ("antidiagonal", 0.064))
    ]
    bends = QuadraticHinges(hinges, weights, stiffness, 3e-3 * damped)
    forces = [GridSprings(rows, columns, families), bends, Gravity((0.0, 0.0, -9.81))]
    if damped:
        forces.append(Drag(0.4))
    if altitude:
        forces.append(AltitudeSprings(grid_hinges(rows, columns), 0.0, 0.5, 1e-3))
    x = np.zeros((3, rows, columns))
    x[0], x[1] = HX * np.arange(columns), -HY * np.arange(rows)[:, None]
    x = x.reshape(3, -1) + random.uniform(-0.2, 0.2, (3, count)) * HX
    v = random.uniform(-0.5, 0.5, (3, count))
    v[:, [0, columns - 1]] = 0.0
    return compile(Model(np.full(count, MASS), forces, anchors=[0, columns - 1])), np.ascontiguousarray(x), v


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


@pytest.mark.parametrize("left_out", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("damped", [True, False])
@every_shape
def test_rows_equal_lists(shape, damped, left_out):
    options = {"damped": damped, "left_out": left_out}
    rows, lists = (scene(shape, as_lists=as_lists, **options) for as_lists in (False, True))
    assert_close(accelerations(rows), accelerations(lists), 1e-13)
    exact = run(rows)
    for case, single, rounding in ((lists, False, 1e-13), (rows, True, 2e-6), (lists, True, 2e-5)):
        for a, b in zip(run(case, single_precision=single).end_state, exact.end_state, strict=True):
            assert_close(a, b, rounding)


def test_rows_ignore_the_order_of_hinges_up_to_rounding():
    assert_close(accelerations(scene((19, 16), order=1)), accelerations(scene((19, 16))), 1e-14)


@every_shape
def test_bounds_of_rows_equal_those_of_lists(shape):
    rows, lists = (scene(shape, as_lists=as_lists) for as_lists in (False, True))
    # Outliers of lists get weights of their own, so their bound may be lower.
    for a, b in zip(rows[0].spectral_bounds(rows[1]), lists[0].spectral_bounds(lists[1]), strict=True):
        assert b <= a * (1.0 + 3e-4)
        assert a <= 1.5 * b


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("damped", [True, False])
@pytest.mark.parametrize("altitude", [True, False])
def test_bits_ignore_threads_and_recorded_powers(damped, single, altitude):
    case = scene((90, 35) if altitude else (130, 97), damped=damped, altitude=altitude)
    alone = run(case, single_precision=single, threads=1).end_state
    for threads in (2, 16):
        np.testing.assert_array_equal(run(case, single_precision=single, threads=threads).end_state, alone)
    np.testing.assert_array_equal(run(case, single_precision=single, record_power=True).end_state, alone)


def test_multirate_rows_equal_lists():
    rows, lists = (scene((19, 16), altitude=True, as_lists=as_lists) for as_lists in (False, True))
    assert_close(run(rows, multirate=3).end_state[0], run(lists, multirate=3).end_state[0], 1e-13)


def test_dissipation_is_recorded():
    rows, lists = scene((19, 16)), scene((19, 16), as_lists=True)
    for single, rounding in ((False, 1e-12), (True, 1e-5)):
        actual, expected = (
            run(case, single_precision=single, record_power=True).power_integrals for case in (rows, lists)
        )
        assert expected[0] > 0.0
        np.testing.assert_allclose(actual, expected, rtol=rounding)


def digest() -> str:
    """Of runs by the engine that the process has."""
    sha = hashlib.sha256()
    for shape in SHAPES:
        for damped in (True, False):
            case = scene(shape, damped=damped)
            for single in (False, True):
                sha.update(run(case, single_precision=single).x.tobytes())
            sha.update(accelerations(case).tobytes())
    return sha.hexdigest()


@pytest.mark.parametrize("name", libraries())
def test_no_bit_depends_on_the_instruction_set(name):
    check_digest(__file__, name, digest())
