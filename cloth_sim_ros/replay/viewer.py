# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Viewer process: a window on the screen, or headless for pictures."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cloth_sim_ros.replay.rows import SIM_TIME

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

#: Timeout for the start of the viewer and for loading a recording [s]: a busy machine without a GPU is slow.
_VIEWER_TIMEOUT = 60.0
#: Interval between screenshots [s]; two equal ones in a row mean that the picture is complete.
_SCREENSHOT_INTERVAL = 0.25

#: Messages of the viewer without a usable driver; the last one if only an OpenGL driver exists.
_NO_ADAPTER = (
    "no graphics adapter",
    "failed to find adapter",
    "no suitable adapter",
    "adapter was found",
    "failed to get render context",
)
#: Folders that list Vulkan drivers, one file each, in addition to the environment's list.
_DRIVER_FOLDERS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
#: Irrelevant lines after the viewer's reason, and colour codes.
_NOISE_PATTERN = re.compile(r"troubleshooting rerun|report bugs|stack backtrace|^\d+:|^at |^$", re.IGNORECASE)
_COLOUR_CODES = re.compile(r"\x1b\[[0-9;]*m")


class ViewerError(Exception):
    """Error: the viewer cannot be used on this machine; the message names the requirement."""


class Viewer(NamedTuple):
    """Process of a running Rerun viewer, and its address for recordings."""

    process: subprocess.Popen[bytes]
    address: str
    """Address for recordings."""


def check_screen(remedy: str) -> None:
    """Raise ViewerError with a remedy if there is no screen for a window."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(f"there is no screen (neither DISPLAY nor WAYLAND_DISPLAY is set); {remedy}")


def executable() -> Path:
    """Return the path of the Rerun viewer's executable, beside its package. Raises ViewerError if it is absent."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise ViewerError("the Rerun viewer is not installed: pip install 'cloth_sim_ros[replay]'")
    return Path(spec.origin).parent / ("rerun.exe" if sys.platform == "win32" else "rerun")


def open_window(*options: str) -> Viewer:
    """Start a Rerun viewer with a window, which outlives this process; wait until it listens. Raises ViewerError.

    The viewer listens on the local interface only; the SDK's `spawn` would listen on all interfaces.

    Raises:
        ViewerError: if it ends at once, or does not listen in time.
    """
    return _start("--hide-welcome-screen", "--expect-data-soon", *options)


def serve_page(port: int, *, memory: str) -> tuple[Viewer, str]:
    """Start a Rerun viewer as a web page on this machine; return it and the page's address. Raises ViewerError.

    Args:
        port: port of the page.
        memory: frames that are kept for a page that is opened later, e.g. "2GB".

    Raises:
        ViewerError: if it ends at once, or does not listen in time.
    """
    viewer = _start("--serve-web", "--web-viewer-port", str(port), "--server-memory-limit", memory)
    return viewer, f"http://127.0.0.1:{port}/?url={urllib.parse.quote(viewer.address, safe='')}"


def _start(*options: str) -> Viewer:
    port = _free_port()
    viewer = subprocess.Popen(
        [str(executable()), *options, "--bind", "127.0.0.1", "--port", str(port)],
        stdin=subprocess.DEVNULL,
        # As part of another program, it does not ask about analytics.
        env={**os.environ, "RERUN_APP_ONLY": "true", "RUST_LOG": "error"},
        start_new_session=True,
    )
    end = time.monotonic() + _VIEWER_TIMEOUT
    while time.monotonic() < end:
        if viewer.poll() is not None:
            raise ViewerError(f"the viewer ended with status {viewer.returncode}; its messages are above")
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
            return Viewer(viewer, f"rerun+http://127.0.0.1:{port}/proxy")
        time.sleep(0.05)
    viewer.kill()
    raise ViewerError(f"the viewer did not start within {_VIEWER_TIMEOUT:g} s; use --save out.rrd")


def save_screenshot(rrd: Path, picture: Path, *, at: float | None, size: tuple[int, int]) -> None:
    """Render a recording without a screen or a GPU; write a PNG of `size` (width, height) [pixels]. Raises ViewerError.

    `at`: simulated time [s]; by default the end. The viewer reads the recording from the disk.

    Raises:
        ViewerError: if the viewer cannot render on this machine.
    """
    with _headless(rrd, size) as (client, log):
        _wait_until_loaded(client, log)
        try:
            if at is not None:
                client.set_time(SIM_TIME, duration=at, play_state="paused")
            painted = _settled_picture(client)
        except (ConnectionError, RuntimeError) as error:
            raise viewer_error(log, f"gave up painting ({error})") from error
        picture.write_bytes(painted)


