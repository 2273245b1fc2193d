# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Wind: drag relative to moving air, and air on the surface, against what is known of them."""

import subprocess
import sys

import numpy as np
import pytest

from cloth_sim_ros import Scene, SetParameters, Simulation
from cloth_sim_ros.parameters import ParameterError
from cloth_sim_ros.physics.forces.air_panels import AirPanels
from cloth_sim_ros.physics.forces.wind import Wind

N = 9
MASSES = np.random.default_rng(4).uniform(0.1, 1.0, N)
TRIANGLES = [[0, 1, 2], [1, 3, 2], [2, 3, 4], [4, 5, 6], [6, 7, 8], [0, 4, 8]]
CELLS = [[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7]]
WINDY = {
    "wind": Wind(MASSES, (3.0, -1.0, 0.5), 0.7),
    "panels": AirPanels(TRIANGLES, normal=2.0, tangential=0.3, wind=(3.0, -1.0, 0.5)),
    "cells": AirPanels(CELLS, normal=2.0, tangential=0.3, wind=(3.0, -1.0, 0.5)),
    "slippery panels": AirPanels(TRIANGLES, normal=2.0, tangential=0.0, wind=(3.0, -1.0, 0.5)),
    "panels that only rub": AirPanels(TRIANGLES, normal=0.0, tangential=0.3, wind=(3.0, -1.0, 0.5)),
}
every_term = pytest.mark.parametrize("term", WINDY.values(), ids=WINDY.keys())
#: Nothing but springs and what a test adds; free.
BARE = {
    "cloth.resolution": (6, 7),
    "cloth.orientation": (0.0, 0.0, 0.0, 1.0),
    "cloth.anchors": ("",),
    "gravity": (0.0, 0.0, 0.0),
    "air.drag": 0.0,
    "tolerance": 1e-6,
    "grippers": ("",),
}


def state(seed):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((3, N)), rng.standard_normal((3, N)), rng


def force(term, x, v):
    f = np.zeros_like(x)
    term.add_force(0.0, x, v, f)
    return f


@every_term
@pytest.mark.parametrize("seed", range(3))
def test_power_is_what_the_wind_gives_less_what_is_lost(term, seed):
    x, v, _ = state(seed)
    power = float(np.sum(force(term, x, v) * v))
    assert power == pytest.approx(term.supply(0.0, x, v) - term.dissipation(0.0, x, v), rel=1e-12)
    assert term.supply(0.0, x, v) != 0.0
    assert term.dissipation(0.0, x, v) >= 0.0
    still = np.zeros_like(v)
    assert term.supply(0.0, x, still) == term.dissipation(0.0, x, still) == 0.0


@every_term
@pytest.mark.parametrize("seed", range(3))
def test_jacobian_product_is_the_derivative(term, seed):
    x, v, rng = state(seed)
    dx, dv = rng.standard_normal((3, N)), rng.standard_normal((3, N))
    product, h = np.zeros_like(x), 1e-6
    term.add_jacobian_product(0.0, x, v, dx, dv, product)
    difference = (force(term, x + h * dx, v + h * dv) - force(term, x - h * dx, v - h * dv)) / (2 * h)
    assert product == pytest.approx(difference, abs=1e-6 * max(1.0, np.abs(difference).max()))


def matrix(term, x, v, part):
    columns = []
    for index in np.ndindex(3, N):
        push, out, zero = np.zeros((3, N)), np.zeros((3, N)), np.zeros((3, N))
        push[index] = 1.0
        term.add_jacobian_product(0.0, x, v, *((push, zero) if part == "x" else (zero, push)), out)
        columns.append(-out.ravel())
    return np.array(columns).T


def full(blocks):
    whole = np.zeros((3, N, 3, N))
    for (i, j), row in zip([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)], blocks, strict=True):
        for p in range(N):
            whole[i, p, j, p] = whole[j, p, i, p] = row[p]
    return whole.reshape(3 * N, 3 * N)


@every_term
@pytest.mark.parametrize("seed", range(3))
def test_blocks_are_the_damping_and_bound_the_turning_at_rest(term, seed):
    x, v, _ = state(seed)
    stiff, damped = np.zeros((6, N)), np.zeros((6, N))
    term.add_stiffness(x, stiff)
    term.add_damping(x, damped)
    assert full(damped) == pytest.approx(matrix(term, x, v, "v"), abs=1e-12)
    turning = matrix(term, x, np.zeros_like(v), "x")
    assert np.linalg.eigvalsh(full(stiff) - 0.5 * (turning + turning.T)).min() > -1e-12


