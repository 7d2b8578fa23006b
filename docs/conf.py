"""Settings of the documentation site: `make docs` builds it with Sphinx, all pages from this repository as it stands.

The source folder is the root of the repository, so that links between pages hold on the site as in the repository.
"""

import os
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent), str(DOCS / "site")]
os.environ["COLUMNS"] = "100"  # of the help of commands

from sphinx.application import Sphinx  # noqa: E402

import femoreg_torch  # noqa: E402

project = "FemoReg Torch"
author = copyright = "The FemoReg Torch developers"
version = release = femoreg_torch.__version__

root_doc = "docs/index"
include_patterns = [
    "docs/**",
    "notebooks/*",
    "examples/README.md",
    "models/weights/*.md",
    "benchmarks/RESULTS.md",
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
]
exclude_patterns = [
    ".venv",
    ".git",
    "out",
    "tests",
    "configs",
    "docs/site",
    "notebooks/out",
    "**/.ipynb_checkpoints",
]

extensions = ["myst_nb", "sphinx.ext.autodoc", "reference_directives"]
myst_heading_anchors = 4
myst_enable_extensions: list[str] = []
nb_execution_mode = "off"  # they are committed as they were executed
suppress_warnings = ["mystnb.unknown_mime_type"]

default_role = "literal"  # docstrings name code in single back quotes
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"FemoReg Torch {release}"
html_extra_path = ["site/root"]
html_static_path = ["site/static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_search_summary = False  # read by `fetch`, which browsers refuse to pages that were opened from disk
pygments_style = "friendly"
# Nothing comes from outside: no widgets of notebooks, no fonts, no formulas by script.
nb_ipywidgets_js: dict[str, dict[str, str]] = {}


def with_title(app: Sphinx, page: str, source: list[str]) -> None:
    """Tables that `femoreg tables` wrote are parts of pages and have no title; on the site they are pages."""
    if page.endswith("/tables") and not source[0].startswith("# "):
        source[0] = f"# All tables\n\n{source[0]}"


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", with_title)
