# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pure bending (KES-FB2): moment of a strip between clamps that turn, at constant curvature.

The bending modulus is the slope of the moment per width between the curvatures 50 and 150 1/m, as the Kawabata
evaluation system defines it. With friction of bending the strip is then bent to 250 1/m and back to -250 1/m. The width
2HB of the loop is the difference of its two moments at 100 1/m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.laboratory.samples import FabricSample
from cloth_sim_ros.laboratory.strips import STIFF_DRAG, Measurement, strip
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import PLASTIC_LENGTHS_KEY

#: Length between the clamps and width of a strip [m].
LENGTH, WIDTH = 0.01, 0.025
#: Curvatures [1/m]; the modulus is the slope between the first and the last.
CURVATURES = (50.0, 100.0, 150.0)
#: Largest curvature of the loop, and that at which its width is measured [1/m].
LOOP_CURVATURE, WIDTH_CURVATURE = 250.0, 100.0
#: Cells between the clamps.
CELLS = 10
_MAX_RESIDUAL = 0.02


def measure_bending(sample: FabricSample, *, cells: int = CELLS) -> list[Measurement]:
    """Simulate bent strips along warp and weft; return measurements: bending modulus, moments, hysteresis."""
    friction_moment = float(sample.parameters["bending.friction_moment"])
    measurements = []
    for direction, angle, stated in zip(
        ("warp", "weft"), (0.0, 0.5 * math.pi), sample.warp_and_weft("material.bending_modulus"), strict=True
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
        if friction_moment:
            path = (LOOP_CURVATURE, WIDTH_CURVATURE, -LOOP_CURVATURE, WIDTH_CURVATURE)
            _, falling, _, rising = bending_moments(sample, angle, path, cells=cells)
            measurements.append(
                Measurement(
                    quantity=f"width 2HB at {WIDTH_CURVATURE:g} 1/m",
                    direction=direction,
                    unit="N",
                    measured=rising - falling,
                    stated=2.0 * friction_moment,
                )
            )
    return measurements


def bending_moment(sample: FabricSample, angle: float, curvature: float, *, cells: int = CELLS) -> float:
    """Return the moment per width [N] of a strip that is bent from flat to a curvature [1/m], by simulation."""
    return bending_moments(sample, angle, (curvature,), cells=cells)[0]


def bending_moments(
    sample: FabricSample, angle: float, curvatures: Sequence[float], *, cells: int = CELLS
) -> list[float]:
    """Return the moments per width [N] of a strip that is bent from flat to one curvature [1/m] after the other.

    Args:
        sample: the fabric.
        angle: angle from the strip's length to the warp [rad].
        curvatures: curvatures between the clamps [1/m].
        cells: cells between the clamps.
    """
    cell = LENGTH / cells
    # Two held rows at each end: a row and its hinge stand for half a cell on either side.
    n_cells = cells + 1
    values = {"gravity": [0.0, 0.0, 0.0]}
    specimen = strip(sample, length=n_cells * cell, width=WIDTH, n_cells=n_cells, angle=angle, values=values)
    held = specimen.rows(0, 1) | specimen.rows(n_cells - 1, n_cells)
    end, memory, moments = specimen.rows(0, 1), dict[str, Array](), list[float]()
    for curvature in curvatures:
        start = _arc(specimen.points, cell, curvature)
        result = specimen.equilibrium(start, held, memory=memory, drag=STIFF_DRAG, max_residual=_MAX_RESIDUAL)
        positions = result.positions
        memory = {name: array for name, array in result.memory.items() if name == PLASTIC_LENGTHS_KEY}
        pivot = positions[specimen.rows(1, 1)].mean(axis=0)
        torque = np.cross(positions[end] - pivot, specimen.forces(positions, memory)[end]).sum(axis=0)
        moments.append(float(torque[0]) / WIDTH)
    return moments


def _arc(points: Array, cell: float, curvature: float) -> Array:
    """Return a strip's particles on a circular arc, a polygon with an angle of curvature times cell, shape (n, 3)."""
    rows = np.rint(points[:, 1] / cell).astype(np.int64)
    turns = curvature * cell * np.arange(rows.max())
    y = np.concatenate([[0.0], np.cumsum(cell * np.cos(turns))])
    z = np.concatenate([[0.0], np.cumsum(cell * np.sin(turns))])
    return np.column_stack([points[:, 0], y[rows], z[rows]])
