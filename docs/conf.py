"""How Sphinx makes the site: `make docs`."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from pwatrack.version import __version__  # noqa: E402

project = "pwatrack"
author = "the pwatrack developers"
copyright = "the pwatrack developers, GPL-3.0-or-later"  # noqa: A001
version = release = __version__

extensions = ["myst_parser", "docs.ext.site"]
exclude_patterns = ["_build", "generated"]
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
math_numfig = False
html_math_renderer = "mathml"

html_theme = "furo"
html_title = f"pwatrack {__version__}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
pygments_style = "friendly"
