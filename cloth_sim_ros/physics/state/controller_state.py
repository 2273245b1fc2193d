# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Controller state: the numbers that step control keeps in ``State.memory`` between advances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from operator import attrgetter
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, Self, TypeAlias

import attrs
import numpy as np

from cloth_sim_ros.physics.control.constants import CONSTANTS


class HasMemory(Protocol):
    """Protocol of a state with `memory`, a dictionary of named arrays."""

    memory: dict[str, np.ndarray]


class ControllerState:
    """Base class of the numbers that one controller keeps in ``State.memory``, as an array under `key`."""

    #: Key in ``State.memory``.
    key: str
    #: Field names, in the order of the array; attrs sets it.
    __match_args__: ClassVar[tuple[str, ...]]

    @classmethod
    def load(cls, state: HasMemory) -> Self:
        """Return an instance with the numbers from a state's memory; with defaults if they are missing or empty."""
        stored = state.memory.get(cls.key)
        return cls() if stored is None else cls(*stored.tolist())  # an empty array gives defaults, too

    def store(self, state: HasMemory) -> None:
        """Write the numbers into a state's memory, as a new array under `key`."""
        state.memory[self.key] = np.array(_value_getter(self.__class__)(self))  # type: ignore[arg-type]

    @classmethod
    def check(cls, array: np.ndarray) -> None:
        """Raise ValueError if `store` cannot have written an array: type, shape, or a number out of range.

        Raises:
            ValueError: naming the number and its fault.
        """
        names = cls.__match_args__
        if not array.size:
            return
        fields: tuple[Any, ...] = attrs.fields(cls)  # type: ignore[arg-type]
        n_first = len([field for field in fields if not field.metadata["is_later"]])
        if array.dtype != np.float64 or array.ndim != 1 or not n_first <= len(array) <= len(names):
            raise ValueError(
                f"memory '{cls.key}' is of type {array.dtype} and shape {array.shape}; it must be float64 and "
                f"({len(names)},)"
            )
        for field, value in zip(fields, array.tolist(), strict=False):
            minimum = field.metadata["minimum"]
            if not math.isfinite(value) or value < minimum:
                bound = "finite" if minimum == -math.inf else f"finite and at least {minimum:g}"
                raise ValueError(f"memory '{cls.key}': {field.name} is {value}; it must be {bound}")


@cache
def _value_getter(rule: Any) -> Callable[[Any], Any]:
    """Return a function that reads all fields of a controller state as a tuple, in the order of the array."""
    names = rule.__match_args__
    if len(names) > 1:
        return attrgetter(*names)
    return lambda instance: (getattr(instance, names[0]),)


def bounded_number(default: float, *, minimum: float = -math.inf, is_later: bool = False) -> Any:
    """Declare an attrs field with a minimum that `check` enforces; a later field may be missing in older states."""
    return attrs.field(default=default, metadata={"minimum": minimum, "is_later": is_later})


@attrs.define
class StabilityState(ControllerState):
    """State of `StabilityRule`: spectral bounds after the last advance, and the longest stable step."""

    key = "control.stability"

    #: Bounds of squared frequency [1/s^2] and damping rate [1/s] at the end of the last advance; negative if unknown.
    omega2: float = bounded_number(-1.0)
    damping: float = bounded_number(-1.0)
    #: Longest stable step since the last restart [s].
    max_step: float = bounded_number(0.0, minimum=0.0)


@attrs.define
class MultirateState(ControllerState):
    """State of `MultirateRule`: spectral bounds of hinges and multirate ratio; only scenes with hinges have it."""

    key = "control.hinges"

    #: Bounds of the hinges' squared frequency [1/s^2] and damping rate [1/s] at the end of the last advance, and of the
    #: squared frequency across springs [1/s^2]; negative if unknown.
    omega2: float = bounded_number(-1.0)
    damping: float = bounded_number(-1.0)
    transverse_omega2: float = bounded_number(-1.0)
    #: Multirate ratio: steps per evaluation of hinges.
    ratio: float = bounded_number(1.0, minimum=1.0)
    #: Error estimates since runs were last combined.
    estimates_since_combination: float = bounded_number(CONSTANTS.multirate_pause, minimum=0.0)


