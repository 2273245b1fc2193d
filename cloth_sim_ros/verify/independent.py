# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A frame by an integrator that is not ours: scipy's DOP853, an explicit Runge-Kutta method of order 8."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.verify.fine import Moving
from cloth_sim_ros.verify.motion import Equations, Motion, RunFrame

#: Its relative tolerance, and its absolute one [m, m/s].
RELATIVE, ABSOLUTE = 1e-13, 1e-13


def frame_by_dop853(equations: Equations, frame: RunFrame, state: State) -> Array:
    """Return positions (3, n) [m] at a frame's end from a state at its beginning."""
    motion = Motion(state)
    motion.take_hold(frame)
    return dop853(equations.plan(frame, motion), frame.t, frame.duration, motion.now).x


def dop853(plan: Plan, t: float, duration: float, start: Moving) -> Moving:
    """Move from time t [s] through a duration [s]. Anchors of friction are dragged after each of its steps.

    Raises:
        ArithmeticError: if it finds no step that is small enough.
    """
    from scipy.integrate import DOP853

    shape, half, contact = start.x.shape, start.x.size, plan.contact
    anchors = contact.lay(start.anchors) if contact is not None else None

    def right(time: float, y: Array) -> Array:
        out = np.empty_like(y)
        out[:half] = y[half:]
        x, v = y[:half].reshape(shape), y[half:].reshape(shape)
        plan.accelerations(time, x, v, out[half:].reshape(shape))
        return out

    y = np.concatenate([start.x.ravel(), start.v.ravel()])
    solver = DOP853(right, t, y, t + duration, rtol=RELATIVE, atol=ABSOLUTE)
    while solver.status == "running":
        trouble = solver.step()
        if contact is not None and anchors is not None:
            x, v = solver.y.copy().reshape(2, *shape)
            anchors = contact.lay(contact.settle(solver.t, x, v, anchors[None], [1.0]))
    if solver.status == "failed":
        raise ArithmeticError(f"DOP853 gave up at {solver.t} s: {trouble}")
    x, v = solver.y.copy().reshape(2, *shape)
    return Moving(x, v, anchors)
