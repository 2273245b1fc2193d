# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The performance estimate: real-time factor, recommended resolution, and log lines."""

from __future__ import annotations

from typing import Any

import pytest

from cloth_sim_ros import Scene, SetParameters, Simulation
from cloth_sim_ros.ros.check.performance_estimate import (
    MAX_LOAD,
    PerformanceEstimator,
    estimate_performance,
    real_time_resolution,
)


class Log:
    def __init__(self) -> None:
        self.infos: list[str] = []
        self.warnings: list[str] = []

    def info(self, text: str) -> None:
        self.infos.append(text)

    def warning(self, text: str) -> None:
        self.warnings.append(text)


def forecaster(**values: Any) -> tuple[PerformanceEstimator, Simulation, Log]:
    simulation, log = Simulation(Scene.from_parameters(values)), Log()
    return PerformanceEstimator(simulation, log), simulation, log


def test_the_estimate_is_steps_times_particles_times_cost() -> None:
    estimate = estimate_performance(period=0.01, step=0.003, particles=1000, cost=1e-8)
    assert (estimate.steps, estimate.seconds) == (4, pytest.approx(4e-5))
    assert estimate.factor == pytest.approx(250.0)
    # A step longer than the frame is one step; a step equal to the frame is one too.
    assert estimate_performance(period=0.01, step=1.0, particles=1, cost=1e-8).steps == 1
    assert estimate_performance(period=0.3, step=0.1, particles=1, cost=1e-8).steps == 3


@pytest.mark.parametrize(
    ("factor", "fixed", "expected"),
    [(0.1, False, (43, 86)), (0.1, True, (28, 56)), (5.0, False, (100, 200)), (1e-9, False, (2, 2))],
)
def test_real_time_resolution(factor: float, fixed: bool, expected: tuple[int, int]) -> None:
    assert real_time_resolution((100, 200), factor, fixed_step=fixed) == expected


@pytest.mark.parametrize(
    "material",
    [
        {"material.stretch_modulus": 1e5},
        {"material.stretch_modulus": 3e4, "material.damping": 0.5},
        {"bending.model": "crossed", "material.bending_modulus": 1e-3, "material.stretch_modulus": 1e4},
        {"step": 2e-6, "cloth.resolution": [30, 40]},
    ],
    ids=["stiff", "damped", "bending", "fixed step"],
)
def test_recommended_resolution_reaches_real_time_by_estimate(material: dict[str, Any]) -> None:
    values = {"cloth.resolution": [100, 80]} | material
    slow, simulation, log = forecaster(**values)
    slow.report()
    assert slow.latest is not None
    assert slow.latest.factor < 1.0
    (warning,) = log.warnings
    most = real_time_resolution(simulation.scene.shape, slow.latest.factor, fixed_step=bool(simulation.scene.step))
    assert f"cloth.resolution [{most[0]}, {most[1]}] would" in warning
    better, _, log = forecaster(**{**values, "cloth.resolution": list(most)})
    better.report()
    assert log.warnings == []
    assert better.latest is not None
    # With the margin, and not much more than springs alone require.
    assert better.latest.factor * MAX_LOAD >= 0.95


def test_changed_estimate_is_logged_again() -> None:
    estimator, simulation, log = forecaster(**{"cloth.resolution": [20, 20]})
    estimator.report()
    estimator.report()
    (words,) = log.infos
    assert words.startswith("expected real-time factor: ")
    assert "at best" in words
    simulation.advance([SetParameters({"material.density": 0.21})])
    estimator.report()
    assert len(log.infos) == 1, "hardly any other"
    simulation.advance([SetParameters({"material.stretch_modulus": 1e8})])
    estimator.report()
    (warning,) = log.warnings
    assert "Real time is not held" in warning
    simulation.advance([SetParameters({"material.stretch_modulus": 1000.0})])
    estimator.report()
    assert len(log.infos) == 2


def test_integrator_without_step_limit_has_no_estimate() -> None:
    estimator, _, log = forecaster(**{"cloth.resolution": [5, 5], "integrator": "implicit"})
    estimator.report()
    assert log.infos + log.warnings == []
    assert estimator.describe() == {"real_time_factor_expected": "unknown"}


def test_estimate_uses_measured_step_cost() -> None:
    estimator, simulation, _ = forecaster(**{"cloth.resolution": [10, 10]})
    estimator.report()
    assert estimator.latest is not None
    before = estimator.latest.factor
    estimator.calibrate(3e-9 * simulation.plan.step_cost)
    estimator.report()
    assert estimator.latest.factor == pytest.approx(before / 3.0)
    estimator.calibrate(None)
    estimator.report()
    assert estimator.latest.factor == pytest.approx(before / 3.0)


TABLE: dict[str, Any] = {
    "cloth.resolution": [8, 8],
    "obstacles": ["table"],
    "table.shape": "plane",
    "table.position": [0.0, 0.0, -1.0],
}


def forecast_log(cost: float, **values: Any) -> tuple[str, list[str]]:
    """Log of a cloth with a real-time factor of `cost` at best, and its warnings."""
    forecast, simulation, log = forecaster(**values)
    forecast.report()
    assert forecast.latest is not None
    before = forecast.latest.factor
    again = PerformanceEstimator(simulation, log)
    again.calibrate(1e-9 * before / cost * simulation.plan.step_cost)
    log.infos.clear()
    log.warnings.clear()
    again.report()
    (line,) = log.infos + log.warnings
    return line, log.warnings


def test_estimate_includes_contact_before_it_begins() -> None:
    line, warnings = forecast_log(5.2, **TABLE)
    assert "about 0.9 in contact (" in line
    assert warnings
    assert "Real time is not held in contact: cloth.resolution [" in line
    line, warnings = forecast_log(20.0, **TABLE)
    assert "20 at best, about 3 in contact (" in line
    assert not warnings
    line, warnings = forecast_log(9.0, **TABLE, **{"gripper.mode": "pinch"})
    assert "about 2 in contact, about 0.6 while a gripper pinches (" in line
    assert "Real time is not held while a gripper pinches:" in line
    # No such line for a cloth without contact, or with a fixed step.
    assert "contact" not in forecast_log(2.0, **{"cloth.resolution": [8, 8]})[0]
    assert "contact" not in forecast_log(2.0, **TABLE, step=1e-4)[0]
