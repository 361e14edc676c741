"""Named parameters of a robot, their effect on the robot, and robots with changed parameters."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.names import matching, stands_for_any
from fflin.base.rotation import skew
from fflin.base.validation import Array, positive
from fflin.robot.equipment.assembly import carrier
from fflin.robot.inputs import ReactionWheel, Thruster
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.mass_properties import Piece, as_inertia
from fflin.robot.robot import Robot

AXES = "xyz"
# (row, column) of the six entries of an inertia.
ENTRIES = {
    a + b: (AXES.index(a), AXES.index(b))
    for a, b in ("xx", "yy", "zz", "xy", "xz", "yz")
}
# Parameters of a link or body.
OF_PIECES = {"mass", "density", *(f"com.{axis}" for axis in AXES)}
OF_PIECES |= {f"inertia.{entry}" for entry in ENTRIES}
_ROUNDING = 1e-9
_TURN = 2.0 * math.pi  # [rad] one revolution


@dataclass(frozen=True)
class Parameter:
    """Parameter, such as "inertia.xx" of "arm", with the robot's derivatives with respect to it."""

    of: str
    part: str
    unit: str
    value: float
    # {Pinocchio joint: change (10,), per unit, of the dynamic parameters of the joint's body}. The
    # ten dynamic parameters are the mass m, the first moment m c, and the entries xx, xy, yy, xz,
    # yz, zz of the inertia about the joint.
    bodies: dict[int, Array] = field(default_factory=dict)
    # index (state order) of the joint whose spring or damper changes; or -1
    joint: int = -1
    by_stiffness: float = 0.0  # change of the joint's stiffness per unit
    by_damping: float = 0.0  # change of the joint's damping per unit
    # (Pinocchio joint, index of the input, wrench (6,) in the joint's frame). A unit of the input
    # exerts a wrench. The third entry is the first derivative of that wrench with respect to the
    # parameter.
    wrench: tuple[int, int, Array] | None = None

    @property
    def name(self) -> str:
        """Name OWNER.PART of the parameter, such as "arm.inertia.xx"."""
        return f"{self.of}.{self.part}"


