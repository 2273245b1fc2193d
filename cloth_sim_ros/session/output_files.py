# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Output files of commands: checked before the work, written atomically."""

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

#: Length of the prefix of a file's name in the temporary name: a name has at most 255 bytes.
_MAX_NAME_PREFIX = 40


class OutputError(SessionError):
    """Error: the requested output cannot be written. The message is one sentence for the command line."""


def check_outputs(
    outputs: Mapping[str, Path | None], inputs: Sequence[Path], *, endings: Mapping[str, str] | None = None
) -> None:
    """Raise OutputError for outputs that would overwrite a session or an input, or cannot be written.

    Call it before the work. Other existing files may be replaced. Devices and pipes are written directly.

    Args:
        outputs: paths by option; None if an option was not given.
        inputs: files that are read.
        endings: required ending of the file name by option; for options that write one kind of file.

    Raises:
        OutputError: with option, path and remedy.
    """
    paths = {option: path for option, path in outputs.items() if path is not None}
    for option, path in paths.items():
        _check_overwriting(option, path, inputs)
        _check_writable(option, path)
        ending = (endings or {}).get(option)
        if ending is not None and path.suffix.lower() not in ("", ending):
            kind = ending[1:].upper()
            raise OutputError(f"{option} is '{path}', but it writes {kind} only: end the name in {ending}")
    for (first_option, path), (second_option, second_path) in itertools.combinations(paths.items(), 2):
        if _is_regular_or_new(path) and os.path.realpath(path) == os.path.realpath(second_path):
            raise OutputError(f"{first_option} and {second_option} both name '{path}': give two names")


@contextlib.contextmanager
def atomic_write(target: Path, *, replace: bool = True) -> Iterator[Path]:
    """Yield a new hidden file's path; on success it becomes `target`, after an error it is removed. Raises OSError.

    After an error or an interruption the hidden file is removed. The target keeps its old contents, also after a power
    loss. If `target` is a device or a pipe, it is yielded itself.

    Raises:
        OSError: with the target's name, if it cannot be written.
        FileExistsError: if it exists and `replace` is False.
    """
    if not _is_regular_or_new(target):
        yield target
        return
    final = Path(os.path.realpath(target))
    hidden = final.with_name(f".{final.name[:_MAX_NAME_PREFIX]}.{secrets.token_hex(4)}.unfinished")
    try:
        hidden.open("xb").close()
        yield hidden
        _sync(hidden)
        if replace:
            if final.exists():
                shutil.copymode(final, hidden)
            hidden.replace(final)
        else:
            # Unlike a rename, a link fails if the file exists by now.
            os.link(hidden, final)
        _sync(final.parent)
    except OSError as error:
        if str(error.filename) == str(hidden) and not isinstance(error, FileExistsError):
            raise OSError(error.errno, error.strerror, str(target)) from error
        raise
    finally:
        with contextlib.suppress(OSError):
            hidden.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, would survive a power loss."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _check_overwriting(option: str, path: Path, inputs: Sequence[Path]) -> None:
    for source in inputs:
        if _same_file(path, source):
            same_file_note = "" if path == source else f"the same file as '{source}', "
            remedy = f"give the output's own name right after {option}"
            raise OutputError(f"{option} is '{path}', {same_file_note}which is read: {remedy}")
    if SUFFIX in (path.suffix.lower(), Path(os.path.realpath(path)).suffix.lower()):
        remedy = f"give the output's own name right after {option}"
        raise OutputError(f"{option} is '{path}', but what ends in {SUFFIX} is a session: {remedy}")
    if _is_mcap(path):
        cause = "which holds an MCAP recording and is not overwritten"
        raise OutputError(f"{option} is '{path}', {cause}: give the output another name")


def _check_writable(option: str, path: Path) -> None:
    if path.is_dir():
        raise OutputError(f"{option} is '{path}', a folder: name a file in it")
    if not _is_regular_or_new(path):
        return
    folder = Path(os.path.realpath(path)).parent
    if not folder.is_dir():
        raise OutputError(f"{option} is '{path}', but there is no folder '{folder}': make it first, or name another")
    if path.exists() and not os.access(path, os.W_OK):
        raise OutputError(f"{option} is '{path}', which must not be written: change its permissions, or name another")
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        cause = f"nothing can be written into '{folder}' ({error.strerror})"
        raise OutputError(f"{option} is '{path}', but {cause}: name another folder") from error


def _is_regular_or_new(path: Path) -> bool:
    """Return True if a new file can take this name; False for a device or a pipe."""
    return path.is_file() or not path.exists()


def _same_file(path_a: Path, path_b: Path) -> bool:
    try:
        return path_a.samefile(path_b)
    except OSError:
        # One of them does not exist.
        return False


def _is_mcap(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        # An unreadable file counts as none. `_check_writable` checks its permissions.
        return False
