"""Path of an HTML page, which notebooks show as the page itself."""

from __future__ import annotations

import os
from pathlib import Path, PosixPath, WindowsPath
from typing import TYPE_CHECKING

from fflin.base import html

if TYPE_CHECKING:
    _Path = Path
else:
    # Before Python 3.12, `Path` itself cannot be the base of a class.
    _Path = WindowsPath if os.name == "nt" else PosixPath

HEIGHT = 480  # [px] of the frame in a notebook


class HtmlPage(_Path):
    """Path of an HTML page. A notebook shows the page, which is stored in the notebook."""

    def _repr_html_(self) -> str | None:
        if self.suffix.lower() != ".html" or not self.is_file():
            return None
        if html.is_shown_elsewhere(self):
            return html.card("HtmlPage", str(self), html.paragraph(html.SHOWN_ABOVE))
        return html.frame(self.name, HEIGHT, content=self.read_text("utf-8"))
