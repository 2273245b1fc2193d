# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_fit`: parameters of a cloth from recorded clouds of it."""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloth_sim_ros.session.console import escape_unencodable, printable

if TYPE_CHECKING:
    from collections.abc import Callable

    from cloth_sim_ros.fit.fit import Fit
    from cloth_sim_ros.fit.motions_result import MotionFit
    from cloth_sim_ros.fit.recording import FitRecording
    from cloth_sim_ros.scene.scene import Scene

#: Exit status: every parameter is identified.
IDENTIFIED = 0
#: Exit status: a parameter is not identified, or the simulated cloth does not follow the recording.
NOT_IDENTIFIED = 1
#: Exit status: the fit is impossible.
REFUSED = 2

_DESCRIPTION = (
    "Fit parameters of a cloth by least squares between recorded clouds and simulations of the same motion. Exit "
    "status 0: every parameter is identified; 1: the clouds do not identify one of them, or the simulated cloth does "
    "not follow the recording; 2: the fit is impossible."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cloth_fit`: fit, report, write files; return 0 if all parameters are identified, 1 if not, 2 or 130."""
    escape_unencodable()
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.plot is not None and importlib.util.find_spec("matplotlib") is None:
        parser.error("--plot needs matplotlib: pip install 'cloth_sim_ros[batch]'")
    from cloth_sim_ros.fit.parameters import FitError
    from cloth_sim_ros.scene.parameters.declare import ParameterError
    from cloth_sim_ros.session.errors import SessionError
    from cloth_sim_ros.session.output_files import check_outputs

    outputs = {"--write": options.write, "--json": options.json, "--plot": options.plot}
    try:
        check_outputs(outputs, _input_files(options), endings={"--plot": ".png"})
        fit = _fit(options)
        _report(fit, options)
    except (SessionError, FitError, ParameterError) as error:
        print(f"cloth_fit: {printable(str(error))}", file=sys.stderr)
        return REFUSED
    except OSError as error:
        print(f"cloth_fit: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        print("cloth_fit: interrupted", file=sys.stderr)
        return 130
    return IDENTIFIED if fit.all_identified else NOT_IDENTIFIED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cloth_fit", description=_DESCRIPTION)
    files = (
        "session.mcap, with the files of one session in order; or bags or tables (CSV, npz) of a real cloth, a motion "
        "each. Several sessions or motions are fitted at once"
    )
    parser.add_argument("session", nargs="+", type=Path, help=files)
    names = (
        "stretch, stretch_weft, shear, bending, bending_weft, bending_friction, poisson, damping, viscosity, density, "
        "drag, normal_drag, tangential_drag, added_mass, friction, or full names such as material.stretch_modulus or "
        "table.friction"
    )
    parser.add_argument("--parameters", required=True, metavar="NAME,NAME", help=names)
    parser.add_argument("--scene", type=Path, metavar="scene.yaml", help="the cloth; replaces the scene of a session")
    start = "starting value (default: the scene's)"
    parser.add_argument("--start", action="append", default=[], metavar="NAME=VALUE", help=start)
    sigma = "deviation of a measured coordinate [m] (default: of the residuals)"
    parser.add_argument("--sigma", type=float, metavar="M", help=sigma)
    within = "largest relative standard deviation of an identified parameter (default 0.025)"
    parser.add_argument("--within", type=float, default=0.025, metavar="PART", help=within)
    parser.add_argument("--until", type=float, metavar="S", help="use clouds up to this time from the beginning [s]")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="use every N-th cloud")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    _add_motion_options(parser)
    _add_bag_options(parser)
    output = parser.add_argument_group("output files besides the table")
    output.add_argument("--write", type=Path, metavar="OUT.yaml", help="scene with the identified parameters")
    output.add_argument("--json", type=Path, metavar="OUT.json", help="all numbers")
    output.add_argument("--plot", type=Path, metavar="OUT.png", help="residuals over time; needs matplotlib")
    return parser


def _input_files(options: argparse.Namespace) -> list[Path]:
    """Return the files that the command reads: recordings, files of a bag's folder, scene and its files, poses."""
    from cloth_sim_ros.fit.tables import is_table
    from cloth_sim_ros.scene.named_files import named_files
    from cloth_sim_ros.session.bag import bag_files

    inputs = list(options.session)
    if options.scene is not None:
        inputs += [options.scene, *named_files(options.scene)]
    for path in options.session:
        if path.is_dir():
            inputs += [*bag_files(path), path / "metadata.yaml"]
    for source in _pairs(options.pose, "--pose").values():
        inputs += [file for file in (Path(_expand(source, path)) for path in options.session) if is_table(file)]
    return inputs


def _expand(source: str, path: Path) -> str:
    """Return the poses' source of a recording: `{}` stands for its path without the ending."""
    return source.replace("{}", str(path.with_suffix("")))


def _add_motion_options(parser: argparse.ArgumentParser) -> None:
    motions = parser.add_argument_group("a real cloth, or several recordings at once")
    kinds = ("no", "shared", "each")
    settings: dict[str, Any] = {"nargs": "?", "const": "shared", "choices": kinds, "metavar": "KIND"}
    offset = (
        "offset between the clocks of clouds and gripper poses: no, shared by all recordings, or for each (default: "
        "shared for a real cloth, no for sessions)"
    )
    motions.add_argument("--fit-time-offset", **settings, help=offset)
    pose = (
        "error of the camera's pose, a small rotation and a shift: no (a shift alone), shared or each (default: same)"
    )
    motions.add_argument("--fit-camera-pose", **settings, help=pose)
    loss = "loss of a point: square, huber (default) or cauchy; its scale is 2.5 standard deviations"
    motions.add_argument("--loss", choices=("square", "huber", "cauchy"), help=loss)
    held_out = "fit nothing on N of the recordings, spread over the list, and report the errors on them (default 0)"
    motions.add_argument("--held-out", type=int, metavar="N", help=held_out)
    parts = "the MCAPs of a real cloth are parts of one recording"
    motions.add_argument("--parts", action="store_true", help=parts)


def _add_bag_options(parser: argparse.ArgumentParser) -> None:
    real = parser.add_argument_group("a recording of a real cloth (see docs/fit_recordings.md)")
    topic = "topic of the clouds, if several topics have clouds; with the field of the points for messages of any type"
    real.add_argument("--topic", metavar="NAME[:FIELD]", help=topic)
    index = "field with the particles' numbers, such as markers[].id; default: points in the order of the particles"
    real.add_argument("--index", default="", metavar="FIELD", help=index)
    pose = (
        "a gripper's poses: topic (PoseStamped), topic and field, or a table (CSV); default: the topic that ends in "
        "/GRIPPER/target or /pose; {} stands for the recording's name without its ending"
    )
    real.add_argument("--pose", action="append", default=[], metavar="GRIPPER=TOPIC[:FIELD]", help=pose)
    offset = "point that a gripper holds, in the frame of its poses [m]"
    real.add_argument("--offset", action="append", default=[], metavar="GRIPPER=X,Y,Z", help=offset)
    camera = "pose of the clouds' frame in that of the gripper poses: position [m] and quaternion"
    real.add_argument("--camera-pose", metavar="X,Y,Z,QX,QY,QZ,QW", help=camera)
    columns = "names in a table, such as time=t,particle=id,x=X,y=Y,z=Z"
    real.add_argument("--columns", default="", metavar="NAME=COLUMN,...", help=columns)
    scale = "factor from the unit of tables to metres (default 1)"
    real.add_argument("--scale", type=float, metavar="M", help=scale)
    held = (
        "particles that a gripper holds at the first cloud: indices (12,13), a corner (top_left) or an edge; default: "
        "the particle nearest to it in the clouds, with those within "
        "gripper.radius. FILE: is for one of several files; then name all grippers"
    )
    real.add_argument("--held", action="append", default=[], metavar="[FILE:]GRIPPER=PARTICLES", help=held)
    begin = "omit clouds before this time from the first one [s]; the cloth must hang at rest at the first used one"
    real.add_argument("--from", dest="begin", type=float, metavar="S", help=begin)
    settle = "settling time of the simulated cloth before the first cloud [s] (default 4)"
    real.add_argument("--settle", type=float, metavar="S", help=settle)
    unordered = "points carry no particle index: fit their distances from the surface; also for sessions"
    real.add_argument("--unordered", action="store_true", help=unordered)


def _fit(options: argparse.Namespace) -> Fit | MotionFit:
    from tqdm import tqdm

    from cloth_sim_ros.fit.parameters import FitError

    if options.every < 1:
        raise FitError(f"--every is {options.every}; give 1 or more")
    if options.until is not None and not options.until > 0.0:
        raise FitError(f"--until is {options.until:g} s; it must be above 0")
    _check_distinct(options.session)
    names = [name.strip() for name in options.parameters.split(",") if name.strip()]
    start = {name: _parse_number(value, f"--start {name}") for name, value in _pairs(options.start, "--start").items()}
    prepared = _prepare_fit(options, names, start)
    with tqdm(unit=" simulations", desc="fit", delay=1.0, disable=None, leave=False) as bar:
        return prepared(bar.update)


def _check_distinct(paths: Sequence[Path]) -> None:
    """Raise FitError if a recording is given twice: a copy would count as an independent motion."""
    from cloth_sim_ros.fit.parameters import FitError

    paths_by_file = dict[Path, Path]()
    for path in paths:
        first = paths_by_file.setdefault(path.resolve(), path)
        if first is not path:
            raise FitError(f"'{path}' is the recording '{first}'; give each recording once")


def _prepare_fit(
    options: argparse.Namespace, names: Sequence[str], start: dict[str, float]
) -> Callable[[Callable[[int], Any]], Fit | MotionFit]:
    """Read the recordings; return the function that fits them, given a callback for its progress. Raises FitError."""
    from cloth_sim_ros.fit.bag import is_session
    from cloth_sim_ros.fit.parameters import FitError
    from cloth_sim_ros.scene.scene import Scene

    scene = None if options.scene is None else Scene.from_file(options.scene)
    common: dict[str, Any] = {"start": start, "within": options.within, "workers": options.workers}
    motion_options = {
        "time_offset": options.fit_time_offset,
        "camera_pose": options.fit_camera_pose,
        "loss": options.loss,
        "held_out": options.held_out,
    }
    chosen = {name: value for name, value in motion_options.items() if value is not None}
    if not is_session(options.session[0]):
        if options.sigma is not None:
            raise FitError("--sigma is for one session; a fit to a real cloth finds the noise from the residuals")
        return _prepare_real(options, scene, names, {**common, **chosen})
    sessions = [
        recording.part(until=options.until, every=options.every) for recording in _read_sessions(options, scene)
    ]
    if len(sessions) == 1 and not chosen:
        from cloth_sim_ros.fit.fit import fit

        return lambda progress: fit(sessions[0], names, **common, sigma=options.sigma, on_progress=progress)
    if options.sigma is not None:
        raise FitError("--sigma is for one session; a fit to several finds the noise from the residuals")
    from cloth_sim_ros.fit.motions import fit_motions

    kinds = {"time_offset": "no", "camera_pose": "no", **chosen}
    return lambda progress: fit_motions(sessions, names, **common, **kinds, on_progress=progress)


def _prepare_real(
    options: argparse.Namespace, scene: Scene | None, names: Sequence[str], settings: dict[str, Any]
) -> Callable[[Callable[[int], Any]], MotionFit]:
    """Read a real cloth's recordings; return the function that fits them, given a callback for its progress."""
    from cloth_sim_ros.fit.bag import read_recording
    from cloth_sim_ros.fit.parameters import FitError
    from cloth_sim_ros.fit.real import fit_real
    from cloth_sim_ros.fit.tables import parse_columns
    from cloth_sim_ros.session.opening import open_file

    if scene is None:
        cause = "was not recorded by cloth_sim and holds no scene"
        raise FitError(f"{options.session[0]} {cause}; describe the cloth by --scene")
    for path in options.session[1:]:
        # `is_session` has checked the first file. Opening a pipe would wait for its writer.
        if not path.is_dir():
            open_file(path).close()
    poses, held = _pairs(options.pose, "--pose"), _pairs(options.held, "--held")
    scale = 1.0 if options.scale is None else options.scale
    if not 0.0 < scale < math.inf:
        raise FitError(f"--scale is {scale:g}; it must be above 0, such as 0.001 for millimetres")
    columns = parse_columns(options.columns)
    offsets = {
        name: _parse_numbers(text, 3, f"--offset {name}") for name, text in _pairs(options.offset, "--offset").items()
    }
    camera_pose = None
    if options.camera_pose is not None:
        camera_pose = _parse_numbers(options.camera_pose, 7, "--camera-pose")
    _check_kinds(options)
    groups = [options.session] if options.parts else [[path] for path in options.session]
    grasped = grasped_of_groups(held, [group[0] for group in groups])
    recordings = []
    for group in groups:
        recording = read_recording(
            group,
            scene,
            topic=options.topic,
            poses={name: _expand(source, group[0]) for name, source in poses.items()},
            matched=not options.unordered,
            index_field=options.index,
            columns=columns,
            scale=scale,
            camera_pose=camera_pose,
            offsets=offsets,
        )
        recordings.append(recording.since(options.begin or 0.0).part(until=options.until, every=options.every))
    if options.settle is not None:
        settings["settle_time"] = options.settle
    return lambda progress: fit_real(recordings, scene, names, **settings, grasped=grasped, on_progress=progress)


def _check_kinds(options: argparse.Namespace) -> None:
    """Refuse options of bags if all recordings are tables, and options of tables if none is."""
    from cloth_sim_ros.fit.parameters import FitError
    from cloth_sim_ros.fit.tables import is_table

    first, has_table = options.session[0], [is_table(path) for path in options.session]
    if all(has_table):
        for option, is_set in (("--topic", options.topic is not None), ("--index", bool(options.index))):
            if is_set:
                raise FitError(f"{option} is for bags, and {first} is a table; name its columns by --columns")
    if options.columns and not any(has_table):
        raise FitError(f"--columns is for tables, and {first} is a bag; name its fields by --topic and --index")


def grasped_of_groups(held: dict[str, str], paths: Sequence[Path]) -> dict[str, str] | list[dict[str, str]]:
    """Return grasped particles by gripper; a list by file if a name has a file (``swing_2:left``). Raises FitError."""
    from cloth_sim_ros.fit.parameters import FitError

    common = {name: text for name, text in held.items() if ":" not in name}
    if len(common) == len(held):
        return common
    by_file = [dict(common) for _ in paths]
    for name, text in held.items():
        file, colon, gripper = name.rpartition(":")
        if not colon:
            continue
        matching = [k for k, path in enumerate(paths) if file in (str(path), path.name, path.stem)]
        if len(matching) != 1:
            raise FitError(f"--held {name}={text} names {len(matching)} files; write a given path or a file's name")
        by_file[matching[0]][gripper] = text
    return by_file


def _read_sessions(options: argparse.Namespace, scene: Scene | None) -> list[FitRecording]:
    """Read sessions of this package; consecutive files of one session are its parts."""
    import itertools

    from cloth_sim_ros.fit.parameters import FitError
    from cloth_sim_ros.fit.recording import read_session
    from cloth_sim_ros.session.part import SessionPart

    bag_options = {
        "--topic": options.topic is not None,
        "--index": bool(options.index),
        "--columns": bool(options.columns),
        "--scale": options.scale is not None,
        "--pose": bool(options.pose),
        "--offset": bool(options.offset),
        "--camera-pose": options.camera_pose is not None,
        "--held": bool(options.held),
        "--from": options.begin is not None,
        "--settle": options.settle is not None,
        "--parts": options.parts,
    }
    for option, is_set in bag_options.items():
        if is_set:
            raise FitError(f"{option} is for a recording of a real cloth; omit it for a session")

    def session_of(path: Path) -> str:
        part = SessionPart(path)
        try:
            return part.session
        finally:
            part.close()

    groups = [options.session]
    if len(options.session) > 1:
        groups = [list(paths) for _, paths in itertools.groupby(options.session, key=session_of)]
    return [read_session(paths, scene=scene, matched=not options.unordered) for paths in groups]


def _pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    from cloth_sim_ros.fit.parameters import FitError

    pairs: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise FitError(f"{option} is '{text}'; write NAME=VALUE")
        if name in pairs:
            raise FitError(f"{option} names '{name}' twice, as '{pairs[name]}' and as '{value}'; give it once")
        pairs[name] = value
    return pairs


def _parse_number(text: str, option: str) -> float:
    from cloth_sim_ros.fit.parameters import FitError

    try:
        return float(text)
    except ValueError:
        raise FitError(f"{option} is '{text}'; it must be a number") from None


def _parse_numbers(text: str, count: int, option: str) -> list[float]:
    from cloth_sim_ros.fit.parameters import FitError

    parts = text.split(",")
    if len(parts) != count:
        raise FitError(f"{option} is '{text}'; give {count} numbers with commas between them")
    numbers = [_parse_number(part, option) for part in parts]
    if not all(map(math.isfinite, numbers)):
        raise FitError(f"{option} is '{text}'; all numbers must be finite")
    return numbers


def _report(fit: Fit | MotionFit, options: argparse.Namespace) -> None:
    from cloth_sim_ros.fit import files, motions_files
    from cloth_sim_ros.fit.fit import Fit
    from cloth_sim_ros.fit.motions_text import describe_motions
    from cloth_sim_ros.fit.text import describe

    print(describe(fit) if isinstance(fit, Fit) else describe_motions(fit), flush=True)
    if options.json is not None:
        files.write_json(fit, options.json) if isinstance(fit, Fit) else motions_files.write_json(fit, options.json)
    if options.write is not None:
        identified = files.write_parameters(fit, options.write)
        print(f"\n{options.write}: the scene with {', '.join(identified) or 'nothing new'}")
        if absent := files.absent_files(fit, options.write):
            origin = "from the folder of --scene" if options.scene else "the session has it as attachment file:NAME"
            print(f"  It names {', '.join(absent)}, absent from its folder: copy each there ({origin}).")
    if options.plot is not None:
        files.write_plot(fit, options.plot) if isinstance(fit, Fit) else motions_files.write_plot(fit, options.plot)


if __name__ == "__main__":
    sys.exit(main())
