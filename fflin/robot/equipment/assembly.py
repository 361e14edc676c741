r"""Equipment of a robot: reaction wheels, flexible appendages and slosh, as joints of its model.

Each mode of a flexible appendage is modelled by a ball on a screw joint, see (16.4) of
docs/derivation.md. The ball is a rigid body with the spatial inertia ``I``. At unit modal rate, the
ball has the twist ``S`` and the momentum ``I S``, which is the mode's column of the modal
participation L (6, k). The modal mass is ``S^T I S`` = 1. Mass, inertia and position of the ball
follow from the appendage alone, so the rest of the link does not affect the modal forces. If the
link is too light for its balls, lighter balls are used, whose ``S^T I S`` exceeds 1. A negative
rotor inertia of the joint then reduces the modal mass to 1. The inertia of the ball is subtracted
from the inertia of the link. Therefore, the link and its balls together have the inertia in the
URDF.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, InputError
from fflin.base.validation import Array, frozen
from fflin.robot.equipment.appendages import (
    Appendage,
    FlexibleAppendage,
    Slosh,
    rigid_inertia,
)
from fflin.robot.inputs import Input, ReactionWheel, named_wheels
from fflin.robot.joints import ROOT, Joint, find_frame
from fflin.robot.urdf.description import is_impossible

# For the rigid inertia M_rr (6, 6) of a body, M_rr - L L^T must be positive semidefinite. A
# negative eigenvalue counts as a rounding error if its magnitude is at most this fraction of the
# largest eigenvalue of M_rr.
_NEGATIVE = 1e-9
# A warning is issued if an entry of the rigid inertia (6, 6) in an appendage's file differs from
# the URDF by more than this fraction of the mass. The unit of length in this comparison is the
# radius of gyration.
_AGREE = 1e-2
# Largest total mass of the balls on a body, as a fraction of the body's mass without sloshing
# liquid. The remaining body must have a positive mass, because CRBA adds the inertias of its
# children to it one by one, and each partial sum must have a positive mass. A smaller remainder
# would magnify rounding errors, because its centre of mass is farther away.
_LARGEST_SHARE = 0.99
# The displacement of a ball is converted to a rotation of the appendage about the origin of its
# frame only if the ball is far enough from this origin. The least distance is this fraction of the
# body's radius of gyration.
_SHORTEST = 0.05
# Least mass of a ball, as a fraction of the mass mu of (16.5).
_LIGHTEST = 1e-6
# Least mass and moment of inertia to which the participation of an appendage is compared, as
# fractions of the mass and of the mean moment of inertia of its body.
_LEAST_SCALE = 1e-6
# The fractions a and b of (16.5) count as zero up to this value. Tables of structural programs
# contain numbers of 1e-16 to 1e-12 where zero is meant, and a and b are squares of such numbers.
_NONE = 1e-24
# Bounds of x in (16.6). Up to the first bound, a mode counts as a rotation, whose ball is at the
# origin of the appendage's frame. From the second bound on, the ball is where r' is parallel to t.
_TURNS, _MOVES = 1e-8, 1e-4


class Mounted(NamedTuple):
    """Body that is mounted on a carrier, and the joint between body and carrier.

    `carrier` is the index of a joint of the bare model, or the joint name of another mounted body.
    `placement` is the joint's placement in the carrier's frame. `motion` is the type of the joint.
    `inertia` is the body's inertia in the joint's frame, and `armature` is the joint's rotor
    inertia.
    """

    joint: Joint
    carrier: int | str
    placement: pin.SE3
    motion: pin.JointModel
    inertia: pin.Inertia
    armature: float = 0.0


def with_mounted(
    model: pin.Model, bodies: list[pin.Inertia], parts: list[Mounted]
) -> pin.Model:
    """Return a model with new joints for `parts`; the old joints get the inertias `bodies`.

    In the order of the indices, a new joint comes after all other joints on its carrier.
    """
    new, names = with_marked_frames(model)
    for part in parts:
        on = (
            part.carrier if isinstance(part.carrier, str) else model.names[part.carrier]
        )
        # `appendModel` needs the frame of the carrier's joint, but a model that was built in code
        # may lack it.
        if not new.existFrame(on, pin.FrameType.JOINT):
            new.addJointFrame(new.getJointId(on))
        alone = pin.Model()
        alone.addJoint(0, part.motion, pin.SE3.Identity(), part.joint.name)
        alone.addJointFrame(1)
        new = pin.appendModel(
            new, alone, new.getFrameId(on, pin.FrameType.JOINT), part.placement
        )
    restore_names(new, names)
    carry_over(model, new)
    for name, body in zip(model.names, bodies, strict=True):
        new.inertias[new.getJointId(name)] = body
    new.name = model.name
    new.gravity = model.gravity
    armature = new.armature.copy()
    for part in parts:
        index = new.getJointId(part.joint.name)
        new.inertias[index], armature[new.idx_vs[index]] = part.inertia, part.armature
    new.armature = armature
    return new


def with_marked_frames(
    model: pin.Model, mark: str = ""
) -> tuple[pin.Model, dict[str, str]]:
    """Return a copy of a model with unique marks as frame names, and {mark: original name}.

    When Pinocchio joins or reduces models, it finds frames by name, but a link and a joint may
    share a name. The unique marks prevent errors in this case. Joint frames keep their names.
    """
    marked, names = model.copy(), dict[str, str]()
    for index, frame in enumerate(marked.frames):
        if index and frame.type != pin.FrameType.JOINT:
            names[f"\0{mark}.{index}"] = frame.name
            frame.name = f"\0{mark}.{index}"
    return marked, names


def restore_names(model: pin.Model, names: Mapping[str, str]) -> None:
    """Replace the marks of `with_marked_frames` by the original names of the frames."""
    for frame in model.frames:
        frame.name = names.get(frame.name, frame.name)


def carry_over(model: pin.Model, new: pin.Model) -> None:
    """Copy armatures and lower velocity limits to `new`, because `appendModel` omits them."""
    for name in ("armature", "lowerVelocityLimit"):
        values, old = getattr(new, name).copy(), getattr(model, name)
        for index in range(ROOT, model.njoints):
            at, size = new.idx_vs[new.getJointId(model.names[index])], model.nvs[index]
            values[at : at + size] = old[model.idx_vs[index] :][:size]
        setattr(new, name, values)


def carrier(model: pin.Model, wheel: ReactionWheel) -> tuple[int, Array]:
    """Return the joint that carries a wheel, and the wheel's axis (3,) in the joint's frame."""
    joint, placement = find_frame(model, wheel.frame)
    return joint, placement.rotation @ np.array(wheel.axis)


def stored_momentum(
    model: pin.Model, inputs: Sequence[Input]
) -> tuple[tuple[int, Array], ...]:
    """Return the constant momentum of the wheels without inertia, summed for each carrying joint.

    Each entry is (index of the joint, angular momentum (3,) [N m s] in the axes of the joint).
    """
    stored: dict[int, Array] = {}
    for wheel in inputs:
        if isinstance(wheel, ReactionWheel) and wheel.momentum:
            joint, axis = carrier(model, wheel)
            stored[joint] = stored.get(joint, np.zeros(3)) + wheel.momentum * axis
    return tuple(zip(stored, map(frozen, stored.values()), strict=True))


def mounted_wheels(
    model: pin.Model, bodies: list[pin.Inertia], inputs: Sequence[Input]
) -> list[Mounted]:
    """Return a mounted body for each wheel with inertia.

    The inertia of the wheel is subtracted from its carrier in `bodies`.
    """
    parts = []
    for name, wheel in named_wheels(inputs):
        if not wheel.inertia:
            continue
        joint, axis = carrier(model, wheel)
        rotor_in_carrier = pin.Inertia(
            0.0, np.zeros(3), wheel.inertia * np.outer(axis, axis)
        )
        carrier_alone = bodies[joint] - rotor_in_carrier
        moments = np.linalg.eigvalsh(carrier_alone.inertia).tolist()
        about_axis = float(axis @ bodies[joint].inertia @ axis)
        # Also refuse a wheel whose inertia is, up to rounding errors, the whole inertia of the link
        # about the wheel's axis. Such a link is the wheel itself.
        is_whole_link = wheel.inertia > (1.0 - 1e-9) * about_axis
        if is_impossible(carrier_alone.mass, moments) or is_whole_link:
            lock = ""
            if joint != ROOT:
                joint_name = model.names[joint]
                lock = f"; if joint '{joint_name}' turns the wheel itself, lock it"
            raise InputError(
                f"wheel '{name}' of {wheel.inertia:g} kg m^2 must have less inertia than the "
                f"link that carries it, but {_carrier_name(model, joint)} has "
                f"{about_axis:.3g} kg m^2 about the axis of the wheel; the inertia in the URDF "
                f"must include the wheels, so correct the URDF or the wheel{lock}"
            )
        bodies[joint] = carrier_alone
        # The rotor turns about z of its own frame: RUBZ is an unbounded revolute joint about z.
        placement = pin.SE3(turned_to(axis), np.zeros(3))
        rotor = pin.Inertia(0.0, np.zeros(3), np.diag([0.0, 0.0, wheel.inertia]))
        rotor_joint = Joint(name, unbounded=True)
        parts.append(
            Mounted(rotor_joint, joint, placement, pin.JointModelRUBZ(), rotor)
        )
    return parts


def _carrier_name(model: pin.Model, joint: int) -> str:
    """Return the name of a joint's body for messages."""
    if joint == ROOT:
        return "the base"
    return f"the link of joint '{model.names[joint]}'"


