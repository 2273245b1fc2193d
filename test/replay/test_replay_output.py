# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_replay`: contents of recordings, pictures, and error messages."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.rrd import rows
from support.session_maker import NODE, SessionMaker, carried_corner, make_grasp, status_bytes

from cloth_sim_ros.replay import viewer
from cloth_sim_ros.replay.main import main
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.writer import WriterOptions
from cloth_sim_ros.simulation.events import Grasp, Reset, SetParameters, Target

pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")

SMALL = {"cloth.resolution": [8, 9], "cloth.size": [0.4, 0.45], "material.stretch_modulus": 100.0,
         "material.shear_modulus": 10.0, "bending.stiffness": 0.5}  # fmt: skip


@pytest.mark.parametrize("velocity", [False, True], ids=["positions", "velocities too"])
def test_rerun_recording_holds_every_cloud(tmp_path: Path, velocity: bool) -> None:
    session = make_grasp(tmp_path, seconds=0.5, cloth__resolution=[8, 9], points__velocity=velocity)
    out = tmp_path / "out.rrd"
    assert main([str(session), "--save", str(out)]) == 0
    times, positions = rows(out, "/world/cloth", "Mesh3D:vertex_positions")
    _, normals = rows(out, "/world/cloth", "Mesh3D:vertex_normals")
    _, anchors = rows(out, "/world/anchors", "Points3D:positions")
    with SessionReader(session) as reader:
        clouds = list(reader.clouds())
        assert len(clouds) == len(positions) == 30
        for k, recorded in enumerate(clouds):
            assert recorded.frame is not None
            assert times[k] == pytest.approx(recorded.frame.time, abs=2e-9)
            np.testing.assert_array_equal(np.array(positions[k], np.float32), recorded.cloud.xyz)
            np.testing.assert_array_equal(np.array(anchors[k], np.float32), recorded.cloud.xyz[:9])
            np.testing.assert_allclose(np.linalg.norm(normals[k], axis=1), 1.0, atol=1e-5)


def test_events_are_shown(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL))
    corner = tuple(maker.simulation.positions[-1].tolist())
    maker.add([Target("gripper", corner, (0.0, 0.0, 0.0, 1.0)), Grasp("gripper", True)])
    maker.add([SetParameters({"material.density": 0.3})], diagnostics={"real_time_factor": "0.75", "late_frames": "3"})
    maker.add([Grasp("gripper", False)], extras={"energy": {"balance": 1e-5}})
    maker.add([Reset()])
    out = tmp_path / "out.rrd"
    assert main([str(maker.finish()), "--save", str(out)]) == 0
    _, said = rows(out, "/log", "TextLog:text")
    held = len(rows(out, "/world/held/gripper", "Points3D:positions")[1][0])
    assert held > 0
    assert [line for lines in said for line in lines] == [
        f"gripper closes, holds {held} particles", "material.density = 0.3", "gripper opens", "reset",
    ]  # fmt: skip
    assert rows(out, "/plots/pace/real_time_factor", "Scalars:scalars")[1] == [[0.75]]
    assert rows(out, "/plots/late/late_frames", "Scalars:scalars")[1] == [[3.0]]
    assert rows(out, "/plots/energy/energy_balance", "Scalars:scalars")[1] == [[1e-5]]
    assert len(rows(out, "/plots/force/gripper", "Scalars:scalars")[1]) == 4
    # After the reset the gripper has no pose and is drawn with size 0.
    _, spheres = rows(out, "/world/grippers/gripper/body", "Ellipsoids3D:half_sizes")
    assert spheres[-1] == [[0.0, 0.0, 0.0]]