@attrs.define
class ErrorState(ControllerState):
    """State of `ErrorRule`: number of runs, refinement, last error estimate, and time until the next one."""

    key = "control.error_estimate"

    #: Number of runs that are combined.
    n_runs: float = bounded_number(1.0, minimum=1.0)
    #: Refinement: step counts relative to those that stability needs.
    refinement: float = bounded_number(1.0, minimum=1.0)
    #: Time until a further run estimates the error again [s]; 0 means now.
    time_until_estimate: float = bounded_number(0.0, minimum=0.0)
    #: Estimate period: `time_until_estimate` after the next estimate [s].
    estimate_period: float = bounded_number(0.0, minimum=0.0)
    #: Last error estimate of a frame, at least the rounding error, and that of one run less [m].
    error: float = bounded_number(0.0, minimum=0.0)
    lower_order_error: float = bounded_number(0.0, minimum=0.0)
    #: Time within which a change of velocities by the last run counted in the lower-order error [s].
    velocity_weight: float = bounded_number(0.0, minimum=0.0)
    #: Longest step of that frame [s].
    step: float = bounded_number(0.0, minimum=0.0)
    #: Error coefficients of the runs of that frame and of one run less, [s] to the power of their orders.
    coefficient: float = bounded_number(0.0, minimum=0.0)
    lower_order_coefficient: float = bounded_number(0.0, minimum=0.0)
    #: Factor on predicted errors, from the ratio of recent estimates to their predictions.
    safety_factor: float = bounded_number(1.0, minimum=1.0)
    #: Largest activity over a part whose error was estimated [m/s], see `runs.activity_of`.
    activity: float = bounded_number(0.0, minimum=0.0)
    #: Length of the frames [s]; a frame of another length needs a new estimate.
    duration: float = bounded_number(0.0, minimum=0.0)
    #: Largest change of jerk over a part whose error was estimated [m/s], see `Run.jerk_change`.
    jerk_change: float = bounded_number(0.0, minimum=0.0, is_later=True)
    #: Largest change of jerk by grippers' paths, see `GripBinding.jerk_change`, over the square of the part's length
    #: [m/s^3].
    grip_jerk_change: float = bounded_number(0.0, minimum=0.0, is_later=True)
    #: Sum of accelerations by small changes of uniform forces since the last estimate [m/s^2].
    force_change: float = bounded_number(0.0, minimum=0.0, is_later=True)
    #: Largest change of a particle's velocity by the last run in the last frame with an estimate [m/s]; 0 if unknown.
    velocity_change: float = bounded_number(0.0, minimum=0.0, is_later=True)

    def count_force_change(self, acceleration: float, tolerance: float | None) -> None:
        """Count a small change of forces; the next advance estimates its error if the changes may matter.

        They always matter to combined runs. A force per mass that changes by a excites vibrations of the amplitude
        a/w^2. The phase of a single run errs by w^3 h^2/24 a second. So it errs by a h/12 a second at most, because
        w h <= 2.

        Args:
            acceleration: change of acceleration [m/s^2].
            tolerance: error tolerance [m]; None for none.
        """
        self.force_change += acceleration
        target = CONSTANTS.error_target_fraction * CONSTANTS.error_budget_fraction * (tolerance or math.inf)
        if self.n_runs > 1.0 or self.force_change * self.step > 12.0 * target:
            self.time_until_estimate = 0.0


@attrs.define
class ChangeState(ControllerState):
    """State of `ChangeRule`: contact, friction and hinges that the last frame with an error estimate contained."""

    key = "control.changes"

    #: Largest contact energy per mass, in U^2/2.
    contact_energy: float = bounded_number(0.0, minimum=0.0)
    #: Largest velocity of a stuck particle that vibrates along a surface [m/s].
    vibration: float = bounded_number(0.0, minimum=0.0)
    #: Largest velocity error of a run by the change of a particle's jerk by contact, or by multirate hinges [m/s].
    jerk_error: float = bounded_number(0.0, minimum=0.0)

    def include(self, further: ChangeState) -> None:
        """Raise the numbers to those of a further state that are larger."""
        self.contact_energy = max(self.contact_energy, further.contact_energy)
        self.vibration = max(self.vibration, further.vibration)
        self.jerk_error = max(self.jerk_error, further.jerk_error)


