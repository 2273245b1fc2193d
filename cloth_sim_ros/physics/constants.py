# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every tuned number of step control, choice of integrator, cost model and sleep.

`make validate ARGS=constants` measures the effect of half and double of each on error and work. Coefficients of
methods, those of Newton's iteration among them, are not tuned and stand with their method; so do roundings, which the
arithmetic sets, and halving and doubling.
"""

from __future__ import annotations

import attrs


def _number(value: float, meaning: str) -> float:
    field: float = attrs.field(default=value, metadata={"meaning": meaning})
    return field


@attrs.define(slots=False)
class Constants:
    """The table; a bench may set its numbers, nobody else does."""

    # Stability.
    safety: float = _number(0.96, "part of the step limit that explicit steps take, so that stretching has room")
    damped: float = _number(2.0, "decay of the fastest waves over a frame from which they count as damped")
    part: float = _number(0.04, "longest part of a frame that is extrapolated at once [s]")

    # Error.
    share: float = _number(0.6, "part of the tolerance that the frames of a second may lose")
    aim: float = _number(0.5, "part of what it may take that a frame aims at: of its budget, of real time explicitly")
    wait: float = _number(16.0, "most frames between two judgements; four times as many where the error is far below")
    far: float = _number(0.05, "part of the budget below which an error is far below")
    trust: float = _number(2.0, "factor by which an estimate may be off before it is made anew or acted upon")
    finer: float = _number(4.0, "most by which one rejection makes steps finer")
    work: float = _number(
        8.0, "least cap of a large sheet's frame, or one with contact, in runs by longest stable steps"
    )

    # Contact.
    brief: float = _number(200.0, "least steps of a stretch that is halved because contact makes them short")

    # Single precision.
    rounding: float = _number(0.02, "part of the budget that single precision may change")
    sample: float = _number(8.0, "part of a stretch's steps, as its inverse, by which single precision is judged")
    motion: float = _number(1e3, "least way of the fastest particle in a frame, in changes by single precision")

    # Energy.
    gain: float = _number(2e-3, "part of the moved energy that steps may make, or single precision in a second")
    swing: float = _number(5e-3, "part of the moved energy that a first frame may end above where it began")
    stiffened: float = _number(1.02, "stiffening from which energy is looked at")

    # Implicit steps and the choice of integrator.
    last_steps: float = _number(8.0, "steps of a frame that is finished by implicit steps")
    implicit: float = _number(5e4, "most particles of a sheet that implicit steps are tried for")

    # Estimated cost, so that no clock is read.
    operation: float = _number(0.05, "time of an arithmetic operation in the engine's loops [ns]")
    own: float = _number(100.0, "time of a force in numpy [ns a particle]")
    factor: float = _number(0.35, "time of a multiply-add in the implicit method's factorisation [ns]")
    call: float = _number(25.0, "time of a call of the engine [us]; a second thread takes part in steps from there on")

    # Sleep.
    drift: float = _number(0.25, "part of the tolerance within which a cloth at rest may still get")
    calm: float = _number(1.0, "time for which it must have been calm [s]")


#: The numbers in force.
CONSTANTS = Constants()
