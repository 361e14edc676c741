"""Tutorials as notebooks: each build writes ``_build/notebooks/NAME.ipynb``, without outputs."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

_CELL = re.compile(r"^```\{code-cell\}\n(?::[^\n]*\n)*\n?(.*?)^```\n", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"\[([^\]]+)\]\((?!http)[^)]+\)")


def notebook(text: str) -> dict[str, Any]:
    """Return the notebook of a page: its Markdown and its code, without links into the site."""
    text = text.split("---\n", 2)[2]  # after the header
    cells: list[dict[str, Any]] = []
    # `split` returns Markdown and code in turn.
    for k, part in enumerate(_CELL.split(text)):
        if not k % 2:
            source = re.sub(r"<!-- index: .*? -->\n", "", _LINK.sub(r"\1", part), flags=re.DOTALL)
            extra: dict[str, Any] = {"cell_type": "markdown"}
        else:
            source = part
            extra = {"cell_type": "code", "execution_count": None, "outputs": []}
        if source.strip():
            name = f"cell-{len(cells)}"
            cells.append({**extra, "id": name, "metadata": {}, "source": source.strip()})
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def write(app: Sphinx) -> None:
    """Write the notebooks, which the index of the tutorials offers for download."""
    folder = Path(app.srcdir) / "_build" / "notebooks"
    folder.mkdir(parents=True, exist_ok=True)
    for page in sorted((Path(app.srcdir) / "tutorials").glob("*.md")):
        if page.stem != "index":
            content = json.dumps(notebook(page.read_text("utf-8")), indent=1)
            (folder / f"{page.stem}.ipynb").write_text(content + "\n", "utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("builder-inited", write)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
