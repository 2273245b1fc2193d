# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fits of cloths with known parameters; `soak_fit.py` has larger ones."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from pathlib import Path

import attrs
import numpy as np
import pytest

pytest.importorskip("mcap")

from support.fit_samples import START, cloth, random_truth, record_swing, write_bag
from support.session_maker import cloud_bytes

from cloth_sim_ros.fit import main as fit_main
from cloth_sim_ros.fit.bag import read_bag
from cloth_sim_ros.fit.files import write_json
from cloth_sim_ros.fit.fit import Fit, fit
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recording import read_session
from cloth_sim_ros.fit.text import describe
from cloth_sim_ros.scene.distribution import Distribution
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.cdr import decode_cloud

TRUTH = random_truth(3)
NAMES = list(TRUTH)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Session of 6 x 6 particles swung for 0.5 s, with 2 mm of noise and a third of the particles missing."""
    return record_swing(tmp_path_factory.mktemp("noisy"), TRUTH, seed=1, seconds=0.5, resolution=6)


@pytest.fixture(scope="module")
def fitted(noisy: Path) -> Fit:
    return fit(read_session([noisy]), NAMES, start=START, workers=1)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp("bag") / "real.mcap", TRUTH, noise=0.0005, off=(0.003, -0.004, 0.002))


def scene_of(**values: float) -> Scene:
    return cloth({**START, "rate": 60.0, **values}, resolution=6)


def test_json_is_a_distribution_for_an_ensemble(fitted: Fit, tmp_path: Path) -> None:
    bounds = [estimate.bound for estimate in fitted.estimates]
    assert np.sqrt(np.diag(fitted.covariance)) == pytest.approx(bounds, rel=1e-6)
    write_json(fitted, tmp_path / "fit.json")
    distribution = Distribution.from_file(tmp_path / "fit.json")
    assert distribution.names == tuple(NAMES)
    assert distribution.values == tuple(fitted.values.values())
    assert np.array(distribution.covariance) == pytest.approx(fitted.covariance, rel=1e-6)
    distribution.check_members(fitted.recording.scene)


def test_noisy_swing_estimates_lie_within_bounds(fitted: Fit) -> None:
    for estimate in fitted.estimates:
        true = TRUTH[estimate.parameter.name]
        # A correct program exceeds four standard deviations once in 4,000 parameters on average; the seed is fixed.
        assert abs(np.log(estimate.value / true)) < 4.0 * estimate.bound
        assert not estimate.is_identified or abs(estimate.value / true - 1.0) < 0.05
        assert estimate.is_identified == (estimate.bound <= 0.025)
    # 15 clouds of 24 particles: 1080 coordinates give their deviation to 2 %; about four times that is allowed.
    assert fitted.sigma == pytest.approx(0.002, rel=0.1)
    assert fitted.missing_fraction == pytest.approx(1 / 3, abs=0.1)
    assert fitted.correlation < 0.15
    assert (fitted.n_clouds, fitted.reason) == (15, "")


def test_bounds_scale_with_noise(noisy: Path, fitted: Fit) -> None:
    refitted = fit(read_session([noisy]), NAMES, start=fitted.values, sigma=0.004, workers=1)
    for estimate, refitted_estimate in zip(fitted.estimates, refitted.estimates, strict=True):
        # Twice the noise gives twice the bound, except for other points and steps of the derivatives.
        assert refitted_estimate.bound == pytest.approx(2.0 * estimate.bound * 0.002 / fitted.sigma, rel=0.05)
    assert refitted.is_sigma_prescribed


def test_noiseless_fit_finds_true_values(tmp_path: Path) -> None:
    path = record_swing(tmp_path, TRUTH, seconds=0.5, resolution=6, noise=0.0, missing=0.0)
    result = fit(read_session([path]), ["shear", "damping"], start={"shear": 60.0, "damping": 0.08}, workers=1)
    for name, value in result.values.items():
        # Clouds are float32, and the simulations have a tolerance of 1e-5 m or less.
        assert value == pytest.approx(TRUTH[name], rel=1e-3)
    assert result.rms < 1e-6
    assert result.all_identified


def test_noiseless_fit_finds_friction_of_bending(tmp_path: Path) -> None:
    truth = {**TRUTH, "bending.friction_moment": 2e-3, "bending.yield_curvature": 2.0}
    path = record_swing(tmp_path, truth, seconds=0.5, resolution=6, noise=0.0, missing=0.0)
    start = {"bending": 3e-4, "bending_friction": 1e-3}
    result = fit(read_session([path]), list(start), start=start, workers=1)
    for name, value in result.values.items():
        assert value == pytest.approx(truth[name], rel=2e-3)
    assert result.all_identified


def test_worker_count_changes_no_bit(noisy: Path) -> None:
    short = read_session([noisy]).part(until=0.25)
    serial, parallel = (fit(short, ["bending"], start={"bending": 3e-4}, workers=workers) for workers in (1, 2))
    assert parallel.values == serial.values
    assert parallel.estimates[0].bound == serial.estimates[0].bound


def test_unpredictable_clouds_are_not_used(tmp_path: Path) -> None:
    # The swing is eight times stronger, so that the sheet collapses between the hands.
    path = record_swing(tmp_path, TRUTH, seed=2, seconds=0.8, resolution=6, strength=8.0)
    result = fit(read_session([path]), ["bending"], start={"bending": 3e-4}, workers=1)
    assert "clouds" in result.reason
    assert 0.2 <= result.end_time < 0.8
    for estimate in result.estimates:
        assert abs(np.log(estimate.value / TRUTH[estimate.parameter.name])) < 4.0 * estimate.bound + 0.01


def test_misfit_identifies_no_parameter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def see(topic: str, data: bytes, at: int) -> bytes:
        """Displace the camera by 14 mm within 5 clouds, from the 8th cloud on."""
        if not topic.endswith("/points") or at < 7:
            return data
        xyz = np.array(decode_cloud(data).xyz, dtype=np.float64) + np.array([0.01, 0.0, 0.01]) * min(1.0, (at - 6) / 5)
        return cloud_bytes(xyz, 0, (6, 6))

    # Without air drag the motion depends most on the parameters.
    truth = {**TRUTH, "wind.normal_drag": 0.0}
    path = record_swing(tmp_path, truth, seed=2, seconds=0.7, resolution=6, strength=4.0, distort=see)
    out = {name: tmp_path / f"fit.{name}" for name in ("json", "yaml")}
    options = ["--parameters", "bending", "--start", "bending=3e-4", "--workers", "1"]
    status = fit_main.main([str(path), *options, "--json", str(out["json"]), "--write", str(out["yaml"])])
    output, written = capsys.readouterr().out, json.loads(out["json"].read_text())
    (entry,) = written["parameters"]
    # The bound alone would identify the parameter.
    assert entry["bound"] < 0.025
    assert not entry["identified"]
    assert not written["all_identified"]
    assert old_keys.add_old_keys(written, old_keys.FIT) == written
    assert status == fit_main.NOT_IDENTIFIED
    assert "NOT IDENTIFIED: the fit is in doubt" in output
    assert "follows only a part of the recording" in written["doubt"]
    assert "No parameter is identified: " in output
    assert parameter_file.read(out["yaml"])["material.bending_modulus"] == TRUTH["material.bending_modulus"]


def test_residuals_above_sigma_identify_no_parameter(noisy: Path) -> None:
    result = fit(read_session([noisy]), ["bending"], start={"bending": 3e-4}, sigma=0.0005, workers=1)
    (estimate,) = result.estimates
    assert estimate.bound < 0.025
    assert not estimate.is_identified
    assert "times the deviation that --sigma gives" in describe(result)


def test_real_recording_fits_parameters_and_offset(bag: Path) -> None:
    # The frames are longer than those of the true motion, so that most clouds lie between two frames' ends.
    recording = read_bag([bag], scene_of(**{**TRUTH, "rate": 45.0}), settle_time=2.0)
    assert recording.n_settle_frames == 90
    assert recording.frames[:3] == pytest.approx([90.0, 91.5, 93.0])
    result = fit(recording, ["bending", "stretch"], start={"bending": 3e-4, "stretch": 500.0}, workers=1)
    # The initial state was not recorded; the simulated cloth settles to it.
    assert result.shift == pytest.approx((0.003, -0.004, 0.002), abs=3e-4)
    for estimate in result.estimates:
        assert abs(np.log(estimate.value / TRUTH[estimate.parameter.name])) < 4.0 * estimate.bound
    assert "The clouds have a common offset of (" in describe(result)


def test_index_field_assigns_points_to_particles(tmp_path: Path) -> None:
    from cloth_sim_ros.session.cdr import decode, encode, message_class

    kind = "sensor_msgs/msg/PointCloud2"
    order = np.random.default_rng(0).permutation(36)[:20]

    def numbered(x: np.ndarray, stamp: int) -> bytes:
        message = decode(cloud_bytes(x[order], stamp, (1, 20)), kind)
        field = message_class("sensor_msgs/msg/PointField")(name="index", offset=12, datatype=6, count=1)
        table = np.concatenate(
            [message.data.reshape(20, 12), order.astype("<u4").view(np.uint8).reshape(20, 4)], axis=1
        )
        message.fields.append(field)
        message.point_step, message.row_step, message.data = 16, 320, np.ascontiguousarray(table).ravel()
        return encode(message, kind)

    path = write_bag(tmp_path / "numbered.mcap", TRUTH, seconds=0.1, see=numbered)
    (cloud, *_) = read_bag([path], scene_of()).clouds
    whole = read_bag([write_bag(tmp_path / "whole.mcap", TRUTH, seconds=0.1)], scene_of()).clouds[0]
    assert np.array_equal(cloud[order], whole[order])
    assert np.isnan(np.delete(cloud, order, axis=0)).all()
    small = cloth({**START, "rate": 60.0}, resolution=5)
    with pytest.raises(FitError, match=r"names particle .*there are 25"):
        read_bag([path], small)


def test_bare_points_fit_by_surface_distance(noisy: Path) -> None:
    bare = read_session([noisy], matched=False).part(until=0.4)
    result = fit(bare, ["bending"], start={"bending": 2e-4}, workers=1)
    (estimate,) = result.estimates
    assert abs(np.log(estimate.value / TRUTH["material.bending_modulus"])) < 4.0 * estimate.bound
    assert result.missing_fraction is None


def test_command_writes_json_parameters_and_plot(
    noisy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = {name: tmp_path / f"fit.{name}" for name in ("json", "yaml", "png")}
    status = fit_main.main(
        [
            *(
                str(noisy),
                "--parameters",
                "bending, shear",
                "--start",
                "shear=20",
                "--workers",
                "1",
                "--within",
                "0.04",
            ),
            *("--json", str(out["json"]), "--write", str(out["yaml"]), "--plot", str(out["png"])),
        ]
    )
    report = json.loads(out["json"].read_text())
    assert status == (fit_main.IDENTIFIED if report["all_identified"] else fit_main.NOT_IDENTIFIED)
    assert "material.bending_modulus" in capsys.readouterr().out
    written = parameter_file.read(out["yaml"])
    for entry in report["parameters"]:
        if entry["identified"]:
            assert written[entry["name"]] == pytest.approx(entry["value"], rel=1e-5)
    assert out["png"].read_bytes().startswith(b"\x89PNG")


def test_unidentified_parameter_keeps_scene_value(noisy: Path, tmp_path: Path) -> None:
    out = tmp_path / "fit.yaml"
    options = ["--parameters", "damping", "--start", "damping=0.2", "--workers", "1", "--within", "1e-5"]
    assert fit_main.main([str(noisy), *options, "--write", str(out)]) == fit_main.NOT_IDENTIFIED
    assert parameter_file.read(out)["material.damping"] == TRUTH["material.damping"]
    assert "not identified" in out.read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--parameters", "strech"], "did you mean 'stretch'"),
        (["--parameters", "stretch,material.stretch_modulus"], "given twice"),
        (["--parameters", ","], "no parameter is given"),
        (["--parameters", "friction"], "contact.self is false"),
        (["--parameters", "bending.stiffness"], "only axial and opposite bending use it"),
        (["--parameters", "viscosity"], "begins at 0"),
        (["--parameters", "rate"], "no parameter of the sheet"),
        (["--parameters", "stretch", "--start", "shear=3"], "not among the parameters"),
        (["--parameters", "stretch", "--start", "stretch=soft"], "must be a number"),
        (["--parameters", "stretch", "--start", "stretch"], "write NAME=VALUE"),
        (["--parameters", "stretch", "--start", "stretch=nan"], "begins at nan"),
        (["--parameters", "stretch", "--until", "0.01"], "holds no cloud"),
        (["--parameters", "stretch", "--until", "0.04"], "a fit needs 3"),
        (["--parameters", "stretch", "--until", "0"], "above 0"),
        (["--parameters", "stretch", "--every", "0"], "give 1 or more"),
        (["--parameters", "stretch", "--sigma", "0"], "must be above 0"),
        (["--parameters", "stretch", "--within", "2"], "between 0 and 1"),
        (["--parameters", "stretch", "--workers", "0"], "at least 1"),
        (["--parameters", "stretch", "--settle", "1"], "--settle is for a recording of a real cloth"),
        (["--parameters", "stretch", "--json", "/nowhere/out.json"], "there is no folder"),
    ],
)
def test_bad_input_is_refused(noisy: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert fit_main.main([str(noisy), *options]) == fit_main.REFUSED
    assert words in capsys.readouterr().err


def test_mismatched_recording_is_refused(tmp_path: Path, noisy: Path, bag: Path) -> None:
    blind = record_swing(tmp_path, TRUTH, seconds=0.2, resolution=6, missing=1.0)
    with pytest.raises(FitError, match="0 of 6 clouds hold a point"):
        fit(read_session([blind]), ["stretch"])
    with pytest.raises(FitError, match="a rate of 60 Hz"):
        read_session([noisy], scene=scene_of())
    with pytest.raises(FitError, match="36 points, the scene's cloth 25"):
        fit(read_bag([bag], cloth({**START, "rate": 60.0}, resolution=5)), ["stretch"])
    with pytest.raises(FitError, match="in frame 'world', the scene in 'map'"):
        read_bag([bag], cloth({**START, "frame_id": "map"}, resolution=6))
    with pytest.raises(FitError, match="--pose names 'middle'"):
        read_bag([bag], scene_of(), poses={"middle": "/robot/left/pose"})
    with pytest.raises(FitError, match="there is no topic '/lost'"):
        read_bag([bag], scene_of(), topic="/lost")
    renamed_bag = write_bag(tmp_path / "other.mcap", TRUTH, seconds=0.1, poses=("/arm/a", "/arm/b"))
    with pytest.raises(FitError, match=r"ends in /left/target or /left/pose; .*--pose left=TOPIC; available: /arm/a"):
        read_bag([renamed_bag], scene_of())
    named = {"left": "/arm/a", "right": "/arm/b"}
    assert len(read_bag([renamed_bag], scene_of(), poses=named).clouds) == 4
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[:200])
    with pytest.raises(FitError, match="can't be read as MCAP"):
        read_bag([cut], scene_of())
    assert fit_main.main([str(bag), "--parameters", "stretch"]) == fit_main.REFUSED
    assert fit_main.main([str(tmp_path / "lost.mcap"), "--parameters", "stretch"]) == fit_main.REFUSED


def test_damaged_session_is_reported(
    noisy: Path, fitted: Fit, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, hurt = noisy.read_bytes(), tmp_path / "hurt.mcap"
    assert read_session([noisy]).unreadable == ""
    assert "unreadable" not in describe(fitted)
    from mcap.reader import make_reader

    chunk = next(iter(make_reader(io.BytesIO(whole)).get_summary().chunk_indexes))
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    hurt.write_bytes(whole[:middle])
    assert fit_main.main([str(hurt), "--parameters", "stretch"]) == fit_main.REFUSED
    assert "nothing to fit (hurt.mcap: the recording was cut off" in capsys.readouterr().err
    hurt.write_bytes(whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :])
    assert fit_main.main([str(hurt), "--parameters", "stretch"]) == fit_main.REFUSED
    # It depends on the byte which check finds it.
    assert re.search("fails its checksum|does not decompress|no readable head", capsys.readouterr().err)
    hurt.write_bytes(whole[:-20])
    recording = read_session([hurt])
    assert len(recording.clouds) == len(fitted.recording.clouds)
    description = describe(attrs.evolve(fitted, recording=recording))
    assert f"A part of the recording is unreadable: {recording.unreadable}." in description
    assert recording.unreadable.startswith("hurt.mcap: ")


def test_unguarded_program_can_fit_in_processes(noisy: Path, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "from pathlib import Path\n"
        "from cloth_sim_ros.fit.fit import fit\n"
        "from cloth_sim_ros.fit.recording import read_session\n"
        f"found = fit(read_session([Path({str(noisy)!r})]), ['stretch'], workers=2)\n"
        "print('fitted', found.estimates[0].value)\n"
    )
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, check=False)
    assert done.stdout.count("fitted") == 1, done.stderr
