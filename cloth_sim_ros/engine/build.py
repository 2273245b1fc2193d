# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Builds the engine with the machine's C++ compiler: one shared library for each instruction set.

setup.py and `make` load this file by its path, before anything is installed: the standard library alone, and no import
of the package. By hand: `python cloth_sim_ros/engine/build.py`, with `--help` for more.

The build id of a library is the fingerprint of its sources, flags and compiler. A library is up to date if its build
id is the present fingerprint. The name of an object file has the fingerprint of its translation unit, of the
headers that the unit includes, flags and compiler. It is compiled only if it is missing.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import os
import platform
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

ENGINE = Path(__file__).resolve().parent
PATTERNS = ("**/*.cpp", "**/*.hpp", "**/*.map")  # the sources of a library, in every folder below this one
OBJECTS = "_objects"  # folder of the object files, beside the sources
MAX_OBJECTS = 3  # kept for each unit of a library: of other compilers, flags and contents
INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]*"([^"]+)"', re.MULTILINE)
MAX_COMPILERS = 2  # running at once: each takes some 500 MB
COMPILERS = ("g++", "clang++", "c++")

# -fno-fast-math comes first: both compilers let it imply errno for square roots, and clang lets it imply contraction.
# Contraction is off, because results have to be the same everywhere: the code writes each fma that it needs.
# The engine reads neither errno nor traps. Without them a square root is one instruction and loops are vectorized; no
# result changes.
# GCC 12 fuses sums and differences that alternate in straight-line code (vfmaddsub, vfmsubadd) although contraction is
# off. Therefore its vectorizer of straight-line code is off; the loops are written in vectors.
ARITHMETIC = [
    "-fno-fast-math",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-tree-slp-vectorize",
]
LANGUAGE = ["-std=c++20", "-I.", "-fPIC", "-pthread", "-fvisibility=hidden", "-fvisibility-inlines-hidden"]
# -Wno-psabi: GCC notes that it passes vectors differently since GCC 4.6. All these functions are inside one library.
WARNINGS = ["-Wall", "-Wextra", "-Wno-psabi"]
LINKED = ["-shared", "-Wl,--version-script=api/library.map"]
PLAIN = ["-Werror"]
# The baseline emulates fma and is slow at any level of optimization. -O1 halves the time to compile it.
OPTIMIZED = {"baseline": "-O1"}
# Warnings are no errors here, because the code that the sanitizers insert gives false ones. Debugging information has
# line numbers only: variables would make the compiler six times as slow.
SANITIZED = ["-O1", "-g1", "-fno-omit-frame-pointer", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]

INSTRUCTION_SETS = {
    "baseline": ["-march=x86-64", "-DCLOTH_VECTOR_BYTES=16"],
    "avx2": ["-march=x86-64-v3", "-DCLOTH_VECTOR_BYTES=32"],
    "avx512": ["-march=x86-64-v4", "-mprefer-vector-width=512", "-DCLOTH_VECTOR_BYTES=64"],
    "neon": ["-march=armv8-a", "-DCLOTH_VECTOR_BYTES=16"],
}
MACHINES = {"x86_64": ("baseline", "avx2", "avx512"), "aarch64": ("neon",)}


class BuildError(RuntimeError):
    """Error: the engine can't be built; the message states cause and remedy."""


class NoCompilerError(BuildError):
    """Error: no C++ compiler is installed."""


def names_for(machine: str | None = None) -> tuple[str, ...]:
    """Return the names of a machine's libraries (`uname -m`; None: this machine), e.g. avx2; BuildError for others."""
    machine = machine or platform.machine()
    try:
        return MACHINES[machine]
    except KeyError:
        known = " and ".join(MACHINES)
        raise BuildError(f"cloth_sim_ros: its engine is written for {known}, and this machine is {machine}.") from None


def names_here() -> list[str]:
    """Return the names of the libraries that this machine can run, preferred first; BuildError on an unknown machine.

    A package that is used in place needs no other: no other machine loads it.
    """
    return list(runpy.run_path(str(ENGINE / "instruction_set.py"))["libraries"]()) or list(names_for())


