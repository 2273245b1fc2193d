# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Estimate of the real-time factor, and the resolution that reaches real time."""

from __future__ import annotations

import math
import time
from typing import Any

import attrs

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import StepLimitError, UnstableError
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.state.controller_state import MultirateState
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: Fraction of a period that stepping may take; the rest is for messages, the recording and other programs.
MAX_LOAD = 0.8
#: Slowdown of frames in contact with an obstacle or the cloth itself, and between pads, relative to the best case. The
#: causes are stiffer springs, smaller errors and contact detection. Measured with the package's scene pinch: 6 on the
#: table, 12 to 20 between pads.
_CONTACT_FACTOR, _PINCH_FACTOR = 6.0, 15.0
#: Relative change of the factor that is logged again.
_REPORTED_CHANGE = 0.2


@attrs.frozen(kw_only=True)
class PerformanceEstimate:
    """Expected number of steps, wall time [s] and real-time factor of one frame."""

    #: Smallest number of steps.
    steps: int
    #: Wall time of these steps [s].
    seconds: float
    #: Real-time factor: simulated time of the frame over its wall time.
    factor: float


def estimate_performance(*, period: float, step: float, particles: int, cost: float) -> PerformanceEstimate:
    """Return steps, wall time [s] and real-time factor of a frame at its longest step; accuracy may need smaller ones.

    Args:
        period: simulated time of a frame [s].
        step: longest step, by the stability limit or as fixed [s].
        particles: number of particles.
        cost: wall time of one step for one particle [s].
    """
    steps = max(1, math.ceil(period / step * (1.0 - 1e-12)))
    seconds = steps * particles * cost
    return PerformanceEstimate(steps=steps, seconds=seconds, factor=period / seconds)


def real_time_resolution(shape: tuple[int, int], factor: float, *, fixed_step: bool = False) -> tuple[int, int]:
    """Return rows and columns, at least 2 each, at which a grid of the same extent reaches real time with a margin.

    The number of particles grows with the square of the rows, and the number of steps with the rows. The springs of a
    sheet keep their stiffness and its particles share the mass. Therefore the stability limit is proportional to the
    spacing. That of bending is proportional to its square, so that the result is on the safe side.

    Args:
        shape: rows and columns of the present grid.
        factor: its expected real-time factor, see `PerformanceEstimate`.
        fixed_step: true if the step is fixed and does not depend on the spacing.
    """
    scale = min(1.0, (MAX_LOAD * factor) ** (1.0 / (2.0 if fixed_step else 3.0)))
    return max(2, int(shape[0] * scale)), max(2, int(shape[1] * scale))


def measure_step_cost(scene: Scene) -> float | None:
    """Measure the wall time of a step for one particle [s] in two frames of a temporary cloth; None if unstable.

    Returns:
        The wall time, or None if the motion is unstable or takes no steps.

    Raises:
        StepLimitError: if the scene's fixed step is above its limit.
    """
    trial = Simulation(scene)
    try:
        trial.advance()
        begun = time.perf_counter()
        advance = trial.advance().advance
        seconds = time.perf_counter() - begun
    except StepLimitError:
        raise
    except UnstableError:
        # The frame itself will report it: there it stops time, not the node.
        return None
    return seconds / (advance.evaluations * trial.state.particle_count) if advance and advance.evaluations else None


