# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What can go wrong with a session, each with a message for people: the value, the limit, the remedy."""


class SessionError(Exception):
    """A session cannot be written or read; the message is one sentence fit for a command line."""


class NotASessionError(SessionError):
    """The file is readable, but it is no recorded cloth session."""


class DamagedSessionError(SessionError):
    """Bytes of the file fail their checksum or do not parse; raised only where the caller asked for strict reading."""


class StrippedSessionError(DamagedSessionError):
    """A session of which a tool copied the messages, but not the scene and state that it opens with."""


class RecordingError(SessionError):
    """A recording cannot be started or continued."""
