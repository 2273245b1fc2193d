# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded swings of a real cloth, read where they lie on the machine.

The recordings are those of a thesis (2021, github.com/Alados5/tfm_matlab, session of 2021-07-05). They have no licence,
so nothing of them stands here. An arm swings a cloth of 0.3 m that hangs by two corners. A camera shows a mesh of 8 x 8
points at 9 Hz.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cloth_sim_ros import Scene
from cloth_sim_ros.fit.bag import read_recording
from cloth_sim_ros.fit.joint_solver import replace_alignment
from cloth_sim_ros.fit.parameters import choose_parameters
from cloth_sim_ros.fit.real import fit_real
from cloth_sim_ros.fit.recorded import Recording
from cloth_sim_ros.fit.scores import Score, driven_floors, pooled_score, score
from cloth_sim_ros.fit.screening import screen_clouds
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from cloth_sim_ros.physics.model.forces.force import Array
from validation.reality.linear_fits import motion_scores, prepare, rigid_scores, start_point
from validation.report import Report, print_progress

#: Topics of the clouds and of the arm's tool.
CLOUDS, TOOL = "/cloth_segmentation/cloth_mesh:x,y,z", "/iri_wam_controller/libbarrett_link_tcp"
#: File with the camera's calibrated pose in the arm's base.
CALIBRATION = "n8_calibration_campose.csv"
#: Held corners in the tool's frame [m], from the first clouds: half of the edge to either side, below the tool.
OFFSETS = {"left": (0.0, -0.15, 0.085), "right": (0.0, 0.15, 0.085)}
#: Held particles. The points of the mesh run down its columns.
HELD = {"left": (0,), "right": (56,)}
#: Fitted parameters, and starts of those that are zero by default.
PARAMETERS, START = ("normal_drag", "added_mass", "damping", "shear"), {"added_mass": 0.06, "normal_drag": 0.4}
#: Material and air of `config/swing.yaml`, which were identified from recordings of this cloth.
IDENTIFIED = {
    "material.density": 0.196,
    "material.shear_modulus": 118.0,
    "material.damping": 0.106,
    "air.added_mass": 0.067,
}
#: Largest mean speed of a cloth that counts as still [m/s], and number of motions that parameters are fitted on.
STILL_SPEED, N_FITTED = 0.02, 5
#: Largest median, 95 % quantile and root mean square of the distances, of the defaults and of a fit [mm].
DEFAULTS, FITTED = (15.0, 45.0, 23.0), (12.3, 38.0, 20.0)


def swing_scene(values: Mapping[str, float] | None = None) -> Scene:
    """Return the cloth with the package's default material, except for some values by full name."""
    cloth = {"cloth.size": [0.3, 0.3], "cloth.resolution": [8, 8], "cloth.anchors": [""], "grippers": list(HELD)}
    return Scene.from_parameters({**cloth, **(values or {})})


def read_swings(folder: Path) -> list[Recording]:
    """Return the recordings in a folder, in the order of their names.

    Raises:
        ValueError: if the folder has none, or no calibration.
    """
    bags = sorted(folder.rglob("*_range*_rep*.bag"))
    calibrations = sorted(folder.rglob(CALIBRATION))
    if not bags or not calibrations:
        raise ValueError(f"{folder} has {len(bags)} bags *_range*_rep*.bag and {len(calibrations)} {CALIBRATION}")
    with calibrations[0].open() as stream:
        camera_pose = [float(cell) for cell in list(csv.reader(stream))[-1][1:]]
    scene, poses = swing_scene(), dict.fromkeys(HELD, TOOL)
    return [
        read_recording([bag], scene, topic=CLOUDS, poses=poses, camera_pose=camera_pose, offsets=OFFSETS)
        for bag in bags
    ]


