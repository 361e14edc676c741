"""Parser that turns bytes into a small tree of XML elements, each with its line number."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from xml.parsers import expat

from fflin.base.errors import UrdfError, listed

# URDFs are about 10 elements deep. Much deeper documents would exceed Python's recursion limit.
_DEPTH_LIMIT = 100

# Large URDFs contain about 10,000 elements. Millions would fill the memory.
_ELEMENT_LIMIT = 500_000
_TAG_LIMIT = 2**20  # bytes

# No physical value is larger than this, and the product of two such numbers does not overflow.
_LARGEST = 1e30

# Least similarity (0 to 1) at which an unknown attribute counts as misspelt. For example, "xzy" is
# similar to "xyz", and "quat" to "quat_xyzw", but "unit" is not similar to "value".
_NEAR = 0.6

_SPACE = " \t\r\n"
_DECIMAL = re.compile(
    r"[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?|inf(inity)?)",
    re.IGNORECASE | re.ASCII,
)


@lru_cache(128)  # a file repeats a few names many times
def nearest(name: str, known: tuple[str, ...], cutoff: float) -> str | None:
    """Return the known name most similar to `name`; None if its similarity is below `cutoff`."""
    import difflib

    return next(iter(difflib.get_close_matches(name, known, n=1, cutoff=cutoff)), None)


@dataclass(eq=False, repr=False, slots=True)
class Element:
    """XML element; its text content is not stored, because URDF uses only attributes."""

    tag: str  # may include a prefix, which need not be bound to a namespace
    attributes: dict[str, str]
    line: int  # line of its start tag
    origin: str  # name of the document in errors: the path of the file
    # innermost link or joint that this element is or belongs to, as "joint 'a'"
    owner: str = ""
    children: list[Element] = field(default_factory=list)
    # {warning: line numbers}; all elements of a document share this dictionary.
    notes: dict[str, list[int]] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Name of this element for messages, such as "<axis> of joint 'a'"."""
        if self.owner.startswith(f"{self.tag} "):
            return self.owner
        if not self.owner:
            return f"<{self.tag}>"
        return f"<{self.tag}> of {self.owner}"

    def error(self, message: str) -> UrdfError:
        """Build an error that names the file and line of this element."""
        return UrdfError(f"{self.origin}:{self.line}: {message}")

    def note(self, message: str) -> None:
        """Add a warning about this element; a repeated warning appears once, with a count."""
        self.notes.setdefault(message, []).append(self.line)

    def find_all(self, tag: str) -> list[Element]:
        """Return the children with a tag."""
        return [child for child in self.children if child.tag == tag]

    def find(self, tag: str, *attributes: str) -> Element | None:
        """Return the only child with a tag, or None; raise `UrdfError` for a second child.

        If `attributes` are given, they are the known attributes of the child. An unknown attribute
        of the child raises `UrdfError` if it is similar to a known one; otherwise it causes a note.
        """
        children = self.find_all(tag)
        if len(children) > 1:
            raise children[1].error(
                f"{self.title} has a second <{tag}>; the first <{tag}> is in line "
                f"{children[0].line}; keep one of them"
            )
        if not children:
            return None
        child = children[0]
        if attributes:
            for name in (
                x for x in child.attributes if x not in attributes and ":" not in x
            ):
                if nearest(name.lower(), attributes, _NEAR):
                    raise child.error(
                        f"{child.title} has an unknown attribute {quoted(name)}; known: "
                        f"{', '.join(attributes)}; correct it or remove it"
                    )
                child.note(
                    f"attribute {quoted(name)} of <{tag}> is not part of URDF, and is ignored"
                )
        return child

    def require(self, tag: str, *attributes: str) -> Element:
        """Return the child that `find` returns, or raise `UrdfError` if there is none."""
        child = self.find(tag, *attributes)
        if child is None:
            raise self.error(f"{self.title} has no <{tag}>; add it")
        return child

    def refuse_near_miss(self, *known: str) -> None:
        """Raise `UrdfError` if the tag of a child is a misspelt known tag.

        Other unknown tags are ignored.
        """
        for child in self.children:
            near = child.tag not in known and ":" not in child.tag
            if near and (meant := nearest(child.tag.lower(), known, 0.85)):
                raise child.error(
                    f"<{child.tag}> in {self.title} is unknown; did you mean <{meant}>?"
                )

    def iterate(self, skip: Collection[str] = ()) -> Iterator[Element]:
        """Yield all elements below this element in document order.

        Elements whose tags are in `skip` are omitted, with all elements below them.
        """
        for child in self.children:
            if child.tag not in skip:
                yield child
                yield from child.iterate(skip)

    def text(self, name: str) -> str:
        """Return an attribute, or raise `UrdfError` if it is missing or empty."""
        value = self.attributes.get(name)
        if value is None or not value.strip():
            problem = "has no" if value is None else "has an empty"
            raise self.error(
                f"{self.title} {problem} '{name}'; write <{self.tag} {name}=\"...\">"
            )
        return value

    def number(self, name: str, default: float | None = None) -> float:
        """Return an attribute as a decimal number; return `default` if it is missing.

        Raise `UrdfError` if the attribute is missing and has no default, or if it is not a number
        with a magnitude of at most 1e30.
        """
        if default is not None and name not in self.attributes:
            return default
        return self.vector(name, 1)[0]

    def vector(self, name: str, size: int) -> tuple[float, ...]:
        """Return an attribute as `size` decimal numbers with magnitudes of at most 1e30."""
        text = self.text(name)
        entries = re.split(rf"[{_SPACE}]+", text.strip(_SPACE))
        values = tuple(map(decimal, entries))
        wrong = [
            entry
            for entry, x in zip(entries, values, strict=True)
            if not abs(x) <= _LARGEST
        ]
        if len(values) != size or wrong:
            given = f"{quoted(text)}, which has {len(values)} entries"
            if len(values) == size:
                given = quoted(wrong[0])
            wanted = f"a finite number, such as 0.5, of at most {_LARGEST:g}"
            if size > 1:
                wanted = f"{size} finite numbers of at most {_LARGEST:g}"
                wanted += ", separated by spaces, without commas"
            raise self.error(f"{name} of {self.title} is {given}; expected {wanted}")
        return values


