# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Distribution of uncertain parameters, and the members of an ensemble that represent it.

The logarithms of the parameters are normally distributed: a member has the scene's value times a positive factor. An
array, for example two coefficients of friction, has one factor.
"""

from __future__ import annotations

import functools
import math
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import attrs

from cloth_sim_ros.physics.arithmetic.deterministic_math import exponential, logarithm, ordered_sum
from cloth_sim_ros.scene import input_file
from cloth_sim_ros.scene.parameters import ros_yaml
from cloth_sim_ros.scene.parameters.declare import Parameter, ParameterError
from cloth_sim_ros.scene.parameters.unknown_parameters import suggestion

#: Largest number of parameters, and relative standard deviation of one.
MAX_PARAMETERS, MAX_DEVIATION = 32, 2.0
#: Largest relative asymmetry of a covariance, which a file may have rounded.
_ASYMMETRY = 1e-6
#: Difference of a scene's value from that of the file which is reported [standard deviations].
_REPORTED_DIFFERENCE = 1.0


class DistributionError(ParameterError):
    """Error: a distribution of parameters cannot be used; the message gives cause and remedy."""


class VariableScene(Protocol):
    """Protocol of a `Scene` of which some parameters vary."""

    @property
    def entries(self) -> tuple[Parameter, ...]: ...

    def parameters(self) -> dict[str, Any]: ...

    def changed(self, values: dict[str, Any]) -> VariableScene: ...


def _plain(values: Any) -> Any:
    """Return tuples of plain numbers in place of numpy's arrays and numbers."""
    if hasattr(values, "tolist"):
        values = values.tolist()
    return tuple(map(_plain, values)) if isinstance(values, tuple | list) else values


