# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Word rules: places where names, docstrings, texts and pages leave the project's vocabulary.

`find_violations` reads the tracked text files of a tree and returns, for each rule, the places that break it.
docs/glossary.md defines the vocabulary; test/data/allowed_words.txt lists words that the field uses in one room.
"""

from __future__ import annotations

import ast
import collections
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


#: Parts of names (between underscores and capitals) that have several meanings or none in a textbook.
BANNED = _words(
    "told tell tells overheard companions relief aside herd crew remembered beside rubbed rubs fallen vain judge judged"
    " judgement asks asked narrows outlook laid lays surroundings surrounded movers namesakes rung pierced rivals ours"
    " theirs contest softest gives abreast wanted taker takers mine stance weighed hear heard spent touched touching"
    " halted rests look looks say says found made taken given kept noted ahead own lost narrow somebody whoever"
)
#: Names that carry no meaning when they stand alone.
BANNED_WHOLE = _words(
    "what way place number each here there then far near many few well side one other others rest all_of thing anew"
)
#: Prefixes of bounds; the field writes max_, min_ and n_.
BANNED_PREFIXES = ("most_", "least_", "few_", "fewest_", "FEWEST_", "MOST_", "LEAST_")
#: Words that belong to the field elsewhere and mean something else in this folder.
BANNED_IN_FOLDER = {
    "physics/control": "settled swing share columns calm effort every wait binds",
    "verify": "kick truth shadow",
    "ros": "shadow tape bell turn due behind",
    "engine": "lay held rough sight felt stand meeting lies crowd",
    "contact": "lay held rough felt",
    "studies": "conduct conductor ties bend sure",
    "learning": "conduct conductor ties bend sure",
    "fit": "conduct conductor ties bend sure",
}
QUESTION_OPENER = re.compile(r"^(What|Who|Whom|Whose|Whether|Which|Where|How|When|Whatever|Whoever|The same)\b")
DIALECT = re.compile(
    r"\b(anew|lest|whoever|thereof|wherein|(?:is|are|be|was|were) (?:told|asked|looked at|let|laid)|gives way|let alone"
    r"|those which|as it were|so often|as may be|what is (?:taken|held|told|made)|one more \w+ comes|where there is"
    r"|where it is)\b"
)
#: Verbs in the third person that no docstring of a class begins with: a class is a thing.
CLASS_VERBS = _words(
    "Accumulates Adds Advances Builds Captures Chooses Collects Commands Compares Compiles Computes Converts Decodes"
    " Detects Draws Encodes Executes Finds Forwards Holds Integrates Keeps Logs Makes Maps Measures Moves Owns Pauses"
    " Plays Publishes Reads Receives Refuses Relaxes Renders Restores Sends Serializes Serves Sets Shows Starts Stores"
    " Subscribes Transforms Turns Validates Waits Warns Watches Writes"
)
MAX_SENTENCE_WORDS = 25
MAX_TEST_NAME = 60
SKIPPED_FOLDERS = {"build", "install", "log", "generated", "data", "third_party", "doctest"}
LOG_CALLS = {"info", "warn", "warning", "error", "fatal", "debug", "add_argument"}
CPP_DECLARATION = re.compile(
    r"\b(?:struct|class|void|double|float|bool|int|auto|Index|std::\w+(?:<[^>]*>)?|T|V|Vec3<\w+>)\s+[&*]?([A-Za-z_]\w*)"
)

Violations = dict[str, list[str]]


def find_violations(root: Path, allowed: list[tuple[str, str]]) -> Violations:
    """Return the places that break each rule.

    Args:
        root: folder of a git checkout.
        allowed: pairs (word, path prefix): the word is the field's in files below that path.

    Returns:
        Rule name to a list of `file:line text`; a rule without violations is missing.
    """
    search = _Search(root, allowed)
    for path in tracked_files(root, ".py"):
        search.check_python(path)
    for path in tracked_files(root, ".hpp", ".cpp", ".h", ".c"):
        search.check_cpp(path)
    for path in tracked_files(root, ".md"):
        search.check_page(path)
    for name, places in search.classes.items():
        if len(places) > 1:
            search.violations["classes that occur twice"].append(f"{name}: {', '.join(places)}")
    return dict(search.violations)


def read_allowed(path: Path) -> list[tuple[str, str]]:
    """Read the list of allowed words: `word path-prefix reason`, a line each.

    Raises:
        ValueError: if a line lacks one of the three.
    """
    allowed = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        cells = line.split(None, 2)
        if len(cells) < 3:
            raise ValueError(f"{path.name}: '{line}' gives no reason; write `word path-prefix reason`")
        allowed.append((cells[0], cells[1]))
    return allowed


def tracked_files(root: Path, *endings: str) -> list[Path]:
    """Return the files that git tracks, or could add, with one of the endings."""
    command = ["git", "-C", str(root), "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\n")
    paths = [root / name for name in names if name.endswith(endings)]
    return [path for path in paths if path.exists() and not SKIPPED_FOLDERS & set(path.relative_to(root).parts)]


def name_parts(name: str) -> list[str]:
    """Split a name at underscores and capitals, in lower case."""
    pieces = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    return [piece.lower() for piece in pieces]


class _Search:
    def __init__(self, root: Path, allowed: list[tuple[str, str]]) -> None:
        self.root = root
        self.allowed = allowed
        self.violations: Violations = collections.defaultdict(list)
        self.classes: dict[str, list[str]] = collections.defaultdict(list)

    def check_python(self, path: Path) -> None:
        """Check names, docstrings, comments and texts of a Python file."""
        file = path.relative_to(self.root).as_posix()
        source = path.read_text(encoding="utf-8")
        is_test = file.startswith("test/")
        if any(self._is_banned(part, file) for part in path.relative_to(self.root).with_suffix("").parts):
            self.violations["names of files and folders"].append(file)
        for node in ast.walk(ast.parse(source)):
            where = f"{file}:{getattr(node, 'lineno', 1)}"
            if isinstance(node, ast.ClassDef) and not is_test:
                self.classes[node.name].append(where)
            name = node.name if isinstance(node, ast.FunctionDef) else ""
            if is_test and name.startswith("test_") and len(name) > MAX_TEST_NAME:
                self.violations["names of tests above 60 characters"].append(f"{where} {name}")
            for name, kind in _names(node):
                if self._is_banned(name, file) and not (is_test and name.startswith("test_")):
                    self.violations[f"names of {kind}"].append(f"{where} {name}")
            self._check_texts(node, where)
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                self._check_docstring(ast.get_docstring(node) or "", where, is_test)
            opener = (ast.get_docstring(node) or "").partition(" ")[0] if isinstance(node, ast.ClassDef) else ""
            if opener in CLASS_VERBS and file.startswith("cloth_sim_ros/"):
                self.violations["docstrings of classes that open with a verb"].append(f"{where} {node.name}")
        for line_number, line in enumerate(source.splitlines(), 1):
            comment = re.search(r"(?:^|\s)#:? (.*)", line)
            if comment and not is_test and (match := DIALECT.search(comment.group(1))):
                self.violations["dialect in comments"].append(f"{file}:{line_number} {match.group(0)}")

    def check_cpp(self, path: Path) -> None:
        """Check declared names and comments of a C or C++ file."""
        file = path.relative_to(self.root).as_posix()
        if self._is_banned(path.stem, file):
            self.violations["names of files and folders"].append(file)
        for line_number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            code, _, comment = line.partition("//")
            for name in CPP_DECLARATION.findall(code):
                if self._is_banned(name, file):
                    self.violations["names in C++"].append(f"{file}:{line_number} {name}")
            if match := DIALECT.search(comment):
                self.violations["dialect in comments"].append(f"{file}:{line_number} {match.group(0)}")

    def check_page(self, path: Path) -> None:
        """Check the sentences of a Markdown page; tables, headings and code are left out."""
        file = path.relative_to(self.root).as_posix()
        text = re.sub(r"```.*?```|<!--.*?-->|\$\$.*?\$\$", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        for paragraph in re.split(r"\n\s*\n", text):
            lines = [line for line in paragraph.split("\n") if not line.startswith(("|", "#", "    ", "!["))]
            for entry in re.split(r"\n\s*(?:[-*]|\d+\.)\s", "\n" + "\n".join(lines)):
                if entry.strip():
                    self._check_sentences("pages", entry, file)

    def _check_texts(self, node: ast.AST, where: str) -> None:
        function = node.func if isinstance(node, ast.Call) else None
        is_log = isinstance(function, ast.Attribute) and function.attr in LOG_CALLS
        if not (isinstance(node, ast.Raise) or is_log):
            return
        for part in ast.walk(node):
            text = part.value if isinstance(part, ast.Constant) and isinstance(part.value, str) else ""
            if " " in text and (match := DIALECT.search(text)):
                self.violations["dialect in log and error texts"].append(f"{where} {match.group(0)}")

    def _check_docstring(self, text: str, where: str, is_test: bool) -> None:
        if QUESTION_OPENER.match(text):
            self.violations["docstrings that open with a question word"].append(f"{where} {text.splitlines()[0][:90]}")
        if text and not is_test:
            self._check_sentences("docstrings", re.split(r"\n\s*(?:Args|Returns|Raises):", text)[0], where)

    def _check_sentences(self, kind: str, text: str, where: str) -> None:
        for sentence in re.split(r"(?<=[.?!])\s+", " ".join(text.split())):
            if len(sentence.split()) > MAX_SENTENCE_WORDS:
                self.violations[f"sentences above 25 words in {kind}"].append(f"{where} {sentence[:90]}")
        if match := DIALECT.search(text):
            self.violations[f"dialect in {kind}"].append(f"{where} {match.group(0)}")

    def _is_banned(self, name: str, file: str) -> bool:
        in_folder = {
            word for folder, words in BANNED_IN_FOLDER.items() if f"/{folder}/" in f"/{file}" for word in words.split()
        }
        hits = [part for part in name_parts(name) if part in BANNED or part in in_folder]
        bare = name.strip("_")
        if bare.lower() in BANNED_WHOLE or bare.startswith(BANNED_PREFIXES):
            hits.append(bare.lower())
        return any(not any(hit == word and file.startswith(path) for word, path in self.allowed) for hit in hits)


def _names(node: ast.AST) -> Iterator[tuple[str, str]]:
    if isinstance(node, ast.ClassDef):
        yield node.name, "classes"
    elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        yield node.name, "functions"
        for argument in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]:
            yield argument.arg, "arguments"
    elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
        yield node.attr, "attributes"
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        yield node.id, "variables"
