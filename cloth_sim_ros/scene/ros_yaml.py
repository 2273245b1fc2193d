# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""YAML as ROS reads it: a plain `1e-5` is a number, a plain `1_000`, `12:30` or date is a text.

PyYAML follows YAML 1.1; ROS's own parser (rcl_yaml_param_parser) asks the functions strtoll and strtod of C. A file
must mean the same with and without ROS.
"""

from __future__ import annotations

import functools
import math
import re
from typing import Any

_BOOL = re.compile(r"^(?:y|Y|yes|Yes|YES|true|True|TRUE|on|On|ON|n|N|no|No|NO|false|False|FALSE|off|Off|OFF)$")
_TRUE = ("y", "yes", "true", "on")
_INT = re.compile(r"^[-+]?(?:0[0-7]*|[1-9][0-9]*|0[xX][0-9a-fA-F]+)$")
_FLOAT = re.compile(
    r"^(?:[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
    # A leading 0 means octal; where it can't, C's strtod makes a floating point number of it.
    r"|[-+]?0[0-9]*[89][0-9]*"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
#: What else C makes a number of: whole numbers beyond 64 bits, hexadecimal ones with an exponent, names.
_DECIMAL = re.compile(r"[-+]?[0-9]+(?:[eE][-+]?[0-9]+)?")
_HEXADECIMAL = re.compile(r"[-+]?0[xX](?:[0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)(?:[pP][-+]?[0-9]+)?")
_NAMED = re.compile(r"[-+]?(?:inf|infinity|nan)", re.IGNORECASE)
#: Most values and keys of a file, those that aliases repeat included, and the deepest nesting.
MAX_NODES, _DEEPEST = 250_000, 100
#: Longest value of a study, a script or a table [characters].
_LONGEST = 10_000
_INT_END = 1 << 63
#: No whole number of 64 bits has as many, unless it begins with noughts.
_MOST_DIGITS = 1000
_RESOLVED = {
    "tag:yaml.org,2002:bool": (_BOOL, "yYnNtTfFoO"),
    "tag:yaml.org,2002:int": (_INT, "-+0123456789"),
    "tag:yaml.org,2002:float": (_FLOAT, "-+0123456789."),
}


def load(text: str) -> Any:
    """Return what a text holds, in plain Python values.

    Raises:
        yaml.YAMLError: if it is no YAML, gives a key twice, has too many values, or is nested too deeply.
    """
    import yaml

    check_size(text)
    try:
        return yaml.load(text, Loader=_loader())
    except (ValueError, TypeError, AttributeError, LookupError) as error:
        # PyYAML's constructors take the text of a value to be what its tag says.
        raise yaml.YAMLError(f"a value is not what its tag says: {error}") from error


def parser() -> Any:
    """Return PyYAML's loader that turns a text into events one after another: the C one if it is installed.

    Its events take neither memory nor recursion; what follows them may.
    """
    import yaml

    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def check_size(text: str, *, most: int = MAX_NODES) -> None:
    """Refuse a text that would take long, or much memory, once it is read.

    An alias is a few bytes and stands for what may hold aliases in turn.

    Args:
        text: YAML.
        most: most values and keys, those that aliases repeat included.

    Raises:
        yaml.YAMLError: naming the limit.
    """
    import yaml

    #: Nodes of each anchor's value, and of each value that is open: its anchor, and the nodes so far.
    anchors: dict[str, int] = {}
    values: list[tuple[str | None, int]] = [(None, 0)]
    for event in yaml.parse(text, Loader=parser()):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, nodes = values.pop()
        elif isinstance(event, yaml.CollectionStartEvent):
            values.append((event.anchor, 1))
            if len(values) > _DEEPEST:
                raise yaml.YAMLError(f"it is nested too deeply to be read: more than {_DEEPEST} levels")
            continue
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchors:
                raise yaml.YAMLError(f"the alias '*{event.anchor}' stands for nothing that ended before it")
            anchor, nodes = None, anchors[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            anchor, nodes = event.anchor, 1
            if len(event.value) > _LONGEST:
                raise yaml.YAMLError(f"it has a value of {len(event.value)} characters; the limit is {_LONGEST}")
        else:
            continue
        if anchor is not None:
            anchors[anchor] = nodes
        around, before = values[-1]
        values[-1] = (around, before + nodes)
        if before + nodes > most:
            raise yaml.YAMLError(f"it has more than {most} values, aliases written out; that is the limit")


def plain(text: str) -> bool | int | float | str:
    """Return what ROS makes of a value that is not quoted; `null` and `~` are texts."""
    if _BOOL.fullmatch(text):
        return text.lower() in _TRUE
    if _INT.fullmatch(text):
        value = _whole(text)
        if -_INT_END <= value < _INT_END:
            return value
    if _HEXADECIMAL.fullmatch(text):
        try:
            return float.fromhex(text)
        except OverflowError:
            return text
    if _FLOAT.fullmatch(text) and "." in text and text.strip("+-.").lower() in ("inf", "nan"):
        return float(text.replace(".", ""))
    if _FLOAT.fullmatch(text) or _DECIMAL.fullmatch(text):
        number = float(text)
        # Beyond the largest number strtod fails, which leaves the text.
        return text if math.isinf(number) else number
    return float(text) if _NAMED.fullmatch(text) else text


def _whole(text: str) -> int:
    """A whole number as strtoll reads it; one of very many digits as one of 65 bits, for Python reads no more."""
    digits = text.lstrip("+-")
    if len(digits) > _MOST_DIGITS:
        return _INT_END << 1
    base = 16 if digits[:2].lower() == "0x" else 8 if digits.startswith("0") else 10
    return int(text, base)


def dump(content: Any) -> str:
    """Return a text that holds plain Python values, read alike by ROS, by `load` and by any reader of YAML 1.1."""
    import yaml

    return str(yaml.dump(content, Dumper=_dumper(), sort_keys=False, default_flow_style=None, width=120))


@functools.cache
def _loader() -> Any:
    import yaml

    class Loader(parser()):  # type: ignore[misc]
        """A SafeLoader with other plain scalars, which refuses a key that is given twice: the last would win unseen."""

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            seen: set[str] = set()
            keys = [key for key, _ in node.value] if isinstance(node, yaml.MappingNode) else []
            for key in keys:
                if not isinstance(key, yaml.ScalarNode):
                    continue
                if key.value in seen:
                    line = key.start_mark.line + 1
                    raise yaml.YAMLError(f"'{key.value}' is given twice, in line {line} again; give it once")
                seen.add(key.value)
            made: dict[Any, Any] = super().construct_mapping(node, deep=deep)
            return made

    others = {*_RESOLVED, "tag:yaml.org,2002:timestamp"}
    Loader.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag not in others]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    for tag, (pattern, first) in _RESOLVED.items():
        Loader.add_implicit_resolver(tag, pattern, list(first))
    # One beyond 64 bits is what C makes of it; Python would refuse one of very many digits.
    Loader.add_constructor("tag:yaml.org,2002:int", lambda _, node: plain(str(node.value)))
    Loader.add_constructor("tag:yaml.org,2002:bool", lambda _, node: str(node.value).lower() in _TRUE)
    return Loader


@functools.cache
def _dumper() -> Any:
    import yaml

    class Dumper(yaml.SafeDumper):
        """A SafeDumper that quotes every text that some reader would take for something else, and writes no aliases."""

        def ignore_aliases(self, data: Any) -> bool:
            # ROS reads none.
            return True

    for tag, (pattern, first) in _RESOLVED.items():
        Dumper.add_implicit_resolver(tag, pattern, list(first))
    return Dumper
