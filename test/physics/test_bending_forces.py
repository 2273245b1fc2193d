# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""S8 and S9: lengths, degenerate states and tightness of bounds; `test_forces.py` has the common properties."""

import numpy as np
import pytest
from support import laws
from support.alone import alone, blocks, force, full, matrix, product

from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.candidates import CANDIDATES, CandidateSprings
from cloth_sim_ros.physics.model.forces.crossed import CrossedSprings
from cloth_sim_ros.physics.model.forces.hinge_springs import gradient_squares, signed_lengths
from cloth_sim_ros.physics.model.forces.opposite import OppositeSprings
from cloth_sim_ros.physics.model.sheets.surface import Surface

N = 9
RNG = np.random.default_rng(7)
HINGES = np.array([RNG.permutation(N)[:4] for _ in range(8)])
REST_LENGTHS = RNG.uniform(-0.4, 0.4, 8)
STIFFNESS = RNG.uniform(5, 50, 8)
DAMPING = RNG.uniform(0.1, 2.0, 8)
FORCES = {
    "crossed": CrossedSprings(HINGES[:, :2], HINGES[:, 2:], REST_LENGTHS, STIFFNESS, DAMPING),
    "crossed flat": CrossedSprings(HINGES[:, :2], HINGES[:, 2:], 0.0, STIFFNESS),
    "altitude": AltitudeSprings(HINGES, REST_LENGTHS, STIFFNESS, DAMPING),
    "altitude flat": AltitudeSprings(HINGES, 0.0, STIFFNESS),
    "edge-wings": CandidateSprings("edge-wings", HINGES, REST_LENGTHS, STIFFNESS, DAMPING),
    "wing0-face": CandidateSprings("wing0-face", HINGES, REST_LENGTHS, STIFFNESS, DAMPING),
}
LENGTHS = {"crossed": laws.crossed_length, "altitude": laws.blended_length}
PAIR = np.array([[0, 1, 2, 3]])


