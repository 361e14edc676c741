"""What the command line shows of robots, linear models and checks."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from fflin.tables import grid, matrix, width

if TYPE_CHECKING:
    from fflin.eigenmodes import Mode, Modes
    from fflin.linear_model import LinearModel
    from fflin.model import Robot
    from fflin.validation import Array
    from fflin.verification import Check, Row


_LIMITS = "limits in rad, N m and rad/s; of a prismatic joint in m, N and m/s"

# Below this rate [SI] nothing moves to speak of.
_MOVES = 1e-9


def robot_list(entries: Iterable[tuple[str, Robot | str, str]]) -> str:
    """Show robots: (name, the robot or why it does not load, where from)."""
    rows, refused = [["name", "n", "mass [kg]", "from"]], []
    for name, robot, origin in entries:
        if isinstance(robot, str):
            refused.append(f"{name} does not load: {robot}")
        else:
            rows.append([name, str(robot.n), f"{robot.mass:.6g}", origin])
    notes = [textwrap.fill(line, width(), subsequent_indent="  ") for line in refused]
    return "\n\n".join((grid(rows, "lrrl"), *notes))


def robot_info(robot: Robot) -> str:
    """Show a robot's tree, masses and limits."""
    from fflin.frames import ROOT

    model = robot.model
    source = str(robot.urdf) if robot.urdf else "a Pinocchio model"
    head = (
        f"{robot.name}: {_counted(robot.n, 'joint')}, {12 + 2 * robot.n} states, "
        f"{6 + robot.n} inputs, mass {robot.mass:.6g} kg\nfrom {source}"
    )
    depth = {0: -1, 1: 0}
    rows = [["joint", "type", "mass [kg]", "lower", "upper", "effort", "velocity"]]
    rows.append(["(base)", "free", f"{model.inertias[1].mass:.6g}", ".", ".", ".", "."])
    kinds = {
        joint: "prismatic" if joint.prismatic else "continuous" if joint.unbounded else "revolute"
        for joint in robot.joints
    }
    kinds |= {joint: "wheel" for joint in robot.joints if joint.name in robot.wheels}
    for joint, leader, multiplier, offset in robot.followers:
        kinds[joint] = f"mimics {leader.name} * {multiplier:g}"
        kinds[joint] += f" {'-' if offset < 0 else '+'} {abs(offset):g}" if offset else ""
    for joint in sorted(kinds, key=lambda joint: joint.idx_v):
        index = model.getJointId(joint.name)
        depth[index] = depth[model.parents[index]] + 1
        limits = (
            (".", ".")
            if joint.unbounded
            else (
                _limit(model.lowerPositionLimit[joint.idx_q]),
                _limit(model.upperPositionLimit[joint.idx_q]),
            )
        )
        rows.append(
            [
                "  " * depth[index] + joint.name,
                kinds[joint],
                f"{model.inertias[index].mass:.6g}",
                *limits,
                _limit(model.effortLimit[joint.idx_v]),
                _limit(model.velocityLimit[joint.idx_v]),
            ]
        )
    frames = [frame.name for frame in model.frames.tolist() if frame.parentJoint >= ROOT]
    wrapped = textwrap.fill(
        ", ".join(dict.fromkeys(frames)), width(), initial_indent="  ", subsequent_indent="  "
    )
    limited = any(cell != "." for row in rows[1:] for cell in row[3:])
    parts = [head, grid(rows, "ll"), *[_LIMITS] * limited, f"frames\n{wrapped}"]
    if robot.notes:
        notes = (
            textwrap.fill(note, width(), initial_indent="  ", subsequent_indent="    ")
            for note in robot.notes
        )
        parts.append("\n".join(("warnings", *notes)))
    return "\n\n".join(parts)


def linear_model(lin: LinearModel) -> str:
    """Show a linear model: its point, A, B, C, D and its certificate."""
    import numpy as np

    from fflin.eigenmodes import modes

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
    # Elsewhere the poles of a frozen model say nothing about stability.
    growing = modes(lin).unstable if stays and not lin.dt else []
    if growing:
        shown = ", ".join(f"{mode.pole:.5g}" for mode in growing)
        parts.append(textwrap.fill(f"unstable: poles with a positive real part {shown}", width()))
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
        f"{c.inertia_residual:.1e};\ncond(M): {c.condition:.1e}; |f0|: {c.f0:.1e}"
    )
    return "\n\n".join(parts)


def check_report(check: Check) -> str:
    """Show what a check found: a table a route, the single figures, the verdict."""
    states = ("q_b", "r_b", "q_m", "omega_b", "v_b", "qdot_m")
    blocks = [row.block for row in check.rows]
    inputs = dict.fromkeys(b[:-1].split(", ")[1] for b in blocks if b.startswith("B["))
    parts = [f"check of {check.title}"]
    for test in ("ABA derivatives", "differences"):
        rows = {row.block: row for row in check.rows if row.test == test}
        body = [
            [
                state,
                *(_error(rows[f"A[{state}, {column}]"]) for column in states),
                *(_error(rows[f"B[{state}, {column}]"]) for column in inputs),
            ]
            for state in states
        ]
        tolerance = next(iter(rows.values())).tolerance
        parts.append(
            f"A and B against {test}: relative error of each block, at most {tolerance:.1e}"
        )
        parts.append(grid([["", *states, *inputs], *body]))
    single = [r for r in check.rows if r.test not in ("ABA derivatives", "differences")]
    rest = [[f"{r.test}: {r.block}", _error(r), f"at most {r.tolerance:.1e}"] for r in single]
    parts.append(grid(rest, "lrl"))
    if check.ok:
        verdict = f"OK: {len(check.rows)} figures hold; the largest error is {check.max_error:.1e}"
    else:
        names = [f"{row.block} ({row.test})" for row in check.failures[:6]]
        names += ["..."] * (len(check.failures) > 6)
        verdict = f"FAILED: {len(check.failures)} of {len(check.rows)} figures: {', '.join(names)}"
    parts.append(textwrap.fill(verdict, width()))
    return "\n\n".join(parts)


