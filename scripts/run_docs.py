# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs every code block of README, tutorials and CONTRIBUTING in a clean clone, and compares its output.

Blocks of bash or Python are run in order from the clone's top. An invisible comment before a block gives its kind.

<!-- output -->                 output of the block before it; a line "..." stands for any lines, and "..." in a line
                                for any text.
<!-- output: numbers vary -->   the same, with each number standing for any number.
<!-- file: NAME -->             content of a file.
<!-- background: TEXT -->       runs in the background, once it has printed the text, until the page's next such block
                                or its end. It then gets SIGINT and must end with status 0.
<!-- skip: REASON -->           not run: it needs more than a machine with Python, make, git and a compiler.

Any other block is an error, and so is a command that fails.
"""

from __future__ import annotations

import argparse
import difflib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import attrs
from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parent.parent
TUTORIALS = ("grasp", "robot_gripper", "robot", "robot_fold", "camera", "mujoco", "mesh", "session", "library")
PAGES = ["README.md", *(f"docs/tutorials/{name}.md" for name in TUTORIALS)]
PAGES += ["CONTRIBUTING.md"]
RUNS = ("bash", "python")
#: Time limit of a block [s]; `make test` from a clean clone takes longest.
LIMIT = 3600.0
#: Time limits of a process in the background to be ready, and to end [s].
READY, PATIENCE = 60.0, 15.0
#: Variables that are not passed to the blocks: those of other Python or ROS environments, and those that make would
#: pass from `make docs-check` to each make of a block.
_EXCLUDED_VARIABLES = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "AMENT_PREFIX_PATH"}
_EXCLUDED_VARIABLES |= {"MAKEFLAGS", "MAKELEVEL", "MFLAGS", "MAKEOVERRIDES", "ARGS", "TESTS", "VENV"}
_MARK = re.compile(r"<!--\s*(output|file|background|skip)(?::\s*(.*?))?\s*-->\s*$")
_NUMBER_PATTERN = re.compile(r"\d+(?:[.,:]\d+)*(?:e[+-]?\d+)?")


class PageError(ValueError):
    """A page has a block that is neither run nor marked."""


@attrs.define(kw_only=True)
class Block:
    """A code block of a page."""

    location: str
    language: str
    code: str
    mark: str = ""
    #: Argument of the mark: a reason, or a file's name.
    words: str = ""
    #: Expected output; None if the page shows none.
    output: str | None = None
    numbers_vary: bool = False


def blocks_of(text: str, name: str) -> list[Block]:
    """Return a page's blocks in order, each with the output that the page shows.

    Raises:
        PageError: naming the first block that is neither run nor marked.
    """
    blocks: list[Block] = []
    mark, words = "", ""
    for token in MarkdownIt("commonmark").parse(text):
        match = _MARK.match(token.content) if token.type == "html_block" else None
        if match:
            mark, words = match.group(1), match.group(2) or ""
        if token.type != "fence" or token.info.startswith("{"):
            continue
        location = f"{name}:{(token.map or [0])[0] + 1}"
        if mark == "output":
            if not blocks or blocks[-1].mark or blocks[-1].output is not None:
                raise PageError(f"{location}: output of no block")
            if words not in ("", "numbers vary"):
                raise PageError(f"{location}: output: '{words}' is unknown; write 'numbers vary' or nothing")
            blocks[-1].output, blocks[-1].numbers_vary = token.content, words == "numbers vary"
        elif mark or token.info in RUNS:
            blocks.append(Block(location=location, language=token.info, code=token.content, mark=mark, words=words))
        else:
            raise PageError(f"{location}: a block of '{token.info}' is neither run nor marked; see scripts/run_docs.py")
        mark, words = "", ""
    return blocks


def difference(shown: str, printed: str, *, numbers_vary: bool) -> str:
    """Return the difference between printed output and the page; empty if there is none."""

    def lines(text: str) -> list[str]:
        stripped = [" ".join(line.split()) for line in text.strip().splitlines()]
        return [_NUMBER_PATTERN.sub("#", line) for line in stripped] if numbers_vary else stripped

    expected, got = lines(shown), lines(printed)
    pattern = "".join(
        "(?:.*\n)*?" if line == "..." else ".*".join(map(re.escape, line.split("..."))) + "\n" for line in expected
    )
    if re.fullmatch(pattern, "".join(f"{line}\n" for line in got)):
        return ""
    return "\n".join(difflib.unified_diff(expected, got, "the page", "printed", lineterm=""))


def user_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a user's shell: this process's variables without those of the check itself."""
    inherited = {name: value for name, value in environment.items() if name not in _EXCLUDED_VARIABLES}
    return inherited | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "PYTHONUNBUFFERED": "1"}


