# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TF frames: poses in them, and grippers and obstacles that follow them."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.line_log import LineLog

from cloth_sim_ros import Grasp, Scene, Simulation, Target
from cloth_sim_ros.ros.io.tf_frames import FrameError, FrameTransformer, TfFollower
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.simulation.events import Move, Pause, Reset, SetParameters

SECOND = 1_000_000_000
NOW = 1000 * SECOND


def transformer(frame_id: str = "world") -> FrameTransformer:
    return FrameTransformer(SimpleNamespace(), frame_id)  # type: ignore[arg-type]


def test_frames_without_tf2_are_refused_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    frames = transformer()
    assert frames.to_cloth("", (1.0, 2.0, 3.0), None, 0) == ((1.0, 2.0, 3.0), None)
    assert frames.to_cloth("world", (1.0, 2.0, 3.0), None, 0) == ((1.0, 2.0, 3.0), None)
    with pytest.raises(
        FrameError,
        match=r"'base' is not the cloth's frame 'world', and tf2_ros.* sudo apt install ros-jazzy-tf2-ros-py",
    ):
        frames.to_cloth("base", (1.0, 2.0, 3.0), None, 0)


#: Stamp of the newest transform that the stand-in for tf2 knows [ns].
NEWEST = 5 * SECOND + 7


def stub_tf2(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, int]]:
    """A tf2_ros with one transform: base is rotated by 90 degrees about z, at x = 1 m."""
    lookups: list[tuple[str, str, int]] = []

    class TransformException(Exception):
        pass

    class Buffer:
        def lookup_transform(self, target: str, source: str, time: Any) -> Any:
            lookups.append((target, source, time.nanoseconds))
            if source != "base":
                raise TransformException(f"'{source}' does not exist")
            if time.nanoseconds > NEWEST:
                raise TransformException("lookup would require extrapolation into the future")
            half = np.sqrt(0.5)
            return SimpleNamespace(
                header=SimpleNamespace(stamp=SimpleNamespace(sec=5, nanosec=7)),  # NEWEST
                transform=SimpleNamespace(
                    translation=SimpleNamespace(x=1.0, y=0.0, z=0.0),
                    rotation=SimpleNamespace(x=0.0, y=0.0, z=half, w=half),
                ),
            )

    module = ModuleType("tf2_ros")
    module.Buffer = Buffer  # type: ignore[attr-defined]
    module.TransformException = TransformException  # type: ignore[attr-defined]
    module.TransformListener = lambda buffer, node: None  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "tf2_ros", module)
    return lookups


