"""Links of all documents, without network: each leads to a file of the repository, and to a heading that is there."""

import re
from functools import cache

import pytest
from places import ROOT

_HIDDEN = re.compile(r"```.*?```|`[^`\n]*`", re.S)  # code is no link
_LINK = re.compile(r"\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#{1,6} +(.+?) *$", re.M)

DOCUMENTS = sorted(
    page
    for place in ("", "docs", "examples", "benchmarks", "renders", "mjcf")
    for page in ((ROOT / place).rglob("*.md") if place else ROOT.glob("*.md"))
    if not {"_build", ".venv"} & set(page.relative_to(ROOT).parts)
)


@cache
def anchors(page):
    """What GitHub and the site call the headings of a page."""
    found = []
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for heading in _HEADING.findall(text):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        found.append(slug if slug not in found else f"{slug}-{sum(one.startswith(slug) for one in found)}")
    return found


@cache
def described():
    """What the reference describes; one of its pages may link to a name on any other."""
    pages = [page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md")]
    return {name for page in pages for name in re.findall(r"^\.\. (?:auto|py:)\w+:: (\S+)$", page, re.M)}


def broken_links(page):
    """Links of a page to what is not there."""
    shown = _HIDDEN.sub(lambda code: re.sub(r"[\[\]()]", "", code[0]), page.read_text(encoding="utf-8"))
    broken = []
    for target in _LINK.findall(shown):
        if re.match(r"\w+://|mailto:", target):
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        if path and not (place.exists() and place.is_relative_to(ROOT)):
            broken.append(f"{target}: there is no such file")
        elif anchor and anchor not in anchors(place) and anchor not in described():
            broken.append(f"{target}: that page has the headings {', '.join(anchors(place))}")
    return broken


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
    assert broken_links(page) == []


def test_the_documents_that_are_read_first_are_among_them():
    names = {page.relative_to(ROOT).as_posix() for page in DOCUMENTS}
    assert {"README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/index.md", "docs/api/planner.md"} <= names


def test_a_link_that_leads_nowhere_is_found(tmp_path):
    page = ROOT / "docs" / "start.md"
    lost = tmp_path / "page.md"
    lost.write_text("[a](none.md) [b](#here) [c](#there) `[d](code.md)`\n# Here\n[e](https://example.org)\n")
    assert broken_links(page) == []
    assert [one.split(":")[0] for one in broken_links(lost)] == ["none.md", "#there"]
