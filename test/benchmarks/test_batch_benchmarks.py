# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of many cloths: a short run, and its report of missed targets."""

import pytest

from benchmarks.__main__ import main
from benchmarks.batch import throughput
from benchmarks.batch import throughput as batch

pytest.importorskip("gymnasium")

SMALL = ["batch", "--envs", "4", "--resolution", "8", "--rollouts", "3", "--rollout-resolution", "6", "--seconds", "0"]


def test_batch_command_prints_each_table(capsys, monkeypatch):
    for name, value in (("MIN_THROUGHPUT", 0.0), ("MIN_THREAD_GAIN", 0.0), ("MAX_MEMORY_RATIO", 1e9)):
        monkeypatch.setattr(batch, name, value)
    monkeypatch.setattr(batch, "MAX_ROLLOUT_TIME", 1e9)
    assert main([*SMALL, "--steps", "400", "--only", *batch.PARTS]) == 0
    printed = capsys.readouterr().out
    for title in ("A vector environment", "on two threads", "Memory", "Rollouts", "Random steps"):
        assert title in printed


def test_batch_command_reports_missed_targets(capsys, monkeypatch):
    monkeypatch.setattr(batch, "MAX_ROLLOUT_TIME", 0.0)
    assert main([*SMALL, "--only", "rollouts"]) == 1
    assert "NOT MET: rollouts took" in capsys.readouterr().out


def test_batch_command_refuses_a_single_cloth(capsys):
    with pytest.raises(SystemExit):
        main([*SMALL, "--envs", "1"])
    assert "--envs: 1; it must be an integer of at least 2" in capsys.readouterr().err


def test_carried_cloths_are_awake_and_grasped():
    with throughput.CarriedCloths(3, 6) as carried:
        for snapshot in carried.cloths.snapshots:
            assert snapshot.state.v.any()
            assert len(snapshot.state.memory["grip.particles"])
        assert len(set(carried.digests())) == 3
        assert carried.evaluations(frames=2) > 0
