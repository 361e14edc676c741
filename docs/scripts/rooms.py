"""Draw the rooms of the package and their imports: ``python docs/scripts/rooms.py``."""

from __future__ import annotations

import ast
import re
import textwrap
from collections import Counter
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "rooms.svg"

# Dimensions of the page, in pixels.
WIDTH, LEFT, BOX, LINE, GAP, COLUMNS = 960, 16, 640, 15, 14, 100


def rooms() -> list[str]:
    """Return the rooms of the import contract from top to bottom."""
    contract = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    layers = re.search(r"layers = \[(.*?)\]", contract, re.DOTALL)
    assert layers is not None
    return re.findall(r'"(\w+)"', layers[1])


def modules(room: str) -> list[str]:
    """Return the modules of a room; a module of a nested room has the name of this room too."""
    folder = ROOT / "fflin" / room
    found = [file.relative_to(folder).with_suffix("").parts for file in folder.rglob("*.py")]
    return sorted(".".join(parts) for parts in found if parts[-1] != "__init__")


def purpose(room: str) -> str:
    """Return the first line of the docstring of a room."""
    text = ast.get_docstring(ast.parse((ROOT / "fflin" / room / "__init__.py").read_text("utf-8")))
    assert text is not None
    return text.splitlines()[0]


def imports(room: str) -> Counter[str]:
    """Return the number of imports of a room for each imported room.

    A public name ``fflin.NAME`` is an import of its module.
    """
    stub = (ROOT / "fflin" / "__init__.pyi").read_text(encoding="utf-8")
    public = {name: module for module, name in re.findall(r"^from (\S+) import (\w+)", stub, re.M)}
    found: Counter[str] = Counter()
    for file in (ROOT / "fflin" / room).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            module = ""
            if isinstance(node, ast.ImportFrom):
                module = node.module or ""
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "fflin":
                module = public.get(node.attr, "")
            if module.startswith("fflin."):
                found[module.split(".")[1]] += 1
    del found[room]
    return found


def drawing() -> str:
    """Return the picture: a box for each room, and an arc to each room that it imports."""
    order = rooms()
    boxes, middles, y = [], {}, GAP
    for room in order:
        lines = textwrap.wrap(", ".join(modules(room)), COLUMNS)
        height = (2.2 + len(lines)) * LINE
        middles[room] = y + height / 2
        boxes.append(
            f'<rect x="{LEFT}" y="{y:g}" width="{BOX}" height="{height:g}" rx="6"/>'
            f'<text x="{LEFT + 12}" y="{y + 1.2 * LINE:g}"><tspan class="room">{room}</tspan>'
            f'<tspan dx="10">{escape(purpose(room).replace("`", ""))}</tspan></text>'
        )
        boxes += [
            f'<text class="modules" x="{LEFT + 12}" y="{y + (2.3 + i) * LINE:g}">{escape(line)}'
            "</text>"
            for i, line in enumerate(lines)
        ]
        y += height + GAP
    arcs = []
    for room in order:
        for other, count in sorted(imports(room).items()):
            start, end, right = middles[room], middles[other], LEFT + BOX
            bulge = right + 24 + 0.42 * (end - start)
            arcs.append(
                f'<path class="{"down" if end > start else "up"}" stroke-width="'
                f'{0.6 + count**0.5 / 2.5:.2f}" d="M{right} {start + 4:g} C{bulge:g} {start + 4:g} '
                f'{bulge:g} {end - 6:g} {right + 7} {end - 6:g}"/>'
            )
    style = (
        "rect{fill:#f4f6f8;stroke:#8a94a0}text{font:12px sans-serif;fill:#222}"
        ".room{font-weight:bold;font-size:14px}.modules{fill:#5a6470;font-size:11.5px}"
        "path{fill:none;stroke:#3b6ea5;stroke-opacity:.55;marker-end:url(#head)}"
        ".up{stroke:#c0392b}"
    )
    head = (
        '<marker id="head" viewBox="0 0 8 8" refX="1" refY="4" markerWidth="8" markerHeight="8" '
        'markerUnits="userSpaceOnUse" orient="auto"><path d="M0 0 8 4 0 8z" '
        'style="fill:#3b6ea5;stroke:none;marker-end:none"/></marker>'
    )
    body = "\n".join((*arcs, *boxes))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y:g}" width="{WIDTH}">\n'
        f"<style>{style}</style>\n<defs>{head}</defs>\n"
        f'<rect width="{WIDTH}" height="{y:g}" style="fill:#fff;stroke:none"/>\n{body}\n</svg>\n'
    )


if __name__ == "__main__":
    PICTURE.write_text(drawing(), encoding="utf-8")
