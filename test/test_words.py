# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Vocabulary of the tree: names, docstrings, texts and pages follow docs/glossary.md."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from support.word_rules import find_violations, read_allowed, tracked_files

ROOT = Path(__file__).resolve().parent.parent
ALLOWED = Path(__file__).resolve().parent / "data" / "allowed_words.txt"

BAD_MODULE = '''"""What gives way."""

MOST_RUNS = 3


class Herd:
    """A pool that is told each result of every run, of each of its threads, of all processes, of every node and of each
    machine that takes part in a study."""

    def run(self, told):
        # It is asked again.
        self.found = told
        place = 1
        raise ValueError(f"the run is told {place}")


class Herd:
    """Keeps a second one."""
'''
BAD_TEST = "def test_a_name_that_tells_a_whole_story_of_what_a_test_does_and_why_it_is_there(): ...\n"
BAD_PAGE = "The node is told the target.\n\n" + "word " * 26 + "end.\n"
BAD_HEADER = "double lost;  // is asked\n"


def test_tree_follows_the_glossary() -> None:
    violations = find_violations(ROOT, read_allowed(ALLOWED))
    lines = [f"{rule}: {entry}" for rule, entries in sorted(violations.items()) for entry in entries]
    assert not lines, f"{len(lines)} places:\n" + "\n".join(lines[:40])


def test_names_of_the_glossary_are_in_the_code() -> None:
    rows = re.findall(
        r"^\| [^|]+ \| `([^`]+)` \|", (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert len(rows) > 60
    paths = tracked_files(ROOT, ".py", ".hpp")
    words = set()
    for path in paths:
        if path.is_relative_to(ROOT / "cloth_sim_ros"):
            words |= {path.name, path.stem, *re.findall(r"\w+", path.read_text(encoding="utf-8"))}
    assert not [name for name in rows if name not in words]


@pytest.fixture
def bad_tree(tmp_path: Path) -> Path:
    for name, text in {
        "cloth_sim_ros/batch/crew.py": BAD_MODULE,
        "test/test_story.py": BAD_TEST,
        "docs/page.md": BAD_PAGE,
        "cloth_sim_ros/engine/law.hpp": BAD_HEADER,
    }.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    return tmp_path


def test_each_rule_finds_its_violation(bad_tree: Path) -> None:
    counts = {rule: len(places) for rule, places in find_violations(bad_tree, []).items()}
    assert counts == {
        "classes that occur twice": 1,
        "dialect in comments": 2,
        "dialect in docstrings": 2,
        "dialect in log and error texts": 1,
        "dialect in pages": 1,
        "docstrings of classes that open with a verb": 1,
        "docstrings that open with a question word": 1,
        "names in C++": 1,
        "names of arguments": 1,
        "names of attributes": 1,
        "names of classes": 2,
        "names of files and folders": 1,
        "names of tests above 60 characters": 1,
        "names of variables": 2,
        "sentences above 25 words in docstrings": 1,
        "sentences above 25 words in pages": 1,
    }


def test_allowed_word_counts_in_its_folder_only(bad_tree: Path) -> None:
    everywhere = len(find_violations(bad_tree, [])["names of attributes"])
    assert everywhere == 1
    assert "names of attributes" not in find_violations(bad_tree, [("found", "cloth_sim_ros/batch/")])
    assert len(find_violations(bad_tree, [("found", "cloth_sim_ros/ros/")])["names of attributes"]) == 1


def test_allowed_word_without_reason_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "allowed.txt"
    path.write_text("# comment\nkick cloth_sim_ros/physics leapfrog: Hairer, Lubich, Wanner, I.1.4\n")
    assert read_allowed(path) == [("kick", "cloth_sim_ros/physics")]
    path.write_text("kick cloth_sim_ros/physics\n")
    with pytest.raises(ValueError, match="gives no reason"):
        read_allowed(path)
