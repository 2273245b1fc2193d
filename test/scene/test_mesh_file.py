# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mesh files: round trips, reported repairs, and refusals with the location of the fault."""

import logging

import numpy as np
import pytest
import trimesh

from cloth_sim_ros.physics.model.sheets.meshes import checked_mesh
from cloth_sim_ros.physics.model.sheets.surface import SurfaceError, grid_triangles
from cloth_sim_ros.scene import mesh_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

ROWS, COLUMNS = 4, 5
TRIANGLES = grid_triangles(ROWS, COLUMNS, "alternating")
POINTS = np.stack((*np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)[::-1], np.zeros(ROWS * COLUMNS)), axis=1)
POINTS = POINTS + 0.01 * np.random.default_rng(0).standard_normal(POINTS.shape)
SHUFFLED = np.random.default_rng(1).permutation(len(POINTS))


def grid():
    """Return the grid with shuffled vertices."""
    new_index = np.argsort(SHUFFLED)
    return POINTS[SHUFFLED].copy(), new_index[TRIANGLES].copy()


def obj(points, triangles):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(points).tolist()]
    return "\n".join(lines + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles]).encode()


def normals(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "OBJ"])
def test_a_written_mesh_is_read_again(kind):
    points, triangles = grid()
    written = trimesh.Trimesh(points, triangles, process=False).export(file_type=kind.lower())
    mesh = mesh_file.read(written.encode() if isinstance(written, str) else written, name=f"cloth.{kind}")
    assert mesh.repairs == ()
    assert len(mesh.positions) == len(points)
    read_triangles, written_triangles = mesh.positions[mesh.surface.triangles], points[triangles]
    assert read_triangles == pytest.approx(written_triangles, abs=1e-6)  # STL and trimesh's text keep single precision
    if kind != "stl":  # the format has no vertex numbers
        assert mesh.surface.triangles.tolist() == triangles.tolist()


def test_texture_seams_groups_and_quads_keep_the_files_vertices():
    text = b"""
o cloth
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 2 0 0
v 2 1 0
vt 0 0
vt 1 1
g left
usemtl red
f 1/1 2/2 3/1 4/2
g right
usemtl blue
f 2/1 5/1 6/1
f 2/2 6/1 3/2
"""
    mesh = mesh_file.read(text, name="seams.obj")
    assert mesh.positions[:, :2].tolist() == [[0, 0], [1, 0], [1, 1], [0, 1], [2, 0], [2, 1]]
    assert len(mesh.surface.triangles) == 4
    assert len(mesh.surface.boundary_loops()) == 1


def test_parse_gives_a_sheet_and_says_what_it_mended(caplog):
    points, triangles = grid()
    triangles[3] = triangles[3][::-1]
    with caplog.at_level(logging.WARNING):
        sheet = mesh_file.parse(obj(points, triangles), name="cloth.obj")
    assert sheet.positions() == pytest.approx(points)
    assert "mesh 'cloth.obj': 1 triangle wound against the others turned round" in caplog.text


def test_triangles_wound_against_the_others_are_turned():
    # The larger part, not the first triangle, determines the orientation.
    points, triangles = grid()
    triangles[[0, 7, 8]] = triangles[[0, 7, 8], ::-1]
    mesh = checked_mesh(points, triangles)
    assert mesh.repairs == ("3 triangles wound against the others turned round",)
    assert (normals(mesh.positions, mesh.surface.triangles)[:, 2] > 0).all()


def test_unused_vertices_are_dropped_even_if_not_finite():
    points, triangles = grid()
    points = np.insert(points, 6, [np.nan, 0, 0], axis=0)
    mesh = checked_mesh(points, triangles + (triangles >= 6))
    assert mesh.repairs == ("1 vertex in no triangle left out",)
    assert mesh.vertex_indices.tolist() == [k for k in range(len(points)) if k != 6]
    assert mesh.surface.triangles.tolist() == triangles.tolist()


def test_vertices_at_one_place_become_one():
    points, triangles = grid()
    soup = checked_mesh(points[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3))
    assert soup.repairs == (f"{triangles.size - len(points)} vertices at the place of another made one with it",)
    assert len(soup.positions) == len(points)
    assert soup.positions[soup.surface.triangles] == pytest.approx(points[triangles])


