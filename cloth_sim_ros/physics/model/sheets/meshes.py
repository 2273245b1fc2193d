# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks and repairs that turn vertices and triangles from files into one cloth's surface.

Repaired and reported faults:

- Vertices in no triangle are removed.
- Vertices at the same position, or closer than a limit if there is one, are merged.
- Triangles given twice are kept once.
- Triangles with two corners at one position are removed, which leaves no hole.
- Triangles wound against their neighbours are turned.

A seam that looks closed and is open is reported and kept.

Faults that are refused, with the position:

- Coordinates are not finite, or not plausible in metres; indices are out of range.
- No fan of triangles fills a face; the three corners of a triangle lie on one line.
- An edge has more than two triangles; parts touch in one point.
- The surface can't be wound one way (a Möbius strip).
- There is more than one piece, unless several are allowed, or no triangle at all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum, row_sum
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.merging import MERGE_FRACTION, clusters, merge_limit
from cloth_sim_ros.physics.model.sheets.seams import border_edges, open_seam
from cloth_sim_ros.physics.model.sheets.surface import Surface, SurfaceError

#: A triangle whose height over its longest side is below this fraction of that side has no area.
FLATNESS = 1e-6
#: The largest coordinate [m] and the smallest extent of a whole mesh [m] that are plausible for a cloth in metres.
MAX_COORDINATE, MIN_EXTENT = 1e6, 1e-6
#: Largest work on failed corners of all faces of a mesh, and the fixed cost of a corner. A failed corner costs the
#: face's number of corners plus the fixed cost.
_MAX_FAN_TRIALS, _FAN_TRIAL_COST = 3_000_000, 64


@attrs.frozen(eq=False, kw_only=True)
class CheckedMesh:
    """Checked mesh of one cloth: vertex positions, surface, and sentences on repairs."""

    positions: Array
    """Vertex positions [m], in the order given, (n, 3)."""
    surface: Surface
    """The triangles, in the order given, consistently wound."""
    vertex_indices: NDArray[np.int64]
    """Index of each vertex in the input, ascending, (n,)."""
    repairs: tuple[str, ...]
    """Repairs and doubts, one sentence each; empty for a clean mesh."""
    notes: tuple[str, ...] = ()
    """Sentences on routine changes: merged vertices."""


def checked_mesh(
    positions: ArrayLike,
    triangles: ArrayLike,
    *,
    allow_pieces: bool = False,
    merge_limit: float = 0.0,
    scale: float = 1.0,
) -> CheckedMesh:
    """Return a checked mesh of vertices (n, 3) and triangles (m, 3): faults are repaired, or raise SurfaceError.

    Args:
        positions: positions of the vertices [m / scale].
        triangles: indices of three vertices each.
        allow_pieces: true to allow several pieces.
        merge_limit: distance below which vertices are copies of one [m / scale]; 0 merges only equal positions.
        scale: factor that converts positions to metres.

    Raises:
        SurfaceError: for a fault that can't be repaired; the message names the vertices or triangles as given, counted
            from 0.
    """
    points, faces = _validated_arrays(positions, triangles)
    repairs: list[str] = []
    notes: list[str] = []
    first_copy, n_copies = _first_copies(points, faces)
    if n_copies:
        repairs.append(f"{pluralize(n_copies, 'vertex', 'vertices')} at the place of another made one with it")
    faces = first_copy[faces]
    faces = _remove_repeats(faces, repairs)
    faces, n_merged = _merge_vertices(points, faces, merge_limit, notes)
    if scale != 1.0:
        points = points * scale
    n_distinct = len(points) - n_copies - n_merged
    try:
        mesh = _checked_surface(points, faces, allow_pieces, n_distinct, repairs, is_unmerged=not merge_limit)
    except SurfaceError as error:
        if not n_merged:
            raise
        raise SurfaceError(
            f"{error} ({pluralize(n_merged, 'vertex', 'vertices')} closer than {merge_limit:.3g} to another merged "
            "with it; cloth.merge: false keeps them apart)"
        ) from error
    return attrs.evolve(mesh, notes=tuple(notes))


