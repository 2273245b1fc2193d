# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""View of a running node: recorded messages in the order in which a node sends them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.rrd import rows
from support.session_maker import cloud_bytes

from cloth_sim_ros.replay import live_main
from cloth_sim_ros.replay.blueprint import make_blueprint
from cloth_sim_ros.replay.live import CHANGED, PARAMETERS, LiveView
from cloth_sim_ros.session.cdr import encode, message_class
from cloth_sim_ros.session.messages import mesh_bytes, point_bytes, pose_bytes, wrench_bytes

pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")

NODE = "/arm/towel"
GRID = np.array([[0.1 * column, 0.0, 0.1 * row] for row in range(3) for column in range(4)])
TRIANGLES = np.array([[0, 1, 4], [1, 5, 4], [6, 7, 11]])
PARAMETERS_OF_NODE = {
    "grippers": ["left"], "obstacles": [""], "cloth.anchors": ["top"], "frame_id": "world", "rate": 60.0,
    "gripper.radius": 0.12,
}  # fmt: skip
STATUS = "diagnostic_msgs/msg/DiagnosticStatus"


def status(name: str, **values: str) -> Any:
    """Return a DiagnosticStatus."""
    entry = message_class("diagnostic_msgs/msg/KeyValue")
    pairs = [entry(key=key, value=value) for key, value in values.items()]
    return message_class(STATUS)(level=0, name=name, message="", hardware_id="none", values=pairs)


class Node:
    """Messages of a node, shown in one recording for each start."""

    def __init__(self, folder: Path) -> None:
        self.files = [folder / "out.rrd", folder / "out_2.rrd"]
        self.sentences: list[str] = []
        self.scans: list[Any] = []
        self.view = LiveView(NODE, self._start, on_message=self.sentences.append)

    def _start(self, scan: Any) -> Any:
        import rerun as rr

        self.scans.append(scan)
        recording = rr.RecordingStream("test")
        recording.save(live_main.numbered_path(self.files[0], len(self.scans)))
        return recording

    def start(self, triangles: np.ndarray = TRIANGLES, vertices: np.ndarray = GRID, **parameters: Any) -> None:
        self.view.add(f"{NODE}/topology", mesh_bytes(triangles, vertices))
        self.view.add(PARAMETERS, json.dumps({**PARAMETERS_OF_NODE, **parameters}).encode())

    def clock(self, seconds: float) -> None:
        whole = int(seconds)
        stamp = message_class("builtin_interfaces/msg/Time")(sec=whole, nanosec=round(1e9 * (seconds - whole)))
        self.view.add(
            f"{NODE}/clock",
            encode(message_class("rosgraph_msgs/msg/Clock")(clock=stamp), "rosgraph_msgs/msg/Clock"),
        )

    def points(self, points: np.ndarray = GRID, *, stamp: int = 5 * 10**9, shape: tuple[int, int] = (3, 4)) -> None:
        self.view.add(f"{NODE}/points", cloud_bytes(points, stamp, shape))

    def send(self, leaf: str, data: bytes) -> None:
        self.view.add(f"{NODE}/{leaf}", data)


def static_rows(path: Path, entity: str, component: str) -> list[Any]:
    """Return the static rows of a component."""
    from rerun.chunk import RrdReader

    chunks = [chunk for chunk in RrdReader(path).stream() if chunk.entity_path == entity and chunk.is_static]
    batches = [chunk.to_record_batch() for chunk in chunks]
    return [row for batch in batches if component in batch.schema.names for row in batch.column(component).to_pylist()]


