"""Data of a robot: its model, joints, inputs, outputs, springs and other fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, unknown
from fflin.base.validation import Array
from fflin.robot.constraints import Constraint
from fflin.robot.disturbance import DisturbanceTerms
from fflin.robot.equipment.appendages import Appendage
from fflin.robot.equipment.assembly import stored_momentum
from fflin.robot.inputs import (
    BaseForce,
    BaseTorque,
    Input,
    JointTorque,
    Range,
    Thruster,
    named_inputs,
    named_wheels,
)
from fflin.robot.joints import Coordinates, Joint
from fflin.robot.orbit import Orbit
from fflin.robot.outputs import FullState, Output

if TYPE_CHECKING:
    from typing import Self


class LinkMass(NamedTuple):
    """Mass [kg] of a link, and its inertia (3, 3) [kg m^2] about the centre of mass."""

    mass: float
    inertia: Array
    # placement of the centre of mass and the inertia's axes on the link
    placement: pin.SE3


def link_mass(body: pin.Inertia) -> LinkMass:
    """Return the mass properties of a link from its inertia in the axes of the link."""
    return LinkMass(body.mass, body.inertia, pin.SE3(np.eye(3), body.lever))


class Springs(NamedTuple):
    """Stiffness, damping and rest positions, each (n,), of the springs and dampers of joints."""

    stiffness: Array
    damping: Array
    rest: Array

    def force(self, q_m: Array, rates: Array) -> Array:
        """Return the forces (.., n) of springs and dampers at joint positions and rates (.., n)."""
        return self.stiffness * (self.rest - q_m) - self.damping * rates


@dataclass(frozen=True, eq=False, repr=False)
class RobotData(Coordinates):
    """Fields of a robot, and the properties that follow from them directly.

    `Robot` describes the fields. The modules that compute properties of a robot or make another
    robot take this class, and `Robot` offers their results as its attributes and methods.
    """

    urdf: Path | None = None
    urdf_sha256: str = ""
    notes: tuple[str, ...] = ()
    locked: tuple[str, ...] = ()
    urdf_damping: Mapping[str, float] = field(default_factory=dict)
    inputs: tuple[Input, ...] = ()
    outputs: tuple[Output, ...] = (FullState(),)
    stiffness: Mapping[str, float] = field(default_factory=dict)
    damping: Mapping[str, float] = field(default_factory=dict)
    rest: Mapping[str, float] = field(default_factory=dict)
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orbit: Orbit | None = None
    disturbance: DisturbanceTerms = field(default_factory=dict)
    package_dirs: tuple[Path, ...] = ()
    xacro: Mapping[str, str] = field(default_factory=dict)
    passive: tuple[str, ...] = ()
    wheel_joints: tuple[str, ...] = ()
    weights: Mapping[str, Any] = field(default_factory=dict)
    tune: Mapping[str, Any] = field(default_factory=dict)
    point: Mapping[str, Any] = field(default_factory=dict)
    target: Mapping[str, Any] = field(default_factory=dict)
    start: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Range] = field(default_factory=dict)
    links: Mapping[str, LinkMass] = field(default_factory=dict)
    file_joints: tuple[str, ...] = ()
    attached: tuple[tuple[str, Self], ...] = ()
    appendages: tuple[Appendage, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    independent: tuple[str, ...] = ()
    # The robot without the joints of wheels and modes; None if no joint is a wheel or mode. Its
    # fields such as `inputs` and `stiffness` may be outdated.
    _unequipped: Self | None = None

    def __post_init__(self) -> None:
        if self._as_made is None or self._as_made[0] is not self.model:
            object.__setattr__(self, "_as_made", (self.model, self.model.copy()))
        if not self.inputs:
            # Default: one force or torque for each degree of freedom.
            default = (BaseTorque(), BaseForce(), *map(JointTorque, self.joint_names))
            object.__setattr__(self, "inputs", default)

    @property
    def used_frames(self) -> tuple[str, ...]:
        """Names of the frames of inputs, outputs and constraints."""
        names = [name for item in self.inputs for name in item.frames]
        names += [name for item in self.outputs for name in item.frames]
        names += [name for item in self.constraints for name in item.frames]
        return tuple(names)

    @cached_property
    def named_inputs(self) -> tuple[tuple[Input, tuple[str, ...]], ...]:
        """Each input with the names of its entries in u."""
        return tuple(named_inputs(self.inputs))

    @cached_property
    def pulsed_thrusters(self) -> dict[int, tuple[str, Thruster]]:
        """Return the thrusters that fire pulses, as {index in u: (name, thruster)}."""
        inputs = ((name, item) for item, names in self.named_inputs for name in names)
        return {
            index: (name, item)
            for index, (name, item) in enumerate(inputs)
            if isinstance(item, Thruster) and (item.on_off or item.least_impulse)
        }

    @cached_property
    def reaction_wheels(self) -> dict[str, float]:
        """Inertias {name: inertia [kg m^2]} of the inputs `ReactionWheel` that are joints."""
        wheels = named_wheels(self.inputs)
        return {name: wheel.inertia for name, wheel in wheels if wheel.inertia}

    @cached_property
    def stored_momentum(self) -> tuple[tuple[int, Array], ...]:
        """Constant momentum of the wheels without inertia, summed for each carrying joint.

        Each entry is (index of the joint, angular momentum (3,) [N m s] in the axes of the joint).
        """
        return stored_momentum(self.model, self.inputs)

    @cached_property
    def springs(self) -> Springs:
        """Stiffness, damping and rest positions (n,) of all joints in state order."""
        rows = np.zeros((3, self.n))
        for row, given in zip(
            rows, (self.stiffness, self.damping, self.rest), strict=True
        ):
            row[:] = [given.get(name, 0.0) for name in self.joint_names]
        return Springs(*rows)

    @cached_property
    def anchored(self) -> bool:
        """Whether a constraint holds a frame of the robot in inertial space."""
        return any(item.to is None for item in self.constraints)

    @cached_property
    def mass(self) -> float:
        """Total mass [kg]."""
        return float(pin.computeTotalMass(self.model))

    def __repr__(self) -> str:
        return f"Robot('{self.name}', n={self.n}, mass={self.mass:.6g} kg)"

    def joint(self, name: str) -> Joint:
        """Return the independent joint with the given name.

        Raises
        ------
        UnknownNameError
            If the robot has no joint with this name; the message suggests similar names.
        InputError
            If the name belongs to a mimic joint, a wheel without inertia or a locked joint.
        """
        if not isinstance(name, str):
            raise unknown("joint", name, self.joint_names)
        if independent := next(
            (joint for joint in self.joints if joint.name == name), None
        ):
            return independent
        leader = next(
            (x.leader.name for x in self.followers if x.joint.name == name), ""
        )
        if leader:
            raise InputError(
                f"joint '{name}' mimics '{leader}'; give '{leader}' instead"
            )
        if name in (wheel for wheel, _ in named_wheels(self.inputs)):
            raise InputError(
                f"wheel '{name}' has no inertia, so it is not a joint and has no speed; give the "
                "wheel an inertia, or its momentum"
            )
        if any(locked.rpartition("=")[0] == name for locked in self.locked):
            raise InputError(
                f"joint '{name}' is locked; unlock it, or leave it out here"
            )
        raise unknown("joint", name, self.joint_names)

    @cached_property
    def modes(self) -> tuple[Joint, ...]:
        """Joints of the robot that represent modes of flexible appendages or slosh."""
        return tuple(joint for joint in self.joints if joint.mode)

    @property
    def _bare(self) -> Self:
        """The robot without the joints of wheels and modes; `self` if it has no such joints."""
        return self._unequipped or self
