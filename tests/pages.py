"""Reports read by tests: text, media and tags."""

import re
from html.parser import HTMLParser

from planner.view.report.page import write_report


class Page(HTMLParser):
    """Reads a page: its text, the sources of its media, its tags; fails when tags are not closed in order."""

    VOID = frozenset({"meta", "img"})

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.sources, self.words = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)


def page_of(plan, proof, folder, note=""):
    return Page(write_report(plan, proof, folder, note).read_text(encoding="utf-8"))
