# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Links of a robot as obstacles: kinematics, choice of links, names, meshes, friction and stops of fingers."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.robots import ARM, chain, robot_scene, with_links

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.physics.contact.obstacle_mesh import mesh_distance
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.recorded_scene import recorded_values
from cloth_sim_ros.scene.robot.collision_meshes import find_file
from cloth_sim_ros.scene.robot.description import parse
from cloth_sim_ros.scene.robot.kinematics import Kinematics, poses_of
from cloth_sim_ros.scene.robot.links import RobotLinks
from cloth_sim_ros.scene.robot.pad_stops import PadStops

AT: dict[str, Any] = {"robot.position": [0.8, 0.0, 0.5]}
#: A tetrahedron, and the same without one face.
SOLID = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
OPEN = SOLID.rsplit("f", 1)[0]
FLAT = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n"


def with_mesh(filename: str, scale: str = "1 1 1") -> str:
    return (
        '<robot name="r"><link name="body"><collision><geometry>'
        f'<mesh filename="{filename}" scale="{scale}"/></geometry></collision></link></robot>'
    )


def test_planar_arm_is_where_trigonometry_puts_it() -> None:
    _, links = robot_scene(ARM, AT)
    a, b = 0.4, 0.7
    poses = dict(zip(links.names, links.poses({"shoulder": a, "elbow": b, "finger": 0.02}), strict=True))
    # Rotations about y: the arm lies in the x-z plane.
    elbow = np.array([0.8 + 0.3 * math.sin(a), 0.0, 0.6 + 0.3 * math.cos(a)])
    hand = elbow + 0.33 * np.array([math.sin(a + b), 0.0, math.cos(a + b)])
    middle = hand + 0.02 * np.array([math.sin(a + b), 0.0, math.cos(a + b)])
    assert np.abs(poses["hand"][:3] - middle).max() < 1e-15
    assert np.abs(poses["hand"][3:] - [0.0, math.sin(0.5 * (a + b)), 0.0, math.cos(0.5 * (a + b))]).max() < 1e-15
    # The right finger mimics the left one.
    assert poses["left_finger"][1] == pytest.approx(0.03)
    assert poses["right_finger"][1] == pytest.approx(-0.03)


