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


class RunConfiguration(NamedTuple):
    """One configuration in which all scenes run."""

    name: str
    environment: dict[str, str]
    #: Reason if this machine can't run it; else empty.
    skip_reason: str = ""
    #: True if the process may use one processor only.
    single_processor: bool = False


class Difference(NamedTuple):
    """A scene whose bits differ between two configurations."""

    scene: str
    configuration: str
    frame: int

    def __str__(self) -> str:
        return f"{self.scene}: {self.configuration} differs from frame {self.frame} on"


def run_in_process(scenes: Sequence[str], frames: int) -> None:
    """Run scenes in this process; print the engine's name and the digests as JSON."""
    from cloth_sim_ros.engine.binding import engine_name

    result = {"engine": engine_name(), "digests": {scene: list(frames_of(scene, frames)) for scene in scenes}}
    print(json.dumps(result))


def run_in_subprocess(
    configuration: RunConfiguration, frames: int, *, scenes: Sequence[str] = tuple(SCENES), python: str = sys.executable
) -> Any:
    """Run scenes in a new process and return the output of `run_in_process`.

    Raises:
        RuntimeError: if the process fails.
    """
    command = [python, str(Path(__file__).resolve()), "--frames", str(frames), "--here", *scenes]
    if configuration.single_processor:
        command = ["taskset", "-c", str(min(os.sched_getaffinity(0))), *command]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path, **configuration.environment}
    process = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
    if process.returncode:
        raise RuntimeError(f"{configuration.name}: {process.stderr[-2000:]}")
    return json.loads(process.stdout.splitlines()[-1])


def compare(
    first: dict[str, list[str]], digests_by_scene: dict[str, list[str]], configuration: str
) -> list[Difference]:
    """Return the scenes with differing digests, each with its first differing frame."""
    differences = []
    for scene, digests in first.items():
        differing_frames = [
            k for k, (a, b) in enumerate(zip(digests, digests_by_scene[scene], strict=True), start=1) if a != b
        ]
        if differing_frames:
            differences.append(Difference(scene, configuration, differing_frames[0]))
    return differences


def run_configurations() -> list[RunConfiguration]:
    """Return the configurations that need nothing but installed software; the first is this machine's own."""
    libraries = runpy.run_path(str(ENGINE / "instruction_set.py"))["libraries"]()
    configurations = [RunConfiguration(libraries[0], {"CLOTH_SIM_ROS_ENGINE": libraries[0]})]
    for name in {"x86_64": ("baseline", "avx2", "avx512"), "aarch64": ("neon",)}[platform.machine()]:
        if name == libraries[0]:
            continue
        why_not = "" if name in libraries else "this processor has no such vectors"
        configurations.append(RunConfiguration(name, {"CLOTH_SIM_ROS_ENGINE": name}, why_not))
    features = numpy_features()
    restricted = {
        "GLIBC_TUNABLES": f"{_HWCAPS}:{_PERTURB}",
        "NPY_DISABLE_CPU_FEATURES": " ".join(features),
        "OPENBLAS_CORETYPE": "PRESCOTT",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONHASHSEED": "1",
    }
    configurations.append(RunConfiguration("plain C library and numpy", restricted))
    skip_alone = "" if shutil.which("taskset") else "there is no taskset"
    configurations.append(RunConfiguration("one processor", {"PYTHONHASHSEED": "2"}, skip_alone, single_processor=True))
    return configurations


def numpy_features() -> list[str]:
    """Return the processor features that numpy detects and can do without."""
    major = int(np.__version__.split(".")[0])
    inside = importlib.import_module(f"numpy.{'core' if major < 2 else '_core'}._multiarray_umath")
    return [name for name in inside.__cpu_dispatch__ if inside.__cpu_features__.get(name)]


def build_with_other_compilers(folder: Path) -> list[RunConfiguration]:
    """Build the engine with each installed compiler, for the widest vectors here; return the configurations."""
    name = runpy.run_path(str(ENGINE / "instruction_set.py"))["libraries"]()[0]
    configurations = []
    for compiler in ("g++", "clang++"):
        label = f"{name} by {compiler}"
        if shutil.which(compiler) is None:
            configurations.append(RunConfiguration(label, {}, f"there is no {compiler}"))
            continue
        build_folder = folder / compiler
        command = [sys.executable, str(ENGINE / "build.py"), "--only", name, "--folder", str(build_folder)]
        process = subprocess.run(
            command, env={**os.environ, "CXX": compiler}, check=False, capture_output=True, text=True
        )
        why_not = process.stderr.strip()[-300:] if process.returncode else ""
        configurations.append(
            RunConfiguration(label, {"CLOTH_SIM_ROS_ENGINE": str(build_folder / f"_{name}.so")}, why_not)
        )
    return configurations


def n_traced_frames(scene: str) -> str:
    """Return the number of frames to repeat in the emulator; with contact there are more, until all bodies touch."""
    return "24" if "contact.thickness" in SCENES[scene] else "4"


def replay_on_arm(folder: Path, scenes: Sequence[str] = tuple(SCENES)) -> Iterator[tuple[str, bool]]:
    """Repeat the engine's calls on an emulated 64-bit ARM processor.

    Yields:
        A line of output for each scene, and True if its bits are the same.
    """
    compiler = next(filter(shutil.which, (f"{_ARM}-g++", f"{_ARM}-g++-12")), None)
    emulator = next(filter(shutil.which, ("qemu-aarch64-static", "qemu-aarch64")), None)
    if platform.machine() != "x86_64" or compiler is None or emulator is None:
        missing = " and ".join(
            name for name, path in (("g++-aarch64-linux-gnu", compiler), ("qemu-user-static", emulator)) if not path
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
        record = [
            sys.executable,
            str(ROOT / "scripts" / "bits_trace.py"),
            str(trace),
            "--frames",
            n_traced_frames(scene),
            scene,
        ]
        subprocess.run(record, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True)
        process = subprocess.run(replay, check=False, capture_output=True, text=True)
        trace.unlink()
        if process.returncode not in (0, 1):
            raise RuntimeError(f"neon, emulated: {scene}: {process.stderr.strip()}")
        outcome = (
            f"{process.stdout.strip()}, the same bits"
            if process.returncode == 0
            else f"differs at {process.stdout.strip()}"
        )
        yield f"neon, emulated: {scene}: {outcome}", process.returncode == 0


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
        run_in_process(options.here, options.frames)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        runs = [
            (configuration, sys.executable)
            for configuration in [*run_configurations(), *build_with_other_compilers(Path(folder))]
        ]
        runs += [(RunConfiguration(python, {}), python) for python in options.python]
        status = compare_runs(runs, options.frames)
        for line, same in replay_on_arm(Path(folder)):
            print(line, flush=True)
            status = status if same else 1
        return status


def compare_runs(runs: Sequence[tuple[RunConfiguration, str]], frames: int) -> int:
    """Run each configuration, print its comparison with the first, and return the exit status."""
    first: dict[str, list[str]] | None = None
    status = 0
    for configuration, python in runs:
        if configuration.skip_reason:
            print(f"{configuration.name}: left out, {configuration.skip_reason}", flush=True)
            continue
        result = run_in_subprocess(configuration, frames, python=python)
        first = first or result["digests"]
        differences = compare(first, result["digests"], configuration.name)
        status = 1 if differences else status
        total = sum(len(digests) for digests in first.values())
        same = f"{configuration.name} ({result['engine']}): {total} frames of {len(first)} scenes"
        print(f"{same}, {len(differences)} scenes differ" if differences else f"{same}, the same bits", flush=True)
        for difference in differences:
            print(f"  {difference}", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main())
