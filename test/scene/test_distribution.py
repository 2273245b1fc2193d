# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Distributions of uncertain parameters: files, members, and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros.scene.distribution import Distribution, DistributionError
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

COVARIANCE = [[0.01, 0.012, 0.0], [0.012, 0.04, -0.01], [0.0, -0.01, 0.09]]
NAMES = ["material.stretch_modulus", "air.drag", "material.density"]
CORRELATED = {"parameters": [{"name": name} for name in NAMES], "covariance": COVARIANCE}


def read(content: Any) -> Distribution:
    text = content if isinstance(content, str) else json.dumps(content)
    return Distribution.from_bytes(text.encode(), "file.json")


def drag(**entry: Any) -> dict[str, Any]:
    return {"parameters": [{"name": "air.drag", **entry}]}


def test_sigma_points_have_mean_and_covariance() -> None:
    logarithms = np.log(read(CORRELATED).factors())
    assert logarithms.shape == (6, 3)
    assert np.abs(logarithms.mean(axis=0)).max() < 1e-15
    assert logarithms.T @ logarithms / 6 == pytest.approx(np.array(COVARIANCE), abs=1e-15)


def test_sample_has_mean_and_covariance() -> None:
    logarithms = np.log(read(CORRELATED).factors(4000, 3))
    assert np.abs(logarithms.mean(axis=0)).max() < 4.0 * 0.3 / 4000**0.5
    assert np.cov(logarithms.T) == pytest.approx(np.array(COVARIANCE), abs=0.008)


def test_factors_have_the_same_bits_on_every_machine() -> None:
    distribution = read(CORRELATED)
    assert [factor.hex() for factor in distribution.factors()[1]] == [
        "0x1.ae92fb50d1a77p-1",
        "0x1.9fe9fc730edd6p-1",
        "0x1.0000000000000p+0",
    ]
    assert [factor.hex() for factor in distribution.factors(3, 7)[2]] == [
        "0x1.eae7d256d90c9p-1",
        "0x1.f254afc4c39d5p-1",
        "0x1.7db3b616e9ad2p+0",
    ]
    assert distribution.factors(3, 7)[:2] == distribution.factors(2, 7)
    assert distribution.factors(2, 8) != distribution.factors(2, 7)


def test_file_of_cloth_fit_is_read(tmp_path: Path) -> None:
    content = {
        "name": "towel",
        "later_field": 1,
        "doubt": "too few motions",
        "parameters": [
            {"name": "air.drag", "value": 0.3, "bound": 0.2, "identified": True, "unit": "1/s"},
            {"name": "material.damping", "value": 0.1, "bound": None, "identified": False},
            {"name": "material.density", "value": 0.2, "bound": 0.06, "identified": False},
        ],
        "covariance": [[0.04, 0.0, 0.0012], [0.0, 0.0, 0.0], [0.0012, 0.0, 0.0009]],
    }
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(content))
    distribution = Distribution.from_file(path)
    assert distribution.names == ("air.drag", "material.density")
    assert distribution.values == (0.3, 0.2)
    # The bound of the density is twice its deviation in the covariance; the correlation of 0.2 stays.
    assert np.array(distribution.covariance) == pytest.approx(np.array([[0.04, 0.0024], [0.0024, 0.0036]]))
    assert distribution.notes == (
        "the fit did not determine material.damping: it does not vary",
        "the fit doubts its deviations: too few motions",
    )


def test_file_without_covariance_says_so() -> None:
    entries = [{"name": name, "value": 1.0, "bound": 0.1, "identified": True} for name in NAMES[:2]]
    distribution = read({"parameters": entries})
    assert np.array(distribution.covariance) == pytest.approx(np.diag([0.01, 0.01]))
    assert distribution.notes == ("the file has no covariance: the parameters vary independently",)


def test_yaml_by_hand_is_read() -> None:
    distribution = read("parameters:\n- {name: air.drag, deviation: 2e-1}\n")
    assert np.log(distribution.factors()) == pytest.approx(np.array([[0.2], [-0.2]]))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("{", "neither JSON of cloth_fit nor YAML"),
        ("[1, 2]", "no list 'parameters'"),
        ({"parameters": []}, "no list 'parameters'"),
        ({"parameters": [{"deviation": 0.1}]}, "has no name"),
        (drag(), "the deviation of air.drag is None"),
        (drag(deviation=-0.1), "above 0"),
        (drag(deviation=3.0), "at most 2"),
        (drag(deviation=True), "the deviation of air.drag is True"),
        (drag(deviation=0.1, value="much"), "the value of air.drag is 'much'"),
        (drag(bound=None), "the fit determined no parameter"),
        (drag(bound=5.0), "the fit determined no parameter"),
        ({"parameters": [{"name": "air.drag", "deviation": 0.1}] * 2}, "given twice"),
        ({"parameters": [{"name": f"p{k}", "deviation": 0.1} for k in range(33)]}, "at most 32"),
        ({**CORRELATED, "covariance": [[1.0]]}, "3 rows of 3 numbers"),
        ({**CORRELATED, "covariance": [[0.01, None, 0.0], *COVARIANCE[1:]]}, "no finite number"),
        ({**CORRELATED, "covariance": [[0.01, 0.0, 0.0], *COVARIANCE[1:]]}, "not symmetric"),
        ({**drag(), "covariance": [[-1.0]]}, "on its diagonal"),
        ({"parameters": [{"name": "a"}, {"name": "b"}], "covariance": [[1, 2], [2, 1]]}, "not positive definite"),
    ],
)
def test_invalid_content_is_refused(content: Any, reason: str) -> None:
    with pytest.raises(DistributionError, match=reason) as caught:
        read(content)
    assert str(caught.value).startswith("file.json: ")


