"""HTML of cards in notebooks, as a parser reads it."""

from html.parser import HTMLParser

# Elements without an end tag.
_EMPTY = {"br", "img", "meta", "input", "hr", "link"}


class Parsed(HTMLParser):
    """The elements of a card: it fails where a tag is not closed, or closed by another one.

    Attributes
    ----------
    tags : set of str
        All elements of the card, without those of the page in a frame.
    titles : list of str
        Texts that browsers show while the pointer is on a mark.
    frames : list of dict
        Attributes of each frame.
    verdicts : list of tuple of str
        Class and text of each paragraph that has a class.
    text : str
    """

    def __init__(self, card):
        super().__init__(convert_charrefs=True)
        self.tags, self.titles, self.frames = set(), [], []
        self.verdicts, self.text, self._open = [], "", []
        self.feed(card)
        self.close()
        assert not self._open, f"not closed: {self._open}"

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        assert len(given) == len(attrs), f"an attribute of {tag} is given twice"
        self.tags.add(tag)
        if tag == "iframe":
            self.frames.append(given)
        if tag == "title":
            self.titles.append("")
        if tag == "p" and "class" in given:
            self.verdicts.append((given["class"], ""))
        if tag not in _EMPTY:
            self._open.append((tag, given))

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in _EMPTY:
            self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self._open, f"{tag} is closed but not open"
        assert self._open[-1][0] == tag, f"{tag} is closed in {self._open[-1][0]}"
        self._open.pop()

    def handle_data(self, data):
        tags = [tag for tag, _ in self._open]
        if "style" in tags:
            return
        self.text += data
        if tags and tags[-1] == "title":
            self.titles[-1] += data
        verdict = any(tag == "p" and "class" in given for tag, given in self._open)
        if verdict:
            kind, text = self.verdicts[-1]
            self.verdicts[-1] = kind, text + data
