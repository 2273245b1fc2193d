# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes from OBJ, PLY and STL files; vertices keep the file's order.

trimesh reads STL, after checks for files that end before their header says, which trimesh accepts silently. Vertices
that are copies of each other, up to rounding, are merged (`physics.model.sheets.merging`).
"""

from __future__ import annotations

import codecs
import io
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.contact.solid_repair import close_solid, drop_unused_vertices, is_closed
from cloth_sim_ros.physics.model.sheets.merging import merge_limit
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.model.sheets.meshes import CheckedMesh, checked_mesh, triangulate

KINDS = ("obj", "ply", "stl")
#: Bytes of a binary STL file's header, the count of triangles included, and of each triangle.
STL_HEADER, STL_TRIANGLE = 84, 50

_log = logging.getLogger(__name__)


@attrs.frozen(eq=False, kw_only=True)
class _Content:
    """Vertices and triangles of a mesh file, before they are checked."""

    points: NDArray[np.float64]
    """Vertices in the file's order and unit, (n, 3)."""
    triangles: NDArray[np.int64]
    """Vertices of each, (m, 3)."""
    repairs: tuple[str, ...] = ()
    """Repairs, one sentence each."""
    single: bool = False
    """True if vertices are in single precision."""


@attrs.frozen(eq=False, kw_only=True)
class SolidMesh:
    """Vertices and triangles of a mesh that is to bound a solid, such as an obstacle."""

    vertices: NDArray[np.float64]
    """[m], (m, 3)."""
    triangles: NDArray[np.int64]
    """Vertices of each, (t, 3)."""
    notes: tuple[str, ...] = ()
    """Repairs that closed it, one sentence each; empty for a closed mesh."""


def parse(data: bytes, *, name: str, several: bool = False, merge: bool = True, scale: float = 1.0) -> MeshSheet:
    """Parse a mesh file's content as a cloth's sheet, and log merges and repairs; arguments and errors as `read`.

    Raises:
        ValueError: if it is no such file, or holds no surface of one cloth.
    """
    mesh = read(data, name=name, several=several, merge=merge, scale=scale)
    for note in mesh.notes:
        _log.info("mesh '%s': %s", name, note)
    for repair in mesh.repairs:
        _log.warning("mesh '%s': %s", name, repair)
    return MeshSheet(rest_positions=mesh.positions, surface=mesh.surface, notes=mesh.notes, repairs=mesh.repairs)


def read(data: bytes, *, name: str, several: bool = False, merge: bool = True, scale: float = 1.0) -> CheckedMesh:
    """Parse and check a mesh file's content as the surface of a cloth, without logging; raise ValueError if it is none.

    An STL file repeats a vertex in each of its triangles by design. Merging these copies is therefore not reported as a
    repair, and vertices are numbered in order of appearance.

    Args:
        data: the content.
        name: name of the file; its suffix gives the format.
        several: True accepts several pieces of cloth.
        merge: True merges vertices that are copies up to rounding; False merges those at exactly one position only.
        scale: factor from the file's unit to metres.

    Raises:
        ValueError: if it is no such file, or holds no surface of one cloth.
    """
    kind, content = _content(data, name)
    limit = _merge_limit(content) if merge else 0.0
    mesh = checked_mesh(content.points, content.triangles, allow_pieces=several, merge_limit=limit, scale=scale)
    repairs = [repair for repair in mesh.repairs if kind != "stl" or "at the place of another" not in repair]
    return attrs.evolve(mesh, repairs=(*content.repairs, *repairs))


