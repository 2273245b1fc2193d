# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""PyBullet's deformable cloth: springs of one stiffness along a triangulation's edges, and across them for bending."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np


class Engine:
    """See `runner`; one variant. It has no drag of the air."""

    distributions = ("pybullet",)

    def __init__(self, sheet: dict[str, Any], step: float, variant: str) -> None:
        import pybullet

        self._bullet = pybullet
        pybullet.connect(pybullet.DIRECT)
        pybullet.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD)
        pybullet.setGravity(*sheet["gravity"].tolist())
        pybullet.setTimeStep(step)
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in sheet["positions"].tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (1 + sheet["triangles"]).tolist()]
        with tempfile.TemporaryDirectory() as folder:
            mesh = Path(folder, "sheet.obj")
            mesh.write_text("\n".join(lines) + "\n")
            self._body = pybullet.loadSoftBody(
                str(mesh),
                mass=float(sheet["masses"].sum()),
                useMassSpring=1,
                useBendingSprings=1,
                springElasticStiffness=float(sheet["stiffness"][0]),
                springDampingStiffness=float(sheet["damping"][0]),
                springBendingStiffness=float(sheet["stiffness"][-1]),
                springDampingAllDirections=0,
                useNeoHookean=0,
                useSelfCollision=0,
                useFaceContact=0,
                collisionMargin=0.0,
            )
        for particle in np.flatnonzero(sheet["anchored"]).tolist():
            pybullet.createSoftBodyAnchor(self._body, particle, -1, -1)

    def advance(self, steps: int) -> None:
        """Take so many steps."""
        for _ in range(steps):
            self._bullet.stepSimulation()

    def positions(self) -> Any:
        """Positions [m]."""
        _, places = self._bullet.getMeshData(self._body, -1, flags=self._bullet.MESH_DATA_SIMULATION_MESH)
        return np.array(places)

    def remarks(self) -> list[str]:
        """Nothing to add."""
        return []
