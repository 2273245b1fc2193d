# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands on damaged input files of every kind: none may end with a traceback.

python test/soak_files.py --count 500

Exit status 1 if a command raised an exception, or took longer than a minute or more than a gigabyte.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import io
import json
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).parent))

if TYPE_CHECKING:
    from support.bag_maker import BagMessage

#: Time limit of a command [s].
LIMIT = 60
SCENE = """\
/**:
  ros__parameters:
    cloth.resolution: [4, 4]
    cloth.size: [0.4, 0.4]
    tolerance: 0.001
    obstacles: ["table"]
    table.shape: box
    table.size: [1.0, 1.0, 0.1]
    table.position: [0.0, 0.0, -0.5]
    grippers: ["left", "right"]
"""
SCRIPT = """\
gripper: left
rate: 30.0
steps:
  - {time: 0.0, position: [0.0, 0.0, 0.3]}
  - {time: 0.1, close: true}
  - {time: 0.2, position: [0.1, 0.0, 0.3], orientation: [0.0, 0.0, 0.0, 1.0]}
"""
STUDY = """\
scene: scene.yaml
scripts: [script.yaml]
duration: 0.2
runs: 2
seed: 3
sampling: sobol
vary:
  material.density: {uniform: [0.1, 0.3]}
  air.drag: [0.1, 0.2]
"""
SPRINGS = """\
positions: [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
masses: [1.0, 1.0, 1.0]
springs: [[0, 1], [1, 2], [2, 0]]
stiffness: [10.0, 10.0, 10.0]
"""
OBJ = "v 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nv 0 0.1 0\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1 4/1/1\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n0.1 0 0\n0.1 0.1 0\n0 0.1 0\n3 0 1 2\n3 0 2 3\n"
)
STL = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 0.1 0 0\nvertex 0.1 0.1 0\nendloop\nendfacet\n"
    "endsolid a\n"
)
#: Replacements of numbers and words in a text, and of bytes.
WORDS = (
    *("-1", "0", "1e999", ".nan", "9" * 5000, str(2**63), str(-(2**63)), str(2**64), "null", "[]", "{}", "true", "''"),
    *("[1, [2]]", "{a: 1}", "*a", "&a 1", "!!int x", "!!binary x", "!!timestamp x", "\x00", "\x85", '"\\ud800"'),
    *("x" * 2000, "é", "-", ":", "#", "|", "../../x", "/dev/zero", "nowhere", "{" * 3000, "[" * 3000, "%", "\t"),
)
JSON_WORDS = ("-1", "1e999", "NaN", "9" * 5000, str(2**63), str(2**64), "null", "[]", "{}", "5", '"\\ud800"', "true")
DEEP = ("[" * 100_000 + "]" * 100_000, '{"a":' * 5000 + "1" + "}" * 5000)
NUMBERS = (0, 1, 0x7F, 0xFF, 0xFFFF, 0xFFFFFFFF, 2**63, 2**63 - 1, 2**64 - 1)


