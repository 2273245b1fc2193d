# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contacts with a growing reduced thickness: energy, forces, power of growth, bounds and derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support import laws
from support import self_scenes as own
from support.alone import NO_MEMORY, alone, force, gradient, matrix, product
from support.contact_scenes import SHAPES, THICKNESS, contact, points_near, still
from support.feature_scenes import SMALL, TIME, facing_scene

from cloth_sim_ros.physics.contact.thickness import (
    LAYER_RECOVERY_SPEED,
    MAX_PUSH,
    RECOVERY_SPEED,
    START_GAP,
    check_gaps,
    grown_thickness,
    reduced_thickness,
)
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.controller_state import THICKNESS_KEY, StateMemory

COUNT, DAMPING = 40, 10.0
#: Time for which the thickness has grown, and time of its growth to the full one [s].
GROWN, DURATION = 2e-3, 5e-3 / LAYER_RECOVERY_SPEED
STILL = still((0.3, -0.2, 0.1), (0.5, -0.5, 0.1, 0.7))


def reduce(plan: Plan, *, duration: float = DURATION) -> StateMemory:
    """Return a memory with a random thickness, which has been growing to the full one for a while."""
    contact_binding = plan.contact
    assert contact_binding is not None
    whole = contact_binding.force.thickness
    reduced = np.random.default_rng(3).uniform(0.6, 0.95, contact_binding.thickness_shape) * whole
    contact_binding.force.start_recovery(TIME - GROWN, duration, np.full_like(reduced, whole) if duration else None)
    return {THICKNESS_KEY: reduced}


def scene(kind: str, damping: float) -> tuple[Plan, Array]:
    """Return the plan of contact alone, and positions (3, n) at which it acts with a reduced thickness, too."""
    rng = np.random.default_rng(1)
    if kind == "cloth":
        triangles, rest_positions, x, masses = own.sheets(
            0.0, 0.5 * 4e-3, rough=5e-4, shift=(0.0031, 0.0057), rows=3, columns=3
        )
        return compile(own.alone(triangles, rest_positions, masses, 4e-3, damping=damping)), np.ascontiguousarray(x.T)
    if kind == "points and edges":
        plan, _, x, _, _ = facing_scene(SMALL["box"], 0, damping=damping, path=STILL, gap=0.25)
        return plan, np.ascontiguousarray(x.T)
    x = points_near(SHAPES[kind], STILL, TIME, COUNT, rng, deepest=0.3)
    return alone(contact(kind, paths=[STILL], damping=damping), masses=rng.uniform(0.5, 2.0, COUNT)), x


KINDS = pytest.mark.parametrize("kind", ["plane", "box", "sphere", "cylinder", "cloth", "points and edges"])


def potential(plan: Plan, x: Array, t: float = TIME, memory: StateMemory = NO_MEMORY) -> float:
    return plan.energies(t, x, np.zeros_like(x), memory)[1]


@KINDS
def test_reduced_force_is_minus_the_energy_gradient(kind: str) -> None:
    plan, x = scene(kind, 0.0)
    whole = potential(plan, x)
    memory = reduce(plan, duration=0.0)
    assert 0.0 < potential(plan, x, memory=memory) < whole
    slopes = gradient(lambda places: potential(plan, places, memory=memory), x, step=1e-8)
    assert force(plan, x, t=TIME, memory=memory) == pytest.approx(-slopes, abs=2e-5 * np.abs(slopes).max())


def test_reduced_law_is_that_of_its_own_thickness() -> None:
    plan, x = scene("sphere", 0.0)
    masses = plan.model.masses
    for thickness in (0.7 * THICKNESS, 0.9 * THICKNESS):
        contact_binding = plan.contact
        assert contact_binding is not None
        contact_binding.force.start_recovery(TIME)
        memory = {THICKNESS_KEY: np.full(contact_binding.thickness_shape, thickness)}
        # The law of another thickness with a proportional U: the same squared frequencies at the same s.
        thin = contact("sphere", paths=[STILL], damping=0.0, thickness=thickness)
        expected, _ = laws.contact(TIME, x, np.zeros_like(x), thin, masses)
        share = thickness / THICKNESS
        assert potential(plan, x, memory=memory) == pytest.approx(share**2 * expected.energy, rel=1e-9)
        assert force(plan, x, t=TIME, memory=memory) == pytest.approx(
            share**2 * expected.force, rel=1e-8, abs=1e-9 * np.abs(expected.force).max()
        )


