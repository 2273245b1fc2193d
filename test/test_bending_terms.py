# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""S7, S8 and S9 as forces: energy, balance, invariance, bounds, derivatives, degenerate states, lengths."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_sim_ros.physics.surface import Surface
from cloth_sim_ros.physics.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.forces.crossed import CrossedSprings
from cloth_sim_ros.physics.forces.opposite import OppositeSprings
from cloth_sim_ros.physics.forces.tetrahedron import signed_lengths

N = 9
RNG = np.random.default_rng(7)
HINGES = np.array([RNG.permutation(N)[:4] for _ in range(8)])
REST = RNG.uniform(-0.4, 0.4, 8)
STIFFNESS = RNG.uniform(5, 50, 8)
DAMPING = RNG.uniform(0.1, 2.0, 8)
TERMS = {
    "opposite": OppositeSprings(HINGES[:, 2:], np.abs(REST) + 0.3, STIFFNESS, DAMPING),
    "crossed": CrossedSprings(HINGES[:, :2], HINGES[:, 2:], REST, STIFFNESS, DAMPING),
    "crossed flat": CrossedSprings(HINGES[:, :2], HINGES[:, 2:], 0.0, STIFFNESS),
    "altitude": AltitudeSprings(HINGES, REST, STIFFNESS, DAMPING),
    "altitude flat": AltitudeSprings(HINGES, 0.0, STIFFNESS),
}
every_term = pytest.mark.parametrize("term", TERMS.values(), ids=TERMS.keys())
tetrahedron_term = pytest.mark.parametrize("term", list(TERMS.values())[1:], ids=list(TERMS)[1:])
seeds = pytest.mark.parametrize("seed", range(4))


def random_state(seed):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((3, N)), rng.standard_normal((3, N)), rng


def force(term, x, v):
    f = np.zeros_like(x)
    term.add_force(0.0, x, v, f)
    return f


@every_term
@seeds
def test_elastic_force_is_the_negative_gradient_of_the_energy(term, seed):
    x, _, _ = random_state(seed)
    elastic = force(term, x, np.zeros_like(x))
    gradient = np.zeros_like(x)
    step = 1e-5
    for index in np.ndindex(x.shape):
        moved = x.copy()
        moved[index] = x[index] + step
        up = term.energy(0.0, moved)
        moved[index] = x[index] - step
        gradient[index] = (up - term.energy(0.0, moved)) / (2 * step)
    assert elastic == pytest.approx(-gradient, abs=1e-6 * max(1.0, np.abs(elastic).max()))


@every_term
@seeds
def test_forces_sum_to_zero_without_torque(term, seed):
    x, v, _ = random_state(seed)
    f = force(term, x, v)
    # rounding is that of each hinge's own forces, which may cancel in the sum
    scale = sum(np.abs(force(single, x, v)).sum() for single in singles(term))
    assert np.abs(f.sum(axis=1)).max() < 1e-13 * scale
    assert np.abs(np.cross(x.T, f.T).sum(axis=0)).max() < 1e-13 * scale


def singles(term):
    if isinstance(term, OppositeSprings):
        return [term]
    kind = type(term)
    return [
        AltitudeSprings(h[None], r, k, c)
        if kind is AltitudeSprings
        else CrossedSprings(h[None, :2], h[None, 2:], r, k, c)
        for h, r, k, c in zip(term.hinges, term.rest_length, term.stiffness, term.damping, strict=True)
    ]


@every_term
@seeds
def test_forces_turn_and_shift_with_the_body(term, seed):
    x, v, rng = random_state(seed)
    turn, shift, spin = Rotation.random(random_state=seed).as_matrix(), rng.standard_normal(3), rng.standard_normal(3)
    moved = turn @ x + shift[:, None]
    moving = turn @ v + rng.standard_normal((3, 1)) + np.cross(spin, moved.T).T
    assert force(term, moved, moving) == pytest.approx(
        turn @ force(term, x, v), abs=1e-11 * np.abs(force(term, x, v)).max()
    )
    assert term.energy(0.0, moved) == pytest.approx(term.energy(0.0, x), rel=1e-11)


@every_term
@seeds
def test_damping_takes_exactly_the_power_that_it_says_and_never_gives(term, seed):
    x, v, _ = random_state(seed)
    lost = term.dissipation(0.0, x, v)
    elastic = force(term, x, np.zeros_like(x))
    assert lost >= 0.0
    assert np.sum((force(term, x, v) - elastic) * v) == pytest.approx(
        -lost, rel=1e-11, abs=1e-11 * np.abs(elastic).max()
    )


