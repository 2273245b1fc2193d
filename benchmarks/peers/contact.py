# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Other engines on the same contact scenes: speed, penetration, creep."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any

import attrs
from support.problems import PERIOD

from benchmarks.peers import contact_measures
from benchmarks.peers import contact_runs as peer_contact
from benchmarks.peers import environment as peer_environment
from benchmarks.peers.contact_runs import ContactPeer, EngineRecording
from benchmarks.peers.contact_scenes import CONTACT_SCENES, DRAG, FRICTION, RADIUS, THICKNESS, TOLERANCE, ContactScene
from benchmarks.peers.jobs import PeerFailed
from benchmarks.peers.solvers import CONTACT_PEERS, REQUIREMENTS
from benchmarks.speed.curtain import cores
from validation.report import Report, Table, print_progress

PRODUCT = "cloth_sim_ros"
#: Packages with a peer that supports contact.
PACKAGES = {peer.package: REQUIREMENTS[peer.package] for peer in CONTACT_PEERS}
#: Final time over which the drape's creep is measured [s], and range of contact [thicknesses].
DRAPE_CREEP_TIME, CONTACT_RANGE = 0.5, 1.5
#: Settling time of the pinched sheet, and shortest time over which its creep is measured [s].
PINCH_SETTLING_TIME, MIN_PINCH_CREEP_TIME = 2.0, 0.5
#: Largest creep of the product in the pinch [m/s].
MAX_PINCH_CREEP = 1e-6
#: With fewer particles a side no particle lies between the pads.
_MIN_RESOLUTION = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--scenes", nargs="+", choices=CONTACT_SCENES, default=[*CONTACT_SCENES], help="which to run")
    parser.add_argument("--resolution", type=int, default=20, metavar="N", help="particles a side")
    peer_environment.add_arguments(parser, PACKAGES, seconds=60.0)


@attrs.frozen(kw_only=True)
class ContactResult:
    """Result of one engine on one scene."""

    scene: str
    engine: str
    #: Simulated seconds per wall second, and simulated time [s].
    factor: float
    simulated: float
    #: Largest penetration of any point of the cloth (measured on a ball), and of a particle [m].
    depth: float
    inside: float
    #: Longest edge over its length at rest.
    stretch: float
    #: Frames with self-intersection; None if self-contact is off.
    crossed: int | None = None
    #: Creep [m/s]; nan if unknown.
    creep: float = math.nan
    #: Reason of an early end, else empty.
    outcome: str = ""

    def row(self) -> list[Any]:
        """Return the row of the table."""
        crossed = "-" if self.crossed is None else self.crossed
        creep = "-" if math.isnan(self.creep) else 1e6 * self.creep
        start = [self.scene, self.engine, self.factor, 1e3 * self.depth, creep, crossed]
        return [*start, self.stretch, self.simulated, self.outcome]


def run(options: argparse.Namespace) -> Report:
    """Run the selected scenes and engines."""
    if not options.seconds > 0.0:
        raise ValueError(f"--seconds is {options.seconds:g}; it must be above 0")
    if options.resolution < _MIN_RESOLUTION:
        raise ValueError(f"--resolution is {options.resolution}; it must be at least {_MIN_RESOLUTION}")
    contact_scenes = [CONTACT_SCENES[name](options.resolution) for name in options.scenes]
    folder = options.environment.expanduser().absolute()
    requirements = {name: PACKAGES[name] for name in options.peers}
    absent = peer_environment.prepare(folder, requirements, print_progress) if requirements else {}
    peers = [peer for peer in CONTACT_PEERS if peer.package in requirements]
    report = Report("Peers in contact", f"python -m benchmarks peers-contact --resolution {options.resolution}")
    report.notes += [f"ABSENT: {name}: {reason}" for name, reason in absent.items()]
    columns = ["scene", "engine", "times real time", "deepest mm", "creep um/s", "frames crossed", "longest edge"]
    table = Table("Cloth that touches", [*columns, "seconds", "outcome"])
    for contact_scene in contact_scenes:
        print_progress(f"{contact_scene.name}: {PRODUCT}")
        with cores(one_core=True):
            product_result = evaluate(contact_scene, PRODUCT, peer_contact.run_product(contact_scene, options.seconds))
        table.rows.append(product_result.row())
        check_product(product_result, report)
        for peer in peers:
            if peer.package in absent:
                table.rows.append(_empty_row(contact_scene, peer, "ABSENT"))
                continue
            print_progress(f"{contact_scene.name}: {peer.name}")
            try:
                recording = peer_contact.run_peer(peer, contact_scene, options.seconds, environment=folder)
            except PeerFailed as error:
                report.note(f"FAILED: {contact_scene.name}: {error}")
                table.rows.append(_empty_row(contact_scene, peer, "FAILED"))
                continue
            report.environment |= recording.versions
            table.rows.append(evaluate(contact_scene, peer.name, recording).row())
            report.notes += [f"{contact_scene.name}: {peer.name} {remark}" for remark in recording.remarks]
    report.tables.append(table)
    _explain(options, contact_scenes, peers, report)
    return report


