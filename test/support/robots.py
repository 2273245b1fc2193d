# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robots of tests, benchmarks and the soak: descriptions (URDF) and scenes with their links."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from cloth_sim_ros.scene.robot.links import RobotLinks, add_links, without_links
from cloth_sim_ros.scene.scene import Scene

_CONFIG = Path(__file__).resolve().parents[2] / "config"
#: An arm of three joints with two fingers, one of which mimics the other.
ARM = (_CONFIG / "arm.urdf").read_text()
#: Its joints.
ARM_JOINTS = ("shoulder", "elbow", "wrist", "finger")


def shell(radius: float, length: float, n_around: int, n_along: int) -> bytes:
    """Return a closed shell with a waist along z as an OBJ file, with 2 n_around n_along triangles."""
    points, faces = [(0.0, 0.0, -0.5 * length), (0.0, 0.0, 0.5 * length)], list[tuple[int, int, int]]()
    for row in range(n_along):
        angle = (row + 0.5) * math.pi / n_along
        z = -0.5 * length * math.cos(angle)
        r = radius * math.sqrt(math.sin(angle)) * (1.0 - 0.25 * math.exp(-((5.0 * z / length) ** 2)))
        for k in range(n_around):
            turn, at, after = (
                2.0 * math.pi * k / n_around,
                2 + row * n_around + k,
                2 + row * n_around + (k + 1) % n_around,
            )
            points.append((r * math.cos(turn), r * math.sin(turn), z))
            faces += (
                [(0, after, at)] if row == 0 else [(at - n_around, after - n_around, after), (at - n_around, after, at)]
            )
            faces += [(1, at, after)] if row == n_along - 1 else []
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    return "\n".join(lines).encode()


def chain(n_joints: int, shapes_per_link: int, *, length: float = 0.1, mesh: str = "") -> str:
    """Return the description of a chain of links, each with capsules along it, or with a mesh in its middle."""
    capsule = '<collision><origin xyz="0 0 {z}"/><geometry><capsule radius="{r}" length="{l}"/></geometry></collision>'
    piece = length / shapes_per_link
    shapes = "".join(capsule.format(z=(k + 0.5) * piece, r=0.3 * piece, l=0.5 * piece) for k in range(shapes_per_link))
    if mesh:
        origin, geometry = f'<origin xyz="0 0 {0.5 * length}"/>', f'<mesh filename="{mesh}"/>'
        shapes = f"<collision>{origin}<geometry>{geometry}</geometry></collision>"
    links = "".join(f'<link name="l{k}">{shapes if k else ""}</link>' for k in range(n_joints + 1))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="0 0 {length if k else 0}"/><axis xyz="{k % 2} {1 - k % 2} 0"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="2"/></joint>'
        for k in range(n_joints)
    )
    return f'<robot name="chain">{links}{joints}</robot>'


def with_links(
    values: dict[str, Any],
    description: str,
    *,
    folder: str | Path = ".",
    files: dict[str, bytes] | None = None,
) -> tuple[dict[str, Any], dict[str, bytes], RobotLinks]:
    """Return what `add_links` returns for the scene of values."""
    scene = Scene.from_parameters(without_links(values), files=files)
    return add_links(scene, values, description, folder=folder)


def robot_scene(description: str, values: dict[str, Any], *, folder: str | Path = ".") -> tuple[Scene, RobotLinks]:
    """Return a scene with the links of a description, and the links; `folder` has the meshes."""
    extended, files, links = with_links({"robot.enabled": True, **values}, description, folder=folder)
    return Scene.from_parameters(extended, files=files), links
