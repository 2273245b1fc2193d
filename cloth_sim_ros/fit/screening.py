# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test of clouds before a fit: a cloud of another scale, or of another object, can't be the cloth."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recording import FitRecording, visible
from cloth_sim_ros.physics.model.forces.force import Array

#: Limits of a cloud's size over that of the rest shape. A sheet hardly stretches; a crumpled one is smaller.
MAX_SCALE, MIN_SCALE = 1.5, 0.1


@attrs.frozen(kw_only=True)
class LeftOut:
    """Numbers of clouds that were not used, by reason."""

    #: Clouds without a point.
    empty: int = 0
    #: Clouds whose size is not the cloth's.
    wrong_scale: int = 0
    #: Clouds far from the simulated cloth.
    other_object: int = 0
    #: Clouds after the motion became unpredictable.
    unpredictable: int = 0

    @property
    def total(self) -> int:
        """Number of all of them."""
        return self.empty + self.wrong_scale + self.other_object + self.unpredictable


@attrs.frozen(kw_only=True, eq=False)
class Screened:
    """Clouds that may be the cloth."""

    #: Indices of the usable clouds of each recording.
    used: tuple[NDArray[np.int64], ...]
    n_empty: int
    n_wrong_scale: int

    def left_out(self) -> LeftOut:
        """Return the numbers of other clouds."""
        return LeftOut(empty=self.n_empty, wrong_scale=self.n_wrong_scale)


def screen_clouds(recordings: Sequence[FitRecording]) -> Screened:
    """Return the clouds that have points and the size of the cloth.

    Raises:
        FitError: if no cloud has the size of the cloth; the text names the ratio.
    """
    used, ratios = list[NDArray[np.int64]](), list[float]()
    n_empty = n_wrong = 0
    for recording in recordings:
        rest_shape, indices = recording.scene.sheet.positions(), list[int]()
        for k, cloud in enumerate(recording.clouds):
            seen = visible(cloud)
            if not seen.any():
                n_empty += 1
                continue
            if recording.matched and len(cloud) != len(rest_shape):
                # `check_recording` refuses it with a remedy.
                indices.append(k)
                continue
            ratio = scale(cloud[seen], rest_shape[seen] if recording.matched else rest_shape)
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
    return Screened(used=tuple(used), n_empty=n_empty, n_wrong_scale=n_wrong)


def scale(points: Array, rest_shape: Array) -> float | None:
    """Return the size of a cloud over that of the rest shape; None if it has too few points.

    The size is the root mean square distance from the median point.
    """
    if len(points) < 4:
        return None
    sizes = [
        float(np.sqrt(np.median(np.square(shape - np.median(shape, axis=0)).sum(axis=1))))
        for shape in (points, rest_shape)
    ]
    return sizes[0] / sizes[1] if sizes[1] > 0.0 else None
