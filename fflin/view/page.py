"""The page that shows a scene: one self-contained HTML file."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from functools import cache
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from fflin.base.validation import Array

_SCRIPTS = ("sky", "orbit", "look", "stage", "marks", "plots", "player", "live", "modes", "main")


def build_page(info: dict[str, Any], commands: Iterable[bytes] = (), connect: str = "") -> str:
    """Build the page of what scripts show and `Recorder.commands`; it may `connect` there alone."""
    info = {**info, "commands": [_base64(command) for command in commands]}
    # In a script element nothing but its own end tag and a comment's start is special.
    data = json.dumps(info, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    fields = {
        "title": escape(info["title"]),
        "scene": info["scene"],
        "mode": info["mode"],
        "connect": connect or "'none'",
        "style": _asset("style.css"),
        "meshcat": _meshcat(),
        "scripts": _scripts(),
        "data": data,
    }
    parts = _asset("page.html").split("{{")
    return parts[0] + "".join(
        fields[name] + rest for name, _, rest in (part.partition("}}") for part in parts[1:])
    )


def packed(array: Array) -> str:
    """Return an array as the page's `floats` reads it, in single precision."""
    return _base64(np.ascontiguousarray(array, dtype="<f4").tobytes())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


@cache
def _asset(name: str) -> str:
    return files("fflin.view").joinpath("assets", name).read_text(encoding="utf-8")


@cache
def _scripts() -> str:
    body = "\n".join(_asset(f"{name}.js") for name in _SCRIPTS)
    # Names of our own, beside those of meshcat's bundle.
    return f'(() => {{\n"use strict";\nconst THREE = MeshCat.THREE;\n{body}\nmain();\n}})();'


@cache
def _meshcat() -> str:
    bundle = files("meshcat").joinpath("viewer", "dist", "main.min.js")
    script = bundle.read_text(encoding="utf-8")
    return script.replace("</script", "<\\/script").replace("<!--", "<\\!--")