def test_random_trees_are_where_scipy_puts_them() -> None:
    rng = np.random.default_rng(3)

    def text(vector: Any) -> str:
        return " ".join(map(repr, np.asarray(vector, dtype=float).tolist()))

    for _ in range(20):
        kinds = rng.choice(["fixed", "revolute", "continuous", "prismatic"], 12).tolist()
        links, expected, q = ['<link name="l0"/>'], [np.eye(4)], dict[int, float]()
        for k, kind in enumerate(kinds):
            parent, xyz, rpy = int(rng.integers(k + 1)), rng.normal(size=3), rng.uniform(-4.0, 4.0, 3)
            # Axes are not of unit length.
            axis, mimic = rng.normal(size=3) * 10.0 ** rng.uniform(-3.0, 3.0), ""
            if kind != "fixed":
                q[k] = float(rng.uniform(-3.0, 3.0))
                if k % 3 == 0 and len(q) > 1:
                    source, multiplier, offset = next(iter(q)), float(rng.normal()), float(rng.normal())
                    mimic = f'<mimic joint="j{source}" multiplier="{multiplier!r}" offset="{offset!r}"/>'
                    q[k] = multiplier * q[source] + offset
            links.append(
                f'<link name="l{k + 1}"/><joint name="j{k}" type="{kind}"><parent link="l{parent}"/>'
                f'<child link="l{k + 1}"/><origin xyz="{text(xyz)}" rpy="{text(rpy)}"/><axis xyz="{text(axis)}"/>'
                f"{mimic}</joint>"
            )
            origin, motion, unit = np.eye(4), np.eye(4), axis / np.linalg.norm(axis)
            origin[:3, :3], origin[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
            if kind == "prismatic":
                motion[:3, 3] = unit * q[k]
            elif kind != "fixed":
                motion[:3, :3] = Rotation.from_rotvec(unit * q[k]).as_matrix()
            expected.append(expected[parent] @ origin @ motion)
        kinematics = Kinematics(parse(f'<robot name="r">{"".join(links)}</robot>'))
        bodies = kinematics.body_transforms(
            kinematics.joint_positions({f"j{k}": value for k, value in q.items()}), np.eye(4)
        )
        for k, transform in enumerate(expected):
            body, placement = kinematics.placements[f"l{k}"]
            assert np.abs(bodies[body] @ placement - transform).max() < 1e-13


def test_poses_keep_rotations_of_half_a_turn() -> None:
    for axis in np.eye(3):
        turned = np.eye(4)
        turned[:3, :3] = 2.0 * np.outer(axis, axis) - np.eye(3)
        assert np.abs(poses_of(turned[None])[0, 3:]).tolist() == [*axis.tolist(), 0.0]


def test_missing_joint_stays_within_its_limits() -> None:
    text = ARM.replace('lower="-2.0"', 'lower="0.5"')
    kinematics = Kinematics(parse(text))
    assert kinematics.joint_positions({"elbow": 1.0}).tolist() == [0.5, 1.0, 0.0, 0.0]


def test_mimic_of_a_mimic_follows_with_both_offsets() -> None:
    links = "".join(f'<link name="l{k}"/>' for k in range(4))
    mimics = ["", '<mimic joint="j0" multiplier="2" offset="0.1"/>', '<mimic joint="j1" multiplier="-1" offset="1"/>']
    joints = "".join(
        f'<joint name="j{k}" type="prismatic"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<limit lower="-1" upper="1"/>{mimic}</joint>'
        for k, mimic in enumerate(mimics)
    )
    kinematics = Kinematics(parse(f'<robot name="r">{links}{joints}</robot>'))
    bodies = kinematics.body_transforms(np.array([0.3]), np.eye(4))
    assert np.diff(bodies[:, 0, 3]).tolist() == pytest.approx([0.3, 0.7, 0.3])


def test_reach_bounds_every_pose_of_every_link() -> None:
    rng = np.random.default_rng(1)
    kinematics = Kinematics(parse(ARM))
    for _ in range(200):
        positions = rng.uniform([-2.0, -2.8, -3.0, 0.0], [2.0, 2.8, 3.0, 0.04])
        bodies = kinematics.body_transforms(positions, np.eye(4))
        for body in range(1, len(bodies)):
            centre, radius = kinematics.bounding_ball(body, 0.0)
            assert np.linalg.norm(bodies[body][:3, 3] - centre) <= radius + 1e-12


def test_links_out_of_reach_are_left_out_and_named() -> None:
    scene, links = robot_scene(ARM, {"robot.position": [9.0, 0.0, 0.0]})
    assert links.names == ()
    assert scene.obstacle_names == []
    assert "cannot reach the cloth are no obstacles: base, forearm, hand, left_finger" in links.notes[0]
    # A gripper may carry the cloth as far as the arm reaches: all its links are kept.
    assert len(robot_scene(ARM, AT)[1].names) == 6
    # Without a gripper the base, which never moves, is too far from the cloth.
    alone = robot_scene(ARM, {"robot.position": [2.6, 0.0, 0.5], "grippers": [""]})[1]
    assert "base" not in alone.names
    assert "hand" in alone.names


@pytest.mark.parametrize(
    "values",
    [
        # It falls on the arm.
        {"cloth.anchors": [""], "cloth.position": [0.0, 0.0, 4.0]},
        # Pads carry it.
        {"robot.pads": ["left_finger"], "robot.position": [2.6, 0.0, 0.5]},
        # Only TF knows where the arm is.
        {"robot.source": "tf", "robot.position": [9.0, 0.0, 0.0]},
    ],
)
def test_links_to_which_the_cloth_may_come_are_kept(values: dict[str, Any]) -> None:
    _, links = robot_scene(ARM, {"grippers": [""], **values})
    assert (len(links.names), links.notes) == (6, ())


def test_link_of_a_mimic_joint_that_stands_is_kept() -> None:
    text = ARM.replace('<limit lower="0.0" upper="0.04" effort="20" velocity="0.2"/>\n  </joint>', "</joint>", 1)
    _, links = robot_scene(text.replace('multiplier="1.0"', 'multiplier="0.0"'), {"grippers": [""], **AT})
    assert "right_finger" in links.names


def test_too_many_shapes_are_refused() -> None:
    with pytest.raises(
        ParameterError, match="has 2400 collision shapes, and at most 2000 become obstacles; name fewer"
    ):
        robot_scene(chain(300, 8), AT)
    assert robot_scene(chain(300, 8), {"robot.links": ["l1"], **AT})[1].links == ("l1",) * 8


def test_poses_of_no_links_are_an_empty_array() -> None:
    _, links = robot_scene(ARM, {"robot.position": [9.0, 0.0, 0.0]})
    assert links.poses({}).shape == links.poses_from_links({}).shape == (0, 7)


def test_mesh_of_a_link_replaces_no_other_file(tmp_path: Path) -> None:
    (tmp_path / "mesh.obj").write_text(SOLID)
    desk = SOLID.replace("0.1", "0.7")
    values = {"obstacles": ["desk"], "desk.shape": "mesh", "desk.mesh": "body.obj", "robot.links": ["body"]}
    extended, files, _ = with_links(values, with_mesh("mesh.obj"), folder=tmp_path, files={"body.obj": desk.encode()})
    assert files["body.obj"] == desk.encode()
    assert extended["body.mesh"] != "body.obj"
    assert files[extended["body.mesh"]].count(b"v ") == 4


def test_link_with_the_name_of_a_camera_gets_another_one() -> None:
    assert robot_scene(ARM, {"cameras": ["hand"], "robot.links": ["hand"], **AT})[1].names == ("hand_0",)


def test_named_links_are_kept_with_names_of_their_own() -> None:
    values = {
        "robot.links": ["hand"],
        "obstacles": ["hand"],
        "hand.shape": "sphere",
        "hand.size": [0.1],
        "robot.position": [9.0, 0.0, 0.0],
    }
    scene, links = robot_scene(ARM, values)
    assert links.names == ("hand_0",)
    assert scene.obstacle_names == ["hand", "hand_0"]
    assert scene.link_names == ["hand_0"]
    assert scene.described["hand_0"].link == "hand"
    several = robot_scene(chain(1, 3), {"robot.links": ["l1"], **AT})[1]
    assert several.names == ("l1_0", "l1_1", "l1_2")


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        (
            "robot.links",
            ["forarm"],
            "robot.links names 'forarm', which is no link of the robot; did you mean 'forearm'",
        ),
        ("robot.pads", ["thumb"], "robot.pads names 'thumb'"),
    ],
)
def test_unknown_link_is_refused_with_a_suggestion(name: str, value: list[str], reason: str) -> None:
    with pytest.raises(ParameterError, match=reason):
        robot_scene(ARM, {name: value})


