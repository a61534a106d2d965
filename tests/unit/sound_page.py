"""What every page must hold to: closed tags, no address outside itself, a text for every picture."""

import re
from html.parser import HTMLParser
from urllib.parse import unquote

VOID = {"meta", "img", "source", "br", "hr", "input", "link"}
ADDRESSES = {"src", "href", "srcset", "action", "poster", "data"}


class PageReader(HTMLParser):
    """Reads a page strictly.

    Attributes
    ----------
    text : str
        All text outside style and script.
    addresses : list of str
        Of links and pictures, in their order.
    alts : list
        Of the pictures; None where one has none.
    tags : list of str
    """

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.text, self.addresses, self.alts, self.tags, self._open = "", [], [], [], []
        self.feed(html)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in VOID:
            self._open.append(tag)
        values = dict(attrs)
        assert len(values) == len(attrs), f"<{tag}> has an attribute twice: {attrs}"
        assert not [name for name in values if name.startswith("on")], f"<{tag}> holds a script: {attrs}"
        self.addresses += [value for name, value in attrs if name in ADDRESSES]
        if tag == "img":
            self.alts.append(values.get("alt"))

    def handle_endtag(self, tag):
        assert self._open and self._open[-1] == tag, f"</{tag}> ends <{self._open[-1] if self._open else 'nothing'}>"
        self._open.pop()

    def handle_data(self, data):
        if not {"style", "script"} & set(self._open):
            self.text += data


def read_sound_page(html: str, folder=None) -> PageReader:
    """A page that was read, after the laws were asserted; with its folder, the pictures it shows must lie there."""
    page = PageReader(html)
    for address in page.addresses:
        assert not re.match(r"(?!data:image/)[a-zA-Z][a-zA-Z0-9+.-]*:|//", address), f"leads out of the page: {address[:80]}"
    assert not re.search(r"@import|url\(", html), "the stylesheet loads something"
    assert all(alt and alt.strip() for alt in page.alts), f"a picture without a text: {page.alts}"
    if folder is not None:
        shown = [address for address in page.addresses if not address.startswith(("data:", "#"))]
        assert [name for name in shown if not (folder / unquote(name)).is_file()] == [], "files that are not there"
    return page