def test_frames_with_tf2_are_transformed(monkeypatch: pytest.MonkeyPatch) -> None:
    lookups = stub_tf2(monkeypatch)
    frames = transformer()
    position, orientation = frames.to_cloth("base", (1.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0), 42)
    assert lookups == [("world", "base", 42)]
    assert position == pytest.approx((1.0, 1.0, 0.5))
    assert orientation == pytest.approx((0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    with pytest.raises(
        FrameError, match="no transform from 'moon' to the cloth's frame 'world': 'moon' does not exist"
    ):
        frames.to_cloth("moon", (1.0, 0.0, 0.5), None, 0)


def test_invalid_transforms_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch)
    frames = transformer()
    frames.newest("base")
    # private: the answer of tf2 is replaced
    lookup, vector = frames._buffer.lookup_transform, SimpleNamespace
    for part, value, words in (
        ("rotation", vector(x=0.0, y=0.0, z=0.0, w=0.0), "is no quaternion"),
        ("rotation", vector(x=float("nan"), y=0.0, z=0.0, w=1.0), "is no quaternion"),
        ("translation", vector(x=float("inf"), y=0.0, z=0.0), "must be finite"),
    ):
        answer = lookup("world", "base", SimpleNamespace(nanoseconds=0))
        setattr(answer.transform, part, value)
        # private: the answer of tf2 is replaced
        monkeypatch.setattr(frames._buffer, "lookup_transform", lambda *_, answer=answer: answer, raising=False)
        with pytest.raises(FrameError, match=f"the transform from 'base' is invalid: .*{words}"):
            frames.newest("base")


def test_command_stamped_now_uses_newest_transform(monkeypatch: pytest.MonkeyPatch) -> None:
    lookups = stub_tf2(monkeypatch)
    frames = transformer()
    position, _ = frames.to_cloth("base", (1.0, 0.0, 0.5), None, NEWEST + SECOND // 10)
    assert position == pytest.approx((1.0, 1.0, 0.5))
    assert lookups[-1] == ("world", "base", 0)
    with pytest.raises(FrameError, match=r"no transform from 'base' .*: lookup would require extrapolation"):
        frames.to_cloth("base", (1.0, 0.0, 0.5), None, NEWEST + SECOND // 10 + 1)
    with pytest.raises(FrameError, match="'moon' does not exist"):
        frames.to_cloth("moon", (1.0, 0.0, 0.5), None, NEWEST + 1)


def test_transforms_are_cleared_when_clock_goes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch)
    frames = transformer()
    frames.clear()
    frames.to_cloth("base", (1.0, 0.0, 0.5), None, 42)
    cleared: list[bool] = []
    # private: counts the calls of tf2
    frames._buffer.clear = lambda: cleared.append(True)
    frames.clear()
    assert cleared == [True]
    for now in (NOW, NOW, NOW + 1, NOW - SECOND, NOW):
        frames.advance_time(now)
    assert cleared == [True, True]


def make_follower(last_target_time: int | None, **values: Any) -> tuple[Simulation, TfFollower, LineLog]:
    simulation = Simulation(
        Scene.from_parameters(
            {"cloth.resolution": (5, 5), **{name.replace("__", "."): v for name, v in values.items()}}
        )
    )
    log = LineLog()
    return simulation, TfFollower(simulation, transformer(), lambda _: last_target_time, ThrottledLog(log)), log


def test_silent_gripper_releases_only_with_timeout_set() -> None:
    simulation, follower, log = make_follower(NOW, gripper__timeout=0.5)
    simulation.advance([Target("gripper", (0.5, 0.0, 0.5)), Grasp("gripper", True)])
    assert follower.events(NOW + SECOND // 2) == []
    assert follower.events(NOW + SECOND) == [Grasp("gripper", False)]
    assert "no target has come for 1.00 s" in log.lines[0]
    simulation.advance([Grasp("gripper", False)])
    assert follower.events(NOW + SECOND) == []
    patient, follower, _ = make_follower(NOW)
    patient.advance([Target("gripper", (0.5, 0.0, 0.5)), Grasp("gripper", True)])
    assert follower.events(NOW + 1000 * SECOND) == []


def test_gripper_timeout_counts_from_the_end_of_a_pause() -> None:
    simulation, follower, _ = make_follower(NOW, gripper__timeout=0.5)
    simulation.advance([Target("gripper", (0.5, 0.0, 0.5)), Grasp("gripper", True), Pause(True)])
    assert follower.events(NOW + 5 * SECOND) == []
    simulation.advance([Pause(False)])
    assert follower.events(NOW + 5 * SECOND + SECOND // 2) == []
    assert follower.events(NOW + 6 * SECOND) == [Grasp("gripper", False)]
    # Wall time is set back.
    assert follower.events(NOW + SECOND) == []
    assert follower.events(NOW + 2 * SECOND) == [Grasp("gripper", False)]


def test_a_gripper_follows_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch)
    _, follower, _ = make_follower(None, gripper__frame="base")
    (target,) = follower.events(NOW)
    assert isinstance(target, Target)
    assert target.position == pytest.approx((1.0, 0.0, 0.0))
    assert follower.events(NOW) == [], "the same transform is no news"
    _, follower, log = make_follower(None, gripper__frame="{gripper}_tool")
    assert follower.events(NOW) == []
    assert "'gripper_tool' does not exist" in log.lines[0]


def test_a_gripper_follows_a_frame_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch)
    two = {"grippers": ["left", "right"]}
    _, grippers, log = make_follower(None, right__frame="base", **two)
    (target,) = grippers.events(NOW)
    assert isinstance(target, Target)
    assert target.gripper == "right"
    assert not log.lines
    # The other gripper follows the frame that is set for all.
    _, grippers, log = make_follower(None, gripper__frame="{gripper}_tool", right__frame="base", **two)
    assert [event.gripper for event in grippers.events(NOW) if isinstance(event, Target)] == ["right"]
    assert len(log.lines) == 1
    assert "'left_tool' does not exist" in log.lines[0]
    # With an empty name it follows none.
    _, grippers, log = make_follower(None, gripper__frame="base", right__frame="", **two)
    assert [event.gripper for event in grippers.events(NOW) if isinstance(event, Target)] == ["left"]


def test_frame_loss_and_recovery_are_logged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stub_tf2(monkeypatch)
    _, follower, log = make_follower(None, gripper__frame="base")
    # private: the lookup is replaced
    newest = follower._frames.newest

    def fail_lookup(frame_id: str) -> Any:
        raise FrameError(f"{frame_id} is gone")

    # private: the lookup is replaced
    monkeypatch.setattr(follower._frames, "newest", fail_lookup)
    monkeypatch.setattr(follower._log, "_seconds", 0.0)  # no throttling of the log
    for second in range(60):
        assert follower.events(NOW + second * SECOND) == []
    assert log.lines == ["'gripper' can't follow frame 'base': base is gone"]
    follower.events(NOW + 60 * SECOND)
    assert len(log.lines) == 2
    # The clock is set back: earlier warnings do not count.
    follower.events(NOW)
    assert len(log.lines) == 3
    # private: the lookup is replaced
    monkeypatch.setattr(follower._frames, "newest", newest)
    assert len(follower.events(NOW + SECOND)) == 1
    assert log.lines[3:] == ["'gripper' follows frame 'base'"]
    follower.events(NOW + 2 * SECOND)
    assert len(log.lines) == 4


def test_an_obstacle_follows_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch)
    ball = {"obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1], "ball.frame": "base"}
    _, follower, _ = make_follower(None, **ball)
    (move,) = follower.events(NOW)
    assert isinstance(move, Move)
    assert move.obstacle == "ball"
    assert move.position == pytest.approx((1.0, 0.0, 0.0))
    assert follower.events(NOW) == [], "the same transform is no news"


def test_static_frames_are_followed_again_after_reset() -> None:
    ball = {"obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1], "ball.position": [0.0, 0.0, -3.0]}
    simulation, follower, _ = make_follower(None, gripper__frame="a", **ball, ball__frame="a")
    # Static transforms, to which tf2 gives the stamp 0.
    x_of = {"a": 1.0, "b": 2.0}
    # private: the lookup is replaced
    follower._frames.newest = (  # type: ignore[method-assign]
        lambda frame: ((x_of[frame], 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0)
    )

    def advance(*events: Any) -> list[str]:
        targets = follower.events(NOW)
        follower.observe(simulation.advance([*events, *targets]))
        return [type(target).__name__ for target in targets]

    assert advance() == ["Move", "Target"]
    assert advance(Reset()) == []
    assert not simulation.grippers.is_placed(0)
    assert advance() == ["Move", "Target"]
    assert simulation.grippers.poses()[0, 0] == 1.0
    advance(SetParameters({"ball.frame": "b"}))
    (move, _) = follower.events(NOW)
    assert isinstance(move, Move)
    assert move.position[0] == 2.0


def test_reset_poses_are_those_of_the_followed_frame() -> None:
    ball = {"obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1], "ball.position": [0.0, 0.0, -3.0]}
    simulation, follower, _ = make_follower(None, **ball, ball__frame="a")
    x_of = {"a": 1.0}

    def newest(frame: str) -> tuple[tuple[float, ...], tuple[float, ...], int]:
        if frame not in x_of:
            raise FrameError(f"no transform from '{frame}'")
        return (x_of[frame], 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0

    # private: the lookup is replaced
    follower._frames.newest = newest  # type: ignore[method-assign]
    at_a = {"ball": (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}
    assert follower.obstacle_poses(simulation.scene) == at_a
    # A change and a reset may share a frame: the reset is of the changed scene.
    changed = simulation.scene.changed({"ball.frame": "b"})
    assert follower.obstacle_poses(changed) == {}
    x_of["b"] = 2.0
    assert follower.obstacle_poses(changed)["ball"][0] == 2.0
    assert follower.obstacle_poses(simulation.scene.changed({"ball.frame": ""})) == {}
    # TF loses a frame whose parents are too old.
    follower.events(NOW)
    del x_of["a"]
    assert follower.obstacle_poses(simulation.scene) == at_a
    follower.restart_time()
    assert follower.obstacle_poses(simulation.scene) == {}


@pytest.mark.parametrize("stamp", [0, 7])
def test_silence_of_a_moving_frame_is_told_once_a_minute(stamp: int) -> None:
    ball = {"obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1], "ball.position": [0.0, 0.0, -3.0]}
    _, follower, log = make_follower(None, **ball, ball__frame="a")
    pose = (0.0, 0.0, -3.0), (0.0, 0.0, 0.0, 1.0)
    # private: the lookup is replaced
    follower._frames.newest = lambda _frame: (*pose, stamp)  # type: ignore[method-assign]
    for seconds in (0, 1, 2, 30, 61):
        follower.events(NOW + seconds * SECOND)
    # A static transform has the stamp 0.
    expected = "no new transform of frame 'a' has come for 1 s: 'ball' stands"
    assert log.lines == ([expected] if stamp else [])


def test_repeated_target_does_not_restart_gripper_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch)
    simulation, follower, _ = make_follower(None, gripper__frame="base", gripper__timeout=0.5)
    simulation.advance(follower.events(NOW))
    follower.observe(simulation.advance([Grasp("gripper", True), SetParameters({"air.drag": 0.5})]))
    (repeated, release) = follower.events(NOW + SECOND)
    assert isinstance(repeated, Target)
    assert release == Grasp("gripper", False)


def test_gripper_with_stale_frame_releases_after_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch)
    simulation, follower, log = make_follower(None, gripper__frame="base", gripper__timeout=0.5)
    simulation.advance(follower.events(NOW))
    simulation.advance([Grasp("gripper", True)])
    assert follower.events(NOW + SECOND // 2) == []
    assert follower.events(NOW + SECOND) == [Grasp("gripper", False)]
    assert "no target has come for 1.00 s" in log.lines[0]


def test_clock_set_back_restarts_gripper_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    stub_tf2(monkeypatch)
    simulation, follower, _ = make_follower(None, gripper__frame="base", gripper__timeout=0.5)
    simulation.advance(follower.events(NOW))
    simulation.advance([Grasp("gripper", True)])
    assert follower.events(NOW - 100 * SECOND) == []
    assert follower.events(NOW - 99 * SECOND) == [Grasp("gripper", False)]
