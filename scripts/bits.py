# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of bits across processors, C libraries, numpy versions and compilers. Run by `make bits`.

Small scenes (bits_scenes.py) use every force, contact, both precisions, several orders and all integrators. They run in
processes that differ only in things that must not change bits. State and wrenches of each frame are compared.

For 64-bit ARM a cross compiler builds the engine. An emulator then repeats the engine's calls of a few frames
(bits_trace.py, bits_replay.cpp). Exit status 1 means a difference, with its scene and its first frame or call.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import runpy
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bits_scenes import SCENES, frames_of

ROOT = Path(__file__).resolve().parent.parent
ENGINE = ROOT / "cloth_sim_ros" / "engine"

#: The prefix of the cross compiler, and of its libraries' folder.
_ARM = "aarch64-linux-gnu"
#: Settings that disable processor features in the C library.
_HWCAPS = "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX,-AVX512F,-AVX2_Usable,-FMA_Usable"
#: Fills fresh memory with a pattern, so that reads of unwritten memory change bits.
_PERTURB = "glibc.malloc.perturb=165"


class Way(NamedTuple):
    """One configuration in which all scenes run."""

    name: str
    environment: dict[str, str]
    #: Reason if this machine can't run it; else empty.
    why_not: str = ""
    #: True if the process may use one processor only.
    alone: bool = False


class Difference(NamedTuple):
    """A scene whose bits differ between two configurations."""

    scene: str
    way: str
    frame: int

    def __str__(self) -> str:
        return f"{self.scene}: {self.way} differs from frame {self.frame} on"


def run_here(scenes: Sequence[str], frames: int) -> None:
    """Run scenes in this process; print the engine's name and the digests as JSON."""
    from cloth_sim_ros.engine.binding import engine_name

    told = {"engine": engine_name(), "digests": {scene: list(frames_of(scene, frames)) for scene in scenes}}
    print(json.dumps(told))


def run_apart(way: Way, frames: int, *, scenes: Sequence[str] = tuple(SCENES), python: str = sys.executable) -> Any:
    """Run scenes in a new process and return the output of `run_in_process`.

    Raises:
        RuntimeError: if the process fails.
    """
    command = [python, str(Path(__file__).resolve()), "--frames", str(frames), "--here", *scenes]
    if way.alone:
        command = ["taskset", "-c", str(min(os.sched_getaffinity(0))), *command]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path, **way.environment}
    done = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{way.name}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def compare(first: dict[str, list[str]], other: dict[str, list[str]], way: str) -> list[Difference]:
    """Return the scenes with differing digests, each with its first differing frame."""
    differences = []
    for scene, digests in first.items():
        unlike = [k for k, (a, b) in enumerate(zip(digests, other[scene], strict=True), start=1) if a != b]
        if unlike:
            differences.append(Difference(scene, way, unlike[0]))
    return differences


def ways() -> list[Way]:
    """Return the configurations that need nothing but installed software; the first is this machine's own."""
    known = runpy.run_path(str(ENGINE / "instruction_set.py"))["libraries"]()
    found = [Way(known[0], {"CLOTH_SIM_ROS_ENGINE": known[0]})]
    for name in {"x86_64": ("baseline", "avx2", "avx512"), "aarch64": ("neon",)}[platform.machine()]:
        if name == known[0]:
            continue
        why_not = "" if name in known else "this processor has no such vectors"
        found.append(Way(name, {"CLOTH_SIM_ROS_ENGINE": name}, why_not))
    features = numpy_features()
    plain = {
        "GLIBC_TUNABLES": f"{_HWCAPS}:{_PERTURB}",
        "NPY_DISABLE_CPU_FEATURES": " ".join(features),
        "OPENBLAS_CORETYPE": "PRESCOTT",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONHASHSEED": "1",
    }
    found.append(Way("plain C library and numpy", plain))
    alone = "" if shutil.which("taskset") else "there is no taskset"
    found.append(Way("one processor", {"PYTHONHASHSEED": "2"}, alone, alone=True))
    return found


def numpy_features() -> list[str]:
    """Return the processor features that numpy detects and can do without."""
    major = int(np.__version__.split(".")[0])
    inside = importlib.import_module(f"numpy.{'core' if major < 2 else '_core'}._multiarray_umath")
    return [name for name in inside.__cpu_dispatch__ if inside.__cpu_features__.get(name)]


