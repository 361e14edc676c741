"""Named parameters of a robot, their effect per unit, and robots with changed parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.names import matching, stands_for_any
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.robot.equipment.mounting import carrier
from fflin.robot.inputs import ReactionWheel, Thruster, named_inputs
from fflin.robot.joints import ROOT, Joint, find_frame
from fflin.robot.mass_properties import Piece, as_inertia, sums_of
from fflin.robot.robot import Robot

AXES = "xyz"
# (row, column) of the six entries of an inertia.
ENTRIES = {a + b: (AXES.index(a), AXES.index(b)) for a, b in ("xx", "yy", "zz", "xy", "xz", "yz")}
# Parameters of a link or body.
OF_PIECES = {
    *("mass", "density"),
    *(f"com.{axis}" for axis in AXES),
    *(f"inertia.{entry}" for entry in ENTRIES),
}
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Parameter:
    """One parameter, such as "inertia.xx" of "arm", and its effect on the robot per unit."""

    of: str
    part: str
    unit: str
    value: float
    # {Pinocchio joint: change (10,) of its body}: m, m c, and xx, xy, yy, xz, yz, zz of I about
    # the joint.
    bodies: dict[int, Array] = field(default_factory=dict)
    spring: int = -1  # joint whose stiffness changes, in state order; -1 for none
    damper: int = -1  # joint whose damping changes, in state order; -1 for none
    by_stiffness: float = 1.0  # change of the stiffness per unit
    by_damping: float = 1.0  # change of the damping per unit
    # (Pinocchio joint, index of the input, change (6,) of its unit wrench in the joint's frame)
    wrench: tuple[int, int, Array] | None = None

    @property
    def name(self) -> str:
        """Name of the parameter: its owner and its part, such as "arm.inertia.xx"."""
        return f"{self.of}.{self.part}"


class Parameters(dict[str, Parameter]):
    """Parameters of a robot by name; a body of one link can also be named by its joint."""

    def __init__(self, robot: Robot) -> None:
        pieces, self._link_of = robot.pieces, robot.link_of
        self._sums = sums_of(pieces)
        of_pieces = (each for name, piece in pieces.items() for each in _of_piece(name, piece))
        found = (*of_pieces, *_of_joints(robot), *_of_inputs(robot))
        super().__init__((each.name, each) for each in found)

    def find(self, key: str) -> list[str]:
        """Return the names that match a name or pattern; links take precedence over bodies."""
        bodies = [body for body in self._link_of if str(key).startswith(f"{body}.")]
        if key not in self and bodies:
            body = max(bodies, key=len)
            key = self._link_of[body] + key[len(body) :]
        names = [name for name in self if key == name or self[name].of not in self._sums]
        names = names if stands_for_any(key, names) else list(self)
        return [names[i] for i in matching("parameter", key, names)]

    def ranked(self, only: str | None) -> list[str]:
        """Return the matches of a name, part or pattern, but no body if its links match."""
        found = [n for n, x in self.items() if only in (None, x.of, x.part, x.part.split(".")[0])]
        found = found or self.find(str(only))
        return [name for name in found if self[name].of not in self._sums] or found


def moments(mass: float, first: Array, inertia: Array) -> Array:
    """Return the dynamic parameters (10,) of a mass, a first moment and an inertia."""
    return np.array((mass, *first, *inertia[np.triu_indices(3)][[0, 1, 3, 2, 4, 5]]))


def _of_piece(name: str, piece: Piece) -> Iterator[Parameter]:
    """Yield the mass, centre of mass, inertia and density of a link or body."""

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
        stiffness, damping, _ = (each[index].item() for each in robot.springs)
        if joint.mode and stiffness:
            yield from _of_mode(joint, index, stiffness, damping)
            continue
        per = f"/({joint.unit})" if " " in joint.unit else f"/{joint.unit}"
        force = joint.force_unit
        yield Parameter(joint.name, "stiffness", f"{force}{per}", stiffness, spring=index)
        yield Parameter(joint.name, "damping", f"{force} s{per}", damping, damper=index)


def _of_mode(joint: Joint, index: int, stiffness: float, damping: float) -> Iterator[Parameter]:
    r"""Yield the frequency and damping ratio of a mode with inertia I, for a link fixed in space.

    The stiffness is :math:`I \omega^2` and the damping :math:`2 \zeta I \omega`.
    """
    omega, ratio = joint.oscillation(stiffness, damping)
    turns = 2.0 * math.pi
    yield Parameter(
        joint.name,
        "frequency",
        "Hz",
        omega / turns,
        spring=index,
        damper=index,
        by_stiffness=2.0 * joint.inertia * omega * turns,
        by_damping=2.0 * ratio * joint.inertia * turns,
    )
    by_damping = 2.0 * joint.inertia * omega
    yield Parameter(joint.name, "damping", "1", ratio, damper=index, by_damping=by_damping)


def _of_inputs(robot: Robot) -> Iterator[Parameter]:
    at = 0
    for item, names in named_inputs(robot.inputs):
        first, at = at, at + len(names)
        if isinstance(item, Thruster):
            joint, placement = find_frame(robot.model, item.frame)
            where, along = np.array(item.position), np.array(item.direction)
            for letter, d in zip(AXES, np.eye(3), strict=True):
                # The direction has unit length, so only the part of d perpendicular to it has an
                # effect.
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


class Variants:
    """Variants of a robot with changed parameters."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self.parameters = robot, Parameters(robot)
        self.pieces = robot.pieces

    def refusal(self, values: Mapping[str, float]) -> str:
        """Return why {parameter: value} is not physically realisable; an empty string if it is."""
        try:
            changed = self._changed(values)
            if self._robot.wheels or self._robot.modes:  # a link may be too light for them
                self._with(changed, values)
        except InputError as error:
            return str(error)
        return ""

    def robot(self, values: Mapping[str, float]) -> Robot:
        """Return the robot with {parameter: value}, or raise `InputError` if it is impossible."""
        return self._with(self._changed(values), values)

    def _parts(self, values: Mapping[str, float]) -> dict[str, dict[str, float]]:
        found: dict[str, dict[str, float]] = {}
        for name, value in values.items():
            one = self.parameters[name]
            found.setdefault(one.of, {})[one.part] = value
        return found

    def _changed(self, values: Mapping[str, float]) -> dict[str, tuple[Piece, float]]:
        """Return {name: (link with changed parameters, density)}."""
        found = {}
        for name, parts in self._parts(values).items():
            own = {part: value for part, value in parts.items() if part in OF_PIECES}
            if name in self.pieces and own:
                changed, density = found[name] = _piece(self.pieces[name], own)
                why = _no_body(self.pieces[name], changed, name)
                if not density > 0.0:
                    why = f"the density of '{name}' has the factor {density:.4g}, expected above 0"
                if why:
                    raise InputError(why)
        return found

    def _with(
        self, changed: Mapping[str, tuple[Piece, float]], values: Mapping[str, float]
    ) -> Robot:
        robot, bodies, parts = self._robot, dict[int, Array](), self._parts(values)
        bare = robot._bare.model
        for name, (piece, density) in changed.items():
            at = ROOT
            if piece.joint > ROOT:
                at = bare.getJointId(robot.model.names[piece.joint])
            now = as_inertia(self.pieces[name]).toDynamicParameters()
            change = density * as_inertia(piece).toDynamicParameters() - now
            bodies[at] = bodies.get(at, bare.inertias[at].toDynamicParameters()) + change
        if bodies:
            changed_bodies = pin.Inertia.FromDynamicParameters
            robot = robot.with_bodies({at: changed_bodies(x) for at, x in bodies.items()})
        fields: dict[str, object] = {}
        springs = {
            joint.name: _spring(joint, parts[joint.name], self._robot)
            for joint in robot.joints
            if joint.name in parts
        }
        for part in ("stiffness", "damping"):
            given = {name: own[part] for name, own in springs.items() if part in own}
            if given:
                fields[part] = {**getattr(robot, part), **given}
        named = named_inputs(robot.inputs)
        inputs = [_input(item, parts.get(names[0], {})) for item, names in named]
        if any(one is not two for one, two in zip(inputs, robot.inputs, strict=True)):
            fields["inputs"] = inputs
        return robot.replace(**fields) if fields else robot


