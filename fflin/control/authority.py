"""Mass properties and actuator authority of a robot at an operating point."""

import math
from itertools import combinations, islice
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.tables import counted, folded, grid
from fflin.base.validation import Array, Mask
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.equipment.assembly import carrier
from fflin.robot.fields import input_limits, limits_of
from fflin.robot.inputs import named_wheels
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot
from fflin.robot.rotors import spin_axis

# Number of facet normals that `least_reach` computes in one batch.
_FACETS = 20_000

# Largest number of thrusters for which the authority is computed. The wrenches of 36 thrusters
# already form a zonotope with 750 000 facets.
_MANY = 36

# A magnitude below this counts as rounding error. It is relative to the largest moment of inertia,
# or to the length of a unit vector.
_ROUNDING = 1e-9

_AXES = "xyz"


class WheelMomentum(NamedTuple):
    """Total momentum of a robot's wheels in base axes, and the wheels' momentum capacity."""

    wheels: int
    total: Array  # (3,) [N m s]
    axes: int  # number of axes that the wheels span
    # Largest momentum [N m s] that the wheels can store in every direction. It is None if the
    # wheels span fewer than three axes, or if the momentum of a wheel has no limit.
    least: float | None

    def __str__(self) -> str:
        if not self.wheels:
            return ""
        text = (
            f"{counted(self.wheels, 'wheel')}: total momentum {_vector(self.total)} N m s, "
            f"magnitude {np.linalg.norm(self.total):.4g}; they span "
            f"{('no', 'only one', 'only two', 'three')[self.axes]} axes"
        )
        if self.least is not None:
            text += (
                f", and they store at least {self.least:.4g} N m s in every direction at their "
                "largest speeds"
            )
        return folded([text])


class ThrusterAuthority(NamedTuple):
    """Largest force and largest torque that the thrusters alone can produce in every direction.

    `least_force` and `least_torque` are None in three cases: the thrusters cannot produce every
    wrench, a thruster has no limit, or there are more than `_MANY` thrusters.
    """

    thrusters: int
    every_way: bool = False
    bounded: bool = False
    least_force: float | None = None  # [N]
    least_torque: float | None = None  # [N m]

    def __str__(self) -> str:
        if not self.thrusters:
            return ""
        text = f"{counted(self.thrusters, 'thruster')} alone "
        if not self.every_way:
            return folded(
                [f"{text}cannot produce a force and a torque in every direction"]
            )
        text += "produce forces and torques in every direction"
        if not self.bounded:
            text += "; some of them have no limit (max)"
        elif self.least_force is not None:
            text += (
                f": at least {self.least_force:.4g} N without a torque about the centre of mass, "
                f"or {self.least_torque:.4g} N m without a force"
            )
        return folded([text])


class PointProperties(NamedTuple):
    """Mass properties and actuator authority at an operating point, in base axes."""

    center_of_mass: Array  # (3,) [m]
    inertia: Array  # (3, 3) [kg m^2], about the centre of mass
    principal_moments: Array
    wheel_momentum: WheelMomentum
    thruster_authority: ThrusterAuthority

    def __str__(self) -> str:
        moments, axes = np.linalg.eigh(self.inertia)
        axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), range(3)])
        rows = [["inertia", *_AXES, "principal", *(f"axis {axis}" for axis in _AXES)]]
        for row, moment, axis, name in zip(
            self.inertia, moments, axes.T, _AXES, strict=True
        ):
            shown = [
                "." if abs(x) < _ROUNDING * moments[-1] else f"{x:.5g}" for x in row
            ]
            along = ["." if abs(x) < _ROUNDING else f"{x:.4f}" for x in axis]
            rows.append([name, *shown, f"{moment:.5g}", *along])
        head = (
            f"centre of mass at {_vector(self.center_of_mass)} m in the base frame, and inertia "
            "about the centre of mass in kg\u00a0m^2, in base axes, at the operating point"
        )
        equipment = str(self.wheel_momentum), str(self.thruster_authority)
        return "\n\n".join(filter(None, (folded([head]), grid(rows), *equipment)))


def point_properties(robot: Robot, q: Array, v: Array) -> PointProperties:
    """Return the mass properties, the wheel momentum and the thruster authority at q and v."""
    # The base gets its neutral pose, in which base axes are equal to world axes.
    data, q = robot.create_data(), np.concatenate((robot.neutral()[:7], q[7:]))
    pin.ccrba(robot.model, data, q, np.zeros(robot.nv))
    center, inertia = data.com[0].copy(), np.array(data.Ig.inertia)
    of_equipment = wheel_momentum(robot, data, v), thruster_authority(robot, q, center)
    return PointProperties(center, inertia, np.linalg.eigvalsh(inertia), *of_equipment)


def wheel_momentum(robot: Robot, data: pin.Data, v: Array) -> WheelMomentum:
    """Return the wheels' momentum relative to their carriers, and the wheels' momentum capacity."""
    limits = limits_of(robot)
    axes, stored, largest = list[Array](), list[float](), list[float]()

    def add_joint(name: str, inertia: float) -> None:
        most = limits.get(f"qdot_m.{name}", (0.0, math.inf))[1]
        stored.append(inertia * float(v[robot.joint(name).idx_v]))
        largest.append(inertia * most)

    for name, wheel in named_wheels(robot.inputs):
        joint, axis = carrier(robot.model, wheel)
        axes.append(data.oMi[joint].rotation @ axis)
        if wheel.inertia:
            add_joint(name, wheel.inertia)
        else:
            stored.append(wheel.momentum)
            largest.append(math.inf)
    for name, inertia in robot.wheels_at(v).items():
        if name not in robot.reaction_wheels:
            joint = robot.model.getJointId(name)
            axes.append(data.oMi[joint].rotation @ spin_axis(robot, joint))
            add_joint(name, inertia)
    directions = np.array(axes).reshape(-1, 3)
    most = np.array(largest)
    rank = 0
    if axes:
        rank = int(np.linalg.matrix_rank(directions, tol=1e-6))
    least = None
    if rank == 3 and np.isfinite(most).all():
        least = least_reach(directions.T, -most, most, np.eye(3))
    return WheelMomentum(len(axes), np.array(stored) @ directions, rank, least)


