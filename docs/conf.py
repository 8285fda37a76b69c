"""How Sphinx makes the site of ``docs``: ``make docs`` writes it to ``build/docs``."""

from __future__ import annotations

import inspect
import json
import re
from importlib.metadata import version as version_of
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image

from torchrl_her_recipes.reports import page as report_page
from torchrl_her_recipes.reports.tidy import is_results, read_results

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "torchrl-her"
author = "the authors of torchrl-her"
version = release = version_of("torchrl-her")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["examples", "upstream"]  # a program; reports for TorchRL
source_suffix = {".rst": "restructuredtext", ".md": "markdown", ".ipynb": "markdown"}

# Pages in Markdown. They are read in the repository, too, so links in them are those of the repository.
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
# What lies outside of this folder, and the page that shows it here.
PAGES = {
    "../RESULTS.md": "results.md",
    "../CHANGELOG.md": "changelog.md",
    "../results/README.md": "numbers.md",  # so it is called in pages of this folder
    "results/README.md": "numbers.md",  # and in RESULTS.md
    "RESULTS.md": "results.md",  # in CHANGELOG.md
    "recipes/one_file_cher.py": "../recipes/one_file_cher.py",  # in RESULTS.md, for downloading
    "../benchmarks/PROFILE.md": "profile.md",
}
# The numbers of studies: a link to such a folder is, on the site, one to the page that is made of them.
RESULTS = Path(__file__).parent.parent / "results"
REPORTS = sorted(folder.name for folder in RESULTS.iterdir() if is_results(folder))

# Docstrings.
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
autodoc_type_aliases = {"NestedKey": "NestedKey", "Strategy": "Strategy"}
napoleon_numpy_docstring = False
napoleon_use_param = napoleon_use_keyword = False  # keeps several names of one line together
napoleon_custom_sections = [("Attributes", "params_style")]  # listed, not defined a second time
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True

# Every reference within the project has a target; other libraries' pages are not read in.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(collections|pathlib|torch|tensordict|torchrl|numpy|gymnasium|optuna)\..*"),
    ("py:class", r"[^.]*"),  # types that are written as text
    ("py:obj", r"typing\.Literal\[.*"),
    ("py:class", r"ctypes\..*"),
    # Types that appear in signatures and that nobody has to name.
    ("py:class", r"torchrl_her\.replay_buffers\.keys\.TransitionKeys"),
    ("py:class", r"torchrl_her_recipes\.tuning\.search\.SearchResult"),
    ("py:class", r"torchrl_her\.replay_buffers\.runs\.storage\.Field"),
    ("py:class", r"torchrl_her\.native\.job\.Structures"),
    ("py:class", r"torchrl_her\.objectives\.targets\._BuffersToo"),
    ("py:class", r"torchrl_her_envs\.common\.goal_rules\.GoalEnds"),
    ("py:class", r"torchrl_her_envs\.throwing\.arrays\.Array"),
    ("py:class", r"torchrl_her_envs\.throwing\.rendering\.render\.Scene"),
    ("py:class", r"torchrl_her_recipes\.components\.(curricula\.CurriculumState|learner\.AgentShape)"),
    ("py:class", r"torchrl_her_recipes\.reports\.tidy\.Results"),
    ("py:class", r"torchrl_her_recipes\.components\.demonstrations\.RunDemonstrations"),
    ("py:class", r"torchrl_her_recipes\.studies\.(workers\.Workers|study\.StudyResult|plan\.Plan)"),
]

html_theme = "furo"
html_static_path, html_css_files = ["_static"], ["narrow.css"]
html_title = f"torchrl-her {release}"
html_theme_options = {
    "navigation_with_keys": True,
    "light_css_variables": {"code-font-size": "75%", "api-font-size": "85%"},
}
html_copy_source = False
html_show_sphinx = html_show_copyright = False


def link_to_pages(text: str) -> str:
    """Links to files outside of this folder become links to the pages that show them.

    Example:
        >>> link_to_pages("see [results](../RESULTS.md#speed)")
        'see [results](results.md#speed)'
        >>> link_to_pages("the study [ibs](../../results/ibs) in a page of docs/results")
        'the study <a href="ibs/index.html">ibs</a> in a page of docs/results'
        >>> link_to_pages("the study [ibs](results/ibs)")
        'the study <a href="results/ibs/index.html">ibs</a>'
    """
    for file, page in PAGES.items():
        if file.startswith("../"):
            text = text.replace(f"](../{file}", f"](../{page}")  # in pages of a folder here
        text = text.replace(f"]({file}", f"]({page}")
    for name in REPORTS:
        for before, home in (("../../", ""), ("../", "results/"), ("", "results/")):
            link = rf"\[([^\]]+)\]\({re.escape(before)}results/{re.escape(name)}\)"
            text = re.sub(link, rf'<a href="{home}{name}/index.html">\1</a>', text)
    return text