def turned_to(axis: Array) -> Array:
    """Return a rotation matrix (3, 3) that maps z to `axis` (3,), which must have unit length.

    The matrix has no rounding errors if the axis is x, y or z.
    """
    beside = np.cross(np.eye(3)[np.abs(axis).argmin()], axis)
    beside /= np.linalg.norm(beside)
    return np.column_stack((beside, np.cross(axis, beside), axis))


def _carried(model: pin.Model, item: Appendage) -> tuple[int, pin.SE3, Array]:
    """Return the joint that carries an appendage, its placement, and its participation L (6, k).

    The placement of the appendage is relative to the joint. L is in the axes of the joint, about
    the origin of the joint.
    """
    joint, placement = find_frame(model, item.frame)
    return joint, placement, placement.toDualActionMatrix() @ item.participation


def mounted_modes(
    model: pin.Model, bodies: list[pin.Inertia], appendages: Sequence[Appendage]
) -> list[Mounted]:
    """Return a mounted body for each mode.

    The inertia of this body is subtracted from its carrier in `bodies`.
    """
    parts = list[Mounted]()
    of_body: dict[int, list[tuple[Appendage, pin.SE3, Array]]] = {}
    for item in appendages:
        joint, placement, L = _carried(model, item)
        of_body.setdefault(joint, []).append((item, placement, L))
    for joint, items in of_body.items():
        body = bodies[joint]
        L = np.hstack([L for _, _, L in items])
        rows = np.array([body.mass]), body.lever[None], body.inertia[None]
        names = [name for item, _, _ in items for name in item.modes]
        for k, mode in enumerate(names, start=1):
            least = float(_least_eigenvalue(*rows, L[:, :k])[0])
            if not least >= -_NEGATIVE:
                raise InputError(
                    f"the effective masses of the modes up to '{mode}' exceed the inertia of "
                    f"{_carrier_name(model, joint)} ({body.mass:.4g} kg): M_rr - L L^T has "
                    f"the eigenvalue {least:.2g}, relative to the largest eigenvalue of M_rr, "
                    "both about the centre of mass with the radius of gyration as unit of length; "
                    "the inertia in the URDF must include the appendage as if it were rigid"
                )
        columns = list[Column]()
        for item, placement, _ in items:
            if isinstance(item, Slosh):
                at = placement * np.array(item.position)
                bodies[joint] = bodies[joint] - pin.Inertia(
                    item.mass, at, np.zeros((3, 3))
                )
                parts += _liquid(item, joint, placement)
            else:
                columns += _columns(item, body, placement)
        body = bodies[joint]
        balls = [_ball(joint, body, column) for column in columns]
        mass = sum(ball.inertia.mass for ball in balls)
        lighter = 1.0
        if mass:
            lighter = _LARGEST_SHARE * body.mass / mass
        if lighter < _LIGHTEST:
            raise InputError(
                f"mode '{balls[0].joint.name}' moves the centre of mass of its body, but without "
                f"the sloshing liquid this body has only {body.mass:.3g} kg; the mass in the URDF "
                "must include the appendage and the liquid"
            )
        if lighter < 1.0:
            balls = [_ball(joint, body, column, lighter) for column in columns]
        for ball in balls:
            bodies[joint] = bodies[joint] - ball.placement.act(ball.inertia)
        parts += balls
    return parts


