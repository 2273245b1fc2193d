# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Equal bits of the same scenes with any vectors, C library or numpy; `make bits` tests more."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))
import bits  # noqa: E402
import bits_scenes  # noqa: E402

#: Frames of scenes with and without contact: the last body touches the cloth in the last one.
CONTACT_FRAMES, FRAMES = 24, 12
#: Scenes whose trace is made again: of one frame, and of as many as contact takes.
_PLAIN = ["axial springs", "implicit", "crossed springs", "raw springs"]
_CONTACT = ["obstacles", "pinch", "cloth on itself"]
#: A scene's, where none is given [m/s^2].
GRAVITY = -9.81


def has_contact(scene: str) -> bool:
    return "contact.thickness" in bits.SCENES[scene]


def run_scenes(configuration: Any) -> tuple[str, dict[str, list[str]]]:
    """Return the engine's name and the digests of all scenes' frames."""
    outputs = [
        bits.run_in_subprocess(
            configuration, frames, scenes=[scene for scene in bits.SCENES if has_contact(scene) == contact]
        )
        for frames, contact in ((FRAMES, False), (CONTACT_FRAMES, True))
    ]
    (engine,) = {output["engine"] for output in outputs}
    return engine, outputs[0]["digests"] | outputs[1]["digests"]


@pytest.fixture(scope="module")
def as_usual() -> dict[str, list[str]]:
    """Digests of all scenes' frames, by the engine that this machine takes."""
    return run_scenes(bits.run_configurations()[0])[1]


@pytest.mark.parametrize("configuration", bits.run_configurations()[1:], ids=lambda configuration: configuration.name)
def test_bits_are_the_same(as_usual: dict[str, list[str]], configuration: Any) -> None:
    if configuration.skip_reason:
        pytest.skip(f"{configuration.name}: {configuration.skip_reason}")
    if "CLOTH_SIM_ROS_ENGINE" in configuration.environment and not (bits.ENGINE / f"_{configuration.name}.so").exists():
        pytest.skip(f"{configuration.name}: not built")
    engine, digests = run_scenes(configuration)
    if "CLOTH_SIM_ROS_ENGINE" in configuration.environment:
        assert engine == configuration.name
    assert as_usual.keys() == digests.keys() == bits.SCENES.keys()
    assert bits.compare(as_usual, digests, configuration.name) == []


def test_scenes_use_both_precisions_and_all_integrators(monkeypatch: pytest.MonkeyPatch) -> None:
    from cloth_sim_ros.physics.plan.plan import Plan
    from cloth_sim_ros.simulation.simulation import Simulation

    precisions, orders, integrators = set(), set(), set()
    runs, advance = Plan.runs, Simulation.advance

    def watched(self: Plan, t: float, duration: float, start: Any, steps: Any, **options: Any) -> Any:
        precisions.add(bool(options.get("single_precision")))
        orders.add(len(steps))
        return runs(self, t, duration, start, steps, **options)

    def watched_advance(self: Simulation, events: Any = ()) -> Any:
        frame = advance(self, events)
        integrators.add(frame.integrator)
        return frame

    monkeypatch.setattr(Plan, "runs", watched)
    monkeypatch.setattr(Simulation, "advance", watched_advance)
    for scene in bits.SCENES:
        digests = list(bits.frames_of(scene, CONTACT_FRAMES if has_contact(scene) else FRAMES))
        assert len(set(digests)) == len(digests)
    assert precisions == {True, False}
    assert {1, 2, 3, 4} <= orders
    assert integrators == {"leapfrog", "extrapolated", "implicit"}


def test_contact_scenes_cover_every_contact() -> None:
    contacts, self_contacts, pinched = set(), set(), set()
    for scene in filter(has_contact, bits.SCENES):
        for _, simulation in bits_scenes.run(scene, CONTACT_FRAMES):
            gaps, contact = simulation.gaps(), simulation.plan.contact
            names = [obstacle.name for obstacle in contact.force.obstacles]
            contacts |= {(scene, name) for name, (count, _) in zip(names, gaps.tolist(), strict=True) if count}
            self_contacts |= {scene} if contact.self_gaps(simulation.state.x)[0] else set()
            pinched |= {scene} if simulation.grasped_count(0) and simulation.pinching else set()
    by_scene = {scene: {name for changed, name in contacts if changed == scene} for scene, _ in contacts}
    assert len(by_scene["obstacles"]) >= 3
    assert {"table"} <= by_scene["friction"] & by_scene["friction, implicit"]
    assert by_scene["pinch"] == {"gripper.left_pad", "gripper.right_pad"}
    assert self_contacts == {"cloth on itself", "mesh on itself", "joined nets with hinges"}
    assert pinched == {"pinch"}