def test_recorded_scene_runs_without_description() -> None:
    scene, links = robot_scene(ARM, AT)
    again = Scene.from_parameters(
        recorded_values(parameter_file.dump(scene.parameters()), node="cloth_sim"), files=scene.files
    )
    assert again == scene
    # A second call replaces the links of the first one.
    values, _, second = with_links(scene.parameters(), ARM, files=scene.files)
    assert second.names == links.names
    assert values["obstacles"] == scene.obstacles


def test_scene_file_names_the_description(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(ARM)
    lines = "robot.enabled: true\n    robot.description_file: arm.urdf\n    robot.position: [0.8, 0.0, 0.5]\n"
    (tmp_path / "scene.yaml").write_text(f"/**:\n  ros__parameters:\n    {lines}")
    scene = Scene.from_file(tmp_path / "scene.yaml")
    assert len(scene.link_names) == 6
    assert Simulation(scene).obstacles is not None


def test_closed_mesh_is_kept_and_scaled(tmp_path: Path) -> None:
    (tmp_path / "body.obj").write_text(SOLID)
    values = {"robot.links": ["body"]}
    _, files, links = with_links(values, with_mesh("body.obj", "1 -2 1"), folder=tmp_path)
    assert links.notes == ()
    scene = Scene.from_parameters(
        with_links(values, with_mesh(f"file://{tmp_path}/body.obj", "1 -2 1"))[0] | {"cloth.position": [0.0, 0.0, 9.0]},
        files=files,
    )
    solid = scene.solids[0]
    assert solid.vertices is not None
    # The obstacle's frame is in the middle of the mesh.
    assert solid.vertices.min(axis=0).tolist() == [-0.05, -0.1, -0.05]
    assert scene.described["body"].position == (0.05, -0.1, 0.05)


def test_open_mesh_becomes_its_convex_hull_and_says_so(tmp_path: Path) -> None:
    (tmp_path / "body.obj").write_text(OPEN)
    _, files, links = with_links({"robot.links": ["body"]}, with_mesh("body.obj"), folder=tmp_path)
    assert links.notes == ("link 'body': mesh 'body.obj' is not closed: its convex hull stands for it",)
    assert files["body.obj"].count(b"f ") == 4
    # Two pieces stay two obstacles.
    second = OPEN.replace("v 0", "v 5").replace("f 1 3 2\nf 1 2 4\nf 1 4 3\n", "f 5 7 6\nf 5 6 8\nf 5 8 7\n")
    (tmp_path / "body.obj").write_text(OPEN + second)
    two = with_links({"robot.links": ["body"]}, with_mesh("body.obj"), folder=tmp_path)[2]
    assert two.names == ("body_0", "body_1")
    assert "the convex hulls of its 2 pieces stand" in two.notes[0].replace("stands", "stand")


def test_fine_mesh_becomes_a_hull_of_few_vertices(tmp_path: Path) -> None:
    # A ball with a waist: closed, not convex, 800 triangles.
    angles, turns = np.linspace(0.0, math.pi, 22)[1:-1], 2.0 * math.pi * np.arange(20) / 20.0
    radii = 0.05 * np.sin(angles) * (1.0 - 0.3 * np.exp(-((10.0 * np.cos(angles)) ** 2)))
    points = [
        (r * math.cos(t), r * math.sin(t), -0.05 * math.cos(a))
        for a, r in zip(angles, radii, strict=True)
        for t in turns
    ]
    points += [(0.0, 0.0, -0.05), (0.0, 0.0, 0.05)]
    faces = [(400, (i + 1) % 20, i) for i in range(20)] + [(401, 380 + i, 380 + (i + 1) % 20) for i in range(20)]
    for a, b in ((20 * k + i, 20 * k + (i + 1) % 20) for k in range(19) for i in range(20)):
        faces += [(a, b, b + 20), (a, b + 20, a + 20)]
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in points] + [
        f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces
    ]
    (tmp_path / "body.obj").write_text("\n".join(lines))
    values, files, links = with_links({"robot.links": ["body"]}, with_mesh("body.obj"), folder=tmp_path)
    assert re.fullmatch(
        r"link 'body': mesh 'body.obj' has 800 triangles: its convex hull stands for it, and the mesh protrudes by up "
        r"to \d(\.\d)? mm",
        links.notes[0],
    )
    (solid,) = Scene.from_parameters(values | {"cloth.position": [0.0, 0.0, 9.0]}, files=files).solids
    assert solid.vertices is not None
    assert len(solid.vertices) == 48
    assert mesh_distance(np.array(points), solid.vertices, solid.triangles)[0].max() < 0.005


