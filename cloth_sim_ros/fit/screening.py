# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test of clouds before a fit: a cloud of another scale can't be the cloth, and a shortened one misses a part of it."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recording import FitRecording, visible_mask
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene

#: Limits of a cloud's size over that of the rest shape. A sheet hardly stretches; a crumpled one is smaller.
MAX_SCALE, MIN_SCALE = 1.5, 0.1
#: Largest shortening of a cloud along the sheet that is no fault of the camera. A sheet bends, but hardly shortens.
MAX_SHORTENING = 0.03
#: Least number of lengths along rows or columns that are compared.
_MIN_LENGTHS = 8
#: Least ratio of a length's parts along two axes; diagonals mix their shortening.
_SIDEWAYS = 1.5


@attrs.frozen(kw_only=True)
class UnusedClouds:
    """Numbers of the clouds that a fit does not use, by reason."""

    #: Clouds without a point.
    empty: int = 0
    #: Clouds whose size is not the cloth's.
    wrong_scale: int = 0
    #: Clouds whose points stand closer along the sheet than the cloth's.
    shortened: int = 0
    #: Clouds far from the simulated cloth.
    other_object: int = 0
    #: Clouds after the motion became unpredictable.
    unpredictable: int = 0

    @property
    def total(self) -> int:
        """Number of all clouds that are not used."""
        return self.empty + self.wrong_scale + self.shortened + self.other_object + self.unpredictable


@attrs.frozen(kw_only=True, eq=False)
class ScreenedClouds:
    """Indices of the clouds that may show the cloth, and numbers of the others."""

    #: Indices of the usable clouds of each recording.
    used: tuple[NDArray[np.int64], ...]
    n_empty: int
    n_wrong_scale: int
    n_shortened: int

    def left_out(self) -> UnusedClouds:
        """Return the numbers of clouds that were left out, by reason."""
        return UnusedClouds(empty=self.n_empty, wrong_scale=self.n_wrong_scale, shortened=self.n_shortened)


def screen_clouds(recordings: Sequence[FitRecording]) -> ScreenedClouds:
    """Return the clouds that may show the cloth: with points, of its size, not shortened. Raises FitError for none.

    A camera that loses a part of a real cloth spreads the points over the rest of it, so that they stand too close.

    Raises:
        FitError: if no cloud has the size of the cloth; the text names the ratio.
    """
    used, ratios = list[NDArray[np.int64]](), list[float]()
    n_empty = n_wrong = 0
    for recording in recordings:
        rest_shape, indices = recording.scene.sheet.positions(), list[int]()
        for k, cloud in enumerate(recording.clouds):
            seen = visible_mask(cloud)
            if not seen.any():
                n_empty += 1
                continue
            if recording.matched and len(cloud) != len(rest_shape):
                # `check_recording` refuses it with a remedy.
                indices.append(k)
                continue
            ratio = size_ratio(cloud[seen], rest_shape[seen] if recording.matched else rest_shape)
            if ratio is not None and not MIN_SCALE <= ratio <= MAX_SCALE:
                n_wrong += 1
                ratios.append(ratio)
                continue
            indices.append(k)
        used.append(np.array(indices, dtype=np.int64))
    if n_wrong and not any(len(indices) for indices in used):
        ratio = float(np.median(ratios))
        unit = ". Are its points in millimetres?" if 300.0 < ratio < 3000.0 else "."
        raise FitError(
            f"none of {n_wrong} clouds can be the scene's cloth: they are {ratio:.3g} times as large{unit} Give points "
            "in metres, and the cloth's size in the scene"
        )
    n_before = sum(len(indices) for indices in used)
    used = _without_shortened(recordings, used)
    n_shortened = n_before - sum(len(indices) for indices in used)
    return ScreenedClouds(used=tuple(used), n_empty=n_empty, n_wrong_scale=n_wrong, n_shortened=n_shortened)


def _without_shortened(
    recordings: Sequence[FitRecording], used: Sequence[NDArray[np.int64]]
) -> list[NDArray[np.int64]]:
    """Leave out clouds that are shortened along the sheet against most clouds, or against the rest shape."""
    scene = recordings[0].scene
    n_particles = len(scene.initial_positions())
    if not all(
        r.matched and r.n_settle_frames > 0 and all(len(c) == n_particles for c in r.clouds) for r in recordings
    ):
        return list(used)
    ratios = [length_ratios([r.clouds[k] for k in indices], scene) for r, indices in zip(recordings, used, strict=True)]
    together = np.concatenate(ratios)
    limits = np.array(
        [(1.0 - MAX_SHORTENING) * min(_shorth_midpoint(column[np.isfinite(column)]), 1.0) for column in together.T]
    )
    return [indices[~(part < limits).any(axis=1)] for indices, part in zip(used, ratios, strict=True)]


def length_ratios(clouds: Sequence[Array], scene: Scene) -> Array:
    """Return the ratios of length of clouds to the rest shape along the sheet's two axes, shape (clouds, 2).

    NaN stands for a direction in which too few neighbours are visible.

    Args:
        clouds: a point for each particle [m], NaN if it is hidden, shape (n, 3) each.
        scene: the cloth.

    Returns:
        Ratios, shape (clouds, 2).
    """
    positions, triangles = scene.sheet.positions(), scene.sheet.triangles()
    edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    vectors = positions[edges[:, 1]] - positions[edges[:, 0]]
    axes = np.argsort(-np.ptp(positions, axis=0), kind="stable")[:2]
    along, across = np.abs(vectors[:, axes]).T
    rest_lengths = np.linalg.norm(vectors, axis=1)
    directions = along > _SIDEWAYS * across, across > _SIDEWAYS * along
    ratios = np.full((len(clouds), 2), np.nan)
    for ratio, cloud in zip(ratios, clouds, strict=True):
        lengths, is_seen = np.linalg.norm(cloud[edges[:, 1]] - cloud[edges[:, 0]], axis=1), visible_mask(cloud)[edges]
        for k, chosen in enumerate(directions):
            used = chosen & is_seen.all(axis=1)
            if used.sum() >= _MIN_LENGTHS:
                ratio[k] = lengths[used].sum() / rest_lengths[used].sum()
    return ratios


def _shorth_midpoint(ratios: Array) -> float:
    """Return the centre of the shortest interval that holds half of some ratios, a robust mode; infinite for none."""
    if not ratios.size:
        return float("inf")
    ordered, half = np.sort(ratios), ratios.size // 2
    first = int(np.argmin(ordered[half:] - ordered[: ratios.size - half]))
    return float(0.5 * (ordered[first] + ordered[first + half]))


def size_ratio(points: Array, rest_shape: Array) -> float | None:
    """Return the ratio of the sizes of a cloud and of the rest shape; None if the cloud has too few points.

    The size is the root mean square distance from the median point.
    """
    if len(points) < 4:
        return None
    sizes = [
        float(np.sqrt(np.median(np.square(shape - np.median(shape, axis=0)).sum(axis=1))))
        for shape in (points, rest_shape)
    ]
    return sizes[0] / sizes[1] if sizes[1] > 0.0 else None
