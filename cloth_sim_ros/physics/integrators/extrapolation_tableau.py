# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Extrapolation tableau: leapfrog runs with several step counts, and their combinations.

The predicted midpoint velocity makes the leapfrog's error a series in h^2, h^3, h^4, ... Without damping it is a series
in h^2, h^4, ... (docs/derivations/time_stepping.md). K runs with step counts n_1 < ... < n_K are combined with weights
w that solve ``sum w = 1`` and ``sum w n^-p = 0``, p = 2 to K. The combination T_K has order K + 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from cloth_sim_ros.physics.accounting.end_corrections import accumulate_runs
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.arithmetic.arrays import combine, largest_distance
from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum, power
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.plan.runs import Run, RunSummary, activity_of
from cloth_sim_ros.physics.state.controller_state import JAWS_KEY, with_jaws
from cloth_sim_ros.physics.state.state import State

#: Step counts of the runs, relative to the first. Wider ratios cost more; closer ones amplify rounding and high modes:
#: the sums of |w| for 1 to 5 runs are 1, 4.6, 17.7, 32 and 55.
RATIOS = (1.0, 1.25, 1.5, 2.0, 2.5)
#: Time within which an error of a velocity displaces [s]: frames of one second share its error equally, so that on
#: average half of the second follows.
VELOCITY_ERROR_TIME = 0.5
#: Sums of the first 0, 1, 2, ... ratios.
RATIO_SUMS = tuple(sum(RATIOS[:columns]) for columns in range(len(RATIOS) + 1))


