# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Common properties of every force on random states: law, energy, balance, invariance, bounds, derivatives."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import laws
from support.alone import alone, blocks, force, full, gradient, matrix, product

from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.candidates import CANDIDATES, CandidateSprings
from cloth_sim_ros.physics.model.forces.crossed import CrossedSprings
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.membrane_triangles import MembraneTriangles
from cloth_sim_ros.physics.model.forces.opposite import OppositeSprings
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.forces.wind import Wind
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.gripper_path import plan_paths
from cloth_sim_ros.physics.plan.plan import compile

N = 12
T = 0.03
RNG = np.random.default_rng(11)
PAIRS = np.array([(a, b) for a in range(N) for b in range(a + 1, N) if RNG.random() < 0.3])
HINGES = np.array([RNG.permutation(N)[:4] for _ in range(11)])
REST_LENGTHS = RNG.uniform(-0.4, 0.4, len(HINGES))
STIFFNESS, DAMPING = RNG.uniform(5, 50, len(HINGES)), RNG.uniform(0.1, 2.0, len(HINGES))
MASSES = RNG.uniform(0.1, 1.0, N)
AROUND = RNG.permuted(np.tile(np.arange(N), (9, 1)), axis=1)


def springs(rest_lengths=None, **options):
    rest_lengths = RNG.uniform(0.3, 1.5, len(PAIRS)) if rest_lengths is None else rest_lengths
    return PairSprings(PAIRS, rest_lengths, RNG.uniform(5, 50, len(PAIRS)), **options)


def sheet(damping, parity, **options):
    """Return all six families of 3 x 4 particles, each with its own coefficients."""
    names = ("right", "down", "diagonal", "antidiagonal", "right2", "down2")
    families = [
        GridFamily(
            name=name,
            stiffness=10.0 + 3.0 * k,
            rest_length=0.7 + 0.1 * k,
            damping=damping * (1.0 + 0.2 * k),
            border=0.5 if name in ("right", "down", "right2", "down2") else 1.0,
            parity=parity if "diagonal" in name else None,
        )
        for k, name in enumerate(names)
    ]
    return GridSprings(3, 4, families, **options)


def membrane(viscosities, **options):
    corners = RNG.uniform(-1.0, 1.0, (len(AROUND), 3, 2))
    # Slivers would make forces of many orders of magnitude.
    corners[:, 1:] += [[[2.0, 0.0], [0.0, 2.0]]]
    return MembraneTriangles(AROUND[:, :3], corners, moduli=[50.0, 8.0, 20.0, 5.0], viscosities=viscosities, **options)


def grips(stillness=False):
    held = Grips(2)
    pose, turned = [0.1, 0, 0, 0, 0, 0, 1.0], [0.4, 0.2, 0.1, *Rotation.from_rotvec([1, 2, 0]).as_quat()]
    twists = np.array([RNG.standard_normal(6) for _ in range(2)])
    paths = plan_paths(0.0, 0.1, np.array([pose, turned]), twists, np.zeros((2, 6)), np.array([turned, pose]))[0]
    if stillness:
        paths[:, 4:13] = paths[:, 17:26] = 0.0
    particles = np.array([1, 2, 2, 5])
    held.set_grips(
        paths, np.array([0, 2, 4]), particles, RNG.standard_normal((4, 3)), np.full(4, 30.0), np.full(4, 2.0)
    )
    return held


