"""The documentation site: ``make docs`` builds it from the pages of this folder."""

from __future__ import annotations

import json
import os
import re
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.inspect import signature, stringify_signature

import marl_explore

project = "marl_explore"
author = "The marl_explore authors"
version = release = version_of("marl-explore")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = "marl_explore"
html_show_copyright = False
html_copy_source = False
html_theme_options = {
    "source_repository": "https://github.com/marl-explore/marl_explore/",
    "source_branch": "main",
    "source_directory": "docs/",
}
html_show_sourcelink = False

nitpicky = True
# Types in signatures are names of other libraries, which are not on this site. Docstrings refer to
# nothing by roles, and links of pages are checked by MyST.
nitpick_ignore_regex = [("py:.*", ".*")]
# pages link to sections by the names that GitHub gives them
myst_heading_anchors = 4

# tutorials run at every build: what they show follows the code of the package, which no cache knows
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_show_tb = True  # beside the warning, which is an error under -W
nb_execution_timeout = 600
nb_merge_streams = True
os.environ.pop("MPLBACKEND", None)  # notebooks show their figures

add_module_names = False
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}

RECORDS = Path(__file__).parent / "runs"
SITE = "https://marl-explore.readthedocs.io/en/latest/"


def fit_links(app: Sphinx, docname: str, source: list[str]) -> None:
    """Lead links to a folder or a file outside of docs/ to their page on the site."""
    source[0] = source[0].replace("](../CHANGELOG.md)", "](changelog.md)")
    source[0] = source[0].replace("](runs)", "](runs/README.md)")
    if docname == "runs/README":  # GitHub lists the folder's files by itself
        names = sorted(path.name for path in RECORDS.glob("*.json"))
        source[0] += "\n" + "\n".join(f"- [{name}]({name})" for name in names) + "\n"


def fit_notebooks(app: Sphinx, failed: Exception | None) -> None:
    """Make downloaded notebooks stand alone: their links lead to the site."""
    for path in Path(app.outdir, "_downloads").glob("*/*.ipynb"):
        book = json.loads(path.read_text())
        for cell in book["cells"]:
            if cell["cell_type"] == "markdown":
                text = "".join(cell["source"]).replace("](../", f"]({SITE}")
                text = re.sub(r"\]\((\w+)\.md", rf"]({SITE}tutorials/\1.md", text)
                text = re.sub(rf"(\]\({re.escape(SITE)}[\w/]+)\.md", r"\1.html", text)
                told = r"You can\s+download\s+this\s+page\s+\{nb-download\}`.*?`\s+and run it with"
                cell["source"] = re.sub(told, "It needs", text)
        path.write_text(json.dumps(book, indent=1))


def fit_docstring(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Make a docstring what Sphinx can read."""
    if what == "data" and name.count(".") == 1:  # public names are documented where they are made
        _, name = name.split(".")
        home = ModuleAnalyzer.for_module(f"marl_explore.{marl_explore._HOMES[name]}")
        lines[:] = home.find_attr_docs()["", name]
    code = None  # the indentation of what announced a block of code
    for i, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        if line and code is not None and indent <= code:
            code = None
        if code is None:  # [*B, N] would begin an emphasis, except in ``...``
            lines[i] = re.sub(r"(``.*?``|>>>.*)|\[\*", lambda m: m[1] or r"[\*", line)
            code = indent if line.endswith("::") else None
    if what in (
        "attribute",
        "data",
        "property",
    ):  # whose first words are no type, as napoleon thinks
        lines[:0] = ["..", ""]


def fit_signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, arguments: str | None, result: str
) -> tuple[str | None, str]:
    """The arguments of a class whose metaclass hides them, as that of TensorDict's modules does."""
    if what == "class" and arguments == "(*args, **kwargs)":
        own = signature(obj.__init__, bound_method=True)
        arguments = stringify_signature(own, unqualified_typehints=True)
    return arguments, result


def setup(app: Sphinx) -> None:
    """Register the functions above."""
    app.connect("autodoc-process-signature", fit_signature)
    app.connect("source-read", fit_links)
    app.connect("build-finished", fit_notebooks)
    app.connect("autodoc-process-docstring", fit_docstring, priority=400)  # before napoleon
