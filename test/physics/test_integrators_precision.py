# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Single precision: used only if the tolerance allows its rounding."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest
from support import garment
from support.raw_sheet import RawSheet

from cloth_sim_ros import Grasp, Scene, Simulation, Target
from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.integrators.extrapolation_tableau import rounding_amplification
from cloth_sim_ros.physics.plan import thread_limit
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import PrecisionState, RoundingNoiseState, reset_step_control
from cloth_sim_ros.physics.state.state import State

PERIOD = 1 / 60


@pytest.fixture(autouse=True)
def one_run_at_a_time() -> Iterator[None]:
    """Disable prefetching, so that tests observe runs on demand."""
    with thread_limit.single_threaded():
        yield


def build() -> tuple[Plan, State]:
    sheet = RawSheet(resolution=20)
    return sheet.plan(sheet.index[0]), State(sheet.flat(hung=False))


def record_precisions(plan: Plan) -> list[bool]:
    """Return a list that collects the precision of each further run: True for single."""
    precisions_of_runs: list[bool] = []
    run = plan.runs

    def watched(t, duration, start, steps, *, single_precision=False, **others):  # type: ignore[no-untyped-def]
        # Only the first of several runs may use single precision.
        precisions_of_runs.extend([single_precision, *(False for _ in steps[1:])])
        return run(t, duration, start, steps, single_precision=single_precision, **others)

    plan.runs = watched  # type: ignore[method-assign]
    return precisions_of_runs


def frames(tolerance: float, count: int) -> tuple[list[list[bool]], State]:
    """Return the precision of the runs of each frame, and the state at the end."""
    plan, state = build()
    seen, precisions_of_frames = record_precisions(plan), []
    for frame in range(count):
        seen.clear()
        Extrapolated(tolerance=tolerance).advance(plan, state, frame * PERIOD, PERIOD)
        precisions_of_frames.append(list(seen))
    return precisions_of_frames, state


def test_loose_tolerance_uses_single_precision() -> None:
    precisions_of_frames, state = frames(1e-2, 48)
    # The first frame starts at rest, where single precision is not used and nothing is measured.
    assert not any(precisions_of_frames[0])
    # The rounding of velocities is unknown while they grow.
    assert [False] in precisions_of_frames[1:8]
    # Error estimates measure it: before their frames, a few steps run in both precisions.
    assert precisions_of_frames.count([False, True, True, True]) >= 1
    assert precisions_of_frames.count([True]) > 10
    rounding = PrecisionState.load(state).rounding
    assert (
        1e-9 < rounding < CONSTANTS.single_precision_budget_fraction * CONSTANTS.error_budget_fraction * PERIOD * 1e-2
    )


def test_estimate_uses_single_precision_beyond_a_combination() -> None:
    tolerance = 2.4e-4
    budget = CONSTANTS.error_budget_fraction * PERIOD * tolerance
    precisions_of_frames, state = frames(tolerance, 24)
    amplified_rounding = rounding_amplification(2) * PrecisionState.load(state).rounding
    assert CONSTANTS.single_precision_budget_fraction * budget < amplified_rounding < 0.1 * budget
    single = [runs for runs in precisions_of_frames if runs[0]]
    assert [True, True] in single
    assert all(all(runs) for runs in single)


def test_single_precision_estimate_equals_double_estimate() -> None:
    tolerance, count = 2.4e-4, 24
    budget = CONSTANTS.error_budget_fraction * PERIOD * tolerance
    plan, state = build()
    seen, compared = record_precisions(plan), 0
    for frame in range(count):
        start = state.copy()
        seen.clear()
        done = Extrapolated(tolerance=tolerance).advance(plan, state, frame * PERIOD, PERIOD)
        if seen[-2:] != [True, True]:
            continue
        # A recorded rounding error that excludes single precision.
        PrecisionState(rounding=1.0).store(start)
        double = Extrapolated(tolerance=tolerance).advance(plan, start, frame * PERIOD, PERIOD)
        assert abs(done.error - double.error) < 0.1 * budget
        compared += 1
    assert compared >= 2