@contextlib.contextmanager
def _headless(rrd: Path, size: tuple[int, int]) -> Iterator[tuple[ViewerClient, Path]]:
    port = _free_port()
    with tempfile.TemporaryDirectory(prefix="cloth_replay_") as folder:
        log = Path(folder) / "viewer.log"
        with log.open("wb") as output:
            viewer = subprocess.Popen(
                [
                    *(str(executable()), str(rrd), "--headless", "--hide-welcome-screen"),
                    *("--bind", "127.0.0.1", "--port", str(port), "--window-size", f"{size[0]}x{size[1]}"),
                ],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                # As part of another program, it does not ask about analytics. Its settings are temporary.
                env={**os.environ, "RERUN_APP_ONLY": "true", "XDG_DATA_HOME": folder, "RUST_LOG": "warn"},
                start_new_session=True,
            )
        try:
            yield _connect(viewer, port, log), log
        finally:
            viewer.kill()
            viewer.wait()


def _connect(viewer: subprocess.Popen[bytes], port: int, log: Path) -> ViewerClient:
    from rerun.experimental import ViewerClient

    end = time.monotonic() + _VIEWER_TIMEOUT
    while time.monotonic() < end:
        if viewer.poll() is not None:
            raise viewer_error(log, f"ended with status {viewer.returncode}")
        try:
            return ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        except ConnectionError:
            time.sleep(0.05)
    raise viewer_error(log, f"did not start within {_VIEWER_TIMEOUT:g} s")


def _wait_until_loaded(client: ViewerClient, log: Path) -> None:
    end = time.monotonic() + _VIEWER_TIMEOUT
    while time.monotonic() < end:
        try:
            state = client.get_state()
        except (ConnectionError, RuntimeError) as error:
            raise viewer_error(log, f"does not answer ({error})") from error
        timelines = {str(getattr(line, "name", line)) for recording in state.recordings for line in recording.timelines}
        if state.active_recording and not state.loading and SIM_TIME in timelines:
            return
        time.sleep(0.1)
    raise viewer_error(log, f"did not load the recording within {_VIEWER_TIMEOUT:g} s")


def _settled_picture(client: ViewerClient) -> bytes:
    """Return a screenshot (PNG) after it stopped changing, because loading has ended and notices have faded."""
    end = time.monotonic() + _VIEWER_TIMEOUT
    before = b""
    while time.monotonic() < end:
        picture = client.take_screenshot()
        if picture == before:
            break
        before = picture
        time.sleep(_SCREENSHOT_INTERVAL)
    return picture


def viewer_error(log: Path, problem: str) -> ViewerError:
    """Return, to be raised, the error of a viewer that failed, with the cause from its log file."""
    output = _COLOUR_CODES.sub("", log.read_text(errors="replace"))
    lines = [line.strip() for line in output.splitlines() if not _NOISE_PATTERN.search(line.strip())]
    # A panic has its reason in one line; otherwise the last lines count.
    reason = next((line for line in lines if "panicked at" in line), " / ".join(lines[-3:])) or "nothing"
    driver = "" if _lists_a_driver() else ": none is installed here"
    if driver or any(phrase in output.lower() for phrase in _NO_ADAPTER):
        return ViewerError(
            f"painting needs a Vulkan driver, and the viewer found none that serves{driver}; install one that needs no "
            f"graphics card: apt-get install mesa-vulkan-drivers (the viewer {problem}; it said: {reason})"
        )
    return ViewerError(f"the viewer {problem}; it said: {reason}")


def _lists_a_driver() -> bool:
    """Return True if the Vulkan loader's folders list a driver; always True on other systems than Linux."""
    if not sys.platform.startswith("linux"):
        return True
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    if named:
        return any(Path(name).exists() for name in named.split(os.pathsep))
    user_folder = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "vulkan" / "icd.d"
    return any(next(Path(folder).glob("*.json"), None) for folder in (*_DRIVER_FOLDERS, user_folder))


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
