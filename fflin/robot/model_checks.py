"""Checks of a Pinocchio model: its tree, its numbers, and motions that move no mass."""

from collections.abc import Iterator, Sequence
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin

from fflin.base.errors import ModelError, SingularInertiaError, listed
from fflin.base.rotation import skew
from fflin.base.validation import Array, is_rotation
from fflin.robot.joints import ROOT, Joint
from fflin.robot.robot import Robot
from fflin.robot.urdf.links import is_impossible

_FOUND: WeakKeyDictionary[Robot, tuple[str, ...]] = WeakKeyDictionary()

# Singular values below this share of the largest are zero: rounding leaves 1e-15 of it, and the
# least that is meant, of links 1e7 m apart, is 1e-7 of it.
_ZERO = 1e-12

# A principal moment of a body below this share of its largest is zero.
_NO_MOMENT = 1e-12

# A coordinate is named where its share in a motion is larger than this.
_INVOLVED = 0.1


def check_root(model: pin.Model, name: str) -> None:
    """Refuse a model that is not one tree on one free-flyer."""
    root = model.joints[ROOT].shortname() if model.njoints > ROOT else "none"
    if root != "JointModelFreeFlyer":
        raise ModelError(
            f"'{name}': the root joint is {root}, expected JointModelFreeFlyer; build the model "
            "with pin.JointModelFreeFlyer() as its root joint"
        )
    fixed = [model.names[i] for i in range(ROOT + 1, model.njoints) if model.parents[i] == 0]
    if fixed:
        raise ModelError(
            f"'{name}': joint '{fixed[0]}' is attached to the world, not the free-flyer; connect "
            "every moving link to the one base"
        )


def joint_of(model: pin.Model, index: int) -> Joint:
    """Return a joint, or refuse one that has not one degree of freedom."""
    joint = model.joints[index]
    kind = joint.shortname()
    name = model.names[index]
    if kind == "JointModelMimic":
        raise ModelError(
            f"joint '{name}' is a JointModelMimic, for which Pinocchio has no derivatives; load "
            "the URDF with fflin.load, or build the model with mimic=False"
        )
    if joint.nv != 1 or joint.nq not in (1, 2):
        raise ModelError(
            f"joint '{name}' is a {kind.removeprefix('JointModel')} of {joint.nv} "
            f"degrees of freedom, expected 1; lock it with lock=['{name}']"
        )
    return Joint(name, joint.idx_q, joint.idx_v, joint.nq == 2, kind.startswith("JointModelP"))


def check_order(model: pin.Model, name: str) -> None:
    """Refuse joints that are not in depth-first order."""
    above: list[int] = []
    for joint, parent in enumerate(model.parents.tolist()):
        while above and above[-1] != parent:
            above.pop()
        if joint and not above:
            raise ModelError(
                f"'{name}': the joints are not in depth-first order, which makes Pinocchio's CRBA "
                "wrong; add all joints of one branch before the joints of the next"
            )
        above.append(joint)


def check_model(model: pin.Model, name: str) -> None:
    """Refuse a model whose numbers no robot has, by the joint that has them."""
    # All parents first: making the Data of a model whose parents form a loop never ends.
    for faults in (_of_parent, _of_joint):
        for index in range(1, model.njoints):
            for fault in faults(model, index):
                raise ModelError(
                    f"'{name}': joint '{model.names[index]}' {fault}; correct it in the model"
                )


def _of_parent(model: pin.Model, index: int) -> Iterator[str]:
    if not (parent := model.parents[index]) < index:
        yield f"has the parent {parent}, expected a joint before {index}"


def _of_joint(model: pin.Model, index: int) -> Iterator[str]:
    """Yield faults of the placement, the body or the armature of a joint."""
    placement, body = model.jointPlacements[index], model.inertias[index]
    if not np.isfinite(placement.homogeneous).all():
        yield "has a placement that is not finite"
    if not is_rotation(placement.rotation):
        yield "has a placement whose matrix R is not a rotation: R^T R must be I and det R 1"
    if not (np.isfinite(body.mass) and body.mass >= 0.0):
        yield f"has a link with a mass of {body.mass:g} kg, expected 0 or more"
    if not (np.isfinite(body.lever).all() and np.isfinite(body.inertia).all()):
        yield "has a link whose inertia or centre of mass is not finite"
    moments = np.linalg.eigvalsh(body.inertia).tolist()
    if is_impossible(body.mass, moments):
        shown = ", ".join(f"{moment:.3g}" for moment in moments)
        yield f"has a link with principal moments of inertia of {shown} kg m^2, expected 0 or more"
    joint = model.joints[index]
    for value in model.armature[joint.idx_v : joint.idx_v + joint.nv].tolist():
        if not (np.isfinite(value) and value >= 0.0):
            yield f"has an armature of {value:g}, expected 0 or more"


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
        f"the mass matrix of '{robot.name}' is singular at every configuration: {idle} can move "
        "without moving mass; give the links of these joints an inertia, or lock the joints"
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
