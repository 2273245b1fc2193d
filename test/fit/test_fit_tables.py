# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of real cloth in tables, and in messages of any type."""

from __future__ import annotations

import io
import math
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest

pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.fit_samples import START, cloth, random_truth, write_bag

from cloth_sim_ros import Scene
from cloth_sim_ros.fit import tables
from cloth_sim_ros.fit.bag import read_recording
from cloth_sim_ros.fit.message_fields import indices_of, points_of, pose_of, split_topic
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recorded import RecordedGripper, Recording
from cloth_sim_ros.fit.tables import parse_columns, read_clouds, read_track

SCENE = Scene.from_parameters({"cloth.resolution": [2, 2], "cloth.anchors": [""], "grippers": ["left"]})
POSES = "time,x,y,z\n100.0,0.5,0.0,1.5\n102.0,0.5,0.2,1.5\n"
LONG = "time,particle,x,y,z\n100.5,1,1,2,3\n100.5,0,4,5,6\n100.0,3,7,8,9\n"
WIDE = "t,m0_x,m0_y,m0_z,m3_x,m3_y,m3_z\n100.0,1,2,3,4,5,6\n100.5,,,,7,8,9\n"


def table(folder: Path, text: str, name: str = "clouds.csv") -> Path:
    (folder / name).write_text(text)
    return folder / name


def test_table_with_a_line_for_each_point(tmp_path: Path) -> None:
    times, clouds = read_clouds(table(tmp_path, LONG), 4)
    assert times.tolist() == [100.0, 100.5]
    nan = [np.nan] * 3
    np.testing.assert_equal(clouds[0], [nan, nan, nan, [7.0, 8.0, 9.0]])
    np.testing.assert_equal(clouds[1], [[4.0, 5.0, 6.0], [1.0, 2.0, 3.0], nan, nan])
    _, bare = read_clouds(table(tmp_path, LONG), 4, matched=False, scale=1e-3)
    np.testing.assert_allclose(bare[1], [[1e-3, 2e-3, 3e-3], [4e-3, 5e-3, 6e-3]])


def test_table_with_a_line_for_each_cloud(tmp_path: Path) -> None:
    columns = parse_columns("time=t, x=m{}_x, y=m{}_y, z=m{}_z")
    _, clouds = read_clouds(table(tmp_path, WIDE), 4, columns=columns)
    nan = [np.nan] * 3
    np.testing.assert_equal(clouds[0], [[1.0, 2.0, 3.0], nan, nan, [4.0, 5.0, 6.0]])
    np.testing.assert_equal(clouds[1], [nan, nan, nan, [7.0, 8.0, 9.0]])
    plain = table(tmp_path, "time,x0,y0,z0\n0,1,2,3\n")
    np.testing.assert_equal(read_clouds(plain, 1)[1][0], [[1.0, 2.0, 3.0]])


def test_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    clouds, poses = table(tmp_path, "\ufeff" + LONG), table(tmp_path, "\ufeff" + POSES, "left.csv")
    assert read_clouds(clouds, 4)[0].tolist() == [100.0, 100.5]
    assert read_track(poses, 100.0).times.tolist() == [0.0, 2.0]


def test_poses_of_semicolons_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FitError, match="separated by semicolons"):
        read_track(table(tmp_path, POSES.replace(",", ";")), 0.0)


def test_point_beyond_any_room_is_refused() -> None:
    poses = RecordedGripper(times=[0.0], positions=[[0.0] * 3], quaternions=[[0.0, 0.0, 0.0, 1.0]])
    with pytest.raises(FitError, match=r"time 0 s has the coordinate 1e\+300 m; at most 1e\+06 m"):
        Recording(name="far", times=[0.0], clouds=[[[0.0, -1e300, np.nan]]], grippers={"left": poses})


@pytest.mark.parametrize(("kind", "reason"), [("U4", "type <U4"), ("complex", "type complex128")])
def test_arrays_of_no_real_numbers_are_refused(kind: str, reason: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "clouds.npz", times=np.zeros(1).astype(kind), points=np.zeros((1, 4, 3)))
    with pytest.raises(FitError, match=reason):
        read_clouds(tmp_path / "clouds.npz", 4)


def test_array_larger_than_the_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_MAX_BYTES", 2000)
    np.savez_compressed(tmp_path / "clouds.npz", times=np.zeros(1000), points=np.zeros((1000, 4, 3)))
    with pytest.raises(FitError, match="8128 bytes unpacked; at most 2000"):
        read_clouds(tmp_path / "clouds.npz", 4)


