# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sleep of a sheet at rest: it wakes at once on events and runs again bit for bit."""

import numpy as np
import pytest
from support.bounded_loops import rounds_until

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation import sleep
from cloth_sim_ros.simulation.energy_watch import EnergyWatch
from cloth_sim_ros.simulation.events import Grasp, Pause, Reset, SetParameters, Step, Target
from cloth_sim_ros.simulation.simulation import Simulation

# Strong drag and little weight bring the sheet to rest within seconds.
CALM = {
    "cloth.resolution": [5, 6],
    "material.stretch_modulus": 100.0,
    "material.shear_modulus": 20.0,
    "air.drag": 5.0,
    "tolerance": 1e-3,
    "rate": 30.0,
    "grippers": ["left", "right"],
}


def simulation(**values):
    return Simulation(Scene.from_parameters({**CALM, **{name.replace("__", "."): v for name, v in values.items()}}))


def until_asleep(moving, events=(), most=600):
    """Advance until the sheet sleeps; return the last frame."""
    frame = moving.advance(events)
    for _ in rounds_until(lambda: moving.asleep, most):
        frame = moving.advance()
    return frame


@pytest.fixture(scope="module")
def snapshot():
    """A state that sleeps, as bytes."""
    sleeping = simulation()
    until_asleep(sleeping)
    return sleeping.state.to_bytes()


@pytest.fixture
def sleeping(snapshot):
    return Simulation(Scene.from_parameters(CALM), State.from_bytes(snapshot))


def test_resting_sheet_sleeps_and_frames_continue(sleeping):
    before, frame_before = sleeping.positions, sleeping.frame
    frames = [sleeping.advance() for _ in range(5)]
    assert [frame.index for frame in frames] == [frame_before + k for k in range(1, 6)]
    assert frames[-1].time == sleeping.frame / 30.0
    assert all(frame.moved and frame.advance.steps == 0 for frame in frames)
    assert "asleep" in frames[-1].advance.reason
    assert np.array_equal(sleeping.positions, before)
    assert not sleeping.velocities.any()


def test_motion_omitted_by_sleep_is_below_tolerance(snapshot):
    asleep = State.from_bytes(snapshot)
    moving = Simulation(Scene.from_parameters({**CALM, "tolerance": 1e-9}), asleep)
    for _ in range(20 * 30):
        moving.advance()
    away = np.linalg.norm(moving.positions - asleep.positions, axis=1).max()
    assert 1e-12 < away < 0.2 * CALM["tolerance"]


def test_falling_asleep_is_continuous():
    moving = simulation()
    for _ in rounds_until(lambda: moving.asleep):
        before, speeds = moving.positions, np.linalg.norm(moving.velocities, axis=1)
        moving.advance()
    step = np.linalg.norm(moving.positions - before, axis=1).max()
    assert step <= 1.1 * (speeds.max() / 30.0) + 1e-12


@pytest.mark.parametrize(
    "events",
    [
        [Target("left", (0.0, 0.0, 0.5)), Grasp("left", True)],
        [SetParameters({"gravity": [0.0, 1.0, -9.81]})],
        [SetParameters({"diagnostics.energy": True})],
        [Reset()],
    ],
    ids=["grasp", "gravity", "any parameter", "reset"],
)
def test_sheet_wakes_in_the_frame_of_the_event(sleeping, events):
    low = sleeping.positions[-1]
    events = [Target("left", low) if isinstance(event, Target) else event for event in events]
    before = sleeping.positions
    frame = sleeping.advance(events)
    assert not sleeping.asleep
    assert frame.advance.steps > 0
    if not isinstance(events[0], Reset):
        # It continues from exactly the same position.
        assert np.linalg.norm(sleeping.positions - before, axis=1).max() < 0.5 * 1.1 / 30.0**2


def test_unrelated_events_do_not_wake_the_sheet(sleeping):
    for events in (
        [Target("left", (5.0, 0.0, 0.0)), Target("right", (0.0, 6.0, 0.0), (0.0, 0.0, 1.0, 1.0))],
        [Target("left", (4.0, 0.0, 0.0))],
        [Grasp("right", True)],
        [Grasp("right", False)],
        [Pause(True)],
    ):
        sleeping.advance(events)
        assert sleeping.asleep
    assert sleeping.grippers.poses()[0, 0] == 4.0, "grippers move on meanwhile"
    frame = sleeping.frame
    sleeping.advance()
    assert sleeping.frame == frame, "paused"
    sleeping.advance([Step()])
    assert (sleeping.frame, sleeping.asleep) == (frame + 1, True)
    sleeping.advance([Pause(False)])
    assert sleeping.advance().index == frame + 3


