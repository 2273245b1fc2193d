# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error estimate of a piece by further runs, and the number of runs that it confirms.

An estimate is the distance between two combinations of runs, so it may be small by chance. Later ones, of more runs,
confirm it.
"""

from __future__ import annotations

from collections.abc import Callable

import attrs

from cloth_sim_ros.physics.control.constants import CONSTANTS


@attrs.define
class ErrorEstimate:
    """Error estimates of a piece [m]: of 1, 2, ... combined runs, and at the ends of the piece."""

    is_rough: bool
    #: True if friction may jump. Runs then do not gain on one another, and the largest error counts for all.
    jumps: bool = False
    #: Errors of T_1, T_2, ... [m], and error that force jumps at the ends of the piece may cause [m].
    errors: list[float] = attrs.Factory(list)
    end_error: float = 0.0
    #: True if undamped waves of a single run may end alike in two runs. The largest error then is its error.
    may_coincide: bool = False
    #: Numbers of runs whose error is approximate; and errors [m] to which those of numbers of runs were raised.
    approximate: set[int] = attrs.Factory(set)
    raised: dict[int, float] = attrs.Factory(dict)
    #: True if single precision does not resolve the error of further runs, which may suffice.
    needs_double: bool = False

    def error(self, n_runs: int) -> float:
        """Return the estimated error of the combination of n_runs runs, that at the piece's ends included [m]."""
        return self.errors[n_runs - 1] + self.end_error

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

    def replace(self, n_runs: int, error: float) -> None:
        """Replace the approximate error of the combination of n_runs runs by an accurate one [m], not below a raise."""
        self.errors[n_runs - 1] = max(error, self.raised.get(n_runs, 0.0))
        self.approximate.remove(n_runs)

    def confirm(self, rounding_floor: Callable[[int], float], measure: Callable[[int], float]) -> None:
        """Raise errors that are small by chance, in place, because combinations of more runs have far larger ones.

        A later one that is approximate is measured first. In a rough motion all errors must fit instead.

        Args:
            rounding_floor: gives the rounding of an error [m] by its number of runs.
            measure: gives the accurate error [m] of a number of runs.
        """
        errors = self.errors
        for k in range(0 if self.is_rough else len(errors) - 1, 0, -1):
            trust_factor = 1.0 if self.may_coincide else CONSTANTS.estimate_trust_factor
            limit = trust_factor * max(errors[k - 1], rounding_floor(k + 1))
            if errors[k] > limit and k + 1 in self.approximate:
                self.replace(k + 1, measure(k + 1))
            if errors[k] > limit:
                errors[k - 1] = self.raised[k] = errors[k]

    def confirmed_runs(
        self, n_runs: int, allowed: float, rounding_floor: Callable[[int], float], measure: Callable[[int], float]
    ) -> int:
        """Return the number of runs whose accurate error fits a budget [m], see `sufficient_runs`.

        Args:
            n_runs: chosen number of runs.
            allowed: error budget [m].
            rounding_floor: gives the rounding of an error [m] by its number of runs.
            measure: gives the accurate error [m] of a number of runs.
        """
        # Where an approximate error suffices, the accurate one decides.
        while (sufficient := self.sufficient_runs(n_runs, allowed)) in self.approximate:
            self.replace(sufficient, measure(sufficient))
            self.confirm(rounding_floor, measure)
        return sufficient

    def sufficient_runs(self, n_runs: int, allowed: float) -> int:
        """Return the chosen number of runs if its error fits a budget [m], else the least that fits, else the chosen.

        If the motion is rough, the errors of all further runs must fit too.
        """
        fits = [error <= allowed for error in self.errors]
        if fits[n_runs - 1]:
            return n_runs
        n_confirming = len(fits) if self.is_rough else 0
        return next((k for k, fit in enumerate(fits, 1) if fit and all(fits[k - 1 : n_confirming])), n_runs)
