# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `tolerance`: its reference, random scenes and evaluations."""

import json

import attrs
import numpy as np
import pytest
from support import laws
from support.plan_scenes import FILES, SCENES, stir
from support.reference_kernel import find_compiler

from cloth_sim_ros.physics.model.forces.bending_friction import BendingFriction
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import PLASTIC_LENGTHS_KEY
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation
from validation.__main__ import main
from validation.case_pool import CasePool, CaseResult
from validation.tolerance import bound
from validation.tolerance.climb import FAMILIES, Climb, VectorGenerator, evaluate_vector, run_climb
from validation.tolerance.compiled_reference import (
    LANES,
    PERTURBATION,
    GripTable,
    Integration,
    ReferenceFailureError,
    ReferenceSystem,
    trajectories,
)
from validation.tolerance.random_scenes import MAX_COST, RandomScene, draw_scene, initial_state
from validation.tolerance.regimes import LinearMotion, Regime, all_regimes, evaluate_regime, regime_scene
from validation.tolerance.violent import run_violent
from validation.tolerance.windows import (
    SceneEvaluation,
    evaluate_scene,
    evaluate_window,
    grip_points,
    record_run,
    unit_perturbations,
)

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

#: Types of a case and of its result.
KINDS = (tuple[int, int, int], SceneEvaluation)
REGIMES = {regime.name: regime for regime in all_regimes()}


@pytest.mark.parametrize(
    "name", ["grid, wind and air", "hinges", "grid, altitude, undamped", "grid, opposite", "mesh, air", "springs"]
)
def test_reference_accelerations_match_numpy_laws(name):
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [7, 6], **SCENES[name]}, files=FILES))
    stir(simulation)
    model, x, v = simulation.model, simulation.state.x, simulation.state.v
    # No three particles are collinear: the laws divide by the area between them.
    x = x + 0.003 * np.random.default_rng(1).normal(size=x.shape)
    expected = laws.total(model, 0.0, x, v).force * model.inverse_masses
    accelerations = ReferenceSystem(model).accelerations(x, v)
    # Rounding of some tens of forces a particle.
    assert accelerations == pytest.approx(expected, abs=1e-13 * np.abs(expected).max())


_FABRIC = {
    "cloth.resolution": [7, 6],
    "cloth.orientation": [0.61, 0.07, -0.13, 0.77],
    "material.bending_modulus": 1e-4,
    "material.bending_modulus_weft": 3e-4,
}
_STIFFENING = {f"material.{name}_stiffening": [0.01 * (k + 2), 4.0] for k, name in enumerate(("warp", "weft", "shear"))}
_TRIANGLES = {"membrane.model": "triangles", "bending.model": "none"}
_FRICTION = {**_FABRIC, "bending.friction_moment": 1e-3, "bending.yield_curvature": 0.1}


@pytest.mark.parametrize(
    "values",
    [
        {**_FABRIC, "bending.model": "quadratic"},
        {**_FABRIC, "bending.model": "shape_operator"},
        {**_FRICTION, "bending.model": "quadratic"},
        {**_FRICTION, "bending.model": "altitude"},
        {**_TRIANGLES, "material.poisson_ratio": -0.3, "material.warp_direction": [0.6, 0.8, 0.0]},
        {**_TRIANGLES, "material.poisson_ratio": 0.3, **_STIFFENING, "air.added_mass": 0.1},
    ],
    ids=["quadratic", "shape operator", "friction", "friction of altitude hinges", "triangles", "stiffening"],
)
def test_reference_accelerations_of_fabrics_match_the_plan(values):
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [7, 6], "wind.normal_drag": 0.0, **values}))
    stir(simulation)
    plan, rng = simulation.plan, np.random.default_rng(1)
    x, v = simulation.state.x + 0.01 * rng.normal(size=simulation.state.x.shape), simulation.state.v
    system, memory = ReferenceSystem(simulation.model), {}
    if plan.plastic is not None:
        lengths = rng.normal(size=system.plastic_lengths.shape[0]) * 3e-3
        system.set_plastic_lengths(lengths)
        memory = {PLASTIC_LENGTHS_KEY: lengths}
    expected = np.empty_like(x)
    plan.accelerations(0.0, x, v, expected, memory)
    assert system.accelerations(x, v) == pytest.approx(expected, abs=1e-11 * np.abs(expected).max())


