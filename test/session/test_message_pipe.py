# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages in a pipe between two processes."""

from __future__ import annotations

import io

from cloth_sim_ros.session.message_pipe import pack, unpack

MESSAGES = [("/cloth_sim/points", bytes(range(256))), ("parameters", b"{}"), ("/a", b"")]


def test_messages_leave_the_pipe_as_they_entered() -> None:
    stream = io.BytesIO(b"".join(pack(topic, data) for topic, data in MESSAGES))
    assert list(unpack(stream)) == MESSAGES


def test_message_that_was_cut_off_is_left_out() -> None:
    whole, cut = pack(*MESSAGES[1]), pack(*MESSAGES[0])
    for length in range(len(cut)):
        assert list(unpack(io.BytesIO(whole + cut[:length]))) == MESSAGES[1:2]
