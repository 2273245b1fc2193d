# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth cameras in the graph: images, camera info, labels, points, their process, sessions."""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import String
from support.clocked_cloth import SECOND, ClockedCloth
from support.ros_client import Client

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.ros.camera.camera_jobs import CameraFrame, CameraSetup, CameraTopics
from cloth_sim_ros.ros.camera.camera_worker import CameraOutput
from cloth_sim_ros.ros.io.tf_frames import MAX_TRANSFORM_AGE, FrameError
from cloth_sim_ros.ros.process.worker_process import WorkerProcess
from cloth_sim_ros.scene.camera_section import CameraParameters
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.session.child_process import child_environment
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.verify.run import verify

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
#: A hanging cloth at y = 0 with a ball before it and a wall behind, seen along y from 2 m.
SCENE: dict[str, Any] = {
    "obstacles": ["ball", "wall"],
    "ball.shape": "sphere",
    "ball.size": [0.1],
    "ball.position": [0.0, -0.5, 1.0],
    "wall.shape": "box",
    "wall.size": [6.0, 0.1, 6.0],
    "wall.position": [0.0, 1.05, 1.0],
    "cameras": ["wrist"],
    "wrist.width": 80,
    "wrist.height": 60,
    "wrist.rate": 60.0,
}
TYPES = {
    "depth/image_rect_raw": Image,
    "depth/camera_info": CameraInfo,
    "labels": Image,
    "points": PointCloud2,
}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


class Watcher:
    """Subscriptions of one camera."""

    def __init__(self, client: Client, *leaves: str, camera: str = "/cloth_sim/wrist") -> None:
        self._client, self.received = client, {leaf: [] for leaf in leaves or TYPES}
        self.subscriptions = [
            client.node.create_subscription(TYPES[leaf], f"{camera}/{leaf}", messages.append, qos_profile_sensor_data)
            for leaf, messages in self.received.items()
        ]

    def close(self) -> None:
        """Unsubscribe."""
        for subscription in self.subscriptions:
            self._client.node.destroy_subscription(subscription)

    def of_one_stamp(self, cloth: ClockedCloth) -> dict[str, Any]:
        """Tick until a message of each topic with one stamp has come; return these."""
        images: dict[str, Any] = {}

        def is_complete() -> bool:
            cloth.tick()
            by_topic = [
                {(message.header.stamp.sec, message.header.stamp.nanosec): message for message in messages}
                for messages in self.received.values()
            ]
            for stamp in set.intersection(*map(set, by_topic)):
                images.update(zip(self.received, (messages[stamp] for messages in by_topic), strict=True))
            return bool(images)

        self._client.spin_until(is_complete, description="a message of each topic of the camera")
        return images


def pixels(image: Image) -> np.ndarray:
    """The pixels of an image."""
    kind = {"32FC1": np.float32, "16UC1": np.uint16}[image.encoding]
    assert image.step == image.width * np.dtype(kind).itemsize
    return np.frombuffer(bytes(image.data), kind).reshape(image.height, image.width)


