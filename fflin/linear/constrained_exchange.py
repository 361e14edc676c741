"""Models of robots with constraints in the coordinates of other tools, at an equilibrium at rest.

The tool's coordinates x' depend on the independent states z by x' = W z, to first order. As many
of them as there are independent states are chosen, such that the chosen rows S of W are regular.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fflin.base.errors import ConstraintError, InputError
from fflin.base.validation import Array, Indices
from fflin.linear.model import LinearModel
from fflin.linear.tool_coordinates import Jacobians, ToolCoordinates

# The chosen coordinates determine the motion if each of them adds at least this fraction.
_REGULAR = 1e-6


class Chosen(NamedTuple):
    """Coordinates of a tool that describe a robot with constraints."""

    rows: Indices  # (2 d,) indices of the chosen coordinates among all of the tool
    S: Array  # (2 d, 2 d) from the independent states to the chosen coordinates
    W: Array  # (nx', 2 d) from the independent states to all coordinates of the tool
    by_state: Array  # (nu, 2 d) term (to.H - source.H) dy/dz of (15.4)


def require_rest(lin: LinearModel, tool: str) -> None:
    """Raise `InputError` if a model is not about an equilibrium at rest, or from a file."""
    if lin._all_states is None:
        raise InputError(
            f"the model of '{lin.robot}' was read from a file, which does not contain the map from "
            "the independent states to all states; linearise the robot again"
        )
    if lin.moving or lin.v.any() or not lin.is_equilibrium():
        raise InputError(
            f"the coordinates of {tool} for a robot with constraints are defined only at an "
            f"equilibrium at rest, but '{lin.robot}' moves or accelerates at this point, so that "
            "the map to the independent states is not constant; linearise about an equilibrium"
        )


def chosen(
    lin: LinearModel, kind: ToolCoordinates, source: Jacobians, to: Jacobians
) -> Chosen:
    """Return the coordinates of a tool for the model of a robot with constraints.

    Joints that are independent in the model are kept. Coordinates of the base are chosen by a
    factorisation with pivoting.
    """
    assert lin._all_states is not None
    by_z = source.left @ lin._all_states
    W: Array = to.P @ by_z
    names = [*kind.states()]
    rates = len(names) - 6 - len(kind.joints)
    d = len(lin.A) // 2
    positions = _rows(lin.state_names[:d], W[:rates, :d], names[:rates])
    velocities = rates + _rows(lin.state_names[d:], W[rates:, d:], names[rates:])
    rows = np.concatenate((positions, velocities))
    return Chosen(rows, W[rows], W, (to.H - source.H) @ by_z)


def _rows(states: tuple[str, ...], W: Array, names: list[str]) -> Indices:
    """Return the rows of W (k, d) of independent coordinates with the given `names` (k,)."""
    from scipy.linalg import qr

    joints = [names.index(name) for name in states if name in names]
    of_base = [column for column, name in enumerate(states) if name not in names]
    joint_groups = "q_m.", "qdot_m."
    base = [row for row, x in enumerate(names) if not x.startswith(joint_groups)]
    if not of_base:
        return np.array(joints, dtype=np.intp)
    _, R, order = qr(W[np.ix_(base, of_base)].T, mode="economic", pivoting=True)
    sizes = np.abs(R.diagonal())
    if sizes.min() < _REGULAR * sizes.max():
        raise ConstraintError(
            "the tool's coordinates of the base do not determine the independent states; "
            "linearise with other coordinates, independent="
        )
    taken = [base[index] for index in order[: len(of_base)]]
    return np.sort(np.array([*joints, *taken], dtype=np.intp))
