# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sections of a ROS parameter file, read as ROS's own parser reads them.

That parser (rcl_yaml_param_parser) reads a file event by event. Sections of one name are merged, whatever stands
between them. A repeated name is set twice, and documents, aliases and tags neither end nor replace anything. Text that
the parser would misread is refused here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from cloth_sim_ros.scene.parameters import ros_yaml
from cloth_sim_ros.scene.parameters.declare import ParameterError

KEY = "ros__parameters"
#: Largest number of parts of a parameter's name.
_MAX_DEPTH = 100
#: Largest number of characters of the name of a parameter or a node.
_MAX_NAME_LENGTH = 1000
_PART = r"(?:[A-Za-z_][A-Za-z0-9_]*|\*\*?)"
#: Valid names of sections in ROS.
_NAME = re.compile(rf"/?(?:{_PART}/)*{_PART}")
#: Names of Python types in ROS.
_TYPES = {"float": "double", "str": "string"}
#: Order of types in which ROS searches the values of a name, of which it keeps one of each type.
_KINDS = ("bool", "int", "float", "str", "bool[]", "int[]", "float[]", "str[]")


def matches(section: str, node: str) -> bool:
    """Return True if a section's name, wildcards included, matches a node's full name with or without its first /."""
    pattern = f"/{section.removeprefix('/')}".replace("/*", r"(/\w+)")
    return re.fullmatch(pattern, f"/{node.strip('/')}", re.ASCII) is not None


def read(text: str, *, source: str) -> dict[str, dict[str, Any]]:
    """Parse the text of a ROS parameter file; return the parameters by full name of each section, or raise.

    An empty list, which sets nothing in ROS, becomes [] if nothing else sets the name.

    Raises:
        ParameterError: for text that ROS refuses, or reads otherwise than it is written.
        yaml.YAMLError: if the text is no YAML.
    """
    return _SectionReader(text, source).sections()


class _Section:
    """Values of one section of a parameter file, by name and type, as ROS's parser keeps them."""

    def __init__(self) -> None:
        self._entries: list[tuple[str, dict[str, Any]]] = []
        self._first: dict[str, dict[str, Any]] = {}
        self._groups: set[str] = set()

    def clashes(self, name: str, *, group: bool) -> bool:
        """Return True if a name is used both as a value and as a group of names; remember the names of groups."""
        if group:
            self._groups.add(name)
            return name in self._first
        return name in self._groups

    def entry(self, name: str, *, nested: bool) -> dict[str, Any]:
        """Return the dict that holds a name's values by type; a nested name gets a new one each time, as in ROS."""
        if nested or name not in self._first:
            self._entries.append((name, {}))
            self._first.setdefault(name, self._entries[-1][1])
            return self._entries[-1][1]
        return self._first[name]

    def values(self) -> dict[str, Any]:
        """Return the value of each name; ROS keeps the first type in its search order."""
        return {name: next((kinds[kind] for kind in _KINDS if kind in kinds), []) for name, kinds in self._entries}


