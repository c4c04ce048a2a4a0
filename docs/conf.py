"""The site, built by `make docs`: Sphinx with the theme furo; pages in Markdown and notebooks are read by MyST-NB."""

import json
import os
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import diffvbd  # noqa: E402
from bench import tables  # noqa: E402

# Tables of all measurements, which are not committed: docs/results.md links to these pages.
RESULTS = tables.write_pages(ROOT / "docs" / "results")

project = "diffvbd"
author = copyright = "diffvbd authors"
version = release = diffvbd.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["images/**"]
# Links to the types of other projects need the internet at each build: DIFFVBD_INTERSPHINX=1 asks for them.
intersphinx_mapping = (
    {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
    }
    if os.environ.get("DIFFVBD_INTERSPHINX")
    else {}
)
nitpicky = True
# Types of other projects, and what is no public name.
nitpick_ignore_regex = [
    ("py:.*", r"(torch|numpy|collections|pathlib|typing)\..*"),
    ("py:.*", r"diffvbd\.\w+\.\w+\.\w+"),
    ("py:.*", r"projections\.\w+|springs"),
]

html_theme = "furo"
html_title = f"diffvbd {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
copybutton_exclude = ".linenos, .gp, .go"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 6

# `make docs` executes notebooks, `make docs NOTEBOOKS=off` does not.
nb_execution_mode = "off"
nb_execution_timeout = 1200  # [s], of one cell, on a busy machine
nb_execution_raise_on_error = True
nb_merge_streams = True

default_role = "code"  # docstrings write names in single backticks
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings state shapes and units, which types do not
autodoc_default_options = {"members": True, "undoc-members": False}
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_use_param = False  # several names share a line of text

CELLS = ((12, "one-line"), (25, "short"), (60, "medium"))  # characters, class

linkcheck_timeout = 20
linkcheck_anchors = False

CONTENTS = """

```{toctree}
:hidden:
:glob:
*
```
"""


def adapt(app: object, docname: str, source: list[str]) -> None:
    """What pages that also have to read well on GitHub leave to the site."""
    text = source[0]
    if docname == "reference/index":
        text += CONTENTS
    if docname == "results":
        text += "\nTables: " + ", ".join(f"[{name}](results/{name}.md)" for name in RESULTS) + ".\n"
    if docname.startswith("results/"):
        text = f"---\norphan: true\n---\n\n{text}"
    if docname == "tutorials/index":
        text = re.sub(r"^\| (\[.*?\]\((.*?\.ipynb)\))", r"| \1 ({download}`notebook <\2>`)", text, flags=re.MULTILINE)
    elif docname.startswith("tutorials/"):
        text = downloadable(docname.removeprefix("tutorials/") + ".ipynb", text)
    # outside of docs/, which Sphinx does not read
    source[0] = re.sub(r"\]\((?:\.\./)+(CONTRIBUTING|CHANGELOG)\.md", lambda m: f"](/{m[1].lower()}.md", text)


def downloadable(name: str, text: str) -> str:
    """A notebook whose first cell links to its file."""
    notebook = json.loads(text)
    notebook["cells"][0]["source"] += ["\n", "\n", f"{{download}}`Download this notebook <{name}>`"]
    return json.dumps(notebook)


def read_docstring(app: object, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """What docstrings write for readers of the text: norms, files of this folder, attributes that share a line."""
    for i, line in enumerate(lines):
        # of "x, v" Sphinx would take x for the type of v
        line = re.sub(r"^:ivar (\w+(?:, \w+)+):", lambda m: f":ivar {m[1].replace(' ', '')}:", line)
        outside = re.split(r"(``.*?``|`[^`]*`)", line)
        lines[i] = "".join(part if k % 2 else text_of(part) for k, part in enumerate(outside))


def text_of(part: str) -> str:
    """Bars are norms and no substitutions; pages become links."""
    return re.sub(r"\bdocs/(\w+)\.md", r":doc:`\1 </\1>`", part.replace("|", r"\|"))


def skip(app: object, what: str, name: str, obj: object, is_skipped: bool, options: object) -> bool | None:
    """Fields of named tuples: the docstring of the class has them."""
    return True if str(getattr(obj, "__doc__", "")).startswith("Alias for field number") else None


def size_cells(app: object, doctree: nodes.document) -> None:
    """Classes for site.css: browsers break 1e-16 at its sign, and make columns of words as narrow as one word."""
    for entry in doctree.findall(nodes.entry):
        length = len(entry.astext())
        entry["classes"].append(next((name for most, name in CELLS if length <= most), "long"))


def setup(app: Any) -> None:
    app.connect("source-read", adapt)
    app.connect("doctree-read", size_cells)
    app.connect("autodoc-process-docstring", read_docstring)
    app.connect("autodoc-skip-member", skip)
