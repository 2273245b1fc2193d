# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tests of strips in their plane: tension (ISO 13934-1), shear (KES-FB1) and bias extension.

*Bias extension.* Threads at 45 degrees to a strip of length L and width W, L at least 2 W. If threads do not stretch,
a zone of area (L - 3/2 W) W shears by γ, and zones of area W² by γ/2. The zones at the clamps stay. An extension δ
shears by γ = 2 δ / (L - W). The work of the force F is the energy of shear. Let both areas
be A = (L - 3/2 W) W and B = W². Then

    G = F (L - W)² / (4 δ (A + B / 4)).

Threads that stretch make this figure smaller than the shear modulus.
"""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.laboratory.samples import FabricSample
from cloth_sim_ros.laboratory.strips import STIFF_DRAG, Measurement, strip
from cloth_sim_ros.physics.model.forces.force import Array

#: Length between the clamps and width of the specimens [m].
TENSION_SIZE, SHEAR_SIZE, BIAS_SIZE = (0.2, 0.05), (0.05, 0.2), (0.2, 0.1)
#: Extensions of a tension test, angles of a shear test [rad], and the tension during shear [N/m].
EXTENSIONS = (0.001, 0.01, 0.02, 0.05)
SHEAR_ANGLES = tuple(math.radians(angle) for angle in (0.5, 2.5, 5.0, 8.0))
SHEAR_TENSION = 10.0
#: Extensions of a bias test.
BIAS_EXTENSIONS = (0.001, 0.01, 0.02, 0.05)
#: Cells along the shorter side. Threads at 45 degrees that hardly stretch lock coarse triangles, so bias takes more.
CELLS, BIAS_CELLS = 8, 32
#: Largest force that a particle may lack, as the residual of an equilibrium: the clamps pull far harder.
_MAX_RESIDUAL = 0.05
_PLANE = {"bending.model": "none", "material.bending_modulus": 0.0, "material.bending_modulus_weft": 0.0}


def _clamp_force(
    sample: FabricSample, size: tuple[float, float], angle: float, cells: int, shift: tuple[float, float]
) -> Array:
    """Return a strip's force per width on its displaced upper clamp, across and along [N/m], shape (2,), at rest.

    Args:
        sample: the fabric.
        size: length between the clamps and width [m].
        angle: angle from the strip's length to the warp [rad].
        cells: cells along the shorter side.
        shift: displacement of the upper clamp across and along the strip [m].
    """
    length, width = size
    n_cells = round(length / (min(size) / cells))
    still = {**_PLANE, "gravity": [0.0, 0.0, 0.0]}
    specimen = strip(sample, length=length, width=width, n_cells=n_cells, angle=angle, values=still)
    upper = specimen.rows(n_cells, n_cells)
    start = specimen.points + np.outer(specimen.points[:, 1] / length, (*shift, 0.0))
    positions = specimen.equilibrium_positions(
        start, upper | specimen.rows(0, 0), drag=STIFF_DRAG, max_residual=_MAX_RESIDUAL
    )
    pull = specimen.forces(positions)[upper].sum(axis=0)
    return np.asarray(-pull[:2] / width)


def measure_tension(sample: FabricSample, *, cells: int = CELLS) -> list[Measurement]:
    """Simulate strips stretched along warp and weft; return measurements: tensile modulus, load at each extension."""
    measurements = []
    for direction, angle, stated in zip(
        ("warp", "weft"), (0.0, 0.5 * math.pi), sample.warp_and_weft("material.stretch_modulus"), strict=True
    ):
        loads = [
            float(_clamp_force(sample, TENSION_SIZE, angle, cells, (0.0, extension * TENSION_SIZE[0]))[1])
            for extension in EXTENSIONS
        ]
        measurements.append(
            Measurement(
                quantity="tensile modulus",
                direction=direction,
                unit="N/m",
                measured=loads[0] / EXTENSIONS[0],
                stated=stated,
            )
        )
        measurements += _curve("load", direction, EXTENSIONS, loads)
    return measurements


def measure_shear(sample: FabricSample, *, cells: int = CELLS) -> list[Measurement]:
    """Simulate a specimen sheared between parallel clamps; return measurements: shear modulus, and load at each angle.

    The modulus is the slope of the force between the first two angles. The specimen's free sides bear no shear, which
    makes it smaller than the fabric's.
    """
    length = SHEAR_SIZE[0]
    stretched = length * (1.0 + SHEAR_TENSION / sample.warp_and_weft("material.stretch_modulus")[0])
    shifts = [(stretched * math.sin(a), stretched * math.cos(a) - length) for a in SHEAR_ANGLES]
    loads = []
    for shear_angle, shift in zip(SHEAR_ANGLES, shifts, strict=True):
        across, along = _clamp_force(sample, SHEAR_SIZE, 0.0, cells, shift).tolist()
        loads.append(across * math.cos(shear_angle) - along * math.sin(shear_angle))
    slope = (loads[1] - loads[0]) / (SHEAR_ANGLES[1] - SHEAR_ANGLES[0])
    stated = float(sample.parameters["material.shear_modulus"])
    modulus = Measurement(quantity="shear modulus", direction="", unit="N/m", measured=slope, stated=stated)
    return [modulus, *_curve("load", "", SHEAR_ANGLES, loads, unit="rad")]


def measure_bias_extension(sample: FabricSample, *, cells: int = BIAS_CELLS) -> list[Measurement]:
    """Simulate a strip stretched at 45 degrees to its threads; return measurements: two moduli, then loads."""
    length, width = BIAS_SIZE
    loads = [
        float(_clamp_force(sample, BIAS_SIZE, 0.25 * math.pi, cells, (0.0, extension * length))[1])
        for extension in BIAS_EXTENSIONS
    ]
    warp, weft = sample.warp_and_weft("material.stretch_modulus")
    shear = float(sample.parameters["material.shear_modulus"])
    # Springs have that of their network.
    poisson = sample.scene({}).poisson_ratio or 0.0
    compliance = 0.25 * (1.0 / warp + 1.0 / weft - 2.0 * poisson / warp) + (0.25 / shear if shear else math.inf)
    zones = (length - 1.5 * width) * width + 0.25 * width * width
    extension = BIAS_EXTENSIONS[0] * length
    sheared = loads[0] * width * (length - width) ** 2 / (4.0 * extension * zones)
    return [
        Measurement(
            quantity="modulus at 45 degrees",
            direction="bias",
            unit="N/m",
            measured=loads[0] / BIAS_EXTENSIONS[0],
            stated=1.0 / compliance,
        ),
        Measurement(
            quantity="shear modulus, threads that do not stretch",
            direction="bias",
            unit="N/m",
            measured=sheared,
            stated=shear,
        ),
        *_curve("load", "bias", BIAS_EXTENSIONS, loads),
    ]


def _curve(
    quantity: str, direction: str, points: tuple[float, ...], loads: list[float], *, unit: str = "%"
) -> list[Measurement]:
    """Return a measurement, without stated value, for each point of a curve of loads [N/m] over extension or angle."""
    texts = [f"{100.0 * point:g} %" if unit == "%" else f"{math.degrees(point):.3g} degrees" for point in points]
    return [
        Measurement(quantity=f"{quantity} at {text}", direction=direction, unit="N/m", measured=load)
        for text, load in zip(texts, loads, strict=True)
    ]
