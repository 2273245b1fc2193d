# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tolerance governor: `overload` relaxes the tolerance within bounds, by recorded events."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from support.ros_client import Client

from cloth_sim_ros import Frame, Relax, Scene, SetParameters, Simulation
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.ros.node import ClothNode
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.pacer import FrameTick
from cloth_sim_ros.ros.timing.tolerance_governor import MAX_PATIENCE, MIN_FRAMES, MIN_PATIENCE, ToleranceGovernor

#: A power of two, so that windows end where they are expected to.
PERIOD = 1.0 / 64.0


class Machine:
    """A cloth on a machine with given frame times."""

    def __init__(self, **values: Any) -> None:
        self.lines: list[str] = []
        self.simulation = Simulation(
            Scene.from_parameters(
                {"rate": 64.0, "cloth.resolution": (4, 4), "overload": "relax", "tolerance": 1e-4} | values
            )
        )
        self.governor = ToleranceGovernor(self.simulation, ThrottledLog(self, seconds=0.0))

    def warning(self, text: str) -> None:
        self.lines.append(text)

    info = error = warning

    def run(self, load: float, *, windows: int = 1, steps: int = 100, moved: bool = True) -> list[float]:
        """Run windows of frames with a load, and return the factors that came into force."""
        factors = []
        # A window ends after half a second or five frames.
        for _ in range(windows * max(MIN_FRAMES, int(np.ceil(0.5 / (PERIOD * max(load, 1.0)))))):
            events = self.governor.events()
            factors += [event.factor for event in events]
            frame = self.simulation.advance(events)
            advance = Advance(steps=steps, evaluations=steps, step=PERIOD / steps, limit=PERIOD / 9.0)
            self.governor.add(evolve_frame(frame, advance, moved=moved), load * PERIOD)
        return factors

    def in_force(self) -> tuple[str, str, str]:
        entries = self.governor.describe()
        return entries["tolerance_m"], entries["tolerance_effective_m"], entries["tolerance_reason"]


def evolve_frame(frame: Frame, advance: Advance, *, moved: bool) -> Frame:
    import attrs

    return attrs.evolve(frame, advance=advance, moved=moved)


def test_tolerance_is_relaxed_tenfold_at_most_and_logged() -> None:
    machine = Machine()
    assert machine.in_force() == ("0.0001", "0.0001", "as it was set")
    assert machine.run(1.3, windows=8) == [2.0, 4.0, 8.0, 10.0]
    set_to, in_force, why = machine.in_force()
    assert (set_to, in_force) == ("0.0001", "0.001")
    assert why == "frames take 130 % of their period, and the tolerance is at its limit: frames come late"
    assert "the tolerance is 0.001 m instead of 0.0001 m: frames take 130 % of their period" in machine.lines


def test_tolerance_is_not_relaxed_beyond_a_centimetre() -> None:
    machine = Machine(tolerance=4e-3)
    machine.run(1.3, windows=8)
    assert machine.in_force()[1] == "0.01"


def test_tolerance_is_tightened_at_low_load_only() -> None:
    machine = Machine()
    machine.run(1.3, windows=3)
    assert machine.run(0.7, windows=3 * MIN_PATIENCE) == [8.0], "the last of the relaxations"
    assert machine.run(0.3, windows=MIN_PATIENCE) == []
    assert machine.run(0.3, windows=2 * MIN_PATIENCE + 1) == [4.0, 2.0, 1.0]
    assert machine.in_force() == ("0.0001", "0.0001", "as it was set")
    assert machine.lines[-1] == "the tolerance is 0.0001 m again, as it was set: frames take 30 % of their period"


def test_early_tightening_doubles_patience() -> None:
    machine = Machine()
    waits = []
    for _ in range(7):
        machine.run(1.3)
        waits.append(next(count for count in range(2 * MAX_PATIENCE) if 1.0 in machine.run(0.3)))
    assert waits == [MIN_PATIENCE, 8, 16, 32, MAX_PATIENCE, MAX_PATIENCE, MAX_PATIENCE]