def test_sleeping_sheet_pulls_and_wakes_when_gripper_moves(sleeping):
    low = sleeping.positions[-1]
    sleeping.advance([Target("left", low), Grasp("left", True)])
    for k in range(30):
        sleeping.advance([Target("left", low + np.array([0.0, 0.0, 0.1]) * (k + 1) / 30)])
    target = Target("left", low + np.array([0.0, 0.0, 0.1]))
    last = until_asleep(sleeping, [target])
    asleep = sleeping.advance()
    assert asleep.advance.steps == 0
    assert np.linalg.norm(last.wrenches[0, :3]) > 1e-3
    assert asleep.wrenches == pytest.approx(last.wrenches, abs=2e-4 * np.abs(last.wrenches).max())
    assert np.array_equal(sleeping.advance().wrenches, asleep.wrenches)
    assert np.array_equal(sleeping.advance([target]).wrenches, asleep.wrenches)
    assert sleeping.asleep, "the same target again moves nothing"
    sleeping.advance([Target("left", low + np.array([0.0, 0.0, 0.1001]))])
    assert not sleeping.asleep
    until_asleep(sleeping)
    sleeping.advance([Grasp("left", False)])
    assert not sleeping.asleep, "it was let go"


def test_a_run_goes_on_from_any_snapshot_to_the_last_bit(snapshot):
    # Before sleep, during the watch for rest, asleep, and awake again.
    original = Simulation(Scene.from_parameters(CALM), State.from_bytes(snapshot))
    low = original.positions[-1]
    script = {3: [Target("left", low), Grasp("left", True)], 4: [Target("left", low + 0.001)]}
    saved, digests, wrenches = [], [], []
    for k in range(200):
        frame = original.advance(script.get(k, ()))
        digests.append(original.state.digest())
        wrenches.append(frame.wrenches)
        saved.append(original.state.to_bytes())
    assert original.asleep
    fell = next(k for k in range(199, 0, -1) if not sleep.is_asleep(State.from_bytes(saved[k])))
    for start in (0, 2, 4, fell + 10, 197):
        again = Simulation(Scene.from_parameters(CALM), State.from_bytes(saved[start]))
        for k in range(start + 1, min(start + 60, 200)):
            frame = again.advance(script.get(k, ()))
            assert again.state.digest() == digests[k], (start, k)
            assert np.array_equal(frame.wrenches, wrenches[k]), (start, k)


def test_a_state_that_slept_under_another_scene_wakes(snapshot):
    for change in ({"gravity": [0.0, 2.0, -9.81]}, {"tolerance": 1e-7}, {"tolerance": 0.0}, {"step": 1e-3}):
        restored = Simulation(Scene.from_parameters({**CALM, **change}), State.from_bytes(snapshot))
        assert restored.advance().advance.steps > 0, change
        assert not restored.asleep


def test_a_state_loaded_by_the_scene_starts_awake(snapshot):
    files = {"rest.npz": snapshot}
    scene = Scene.from_parameters({**CALM, "initial_state": "rest.npz"}, files=files)
    loaded = Simulation(scene)
    assert not loaded.asleep
    assert loaded.advance().advance.steps > 0
    until_asleep(loaded)
    loaded.advance([Reset()])
    assert not loaded.asleep


@pytest.mark.parametrize("change", [{"tolerance": 0.0}, {"step": 2e-3}])
def test_without_a_tolerance_nothing_sleeps(change, snapshot):
    state = State.from_bytes(snapshot)
    sleep.wake(state)
    watched = Simulation(Scene.from_parameters({**CALM, **change}), state)
    for _ in range(90):
        watched.advance()
    assert not watched.asleep


def test_turning_point_does_not_count_as_rest():
    # Every particle is at rest simultaneously, as at a turning point, and accelerated.
    scene = Scene.from_parameters({**CALM, "rate": 1000.0})
    rule = sleep.SleepRule(scene.plan(), tolerance=1e-3, period=1e-3)
    state = scene.starting_state()
    for _ in range(1002):
        # As if it had been there for a second.
        assert not rule.update(state, 0.0)
    assert not sleep.is_asleep(state)


