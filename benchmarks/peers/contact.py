# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Other engines on the same contact scenes: speed, penetration, creep."""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from support.problems import PERIOD

from benchmarks.peers import contact_scenes as peer_scenes
from benchmarks.peers import environment as peer_environment
from benchmarks.peers.contact_scenes import CONTACT_SCENES, DRAG, FRICTION, RADIUS, THICKNESS, TOLERANCE, ContactScene
from benchmarks.peers.environment import Attempt, Peer, PeerFailed
from benchmarks.peers.runner import largest_stretch
from benchmarks.peers.solvers import CONTACT_PEERS, REQUIREMENTS
from benchmarks.speed.curtain import cores
from cloth_sim_ros import Grasp, Model, Simulation, Target
from cloth_sim_ros.physics.contact import self_contact_binding
from cloth_sim_ros.physics.contact.initial_penetration import find_self_intersection
from cloth_sim_ros.physics.contact.obstacle_mesh import nearest_points
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.sleep import wake
from validation.command import at_least
from validation.report import Report, Table, print_progress

#: Stretch of an edge above which a peer's sheet is torn.
TORN = 1.5


@attrs.frozen(eq=False, kw_only=True)
class EngineRecording(Attempt):
    """Run of a scene with contact, and the positions at the start and at the end of every whole frame."""

    #: Particles [m], (frames + 1, n, 3).
    frames: Array
    #: Centres of the pads [m], (frames + 1, pads, 3).
    pads: Array

    @property
    def seen(self) -> float:
        """Time of the last whole frame [s]."""
        return (len(self.frames) - 1) * PERIOD


def run_product(contact_scene: ContactScene, seconds: float) -> EngineRecording:
    """Run a scene by the product as shipped, without sleep: the cloth is woken before each frame.

    Args:
        contact_scene: the scene.
        seconds: limit of the wall time of the frames [s].
    """
    simulation = Simulation(contact_scene.scene)
    frames, pads, wall, cpu = [simulation.positions], [contact_scene.pad_positions], 0.0, 0.0
    for frame in range(contact_scene.frames):
        commands = _events(contact_scene, frame)
        begin, cpu_begin = time.perf_counter(), time.process_time()
        wake(simulation.state)
        simulation.advance(commands)
        wall, cpu = wall + time.perf_counter() - begin, cpu + time.process_time() - cpu_begin
        frames.append(simulation.positions)
        pinching = simulation.pinching
        pads.append(contact_scene.pad_positions if pinching is None else pinching.poses()[:, :3])
        if wall >= seconds:
            break
    stretch = max(largest_stretch(x, contact_scene.edges, contact_scene.edge_lengths) for x in frames)
    return EngineRecording(
        steps=1,
        whole=True,
        stretch=stretch,
        n_steps=len(frames) - 1,
        wall=wall,
        cpu=cpu,
        frames=np.array(frames),
        pads=np.array(pads),
    )


def _events(contact_scene: ContactScene, frame: int) -> list[Event]:
    """Return the commands to the grippers before a frame."""
    names = contact_scene.scene.gripper_names
    if contact_scene.pads:
        position = contact_scene.pad_positions.mean(axis=0)
        return [] if frame else [Target(names[0], position), Grasp(names[0], True)]
    if frame > contact_scene.hold or not names:
        return []
    if frame == contact_scene.hold:
        return [Grasp(name, False) for name in names]
    ends = contact_scene.path[frame + 1]
    commands: list[Event] = [Target(name, end) for name, end in zip(names, ends, strict=True)]
    return commands if frame else commands + [Grasp(name, True) for name in names]


