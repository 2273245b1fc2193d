# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `tolerance --contact`: contact scenes compared with DOP853."""

import json

import attrs
import pytest

from validation.__main__ import main
from validation.tolerance import contact
from validation.tolerance.contact import FRICTIONS, KINDS, draw_contact, judge_contact, run_contact

#: A table and a sheet folded on itself, without friction.
CASES = (0, 3)


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Shorten scenes to a fifth of a second, at a tight tolerance."""
    monkeypatch.setattr(contact, "_SECONDS", 0.2)
    drawn = contact.draw_contact

    def shorter(seed, index):
        found = drawn(seed, index)
        return attrs.evolve(found, scene=found.scene.changed({"tolerance": 1e-5}))

    monkeypatch.setattr(contact, "draw_contact", shorter)
    monkeypatch.setattr(contact, "_WINDOW", 0.2)


@pytest.mark.parametrize("index", CASES)
def test_contact_scene_satisfies_the_error_bound(index):
    judgement = judge_contact(1, index, 1)
    assert judgement.verdict == "kept"
    assert judgement.worst(flagged=False).error > 0.0


def test_wrong_frame_violates_the_error_bound(monkeypatch):
    def off(draw):
        run = run_contact(draw)
        run.frames[-1].after.x[2] += 0.01
        return run

    monkeypatch.setattr(contact, "run_contact", off)
    assert judge_contact(1, 0, 1).verdict == "BROKEN"


def test_contact_scenes_cover_every_kind_and_touch():
    for index in range(len(KINDS) * len(FRICTIONS)):
        draw = draw_contact(1, index)
        assert draw.words.startswith(KINDS[index % len(KINDS)])
        run = run_contact(draw)
        assert not run.trouble
        plan = draw.scene.plan()
        nearest = min(float(plan.contact.contact_gaps_of(frame.after, frame.t)[0, 1]) for frame in run.frames)
        assert 0.0 < nearest < draw.scene.contact.thickness


def test_command_reports_evaluated_contact_scenes(tmp_path, monkeypatch):
    # Worker processes would not have the shorter window.
    monkeypatch.setattr("validation.tolerance.bound.run_missing", _alone)
    file = tmp_path / "output.json"
    assert main(["tolerance", "--contact", "--count", "1", "--windows", "1", "--json", str(file)]) == 0
    told = json.loads(file.read_text())
    assert told["tables"][0]["rows"][0][1] == "kept"


def _alone(judged_by, cases, **_):
    from validation.case_pool import Done

    for case in cases:
        yield Done(case, judged_by(case), 1.0)
