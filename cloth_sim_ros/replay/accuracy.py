# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How accurate a session is, for its curves and colours: measured by `cloth_verify --accuracy`, in its own process.

The physics stays out of this room; a file each of frames' and of particles' numbers is all that comes over.
"""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.replay.survey import round_up
from cloth_sim_ros.session.child_process import child_environment, module_command
from cloth_sim_ros.session.errors import SessionError

if TYPE_CHECKING:
    import rerun as rr

#: Exit statuses of `cloth_verify` with which there is a certificate.
_MEASURED = (0, 1, 3, 4)
#: Least error that is shown in the last colour [m].
_LEAST_LIMIT = 1e-12
#: By what a frame's numbers are called: path, legend and colour of their curve.
_CURVES = {
    "promise": ("plots/accuracy/allowed", "allowed", 0xF0F0F0FF),
    "tolerance": ("plots/accuracy/tolerance", "tolerance", 0x8A8A8AFF),
    "error": ("plots/accuracy/error", "error", 0xFF5A4AFF),
    "own": ("plots/accuracy/own_error", "measured to", 0x25C26EFF),
    "growth": ("plots/growth/growth", "growth", 0xB48CFFFF),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """A certificate's numbers."""

    rows: dict[int, int]
    """Place of each frame's numbers, by its number."""
    frames: list[dict[str, Any]]
    particles: NDArray[np.float32]
    """Error of each particle since its window's beginning [m], shape (frames, n), on the disk; nan where unknown."""
    limit: float
    """Error that is shown in the last colour [m]."""

    def errors(self, frame: int) -> NDArray[np.float32]:
        """Errors of a frame's particles [m], shape (n,); 0 where none is known."""
        row = self.rows.get(frame)
        if row is None:
            return np.zeros(self.particles.shape[1], np.float32)
        return np.nan_to_num(self.particles[row])

    def curves(self, frame: int) -> Iterator[tuple[str, float]]:
        """Path and height of each curve at a frame: powers of ten, for errors differ by many."""
        row = self.rows.get(frame)
        if row is None:
            return
        for name, (path, _, _) in _CURVES.items():
            value = self.frames[row][name]
            if value is not None and value > 0.0:
                yield path, math.log10(value)


def draw_curves(recording: rr.RecordingStream) -> None:
    """Give the curves their names and colours."""
    import rerun as rr

    for path, name, colour in _CURVES.values():
        recording.log(path, rr.SeriesLines(names=[name], colors=[colour]), static=True)


def measure(paths: Sequence[Path], folder: Path, particle_count: int) -> Accuracy:
    """Measure a session, all its files in order; what is found lies in a folder, which must stay.

    Raises:
        SessionError: if it cannot be measured.
    """
    numbers, particles = folder / "accuracy.json", folder / "particles.f32"
    command = module_command("cloth_sim_ros.verify.main", "--accuracy", *map(str, paths))
    command += ["--json", str(numbers), "--particles", str(particles)]
    # Its progress bar is for the terminal; its tables are not what was asked for here.
    done = subprocess.run(command, env=child_environment(), stdout=subprocess.DEVNULL, check=False)
    if done.returncode not in _MEASURED:
        raise SessionError(f"{paths[0]}: its accuracy cannot be measured (cloth_verify ended with {done.returncode})")
    frames = json.loads(numbers.read_text(encoding="utf-8"))["frames"]
    if not frames:
        raise SessionError(f"{paths[0]} holds no frame in which time passes: there is no accuracy to show")
    errors = [frame["error"] for frame in frames if frame["error"] is not None]
    usual = float(np.quantile(errors, 0.9)) if errors else 0.0
    return Accuracy(
        rows={frame["frame"]: k for k, frame in enumerate(frames)},
        frames=frames,
        particles=np.memmap(particles, dtype="<f4", mode="r", shape=(len(frames), particle_count)),
        limit=round_up(max(usual, _LEAST_LIMIT)),
    )
