# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error bound on small problems that a search found, against exact solutions and an independent integrator."""

from __future__ import annotations

import numpy as np
import pytest
from support.error_bound import error_by_evaluations, error_of_frames, unflagged_frames

from cloth_sim_ros.engine.binding import PATH_NUMBERS
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
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.independent_integrator import dop853
from cloth_sim_ros.verify.reference_integrator import MotionState

GRAVITY = np.array([0.0, 0.0, -9.81])
TIMES = np.arange(1, 61) / 60.0


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


def test_pieces_of_one_step_aim_at_half_of_the_budget() -> None:
    drag, rate, tolerance = 0.02, 11, 1.18e-7
    plan, state = compile(Model([1.0], [Gravity(GRAVITY), Drag(drag)])), State(np.zeros((1, 3)), [[1.9, 0.018, 1.75]])
    integrator, motions = make_integrator("auto", tolerance=tolerance), [state.shallow_copy()]
    for frame in range(rate + rate // 2):
        assert not integrator.advance(plan, state, frame / rate, 1.0 / rate).flagged
        motions.append(state.shallow_copy())
    times, limit_speed = np.arange(1, rate + 1) / rate, GRAVITY[:, None] / drag
    for first in (0, rate // 2):
        start, after = motions[first], np.stack([motion.x[:, 0] for motion in motions[first + 1 : first + rate + 1]], 1)
        exact = start.x - (start.v - limit_speed) * np.expm1(-drag * times) / drag + limit_speed * times
        # Errors were 0.92 tolerances where a step was refined without another number of steps.
        assert np.linalg.norm(after - exact, axis=0).max() <= 0.7 * tolerance


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


def test_strain_that_meets_its_limit_is_within_tolerance() -> None:
    # The second derivative of the force jumps within the last half step of a frame, which no run samples.
    tolerance, growth = 2.93610467e-8, 1.68
    parameters = {
        "rate": 36.0,
        "tolerance": tolerance,
        "cloth.resolution": [2, 2],
        "cloth.size": [1.57690468, 0.610173503],
        "cloth.orientation": [0.5, 0.5, 0.5, 0.5],
        "cloth.anchors": ["top"],
        "material.stretch_modulus": 5.52581211,
        "material.stretch_modulus_weft": 5.52581211,
        "material.shear_modulus": 0.08902589,
        "material.poisson_ratio": 0.0,
        "material.density": 0.3,
        "material.damping": 0.0,
        "material.warp_direction": [1.0, 0.03158585895282884, 0.0],
        "material.warp_stiffening": [0.0252717849, 22.7423849],
        "material.weft_stiffening": [0.0325803858, 11.7075973],
        "membrane.model": "triangles",
        "bending.model": "none",
        "air.drag": 0.0,
        "wind.normal_drag": 0.0,
        "gravity": [0.0, 0.0, -8.26094982],
        "grippers": [""],
    }
    frames = unflagged_frames(Scene.from_parameters(parameters), 36, {})
    assert error_of_frames(frames, (1000, 1700), 0.1 * tolerance) <= tolerance * growth


def test_sheet_thrown_through_its_anchors_is_within_tolerance() -> None:
    # Its triangles turn over in their plane, so the drag of their panels has a kink.
    tolerance, growth, rate = 1.27764653e-9, 2.3, 29.0
    parameters = {
        "rate": rate,
        "tolerance": tolerance,
        "cloth.resolution": [2, 2],
        "cloth.size": [0.982321865, 1.14266082],
        "cloth.orientation": [0.5, 0.5, 0.5, 0.5],
        "cloth.anchors": ["top"],
        "material.stretch_modulus": 5.11252805,
        "material.stretch_modulus_weft": 5.11252805,
        "material.shear_modulus": 0.9531454399163686,
        "material.warp_direction": [1.0, 0.7500113629646274, 0.0],
        "material.density": 0.3,
        "material.damping": 0.0,
        "membrane.model": "triangles",
        "bending.model": "none",
        "air.drag": 0.0,
        "wind.normal_drag": 0.0048570397,
        "wind.tangential_drag": 0.0633910273,
        "wind.velocity": [0.0, 0.7900009731389828, -3.4759582608781026],
        "gravity": [0.0, 0.0, -0.344341646],
        "grippers": [""],
    }
    velocities = np.zeros((3, 4))
    velocities[2, 2:] = 4.77788444
    frames = unflagged_frames(Scene.from_parameters(parameters), round(rate), {}, velocities)
    assert error_by_evaluations(frames) <= tolerance * growth


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


def test_vibrations_beside_one_in_flight_are_within_tolerance() -> None:
    # Single precision rounds positions relative to the first particle.
    tolerance, rate, count, frequency = 3e-6, 10, 64, 10.0
    rng, amplitude = np.random.default_rng(0), 0.003
    positions, velocities = np.zeros((2 + count, 3)), np.zeros((2 + count, 3))
    positions[2:] = amplitude * rng.normal(size=(count, 3))
    velocities[0, 0], velocities[2:] = 30.0, 0.3 * amplitude * frequency * rng.normal(size=(count, 3))
    joints = PairSprings([[1, 2 + k] for k in range(count)], 0.0, frequency * frequency)
    plan, state = compile(Model(np.ones(2 + count), [joints], anchors=[1])), State(positions, velocities)
    integrator, states = make_integrator("auto", tolerance=tolerance, work=10.0), [state.shallow_copy()]
    for frame in range(3 * rate):
        assert not integrator.advance(plan, state, frame / rate, 1.0 / rate).flagged
        states.append(state.shallow_copy())
    for first in range(0, 3 * rate, rate):
        start = states[first]
        for k, after in enumerate(states[first + 1 : first + rate + 1], start=1):
            angle = frequency * k / rate
            exact = np.cos(angle) * start.x[:, 2:] + np.sin(angle) / frequency * start.v[:, 2:]
            assert np.linalg.norm(after.x[:, 2:] - exact, axis=0).max() <= tolerance


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
