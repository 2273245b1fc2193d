# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pre-scan of a session: bounds, colour range and plots for the viewer."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.replay.measures import Measures, measures_of
from cloth_sim_ros.replay.plots import DIAGNOSTICS_TOPIC, PLOTS, diagnostic_numbers, extra_numbers
from cloth_sim_ros.replay.scene_text import Opening, read_opening
from cloth_sim_ros.session.cdr import Cloud, decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.reader import SessionReader, read_frame

#: Number of sampled clouds.
SAMPLES = 40
#: Time between sampled clouds in a file without an index, and time within which diagnostics are certain [ns].
_BETWEEN, _PERIODIC = 1_000_000_000, 5_000_000_000
#: Fraction of particles above the colour range, so that one stretched corner does not determine it.
_BEYOND = 0.002
#: Margin around the cloth's bounding box in which grippers stay in view, as a fraction of its diagonal.
_MARGIN = 0.08
#: Colour range (strain) of an unstretched cloth, and of a session that is being recorded.
_LEAST_LIMIT, _FOLLOWED_LIMIT = 0.001, 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """Result of a pre-scan."""

    opening: Opening
    rows: int
    columns: int
    triangles: NDArray[np.uint32]
    measures: Measures
    normal: NDArray[np.float64]
    """Mean normal of the cloth at its start, shape (3,)."""
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    """Corners of the bounding box of the cloth and of grippers near it [m], shape (3,)."""
    grips: NDArray[np.float64]
    """Target positions of the grippers [m], shape (k, 3)."""
    strain_limit: float
    """Strain of the last colour."""
    plots: tuple[str, ...]
    """Paths of the plots that have numbers, in order."""
    error_limit: float | None = None
    """Error of the last colour [m]; None if strain is shown."""


def survey(reader: SessionReader, *, strain_limit: float | None = None, followed: bool = False) -> Survey:
    """Scan a sample of a session's clouds; only the first one if `is_followed`.

    Raises:
        SessionError: if the session has no surface, or its clouds do not fit the surface.
    """
    opening = read_opening(reader.scene_yaml, reader.state)
    surface = reader.topology()
    if surface is None:
        raise SessionError(
            f"{reader.parts[0].path} holds no {reader.node}/topology, therefore its surface is unknown; "
            "`rerun` itself shows the points"
        )
    rest = np.asarray(surface.vertices, dtype=np.float64)
    if len(rest) != len(opening.positions) or (len(surface.triangles) and int(surface.triangles.max()) >= len(rest)):
        raise SessionError(f"{reader.parts[0].path}: the topology of {len(rest)} particles does not fit the state")
    gathered = _Gathered(reader.node)
    measures: Measures | None = None
    rows, columns = 1, len(rest)
    strain, normals = np.zeros(len(rest), np.float32), np.zeros((len(rest), 3), np.float32)
    low, high = opening.positions.min(axis=0), opening.positions.max(axis=0)
    strains: list[float] = []
    for cloud in gathered.clouds(reader, 1 if followed else SAMPLES):
        if measures is None:
            rows, columns = cloud.height, cloud.width
            check_fit(cloud, len(rest))
            measures = measures_of(surface.triangles, rest, opening.positions, rows, columns)
        check_fit(cloud, len(rest))
        measures.measure(cloud.xyz, normals, strain)
        strains.append(float(np.quantile(strain, 1.0 - _BEYOND)))
        low, high = np.minimum(low, cloud.xyz.min(axis=0)), np.maximum(high, cloud.xyz.max(axis=0))
    if measures is None:
        rows, columns = 1, len(rest)
        measures = measures_of(surface.triangles, rest, opening.positions, rows, columns)
    grips = np.array(gathered.grips).reshape(-1, 3)
    if len(grips):
        # A distant gripper must not make the cloth small.
        margin = _MARGIN * float(np.linalg.norm(high - low))
        low = np.minimum(low, np.maximum(grips.min(axis=0), low - margin))
        high = np.maximum(high, np.minimum(grips.max(axis=0), high + margin))
    measures.measure(np.ascontiguousarray(opening.positions, dtype=np.float32), normals, strain)
    # The snap of a released cloth lasts a few frames; they may exceed the colour range.
    usual = float(np.quantile(strains, 0.9)) if strains else 0.0
    always = {"plots/strain", "plots/steps"}
    return Survey(
        opening=opening,
        rows=rows,
        columns=columns,
        triangles=surface.triangles,
        measures=measures,
        normal=np.asarray(normals.mean(axis=0), dtype=np.float64),
        low=low,
        high=high,
        grips=grips,
        strain_limit=strain_limit or (_FOLLOWED_LIMIT if followed else round_up(max(usual, _LEAST_LIMIT))),
        plots=tuple(path for path in PLOTS if path in always | gathered.plots or (followed and path != "plots/error")),
    )


def check_fit(cloud: Cloud, particle_count: int) -> None:
    """Raise SessionError if a cloud does not fit the session's cloth."""
    if len(cloud.xyz) != particle_count:
        raise SessionError(f"a cloud has {len(cloud.xyz)} points, the topology {particle_count}")


def round_up(value: float) -> float:
    """Return the next number of the sequence 1, 2, 5, 10, 20 ... times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1.0 - 1e-9))


class _Gathered:
    """Targets and plots in a sample of the messages."""

    def __init__(self, node: str) -> None:
        self._node = node
        self.grips: list[list[float]] = []
        self.plots: set[str] = set()

    def clouds(self, reader: SessionReader, samples: int) -> Iterator[Cloud]:
        """Yield clouds evenly over the session, and add the other messages of the sample."""
        windows = _windows(reader, samples)
        first = windows[0][0]
        if first is not None:
            # Reading stops at the first cloud of a window and may miss diagnostics, which come about once a second.
            # Therefore the beginning is read in full.
            for message in reader.messages(start=first, end=first + _PERIODIC):
                self._note(message)
        for start, end in windows:
            due = start
            for message in reader.messages(start=start, end=end):
                self._note(message)
                if message.topic == f"{self._node}/points" and (due is None or message.log_time >= due):
                    yield decode_cloud(message.data)
                    if end is not None or samples == 1:
                        break
                    # Without an index the whole file is read.
                    due = message.log_time + _BETWEEN

    def _note(self, message: Message) -> None:
        if message.topic == f"{self._node}/frame":
            record = read_frame(message)
            targets = [list(event["position"]) for event in record.events if event.get("kind") == "target"]
            if any(len(position) != 3 for position in targets):
                raise SessionError(f"the record of frame {record.frame} has a target that is not three numbers")
            self.grips.extend(targets)
            found = list(extra_numbers(record.extras))
        elif message.topic == DIAGNOSTICS_TOPIC:
            found = list(diagnostic_numbers(message.data))
        elif message.topic.endswith("/wrench"):
            self.plots.add("plots/force")
            return
        else:
            return
        self.plots.update(path.rsplit("/", 1)[0] for path, _ in found)


def _windows(reader: SessionReader, samples: int) -> list[tuple[int | None, int | None]]:
    """Return windows of log time [ns] for one cloud each; one infinite window if a file has no index."""
    times = []
    for part in reader.parts:
        if not part.indexed or part.summary is None or not part.summary.chunks:
            return [(None, None)]
        times += [
            time
            for index in part.summary.chunks.values()
            for time in (index.message_start_time, index.message_end_time)
        ]
    first, last = min(times), max(times) + 1
    if samples < 2 or last - first < samples:
        return [(None, None)]
    edges = [first + (last - first) * k // samples for k in range(samples)]
    return list(zip(edges, [*edges[1:], last], strict=True))