def test_camera_shows_cloth_and_obstacles_with_one_stamp(client: Client) -> None:
    names: list[String] = []
    client.node.create_subscription(String, "/cloth_sim/wrist/label_names", names.append, LATCHED)
    with ClockedCloth(client, SCENE) as cloth:
        images = Watcher(client).of_one_stamp(cloth)
        depth, info, labels, cloud = (images[leaf] for leaf in TYPES)
        client.spin_until(lambda: names, description="the names of labels")
    assert {message.header.frame_id for message in images.values()} == {"cloth_sim/wrist_optical_frame"}
    numbers = {name: int(label) for label, name in json.loads(names[-1].data).items()}
    assert numbers == {"cloth": 1, "ball": 2, "wall": 3}
    depths, seen = pixels(depth), pixels(labels)
    assert (depth.encoding, labels.encoding) == ("32FC1", "16UC1")
    centre = 30, 40
    assert seen[centre] == numbers["ball"] and depths[centre] == pytest.approx(1.4, abs=2e-3)
    assert np.abs(depths[seen == numbers["cloth"]] - 2.0).max() < 0.1
    assert np.abs(depths[seen == numbers["wall"]] - 3.0).max() < 5e-4
    assert seen[0, 0] == numbers["wall"]
    fx, fy, cx, cy = info.k[0], info.k[4], info.k[2], info.k[5]
    assert (info.width, info.height, info.distortion_model, list(info.d)) == (80, 60, "plumb_bob", [0.0] * 5)
    assert list(info.p) == [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    assert list(info.r) == np.eye(3).ravel().tolist() and (cx, cy) == (39.5, 29.5)
    # As depth_image_proc makes points of depths.
    v, u = np.mgrid[:60, :80]
    expected = np.stack([(u - cx) / fx * depths, (v - cy) / fy * depths, depths], axis=-1)
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (60, 80, 12, 960)
    assert [(field.name, field.offset) for field in cloud.fields] == [("x", 0), ("y", 4), ("z", 8)]
    points = np.frombuffer(bytes(cloud.data), np.float32).reshape(60, 80, 3)
    assert np.abs(points - expected).max() < 1e-5 and not cloud.is_dense


def test_millimetres_and_no_depth_are_encoded_by_rep_118(client: Client) -> None:
    with ClockedCloth(client, {**SCENE, "wrist.encoding": "16UC1", "wrist.max_depth": 2.5, "wrist.width": 81}) as cloth:
        images = Watcher(client, "depth/image_rect_raw", "labels").of_one_stamp(cloth)
    depths, labels = pixels(images["depth/image_rect_raw"]), pixels(images["labels"])
    assert int(depths[30, 40]) == pytest.approx(1400, abs=2)
    assert np.array_equal(depths == 0, labels == 0) and (depths == 0).any()


def test_names_of_labels_need_no_subscriber_of_images(client: Client) -> None:
    names: list[String] = []
    client.node.create_subscription(String, "/cloth_sim/wrist/label_names", names.append, LATCHED)
    with ClockedCloth(client, SCENE) as cloth:

        def is_named() -> bool:
            cloth.tick()
            return bool(names)

        client.spin_until(is_named, description="the names of labels")


def test_nothing_is_rendered_without_subscribers(client: Client) -> None:
    with ClockedCloth(client, SCENE) as cloth:
        cameras = cloth.node.outputs.cameras
        assert cameras is not None
        cloth.tick(5)
        client.spin_until(lambda: cameras.describe()["cameras"] == "running", description="the process")
        cloth.tick(5)
        assert cameras.describe()["camera_images"] == "0"
        watcher = Watcher(client, "depth/camera_info")
        watcher.of_one_stamp(cloth)
        watcher.close()
        client.spin_until(lambda: not subscribed(cameras), description="no subscriber")
        cloth.tick()
        count = cameras.describe()["camera_images"]
        cloth.tick(5)
        assert int(cameras.describe()["camera_images"]) <= int(count) + 1


def subscribed(cameras: Any) -> frozenset[str]:
    """The cameras with subscribers."""
    # private: the condition under test
    images: frozenset[str] = cameras._subscribed  # private, likewise
    return images


def test_rate_is_counted_in_frames(client: Client) -> None:
    with ClockedCloth(client, {**SCENE, "wrist.rate": 20.0}) as cloth:
        watcher = Watcher(client, "depth/camera_info")
        watcher.of_one_stamp(cloth)
        (messages,) = watcher.received.values()
        for _ in range(12):
            count = len(messages)
            cloth.tick(3)
            client.spin_until(lambda count=count: len(messages) > count, description="an image in three frames")
        stamps = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in messages]
    # A busy machine skips images.
    images = np.diff(stamps) * 20e-9
    assert np.all(np.abs(images - np.rint(images)) < 1e-3) and images.min() > 0.5, images


class BusyProcess:
    """Keeps the newest job, as a process that is not done."""

    def __init__(self) -> None:
        self.job: CameraFrame | None = None

    @property
    def has_waiting_job(self) -> bool:
        """True if there is a job."""
        return self.job is not None

    def put(self, job: CameraFrame) -> CameraFrame | None:
        """Replace the job."""
        replaced, self.job = self.job, job
        return replaced

    def close(self) -> None:
        """Do nothing."""


def test_slow_camera_gets_an_image_beside_a_fast_one(client: Client) -> None:
    with ClockedCloth(client, {**SCENE, "cameras": ["wrist", "top"], "top.rate": 6.0}) as cloth:
        cameras = cloth.node.outputs.cameras
        assert cameras is not None
        cameras.close()
        process = BusyProcess()
        cameras._process = process  # type: ignore[assignment]  # private: a process that tests can hold up
        cameras._subscribed = frozenset({"wrist", "top"})  # private: as if it answered so
        cloth.tick(25)
        assert process.job is not None and process.job.cameras == {"wrist", "top"}
        cloth.tick()
        assert process.job.cameras == {"wrist", "top"}, "an image that was skipped is rendered later"
        process.job = None
        cloth.tick()
        assert process.job.cameras == {"wrist"}
        assert int(cameras.describe()["camera_images_skipped"]) > 25


def test_camera_moves_by_its_parameters(client: Client) -> None:
    with ClockedCloth(client, SCENE) as cloth:
        watcher = Watcher(client, "depth/image_rect_raw")
        watcher.of_one_stamp(cloth)
        (messages,) = watcher.received.values()
        cloth.node.node.set_parameters([Parameter("wrist.position", value=[0.0, -1.5, 1.0])])

        def has_moved() -> bool:
            cloth.tick()
            return abs(float(pixels(messages[-1])[30, 40]) - 0.9) < 2e-3

        client.spin_until(has_moved, description="the depth at the new position")


