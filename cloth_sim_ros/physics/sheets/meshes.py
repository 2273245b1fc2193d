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

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.powers import in_order, in_rows
from cloth_sim_ros.physics.sheets.merging import MERGE_SHARE, clusters, merge_limit
from cloth_sim_ros.physics.sheets.seams import border_edges, open_seam
from cloth_sim_ros.physics.sheets.surface import Surface, SurfaceError

#: A triangle whose height over its longest side is below this fraction of that side has no area.
FLATNESS = 1e-6
#: The largest coordinate [m] and the smallest extent of a whole mesh [m] that are plausible for a cloth in metres.
FARTHEST, SMALLEST = 1e6, 1e-6
#: Largest work on failed corners of all faces of a mesh, and the fixed cost of a corner. A failed corner costs the
#: face's number of corners plus the fixed cost.
_MAX_TRIED, _TRY = 3_000_000, 64


@attrs.frozen(eq=False, kw_only=True)
class CheckedMesh:
    """A mesh that is the surface of one cloth."""

    positions: Array
    """Vertex positions [m], in the order given, (n, 3)."""
    surface: Surface
    """The triangles, in the order given, consistently wound."""
    kept: NDArray[np.int64]
    """Index of each vertex in the input, ascending, (n,)."""
    repairs: tuple[str, ...]
    """Repairs and doubts, one sentence each; empty for a clean mesh."""
    notes: tuple[str, ...] = ()
    """Sentences on routine changes: merged vertices."""


def checked_mesh(
    positions: ArrayLike,
    triangles: ArrayLike,
    *,
    several: bool = False,
    merge: float = 0.0,
    scale: float = 1.0,
) -> CheckedMesh:
    """Check vertices (n, 3) and triangles (m, 3), and repair faults without changing the cloth.

    Args:
        positions: positions of the vertices [m / scale].
        triangles: indices of three vertices each.
        several: true to allow several pieces.
        merge: distance below which vertices are copies of one [m / scale]; 0 merges only equal positions.
        scale: factor that converts positions to metres.

    Raises:
        SurfaceError: for a fault that can't be repaired; the message names the vertices or triangles as given, counted
            from 0.
    """
    points, faces = _arrays(positions, triangles)
    repairs: list[str] = []
    notes: list[str] = []
    place, copies = _first_of_equals(points, faces)
    if copies:
        repairs.append(f"{_several(copies, 'vertex', 'vertices')} at the place of another made one with it")
    faces = place[faces]
    faces = _without_repeats(faces, repairs)
    faces, merged = _merged(points, faces, merge, notes)
    if scale != 1.0:
        points = points * scale
    try:
        mesh = _checked(points, faces, several, len(points) - copies - merged, repairs, unmerged=not merge)
    except SurfaceError as error:
        if not merged:
            raise
        raise SurfaceError(
            f"{error} ({_several(merged, 'vertex', 'vertices')} closer than {merge:.3g} to another merged with it; "
            "cloth.merge: false keeps them apart)"
        ) from error
    return attrs.evolve(mesh, notes=tuple(notes))


