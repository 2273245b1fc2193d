# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""S1 to S4 against exact solutions."""

import attrs
import numpy as np
import pytest
from scipy.linalg import expm
from support.alone import alone, force, product

from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.chain import Chain, SpringLaw, joint
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.state import State

LAW = SpringLaw(mass=0.3, rest_length=0.25, stiffness=40.0)


def advance(model, state, duration, steps):
    Leapfrog(duration / steps).advance(compile(model), state, 0.0, duration)
    return state


def oscillator(k, c, m, u, w, t):
    """Exact u'' = -(k u + c u')/m by the matrix exponential: all regimes, the critical one included."""
    return expm(t * np.array([[0.0, 1.0], [-k / m, -c / m]])) @ [u, w]


def observed_order(error, counts):
    errors = [error(count) for count in counts]
    return np.polyfit(np.log(counts), np.log(errors), 1)[0] * -1, errors


@pytest.mark.parametrize("k_d0", [0.0, 0.3, 2.0, 3.0], ids=["undamped", "under", "critical", "over"])
def test_simple_spring_with_one_end_fixed(k_d0):
    chain = Chain(law=attrs.evolve(LAW, k_d0=k_d0), particle_count=2, half_ends=False)
    duration, stretch, speed = 0.9, 0.05, -0.2
    exact = oscillator(LAW.stiffness / LAW.rest_length, chain.law.damping, LAW.mass, stretch, speed, duration)

    def error(steps):
        state = chain.state()
        state.x[0, 1] += stretch
        state.v[0, 1] = speed
        advance(chain.model(), state, duration, steps)
        return max(
            abs(state.x[0, 1] - LAW.rest_length - exact[0]) / stretch, abs(state.v[0, 1] - exact[1]) / abs(speed)
        )

    order, errors = observed_order(error, [400, 800, 1600])
    assert abs(order - 2.0) < 0.05, errors
    # Second order all the way down: 1e-10 of the stretch.
    assert error(int(1600 * np.sqrt(errors[-1] / 0.8e-10))) < 1e-10


@pytest.mark.parametrize("k_d0", [0.3, np.sqrt(2.0), 4.0], ids=["under", "critical", "over"])
def test_simple_spring_between_two_free_masses(k_d0):
    """The pair oscillates with the reduced mass; critical damping is k_d0 = sqrt(2)."""
    chain = Chain(law=attrs.evolve(LAW, k_d0=k_d0), particle_count=2, half_ends=False, anchored="none")
    exact = oscillator(LAW.stiffness / LAW.rest_length, chain.law.damping, LAW.mass / 2, 0.05, 0.0, 0.5)
    state = chain.state()
    state.x[0, 1] += 0.05
    state.v[1] = 0.7
    advance(chain.model(), state, 0.5, 20000)
    assert state.x[0, 1] - state.x[0, 0] - LAW.rest_length == pytest.approx(exact[0], abs=1e-8)
    assert state.x[1] == pytest.approx([0.35, 0.35], abs=1e-12), "a spring at right angles to the motion drags it"


@pytest.mark.parametrize("k_d0", [0.0, 0.3, 2.0, 3.0])
def test_zero_length_spring_is_linear_and_passes_through_zero(k_d0):
    stiffness, mass, duration = 50.0, 0.2, 1.1
    spring = joint((0, 1), stiffness=stiffness, k_d0=k_d0, mass=mass)
    start, speed = np.array([0.3, -0.1, 0.0]), np.array([0.0, 0.4, 1.0])
    damping = k_d0 * np.sqrt(mass * stiffness)

    def error(steps):
        state = State([[0, 0, 0], start], [[0, 0, 0], speed])
        advance(Model([mass, mass], [spring], anchors=[0]), state, duration, steps)
        exact = [oscillator(stiffness, damping, mass, u, w, duration) for u, w in zip(start, speed, strict=True)]
        return np.abs(np.stack([state.x[:, 1], state.v[:, 1]], axis=1) - exact).max()

    order, errors = observed_order(error, [400, 800, 1600])
    assert abs(order - 2.0) < 0.05, errors
    # Straight through s = 0: the direction is not lost there.
    state = State([[0, 0, 0], [0.1, 0, 0]])
    advance(
        Model([mass, mass], [joint((0, 1), stiffness=stiffness, k_d0=0.0, mass=mass)], anchors=[0]),
        state,
        np.pi / np.sqrt(stiffness / mass),
        4000,
    )
    assert state.x[0, 1] == pytest.approx(-0.1, abs=1e-7)


