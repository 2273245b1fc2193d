# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A cloth from a triangle mesh: a round table cloth, fixed in the middle.

`python mesh_cloth.py [mesh.obj]` reads an OBJ, PLY or STL file in metres; without one it makes a disc.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import Delaunay

from cloth_sim_ros import Scene, Simulation


def disc(path: Path, *, radius: float = 0.5, rings: int = 12) -> Path:
    """Write a disc of nearly equilateral triangles in the x-y plane; its first vertex is the centre."""
    radii = np.repeat(np.arange(rings + 1), [1, *(6 * np.arange(1, rings + 1))]) * radius / rings
    angles = np.concatenate([[0.0], *(np.arange(6 * k) * np.pi / (3 * k) for k in range(1, rings + 1))])
    points = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    flat = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    trimesh.Trimesh(flat, Delaunay(points).simplices, process=False).export(path)
    return path


def main() -> None:
    """Let the cloth fall for a second and print how far its edge hangs."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else disc(Path("table_cloth.obj"))
    scene = Scene.from_parameters(
        {
            "cloth.mesh": str(path),
            "cloth.orientation": [0.0, 0.0, 0.0, 1.0],  # as in the file: flat, z up
            "cloth.anchors": [str(k) for k in range(7)],  # vertices: the centre and the first ring
            "material.density": 0.15,  # kg/m^2
            "material.bending_modulus": 1e-5,  # N m
            "bending.model": "altitude",
        }
    )
    simulation = Simulation(scene)
    for _ in range(60):
        frame = simulation.advance()
    drop = simulation.positions[:, 2].max() - simulation.positions[:, 2].min()
    print(
        f"{len(simulation.positions)} particles; after {frame.time:.2f} s the edge hangs {drop:.3f} m below the centre"
    )
    print(
        f"Poisson's ratio {scene.poisson_ratio:.3f}; {frame.integrator}, {frame.advance.steps} steps in the last frame"
    )


if __name__ == "__main__":
    main()