def test_repeated_and_collapsed_triangles_are_left_out():
    points, triangles = grid()
    more = np.concatenate((triangles, triangles[4:5, [1, 2, 0]], [[1, 1, 2]]))
    mesh = checked_mesh(points, more)
    assert mesh.repairs == (
        "1 triangle given more than once kept once",
        "1 triangle with a repeated vertex left out",
    )
    assert mesh.surface.triangles.tolist() == triangles.tolist()


def mobius(count=12):
    k = np.arange(count)
    top, bottom = 2 * k, 2 * k + 1
    closing_edges = [(int(t), int(b)) for t, b in zip(np.roll(top, -1), np.roll(bottom, -1), strict=True)]
    closing_edges[-1] = closing_edges[-1][::-1]
    triangles = [t for i, (a, b) in enumerate(closing_edges) for t in ([2 * i, a, 2 * i + 1], [2 * i + 1, a, b])]
    turn, half = 2 * np.pi * k / count, np.pi * k / count
    across = 0.3 * np.stack((np.cos(half) * np.cos(turn), np.cos(half) * np.sin(turn), np.sin(half)), axis=1)
    ring = np.stack((np.cos(turn), np.sin(turn), 0 * turn), axis=1)
    return np.stack((ring + across, ring - across), axis=1).reshape(-1, 3), np.array(triangles)


def spoiled(kind):
    points, triangles = grid()
    if kind == "nan":
        points[3, 1] = np.nan
    elif kind == "range":
        triangles[2, 0] = 99
    elif kind == "fin":
        points = np.concatenate((points, [[0.5, 0.5, 1.0]]))
        a, b = triangles[0, :2]
        edges = np.sort(np.concatenate((triangles[:, :2], triangles[:, 1:], triangles[:, ::2])), axis=1)
        unique, uses = np.unique(edges, axis=0, return_counts=True)
        a, b = unique[uses == 2][0]
        triangles = np.concatenate((triangles, [[a, b, len(points) - 1]]))
    elif kind == "line":
        points = np.concatenate((points, [[-1, -1, 0], [-2, -2, 0], [-3, -3, 0]]))
        triangles = np.concatenate((triangles, [[len(points) - 3, len(points) - 2, len(points) - 1]]))
    elif kind == "shells":
        triangles = np.concatenate((triangles, triangles + len(points)))
        points = np.concatenate((points, points + np.array([0, 0, 1.0])))
    elif kind == "touching":
        points = np.concatenate((points, [[9, 9, 9], [9, 8, 9]]))
        triangles = np.concatenate((triangles, [[0, len(points) - 2, len(points) - 1]]))
    elif kind == "mobius":
        return mobius()
    elif kind == "empty":
        triangles = triangles[:0]
    return points, triangles


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("nan", r"vertex 3 is \[.*nan.*\]; positions must be finite"),
        ("range", r"triangle 2 is \[99, .*\]; vertices are 0 to 19"),
        ("fin", r"the edge of vertices \d+ and \d+, at .* belongs to 3 triangles"),
        ("line", r"triangle \[20, 21, 22\] has no area"),
        ("shells", r"2 pieces that share no edge; vertex (2|3)\d is not in the piece of vertex 1?\d:"),
        ("touching", "at particle 0 two parts of the surface touch"),
        ("mobius", "can't be wound alike"),
        ("empty", "no triangles"),
    ],
)
def test_irreparable_mesh_is_refused_with_location(kind, words):
    with pytest.raises(SurfaceError, match=words):
        checked_mesh(*spoiled(kind))


def test_several_pieces_need_self_contact() -> None:
    points, triangles = spoiled("shells")
    assert checked_mesh(points, triangles, allow_pieces=True).surface.pieces().max() == 1
    values = {"cloth.mesh": "two.obj", "cloth.anchors": ["0"], "bending.model": "none", "contact.thickness": 0.001}
    files = {"two.obj": obj(points, triangles)}
    with pytest.raises(ParameterError, match=r"cloth.mesh 'two.obj': .*2 pieces.*set contact.self: true"):
        Scene.from_parameters(values, files=files)
    scene = Scene.from_parameters({**values, "contact.self": True}, files=files)
    assert len(scene.initial_positions()) == len(np.unique(triangles))


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("cloth.step", b"", "must end in obj, ply, stl"),
        ("cloth.obj", b"", "no triangles"),
        ("cloth.obj", b"v a b c\nf 1 2 3\n", "no readable OBJ file"),
        ("cloth.obj", b"v 0 0 0\nf 1 2 3\n", "no readable OBJ file|vertices are"),
        ("cloth.ply", b"garbage \x00\xff", "no readable PLY file"),
        ("cloth.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "no readable PLY file"),
        ("cloth.stl", b"xx", "has 2 bytes; a binary file has a header of 84"),
    ],
)
def test_files_that_are_no_meshes_are_refused(name, data, words):
    with pytest.raises(ValueError, match=words):
        mesh_file.read(data, name=name)


