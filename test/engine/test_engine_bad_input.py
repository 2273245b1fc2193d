# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bad input at the engine's boundary: an error that names the argument, never a crash nor a silent result."""

import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.arithmetic.arrays import combine, largest_distance, weighted_dot
from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.crossed import CrossedSprings
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.opposite import OppositeSprings
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.forces.wind import Wind
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.plan import compile

N = 8
NAN, INF = math.nan, math.inf
#: For each force its arguments, one good one and many bad ones for each, and the name by which the error tells it.
PAIRS = [[0, 1], [1, 2]]
BAD_NUMBERS = [NAN, INF, -1.0, [1.0], [1.0, NAN], [1.0, -2.0], [[1.0, 2.0]], "many", [1.0, 2.0, 3.0], {}, 1j]
BAD_PAIRS = [[[0, N]], [[-1, 2]], [[0, 1, 2]], [0, 1], [[0.0, 1.5]], [["a", "b"]], [[0, 1], [2]], [[2**63, 1]], 3]
BAD_HINGES = [
    [[0, 1, 2, N], [0, 1, 2, 3]],
    [[0, 1, 2]],
    [[0, 1, 2, 2], [0, 1, 2, 3]],
    [[0, 1, 2, -3]],
    [[0.5, 1, 2, 3]],
    [[0, 1, 2, 3], [4]],
]
BAD_VECTORS = [9.81, [1.0, 2.0], [1.0, 2.0, NAN], [INF, 0.0, 0.0], "down", [[0.0, 0.0, 1.0]], {}]
BAD_NUMBER = [NAN, INF, -1.0, [1.0, 2.0], "much", {}]

PAIR = {"pairs": PAIRS, "rest_length": 1.0, "stiffness": 2.0, "damping": 0.5}
HINGE = {"rest_length": [0.1, -0.1], "stiffness": 2.0, "damping": 0.5}
PANEL = {"panels": [[0, 1, 2]], "normal": 1.0, "tangential": 0.5, "wind": (1.0, 0.0, 0.0)}
HINGE_NUMBERS = {"rest_length": [n for n in BAD_NUMBERS if n != -1.0 and n != [1.0, -2.0]]} | {
    name: BAD_NUMBERS for name in ("stiffness", "damping")
}
CASES = [
    (PairSprings, PAIR, {"pairs": BAD_PAIRS, **{name: BAD_NUMBERS for name in list(PAIR)[1:]}}),
    (
        OppositeSprings,
        {"wings": PAIRS, "rest_length": 1.0, "stiffness": 2.0, "damping": 0.5},
        {"wings": BAD_PAIRS, "rest_length": [*BAD_NUMBERS, 0.0], "stiffness": BAD_NUMBERS, "damping": BAD_NUMBERS},
    ),
    (
        CrossedSprings,
        {"edges": PAIRS, "wings": [[2, 3], [4, 5]], **HINGE},
        {"edges": [*BAD_PAIRS, [[0, 1]], [[0, 0], [1, 2]]], "wings": [*BAD_PAIRS, []], **HINGE_NUMBERS},
    ),
    (AltitudeSprings, {"quads": [[0, 1, 2, 3], [1, 2, 3, 4]], **HINGE}, {"quads": BAD_HINGES, **HINGE_NUMBERS}),
    (
        AirPanels,
        PANEL,
        {
            "panels": [[], [[0, 1]], [[0, 1, N]], [[0, 1, -2]], [[0, 1, 2.5]], [[0, 1, 2], [0, 1]], 7, "skin"],
            "normal": BAD_NUMBER,
            "tangential": BAD_NUMBER,
            "wind": BAD_VECTORS,
        },
    ),
    (Gravity, {"acceleration": [0.0, 0.0, -9.81]}, {"acceleration": BAD_VECTORS}),
    (Drag, {"rate": 1.0}, {"rate": BAD_NUMBER}),
    (Wind, {"velocity": [1.0, 0.0, 0.0], "rate": 1.0}, {"velocity": BAD_VECTORS, "rate": BAD_NUMBER}),
]
#: What an error may call an argument.
CALLED = {
    "pairs": "pairs|joins",
    "quads": "hinge",
    "edges": "edges|hinge",
    "wings": "wings|hinge|pairs",
    "wind": "wind",
    "velocity": "wind",
    "rate": "rate",
    "normal": "normal",
    "rest_length": "rest_length|rest length",
}


