# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Worker process that takes the newest job of a node and answers by lines of JSON.

The node never waits for it: a thread starts it and sends the jobs, another one reads the answers. A job is sent after
the previous one was done, and a newer job replaces one that waits.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import queue
import subprocess
import threading
from collections.abc import Callable
from typing import IO, Any, Generic, TypeVar

from cloth_sim_ros.session.child_process import child_environment, module_command

Job = TypeVar("Job")
#: Longest wait for the end of a process after its input, and of a killed one [s].
_END_TIMEOUT, _KILL_TIMEOUT = 1.0, 1.0


class WorkerProcess(Generic[Job]):
    """Child process that runs a module, started at once: takes the newest job and answers, without blocking the node.

    Args:
        module: module that the process runs, with this process's id as argument. It reads pickled objects from its
            standard input.
        name: name of the threads.
        encode: returns the object that is pickled for a job; called in a thread.
        on_answer: takes an answer and returns true if the process is ready for a job; called in another thread.
        on_end: called with the reason if the process ends by itself or can't be started.
        ends_with_input: true if the process ends soon after its input, and has to leave the ROS graph in order; false
            if it is killed.
    """

    def __init__(
        self,
        module: str,
        *,
        name: str,
        encode: Callable[[Job], Any],
        on_answer: Callable[[dict[str, Any]], bool],
        on_end: Callable[[str], None],
        ends_with_input: bool = False,
    ) -> None:
        self._module, self._name, self._encode = module, name, encode
        self._on_answer, self._on_end, self._ends_with_input = on_answer, on_end, ends_with_input
        self._jobs: queue.Queue[Job | None] = queue.Queue(maxsize=1)
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = threading.Event()
        self._has_ended = False
        #: A pipe would buffer many jobs.
        self._ready = threading.Semaphore(1)
        threading.Thread(target=self._run, name=name, daemon=True).start()

    @property
    def has_waiting_job(self) -> bool:
        """True if the newest job was not sent yet."""
        return not self._jobs.empty()

    def put(self, job: Job) -> Job | None:
        """Queue a job for the process; return the unsent job that it replaces, or None."""
        replaced = None
        with contextlib.suppress(queue.Empty):
            replaced = self._jobs.get_nowait()
        self._jobs.put_nowait(job)
        return replaced

    def close(self) -> None:
        """End the process by closing its input or by killing it; wait at most 2 s."""
        self._closed.set()
        # No job comes any more: only the thread takes from the queue. It then closes the process's input.
        with contextlib.suppress(queue.Empty):
            self._jobs.get_nowait()
        self._jobs.put_nowait(None)
        self._ready.release()
        process = self._process
        if process is None:
            return
        with contextlib.suppress(subprocess.TimeoutExpired):
            if self._ends_with_input:
                process.wait(_END_TIMEOUT)
                return
        process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_KILL_TIMEOUT)

    def _run(self) -> None:
        """Start the process and send it jobs, in a thread because both may block."""
        # Not in the terminal's process group: Ctrl-C ends the node, and the node ends the process.
        try:
            process = subprocess.Popen(
                module_command(self._module, str(os.getpid())),
                env=child_environment(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:
            self._end(f"could not be started: {error}")
            return
        self._process = process
        if self._closed.is_set():
            process.kill()
        assert process.stdin is not None and process.stdout is not None
        threading.Thread(target=self._read, args=(process, process.stdout), name=self._name, daemon=True).start()
        # If the process has ended, the reading thread reports it.
        with contextlib.suppress(OSError), process.stdin:
            self._send_jobs(process.stdin)

    def _send_jobs(self, stream: IO[bytes]) -> None:
        while True:
            self._ready.acquire()
            job = self._jobs.get()
            if job is None or self._has_ended:
                return
            pickle.dump(self._encode(job), stream)
            stream.flush()

    def _read(self, process: subprocess.Popen[bytes], lines: IO[bytes]) -> None:
        with lines:
            for line in lines:
                if self._on_answer(json.loads(line)):
                    self._ready.release()
        self._end(f"ended by itself (status {process.wait()})")
        self._ready.release()

    def _end(self, reason: str) -> None:
        if not self._closed.is_set():
            self._has_ended = True
            self._on_end(reason)
