# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Creates the project's environment, or completes it. Run by the Makefile, with any supported Python.

It uses the standard library only. A stamp is written last, and an environment whose creation was interrupted is created
again. Two runs at a time wait for each other.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import compiler

ROOT = Path(__file__).resolve().parent.parent
INPUTS = ("setup.py", "setup.cfg", "constraints.txt")
PURPOSES = {"demo": "`make run` needs", "dev": "the tests and tools need"}


def fingerprint() -> str:
    """Return the content of a stamp: the folder, and a digest of the files that determine what is installed."""
    digest = hashlib.sha256(f"{ROOT}\n".encode())
    for name in INPUTS:
        digest.update((ROOT / name).read_bytes())
    return digest.hexdigest()


def is_sound(folder: Path) -> bool:
    """Return True if the environment can be completed: it is whole, in its original folder, and its Python works."""
    if (folder / "unfinished").exists():
        return False
    origin = folder / "made_in"
    if origin.exists() and origin.read_text().strip() != str(ROOT):
        return False  # the project was moved: scripts of the environment name the old folder
    probe = "import sys, pip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))"
    try:
        return subprocess.run([folder / "bin" / "python", "-c", probe], check=False).returncode == 0
    except OSError:
        return False


def install(folder: Path, extras: str) -> None:
    """Create or complete the environment; raise CalledProcessError if a step fails."""
    purpose = PURPOSES[extras]
    unfinished = folder / "unfinished"
    if is_sound(folder):
        unfinished.touch()
        report(f"adding to {folder.name} what {purpose} from PyPI; a minute or two, once ...")
    else:
        version = ".".join(map(str, sys.version_info[:3]))
        report(f"making {folder.name} with Python {version} and what {purpose}, real ROS 2 included, from PyPI:")
        report("some 400 MB, half a minute with a fast connection, minutes with a slow one, once ...")
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir()
        unfinished.touch()
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    (folder / "made_in").write_text(f"{ROOT}\n")
    command = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    command += ["--no-input", "--constraint", str(ROOT / "constraints.txt"), "--editable", f"{ROOT}[{extras}]"]
    before = packages(folder)
    try:
        # setuptools warns of every editable install.
        subprocess.run(command, check=True, cwd=ROOT, env={**os.environ, "PYTHONWARNINGS": "ignore"})
    finally:
        # A failed step that installed nothing (no network, say) leaves a working environment, which must be kept.
        if before == packages(folder):
            unfinished.unlink()
    unfinished.unlink(missing_ok=True)


def build_engine(every: bool) -> None:
    """Build the engine while pip fetches packages. pip's own build then finds it done, or reports the fault.

    Args:
        every: after the library that this machine loads build the others that it can run, which the tests compare.
    """
    build = compiler.load_build()
    with contextlib.suppress(build.BuildError, OSError):
        for name in build.names_here()[: None if every else 1]:
            build.build(names=[name])


def packages(folder: Path) -> set[tuple[str, int]]:
    """Return name and date of everything at the top level of the environment."""
    return {(path.name, path.stat().st_mtime_ns) for path in folder.glob("lib/python*/site-packages/*")}


def report(text: str) -> None:
    """Print a line at once, also through a pipe."""
    print(f"cloth_sim_ros: {text}", flush=True)


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="the environment")
    parser.add_argument("--extras", choices=PURPOSES, required=True, help="which extra of setup.py it shall have")
    parser.add_argument("--stamp", type=Path, action="append", required=True, help="written last, when all is there")
    arguments = parser.parse_args()
    folder: Path = arguments.folder.absolute()

    # The lock is on the project's folder itself, so that no file is left behind.
    lock = os.open(ROOT, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        report("another `make` is at work on the environment; waiting for it ...")
        fcntl.flock(lock, fcntl.LOCK_EX)

    stamps: list[Path] = arguments.stamp
    if is_sound(folder) and all(stamp.exists() and stamp.read_text() == fingerprint() for stamp in stamps):
        # Files with a newer date and the old content (another branch and back), or another `make` has just done it.
        for stamp in stamps:
            stamp.touch()
        return 0

    if not compiler.ensure():  # pip builds the engine
        return 1
    start = time.monotonic()
    builder = threading.Thread(target=build_engine, args=[arguments.extras == "dev"], daemon=True)
    builder.start()
    try:
        install(folder, arguments.extras)
        builder.join()
    except subprocess.CalledProcessError as error:
        step = "pip" if "pip" in error.cmd else "venv"
        report(
            f"{step} could not make {folder.name}, status {error.returncode}; see above (PyPI out of reach? disk full?)"
        )
        report("the next `make` tries again.")
        return 1
    except KeyboardInterrupt:
        report("interrupted; the next `make` continues, or starts again if it must.")
        return 130
    for stamp in stamps:
        stamp.write_text(fingerprint())
    report(f"{folder.name} is ready, after {time.monotonic() - start:.0f} s.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
