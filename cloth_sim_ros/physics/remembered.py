# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the rules of step control remember from one advance to the next: each its own few numbers, all in the state."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from operator import attrgetter
from typing import Any, ClassVar, Protocol, Self

import attrs
import numpy as np

from cloth_sim_ros.physics.constants import CONSTANTS


class HasMemory(Protocol):
    """A state, as far as this module knows it."""

    memory: dict[str, np.ndarray]


class Remembered:
    """Numbers that lie in ``State.memory`` under the name of their rule."""

    #: Name in ``State.memory``.
    key: str
    #: Names of its numbers, in order: attrs sets it.
    __match_args__: ClassVar[tuple[str, ...]]

    @classmethod
    def of(cls, state: HasMemory) -> Self:
        """Read them; fresh ones where the state has none."""
        stored = state.memory.get(cls.key)
        return cls() if stored is None or not stored.size else cls(*stored.tolist())

    def store(self, state: HasMemory) -> None:
        """Write them into a state."""
        state.memory[self.key] = np.array(_values(self.__class__)(self))  # type: ignore[arg-type]

    @classmethod
    def check(cls, array: np.ndarray) -> None:
        """Refuse numbers that could not have been written.

        Raises:
            ValueError: naming the number and what is wrong with it.
        """
        names = cls.__match_args__
        if not array.size:
            return
        if array.dtype != np.float64 or array.shape != (len(names),):
            raise ValueError(
                f"memory '{cls.key}' is of type {array.dtype} and shape {array.shape}; it must be float64 and "
                f"({len(names)},)"
            )
        for field, value in zip(attrs.fields(cls), array.tolist(), strict=True):  # type: ignore[arg-type]
            if not math.isfinite(value) or value < field.metadata.get("least", -math.inf):
                least = field.metadata.get("least", -math.inf)
                bound = "finite" if least == -math.inf else f"finite and at least {least:g}"
                raise ValueError(f"memory '{cls.key}': {field.name} is {value}; it must be {bound}")


@cache
def _values(rule: Any) -> Callable[[Any], Any]:
    """Return what reads all numbers of a rule, in order."""
    names = rule.__match_args__
    if len(names) > 1:
        return attrgetter(*names)
    return lambda remembered: (getattr(remembered, names[0]),)


def number(default: float, *, least: float = -math.inf) -> Any:
    """Declare a number and the least that it can be."""
    return attrs.field(default=default, metadata={"least": least})


@attrs.define
class Stability(Remembered):
    """What the rule of stability remembers."""

    key = "control.stability"

    #: Squared frequency [1/s^2] and damping rate [1/s] at the end of the last advance; negative when unknown.
    omega2: float = number(-1.0)
    damping: float = number(-1.0)
    #: Longest stable step since the last restart [s].
    longest: float = number(0.0, least=0.0)


@attrs.define
class Hinges(Remembered):
    """What is remembered of hinges, by scenes that have some alone."""

    key = "control.hinges"

    #: Bounds of their squared frequency [1/s^2] and damping rate [1/s] at the end of the last advance, and of the
    #: squared frequency across springs; negative when unknown.
    omega2: float = number(-1.0)
    damping: float = number(-1.0)
    across2: float = number(-1.0)
    #: Steps that an impulse of them stands for.
    every: float = number(1.0, least=1.0)
    #: Judgements since runs were combined last.
    since: float = number(CONSTANTS.wait, least=0.0)


@attrs.define
class Error(Remembered):
    """What the rule of the error remembers."""

    key = "control.error"

    #: Runs that are combined.
    columns: float = number(1.0, least=1.0)
    #: Step counts relative to what stability needs.
    refine: float = number(1.0, least=1.0)
    #: Frames until the next judgement by a further run; 0 judges now.
    wait: float = number(0.0, least=0.0)
    #: What `wait` restarts from.
    interval: float = number(1.0, least=1.0)
    #: Error of a frame when last judged, at least rounding's [m].
    error: float = number(0.0, least=0.0)
    #: That error relative to the difference of the last two combinations, and that difference [m].
    ratio: float = number(1.0, least=0.0)
    difference: float = number(0.0, least=0.0)
    #: What predictions are multiplied by: how far they were off lately.
    margin: float = number(1.0, least=1.0)
    #: Largest change of a velocity over the part that was judged [m/s]: how violent it was.
    activity: float = number(0.0, least=0.0)
    #: Length of the frames [s]; another length is judged anew.
    part: float = number(0.0, least=0.0)


@attrs.define
class Touch(Remembered):
    """What is remembered of contact, by scenes with obstacles alone."""

    key = "control.contact"

    #: Largest energy per mass that contact held in the frame that was judged last, in U^2/2.
    held: float = number(0.0, least=0.0)


