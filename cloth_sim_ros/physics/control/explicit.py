# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One advance by explicit steps: pieces that three rules accept or reject, within the work limit of a frame.

A piece is a part of the frame, usually all of it. It has a length H and is integrated by K leapfrog runs. Their
combination has order K + 1, because forces that depend on velocities leave odd powers of h in the error. `Controller`
chooses K and the steps for least work, as ODEX chooses order and H (Hairer, Norsett, Wanner, Solving Ordinary
Differential Equations I, II.9). Unlike there, H is the whole frame unless a rule divides or halves it. The number of
steps in H is free. An error estimate needs a further run, so most pieces have only a predicted error.

The steps of a piece must be stable. It is accepted if its error fits its budget. Otherwise, and without a tolerance, it
must create no energy.

docs/step_control.md tells when a piece is accepted over its budget.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control import fallback
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.controller import Controller
from cloth_sim_ros.physics.integrators.base import Advance, Integrator, NoRoomError
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State


class ExplicitIntegrator(Integrator):
    """Base class of integrators by leapfrog runs, alone or combined."""

    #: Largest number of combined runs; their number without a tolerance.
    n_runs: int
    #: Fixed step [s] and tolerance of positions [m]; None for none.
    step: float | None
    tolerance: float | None
    #: Work limit of a frame, as a multiple of real time by the plan's estimated cost; 0 for no limit.
    work: float

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        return leapfrog_limit(omega2, damping_rate)

    def advance(
        self, plan: Plan, state: State, t: float, duration: float, accumulator: WorkAccumulator | None = None
    ) -> Advance:
        """Advance a state, in place, by a duration [s] with explicit steps, or a fallback if these are abandoned.

        Explicit steps may be abandoned, because stable ones exceed the work limit or create energy. The frame then
        starts again. With contact and a tolerance, single runs within a reserve of work advance it. If that fails too,
        implicit steps do. Implicit steps are the only fallback without contact, or without a tolerance, or if bodies
        leave the cloth no room.

        Raises:
            UnstableError: if no choice is left and there is no fallback.
            StepLimitError: if a fixed step exceeds the limit at the start.
        """
        controller, start = Controller(self, plan, state, t, duration), state.shallow_copy()
        try:
            while not (is_finished := integrate(controller, state, start, t, duration, accumulator)):
                state.restore_motion(start)
                if not controller.has_explicit_fallback:
                    break
                controller.use_reserve()
        except BaseException as error:
            state.restore_motion(start)
            # No step is short enough if moving bodies left the cloth no space. A force in Python may raise anything.
            if not (isinstance(error, NoRoomError) and fallback.is_implicit_feasible(plan)):
                raise
            is_finished = False
        if is_finished:
            controller.store()
            return controller.report()
        state.restore_motion(start)
        # Implicit steps repeat the frame from its start.
        work = controller.work
        controller.store_bounds()
        limit = self.work * duration or math.inf
        result = fallback.finish_implicitly(
            plan,
            state,
            t,
            duration,
            accumulator,
            instead_of=self.name,
            max_evaluations=work.max_evaluations - work.used,
            max_time=CONSTANTS.implicit_finish_cost * limit,
        )
        return result._replace(
            evaluations=work.evaluations + result.evaluations,
            limit=controller.limit,
            rejected=controller.rejected,
            limited_by="work",
            error=result.error if self.tolerance is not None else None,
        )


def integrate(
    controller: Controller, state: State, start: State, t: float, duration: float, accumulator: WorkAccumulator | None
) -> bool:
    """Move the state through a frame, piece by piece; return False, before its end, if explicit steps are abandoned.

    Args:
        controller: chooses runs, steps and lengths.
        state: advanced in place.
        start: the state at the start of the frame.
        t: time at the start [s].
        duration: length of the frame [s].
        accumulator: work accumulator; None for none.
    """
    if accumulator is not None:
        accumulator.reset()
    elapsed, tableau = 0.0, None
    while elapsed < duration:
        piece = controller.choose_piece(t + elapsed)
        if piece is None:
            return False
        tableau = controller.tableau(t + elapsed, piece, tableau, accumulator)
        controller.run(tableau)
        if not controller.is_stable(tableau, piece):  # rule 1: stability, contact on the way included
            controller.reject_unstable(tableau, piece)
            continue
        error, allowed = controller.predict(tableau, piece), controller.allowed_error(piece)
        if controller.must_restart(needs_estimate=error > allowed):
            elapsed, tableau = 0.0, None
            state.restore_motion(start)
            controller.restart()
            if accumulator is not None:
                accumulator.reset()
            continue
        if error > allowed:  # rule 2: error; an estimate is due, or the prediction is unknown or does not fit
            n_runs = controller.n_runs
            error = controller.estimate(tableau, piece, allowed)
            if controller.n_runs != n_runs and not controller.is_stable(tableau, piece):
                controller.reject_unstable(tableau, piece)
                continue
            if error > allowed and controller.reject_inaccurate(piece):
                continue
        fits = error <= allowed and controller.options.tolerance is not None
        if not (fits or controller.check_energy(tableau)):  # rule 3: energy
            controller.reject_energy(piece)
            continue
        # Times of short pieces may round to the same number, so the next piece must not reuse these runs.
        elapsed, tableau = controller.accept(tableau, piece, error, allowed, accumulator), None
    return True