def stl(ascii_text=False):
    mesh = trimesh.Trimesh(*grid(), process=False)
    return mesh.export(file_type="stl_ascii").encode() if ascii_text else mesh.export(file_type="stl")


COUNT = len(TRIANGLES)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (stl()[:-1], f"ends after {COUNT - 1} of {COUNT} triangles"),
        (stl()[:100], f"ends after 0 of {COUNT} triangles"),
        (stl()[:80] + (COUNT + 3).to_bytes(4, "little") + stl()[84:], f"ends after {COUNT} of {COUNT + 3} triangles"),
        (stl()[:80] + (COUNT - 2).to_bytes(4, "little") + stl()[84:], "100 bytes follow them, room for 2 more"),
        (b"solid" + stl()[5:-1], f"ends after {COUNT - 1} of {COUNT} triangles"),
        (stl(True)[: stl(True).rindex(b"endfacet")], f"ends after {COUNT - 1} of {COUNT} facets"),
        (stl(True)[: stl(True).rindex(b"endsolid")], f"ends after {COUNT} facets without endsolid"),
        (stl(True).replace(b"vertex", b"vortex", 1), f"have {3 * COUNT - 1} vertices"),
    ],
)
def test_an_stl_file_of_the_wrong_length_is_refused(data, words):
    with pytest.raises(ValueError, match=f"no readable STL file: .*{words}"):
        mesh_file.read(data, name="cloth.stl")


def test_stl_trailing_bytes_are_dropped_with_warning():
    mesh = mesh_file.read(stl() + b"\r\n\0", name="cloth.stl")
    assert mesh.repairs == ("3 bytes after the last triangle left out",)
    assert len(mesh.surface.triangles) == COUNT
    assert len(mesh_file.read(stl(True) + b"\n\n", name="cloth.stl").surface.triangles) == COUNT


def test_relative_obj_indices_count_back_from_their_line():
    text = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 1 1 0\nf -1/1 -2 -3//4\n"
    mesh = mesh_file.read(text, name="cloth.obj")
    assert mesh.repairs == ()
    assert mesh.surface.triangles.tolist() == [[0, 1, 2], [3, 2, 1]]


@pytest.mark.parametrize(
    ("face", "words"),
    [
        (b"f 0 1 2", "line 4: a face has vertex 0; indices count from 1"),
        (b"f -4 1 2", "line 4: a face has vertex -4, with only 3 vertices above it"),
        (b"f 1 2 4", "line 4: a face has vertex 4; the file has 3 vertices"),
        (b"f 1 2", "line 4: a face has at least 3 corners, not 2"),
        (b"f 1 2 x/3", "line 4: 'x/3' is no corner of a face"),
        (b"v 1 2", "line 4: a vertex has 3 coordinates, not 2"),
    ],
)
def test_a_wrong_obj_line_is_named(face, words):
    with pytest.raises(ValueError, match=words):
        mesh_file.read(b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + face + b"\n", name="cloth.obj")


def test_obj_comments_tabs_bom_and_continuations_are_read():
    text = (
        b"\xef\xbb\xbfv 0 0 0 # first\r\n\tv\t1 0 0\r\n  v 0 \\\r\n 1 0#close\r\nv 1 1 0\r\n"
        b"f 1 2 \\\r\n3 # one\r\n\tf\t2 4 3 # path C:\\\r\n"
    )
    mesh = mesh_file.read(text, name="cloth.obj")
    assert mesh.positions.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert mesh.surface.triangles.tolist() == [[0, 1, 2], [1, 3, 2]]


def ply(points, faces, *, n_faces=None):
    rows = [" ".join(map(str, row)) for row in points] + [" ".join(map(str, (len(f), *f))) for f in faces]
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\n"
    head += (
        f"property float z\nelement face {n_faces or len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return (head + "\n".join(rows) + "\n").encode()


SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (ply(SQUARE, [[0, 1, 2]], n_faces=2), "ends after 1 of 2 faces"),
        (ply(SQUARE, [])[:-8].replace(b"face 0", b"face 2"), "ends after 3 of 4 vertices"),
        (ply(SQUARE, [[0, 1, 2], [0, 2, 3]])[:-3], "face 1 has 3 of 4 values"),
        (trimesh.Trimesh(*grid(), process=False).export(file_type="ply")[:-5], "cut short"),
    ],
)
def test_a_ply_file_cut_short_is_refused(data, words):
    with pytest.raises(ValueError, match=f"no readable PLY file: .*{words}"):
        mesh_file.read(data, name="cloth.ply")