@attrs.define
class Precision(Remembered):
    """What is known of single precision."""

    key = "control.precision"

    #: What it changes over a part [m], when last measured; negative when unknown.
    rounding: float = number(-1.0)


@attrs.define
class Noise(Remembered):
    """What is known of the energy that rounding in single precision puts into the motion; where it was measured."""

    key = "control.noise"

    #: Its power, the largest that was measured [W]; negative when unknown.
    power: float = number(-1.0)
    #: How often it was measured.
    samples: float = number(0.0, least=0.0)
    #: Kinetic energy when last judged, or half of what is remembered of the time before [J].
    kinetic: float = number(0.0, least=0.0)


@attrs.define
class Energy(Remembered):
    """What the rule of the energy remembers."""

    key = "control.energy"

    #: Least bound of the squared frequency since the last restart [1/s^2]: the sheet at its softest; negative at first.
    softest: float = number(-1.0)
    #: Energy that steps made since then and did not lose again [J].
    made: float = number(0.0, least=0.0)


@attrs.define
class Fallback(Remembered):
    """What the rule of the fallback remembers."""

    key = "control.fallback"

    #: Frames in a row that had to be finished by implicit steps.
    fallen: float = number(0.0, least=0.0)


@attrs.define
class Implicit(Remembered):
    """What the implicit method remembers."""

    key = "control.implicit"

    #: Length of its steps [s]; 0 when unknown.
    step: float = number(0.0, least=0.0)


@attrs.define
class Choice(Remembered):
    """What the choice of integrator rests on."""

    key = "control.choice"

    #: 0 explicit, 1 implicit.
    implicit: float = number(0.0, least=0.0)
    #: Cost of an implicit frame when last run [ns]; 0 unknown.
    cost: float = number(0.0, least=0.0)
    #: Frames until the next comparison.
    wait: float = number(0.0)
    #: Cost of an explicit frame at the stability limit when last compared [ns].
    explicit: float = number(0.0, least=0.0)
    #: Whether explicit steps missed the tolerance as well: implicit ones that miss it are then accepted until the next
    #: comparison.
    vain: float = number(0.0, least=0.0)


@attrs.define
class Sleep(Remembered):
    """What the rule of sleep remembers."""

    key = "control.sleep"

    #: Calm frames since it is watched.
    frames: float = number(0.0, least=0.0)
    #: Furthest that a particle got in the second that was watched last [m].
    moved: float = number(0.0, least=0.0)
    #: How long it slept, or sleeps, since then [s]; the frame at which it wakes by itself.
    slept: float = number(0.0, least=0.0)
    until: float = number(0.0, least=0.0)
    #: What sleep has left out since something touched the sheet, at most [m].
    used: float = number(0.0, least=0.0)


#: Name of friction's anchors, shape (obstacles, 4, particles); two rows more with friction between layers.
ANCHORS = "contact.anchors"
#: Of these rows: sides of the cloth on which a layer may lie.
LAYER_SIDES = 2
#: Name of where the pads of pinching grippers are, shape (pinches, 2): half the way between their faces [m], its rate.
PINCHED = "contact.pinched"
#: Name of the thickness of contacts [m] where some have a reduced one, shape (obstacles + 1, particles + 1): of each
#: obstacle, pads included, with each particle, and in the last row of the cloth with itself; the last column is of
#: obstacles' edges.
THICKNESS = "contact.thickness"
#: Name of whether it was told of each that its pads came to rest, shape (pinches,).
SETTLED = "contact.settled"
#: Names of what lies beside it, shape (3, particle_count): positions [m] at the start of the watched second, and
#: velocities [m/s] that a sheet fell asleep with.
SLEEP_ARRAYS = (SLEEP_FROM, SLEEP_VELOCITY) = ("control.sleep_from", "control.sleep_velocity")
#: What step control remembers.
RULES: tuple[type[Remembered], ...] = (
    Stability,
    Hinges,
    Error,
    Touch,
    Precision,
    Noise,
    Energy,
    Fallback,
    Implicit,
    Choice,
)
#: Names under which versions up to 0.1 kept what other rules remembered: it is not taken over.
BEFORE = ("stepper", "automatic", "sleep")


def restart(state: HasMemory, *, entirely: bool = False) -> None:
    """Forget everything: after an event the next advance judges its step, and `auto` its integrator, anew.

    A fixed step above the limit is refused where nothing is remembered, not even that something was forgotten: at the
    start of a run, and after a restart ``entirely``, for new parameters. Later it is made smaller.
    """
    for rule in RULES:
        if entirely:
            state.memory.pop(rule.key, None)
        elif rule.key in state.memory:
            state.memory[rule.key] = np.empty(0)
