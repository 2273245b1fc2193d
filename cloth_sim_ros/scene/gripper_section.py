# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of grippers: grasp mode, limits and pads."""

from __future__ import annotations

import attrs

from cloth_sim_ros.physics.contact.obstacle_shapes import MAX_SIZE
from cloth_sim_ros.scene.limits import FRAME, FRICTION, QUATERNION
from cloth_sim_ros.scene.parameters.declare import parameter

#: Default speed limit of a gripper, the limit of obstacles [m/s]: robots move at 2 to 3 m/s, fast parallel ones at 10.
MAX_SPEED = 10.0
#: Grasp modes of a gripper.
MODES = ATTACH, PINCH = ("attach", "pinch")
#: Types of the action of a gripper, as controllers of MoveIt name them.
ACTIONS = NO_ACTION, GRIPPER_COMMAND, PARALLEL_GRIPPER_COMMAND = ("none", "GripperCommand", "ParallelGripperCommand")
#: Models of the grip of an attached particle.
GRIP_MODELS = SPRING, PRESCRIBED = ("spring", "prescribed")


@attrs.frozen(kw_only=True)
class GripperParameters:
    """Parameters `gripper.*`, which all grippers share unless a single gripper overrides them, e.g. `left.frame`."""

    mode: str = parameter(
        "string",
        "attach",
        "Grasp mode: attach binds particles to the gripper; pinch closes two pads that hold the cloth by friction. "
        "<gripper>.mode overrides it for one gripper",
        choices=MODES,
    )
    model: str = parameter(
        "string",
        "spring",
        "Model of the grip in mode attach: spring ties each particle by a zero-length spring; prescribed makes each "
        "particle follow its point of the gripper exactly, which sets no step. <gripper>.model overrides it for one "
        "gripper",
        choices=GRIP_MODELS,
    )
    radius: float = parameter(
        "double",
        0.05,
        "Distance within which a closing gripper grasps particles",
        unit="m",
        min=0.0,
        max=100.0,
        live=True,
        observes=True,
    )
    stiffness: float = parameter(
        "double",
        1000.0,
        "In model spring: stiffness of the zero-length spring that holds a grasped particle; in proportion to mass at "
        "borders",
        unit="N/m",
        min=0.0,
        max=1e8,
        excludes_min=True,
        live=True,
    )
    damping: float = parameter(
        "double",
        0.5,
        "Dimensionless damping of that spring; 2 is critical for a free particle",
        min=0.0,
        max=10.0,
        live=True,
    )
    timeout: float = parameter(
        "double",
        0.0,
        "Time without a target after which a closed gripper opens; 0: never, it keeps its last target",
        unit="s",
        min=0.0,
        max=1e6,
        live=True,
        observes=True,
    )
    frame: str = parameter(
        "string",
        "",
        "TF frame that a gripper follows; {gripper} stands for the gripper's name; empty: none. Needs tf2_ros. "
        "<gripper>.frame overrides it for one gripper",
        constraint=FRAME,
    )
    max_speed: float = parameter(
        "double",
        MAX_SPEED,
        "Speed limit of a gripper's grasped particles, mean over a frame; 0: no limit, except "
        f"{MAX_SPEED:g} m/s for pads. <gripper>.max_speed overrides it for one gripper",
        unit="m/s",
        min=0.0,
        max=1e6,
        live=True,
        observes=True,
    )
    pad_size: tuple[float, ...] = parameter(
        "double[]",
        (0.06, 0.02, 0.06),
        "In mode pinch: edge lengths of each pad along the gripper's axes; pads close along y. Pads hold particles "
        "only: pads smaller than a cell of the cloth may miss it",
        unit="m",
        length=3,
        min=0.0,
        max=MAX_SIZE,
        excludes_min=True,
    )
    opening: float = parameter(
        "double",
        0.06,
        "In mode pinch: distance between the faces of the open pads",
        unit="m",
        min=0.0,
        max=MAX_SIZE,
        excludes_min=True,
        live=True,
    )
    force: float = parameter(
        "double",
        5.0,
        "In mode pinch: force of each pad at rest; cloth of weight G slips out if it is below G / (2 friction)",
        unit="N",
        min=0.0,
        max=1e4,
        excludes_min=True,
        live=True,
    )
    speed: float = parameter(
        "double", 0.05, "In mode pinch: speed of each pad without contact", unit="m/s", min=1e-4, max=10.0, live=True
    )
    friction: tuple[float, ...] = parameter(
        "double[]",
        (0.6, 0.5),
        "In mode pinch: coefficients of friction between pads and cloth, as those of an obstacle",
        min=0.0,
        max=1e3,
        constraint=FRICTION,
        live=True,
    )
    action: str = parameter(
        "string",
        NO_ACTION,
        "Type of the action server ~/<gripper>/gripper_cmd, of control_msgs. <gripper>.action overrides it for one "
        "gripper",
        choices=ACTIONS,
    )
    joint_range: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0),
        "Positions of the robot's joint with the gripper closed and open, as goals of the action have them; equal: the "
        "distance between the pads, from 0 to gripper.opening. <gripper>.joint_range overrides it for one gripper",
        unit="rad or m",
        length=2,
        min=-1e3,
        max=1e3,
    )
    allow_stalling: bool = parameter(
        "bool",
        True,
        "Whether a goal of the action succeeds if cloth stops the pads before their position; otherwise it is aborted",
        live=True,
        observes=True,
    )
    twist_max_speed: float = parameter(
        "double",
        0.0,
        "Speed limit of velocities on ~/<gripper>/twist; faster ones are shortened; 0: there is no such topic",
        unit="m/s",
        min=0.0,
        max=MAX_SPEED,
    )
    twist_max_rate: float = parameter(
        "double",
        2.0,
        "Limit of angular velocities on ~/<gripper>/twist",
        unit="rad/s",
        min=0.0,
        max=100.0,
        live=True,
        observes=True,
    )
    twist_timeout: float = parameter(
        "double",
        0.1,
        "Time without a velocity on ~/<gripper>/twist after which a gripper stops",
        unit="s",
        min=1e-3,
        max=10.0,
        live=True,
        observes=True,
    )
    sensor_frame: str = parameter(
        "string",
        "",
        "Name of the frame of a force-torque sensor on the gripper, whose wrench ~/<gripper>/ft_sensor_wrench has; "
        "{gripper} stands for the gripper's name; empty: there is no such topic",
        constraint=FRAME,
    )
    sensor_position: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0, 0.0),
        "Position of that sensor in the gripper's frame",
        unit="m",
        length=3,
        min=-10.0,
        max=10.0,
    )
    sensor_orientation: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0, 0.0, 1.0),
        "Orientation of that sensor in the gripper's frame, a quaternion x, y, z, w",
        length=4,
        constraint=QUATERNION,
    )
