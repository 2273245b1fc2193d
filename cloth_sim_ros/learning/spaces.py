# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checked options of environments: scenes, numbers, spaces, modes and reset masks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.learning.actions import ActionDecoder
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.fabrics import with_changes
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import MAX_COORDINATE

if TYPE_CHECKING:
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode

#: Tolerance of the default scene of environments [m].
TOLERANCE = 1e-3


def scene_of(source: Scene | str | Path | Mapping[str, Any] | None, base: Scene | None = None) -> Scene:
    """Return a scene from a scene, a ROS parameter file, or values by full name. Raises ValueError.

    Args:
        source: scene, file or values; None for the default scene with a tolerance of 1 mm.
        base: scene whose parameters the values replace; the default scene by default.

    Raises:
        ValueError: if a name is unknown or a value is invalid.
    """
    if isinstance(source, Scene):
        return source
    if isinstance(source, str | Path):
        return Scene.from_file(source)
    if source is not None and not isinstance(source, Mapping):
        raise ValueError(f"scene is {source!r}; give a Scene, a parameter file, or values of parameters by full name")
    if base is None:
        return Scene.from_parameters({"tolerance": TOLERANCE, **(source or {})})
    return Scene.from_parameters(with_changes(base.parameters(), source or {}, base.files), files=base.files)


def check_positive_integer(name: str, value: Any) -> int:
    """Return an option's value as an int. Raises ValueError unless it is a whole number of at least 1.

    Args:
        name: name of the option, for the error text.
        value: the number.

    Raises:
        ValueError: if the value is no whole number of at least 1.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name} is {value!r}; it must be a whole number of at least 1")
    return int(value)


def make_workspace(bounds: ArrayLike | None, start: Array) -> Array:
    """Return the box of gripper targets, lowest and highest corner [m], shape (2, 3). Raises ValueError.

    Args:
        bounds: the user's box; None for the box of the initial cloth, extended by twice its size on each side.
        start: initial particle positions [m], shape (n, 3).

    Raises:
        ValueError: if the shape is wrong, a number is not finite, or the first corner is not the lowest.
    """
    if bounds is None:
        low, high = start.min(axis=0), start.max(axis=0)
        margin = 2.0 * float((high - low).max())
        return np.array([low - margin, high + margin])
    box = np.asarray(bounds, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        remedy = "give the lowest and the highest corner [m], [[x, y, z], [x, y, z]]"
        raise ValueError(f"workspace is {box.tolist()}; {remedy}")
    if np.abs(box).max() > MAX_COORDINATE:
        raise ValueError(f"workspace is {box.tolist()} m; no coordinate may be beyond {MAX_COORDINATE:g} m")
    return box


def action_space(decoder: ActionDecoder, workspace: Array) -> Box:
    """Return the gymnasium space of one cloth's actions: targets in the workspace, quaternions, grasps.

    Args:
        decoder: decoder of the actions.
        workspace: lowest and highest corner of the targets [m], shape (2, 3).
    """
    from gymnasium.spaces import Box

    low, high = (np.zeros(decoder.shape, dtype=np.float32) for _ in range(2))
    low[:, :3], high[:, :3] = workspace
    # The box contains the quaternion of length zero, but random samples never hit it.
    low[:, 3:-1], high[:, 3:-1], high[:, -1] = -1.0, 1.0, 1.0
    return Box(low, high, dtype=np.float32)


def observation_space(shape: tuple[int, ...]) -> Box:
    """Return an unbounded gymnasium space of observations, whose bounds take no memory."""
    from gymnasium.spaces import Box

    space = Box(-np.inf, np.inf, shape, np.float32)
    for name in ("low", "high", "bounded_below", "bounded_above"):
        # Broadcasting saves four arrays of the observations' size.
        setattr(space, name, np.broadcast_to(getattr(space, name).flat[0], shape))
    return space


def parse_autoreset_mode(name: str | AutoresetMode) -> AutoresetMode:
    """Return gymnasium's autoreset mode of a name. Raises ValueError for an unknown one.

    Raises:
        ValueError: if the name is unknown.
    """
    from gymnasium.vector import AutoresetMode

    try:
        return AutoresetMode(name)
    except ValueError as error:
        names = ", ".join(mode.value for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode is {name!r}; it must be one of {names}") from error


def reset_mask(options: Mapping[str, Any] | None, count: int) -> NDArray[np.bool_]:
    """Return a mask of the cloths to reset from ``options["reset_mask"]``, (count,), all by default. Raises ValueError.

    Raises:
        ValueError: if an option is unknown, or the mask has another shape or type or selects no cloth.
    """
    remaining = dict(options or {})
    mask = remaining.pop("reset_mask", None)
    if remaining:
        raise ValueError(f"options has {', '.join(map(repr, remaining))}; the only option is 'reset_mask'")
    if mask is None:
        return np.ones(count, dtype=bool)
    if not isinstance(mask, np.ndarray) or mask.shape != (count,) or mask.dtype != np.bool_ or not mask.any():
        raise ValueError(f"options['reset_mask'] is {mask!r}; give a bool array of shape ({count},) with one true")
    return mask