#: Internal forces without resultant and torque; damped joints have a torque if they are open.
INTERNAL = {
    "springs": [springs(damping=RNG.uniform(0.1, 2.0, len(PAIRS)))],
    "undamped springs": [springs()],
    "joints": [springs(0.0)],
    "sheet": [sheet(0.3, None)],
    "undamped sheet": [sheet(0.0, None)],
    "checkered sheet": [sheet(0.3, 1)],
    "membrane": [membrane([2.0, -0.3, 0.8, 0.2])],
    "undamped membrane": [membrane([0.0, 0.0, 0.0, 0.0])],
    "opposite": [OppositeSprings(HINGES[:, 2:], np.abs(REST_LENGTHS) + 0.3, STIFFNESS, DAMPING)],
    "crossed": [CrossedSprings(HINGES[:, :2], HINGES[:, 2:], REST_LENGTHS, STIFFNESS, DAMPING)],
    "crossed flat": [CrossedSprings(HINGES[:, :2], HINGES[:, 2:], 0.0, STIFFNESS)],
    "altitude": [AltitudeSprings(HINGES, REST_LENGTHS, STIFFNESS, DAMPING)],
    "altitude flat": [AltitudeSprings(HINGES, 0.0, STIFFNESS)],
    **{name: [CandidateSprings(name, HINGES, REST_LENGTHS, STIFFNESS, DAMPING)] for name in CANDIDATES},
}
EXTERNAL = {
    "damped joints": [springs(0.0, damping=1.5)],
    "gravity": [Gravity([1.0, -2.0, -9.81])],
    "drag": [Drag(0.7)],
    "grips": [grips()],
    "still air": [AirPanels(AROUND[:, :3], normal=2.0, tangential=0.3)],
}
#: Moving air does work, and its force turns with the panels: no potential, no symmetric stiffness.
MOVING_AIR = {
    "wind": [Wind([3.0, -1.0, 0.5], 0.7)],
    "blown triangles": [AirPanels(AROUND[:, :3], normal=2.0, tangential=0.3, wind=(3.0, -1.0, 0.5))],
    "blown cells": [AirPanels(AROUND[:, :4], normal=2.0, tangential=0.3, wind=(3.0, -1.0, 0.5))],
}
CONSERVING = {**INTERNAL, **EXTERNAL}
ON_LIST = [springs(damping=0.4), *INTERNAL["membrane"], *INTERNAL["crossed"], *INTERNAL["altitude"]]
ON_SHEET = [sheet(0.3, 0), *INTERNAL["membrane"], *INTERNAL["opposite"], *INTERNAL["altitude"]]
DRIVEN = [*EXTERNAL["gravity"], *EXTERNAL["drag"], *MOVING_AIR["wind"]]
#: All forces at once too, on a list and on a sheet.
ALL = {
    **CONSERVING,
    **MOVING_AIR,
    "everything on a list": [*ON_LIST, *DRIVEN, *MOVING_AIR["blown cells"], grips()],
    "everything on a sheet": [*ON_SHEET, *DRIVEN, *MOVING_AIR["blown triangles"], grips()],
}


def over(models):
    return pytest.mark.parametrize("forces", models.values(), ids=models.keys())


seeds = pytest.mark.parametrize("seed", range(4))


def random_state(seed):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((3, N)), rng.standard_normal((3, N)), rng


def plan_of(forces):
    return alone(*forces, masses=MASSES)


@over(ALL)
@seeds
def test_forces_energies_and_powers_are_those_of_the_laws(forces, seed):
    x, v, _ = random_state(seed)
    plan, expected = plan_of(forces), laws.total(Model(MASSES, forces), T, x, v)
    scale = max(1.0, np.abs(expected.force).max())
    assert force(plan, x, v, T) == pytest.approx(expected.force, abs=1e-11 * scale)
    kinetic, potential = plan.energies(T, x, v)
    assert kinetic == pytest.approx(0.5 * np.sum(MASSES * v * v), rel=1e-12)
    assert potential == pytest.approx(expected.energy, rel=1e-11, abs=1e-12)
    assert plan.dissipation(T, x, v) == pytest.approx(expected.dissipation, rel=1e-11, abs=1e-12)
    assert plan.external_power(T, x, v) == pytest.approx(expected.external_power, rel=1e-11, abs=1e-12)


@over({name: ALL[name] for name in ("grips", "everything on a list", "everything on a sheet")})
@seeds
def test_gripper_wrenches_are_those_of_the_law(forces, seed):
    x, v, _ = random_state(seed)
    held = next(force for force in forces if isinstance(force, Grips))
    expected = laws.grips(T, x, v, held)[1]
    assert plan_of(forces).grip_wrench_rates(T, x, v) == pytest.approx(expected, rel=1e-11, abs=1e-10)