def test_undamped_motion_does_not_sleep():
    # A free sheet without weight or air moves slowly for ever.
    still = {"gravity": [0.0, 0.0, 0.0], "wind.normal_drag": 0.0}
    free = {**CALM, **still, "cloth.anchors": [""], "grippers": [""]}
    for drag, falls in ((0.0, False), (5.0, True)):
        scene = Scene.from_parameters({**free, "air.drag": drag})
        start = scene.starting_state()
        start.v[1] = 5e-5
        drifting = Simulation(scene, start)
        for _ in range(900):
            drifting.advance()
        assert drifting.asleep is falls
        # Regardless of the time asleep.
        displacement = 5e-5 * (30.0 if not drag else 1.0 / drag)
        assert drifting.positions[:, 1] - start.x[1] == pytest.approx(displacement, abs=0.25 * CALM["tolerance"])


def free_sheet(wind, files=None, **values):
    """A free sheet without weight in a wind along y [m/s] that only its drag feels."""
    still = {"gravity": [0.0, 0.0, 0.0], "wind.normal_drag": 0.0, "cloth.anchors": [""], "grippers": [""]}
    return Scene.from_parameters(
        {**CALM, **still, "air.drag": 1e-3, "wind.velocity": [0.0, wind, 0.0], **values}, files=files
    )


@pytest.mark.parametrize("wind", [0.001, 0.01, 0.05])
def test_sleep_keeps_the_impulse_of_a_weak_wind(wind):
    # With drag c the velocity is wind (1 - exp(-c t)), asleep or not.
    scene, seconds = free_sheet(wind), 60.0
    drifting, slept = Simulation(scene), 0
    start = drifting.positions
    for _ in range(round(seconds * 30)):
        drifting.advance()
        slept += drifting.asleep
    exact = wind * (seconds + np.expm1(-1e-3 * seconds) / 1e-3)
    assert slept > 0 or wind == 0.05
    assert drifting.positions[:, 1] - start[:, 1] == pytest.approx(exact, abs=0.25 * CALM["tolerance"])


def test_event_during_sleep_wakes_with_the_impulse_so_far():
    drifting = Simulation(free_sheet(1e-3))
    until_asleep(drifting)
    for _ in range(20):
        drifting.advance()
    assert drifting.asleep
    t = drifting.time
    drifting.advance([SetParameters({"diagnostics.energy": True})])
    assert drifting.velocities[:, 1] == pytest.approx(-1e-3 * np.expm1(-1e-3 * (t + 1.0 / 30.0)), rel=0.01)


def test_loaded_state_wakes_with_the_impulse_so_far():
    drifting = Simulation(free_sheet(1e-3))
    until_asleep(drifting)
    drifting.advance()
    files = {"asleep.npz": drifting.state.to_bytes()}
    loaded = Simulation(free_sheet(1e-3, files, initial_state="asleep.npz"))
    assert loaded.velocities[:, 1] == pytest.approx(-1e-3 * np.expm1(-1e-3 * drifting.time), rel=0.02)


def test_sheet_without_forces_sleeps_after_a_second():
    still = simulation(gravity=[0.0, 0.0, 0.0], air__drag=0.0, wind__normal_drag=0.0)
    for _ in range(31):
        assert not still.asleep
        still.advance()
    assert still.asleep


def test_energy_report_includes_kinetic_energy_lost_to_sleep():
    watched = simulation(**{"diagnostics.energy": True})
    until_asleep(watched)
    report = watched.energy_report
    assert report.total == pytest.approx(watched.energy(), rel=1e-9)
    watched.advance()
    assert watched.energy_report == report
    watch = EnergyWatch(watched.plan)
    moving = watched.state.copy()
    moving.v[0] = 3.0
    kinetic = 4.5 * watched.model.masses.sum()
    stopped = watch.add_sleep_loss(moving)
    assert (stopped.total, stopped.dissipated, stopped.residual) == pytest.approx((-kinetic, kinetic, 0.0), rel=1e-12)


def test_invalid_sleep_memory_is_refused(snapshot):
    state = State.from_bytes(snapshot)
    state.memory["control.sleep"] = np.zeros(3)
    with pytest.raises(ValueError, match=r"memory 'control.sleep' is of type float64 and shape \(3,\); .* \(5,\)"):
        State.from_bytes(state.to_bytes())
    del state.memory["control.sleep"]
    with pytest.raises(ValueError, match=r"memory 'control\.sleep' is missing; a state that sleeps has it"):
        State.from_bytes(state.to_bytes())