def test_array_of_a_false_shape_is_refused(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**13,)})
    with zipfile.ZipFile(tmp_path / "clouds.npz", "w") as file:
        file.writestr("times.npy", header.getvalue())
    with pytest.raises(FitError, match=r"clouds\.npz"):
        read_clouds(tmp_path / "clouds.npz", 4)


def test_damaged_arrays_are_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "clouds.npz", "w") as file:
        file.writestr("times.npy", b"")
    with pytest.raises(FitError, match="the array 'times' is damaged"):
        read_clouds(tmp_path / "clouds.npz", 4)
    (tmp_path / "clouds.npz").write_text("no archive")
    with pytest.raises(FitError, match=r"is no npz file: write it with numpy\.savez"):
        read_clouds(tmp_path / "clouds.npz", 4)


def test_arrays_of_numpy_are_read(tmp_path: Path) -> None:
    points = np.arange(24.0).reshape(2, 4, 3)
    points[0, 1] = np.nan
    np.savez(tmp_path / "clouds.npz", t=[0.0, 0.5], points=points)
    times, clouds = read_clouds(tmp_path / "clouds.npz", 4, columns={"times": "t"})
    assert times.tolist() == [0.0, 0.5]
    np.testing.assert_equal(clouds[0], points[0])
    assert len(read_clouds(tmp_path / "clouds.npz", 4, columns={"times": "t"}, matched=False)[1][0]) == 3


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "there is no column 'time'; there are none"),
        ("time,x,y,z\n0,1,2,3\n", "there is no column 'particle'; there are time, x, y, z"),
        ("time,particle,x,y\n0,0,1,2\n", "there is no column 'z'"),
        ("time,particle,x,y,z\n", "the table has no cloud"),
        ("time,particle,x,y,z\n0,9,1,2,3\n", "line 2 names particle 9; there are 4, from index 0"),
        ("time,particle,x,y,z\n0,0.5,1,2,3\n", "line 2 names particle 0.5"),
        ("time,particle,x,y,z\n0,0,1,2\n", "line 2 has 4 entries; the table has 5 columns"),
        ("time,particle,x,y,z\n0,0,1,2,far\n", "line 2: z is 'far'; it must be a number"),
        ("time,particle,x,y,z\nnan,0,1,2,3\n", "line 2: time is nan; it must be finite"),
        ("time,x0,y0,z0\n0,1,2,3\n0,1,2,3\n", "line 3: a cloud of time 0 s stands above"),
        ("time,particle,x,y,z\n0,1,1,2,3\n0,1,,,\n", "line 3: particle 1 stands twice in the cloud of time 0 s"),
        ("time,x1,x01,y1,y01,z1,z01\n0,1,2,3,4,5,6\n", "there are several columns of particle 1, such as 'x01'"),
        ("time,x0,y0\n0,1,2\n", "there is a column 'x0', but no column 'z0'"),
        ("time,x7,y7,z7\n0,1,2,3\n", "there are columns of particle 7; there are 4"),
        ("time;x0;y0;z0\n0;1,5;2;3\n", "its columns are separated by semicolons; save it with commas"),
        ("Time,particle,x,y,z\n0,0,1,2,3\n", "there is no column 'time'; .*; name it by --columns time=COLUMN"),
        ("time,particle,x,y,z,x\n0,0,1,2,3,9\n", "the column 'x' stands 2 times; rename or remove the others"),
        ("time,x0,y0,z0,y0\n0,1,2,3,9\n", "the column 'y0' stands 2 times"),
    ],
)
def test_faulty_table_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(FitError, match=rf"clouds\.csv: {reason}"):
        read_clouds(table(tmp_path, text), 4)


def test_table_takes_less_memory_than_its_lines() -> None:
    lines = [f"{time},{particle},0.12345678,0.12345678,0.12345678" for time in range(50) for particle in range(100)]
    content = "\n".join(["time,particle,x,y,z", *lines]).encode()
    n_result_bytes = 50 * 100 * 3 * 8
    tracemalloc.start()
    try:
        # private: reading the file from disk takes a buffer that is larger than this table.
        tables._read_csv(content, 100, {}, True)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2 * n_result_bytes + len(content)


