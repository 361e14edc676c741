"""What is said of a motion: where it began and ended, what it took, what proves it."""

from __future__ import annotations

import textwrap

import numpy as np

from fflin.base.names import group_of
from fflin.base.tables import grid, width
from fflin.base.validation import Array
from fflin.simulation.motion import Motion

# A motion has settled once its error stays below this share of the largest.
_SETTLED = 0.02

# An error below this, in SI units, is rounding.
_NOTHING = 1e-14


def motion_report(motion: Motion, *, controlled: bool = True) -> str:
    """Show where a motion began and ended, what it took, and the figures that prove it."""
    end = motion.t[-1]
    parts = [f"{motion.robot}: {end:g} s, {len(motion.t)} rows, frame {motion.frame}"]
    if motion.stopped:
        parts.append(textwrap.fill(f"stopped: {motion.stopped}", width(), subsequent_indent="  "))
    error = np.abs(motion.error)
    if controlled:
        rows = [["error", "unit", "first", "largest", "last", "settled after [s]"]]
        rows.append(["attitude", "deg", *_course(motion.attitude_error, motion.t)])
        groups = {"r_b": "position", "q_m": "joints", "omega_b": "omega_b", "v_b": "v_b"}
        groups["qdot_m"] = "joint rates"
        for group, title in groups.items():
            at = [i for i, n in enumerate(motion.state_names) if group_of(n) == group]
            if at:
                units = "|".join(dict.fromkeys(motion.state_units[i] for i in at))
                rows.append([title, units, *_course(error[:, at].max(axis=1), motion.t)])
        parts.append(f"\n{grid(rows, 'll')}\n")
        largest = np.abs(motion.u).max(axis=0)
        kinds: dict[tuple[str, str], float] = {}
        for name, unit, value in zip(motion.input_names, motion.input_units, largest, strict=True):
            if value < _NOTHING:
                continue
            key = (group_of(name), unit.replace(" ", "\u00a0"))
            kinds[key] = max(kinds.get(key, 0.0), float(value))
        shown = [f"{name}\u00a0{value:.4g}\u00a0{unit}" for (name, unit), value in kinds.items()]
        line = f"largest inputs: {', '.join(shown) or 'none'}"
        # Name, value and unit stay on one line.
        line = textwrap.fill(line, width(), subsequent_indent="  ", break_on_hyphens=False)
        parts.append(line.replace("\u00a0", " "))
    energy = motion.energy
    parts.append(
        f"energy {energy[0]:.6g} J at first, {energy[-1]:.6g} J at last; "
        f"momentum drift {motion.momentum_drift.max():.1e}"
    )
    if len(motion.com_drift):
        largest = motion.com_drift.max()
        parts.append(f"largest distance of the centre of mass from its line: {largest:.1e} m")
    if motion.linear is not None:
        apart = np.abs(motion.x - motion.linear).max(axis=0)
        most = int(apart.argmax())
        unit = motion.state_units[most].replace("1", "")
        size = f"{apart[most]:.3g} {unit}".rstrip()
        parts.append(
            f"largest difference from the linear model: {size} in {motion.state_names[most]}"
        )
    return "\n".join(parts)


def _course(error: Array, t: Array) -> list[str]:
    largest = float(error.max())
    outside = np.flatnonzero(error > _SETTLED * largest)
    if largest < _NOTHING:
        return [".", ".", ".", "."]
    if len(outside) and outside[-1] == len(error) - 1:
        settled = "not yet"
    else:
        settled = f"{t[outside[-1] + 1]:.3g}"
    return [*(f"{value:.3g}" for value in (error[0], largest, error[-1])), settled]
