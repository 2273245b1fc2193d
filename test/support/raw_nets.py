# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Springs files of chains, nets and hinges."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from cloth_sim_ros.physics.model.sheets.surface import Surface, grid_triangles
from cloth_sim_ros.scene.scene import Scene

#: Parameters of a free, flat cloth from the springs file `s.yaml`.
VALUES: dict[str, Any] = {
    "cloth.springs": "s.yaml",
    "cloth.anchors": [""],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "bending.model": "none",
    "grippers": [""],
}
BALL: dict[str, Any] = {
    "obstacles": ["ball"],
    "ball.shape": "sphere",
    "ball.size": [0.1],
    "ball.position": [0.0, 0.0, 0.0],
    "ball.friction": [0.5],
}


def chain_tables(count: int = 21, link: float = 0.05) -> dict[str, Any]:
    """Return the tables of a chain along x, centred on the origin, without triangles."""
    x = (np.arange(count) - 0.5 * (count - 1)) * link
    springs = [[i, i + 1] for i in range(count - 1)]
    positions = np.stack([x, 0.0 * x, 0.0 * x], axis=1).tolist()
    return {"positions": positions, "masses": 0.005, "springs": springs, "stiffness": 50.0, "k_d0": 0.3}


def net_tables(count: int = 9, width: float = 0.4) -> dict[str, Any]:
    """Return the tables of a square net of count x count particles with a spring on each edge of its triangles."""
    line = np.linspace(-0.5 * width, 0.5 * width, count)
    positions = [[x, y, 0.0] for y in line.tolist() for x in line.tolist()]
    surface = Surface.from_triangles(grid_triangles(count, count, "left"))
    tables = {"positions": positions, "masses": 0.002, "stiffness": 20.0, "k_d0": 0.2}
    return {**tables, "springs": surface.edges.tolist(), "triangles": surface.triangles.tolist()}


def two_nets(count: int, *, gap: float) -> dict[str, Any]:
    """Return the tables of two nets of count x count particles, the second a gap above the first [m]."""
    tables, n = net_tables(count), count * count
    upper = [[x + 0.01, y + 0.005, gap] for x, y, _ in tables["positions"]]
    moved = {name: tables[name] + (np.array(tables[name]) + n).tolist() for name in ("springs", "triangles")}
    return {**tables, **moved, "positions": tables["positions"] + upper}


def springs_scene(tables: dict[str, Any], **values: Any) -> Scene:
    """Return the scene of a springs file with these tables."""
    return Scene.from_parameters({**VALUES, **values}, files={"s.yaml": json.dumps(tables).encode()})