@pytest.mark.parametrize(
    ("kind", "good", "name", "bad"),
    [(kind, good, name, value) for kind, good, bad in CASES for name, values in bad.items() for value in values],
)
def test_an_argument_that_is_none_is_refused_by_its_name(kind, good, name, bad):
    compile(Model(np.ones(N), [kind(**good)]))
    with pytest.raises((ValueError, TypeError), match=CALLED.get(name, name)):
        compile(Model(np.ones(N), [kind(**{**good, name: bad})]))


FAMILY = {"name": "right", "stiffness": 1.0, "rest_length": 1.0, "damping": 0.1, "border": 0.5, "parity": None}
BAD_FAMILIES = {
    "name": ["sideways", ""],
    "stiffness": BAD_NUMBER,
    "rest_length": [*BAD_NUMBER, 0.0],
    "damping": BAD_NUMBER,
    "border": BAD_NUMBER,
    "parity": [2, -1, "even", 0.5],
}


@pytest.mark.parametrize(("name", "bad"), [(name, bad) for name, values in BAD_FAMILIES.items() for bad in values])
def test_a_familys_property_that_is_none_is_refused(name, bad):
    GridSprings(2, 3, [GridFamily(**FAMILY)])
    with pytest.raises(ValueError, match=name.replace("_", " ") if name != "name" else "no spring family"):
        GridSprings(2, 3, [GridFamily(**{**FAMILY, name: bad})])


@pytest.mark.parametrize(("rows", "columns"), [(0, 6), (-2, -3), (2.0, 3), (2, "3"), (None, 6), (2, 2), (3, 3)])
def test_invalid_sheet_is_refused(rows, columns):
    with pytest.raises(ValueError, match="sheet of"):
        compile(Model(np.ones(N), [GridSprings(rows, columns, [GridFamily(**FAMILY)])]))


GRIPS = {
    "paths": np.zeros((1, PATH_NUMBERS)),
    "starts": np.array([0, 2]),
    "particles": np.array([2, 4]),
    "offsets": np.zeros((2, 3)),
    "stiffness": np.array([7.0, 8.0]),
    "damping": np.array([0.1, 0.2]),
}
BAD_GRIPS = {
    "paths": [np.zeros((0, PATH_NUMBERS)), np.zeros((1, 5)), np.full((1, PATH_NUMBERS), NAN), None],
    "starts": [np.array(s) for s in ([0], [0, 1], [0, 3], [0, -1], [1, 0], [1, 3], [0, 1, 2], [0.0, 2.0], [])],
    "particles": [np.array(p) for p in ([2, N], [-1, 2], [1.5, 2.0], [2], [1, 2, 3], [])],
    "offsets": [np.zeros((2, 2)), np.zeros((0, 3)), np.full((2, 3), NAN), np.zeros((3, 2)), "far"],
    "stiffness": [np.array(k) for k in ([1.0], [1.0, NAN], [1.0, -1.0], [1.0, INF])] + [None, "firm"],
    "damping": [np.array(k) for k in ([1.0], [1.0, NAN], [1.0, -1.0], [1.0, 2.0, 3.0])] + [None],
}


@pytest.mark.parametrize(("name", "bad"), [(name, bad) for name, values in BAD_GRIPS.items() for bad in values])
def test_what_no_gripper_holds_is_refused(name, bad):
    grips, x = Grips(1), np.zeros((3, N))
    plan = compile(Model(np.ones(N), [grips]))
    grips.set_grips(**GRIPS)
    plan.spectral_bounds(x)
    # What is wrong with the numbers of particles and starts is told of both.
    words = "particles|starts" if name in ("particles", "starts") else name
    grips.set_grips(**{**GRIPS, name: bad})
    for ask in (
        lambda: plan.spectral_bounds(x),
        lambda: plan.runs(0.0, 0.01, (x, x), [1]),
        lambda: plan.accelerations(0.0, x, x, x),
    ):
        with pytest.raises(ValueError, match=words):
            ask()
    grips.set_grips(**GRIPS)
    plan.spectral_bounds(x)


@pytest.mark.parametrize("count", [-1, 1.5, None, "two"])
def test_a_number_of_grippers_that_is_none_is_refused(count):
    with pytest.raises(ValueError, match="gripper_count"):
        Grips(count)


@pytest.mark.parametrize(
    ("masses", "forces", "anchors", "words"),
    [
        ([], [], [], "masses have shape"),
        ([[1.0]], [], [], "masses have shape"),
        ("heavy", [], [], "masses are"),
        ([1.0, -1.0], [], [], "mass of particle 1"),
        ([1.0, NAN], [], [], "mass of particle 1"),
        ([1.0, 1.0], [None], [], "among the forces"),
        ([1.0, 1.0], [], [2], "anchors"),
        ([1.0, 1.0], [], [-1], "anchors"),
        ([1.0, 1.0], [], [0.5], "anchors"),
        ([1.0, 1.0], [], ["first"], "anchors"),
        ([1.0, 1.0], [Grips(1), Grips(1)], [], "two forces"),
    ],
)
def test_what_is_no_model_is_refused(masses, forces, anchors, words):
    with pytest.raises(ValueError, match=words):
        compile(Model(masses, forces, anchors=anchors))