@every_term
@seeds
def test_jacobian_product_is_the_derivative_of_the_force(term, seed):
    x, v, rng = random_state(seed)
    dx, dv = rng.standard_normal((3, N)), rng.standard_normal((3, N))
    product = np.zeros_like(x)
    term.add_jacobian_product(0.0, x, v, dx, dv, product)
    step = 1e-6
    difference = (force(term, x + step * dx, v + step * dv) - force(term, x - step * dx, v - step * dv)) / (2 * step)
    assert product == pytest.approx(difference, abs=1e-6 * max(1.0, np.abs(difference).max()))


def matrix_of(term, x, part):
    columns, zero = [], np.zeros((3, N))
    for p, i in itertools.product(range(N), range(3)):
        push, out = np.zeros((3, N)), np.zeros((3, N))
        push[i, p] = 1.0
        term.add_jacobian_product(0.0, x, zero, *((push, zero) if part == "x" else (zero, push)), out)
        columns.append(-out.T.ravel())
    return np.array(columns).T


def matrix_of_blocks(blocks):
    matrix = np.zeros((N, 3, N, 3))
    for (i, j), row in zip([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)], blocks, strict=True):
        matrix[range(N), i, range(N), j] = matrix[range(N), j, range(N), i] = row
    return matrix.reshape(3 * N, 3 * N)


@every_term
@pytest.mark.parametrize("seed", range(20))
def test_blocks_bound_stiffness_and_damping(term, seed):
    x, _, _ = random_state(seed)
    for part, add in (("x", term.add_stiffness), ("v", term.add_damping)):
        blocks = np.zeros((6, N))
        add(x, blocks)
        matrix = matrix_of(term, x, part)
        assert matrix == pytest.approx(matrix.T, abs=1e-9 * max(1.0, np.abs(matrix).max()))
        room = np.linalg.eigvalsh(matrix_of_blocks(blocks) - 0.5 * (matrix + matrix.T))
        assert room.min() > -1e-10 * max(1.0, np.abs(matrix).max()), part


def candidates(p):
    """6V and |a x b| of the seven candidates of tetrahedron p (4, 3): three edge pairs (S8's first), four faces."""
    pairs = [((0, 1), (2, 3)), ((0, 2), (1, 3)), ((0, 3), (1, 2))]
    areas = [np.cross(p[b] - p[a], p[d] - p[c]) for (a, b), (c, d) in pairs]
    areas += [np.cross(p[b] - p[a], p[c] - p[a]) for a, b, c in itertools.combinations(range(4), 3)]
    return np.dot(p[1] - p[0], np.cross(p[2] - p[0], p[3] - p[0])), np.linalg.norm(areas, axis=1)


@seeds
def test_lengths_are_those_of_the_candidates(seed):
    x, _, _ = random_state(seed)
    for hinge in HINGES:
        p = x.T[hinge]
        volume, areas = candidates(p)
        assert signed_lengths(hinge, x, crossed=True) == pytest.approx(volume / areas[0], rel=1e-12)
        # the blend: 1/h^2 is half the sum of 1/h_c^2 over all seven
        blend = np.sign(volume) * (0.5 * np.sum((areas / volume) ** 2)) ** -0.5
        assert signed_lengths(hinge, x, crossed=False) == pytest.approx(blend, rel=1e-12)
        # which lies between the shortest candidate over sqrt(7/2) and the shortest itself
        shortest = np.abs(volume / areas).min()
        assert shortest / np.sqrt(3.5) <= np.abs(blend) <= np.sqrt(2) * shortest


def fold(angle, *, height0=1.0, height1=1.0, foot0=0.5, foot1=0.5, edge=1.0):
    """A hinge with its edge along y, folded by `angle` towards the normal (+z), as (3, 4)."""
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    points = [(0, 0, 0), (0, edge, 0), (-height0 * c, foot0, height0 * s), (height1 * c, foot1, height1 * s)]
    return np.array(points, dtype=float).T


PAIR = np.array([[0, 1, 2, 3]])


def test_near_flat_the_crossed_length_is_h1_h2_theta_over_their_sum():
    for h0, h1, f0, f1 in [(1.0, 1.0, 0.5, 0.5), (0.7, 1.3, 0.2, 0.9), (1.0, 1.0, 0.0, 1.0)]:
        angle = 1e-4
        length = signed_lengths(PAIR, fold(angle, height0=h0, height1=h1, foot0=f0, foot1=f1), crossed=True)[0]
        assert length == pytest.approx(h0 * h1 * angle / (h0 + h1), rel=1e-7)


