# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes from OBJ, PLY and STL files; vertices keep the order of the file.

PLY and STL are read by trimesh, after checks of what it takes in silence: files that end before their header says.
"""

from __future__ import annotations

import codecs
import io
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.sheets.meshes import CheckedMesh, checked_mesh, triangulated

KINDS = ("obj", "ply", "stl")
#: Bytes of a binary STL file's header, the count of triangles included, and of each triangle.
STL_HEADER, STL_TRIANGLE = 84, 50

#: Vertices (n, 3) [m], triangles (m, 3), and what was mended on the way.
_Read: TypeAlias = tuple[NDArray[np.float64], NDArray[np.int64], list[str]]

_log = logging.getLogger(__name__)


def parse(data: bytes, *, name: str, several: bool = False) -> MeshSheet:
    """Return the sheet of a mesh file's content, its name given for its kind and for messages; says what it repaired.

    Args:
        data: the content.
        name: of the file.
        several: whether it may hold several pieces of cloth.

    Raises:
        ValueError: if it is not such a file, or holds no surface of one cloth.
    """
    mesh = read(data, name=name, several=several)
    for repair in mesh.repairs:
        _log.warning("mesh '%s': %s", name, repair)
    return MeshSheet(rest=mesh.positions, surface=mesh.surface)


def read(data: bytes, *, name: str, several: bool = False) -> CheckedMesh:
    """Return the checked mesh of a file's content; `parse` without words.

    An STL file repeats a vertex in each of its triangles: that is how the format is, so making them one is no repair
    there, and vertices are numbered as they first appear.

    Raises:
        ValueError: if it is not such a file, or holds no surface of one cloth.
    """
    kind, (points, faces, words) = _content(data, name)
    mesh = checked_mesh(points, faces, several=several)
    repairs = [repair for repair in mesh.repairs if kind != "stl" or "at the place of another" not in repair]
    return CheckedMesh(
        positions=mesh.positions, surface=mesh.surface, kept=mesh.kept, repairs=tuple((*words, *repairs))
    )


def solid(data: bytes, *, name: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices (n, 3) [m] and triangles (m, 3) of a mesh file's content that is to be a solid.

    Vertices at one place are made one, those of no triangle left out; nothing else is mended.

    Raises:
        ValueError: if it is not such a file, or a triangle names a vertex that is not there.
    """
    _, (points, faces, _) = _content(data, name)
    if len(faces) == 0:
        raise ValueError(f"'{name}' has no triangles; a solid has at least 4")
    if faces.min() < 0 or faces.max() >= len(points):
        raise ValueError(f"'{name}' has vertices 0 to {len(points) - 1}, and a triangle of others")
    # Adding zero makes one zero of both.
    _, first, same = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    corners = first[same.reshape(-1)][faces]
    kept = np.unique(corners)
    number = np.zeros(len(points), dtype=np.int64)
    number[kept] = np.arange(len(kept))
    return np.ascontiguousarray(points[kept]), number[corners]


def _content(data: bytes, name: str) -> tuple[str, _Read]:
    """The kind of a mesh file, and what is in it."""
    kind = Path(name).suffix.lower().lstrip(".")
    if kind not in KINDS:
        raise ValueError(f"'{name}' is no mesh file that can be read: its name must end in {', '.join(KINDS)}")
    try:
        return kind, {"obj": _obj, "ply": _ply, "stl": _stl}[kind](data)
    except ValueError as error:
        raise ValueError(f"'{name}' is no readable {kind.upper()} file: {error}") from error


def _obj(data: bytes) -> _Read:
    """Vertices and faces of an OBJ file alone.

    Not by trimesh, which splits and reorders at materials, groups and texture seams, counts relative indices from the
    end of the file and cuts concave faces along an outer diagonal.
    """
    points: list[list[float]] = []
    polygons: list[list[int]] = []
    highest, highest_line = 0, 0
    for number, words in _obj_lines(data):
        if words[0] == b"v":
            if len(words) < 4:
                raise ValueError(f"line {number}: a vertex has 3 coordinates, not {len(words) - 1}")
            try:
                points.append([float(word) for word in words[1:4]])
            except ValueError as error:
                raise ValueError(f"line {number}: {error}") from error
        elif words[0] == b"f":
            face = [_obj_index(word, number, len(points)) for word in words[1:]]
            if len(face) < 3:
                raise ValueError(f"line {number}: a face has at least 3 corners, not {len(face)}")
            if max(face) >= highest:
                highest, highest_line = max(face) + 1, number
            polygons.append(face)
    if highest > len(points):
        raise ValueError(f"line {highest_line}: a face has vertex {highest}; the file has {len(points)} vertices")
    positions = np.array(points, dtype=np.float64).reshape(-1, 3)
    return positions, triangulated(positions, polygons), []


