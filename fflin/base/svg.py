"""Small pictures for HTML cards: heat maps of matrices, pole maps and curves.

Each mark has a title, which browsers show while the pointer is on the mark.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fflin.base.figures import COLORS
from fflin.base.html import escape
from fflin.base.names import runs
from fflin.base.pole_grid import (
    RATIOS,
    Label,
    damped_poles,
    nyquist_frequency,
    oscillates,
    spaced,
)
from fflin.base.tables import rounding
from fflin.base.validation import Array, Indices, Values

# Largest size of a heat map [bytes]. The entries of a larger matrix are combined to blocks.
_LARGEST = 45_000

# Sides [px] of a cell of a heat map, and its largest width.
_CELL, _WIDEST = 13.0, 400.0

# An entry up to this multiple of its estimated rounding error stays blank. Solvers of equations
# multiply rounding errors.
_NOISE = 1e3

# Smaller entries have the palest colour, relative to the largest entry.
_PALEST = 1e-6

# Width of a character [px] of labels, roughly.
_LETTER = 5.8

# A pole is drawn as unstable beyond this distance from the stability boundary, relative to the
# largest pole. Rounding errors move double poles by this distance.
_MARGINAL = 1e-7

# Half the side [px] of a pole map.
_MIDDLE = 95.0

# Number of points of a curve, and number of curves in a plot.
_POINTS, _CURVES = 160, 8


class Axis(NamedTuple):
    """Rows or columns of a matrix: names and units of signals."""

    names: Sequence[str]
    units: Sequence[str]


def figure(caption: str, drawing: str) -> str:
    """Return a picture with its caption, which is text."""
    return f"<figure><figcaption>{escape(caption)}</figcaption>{drawing}</figure>"


def rate_unit(unit: str) -> str:
    """Return the unit of the time derivative of a quantity."""
    if unit.endswith("/s"):
        return f"{unit}^2"
    return f"({unit})/s" if " " in unit or "/" in unit else f"{unit}/s"


def heat_map(title: str, values: Array, rows: Axis, columns: Axis) -> str:
    """Return a heat map of the nonzero entries of a matrix, with a logarithmic scale.

    Positive and negative entries have different colours. Entries that may be only rounding errors
    stay blank. If the matrix has many entries, each cell stands for the entry of largest magnitude
    in a block.
    """
    shown = np.where(np.abs(values) > _NOISE * rounding(values), values, 0.0)
    block = 1
    drawing = _heat_map(title, shown, rows, columns, block)
    while len(drawing) > _LARGEST and block < max(values.shape):
        block += 1
        drawing = _heat_map(title, shown, rows, columns, block)
    many, wide = values.shape
    caption = f"{title} ({many} x {wide})"
    if block > 1:
        caption += f", largest entry of each block of {block} x {block}"
    return figure(caption, drawing)


def _heat_map(title: str, values: Array, rows: Axis, columns: Axis, block: int) -> str:
    """Return the drawing of a heat map in which `block` x `block` entries share a cell."""
    many, wide = values.shape
    cell = min(_CELL, _WIDEST / max(1, wide)) * block
    groups_down = runs(rows.names, rows.units)
    groups_across = runs(columns.names, columns.units)
    left = 6.0 + _LETTER * max((len(group[2]) for group in groups_down), default=0)
    top = 14.0
    height, width = math.ceil(many / block) * cell, math.ceil(wide / block) * cell
    parts = [f'<rect class="plot" x="0" y="0" width="{width:g}" height="{height:g}"/>']
    per_entry = cell / block
    for first, *_ in groups_down[1:]:
        parts.append(_line(0.0, first * per_entry, width, first * per_entry))
    for first, *_ in groups_across[1:]:
        parts.append(_line(first * per_entry, 0.0, first * per_entry, height))
    parts += _cells(title, values, rows, columns, block, cell)
    for first, last, name, _ in groups_down:
        y = (first + last + 1) / 2.0 * per_entry + 3.0
        parts.append(
            f'<text x="-4" y="{y:.1f}" text-anchor="end">{escape(name)}</text>'
        )
    end = -math.inf
    for first, last, name, _ in groups_across:
        x = (first + last + 1) / 2.0 * per_entry
        half = 0.5 * _LETTER * len(name)
        if x - half > end:  # names that do not fit are left out
            parts.append(
                f'<text x="{x:.1f}" y="-4" text-anchor="middle">{escape(name)}</text>'
            )
            end = x + half
    content = "".join(parts)
    return picture(-left, -top, left + width + 8.0, top + height + 2.0, content)


def _cells(
    title: str, values: Array, rows: Axis, columns: Axis, block: int, cell: float
) -> list[str]:
    """Return the cells of a heat map, one for each block that is not zero."""
    magnitudes = np.abs(values)
    nonzero = magnitudes[magnitudes > 0.0]
    if not nonzero.size:
        return []
    high = math.log(float(nonzero.max()))
    span = min(max(high - math.log(float(nonzero.min())), 1e-9), -math.log(_PALEST))
    cells = []
    for top in range(0, len(values), block):
        for left in range(0, values.shape[1], block):
            part = magnitudes[top : top + block, left : left + block]
            down, across = np.unravel_index(int(part.argmax()), part.shape)
            i, j = top + int(down), left + int(across)
            value = float(values[i, j])
            if not value:
                continue
            opacity = 1.0 - 0.75 * min(1.0, (high - math.log(abs(value))) / span)
            sign = "positive" if value > 0.0 else "negative"
            unit = _per(rows.units[i], columns.units[j])
            text = f"{title}[{rows.names[i]}, {columns.names[j]}] = {value:.4g}{unit}"
            cells.append(
                f'<rect class="{sign}" x="{left // block * cell:g}" '
                f'y="{top // block * cell:g}" width="{cell:g}" height="{cell:g}" '
                f'opacity="{opacity:.2f}"><title>{escape(text)}</title></rect>'
            )
    return cells


def _per(row: str, column: str) -> str:
    """Return the unit of an entry with a space before it, or "" if it has no unit."""
    if column not in ("", "1"):
        return f" {row} per {column}"
    return "" if row in ("", "1") else f" {row}"


def pole_map(poles: Values, dt: float = 0.0) -> str:
    """Return a map of poles: [1/s] for dt = 0, otherwise poles z with the unit circle.

    The axes of poles in 1/s are logarithmic on both sides of zero. Dashed curves mark equal damping
    ratios if a pole oscillates.
    """
    size, middle = 2.0 * _MIDDLE, _MIDDLE
    finite = [complex(pole) for pole in poles if cmath.isfinite(pole)]
    moduli = sorted(abs(pole) for pole in finite if abs(pole) > 0.0)
    if dt:
        reach = max(1.1, *moduli) if moduli else 1.1

        def place(x: float) -> float:
            return 88.0 * x / reach
    else:
        unit = moduli[0] if moduli else 1.0
        reach = math.asinh((moduli[-1] if moduli else 1.0) / unit)

        def place(x: float) -> float:
            return 80.0 * math.asinh(x / unit) / reach

    parts = [f'<rect class="plot" x="0" y="0" width="{size:g}" height="{size:g}"/>']
    parts += [_line(0.0, middle, size, middle), _line(middle, 0.0, middle, size)]
    if dt:
        radius = place(1.0)
        parts.append(
            f'<circle class="axis" cx="{middle}" cy="{middle}" r="{radius:.1f}"/>'
        )
    if dt or oscillates(np.array(finite)):
        parts += _damping_curves(place, moduli[-1] if moduli else 1.0, dt)
    shown = set[str]()
    for pole in finite:
        excess = abs(pole) - 1.0 if dt else pole.real / (moduli[-1] if moduli else 1.0)
        x = f"{middle + place(pole.real):.1f}"
        y = f"{middle - place(pole.imag):.1f}"
        text = f"{pole.real:.4g}"
        if pole.imag:
            text = f"{pole:.4g}".replace("j", "i")
        if not dt:
            text += f" 1/s, {abs(pole):.3g} rad/s"
            if abs(pole):
                text += f", damping {-pole.real / abs(pole):.3g}"
        kind = "mark unstable" if excess > _MARGINAL else "mark"
        mark = (
            f'<g><path class="{kind}" d="M{x} {y}m-3 -3l6 6m0 -6l-6 6"/>'
            f'<circle class="hit" cx="{x}" cy="{y}" r="6"/>'
            f"<title>{escape(text)}</title></g>"
        )
        if mark not in shown and len(shown) < 300:
            parts.append(mark)
        shown.add(mark)
    parts.append(
        f'<text x="{size - 3:g}" y="{middle - 4:g}" text-anchor="end">Re</text>'
    )
    parts.append(f'<text x="{middle + 4:g}" y="10">Im</text>')
    return picture(0.0, 0.0, size, size, "".join(parts))


def _damping_curves(
    place: Callable[[float], float], largest: float, dt: float
) -> list[str]:
    """Return curves of constant damping ratio and their labels, up to the modulus `largest`."""
    parts = []
    labels = []
    for ratio in RATIOS:
        end = nyquist_frequency(ratio, dt) if dt else largest
        frequencies = np.concatenate(([0.0], np.geomspace(1e-6 * end, end, 60)))
        if dt:
            frequencies = np.linspace(0.0, end, 60)
        poles = damped_poles(ratio, frequencies, dt)
        for half in (poles, poles.conj()):
            points = " ".join(
                f"{_MIDDLE + place(pole.real):.1f},{_MIDDLE - place(pole.imag):.1f}"
                for pole in half.tolist()
            )
            parts.append(f'<polyline class="damping" points="{points}"/>')
        tip = complex(poles[len(poles) // 2] if dt else poles[-1])
        x, y = _MIDDLE + place(tip.real), _MIDDLE - place(tip.imag)
        labels.append(Label(x, y - 3.0, f"{ratio:g}"))
    for label in spaced(labels, 2.5 * _LETTER, 9.0):
        parts.append(
            f'<text class="damping" x="{label.x:.1f}" y="{label.y:.1f}" '
            f'text-anchor="middle">{label.text}</text>'
        )
    return parts


def sampled(count: int) -> Indices:
    """Return the indices of the rows of a history with `count` rows that a plot shows."""
    return np.unique(np.linspace(0, count - 1, _POINTS).round().astype(int))


def curves(t: Array, values: Mapping[str, Array], unit: str) -> str:
    """Return a plot of curves {name: values (N,)} over the times t (N,) [s].

    If there are more than _CURVES curves, only the largest are drawn.
    """
    width = 280.0
    height = 110.0
    left = 44.0  # margin for the labels of the vertical axis
    drawn = _largest_curves(values)
    rows = sampled(len(t))

    # The vertical range includes zero.
    low = high = 0.0
    for curve in drawn.values():
        low = min(low, float(curve[rows].min()))
        high = max(high, float(curve[rows].max()))
    if not high > low:
        low = -1.0
        high = 1.0

    x = width * (t[rows] - t[0]) / (t[-1] - t[0])
    parts = [f'<rect class="plot" x="0" y="0" width="{width:g}" height="{height:g}"/>']
    zero = height * high / (high - low)  # y points down
    parts.append(_line(0.0, zero, width, zero))
    for color, (name, curve) in zip(COLORS, drawn.items(), strict=False):
        y = height * (high - curve[rows]) / (high - low)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
        # The second, invisible line is wide, so that a pointer finds the curve more easily.
        parts.append(
            f'<g><polyline class="curve" stroke="{_ink(color)}" points="{points}"/>'
            f'<polyline class="near" points="{points}"/>'
            f"<title>{escape(name)}</title></g>"
        )
    # Labels: the limits and the unit of the vertical axis on the left, the time range below.
    below = height + 12.0
    unit_label = "" if unit == "1" else f"[{unit}]"
    parts += [
        _text(-4.0, 8.0, f"{high:.3g}", at_end=True),
        _text(-4.0, height, f"{low:.3g}", at_end=True),
        _text(0.0, below, f"{t[0]:g}"),
        _text(width, below, f"{t[-1]:g} s", at_end=True),
        _text(-4.0, height / 2, unit_label, at_end=True),
    ]
    return picture(-left, -4.0, left + width + 8.0, height + 22.0, "".join(parts))


def _largest_curves(values: Mapping[str, Array]) -> dict[str, Array]:
    """Return the _CURVES curves with the largest absolute values, in their original order."""

    def size(name: str) -> float:
        return float(np.abs(values[name]).max())

    largest = sorted(values, key=size, reverse=True)[:_CURVES]
    return {name: curve for name, curve in values.items() if name in largest}


def _text(x: float, y: float, text: str, *, at_end: bool = False) -> str:
    """Return a text that begins at x, or that ends there if `at_end` is true."""
    anchor = ' text-anchor="end"' if at_end else ""
    return f'<text x="{x:g}" y="{y:g}"{anchor}>{text}</text>'


def _ink(color: str) -> str:
    """Return a colour that is visible in light and dark themes."""
    return "currentColor" if color == "#000000" else color


def _line(x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<path class="axis" d="M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}"/>'


def picture(x: float, y: float, width: float, height: float, content: str) -> str:
    """Return a picture of `width` x `height` [px] whose upper left corner is (x, y)."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" '
        f'height="{height:.0f}" viewBox="{x:.1f} {y:.1f} {width:.1f} {height:.1f}">'
        f"{content}</svg>"
    )