def _checked_surface(
    points: Array,
    faces: NDArray[np.int64],
    allow_pieces: bool,
    n_distinct: int,
    repairs: list[str],
    *,
    is_unmerged: bool,
) -> CheckedMesh:
    """Clean, orient and check triangles after copies of vertices were merged; return the mesh, add to `repairs`.

    Args:
        points: vertices [m], (n, 3).
        faces: triangles, (m, 3).
        allow_pieces: true to allow several pieces.
        n_distinct: number of vertices left by merging.
        repairs: sentences on repairs, to which further ones are added.
        is_unmerged: true if only vertices at equal positions were merged.
    """
    _check_size(points, faces)
    faces = _remove_slivers(points, faces, repairs)
    if len(faces) == 0:
        raise SurfaceError("no triangle with an area is left: a cloth needs at least one")
    _check_edges(faces, points)
    faces = _orient_alike(faces, repairs)
    vertex_indices = np.unique(faces)
    n_loose = n_distinct - len(vertex_indices)
    if n_loose:
        repairs.append(f"{pluralize(n_loose, 'vertex', 'vertices')} in no triangle left out")
    new_index = np.full(len(points), -1)
    new_index[vertex_indices] = np.arange(len(vertex_indices))
    gap = open_seam(points, faces, border_edges(faces))
    seam = gap.describe(points) if gap is not None else ""
    if gap is not None and is_unmerged and gap.distance < merge_limit(points[vertex_indices]):
        seam += ", or set cloth.merge: true"
    try:
        surface = Surface.from_triangles(new_index[faces], particle_count=len(vertex_indices))
    except SurfaceError as error:
        repair_text = "; ".join(repairs) or "none"
        raise SurfaceError(f"{error} (vertices counted after repairs: {repair_text}){seam and f'. {seam}'}") from error
    pieces = surface.pieces()
    if pieces.max() > 0 and not allow_pieces:
        other_triangle = int(np.argmax(pieces > 0))
        raise SurfaceError(
            f"the mesh has {pieces.max() + 1} pieces that share no edge; vertex "
            f"{vertex_indices[surface.triangles[other_triangle, 0]]} is "
            f"not in the piece of vertex {vertex_indices[surface.triangles[0, 0]]}: a cloth is one piece, "
            "so give each its own file, join them (cloth.joints), or set contact.self: true, which keeps pieces apart"
            + (seam and f". {seam}")
        )
    if seam:
        repairs.append(seam)
    positions = np.ascontiguousarray(points[vertex_indices])
    return CheckedMesh(positions=positions, surface=surface, vertex_indices=vertex_indices, repairs=tuple(repairs))


def _merge_vertices(
    points: Array, faces: NDArray[np.int64], limit: float, notes: list[str]
) -> tuple[NDArray[np.int64], int]:
    """Merge vertices closer than a limit into the lowest; return triangles and number of merged ones, add a note."""
    used = np.unique(faces)
    lowest = used[clusters(points[used], limit)]
    moved_rows = np.flatnonzero(lowest != used)
    if not moved_rows.size:
        return faces, 0
    extent = merge_limit(points[used]) / MERGE_FRACTION
    vertex_map = np.arange(len(points))
    vertex_map[used] = lowest
    merged, repeated = vertex_map[faces], _has_repeated_vertex(faces)
    is_proper = ~_has_repeated_vertex(merged)
    n_flat = int(np.sum(~is_proper & ~repeated))
    old_faces = faces[is_proper]
    _, first, group = np.unique(np.sort(merged[is_proper], axis=1), axis=0, return_index=True, return_inverse=True)
    if len(first) < len(old_faces):
        twin = first[group.ravel()]
        copy_index = int(np.argmax(twin != np.arange(len(old_faces))))
        raise SurfaceError(
            f"triangles {old_faces[twin[copy_index]].tolist()} and {old_faces[copy_index].tolist()} lie on one "
            f"another: their vertices are closer than {limit:.3g}, {limit / extent:.1g} of the mesh's extent. Remove "
            "one of them, or, if they are two layers of cloth, set cloth.merge: false"
        )
    notes.append(
        f"{pluralize(len(moved_rows), 'vertex', 'vertices')} closer than {limit:.3g} to another ({limit / extent:.1g} "
        f"of the mesh's extent) merged with it, the first {used[moved_rows[0]]} with {lowest[moved_rows[0]]}"
        + (f"; {pluralize(n_flat, 'triangle')} between them left out" if n_flat else "")
        + "; particle numbers leave them out; cloth.merge: false keeps them apart"
    )
    return merged[is_proper | repeated], len(moved_rows)