def run_peer(
    peer: Peer, contact_scene: ContactScene, steps: int, seconds: float, *, environment: Path
) -> EngineRecording:
    """Run a scene by another engine on one thread, in a process of the peers' environment.

    Args:
        peer: the engine.
        contact_scene: the scene.
        steps: steps per frame of 1/60 s.
        seconds: limit of the wall time of the steps [s].
        environment: where the engines are installed.

    Raises:
        PeerFailed: if the engine gives no result.
    """
    with tempfile.TemporaryDirectory() as folder:
        sheet, record = Path(folder, "sheet.npz"), Path(folder, "record.npz")
        np.savez(sheet, **contact_scene.tables())
        attempt = peer_environment.attempt(
            peer,
            sheet,
            steps,
            environment=environment,
            frames=contact_scene.frames,
            seconds=seconds,
            whole=TORN,
            record=str(record),
            hold=contact_scene.hold,
        )
        with np.load(record) as arrays:
            return EngineRecording(frames=arrays["frames"], pads=arrays["pads"], **attrs.asdict(attempt))


def depth_in_ball(frames: Array, triangles: NDArray[np.int64], radius: float) -> float:
    """Return the largest depth of any triangle point in a ball about the origin [m]; 0 without penetration.

    Args:
        frames: positions [m], (frames, n, 3).
        triangles: (t, 3).
        radius: of the ball [m].
    """
    nearest = radius
    for x in frames:
        # A triangle without area has no normal; its edges are used.
        with np.errstate(invalid="ignore", divide="ignore"):
            points = nearest_points(np.zeros((1, 3)), x[triangles])[0]
        nearest = min(nearest, float(np.sqrt(np.nanmin((points * points).sum(axis=1)))))
    return radius - nearest


def depth(frames: Array, solid: Obstacle, places: Array) -> float:
    """Return the largest depth of any particle in an obstacle [m]; 0 without penetration.

    Args:
        frames: positions [m], (frames, n, 3).
        solid: the obstacle, without rotation.
        places: its position in each frame, or in all frames [m], (frames, 3) or (3,).
    """
    away = frames - np.broadcast_to(places, (len(frames), 3))[:, None, :]
    gaps, _ = solid.distance(away.reshape(-1, 3))
    return max(0.0, -float(gaps.min()))


def crossings(frames: Array, triangles: NDArray[np.int64], rest_positions: Array) -> list[int]:
    """Return the indices of frames in which an edge of the cloth intersects one of its triangles.

    Args:
        frames: positions [m], (frames, n, 3).
        triangles: (t, 3).
        rest_positions: positions at rest [m], (n, 3).
    """
    plan = PlanHandle(Model(np.ones(len(rest_positions)), []))
    # The thickness does not matter for intersection.
    surface = ContactSurface(triangles, rest_positions, thickness=1e-9)
    self_contact_binding.upload_surface(plan.pointer, Contact(thickness=1e-9, surface=surface))
    intersections = (find_self_intersection(plan, np.ascontiguousarray(x.T)) for x in frames)
    return [index for index, intersection in enumerate(intersections) if intersection is not None]


def creep_on_ball(frames: Array, seconds: float, radius: float, contact_range: float) -> float:
    """Return the mean speed of the fastest particle on a ball [m/s]; nan if none is on it.

    Args:
        frames: positions over the measured time [m], (frames, n, 3).
        seconds: length of that time [s].
        radius: of the ball about the origin [m].
        contact_range: a particle within this distance of the ball at both ends of the time is on it [m].
    """
    first, last = frames[0], frames[-1]
    in_contact = np.ones(frames.shape[1], dtype=bool)
    for x in (first, last):
        in_contact &= np.linalg.norm(x, axis=1) - radius <= contact_range
    if not in_contact.any():
        return float("nan")
    return float(np.linalg.norm(last - first, axis=1)[in_contact].max()) / seconds


def sinking(frames: Array, seconds: float, between: NDArray[np.bool_]) -> float:
    """Return the mean downward speed of some particles [m/s].

    Args:
        frames: positions over the measured time [m], (frames, n, 3).
        seconds: length of that time [s].
        between: mask of these particles, (n,).
    """
    return float((frames[0] - frames[-1])[between, 2].mean()) / seconds


