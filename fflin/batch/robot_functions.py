"""What the models of a batch ask their robot for; of a file it need not be there."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

# Position and quaternion of a free-flyer joint that stands at the robot's root.
AT_ROOT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def functions_of(
    robot: Robot | None, name: str, ignorable: tuple[str, ...] | None
) -> dict[str, Any]:
    """Return what a `LinearModel` computes when it is asked for it, by its fields' names.

    Parameters
    ----------
    robot : Robot or None
        None where the batch was loaded without it.
    name : str
        Of the robot.
    ignorable : tuple of str or None
        The states that the file has as ignorable.
    """
    if robot is None:
        return {
            "_certify": partial(_refuse, "certificate", name),
            "_inertia": partial(_refuse, "inertia M", name),
            "_ignorable": partial(_as_saved, ignorable),
            "_limits": dict,
            "weights": {},
        }
    from fflin.linear.certificate import certify, inertia_matrix
    from fflin.linear.ignorable import ignorable_states
    from fflin.robot.limits import magnitudes_of

    functions: dict[str, Any] = {
        "_certify": certify,
        "_inertia": inertia_matrix,
        "_ignorable": ignorable_states,
        "_limits": magnitudes_of,
    }
    of_robot = {field: partial(function, robot) for field, function in functions.items()}
    return of_robot | {
        "weights": robot.weights,
        "_require_unchanged": robot.require_unchanged,
    }


def own_reference(root: Array, base: Array) -> Array:
    """Return the placement (7,) in the world of a base that is placed (7,) in the root's frame."""
    import pinocchio as pin

    if (root == AT_ROOT).all():
        return base
    placement = pin.SE3ToXYZQUAT(pin.XYZQUATToSE3(root) * pin.XYZQUATToSE3(base))
    placement.setflags(write=False)
    return placement


def _as_saved(ignorable: Any, _: LinearModel) -> Any:
    return ignorable


def _refuse(what: str, name: str, _: LinearModel) -> NoReturn:
    raise InputError(
        f"the {what} needs the robot: load the batch with LinearBatch.load(path, robot) where "
        f"robot is '{name}' as it was"
    )
