"""Transitions between the phases of a motion, which `Motion.then` joins.

A phase must begin at the state and with the bodies with which the phase before it ended. The bodies
are compared by the joint-space inertia matrix M. Only an impact adds a body; a payload may be
released at any time, because a release changes no velocity.
"""

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.impact import inertia_at, joint_called
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

# Tolerance [SI units] of positions and rates when phases are joined: a phase must start where the
# phase before it ended. If the largest rate at this time exceeds 1, the tolerance is multiplied by
# that rate.
_MET = 1e-6

# Tolerance of M_ij, relative to sqrt(M_ii M_jj). A joint that is off by `_MET` changes M by `_MET`
# times the ratio of its lever arm to the radius of gyration, which is below 10.
_SAME = 10.0 * _MET


def require_start(
    name: str, robot: Robot, q: Array, v: Array, end: tuple[Robot, Array, Array]
) -> None:
    """Raise `InputError` if a phase does not begin where the phase before it ended.

    `name` is the name of the phase, whose robot begins at q (nq,) and v (nv,). `end` contains the
    robot, q and v at the end of the phase before it.
    """
    end_robot, end_q, end_v = end
    starts = in_coordinates_of(end_robot, robot, end_q, q[None], v[None])
    start_q, start_v = (rows[0] for rows in starts)
    model = end_robot.model
    apart = np.maximum(
        np.abs(pin.difference(model, end_q, start_q)), np.abs(start_v - end_v)
    )
    for payload in _detached(end_robot, robot):  # its joints may move on
        apart[_joints_of_payload(end_robot, payload)] = 0.0
    if apart.max() > _MET * max(1.0, np.abs(end_v).max()):
        # The joint whose entries of v contain the entry that differs most: its first entry is the
        # last first entry that is not after it.
        worst = int(apart.argmax())
        joint = int(np.searchsorted(model.idx_vs, worst, side="right")) - 1
        raise InputError(
            f"'{name}' does not begin where the motion before it ended: "
            f"'{model.names[joint]}' differs by {apart.max():.2g} in position or rate; "
            "start from q and v in the last row of that motion"
        )
    _require_bodies(name, robot, q, end_robot, start_q)


def named_phase(before: Robot, robot: Robot) -> str:
    """Return the name of a phase of `robot` after a phase of the robot `before`.

    The name states the constraints and payloads that the robot no longer has, and the constraints
    that it has in addition. Without such changes, the name is the robot.
    """
    titles = [item.title for item in robot.constraints]
    titles_before = [item.title for item in before.constraints]
    released = [title for title in titles_before if title not in titles]
    released += _detached(before, robot)
    closed = [title for title in titles if title not in titles_before]
    events = []
    if released:
        events.append(f"{', '.join(released)} released")
    if closed:
        events.append(f"{', '.join(closed)} closed")
    return ", ".join(events) or robot.name


def in_coordinates_of(
    robot: Robot, other: Robot, last: Array, q: Array, v: Array
) -> tuple[Array, Array]:
    """Convert rows q (N, nq) and v (N, nv) of the robot `other` to the coordinates of `robot`.

    Joints that `other` lacks are at rest, at their positions in `last` (nq,), a configuration of
    `robot`.
    """
    new_q = np.tile(last, (len(q), 1))
    new_v = np.zeros((len(q), robot.nv))
    for name in list(robot.model.names)[ROOT:]:
        if not other.model.existJointName(name):
            continue
        to = joint_called(robot, name)
        source = joint_called(other, name)
        q_of_joint = q[:, source.idx_q : source.idx_q + source.nq]
        v_of_joint = v[:, source.idx_v : source.idx_v + source.nv]
        new_q[:, to.idx_q : to.idx_q + to.nq] = q_of_joint
        new_v[:, to.idx_v : to.idx_v + to.nv] = v_of_joint
    return new_q, new_v


def _detached(before: Robot, robot: Robot) -> list[str]:
    """Return the names of the payloads of the robot `before` that `robot` does not have."""
    kept = [prefix for prefix, _ in robot.attached]
    return [prefix for prefix, _ in before.attached if prefix not in kept]


