# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of sessions. Each message names the value, the limit and the remedy."""


class SessionError(Exception):
    """A session cannot be written or read. The message is one sentence for the command line."""


class NotASessionError(SessionError):
    """The file is readable, but it is not a recorded cloth session."""


class DamagedSessionError(SessionError):
    """Bytes of the file fail their checksum or do not parse. Only strict reading raises this for messages."""


class StrippedSessionError(DamagedSessionError):
    """A tool copied the session's messages without the scene and the state of its opening."""


class RecordingError(SessionError):
    """A recording cannot be started or continued."""
