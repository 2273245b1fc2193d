# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Independent integrator: scipy's DOP853, an explicit Runge-Kutta method of order 8."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.verify.fine import Moving
from cloth_sim_ros.verify.motion import Equations, Motion, RunFrame

#: Relative tolerance, and absolute tolerance [m, m/s].
RELATIVE, ABSOLUTE = 1e-13, 1e-13


def frame_by_dop853(equations: Equations, frame: RunFrame, state: State) -> Array:
    """Return the positions (3, n) [m] at a frame's end from a state at its beginning."""
    motion = Motion(state)
    motion.take_hold(frame)
    return dop853(equations.plan(frame, motion), frame.t, frame.duration, motion.now).x


def dop853(
    plan: Plan,
    t: float,
    duration: float,
    start: Moving,
    *,
    relative: float = RELATIVE,
    absolute: float = ABSOLUTE,
) -> Moving:
    """Integrate from time t [s] over a duration [s].

    Friction anchors are updated after each step. The jaws are integrated together with the particles.

    Raises:
        ArithmeticError: if no step is small enough.
    """
    from scipy.integrate import DOP853

    shape, half, contact = start.x.shape, start.x.size, plan.contact
    anchors = contact.lay(start.anchors) if contact is not None else None
    pinched = contact.lay_pads(start.pinched) if contact is not None else None
    pads = np.empty((0, 2)) if pinched is None else pinched

    def right(time: float, y: Array) -> Array:
        out = np.empty_like(y)
        out[:half] = y[half : 2 * half]
        x, v = y[:half].reshape(shape), y[half : 2 * half].reshape(shape)
        if contact is not None and len(pads):
            now = y[2 * half :].reshape(pads.shape)
            contact.lay_pads(now.copy())
            out[2 * half :] = np.stack([now[:, 1], contact.pad_accelerations(time, x, v)], axis=1).ravel()
        plan.accelerations(time, x, v, out[half : 2 * half].reshape(shape))
        return out

    y = np.concatenate([start.x.ravel(), start.v.ravel(), pads.ravel()])
    solver = DOP853(right, t, y, t + duration, rtol=relative, atol=absolute)
    while solver.status == "running":
        trouble = solver.step()
        if contact is not None and anchors is not None:
            x, v = solver.y[: 2 * half].copy().reshape(2, *shape)
            if len(pads):
                contact.lay_pads(solver.y[2 * half :].reshape(pads.shape).copy())
            anchors = contact.lay(contact.settle(solver.t, x, v, anchors[None], [1.0]))
    if solver.status == "failed":
        raise ArithmeticError(f"DOP853 gave up at {solver.t} s: {trouble}")
    x, v = solver.y[: 2 * half].copy().reshape(2, *shape)
    ended = solver.y[2 * half :].reshape(pads.shape).copy() if len(pads) else None
    return Moving(x, v, anchors, ended)
