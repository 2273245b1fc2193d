# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What every term promises, on random states: energy, balance, invariance, bounds, derivatives."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_sim_ros.physics.gripper_path import path_row
from cloth_sim_ros.physics.forces.air_panels import AirPanels
from cloth_sim_ros.physics.forces.drag import Drag
from cloth_sim_ros.physics.forces.gravity import Gravity
from cloth_sim_ros.physics.forces.grips import Grips
from cloth_sim_ros.physics.forces.pair_springs import PairSprings

N = 12
RNG = np.random.default_rng(11)
PAIRS = np.array([(a, b) for a in range(N) for b in range(a + 1, N) if RNG.random() < 0.3])
MASSES = RNG.uniform(0.1, 1.0, N)


def springs(**options):
    return PairSprings(PAIRS, RNG.uniform(0.3, 1.5, len(PAIRS)), RNG.uniform(5, 50, len(PAIRS)), **options)


def grips():
    term = Grips(2)
    one, turned = (
        np.array([0.1, 0, 0, 0, 0, 0, 1.0]),
        np.array([0.4, 0.2, 0.1, *Rotation.from_rotvec([1, 2, 0]).as_quat()]),
    )
    for g, (pose, target) in enumerate([(one, turned), (turned, one)]):
        term.paths[g] = path_row(0.0, 0.1, pose, RNG.standard_normal(6), np.zeros(6), target)[0]
    held = np.array([1, 2, 2, 5])
    term.hold(np.array([0, 2, 4]), held, RNG.standard_normal((4, 3)), np.full(4, 30.0), np.full(4, 2.0))
    return term


INTERNAL = {
    "springs": springs(damping=RNG.uniform(0.1, 2.0, len(PAIRS))),
    "undamped springs": springs(),
    "joints": PairSprings(PAIRS, 0.0, 12.0, 0.0),
}
EXTERNAL = {
    "damped joints": PairSprings(PAIRS, 0.0, 12.0, 1.5),
    "gravity": Gravity(MASSES, [1.0, -2.0, -9.81]),
    "drag": Drag(MASSES, 0.7),
    "grips": grips(),
    "air panels": AirPanels(RNG.permuted(np.tile(np.arange(N), (9, 1)), axis=1)[:, :3], normal=2.0, tangential=0.3),
}
TERMS = {**INTERNAL, **EXTERNAL}
every_term = pytest.mark.parametrize("term", TERMS.values(), ids=TERMS.keys())
internal_term = pytest.mark.parametrize("term", INTERNAL.values(), ids=INTERNAL.keys())


def random_state(seed):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((3, N)), rng.standard_normal((3, N)), rng


def force(term, x, v, t=0.03):
    f = np.zeros_like(x)
    term.add_force(t, x, v, f)
    return f


@every_term
@pytest.mark.parametrize("seed", range(4))
def test_elastic_force_is_the_negative_gradient_of_the_energy(term, seed):
    x, _, _ = random_state(seed)
    t = 0.03
    # The elastic part: what is left where nothing moves, a gripper's own motion included.
    elastic = 0.5 * (force(term, x, np.zeros_like(x)) + force(term, x, np.zeros_like(x)))
    if isinstance(term, Grips):
        still = Grips(2)
        still.paths[:] = term.paths
        still.hold(term.starts, term.particles, term.offsets, term.stiffness, 0.0 * term.damping)
        elastic = force(still, x, np.zeros_like(x))
    gradient = np.zeros_like(x)
    h = 1e-5
    for index in np.ndindex(x.shape):
        moved = x.copy()
        moved[index] = x[index] + h
        up = term.energy(t, moved)
        moved[index] = x[index] - h
        gradient[index] = (up - term.energy(t, moved)) / (2 * h)
    assert elastic == pytest.approx(-gradient, abs=1e-6 * max(1.0, np.abs(elastic).max()))


@internal_term
@pytest.mark.parametrize("seed", range(4))
def test_internal_forces_sum_to_zero_without_torque(term, seed):
    x, v, _ = random_state(seed)
    f = force(term, x, v)
    scale = np.abs(f).sum()
    assert np.abs(f.sum(axis=1)).max() < 1e-14 * scale
    assert np.abs(np.cross(x.T, f.T).sum(axis=0)).max() < 1e-14 * scale


