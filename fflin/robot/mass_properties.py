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
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, listed, require_known
from fflin.base.names import by_name
from fflin.base.rotation import row_products, skew
from fflin.base.validation import (
    Array,
    instance,
    number,
    positive,
    shaped,
    vector,
    whole,
)
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot_data import RobotData
from fflin.robot.urdf.description import TRIANGLE_SLACK, is_impossible

_KEYS = ("mass", "com", "inertia")
_SYMMETRIC = 1e-9
# _ROUNDING is the largest relative rounding error of a sum of inertias. _NO_MOMENT is the largest
# relative rounding error of a principal moment of inertia, and of a second moment.
_ROUNDING, _NO_MOMENT = 1e-9, 1e-12

# Least number of joints without mass between the root and the first body that count as virtual.
_FEWEST_VIRTUAL = 3

# In `idle_coordinates`, singular values below this fraction of the largest one count as zero. The
# fraction is above the rounding errors of about 1e-15, and below the smallest nonzero value of
# about 1e-7, which occurs for links that are 1e7 m apart.
_ZERO = 1e-12

# A coordinate takes part in motions without kinetic energy if the norm of its components in an
# orthonormal basis of these motions exceeds this value.
_INVOLVED = 0.1


def dynamic_parameters(model: pin.Model) -> bytes:
    """Return the mass properties of all bodies as bytes, for a hash of the robot."""
    return np.array(
        [*map(pin.Inertia.toDynamicParameters, model.inertias.tolist())]
    ).tobytes()


def given_bodies(model: pin.Model, bodies: object) -> dict[int, pin.Inertia]:
    """Return {joint index: inertia} from the argument of `Robot.with_mass_properties`."""
    given = instance("bodies", bodies, Mapping, "{body: value}")
    index_of = {"base": ROOT, **{model.names[i]: i for i in range(ROOT, model.njoints)}}
    first_link, links = len(index_of), dict[int, list[str]]()
    for frame in model.frames.tolist():
        if frame.type == pin.FrameType.BODY and frame.name not in index_of:
            index_of[frame.name] = frame.parentJoint
            links.setdefault(frame.parentJoint, []).append(frame.name)
    names = [*index_of]
    done = dict[int, object]()
    new = dict[int, pin.Inertia]()
    for place, value in by_name("body", given, names).items():
        name, index = names[place], index_of[names[place]]
        body = "base" if index == ROOT else model.names[index]
        part = place >= first_link
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
    of_body = f"of '{name}'"
    if isinstance(value, pin.Inertia):
        value = {"mass": value.mass, "com": value.lever, "inertia": value.inertia}
    if not isinstance(value, Mapping):
        raise InputError(
            f"'{name}' has type {type(value).__name__}, expected {{'mass': m, 'com': (3,), "
            "'inertia': (3, 3)} or a pin.Inertia"
        )
    require_known("mass property", value, _KEYS)
    mass = old.mass
    if "mass" in value:
        mass = positive(f"mass {of_body}", value["mass"], "kg")
    com = vector(
        f"com {of_body}", value.get("com", old.lever), 3, "a point in the body's frame"
    )
    if "inertia" not in value:
        scale = mass / old.mass if old.mass else 1.0
        return pin.Inertia(mass, com, old.inertia * scale)
    hint = " [kg m^2] about the centre of mass"
    inertia = shaped(f"inertia {of_body}", value["inertia"], (3, 3), hint)
    symmetric = np.abs(inertia - inertia.T).max() <= _SYMMETRIC * np.abs(inertia).max()
    inertia = 0.5 * (inertia + inertia.T)
    least, middle, largest = moments = np.linalg.eigvalsh(inertia).tolist()
    unequal = largest - middle - least > TRIANGLE_SLACK * largest
    if not symmetric or is_impossible(mass, moments) or unequal:
        raise InputError(
            f"inertia {of_body} has principal moments {least:.3g}, {middle:.3g}, {largest:.3g} "
            "kg m^2 and is not physically realisable; expected a symmetric matrix with moments of "
            "0 or more, none of which exceeds the sum of the other two"
        )
    return pin.Inertia(mass, com, inertia)


