# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""YAML with the scalars of ROS: a plain `1e-5` is a number, a date is text.

Plain `1_000` and `12:30` are text as well. PyYAML follows YAML 1.1. ROS's own parser (rcl_yaml_param_parser) uses the C
functions strtoll and strtod. A file must have the same meaning with and without ROS.
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
    # A leading 0 means octal. If the digits are not octal, C's strtod reads a floating-point number.
    r"|[-+]?0[0-9]*[89][0-9]*"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
#: Further numbers in C: integers beyond 64 bits, hexadecimal numbers with an exponent, names.
_DECIMAL = re.compile(r"[-+]?[0-9]+(?:[eE][-+]?[0-9]+)?")
_HEXADECIMAL = re.compile(r"[-+]?0[xX](?:[0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)(?:[pP][-+]?[0-9]+)?")
_NAMED = re.compile(r"[-+]?(?:inf|infinity|nan)", re.IGNORECASE)
#: Largest number of values and keys of a file, with repetitions by aliases, and deepest nesting.
MAX_NODES, _MAX_DEPTH = 250_000, 100
#: Longest value of a study, a script or a table [characters].
_MAX_VALUE_LENGTH = 10_000
_INT_END = 1 << 63
#: Largest number of digits: an integer of 64 bits has fewer, apart from leading zeros.
_MAX_DIGITS = 1000
_RESOLVED = {
    "tag:yaml.org,2002:bool": (_BOOL, "yYnNtTfFoO"),
    "tag:yaml.org,2002:int": (_INT, "-+0123456789"),
    "tag:yaml.org,2002:float": (_FLOAT, "-+0123456789."),
}


def load(text: str) -> Any:
    """Parse a YAML text to plain Python values, with scalars as ROS reads them, or raise YAMLError.

    Raises:
        yaml.YAMLError: if it is no YAML, repeats a key, has too many values, or is nested too deeply.
    """
    import yaml

    check_size(text)
    try:
        return yaml.load(text, Loader=_loader())
    except (ValueError, TypeError, AttributeError, LookupError) as error:
        # PyYAML's constructors assume that the text of a value fits its tag.
        raise yaml.YAMLError(f"a value is not what its tag says: {error}") from error


def parser() -> Any:
    """Return PyYAML's safe loader class for a stream of events, the one in C if it is installed.

    The events need neither memory nor recursion; their consumers may.
    """
    import yaml

    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def check_size(text: str, *, max_nodes: int = MAX_NODES) -> None:
    """Raise YAMLError for a YAML text that is nested too deeply, or has too many values with its aliases written out.

    An alias of a few bytes stands for content that may hold aliases in turn.

    Args:
        text: YAML.
        max_nodes: largest number of values and keys, with repetitions by aliases.

    Raises:
        yaml.YAMLError: naming the limit.
    """
    import yaml

    #: Number of nodes of each anchor's value; for each open value its anchor and its number of nodes so far.
    anchors: dict[str, int] = {}
    values: list[tuple[str | None, int]] = [(None, 0)]
    for event in yaml.parse(text, Loader=parser()):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, nodes = values.pop()
        elif isinstance(event, yaml.CollectionStartEvent):
            values.append((event.anchor, 1))
            if len(values) > _MAX_DEPTH:
                raise yaml.YAMLError(f"it is nested too deeply to be read: more than {_MAX_DEPTH} levels")
            continue
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchors:
                raise yaml.YAMLError(f"the alias '*{event.anchor}' stands for nothing that ended before it")
            anchor, nodes = None, anchors[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            anchor, nodes = event.anchor, 1
            if len(event.value) > _MAX_VALUE_LENGTH:
                raise yaml.YAMLError(
                    f"it has a value of {len(event.value)} characters; the limit is {_MAX_VALUE_LENGTH}"
                )
        else:
            continue
        if anchor is not None:
            anchors[anchor] = nodes
        enclosing_anchor, n_before = values[-1]
        values[-1] = (enclosing_anchor, n_before + nodes)
        if n_before + nodes > max_nodes:
            raise yaml.YAMLError(f"it has more than {max_nodes} values, aliases written out; that is the limit")


def parse_plain_scalar(text: str) -> bool | int | float | str:
    """Convert an unquoted scalar to the value that ROS reads; `null` and `~` are text."""
    if _BOOL.fullmatch(text):
        return text.lower() in _TRUE
    if _INT.fullmatch(text):
        value = _integer(text)
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
        parsed = float(text)
        # Beyond the largest number strtod fails, and the value stays text.
        return text if math.isinf(parsed) else parsed
    return float(text) if _NAMED.fullmatch(text) else text


def _integer(text: str) -> int:
    """Convert a text to an integer as strtoll does.

    Very many digits give an integer of 65 bits, because Python refuses them.
    """
    digits = text.lstrip("+-")
    if len(digits) > _MAX_DIGITS:
        return _INT_END << 1
    base = 16 if digits[:2].lower() == "0x" else 8 if digits.startswith("0") else 10
    return int(text, base)


def dump(content: Any) -> str:
    """Return a YAML text of plain Python values that ROS, `load` and any reader of YAML 1.1 read alike."""
    import yaml

    return str(yaml.dump(content, Dumper=_dumper(), sort_keys=False, default_flow_style=None, width=120))


@functools.cache
def _loader() -> Any:
    import yaml

    class Loader(parser()):  # type: ignore[misc]
        """SafeLoader that reads unquoted scalars as ROS does, and refuses a repeated key."""

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
            mapping: dict[Any, Any] = super().construct_mapping(node, deep=deep)
            return mapping

    replaced_tags = {*_RESOLVED, "tag:yaml.org,2002:timestamp"}
    Loader.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag not in replaced_tags]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    for tag, (pattern, first) in _RESOLVED.items():
        Loader.add_implicit_resolver(tag, pattern, list(first))
    # An integer beyond 64 bits is read as in C; Python would refuse one of very many digits.
    Loader.add_constructor("tag:yaml.org,2002:int", lambda _, node: parse_plain_scalar(str(node.value)))
    Loader.add_constructor("tag:yaml.org,2002:bool", lambda _, node: str(node.value).lower() in _TRUE)
    return Loader


@functools.cache
def _dumper() -> Any:
    import yaml

    class Dumper(yaml.SafeDumper):
        """A SafeDumper without aliases that quotes every text that some reader would misread."""

        def ignore_aliases(self, data: Any) -> bool:
            # ROS does not read aliases.
            return True

    for tag, (pattern, first) in _RESOLVED.items():
        Dumper.add_implicit_resolver(tag, pattern, list(first))
    return Dumper
