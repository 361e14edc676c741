"""How much rounding the inverse inertia can suffer, bounded for all configurations at once."""

from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.robot.robot import Robot

STROKE = 1.0  # [m] that a sliding joint is taken to be out at most


# Of the robots that are alive, which do not change.
_BOUNDS: WeakKeyDictionary[Robot, Array | None] = WeakKeyDictionary()


def inertia_bounds(robot: Robot) -> Array | None:
    """Bounds (nv,) of what each coordinate of a robot moves, see `bounds_of_inertia`."""
    if robot not in _BOUNDS:
        _BOUNDS[robot] = bounds_of_inertia(robot.model)
    return _BOUNDS[robot]


def bounds_of_inertia(model: pin.Model) -> Array | None:
    """Bound what each coordinate moves: its mass, or its moment about the base's origin.

    A body's moment about an axis through that origin is at most its largest principal moment and
    its mass times the square of the way to it, from joint to joint. M's diagonal is no larger.

    Parameters
    ----------
    model : pin.Model
        Its root joint is a free flyer.

    Returns
    -------
    ndarray (nv,) or None
        In Pinocchio's order, for sliding joints within `STROKE`; None where a joint neither turns
        nor slides alone.
    """
    joints = model.joints.tolist()
    slides = [joint.shortname().startswith("JointModelP") for joint in joints]
    if not all(joint.shortname()[:11] in ("JointModelR", "JointModelP") for joint in joints[2:]):
        return None
    inertias, parents = model.inertias.tolist(), model.parents.tolist()
    places = model.jointPlacements.tolist()
    ways = [0.0] * len(joints)
    for index in range(2, len(joints)):
        step = float(np.linalg.norm(places[index].translation)) + STROKE * slides[index]
        ways[index] = ways[parents[index]] + step
    masses = [item.mass for item in inertias]
    moments = [
        # The largest sum of a row is no less than the largest principal moment.
        item.mass * (way + float(np.linalg.norm(item.lever))) ** 2
        + float(np.abs(item.inertia).sum(axis=0).max())
        for item, way in zip(inertias, ways, strict=True)
    ]
    bounds: Array = np.empty(model.nv)
    for index in range(len(joints) - 1, 1, -1):
        bounds[joints[index].idx_v] = masses[index] if slides[index] else moments[index]
        masses[parents[index]] += masses[index]
        moments[parents[index]] += moments[index]
    bounds[:3], bounds[3:6] = masses[1], moments[1]
    return bounds