class Parameters(dict[str, Parameter]):
    """Parameters of a robot by name; a body of one link can be named by its link or joint."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.pieces = robot.pieces
        self._link_of = robot.link_of
        self._sums = robot._sums
        of_pieces = (
            parameter for item in self.pieces.items() for parameter in _of_piece(*item)
        )
        parameters = (*of_pieces, *_of_joints(robot), *_of_inputs(robot))
        super().__init__((parameter.name, parameter) for parameter in parameters)

    def find(self, key: str) -> list[str]:
        """Return the names of the parameters that match a name or pattern.

        For a pattern, mass properties of a body of several links are returned only if no other
        parameter matches. Otherwise a pattern such as "*.mass" would vary the mass of a link twice:
        as the link, and as a part of the body.
        """
        # If the key begins with the name of a body of one link, put the name of the link in its
        # place. If several bodies fit, because names may contain dots, the longest name counts.
        bodies = [body for body in self._link_of if str(key).startswith(f"{body}.")]
        if key not in self and bodies:
            body = max(bodies, key=len)
            key = self._link_of[body] + key.removeprefix(body)
        names = [
            name for name in self if key == name or not self._of_several_links(name)
        ]
        if not stands_for_any(key, names):
            names = list(self)
        return [names[i] for i in matching("parameter", key, names)]

    def ranked(self, only: str | None) -> list[str]:
        """Return the names of the parameters that match `only`.

        The text `only` is an owner such as "arm", a part such as "mass", a name or a pattern. If
        `only` is None, all parameters match.

        Mass properties of a body of several links are left out if other parameters match.
        """
        names = [
            name
            for name, parameter in self.items()
            if only in (None, parameter.of, parameter.part)
            or only == parameter.part.split(".")[0]
        ]
        names = names or self.find(str(only))
        of_single_links = [name for name in names if not self._of_several_links(name)]
        return of_single_links or names

    def _of_several_links(self, name: str) -> bool:
        """Return whether a parameter is a mass property of a body that consists of links."""
        parameter = self[name]
        return parameter.of in self._sums and parameter.part in OF_PIECES

    def refusal(self, values: Mapping[str, float]) -> str:
        """Return why the robot with {parameter: value} is not realisable, or an empty text."""
        try:
            self._bodies(values)
            # Also create the robot, because a link may be too light for its wheels or modes.
            if self._robot.reaction_wheels or self._robot.modes:
                self.robot(values)
        except InputError as error:
            return str(error)
        return ""

    def robot(self, values: Mapping[str, float]) -> Robot:
        """Return the robot with {parameter: value}; raise `InputError` if it is not realisable."""
        nominal = self._robot
        bodies = self._bodies(values)
        parts = self._by_owner(values)
        robot = nominal
        if bodies:
            robot = nominal.with_bodies(bodies)
        springs = {"stiffness": {**robot.stiffness}, "damping": {**robot.damping}}
        for joint in robot.joints:
            changes = parts.get(joint.name, {})
            stiffness = nominal.stiffness.get(joint.name, 0.0)
            if changes and joint.mode and stiffness:
                omega, ratio = joint.oscillation(
                    stiffness, nominal.damping.get(joint.name, 0.0)
                )
                if "frequency" in changes:
                    omega = _TURN * changes["frequency"]
                damping = 2.0 * changes.get("damping", ratio) * joint.inertia * omega
                changes = {"stiffness": joint.inertia * omega**2, "damping": damping}
            for part in springs.keys() & changes.keys():
                springs[part][joint.name] = changes[part]
        inputs = list(robot.inputs)
        for index, (item, names) in enumerate(robot.named_inputs):
            changes = parts.get(names[0], {})
            if isinstance(item, ReactionWheel) and "inertia" in changes:
                inputs[index] = replace(item, inertia=changes["inertia"])
            if isinstance(item, Thruster) and changes:
                old = zip(AXES, item.position, strict=True)
                position = [changes.get(f"position.{axis}", x) for axis, x in old]
                torque = changes.get("torque", item.torque)
                inputs[index] = replace(item, position=position, torque=torque)
        fields = {**springs, "inputs": tuple(inputs)}
        changed = {
            key: value for key, value in fields.items() if value != getattr(robot, key)
        }
        if not changed:
            return robot
        return robot.replace(**changed)

    def _by_owner(self, values: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Convert {parameter: value} to {owner: {part: value}}."""
        owners: dict[str, dict[str, float]] = {}
        for name, value in values.items():
            owners.setdefault(self[name].of, {})[self[name].part] = value
        return owners

    def _bodies(self, values: Mapping[str, float]) -> dict[int, pin.Inertia]:
        """Return {joint: inertia of its body} for all bodies with a changed link.

        The joints are numbered as in the Pinocchio model without wheels. If the inertia of a
        changed link is not physically realisable, raise `InputError`.
        """
        model, bare = self._robot.model, self._robot._bare.model
        bodies: dict[int, Array] = {}
        for name, parts in self._by_owner(values).items():
            changed_parts = {*parts} & OF_PIECES
            piece = self.pieces.get(name)
            if piece is None or not changed_parts:
                continue
            com = piece.frame.actInv(piece.placement.translation)
            inertia = piece.inertia.copy()
            com = [
                parts.get(f"com.{axis}", x) for axis, x in zip(AXES, com, strict=True)
            ]
            for entry, (i, j) in ENTRIES.items():
                inertia[i, j] = inertia[j, i] = parts.get(
                    f"inertia.{entry}", inertia[i, j]
                )
            mass = positive(
                f"the mass of '{name}'", parts.get("mass", piece.mass), "kg"
            )
            density = positive(
                f"the density factor of '{name}'", parts.get("density", 1.0)
            )
            # An unchanged inertia is always accepted, for example zero for a point mass. If the
            # nominal inertia is not physically realisable, the changed one must not be worse.
            was, least = (
                float(np.linalg.eigvalsh(0.5 * np.trace(J) * np.eye(3) - J)[0])
                / (np.trace(J) or 1.0)
                for J in (piece.inertia, inertia)
            )
            sound = np.trace(inertia) > 0.0 and least >= min(
                -_ROUNDING, was - _ROUNDING
            )
            if not sound and (inertia != piece.inertia).any():
                raise InputError(
                    f"the inertia of '{name}' is not physically realisable"
                )
            placement = pin.SE3(
                piece.placement.rotation, piece.frame.act(np.array(com))
            )
            changed = piece._replace(placement=placement, mass=mass, inertia=inertia)
            at = ROOT
            if piece.joint > ROOT:
                at = bare.getJointId(model.names[piece.joint])
            bodies.setdefault(at, bare.inertias[at].toDynamicParameters())
            bodies[at] += density * as_inertia(changed).toDynamicParameters()
            bodies[at] -= as_inertia(piece).toDynamicParameters()
        return {
            at: pin.Inertia.FromDynamicParameters(body) for at, body in bodies.items()
        }


def moments(mass: float, first: Array, inertia: Array) -> Array:
    """Return the dynamic parameters (10,) of a body from its mass, first moment and inertia."""
    return np.array((mass, *first, *inertia[np.triu_indices(3)][[0, 1, 3, 2, 4, 5]]))


