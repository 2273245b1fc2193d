# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Factors of a study: named distributions, sampled by their quantile functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import attrs

from cloth_sim_ros.scene.parameters.unknown_parameters import suggestion
from cloth_sim_ros.studies.errors import StudyError

#: Limit of the number of values of a list or of `steps`.
MAX_CHOICES = 1_000_000
#: Standard deviations of a normal distribution beyond which no sample is.
_MAX_DEVIATIONS = 9.0
#: Range of whole numbers in the index.
_MIN_INTEGER, _MAX_INTEGER = -(2**63), 2**63 - 1


@attrs.frozen(kw_only=True)
class Factor:
    """Varied quantity of a study, and the distribution of its values."""

    #: Full name of a parameter, `name[i]` for an array's entry, `target.<gripper>.x` and the like, or `policy.<name>`.
    name: str
    #: Distribution, one of `KINDS`.
    kind: str
    #: Arguments of the distribution: the choices, or two or three numbers.
    values: tuple[Any, ...]

    @property
    def count(self) -> int | None:
        """Number of possible values; None if they are continuous or unbounded."""
        if self.kind == "choices":
            return len(self.values)
        if self.kind == "steps":
            return int(self.values[2])
        return int(self.values[1] - self.values[0]) + 1 if self.kind == "integers" else None

    def value(self, quantile: float) -> Any:
        """Return the value at a quantile of the distribution, from 0 to 1."""
        return KINDS[self.kind][1](self.values, min(max(quantile, 0.0), 1.0))

    def at(self, index: int) -> Any:
        """Return the possible value at an index from 0 to `count` - 1, of a factor whose `count` is not None."""
        if self.kind == "choices":
            return self.values[index]
        if self.kind == "integers":
            return int(self.values[0]) + index
        return _steps_at(self.values, index)

    def ends(self) -> list[Any]:
        """Return the values to check: all choices, or both ends of a range; none of a normal distribution."""
        if self.kind == "choices":
            return list(self.values)
        return [] if self.kind == "normal" else [self.value(0.0), self.value(1.0)]


def _choice(values: tuple[Any, ...], quantile: float) -> Any:
    return values[min(int(quantile * len(values)), len(values) - 1)]


def _steps_at(values: tuple[Any, ...], index: int) -> float:
    low, high, count = float(values[0]), float(values[1]), int(values[2])
    return high if index == count - 1 else low + (high - low) * (index / (count - 1))


def _steps(values: tuple[Any, ...], quantile: float) -> float:
    return _steps_at(values, min(int(quantile * values[2]), int(values[2]) - 1))


def _uniform(values: tuple[Any, ...], quantile: float) -> float:
    return float(values[1]) if quantile == 1.0 else float(values[0]) + (float(values[1]) - float(values[0])) * quantile


def _log_uniform(values: tuple[Any, ...], quantile: float) -> float:
    low, high = float(values[0]), float(values[1])
    # Clip rounding errors to the range.
    return min(max(math.exp(math.log(low) + (math.log(high) - math.log(low)) * quantile), low), high)


def _normal(values: tuple[Any, ...], quantile: float) -> float:
    from scipy.special import ndtri

    # The quantiles 0 and 1 of a normal distribution are infinite.
    clipped = min(max(quantile, 2.0**-53), 1.0 - 2.0**-53)
    return float(values[0]) + float(values[1]) * float(ndtri(clipped))


def _integers(values: tuple[Any, ...], quantile: float) -> int:
    low, high = int(values[0]), int(values[1])
    return min(low + int(quantile * (high - low + 1)), high)


#: Distributions: description of the arguments, and the quantile function.
KINDS: dict[str, tuple[str, Callable[[tuple[Any, ...], float], Any]]] = {
    "choices": ("a list of values", _choice),
    "steps": ("[lowest, highest, how many]", _steps),
    "uniform": ("[lowest, highest]", _uniform),
    "log_uniform": ("[lowest, highest], both above 0", _log_uniform),
    "normal": ("[mean, standard deviation]", _normal),
    "integers": ("[lowest, highest], whole numbers, both included", _integers),
}


