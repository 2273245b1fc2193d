# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""C ABI of the engine: header, export list, libraries and ctypes declarations agree."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from fnmatch import fnmatchcase
from typing import Any

import pytest

from cloth_sim_ros.engine import band, binding, build, instruction_set

COMMENT = re.compile(r"//[^\n]*")
HEADER = COMMENT.sub("", (build.ENGINE / "api/cloth_sim.hpp").read_text())
REQUEST = COMMENT.sub("", (build.ENGINE / "plan/frame_request.hpp").read_text())
#: Types of arguments and results in ctypes. Any other pointer is an address.
TYPES = {"double": ctypes.c_double, "std::int64_t": ctypes.c_int64, "int": ctypes.c_int, "void": None}
TYPES |= {"Callback": binding.CALLBACK, "const FrameRequest*": ctypes.POINTER(binding.FrameRequest)}


def ctypes_of(declaration: str) -> Any:
    """The type of a parameter, with or without its name."""
    text = " ".join(declaration.split())
    for name, kind in TYPES.items():
        if re.fullmatch(rf"{re.escape(name)}( \w+)?", text):
            return kind
    assert "*" in text, f"{text} is in no row of TYPES"
    return ctypes.c_void_p


def functions_of(header: str) -> dict[str, tuple[Any, ...]]:
    """Result and parameters of each function in a header."""
    matches = re.findall(r"CLOTH_API ([\w: ]+?[ *]+)(cloth_\w+)\(([^)]*)\);", header)
    return {
        name: (ctypes_of(result), *map(ctypes_of, filter(None, parameters.split(","))))
        for result, name, parameters in matches
    }


def fields_of(struct: str) -> list[tuple[str, Any]]:
    """Names and types of the fields of a struct, in order."""
    body = re.search(rf"struct {struct} \{{(.*?)\n\}};", REQUEST, re.DOTALL)
    assert body
    fields = []
    for statement in filter(None, map(str.strip, body[1].split(";"))):
        names = re.findall(r"(\w+)(?=,|$)", statement)
        fields += [(name, ctypes_of(statement.partition(",")[0])) for name in names]
    return fields


def test_header_and_binding_declare_the_same_functions() -> None:
    letters = {"p": ctypes.c_void_p, "i": ctypes.c_int64}
    in_band = {
        name: (ctypes.c_int, *(letters[letter] for letter in letters_of))
        for name, letters_of in band._FUNCTIONS.items()  # private: the declarations under test
    }
    declared = functions_of(HEADER)
    assert len(declared) == HEADER.count("CLOTH_API ") - 1, "each is read"
    assert declared.pop("cloth_band_stride") == (ctypes.c_int64, ctypes.c_int64)
    assert declared == {
        # private: the declared calls
        **binding._SIGNATURES,  # private, likewise
        **in_band,
        "cloth_engine_abi": (ctypes.c_int,),
        "cloth_engine_name": (ctypes.c_void_p,),
    }


def test_frame_request_has_the_layout_of_the_header() -> None:
    assert fields_of("FrameRequest") == list(binding.FrameRequest._fields_)
    offsets = re.findall(r"offsetof\(FrameRequest, (\w+)\) == (\d+)", HEADER)
    names = [name for name, _ in binding.FrameRequest._fields_]
    assert offsets == [(name, str(getattr(binding.FrameRequest, name).offset)) for name in names]
    size = ctypes.sizeof(binding.FrameRequest)
    assert f"sizeof(FrameRequest) == {size} && alignof(FrameRequest) == 8" in HEADER
    assert binding.FRAME.size == size


def test_callback_has_the_type_of_the_header() -> None:
    result, parameters = re.findall(r"using Callback = (\w+) \(\*\)\(([^)]*)\);", REQUEST)[0]
    assert ctypes_of(result) is binding.CALLBACK._restype_
    pointer = ctypes.POINTER(ctypes.c_double)
    kinds = [pointer if kind is ctypes.c_void_p else kind for kind in map(ctypes_of, parameters.split(","))]
    assert kinds == list(binding.CALLBACK._argtypes_)
    assert re.findall(r"callback_ok = (\d+);", REQUEST) == [str(binding.CALLED_WELL)]
    assert re.findall(r"max_runs = (\d+);", REQUEST) == [str(binding.MAX_RUNS)]


def test_map_exports_names_of_the_header() -> None:
    text = (build.ENGINE / "api/library.map").read_text()
    (patterns,) = re.findall(r"global:([^:]*);\s*local:\s*\*;", text)
    exported = [pattern.strip() for pattern in patterns.split(";")]
    for name in functions_of(HEADER):
        assert any(fnmatchcase(name, pattern) for pattern in exported), name


@pytest.mark.parametrize("name", instruction_set.libraries())
def test_library_exports_names_of_the_header(name: str) -> None:
    nm, library = shutil.which("nm"), build.ENGINE / build.file_name(name)
    if nm is None or not library.exists():
        pytest.skip("nm is not installed" if nm is None else f"{library.name} is not built: run make engines")
    lines = subprocess.run([nm, "-D", library], check=True, capture_output=True, text=True).stdout.splitlines()
    exported = {line.split()[-1] for line in lines if " T " in line}
    assert exported == set(functions_of(HEADER))
