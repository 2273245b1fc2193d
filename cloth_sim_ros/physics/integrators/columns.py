# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Extrapolation tableau: leapfrog runs with several step counts, and their combinations.

The predicted midpoint velocity makes the leapfrog's error a series in h^2, h^3, h^4, ... Without damping it is a series
in h^2, h^4, ... (docs/time_stepping.md). K runs with step counts n_1 < ... < n_K are combined with weights w that
solve ``sum w = 1`` and ``sum w n^-p = 0``, p = 2 to K. The combination T_K has order K + 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cloth_sim_ros.physics.arrays import combine, largest_distance
from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.book_ends import note_runs
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.powers import in_order
from cloth_sim_ros.physics.runs import Run, Told
from cloth_sim_ros.physics.state import State

#: Step counts of the runs, relative to the first. Wider ratios cost more; closer ones amplify rounding and high modes:
#: the sums of |w| for 1 to 5 runs are 1, 4.6, 17.7, 32 and 70.
RATIOS = (1.0, 1.25, 1.5, 2.0, 2.5)
#: Sums of the first 0, 1, 2, ... ratios.
SUMS = tuple(sum(RATIOS[:columns]) for columns in range(len(RATIOS) + 1))


@lru_cache(maxsize=256)
def step_counts(first: int, columns: int, every: int = 1) -> tuple[int, ...]:
    """Return the step counts of the runs, strictly increasing multiples of the multirate ratio.

    Args:
        first: step count of the first run.
        columns: number of runs.
        every: multirate ratio.
    """
    counts = [first // every]
    for ratio in RATIOS[1:columns]:
        counts.append(max(counts[-1] + 1, math.ceil(counts[0] * ratio - 1e-9)))
    return tuple(every * count for count in counts)


@lru_cache(maxsize=16)
def amplification(columns: int) -> float:
    """Return the amplification of rounding by a combination of some runs: the sum of |w|."""
    # Twenty is the smallest first count whose step counts have exactly the ratios.
    return in_order(abs(weight) for weight in weights(step_counts(20, columns)))


@lru_cache(maxsize=1024)
def weights(counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return the weights of T_K for K runs of step counts n: exact ratios of integers, rounded once.

    Divided differences of 1, n, ..., n^(K - 2) vanish, and that of n^K is the sum of the n. Therefore the weights are
    ``w_i = n_i^K / (sum of n * product of n_i - n_j over j != i)``.
    """
    size, total = len(counts), sum(counts)
    return tuple(n**size / (total * math.prod(n - other for other in counts if other != n)) for n in counts)


def larger_rates(*rates: tuple[float, float]) -> tuple[float, float]:
    """Return the largest squared frequency [1/s^2] and the largest damping rate [1/s] of some pairs."""
    if rates.count(rates[0]) == len(rates):
        return rates[0]
    return max(omega2 for omega2, _ in rates), max(damping for _, damping in rates)


class Ran(NamedTuple):
    """A single run that already exists, with its request."""

    #: Positions at the start, time [s] and length [s].
    x: Array
    t: float
    duration: float
    #: Number of steps, True for single precision, and the multirate ratio.
    steps: int
    narrow: bool
    every: int
    #: Return value of `Plan.runs` for it.
    made: tuple[list[Run], tuple[Array, Array, Told] | None]


class Columns:
    """Leapfrog runs over one interval and their combinations T_K; runs are computed on demand.

    Args:
        plan: equations of motion.
        start: state at the start; it is not changed.
        t: time at the start [s].
        duration: length of the interval [s].
        counts: step counts of the available runs.
        powers: runs record the work of damping and wind.
        touches: runs record the work of obstacles.
        narrow: runs use single precision.
        omega: highest angular frequency [1/s], see `difference`.
        touched: the same with contact [1/s]: the inverse of the time over which a rebounding particle is followed.
        ran: an existing run, used if it equals the requested one.
        every: multirate ratio.
        likely: expected number of runs, for prefetching; results do not depend on it.
    """

    def __init__(
        self,
        plan: Plan,
        start: State,
        t: float,
        duration: float,
        counts: Sequence[int],
        *,
        powers: bool = False,
        touches: bool = False,
        narrow: bool = False,
        omega: float = math.inf,
        touched: float = math.inf,
        ran: Ran | None = None,
        every: int = 1,
        likely: int = 0,
    ) -> None:
        self._plan, self._start, self._t, self.duration = plan, start, t, duration
        self._powers, self._touches = powers, touches
        self.counts = tuple(counts)
        self.narrow, self.every = narrow, every
        self._omega, self._touched, self._ran = omega, touched, ran
        self._likely = likely
        #: Force evaluations of the requested runs, and their number. Prefetched runs are not included.
        self.evaluations, self._asked = 0, 0
        self._runs: list[Run] = []
        self._combined: dict[int, tuple[Array, Array]] = {}
        self._told: dict[int, Told] = {}
        self._met: dict[int, tuple[float, float, tuple[float, float]]] = {}

    def combine(self, columns: int) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s] of T_K, K = n_runs, each of shape (3, n)."""
        known = self._combined.get(columns)
        if known is None:
            self._make(columns)
            known = self._combined.get(columns)
        if known is None:
            factors, runs = weights(self.counts[:columns]), self._runs[:columns]
            known = combine([run.x for run in runs], factors), combine([run.v for run in runs], factors)
            self._combined[columns] = known
        return known

    def told(self, columns: int) -> Told:
        """Return the summary of T_K, K = n_runs: activity, spectral bounds and contact at its end."""
        told = self._told.get(columns)
        if told is None:
            x, v = self.combine(columns)
            told = self._told.get(columns)
        if told is None:
            activity = max(largest_distance(v, self._start.v), 0.0 * largest_distance(x, self._start.x))
            if not math.isfinite(largest_distance(x, self._start.x)):
                activity = math.inf
            contact, held, own = self._plan.contact, 0.0, (0.0, 0.0)
            if contact is not None:
                contact.lay_pads(self.pads(columns))
                end = self._t + self.duration
                held = contact.energy_ahead(end, 0.0, x, v)
                own = contact.own_ahead(end, 0.0, x, v)
                if not held < math.inf or contact.passes(end, 0.0, self._runs[columns - 1].x, x):
                    activity = math.inf
            omega2, damping, *hinges = self._plan.bounds(x, hinges=self.every > 1)
            told = Told(activity, omega2, damping, held, own, hinges)
            self._told[columns] = told
        return told

    def difference(self, columns: int) -> float:
        """Return the distance of T_(K+1) from T_K, K = n_runs [m]: the error estimate of T_K.

        It is the largest distance of a particle's positions, or of its velocities over the highest angular frequency.
        The error of an oscillation may be in its velocity alone. After contact a particle keeps its velocity error;
        then the velocities are divided by the lower frequency of contact.
        """
        (x, v), (y, w) = self.combine(columns + 1), self.combine(columns)
        omega = self._touched if self.held(columns + 1) else self._omega
        of_pads = self._difference_of_pads(columns)
        return max(largest_distance(x, y), largest_distance(v, w) / omega, of_pads)

    def pads(self, columns: int) -> Array | None:
        """Return the jaw states at the end of T_K, K = n_runs; None without parallel grippers."""
        contact = self._plan.contact
        if contact is None or not contact.force.pads:
            return None
        self._make(columns)
        return contact.combined_pads(self._runs[:columns], weights(self.counts[:columns]))

    def _difference_of_pads(self, columns: int) -> float:
        """Return the difference of half openings [m], or of their rates over the frequency of contact."""
        finer, here = self.pads(columns + 1), self.pads(columns)
        if finer is None or here is None:
            return 0.0
        away = np.abs(finer - here)
        return max(float(away[:, 0].max()), float(away[:, 1].max()) / self._touched)

    def reached(self, columns: int) -> float:
        """Return the energy per mass, in U^2/2, that contact had to absorb in the runs of T_K.

        For an approach that the runs did not complete, it is the energy that contact would have had to absorb.
        """
        return self._touched_in(columns)[0]

    def own(self, columns: int) -> tuple[float, float]:
        """Return squared frequency [1/s^2] and damping rate [1/s] of self-contact in the runs of T_K, K = n_runs."""
        return self._touched_in(columns)[2]

    def held(self, columns: int) -> float:
        """Return the largest contact energy per mass in the runs of T_K, K = n_runs, in U^2/2."""
        contact = self._plan.contact
        return 0.0 if contact is None else contact.held(self._touched_in(columns)[1])

    def _touched_in(self, columns: int) -> tuple[float, float, tuple[float, float]]:
        """Return the contact summary of the runs of T_K, see `Run.contact_summary`; cached."""
        if self._plan.contact is None:
            return 0.0, math.inf, (0.0, 0.0)
        met = self._met.get(columns)
        if met is None:
            self._make(columns)
            reached, gaps, own = zip(*(run.met for run in self._runs[:columns]), strict=True)
            met = self._met[columns] = max(reached), min(gaps), larger_rates(*own)
        return met

    def pass_on(self, columns: int, state: State) -> None:
        """Write the end of T_K, K = n_runs, into a state: positions, velocities, jaws and friction anchors."""
        state.x, state.v = self.combine(columns)
        contact = self._plan.contact
        if contact is None:
            return
        self._make(columns)
        contact.pass_on(state, self._t + self.duration, self._runs[:columns], weights(self.counts[:columns]))

    def work(self, columns: int) -> float:
        """Return the external work [J] over T_K, K = n_runs.

        It is the work of grippers, and, if recorded, of obstacles, moving air and growing contact thickness.
        """
        book = Book(self._plan.gripper_count, powers=self._powers, obstacle_count=self._plan.obstacle_count)
        self.note(columns, book)
        return book.work + book.given + book.recovered

    def note(self, columns: int, book: Book) -> None:
        """Accumulate T_K, K = n_runs; integrals along the runs are extrapolated with the weights of the state."""
        self._make(columns)
        runs, counts = self._runs[:columns], self.counts[:columns]
        note_runs(book, self._plan, self._start, self._t, self.duration, runs, counts, weights(counts))

    def _make(self, columns: int) -> None:
        """Compute the missing runs; if there is none yet, the engine combines them in the same call."""
        if columns > self._asked:
            self.evaluations += sum(self.counts[self._asked : columns]) + columns - self._asked
            self._asked = columns
        made = len(self._runs)
        if made >= columns:
            return
        if self._plan.contact is not None:
            self._plan.contact.take(self._start)
        whole = made == 0
        runs, result = (self._made(self.counts[:columns]) if whole else None) or self._run(made, columns)
        self._runs.extend(runs)
        if result is not None:
            x, v, self._told[columns] = result
            self._combined[columns] = x, v

    def _run(self, made: int, columns: int) -> tuple[list[Run], tuple[Array, Array, Told] | None]:
        """Compute runs, and prefetch the runs that are expected next if a second thread is idle.

        A prefetched run changes neither results nor counts before it is requested.
        """
        plan, steps = self._plan, self.counts[made:columns]
        ahead = self._likely
        if made and plan.threads(self.every) == 1:
            # If the error is too large, the next two runs are often necessary for the next choice.
            ahead = columns + 1
        more = self.counts[made : max(columns, ahead)]
        abreast = plan.abreast(len(more), sum(more), self.every) if len(more) > 1 else 1
        return plan.runs(
            self._t,
            self.duration,
            (self._start.x, self._start.v),
            more if abreast > 1 else steps,
            weights=weights(self.counts[:columns]) if made == 0 else None,
            narrow=self.narrow,
            powers=self._powers,
            touches=self._touches,
            every=self.every,
            abreast=abreast,
        )

    def _made(self, steps: tuple[int, ...]) -> tuple[list[Run], tuple[Array, Array, Told] | None] | None:
        """Return the result of the precomputed run if it equals the request, else None."""
        ran = self._ran
        if ran is None or steps != (ran.steps,) or ran.x is not self._start.x:
            return None
        asked = self._t, self.duration, self.narrow, self.every
        return ran.made if (ran.t, ran.duration, ran.narrow, ran.every) == asked else None
