# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pre-scan of a session: bounds, colour range and plots for the viewer."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.replay.deviations import FOLLOWED_DEVIATION, typical_deviation
from cloth_sim_ros.replay.opening import Opening, read_opening
from cloth_sim_ros.replay.plots import DIAGNOSTICS_TOPIC, PLOTS, diagnostic_numbers, extra_numbers
from cloth_sim_ros.replay.surface_geometry import SurfaceGeometry, make_surface_geometry
from cloth_sim_ros.session.cdr import Cloud, decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.reader import SessionReader, read_frame

#: Number of sampled clouds.
SAMPLES = 40
#: Time between sampled clouds in a file without an index, and time within which diagnostics are certain [ns].
_CLOUD_SPACING, _DIAGNOSTICS_SPAN = 1_000_000_000, 5_000_000_000
#: Fraction of particles above the colour range, so that one stretched corner does not determine it.
_CLIPPED_FRACTION = 0.002
#: Margin around the cloth's bounding box in which grippers stay in view, as a fraction of its diagonal.
_MARGIN = 0.08
#: Colour range (strain) of an unstretched cloth, and of a session that is being recorded.
_MIN_LIMIT, FOLLOWED_LIMIT = 0.001, 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class PreScan:
    """Bounds, geometry, colour range and plots of a session, known before it is shown."""

    opening: Opening
    rows: int
    columns: int
    triangles: NDArray[np.uint32]
    geometry: SurfaceGeometry
    normal: NDArray[np.float64]
    """Mean normal of the cloth at its start, shape (3,)."""
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    """Corners of the bounding box of the cloth and of grippers near it [m], shape (3,)."""
    gripper_targets: NDArray[np.float64]
    """Target positions of the grippers [m], shape (k, 3)."""
    strain_limit: float
    """Strain of the last colour."""
    plots: tuple[str, ...]
    """Paths of the plots that have numbers, in order."""
    error_limit: float | None = None
    """Error of the last colour [m]; None if strain or deviation is shown."""
    deviation_limit: float | None = None
    """Deviation of the last colour [m]; None if strain or error is shown."""


def scan_session(reader: SessionReader, *, strain_limit: float | None = None, is_followed: bool = False) -> PreScan:
    """Read a sample of a session's clouds; return bounds, colour range and plots. Raises SessionError.

    The sample is one cloud if `is_followed`, because the session is still being recorded.

    Raises:
        SessionError: if the session has no surface, or its clouds do not fit the surface.
    """
    opening = read_opening(reader.scene_yaml, reader.state)
    surface = reader.topology()
    if surface is None:
        topic = f"{reader.node}/topology"
        cause = reader.with_missing(f"{reader.parts[0].path} holds no {topic}, therefore its surface is unknown")
        raise SessionError(f"{cause}; `rerun` itself shows the points")
    rest_positions = np.asarray(surface.vertices, dtype=np.float64)
    if len(rest_positions) != len(opening.positions) or (
        len(surface.triangles) and int(surface.triangles.max()) >= len(rest_positions)
    ):
        cause = f"the topology of {len(rest_positions)} particles does not fit the state"
        raise SessionError(f"{reader.parts[0].path}: {cause}")
    sample = _ScanSample(reader.node)
    geometry: SurfaceGeometry | None = None
    rows, columns = 1, len(rest_positions)
    strain, normals = np.zeros(len(rest_positions), np.float32), np.zeros((len(rest_positions), 3), np.float32)
    low, high = opening.positions.min(axis=0), opening.positions.max(axis=0)
    strains: list[float] = []
    for cloud in sample.clouds(reader, 1 if is_followed else SAMPLES):
        if geometry is None:
            rows, columns = cloud.height, cloud.width
            check_fit(cloud, len(rest_positions))
            geometry = make_surface_geometry(surface.triangles, rest_positions, opening.positions, rows, columns)
        check_fit(cloud, len(rest_positions))
        geometry.compute(cloud.xyz, normals, strain)
        # A cloth that diverged must not determine bounds and colours.
        if np.isfinite(strain).all() and np.isfinite(cloud.xyz).all():
            strains.append(float(np.quantile(strain, 1.0 - _CLIPPED_FRACTION)))
            low, high = np.minimum(low, cloud.xyz.min(axis=0)), np.maximum(high, cloud.xyz.max(axis=0))
    if geometry is None:
        rows, columns = 1, len(rest_positions)
        geometry = make_surface_geometry(surface.triangles, rest_positions, opening.positions, rows, columns)
    gripper_targets = np.array(sample.gripper_targets).reshape(-1, 3)
    if len(gripper_targets):
        # A distant gripper must not make the cloth small.
        margin = _MARGIN * float(np.linalg.norm(high - low))
        low = np.minimum(low, np.maximum(gripper_targets.min(axis=0), low - margin))
        high = np.maximum(high, np.minimum(gripper_targets.max(axis=0), high + margin))
    geometry.compute(np.ascontiguousarray(opening.positions, dtype=np.float32), normals, strain)
    # The snap of a released cloth lasts a few frames; they may exceed the colour range.
    typical_strain = float(np.quantile(strains, 0.9)) if strains else 0.0
    shown = {"plots/strain", "plots/steps"} | sample.plots
    if is_followed:
        shown |= set(PLOTS) - {"plots/error", "plots/deviation"}
    deviation_limit = None
    if opening.has_ensemble:
        shown.add("plots/deviation")
        if strain_limit is None:
            windows, count = _windows(reader, 1 if is_followed else SAMPLES), len(rest_positions)
            deviation_limit = FOLLOWED_DEVIATION if is_followed else typical_deviation(reader, windows, count)
    return PreScan(
        opening=opening,
        rows=rows,
        columns=columns,
        triangles=surface.triangles,
        geometry=geometry,
        normal=np.asarray(normals.mean(axis=0), dtype=np.float64),
        low=low,
        high=high,
        gripper_targets=gripper_targets,
        strain_limit=strain_limit or (FOLLOWED_LIMIT if is_followed else round_up(max(typical_strain, _MIN_LIMIT))),
        plots=tuple(path for path in PLOTS if path in shown),
        deviation_limit=None if deviation_limit is None else round_up(deviation_limit),
    )


