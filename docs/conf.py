"""How Sphinx makes the site of ``docs``: ``make docs`` writes it to ``build/docs``."""

from __future__ import annotations

from importlib.metadata import version as version_of
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from sphinx.application import Sphinx

project = "torchrl-her"
author = "the authors of torchrl-her"
version = release = version_of("torchrl-her")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["examples", "results"]  # a program, and the numbers behind the figures

# Pages in Markdown. They are read in the repository, too, so links in them are those of the repository.
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
# What lies outside of this folder, and the page that shows it here.
PAGES = {"../RESULTS.md": "results.md", "../CHANGELOG.md": "changelog.md", "benchmarks/PROFILE.md": "profile.md"}

# Docstrings.
autodoc_default_options = {"members": True, "show-inheritance": True, "member-order": "bysource"}
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
autodoc_type_aliases = {"NestedKey": "NestedKey", "Strategy": "Strategy"}
napoleon_numpy_docstring = False
napoleon_use_ivar = True  # attributes are listed, not defined a second time
napoleon_custom_sections = []
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = f"torchrl-her {release}"
html_theme_options = {"navigation_with_keys": True}
html_copy_source = False
html_show_sphinx = False


def link_to_pages(text: str) -> str:
    """Links to files outside of this folder become links to the pages that show them.

    Example:
        >>> link_to_pages("see [results](../RESULTS.md#speed)")
        'see [results](results.md#speed)'
    """
    for file, page in PAGES.items():
        text = text.replace(f"]({file}", f"]({page}")
    return text


def on_read(app: Sphinx, document: str, source: list[str]) -> None:
    source[0] = link_to_pages(source[0])


def on_include(app: Sphinx, path: Path, document: str, source: list[str]) -> None:
    source[0] = link_to_pages(source[0])


def setup(app: Sphinx) -> None:
    app.connect("source-read", on_read)
    app.connect("include-read", on_include)
