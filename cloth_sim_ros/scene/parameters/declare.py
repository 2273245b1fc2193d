# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters: flat, typed, described, ranged names of configuration fields.

A field is declared once, with `parameter`. The scene, the YAML reader, the node's parameter descriptors and the
documentation take default, unit and limits from that declaration. It also says if the parameter may change while the
cloth runs.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from typing import Any

import attrs

#: Names of grippers and obstacles, which are part of names in ROS.
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_META = "parameter"
_SECTION = "section"
#: Integers of a parameter have 64 bits, as in ROS.
_INT_END = 1 << 63
#: Largest number of characters of a value in a message.
_MAX_SHOWN = 200

#: ROS parameter types by name, as Python types.
KINDS: dict[str, type] = {"bool": bool, "int": int, "double": float, "string": str}


class ParameterError(ValueError):
    """Error: a parameter is unknown, of the wrong type, out of range, read-only, or unfit for others."""

    @property
    def sentences(self) -> list[str]:
        """Messages of the error, one for each fault."""
        return [str(self)]


class ParameterErrors(ParameterError):
    """Error of several faults of parameters, one per line of its message, each in `sentences`."""

    def __init__(self, sentences: Sequence[str]) -> None:
        super().__init__("\n".join(sentences))
        self._sentences = list(sentences)

    @property
    def sentences(self) -> list[str]:
        """Messages of the error, one for each fault."""
        return list(self._sentences)


class Faults:
    """Collection of several faults' messages, true if not empty, so that one error names all of them."""

    def __init__(self) -> None:
        self._sentences: list[str] = []

    def __bool__(self) -> bool:
        return bool(self._sentences)

    @property
    def sentences(self) -> list[str]:
        """Copy of the list of messages of the collected faults."""
        return list(self._sentences)

    def add(self, sentences: Iterable[str]) -> None:
        """Add messages of faults, except those that were added before."""
        self._sentences += [sentence for sentence in sentences if sentence not in self._sentences]

    def collect(self, check: Callable[[], Any]) -> Any:
        """Call a check, and return its result; if it raises ParameterError, add its faults and return None."""
        try:
            return check()
        except ParameterError as error:
            self.add(error.sentences)
            return None

    def refuse(self) -> None:
        """Raise one error that names every collected fault; do nothing if there are none.

        Raises:
            ParameterError: with a single message, or several, one per line.
        """
        if len(self._sentences) == 1:
            raise ParameterError(self._sentences[0])
        if self._sentences:
            raise ParameterErrors(self._sentences)


@attrs.frozen(kw_only=True)
class Parameter:
    """Declaration of one parameter: name, type, default, unit, range and description."""

    #: Full name, e.g. ``cloth.size``.
    name: str = ""
    #: bool, int, double or string; with the suffix [] for an array.
    kind: str
    default: Any
    description: str
    unit: str = ""
    min: float | None = None
    max: float | None = None
    #: True if the minimum itself is not allowed.
    excludes_min: bool = False
    #: Number of entries of an array, if it is fixed.
    length: int | None = None
    choices: tuple[str, ...] = ()
    #: A limit that the fields above can't express, in words.
    constraint: str = ""
    #: True if it may change while the cloth runs; a change takes effect at the next frame.
    live: bool = False
    #: True if a change does not alter the motion by a single bit. Such a parameter decides about displays, reports, or
    #: the handling of later commands.
    observes: bool = False

    @property
    def element(self) -> str:
        """Type of one entry of an array, or of a single value: bool, int, double or string."""
        return self.kind.removesuffix("[]")

    @property
    def min_accepted(self) -> float | None:
        """Smallest value that is accepted; None without a range.

        If the minimum 0 is excluded, this is the smallest normal number, because divisions by a smaller one overflow.
        """
        if self.min is None or not self.excludes_min:
            return self.min
        return math.nextafter(self.min, math.inf) if self.min else sys.float_info.min

    @property
    def is_array(self) -> bool:
        """True if the value is an array."""
        return self.kind.endswith("[]")

    def check(self, value: Any) -> Any:
        """Return a value of the right type, length, range and choice as a Python value or tuple, else raise.

        Raises:
            ParameterError: for a wrong type, length, range or choice.
        """
        if not self.is_array:
            return self._check_one(value)
        listed = isinstance(value, Sequence) or hasattr(value, "__array__")
        if not listed or isinstance(value, str | bytes) or getattr(value, "ndim", 1) != 1:
            raise ParameterError(f"{self.name} is {_format_value(value)}; it must be an array of {self.element}")
        values = tuple(self._check_one(entry) for entry in value)
        if self.length is not None and len(values) != self.length:
            raise ParameterError(
                f"{self.name} has {len(values)} entries, {_format_value(list(values))}; it must have {self.length}"
            )
        return values

    def _check_one(self, value: Any) -> Any:
        kind = KINDS[self.element]
        value = _python_scalar(value)
        if type(value) is int and not -_INT_END <= value < _INT_END:
            # The value is not quoted, because Python refuses to print integers of more than a few thousand digits.
            raise ParameterError(f"{self.name} is a whole number of {value.bit_length()} bits; it must fit into 64")
        if kind is float and type(value) is int:
            raise ParameterError(f"{self.name} is the whole number {value}; it is a double: write {float(value)}")
        if type(value) is not kind:
            # YAML reads a plain no, y or 12 as another type.
            remedy = ": write it in quotes" if kind is str and isinstance(value, int | float) else ""
            raise ParameterError(
                f"{self.name} is {_format_value(value)}, of type {type(value).__name__}; it must be {self.kind}{remedy}"
            )
        if isinstance(value, int | float) and kind is not bool:
            self._check_range(value)
        if self.choices and value not in self.choices:
            raise ParameterError(f"{self.name} is {_format_value(value)}; it must be one of {', '.join(self.choices)}")
        return value

    def _check_range(self, value: float) -> None:
        unit = f" {self.unit}" if self.unit else ""
        if not math.isfinite(value):
            raise ParameterError(f"{self.name} is {value}; it must be finite")
        if self.min_accepted is not None and value < self.min_accepted:
            bound = "above" if self.excludes_min else "at least"
            raise ParameterError(f"{self.name} is {value}{unit}; it must be {bound} {self.min}{unit}")
        if self.max is not None and value > self.max:
            raise ParameterError(f"{self.name} is {value}{unit}; it must be at most {self.max}{unit}")


