"""The figure of a motion: states, inputs, errors and drifts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.names import chosen, input_keys
from fflin.dynamics.state import moving_errors
from fflin.simulation.plots import Signals, draw

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Between rows a target that moves less than this, in SI units, stands still.
_STILL = 1e-12


def draw_motion(motion: Any, path: str | Path | None, show: Sequence[str] | None) -> Figure:
    """Draw a motion, see `plot_motion`."""
    limits = dict(zip(motion.limit_names, motion.limits, strict=True))
    inertias = motion.wheel_inertias.tolist()
    title = f"{motion.robot}: {motion.t[-1]:g} s, frame {motion.frame}"
    if motion.linear is not None:
        title += "; solid: nonlinear, dashed: linear"
    for name, start in zip(motion.phases[1:], motion.starts[1:], strict=True):
        title += f"; {name} at {start:g} s"
    rest = None if motion.phases else resting_from(motion)
    if rest is not None:
        title += f"; reference at rest from {rest:.4g} s"
    names = (*motion.state_names, *input_keys(motion))
    show = [show] if isinstance(show, str) else show
    if not (show is None or isinstance(show, Sequence)):
        raise InputError(f"show is {show!r}, expected a list of names, groups or patterns")
    shown = range(len(names)) if show is None else chosen("state or input", show, names)
    nx = len(motion.state_names)
    states, inputs = [i for i in shown if i < nx], [i - nx for i in shown if i >= nx]
    apart = _apart(motion)
    followed = Signals(motion.x, motion.state_names, motion.state_units, limits, motion.linear)
    if motion.tracked:
        followed = followed._replace(linear=None, reference=motion.target)
    return draw(
        motion.t,
        followed.only(states),
        Signals(motion.u, motion.input_names, motion.input_units, limits).only(inputs),
        dict.fromkeys(motion.wheels, 0.0) | dict(zip(motion.wheels, inertias, strict=False)),
        apart and (apart[0], apart[1].only(states)),
        {motion.kept: motion.momentum_drift, "centre of mass [m]": motion.com_drift},
        title=f"{title}\n{motion.stopped}" if motion.stopped else title,
        marks=[*motion.starts[1:].tolist(), *([] if rest is None else [rest])],
        path=path,
    )


def _apart(motion: Any) -> tuple[str, Signals] | None:
    """Return the errors from a reference, of attitude in degrees, or from the linear model."""
    names, units, linear = motion.state_names, motion.state_units, motion.linear
    if not motion.tracked:
        if linear is None:
            return None
        return "difference", Signals(motion.x - linear, names, units, {})
    found = []
    for x in (motion.x,) if linear is None else (motion.x, linear):
        e = moving_errors(motion.frame, x, motion.target)
        sines = np.minimum(1.0, np.linalg.norm(e[:, :3], axis=1, keepdims=True))
        e[:, :3] *= np.degrees(2.0 / np.sinc(np.arcsin(sines) / np.pi))
        found.append(e)
    flown, *foreseen = found
    return "error", Signals(flown, names, ("deg",) * 3 + units[3:], {}, *foreseen)


def resting_from(motion: Any) -> float | None:
    """Return the time [s] from which a target that moved stands still; None where none does."""
    places = motion.target[:, : motion.x.shape[1] // 2] if motion.tracked else motion.x[:1]
    moved = np.flatnonzero(np.abs(np.diff(places, axis=0)).max(axis=1, initial=0.0) > _STILL)
    if not len(moved) or moved[-1] + 2 >= len(places):
        return None
    return float(motion.t[moved[-1] + 1])
