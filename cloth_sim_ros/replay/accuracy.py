# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Accuracy of a session, for curves and colours.

`cloth_verify --accuracy` measures it in a separate process; therefore this package does not import the physics. The
results come in two files: numbers of frames and errors of particles.
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

from cloth_sim_ros.replay.pre_scan import round_up
from cloth_sim_ros.session.child_process import child_environment, module_command
from cloth_sim_ros.session.errors import SessionError

if TYPE_CHECKING:
    import rerun as rr

#: Exit statuses of `cloth_verify` that come with a certificate.
_CERTIFIED_STATUSES = (0, 1, 3, 4)
#: Minimum error of the last colour [m].
_MIN_LIMIT = 1e-12
#: Path, legend and colour of the curve by key of a frame's numbers.
_CURVES = {
    "error_bound": ("plots/accuracy/allowed", "allowed", 0xF0F0F0FF),
    "tolerance": ("plots/accuracy/tolerance", "tolerance", 0x8A8A8AFF),
    "error": ("plots/accuracy/error", "error", 0xFF5A4AFF),
    "uncertainty": ("plots/accuracy/own_error", "measured to", 0x25C26EFF),
    "amplification": ("plots/growth/growth", "amplification", 0xB48CFFFF),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredAccuracy:
    """Errors of a session's frames and particles, read from a certificate."""

    rows: dict[int, int]
    """Row of each frame's numbers by frame index."""
    frames: list[dict[str, Any]]
    particles: NDArray[np.float32]
    """Error of each particle since its window's beginning [m], shape (frames, n), memory-mapped; nan if unknown."""
    limit: float
    """Error of the last colour [m]."""

    def errors(self, frame: int) -> NDArray[np.float32]:
        """Return the error of each particle in a frame [m], shape (n,); 0 if unknown."""
        row = self.rows.get(frame)
        if row is None:
            return np.zeros(self.particles.shape[1], np.float32)
        return np.nan_to_num(self.particles[row])

    def curves(self, frame: int) -> Iterator[tuple[str, float]]:
        """Yield plot path and log10 of each error and bound of a frame, which differ by orders of magnitude."""
        row = self.rows.get(frame)
        if row is None:
            return
        for name, (path, _, _) in _CURVES.items():
            value = self.frames[row][name]
            if value is not None and value > 0.0:
                yield path, math.log10(value)


def draw_curves(recording: rr.RecordingStream) -> None:
    """Log names and colours of the accuracy curves to Rerun, once for the whole recording."""
    import rerun as rr

    for path, name, colour in _CURVES.values():
        recording.log(path, rr.SeriesLines(names=[name], colors=[colour]), static=True)


def measure(paths: Sequence[Path], folder: Path, particle_count: int) -> MeasuredAccuracy:
    """Run `cloth_verify --accuracy` into `folder`, which the result needs later; return errors. Raises SessionError.

    Raises:
        SessionError: if it cannot be measured.
    """
    certificate_file, particles = folder / "accuracy.json", folder / "particles.f32"
    command = module_command("cloth_sim_ros.verify.main", "--accuracy", *map(str, paths))
    command += ["--json", str(certificate_file), "--particles", str(particles)]
    # Only its progress bar is shown, not its tables.
    completed = subprocess.run(command, env=child_environment(), stdout=subprocess.DEVNULL, check=False)
    if completed.returncode not in _CERTIFIED_STATUSES:
        cause = f"cloth_verify ended with {completed.returncode}"
        raise SessionError(f"{paths[0]}: its accuracy cannot be measured ({cause})")
    frames = json.loads(certificate_file.read_text(encoding="utf-8"))["frames"]
    if not frames:
        raise SessionError(f"{paths[0]} holds no frame in which time passes: there is no accuracy to show")
    errors = [frame["error"] for frame in frames if frame["error"] is not None]
    usual = float(np.quantile(errors, 0.9)) if errors else 0.0
    return MeasuredAccuracy(
        rows={frame["frame"]: k for k, frame in enumerate(frames)},
        frames=frames,
        particles=np.memmap(particles, dtype="<f4", mode="r", shape=(len(frames), particle_count)),
        limit=round_up(max(usual, _MIN_LIMIT)),
    )