def _checked(
    points: Array, faces: NDArray[np.int64], several: bool, distinct: int, repairs: list[str], *, unmerged: bool
) -> CheckedMesh:
    """Return the mesh of triangles whose corners are at different positions.

    Args:
        points: vertices [m], (n, 3).
        faces: triangles, (m, 3).
        several: true to allow several pieces.
        distinct: number of vertices left by merging.
        repairs: sentences on repairs, to which further ones are added.
        unmerged: true if only vertices at equal positions were merged.
    """
    _check_size(points, faces)
    faces = _without_slivers(points, faces, repairs)
    if len(faces) == 0:
        raise SurfaceError("no triangle with an area is left: a cloth needs at least one")
    _check_edges(faces, points)
    faces = _wound(faces, repairs)
    kept = np.unique(faces)
    loose = distinct - len(kept)
    if loose:
        repairs.append(f"{_several(loose, 'vertex', 'vertices')} in no triangle left out")
    number = np.full(len(points), -1)
    number[kept] = np.arange(len(kept))
    gap = open_seam(points, faces, border_edges(faces))
    seam = gap.describe(points) if gap is not None else ""
    if gap is not None and unmerged and gap.distance < merge_limit(points[kept]):
        seam += ", or set cloth.merge: true"
    try:
        surface = Surface.from_triangles(number[faces], particle_count=len(kept))
    except SurfaceError as error:
        done = "; ".join(repairs) or "none"
        raise SurfaceError(f"{error} (vertices counted after repairs: {done}){seam and f'. {seam}'}") from error
    pieces = surface.pieces()
    if pieces.max() > 0 and not several:
        other = int(np.argmax(pieces > 0))
        raise SurfaceError(
            f"the mesh has {pieces.max() + 1} pieces that share no edge; vertex {kept[surface.triangles[other, 0]]} is "
            f"not in the piece of vertex {kept[surface.triangles[0, 0]]}: a cloth is one piece, "
            "so give each its own file, join them, or set contact.self: true, which keeps pieces apart"
            + (seam and f". {seam}")
        )
    if seam:
        repairs.append(seam)
    positions = np.ascontiguousarray(points[kept])
    return CheckedMesh(positions=positions, surface=surface, kept=kept, repairs=tuple(repairs))


def _merged(points: Array, faces: NDArray[np.int64], limit: float, notes: list[str]) -> tuple[NDArray[np.int64], int]:
    """Merge vertices closer than a limit into the lowest of them; return the triangles and the number of merged
    vertices.
    """
    used = np.unique(faces)
    lowest = used[clusters(points[used], limit)]
    moved = np.flatnonzero(lowest != used)
    if not moved.size:
        return faces, 0
    extent = merge_limit(points[used]) / MERGE_SHARE
    vertex_map = np.arange(len(points))
    vertex_map[used] = lowest
    merged, repeated = vertex_map[faces], _collapsed(faces)
    proper = ~_collapsed(merged)
    flat = int(np.sum(~proper & ~repeated))
    before = faces[proper]
    _, first, same = np.unique(np.sort(merged[proper], axis=1), axis=0, return_index=True, return_inverse=True)
    if len(first) < len(before):
        twin = first[same.ravel()]
        copy = int(np.argmax(twin != np.arange(len(before))))
        raise SurfaceError(
            f"triangles {before[twin[copy]].tolist()} and {before[copy].tolist()} lie on one another: their vertices "
            f"are closer than {limit:.3g}, {limit / extent:.1g} of the mesh's extent. Remove one of them, or, if they "
            "are two layers of cloth, set cloth.merge: false"
        )
    notes.append(
        f"{_several(len(moved), 'vertex', 'vertices')} closer than {limit:.3g} to another ({limit / extent:.1g} of the "
        f"mesh's extent) merged with it, the first {used[moved[0]]} with {lowest[moved[0]]}"
        + (f"; {_several(flat, 'triangle')} between them left out" if flat else "")
        + "; particle numbers leave them out; cloth.merge: false keeps them apart"
    )
    return merged[proper | repeated], len(moved)


