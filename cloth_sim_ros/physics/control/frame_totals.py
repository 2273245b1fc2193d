# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pieces of a frame, and the totals of those that were accepted."""

from __future__ import annotations

import math
from typing import NamedTuple

from cloth_sim_ros.physics.control.error import ErrorPrediction, ErrorSums
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau


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


class FrameTotals:
    """Totals over the accepted pieces of a frame: steps, errors, contact energy and error estimates."""

    #: Numbers of pieces and of steps of the result, smallest step and time with refined steps [s].
    n_pieces, steps, min_step, refined_time = 0, 0, math.inf, 0.0
    #: Largest multirate ratio, and true if the last runs used single precision.
    max_ratio, single_precision = 1, False
    #: Sums of errors and of errors of one run less [m], and true if a piece missed its budget.
    error, lower_order_error, has_missed = 0.0, 0.0, False
    #: Largest contact energy per mass, in U^2/2.
    contact_energy = 0.0
    #: Longest step that a rough piece suggests for the next frame [s], and its number of runs.
    longest_step, longest_runs = 0.0, 1
    #: Sums of estimates; None while pieces are accepted by predictions.
    sums: ErrorSums | None = None

    def add(
        self, tableau: ExtrapolationTableau, piece: Piece, n_runs: int, prediction: ErrorPrediction, error: float
    ) -> None:
        """Add an accepted piece, with its number of runs, its prediction and its error [m]."""
        self.n_pieces += 1
        self.steps += sum(tableau.counts[:n_runs])
        self.min_step, self.max_ratio = min(self.min_step, piece.step), max(self.max_ratio, piece.ratio)
        self.single_precision = tableau.single_precision
        self.error += error
        self.lower_order_error += prediction.lower_order_error
        self.contact_energy = max(self.contact_energy, prediction.contact_energy)

    def add_estimate(
        self, tableau: ExtrapolationTableau, prediction: ErrorPrediction, errors: list[float], error: float
    ) -> None:
        """Add an accepted piece's error estimates [m]: of 1, 2, ... combined runs, and of the chosen number."""
        changes = [tableau.change(k) for k in range(1, len(errors) + 1)]
        known = prediction.error, prediction.activity, tableau.jerk_change
        sums = ErrorSums(tableau.counts, tableau.duration, errors, changes, error, *known)
        if self.sums is None:
            self.sums = sums
        else:
            self.sums.add(sums)
