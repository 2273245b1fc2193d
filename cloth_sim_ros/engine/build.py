# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Builds the engine with the machine's C++ compiler: one shared library for each instruction set.

setup.py and `make` load this file by its path, before anything is installed: the standard library alone, and no import
of the package. By hand: `python cloth_sim_ros/engine/build.py`, with `--help` for more.

A library carries the fingerprint of what it was made from (sources, flags, compiler) as its linker's build id, so that
no other file says whether it is up to date.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import os
import platform
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

ENGINE = Path(__file__).resolve().parent
UNIT = "library.cpp"  # the only translation unit
PATTERNS = ("**/*.cpp", "**/*.hpp", "**/*.map")  # the sources of a library, in every folder below this one
AT_A_TIME = 2  # a compile takes some 500 MB
COMPILERS = ("g++", "clang++", "c++")

# -fno-fast-math comes first: to both compilers it also means errno for square roots, and to clang contraction.
# Contraction off is what makes the results the same everywhere: fma stands where it is written and nowhere else.
# Nobody looks at errno or traps; without them a square root is one instruction, and loops become vectors. No result
# changes with either.
# Among statements in a row GCC 12 takes products that are added and subtracted in turn for one fused instruction, with
# contraction off too (vfmaddsub, vfmsubadd): it shall not look for vectors there. Loops are written in vectors anyway.
ARITHMETIC = [
    "-fno-fast-math",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-tree-slp-vectorize",
]
LANGUAGE = ["-std=c++20", "-I.", "-fPIC", "-shared", "-pthread", "-fvisibility=hidden", "-fvisibility-inlines-hidden"]
# -Wno-psabi: GCC notes that functions which pass vectors changed in GCC 4.6; they are all inside one library.
WARNINGS = ["-Wall", "-Wextra", "-Wno-psabi"]
LINKED = ["-Wl,--version-script=library.map"]
PLAIN = ["-Werror", "-Wl,-z,defs"]
# The baseline emulates fma and is slow whatever the compiler does: half the time to compile it is worth more.
OPTIMIZED = {"baseline": "-O1"}
# The sanitizers' own code gives false warnings, so these are no errors here. Of debugging information there are lines
# alone: with variables the compiler takes six times as long.
SANITIZED = ["-O1", "-g1", "-fno-omit-frame-pointer", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]

INSTRUCTION_SETS = {
    "baseline": ["-march=x86-64", "-DCLOTH_VECTOR_BYTES=16"],
    "avx2": ["-march=x86-64-v3", "-DCLOTH_VECTOR_BYTES=32"],
    "avx512": ["-march=x86-64-v4", "-mprefer-vector-width=512", "-DCLOTH_VECTOR_BYTES=64"],
    "neon": ["-march=armv8-a", "-DCLOTH_VECTOR_BYTES=16"],
}
MACHINES = {"x86_64": ("baseline", "avx2", "avx512"), "aarch64": ("neon",)}


class BuildError(RuntimeError):
    """The engine can't be built; the message says why, and what to do."""


class NoCompilerError(BuildError):
    """There is no C++ compiler."""


def names_for(machine: str | None = None) -> tuple[str, ...]:
    """The libraries that are built for a machine (as `uname -m` names it; this one if None)."""
    machine = machine or platform.machine()
    try:
        return MACHINES[machine]
    except KeyError:
        known = " and ".join(MACHINES)
        raise BuildError(f"cloth_sim_ros: its engine is written for {known}, and this machine is {machine}.") from None


def names_here() -> list[str]:
    """The libraries that this machine can run, the one that it loads first; all of `names_for` on a stranger's machine.

    Where the package is used in place no other machine loads them, so no other need be built.
    """
    return list(runpy.run_path(str(ENGINE / "instruction_set.py"))["libraries"]()) or list(names_for())


def file_name(name: str) -> str:
    """The file of a library."""
    return f"_{name}.so"


def flags(name: str, *, sanitize: bool = False) -> list[str]:
    """What the compiler is told for a library; CXXFLAGS is not read, for it could change results."""
    purpose = SANITIZED if sanitize else [OPTIMIZED.get(name, "-O3"), *PLAIN]
    return [*LANGUAGE, *purpose, *ARITHMETIC, *INSTRUCTION_SETS[name], *WARNINGS, *LINKED]


def find_compiler(environ: Mapping[str, str] = os.environ) -> list[str]:
    """The command of the C++ compiler: $CXX if it is set, else the first that is there.

    Raises:
        NoCompilerError: if there is none.
    """
    path = environ.get("PATH")
    chosen = shlex.split(environ.get("CXX", ""))
    if chosen:
        if shutil.which(chosen[0], path=path):
            return chosen
        raise NoCompilerError(
            f"cloth_sim_ros: its engine is C++, and the compiler that CXX names, {chosen[0]}, was not found;"
            " install it, or unset CXX to have g++ or clang++ found."
        )
    for command in COMPILERS:
        if shutil.which(command, path=path):
            return [command]
    raise NoCompilerError(
        f"cloth_sim_ros: its engine is C++, and no compiler was found ({', '.join(COMPILERS)});"
        " install the package g++ (Debian, Ubuntu: apt install g++), or name a compiler: CXX=/path/to/clang++."
    )


