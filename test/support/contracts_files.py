# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contracts of files: sessions, certificates, fits, studies, scripts and springs. Each is read from a written file."""

from __future__ import annotations

import ast
import contextlib
import functools
import inspect
import io
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import yaml
from mcap.reader import make_reader

from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import frame_record
from cloth_sim_ros.session.cdr import decode
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.simulation import gripper_script
from cloth_sim_ros.simulation.events import Grasp, Move, SetParameters, Target
from support.session_maker import SessionMaker

_PERIOD = 0.1
_SCENE: dict[str, Any] = {
    "rate": 1.0 / _PERIOD,
    "cloth.size": [0.2, 0.2],
    "cloth.resolution": [4, 5],
    "cloth.position": [0.0, 0.0, 0.3],
    "obstacles": ["table"],
    "table.shape": "plane",
    "points.velocity": True,
    "tf.publish": True,
}


@functools.cache
def recorded() -> Path:
    """Return a session of all kinds of messages that can be written without ROS."""
    maker = SessionMaker(Path(tempfile.mkdtemp()), Scene.from_parameters(_SCENE))
    turn = (0.0, 0.0, 0.0, 1.0)
    maker.add([Target("gripper", (0.0, 0.0, 0.3), turn), Move("table", (0.0, 0.0, -0.1), turn)])
    # Too far for one frame, so that the record holds a pose.
    maker.add([Grasp("gripper", True), Target("gripper", (9.0, 0.0, 0.3), turn)], states=True)
    maker.add([SetParameters({"air.drag": 0.3})])
    for _ in range(4):
        maker.add()
    return maker.finish()


def contents(path: Path) -> dict[str, Any]:
    """Return the names, types and keys in a session file."""
    with path.open("rb") as file:
        reader = make_reader(file)
        summary, header = reader.get_summary(), reader.get_header()
        assert summary is not None
        contract: dict[str, Any] = {
            "profile": header.profile,
            "library": header.library,
            "metadata": {record.name: sorted(record.metadata) for record in reader.iter_metadata()},
            "attachments": {record.name: record.media_type for record in reader.iter_attachments()},
            "channels": {
                channel.topic: {
                    "type": summary.schemas[channel.schema_id].name,
                    "schema encoding": summary.schemas[channel.schema_id].encoding,
                    "message encoding": channel.message_encoding,
                    "metadata": channel.metadata,
                }
                for channel in summary.channels.values()
            },
        }
        frames: dict[str, Any] = {"keys": [], "extras": {}, "events": {}}
        values: dict[str, list[str]] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.topic.endswith("/frame") and schema.name == "std_msgs/msg/String":
                record = json.loads(decode(message.data, schema.name).data)
                frames["keys"] = max(frames["keys"], list(record), key=len)
                frames["extras"] |= {key: type(value).__name__ for key, value in record.get("extras", {}).items()}
                frames["events"] |= {event["kind"]: list(event) for event in record["events"]}
            elif schema.name.startswith("diagnostic_msgs/msg/"):
                content = decode(message.data, schema.name)
                for status in getattr(content, "status", [content]):
                    known = values.setdefault(channel.topic, [])
                    known += [pair.key for pair in status.values if pair.key not in known]
    return contract | {
        "frame records": frames,
        "keys of statuses": {name: sorted(keys) for name, keys in values.items()},
    }


def session_file() -> dict[str, Any]:
    """Return the contents of a session, the frame record, and the session's exports."""
    from cloth_sim_ros.simulation.simulation import Simulation
    from cloth_sim_ros.studies.run_recording import RunRecording

    folder = Path(tempfile.mkdtemp())
    # So little work misses the tolerance, which a frame's record tells.
    simulation = Simulation(Scene.from_parameters({**_SCENE, "tolerance": 1e-9, "work_limit": 1e-4}))
    recording = RunRecording(folder, simulation, name="run", clouds=True)
    recording.add([], attrs.evolve(simulation.advance(), stopped=("table",)))
    session, table = folder / "session.npz", folder / "session.parquet"
    _run("session.main", ["export", str(recorded()), "-o", str(session)])
    _run("session.main", ["export", str(recorded()), "-o", str(table)])
    import pyarrow.parquet as pq

    with np.load(session) as file:
        arrays = {name: [str(file[name].dtype), file[name].ndim] for name in file.files}
    record = FrameRecord(frame=1, time=0.1, integrator="x", tolerance=None, steps=2, digest="", paused=False)
    return {
        "of a simulation": contents(recorded()),
        "of a study's run": contents(recording.finish(reason="stopped")),
        "frame record": {
            "fields": [name for name in inspect.signature(FrameRecord).parameters],
            "text": record.to_json(),
            # private: the messages are a contract
            "extras that are read": sorted(frame_record._EXTRA_CHECKS),
        },
        "scene.yaml": sorted(yaml.safe_load(parameter_file.dump(simulation.scene.parameters()))),
        "export .npz": arrays,
        "export .parquet": {field.name: str(field.type) for field in pq.read_schema(table)},
    }


