# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pieces of a frame, and the totals of those that were accepted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import ChangeState


class Piece(NamedTuple):
    """Part of a frame that is accepted or rejected at once: its length, steps and multirate ratio."""

    #: Length H [s].
    length: float
    #: Steps of the first run, and multirate ratio.
    steps: int
    ratio: int
    #: Longest stable step by the bounds at the start of its stretch [s]; a shorter fixed step instead.
    max_step: float
    #: Equal pieces until its stretch ends, itself included.
    pieces_left: int

    @property
    def step(self) -> float:
        """Step size of the first run [s]."""
        return self.length / self.steps


class ErrorPrediction(NamedTuple):
    """Predicted errors of a piece [m], and the causes that the prediction used."""

    #: Errors of the combination and of one run less [m]; infinite if they are unknown.
    error: float = 0.0
    lower_order_error: float = 0.0
    #: Activity [m/s], see `runs.activity_of`.
    activity: float = 0.0
    #: Change of jerk by grippers' paths, see `GripBinding.jerk_change` [m/s].
    grip_jerk_change: float = 0.0
    #: Contact, friction and multirate hinges; None without contact and multirate hinges.
    contents: ChangeState | None = None


class FrameTotals:
    """Totals over the accepted pieces of a frame: steps, errors, contact and error estimates."""

    #: Numbers of pieces and of steps of the result, smallest step and time with refined steps [s].
    n_pieces, steps, min_step, refined_time = 0, 0, math.inf, 0.0
    #: Largest multirate ratio, and true if the last runs used single precision.
    max_ratio, single_precision = 1, False
    #: Sums of errors and of errors of one run less [m], and true if a piece missed its budget.
    error, lower_order_error, has_missed = 0.0, 0.0, False
    #: Contact, friction and multirate hinges of the pieces; None without contact and multirate hinges.
    contents: ChangeState | None = None
    #: Longest step that a rough piece suggests for the next frame [s], and its number of runs.
    longest_step, longest_runs = 0.0, 1
    #: Sum of predicted errors [m]; largest activity and change of jerk of a piece [m/s]; largest change of jerk by
    #: grippers' paths, over the square of the piece's length [m/s^3].
    predicted_error, activity, jerk_change, grip_jerk_change = 0.0, 0.0, 0.0, 0.0
    #: False while pieces are accepted by predictions. Each has an estimate then; False if a piece has other refinement,
    #: which makes the sums of estimates useless. The refinement.
    has_estimates, is_uniform, refinement = False, True, 1.0
    #: Step counts of the runs, and length [s], of the piece with the shortest steps.
    runs: tuple[tuple[int, ...], float] = (), 0.0
    #: Errors of T_1, T_2, ... [m], as many as all pieces have in common.
    errors: Sequence[float] = ()
    #: Changes of positions [m] and of velocities [m/s] from T_1 to T_2, from T_2 to T_3, ...
    changes: Sequence[tuple[float, float]] = ()
    #: Sums of the second differences of `RunDifferences` [m, m/s], (2, n); None if they are unknown.
    second_differences: Array | None = None

    def add(
        self, tableau: ExtrapolationTableau, piece: Piece, n_runs: int, prediction: ErrorPrediction, error: float
    ) -> None:
        """Add the steps, errors [m] and contact of a piece; `add_estimate` adds the predicted error."""
        self.n_pieces += 1
        self.steps += sum(tableau.counts[:n_runs])
        self.min_step, self.max_ratio = min(self.min_step, piece.step), max(self.max_ratio, piece.ratio)
        self.single_precision = tableau.single_precision
        self.error += error
        self.lower_order_error += prediction.lower_order_error
        if self.contents is None:
            self.contents = prediction.contents
        elif prediction.contents is not None:
            self.contents.include(prediction.contents)

    def add_estimate(
        self,
        tableau: ExtrapolationTableau,
        prediction: ErrorPrediction,
        errors: Sequence[float],
        refinement: float,
        second_differences: Array | None,
    ) -> None:
        """Add an accepted piece's error estimates [m] of 1, 2, ... combined runs, and its refinement.

        Args:
            tableau: runs of the piece.
            prediction: its predicted errors.
            errors: estimates of 1, 2, ... combined runs [m].
            refinement: refinement of its steps.
            second_differences: see `RunDifferences`; None if they are unknown.
        """
        runs, changes = (tableau.counts, tableau.duration), [tableau.change(k) for k in range(1, len(errors) + 1)]
        if self.has_estimates:
            self.is_uniform &= self.refinement == refinement
            # Predictions from the shortest steps overestimate the others.
            runs = min(self.runs, runs, key=lambda piece: piece[1] / piece[0][0])
            errors = [ordered_sum(pair) for pair in zip(self.errors, errors, strict=False)]
            changes = [(x + dx, v + dv) for (x, v), (dx, dv) in zip(self.changes, changes, strict=False)]
            if second_differences is not None and self.second_differences is not None:
                second_differences = self.second_differences + second_differences
        self.has_estimates, self.runs, self.errors, self.changes = True, runs, errors, changes
        self.refinement, self.second_differences = refinement, second_differences
        self.predicted_error += prediction.error
        self.activity = max(self.activity, prediction.activity)
        self.jerk_change = max(self.jerk_change, tableau.jerk_change)
        grip_jerk_change = prediction.grip_jerk_change / (tableau.duration * tableau.duration)
        self.grip_jerk_change = max(self.grip_jerk_change, grip_jerk_change)