@lru_cache(maxsize=256)
def step_counts(first: int, n_runs: int = len(RATIOS), ratio: int = 1, *, coprime: bool = False) -> tuple[int, ...]:
    """Return the step counts of the tableau's runs, strictly increasing multiples of the multirate ratio.

    Args:
        first: step count of the first run.
        n_runs: number of runs.
        ratio: multirate ratio.
        coprime: true for counts without a common divisor but the ratio. Then no steps of two runs begin together within
            the interval; a force jump at such a time would change both runs alike.
    """
    counts = [first // ratio]
    for step_ratio in RATIOS[1:n_runs]:
        count = max(counts[-1] + 1, math.ceil(counts[0] * step_ratio - 1e-9))
        while coprime and any(math.gcd(count, previous) > 1 for previous in counts):
            count += 1
        counts.append(count)
    return tuple(ratio * count for count in counts)


@lru_cache(maxsize=16)
def rounding_amplification(n_runs: int) -> float:
    """Return the factor by which a combination of n_runs runs amplifies rounding: the sum of its weights' |w|."""
    # Twenty is the smallest first count whose step counts have exactly the ratios.
    return ordered_sum(abs(weight) for weight in weights(step_counts(20, n_runs)))


@lru_cache(maxsize=1024)
def weights(counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return the weights by which K runs with step counts n are combined to order K + 1: exact ratios, rounded once.

    Divided differences of 1, n, ..., n^(K - 2) vanish, and that of n^K is the sum of the n. Therefore the weights are
    ``w_i = n_i^K / (sum of n * product of n_i - n_j over j != i)``.
    """
    size, count_sum = len(counts), sum(counts)
    return tuple(n**size / (count_sum * math.prod(n - m for m in counts if m != n)) for n in counts)


@lru_cache(maxsize=1024)
def error_coefficient(counts: tuple[int, ...]) -> float:
    """Return the leading error's coefficient of K combined runs with step counts n: |sum of w n^-(K + 1)|.

    For an interval of length H the error is this coefficient times H^(K + 1), times what depends on the motion alone.
    """
    terms = [weight / n ** (len(counts) + 1) for weight, n in zip(weights(counts), counts, strict=True)]
    return abs(ordered_sum(terms))


def coefficient_of(counts: tuple[int, ...], length: float) -> float:
    """Return the error coefficient of K combined runs of a length [s]: `error_coefficient` times length^(K + 1)."""
    return error_coefficient(counts) * power(length, len(counts) + 1)


def max_rates(first: tuple[float, float], second: tuple[float, float]) -> tuple[float, float]:
    """Return the larger squared frequency [1/s^2] and the larger damping rate [1/s] of two such pairs."""
    return max(first[0], second[0]), max(first[1], second[1])


class ExtrapolationTableau:
    """Leapfrog runs over one interval and the combinations T_K of the first K of them; each query makes missing runs.

    Args:
        plan: equations of motion.
        start: state at the start; it is not changed.
        t: time at the start [s].
        duration: length of the interval [s].
        counts: step counts of the available runs.
        record_power: runs record the work of damping and wind.
        record_obstacles: runs record the work of obstacles.
        single_precision: runs use single precision.
        frame_time: length of the frame [s], within which errors of contact count, see `difference`.
        ratio: multirate ratio.
        before: velocities [m/s] at the start of the interval before, and its length [s]; None for none.
        expected_runs: expected number of runs, for prefetching; results do not depend on it.
    """

    def __init__(
        self,
        plan: Plan,
        start: State,
        t: float,
        duration: float,
        counts: Sequence[int],
        *,
        record_power: bool = False,
        record_obstacles: bool = False,
        single_precision: bool = False,
        frame_time: float = 0.0,
        ratio: int = 1,
        expected_runs: int = 0,
        before: tuple[Array, float] | None = None,
    ) -> None:
        self._plan, self._start, self.t, self.duration = plan, start, t, duration
        self._record_power, self._record_obstacles = record_power, record_obstacles
        self.counts = tuple(counts)
        self.single_precision, self.ratio = single_precision, ratio
        self._frame_time = frame_time
        self._expected_runs, self._before = expected_runs, before
        #: Force evaluations of the requested runs, and their number. Prefetched runs are not included.
        self.evaluations, self._n_requested = 0, 0
        self._runs: list[Run] = []
        self._combined: dict[int, tuple[Array, Array]] = {}
        self._summaries: dict[int, RunSummary] = {}
        self._changes: dict[int, tuple[float, float]] = {}
        self._end_memories: dict[int, dict[str, Array]] = {}
        self._distances: dict[int, float] = {}
        self._velocity_weight = VELOCITY_ERROR_TIME
        self._contact_summaries: dict[int, tuple[float, float, tuple[float, float]]] = {}

    def combine(self, n_runs: int) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s] at the end of n_runs combined runs, (3, n) each."""
        if n_runs not in self._combined:
            self._make_runs(n_runs)
            if n_runs not in self._combined:
                x, v = combine([run.end_state for run in self._runs[:n_runs]], weights(self.counts[:n_runs]))
                self._combined[n_runs] = x, v
        return self._combined[n_runs]

    def summary(self, n_runs: int) -> RunSummary:
        """Return the summary of n_runs combined runs: activity, spectral bounds and contact at their end."""
        if n_runs not in self._summaries:
            self._make_runs(n_runs)
            if n_runs not in self._summaries:
                self._summaries[n_runs] = self._summarize(n_runs)
        return self._summaries[n_runs]

    def _summarize(self, n_runs: int) -> RunSummary:
        """Calculate the summary of n_runs combined runs that the engine did not combine in one call."""
        x, v = self.combine(n_runs)
        # The motion of prescribed particles is given.
        free = self._plan.free_particles()
        change = largest_distance(v * free, self._start.v * free)
        activity = activity_of(change, self._runs[n_runs - 1].half_difference)
        if not (math.isfinite(largest_distance(x, self._start.x)) and math.isfinite(change)):
            activity = math.inf
        contact, contact_energy, self_contact = self._plan.contact, 0.0, (0.0, 0.0)
        if contact is not None:
            end, memory = self.t + self.duration, with_jaws(self._start.memory, self.jaws(n_runs))
            contact_energy = contact.predict_energy(end, 0.0, x, v, memory)
            self_contact = contact.predict_surface_contact(end, 0.0, x, v, memory)
            finest = self._runs[n_runs - 1].x
            if not contact_energy < math.inf or contact.ccd_surface_hits(end, 0.0, finest, x, memory):
                activity = math.inf
        omega2, damping, *hinge_bounds = self._plan.detailed_spectral_bounds(x, hinges=self.ratio > 1)
        turn = self._plan.turn_in_step(self._start.x, x, self.counts[0], n_runs)
        from_before = 0.0
        if self._before is not None:
            v0, ratio = self._start.v, self.duration / self._before[1]
            predicted = combine([v0, self._before[0]], (1.0 + ratio, -ratio))
            from_before = 0.25 * largest_distance(v * free, predicted * free)
        return RunSummary(activity, from_before, turn, omega2, damping, contact_energy, self_contact, hinge_bounds)

    @property
    def jerk_change(self) -> float:
        """Largest change of a particle's jerk from start to middle of the first run, times T²/4 [m/s]; 0 if unknown."""
        self._make_runs(1)
        return self._runs[0].jerk_change

    def friction_change(self, n_runs: int) -> tuple[Array, Array] | None:
        """Return the changes of friction over the interval, see `ContactBinding.friction_change`; None without any."""
        states = self._start.x, *self.combine(n_runs)
        contact, ends = self._plan.contact, self._runs[n_runs - 1].anchors
        if contact is None or ends is None:
            return None
        return contact.friction_change(self.t, self.duration, states, ends, self._start.memory)

    def contact_jerk_change(self, n_runs: int) -> Array | None:
        """Return changes of the jerk by contact [m/s^3], see `ContactBinding.jerk_change`; None without contact."""
        contact = self._plan.contact
        if contact is None:
            return None
        states = self._start.x, self._start.v, *self.combine(n_runs)
        return contact.jerk_change(self.t, self.duration, states, self._start.memory)

    def kink_velocities(self, n_runs: int) -> Array:
        """Return velocity changes that all runs may miss at kinks [m/s], see `PlanQueries.kink_velocities`."""
        plastic, start, lengths = self._plan.plastic, self._start, None
        if plastic is not None:
            end_memory = self._end_memory(n_runs)
            lengths = plastic.lengths_of(start.memory), plastic.lengths_of(end_memory)
        ends, step = self.combine(n_runs), self.duration / self.counts[0]
        return self._plan.kink_velocities((start.x, start.v), ends, lengths, self.duration, step)

    def kink_displacement(self, n_runs: int) -> float:
        """Return the displacement [m] by kinks of bending friction, see `PlasticLengths.kink_displacement`."""
        (x, v), plastic = self.combine(n_runs), self._plan.plastic
        ends = [run.plastic_lengths for run in self._runs[:n_runs] if run.plastic_lengths is not None]
        if plastic is None or not ends:
            return 0.0
        start, factors = self._start, weights(self.counts[:n_runs])
        lengths = plastic.lengths_of(start.memory), ends, combine(ends, factors)
        displacement = plastic.kink_displacement(
            (start.x, start.v), (x, v), lengths, self.duration / self.counts[0], self.counts[0], VELOCITY_ERROR_TIME
        )
        return displacement * ordered_sum(abs(factor) for factor in factors)

    def _plastic_difference(self, n_runs: int) -> float:
        """Return the displacement [m] by the change of plastic lengths if one run more is combined; 0 without any."""
        plastic, x = self._plan.plastic, self.combine(n_runs + 1)[0]
        if plastic is None:
            return 0.0
        ends = [run.plastic_lengths for run in self._runs[: n_runs + 1] if run.plastic_lengths is not None]
        more, fewer = (combine(ends[:k], weights(self.counts[:k])) for k in (n_runs + 1, n_runs))
        return plastic.displacement(x, more - fewer)

    def _stretch_difference(self, n_runs: int, known: float) -> float:
        """Return the displacement [m] by the change of anchor springs' stretches if one run more is combined.

        A stretch makes its particle vibrate. The velocity counts within a frame, because the next slip ends it.

        Args:
            n_runs: number of combined runs.
            known: displacement [m] up to which an upper limit suffices.
        """
        contact = self._plan.contact
        if contact is None or not contact.force.has_anchors:
            return 0.0
        (x, _), end, time = self.combine(n_runs + 1), self.t + self.duration, self._frame_time
        ends = [(self.combine(k)[0], {**self._start.memory, **self._end_memory(k)}) for k in (n_runs + 1, n_runs)]
        velocities = contact.force.frequency * contact.stretch_difference(end, ends)
        limit = time * largest_distance(velocities, np.zeros_like(velocities))
        if limit <= known:
            return limit
        displacement, evaluations = self._plan.velocity_displacement(end, x, velocities, time)
        self.evaluations += evaluations
        return displacement

    def change(self, n_runs: int) -> tuple[float, float]:
        """Return the largest changes of position [m] and velocity [m/s] if one run more than n_runs is combined."""
        if n_runs not in self._changes:
            (x, v), (y, w) = self.combine(n_runs + 1), self.combine(n_runs)
            self._changes[n_runs] = largest_distance(x, y), largest_distance(v, w)
        return self._changes[n_runs]

    def difference(self, n_runs: int) -> float:
        """Return the error estimate of n_runs combined runs [m]: the distance from the combination of one run more.

        It is the largest distance of a particle's positions, plus the displacement that the difference of velocities
        causes later. Slow waves keep that difference, fast ones lose it within a period. A jaw's half opening counts
        alike, and so do plastic lengths and the stretches of anchor springs.
        """
        if n_runs not in self._distances:
            distance, velocity_change = self.change(n_runs)
            displacement = 0.0
            if distance < math.inf:
                (x, v), (_, w), end = self.combine(n_runs + 1), self.combine(n_runs), self.t + self.duration
                displacement, evaluations = self._plan.velocity_displacement(end, x, v - w, VELOCITY_ERROR_TIME)
                self.evaluations += evaluations
                distance += self._plastic_difference(n_runs)
                distance += self._stretch_difference(n_runs, distance + displacement)
            if velocity_change:
                self._velocity_weight = displacement / velocity_change
            self._distances[n_runs] = max(distance + displacement, self._jaw_difference(n_runs))
        return self._distances[n_runs]

    def approximate_difference(self, n_runs: int) -> float:
        """Return the error estimate of n_runs combined runs [m] approximately, without force evaluations.

        Velocities displace in proportion to their difference, as in the last call of `difference`. It shows which runs
        are worth a try; the error of those that are taken is a `difference`.
        """
        distance, velocity_change = self.change(n_runs)
        return max(distance + self._velocity_weight * velocity_change, self._jaw_difference(n_runs))

    def jaws(self, n_runs: int) -> Array | None:
        """Return the jaw states (pinches, 2) at the end of n_runs combined runs; None without parallel grippers."""
        contact = self._plan.contact
        if contact is None or not contact.force.jaws:
            return None
        self._make_runs(n_runs)
        return contact.combine_jaws(self._runs[:n_runs], weights(self.counts[:n_runs]))

    def jaw_speed_change(self, n_runs: int) -> float:
        """Return the largest change of a jaw's speed over the interval [m/s]; 0 without parallel grippers."""
        start, end = self._start.memory.get(JAWS_KEY), self.jaws(n_runs)
        return 0.0 if start is None or end is None else float(np.abs(end[:, 1] - start[:, 1]).max())

    def _jaw_difference(self, n_runs: int) -> float:
        """Return the largest change of a jaw [m] if one run more is combined: half opening, or what speed displaces."""
        next_jaws, jaws = self.jaws(n_runs + 1), self.jaws(n_runs)
        if next_jaws is None or jaws is None:
            return 0.0
        differences = np.abs(next_jaws - jaws)
        return max(float(differences[:, 0].max()), float(differences[:, 1].max()) * VELOCITY_ERROR_TIME)

    def contact_summary(self, n_runs: int) -> tuple[float, float, tuple[float, float]]:
        """Return the largest contact energies and self-contact rates in the first n_runs runs; zeros without contact.

        Returns:
            Energy per mass, in U^2/2, that contact had to absorb, or would have had to in a completed approach; the
            largest one in a contact; squared frequency [1/s^2] and damping rate [1/s] of self-contact.
        """
        contact = self._plan.contact
        if contact is None:
            return 0.0, 0.0, (0.0, 0.0)
        if n_runs not in self._contact_summaries:
            self._make_runs(n_runs)
            energy, gap, rates = self._runs[0].contact_summary
            for run in self._runs[1:n_runs]:
                next_energy, next_gap, next_rates = run.contact_summary
                energy, gap, rates = max(energy, next_energy), min(gap, next_gap), max_rates(rates, next_rates)
            self._contact_summaries[n_runs] = energy, contact.contact_energy(gap), rates
        return self._contact_summaries[n_runs]

    def commit(self, n_runs: int, state: State) -> None:
        """Write the end of n_runs combined runs into a state: positions, velocities, and memory that runs change."""
        state.x, state.v = self.combine(n_runs)
        if not self._plan.has_end_memory:
            return
        state.memory |= self._end_memory(n_runs)

    def _end_memory(self, n_runs: int) -> dict[str, Array]:
        """Return the memory that runs change, at the end of n_runs combined runs."""
        if n_runs not in self._end_memories:
            self._make_runs(n_runs)
            (x, v), end = self.combine(n_runs), self.t + self.duration
            runs, run_weights = self._runs[:n_runs], weights(self.counts[:n_runs])
            self._end_memories[n_runs] = self._plan.combine_ends(end, x, v, runs, run_weights, self._start.memory)
        return self._end_memories[n_runs]

    def work(self, n_runs: int) -> float:
        """Return the external work on the cloth [J] over the interval, by n_runs combined runs.

        It is the work of grippers, and, if recorded, of obstacles, moving air and growing contact thickness.
        """
        grippers, obstacles = self._plan.gripper_count, self._plan.obstacle_count
        accumulator = WorkAccumulator(grippers, record_power=self._record_power, obstacle_count=obstacles)
        self.accumulate(n_runs, accumulator)
        return accumulator.work + accumulator.wind_work + accumulator.recovery_work

    def accumulate(self, n_runs: int, accumulator: WorkAccumulator) -> None:
        """Add the wrench and work integrals of n_runs combined runs to an accumulator."""
        self._make_runs(n_runs)
        runs, counts = self._runs[:n_runs], self.counts[:n_runs]
        accumulate_runs(accumulator, self._plan, self._start, self.t, self.duration, runs, counts, weights(counts))

    def _make_runs(self, n_runs: int) -> None:
        """Calculate those of the first n_runs runs that are missing; the first call also combines them.

        Expected runs are calculated with them if a second thread is idle, or if they are shorter than a further call.
        Such a run changes neither results nor counts before it is requested.
        """
        n_requested = self._n_requested
        if n_runs > n_requested:
            self.evaluations += sum(self.counts[n_requested:n_runs]) + n_runs - n_requested
            self._n_requested = n_runs
        n_existing = len(self._runs)
        if n_existing >= n_runs:
            return
        plan, concurrency = self._plan, 1
        # If the error is too large, the next choice often needs the next two runs. In contact it rarely does.
        is_next = n_existing > 0 and plan.threads_per_run(self.ratio) == 1 and not self._is_in_contact
        counts = self.counts[n_existing : max(n_runs, n_runs + 1 if is_next else self._expected_runs)]
        if len(counts) > 1:
            concurrency = plan.concurrent_runs(len(counts), sum(counts), self.ratio)
            if concurrency == 1 and sum(counts) > plan.evaluations_per_call:
                counts = self.counts[n_existing:n_runs]
        runs = self._execute(n_existing, counts, n_runs, concurrency)
        is_other_request = n_existing > n_requested or len(runs) > n_runs - n_existing > 0
        if n_existing > 0 and is_other_request and runs[0].repeated_without_culling:
            # Those runs are repeated together that are requested together.
            del self._runs[n_requested:]
            self._execute(n_requested, self.counts[n_requested:n_runs], n_runs, concurrency)

    @property
    def _is_in_contact(self) -> bool:
        """True if the last run was in contact."""
        contact = self._plan.contact
        return contact is not None and contact.contact_energy(self._runs[-1].min_gap) > 0.0

    def _execute(self, first: int, counts: Sequence[int], n_runs: int, concurrency: int) -> list[Run]:
        """Calculate and store runs from index ``first`` on in one engine call; if it is 0, also their combination."""
        runs, result = self._plan.runs(
            self.t,
            self.duration,
            (self._start.x, self._start.v),
            counts,
            weights=weights(self.counts[:n_runs]) if first == 0 else None,
            single_precision=self.single_precision,
            record_power=self._record_power,
            record_obstacles=self._record_obstacles,
            multirate=self.ratio,
            before=self._before,
            concurrency=concurrency,
            memory=self._start.memory,
        )
        self._runs.extend(runs)
        if result is not None:
            x, v, self._summaries[n_runs] = result
            self._combined[n_runs] = x, v
        return runs