def make_report_pages(app: Sphinx, error: Exception | None) -> None:
    """Makes the page of each study out of its numbers, unless there is one that is newer than them."""
    if error is not None or app.builder.format != "html":
        return
    code = Path(report_page.__file__).parent
    for name in REPORTS:
        out = Path(app.outdir) / "results" / name
        made_of = [*(RESULTS / name).iterdir(), *code.glob("*.py"), *(code.parent / "templates").iterdir()]
        page = out / "index.html"
        if not page.exists() or page.stat().st_mtime < max(file.stat().st_mtime for file in made_of):
            report_page.write_page(read_results(RESULTS / name), out, back="../../results.html")


def notebook_page(text: str, name: str) -> str:
    """A notebook as a page in Markdown: its cells, and the texts and pictures that they showed.

    Example:
        >>> cell = {"cell_type": "code", "source": ["1 + 1"]}
        >>> shown = {"output_type": "execute_result", "data": {"text/plain": ["2"]}}
        >>> print(notebook_page(json.dumps({"cells": [{**cell, "outputs": [shown]}]}), "sum"))
        ```python
        1 + 1
        ```
        <BLANKLINE>
        ```text
        2
        ```
        <BLANKLINE>
        {download}`This page as a notebook <sum.ipynb>`
    """
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        for file, page in PAGES.items():  # notebooks lie one folder deeper
            source = source.replace(f"](../{file}", f"](../{page}")
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                picture = "".join(data["image/png"]).replace("\n", "")
                parts.append(f"![What the cell shows](data:image/png;base64,{picture})")
            else:
                shown = "".join(output.get("text", data.get("text/plain", "")))
                parts.append(f"```text\n{shown.rstrip()}\n```")
    return "\n\n".join([*parts, f"{{download}}`This page as a notebook <{name}.ipynb>`"])


def on_read(app: Sphinx, *event: Any) -> None:
    """A page, or what it includes, was read: its text comes last, in a list."""
    *_, name, text = event
    if str(app.env.doc2path(str(name))).endswith(".ipynb"):
        text[0] = notebook_page(text[0], Path(str(name)).name)
    text[0] = link_to_pages(text[0])


class Unquoted(str):
    """An annotation that is shown as it is written."""

    __slots__ = ()
    __repr__ = str.__str__


def own_signature(cls: type) -> str:
    """How a class is called whose metaclass takes anything: as its ``__init__``. Protocols are not called."""
    if getattr(cls, "_is_protocol", False):
        return ""
    parameters = list(inspect.signature(cls.__init__).parameters.values())[1:]
    written = [
        one if one.annotation is one.empty else one.replace(annotation=Unquoted(one.annotation))
        for one in parameters
    ]
    return str(inspect.Signature(written))


def on_signature(*event: Any) -> tuple[str, str | None] | None:
    """Classes are shown with their own parameters; types that have a name by it, also within others."""
    _, what, _, documented, _, signature, returned = event
    if what == "class" and signature == "(*args, **kwargs)":
        signature = own_signature(documented)
    signature, returned = (
        text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text) for text in (signature, returned)
    )
    return None if signature is None else (signature, returned)


def mark_wide_pictures(app: Sphinx, page: Any, _name: str) -> None:
    """Marks pictures that are more than twice as wide as high, for ``narrow.css``."""
    for node in page.findall(lambda node: node.tagname == "image"):
        path = Path(app.srcdir) / node["uri"]
        if path.suffix in (".png", ".gif") and path.is_file():
            with Image.open(path) as picture:
                node["classes"] += ["wide"] if picture.width > 2 * picture.height else []


def setup(app: Sphinx) -> None:
    app.connect("source-read", on_read)
    app.connect("include-read", on_read)
    app.connect("autodoc-process-signature", on_signature)
    app.connect("doctree-resolved", mark_wide_pictures)
    app.connect("build-finished", make_report_pages)