def some_plan(listed):
    grips = Grips(1)
    grips.set_grips(**GRIPS)
    families = [GridFamily(**{**FAMILY, "name": name}) for name in ("right", "down")]
    springs = PairSprings(PAIRS, 1.0, 2.0, 0.5) if listed else GridSprings(2, 4, families)
    return compile(Model(np.ones(N), [springs, grips, Drag(0.1)]))


PLANS = {"listed": some_plan(True), "sheet": some_plan(False)}
over_plans = pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS.keys())


def strange(shape):
    """Arrays that are not C-contiguous float64 of a shape."""
    rows, columns = shape
    whole = np.arange(2.0 * rows * columns).reshape(rows, 2 * columns)
    return {
        "nothing": None,
        "a list": whole[:, :columns].tolist(),
        "flat": whole[:, :columns].ravel(),
        "turned": np.ascontiguousarray(whole[:, :columns].T),
        "fewer": np.ascontiguousarray(whole[:, : columns - 1]),
        "more": np.zeros((rows, columns + 1)),
        "a row less": np.zeros((rows - 1, columns)),
        "empty": np.zeros((0, 0)),
        "strided": whole[:, ::2],
        "reversed": whole[:, columns - 1 :: -1],
        "by columns": np.asfortranarray(whole[:, :columns]),
        "single": np.zeros(shape, np.float32),
        "whole": np.zeros(shape, np.int64),
        "other end first": np.zeros(shape, ">f8"),
        "complex": np.zeros(shape, np.complex128),
        "objects": np.zeros(shape, object),
    }


def good(shape=(3, N)):
    return np.random.default_rng(1).standard_normal(shape)


def read_only(shape=(3, N)):
    array = np.zeros(shape)
    array.flags.writeable = False
    return array


#: Each call that takes arrays, with the arrays by the names that errors call them, and those that are written.
CALLS = {
    "runs": (lambda p, x, v: p.runs(0.0, 0.01, (x, v), [2, 3], weights=[-1.0, 2.0]), "x v", ""),
    "accelerations": (lambda p, x, v, out: p.accelerations(0.0, x, v, out), "x v out", "out"),
    "rates": (lambda p, x: p.spectral_bounds(x), "x", ""),
    "energies": (lambda p, x, v: p.energies(0.0, x, v), "x v", ""),
    "powers": (lambda p, x, v: p.powers(0.0, x, v), "x v", ""),
    "grip_rates": (lambda p, x, v: p.grip_wrench_rates(0.0, x, v), "x v", ""),
    "add_bounds": (lambda p, x, stiff, damped: p.add_bounds(x, stiff, damped), "x stiff damped", "stiff damped"),
    "add_jacobian_product": (lambda p, *key: p.add_jacobian_product(0.0, *key), "x v dx dv out", "out"),
}


@over_plans
@pytest.mark.parametrize(
    ("call", "name", "fault"),
    [
        (call, name, fault)
        for call, (_, names, written) in CALLS.items()
        for name in names.split()
        for fault in [*strange((3, N)), *(["read-only"] if name in written.split() else [])]
        if not (call == "energies" and name == "v" and fault == "nothing")
    ],
)
def test_misfit_arrays_are_refused_by_name(plan, call, name, fault):
    ask, names, _ = CALLS[call]
    shapes = {key: (6, N) if key in ("stiff", "damped") else (3, N) for key in names.split()}
    arrays = {key: good(shape) for key, shape in shapes.items()}
    ask(plan, *arrays.values())
    shape = shapes[name]
    arrays[name] = read_only(shape) if fault == "read-only" else strange(shape)[fault]
    with pytest.raises(ValueError, match=rf"^{name} (has|is)"):
        ask(plan, *arrays.values())