def _of_piece(name: str, piece: Piece) -> Iterator[Parameter]:
    """Yield the mass, centre of mass, inertia and density of a link or body."""

    def change(part: str, unit: str, value: float, parameters: Array) -> Parameter:
        return Parameter(name, part, unit, value, {piece.joint: parameters})

    m, c, turn = piece.mass, piece.placement.translation, piece.placement.rotation
    C = skew(c)
    yield change("mass", "kg", m, moments(1.0, c, C.T @ C))
    com = piece.frame.actInv(c).tolist()
    for axis, at, d in zip(AXES, com, piece.frame.rotation.T, strict=True):
        D = skew(d)
        yield change(
            f"com.{axis}", "m", at, moments(0.0, m * d, m * (D.T @ C + C.T @ D))
        )
    for entry, (row, column) in ENTRIES.items():
        unit_inertia = np.zeros((3, 3))
        unit_inertia[row, column] = unit_inertia[column, row] = 1.0
        about = turn @ unit_inertia @ turn.T
        value = float(piece.inertia[row, column])
        yield change(
            f"inertia.{entry}", "kg m^2", value, moments(0.0, np.zeros(3), about)
        )
    yield change("density", "1", 1.0, as_inertia(piece).toDynamicParameters())


def _of_joints(robot: Robot) -> Iterator[Parameter]:
    r"""Yield the stiffness and damping of each joint, or the frequency and damping ratio of a mode.

    The frequency and damping ratio apply to a mode whose link is fixed in space. A mode with the
    inertia I has the stiffness :math:`I \omega^2` and the damping :math:`2 \zeta I \omega`.
    """
    for index, joint in enumerate(robot.joints):
        name, inertia = joint.name, joint.inertia
        stiffness, damping, _ = (values[index].item() for values in robot.springs)
        if joint.mode and stiffness:
            omega, ratio = joint.oscillation(stiffness, damping)
            by_rate, per_turn = 2.0 * inertia * omega, 2.0 * inertia * _TURN
            frequency = Parameter(name, "frequency", "Hz", omega / _TURN, joint=index)
            yield replace(
                frequency, by_stiffness=by_rate * _TURN, by_damping=per_turn * ratio
            )
            yield Parameter(
                name, "damping", "1", ratio, joint=index, by_damping=by_rate
            )
            continue
        per = f"/({joint.unit})" if " " in joint.unit else f"/{joint.unit}"
        force = joint.force_unit
        yield Parameter(
            name, "stiffness", f"{force}{per}", stiffness, joint=index, by_stiffness=1.0
        )
        yield Parameter(
            name, "damping", f"{force} s{per}", damping, joint=index, by_damping=1.0
        )


def _of_thruster(
    robot: Robot, thruster: Thruster, name: str, index: int
) -> Iterator[Parameter]:
    """Yield the parameters of a thruster, which is the input with the given name and index."""
    joint, placement = find_frame(robot.model, thruster.frame)
    position, direction = np.array(thruster.position), np.array(thruster.direction)

    def parameter(part: str, unit: str, value: float, wrench: Array) -> Parameter:
        """Return a parameter whose derivative of the wrench is `wrench` (6,) in the frame."""
        in_joint = np.array(placement.act(pin.Force(wrench)).vector)
        made = Parameter(name, part, unit, value)
        return replace(made, wrench=(joint, index, in_joint))

    for letter, d in zip(AXES, np.eye(3), strict=True):
        moved = np.concatenate((np.zeros(3), np.cross(d, direction)))
        yield parameter(f"position.{letter}", "m", float(position @ d), moved)
        # The sum of the direction and a small vector along d is normalised. So only the component
        # of d that is perpendicular to the direction has an effect.
        across = d - direction * (direction @ d)
        torque = np.cross(position, across) + thruster.torque * across
        tilted = np.concatenate((across, torque))
        yield parameter(f"direction.{letter}", "1", float(direction @ d), tilted)
    if thruster.torque:
        reaction = np.concatenate((np.zeros(3), direction))
        yield parameter("torque", "m", thruster.torque, reaction)


def _of_inputs(robot: Robot) -> Iterator[Parameter]:
    at = 0
    for item, names in robot.named_inputs:
        first = at
        at = at + len(names)
        if isinstance(item, Thruster):
            yield from _of_thruster(robot, item, names[0], first)
        if isinstance(item, ReactionWheel) and item.inertia:
            joint, axis = carrier(robot.model, item)
            wheel_joint = robot.model.getJointId(names[0])
            spin = robot.model.jointPlacements[wheel_joint].rotation.T @ axis
            bodies = {
                wheel_joint: moments(0.0, np.zeros(3), np.outer(spin, spin)),
                joint: moments(0.0, np.zeros(3), -np.outer(axis, axis)),
            }
            yield Parameter(names[0], "inertia", "kg m^2", float(item.inertia), bodies)