def test_process_that_ends_leaves_the_node_running(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client, SCENE) as cloth:
        cameras = cloth.node.outputs.cameras
        assert cameras is not None
        Watcher(client, "depth/image_rect_raw").of_one_stamp(cloth)
        # private: there is no other way to its process
        process = cameras._process._process  # type: ignore[union-attr]  # private, likewise
        assert process is not None
        # SIGKILL while it sends may crash Fast DDS in this process.
        os.kill(process.pid, signal.SIGTERM)
        client.spin_until(lambda: cameras.describe()["cameras"] == "ended by itself (status 0)", description="the end")
        cloth.tick(5)
        cameras.report()
    assert (
        "cameras send no images: their process ended by itself (status 0); restart the node" in capfd.readouterr().err
    )


def test_process_leaves_the_graph_with_the_node(client: Client) -> None:
    with ClockedCloth(client, SCENE) as cloth:
        cameras = cloth.node.outputs.cameras
        assert cameras is not None
        Watcher(client, "depth/image_rect_raw").of_one_stamp(cloth)
        # private: there is no other way to its process
        process = cameras._process._process  # type: ignore[union-attr]  # private, likewise
        assert process is not None and process.poll() is None
    assert process.returncode == 0, "it was not killed"


def test_missing_transform_is_reported_once(client: Client, capfd: pytest.CaptureFixture[str]) -> None:
    with ClockedCloth(client, {**SCENE, "wrist.frame": "hand_optical"}) as cloth:
        cameras = cloth.node.outputs.cameras
        assert cameras is not None
        watcher = Watcher(client, "depth/image_rect_raw")
        said: list[str] = []

        def is_reported() -> bool:
            cloth.tick()
            cameras.report()
            said.append(capfd.readouterr().err)
            return "camera 'wrist' sends no images" in "".join(said)

        client.spin_until(is_reported, description="the report")
        cloth.tick(10)
        cameras.report()
    text = "".join([*said, capfd.readouterr().err])
    assert text.count("camera 'wrist' sends no images") == 1
    is_installed = importlib.util.find_spec("tf2_ros")
    assert ("no transform" if is_installed else "tf2_ros, which would transform it, is not installed") in text
    assert not watcher.received["depth/image_rect_raw"]


