# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The state that `initial_state` names when it lies in a recorded session: ``session.mcap@frame``."""

from __future__ import annotations

from cloth_sim_ros import events, parameter_file
from cloth_sim_ros.parameters import ParameterError
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.simulation import Simulation

_MARK = ".mcap@"


def session_state(name: str) -> dict[str, bytes]:
    """Return the state's bytes by the name, or nothing if the name is that of a plain file.

    The session runs again from its snapshot to the frame: only snapshots are recorded whole.

    Raises:
        ParameterError: if the session can't be read, has no such frame, or runs differently here.
    """
    if _MARK not in name:
        return {}
    path, _, number = name.rpartition("@")
    if not number.isdecimal():
        raise ParameterError(f"initial_state '{name}': '{number}' is no frame number; write session.mcap@120")
    try:
        from cloth_sim_ros.session.errors import SessionError
        from cloth_sim_ros.session.reader import SessionReader
    except ImportError as error:
        raise ParameterError(f"initial_state '{name}' needs {error.name}: pip install mcap rosbags") from error
    try:
        with SessionReader(path) as reader:
            return {name: _run(reader, int(number), name)}
    except (SessionError, OSError) as error:
        raise ParameterError(f"initial_state '{name}': {error}") from error


def _run(reader: object, number: int, name: str) -> bytes:
    scene = Scene.from_parameters(parameter_file.parse(reader.scene_yaml))  # type: ignore[attr-defined]
    simulation = Simulation(scene, State.from_bytes(reader.state))  # type: ignore[attr-defined]
    first = simulation.frame
    for record in reader.frames():  # type: ignore[attr-defined]
        if simulation.frame >= number:
            break
        simulation.advance([events.from_dict(dict(event)) for event in record.events])
        if simulation.frame == number and simulation.state.digest() != record.digest:
            raise ParameterError(
                f"initial_state '{name}': the session does not run here as it was recorded (cloth_verify says why); "
                "save the state with ~/save_state where it does"
            )
    if simulation.frame != number:
        raise ParameterError(f"initial_state '{name}': the session holds frames {first} to {simulation.frame}")
    return simulation.state.to_bytes()
