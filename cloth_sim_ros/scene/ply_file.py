# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Vertices and faces of PLY files.

plyfile reads the rows. A binary file whose rows all have one length is read as an array instead. Before that, this
module reads the header, drops comments and compares counts with the file's length. The values of an ASCII file are
arranged one row per line, because programs break lines anywhere.
"""

from __future__ import annotations

import io
import itertools
import re
import warnings
from collections.abc import Iterator

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import integer_sum

#: numpy's names of the types.
_KINDS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_SINGLE, _FRACTIONS = ("float", "float32"), ("float", "float32", "double", "float64")
_FORMATS = {"ascii", "binary_little_endian", "binary_big_endian"}
#: Upper bound of the number of rows in any file.
_MAX_COUNT = 10**15
#: Names of the list of a face's corners, the usual ones first.
_CORNER_LISTS = ("vertex_indices", "vertex_index")
_END = re.compile(rb"(?:^|(?<=[\r\n]))[ \t]*end_header[ \t]*(?:\r\n|\r|\n|\Z)")


@attrs.define(kw_only=True)
class PlyElement:
    """Element that a PLY header declares, e.g. vertex: its name, number of rows and properties."""

    name: str
    count: int
    #: Name of each property, the type of its list's length ("" for a single value), and the type of its values.
    properties: list[tuple[str, str, str]] = attrs.field(factory=list)

    @property
    def plural(self) -> str:
        """Plural of the element's name, for messages."""
        return {"vertex": "vertices"}.get(self.name, f"{self.name}s")

    def lines(self) -> Iterator[str]:
        """Yield the lines of a PLY header that declare the element and its properties."""
        yield f"element {self.name} {self.count}"
        for name, length, kind in self.properties:
            yield f"property list {length} {kind} {name}" if length else f"property {kind} {name}"


@attrs.frozen(kw_only=True)
class PlyMesh:
    """Vertices and polygons of a PLY file."""

    points: NDArray[np.float64]
    """Vertices as they are in the file, (n, 3)."""
    polygons: list[list[int]]
    """Vertices of each face."""
    single: bool
    """True if coordinates are in single precision."""


def read_ply(data: bytes) -> PlyMesh:
    """Parse a PLY file's bytes as vertices and polygons, or triangle strips; raise ValueError if it is incomplete.

    Raises:
        ValueError: if it is no complete PLY file.
    """
    form, elements, body = _header(data)
    by_name = {element.name: element for element in elements}
    vertex, face = by_name.get("vertex"), by_name.get("face")
    strips = face is None or not face.count
    if strips:
        face = by_name.get("tristrips")
    if vertex is None or not vertex.count or face is None or not face.count:
        return PlyMesh(points=np.zeros((0, 3)), polygons=[], single=False)
    kinds = {name: kind for name, length, kind in vertex.properties if not length}
    missing = [axis for axis in "xyz" if axis not in kinds]
    if missing:
        raise ValueError(f"its vertices have no property {', '.join(missing)}")
    corners = _corner_list(face)
    rows = _rows(form, elements, body)
    columns = [np.asarray(rows["vertex"][axis], dtype=np.float64) for axis in "xyz"]
    polygons: list[list[int]] = [row.tolist() for row in rows[face.name][corners]]
    if strips:
        polygons = [triangle for row in polygons for triangle in _triangles(row)]
    return PlyMesh(
        points=np.stack(columns, axis=1), polygons=polygons, single=any(kinds[axis] in _SINGLE for axis in "xyz")
    )


