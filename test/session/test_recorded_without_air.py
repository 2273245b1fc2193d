# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions from before wind.normal_drag had a default."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")
from support.session_maker import SessionMaker

from cloth_sim_ros import Scene
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.recorded_scene import recorded_values
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.verify.run import verify

OLD = Path(__file__).resolve().parents[1] / "data" / "session_0.1.0.mcap"


def falling(folder: Path, normal_drag: float) -> Path:
    scene = Scene.from_parameters(
        {"cloth.resolution": [5, 5], "cloth.orientation": [0.0, 0.0, 0.0, 1.0], "wind.normal_drag": normal_drag}
    )
    maker = SessionMaker(folder, scene)
    for _ in range(12):
        maker.add([])
    return maker.finish()


def test_session_without_air_parameter_runs_without_air(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dump = parameter_file.dump

    def without(values: dict[str, Any], **options: Any) -> str:
        return dump({name: value for name, value in values.items() if name != "wind.normal_drag"}, **options)

    monkeypatch.setattr(parameter_file, "dump", without)
    verdict = verify([falling(tmp_path, 0.0)])
    assert (verdict.first_frame, verdict.frames) == (None, 12)


@pytest.mark.parametrize("normal_drag", [0.0, 0.45])
def test_session_reruns_with_its_recorded_air(tmp_path: Path, normal_drag: float) -> None:
    verdict = verify([falling(tmp_path, normal_drag)])
    assert (verdict.first_frame, verdict.frames) == (None, 12)


def test_session_of_the_first_version_has_no_air() -> None:
    reader = SessionReader(OLD)
    scene = Scene.from_parameters(recorded_values(reader.scene_yaml, node=reader.node), files=reader.files)
    assert scene.wind.normal_drag == 0.0
    assert "air" not in {force.name for force in scene.model().forces}
