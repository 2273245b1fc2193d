# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Validation and order of command stamps, without a ROS graph."""

from __future__ import annotations

import attrs

_SECOND = 1_000_000_000
#: Largest time of a stamp ahead of the present [ns].
MAX_FUTURE = _SECOND
#: After this silence [ns] older stamps are accepted again: a sender was restarted, or a bag is played again.
STAMP_EXPIRY = _SECOND


class StampError(ValueError):
    """Error: a command's stamp is refused; the message says why."""


class NoTimeError(StampError):
    """Error: a stamp is no valid time: negative, or with a second or more of nanoseconds."""


class OldStampError(StampError):
    """Error: a stamp is older than the newest one, e.g. of the same gripper's commands."""


def to_ros_time(sec: int, nanosec: int) -> int:
    """Convert a message's stamp to ROS time [ns]; NoTimeError for a negative one, or for 10^9 nanoseconds and more.

    Raises:
        NoTimeError: if they are no valid time: before 1970, or with a second or more of nanoseconds.
    """
    if sec < 0:
        raise NoTimeError(f"its stamp is {sec} s and {nanosec} ns; a time is not negative, and 0 s and 0 ns mean now")
    if nanosec >= _SECOND:
        raise NoTimeError(f"its stamp is {sec} s and {nanosec} ns; nanoseconds are below {_SECOND}")
    return sec * _SECOND + nanosec


@attrs.define
class StampGate:
    """Check of successive stamps, e.g. of one gripper's commands: refuses those out of order or too far ahead."""

    _newest: int | None = None
    _last_command: int = 0

    def accept(self, stamp: int, now: int) -> int:
        """Check a command's stamp [ns], 0 for now; return the ROS time [ns] at which it takes effect, or StampError.

        Args:
            stamp: stamp of the command [ns]; zero means now.
            now: present ROS time [ns].

        Raises:
            OldStampError: if the stamp is older than the newest one, which came less than a second ago.
            StampError: if the stamp is more than a second ahead.
        """
        effective = stamp or now
        if effective > now + MAX_FUTURE:
            raise StampError(
                f"its stamp is {(effective - now) / _SECOND:.3f} s ahead, at most {MAX_FUTURE / _SECOND:g} s can wait; "
                "do sender and cloth follow the same clock (use_sim_time)?"
            )
        silence = now - self._last_command
        if self._newest is not None and effective < self._newest and 0 <= silence < STAMP_EXPIRY:
            raise OldStampError(
                f"its stamp is {(self._newest - effective) / _SECOND:.3f} s older than that of the newest command"
            )
        self._newest = effective
        self._last_command = now
        return effective

    def reset(self) -> None:
        """Forget the newest stamp because the clock was set back: any stamp is accepted next."""
        self._newest = None