@pytest.mark.parametrize(
    ("uri", "reason"),
    [
        ("missing.obj", "mesh 'missing.obj' can't be read.*No such file.*leave its link out"),
        ("flat.obj", "is open and flat"),
        ("package://no_such_robot/a.stl", "package 'no_such_robot', which is not in AMENT_PREFIX_PATH; source"),
        ("http://host/a.stl", "give package:// or file://"),
        (f"package://{'p' * 300}/a.stl", "can't be read.*File name too long"),
        ("body.dae", "its name must end in obj, ply, stl"),
    ],
)
def test_mesh_that_cannot_be_used_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uri: str, reason: str
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    (tmp_path / "share").mkdir()
    (tmp_path / "flat.obj").write_text(FLAT)
    (tmp_path / "body.dae").write_text("<COLLADA/>")
    with pytest.raises(ParameterError, match=reason):
        with_links({"robot.links": ["body"]}, with_mesh(uri), folder=tmp_path)


def test_package_of_a_mesh_is_found_by_the_prefix_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "share" / "my_robot").mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    assert find_file("package://my_robot/meshes/a%20b.stl", Path()) == tmp_path / "share/my_robot/meshes/a b.stl"


@pytest.mark.parametrize("gap", [None, 1.0, 1.9])
def test_pads_have_the_friction_of_grippers_and_stop(gap: float | None) -> None:
    values = {**AT, "robot.pads": ["left_finger", "right_finger"], "gripper.friction": [0.8, 0.7]}
    if gap is not None:
        values["robot.pad_gap"] = gap
    scene, links = robot_scene(ARM, {**values, "robot.friction": [0.1]})
    assert scene.described["left_finger"].friction == (0.8, 0.7)
    assert scene.described["hand"].friction == (0.1,)
    stops, positions = PadStops(scene, links), np.array([0.2, 0.3, 0.4, 0.03])
    for finger in np.linspace(0.03, 0.0, 20):
        positions[3] = finger
        positions[0] += 0.01
        stopped = stops.limit_positions(positions)
        assert stopped[:3].tolist() == positions[:3].tolist()
    # Half the distance between the faces, which are at y = 0 of the closed fingers.
    half_gap = 0.5 * (gap or 1.4) * scene.contact.thickness
    assert stopped[3] == pytest.approx(half_gap, rel=0.05)
    assert stopped[3] >= half_gap
    positions[3] = 0.01
    assert stops.limit_positions(positions).tolist() == positions.tolist()


