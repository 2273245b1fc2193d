# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signals that come while a command still loads its modules."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

#: Exit status of a command that a signal ended.
INTERRUPTED = 130
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def loading(command: str) -> Iterator[None]:
    """Within, SIGINT, SIGTERM and SIGHUP end the process at once, with one line and status 130.

    Nothing has begun yet that needs an end, and an exception amid imports leaves a traceback, or is taken for a missing
    library. From the main thread only; a signal that is ignored stays so.

    Args:
        command: its name.
    """

    def end(_number: int, _frame: FrameType | None) -> None:
        # Not by print: the signal may have come amid one.
        os.write(2, f"{command}: interrupted\n".encode())
        os._exit(INTERRUPTED)

    taken = [number for number in _SIGNALS if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    before = [(number, signal.signal(number, end)) for number in taken]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)


def run_command(command: str, module: str, arguments: Sequence[str] | None) -> int:
    """Import the module of a command and run its `main`.

    Args:
        command: its name.
        module: full name of the module.
        arguments: of the command line; those of this process where left out.

    Returns:
        The command's exit status; 130 if it was interrupted.
    """
    with loading(command):
        main = importlib.import_module(module).main
    try:
        status: int = main(arguments)
    except KeyboardInterrupt:
        print(f"{command}: interrupted", file=sys.stderr)
        return INTERRUPTED
    return status
