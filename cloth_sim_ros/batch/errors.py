# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a study; every message names the value, the limit and the remedy."""

from __future__ import annotations

import errno
from pathlib import Path

#: What the system says when no more fits: the disk, the user's share of it, the size of a file.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class StudyError(ValueError):
    """A study that can't be run as it is described, or a folder that is none of it."""


class StoppedError(RuntimeError):
    """A study that had to stop on its way; what is finished is kept."""


class FolderError(StoppedError):
    """A study's folder can't be written: not the fault of a run."""


def folder_error(folder: Path, error: OSError) -> FolderError:
    """Say what keeps a folder from being written, and what helps."""
    if error.errno in _FULL:
        return FolderError(
            f"nothing more fits into {folder}: {error.strerror}. Finished runs are kept, nothing half-written stays. "
            "Make room (or leave the clouds out: 'clouds: false' in another folder), then go on with --resume"
        )
    return FolderError(f"cannot write into {folder}: {error.strerror or error}. Mend that, then go on with --resume")
