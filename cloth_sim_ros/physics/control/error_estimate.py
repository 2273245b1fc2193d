# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error estimate of a piece by further runs, and the number of runs that suffices.

The estimate of a combination T_K is its distance from T_(K+1), so it may be small by chance. Later ones, of more runs,
confirm it. Three loops append estimates:

- `begin`: up to the chosen combination, or further if its own estimate is not reliable.
- `extend`: while a further run may meet the target with less work.
- `sufficient_runs`: until a later estimate confirms a new touch.
"""

from __future__ import annotations

import attrs

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.error import ErrorRule, displacement_by_velocities
from cloth_sim_ros.physics.control.force_jump import EVALUATIONS, missed_velocity_changes
from cloth_sim_ros.physics.control.frame_totals import Piece
from cloth_sim_ros.physics.control.precision import PrecisionRule
from cloth_sim_ros.physics.control.work_budget import WorkBudget
from cloth_sim_ros.physics.integrators.extrapolation_tableau import VELOCITY_ERROR_TIME, ExtrapolationTableau
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State

#: Largest number of force evaluations of a displacement by velocities.
_DISPLACEMENT_EVALUATIONS = 9


@attrs.define
class ErrorEstimate:
    """Error estimates of a piece [m]: of the combinations T_1, T_2, ... of its runs, and at its ends."""

    #: Runs of the piece.
    tableau: ExtrapolationTableau
    piece: Piece
    #: Rule that chooses runs and steps by errors, and the work budget that counts evaluations.
    rule: ErrorRule
    work: WorkBudget
    #: Chosen number of combined runs, and error budget of the piece [m].
    chosen_runs: int
    allowed: float
    #: The pieces of a stretch share the rounding error of one run, because it cancels over them: the piece's share.
    rounding_fraction: float = 1.0
    is_rough: bool = False
    #: True if friction may jump. Runs then do not gain on one another, and the largest error counts for all.
    jumps: bool = False
    #: True if undamped waves of a single run may end alike in two runs. The largest error then is its error.
    may_coincide: bool = False
    #: Errors of T_1, T_2, ... [m], and error that force jumps at the ends of the piece may cause [m].
    errors: list[float] = attrs.Factory(list)
    end_error: float = 0.0
    #: Numbers of runs whose error is approximate; and errors [m] to which those of numbers of runs were raised.
    approximate: set[int] = attrs.Factory(set)
    raised: dict[int, float] = attrs.Factory(dict)
    #: True if single precision does not resolve the error of further runs, which may suffice.
    needs_double: bool = False

    @property
    def target(self) -> float:
        """Error at which further runs or finer steps aim [m]."""
        return CONSTANTS.error_target_fraction * self.allowed

    def error(self, n_runs: int) -> float:
        """Return the estimated error of the combination of n_runs runs, that at the piece's ends included [m]."""
        return self.errors[n_runs - 1] + self.end_error

    def rounding_floor(self, n_runs: int) -> float:
        """Return the error estimate of n_runs combined runs that rounding alone causes [m]."""
        return self.rule.rounding_floor(n_runs, self.piece.steps, self.rule.target(self.piece.length))

    def choose_runs(self, refinement: float, target: float) -> tuple[int, float]:
        """Return number of runs and refinement that meet a target [m] with the fewest evaluations.

        Args:
            refinement: refinement of the estimated runs.
            target: aimed error [m].
        """
        length, steps = self.piece.length, self.piece.steps
        fraction = self.rounding_fraction
        return self.rule.choose_runs(self.errors, refinement, target, length, steps, rounding_fraction=fraction)

    # Loops.

    def begin(self, n_estimates: int) -> None:
        """Estimate the errors of the first n_estimates combinations; that of the chosen one is accurate."""
        if self.chosen_runs > 1 and not self.is_rough:
            self._measure(self.chosen_runs)  # its displacement by velocities scales the approximate ones
        while len(self.errors) < n_estimates:
            self._estimate_next()

    def extend(self, refinement: float, reserved: float, precision: PrecisionRule) -> bool:
        """Estimate further combinations while they may meet the target with less work.

        Args:
            refinement: refinement of the runs, that of stability included.
            reserved: work of the rest of the frame, in force evaluations.
            precision: tells if single precision resolves a further error.

        Returns:
            False if single precision did not resolve the error of a further combination.
        """
        errors = self.errors
        while len(errors) < self.rule.max_runs and errors[-1] > self.target:
            if errors[-1] <= self.allowed and not self._may_gain(refinement):
                break
            is_affordable = self.work.fits(reserved + self.work.weight * self.tableau.counts[len(errors) + 1])
            # If runs do not gain on one another, as at a force jump, a further run does not either.
            is_useless = len(errors) > 1 and errors[-1] > errors[-2]
            if is_useless or not is_affordable:
                break
            if self.tableau.single_precision and not precision.resolves_error(len(errors) + 2):
                return False
            self._estimate_next()
        return True

    def sufficient_runs(self, *, is_touch: bool = False) -> int:
        """Return the number of runs whose accurate error fits the budget, see `_first_fitting`.

        Args:
            is_touch: True if new contact needs a further estimate that confirms the last one.
        """
        n_runs = self._accurate_runs()
        while is_touch and n_runs == len(self.errors) < self.rule.max_runs and not self.needs_double:
            self._estimate_next()
            self.confirm()
            n_runs = self._accurate_runs()
        return n_runs

    # Estimates.

    def _estimate_next(self) -> None:
        """Estimate the error of the next combination; approximately if it is not the chosen one."""
        n_runs = len(self.errors) + 1
        # A wrong approximation costs a run.
        is_cheap = n_runs > self.chosen_runs and self.tableau.counts[n_runs] > _DISPLACEMENT_EVALUATIONS
        is_accurate = self.is_rough or n_runs == self.chosen_runs or is_cheap
        self.append(self._measure(n_runs, is_accurate=is_accurate), is_approximate=not is_accurate)

    def _may_gain(self, refinement: float) -> bool:
        """Return True if one run more than those of the estimates may meet the target with less work."""
        n_runs, next_refinement = self.choose_runs(refinement, self.target)
        return self.rule.may_gain(len(self.errors) + 1, n_runs, next_refinement, self.piece.length)

    def _measure(self, n_runs: int, *, is_accurate: bool = True) -> float:
        """Return the error estimate of the combination of n_runs runs [m], and count its work."""
        tableau = self.tableau
        evaluations = tableau.evaluations
        error = tableau.difference(n_runs) if is_accurate else tableau.approximate_difference(n_runs)
        self.work.add(tableau.evaluations - evaluations, self.work.weight)
        return error

    def append(self, error: float, *, is_approximate: bool = False) -> None:
        """Append the estimated error [m] of the next combination, of one run more; rough motion may raise it.

        If the motion is rough, an estimate may be small by chance. Then it counts as at least what the gain of the
        combination before it makes plausible. At a jump the largest estimate counts for all combinations.
        """
        errors = self.errors
        if is_approximate:
            self.approximate.add(len(errors) + 1)
        if self.is_rough and errors:
            gain = errors[-1] / errors[-2] if len(errors) > 1 and errors[-2] else CONSTANTS.first_gain
            error = max(error, errors[-1] * gain * gain)
        if self.jumps:
            error = max(error, *errors, 0.0)
            errors[:] = [error] * len(errors)
        errors.append(error)

    def confirm(self) -> None:
        """Raise errors that are small by chance, because combinations of more runs have far larger ones.

        A later one that is approximate is measured first. In rough motion it raises nothing, because
        combinations amplify the error of a jump. An estimate beyond the largest number of runs only confirms.
        """
        errors, trust_factor = self.errors, 1.0 if self.may_coincide else CONSTANTS.estimate_trust_factor
        for k in range(0 if self.is_rough else len(errors) - 1, 0, -1):
            limit = trust_factor * max(errors[k - 1], self.rounding_floor(k + 1))
            if errors[k] > limit and k + 1 in self.approximate:
                self._replace(k + 1)
            if errors[k] > limit:
                errors[k - 1] = self.raised[k] = errors[k]
        del errors[self.rule.max_runs :]

    def _replace(self, n_runs: int) -> None:
        """Replace the approximate error of the combination of n_runs runs by an accurate one, not below a raise."""
        self.errors[n_runs - 1] = max(self._measure(n_runs), self.raised.get(n_runs, 0.0))
        self.approximate.remove(n_runs)

    def _accurate_runs(self) -> int:
        """Return the number of runs by `_first_fitting`, after its error was measured if it was approximate."""
        while (n_runs := self._first_fitting()) in self.approximate:
            self._replace(n_runs)
            self.confirm()
        return n_runs

    def _first_fitting(self) -> int:
        """Return the chosen number of runs if its error fits the budget, else the least that fits, else the chosen.

        In rough motion another number fits only if the errors of all further runs fit too.
        """
        fits = [error <= self.allowed for error in self.errors]
        if fits[self.chosen_runs - 1]:
            return self.chosen_runs
        n_confirming = len(fits) if self.is_rough else 0
        return next((k for k, fit in enumerate(fits, 1) if fit and all(fits[k - 1 : n_confirming])), self.chosen_runs)

    # Ends of the piece.

    def add_end_error(self, plan: Plan, start: State, n_runs: int) -> None:
        """Add the error that a force jump in the first or last half step of n_runs runs may cause; count its work.

        Args:
            plan: equations of motion.
            start: state at the start of the piece.
            n_runs: number of combined runs that gives the state at its end.
        """
        end, half_step, t = start.shallow_copy(), 0.5 * self.piece.step, self.tableau.t
        self.tableau.commit(n_runs, end)
        for state, time, duration in ((start, t, -half_step), (end, t + self.piece.length, half_step)):
            changes, jaw_change = missed_velocity_changes(plan, state, time, duration)
            self.end_error += displacement_by_velocities(plan, self.work, time, state.x, changes)
            self.end_error += VELOCITY_ERROR_TIME * jaw_change
            self.work.add(EVALUATIONS)