def test_surface_moves_and_its_triangles_are_sent_once(tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start()
    assert not node.view.is_showing
    for k in range(3):
        node.points(GRID + 0.1 * k, stamp=(5 + k) * 10**9)
        node.clock(2.0 + k)
        assert node.view.is_showing
    node.view.finish()
    times, clouds = rows(node.files[0], "/world/cloth", "Mesh3D:vertex_positions")
    np.testing.assert_allclose(times, [2.0, 3.0, 4.0])
    np.testing.assert_allclose(clouds, [GRID, GRID + 0.1, GRID + 0.2], atol=1e-6)
    assert static_rows(node.files[0], "/world/cloth", "Mesh3D:triangle_indices") == [TRIANGLES.tolist()]
    assert not rows(node.files[0], "/world/cloth", "Mesh3D:triangle_indices")[1]
    _, anchors = rows(node.files[0], "/world/anchors", "Points3D:positions")
    np.testing.assert_allclose(anchors[0], GRID[:4], atol=1e-6)


def test_clock_before_its_cloud_has_the_same_time(tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start()
    for k in range(3):
        node.clock(1.0 + k)
        node.points(GRID + k)
    node.view.finish()
    times, clouds = rows(node.files[0], "/world/cloth", "Mesh3D:vertex_positions")
    np.testing.assert_allclose(times, [1.0, 2.0, 3.0])
    np.testing.assert_allclose([cloud[0][0] for cloud in clouds], [0.0, 1.0, 2.0], atol=1e-6)


def test_bag_without_a_clock_is_shown_by_its_stamps(tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start()
    for k in range(4):
        node.points(GRID + k, stamp=(7 + k) * 10**9)
    node.view.finish()
    times, clouds = rows(node.files[0], "/world/cloth", "Mesh3D:vertex_positions")
    np.testing.assert_allclose(times, [0.0, 1.0, 2.0])
    assert len(clouds) == 3


def test_grasp_shows_gripper_held_particles_and_force(tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start()
    node.points()
    node.clock(1.0)
    node.send("left/target", pose_bytes([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0], frame_id="world", stamp=0))
    node.send("left/point", point_bytes([0.3, 0.0, 0.2], frame_id="", stamp=0))
    node.send("left/state", encode(status("left", closed="true", grasped_count="3"), STATUS))
    node.send("left/wrench", wrench_bytes([3.0, 0.0, 4.0, 0.0, 0.0, 0.0], frame_id="world", stamp=0))
    node.points()
    node.clock(1.0 + 1 / 60)
    node.points()
    node.clock(1.0 + 2 / 60)
    node.view.finish()
    file = node.files[0]
    _, poses = rows(file, "/world/grippers/left", "Transform3D:translation")
    np.testing.assert_allclose(poses[0], [[0.3, 0.0, 0.2]], atol=1e-6)
    _, held = rows(file, "/world/held/left", "Points3D:positions")
    assert len(held[0]) == 0
    np.testing.assert_allclose(sorted(held[-1]), sorted(GRID[[11, 10, 7]].tolist()), atol=1e-6)
    assert rows(file, "/plots/force/left", "Scalars:scalars")[1] == [[5.0]]
    assert rows(file, "/log", "TextLog:text")[1] == [["left closes, holds 3 particles"]]


@pytest.mark.parametrize(
    "data",
    [
        point_bytes([np.nan, 0.0, 0.0], frame_id="world", stamp=0),
        point_bytes([0.0, 0.0, 0.0], frame_id="gripper_link", stamp=0),
        b"\x00\x01\x00\x00rubbish",
        b"",
    ],
    ids=["NaN", "another frame", "rubbish", "empty"],
)
def test_target_that_cannot_be_shown_is_left_out(data: bytes, tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start()
    for k in range(2):
        node.send("left/point", data)
        node.points()
        node.clock(1.0 + k)
    node.view.finish()
    assert not rows(node.files[0], "/world/grippers/left", "Transform3D:translation")[1]
    assert len(rows(node.files[0], "/world/cloth", "Mesh3D:vertex_positions")[1]) == 2
    assert len(node.sentences) <= 1


def test_changed_anchors_are_shown(tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start()
    node.points()
    node.clock(1.0)
    node.view.add(CHANGED, json.dumps({"cloth.anchors": ["bottom_left"]}).encode())
    node.points()
    node.clock(2.0)
    node.view.finish()
    _, anchors = rows(node.files[0], "/world/anchors", "Points3D:positions")
    np.testing.assert_allclose(anchors[1], GRID[[8]], atol=1e-6)


def test_restarted_node_begins_another_recording(tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start()
    node.points()
    node.clock(9.0)
    node.points()
    node.start(np.array([[0, 1, 2]]), GRID[:3], grippers=["right", "third"])
    assert not node.view.is_showing
    # A cloud of the former node, still on its way.
    node.points()
    node.clock(9.1)
    node.points(GRID[:3], shape=(1, 3))
    node.clock(0.1)
    node.view.finish()
    assert [len(scan.opening.positions) for scan in node.scans] == [12, 3]
    times, _ = rows(node.files[0], "/world/cloth", "Mesh3D:vertex_positions")
    np.testing.assert_allclose(times, [9.0])
    times, _ = rows(node.files[1], "/world/cloth", "Mesh3D:vertex_positions")
    np.testing.assert_allclose(times, [0.1])
    assert [start.name for start in node.scans[1].opening.grippers] == ["right", "third"]
    assert node.sentences == ["a cloud is not shown: a cloud has 12 points, the topology 3"]


def test_messages_of_other_nodes_are_left_out(tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start()
    node.points()
    node.clock(1.0)
    stamp = message_class("builtin_interfaces/msg/Time")(sec=1, nanosec=0)
    header = message_class("std_msgs/msg/Header")(stamp=stamp, frame_id="")
    for name, factor in (("arm/towel: cloth", "0.5"), ("motor", "7.0")):
        message = message_class("diagnostic_msgs/msg/DiagnosticArray")(
            header=header, status=[status(name, real_time_factor=factor)]
        )
        node.view.add("/diagnostics", encode(message, "diagnostic_msgs/msg/DiagnosticArray"))
    for name in ("arm.towel", "motor"):
        message = message_class("rcl_interfaces/msg/Log")(
            stamp=stamp, level=30, name=name, msg=f"{name} is late", file="", function="", line=0
        )
        node.view.add("/rosout", encode(message, "rcl_interfaces/msg/Log"))
        node.view.add("/rosout", encode(message, "rcl_interfaces/msg/Log").replace(b"late", b"\xff\xfe\xff\xfe"))
    node.view.finish()
    assert len(node.sentences) == 1, "a text that is not UTF-8"
    assert rows(node.files[0], "/plots/pace/real_time_factor", "Scalars:scalars")[1] == [[0.5]]
    assert rows(node.files[0], "/log", "TextLog:text")[1] == [["arm.towel is late"]]


def test_surface_with_missing_particles_is_not_shown(tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start(np.array([[0, 1, 99]]))
    node.points()
    node.clock(1.0)
    assert not node.view.is_showing
    assert node.sentences == ["a cloud is not shown: a triangle of the topology names particle 99, and there are 12"]


def test_viewer_keeps_the_newest_frame_in_view(tmp_path: Path) -> None:
    node = Node(tmp_path)
    node.start()
    node.points()
    node.clock(1.0)
    panel = make_blueprint(node.scans[0], following=True).time_panel
    # In a loop the viewer would play from the first frame on.
    assert (panel.play_state, panel.loop_mode) == ("following", "off")


def test_missing_rerun_is_named_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(live_main.importlib.util, "find_spec", lambda name: None)
    assert live_main.main(["--node", NODE, "--every", "1", "--strain-limit", "0.05"]) == 1
    assert "pip install 'cloth_sim_ros[replay]'" in capfd.readouterr().err


def test_missing_screen_is_named_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert live_main.main(["--node", NODE, "--every", "1", "--strain-limit", "0.05"]) == 1
    assert "--serve" in capfd.readouterr().err