@attrs.define
class PrecisionState(ControllerState):
    """State of the choice of precision: measured effect of single precision on positions [m]."""

    key = "control.single_precision"

    #: Change of positions over a frame [m]; negative if unknown.
    rounding: float = bounded_number(-1.0)
    #: Later displacement by the velocity change that all particles have in common [m].
    common_rounding: float = bounded_number(0.0, minimum=0.0)
    #: Largest component of velocities at the measurements [m/s].
    speed: float = bounded_number(0.0, minimum=0.0)
    #: Largest distance of a particle from the first one along an axis at the measurements [m].
    reach: float = bounded_number(0.0, minimum=0.0, is_later=True)


@attrs.define
class RoundingNoiseState(ControllerState):
    """Measured power that rounding in single precision adds to the cloth [W]; absent until it was measured."""

    key = "control.noise"

    #: Largest measured power [W]; negative if unknown.
    power: float = bounded_number(-1.0)
    #: Number of measurements.
    n_samples: float = bounded_number(0.0, minimum=0.0)
    #: Kinetic energy at the last error estimate, or half of the previous value if that is larger [J].
    kinetic_energy: float = bounded_number(0.0, minimum=0.0)


@attrs.define
class EnergyState(ControllerState):
    """State of `EnergyRule`: energy drift [J] and least squared frequency since the last restart."""

    key = "control.energy"

    #: Smallest bound of the squared frequency since the last restart [1/s^2]; negative at first.
    min_omega2: float = bounded_number(-1.0)
    #: Energy drift: energy that steps have created since then and not lost again [J].
    energy_drift: float = bounded_number(0.0, minimum=0.0)


@attrs.define
class FallbackState(ControllerState):
    """State of the fallback: number of consecutive frames that fallback steps had to finish."""

    key = "control.fallback"

    #: Consecutive frames that fallback steps had to finish.
    fallback_count: float = bounded_number(0.0, minimum=0.0)


@attrs.define
class ImplicitState(ControllerState):
    """State of the implicit method: its step size [s]."""

    key = "control.implicit"

    #: Step size [s]; 0 if unknown.
    step: float = bounded_number(0.0, minimum=0.0)


@attrs.define
class IntegratorChoiceState(ControllerState):
    """State of integrator `auto`: explicit or implicit steps, and the costs that were last compared."""

    key = "control.choice"

    #: 1 if the implicit method is in use, else 0.
    is_implicit: float = bounded_number(0.0, minimum=0.0)
    #: Cost of the last implicit frame [ns]; 0 if unknown.
    implicit_cost: float = bounded_number(0.0, minimum=0.0)
    #: Frames until the next comparison.
    frames_until_comparison: float = bounded_number(0.0)
    #: Cost of an explicit frame at the stability limit at the last comparison [ns].
    explicit_cost: float = bounded_number(0.0, minimum=0.0)
    #: 1 if explicit steps missed the tolerance too, else 0. Implicit steps that miss it are then accepted until the
    #: next comparison.
    explicit_also_failed: float = bounded_number(0.0, minimum=0.0)


@attrs.define
class SleepState(ControllerState):
    """State of the sleep rule: quiet frames, displacement, time asleep, and drift omitted by sleep."""

    key = "control.sleep"

    #: Consecutive quiet frames.
    quiet_frames: float = bounded_number(0.0, minimum=0.0)
    #: Largest displacement of a particle in the last observed second, or twice that in one of its halves [m].
    max_displacement: float = bounded_number(0.0, minimum=0.0)
    #: Time asleep since then [s]; the frame at which the sheet wakes without an event.
    sleep_time: float = bounded_number(0.0, minimum=0.0)
    wake_frame: float = bounded_number(0.0, minimum=0.0)
    #: Upper bound of the drift that sleep has omitted since the last external change [m].
    drift_used: float = bounded_number(0.0, minimum=0.0)


