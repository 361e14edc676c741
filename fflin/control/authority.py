"""Mass properties of a robot at an operating point, and authority of its wheels and thrusters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations, islice
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.tables import counted, folded, grid
from fflin.base.validation import Array, Mask
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.equipment.mounting import carrier
from fflin.robot.fields import limits_of
from fflin.robot.inputs import named_wheels
from fflin.robot.robot import Robot

_FACETS = 20_000  # normals computed together
_MANY = 36  # thrusters; their zonotope has 400 000 facets

# A force or torque below this fraction of the sum of all thrusts is rounding error.
_ROUNDING = 1e-9

_AXES = "xyz"


def point_properties(robot: Robot, q: Array, v: Array) -> dict[str, object]:
    """Return mass properties and properties of wheels and thrusters, by name, in base axes."""
    center, inertia = mass_properties(robot, q)
    return {
        "center_of_mass": center,
        "inertia": inertia,
        "principal_moments": np.linalg.eigvalsh(inertia),
        "wheel_momentum": wheel_properties(robot, q, v),
        "thruster_authority": thruster_properties(robot, q, center),
    }


def point_report(properties: Mapping[str, Any]) -> str:
    """Format the properties of a robot at an operating point."""
    inertia = properties["inertia"]
    moments, axes = np.linalg.eigh(inertia)
    axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), range(3)])
    rows = [["inertia", *_AXES, "principal", *(f"axis {axis}" for axis in _AXES)]]
    for row, moment, axis, name in zip(inertia, moments, axes.T, _AXES, strict=True):
        shown = ["." if abs(x) < _ROUNDING * moments[-1] else f"{x:.5g}" for x in row]
        along = ["." if abs(x) < _ROUNDING else f"{x:.4f}" for x in axis]
        rows.append([name, *shown, f"{moment:.5g}", *along])
    head_line = (
        f"centre of mass at {_vector(properties['center_of_mass'])} m in the base frame, and "
        "inertia about the centre of mass in kg\u00a0m^2, in base axes, at the operating point"
    )
    wheels = wheel_report(properties["wheel_momentum"])
    thrusters = thruster_report(properties["thruster_authority"])
    return "\n\n".join(filter(None, (folded([head_line]), grid(rows), wheels, thrusters)))


def mass_properties(robot: Robot, q: Array) -> tuple[Array, Array]:
    """Return the centre of mass (3,) [m] and the inertia (3, 3) [kg m^2] about it, in base axes."""
    data, q = robot.create_data(), _at_origin(q)
    pin.ccrba(robot.model, data, q, np.zeros(robot.nv))
    return data.com[0].copy(), np.array(data.Ig.inertia)


def wheel_momenta(robot: Robot, q: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return axes (3, k) of the wheels in base axes, their momenta (k,) and largest momenta (k,).

    Momenta [N m s] are relative to the carriers of the wheels.
    """
    data = robot.create_data()
    pin.forwardKinematics(robot.model, data, _at_origin(q))
    limits, axes, stored, largest = limits_of(robot), [], [], []
    for name, wheel in named_wheels(robot.inputs):
        joint, axis = carrier(robot.model, wheel)
        axes.append(data.oMi[joint].rotation @ axis)
        if wheel.inertia:
            stored.append(wheel.inertia * v[robot.joint(name).idx_v])
            largest.append(wheel.inertia * limits.get(f"qdot_m.{name}", (0.0, math.inf))[1])
        else:
            stored.append(wheel.momentum)
            largest.append(math.inf)
    return np.array(axes).reshape(-1, 3).T, np.array(stored), np.array(largest)


def wheel_properties(robot: Robot, q: Array, v: Array) -> dict[str, object]:
    """Return the total momentum of the wheels, and the momentum that they can store.

    `least` is the largest momentum [N m s] that the wheels can store in every direction. `axes` is
    the number of axes that the wheels span.
    """
    axes, stored, largest = wheel_momenta(robot, q, v)
    rank = int(np.linalg.matrix_rank(axes, tol=1e-6)) if stored.size else 0
    bounded = rank == 3 and np.isfinite(largest).all()
    return {
        "wheels": stored.size,
        "total": axes @ stored,
        "axes": rank,
        "least": least_reach(axes, -largest, largest, np.eye(3)) if bounded else None,
    }


def wheel_report(properties: Mapping[str, Any]) -> str:
    """Format the momentum of the wheels, and the number of axes that they span."""
    if not properties["wheels"]:
        return ""
    total, least = properties["total"], properties["least"]
    text = (
        f"{counted(properties['wheels'], 'wheel')}: total momentum {_vector(total)} N m s, "
        f"magnitude {np.linalg.norm(total):.4g}; they span "
        f"{('no', 'only one', 'only two', 'three')[properties['axes']]} axes"
    )
    if least is not None:
        text += (
            f", and they store at least {least:.4g} N m s in every direction at their largest "
            "speeds"
        )
    return folded([text])