@KINDS
@pytest.mark.parametrize("damping", [0.0, DAMPING])
def test_growth_power_closes_the_energy_balance(kind: str, damping: float) -> None:
    plan, x = scene(kind, damping)
    memory = reduce(plan)
    assert plan.contact is not None
    v = 0.1 * np.random.default_rng(5).normal(size=x.shape)
    h = 1e-7
    # Power of these forces on the motion, and the gain of contact energy.
    change = (potential(plan, x + h * v, TIME + h, memory) - potential(plan, x - h * v, TIME - h, memory)) / (2.0 * h)
    done = float((force(plan, x, v, TIME, memory) * v).sum())
    grown, dissipation = plan.contact.recovery_power(TIME, x, v, memory), plan.dissipation(TIME, x, v, memory)
    size = abs(change) + abs(done) + grown + dissipation
    assert grown > 1e-3 * size
    assert (dissipation > 0.0) == (damping > 0.0)
    assert change + done - grown + dissipation == pytest.approx(0.0, abs=1e-5 * size)


@KINDS
def test_growth_ends_with_the_whole_law(kind: str) -> None:
    # Damping feels the growth up to its end.
    plan, x = scene(kind, 0.0)
    v = np.random.default_rng(5).normal(size=x.shape)
    whole = force(plan, x, v, TIME), potential(plan, x)
    memory = reduce(plan)
    assert plan.contact is not None
    later = TIME - GROWN + DURATION
    assert not np.array_equal(force(plan, x, v, TIME, memory), whole[0])
    assert memory[THICKNESS_KEY].max() < plan.contact.force.thickness
    assert force(plan, x, v, later, memory) == pytest.approx(whole[0], rel=1e-12, abs=1e-12 * np.abs(whole[0]).max())
    assert potential(plan, x, later, memory) == pytest.approx(whole[1], rel=1e-12)
    assert np.array_equal(force(plan, x, v, TIME), whole[0])
    assert plan.contact.recovery_power(TIME, x, v, memory={}) == 0.0


@KINDS
def test_contacts_grow_at_rates_of_their_own(kind: str) -> None:
    plan, x = scene(kind, 0.0)
    reduced, contact_binding = reduce(plan)[THICKNESS_KEY], plan.contact
    assert contact_binding is not None
    rng = np.random.default_rng(4)
    # Half of them do not grow, the others to a part of the whole thickness.
    parts = rng.uniform(0.0, 1.0, reduced.shape) * (rng.uniform(size=reduced.shape) < 0.5)
    after = reduced + parts * (contact_binding.force.thickness - reduced)
    for share in (0.25, 1.0):
        contact_binding.force.start_recovery(TIME - share * DURATION, DURATION, after)
        grown = force(plan, x, t=TIME, memory={THICKNESS_KEY: reduced})
        contact_binding.force.start_recovery(TIME)
        memory = {THICKNESS_KEY: reduced + share * (after - reduced)}
        assert grown == pytest.approx(force(plan, x, t=TIME, memory=memory), rel=1e-9, abs=1e-9 * np.abs(grown).max())
        assert contact_binding.recovery_power(TIME, x, np.zeros_like(x), memory) == 0.0


def test_contacts_grow_up_to_the_max_push() -> None:
    plan, x = scene("plane", 0.0)
    contact_binding = plan.contact
    assert contact_binding is not None
    # The force by the engine's law, at gaps around the one at which growth stops.
    gaps = contact_binding.contact_gaps(TIME, x, memory={})
    reduced = gaps / np.linspace(0.9, 0.99, gaps.shape[1])
    thickness = contact_binding.force.thickness
    reduced[~(reduced < thickness)] = thickness
    contact_binding.force.start_recovery(TIME)
    push = np.linalg.norm(force(plan, x, t=TIME, memory={THICKNESS_KEY: reduced}), axis=0) / plan.model.masses
    after = grown_thickness(reduced, gaps, thickness, 1e-3)
    assert after is not None
    grows, below = (after > reduced)[0, :-1], reduced[0, :-1] < thickness
    assert np.array_equal(grows, below & (push <= MAX_PUSH))
    assert min(grows.sum(), (below & ~grows).sum()) > 5


@KINDS
def test_reduced_derivative_product_is_the_difference(kind: str) -> None:
    plan, x = scene(kind, DAMPING)
    memory = reduce(plan)
    rng = np.random.default_rng(2)
    v, dx, dv = (0.3 * rng.normal(size=x.shape) for _ in range(3))
    zero, h = np.zeros_like(x), 1e-9
    by_place = (force(plan, x + h * dx, v, TIME, memory) - force(plan, x - h * dx, v, TIME, memory)) / (2.0 * h)
    by_speed = (force(plan, x, v + 1e-6 * dv, TIME, memory) - force(plan, x, v - 1e-6 * dv, TIME, memory)) / 2e-6
    assert product(plan, x, v, dx, zero, TIME, memory) == pytest.approx(by_place, abs=2e-4 * np.abs(by_place).max())
    assert product(plan, x, v, zero, dv, TIME, memory) == pytest.approx(by_speed, abs=1e-5 * np.abs(by_speed).max())


