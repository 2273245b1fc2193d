# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Documentation site: no warnings, every parameter documented, answers within a few clicks."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from cloth_sim_ros import Scene
from cloth_sim_ros.scene.parameter_page import page

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
#: Source pages, and every file of the source tree.
WRITTEN = [path for path in sorted(DOCS.rglob("*.md")) if path.parent != DOCS / "generated"]
FILES = [
    str(path.relative_to(ROOT))
    for folder in ("benchmarks", "cloth_sim_ros", "docs", "examples", "launch", "scripts", "test", "validation")
    for path in (ROOT / folder).rglob("*.*")
]
#: Word limit of a page, and the reference pages without it.
MAX_WORDS = 2500
LONG_PAGES = {"benchmarks.md"}
LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)")
#: Questions of a newcomer, and the place of the answer.
ANSWERS = {
    "where is the stability limit?": "time_stepping.md#stability",
    "what happens between a target and a cloud?": "frame.md",
    "how do I add a force?": "tutorials/library.md#a-force-of-your-own",
    "what bounds the error?": "time_stepping.md",
    "where is a session's digest made?": "frame.md",
}


@pytest.fixture(scope="module")
def run_docs() -> ModuleType:
    pytest.importorskip("markdown_it")
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        import run_docs
    finally:
        sys.path.remove(str(ROOT / "scripts"))
    return run_docs


@pytest.mark.parametrize("entry", Scene.declared(), ids=lambda entry: entry.name)
def test_each_parameter_is_described_on_the_page(entry) -> None:
    (row,) = [line for line in page().splitlines() if line.startswith(f"| `{entry.name}` |")]
    _, kind, unit, default, limits, live, words = [cell.strip() for cell in row.strip("| ").split(" | ")]
    assert (kind, unit) == (entry.kind, entry.unit)
    read = yaml.safe_load(default.strip("`"))
    assert entry.check(read) == entry.default
    assert words.replace("`", "") == entry.description
    assert live == ("live" if entry.live else "")
    for bound in (entry.min, entry.max, *entry.choices):
        assert bound is None or str(bound) in limits


def test_parameter_page_has_no_tag_outside_code() -> None:
    assert not re.findall(r"<\w+", re.sub(r"`[^`]*`", "", page()))


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    for library in ("sphinx", "myst_parser", "sphinx_rtd_theme"):
        pytest.importorskip(library)
    command = [sys.executable, "-m", "sphinx", "-b", "html", "-n", "-W", "--keep-going", "-q", "-d", tmp_path / "trees"]
    # The whole site's list of pages on each page takes half of the time.
    command += ["-D", "html_theme_options.collapse_navigation=1"]
    done = subprocess.run([*command, DOCS, tmp_path / "html"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "html" / "generated" / "parameters.html").is_file()


def links_of(name: str) -> set[str]:
    """Return the pages, with headings, that a page links to, as paths from docs/."""
    path = DOCS / name
    links = set()
    for link in LINK.findall(path.read_text()) if path.is_file() else []:
        target, _, heading = link.partition("#")
        if "://" not in link and target.endswith(".md"):
            linked_file = (path.parent / target).resolve()
            if linked_file.is_relative_to(DOCS):
                links.add(str(linked_file.relative_to(DOCS)) + (f"#{heading}" if heading else ""))
    return links


@pytest.mark.parametrize("question", ANSWERS)
def test_an_answer_is_less_than_three_clicks_away(question: str) -> None:
    reached = links_of("index.md")
    reached |= {link for name in reached for link in links_of(name.partition("#")[0])}
    assert ANSWERS[question] in reached


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_that_a_page_names_are_there(path: Path) -> None:
    named = set(re.findall(r"\w[\w./]*\.(?:py|hpp|cpp)\b", path.read_text()))
    assert not {name for name in named if not any(f"/{file}".endswith(f"/{name}") for file in FILES)}


@pytest.fixture(scope="module")
def members() -> dict[str, set[str]]:
    """Names of methods, fields and read attributes in the body of each class of the package, by the class."""
    by_class: dict[str, set[str]] = {}
    for path in sorted((ROOT / "cloth_sim_ros").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.ClassDef):
                names = {getattr(part, key, None) for part in ast.walk(node) for key in ("name", "attr", "id")}
                by_class[node.name] = {name for name in names if isinstance(name, str)}
    return by_class


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: str(path.relative_to(ROOT)))
def test_members_that_a_page_names_are_there(path: Path, members: dict[str, set[str]]) -> None:
    # The migration page names old members.
    named = re.findall(r"`([A-Z]\w+)\.([a-z_]\w*)\b", path.read_text()) if path.name != "migration.md" else []
    assert not [f"{owner}.{name}" for owner, name in named if owner in members and name not in members[owner]]


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: str(path.relative_to(ROOT)))
def test_page_is_short_enough(path: Path) -> None:
    assert path.name in LONG_PAGES or len(path.read_text().split()) <= MAX_WORDS


