"""The site: `python -m sphinx -W docs docs/_build/html` builds it in that folder, without network access; needs the
extra `docs`.

Generated pages (public names, errors, results, notebooks) are written into folders that git ignores.
"""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

from lagjax import __version__  # noqa: E402  (of this checkout)

project, author, copyright = "lagjax", "the authors of lagjax", "the authors of lagjax, Apache-2.0"
release = version = __version__
language = "en"
extensions = [
    "myst_nb",
    "sphinx_copybutton",
    "mathml",
    "api_pages",
    "api_links",
    "notebook_pages",
    "error_pages",
    "result_pages",
]
exclude_patterns = ["_build", "_ext", "_static", "_templates"]
nitpicky = True

html_theme = "pydata_sphinx_theme"
templates_path = ["_templates"]
html_favicon = "_static/icon.svg"
html_context = {"default_mode": "auto"}
html_title = "lagjax"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
# Pages without neighbours; and one whose list would fold with a toggle that has no name for screen readers.
html_sidebars = {name: [] for name in ("index", "first-ten-minutes", "gallery", "generated/measured/*")}
html_theme_options = {
    "navigation_with_keys": False,
    "collapse_navigation": True,
    "show_nav_level": 1,
    "navbar_align": "left",
    "header_links_before_dropdown": 8,
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"
# No scripts for widgets: they would come from the network.
nb_ipywidgets_js = {}
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
copybutton_only_copy_prompt_lines = True