def thruster_authority(robot: Robot, q: Array, center: Array) -> ThrusterAuthority:
    """Return the force and the torque about `center` (3,) that the thrusters can produce.

    `center` is the centre of mass. The base must have its neutral pose in q.
    """
    actuation = Actuation(StateMap(robot))
    thrusters = actuation.groups.get("thrust", ())
    count = len(thrusters)
    if not count:
        return ThrusterAuthority(0)
    W = actuation.columns(robot.create_data(), q)[:6, thrusters]
    W[:3] -= np.cross(center, W[3:].T).T
    low, high = (bound[thrusters] for bound in input_limits(robot, limits_of(robot)))
    every_way = gives_every_wrench(W, np.full(count, True))
    bounded = bool(np.isfinite(high).all())
    if not (every_way and bounded and count <= _MANY):
        return ThrusterAuthority(count, every_way, bounded)
    torque, force = (
        least_reach(W, low, high, part) for part in np.hsplit(np.eye(6), 2)
    )
    return ThrusterAuthority(count, every_way, bounded, force, torque)


def gives_every_wrench(W: Array, pushing: Mask) -> bool:
    """Return whether the inputs can produce every wrench.

    Column i of W (6, k) is the wrench of a unit value of input i. `pushing` (k,) is True for inputs
    that cannot be negative.
    """
    from scipy.optimize import nnls

    both = np.hstack((W, -W[:, ~pushing]))
    size = np.linalg.norm(both, axis=0)
    directions = both[:, size > 0.0] / size[size > 0.0]
    units = np.vstack((np.eye(6), -np.eye(6)))
    return all(nnls(directions, wanted)[1] <= _ROUNDING for wanted in units)


def thrusters_give_every_wrench(robot: Robot) -> bool:
    """Return whether the inputs of a robot with thrusters can produce every wrench.

    Return False if the robot has no thrusters.
    """
    actuation = Actuation(StateMap(robot))
    thrusters = actuation.groups.get("thrust")
    if thrusters is None:
        return False
    W = actuation.columns(robot.create_data(), robot.neutral())[:6]
    return gives_every_wrench(W, np.isin(np.arange(W.shape[1]), thrusters))


def torquers_give_every_moment(robot: Robot) -> bool:
    """Return whether magnetorquers on the base can have a magnetic moment in every direction."""
    actuation = Actuation(StateMap(robot))
    axes = [axis for joint, _, axis in actuation.torquers if joint == ROOT]
    return len(axes) > 2 and int(np.linalg.matrix_rank(axes)) == 3


def least_reach(W: Array, low: Array, high: Array, kept: Array) -> float:
    r"""Return the largest wrench magnitude r that the inputs can produce in every direction.

    The directions are the vectors ``kept d`` with unit vectors d. For each of them, some inputs u
    within their limits satisfy ``W u = r kept d``, and r is the largest number with this property.

    The wrenches ``W u`` of inputs between `low` and `high` form a zonotope. It contains each w with
    :math:`n^T w \le h(n)` for all vectors n, where
    :math:`h(n) = \sum_i \max(low_i n^T W_i, high_i n^T W_i)` and :math:`W_i` is column i of W. The
    normal n of each facet is orthogonal to m - 1 independent columns of W. In the subspace spanned
    by the columns of `kept`, the distance of the facet from the origin is
    :math:`h(n) / |kept^T n|`. The smallest of these distances is r.

    Parameters
    ----------
    W : ndarray (m, k)
        Column i is the wrench (or momentum) of a unit value of input i. The rank of W must be m.
    low, high : ndarray (k,)
        Limits of the inputs. They must satisfy ``low <= 0 <= high``.
    kept : ndarray (m, p)
        Orthonormal columns, which span the subspace of the directions.
    """
    # Rows of W may have different units, so the facets are computed from scaled rows. A normal n of
    # scaled wrenches is the normal n / scale of wrenches.
    scale = np.linalg.norm(W, axis=1)
    columns = W / scale[:, None]
    columns /= np.linalg.norm(columns, axis=0)
    subsets = combinations(range(W.shape[1]), len(W) - 1)
    least = math.inf
    while chunk := list(islice(subsets, _FACETS)):
        chosen = columns[:, np.array(chunk)].transpose(1, 0, 2)  # (normals, m, m - 1)
        minors = [
            np.linalg.det(np.delete(chosen, row, axis=1)) for row in range(len(W))
        ]
        normals = np.stack(minors, axis=1) * (-1.0) ** np.arange(len(W))
        normals = normals[np.linalg.norm(normals, axis=1) > _ROUNDING]
        unscaled = normals / scale
        within = np.linalg.norm(unscaled @ kept, axis=1)
        crossing = within > _ROUNDING * np.linalg.norm(unscaled, axis=1)
        along = unscaled[crossing] @ W
        for components in (along, -along):
            reach = (
                np.maximum(components * low, components * high).sum(axis=1)
                / within[crossing]
            )
            least = min(least, float(reach.min(initial=math.inf)))
    return least


def _vector(values: Array) -> str:
    return f"({', '.join(f'{x:.4g}' for x in np.round(values, 12) + 0.0)})"
