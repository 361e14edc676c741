"""The rows that read the undriven vibrations of an undamped model, and their names."""

from __future__ import annotations

import numpy as np

from fflin.analysis.names import combination
from fflin.analysis.second_order import Hidden
from fflin.base.validation import Array


def vibration_rows(
    found: Hidden, M: Array, to_s: Array, names: tuple[str, ...]
) -> tuple[Array, tuple[str, ...]]:
    """Return the rows (m, 2 r) that read the undriven modes over the state, and their names."""
    r = len(M)
    size = np.sqrt(M.diagonal())
    rows, labels = [np.zeros((0, 2 * r))], []
    members = tuple(name.split(".", 1)[-1] for name in names[r:])
    for pole, missed in found.shapes:
        if pole.real < 0.0:  # of a pair of real poles the other has the same shapes
            continue
        shapes = missed.real
        momenta = shapes.T @ M
        zero = np.zeros_like(momenta)
        rows += [np.hstack((momenta @ to_s, zero)), np.hstack((zero, momenta))]
        kind = "vibration" if pole.imag else "instability"
        shown = [
            combination(s / np.abs(s * size).max() * size, members, np.ones(r)) for s in shapes.T
        ]
        for what in ("", "rate of "):
            labels += [f"{what}{kind} at {abs(pole):.4g} rad/s ({shape})" for shape in shown]
    return np.vstack(rows), tuple(labels)
