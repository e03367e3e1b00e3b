"""Settings of Sphinx for the site; see build.py."""

from __future__ import annotations

import re
from typing import Any

from tactflow import __version__

project = "tactflow"
author = "tactflow developers"
copyright = author
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.githubpages",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
myst_heading_anchors = 4
myst_enable_extensions = ["html_image"]
exclude_patterns = ["examples", "pipelines", "plugins"]
# `name` in a docstring is code.
default_role = "code"
autodoc_default_options = {"members": True, "inherited-members": "BaseModel,Exception,str,tuple,int"}
autodoc_typehints = "none"
napoleon_google_docstring = False
napoleon_use_rtype = False
# Attributes are a list: as entries of their own they would stand twice, beside the properties.
napoleon_use_ivar = True
sphinx_gallery_conf = {
    "examples_dirs": "examples/gallery",
    "gallery_dirs": "gallery",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "write_computation_times": False,
    "min_reported_time": 1e9,
    "remove_config_comments": True,
    "abort_on_example_error": True,
}

html_theme = "pydata_sphinx_theme"
html_title = "tactflow"
html_static_path = ["static"]
html_extra_path = ["measured"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
html_theme_options = {
    "show_prev_next": True,
    "header_links_before_dropdown": 6,
    "footer_start": ["sphinx-version"],
    "footer_end": ["theme-version"],
}
html_sidebars = {"accuracy": [], "peers": [], "changes": []}


def itemize(_app: Any, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Make a list of the lines `name : meaning` above the sections of a docstring, and entries in them."""
    underlines = [index for index, line in enumerate(lines) if re.fullmatch(r"-{3,}", line)]
    end = underlines[0] - 1 if underlines else len(lines)
    made: list[str] = []
    listed = False
    for line in lines[:end]:
        starts = re.match(r"\w[\w, ]* : ", line) is not None
        listed = starts or (listed and line.startswith("  "))
        if starts or (not listed and made and made[-1].startswith(("* ", "  "))):
            made.append("")
        made.append(f"* {line}" if starts else f"  {line.strip()}" if listed else line)
    entries: list[str] = []
    for line in lines[end:]:
        entry = re.fullmatch(r"(\*{0,2}\w[\w, *]*) : (.+)", line)
        entries += [line] if entry is None else [entry[1], f"    {entry[2]}"]
    lines[:] = [*made, *entries]


def setup(app: Any) -> None:
    """Register the hook before napoleon's."""
    app.connect("autodoc-process-docstring", itemize, priority=100)
