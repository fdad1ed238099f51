"""The documentation site: `make docs`. Its source folder is the repository, so that the links of all pages hold."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "docs" / "site"), str(ROOT / "src")]

project = "EndoPrior-GS"
root_doc = "docs/index"
include_patterns = ["*.md", "docs/*.md", "docs/notebooks/*.ipynb"]
exclude_patterns = [path.name for path in ROOT.iterdir() if path.is_dir() and path.name != "docs"]

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_nb", "folders", "generated", "mathml"]
default_role = "code"  # docstrings write `names` in single backticks
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
highlight_language = "none"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # notebooks are run by a test and hold their output
nb_ipywidgets_js = {}  # it would come from the network
nb_render_markdown_format = "myst"  # for tables
html_math_renderer = "mathml"

html_theme = "furo"
html_title = project
html_extra_path = ["site/index.html"]
html_copy_source = False
html_show_copyright = False