def session_info() -> dict[str, Any]:
    """Return the keys of `cloth_session info --json`."""
    return {"keys": shape(json.loads(_run("session.main", ["info", "--json", str(recorded())])))}


def certificate() -> dict[str, Any]:
    """Return the keys of `cloth_verify --accuracy --json`, and the status of the command without `--accuracy`."""
    from cloth_sim_ros.verify import main as verify_main

    folder = Path(tempfile.mkdtemp())
    maker, target = SessionMaker(folder, Scene.from_parameters({**_SCENE, "rate": 100.0})), folder / "certificate.json"
    for _ in range(3):
        maker.add()
    session = str(maker.finish())
    _run("verify.main", [session, "--accuracy", "--json", str(target)], status=None)
    try:
        status: Any = _run("verify.main", [session, "--json", str(target)], status=None)
    except SystemExit as error:
        status = error.code
    return {
        "keys": shape(json.loads(target.read_text())),
        "status of --json without --accuracy": status,
        "statuses": [
            verify_main.SAME,
            verify_main.DIFFERENT,
            verify_main.UNREADABLE,
            verify_main.OTHER_ARITHMETIC,
            verify_main.BOUND_VIOLATED,
        ],
    }


def fit() -> dict[str, Any]:
    """Return the keys of `cloth_fit --json`, and the names of parameters that it takes."""
    from cloth_sim_ros.fit import parameters as fit_parameters
    from support.fit_samples import random_truth, record_swing

    folder = Path(tempfile.mkdtemp())
    path = record_swing(folder, random_truth(3), seconds=0.2, resolution=3, missing=0.0)
    target = folder / "fit.json"
    arguments = [str(path), "--parameters", "stretch,density", "--workers", "1", "--json", str(target)]
    _run("batch.fit_main", arguments, status=None)
    return {
        "keys": shape(json.loads(target.read_text())),
        # private: names in files are a contract
        "short names": fit_parameters._SHORT | {"bending": "by bending.model"},
        "further names": list(fit_parameters._OTHER_NAMES),
    }


def study() -> dict[str, Any]:
    """Return what a study file may have, and what a study's folder and its exports hold."""
    from cloth_sim_ros.studies import factors, index, outcomes, study_file
    from cloth_sim_ros.studies.folder import StudyFolder
    from cloth_sim_ros.studies.sampling import SAMPLINGS
    from cloth_sim_ros.studies.study_estimate import sample_and_estimate
    from cloth_sim_ros.studies.study_run import perform

    folder = Path(tempfile.mkdtemp())
    content = {
        "scene": "cloth_sim.yaml",
        "parameters": {"cloth.resolution": [3, 3], "tolerance": 1e-2, "rate": 20.0},
        "scripts": "grasp.yaml",
        "duration": 0.2,
        "runs": 1,
        "vary": {"material.density": {"uniform": [0.1, 0.3]}},
    }
    (folder / "study.yaml").write_text(json.dumps(content))
    whole = study_file.read(folder / "study.yaml")
    study_folder, samples = StudyFolder(folder / "out"), sample_and_estimate(whole, 1)[0]
    study_folder.create(whole, samples, "")
    rows = [perform(study_folder, whole, run, values) for run, values in enumerate(samples)]
    index.write(study_folder, rows)
    study_keys = json.loads(study_folder.study_file.read_text())
    study_keys["parameters"] = {}
    row = json.loads(study_folder.row_file(0).read_text())
    return {
        "entries": list(study_file.ENTRIES),
        "distributions": list(factors.KINDS),
        "samplings": list(SAMPLINGS),
        "outcomes": list(outcomes.BUILT_IN),
        "files": sorted(
            str(path.relative_to(study_folder.path)) for path in study_folder.path.rglob("*") if path.is_file()
        ),
        "study.json": shape(study_keys),
        "row": shape(row),
        "index": {field.name: str(field.type) for field in index.read(study_folder).schema},
        "exports": _exports(study_folder.path),
    }


