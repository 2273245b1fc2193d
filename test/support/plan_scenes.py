# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes of every kind of sheet, for tests of plans."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from scipy.spatial import Delaunay

from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.simulation.simulation import Simulation


def sheet_of_triangles(count: int = 400, seed: int = 0) -> bytes:
    """A wavefront file of an irregular sheet whose vertices come in random order."""
    rng = np.random.default_rng(seed)
    n_columns = round(count**0.5)
    plane = np.stack(np.meshgrid(np.arange(n_columns), np.arange(n_columns)), axis=-1).reshape(-1, 2) / (
        n_columns - 1.0
    )
    inner = ((plane > 0.0) & (plane < 1.0)).all(axis=1)
    plane[inner] += rng.uniform(-0.2, 0.2, (int(inner.sum()), 2)) / n_columns
    plane = plane[rng.permutation(len(plane))]
    vertices = [f"v {x:.6f} {y:.6f} 0" for x, y in plane]
    faces = ["f " + " ".join(str(i + 1) for i in triangle) for triangle in Delaunay(plane).simplices]
    return "\n".join(vertices + faces).encode()


def tangle(count: int = 300, seed: int = 1) -> bytes:
    """A springs file with joints, damped and undamped springs, and a particle that many hang on."""
    rng = np.random.default_rng(seed)
    pairs = {tuple(sorted(pair)) for pair in rng.integers(0, count, (900, 2)).tolist() if pair[0] != pair[1]}
    pairs |= {(0, i) for i in range(1, 60)}
    chosen = np.array(sorted(pairs))[rng.permutation(len(pairs))]
    n_springs = len(chosen)
    rest_lengths = rng.uniform(0.1, 1.0, n_springs)
    rest_lengths[::7] = 0.0
    damping = np.where(np.arange(n_springs) % 3 == 0, 0.0, 0.02)
    tables = {
        "positions": rng.uniform(-1, 1, (count, 3)).tolist(),
        "masses": rng.uniform(0.1, 0.4, count).tolist(),
        "springs": chosen.tolist(),
        "rest_lengths": rest_lengths.tolist(),
        "stiffness": 5.0,
        "k_d": damping.tolist(),
    }
    return json.dumps(tables).encode()


MESH, TANGLE = sheet_of_triangles(), tangle()
FILES = {"sheet.obj": MESH, "springs.yaml": TANGLE}
SHEET: dict[str, Any] = {
    "cloth.mesh": "sheet.obj",
    "material.stretch_modulus": 100.0,
    "cloth.anchors": ["3", "77"],
    "bending.model": "none",
    "wind.normal_drag": 0.0,
}
_BENDING = {"cloth.resolution": [7, 9], "material.bending_modulus": 1e-4}
_AIR = {"wind.velocity": [1.0, 2.0, -0.5], "wind.normal_drag": 0.3, "wind.tangential_drag": 0.1}
SCENES: dict[str, dict[str, Any]] = {
    "default": {},
    "bare": {
        "gravity": [0.0, 0.0, 0.0],
        "air.drag": 0.0,
        "wind.normal_drag": 0.0,
        "bending.model": "none",
        "material.shear_modulus": 0.0,
        "material.damping": 0.0,
    },
    "left": {"cloth.shear_layout": "left", "cloth.anchors": ["top_left", "40"]},
    "right, undamped": {
        "cloth.shear_layout": "right",
        "material.damping": 0.0,
        "air.drag": 0.0,
        "wind.normal_drag": 0.0,
    },
    "alternating, free": {"cloth.shear_layout": "alternating", "cloth.anchors": [""], "wind.normal_drag": 0.0},
    "viscous": {"material.viscosity": 0.05, "wind.normal_drag": 0.0},
    "hinges": {"bending.model": "crossed", "material.bending_modulus": 1e-4},
    "narrow": {"cloth.resolution": [3, 17], "cloth.size": [0.2, 1.1], "material.shear_modulus": 10.0},
    "two wide": {"cloth.resolution": [11, 2], "cloth.size": [1.0, 0.1]},
    "grid, air": {"material.damping": 0.0, "air.drag": 0.0, "wind.normal_drag": 0.3},
    "grid, wind and air": _AIR,
    "grid, opposite": {"bending.model": "opposite"},
    "grid, altitude, undamped": {**_BENDING, "bending.model": "altitude", "material.damping": 0.0},
    "mesh": SHEET,
    "mesh, bare": {**SHEET, "gravity": [0.0] * 3, "air.drag": 0.0, "material.damping": 0.0, "cloth.anchors": [""]},
    "mesh, undamped in air": {**SHEET, "material.damping": 0.0},
    "mesh, viscous": {**SHEET, "material.viscosity": 0.05, "air.drag": 0.0},
    "mesh, wind": {**SHEET, "wind.velocity": [1.0, 2.0, -0.5]},
    "mesh, air": {**SHEET, **_AIR},
    "mesh, crossed": {**SHEET, "bending.model": "crossed", "material.bending_modulus": 1e-8},
    "springs": {"cloth.springs": "springs.yaml", "cloth.anchors": ["5"], "bending.model": "none"},
}


def listed(model: Model) -> Model:
    """Return the model with each spring of a sheet separate."""
    forces = [force.pair_springs if isinstance(force, GridSprings) else force for force in model.forces]
    return Model(model.masses, forces, anchors=model.anchors)


def stir(simulation: Simulation, seed: int = 3) -> None:
    """Set a crumpled, moving start."""
    rng = np.random.default_rng(seed)
    free = simulation.model.inverse_masses > 0
    simulation.state.x[:, free] += 0.003 * rng.standard_normal((3, int(free.sum())))
    simulation.state.v[:, free] += 0.1 * rng.standard_normal((3, int(free.sum())))
