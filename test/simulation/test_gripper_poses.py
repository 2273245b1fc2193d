# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded poses of grippers: `Simulation.play`, and tables (CSV)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Grasp, Pause, Scene, Simulation, Target
from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError

TIMES = [5.0, 5.1, 5.4]
POSES = [[0.5, 0.0, 1.5], [0.5, 0.1, 1.5], [0.5, 0.1, 1.8]]


def simulation(**values: Any) -> Simulation:
    return Simulation(Scene.from_parameters({"cloth.resolution": [4, 4], "cloth.anchors": [""], **values}))


def test_frames_end_at_poses_of_their_times() -> None:
    cloth = simulation(rate=20.0)
    frames = list(cloth.play(TIMES, POSES))
    assert len(frames) == 9
    assert cloth.time == pytest.approx(0.45)
    targets = [event.position for frame in frames for event in frame.events if isinstance(event, Target)]
    expected = [[0.5, 0.0, 1.5], [0.5, 0.05, 1.5], [0.5, 0.1, 1.5], *([0.5, 0.1, 1.5 + 0.05 * k] for k in range(1, 7))]
    np.testing.assert_allclose(targets, expected, atol=1e-12)


def test_gripper_closes_at_its_first_pose_and_carries() -> None:
    # The corner of the cloth is at the first pose; a moment later the gripper is out of reach.
    poses = [[0.5, 0.0, 1.5], [0.5, 0.4, 1.9]]
    cloth = simulation(**{"gripper.radius": 0.02})
    frames = list(cloth.play([0.0, 0.5], poses, closed=True))
    assert cloth.grasped_count(0) == 1
    assert [event.closed for frame in frames for event in frame.events if isinstance(event, Grasp)] == [True]
    assert math.dist(cloth.positions[3], poses[1]) < 0.02


def test_closed_by_time_opens_again() -> None:
    cloth = simulation()
    counts, grasps = [], []
    for k, frame in enumerate(cloth.play([0.0, 0.1, 0.2, 0.3], [POSES[0]] * 4, closed=[True, False, True, False])):
        counts.append(cloth.grasped_count(0))
        grasps += [(k, event.closed) for event in frame.events if isinstance(event, Grasp)]
    assert grasps == [(1, True), (7, False), (13, True), (19, False)]
    assert counts[:7] == [0, *[1] * 6]
    # The cloth has fallen out of reach.
    assert counts[7:] == [0] * 13


def test_orientation_turns_by_the_shortest_way() -> None:
    half = [0.0, 0.0, math.sin(0.5), math.cos(0.5)]
    script = GripperScript.from_poses([0.0, 1.0], [[0.0] * 6 + [2.0], [0.0] * 3 + [-entry for entry in half]])
    np.testing.assert_allclose(script.pose(0.5)[1], [0.0, 0.0, math.sin(0.25), math.cos(0.25)], atol=1e-15)


def test_several_grippers_play_by_name() -> None:
    cloth = simulation(grippers=["left", "right"])
    list(cloth.play([0.0, 0.1], {"left": [[-0.5, 0.0, 1.5]] * 2, "right": POSES[:2]}, closed={"right": True}))
    assert [cloth.grasped_count(k) for k in range(2)] == [0, 1]
    with pytest.raises(ValueError, match="has 2 grippers; give poses by name"):
        cloth.play(TIMES, POSES)


