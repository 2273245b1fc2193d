# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Controls: inputs of a frame for grips, obstacles and jaws.

They are grasped particles, the paths of grippers, obstacles and jaws, jaw commands, and the recovery of thickness.
Controls are never changed, but replaced. Therefore a plan knows by identity if it has uploaded them, and a snapshot
keeps them without a copy.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import checked_floats, checked_indices
from cloth_sim_ros.physics.model.forces.force import Array


# Without slots: a member keeps the validated arrays.
@attrs.frozen(eq=False, slots=False)
class Grasps:
    """Grasped particles of all grippers, with springs: gripper g grasps ``particles[starts[g]:starts[g + 1]]``."""

    #: First grip of each gripper, shape (grippers + 1,), int64.
    starts: NDArray[np.int64]
    #: Grasped particles, shape (m,), int64.
    particles: NDArray[np.int64]
    #: Points in their gripper's frame [m], shape (m, 3).
    offsets: Array
    #: k [N/m] and k_d [N s/m], shape (m,) each.
    stiffness: Array
    damping: Array
    #: What they were computed from; while it stays the same, so do they.
    source: tuple[Any, ...] = ()
    #: True for each particle that follows its point exactly, shape (m,); None for none. Such a grip has no spring.
    prescribed: NDArray[np.bool_] | None = None

    @property
    def prescribed_particles(self) -> NDArray[np.int64]:
        """Grasped particles that follow their points on the gripper exactly, ascending; sorted at first access."""
        cached: NDArray[np.int64] | None = self.__dict__.get("_prescribed_particles")
        if cached is None:
            selected = self.particles[:0] if self.prescribed is None else self.particles[self.prescribed]
            cached = self.__dict__["_prescribed_particles"] = np.sort(selected)
        return cached

    def gripper_indices(self, gripper_count: int) -> NDArray[np.int64]:
        """Return the gripper index of each grip, shape (m,); check `starts`.

        Raises:
            ValueError: for starts that do not ascend from 0.
        """
        starts = np.asarray(self.starts)
        if starts.shape != (gripper_count + 1,) or starts.dtype.kind not in "iu":
            raise ValueError(f"starts are {starts.tolist()}; give {gripper_count + 1} whole numbers")
        if starts[0] != 0 or (starts[1:] < starts[:-1]).any():
            raise ValueError(f"starts are {starts.tolist()}; they must ascend from 0")
        return np.repeat(np.arange(gripper_count), np.diff(self.starts))

    def validated(self, gripper_count: int, particle_count: int) -> tuple[NDArray[Any], ...]:
        """Check the arrays once and return copies: particles, gripper indices, offsets, stiffness, damping, prescribed.

        Raises:
            ValueError: for arrays that do not fit together or are out of range.
        """
        counts = gripper_count, particle_count
        validated: tuple[Any, tuple[NDArray[Any], ...]] = self.__dict__.get("_validated", (None, ()))
        if validated[0] != counts:
            validated = self.__dict__["_validated"] = counts, self._validate(*counts)
        return validated[1]

    def _validate(self, gripper_count: int, particle_count: int) -> tuple[NDArray[Any], ...]:
        particles = checked_indices("held particles", np.reshape(self.particles, (-1, 1)), 1, particle_count)
        count = len(particles)
        gripper_indices = np.ascontiguousarray(self.gripper_indices(gripper_count), dtype=np.int64)
        if len(gripper_indices) != count:
            raise ValueError(
                f"starts {self.starts.tolist()} are of {len(gripper_indices)} grasped particles; there are {count}"
            )
        coefficients = (
            checked_floats("offsets of grips", self.offsets, (count, 3)),
            checked_floats("stiffness of grips", self.stiffness, (count,), lower=0.0),
            checked_floats("damping of grips", self.damping, (count,), lower=0.0),
        )
        prescribed = np.zeros(count, dtype=np.bool_) if self.prescribed is None else np.asarray(self.prescribed)
        if prescribed.shape != (count,) or prescribed.dtype != np.bool_:
            raise ValueError(f"prescribed is {prescribed.tolist()}; give {count} of true and false, one for each grip")
        followers = self.prescribed_particles
        if (repeated := followers[1:][followers[1:] == followers[:-1]]).size:
            raise ValueError(f"two grips prescribe the motion of particle {repeated[0]}; keep one of them")
        # Copies: later writes into the caller's arrays must not change them. A prescribed particle has no spring.
        springs = [np.where(prescribed, 0.0, coefficient) for coefficient in coefficients[1:]]
        return tuple(
            array.copy()
            for array in (particles, gripper_indices, coefficients[0], *springs, prescribed.astype(np.int64))
        )


class GripControls(NamedTuple):
    """Inputs of a frame for grippers: paths and grasped particles."""

    #: Paths of the grippers, shape (grippers, PATH_NUMBERS), see `Grips`.
    paths: Array
    grasps: Grasps


class ThicknessRecovery(NamedTuple):
    """Recovery of a reduced contact thickness: start time, duration, and thickness at its end and its start."""

    #: Its start and its duration [s].
    t: float = 0.0
    duration: float = 0.0
    #: Thickness at its end and at its start [m], shape `ContactBinding.thickness_shape`; None if none grows.
    target: Array | None = None
    start: Array | None = None


class ContactControls(NamedTuple):
    """Inputs of a frame for contact: paths of obstacles and jaws, jaw commands, recovery, setpoints, far obstacles."""

    #: Path of each obstacle, then the gripper's path for each jaw, shape (m, PATH_NUMBERS), see `Grips`.
    paths: Array
    #: For each gripper that pinches: whether it is present, and whether it closes, shape (pinches, 2).
    jaw_commands: NDArray[np.bool_]
    recovery: ThicknessRecovery = ThicknessRecovery()
    #: For each gripper that pinches: commanded half opening [m], largest force [N] and largest speed [m/s], shape
    #: (pinches, 3). A half opening below 0 stands for none, and 0 for the drive's own force and speed. None without a
    #: command.
    jaw_setpoints: Array | None = None
    #: True for each obstacle that cannot touch the cloth in the frame, shape (obstacles,); None if that is not known.
    is_away: NDArray[np.bool_] | None = None


class Controls(NamedTuple):
    """Inputs of a frame, of grips and of contact; None for what the model lacks."""

    grips: GripControls | None = None
    contact: ContactControls | None = None