def effective_shares(
    model: pin.Model, appendages: Sequence[Appendage]
) -> dict[str, Array]:
    """Return the effective masses and moments of inertia (6,) of each mode, as {mode: values}.

    Each value is a fraction of the corresponding mass or moment of the rigid inertia, along the
    axes and about the origin of the appendage's frame. The rigid inertia is from the file of the
    appendage. If there is no file, it is the inertia of the carrying body.
    """
    shares_of_mode: dict[str, Array] = {}
    for item in appendages:
        joint, placement = find_frame(model, item.frame)
        total = model.inertias[joint].se3Action(placement.inverse()).matrix()
        if isinstance(item, FlexibleAppendage) and item.inertia is not None:
            total = item.inertia
        shares = item.participation.T**2 / np.maximum(total.diagonal(), 1e-300)
        shares_of_mode |= dict(zip(item.modes, shares, strict=True))
    return shares_of_mode


def compare_inertia(
    appendage: FlexibleAppendage, inertia: Array, of_urdf: pin.Inertia, what: str
) -> None:
    """Warn if the rigid inertia in an appendage's file differs from the inertia in the URDF."""
    scale = np.array([1.0, 1.0, 1.0, *[1.0 / _radius_of_gyration(of_urdf)] * 3])
    apart = np.abs(of_urdf.matrix() - inertia) * np.outer(scale, scale)
    of_file = rigid_inertia(inertia)
    if apart.max() > _AGREE * max(of_urdf.mass, of_file.mass):
        file, urdf = (
            f"{x.mass:.4g} kg at ({', '.join(f'{r:.4g}' for r in x.lever)}) m"
            for x in (of_file, of_urdf)
        )
        warnings.warn(
            f"flexible appendage '{appendage.title}': the inertia in its file ({file}) differs "
            f"from the inertia of {what} ({urdf} in the axes of the frame) in these values or in "
            "the moments of inertia; correct the URDF, or use the inertia of the file with "
            "rigid=True",
            FflinWarning,
            stacklevel=6,
        )


