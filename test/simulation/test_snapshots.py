# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Snapshots: the same events give the same bits, in this and in another simulation."""

from __future__ import annotations

import itertools
import pickle
from collections.abc import Callable, Sequence

import attrs
import numpy as np
import pytest

from cloth_sim_ros import Grasp, Pause, Relax, Reset, Scene, SetParameters, Simulation, Step, Target
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Move

HUNG = {"cloth.resolution": [6, 7], "tolerance": 1e-3, "rate": 30.0, "material.stretch_modulus": 200.0}
CALM = {
    **HUNG,
    "cloth.resolution": [4, 5],
    "air.drag": 5.0,
    "material.stretch_modulus": 100.0,
    "material.shear_modulus": 20.0,
}
LYING = {
    **HUNG,
    "cloth.resolution": [6, 6],
    "cloth.size": [0.3, 0.3],
    "cloth.position": [-0.15, 0.0, 0.004],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.anchors": [""],
    "obstacles": ["table"],
    "table.shape": "box",
    "table.size": [2.0, 2.0, 0.04],
    "table.position": [0.0, 0.0, -0.02],
    "table.friction": [0.6, 0.5],
}
PINCHED = {
    **HUNG,
    "gripper.mode": "pinch",
    "gripper.pad_size": [0.2, 0.02, 0.2],
    "gripper.opening": 0.08,
    "gripper.friction": [0.6, 0.5],
}


def along(*places: Sequence[float], frames: int) -> list[list[Event]]:
    """Targets of the gripper along waypoints, with a number of frames for each."""
    event_frames: list[list[Event]] = []
    for start, end in itertools.pairwise(places):
        ways = np.linspace(start, end, frames)
        event_frames += [[Target("gripper", target_position)] for target_position in ways]
    return event_frames


def corner(values: dict) -> tuple[float, ...]:
    return tuple(Simulation(Scene.from_parameters(values)).positions[-1])


def carried(values: dict) -> list[list[Event]]:
    """The last corner is grasped and moved."""
    x, y, z = corner(values)
    begin: list[list[Event]] = [[Target("gripper", (x, y, z)), Grasp("gripper", True)]]
    return begin + along((x, y, z), (x - 0.1, y + 0.1, z + 0.15), frames=8)


def pinched() -> list[list[Event]]:
    """Pads close on a corner that hangs between them, and pull it sideways."""
    x, y, z = corner(PINCHED)
    at = (x, y, z)
    return [[Target("gripper", at)], [Grasp("gripper", True)], *[[]] * 20, *along(at, (x, y + 0.1, z), frames=6)]


#: Scene, events before the snapshot, and events after it.
STORIES: dict[str, tuple[dict, Callable[[], list[list[Event]]], list[list[Event]]]] = {
    "held by a gripper": (HUNG, lambda: carried(HUNG), [[], [Target("gripper", (0.8, 0.2, 0.4))], [], []]),
    "let go": (HUNG, lambda: carried(HUNG), [[Grasp("gripper", False)], [], [Grasp("gripper", True)], []]),
    "friction on a table": (LYING, lambda: [*carried(LYING), *[[]] * 4], [[Move("table", (0.05, 0.0, -0.02))], [], []]),
    "pinched": (PINCHED, pinched, [[], [Target("gripper", (0.4, 0.2, 0.2))], [Grasp("gripper", False)], [], []]),
    "asleep": (
        CALM,
        lambda: [*carried(CALM), *[[]] * 1500],
        # A target at the present pose does not wake the cloth.
        [
            [Target("gripper", tuple(np.add(corner(CALM), (-0.1, 0.1, 0.15))))],
            [],
            [Target("gripper", (0.0, 0.0, 0.0))],
            [SetParameters({"air.drag": 4.0})],
            [],
        ],
    ),
    "parameters": (
        HUNG,
        lambda: [*carried(HUNG), [SetParameters({"material.stretch_modulus": 300.0})], [Relax(4.0)], []],
        [[Relax(1.0)], [SetParameters({"gravity": [0.0, 1.0, -9.0]})], []],
    ),
    "a fixed step": (
        {**HUNG, "step": 2e-3},
        lambda: carried(HUNG),
        [[SetParameters({"material.stretch_modulus": 100.0})], [], []],
    ),
    "energy watched": ({**HUNG, "diagnostics.energy": True}, lambda: carried(HUNG), [[], []]),
    "paused": (HUNG, lambda: [*carried(HUNG), [Pause(True)]], [[], [Step()], [Pause(False)], []]),
    "implicit": ({**HUNG, "integrator": "implicit"}, lambda: carried(HUNG), [[], []]),
    "symplectic Euler": ({**HUNG, "integrator": "symplectic_euler"}, lambda: carried(HUNG), [[], [Reset()], []]),
}
#: Events before the restore, which must leave no trace.
BETWEEN: list[list[Event]] = [
    [Grasp("gripper", False), Target("gripper", (0.3, 0.3, 0.3))],
    [SetParameters({"material.stretch_modulus": 150.0, "air.drag": 1.0, "gravity": [0.0, 0.0, -5.0]})],
    [Relax(3.0), Pause(False)],
    [Reset()],
    [Grasp("gripper", True)],
]
#: Events before the restore without a change of scene.
BRIEFLY: list[list[Event]] = [[Relax(3.0), Grasp("gripper", False), Move("table", (0.0, 0.0, -0.1))], [], []]


def now(simulation: Simulation) -> tuple:
    """Results of queries between frames."""
    gaps = simulation.gaps()
    queries = (
        simulation.energy(),
        simulation.plan.spectral_bounds(simulation.state.x),
        simulation.grasped_count(0),
        simulation.time,
    )
    return *queries, simulation.state.digest(), None if gaps is None else gaps.tobytes()