def triangulate(positions: Array, polygons: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """Return triangles (m, 3) that fill polygons, in their order; raise SurfaceError for one that no fan fills.

    Each polygon is cut into a fan. The fan starts at the first corner for which no triangle lies outside the polygon,
    measured against the polygon's area vector (Newell). Therefore a concave face is cut along an inner diagonal.

    Args:
        positions: vertices [m], (n, 3).
        polygons: vertex indices of each polygon.

    Raises:
        SurfaceError: for a polygon of fewer than three corners, a corner out of range, or a polygon that no fan fills.
    """
    triangles: list[Sequence[int]] = []
    n_tried = 0
    for face_index, polygon in enumerate(polygons):
        if len(polygon) == 3:
            triangles.append(polygon)
            continue
        if len(polygon) < 3:
            raise SurfaceError(f"face {face_index} is {list(polygon)}; a face has at least 3 corners")
        if min(polygon) < 0 or max(polygon) >= len(positions):
            raise SurfaceError(f"face {face_index} is {list(polygon)}; vertices are 0 to {len(positions) - 1}")
        cost = len(polygon) + _FAN_TRIAL_COST
        fan_start, failures = _fan_corner(positions[list(polygon)], (_MAX_FAN_TRIALS - n_tried) // cost)
        n_tried += failures * cost
        if n_tried > _MAX_FAN_TRIALS:
            raise SurfaceError(
                f"face {face_index} has {len(polygon)} corners and is concave; too many corners of faces were tried "
                f"for a fan of triangles (limit {_MAX_FAN_TRIALS}); cut such faces into triangles in the program that "
                "made them"
            )
        if fan_start is None:
            raise SurfaceError(
                f"face {face_index}, of vertices {list(polygon)}, at {positions[polygon[0]].tolist()}, is too concave "
                "or crosses itself: no corner sees all others; cut it into triangles in the program that made it"
            )
        fan = [*polygon[fan_start:], *polygon[:fan_start]]
        triangles.extend((fan[0], fan[k], fan[k + 1]) for k in range(1, len(fan) - 1))
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _fan_corner(corners: Array, max_trials: int) -> tuple[int | None, int]:
    """Return a polygon's first corner whose fan of triangles lies inside, and the number of corners that failed.

    The corner is None if there is none, or if more corners failed than allowed.

    Args:
        corners: the polygon's corners [m], (k, 3).
        max_trials: largest number of failed corners.
    """
    best, best_fraction = 0, -np.inf
    for corner in range(len(corners)):
        if corner > max_trials:
            return None, corner
        arms = np.roll(corners, -corner, axis=0)[1:] - corners[corner]
        with np.errstate(invalid="ignore", over="ignore"):
            areas = np.cross(arms[:-1], arms[1:])
            area_vector = row_sum(areas)
            size = ordered_sum((area_vector * area_vector).tolist())
        if not (0 < size < np.inf):
            return 0, corner  # without an area or not finite: the check of the triangles names the place
        fraction = float(row_sum((areas * area_vector).T).min() / size)
        if fraction > FLATNESS:
            return corner, corner
        if fraction > best_fraction + FLATNESS:
            best, best_fraction = corner, fraction
    # a corner given twice leaves a triangle without area in every fan
    return (best if best_fraction > -FLATNESS else None), len(corners)


def _check_size(points: Array, faces: NDArray[np.int64]) -> None:
    used = np.unique(faces)
    max_coordinates = np.abs(points[used]).max(axis=1)
    if max_coordinates.max() > MAX_COORDINATE:
        bad = int(used[np.argmax(max_coordinates)])
        raise SurfaceError(
            f"vertex {bad} is {points[bad].tolist()}: a coordinate of magnitude {max_coordinates.max():.3g} m is "
            f"beyond "
            f"{MAX_COORDINATE:g} m; positions are in metres, so scale the mesh (cloth.scale) or move it to the origin"
        )
    extent = float(np.ptp(points[used], axis=0).max())
    if extent < MIN_EXTENT:
        raise SurfaceError(
            f"the whole mesh is {extent:.3g} m across, less than {MIN_EXTENT:g} m; positions are in metres, so scale "
            "it (cloth.scale)"
        )


def _validated_arrays(positions: ArrayLike, triangles: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
    points = np.array(positions, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SurfaceError(f"vertices have shape {points.shape}; they must be (n, 3)")
    face_array = np.asarray(triangles)
    if face_array.size == 0:
        raise SurfaceError("the mesh has no triangles; it needs one at least, as faces of its file")
    if face_array.ndim != 2 or face_array.shape[1] != 3 or not np.issubdtype(face_array.dtype, np.integer):
        raise SurfaceError(
            f"triangles are an (m, 3) array of whole numbers, not {face_array.shape} of {face_array.dtype}"
        )
    faces = face_array.astype(np.int64)
    is_outside = np.any((faces < 0) | (faces >= len(points)), axis=1)
    if np.any(is_outside):
        bad = int(np.argmax(is_outside))
        raise SurfaceError(f"triangle {bad} is {faces[bad].tolist()}; vertices are 0 to {len(points) - 1}")
    is_wrong = np.zeros(len(points), dtype=np.bool_)
    is_wrong[faces] = True
    is_wrong &= ~np.isfinite(points).all(axis=1)
    if np.any(is_wrong):
        bad = int(np.argmax(is_wrong))
        raise SurfaceError(f"vertex {bad} is {points[bad].tolist()}; positions must be finite")
    return points, faces


def _first_copies(points: Array, faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Return for each vertex the first one at the same position, (n,), and the number of copies in triangles."""
    used = np.unique(faces)
    # 0.0 and -0.0 are one position
    _, first, group = np.unique(points[used] + 0.0, axis=0, return_index=True, return_inverse=True)
    first_copy = np.arange(len(points))
    first_copy[used] = used[first[group.ravel()]]
    return first_copy, len(used) - len(first)


def _remove_repeats(faces: NDArray[np.int64], repairs: list[str]) -> NDArray[np.int64]:
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(first) < len(faces):
        repairs.append(f"{pluralize(len(faces) - len(first), 'triangle')} given more than once kept once")
    return faces[np.sort(first)]


def _remove_slivers(points: Array, faces: NDArray[np.int64], repairs: list[str]) -> NDArray[np.int64]:
    """Return triangles without repeated vertices, add to `repairs`; raise SurfaceError for thin ones."""
    is_collapsed = _has_repeated_vertex(faces)
    if np.any(is_collapsed):
        repairs.append(f"{pluralize(int(is_collapsed.sum()), 'triangle')} with a repeated vertex left out")
        faces = faces[~is_collapsed]
    a, b, c = (points[faces[:, k]] for k in range(3))
    sides = np.stack([np.linalg.norm(edge, axis=1) for edge in (b - a, c - b, a - c)])
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.square(sides.max(axis=0, initial=0.0))
    is_thin = ~(height > FLATNESS)
    if np.any(is_thin):
        bad = int(np.argmax(is_thin))
        raise SurfaceError(
            f"triangle {faces[bad].tolist()} has no area: its height is {height[bad]:.2g} of its longest side, at most "
            f"{FLATNESS:g}; its corners {points[faces[bad]].tolist()} lie on one line. Remove it and split its "
            "neighbour's long side at the middle corner (Blender: Mesh, Clean Up, Degenerate Dissolve)"
        )
    return faces


def _has_repeated_vertex(faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of triangles (m, 3) with a repeated vertex, (m,)."""
    first, second, third = faces.T
    return (first == second) | (second == third) | (third == first)


def _check_edges(faces: NDArray[np.int64], points: Array) -> None:
    edges = np.sort(np.concatenate((faces[:, :2], faces[:, 1:], faces[:, ::2])), axis=1)
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    if np.any(uses > 2):
        bad = int(np.argmax(uses > 2))
        vertex0, vertex1 = (int(v) for v in unique[bad])
        raise SurfaceError(
            f"the edge of vertices {vertex0} and {vertex1}, at {points[vertex0].tolist()} and "
            f"{points[vertex1].tolist()}, belongs to {uses[bad]} triangles; a cloth's edge has at most 2"
        )


def _orient_alike(faces: NDArray[np.int64], repairs: list[str]) -> NDArray[np.int64]:
    """Return triangles wound alike, by each piece's majority; add to `repairs`, raise SurfaceError if one-sided."""
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    order = np.lexsort((high, low))
    is_shared = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    half_edge0, half_edge1 = order[:-1][is_shared], order[1:][is_shared]
    is_clash = tail[half_edge0] == tail[half_edge1]
    if not np.any(is_clash):
        return faces
    neighbours: list[list[tuple[int, bool]]] = [[] for _ in faces]
    for a, b, against in zip((half_edge0 // 3).tolist(), (half_edge1 // 3).tolist(), is_clash.tolist(), strict=True):
        neighbours[a].append((b, against))
        neighbours[b].append((a, against))
    is_turned = np.full(len(faces), -1)
    count = 0
    for seed in range(len(faces)):
        if is_turned[seed] >= 0:
            continue
        is_turned[seed] = 0
        piece, queue = [seed], deque([seed])
        while queue:
            triangle = queue.popleft()
            for neighbor, against in neighbours[triangle]:
                expected = is_turned[triangle] ^ int(against)
                if is_turned[neighbor] < 0:
                    is_turned[neighbor] = expected
                    piece.append(neighbor)
                    queue.append(neighbor)
                elif is_turned[neighbor] != expected:
                    raise SurfaceError(
                        f"triangles {faces[triangle].tolist()} and {faces[neighbor].tolist()} can't be wound alike: "
                        "the surface has one side only, like a Möbius strip; cut it open"
                    )
        if 2 * is_turned[piece].sum() > len(piece):
            is_turned[piece] ^= 1
        count += int(is_turned[piece].sum())
    repairs.append(f"{pluralize(count, 'triangle')} wound against the others turned round")
    return np.where(is_turned[:, None] == 1, faces[:, ::-1], faces)


def pluralize(count: int, singular: str, plural: str | None = None) -> str:
    """Return a count with its noun: 1 vertex, 2 vertices."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"
