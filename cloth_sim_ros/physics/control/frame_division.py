# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Division of a frame into stretches, equal pieces and steps, and its estimated work.

A stretch is a part of the frame that is divided into equal pieces. It is the whole frame, or what halving or a rejected
rough piece has left. Times count from the start of the frame.
"""

from __future__ import annotations

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.frame_totals import Piece
from cloth_sim_ros.physics.control.stability import MAX_UNDAMPED_STEPS, StabilityRule
from cloth_sim_ros.physics.control.work_budget import WorkBudget
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIO_SUMS
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.physics.model.forces.force import EngineForce
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State

#: Shortest piece, relative to the frame; in a frame of 60 Hz it is a nanosecond.
_MIN_PIECE = 2.0**-24


class FrameDivision:
    """Division of a frame: elapsed time, ends of its stretches, and pieces, steps and work of a length.

    Args:
        plan: equations of motion.
        state: moves from piece to piece.
        t: time at the start of the frame [s].
        duration: of the frame [s].
        stability: requires refinements and pieces of combined runs.
        work: work budget of the frame.
        has_tolerance: True if errors are estimated.
    """

    __slots__ = (
        *("_duration", "_ends", "_has_external_work", "_has_tolerance", "_plan", "_stability", "_state", "_t", "_work"),
        *("elapsed", "is_rough", "multirate_refinement", "stretch"),
    )

    def __init__(
        self,
        plan: Plan,
        state: State,
        t: float,
        duration: float,
        stability: StabilityRule,
        work: WorkBudget,
        *,
        has_tolerance: bool,
    ) -> None:
        self._plan, self._state, self._t, self._duration = plan, state, t, duration
        self._stability, self._work, self._has_tolerance = stability, work, has_tolerance
        self._has_external_work: bool | None = None

    def restart(self, *, is_rough: bool) -> None:
        """Return to the start of the frame, in rough motion or not."""
        #: Time at which the next piece starts, and length of the stretch that was divided last [s].
        self.elapsed, self.stretch = 0.0, self._duration
        #: Ends of the frame and of the stretches that were halved [s]; that of the present stretch is the last.
        self._ends = [self._duration]
        #: True if a kink or a jump of a force requires short pieces. Refinement that the multirate ratio requires.
        self.is_rough, self.multirate_refinement = is_rough, 1.0

    # Stretches and pieces.

    @property
    def rest_of_stretch(self) -> float:
        """Time until the present stretch ends [s]; 0 at the end of the frame."""
        return self._ends[-1] - self.elapsed if self._ends else 0.0

    def end_of(self, piece: Piece) -> float:
        """Return the time at the end of a piece [s]; the last piece of a stretch ends exactly with it."""
        return self._ends[-1] if piece.pieces_left == 1 else self.elapsed + piece.length

    def accept(self, piece: Piece) -> None:
        """Move to the end of a piece."""
        self.elapsed = self._ends.pop() if piece.pieces_left == 1 else self.elapsed + piece.length

    def isolate(self, piece: Piece) -> None:
        """Make a stretch of a piece; the other pieces of its stretch become the next one."""
        if piece.pieces_left > 1:
            self._ends.append(self.elapsed + piece.length)

    def halve(self, length: float) -> None:
        """Make a stretch of the first half of a length [s]."""
        self._ends.append(self.elapsed + 0.5 * length)

    def is_long_enough(self, length: float) -> bool:
        """Return True if a piece may have a length [s]."""
        return length >= _MIN_PIECE * self._duration

    # Steps.

    def count_steps(self, n_runs: int, refinement: float, length: float, max_step: float) -> tuple[int, int]:
        """Return the number of steps of the first run over a length [s], and of the pieces to divide it into."""
        if self._has_tolerance:
            refinement = max(refinement, self.required_refinement(n_runs, length, max_step))
        steps = max(steps_for(length, max_step / refinement), MAX_UNDAMPED_STEPS if self.is_rough else 1)
        is_whole = n_runs == 1 and not self._has_tolerance
        n_pieces = 1 if is_whole else self._stability.n_pieces(n_runs, steps, length)
        return max(steps, self.min_steps(n_runs) * n_pieces), n_pieces

    def min_steps(self, n_runs: int) -> int:
        """Return the least number of steps of a piece's first run: 2 for a single run with a tolerance, else 1.

        The activity of a single run needs two halves.
        """
        return 2 if n_runs == 1 and self._has_tolerance else 1

    def required_refinement(self, n_runs: int, length: float, max_step: float) -> float:
        """Return the refinement of steps [s] that stability, the multirate ratio and the longest pieces [s] require.

        A lower one does not change the number of steps, thus not their error.
        """
        steps = self.min_steps(n_runs) * steps_for(length, CONSTANTS.max_interval)
        stable_refinement = self._stability.min_refinement(n_runs, length)
        return max(self.multirate_refinement, stable_refinement, steps * max_step / length)

    # Work.

    def rest_work(self, piece: Piece | None = None) -> float:
        """Return the estimated work of the frame after a piece, or after the stretch, in force evaluations."""
        end = self._ends[-1] if piece is None else self.elapsed + piece.length
        return self._work.rest_of(self._duration - end, len(self._ends))

    def attempt_work(self, n_runs: int, refinement: float, length: float, max_step: float) -> float:
        """Return the estimated work of an attempt over a length [s] with an error estimate, in force evaluations."""
        steps, n_pieces = self.count_steps(n_runs, refinement, length, max_step)
        # Where air or obstacles do work, the energy check of a piece that misses its budget repeats its runs.
        check = self._work.weight * steps * RATIO_SUMS[n_runs] if self._does_external_work() else 0.0
        return self._work.work_of(n_runs, steps, n_pieces) + check

    def fits(self, n_runs: int, refinement: float, piece: Piece) -> bool:
        """Return True if a further attempt of a piece fits the remaining work of the frame."""
        work = self.attempt_work(n_runs, refinement, piece.length, piece.max_step)
        return self._work.fits(work + self.rest_work(piece))

    def _does_external_work(self) -> bool:
        """Return True if Python forces, moving air or moving obstacles may do work on the cloth; cached."""
        if self._has_external_work is None:
            plan, state = self._plan, self._state
            self._has_external_work = (
                (plan.contact is not None and not plan.contact.force.steady())
                or any(not isinstance(force, EngineForce) for force in plan.model.forces)
                or plan.external_power(self._t, state.x, state.v, state.memory) != 0.0
            )
        return self._has_external_work

    def reduce_to_budget(
        self, n_runs: int, refinement: float, max_step: float, *, allows_second: bool
    ) -> tuple[int, float, float]:
        """Reduce runs and refinement to the work budget of the stretch; return them with the work of the frame's rest.

        The work, in force evaluations, exceeds the budget if even a single run of the longest stable steps [s] does.

        Args:
            n_runs: number of combined runs.
            refinement: refinement of their steps.
            max_step: longest stable step [s].
            allows_second: True if a second attempt, with finer steps, must fit too.
        """
        work, reserved = self._work, self.rest_work()

        def frame_work(n_runs: int, refinement: float) -> float:
            return reserved + self.attempt_work(n_runs, refinement, self.stretch, max_step)

        while n_runs > 1 and not work.fits(frame_work(n_runs, 1.0)):
            n_runs -= 1
        remaining = work.cap - work.used - reserved
        fitting = refinement * remaining / self.attempt_work(n_runs, refinement, self.stretch, max_step)
        if allows_second:
            fitting /= CONSTANTS.max_refinement_factor
        refinement = max(1.0, min(refinement, fitting))
        # Rounding up steps and pieces may exceed the remaining work.
        while refinement > 1.0 and not work.fits(frame_work(n_runs, refinement)):
            refinement = max(1.0, 0.5 * refinement)
        return n_runs, refinement, frame_work(n_runs, refinement)
