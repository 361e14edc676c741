"""Coordinates that move no mass at any configuration, so that M is singular."""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin

from fflin.base.errors import SingularInertiaError, listed
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.robot.frames import ROOT
from fflin.robot.robot import Robot

_FOUND: WeakKeyDictionary[Robot, tuple[str, ...]] = WeakKeyDictionary()

# Singular values below this share of the largest are zero: rounding leaves 1e-15 of it, and the
# least that is meant, of links 1e7 m apart, is 1e-7 of it.
_ZERO = 1e-12

# A principal moment of a body below this share of its largest is zero.
_NO_MOMENT = 1e-12

# A coordinate is named where its share in a motion is larger than this.
_INVOLVED = 0.1


def idle_coordinates(robot: Robot) -> tuple[str, ...]:
    """Return the coordinates that can move together without moving mass; usually none."""
    # The energy vanishes only if the velocity of every mass, every turn that has inertia and every
    # rate that has an armature do: a question of geometry, decided without the masses, whose
    # rounding could hide it.
    if robot not in _FOUND:
        _FOUND[robot] = _idle(robot)
    return _FOUND[robot]


def _idle(robot: Robot) -> tuple[str, ...]:
    bodies = robot.model.inertias.tolist()[ROOT:]
    moments = [np.linalg.eigh(body.inertia) for body in bodies]
    if all(
        body.mass > 0.0 and values[0] > _NO_MOMENT * values[2]
        for body, (values, _) in zip(bodies, moments, strict=True)
    ):
        return ()
    # v = columns nu: joints that mimic others follow them.
    columns = np.eye(robot.nv)
    for joint, leader, multiplier, _ in robot.followers:
        columns[joint.idx_v, leader.idx_v] = multiplier
    columns = columns[:, [*range(6), *(joint.idx_v for joint in robot.joints)]]
    names = np.array(coordinate_names(robot))
    rng = np.random.default_rng(0)
    idle: tuple[str, ...] = ()
    # An M that is singular at two random configurations is singular at all.
    for _ in range(2):
        velocity = columns @ rng.uniform(-1.0, 1.0, columns.shape[1])
        q = pin.integrate(robot.model, robot.neutral(), velocity)
        moved = _moved(robot, q, moments) @ columns
        moved /= np.maximum(np.linalg.norm(moved, axis=0), 1e-300)
        _, sizes, modes = np.linalg.svd(np.linalg.qr(moved, mode="r"))
        rank = int(np.count_nonzero(sizes > _ZERO * sizes.max(initial=0.0)))
        involved = np.linalg.norm(modes[rank:], axis=0) > _INVOLVED
        idle = tuple(dict.fromkeys(names[involved].tolist()))
        if not idle:
            break
    return idle


def coordinate_names(robot: Robot) -> list[str]:
    """Return the names (6 + n) of the coordinates of velocity, in state order, for a message."""
    return ["the base"] * 6 + [f"joint '{name}'" for name in robot.joint_names]


def massless_note(robot: Robot) -> str:
    """Return the message about coordinates that can move without moving mass."""
    idle = listed(idle_coordinates(robot))
    return (
        f"M of '{robot.name}' cannot be inverted at any configuration: {idle} can move without "
        "moving mass; give their links an inertia, or lock the joints"
    )


def require_inertia(robot: Robot) -> None:
    """Refuse an M that is singular at every configuration, which rounding of factors may hide."""
    if idle_coordinates(robot):
        raise SingularInertiaError(massless_note(robot))


def _moved(robot: Robot, q: Array, moments: Sequence[tuple[Array, Array]]) -> Array:
    """Return rows (k, nv) that give, from v, every velocity that has inertia."""
    model, data = robot.model, robot.create_data()
    pin.computeJointJacobians(model, data, q)
    rows = [np.eye(model.nv)[model.armature > 0.0]]
    for index, (values, axes) in enumerate(moments, start=ROOT):
        body = model.inertias[index]
        J = pin.getJointJacobian(model, data, index, pin.ReferenceFrame.LOCAL)
        if body.mass > 0.0:
            rows.append(J[:3] - skew(body.lever) @ J[3:])
        turning = values > _NO_MOMENT * values[2]
        rows.append(axes[:, turning].T @ J[3:])
    return np.vstack(rows)
