# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`simulate`: arguments, refusals, and motions without a force that bounds the step."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import (
    Drag,
    Extrapolated,
    Force,
    Gravity,
    Leapfrog,
    Model,
    PairSprings,
    Scene,
    Simulation,
    State,
    SymplecticEuler,
    simulate,
)
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene as NodeScene


def pair(k_s: float = 10.0) -> Model:
    return Model([1.0, 1.0], [PairSprings([[0, 1]], 1.0, k_s, 0.0)])


def apart() -> State:
    return State([[0.0, 0.0, 0.0], [1.1, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("until", "options", "words"),
    [
        (0.5, {"save_at": []}, "save_at is []"),
        (0.5, {"save_at": "abc"}, "save_at is 'abc'"),
        (0.5, {"save_at": [0.2, 0.1]}, "ascend"),
        (0.5, {"save_at": [0.6]}, "from 0 to until, 0.5 s"),
        (0.5, {"save_at": [np.nan]}, "finite"),
        (0.5, {"integrator": "auto"}, "integrator is 'auto'"),
        (0.5, {"tolerance": "a"}, "tolerance is 'a'"),
        (0.5, {"tolerance": 1e-8, "integrator": Leapfrog()}, "give it there, Leapfrog(tolerance=1e-08)"),
        (0.5, {"tolerance": 1e-8, "integrator": SymplecticEuler(step=1e-4)}, "decides on its own: leave it out"),
        (None, {}, "until is nan"),
        (-1.0, {}, "until is -1.0 s; it must be above 0"),
        (10**400, {}, "until is 1000"),
    ],
)
def test_invalid_arguments_are_refused(until: Any, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        simulate(pair(), apart(), until, **options)


def test_state_refuses_a_negative_frame() -> None:
    with pytest.raises(ValueError, match="frame is -5"):
        State([[0.0, 0.0, 0.0]], frame=-5)


def test_unstable_motion_reports_its_bounds() -> None:
    with pytest.raises(UnstableError, match="no step is short enough: the highest frequency"):
        simulate(pair(1e160), apart(), 0.1)
    with pytest.raises(UnstableError, match="reduce stiffness, damping or drag"):
        simulate(Model([1.0], [Drag(1e300)]), State([[0.0, 0.0, 0.0]]), 0.1)


@pytest.mark.parametrize(("forces", "drop_height"), [([], 0.0), ([Gravity()], 0.5 * 9.81 * 0.05**2)])
def test_single_particle_moves_without_a_step_limit(forces: list[Force], drop_height: float) -> None:
    # Within the default tolerance in this number of frames, and far below it.
    motion = simulate(Model([1.0], forces), State([[0.0, 0.0, 0.0]]), 0.05)
    np.testing.assert_allclose(motion.positions[-1], [[0.0, 0.0, -drop_height]], rtol=0, atol=1e-6)


def test_fully_anchored_cloth_stays() -> None:
    held = ["top", "bottom", *map(str, range(4, 12))]
    values = {"cloth.size": [0.3, 0.3], "cloth.resolution": [4, 4], "cloth.anchors": held}
    simulation = Simulation(Scene.from_parameters(values))
    before = simulation.positions
    for _ in range(3):
        simulation.advance()
    assert np.array_equal(simulation.positions, before)


def test_library_and_node_have_the_same_tolerance() -> None:
    motions = []
    for options in ({}, {"tolerance": NodeScene().tolerance}):
        motion = simulate(pair(), apart(), 0.5, **options)
        motions.append(motion.positions)
    assert np.array_equal(*motions)


def fast_spring(frequency: float = 9000.0) -> tuple[Model, State]:
    """Return a mass of 0.1 kg on a spring of 1 m, stretched by 0.01 m, with an angular frequency [rad/s]."""
    spring = PairSprings([[0, 1]], 1.0, 0.1 * frequency**2, 0.0)
    return Model([0.1, 0.1], [spring], anchors=[0]), State([[0.0, 0.0, 0.0], [1.01, 0.0, 0.0]])


def test_dense_save_times_hold_the_tolerance() -> None:
    times = np.arange(1, 201) * 1e-5
    motion = simulate(*fast_spring(), 2e-3, save_at=times, tolerance=1e-6)
    exact = 1.0 + 0.01 * np.cos(9000.0 * times)
    assert motion.flagged == 0
    assert np.abs(motion.positions[:, 1, 0] - exact).max() < 0.1 * 1e-6


@pytest.mark.parametrize(("frame", "tolerance"), [(1e-6, 1e-8), (1e-4, 1e-10)])
def test_advances_below_rounding_do_not_refine_for_ever(frame: float, tolerance: float) -> None:
    # The tolerance of a frame is 6e-15 m, which is the rounding of a few steps.
    times = np.arange(1, 201) * frame
    motion = simulate(*fast_spring(), 200 * frame, save_at=times, tolerance=tolerance)
    advances = motion.advances
    first, last = (sum(advance.evaluations for advance in half) for half in (advances[:100], advances[100:]))
    assert last < 1.5 * first
    assert first + last < 300 * len(advances)


def test_flagged_counts_advances_beyond_the_work_limit() -> None:
    limited = Extrapolated(tolerance=1e-9, work=1e-4)
    motion = simulate(*fast_spring(), 0.1, integrator=limited)
    assert 0 < motion.flagged == sum(advance.flagged > 0 for advance in motion.advances)
    assert simulate(*fast_spring(), 0.1, tolerance=1e-9).flagged == 0


def test_positions_are_no_state() -> None:
    with pytest.raises(ValueError, match=r"state is of type ndarray; make one: State\(positions\)"):
        simulate(pair(), apart().positions, 0.1)  # type: ignore[arg-type]


def test_save_times_equal_up_to_rounding_share_an_advance() -> None:
    motion = simulate(pair(), apart(), 0.3 + 1e-16, save_at=[0.0, 0.3, 0.3 + 1e-16], tolerance=1e-9)
    assert len(motion.advances) == 18
    assert motion.flagged == 0
    assert np.array_equal(motion.positions[1], motion.positions[2])


def test_progress_adds_up_to_the_duration() -> None:
    durations: list[float] = []
    motion = simulate(pair(), apart(), 0.5, save_at=[0.1, 0.13], on_progress=durations.append)
    assert len(durations) == len(motion.advances)
    assert sum(durations) == pytest.approx(0.5, rel=1e-12)


class NotFinite(Force):
    """A force that is not a number from a time on."""

    name = "not finite"

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        f += np.nan if t > 0.02 else 0.0

    def energy(self, t: float, x: Array) -> float:
        return 0.0

    def add_stiffness(self, x: Array, blocks: Array) -> None:
        pass


@pytest.mark.parametrize("tolerance", [1e-3, None])
def test_force_without_finite_values_ends_the_motion(tolerance: float | None) -> None:
    with pytest.raises(UnstableError, match="check that all forces are finite"):
        simulate(Model([1.0], [NotFinite()]), State([[0.0, 0.0, 0.0]]), 0.05, tolerance=tolerance)


@pytest.mark.parametrize("step", [1e-3, 9e-4, 1.5e-3])
def test_fixed_step_is_told_although_frames_divide_it(step: float) -> None:
    motion = simulate(pair(), apart(), 0.1, integrator=Leapfrog(step=step))
    assert {(advance.limited_by, "fixed step of" in advance.reason) for advance in motion.advances} == {("step", True)}


def test_fixed_step_is_told_although_pieces_round_their_steps_up() -> None:
    # 344 of these steps cover a frame. Its nine pieces of at most 0.04 s have 39 each, 351 in all.
    values = {"cloth.resolution": [4, 4], "integrator": "extrapolated", "step": 9.7e-4, "rate": 3.0, "tolerance": 0.0}
    done = Simulation(Scene.from_parameters({**values, "contact.self": False})).advance().advance
    assert done is not None
    assert (done.limited_by, "fixed step of" in done.reason) == ("step", True)
