# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Studies: files, checks, runs, folders and the command `cloth_batch`."""

from __future__ import annotations

import datetime
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.studies import index, study_file
from cloth_sim_ros.studies.errors import FolderError, StudyError
from cloth_sim_ros.studies.factors import read
from cloth_sim_ros.studies.folder import StudyFolder
from cloth_sim_ros.studies.main import main
from cloth_sim_ros.studies.sampling import sample
from cloth_sim_ros.studies.study_estimate import sample_and_estimate
from cloth_sim_ros.studies.study_run import perform, perform_all
from cloth_sim_ros.verify.run import verify

BASE = {
    "scene": "cloth_sim.yaml",
    "parameters": {"cloth.resolution": [5, 5], "tolerance": 1e-3, "gripper.radius": 0.3},
    "scripts": "grasp.yaml",
    "duration": 0.5,
    "runs": 4,
    "vary": {"material.density": {"uniform": [0.1, 0.3]}, "target.gripper.z": {"normal": [0.0, 0.01]}},
}
POLICY = """\
from cloth_sim_ros import Grasp, Target

class Lift:
    def __init__(self):
        self.start = None

    def __call__(self, seen):
        if self.start is None:
            self.start = seen.positions[-1]
            return [Target("gripper", self.start), Grasp("gripper", True)]
        if seen.time > seen.values["fails_after"]:
            raise RuntimeError("the arm is at its end")
        return Target("gripper", self.start + [0.0, 0.0, 0.1 * seen.time + 1e-3 * seen.rng.normal()])

def broken(seen):
    return 1 / 0

def leaves(seen):
    raise SystemExit(3)

def ends(run):
    raise SystemExit("enough")

def spread(run):
    return {"spread": run.positions[:, 2].std(), "kept": len(run.times) == 30}
"""


def study_of(folder: Path, **entries):
    content = {**BASE, **entries}
    return study_file.from_dict({k: v for k, v in content.items() if v is not None}, folder=folder)


def create_study(folder: Path, study) -> tuple[StudyFolder, list]:
    study_folder = StudyFolder(folder)
    samples, _ = sample_and_estimate(study, 2)
    study_folder.create(study, samples, "")
    return study_folder, samples


@pytest.fixture
def with_policy(tmp_path: Path):
    (tmp_path / "arm.py").write_text(POLICY)
    return study_of(
        tmp_path,
        scripts=None,
        policy="arm.py:Lift",
        outcomes=["arm.py:spread"],
        vary={"policy.fails_after": [9.0, 0.2]},
        sampling="grid",
        runs=None,
    )


