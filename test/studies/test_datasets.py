# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Datasets read by zarr and pyarrow, compared with their sessions."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("zarr")
pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
pytest.importorskip("rosbags")

import pyarrow.parquet as pq

from cloth_sim_ros.session.cdr import decode, decode_cloud
from cloth_sim_ros.session.reader import SessionReader, read_frame
from cloth_sim_ros.studies import study_file
from cloth_sim_ros.studies.folder import StudyFolder
from cloth_sim_ros.studies.lerobot_stats import aggregate, statistics
from cloth_sim_ros.studies.main import main
from cloth_sim_ros.studies.study_estimate import sample_and_estimate
from cloth_sim_ros.studies.study_run import perform
from cloth_sim_ros.verify.run import verify

POLICY = """\
from cloth_sim_ros import Grasp, Target
from cloth_sim_ros.simulation.events import Move

def push(seen):
    if seen.frame == 0:
        return [Target("gripper", seen.positions[-1], (0.0, 0.0, 0.0, 1.0)), Grasp("gripper", True)]
    if seen.frame == 9 and seen.values.get("fails"):
        raise RuntimeError("requested failure")
    return [Target("gripper", seen.positions[-1] + [0.0, 0.0, 0.01]), Move("ball", (0.0, 1.0 - 0.01 * seen.frame, 0.2))]
"""
STUDY = {
    "scene": "cloth_sim.yaml",
    "parameters": {
        "cloth.resolution": [5, 6],
        "tolerance": 1e-3,
        "gripper.radius": 0.3,
        "points.velocity": True,
        "contact.thickness": 0.004,
        "obstacles": ["ball"],
        "ball.shape": "sphere",
        "ball.size": [0.1],
        "ball.position": [0.0, 1.0, 0.2],
    },
    "policy": "arm.py:push",
    "duration": 0.25,
    "sampling": "grid",
}


@pytest.fixture(scope="module", params=[True, False], ids=["clouds", "no clouds"])
def folder(request, tmp_path_factory) -> StudyFolder:
    root = tmp_path_factory.mktemp("study")
    (root / "arm.py").write_text(POLICY)
    vary = {"material.density": [0.1, 0.2], "policy.fails": [False, True]}
    study = study_file.from_dict({**STUDY, "vary": vary, "clouds": request.param}, folder=root)
    study_folder = StudyFolder(root / "out")
    samples, _ = sample_and_estimate(study, 1)
    study_folder.create(study, samples, "")
    for run, values in enumerate(samples):
        perform(study_folder, study, run, values)
    return study_folder


def recorded(path: Path):
    """Return the recorded clouds, velocities, wrenches and events of a session."""
    clouds, velocities, wrenches, events = [], [], [], []
    with SessionReader([path]) as reader:
        for message in reader.messages():
            if message.topic.endswith("/points"):
                cloud = decode_cloud(message.data)
                clouds.append(cloud.xyz.copy())
                velocities.append(cloud.velocity.copy())
            elif message.topic.endswith("/gripper/wrench"):
                wrench = decode(message.data, message.type_name).wrench
                wrenches.append([getattr(part, axis) for part in (wrench.force, wrench.torque) for axis in "xyz"])
            elif message.topic.endswith("/frame"):
                events.append(read_frame(message).events)
    return np.array(clouds), np.array(velocities), np.array(wrenches, dtype=np.float32), events


def test_zarr_equals_recorded_sessions(folder: StudyFolder, tmp_path: Path) -> None:
    import zarr

    out = tmp_path / "set.zarr"
    assert main(["export", str(folder.path), "--zarr", str(out)]) == 0
    group = zarr.open_group(str(out), mode="r")
    assert json.loads((out / "zarr.json").read_text())["zarr_format"] == 3
    # Runs 1 and 3 failed.
    assert group["run"][:].tolist() == [0, 2]
    assert group["frame_count"][:].tolist() == [15, 15]
    assert group["positions"].chunks == (1, 16, 30, 3)
    assert group["positions"].dtype == np.float32
    for k, run in enumerate((0, 2)):
        clouds, velocities, wrenches, events = recorded(folder.session_file(run))
        if len(clouds):
            assert np.array_equal(group["positions"][k, 1:], clouds)
            assert np.array_equal(group["velocities"][k, 1:], velocities)
        assert np.array_equal(group["wrenches"][k, :, 0], wrenches)
        assert np.abs(wrenches).max() > 0.1
        for frame, of_frame in enumerate(events):
            (target,) = [event for event in of_frame if event["kind"] == "target"]
            assert np.array_equal(group["actions"][k, frame, 0, :3], np.float32(target["position"]))
            assert group["actions"][k, frame, 0, 7] == 1.0
    assert np.all(group["obstacle_poses"][:, -1, 0, 1] < 0.9)
    assert np.all(group["poses"][:, 1:, 0, 7] == 1.0)
    assert main(["export", str(folder.path), "--zarr", str(out)]) == 2