def random_bodies(
    model: pin.Model, seed: int, **spreads: float
) -> dict[int, pin.Inertia]:
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
            density = spreads["mass"] * drawn[:, 0]
            com = spreads["com"] * drawn[:, 1:4] * radii
            wider = spreads["inertia"] * drawn[:, 4:]
            mass, com, about = properties(
                _stretched(body, np.eye(3), density, com, wider)
            )
            new[index] = pin.Inertia(float(mass[0]), com[0], about[0])
    return new


def _stretched(
    body: pin.Inertia, axes: Array, density: Array, com: Array, inertia: Array
) -> Array:
    """Return the pseudo-inertias (N, 4, 4) of N variants of a body.

    `density` (N,) is the relative change of density. `inertia` (N, 3) is the relative change of the
    second moments per unit mass about the centre of mass. `com` (N, 3) [m] shifts the centre of
    mass, and changes neither the mass nor the inertia about the centre of mass. The components of
    `inertia` and `com` are along the columns of `axes` (3, 3).
    """
    # Some files contain physically impossible bodies, which have a negative second moment. Scale
    # such a body equally along all axes, so that the signs of its principal moments do not change.
    half_trace = 0.5 * np.trace(body.inertia)
    second_moments = half_trace * np.eye(3) - body.inertia
    least = np.linalg.eigvalsh(second_moments)[0]
    if least < -_NO_MOMENT * half_trace:
        inertia = inertia[:, :1] * np.ones(3)
    # If the affine map T is applied to the mass distribution, P becomes T P T^T. This matrix is
    # positive semidefinite if P is. Here, T stretches the body about its centre of mass, and then
    # shifts it.
    T = np.zeros((len(com), 4, 4))
    stretch = (axes * np.sqrt(1.0 + inertia)[:, None]) @ axes.T
    T[:, :3, :3] = stretch
    T[:, :3, 3] = body.lever + row_products(com, axes.T) - stretch @ body.lever
    T[:, 3, 3] = 1.0
    P: Array = body.toPseudoInertia().toMatrix()
    factor = (1.0 + density)[:, None, None]
    return factor * (T @ P @ T.swapaxes(1, 2))


def properties(P: Array) -> tuple[Array, Array, Array]:
    """Return masses (N,), centres of mass (N, 3) and inertias (N, 3, 3) about these centres.

    P (N, 4, 4) contains the pseudo-inertias.
    """
    mass = P[:, 3, 3]
    com = P[:, :3, 3] / np.where(mass == 0.0, 1.0, mass)[:, None]
    second = P[:, :3, :3] - mass[:, None, None] * com[:, :, None] * com[:, None]
    about = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    return mass, com, about


def equivalent_box(inertia: pin.Inertia) -> tuple[Array, pin.SE3]:
    """Return the sides (3,) [m] and the placement of a uniform box with a given inertia.

    A side is at least a twentieth of the largest side and 1 mm, so that the box can be drawn. The
    mass of the body must be positive.
    """
    moments, axes = np.linalg.eigh(inertia.inertia)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] = -axes[:, 0]
    # Find the sides of a uniform box from its moments of inertia m (b^2 + c^2)/12. If the inertia
    # in the file is not physically realisable, a squared side may be negative; it is set to zero.
    squares = 6.0 / inertia.mass * (moments.sum() - 2.0 * moments)
    sides = np.sqrt(np.maximum(squares, 0.0))
    sides = np.maximum(sides, max(0.05 * sides.max(), 1e-3))
    return sides, pin.SE3(axes, inertia.lever)


class Piece(NamedTuple):
    """Mass properties of a link, or of a body of links that are fixed to each other."""

    joint: int
    # placement of the centre of mass and the inertia's axes on the joint
    placement: pin.SE3
    mass: float
    inertia: Array
    # placement of the link's frame on the joint; identity for a whole body
    frame: pin.SE3
    body: str  # name of the whole body: its joint, or "base"
    whole: bool = False  # whether the piece is a body of several links


