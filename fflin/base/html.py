"""HTML cards that notebooks show for results: text, verdicts and tables.

A card needs neither scripts nor a network. Its colours follow the light or dark theme of the
notebook. `fflin.base.svg` draws the pictures on cards.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

_LIGHT = (
    "{--ink:#1b1f24;--soft:#5c6670;--line:#d3d9df;--back:#ffffff;--cell:#f1f4f6;"
    "--good:#1a7f37;--bad:#b42318;--first:#0072b2;--second:#d55e00;--body:#c9d6e2;--bright:1}"
)
_DARK = (
    "{--ink:#e4e8ec;--soft:#9aa5b0;--line:#3b434c;--back:#1a1e23;--cell:#262c33;"
    "--good:#4cc36d;--bad:#ff7b72;--first:#56b4e9;--second:#f08c4a;--body:#3d4d5c;--bright:1.5}"
)


# Environment variables of kernels that a browser reaches through a network.
_REMOTE = frozenset(
    (
        "SSH_CONNECTION",
        "JUPYTERHUB_USER",
        "BINDER_SERVICE_HOST",
        "COLAB_RELEASE_TAG",
        "KAGGLE_KERNEL_RUN_TYPE",
        "CODESPACES",
    )
)


@lru_cache(maxsize=1)
def _style() -> str:
    path = Path(__file__).parent / "assets" / "notebook.css"
    sheet = path.read_text("utf-8").replace("{{light}}", _LIGHT)
    return " ".join(sheet.replace("{{dark}}", _DARK).split())


# Characters with a meaning in HTML. Importing Python's own module `html` would take a millisecond
# of the start time of every command.
_ENTITIES = str.maketrans(
    {"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;", "'": "&#x27;"}
)


def escape(text: str) -> str:
    """Return text as HTML, in which characters such as "<" are escaped."""
    return text.translate(_ENTITIES)


# A number with an exponent, such as 2e-08 or residual=1.4e-13. Browsers break lines at its hyphen.
_EXPONENT = re.compile(r"[\w=.]*\de-\d+")


def _running_text(text: str) -> str:
    """Return text as HTML for a block with line breaks, which do not split numbers."""
    return _EXPONENT.sub(r'<span class="whole">\g<0></span>', escape(text))


def card(title: str, about: str, *parts: str) -> str:
    """Return a card with a title, a short description, and parts in HTML; empty parts are omitted.

    The title and the description are text, which is escaped.
    """
    shown = _running_text(about)
    head = f'<div class="head">{escape(title)} <span>{shown}</span></div>'
    content = "\n".join(filter(None, (head, *parts)))
    return f'<div class="fflin"><style>{_style()}</style>\n{content}\n</div>'


def result_card(result: object, *parts: str) -> str:
    """Return a card whose description is the text in the parentheses of the result's `repr`."""
    about = repr(result).partition("(")[2].removesuffix(")")
    return card(type(result).__name__, about, *parts)


class Reported:
    """Mixin for results whose `repr` is their report, which notebooks show as a card."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        about = str(getattr(self, "robot", ""))
        return card(type(self).__name__, about, *self._html_parts())

    def _html_parts(self) -> Sequence[str]:
        """Return the parts of the card in HTML."""
        return (preformatted(str(self)),)


def paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph of text; `kind` is "good", "bad", "note" or empty."""
    if not text:
        return ""
    style = f' class="{kind}"' if kind else ""
    return f"<p{style}>{_running_text(text)}</p>"


def verdict(text: str, is_good: bool | None) -> str:
    """Return a verdict: green if `is_good` is true, red if it is false, plain if it is None."""
    if is_good is None:
        return paragraph(text)
    return paragraph(text, "good" if is_good else "bad")


def preformatted(text: str) -> str:
    """Return a text report with its line breaks and spaces."""
    return f'<pre class="fflin-text">{escape(text)}</pre>' if text else ""


def table(rows: Sequence[Sequence[str]], align: str = "l") -> str:
    """Return a table of texts, whose first row is its header.

    `align` has the same meaning as in `fflin.base.tables.grid`.
    """
    columns = max(map(len, rows), default=0)
    left = [at < len(align) and align[at] == "l" for at in range(columns)]
    lines = []
    for at, row in enumerate(rows):
        tag = "td" if at else "th"
        cells = []
        for cell, is_left in zip(row, left, strict=False):
            side = ' class="l"' if is_left else ""
            cells.append(f"<{tag}{side}>{escape(cell)}</{tag}>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    head, *body = lines or ["<tr></tr>"]
    return (
        f'<table class="rows"><thead>{head}</thead><tbody>{"".join(body)}</tbody>'
        "</table>"
    )


def folded(summary: str, *parts: str) -> str:
    """Return parts in HTML that are hidden until the reader opens them."""
    content = "\n".join(filter(None, parts))
    if not content:
        return ""
    return f"<details><summary>{escape(summary)}</summary>\n{content}</details>"


def side_by_side(*parts: str) -> str:
    """Return parts in one row, which is broken if it does not fit."""
    content = "".join(filter(None, parts))
    return f'<div class="row">{content}</div>' if content else ""


def frame(title: str, height: int, *, content: str = "", address: str = "") -> str:
    """Return a frame that shows a complete page, given as `content` or by its `address`.

    The scripts of a page that is given as `content` cannot access the notebook.
    """
    if content:
        source = f'sandbox="allow-scripts allow-downloads" srcdoc="{escape(content)}"'
    else:
        source = f'src="{escape(address)}"'
    return (
        f'<iframe class="fflin-page" title="{escape(title)}" width="100%" '
        f'height="{height}" style="border:0" {source}></iframe>'
    )


SHOWN_ABOVE = (
    "Another cell of this notebook already shows this page, which is stored only once. To show it "
    "again, call fflin.visualize again."
)


def is_shown_elsewhere(result: object) -> bool:
    """Return whether another cell of this notebook has shown a result before.

    A result has a page of some MB, which a notebook should contain only once. If its cell is run
    again, the page replaces its former copy, so the result then counts as not shown.
    """
    if not in_notebook():
        return False
    from IPython import get_ipython

    cell = str(get_ipython().history_manager.input_hist_raw[-1])
    return bool(vars(result).setdefault("_shown_by", cell) != cell)


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    if "IPython" not in sys.modules:
        return False
    from IPython import get_ipython

    return hasattr(get_ipython(), "kernel")


def browser_is_local() -> bool:
    """Return whether the browser of the notebook probably runs on the machine of the kernel.

    The browser is elsewhere if the kernel runs in a session of SSH or of a service, such as
    JupyterHub, Binder, Colab, Kaggle or Codespaces.
    """
    return "google.colab" not in sys.modules and _REMOTE.isdisjoint(os.environ)