def test_held_pads_need_three_forward_kinematics(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, links = robot_scene(ARM, {**AT, "robot.pads": ["left_finger", "right_finger"]})
    stops, calls, poses = PadStops(scene, links), [], links.poses
    for finger in (0.03, *np.zeros(20)):
        stopped = stops.limit_positions(np.array([0.2, 0.3, 0.4, finger]))
    monkeypatch.setattr(links, "poses", lambda positions: calls.append(positions) or poses(positions))
    # The arm goes on, and the command keeps the fingers closed.
    assert stops.limit_positions(np.array([0.21, 0.3, 0.4, 0.0]))[3] == stopped[3]
    assert len(calls) == 3


def sliding_fingers(*joints: tuple[str, str, str]) -> str:
    """Return a robot whose links slide along y: name, parent and origin of each. They are pads of 2 cm."""
    box = '<collision><geometry><box size="0.02 0.02 0.02"/></geometry></collision>'
    links = [
        f'<link name="{name}">{box}</link><joint name="{name}_joint" type="prismatic"><parent link="{parent}"/>'
        f'<child link="{name}"/><axis xyz="0 1 0"/><origin xyz="{origin}"/><limit lower="-1" upper="1"/></joint>'
        for name, parent, origin in joints
    ]
    return f'<robot name="r"><link name="stand"/>{"".join(links)}</robot>'


def test_pads_of_two_hands_leave_the_arms_free() -> None:
    """Each arm slides towards the other one; the pads of the two hands meet, and both arms go on."""
    arms = [(name, "stand", f"0 {y} 0") for name, y in (("left", 0.2), ("right", -0.2))]
    fingers = [(f"{arm}_{k}", arm, f"0 {y} 0.1") for arm in ("left", "right") for k, y in enumerate((0.02, -0.02))]
    pads = [name for name, _, _ in fingers]
    scene, links = robot_scene(
        sliding_fingers(*arms, *fingers), {"robot.position": [2.0, 0.0, 0.0], "robot.pads": pads}
    )
    stops = PadStops(scene, links)
    index = {name: k for k, name in enumerate(links.joint_names)}
    positions = np.zeros(len(index))
    stops.limit_positions(positions)
    positions[index["left_joint"]], positions[index["right_joint"]] = -0.17, 0.17
    assert stops.limit_positions(positions).tolist() == positions.tolist()
    # Fingers of one hand still stop.
    positions[index["left_0_joint"]] = -0.02
    assert -0.02 < stops.limit_positions(positions)[index["left_0_joint"]] < -0.01


def opposite_chains(n_left: int, n_right: int) -> tuple[PadStops, RobotLinks]:
    """Two chains of sliding joints with a pad at each end: the first ones close the pads, the second ones move along x.

    They are two arms with palms, or two fingers of a hand.
    """
    joints = []
    for branch, y, count in (("left", 0.1, n_left), ("right", -0.1, n_right)):
        bodies = ["stand", *(f"{branch}_{k}" for k in range(count))]
        joints += [
            (child, parent, f"0 {0.0 if k else y} {0.12 / count}") for k, (parent, child) in enumerate(pairwise(bodies))
        ]
    text = sliding_fingers(*joints)
    for name in ("left_1", "right_1"):
        text = text.replace(f'<child link="{name}"/><axis xyz="0 1 0"/>', f'<child link="{name}"/><axis xyz="1 0 0"/>')
    pads = [f"left_{n_left - 1}", f"right_{n_right - 1}"]
    scene, links = robot_scene(text, {"robot.position": [2.0, 0.0, 0.0], "robot.pads": pads, "robot.links": pads})
    return PadStops(scene, links), links


@pytest.mark.parametrize(("n_left", "n_right"), [(2, 2), (4, 4), (5, 4), (6, 6)])
def test_pads_at_their_stop_move_together(n_left: int, n_right: int) -> None:
    """Palms of two arms press and carry, or the fingers of a hand close and turn what is between them."""
    stops, links = opposite_chains(n_left, n_right)
    index = {name: k for k, name in enumerate(links.joint_names)}
    positions = np.zeros(len(index))
    stops.limit_positions(positions)
    for _ in range(10):
        positions[index["left_0_joint"]] -= 0.009
        positions[index["right_0_joint"]] += 0.009
        before = links.poses(stops.limit_positions(positions))
    for _ in range(10):
        positions[[index["left_1_joint"], index["right_1_joint"]]] += 0.005
        after = links.poses(stops.limit_positions(positions))
    assert (after - before)[:, 0] == pytest.approx([0.05, 0.05], abs=1e-4)
    # 1.4 thicknesses of 3 mm between faces of pads of 2 cm.
    gap = after[0, 1] - after[1, 1] - 0.02
    assert 0.0042 <= gap < 0.0044
    positions[index["left_0_joint"]] += 0.03
    assert stops.limit_positions(positions).tolist() == positions.tolist()


def test_closing_finger_moves_no_finger_that_stands() -> None:
    stops, links = opposite_chains(3, 3)
    index = {name: k for k, name in enumerate(links.joint_names)}
    positions = np.zeros(len(index))
    stops.limit_positions(positions)
    for _ in range(20):
        # The finger's last command is 10 mm beyond the face of the other one.
        positions[index["left_0_joint"]] = max(positions[index["left_0_joint"]] - 0.012, -0.19)
        limited = stops.limit_positions(positions)
        assert limited[[k for name, k in index.items() if name != "left_0_joint"]].tolist() == [0.0] * 5
    assert links.poses(limited)[0, 1] - links.poses(limited)[1, 1] - 0.02 == pytest.approx(0.0042, abs=2e-4)


def test_finger_between_two_others_keeps_both_gaps() -> None:
    joints = [("low", "stand", "0 -0.05 0"), ("middle", "stand", "0 0 0"), ("high", "stand", "0 0.05 0")]
    pads = ["low", "middle", "high"]
    scene, links = robot_scene(sliding_fingers(*joints), {"robot.position": [2.0, 0.0, 0.0], "robot.pads": pads})
    stops, random, positions = PadStops(scene, links), np.random.default_rng(4), np.zeros(3)
    stops.limit_positions(positions)
    for _ in range(300):
        positions = np.clip(positions + random.normal(scale=0.004, size=3) + [2e-4, 0.0, -2e-4], -0.03, 0.03)
        y = links.poses(stops.limit_positions(positions))[:, 1]
        by_name = dict(zip(links.names, y, strict=True))
        gaps = by_name["middle"] - by_name["low"], by_name["high"] - by_name["middle"]
        assert min(gaps) >= 0.02 + 0.0042 - 1e-9


def test_pads_of_one_finger_leave_its_joints_free() -> None:
    joints = [("near", "stand", "0 0.05 0"), ("tip", "near", "0 0 0.02"), ("thumb", "stand", "0 -0.05 0")]
    values = {"robot.position": [2.0, 0.0, 0.0], "robot.pads": ["near", "tip", "thumb"]}
    scene, links = robot_scene(sliding_fingers(*joints), values)
    stops, index = PadStops(scene, links), links.joint_names.index("tip_joint")
    positions = np.zeros(3)
    stops.limit_positions(positions)
    positions[index] = 0.01
    assert stops.limit_positions(positions).tolist() == positions.tolist()
    # The finger still stops before the thumb.
    positions[links.joint_names.index("near_joint")] = -0.1
    assert stops.limit_positions(positions)[links.joint_names.index("near_joint")] > -0.08


def test_pads_stop_at_the_thickness_of_the_present_scene() -> None:
    scene, links = robot_scene(ARM, {**AT, "robot.pads": ["left_finger", "right_finger"]})
    stops = PadStops(scene, links)
    stops.limit_positions(np.array([0.0, 0.0, 0.0, 0.03]))
    stops.update(attrs.evolve(scene, contact=attrs.evolve(scene.contact, thickness=0.008)))
    # Within a hundredth of the step.
    assert stops.limit_positions(np.zeros(4))[3] == pytest.approx(0.7 * 0.008, abs=0.0003)
    stops.update(scene)
    assert stops.limit_positions(np.zeros(4))[3] == pytest.approx(0.7 * scene.contact.thickness, rel=0.05)


def test_joint_of_several_degrees_of_freedom_is_reported() -> None:
    text = ARM.replace('name="wrist" type="continuous"', 'name="wrist" type="floating"')
    _, links = robot_scene(text, AT)
    assert links.joint_names == ("shoulder", "elbow", "finger")
    assert links.notes == ("joint 'wrist' of the robot has several degrees of freedom: it stays at 0",)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"robot.orientation": [0.0, 0.0, 0.0, 0.0]}, "robot.orientation: orientation"),
        ({"robot.friction": [0.1, 0.2]}, "robot.friction is 0.1 at rest and 0.2 in motion"),
    ],
)
def test_invalid_robot_parameter_is_named(values: dict[str, Any], reason: str) -> None:
    with pytest.raises(ParameterError, match=reason):
        Scene.from_parameters(values)
