# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tuned constants of step control, integrator choice, cost model and sleep.

`make validate ARGS=constants` measures how half and double of each change error and work. Three kinds of numbers stay
beside their code because they are not tuned: coefficients of methods, including Newton's iteration; rounding errors;
halving and doubling.
"""

from __future__ import annotations

import attrs


def _number(value: float, meaning: str) -> float:
    field: float = attrs.field(default=value, metadata={"meaning": meaning})
    return field


@attrs.define(slots=False)
class Constants:
    """The table of tuned constants; only validation changes it."""

    # Stability.
    safety: float = _number(
        0.96, "fraction of the step limit that explicit steps take; the rest is a margin for stretching"
    )
    damped: float = _number(2.0, "decay of the fastest waves over a frame above which they count as damped")
    part: float = _number(0.04, "longest interval that is extrapolated at once [s]")

    # Error.
    share: float = _number(0.6, "fraction of the tolerance that the errors of one second may use")
    aim: float = _number(0.5, "fraction of its error budget, or of real time by explicit steps, that a frame aims at")
    wait: float = _number(16.0, "most frames between two error estimates; four times as many if the error is low")
    far: float = _number(0.05, "fraction of the budget below which an error is low")
    trust: float = _number(2.0, "factor by which an estimate may be wrong before it is renewed or acted upon")
    finer: float = _number(4.0, "largest refinement by one rejection")
    work: float = _number(
        8.0, "least work limit of a frame with a large sheet or contact, in runs with the longest stable steps"
    )

    # Contact.
    brief: float = _number(200.0, "least number of steps of an interval that contact may halve")

    # Single precision.
    rounding: float = _number(0.02, "fraction of the error budget that single precision may use")
    sample: float = _number(8.0, "steps of an interval over the steps of the sample run that measures single precision")
    motion: float = _number(
        1e3, "least displacement of the fastest particle in a frame, in changes by single precision"
    )

    # Energy.
    gain: float = _number(2e-3, "fraction of the moved energy that steps, or single precision in a second, may add")
    swing: float = _number(5e-3, "fraction of the moved energy by which a first frame's energy may rise")
    stiffened: float = _number(1.02, "relative stiffening above which energy is checked")

    # Implicit steps and the choice of integrator.
    last_steps: float = _number(8.0, "implicit steps of a frame that they finish")
    implicit: float = _number(5e4, "largest number of particles for which implicit steps are tried")

    # Estimated cost; no clock is read.
    operation: float = _number(0.05, "time of an arithmetic operation in the engine's loops [ns]")
    own: float = _number(100.0, "time of a force in Python [ns a particle]")
    factor: float = _number(0.35, "time of a multiply-add in the implicit method's factorisation [ns]")
    call: float = _number(25.0, "time of a call of the engine [us]; longer steps use a second thread")

    # Sleep.
    drift: float = _number(0.25, "fraction of the tolerance by which a cloth at rest may still move")
    calm: float = _number(1.0, "time at rest before a cloth falls asleep [s]")


#: The constants in use.
CONSTANTS = Constants()
