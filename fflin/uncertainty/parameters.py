"""Named parameters of a robot, and the change of the robot per unit of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from fflin.base.names import matching
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.robot.frames import find_frame
from fflin.robot.inputs import ReactionWheel, Thruster, named_inputs
from fflin.robot.link_masses import Piece, pieces_of
from fflin.robot.robot import Robot
from fflin.robot.wheels import carrier

AXES = "xyz"
# (row, column) of the six entries of an inertia.
ENTRIES = {a + b: (AXES.index(a), AXES.index(b)) for a, b in ("xx", "yy", "zz", "xy", "xz", "yz")}


@dataclass(frozen=True)
class Parameter:
    """One parameter, such as "inertia.xx" of "arm", and how a unit of it changes the robot."""

    of: str
    part: str
    unit: str
    value: float
    # {Pinocchio joint: change (10,)} of bodies: m, m c, and I xx, xy, yy, xz, yz, zz at the joint.
    bodies: dict[int, Array] = field(default_factory=dict)
    spring: int = -1  # the joint whose stiffness or damping it is, in state order
    damper: int = -1
    # (Pinocchio joint, input, change (6,) of the wrench of a unit of it in the joint's frame)
    wrench: tuple[int, int, Array] | None = None

    @property
    def name(self) -> str:
        """Name of the parameter: its owner and its part, such as "arm.inertia.xx"."""
        return f"{self.of}.{self.part}"


class Parameters(dict[str, Parameter]):
    """Parameters of a robot by name; a body of one link can also be named by its joint."""

    def __init__(self, robot: Robot) -> None:
        pieces, self._also = pieces_of(robot)
        linked = {each.joint for each in pieces.values() if not each.whole}
        self._sums = {of for of, each in pieces.items() if each.whole and each.joint in linked}
        of_pieces = (each for name, piece in pieces.items() for each in _of_piece(name, piece))
        found = (*of_pieces, *_of_joints(robot), *_of_inputs(robot))
        super().__init__((each.name, each) for each in found)

    def find(self, key: str) -> list[str]:
        """Return the names that a name or pattern stands for."""
        bodies = [body for body in self._also if str(key).startswith(f"{body}.")]
        if key not in self and bodies:
            body = max(bodies, key=len)
            key = self._also[body] + key[len(body) :]
        names = list(self)
        return [names[i] for i in matching("parameter", key, names)]

    def ranked(self, only: str | None) -> list[str]:
        """Return what a name, part or pattern stands for, without bodies beside their links."""
        found = [n for n, x in self.items() if only in (None, x.of, x.part, x.part.split(".")[0])]
        found = found or self.find(str(only))
        return [name for name in found if self[name].of not in self._sums] or found


def moments(mass: float, first: Array, inertia: Array) -> Array:
    """Return the dynamic parameters (10,) of a mass, a first moment and an inertia."""
    return np.array((mass, *first, *inertia[np.triu_indices(3)][[0, 1, 3, 2, 4, 5]]))


def _of_piece(name: str, piece: Piece) -> Iterator[Parameter]:
    """Give mass, centre of mass, inertia and density of a link or body."""

    def change(part: str, unit: str, value: float, parameters: Array) -> Parameter:
        return Parameter(name, part, unit, value, {piece.joint: parameters})

    m, c, turn = piece.mass, piece.placement.translation, piece.placement.rotation
    C = skew(c)
    yield change("mass", "kg", m, moments(1.0, c, C.T @ C))
    own = piece.frame.actInv(c).tolist()
    for axis, at, d in zip(AXES, own, piece.frame.rotation.T, strict=True):
        D = skew(d)
        yield change(f"com.{axis}", "m", at, moments(0.0, m * d, m * (D.T @ C + C.T @ D)))
    for entry, (row, column) in ENTRIES.items():
        unit_inertia = np.zeros((3, 3))
        unit_inertia[row, column] = unit_inertia[column, row] = 1.0
        about = turn @ unit_inertia @ turn.T
        value = float(piece.inertia[row, column])
        yield change(f"inertia.{entry}", "kg m^2", value, moments(0.0, np.zeros(3), about))
    whole = m * C.T @ C + turn @ piece.inertia @ turn.T
    yield change("density", "1", 1.0, moments(m, m * c, whole))


def _of_joints(robot: Robot) -> Iterator[Parameter]:
    for index, joint in enumerate(robot.joints):
        per = "m" if joint.prismatic else "rad"
        force = "N" if joint.prismatic else "N m"
        stiffness, damping, _ = (each[index].item() for each in robot.springs)
        yield Parameter(joint.name, "stiffness", f"{force}/{per}", stiffness, spring=index)
        yield Parameter(joint.name, "damping", f"{force} s/{per}", damping, damper=index)


def _of_inputs(robot: Robot) -> Iterator[Parameter]:
    at = 0
    for item, names in named_inputs(robot.inputs):
        first, at = at, at + len(names)
        if isinstance(item, Thruster):
            joint, placement = find_frame(robot.model, item.frame)
            where, along = np.array(item.position), np.array(item.direction)
            for letter, d in zip(AXES, np.eye(3), strict=True):
                # A direction is of unit length: only what turns it counts.
                turned = d - along * (along @ d)
                moved = np.concatenate((np.zeros(3), np.cross(d, along)))
                tilted = np.concatenate((turned, np.cross(where, turned)))
                for part, unit, value, wrench in (
                    ("position", "m", where @ d, moved),
                    ("direction", "1", along @ d, tilted),
                ):
                    in_joint = np.array(placement.act(pin.Force(wrench)).vector)
                    at_input = (joint, first, in_joint)
                    yield Parameter(
                        names[0], f"{part}.{letter}", unit, float(value), wrench=at_input
                    )
        if isinstance(item, ReactionWheel) and item.inertia:
            joint, axis = carrier(robot.model, item)
            own = robot.model.getJointId(names[0])
            spin = robot.model.jointPlacements[own].rotation.T @ axis
            bodies = {
                own: moments(0.0, np.zeros(3), np.outer(spin, spin)),
                joint: moments(0.0, np.zeros(3), -np.outer(axis, axis)),
            }
            yield Parameter(names[0], "inertia", "kg m^2", float(item.inertia), bodies)