def pieces_of(robot: RobotData) -> dict[str, Piece]:
    """Return the links and bodies of a robot as {name: piece}.

    - Each link with mass is a piece, if the inertias of the links of its body add up to the
      inertia of the body.
    - Each body is a piece. A body with only one link is the same piece as the link, and has the
      name of the link.
    """
    model = robot._bare.model
    pieces = dict[str, Piece]()
    bodies = [*model.names]
    bodies[ROOT] = "base"
    of_body: dict[int, dict[str, Piece]] = {}
    for name, link in robot.links.items():
        if model.existFrame(name, pin.FrameType.BODY):
            joint, at = find_frame(model, name)
            placement = at * link.placement
            body = bodies[joint]
            piece = Piece(joint, placement, link.mass, link.inertia, at, body)
            of_body.setdefault(joint, {})[name] = piece
    for joint in range(ROOT, model.njoints):
        inertia = model.inertias[joint]
        named = of_body.get(joint, {})
        at = pin.SE3(np.eye(3), inertia.lever)
        axes = pin.SE3.Identity()
        several = len(named) > 1
        whole = Piece(
            joint, at, inertia.mass, inertia.inertia, axes, bodies[joint], several
        )
        total = sum((as_inertia(piece) for piece in named.values()), pin.Inertia.Zero())
        difference = np.abs(total.matrix() - inertia.matrix()).max()
        if difference <= _ROUNDING * np.abs(inertia.matrix()).max():
            pieces |= named
        title = bodies[joint]
        if len(named) == 1:
            title = next(iter(named))
        pieces.setdefault(title, whole)
    # Wheels and modes are inserted between the joints. Therefore a joint may have another index in
    # the robot's model than in the bare model.
    now = [robot.model.getJointId(name) for name in model.names]
    now[ROOT] = ROOT
    return {
        name: piece._replace(joint=now[piece.joint]) for name, piece in pieces.items()
    }


def sums_of(pieces: Mapping[str, Piece]) -> frozenset[str]:
    """Return the names of the pieces that are sums of other pieces: the bodies of several links."""
    linked = {piece.joint for piece in pieces.values() if not piece.whole}
    return frozenset(
        name for name, piece in pieces.items() if piece.whole and piece.joint in linked
    )


def as_inertia(piece: Piece) -> pin.Inertia:
    """Return the spatial inertia of a piece in the frame of its joint."""
    # The constructor of pin.Inertia refuses an inertia that is negative due to rounding errors.
    body = pin.Inertia(piece.mass, np.zeros(3), np.zeros((3, 3)))
    body.inertia = piece.inertia
    return piece.placement.act(body)


def varied(
    piece: Piece, mass: Array, density: Array, com: Array, inertia: Array
) -> Array:
    """Return the changes (N, 4, 4) of a body's pseudo-inertia due to changes of one piece.

    The changes by `density`, `com` and `inertia` are as in `_stretched`, with components along the
    axes of `piece.frame`. Then, a point mass is added at the centre of mass, which does not change
    the inertia about this point. `mass` (N,) is the ratio of the point mass to the changed mass of
    the piece.
    """
    body = as_inertia(piece)
    after = _stretched(body, piece.frame.rotation, density, com, inertia)
    moved = body.lever + row_products(com, piece.frame.rotation.T)
    center = np.concatenate((moved, np.ones((len(com), 1))), axis=1)
    added = (
        (mass * after[:, 3, 3])[:, None, None] * center[:, :, None] * center[:, None]
    )
    changes: Array = after + added - body.toPseudoInertia().toMatrix()
    return changes


class _Part(NamedTuple):
    """Body with the balls and liquids of its modes, and its motions with kinetic energy.

    Each row of `rows` (r, 6 + k) is a velocity on which the kinetic energy depends, as a linear
    function of the twist (6,) of the body and of the rates (k,) of its modes, in units of v. The
    twist is in the axes of the body's joint, about the point `center` (3,). The modal amplitudes
    are zero. There are 6 + k rows if every motion of the part has kinetic energy.
    """

    joint: int
    center: Array
    modes: list[int]  # indices of the modes in v
    rows: Array


