"""Terms that the search of the site finds first.

A comment ``<!-- index: spring, stiffness -->`` before a paragraph makes these words main entries of
the index, which lead to the paragraph. The search puts main entries of the index before all else.
A comment is not seen where a page is read as Markdown.
"""

import re
from typing import Any

from sphinx.application import Sphinx

_COMMENT = re.compile(r"^<!-- index: (.+?) -->$", re.MULTILINE | re.DOTALL)


def enter(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace each comment by the directive that makes the entries."""
    source[0] = _COMMENT.sub(_directive, source[0])


def _directive(found: re.Match[str]) -> str:
    terms = ", ".join(f"! {' '.join(term.split())}" for term in found[1].split(","))
    return f"```{{index}} {terms}\n```"


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("source-read", enter)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
