# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Joints (S4) between particles of one cloth and between pieces of a mesh."""

import numpy as np
import pytest
from support.raw_nets import net_tables, springs_scene, two_nets

from cloth_sim_ros.ros.check import check
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.parameter_file import dump
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

GRID = {"cloth.resolution": [6, 7], "cloth.anchors": [""], "wind.normal_drag": 0.0, "air.drag": 0.0}
#: Two squares of four cells, 1 mm apart, and their joined particles.
SQUARE = [(0.05 * column, 0.05 * row) for row in range(3) for column in range(3)]
FACES = [f"f {a} {a + 1} {a + 4}\nf {a} {a + 4} {a + 3}" for a in (1, 2, 4, 5)]
PIECES = "\n".join(
    [f"v {x + shift} {y} 0" for shift in (0.0, 0.101) for x, y in SQUARE]
    + FACES
    + [
        " ".join(str(int(w) + 9) if w.isdecimal() else w for w in line.split(" "))
        for f in FACES
        for line in f.split("\n")
    ]
)
SEAM = ["2-9", "5-12", "8-15"]
MESH = {
    "cloth.mesh": "m.obj", "cloth.anchors": ["0", "3", "6"], "bending.model": "none", "material.stretch_modulus": 100.0,
    "cloth.joints": SEAM, "cloth.joint_stiffness": 200.0, "grippers": [""],
}  # fmt: skip


def pieces_scene(**values):
    return Scene.from_parameters({**MESH, **values}, files={"m.obj": PIECES.encode()})


def test_opposite_edges_join_to_a_tube():
    scene = Scene.from_parameters({**GRID, "cloth.joints": ["left-right"], "cloth.joint_damping": 0.3})
    joints = scene.model().force("joints")
    assert joints.pairs.tolist() == [[row * 7, row * 7 + 6] for row in range(6)]
    assert not joints.rest_length.any()
    masses = scene.model().masses[joints.pairs[:, 0]]
    assert joints.damping == pytest.approx(0.3 * np.sqrt(1000.0 * masses))


def test_piece_hangs_on_the_joints_of_another():
    simulation = Simulation(pieces_scene(**{"cloth.orientation": [0.0, 0.0, -(0.5**0.5), 0.5**0.5], "air.drag": 5.0}))
    weight = 9.81 * simulation.model.masses[9:].sum()
    for _ in range(240):
        simulation.advance()
    first, second = np.array([joint.split("-") for joint in SEAM], dtype=int).T
    pull = 200.0 * (simulation.positions[first] - simulation.positions[second])
    assert pull.sum(axis=0) == pytest.approx([0.0, 0.0, weight], rel=1e-3, abs=1e-3 * weight)


def test_joined_layers_do_not_touch_at_their_joint():
    tables = two_nets(5, gap=0.0)
    positions = np.array(tables["positions"]) - np.repeat([[0.0] * 3, [0.01, 0.005, 0.0]], 25, axis=0)
    positions[25:] = positions[:25] * [-1.0, 1.0, 1.0] + [-0.4, 0.0, 0.0]
    seam = [f"{5 * row}-{25 + 5 * row}" for row in range(5)]
    tables["positions"] = positions.tolist()
    values = {"cloth.joints": seam, "contact.self": True, "contact.thickness": 0.02, "gravity": [0.0] * 3}
    simulation = Simulation(springs_scene(tables, **values))
    before = simulation.positions
    for _ in range(10):
        simulation.advance()
    assert simulation.positions == pytest.approx(before, abs=1e-12)
    with pytest.raises(ValueError, match="from itself"):
        Simulation(springs_scene(tables, **{**values, "cloth.joints": seam[1:]}))


def test_joint_of_a_springs_file_does_not_touch_itself():
    tables = net_tables(5)
    joined = {
        **tables,
        "positions": [*tables["positions"], tables["positions"][12]],
        "springs": [*tables["springs"], [12, 25]],
        "rest_lengths": [0.1 if i < len(tables["springs"]) else 0.0 for i in range(len(tables["springs"]) + 1)],
    }
    values = {"contact.self": True, "contact.thickness": 0.02, "gravity": [0.0] * 3}
    Simulation(springs_scene(joined, **values)).advance()
    apart = {**joined, "rest_lengths": 0.1}
    with pytest.raises(ValueError, match="from itself"):
        Simulation(springs_scene(apart, **values))


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        (["3"], "cloth.joints has '3'; give two particles, e.g. '12-340'"),
        (["1-2-3"], "cloth.joints has '1-2-3'; give two particles"),
        (["4-4"], "'4-4', which joins particle 4 to itself"),
        (["left-top"], "'left-top', which joins 6 particles with 7"),
        (["0-42"], "cloth.joints names particle 42; there are 42, counted from 0"),
        (["0-1", "1-0"], "cloth.joints has '0-1' and '1-0', which both join particles 1 and 0; give one"),
        (["left-right", "7-13"], "cloth.joints has 'left-right' and '7-13', which both join particles 7 and 13"),
        (["0-table"], "cloth.joints: 'table' is no edge or corner of a grid"),
    ],
)
def test_invalid_joints_are_refused(joints, words):
    with pytest.raises(ParameterError) as caught:
        Scene.from_parameters({**GRID, "cloth.joints": joints})
    assert words in str(caught.value)


def test_pieces_without_joints_are_refused():
    with pytest.raises(ParameterError, match=r"join them \(cloth\.joints\), or set contact\.self: true"):
        pieces_scene(**{"cloth.joints": [""]})


def test_pieces_that_joints_leave_apart_are_refused():
    scene = pieces_scene(**{"cloth.joints": ["2-9"]})
    assert scene.sheet.surface.pieces().max() == 1
    with pytest.raises(
        ParameterError, match=r"leave the mesh in 2 pieces: nothing connects particle 9 with particle 0"
    ):
        pieces_scene(**{"cloth.joints": ["0-4"]})
    pieces_scene(**{"cloth.joints": ["0-4"], "contact.self": True, "contact.thickness": 5e-4})


def test_check_reports_the_joints(tmp_path, capsys):
    (tmp_path / "m.obj").write_text(PIECES)
    (tmp_path / "scene.yaml").write_text(dump({**MESH, "cloth.mesh": str(tmp_path / "m.obj")}))
    assert check.check(str(tmp_path / "scene.yaml"), node="cloth_sim") == 0
    assert "3 joints, at most 0.001 m long at the start" in capsys.readouterr().out