def _radius_of_gyration(body: pin.Inertia) -> float:
    """Return the root mean square distance [m] of a body's mass from the origin of its frame."""
    trace = max(float(np.trace(body.matrix()[3:, 3:])), 1e-300)
    return math.sqrt(trace / max(2.0 * body.mass, 1e-300))


def _least_eigenvalue(mass: Array, center: Array, inertia: Array, L: Array) -> Array:
    """Return the least eigenvalue (N,) of M_rr - L L^T, divided by the largest eigenvalue of M_rr.

    Both matrices are about the centre of mass, and their unit of length is the radius of gyration.
    M_rr is computed for N variants of a body from the masses (N,), the centres of mass (N, 3), and
    the inertias (N, 3, 3) about these centres. L (6, k) is about the origin of the joint. The
    result is -inf for a variant with values that are not finite.
    """
    # In `M` and `modes`, moments are about the centre of mass, and the unit of length is the radius
    # of gyration `size`.
    trace = np.trace(inertia, axis1=1, axis2=2)
    size = np.sqrt(np.maximum(trace, 1e-300) / np.maximum(2.0 * mass, 1e-300))[
        :, None, None
    ]
    t, r = np.split(L, 2)
    modes = np.empty((len(mass), *L.shape))
    modes[:, :3] = t
    modes[:, 3:] = (r - np.cross(center[:, :, None], t[None], axis=1)) / size
    M = np.zeros((len(mass), 6, 6))
    M[:, :3, :3], M[:, 3:, 3:] = mass[:, None, None] * np.eye(3), inertia / size**2
    left = M - modes @ modes.swapaxes(1, 2)
    least = np.full(len(mass), -np.inf)
    finite = np.isfinite(left).all(axis=(1, 2))
    largest = np.linalg.eigvalsh(M[finite])[:, -1]
    least[finite] = np.linalg.eigvalsh(left[finite])[:, 0] / largest
    return least


