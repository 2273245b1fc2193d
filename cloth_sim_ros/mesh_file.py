# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes from OBJ, PLY and STL files, read by trimesh; vertices keep the order of the file."""

from __future__ import annotations

import io
import logging
from pathlib import Path

import numpy as np

from cloth_sim_ros.physics.mesh_sheet import MeshSheet
from cloth_sim_ros.physics.meshes import CheckedMesh, checked_mesh

KINDS = ("obj", "ply", "stl")

_log = logging.getLogger(__name__)


def parse(data: bytes, *, name: str) -> MeshSheet:
    """Return the sheet of a mesh file's content, its name given for its kind and for messages; says what it repaired.

    Raises:
        ValueError: if it is not such a file, or holds no surface of one cloth.
    """
    mesh = read(data, name=name)
    for repair in mesh.repairs:
        _log.warning("mesh '%s': %s", name, repair)
    return MeshSheet(rest=mesh.positions, surface=mesh.surface)


def read(data: bytes, *, name: str) -> CheckedMesh:
    """Return the checked mesh of a file's content; `parse` without words.

    An STL file repeats a vertex in each of its triangles: that is how the format is, so making them one is no repair
    there, and vertices are numbered as they first appear.

    Raises:
        ValueError: if it is not such a file, or holds no surface of one cloth.
    """
    kind = Path(name).suffix.lower().lstrip(".")
    if kind not in KINDS:
        raise ValueError(f"'{name}' is no mesh file that can be read: its name must end in {', '.join(KINDS)}")
    import trimesh

    options = {"maintain_order": True} if kind == "obj" else {}
    if kind == "obj":
        data = _shape_of_obj(data)
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False, validate=False, **options)
        points, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    # what a broken file makes trimesh's readers raise depends on where it breaks; each names the cause
    except (ValueError, KeyError, IndexError, AttributeError, TypeError, EOFError, NameError) as error:
        raise ValueError(f"'{name}' is no readable {kind.upper()} file: {error}") from error
    mesh = checked_mesh(points, faces)
    if kind == "stl":
        return CheckedMesh(
            positions=mesh.positions,
            surface=mesh.surface,
            kept=mesh.kept,
            repairs=tuple(repair for repair in mesh.repairs if "at the place of another" not in repair),
        )
    return mesh


def _shape_of_obj(data: bytes) -> bytes:
    """Vertices and faces of an OBJ file alone: materials, groups and texture seams make trimesh split and reorder."""
    lines = []
    for line in data.replace(b"\\\n", b" ").splitlines():
        words = line.split()
        if words[:1] == [b"v"]:
            lines.append(line)
        elif words[:1] == [b"f"]:
            lines.append(b" ".join([b"f", *(word.split(b"/", 1)[0] for word in words[1:])]))
    return b"\n".join(lines) + b"\n"
