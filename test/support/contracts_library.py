# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contracts of the library: its public API, events, parameters, `State.memory`, bits and the engine's interface."""

from __future__ import annotations

import ctypes
import functools
import importlib
import inspect
import io
import runpy
import shutil
import subprocess
import typing
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest

from cloth_sim_ros.engine import NUMERICS, binding
from cloth_sim_ros.physics.control.automatic import INTEGRATORS
from cloth_sim_ros.physics.state import controller_state
from cloth_sim_ros.physics.state import memory as state_memory
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation import events
from cloth_sim_ros.simulation.simulation import Simulation

ROOT = Path(__file__).resolve().parents[2]
#: Frames of the scenes whose states are pinned; fewer if a frame takes long.
_FRAMES, _FEW_FRAMES = 8, 3
_FEWER = {"implicit": 2}


def api() -> dict[str, Any]:
    """Return the names that the package exports, with signatures, fields, methods and properties."""
    names: dict[str, Any] = {}
    for package in ("cloth_sim_ros", "cloth_sim_ros.learning", "cloth_sim_ros.batch", "cloth_sim_ros.session.cdr"):
        module = importlib.import_module(package)
        for name in module.__all__:
            names[f"{package}.{name}"] = _described(getattr(module, name))
    return names


def event_fields() -> dict[str, Any]:
    """Return the fields of each kind of event, in order, and one event of each as a dict."""
    samples: list[events.Event] = [
        events.Target("left", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)),
        events.Move("table", (1.0, 2.0, 3.0)),
        events.MoveObstacles(["table"], [[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]]),
        events.Grasp("left", True),
        events.SetParameters({"gravity": [0.0, 0.0, -1.0]}),
        events.Pause(True),
        events.Step(),
        events.Reset(["table"], [[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]]),
        events.Relax(2.0),
    ]
    assert {type(sample) for sample in samples} == set(typing.get_args(events.Event))
    contract = {}
    for sample in samples:
        kind = type(sample)
        hints = typing.get_type_hints(kind)
        fields = [f"{field.name}: {_type_name(hints[field.name])}" for field in attrs.fields(kind)]
        text = events.to_dict(sample)
        assert events.from_dict(text) == sample
        contract[kind.__name__] = {"fields": fields, "keys": list(text), "dict": text}
    return contract


def scene_parameters() -> dict[str, Any]:
    """Return every parameter of a scene.

    It has one obstacle, `table`, one camera, `wrist`, and one gripper with values of its own, `left`.
    """
    leaves = [entry.name for entry in Scene.declared() if entry.name.startswith("gripper.")]
    names = ["table.shape", "grippers", *(leaf.replace("gripper.", "left.") for leaf in leaves)]
    entries = Scene.declared_for({**dict.fromkeys(names), "cameras": ["wrist"]})
    return {
        "order": [entry.name for entry in entries],
        "parameters": {
            entry.name: {
                "type": entry.kind,
                "default": entry.default,
                "unit": entry.unit,
                "min": entry.min,
                "min is excluded": entry.excludes_min,
                "max": entry.max,
                "length": entry.length,
                "choices": list(entry.choices),
                "has a further constraint": bool(entry.constraint),
                "read-only": not entry.live,
                "has no effect on the motion": entry.observes,
            }
            for entry in entries
        },
        "sections": sorted({entry.name.rpartition(".")[0] for entry in entries}),
        "constructor": _parameters(Scene),
    }


def memory() -> dict[str, Any]:
    """Return the arrays of `State.memory`: what may be there, and what is there after some frames.

    Fields of the records of step control have no names in the array; their order shows in `values`.
    """
    records: list[type[controller_state.ControllerState]] = [
        *controller_state.STEP_CONTROL_STATES,
        controller_state.SleepState,
    ]
    contract: dict[str, Any] = {
        "records": {
            record.key: [[field.default, field.metadata["minimum"]] for field in attrs.fields(typing.cast(Any, record))]
            for record in records
        },
        "tables": {
            name: [str(kind), list(shape)]
            # private: keys of the memory are a contract
            for table in (state_memory._GRIPPERS, state_memory._OBSTACLES)
            for name, (kind, shape) in table.items()
        },
        "constants": [
            controller_state.ANCHORS_KEY,
            controller_state.JAWS_KEY,
            controller_state.JAWS_AT_REST_KEY,
            controller_state.THICKNESS_KEY,
            controller_state.PLASTIC_LENGTHS_KEY,
            *controller_state.SLEEP_KEYS,
        ],
        "of older versions": list(controller_state.LEGACY_KEYS),
        "integrators": {},
        "values": {},
        "state file": {},
    }
    contract["scenes"] = {name: _layout(state) for name, state in _states().items()}
    for name in INTEGRATORS:
        simulation = Simulation(
            Scene.from_parameters({"cloth.resolution": [5, 6], "integrator": name, "diagnostics.energy": True})
        )
        for _ in range(_FEW_FRAMES):
            simulation.advance()
        state = simulation.state
        contract["integrators"][name] = _layout(state)
        contract["values"][name] = {
            key: [float(element).hex() for element in array]
            for key, array in sorted(state.memory.items())
            if key.startswith("control.") and array.ndim == 1
        }
    with np.load(io.BytesIO(state.to_bytes())) as file:
        contract["state file"] = {key: [str(file[key].dtype), list(file[key].shape)] for key in sorted(file.files)}
    return contract