def first_impossible(
    model: pin.Model,
    appendages: Sequence[Appendage],
    bodies: Mapping[int, tuple[Array, Array, Array]],
) -> int | None:
    """Return the index of the first sample in which a body has too little inertia for its modes.

    `model` is the model without wheels and modes. `bodies` maps its joint indices to the masses
    (N,), centres of mass (N, 3) and inertias (N, 3, 3) of N samples. The result is None if all
    samples are possible.
    """
    carried = [_carried(model, item) for item in appendages]
    impossible = []
    for joint, rows in bodies.items():
        if of_body := [L for carrier, _, L in carried if carrier == joint]:
            least = _least_eigenvalue(*rows, np.hstack(of_body))
            impossible += np.flatnonzero(~(least >= -_NEGATIVE)).tolist()
    return min(impossible, default=None)


class Column(NamedTuple):
    """Modal participation of one mode, in the axes of the joint that carries the appendage.

    `t` (3,) is the translation and `r` (3,) the rotation about the origin `p` (3,) of the
    appendage's frame. `mass` and `moment` are the scales m_a and I_a of the appendage in (16.5).
    """

    name: str
    t: Array
    r: Array
    p: Array
    mass: float
    moment: float


def _columns(
    item: FlexibleAppendage, body: pin.Inertia, placement: pin.SE3
) -> list[Column]:
    """Return the modes of an appendage whose frame has the given placement on its body."""
    T = placement.rotation @ item.translation
    R = placement.rotation @ item.rotation
    # The scales depend on the body only if the appendage hardly translates or hardly rotates.
    least_moment = float(np.trace(body.inertia)) / 3.0
    mass = max(float(np.square(T).sum()), _LEAST_SCALE * body.mass)
    moment = max(float(np.square(R).sum()), _LEAST_SCALE * least_moment)
    rows = zip(item.modes, T.T, R.T, strict=True)
    return [
        Column(name, t, r, placement.translation, mass, moment) for name, t, r in rows
    ]


def _smooth_step(x: float) -> float:
    """Return the factor sigma of (16.6): 0 for x <= _TURNS, and 1 for x >= _MOVES.

    In between, sigma is a smooth function of log(x).
    """
    if x <= _TURNS:
        return 0.0
    y = min(1.0, math.log(x / _TURNS) / math.log(_MOVES / _TURNS))
    sigma = y * y * (3.0 - 2.0 * y)
    # The distance from the ball to its joint axis is proportional to 1 / (1 - sigma). Therefore
    # sigma jumps to 1 before this distance is too large.
    if 1.0 - sigma > 1e-6:
        return sigma
    return 1.0


class _AtBall(NamedTuple):
    """Modal participation of one mode about the ball.

    `center` (3,) is the ball relative to the origin of the appendage's frame. About the ball, the
    participation is `t` (3,) and r' = `along` + `across` (3,), of which `along` is parallel to t
    and `across` is perpendicular to t. `fraction` is a + b of (16.5).
    """

    center: Array
    t: Array
    along: Array
    across: Array
    fraction: float


def _at_ball(column: Column) -> _AtBall:
    """Choose the ball of a mode by (16.5) and (16.6)."""
    zero: Array = np.zeros(3)
    t, r = column.t, column.r
    center, along, across = zero, zero, r
    a = _square_over(t, column.mass)
    if a > _NONE:
        square = float(t @ t)
        along = t * (float(t @ r) / square)
        across = r - along
        sigma = _smooth_step(a / (a + _square_over(across, column.moment)))
        center = sigma * np.cross(t, r) / square
        across = (1.0 - sigma) * across
    else:
        a = 0.0
        t = zero
    b = _square_over(along + across, column.moment)
    if b <= _NONE:
        b = 0.0
        along = zero
        across = zero
    return _AtBall(center, t, along, across, a + b)