def _rigid_part(model: pin.Model, index: int) -> _Part:
    """Return the body of a joint, which carries no modes."""
    body = model.inertias[index]
    moments, axes = np.linalg.eigh(body.inertia)
    rotations = axes[:, moments > _NO_MOMENT * moments[2]].T
    translations = np.zeros((0, 3))
    if body.mass > 0.0:
        translations = np.eye(3)
    count = len(translations)
    rows = np.zeros((count + len(rotations), 6))
    rows[:count, :3] = translations
    rows[count:, 3:] = rotations
    return _Part(index, body.lever, [], rows)


def _have_inertia(model: pin.Model, indices: Sequence[int]) -> bool:
    """Return whether all bodies of joints have a mass, and moments of inertia about all axes."""
    bodies = [model.inertias[index] for index in indices]
    values = np.linalg.eigvalsh(
        np.reshape([body.inertia for body in bodies], (-1, 3, 3))
    )
    masses = np.array([body.mass for body in bodies])
    return bool(
        (masses > 0.0).all() and (values[:, 0] > _NO_MOMENT * values[:, 2]).all()
    )


def _flexible_part(
    model: pin.Model, body: int, mode_joints: Mapping[int, int]
) -> _Part:
    """Return the body of a joint with the balls and liquids of its modes.

    `mode_joints` maps the joints of these modes to their indices in v, in ascending order.
    """
    # The body without its balls may have negative moments of inertia, so only the inertia matrix of
    # body and balls together is tested for motions without kinetic energy.
    modes = [*mode_joints.values()]
    placements = {body: pin.SE3.Identity()}
    # Jacobians (6, k) from the rates of the modes to the twist of each ball.
    jacobians = {body: np.zeros((6, len(modes)))}
    for column, joint in enumerate(mode_joints):
        parent = model.parents[joint]
        placements[joint] = placements[parent] * model.jointPlacements[joint]
        jacobians[joint] = jacobians[parent].copy()
        joint_data = model.joints[joint].createData()
        model.joints[joint].calc(joint_data, pin.neutral(model))
        axis = np.ravel(joint_data.S)
        jacobians[joint][:, column] = placements[joint].toActionMatrix() @ axis
    inertias = {
        joint: placement.act(model.inertias[joint])
        for joint, placement in placements.items()
    }
    mass = sum(inertia.mass for inertia in inertias.values())
    moment = sum(inertia.mass * inertia.lever for inertia in inertias.values())
    center = np.zeros(3)
    if mass > 0.0:
        center = moment / mass
    to_center = pin.SE3(np.eye(3), -center)
    # Inertia matrix for the twist of the body about `center` and for the mode rates.
    M = np.zeros((6 + len(modes), 6 + len(modes)))
    M[6:, 6:] = np.diag(model.armature[modes])
    for joint, inertia in inertias.items():
        by_modes = to_center.toActionMatrix() @ jacobians[joint]
        V = np.hstack((np.eye(6), by_modes))
        M += V.T @ to_center.act(inertia).matrix() @ V
    # Scale M to a matrix with entries of at most 1, so that its rounding errors are known.
    sizes = M.diagonal().copy()
    sizes[:3] = mass
    sizes[3:6] = np.linalg.eigvalsh(M[3:6, 3:6])[-1]
    scale = np.sqrt(np.where(sizes > 0.0, sizes, 1.0))
    energies, motions = np.linalg.eigh(M / np.outer(scale, scale))
    # Twice the kinetic energy of a velocity v is the sum of energies * (motions' (scale v))^2.
    # Therefore it depends only on these rows. Without division by scale[0], the square root of the
    # mass, the rows would depend on the unit of mass.
    with_energy = motions[:, energies > _NO_MOMENT].T
    rows = with_energy * scale / scale[0]
    return _Part(body, center, modes, rows)


def mode_carriers(robot: RobotData) -> dict[int, int]:
    """Return {joint of a mode: joint of the body that carries the mode}, in ascending order."""
    carrier_of: dict[int, int] = {}
    for index in sorted(robot.model.getJointId(joint.name) for joint in robot.modes):
        parent = robot.model.parents[index]
        carrier_of[index] = carrier_of.get(parent, parent)
    return carrier_of


