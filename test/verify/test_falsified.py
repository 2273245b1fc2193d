# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Falsified sessions with valid indexes and checksums are found or listed."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.falsifier import Falsification, falsifications, falsify
from support.session_maker import make_grasp

from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.verify.main import describe
from cloth_sim_ros.verify.run import verify

WAYS = falsifications("gripper", busy=True)
FRAMES = 24


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    shown = {"points__velocity": True, "tf__publish": True, "cameras": ["wrist"], "wrist__width": 64}
    return make_grasp(tmp_path_factory.mktemp("session"), seconds=FRAMES / 60.0, cloth__resolution=[5, 6], **shown)


def test_unaltered_copy_reruns_equally(session: Path, tmp_path: Path) -> None:
    verdict = verify([falsify(session, tmp_path / "copy.mcap", Falsification())])
    assert verdict.same, verdict.first_reason
    assert (verdict.missing, verdict.absent) == ([], ["/cloth_sim/gripper/state"])
    assert verdict.compared == {
        "cloud": FRAMES,
        "wrench": FRAMES,
        "topology": 1,
        "transform": FRAMES,
        "command": FRAMES + 2,
    }
    assert not verdict.not_compared


@pytest.mark.parametrize("case", WAYS)
def test_falsified_session_is_found_or_listed(session: Path, tmp_path: Path, case: str) -> None:
    falsification = WAYS[case]
    with SessionReader(session) as reader:
        if not any(True for _ in reader.messages([falsification.needs])):
            pytest.skip("a node's sessions alone have such messages")
    verdict = verify([falsify(session, tmp_path / "false.mcap", falsification)])
    assert falsification.is_shown(verdict), describe(verdict)
