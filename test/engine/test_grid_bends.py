# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hinges of a grid, which the engine takes by rows, against the same hinges taken from lists."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from support.instruction_sets import check_digest

from cloth_sim_ros.engine.instruction_set import libraries
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.crossed import CrossedSprings
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.opposite import OppositeSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.model.sheets.surface import grid_hinges
from cloth_sim_ros.physics.plan.plan import compile

SPACING = 0.05
KINDS = ("altitude", "crossed")
SHAPES = [(8, 9), (19, 16), (33, 37)]


def scene(kind, shape, *, damped=True, left_out=0.0, as_lists=False, twice=False, order=0):
    """A creased sheet whose hinges differ from each other, with springs between their wings; and its start.

    The same hinge written from the other end of its edge lies on the grid in no way that rows know: with one of them in
    it a list is taken as a list. `order` is the hinges' in their list.
    """
    rows, columns = shape
    random = np.random.default_rng(3)
    count = rows * columns
    hinges = grid_hinges(rows, columns)
    hinges = hinges[random.random(len(hinges)) >= left_out]
    if twice:
        hinges = np.concatenate([hinges, hinges[:1]])
    numbers = np.stack(
        [
            random.uniform(-0.3, 0.3, len(hinges)) * SPACING,
            random.uniform(0.5, 2.0, len(hinges)),
            random.uniform(1e-3, 4e-3, len(hinges)) * damped,
        ]
    )
    shuffled = np.random.default_rng(order).permutation(len(hinges))
    hinges, numbers = hinges[shuffled], numbers[:, shuffled]
    index = np.arange(count).reshape(rows, columns)
    pairs = np.concatenate(
        [
            np.stack([index[:, :-2].ravel(), index[:, 2:].ravel()], axis=1),
            np.stack([index[:-2].ravel(), index[2:].ravel()], axis=1),
        ]
    )
    soft = random.uniform(0.1, 0.3, len(pairs))
    if as_lists:
        hinges[0] = hinges[0][[1, 0, 3, 2]]
        pairs[0] = pairs[0][::-1]
    bends = (
        AltitudeSprings(hinges, *numbers)
        if kind == "altitude"
        else CrossedSprings(hinges[:, :2], hinges[:, 2:], *numbers)
    )
    wings = OppositeSprings(pairs, 2.0 * SPACING, soft, 1e-4 * damped)
    families = [
        GridFamily(name=name, stiffness=3.0, rest_length=reach * SPACING, damping=2e-3 * damped)
        for name, reach in (("right", 1.0), ("down", 1.0), ("diagonal", 2.0**0.5), ("antidiagonal", 2.0**0.5))
    ]
    forces = [GridSprings(rows, columns, families), bends, wings, Gravity((0.0, 0.0, -9.81))]
    if damped:
        forces.append(Drag(0.4))
    x = np.zeros((3, rows, columns))
    x[0], x[1] = SPACING * np.arange(columns), -SPACING * np.arange(rows)[:, None]
    x = x.reshape(3, -1) + random.uniform(-0.2, 0.2, (3, count)) * SPACING
    v = random.uniform(-0.5, 0.5, (3, count))
    return compile(Model(np.full(count, 2e-3), forces, anchors=[0, columns - 1])), np.ascontiguousarray(x), v


def run(case, steps=24, **options):
    plan, x, v = case
    (done,), _ = plan.runs(0.0, 2e-4 * steps, (x, v), [steps], **options)
    return done


def accelerations(case):
    plan, x, v = case
    out = np.empty_like(x)
    plan.accelerations(0.0, x, v, out)
    return out


@pytest.mark.parametrize("left_out", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("damped", [True, False])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", KINDS)
def test_rows_equal_lists(kind, shape, damped, left_out):
    options = {"damped": damped, "left_out": left_out}
    rows, lists = scene(kind, shape, **options), scene(kind, shape, **options, as_lists=True)
    actual, expected = accelerations(rows), accelerations(lists)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-13 * scale)
    # Rows know no order of the hinges; sparse ones are taken from lists.
    shuffled = accelerations(scene(kind, shape, **options, order=1))
    assert np.array_equal(actual, shuffled) == (left_out < 0.6)
    for single, rounding in ((False, 1e-13), (True, 1e-6)):
        actual, expected = run(rows, single_precision=single).end_state, run(lists, single_precision=single).end_state
        for a, b in zip(actual, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=0.0, atol=rounding * np.abs(b).max())
        assert np.isfinite(actual).all()


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("damped", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_bits_ignore_threads_and_recorded_powers(kind, damped, single):
    case = scene(kind, (130, 97), damped=damped)
    alone = run(case, single_precision=single, threads=1).end_state
    for threads in (2, 5, 8, 16):
        np.testing.assert_array_equal(run(case, single_precision=single, threads=threads).end_state, alone)
    np.testing.assert_array_equal(run(case, single_precision=single, record_power=True).end_state, alone)


@pytest.mark.parametrize("kind", KINDS)
def test_dissipation_is_recorded(kind):
    rows, lists = scene(kind, (19, 16)), scene(kind, (19, 16), as_lists=True)
    for single, rounding in ((False, 1e-12), (True, 1e-5)):
        actual, expected = (
            run(case, single_precision=single, record_power=True).power_integrals for case in (rows, lists)
        )
        assert expected[0] > 0.0
        np.testing.assert_allclose(actual, expected, rtol=rounding)


@pytest.mark.parametrize("kind", KINDS)
def test_duplicate_hinges_both_act(kind):
    rows, lists = scene(kind, (8, 9), twice=True), scene(kind, (8, 9), twice=True, as_lists=True)
    actual, expected = accelerations(rows), accelerations(lists)
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())


def digest() -> str:
    """Of runs by the engine that the process has."""
    sha = hashlib.sha256()
    for kind in KINDS:
        for shape in SHAPES:
            for damped in (True, False):
                case = scene(kind, shape, damped=damped)
                sha.update(accelerations(case).tobytes())
                for single in (False, True):
                    done = run(case, single_precision=single, record_power=True)
                    sha.update(done.end_state.tobytes() + done.integrals.tobytes())
    return sha.hexdigest()


@pytest.mark.parametrize("name", libraries())
def test_no_bit_depends_on_the_instruction_set(name):
    check_digest(__file__, name, digest())
