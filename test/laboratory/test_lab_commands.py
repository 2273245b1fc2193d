# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands `cloth_drape` and `cloth_lab`: output, files and errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cloth_sim_ros.laboratory import drape_main, lab_main
from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
from cloth_sim_ros.laboratory.samples import read_sample
from cloth_sim_ros.scene.parameters.declare import ParameterError

QUICK = ["--edge-length", "0.013", "--specimens", "1"]
SCENE = "/**:\n  ros__parameters:\n    material:\n      fabric: denim\n      density: 0.3\n"
FABRIC = "title: mine\nparameters:\n  material.bending_modulus: 1.0e-5\n  bending.model: crossed\n"


def test_drape_prints_and_writes_all_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    outputs = {"--json": tmp_path / "out.json", "--picture": tmp_path / "out.png"}
    options = [str(word) for pair in outputs.items() for word in pair]
    assert drape_main.main(["denim", *QUICK, *options]) == 0
    text = capsys.readouterr().out
    assert "real fabric        70 to 90 %" in text
    content = json.loads(outputs["--json"].read_text())
    assert content["stated"] == [0.7, 0.9]
    assert f"drape coefficient  {100 * content['coefficient']:.1f} %" in text
    assert len(content["specimens"][0]["contour"]) == 720
    assert outputs["--picture"].read_bytes().startswith(b"\x89PNG")


def test_lab_prints_and_writes_a_test(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "out.json"
    assert lab_main.main(["tension", "denim", "--cells", "3", "--json", str(output)]) == 0
    assert "tensile modulus" in capsys.readouterr().out
    (first, *_) = json.loads(output.read_text())["tests"]["tension"]
    assert first["stated"] == pytest.approx(205.249)
    assert first["ratio"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["felt"], "the fabrics are polyester_twill"),
        (["nowhere.yaml"], "nowhere.yaml"),
        (["denim", "--set", "material.stretch_modulus=-1.0"], "stretch_modulus"),
        (["denim", "--set", "gravity"], "NAME=VALUE"),
        (["denim", "--set", "air.drag=1.0"], "no parameter of a fabric"),
        (["denim", "--set", "bending.model=none"], "bending.model is none, so material.bending_modulus"),
        (["denim", "--plate", "0.4"], "plate"),
        (["denim", "--edge-length", "0.1"], "at most 0.0247 m for an overhang of 0.06 m over a plate of 0.18 m"),
        (["denim", "--diameter", "inf"], "that of the specimen, inf m"),
        (["denim", "--set", "material.density=0.2", "--set", "material.density=0.3"], "twice; give it once"),
        (["denim", *QUICK, "--set", "material.density=1.0e-9"], "Lower the fabric's moduli, raise its density"),
        (["denim", "--seed", "-1"], "--seed"),
        (["denim", "--json", "/nowhere/out.json"], "--json"),
    ],
)
def test_bad_input_is_refused(arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert drape_main.main(arguments) == 2
    assert reason in capsys.readouterr().err


def test_mesh_of_a_scene_is_no_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh, scene = tmp_path / "towel.obj", tmp_path / "scene.yaml"
    mesh.write_text("v 0 0 0")
    scene.write_text("/**: {ros__parameters: {cloth: {mesh: towel.obj}}}")
    assert drape_main.main([str(scene), "--json", str(mesh)]) == 2
    assert f"--json is '{mesh}', which is read" in capsys.readouterr().err
    assert mesh.read_text() == "v 0 0 0"


def test_lab_refuses_too_few_cells(capsys: pytest.CaptureFixture[str]) -> None:
    assert lab_main.main(["tension", "denim", "--cells", "1"]) == 2
    assert "--cells" in capsys.readouterr().err


def test_full_device_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no device that is always full")
    assert lab_main.main(["tension", "denim", "--cells", "3", "--json", "/dev/full"]) == 2
    output = capsys.readouterr()
    assert "tensile modulus" in output.out
    assert "cannot write '/dev/full'" in output.err


def test_sample_is_read_from_scene_and_fabric_files(tmp_path: Path) -> None:
    scene, fabric = tmp_path / "scene.yaml", tmp_path / "mine.yaml"
    scene.write_text(SCENE)
    fabric.write_text(FABRIC)
    of_scene, of_file = read_sample(str(scene)), read_sample(str(fabric))
    assert of_scene.density == 0.3
    assert of_scene.warp_and_weft("material.bending_modulus") == pytest.approx((6.4196e-05, 9.6952e-05))
    assert of_scene.fabric.drape_coefficient == (0.7, 0.9)
    assert of_file.title == "mine"
    assert of_file.warp_and_weft("material.bending_modulus") == (1e-5, 1e-5)
    (tmp_path / "bad.yaml").write_text("a: [")
    with pytest.raises(ParameterError, match="YAML"):
        read_sample(str(tmp_path / "bad.yaml"))


def test_override_replaces_a_value_of_the_fabric() -> None:
    assert read_sample("denim", {"material.density": 0.5}).density == 0.5
    with pytest.raises(LaboratoryError, match=r"cloth\.size"):
        read_sample("denim", {"cloth.size": [1.0, 1.0]})
