# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cusick drape test (BS 5058, ISO 9073-9): a disc of fabric hangs over a smaller plate.

The drape coefficient is the area of the overhang's vertical projection over its area when flat. A is the area of the
whole shadow, r the radius of the plate, and R that of the specimen. Then

    DC = (A - π r²) / (π R² - π r²).

Supports are lowered slowly in the test; here gravity grows slowly. Folds then form one after the other, as in the test.
A small random offset of each particle chooses among the possible ones.

A held plate holds the particles up to half a row beyond its edge. Hinges at the last held ring stand for the curvature
of half a row on either side. The sheet is therefore clamped half a row before that ring, at the edge. Plates in contact
end near that ring for the same reason. docs/laboratory.md describes what their edges do.
"""

from __future__ import annotations

import math

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.laboratory.equilibrium import LaboratoryError, find_equilibrium
from cloth_sim_ros.laboratory.samples import FabricSample
from cloth_sim_ros.laboratory.silhouette import Silhouette, silhouette
from cloth_sim_ros.laboratory.specimens import ROW, DiscMesh, annulus, disc_mesh, is_on_plate
from cloth_sim_ros.physics.model.forces.force import Array

#: Diameter of the specimen and of the plate [m].
DIAMETER, PLATE_DIAMETER = 0.30, 0.18
#: Length of an edge of a held specimen, and of one in contact with the plate, whose drape takes longer [m].
EDGE_LENGTH, CONTACT_EDGE_LENGTH = 0.005, 0.0075
#: Ratio of the sides of the coarser and the finer mesh of an estimate of the mesh error.
COARSENING = 1.5
#: Drag of the air in which the loaded specimen comes to rest [1/s]: near twice the frequency of a hanging overhang.
_SETTLING_DRAG = 16.0
#: Standard deviation of a particle's height at the beginning [m].
_PERTURBATION = 1e-4
#: Height of a plate [m], and sides of the specimen on which plates lie.
_PLATE_HEIGHT, _PLATES = 0.004, {"plate": -1.0, "cover": 1.0}
#: Distance of the outermost ring from the plate's edge, and of the middle surface from the plate's face, over the
#: thickness. An edge acts within half the thickness; at this distance no slope of the overhang comes so near. At 0.98
#: the specimen rests under its weight, and the cover bears on it as much.
_EDGE_DISTANCE, _FACE_DISTANCE = 0.5, 0.98


@attrs.frozen(kw_only=True)
class DrapeTest:
    """Conditions of a Cusick drape test: specimen, plate, mesh and support; LaboratoryError if they do not fit.

    Raises:
        LaboratoryError: for a plate that is not smaller than the specimen.
    """

    #: Diameters of the specimen and of the plate [m].
    diameter: float = DIAMETER
    plate_diameter: float = PLATE_DIAMETER
    #: Length of an edge of the mesh [m], and its pattern.
    edge_length: float = EDGE_LENGTH
    pattern: str = "regular"
    #: True for contact with the plate and a cover on it, false for particles that are held.
    contact: bool = False
    #: Static and kinetic coefficients of friction between specimen and plate.
    friction: tuple[float, float] = (0.4, 0.3)
    #: Distance from the specimen's middle surface within which a plate acts [m].
    thickness: float = 0.0007
    #: Time during which the load grows [s].
    loading_time: float = 1.2

    def __attrs_post_init__(self) -> None:
        if not 0.0 < self.plate_diameter < self.diameter < math.inf:
            raise LaboratoryError(
                f"the plate's diameter is {self.plate_diameter:g} m; it must be between 0 and that of the specimen, "
                f"{self.diameter:g} m"
            )
        longest = self.max_edge_length
        if not 0.0 < self.edge_length <= longest:
            raise LaboratoryError(
                f"the mesh's edges are {self.edge_length:g} m long; they must be above 0 and at most {longest:.3g} m "
                f"for an overhang of {self.radius - self.plate_radius:g} m over a plate of {self.plate_diameter:g} m"
            )

    @property
    def radius(self) -> float:
        """Radius of the specimen [m]."""
        return 0.5 * self.diameter

    @property
    def plate_radius(self) -> float:
        """Radius of the plate [m]."""
        return 0.5 * self.plate_diameter

    @property
    def max_edge_length(self) -> float:
        """Largest permitted edge length of the mesh [m]: two edges fit on the plate's radius and the overhang."""
        return min(self.plate_radius / 2.0, (self.radius - self.plate_radius) / (2.0 + 0.5 * ROW))

    @property
    def permits_coarser_mesh(self) -> bool:
        """True if a mesh with edges `COARSENING` times as long, for the mesh error, fits the test too."""
        return COARSENING * self.edge_length <= self.max_edge_length

    @property
    def ring_radius(self) -> float:
        """Radius of the outermost ring of particles on the plate [m], half a row beyond the plate's edge."""
        return self.plate_radius + 0.5 * ROW * self.edge_length