def _python_scalar(entry: Any) -> Any:
    """Return a numpy scalar as a Python number; other values unchanged."""
    return entry.item() if hasattr(entry, "item") and getattr(entry, "ndim", 0) == 0 else entry


def parameter(kind: str, default: Any, description: str, **options: Any) -> Any:
    """Return an attrs field that declares a parameter of a configuration class; options are those of `Parameter`."""
    if kind.endswith("[]"):
        default = tuple(default)
    declaration = Parameter(kind=kind, default=default, description=description, **options)
    return attrs.field(default=default, metadata={_META: declaration})


def _leaf(field: attrs.Attribute[Any]) -> str:
    """Return the last part of a parameter's name: the attrs field's name without a trailing _."""
    return field.name.removesuffix("_")


def section(cls: type) -> Any:
    """Return an attrs field for a nested configuration class; its parameters' names begin with the field's."""
    return attrs.field(factory=cls, metadata={_SECTION: cls})


def declarations(cls: type, prefix: str = "") -> tuple[Parameter, ...]:
    """Return the declarations of all parameters of a configuration class, each name with the prefix before it."""
    return _declarations(cls, prefix)


@cache
def _declarations(cls: Any, prefix: str) -> tuple[Parameter, ...]:
    entries: list[Parameter] = []
    for field in attrs.fields(cls):
        if _META in field.metadata:
            entries.append(attrs.evolve(field.metadata[_META], name=prefix + _leaf(field)))
        elif _SECTION in field.metadata:
            entries.extend(_declarations(field.metadata[_SECTION], f"{prefix}{field.name}."))
    return tuple(entries)


def flatten(instance: Any, prefix: str = "") -> dict[str, Any]:
    """Return the parameter values of a configuration object by full name, those of sections included."""
    values: dict[str, Any] = {}
    for field in attrs.fields(type(instance)):
        value = getattr(instance, field.name)
        if _SECTION in field.metadata:
            values.update(flatten(value, f"{prefix}{field.name}."))
        elif _META in field.metadata:
            values[prefix + _leaf(field)] = value
    return values


def check(
    entries: Iterable[Parameter], values: dict[str, Any], *, hint: Callable[[str], str] = lambda _: ""
) -> dict[str, Any]:
    """Return values by full name, checked and in their own types, arrays as tuples; raise ParameterError on all faults.

    Args:
        entries: the declared parameters.
        values: values by full name.
        hint: returns an addition to the message on an unknown name.

    Raises:
        ParameterError: for unknown names and invalid values; it names all of them.
    """
    known = {entry.name: entry for entry in entries}
    faults = Faults()
    faults.add(
        f"unknown parameter '{name}'{_suggestion(name, known)}{hint(name)}" for name in values if name not in known
    )
    checked = {
        name: faults.collect(partial(known[name].check, value)) for name, value in values.items() if name in known
    }
    faults.refuse()
    return checked


def build(cls: Callable[..., Any], values: dict[str, Any], prefix: str = "", **extra_fields: Any) -> Any:
    """Build an object of a configuration class from checked values by full name; missing ones take defaults.

    `prefix` precedes the names of its fields. `extra_fields` are fields of the class that are no parameters.
    """
    return _build(cls, values, prefix, extra_fields)


def _build(cls: Any, values: dict[str, Any], prefix: str, extra_fields: dict[str, Any]) -> Any:
    arguments = dict(extra_fields)
    for field in attrs.fields(cls):
        name = prefix + _leaf(field)
        if _SECTION in field.metadata:
            arguments[field.name] = _build(field.metadata[_SECTION], values, name + ".", {})
        elif name in values:
            arguments[field.name] = values[name]
    return cls(**arguments)


def read_only_message(name: str) -> str:
    """Return the error message for a change of the parameter `name`, which is set at start only."""
    return f"{name} can't change while the cloth runs; set it at start"


def _suggestion(name: str, known: dict[str, Parameter]) -> str:
    import difflib

    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def _format_value(value: Any) -> str:
    """Return a value's repr for a message, cut after 200 characters."""
    text = repr(value)
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}... ({len(text)} characters)"