def check_fit(cloud: Cloud, particle_count: int) -> None:
    """Raise SessionError for a cloud whose number of points is not that of the session's particles."""
    if len(cloud.xyz) != particle_count:
        raise SessionError(f"a cloud has {len(cloud.xyz)} points, the topology {particle_count}")


def round_up(value: float) -> float:
    """Return a value above 0, rounded up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1.0 - 1e-9))


class _ScanSample:
    """Gripper targets and plots that a sample of a session's messages shows."""

    def __init__(self, node: str) -> None:
        self._node = node
        self.gripper_targets: list[list[float]] = []
        self.plots: set[str] = set()

    def clouds(self, reader: SessionReader, samples: int) -> Iterator[Cloud]:
        """Yield sample clouds evenly over the session, and collect targets and plots of the messages between."""
        windows = _windows(reader, samples)
        first = windows[0][0]
        if first is not None:
            # Reading stops at the first cloud of a window and may miss diagnostics, which come about once a second.
            # Therefore the beginning is read in full.
            for message in reader.messages(start=first, end=first + _DIAGNOSTICS_SPAN):
                self._add(message)
        for start, end in windows:
            next_time = start
            for message in reader.messages(start=start, end=end):
                self._add(message)
                if message.topic == f"{self._node}/points" and (next_time is None or message.log_time >= next_time):
                    yield decode_cloud(message.data)
                    if end is not None or samples == 1:
                        break
                    # Without an index the whole file is read.
                    next_time = message.log_time + _CLOUD_SPACING

    def _add(self, message: Message) -> None:
        if message.topic == f"{self._node}/frame":
            record = read_frame(message)
            targets = [list(event["position"]) for event in record.events if event.get("kind") == "target"]
            if any(len(position) != 3 for position in targets):
                raise SessionError(f"the record of frame {record.frame} has a target that is not three numbers")
            self.gripper_targets.extend(targets)
            numbers = list(extra_numbers(record.extras))
        elif message.topic == DIAGNOSTICS_TOPIC:
            numbers = list(diagnostic_numbers(message.data))
        elif message.topic.endswith("/wrench"):
            self.plots.add("plots/force")
            return
        else:
            return
        self.plots.update(path.rsplit("/", 1)[0] for path, _ in numbers)


def _windows(reader: SessionReader, samples: int) -> list[tuple[int | None, int | None]]:
    """Return windows of log time [ns], from each of which one cloud is sampled; one infinite one without indexes."""
    times = []
    for part in reader.parts:
        if not part.indexed or part.summary is None or not part.summary.chunks:
            return [(None, None)]
        for index in part.summary.chunks.values():
            times += [index.message_start_time, index.message_end_time]
    first, last = min(times), max(times) + 1
    if samples < 2 or last - first < samples:
        return [(None, None)]
    edges = [first + (last - first) * k // samples for k in range(samples)]
    return list(zip(edges, [*edges[1:], last], strict=True))
