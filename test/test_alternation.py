# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weak springs at every second step: when that is stable, and when it is done."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.bench.problems import PERIOD, carried
from cloth_sim_ros.bench.raw_sheet import RawSheet
from cloth_sim_ros.physics.alternation import stable_share
from cloth_sim_ros.physics.automatic import make_integrator
from cloth_sim_ros.physics.integrators.base import restart
from cloth_sim_ros.physics.integrators.control import SHARE_PER_SECOND, Memory
from cloth_sim_ros.physics.integrators.extrapolated import Extrapolated
from cloth_sim_ros.physics.integrators.march import leapfrog_limit
from cloth_sim_ros.physics.kernels.grid_leapfrog import GridLeapfrog
from cloth_sim_ros.physics.kernels.grid_springs import GridFamily, GridSprings
from cloth_sim_ros.physics.kernels.leapfrog import largest_distance
from cloth_sim_ros.physics.state import State


def families(k_d0: float, shear: float = 200.0, parity: int | None = None) -> tuple[GridFamily, ...]:
    """A raw sheet's springs, of rest length 0.05 m, with other damping or shear."""
    spacing, mass = 0.05, 5e-4
    kinds = [
        ("right", 1.0, 1000.0),
        ("down", 1.0, 1000.0),
        ("diagonal", 2**0.5, shear),
        ("antidiagonal", 2**0.5, shear),
    ]
    return tuple(
        GridFamily(
            *(name, modulus * spacing, reach * spacing, k_d0 * np.sqrt(modulus * mass / reach)),
            parity=parity if "diagonal" in name else None,
            weak="diagonal" in name,
        )
        for name, reach, modulus in kinds
    )


def limit(springs: tuple[GridFamily, ...], mass: float) -> float:
    """Step limit at rest [s], for the wave that moves neighbours in opposite directions along one axis."""
    along = {family.name: (family.stiffness / family.rest_length, family.damping) for family in springs}
    omega2, rate = (4.0 * (along["right"][part] + along["diagonal"][part]) / mass for part in (0, 1))
    return leapfrog_limit(omega2, rate)


def growth(springs: tuple[GridFamily, ...], share: float) -> float:
    """How much a small random motion within a flat sheet grows over 200 steps at a share of the step limit."""
    rows, columns, mass = 9, 10, 5e-4
    loop = GridLeapfrog(GridSprings(rows, columns, springs), np.full(rows * columns, 1.0 / mass))
    down, right = np.divmod(np.arange(rows * columns), columns)
    x = 0.05 * np.stack([right, down, 0.0 * down])
    v = 1e-9 * np.random.default_rng(1).standard_normal(x.shape)
    v[2] = 0.0
    first = np.abs(v).max()
    for _ in range(8):
        loop.advance(x, v, 25, share * limit(springs, mass), alternate=True)
    return float(np.abs(v).max() / first)


@pytest.mark.parametrize("k_d0", [0.2, 0.3, 0.6])
def test_damping_makes_it_stable(k_d0: float) -> None:
    springs = families(k_d0, shear=150.0)
    share = stable_share(springs, 5e-4)
    assert share >= 0.9
    assert growth(springs, share) < 1.0


@pytest.mark.parametrize("k_d0", [0.0, 0.02, 0.05])
def test_fast_waves_resonate_where_damping_is_weak(k_d0: float) -> None:
    springs = families(k_d0, shear=300.0)
    assert stable_share(springs, 5e-4) == 0.0
    # It may have left all bounds.
    assert not growth(springs, 0.95) < 1e3


def test_nothing_is_said_of_what_is_no_lattice() -> None:
    assert stable_share(families(0.6, parity=0), 5e-4) == 0.0
    strong = tuple(family._replace(weak=False) for family in families(0.6))
    assert stable_share(strong, 5e-4) == 0.0


def frames(tolerance: float, count: int, **sheet: float) -> tuple[list[str], State]:
    """What was said of each frame of a sheet that falls from flat, held by an edge."""
    made = RawSheet(resolution=40, drag=1.0, **sheet)  # type: ignore[arg-type]
    dynamics, state = made.dynamics(made.index[0]), State(made.flat(hung=False))
    said = []
    for frame in range(count):
        if frame == 12:
            restart(state)
        said.append(Extrapolated(tolerance=tolerance).advance(dynamics, state, frame * PERIOD, PERIOD).reason)
    return said, state


def test_a_loose_tolerance_takes_weak_springs_less_often() -> None:
    said, loose = frames(2e-3, 18)
    assert sum("every second step" in reason for reason in said) >= 15
    memory = Memory.of(loose)
    assert 0.0 < memory.alternating < SHARE_PER_SECOND * PERIOD * 2e-3
    _, tight = frames(1e-6, 18)
    assert 1e-7 < np.abs(loose.x - tight.x).max() < 1e-3


@pytest.mark.parametrize(("tolerance", "sheet"), [(1e-4, {}), (2e-3, {"k_d0": 0.05})])
def test_otherwise_they_are_taken_at_every_step(tolerance: float, sheet: dict[str, float]) -> None:
    said, _ = frames(tolerance, 4, **sheet)
    assert not any("every second step" in reason for reason in said)


def test_a_stretched_sheet_takes_them_at_every_step() -> None:
    made = RawSheet(resolution=40, drag=1.0)
    dynamics, state = made.dynamics(made.index[0]), State(1.4 * made.flat(hung=False))
    reason = Extrapolated(tolerance=2e-3).advance(dynamics, state, 0.0, PERIOD).reason
    assert "every second step" not in reason


def test_what_it_loses_is_followed_while_a_motion_gets_going() -> None:
    """A corner is carried off from rest: what the weak springs lose grows tenfold within a few frames."""
    ends = []
    for tolerance in (1e-3, 1e-8):
        scene = carried(16)
        dynamics, state = scene.build()
        integrator = make_integrator("auto", tolerance=tolerance)
        for frame in range(scene.frames):
            integrator.advance(dynamics, state, frame * PERIOD, PERIOD)
        ends.append(state.x)
    assert largest_distance(*ends) < 0.5e-3
