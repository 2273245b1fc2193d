# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of a state's named memory from a file."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cloth_sim_ros.physics.state import controller_state
from cloth_sim_ros.physics.state.controller_state import (
    ANCHORS_KEY,
    JAWS_AT_REST_KEY,
    JAWS_KEY,
    JOINTS_KEY,
    PLASTIC_LENGTHS_KEY,
    SETPOINTS_KEY,
    THICKNESS_KEY,
    SleepState,
)

#: Type and shape of arrays by name; a letter of a shape stands for a number that other arrays give.
_Table = Mapping[str, tuple[np.dtype, tuple[str | int, ...]]]

_FLOAT, _INT, _BOOL = np.dtype(np.float64), np.dtype(np.int64), np.dtype(np.bool_)

#: Arrays of grippers and grips: type and shape; g is the number of grippers, m that of grasped particles.
_GRIPPERS: _Table = {
    "gripper.pose": (_FLOAT, ("g", 7)),
    "gripper.target": (_FLOAT, ("g", 7)),
    "gripper.twist": (_FLOAT, ("g", 6)),
    "gripper.turn": (_FLOAT, ("g", 6)),
    "gripper.placed": (_BOOL, ("g",)),
    "gripper.closed": (_BOOL, ("g",)),
    "grip.particles": (_INT, ("m",)),
    "grip.offsets": (_FLOAT, ("m", 3)),
    "grip.starts": (_INT, ("g+1",)),
}
#: Arrays of obstacles; o is their number.
_OBSTACLES: _Table = {
    "obstacle.pose": (_FLOAT, ("o", 7)),
    "obstacle.target": (_FLOAT, ("o", 7)),
    "obstacle.twist": (_FLOAT, ("o", 6)),
    "obstacle.turn": (_FLOAT, ("o", 6)),
}