def test_reference_yields_at_extremes_within_a_step():
    # A hinge between two equal triangles, held at its edge. The wings swing and reverse within a step.
    hinge = [[0, 1, 2, 3]]
    friction = BendingFriction(hinge, 0.0, 2.0, 0.002)
    joints = PairSprings([[0, 2], [0, 3]], 0.0, 3.0)
    model = Model(np.full(4, 0.01), [friction, joints], anchors=[0, 1])
    x = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.1, 0.5, 0.0], [0.1, 0.5, 0.0]]).T
    v = np.zeros((3, 4))
    v[2, 2:] = 0.5
    lengths = []
    for max_step in (1e-3, 1e-5):
        system = ReferenceSystem(model)
        Integration(system, trajectories(x, v), tolerance=1e-3, max_step=max_step).advance(0.3)
        lengths.append(system.plastic_lengths)
    assert np.abs(lengths[1]).max() > 0.002
    assert lengths[0] == pytest.approx(lengths[1], abs=1e-8)


def test_reference_returns_hinges_to_yield_surface_at_start():
    # Folded wings beyond the yield limit unfold; the first step holds the plastic length.
    model = Model(np.full(4, 0.01), [BendingFriction([[0, 1, 2, 3]], 0.0, 2.0, 0.002)], anchors=[0, 1])
    x = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.1, 0.5, 0.05], [0.1, 0.5, 0.05]]).T.copy()
    v = np.zeros((3, 4))
    v[2, 2:] = -0.5
    plastic = compile(model).plastic
    ends = []
    for lengths in (np.zeros(1), plastic.return_mapping(x, {})[0]):
        system = ReferenceSystem(model)
        system.set_plastic_lengths(lengths)
        integration = Integration(system, trajectories(x, v), tolerance=1e-10)
        integration.advance(0.02)
        ends.append((integration.positions, system.plastic_lengths))
    assert ends[0][0] == pytest.approx(ends[1][0], abs=1e-13)
    assert ends[0][1] == pytest.approx(ends[1][1], abs=1e-13)


def test_reference_follows_friction_of_bending():
    rng = np.random.default_rng([2, 9])
    values = {**_FRICTION, "bending.model": "quadratic", "tolerance": 1e-4, "grippers": [""], "rate": 60.0}
    scene = Scene.from_parameters({**values, "cloth.resolution": [4, 3], "wind.normal_drag": 0.0})
    draw = RandomScene(scene=scene, state=initial_state(rng, scene, 1.0), frames=60, words="a sheet with friction")
    run = record_run(draw)
    assert run.mismatch < 1e-12
    assert np.ptp(run.plastic_lengths, axis=0).max() > 0.0
    window = evaluate_window(run, 0, 60, seed=0)[0]
    assert window.is_known
    assert window.ratio < 1.0
    # The reference starts from the recorded plastic lengths.
    run.plastic_lengths[0] = run.plastic_lengths[0] + 0.01
    assert evaluate_window(run, 0, 60, seed=0)[0].ratio > 1.0


@pytest.mark.parametrize("turn", [0.0, 0.2, 3.0])
def test_reference_gripper_motion_matches_numpy_laws(turn):
    rng = np.random.default_rng(5)
    paths = np.zeros((2, 26))
    paths[:, 0] = 1.0
    paths[:, 1:13] = rng.normal(size=(2, 12))
    paths[:, 13:17] = rng.normal(size=(2, 4))
    paths[:, 13:17] /= np.linalg.norm(paths[:, 13:17], axis=1)[:, None]
    paths[:, 17:26] = turn * rng.normal(size=(2, 9))
    grips = Grips(2)
    particles, offsets = np.array([0, 2, 1]), rng.normal(size=(3, 3))
    stiffness, damping = rng.uniform(1.0, 9.0, 3), rng.uniform(0.1, 0.9, 3)
    grips.set_grips(paths, np.array([0, 2, 3]), particles, offsets, stiffness, damping)
    model = Model([1.0, 2.0, 3.0], [grips])
    system = ReferenceSystem(model)
    grasped = GripTable(
        paths=paths,
        grippers=np.array([0, 0, 1]),
        particles=particles,
        numbers=np.stack([stiffness, damping], axis=1),
        offsets=np.repeat(offsets[:, :, None], LANES, axis=2),
    )
    system.set_grasped(grasped, 1.25)
    x, v = rng.normal(size=(2, 3, 3))
    expected = laws.total(model, 1.75, x, v).force * model.inverse_masses
    assert system.accelerations(x, v, since=0.5) == pytest.approx(expected, abs=1e-12 * np.abs(expected).max())


