"""Colours of messages, reports and names of joints on terminals."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from typing import TextIO

# Parameters of the escape sequence that selects a colour or style.
_RED, _YELLOW, _GREEN, _DIM = "1;31", "1;33", "1;32", "2"

_LABEL = re.compile(r"^(fflin: )(error|warning)(?=:)")
_LABELS = {"error": _RED, "warning": _YELLOW}

# Words of verdicts in reports, and the cell "." of a table, which is a zero.
_IN_REPORT = (
    r"(?P<failed>\bnot\s+verified\b|\bFAILED\b)"
    r"|(?P<verified>(?<![\w/.-])verified(?![\w/.-]))"
    r"|(?P<zero>(?<=  )\.(?=  |$))"
)
# A joint is the cell of a table, or the end of the name of a state or input.
_JOINT = (
    r"|(?P<joint>(?:(?<=\bq_m\.)|(?<=\bqdot_m\.)|(?<=\btau_m\.))(?:{names})(?![\w/-]|\.\w)"
    r"|(?:^|(?<=  ))(?:{names})(?=  |$))"
)
# Levels of red, green and blue in a palette with 256 colours.
_CUBE = (0, 95, 135, 175, 215, 255)
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


def color_report(text: str, colors: Mapping[str, str] | None = None) -> str:
    """Return a report for stdout, with coloured verdicts and dimmed zeros on a terminal.

    `colors` are the colours "#rrggbb" of joints, {joint: colour}. The name of a joint is black or
    white on its colour, so that it can be read on light and on dark terminals.
    """
    if not shows_colors(sys.stdout):
        return text
    pattern = _IN_REPORT
    if colors:
        longest_first = sorted(colors, key=len, reverse=True)
        pattern += _JOINT.format(names="|".join(map(re.escape, longest_first)))

    def styled(match: re.Match[str]) -> str:
        kind = str(match.lastgroup)
        style = _STYLES.get(kind, "")
        if colors and kind == "joint":
            style = _on_ground(colors[match[0]])
        return _styled(match[0], style)

    return re.sub(pattern, styled, text, flags=re.MULTILINE)


def ink_on(color: str) -> str:
    """Return the colour of letters on a ground "#rrggbb": black, or white on dark grounds."""
    linear = [
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4
        for part in (level / 255.0 for level in _levels(color))
    ]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    # By WCAG, the contrast with black is (L + 0.05) / 0.05, and with white 1.05 / (L + 0.05).
    if (luminance + 0.05) ** 2 > 0.05 * 1.05:
        return "#000000"
    return "#ffffff"


def _levels(color: str) -> tuple[int, int, int]:
    """Return red, green and blue of a colour "#rrggbb", from 0 to 255."""
    red, green, blue = bytes.fromhex(color[1:])
    return red, green, blue


def _on_ground(color: str) -> str:
    """Return the parameters that select a ground and the colour of letters on it.

    Terminals that do not announce all colours by COLORTERM get the nearest of 256 colours.
    """
    if os.environ.get("COLORTERM") in ("truecolor", "24bit"):
        ink, ground = (
            "2;" + ";".join(map(str, _levels(each))) for each in (ink_on(color), color)
        )
    else:
        nearest = "#" + "".join(f"{_CUBE[at]:02x}" for at in _in_cube(color))
        ink, ground = (f"5;{_index(each)}" for each in (ink_on(nearest), nearest))
    return f"38;{ink};48;{ground}"


def _in_cube(color: str) -> list[int]:
    """Return the indices in _CUBE of the levels that are nearest to the levels of a colour."""
    return [
        min(range(len(_CUBE)), key=lambda at: abs(_CUBE[at] - level))
        for level in _levels(color)
    ]


def _index(color: str) -> int:
    """Return the index of a colour in a palette with 256 colours."""
    red, green, blue = _in_cube(color)
    return 16 + 36 * red + 6 * green + blue


def _styled(text: str, style: str) -> str:
    return f"\x1b[{style}m{text}\x1b[0m"
