"""Reading pages as markup."""

from html.parser import HTMLParser

VOID = {"meta", "link", "input", "br", "img"}


class Markup(HTMLParser):
    """Elements with their attributes; fails on a tag that is closed out of turn."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self._open: list[str] = []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag, tag

    def ids(self):
        return [attributes["id"] for _, attributes in self.elements if "id" in attributes]