def _joints_of_payload(robot: Robot, prefix: str) -> Array:
    """Return the indices in v of the joints of a payload."""
    columns = [np.zeros(0, dtype=int)]
    for name in robot.model.names[ROOT:]:
        if name.startswith(f"{prefix}."):
            columns.append(_columns(robot, name))
    return np.concatenate(columns)


def _require_bodies(
    name: str, robot: Robot, q: Array, before: Robot, before_q: Array
) -> None:
    """Raise `InputError` if a phase begins with bodies that the phase before it lacks.

    The phase `name` begins with `robot` at q (nq,). The phase before it ended with the robot
    `before`, whose configuration at this time is before_q (nq,).
    """
    if joined := _detached(robot, before):
        payload = dict(robot.attached)[joined[0]]
        raise InputError(
            f"'{name}' begins with '{joined[0]}' of {payload.mass:.6g} kg, which the robot before "
            "it does not have; join the payload by fflin.capture, and give its result before "
            "this phase"
        )
    names = [x for x in robot.model.names[ROOT:] if before.model.existJointName(x)]
    rows = np.concatenate([_columns(robot, x) for x in names])
    before_rows = np.concatenate([_columns(before, x) for x in names])
    M = inertia_at(robot, q)[np.ix_(rows, rows)]
    M_before = inertia_at(before, before_q)[np.ix_(before_rows, before_rows)]
    size = np.sqrt(np.maximum(M.diagonal(), M_before.diagonal()))
    lost = (M_before - M) / np.outer(size, size)
    payloads = _detached(before, robot)
    error = lost
    if payloads:
        J = _jacobian(before, before_q, payloads)[:, before_rows] / size
        error = _not_of_payload(lost, J)
    if np.abs(error).max() > _SAME:
        worst = int(before_rows[np.abs(error).max(axis=0).argmax()])
        joint = int(np.searchsorted(before.model.idx_vs, worst, side="right")) - 1
        difference = f"the inertia that '{before.model.names[joint]}' moves differs"
        if not payloads:
            difference = _difference(M, M_before) or difference
        raise InputError(
            f"'{name}' begins with another robot: {difference}; simulate the robot with which the "
            "motion before it ended, or give the result of fflin.capture or fflin.jam before "
            "this phase"
        )


def _jacobian(robot: Robot, q: Array, payloads: list[str]) -> Array:
    """Return the Jacobians (6 k, nv) of the frames of k payloads."""
    local = pin.ReferenceFrame.LOCAL
    model = robot.model
    data = robot.create_data()
    frames = [model.getFrameId(prefix, pin.FrameType.BODY) for prefix in payloads]
    jacobians = [pin.computeFrameJacobian(model, data, q, x, local) for x in frames]
    return np.concatenate(jacobians)


def _not_of_payload(lost: Array, J: Array) -> Array:
    """Return the part of a lost inertia matrix that no payload on frames can contribute.

    `J` contains the Jacobians of the frames. Payloads contribute J^T I J with a positive
    semidefinite I.
    """
    values, vectors = np.linalg.eigh(lost)
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    onto_rows = np.linalg.pinv(J) @ J
    remainder: Array = lost - onto_rows @ positive @ onto_rows
    return remainder


def _columns(robot: Robot, name: str) -> Array:
    """Return the indices in v of a joint."""
    joint = joint_called(robot, name)
    return np.arange(joint.idx_v, joint.idx_v + joint.nv)


def _difference(M: Array, M_before: Array) -> str:
    """Return how mass or centre of mass differ, or an empty text if both agree."""
    mass, mass_before = M[0, 0], M_before[0, 0]
    if abs(mass - mass_before) > _SAME * mass_before:
        return f"mass {mass:.6g} kg instead of {mass_before:.6g} kg"
    # mass times the displacement of the centre of mass, as a skew-symmetric matrix
    moment = M[3:6, :3] - M_before[3:6, :3]
    displaced = np.linalg.norm(moment) / np.sqrt(2.0) / mass
    radius = np.sqrt(np.trace(M[3:6, 3:6]) / mass)
    if displaced > _SAME * radius:
        return f"its centre of mass is displaced by {displaced:.3g} m"
    return ""
