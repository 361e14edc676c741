"""Text of all pages in ``_static/excerpts.js``, for the search of a site that is read from disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx


def text_of(doctree: nodes.document) -> str:
    """Return the text of the paragraphs, titles, terms and code of a page."""
    shown = (nodes.paragraph, nodes.title, nodes.term, nodes.literal_block)
    parts = [node.astext() for node in doctree.findall(lambda node: isinstance(node, shown))]
    return " ".join(" ".join(parts).split())


def write(app: Sphinx, error: Exception | None) -> None:
    """Write the script."""
    if error is not None or app.builder.format != "html":
        return
    pages = {page: text_of(app.env.get_doctree(page)) for page in sorted(app.env.found_docs)}
    script = f"window.FFLIN_EXCERPTS = {json.dumps(pages, ensure_ascii=False)};\n"
    Path(app.outdir, "_static", "excerpts.js").write_text(script, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("build-finished", write)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
