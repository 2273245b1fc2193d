# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The state `failed`, from an exception in a frame to a reset."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from rclpy.node import Node

from cloth_sim_ros.ros.process.stopping import StopRequestedError
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.stepper import Stepper
from cloth_sim_ros.simulation.events import Reset, SetParameters
from cloth_sim_ros.simulation.snapshot import Snapshot

#: Environment variable that lets exceptions of frames propagate. The tests set it, so that the state hides no bug.
RAISE_VARIABLE = "CLOTH_SIM_ROS_RAISE"
#: Longest reason [characters]: it is a label, a diagnostics message and an end record.
_MAX_REASON_LENGTH = 300


class NodeFailedError(RuntimeError):
    """Error: a frame failed, and the node has to end because `on_failure` is `exit`."""


class FailureGuard:
    """Guard around frames: an exception in one restores the state before it and stops time until a reset.

    MemoryError, StopRequestedError and exceptions outside the class Exception propagate. If a callback that holds
    `callback_lock` raises, the next frame fails.

    Args:
        node: the node.
        stepper: computes the frames, and holds the events of the frame that failed.
        lock: the lock of the cloth.
    """

    def __init__(self, node: Node, stepper: Stepper, lock: AbstractContextManager[Any]) -> None:
        self._node, self._stepper, self.lock = node, stepper, lock
        self._simulation, self._queue = stepper.simulation, stepper.queue
        #: Callbacks for a failure, by subject; each takes the reason and the ROS time of the frame [ns]. If one fails,
        #: the others still run.
        self.reports: Mapping[str, Callable[[str, int], Any]] = {}
        #: Callbacks hold this instead of the lock.
        self.callback_lock = CallbackLock(lock, self.defer)
        self._pending: Exception | None = None
        self._log = ThrottledLog(node.get_logger(), seconds=60.0)
        self._must_exit = False
        #: Exception of the frame that failed, in one line; empty while frames succeed.
        self.reason = ""

    @property
    def refusal(self) -> str:
        """Text by which requests are refused while the node is failed, with reason and remedy; empty otherwise."""
        return f"failed: {self.reason}; call ~/reset" if self.reason else ""

    def run(self, frame: Callable[[], None], stamp: int) -> None:
        """Run a frame due at a ROS time [ns]; an exception restores the state before it, and the node is failed.

        While the node is failed, the frame runs only if a reset waits, and other events are refused.
        """
        failed = self.reason
        if failed:
            is_reset = self._queue.contains(Reset)
            self._queue.refuse(self.refusal, keep=(SetParameters, Reset) if is_reset else (SetParameters,))
            if not is_reset:
                return
        before = self._simulation.snapshot()
        try:
            pending, self._pending = self._pending, None
            if pending is not None:
                raise pending
            frame()
        except Exception as error:
            if self._propagates(error):
                raise
            self._enter(error, before, stamp)
        else:
            if failed:
                self.reason = ""
                self._node.get_logger().info(f"reset: time goes on from frame {self._simulation.frame}")

    def defer(self, error: Exception) -> bool:
        """Let the exception of a callback fail the next frame; return false if the callback must raise it."""
        if self._propagates(error):
            return False
        if not self.reason:
            self._pending = error
        return True

    def attempt(self, subject: str, job: Callable[[], Any]) -> None:
        """Run a job that must not end the node; log its exception instead, once a minute for each subject."""
        try:
            job()
        except Exception as error:
            if self._propagates(error):
                raise
            # While failed, further errors most likely have the same cause, whose traceback is in the log.
            trace = "" if self.reason else f"\n{traceback.format_exc().rstrip()}"
            self._log.error(subject, f"{subject}: {describe_exception(error)}{trace}")

    def check_exit(self) -> None:
        """Raise NodeFailedError, which ends the executor's spin, if a frame failed and `on_failure` is `exit`.

        Raises:
            NodeFailedError: if a frame failed, and `on_failure` is `exit`.
        """
        if self._must_exit and self.reason:
            raise NodeFailedError(f"failed: {self.reason}; the node ends because on_failure is exit")

    def _propagates(self, error: Exception) -> bool:
        if isinstance(error, MemoryError | StopRequestedError) or os.environ.get(RAISE_VARIABLE):
            return True
        # The middleware raises after the context was shut down; there is no subscriber any more.
        return isinstance(error, RuntimeError) and not self._node.context.ok()

    def _enter(self, error: Exception, before: Snapshot, stamp: int) -> None:
        self.reason, self._pending = describe_exception(error), None
        reason = self.reason
        trace = "".join(traceback.format_exception(error)).rstrip()
        self.attempt("cannot return to the last good frame", lambda: self._simulation.restore(before))
        self._must_exit = self._simulation.scene.on_failure == "exit"
        self._node.get_logger().error(
            f"failed: {reason}; time is stopped at frame {self._simulation.frame}, and no clouds are published until "
            f"~/reset is called\n{trace}"
        )
        self._stepper.refuse(self.refusal)
        self._queue.refuse(self.refusal)
        for subject, report in self.reports.items():
            self.attempt(f"cannot report the failure by {subject}", lambda report=report: report(reason, stamp))  # type: ignore[misc]


class CallbackLock:
    """Lock for callbacks: `defer` receives the exception of the callback that holds it, and may suppress it.

    Args:
        lock: the lock to hold.
        defer: takes an exception; returns true if the exception is not raised.
    """

    def __init__(self, lock: AbstractContextManager[Any], defer: Callable[[Exception], bool]) -> None:
        self._lock, self._defer = lock, defer

    def __enter__(self) -> None:
        """Take the wrapped lock."""
        self._lock.__enter__()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> bool:
        self._lock.__exit__(None, None, None)
        return isinstance(error, Exception) and self._defer(error)


@contextmanager
def ignore_errors_after_shutdown(node: Node) -> Iterator[None]:
    """Context that suppresses RuntimeErrors of rclpy if ROS was shut down meanwhile.

    rclpy's signal handlers may shut it down at any moment.
    """
    try:
        yield
    except RuntimeError:
        if node.context.ok():
            raise


def describe_exception(error: Exception) -> str:
    """Return type and message of an exception in one line of about 300 characters at most."""
    text = " ".join(str(error).split())
    line = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return line if len(line) <= _MAX_REASON_LENGTH else f"{line[:_MAX_REASON_LENGTH]}..."
