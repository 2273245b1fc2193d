# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Makes pictures of docs/images: nine sessions, simulated, recorded, and painted by `cloth_replay`.

.venv/bin/python scripts/session_pictures.py [name ...]
"""

from __future__ import annotations

import importlib
import itertools
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "test"), str(ROOT / "examples")]

from support.arm_examples import START, arm_events, arm_scene  # type: ignore[import-not-found]  # noqa: E402
from support.session_maker import SessionMaker, carried_corner  # type: ignore[import-not-found]  # noqa: E402

from cloth_sim_ros.replay.main import main as cloth_replay  # noqa: E402
from cloth_sim_ros.scene.parameters.parameter_file import read as read_parameters  # noqa: E402
from cloth_sim_ros.scene.scene import Scene  # noqa: E402
from cloth_sim_ros.simulation.ensemble import Ensemble  # noqa: E402
from cloth_sim_ros.simulation.events import Event, Grasp, Target  # noqa: E402
from cloth_sim_ros.simulation.gripper_script import GripperScript  # noqa: E402
from cloth_sim_ros.simulation.simulation import Simulation  # noqa: E402
from cloth_sim_ros.studies.run_recording import RunRecording  # noqa: E402

#: Orientation of a lying sheet.
FLAT = [0.0, 0.0, 0.0, 1.0]
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@attrs.frozen(kw_only=True)
class SessionPicture:
    """A session and the time of its picture."""

    values: dict[str, Any]
    events: Callable[[Scene], Iterator[list[Event]]]
    at: float
    strain_limit: float


def carry(scene: Scene) -> Iterator[list[Event]]:
    """A gripper grasps a bottom corner and carries it up."""
    yield from carried_corner(scene, 4.0)


def fold(scene: Scene) -> Iterator[list[Event]]:
    """Two grippers grasp the bottom corners and lift them over the top edge."""
    start = scene.initial_positions()
    rows, columns = scene.shape
    corners = {"left": start[(rows - 1) * columns], "right": start[-1]}
    for k in range(240):
        progress = _smooth((k - 20) / 180.0)
        rise = np.array([0.0, -0.55 * np.sin(np.pi * progress), 1.25 * progress * scene.cloth.size[0] * 0.8])
        events: list[Event] = [Target(name, tuple(at + rise), UPRIGHT) for name, at in corners.items()]
        if k == 10:
            events += [Grasp(name, True) for name in corners]
        yield events


def swing(scene: Scene) -> Iterator[list[Event]]:
    """A sheet held by its two upper corners is pulled sideways at its lower edge and released."""
    start = scene.initial_positions()
    rows, columns = scene.shape
    middle = start[(rows - 1) * columns + columns // 2]
    for k in range(180):
        displacement = _smooth((k - 10) / 80.0) * np.array([0.0, -0.6, 0.35])
        events: list[Event] = [Target("gripper", tuple(middle + displacement), UPRIGHT)]
        if k in (8, 110):
            events.append(Grasp("gripper", k == 8))
        yield events


def lift(scene: Scene) -> Iterator[list[Event]]:
    """A lying sheet, anchored at its corners, is lifted in the middle."""
    rows, columns = scene.shape
    middle = scene.initial_positions()[rows // 2 * columns + columns // 2]
    for k in range(240):
        rise = _smooth((k - 60) / 120.0) * np.array([0.0, 0.0, 0.45])
        events: list[Event] = [Target("gripper", tuple(middle + rise), UPRIGHT)]
        if k == 0:
            events.append(Grasp("gripper", True))
        yield events


def pinch(scene: Scene) -> Iterator[list[Event]]:
    """Script of pinch.yaml: a gripper pinches a towel where it hangs over a table's edge, and lifts it."""
    script = GripperScript.from_file(ROOT / "config" / "pinch_grasp.yaml")
    waiting = list(script.grasps)
    for k in range(round(9.0 * scene.rate)):
        events: list[Event] = [Target(script.gripper, *script.pose(k / scene.rate))]
        while waiting and waiting[0].time <= k / scene.rate:
            events.append(Grasp(script.gripper, waiting.pop(0).closed))
        yield events