def test_reference_matches_projectile_with_drag():
    drag, gravity = 0.7, np.array([0.0, 0.0, -9.81])
    system = ReferenceSystem(Model([1.0], [Drag(drag), Gravity(gravity)]))
    v = np.array([[1.0], [2.0], [3.0]])
    y = trajectories(np.zeros((3, 1)), v)
    y[0, 0, 0, 1] += PERTURBATION
    y[1, 0, 1, 2] += PERTURBATION
    integration = Integration(system, y, tolerance=1e-13)
    for _ in range(4):
        integration.advance(0.5)
    slowed = (1.0 - np.exp(-2.0 * drag)) / drag
    expected = v[:, 0] * slowed + gravity * (2.0 - slowed) / drag
    assert integration.positions[:, 0] == pytest.approx(expected, abs=1e-12)
    # A perturbation of position keeps its size. A perturbation of velocity grows like a throw with drag. The third
    # trajectory is not perturbed. Positions are rounded to 1e-7 of a perturbation.
    assert integration.deviations() / PERTURBATION == pytest.approx([1.0, slowed, 0.0], abs=1e-5)


@pytest.mark.parametrize(
    "name", ["spring, critically damped", "chain of 7, taut, undamped", "chain of 7, joints, damped"]
)
def test_reference_matches_matrix_exponential(name):
    scene = regime_scene(REGIMES[name], 1e-3)
    simulation = Simulation(scene.scene, scene.state)
    model, x, v = simulation.model, simulation.state.x, simulation.state.v
    integration = Integration(ReferenceSystem(model), trajectories(x, v), tolerance=1e-13)
    motion = LinearMotion(model, x, v)
    for _ in range(60):
        integration.advance(1.0 / 60.0)
        expected = motion.advance(1.0 / 60.0)
        assert np.abs(integration.positions - expected).max() < 1e-11


def test_reference_matches_particle_pulled_by_gripper():
    paths = np.zeros((1, 26))
    paths[0, 4], paths[0, 16] = 0.3, 1.0
    first_index, mass, stiffness = np.array([0]), 0.5, 8.0
    numbers, offsets = np.array([[stiffness, 0.0]]), np.zeros((1, 3, LANES))
    grasped = GripTable(paths=paths, grippers=first_index, particles=first_index, numbers=numbers, offsets=offsets)
    system = ReferenceSystem(Model([mass], [Grips(1)]))
    integration = Integration(system, trajectories(np.zeros((3, 1)), np.zeros((3, 1))), tolerance=1e-13)
    rate = (stiffness / mass) ** 0.5
    for frame in range(10):
        system.set_grasped(grasped, 0.1 * frame)
        integration.advance(0.1)
    assert integration.positions[0, 0] == pytest.approx(0.3 * (1.0 - np.sin(rate) / rate), abs=1e-12)


def test_reference_stops_at_its_evaluation_limit():
    model = Model([1.0, 1.0], [PairSprings([[0, 1]], 1.0, 1e6)], anchors=[0])
    y = trajectories(np.array([[0.0, 1.1], [0.0, 0.0], [0.0, 0.0]]), np.zeros((3, 2)))
    with pytest.raises(ReferenceFailureError, match="more than 100 evaluations"):
        Integration(ReferenceSystem(model), y, tolerance=1e-9, max_evaluations=100).advance(1.0)


def test_random_scene_follows_from_seed_and_index():
    first, repeated, different = draw_scene(3, 5), draw_scene(3, 5), draw_scene(3, 6)
    assert first.scene == repeated.scene
    assert first.words == repeated.words
    assert (first.cost, first.frames) == (repeated.cost, repeated.frames)
    assert first.state.digest() == repeated.state.digest()
    assert [hold.grasp for hold in first.script.holds] == [hold.grasp for hold in repeated.script.holds]
    assert first.words != different.words


def test_random_scenes_cover_all_kinds_and_exceed_the_cap():
    random_scenes = [draw_scene(1, index) for index in range(40)]
    words = " ".join(random_scene.words for random_scene in random_scenes)
    kinds = ("grid", "disc", "hole", "irregular", "spring", "chain", "crossed", "altitude", "axial", "opposite")
    for kind in (*kinds, "shape_operator", "quadratic", "friction of bending", "stiffening triangles", "added mass"):
        assert kind in words
    assert 0 < sum(random_scene.cost > MAX_COST for random_scene in random_scenes) < 30


