# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Append-only file that ends on a whole record and is locked by its writer."""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import time
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.session.errors import RecordingError

_NO_HARD_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)
_NAME_LIMIT = 1000
_UNFINISHED_SUFFIX = ".unfinished"
_MIN_LEFTOVER_AGE = 3600.0


class AppendFile:
    """New file in `folder` that one process appends to and locks, at first with a hidden name.

    `publish` gives it its final name. A session is published with a complete opening. Therefore a visible file always
    has a readable opening, whenever the process was killed. The writer holds an exclusive advisory lock while the file
    is open. If a reader gets a shared lock, the writer has ended (see `is_being_written`).

    Methods raise OSError as the operating system reports it.
    """

    def __init__(self, folder: Path, stem: str, suffix: str) -> None:
        self._stem = stem
        self._suffix = suffix
        self._hidden: Path | None = folder / f".{stem}{suffix}.{secrets.token_hex(4)}{_UNFINISHED_SUFFIX}"
        self._descriptor = os.open(self._hidden, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self.path = folder / f"{stem}{suffix}"
        """The final path; fixed by `publish`."""
        self.size = 0
        """Size [bytes]; always the end of a complete append."""
        _lock(self._descriptor)

    def append(self, parts: Sequence[bytes]) -> None:
        """Append the bytes of all parts. On an OSError the file keeps none of them."""
        try:
            for part in parts:
                view = memoryview(part)
                while view:
                    view = view[self._write(view) :]
        except OSError:
            self._truncate()
            raise
        self.size += sum(map(len, parts))

    def publish(self) -> Path:
        """Give the file the first free name of ``stem``, ``stem-2``, ``stem-3`` ..., and return its path."""
        if self._hidden is not None:
            self.path = _link_free_name(self._hidden, self._stem, self._suffix)
            self._hidden.unlink(missing_ok=True)
            self._hidden = None
        return self.path

    def sync(self) -> None:
        """Wait until the file's contents would survive a power loss."""
        os.fdatasync(self._descriptor)

    def sync_name(self) -> None:
        """Wait until the file's name would survive a power loss."""
        descriptor = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def free_space(self) -> int:
        """Return the free space of the file system for an unprivileged writer [bytes]."""
        status = os.fstatvfs(self._descriptor)
        return status.f_bavail * status.f_frsize

    def is_linked(self) -> bool:
        """Return False if the file's name was removed: further bytes would be lost."""
        return os.fstat(self._descriptor).st_nlink > 0

    def close(self) -> None:
        """Close the file; remove it if it was never published. Can be called twice."""
        if self._descriptor >= 0:
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)
        if self._hidden is not None:
            self._hidden.unlink(missing_ok=True)
            self._hidden = None

    def discard(self) -> None:
        """Close and remove the file, even if it was published."""
        published = self._hidden is None
        self.close()
        if published:
            self.path.unlink(missing_ok=True)

    def _write(self, view: memoryview) -> int:
        return os.write(self._descriptor, view)

    def _truncate(self) -> None:
        """Remove an incomplete append. If this fails too, readers still stop at the last whole record."""
        try:
            os.ftruncate(self._descriptor, self.size)
            os.lseek(self._descriptor, self.size, os.SEEK_SET)
        except OSError:
            return


def is_being_written(descriptor: int) -> bool:
    """Return True if a living writer holds the lock of an open file; False on file systems without locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    return False


def make_folder(folder: Path) -> None:
    """Create a recording's folder if it is absent, and check that it is writable. Raises RecordingError if not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise RecordingError(f"cannot record into {folder}: it is, or lies under, a file; set record.folder") from None
    except OSError as error:
        raise RecordingError(f"cannot create {folder}: {error.strerror}; set record.folder") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise RecordingError(f"cannot write into {folder}: permission denied; set record.folder")


def remove_leftovers(folder: Path, suffix: str) -> None:
    """Delete a folder's hidden, unpublished files of killed processes: older than an hour and not locked."""
    for path in folder.glob(f".*{suffix}.????????{_UNFINISHED_SUFFIX}"):
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            continue
        try:
            # A file system without locks leaves only the age as a criterion.
            if time.time() - os.fstat(descriptor).st_mtime > _MIN_LEFTOVER_AGE and not is_being_written(descriptor):
                path.unlink(missing_ok=True)
        finally:
            os.close(descriptor)


def _lock(descriptor: int) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        # Some network file systems have no locks; a follower then reads the file as abandoned.
        return


def _link_free_name(hidden: Path, stem: str, suffix: str) -> Path:
    for name_index in range(1, _NAME_LIMIT):
        path = hidden.parent / (f"{stem}{suffix}" if name_index == 1 else f"{stem}-{name_index}{suffix}")
        try:
            os.link(hidden, path)
        except FileExistsError:
            continue
        except OSError as error:
            if error.errno not in _NO_HARD_LINKS:
                raise
            # Without hard links (FAT): reserve the name, then replace the reservation.
            try:
                os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644))
            except FileExistsError:
                continue
            try:
                os.replace(hidden, path)
            except OSError:
                path.unlink(missing_ok=True)
                raise
        return path
    raise RecordingError(f"{hidden.parent} already holds {_NAME_LIMIT - 1} files named {stem}; choose another folder")