def between_pads(start: Array, solid: Obstacle, places: Array) -> NDArray[np.bool_]:
    """Return the mask of particles between the pads, (n,).

    Args:
        start: positions [m], (n, 3).
        solid: a pad; y is normal to its faces.
        places: positions of both pads [m], (2, 3).
    """
    x, _, z = (0.5 * length for length in solid.size)
    away = np.abs(start - places.mean(axis=0))
    return np.asarray((away[:, 0] <= x) & (away[:, 2] <= z))


def dropped(frames: Array, solid: Obstacle, pads: Array) -> int | None:
    """Return the index of the first frame with all of the cloth below the pads; None if there is none.

    Args:
        frames: positions [m], (frames, n, 3).
        solid: a pad.
        pads: positions of both [m], (frames, 2, 3).
    """
    below = frames[:, :, 2].max(axis=1) < pads[:, :, 2].min(axis=1) - 0.5 * solid.size[2]
    return int(np.argmax(below)) if below.any() else None


PRODUCT = "cloth_sim_ros"
#: Packages with a peer that supports contact.
PACKAGES = {peer.package: REQUIREMENTS[peer.package] for peer in CONTACT_PEERS}
#: Final time over which the drape's creep is measured [s], and range of contact [thicknesses].
DRAPE_CREEP_TIME, CONTACT_RANGE = 0.5, 1.5
#: Settling time of the pinched sheet, and shortest time over which its creep is measured [s].
PINCH_SETTLING_TIME, MIN_PINCH_CREEP_TIME = 2.0, 0.5
#: Largest creep of the product in the pinch [m/s].
MAX_PINCH_CREEP = 1e-6
#: Largest penetration [m] and stretch along the threads of a valid run.
MAX_DEPTH, MAX_STRETCH = 0.1 * THICKNESS, 1.02
#: Times at which the fold is compared with the reference, before layers touch [s].
ERROR_TIMES = (0.5, 0.75, 1.0)
COLUMNS = ["scene", "engine", "step", "times real time", "by processor time", "deepest mm", "creep um/s"]
COLUMNS += ["frames crossed", "longest edge", "error mm", "seconds", "outcome"]
#: With fewer particles a side no particle lies between the pads.
_MIN_RESOLUTION = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--scenes", nargs="+", choices=CONTACT_SCENES, default=[*CONTACT_SCENES], help="which to run")
    parser.add_argument(
        "--resolution", type=at_least(_MIN_RESOLUTION), default=20, metavar="N", help="particles a side"
    )
    peer_environment.add_arguments(parser, PACKAGES, seconds=60.0)


@attrs.frozen(kw_only=True)
class ContactResult:
    """Result of one engine on one scene."""

    scene: str
    engine: str
    recording: EngineRecording
    #: Largest penetration of any point of the cloth (measured on a ball), and of a particle [m].
    depth: float
    inside: float
    #: Frames with self-intersection; None if self-contact is off.
    crossed: int | None = None
    #: Creep [m/s], and distance from the reference [m]; nan if unknown.
    creep: float = math.nan
    error: float = math.nan
    #: Whether the run covers the whole motion; reason of an early end or a failure, else empty.
    complete: bool = True
    outcome: str = ""

    @property
    def step(self) -> str:
        """Length of a step."""
        return f"1/{self.recording.steps / PERIOD:.0f} s"

    @property
    def violations(self) -> list[str]:
        """Violated limits; a valid run has none."""
        limits = {
            f"crosses itself in {self.crossed} frames": bool(self.crossed),
            f"sinks by {1e3 * self.depth:.2g} mm": self.depth > MAX_DEPTH,
            f"stretches by {100.0 * (self.recording.stretch - 1.0):.3g} %": self.recording.stretch > MAX_STRETCH,
            self.outcome: self.outcome,
        }
        return [name for name, violated in limits.items() if violated]

    def row(self, step: str, outcome: str) -> list[Any]:
        """Return the row of the table."""
        recording, crossed = self.recording, "-" if self.crossed is None else self.crossed
        creep = "-" if math.isnan(self.creep) else 1e6 * self.creep
        error = "-" if math.isnan(self.error) else 1e3 * self.error
        start = [self.scene, self.engine, step, recording.factor, recording.cpu_factor, 1e3 * self.depth, creep]
        return [*start, crossed, recording.stretch, error, recording.simulated, outcome]