def _square_over(vector: Array, scale: float) -> float:
    """Return |vector|^2 / scale, or 0 if the vector is zero. In this case, the scale may be 0."""
    square = float(vector @ vector)
    if square == 0.0:
        return 0.0
    return square / scale


def _ball(
    joint: int, body: pin.Inertia, column: Column, lighter: float = 1.0
) -> Mounted:
    """Return the ball that models a mode by (16.4) to (16.6).

    `joint` is the joint that carries the body. `lighter` is the mass of the ball, as a fraction of
    the mass mu in (16.5). If `lighter` is 1, the joint needs no rotor inertia.
    """
    at = _at_ball(column)
    t = at.t
    r = at.along + at.across
    mass = at.fraction * column.mass
    moment = 0.0
    if r.any():
        moment = at.fraction * column.moment
    v, w = t / (mass or 1.0), r / (moment or 1.0)
    moving, turning, lever = math.hypot(*v), math.hypot(*w), math.hypot(*at.center)
    # Bound the rotation of the appendage for a unit amplitude. The ball rotates by |w|. Its centre
    # moves by |v|, at the distance `lever` from the origin of the appendage's frame. This is a
    # rotation by at most |v| / lever about this origin, which is neglected if `lever` is too short.
    # The bound does not depend on `lighter`, because `mass` is still mu.
    rotation = turning
    if moving and lever >= _SHORTEST * _radius_of_gyration(body):
        rotation += moving / lever
    mass *= lighter
    v, moving = v / lighter, moving / lighter
    motion: pin.JointModel = pin.JointModelPZ()
    axis: Array = np.array([0.0, 0.0, 1.0])
    scale = 1.0
    offset: Array = np.zeros(3)  # from the ball to the joint axis
    if turning:
        axis = w / turning
        scale = turning
        pitch = float(v @ w) / turning**2
        # w x v / |w|^2, where only the part of w across v counts. It is exactly 0 for sigma = 1.
        offset = np.cross(at.across, v) / (moment * turning**2)
        motion = pin.JointModelRZ()
        if pitch:
            motion = pin.JointModelHZ(pitch)
    elif moving:
        axis = v / moving
        scale = moving
    # The modal mass of 1 is the sum of S^T I S, which is t @ v + r @ w, and of the rotor inertia
    # `rotor`. If the mass of the ball is less than mu in (16.5), S^T I S exceeds 1, and `rotor` is
    # negative. If the participation is zero, S = 0 and `rotor` = 1.
    R = turned_to(axis)
    rotor = 1.0 - float(t @ v + r @ w)
    if abs(rotor) < 1e-13:
        rotor = 0.0
    mode = Joint(
        column.name, prismatic=not turning, kind="modal", scale=scale, rotation=rotation
    )
    inertia = pin.Inertia(mass, R.T @ -offset, moment * np.eye(3))
    placement = pin.SE3(R, column.p + at.center + offset)
    return Mounted(mode, joint, placement, motion, inertia, rotor / scale**2)


def _liquid(slosh: Slosh, joint: int, placement: pin.SE3) -> list[Mounted]:
    """Return a slosh mass as two joints in series; the second joint carries the mass."""
    x, y, z = (placement.rotation @ slosh.axes).T
    # A mass on springs slides along x and y. A pendulum rotates about -y, then about x, so that
    # positive angles move its mass in the directions x and y.
    slides = slosh.length is None
    arm = (slosh.length or 0.0) * z
    axes = (x, y) if slides else (-y, x)
    first, second = map(turned_to, axes)
    inertia = slosh.modal_mass
    rotation = float(not slides)
    across = [
        Joint(name, prismatic=slides, kind="slosh", inertia=inertia, rotation=rotation)
        for name in slosh.modes
    ]
    motion = pin.JointModelPZ if slides else pin.JointModelRZ
    hinge = pin.SE3(first, placement * np.array(slosh.position) + arm)
    between = pin.SE3(first.T @ second, np.zeros(3))
    mass = pin.Inertia(slosh.mass, second.T @ -arm, np.zeros((3, 3)))
    outer = Mounted(across[0], joint, hinge, motion(), pin.Inertia.Zero())
    return [outer, Mounted(across[1], slosh.modes[0], between, motion(), mass)]
