# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robot description (URDF): links, joints, collision shapes, and refusals that name the fault."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from support.robots import ARM, chain

from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.robot.description import parse
from cloth_sim_ros.scene.robot.kinematics import Kinematics

LINKS = '<link name="a"/><link name="b"/>'
MESH = '<collision><geometry><mesh filename="m.stl" scale="1 0 1"/></geometry></collision>'
ENDS = '<parent link="a"/><child link="b"/>'


def robot(inner: str) -> str:
    return f'<robot name="r">{inner}</robot>'


def test_arm_has_its_links_joints_and_shapes() -> None:
    arm = parse(ARM)
    assert arm.root == "base"
    assert [joint.name for joint in arm.joints if joint.mimic is None] == ["shoulder", "elbow", "wrist", "finger"]
    mimic = arm.joints[-1].mimic
    assert mimic is not None
    assert (mimic.joint, mimic.multiplier, mimic.offset) == ("finger", 1.0, 0.0)
    assert [(shape.shape, shape.size) for shape in arm.shapes["forearm"]] == [("cylinder", (0.03, 0.28))]
    assert (arm.joints[0].lower, arm.joints[0].upper) == (-2.0, 2.0)


def test_origin_rotates_by_roll_then_pitch_then_yaw() -> None:
    origin = '<origin xyz="1 2 3" rpy="0.3 -0.4 0.5"/>'
    arm = parse(robot(f'{LINKS}<joint name="j" type="fixed">{ENDS}{origin}</joint>'))
    roll, pitch, yaw = 0.3, -0.4, 0.5
    rx = [[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]]
    ry = [[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]]
    rz = [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
    expected = np.array(rz) @ np.array(ry) @ np.array(rx)
    assert np.abs(arm.joints[0].origin[:3, :3] - expected).max() < 1e-15
    assert arm.joints[0].origin[:3, 3].tolist() == [1.0, 2.0, 3.0]


def test_description_without_inertia_and_visuals_is_read() -> None:
    assert len(parse(chain(3, 2)).shapes["l1"]) == 2


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<robot", "is no XML.*run xacro"),
        ("<sdf/>", "begins with <sdf>; a URDF begins with <robot>"),
        (
            '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/><link name="a"/></robot>',
            "xacro macros; run xacro",
        ),
        (robot(""), "0 links without a parent"),
        (robot(LINKS), r"2 links without a parent \(a, b\)"),
        (robot('<link name="a"/><link name="a"/>'), "two links 'a'"),
        (robot("<link/>"), "a link of the robot has no name"),
        (robot(f'{LINKS}<joint name="j" type="bend">{ENDS}</joint>'), "joint 'j' of the robot has type 'bend'"),
        (robot(f'{LINKS}<joint name="j" type="fixed"><child link="b"/></joint>'), "<parent> of joint 'j'"),
        (
            robot('<link name="a"/><joint name="j" type="fixed"><parent link="a"/><child link="z"/></joint>'),
            "names the link 'z', which does not exist",
        ),
        (
            robot(f'{LINKS}<joint name="j" type="revolute">{ENDS}<axis xyz="0 0 0"/></joint>'),
            r"has the axis \[0.0, 0.0, 0.0\]",
        ),
        (
            robot(f'{LINKS}<joint name="j" type="revolute">{ENDS}<mimic joint="k"/></joint>'),
            "joint 'j' mimics 'k', which is no joint",
        ),
        (
            robot(f'{LINKS}<joint name="j" type="revolute">{ENDS}<mimic joint="j"/></joint>'),
            "joint 'j' mimics itself",
        ),
        (
            robot('<link name="a"><collision><origin xyz="0 nan 0"/></collision></link>'),
            "has xyz '0 nan 0'; give 3 finite numbers",
        ),
        (
            robot('<link name="a"><collision><geometry><sphere radius="-1"/></geometry></collision></link>'),
            "a collision of link 'a' is a sphere whose radius is -1 m",
        ),
        (robot('<link name="a"><collision><geometry/></collision></link>'), "has no geometry that is known"),
        (
            robot(f'<link name="a">{MESH}</link>'),
            "no entry may be 0",
        ),
    ],
)
def test_description_with_a_fault_is_refused_by_name(text: str, reason: str) -> None:
    with pytest.raises(ParameterError, match=reason):
        parse(text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa">'
            + "".join(f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(9))
            + ']><robot name="r"><link name="&j;"/></robot>',
            "is no XML",
        ),
        (
            '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/hostname">]><robot><link name="a">&x;</link></robot>',
            "is no XML",
        ),
        ('<robot name="\xe9">'.encode("latin-1"), "is no XML"),
        (b'<?xml version="1.0" encoding="no-such"?><robot name="r"/>', "is no XML: unknown encoding"),
        (robot(f'{LINKS}<joint name="j" type="fixed">{ENDS}<origin xyz="1e300 0 0"/></joint>'), "of at most 10000"),
        (
            robot('<link name="a"><collision><geometry><sphere radius="1e300"/></geometry></collision></link>'),
            "has radius '1e300'; give 1 finite numbers of at most 10000",
        ),
        (
            robot(f'{LINKS}<joint name="j" type="revolute">{ENDS}<limit lower="2" upper="1"/></joint>'),
            "joint 'j' of the robot has the limits 2 to 1; exchange them",
        ),
    ],
)
def test_hostile_description_is_refused(text: str | bytes, reason: str) -> None:
    with pytest.raises(ParameterError, match=reason):
        parse(text)


def test_chain_of_mimic_joints_is_read_in_linear_time() -> None:
    # The square of this number would take a minute.
    links = "".join(f'<link name="l{k}"/>' for k in range(20001))
    joints = "".join(
        f'<joint name="j{k}" type="continuous"><parent link="l{k}"/><child link="l{k + 1}"/>'
        + (f'<mimic joint="j{k - 1}"/></joint>' if k else "</joint>")
        for k in range(20000)
    )
    start = time.process_time()
    assert Kinematics(parse(robot(links + joints))).joint_names == ("j0",)
    assert time.process_time() - start < 20.0


def test_time_to_read_grows_with_the_number_of_links() -> None:
    # The square of this number would take minutes.
    links = "".join(f'<link name="l{k}"/>' for k in range(20001))
    joints = "".join(
        f'<joint name="j{k}" type="fixed"><parent link="l{k}"/><child link="l{k + 1}"/></joint>' for k in range(20000)
    )
    start = time.process_time()
    assert parse(robot(links + joints)).joints[-1].child == "l20000"
    assert time.process_time() - start < 20.0


def test_circle_of_links_is_refused() -> None:
    links = '<link name="root"/><link name="a"/><link name="b"/>'
    joints = "".join(
        f'<joint name="{parent}{child}" type="fixed"><parent link="{parent}"/><child link="{child}"/></joint>'
        for parent, child in (("a", "b"), ("b", "a"))
    )
    with pytest.raises(ParameterError, match="is part of a circle of links"):
        parse(robot(links + joints))
