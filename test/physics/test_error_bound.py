# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error bound on small problems that a search found, against exact solutions and an independent integrator."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.simulate import simulate
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.independent_integrator import dop853
from cloth_sim_ros.verify.reference_integrator import MotionState, integrate_intervals
from cloth_sim_ros.verify.reference_motion import Equations, FrameCapture, ReferenceMotion, SimulatedFrame

GRAVITY = np.array([0.0, 0.0, -9.81])
TIMES = np.arange(1, 61) / 60.0
#: Parameters of a scene of raw springs without air.
SPRINGS = {
    "cloth.springs": "springs.yaml",
    "cloth.anchors": ["0"],
    "cloth.size": [1.0, 1e-6],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "bending.model": "none",
    "air.drag": 0.0,
    "wind.normal_drag": 0.0,
    "grippers": [""],
}


def positions_of_one_second(model: Model, state: State, tolerance: float) -> Array:
    """Return positions (60, n, 3) [m], saved at 60 Hz; no frame may be flagged."""
    motion = simulate(model, state, 1.0, save_at=TIMES, tolerance=tolerance)
    assert not any(advance.flagged for advance in motion.advances)
    return motion.positions


@pytest.mark.parametrize("tolerance", [1e-6, 1e-9])
@pytest.mark.parametrize("drag", [0.3, 1.0, 3.0])
def test_falling_particle_is_within_tolerance(drag: float, tolerance: float) -> None:
    state = State(np.zeros((1, 3)))
    positions = positions_of_one_second(Model([1.0], [Gravity(GRAVITY), Drag(drag)]), state, tolerance)
    times = TIMES[:, None]
    exact = GRAVITY / drag * (times + np.expm1(-drag * times) / drag)
    # The amplification of a perturbation is 1.
    assert np.linalg.norm(positions[:, 0] - exact, axis=1).max() <= tolerance


def test_stiff_and_soft_joints_are_within_tolerance() -> None:
    from scipy.linalg import expm

    tolerance, masses = 1e-8, np.array([0.017, 0.5])
    stiff, soft = 2400.0, 0.8
    # k_d0 1.8: the lecture's mass of a joint with one fixed end is that of the other, else twice the reduced mass.
    stiff_damping = 1.8 * (masses[0] * stiff) ** 0.5
    soft_damping = 1.8 * (2.0 * masses.prod() / masses.sum() * soft) ** 0.5
    joints = PairSprings([[0, 1], [1, 2]], 0.0, [stiff, soft], [stiff_damping, soft_damping])
    model = Model([0.004, *masses], [joints, Gravity(GRAVITY)], anchors=[0])
    start = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.1], [0.0, 0.0, -0.2]])
    positions = positions_of_one_second(model, State(start), tolerance)
    # State: two heights, two velocities, and 1.
    matrix = np.zeros((5, 5))
    matrix[:2, 2:4] = np.eye(2)
    for columns, a, b in ((slice(0, 2), stiff, soft), (slice(2, 4), stiff_damping, soft_damping)):
        matrix[2:4, columns] = -np.array([[a + b, -b], [-b, b]]) / masses[:, None]
    matrix[2:4, 4] = GRAVITY[2]
    propagators = [expm(matrix * time) for time in TIMES]
    exact = np.array([propagator @ [*start[1:, 2], 0.0, 0.0, 1.0] for propagator in propagators])[:, :2]
    growth = max(np.abs(block).sum(axis=1).max() for p in propagators for block in (p[:2, :2], p[:2, 2:4]))
    assert 1.0 < growth < 1.1
    assert np.abs(positions[:, 1:, 2] - exact).max() <= tolerance * growth


def test_hung_sheet_is_within_tolerance() -> None:
    tolerance = 2.54e-5
    parameters = {
        "rate": 74.0,
        "tolerance": tolerance,
        "cloth.resolution": [2, 2],
        "cloth.size": [6.26, 1.104],
        "cloth.shear_layout": "alternating",
        "cloth.anchors": ["top"],
        "material.stretch_modulus": 25.94,
        "material.shear_modulus": 0.6623,
        "material.density": 2.78,
        "material.damping": 1.516,
        "air.drag": 0.0264,
        "wind.normal_drag": 0.0,
        "bending.model": "none",
        "grippers": [""],
    }
    scene = Scene.from_parameters(parameters)
    simulation, plan = Simulation(scene), scene.plan()
    x, zeros = simulation.state.x.copy(), np.zeros_like(simulation.state.x)
    error, growth, size = 0.0, 1.0, 1e-7
    fields = np.random.default_rng(1).normal(size=(2, *x.shape)) * (plan.model.inverse_masses > 0.0)
    fields /= np.linalg.norm(fields, axis=1).max(axis=1)[:, None, None]
    exact = MotionState(x, zeros)
    perturbed = [exact._replace(x=x + size * fields[0]), exact._replace(v=size * fields[1])]
    for frame in range(74):
        advance = simulation.advance().advance
        assert advance is not None
        assert not advance.flagged
        span = (frame * scene.period, scene.period)
        exact, *perturbed = (
            dop853(plan, *span, motion, relative_tolerance=1e-11, absolute_tolerance=1e-12)
            for motion in (exact, *perturbed)
        )
        error = max(error, np.linalg.norm(simulation.state.x - exact.x, axis=0).max())
        growth = max(growth, *(np.linalg.norm(motion.x - exact.x, axis=0).max() / size for motion in perturbed))
    assert error <= tolerance * growth


def error_of_fall(plan: Plan, state: State, tolerance: float, rate: int, gravity: Array, particles: slice) -> float:
    """Return the largest error of the mean position of a falling sheet within a second [m]; no frame may be flagged."""
    integrator, motions = make_integrator("auto", tolerance=tolerance, work=10.0), list[Array]()
    for frame in range(int(2.6 * rate)):
        motions.append(np.array([state.x[:, particles].mean(axis=1), state.v[:, particles].mean(axis=1)]))
        assert not integrator.advance(plan, state, frame / rate, 1.0 / rate).flagged
    times = np.arange(1, rate + 1)[:, None] / rate
    return max(
        float(np.linalg.norm(x + times * v + 0.5 * times**2 * gravity - after, axis=1).max())
        for first, (x, v) in enumerate(motions[:-rate])
        for after in [np.array(motions)[first + 1 : first + 1 + rate, 0]]
    )


