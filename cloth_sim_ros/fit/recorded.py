# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recording of a real cloth: clouds and gripper poses, whatever file they came from.

A reader of another format returns a `Recording`. `start.py` turns it into a `FitRecording`, which a fit simulates.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix

#: Longest interval between two poses in which a gripper moves along a cubic polynomial [s].
MAX_POSE_GAP = 0.1
#: Longest accepted recording [s].
MAX_DURATION = 3600.0
#: Largest accepted coordinate of a point [m].
MAX_COORDINATE = 1e6


def _to_array(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, dtype=np.float64)


def _to_clouds(clouds: Iterable[ArrayLike]) -> tuple[NDArray[np.float64], ...]:
    return tuple(_to_array(cloud) for cloud in clouds)


@attrs.frozen(eq=False, kw_only=True)
class RecordedGripper:
    """Recorded poses and grasps of one gripper over time. Raises FitError for arrays of other shapes."""

    #: Times of the poses [s], ascending, shape (n,).
    times: NDArray[np.float64] = attrs.field(converter=_to_array)
    #: Positions [m], shape (n, 3).
    positions: Array = attrs.field(converter=_to_array)
    #: Unit quaternions x, y, z, w, shape (n, 4).
    quaternions: Array = attrs.field(converter=_to_array)
    #: Times of its grasps [s], and true if it closes.
    grasps: tuple[tuple[float, bool], ...] = ()

    def __attrs_post_init__(self) -> None:
        n = len(self.times)
        if not n or self.positions.shape != (n, 3) or self.quaternions.shape != (n, 4):
            shapes = f"{self.times.shape}, {self.positions.shape} and {self.quaternions.shape}"
            raise FitError(f"times, positions and quaternions have shapes {shapes}; they must be (n,), (n, 3), (n, 4)")

    def offset_by(self, offset: ArrayLike) -> RecordedGripper:
        """Return the track of another point of the gripper, `offset` in the frame of the recorded poses [m].

        Args:
            offset: the point in the frame of the recorded poses [m], shape (3,).
        """
        turned = np.array([rotation_matrix(q) for q in self.quaternions]) @ _to_array(offset)
        return attrs.evolve(self, positions=self.positions + turned)

    def is_closed(self, time: float) -> bool:
        """Return True if the gripper is closed at a time [s]: by its last grasp, or because it has none before."""
        grasps = [closed for begin, closed in self.grasps if begin <= time]
        return not grasps or grasps[-1]

    def pose_at(self, time: float) -> tuple[list[float], list[float]]:
        """Return position [m] and quaternion at a time [s], interpolated; constant before and after the poses.

        They are cubic polynomials between poses, with continuous velocities, and straight in gaps. Straight lines
        between all poses would shake the cloth at every pose.
        """
        last = len(self.times) - 1
        k = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, max(last - 1, 0)))
        places = np.clip(np.arange(k - 1, k + 3), 0, last)
        times, turns = self.times[places], self.quaternions[places].copy()
        for before, turn in pairwise(turns):
            if float(before @ turn) < 0.0:
                turn *= -1.0
        numbers, spans = np.hstack([self.positions[places], turns]), np.diff(times)
        start, span = numbers[1], float(spans[1])
        change = numbers[2] - start
        s = float(np.clip((time - times[1]) / span, 0.0, 1.0)) if span > 0.0 else 0.0
        pose = start + s * change
        if 0.0 < span <= MAX_POSE_GAP:
            # Velocities at both ends, minus that of the straight line; a pose beside a gap has the line's velocity.
            first, second = (
                (numbers[i + 1] - numbers[i - 1]) * span / (times[i + 1] - times[i - 1]) - change
                if 0.0 < spans[interval] <= MAX_POSE_GAP
                else 0.0 * change
                for i, interval in ((1, 0), (2, 2))
            )
            pose = pose + s * (1.0 - s) * ((1.0 - s) * first - s * second)
        turn = pose[3:] / np.sqrt(float(pose[3:] @ pose[3:]))
        return pose[:3].tolist(), turn.tolist()