def scripts() -> dict[str, Any]:
    """Return the entries of gripper scripts, and the tables of springs files and of rest angles."""
    from cloth_sim_ros.physics.model.sheets import raw, rest_angles
    from cloth_sim_ros.scene import springs_file

    step = {"time": 0.0, "position": [0.0, 0.0, 0.0]}
    tables = {"positions": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], "masses": 1.0, "springs": [[0, 1]], "stiffness": 1.0}

    def script(entries: dict[str, Any]) -> None:
        gripper_script.GripperScript.from_dict({"steps": [step], **entries})

    def one_step(entries: dict[str, Any]) -> None:
        gripper_script.GripperScript.from_dict({"steps": [step | entries]})

    def springs(entries: dict[str, Any]) -> None:
        springs_file.parse(yaml.safe_dump(tables | entries).encode())

    def angles(entries: dict[str, Any]) -> None:
        tables = {"edges": [[0, 1]], "angles": 0.0}
        springs_file.parse_rest_angles(yaml.safe_dump(tables | entries).encode())

    return {
        "gripper script": _accepted(script, gripper_script),
        "gripper script: step": _accepted(one_step, gripper_script),
        "springs file": _accepted(springs, raw),
        "file of rest angles": _accepted(angles, rest_angles),
        "springs file: required": [name for name in tables if _is_refused(springs_file.parse, _without(tables, name))],
    }


def shape(tree: Any) -> Any:
    """Return the keys of a tree of JSON; the items of a list as one."""
    if isinstance(tree, dict):
        return {key: shape(value) for key, value in tree.items()}
    if isinstance(tree, list):
        items = [shape(item) for item in tree]
        if items and all(isinstance(item, dict) for item in items):
            return [functools.reduce(lambda one, other: one | other, items)]
        return "list"
    return "value"


def _exports(folder: Path) -> dict[str, Any]:
    import zarr

    _run("batch.main", ["export", str(folder), "--zarr", str(folder / "z.zarr")])
    _run("batch.main", ["export", str(folder), "--lerobot", str(folder / "lerobot")])
    group: Any = zarr.open_group(str(folder / "z.zarr"), mode="r")
    info = json.loads((folder / "lerobot" / "meta" / "info.json").read_text())
    return {
        "zarr arrays": {
            name: [str(array.dtype), list(array.metadata.dimension_names or []), dict(array.attrs)]
            for name, array in sorted(group.arrays())
        },
        "zarr attributes": sorted(group.attrs),
        "lerobot": shape(info),
        "lerobot files": sorted(
            str(path.relative_to(folder / "lerobot")) for path in (folder / "lerobot").rglob("*") if path.is_file()
        ),
    }


def _run(module: str, arguments: list[str], *, status: int | None = 0) -> Any:
    """Run a command in this process; return its output, or its exit status if none is expected."""
    import importlib

    main = importlib.import_module(f"cloth_sim_ros.{module}").main
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(io.StringIO()):
        result = main(arguments)
    if status is None:
        return result
    assert result == status, output.getvalue()
    return output.getvalue()


def _accepted(read: Callable[[dict[str, Any]], object], module: Any) -> list[str]:
    """Return the entries that a reader knows, of all words in the source of its module."""
    unknown = "no_such_entry"
    refusal = _message(read, {unknown: 0})
    assert unknown in refusal
    known = set()
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        word = node.value if isinstance(node, ast.Constant) else None
        if not isinstance(word, str) or not word.isidentifier():
            continue
        if _message(read, {word: 0}) != refusal.replace(unknown, word, 1):
            known.add(word)
    return sorted(known)


def _message(read: Callable[[dict[str, Any]], object], entries: dict[str, Any]) -> str:
    try:
        read(entries)
    except ValueError as error:
        return str(error)
    return ""


def _is_refused(parse: Callable[[bytes], object], tables: dict[str, Any]) -> bool:
    try:
        parse(yaml.safe_dump(tables).encode())
    except ValueError:
        return True
    return False


def _without(tables: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in tables.items() if key != name}