def file_name(name: str) -> str:
    """Return the file name of a library: _avx2.so for the name avx2."""
    return f"_{name}.so"


def flags(name: str, *, sanitize: bool = False) -> list[str]:
    """Return the compiler flags of a library; CXXFLAGS is not read, because it could change results."""
    purpose = SANITIZED if sanitize else [OPTIMIZED.get(name, "-O3"), *PLAIN]
    return [*LANGUAGE, *purpose, *ARITHMETIC, *INSTRUCTION_SETS[name], *WARNINGS]


def link_flags(name: str, *, sanitize: bool = False) -> list[str]:
    """Return the compiler flags that link a library's objects; with `sanitize`, symbols may be undefined."""
    return [*flags(name, sanitize=sanitize), *LINKED, *([] if sanitize else ["-Wl,-z,defs"])]


def find_compiler(environ: Mapping[str, str] = os.environ) -> list[str]:
    """Return the C++ compiler's command as a list: $CXX, else the first of `COMPILERS` here; else NoCompilerError.

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
    """Run a compiler with `--version` and return its output, the version; BuildError if it does not run.

    Raises:
        BuildError: if it does not run.
    """
    english = {**os.environ, "LC_ALL": "C"}  # the fingerprint must not depend on the language
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
    """Return all C++ sources, headers and linker maps below a folder, sorted by path."""
    return sorted(path for pattern in PATTERNS for path in sources.glob(pattern))


def translation_units(sources: Path = ENGINE) -> list[Path]:
    """Return the .cpp files below a folder, sorted by path."""
    return [path for path in source_files(sources) if path.suffix == ".cpp"]


def included_files(unit: Path, sources: Path = ENGINE) -> list[Path]:
    """Return a translation unit and all sources that it includes, directly or not, whatever their conditions."""
    files = {unit}
    waiting = [unit]
    while waiting:
        path = waiting.pop()
        for name in INCLUDE.findall(path.read_text()):
            for header in (path.parent / name, sources / name):
                if header.is_file() and header not in files:
                    files.add(header)
                    waiting.append(header)
    return sorted(files)


def fingerprint(
    arguments: Sequence[str], version: str, sources: Path = ENGINE, files: Sequence[Path] | None = None
) -> str:
    """Return a build id: hash of flags, compiler version and source files (all if None), 40 hexadecimal digits."""
    digest = hashlib.sha256("\0".join([*arguments, version]).encode())
    for path in source_files(sources) if files is None else files:
        content = path.read_bytes()
        digest.update(f"\0{path.relative_to(sources).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:40]


def is_current(library: Path, build_id: str) -> bool:
    """Return true if a library's file contains this build id; false if it does not, or can't be read."""
    try:
        return bytes.fromhex(build_id) in library.read_bytes()
    except OSError:
        return False


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock a folder during a `with` block: a second build at the same time waits, then finds the work done."""
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
    on_message: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Build, or copy, the libraries of a folder that are not up to date; return the paths of all.

    Args:
        folder: of the libraries; created if it is missing.
        names: of the libraries; all for this machine if None.
        sanitize: add the address and the undefined-behaviour sanitizer, for tests.
        sources: folder of the sources.
        on_message: called with a line of progress before a compile.

    Raises:
        BuildError: if a library can't be built.
    """
    names = names_for() if names is None else names
    compiler = find_compiler()
    version = describe(compiler)
    prints = {name: fingerprint(link_flags(name, sanitize=sanitize), version, sources) for name in names}
    libraries = {name: folder / file_name(name) for name in names}
    if all(is_current(libraries[name], prints[name]) for name in names):
        return list(libraries.values())
    folder.mkdir(parents=True, exist_ok=True)
    with lock_folder(folder):
        outdated = [name for name in names if not is_current(libraries[name], prints[name])]
        # A library beside the sources that is up to date is copied.
        ready = {name for name in outdated if is_current(sources / file_name(name), prints[name])}
        for name in sorted(ready):
            replace(libraries[name], partial(shutil.copy2, sources / file_name(name)))
        outdated = [name for name in outdated if name not in ready]
        if outdated:
            on_message(f"building the engine with {compiler[0]}: {', '.join(outdated)} ...")
            with ExitStack() as stack:
                objects = compile_units(stack, compiler, version, outdated, sanitize=sanitize, sources=sources)
                for name in outdated:
                    command = [*compiler, *link_flags(name, sanitize=sanitize), f"-Wl,--build-id=0x{prints[name]}"]
                    command += [str(path) for path in objects[name]]
                    replace(libraries[name], partial(run, command, name=name, version=version, sources=sources))
    return list(libraries.values())


def compile_units(
    stack: ExitStack, compiler: Sequence[str], version: str, names: Sequence[str], *, sanitize: bool, sources: Path
) -> dict[str, list[Path]]:
    """Compile the translation units of libraries unless their objects exist; return the paths of objects by library.

    The folder of the objects is locked until the stack is closed. Where the sources can't be written it is temporary.
    """
    folder = (sources / OBJECTS).absolute()
    if os.access(folder if folder.exists() else sources, os.W_OK):
        folder.mkdir(exist_ok=True)
    else:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    stack.enter_context(lock_folder(folder))
    for interrupted in folder.glob("*.new"):
        interrupted.unlink()
    objects: dict[str, list[Path]] = {}
    missing = []
    for name in names:
        arguments = flags(name, sanitize=sanitize)
        for unit in translation_units(sources):
            relative = unit.relative_to(sources).as_posix()
            print_of_unit = fingerprint(arguments, version, sources, included_files(unit, sources))
            target = folder / f"{name}-{relative.replace('/', '-')}-{print_of_unit}.o"
            objects.setdefault(name, []).append(target)
            if target.exists():
                target.touch()  # the latest are kept
            else:
                missing.append((target, name, [*compiler, *arguments, "-c", relative]))

    def compile_unit(target: Path, name: str, command: list[str]) -> None:
        replace(target, partial(run, command, name=name, version=version, sources=sources))

    with ThreadPoolExecutor(MAX_COMPILERS) as pool:
        try:
            for done in [pool.submit(compile_unit, *unit) for unit in missing]:
                done.result()
        except BuildError:
            pool.shutdown(cancel_futures=True)
            raise
    for target in [target for targets in objects.values() for target in targets]:
        versions = sorted(folder.glob(f"{target.name[:-42]}*.o"), key=lambda path: path.stat().st_mtime_ns)
        for outdated in versions[:-MAX_OBJECTS]:
            outdated.unlink()
    return objects


def replace(library: Path, make: Callable[[Path], object]) -> None:
    """Replace a file atomically by one that `make(path)` writes; a process that has loaded the old library keeps it."""
    target = library.with_name(f"{library.name}.{os.getpid()}.new").absolute()
    try:
        make(target)
        os.replace(target, library)
    finally:
        target.unlink(missing_ok=True)


def run(command: list[str], output: Path, *, name: str, version: str, sources: Path) -> None:
    """Run a compiler command in the folder of the sources, which writes `output`; BuildError if it fails.

    Raises:
        BuildError: with the compiler's output, if it fails.
    """
    command = [*command, "-o", str(output)]
    done = subprocess.run(command, cwd=sources, check=False, capture_output=True, text=True, errors="replace")
    if done.returncode:
        raise BuildError(
            f"{done.stdout}{done.stderr}\n{shlex.join(command)}\n"
            f"cloth_sim_ros: the compiler could not build the engine for {name} (status {done.returncode}, see above);"
            f" it needs g++ 12, clang 14 or newer, and this is {version.splitlines()[0]}."
        )


def main() -> int:
    """Build the engine's libraries by options of the command line; return 0, or 1 after an error that is printed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", action="append", choices=INSTRUCTION_SETS, help="name of a library; by default all for this machine"
    )
    parser.add_argument("--folder", type=Path, default=ENGINE, help="folder of the libraries")
    parser.add_argument("--sanitize", action="store_true", help="with the address and undefined-behaviour sanitizers")
    arguments = parser.parse_args()
    try:
        build(
            arguments.folder.absolute(),
            names=arguments.only,
            sanitize=arguments.sanitize,
            on_message=lambda text: print(f"cloth_sim_ros: {text}", flush=True),
        )
    except BuildError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