def chain_matrices(chain):
    """Return stiffness K and damping C of the longitudinal motion, assembled independently of the package."""
    n, law = chain.particle_count, chain.law
    difference = np.zeros((n - 1, n))
    difference[np.arange(n - 1), np.arange(n - 1)] = -1.0
    difference[np.arange(n - 1), np.arange(1, n)] = 1.0
    laplacian = difference.T @ difference
    return law.stiffness / law.rest_length * laplacian, law.damping * laplacian


@pytest.mark.parametrize("anchored", ["none", "first", "both"])
@pytest.mark.parametrize("k_d0", [0.0, 0.2, 1.5])
def test_chain_moves_as_the_matrix_exponential_says(anchored, k_d0):
    chain = Chain(law=attrs.evolve(LAW, k_d0=k_d0), particle_count=9, anchored=anchored)
    rng = np.random.default_rng(5)
    free = np.setdiff1d(np.arange(9), chain.anchors)
    u, w = np.zeros(9), np.zeros(9)
    u[free], w[free] = 0.02 * rng.standard_normal(free.size), 0.3 * rng.standard_normal(free.size)
    stiffness, damping = (matrix[np.ix_(free, free)] for matrix in chain_matrices(chain))
    inverse = 1.0 / chain.masses()[free][:, None]
    generator = np.block(
        [[np.zeros((free.size, free.size)), np.eye(free.size)], [-inverse * stiffness, -inverse * damping]]
    )
    exact = expm(0.4 * generator) @ np.concatenate([u[free], w[free]])

    def error(steps):
        state = chain.state()
        state.x[0] += u
        state.v[0] = w
        advance(chain.model(), state, 0.4, steps)
        return np.abs(state.x[0, free] - chain.positions()[free, 0] - exact[: free.size]).max()

    order, errors = observed_order(error, [400, 800, 1600])
    assert abs(order - 2.0) < 0.1, errors


@pytest.mark.parametrize(
    ("anchored", "half_ends", "wave"),
    [
        ("both", True, lambda j, n: j / (n - 1)),
        ("none", False, lambda j, n: j / n),
        ("none", True, lambda j, n: j / (n - 1)),
    ],
)
def test_chain_modes_have_the_discrete_dispersion_and_damping(anchored, half_ends, wave):
    """W = 2 lambda sin(q l0 / 2), damping ratio k_d0 sin(q l0 / 2), for the modes of the product's own Jacobian.

    `wave` gives q l0 / pi; a chain of n particles with both ends anchored has n - 2 free ones between.
    """
    n, k_d0 = 14, 0.05
    chain = Chain(law=attrs.evolve(LAW, k_d0=k_d0), particle_count=n, anchored=anchored, half_ends=half_ends)
    model, state = chain.model(), chain.state()
    plan, free = compile(model), np.setdiff1d(np.arange(n), chain.anchors)
    jacobians = []
    for part in (0, 1):
        columns = []
        for particle in free:
            push, nothing = np.zeros((3, n)), np.zeros((3, n))
            push[0, particle] = 1.0
            moved = (push, nothing) if part == 0 else (nothing, push)
            out = product(plan, state.x, state.v, *moved)
            columns.append(out[0, free] * model.inverse_masses[free])
        jacobians.append(np.array(columns).T)
    generator = np.block([[np.zeros((free.size, free.size)), np.eye(free.size)], jacobians])
    roots = np.linalg.eigvals(generator)
    frequencies = np.sort(np.abs(roots[roots.imag > 1e-6]))
    modes = range(1, free.size + 1 if anchored == "both" else free.size)
    sines = np.sin(0.5 * np.pi * np.array([wave(j, n) for j in modes]))
    assert frequencies == pytest.approx(2.0 * LAW.frequency * sines, rel=1e-6)
    damped = roots[roots.imag > 1e-6]
    ratios = (-damped.real / np.abs(damped))[np.argsort(np.abs(damped))]
    assert ratios == pytest.approx(k_d0 * sines, rel=1e-6)


