"""Robots with changed parameters, each link physically realisable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.robot.frames import ROOT
from fflin.robot.inputs import Thruster, named_inputs
from fflin.robot.link_masses import Piece, as_inertia, pieces_of
from fflin.robot.mass_properties import with_inertias
from fflin.robot.robot import Robot
from fflin.uncertainty.fraction import OF_PIECES
from fflin.uncertainty.parameters import AXES, ENTRIES, Parameters

_ROUNDING = 1e-9


class Variants:
    """Variants of a robot with changed parameters."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self.parameters = robot, Parameters(robot)
        self.pieces = pieces_of(robot)[0]

    def refusal(self, values: Mapping[str, float]) -> str:
        """Return why {parameter: value} are not physically realisable, or an empty string."""
        try:
            changed = self._changed(values)
            if self._robot.wheels:  # which a carrier may be too light for
                self._with(changed, values)
        except InputError as error:
            return str(error)
        return ""

    def robot(self, values: Mapping[str, float]) -> Robot:
        """Return the robot of {parameter: value}, or raise `InputError`."""
        return self._with(self._changed(values), values)

    def _parts(self, values: Mapping[str, float]) -> dict[str, dict[str, float]]:
        found: dict[str, dict[str, float]] = {}
        for name, value in values.items():
            one = self.parameters[name]
            found.setdefault(one.of, {})[one.part] = value
        return found

    def _changed(self, values: Mapping[str, float]) -> dict[str, tuple[Piece, float]]:
        """Return the links that are others, each with its density."""
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
            found = {at: pin.Inertia.FromDynamicParameters(x) for at, x in bodies.items()}
            of = {at: (x.mass, x.lever, x.inertia) for at, x in found.items()}
            robot = with_inertias(robot, of)
        fields: dict[str, Any] = {}
        for field in ("stiffness", "damping"):
            given = {name: own[field] for name, own in parts.items() if field in own}
            if given:
                fields[field] = {**getattr(robot, field), **given}
        named = named_inputs(robot.inputs)
        inputs = [_input(item, parts.get(names[0], {})) for item, names in named]
        if any(one is not two for one, two in zip(inputs, robot.inputs, strict=True)):
            fields["inputs"] = inputs
        return robot.replace(**fields) if fields else robot


def _piece(piece: Piece, parts: Mapping[str, float]) -> tuple[Piece, float]:
    """Return a link with other parameters, and its density."""
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
    """Return why a link is not a rigid body; nothing if it is, or is no less than it was."""
    if not piece.mass > 0.0:
        return f"the mass of '{name}' is {piece.mass:.4g} kg, expected above 0"
    if (piece.inertia == before.inertia).all():  # a point mass has none
        return ""
    was, least = (
        float(np.linalg.eigvalsh(0.5 * np.trace(J) * np.eye(3) - J)[0] / (np.trace(J) or 1.0))
        for J in (before.inertia, piece.inertia)
    )
    if np.trace(piece.inertia) > 0.0 and least >= min(-_ROUNDING, was - _ROUNDING):
        return ""
    return f"the inertia of '{name}' is not physically realisable"


def _input(item: Any, parts: Mapping[str, float]) -> Any:
    """Return a thruster that sits elsewhere or a wheel of another inertia, or the same."""
    if "inertia" in parts:
        return replace(item, inertia=parts["inertia"])
    if not isinstance(item, Thruster):
        return item
    position = [parts.get(f"position.{a}", x) for a, x in zip(AXES, item.position, strict=True)]
    return replace(item, position=position)