@pytest.mark.parametrize(
    ("damage", "words"),
    [("cut", "it has {} frames, the run 15; run the study again"), ("exchanged", "and its last digest differs")],
)
def test_session_of_another_run_is_not_exported(
    folder: StudyFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: str, words: str
) -> None:
    copy = StudyFolder(shutil.copytree(folder.path, tmp_path / "copy"))
    session = copy.session_file(0)
    n_frames = 15
    if damage == "exchanged":
        shutil.copy(copy.session_file(2), session)
    else:
        data = session.read_bytes()
        session.write_bytes(data[: data.rfind(b"/cloth_sim/frame") // 2])
        with SessionReader([session]) as reader:
            n_frames = len([message for message in reader.messages() if message.topic.endswith("/frame")])
    for kind in ("zarr", "lerobot", "mcap"):
        out = tmp_path / f"set.{kind}"
        assert main(["export", str(copy.path), f"--{kind}", str(out)]) != 0
        said = capsys.readouterr().err
        assert f"{session} is not the session of run 0" in said
        assert words.format(n_frames) in said
        assert not out.exists()


def test_lerobot_equals_recorded_sessions(folder: StudyFolder, tmp_path: Path) -> None:
    out = tmp_path / "set"
    assert main(["export", str(folder.path), "--lerobot", str(out), "--task", "lift it"]) == 0
    info = json.loads((out / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"], info["total_frames"]) == ("v3.0", 60, 2, 30)
    table = pq.read_table(out / info["data_path"].format(chunk_index=0, file_index=0))
    assert table.num_rows == 30
    assert set(table.column_names) == set(info["features"])
    rows = {name: np.array(table[name].to_pylist()) for name in table.column_names}
    assert rows["index"].tolist() == list(range(30))
    assert rows["episode_index"].tolist() == [0] * 15 + [1] * 15
    assert np.allclose(rows["timestamp"][:15], np.arange(15) / 60, atol=1e-6)
    for name, feature in info["features"].items():
        width = feature["shape"][0]
        assert rows[name].shape == ((30,) if width == 1 and feature["names"] is None else (30, width))
    assert pq.read_metadata(out / "data" / "chunk-000" / "file-000.parquet").num_row_groups == 2
    for k, run in enumerate((0, 2)):
        clouds, velocities, wrenches, _ = recorded(folder.session_file(run))
        part = slice(15 * k, 15 * k + 15)
        if len(clouds):
            assert np.array_equal(rows["observation.environment_state"][part][1:], clouds[:-1].reshape(14, -1))
            assert np.array_equal(rows["observation.velocities"][part][1:], velocities[:-1].reshape(14, -1))
        # The observed wrench is that of the previous frame.
        assert np.array_equal(rows["observation.wrench"][part][1:], wrenches[:-1])
        assert not rows["observation.wrench"][15 * k].any()
    episodes = pq.read_table(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert [e["length"] for e in episodes] == [15, 15]
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [(0, 15), (15, 30)]
    assert [e["tasks"] for e in episodes] == [["lift it"], ["lift it"]]
    assert episodes[1]["stats/action/max"] == rows["action"][15:].max(axis=0).tolist()
    tasks = pq.read_table(out / "meta" / "tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "lift it"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    stats = json.loads((out / "meta" / "stats.json").read_text())
    assert np.allclose(stats["action"]["mean"], rows["action"].mean(axis=0), atol=1e-12)
    assert np.allclose(stats["action"]["std"], rows["action"].std(axis=0), atol=1e-9)
    assert stats["action"]["count"] == [30]


def test_video_has_one_picture_per_row(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    pytest.importorskip("matplotlib")
    (tmp_path / "arm.py").write_text(POLICY)
    study = study_file.from_dict({**STUDY, "duration": 0.1, "vary": {"material.density": [0.1]}}, folder=tmp_path)
    study_folder = StudyFolder(tmp_path / "out")
    samples, _ = sample_and_estimate(study, 1)
    study_folder.create(study, samples, "")
    perform(study_folder, study, 0, samples[0])
    out = tmp_path / "set"
    assert main(["export", str(study_folder.path), "--lerobot", str(out), "--video"]) == 0
    info = json.loads((out / "meta" / "info.json").read_text())
    key = "observation.images.cloth"
    with av.open(str(out / info["video_path"].format(video_key=key, chunk_index=0, file_index=0))) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(pictures) == info["total_frames"] == 6
    assert list(pictures[0].shape) == info["features"][key]["shape"]
    # The picture shows the red cloth on white.
    assert pictures[0][:, :, 1].min() < 120 < pictures[0][:, :, 1].max()
    (episode,) = pq.read_table(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert episode[f"videos/{key}/to_timestamp"] == pytest.approx(0.1)
    assert np.shape(episode[f"stats/{key}/mean"]) == (3, 1, 1)


def test_mcap_export_adds_missing_clouds(folder: StudyFolder, tmp_path: Path) -> None:
    out = tmp_path / "sessions"
    assert main(["export", str(folder.path), "--mcap", str(out)]) == 0
    (first, _) = sorted(out.glob("*.mcap"))
    verdict = verify([first])
    assert verdict.same
    assert verdict.clouds == verdict.frames == 15


def performed(folder: Path, **vary) -> StudyFolder:
    """Return the folder of a finished study of hanging cloths."""
    entries = {"scene": "cloth_sim.yaml", "scripts": "grasp.yaml", "duration": 0.1, "sampling": "grid", "vary": vary}
    parameters = {
        "cloth.resolution": [4, 4],
        "tolerance": 1e-3,
        "ball.shape": "box",
        "ball.position": [0.0, 1.0, 0.2],
    }
    study = study_file.from_dict({**entries, "parameters": parameters}, folder=folder)
    study_folder, (samples, _) = StudyFolder(folder / "out"), sample_and_estimate(study, 1)
    study_folder.create(study, samples, "")
    for run, values in enumerate(samples):
        assert perform(study_folder, study, run, values)["status"] == "ok"
    return study_folder


def test_zarr_stores_triangles_of_differing_cloths(tmp_path: Path) -> None:
    import zarr

    study_folder, out = performed(tmp_path, **{"cloth.resolution[0]": [4, 5]}), tmp_path / "set.zarr"
    assert main(["export", str(study_folder.path), "--zarr", str(out)]) == 0
    group = zarr.open_group(str(out), mode="r")
    triangles = group["triangles"][:]
    assert triangles.shape == (2, 24, 3)
    assert (triangles[0, 18:] == -1).all()
    assert (triangles[0, :18].max(), triangles[1].max()) == (15, 19)
    assert group["particle_count"][:].tolist() == [16, 20]


@pytest.mark.parametrize("kind", ["--zarr", "--lerobot"])
def test_runs_at_several_rates_are_refused(tmp_path: Path, capsys, kind: str) -> None:
    study_folder, out = performed(tmp_path, rate=[60.0, 120.0]), tmp_path / "set"
    assert main(["export", str(study_folder.path), kind, str(out)]) == 2
    assert "rate of run 1 is 120.0" in capsys.readouterr().err
    assert not out.exists()
    assert main(["export", str(study_folder.path), "--mcap", str(out)]) == 0


def test_runs_with_other_obstacles_are_refused(tmp_path: Path, capsys) -> None:
    study_folder = performed(tmp_path, obstacles=[[""], ["ball"]])
    assert main(["export", str(study_folder.path), "--zarr", str(tmp_path / "set")]) == 2
    assert "obstacles of run 1 is ['ball'], of the first one []" in capsys.readouterr().err


def test_aggregated_statistics_equal_row_statistics() -> None:
    generator = np.random.default_rng(0)
    parts = [generator.normal(size=(n, 3)) + n for n in (5, 11)]
    total = aggregate([{"x": statistics(part)} for part in parts])["x"]
    rows = np.concatenate(parts)
    assert np.allclose(total["mean"], rows.mean(axis=0))
    assert np.allclose(total["std"], rows.std(axis=0))
    assert np.array_equal(total["max"], rows.max(axis=0))


def test_gripper_is_nowhere_before_its_first_target(tmp_path: Path) -> None:
    import zarr

    (tmp_path / "late.py").write_text(
        "from cloth_sim_ros import Target\n"
        "def move(seen):\n"
        "    return [Target('b', (0.2, 0.0, 0.8))] if seen.frame == 3 else []\n"
    )
    parameters = {"cloth.resolution": [4, 5], "grippers": ["a", "b"]}
    values = {"scene": "cloth_sim.yaml", "parameters": parameters, "policy": "late.py:move", "duration": 0.1}
    study = study_file.from_dict({**values, "runs": 1}, folder=tmp_path)
    folder = StudyFolder(tmp_path / "out")
    samples, _ = sample_and_estimate(study, 1)
    folder.create(study, samples, "")
    perform(folder, study, 0, samples[0])
    assert main(["export", str(folder.path), "--zarr", str(tmp_path / "set.zarr")]) == 0
    group = zarr.open_group(str(tmp_path / "set.zarr"), mode="r")
    for name, first in (("poses", 4), ("actions", 3)):
        rows = group[name][0]
        assert np.isnan(rows[:, 0, :7]).all()
        assert np.isnan(rows[:first, 1, :7]).all()
        assert np.allclose(rows[first:, 1, :7], (0.2, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0))
        assert (rows[:, :, 7] == 0.0).all()
    assert main(["export", str(folder.path), "--lerobot", str(tmp_path / "set"), "--task", "wait"]) == 0
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    table = pq.read_table(tmp_path / "set" / info["data_path"].format(chunk_index=0, file_index=0))
    for name in ("observation.state", "action"):
        rows = np.array(table[name].to_pylist()).reshape(-1, 2, 8)
        assert np.allclose(rows[:, 1, :7], (0.2, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0))
        assert np.allclose(rows[:, 0, :7], (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