def evaluate(contact_scene: ContactScene, engine: str, recording: EngineRecording) -> ContactResult:
    """Evaluate an engine's recording of a scene."""
    frames, pads = recording.frames, recording.pads
    solids = zip(contact_scene.solids, contact_scene.solid_positions, strict=True)
    inside = [contact_measures.depth(frames, solid, position) for solid, position in solids]
    inside += [contact_measures.depth(frames, solid, pads[:, k]) for k, solid in enumerate(contact_scene.pads)]
    result = ContactResult(
        scene=contact_scene.name,
        engine=engine,
        factor=recording.factor,
        simulated=recording.simulated,
        depth=max(inside),
        inside=max(inside),
        stretch=contact_measures.stretch(frames, contact_scene.triangles),
        outcome=_outcome(contact_scene, recording),
    )
    return _MEASURES[contact_scene.name](contact_scene, recording, result)


def _drape(contact_scene: ContactScene, recording: EngineRecording, result: ContactResult) -> ContactResult:
    depth = contact_measures.depth_in_ball(recording.frames, contact_scene.triangles, RADIUS)
    n_frames = round(DRAPE_CREEP_TIME / PERIOD) + 1
    creep = math.nan
    if len(recording.frames) >= n_frames:
        frames, contact_range = recording.frames[-n_frames:], CONTACT_RANGE * THICKNESS
        creep = contact_measures.creep_on_ball(frames, DRAPE_CREEP_TIME, RADIUS, contact_range)
    return attrs.evolve(result, depth=depth, creep=creep)


def _fold(contact_scene: ContactScene, recording: EngineRecording, result: ContactResult) -> ContactResult:
    crossed = contact_measures.crossings(recording.frames, contact_scene.triangles, contact_scene.start)
    return attrs.evolve(result, crossed=len(crossed))


def _pinch(contact_scene: ContactScene, recording: EngineRecording, result: ContactResult) -> ContactResult:
    frames, pad = recording.frames, contact_scene.pads[0]
    fell = contact_measures.dropped(frames, pad, recording.pads)
    if fell is not None:
        return attrs.evolve(result, outcome=f"dropped at {fell * PERIOD:.2f} s")
    if recording.seen < PINCH_SETTLING_TIME + MIN_PINCH_CREEP_TIME:
        return result
    first = round(PINCH_SETTLING_TIME / PERIOD)
    between = contact_measures.between_pads(contact_scene.start, pad, contact_scene.pad_positions)
    creep = contact_measures.sinking(frames[first:], recording.seen - PINCH_SETTLING_TIME, between)
    return attrs.evolve(result, creep=creep)


_MEASURES: dict[str, Callable[[ContactScene, EngineRecording, ContactResult], ContactResult]] = {
    "drape": _drape,
    "fold": _fold,
    "pinch": _pinch,
}


def _outcome(contact_scene: ContactScene, recording: EngineRecording) -> str:
    if not recording.finite:
        return f"blew up after {recording.seen:.2f} s"
    if recording.seen < contact_scene.duration - 0.5 * PERIOD:
        return f"ended at {recording.seen:.2f} s of {contact_scene.duration:g}"
    return ""


def _empty_row(contact_scene: ContactScene, peer: ContactPeer, reason: str) -> list[Any]:
    return [contact_scene.name, peer.name, *["-"] * 6, reason]


def check_product(result: ContactResult, report: Report) -> None:
    """Report guarantees that the product violates."""
    if result.inside > 0.0:
        report.fail(f"{result.scene}: a particle of the product is {1e3 * result.inside:.3g} mm inside an obstacle")
    if result.crossed:
        report.fail(f"{result.scene}: the product intersects itself in {result.crossed} frames")
    if result.outcome.startswith("dropped"):
        report.fail(f"{result.scene}: the product is {result.outcome}")
    if result.scene == "pinch" and abs(result.creep) >= MAX_PINCH_CREEP:
        excess = f"creeps by {1e6 * result.creep:.3g} um/s; at most {1e6 * MAX_PINCH_CREEP:g}"
        report.fail(f"{result.scene}: the product {excess}")


def _explain(
    options: argparse.Namespace, contact_scenes: list[ContactScene], peers: list[ContactPeer], report: Report
) -> None:
    material = contact_scenes[0].scene.material
    report.notes += [
        f"all: {material.density:g} kg/m2, {1e3 * THICKNESS:g} mm thick, friction {FRICTION:g} at rest and in motion, "
        f"the same particles and triangles, frames of 1/{1.0 / PERIOD:.0f} s, one thread; only the wall time of steps "
        f"counts; a run ends after {options.seconds:g} s of it, and its figures cover the time until then",
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
            "triangle"
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
