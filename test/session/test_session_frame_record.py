# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""JSON form of frame records: keeps every bit, refuses objects without a JSON form."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord

RECORD = FrameRecord(
    frame=7,
    time=0.11666666666666667,
    events=({"kind": "grasp", "gripper": "left", "closed": True},),
    integrator="leapfrog",
    tolerance=1e-4,
    steps=5,
    digest="00ff",
    paused=False,
)
TEXT = (
    '{"frame":7,"time":0.11666666666666667,"events":[{"kind":"grasp","gripper":"left","closed":true}],'
    '"integrator":"leapfrog","tolerance":0.0001,"steps":5,"digest":"00ff","paused":false}'
)
floats = st.floats(allow_nan=False, allow_infinity=False)


def test_text_is_exact() -> None:
    assert RECORD.to_json() == TEXT
    assert FrameRecord.from_json(TEXT) == RECORD


@given(time=floats, tolerance=st.none() | floats, values=st.lists(floats), name=st.text())
def test_every_float_and_text_comes_back_bit_for_bit(
    time: float, tolerance: float | None, values: list[float], name: str
) -> None:
    record = FrameRecord(
        frame=1,
        time=time,
        events=({"kind": "target", "gripper": name, "position": values},),
        integrator=name,
        tolerance=tolerance,
        steps=0,
        digest="",
        paused=True,
        extras={"kinetic energy": time},
    )
    again = FrameRecord.from_json(record.to_json())
    assert again == record
    # -0.0 == 0.0; therefore the texts are compared too.
    assert again.to_json() == record.to_json()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_non_finite_numbers_are_refused(value: float) -> None:
    with pytest.raises(SessionError, match="frame 3"):
        FrameRecord(
            frame=3,
            time=0.0,
            events=({"kind": "target", "position": [value]},),
            integrator="",
            tolerance=None,
            steps=1,
            digest="",
            paused=False,
        ).to_json()


def test_a_value_without_json_form_is_refused() -> None:
    with pytest.raises(SessionError, match="not JSON serializable"):
        FrameRecord(
            frame=3, time=0.0, events=({"kind": b""},), integrator="", tolerance=None, steps=1, digest="", paused=False
        ).to_json()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frame": "7"}, "frame is '7'"),
        ({"frame": True}, "frame is True"),
        ({"events": [1]}, "events are JSON objects"),
        ({"paused": 0}, "paused is 0"),
        ({"speed": 1}, "unknown keys"),
        ({"digest": None}, "digest is None"),
    ],
)
def test_a_wrong_field_is_named(change: dict[str, object], said: str) -> None:
    with pytest.raises(SessionError, match=said):
        FrameRecord.from_json(json.dumps({**json.loads(TEXT), **change}))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        TEXT[:-1],
        TEXT.replace("0.0001", "NaN"),
        TEXT.replace("0.0001", "1e999"),
        TEXT[:-1] + ',"frame":8}',
    ],
)
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(SessionError, match="frame record"):
        FrameRecord.from_json(text)


@pytest.mark.parametrize("member", [{"obstacles": "hand"}, {"obstacles": ["hand"], "poses": [0.0]}, {"poses": 1.0}])
def test_bad_members_of_a_reset_are_refused(member: dict[str, object]) -> None:
    record = json.loads(TEXT)
    valid = {"kind": "reset", "obstacles": ["hand"], "poses": [[0.0] * 7]}
    for event in ({"kind": "reset"}, valid):
        assert FrameRecord.from_json(json.dumps({**record, "events": [event]})).events == (event,)
    with pytest.raises(SessionError, match=r"event \{'kind': 'reset'.* has no '(obstacles|poses)' that is a list of"):
        FrameRecord.from_json(json.dumps({**record, "events": [{"kind": "reset", **member}]}))
