# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is measured of a tree, by name: the same scenes, steps and clocks whichever tree it is.

Loaded by `engine_worker` beside the package of either tree; what the trees call differently is in `engine_side_new` and
`engine_side_old`. Processor time where one thread works, the wall clock where a user waits.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

Job = Callable[[], dict[str, Any]]

PERIOD = 1.0 / 60.0
#: A step so short [s] that nothing moves, however many are timed.
STILL = 1e-9
#: No fewer steps than these are timed at once.
FEWEST_STEPS = 40
#: The scene of config/cloth_sim.yaml, without air across the sheet.
DEFAULT_CLOTH: dict[str, Any] = {
    "rate": 60.0,
    "cloth.size": [1.0, 1.0],
    "cloth.resolution": [30, 30],
    "cloth.position": [0.0, 0.0, 1.0],
    "cloth.anchors": ["top"],
    "material.density": 0.2,
    "material.stretch_modulus": 1000.0,
    "material.shear_modulus": 100.0,
    "material.damping": 0.1,
    "wind.normal_drag": 0.0,
    "grippers": ["gripper"],
    "gripper.radius": 0.05,
}
#: The circle that the gripper moves on: radius [m] and time of a turn [s].
_CIRCLE, _TURN = 0.15, 2.0


@cache
def side() -> Any:
    """What belongs to the tree that is loaded."""
    new = importlib.util.find_spec("cloth_sim_ros.physics.plan") is not None
    return importlib.import_module("engine_side_new" if new else "engine_side_old")


def prepare(name: str, options: dict[str, Any]) -> Job:
    """Make a job ready: scenes built, everything compiled.

    Raises:
        ValueError: for an unknown job.
    """
    if name not in JOBS:
        raise ValueError(f"no job '{name}'; there are {', '.join(JOBS)}")
    return JOBS[name](**options)


def sheet_start(resolution: int) -> tuple[Any, Any]:
    """Positions and velocities (3, n) of a square sheet of 1 m, a little waved."""
    along = np.linspace(0.0, 1.0, resolution)
    x = np.zeros((3, resolution, resolution))
    x[0], x[1] = along, -along[:, None]
    x[2] = 0.01 * np.sin(9.0 * x[0]) * np.sin(7.0 * x[1])
    x = np.ascontiguousarray(x.reshape(3, -1))
    return x, np.zeros_like(x)


def shuffled_mesh(particles: int) -> tuple[Any, Any]:
    """Vertices (n, 3) in random order and triangles (m, 3) of a square sheet of 1 m."""
    from scipy.spatial import Delaunay

    random = np.random.default_rng(5)
    edge = max(round(particles**0.5), 2)
    plane = np.stack(np.meshgrid(np.arange(edge), np.arange(edge)), axis=-1).reshape(-1, 2) / (edge - 1.0)
    inner = ((plane > 0.0) & (plane < 1.0)).all(axis=1)
    plane[inner] += random.uniform(-0.3, 0.3, (int(inner.sum()), 2)) / edge
    plane = plane[random.permutation(len(plane))]
    rest = np.concatenate([plane, np.zeros((len(plane), 1))], axis=1)
    return rest, Delaunay(plane).simplices.astype(np.int64)


def step(*, resolution: int, narrow: bool, updates: int) -> Job:
    """A whole step of the six damped families, with gravity and drag, on one core."""
    x, v = sheet_start(resolution)
    return _per_step(side().sheet_runner(resolution, narrow, x, v), resolution**2, updates)