def run(simulation: Simulation, events: list[list[Event]]) -> list[tuple]:
    """Results of frames: digests, wrenches, and if time passed."""
    results = []
    for frame_events in events:
        frame = simulation.advance(frame_events)
        report = simulation.energy_report
        results.append(
            (
                simulation.state.digest(),
                frame.index,
                frame.moved,
                frame.advance,
                frame.wrenches.tobytes(),
                frame.obstacle_wrenches.tobytes(),
                frame.pinches,
                simulation.asleep,
                None if report is None else attrs.astuple(report),
            )
        )
    return results


@pytest.mark.parametrize("name", STORIES)
def test_the_same_events_give_the_same_bits(name: str) -> None:
    values, before, after = STORIES[name]
    scene = Scene.from_parameters(values)
    simulation = Simulation(scene)
    run(simulation, before())
    if name == "asleep":
        assert simulation.asleep
    if name == "pinched":
        assert simulation.grasped_count(0) > 0
    if name == "friction on a table":
        assert simulation.state.memory["contact.anchors"].any()
    snapshot = simulation.snapshot()
    digest, queries = snapshot.state.digest(), now(simulation)
    expected = run(simulation, after)
    assert len({result[0] for result in expected}) == len(expected)
    # In the same simulation, after other events.
    for between in (BETWEEN, BRIEFLY):
        known = [[event for event in events if values is LYING or not isinstance(event, Move)] for events in between]
        run(simulation, known)
        simulation.restore(snapshot)
        assert now(simulation) == queries
        assert run(simulation, after) == expected
    # In another simulation, and from bytes.
    fresh = Simulation(scene)
    fresh.restore(snapshot)
    assert now(fresh) == queries
    assert run(fresh, after) == expected
    fresh.restore(pickle.loads(pickle.dumps(snapshot)))
    assert run(fresh, after) == expected
    assert snapshot.state.digest() == digest


def test_rollouts_from_a_snapshot_do_not_change_it() -> None:
    simulation = Simulation(Scene.from_parameters(HUNG))
    run(simulation, carried(HUNG))
    snapshot = simulation.snapshot()
    start = simulation.grippers.poses()[0, :3]

    def future(k: int) -> list[tuple]:
        simulation.restore(snapshot)
        return run(simulation, along(start, start + np.array([0.0, 0.02 * k, 0.0]), frames=3))

    ways = [future(k) for k in range(3)]
    assert len({path[-1][0] for path in ways}) == 3
    assert future(1) == ways[1]


def test_a_snapshot_copies_no_array() -> None:
    simulation = Simulation(Scene.from_parameters(HUNG))
    run(simulation, carried(HUNG))
    snapshot = simulation.snapshot()
    assert snapshot.state.x is simulation.state.x
    assert snapshot.state.v is simulation.state.v
    assert all(array is simulation.state.memory[name] for name, array in snapshot.state.memory.items())
    assert (snapshot.frame, snapshot.time) == (simulation.frame, simulation.time)
    assert (snapshot.positions == simulation.positions).all()


def test_reset_after_restore_uses_the_snapshot_scene() -> None:
    lies = Simulation(Scene.from_parameters(LYING)).state.to_bytes()
    scene = Scene.from_parameters({**LYING, "initial_state": "lies.npz"}, files={"lies.npz": lies})
    simulation = Simulation(scene)
    snapshot = simulation.snapshot()
    for _ in range(2):  # changes after the restore must not reach the snapshot
        simulation.advance([SetParameters({"obstacles": [""]})])
        assert "obstacle.pose" in snapshot.initial.memory
        simulation.restore(snapshot)
    simulation.advance([Reset()])
    assert "obstacle.pose" in simulation.state.memory
    assert simulation.scene.obstacle_names == ["table"]


def test_snapshot_with_read_only_arrays_is_restored() -> None:
    simulation = Simulation(Scene.from_parameters(HUNG))
    run(simulation, carried(HUNG))
    buffers: list[pickle.PickleBuffer] = []
    data = pickle.dumps(simulation.snapshot(), protocol=5, buffer_callback=buffers.append)
    # As a message from another process brings them.
    snapshot = pickle.loads(data, buffers=[bytes(buffer.raw()) for buffer in buffers])
    assert not snapshot.state.x.flags.writeable
    restored = Simulation(Scene.from_parameters(HUNG))
    restored.restore(snapshot)
    assert restored.energy() == simulation.energy()


def test_a_snapshot_of_another_scene_is_refused() -> None:
    snapshot = Simulation(Scene.from_parameters(HUNG)).snapshot()
    other_scene = Simulation(Scene.from_parameters({**HUNG, "cloth.resolution": [7, 6]}))
    before = other_scene.state.digest()
    with pytest.raises(ValueError, match=r"another scene: cloth\.resolution is \(6, 7\) there, \(7, 6\) here; restore"):
        other_scene.restore(snapshot)
    assert other_scene.state.digest() == before
    more = Simulation(Scene.from_parameters({**HUNG, "grippers": ["left", "right"]}))
    with pytest.raises(ValueError, match="another scene: grippers is"):
        more.restore(snapshot)


def test_failed_frame_keeps_the_grips_of_the_plan() -> None:
    simulation = Simulation(Scene.from_parameters({**HUNG, "step": 2e-3}))
    run(simulation, carried(HUNG))
    snapshot = simulation.snapshot()
    with pytest.raises(EventError, match="no gripper"):
        simulation.advance([Grasp("gripper", False), Grasp("none", True)])
    after: list[list[Event]] = [[SetParameters({"material.stretch_modulus": 100.0})], []]
    expected = run(simulation, after)
    simulation.restore(snapshot)
    assert run(simulation, after) == expected
