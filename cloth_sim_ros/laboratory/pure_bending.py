# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pure bending (KES-FB2): moment of a strip between clamps that turn, at constant curvature.

The bending modulus is the slope of the moment per width between the curvatures 50 and 150 1/m, as the Kawabata
evaluation system defines it.
"""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.laboratory.samples import FabricSample
from cloth_sim_ros.laboratory.strips import STIFF_DRAG, Measurement, strip
from cloth_sim_ros.physics.model.forces.force import Array

#: Length between the clamps and width of a strip [m].
LENGTH, WIDTH = 0.01, 0.025
#: Curvatures [1/m]; the modulus is the slope between the first and the last.
CURVATURES = (50.0, 100.0, 150.0)
#: Cells between the clamps.
CELLS = 10
_MAX_RESIDUAL = 0.02


def measure_bending(sample: FabricSample, *, cells: int = CELLS) -> list[Measurement]:
    """Measure strips along warp and weft: moments at several curvatures, and the modulus."""
    measurements = []
    for direction, angle, stated in zip(
        ("warp", "weft"), (0.0, 0.5 * math.pi), sample.pair("material.bending_modulus"), strict=True
    ):
        moments = [bending_moment(sample, angle, curvature, cells=cells) for curvature in CURVATURES]
        slope = (moments[-1] - moments[0]) / (CURVATURES[-1] - CURVATURES[0])
        measurements.append(
            Measurement(
                quantity="bending modulus", direction=direction, unit="N m", measured=slope, stated=stated or None
            )
        )
        measurements += [
            Measurement(quantity=f"moment at {curvature:g} 1/m", direction=direction, unit="N", measured=moment)
            for curvature, moment in zip(CURVATURES, moments, strict=True)
        ]
    return measurements


def bending_moment(sample: FabricSample, angle: float, curvature: float, *, cells: int = CELLS) -> float:
    """Return the moment per width of a strip [N].

    Args:
        sample: the fabric.
        angle: angle from the strip's length to the warp [rad].
        curvature: curvature between the clamps [1/m].
        cells: cells between the clamps.
    """
    cell = LENGTH / cells
    # Two held rows at each end: a row and its hinge stand for half a cell on either side.
    n_cells = cells + 1
    values = {"gravity": [0.0, 0.0, 0.0]}
    specimen = strip(sample, length=n_cells * cell, width=WIDTH, n_cells=n_cells, angle=angle, values=values)
    held = specimen.rows(0, 1) | specimen.rows(n_cells - 1, n_cells)
    start = _arc(specimen.points, cell, curvature)
    positions = specimen.at_rest(start, held, drag=STIFF_DRAG, max_residual=_MAX_RESIDUAL)
    end = specimen.rows(0, 1)
    pivot = positions[specimen.rows(1, 1)].mean(axis=0)
    torque = np.cross(positions[end] - pivot, specimen.forces(positions)[end]).sum(axis=0)
    return abs(float(torque[0])) / WIDTH


def _arc(points: Array, cell: float, curvature: float) -> Array:
    """Return particles of a flat strip along y on a polygon whose sides turn by curvature times cell, (n, 3)."""
    rows = np.rint(points[:, 1] / cell).astype(np.int64)
    turns = curvature * cell * np.arange(rows.max())
    y = np.concatenate([[0.0], np.cumsum(cell * np.cos(turns))])
    z = np.concatenate([[0.0], np.cumsum(cell * np.sin(turns))])
    return np.column_stack([points[:, 0], y[rows], z[rows]])