def test_replay_reads_old_and_current_keys(tmp_path: Path) -> None:
    current = {"energy_friction_j": "0.25", "energy_work_j": "1.5", "stopped_bodies": "none"}
    both = old_keys.add_old_keys(current, old_keys.DIAGNOSTICS)
    old = {key: text for key, text in both.items() if key not in old_keys.DIAGNOSTICS.values()}
    assert old.keys() == {"energy_rubbed_j", "energy_work_j", "halted"}
    for name, entries in {"current": current, "both": both, "old": old}.items():
        (folder := tmp_path / name).mkdir()
        maker, out = SessionMaker(folder, Scene.from_parameters(SMALL)), folder / "out.rrd"
        maker.add(diagnostics=entries)
        assert main([str(maker.finish()), "--save", str(out)]) == 0
        assert rows(out, "/plots/energy/energy_friction_j", "Scalars:scalars")[1] == [[0.25]]
        assert rows(out, "/plots/energy/energy_work_j", "Scalars:scalars")[1] == [[1.5]]


def test_replay_counts_grasps_by_old_and_current_keys(tmp_path: Path) -> None:
    for name in ("grasped_count", "held"):
        (folder := tmp_path / name).mkdir()
        maker = SessionMaker(folder, Scene.from_parameters(SMALL))

        def alter(topic: str, data: bytes, name: str = name) -> bytes | None:
            if topic.endswith("/points"):
                return None  # Without a cloud only the state has the count.
            return status_bytes("gripper", {"closed": "true", name: "7"}) if topic.endswith("/state") else data

        corner = tuple(maker.simulation.positions[-1].tolist())
        maker.add()
        maker.add([Target("gripper", corner, (0.0, 0.0, 0.0, 1.0)), Grasp("gripper", True)], change=alter, states=True)
        assert messages(maker.finish(), folder / "out.rrd") == ["gripper closes, holds 7 particles"]


def messages(session: Path, out: Path) -> list[str]:
    """Return the events in a session's Rerun recording."""
    assert main([str(session), "--save", str(out)]) == 0
    return [line for lines in rows(out, "/log", "TextLog:text")[1] for line in lines]


def test_each_grasp_of_a_frame_has_its_count(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL | {"gripper.radius": 0.1}))
    corner = tuple(maker.simulation.positions[-1].tolist())
    close, let_go = Grasp("gripper", True), Grasp("gripper", False)
    held: list[int] = []
    maker.add([Target("gripper", corner)])
    for events in ([close, let_go], [close, Reset()], [Target("gripper", corner)], [close], [close, let_go, close]):
        maker.add(events)
        held.append(maker.simulation.grasped_count(0))
    count = held[-1]
    assert count > 0
    closes = f"gripper closes, holds {count} particles"
    assert messages(maker.finish(), tmp_path / "out.rrd") == [
        closes, "gripper opens", closes, "reset", closes, closes, "gripper opens", closes,
    ]  # fmt: skip


@pytest.mark.parametrize("drops", ["all clouds", "the last cloud"])
def test_held_count_is_unknown_without_a_cloud(tmp_path: Path, drops: str) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL))
    position = np.array([0.0, 0.0, 0.0])

    def without(topic: str, data: bytes) -> bytes | None:
        return None if topic.endswith("/points") else data

    for k in range(8):
        position = maker.simulation.positions[-1]
        leave_out = drops == "all clouds" or k == 7
        events = [Target("gripper", tuple(position.tolist()))]
        maker.add(events, change=without) if leave_out else maker.add(events)
    maker.add([Grasp("gripper", True)])
    assert messages(maker.finish(), tmp_path / "out.rrd") == ["gripper closes"]


def test_held_count_comes_from_gripper_state(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL))
    corner = tuple(maker.simulation.positions[-1].tolist())

    def without(topic: str, data: bytes) -> bytes | None:
        return None if topic.endswith("/points") else data

    maker.add([Target("gripper", corner)], change=without)
    maker.add([Grasp("gripper", True)], states=True)
    maker.add([Grasp("gripper", False)], states=True)
    maker.add([Grasp("gripper", True), Reset()], states=True)
    expected = ["gripper closes, holds 1 particles", "gripper opens"]
    assert messages(maker.finish(), tmp_path / "out.rrd")[:2] == expected