@pytest.mark.parametrize(("perturbation", "single"), [(0.2, True), (1.5, False)])
def test_faster_motion_than_measured_uses_double_precision(perturbation: float, single: bool) -> None:
    plan, state = build()
    for frame in range(12):
        Extrapolated(tolerance=1e-2).advance(plan, state, frame * PERIOD, PERIOD)
    # A perturbation [m/s] without an event: frames without it had half of the speed.
    state.v = state.v + perturbation * np.random.default_rng(1).uniform(-1.0, 1.0, state.v.shape) * (state.v != 0.0)
    seen = record_precisions(plan)
    Extrapolated(tolerance=1e-2).advance(plan, state, 12 * PERIOD, PERIOD)
    assert (seen[0], any(seen)) == (single, single)


def carried_corner() -> tuple[Scene, Callable[[float], dict[str, Sequence[float]]]]:
    """Return a sheet whose corner a gripper carries on a circle, and the gripper's path."""
    scene = Scene.from_parameters({"cloth.resolution": (30, 30), "tolerance": 1e-4, "grippers": ["gripper"]})
    x, y, z = Simulation(scene).positions[-1].tolist()
    return scene, lambda t: {"gripper": (x + 0.1 * (np.cos(3.0 * t) - 1.0), y - 0.1 * np.sin(3.0 * t), z)}


def swung_garment() -> tuple[Scene, Callable[[float], dict[str, Sequence[float]]]]:
    """Return a T-shirt, whose hinges act every seven steps, and paths of the grippers at its shoulders."""
    values = garment.parameters(bending="altitude", tolerance=1e-3)
    scene = Scene.from_parameters(values, files={"garment.obj": garment.obj_file(400)})
    return scene, lambda t: {name: garment.target(name, t).tolist() for name in garment.SHOULDERS}


@pytest.mark.parametrize(("build_scene", "count"), [(carried_corner, 30), (swung_garment, 200)])
def test_repetition_in_double_precision_takes_longest_steps(build_scene, count: int) -> None:  # type: ignore[no-untyped-def]
    scene, path = build_scene()
    simulation = Simulation(scene)
    plan, run, seen, n_repeated = simulation.plan, simulation.plan.runs, [], 0

    def watched(t, duration, start, steps, *, single_precision=False, multirate=1, **others):  # type: ignore[no-untyped-def]
        seen.append((single_precision, multirate, steps[0]))
        return run(t, duration, start, steps, single_precision=single_precision, multirate=multirate, **others)

    plan.runs = watched  # type: ignore[method-assign]
    for frame in range(count):
        seen.clear()
        events = [Target(name, tuple(at)) for name, at in path(frame * scene.period).items()]
        grasps = [Grasp(name, True) for name in scene.gripper_names if frame == 0]
        advance = simulation.advance([*events, *grasps]).advance
        # A run in single precision and the further one of its estimate miss the budget.
        if [single for single, _, _ in seen[:3]] != [True, True, False]:
            continue
        assert advance is not None
        (_, _, refined_steps), _, (_, ratio, steps) = seen[:3]
        # Their steps are refined. The longest stable ones suffice for a combination, without multirate hinges.
        assert (steps, ratio) == (np.ceil(scene.period / (CONSTANTS.stability_safety * advance.limit)), 1)
        assert refined_steps > steps
        n_repeated += 1
    assert n_repeated > 0


def test_tight_tolerance_uses_double_precision() -> None:
    precisions_of_frames, state = frames(1e-6, 24)
    assert not any(any(runs) for runs in precisions_of_frames)
    assert PrecisionState.load(state).rounding < 0.0


def test_single_precision_error_is_far_below_the_tolerance() -> None:
    _, loose = frames(1e-2, 30)
    _, tight = frames(1e-7, 30)
    assert 0.0 < np.abs(loose.x - tight.x).max() < 1e-3


def swing_sheet(
    stiffness: float, count: int = 20, resolution: int = 16
) -> tuple[float, RoundingNoiseState, list[list[bool]]]:
    """Return residual over turnover of the energy balance of a swinging sheet, its noise state, and precisions."""
    sheet = RawSheet(resolution=resolution, stiffness=stiffness)
    positions = sheet.flat(hung=True)
    velocities = np.zeros_like(positions)
    velocities[:, 1] = -0.5 * positions[:, 2]
    plan, state = sheet.plan(sheet.index[0]), State(positions, velocities)
    balance, residual, precisions_of_frames = EnergyBalance(plan, state), 0.0, []
    seen = record_precisions(plan)
    for frame in range(count):
        seen.clear()
        Extrapolated(tolerance=1e-3).advance(plan, state, frame * PERIOD, PERIOD, balance.accumulator)
        residual = max(residual, abs(balance.add_advance((frame + 1) * PERIOD, state)))
        precisions_of_frames.append(list(seen))
    return residual / balance.energy_turnover, RoundingNoiseState.load(state), precisions_of_frames


