r"""Mass properties of links and bodies, their changes, and motions without kinetic energy.

Let a body have the mass m, the centre of mass c and the inertia I about c. With the identity matrix
E, the second moments of its mass distribution about c are
:math:`\Sigma = \tfrac12 \mathrm{tr}(I) E - I`. The pseudo-inertia P (4, 4) consists of m, of the
vector m c, and of the second moments about the origin, :math:`\Sigma + m c c^T`. P is linear in the
mass distribution. The body is physically realisable if and only if P is positive semidefinite
(Wensing, Kim and Slotine, Linear matrix inequalities for physically-consistent inertial parameter
identification, IEEE Robotics and Automation Letters 3(1), 2018).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import filterfalse
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, SingularInertiaError, listed, require_known
from fflin.base.names import by_name, matching
from fflin.base.rotation import skew
from fflin.base.validation import Array, instance, number, positive, shaped, vector, whole
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.urdf.description import TRIANGLE_SLACK, is_impossible

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

_KEYS = ("mass", "com", "inertia")
_SYMMETRIC = 1e-9
# _ROUNDING is the largest relative rounding error of a sum of inertias. _NO_MOMENT is the largest
# relative rounding error of a principal moment of inertia, and of a second moment.
_ROUNDING, _NO_MOMENT = 1e-9, 1e-12

# In `idle_coordinates`, singular values below this fraction of the largest one count as zero. The
# fraction is above the rounding errors of about 1e-15, and below the smallest nonzero value of
# about 1e-7, which occurs for links that are 1e7 m apart.
_ZERO = 1e-12

# A coordinate takes part in motions without kinetic energy if the norm of its components in an
# orthonormal basis of these motions exceeds this value.
_INVOLVED = 0.1


def dynamic_parameters(model: pin.Model) -> bytes:
    """Return the mass properties of all bodies as bytes, for a hash of the robot."""
    return np.array([*map(pin.Inertia.toDynamicParameters, model.inertias.tolist())]).tobytes()


def given_bodies(model: pin.Model, bodies: object) -> dict[int, pin.Inertia]:
    """Return {joint index: inertia} from the argument of `Robot.with_mass_properties`."""
    given = instance("bodies", bodies, Mapping, "{body: value}")
    index_of = {"base": ROOT, **{model.names[i]: i for i in range(ROOT, model.njoints)}}
    first_link, links = len(index_of), dict[int, list[str]]()
    for frame in model.frames.tolist():
        if frame.type == pin.FrameType.BODY and frame.name not in index_of:
            index_of[frame.name] = frame.parentJoint
            links.setdefault(frame.parentJoint, []).append(frame.name)
    names, done, new = [*index_of], dict[int, object](), dict[int, pin.Inertia]()
    for place, value in by_name("body", given, names).items():
        name, index = names[place], index_of[names[place]]
        body, part = "base" if index == ROOT else model.names[index], place >= first_link
        if (part and links[index][1:]) or done.setdefault(index, value) is not value:
            raise InputError(
                f"'{name}' is part of the body '{body}' with the links "
                f"{listed(links.get(index, [name]))}; give the properties of the whole body "
                f"'{body}' once"
            )
        new[index] = given_body(name, value, model.inertias[index])
    return new


def given_body(name: str, value: object, old: pin.Inertia) -> pin.Inertia:
    """Return the new inertia of a body; `value` is an inertia, or {property: new value}."""
    of = f"of '{name}'"
    if isinstance(value, pin.Inertia):
        value = {"mass": value.mass, "com": value.lever, "inertia": value.inertia}
    if not isinstance(value, Mapping):
        raise InputError(
            f"'{name}' has type {type(value).__name__}, expected {{'mass': m, 'com': (3,), "
            "'inertia': (3, 3)} or a pin.Inertia"
        )
    require_known("mass property", value, _KEYS)
    mass = positive(f"mass {of}", value["mass"], "kg") if "mass" in value else old.mass
    com = vector(f"com {of}", value.get("com", old.lever), 3, "a point in the body's frame")
    if "inertia" not in value:
        return pin.Inertia(mass, com, old.inertia * (mass / old.mass if old.mass else 1.0))
    hint = " [kg m^2] about the centre of mass"
    inertia = shaped(f"inertia {of}", value["inertia"], (3, 3), hint)
    symmetric = np.abs(inertia - inertia.T).max() <= _SYMMETRIC * np.abs(inertia).max()
    inertia = 0.5 * (inertia + inertia.T)
    least, middle, largest = moments = np.linalg.eigvalsh(inertia).tolist()
    unequal = largest - middle - least > TRIANGLE_SLACK * largest
    if not symmetric or is_impossible(mass, moments) or unequal:
        raise InputError(
            f"inertia {of} has principal moments {least:.3g}, {middle:.3g}, {largest:.3g} kg m^2 "
            "and is not physically realisable; expected a symmetric matrix with moments of 0 or "
            "more, none of which exceeds the sum of the other two"
        )
    return pin.Inertia(mass, com, inertia)


def random_bodies(model: pin.Model, seed: int, **spreads: float) -> dict[int, pin.Inertia]:
    """Return {joint index: inertia} with random changes of all bodies; see `Robot.perturbed`."""
    spreads = {key: number(key, value) for key, value in spreads.items()}
    for key, spread in spreads.items():
        if not 0.0 <= spread < 1.0:
            raise InputError(f"{key} is {spread:g}, expected 0 or more and less than 1")
    draw, new = np.random.default_rng(whole("seed", seed, 0)), dict[int, pin.Inertia]()
    for index in range(ROOT, model.njoints):
        drawn = draw.uniform(-1.0, 1.0, (1, 7))
        if any(spreads.values()):
            body = model.inertias[index]
            # `radii` (3,) [m] are the root mean square distances of the body's mass from the centre
            # of mass, along each axis.
            second = 0.5 * np.trace(body.inertia) - body.inertia.diagonal()
            radii = np.sqrt(np.abs(second) / (body.mass or np.inf))
            density, com = spreads["mass"] * drawn[:, 0], spreads["com"] * drawn[:, 1:4] * radii
            wider = spreads["inertia"] * drawn[:, 4:]
            mass, com, about = properties(_stretched(body, np.eye(3), density, com, wider))
            new[index] = pin.Inertia(float(mass[0]), com[0], about[0])
    return new


def _stretched(body: pin.Inertia, axes: Array, density: Array, com: Array, inertia: Array) -> Array:
    """Return the pseudo-inertias (N, 4, 4) of N variants of a body.

    `density` (N,) is the relative change of density. `inertia` (N, 3) is the relative change of the
    second moments per unit mass about the centre of mass. `com` (N, 3) [m] shifts the centre of
    mass, and changes neither the mass nor the inertia about the centre of mass. The components of
    `inertia` and `com` are along the columns of `axes` (3, 3).
    """
    # Some files contain physically impossible bodies, which have a negative second moment. Scale
    # such a body equally along all axes, so that the signs of its principal moments do not change.
    least = np.linalg.eigvalsh(0.5 * np.trace(body.inertia) * np.eye(3) - body.inertia)[0]
    if least < -_NO_MOMENT * 0.5 * np.trace(body.inertia):
        inertia = inertia[:, :1] * np.ones(3)
    # If the affine map T is applied to the mass distribution, P becomes T P T^T. This matrix is
    # positive semidefinite if P is. Here, T stretches the body about its centre of mass, and then
    # shifts it.
    T = np.zeros((len(com), 4, 4))
    T[:, :3, :3] = (axes * np.sqrt(1.0 + inertia)[:, None]) @ axes.T
    T[:, :3, 3] = body.lever + com @ axes.T - T[:, :3, :3] @ body.lever
    T[:, 3, 3] = 1.0
    P: Array = body.toPseudoInertia().toMatrix()
    return (1.0 + density)[:, None, None] * (T @ P @ T.swapaxes(1, 2))


def properties(P: Array) -> tuple[Array, Array, Array]:
    """Return masses (N,), centres of mass (N, 3) and inertias (N, 3, 3) about these centres.

    P (N, 4, 4) contains the pseudo-inertias.
    """
    mass = P[:, 3, 3]
    com = P[:, :3, 3] / np.where(mass == 0.0, 1.0, mass)[:, None]
    second = P[:, :3, :3] - mass[:, None, None] * com[:, :, None] * com[:, None]
    about = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    return mass, com, about


class LinkMass(NamedTuple):
    """Mass [kg] of a link, and its inertia (3, 3) [kg m^2] about the centre of mass."""

    mass: float
    inertia: Array
    placement: pin.SE3  # placement of the centre of mass and the inertia's axes on the link


def link_mass(body: pin.Inertia) -> LinkMass:
    """Return the mass properties of a link from its inertia in the axes of the link."""
    return LinkMass(body.mass, body.inertia, pin.SE3(np.eye(3), body.lever))


class Piece(NamedTuple):
    """Mass properties of a link, or of a body of links that are fixed to each other."""

    joint: int
    placement: pin.SE3  # placement of the centre of mass and the inertia's axes on the joint
    mass: float
    inertia: Array
    frame: pin.SE3  # placement of the link's frame on the joint; identity for a whole body
    body: str  # name of the whole body: its joint, or "base"
    whole: bool = False  # whether the piece is a body of several links


def pieces_of(robot: Robot) -> dict[str, Piece]:
    """Return the links and bodies of a robot as {name: piece}.

    - Each link with mass is a piece, if the inertias of the links of its body add up to the
      inertia of the body.
    - Each body is a piece. A body with only one link is the same piece as the link, and has the
      name of the link.
    """
    model, found = robot._bare.model, dict[str, Piece]()
    bodies = ["base" if joint == ROOT else name for joint, name in enumerate(model.names)]
    of_body: dict[int, dict[str, Piece]] = {}
    for name, link in robot.links.items():
        if model.existFrame(name, pin.FrameType.BODY):
            joint, at = find_frame(model, name)
            placement, body = at * link.placement, bodies[joint]
            piece = Piece(joint, placement, link.mass, link.inertia, at, body)
            of_body.setdefault(joint, {})[name] = piece
    for joint in range(ROOT, model.njoints):
        inertia, named = model.inertias[joint], of_body.get(joint, {})
        at, axes, several = pin.SE3(np.eye(3), inertia.lever), pin.SE3.Identity(), len(named) > 1
        whole = Piece(joint, at, inertia.mass, inertia.inertia, axes, bodies[joint], several)
        total = sum((as_inertia(each) for each in named.values()), pin.Inertia.Zero())
        difference = np.abs(total.matrix() - inertia.matrix()).max()
        if difference <= _ROUNDING * np.abs(inertia.matrix()).max():
            found |= named
        found.setdefault(next(iter(named)) if len(named) == 1 else bodies[joint], whole)
    # Wheels and modes are inserted between the joints. Therefore a joint may have another index in
    # the robot's model than in the bare model.
    now = [robot.model.getJointId(name) for name in model.names]
    now[ROOT] = ROOT
    return {name: each._replace(joint=now[each.joint]) for name, each in found.items()}


def bodies_named(robot: Robot, kind: str, key: str) -> list[str]:
    """Return the names of the pieces (links and bodies) that match a name or pattern."""
    pieces, link_of = robot.pieces, robot.link_of
    if key in pieces or key in link_of:
        return [key if key in pieces else link_of[key]]
    names = [*filterfalse(robot._sums.__contains__, pieces), *link_of]
    found = [names[i] for i in matching(kind, key, names)]
    return list(dict.fromkeys(map(link_of.get, found, found)))


def sums_of(robot: Robot) -> frozenset[str]:
    """Return the names of the pieces that are sums of other pieces: the bodies of several links."""
    linked = {each.joint for each in robot.pieces.values() if not each.whole}
    pieces = robot.pieces.items()
    return frozenset(name for name, each in pieces if each.whole and each.joint in linked)


def as_inertia(piece: Piece) -> pin.Inertia:
    """Return the spatial inertia of a piece in the frame of its joint."""
    # The constructor of pin.Inertia refuses an inertia that is negative due to rounding errors.
    body = pin.Inertia(piece.mass, np.zeros(3), np.zeros((3, 3)))
    body.inertia = piece.inertia
    return piece.placement.act(body)


def varied(piece: Piece, mass: Array, density: Array, com: Array, inertia: Array) -> Array:
    """Return the changes (N, 4, 4) of a body's pseudo-inertia due to changes of one piece.

    The changes by `density`, `com` and `inertia` are as in `_stretched`, with components along the
    axes of `piece.frame`. Then, a point mass is added at the centre of mass, which does not change
    the inertia about this point. `mass` (N,) is the ratio of the point mass to the changed mass of
    the piece.
    """
    body = as_inertia(piece)
    after = _stretched(body, piece.frame.rotation, density, com, inertia)
    center = np.concatenate((body.lever + com @ piece.frame.rotation.T, np.ones((len(com), 1))), 1)
    added = (mass * after[:, 3, 3])[:, None, None] * center[:, :, None] * center[:, None]
    changes: Array = after + added - body.toPseudoInertia().toMatrix()
    return changes


def idle_coordinates(robot: Robot) -> tuple[str, ...]:
    """Return the names of the coordinates that can move without kinetic energy; usually none."""
    # A motion has no kinetic energy if it moves no centre of mass, rotates no body about an axis
    # with inertia, and moves no joint with armature. The test uses only whether a mass or moment is
    # zero. If it computed the kinetic energy, rounding errors could hide such a motion.
    bodies = robot.model.inertias.tolist()[ROOT:]
    masses = np.array([*map(attrgetter("mass"), bodies)])
    values, axes = np.linalg.eigh([*map(attrgetter("inertia"), bodies)])
    if (masses > 0.0).all() and (values[:, 0] > _NO_MOMENT * values[:, 2]).all():
        return ()
    moments = [*zip(values, axes, strict=True)]
    # Mimic joints follow their leaders. Therefore v = columns @ nu, where nu is the velocity of the
    # base and of the independent joints.
    columns = np.eye(robot.nv)
    for joint, leader, multiplier, _ in robot.followers:
        columns[joint.idx_v, leader.idx_v] = multiplier
    columns = columns[:, [*range(6), *(joint.idx_v for joint in robot.joints)]]
    names = np.array(coordinate_names(robot))
    rng = np.random.default_rng(0)
    # If M is singular at two random configurations, it is almost surely singular at every
    # configuration.
    for _ in range(2):
        velocity = columns @ rng.uniform(-1.0, 1.0, columns.shape[1])
        q = pin.integrate(robot.model, robot.neutral(), velocity)
        moved = _moved(robot, q, moments) @ columns
        moved /= np.maximum(np.linalg.norm(moved, axis=0), 1e-300)
        _, sizes, modes = np.linalg.svd(np.linalg.qr(moved, mode="r"))
        rank = int(np.count_nonzero(sizes > _ZERO * sizes.max(initial=0.0)))
        involved = np.linalg.norm(modes[rank:], axis=0) > _INVOLVED
        if not involved.any():
            return ()
    return tuple(dict.fromkeys(names[involved].tolist()))


def coordinate_names(robot: Robot) -> list[str]:
    """Return the names of the 6 + n velocity coordinates for messages, in state order."""
    return ["the base"] * 6 + [f"joint '{name}'" for name in robot.joint_names]


def massless_note(robot: Robot) -> str:
    """Return the message about coordinates that can move without kinetic energy."""
    idle = listed(robot.idle_coordinates)
    return (
        f"the mass matrix of '{robot.name}' is singular at every configuration: {idle} can move "
        "without moving mass; give an inertia to the link of each such joint, or lock the joint"
    )


def require_inertia(robot: Robot) -> None:
    """Raise `SingularInertiaError` if M is singular at every configuration.

    Rounding errors may hide this singularity in a factorisation of M.
    """
    if robot.idle_coordinates:
        raise SingularInertiaError(massless_note(robot))


def _moved(robot: Robot, q: Array, moments: Sequence[tuple[Array, Array]]) -> Array:
    """Return the matrix (k, nv) that maps v to all velocities on which the kinetic energy depends.

    These are the rates of joints with armature, the velocities of centres of mass, and the angular
    velocities about principal axes with inertia. `moments` contains the eigenvalues and
    eigenvectors of each inertia.
    """
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
