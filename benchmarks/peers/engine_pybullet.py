# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine PyBullet: springs of one stiffness on the edges of a triangulation, and bending springs."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

#: Largest stiffness of its explicit springs, as a share of mass over squared step.
_STABLE_SHARE = 0.2
#: Half the distance between the pads' faces at which joint limits stop them [thicknesses].
_STOP = 0.2
#: Mass [kg] and damping [N s/m] of each pad; mass of the body that carries an edge [kg].
_PAD_MASS, _PAD_DAMPING, _CARRIER = 0.05, 10.0, 100.0


class PyBulletEngine:
    """See `runner`; one variant. It has no drag of the air."""

    distributions = ("pybullet",)

    def __init__(self, sheet: dict[str, Any], step: float, variant: str) -> None:
        self._start_world(sheet, step)
        self._load(
            sheet,
            springElasticStiffness=float(sheet["stiffness"][0]),
            springDampingStiffness=float(sheet["damping"][0]),
            springBendingStiffness=float(sheet["stiffness"][-1]),
            useSelfCollision=0,
            useFaceContact=0,
            collisionMargin=0.0,
        )

    def _start_world(self, sheet: dict[str, Any], step: float) -> None:
        import pybullet

        self._bullet = pybullet
        pybullet.connect(pybullet.DIRECT)
        pybullet.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD)
        pybullet.setGravity(*sheet["gravity"].tolist())
        pybullet.setTimeStep(step)

    def _load(self, sheet: dict[str, Any], **options: Any) -> None:
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in sheet["positions"].tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (1 + sheet["triangles"]).tolist()]
        options |= {"useMassSpring": 1, "useBendingSprings": 1, "springDampingAllDirections": 0, "useNeoHookean": 0}
        with tempfile.TemporaryDirectory() as folder:
            mesh = Path(folder, "sheet.obj")
            mesh.write_text("\n".join(lines) + "\n")
            self._body = self._bullet.loadSoftBody(str(mesh), mass=float(sheet["masses"].sum()), **options)
        for particle in np.flatnonzero(sheet["anchored"]).tolist():
            self._bullet.createSoftBodyAnchor(self._body, particle, -1, -1)

    def advance(self, steps: int) -> None:
        """Take some steps."""
        for _ in range(steps):
            self._bullet.stepSimulation()

    def positions(self) -> Any:
        """Positions [m], (n, 3)."""
        _, places = self._bullet.getMeshData(self._body, -1, flags=self._bullet.MESH_DATA_SIMULATION_MESH)
        return np.array(places)