class StubTransformer:
    """TF with at most one frame, at a pose."""

    def __init__(self) -> None:
        self.pose: tuple[tuple[float, ...], tuple[float, ...]] | None = None
        #: Number of calls before the transform comes, and of calls for which an older one was enough.
        self.n_missing = self.n_older = 0
        #: Times of the frames [ns].
        self.times: list[int] = []

    def advance_time(self, now: int) -> None:
        """Store a time."""
        self.times.append(now)

    def to_cloth(
        self, frame: str, *_: Any, max_age: int = MAX_TRANSFORM_AGE
    ) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the pose, or refuse."""
        self.n_missing -= 1
        self.n_older += max_age > 0
        if self.pose is None or (self.n_missing >= 0 and not max_age):
            raise FrameError(f"no transform from '{frame}'")
        return self.pose


def test_camera_follows_its_frame_when_it_is_known(client: Client) -> None:
    leaves = ("depth/image_rect_raw", "depth/camera_info", "labels", "label_names", "points")
    profile = {"reliability": 2, "history": 1, "durability": 2, "depth": 5}
    topics = CameraTopics(
        frame_id="hand", names={leaf: f"/arm/{leaf}" for leaf in leaves}, profiles=dict.fromkeys(leaves, profile)
    )
    setup = CameraSetup(
        node="cloth_sim",
        namespace="/",
        frame_id="world",
        cameras={"arm": CameraParameters(width=8, height=6, frame="hand")},
        topics={"arm": topics},
        triangles=np.zeros((0, 3), np.int64),
    )
    frame = CameraFrame(
        index=1,
        stamp=SECOND,
        cameras=frozenset({"arm"}),
        poses={},
        x=np.zeros((3, 0)),
        bodies=None,
        body_poses=np.zeros((0, 7)),
        labels={},
    )
    wall = Obstacle(name="wall", shape="plane")
    bodies = [(wall, np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0]), 2)]
    frames, answers = StubTransformer(), list[dict[str, Any]]()
    # The output needs one method of a transformer.
    output = CameraOutput(client.node, "arm", setup, frames, answers.append)  # type: ignore[arg-type]
    images: list[Image] = []
    client.node.create_subscription(Image, "/arm/depth/image_rect_raw", images.append, qos_profile_sensor_data)
    client.spin_until(lambda: output.is_subscribed, description="the subscriber")
    for _ in range(3):
        output.send(frame, bodies)
    assert answers == [{"warning": "camera 'arm' sends no images: no transform from 'hand'", "camera": "arm"}]
    frames.pose = (0.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0)
    output.send(frame, bodies)
    client.spin_until(lambda: images, description="an image")
    assert (images[0].header.frame_id, images[0].header.stamp.sec) == ("hand", 1)
    assert np.abs(pixels(images[0]) - 3.0).max() < 1e-6
    assert answers[1:] == [{"found": "camera 'arm' follows frame 'hand'", "camera": "arm"}]
    frames.n_missing, frames.n_older = 3, 0
    output.send(frame, bodies)
    assert frames.n_missing < 0 and not frames.n_older, "it waits for the transform of the frame's time"
    frames.n_missing = 10**9
    output.send(frame, bodies)
    assert frames.n_older == 1
    frames.pose = None
    output.send(frame, bodies)
    assert len(answers) == 3, "a frame that is lost again is reported"
    assert frames.times == 7 * [SECOND], "TF is cleared if time was set back"


def test_quality_of_service_may_be_overridden(client: Client) -> None:
    topic = "/cloth_sim/wrist/labels"
    prefix = f"qos_overrides.{topic}.publisher"
    with ClockedCloth(client, {**SCENE, f"{prefix}.reliability": "reliable", f"{prefix}.depth": 2}) as cloth:
        # The name of its node may come later.
        (info,) = client.spin_until(
            lambda: [
                info
                for info in client.node.get_publishers_info_by_topic(topic)
                if info.node_name == "cloth_sim_cameras"
            ],
            description="the publisher of labels",
        )
        assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        depth = "/cloth_sim/wrist/depth/image_rect_raw"
        (info,) = client.spin_until(
            lambda: client.node.get_publishers_info_by_topic(depth), description="the publisher of depth"
        )
        assert info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        assert cloth.node.node.get_parameter(f"{prefix}.depth").value == 2
        assert cloth.node.node.get_parameter(f"qos_overrides.{depth}.publisher.depth").value == 5
    with pytest.raises(ParameterError, match=f"{prefix}.reliability is 'sure'"):
        ClockedCloth(client, {**SCENE, f"{prefix}.reliability": "sure"})


def test_session_with_cameras_verifies(client: Client, tmp_path: Path) -> None:
    values = {**SCENE, "record.enabled": True, "record.folder": str(tmp_path)}
    digests = []
    for cameras in (["wrist"], [""]):
        listed = {name: value for name, value in values.items() if cameras[0] or not name.startswith("wrist.")}
        with ClockedCloth(client, {**listed, "cameras": cameras}) as cloth:
            if cameras[0]:
                watcher = Watcher(client, "depth/image_rect_raw")
                watcher.of_one_stamp(cloth)
                cloth.node.node.set_parameters([Parameter("wrist.position", value=[0.0, -1.5, 1.0])])
            while cloth.simulation.frame < (digests[0][0] if digests else 40):
                cloth.tick()
            digests.append((cloth.simulation.frame, cloth.simulation.state.digest()))
    assert digests[0] == digests[1], "cameras change no bit"
    for path in tmp_path.glob("*.mcap"):
        verdict = verify([path])
        assert verdict.same and verdict.frames >= 39, verdict
        with SessionReader(path) as session:
            assert not [message.topic for message in session.messages() if "/wrist/" in message.topic]


def test_camera_process_keeps_its_answers_from_other_output() -> None:
    script = """
import os, sys
from cloth_sim_ros.ros.camera import camera_worker

class Worker(camera_worker.CameraWorker):
    def __init__(self, setup, answer):
        os.write(1, b"log of a library")
        answer({"warning": setup, "camera": ""})
        sys.exit()

camera_worker.CameraWorker = Worker
camera_worker.main([str(os.getppid())])
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        input=pickle.dumps("text"),
        env=child_environment(),
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"warning": "text", "camera": ""}
    assert b"log of a library" in done.stderr


def test_node_without_cameras_starts_no_process(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick()
        assert cloth.node.outputs.cameras is None
        assert "cameras" not in cloth.node.reporting.collector()[2]


def test_worker_takes_newest_job_and_reports_its_end(wait_until: Any) -> None:
    ends: list[str] = []
    process: WorkerProcess[int] = WorkerProcess(
        "cloth_sim_ros.no_such_module", name="test", encode=int, on_answer=lambda _: True, on_end=ends.append
    )
    wait_until(lambda: ends, description="the end of the process")
    assert ends == ["ended by itself (status 1)"]
    process.put(1)
    assert process.put(2) in (1, None)
    process.close()
