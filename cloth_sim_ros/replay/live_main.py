# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Process of `cloth_viewer` that draws: messages on the standard input, Rerun as the output.

It imports no ROS, so that it may run in an environment of its own.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from cloth_sim_ros.replay.viewer import Viewer, ViewerError, check_screen, open_window, serve_page
from cloth_sim_ros.session.console import escape_unencodable
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.message_pipe import unpack

if TYPE_CHECKING:
    import rerun as rr

    from cloth_sim_ros.replay.pre_scan import PreScan

DONE, UNAVAILABLE = 0, 1
#: Memory of the viewer; it then drops the oldest frames.
_MEMORY = "2GB"


def main(arguments: Sequence[str] | None = None) -> int:
    """Show the messages on standard input in Rerun until the input ends; return 0, or 1 if that is impossible."""
    escape_unencodable()
    options = _parser().parse_args(arguments)
    if any(importlib.util.find_spec(library) is None for library in ("rerun", "mcap", "rosbags")):
        _print(
            "the Rerun viewer is not installed: pip install 'cloth_sim_ros[replay]', here or in an environment of its "
            "own that --python names"
        )
        return UNAVAILABLE
    from cloth_sim_ros.session.output_files import check_outputs

    viewer = None
    try:
        check_outputs({"--save": options.save}, [], endings={"--save": ".rrd"})
        # The libraries load while the window opens.
        with ThreadPoolExecutor(1) as starter:
            starting = starter.submit(_start_viewer, options)
            _load_libraries()
            viewer = starting.result()
        return _draw(options, viewer)
    except RuntimeError as error:
        # Rerun's, from the connection.
        if viewer is not None and viewer.process.poll() is not None:
            _print("the viewer was closed")
            return DONE
        _print(f"the viewer does not answer: {error}")
        return UNAVAILABLE
    except (ViewerError, SessionError, OSError) as error:
        _print(str(error))
        return UNAVAILABLE
    finally:
        if viewer is not None:
            viewer.process.terminate()


def _start_viewer(options: argparse.Namespace) -> Viewer | None:
    if options.save or options.connect:
        return None
    if options.serve:
        viewer, page = serve_page(options.serve, memory=_MEMORY)
        _print(f"open {page}")
        return viewer
    check_screen("use --save out.rrd for a file, or --serve for a page that a browser shows")
    return open_window("--memory-limit", _MEMORY)


def _load_libraries() -> None:
    """Import the libraries that the first message needs, while the viewer starts."""
    # Rerun's errors are reported here, in one sentence.
    os.environ.setdefault("RUST_LOG", "off")
    import rerun.blueprint  # noqa: F401

    import cloth_sim_ros.replay.live  # noqa: F401
    from cloth_sim_ros.session.channel_description import standard_types

    standard_types()


def _draw(options: argparse.Namespace, viewer: Viewer | None) -> int:
    import rerun as rr

    from cloth_sim_ros.replay.blueprint import make_blueprint
    from cloth_sim_ros.replay.live import LiveView

    # Without strict mode, rerun only warns about an error, and the recording lacks the rows.
    rr.set_strict_mode(True)
    n_recordings = 0

    def start_recording(scan: PreScan) -> rr.RecordingStream:
        nonlocal n_recordings
        n_recordings += 1
        recording = rr.RecordingStream("cloth_sim")
        recording.send_recording_name(options.node.strip("/") + (f" {n_recordings}" if n_recordings > 1 else ""))
        blueprint = make_blueprint(scan, following=True)
        if options.save:
            path = numbered_path(options.save, n_recordings)
            recording.save(path, default_blueprint=blueprint)
            _print(f"writing {path}")
        else:
            address = options.connect if viewer is None else viewer.address
            recording.connect_grpc(address, default_blueprint=blueprint)
        return recording

    view = LiveView(
        options.node, start_recording, on_message=_print, every=options.every, strain_limit=options.strain_limit
    )
    for topic, data in unpack(sys.stdin.buffer):
        if viewer is not None and viewer.process.poll() is not None:
            _print("the viewer was closed")
            return DONE
        view.add(topic, data)
    view.finish()
    return DONE


def numbered_path(path: Path, index: int) -> Path:
    """Return the file of the recording `index`, from 1: the second one of `out.rrd` is `out_2.rrd`."""
    return path if index == 1 else path.with_name(f"{path.stem}_{index}{path.suffix}")


def _print(text: str) -> None:
    # In one write: two processes share the stream.
    os.write(2, f"cloth_viewer: {text}\n".encode(errors="backslashreplace"))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cloth_viewer")
    parser.add_argument("--node", required=True)
    parser.add_argument("--save", type=Path)
    parser.add_argument("--connect")
    parser.add_argument("--serve", type=int)
    parser.add_argument("--every", type=int, required=True)
    parser.add_argument("--strain-limit", type=float, required=True)
    return parser


if __name__ == "__main__":
    sys.exit(main())