class PyBulletContactEngine(PyBulletEngine):
    """Scenes with contact; one variant."""

    def __init__(self, sheet: dict[str, Any], step: float, variant: str) -> None:
        self._start_world(sheet, step)
        self._step, self._gravity = step, sheet["gravity"]
        self._bullet.setPhysicsEngineParameter(sparseSdfVoxelSize=0.25)
        self._joints: int | None = None
        self._pads = np.zeros((0, 3))
        self._add_solids(sheet)
        mass = float(sheet["masses"].sum()) / len(sheet["masses"])
        #: Stiffness of the springs [N/m].
        self._stiffness = min(float(sheet["modulus"]), _STABLE_SHARE * mass / step**2)
        self._load(
            sheet,
            springElasticStiffness=self._stiffness,
            springDampingStiffness=float(sheet["retardation"] * sheet["modulus"]),
            springBendingStiffness=0.01 * self._stiffness,
            useSelfCollision=int(sheet["own"]),
            useFaceContact=1,
            # The friction of the other body is a factor; it is 1 here.
            frictionCoeff=float(sheet["friction"]),
            collisionMargin=float(sheet["thickness"]),
        )
        self._path: Any = iter(())
        self._carrier = -1
        self._anchors: list[int] = []
        if len(sheet["held"]):
            self._carry(sheet)

    def _add_solids(self, sheet: dict[str, Any]) -> None:
        """Add obstacles."""
        bullet = self._bullet
        if sheet["kind"] == "pinch":
            half = (0.5 * sheet["pad_size"]).tolist()
            shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half)
            still, unturned = [[0.0, 0.0, 0.0]] * 2, [[0.0, 0.0, 0.0, 1.0]] * 2
            self._joints = bullet.createMultiBody(
                baseMass=0.0,
                linkMasses=[_PAD_MASS] * 2,
                linkCollisionShapeIndices=[shape] * 2,
                linkVisualShapeIndices=[-1] * 2,
                linkPositions=sheet["pad_places"].tolist(),
                linkOrientations=unturned,
                linkInertialFramePositions=still,
                linkInertialFrameOrientations=unturned,
                linkParentIndices=[0, 0],
                linkJointTypes=[bullet.JOINT_PRISMATIC] * 2,
                linkJointAxis=[[0.0, 1.0, 0.0]] * 2,
            )
            self._forces = (-np.sign(sheet["pad_places"][:, 1]) * float(sheet["force"])).tolist()
            apart = float(np.abs(sheet["pad_places"][0, 1])) - half[1]
            travel = apart - _STOP * float(sheet["thickness"])
            for link in range(2):
                bullet.setJointMotorControl2(self._joints, link, bullet.VELOCITY_CONTROL, force=0.0)
                bullet.changeDynamics(self._joints, link, lateralFriction=1.0, jointDamping=_PAD_DAMPING)
                bullet.changeDynamics(self._joints, link, jointLowerLimit=-travel, jointUpperLimit=travel)
            return
        if sheet["kind"] == "drape":
            shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=float(sheet["radius"]))
            solid = bullet.createMultiBody(0.0, shape)
        else:
            # A box, because distances to a plane are to the middle of a cell.
            shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[0.5, 0.5, 0.1])
            solid = bullet.createMultiBody(0.0, shape, basePosition=[0.0, 0.0, -0.1])
        bullet.changeDynamics(solid, -1, lateralFriction=1.0)

    def _carry(self, sheet: dict[str, Any]) -> None:
        """Tie held particles to a heavy body without contact."""
        places = sheet["positions"][sheet["held"]]
        self._start = places.mean(axis=0)
        self._carrier = self._bullet.createMultiBody(_CARRIER, basePosition=self._start.tolist())
        for particle, position in zip(sheet["held"].tolist(), places, strict=True):
            offset = (position - self._start).tolist()
            self._anchors.append(self._bullet.createSoftBodyAnchor(self._body, particle, self._carrier, -1, offset))

    def lead(self, begin: Any, end: Any, steps: int) -> None:
        """Move held particles by a common displacement in the next steps."""
        first, last = begin.mean(axis=0), end.mean(axis=0)
        self._path = iter([first + (k + 1) / steps * (last - first) for k in range(steps)])

    def let_go(self) -> None:
        """Release the held particles."""
        for anchor in self._anchors:
            self._bullet.removeConstraint(anchor)

    def advance(self, steps: int) -> None:
        """Take some steps."""
        bullet = self._bullet
        for _ in range(steps):
            target = next(self._path, None)
            if target is not None:
                now, _ = bullet.getBasePositionAndOrientation(self._carrier)
                speed = (target - np.array(now)) / self._step - self._gravity * self._step
                bullet.resetBaseVelocity(self._carrier, speed.tolist(), [0.0, 0.0, 0.0])
            if self._joints is not None:
                for link, force in enumerate(self._forces):
                    bullet.setJointMotorControl2(self._joints, link, bullet.TORQUE_CONTROL, force=force)
            bullet.stepSimulation()

    def pads(self) -> Any:
        """Positions of the pads [m], (pads, 3)."""
        if self._joints is None:
            return np.zeros((0, 3))
        return np.array([self._bullet.getLinkState(self._joints, link)[0] for link in range(2)])

    def remarks(self) -> list[str]:
        """Return the stiffness of its springs."""
        return [f"has springs of {self._stiffness:.3g} N/m, the stiffest that its step bears"]