#: Key of friction anchors, shape (obstacles, 4, particles); two rows more with friction between layers.
ANCHORS_KEY = "contact.anchors"
#: Number of these rows: one for each side of the cloth.
LAYER_SIDES = 2
#: Key of the jaw states of parallel grippers, shape (grippers, 2): half opening [m] and its rate [m/s].
JAWS_KEY = "contact.pinched"
#: Key of the setpoints of parallel grippers, see `ContactControls.jaw_setpoints`; present once one is commanded.
SETPOINTS_KEY = "contact.setpoints"
#: Key of contact thicknesses [m], present while some are reduced, shape (obstacles + 1, particles + 1). Rows: each
#: obstacle, jaws included; the last row is self-contact. Columns: each particle; the last one is obstacle edges.
THICKNESS_KEY = "contact.thickness"
#: Key of the points of joints in the frames of their obstacles [m], shape (joints, 3).
JOINTS_KEY = "joint.offsets"
#: Key of the plastic lengths of hinges with friction [m], shape (hinges,).
PLASTIC_LENGTHS_KEY = "bending.plastic_lengths"
#: Named arrays of a state, `State.memory`. Forces of contact depend on its anchors, jaws and thickness, friction of
#: bending on its plastic lengths.
StateMemory: TypeAlias = Mapping[str, np.ndarray]
#: Default of queries, which a plan with contact or friction of bending refuses.
MISSING_MEMORY: StateMemory = MappingProxyType({})
#: Key of flags, shape (grippers,): True once the jaws are reported to be at rest.
JAWS_AT_REST_KEY = "contact.settled"
#: Keys of the arrays of sleep, shape (3, particle_count): positions [m] at the start and at the middle of the observed
#: second; velocities [m/s] of a sleeping sheet at its wake frame, and their change in a frame [m/s].
SLEEP_KEYS = (SLEEP_POSITIONS_KEY, SLEEP_MIDDLE_KEY, SLEEP_VELOCITIES_KEY, SLEEP_IMPULSES_KEY) = (
    "control.sleep_from",
    "control.sleep_middle",
    "control.sleep_velocity",
    "control.sleep_impulse",
)
#: Key of the velocities [m/s] at the start of the last frame, shape (3, particle_count).
PREVIOUS_VELOCITIES_KEY = "control.velocities"
#: Key of the differences of positions [m] and velocities [m/s] between the combination of the chosen runs and that of
#: one run less, over the coefficient of their error, in the last one or two pieces, (pieces, 2, 3, particle_count).
RUN_DIFFERENCES_KEY = "control.run_differences"
#: Key of the lengths of their second differences in the last frame with an estimate, shape (2, particle_count).
SECOND_DIFFERENCES_KEY = "control.second_differences"
#: Keys of step control with numbers for each particle.
PARTICLE_KEYS = PREVIOUS_VELOCITIES_KEY, RUN_DIFFERENCES_KEY, SECOND_DIFFERENCES_KEY
#: Controller states that belong to step control.
STEP_CONTROL_STATES: tuple[type[ControllerState], ...] = (
    StabilityState,
    MultirateState,
    ErrorState,
    ChangeState,
    PrecisionState,
    RoundingNoiseState,
    EnergyState,
    FallbackState,
    ImplicitState,
    IntegratorChoiceState,
)
#: Keys of earlier versions; their content is dropped.
LEGACY_KEYS = (
    "stepper",
    "automatic",
    "sleep",
    "control.error",
    "control.precision",
    "control.earlier_velocities",
    "control.particle_changes",
    "control.contact",
)


def with_jaws(memory: StateMemory, jaws: np.ndarray | None) -> StateMemory:
    """Return a new memory of a state with other jaw states, (pinches, 2); the memory itself if these are None."""
    return memory if jaws is None else {**memory, JAWS_KEY: jaws}


def drift_jaws(memory: StateMemory, duration: float) -> StateMemory:
    """Return a memory whose jaws moved at their speeds for a duration [s], which may be negative."""
    jaws = memory.get(JAWS_KEY)
    if jaws is None:
        return memory
    return with_jaws(memory, np.stack([jaws[:, 0] + duration * jaws[:, 1], jaws[:, 1]], axis=1))


def count_force_change(state: HasMemory, acceleration: float, tolerance: float | None) -> None:
    """Count a small change of uniform forces in a state, see `ErrorState.count_force_change`."""
    error = ErrorState.load(state)
    error.count_force_change(acceleration, tolerance)
    error.store(state)


def reset_step_control(state: HasMemory, *, entirely: bool = False) -> None:
    """Reset a state's step control after an event: the next advance estimates its error, `auto` compares integrators.

    Args:
        state: its controller states become empty arrays.
        entirely: remove the arrays too. A fixed step above the limit is then refused, as at the start of a run;
            otherwise it is made smaller.
    """
    for controller in STEP_CONTROL_STATES:
        if entirely:
            state.memory.pop(controller.key, None)
        elif controller.key in state.memory:
            state.memory[controller.key] = np.empty(0)
    for key in PARTICLE_KEYS:
        state.memory.pop(key, None)