@over(ALL)
@pytest.mark.parametrize("steps", [1, 5])
@pytest.mark.parametrize("single_precision", [False, True], ids=["double", "single"])
def test_runs_are_the_leapfrog_of_the_laws(forces, steps, single_precision):
    x, v, _ = random_state(1)
    model = Model(MASSES, forces, anchors=[0, 7])
    v[:, [0, 7]] = 0.0
    duration = 0.002 * steps
    expected = laws.leapfrog(model, T, duration, x, v, steps)
    runs, _ = compile(model).runs(T, duration, (x, v), [steps], single_precision=single_precision)
    # Single precision resolves 6e-8 of the largest numbers: positions and speeds of a few units, accelerations of a
    # thousand a step.
    for calculated, reference in zip(runs[0].end_state, expected, strict=True):
        assert calculated == pytest.approx(
            reference, abs=(3e-6 if single_precision else 1e-12) * np.abs(reference).max()
        )


@over(ALL)
def test_single_precision_is_single(forces):
    x, v, _ = random_state(1)
    plan = plan_of(forces)
    (wide,), _ = plan.runs(T, 0.01, (x, v), [5])
    (single_run,), _ = plan.runs(T, 0.01, (x, v), [5], single_precision=True)
    assert np.abs(wide.v - single_run.v).max() > 1e-10


@over(ALL)
@seeds
def test_power_is_wind_power_minus_dissipation(forces, seed):
    x, v, _ = random_state(seed)
    forces = [grips(stillness=True) if isinstance(model_force, Grips) else model_force for model_force in forces]
    plan = plan_of(forces)
    dissipation, wind_power = plan.dissipation(T, x, v), plan.external_power(T, x, v)
    still = np.zeros_like(x)
    # At rest the force is elastic, or that of the wind.
    resting = force(plan, x, still, T)
    pushed = laws.total(Model(MASSES, [f for f in forces if isinstance(f, (Wind, AirPanels))]), T, x, still).force
    power = float(np.sum((force(plan, x, v, T) - resting + pushed) * v))
    assert dissipation >= 0.0
    assert power == pytest.approx(wind_power - dissipation, rel=1e-11, abs=1e-11 * max(1.0, np.abs(resting).max()))
    assert plan.powers(T, x, still) == (0.0, 0.0)


@over(MOVING_AIR)
def test_moving_air_does_work(forces):
    x, v, _ = random_state(0)
    assert plan_of(forces).external_power(T, x, v) != 0.0


@over(CONSERVING)
@seeds
def test_elastic_force_is_the_negative_gradient_of_the_energy(forces, seed):
    x, _, _ = random_state(seed)
    # The elastic part: the force at rest, grippers included.
    plan = plan_of([grips(stillness=True)] if isinstance(forces[0], Grips) else forces)
    elastic = force(plan, x, t=T)
    slopes = gradient(lambda places: plan.energies(T, places, None)[1], x)
    assert elastic == pytest.approx(-slopes, abs=1e-6 * max(1.0, np.abs(elastic).max()))


@over(INTERNAL)
@seeds
def test_internal_forces_sum_to_zero_without_torque(forces, seed):
    x, v, _ = random_state(seed)
    f = force(plan_of(forces), x, v)
    # Rounding is that of each element's own forces, which may cancel in the sum.
    limit = 1e-12 * np.abs(f).sum()
    assert np.abs(f.sum(axis=1)).max() < limit
    assert np.abs(np.cross(x.T, f.T).sum(axis=0)).max() < limit