def _obj_lines(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """The number, from 1, and the words of each line that has any, continued lines joined, comments left out."""
    words: list[bytes] = []
    begin = 0
    for number, line in enumerate(data.removeprefix(codecs.BOM_UTF8).splitlines(), start=1):
        begin = begin or number
        line = line.split(b"#", 1)[0].rstrip()
        words += line.removesuffix(b"\\").split()
        if line.endswith(b"\\"):
            continue
        if words:
            yield begin, words
        words, begin = [], 0
    if words:
        yield begin, words


def _obj_index(word: bytes, line: int, before: int) -> int:
    """The vertex, from 0, of a face's corner like 7, 7/1/2 or -1, the last of the `before` vertices above the face."""
    try:
        index = int(word.split(b"/", 1)[0])
    except ValueError as error:
        raise ValueError(f"line {line}: {word.decode(errors='replace')!r} is no corner of a face") from error
    if index == 0:
        raise ValueError(f"line {line}: a face has vertex 0; indices count from 1")
    if index < -before:
        raise ValueError(f"line {line}: a face has vertex {index}, with only {before} vertices above it")
    return index - 1 if index > 0 else before + index


def _ply(data: bytes) -> _Read:
    """Vertices and faces of a PLY file; not through trimesh's mesh, which cuts concave faces outside."""
    from trimesh.exchange.ply import load_ply

    if b"end_header" not in data:
        raise ValueError("the header does not end with end_header")
    head, body = data.split(b"end_header", 1)
    if b"ascii" in head.split(b"element", 1)[0]:
        _check_ascii_ply(head, body.split(b"\n", 1)[-1])
    try:
        loaded = _by_trimesh(load_ply, io.BytesIO(data), fix_texture=False, skip_materials=True)
    except ValueError as error:
        if "unexpected length" not in str(error):
            raise
        raise ValueError(
            "its length is not what its header says: it is cut short, or has more behind its end, or its faces have "
            "different numbers of corners, which can be read from ASCII PLY only"
        ) from error
    face = loaded["metadata"]["_ply_raw"].get("face", {})
    if not face.get("length") or "vertices" not in loaded:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), []
    rows = face["data"]
    lists = [key for key in ("vertex_indices", "vertex_index", *face["properties"]) if key in face["properties"]]
    polygons = rows[lists[0]]
    if isinstance(rows, np.ndarray):
        counts, polygons = polygons["f0"], polygons["f1"]
        if np.any(counts != counts[0]):
            raise ValueError(f"face {int(np.argmax(counts != counts[0]))} has another number of corners than face 0")
    points = np.array(loaded["vertices"], dtype=np.float64).reshape(-1, 3)
    return points, triangulated(points, [np.asarray(row).astype(np.int64).tolist() for row in polygons]), []


def _check_ascii_ply(head: bytes, body: bytes) -> None:
    """Refuse a file with fewer rows, or fewer values in a row, than its header says: trimesh takes what there is."""
    elements: list[tuple[str, int, list[bool]]] = []
    for words in (line.split() for line in head.splitlines()):
        if words[:1] == [b"element"] and len(words) == 3:
            elements.append((words[1].decode(errors="replace"), int(words[2]), []))
        elif words[:1] == [b"property"] and elements:
            elements[-1][2].append(words[1:2] == [b"list"])
    rows = body.rstrip().splitlines()
    at = 0
    for element, count, properties in elements:
        here = rows[at : at + count]
        if len(here) < count:
            many = {"vertex": "vertices"}.get(element, element + "s")
            raise ValueError(f"it ends after {len(here)} of {count} {many}")
        for number, row in enumerate(here):
            values = row.split()
            needed = 0
            for is_list in properties:
                needed += 1 + (int(values[needed]) if is_list and needed < len(values) else 0)
            if len(values) < needed:
                raise ValueError(f"{element} {number} has {len(values)} of {needed} values")
        at += count


def _stl(data: bytes) -> _Read:
    """Corners of an STL file's triangles, three for each, once its length is known to be right."""
    import trimesh

    count = int.from_bytes(data[80:84], "little")
    length, words = STL_HEADER + STL_TRIANGLE * count, []
    told = None
    if len(data) != length and b"\0" not in data and data.lstrip()[:5].lower() == b"solid":
        told = _ascii_stl_facets(data)
    elif len(data) < STL_HEADER:
        raise ValueError(f"it has {len(data)} bytes; a binary file has a header of {STL_HEADER}")
    elif len(data) < length:
        raise ValueError(f"it ends after {(len(data) - STL_HEADER) // STL_TRIANGLE} of {count} triangles")
    elif len(data) - length >= STL_TRIANGLE:
        raise ValueError(
            f"its header says {count} triangles, but {len(data) - length} bytes follow them, room for "
            f"{(len(data) - length) // STL_TRIANGLE} more: the count is wrong, or something was added; write it anew"
        )
    elif len(data) > length:
        words.append(f"{len(data) - length} bytes after the last triangle left out")
        data = data[:length]
    if (count if told is None else told) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), []
    mesh = _by_trimesh(trimesh.load_mesh, io.BytesIO(data), file_type="stl", process=False, validate=False)
    if told is not None and len(mesh.faces) != told:
        raise ValueError(f"{len(mesh.faces)} of {told} facets could be read: a vertex is not three numbers")
    return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64), words


def _by_trimesh(load: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """What one of trimesh's readers returns.

    What a broken file makes it raise depends on where it breaks; each names the cause. What is raised by the call
    itself, and not within it, is no fault of the file's.

    Raises:
        ValueError: if the file is broken.
    """
    try:
        return load(*arguments, **options)
    except ModuleNotFoundError as error:
        if error.name != "charset_normalizer":
            raise
        # With it trimesh would guess what the text is written in.
        raise ValueError("it has bytes that are no text in UTF-8") from error
    except (KeyError, IndexError, AttributeError, TypeError, EOFError, NameError) as error:
        within = error.__traceback__ is not None and error.__traceback__.tb_next is not None
        if not within:
            raise
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _ascii_stl_facets(data: bytes) -> int:
    """The number of facets in an ASCII STL file, every one of them whole."""
    first = [words[0] for words in (line.split() for line in data.lower().splitlines()) if words]
    begun, ended = first.count(b"facet"), first.count(b"endfacet")
    if ended < begun:
        raise ValueError(f"it ends after {ended} of {begun} facets, or one lacks its endfacet")
    if first.count(b"endsolid") < first.count(b"solid"):
        raise ValueError(f"it ends after {ended} facets without endsolid: it is cut short")
    if first.count(b"vertex") != 3 * begun:
        raise ValueError(f"{begun} facets have {first.count(b'vertex')} vertices; each has 3, on lines of their own")
    return begun