def test_gripper_at_sleeping_cloth_shows_held_particles(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL | {"gravity": [0.0, 0.0, 0.0]}))
    corner = maker.simulation.positions[-1]
    maker.add([Target("gripper", tuple((corner + 0.5).tolist()))])
    for _ in range(90):
        maker.add()
    assert maker.simulation.asleep
    maker.add([Target("gripper", tuple(corner.tolist()))])
    assert maker.simulation.asleep
    maker.add([Grasp("gripper", True)])
    held = len(maker.simulation.grippers.grasped_particles(0))
    assert held > 0
    out = tmp_path / "out.rrd"
    assert main([str(maker.finish()), "--save", str(out)]) == 0
    assert [line for lines in rows(out, "/log", "TextLog:text")[1] for line in lines] == [
        f"gripper closes, holds {held} particles"
    ]


def test_anchors_that_change_are_shown_and_not_grabbed(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL | {"cloth.anchors": [""], "gripper.radius": 0.08}))
    last = maker.simulation.state.particle_count - 1
    corner = tuple(maker.simulation.positions[last].tolist())
    maker.add()
    maker.add([SetParameters({"cloth.anchors": ["top", str(last)]})])
    maker.add([Target("gripper", corner), Grasp("gripper", True)])
    maker.add([SetParameters({"cloth.anchors": [""]})])
    held = maker.simulation.grippers.grasped_particles(0).tolist()
    assert last not in held
    out = tmp_path / "out.rrd"
    assert main([str(maker.finish()), "--save", str(out)]) == 0
    assert [len(points or []) for points in rows(out, "/world/anchors", "Points3D:positions")[1]] == [10, 10, 0]
    assert {len(points) for points in rows(out, "/world/held/gripper", "Points3D:positions")[1] if points} == {
        len(held)
    }


def test_every_nth_cloud_and_all_of_the_plots(tmp_path: Path) -> None:
    session = make_grasp(tmp_path, seconds=0.5, cloth__resolution=[8, 9])
    out = tmp_path / "out.rrd"
    assert main([str(session), "--save", str(out), "--every", "7"]) == 0
    times, positions = rows(out, "/world/cloth", "Mesh3D:vertex_positions")
    np.testing.assert_allclose(times * 60.0, [1, 8, 15, 22, 29], atol=1e-6)
    assert len(positions) == 5
    assert len(rows(out, "/plots/steps/steps", "Scalars:scalars")[1]) == 30


def test_split_and_killed_sessions_are_shown_to_their_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maker = SessionMaker(
        tmp_path, Scene.from_parameters(SMALL), options=WriterOptions(chunk_bytes=8192, sync_seconds=0.0)
    )
    for k in range(30):
        maker.add()
        if k == 10:
            maker.split()
    maker.cut()
    out = tmp_path / "out.rrd"
    assert main([*(str(path) for path in maker.paths), "--save", str(out)]) == 0
    assert "cut off" in capsys.readouterr().err
    times, _ = rows(out, "/world/cloth", "Mesh3D:vertex_positions")
    assert 20 < len(times) < 30


def test_follow_shows_session_during_recording(tmp_path: Path, wait_until: Any) -> None:
    scene = Scene.from_parameters(SMALL)
    maker = SessionMaker(tmp_path, scene, options=WriterOptions(chunk_bytes=4096, sync_seconds=0.0))
    out = tmp_path / "out.rrd"
    status: list[int] = []
    follower = threading.Thread(
        target=lambda: status.append(main([str(maker.paths[0]), "--save", str(out), "--follow"]))
    )
    events = list(carried_corner(scene, 1.0))
    for frame in events[:20]:
        maker.add(frame)
    follower.start()
    wait_until(lambda: out.exists() and out.stat().st_size > 20_000, description="the followed frames in the recording")
    assert follower.is_alive()
    before = out.stat().st_size
    for frame in events[20:]:
        maker.add(frame)
    wait_until(lambda: out.stat().st_size > before, description="the newer frames in the recording")
    maker.finish()
    follower.join(30.0)
    assert status == [0]
    assert len(rows(out, "/world/cloth", "Mesh3D:vertex_positions")[0]) == 60


