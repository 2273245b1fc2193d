# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robots of tests, benchmarks and the soak: descriptions (URDF) and scenes with their links."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cloth_sim_ros.scene.robot.links import RobotLinks, add_links
from cloth_sim_ros.scene.scene import Scene

_CONFIG = Path(__file__).resolve().parents[2] / "config"
#: An arm of three joints with two fingers, one of which mimics the other.
ARM = (_CONFIG / "arm.urdf").read_text()
#: Its joints.
ARM_JOINTS = ("shoulder", "elbow", "wrist", "finger")


def chain(n_joints: int, shapes_per_link: int, *, length: float = 0.1) -> str:
    """Return the description of a chain of links, each with capsules along it."""
    capsule = '<collision><origin xyz="0 0 {z}"/><geometry><capsule radius="{r}" length="{l}"/></geometry></collision>'
    piece = length / shapes_per_link
    shapes = "".join(capsule.format(z=(k + 0.5) * piece, r=0.3 * piece, l=0.5 * piece) for k in range(shapes_per_link))
    links = "".join(f'<link name="l{k}">{shapes if k else ""}</link>' for k in range(n_joints + 1))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="0 0 {length if k else 0}"/><axis xyz="{k % 2} {1 - k % 2} 0"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="2"/></joint>'
        for k in range(n_joints)
    )
    return f'<robot name="chain">{links}{joints}</robot>'


def robot_scene(description: str, values: dict[str, Any]) -> tuple[Scene, RobotLinks]:
    """Return a scene with the links of a description, and the links."""
    extended, files, links = add_links({"robot.enabled": True, **values}, description)
    return Scene.from_parameters(extended, files=files), links
