# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames with contact on several threads: equal bits, concurrent runs, prefetched runs that violate the culling."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.contact_scenes import flat_sheet
from support.self_scenes import folded, self_contact

from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau, step_counts
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, JAWS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: A folded sheet, partly on a table. Pads pinch its layers beside the table. Everything has friction.
PINCHED_LAYERS = {
    "cloth.resolution": [9, 9],
    "cloth.size": [0.18, 0.18],
    "cloth.anchors": [""],
    "material.stretch_modulus": 30.0,
    "material.shear_modulus": 3.0,
    "tolerance": 1e-4,
    "contact.self": True,
    "contact.thickness": 4e-3,
    "contact.friction": [0.5, 0.4],
    "obstacles": ["table"],
    "table.shape": "box",
    "table.size": [0.3, 0.1, 0.02],
    "table.position": [0.05, -0.05, -0.013],
    "table.friction": [0.5, 0.4],
    "gripper.mode": "pinch",
    "gripper.pad_size": [0.05, 0.01, 0.06],
    "gripper.opening": 0.032,
    "gripper.speed": 0.5,
    "gripper.force": 2.0,
}
#: The pads close along the vertical.
OPEN: list[Event] = [Target("gripper", (0.01, 0.07, 0.01), (0.7071067811865476, 0.0, 0.0, 0.7071067811865476))]
CLOSE: list[Event] = [Grasp("gripper", True)]

Calls = list[tuple[list[int], int]]


def observe(monkeypatch: pytest.MonkeyPatch, threads: int) -> Calls:
    """Set the available threads; return the step counts and the concurrency of each further call of the engine."""
    monkeypatch.setattr("cloth_sim_ros.physics.plan.plan.available_threads", lambda: threads)
    calls: Calls = []
    execute = Plan.runs

    def seen(self: Plan, t: float, duration: float, start: Any, steps: Any, **options: Any) -> Any:
        calls.append((list(steps), options.get("concurrency", 1)))
        return execute(self, t, duration, start, steps, **options)

    monkeypatch.setattr(Plan, "runs", seen)
    return calls


def pinch_layers() -> tuple[list[str], Simulation]:
    """Fold and pinch the sheet of `PINCHED_LAYERS`; return the digests of its frames and the simulation."""
    _, places, velocities = folded(9, size=0.18, radius=0.01, speed=0.3)
    simulation = Simulation(Scene.from_parameters(PINCHED_LAYERS), State(places, velocities))
    digests = []
    for events in (OPEN, CLOSE, [], []):
        simulation.advance(events)
        digests.append(simulation.state.digest())
    return digests, simulation


