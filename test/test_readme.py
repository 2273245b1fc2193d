# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Examples and links of the README."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
#: Generated when the site is built.
GENERATED = ROOT / "docs" / "generated"
WRITTEN = [page for page in sorted((ROOT / "docs").rglob("*.md")) if page.parent != GENERATED]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *WRITTEN]


@pytest.mark.parametrize("index", range(len(EXAMPLES)))
def test_an_example_runs_as_printed(index):
    assert len(EXAMPLES[index].splitlines()) <= 20
    done = subprocess.run(
        [sys.executable, "-c", EXAMPLES[index]], cwd=ROOT, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_to_files(page):
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text())
    places = {link: (page.parent / link).resolve() for link in links if "://" not in link}
    missing = [link for link, at in places.items() if not at.exists() and at != GENERATED / "parameters.md"]
    assert not missing