def test_picture_shows_lit_cloth_at_gripper(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = pytest.importorskip("PIL.Image", reason="pictures are looked at with pillow")
    session = make_grasp(tmp_path, seconds=1.0, cloth__resolution=[20, 20], material__stretch_modulus=300.0)
    out = tmp_path / "out.png"
    status = main([str(session), "--screenshot", str(out), "--at", "0.6", "--size", "900x600"])
    said = capsys.readouterr().err
    if "mesa-vulkan-drivers" in said:
        pytest.skip(f"a picture needs a Vulkan driver, apt-get install mesa-vulkan-drivers: {said.strip()}")
    assert status == 0, said
    picture = np.asarray(image.open(out).convert("RGB"), dtype=int)
    assert picture.shape == (600, 900, 3)
    view = picture[60:560, 5:600]
    red, green, blue = view[..., 0], view[..., 1], view[..., 2]
    # Cloth: bright, with varying brightness from the lighting.
    cloth = (view.min(axis=2) > 70) & (abs(red - green) < 80)
    assert cloth.mean() > 0.1
    assert view[cloth].sum(axis=1).std() > 15.0
    # One connected piece that fills most of each row.
    rows = [np.flatnonzero(line) for line in cloth if line.sum() > 20]
    assert np.median([len(row) / (row[-1] - row[0] + 1) for row in rows]) > 0.8
    # The closed gripper is green, beside the cloth.
    gripper = np.argwhere((green > 1.5 * red) & (green > 1.3 * blue) & (green > 120))
    assert len(gripper) > 30
    middle = np.median(gripper, axis=0)
    assert np.linalg.norm(np.argwhere(cloth) - middle, axis=1).min() < 40.0


def test_viewer_needs_a_screen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    session = make_grasp(tmp_path, seconds=0.1, cloth__resolution=[5, 5])
    assert main([str(session)]) == 1
    said = capsys.readouterr().err
    assert "--screenshot" in said
    assert "apt-get install xvfb xauth" in said
    # A missing file comes first.
    assert main([str(tmp_path / "nothing.mcap")]) == 2
    assert "nothing.mcap" in capsys.readouterr().err


def test_missing_driver_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # An empty list of drivers, as on a machine without any.
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none.json"))
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    session = make_grasp(tmp_path, seconds=0.1, cloth__resolution=[5, 5])
    assert main([str(session), "--screenshot", str(tmp_path / "out.png")]) == 1
    assert "apt-get install mesa-vulkan-drivers" in capsys.readouterr().err


@pytest.mark.parametrize("listed", [True, False], ids=["one that does not serve", "none"])
def test_unusable_driver_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listed: bool) -> None:
    # Message of the viewer with OpenGL but without Vulkan: it does not mention drivers.
    log = tmp_path / "viewer.log"
    log.write_text(
        "\x1b[33m WARN\x1b[0m egui_wgpu: Software rasterizer detected - loss of performance expected. backend: Gl\n\n"
        "thread 'main' panicked at 'Failed to get render context'\nre_viewer/src/app/mod.rs:1425\nstack backtrace:\n"
        "   6: core::panicking::panic_fmt\n             at libc-start.c:360:3\n\nTroubleshooting Rerun: https://...\n"
        "Report bugs: https://...\n"
    )
    driver = tmp_path / "driver.json"
    if listed:
        driver.write_text("{}")
    monkeypatch.setenv("VK_DRIVER_FILES", str(driver))
    message = str(viewer.viewer_error(log, "does not answer (transport error)"))
    assert "apt-get install mesa-vulkan-drivers" in message
    assert ("none is installed here" in message) is not listed
    assert message.endswith("it said: thread 'main' panicked at 'Failed to get render context')")