def read(name: str, content: Any) -> Factor:
    """Return the factor of an entry of `vary`: a list, or e.g. ``{uniform: [0.1, 0.3]}``. Raises StudyError.

    Raises:
        StudyError: if the entry is invalid; the text names entry and problem.
    """
    if isinstance(content, list):
        content = {"choices": content}
    if not isinstance(content, Mapping) or len(content) != 1:
        known = ", ".join(f"{{{kind}: {takes}}}" for kind, (takes, _) in KINDS.items() if kind != "choices")
        raise StudyError(f"vary: '{name}' is {content!r}; give a list of values, or one of {known}")
    ((kind, entries),) = content.items()
    if kind not in KINDS:
        known = f"{', '.join(KINDS)}{suggestion(str(kind), KINDS)}"
        raise StudyError(f"vary: '{name}' has the unknown distribution '{kind}'; known are {known}")
    if not isinstance(entries, list) or not entries:
        problem = "is empty" if entries == [] else f"has {entries!r}"
        raise StudyError(f"vary: '{name}' {problem}; {kind} takes {KINDS[kind][0]}")
    if len(entries) > MAX_CHOICES:
        raise StudyError(f"vary: '{name}' has {len(entries)} values; at most {MAX_CHOICES}")
    if kind == "choices":
        for value in entries:
            if not _is_storable(value):
                limits = "numbers must be finite, and whole ones from -2^63 to 2^63 - 1"
                raise StudyError(f"vary: '{name}' has {str(value)[:40]}, which a run's row can't hold; {limits}")
        return Factor(name=name, kind=kind, values=tuple(tuple(v) if isinstance(v, list) else v for v in entries))
    return Factor(name=name, kind=kind, values=_parse_numbers(name, kind, entries))


def _is_storable(value: Any) -> bool:
    """Return True if JSON and an Arrow table can hold a value: null, bool, number, text, or list or dict of them."""
    if isinstance(value, list):
        return all(map(_is_storable, value))
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_storable(entry) for key, entry in value.items())
    if isinstance(value, bool | str | None):
        return True
    return isinstance(value, int | float) and _is_in_range(value)


def _is_in_range(value: float) -> bool:
    """Return True for a finite float, and for a whole number of 64 bits."""
    return _MIN_INTEGER <= value <= _MAX_INTEGER if isinstance(value, int) else math.isfinite(value)


def _parse_numbers(name: str, kind: str, entries: list[Any]) -> tuple[Any, ...]:
    n_expected = 3 if kind == "steps" else 2
    is_integer = kind == "integers"
    for value in entries:
        is_number = isinstance(value, int if is_integer else int | float) and not isinstance(value, bool)
        if not (is_number and _is_in_range(value)):
            raise StudyError(f"vary: '{name}' has {str(value)[:40]}; {kind} takes {KINDS[kind][0]}")
    if len(entries) != n_expected:
        raise StudyError(f"vary: '{name}' has {len(entries)} numbers, {entries}; {kind} takes {KINDS[kind][0]}")
    low, high = entries[:2]
    if kind == "normal":
        if high <= 0:
            raise StudyError(f"vary: '{name}' has the standard deviation {high}; it must be above 0")
        if not math.isfinite(abs(float(low)) + _MAX_DEVIATIONS * float(high)):
            raise StudyError(f"vary: '{name}' has the standard deviation {high}, beyond a double's range")
        return tuple(entries)
    if not low < high:
        order = "the lowest comes first and is below the highest (a single value belongs into 'parameters')"
        raise StudyError(f"vary: '{name}' has the empty range from {low} to {high}; {order}")
    if not math.isfinite(float(high) - float(low)):
        raise StudyError(f"vary: '{name}' has the range from {low} to {high}, whose width is beyond a double's range")
    if kind == "log_uniform" and low <= 0:
        raise StudyError(f"vary: '{name}' has the lowest value {low}; log_uniform takes {KINDS[kind][0]}")
    if kind == "steps" and not (isinstance(entries[2], int) and 2 <= entries[2] <= MAX_CHOICES):
        raise StudyError(f"vary: '{name}' has {entries[2]} steps; from 2 to {MAX_CHOICES} are possible")
    return tuple(entries)