def test_positive_is_the_side_of_the_normal():
    surface = Surface.from_triangles([[0, 1, 2], [1, 0, 3]])
    x = fold(0.3)
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    assert normal[2] > 0 and x[2, 2] > 0
    for crossed in (True, False):
        assert signed_lengths(surface.hinges, x, crossed=crossed)[0] > 0
        assert signed_lengths(surface.hinges, fold(-0.3), crossed=crossed)[0] < 0


@tetrahedron_term
@pytest.mark.parametrize(
    "x",
    [
        np.zeros((3, N)),
        np.outer([1.0, 2.0, 3.0], np.arange(N)),  # all collinear
        np.outer([1.0, 2.0, 3.0], np.arange(N) % 2),  # coincident points
        fold(np.pi)[:, np.arange(N) % 4],  # a symmetric pair folded shut
    ],
    ids=["one point", "collinear", "two points", "shut"],
)
def test_degenerate_states_give_no_nan(term, x):
    v = np.ones((3, N)) * np.arange(N)
    blocks, out = np.zeros((6, N)), np.zeros((3, N))
    term.add_stiffness(x, blocks)
    term.add_damping(x, blocks)
    term.add_jacobian_product(0.0, x, v, x + 1.0, v, out)
    for value in (force(term, x, v), blocks, out, term.energy(0.0, x), term.dissipation(0.0, x, v)):
        assert np.isfinite(value).all()


@pytest.mark.parametrize("thin", 10.0 ** -np.arange(1, 16, 2))
def test_force_of_the_blend_stays_bounded_down_to_collinear(thin):
    # weights of the lecture's S8 grow without limit as lines turn parallel; those of the blend do not
    x = np.random.default_rng(3).standard_normal((3, 4))
    x[1:] *= thin
    term = AltitudeSprings(PAIR, 0.5, 1.0)
    assert np.abs(force(term, x, 0 * x)).max() < 2.0


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: AltitudeSprings([[0, 1, 2, 2]], 0.0, 1.0), r"hinge 0 of 'altitude' is \[0, 1, 2, 2\]"),
        (lambda: AltitudeSprings([[0, 1, 2, 3]], np.nan, 1.0), "rest_length of hinge 0 .* is nan; it must be finite"),
        (lambda: CrossedSprings([[0, 1]], [[2, 3]], 0.0, -1.0), "stiffness of hinge 0 of 'crossed' is -1.0"),
        (lambda: CrossedSprings([[0, 1]], [[2, 3]], [0.0, 1.0], 1.0), "has shape"),
        (
            lambda: OppositeSprings([[2, 3]], 0.0, 1.0),
            r"bending spring 0 \(particles \[2, 3\]\) is 0.0; it must be above 0",
        ),
    ],
)
def test_hinges_that_are_none_are_refused(build, words):
    with pytest.raises(ValueError, match=words):
        build()


@pytest.mark.parametrize("kind", [CrossedSprings, AltitudeSprings])
def test_stiffness_bound_holds_and_is_not_loose_for_hinges_of_any_shape(kind):
    # far from rest, so that the part from the length's curvature leads
    rng = np.random.default_rng(5)
    looseness = []
    for _ in range(300):
        x = rng.standard_normal((3, 4)) * 10.0 ** rng.uniform(-1.5, 0, (3, 1))
        length = signed_lengths(PAIR, x, crossed=kind is CrossedSprings)[0]
        rest = length + rng.choice([-1.0, 1.0]) * rng.uniform(0, 3)
        ends = (PAIR,) if kind is AltitudeSprings else (PAIR[:, :2], PAIR[:, 2:])
        term = kind(*ends, rest, 1.0)
        blocks = np.zeros((6, 4))
        term.add_stiffness(x, blocks)
        matrix = np.zeros((12, 12))
        for column in range(12):
            push, out = np.zeros((3, 4)), np.zeros((3, 4))
            push[divmod(column, 4)] = 1.0
            term.add_jacobian_product(0.0, x, 0 * x, push, 0 * x, out)
            matrix[:, column] = -out.ravel()
        bound = np.zeros((3, 4, 3, 4))
        for (i, j), row in zip([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)], blocks, strict=True):
            bound[i, range(4), j, range(4)] = bound[j, range(4), i, range(4)] = row
        bound = bound.reshape(12, 12)
        largest = np.linalg.eigvalsh(matrix)[-1]
        assert np.linalg.eigvalsh(bound - matrix)[0] > -1e-9 * np.abs(matrix).max()
        looseness.append(np.linalg.eigvalsh(bound)[-1] / largest)
    assert np.median(looseness) < 12.0
