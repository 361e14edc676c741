"""Colours of messages and reports on terminals."""

from __future__ import annotations

import os
import re
import sys
from typing import TextIO

# Parameters of the escape sequence that selects a colour or style.
_RED, _YELLOW, _GREEN, _DIM = "1;31", "1;33", "1;32", "2"

_LABEL = re.compile(r"^(fflin: )(error|warning)(?=:)")
_LABELS = {"error": _RED, "warning": _YELLOW}

# Words of verdicts in reports, and the cell "." of a table, which is a zero.
_IN_REPORT = re.compile(
    r"(?P<failed>\bnot\s+verified\b|\bFAILED\b)"
    r"|(?P<verified>(?<![\w/.-])verified(?![\w/.-]))"
    r"|(?P<zero>(?<=  )\.(?=  |$))",
    re.MULTILINE,
)
_STYLES = {"failed": _RED, "verified": _GREEN, "zero": _DIM}


def shows_colors(stream: TextIO | None) -> bool:
    """Return whether text that is written to a stream may contain colours.

    By default, only terminals show colours. The environment variable NO_COLOR disables colours,
    and FORCE_COLOR enables them for every stream. If both are set, NO_COLOR is decisive.
    """
    if stream is None or os.environ.get("NO_COLOR"):
        return False
    if os.environ.get("FORCE_COLOR"):
        return True
    return os.environ.get("TERM") != "dumb" and stream.isatty()


def color_message(line: str) -> str:
    """Return a message for stderr, with a coloured label "error" or "warning" on a terminal."""
    if not shows_colors(sys.stderr):
        return line
    return _LABEL.sub(
        lambda match: match[1] + _styled(match[2], _LABELS[match[2]]), line
    )


def color_report(text: str) -> str:
    """Return a report for stdout, with coloured verdicts and dimmed zeros on a terminal."""
    if not shows_colors(sys.stdout):
        return text
    return _IN_REPORT.sub(
        lambda match: _styled(match[0], _STYLES[str(match.lastgroup)]), text
    )


def _styled(text: str, style: str) -> str:
    return f"\x1b[{style}m{text}\x1b[0m"