def idle_coordinates(robot: RobotData) -> tuple[str, ...]:
    """Return the names of the coordinates that can move without kinetic energy; usually none."""
    # A motion has no kinetic energy if it moves no centre of mass, rotates no body about an axis
    # with inertia, and moves no joint with armature. The test uses only whether a mass or moment is
    # zero. If it computed the kinetic energy, rounding errors could hide such a motion.
    model = robot.model
    modes_of: dict[int, dict[int, int]] = {}
    for index, carrier in mode_carriers(robot).items():
        modes_of.setdefault(carrier, {})[index] = model.joints[index].idx_v
    flexible = [_flexible_part(model, *item) for item in modes_of.items()]
    modes = {index for group in modes_of.values() for index in group}
    rigid = [
        i for i in range(ROOT, model.njoints) if i not in modes and i not in modes_of
    ]
    complete = all(part.rows.shape[0] == part.rows.shape[1] for part in flexible)
    if complete and _have_inertia(model, rigid):
        return ()
    parts = [*(_rigid_part(model, index) for index in rigid), *flexible]
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
        moved = _moved(robot, q, parts) @ columns
        moved /= np.maximum(np.linalg.norm(moved, axis=0), 1e-300)
        _, sizes, motions = np.linalg.svd(np.linalg.qr(moved, mode="r"))
        rank = int(np.count_nonzero(sizes > _ZERO * sizes.max(initial=0.0)))
        involved = np.linalg.norm(motions[rank:], axis=0) > _INVOLVED
        if not involved.any():
            return ()
    return tuple(dict.fromkeys(names[involved].tolist()))


def coordinate_names(robot: RobotData) -> list[str]:
    """Return the names of the 6 + n velocity coordinates for messages, in state order."""
    return ["the base"] * 6 + [f"joint '{name}'" for name in robot.joint_names]


def massless_note(robot: RobotData, idle: Sequence[str]) -> str:
    """Return the message about coordinates `idle` that can move without kinetic energy."""
    advice = "give an inertia to the link of each such joint, or lock the joint"
    if {f"joint '{joint.name}'" for joint in robot.modes} & {*idle}:
        advice = (
            "the effective mass of modes is the whole mass of their link in some direction, so "
            "give the link more inertia, or the modes less participation"
        )
    virtual = _virtual_joints(robot)
    if virtual:
        advice = (
            f"the joints {', '.join(virtual)} seem to stand for the free motion of the base, which "
            f"fflin adds by itself: lock them, as in lock={virtual}"
        )
    return (
        f"the mass matrix of '{robot.name}' is singular at every configuration: {listed(idle)} can "
        f"move without moving mass; {advice}"
    )


def _virtual_joints(robot: RobotData) -> list[str]:
    """Return the joints of a chain without mass from the root to the first body, if it is long.

    Some URDFs describe a floating base by such joints. A chain of at least three joints counts.
    """
    model = robot._bare.model
    chain = list[str]()
    body = ROOT
    while model.inertias[body].mass == 0.0:
        children = [
            i for i in range(body + 1, model.njoints) if model.parents[i] == body
        ]
        if len(children) != 1:
            return []
        body = children[0]
        chain.append(model.names[body])
    if len(chain) < _FEWEST_VIRTUAL:
        return []
    return chain


def _moved(robot: RobotData, q: Array, parts: Sequence[_Part]) -> Array:
    """Return the matrix (k, nv) that maps v to all velocities on which the kinetic energy depends.

    These are the rates of joints with armature and the rows of all parts.
    """
    model = robot.model
    data = robot.create_data()
    pin.computeJointJacobians(model, data, q)
    armature = model.armature > 0.0
    armature[[joint.idx_v for joint in robot.modes]] = False  # included in `parts`
    rows = [np.eye(model.nv)[armature]]
    for part in parts:
        J = pin.getJointJacobian(model, data, part.joint, pin.ReferenceFrame.LOCAL)
        linear = J[:3] - skew(part.center) @ J[3:]
        rates = np.eye(model.nv)[part.modes]
        rows.append(part.rows @ np.vstack((linear, J[3:], rates)))
    return np.vstack(rows)
