# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tuned constants of step control, integrator choice, cost model and sleep.

`make validate ARGS=constants` measures how half and double of each change error and work. Three kinds of numbers stay
beside their code because they are not tuned: coefficients of methods, including Newton's iteration; rounding errors;
halving and doubling.
"""

from __future__ import annotations

import attrs


def _constant(value: float, meaning: str) -> float:
    field: float = attrs.field(default=value, metadata={"meaning": meaning})
    return field


@attrs.define(slots=False)
class Constants:
    """Table of the tuned constants of step control, each with its meaning; only validation changes it."""

    # Stability.
    stability_safety: float = _constant(
        0.96, "fraction of the step limit that explicit steps take; the rest is a margin for stretching"
    )
    damped_wave_decay: float = _constant(
        2.0, "decay of the fastest waves over a frame above which they count as damped"
    )
    long_piece_preference: float = _constant(
        4.0, "factor on the steps of short pieces up to which a long one costs less, because pieces add their rounding"
    )
    max_interval: float = _constant(0.04, "longest interval that is extrapolated at once [s]")

    # Error.
    error_budget_fraction: float = _constant(0.8, "fraction of the tolerance that the errors of one second may use")
    error_target_fraction: float = _constant(
        0.5, "fraction of its error budget, or of real time by explicit steps, that a frame aims at"
    )
    max_estimate_period: float = _constant(
        0.25, "longest time between two error estimates [s]; four times as long if the error is low"
    )
    error_growth_time: float = _constant(
        0.2, "time after an estimate in which the error of combined runs may become four times as large [s]"
    )
    low_error_fraction: float = _constant(0.05, "fraction of the budget below which an error is low")
    estimate_trust_factor: float = _constant(
        2.0, "factor by which an estimate may be wrong before it is renewed or acted upon"
    )
    min_ordered_steps: float = _constant(6.0, "steps of a run from which on its error grows with its order")
    max_refinement_factor: float = _constant(4.0, "largest refinement by one rejection")
    steady_fraction: float = _constant(
        1e-5, "fraction of the velocity change of an interval that counts as activity even if it was predicted"
    )
    first_gain: float = _constant(0.1, "plausible gain of two combined runs over one in a rough motion")
    hidden_gain: float = _constant(
        0.03, "plausible gain of one run more for a particle whose difference of runs the last estimate did not contain"
    )
    max_turn: float = _constant(0.25, "largest angle by which a spring may turn in a step of a smooth motion [rad]")
    smooth_turn: float = _constant(
        0.015, "angle by which a spring may turn in a step without a change of jerk that the activity misses [rad]"
    )
    max_failed_attempts: float = _constant(12.0, "attempts of a piece after which steps without a work limit fail")
    min_work_cap: float = _constant(
        8.0, "least work limit of a frame with a large sheet or contact, in runs with the longest stable steps"
    )

    run_change_cost: float = _constant(
        1.1, "factor on the work of another number of runs, because the next frame needs an estimate then"
    )
    multirate_pause: float = _constant(16.0, "error estimates without multirate hinges after a combination of runs")

    # Contact.
    contact_min_interval_steps: float = _constant(200.0, "least number of steps of an interval that contact may halve")

    # Single precision.
    single_precision_budget_fraction: float = _constant(0.06, "fraction of the error budget for single precision")
    single_precision_sample_divisor: float = _constant(
        8.0, "steps of an interval over the steps of the sample run that measures single precision"
    )
    single_precision_min_motion: float = _constant(
        1e3, "least displacement of the fastest particle in a frame, in changes by single precision"
    )

    single_precision_min_particles: float = _constant(
        64.0, "number of particles from which steps are faster in single precision"
    )

    # Energy.
    max_energy_gain: float = _constant(
        2e-3, "fraction of the moved energy that steps, or single precision in a second, may add"
    )
    max_energy_oscillation: float = _constant(5e-3, "fraction of the moved energy that a first frame may add")
    energy_check_stiffening: float = _constant(1.02, "relative stiffening above which energy is checked")

    # Implicit steps and the choice of integrator.
    implicit_finish_steps: float = _constant(8.0, "implicit steps of a frame that they finish")
    implicit_finish_cost: float = _constant(
        4.0, "longest time of implicit steps that finish a frame, by estimated cost, in work limits"
    )
    implicit_max_particles: float = _constant(5e4, "largest number of particles for which implicit steps are tried")

    comparison_period: float = _constant(16.0, "frames between two comparisons of integrators")

    # Estimated cost; no clock is read.
    operation_time: float = _constant(0.05, "time of an arithmetic operation in the engine's loops [ns]")
    python_force_time: float = _constant(100.0, "time of a force in Python [ns a particle]")
    factorization_time: float = _constant(0.35, "time of a multiply-add in the implicit method's factorisation [ns]")
    engine_call_time: float = _constant(25.0, "time of a call of the engine [us]; longer steps use a second thread")

    # Sleep.
    sleep_drift_fraction: float = _constant(0.25, "fraction of the tolerance by which a cloth at rest may still move")
    sleep_quiet_time: float = _constant(1.0, "time at rest before a cloth falls asleep [s]")


#: The constants in use.
CONSTANTS = Constants()