def _swinging(tolerance: float) -> Regime:
    """Return a swinging weight, which has no closed-form solution."""
    tables = {"positions": [[0, 0, 0], [0.4, 0, 0]], "masses": 0.1, "springs": [[0, 1]], "stiffness": 20.0}
    return Regime("swinging", tables, ("0",), linear=False, gravity=(0.0, 0.0, -9.81), duration=1.0)


def test_window_satisfies_and_violates_the_error_bound():
    run = record_run(regime_scene(_swinging(1e-4), 1e-4))
    assert run.mismatch < 1e-13
    window = evaluate_window(run, 0, 60, seed=0)[0]
    assert window.is_known
    assert window.ratio < 1.0
    assert 1.0 < window.amplification < 10.0
    # The same run with an error of three times the bound in each coordinate in the middle.
    run.positions[30] = run.positions[30] + 3.0 * window.error_bound
    violated = evaluate_window(run, 0, 60, seed=0)[0]
    assert violated.ratio_from_start == pytest.approx(3.0 * 3.0**0.5, abs=1.0)
    # Perturbations that start later in the window grow more here, but not enough to explain the error.
    assert violated.amplification < violated.later_amplification < 3.0 * violated.amplification
    assert violated.ratio == pytest.approx(
        violated.ratio_from_start * violated.amplification / violated.later_amplification
    )
    assert violated.ratio > 1.0


def test_perturbations_have_unit_size_and_spare_anchors():
    run = record_run(attrs.evolve(regime_scene(_swinging(1e-4), 1e-4), frames=1))
    for second in (False, True):
        perturbations = unit_perturbations(run, 1, second=second)
        size = np.sqrt(np.sum(perturbations * perturbations, axis=2))
        assert size[:, 0].max() == 0.0
        # Each trajectory has a perturbation of positions or one of velocities.
        assert np.count_nonzero(size[:, 1], axis=0).tolist() == [1] * (LANES - 1)
        assert size.max() <= 1.0 + 1e-12


def test_new_grips_start_at_each_trajectory():
    rng = np.random.default_rng(2)
    paths = np.zeros((1, 26))
    paths[0, 1:4], paths[0, 13:17] = (1.0, 2.0, 3.0), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    grasped = GripTable(
        paths=paths,
        grippers=np.array([0]),
        particles=np.array([1]),
        numbers=np.ones((1, 2)),
        offsets=rng.normal(size=(1, 3, LANES)),
    )
    y, known_points = rng.normal(size=(2, 3, 3, LANES)), {}
    # The engine's points if the grip is older than the window.
    assert grip_points(grasped, np.array([False]), known_points, y).offsets.tolist() == grasped.offsets.tolist()
    offsets = y[0, 1] - np.array([[1.0], [2.0], [3.0]])
    # In the frame of a gripper that is turned by a right angle about z.
    expected = np.stack([offsets[1], -offsets[0], offsets[2]])
    assert grip_points(grasped, np.array([True]), known_points, y).offsets[0] == pytest.approx(expected, abs=1e-14)
    later = grip_points(grasped, np.array([False]), known_points, rng.normal(size=y.shape))
    assert later.offsets[0] == pytest.approx(expected, abs=1e-14)
    assert grip_points(None, np.zeros(0, dtype=bool), known_points, y) is None
    assert not known_points


@pytest.fixture(scope="module")
def held_scene():
    """Return the index of a cheap random scene with grasped particles."""
    return next(k for k in range(100) if draw_scene(2, k).cost < 3e7 and draw_scene(2, k).script.holds)


def test_command_reports_evaluated_scenes(held_scene, tmp_path):
    file = tmp_path / "evaluation.json"
    status = main(["tolerance", "--seed", "2", "--only", str(held_scene), "--windows", "2", "--json", str(file)])
    written = json.loads(file.read_text())
    assert status == (1 if written["failures"] else 0)
    windows = written["tables"][1]
    assert len(windows["rows"]) == 3
    reference = windows["columns"].index("reference m")
    assert all(row[reference] < 0.02 * row[4] for row in windows["rows"])


