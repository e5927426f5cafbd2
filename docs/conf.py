"""Sphinx configuration; pages of commands and settings are written from the code while Sphinx reads them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import reference
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

import derender

project = "derender"
copyright = "the derender authors"
version = release = derender.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence", "dollarmath", "deflist", "attrs_inline"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "derender"
html_static_path = ["style"]
html_css_files = ["site.css"]
smartquotes_action = "qe"  # `--option` keeps its two hyphens
html_show_sphinx = False
html_copy_source = False
pygments_style, pygments_dark_style = "friendly", "monokai"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
maximum_signature_line_length = 80
autodoc_default_options = {"members": True, "undoc-members": False}
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_use_ivar = True
suppress_warnings = ["ref.python"]
nitpicky = False


html_math_renderer = "mathml"  # drawn by the browser itself: no script from elsewhere


def math(self, node):
    """A formula as MathML."""
    block = not isinstance(node, nodes.math)
    self.body.append(tex2mathml(node.astext(), as_block=block))
    raise nodes.SkipNode


def setup(app):
    app.connect("source-read", reference.fill)
    app.add_html_math_renderer("mathml", (math, None), (math, None))