def test_every_block_of_the_pages_is_run_or_says_why_not(run_docs: ModuleType) -> None:
    blocks = {name: run_docs.blocks_of((ROOT / name).read_text(), name) for name in run_docs.PAGES}
    assert all(blocks.values())
    assert {f"docs/tutorials/{path.name}" for path in (DOCS / "tutorials").glob("*.md")} < set(blocks)
    assert all(block.words for some in blocks.values() for block in some if block.mark == "skip")


@pytest.mark.parametrize("name", ["README.md", "docs/tutorials/robot.md", "docs/tutorials/library.md"])
def test_python_blocks_run_as_shown(run_docs: ModuleType, name: str) -> None:
    blocks = [block for block in run_docs.blocks_of((ROOT / name).read_text(), name) if block.language == "python"]
    assert blocks
    for block in blocks:
        done = subprocess.run([sys.executable, "-c", block.code], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, f"{block.location}: {done.stderr}"
        assert not block.output or not run_docs.difference(block.output, done.stdout, numbers_vary=block.numbers_vary)


def test_a_block_that_is_neither_run_nor_marked_is_refused(run_docs: ModuleType) -> None:
    with pytest.raises(run_docs.PageError, match=r"page:3: a block of 'yaml'"):
        run_docs.blocks_of("words\n\n```yaml\na: 1\n```\n", "page")


def test_blocks_run_in_a_clean_user_environment(run_docs: ModuleType, tmp_path: Path) -> None:
    # make exports its variables, and `make run` of a page would use ARGS.
    makefile = tmp_path / "Makefile"
    makefile.write_text(f"all:\n\t@{sys.executable} -c 'import json, os; print(json.dumps(dict(os.environ)))'\n")
    command = ["make", "-s", "-f", makefile, "ARGS=--leave-out x", "VENV=other", "PYTHON=python3.12"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    seen = run_docs.user_environment(json.loads(done.stdout))
    assert not {"ARGS", "VENV"} & seen.keys()
    assert not any("--leave-out" in value for value in seen.values())
    assert seen["PYTHON"] == "python3.12"
    assert seen["PATH"]


@pytest.mark.parametrize(
    ("shown", "printed", "vary", "same"),
    [
        ("a 1\nb", "a  1\nb\n", False, True),
        ("a 1", "a 2", False, False),
        ("a 1.5e-3 s", "a 22 s", True, True),
        ("a 1 s", "a 1 m", True, False),
        ("a\n...\nz", "a\nb\nc\nz", False, True),
        ("a\n...\nz", "a\nb\nc", False, False),
        ("a", "a\nb", False, False),
        ("a 1, ... (2 s)", "a 7, b, c (3 s)", True, True),
        ("a 1, ... (2 s)", "a 7, b, c (3 m)", True, False),
    ],
)
def test_outputs_are_compared(run_docs: ModuleType, shown: str, printed: str, vary: bool, same: bool) -> None:
    assert (not run_docs.difference(shown, printed, numbers_vary=vary)) is same