@internal_term
@pytest.mark.parametrize("seed", range(4))
def test_internal_forces_turn_and_shift_with_the_body(term, seed):
    x, v, rng = random_state(seed)
    turn, shift, spin = Rotation.random(random_state=seed).as_matrix(), rng.standard_normal(3), rng.standard_normal(3)
    moved = turn @ x + shift[:, None]
    # The body moves as well as it deforms: uniform motion plus a rotation, which damping must not see.
    moving = turn @ v + rng.standard_normal((3, 1)) + np.cross(spin, moved.T).T
    assert force(term, moved, moving) == pytest.approx(
        turn @ force(term, x, v), abs=1e-12 * np.abs(force(term, x, v)).max()
    )
    assert term.energy(0.0, moved) == pytest.approx(term.energy(0.0, x), rel=1e-12)


@every_term
@pytest.mark.parametrize("seed", range(4))
def test_damping_takes_exactly_the_power_that_it_says_and_never_gives(term, seed):
    x, v, _ = random_state(seed)
    if isinstance(term, Grips):
        term.paths[:, 4:13] = 0.0  # grippers at rest: their own work is none
        term.paths[:, 17:26] = 0.0
    lost = term.dissipation(0.03, x, v)
    elastic = force(term, x, np.zeros_like(x))
    assert lost >= 0.0
    assert np.sum((force(term, x, v) - elastic) * v) == pytest.approx(-lost, rel=1e-12, abs=1e-12)


@every_term
@pytest.mark.parametrize("seed", range(4))
def test_jacobian_product_is_the_derivative_of_the_force(term, seed):
    x, v, rng = random_state(seed)
    dx, dv = rng.standard_normal((3, N)), rng.standard_normal((3, N))
    product = np.zeros_like(x)
    term.add_jacobian_product(0.03, x, v, dx, dv, product)
    h = 1e-6
    difference = (force(term, x + h * dx, v + h * dv) - force(term, x - h * dx, v - h * dv)) / (2 * h)
    assert product == pytest.approx(difference, abs=1e-6 * max(1.0, np.abs(difference).max()))


def full_matrix(blocks):
    matrix = np.zeros((N, 3, N, 3))
    for (i, j), row in zip([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)], blocks, strict=True):
        for p in range(N):
            matrix[p, i, p, j] = matrix[p, j, p, i] = row[p]
    return matrix.reshape(3 * N, 3 * N)


def linear_part(term, x, v, part):
    columns = []
    for p in range(N):
        for i in range(3):
            push, out = np.zeros((3, N)), np.zeros((3, N))
            push[i, p] = 1.0
            zero = np.zeros((3, N))
            term.add_jacobian_product(0.03, x, v, *((push, zero) if part == "x" else (zero, push)), out)
            columns.append(-out.T.ravel())
    return np.array(columns).T


@every_term
@pytest.mark.parametrize("seed", range(4))
def test_blocks_bound_stiffness_and_damping(term, seed):
    x, _, _ = random_state(seed)
    still = np.zeros_like(x)
    for part, add in (("x", term.add_stiffness), ("v", term.add_damping)):
        blocks = np.zeros((6, N))
        add(x, blocks)
        matrix = linear_part(term, x, still, part)
        room = np.linalg.eigvalsh(full_matrix(blocks) - 0.5 * (matrix + matrix.T))
        assert room.min() > -1e-10 * max(1.0, np.abs(matrix).max()), part


@pytest.mark.parametrize("rest", [0.0, 0.5])
def test_coincident_ends_give_no_nan(rest):
    term = PairSprings([[0, 1]], rest, 10.0, 1.0)
    x, v = np.zeros((3, 2)), np.ones((3, 2))
    blocks, out = np.zeros((6, 2)), np.zeros((3, 2))
    term.add_stiffness(x, blocks)
    term.add_damping(x, blocks)
    term.add_jacobian_product(0.0, x, v, x + 1.0, v, out)
    assert np.isfinite(force(term, x, v)).all()
    assert np.isfinite(blocks).all()
    assert np.isfinite(out).all()
    assert np.isfinite(term.dissipation(0.0, x, v))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([[0, 0]], 1.0, 1.0), "joins particle 0 to itself"),
        (([[0, 1]], -1.0, 1.0), "rest_length of spring 0 is -1.0"),
        (([[0, 1]], 1.0, np.nan), "stiffness of spring 0 is nan"),
        (([[0, 1], [1, 2]], [1.0], 1.0), "has shape"),
        (([[0, -1]], 1.0, 1.0), "negative particle index -1"),
    ],
)
def test_pairs_that_are_no_springs_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        PairSprings(*arguments)