def test_evaluated_scenes_are_read_from_the_file(held_scene, tmp_path, monkeypatch):
    result_file = tmp_path / "evaluated.jsonl"
    evaluation = evaluate_scene(2, held_scene, 1)
    case = (2, held_scene, 1)
    pool = CasePool(1, 60.0, result_file)
    assert not [*pool.run_missing(evaluate_scene, [], KINDS)]
    assert not result_file.exists()
    monkeypatch.setattr(CasePool, "run", lambda *_: [CaseResult(case, evaluation, 1.0)])
    first_results = [*pool.run_missing(bound.evaluate_case, [case], KINDS)]
    monkeypatch.setattr(CasePool, "run", lambda *_: pytest.fail("it runs again"))
    assert (
        [*pool.run_missing(bound.evaluate_case, [case], KINDS)] == first_results == [CaseResult(case, evaluation, 1.0)]
    )


def test_differing_forces_are_reported(held_scene, monkeypatch):
    monkeypatch.setattr("validation.tolerance.windows._mismatch", lambda *_: 1e-9)
    evaluation = evaluate_scene(2, held_scene, 1)
    assert evaluation.verdict == "FORCES DIFFER"
    assert not evaluation.windows


def test_free_rotating_spring_satisfies_the_error_bound():
    # Its errors have one sign, and estimates are too low by a factor of up to four.
    evaluation = evaluate_scene(1, 96, 2)
    assert evaluation.verdict == "kept"
    assert not evaluation.flagged_frames
    assert max(window.error / window.error_bound for window in evaluation.windows) < 1.0


def test_linear_regime_is_compared_with_exact_solution():
    result = evaluate_regime((REGIMES["spring, undamped"], 1e-3))
    assert result.reference < 1e-6
    assert 0.0 < result.ratio < 1.0


def test_violent_scene_stays_finite_without_energy_gain():
    result = run_violent((1, 5))
    assert result.finite
    assert not result.trouble
    assert result.evaluations > 0
    assert result.gain < 0.01


def test_violent_scene_frames_stay_within_work_limit():
    # Grippers jump in its frames; a former version took 1.2 times the limit in one of them.
    result = run_violent((1, 146))
    assert 0.5 < result.of_cap <= 1.0


def test_work_limited_frame_keeps_explicit_steps() -> None:
    """Undamped chain at a tolerance beyond its work limit.

    A former version switched to implicit steps with errors of centimetres: the rounded number of steps exceeded the
    remaining work.
    """
    chain = attrs.evolve(REGIMES["chain of 33, joints, undamped"], duration=0.2)
    run = record_run(regime_scene(chain, 1e-10))
    advances = [frame.advance for frame in run.frames]
    assert sum(done.flagged > 0 for done in advances) > 3
    assert {done.integrator for done in advances} == {"extrapolated"}
    assert max(done.error for done in advances) < 1e-10


def test_search_finds_violations_and_replays_them(tmp_path):
    file = tmp_path / "climbs.jsonl"
    # A particle that falls with light drag, at a tight tolerance, in still air.
    vector = np.array([0.5, 0.5, 0.5, 0.3, 0.4, 0.5])
    trial = evaluate_vector("falling", vector)
    assert len(trial.windows) == 2
    assert trial.parameters["drag"] == pytest.approx((0.02 * 5.0) ** 0.5)
    assert all(window.is_known and window.amplification <= 1.0 for window in trial.windows)
    climb = Climb("falling", "hill", 1, 0, 0.5)
    result = run_climb(climb)
    assert result.ratio >= result.median > 0.0
    assert result.windows == 2 * result.scenes
    assert evaluate_vector("falling", np.array(result.vector)).worst.ratio == result.ratio
    entry = {"case": attrs.asdict(climb), "result": attrs.asdict(result), "seconds": 1.0, "trouble": ""}
    file.write_text(json.dumps(entry) + "\n")
    assert main(["tolerance", "--replay", str(file)]) == int(result.ratio > 1.0)


@pytest.mark.parametrize("family", sorted(FAMILIES.keys() - {"contact"}))
def test_families_of_the_search_have_known_windows(family):
    size = FAMILIES[family][1]
    rng = np.random.default_rng(1)
    trials = [trial for _ in range(2) if (trial := evaluate_vector(family, rng.random(size))) is not None]
    windows = [window for trial in trials for window in trial.windows]
    assert windows
    assert any(window.is_known for window in windows)
    for trial in trials:
        json.dumps(trial.parameters)


def test_vector_generator_draws_coordinates():
    rng = VectorGenerator([0.25, 0.5, 1.0, 0.1])
    assert rng.uniform(2.0, 4.0) == 2.5
    assert rng.normal() == 0.0
    assert rng.choice(["a", "b"], p=[0.9, 0.1]) == "b"
    assert rng.integers(5, 15) == 6
    assert rng.random() == VectorGenerator([]).random()
