# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Build of the engine: compiler, flags, rebuilds, packages and error messages."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
import sys
import tarfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from cloth_sim_ros.engine import build, instruction_set

ROOT = Path(__file__).resolve().parents[2]
UNIT = "api/library.cpp"
V3 = "fpu sse2 ssse3 sse4_1 sse4_2 popcnt cx16 avx avx2 bmi1 bmi2 f16c fma abm movbe"
V4 = f"{V3} avx512f avx512bw avx512cd avx512dq avx512vl"
SMALL = """
#include <cmath>
#include <map>
#include <stdexcept>
#include "core/small.hpp"
#define CLOTH_PUBLIC extern "C" __attribute__((visibility("default")))
CLOTH_PUBLIC int cloth_bytes() { return CLOTH_VECTOR_BYTES; }
CLOTH_PUBLIC double cloth_sum(double a, double b, double c) { return a * b + c; }
CLOTH_PUBLIC void cloth_product(const double* a, const double* b, double* out)  // of complex numbers
{
    const double real = a[0] * b[0] - a[1] * b[1], other = a[0] * b[1] + a[1] * b[0];
    out[0] = real;
    out[1] = other;
}
CLOTH_PUBLIC double cloth_root(double a) { return std::sqrt(a); }
CLOTH_PUBLIC int cloth_at(int n)
{
    std::map<int, int> values;  // whose code the compilers keep as functions of their own
    for (int k = 0; k < 3; ++k) values[k * n] = k;
    try { return values.at(n > 5 ? -1 : n); } catch (const std::out_of_range&) { return missing; }
}
"""


def write_unit(sources: Path, text: str = SMALL) -> None:
    """Write the translation unit, and the header in a folder that it includes."""
    for name, content in ((UNIT, text), ("core/small.hpp", "inline constexpr int missing = -1;\n")):
        (sources / name).parent.mkdir(parents=True, exist_ok=True)
        (sources / name).write_text(content)


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    """A small engine, with the real one's list of what a library shows."""
    folder = tmp_path / "sources"
    write_unit(folder)
    shutil.copy(build.ENGINE / "api/library.map", folder / "api")
    return folder