class _SectionReader:
    """Reader, for one use, of a parameter file's sections from a YAML parser's events; it raises where ROS does."""

    def __init__(self, text: str, source: str) -> None:
        import yaml

        self._events: Iterator[Any] = yaml.parse(text, Loader=ros_yaml.parser())
        self._event: Any = None
        self._count = 0
        self._source = source
        self._sections: dict[str, _Section] = {}

    def sections(self) -> dict[str, dict[str, Any]]:
        """Parse the whole text; return the parameters of each section by full name, or raise. Call it once."""
        for _ in self._until("StreamEnd"):
            if self._is("DocumentStart"):
                self._next()
                if not self._is("MappingStart"):
                    raise self._not_a_parameter_file()
                self._names(())
        return {name: section.values() for name, section in self._sections.items()}

    def _next(self) -> Any:
        self._event = next(self._events)
        self._count += 1
        if self._count > ros_yaml.MAX_NODES:
            raise self._error(f"more than {ros_yaml.MAX_NODES} values and names; that is the limit")
        if self._is("Alias"):
            raise self._error("an alias, which ROS does not read: write out what it stands for")
        return self._event

    def _until(self, end: str) -> Iterator[Any]:
        """Yield the YAML parser's events up to the end of the open collection.

        The caller consumes the events of nested collections.
        """
        self._next()
        while not self._is(end):
            yield self._event
            self._next()

    def _is(self, kind: str) -> bool:
        return type(self._event).__name__ == f"{kind}Event"

    def _key(self) -> str:
        key = _scalar_text(self._event) if self._is("Scalar") else ""
        if not key:
            raise self._error("a key that is no name; write 'name: value'")
        if len(key) > _MAX_NAME_LENGTH:
            raise self._error(f"a name of {len(key)} characters; the limit is {_MAX_NAME_LENGTH}")
        return key

    def _names(self, above: tuple[str, ...]) -> None:
        """Parse a mapping from names of namespaces and nodes to sections, and store what they set."""
        ended = False
        for _ in self._until("MappingEnd"):
            key = self._key()
            path = (*above, key)
            if ended:
                raise self._error(f"'{key}:' behind the '{KEY}:' of '{'/'.join(above)}:'; begin a section of its own")
            if key.startswith(KEY):
                if not above:
                    raise self._not_a_parameter_file()
                self._begin(above)
                ended = True
                continue
            if above and "/" in key:
                raise self._error(f"the name '{key}' with a / within '{'/'.join(above)}:'; write the whole name as one")
            self._next()
            if not self._is("MappingStart"):
                raise self._error(f"no '{KEY}:' below '{'/'.join(above or path)}:'")
            if len(path) > _MAX_DEPTH:
                raise self._too_deep_error()
            self._names(path)

    def _begin(self, path: tuple[str, ...]) -> None:
        name = "/".join(path)
        if not _NAME.fullmatch(name):
            subject = "the wildcard" if "*" in name else "the node name"
            raise self._error(
                f"{subject} '{name}:'; names are of letters, digits and _, with / between them; * stands for one, ** "
                "for any number"
            )
        section = self._sections.setdefault(name, _Section())
        self._next()
        if not self._is("MappingStart"):
            raise self._error(f"no parameters below the '{KEY}:' of '{name}:'; write 'name: value' there, or {{}}")
        self._parameters(section, ())

    def _parameters(self, section: _Section, above: tuple[str, ...]) -> None:
        """Parse a mapping of parameters and groups of parameters, and store it in a section."""
        empty = True
        for _ in self._until("MappingEnd"):
            empty = False
            key = self._key()
            path = (*above, key)
            name = ".".join(path)
            self._next()
            group = self._is("MappingStart")
            if section.clashes(name, group=group):
                raise self._error(f"'{name}' both as a value and as a group of parameters; take one of them out")
            if not group:
                self._value(section.entry(name, nested=bool(above)), name)
            elif above and "." in key:
                # ROS would put later parameters into a group of its first part.
                raise self._error(f"the group '{key}' with a . within '{'.'.join(above)}:'; write a group in a group")
            elif len(path) >= _MAX_DEPTH:
                raise self._too_deep_error()
            else:
                self._parameters(section, path)
        if empty and above:
            raise self._error(f"no parameter below '{'.'.join(above)}:'; give one, or leave '{above[-1]}:' out")

    def _value(self, kinds: dict[str, Any], name: str) -> None:
        if self._is("Scalar"):
            value = self._scalar(name)
            kinds[type(value).__name__] = value
            return
        values = [self._scalar(name) for _ in self._until("SequenceEnd")]
        types = list(dict.fromkeys(type(value).__name__ for value in values))
        if len(types) > 1:
            type_names = " and ".join(_TYPES.get(kind, kind) for kind in types)
            raise self._error(
                f"entries of {name} of different types, {type_names}; give all one type, as in [1.0, 2.5]"
            )
        if types:
            kinds[f"{types[0]}[]"] = values

    def _scalar(self, name: str) -> Any:
        if not self._is("Scalar"):
            raise self._error(f"a list or group within the list {name}; ROS has lists of plain values only")
        if not self._event.value and self._event.style not in ("'", '"'):
            raise self._error(f"no value for {name}; give one, or leave '{name.rpartition('.')[2]}:' out")
        text = _scalar_text(self._event)
        # ROS regards only this tag.
        is_text = self._event.style in ("'", '"') or self._event.tag == "tag:yaml.org,2002:str"
        return text if is_text else ros_yaml.parse_plain_scalar(text)

    def _not_a_parameter_file(self) -> ParameterError:
        return ParameterError(
            f"'{self._source}' is no parameter file; it needs '/**:' or 'cloth_sim:' with '{KEY}:' below"
        )

    def _too_deep_error(self) -> ParameterError:
        return self._error(f"names nested more than {_MAX_DEPTH} deep; no parameter's name has so many parts")

    def _error(self, problem: str) -> ParameterError:
        return ParameterError(f"'{self._source}' has {problem} (line {self._event.start_mark.line + 1})")


def _scalar_text(event: Any) -> str:
    """Return the text of a scalar; as in C it ends at a null character."""
    return str(event.value).partition("\0")[0]
