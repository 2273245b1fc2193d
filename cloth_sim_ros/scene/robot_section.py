# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of a robot whose links are obstacles."""

from __future__ import annotations

import attrs

from cloth_sim_ros.scene.limits import FRAME, FRICTION, QUATERNION
from cloth_sim_ros.scene.parameters.declare import parameter

#: Sources of the poses of links.
SOURCES = JOINT_STATES, TF = ("joint_states", "tf")


@attrs.frozen(kw_only=True)
class RobotParameters:
    """Parameters `robot.*`: links of a robot as obstacles, from its description (URDF) and its joint states."""

    enabled: bool = parameter(
        "bool", False, "Make the collision geometry of a robot's links obstacles, which follow its joint states"
    )
    description_topic: str = parameter(
        "string", "/robot_description", "Topic of the robot's description (URDF), std_msgs/String, transient local"
    )
    description_file: str = parameter(
        "string", "", "File of the robot's description (URDF), instead of description_topic"
    )
    source: str = parameter(
        "string",
        JOINT_STATES,
        "Source of the links' poses: joint_states: the topic joint_states_topic and forward kinematics; tf: the TF "
        "frames of the links' names, which need tf2_ros",
        choices=SOURCES,
    )
    joint_states_topic: str = parameter(
        "string", "/joint_states", "Topic of the positions of joints, sensor_msgs/JointState"
    )
    frame: str = parameter(
        "string",
        "",
        "TF frame of the robot's root link, or of what it is mounted on; empty: frame_id. Needs tf2_ros",
        constraint=FRAME,
    )
    position: tuple[float, ...] = parameter(
        "double[]", (0.0, 0.0, 0.0), "Position of the root link in that frame", unit="m", length=3, min=-1e4, max=1e4
    )
    orientation: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0, 0.0, 1.0),
        "Orientation of the root link in that frame, a quaternion x, y, z, w",
        length=4,
        constraint=QUATERNION,
    )
    links: tuple[str, ...] = parameter(
        "string[]", ("",), "Names of the links that become obstacles; ['']: all that can come within reach of the cloth"
    )
    pads: tuple[str, ...] = parameter(
        "string[]",
        ("",),
        "Names of links that are fingers: obstacles with gripper.friction, whose joints stop before the fingers press "
        "the cloth without room; none by ['']",
    )
    pad_gap: float = parameter(
        "double",
        1.4,
        "Distance between closed fingers of one hand at which their joints stop, in units of contact.thickness. A "
        "shorter one holds the cloth more firmly, and needs shorter steps",
        min=1.0,
        max=1.9,
    )
    friction: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0),
        "Coefficients of friction between the other links and the cloth, as those of an obstacle",
        min=0.0,
        max=1e3,
        constraint=FRICTION,
    )
