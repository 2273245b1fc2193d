# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of recordings that cannot start."""


class RecordingUnavailableError(RuntimeError):
    """Error: recording is not possible; the message says why."""


class RecordingNotInstalledError(RecordingUnavailableError):
    """Error: the libraries for recording are not installed."""
