"""Reports of linear models and inputs on the command line."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from fflin.base.names import runs
from fflin.base.tables import cut, grid, matrix, signals, width

if TYPE_CHECKING:
    from fflin.base.validation import Array
    from fflin.linear.model import LinearModel
    from fflin.robot.robot import Robot


# Rates [SI] below this value count as zero.
_MOVES = 1e-9


def model_report(lin: LinearModel) -> str:
    """Show a linear model: its point, A, B, C, D and its certificate."""
    import numpy as np

    nx, nu = lin.B.shape
    stays, f0 = lin.is_equilibrium(), np.where(np.abs(lin.f0) > _MOVES, lin.f0, 0.0)
    point = "a fixed point" if stays else "not a fixed point"
    if stays and (lin.moving or f0.any()):
        point = "a relative equilibrium"
    head = f"{lin.robot}: {nx} states, {nu} inputs, frame {lin.frame}, {point}"
    if lin.dt:
        head += f", sampled every {lin.dt:g} s"
    parts = [f"{textwrap.fill(head, width(), subsequent_indent='  ')}\n{_units(lin)}"]
    rates = lin.state_units if lin.dt else [_rate(unit) for unit in lin.state_units]
    # In motion the poles of a frozen model do not show stability. If A A = 0, all are zero.
    if stays and not lin.dt and (lin.A @ lin.A).any():
        from fflin.analysis.modes import modes

        if growing := modes(lin).unstable:
            shown = ", ".join(f"{mode.pole:.5g}" for mode in growing)
            shown = f"unstable: poles with a positive real part {shown}"
            parts.append(textwrap.fill(shown, width()))
    moved = [
        signals(title, values, names, units)
        for title, values, names, units in (
            ("x0", lin.x0, lin.state_names, lin.state_units),
            ("u0", lin.u0, lin.input_names, lin.input_units),
            ("f0", f0, lin.state_names, rates),
        )
        if values.any()
    ]
    if moved:
        parts.append("\n".join(moved))
    parts.append(_named_matrix("A", lin.A, lin.state_names, lin.state_names))
    parts.append(_named_matrix("B", lin.B, lin.state_names, lin.input_names))
    if lin.output_names == lin.state_names and not lin.D.any():
        parts.append("C = E, D = 0: the output is the state")
    else:
        parts.append(_named_matrix("C", lin.C, lin.output_names, lin.state_names))
        parts.append(_named_matrix("D", lin.D, lin.output_names, lin.input_names))
    c = lin.certificate
    parts.append(
        f"A and B against ABA derivatives: {c.route_A:.1e} and {c.route_B:.1e}; M M^-1 - E: "
        f"{c.inertia_residual:.1e};\ncond(M), scaled: {c.condition:.1e}; |f0|: {c.f0:.1e}"
    )
    return "\n\n".join(parts)


def inputs_report(robot: Robot) -> str:
    """Show the inputs of a robot and their limits."""
    from fflin.dynamics.actuation import Actuation
    from fflin.dynamics.state import StateMap
    from fflin.robot.limits import limits_of

    acting, limits = Actuation(StateMap(robot)), limits_of(robot)
    rows = [["input", "unit", "min", "max"]]
    for name, unit in zip(acting.names, acting.units, strict=True):
        ends = limits.get(name, (-math.inf, math.inf))
        rows.append([name, unit, *(f"{end:.5g}" if math.isfinite(end) else "." for end in ends)])
    return grid(cut(rows, "see linearize -o"), "ll")


def _named_matrix(title: str, values: Array, rows: Sequence[str], columns: Sequence[str]) -> str:
    size = f"{title} ({values.shape[0]} x {values.shape[1]})"
    if not values.any():
        return f"{size} is zero"
    return f"{size}; rows and columns of zeros are not shown\n\n{matrix(values, rows, columns)}"


def _units(lin: LinearModel) -> str:
    """Return the units of states, inputs and outputs, once for each group."""
    lines = [("x", lin.state_names, lin.state_units), ("u", lin.input_names, lin.input_units)]
    if lin.output_names != lin.state_names:
        lines.append(("y", lin.output_names, lin.output_units))
    return "\n".join(
        textwrap.fill(f"{title}: {_grouped(names, units)}", width(), subsequent_indent="   ")
        for title, names, units in lines
    )


def _grouped(names: Sequence[str], units: Sequence[str]) -> str:
    return ", ".join(
        f"{group or ' ... '.join(dict.fromkeys((names[first], names[last])))} [{of}]"
        for first, last, group, of in runs(names, units)
    )


def _rate(unit: str) -> str:
    return "1/s" if unit == "1" else f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"