class PerformanceEstimator:
    """Estimator that logs the expected real-time factor, at the start and after changes of the cloth.

    Args:
        simulation: the cloth.
        logger: receives the estimate.
    """

    def __init__(self, simulation: Simulation, logger: Any) -> None:
        self._simulation, self._logger = simulation, logger
        self._reported_factor: float | None = None
        #: Ratio of the measured cost of a step on this machine to that of the cost model.
        self._cost_ratio = 1.0
        #: The newest estimate; None if the integrator has no step limit that is known beforehand.
        self.latest: PerformanceEstimate | None = None

    def calibrate(self, cost: float | None) -> None:
        """Scale estimates by the measured wall time of a step for one particle [s]; None changes nothing."""
        if cost is not None:
            self._cost_ratio = cost / self._cost

    def report(self) -> None:
        """Estimate the real-time factor; log it if it changed by over 20 % or crossed 1, below 1 with a remedy."""
        self.latest = self._estimate()
        if self.latest is None:
            return
        in_contact = self._contact_factors(self.latest.factor)
        factor, reported = min([self.latest.factor, *in_contact.values()]), self._reported_factor
        if (
            reported is not None
            and (factor < 1.0) == (reported < 1.0)
            and abs(factor - reported) <= _REPORTED_CHANGE * reported
        ):
            return
        self._reported_factor = factor
        scene = self._simulation.scene
        bound = "as the step is fixed" if scene.step else "by the stability limit"
        text = (
            f"expected real-time factor: {self.latest.factor:.2g} at best"
            + "".join(f", about {slower:.1g} {when}" for when, slower in in_contact.items())
            + f" ({self.latest.steps} steps a frame {bound}, {self.latest.seconds * 1e3:.2g} ms of "
            f"{scene.period * 1e3:.3g} ms; accuracy may ask for more)"
        )
        if factor >= 1.0:
            self._logger.info(text)
        else:
            when = "" if self.latest.factor < 1.0 else f" {next(when for when in in_contact if in_contact[when] < 1.0)}"
            self._logger.warning(f"{text}. Real time is not held{when}: {self._remedy(factor)}")

    def describe(self) -> dict[str, str]:
        """Return the real-time factor that `report` estimated last as a diagnostics entry, or `unknown`."""
        return {"real_time_factor_expected": "unknown" if self.latest is None else f"{self.latest.factor:.4g}"}

    def _estimate(self) -> PerformanceEstimate | None:
        scene, plan = self._simulation.scene, self._simulation.plan
        if not scene.step and scene.integrator in ("implicit", "symplectic_euler"):
            return None
        step = scene.step or CONSTANTS.stability_safety * leapfrog_limit(
            *plan.spectral_bounds(self._simulation.state.x)
        )
        return estimate_performance(
            period=scene.period, step=step, particles=plan.model.particle_count, cost=self._cost_ratio * self._cost
        )

    def _contact_factors(self, factor: float) -> dict[str, float]:
        """Return the expected real-time factors in contact, by the condition as text; empty with a fixed step.

        A fixed step has none: it stays as it is, and the cost model includes contact.
        """
        scene = self._simulation.scene
        if scene.step:
            return {}
        factors = {}
        if scene.obstacle_names or scene.contact.self_ or scene.pinching:
            factors["in contact"] = factor / _CONTACT_FACTOR
        if scene.pinching:
            factors["while a gripper pinches"] = factor / _PINCH_FACTOR
        return factors

    @property
    def _cost(self) -> float:
        """Wall time of a step for one particle [s] by the cost model with present contact, computed at each access."""
        simulation, state = self._simulation, self._simulation.state
        contact_cost = simulation.plan.contact_cost(simulation.time, simulation.scene.period, state)
        spring_cost = simulation.plan.multirate_step_cost(int(MultirateState.load(state).ratio))
        return 1e-9 * (spring_cost + contact_cost / state.particle_count)

    def _remedy(self, factor: float) -> str:
        scene = self._simulation.scene
        has_fixed_step = bool(scene.step)
        rows, columns = scene.shape
        if rows > 1:
            resolution = real_time_resolution((rows, columns), factor, fixed_step=has_fixed_step)
            remedy = f"cloth.resolution [{resolution[0]}, {resolution[1]}] would"
        else:
            scale = (MAX_LOAD * factor) ** (1.0 if has_fixed_step else 2.0 / 3.0)
            remedy = f"a mesh of {max(3, int(columns * scale))} particles would"
        softer = "a larger step" if has_fixed_step else "a softer or heavier material"
        return f"{remedy}, as would {softer}; otherwise frames are late or, with overload: relax, less accurate"