def parse_solid(data: bytes, *, name: str, scale: float = 1.0) -> SolidMesh:
    """Parse a mesh file's content as the mesh of a solid; repair an open one and log that. Raise ValueError if unfit.

    Vertices at one position are merged, and unused ones are dropped. A mesh that is still open is repaired. Copies of
    vertices are merged and flat triangles joined to neighbours. Edges are split at vertices that lie on them.

    Args:
        data: the content.
        name: name of the file; its suffix gives the format.
        scale: factor from the file's unit to metres.

    Raises:
        ValueError: if it is no such file, or a triangle names a vertex that does not exist.
    """
    _, content = _content(data, name)
    points, faces = content.points, content.triangles
    if len(faces) == 0:
        raise ValueError(f"'{name}' has no triangles; a solid has at least 4")
    if faces.min() < 0 or faces.max() >= len(points):
        raise ValueError(f"'{name}' has vertices 0 to {len(points) - 1}, and a triangle of others")
    # Adding zero turns -0.0 into 0.0.
    _, first, same = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    vertices, triangles = drop_unused_vertices(points, first[same.reshape(-1)][faces])
    notes: tuple[str, ...] = ()
    if not is_closed(vertices, triangles):
        used = content.points[np.unique(faces)]
        limit = merge_limit(used, single_precision=content.single) if np.isfinite(used).all() else 0.0
        vertices, triangles, notes = close_solid(vertices, triangles, limit)
        for note in notes:
            _log.info("mesh '%s': %s", name, note)
    return SolidMesh(vertices=vertices if scale == 1.0 else vertices * scale, triangles=triangles, notes=notes)


def _merge_limit(content: _Content) -> float:
    """Return the distance below which vertices of a mesh file are copies of each other, in the file's unit."""
    faces, count = content.triangles, len(content.points)
    used = np.unique(faces[(faces >= 0) & (faces < count)])
    points = content.points[used]
    return merge_limit(points[np.isfinite(points).all(axis=1)], single_precision=content.single)


def _content(data: bytes, name: str) -> tuple[str, _Content]:
    """Parse a mesh file's bytes by the suffix of its name; return suffix and content, or raise ValueError."""
    kind = Path(name).suffix.lower().lstrip(".")
    if kind not in KINDS:
        raise ValueError(f"'{name}' is no mesh file that can be read: its name must end in {', '.join(KINDS)}")
    try:
        return kind, {"obj": _obj, "ply": _ply, "stl": _stl}[kind](data)
    except ValueError as error:
        raise ValueError(f"'{name}' is no readable {kind.upper()} file: {error}") from error


def _obj(data: bytes) -> _Content:
    """Parse the bytes of an OBJ file; return vertices and triangulated faces, or raise ValueError that names the line.

    trimesh is not used here. It splits and reorders vertices at materials, groups and texture seams. It also counts
    relative indices from the file's end and cuts concave faces along an outer diagonal.
    """
    points: list[list[float]] = []
    polygons: list[list[int]] = []
    max_index, max_index_line = 0, 0
    for line_number, words in _obj_lines(data):
        if words[0] == b"v":
            if len(words) < 4:
                raise ValueError(f"line {line_number}: a vertex has 3 coordinates, not {len(words) - 1}")
            try:
                points.append([float(word) for word in words[1:4]])
            except ValueError as error:
                raise ValueError(f"line {line_number}: {error}") from error
        elif words[0] == b"f":
            face = [_obj_index(word, line_number, len(points)) for word in words[1:]]
            if len(face) < 3:
                raise ValueError(f"line {line_number}: a face has at least 3 corners, not {len(face)}")
            if max(face) >= max_index:
                max_index, max_index_line = max(face) + 1, line_number
            polygons.append(face)
    if max_index > len(points):
        raise ValueError(f"line {max_index_line}: a face has vertex {max_index}; the file has {len(points)} vertices")
    positions = np.array(points, dtype=np.float64).reshape(-1, 3)
    return _Content(points=positions, triangles=triangulate(positions, polygons))


