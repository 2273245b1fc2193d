# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The scene: frozen, checked configuration, and the physics that is built from it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros import parameter_file, parameters
from cloth_sim_ros.parameters import ParameterError, parameter, section
from cloth_sim_ros.physics.bending_calibration import bending_terms, grid_hinge_constants, refuse_bending_modulus
from cloth_sim_ros.physics.grid_sheet import GridSheet
from cloth_sim_ros.physics.gripper_path import normalised, rotation_matrix
from cloth_sim_ros.physics.integrators.base import Integrator
from cloth_sim_ros.physics.integrators.leapfrog import Leapfrog
from cloth_sim_ros.physics.material import Threads, grid_threads
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.physics.surface import Surface
from cloth_sim_ros.physics.terms.base import Array, Term
from cloth_sim_ros.physics.terms.drag import Drag
from cloth_sim_ros.physics.terms.gravity import Gravity
from cloth_sim_ros.physics.terms.grips import Grips
from cloth_sim_ros.physics.terms.pair_springs import PairSprings
from cloth_sim_ros.scene_sections import Air, Bending, Cloth, Gripper, Material, Record

MOST_PARTICLES = 4_000_000
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@attrs.frozen(kw_only=True)
class Scene:
    """A cloth, what acts on it, and how it is stepped.

    Raises:
        ParameterError: for a value, or a combination of values, that makes no scene.
    """

    rate: float = parameter(
        "double", 60.0, "Published frames in a second of simulated time", unit="Hz", least=0.1, most=10000.0
    )
    frame_id: str = parameter("string", "world", "Coordinate frame of the cloth and of commands")
    cloth: Cloth = section(Cloth)
    material: Material = section(Material)
    bending: Bending = section(Bending)
    gravity: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0, -9.81),
        "Gravitational acceleration",
        unit="m/s^2",
        length=3,
        least=-1e4,
        most=1e4,
        live=True,
    )
    air: Air = section(Air)
    grippers: tuple[str, ...] = parameter("string[]", ("gripper",), "Names of the grippers; none by ['']")
    gripper: Gripper = section(Gripper)
    integrator: str = parameter(
        "string", "auto", "How time is stepped; auto chooses", choices=("auto", "leapfrog"), live=True
    )
    step: float = parameter(
        "double", 0.0, "Fixed time step; 0 takes it from the stability limit", unit="s", least=0.0, most=1.0, live=True
    )
    record: Record = section(Record)

    def __attrs_post_init__(self) -> None:
        """Check what no single parameter shows."""
        rows, columns = self.cloth.resolution
        if rows * columns > MOST_PARTICLES:
            raise ParameterError(
                f"cloth.resolution {rows} x {columns} makes {rows * columns} particles; at most {MOST_PARTICLES}"
            )
        if not self.frame_id:
            raise ParameterError("frame_id is empty; name the coordinate frame, e.g. 'world'")
        names = self.gripper_names
        for name in names:
            if not _NAME.fullmatch(name):
                raise ParameterError(f"gripper name '{name}' is no ROS name; use letters, digits and _, a letter first")
            if names.count(name) > 1:
                raise ParameterError(f"two grippers are named '{name}'; give each its own name")
        try:
            normalised(self.cloth.orientation)
        except ValueError as error:
            raise ParameterError(f"cloth.orientation: {error}") from error
        self.anchored_particles()
        self.threads()
        self._check_bending()

    @classmethod
    def declared(cls) -> tuple[parameters.Parameter, ...]:
        """Every parameter of a scene."""
        return tuple(parameters.declared(cls))

    @classmethod
    def from_parameters(cls, values: dict[str, Any]) -> Scene:
        """Build a scene from values by full name, e.g. ``{"cloth.size": [1.0, 1.0]}``.

        Raises:
            ParameterError: for an unknown name or a bad value.
        """
        scene: Scene = parameters.build(cls, values)
        return scene

    @classmethod
    def from_file(cls, path: str | Path, *, node: str = "cloth_sim") -> Scene:
        """Read a scene from a ROS parameter file.

        Raises:
            ParameterError: as `from_parameters`, or if the file can't be read.
        """
        return cls.from_parameters(parameter_file.read(path, node=node))

    def parameters(self) -> dict[str, Any]:
        """Every parameter's value by full name."""
        return parameters.flatten(self)

    def changed(self, values: dict[str, Any]) -> Scene:
        """Return a scene with live parameters changed.

        Raises:
            ParameterError: for an unknown name, a parameter that can't change while running, or a bad value.
        """
        known = {entry.name: entry for entry in self.declared()}
        for name in values:
            if name in known and not known[name].live:
                raise ParameterError(f"{name} can't change while the cloth runs; set it at start")
        return self.from_parameters({**self.parameters(), **values})

    @property
    def period(self) -> float:
        """Simulated time of one frame [s]."""
        return 1.0 / self.rate

    @property
    def gripper_names(self) -> list[str]:
        """Names of the grippers."""
        return [name for name in self.grippers if name]

    @property
    def sheet(self) -> GridSheet:
        """Geometry of the flat sheet."""
        rows, columns = self.cloth.resolution
        height, width = self.cloth.size
        return GridSheet(height=height, width=width, rows=rows, columns=columns, layout=self.cloth.shear_layout)  # type: ignore[arg-type]

    def threads(self) -> Threads:
        """Spring stiffnesses of the grid.

        Raises:
            ParameterError: if the moduli can't be met.
        """
        try:
            return grid_threads(
                stretch_modulus=self.material.stretch_modulus,
                shear_modulus=self.material.shear_modulus,
                spacing=self.sheet.spacing,
                layout=self.cloth.shear_layout,  # type: ignore[arg-type]
                bend_stiffness=self.bending.stiffness if self.bending.model == "axial" else 0.0,
            )
        except ValueError as error:
            raise ParameterError(str(error)) from error

    def anchored_particles(self) -> list[int]:
        """Indices of the anchored particles.

        Raises:
            ParameterError: for an anchor that is no edge, corner or particle number.
        """
        sheet = self.sheet
        found: set[int] = set()
        for name in self.cloth.anchors:
            if name.isdecimal():
                if int(name) >= sheet.rows * sheet.columns:
                    raise ParameterError(
                        f"cloth.anchors names particle {name}; there are {sheet.rows * sheet.columns}, counted from 0"
                    )
                found.add(int(name))
            elif name:
                try:
                    found.update(int(particle) for particle in sheet.edge(name))
                except ValueError as error:
                    raise ParameterError(f"cloth.anchors: {error}, or give a particle's number") from error
        return sorted(found)

    def model(self) -> Model:
        """Build the physics: masses, terms, anchors. Terms that the scene does not use are not there."""
        masses = self.sheet.masses(self.material.density)
        material = self.material
        terms: list[Term] = [
            *self.sheet.springs(
                self.threads(),
                k_d0=material.damping,
                density=material.density,
                retardation=material.viscosity / material.stretch_modulus,
            )
        ]
        if self.bending.model in ("opposite", "crossed", "altitude"):
            shear = [term.pairs for term in terms if term.name == "shear" and isinstance(term, PairSprings)]
            terms.extend(self._hinge_springs(masses, shear[0] if shear else None))
        if any(self.gravity):
            terms.append(Gravity(masses, self.gravity))
        if self.air.drag:
            terms.append(Drag(masses, self.air.drag))
        if self.gripper_names:
            terms.append(Grips(len(self.gripper_names)))
        return Model(masses, terms, anchors=self.anchored_particles())

    def _check_bending(self) -> None:
        model, modulus = self.bending.model, self.material.bending_modulus
        if model in ("axial", "opposite") and modulus:
            try:
                refuse_bending_modulus(model)
            except ValueError as error:
                raise ParameterError(f"material.bending_modulus is {modulus} N m: {error}") from error
        if model in ("crossed", "altitude") and not modulus:
            raise ParameterError(
                f"bending model '{model}' needs material.bending_modulus above 0 N m, e.g. 1.0e-5; or choose 'none'"
            )

    def _hinge_springs(self, masses: Array, existing: NDArray[np.int64] | None) -> list[Term]:
        """Build the terms of S7, S7 and S8, or S7 and S9; pairs that shear springs join already get no second one."""
        sheet = self.sheet
        surface = Surface.from_triangles(sheet.triangles(), particle_count=len(masses))
        rest = sheet.positions()
        options: dict[str, Any] = {}
        if self.bending.model == "opposite":
            ends = rest[surface.hinges[:, 1]] - rest[surface.hinges[:, 0]]
            options["spring_stiffness"] = self.bending.stiffness * np.sqrt(np.sum(ends * ends, axis=1))
        else:
            options["hinge_constants"] = grid_hinge_constants(
                surface.hinges,
                columns=sheet.columns,
                spacing=sheet.spacing,
                bending_modulus=self.material.bending_modulus,
            )
        return list(
            bending_terms(
                self.bending.model,  # type: ignore[arg-type]
                surface.hinges,
                rest,
                rest_angle=self.bending.rest_angle or None,
                damping=self.material.damping,
                masses=masses,
                existing=existing,
                weak=True,
                **options,
            )
        )

    def initial_positions(self) -> Array:
        """Starting positions [m], shape (particle_count, 3)."""
        turn = rotation_matrix(normalised(self.cloth.orientation))
        return np.einsum("ij,nj->ni", turn, self.sheet.positions()) + np.asarray(self.cloth.position)

    def initial_state(self) -> State:
        """Starting state, at rest."""
        return State(self.initial_positions())

    def build_integrator(self) -> Integrator:
        """The integrator that the scene asks for."""
        return Leapfrog(self.step or None)