def modes_report(found: Modes) -> str:
    """Show natural modes: how many are rigid, and a table of the others with what moves most."""
    vibrations, others = len(found.vibrations), len(found.modes) - len(found.vibrations)
    head = (
        f"{found.robot}: {_counted(found.rigid_body, 'rigid-body mode')} "
        f"({_counted(found.zero_eigenvalues, 'eigenvalue')} at zero), "
        f"{_counted(vibrations, 'vibration')}"
    )
    head += f", {_counted(others, 'real pole')}" if others else ""
    if not found.equilibrium:
        head += "; not an equilibrium, where eigenvalues are those of a frozen model"
    parts = [textwrap.fill(head, width())]
    if found.unstable:
        poles = ", ".join(f"{mode.pole:.5g}" for mode in found.unstable)
        parts.append(textwrap.fill(f"unstable: poles with a positive real part {poles}", width()))
    rows = [["rad/s", "damping", "time [s]", "", "what moves"]]
    rows += [
        [
            f"{mode.frequency:.6g}" if mode.oscillates else ".",
            f"{mode.damping_ratio:.4g}" if mode.oscillates else ".",
            f"{mode.time_constant:.4g}" if mode.pole.real else ".",
            "unstable" if mode.unstable else "",
            "",
        ]
        for mode in found.modes
    ]
    left = max(map(len, grid(rows, "rrrll").splitlines())) - len(rows[0][-1])
    for row, mode in zip(rows[1:], found.modes, strict=True):
        row[-1] = _moving_most(mode, found.state_names, width() - left)
    if found.modes:
        parts.append(grid(rows, "rrrll"))
    return "\n\n".join(parts)


def _moving_most(mode: Mode, names: Sequence[str], room: int) -> str:
    """Name the positions that move most in a mode, as many as there is room for."""
    shape = mode.shape[: len(names) // 2]
    sizes = abs(shape)
    text = ""
    for i in (-sizes.round(9)).argsort(kind="stable").tolist():
        value = complex(shape[i])
        if abs(value) < 0.1:
            break
        amount = f"{value.real:.2g}"
        if abs(value.imag) > 0.02 * abs(value):  # an angle of more than a degree
            angle = math.degrees(math.atan2(value.imag, value.real))
            amount = f"{abs(value):.2g} at {angle:.0f} deg"
        longer = f"{text}, {names[i]} {amount}" if text else f"{names[i]} {amount}"
        if text and len(longer) > room:
            break
        text = longer
    return text


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _named_matrix(title: str, values: Array, rows: Sequence[str], columns: Sequence[str]) -> str:
    size = f"{title} ({values.shape[0]} x {values.shape[1]})"
    if not values.any():
        return f"{size} is zero"
    return f"{size}; rows and columns of zeros are not shown\n\n{matrix(values, rows, columns)}"


def signals(title: str, values: Array, names: Sequence[str], units: Sequence[str]) -> str:
    """Show what is not zero of a state, an input or a force, with its unit."""
    # A line is broken between entries alone, not at the spaces within them.
    entries = [
        f"{name}\xa0=\xa0{value:.6g}" + (f"\xa0{unit}" if unit != "1" else "")
        for name, value, unit in zip(names, values.tolist(), units, strict=True)
        if value
    ]
    text = textwrap.fill(
        f"{title}: {', '.join(entries)}", width(), subsequent_indent=" " * (len(title) + 2)
    )
    return text.replace("\xa0", " ")


def _units(lin: LinearModel) -> str:
    """Say the units of states, inputs and outputs, once for each group of them."""
    lines = [("x", lin.state_names, lin.state_units), ("u", lin.input_names, lin.input_units)]
    if lin.output_names != lin.state_names:
        lines.append(("y", lin.output_names, lin.output_units))
    return "\n".join(
        textwrap.fill(f"{title}: {_grouped(names, units)}", width(), subsequent_indent="   ")
        for title, names, units in lines
    )


def _grouped(names: Sequence[str], units: Sequence[str]) -> str:
    # Names without a group, such as a thruster's, stand together as long as their unit is one.
    groups: list[tuple[str, list[str], list[str]]] = []
    for name, unit in zip(names, units, strict=True):
        group = name.partition(".")[0] if name.count(".") == 1 else name.rpartition(".")[0]
        last = groups[-1] if groups else None
        if last and last[0] == group and (group or unit in last[2]):
            last[1].append(name)
            last[2].append(unit)
        else:
            groups.append((group, [name], [unit]))
    return ", ".join(
        f"{group or ' ... '.join(dict.fromkeys((members[0], members[-1])))} "
        f"[{'|'.join(dict.fromkeys(of))}]"
        for group, members, of in groups
    )


def _rate(unit: str) -> str:
    return "1/s" if unit == "1" else f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"


def _error(row: Row) -> str:
    text = "." if row.error == 0.0 else f"{row.error:.0e}"
    return text if row.ok else f"{text}!"


def _limit(value: float) -> str:
    # Pinocchio marks what the URDF does not limit by the largest double or by infinity.
    return "." if not math.isfinite(value) or abs(value) > 1e300 else f"{value:.5g}"
