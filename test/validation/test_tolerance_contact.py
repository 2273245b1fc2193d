# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `tolerance --contact`: contact scenes compared with DOP853."""

import json

import attrs
import numpy as np
import pytest

from validation.__main__ import main
from validation.case_pool import CasePool, CaseResult
from validation.tolerance import contact
from validation.tolerance.climb_motions import draw_prescribed, draw_shaken
from validation.tolerance.contact import FRICTIONS, KINDS, draw_contact, evaluate_contact, run_contact

#: A table and a sheet folded on itself, without friction.
CASES = (0, 3)


@pytest.fixture(autouse=True)
def short_scenes(monkeypatch):
    """Shorten scenes of small sheets to a fifth of a second, at a tight tolerance."""
    monkeypatch.setattr(contact, "_SECONDS", 0.2)
    monkeypatch.setattr(contact, "_SIDES", (4, 6))
    draw_original = contact.draw_contact

    def shorter(seed, index):
        contact_draw = draw_original(seed, index)
        return attrs.evolve(contact_draw, scene=contact_draw.scene.changed({"tolerance": 1e-5}))

    monkeypatch.setattr(contact, "draw_contact", shorter)
    monkeypatch.setattr(contact, "_WINDOW", 0.2)


@pytest.mark.parametrize("index", CASES)
def test_contact_scene_satisfies_the_error_bound(index):
    evaluation = evaluate_contact(1, index, 1)
    assert evaluation.verdict == "kept"
    assert evaluation.worst(flagged=False).error > 0.0


def test_wrong_frame_violates_the_error_bound(monkeypatch):
    def off(draw):
        run = run_contact(draw)
        run.frames[-1].after.x[2] += 0.01
        return run

    monkeypatch.setattr(contact, "run_contact", off)
    monkeypatch.setattr(contact, "_PARTS", 2)
    assert evaluate_contact(1, 0, 1).verdict == "BROKEN"


def test_contact_scenes_cover_the_laws_of_fabrics():
    words = " ".join(draw_contact(1, index).words for index in range(24))
    for law in ("shape_operator", "quadratic", "friction of bending", "with triangles", "stiffening triangles"):
        assert law in words


def test_contact_scenes_cover_every_kind_and_touch():
    for index in range(len(KINDS) * len(FRICTIONS)):
        draw = draw_contact(1, index)
        assert draw.words.startswith(KINDS[index % len(KINDS)])
        run = run_contact(draw)
        assert not run.trouble
        plan = draw.scene.plan()
        nearest = min(
            float(plan.contact.obstacle_gaps(frame.t, frame.after.x, frame.after.memory)[0, 1]) for frame in run.frames
        )
        assert 0.0 < nearest < draw.scene.contact.thickness


@pytest.mark.parametrize(
    ("draw", "kinds"), [(draw_shaken, ("plane", "box", "sphere")), (draw_prescribed, ("prescribed", "spring"))]
)
def test_bodies_of_climbed_scenes_move_in_each_kind(draw, kinds):
    rng = np.random.default_rng(1)
    draws = [draw(rng) for _ in range(12)]
    assert {scene_draw.words.split(",")[0] for scene_draw in draws} == set(kinds)
    for scene_draw in draws[:4]:
        assert min(frame for frame in scene_draw.events if frame) >= scene_draw.first
        run = run_contact(scene_draw)
        assert not run.trouble
        assert len(run.frames) - scene_draw.first == round(scene_draw.scene.rate)
        memory = run.frames[-1].after.memory
        # Each gripper grasps a particle.
        assert np.diff(memory["grip.starts"]).min(initial=1) > 0


def test_command_reports_evaluated_contact_scenes(tmp_path, monkeypatch):
    # Worker processes would not have the shorter window.
    monkeypatch.setattr(CasePool, "run_missing", _run_in_process)
    file = tmp_path / "output.json"
    assert main(["tolerance", "--contact", "--count", "1", "--windows", "1", "--json", str(file)]) == 0
    output = json.loads(file.read_text())
    assert output["tables"][0]["rows"][0][1] == "kept"


def _run_in_process(_, evaluate, cases, kinds):
    for case in cases:
        yield CaseResult(case, evaluate(case), 1.0)
