"""What the command line shows of a gain."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from fflin.base.record import NOT_VERIFIED
from fflin.base.tables import grid, matrix, width

# A gain of more entries, of more than three joints, is shown by the norms of its blocks.
_LARGE = 9 * 18


def gain_report(gain: Any) -> str:
    """Show a `Gain`, its poles, and the figures that prove it."""
    nu, nx = gain.K.shape
    time = f"sampled at {gain.dt:g} s" if gain.dt else "continuous"
    head = textwrap.fill(
        f"{gain.robot}: u = u0 - K (x - x0), {nx} states, {nu} inputs, frame {gain.frame}, {time}",
        width(),
    )
    if gain.K.size <= _LARGE:
        body = f"K ({nu} x {nx})\n\n{matrix(gain.K, gain.input_names, gain.state_names)}"
    else:
        body = f"K ({nu} x {nx}): norms of its blocks; a file holds all of it\n\n{_blocks(gain)}"
    parts = [head, body, _poles(gain), _figures(gain)]
    return "\n\n".join(parts if gain.verified else [*parts, NOT_VERIFIED])


def _blocks(gain: Any) -> str:
    rows, columns = _groups(gain.input_names), _groups(gain.state_names)
    values = np.array(
        [[np.linalg.norm(gain.K[np.ix_(i, j)]) for j in columns.values()] for i in rows.values()]
    )
    return matrix(values, list(rows), list(columns))


def _groups(names: Sequence[str]) -> dict[str, list[int]]:
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        groups.setdefault(name.partition(".")[0], []).append(index)
    return groups


def _poles(gain: Any) -> str:
    poles: Any = gain.poles[gain.poles.imag >= 0.0]
    if gain.dt:
        order, heads = np.argsort(-np.abs(poles)), ["pole", "modulus", "frequency [rad/s]"]
        rates = np.log(np.where(poles == 0.0, 1e-300, poles)) / gain.dt
        columns = [np.abs(poles), np.abs(rates.imag)]
    else:
        order, heads = np.argsort(-poles.real), ["pole [1/s]", "frequency [rad/s]", "damping"]
        columns = [np.abs(poles), -poles.real / np.abs(poles)]
    body = [
        [_pole(poles[i]), *(f"{column[i]:.4g}" for column in columns)]
        for i in (order if len(order) <= 24 else [*order[:12], *order[-4:]])
    ]
    if len(order) > 24:
        body.insert(12, [f"... {len(order) - 16} more", "", ""])
    title = "poles of A - B K, the slowest first"
    return f"{title}\n\n{grid([heads, *body], 'l')}"


def _pole(pole: complex) -> str:
    return f"{pole.real:.5g}" + (f" +- {pole.imag:.5g}i" if pole.imag else "")


def _figures(gain: Any) -> str:
    margins = gain.margins
    slowest = "1 - largest modulus" if gain.dt else "slowest decay [1/s]"
    low, high = margins.gain
    text = (
        f"Riccati residual {gain.residual:.1e} ({gain.method}); {slowest} {gain.margin:.5g}; "
        f"all inputs at once bear gains of {low:.3g} to {high:.3g} and {margins.phase:.3g} deg of "
        f"phase (disk margin {margins.disk:.3g})"
    )
    return textwrap.fill(text, width())