def thruster_properties(robot: Robot, q: Array, center: Array) -> dict[str, object]:
    """Return the force and torque that the thrusters alone can produce in every direction.

    Both are None unless the thrusters can push in every direction, all thrusters have limits, and
    there are at most _MANY thrusters.
    """
    actuation = Actuation(StateMap(robot))
    thrusters = actuation.groups.get("thrust", ())
    found = dict[str, object](thrusters=len(thrusters), every_way=False, bounded=False)
    found |= {"least_force": None, "least_torque": None}
    if not len(thrusters):
        return found
    from fflin.control.channel import input_limits

    W = actuation.columns(robot.create_data(), _at_origin(q))[:6, thrusters]
    W[:3] -= np.cross(center, W[3:].T).T
    low, high = (each[thrusters] for each in input_limits(robot, limits_of(robot)))
    found["every_way"] = gives_every_wrench(W, np.full(len(thrusters), True))
    found["bounded"] = bool(np.isfinite(high).all())
    if found["every_way"] and found["bounded"] and len(thrusters) <= _MANY:
        found["least_torque"] = least_reach(W, low, high, np.eye(6)[:, :3])
        found["least_force"] = least_reach(W, low, high, np.eye(6)[:, 3:])
    return found


def thruster_report(properties: Mapping[str, Any]) -> str:
    """Report whether the thrusters push in every direction, and with what force and torque."""
    if not properties["thrusters"]:
        return ""
    text = f"{counted(properties['thrusters'], 'thruster')} alone "
    if not properties["every_way"]:
        return folded([f"{text}cannot produce a force and a torque in every direction"])
    text += "produce forces and torques in every direction"
    if not properties["bounded"]:
        text += "; some of them have no limit (max)"
    elif properties["least_force"] is not None:
        text += (
            f": at least {properties['least_force']:.4g} N without a torque about the centre of "
            f"mass, or {properties['least_torque']:.4g} N m without a force"
        )
    return folded([text])


def gives_every_wrench(W: Array, pushing: Mask) -> bool:
    """Return whether inputs W (6, k) can produce every wrench; `pushing` inputs only push."""
    from scipy.optimize import nnls

    both = np.hstack((W, -W[:, ~pushing]))
    size = np.linalg.norm(both, axis=0)
    directions = both[:, size > 0.0] / size[size > 0.0]
    units = np.vstack((np.eye(6), -np.eye(6)))
    return all(nnls(directions, wanted)[1] <= _ROUNDING for wanted in units)


def thrusters_give_every_wrench(robot: Robot) -> bool:
    """Return whether thrusters and other base inputs of a robot can push in every direction."""
    actuation = Actuation(StateMap(robot))
    thrusters = actuation.groups.get("thrust")
    if thrusters is None:
        return False
    W = actuation.columns(robot.create_data(), robot.neutral())[:6]
    return gives_every_wrench(W, np.isin(np.arange(W.shape[1]), thrusters))


def least_reach(W: Array, low: Array, high: Array, kept: Array) -> float:
    r"""Return the largest r for which inputs reach W u = r kept d for every unit vector d.

    The values W u of inputs between `low` and `high` form a zonotope
    :math:`\{w : n^T w \le h(n)\}` with :math:`h(n) = \sum_i \max(low_i n^T W_i, high_i n^T W_i)`.
    The normals n of its facets are orthogonal to m - 1 independent columns of W. Within the
    subspace that the columns of `kept` span, a facet is at the distance
    :math:`h(n) / |kept^T n|` from the origin; r is the least of these distances.

    Parameters
    ----------
    W : ndarray (m, k)
        Wrenches of unit inputs; the rank of W is m.
    low, high : ndarray (k,)
        Limits of the inputs, with low <= 0 <= high.
    kept : ndarray (m, d)
        Orthonormal columns.
    """
    scale = np.linalg.norm(W, axis=1)
    columns = W / scale[:, None]
    columns /= np.linalg.norm(columns, axis=0)
    subsets, least = combinations(range(W.shape[1]), len(W) - 1), math.inf
    while chunk := list(islice(subsets, _FACETS)):
        chosen = columns[:, np.array(chunk)].transpose(1, 0, 2)  # (facets, m, m - 1)
        minors = [np.linalg.det(np.delete(chosen, row, axis=1)) for row in range(len(W))]
        normals = np.stack(minors, axis=1) * (-1.0) ** np.arange(len(W))
        normals = normals[np.linalg.norm(normals, axis=1) > _ROUNDING]
        within = np.linalg.norm(normals / scale @ kept, axis=1)
        crossing = within > _ROUNDING * np.linalg.norm(normals / scale, axis=1)
        along = (normals / scale)[crossing] @ W
        for each in (along, -along):
            reach = np.maximum(each * low, each * high).sum(axis=1) / within[crossing]
            least = min(least, float(reach.min(initial=math.inf)))
    return least


def _at_origin(q: Array) -> Array:
    """Return the configuration with the base at the origin, so that world axes are base axes."""
    at_origin = q.copy()
    at_origin[:7] = pin.SE3ToXYZQUAT(pin.SE3.Identity())
    return at_origin


def _vector(values: Array) -> str:
    return f"({', '.join(f'{x:.4g}' for x in np.round(values, 12) + 0.0)})"