def triangulated(positions: Array, polygons: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """Cut polygons into triangles, (m, 3), in the order given.

    Each polygon is cut into a fan. The fan starts at the first corner for which no triangle lies outside the polygon,
    measured against the polygon's area vector (Newell). Therefore a concave face is cut along an inner diagonal.

    Args:
        positions: vertices [m], (n, 3).
        polygons: vertex indices of each polygon.

    Raises:
        SurfaceError: for a polygon of fewer than three corners, a corner out of range, or a polygon that no fan fills.
    """
    triangles: list[Sequence[int]] = []
    tried = 0
    for number, polygon in enumerate(polygons):
        if len(polygon) == 3:
            triangles.append(polygon)
            continue
        if len(polygon) < 3:
            raise SurfaceError(f"face {number} is {list(polygon)}; a face has at least 3 corners")
        if min(polygon) < 0 or max(polygon) >= len(positions):
            raise SurfaceError(f"face {number} is {list(polygon)}; vertices are 0 to {len(positions) - 1}")
        begin, failures = _fan_corner(positions[list(polygon)], (_MAX_TRIED - tried) // (len(polygon) + _TRY))
        tried += failures * (len(polygon) + _TRY)
        if tried > _MAX_TRIED:
            raise SurfaceError(
                f"face {number} has {len(polygon)} corners and is concave; too many corners of faces were tried "
                f"for a fan of triangles (limit {_MAX_TRIED}); cut such faces into triangles in the program that made "
                "them"
            )
        if begin is None:
            raise SurfaceError(
                f"face {number}, of vertices {list(polygon)}, at {positions[polygon[0]].tolist()}, is too concave or "
                "crosses itself: no corner sees all others; cut it into triangles in the program that made it"
            )
        turned = [*polygon[begin:], *polygon[:begin]]
        triangles.extend((turned[0], turned[k], turned[k + 1]) for k in range(1, len(turned) - 1))
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _fan_corner(corners: Array, most: int) -> tuple[int | None, int]:
    """Return a polygon's first corner from which a fan has no triangle outside, and the number of failed corners.

    The corner is None if there is none, or if more corners failed than allowed.

    Args:
        corners: the polygon's corners [m], (k, 3).
        most: largest number of failed corners.
    """
    best, best_share = 0, -np.inf
    for begin in range(len(corners)):
        if begin > most:
            return None, begin
        arms = np.roll(corners, -begin, axis=0)[1:] - corners[begin]
        with np.errstate(invalid="ignore", over="ignore"):
            areas = np.cross(arms[:-1], arms[1:])
            whole = in_rows(areas)
            size = in_order((whole * whole).tolist())
        if not (0 < size < np.inf):
            return 0, begin  # without an area or not finite: the check of the triangles names the place
        share = float(in_rows((areas * whole).T).min() / size)
        if share > FLATNESS:
            return begin, begin
        if share > best_share + FLATNESS:
            best, best_share = begin, share
    # a corner given twice leaves a triangle without area in every fan
    return (best if best_share > -FLATNESS else None), len(corners)


def _check_size(points: Array, faces: NDArray[np.int64]) -> None:
    used = np.unique(faces)
    reach = np.abs(points[used]).max(axis=1)
    if reach.max() > FARTHEST:
        bad = int(used[np.argmax(reach)])
        raise SurfaceError(
            f"vertex {bad} is {points[bad].tolist()}: a coordinate of magnitude {reach.max():.3g} m is beyond "
            f"{FARTHEST:g} m; positions are in metres, so scale the mesh (cloth.scale) or move it to the origin"
        )
    extent = float(np.ptp(points[used], axis=0).max())
    if extent < SMALLEST:
        raise SurfaceError(
            f"the whole mesh is {extent:.3g} m across, less than {SMALLEST:g} m; positions are in metres, so scale it "
            "(cloth.scale)"
        )


def _arrays(positions: ArrayLike, triangles: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
    points = np.array(positions, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SurfaceError(f"vertices have shape {points.shape}; they must be (n, 3)")
    given = np.asarray(triangles)
    if given.size == 0:
        raise SurfaceError("the mesh has no triangles; it needs one at least, as faces of its file")
    if given.ndim != 2 or given.shape[1] != 3 or not np.issubdtype(given.dtype, np.integer):
        raise SurfaceError(f"triangles are an (m, 3) array of whole numbers, not {given.shape} of {given.dtype}")
    faces = given.astype(np.int64)
    outside = np.any((faces < 0) | (faces >= len(points)), axis=1)
    if np.any(outside):
        bad = int(np.argmax(outside))
        raise SurfaceError(f"triangle {bad} is {faces[bad].tolist()}; vertices are 0 to {len(points) - 1}")
    wrong = np.zeros(len(points), dtype=np.bool_)
    wrong[faces] = True
    wrong &= ~np.isfinite(points).all(axis=1)
    if np.any(wrong):
        bad = int(np.argmax(wrong))
        raise SurfaceError(f"vertex {bad} is {points[bad].tolist()}; positions must be finite")
    return points, faces


def _first_of_equals(points: Array, faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Return for each vertex the first used one at the same position, and the number of used vertices that are not
    first.
    """
    used = np.unique(faces)
    # 0.0 and -0.0 are one position
    _, first, same = np.unique(points[used] + 0.0, axis=0, return_index=True, return_inverse=True)
    place = np.arange(len(points))
    place[used] = used[first[same.ravel()]]
    return place, len(used) - len(first)


def _without_repeats(faces: NDArray[np.int64], repairs: list[str]) -> NDArray[np.int64]:
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(first) < len(faces):
        repairs.append(f"{_several(len(faces) - len(first), 'triangle')} given more than once kept once")
    return faces[np.sort(first)]


def _without_slivers(points: Array, faces: NDArray[np.int64], repairs: list[str]) -> NDArray[np.int64]:
    """Remove triangles of fewer than three vertices; refuse thin ones, whose removal would open the surface."""
    collapsed = _collapsed(faces)
    if np.any(collapsed):
        repairs.append(f"{_several(int(collapsed.sum()), 'triangle')} with a repeated vertex left out")
        faces = faces[~collapsed]
    a, b, c = (points[faces[:, k]] for k in range(3))
    sides = np.stack([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)])
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.square(sides.max(axis=0, initial=0.0))
    thin = ~(height > FLATNESS)
    if np.any(thin):
        bad = int(np.argmax(thin))
        raise SurfaceError(
            f"triangle {faces[bad].tolist()} has no area: its height is {height[bad]:.2g} of its longest side, at most "
            f"{FLATNESS:g}; its corners {points[faces[bad]].tolist()} lie on one line. Remove it and split its "
            "neighbour's long side at the middle corner (Blender: Mesh, Clean Up, Degenerate Dissolve)"
        )
    return faces


def _collapsed(faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of triangles (m, 3) with a repeated vertex, (m,)."""
    first, second, third = faces.T
    return (first == second) | (second == third) | (third == first)


def _check_edges(faces: NDArray[np.int64], points: Array) -> None:
    edges = np.sort(np.concatenate((faces[:, :2], faces[:, 1:], faces[:, ::2])), axis=1)
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    if np.any(uses > 2):
        bad = int(np.argmax(uses > 2))
        one, two = (int(v) for v in unique[bad])
        raise SurfaceError(
            f"the edge of vertices {one} and {two}, at {points[one].tolist()} and {points[two].tolist()}, "
            f"belongs to {uses[bad]} triangles; a cloth's edge has at most 2"
        )


def _wound(faces: NDArray[np.int64], repairs: list[str]) -> NDArray[np.int64]:
    """Turn triangles so that neighbours agree; in every piece the larger part stays as given."""
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    one, two = order[:-1][same], order[1:][same]
    clash = tail[one] == tail[two]
    if not np.any(clash):
        return faces
    neighbours: list[list[tuple[int, bool]]] = [[] for _ in faces]
    for a, b, against in zip((one // 3).tolist(), (two // 3).tolist(), clash.tolist(), strict=True):
        neighbours[a].append((b, against))
        neighbours[b].append((a, against))
    turned = np.full(len(faces), -1)
    count = 0
    for begin in range(len(faces)):
        if turned[begin] >= 0:
            continue
        turned[begin] = 0
        piece, queue = [begin], deque([begin])
        while queue:
            at = queue.popleft()
            for to, against in neighbours[at]:
                wanted = turned[at] ^ int(against)
                if turned[to] < 0:
                    turned[to] = wanted
                    piece.append(to)
                    queue.append(to)
                elif turned[to] != wanted:
                    raise SurfaceError(
                        f"triangles {faces[at].tolist()} and {faces[to].tolist()} can't be wound alike: "
                        "the surface has one side only, like a Möbius strip; cut it open"
                    )
        if 2 * turned[piece].sum() > len(piece):
            turned[piece] ^= 1
        count += int(turned[piece].sum())
    repairs.append(f"{_several(count, 'triangle')} wound against the others turned round")
    return np.where(turned[:, None] == 1, faces[:, ::-1], faces)


def _several(count: int, one: str, many: str | None = None) -> str:
    return f"{count} {one if count == 1 else many or one + 's'}"
