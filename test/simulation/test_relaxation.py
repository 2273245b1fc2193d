# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Relaxation of the tolerance by events; display parameters leave the motion unchanged."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Pause, Relax, Reset, Scene, SetParameters, Simulation, State
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import from_dict, to_dict


def simulation(**values: Any) -> Simulation:
    parameters = {"cloth.resolution": (8, 8), "cloth.orientation": (0.0, 0.0, 0.0, 1.0), "tolerance": 1e-6}
    return Simulation(Scene.from_parameters(parameters | values))


def test_the_tolerance_in_force_is_a_multiple_of_the_scenes() -> None:
    cloth, unrelaxed = simulation(), simulation()
    evaluations = sum(unrelaxed.advance().advance.evaluations for _ in range(40))
    for _ in range(19):
        cloth.advance()
    frame = cloth.advance([Relax(10.0)])
    assert frame.events == (Relax(10.0),)
    assert frame.tolerance == pytest.approx(1e-5)
    assert cloth.scene.tolerance == 1e-6, "the user's own"
    relaxed = [cloth.advance().advance for _ in range(40)]
    assert sum(advance.evaluations for advance in relaxed) < evaluations
    assert "tolerance 1e-05 m" in relaxed[-1].reason
    assert cloth.advance([Relax(1.0)]).tolerance == 1e-6
    assert "relaxed" not in cloth.state.memory


@pytest.mark.parametrize(
    ("values", "in_force"),
    [
        ({"tolerance": 5e-3}, 1e-2),
        ({"tolerance": 0.1}, 0.1),
        ({"tolerance": 0.0}, None),
        ({"step": 1e-4}, None),
    ],
    ids=["centimetre", "beyond it by itself", "none", "fixed step"],
)
def test_relaxed_tolerance_is_bounded(values: dict[str, Any], in_force: float | None) -> None:
    assert simulation(**values).advance([Relax(10.0)]).tolerance == in_force


def test_relaxation_survives_reset_and_tolerance_change() -> None:
    cloth = simulation()
    cloth.advance([Relax(4.0)])
    assert cloth.advance([Reset()]).tolerance == pytest.approx(4e-6)
    assert cloth.advance([SetParameters({"tolerance": 1e-5})]).tolerance == pytest.approx(4e-5)


def test_a_run_goes_on_from_a_snapshot_bit_for_bit() -> None:
    cloth = simulation()
    for events in ([], [Relax(8.0)], [], []):
        cloth.advance(events)
    twin = Simulation(cloth.scene, State.from_bytes(cloth.state.to_bytes()))
    for events in ([], [Relax(2.0)], [], [Pause(True)], [Relax(1.0)]):
        assert (
            cloth.advance(events).tolerance == twin.advance([from_dict(to_dict(event)) for event in events]).tolerance
        )
        assert cloth.state.digest() == twin.state.digest()


def test_a_saved_state_starts_with_the_scenes_own_tolerance() -> None:
    cloth = simulation()
    cloth.advance([Relax(8.0)])
    values = {**cloth.scene.parameters(), "initial_state": "saved.npz"}
    started = Simulation(Scene.from_parameters(values, files={"saved.npz": cloth.state.to_bytes()}))
    assert started.advance().tolerance == 1e-6


def test_failed_frame_keeps_the_tolerance(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = simulation()

    def fail(*_: Any) -> None:
        raise UnstableError("no")

    with monkeypatch.context() as patch:
        patch.setattr(cloth, "_advance_time", fail)
        with pytest.raises(UnstableError):
            cloth.advance([Relax(5.0)])
    frame = cloth.advance()
    assert frame.tolerance == 1e-6
    assert "1e-06" in frame.advance.reason


@pytest.mark.parametrize("factor", [0.5, 10.1, float("nan"), float("inf"), -1.0])
def test_other_factors_are_refused(factor: float) -> None:
    with pytest.raises(EventError, match=r"relaxed .* times; it must be from 1 to 10"):
        simulation().advance([Relax(factor)])


def test_a_state_file_with_another_factor_is_refused() -> None:
    cloth = simulation()
    cloth.state.memory["relaxed"] = np.array([0.5])
    with pytest.raises(ValueError, match=r"'relaxed' is 0\.5; it must be at least 1"):
        State.from_bytes(cloth.state.to_bytes())


def test_display_parameters_change_no_bit() -> None:
    plain, watched = simulation(), simulation()
    for index in range(6):
        plain.advance()
        watched.advance([SetParameters({"points.velocity": index % 2 == 0, "overload": "relax"})])
        assert plain.state.digest() == watched.state.digest()
    assert watched.scene.overload == "relax"
