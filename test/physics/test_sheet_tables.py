# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of pairs of particles in tables."""

import numpy as np
from support.raw_nets import net_tables, springs_scene

from cloth_sim_ros.physics.model.sheets.tables import pair_rows
from cloth_sim_ros.scene import springs_file
from cloth_sim_ros.scene.scene import Scene


def test_pairs_are_found_in_either_order_at_their_last_row():
    pairs = np.array([[0, 1], [4, 2], [1, 0], [3, 2]])
    queries = np.array([[1, 0], [2, 4], [2, 3], [0, 2], [-1, 3], [2, 1 << 62], [3, 3]])
    assert pair_rows(pairs, queries).tolist() == [2, 1, 3, -1, -1, -1, -1]
    assert pair_rows(pairs[:0], queries[:2]).tolist() == [-1, -1]
    assert pair_rows(pairs, queries[:0]).tolist() == []


def test_later_scene_reads_files_and_surface_once(monkeypatch):
    parsed = []
    parse = springs_file.parse_rest_angles
    monkeypatch.setattr(springs_file, "parse_rest_angles", lambda data: parsed.append(data) or parse(data))
    values = {"bending.model": "altitude", "material.bending_modulus": 1e-4, "bending.rest_angles": "a.yaml"}
    plain = springs_scene(net_tables(3))
    files = {**plain.files, "a.yaml": b"edges: [[1, 4]]\nangles: 0.4321\n"}
    first, second = (
        Scene.from_parameters({**plain.parameters(), **values, "gravity": [0.0, 0.0, g]}, files=files)
        for g in (-1.0, -2.0)
    )
    assert first.sheet.surface is second.sheet.surface
    assert len(parsed) == 1
