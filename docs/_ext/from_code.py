"""Site content from the code: reference, command line, numbered equations, links to names."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from jinja2 import BaseLoader
from jinja2.sandbox import SandboxedEnvironment
from numpydoc import docscrape_sphinx
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import fflin
from fflin.commands import cli


def titles() -> dict[str, list[str]]:
    """Return the public names by title, in the order of the stub."""
    found: dict[str, list[str]] = {}
    for line in Path(fflin.__file__).with_suffix(".pyi").read_text(encoding="utf-8").splitlines():
        if line.startswith("# "):
            names = found[line[2:]] = []
        elif line.startswith("from "):
            names.append(line.split()[-1])
    return found


def write(path: Path, text: str) -> None:
    """Write a page only if it differs, so that Sphinx does not read unchanged pages again."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def reference(app: Sphinx) -> None:
    """Write a page for each title of the reference, with a table of links to its names."""
    folder = Path(app.srcdir) / "reference"
    head = ".. currentmodule:: fflin\n\n.. autosummary::\n   :nosignatures:\n   :toctree: names\n\n"
    pages = {}
    for title, names in titles().items():
        page = title.lower().replace(" ", "_")
        rows = "".join(f"   {name}\n" for name in names)
        pages[page] = f"{title}\n{'=' * len(title)}\n\n{head}{rows}"
    for page, text in pages.items():
        write(folder / f"{page}.rst", text)
    entries = "".join(f"   {page}\n" for page in pages)
    tables = "".join(text.replace("   :toctree: names\n", "") + "\n" for text in pages.values())
    write(
        folder / "index.rst",
        "Reference\n#########\n\nAll public names ``fflin.NAME``, grouped by task. Each name has a "
        "page with its equation,\nshapes, units, errors and an example.\n\n"
        f".. toctree::\n   :hidden:\n\n{entries}\n{tables}",
    )


class CommandHelp(SphinxDirective):
    """Directive that shows the ``--help`` of every command, each under its name."""

    def run(self) -> list[nodes.Node]:
        """Return a section for each command."""
        os.environ["COLUMNS"] = "88"
        parser = cli._parser("")
        (action,) = (
            each for each in parser._actions if each.dest == "==SUPPRESS==" or each.choices
        )
        made: list[nodes.Node] = [_help(parser.format_help())]
        for names in cli.TASKS.values():
            for name in names:
                section = nodes.section(ids=[f"fflin-{name}"], names=[f"fflin {name}"])
                section += nodes.title("", f"fflin {name}")
                section += _help(action.choices[name].format_help())  # type: ignore[index]
                self.state.document.note_explicit_target(section)
                made.append(section)
        return made


def _help(text: str) -> nodes.literal_block:
    return nodes.literal_block(text, text, language="text")


def keep_tags(app: Sphinx, doctree: nodes.document) -> None:
    """Put equations with a tag into an environment that shows their number."""
    for node in doctree.findall(nodes.math_block):
        if r"\tag{" in node.astext():
            text = rf"\begin{{equation}}{node.astext()}\end{{equation}}"
            node.children = [nodes.Text(text)]
            node["no-wrap"] = node["nowrap"] = True


def link_names(app: Sphinx, doctree: nodes.document) -> None:
    """Link public names in code, ``lqr`` or ``fflin.lqr(lin)``, to their pages."""
    page = app.env.current_document.docname
    if page.startswith("reference/"):
        return
    for node in list(doctree.findall(nodes.literal)):
        named = re.fullmatch(r"(?:fflin\.)?(\w+)(\(.*\))?", node.astext())
        inside = (nodes.reference, nodes.title, addnodes.pending_xref)
        if named and named[1] in fflin.__all__ and not isinstance(node.parent, inside):
            link = addnodes.pending_xref(
                "", refdomain="py", reftype="obj", reftarget=f"fflin.{named[1]}", refdoc=page
            )
            node.replace_self(link)
            link += node


def short_signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, result: str
) -> tuple[str, str] | None:
    """Hide the signature of a record: a function creates it, and its attributes are listed."""
    made = what == "class" and "\nParameters\n---" not in (inspect.getdoc(obj) or "")
    return ("", result) if made and dataclasses.is_dataclass(obj) else None


def link_pages(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Link the names of documentation pages in docstrings."""
    for at, line in enumerate(lines):
        lines[at] = re.sub(r"docs/([\w/]+)\.md", r":doc:`/\1`", line)


# A closed group of the reference in the navigation: its link, the button that opens it, its names.
_GROUP = re.compile(
    r'(<li class="toctree-l2) has-children("><a [^>]*href="[^"]*"[^>]*>[^<]*</a>)'
    r'<input [^>]*id="toctree-checkbox-\d+"[^>]*/><label [^>]*>.*?</label><ul>\n'
    r'(?:<li class="toctree-l3"><a [^>]*fflin\.\w+\.html">[^<]*</a></li>\n)+</ul>\n',
)


def fold_names(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: nodes.document | None
) -> None:
    """Leave the names of the other groups of the reference out of the navigation of a page.

    With all names in the navigation of each page, they would be a tenth of the site.
    """
    if tree := context.get("furo_navigation_tree"):
        context["furo_navigation_tree"] = _GROUP.sub(r"\1\2", tree)


def keep_template() -> None:
    """Make numpydoc compile its template once, not for every docstring."""
    kept: list[SandboxedEnvironment] = []

    def environment(loader: BaseLoader) -> SandboxedEnvironment:
        if not kept:
            kept.append(SandboxedEnvironment(loader=loader))
        return kept[0]

    docscrape_sphinx.SandboxedEnvironment = environment


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    keep_template()
    reference(app)  # here, since autosummary looks for its tables before anything is read
    app.connect("doctree-read", keep_tags)
    app.connect("doctree-read", link_names)
    app.connect("autodoc-process-docstring", link_pages)
    app.connect("autodoc-process-signature", short_signature)
    app.connect("html-page-context", fold_names, priority=900)  # after the theme
    app.add_directive("command-help", CommandHelp)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
