# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorder of the engine's calls: arguments, result, and memory before and after.

`python scripts/bits_trace.py FILE --frames N SCENE ...` runs scenes of bits.py and writes the trace to FILE.
bits_replay.cpp reads it, makes the same calls with another build of the engine, and compares the results.

A file is a sequence of calls. Numbers take 8 bytes, little-endian; kinds are one letter. A call has three parts.

    length of the function's name, the name.
    kind of the result ("i" status, "n" number, "h" plan, "v" nothing), the result (0 without a result).
    number of arguments, then each argument: its kind and its value.

An argument's value, by its kind.

    "h"  a plan's handle.
    "i"  an integer.
    "d"  a double.
    "0"  a null pointer: no value.
    "b"  memory: its size in bytes, its content before the call, its content after the call.
    "a"  an array of pointers: their number, then a "b" for each.
    "f"  a binding.Frame: its size in bytes and its bytes, then for each array the field's index and a "b", then -1.

A content is stored as its index in the file. At the first occurrence of an index the bytes follow.
"""

from __future__ import annotations

import argparse
import ctypes
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import xxhash

from cloth_sim_ros.engine import binding
from cloth_sim_ros.physics.state.controller_state import LAYER_SIDES

#: Function of a call's arguments and its plan's sizes that returns the size of a memory argument, in 8-byte numbers.
Size = Callable[[Sequence[Any], dict[str, Any]], int]


def _particles(factor: int) -> Size:
    return lambda _, plan: factor * plan["n"]


def _argument_size(factor: int, at: int) -> Size:
    return lambda a, _: factor * a[at]


def _fixed(size: int) -> Size:
    return lambda _a, _p: size


def _obstacles(factor: int) -> Size:
    return lambda _, plan: factor * plan["obstacles"]


def _contacts(_: Sequence[Any], plan: dict[str, Any]) -> int:
    return (plan["obstacles"] + 1) * (plan["n"] + 1)


def _pinches(factor: int) -> Size:
    return lambda _, plan: factor * plan["pinches"]


def _anchors(plan: dict[str, Any]) -> int:
    return binding.ANCHOR_NUMBERS * (plan["obstacles"] + plan["sides"]) * plan["n"]


def _plastic(_: Sequence[Any], plan: dict[str, Any]) -> int:
    return plan["plastic"]


def _matrix(count: int, width: int) -> Size:
    return lambda a, _: 3 * a[count] * binding.library()["cloth_band_stride"](a[width])


_X = _particles(3)
_B = _particles(6)
_PATHS: Size = lambda _, plan: binding.PATH_NUMBERS * plan["grippers"]  # noqa: E731
_LISTS = list(binding.KINDS.values())
#: Numbers that all elements of a list have in common, by kind; panels and added mass have five.
_SHARED = {
    binding.KINDS[name][0]: count for name, count in (("membrane", 8), ("stiffening_membrane", 14), ("quadratic", 1))
}

#: Result kind and argument kinds of each function: h, i, d, or the size of memory.
CALLS: dict[str, tuple[str, tuple[Any, ...]]] = {
    "cloth_plan_new": ("h", ("i", _argument_size(1, 0), _argument_size(1, 0))),
    "cloth_plan_free": ("v", ("h",)),
    "cloth_plan_grid": ("i", ("h", "i", "i", _fixed(6 * len(binding.FAMILIES)))),
    "cloth_plan_list": (
        "i",
        (
            "h",
            "i",
            "i",
            lambda a, _: a[2] * _LISTS[a[1]][1],
            lambda a, _: a[2] * _LISTS[a[1]][2],
            lambda a, _: _SHARED.get(a[1], 5),
        ),
    ),
    "cloth_plan_uniform": ("i", ("h", _fixed(3), _fixed(3), "d")),
    "cloth_plan_air": ("i", ("h", _fixed(5))),
    "cloth_plan_plastic_lengths": ("i", ("h", _plastic)),
    "cloth_plan_order": ("i", ("h", _particles(1))),
    "cloth_plan_grips": (
        "i",
        (
            "h",
            "i",
            "i",
            _argument_size(1, 2),
            _argument_size(1, 2),
            _argument_size(3, 2),
            _argument_size(1, 2),
            _argument_size(1, 2),
            _argument_size(1, 2),
        ),
    ),
    "cloth_plan_gripper_paths": ("i", ("h", _PATHS)),
    "cloth_plan_contact": (
        "i",
        (
            "h",
            "i",
            _argument_size(1, 1),
            _argument_size(3, 1),
            _argument_size(1, 1),
            _argument_size(2, 1),
            _argument_size(binding.PATH_NUMBERS, 1),
            "d",
            "d",
            "d",
        ),
    ),
    "cloth_plan_contact_paths": ("i", ("h", _obstacles(binding.PATH_NUMBERS))),
    "cloth_plan_jaws": ("i", ("h", "i", _argument_size(2, 1), _argument_size(binding.DRIVE_NUMBERS, 1))),
    "cloth_plan_mesh": ("i", ("h", "i", "i", _argument_size(3, 2), "i", _argument_size(3, 4))),
    "cloth_plan_faces": ("i", ("h", "i", _argument_size(3, 1), "d")),
    "cloth_plan_features": ("i", ("h", "i", "i", _argument_size(3, 2), "i", _argument_size(2, 4), "d")),
    "cloth_features_culled": ("i", ("h", "d", "d", _X, _X, _fixed(1))),
    "cloth_predict_contact": ("i", ("h", "d", "d", "d", "d", _X, _X, _fixed(8))),
    "cloth_predict_surface_contact": ("i", ("h", "d", "d", "d", _X, _X, _fixed(3))),
    "cloth_ccd_features": ("i", ("h", "d", "d", _X, _X, _fixed(1))),
    "cloth_ccd_jaws": ("i", ("h", "d", _X, _pinches(1), _pinches(1))),
    "cloth_feature_intersection": ("i", ("h", "d", _X, _fixed(3))),
    "cloth_plan_self": ("i", ("h", "i", _argument_size(3, 1), "d")),
    "cloth_self_joints": ("i", ("h", _particles(1))),
    "cloth_self_friction": ("i", ("h", "d", "d")),
    "cloth_self_friction_power": ("i", ("h", "d", _X, _X, _fixed(1))),
    "cloth_plan_jaw_states": ("i", ("h", _pinches(binding.JAW_NUMBERS))),
    "cloth_contact_anchors": ("i", ("h", lambda _, plan: _anchors(plan))),
    "cloth_combine_anchors": (
        "i",
        (
            "h",
            "d",
            _X,
            _X,
            "i",
            _argument_size(1, 4),
            lambda a, plan: a[4] * _anchors(plan),
            lambda _, plan: _anchors(plan),
        ),
    ),
    "cloth_jaw_accelerations": ("i", ("h", "d", _X, _X, _pinches(1))),
    "cloth_contact_wrenches": ("i", ("h", "d", _X, _X, "d", _obstacles(binding.RECORD_NUMBERS))),
    "cloth_contact_gaps": ("i", ("h", "d", _X, _obstacles(2))),
    "cloth_contact_bounds": ("i", ("h", "d", _X, _B, _B)),
    "cloth_predict_obstacle_contact": ("i", ("h", "d", "d", _X, _X, _fixed(3))),
    "cloth_ccd_obstacles": ("i", ("h", "d", "d", _X, _X, _fixed(1))),
    "cloth_contact_thickness": ("i", ("h", _contacts, _contacts, "d")),
    "cloth_contact_gap_rows": ("i", ("h", "d", _X, _contacts)),
    "cloth_contact_growth_power": ("i", ("h", "d", _X, _X, _fixed(1))),
    "cloth_hinge_jerk": ("i", ("h", _X, _X, _X)),
    "cloth_kink_velocities": ("i", ("h", _X, _X, _X, _X, _plastic, _plastic, "d", "d", _X)),
    "cloth_contact_jerk_change": ("i", ("h", "d", "d", _X, _X, _X, _X, _X)),
    "cloth_friction_change": ("i", ("h", "d", "d", _X, _X, _X, lambda _, plan: _anchors(plan), _particles(6))),
    "cloth_contact_limits": ("i", ("h", "d", _fixed(2))),
    "cloth_self_cache_pairs": ("i", ("h", "i")),
    "cloth_stretch_difference": ("i", ("h", "d", _X, _X, lambda _, plan: _anchors(plan), _X)),
    "cloth_self_bounds": ("i", ("h", "d", _X, _B, _B)),
    "cloth_self_gaps": ("i", ("h", _X, _fixed(2))),
    "cloth_self_intersection": ("i", ("h", _X, _fixed(5))),
    "cloth_self_culled": ("i", ("h", "d", _X, _X, _fixed(1))),
    "cloth_ccd_self": ("i", ("h", _X, _X, _fixed(1))),
    "cloth_frame": ("i", ("h", "f")),
    "cloth_accelerations": ("i", ("h", "d", _X, _X, _X)),
    "cloth_energy": ("i", ("h", "d", _X, _X, _fixed(2))),
    "cloth_powers": ("i", ("h", "d", _X, _X, _fixed(2))),
    "cloth_grip_wrenches": (
        "i",
        ("h", "d", _X, _X, "d", lambda _, plan: binding.RECORD_NUMBERS * plan["grippers"]),
    ),
    "cloth_prescribe": ("i", ("h", "d", _X, _X, lambda _, plan: binding.RECORD_NUMBERS * plan["grippers"])),
    "cloth_velocity_displacement": ("i", ("h", "d", _X, _X, "d", _fixed(2))),
    "cloth_spectral_bounds": ("i", ("h", _X, _B, _B, "i", _fixed(5))),
    "cloth_turn_in_step": ("i", ("h", _X, _X, "i", "i", _fixed(1))),
    "cloth_bounds": ("i", ("h", _X, _B, _B)),
    "cloth_eigenvalues": ("i", (_argument_size(6, 1), "i", _argument_size(1, 1))),
    "cloth_derivative_product": ("i", ("h", "d", _X, _X, _X, _X, _X)),
    "cloth_mass_blocks": ("i", ("h", _X, _B)),
    "cloth_pair_blocks": ("i", ("h", "i", _X, "d", "d", lambda a, plan: 6 * plan["lists"][a[1]])),
    "cloth_membrane_blocks": ("i", ("h", "i", _X, "d", "d", lambda a, plan: 27 * plan["lists"][a[1]])),
    "cloth_paths": (
        "i",
        ("i", "d", "d", *(_argument_size(size, 0) for size in (7, 6, 6, 7, binding.PATH_NUMBERS, 6, 6, 1))),
    ),
    "cloth_rotation_vector": ("i", (_fixed(4), _fixed(4), _fixed(3))),
    "cloth_pose": ("i", (_fixed(binding.PATH_NUMBERS), "d", _fixed(18))),
    "cloth_hinge_lengths": (
        "i",
        ("i", "i", _argument_size(4, 1), _argument_size(3, 4), "i", _argument_size(1, 1), _argument_size(4, 1)),
    ),
    "cloth_combine_plastic_lengths": (
        "i",
        ("h", _X, "i", _argument_size(1, 2), lambda a, plan: a[2] * _plastic(a, plan), _plastic, _fixed(1)),
    ),
    "cloth_combine": ("i", ("i", "a", _argument_size(1, 0), "i", _argument_size(1, 3))),
    "cloth_distance": ("i", (_argument_size(3, 2), _argument_size(3, 2), "i", _fixed(1))),
    "cloth_weighted_dot": ("i", (_argument_size(1, 3), _argument_size(3, 3), _argument_size(3, 3), "i", _fixed(1))),
    "cloth_band_stride": ("n", ("i",)),
    "cloth_band_assemble": (
        "i",
        (
            _matrix(1, 2),
            "i",
            "i",
            _argument_size(1, 4),
            "i",
            _argument_size(2, 8),
            lambda a, _: a[7] * a[8],
            "i",
            "i",
            _argument_size(1, 10),
            "i",
        ),
    ),
    "cloth_band_assemble_diagonal": (
        "i",
        (_matrix(1, 2), "i", "i", _argument_size(1, 4), "i", _argument_size(1, 4), _argument_size(6, 4)),
    ),
    "cloth_band_factor": ("i", (_matrix(1, 2), "i", "i", "i")),
    "cloth_band_forward": ("i", (_matrix(1, 2), "i", "i", "i", _argument_size(3, 1))),
    "cloth_band_backward": ("i", (_matrix(1, 2), "i", "i", "i", _argument_size(3, 1))),
    "cloth_band_join": (
        "i",
        (_matrix(1, 4), "i", _matrix(3, 4), "i", "i", "i", "i", _matrix(8, 9), "i", "i"),
    ),
    "cloth_cuthill_mckee": ("i", ("i", _argument_size(2, 2), "i", _argument_size(1, 0))),
    "cloth_sum": ("i", (_argument_size(1, 1), "i", _fixed(1))),
}


class TracedLibrary:
    """Replaces the engine's library and records every call."""

    def __init__(self, library: ctypes.CDLL, file: BinaryIO) -> None:
        self._library, self._file = library, file
        self._functions: dict[str, Any] = {}
        self._plans: dict[int, dict[str, Any]] = {}
        self._contents: dict[bytes, int] = {}
        self._ended = False

    def end(self) -> None:
        """Stop recording: plans are freed when the process ends."""
        self._ended = True

    def __getattr__(self, name: str) -> Any:
        """Return a function of the library."""
        return self[name]

    def __getitem__(self, name: str) -> Any:
        """Return a function of the library."""
        if name not in self._functions:
            self._functions[name] = getattr(self._library, name) if name == "cloth_engine_name" else _Call(self, name)
        return self._functions[name]

    def call(self, name: str, arguments: tuple[Any, ...]) -> Any:
        """Make a call and record it.

        Raises:
            RuntimeError: for a function that is not in CALLS.
        """
        if name not in CALLS:
            raise RuntimeError(f"a trace can't hold calls of {name}; add it to CALLS, or omit the scene")
        returned, kinds = CALLS[name]
        real = getattr(self._library, name)
        if self._ended:
            return real(*arguments)
        plan = self._plans.get(arguments[0], {}) if kinds[0] == "h" else {}
        parts = [self._part(kind, value, arguments, plan) for kind, value in zip(kinds, arguments, strict=True)]
        result = real(*arguments)
        self._remember(name, arguments, plan, result)
        words = [struct.pack("<q", len(name)), name.encode(), returned.encode(), struct.pack("<q", result or 0)]
        words += [struct.pack("<q", len(parts)), *(part() for part in parts)]
        self._file.write(b"".join(words))
        return result

    def _remember(self, name: str, arguments: tuple[Any, ...], plan: dict[str, Any], result: Any) -> None:
        if name == "cloth_plan_new":
            self._plans[result] = {
                "n": arguments[0],
                "grippers": 0,
                "obstacles": 0,
                "sides": 0,
                "pinches": 0,
                "met": 0,
                "plastic": 0,
                "lists": [],
            }
        elif name == "cloth_plan_list":
            plan["lists"].append(arguments[2])
            if arguments[1] == binding.KINDS["bending_friction"][0]:
                plan["plastic"] = arguments[2]
        elif name == "cloth_plan_grips":
            plan["grippers"] = arguments[1]
        elif name == "cloth_plan_contact":
            plan["obstacles"], plan["met"] = arguments[1], binding.CONTACT_SUMMARY_NUMBERS
        elif name == "cloth_plan_self":
            plan["met"] = binding.CONTACT_SUMMARY_NUMBERS
        elif name == "cloth_self_friction":
            plan["sides"] = LAYER_SIDES
        elif name == "cloth_plan_jaws":
            plan["pinches"] = arguments[1]

    def _part(self, kind: Any, value: Any, arguments: tuple[Any, ...], plan: dict[str, Any]) -> Callable[[], bytes]:
        """Return a function that gives an argument's bytes after the call; memory is read before and after it."""
        if kind in ("h", "i"):
            return lambda: kind.encode() + struct.pack("<q", value)
        if kind == "d":
            return lambda: b"d" + struct.pack("<d", value)
        if kind == "f":
            return self._frame(value._obj, plan)
        if isinstance(value, bytes):
            value = ctypes.cast(ctypes.c_char_p(value), ctypes.c_void_p).value
        if kind == "a":
            addresses = (ctypes.c_int64 * arguments[0]).from_address(value)
            several = [self._memory(address, 8 * arguments[3]) for address in addresses]
            return lambda: b"a" + struct.pack("<q", len(several)) + b"".join(part() for part in several)
        return self._memory(value, 8 * kind(arguments, plan)) if value else lambda: b"0"

    def _memory(self, address: int, size: int) -> Callable[[], bytes]:
        before = ctypes.string_at(address, size)

        def write() -> bytes:
            contents = self._content(before) + self._content(ctypes.string_at(address, size))
            return b"b" + struct.pack("<q", size) + contents

        return write

    def _content(self, content: bytes) -> bytes:
        key = xxhash.xxh3_128_digest(content) + struct.pack("<q", len(content))
        known_index = self._contents.get(key)
        if known_index is not None:
            return struct.pack("<q", known_index)
        index = self._contents[key] = len(self._contents)
        return struct.pack("<q", index) + content

    def _frame(self, frame: binding.FrameRequest, plan: dict[str, Any]) -> Callable[[], bytes]:
        n, runs = plan["n"], frame.runs
        sizes = {
            "steps": runs,
            "weights": runs,
            "x0": 3 * n,
            "v0": 3 * n,
            "out": 6 * n * runs,
            "result": 6 * n,
            "records": runs * (binding.RECORD_NUMBERS * (plan["grippers"] + plan["obstacles"]) + 2 + plan["met"]),
            "summary": binding.SUMMARY_NUMBERS,
            "anchors": runs * _anchors(plan),
            "jaw_states": runs * binding.JAW_NUMBERS * plan["pinches"],
            "activities": 2 * runs,
            "previous_v0": 3 * n,
            "plastic_lengths": runs * plan["plastic"],
        }
        names = [name for name, *_ in binding.FrameRequest._fields_]
        raw = bytes(frame)
        addresses = {name: getattr(frame, name) for name in sizes if getattr(frame, name)}
        arrays = [(names.index(name), self._memory(address, 8 * sizes[name])) for name, address in addresses.items()]

        def write() -> bytes:
            inside = b"".join(struct.pack("<q", at) + part() for at, part in arrays)
            return b"f" + struct.pack("<q", len(raw)) + raw + inside + struct.pack("<q", -1)

        return write


class _Call:
    """A function of the library. Its types may be set as usual."""

    def __init__(self, traced: TracedLibrary, name: str) -> None:
        self._traced, self._name = traced, name
        self._real = getattr(traced._library, name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("argtypes", "restype"):
            setattr(self._real, name, value)
        else:
            object.__setattr__(self, name, value)

    def __call__(self, *arguments: Any) -> Any:
        return self._traced.call(self._name, arguments)


def main() -> None:
    """Run scenes and write their trace."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--frames", type=int, default=12, help="frames of each scene (default: 12)")
    parser.add_argument("scenes", nargs="+")
    options = parser.parse_args()
    with options.file.open("wb") as file:
        traced = TracedLibrary(binding.library(), file)
        # This precedes the import of modules that use the library by name.
        binding.library = lambda: traced  # type: ignore[assignment]
        import bits

        for scene in options.scenes:
            for _ in bits.frames_of(scene, options.frames):
                pass
        traced.end()


if __name__ == "__main__":
    main()
