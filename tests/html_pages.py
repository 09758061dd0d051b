"""Reader of report pages for the tests."""

import base64
import html.parser
import io
import re

import numpy as np
from matplotlib.image import imread

VOID = {"meta", "img", "br"}


class Page(html.parser.HTMLParser):
    """Checks that tags close in order; gathers text and what the page refers to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.sources: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.sources += [str(value) for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(path):
    """The page's parser and its text; it needs nothing but itself, and its pictures are drawn."""
    text = path.read_text()
    page = Page(text)
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    # neither a script nor an address: it works without network
    assert not re.search(r"<script|http|url\(|@import|<link", text)
    assert "prefers-color-scheme: dark" in text
    assert "width=device-width" in text
    for source in page.sources:
        picture = imread(io.BytesIO(base64.b64decode(source.partition(",")[2])))
        assert np.mean(picture[..., :3] < 0.95) > 0.005
    return page, " ".join(" ".join(page.text).split())
