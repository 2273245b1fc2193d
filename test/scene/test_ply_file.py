# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""PLY files as programs write them: formats, faces of several sizes, further properties and elements."""

from __future__ import annotations

import struct
from collections.abc import Iterable

import pytest

from cloth_sim_ros.scene import mesh_file

pytest.importorskip("plyfile")

POINTS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)]
FACES = [[0, 1, 2, 3], [1, 4, 2]]
TRIANGLES = [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
XYZ = ("float x", "float y", "float z")
CORNERS = ("list uchar int vertex_indices",)


def head(form: str, *elements: tuple[str, int, Iterable[str]], further: Iterable[str] = ()) -> bytes:
    lines = ["ply", f"format {form} 1.0", *further]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {entry}" for entry in properties)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def binary(order: str = "<", *, texture: bool = False, edges: bool = False, further: Iterable[str] = ()) -> bytes:
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    faces = (*CORNERS, "list uchar float texcoord") if texture else CORNERS
    elements = [("vertex", len(POINTS), XYZ), ("face", len(FACES), faces)]
    elements += [("edge", 1, ("int vertex1", "int vertex2"))] if edges else []
    data = head(form, *elements, further=further)
    data += b"".join(struct.pack(f"{order}3f", *point) for point in POINTS)
    for face in FACES:
        data += struct.pack(f"{order}B{len(face)}i", len(face), *face)
        if texture:
            data += struct.pack(f"{order}B{2 * len(face)}f", 2 * len(face), *[0.5] * 2 * len(face))
    return data + (struct.pack(f"{order}2i", 0, 1) if edges else b"")


ROWS = "".join(f"{x} {y} {z}\n" for x, y, z in POINTS)
FACE_ROWS = "4 0 1 2 3\n3 1 4 2\n"
TEXT_HEAD = head("ascii", ("vertex", 5, XYZ), ("face", 2, CORNERS))
TEXT = TEXT_HEAD + (ROWS + FACE_ROWS).encode()
LISTS = (*CORNERS, "list uchar float texcoord")
TEXTURED = "4 0 1 2 3 8 0 0 1 0 1 1 0 1\n3 1 4 2 6 0 0 1 0 1 1\n"
TYPES = ("uchar red", "double x", "int8 flag", "float64 y", "float nx", "double z")
COLOURED = "".join(f"7 {x} -1 {y} 0.5 {z}\n" for x, y, z in POINTS)
FILES = {
    "little endian": binary(),
    "big endian": binary(">"),
    "texture of mixed faces": binary(texture=True),
    "texture, big endian": binary(">", texture=True),
    "edges": binary(edges=True),
    "ascii in a comment": binary(further=["comment made from an ascii file", "obj_info ascii"]),
    "a comment before the format": binary().replace(b"ply\n", b"ply\ncomment ascii end_header\n", 1),
    "text": TEXT,
    "Windows lines": TEXT.replace(b"\n", b"\r\n"),
    "old Macintosh lines": TEXT.replace(b"\n", b"\r"),
    "blank lines": TEXT_HEAD + f"\n{ROWS}\n\n{FACE_ROWS}\n".replace("\n3", "\n\n3").encode(),
    "a value a line": TEXT_HEAD + "\n".join((ROWS + FACE_ROWS).split()).encode(),
    "texture in text": head("ascii", ("vertex", 5, XYZ), ("face", 2, LISTS)) + (ROWS + TEXTURED).encode(),
    "colours and types": head("ascii", ("vertex", 5, TYPES), ("face", 2, ("list ushort uint vertex_index",)))
    + (COLOURED + FACE_ROWS).encode(),
    "faces first": head("ascii", ("face", 2, CORNERS), ("vertex", 5, XYZ)) + (FACE_ROWS + ROWS).encode(),
    "texture before corners": head("ascii", ("vertex", 5, XYZ), ("face", 2, ("list uchar float uv", *CORNERS)))
    + (ROWS + "2 0.5 0.5 4 0 1 2 3\n0 3 1 4 2\n").encode(),
    "empty texture": head("ascii", ("vertex", 5, XYZ), ("face", 2, LISTS))
    + (ROWS + "4 0 1 2 3 0\n3 1 4 2 0\n").encode(),
}


@pytest.mark.parametrize("kind", FILES)
def test_ply_is_read_as_it_was_written(kind: str) -> None:
    mesh = mesh_file.read(FILES[kind], name="cloth.ply")
    assert mesh.positions.tolist() == [list(map(float, point)) for point in POINTS]
    assert mesh.surface.triangles.tolist() == TRIANGLES
    assert mesh.repairs == ()


def test_ply_of_triangles_needs_no_further_package(monkeypatch: pytest.MonkeyPatch) -> None:
    data = head("binary_little_endian", ("vertex", 5, XYZ), ("face", 3, CORNERS))
    data += b"".join(struct.pack("<3f", *point) for point in POINTS)
    data += b"".join(struct.pack("<B3i", 3, *triangle) for triangle in TRIANGLES)
    monkeypatch.setitem(__import__("sys").modules, "plyfile", None)
    assert mesh_file.read(data, name="cloth.ply").surface.triangles.tolist() == TRIANGLES
    with pytest.raises(
        ValueError, match=r"the Python package plyfile, which .* is missing: install it, or write binary PLY"
    ):
        mesh_file.read(TEXT, name="cloth.ply")


def test_lists_without_rows_have_no_length() -> None:
    # Read as the length of a list, the first coordinate is 3 billion.
    points = [(x - 2.0, y, z) for x, y, z in POINTS]
    elements = ("patch", 0, ("list uint double control",)), ("vertex", 5, XYZ), ("face", 3, CORNERS)
    data = head("binary_little_endian", *elements) + b"".join(struct.pack("<3f", *point) for point in points)
    data += b"".join(struct.pack("<B3i", 3, *triangle) for triangle in TRIANGLES)
    assert mesh_file.read(data, name="cloth.ply").positions.tolist() == [list(point) for point in points]


def test_triangle_strips_are_triangles() -> None:
    header = head("ascii", ("vertex", 5, XYZ), ("tristrips", 1, ("list int int vertex_indices",)))
    mesh = mesh_file.read(header + f"{ROWS}8 3 0 2 1 -1 2 1 4\n".encode(), name="cloth.ply")
    assert mesh.surface.triangles.tolist() == [[3, 0, 2], [2, 0, 1], [2, 1, 4]]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", ["9223372036854775808", "18446744073709551617", "1" + 5000 * "0", "1000000000000"])
@pytest.mark.parametrize("element", ["vertex", "face"])
def test_ply_count_beyond_the_file_is_refused(element: str, count: str, form: str) -> None:
    data = TEXT if form == "ascii" else binary("<" if "little" in form else ">")
    row = {"vertex": 5, "face": 2}[element]
    data = data.replace(f"element {element} {row}".encode(), f"element {element} {count}".encode())
    with pytest.raises(ValueError, match=r"no readable PLY file: it ends after|its header says .* bytes follow"):
        mesh_file.read(data, name="cloth.ply")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (binary()[:-3], "cut short: it ends within face 1 of 2"),
        (binary() + b"\0", "1 bytes follow its last row"),
        (TEXT + b"7\n", "1 values follow its last row"),
        (TEXT.replace(b"float y", b"float v"), "its vertices have no property y"),
        (TEXT.replace(b"int vertex", b"float vertex"), "its faces have no list of whole numbers"),
        (TEXT.replace(b"float x", b"real x"), "'property real x' in the header is no PLY"),
        (TEXT.replace(b"format ascii", b"format text"), "'format text 1.0' in the header is no PLY"),
        (TEXT.replace(b"format ascii 1.0\n", b""), "the header has no format"),
        (TEXT.replace(b"1 4 2", b"1 4 x"), "face 1 is wrong"),
        (TEXT.replace(b"3 1 4 2", b"-3 1 4 2"), "face 1 has a list vertex_indices of length '-3'"),
        (TEXT.replace(b"element face", b"element void 9\nelement face"), "element void in the header has no property"),
        (TEXT[4:], "it does not begin with ply"),
    ],
)
def test_broken_ply_is_refused_in_a_sentence(data: bytes, words: str) -> None:
    with pytest.raises(ValueError, match=f"no readable PLY file: .*{words}"):
        mesh_file.read(data, name="cloth.ply")