PICTURES = {
    "grasp": SessionPicture(values={}, events=carry, at=2.4, strain_limit=3.0),
    "fold": SessionPicture(values={"grippers": ["left", "right"]}, events=fold, at=2.4, strain_limit=3.0),
    "swing": SessionPicture(
        values={"cloth.anchors": ["top_left", "top_right"], "gripper.radius": 0.08},
        events=swing,
        at=2.25,
        strain_limit=5.0,
    ),
    "lift": SessionPicture(
        values={
            "cloth.orientation": FLAT,
            "cloth.position": [0.0, 0.0, 0.6],
            "cloth.anchors": ["top_left", "top_right", "bottom_left", "bottom_right"],
            "material.stretch_modulus": 300.0,
            "material.shear_modulus": 30.0,
        },
        events=lift,
        at=3.6,
        strain_limit=30.0,
    ),
    "pinch": SessionPicture(
        values=read_parameters(ROOT / "config" / "pinch.yaml"), events=pinch, at=8.6, strain_limit=2.0
    ),
}


#: Example, and time of its path [s], for the picture of each parameter file with arms.
ARMS = {
    "robot_fold": ("fold_towel", 10.0),
    "robot_drape": ("drape_towel", 11.0),
    "robot_lift": ("lift_towel", 9.0),
}


def _smooth(progress: float) -> float:
    progress = float(np.clip(progress, 0.0, 1.0))
    return progress * progress * (3.0 - 2.0 * progress)


def paint(name: str) -> int:
    """Simulate, record and paint one picture; return the exit status of `cloth_replay`."""
    picture = PICTURES[name]
    scene = Scene.from_parameters({"cloth.resolution": [40, 40], **picture.values})
    with tempfile.TemporaryDirectory() as folder:
        maker = SessionMaker(Path(folder), scene, stem=name)
        for k, events in enumerate(picture.events(scene)):
            maker.add(events, diagnostics={"real_time_factor": "1.0", "late_frames": "0"} if k % 60 == 0 else None)
        out = ROOT / "docs" / "images" / f"{name}.png"
        return cloth_replay(
            [
                *(str(maker.finish()), "--screenshot", str(out), "--at", str(picture.at)),
                *("--size", "1280x760", "--strain-limit", str(picture.strain_limit)),
            ]
        )


def paint_uncertain(name: str) -> int:
    """Paint uncertain.yaml, coloured by the deviation of its ensemble; return the exit status of `cloth_replay`."""
    scene = Scene.from_file(ROOT / "config" / f"{name}.yaml")
    simulation = Simulation(scene)
    with tempfile.TemporaryDirectory() as folder, Ensemble(scene, scene.distribution()) as ensemble:
        recording = RunRecording(Path(folder), simulation, name=name, clouds=True)
        for _ in range(150):
            frame = simulation.advance()
            recording.add([], frame, ensemble.advance())
        out = ROOT / "docs" / "images" / f"{name}.png"
        session = recording.finish(reason="stopped")
        return cloth_replay([str(session), "--screenshot", str(out), "--at", "1.9", "--size", "1280x760"])


def paint_arms(name: str) -> int:
    """Play and paint an example of arms; return the exit status of `cloth_replay`."""
    example, at = ARMS[name]
    scene, links, joints = arm_scene(importlib.import_module(example), f"{name}.yaml")
    with tempfile.TemporaryDirectory() as folder:
        maker = SessionMaker(Path(folder), scene, stem=name)
        for events in itertools.islice(arm_events(scene, links, joints), round((at - START) * scene.rate)):
            maker.add(events)
        out = ROOT / "docs" / "images" / f"{name}.png"
        return cloth_replay([str(maker.finish()), "--screenshot", str(out), "--size", "1280x760"])


def painter(name: str) -> Callable[[str], int]:
    """Return the function that paints the picture of a name."""
    if name == "uncertain":
        return paint_uncertain
    return paint_arms if name in ARMS else paint


if __name__ == "__main__":
    names = sys.argv[1:] or [*PICTURES, "uncertain", *ARMS]
    sys.exit(max(painter(name)(name) for name in names))