@attrs.frozen(eq=False, kw_only=True)
class Drape:
    """Shape and shadow of one draped specimen, and whether it came to rest."""

    test: DrapeTest
    seed: int
    #: Mesh whose particles moved; without the plate's inside if it is held.
    mesh: DiscMesh
    #: Particles of the drape [m], shape (n, 3).
    positions: Array
    shadow: Silhouette
    #: Largest out-of-balance force on a particle over its weight, and true if it is below its limit.
    residual: float
    is_converged: bool
    #: Simulated time until rest [s].
    time: float

    @property
    def coefficient(self) -> float:
        """Drape coefficient: area of the overhang's shadow over that of the flat overhang, from 0 to 1."""
        plate = math.pi * self.test.plate_radius**2
        return (self.shadow.area - plate) / (math.pi * self.test.radius**2 - plate)


def drape(sample: FabricSample, test: DrapeTest, *, seed: int = 0, start: Drape | None = None) -> Drape:
    """Simulate a specimen over the plate until it is at rest, or for 30 s; return its drape, `is_converged` or not.

    Args:
        sample: the fabric.
        test: conditions of the test.
        seed: seed of the angle between mesh and threads and of the particles' offsets.
        start: drape of another mesh in whose shape the specimen begins; None begins flat.

    Raises:
        LaboratoryError: for a mesh that does not fit the specimen.
        ParameterError: for a fabric that a mesh can't have.
    """
    ring_radius = test.ring_radius
    mesh = disc_mesh(test.radius, ring_radius, test.edge_length, pattern=test.pattern, seed=seed)
    values: dict[str, object] = {"cloth.mesh": "specimen.obj", "cloth.orientation": [0.0, 0.0, 0.0, 1.0]}
    values |= {"cloth.position": [0.0, 0.0, 0.0]}
    if test.contact:
        values |= _plate_parameters(test)
    else:
        mesh = annulus(mesh, ring_radius)
    held = is_on_plate(mesh.points, ring_radius)
    values["cloth.anchors"] = [""] if test.contact else [str(particle) for particle in np.flatnonzero(held)]
    scene = sample.scene(values, {"specimen.obj": mesh.obj()})
    if start is None:
        heights = _PERTURBATION * np.random.default_rng(seed).standard_normal(len(held))
        positions = np.column_stack([mesh.points, np.where(held, 0.0, heights)])
    else:
        positions = _resampled_positions(start, mesh, held)
    loading_time = test.loading_time if start is None else 0.0
    equilibrium = find_equilibrium(scene, positions, loading_time=loading_time, drag=_SETTLING_DRAG)
    return Drape(
        test=test,
        seed=seed,
        mesh=mesh,
        positions=equilibrium.positions,
        shadow=silhouette(equilibrium.positions, mesh.triangles, test.plate_radius),
        residual=equilibrium.residual,
        is_converged=equilibrium.is_converged,
        time=equilibrium.time,
    )


def coarser_drape(sample: FabricSample, fine: Drape) -> Drape:
    """Simulate the drape of a mesh `COARSENING` times as coarse, from a finer drape's shape; maybe not converged."""
    test = attrs.evolve(fine.test, edge_length=COARSENING * fine.test.edge_length)
    return drape(sample, test, seed=fine.seed, start=fine)


def mesh_error(fine: Drape, coarse: Drape) -> float:
    """Estimate the error by its mesh of the finer of two drape coefficients, for order 2 in edge length.

    It is positive if the coefficient is too large.
    """
    return (coarse.coefficient - fine.coefficient) / (COARSENING * COARSENING - 1.0)


def _plate_parameters(test: DrapeTest) -> dict[str, object]:
    """Return the scene parameters of the two plates between which a specimen in contact lies."""
    values: dict[str, object] = {"obstacles": list(_PLATES), "contact.thickness": test.thickness}
    for name, sign in _PLATES.items():
        values |= {
            f"{name}.shape": "cylinder",
            f"{name}.size": [test.ring_radius - _EDGE_DISTANCE * test.thickness, _PLATE_HEIGHT],
            f"{name}.position": [0.0, 0.0, sign * (0.5 * _PLATE_HEIGHT + _FACE_DISTANCE * test.thickness)],
            f"{name}.friction": list(test.friction),
        }
    return values


def _resampled_positions(start: Drape, mesh: DiscMesh, held: NDArray[np.bool_]) -> Array:
    """Return positions of a mesh's particles on the surface of a drape [m], shape (n, 3)."""
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    points, moved = start.mesh.points, start.positions
    positions = np.asarray(LinearNDInterpolator(points, moved)(mesh.points))
    # Between the chords of the border and the border.
    outside = np.isnan(positions).any(axis=1)
    positions[outside] = NearestNDInterpolator(points, moved)(mesh.points[outside])
    positions[held] = np.column_stack([mesh.points[held], np.zeros(int(held.sum()))])
    return positions