def test_an_undamped_chain_is_stable_up_to_one_over_lambda():
    chain = Chain(law=LAW, particle_count=40, anchored="both")
    omega2, damping = compile(chain.model()).spectral_bounds(chain.state().x)
    limit = Leapfrog().step_limit(omega2, damping)
    assert limit == pytest.approx(LAW.stable_step, rel=1e-12)


def test_pulse_travels_at_the_speed_of_sound():
    chain = Chain(law=SpringLaw(mass=0.001, rest_length=0.005, stiffness=20.0), particle_count=801, anchored="both")
    c, x0, width = chain.law.sound_speed, chain.positions()[:, 0], 0.15
    pulse = 1e-3 * np.exp(-(((x0 - 1.0) / width) ** 2))
    state = chain.state()
    state.x[0] += pulse
    # Moving to the right only: u = g(x - c t), v = -c g'.
    state.v[0] = 2.0 * c * (x0 - 1.0) / width**2 * pulse
    state.v[0, [0, -1]] = 0.0
    Leapfrog().advance(compile(chain.model()), state, 0.0, 2.0 / c)
    moved = state.x[0] - x0
    centre = np.sum(x0 * moved**2) / np.sum(moved**2)
    assert centre == pytest.approx(3.0, rel=1e-3)


def test_the_refinement_table_of_the_lecture():
    """Resolution doubled in one dimension: m/2, l0/2, k_s, k_d and c as they were, lambda doubled, stable step
    halved.
    """
    law = attrs.evolve(LAW, k_d0=0.4)
    fine = law.refined()
    assert fine.mass == law.mass / 2
    assert fine.rest_length == law.rest_length / 2
    assert fine.stiffness == law.stiffness
    assert fine.damping == pytest.approx(law.damping, rel=1e-15)
    assert fine.sound_speed == pytest.approx(law.sound_speed, rel=1e-15)
    assert fine.frequency == pytest.approx(2 * law.frequency, rel=1e-15)
    assert fine.stable_step == pytest.approx(law.stable_step / 2, rel=1e-15)
    chain = Chain(law=law, particle_count=5, anchored="none")
    for stretched in (chain, chain.refined()):
        assert stretched.masses().sum() == pytest.approx(4 * law.mass, rel=1e-14), "total mass is exact"
        assert stretched.length == pytest.approx(4 * law.rest_length, rel=1e-15)
        state = stretched.state()
        state.x[0] *= 1.1
        f = force(alone(*stretched.model().forces, count=stretched.particle_count), state.x)
        assert f[0, 0] == pytest.approx(0.1 * law.stiffness, rel=1e-12), "the force stays, so the acceleration doubles"


def test_the_refinement_table_of_a_sheet():
    law = attrs.evolve(LAW, k_d0=0.4)
    fine = law.refined(dimension=2)
    assert (fine.mass, fine.stiffness) == (law.mass / 4, law.stiffness / 2)
    assert fine.damping == pytest.approx(law.damping / 2, rel=1e-15)
    assert fine.frequency == pytest.approx(2 * law.frequency, rel=1e-15)
    assert fine.sound_speed == pytest.approx(law.sound_speed, rel=1e-15)


def slow_mode(chain):
    """Return frequency and damping rate of the slowest mode of a chain with anchored ends, assembled independently."""
    stiffness, damping = (matrix[1:-1, 1:-1] for matrix in chain_matrices(chain))
    mass = chain.law.mass
    k, c = (np.linalg.eigvalsh(matrix)[0] for matrix in (stiffness, damping))
    return np.sqrt(k / mass), 0.5 * c / mass


