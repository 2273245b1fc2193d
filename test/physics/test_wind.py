# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Wind: drag relative to moving air, and air on the surface, against known results."""

import subprocess
import sys

import numpy as np
import pytest
from support.alone import alone, blocks, force, full, matrix, product

from cloth_sim_ros import Scene, SetParameters, Simulation
from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.scene.parameters.declare import ParameterError

TRIANGLES = [[0, 1, 2], [1, 3, 2], [2, 3, 4], [4, 5, 6], [6, 7, 8], [0, 4, 8]]
#: A free sheet with springs and the test's forces alone.
BARE = {
    "cloth.resolution": (6, 7),
    "cloth.orientation": (0.0, 0.0, 0.0, 1.0),
    "cloth.anchors": ("",),
    "gravity": (0.0, 0.0, 0.0),
    "air.drag": 0.0,
    "wind.normal_drag": 0.0,
    "tolerance": 1e-6,
    "grippers": ("",),
}


def test_force_on_a_flat_panel_is_coefficient_area_speed():
    square = np.array([[0.0, 2.0, 0.0, 2.0], [0.0, 0.0, 3.0, 3.0], [0.0, 0.0, 0.0, 0.0]])

    def pushes(panels):
        return force(alone(AirPanels(panels, normal=1.5, tangential=0.2, wind=(4.0, 0.0, -7.0)), count=4), square)

    total = pushes([[0, 1, 3], [0, 3, 2]]).sum(axis=1)
    assert total == pytest.approx([0.2 * 6.0 * 4.0, 0.0, -1.5 * 6.0 * 7.0])
    cell = pushes([[0, 1, 3, 2]])
    assert cell == pytest.approx(np.tile(total[:, None] / 4.0, 4)), "the same at each of its corners"
    # Turned over it is the same: neither side is its front.
    assert pushes([[0, 3, 1], [0, 2, 3]]).sum(axis=1) == pytest.approx(total)


@pytest.mark.parametrize(("normal", "tangential"), [(2.0, 0.3), (2.0, 0.0), (0.0, 0.3)])
@pytest.mark.parametrize("corners", [3, 4])
def test_blocks_are_the_damping_and_bound_the_turning_at_rest(normal, tangential, corners):
    rng = np.random.default_rng(corners)
    panels = rng.permuted(np.tile(np.arange(9), (6, 1)), axis=1)[:, :corners]
    plan = alone(AirPanels(panels, normal=normal, tangential=tangential, wind=(3.0, -1.0, 0.5)), count=9)
    for _ in range(5):
        x, v = rng.standard_normal((3, 9)), rng.standard_normal((3, 9))
        stiff, damped = (full(block) for block in blocks(plan, x))
        assert damped == pytest.approx(matrix(plan, x, v, "v"), abs=1e-12)
        turning = matrix(plan, x, 0.0 * v, "x")
        assert np.linalg.eigvalsh(stiff - 0.5 * (turning + turning.T)).min() > -1e-12


@pytest.mark.parametrize("corners", [3, 4])
def test_a_panel_without_area_feels_nothing(corners):
    line = np.zeros((3, corners))
    line[0] = np.arange(corners)
    panels = AirPanels([list(range(corners))], normal=1.0, tangential=1.0, wind=(1.0, 2.0, 3.0))
    plan = alone(panels, count=corners)
    for array in (force(plan, line, line), product(plan, line, line, line, line), blocks(plan, line)[1]):
        assert not array.any()
    assert plan.powers(0.0, line, line) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (({"normal": -1.0, "tangential": 0.0}), "normal drag is -1"),
        (({"normal": 1.0, "tangential": float("nan")}), "tangential drag is nan"),
        (({"normal": 1.0, "tangential": 0.0, "wind": (0.0, float("inf"), 0.0)}), r"wind\[1\] is inf"),
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


def test_flat_falling_sheet_reaches_its_terminal_speed():
    values = BARE | {"gravity": (0.0, 0.0, -9.81), "wind.normal_drag": 4.0, "wind.velocity": (0.0, 0.0, 1.0)}
    cloth = Simulation(Scene.from_parameters(values))
    for _ in range(60):
        cloth.advance()
    # density g = normal_drag (speed + 1): after one second exp(-20) remains.
    speed = 0.2 * 9.81 / 4.0 - 1.0
    mean = np.average(cloth.velocities, axis=0, weights=cloth.model.masses)
    assert mean == pytest.approx([0.0, 0.0, -speed], abs=1e-5)


