"""Settings of the documentation site, which ``make docs`` builds; tools/website prepares its pages."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))

from website.names import list_aliases  # noqa: E402

from kineverse import __version__  # noqa: E402

project = "Kineverse"
author = "The Kineverse developers"
copyright = author  # noqa: A001  - the name that Sphinx wants
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "website.extension"]
root_doc = "index"
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
nitpicky = False
maximum_signature_line_length = 88
python_use_unqualified_type_names = True
toc_object_entries = True
toc_object_entries_show_parents = "hide"

myst_enable_extensions = ["dollarmath"]
myst_dmath_allow_space = False
myst_heading_anchors = 4
html_math_renderer = "mathml"

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_inherit_docstrings = True
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = list_aliases()

html_theme = "furo"
pygments_dark_style = "github-dark"
html_title = f"Kineverse {version}"
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_static_path = [str(ROOT / "docs" / "_static")]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