def decimal(text: str) -> float:
    """Return the value of a text that is a decimal number or "inf"; NaN for any other text."""
    if not _DECIMAL.fullmatch(text):
        return math.nan
    return float(text)


def quoted(text: str) -> str:
    """Return text from a file for an error message: quoted, short, printable and on one line."""
    if len(text) > 60:
        text = f"{text[:57]}..."
    return repr(text)


def enumerated(names: Iterable[str]) -> str:
    """Join quoted names for a sentence: give the first six, and count the others."""
    return listed(map(quoted, names))


def named(kind: str, names: Sequence[str]) -> str:
    """Return a noun with quoted names, such as "joint 'a'" or "joints 'a', 'b'"."""
    plural = "s" if len(names) > 1 else ""
    return f"{kind}{plural} {enumerated(names)}"


def notes_of(root: Element) -> list[str]:
    """Return the notes about a document, with one line for each note."""
    # Notes are saved with the robot. Therefore they contain the name of the file, but not its
    # folder, which may differ on another computer.
    origin = root.origin.rpartition(os.sep)[2]
    notes = []
    for message, lines in root.notes.items():
        note = f"{origin}:{lines[0]}: {message}"
        if len(lines) > 1:
            note += f" (also {len(lines) - 1} more times)"
        notes.append(note)
    return notes


def parse(document: bytes, origin: str) -> Element:
    """Parse a document in its declared encoding, and return its root; refuse <!DOCTYPE>."""
    top = Element("", {}, 0, origin)
    opened = [top]
    count = 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        owner, line = opened[-1].owner, parser.CurrentLineNumber
        if tag in ("link", "joint") and attributes.get("name", "").strip():
            owner = f"{tag} {quoted(attributes['name'])}"
        element = Element(tag, attributes, line, origin, owner, [], top.notes)
        if len(opened) > _DEPTH_LIMIT:
            raise element.error(
                f"more than {_DEPTH_LIMIT} elements deep; find the missing end tag"
            )
        nonlocal count
        if (count := count + 1) > _ELEMENT_LIMIT:
            raise element.error(
                f"more than {_ELEMENT_LIMIT} elements; reduce it to the robot"
            )
        opened[-1].children.append(element)
        opened.append(element)

    def refuse_document_type(*_: object) -> None:
        # A document type can declare entities, which can read other files or expand to any length.
        raise UrdfError(
            f"{origin}:{parser.CurrentLineNumber}: document types (<!DOCTYPE>) and entities are "
            "not supported; remove the declaration and replace each entity by its text"
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: opened.pop()
    parser.StartDoctypeDeclHandler = refuse_document_type
    try:
        for begin in range(0, len(document), _TAG_LIMIT):
            parser.Parse(document[begin : begin + _TAG_LIMIT], False)
            if begin - parser.CurrentByteIndex > _TAG_LIMIT:
                raise UrdfError(
                    f"{origin}:{parser.CurrentLineNumber}: a tag or comment is longer than "
                    f"{_TAG_LIMIT} bytes; shorten it"
                )
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise UrdfError(
            f"{origin}:{error.lineno}: not well-formed XML: {expat.errors.messages[error.code]} at "
            f"column {error.offset + 1}; correct the file there"
        ) from None
    except UrdfError:
        raise
    except (LookupError, ValueError) as error:
        raise UrdfError(
            f"{origin}: cannot be decoded ({error}); save it as UTF-8"
        ) from None
    return top.children[0]