PUSHED = {
    "wind": {"wind.velocity": (3.0, 2.0, 1.0), "air.drag": 1.0, "wind.normal_drag": 0.0},
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
    more = {"diagnostics.energy": True, "integrator": integrator, "tolerance": 1e-4}
    cloth = Simulation(Scene.from_parameters(hung | more | values))
    for _ in range(40):
        cloth.advance()
    report = cloth.energy_report
    assert report.wind > 0.01, "the wind lifts it"
    assert report.work == 0.0
    assert abs(report.residual) < 1e-3 * report.turned_over


def test_wind_work_is_not_gripper_work_or_numerical_energy():
    cloth = Simulation(Scene.from_parameters({"cloth.resolution": (8, 8), "diagnostics.energy": True}))
    for _ in range(10):
        cloth.advance()
    assert cloth.energy_report.wind == 0.0


def test_implicit_and_explicit_steps_agree_in_the_wind():
    values = {"cloth.resolution": (8, 8), "tolerance": 1e-5, "wind.velocity": (4.0, 4.0, 0.0), "wind.normal_drag": 0.3}
    runs = [Simulation(Scene.from_parameters(values | {"integrator": name})) for name in ("extrapolated", "implicit")]
    for _ in range(12):
        for run in runs:
            run.advance()
    assert np.abs(runs[0].positions - runs[1].positions).max() < 2e-5


def test_heavy_drag_counts_in_the_step_limit():
    values = BARE | {"wind.normal_drag": 1000.0, "wind.velocity": (0.0, 0.0, 5.0), "integrator": "leapfrog"}
    values |= {"material.stretch_modulus": 10.0, "material.shear_modulus": 1.0, "tolerance": 0.0}
    cloth = Simulation(Scene.from_parameters(values))
    _, rate = cloth.plan.spectral_bounds(cloth.state.x)
    # A third of each triangle's drag acts at its corners, like the masses: everywhere normal_drag / density.
    assert rate >= (1.0 - 1e-6) * 1000.0 / 0.2
    _, calm = Simulation(Scene.from_parameters(values | {"wind.normal_drag": 0.0})).plan.spectral_bounds(cloth.state.x)
    assert rate < 2.0 * 1000.0 / 0.2 + calm
    for _ in range(20):
        cloth.advance()
    # No speed exceeds the wind's: too long a step overshoots, and grows.
    assert np.abs(cloth.velocities).max() < 5.0 * 1.01


def test_a_grid_sheet_feels_the_air_evenly():
    cloth = Simulation(Scene.from_parameters(BARE | {"wind.normal_drag": 2.0, "wind.velocity": (0.0, 0.0, 5.0)}))
    acceleration = np.zeros_like(cloth.state.x)
    cloth.plan.accelerations(0.0, cloth.state.x, cloth.state.v, acceleration)
    # normal_drag wind / density, at corners, edges and inside.
    assert acceleration[2] == pytest.approx(2.0 * 5.0 / 0.2, rel=1e-12)


def test_a_scene_without_wind_has_none_of_it():
    code = (
        "import sys; from cloth_sim_ros import Scene, Simulation;"
        "still = {'cloth.resolution': (4, 4), 'wind.normal_drag': 0.0};"
        "cloth = Simulation(Scene.from_parameters(still)); cloth.advance();"
        "names = [force.name for force in cloth.model.forces];"
        "print(*names, 'cloth_sim_ros.physics.model.forces.air_panels' in sys.modules)"
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


@pytest.mark.parametrize(("panels", "areas"), [([[0, 1, 2, 3]], 1.5), ([[0, 1, 2], [0, 2, 3]], 2.0)])
def test_drag_rate_is_that_of_the_lightest_corner(panels: list[list[int]], areas: float) -> None:
    # A rectangle of 2 m x 3 m. Two corners of its triangles have a third of both, those of the cell have a quarter.
    corners = np.array([[0.0, 2.0, 2.0, 0.0], [0.0, 0.0, 3.0, 3.0], [0.0, 0.0, 0.0, 0.0]])
    force, inverse_masses = AirPanels(panels, normal=1.0, tangential=0.5), np.array([10.0, 0.0, 1.0, 1.0])
    assert force.max_drag_rate(corners, inverse_masses) == pytest.approx(1.5 * areas * 10.0)