DART = [[0, 0, 0], [2, -1, 0], [0.5, 0, 0], [2, 1, 0]]


@pytest.mark.parametrize("shift", range(4))
@pytest.mark.parametrize("kind", ["obj", "ply", "mixed"])
def test_concave_faces_are_cut_along_the_inner_diagonal(kind, shift):
    points, face = [*DART, [1, -2, 0]], np.roll(range(4), shift).tolist()
    faces = [face, [0, 4, 1]] if kind == "mixed" else [face]
    text = ply(points, faces)
    if kind == "obj":
        text = "".join(f"v {x} {y} {z}\n" for x, y, z in points) + "f " + " ".join(str(k + 1) for k in face)
        text = text.encode()
    mesh = mesh_file.read(text, name="cloth.obj" if kind == "obj" else "cloth.ply")
    area = normals(mesh.positions, mesh.surface.triangles)[:, 2]
    assert (area > 0).all()
    assert area[:2].sum() == pytest.approx(1.0)  # twice the hull's area 2 less the notch's 1.5


def test_face_without_visible_corner_is_refused_with_location():
    comb = [[0, 0, 0], [5, 0, 0], [5, 3, 0], [4, 1, 0], [3, 3, 0], [2, 1, 0], [1, 3, 0], [0.5, 1, 0], [0, 3, 0]]
    with pytest.raises(ValueError, match=r"face 0, of vertices \[0, 1, .*no corner sees all others"):
        mesh_file.read(ply(comb, [list(range(9))]), name="cloth.ply")


@pytest.mark.parametrize(
    ("scale", "shift", "words"),
    [
        (1.0, 3e8, r"vertex \d+ is .*magnitude 3e\+08 m is beyond 1e\+06 m; positions are in metres"),
        (1e200, 0.0, r"magnitude 4.*e\+200 m is beyond"),
        (1e-9, 0.0, r"the whole mesh is 4.*e-09 m across, less than 1e-06 m"),
    ],
)
def test_implausible_mesh_size_is_refused_with_magnitude(scale, shift, words):
    points, triangles = grid()
    with pytest.raises(SurfaceError, match=words):
        checked_mesh(points * scale + shift, triangles)


@pytest.mark.parametrize("kind", ["obj", "ply", "stl"])
def test_program_errors_are_not_reported_as_file_errors(monkeypatch, kind):
    def changed(data):
        raise TypeError("an argument too many")

    monkeypatch.setattr(mesh_file, f"_{kind}", changed)
    with pytest.raises(TypeError, match="an argument too many"):
        mesh_file.read(b"", name=f"cloth.{kind}")


def test_wrong_reader_call_is_not_reported_as_broken_file():
    with pytest.raises(TypeError, match="no_such_option"):
        mesh_file.load_with_trimesh(lambda file: file, b"", no_such_option=True)


def test_damaged_mesh_files_raise_only_value_errors():
    points, triangles = grid()
    mesh = trimesh.Trimesh(points, triangles, process=False)
    ascii_ply = trimesh.exchange.ply.export_ply(mesh, encoding="ascii")
    whole = {
        "obj": [obj(points, triangles)],
        "ply": [mesh.export(file_type="ply"), ascii_ply],
        "stl": [mesh.export(file_type="stl"), mesh.export(file_type="stl_ascii").encode()],
    }
    random = np.random.default_rng(7)
    refused = 0
    for trial in range(600):
        kind = sorted(whole)[trial % 3]
        data = bytearray(whole[kind][trial % len(whole[kind])])
        for _ in range(random.integers(1, 4)):
            at = int(random.integers(len(data)))
            some = bytes(data[at : at + int(random.integers(1, 30))])
            data[at : at + len(some)] = [b"", some + some, b"property\n", bytes([random.integers(256)])][
                random.integers(4)
            ]
        try:
            mesh_file.read(bytes(data), name=f"cloth.{kind}")
        except ValueError:
            refused += 1
    assert refused > 300