class Clone:
    """A clean clone in which blocks run as in a user's shell."""

    def __init__(self, folder: Path, *, logs: Path) -> None:
        self.folder, self._logs = folder, logs
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
        self._environment = user_environment(os.environ)
        self._background: list[tuple[subprocess.Popen[str], Path]] = []

    def run(self, block: Block) -> str:
        """Run a block; return its fault, or ""."""
        if block.mark == "file":
            (self.folder / block.words).write_text(block.code)
            return ""
        if block.mark == "background":
            return self._begin(block)
        process = self._start(block, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        try:
            printed, errors = process.communicate(timeout=LIMIT)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return f"still runs after {LIMIT:g} s"
        if process.returncode:
            return f"ended with status {process.returncode}\n{printed[-2000:]}{errors[-4000:]}"
        if block.output is None:
            return ""
        return difference(block.output, printed, numbers_vary=block.numbers_vary)

    def end_background(self) -> Iterator[str]:
        """End processes in the background; yield the fault of each."""
        for process, log in self._background:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
            try:
                status: object = process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                status = f"none, {PATIENCE:g} s after SIGINT"
            if status:
                yield f"what ran in the background ended with status {status}\n{log.read_text()[-4000:]}"
        self._background.clear()

    def report_background(self, page: str) -> int:
        """End processes in the background and report their faults; return the number of faults."""
        faults = list(self.end_background())
        for fault in faults:
            report(f"WRONG {page}: {fault}")
        return len(faults)

    def _begin(self, block: Block) -> str:
        log = self._logs / f"{len(self._background)}.log"
        with log.open("w") as stream:
            # exec replaces the shell, so that the process gets the signal itself.
            block.code = f"exec {block.code}"
            process = self._start(block, stdout=stream, stderr=subprocess.STDOUT)
        self._background.append((process, log))
        end = time.monotonic() + READY
        while block.words not in log.read_text():
            if process.poll() is not None or time.monotonic() > end:
                return f"did not print '{block.words}' within {READY:g} s\n{log.read_text()[-4000:]}"
            time.sleep(0.05)
        return ""

    def _start(self, block: Block, **streams: Any) -> subprocess.Popen[str]:
        bash = block.language == "bash"
        python = [str(self.folder / ".venv" / "bin" / "python"), "-c"]
        return subprocess.Popen(
            [*(["bash", "-euo", "pipefail", "-c"] if bash else python), block.code],
            cwd=self.folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
            **streams,
        )


def main() -> int:
    """Run the requested pages; return 1 if a block is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", default=PAGES, metavar="page", help="default: %(default)s")
    parser.add_argument("--leave-out", action="append", default=[], metavar="COMMAND", help="a block's first line")
    parser.add_argument("--folder", type=Path, help="where the clone goes and stays; a temporary place if left out")
    options = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", "87")
    with tempfile.TemporaryDirectory() as temporary:
        begun = time.monotonic()
        clone = Clone(options.folder or Path(temporary) / "cloth_sim_ros", logs=Path(temporary))
        wrong = run = skipped = 0
        for name in options.pages:
            for block in blocks_of((clone.folder / name).read_text(), name):
                title = (
                    f"{block.location}: {(block.words if block.mark == 'file' else block.code.splitlines()[0])[:90]}"
                )
                if block.mark == "skip" or block.code.splitlines()[0] in options.leave_out:
                    skipped += 1
                    report(f"skipped   {title} ({block.words or 'left out'})")
                    continue
                start, run = time.monotonic(), run + 1
                if block.mark == "background":
                    wrong += clone.report_background(name)
                fault = clone.run(block)
                wrong += bool(fault)
                report(f"{'WRONG' if fault else 'ok':5s} {time.monotonic() - start:6.1f} s  {title}")
                if fault:
                    report(fault)
            wrong += clone.report_background(name)
        minutes, seconds = divmod(round(time.monotonic() - begun), 60)
        report(f"{run} blocks run in {minutes} min {seconds} s, {wrong} wrong, {skipped} skipped")
    return 1 if wrong else 0


def report(text: str) -> None:
    """Print a line at once, also through a pipe."""
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