def forces(*, resolution: int, updates: int) -> Job:
    """One evaluation of the six families' forces in double precision, on one core."""
    x, v = sheet_start(resolution)
    evaluate = side().sheet_forces(resolution, x, v)
    count = max(updates // (2 * resolution**2), FEWEST_STEPS)
    evaluate()

    def job() -> dict[str, Any]:
        begin = time.process_time()
        for _ in range(count):
            evaluate()
        return {"seconds": (time.process_time() - begin) / count}

    return job


def mesh_step(*, particles: int, updates: int) -> Job:
    """A step of an irregular mesh, damped, in air, with vertices in random order."""
    rest, triangles = shuffled_mesh(particles)
    return _per_step(side().mesh_runner(rest, triangles), len(rest), updates)


def bending_step(*, resolution: int, bending: str, updates: int) -> Job:
    """A step of the default cloth with hinges, and without grippers."""
    values = {**DEFAULT_CLOTH, "cloth.resolution": [resolution, resolution], "bending.model": bending}
    if bending != "opposite":
        values["material.bending_modulus"] = 1e-5
    return _per_step(side().simulation_runner(_simulation(values)), resolution**2, updates)


def carried(*, tolerance: float, resolution: int, warm: int, frames: int, share: bool = False) -> Job:
    """A frame of the default cloth whose corner a gripper carries round; with `share`, how much of it is Python's."""
    from cloth_sim_ros import Grasp, Target

    values = {**DEFAULT_CLOTH, "cloth.resolution": [resolution, resolution], "tolerance": tolerance}
    corner = _simulation(values).positions[-1]

    def target(frame: int) -> Any:
        angle = 2.0 * np.pi * frame * PERIOD / _TURN
        return Target("gripper", corner + _CIRCLE * np.array([0.0, np.sin(angle), 1.0 - np.cos(angle)]))

    def job() -> dict[str, Any]:
        simulation = _simulation(values)
        simulation.advance([target(0), Grasp("gripper", True)])
        for frame in range(1, warm):
            simulation.advance([target(frame)])
        figures = _frames(simulation, [[target(frame)] for frame in range(warm, warm + frames)], share=share)
        figures["seconds"] = figures.pop("mean")
        return figures

    job()
    return job


def curtain(*, resolution: int, tolerance: float, frames: int) -> Job:
    """A simulated second of scene C as shipped: an edge pinned, dropped from flat, on all cores."""
    make, advance = side().curtain(resolution, tolerance)

    def job() -> dict[str, Any]:
        equations, state = make()
        busy, begin = time.process_time(), time.perf_counter()
        for frame in range(frames):
            advance(equations, state, frame * PERIOD, PERIOD)
        wall, busy = time.perf_counter() - begin, time.process_time() - busy
        return {"seconds": wall / (frames * PERIOD), "processor": busy / (frames * PERIOD)}

    job()
    return job


def garment(*, vertices: int, bending: str, tolerance: float, warm: int, frames: int) -> Job:
    """A frame of a T-shirt that two grippers swing."""
    from cloth_sim_ros import Grasp, Scene, Simulation, Target

    shirt = importlib.import_module("garment")
    values = shirt.parameters(bending=bending, tolerance=tolerance)
    scene = Scene.from_parameters(values, files={"garment.obj": shirt.obj_file(vertices)})
    names = list(shirt.SHOULDERS)

    def events(frame: int) -> list[Any]:
        return [Target(name, shirt.target(name, frame * PERIOD)) for name in names]

    def job() -> dict[str, Any]:
        simulation = Simulation(scene)
        done = simulation.advance([*events(0), *(Grasp(name, True) for name in names)])
        if not all(grasp.held for grasp in done.grasps):
            raise RuntimeError(f"a gripper holds nothing: {done.grasps}")
        for frame in range(1, warm):
            simulation.advance(events(frame))
        figures = _frames(simulation, [events(frame) for frame in range(warm, warm + frames)])
        figures["seconds"] = figures.pop("median")
        figures["vertices"] = len(simulation.positions)
        return figures

    # What is compiled on the way is then there.
    Simulation(scene).advance([*events(0), *(Grasp(name, True) for name in names)])
    return job


JOBS: dict[str, Callable[..., Job]] = {
    job.__name__: job for job in (step, forces, mesh_step, bending_step, carried, curtain, garment)
}


def _simulation(values: dict[str, Any]) -> Any:
    from cloth_sim_ros import Scene, Simulation

    return Simulation(Scene.from_parameters(values))


def _frames(simulation: Any, events: list[list[Any]], *, share: bool = False) -> dict[str, Any]:
    """Advance a frame for each list of events; return times of frames [s], steps and evaluations."""
    times, steps, evaluations = [], 0, 0
    timer = side().EngineTimer() if share else None
    busy = time.process_time()
    for given in events:
        begin = time.perf_counter()
        done = simulation.advance(given)
        times.append(time.perf_counter() - begin)
        if not (done.advance and done.advance.steps):
            raise RuntimeError(f"frame {done.index} was not computed: the cloth sleeps")
        steps, evaluations = steps + done.advance.steps, evaluations + done.advance.evaluations
    figures = {
        "processor": (time.process_time() - busy) / len(times),
        "mean": float(np.mean(times)),
        "median": float(np.median(times)),
        "p99": float(np.percentile(times, 99)),
        "steps": steps / len(times),
        "evaluations": evaluations / len(times),
    }
    if timer is not None:
        figures["python"] = 1.0 - timer.stop() / float(np.sum(times))
    return figures


def _per_step(run: Callable[[int], None], particles: int, updates: int) -> Job:
    """One step, as the difference of a long and a short run over the steps between: what a call costs falls out."""
    long = max(updates // particles, FEWEST_STEPS)
    short = max(long // 8, 1)
    run(short)

    def job() -> dict[str, Any]:
        spent = []
        for steps in (short, long):
            begin = time.process_time()
            run(steps)
            spent.append(time.process_time() - begin)
        return {"seconds": (spent[1] - spent[0]) / (long - short)}

    return job