def bits() -> dict[str, Any]:
    """Return the digests of small scenes after some frames; they change with NUMERICS alone."""
    digests = {name: state.digest() for name, state in _states().items()}
    return {"numerics": NUMERICS, "frames": _FRAMES, "fewer frames": _FEWER, "digests": digests}


def engine_calls() -> dict[str, Any]:
    """Return the types of the engine's calls, of a frame's request and of a user's force."""
    plain = {None: "void", ctypes.c_void_p: "pointer", ctypes.c_int64: "int64", ctypes.c_double: "double"}

    def name(kind: Any) -> str:
        if kind in plain:
            return plain[kind]
        return {ctypes.c_int: "int", binding.CALLBACK: "callback"}.get(kind) or "pointer to frame"

    return {
        "interface": binding.ABI,
        "calls": {
            call: f"{name(result)} ({', '.join(map(name, arguments))})"
            # private: the declared calls
            for call, (result, *arguments) in binding._SIGNATURES.items()
        },
        "frame": [f"{index:02d} {name(kind)}" for index, (_, kind) in enumerate(binding.FrameRequest._fields_)],
        "frame bytes": ctypes.sizeof(binding.FrameRequest),
        "force answers": binding.CALLED_WELL,
        "shapes": binding.SHAPES,
        "families": list(binding.FAMILIES),
        "elements": {kind: list(numbers) for kind, numbers in binding.KINDS.items()},
    }


def engine_symbols() -> dict[str, Any]:
    """Return the names that the shared library exports."""
    if shutil.which("nm") is None:
        pytest.skip("nm is not installed: it lists the library's symbols")
    done = subprocess.run(
        ["nm", "-D", "--defined-only", str(binding.library()._name)], check=True, capture_output=True, text=True
    )
    symbols = sorted(line.split()[-1] for line in done.stdout.splitlines())
    return {"exported": [symbol for symbol in symbols if symbol.startswith("cloth_")]}


def _described(public_object: Any) -> dict[str, Any]:
    if not inspect.isclass(public_object):
        if callable(public_object):
            return {"function": _parameters(public_object)}
        return {"value": str(public_object)}
    described: dict[str, Any] = {"class": _parameters(public_object)}
    if attrs.has(public_object):
        described["fields"] = [field.name for field in attrs.fields(public_object)]
    foreign = {name for base in public_object.__mro__ if not _is_package_class(base) for name in vars(base)}
    members = {}
    for name in dir(public_object):
        if name.startswith("_") or name in foreign:
            continue
        member = inspect.getattr_static(public_object, name)
        if isinstance(member, property):
            members[name] = "property"
        elif isinstance(member, classmethod | staticmethod):
            members[name] = f"{type(member).__name__} {_signature(getattr(public_object, name))}"
        elif inspect.isfunction(member):
            members[name] = f"method {_signature(member)}"
        else:
            members[name] = "attribute"
    described["members"] = members
    return described


def _is_package_class(kind: type) -> bool:
    return kind.__module__.startswith("cloth_sim_ros")


def _signature(function: Any) -> str:
    """Return a signature without types."""
    signature = inspect.signature(function)
    parameters = [parameter.replace(annotation=inspect.Parameter.empty) for parameter in signature.parameters.values()]
    return str(signature.replace(parameters=parameters, return_annotation=inspect.Signature.empty))


def _parameters(public_object: Any) -> list[str]:
    """Return the parameters of a call, one text each."""
    try:
        signature = inspect.signature(public_object)
    except ValueError:
        return []
    listed = []
    for parameter in signature.parameters.values():
        plain = parameter.replace(annotation=inspect.Parameter.empty)
        default = plain.default
        if default is not inspect.Parameter.empty and not isinstance(default, bool | int | float | str | tuple | None):
            plain = plain.replace(default="...")
        listed.append(f"{plain}{' (by name alone)' if plain.kind is inspect.Parameter.KEYWORD_ONLY else ''}")
    return listed


def _type_name(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint).replace("typing.", "")


def _layout(state: State) -> dict[str, Any]:
    return {name: [str(array.dtype), list(array.shape)] for name, array in sorted(state.memory.items())}


@functools.cache
def _states() -> dict[str, State]:
    """Return the state of each of the scenes of `make bits` after some frames."""
    scenes = runpy.run_path(str(ROOT / "scripts" / "bits_scenes.py"))
    states = {}
    for name in scenes["SCENES"]:
        *_, (_, simulation) = scenes["run"](name, _FEWER.get(name, _FRAMES))
        states[name] = simulation.state
    return states
