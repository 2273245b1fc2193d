# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Membranes whose moduli grow with strain."""

import math

import numpy as np
import pytest
from support.alone import alone, blocks, force, full, matrix

from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.membrane import FabricModuli, membrane
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

SHEET = GridSheet(height=0.4, width=0.5, rows=5, columns=6, layout="alternating")
#: Weft, warp and shear of a wool, ../docs/fabrics.md.
WOOL = FabricModuli(
    warp=16450.0,
    weft=366.0,
    shear=100.0,
    poisson_ratio=0.3,
    warp_stiffening=(0.014, 34.3),
    weft_stiffening=(0.11, 64.0),
    shear_stiffening=(0.14, 9.0),
)
SCENE = {
    "cloth.resolution": [8, 8],
    "cloth.size": [0.4, 0.4],
    "membrane.model": "triangles",
    "material.stretch_modulus": 300.0,
    "material.shear_modulus": 20.0,
    "material.warp_stiffening": [0.05, 20.0],
    "material.weft_stiffening": [0.1, 30.0],
    "material.shear_stiffening": [0.1, 10.0],
    "bending.model": "none",
}


def sheet_membrane(moduli=WOOL, warp=(0.0, 1.0, 0.0)):
    return membrane(SHEET.positions(), SHEET.triangles(), moduli, warp=warp, k_d0=0.1, density=0.2)


def pull(moduli, strain, axis):
    """Force over width of a strip that is stretched along an axis and keeps its stress across at zero."""
    plan = alone(sheet_membrane(moduli), masses=SHEET.masses(0.2))
    x = np.ascontiguousarray(SHEET.positions().T)
    stretch = 1.0 + strain
    green = strain + 0.5 * strain * strain
    c11, c12, c22, _ = moduli.stiffness()
    across = -c12 / (c22 if axis == 1 else c11) * green
    x[axis] *= stretch
    x[1 - axis] *= math.sqrt(1.0 + 2.0 * across)
    f = force(plan, x)[axis].reshape(SHEET.rows, SHEET.columns)
    edge, width = (f[0], SHEET.width) if axis == 1 else (f[:, 0], SHEET.height)
    return abs(edge.sum()) / width


@pytest.mark.parametrize(
    ("axis", "modulus", "strain", "factor"), [(1, 16450.0, 0.014, 34.3), (0, 366.0, 0.11, 64.0)], ids=["warp", "weft"]
)
def test_modulus_of_a_pull_grows_by_the_stated_factor(axis, modulus, strain, factor):
    step = 1e-7
    for at, expected in ((0.0, 1.0), (strain, factor)):
        # One-sided at the limit, where the curvature jumps.
        slope = (pull(WOOL, at + step, axis) - pull(WOOL, at, axis)) / step
        assert slope == pytest.approx(expected * modulus, rel=1e-3)
    assert pull(WOOL, -0.01, axis) == pytest.approx(modulus * 0.01, rel=0.03), "compression does not stiffen"


def test_shear_grows_on_both_sides():
    plan = alone(sheet_membrane(), masses=SHEET.masses(0.2))

    def energy(shear):
        # Threads of unit length at an angle of cosine `shear`.
        x = SHEET.positions().T.copy()
        x[0] += shear * x[1]
        x[1] *= math.sqrt(1.0 - shear * shear)
        return plan.energies(0.0, np.ascontiguousarray(x), None)[1]

    area, rate = SHEET.height * SHEET.width, 8.0 * 100.0 / 0.14**2
    for shear in (-0.1, 0.1):
        assert energy(shear) == pytest.approx(area * (50.0 * shear**2 + rate * shear**4 / 12.0), rel=1e-9)
    beyond = energy(0.21) - 2.0 * energy(0.2) + energy(0.19)
    assert beyond / 1e-4 == pytest.approx(area * 900.0, rel=1e-6), "the modulus stays"


def test_bounds_of_random_sheets_hold():
    rng = np.random.default_rng(8)
    plan = alone(sheet_membrane(), masses=SHEET.masses(0.2))
    for size in (0.003, 0.08):
        x = np.ascontiguousarray(SHEET.positions().T + size * rng.standard_normal((3, SHEET.rows * SHEET.columns)))
        for part, bound in zip("xv", blocks(plan, x), strict=True):
            whole = matrix(plan, x, np.zeros_like(x), part)
            assert np.linalg.eigvalsh(full(bound) - 0.5 * (whole + whole.T))[0] > -1e-9 * np.abs(whole).max()


def test_constant_moduli_are_the_plain_membrane():
    plain = FabricModuli(warp=400.0, weft=150.0, shear=30.0)
    stated = FabricModuli(warp=400.0, weft=150.0, shear=30.0, warp_stiffening=(0.2, 1.0))
    parts = [sheet_membrane(moduli).parts(30)[0] for moduli in (plain, stated)]
    assert [part.kind for part in parts] == ["membrane", "membrane"]


def test_implicit_steps_agree_with_explicit_ones():
    ends = []
    for integrator in ("leapfrog", "implicit"):
        values = {**SCENE, "integrator": integrator, "tolerance": 1e-5, "gravity": [0.0, 0.0, -30.0]}
        simulation = Simulation(Scene.from_parameters(values))
        for _ in range(10):
            simulation.advance([])
        ends.append(simulation.positions)
    assert ends[1] == pytest.approx(ends[0], abs=1e-4)


def test_energy_never_rises_without_a_source():
    values = {**SCENE, "cloth.anchors": [""], "gravity": [0.0, 0.0, 0.0], "air.drag": 0.0, "wind.normal_drag": 0.0}
    simulation = Simulation(Scene.from_parameters(values))
    x = simulation.state.x
    x *= 1.15
    x += 0.003 * np.random.default_rng(5).standard_normal(x.shape)
    energies = [simulation.plan.energy(0.0, x, simulation.state.v)]
    for _ in range(30):
        simulation.advance([])
        energies.append(simulation.plan.energy(0.0, simulation.state.x, simulation.state.v))
    assert np.diff(energies).max() < 1e-3 * energies[0]
    assert energies[-1] < 0.9 * energies[0]


def test_a_stiffening_sheet_sags_less():
    sags = []
    for factor in (1.0, 50.0):
        stiffening = [0.02, factor] if factor > 1.0 else [0.0, 1.0]
        names = ("warp_stiffening", "weft_stiffening")
        values = {**SCENE, "gravity": [0.0, 0.0, -200.0], **{f"material.{name}": stiffening for name in names}}
        simulation = Simulation(Scene.from_parameters({**values, "air.drag": 5.0}))
        for _ in range(60):
            simulation.advance([])
        height = simulation.positions[:, 2]
        sags.append(height.max() - height.min() - 0.4)
    assert sags[0] == pytest.approx(0.4 * 0.5 * 200.0 * 0.2 * 0.4 / 300.0, rel=0.2), "the mean load over the modulus"
    assert sags[1] < 0.5 * sags[0]


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([0.1, 1.2], r"material\.warp_stiffening is \[0\.1, 1\.2\]; .* the factor at least 1\.315"),
        ([0.0, 2.0], "the strain must be at least 1e-12"),
        ([1e-200, 2.0], "the strain must be at least 1e-12"),
        ([-0.1, 2.0], "-0.1"),
        ([0.1], "2"),
    ],
)
def test_impossible_stiffening_is_refused(value, words):
    with pytest.raises(ParameterError, match=words):
        Scene.from_parameters({**SCENE, "material.warp_stiffening": value})
