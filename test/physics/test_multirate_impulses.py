# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Multirate hinge impulses: order, bits, dissipation and scope."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.garment import obj_file, parameters

from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.model.forces.force import Force
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.controller_state import MultirateState
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

_PERIOD = 1.0 / 60.0
_GRID: dict[str, Any] = {
    "cloth.resolution": [14, 15],
    "bending.model": "altitude",
    "material.bending_modulus": 1e-4,
}


#: Hinges with forces and damping comparable to those of springs.
_STIFF = {"material.bending_modulus": 3e-3, "material.damping": 1.0}


def _scene(kind: str, **values: Any) -> Scene:
    if kind == "mesh":
        values_of_mesh = {**parameters(bending="altitude", tolerance=1e-3), "cloth.anchors": ["0", "40"], **values}
        return Scene.from_parameters(values_of_mesh, files={"garment.obj": obj_file(220)})
    return Scene.from_parameters({**_GRID, "bending.model": kind, **values})


def _moving(kind: str, frames: int = 25, **values: Any) -> tuple[Plan, np.ndarray, np.ndarray, float]:
    """Return a plan, and positions, velocities and time of its cloth after some frames, crumpled to load the hinges."""
    simulation = Simulation(_scene(kind, **values))
    for _ in range(frames):
        simulation.advance([])
    state, rng = simulation.state, np.random.default_rng(3)
    x = state.x + 1e-3 * rng.normal(size=state.x.shape)
    v = state.v + 0.1 * rng.normal(size=state.x.shape)
    return simulation.plan, x, v, frames * _PERIOD


def _end(moving: Any, steps: int, ratio: int, **options: Any) -> np.ndarray:
    plan, x, v, t = moving
    (run,), _ = plan.runs(t, _PERIOD, (x, v), [steps], multirate=ratio, **options)
    return run.end_state.copy()


@pytest.mark.parametrize("kind", ["altitude", "crossed", "mesh"])
def test_impulses_have_order_two(kind: str) -> None:
    moving = _moving(kind, **_STIFF)
    steps = 720
    fine = [_end(moving, factor * steps, 1)[0] for factor in (8, 16)]
    exact = (4.0 * fine[1] - fine[0]) / 3.0
    for ratio in (3, 9):
        errors = [np.abs(_end(moving, factor * steps, ratio)[0] - exact).max() for factor in (1, 2)]
        assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize("kind", ["altitude", "mesh"])
@pytest.mark.parametrize("single_precision", [False, True])
def test_impulses_have_equal_bits_for_any_thread_count(kind: str, single_precision: bool) -> None:
    moving = _moving(kind)
    reference = _end(moving, 90, 9, single_precision=single_precision, threads=1)
    for threads in (2, 3, 7):
        assert np.array_equal(_end(moving, 90, 9, single_precision=single_precision, threads=threads), reference)
    # Previous runs have no effect on the result.
    _end(moving, 45, 3, single_precision=single_precision)
    _end(moving, 45, 1, single_precision=single_precision)
    assert np.array_equal(_end(moving, 90, 9, single_precision=single_precision, threads=1), reference)


@pytest.mark.parametrize("kind", ["altitude", "mesh"])
def test_dissipation_includes_all_steps(kind: str) -> None:
    plan, x, v, t = _moving(kind, **_STIFF)
    dissipation = {}
    for ratio in (1, 3, 9):
        (run,), _ = plan.runs(t, _PERIOD, (x, v), [2880], multirate=ratio, record_power=True)
        dissipation[ratio] = run.power_integrals[0]
    # The dissipation of one step per impulse would be too small by three thousandths.
    assert dissipation[3] == pytest.approx(dissipation[1], rel=1e-5)
    assert dissipation[9] == pytest.approx(dissipation[1], rel=1e-4)


@pytest.mark.parametrize(("steps", "ratio"), [(36, 2), (36, 0), (36, -3), (36, 5), (36, 3.0)])
def test_ratios_that_do_not_divide_a_run_are_refused(steps: int, ratio: int) -> None:
    with pytest.raises(ValueError, match=rf"hinges every {ratio} steps of \[{steps}\]"):
        _end(_moving("altitude", 1), steps, ratio)


class _Held(Force):
    """Undamped springs in numpy that hold every particle at its initial position."""

    name = "held"

    def __init__(self, stiffness: float, at: np.ndarray) -> None:
        self.stiffness, self.at = stiffness, at

    def add_force(self, t: float, x: np.ndarray, v: np.ndarray, f: np.ndarray) -> None:
        f -= self.stiffness * (x - self.at)

    def energy(self, t: float, x: np.ndarray) -> float:
        return 0.5 * self.stiffness * float(((x - self.at) ** 2).sum())

    def add_stiffness(self, x: np.ndarray, blocks: np.ndarray) -> None:
        blocks[:3] += self.stiffness


@pytest.mark.parametrize(("stiffness", "uses_multirate"), [(1e-3, True), (3000.0, False)])
def test_numpy_force_counts_as_undamped_transverse_wave(stiffness: float, uses_multirate: bool) -> None:
    model = _scene("altitude", **{"material.bending_modulus": 1e-5}).model()
    at = Simulation(_scene("altitude")).state.x.copy()
    plan = compile(Model(model.masses, [*model.forces, _Held(stiffness, at)], anchors=model.anchors))
    state, ratios = State(at.T), set()
    for frame in range(8):
        make_integrator("auto", tolerance=1e-3).advance(plan, state, frame * _PERIOD, _PERIOD)
        ratios.add(int(MultirateState.load(state).ratio))
    assert (max(ratios) > 1) == uses_multirate


def _reasons(**values: Any) -> list[str]:
    simulation = Simulation(_scene("altitude", **{"material.bending_modulus": 1e-5, **values}))
    reasons = []
    for _ in range(12):
        frame = simulation.advance([])
        assert frame.advance is not None
        reasons.append(frame.advance.reason)
    return reasons


def test_frames_use_and_report_multirate_steps() -> None:
    reasons = _reasons()
    assert all("; bending every " in reason for reason in reasons[4:])


@pytest.mark.parametrize(
    "values",
    [
        {"material.damping": 0.0},
        {"tolerance": 0.0},
        {"tolerance": 0.0, "step": 1e-4, "integrator": "leapfrog"},
        {
            "obstacles": ["it"],
            "it.shape": "plane",
            "cloth.size": [0.3, 0.3],
            "cloth.position": [0.0, 0.0, 0.003],
            "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
            "contact.thickness": 0.003,
        },
        {"integrator": "implicit"},
    ],
    ids=["undamped", "no tolerance", "fixed step", "contact", "implicit"],
)
def test_excluded_scenes_use_no_multirate_steps(values: dict[str, Any]) -> None:
    assert not any("bending every" in reason for reason in _reasons(**values))


def test_hanging_sheet_matches_single_rate_within_tolerance() -> None:
    """The comparison covers two seconds."""
    ends = []
    for tolerance in (1e-3, 1e-6):
        simulation = Simulation(_scene("crossed", **{"material.bending_modulus": 1e-5, "tolerance": tolerance}))
        for _ in range(120):
            simulation.advance([])
        ends.append(simulation.positions.copy())
    assert np.abs(ends[0] - ends[1]).max() < 1e-3
