# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Strips of fabric on grids, at rest between clamps, and the forces of the clamps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.laboratory.equilibrium import Equilibrium, LaboratoryError, find_equilibrium
from cloth_sim_ros.laboratory.samples import FabricSample
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import StateMemory
from cloth_sim_ros.scene.scene import Scene

#: Drag of the air in which stretched strips come to rest [1/s]: they oscillate much faster than hanging ones.
STIFF_DRAG = 200.0


@attrs.frozen(kw_only=True)
class Measurement:
    """Measured quantity of a specimen, and the value that the fabric's parameters state for it."""

    quantity: str
    #: Direction of the specimen: warp, weft or bias; empty if it has none.
    direction: str
    unit: str
    measured: float
    #: Value of the fabric; None if it states none.
    stated: float | None = None

    @property
    def ratio(self) -> float | None:
        """Measured over stated value; None if that is missing or 0."""
        return self.measured / self.stated if self.stated else None


@attrs.frozen(eq=False, kw_only=True)
class FabricStrip:
    """Flat strip of fabric along y, from y = 0 on, on a grid of particles, with the scene to simulate it."""

    scene: Scene
    #: Particles at rest [m], shape (n, 3).
    points: Array
    #: Length of a cell along the strip [m].
    cell: float

    def rows(self, first: int, last: int) -> NDArray[np.bool_]:
        """Return a mask, shape (n,), of the particles in the rows from `first` to `last`, counted from y = 0."""
        row = np.rint(self.points[:, 1] / self.cell)
        return np.asarray((row >= first) & (row <= last))

    @property
    def n_rows(self) -> int:
        """Number of rows of particles along the strip."""
        return int(np.rint(self.points[:, 1].max() / self.cell)) + 1

    def equilibrium_positions(self, start: Array, held: NDArray[np.bool_], **options: Any) -> Array:
        """Return the positions at rest [m], (n, 3), as `equilibrium`, whose arguments and errors it has."""
        return self.equilibrium(start, held, **options).positions

    def equilibrium(self, start: Array, held: NDArray[np.bool_], **options: Any) -> Equilibrium:
        """Simulate the strip with held particles until it is at rest; raise LaboratoryError if it never is.

        Args:
            start: positions at the beginning, those of held particles included [m], shape (n, 3).
            held: true for held particles, shape (n,).
            options: further arguments of `find_equilibrium`.

        Raises:
            LaboratoryError: if the strip does not come to rest.
        """
        anchors = [str(particle) for particle in np.flatnonzero(held)]
        rest_state = find_equilibrium(self.scene.changed({"cloth.anchors": anchors}), start, **options)
        if not rest_state.is_converged:
            raise LaboratoryError(
                f"the strip is not at rest after {rest_state.time:g} s: a force of {rest_state.residual:.2g} of a "
                "particle's weight is left; try more cells, or a smaller load"
            )
        return rest_state

    def forces(self, positions: Array, memory: StateMemory | None = None) -> Array:
        """Return the force of the strip on each particle at rest [N], held ones included, shape (n, 3).

        Args:
            positions: positions [m], shape (n, 3).
            memory: `State.memory`, which friction of bending needs.
        """
        plan = self.scene.plan()
        x = np.ascontiguousarray(positions.T)
        acceleration = np.empty_like(x)
        plan.accelerations(0.0, x, np.zeros_like(x), acceleration, memory or {})
        return np.ascontiguousarray((acceleration * plan.model.masses).T)


def strip(
    sample: FabricSample,
    *,
    length: float,
    width: float,
    n_cells: int,
    angle: float,
    min_columns: int = 3,
    values: Mapping[str, Any] | None = None,
) -> FabricStrip:
    """Build a flat strip of a fabric, cut at an angle [rad] to the warp, that nothing holds.

    Args:
        sample: the fabric.
        length: length [m].
        width: width [m].
        n_cells: number of cells along it.
        angle: angle from its length to the warp [rad].
        min_columns: smallest number of particles across.
        values: further parameters of its scene.
    """
    cell = length / n_cells
    columns = max(min_columns, round(width / cell) + 1)
    scene = sample.scene(
        {
            "cloth.size": [length, width],
            "cloth.resolution": [n_cells + 1, columns],
            "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
            "cloth.position": [0.0, 0.5 * length, 0.0],
            "cloth.anchors": [""],
            "material.warp_direction": _direction(angle),
            **(values or {}),
        }
    )
    return FabricStrip(scene=scene, points=scene.initial_positions(), cell=cell)


def _direction(angle: float) -> list[float]:
    """Return the unit vector in the x-y plane at an angle from y [rad]; along an axis it is exact."""
    quarter = angle / (0.5 * math.pi)
    if quarter == round(quarter):
        return [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]][round(quarter) % 2]
    return [math.sin(angle), math.cos(angle), 0.0]


def describe(title: str, measurements: Sequence[Measurement]) -> str:
    """Return measurements beside stated values as a text table of several lines under a title."""
    width = max(len(measurement.quantity) for measurement in measurements)
    lines = [title, f"  {'':{width}}  {'':5}  {'measured':>10}  {'fabric':>10}  {'ratio':>6}"]
    for measurement in measurements:
        stated = "" if measurement.stated is None else f"{measurement.stated:.4g}"
        ratio = "" if measurement.ratio is None else f"{measurement.ratio:.3f}"
        line = f"  {measurement.quantity:{width}}  {measurement.direction:5}  {measurement.measured:>10.4g}"
        lines.append(f"{line}  {stated:>10}  {ratio:>6}  {measurement.unit}")
    return "\n".join([*lines, ""])
