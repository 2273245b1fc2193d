# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks speed`: timing, comparison, and report of missed targets."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from support.problems import PERIOD, curtain

from benchmarks import timing as speed_turns
from benchmarks.__main__ import main
from benchmarks.speed import curtain as speed_curtain
from benchmarks.speed import overview as speed
from benchmarks.speed.curtain import CurtainSpeed
from cloth_sim_ros.session.mcap_builder import MAGIC


def test_report_does_not_overwrite_a_session(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    session = tmp_path / "kept.mcap"
    session.write_bytes(MAGIC)
    monkeypatch.setattr(speed, "run", lambda _: pytest.fail("work was done before the refusal"))
    with pytest.raises(SystemExit):
        main(["speed", "--json", str(session)])
    assert "--json" in capsys.readouterr().err
    assert session.read_bytes() == MAGIC


def times_on_fake_clock(wall_times: dict[str, list[float]]) -> speed_turns.InterleavedTimes:
    """Time candidates with the listed durations, one a round, on a fake clock."""
    now = [0.0]
    left = {name: iter(times) for name, times in wall_times.items()}

    def candidate(name: str) -> None:
        now[0] += next(left[name])

    candidates = {name: lambda name=name: candidate(name) for name in wall_times}
    return speed_turns.time_interleaved(candidates, seconds=0.0, clock=lambda: now[0])


def test_interleaved_times_exclude_the_first_round() -> None:
    # The machine is three times slower in two of the five counted rounds, which must not change the ratio.
    turns = times_on_fake_clock({"a": [100.0, 1.0, 3.0, 3.0, 1.0, 1.0], "b": [100.0, 2.0, 6.0, 6.0, 2.0, 2.0]})
    assert turns.seconds["a"] == pytest.approx([1.0, 3.0, 3.0, 1.0, 1.0])
    assert turns.median("b") == pytest.approx(2.0)
    assert turns.ratio("b", "a") == pytest.approx(2.0)


def test_ratio_is_the_median_over_rounds() -> None:
    turns = speed_turns.InterleavedTimes({"a": [1.0, 10.0, 2.0], "b": [1.0, 5.0, 4.0]})
    assert turns.median("a") / turns.median("b") == 0.5
    assert turns.ratio("a", "b") == 1.0


def test_engine_is_timed_without_a_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(speed, "find_compiler", lambda: None)
    file = tmp_path / "speed.json"
    assert main(["speed", "--only", "kernels", "--kernels", "8", "--seconds", "0", "--json", str(file)]) == 0
    written = json.loads(file.read_text())
    assert [row[:3] for row in written["tables"][0]["rows"]] == [[8, "float32", "-"], [8, "float64", "-"]]
    assert all(row[3] > 0.0 and row[4] == "-" for row in written["tables"][0]["rows"])
    assert any("no C compiler" in note for note in written["notes"])


def test_two_threads_give_the_same_bits() -> None:
    row = speed.thread_gain(12, np.float32, seconds=0.0)
    assert row[-1] == "yes"
    assert row[-3] > 0.0
    # The steps of a frame are stable.
    sheet = curtain(16).build()[0]
    limit = speed.leapfrog_limit(*sheet.spectral_bounds(curtain(16).build()[1].x))
    assert PERIOD / speed.thread_gain(16, np.float64, seconds=0.0)[2] < limit


def test_different_bits_and_a_small_gain_fail(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    row = [96, "float64", 10, 1.0, 0.625, 1.6, 1.9, "no"]
    monkeypatch.setattr(speed, "thread_gain", lambda *_, **__: row)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    assert main(["speed", "--only", "threads", "--threads", "96"]) == 1
    printed = capsys.readouterr().out
    assert "NOT MET: two threads at N = 96, float64: other bits than one thread" in printed
    assert "NOT MET: two threads at N = 96, float64: 1.60 times one; target 1.7 (apart 1.90)" in printed


def test_curtain_error_is_against_the_reference() -> None:
    scene = speed_curtain.scored(curtain, 16)
    known = speed_curtain.trusted(scene)
    assert known.error < 1e-10
    fine, coarse = (speed_curtain.run(scene, tolerance=tolerance) for tolerance in (1e-6, 1e-2))
    errors = [known.deviation(scene.frames, run.positions) for run in (fine, coarse)]
    assert errors[0] < 1e-6
    # A looser tolerance gives a larger error against the reference.
    assert 2.0 * errors[0] < errors[1] < 1e-2
    moved = coarse.positions.copy()
    moved[2, 77] += 0.25
    assert known.deviation(scene.frames, moved) == pytest.approx(0.25, rel=1e-3)


def test_curtain_refuses_unscored_resolutions(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        main(["speed", "--only", "curtain", "--curtains", "48"])
    assert "16, 32, 64, 128 particles a side" in capsys.readouterr().err


def curtain_speed(tolerance: float, error: float, factor: float, *, one_core: bool = False) -> CurtainSpeed:
    return CurtainSpeed(
        tolerance=tolerance, one_core=one_core, factors=[factor], evaluations=1.0, error=error, reason="because"
    )


def test_loosest_accurate_tolerance_counts(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    speeds = [
        curtain_speed(1e-3, 2e-3, 30.0),
        curtain_speed(1e-4, 1e-4, 20.0),
        curtain_speed(1e-4, 1e-4, 40.0, one_core=True),
    ]
    best = speed_curtain.loosest_accurate(speeds)
    assert best is not None
    assert best.factor == 20.0
    assert speed_curtain.loosest_accurate(speeds[:1]) is None
    monkeypatch.setattr(speed_curtain, "trusted", lambda _: speed_curtain.Reference(np.ones(1), np.ones(1), 1e-12))
    monkeypatch.setattr(speed_curtain, "curtain_speeds", lambda *_, **__: speeds)
    assert main(["speed", "--only", "curtain", "--curtains", "32"]) == 1
    assert "NOT MET: curtain N = 32: 20 x real time; target 25" in capsys.readouterr().out


def test_cores_restores_the_affinity() -> None:
    before = os.sched_getaffinity(0)
    with speed_curtain.cores(one_core=True):
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before
    with speed_curtain.cores(one_core=False):
        assert os.sched_getaffinity(0) == before
