"""How Sphinx builds this documentation: references are made from the code first, then every page with Furo, without network."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from generators import sphinx_steps  # noqa: E402  (its folder is on the path only now)

from twin.store.fingerprint import program_version  # noqa: E402

project = "TacTip twin"
author = "the authors of the TacTip twin"
copyright = "the authors; Apache-2.0"
version = release = program_version()

extensions = ["myst_parser", "sphinx_copybutton"]
exclude_patterns = ["generators"]
templates_path: list[str] = []

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 4
html_math_renderer = "mathml"

html_theme = "furo"
html_title = "TacTip twin"
html_static_path = ["static"]
html_css_files = ["docs.css"]
html_copy_source = False
html_show_sphinx = False
pygments_style = "friendly"
pygments_dark_style = "monokai"


def setup(app):
    """Add this project's own steps."""
    return sphinx_steps.setup(app)