@attrs.frozen(kw_only=True)
class Distribution:
    """Joint distribution of uncertain parameters, whose logarithms are normally distributed.

    Raises:
        DistributionError: for names given twice, values that are no numbers, and an invalid covariance.
    """

    #: Full names of the parameters.
    names: tuple[str, ...]
    #: Their values, None if unknown; a scene's own values replace them.
    values: tuple[float | None, ...] = attrs.field(converter=_plain)
    #: Covariance of the logarithms, shape (n, n); a diagonal entry is the square of a relative standard deviation.
    covariance: tuple[tuple[float, ...], ...] = attrs.field(converter=_plain)
    #: Properties of the file that its user should know, a sentence each.
    notes: tuple[str, ...] = ()

    def __attrs_post_init__(self) -> None:
        """Raise DistributionError for names given twice, values that are no numbers, and an invalid covariance."""
        for name in self.names:
            if self.names.count(name) > 1:
                raise DistributionError(f"parameter '{name}' is given twice")
        if len(self.values) != len(self.names):
            raise DistributionError(
                f"there are {len(self.names)} names and {len(self.values)} values; give one for each"
            )
        for name, value in zip(self.names, self.values, strict=True):
            _value({"name": name, "value": value})
        rows = [list(row) for row in self.covariance]
        _cholesky(_covariance(rows, len(self.names), range(len(self.names))))

    @classmethod
    def from_file(cls, path: str | Path) -> Distribution:
        """Read a distribution from a file, JSON of `cloth_fit` or YAML; raise DistributionError if that fails.

        YAML has `parameters` and, unless they are independent, `covariance`. Parameters that the fit left open are left
        out. Deviations of entries replace those of the covariance, which then gives the correlations.

        Raises:
            DistributionError: if the file cannot be read or describes no distribution.
        """
        try:
            content = input_file.read_bytes(path)
        except (OSError, ValueError) as error:
            raise DistributionError(f"cannot read the distribution '{path}': {error}") from error
        return cls.from_bytes(content, str(path))

    @classmethod
    def from_bytes(cls, content: bytes, subject: str) -> Distribution:
        """Parse a file's content as a distribution, or raise DistributionError that begins with `subject`, its name.

        Raises:
            DistributionError: if the content describes no distribution.
        """
        try:
            return _parse(content)
        except DistributionError as error:
            raise DistributionError(f"{subject}: {error}") from error

    def factors(self, members: int = 0, seed: int = 0) -> list[tuple[float, ...]]:
        """Return a tuple of factors, one a parameter, for each member of an ensemble: sigma points or a random sample.

        Args:
            members: 0 for sigma points, two for each parameter: mean and covariance of the logarithms are exact, and
                with them the mean and the deviation of a motion to second order. At least 2 for a random sample of that
                size, whose bits depend on `seed` alone.
            seed: seed of the sample.
        """
        root, count = _cholesky(self.covariance), len(self.names)
        if members:
            generator = random.Random(seed)
            points = [[_draw_normal(generator) for _ in range(count)] for _ in range(members)]
        else:
            radius = math.sqrt(count)
            points = [[sign * radius * (k == i) for k in range(count)] for i in range(count) for sign in (1.0, -1.0)]
        return [
            tuple(exponential(ordered_sum(a * b for a, b in zip(row, point, strict=True))) for row in root)
            for point in points
        ]

    def check(self, scene: VariableScene) -> None:
        """Raise DistributionError unless each parameter is a live, nonzero float of the scene that affects the motion.

        Raises:
            DistributionError: if a parameter is unknown, no number, zero, or cannot change while the cloth runs.
        """
        entries, values = {entry.name: entry for entry in scene.entries}, scene.parameters()
        for name in self.names:
            entry = entries.get(name)
            if entry is None:
                raise DistributionError(f"unknown parameter '{name}'{suggestion(name, list(entries))}")
            value = values[name]
            numbers = value if isinstance(value, tuple) else (value,)
            is_number = all(isinstance(component, float) for component in numbers)
            if not is_number or not entry.live or entry.observes:
                raise DistributionError(
                    f"'{name}' cannot vary; it must be a number that may change while the cloth runs and moves it"
                )
            if not any(numbers):
                raise DistributionError(
                    f"'{name}' is 0 in the scene, and a relative deviation does not change it; set it, or leave it out"
                )

    def check_members(
        self, scene: VariableScene, members: int = 0, seed: int = 0, *, extremes_alone: bool = False
    ) -> None:
        """Raise DistributionError if a parameter cannot vary in a scene, or a member's values make an invalid scene.

        Args:
            scene: the scene.
            members: see `factors`.
            seed: seed of the sample.
            extremes_alone: true to check only the members that have the least or the largest factor of a parameter.

        Raises:
            DistributionError: naming parameter or member.
        """
        self.check(scene)
        rows = self.factors(members, seed)
        checked = list(range(len(rows)))
        if extremes_alone:
            columns = [[row[k] for row in rows] for k in range(len(self.names))]
            checked = sorted({column.index(choose(column)) for column in columns for choose in (min, max)})
        for k in checked:
            values = self.member_values(scene, rows[k])
            try:
                scene.changed(values)
            except ParameterError as error:
                raise DistributionError(f"{describe_member(k, values)}: {error}; state a smaller deviation") from error

    def differences(self, scene: VariableScene) -> list[str]:
        """Return a sentence for each parameter whose value in a scene is over a standard deviation from the file's."""
        sentences, values = [], scene.parameters()
        for k, (name, value) in enumerate(zip(self.names, self.values, strict=True)):
            if value is None or not value > 0.0:
                continue
            current = values[name][0] if isinstance(values[name], tuple) else values[name]
            deviation = math.sqrt(self.covariance[k][k])
            ratio = abs(current) / value
            if not ratio or abs(logarithm(ratio)) > _REPORTED_DIFFERENCE * deviation:
                sentences.append(
                    f"{name} is {current:g} in the scene and {value:g} in the file, more than a standard deviation "
                    f"apart: the ensemble is about the scene's value"
                )
        return sentences

    def member_values(self, scene: VariableScene, factors: Sequence[float]) -> dict[str, Any]:
        """Return a scene's values of the distributed parameters by full name, times the factors of one member."""
        values = scene.parameters()
        return self.scaled({name: values[name] for name in self.names}, factors)

    def scaled(self, values: Mapping[str, Any], factors: Sequence[float]) -> dict[str, Any]:
        """Return a copy of parameters by full name, those of the distribution multiplied by a member's factors."""
        scaled = dict(values)
        for name, factor in zip(self.names, factors, strict=True):
            if name in scaled:
                value = scaled[name]
                is_array = isinstance(value, list | tuple)
                scaled[name] = tuple(factor * component for component in value) if is_array else factor * value
        return scaled


def describe_member(index: int, values: Mapping[str, Any]) -> str:
    """Return a text for messages, such as `member 2 of the ensemble (air.drag = 0.1)`, from index and parameters."""
    texts = [f"{name} = {_text(value)}" for name, value in values.items()]
    return f"member {index} of the ensemble ({', '.join(texts)})"


def _text(value: Any) -> str:
    return ", ".join(f"{component:.6g}" for component in value) if isinstance(value, tuple) else f"{value:.6g}"


