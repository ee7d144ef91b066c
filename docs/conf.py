"""How Sphinx makes a site of these pages: `make docs`. Nothing of it needs the network, to build or to read."""

from __future__ import annotations

import sys
from importlib.metadata import version as version_of
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "chordlab"
version = release = version_of("chordlab")
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "made_from_code",
    "mathml",
]
exclude_patterns = ["_build", "extensions", "**.ipynb_checkpoints", "**/README.md"]
nitpicky = True
# Docstrings name things in plain literals; what annotations name may be another package's, whose index is not here.
nitpick_ignore_regex = [(r"py:.*", r".*")]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # the anchors that forges make
nb_execution_mode = "off"  # a test runs the notebooks; here they are shown as they are stored

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 90
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = f"chordlab {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_show_copyright = False
smartquotes = False  # it makes one dash of an option's two
html_copy_source = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b6e6e", "color-brand-content": "#0b6e6e"},
    "dark_css_variables": {"color-brand-primary": "#6fd3cf", "color-brand-content": "#6fd3cf"},
}
copybutton_only_copy_prompt_lines = False
pygments_style, pygments_dark_style = "a11y-high-contrast-light", "a11y-high-contrast-dark"


def literally(_app: Sphinx, _what: str, _name: str, _of: object, _options: object, lines: list[str]) -> None:
    """Take a | in a docstring for what it is, a bar: of an absolute value."""
    lines[:] = [line.replace("|", r"\|") for line in lines]


def setup(app: Sphinx) -> None:
    """Tell Sphinx."""
    app.connect("autodoc-process-docstring", literally)