def built_by_other_compilers(folder: Path) -> list[Way]:
    """Build the engine with each installed compiler, for the widest vectors here; return the configurations."""
    name = runpy.run_path(str(ENGINE / "instruction_set.py"))["libraries"]()[0]
    found = []
    for compiler in ("g++", "clang++"):
        label = f"{name} by {compiler}"
        if shutil.which(compiler) is None:
            found.append(Way(label, {}, f"there is no {compiler}"))
            continue
        place = folder / compiler
        command = [sys.executable, str(ENGINE / "build.py"), "--only", name, "--folder", str(place)]
        done = subprocess.run(command, env={**os.environ, "CXX": compiler}, check=False, capture_output=True, text=True)
        why_not = done.stderr.strip()[-300:] if done.returncode else ""
        found.append(Way(label, {"CLOTH_SIM_ROS_ENGINE": str(place / f"_{name}.so")}, why_not))
    return found


def traced(scene: str) -> str:
    """Return the number of frames to repeat in the emulator; with contact there are more, until all bodies touch."""
    return "24" if "contact.thickness" in SCENES[scene] else "4"


def replayed_on_arm(folder: Path, scenes: Sequence[str] = tuple(SCENES)) -> Iterator[tuple[str, bool]]:
    """Repeat the engine's calls on an emulated 64-bit ARM processor.

    Yields:
        A line of output for each scene, and True if its bits are the same.
    """
    compiler = next(filter(shutil.which, (f"{_ARM}-g++", f"{_ARM}-g++-12")), None)
    emulator = next(filter(shutil.which, ("qemu-aarch64-static", "qemu-aarch64")), None)
    if platform.machine() != "x86_64" or compiler is None or emulator is None:
        missing = " and ".join(
            name for name, found in (("g++-aarch64-linux-gnu", compiler), ("qemu-user-static", emulator)) if not found
        )
        yield f"neon, emulated: left out, there is no {missing or 'x86-64 to record on'}", True
        return
    build = [sys.executable, str(ENGINE / "build.py"), "--only", "neon", "--folder", str(folder)]
    driver = [compiler, "-std=c++20", "-O1", str(ROOT / "scripts" / "bits_replay.cpp"), "-o", str(folder / "replay")]
    for command in (build, [*driver, "-ldl"]):
        subprocess.run(command, env={**os.environ, "CXX": compiler}, check=True, capture_output=True)
    trace = folder / "trace"
    replay = [emulator, "-L", f"/usr/{_ARM}", str(folder / "replay"), str(folder / "_neon.so"), str(trace)]
    for scene in scenes:
        record = [sys.executable, str(ROOT / "scripts" / "bits_trace.py"), str(trace), "--frames", traced(scene), scene]
        subprocess.run(record, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True)
        done = subprocess.run(replay, check=False, capture_output=True, text=True)
        trace.unlink()
        if done.returncode not in (0, 1):
            raise RuntimeError(f"neon, emulated: {scene}: {done.stderr.strip()}")
        told = f"{done.stdout.strip()}, the same bits" if done.returncode == 0 else f"differs at {done.stdout.strip()}"
        yield f"neon, emulated: {scene}: {told}", done.returncode == 0


def main() -> int:
    """Run the comparison, print its results, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300, help="frames of each scene (default: 300)")
    parser.add_argument("--python", action="append", default=[], help="another interpreter, with its own numpy")
    parser.add_argument("--here", nargs="+", metavar="SCENE", help="run scenes in this process and print their digests")
    options = parser.parse_args()
    if options.frames < 1:
        parser.error(f"--frames is {options.frames}; at least 1 is needed")
    if options.here:
        run_here(options.here, options.frames)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        found = [(way, sys.executable) for way in [*ways(), *built_by_other_compilers(Path(folder))]]
        found += [(Way(python, {}), python) for python in options.python]
        status = tell(found, options.frames)
        for line, same in replayed_on_arm(Path(folder)):
            print(line, flush=True)
            status = status if same else 1
        return status


def tell(found: Sequence[tuple[Way, str]], frames: int) -> int:
    """Run each configuration, print its comparison with the first, and return the exit status."""
    first: dict[str, list[str]] | None = None
    status = 0
    for way, python in found:
        if way.why_not:
            print(f"{way.name}: left out, {way.why_not}", flush=True)
            continue
        told = run_apart(way, frames, python=python)
        first = first or told["digests"]
        differences = compare(first, told["digests"], way.name)
        status = 1 if differences else status
        total = sum(len(digests) for digests in first.values())
        same = f"{way.name} ({told['engine']}): {total} frames of {len(first)} scenes"
        print(f"{same}, {len(differences)} scenes differ" if differences else f"{same}, the same bits", flush=True)
        for difference in differences:
            print(f"  {difference}", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main())
