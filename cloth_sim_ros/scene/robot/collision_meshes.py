# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Meshes of a robot's collision geometry: their files, and closed solids of them.

An open or a fine mesh is replaced by the convex hulls of its connected pieces, or by its own. A hull has few faces:
contact with a fine mesh takes far longer, and steps become short at its short edges.
"""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import unquote

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene import input_file, mesh_file
from cloth_sim_ros.scene.files import MAX_BYTES
from cloth_sim_ros.scene.parameters.declare import ParameterError

#: Largest number of pieces that become obstacles of their own.
_MAX_PIECES = 8
#: Largest number of triangles of a closed mesh that stays as it is, and of vertices of a hull.
_MAX_TRIANGLES, _MAX_VERTICES = 60, 48
#: A hull gets no more vertices once all of the mesh's are this close [m].
_HULL_TOLERANCE = 0.0005
#: Directions of a hull's first vertices: along the axes and the diagonals of a cube.
_DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1]], dtype=float)
_PACKAGE, _FILE = "package://", "file://"


@attrs.frozen(kw_only=True, eq=False)
class ClosedMeshes:
    """Closed meshes that replace one mesh of a robot's description: the mesh itself, or convex hulls."""

    #: Vertices [m], (m, 3), and triangles, (t, 3), of each.
    parts: tuple[tuple[Array, NDArray[np.int64]], ...]
    #: A sentence's end if hulls stand for the mesh; else empty.
    note: str = ""


def find_file(uri: str, folder: Path) -> Path:
    """Return the path, existing or not, of package://PACKAGE/PATH, file://PATH, or a path in `folder`, or raise.

    Raises:
        ParameterError: for another URI, or a package that is not there.
    """
    if uri.startswith(_PACKAGE):
        package, _, path = unquote(uri.removeprefix(_PACKAGE)).partition("/")
        for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
            if prefix and (share := Path(prefix, "share", package)).is_dir():
                return share / path
        raise ParameterError(
            f"the robot's mesh '{uri}' is in the package '{package}', which is not in AMENT_PREFIX_PATH; source the "
            "workspace that holds it, or leave its link out (robot.links)"
        )
    if uri.startswith(_FILE):
        return Path(unquote(uri.removeprefix(_FILE)))
    if "://" in uri:
        raise ParameterError(f"the robot's mesh '{uri}' can't be read; give package:// or file://, or a path")
    return folder / uri


def load(uri: str, scale: tuple[float, ...], folder: Path) -> ClosedMeshes:
    """Read a robot's mesh file as closed meshes [m]: itself if closed and coarse, else convex hulls; or raise.

    Args:
        uri: see `find_file`.
        scale: factors to metres along the axes.
        folder: base of relative paths.

    Raises:
        ParameterError: for a file that can't be read or that bounds no volume; names the file and the remedy.
    """
    path = Path(uri)
    try:
        path = find_file(uri, folder)
        data = input_file.read_bytes(path, max_bytes=MAX_BYTES)
        solid = mesh_file.parse_solid(data, name=path.name)
    except ParameterError:
        raise
    except OSError as error:
        raise ParameterError(
            f"the robot's mesh '{uri}' can't be read: '{path}': {error.strerror}; install the package that holds it, "
            "or leave its link out (robot.links)"
        ) from error
    except ValueError as error:
        raise ParameterError(f"the robot's mesh '{uri}': {error}") from error
    vertices, triangles = solid.vertices * np.array(scale), solid.triangles
    if np.prod(scale) < 0.0:
        # A mirror image turns triangles over.
        triangles = triangles[:, ::-1]
    vertices, triangles = np.ascontiguousarray(vertices), np.ascontiguousarray(triangles)
    is_solid = _is_solid(vertices, triangles)
    if is_solid and len(triangles) <= _MAX_TRIANGLES:
        return ClosedMeshes(parts=((vertices, triangles),))
    parts = _hulls(vertices, triangles)
    if not parts:
        raise ParameterError(
            f"the robot's mesh '{uri}' is open and flat, so it bounds no volume; give a solid, or leave its link out "
            "(robot.links)"
        )
    count = "its convex hull" if len(parts) == 1 else f"the convex hulls of its {len(parts)} pieces"
    fault = f"has {len(triangles)} triangles" if is_solid else "is not closed"
    note = f"mesh '{uri}' {fault}: {count} stands for it"
    inset = float(np.min([_distances_outside(vertices, *part) for part in parts], axis=0).max())
    if inset > _HULL_TOLERANCE:
        note += f", and the mesh protrudes by up to {1e3 * inset:.2g} mm"
    return ClosedMeshes(parts=parts, note=note)


