# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sphinx's settings for the site: `make docs`, or rosdoc2, which runs this file inside one of its own."""

from __future__ import annotations

import importlib.util
import pydoc
import re
from pathlib import Path
from typing import Any

import cloth_sim_ros
from cloth_sim_ros.scene.parameter_page import page

project = "cloth_sim_ros"
author = "cloth_sim_ros authors"
project_copyright = "2026 the cloth_sim_ros authors, Apache-2.0"
release = version = cloth_sim_ros.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
html_theme = "sphinx_rtd_theme"
html_theme_options = {"collapse_navigation": False, "navigation_depth": 2}
html_show_sourcelink = False
# Blocks without a language are commands and outputs.
highlight_language = "none"
html_static_path = ["_static"]
html_css_files = ["tables.css"]

# Links between pages go to headings as GitHub names them.
myst_heading_anchors = 3

templates_path = ["_templates"]
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
python_use_unqualified_type_names = True
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "Array": "Array"}
# Where no ROS is installed the node's page is made all the same.
_ROS = ("rclpy", "tf2_ros", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "rcl_interfaces", "rosgraph_msgs",
        "sensor_msgs", "shape_msgs", "std_msgs", "std_srvs", "visualization_msgs")  # fmt: skip
autodoc_mock_imports = [name for name in _ROS if importlib.util.find_spec(name) is None]
# Types in signatures are those of the code; not each of them has a page.
nitpick_ignore_regex = [("py:.*", ".*")]


def _write_parameters(app: Any) -> None:
    folder = Path(app.srcdir) / "generated"
    folder.mkdir(exist_ok=True)
    (folder / "parameters.md").write_text(page())


def _lead_within(app: Any, name: str, source: list[str]) -> None:
    """CONTRIBUTING.md is a page of the site; elsewhere it lies above the pages."""
    source[0] = source[0].replace("](../CONTRIBUTING.md", "](contributing.md")


def _hide_colon(app: Any, kind: str, name: str, member: Any, options: Any, lines: list[str]) -> None:
    """Napoleon takes the words before the first colon as the type of an attribute."""
    if kind in ("attribute", "data", "property") and lines:
        lines[0] = lines[0].replace(": ", "\0 ")


def _show_colon(app: Any, kind: str, name: str, member: Any, options: Any, lines: list[str]) -> None:
    lines[:] = [line.replace("\0 ", ": ") for line in lines]


def _mark_old_name(app: Any, kind: str, name: str, member: Any, options: Any, lines: list[str]) -> None:
    """An old name has the docstring of the new one."""
    owner, _, leaf = name.rpartition(".")
    for base in getattr(pydoc.locate(owner), "__mro__", ()):
        entry = vars(base).get(leaf)
        if entry is not None:
            if type(entry).__name__ == "_OldName":
                lines[:] = [f"Old name of `{entry._new}`, for one release."]
            return


def _shorten_aliases(
    app: Any, kind: str, name: str, member: Any, options: Any, signature: str | None, result: str | None
) -> tuple[str | None, ...]:
    """Sphinx writes an alias within a union as an object of its own."""
    return tuple(text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text) for text in (signature, result))


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", _hide_colon, priority=400)
    app.connect("autodoc-process-docstring", _show_colon, priority=600)
    app.connect("autodoc-process-signature", _shorten_aliases)
    app.connect("autodoc-process-docstring", _mark_old_name, priority=700)
    app.connect("builder-inited", _write_parameters, priority=1)
    app.connect("source-read", _lead_within)