class _Evaluation:
    """Errors of a scene on recordings."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        values: dict[str, float],
        pool: TrajectoryPool,
        pivot: tuple[float, ...] | None = None,
        *,
        material: Mapping[str, float] | None = None,
    ) -> None:
        scene = swing_scene(material)
        parameters = choose_parameters(scene, ["damping"])
        if values:
            parameters = choose_parameters(scene, list(values), values)
        self.problem = prepare(recordings, parameters, pool, scene, HELD, pivot)
        screened = screen_clouds(self.problem.recordings)
        self.left_out, self.problem.used = screened.left_out(), list(screened.used)
        self.n_clouds = sum(len(used) for used in screened.used)
        self.point = start_point(self.problem)
        self.align(self.point.eta)

    def align(self, eta: Array) -> None:
        """Use another time offset and camera pose."""
        self.point = replace_alignment(self.problem, self.point, range(len(self.problem.recordings)), eta)
        self.motions = motion_scores(self.point)

    def still(self) -> Score:
        """Return the errors in clouds of a cloth that is nearly at rest: those of the camera, all over the sheet."""
        parts = []
        for k, (recording, trajectory) in enumerate(zip(self.problem.recordings, self.point.trajectories, strict=True)):
            rate = recording.scene.rate
            offset = self.problem.alignment.alignment(self.point.eta, k).offset
            frames = recording.frames[self.problem.used[k]] - offset * rate
            moved = trajectory.sample(frames + 0.5) - trajectory.sample(frames - 0.5)
            speeds = rate * np.linalg.norm(moved, axis=2).mean(axis=1)
            parts += [
                np.linalg.norm(r, axis=1)
                for r, speed in zip(self.point.residuals[k], speeds, strict=True)
                if speed < STILL_SPEED
            ]
        return score(parts)

    def floor(self) -> Score | None:
        """Return the error of the camera at the held particles."""
        return pooled_score(driven_floors(self.problem, self.point, range(len(self.problem.recordings)))[0])


def run(options: argparse.Namespace) -> Report:
    """Compare the defaults, a fit to some motions, and a rigid cloth with recordings."""
    report = Report("Recorded swings of a real cloth")
    if options.folder is None:
        report.notes.append("skipped: --folder names no recordings (Alados5/tfm_matlab, Session_2021_07_05)")
        return report
    recordings = read_swings(options.folder)
    print_progress(f"{len(recordings)} recordings")
    inside = [int((k + 0.5) * len(recordings) / N_FITTED) for k in range(N_FITTED)]
    outside = [k for k in range(len(recordings)) if k not in inside]
    columns = ["cloth", "motions", "median mm", "95 % mm", "rms mm", "better than rigid"]
    table = report.add_table("Distances of the points from the simulated cloth", columns)
    with TrajectoryPool(options.workers) as pool:
        plain = _Evaluation(recordings, {}, pool)
        rigid = rigid_scores(plain.problem, plain.point)
        print_progress(f"defaults: {_pooled(plain.motions).rms * 1e3:.1f} mm rms")
        identified = _Evaluation(recordings, {}, pool, material=IDENTIFIED)
        begin = time.perf_counter()
        fit = fit_real(
            [recordings[k] for k in inside],
            swing_scene(),
            list(PARAMETERS),
            grasped={name: ",".join(map(str, particles)) for name, particles in HELD.items()},
            start=START,
            workers=options.workers,
        )
        seconds = time.perf_counter() - begin
        fitted = _Evaluation(recordings, fit.values, pool, fit.alignment_model.pivot)
        fitted.align(fit.solution.point.eta)
    for name, motions, selected in (
        ("carried rigidly", rigid, range(len(recordings))),
        ("defaults", plain.motions, range(len(recordings))),
        ("numbers of config/swing.yaml", identified.motions, range(len(recordings))),
        (f"fitted on {N_FITTED} others", fitted.motions, outside),
        ("fitted, still clouds (camera)", [fitted.still()], range(1)),
        ("driven corners (camera)", [floor] if (floor := plain.floor()) is not None else [], range(1)),
    ):
        chosen = [motions[k] for k in selected] if len(motions) > 1 else motions
        better = sum(motions[k].rms < rigid[k].rms for k in selected) if len(motions) > 1 else "-"
        pooled = _pooled(chosen)
        table.rows.append([name, len(chosen), 1e3 * pooled.median, 1e3 * pooled.quantile_95, 1e3 * pooled.rms, better])
    estimates = report.add_table("Fitted parameters", ["parameter", "value", "90 % interval", "identified"])
    for e in fit.estimates:
        low, high = e.interval_at(0.9)
        estimates.rows.append([e.parameter.name, e.value, f"{low:.4g} to {high:.4g}", e.is_identified])
    first = fit.alignments[0]
    assert first is not None
    report.notes.append(
        f"{plain.n_clouds} clouds used, {plain.left_out.shortened} shortened ones left out; {seconds:.0f} s and "
        f"{fit.n_runs} simulations of the fit; clouds {first.offset:.3f} s late, camera turned by "
        f"{np.degrees(first.angle):.1f} degrees. {fit.doubt}"
    )
    _check(report, "defaults", _pooled(plain.motions), DEFAULTS)
    _check(report, "fitted", _pooled([fitted.motions[k] for k in outside]), FITTED)
    worse = [recordings[k].name for k in outside if fitted.motions[k].rms >= rigid[k].rms]
    report.require(not worse, f"a rigid cloth is nearer in {', '.join(worse)}")
    return report


def _pooled(scores: Sequence[Score]) -> Score:
    return score([entry.distances for entry in scores])


def _check(report: Report, name: str, reached: Score, limits: tuple[float, float, float]) -> None:
    values = (1e3 * reached.median, 1e3 * reached.quantile_95, 1e3 * reached.rms)
    if any(value > limit for value, limit in zip(values, limits, strict=True)):
        texts = [" / ".join(f"{distance:.3g}" for distance in distances) for distances in (values, limits)]
        report.fail(f"{name}: {texts[0]} mm instead of {texts[1]}")