def test_run_session_verifies_and_row_describes_it(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    study_folder, samples = create_study(tmp_path / "out", study)
    row = perform(study_folder, study, 2, samples[2])
    verdict = verify([study_folder.path / row["session"]])
    assert (verdict.same, verdict.frames, verdict.clouds) == (True, 30, 30)
    assert not verdict.missing
    assert (row["status"], row["frames"]) == ("ok", 30)
    assert row["values"]["material.density"] == samples[2][0]
    assert row["outcomes"]["mean_height"] > 0.5


def test_bits_are_independent_of_order_and_process(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    first, samples = create_study(tmp_path / "first", study)
    second, again = create_study(tmp_path / "second", study)
    assert samples == again
    for run in (0, 1, 2, 3):
        perform(first, study, run, samples[run])
    # A worker reads the study from the folder.
    perform_all(str(second.path), [(run, again[run]) for run in (3, 1, 0, 2)])
    for run in range(4):
        assert first.session_file(run).read_bytes() == second.session_file(run).read_bytes()
    digests = [row["digest"] for row in first.rows()]
    assert digests == [row["digest"] for row in second.rows()]
    assert len(set(digests)) == 4


def test_session_without_clouds_is_small_and_verifies(tmp_path: Path) -> None:
    rows = {}
    for clouds in (True, False):
        study = study_of(tmp_path, clouds=clouds)
        study_folder, samples = create_study(tmp_path / str(clouds), study)
        rows[clouds] = perform(study_folder, study, 0, samples[0])
        assert verify([study_folder.path / rows[clouds]["session"]]).same
    assert rows[True]["digest"] == rows[False]["digest"]
    assert rows[False]["bytes"] < rows[True]["bytes"]


def test_failed_run_is_recorded_until_its_failure(with_policy, tmp_path: Path) -> None:
    study_folder, samples = create_study(tmp_path / "out", with_policy)
    succeeded, failed = (perform(study_folder, with_policy, run, values) for run, values in enumerate(samples))
    assert (succeeded["status"], failed["status"]) == ("ok", "failed")
    assert succeeded["outcomes"]["kept"] == 1.0
    assert succeeded["outcomes"]["spread"] > 0.0
    assert "RuntimeError: the arm is at its end (arm.py, line 12)" in failed["error"]
    verdict = verify([study_folder.path / failed["session"]])
    assert verdict.same
    assert verdict.frames == failed["frames"] == 13


def test_policy_random_numbers_depend_on_run(with_policy, tmp_path: Path) -> None:
    first, samples = create_study(tmp_path / "one", with_policy)
    second, _ = create_study(tmp_path / "other", with_policy)
    perform(first, with_policy, 1, samples[0])
    perform(first, with_policy, 0, samples[0])
    perform(second, with_policy, 0, samples[0])
    digests = [row["digest"] for row in first.rows()]
    assert digests[0] == next(second.rows())["digest"]
    assert digests[0] != digests[1]


def test_finished_run_is_not_repeated(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    study_folder, samples = create_study(tmp_path / "out", study)
    row = perform(study_folder, study, 0, samples[0])
    assert perform(study_folder, study, 0, samples[0]) == row


@pytest.mark.parametrize("where", ["session", "row"])
def test_full_disk_names_folder_and_leaves_no_files(tmp_path: Path, monkeypatch, where: str) -> None:
    study = study_of(tmp_path)
    study_folder, samples = create_study(tmp_path / "out", study)

    def full(*_arguments, **_options):
        raise OSError(28, "No space left on device")

    name = "cloth_sim_ros.session.storage.AppendFile._write" if where == "session" else "os.replace"
    monkeypatch.setattr(name, full)
    with pytest.raises(FolderError, match=r"no space left in .*out.*--resume"):
        perform(study_folder, study, 0, samples[0])
    monkeypatch.undo()
    assert not list(study_folder.path.rglob(".unfinished*"))
    assert not list(study_folder.rows())
    assert perform(study_folder, study, 0, samples[0])["status"] == "ok"


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"scnee": "x"}, "there is no entry 'scnee'; did you mean 'scene'"),
        ({"scene": "nowhere.yaml"}, "scene 'nowhere.yaml' is neither"),
        (
            {"parameters": {"material.densty": 0.2}},
            "unknown parameter 'material.densty'; did you mean 'material.density'",
        ),
        ({"vary": {"material.densty": [0.2]}}, "'material.densty' at 0.2: unknown.*did you mean 'material.density'"),
        ({"vary": {"air.drag": []}}, "'air.drag' is empty"),
        ({"vary": {"air.drag": {"uniform": [1.0, 0.5]}}}, "empty range from 1.0 to 0.5"),
        ({"vary": {"air.drag": {"uniform": [-1.0, 0.5]}}}, "air.drag is -1.0"),
        ({"vary": {"air.drag": {"unifrom": [0.0, 0.5]}}}, "did you mean 'uniform'"),
        ({"vary": {"air.drag": {"log_uniform": [0.0, 0.5]}}}, "both above 0"),
        ({"vary": {"air.drag": {"normal": [0.1, 0.0]}}}, "standard deviation 0.0"),
        (
            {"vary": {"target.gripper.z": [float("nan")]}},
            "has nan, which a run's row can't hold; numbers must be finite",
        ),
        ({"vary": {"target.gripper.z": [0.1, 2**63]}}, "whole ones from"),
        ({"vary": {"target.gripper.z": [datetime.date(2026, 1, 1)]}}, "has 2026-01-01, which"),
        ({"vary": {"target.gripper.z": {"integers": [0, 2**63]}}}, "has 9223372036854775808; integers takes"),
        ({"vary": {"target.gripper.z": {"uniform": [-1.5e308, 1.5e308]}}}, "beyond a double's range"),
        ({"vary": {"target.gripper.z": {"normal": [0.0, 1e308]}}}, "beyond a double's range"),
        ({"vary": {"cloth.size[2]": [1.0]}}, "has the entries 0 to 1"),
        ({"vary": {"target.griper.z": [0.1]}}, "did you mean 'gripper'"),
        ({"vary": {"target.gripper.9.z": [0.1]}}, "positions 1 to"),
        ({"vary": {"policy.speed": [0.1]}}, "there is no policy"),
        ({"vary": {"cloth.mesh": ["nowhere.obj"]}}, "nowhere.obj"),
        ({"runs": 0}, "runs is 0"),
        ({"runs": None}, "'runs' is missing"),
        ({"sampling": "grid"}, "varies continuously"),
        ({"sampling": "sobel"}, "did you mean 'sobol'"),
        ({"duration": -1.0}, "duration is -1.0"),
        ({"clouds": "maybe"}, "true or false"),
        ({"seed": -1}, "seed is -1"),
        ({"scripts": "fold_left.yaml"}, "for the gripper 'left'"),
        ({"policy": "arm.py:Lift"}, "not both"),
        ({"scripts": None, "policy": "arm.py:Lift"}, "cannot read"),
    ],
)
def test_invalid_study_is_refused(tmp_path: Path, entries, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        study_of(tmp_path, **entries)


def test_raising_policy_is_refused_before_first_run(tmp_path: Path) -> None:
    (tmp_path / "arm.py").write_text(POLICY)
    study = study_of(tmp_path, scripts=None, vary={}, policy="arm.py:broken")
    with pytest.raises(StudyError, match=r"no run starts: policy 'arm.py:broken' raised ZeroDivisionError.*line 16"):
        sample_and_estimate(study, 2)
    (tmp_path / "worse.py").write_text("import nothing_of_that_name\n")
    with pytest.raises(StudyError, match="ModuleNotFoundError"):
        study_of(tmp_path, scripts=None, vary={}, policy="worse.py:f")
    with pytest.raises(StudyError, match="no function 'lift'; it has"):
        study_of(tmp_path, scripts=None, vary={}, policy="arm.py:lift")


def test_exit_in_user_code_fails_only_its_run(tmp_path: Path) -> None:
    (tmp_path / "arm.py").write_text(POLICY)
    (tmp_path / "gone.py").write_text("import sys\nsys.exit(5)\n")
    study = study_of(tmp_path, scripts=None, policy="arm.py:leaves", vary=None)
    with pytest.raises(StudyError, match=r"no run starts: policy 'arm.py:leaves' raised SystemExit: 3 \(arm.py"):
        sample_and_estimate(study, 1)
    with pytest.raises(StudyError, match=r"policy 'gone.py:lift' can't be imported: SystemExit: 5 \(gone.py, line 2\)"):
        study_of(tmp_path, scripts=None, policy="gone.py:lift", vary=None)
    study = study_of(tmp_path, outcomes="arm.py:ends", runs=1)
    study_folder, samples = create_study(tmp_path / "out", study)
    row = perform(study_folder, study, 0, samples[0])
    assert (row["status"], row["frames"]) == ("failed", 30)
    assert row["error"].startswith("outcome 'arm.py:ends' raised SystemExit: enough (arm.py")


def test_too_many_runs_are_refused_with_estimate(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"runs is 1000000000; at most 10000000.*B and .* hours on 2 cores"):
        sample_and_estimate(study_of(tmp_path, runs=1e9), 2)


def test_invalid_normal_value_is_reported_with_run(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"'air.drag' is -.* in run \d+"):
        sample_and_estimate(study_of(tmp_path, vary={"air.drag": {"normal": [0.0, 1.0]}}), 2)


def test_folder_of_another_study_is_refused(tmp_path: Path, capsys) -> None:
    study_folder, _ = create_study(tmp_path / "out", study_of(tmp_path))
    with pytest.raises(StudyError, match="holds another study: it differs in duration"):
        study_folder.create(study_of(tmp_path, duration=1.0), [], "")
    (tmp_path / "study.yaml").write_text(json.dumps({**BASE, "seed": 5}))
    assert main([str(tmp_path / "study.yaml"), "--out", str(study_folder.path), "--resume"]) == 2
    assert "differs in seed" in capsys.readouterr().err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("")
    assert main([str(tmp_path / "study.yaml"), "--out", str(tmp_path / "full")]) == 2
    assert "holds no study" in capsys.readouterr().err


def test_study_round_trip_is_exact(tmp_path: Path) -> None:
    study = study_of(tmp_path, vary={"cloth.size[0]": [0.8, 1.2], "material.density": {"uniform": [0.1, 0.3]}})
    study_folder, samples = create_study(tmp_path / "out", study)
    assert study_folder.read() == study
    assert study_folder.samples(study) == samples
    study_folder.check_same(study_folder.read())


@pytest.mark.parametrize("sampling", ["sobol", "latin_hypercube", "random"])
def test_samples_fill_ranges_and_follow_seed(sampling: str) -> None:
    factors = [
        read("a", {"uniform": [1.0, 2.0]}),
        read("b", {"log_uniform": [1e-6, 1e-2]}),
        read("c", {"integers": [1, 4]}),
        read("d", ["x", "y"]),
        read("e", {"normal": [5.0, 0.5]}),
        read("f", {"steps": [0.0, 1.0, 5]}),
    ]
    drawn = sample(factors, runs=256, seed=1, sampling=sampling)
    a, b, c, d, e, f = zip(*drawn, strict=True)
    assert drawn == sample(factors, runs=256, seed=1, sampling=sampling)
    assert drawn != sample(factors, runs=256, seed=2, sampling=sampling)
    # Each quarter of a range has a quarter of the runs, within five standard deviations of independent samples.
    for values in (np.array(a) - 1.0, np.log10(b) / 4.0 + 1.5):
        assert np.all(np.abs(np.histogram(values, bins=4, range=(0.0, 1.0))[0] - 64) < 35)
    assert set(c) == {1, 2, 3, 4}
    assert set(d) == {"x", "y"}
    assert abs(np.mean(e) - 5.0) < 0.16
    assert set(f) == {0.0, 0.25, 0.5, 0.75, 1.0}


def test_grid_has_each_combination_once() -> None:
    factors = [read("a", [1, 2]), read("b", {"integers": [0, 2]})]
    assert sample(factors, runs=6, seed=0, sampling="grid") == [(1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)]


def test_target_factors_move_script_positions(tmp_path: Path) -> None:
    study = study_of(tmp_path, vary={"target.gripper.x": [0.1], "target.gripper.2.z": [0.5]})
    before, after = study.scripts[0], study.moved_scripts({"target.gripper.x": 0.1, "target.gripper.2.z": 0.5})[0]
    moved = np.array([p.position for p in after.waypoints]) - np.array([p.position for p in before.waypoints])
    assert np.allclose(moved[:, 0], 0.1)
    assert np.allclose(moved[:, 2], [0.5 if k == 1 else 0.0 for k in range(len(moved))])


def test_command_runs_and_resumes_study(tmp_path: Path, capsys) -> None:
    (tmp_path / "study.yaml").write_text(json.dumps({**BASE, "runs": 6}))
    command = [str(tmp_path / "study.yaml"), "--out", str(tmp_path / "out"), "--workers", "1"]
    assert main(command) == 0
    assert "6 of 6 runs were successful" in capsys.readouterr().out
    study_folder = StudyFolder(tmp_path / "out")
    whole = index.read(study_folder).to_pydict()
    assert whole["run"] == list(range(6))
    assert "outcome.mean_height" in whole
    assert main(command) == 2
    assert "continue with --resume" in capsys.readouterr().err
    study_folder.row_file(3).unlink()
    study_folder.row_file(4).write_text('{"run": 4, "sta')
    (study_folder.path / "runs" / ".unfinished-0000003-abc").mkdir()
    assert main([*command, "--resume"]) == 0
    again = index.read(study_folder).to_pydict()
    assert again["digest"] == whole["digest"]
    assert not list(study_folder.path.rglob(".unfinished*"))
    assert main(["view", str(study_folder.path), "--outcome", "mean_height", "--rows", "2"]) == 0
    shown = capsys.readouterr().out
    assert "mean_height" in shown
    assert "4 more" in shown
    picture = tmp_path / "plot.png"
    assert (
        main(
            ["view", str(study_folder.path), "--outcome", "held", "--over", "material.density", "--plot", str(picture)]
        )
        == 0
    )
    assert picture.read_bytes()[:4] == b"\x89PNG"
    for file in (study_folder.study_file, study_folder.path / "study.yaml", study_folder.index_file):
        content = file.read_bytes()
        options = ["--outcome", "held", "--over", "material.density", "--plot", str(file)]
        assert main(["view", str(study_folder.path), *options]) == 2
        assert f"--plot is '{file}', which is read" in capsys.readouterr().err
        assert file.read_bytes() == content
    assert main(["view", str(study_folder.path), "--outcome", "mean_heigth"]) == 2
    assert "did you mean 'mean_height'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--wait", "nan", "argument --wait: nan s is no waiting time; give 0 or more"),
        ("--wait", "-1", "-1.0 s is no waiting time"),
        ("--wait", "inf", "inf s is no waiting time"),
        ("--wait", "soon", "'soon' is no number of seconds"),
        ("--workers", "0", "0 is below 1"),
        ("--workers", "two", "argument --workers: 'two' is no whole number"),
    ],
)
def test_invalid_option_is_refused(tmp_path: Path, capsys, option: str, value: str, words: str) -> None:
    with pytest.raises(SystemExit) as left:
        main([str(tmp_path / "study.yaml"), "--out", str(tmp_path / "out"), option, value])
    assert left.value.code == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_second_client_is_refused(tmp_path: Path) -> None:
    study_folder, _ = create_study(tmp_path / "out", study_of(tmp_path))
    with (
        study_folder.lock(),
        pytest.raises(StudyError, match="another cloth_batch"),
        StudyFolder(study_folder.path).lock(),
    ):
        pass


