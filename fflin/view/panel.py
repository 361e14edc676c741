"""The panel beside a motion: errors, states, inputs and limits over time."""

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.robot.robot import Robot
from fflin.simulation.motion import Motion
from fflin.simulation.plots import JOINTS, WHEELS, charts, resting_from
from fflin.simulation.report import STATES, Curve
from fflin.view.page import packed

# Values below this, in SI units, count as rounding errors.
_NOTHING = 1e-14

# Lines below this fraction of the largest line of their plot are not drawn.
_UNSEEN = 1e-6

_NONE = np.zeros(0)


def errors(robot: Robot, q: Array, target: Array) -> dict[str, tuple[str, Array]]:
    """Return {quantity: (unit, errors (N,))} of q (N, nq) from the target.

    Wheels and modes are left out.
    """
    goals = np.broadcast_to(target, q.shape)
    apart = np.array([pin.difference(robot.model, *each) for each in zip(goals, q, strict=True)])
    joints = [joint for joint in robot.joints if not (joint.mode or joint.name in robot.wheels)]
    turning = [joint.idx_v for joint in joints if not joint.prismatic]
    sliding = [joint.idx_v for joint in joints if joint.prismatic]
    found = {
        "attitude": ("°", np.degrees(np.linalg.norm(apart[:, 3:6], axis=1))),
        "position": ("m", np.linalg.norm((q - goals)[:, :3], axis=1)),
    }
    if turning:
        found["largest joint"] = ("°", np.degrees(np.abs(apart[:, turning]).max(axis=1)))
    if sliding:
        found["largest prismatic joint"] = ("m", np.abs(apart[:, sliding]).max(axis=1))
    return {k: (unit, np.where(x < _NOTHING, 0.0, x)) for k, (unit, x) in found.items()}


def panel(robot: Robot, motion: Motion, shown: Array, target: Array) -> dict[str, object]:
    """Return the readouts and plots of the rows `shown`, with errors from the target (k, nq)."""
    found = errors(robot, motion.q[shown], target if len(target) else motion.q[:1])
    of = "{} error" if len(target) else "{} change"
    readouts = [(of.format(what), unit, values) for what, (unit, values) in found.items()]
    plots = [
        _plot(title, [Curve("", "", "", unit, values, _NONE)])
        for title, unit, values in readouts[: 4 if len(target) > 1 else 2]
        if values.any()
    ]
    readouts.append((f"{motion.kept} drift", "", motion.momentum_drift[shown]))
    if len(motion.com_drift):  # it may be missing in a file
        readouts.append(("centre of mass drift", "m", motion.com_drift[shown]))
    for title, whole in charts(motion).items():
        lines = []
        for each in whole:
            followed = each.reference if len(target) > 1 else None
            reference = None if followed is None else followed[shown]
            lines.append(each._replace(values=each.values[shown], reference=reference))
        least = max(_NOTHING, _UNSEEN * max(map(_size, lines)))
        seen = [each for each in lines if _size(each) >= least]
        # States of the base have errors instead. Rates are shown only if a limit is near.
        of_base = whole[0].group in STATES and whole[0].group not in JOINTS
        if any(each.near or not title.endswith("rates") for each in seen) and not of_base:
            plots.append(_plot(title, seen))
    return {
        "readouts": [
            {"label": label, "unit": unit, "values": packed(values)}
            for label, unit, values in readouts
        ],
        "plots": plots,
        "rest": resting_from(motion) if len(target) > 1 else None,
        "passed": [[str(each), each.time] for each in motion.passed],
    }


def _size(curve: Curve) -> float:
    """Return the largest magnitude of a curve."""
    rows = curve.values if curve.reference is None else (*curve.values, *curve.reference)
    return float(np.abs(rows).max())


def _plot(title: str, lines: list[Curve]) -> dict[str, object]:
    """Return a plot of curves, with each limit that a curve comes near."""
    group = lines[0].group
    return {
        "title": title,
        "unit": lines[0].unit,
        # A name has the same colour in all plots of a family.
        "family": next((kin[0] for kin in (JOINTS, WHEELS) if group in kin), group),
        "lines": [
            {
                "label": curve.short,
                "values": packed(curve.values),
                "reference": "" if curve.reference is None else packed(curve.reference),
                "limits": curve.near,
            }
            for curve in lines
        ],
    }