def test_stability_limited_steps_keep_the_tolerance() -> None:
    machine = Machine()
    assert machine.run(2.0, windows=3, steps=10) == []
    assert machine.in_force()[2] == (
        "frames take 200 % of their period, but stability limits the step: a larger tolerance would not help, "
        "frames come late"
    )
    assert len(machine.lines) == 1
    machine.run(0.7)
    assert machine.in_force()[2] == "as it was set"


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"overload": "slow"}, ("0.0001", "0.0001", "as it was set")),
        ({"tolerance": 0.0}, ("none", "none", "none is set")),
        ({"step": 1e-4}, ("none", "none", "a fixed step holds none")),
    ],
    ids=["not asked for", "no tolerance", "fixed step"],
)
def test_inactive_governor_changes_nothing(values: dict[str, Any], expected: tuple[str, str, str]) -> None:
    machine = Machine(**values)
    assert machine.run(3.0, windows=3) == []
    assert machine.in_force() == expected
    assert machine.lines == []


def test_single_long_frame_and_pause_are_no_overload() -> None:
    machine = Machine()
    for _ in range(10):
        machine.run(5.0, windows=0)
        machine.governor.add(machine.simulation.advance(), 20.0 * PERIOD)
        for _ in range(31):
            machine.governor.add(machine.simulation.advance(), 0.1 * PERIOD)
    assert machine.run(5.0, windows=3, moved=False) == []


def test_switching_relaxation_off_restores_the_tolerance() -> None:
    machine = Machine()
    machine.run(1.3, windows=4)
    machine.simulation.advance([SetParameters({"overload": "slow"})])
    assert machine.governor.events() == [Relax(1.0)]


def test_clock_driven_node_has_no_overload() -> None:
    machine = Machine()
    machine.governor.live = False
    assert machine.run(3.0, windows=3) == []


def test_a_node_relaxes_and_its_session_runs_again(
    ros_domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.session.reader import SessionReader
    from cloth_sim_ros.verify.run import verify

    watch = SlowWatch()
    monkeypatch.setattr("cloth_sim_ros.ros.timing.frame_timing.WallPacer", HandPacer)
    monkeypatch.setattr("cloth_sim_ros.ros.node.time", watch)
    expected = {
        "overload": "relax",
        "tolerance": 1e-8,
        "cloth.resolution": [8, 8],
        "record.enabled": True,
        "record.folder": str(tmp_path),
    }
    with Client() as client:
        cloth = ClothNode(
            context=client.context,
            parameter_overrides=[Parameter(name, value=value) for name, value in expected.items()],
        )
        cloth.start()
        frames(cloth, 60)
        assert cloth.timing.governor.describe()["tolerance_effective_m"] == "1e-07"
        assert cloth.node.get_parameter("tolerance").value == 1e-8, "what the user set"
        watch.frame = 0.001
        frames(cloth, 150)
        (result,) = cloth.node.set_parameters([Parameter("overload", value="slow")])
        assert result.successful
        frames(cloth, 2)
        assert cloth.timing.governor.describe()["tolerance_effective_m"] == "1e-08"
        assert cloth.close(timeout=30.0)
        cloth.node.destroy_node()
    (path,) = tmp_path.glob("*.mcap")
    with SessionReader(path) as reader:
        records = list(reader.frames())
    factors = [event["factor"] for record in records for event in record.events if event["kind"] == "relax"]
    assert factors == [2.0, 4.0, 8.0, 10.0, 5.0, 1.0]
    assert {1e-8, 1e-7} <= {record.tolerance for record in records}
    verdict = verify([path])
    assert verdict.same, verdict.first_reason
    assert verdict.frames == len(records) == 212


class SlowWatch:
    """A stub of the module time with a given frame time."""

    def __init__(self) -> None:
        self.frame = 0.1
        self._now = 0.0

    def monotonic(self) -> float:
        """Return the time; each frame reads it twice."""
        self._now += self.frame
        return self._now


class HandPacer:
    """A pacer whose ticks the test triggers."""

    period = 16_666_667

    def __init__(self, _node: Any, *, rate: float, on_tick: Any, is_drained: Any, in_timer_thread: bool) -> None:
        self.on_tick = on_tick

    def start(self) -> None:
        """Do nothing: no thread waits."""

    def stop(self) -> None:
        """Do nothing: no frame runs."""


def frames(cloth: ClothNode, count: int) -> None:
    """Run frames that are due now."""
    for _ in range(count):
        stamp = cloth.node.get_clock().now().nanoseconds
        cloth.timing.pacer.on_tick(FrameTick(stamp=stamp, lateness=0, skipped=0, now=stamp))  # type: ignore[union-attr]
