# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command runner; signals during the import of the command end it at once."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

#: Exit status of a command that a signal ended.
INTERRUPTED = 130
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def exit_on_signal(command: str) -> Iterator[None]:
    """Context for imports: until it ends, SIGINT, SIGTERM or SIGHUP exits the process at once with status 130.

    The exit prints one line and cleans up nothing: during imports nothing needs it yet. An exception during an import
    would print a traceback or look like a missing library. Ignored signals stay ignored. The end of the context
    restores the previous handlers. Outside the main thread, which takes the signals, the context has no effect.

    Args:
        command: name of the command, for the message.
    """

    def exit_at_once(_signal_number: int, _frame: FrameType | None) -> None:
        # Not by print: the signal may interrupt another print.
        os.write(2, f"{command}: interrupted\n".encode())
        os._exit(INTERRUPTED)

    is_main_thread = threading.current_thread() is threading.main_thread()
    candidates = _SIGNALS if is_main_thread else ()
    signal_numbers = [signum for signum in candidates if signal.getsignal(signum) not in (signal.SIG_IGN, None)]
    previous_handlers = [(signum, signal.signal(signum, exit_at_once)) for signum in signal_numbers]
    try:
        yield
    finally:
        for signal_number, handler in previous_handlers:
            signal.signal(signal_number, handler)


def _interrupt(_signal_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


@contextmanager
def interrupt_on_signal() -> Iterator[None]:
    """Context in which SIGTERM and SIGHUP interrupt as Ctrl-C does, so that the command cleans up.

    A batch system or a supervisor ends commands by SIGTERM. Call from the main thread. Only signals with
    the default action interrupt: others keep their handlers.
    """
    signal_numbers = [signum for signum in _SIGNALS if signal.getsignal(signum) is signal.SIG_DFL]
    for signal_number in signal_numbers:
        signal.signal(signal_number, _interrupt)
    try:
        yield
    finally:
        for signal_number in signal_numbers:
            signal.signal(signal_number, signal.SIG_DFL)


def run_command(command: str, module: str, arguments: Sequence[str] | None) -> int:
    """Import a command's module, run its `main(arguments)` and return its exit status; 130 after KeyboardInterrupt.

    Args:
        command: name of the command.
        module: full name of the module.
        arguments: of the command line; by default those of this process.

    Returns:
        The command's exit status; 130 if it was interrupted.
    """
    with exit_on_signal(command):
        main = importlib.import_module(module).main
    try:
        with interrupt_on_signal():
            status: int = main(arguments)
    except KeyboardInterrupt:
        print(f"{command}: interrupted", file=sys.stderr)
        return INTERRUPTED
    return status