@pytest.mark.parametrize(
    ("times", "poses", "closed", "reason"),
    [
        (TIMES, POSES[:2], None, r"poses have the shape \(2, 3\); it must be \(3, 3\) or \(3, 7\)"),
        ([0.0, 0.0], POSES[:2], None, "time 1 is 0.0 s, after 0.0 s; times must increase"),
        ([0.0, math.inf], POSES[:2], None, r"times hold inf at \[1\]; all must be finite"),
        (TIMES, [[0.0, math.nan, 0.0]] * 3, None, r"poses hold nan at \[0, 1\]"),
        ([], [], None, "at least one time"),
        ("soon", POSES, None, "times are no array of numbers"),
        ([0.0], [[0.0] * 7], None, r"the pose at 0 s: orientation \[0.0, 0.0, 0.0, 0.0\] is no quaternion"),
        (TIMES, POSES, [True, False], r"closed has the shape \(2,\); it must be \(\) or \(3,\)"),
        (TIMES, {"hand": POSES}, None, "no gripper 'hand'; it has gripper"),
        (TIMES, POSES, {"hand": True}, "no gripper 'hand'; it has gripper"),
    ],
)
def test_poses_that_cannot_be_played_are_refused(times: Any, poses: Any, closed: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        simulation().play(times, poses, closed=closed)


def test_paused_simulation_does_not_play() -> None:
    cloth = simulation()
    cloth.advance([Pause(True)])
    with pytest.raises(ValueError, match="paused; resume it"):
        cloth.play(TIMES, POSES)


def table(folder: Path, text: str) -> GripperScript:
    (folder / "poses.csv").write_text(text)
    return GripperScript.from_file(folder / "poses.csv")


def test_table_of_poses_has_named_columns(tmp_path: Path) -> None:
    script = table(tmp_path, "time, x, y, z, closed, frame_id\n7.5,1,2,3,0,arm\n8.0,2,2,3,1,arm\n")
    assert script.pose(0.25) == ((1.5, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    assert [(grasp.time, grasp.closed) for grasp in script.grasps] == [(0.0, False), (0.5, True)]
    assert script.frame_id == "arm"


def test_table_of_topic_echo_has_no_header(tmp_path: Path) -> None:
    script = table(tmp_path, "1790000000,999999999,map,1,2,3,0,0,0,1\n1790000001,100000000,map,2,2,3,0,0,0,1\n")
    assert script.duration == pytest.approx(0.100000001, abs=1e-12)
    assert script.frame_id == "map"
    assert [(grasp.time, grasp.closed) for grasp in script.grasps] == [(0.0, True)]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "the table is empty"),
        ("time,x,y,z\n", "the table has no pose"),
        ("time,x,y\n0,1,2\n", "no column 'z'; it needs time, x, y, z"),
        ("x,y,z\n0,1,2\n", "no column 'time'"),
        ("time,x,y,z,qw\n0,1,2,3,1\n", "no column 'qx'"),
        ("time,x,y,z,speed\n0,1,2,3,1\n", "unknown column 'speed'; known are time, sec"),
        ("time,x,y,z,x\n0,1,2,3,1\n", "the column 'x' stands twice"),
        ("time,x,y,z\n0,1,2\n", "line 2 has 3 entries; the table has 4 columns"),
        ("time,x,y,z\n0,1,2,far\n", "line 2: z is 'far'; it must be a number"),
        ("time,x,y,z\n0,1,2,nan\n", r"poses hold nan at \[0, 2\]"),
        ("time,x,y,z\n1,1,2,3\n0,1,2,3\n", "line 3 is not later than the line before"),
        ("time,x,y,z,closed\n0,1,2,3,maybe\n", "line 2: closed is 'maybe'; it must be 0 or 1"),
        ("time,x,y,z,frame_id\n0,1,2,3,a\n1,1,2,3,b\n", "several frames: a, b; transform them"),
    ],
)
def test_faulty_table_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(ScriptError, match=f"poses.csv: .*{reason}"):
        table(tmp_path, text)


def test_table_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScriptError, match=r"cannot read the poses .*No such file"):
        GripperScript.from_file(tmp_path / "poses.csv")
    (tmp_path / "poses.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(ScriptError, match="no text in UTF-8"):
        GripperScript.from_file(tmp_path / "poses.csv")


def test_closed_gripper_without_poses_is_refused() -> None:
    cloth = simulation(grippers=["left", "right"])
    with pytest.raises(ScriptError, match="closed names the gripper 'right', which has no poses"):
        cloth.play(TIMES, {"left": POSES}, closed={"right": True})
    with pytest.raises(ScriptError, match="poses name no gripper"):
        cloth.play(TIMES, {})


@pytest.mark.parametrize("closed", ["no", math.nan, [0.0, 0.4, 1.0], [None, True, False], ["true"] * 3])
def test_closed_that_is_no_truth_value_is_refused(closed: Any) -> None:
    with pytest.raises(ScriptError, match="it must be true or false, or 1 or 0"):
        simulation().play(TIMES, POSES, closed=closed)