def test_the_push_on_a_flat_panel_is_coefficient_area_speed():
    square = np.array([[0.0, 2.0, 0.0, 2.0], [0.0, 0.0, 3.0, 3.0], [0.0, 0.0, 0.0, 0.0]])
    term = AirPanels([[0, 1, 3], [0, 3, 2]], normal=1.5, tangential=0.2, wind=(4.0, 0.0, -7.0))
    total = force(term, square, np.zeros_like(square)).sum(axis=1)
    assert total == pytest.approx([0.2 * 6.0 * 4.0, 0.0, -1.5 * 6.0 * 7.0])
    cell = AirPanels([[0, 1, 3, 2]], normal=1.5, tangential=0.2, wind=(4.0, 0.0, -7.0))
    pushes = force(cell, square, np.zeros_like(square))
    assert pushes == pytest.approx(np.tile(total[:, None] / 4.0, 4)), "the same at each of its corners"
    # Turned over it is the same: neither side is its front.
    over = AirPanels([[0, 3, 1], [0, 2, 3]], normal=1.5, tangential=0.2, wind=(4.0, 0.0, -7.0))
    assert force(over, square, np.zeros_like(square)).sum(axis=1) == pytest.approx(total)


def test_a_triangle_without_area_feels_nothing():
    line = np.array([[0.0, 1.0, 2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    term = AirPanels([[0, 1, 2]], normal=1.0, tangential=1.0, wind=(1.0, 2.0, 3.0))
    out, blocks = np.zeros((3, 3)), np.zeros((6, 3))
    term.add_jacobian_product(0.0, line, line, line, line, out)
    term.add_damping(line, blocks)
    for found in (force(term, line, line), out, blocks):
        assert not found.any()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (({"normal": -1.0, "tangential": 0.0}), "normal drag is -1"),
        (({"normal": 1.0, "tangential": float("nan")}), "tangential drag is nan"),
        (({"normal": 1.0, "tangential": 0.0, "wind": (0.0, float("inf"), 0.0)}), "the wind is"),
    ],
)
def test_bad_coefficients_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        AirPanels(TRIANGLES, **arguments)
    with pytest.raises(ValueError, match="give panels of three or four particles"):
        AirPanels([], normal=1.0, tangential=0.0)


def test_a_free_sheet_is_carried_along_by_the_wind():
    wind, drag = np.array([2.0, -1.0, 0.5]), 1.5
    cloth = Simulation(Scene.from_parameters(BARE | {"air.drag": drag, "wind.velocity": tuple(wind)}))
    for _ in range(30):
        cloth.advance()
    expected = wind * (1.0 - np.exp(-drag * cloth.time))
    assert cloth.velocities == pytest.approx(np.tile(expected, (42, 1)), abs=2e-5)


def test_a_sheet_that_falls_flat_reaches_the_speed_at_which_the_air_carries_it():
    values = BARE | {"gravity": (0.0, 0.0, -9.81), "wind.normal_drag": 4.0, "wind.velocity": (0.0, 0.0, 1.0)}
    cloth = Simulation(Scene.from_parameters(values))
    for _ in range(60):
        cloth.advance()
    # density g = normal_drag (speed + 1): after one second the rest is exp(-20).
    speed = 0.2 * 9.81 / 4.0 - 1.0
    mean = np.average(cloth.velocities, axis=0, weights=cloth.model.masses)
    assert mean == pytest.approx([0.0, 0.0, -speed], abs=1e-5)


PUSHED = {
    "wind": {"wind.velocity": (3.0, 2.0, 1.0), "air.drag": 1.0},
    "panels": {
        "wind.velocity": (3.0, 2.0, 1.0),
        "air.drag": 0.0,
        "wind.normal_drag": 0.5,
        "wind.tangential_drag": 0.05,
    },
    "both": {"wind.velocity": (3.0, 2.0, 1.0), "wind.normal_drag": 0.5},
}


@pytest.mark.parametrize("integrator", ["auto", "implicit"])
@pytest.mark.parametrize("values", PUSHED.values(), ids=PUSHED.keys())
def test_energy_balance_with_wind(values, integrator):
    hung = {"cloth.resolution": (8, 8), "material.stretch_modulus": 200.0, "material.shear_modulus": 20.0}
    more = {"diagnostics.energy": True, "integrator": integrator, "tolerance": 1e-5}
    cloth = Simulation(Scene.from_parameters(hung | more | values))
    for _ in range(40):
        cloth.advance()
    report = cloth.energy_report
    assert report.wind > 0.01, "the wind lifts it"
    assert report.work == 0.0
    assert abs(report.residual) < 1e-3 * report.turned_over


def test_what_the_wind_does_is_no_work_of_grippers_nor_energy_from_nowhere():
    cloth = Simulation(Scene.from_parameters({"cloth.resolution": (8, 8), "diagnostics.energy": True}))
    for _ in range(10):
        cloth.advance()
    assert cloth.energy_report.wind == 0.0


def test_uniform_wind_stays_in_the_fused_plan_and_is_the_same():
    values = {"cloth.resolution": (7, 9), "wind.velocity": (3.0, 2.0, 1.0), "air.drag": 0.5}
    fused, plain = (Simulation(Scene.from_parameters(values)) for _ in range(2))
    plain.dynamics.plan = plain.dynamics.forces = None
    assert fused.dynamics.plan._loop is not None
    for _ in range(10):
        fused.advance()
        plain.advance()
    assert fused.positions == pytest.approx(plain.positions, abs=1e-10)
    calm = Simulation(Scene.from_parameters(values | {"wind.velocity": (0.0, 0.0, 0.0)}))
    for _ in range(10):
        calm.advance()
    assert np.abs(calm.positions - fused.positions).max() > 1e-3


def test_implicit_and_explicit_steps_agree_in_the_wind():
    values = {"cloth.resolution": (8, 8), "tolerance": 1e-5, "wind.velocity": (4.0, 4.0, 0.0), "wind.normal_drag": 0.3}
    runs = [Simulation(Scene.from_parameters(values | {"integrator": name})) for name in ("extrapolated", "implicit")]
    for _ in range(30):
        for run in runs:
            run.advance()
    assert np.abs(runs[0].positions - runs[1].positions).max() < 2e-5


def test_heavy_drag_counts_in_the_step_limit():
    values = BARE | {"wind.normal_drag": 1000.0, "wind.velocity": (0.0, 0.0, 5.0), "integrator": "leapfrog"}
    values |= {"material.stretch_modulus": 10.0, "material.shear_modulus": 1.0, "tolerance": 0.0}
    cloth = Simulation(Scene.from_parameters(values))
    _, rate = cloth.dynamics.rates(cloth.state.x)
    # A third of each triangle's drag at its corners, as the masses are: everywhere normal_drag / density.
    assert rate >= 1000.0 / 0.2
    _, calm = Simulation(Scene.from_parameters(values | {"wind.normal_drag": 0.0})).dynamics.rates(cloth.state.x)
    assert rate < 2.0 * 1000.0 / 0.2 + calm
    for _ in range(20):
        cloth.advance()
    # No speed beyond the wind's: what is too long a step overshoots, and grows.
    assert np.abs(cloth.velocities).max() < 5.0 * 1.01


def test_a_grid_sheet_feels_the_air_evenly():
    cloth = Simulation(Scene.from_parameters(BARE | {"wind.normal_drag": 2.0, "wind.velocity": (0.0, 0.0, 5.0)}))
    acceleration = np.zeros_like(cloth.state.x)
    cloth.dynamics.acceleration(0.0, cloth.state.x, cloth.state.v, acceleration)
    # normal_drag wind / density, at corners and edges as within.
    assert acceleration[2] == pytest.approx(2.0 * 5.0 / 0.2, rel=1e-12)


def test_a_scene_without_wind_has_none_of_it():
    code = (
        "import sys; from cloth_sim_ros import Scene, Simulation;"
        "cloth = Simulation(Scene.from_parameters({'cloth.resolution': (4, 4)})); cloth.advance();"
        "print(*(term.name for term in cloth.model.terms), 'cloth_sim_ros.physics.forces.air_panels' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == ["structural", "shear", "bend", "gravity", "drag", "grips", "False"]


def test_wind_may_change_while_it_runs():
    cloth = Simulation(Scene.from_parameters(BARE | {"air.drag": 1.0}))
    cloth.advance()
    assert np.abs(cloth.velocities).max() < 1e-10
    cloth.advance([SetParameters({"wind.velocity": [1.0, 0.0, 0.0]})])
    assert cloth.velocities[:, 0] == pytest.approx(1.0 - np.exp(-1.0 / 60.0), rel=1e-4)


def test_a_chain_has_no_surface_for_the_air():
    with pytest.raises(ParameterError, match="need a surface"):
        Scene.from_parameters(
            {**Scene.from_file("config/chain.yaml").parameters(), "wind.normal_drag": 1.0}, folder="config"
        )