def test_falling_sheet_in_single_precision_is_within_tolerance() -> None:
    # Found by a climb. Each step rounds the velocities of all particles alike, by more when the sheet falls than when
    # it was measured.
    tolerance, rate, pull = 2.815579652655301e-4, 36, 2.9058365472679952
    parameters = {
        "rate": float(rate),
        "tolerance": tolerance,
        "cloth.resolution": [8, 8],
        "cloth.size": [0.022183315186968287] * 2,
        "cloth.anchors": [""],
        "material.stretch_modulus": 727.1166837028743,
        "material.shear_modulus": 363.55834185143715,
        "material.density": 0.11185364958191946,
        "material.damping": 0.5,
        "air.drag": 0.0,
        "wind.normal_drag": 0.0,
        "bending.model": "none",
        "grippers": [""],
        "gravity": [0.0, 0.0, -pull],
    }
    scene = Scene.from_parameters(parameters)
    state = scene.starting_state()
    state.v = state.v + np.array([[3.1185585478599784], [0.0], [0.5284108454457472]])
    gravity = np.array([0.0, 0.0, -pull])
    # A common perturbation does not grow.
    assert error_of_fall(scene.plan(), state, tolerance, rate, gravity, slice(None)) <= tolerance


def test_sheet_that_falls_beside_an_anchor_is_within_tolerance() -> None:
    # Found by a climb. An anchor that holds nothing made the measured mean of rounding smaller.
    tolerance, rate, spacing, stiffness, mass = 2.64e-4, 39, 0.125 / 7.0, 4820.0, 0.2 * 0.125**2 / 64
    places = [(i, j) for i in range(8) for j in range(8)]
    pairs = [(8 * i + j, 8 * k + m) for i, j in places for k, m in ((i + 1, j), (i, j + 1)) if k < 8 and m < 8]
    positions = np.array([*((spacing * i, spacing * j, 0.0) for i, j in places), (0.0, 0.0, 1.0)])
    velocities = np.array([*[(22.8, 0.0, 1.67)] * 64, (0.0, 0.0, 0.0)])
    springs = PairSprings(pairs, spacing, stiffness, 0.5 * (stiffness * mass) ** 0.5)
    gravity = np.array([0.0, 0.0, -3.53])
    plan = compile(Model([*[mass] * 64, 1.0], [springs, Gravity(gravity)], anchors=[64]))
    # A common perturbation does not grow.
    assert error_of_fall(plan, State(positions, velocities), tolerance, rate, gravity, slice(64)) <= tolerance


@pytest.mark.parametrize(("tolerance", "rest_length"), [(1e-4, 0.1), (1e-5, 0.5)])
def test_spring_thrown_past_its_anchor_is_within_tolerance(tolerance: float, rest_length: float) -> None:
    from scipy.integrate import solve_ivp

    # Calm flight for three quarters of a second, then past the anchor at a distance of 0.1 mm.
    omega2, start = 1.0, np.array([-0.75, 1e-4, 0.0])
    velocity = np.array([1.0, 0.0, 0.0])
    model = Model([1.0, 1.0], [PairSprings([[0, 1]], rest_length, omega2 * rest_length)], anchors=[0])
    state = State(np.array([np.zeros(3), start]), np.array([np.zeros(3), velocity]))

    def derivative(_t: float, y: Array) -> Array:
        length = np.linalg.norm(y[:3])
        return np.concatenate([y[3:], -omega2 * (1.0 - rest_length / length) * y[:3]])

    def integrate(position: Array, local_error: float) -> Array:
        accuracy = {"rtol": local_error, "atol": local_error, "t_eval": TIMES}
        return np.asarray(solve_ivp(derivative, (0.0, 1.0), [*position, *velocity], "DOP853", **accuracy).y[:3].T)

    exact = integrate(start, 1e-12)
    assert np.abs(exact - integrate(start, 1e-11)).max() < 1e-8
    perturbations = 1e-7 * np.eye(3)
    growth = max(np.linalg.norm(integrate(start + p, 1e-12) - exact, axis=1).max() / 1e-7 for p in perturbations)
    positions = positions_of_one_second(model, state, tolerance)
    assert np.linalg.norm(positions[:, 1] - exact, axis=1).max() <= tolerance * max(1.0, growth)


def test_damped_joint_in_few_steps_is_within_tolerance() -> None:
    from scipy.linalg import expm

    # Found by a climb. The estimate of a run of two steps was small by chance.
    tolerance, rate, mass, stiffness = 3.3535172e-3, 32, 9.3274624e-3, 22.4403151
    damping = 0.18708512
    joint = PairSprings([[0, 1]], 0.0, stiffness, damping)
    plan = compile(Model([0.171712506, mass], [joint, Gravity(GRAVITY)], anchors=[0]))
    state = State(np.array([[0.0, 0.0, 0.0], [0.198716731, 0.0, 0.005802738]]))
    matrix = np.zeros((3, 3))
    matrix[0, 1], matrix[1, :2], matrix[1, 2] = 1.0, (-stiffness / mass, -damping / mass), 1.0
    # One column for each axis: position, velocity, gravity.
    exact = np.array([state.x[:, 1], np.zeros(3), GRAVITY])
    integrator, error = make_integrator("auto", tolerance=tolerance, work=10.0), 0.0
    for frame in range(rate):
        assert not integrator.advance(plan, state, frame / rate, 1.0 / rate).flagged
        exact = expm(matrix / rate) @ exact
        error = max(error, np.linalg.norm(state.x[:, 1] - exact[0]))
    # A perturbation of a damped oscillator does not grow.
    assert error <= tolerance