def run(options: argparse.Namespace) -> Report:
    """Run the selected scenes and engines."""
    contact_scenes = [CONTACT_SCENES[name](options.resolution) for name in options.scenes]
    report = Report("Peers in contact")
    folder, absent = peer_environment.prepare_selected(options, PACKAGES, report)
    peers = [peer for peer in CONTACT_PEERS if peer.package in options.peers]
    table, tried = Table("Cloth that touches", COLUMNS), Table("Each step tried", COLUMNS)
    for contact_scene in contact_scenes:
        print_progress(f"{contact_scene.name}: {PRODUCT}")
        with cores(one_core=True):
            result = evaluate(contact_scene, PRODUCT, run_product(contact_scene, options.seconds))
            if contact_scene.name == "fold":
                frames = fold_reference(options.resolution, TOLERANCE)
                result = attrs.evolve(result, error=deviation(frames, options.resolution))
        table.rows.append(result.row(f"tolerance {1e3 * TOLERANCE:g} mm", result.outcome))
        check_product(result, report)
        for peer in peers:
            if peer.package in absent:
                table.rows.append(_empty_row(contact_scene, peer, "ABSENT"))
                continue

            def attempt(steps: int, peer: Peer = peer, contact_scene: ContactScene = contact_scene) -> ContactResult:
                recording = run_peer(peer, contact_scene, steps, options.seconds, environment=folder)
                return evaluate(contact_scene, peer.name, recording, comparable=peer.comparable)

            try:
                result, results = search(attempt)
            except PeerFailed as error:
                report.note(f"FAILED: {contact_scene.name}: {error}")
                table.rows.append(_empty_row(contact_scene, peer, "FAILED"))
                continue
            report.environment |= result.recording.versions
            tried.rows += [entry.row(entry.step, ", ".join(entry.violations)) for entry in results]
            invalid = f"no valid step in {options.seconds:g} s: {', '.join(result.violations)}"
            table.rows.append(result.row(result.step, invalid if result.violations else ""))
            report.notes += [f"{contact_scene.name}: {peer.name} {remark}" for remark in result.recording.remarks]
    report.tables += [table, tried]
    _explain(options, contact_scenes, peers, report)
    return report


def search(attempt: Callable[[int], ContactResult]) -> tuple[ContactResult, list[ContactResult]]:
    """Search the longest valid step of an engine.

    Args:
        attempt: runs a scene with a number of steps per frame.

    Returns:
        The result with the longest valid step, or without one that of the shortest step that covers the whole motion;
        and all results.
    """
    results: dict[int, ContactResult] = {}

    def is_valid(steps: int) -> bool | None:
        result = results[steps] = attempt(steps)
        print_progress(f"{result.scene}: {result.engine}, {result.step}: {', '.join(result.violations) or 'valid'}")
        return None if result.recording.whole and not result.complete else not result.violations

    longest = peer_environment.longest_step(is_valid, 1)
    tried = [*results.values()]
    if longest is not None:
        return results[longest], tried
    return results[max([steps for steps, result in results.items() if result.complete] or results)], tried


@cache
def fold_reference(resolution: int, tolerance: float) -> Array:
    """Return the product's fold with the peers' material until the last of `ERROR_TIMES` [m], (frames + 1, n, 3)."""
    contact_scene = peer_scenes.fold(resolution, tolerance=tolerance, **peer_scenes.PEER_MATERIAL)
    return run_product(attrs.evolve(contact_scene, duration=ERROR_TIMES[-1]), math.inf).frames