@pytest.mark.parametrize("seed", range(4))
def test_lengths_are_those_of_the_candidates(seed):
    x = np.random.default_rng(seed).standard_normal((3, N))
    for hinge in HINGES:
        p = x.T[hinge]
        volume, seven = laws.volume(p), laws.candidates(p)
        heights, areas = (np.array([candidate[k] for candidate in seven]) for k in (0, 2))
        assert heights == pytest.approx(volume / areas, rel=1e-10), "each by its own feet, signs included"
        edge = x.T[hinge[1]] - x.T[hinge[0]]
        defined = np.hypot(areas[0], 0.1 * (edge @ edge))
        assert signed_lengths([hinge], x, kind="crossed") == pytest.approx(volume / defined, rel=1e-12)
        # the blend: 1/h^2 is half the sum of 1/h_c^2 over all seven
        blend = np.sign(volume) * (0.5 * np.sum((areas / volume) ** 2)) ** -0.5
        assert signed_lengths([hinge], x, kind="altitude") == pytest.approx(blend, rel=1e-12)
        # which lies between the shortest candidate over sqrt(7/2) and the shortest itself
        shortest = np.abs(volume / areas).min()
        assert shortest / np.sqrt(3.5) <= np.abs(blend) <= np.sqrt(2) * shortest
    for kind, length in LENGTHS.items():
        squares = [np.sum(length(x.T[hinge])[1] ** 2, axis=1) for hinge in HINGES]
        assert gradient_squares(HINGES, x, kind=kind) == pytest.approx(np.array(squares), rel=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_candidates_have_the_seven_lengths_and_gradients(seed):
    x = np.random.default_rng(seed).standard_normal((3, N))
    for hinge in HINGES:
        for name, (height, gradient, _) in zip(CANDIDATES, seven_of(x.T[hinge]), strict=True):
            springs = CandidateSprings(name, [hinge], 0.0, 1.0)
            assert springs.lengths(x) == pytest.approx(height, rel=1e-9), name
            expected = np.zeros((3, N))
            expected[:, hinge] = -height * gradient.T
            assert force(alone(springs, count=N), x) == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


def seven_of(p):
    """Return the candidates of four points (4, 3) in the order of `CANDIDATES`."""
    edges, faces = laws.candidates(p)[:3], laws.candidates(p)[3:]
    return [*edges, *faces[::-1]]


def test_blend_pulls_by_all_seven_candidates():
    x = np.random.default_rng(2).standard_normal((3, 4))
    areas = np.array([area for _, _, area in seven_of(x.T)])
    blend = signed_lengths(PAIR, x, kind="altitude")[0]
    # Each candidate has its share of the blend's force.
    shares = 0.5 * (areas / np.sqrt(0.5 * np.sum(areas**2))) ** 3
    total = np.zeros((3, 4))
    for share, name in zip(shares, CANDIDATES, strict=True):
        springs = CandidateSprings(name, PAIR, 0.0, 1.0)
        total += share * force(alone(springs, count=4), x) / springs.lengths(x)
    expected = force(alone(AltitudeSprings(PAIR, 0.0, 1.0), count=4), x) / blend
    assert total == pytest.approx(expected, rel=1e-9, abs=1e-10)


def test_some_candidate_acts_on_any_tetrahedron_with_an_area():
    # Flat, folded shut, and inverted: S7 alone has no restoring force across the plane; one candidate at least has.
    for x in map(np.ascontiguousarray, (fold(0.0), fold(np.pi), fold(-0.5), fold(0.0, height1=-1.0, foot1=0.2))):
        defined = [name for name in CANDIDATES if np.isfinite(CandidateSprings(name, PAIR, 0.3, 1.0).lengths(x)).all()]
        forces = [np.abs(force(alone(CandidateSprings(name, PAIR, 0.3, 1.0), count=4), x)).max() for name in defined]
        assert max(forces) > 0.1
    with pytest.raises(ValueError, match="candidate is 'nearest'; there are edge-wings, "):
        CandidateSprings("nearest", PAIR, 0.0, 1.0)


def fold(angle, *, height0=1.0, height1=1.0, foot0=0.5, foot1=0.5, edge=1.0):
    """A hinge with its edge along y, folded by `angle` towards the normal (+z), as (3, 4)."""
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    points = [(0, 0, 0), (0, edge, 0), (-height0 * c, foot0, height0 * s), (height1 * c, foot1, height1 * s)]
    return np.array(points, dtype=float).T


def test_crossed_length_near_flat_is_h1_h2_theta_over_h1_plus_h2():
    for h0, h1, f0, f1 in [(1.0, 1.0, 0.5, 0.5), (0.7, 1.3, 0.2, 0.9), (1.0, 1.0, 0.0, 1.0)]:
        angle = 1e-4
        length = signed_lengths(PAIR, fold(angle, height0=h0, height1=h1, foot0=f0, foot1=f1), kind="crossed")[0]
        lines = h0 * h1 * angle / (h0 + h1)
        assert length == pytest.approx(lines / np.sqrt(1.0 + (0.1 / (h0 + h1)) ** 2), rel=1e-7)


def test_positive_is_the_side_of_the_normal():
    surface = Surface.from_triangles([[0, 1, 2], [1, 0, 3]])
    x = fold(0.3)
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    assert normal[2] > 0 and x[2, 2] > 0
    for kind in LENGTHS:
        assert signed_lengths(surface.hinges, x, kind=kind)[0] > 0
        assert signed_lengths(surface.hinges, fold(-0.3), kind=kind)[0] < 0


def test_undefined_length_is_nan():
    # An edge without length has no direction; four points on a line have no height.
    for kind, x in (
        ("crossed", fold(0.3, edge=0.0)),
        ("altitude", np.outer([1.0, 2.0, 3.0], np.arange(4))),
    ):
        assert np.isnan(signed_lengths(PAIR, x, kind=kind)).all()
        assert (gradient_squares(PAIR, x, kind=kind) == 0.0).all()


@pytest.mark.parametrize("hinges", FORCES.values(), ids=FORCES.keys())
@pytest.mark.parametrize(
    "x",
    [
        np.zeros((3, N)),
        np.outer([1.0, 2.0, 3.0], np.arange(N)),  # all collinear
        np.outer([1.0, 2.0, 3.0], np.arange(N) % 2),  # coincident points
        np.ascontiguousarray(fold(np.pi)[:, np.arange(N) % 4]),  # a symmetric pair folded shut
    ],
    ids=["one point", "collinear", "two points", "shut"],
)
def test_degenerate_states_give_no_nan(hinges, x):
    plan, v = alone(hinges, count=N), np.ones((3, N)) * np.arange(N)
    arrays = [force(plan, x, v), *blocks(plan, x), product(plan, x, v, x + 1.0, v)]
    for single_precision in (False, True):
        (run,), _ = plan.runs(0.0, 0.0, (x, v), [1], single_precision=single_precision)
        arrays += [run.x, run.v]
    for value in (*arrays, plan.energies(0.0, x, v), plan.dissipation(0.0, x, v), plan.spectral_bounds(x)):
        assert np.isfinite(value).all()


@pytest.mark.parametrize("short", 10.0 ** -np.arange(1, 12, 2))
def test_crossed_force_stays_bounded_up_to_a_closed_fold(short):
    for f0, f1 in ((0.5, 0.5), (0.2, 0.8)):
        x = fold(np.pi - short, foot0=f0, foot1=f1)
        assert np.abs(signed_lengths(PAIR, x, kind="crossed")).max() < 1.0
        # 6V vanishes as fast as the lines become parallel: its gradient over M remains, 10 times that of a flat pair
        assert gradient_squares(PAIR, x, kind="crossed").max() < 100.1
    assert signed_lengths(PAIR, fold(np.pi), kind="crossed") == pytest.approx(0.0, abs=1e-13)


@pytest.mark.parametrize("thin", 10.0 ** -np.arange(1, 16, 2))
def test_altitude_force_stays_bounded_down_to_collinear(thin):
    # weights of the lecture's S8 grow without limit as lines turn parallel; those of the blend do not
    x = np.random.default_rng(3).standard_normal((3, 4))
    x[1:] *= thin
    assert np.abs(force(alone(AltitudeSprings(PAIR, 0.5, 1.0), count=4), x)).max() < 2.0


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: AltitudeSprings([[0, 1, 2, 2]], 0.0, 1.0), r"hinge 0 of 'altitude' is \[0, 1, 2, 2\]"),
        (
            lambda: AltitudeSprings([[0, 1, 2, 3]], np.nan, 1.0),
            r"rest_length of 'altitude'\[0\] is nan; it must be fin",
        ),
        (lambda: CrossedSprings([[0, 1]], [[2, 3]], 0.0, -1.0), r"stiffness of 'crossed'\[0\] is -1.0"),
        (lambda: CrossedSprings([[0, 1]], [[2, 3]], [0.0, 1.0], 1.0), "has shape"),
        (
            lambda: OppositeSprings([[2, 3]], 0.0, 1.0),
            r"bending spring 0 \(particles \[2, 3\]\) is 0.0; it must be above 0",
        ),
    ],
)
def test_degenerate_hinges_are_refused(build, words):
    with pytest.raises(ValueError, match=words):
        build()


@pytest.mark.parametrize("kind", [CrossedSprings, AltitudeSprings])
def test_stiffness_bound_is_tight_for_hinges_of_any_shape(kind):
    # far from rest: the part of the length's curvature dominates
    rng = np.random.default_rng(5)
    looseness = []
    for _ in range(300):
        x = rng.standard_normal((3, 4)) * 10.0 ** rng.uniform(-1.5, 0, (3, 1))
        length = signed_lengths(PAIR, x, kind=kind.kind)[0]
        rest_length = length + rng.choice([-1.0, 1.0]) * rng.uniform(0, 3)
        ends = (PAIR,) if kind is AltitudeSprings else (PAIR[:, :2], PAIR[:, 2:])
        plan = alone(kind(*ends, rest_length, 1.0), count=4)
        whole, bound = matrix(plan, x, 0.0 * x, "x"), full(blocks(plan, x)[0])
        largest = np.linalg.eigvalsh(whole)[-1]
        assert np.linalg.eigvalsh(bound - whole)[0] > -1e-9 * np.abs(whole).max()
        looseness.append(np.linalg.eigvalsh(bound)[-1] / largest)
    assert np.median(looseness) < 12.0