@over(INTERNAL)
@seeds
def test_internal_forces_turn_and_shift_with_the_body(forces, seed):
    x, v, rng = random_state(seed)
    plan = plan_of(forces)
    turn, shift, spin = Rotation.random(random_state=seed).as_matrix(), rng.standard_normal(3), rng.standard_normal(3)
    moved = turn @ x + shift[:, None]
    # The body deforms and moves: uniform motion plus a rotation, which damping must not see.
    moving = np.ascontiguousarray(turn @ v + rng.standard_normal((3, 1)) + np.cross(spin, moved.T).T)
    expected = turn @ force(plan, x, v)
    assert force(plan, moved, moving) == pytest.approx(expected, abs=1e-11 * np.abs(expected).max())
    assert plan.energies(0.0, moved, None)[1] == pytest.approx(plan.energies(0.0, x, None)[1], rel=1e-11)


@over(ALL)
@seeds
def test_jacobian_product_is_the_derivative_of_the_force(forces, seed):
    x, v, rng = random_state(seed)
    plan = plan_of(forces)
    dx, dv = rng.standard_normal((3, N)), rng.standard_normal((3, N))
    h = 1e-6
    difference = (force(plan, x + h * dx, v + h * dv, T) - force(plan, x - h * dx, v - h * dv, T)) / (2 * h)
    derivative = product(plan, x, v, dx, dv, T)
    assert derivative == pytest.approx(difference, abs=1e-6 * max(1.0, np.abs(difference).max()))


@over(ALL)
@pytest.mark.parametrize("seed", range(12))
def test_blocks_bound_stiffness_and_damping(forces, seed):
    x, _, _ = random_state(seed)
    plan, still = plan_of(forces), np.zeros_like(x)
    for part, bound in zip("xv", blocks(plan, x), strict=True):
        held = [grips(stillness=True) if isinstance(model_force, Grips) else model_force for model_force in forces]
        whole = matrix(plan_of(held), x, still, part, T)
        room = np.linalg.eigvalsh(full(bound) - 0.5 * (whole + whole.T))
        assert room.min() > -1e-10 * max(1.0, np.abs(whole).max()), part


@over(CONSERVING)
def test_stiffness_and_damping_at_rest_are_symmetric(forces):
    x, _, _ = random_state(0)
    for part in "xv":
        whole = matrix(plan_of(forces), x, np.zeros_like(x), part, T)
        assert whole == pytest.approx(whole.T, abs=1e-9 * max(1.0, np.abs(whole).max()))


@over(ALL)
@seeds
def test_spectral_bounds_are_at_most_the_largest_block_over_mass(forces, seed):
    x, _, _ = random_state(seed)
    plan = plan_of(forces)
    expected = [
        max(np.linalg.eigvalsh(full(bound[:, [p]]))[-1] / MASSES[p] for p in range(N)) for bound in blocks(plan, x)
    ]
    # A sheet's are calculated in single precision, where two nearly equal eigenvalues cost half of the digits.
    for rate, most in zip(plan.spectral_bounds(x), expected, strict=True):
        assert 0.5 * (1.0 - 3e-4) * most <= rate <= (1.0 + 3e-4) * most


@pytest.mark.parametrize("rest_length", [0.0, 0.5])
def test_coincident_ends_give_no_nan(rest_length):
    plan = alone(PairSprings([[0, 1]], rest_length, 10.0, 1.0), count=2)
    x, v = np.zeros((3, 2)), np.ones((3, 2))
    v[:, 1] = 2.0
    for array in (force(plan, x, v), *blocks(plan, x), product(plan, x, v, x + 1.0, v)):
        assert np.isfinite(array).all()
    assert np.isfinite([plan.dissipation(0.0, x, v), plan.energy(0.0, x, v)]).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([[0, 0]], 1.0, 1.0), "joins particle 0 to itself"),
        (([[0, 1]], -1.0, 1.0), r"rest_length of 'springs'\[0\] is -1.0"),
        (([[0, 1]], 1.0, np.nan), r"stiffness of 'springs'\[0\] is nan"),
        (([[0, 1], [1, 2]], [1.0], 1.0), "has shape"),
        (([[0, -1]], 1.0, 1.0), "row 0 of pairs of 'springs' names particle -1"),
    ],
)
def test_invalid_pairs_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        PairSprings(*arguments)