def deviation(frames: Array, resolution: int) -> float:
    """Return the largest distance of a particle from the reference at `ERROR_TIMES` [m]; nan if the run is shorter."""
    indices = [round(time / PERIOD) for time in ERROR_TIMES]
    if len(frames) <= indices[-1]:
        return math.nan
    reference = fold_reference(resolution, 0.01 * TOLERANCE)
    return float(np.linalg.norm(frames[indices] - reference[indices], axis=2).max())


def evaluate(
    contact_scene: ContactScene, engine: str, recording: EngineRecording, *, comparable: bool = False
) -> ContactResult:
    """Evaluate an engine's recording of a scene; the error only of a comparable material."""
    frames, pads = recording.frames, recording.pads
    solids = zip(contact_scene.solids, contact_scene.solid_positions, strict=True)
    inside = [depth(frames, solid, position) for solid, position in solids]
    inside += [depth(frames, solid, pads[:, k]) for k, solid in enumerate(contact_scene.pads)]
    outcome = _outcome(contact_scene, recording)
    values: dict[str, Any] = {"depth": max(inside), "inside": max(inside), "complete": not outcome, "outcome": outcome}
    if comparable and contact_scene.name == "fold":
        values["error"] = deviation(frames, contact_scene.scene.cloth.resolution[0])
    values |= _MEASURES[contact_scene.name](contact_scene, recording)
    return ContactResult(scene=contact_scene.name, engine=engine, recording=recording, **values)


def _drape(contact_scene: ContactScene, recording: EngineRecording) -> dict[str, Any]:
    depth = depth_in_ball(recording.frames, contact_scene.triangles, RADIUS)
    n_frames = round(DRAPE_CREEP_TIME / PERIOD) + 1
    creep = math.nan
    if len(recording.frames) >= n_frames:
        frames, contact_range = recording.frames[-n_frames:], CONTACT_RANGE * THICKNESS
        creep = creep_on_ball(frames, DRAPE_CREEP_TIME, RADIUS, contact_range)
    return {"depth": depth, "creep": creep}


def _fold(contact_scene: ContactScene, recording: EngineRecording) -> dict[str, Any]:
    return {"crossed": len(crossings(recording.frames, contact_scene.triangles, contact_scene.start))}


def _pinch(contact_scene: ContactScene, recording: EngineRecording) -> dict[str, Any]:
    frames, pad = recording.frames, contact_scene.pads[0]
    fell = dropped(frames, pad, recording.pads)
    if fell is not None:
        return {"outcome": f"dropped at {fell * PERIOD:.2f} s"}
    if recording.seen < PINCH_SETTLING_TIME + MIN_PINCH_CREEP_TIME:
        return {}
    first = round(PINCH_SETTLING_TIME / PERIOD)
    between = between_pads(contact_scene.start, pad, contact_scene.pad_positions)
    return {"creep": sinking(frames[first:], recording.seen - PINCH_SETTLING_TIME, between)}


_MEASURES = {"drape": _drape, "fold": _fold, "pinch": _pinch}


def _outcome(contact_scene: ContactScene, recording: EngineRecording) -> str:
    if not recording.whole:
        return f"torn after {recording.seen:.2f} s"
    if recording.seen < contact_scene.duration - 0.5 * PERIOD:
        return f"ended at {recording.seen:.2f} s of {contact_scene.duration:g}"
    return ""


def _empty_row(contact_scene: ContactScene, peer: Peer, reason: str) -> list[Any]:
    return [contact_scene.name, peer.name, *["-"] * (len(COLUMNS) - 3), reason]