def test_unreadable_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DistributionError, match="cannot read the distribution"):
        Distribution.from_file(tmp_path / "none.json")
    path = tmp_path / "binary.json"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DistributionError, match="neither JSON of cloth_fit nor YAML"):
        Distribution.from_file(path)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("air.drga", "unknown parameter 'air.drga'; did you mean 'air.drag'?"),
        ("cloth.size", "'cloth.size' cannot vary"),
        ("points.velocity", "'points.velocity' cannot vary"),
        ("contact.friction", "'contact.friction' is 0 in the scene"),
    ],
)
def test_parameter_that_cannot_vary_is_refused(tmp_path: Path, name: str, reason: str) -> None:
    path = tmp_path / "distribution.yaml"
    path.write_text(f"parameters: [{{name: {name}, deviation: 0.1}}]")
    with pytest.raises(ParameterError) as caught:
        Scene.from_parameters({"ensemble.file": str(path)})
    assert reason in str(caught.value)
    assert str(caught.value).startswith(f"ensemble.file '{path}': ")


def test_scene_holds_the_file_of_its_distribution(tmp_path: Path) -> None:
    (tmp_path / "distribution.yaml").write_text("parameters: [{name: air.drag, deviation: 0.1}]")
    scene = Scene.from_parameters({"ensemble.file": "distribution.yaml"}, folder=tmp_path)
    assert scene.distribution().names == ("air.drag",)
    assert set(scene.files) == {"distribution.yaml"}
    assert scene.changed({"air.drag": 0.5}).distribution() == scene.distribution()
    with pytest.raises(ParameterError, match="can't change while the cloth runs"):
        scene.changed({"ensemble.file": ""})
    with pytest.raises(ParameterError, match=r"ensemble\.file is empty"):
        Scene().distribution()
    with pytest.raises(ParameterError, match=r"ensemble\.members is 1"):
        Scene.from_parameters({"ensemble.members": 1})


def test_member_out_of_range_is_refused() -> None:
    distribution = read("parameters: [{name: contact.thickness, deviation: 1.5}]")
    scene = Scene.from_parameters({"contact.thickness": 0.5})
    with pytest.raises(DistributionError, match=r"member 0 of the ensemble \(contact\.thickness = 2\.24.*smaller"):
        distribution.check_members(scene)


def test_members_scale_numbers_and_arrays() -> None:
    distribution = read(
        {"parameters": [{"name": "wind.velocity", "deviation": 0.1}, {"name": "air.drag", "deviation": 0.1}]}
    )
    scene = Scene.from_parameters({"wind.velocity": [2.0, -1.0, 0.0]})
    assert distribution.member_values(scene, (2.0, 0.5)) == {"wind.velocity": (4.0, -2.0, 0.0), "air.drag": 0.1}
    values = {"gravity": [0.0, 0.0, -1.0], "air.drag": 3.0}
    assert distribution.scaled(values, (2.0, 0.5)) == {"gravity": [0.0, 0.0, -1.0], "air.drag": 1.5}


def test_distant_values_of_the_file_are_told() -> None:
    scene = Scene()
    assert read(drag(value=0.2, deviation=0.1)).differences(scene) == []
    assert read(drag(value=0.21, deviation=0.1)).differences(scene) == []
    assert read(drag(deviation=0.1)).differences(scene) == []
    (sentence,) = read(drag(value=0.3, deviation=0.1)).differences(scene)
    assert sentence.startswith("air.drag is 0.2 in the scene and 0.3 in the file")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"covariance": ((0.01, 0.009), (0.0, 0.01))}, "covariance is not symmetric: 0 and 0.009"),
        ({"covariance": ((0.01,),)}, "covariance must have 2 rows of 2 numbers"),
        ({"covariance": ((0.01, 0.0), (0.0, float("nan")))}, "covariance has an entry of a used parameter that is no"),
        ({"covariance": ((0.01, 0.02), (0.02, 0.01))}, "covariance is not positive definite"),
        ({"names": ("air.drag", "air.drag")}, "parameter 'air.drag' is given twice"),
        ({"values": (None,)}, "there are 2 names and 1 values; give one for each"),
        ({"values": (None, float("nan"))}, "the value of material.density is nan; it must be a number"),
    ],
)
def test_constructor_refuses_what_a_file_may_not_hold(change: dict[str, Any], reason: str) -> None:
    fields: dict[str, Any] = {"names": ("air.drag", "material.density"), "values": (None, 0.2)}
    fields["covariance"] = ((0.01, 0.0), (0.0, 0.01))
    Distribution(**fields)
    with pytest.raises(DistributionError, match=reason):
        Distribution(**{**fields, **change})


def test_largest_deviation_beside_a_covariance_is_read() -> None:
    for k in range(100):
        content = {"parameters": [{"name": "air.drag", "deviation": 2.0}], "covariance": [[0.013 + 0.0371 * k]]}
        assert read(content).covariance[0][0] == pytest.approx(4.0)


def test_numbers_of_numpy_become_plain() -> None:
    arrays = {"values": np.array([0.5], dtype=np.float32), "covariance": np.array([[0.25]], dtype=np.float32)}
    distribution = Distribution(names=("air.drag",), **arrays)
    assert (distribution.values, distribution.covariance) == ((0.5,), ((0.25,),))


def test_extreme_members_show_values_out_of_range() -> None:
    distribution = read("parameters: [{name: air.drag, deviation: 0.5}]")
    scene = Scene.from_parameters({"air.drag": 9000.0})
    for alone in (False, True):
        with pytest.raises(DistributionError, match=r"member \d+ of the ensemble \(air\.drag = .*smaller"):
            distribution.check_members(scene, 200, 1, extremes_alone=alone)
        distribution.check_members(Scene(), 200, 1, extremes_alone=alone)