@pytest.mark.parametrize(
    ("rate", "start", "speed", "rest_length", "stiffness", "tolerance"),
    [
        # Found by climbs. The end passes the anchor in a frame of two runs without an estimate, in the last half step
        # of its first piece; or within its second piece.
        (119, (-1.653, 1.094e-4, 0.0), 1.54, 0.04564, 2.059, 2.558e-8),
        (91, (-6.50578, 8.45947e-5, 0.0), 4.81179, 0.0476218, 2.72554, 3.36526e-8),
        # The end passes the anchor after the last force of a frame of a single run.
        (29, (-4.694, 5.391e-4, 0.0), 3.563, 0.1084, 0.4957, 1.086e-3),
        # The spring begins to turn at the end of a frame of a single run without an estimate.
        (102, (-0.53994415, 3.15507984e-3, 0.0), 0.998264014, 0.0192200358, 4.1424425685e-3, 1.93259839e-8),
    ],
)
def test_thrown_spring_between_estimates_is_within_tolerance(
    rate: int, start: tuple[float, ...], speed: float, rest_length: float, stiffness: float, tolerance: float
) -> None:
    from scipy.integrate import solve_ivp

    period, omega2 = 1.0 / rate, stiffness / rest_length
    times = period * np.arange(1, rate + 1)
    plan = compile(Model([1.0, 1.0], [PairSprings([[0, 1]], rest_length, stiffness)], anchors=[0]))
    state = State(np.array([np.zeros(3), start]), np.array([np.zeros(3), [speed, 0.0, 0.0]]))

    def derivative(_t: float, y: Array) -> Array:
        length = np.linalg.norm(y[:3])
        return np.concatenate([y[3:], -omega2 * (1.0 - rest_length / length) * y[:3]])

    def integrate(motion: Array) -> Array:
        accuracy = {"rtol": 1e-13, "atol": 1e-13, "t_eval": times, "max_step": 2e-3}
        return np.asarray(solve_ivp(derivative, (0.0, times[-1]), motion, "DOP853", **accuracy).y[:3].T)

    integrator, motions = make_integrator("auto", tolerance=tolerance, work=10.0), list[Array]()
    for frame in range(int(1.5 * rate)):
        motions.append(np.concatenate([state.x[:, 1], state.v[:, 1]]))
        assert not integrator.advance(plan, state, frame * period, period).flagged
    motions.append(np.concatenate([state.x[:, 1], state.v[:, 1]]))
    size = 1e-8
    for first in (0, rate // 2):
        exact = integrate(motions[first])
        perturbed = [integrate(motions[first] + size * axis) for axis in np.eye(6)[:3]]
        growth = max(1.0, max(np.linalg.norm(motion - exact, axis=1).max() for motion in perturbed) / size)
        errors = exact - np.array(motions[first + 1 : first + 1 + rate])[:, :3]
        assert np.linalg.norm(errors, axis=1).max() <= tolerance * growth


@pytest.mark.parametrize(
    ("tolerance", "rate", "swing", "speed", "joint", "stiffness", "damping", "jump", "stride", "twist"),
    [
        # Found by climbs. A swing hides the gripper from the activity of a single run: it moves within one frame and
        # stops.
        (2e-4, 40, 1.0, 8.0, 0.25, 0.25, 1.0, 0.004, 2, 0.0),
        (2e-4, 40, 1.0, 8.0, 0.25, 0.25, 1.0, 0.004, 4, 0.0),
        # The swing hides it from the change by the second of combined runs, which gains much more on a smooth motion.
        (5.457e-8, 53, 10.61, 5.403, 0.01739, 1.228, 1.547, 2.599e-3, 3, 0.0),
        (3.263e-7, 31, 24.59, 1.337, 1.705, 1.236, 1.879, 3.643e-3, 3, 0.0),
        (4.294e-7, 81, 1.003, 0.7155, 6.588, 7.557, 0.3092, 0.02871, 3, 0.0),
        # A twist about the axis on which the particle lies has no effect, and hides the jumps from single and combined
        # runs.
        (2e-4, 40, 1.0, 8.0, 0.25, 0.25, 1.0, 0.004, 4, 0.1),
        (3.263e-7, 31, 24.59, 1.337, 1.705, 1.236, 1.879, 1.8215e-3, 2, 7.286e-3),
    ],
)
def test_gripper_jump_between_estimates_is_within_tolerance(
    tolerance: float,
    rate: int,
    swing: float,
    speed: float,
    joint: float,
    stiffness: float,
    damping: float,
    jump: float,
    stride: int,
    twist: float,
) -> None:
    from scipy.linalg import expm

    period, grips, reach, angle = 1.0 / rate, Grips(1), 0.3, 0.0
    plan = compile(Model(np.ones(3), [PairSprings([[0, 1], [0, 2]], 0.0, [swing, joint]), grips], anchors=[0]))
    state = State(np.zeros((3, 3)), np.array([np.zeros(3), [0.0, speed, 0.0], np.zeros(3)]))
    path = np.zeros((1, PATH_NUMBERS))
    path[0, 3], path[0, 16] = -reach, 1.0
    offsets = np.array([[0.0, 0.0, reach]])
    grips.set_grips(path, np.array([0, 1]), np.array([2]), offsets, np.array([stiffness]), np.array([damping]))
    # State: the particle's position and velocity; 1, s, s^2, s^3 with the time s in the frame.
    matrix = np.zeros((6, 6))
    matrix[0, 1], matrix[1, :2] = 1.0, (-joint - stiffness, -damping)
    matrix[[3, 4, 5], [2, 3, 4]] = 1.0, 2.0, 3.0
    integrator, motion, target, error = make_integrator("auto", tolerance=tolerance, work=10.0), np.zeros(2), 0.0, 0.0
    for frame in range(rate):
        has_jump = frame >= 3 and (frame - 3) % stride == 0
        cubic = jump / period**2 * np.array([3.0, -2.0 / period]) if has_jump else np.zeros(2)
        path = path.copy()
        path[0, 0], path[0, 1], path[0, [7, 10]] = frame * period, target, cubic
        path[0, 15:17] = np.sin(0.5 * angle), np.cos(0.5 * angle)
        turn = 0.0 if has_jump else twist - 2.0 * angle
        path[0, [22, 25]] = turn / period**2 * np.array([3.0, -2.0 / period])
        angle += turn
        grips.set_paths(path)
        assert not integrator.advance(plan, state, frame * period, period).flagged
        position, rates = np.array([target, 0.0, *cubic]), np.array([0.0, 2.0 * cubic[0], 3.0 * cubic[1], 0.0])
        matrix[1, 2:] = stiffness * position + damping * rates
        motion = (expm(period * matrix) @ [*motion, 1.0, 0.0, 0.0, 0.0])[:2]
        target += jump if has_jump else 0.0
        error = max(error, abs(state.x[0, 2] - motion[0]))
    # A perturbation of a damped oscillator does not grow.
    assert error <= tolerance


@pytest.mark.parametrize("jump", [0.1, 0.2])
def test_gripper_jump_in_implicit_steps_is_within_tolerance(jump: float) -> None:
    from scipy.linalg import expm

    # The implicit method integrates the time-dependent force by two points, which leaves an error of the velocity. A
    # stiff pair beside it makes explicit steps too expensive, and its accelerations are rounding.
    tolerance, rate, joint, stiffness, mass = 1e-3, 40, 0.25, 4.0, 1e-6
    period, stiff, grips = 1.0 / rate, 1e18 * mass, Grips(1)
    springs = PairSprings([[0, 1], [2, 3]], [0.0, 1.0], [joint, stiff], [0.0, (stiff * mass) ** 0.5])
    plan = compile(Model([1.0, 1.0, 1.0, mass], [springs, grips], anchors=[0, 2]))
    state = State(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    path = np.zeros((1, PATH_NUMBERS))
    path[0, 16] = 1.0
    grips.set_grips(path, np.array([0, 1]), np.array([1]), np.zeros((1, 3)), np.array([stiffness]), np.zeros(1))
    # State: the particle's position and velocity; 1, s, s^2, s^3 with the time s in the frame.
    matrix = np.zeros((6, 6))
    matrix[0, 1], matrix[1, 0] = 1.0, -joint - stiffness
    matrix[[3, 4, 5], [2, 3, 4]] = 1.0, 2.0, 3.0
    integrator, motion, target, error = make_integrator("auto", tolerance=tolerance, work=10.0), np.zeros(2), 0.0, 0.0
    for frame in range(rate):
        has_jump = frame >= 3 and frame % 2 == 1
        cubic = jump / period**2 * np.array([3.0, -2.0 / period]) if has_jump else np.zeros(2)
        path = path.copy()
        path[0, 0], path[0, 1], path[0, [7, 10]] = frame * period, target, cubic
        grips.set_paths(path)
        advance = integrator.advance(plan, state, frame * period, period)
        assert advance.integrator == "implicit"
        assert not advance.flagged
        matrix[1, 2:] = stiffness * np.array([target, 0.0, *cubic])
        motion = (expm(period * matrix) @ [*motion, 1.0, 0.0, 0.0, 0.0])[:2]
        target += jump if has_jump else 0.0
        error = max(error, abs(state.x[0, 1] - motion[0]))
    # A perturbation of an oscillator faster than 1 / s does not grow.
    assert error <= tolerance


@pytest.mark.parametrize(("stiffness", "tolerance"), [(10.0, 1e-5), (100.0, 1e-4)])
def test_accelerated_grip_in_implicit_steps_is_within_tolerance(stiffness: float, tolerance: float) -> None:
    # The particle keeps its distance from a gripper of constant acceleration. The derivatives of its motion above the
    # second vanish, but the method's first stage is off, and forces by that change the velocity.
    acceleration, rate, grips = 10.0, 40, Grips(1)
    period, offset = 1.0 / rate, -acceleration / stiffness
    plan, state = compile(Model([1.0], [grips])), State(np.array([[offset, 0.0, 0.0]]))
    path = np.zeros((1, PATH_NUMBERS))
    path[0, [7, 16]] = 0.5 * acceleration, 1.0
    grips.set_grips(path, np.array([0, 1]), np.array([0]), np.zeros((1, 3)), np.array([stiffness]), np.zeros(1))
    integrator, error = make_integrator("implicit", tolerance=tolerance), 0.0
    for frame in range(rate):
        t, end = frame * period, (frame + 1) * period
        path = path.copy()
        path[0, [0, 1, 4]] = t, 0.5 * acceleration * t * t, acceleration * t
        grips.set_paths(path)
        assert not integrator.advance(plan, state, t, period).flagged
        error = max(error, abs(state.x[0, 0] - offset - 0.5 * acceleration * end * end))
    # A perturbation of an oscillator faster than 1 / s does not grow.
    assert error <= tolerance


@pytest.mark.parametrize(
    ("rate", "stride", "travel", "friction", "swing", "speed", "joint", "slip", "tolerance", "growth"),
    [
        # Found by searches. The table turns round in a frame without an estimate, or at the ends of all frames.
        (57.0, 4, 2.6628239709891475e-3, 0.1149948679378981, 4.180505429, 6.749774132600399, 1.0, None, 1.034e-4, 1.0),
        (44.0, 1, 2.32317176821796e-3, 0.031434493120616934, 4.068552679, 11.24795623818855, 0.05, None, 5.83e-5, 3.6),
        # It moves on under a sliding particle. All runs sample jumps of friction alike, at 2/5 and 3/5 of a frame.
        (60.0, 2, 0.019118502, 0.0555445227, 5.584202597, 8.915892898, 0.02, 1.5045055459, 3.6869766e-5, 6.1),
        # It moves on in jumps. A particle that stopped vibrates along it, faster than steps resolve.
        (68.0, 3, 0.01964, 0.0905, 3.0165, 7.4, 0.0287, 0.0, 3.04e-5, 1.0),
        # It stops at the end of a frame. Its anchor is then wrong, and its vibration while the next jump begins.
        (84.0, 3, 0.0402225, 0.145197315, 4.58589184, 3.0412247, 0.0287, 0.0, 2.15341396e-5, 1.14),
        # It overtakes a sliding particle within a frame. Two runs, or three, hardly differ by chance.
        (49.0, 2, 0.0171234, 8.449675156e-3, 3.798171774, 5.912325197, 5.9521157e-3, 0.7482, 5.77285345e-5, 1.0),
        (38.0, 2, 0.053825, 7.8177874849e-3, 6.372548596, 9.052114569, 8.203978893e-3, 2.481, 2.8353183e-4, 1.0),
    ],
)
def test_particle_on_a_shaken_table_is_within_tolerance(
    rate: float,
    stride: int,
    travel: float,
    friction: float,
    swing: float,
    speed: float,
    joint: float,
    slip: float | None,
    tolerance: float,
    growth: float,
) -> None:
    # Another particle swings above and hides the friction from the activity.
    thickness, settled = 5e-3, 44
    springs = {
        "positions": [[0.0, 0.0, 2.0], [0.0, 0.0, 2.0 - 9.81 / swing**2], [1.0, 0.0, 0.98 * thickness]],
        "velocities": [[0.0, 0.0, 0.0], [speed, 0.0, 0.0], [slip or 0.0, 0.0, 0.0]],
        "masses": [1.0, 1.0, 1.0],
        "springs": [[0, 1], [0, 2]],
        "rest_lengths": [0.0, 0.0],
        "stiffness": [swing**2, joint**2],
        "k_d0": 0.0,
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "contact.thickness": thickness,
    }
    files = {"springs.yaml": json.dumps(springs).encode()}
    x = Scene.from_parameters(parameters, files=files).starting_state().x
    position, direction = np.array([0.0, 0.0, float(x[2, 2]) - 0.98 * thickness]), 1.0
    parameters |= {"obstacles": ["table"], "table.shape": "plane", "table.position": position.tolist()}
    scene = Scene.from_parameters(parameters | {"table.friction": [friction, friction]}, files=files)
    simulation, capture, frames = Simulation(scene), FrameCapture(), list[SimulatedFrame]()
    for frame in range(settled + round(rate)):
        events: list[Event] = []
        if frame > settled and (frame - settled) % stride == 0:
            direction = -direction if slip is None else direction
            position = position + np.array([direction * travel, 0.0, 0.0])
            events = [Move("table", position)]
        before = simulation.state.shallow_copy()
        simulated = capture.capture(simulation, scene, before, simulation.advance(events))
        assert simulated is not None
        assert not simulated.flagged
        frames.append(simulated)

    assert error_of_frames(frames[settled:], (8000, 2000), 0.1 * tolerance) <= tolerance * growth


@pytest.mark.parametrize(
    ("rate", "thickness", "gap", "swing", "speed", "pull", "sink", "height", "damping", "slip", "tolerance", "first"),
    [
        # Found by climbs. A particle touches the table in a frame without an estimate. The contact energy of another,
        # which lies there, hides it. Or the particle leaves the table before the first force of long steps.
        (
            71.0,
            1.445377205e-3,
            0.922683889,
            0.92813,
            4.1134,
            0.84059165,
            0.164735166,
            3.1027081e-3,
            6.2,
            0.0,
            1.8e-6,
            65,
        ),
        (56.0, 4.4777e-3, 0.0, 3.7309, 2.2054, 1.15987, 0.048206, 8.00056e-4, 4.8052, 1.55037, 5.85976e-6, 28),
        # It touches the table only within a frame, not at its ends.
        (
            35.0,
            1.410951166e-3,
            0.986804782,
            2.5899409,
            57.576801,
            0.3570593,
            0.474931151,
            1.6978022e-3,
            27.5387083,
            0.0,
            1.5112873e-5,
            1,
        ),
    ],
)
def test_particle_that_touches_a_table_is_within_tolerance(
    rate: float,
    thickness: float,
    gap: float,
    swing: float,
    speed: float,
    pull: float,
    sink: float,
    height: float,
    damping: float,
    slip: float,
    tolerance: float,
    first: int,
) -> None:
    low = gap * thickness or 1.0
    springs = {
        "positions": [
            [0.0, 0.0, 5.0 + 9.81 / swing**2],
            [0.0, 0.0, 5.0],
            [1.0, 0.0, low],
            [2.0, 0.0, thickness + height],
            [2.0, 0.0, thickness - sink + 9.81 / pull**2],
        ],
        "velocities": [[0.0] * 3, [speed, 0.0, 0.0], [0.0] * 3, [slip, 0.0, 0.0], [0.0] * 3],
        "masses": [1.0] * 5,
        "springs": [[0, 1], [3, 4]],
        "rest_lengths": [0.0, 0.0],
        "stiffness": [swing**2, pull**2],
        "k_d0": 0.0,
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": ["0", "4"] if gap else ["0", "2", "4"],
        "contact.thickness": thickness,
        "contact.damping": damping,
    }
    files = {"springs.yaml": json.dumps(springs).encode()}
    top = float(Scene.from_parameters(parameters, files=files).starting_state().x[2, 2]) - low
    parameters |= {"obstacles": ["table"], "table.shape": "plane", "table.position": [0.0, 0.0, top]}
    scene = Scene.from_parameters(parameters | {"table.friction": [0.0]}, files=files)
    frames = unflagged_frames(scene, first + round(rate), {})
    # A perturbation grows by up to 1.3.
    assert error_of_frames(frames[first:], (2000, 3400), 0.1 * tolerance) <= 1.3 * tolerance


def test_layer_that_bounces_within_a_frame_is_within_tolerance() -> None:
    # Found by a climb. A damped bounce off another layer lasts for a part of a frame. The contact energy of a particle
    # at rest and a particle that swings hide it.
    tolerance, rate, thickness, speed, swing, sink, first = 1e-6, 72.0, 9e-4, 6.5e-3, 1.2, 0.017, 9
    triangle = np.array([[-0.4, -0.4, 0.0], [0.8, -0.4, 0.0], [-0.4, 0.8, 0.0]])
    resting = [10.0, 0.0, thickness * (1.0 - sink)]
    falling, origin_of_swing = [0.0, 0.0, thickness + speed * 11.23 / rate], [0.0, 0.0, 5.0]
    springs = {
        "positions": [
            *triangle.tolist(),
            *np.add(triangle, [10.0, 0.0, 0.0]).tolist(),
            resting,
            resting,
            falling,
            origin_of_swing,
            origin_of_swing,
        ],
        "velocities": [[0.0] * 3] * 8 + [[0.0, 0.0, -speed], [0.0] * 3, [4.0 * speed * (rate / swing) ** 2, 0.0, 0.0]],
        "masses": 1.0,
        "springs": [[6, 7], [9, 10]],
        "rest_lengths": 0.0,
        "stiffness": [9e4, swing**2],
        "k_d0": [0.7, 0.0],
        "triangles": [[0, 1, 2], [3, 4, 5]],
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": [str(particle) for particle in (0, 1, 2, 3, 4, 5, 7, 9)],
        "contact.self": True,
        "contact.thickness": thickness,
        "contact.damping": 200.0,
        "contact.friction": [0.0, 0.0],
        "gravity": [0.0, 0.0, 0.0],
    }
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    frames = unflagged_frames(scene, first + round(rate), {})
    # A perturbation does not grow.
    assert error_of_frames(frames[first:], (1000, 1700), 0.1 * tolerance) <= tolerance


def test_triangle_that_bounces_off_a_ball_is_within_tolerance() -> None:
    # Found by a climb. The same as above, with a corner or edge of an obstacle in place of a layer.
    tolerance, rate, thickness, speed = 2.95605055e-07, 63.0, 0.000826877734, 0.002230473945603146
    swing, edge, radius, first = 0.250626343, 0.1, 0.004, 10
    corners = edge / 3**0.5 * np.array([[1.0, 0.0, 0.0], [-0.5, 0.75**0.5, 0.0], [-0.5, -(0.75**0.5), 0.0]])
    height = 5.0 + radius + 0.5 * thickness + speed * (first + 2.5061805609276613) / rate
    resting, origin_of_swing = [10.0, 0.0, 0.841191657 * thickness], [0.0, 3.0, 5.0]
    springs = {
        "positions": [
            *np.add(corners, [0.0, 0.0, height]).tolist(),
            resting,
            resting,
            origin_of_swing,
            origin_of_swing,
        ],
        "velocities": [
            *[[0.0, 0.0, -speed]] * 3,
            *[[0.0] * 3] * 3,
            [8.7637118 * speed * (rate / swing) ** 2, 0.0, 0.0],
        ],
        "masses": 1.0,
        "springs": [[0, 1], [1, 2], [0, 2], [3, 4], [5, 6]],
        "rest_lengths": [edge] * 3 + [0.0] * 2,
        "stiffness": [108.13425**2 * edge] * 3 + [473.879573**2, swing**2],
        "k_d0": [0.5] * 3 + [0.7, 0.0],
        "triangles": [[0, 1, 2]],
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": ["4", "5"],
        "contact.thickness": thickness,
        "contact.damping": 67.970442,
        "gravity": [0.0, 0.0, 0.0],
    }
    files = {"springs.yaml": json.dumps(springs).encode()}
    origin = Scene.from_parameters(parameters, files=files).starting_state().positions[3] - resting
    parameters |= {
        "obstacles": ["ball", "table"],
        "ball.shape": "sphere",
        "ball.size": [radius],
        "ball.position": (origin + np.array([0.0, 0.0, 5.0])).tolist(),
        "ball.friction": [0.0],
        "table.shape": "plane",
        "table.position": origin.tolist(),
        "table.friction": [0.0],
    }
    frames = unflagged_frames(Scene.from_parameters(parameters, files=files), first + round(rate), {})
    # A perturbation grows by up to 1.06.
    assert error_of_frames(frames[first:], (1000, 1700), 0.1 * tolerance) <= 1.06 * tolerance


@pytest.mark.parametrize(("rate", "friction"), [(90.0, 0.01), (92.0, 0.012)])
def test_layers_that_slide_to_and_fro_are_within_tolerance(rate: float, friction: float) -> None:
    # Found by a search. A triangle of cloth slides to and fro on another. A particle that swings hides the friction.
    tolerance, thickness, settled, pull, swing = 6e-6, 4e-3, round(rate / 2.0), 11.0, 4.5
    height, edge, extent = 0.978 * thickness, 0.06, 0.2
    lower, upper = (
        [[-extent, -extent, 0.0], [2.0 * extent, -extent, 0.0], [-extent, 2.0 * extent, 0.0]],
        [[0.0, 0.0, height]],
    )
    upper += [[edge, 0.0, height], [0.0, edge, height]]
    springs = {
        "positions": [*lower, *upper, [0.0, 0.02, height], [0.0, 0.0, 2.0], [0.0, 0.0, 2.0 - 9.81 / swing**2]],
        "velocities": [[0.0] * 3] * 3 + [[0.0093, 0.0, 0.0]] * 3 + [[0.0] * 3] * 2 + [[3.27, 0.0, 0.0]],
        "masses": [1.0] * 3 + [0.14] * 3 + [1.0] * 3,
        "springs": [[3, 4], [4, 5], [5, 3], [3, 6], [4, 6], [5, 6], [7, 8]],
        "rest_lengths": [edge, edge * 2.0**0.5, edge, 0.0, 0.0, 0.0, 0.0],
        "stiffness": [26.0] * 3 + [0.14 * pull**2] * 3 + [swing**2],
        "k_d0": [0.46] * 3 + [0.0] * 4,
        "triangles": [[0, 1, 2], [3, 4, 5]],
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": ["0", "1", "2", "6", "7"],
        "contact.self": True,
        "contact.thickness": thickness,
        "contact.friction": [friction, friction],
    }
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    frames = unflagged_frames(scene, settled + round(rate), {})
    # A perturbation does not grow.
    assert error_of_frames(frames[settled:], (1000, 1700), 0.1 * tolerance) <= tolerance


@pytest.mark.parametrize(("rate", "damping"), [(80.0, 0.68), (83.0, 0.68), (83.0, 0.7)])
def test_chain_on_a_turning_obstacle_is_within_tolerance(rate: float, damping: float) -> None:
    # Found by a climb, then reduced. The obstacle turns to and fro in frames of three runs without an estimate. These
    # runs have 2 to 4 steps, and hardly differ by chance.
    tolerance, arm, angle, length, mass = 2.7e-6, 1.94, 0.00132, 0.6, 0.26
    axis = np.array([0.245, 0.037, -0.918])
    axis /= np.linalg.norm(axis)
    springs = {
        "positions": [[0.0, 0.0, 0.0], [length, 0.0, 0.0], [2.0 * length, 0.0, 0.0]],
        "masses": [mass, 0.14 * mass, mass],
        "springs": [[0, 1], [1, 2]],
        "rest_lengths": [0.83 * length, length],
        "stiffness": 0.14,
        "k_d0": damping,
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": [""],
        "cloth.joints": ["0-ball"],
        "cloth.joint_stiffness": 1.6,
        "cloth.joint_damping": 0.81,
        "obstacles": ["ball"],
        "ball.shape": "sphere",
        "ball.size": [0.01],
        "ball.position": [0.0, arm, 0.0],
    }
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    turns = [(np.array([*(sign * np.sin(0.5 * angle) * axis), np.cos(0.5 * angle)])) for sign in (-1.0, 1.0)]
    moves = {k: [Move("ball", [0.0, arm, 0.0], turns[(k + 2) // 4 % 2 - 1])] for k in range(2, round(rate), 4)}
    frames = unflagged_frames(scene, round(rate), moves)
    # A perturbation does not grow.
    assert error_of_frames(frames, (1000, 2000), 0.1 * tolerance) <= tolerance


@pytest.mark.parametrize(
    ("rate", "tolerance", "edge", "width", "mass", "stretch", "fold", "speed", "moduli", "model", "growth"),
    [
        # Found by climbs. Plastic lengths have errors in frames with an estimate, or hinges turn round between them.
        (64.0, 3.3e-6, 0.034, 1.0, 0.063, (4.8, 0.07), 2.9, 0.0055, (4.7e-6, 1.7e-5, 1.03), "altitude", 1.0),
        (56.0, 1.22e-6, 0.0926, 0.927, 0.2155, (1421.0, 0.56), 1.769, 0.1558, (0.2635, 2.212, 0.949), "crossed", 1.0),
        (39.0, 5.24e-5, 0.193, 1.0, 0.00354, (11.8, 0.339), 2.05, 0.00337, (0.00592, 0.0707, 0.727), "altitude", 2.2),
    ],
)
def test_hinge_with_friction_is_within_tolerance(
    rate: float,
    tolerance: float,
    edge: float,
    width: float,
    mass: float,
    stretch: tuple[float, float],
    fold: float,
    speed: float,
    moduli: tuple[float, float, float],
    model: str,
    growth: float,
) -> None:
    tip, along = np.array([np.cos(fold), 0.0, np.sin(fold)]), np.array([-np.sin(fold), 0.0, np.cos(fold)])
    width, modulus, moment, curvature = edge * width, *moduli
    sides = [edge, *[np.hypot(edge, 0.5 * edge)] * 2, *[np.hypot(width, 0.5 * edge)] * 2]
    wing = [0.0, 0.5 * edge, 0.0] + width * tip
    springs = {
        "positions": [[0.0, 0.0, 0.0], [0.0, edge, 0.0], [-edge, 0.5 * edge, 0.0], wing.tolist()],
        "velocities": [[0.0, 0.0, 0.0]] * 3 + [(speed * along).tolist()],
        "masses": [1.0, 1.0, 1.0, mass],
        "springs": [[0, 1], [0, 2], [1, 2], [0, 3], [1, 3]],
        "rest_lengths": sides,
        "stiffness": stretch[0],
        "k_d0": stretch[1],
        "triangles": [[0, 1, 2], [1, 0, 3]],
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": ["0", "1", "2"],
        "bending.model": model,
        "bending.flat": True,
        "bending.friction_moment": moment,
        "bending.yield_curvature": curvature,
        "material.bending_modulus": modulus,
        "material.damping": 0.0,
        "gravity": [0.0, 0.0, 0.0],
    }
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    frames = unflagged_frames(scene, round(rate), {})
    assert error_of_frames(frames, (2000, 3500), 0.1 * tolerance) <= tolerance * growth


def test_hinge_that_a_gripper_turns_round_is_within_tolerance() -> None:
    # Found by a climb. A hinge that yields turns round at the end of a frame without an estimate, near its reach.
    tolerance, rate, edge, mass, fold, speed = (
        3.6246904401840376e-7,
        91.0,
        0.20786060598581035,
        0.0742674505,
        0.9945545541,
        0.1407004316,
    )
    width, travel, stiffness = 0.9836889837 * edge, 0.015418254732321019, 60.31155820781411
    tip, along = np.array([np.cos(fold), 0.0, np.sin(fold)]), np.array([-np.sin(fold), 0.0, np.cos(fold)])
    springs = {
        "positions": [
            [0.0, 0.0, 0.0],
            [0.0, edge, 0.0],
            [-edge, 0.5 * edge, 0.0],
            ([0.0, 0.5 * edge, 0.0] + width * tip).tolist(),
        ],
        "velocities": [[0.0] * 3] * 3 + [(speed * along).tolist()],
        "masses": [1.0] * 3 + [mass],
        "springs": [[0, 1], [0, 2], [1, 2], [0, 3], [1, 3]],
        "rest_lengths": [edge] + [edge * 1.25**0.5] * 2 + [np.hypot(width, 0.5 * edge)] * 2,
        "stiffness": stiffness,
        "k_d0": 0.230149966454,
        "triangles": [[0, 1, 2], [1, 0, 3]],
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": ["0", "1", "2"],
        "bending.model": "crossed",
        "bending.flat": True,
        "bending.friction_moment": 0.035167748077602354,
        "bending.yield_curvature": 7.1923477815020185,
        "material.bending_modulus": 0.20157598735922305,
        "material.damping": 0.0,
        "grippers": ["hand"],
        "gripper.model": "spring",
        "gripper.radius": 0.3 * edge,
        "gripper.stiffness": 0.15987064371953286,
        "gripper.damping": 0.35486339641481457,
        "gripper.max_speed": 0.0,
    }
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    tip_start = scene.starting_state().positions[3]
    events = {k: [Target("hand", tip_start - (k // 6 % 2) * travel * along)] for k in range(7, 94, 6)}
    frames = unflagged_frames(scene, 94, {0: [Target("hand", tip_start), Grasp("hand", True)], **events})
    # A perturbation does not grow.
    assert error_of_frames(frames[3:], (900, 1531), 0.1 * tolerance) <= tolerance


def test_hinge_of_rare_impulses_is_within_tolerance() -> None:
    # Found by a climb. A gripper moves once, in a frame without an estimate. The hinge that follows is evaluated every
    # fifth step, so it errs 25 times as much as springs. A particle that swings hides it from the activity.
    tolerance, rate, edge, mass, stiff, slow, swing = (
        4.440139185859674e-7,
        36.0,
        0.23003632487938314,
        0.14637617789518023,
        3669.3772129733,
        146.5843702662083,
        0.634187845158376,
    )
    diagonal = edge * 1.25**0.5
    springs = {
        "positions": [
            [0.0, 0.0, 0.0],
            [0.0, edge, 0.0],
            [-edge, 0.5 * edge, 0.0],
            [edge, 0.5 * edge, 0.0],
            [0.0, 0.0, 5.0],
            [0.0, 0.0, 5.0],
        ],
        "velocities": [[0.0] * 3] * 5 + [[91.59879861425198, 0.0, 0.0]],
        "masses": [1.0] * 3 + [mass] + [1.0] * 2,
        "springs": [[0, 1], [0, 2], [1, 2], [0, 3], [1, 3], [4, 5]],
        "rest_lengths": [edge, *[diagonal] * 4, 0.0],
        "stiffness": [mass * stiff**2 / 1.6] * 5 + [swing**2],
        "k_d0": [0.504024066041266] * 5 + [0.013126065030841712],
        "triangles": [[0, 1, 2], [1, 0, 3]],
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": ["0", "1", "4"],
        "bending.model": "altitude",
        "bending.flat": True,
        "material.bending_modulus": 0.5 * mass * (slow * edge) ** 2,
        "material.damping": 0.034347449240735226,
        "gravity": [0.0, 0.0, 0.0],
        "grippers": ["hand"],
        "gripper.model": "prescribed",
        "gripper.radius": 0.3 * edge,
        "gripper.max_speed": 0.0,
    }
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    start = scene.starting_state().positions[2]
    moved = start + np.array([0.0, 0.0, 1.3662954391391123e-4])
    events = {0: [Target("hand", start), Grasp("hand", True)], 6: [Target("hand", moved)]}
    frames = unflagged_frames(scene, 6 + round(rate), events)
    # A perturbation does not grow.
    assert error_of_frames(frames[6:], (500, 850), 0.1 * tolerance) <= tolerance


def test_vibration_from_a_lucky_phase_is_within_tolerance() -> None:
    # Found by a climb. A single run of two steps errs by .74 of the budget in the first frame, and by 116 in the next.
    tolerance, rate = 1.68183785e-05, 42.0
    springs = {
        "positions": [[0.0, 0.0, 0.0], [-0.00012271298851441854, -6.058327151681522e-06, 0.0]],
        "velocities": [[0.0, 0.0, 0.0], [0.005597322541785226, 0.0002364635642991589, 0.0]],
        "masses": 1.0,
        "springs": [[0, 1]],
        "rest_lengths": 0.0,
        "stiffness": 8868.746427190408,
        "k_d0": 0.0,
    }
    parameters = {**SPRINGS, "rate": rate, "tolerance": tolerance, "gravity": [0.0, 0.0, 0.0]}
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    frames = unflagged_frames(scene, round(rate), {})
    assert error_of_frames(frames, (100, 170), 0.01 * tolerance) <= tolerance


def test_table_that_moves_is_not_left_out_of_late_pieces() -> None:
    # Found by a climb. Late pieces of a frame left out the table, which had moved since the frame's start. References
    # that divide the frame did so too.
    tolerance, rate, thickness = 7.28944482e-8, 113.0, 4.59903931e-3
    springs = {
        "positions": [[0.0, 0.0, 0.98 * thickness], [0.0, 0.0, 0.98 * thickness + 0.01]],
        "masses": 1.0,
        "springs": [[0, 1]],
        "rest_lengths": 0.01,
        "stiffness": 1.0,
        "k_d0": 0.0,
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": [""],
        "contact.thickness": thickness,
        "contact.damping": 7.52436074,
    }
    files = {"springs.yaml": json.dumps(springs).encode()}
    low = Scene.from_parameters(parameters, files=files).starting_state().positions[0]
    table = low - [0.0, 0.0, 0.98 * thickness]
    parameters |= {"obstacles": ["table"], "table.shape": "plane", "table.position": table.tolist()}
    scene = Scene.from_parameters(parameters | {"table.friction": [0.0]}, files=files)
    (frame,) = unflagged_frames(scene, 5, {4: [Move("table", np.add(table, [0.0, 0.0, 4.79168843e-3]))]})[4:]
    motion = MotionState(frame.before.x, frame.before.v)
    plan = Equations().plan(frame, ReferenceMotion(frame.before))
    exact = dop853(plan, frame.t, frame.duration, motion, relative_tolerance=1e-12, absolute_tolerance=1e-13)
    assert largest_distance(frame.after.x, exact.x) <= tolerance


def test_two_modes_beside_a_swing_are_within_tolerance() -> None:
    # Found by a climb. The phases of its modes decide the error of a single run, and the swing hides them from the
    # activity. Estimates at lucky moments were believed.
    springs = {
        "positions": [
            [-3.07036759e-6, 0.0, 0.0],
            [3.07036759e-6, 0.0, 0.0],
            [0.0, 0.0, 1.43090797e-6],
            [0.0, 0.0, -2.0],
            [0.0, 0.0, -0.56017139],
        ],
        "velocities": [[0.0] * 3] * 4 + [[0.16209367, 0.0, -0.07414074]],
        "masses": [1.0, 1.0, 8.84309298e-5, 1.0, 0.0385316916],
        "springs": [[0, 2], [1, 2], [3, 4], [2, 4]],
        "rest_lengths": [3.38742598e-6, 3.38742598e-6, 1.0, 1.0000014309],
        "stiffness": [1.5750718e-5, 1.5750718e-5, 0.00976033917, 9.33115475e-7],
        "k_d0": 0.0,
    }
    tolerance, rate = 6.61174133e-8, 63.0
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": ["0", "1", "3"],
        "gravity": [0.0, 0.0, 0.0],
    }
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    frames = unflagged_frames(scene, 94, {})
    assert error_of_frames(frames[31:], (100, 170), 0.01 * tolerance) <= tolerance


@pytest.mark.parametrize(
    ("tolerance", "swing", "speed", "frequencies", "k_d0", "first", "travels", "steps"),
    [
        # Found by a climb. Two combined runs amplify the waves of an undamped spring, although another one is damped. A
        # gripper begins to move in a frame without an estimate, and a particle that swings hides it.
        (
            2.18830673173009e-07,
            2.16626493577086,
            25.427542306672073,
            (1094.9354125094196, 1225.860715910079),
            (0.0, 0.0, 0.7672314226968118),
            16,
            {frame: 3.3771362086513026e-06 * (-1.0) ** ((frame - 11) // 9 + 1) for frame in range(11, 41)},
            (1600, 2700),
        ),
        # Two runs of a hundred steps amplify its waves too if all springs are damped, but decay by less than they drift
        # apart.
        (
            2.2e-7,
            5.5,
            100.0,
            (2662.4, 4096.0),
            (1e-4, 6.849e-3, 1.05367e-2),
            19,
            dict.fromkeys(range(20, 44), -1e-7),
            (6000, 10000),
        ),
    ],
)
def test_wave_that_combined_runs_amplify_is_within_tolerance(
    tolerance: float,
    swing: float,
    speed: float,
    frequencies: tuple[float, float],
    k_d0: tuple[float, float, float],
    first: int,
    travels: Mapping[int, float],
    steps: tuple[int, int],
) -> None:
    rate, mass, (slow, fast) = 25.0, 0.002661644485942177, frequencies
    springs = {
        "positions": [
            [0.0, 0.0, 5.0],
            [0.0, 0.0, 5.0],
            [0.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [5.0, 0.0, 0.0],
            [5.0, 0.0, 0.0],
        ],
        "velocities": [[0.0] * 3, [speed, 0.0, 0.0]] + [[0.0] * 3] * 4,
        "masses": [1.0] * 3 + [mass] + [1.0] * 2,
        "springs": [[0, 1], [2, 3], [4, 5]],
        "rest_lengths": [0.0, 1.0, 0.0],
        "stiffness": [swing**2, mass * slow**2, fast**2],
        "k_d0": list(k_d0),
    }
    parameters = {
        **SPRINGS,
        "rate": rate,
        "tolerance": tolerance,
        "cloth.anchors": ["0", "4"],
        "gravity": [0.0, 0.0, 0.0],
        "grippers": ["hand"],
        "gripper.model": "prescribed",
        "gripper.radius": 0.1,
        "gripper.max_speed": 0.0,
    }
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    start, travel = scene.starting_state().positions[2], 0.0
    events: dict[int, list[Event]] = {0: [Target("hand", start), Grasp("hand", True)]}
    for frame, distance in travels.items():
        travel += distance
        events[frame] = [Target("hand", start + np.array([travel, 0.0, 0.0]))]
    frames = unflagged_frames(scene, first + 25, events)
    # A perturbation does not grow.
    assert error_of_frames(frames[first:], steps, 0.1 * tolerance) <= tolerance


def unflagged_frames(scene: Scene, count: int, events: Mapping[int, Sequence[Event]]) -> list[SimulatedFrame]:
    """Return a number of frames, with events by frame; no frame may be flagged."""
    simulation, capture, frames = Simulation(scene), FrameCapture(), list[SimulatedFrame]()
    for k in range(count):
        before = simulation.state.shallow_copy()
        simulated = capture.capture(simulation, scene, before, simulation.advance(events.get(k, ())))
        assert simulated is not None
        assert not simulated.flagged
        frames.append(simulated)
    return frames


def error_of_frames(frames: list[SimulatedFrame], steps: tuple[int, int], max_reference_error: float) -> float:
    """Return the largest error of positions [m] against a run from the first frame's start, checked by another."""
    equations = Equations()

    def integrate(count: int) -> list[Array]:
        motion, positions = ReferenceMotion(frames[0].before), list[Array]()
        for frame in frames:
            motion.apply_grasps(frame)
            plan = equations.plan(frame, motion)
            motion.state = integrate_intervals(plan, frame.t, [frame.duration], motion.state, (count,))
            positions.append(motion.x)
        return positions

    exact, check = map(integrate, steps)
    assert max(largest_distance(a, b) for a, b in zip(exact, check, strict=True)) <= max_reference_error
    return max(largest_distance(frame.after.x, x) for frame, x in zip(frames, exact, strict=True))
