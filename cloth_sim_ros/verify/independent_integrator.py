# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Independent integrator: scipy's DOP853, an explicit Runge-Kutta method of order 8."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import (
    ANCHORS_KEY,
    JAWS_KEY,
    PLASTIC_LENGTHS_KEY,
    StateMemory,
    with_jaws,
)
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.verify.reference_integrator import MotionState, returned_to_yield_surface
from cloth_sim_ros.verify.reference_motion import Equations, ReferenceMotion, SimulatedFrame

#: Relative tolerance, and absolute tolerance [m, m/s].
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-13, 1e-13


def frame_by_dop853(equations: Equations, frame: SimulatedFrame, state: State) -> Array:
    """Integrate a frame by DOP853 from a state at its beginning; return the end positions (3, n) [m]."""
    motion = ReferenceMotion(state)
    motion.apply_grasps(frame)
    return dop853(equations.plan(frame, motion), frame.t, frame.duration, motion.state).x


def dop853(
    plan: Plan,
    t: float,
    duration: float,
    start: MotionState,
    *,
    relative_tolerance: float = RELATIVE_TOLERANCE,
    absolute_tolerance: float = ABSOLUTE_TOLERANCE,
) -> MotionState:
    """Integrate a motion by DOP853 from time t [s] over a duration [s]; return the end. Raises ArithmeticError.

    Friction anchors and plastic lengths are updated after each step, plastic lengths at the start too. The jaws are
    integrated together with the particles. Prescribed particles are at their points in each evaluation.

    Raises:
        ArithmeticError: if no step is small enough.
    """
    from scipy.integrate import DOP853

    start = returned_to_yield_surface(plan, start)
    shape, n_coordinates, contact = start.x.shape, start.x.size, plan.contact
    jaws, memory = np.empty((0, 2)) if contact is None else contact.jaws_of(start.memory), dict(start.memory)

    def memory_at(y: Array) -> StateMemory:
        return with_jaws(memory, y[2 * n_coordinates :].reshape(jaws.shape).copy()) if len(jaws) else memory

    def derivative(time: float, y: Array) -> Array:
        out = np.empty_like(y)
        x, v = y[: 2 * n_coordinates].copy().reshape(2, *shape)
        plan.prescribe(time, x, v)
        out[:n_coordinates] = v.ravel()
        memory = memory_at(y)
        if contact is not None and len(jaws):
            jaw_rates = [memory[JAWS_KEY][:, 1], contact.jaw_accelerations(time, x, v, memory)]
            out[2 * n_coordinates :] = np.stack(jaw_rates, axis=1).ravel()
        plan.accelerations(time, x, v, out[n_coordinates : 2 * n_coordinates].reshape(shape), memory)
        return out

    y = np.concatenate([start.x.ravel(), start.v.ravel(), jaws.ravel()])
    solver = DOP853(derivative, t, y, t + duration, rtol=relative_tolerance, atol=absolute_tolerance)
    while solver.status == "running":
        failure = solver.step()
        if contact is not None and contact.force.has_anchors:
            x, v = solver.y[: 2 * n_coordinates].copy().reshape(2, *shape)
            anchors = contact.anchors_of(memory)[None]
            memory[ANCHORS_KEY] = contact.combine_anchors(solver.t, x, v, anchors, [1.0], memory_at(solver.y))
        if plan.plastic is not None:
            x = solver.y[:n_coordinates].copy().reshape(shape)
            memory[PLASTIC_LENGTHS_KEY], _ = plan.plastic.return_mapping(x, memory)
    if solver.status == "failed":
        raise ArithmeticError(f"DOP853 gave up at {solver.t} s: {failure}")
    x, v = solver.y[: 2 * n_coordinates].copy().reshape(2, *shape)
    plan.prescribe(t + duration, x, v)
    return MotionState(x, v, memory_at(solver.y))
