# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Makes the pictures of README and docs from real sessions: `make screenshots`.

A session is played as by `make run`, recorded, and shown by cloth_replay at a given time. It needs the requirements of
`cloth_replay --screenshot`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from cloth_sim_ros.session.reader import SessionReader

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One picture: the played scene, and its time."""

    parameters: str
    """Parameter file of the cloth, in config/."""
    scripts: tuple[str, ...]
    """A script for each gripper, in config/."""
    after_closing: float
    """Simulated time of the picture since the frame in which a gripper first closed [s]."""


#: Name of the file in docs/images, without its suffix, and its picture.
PICTURES = {
    "towel": Picture(parameters="fold.yaml", scripts=("fold_left.yaml", "fold_right.yaml"), after_closing=1.8),
}


def closing_time(session: list[Path]) -> float:
    """Return the simulated time at which a gripper first closed [s]; raise ValueError without a grasp."""
    with SessionReader(session) as reader:
        for frame in reader.frames():
            if any(event["kind"] == "grasp" and event["closed"] for event in frame.events):
                return frame.time
    raise ValueError(f"in {session[0]} no gripper closed, so there is no grasp to show")


def make(name: str, picture: Picture, folder: Path) -> None:
    """Play, record, and write the picture into `folder`; raise CalledProcessError if a command fails."""
    config = ROOT / "config"
    with tempfile.TemporaryDirectory() as sessions:
        demo = [sys.executable, "-m", "cloth_sim_ros.ros.demo", "--folder", sessions]
        scripts = [config / script for script in picture.scripts]
        subprocess.run([*demo, "--params", config / picture.parameters, "--script", *scripts], check=True, cwd=ROOT)
        session = sorted(Path(sessions).glob("*.mcap"))
        at = closing_time(session) + picture.after_closing
        replay = [sys.executable, "-m", "cloth_sim_ros.replay.main", *map(str, session)]
        subprocess.run([*replay, "--at", f"{at:.3f}", "--screenshot", folder / f"{name}.png"], check=True, cwd=ROOT)


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="make screenshots", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which; default: all of {', '.join(PICTURES)}")
    parser.add_argument("--folder", type=Path, default=ROOT / "docs" / "images", help="default: %(default)s")
    options = parser.parse_args()
    unknown = set(options.names) - PICTURES.keys()
    if unknown:
        parser.error(f"no picture named {', '.join(sorted(unknown))}; there are {', '.join(PICTURES)}")
    options.folder.mkdir(parents=True, exist_ok=True)
    for name in options.names or PICTURES:
        try:
            make(name, PICTURES[name], options.folder)
        except (subprocess.CalledProcessError, ValueError) as error:
            print(f"screenshots: {name}: {error}", file=sys.stderr)
            return 1
        print(f"screenshots: {options.folder / name}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