def _header(data: bytes) -> tuple[str, list[PlyElement], bytes]:
    """Parse a PLY file's header; return format, elements and the bytes after the header, or raise ValueError."""
    end = _END.search(data)
    if end is None:
        raise ValueError("the header does not end with end_header")
    lines = [line.split() for line in re.split(rb"[\r\n]+", data[: end.start()])]
    lines = [line for line in lines if line]
    if not lines or lines[0] != [b"ply"]:
        raise ValueError("it does not begin with ply")
    form = ""
    elements: list[PlyElement] = []
    for raw in lines[1:]:
        words = [word.decode(errors="replace") for word in raw]
        shown = " ".join(words)[:60]
        if words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _FORMATS:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and words[2].isascii():
            # Python refuses to parse integers of more than a few thousand digits.
            digits = words[2].lstrip("0") or "0"
            count = int(digits) if len(digits) < len(str(_MAX_COUNT)) else _MAX_COUNT
            elements.append(PlyElement(name=words[1], count=count))
        elif words[0] == "property" and len(words) == 3 and words[1] in _KINDS and elements:
            elements[-1].properties.append((words[2], "", words[1]))
        elif words[0] == "property" and len(words) == 5 and elements and words[1] == "list":
            length, kind = words[2:4]
            if length not in _KINDS or kind not in _KINDS or length in _FRACTIONS:
                raise ValueError(f"'{shown}' in the header is no list")
            elements[-1].properties.append((words[4], length, kind))
        else:
            raise ValueError(f"'{shown}' in the header is no PLY")
    if not form:
        raise ValueError(f"the header has no format of {', '.join(sorted(_FORMATS))}")
    body = data[end.end() :]
    _check_counts(elements, form, len(body))
    return form, elements, body


def _check_counts(elements: list[PlyElement], form: str, length: int) -> None:
    """Raise ValueError if a binary PLY file's `length` bytes after the header can't hold the rows that it counts."""
    for element in elements:
        if element.count and not element.properties:
            raise ValueError(f"element {element.name} in the header has no property")
        if form == "ascii":
            # Its values are counted during reading.
            continue
        min_bytes = integer_sum(
            np.dtype(_KINDS[length_kind or kind]).itemsize for _, length_kind, kind in element.properties
        )
        if element.count * min_bytes > length:
            count = str(element.count) if element.count < _MAX_COUNT else f"{_MAX_COUNT} or more"
            raise ValueError(
                f"its header says {count} {element.plural} of at least {min_bytes} bytes each, and {length} bytes "
                "follow: it is cut short, or the count is wrong"
            )


def _corner_list(face: PlyElement) -> str:
    """Return the name of the property that lists the corners of a PLY file's face, or raise ValueError."""
    lists = [name for name, length, kind in face.properties if length and kind not in _FRACTIONS]
    for name in (*_CORNER_LISTS, *lists):
        if name in lists:
            return name
    raise ValueError(f"its {face.plural} have no list of whole numbers, such as {_CORNER_LISTS[0]}")


def _rows(form: str, elements: list[PlyElement], body: bytes) -> dict[str, NDArray[np.void]]:
    """Parse the rows of every element of a PLY file; return arrays by the element's name, or raise ValueError."""
    if form != "ascii":
        uniform = _uniform_rows(elements, body, "<" if form == "binary_little_endian" else ">")
        if uniform is not None:
            return uniform
    try:
        import plyfile
    except ModuleNotFoundError as error:
        raise ValueError(
            "its rows differ in length, or are text, and the Python package plyfile, which reads those, is missing: "
            "install it, or write binary PLY with triangles alone, or OBJ"
        ) from error

    if form == "ascii":
        body = b"\n".join(_ascii_rows(elements, body.split())) + b"\n"
    lines = ["ply", f"format {form} 1.0", *(line for element in elements for line in element.lines()), "end_header"]
    stream = io.BytesIO(("\n".join(lines) + "\n").encode() + body)
    try:
        with warnings.catch_warnings():
            # plyfile warns of an empty list in an ASCII file.
            warnings.simplefilter("ignore")
            read = plyfile.PlyData.read(stream, mmap=False)
    except plyfile.PlyElementParseError as error:
        cut = error.message.startswith("early end-of-file")
        row = "" if error.row is None else f" {error.row}"
        raise ValueError(
            f"it is cut short: it ends within {error.element.name}{row} of {error.element.count}"
            if cut
            else f"{error.element.name}{row} is wrong: {error.message}"
        ) from error
    except (plyfile.PlyParseError, ValueError, OverflowError) as error:
        raise ValueError(str(error)) from error
    if form != "ascii":
        _check_end(len(body), stream.tell() - (len(stream.getvalue()) - len(body)))
    return {element.name: element.data for element in read.elements}