def check_product(result: ContactResult, report: Report) -> None:
    """Report guarantees that the product violates."""
    if result.inside > 0.0:
        report.fail(f"{result.scene}: a particle of the product is {1e3 * result.inside:.3g} mm inside an obstacle")
    report.require(not result.crossed, f"{result.scene}: the product intersects itself in {result.crossed} frames")
    report.require(not result.outcome.startswith("dropped"), f"{result.scene}: the product is {result.outcome}")
    if result.scene == "pinch" and abs(result.creep) >= MAX_PINCH_CREEP:
        excess = f"creeps by {1e6 * result.creep:.3g} um/s; at most {1e6 * MAX_PINCH_CREEP:g}"
        report.fail(f"{result.scene}: the product {excess}")


def _explain(
    options: argparse.Namespace, contact_scenes: list[ContactScene], peers: list[Peer], report: Report
) -> None:
    material = contact_scenes[0].scene.material
    report.notes += [
        f"all: {material.density:g} kg/m2, {1e3 * THICKNESS:g} mm thick, friction {FRICTION:g} at rest and in motion, "
        f"the same particles and triangles, frames of 1/{1.0 / PERIOD:.0f} s, one thread, over the whole motion unless "
        "the outcome says otherwise; only the steps are timed, by the wall clock and by the engine's processor time",
        f"a peer's step is the longest, to about a fifth, at which its sheet sinks by at most {1e3 * MAX_DEPTH:g} mm, "
        f"no edge along the threads exceeds {MAX_STRETCH:g} times its rest length and, with self-contact, no frame is "
        f"crossed; the pinched sheet stays between the pads. Steps are tried from 1/{1.0 / PERIOD:.0f} s down by "
        f"halves, each for {options.seconds:g} s at most and until an edge exceeds {TORN:g} times its rest length; "
        "without a valid step, the shortest of the whole motion is shown",
        f"{PRODUCT}: {material.stretch_modulus:g} N/m along the threads, {material.shear_modulus:g} N/m in shear, "
        f"damping {material.damping:g}, axial bending, drag {DRAG:g} 1/s, tolerance {TOLERANCE:g} m, sleep off: it is "
        "woken before each frame; its thickness is the distance from an obstacle to the middle of the sheet, and "
        "between layers",
    ]
    descriptions = {
        "drape": (
            f"drape: a sheet of 0.5 m falls by 10 mm on a ball of {RADIUS:g} m; deepest is any point of a triangle in "
            f"it; creep is the largest mean speed of a particle within "
            f"{CONTACT_RANGE:g} thicknesses of it over the last {DRAPE_CREEP_TIME:g} s"
        ),
        "fold": (
            "fold: one edge of a sheet of 0.3 m on a table is carried in half a circle to the anchored other edge and "
            "released after 2 s; deepest is a particle in the table; crossed are frames in which an edge intersects a "
            "triangle; error is the largest distance of a particle, at "
            f"{', '.join(f'{time:g}' for time in ERROR_TIMES)} s, before layers touch, from the product's motion at "
            f"tolerance {0.01 * TOLERANCE:g} m with the peers' material, isotropic with a bending modulus of "
            f"{peer_scenes.PEER_BENDING:g} N m. The product's error is at tolerance "
            f"{TOLERANCE:g} m with that material; that of a peer includes the discretization of its shell"
        ),
        "pinch": (
            "pinch: a sheet of 0.18 x 0.09 m, half as many particles across, hangs from two pads that press with 4 N "
            f"each, 40 mm wide, over its upper quarter; creep is the mean sinking speed of the clamped part from "
            f"{PINCH_SETTLING_TIME:g} s on; deepest is a particle in a pad"
        ),
    }
    report.notes += [descriptions[contact_scene.name] for contact_scene in contact_scenes]
    for peer in peers:
        report.note(f"{peer.name}: {peer.differs}")
        for contact_scene in contact_scenes:
            if contact_scene.name in peer.apart:
                report.note(f"{contact_scene.name}: {peer.name}: {peer.apart[contact_scene.name]}")