def damaged_bytes(data: bytes, rng: random.Random) -> bytes:
    """Return damaged bytes: cut off, torn, repeated, or with other numbers."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.randrange(len(out)) if out else 0
        kind = rng.randrange(7)
        if kind == 0:
            del out[at:]
        elif kind == 1:
            del out[at : at + rng.choice((1, 4, 100))]
        elif kind == 2:
            out[at:at] = out[: rng.choice((1, 9, 200))]
        elif kind == 3:
            size = rng.choice((1, 2, 4, 8))
            integer = rng.choice(NUMBERS) % (1 << 8 * size)
            out[at : at + size] = integer.to_bytes(size, rng.choice(("little", "big")))
        elif kind == 4 and out:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 5:
            out[at : at + 16] = rng.randbytes(16)
        else:
            out += rng.randbytes(rng.choice((1, 20, 1000)))
    return bytes(out)


def damaged_text(text: str, rng: random.Random, words: Sequence[str] = WORDS) -> bytes:
    """Return a damaged text: other words, lost or repeated lines, sometimes damaged bytes."""
    if rng.random() < 0.2:
        return damaged_bytes(text.encode(), rng)
    for _ in range(rng.choice((1, 1, 2, 3))):
        lines = text.splitlines(keepends=True)
        at = rng.randrange(len(lines)) if lines else 0
        kind = rng.randrange(5)
        if not lines or kind == 0:
            text = "".join([*lines[:at], *lines[at : at + 1] * 2, *lines[at + 1 :]])
        elif kind == 1:
            text = "".join([*lines[:at], *lines[at + 1 :]])
        else:
            parts = lines[at].replace(",", " , ").replace("]", " ] ").split(" ")
            parts[rng.randrange(len(parts))] = rng.choice(words)
            lines[at] = " ".join(parts)
            text = "".join(lines)
    return text.encode(errors="surrogatepass")


def damaged_json(text: str, rng: random.Random) -> str:
    """Return JSON with one changed entry, or with a missing or additional key."""
    if rng.random() < 0.1:
        return text[: rng.randrange(len(text))]
    content = json.loads(text)
    places: list[tuple[Any, Any]] = []
    waiting = [content]
    while waiting:
        node = waiting.pop()
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                waiting.append(node[key])
    node, key = rng.choice(places)
    if rng.random() < 0.15:
        del node[key]
        return json.dumps(content)
    node[key] = "REPLACED"
    return json.dumps(content).replace('"REPLACED"', rng.choice((*JSON_WORDS, *JSON_WORDS, *DEEP)))


class Samples:
    """Intact files, and methods that write damaged copies into another folder."""

    def __init__(self, folder: Path) -> None:
        from support.session_maker import make_grasp

        self.folder = folder
        folder.mkdir()
        self.session = make_grasp(folder, seconds=0.4, cloth__resolution=[5, 5])
        self.bag = self._bag()
        self.state = self._state()
        for name, text in self.texts().items():
            (folder / name).write_text(text)
        (folder / "state.npz").write_bytes(self.state)
        self.study = folder / "study"
        if importlib.util.find_spec("distributed") is not None:
            self._perform()

    @staticmethod
    def _bag() -> list[BagMessage]:
        """Return the messages of a bag with two snapshots."""
        from support.bag_maker import MessageMaker

        from cloth_sim_ros.scene.scene import Scene

        maker = MessageMaker(Scene.from_parameters({"cloth.resolution": [5, 5]}))
        frames = [[maker.snapshot(), *maker.frame()] if k in (0, 5) else maker.frame() for k in range(10)]
        return [maker.topology(), *(message for messages in frames for message in messages)]

    def _state(self) -> bytes:
        from cloth_sim_ros.session.reader import SessionReader

        with SessionReader(self.session) as reader:
            return reader.state

    @staticmethod
    def texts() -> dict[str, str]:
        """Return the text files by name."""
        return {
            "scene.yaml": SCENE, "script.yaml": SCRIPT, "study.yaml": STUDY, "springs.yaml": SPRINGS,
            "cloth.obj": OBJ, "cloth.ply": PLY, "cloth.stl": STL,
        }  # fmt: skip

    def _perform(self) -> None:
        """Run a study in this process."""
        from cloth_sim_ros.studies import index, study_file
        from cloth_sim_ros.studies.folder import StudyFolder
        from cloth_sim_ros.studies.study_estimate import sample_and_estimate
        from cloth_sim_ros.studies.study_run import perform

        study = study_file.read(self.folder / "study.yaml")
        study_folder = StudyFolder(self.study)
        samples, _ = sample_and_estimate(study, 1)
        study_folder.create(study, samples, STUDY)
        for run, values in enumerate(samples):
            perform(study_folder, study, run, values)
        index.write(study_folder, study_folder.rows())


def frames_damaged(session: Path, target: Path, rng: random.Random) -> None:
    """Write a copy of a session with one damaged frame record or other message, and correct checksums."""
    from cloth_sim_ros.session.cdr import decode_string, encode_string
    from cloth_sim_ros.session.reader import SessionReader
    from cloth_sim_ros.session.writer import SessionSnapshot, SessionWriter, WriterOptions

    with SessionReader(session) as reader:
        scene, state = reader.scene_yaml, reader.state
        kind = rng.randrange(5)
        if kind == 0:
            scene = damaged_text(scene, rng).decode(errors="replace")
        elif kind == 1:
            state = damaged_bytes(state, rng)
        shot = SessionSnapshot(scene_yaml=scene, state=state, metadata={**reader.metadata}, files=dict(reader.files))
        messages = list(reader.messages())
    frames = [k for k, message in enumerate(messages) if message.topic.endswith("/frame")]
    at = rng.choice(frames) if kind < 4 else rng.randrange(len(messages))
    writer = SessionWriter(target.parent, snapshot=shot, stem=target.stem, log_time=0, options=WriterOptions())
    for k, message in enumerate(messages):
        data = bytes(message.data)
        if k == at and kind in (2, 3):
            data = encode_string(damaged_json(decode_string(data), rng))
        elif k == at and kind == 4:
            data = damaged_bytes(data, rng)
        if not writer.is_declared(message.topic):
            writer.declare(message.topic, message.type_name)
        writer.add(
            message.topic, data, log_time=message.log_time, publish_time=message.publish_time, sequence=message.sequence
        )
    writer.finish(reason="stopped", notes={"dropped": "0"})
    if writer.path != target:
        shutil.move(writer.path, target)


class TooLong(BaseException):
    """A command exceeded the time limit."""


def _too_long(_signal_number: int, _frame: FrameType | None) -> None:
    raise TooLong


def run(command: str, arguments: Sequence[str]) -> str:
    """Run a command in this process; return its failure, empty after a normal end."""
    module = {
        "cloth_session": "session.main", "cloth_verify": "verify.main", "cloth_replay": "replay.main",
        "cloth_batch": "batch.main", "cloth_fit": "batch.fit_main", "cloth_sim": "ros.main",
        "script": "simulation.gripper_script",
    }[command]  # fmt: skip
    said = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    trouble = ""
    signal.alarm(LIMIT)
    try:
        loaded = importlib.import_module(f"cloth_sim_ros.{module}")
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            if command == "script":
                with contextlib.suppress(loaded.ScriptError):
                    loaded.GripperScript.from_file(arguments[0])
            else:
                loaded.main(list(arguments))
            said.flush()
    except SystemExit:
        pass
    except TooLong:
        trouble = f"took longer than {LIMIT} s"
    except BaseException:
        trouble = traceback.format_exc()
    finally:
        signal.alarm(0)
    with contextlib.suppress(ValueError, AttributeError):
        if "Traceback (most recent call last)" in said.buffer.getvalue().decode(errors="replace"):  # type: ignore[attr-defined]
            trouble = trouble or said.buffer.getvalue().decode(errors="replace")  # type: ignore[attr-defined]
    return trouble


def cases(samples: Samples, folder: Path, rng: random.Random) -> Iterator[tuple[str, list[tuple[str, list[str]]]]]:
    """Yield damaged files endlessly: description, and the commands that read the file."""
    texts = samples.texts()
    session = samples.session.read_bytes()

    def write(name: str, data: bytes) -> str:
        (folder / name).write_bytes(data)
        return str(folder / name)

    def scene_with(parameter: str, value: str) -> list[tuple[str, list[str]]]:
        text = SCENE.replace("    cloth.resolution: [4, 4]\n    cloth.size: [0.4, 0.4]\n", "")
        return [("cloth_sim", ["--check", write("with.yaml", f"{text}    {parameter}: {folder / value}\n".encode())])]

    def readers(path: str) -> list[tuple[str, list[str]]]:
        commands = [
            ("cloth_session", ["info", path]),
            ("cloth_session", ["info", "--json", path]),
            ("cloth_verify", [path]),
            ("cloth_session", ["recover", path, "-o", str(folder / "mended.mcap")]),
            ("cloth_session", ["export", path, "-o", str(folder / "out.npz")]),
            ("cloth_replay", [path, "--save", str(folder / "out.rrd")]),
            ("cloth_fit", [path, "--parameters", "stretch", "--until", "0.1", "--workers", "1"]),
            (
                "cloth_sim",
                ["--check", write("at.yaml", f"/**: {{ros__parameters: {{initial_state: {path}@5}}}}".encode())],
            ),
        ]
        return [commands[0], commands[2], *rng.sample([commands[1], *commands[3:]], 2)]

    while True:
        yield "session", readers(write("session.mcap", damaged_bytes(session, rng)))
        frames_damaged(samples.session, folder / "written.mcap", rng)
        yield "frames", readers(str(folder / "written.mcap"))
        yield (
            "bag",
            [
                (
                    "cloth_fit",
                    [
                        write("bag.mcap", damaged_bytes(session.replace(b"cloth_sim_end", b"other_bag_end"), rng)),
                        *("--parameters", "stretch", "--workers", "1", "--scene", str(samples.folder / "scene.yaml")),
                    ],
                )
            ],
        )
        yield "bag of frames", _bag_damaged(samples, folder / "frames.mcap", rng)
        write("state.npz", damaged_bytes(samples.state, rng))
        yield "state", scene_with("initial_state", "state.npz")
        yield "scene", [("cloth_sim", ["--check", write("scene.yaml", damaged_text(texts["scene.yaml"], rng))])]
        yield "script", [("script", [write("script.yaml", damaged_text(texts["script.yaml"], rng))])]
        for kind in ("obj", "ply", "stl"):
            write(f"cloth.{kind}", damaged_text(texts[f"cloth.{kind}"], rng))
            yield kind, scene_with("cloth.mesh", f"cloth.{kind}")
        write("springs.yaml", damaged_text(texts["springs.yaml"], rng))
        yield "springs", scene_with("cloth.springs", "springs.yaml")
        if samples.study.exists():
            (folder / "scene.yaml").write_text(SCENE)
            (folder / "script.yaml").write_text(SCRIPT)
            write("study.yaml", damaged_text(texts["study.yaml"], rng))
            yield "study", [("cloth_batch", ["check", str(folder / "study.yaml")])]
            yield "study folder", _study_folder(samples, folder, rng)


def _bag_damaged(samples: Samples, path: Path, rng: random.Random) -> list[tuple[str, list[str]]]:
    """Write a bag with one damaged message or damaged bytes."""
    from support.bag_maker import write_bag

    messages = list(samples.bag)
    if rng.random() < 0.7:
        position = rng.randrange(len(messages))
        messages[position] = messages[position]._replace(data=damaged_bytes(messages[position].data, rng))
        write_bag(path, messages)
    else:
        path.write_bytes(damaged_bytes(write_bag(path, messages).read_bytes(), rng))
    return [("cloth_verify", [str(path)])]


def _study_folder(samples: Samples, folder: Path, rng: random.Random) -> list[tuple[str, list[str]]]:
    study_folder = folder / "study"
    shutil.rmtree(study_folder, ignore_errors=True)
    shutil.copytree(samples.study, study_folder)
    (folder / "study.yaml").write_text(STUDY)
    files = sorted(path for path in study_folder.rglob("*") if path.is_file() and path.name != ".lock")
    path = rng.choice(files)
    if path.suffix == ".json" and rng.random() < 0.7:
        path.write_text(damaged_json(path.read_text(), rng))
    else:
        path.write_bytes(damaged_bytes(path.read_bytes(), rng))
    if path.suffix == ".json" and "rows" in path.parts:
        (study_folder / "index.parquet").unlink()
    commands = [
        ("cloth_batch", ["view", str(study_folder)]),
        ("cloth_batch", ["view", str(study_folder), "--outcome", "mean_height"]),
        ("cloth_batch", ["view", str(study_folder), "--run", "0", "--save", str(folder / "run.rrd")]),
        ("cloth_batch", ["export", str(study_folder), "--zarr", str(folder / "out.zarr")]),
        ("cloth_batch", ["export", str(study_folder), "--mcap", str(folder / "out_mcap")]),
        ("cloth_batch", [str(folder / "study.yaml"), "--out", str(study_folder)]),
    ]
    return [commands[0], *rng.sample(commands[1:], 2)]


def soak(count: int, seed: int, report: Callable[[str], None]) -> list[str]:
    """Damage `count` files; return the failures of commands with the description of the damage."""
    rng = random.Random(seed)
    troubles: list[str] = []
    kinds: Counter[str] = Counter()
    signal.signal(signal.SIGALRM, _too_long)
    with tempfile.TemporaryDirectory(prefix="soak_files_") as name:
        samples = Samples(Path(name) / "whole")
        folder = Path(name) / "damaged"
        for kind, commands in cases(samples, folder := _created_folder(folder), rng):
            kinds[kind] += 1
            for command, arguments in commands:
                trouble = run(command, arguments)
                if trouble:
                    troubles.append(f"{kind} {kinds[kind]}: {command} {' '.join(arguments)}\n{trouble}")
                    report(troubles[-1])
                for left in ("out.npz", "mended.mcap", "out.rrd", "run.rrd", "out.zarr", "out_mcap"):
                    _remove(folder / left)
            _remove(folder / "written.mcap")
            if sum(kinds.values()) >= count:
                break
    report(f"{sum(kinds.values())} files: {', '.join(f'{kind} {n}' for kind, n in kinds.items())}")
    return troubles


def _created_folder(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def main() -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500, help="number of files (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 100_000, help="random seed of the damage; printed")
    options = parser.parse_args()
    print(f"seed {options.seed}")
    troubles = soak(options.count, options.seed, lambda text: print(text, flush=True))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"{len(troubles)} troubles; peak of the memory {memory:.0f} MB")
    return 1 if troubles or memory > 1000.0 else 0


if __name__ == "__main__":
    sys.exit(main())
