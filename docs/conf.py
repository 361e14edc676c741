"""Configuration of the documentation site: ``sphinx-build -W docs site``."""

import sys
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

from numpydoc.xref import DEFAULT_LINKS

import fflin

project = "fflin"
author = "The fflin developers"
copyright = "the fflin developers, BSD-2-Clause"
version = release = fflin.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "numpydoc",
    "sphinx_copybutton",
    "executed",
    "excerpts",
    "from_code",
    "index_terms",
    "notebooks",
]
exclude_patterns = ["_*"]
templates_path = ["_templates"]

# Pages are plain Markdown with tables, formulas and links to headings. Pages with a Jupytext
# header are executed.
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_timeout = 900
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_render_markdown_format = "myst"

# The reference, from the docstrings.
default_role = "py:obj"
add_module_names = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autosummary_ignore_module_all = False
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
# Links to public names only: numpydoc links to other sites.
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = {
    **{name: name for name in DEFAULT_LINKS},
    **{name: f"fflin.{name}" for name in fflin.__all__},
}
toc_object_entries = False

html_theme = "furo"
html_title = f"fflin {release}"
html_static_path = ["_static"]
html_logo = "_static/logo.svg"
html_favicon = "_static/logo.svg"
html_css_files = ["fflin.css"]
html_js_files = ["from_disk.js", "hero.js"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
copybutton_exclude = ".linenos, .gp, .go"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# Formulas without a network: MathJax is part of the site, and its SVG output needs no fonts.
_mathjax = find_spec("sphinx-mathjax-offline")
assert _mathjax is not None and _mathjax.origin is not None, "pip install -e '.[docs]'"
html_static_path.append(str(Path(_mathjax.origin).parent / "static/mathjax/tex-svg.js"))
mathjax_path = "tex-svg.js"