def describe(compiler: Sequence[str]) -> str:
    """What a compiler says of itself.

    Raises:
        BuildError: if it does not run.
    """
    english = {**os.environ, "LC_ALL": "C"}  # the same words, and so the same fingerprint, in every language
    try:
        done = subprocess.run(
            [*compiler, "--version"], env=english, check=False, capture_output=True, text=True, errors="replace"
        )
    except OSError as error:
        raise BuildError(f"cloth_sim_ros: the compiler {compiler[0]} does not run ({error}).") from error
    if done.returncode or not done.stdout.strip():
        raise BuildError(
            f"cloth_sim_ros: the compiler {shlex.join(compiler)} does not run: `--version` ended with status"
            f" {done.returncode} ({done.stderr.strip()}); install the package g++, or name another compiler with CXX."
        )
    return done.stdout


def source_files(sources: Path = ENGINE) -> list[Path]:
    """The sources of a library, sorted by path."""
    return sorted(path for pattern in PATTERNS for path in sources.glob(pattern))


def fingerprint(arguments: Sequence[str], version: str, sources: Path = ENGINE) -> str:
    """40 hexadecimal digits that stand for the sources, the flags and the compiler."""
    digest = hashlib.sha256("\0".join([*arguments, version]).encode())
    for path in source_files(sources):
        content = path.read_bytes()
        digest.update(f"\0{path.relative_to(sources).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:40]


def is_current(library: Path, made_from: str) -> bool:
    """Whether a library is there and carries this fingerprint."""
    try:
        return bytes.fromhex(made_from) in library.read_bytes()
    except OSError:
        return False


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder alone, so that of two builds at a time the second finds the work done."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def build(
    folder: Path = ENGINE,
    *,
    names: Sequence[str] | None = None,
    sanitize: bool = False,
    sources: Path = ENGINE,
    say: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Make the libraries in a folder, those that are not up to date; return all of them.

    Args:
        folder: where they shall be; made if it is missing.
        names: which; those for this machine if None.
        sanitize: with the address and the undefined-behaviour sanitizer, for tests.
        sources: the folder of the sources.
        say: is told what is built.

    Raises:
        BuildError: if a library can't be built.
    """
    names = names_for() if names is None else names
    compiler = find_compiler()
    version = describe(compiler)
    prints = {name: fingerprint(flags(name, sanitize=sanitize), version, sources) for name in names}
    libraries = {name: folder / file_name(name) for name in names}
    if all(is_current(libraries[name], prints[name]) for name in names):
        return list(libraries.values())
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        wanted = [name for name in names if not is_current(libraries[name], prints[name])]
        # What was built beside the sources needs no second compile.
        ready = {name for name in wanted if is_current(sources / file_name(name), prints[name])}
        for name in sorted(ready):
            replace(libraries[name], partial(shutil.copy2, sources / file_name(name)))
        wanted = [name for name in wanted if name not in ready]
        if wanted:
            say(f"building the engine with {compiler[0]}: {', '.join(wanted)} ...")

        def compile_one(name: str) -> None:
            command = [*compiler, *flags(name, sanitize=sanitize), f"-Wl,--build-id=0x{prints[name]}", UNIT]
            replace(libraries[name], lambda target: run([*command, "-o", str(target)], name, version, sources))

        with ThreadPoolExecutor(AT_A_TIME) as pool:
            list(pool.map(compile_one, wanted))
    return list(libraries.values())


def replace(library: Path, make: Callable[[Path], object]) -> None:
    """Have a library made under another name and take its place whole: a process that has the old one keeps it."""
    target = library.with_name(f"{library.name}.{os.getpid()}.new").absolute()
    try:
        make(target)
        os.replace(target, library)
    finally:
        target.unlink(missing_ok=True)


def run(command: list[str], name: str, version: str, sources: Path) -> None:
    """Run the compiler; raises BuildError with what it said."""
    done = subprocess.run(command, cwd=sources, check=False, capture_output=True, text=True, errors="replace")
    if done.returncode:
        raise BuildError(
            f"{done.stdout}{done.stderr}\n{shlex.join(command)}\n"
            f"cloth_sim_ros: the compiler could not build the engine for {name} (status {done.returncode}, see above);"
            f" it needs g++ 12, clang 14 or newer, and this is {version.splitlines()[0]}."
        )


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", action="append", choices=INSTRUCTION_SETS, help="which; by default this machine's all"
    )
    parser.add_argument("--folder", type=Path, default=ENGINE, help="where the libraries shall be")
    parser.add_argument("--sanitize", action="store_true", help="with the address and undefined-behaviour sanitizers")
    arguments = parser.parse_args()
    try:
        build(
            arguments.folder.absolute(),
            names=arguments.only,
            sanitize=arguments.sanitize,
            say=lambda text: print(f"cloth_sim_ros: {text}", flush=True),
        )
    except BuildError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
