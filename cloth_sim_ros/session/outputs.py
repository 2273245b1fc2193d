# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What commands write: never over a session or what they read, only where a file can be made, whole or not at all."""

from __future__ import annotations

import contextlib
import itertools
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.mcap_builder import MAGIC
from cloth_sim_ros.session.writer import SUFFIX

#: Characters of a file's name that the hidden name beside it repeats: a name has at most 255 bytes.
_KEPT_OF_NAME = 40


class OutputError(SessionError):
    """A file cannot be written where it was asked for; the message is one sentence fit for a command line."""


def check_outputs(
    outputs: Mapping[str, Path | None], inputs: Sequence[Path], *, endings: Mapping[str, str] | None = None
) -> None:
    """Refuse outputs that would destroy a session or an input, or cannot be written, before any work is done.

    Any other file that exists may be replaced. Devices and pipes are written to as they are.

    Args:
        outputs: paths by the options that name them; None where an option was not given.
        inputs: files that are read.
        endings: the ending of an output's name by its option, where but one kind of file is written.

    Raises:
        OutputError: naming option, path and remedy.
    """
    given = {option: path for option, path in outputs.items() if path is not None}
    for option, path in given.items():
        _check_overwriting(option, path, inputs)
        _check_place(option, path)
        ending = (endings or {}).get(option)
        if ending is not None and path.suffix.lower() not in ("", ending):
            raise OutputError(
                f"{option} is '{path}', but {ending[1:].upper()} is all that it writes: end the name in {ending}"
            )
    for (one, path), (other, also) in itertools.combinations(given.items(), 2):
        if _is_replaced(path) and os.path.realpath(path) == os.path.realpath(also):
            raise OutputError(f"{one} and {other} both name '{path}': give two names")


@contextlib.contextmanager
def written_whole(target: Path, *, replace: bool = True) -> Iterator[Path]:
    """Give an empty hidden file beside the target to write; at the end it takes the target's name.

    After an error, an interruption or a loss of power nothing of it stays, and what was there before is as it was.
    Where `target` is a device or a pipe, it is itself what is given.

    Raises:
        OSError: naming the target, where it cannot be written; FileExistsError where it exists and `replace` is false.
    """
    if not _is_replaced(target):
        yield target
        return
    final = Path(os.path.realpath(target))
    hidden = final.with_name(f".{final.name[:_KEPT_OF_NAME]}.{secrets.token_hex(4)}.unfinished")
    try:
        hidden.open("xb").close()
        yield hidden
        _sync(hidden)
        if replace:
            if final.exists():
                shutil.copymode(final, hidden)
            hidden.replace(final)
        else:
            # Unlike a rename this fails where there is a file by now.
            os.link(hidden, final)
        _sync(final.parent)
    except OSError as error:
        if str(error.filename) == str(hidden) and not isinstance(error, FileExistsError):
            raise OSError(error.errno, error.strerror, str(target)) from error
        raise
    finally:
        with contextlib.suppress(OSError):
            hidden.unlink(missing_ok=True)


def _sync(place: Path) -> None:
    """Wait until a file, or a folder's names, would survive a loss of power."""
    descriptor = os.open(place, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _check_overwriting(option: str, path: Path, inputs: Sequence[Path]) -> None:
    for source in inputs:
        if _same_file(path, source):
            same = "" if path == source else f"the same file as '{source}', "
            raise OutputError(
                f"{option} is '{path}', {same}which is read: give the output's own name right after {option}"
            )
    if SUFFIX in (path.suffix.lower(), Path(os.path.realpath(path)).suffix.lower()):
        raise OutputError(
            f"{option} is '{path}', but what ends in {SUFFIX} is a session: give the output's own name right after "
            f"{option}"
        )
    if _holds_mcap(path):
        raise OutputError(
            f"{option} is '{path}', which holds an MCAP recording and is not overwritten: give the output another name"
        )


def _check_place(option: str, path: Path) -> None:
    if path.is_dir():
        raise OutputError(f"{option} is '{path}', a folder: name a file in it")
    if not _is_replaced(path):
        return
    folder = Path(os.path.realpath(path)).parent
    if not folder.is_dir():
        raise OutputError(f"{option} is '{path}', but there is no folder '{folder}': make it first, or name another")
    if path.exists() and not os.access(path, os.W_OK):
        raise OutputError(f"{option} is '{path}', which must not be written: change its permissions, or name another")
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OutputError(
            f"{option} is '{path}', but nothing can be written into '{folder}' ({error.strerror}): name another folder"
        ) from error


def _is_replaced(path: Path) -> bool:
    """Whether a new file takes this name; a device or a pipe is written to."""
    return path.is_file() or not path.exists()


def _same_file(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        # One of them is not there.
        return False


def _holds_mcap(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        # What cannot be read cannot be told; whether it may be written is asked elsewhere.
        return False
