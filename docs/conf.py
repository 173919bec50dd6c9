"""Sphinx: ``make docs`` builds the site into build/site, without the network, with warnings as errors."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import made_from_code  # noqa: E402 (found by the path above)

import idm_env  # noqa: E402

project = "idm_env"
author = "the idm_env developers"
release = version = idm_env.__version__
extensions = [
    "myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_gallery.gen_gallery",
]  # fmt: skip
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
root_doc = "index"
exclude_patterns = [
    "_site",
    "gallery/*.ipynb",
    "gallery/*.py",
    "gallery/*.md5",
    "gallery/*.json",
    "sg_execution_times*",
    "**/sg_execution_times*",
]
highlight_language = "none"
smartquotes = False  # options begin with two hyphens
html_theme = "furo"
html_title = "idm_env"
html_static_path: list[str] = []
html_show_sphinx = html_show_copyright = False
html_copy_source = False
templates_path: list[str] = []
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
suppress_warnings = ["config.cache"]
nitpicky = False
sphinx_gallery_conf = {
    "examples_dirs": "../build/examples",
    "gallery_dirs": "gallery",
    # Those of seconds; tests/test_examples.py runs all. Others are shown without their output.
    "filename_pattern": r"/(?:add_|drifting_|filter_|first_hour|fit_a_|ring_gradient|step_and)[^/]*\.py$",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_signature": False,
    "remove_config_comments": True,
    "min_reported_time": 1e9,
    "plot_gallery": "True",
    "abort_on_example_error": True,
}


PAGES = {
    "idm_env/tasks/ring.py": "generated/tasks/ring.md",
    "idm_env/tasks/features.py": "generated/features.md",
    "idm_env/tasks/": "generated/environments.md",
    "idm_env/effects/": "generated/effects.md",
    "idm_env/cli/commands.py": "generated/commands.md",
    "examples/first_hour.ipynb": "gallery/first_hour.rst",
    "README.md": "index.md",
}
"""Where a link into the checkout leads on the site: to the page that is made from that file."""


def setup(app: Any) -> None:
    """Write the pages that come from code before anything is read, and let links into the checkout lead to them."""
    made_from_code.write(HERE)
    app.connect("source-read", _links)


def _links(app: Any, name: str, text: list[str]) -> None:
    """Replace links into the checkout by pages of the site, and name what is read in the checkout."""
    up = "../" * name.count("/")
    for file, page in PAGES.items():
        text[0] = text[0].replace(f"]({up}../{file}", f"]({up}{page}")
    text[0] = re.sub(r"\[([^]]+)\]\((?:\.\./)+((?:studies/|idm_env/README)[^)]*)\)", r"\1: `\2`", text[0])
