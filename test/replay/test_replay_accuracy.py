# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_replay --accuracy`: curves and colours equal the certificate."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from support.rrd import rows
from support.session_maker import SessionMaker, make_grasp
from test_replay_output import SMALL

from cloth_sim_ros.replay import colours
from cloth_sim_ros.replay.accuracy import measure
from cloth_sim_ros.replay.main import main
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.simulation.events import Pause
from cloth_sim_ros.verify.accuracy import certify

pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")


def test_curves_and_colours_are_those_of_the_certificate(tmp_path: Path) -> None:
    session = make_grasp(tmp_path, seconds=0.5, cloth__resolution=[8, 9])
    out = tmp_path / "out.rrd"
    assert main([str(session), "--accuracy", "--save", str(out)]) == 0
    _, certificate = certify([session])
    times, errors = rows(out, "/plots/accuracy/error", "Scalars:scalars")
    assert times == pytest.approx([frame.time for frame in certificate.frames], abs=2e-9)
    assert np.ravel(errors) == pytest.approx([math.log10(frame.error) for frame in certificate.frames])
    _, growth = rows(out, "/plots/growth/growth", "Scalars:scalars")
    assert np.ravel(growth) == pytest.approx([math.log10(frame.amplification) for frame in certificate.frames])
    measured = measure([session], tmp_path, 72)
    _, painted = rows(out, "/world/cloth", "Mesh3D:vertex_colors")
    expected = np.empty(72, np.uint32)
    for frame, row in zip(certificate.frames, painted, strict=True):
        particles = measured.errors(frame.frame)
        assert particles.max() == pytest.approx(frame.error, rel=1e-6)
        colours.strain_colours(particles, measured.limit, expected)
        assert row == expected.tolist()
    # Anchors have no error, up to rounding.
    assert particles[:9].max() < 1e-12
    assert len(set(painted[-1])) > 10


def test_a_paused_cloth_keeps_its_colours(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL))
    for events in ([], [], [Pause(True)], [], [Pause(False)]):
        maker.add(events)
    measured = measure([maker.finish()], tmp_path, 72)
    assert sorted(measured.rows) == [1, 2, 3]
    assert measured.errors(2).any()
    assert not measured.errors(77).any()
    assert list(measured.curves(77)) == []


def test_unmeasurable_session_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = make_grasp(tmp_path, seconds=0.1, cloth__resolution=[8, 9])
    with pytest.raises(SystemExit):
        main([str(session), "--accuracy", "--follow"])
    assert "whole session" in capsys.readouterr().err
    empty = SessionMaker(tmp_path, Scene.from_parameters(SMALL), stem="empty")
    empty.add([Pause(True)])
    with pytest.raises(SessionError, match="no frame in which time passes"):
        measure([empty.finish()], tmp_path, 72)
    with pytest.raises(SessionError, match="cannot be measured"):
        measure([tmp_path / "absent.mcap"], tmp_path, 72)
