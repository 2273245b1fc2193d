# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings around failures in quick succession."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.ros.recording.errors import RecordingUnavailableError
from cloth_sim_ros.ros.recording.recording import SessionRecording, log_end
from cloth_sim_ros.ros.recording.recording_control import RecordingControl


class OpeningRecording:
    """A recording whose state the test controls."""

    def __init__(self) -> None:
        self.running = self.busy = False
        self.begun = 0
        self._listeners: list[Callable[[Any], None]] = []

    def discard(self) -> None:
        """Drop nothing: frames record nothing here."""

    def begin(self, _stamp: int) -> None:
        """Start; the file is not open yet."""
        self.running = self.busy = True
        self.begun += 1

    def begin_close(self, *, reason: str) -> None:
        """End; the file is still being closed."""
        assert reason
        self.running = False

    def notify(self, listener: Callable[[Any], None]) -> None:
        """Call a listener at the next state."""
        self._listeners.append(listener)

    def poll(self) -> str:
        """Report no error."""
        return ""

    def become(self, state: str) -> None:
        """Set a state and call the listeners."""
        self.busy = state == "recording"
        listeners, self._listeners = self._listeners, []
        for listener in listeners:
            listener(SimpleNamespace(state=state, error="", path=Path("a.mcap"), messages=0, bytes_written=0))


def test_failure_of_an_opening_recording_is_resumed() -> None:
    errors: list[str] = []
    logger = SimpleNamespace(info=lambda _: None, debug=lambda _: None, error=errors.append)
    clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=0))
    node: Any = SimpleNamespace(get_logger=lambda: logger, get_clock=lambda: clock)
    recording: Any = OpeningRecording()
    rosout: Any = SimpleNamespace(update=lambda: None)
    control = RecordingControl(node, recording, rosout, record_latched=lambda _: None, refusal=lambda: "")
    recording.begin(0)
    for _ in range(2):
        control.fail("ValueError: first", 0)
        recording.become("closed")
        # After the reset a recording starts; the next failure comes before its file is open.
        control.update()
    assert (recording.begun, recording.running) == (3, True)
    control.fail("ValueError: again", 0)
    recording.become("closed")
    control.update()
    recording.become("recording")
    assert not errors
    assert (recording.begun, recording.running) == (4, True)


def test_recording_that_opens_has_no_path() -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (4, 4)}))
    session = SessionRecording(node_name="/cloth_sim", simulation=simulation)
    # private: a recorder opens its file in a thread, at any time.
    opening: Any = SimpleNamespace(status=lambda: SimpleNamespace(path=None))
    session._recorder = opening
    with pytest.raises(RecordingUnavailableError, match=r"^recording already; its file is being opened$"):
        session.begin(0)


@pytest.mark.parametrize("end", ["", ", which was renamed or moved since"])
def test_moved_recording_is_told_at_its_end(tmp_path: Path, end: str) -> None:
    path, lines = tmp_path / "a.mcap", list[str]()
    if not end:
        path.write_bytes(b"")
    status: Any = SimpleNamespace(state="closed", path=path, messages=3, bytes_written=0)
    log_end(SimpleNamespace(info=lines.append), status)
    assert lines == [f"recorded 3 messages, 0 bytes, into {path}{end}"]
