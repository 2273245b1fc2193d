# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions from before grippers had a speed limit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")
from support.session_maker import SessionMaker

from cloth_sim_ros import Grasp, Scene, Target
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.recorded_scene import LEGACY_VALUES, recorded_values
from cloth_sim_ros.verify.run import verify


def jumping(folder: Path, **values: Any) -> Path:
    """Session of a gripper that holds a corner and jumps by 1 m, and back."""
    scene = Scene.from_parameters({"cloth.resolution": [5, 5], **values})
    maker = SessionMaker(folder, scene)
    x, y, z = scene.initial_positions()[-1].tolist()
    for k in range(12):
        grasps = [Grasp("gripper", True)] if k == 1 else []
        maker.add([Target("gripper", (x, y + (1.0 if k in (4, 5) else 0.0), z), (0.0, 0.0, 0.0, 1.0)), *grasps])
    return maker.finish()


@pytest.fixture
def older(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write sessions without the parameter, like the older version."""
    dump = parameter_file.dump

    def without(values: dict[str, Any], **options: Any) -> str:
        return dump({name: value for name, value in values.items() if name != "gripper.max_speed"}, **options)

    monkeypatch.setattr(parameter_file, "dump", without)


@pytest.mark.usefixtures("older")
def test_older_session_reruns_without_speed_limit(tmp_path: Path) -> None:
    verdict = verify([jumping(tmp_path, **{"gripper.max_speed": 0.0})])
    assert (verdict.first_frame, verdict.frames) == (None, 12)


@pytest.mark.parametrize("speed", [0.0, 3.0, 10.0])
def test_session_reruns_with_its_speed_limit(tmp_path: Path, speed: float) -> None:
    verdict = verify([jumping(tmp_path, **{"gripper.max_speed": speed})])
    assert (verdict.first_frame, verdict.frames) == (None, 12)


def test_only_older_sessions_lack_speed_limit() -> None:
    assert LEGACY_VALUES["gripper.max_speed"] == 0.0
    text = parameter_file.dump({"rate": 60.0})
    assert recorded_values(text, node="/cloth_sim") == {"rate": 60.0, **LEGACY_VALUES}
    assert Scene.from_parameters(parameter_file.parse(text)).gripper.max_speed == 10.0
    assert recorded_values(parameter_file.dump({"gripper.max_speed": 2.0}), node="/a")["gripper.max_speed"] == 2.0