def check(memory: Mapping[str, np.ndarray], particle_count: int) -> None:
    """Raise ValueError if a known array of a state's memory has wrong type, shape or range; unknown names pass.

    The arrays of grippers and grips occur together, or none of them; so do those of obstacles.

    Args:
        memory: arrays by name, as in `State.memory`.
        particle_count: number of particles of the state.

    Raises:
        ValueError: naming the array and the fault.
    """
    for name, array in memory.items():
        if array.dtype not in (_FLOAT, _INT, _BOOL):
            raise ValueError(f"memory '{name}' is of type {array.dtype}; it must be float64, int64 or bool")
    if "paused" in memory:
        _check_array("paused", memory["paused"], _BOOL, (1,))
    if "relaxed" in memory:
        _check_array("relaxed", memory["relaxed"], _FLOAT, (1,))
        if not memory["relaxed"][0] >= 1.0:
            raise ValueError(f"memory 'relaxed' is {memory['relaxed'][0]}; it must be at least 1")
    for name in (*controller_state.SLEEP_KEYS, controller_state.PREVIOUS_VELOCITIES_KEY):
        if name in memory:
            _check_array(name, memory[name], _FLOAT, (3, particle_count))
    if controller_state.SECOND_DIFFERENCES_KEY in memory:
        second_differences = memory[controller_state.SECOND_DIFFERENCES_KEY]
        _check_array(controller_state.SECOND_DIFFERENCES_KEY, second_differences, _FLOAT, (2, particle_count))
    if controller_state.RUN_DIFFERENCES_KEY in memory:
        differences = memory[controller_state.RUN_DIFFERENCES_KEY]
        n_pieces = 2 if differences.ndim and len(differences) == 2 else 1
        _check_array(controller_state.RUN_DIFFERENCES_KEY, differences, _FLOAT, (n_pieces, 2, 3, particle_count))
    if controller_state.SLEEP_VELOCITIES_KEY in memory and SleepState.key not in memory:
        raise ValueError(f"memory '{SleepState.key}' is missing; a state that sleeps has it")
    if ANCHORS_KEY in memory:
        anchors = memory[ANCHORS_KEY]
        _check_array(ANCHORS_KEY, anchors, _FLOAT, (len(anchors) if anchors.ndim else 0, 4, particle_count))
        bad_bonds = np.argwhere(~np.isin(anchors[:, 3], (0.0, 1.0, 2.0)))
        if len(bad_bonds):
            obstacle, particle = bad_bonds[0].tolist()
            raise ValueError(
                f"memory '{ANCHORS_KEY}' has bond {anchors[obstacle, 3, particle]} of obstacle {obstacle} with "
                f"particle {particle}; it must be 0 (none), 1 (sticks) or 2 (slides)"
            )
        n_jaws = 2 * len(np.atleast_1d(memory.get(JAWS_KEY, ())))
        n_obstacles = (
            len(np.atleast_1d(memory["obstacle.pose"])) if "obstacle.pose" in memory else len(anchors) - n_jaws
        )
        # Two more rows if layers of the cloth have friction.
        if len(anchors) - n_obstacles - n_jaws not in (0, controller_state.LAYER_SIDES):
            description = f"obstacles, 'obstacle.pose' of {n_obstacles}"
            if n_jaws:
                description = f"obstacles and pads, 'obstacle.pose' of {n_obstacles} and '{JAWS_KEY}' of {n_jaws}"
            raise ValueError(f"memory '{ANCHORS_KEY}' is of {len(anchors)} {description}")
    if THICKNESS_KEY in memory:
        reduced = memory[THICKNESS_KEY]
        _check_array(THICKNESS_KEY, reduced, _FLOAT, (len(reduced) if reduced.ndim else 0, particle_count + 1))
        if not (reduced > 0.0).all():
            raise ValueError(f"memory '{THICKNESS_KEY}' holds {reduced.min()}; it must be above 0")
    if PLASTIC_LENGTHS_KEY in memory:
        lengths = memory[PLASTIC_LENGTHS_KEY]
        _check_array(PLASTIC_LENGTHS_KEY, lengths, _FLOAT, (lengths.size,))
    if JOINTS_KEY in memory:
        _check_array(JOINTS_KEY, memory[JOINTS_KEY], _FLOAT, (len(np.atleast_1d(memory[JOINTS_KEY])), 3))
    n_pinches = len(np.atleast_1d(memory.get(JAWS_KEY, ())))
    for name, (dtype, length) in {
        JAWS_KEY: (_FLOAT, (n_pinches, 2)),
        JAWS_AT_REST_KEY: (_BOOL, (n_pinches,)),
        SETPOINTS_KEY: (_FLOAT, (n_pinches, 3)),
    }.items():
        if name in memory:
            _check_array(name, memory[name], dtype, length)
    rules: list[type[controller_state.ControllerState]] = [*controller_state.STEP_CONTROL_STATES, SleepState]
    for rule in rules:
        if rule.key in memory:
            rule.check(memory[rule.key])
    _check_table("obstacles", memory, _OBSTACLES, {"o": "obstacle.pose"})
    if not _check_table("grippers", memory, _GRIPPERS, {"g": "gripper.pose", "m": "grip.particles"}):
        return
    particles, starts = memory["grip.particles"], memory["grip.starts"]
    if starts[0] != 0 or starts[-1] != len(particles) or (np.diff(starts) < 0).any():
        raise ValueError(
            f"memory 'grip.starts' is {starts.tolist()}; it must ascend from 0 to {len(particles)}, "
            "the length of 'grip.particles'"
        )
    wrong = np.flatnonzero((particles < 0) | (particles >= particle_count))
    if wrong.size:
        raise ValueError(
            f"memory 'grip.particles' names particle {particles[wrong[0]]}; there are {particle_count}, counted from 0"
        )


def _check_table(
    contents: str, memory: Mapping[str, np.ndarray], table: _Table, length_arrays: Mapping[str, str]
) -> bool:
    """Raise ValueError unless a memory has all arrays of a table, with type and shape, or none; return true if all.

    Args:
        contents: their owner, for messages.
        memory: all arrays.
        table: type and shape of each array.
        length_arrays: for each letter of the shapes, the array with that length.
    """
    if not any(name in memory for name in table):
        return False
    for name in table:
        if name not in memory:
            raise ValueError(f"memory '{name}' is missing; a state with {contents} has {', '.join(table)}")
    sizes = {letter: len(np.atleast_1d(memory[name])) for letter, name in length_arrays.items()}
    sizes |= {f"{letter}+1": size + 1 for letter, size in sizes.items()}
    for name, (dtype, shape) in table.items():
        expected_shape = tuple(sizes[length] if isinstance(length, str) else length for length in shape)
        _check_array(name, memory[name], dtype, expected_shape)
    return True


def _check_array(name: str, array: np.ndarray, dtype: np.dtype, shape: tuple[int, ...]) -> None:
    if array.dtype != dtype:
        raise ValueError(f"memory '{name}' is of type {array.dtype}; it must be {dtype}")
    if array.shape != shape:
        raise ValueError(f"memory '{name}' has shape {array.shape}; it must be {shape}")
    if dtype == _FLOAT and not np.isfinite(array).all():
        raise ValueError(f"memory '{name}' holds {array[~np.isfinite(array)][0]}; it must be finite")
