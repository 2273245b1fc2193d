# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Motion of a model over a time span in one call."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import attrs
import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import checked_floats
from cloth_sim_ros.physics.integrators.base import TOLERANCE, Advance, Integrator
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.controller_state import PLASTIC_LENGTHS_KEY
from cloth_sim_ros.physics.state.state import State

#: Longest interval of one advance [s]: a frame of a node at 60 Hz.
MAX_ADVANCE = 1.0 / 60.0


@attrs.frozen(eq=False, kw_only=True)
class Motion:
    """Result of `simulate`: positions and velocities at the requested times, and a report of each advance."""

    #: Requested times [s], shape (k,).
    times: Array
    #: Positions [m] and velocities [m/s] at these times, shape (k, particle_count, 3).
    positions: Array
    velocities: Array
    #: Report of the integrator on each advance.
    advances: Sequence[Advance]

    @property
    def flagged(self) -> int:
        """Number of advances whose estimated error exceeds their part of the tolerance."""
        return len([advance for advance in self.advances if advance.flagged])


def simulate(
    model: Model | Plan,
    state: State,
    until: float,
    *,
    save_at: ArrayLike | None = None,
    tolerance: float | None = TOLERANCE,
    integrator: Integrator | None = None,
    on_progress: Callable[[float], object] | None = None,
) -> Motion:
    """Simulate a model from time 0 to `until` [s]: move the state there, return the motion at requested times.

    The motion is divided into advances of at most 1/60 s. Each saved time ends an advance, so it is not interpolated.
    By default the work has no limit: an advance takes as many steps as its tolerance needs.

    Args:
        model: masses, forces and anchors; or a compiled plan of them.
        state: the start; it is at the end when this returns.
        until: end time [s], above 0.
        save_at: times of saved positions and velocities [s], ascending from 0 to `until`; the default is the end alone.
            Times that differ by rounding alone share an advance.
        tolerance: bound of the position error [m] that each second adds, times the amplification of a small
            perturbation in that second (at least 1); see docs/time_stepping.md. None limits steps by stability alone.
            An integrator has its own instead.
        integrator: the integrator; by default `auto` chooses by stiffness and tolerance.
        on_progress: called after each advance with its duration [s]; for example `tqdm(total=until).update`.

    Raises:
        ValueError: for times that do not ascend or are out of range, a state with another number of particles, or a
            tolerance other than the default beside an integrator.
        UnstableError: if the motion does not stay finite.
    """
    from cloth_sim_ros.physics.control.automatic import make_integrator

    plan = model if isinstance(model, Plan) else compile(model)
    if not isinstance(state, State):
        raise ValueError(f"state is of type {type(state).__name__}; make one: State(positions)")
    if state.particle_count != plan.model.particle_count:
        raise ValueError(
            f"the state has {state.particle_count} particles, the model {plan.model.particle_count}: make the "
            "state of as many positions as the model has masses"
        )
    until = float(checked_floats("until", until, ()))
    if not until > 0.0:
        raise ValueError(f"until is {until} s; it must be above 0")
    if not (integrator is None or isinstance(integrator, Integrator)):
        raise ValueError(f"integrator is {integrator!r}; it must be an object such as Leapfrog(step=1e-4)")
    if tolerance is not None:
        tolerance = float(checked_floats("tolerance", tolerance, ()))
    if integrator is not None and tolerance not in (None, TOLERANCE):
        name = type(integrator).__name__
        remedy = f"give it there, {name}(tolerance={tolerance})" if hasattr(integrator, "tolerance") else "leave it out"
        raise ValueError(f"tolerance is {tolerance} m, and the integrator {name} decides on its own: {remedy}")
    requested_times = [until] if save_at is None else save_at
    times = checked_floats("save_at", requested_times, (np.size(requested_times),))
    if (np.diff(times) < 0.0).any() or not times.size or times[0] < 0.0 or times[-1] > until:
        raise ValueError(f"save_at is {times.tolist()} s; it must hold times that ascend from 0 to until, {until} s")
    stepper = integrator or make_integrator("auto", tolerance=tolerance)
    if PLASTIC_LENGTHS_KEY not in state.memory:
        plan.return_hinges(state)
    positions, velocities, advances = [], [], list[Advance]()
    now, spacing = 0.0, 4.0 * math.ulp(until)
    for end in [*times.tolist(), until]:
        count = max(1, math.ceil((end - now) / MAX_ADVANCE - 1e-9)) if end - now > spacing else 0
        for k in range(count):
            begin, duration = now + k * (end - now) / count, (end - now) / count
            advances.append(stepper.advance(plan, state, begin, duration))
            if on_progress is not None:
                on_progress(duration)
        now = end if count else now
        positions.append(state.positions)
        velocities.append(state.velocities)
    x, v = np.array(positions[: len(times)]), np.array(velocities[: len(times)])
    return Motion(times=times, positions=x, velocities=v, advances=advances)