def test_header_of_a_wide_table_is_searched_once() -> None:
    class Header(list[str]):
        def __contains__(self, _: object) -> bool:
            pytest.fail("each column searches the whole header")

    header = Header(["time", *(f"{axis}{k}" for k in range(3) for axis in "xyz")])
    # private: a quadratic search shows in a header that counts it, and in times only of large tables.
    assert len(tables._wide_columns(header, {"x": "x", "y": "y", "z": "z"})) == 3


def test_column_of_two_names_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FitError, match="--columns uses the column 'y' 2 times; name a column for each"):
        read_clouds(table(tmp_path, LONG), 4, columns={"x": "y"})


def test_time_that_goes_back_is_named() -> None:
    poses = RecordedGripper(times=[0.0], positions=[[0.0] * 3], quaternions=[[0.0, 0.0, 0.0, 1.0]])
    with pytest.raises(FitError, match=r"back: cloud 2 has the time 0\.1 s after 0\.2 s"):
        Recording(name="back", times=[0.0, 0.2, 0.1], clouds=[[[0.0] * 3]] * 3, grippers={"left": poses})


def test_faulty_arrays_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "clouds.npz"
    with pytest.raises(FitError, match=r"clouds\.npz: .*No such file"):
        read_clouds(path, 4)
    path.write_bytes(b"PK\3\4 rubbish")
    with pytest.raises(FitError, match=r"clouds\.npz: "):
        read_clouds(path, 4)
    np.savez(path, times=[0.0])
    with pytest.raises(FitError, match="there is no array 'points'; there are times"):
        read_clouds(path, 4)
    np.savez(path, times=[0.0], points=np.zeros((1, 4)))
    with pytest.raises(FitError, match=r"they must be \(clouds,\) and \(clouds, points, 3\)"):
        read_clouds(path, 4)
    np.savez(path, times=[0.0, np.nan, 2.0], points=np.zeros((3, 4, 3)))
    with pytest.raises(FitError, match="the time of cloud 1 is nan; it must be finite"):
        read_clouds(path, 4)
    np.savez(path, times=[], points=np.zeros((0, 4, 3)))
    with pytest.raises(FitError, match="the table has no cloud"):
        read_clouds(path, 4)
    np.savez(path, times=[0.0], points=np.zeros((1, 5, 3)))
    with pytest.raises(FitError, match="points have 5 particles; the scene has 4"):
        read_clouds(path, 4)
    np.savez(path, times=np.array([{}], dtype=object), points=np.zeros((1, 4, 3)))
    with pytest.raises(FitError, match="allow_pickle"):
        read_clouds(path, 4)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("time", "write it as time=t"),
        ("width=w", "unknown name 'width'; known are time, particle"),
        ("x=a,x=b", "names 'x' twice, as 'a' and as 'b'; give it once"),
    ],
)
def test_faulty_names_of_columns_are_refused(text: str, reason: str) -> None:
    with pytest.raises(FitError, match=reason):
        parse_columns(text)


def test_clouds_and_poses_of_tables_have_one_clock(tmp_path: Path) -> None:
    poses = table(tmp_path, POSES, "left.csv")
    recording = read_recording([table(tmp_path, LONG)], SCENE, poses={"left": str(poses)})
    assert recording.times.tolist() == [0.0, 0.5]
    assert recording.grippers["left"].times.tolist() == [0.0, 2.0]
    assert recording.grippers["left"].pose_at(1.0)[0] == [0.5, 0.1, 1.5]
    assert recording.grippers["left"].is_closed(0.0)
    with pytest.raises(FitError, match=r"poses of gripper 'left' are missing; give --pose left=poses\.csv"):
        read_recording([table(tmp_path, LONG)], SCENE)
    with pytest.raises(FitError, match="a table is one recording"):
        read_recording([table(tmp_path, LONG), poses], SCENE, poses={"left": str(poses)})


TYPES = get_types_from_msg("uint32 id\ngeometry_msgs/Point translation", "mocap_msgs/msg/Marker") | get_types_from_msg(
    "std_msgs/Header header\nmocap_msgs/Marker[] markers\nfloat64[] flat", "mocap_msgs/msg/Markers"
)


def markers(store: Any, seconds: int, points: dict[int, tuple[float, float, float]], **header: Any) -> Any:
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=0)
    entries = [
        types["mocap_msgs/msg/Marker"](id=k, translation=types["geometry_msgs/msg/Point"](*point))
        for k, point in points.items()
    ]
    head = types["std_msgs/msg/Header"](stamp=stamp, frame_id="map", **header)
    return types["mocap_msgs/msg/Markers"](header=head, markers=entries, flat=np.arange(6.0))