@pytest.fixture(scope="module")
def pinched() -> tuple[list[str], Simulation]:
    """Return the result of `pinch_layers` on one thread."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        calls = observe(monkeypatch, 1)
        digests, simulation = pinch_layers()
    assert {concurrency for _, concurrency in calls} == {1}
    contact, memory = simulation.plan.contact, simulation.state.memory
    assert contact is not None
    assert contact.self_gaps(simulation.state.x)[0] > 0
    # Table, both pads, and a face of the layers: anchors of each are in use.
    assert ((memory[ANCHORS_KEY][:4, 3] > 0.0).sum(axis=1) > 0).all()
    assert memory[JAWS_KEY][0, 0] < 5e-3
    return digests, simulation


@pytest.mark.parametrize("threads", [2, 4, 8])
def test_contact_has_the_same_bits_on_any_threads(
    pinched: tuple[list[str], Simulation], threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = observe(monkeypatch, threads)
    assert pinch_layers()[0] == pinched[0]
    assert sum(len(steps) > 1 and concurrency == threads for steps, concurrency in calls) > 20


def test_concurrent_runs_ignore_the_age_of_lists(pinched: tuple[list[str], Simulation]) -> None:
    plan, state = pinched[1].plan, pinched[1].state
    assert plan.contact is not None
    t, counts, ends = pinched[1].time, [600, 750, 900], []
    for concurrency, threads, reuses in (
        (1, 1, True),
        (1, 4, True),
        (2, 1, True),
        (8, 8, True),
        (1, 1, False),
        (2, 1, False),
    ):
        plan.contact.reuse_pairs(reuses)
        runs, _ = plan.runs(
            t, 5e-3, (state.x, state.v), counts, concurrency=concurrency, threads=threads, memory=state.memory
        )
        arrays = [array for run in runs for array in (run.end_state, run.integrals, run.anchors, run.jaw_states)]
        ends.append([array.tobytes() for array in arrays if array is not None])
        assert all(np.isfinite(run.end_state).all() for run in runs)
    plan.contact.reuse_pairs(True)
    assert all(end == ends[0] for end in ends)


def test_runs_after_the_next_are_prefetched_without_contact(
    pinched: tuple[list[str], Simulation], culled: tuple[Plan, State], monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation, (free_plan, free_state) = pinched[1], culled
    monkeypatch.setattr(Plan, "concurrent_runs", lambda *_: 2)
    calls = observe(monkeypatch, 2)
    for plan, state, first in ((simulation.plan, simulation.state, 600), (free_plan, free_state, 20)):
        runs = ExtrapolationTableau(plan, state, simulation.time, 5e-3, step_counts(first))
        runs.combine(1)
        runs.combine(2)
    assert [steps for steps, _ in calls] == [[600], [750], [20], [25, 30]]


def test_separated_sheet_runs_concurrently() -> None:
    frames, n_concurrent, digests = 8, [], []
    for has_contact, threads in ((False, 2), (True, 1), (True, 2)):
        scene = Scene.from_parameters({"contact.self": has_contact, "tolerance": 1e-4})
        places = scene.initial_positions()
        velocities = np.zeros_like(places)
        velocities[:, 1] = places[:, 2].max() - places[:, 2]
        with pytest.MonkeyPatch.context() as monkeypatch:
            calls = observe(monkeypatch, threads)
            simulation = Simulation(scene, State(places, velocities))
            n_concurrent.append(0)
            for _ in range(frames):
                calls.clear()
                if (contact := simulation.plan.contact) is not None:
                    assert contact.is_clear_of_itself(scene.period, simulation.state.x, simulation.state.v)
                simulation.advance([])
                n_concurrent[-1] += any(len(steps) > 1 and concurrency > 1 for steps, concurrency in calls)
            digests.append(simulation.state.digest())
    assert digests[1] == digests[2]
    assert n_concurrent[1] == 0
    assert n_concurrent[0] == n_concurrent[2] >= frames / 2


#: Step counts of runs over `DURATION`: the last is too coarse to be stable and becomes faster than culling assumes.
COUNTS, DURATION = (20, 25, 9), 5.2e-3


@pytest.fixture(params=[False, True], ids=["grid", "listed"])
def culled(request: pytest.FixtureRequest) -> tuple[Plan, State]:
    """Return a sheet that moves away from itself, so that frames cull its contact, and its state."""
    sheet = GridSheet(height=0.3, width=0.3, rows=8, columns=8, layout="alternating")
    model, places = flat_sheet(
        8, 8, self_contact(sheet.triangles(), sheet.positions(), 4e-3), size=0.3, listed=request.param
    )
    return compile(model), State(places, 0.2 * np.random.default_rng(0).normal(size=places.shape))


def test_a_violated_culling_repeats_requested_runs(culled: tuple[Plan, State]) -> None:
    plan, state = culled
    options: dict[str, Any] = {"single_precision": True, "memory": {}}
    start = state.x, state.v
    exact = [plan.runs(0.0, DURATION, start, [count], memory={})[0][0] for count in COUNTS]
    coarse = [plan.runs(0.0, DURATION, start, [count], **options)[0][0] for count in COUNTS]
    assert [run.repeated_without_culling for run in coarse] == [False, False, True]
    # Runs with contact on the surface have double precision.
    assert [np.array_equal(a.x, b.x) for a, b in zip(exact, coarse, strict=True)] == [False, False, True]
    for concurrency in (1, 2):
        runs, _ = plan.runs(0.0, DURATION, start, COUNTS, concurrency=concurrency, **options)
        assert all(run.repeated_without_culling for run in runs)
        assert all(np.array_equal(a.end_state, b.end_state) for a, b in zip(runs, exact, strict=True))
        # The last run is not requested.
        runs, _ = plan.runs(0.0, DURATION, start, COUNTS, concurrency=concurrency, weights=[-1.0, 2.0], **options)
        assert len(runs) == 2
        assert not any(run.repeated_without_culling for run in runs)
        assert all(np.array_equal(a.end_state, b.end_state) for a, b in zip(runs, coarse[:2], strict=True))
        # It is the only one that is requested.
        (run,), _ = plan.runs(0.0, DURATION, start, COUNTS[::-1], concurrency=concurrency, weights=[1.0], **options)
        assert run.repeated_without_culling
        assert np.array_equal(run.end_state, exact[2].end_state)


@pytest.mark.parametrize("requests", [(1, 2, 3), (1, 3), (2, 3), (3,), (1, 2), (2,)])
@pytest.mark.parametrize("expected_runs", [2, 3])
def test_prefetched_runs_change_no_culled_result(
    culled: tuple[Plan, State], requests: tuple[int, ...], expected_runs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, state = culled
    results = []
    for threads in (1, 2):
        monkeypatch.setattr(plan, "concurrent_runs", lambda *_, threads=threads: threads)
        runs = ExtrapolationTableau(
            plan, state, 0.0, DURATION, COUNTS, single_precision=True, expected_runs=expected_runs
        )
        results.append([(*(a.tobytes() for a in runs.combine(k)), runs.summary(k), runs.evaluations) for k in requests])
    assert results[0] == results[1]