def test_trace_describes_every_engine_function() -> None:
    import bits_trace

    # private: the declared calls
    from cloth_sim_ros.engine.binding import _SIGNATURES

    # An emulator has no Python for the first; no frame calls the others.
    omitted = {"cloth_plan_callback", "cloth_draw_triangles", "cloth_draw_solid"}
    assert _SIGNATURES.keys() - bits_trace.CALLS.keys() == omitted
    for name, (_, *arguments) in _SIGNATURES.items():
        if name not in omitted:
            assert len(bits_trace.CALLS[name][1]) == len(arguments), name


def test_first_differing_frame_is_reported(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    usual = {"one": ["a", "b", "c"], "two": ["d", "e", "f"]}
    changed = {"one": ["a", "x", "y"], "two": ["d", "e", "f"]}
    assert bits.compare(usual, changed, "there") == [bits.Difference("one", "there", 2)]
    answers = iter([usual, usual, changed])
    monkeypatch.setattr(bits, "run_in_subprocess", lambda *_, **__: {"engine": "any", "digests": next(answers)})
    ways = [(bits.RunConfiguration(name, {}, why_not), "python") for name, why_not in
             [("here", ""), ("absent", "no such thing"), ("same", ""), ("there", "")]]  # fmt: skip
    assert bits.compare_runs(ways, 3) == 1
    printed = capsys.readouterr().out
    assert "absent: left out, no such thing" in printed
    assert "same (any): 6 frames of 2 scenes, the same bits" in printed
    assert "  one: there differs from frame 2 on" in printed


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program that makes the calls of a trace again, on this machine's processor."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("there is no g++")
    program = tmp_path_factory.mktemp("replay") / "replay"
    source = ROOT / "scripts" / "bits_replay.cpp"
    subprocess.run(
        [compiler, "-std=c++20", "-O1", "-Wall", "-Wextra", "-Werror", source, "-o", program, "-ldl"], check=True
    )
    return program


@pytest.mark.parametrize("scene", [*_PLAIN, *_CONTACT])
def test_trace_replays_with_equal_bits(replay: Path, tmp_path: Path, scene: str) -> None:
    from cloth_sim_ros.engine.instruction_set import libraries

    trace = tmp_path / "trace"
    recorder = [
        sys.executable,
        ROOT / "scripts" / "bits_trace.py",
        trace,
        "--frames",
        bits.n_traced_frames(scene) if scene in _CONTACT else "1",
        scene,
    ]
    subprocess.run(recorder, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True)
    library = bits.ENGINE / f"_{libraries()[0]}.so"
    done = subprocess.run([replay, library, trace], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.fullmatch(r"[1-9]\d* calls of \d+ functions\n", done.stdout)
    # With gravity changed by its last bit something else comes out.
    content = bytearray(trace.read_bytes())
    content[content.index(struct.pack("<d", GRAVITY))] ^= 1
    trace.write_bytes(content)
    done = subprocess.run([replay, library, trace], capture_output=True, text=True)
    assert done.returncode == 1
    assert re.match(r"call \d+, of cloth_\w+: number \d+ of array \d+: ", done.stdout)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="an x86-64 C library is switched")
def test_plain_environment_changes_c_library_and_numpy() -> None:
    configuration = next(
        configuration for configuration in bits.run_configurations() if configuration.name.startswith("plain")
    )
    if not configuration.environment["NPY_DISABLE_CPU_FEATURES"]:
        pytest.skip("numpy takes nothing of this processor that it could do without")
    script = (
        "import json, math, sys; import numpy as np; sys.path.insert(0, 'scripts'); import bits\n"
        "x = np.linspace(0.1, 30.0, 20011)\n"
        "print(json.dumps([bits.numpy_features(), [math.exp(v) * math.sin(v) * math.tan(v) for v in x.tolist()]]))"
    )

    def output(environment: dict[str, str]) -> Any:
        done = subprocess.run(
            [sys.executable, "-c", script], cwd=ROOT, env={**os.environ, **environment}, capture_output=True, check=True
        )
        return json.loads(done.stdout)

    (features, values), (disabled, other_values) = output({}), output(configuration.environment)
    assert features
    assert disabled == []
    assert values != other_values