def test_refinement_converges_frequency_but_loses_k_d0_damping():
    coarse = Chain(law=attrs.evolve(LAW, k_d0=0.4), particle_count=9, anchored="both")
    viscous = Chain(law=attrs.evolve(LAW, viscosity=LAW.rest_length * 0.5), particle_count=9, anchored="both")
    exact = np.pi * LAW.sound_speed / coarse.length
    errors, rates, viscous_rates = [], [], []
    for factor in (1, 2, 4, 8):
        frequency, rate = slow_mode(coarse.refined(factor))
        errors.append(abs(frequency - exact))
        rates.append(rate)
        viscous_rates.append(slow_mode(viscous.refined(factor))[1])
    assert np.array(errors[:-1]) / errors[1:] == pytest.approx([4, 4, 4], rel=0.05), "second order in l0"
    assert np.array(rates[:-1]) / rates[1:] == pytest.approx([2, 2, 2], rel=0.05), "the lecture's law: it goes as l0"
    q = np.pi / coarse.length
    law = coarse.law
    assert rates[-1] == pytest.approx(0.5 * law.k_d0 * law.sound_speed * q**2 * law.rest_length / 8, rel=0.01)
    assert viscous_rates[-1] == pytest.approx(viscous_rates[-2], rel=0.01), "a viscosity converges"


@pytest.mark.parametrize("particle_count", [2, 3, 17, 200])
def test_a_hanging_chains_tip_is_exact_at_any_resolution(particle_count):
    """With half a mass at the tip the stretch is M g L / (2 k_s) for any number of springs."""
    total, length, k_s, g = 0.6, 1.2, 30.0, 9.81
    springs = particle_count - 1
    law = SpringLaw(mass=total / springs, rest_length=length / springs, stiffness=k_s)
    chain = Chain(law=law, particle_count=particle_count)
    model = chain.model(gravity=(g, 0.0, 0.0))
    below = total - law.mass * (np.arange(springs) + 0.5)
    state = chain.state()
    state.x[0, 1:] = np.cumsum(law.rest_length * (1.0 + below * g / k_s))
    a = np.zeros_like(state.x)
    compile(model).accelerations(0.0, state.x, state.v, a)
    assert np.abs(a).max() < 1e-9 * springs, "the shape is in equilibrium by the product's own forces"
    assert state.x[0, -1] == pytest.approx(length * (1.0 + total * g / (2 * k_s)), rel=1e-13)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mass": 0.0}, "mass is 0.0"),
        ({"rest_length": -1.0}, "rest_length is -1.0"),
        ({"stiffness": float("nan")}, "stiffness is nan"),
        ({"k_d0": 0.1, "viscosity": 0.1}, "give one of them"),
    ],
)
def test_invalid_spring_values_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        attrs.evolve(LAW, **change)


@pytest.mark.parametrize("anchored", ["none", "first", "both"])
@pytest.mark.parametrize("k_d0", [0.0, 0.2, 1.0, 1.5])
def test_a_chains_motion_is_exact_to_1e_10_by_a_high_order(anchored, k_d0):
    """Chain (S2) and, by its springs' joints at rest length zero, S4: relative to the largest displacement."""
    chain = Chain(law=attrs.evolve(LAW, k_d0=k_d0), particle_count=9, anchored=anchored)
    rng = np.random.default_rng(8)
    free = np.setdiff1d(np.arange(9), chain.anchors)
    u, w = np.zeros(9), np.zeros(9)
    u[free], w[free] = 0.02 * rng.standard_normal(free.size), 0.3 * rng.standard_normal(free.size)
    stiffness, damping = (matrix[np.ix_(free, free)] for matrix in chain_matrices(chain))
    inverse = 1.0 / chain.masses()[free][:, None]
    generator = np.block(
        [[np.zeros((free.size, free.size)), np.eye(free.size)], [-inverse * stiffness, -inverse * damping]]
    )
    exact = expm(0.4 * generator) @ np.concatenate([u[free], w[free]])
    for joints in (False, True):
        state, model = chain.state(), chain.model()
        rest_positions = chain.positions()
        if joints:
            springs = model.forces[0]
            model = Model(
                chain.masses(),
                [PairSprings(springs.pairs, 0.0, springs.rigidity, springs.damping)],
                anchors=chain.anchors,
            )
            rest_positions = np.zeros_like(rest_positions)
            state = State(rest_positions)
        state.x[0] += u
        state.v[0] = w
        Extrapolated(n_runs=4, step=2e-4).advance(compile(model), state, 0.0, 0.4)
        error = np.abs(state.x[0, free] - rest_positions[free, 0] - exact[: free.size]).max()
        assert error < 1e-10 * np.abs(exact[: free.size]).max()