def obj_bytes(vertices: Array, triangles: NDArray[np.int64]) -> bytes:
    """Return a mesh as the content of an OBJ file, with every bit of its vertices."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
    return ("\n".join(lines) + "\n").encode()


def _is_solid(vertices: Array, triangles: NDArray[np.int64]) -> bool:
    from cloth_sim_ros.physics.contact.obstacles import Obstacle

    try:
        Obstacle(name="mesh", shape="mesh", vertices=vertices, triangles=triangles)
    except ValueError:
        return False
    return True


def _pieces(triangles: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Return the triangles (k, 3) of each connected piece of a mesh with `count` vertices."""
    from cloth_sim_ros.physics.model.sheets.merging import component_labels

    labels = component_labels(np.concatenate([triangles[:, :2], triangles[:, 1:]]), count)[triangles[:, 0]]
    return [triangles[labels == label] for label in np.unique(labels)]


def _hulls(vertices: Array, triangles: NDArray[np.int64]) -> tuple[tuple[Array, NDArray[np.int64]], ...]:
    """Return vertices and triangles of the convex hull of each piece of a mesh, or of the whole; empty if it is flat.

    The hull of the whole mesh replaces them if it has many pieces, or a flat one. Without volume there is none.
    """
    pieces = _pieces(triangles, len(vertices))
    if len(pieces) <= _MAX_PIECES:
        hulls = [hull for piece in pieces if (hull := _hull(vertices[np.unique(piece)])) is not None]
        if len(hulls) == len(pieces):
            return tuple(hulls)
    whole = _hull(vertices)
    return () if whole is None else (whole,)


def _hull(points: Array) -> tuple[Array, NDArray[np.int64]] | None:
    """Return vertices and triangles of a convex hull of points (m, 3) [m] with at most 48 vertices; None if flat.

    With too many vertices it is that of some of them. The next one is always the furthest outside.
    """
    exact = _exact_hull(points)
    if exact is None or len(exact[0]) <= _MAX_VERTICES:
        return exact
    points, hull = exact[0], exact
    heights = points @ _DIRECTIONS.T
    chosen = sorted({*np.argmin(heights, axis=0).tolist(), *np.argmax(heights, axis=0).tolist()})
    while (next_hull := _exact_hull(points[chosen])) is not None:
        hull = next_hull
        outside = _distances_outside(points, *hull)
        furthest = int(np.argmax(outside))
        if len(chosen) >= _MAX_VERTICES or outside[furthest] <= _HULL_TOLERANCE:
            break
        chosen.append(furthest)
    return hull


def _distances_outside(points: Array, vertices: Array, triangles: NDArray[np.int64]) -> Array:
    """Return lower bounds of the distances of points (m, 3) [m] from a convex hull, negative inside, shape (m,)."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.sqrt((normals * normals).sum(axis=1))[:, None]
    distances: Array = (points @ normals.T - (normals * corners[:, 0]).sum(axis=1)).max(axis=1)
    return distances


def _exact_hull(points: Array) -> tuple[Array, NDArray[np.int64]] | None:
    """Return vertices and triangles of the convex hull of points (m, 3) [m], a closed mesh; None if it is flat."""
    from scipy.spatial import ConvexHull, QhullError

    # Joggled input gives triangles without flat ones; it is the fallback, because it moves the vertices by rounding.
    for options in ("Qt", "QJ"):
        try:
            hull = ConvexHull(points, qhull_options=options)
        except (QhullError, ValueError):
            continue
        corners = points[hull.simplices]
        outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        is_inward = np.einsum("tk,tk->t", outward, hull.equations[:, :3]) < 0.0
        triangles = np.where(is_inward[:, None], hull.simplices[:, ::-1], hull.simplices)
        used, compact = np.unique(triangles, return_inverse=True)
        vertices, triangles = points[used], compact.reshape(-1, 3).astype(np.int64)
        if _is_solid(vertices, triangles):
            return np.ascontiguousarray(vertices), np.ascontiguousarray(triangles)
    return None