@pytest.mark.parametrize("version", [1, 2])
def test_fields_of_own_messages_are_read(tmp_path: Path, version: int) -> None:
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_JAZZY)
    store.register(TYPES)
    name = "mocap_msgs/msg/Markers"
    header = {"seq": 1} if version == 1 else {}
    path = tmp_path / ("real.bag" if version == 1 else "real")
    with Ros1Writer(path) if version == 1 else Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/mocap", name, typestore=store)
        for seconds, points in ((100, {3: (1.0, 2.0, 3.0), 0: (4.0, 5.0, 6.0)}), (101, {1: (7.0, 8.0, 9.0)})):
            message = markers(store, seconds, points, **header)
            data = store.serialize_ros1(message, name) if version == 1 else store.serialize_cdr(message, name)
            writer.write(connection, seconds, data)
    poses = {"left": str(table(tmp_path, POSES, "left.csv"))}
    topic = "/mocap:markers[].translation"
    recording = read_recording([path], SCENE, topic=topic, poses=poses, index_field="markers[].id")
    assert recording.times.tolist() == [0.0, 1.0]
    nan = [np.nan] * 3
    np.testing.assert_equal(recording.clouds[0], [[4.0, 5.0, 6.0], nan, nan, [1.0, 2.0, 3.0]])
    bare = read_recording([path], SCENE, topic="/mocap:flat", poses=poses, matched=False)
    np.testing.assert_equal(bare.clouds[1], [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    for wrong, reason in (
        ("/mocap:markers[].position", r"there is no 'position'; there are id, translation"),
        ("/mocap:header[].stamp", r"\[\] stands after a value that is no array"),
        ("/mocap:markers[].id", "holds 1 numbers; each point has three"),
        ("/mocap:markers..id", "is no field of a message; write it as"),
        ("/tracker:markers[].translation", "has no topic '/tracker'; it has /mocap"),
    ):
        with pytest.raises(FitError, match=reason):
            read_recording([path], SCENE, topic=wrong, poses=poses)
    with pytest.raises(FitError, match="a gripper has one pose"):
        read_recording([path], SCENE, topic=topic, poses={"left": "/mocap:markers[].translation"})


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        (("base", "base"), "the poses of gripper 'left' are in frame 'base', the clouds in 'map'; give --camera-pose"),
        (("map", "base"), "the poses of gripper 'left' are in several frames: base, map; transform them"),
    ],
)
def test_poses_in_another_frame_are_refused(tmp_path: Path, frames: tuple[str, str], reason: str) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(TYPES)
    types, name, kind = store.types, "mocap_msgs/msg/Markers", "geometry_msgs/msg/PoseStamped"
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](0.5, 0.0, 1.5),
        orientation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )
    with Writer(tmp_path / "real", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        clouds = writer.add_connection("/mocap", name, typestore=store)
        hand = writer.add_connection("/left/pose", kind, typestore=store)
        for seconds, frame in zip((100, 101), frames, strict=True):
            message = markers(store, seconds, {3: (1.0, 2.0, 3.0)})
            writer.write(clouds, seconds, store.serialize_cdr(message, name))
            stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=0)
            head = types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)
            writer.write(hand, seconds, store.serialize_cdr(types[kind](header=head, pose=pose), kind))
    options: dict[str, Any] = {"topic": "/mocap:markers[].translation", "index_field": "markers[].id"}
    with pytest.raises(FitError, match=reason):
        read_recording([tmp_path / "real"], SCENE, **options)
    if frames[0] == frames[1]:
        identity = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        assert len(read_recording([tmp_path / "real"], SCENE, camera_pose=identity, **options).clouds) == 2


def test_forms_of_points_and_poses() -> None:
    types = get_typestore(Stores.ROS2_JAZZY).types
    point, turn = (
        types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0),
        types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 1.0, 0.0),
    )
    transform = types["geometry_msgs/msg/Transform"](
        translation=types["geometry_msgs/msg/Vector3"](1.0, 2.0, 3.0), rotation=turn
    )
    pose = types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
    for message, field in ((transform, ""), (pose, "")):
        assert pose_of(message, field) == [1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0]
    assert pose_of(pose, "position") == [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]
    with pytest.raises(FitError, match="a pose has position and orientation"):
        pose_of(turn, "w")
    assert split_topic("/mocap:flat") == ("/mocap", "flat")
    array = types["std_msgs/msg/Float64MultiArray"](
        layout=types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0), data=np.array([1.0, 2.5])
    )
    with pytest.raises(FitError, match="not whole"):
        indices_of(array, "data")
    with pytest.raises(FitError, match="holds 2 numbers"):
        points_of(array, "data")
    with pytest.raises(FitError, match="no points"):
        points_of(types["std_msgs/msg/String"](data="x"), "data")