@pytest.fixture(params=["g++", "clang++"])
def compiler(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each compiler of this machine in turn."""
    if shutil.which(request.param) is None:
        pytest.skip(f"{request.param} is not installed")
    monkeypatch.setenv("CXX", request.param)
    return request.param


def stub_compiler(path: Path, script: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def plainest_library() -> str:
    """The name of the library that any machine of this kind runs."""
    return instruction_set.libraries()[-1]


@pytest.mark.parametrize(
    ("machine", "flags", "expected"),
    [
        ("x86_64", V4, ["avx512", "avx2", "baseline"]),
        ("x86_64", V3, ["avx2", "baseline"]),
        ("x86_64", V3.replace(" fma", ""), ["baseline"]),
        ("x86_64", V4.replace(" avx512vl", ""), ["avx2", "baseline"]),
        ("x86_64", V4.replace(" abm", ""), ["baseline"]),
        ("aarch64", "", ["neon"]),
        ("riscv64", "", []),
    ],
)
def test_libraries_of_each_machine(tmp_path: Path, machine: str, flags: str, expected: list[str]) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"processor\t: 0\nflags\t\t: {flags}\nvmx flags\t: fma\n\nprocessor\t: 1\nflags\t\t: {flags}\n")
    assert instruction_set.libraries(machine=machine, cpuinfo=cpuinfo) == expected


def test_processors_that_differ_run_what_all_can(tmp_path: Path) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"processor : 0\nflags : {V4}\n\nprocessor : 1\nflags : {V3}\n")
    assert instruction_set.libraries(machine="x86_64", cpuinfo=cpuinfo) == ["avx2", "baseline"]
    assert instruction_set.libraries(machine="x86_64", cpuinfo=tmp_path / "absent") == ["baseline"]


def test_preferred_libraries_are_built(tmp_path: Path) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"flags : {V4}\n")
    for machine in build.MACHINES:
        assert set(instruction_set.libraries(machine=machine, cpuinfo=cpuinfo)) == set(build.names_for(machine))
    with pytest.raises(build.BuildError, match="this machine is riscv64"):
        build.names_for("riscv64")


@pytest.mark.parametrize("sanitize", [False, True])
@pytest.mark.parametrize("name", build.INSTRUCTION_SETS)
def test_flags_keep_to_ieee_arithmetic(name: str, sanitize: bool) -> None:
    flags = build.flags(name, sanitize=sanitize)
    # It would undo the three that are named after it: contraction (clang), errno and traps (both).
    first = flags.index("-fno-fast-math")
    for flag in ("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-tree-slp-vectorize"):
        assert flags.count(flag) == 1
        assert flags.index(flag) > first
    assert build.link_flags(name, sanitize=sanitize)[: len(flags)] == flags
    loose = {"-ffast-math", "-Ofast", "-funsafe-math-optimizations", "-fassociative-math", "-freciprocal-math"}
    loose |= {"-ffinite-math-only", "-fno-signed-zeros", "-march=native"}
    assert not loose & set(flags)
    assert sum(flag.startswith("-DCLOTH_VECTOR_BYTES=") for flag in flags) == 1
    assert ("-Werror" in flags) == (not sanitize)


def test_products_are_rounded_before_sums(sources: Path, tmp_path: Path, compiler: str) -> None:
    names = instruction_set.libraries()
    for path in build.build(tmp_path / "out", names=names, sources=sources):
        library = ctypes.CDLL(str(path))
        library.cloth_sum.restype = library.cloth_root.restype = ctypes.c_double
        x = 1.0 + 2.0**-30
        # The product's last bit, 2^-60, is lost in rounding; one contracted to fma would keep it.
        assert library.cloth_sum(*map(ctypes.c_double, (x, x, -1.0 - 2.0**-29))) == 0.0
        # The same where sums and differences alternate: either product is the one whose last bit is lost.
        for a, b in (((x, 1.0), (x, 1.0 + 2.0**-29)), ((1.0, x), (1.0 + 2.0**-29, x))):
            out = (ctypes.c_double * 2)()
            library.cloth_product((ctypes.c_double * 2)(*a), (ctypes.c_double * 2)(*b), out)
            assert list(out) == [0.0, a[0] * b[1] + a[1] * b[0]]
        assert library.cloth_root(ctypes.c_double(2.0)) == 2.0**0.5
        bytes_here = {"avx512": 64, "avx2": 32}.get(path.stem.removeprefix("_"), 16)
        assert library.cloth_bytes() == bytes_here
        assert library.cloth_at(1) == 1
        assert library.cloth_at(7) == -1


def test_square_roots_call_no_library_and_all_sets_build(sources: Path, tmp_path: Path, compiler: str) -> None:
    nm = shutil.which("nm")
    if nm is None:
        pytest.skip("nm is not installed")
    for path in build.build(tmp_path / "out", sources=sources):
        shown = subprocess.run([nm, "-D", path], check=True, capture_output=True, text=True).stdout.splitlines()
        # With errno the compiler calls the C library's sqrt for negative numbers.
        assert not [line for line in shown if " U sqrt" in line]
        # Nothing but the C ABI, though templates of the standard library were used.
        defined = [line.split()[-1] for line in shown if " U " not in line and " w " not in line]
        assert sorted(defined) == ["cloth_at", "cloth_bytes", "cloth_product", "cloth_root", "cloth_sum"]


def test_the_engine_itself_is_built_without_a_warning(tmp_path: Path, compiler: str) -> None:
    # With the widest vectors that this machine has; `make bits` builds all of them with each compiler.
    name = instruction_set.libraries()[0]
    (library,) = build.build(tmp_path / "out", names=[name])
    assert library.name == build.file_name(name)
    assert library.is_file()


def test_engine_for_other_processors_has_no_error(compiler: str) -> None:
    # The compiler checks every template that is used and generates no code; a build takes seven times as long. All
    # units are one, because their headers take most of the time.
    unit = "".join(f'#include "{path.relative_to(build.ENGINE)}"\n' for path in build.translation_units())
    for name in build.names_for():
        if name not in instruction_set.libraries():
            command = [compiler, *build.flags(name), "-fsyntax-only", "-x", "c++", "-"]
            done = subprocess.run(command, cwd=build.ENGINE, input=unit, check=False, capture_output=True, text=True)
            assert not done.stderr


def test_rebuild_only_after_a_change(sources: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    messages: list[str] = []
    counts = []

    def make() -> None:
        build.build(folder, names=[plainest_library()], sources=sources, on_message=messages.append)
        counts.append(len(messages))

    make()
    make()
    (sources / UNIT).touch()
    make()
    assert counts == [1, 1, 1]
    (sources / "law.hpp").write_text("// another law\n")
    make()
    build.build(folder, names=[plainest_library()], sources=sources, sanitize=True, on_message=messages.append)
    (folder / build.file_name(plainest_library())).unlink()
    make()
    assert counts[3:] == [2, 4]
    assert [path.name for path in folder.iterdir()] == [build.file_name(plainest_library())]


def test_every_source_changes_build_id(tmp_path: Path) -> None:
    copy = tmp_path / "engine"
    shutil.copytree(build.ENGINE, copy, ignore=shutil.ignore_patterns("*.so", "__pycache__", build.OBJECTS))
    (copy / "laws" / "air").mkdir(parents=True)
    (copy / "laws" / "air" / "law.hpp").write_text("// a law\n")
    prints = {build.fingerprint([], "", copy)}
    files = [path for path in copy.rglob("*") if path.suffix in (".cpp", ".hpp", ".map")]
    for path in files:
        with path.open("a") as source:
            source.write("\n")
        prints.add(build.fingerprint([], "", copy))
    assert len(prints) == 1 + len(files)
    moved = copy / "laws" / "law.hpp"
    (copy / "laws" / "air" / "law.hpp").rename(moved)
    assert build.fingerprint([], "", copy) not in prints


def test_sources_are_those_that_the_compiler_reads(compiler: str) -> None:
    flags = build.flags(plainest_library())
    all_read = set()
    for unit in build.translation_units():
        done = subprocess.run([compiler, *flags, "-MM", unit], cwd=build.ENGINE, check=True, capture_output=True)
        names = done.stdout.decode().replace("\\\n", " ").split()[1:]
        read = {(build.ENGINE / name).resolve() for name in names}
        assert read == {path.resolve() for path in build.included_files(unit)}, unit
        all_read |= read
    sources = {path.resolve() for path in build.source_files() if path.suffix in (".cpp", ".hpp")}
    assert all_read == sources, "what is included is part of the build id, and what is part of it is included"


def compiled_units(folder: Path, log: Path, sources: Path) -> list[str]:
    """Build the plainest library with a compiler that logs; return the translation units that it compiled."""
    log.write_text("")
    build.build(folder, names=[plainest_library()], sources=sources)
    return sorted(line for line in log.read_text().split() if line.endswith(".cpp"))


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file to which the compiler writes its arguments."""
    path = tmp_path / "log"
    real = shutil.which("g++") or shutil.which("clang++")
    script = f'echo "$@" >> {path}\nexec {real} "$@"'
    monkeypatch.setenv("CXX", str(stub_compiler(tmp_path / "bin" / "compiler", script)))
    return path


def test_edit_compiles_units_that_include_it(sources: Path, tmp_path: Path, log: Path) -> None:
    folder, second = tmp_path / "out", sources / "core" / "second.cpp"
    second.write_text('#include "inner.hpp"\nint second() { return deep; }\n')
    (sources / "core" / "inner.hpp").write_text('#if 1\n  # include "deep.hpp"\n#endif\n')
    (sources / "core" / "deep.hpp").write_text("inline constexpr int deep = 1;\n")
    assert compiled_units(folder, log, sources) == [UNIT, "core/second.cpp"]
    (sources / "core" / "deep.hpp").write_text("inline constexpr int deep = 2;\n")
    assert compiled_units(folder, log, sources) == ["core/second.cpp"]
    (sources / "core" / "small.hpp").write_text("inline constexpr int missing = -2;\n")
    assert compiled_units(folder, log, sources) == [UNIT]
    (sources / "unused.hpp").write_text("// linked again with another build id\n")
    assert compiled_units(folder, log, sources) == []
    (sources / "core" / "deep.hpp").write_text("inline constexpr int deep = 1;\n")
    assert compiled_units(folder, log, sources) == [], "the object of the earlier content is kept"
    assert ctypes.CDLL(str(folder / build.file_name(plainest_library()))).cloth_at(7) == -2


def test_old_objects_are_removed(sources: Path, tmp_path: Path) -> None:
    for status in range(build.MAX_OBJECTS + 2):
        (sources / "core/small.hpp").write_text(f"inline constexpr int missing = {status};\n")
        (library,) = build.build(tmp_path / "out", names=[plainest_library()], sources=sources)
        assert ctypes.CDLL(str(library.rename(tmp_path / f"{status}.so"))).cloth_at(7) == status
    objects = list((sources / build.OBJECTS).iterdir())
    assert len(objects) == build.MAX_OBJECTS
    assert {path.suffix for path in objects} == {".o"}


def test_interrupted_build_leaves_no_partial_object(sources: Path, tmp_path: Path, log: Path) -> None:
    arguments = "folder=Path(sys.argv[1]), names=sys.argv[2:3], sources=Path(sys.argv[3])"
    script = f"import sys\nfrom pathlib import Path\nfrom cloth_sim_ros.engine import build\nbuild.build({arguments})"
    command = [sys.executable, "-c", script, tmp_path / "out", plainest_library(), sources]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    stub = Path(os.environ["CXX"])
    working = stub.read_text()
    # The compiler writes the first half of an object, and then its caller is killed.
    stub_compiler(
        stub,
        '[ "$1" = --version ] && exec g++ "$@"\nfor last; do :; done\necho half > "$last"\nkill -9 $PPID',
    )
    assert subprocess.run(command, env=environment, check=False).returncode == -9
    assert [path.suffix for path in (sources / build.OBJECTS).iterdir()] == [".new"]
    stub.write_text(working)
    build.build(tmp_path / "out", names=[plainest_library()], sources=sources)
    assert [path.suffix for path in (sources / build.OBJECTS).iterdir()] == [".o"]


def test_builds_at_once_compile_once(sources: Path, tmp_path: Path, log: Path) -> None:
    with ThreadPoolExecutor(4) as pool:
        folders = [tmp_path / f"out{k % 2}" for k in range(4)]
        build_one = partial(build.build, names=[plainest_library()], sources=sources)
        paths = [path for (path,) in pool.map(build_one, folders)]
    assert log.read_text().split().count(UNIT) == 1
    assert [ctypes.CDLL(str(path)).cloth_at(7) for path in paths] == [-1] * 4


def test_sources_that_are_read_only_build(sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build.os, "access", lambda path, mode: "bin" in str(path))
    (library,) = build.build(tmp_path / "out", names=[plainest_library()], sources=sources)
    assert ctypes.CDLL(str(library)).cloth_at(7) == -1
    assert not (sources / build.OBJECTS).exists()


def test_another_version_of_the_compiler_builds_again(
    sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = shutil.which("g++") or shutil.which("clang++")
    script = f'[ "$1" = --version ] && {{ cat {tmp_path}/version; exit; }}\nexec {real} "$@"'
    monkeypatch.setenv("CXX", str(stub_compiler(tmp_path / "bin" / "compiler", script)))
    messages: list[str] = []
    for version in ("13.1", "13.1", "13.2"):
        (tmp_path / "version").write_text(version)
        build.build(tmp_path / "out", names=[plainest_library()], sources=sources, on_message=messages.append)
    assert len(messages) == 2


def test_library_beside_sources_is_copied(sources: Path, tmp_path: Path) -> None:
    messages: list[str] = []
    build.build(sources, names=[plainest_library()], sources=sources, on_message=messages.append)
    (copied,) = build.build(tmp_path / "out", names=[plainest_library()], sources=sources, on_message=messages.append)
    assert len(messages) == 1
    assert copied.read_bytes() == (sources / build.file_name(plainest_library())).read_bytes()


def test_failing_compiler_is_quoted(sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = '[ "$1" = --version ] && { echo "g++ 4.8"; exit; }\necho "unrecognized option -std=c++20" >&2; exit 3'
    monkeypatch.setenv("CXX", str(stub_compiler(tmp_path / "bin" / "g++", script)))
    with pytest.raises(build.BuildError) as failed:
        build.build(tmp_path / "out", sources=sources)
    text = str(failed.value)
    assert "unrecognized option -std=c++20" in text
    assert "(status 3, see above); it needs g++ 12, clang 14 or newer, and this is g++ 4.8." in text
    assert list((tmp_path / "out").iterdir()) == []


def test_an_error_in_the_sources_leaves_the_old_library(sources: Path, tmp_path: Path) -> None:
    (library,) = build.build(tmp_path / "out", names=[plainest_library()], sources=sources)
    before = library.read_bytes()
    write_unit(sources, SMALL + "int unused(int n) { }\n")
    with pytest.raises(build.BuildError, match="Werror"):
        build.build(tmp_path / "out", names=[plainest_library()], sources=sources)
    assert library.read_bytes() == before
    assert list((tmp_path / "out").iterdir()) == [library]


def test_no_compiler_gets_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(build.NoCompilerError) as failed:
        build.find_compiler({"PATH": str(tmp_path)})
    assert "install the package g++" in str(failed.value)
    assert "\n" not in str(failed.value)
    with pytest.raises(build.NoCompilerError, match="CXX names, absent, was not found"):
        build.find_compiler({"PATH": str(tmp_path), "CXX": "absent -x"})


def test_cxx_precedes_first_compiler_found(tmp_path: Path) -> None:
    for name in ("c++", "clang++"):
        stub_compiler(tmp_path / name, "exit 0")
    assert build.find_compiler({"PATH": str(tmp_path), "CXX": ""}) == ["clang++"]
    assert build.find_compiler({"PATH": str(tmp_path), "CXX": "c++ -v"}) == ["c++", "-v"]


def test_setup_fails_with_one_sentence(tmp_path: Path) -> None:
    pytest.importorskip("setuptools")
    done = subprocess.run(
        [sys.executable, "setup.py", "-q", "build_ext", "--build-lib", tmp_path / "lib", "--build-temp", tmp_path],
        cwd=ROOT, env={**os.environ, "PATH": str(tmp_path), "CXX": ""}, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 1
    assert "install the package g++" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A copy of the project as from a fresh clone, with a small engine that is built at once."""
    folder = tmp_path / "project"
    built = shutil.ignore_patterns("*.so", "__pycache__", "*.cpp", "*.hpp", build.OBJECTS)
    for name in ("cloth_sim_ros", "config", "launch", "resource", "scripts"):
        shutil.copytree(ROOT / name, folder / name, ignore=built)
    for name in ("setup.py", "setup.cfg", "package.xml"):
        shutil.copy(ROOT / name, folder)
    write_unit(folder / "cloth_sim_ros" / "engine")
    return folder


def test_in_place_build_beside_sources(project: Path, tmp_path: Path) -> None:
    pytest.importorskip("setuptools")
    subprocess.run([sys.executable, "setup.py", "-q", "build_ext", "--inplace"], cwd=project, check=True)
    names = {path.name for path in (project / "cloth_sim_ros" / "engine").glob("*.so")}
    assert names == {build.file_name(build.names_here()[0])}, "the one that this machine loads, and no other"
    subprocess.run(
        [sys.executable, "setup.py", "-q", "build", "--build-base", tmp_path / "build"], cwd=project, check=True
    )
    built = [path.name for path in (tmp_path / "build").rglob("*")]
    assert set(map(build.file_name, build.names_for())) <= set(built)
    assert not [name for name in built if name.endswith(".o")], "packages are made of this folder"


def test_source_distribution_holds_all_sources(project: Path, tmp_path: Path) -> None:
    pytest.importorskip("setuptools")
    engine = project / "cloth_sim_ros" / "engine"
    for folder in (engine, engine / "laws", engine / "laws" / "air"):
        folder.mkdir(exist_ok=True)
        (folder / "law.hpp").write_text("// a law\n")
    subprocess.run(
        [sys.executable, "setup.py", "-q", "sdist", "--dist-dir", tmp_path / "dist"], cwd=project, check=True
    )
    (archive,) = (tmp_path / "dist").glob("*.tar.gz")
    with tarfile.open(archive) as packed:
        names = {name.partition("/engine/")[2] for name in packed.getnames() if "/engine/" in name}
    assert names >= {"build.py", *(path.relative_to(engine).as_posix() for path in build.source_files(engine))}
    assert names >= {"law.hpp", "laws/law.hpp", "laws/air/law.hpp", "core/small.hpp"}
    assert not [name for name in names if name.endswith((".so", ".o"))]


def check_layout_of_ros2_run(install: Path, project: Path) -> None:
    """Check an installed package: its commands, files and index entry, and a command in colcon's environment."""
    prefix = install / "cloth_sim_ros"
    commands = sorted((prefix / "lib" / "cloth_sim_ros").iterdir())
    assert [path.name for path in commands] == json.loads((ROOT / "test/golden/package.json").read_text())["commands"]
    assert all(os.access(path, os.X_OK) for path in commands)
    share = prefix / "share" / "cloth_sim_ros"
    for folder in ("config", "launch"):
        assert {path.name for path in (share / folder).iterdir()} == {
            path.name for path in (project / folder).iterdir() if path.is_file()
        }
    assert (share / "package.xml").is_file()
    assert (prefix / "share" / "ament_index" / "resource_index" / "packages" / "cloth_sim_ros").is_file()
    command = f". {install}/local_setup.sh && {prefix}/lib/cloth_sim_ros/cloth_session --help"
    done = subprocess.run(
        ["sh", "-c", command], cwd=install.parent, env=colcon_environment(), check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "usage: cloth_session" in done.stdout


def colcon_environment() -> dict[str, str]:
    """Return the environment of a user of the installed package: this Python, and no other path of modules."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    environment.pop("PYTHONPATH", None)
    return environment


@pytest.mark.parametrize("options", [[], ["--symlink-install"]], ids=["copied", "linked"])
def test_colcon_builds_the_engine(project: Path, tmp_path: Path, options: list[str]) -> None:
    for module in ("colcon_core", "colcon_ros", "colcon_python_setup_py"):
        pytest.importorskip(module)
    install = tmp_path / "install"
    done = subprocess.run(
        [sys.executable, "-m", "colcon", "--log-base", tmp_path / "log", "build", "--base-paths", project,
         "--build-base", tmp_path / "build", "--install-base", install, *options],
        cwd=tmp_path, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    script = (
        f". {install}/local_setup.sh && python -c 'import cloth_sim_ros.engine; print(cloth_sim_ros.engine.__file__)'"
    )
    done = subprocess.run(
        ["sh", "-c", script], cwd=tmp_path, env=colcon_environment(), check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    engine = Path(done.stdout.splitlines()[-1]).parent
    assert engine.is_relative_to(tmp_path)
    for name in build.names_here()[:1] if options else build.names_for():
        assert (engine / build.file_name(name)).is_file()
    assert ctypes.CDLL(str(engine / build.file_name(build.names_here()[0]))).cloth_at(1) == 1
    if not options:
        assert engine.is_relative_to(install / "cloth_sim_ros")
        check_layout_of_ros2_run(install, project)
        # The installed sources build the same library.
        relative = [path.relative_to(engine).as_posix() for path in build.source_files(engine)]
        assert relative == [UNIT, "api/library.map", "core/small.hpp"]
        assert build.build(engine, sources=engine, on_message=pytest.fail)


def make_engine(project: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "scripts/engine.py", *arguments],
        cwd=project, env={**os.environ, **variables}, check=False, capture_output=True, text=True,
    )  # fmt: skip


def test_second_make_is_silent(project: Path, tmp_path: Path) -> None:
    first, second = make_engine(project), make_engine(project)
    assert (first.returncode, second.returncode) == (0, 0), first.stdout + first.stderr
    assert first.stdout.startswith("cloth_sim_ros: building the engine with ")
    assert second.stdout == ""
    assert make_engine(project, "--every").returncode == 0
    names = {path.name for path in (project / "cloth_sim_ros" / "engine").glob("*.so")}
    assert names == {build.file_name(name) for name in build.names_here()}
    write_unit(project / "cloth_sim_ros" / "engine", "no C++\n")
    failed = make_engine(project)
    assert failed.returncode == 1
    assert "cloth_sim_ros: the compiler could not build the engine" in failed.stdout
    assert "Traceback" not in failed.stderr


def test_sanitizers_report_write_beyond_array(project: Path) -> None:
    gcc = shutil.which("g++")
    if gcc is None:
        pytest.skip("g++ is not installed")
    at = subprocess.run([gcc, "-print-file-name=libasan.so"], check=True, capture_output=True, text=True).stdout.strip()
    if not Path(at).is_absolute():
        pytest.skip("g++ is without its sanitizers")
    with (project / "cloth_sim_ros" / "engine" / UNIT).open("a") as unit:
        unit.write("CLOTH_PUBLIC void cloth_write(double* values, int at) { values[at] = 1.0; }\n")
    (project / "test_writes.py").write_text(
        "import ctypes, os, pytest\n"
        "@pytest.mark.parametrize('at', [pytest.param(9, id='within'), pytest.param(10, id='beyond')])\n"
        "def test_write(at):\n"
        "    library = ctypes.CDLL(os.environ['CLOTH_SIM_ROS_ENGINE'])\n"
        "    assert library.cloth_at(7) == -1\n"
        "    library.cloth_write((ctypes.c_double * 10)(), at)\n"
    )
    within = make_engine(project, "--sanitize", "test_writes.py", "-k", "within", CXX="g++")
    assert within.returncode == 0, within.stdout + within.stderr
    assert within.stdout.count("1 passed") == len({*instruction_set.libraries()[:1], plainest_library()})
    beyond = make_engine(project, "--sanitize", "test_writes.py", "-k", "beyond", CXX="g++")
    assert beyond.returncode != 0
    assert "heap-buffer-overflow" in beyond.stderr
    assert not list((project / "cloth_sim_ros" / "engine").glob("*.so")), "the plain libraries stay as they are"
    if shutil.which("clang++"):
        assert "with g++, not with clang" in make_engine(project, "--sanitize", "test_writes.py", CXX="clang++").stdout
