# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cantilever test (ASTM D1388): overhang at which the tip of a strip reaches 41.5 degrees below the level.

At this angle the bending length c is half the overhang. The flexural rigidity is G = w c³ with the weight per area w
(Peirce, Journal of the Textile Institute 21, 1930, T377). Hinges at the last held row stand for the
curvature of half a cell on either side. Therefore that row lies half a cell beyond the edge of the platform.
"""

from __future__ import annotations

import math

import attrs

from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
from cloth_sim_ros.laboratory.samples import FabricSample
from cloth_sim_ros.laboratory.strips import Measurement, strip

#: Angle of the line from the edge to the tip below the level [rad], and largest width of a strip [m].
TIP_ANGLE, WIDTH = math.radians(41.5), 0.025
#: Cells in a bending length.
CELLS = 4
_GRAVITY = 9.81
#: Accuracy of the angle [rad].
_ANGLE_ACCURACY = 1e-4
_MAX_ITERATIONS = 20
#: Limits of the overhang [m].
_MIN_OVERHANG, _MAX_OVERHANG = 1e-3, 2.0


@attrs.frozen(kw_only=True)
class Cantilever:
    """Result of the cantilever test of one strip."""

    #: Length of the overhang [m].
    overhang: float
    #: Mass per area [kg/m^2].
    density: float

    @property
    def bending_length(self) -> float:
        """Bending length c, half of the overhang [m]."""
        return 0.5 * self.overhang

    @property
    def rigidity(self) -> float:
        """Flexural rigidity G, weight per area times c^3 [N m]."""
        return self.density * _GRAVITY * self.bending_length**3


def cantilever(sample: FabricSample, angle: float, *, cells: int = CELLS) -> Cantilever:
    """Simulate a strip at several overhangs; return that whose tip hangs 41.5 degrees below the level, or raise.

    Args:
        sample: the fabric.
        angle: angle from the strip's length to the warp [rad].
        cells: cells in a bending length.

    Raises:
        LaboratoryError: if no overhang between limits bends to the angle.
    """
    stated = 0.5 * sum(sample.warp_and_weft("material.bending_modulus")) or 1e-5
    overhang = 2.0 * (stated / (sample.density * _GRAVITY)) ** (1.0 / 3.0)
    known: list[tuple[float, float]] = []
    for _ in range(_MAX_ITERATIONS):
        if not _MIN_OVERHANG <= overhang <= _MAX_OVERHANG:
            break
        excess = math.log(math.tan(_tip_angle(sample, angle, overhang, 2 * cells)) / math.tan(TIP_ANGLE))
        if abs(excess) < _ANGLE_ACCURACY / (math.sin(TIP_ANGLE) * math.cos(TIP_ANGLE)):
            return Cantilever(overhang=overhang, density=sample.density)
        known.append((math.log(overhang), excess))
        slope = 2.0
        if len(known) > 1:
            (x0, y0), (x1, y1) = known[-2:]
            slope = (y1 - y0) / (x1 - x0) if (y1 - y0) * (x1 - x0) > 0.0 else slope
        step = min(max(-excess / slope, -0.7), 0.7)
        overhang = math.exp(math.log(overhang) + step)
    raise LaboratoryError(
        f"no overhang from {_MIN_OVERHANG:g} to {_MAX_OVERHANG:g} m bends the strip to {math.degrees(TIP_ANGLE):g} "
        "degrees; check bending.model, bending_modulus and density of the fabric"
    )


def _tip_angle(sample: FabricSample, angle: float, overhang: float, n_cells: int) -> float:
    """Return the angle below the level [rad] at which the edge sees the tip of an overhanging strip at rest."""
    cell = overhang / (n_cells + 0.5)
    # The grid has no Poisson's ratio in bending, therefore the width has no effect.
    width = min(WIDTH, 4.0 * cell)
    specimen = strip(sample, length=(n_cells + 1) * cell, width=width, n_cells=n_cells + 1, angle=angle)
    positions = specimen.equilibrium_positions(specimen.points, specimen.rows(0, 1))
    _, y, z = positions[specimen.rows(n_cells + 1, n_cells + 1)].mean(axis=0)
    return math.atan2(-float(z), float(y) - 0.5 * cell)


def measure_cantilever(sample: FabricSample, *, cells: int = CELLS) -> list[Measurement]:
    """Simulate cantilever tests along warp and weft; return measurements of bending length and flexural rigidity."""
    measurements = []
    for direction, angle, stated in zip(
        ("warp", "weft"), (0.0, 0.5 * math.pi), sample.warp_and_weft("material.bending_modulus"), strict=True
    ):
        bent = cantilever(sample, angle, cells=cells)
        length = (stated / (sample.density * _GRAVITY)) ** (1.0 / 3.0) if stated else None
        measurements += [
            Measurement(
                quantity="bending length", direction=direction, unit="m", measured=bent.bending_length, stated=length
            ),
            Measurement(
                quantity="flexural rigidity",
                direction=direction,
                unit="N m",
                measured=bent.rigidity,
                stated=stated or None,
            ),
        ]
    return measurements