@over_plans
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"steps": []}, "runs of"),
        ({"steps": [0]}, "runs of"),
        ({"steps": [-3]}, "runs of"),
        ({"steps": [2.5]}, "runs of"),
        ({"steps": [NAN]}, "runs of"),
        ({"steps": [2**70]}, "runs of"),
        ({"steps": list(range(1, 40))}, "runs of"),
        ({"steps": [1, 2], "weights": []}, "weights"),
        ({"steps": [1], "weights": [1.0, 2.0]}, "weights"),
        ({"t": NAN}, "from time"),
        ({"duration": INF}, "from time"),
        ({"duration": NAN}, "from time"),
    ],
)
def test_invalid_runs_are_refused(plan, options, words):
    request = {"t": 0.0, "duration": 0.01, "start": (good(), good()), "steps": [1], **options}
    with pytest.raises(ValueError, match=words):
        plan.runs(**request)


@over_plans
@pytest.mark.parametrize("threads", [-5, 0, 1, 2, 7, 1000])
def test_bits_ignore_number_of_threads(plan, threads):
    (actual,), _ = plan.runs(0.0, 0.01, (good(), good()), [5], threads=threads)
    (expected,), _ = plan.runs(0.0, 0.01, (good(), good()), [5])
    assert actual.x.tobytes() == expected.x.tobytes()
    at_once, _ = plan.runs(0.0, 0.01, (good(), good()), [5, 9, 7], concurrency=threads)
    in_turn, _ = plan.runs(0.0, 0.01, (good(), good()), [5, 9, 7])
    assert [run.x.tobytes() for run in at_once] == [run.x.tobytes() for run in in_turn]


@over_plans
@pytest.mark.parametrize("value", [NAN, INF, -INF, 1e300, 1e-320])
@pytest.mark.parametrize("single", [False, True])
def test_non_finite_state_gives_flagged_result(plan, value, single):
    x, v = good(), good()
    x[1, 3] = value
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, result = plan.runs(0.0, 0.01, (x, v), [2, 3], weights=[-1.0, 2.0], single_precision=single)
    if not abs(value) < INF:
        assert not result[2].is_finite


def test_lists_of_other_springs_are_refused():
    for index, count in ((1, 2), (-1, 2), (0, 3), (5, 0)):
        with pytest.raises(ValueError, match="the plan has lists of"):
            PLANS["listed"].pair_blocks(index, count, good(), 1.0, 1.0)


def test_sums_refuse_misfit_arrays():
    x = good()
    for wrong in [good((3, N - 1)), x[:2], x.ravel(), None]:
        with pytest.raises(ValueError, match=r"has shape|is of type"):
            largest_distance(x, wrong)
        with pytest.raises(ValueError, match=r"has shape|is of type"):
            combine([x, wrong], [1.0, 2.0])
        with pytest.raises(ValueError, match=r"has shape|is of type"):
            weighted_dot(np.ones(N), x, wrong)
    with pytest.raises(ValueError, match="x has shape"):
        largest_distance(x[:2].copy(), x[:2].copy())
    for arrays, weights in (([x], [1.0, 2.0]), ([x, x], [1.0]), ([], [])):
        with pytest.raises(ValueError, match="weights"):
            combine(arrays, weights)


@pytest.mark.parametrize("count", [1, 3, 8, 19, 40])
def test_largest_distance_counts_every_particle(count):
    rng = np.random.default_rng(count)
    x = rng.normal(scale=0.1, size=(3, count))
    for particle in range(count):
        y = x.copy()
        y[:, particle] += (2.0, -3.0, 6.0)
        assert largest_distance(y, x) == pytest.approx(7.0)
        for component, value in ((0, np.nan), (1, np.inf), (2, -np.inf), (0, 1e200)):
            y[component, particle] = value
            assert largest_distance(y, x) == np.inf


numbers = st.one_of(st.floats(), st.integers(-(2**70), 2**70), st.none(), st.text(max_size=2), st.booleans())
nested = st.recursive(numbers, lambda inner: st.lists(inner, max_size=4), max_leaves=16)


@settings(max_examples=200)
@given(nested, nested, nested, nested)
def test_forces_accept_or_refuse_any_argument(first, second, third, fourth):
    """Anything that is made runs too: what the engine is told lies within the model."""
    builders = [
        lambda: PairSprings(first, second, third, fourth),
        lambda: OppositeSprings(first, second, third, fourth),
        lambda: CrossedSprings(first, second, third, fourth),
        lambda: AltitudeSprings(first, second, third, fourth),
        lambda: AirPanels(first, normal=second, tangential=third, wind=fourth),
        lambda: Wind(first, second),
        lambda: GridSprings(2, 4, [GridFamily(name="right", stiffness=first, rest_length=second, border=third)]),
    ]
    for build in builders:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                plan = compile(Model(np.ones(N), [build()]))
            except (ValueError, TypeError, OverflowError):
                continue
        plan.runs(0.0, 1e-3, (good(), good()), [1])
        plan.spectral_bounds(good())