def _obj_lines(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Yield line number, from 1, and words of each non-empty line of an OBJ file, continued lines joined."""
    words: list[bytes] = []
    first_line = 0
    for line_number, line in enumerate(data.removeprefix(codecs.BOM_UTF8).splitlines(), start=1):
        first_line = first_line or line_number
        line = line.split(b"#", 1)[0].rstrip()
        words += line.removesuffix(b"\\").split()
        if line.endswith(b"\\"):
            continue
        if words:
            yield first_line, words
        words, first_line = [], 0
    if words:
        yield first_line, words


def _obj_index(word: bytes, line: int, n_vertices: int) -> int:
    """Return a face corner's vertex index, from 0, of a word like 7, 7/1/2 or -1 (the last so far), or raise."""
    try:
        index = int(word.split(b"/", 1)[0])
    except ValueError as error:
        raise ValueError(f"line {line}: {word.decode(errors='replace')!r} is no corner of a face") from error
    if index == 0:
        raise ValueError(f"line {line}: a face has vertex 0; indices count from 1")
    if index < -n_vertices:
        raise ValueError(f"line {line}: a face has vertex {index}, with only {n_vertices} vertices above it")
    return index - 1 if index > 0 else n_vertices + index


def _ply(data: bytes) -> _Content:
    """Parse the bytes of a PLY file; return vertices and triangulated faces, or raise ValueError.

    trimesh is not used here, because it cuts concave faces outside and guesses at the format.
    """
    from cloth_sim_ros.scene.ply_file import read_ply

    mesh = read_ply(data)
    triangles = triangulate(mesh.points, mesh.polygons)
    return _Content(points=mesh.points, triangles=triangles, single=mesh.single)


def _stl(data: bytes) -> _Content:
    """Parse the bytes of an STL file; return three vertices per triangle, or raise ValueError if it is incomplete."""
    try:
        import trimesh
    except ModuleNotFoundError as error:
        raise ValueError("the Python package trimesh, which reads STL, is missing: install it, or write OBJ") from error
    count = int.from_bytes(data[80:84], "little")
    length, repairs = STL_HEADER + STL_TRIANGLE * count, []
    n_facets = None
    if len(data) != length and b"\0" not in data and data.lstrip()[:5].lower() == b"solid":
        n_facets = _ascii_stl_facets(data)
    elif len(data) < STL_HEADER:
        raise ValueError(f"it has {len(data)} bytes; a binary file has a header of {STL_HEADER}")
    elif len(data) < length:
        raise ValueError(f"it ends after {(len(data) - STL_HEADER) // STL_TRIANGLE} of {count} triangles")
    elif len(data) - length >= STL_TRIANGLE:
        raise ValueError(
            f"its header says {count} triangles, but {len(data) - length} bytes follow them, room for "
            f"{(len(data) - length) // STL_TRIANGLE} more: the count is wrong, or bytes were appended; "
            "export the file again"
        )
    elif len(data) > length:
        repairs.append(f"{len(data) - length} bytes after the last triangle left out")
        data = data[:length]
    if (count if n_facets is None else n_facets) == 0:
        return _Content(points=np.zeros((0, 3)), triangles=np.zeros((0, 3), dtype=np.int64))
    mesh = load_with_trimesh(trimesh.load_mesh, io.BytesIO(data), file_type="stl", process=False, validate=False)
    if n_facets is not None and len(mesh.faces) != n_facets:
        raise ValueError(f"{len(mesh.faces)} of {n_facets} facets could be read: a vertex is not three numbers")
    return _Content(
        points=np.array(mesh.vertices, dtype=np.float64),
        triangles=np.array(mesh.faces, dtype=np.int64),
        repairs=tuple(repairs),
        single=True,
    )


def load_with_trimesh(load: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call a reader of trimesh, with trimesh's logger silenced for good; convert errors of a broken file to ValueError.

    The exception that a broken file raises depends on the fault; its text names the cause. An exception of the call
    itself, not of code within it, is a programming error and passes.

    Raises:
        ValueError: if the file is broken.
    """
    # trimesh logs the exceptions of the readers that it tries one after the other.
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        return load(*arguments, **options)
    except ModuleNotFoundError as error:
        if error.name != "charset_normalizer":
            raise
        # That package would let trimesh guess the text's encoding.
        raise ValueError("it has bytes that are no text in UTF-8") from error
    except (KeyError, IndexError, AttributeError, TypeError, EOFError, NameError) as error:
        is_from_reader = error.__traceback__ is not None and error.__traceback__.tb_next is not None
        if not is_from_reader:
            raise
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _ascii_stl_facets(data: bytes) -> int:
    """Return the number of facets in an ASCII STL file; raise ValueError if one is incomplete."""
    first = [words[0] for words in (line.split() for line in data.lower().splitlines()) if words]
    begun, ended = first.count(b"facet"), first.count(b"endfacet")
    if ended < begun:
        raise ValueError(f"it ends after {ended} of {begun} facets, or one lacks its endfacet")
    if first.count(b"endsolid") < first.count(b"solid"):
        raise ValueError(f"it ends after {ended} facets without endsolid: it is cut short")
    if first.count(b"vertex") != 3 * begun:
        raise ValueError(f"{begun} facets have {first.count(b'vertex')} vertices; each has 3, on lines of their own")
    return begun