def _spring(joint: Joint, parts: Mapping[str, float], robot: Robot) -> dict[str, float]:
    """Return the stiffness and damping of a joint with changed parameters {part: value}."""
    stiffness = robot.stiffness.get(joint.name, 0.0)
    if not (joint.mode and stiffness):
        return {part: x for part, x in parts.items() if part in ("stiffness", "damping")}
    omega, ratio = joint.oscillation(stiffness, robot.damping.get(joint.name, 0.0))
    omega = 2.0 * math.pi * parts["frequency"] if "frequency" in parts else omega
    inertia, ratio = joint.inertia, parts.get("damping", ratio)
    return {"stiffness": inertia * omega**2, "damping": 2.0 * ratio * inertia * omega}


def _piece(piece: Piece, parts: Mapping[str, float]) -> tuple[Piece, float]:
    """Return a link with changed parameters {part: value}, and its density."""
    own, inertia = np.array(piece.frame.actInv(piece.placement.translation)), piece.inertia.copy()
    for at, axis in enumerate(AXES):
        own[at] = parts.get(f"com.{axis}", own[at])
    for entry, (i, j) in ENTRIES.items():
        inertia[i, j] = inertia[j, i] = parts.get(f"inertia.{entry}", inertia[i, j])
    placement = pin.SE3(piece.placement.rotation, piece.frame.act(own))
    changed = piece._replace(
        placement=placement, mass=parts.get("mass", piece.mass), inertia=inertia
    )
    return changed, parts.get("density", 1.0)


def _no_body(before: Piece, piece: Piece, name: str) -> str:
    """Return why a changed link is physically impossible, or an empty text if it is possible.

    A link that was impossible before the change is accepted unless the change makes it worse.
    """
    if not piece.mass > 0.0:
        return f"the mass of '{name}' is {piece.mass:.4g} kg, expected above 0"
    if (piece.inertia == before.inertia).all():  # accepted, for example zero for a point mass
        return ""
    was, least = (
        float(np.linalg.eigvalsh(0.5 * np.trace(J) * np.eye(3) - J)[0] / (np.trace(J) or 1.0))
        for J in (before.inertia, piece.inertia)
    )
    if np.trace(piece.inertia) > 0.0 and least >= min(-_ROUNDING, was - _ROUNDING):
        return ""
    return f"the inertia of '{name}' is not physically realisable"


def _input(item: Any, parts: Mapping[str, float]) -> Any:
    """Return a thruster with a changed position, a wheel with a changed inertia, or the input."""
    if "inertia" in parts:
        return replace(item, inertia=parts["inertia"])
    if not isinstance(item, Thruster):
        return item
    position = [parts.get(f"position.{a}", x) for a, x in zip(AXES, item.position, strict=True)]
    return replace(item, position=position)
