"""The documentation site: `make docs` builds it from the pages beside this file, without network."""

import base64
import io
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
html_math_renderer = "mathtext"  # MathJax would come from the network
html_theme = "furo"
html_title = f"planner {release}"
html_static_path = html_css_files = ["site.css"]
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


def _formula(visitor, node):
    """A formula as a picture by Matplotlib, whose mathtext knows all but a few commands of LaTeX."""
    from docutils import nodes
    from matplotlib.font_manager import FontProperties
    from matplotlib.mathtext import math_to_image

    text, picture = node.astext().strip(), io.BytesIO()
    tex = re.sub(r"\\tfrac(\d)(\d)", r"\\frac{\1}{\2}", " ".join(text.split()))
    depth = math_to_image(f"${tex}$", picture, FontProperties(size=13), dpi=72, format="svg")
    source = f"data:image/svg+xml;base64,{base64.b64encode(picture.getvalue()).decode()}"
    style = f"vertical-align: {-depth:.1f}px" if isinstance(node, nodes.math) else "display: block; margin: 1em auto"
    visitor.body.append(f'<img class="no-scaled-link" style="{style}" src="{source}" alt="{visitor.attval(text)}">')
    raise nodes.SkipNode


def setup(app):
    """Adds all three."""
    app.add_html_math_renderer("mathtext", (_formula, None), (_formula, None))
    app.connect("source-read", _links_out_of_the_site)
    app.connect("autodoc-process-docstring", _plain_docstrings, priority=400)  # before napoleon adds markup of its own
