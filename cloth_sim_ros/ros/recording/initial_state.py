# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Initial states from recorded sessions: ``session.mcap@frame``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.recorded_scene import recorded_values
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation import events
from cloth_sim_ros.simulation.environment import recorder_with_other_arithmetic
from cloth_sim_ros.simulation.simulation import Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.session.reader import SessionReader

_SESSION_MARK = ".mcap@"
#: Frame numbers have 64 bits.
_MAX_DIGITS = 18


def session_state(name: str) -> dict[str, bytes]:
    """Return {name: bytes of the state} for a name `session.mcap@frame`, replayed; {} for a plain file's name.

    Only snapshots are recorded in full. The session is replayed from the last snapshot before the frame. For a split
    session any file may be named; the others are searched in the same folder.

    Raises:
        ParameterError: if the session can't be read, has no such frame, or runs differently here.
    """
    if _SESSION_MARK not in name:
        return {}
    path, _, frame = name.rpartition("@")
    if not (frame.isascii() and frame.isdecimal() and len(frame) <= _MAX_DIGITS):
        raise ParameterError(f"initial_state '{name}': '{frame}' is no frame number; write session.mcap@120")
    try:
        return {name: _state_at(path, int(frame), name)}
    except ImportError as error:
        library = str(error.name).partition(".")[0]
        raise ParameterError(
            f"initial_state '{name}' needs {library}, which is not installed: pip install mcap rosbags zstandard lz4"
        ) from error


def _state_at(path: str, frame: int, name: str) -> bytes:
    """Return the bytes of the state at a frame of a session, given by any of its files; replays from a snapshot."""
    from cloth_sim_ros.session.errors import SessionError
    from cloth_sim_ros.session.reader import SessionReader, session_files

    first_frame = None
    try:
        # Backwards from the last file, to the nearest snapshot.
        for file in reversed(session_files(path)):
            with SessionReader(file) as reader:
                state = State.from_bytes(reader.state)
                if state.frame <= frame:
                    return _replay(reader, state, frame, name)
                first_frame = state.frame
    except ParameterError:
        raise
    except (SessionError, UnstableError, ValueError, OSError) as error:
        raise ParameterError(f"initial_state '{name}': {error}") from error
    raise ParameterError(f"initial_state '{name}': the session begins at frame {first_frame}")


def _replay(reader: SessionReader, state: State, frame: int, name: str) -> bytes:
    """Replay a session file from its snapshot to a frame; return the bytes of the state there."""
    values = recorded_values(reader.scene_yaml, node=reader.node)
    simulation = Simulation(Scene.from_parameters(values, files=reader.files), state)
    # With another arithmetic the motion differs only by rounding, which is acceptable for an initial state.
    repeatable = not recorder_with_other_arithmetic(reader.metadata)
    for record in reader.frames():
        if simulation.frame >= frame:
            break
        if record.frame > simulation.frame + 1:
            raise ParameterError(
                f"initial_state '{name}': frames {simulation.frame + 1} to {record.frame - 1} of the session are "
                f"missing; {reader.missing or 'it was not recorded whole'}"
            )
        simulation.advance([events.from_dict(dict(event)) for event in record.events])
        if repeatable and simulation.state.digest() != record.digest:
            raise ParameterError(
                f"initial_state '{name}': from frame {record.frame} on the session does not run here as it was "
                "recorded (cloth_verify gives the reason); save the state with ~/save_state on the recording machine"
            )
    if simulation.frame != frame:
        cause = f" ({reader.missing})" if reader.missing else ""
        raise ParameterError(f"initial_state '{name}': the session ends at frame {simulation.frame}{cause}")
    return simulation.state.to_bytes()


def describe_left_out(simulation: Simulation) -> str:
    """Return a sentence on the parts of the initial state that another version saved and that are not used."""
    name, left_out = simulation.scene.initial_state, ", ".join(simulation.state.dropped_memory)
    return f"initial_state '{name}' was saved by another version: its controller state ({left_out}) is reset"
