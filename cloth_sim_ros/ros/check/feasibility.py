# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Feasibility check of parameters for a live node.

Parameters are refused if one frame would take minutes, so that the node stays responsive. The library itself has no
such bound.
"""

from __future__ import annotations

from cloth_sim_ros.physics.integrators.base import refuse_step
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: Largest number of particle steps in a frame: about a second of the slowest forces.
MAX_WORK = 20_000_000
#: Number of steps in a frame that is accepted for any number of particles.
ALLOWED_STEPS = 1000
#: Largest number of steps in a frame for any number of particles: each step has a fixed cost.
MAX_STEPS = 100_000
#: Iterations of an implicit step, typically: two to six.
_ITERATIONS_PER_STEP = 4
#: Time of an iteration besides its estimate, which is by particles [s].
_ITERATION_CALL_TIME = 3e-4
#: Largest estimated time of the fixed implicit steps of a frame [s], and number of them that is accepted for any cloth.
_MAX_IMPLICIT_TIME, _ALLOWED_IMPLICIT_STEPS = 1.0, 10
#: Largest work limit of a frame that bounds explicit steps in place of their number [s of estimated cost].
_MAX_WORK_TIME = 60.0


def check_feasibility(scene: Scene, simulation: Simulation) -> None:
    """Raise ParameterError if a scene's fixed step or stability limit needs too many steps in a frame for a live node.

    Args:
        scene: the scene to check.
        simulation: the cloth that would use the scene.

    Raises:
        ParameterError: names the number of steps of a frame, and the remedy.
        StepLimitError: if the fixed step is above the stability limit of the present positions.
    """
    particles, bounds = simulation.state.particle_count, simulation.spectral_bounds(scene)
    integrator = scene.build_integrator()
    limit = integrator.step_limit(*bounds)
    step, reason = scene.step, f"step is {scene.step} s"
    remedy = (
        "lower stiffness or damping, raise the density, or choose integrator 'auto' with step 0.0 and the default "
        "work_limit"
    )
    if step:
        remedy = "set a larger step, or 0.0 with a tolerance"
        refuse_step(step, limit, integrator.name)
    else:
        step = limit
        reason = f"the stability limit of '{scene.integrator}' is {step:.3g} s"
        work_time = scene.work_limit * scene.period
        if scene.integrator == "auto" and not 0.0 < work_time <= _MAX_WORK_TIME:
            # If implicit steps find no solution, only the work limit bounds the explicit ones.
            step = leapfrog_limit(*bounds)
            work = f"a work_limit of {scene.work_limit:g}" if scene.work_limit else "no work_limit"
            reason = f"the stability limit of explicit steps is {step:.3g} s, with {work}"
    # Longer frames may take more steps.
    duration_factor = max(1.0, 2.0 * scene.period)
    max_steps = int(duration_factor * min(MAX_STEPS, max(ALLOWED_STEPS, MAX_WORK // particles)))
    if scene.step and scene.integrator == "implicit":
        from cloth_sim_ros.physics.integrators.stage_matrix import iteration_cost

        # No live parameter changes which particles the elements couple.
        step_time = _ITERATIONS_PER_STEP * (_ITERATION_CALL_TIME + 1e-9 * iteration_cost(simulation.plan.model))
        max_steps = int(duration_factor * max(_ALLOWED_IMPLICIT_STEPS, _MAX_IMPLICIT_TIME / step_time))
    if step < scene.period / max_steps:
        raise ParameterError(
            f"a frame would take {scene.period / step:.3g} steps ({reason}), at most {max_steps} are taken live: "
            + remedy
        )