@attrs.frozen(eq=False, kw_only=True)
class Recording:
    """Clouds and gripper poses of one motion of a real cloth. Raises FitError if times or points are invalid.

    All times have one origin. The clouds' clock may differ from the grippers' by an offset, which a fit can find.
    """

    #: Name of the file, for reports.
    name: str
    #: Time of each cloud [s], ascending, shape (clouds,).
    times: NDArray[np.float64] = attrs.field(converter=_to_array)
    #: Points of each cloud [m], shape (points, 3): a row for each particle, NaN if it is hidden; or bare points.
    clouds: tuple[NDArray[np.float64], ...] = attrs.field(converter=_to_clouds)
    #: Track of each gripper, by the name that the scene gives it.
    grippers: Mapping[str, RecordedGripper]
    #: True if row k of a cloud is particle k; false for bare points of the surface.
    matched: bool = True

    def __attrs_post_init__(self) -> None:
        if len(self.times) != len(self.clouds):
            raise FitError(f"{self.name} has {len(self.times)} times for {len(self.clouds)} clouds")
        if not len(self.clouds):
            raise FitError(f"{self.name} holds no cloud")
        is_wrong = ~np.isfinite(self.times)
        is_wrong[1:] |= ~(np.diff(self.times) > 0.0)
        if is_wrong.any():
            k = int(np.argmax(is_wrong))
            after = f" after {self.times[k - 1]:g} s" if k else ""
            raise FitError(
                f"{self.name}: cloud {k} has the time {self.times[k]:g} s{after}; times must be finite and ascending"
            )
        for time, cloud in zip(self.times, self.clouds, strict=True):
            farthest = float(np.max(np.abs(cloud), initial=0.0, where=np.isfinite(cloud)))
            if farthest > MAX_COORDINATE:
                raise FitError(
                    f"{self.name}: the cloud of time {time:g} s has the coordinate {farthest:g} m; at most "
                    f"{MAX_COORDINATE:g} m are possible. Give points in metres, and hidden ones as NaN"
                )
        span = self.times[-1] - self.times[0]
        if span > MAX_DURATION:
            cause = f"clouds span {span:.0f} s; the limit is {MAX_DURATION:g} s"
            raise FitError(f"{cause}. Stamp all messages by one clock")
        for name, track in self.grippers.items():
            if track.times.min() > self.times[-1] or track.times.max() < self.times[0] - 60.0:
                raise FitError(
                    f"poses of gripper '{name}' and clouds do not overlap in time: stamps of "
                    f"{track.times.min():.3f} to {track.times.max():.3f} s and {self.times[0]:.3f} to "
                    f"{self.times[-1]:.3f} s; stamp both by one clock"
                )

    def in_gripper_frame(self, cloud_pose: ArrayLike) -> Recording:
        """Return the recording with its clouds transformed into the grippers' frame. Raises FitError.

        Args:
            cloud_pose: position [m] and quaternion x, y, z, w of the clouds' frame in the grippers' frame, shape (7,).

        Raises:
            FitError: unless they are finite, with a quaternion other than zero.
        """
        numbers = _to_array(cloud_pose)
        size = float(np.sqrt(np.square(numbers[3:]).sum())) if numbers.shape == (7,) else 0.0
        if not (np.isfinite(numbers).all() and size > 0.0):
            raise FitError(
                f"the camera's pose is {numbers.tolist()}; it needs seven finite numbers, a position and a "
                "quaternion x, y, z, w"
            )
        rotation = np.array(rotation_matrix(numbers[3:] / size))
        return attrs.evolve(self, clouds=[cloud @ rotation.T + numbers[:3] for cloud in self.clouds])

    def since(self, time: float) -> Recording:
        """Return the recording without the clouds before a time [s] after its first one. Raises FitError.

        Raises:
            FitError: if there is no such cloud.
        """
        last = float(self.times[-1] - self.times[0])
        if not (np.isfinite(time) and 0.0 <= time <= last):
            raise FitError(f"--from is {time:g} s; it must be from 0 to {last:.2f}, the last cloud")
        first = int(np.searchsorted(self.times, self.times[0] + time - 1e-3))
        return attrs.evolve(self, times=self.times[first:], clouds=self.clouds[first:])

    def part(self, *, until: float | None = None, every: int = 1) -> Recording:
        """Return the recording with every n-th cloud, up to a time [s] after the first cloud.

        Args:
            until: time of the last cloud [s]; None for all.
            every: n.
        """
        count = len(self.times)
        if until is not None:
            count = int(np.searchsorted(self.times, self.times[0] + until + 1e-9, side="right"))
        return attrs.evolve(self, times=self.times[:count:every], clouds=self.clouds[:count:every])