def test_stiff_sheet_uses_double_precision_for_its_energy() -> None:
    residual, noise, precisions_of_frames = swing_sheet(100.0)
    # In single precision it is 2e-3 (docs/derivations/single_precision.md).
    assert residual < 1e-3
    assert noise.power > CONSTANTS.max_energy_gain * noise.kinetic_energy > 0.0
    # The measurements alone use single precision.
    assert sum(sum(runs) for runs in precisions_of_frames) == noise.n_samples > 2.0


def test_energy_of_a_falling_sheet_is_kept_at_a_loose_tolerance() -> None:
    sheet = RawSheet(resolution=10, stiffness=1500.0)
    plan, places = sheet.plan([]), sheet.flat(hung=False)
    # Gravity rounds this common velocity with one sign in each step.
    state = State(places, np.tile([0.0, 0.0, -8.2], (len(places), 1)))
    balance = EnergyBalance(plan, state)
    residuals = []
    for frame in range(42):
        Extrapolated(tolerance=0.1).advance(plan, state, frame * PERIOD, PERIOD, balance.accumulator)
        residuals.append(abs(balance.add_advance((frame + 1) * PERIOD, state)))
    assert max(residuals) < 1e-3 * balance.energy_turnover


def test_rounding_of_a_flat_sheet_is_measured_once_it_moves() -> None:
    # Multiples of 1/32 m are exact in single precision: the first measurement finds a hundredth of the noise.
    residual, noise, _ = swing_sheet(1.0, resolution=33)
    _, reference_noise, _ = swing_sheet(1.0, resolution=34)
    assert noise.power > 0.05 * reference_noise.power
    assert residual < 5e-4


def test_soft_sheet_uses_single_precision_and_keeps_its_energy() -> None:
    residual, noise, precisions_of_frames = swing_sheet(0.3)
    assert residual < 1e-3
    assert 0.0 < noise.power < CONSTANTS.max_energy_gain * noise.kinetic_energy
    assert sum(all(runs) for runs in precisions_of_frames) > 10


def test_event_causes_a_new_measurement() -> None:
    plan, state = build()
    for frame in range(12):
        Extrapolated(tolerance=1e-2).advance(plan, state, frame * PERIOD, PERIOD)
    assert PrecisionState.load(state).rounding > 0.0
    reset_step_control(state)
    seen = record_precisions(plan)
    Extrapolated(tolerance=1e-2).advance(plan, state, 12 * PERIOD, PERIOD)
    assert seen[0] is False


@pytest.mark.parametrize("resolution", [20, 34, 64])
def test_single_precision_resolves_sheets_at_rest(resolution: int) -> None:
    sheet = RawSheet(resolution=resolution, gravity=(0.0, 0.0, 0.0))
    plan, turned = sheet.plan([0]), np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    x = np.ascontiguousarray((sheet.flat(hung=True) @ turned + [0.3, 5.1, -2.7]).T)
    step, steps = 1e-4, 20
    (run,), _ = plan.runs(0.0, steps * step, (x, np.zeros_like(x)), [steps], single_precision=True)
    # Springs are rounded relative to their length. Positions alone would be rounded relative to the sheet of 1 m.
    spacing = 2.0**-24 / step
    assert np.abs(run.v).max() < 2.0 * spacing * sheet.spacing
    assert np.abs(run.x - x).max() < 1e-8


def test_single_precision_keeps_the_rest_length() -> None:
    # Single precision rounds k_s / k of this sheet, so that all springs would pull alike at an anchored edge.
    sheet = RawSheet(resolution=64)
    plan, x = sheet.plan(sheet.index[0]), np.ascontiguousarray(sheet.flat(hung=False).T)
    x *= 1.002
    x[2] = 0.2 * np.sin(3.0 * x[0]) * x[1]
    changes = [
        plan.runs(0.0, 2e-3, (x, np.zeros_like(x)), [13], single_precision=single)[0][0].v.mean(axis=1)
        for single in (False, True)
    ]
    assert np.abs(changes[1] - changes[0]).max() < 6e-8
