# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Extrapolation: one stretch of time run with several step counts, and the combinations that cancel their leading
errors.

The predicted midpoint velocity makes the leapfrog's error a series in h^2, h^3, h^4, ... (without damping in h^2,
h^4, ...; docs/time_stepping.md). K columns with step counts n_1 < ... < n_K are combined with the weights w that solve
``sum w = 1, sum w n^-p = 0`` for p = 2, ..., K: the combination T_K has order K + 1.
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

#: Step counts of the columns, relative to the first. Wider ones cost more, narrower ones amplify rounding and what
#: high modes do: the sums of |w| of the first 1 to 5 columns are 1, 4.6, 17.7, 32 and 70.
RATIOS = (1.0, 1.25, 1.5, 2.0, 2.5)
#: What the first 0, 1, 2, ... of them take together.
SUMS = tuple(sum(RATIOS[:columns]) for columns in range(len(RATIOS) + 1))


@lru_cache(maxsize=256)
def step_counts(first: int, columns: int, every: int = 1) -> tuple[int, ...]:
    """Return the columns' step counts for a first column of so many steps; each is larger than the one before, and a
    multiple of `every`, as the first is.
    """
    counts = [first // every]
    for ratio in RATIOS[1:columns]:
        counts.append(max(counts[-1] + 1, math.ceil(counts[0] * ratio - 1e-9)))
    return tuple(every * count for count in counts)


@lru_cache(maxsize=16)
def amplification(columns: int) -> float:
    """Return by how much a combination of so many columns amplifies rounding: the sum of |w|."""
    # Twenty steps are the fewest whose counts keep the ratios.
    return in_order(abs(weight) for weight in weights(step_counts(20, columns)))


@lru_cache(maxsize=1024)
def weights(counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return the weights of T_K for K columns of these step counts n: exact ratios of whole numbers, rounded once.

    Divided differences of 1, n, ..., n^(K - 2) vanish, and that of n^K is the sum of the n. So the weights that solve
    ``sum w = 1, sum w n^-p = 0`` are ``w_i = n_i^K / (sum of n * product of n_i - n_j over the others)``.
    """
    size, total = len(counts), sum(counts)
    return tuple(n**size / (total * math.prod(n - other for other in counts if other != n)) for n in counts)


def larger_rates(*rates: tuple[float, float]) -> tuple[float, float]:
    """Return the largest squared frequency and the largest damping rate of some pairs of both."""
    if rates.count(rates[0]) == len(rates):
        return rates[0]
    return max(omega2 for omega2, _ in rates), max(damping for _, damping in rates)


class Ran(NamedTuple):
    """A single run that was made already, and from what."""

    #: Positions at the start, time [s] and length [s].
    x: Array
    t: float
    duration: float
    #: Number of steps, whether it calculated in single precision, and how often it asked for hinges.
    steps: int
    narrow: bool
    every: int
    #: What the plan returned for it.
    made: tuple[list[Run], tuple[Array, Array, Told] | None]


class Columns:
    """The runs of one stretch of time, made as they are asked for.

    Args:
        plan: equations of motion.
        start: state at the start; it is not changed.
        t: time at the start [s].
        duration: length of the stretch [s].
        counts: step counts of the columns that may be asked for.
        powers: whether runs note what damping takes and wind gives.
        touches: whether they note what obstacles do.
        narrow: whether they calculate in single precision.
        omega: highest angular frequency [1/s], see `difference`.
        touched: the same where contact is [1/s]: one over the time for which what it throws off is looked ahead.
        ran: a run that is there, which is taken where it is the one that is missing.
        every: steps for which hinges are asked for once.
        likely: how many runs are likely to be asked for: no bit depends on it.
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
        #: Force evaluations of the runs that were asked for, and how many these are. More may be there.
        self.evaluations, self._asked = 0, 0
        self._runs: list[Run] = []
        self._combined: dict[int, tuple[Array, Array]] = {}
        self._told: dict[int, Told] = {}
        self._met: dict[int, tuple[float, float, tuple[float, float]]] = {}

    def combine(self, columns: int) -> tuple[Array, Array]:
        """Return positions and velocities of T_K, K = columns."""
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
        """Return how lively T_K, K = columns, is, and the bounds at its end."""
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
        """Return how far T_(K+1) is from T_K, K = columns [m]: the error of T_K.

        That is the largest distance of a particle's positions, or of its velocities over the highest angular frequency:
        the error of a wave that swings may lie in its velocity alone when it is looked at. What contact throws off
        flies on with the error of its velocity.
        """
        (x, v), (y, w) = self.combine(columns + 1), self.combine(columns)
        omega = self._touched if self.held(columns + 1) else self._omega
        of_pads = self._difference_of_pads(columns)
        return max(largest_distance(x, y), largest_distance(v, w) / omega, of_pads)

    def pads(self, columns: int) -> Array | None:
        """Return where pads are at the end of T_K, K = columns; None where no gripper pinches."""
        contact = self._plan.contact
        if contact is None or not contact.force.pads:
            return None
        self._make(columns)
        return contact.combined_pads(self._runs[:columns], weights(self.counts[:columns]))

    def _difference_of_pads(self, columns: int) -> float:
        """Return the same of half the ways between pads and their rates."""
        finer, here = self.pads(columns + 1), self.pads(columns)
        if finer is None or here is None:
            return 0.0
        away = np.abs(finer - here)
        return max(float(away[:, 0].max()), float(away[:, 1].max()) / self._touched)

    def reached(self, columns: int) -> float:
        """Return the energy per mass that contact had to take up in the runs of T_K, or would have had to, had they
        gone on as they came in; in U^2/2.
        """
        return self._touched_in(columns)[0]

    def own(self, columns: int) -> tuple[float, float]:
        """Return squared frequency [1/s^2] and damping rate [1/s] at which the cloth's contact with itself had to be
        followed in the runs of T_K, K = columns.
        """
        return self._touched_in(columns)[2]

    def held(self, columns: int) -> float:
        """Return the largest energy per mass that contact held in the runs of T_K, K = columns, in U^2/2."""
        contact = self._plan.contact
        return 0.0 if contact is None else contact.held(self._touched_in(columns)[1])

    def _touched_in(self, columns: int) -> tuple[float, float, tuple[float, float]]:
        """Return what the runs of T_K met, see `Run.met`: asked for again and again, and read once."""
        if self._plan.contact is None:
            return 0.0, math.inf, (0.0, 0.0)
        met = self._met.get(columns)
        if met is None:
            self._make(columns)
            reached, gaps, own = zip(*(run.met for run in self._runs[:columns]), strict=True)
            met = self._met[columns] = max(reached), min(gaps), larger_rates(*own)
        return met

    def pass_on(self, columns: int, state: State) -> None:
        """Let a state end as T_K, K = columns, does: its positions, velocities, pads and friction's anchors."""
        state.x, state.v = self.combine(columns)
        contact = self._plan.contact
        if contact is None:
            return
        self._make(columns)
        contact.pass_on(state, self._t + self.duration, self._runs[:columns], weights(self.counts[:columns]))

    def work(self, columns: int) -> float:
        """Return the work [J] that grippers did over T_K, K = columns; obstacles, air and contacts that regain their
        thickness too where these are noted.
        """
        book = Book(self._plan.gripper_count, powers=self._powers, obstacle_count=self._plan.obstacle_count)
        self.note(columns, book)
        return book.work + book.given + book.recovered

    def note(self, columns: int, book: Book) -> None:
        """Note T_K, K = columns: what was noted along the runs is extrapolated as the state is."""
        self._make(columns)
        runs, counts = self._runs[:columns], self.counts[:columns]
        note_runs(book, self._plan, self._start, self._t, self.duration, runs, counts, weights(counts))

    def _make(self, columns: int) -> None:
        """Make the runs that are missing; all at once, and combined, where none is there yet."""
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
        """Make runs from one on, and those that are likely to be asked for next where another thread can take them
        meanwhile: of what nobody asks for nothing is seen, nor counted.
        """
        plan, steps = self._plan, self.counts[made:columns]
        ahead = self._likely
        if made and plan.threads(self.every) == 1:
            # Where an error is too large it often takes the next two runs to tell what would do.
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
        """What was returned for the run that is there, where it is the one of these steps."""
        ran = self._ran
        if ran is None or steps != (ran.steps,) or ran.x is not self._start.x:
            return None
        asked = self._t, self.duration, self.narrow, self.every
        return ran.made if (ran.t, ran.duration, ran.narrow, ran.every) == asked else None
