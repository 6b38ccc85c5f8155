"""The documentation site: `make docs` builds it from the pages beside this file, without network."""

import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

import planner  # noqa: E402

project = "planner"
author = "The slq-planner developers"
release = version = planner.__version__
copyright = author

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"planner {release}"
exclude_patterns = ["_build"]
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath", "deflist"]

default_role = "code"
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
python_use_unqualified_type_names = True
napoleon_use_ivar = True
napoleon_use_rtype = False

_SEEN = {".png", ".gif", ".jpg", ".svg"}
_FIELD = re.compile(r"^(\s*:[^:]*:)(.*)$")


def _links_out_of_the_site(app, docname, source):
    """Links to files beside docs/ become their paths: the site has no copy of the source."""
    here = (HERE / docname).parent

    def told(match):
        text, target = match[1], match[2].split("#")[0]
        path = (here / target).resolve()
        if not target or "://" in target or path.is_relative_to(HERE) or path.suffix in _SEEN:
            return match[0]
        name = path.relative_to(HERE.parent).as_posix()
        return text if name in text else f"{text} (`{name}`)"

    if docname == "index":  # a pattern of pages that are not written yet is no error
        source[0] = re.sub(r"^(\w+)\*\n", lambda m: m[0] if [*HERE.glob(f"{m[1]}*.md")] else "", source[0], flags=re.M)
    source[0] = re.sub(r"(?<!!)\[([^\[\]]+)\]\(([^)\s]+)\)", told, source[0])


def _plain_docstrings(app, what, name, thing, options, lines):
    """Docstrings are plain text with code in backticks: a star or a bar in them is no markup."""
    for i, line in enumerate(lines):
        field = _FIELD.match(line)
        head, rest = (field[1], field[2]) if field else ("", line)
        parts = re.split(r"(``[^`]*``|`[^`]*`)", rest)
        parts[::2] = [re.sub(r"(?<!\\)([*|])|(?<=\w)(_)(?!\w)", r"\\\1\2", part) for part in parts[::2]]
        lines[i] = head + "".join(parts)


def setup(app):
    """Adds both."""
    app.connect("source-read", _links_out_of_the_site)
    app.connect("autodoc-process-docstring", _plain_docstrings, priority=400)  # before napoleon adds markup of its own
