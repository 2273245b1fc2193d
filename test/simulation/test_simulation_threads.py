# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One simulation called by several threads, by a force within a frame, and copied."""

from __future__ import annotations

import copy
import pickle
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Scene, Simulation, Target
from cloth_sim_ros.physics.model.forces.force import Force
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.simulation.events import Grasp, Pause

THREADS, FRAMES = 4, 40
#: A cloth without an anchor whose gripper holds it in the middle.
HELD = {"cloth.resolution": [8, 8], "cloth.anchors": [""], "grippers": ["gripper"]}


@pytest.fixture(autouse=True)
def eager_threads() -> Iterator[None]:
    """Switch threads as often as possible."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


def in_threads(job: Callable[[int], None], count: int = THREADS) -> None:
    """Run a job in several threads at once, and raise the exception of any of them."""
    begin, errors = threading.Barrier(count), list[BaseException]()

    def run(index: int) -> None:
        try:
            begin.wait(20.0)
            job(index)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(index,), daemon=True) for index in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert not any(thread.is_alive() for thread in threads), "a thread waits for ever"
    if errors:
        raise errors[0]


def test_frames_from_several_threads_are_sequential() -> None:
    scene = Scene.from_parameters({"cloth.resolution": [8, 8]})
    alone, shared = Simulation(scene), Simulation(scene)
    expected = {alone.frame: alone.positions}
    for _ in range(THREADS * FRAMES):
        frame = alone.advance()
        expected[frame.index] = alone.positions
    seen: list[tuple[int, Any]] = []

    def go(_: int) -> None:
        for _ in range(FRAMES):
            frame = shared.advance()
            snapshot = shared.snapshot()
            seen.append((frame.index, None))
            seen.append((snapshot.frame, snapshot.positions))
            shared.energy()
            shared.grasped_count(0)

    in_threads(go)
    assert sorted(index for index, positions in seen if positions is None) == list(range(1, THREADS * FRAMES + 1))
    for index, positions in seen:
        if positions is not None:
            np.testing.assert_array_equal(positions, expected[index])
    assert shared.state.digest() == alone.state.digest()


def test_concurrently_read_positions_belong_to_one_frame() -> None:
    # Frames of 0.2 s have several intervals each; the state between intervals is none of the sequence.
    scene = Scene.from_parameters({"cloth.resolution": [8, 8], "rate": 5.0, "tolerance": 1e-5})
    alone, shared = Simulation(scene), Simulation(scene)
    expected = {alone.positions.tobytes(), *((alone.advance(), alone.positions.tobytes())[1] for _ in range(FRAMES))}
    done = threading.Event()

    def go(index: int) -> None:
        if index:
            while not done.is_set():
                assert shared.positions.tobytes() in expected
            return
        for _ in range(FRAMES):
            shared.advance()
        done.set()

    in_threads(go, 2)


def test_events_from_several_threads_are_applied_atomically() -> None:
    scene = Scene.from_parameters(HELD)
    shared = Simulation(scene)
    middle = tuple(shared.positions[27].tolist())
    shared.advance([Target("gripper", middle), Grasp("gripper", True)])
    held = shared.grasped_count(0)
    assert held
    start = shared.snapshot()

    def go(index: int) -> None:
        for k in range(FRAMES):
            if index == 0 and k % 8 == 7:
                shared.restore(start)
            else:
                frame = shared.advance([Grasp("gripper", k % 2 == 0), Pause(False)])
                # Closed or open, by the order of calls: the report fits the result.
                (grasp,) = frame.grasps
                assert grasp.closed == (k % 2 == 0)

    in_threads(go)
    shared.restore(start)
    again = Simulation(scene)
    again.restore(start)
    assert [shared.advance().index for _ in range(5)] == [again.advance().index for _ in range(5)]
    assert shared.state.digest() == again.state.digest()
    assert shared.grasped_count(0) == held


class Calls(Force):
    """A force that calls a function once during its evaluation."""

    name = "calls"

    def __init__(self) -> None:
        self.call: Callable[[], object] | None = None
        self.threads: set[int] = set()

    def add_force(self, t: float, x: Any, v: Any, f: Any) -> None:
        self.threads.add(threading.get_ident())
        if self.call is not None:
            call, self.call = self.call, None
            call()


def with_force(scene: Scene, force: Force) -> Simulation:
    """A simulation with one more force in its plan, as a user's subclass may add it."""
    simulation = Simulation(scene)
    model = simulation.model
    simulation.plan = compile(Model(model.masses, [*model.forces, force], anchors=model.anchors))
    return simulation


@pytest.mark.parametrize("name", ["advance", "snapshot", "restore", "energy", "is_in_equilibrium"])
def test_calls_within_a_frame_are_refused(name: str) -> None:
    force = Calls()
    scene = Scene.from_parameters({"cloth.resolution": [6, 6], "grippers": [""]})
    simulation, plain = with_force(scene, force), with_force(scene, Calls())
    start = simulation.snapshot()
    force.call = lambda: getattr(simulation, name)(*([start] if name == "restore" else []))
    with pytest.raises(RuntimeError, match=rf"Simulation\.{name} was called while another call"):
        simulation.advance()
    # The refusal changes nothing.
    assert simulation.advance().index == plain.advance().index == 1
    assert simulation.state.digest() == plain.state.digest()


def test_positions_may_be_read_by_a_force() -> None:
    force, read = Calls(), []
    simulation = with_force(Scene.from_parameters({"cloth.resolution": [6, 6], "grippers": [""]}), force)
    force.call = lambda: read.append(simulation.positions)
    simulation.advance()
    assert read[0].shape == (36, 3)


def test_failed_call_releases_the_lock() -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [4, 4]}))
    with pytest.raises(ValueError, match="no gripper 'nobody'"):
        simulation.advance([Grasp("nobody", True)])
    in_threads(lambda _: simulation.advance() and None)
    assert simulation.frame == THREADS


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_simulation_is_not_copied(again: Callable[[Any], Any]) -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [4, 4], "contact.self": True}))
    with pytest.raises(TypeError, match=r"restore this one's snapshot\(\)"):
        again(simulation)
    # Objects that use the same memory are not copied either.
    for part in (simulation.plan, simulation.plan.contact, PlanHandle(simulation.model)):
        with pytest.raises(TypeError, match="memory of the engine"):
            again(part)


def test_a_copied_state_is_independent() -> None:
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [4, 4]}))
    twin = copy.copy(simulation.state)
    before = twin.digest()
    simulation.advance([Target("gripper", (0.0, 0.0, 1.0))])
    assert twin.digest() == before != simulation.state.digest()
    assert isinstance(twin, State)
    twin.memory["paused"][0] = True
    twin.x[2] += 1.0
    assert not simulation.paused
