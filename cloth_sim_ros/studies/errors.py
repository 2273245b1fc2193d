# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Exceptions of studies.

Every message names the value, the limit and the remedy.
"""

from __future__ import annotations

import errno
from pathlib import Path

#: System errors of a full disk, an exceeded quota and a file size limit.
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class StudyError(ValueError):
    """Error: a study description is invalid, or a folder does not hold the study."""


class StoppedError(RuntimeError):
    """Error: a study stopped before its end; finished runs are kept."""


class FolderError(StoppedError):
    """Error: a study's folder can't be written, for a reason independent of the runs."""


def folder_error(folder: Path, error: OSError) -> FolderError:
    """Return, to be raised, the `FolderError` of a failed write, with cause and remedy."""
    if error.errno in _DISK_FULL:
        return FolderError(
            f"no space left in {folder}: {error.strerror}. Finished runs are kept, incomplete files are removed. "
            "Free disk space (or start in another folder with 'clouds: false'), then continue with --resume"
        )
    return FolderError(f"cannot write into {folder}: {error.strerror or error}. Fix that, then continue with --resume")