def _check_end(length: int, n_read: int) -> None:
    """Raise ValueError if a binary PLY file has bytes after its last row."""
    if n_read < length:
        raise ValueError(f"{length - n_read} bytes follow its last row: a count in its header is wrong")


def _uniform_rows(elements: list[PlyElement], body: bytes, order: str) -> dict[str, NDArray[np.void]] | None:
    """Read the rows of a binary PLY file as arrays; None if an element's rows differ in length or the size is wrong."""
    rows: dict[str, NDArray[np.void]] = {}
    offset = 0
    # An element without rows has no first row, whose lists give the lengths.
    for element in filter(lambda element: element.count, elements):
        fields: list[tuple[str, str, tuple[int, ...]]] = []
        lengths: dict[str, int] = {}
        end = offset
        for name, length, kind in element.properties:
            shape: tuple[int, ...] = ()
            if length:
                size = np.dtype(order + _KINDS[length])
                if end + size.itemsize > len(body):
                    return None
                # The length in the first row counts for every row.
                lengths[f"length of {name}"] = int(np.frombuffer(body, size, 1, end)[0])
                shape = (max(0, lengths[f"length of {name}"]),)
                fields.append((f"length of {name}", order + _KINDS[length], ()))
                end += size.itemsize
            fields.append((name, order + _KINDS[kind], shape))
            end += np.dtype(_KINDS[kind]).itemsize * (shape[0] if shape else 1)
        if len({name for name, _, _ in fields}) < len(fields) or (end - offset) * element.count > len(body) - offset:
            return None
        row = np.dtype(fields)
        rows[element.name] = np.frombuffer(body, row, element.count, offset)
        if any(np.any(rows[element.name][name] != length) for name, length in lengths.items()):
            return None
        offset += row.itemsize * element.count
    return rows if offset == len(body) else None


def _ascii_rows(elements: list[PlyElement], values: list[bytes]) -> Iterator[bytes]:
    """Yield each row of an ASCII PLY file as a line, from its values; raise ValueError if their count is wrong."""
    index = 0
    for element in elements:
        for row in range(element.count):
            row_start = index
            for name, length, _ in element.properties:
                index += 1
                if length and index <= len(values):
                    index += _list_length(values[index - 1], f"{element.name} {row}", name)
            if index > len(values):
                n_values = len(values) - row_start
                if row + 1 < element.count or not n_values:
                    raise ValueError(f"it ends after {row + bool(n_values)} of {element.count} {element.plural}")
                raise ValueError(f"{element.name} {row} has {n_values} of {index - row_start} values")
            yield b" ".join(values[row_start:index])
    if index < len(values):
        raise ValueError(f"{len(values) - index} values follow its last row: a count in its header is wrong")


def _list_length(value: bytes, row: str, name: str) -> int:
    if not value.isdigit() or len(value) > 9:
        raise ValueError(f"{row} has a list {name} of length {value[:20].decode(errors='replace')!r}")
    return int(value)


def _triangles(strip: list[int]) -> Iterator[list[int]]:
    """Yield triangles of strips, which -1 separates; reverse every second one, drop those with a repeated vertex."""
    for ends, run in itertools.groupby(strip, key=lambda vertex: vertex == -1):
        if ends:
            continue
        corners = list(run)
        for k in range(len(corners) - 2):
            first, second, third = corners[k : k + 3]
            if len({first, second, third}) == 3:
                yield [first, second, third] if k % 2 == 0 else [second, first, third]