@functools.lru_cache(maxsize=16)
def _parse(content: bytes) -> Distribution:
    import yaml

    try:
        document = ros_yaml.load(content.decode())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DistributionError(f"it is neither JSON of cloth_fit nor YAML: {error}") from error
    entries = document.get("parameters") if isinstance(document, dict) else None
    if not isinstance(entries, list) or not entries:
        raise DistributionError("it has no list 'parameters', of entries with name and deviation; see cloth_fit --json")
    if not all(isinstance(entry, dict) and isinstance(entry.get("name"), str) for entry in entries):
        raise DistributionError("an entry of 'parameters' has no name; write {name: air.drag, deviation: 0.2}")
    used = [k for k, entry in enumerate(entries) if not _is_open(entry)]
    if not used:
        raise DistributionError("the fit determined no parameter; record more motions")
    if len(used) > MAX_PARAMETERS:
        raise DistributionError(f"it has {len(used)} parameters; at most {MAX_PARAMETERS} are taken")
    names = tuple(entries[k]["name"] for k in used)
    left_out = [entry["name"] for k, entry in enumerate(entries) if k not in used]
    notes = [f"the fit did not determine {name}: it does not vary" for name in left_out]
    if isinstance(document.get("doubt"), str) and document["doubt"]:
        notes.append(f"the fit doubts its deviations: {document['doubt']}")
    if document.get("covariance") is None:
        if len(used) > 1 and any("bound" in entry for entry in entries):
            notes.append("the file has no covariance: the parameters vary independently")
        deviations = [_deviation(entries[k]) for k in used]
        covariance = [[d * d * (i == k) for k in range(len(used))] for i, d in enumerate(deviations)]
    else:
        covariance = _covariance(document["covariance"], len(entries), used)
        # Bounds may be wider than the covariance, for example those of Student's distribution.
        stated = ["deviation" in entries[k] or "bound" in entries[k] for k in used]
        scales = [
            _deviation(entries[k]) / math.sqrt(covariance[i][i]) if is_stated else 1.0
            for i, (k, is_stated) in enumerate(zip(used, stated, strict=True))
        ]
        covariance = [[scales[i] * c * scales[k] for k, c in enumerate(row)] for i, row in enumerate(covariance)]
    return Distribution(
        names=names,
        values=tuple(_value(entries[k]) for k in used),
        covariance=tuple(map(tuple, covariance)),
        notes=tuple(notes),
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_open(entry: Mapping[str, Any]) -> bool:
    """Return True for an entry of a file that the fit left open: its bound is null, or too large for a distribution."""
    if "bound" not in entry or "deviation" in entry:
        return False
    bound = entry["bound"]
    return bound is None or (_is_number(bound) and bound > MAX_DEVIATION)


def _value(entry: Mapping[str, Any]) -> float | None:
    value = entry.get("value")
    if value is not None and not _is_number(value):
        raise DistributionError(f"the value of {entry['name']} is {value!r}; it must be a number")
    return None if value is None else float(value)


def _deviation(entry: Mapping[str, Any]) -> float:
    """Return a file entry's relative standard deviation, `deviation` or else `bound`; raise if it is out of range."""
    deviation = entry.get("deviation", entry.get("bound"))
    if not _is_number(deviation) or not 0.0 < deviation <= MAX_DEVIATION:
        raise DistributionError(
            f"the deviation of {entry['name']} is {deviation!r}; it must be relative, above 0 and at most "
            f"{MAX_DEVIATION:g}, for example 0.05 for 5 %"
        )
    return float(deviation)


def _covariance(rows: Any, size: int, used: Sequence[int]) -> list[list[float]]:
    """Check a file's covariance, (size, size), and return its rows and columns of the used parameters, or raise."""
    is_square = isinstance(rows, list) and len(rows) == size
    if not is_square or not all(isinstance(row, list) and len(row) == size for row in rows):
        raise DistributionError(f"covariance must have {size} rows of {size} numbers, in the order of 'parameters'")
    covariance = [[rows[i][k] for k in used] for i in used]
    if not all(_is_number(entry) for row in covariance for entry in row):
        raise DistributionError("covariance has an entry of a used parameter that is no finite number")
    for i, row in enumerate(covariance):
        # The square of a stated deviation may be rounded.
        if not 0.0 < row[i] <= MAX_DEVIATION * MAX_DEVIATION * (1.0 + _ASYMMETRY):
            raise DistributionError(
                f"covariance has {row[i]:g} on its diagonal; squares of relative deviations are above 0 and at most "
                f"{MAX_DEVIATION * MAX_DEVIATION:g}"
            )
        for k in range(i):
            if not abs(row[k] - covariance[k][i]) <= _ASYMMETRY * math.sqrt(row[i] * covariance[k][k]):
                raise DistributionError(f"covariance is not symmetric: {row[k]:g} and {covariance[k][i]:g}")
    return [list(map(float, row)) for row in covariance]


def _cholesky(covariance: Sequence[Sequence[float]]) -> list[list[float]]:
    """Return the lower triangular L with L L' = covariance; raise DistributionError if it is not positive definite.

    Raises:
        DistributionError: if the covariance is not positive definite.
    """
    size = len(covariance)
    root = [[0.0] * size for _ in range(size)]
    for i in range(size):
        for k in range(i + 1):
            remainder = covariance[i][k] - ordered_sum(root[i][m] * root[k][m] for m in range(k))
            if k < i:
                root[i][k] = remainder / root[k][k]
            elif remainder > 0.0:
                root[i][i] = math.sqrt(remainder)
            else:
                raise DistributionError("covariance is not positive definite; correlations are between -1 and 1")
    return root


def _draw_normal(generator: random.Random) -> float:
    """Draw a number from the standard normal distribution by Marsaglia's polar method."""
    while True:
        x, y = 2.0 * generator.random() - 1.0, 2.0 * generator.random() - 1.0
        square = x * x + y * y
        if 0.0 < square < 1.0:
            return x * math.sqrt(-2.0 * logarithm(square) / square)