def test_coordinates_may_stand_in_three_arrays() -> None:
    types = get_typestore(Stores.ROS2_JAZZY).types
    names = {"name": [], "position": np.array([1.0, 2.0]), "velocity": np.array([3.0, 4.0]), "effort": np.array([5.0])}
    message = types["sensor_msgs/msg/JointState"](header=None, **names)
    assert points_of(message, "position,velocity,position").tolist() == [[1.0, 3.0, 1.0], [2.0, 4.0, 2.0]]
    assert split_topic("/mesh:x,y,z") == ("/mesh", "x,y,z")
    with pytest.raises(FitError, match="hold 2, 2, 1 numbers; each point has one in every field"):
        points_of(message, "position,velocity,effort")
    with pytest.raises(FitError, match="is no field of a message"):
        split_topic("/mesh:x,y")


def test_camera_pose_and_offset_move_clouds_and_grippers(tmp_path: Path) -> None:
    """A quarter turn about z takes x to y."""
    clouds, poses = table(tmp_path, LONG), {"left": str(table(tmp_path, POSES, "left.csv"))}
    quarter = [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]
    plain = read_recording([clouds], SCENE, poses=poses)
    moved = read_recording(
        [clouds], SCENE, poses=poses, camera_pose=[1.0, 0.0, 0.0, *quarter], offsets={"left": [0.0, 0.0, -0.1]}
    )
    x, y, z = plain.clouds[0].T
    np.testing.assert_allclose(moved.clouds[0], np.stack([1.0 - y, x, z], axis=1), atol=1e-15)
    np.testing.assert_allclose(
        moved.grippers["left"].positions, plain.grippers["left"].positions - [0.0, 0.0, 0.1], atol=1e-15
    )
    turned = attrs.evolve(plain.grippers["left"], quaternions=[quarter] * len(plain.grippers["left"].times))
    np.testing.assert_allclose(
        turned.offset_by([0.2, 0.0, 0.0]).positions - turned.positions, [[0.0, 0.2, 0.0]] * 2, atol=1e-15
    )
    with pytest.raises(FitError, match="--offset names 'right'; the scene's grippers are left"):
        read_recording([clouds], SCENE, poses=poses, offsets={"right": [0.0, 0.0, 0.0]})
    with pytest.raises(FitError, match="it needs seven finite numbers"):
        read_recording([clouds], SCENE, poses=poses, camera_pose=[0.0] * 7)


def test_bag_and_tables_give_the_same_recording(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "real.mcap", random_truth(3), seconds=0.1, resolution=4)
    scene = cloth({**START, "rate": 60.0}, resolution=4)
    expected = read_recording([bag], scene)
    lines = ["t,id,X,Y,Z"]
    for time, cloud in zip(expected.times.tolist(), expected.clouds, strict=True):
        lines += [f"{7.0 + time!r},{k},{x!r},{y!r},{z!r}" for k, (x, y, z) in enumerate((1e3 * cloud).tolist())]
    clouds = table(tmp_path, "\n".join(lines))
    poses = {}
    for name, track in expected.grippers.items():
        rows = np.column_stack([track.times + 7.0, 1e3 * track.positions, track.quaternions]).tolist()
        text = "\n".join(["time,x,y,z,qx,qy,qz,qw", *(",".join(map(repr, row)) for row in rows)])
        poses[name] = str(table(tmp_path, text, f"{name}.csv"))
    columns = parse_columns("time=t,particle=id,x=X,y=Y,z=Z")
    recording = read_recording([clouds], scene, poses=poses, columns=columns, scale=1e-3)
    np.testing.assert_allclose(recording.times, expected.times, atol=1e-12)
    np.testing.assert_allclose(recording.clouds, expected.clouds, rtol=1e-14)
    for name, track in expected.grippers.items():
        np.testing.assert_allclose(recording.grippers[name].times, track.times, atol=1e-6)
        np.testing.assert_allclose(recording.grippers[name].positions, track.positions, rtol=1e-14)