@KINDS
def test_bounds_hold_with_a_reduced_thickness(kind: str) -> None:
    plan, x = scene(kind, DAMPING)
    # At rest, without growth.
    memory = reduce(plan, duration=0.0)
    stiff, damped = np.zeros((2, 6, x.shape[1]))
    plan.add_bounds(x, stiff, damped, TIME, memory)
    zero = np.zeros_like(x)
    for part, bound in (("x", stiff), ("v", damped)):
        whole = matrix(plan, x, zero, part, TIME, memory)
        most = np.linalg.eigvalsh(0.5 * (whole + whole.T))[-1]
        assert 0.0 < most <= bound[:3].sum(axis=0).max() * (1.0 + 1e-9)


def test_predicted_bounds_follow_the_growth() -> None:
    plan, x = scene("plane", DAMPING)
    contact_binding = plan.contact
    assert contact_binding is not None
    normals = force(plan, x, t=TIME)
    assert (np.abs(normals).max(axis=0) > 0.0).sum() > 10
    memory = reduce(plan)
    grows = contact_binding.predict_contact(TIME, 1e-3, x, np.zeros_like(x), memory)
    contact_binding.force.start_recovery(TIME - GROWN)
    stands = contact_binding.predict_contact(TIME, 1e-3, x, np.zeros_like(x), memory)
    assert grows[0] > stands[0] > 0.0
    # Present bounds of a contact are at most those predicted.
    memory = reduce(plan)
    matrices = matrix(plan, x, np.zeros_like(x), "x", TIME, memory)
    scaled = matrices / np.tile(plan.model.masses, 3)[:, None]
    assert np.linalg.eigvals(scaled).real.max() <= grows[0] * (1.0 + 1e-9)


def test_reduced_thickness_leaves_the_rest_gap() -> None:
    gaps = np.array([[0.1, 0.95, 0.97], [np.inf, 2.0, 0.5]])
    assert reduced_thickness(gaps, 1.0) == pytest.approx(
        np.array([[0.1 / 0.98, 0.95 / 0.98, 1.0], [1.0, 1.0, 0.5 / 0.98]])
    )
    # Above the rest gap alone nothing is reduced.
    assert reduced_thickness(np.array([[0.96, np.inf]]), 1.0) is None


def test_layers_regain_their_thickness_more_slowly() -> None:
    # The last row is of the cloth with itself.
    reduced, thickness = np.array([[1.2e-3, 1.9e-3, 2e-3], [1.2e-3, 1.95e-3, 2e-3]]), 2e-3
    gaps, duration = START_GAP * reduced, 2e-4 / RECOVERY_SPEED
    after = grown_thickness(reduced, gaps, thickness, duration)
    assert after is not None
    layer = 1.2e-3 + LAYER_RECOVERY_SPEED * duration
    assert after == pytest.approx(np.array([[1.4e-3, 2e-3, 2e-3], [layer, 2e-3, 2e-3]]))
    assert layer < 1.4e-3
    whole = grown_thickness(after, START_GAP * after, thickness, (thickness - layer) / LAYER_RECOVERY_SPEED + duration)
    assert whole is not None
    assert (whole == thickness).all()
    # The thickness is full, or the cloth has not followed.
    assert grown_thickness(whole, START_GAP * whole, thickness, duration) is None
    assert grown_thickness(reduced, 0.5 * reduced, thickness, duration) is None


@pytest.mark.parametrize(
    ("gaps", "words"),
    [
        ([[0.019, 0.5, 1.0], [1.0, 1.0, 1.0]], r"0.019 m from obstacle 'it' at particle 0; it must be 0.02 m at least"),
        ([[0.01, 0.015, 1.0], [1.0, 1.0, 1.0]], r"at particle 0 and 1 more; .* move them 0.99 m apart"),
        ([[1.0, 1.0, 0.01], [1.0, 1.0, 1.0]], r"0.01 m from obstacle 'it'; it must"),
        ([[1.0, 1.0, 1.0], [1.0, 0.01, 1.0]], r"0.01 m from itself at particle 1; .* 0.02 of contact.thickness"),
    ],
)
def test_gaps_too_narrow_are_refused_with_the_lift(gaps: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check_gaps(np.array(gaps), 1.0, ["it"])