def test_session_metadata_names_run(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    study_folder, samples = create_study(tmp_path / "out", study)
    row = perform(study_folder, study, 0, samples[0])
    with SessionReader([study_folder.path / row["session"]]) as reader:
        assert reader.missing is None
        assert reader.metadata["session"] == "run_0000000"


OUTCOMES = """\
def moved(run):
    positions = run.positions
    positions -= run.initial
    run.values["air.drag"] = 9.0
    return float(abs(positions).max())

def mean_of(run):
    return {"mean": run.positions[:, 2].mean(), "drag": run.values["air.drag"], "first": run.initial[0, 2]}

def same(run):
    return {"moved": 1.0}

def huge(run):
    return 10**400
"""


def outcome_study(folder: Path, *names: str):
    (folder / "outcomes.py").write_text(OUTCOMES)
    outcomes = [f"outcomes.py:{name}" for name in names]
    return study_of(folder, outcomes=outcomes, runs=1, duration=0.1, vary={"air.drag": [0.2]})


def performed_row(folder: Path, study) -> dict:
    study_folder, samples = create_study(folder, study)
    return perform(study_folder, study, 0, samples[0])


def test_outcome_functions_share_no_arrays(tmp_path: Path) -> None:
    alone = performed_row(tmp_path / "alone", outcome_study(tmp_path, "mean_of"))["outcomes"]
    after = performed_row(tmp_path / "after", outcome_study(tmp_path, "moved", "mean_of"))["outcomes"]
    assert after.pop("moved") > 0.0
    assert after == alone


@pytest.mark.parametrize(
    ("names", "words"), [(("moved", "same"), "gives 'moved', which another"), (("huge",), "it must be a finite number")]
)
def test_bad_outcome_fails_its_run(tmp_path: Path, names: tuple[str, ...], words: str) -> None:
    row = performed_row(tmp_path / "out", outcome_study(tmp_path, *names))
    assert row["status"] == "failed"
    assert words in row["error"]


def test_policy_may_return_numpy_parameters(tmp_path: Path) -> None:
    (tmp_path / "drag.py").write_text(
        "import numpy as np\nfrom cloth_sim_ros import SetParameters\n\ndef policy(seen):\n"
        "    return SetParameters({'air.drag': np.float32(0.3), 'wind.velocity': [np.float32(0.1), 0.0, 0.0]})\n"
    )
    study = study_of(tmp_path, scripts=None, policy="drag.py:policy", runs=1, duration=0.1, vary={})
    row = performed_row(tmp_path / "out", study)
    assert row["status"] == "ok", row["error"]
    assert verify([tmp_path / "out" / row["session"]]).same


def test_default_duration_includes_last_grasp(tmp_path: Path) -> None:
    steps = [{"time": 0.0, "position": [0.5, 0.0, 1.0]}, {"time": 0.205, "close": True}]
    (tmp_path / "late.yaml").write_text(json.dumps({"steps": steps}))
    study = study_of(tmp_path, scripts="late.yaml", duration=None, runs=1, vary={})
    row = performed_row(tmp_path / "out", study)
    assert row["frames"] == 14
    assert row["outcomes"]["held"] > 0.0


def test_empty_policy_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "empty.py").write_text("")
    with pytest.raises(StudyError, match=r"'empty\.py' has no function 'policy'; it has none"):
        study_of(tmp_path, scripts=None, policy="empty.py:policy")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["view", "--run", "0", "--outcome", "held"], "--run opens one run: it takes no --outcome"),
        (["view", "--run", "0", "--rows", "3"], "it takes no --rows"),
        (["view", "--plot", "a.png", "--outcome", "held", "--over", "run", "--rows", "3"], "it takes no --rows"),
        (["export", "--zarr", "out.zarr", "--task", "lift"], "--task describes a LeRobot dataset"),
    ],
)
def test_option_without_effect_is_refused(tmp_path: Path, capsys, arguments: list[str], words: str) -> None:
    assert main([arguments[0], str(tmp_path), *arguments[1:]]) == 2
    assert words in capsys.readouterr().err