def test_viewer_end_during_rendering_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, log = tmp_path / "driver.json", tmp_path / "viewer.log"
    driver.write_text("{}")
    log.write_text("Error: out of memory\n")
    monkeypatch.setenv("VK_DRIVER_FILES", str(driver))

    def end() -> None:
        raise RuntimeError("transport error")

    client = SimpleNamespace(take_screenshot=end)
    monkeypatch.setattr(viewer, "_headless", lambda *_: contextlib.nullcontext((client, log)))
    monkeypatch.setattr(viewer, "_wait_until_loaded", lambda *_: None)
    with pytest.raises(
        viewer.ViewerError, match=r"gave up painting \(transport error\); it said: Error: out of memory"
    ):
        viewer.save_screenshot(tmp_path / "in.rrd", tmp_path / "out.png", at=None, size=(300, 300))


def test_other_viewer_failure_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, log = tmp_path / "driver.json", tmp_path / "viewer.log"
    driver.write_text("{}")
    monkeypatch.setenv("VK_DRIVER_FILES", str(driver))
    log.write_text("Error: the port is taken\n\nReport bugs: https://...\n")
    message = str(viewer.viewer_error(log, "ended with status 1"))
    assert message == "the viewer ended with status 1; it said: Error: the port is taken"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--every", "0"], "at least 1"),
        (["--size", "big", "--screenshot", "a.png"], "1600x900"),
        (["--size", "10x10", "--screenshot", "a.png"], "200"),
        (["--at", "1.0"], "--screenshot"),
        (["--at", "nan", "--screenshot", "a.png"], "number of seconds"),
        (["--at=-inf", "--screenshot", "a.png"], "number of seconds"),
        (["--at", "1e300", "--screenshot", "a.png"], "at most 9e+09"),
        (["--screenshot", "a.png", "--follow"], "one moment"),
        (["--save", "a.rrd", "--screenshot", "a.png"], "not allowed"),
        (["--strain-limit", "-1"], "strain-limit"),
    ],
)
def test_a_wrong_command_line_is_refused(arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["session.mcap", *arguments])
    assert end.value.code == 2
    assert reason in capsys.readouterr().err


def test_foreign_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "out.rrd")
    foreign_file = tmp_path / "other.mcap"
    foreign_file.write_bytes(b"no session")
    assert main([str(foreign_file), "--save", out]) == 2
    assert main([str(tmp_path / "absent.mcap"), "--save", out]) == 2
    errors = capsys.readouterr().err
    assert "is not an MCAP file" in errors
    assert "does not exist" in errors
    session = make_grasp(tmp_path, seconds=0.1, cloth__resolution=[5, 5])
    assert main([str(session), "--save", str(tmp_path / "nowhere" / "out.rrd")]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_a_session_without_topology_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL), topology=False)
    maker.add()
    assert main([str(maker.finish()), "--save", str(tmp_path / "out.rrd")]) == 2
    assert f"{NODE}/topology" in capsys.readouterr().err


def test_replay_imports_neither_ros_nor_physics(tmp_path: Path) -> None:
    session = make_grasp(tmp_path, seconds=0.1, cloth__resolution=[5, 5])
    code = f"""
import sys
from cloth_sim_ros.replay.main import main
assert 'rerun' not in sys.modules
assert main([{str(session)!r}, '--save', {str(tmp_path / "out.rrd")!r}]) == 0
rooms = ('engine', 'physics', 'scene', 'simulation', 'ros')
foreign = ('rclpy', 'scipy', *('cloth_sim_ros.' + room for room in rooms))
print([name for name in sys.modules if any(name == other or name.startswith(other + '.') for other in foreign)])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100, check=False)
    assert done.stdout.strip() == "[]", done.stderr
