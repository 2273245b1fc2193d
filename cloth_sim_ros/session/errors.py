# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of sessions. Each message names the value, the limit and the remedy."""


class SessionError(Exception):
    """Error: a session cannot be written or read. The message is one sentence for the command line."""


class NotASessionError(SessionError):
    """Error: the file is readable, but it is not a recorded cloth session."""


class DamagedSessionError(SessionError):
    """Error: bytes of the file fail their checksum or do not parse. Only strict reading raises it for messages."""


class StrippedSessionError(DamagedSessionError):
    """Error: a tool copied the session's messages without the scene and the state of its opening."""


class RecordingError(SessionError):
    """Error: a recording cannot be started or continued."""
