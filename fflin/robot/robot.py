"""The robot that every other call speaks of: a free-flyer root and n one-degree joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, unknown
from fflin.base.validation import Array
from fflin.robot.coordinates import Coordinates
from fflin.robot.fields import Range, checked_fields, checked_passive
from fflin.robot.frames import ROOT, find_frame
from fflin.robot.inputs import BaseForce, BaseTorque, Input, JointTorque, named_wheels
from fflin.robot.joints import Follower, Joint
from fflin.robot.orbit import CircularOrbit
from fflin.robot.outputs import FullState, Output
from fflin.robot.wheels import stored_momentum, with_inputs


class Springs(NamedTuple):
    """What springs and dampers do: -stiffness (q_m - rest) - damping qdot_m, each (n,)."""

    stiffness: Array
    damping: Array
    rest: Array

    def force(self, q_m: Array, rates: Array) -> Array:
        """Return the force (.., n) on joints at q_m (.., n) that move at rates (.., n)."""
        return self.stiffness * (self.rest - q_m) - self.damping * rates


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Coordinates):
    """A robot floating free; made by `load` or `from_model`.

    Attributes
    ----------
    model : pin.Model
        Free-flyer root joint, zero gravity; its mimic joints are joints like the others, and so
        are the wheels with an inertia among the inputs. To be read: a robot whose model was
        changed is refused, see `from_model`.
    name : str
        Name or file stem it was loaded by.
    urdf : Path or None
        The file it was read from.
    urdf_sha256 : str
        Hash of that file, and of the masses where they are others; empty where there is none.
    joints : tuple of Joint
        The n independent joints in state order, which is Pinocchio's.
    followers : tuple of Follower
        The mimic joints, each with the independent joint that it follows.
    notes : tuple of str
        What was warned of when it was read.
    locked : tuple of str
        "joint=value" [rad|m] of the joints that were welded.
    urdf_damping : mapping
        {joint: viscous damping [N m s/rad | N s/m]} as its file says, what follows a joint
        counted with it; part of the model only if `damping` is "urdf".
    inputs : tuple of Input
        What acts on it; the base's torque and force and every joint's by default.
    outputs : tuple of Output
        What is watched of it; the full state by default.
    stiffness, damping : mapping
        {joint: value [N m/rad | N/m], [N m s/rad | N s/m]} of springs and dampers.
    rest : mapping
        {joint: position [rad|m]} where a spring is relaxed; 0 where not named.
    gravity : tuple of float (3,)
        Uniform acceleration [m/s^2] in Pinocchio's world axes. `model` itself has none.
    orbit : CircularOrbit or None
        What it circles; Pinocchio's world is then the orbit's frame, see `CircularOrbit`.
    package_dirs : tuple of Path
        Folders in which ``package://`` paths of meshes are looked up when it is drawn.
    passive : tuple of str
        Joints without a motor.
    weights : mapping
        What `lqr` weighs by default, where it is not the rule's: see `replace`.
    start : mapping
        Where `simulate` and `visualize` begin by default: see `replace`.
    limits : mapping
        {name of an input or state: (least, largest)} in place of what the URDF and the inputs say.
    links : mapping
        {link: LinkMass} of those that weigh something, as the URDF has them.
    file_joints : tuple of str
        All joints, fixed ones too, as its file has them.
    attached : tuple of (str, Robot)
        What it has grasped, each with the prefix of its names.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> heavy = robot.with_mass_properties({"base": {"mass": 900.0}})
    >>> stiff = robot.replace(stiffness={"joint_1": 50.0}, gravity=(0, 0, -1.62))
    >>> robot.n, stiff.stiffness["joint_1"], round(heavy.mass)
    (3, 50.0, 972)
    """

    model: pin.Model
    name: str
    urdf: Path | None
    urdf_sha256: str
    joints: tuple[Joint, ...]
    followers: tuple[Follower, ...] = ()
    notes: tuple[str, ...] = ()
    locked: tuple[str, ...] = ()
    urdf_damping: Mapping[str, float] = field(default_factory=dict)
    inputs: tuple[Input, ...] = ()
    outputs: tuple[Output, ...] = (FullState(),)
    stiffness: Mapping[str, float] = field(default_factory=dict)
    damping: Mapping[str, float] = field(default_factory=dict)
    rest: Mapping[str, float] = field(default_factory=dict)
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orbit: CircularOrbit | None = None
    package_dirs: tuple[Path, ...] = ()
    passive: tuple[str, ...] = ()
    weights: Mapping[str, Any] = field(default_factory=dict)
    start: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Range] = field(default_factory=dict)
    links: Mapping[str, Any] = field(default_factory=dict)
    file_joints: tuple[str, ...] = ()
    attached: tuple[tuple[str, Robot], ...] = ()
    # Where some of its joints are wheels: the same robot without them.
    _wheelless: Robot | None = None
    # The model, and what it was when the first robot of it was made.
    _as_made: tuple[pin.Model, pin.Model] | None = None

    def __post_init__(self) -> None:
        if self._as_made is None or self._as_made[0] is not self.model:
            object.__setattr__(self, "_as_made", (self.model, self.model.copy()))
        if not self.inputs:
            # One force for each degree of freedom.
            default = (BaseTorque(), BaseForce(), *map(JointTorque, self.joint_names))
            object.__setattr__(self, "inputs", default)

    def replace(self, **fields: Any) -> Robot:
        """Return the same robot with other inputs, passive joints, gravity or orbit.

        Parameters
        ----------
        inputs : sequence of Input
            What acts on it, in the order of u. Wheels with an inertia among them become joints
            of the robot; those that it had before and that are not among them go. The joint of
            a `JointTorque` may be a pattern, ``*``, for all that it fits and that have a motor.
        outputs : sequence of Output
            What is watched of it, in the order of y.
        stiffness : mapping or float
            {joint: K [N m/rad | N/m]}, or one for all joints but wheels. A name may be a
            pattern, ``hinge_*``, here and below.
        damping : mapping, float or "urdf"
            {joint: D [N m s/rad | N s/m]}, one for all joints but wheels, or what the URDF
            says.
        rest : mapping
            {joint: position [rad|m]} where its spring is relaxed.
        gravity : sequence of float (3,)
            Uniform acceleration [m/s^2] in Pinocchio's world axes.
        orbit : CircularOrbit, float, mapping or None
            What it circles, or the altitude over the earth [m], or {parameter: value} of one.
        passive : sequence of str
            Joints without a motor: their torques leave the inputs.
        weights : mapping
            What `lqr` weighs where it is given nothing: ``rule`` ("urdf", "identity"), ``q``,
            ``r``, ``bryson``: {state, input, group or pattern: weight or largest value}.
        start : mapping
            Where `simulate` begins where it is not told: ``joints`` {joint: position [rad|m]},
            ``rpy`` (3,) [deg] about fixed axes, ``position`` (3,) [m] of the base, ``velocity``
            {joint or state: rate}, as `fflin.velocity` takes it.
        limits : mapping
            {name, group or pattern of inputs or states: largest magnitude, or (least, largest)},
            in place of what the URDF and the inputs say of them.

        Returns
        -------
        Robot

        Raises
        ------
        InputError
            If a value is negative or not a number, a field is not one of these, or a wheel has
            more inertia than what carries it, or there are both gravity and an orbit.
        UnknownNameError
            If there is no such joint, no such frame for an input or output, or nothing to limit.
        ModelError
            If dry friction is asked for, which is not differentiable at rest, or the robot's
            model was changed after it was made.
        """
        self.require_unchanged()
        robot = self
        if "passive" in fields:
            robot = robot._without_motors(fields.pop("passive"))
        if "inputs" in fields:
            robot = with_inputs(robot, fields.pop("inputs"))
        joints, own = robot.joint_names, robot._bare.joint_names
        known = (robot.joint, joints, own, robot.inputs, self.urdf_damping)
        robot = replace(robot, **checked_fields(fields, *known))
        if robot.orbit and any(robot.gravity):
            raise InputError(
                f"'{self.name}' has uniform gravity and an orbit, which has the field of its own "
                "body; leave one out"
            )
        for name in robot.used_frames:
            find_frame(robot.model, name)
        return robot

    def with_mass_properties(self, bodies: Mapping[str, Any]) -> Robot:
        """Return the same robot with other masses.

        Parameters
        ----------
        bodies : mapping
            {body: {"mass": m [kg], "com": (3,) [m], "inertia": (3, 3) [kg m^2] about the centre of
            mass} or pin.Inertia}, in the axes of the body's joint. A body is named by its joint,
            ``base``, a pattern, or its link where no other is fixed to that: links that are fixed
            to each other are one body, given as a whole and with its wheels. What is left out
            stays; a mass without an inertia scales that with it, as another density does.

        Returns
        -------
        Robot
            With the pictures, names and inputs of this one, and another ``urdf_sha256``.

        Raises
        ------
        InputError
            If a mass is not positive, an inertia is that of no rigid body, or less than that of
            the wheels in it.
        UnknownNameError
            If there is no such body or property.
        """
        from fflin.robot.mass_properties import with_bodies

        return with_bodies(self, bodies)

    def perturbed(
        self, *, mass: float = 0.1, com: float = 0.1, inertia: float = 0.1, seed: int = 0
    ) -> Robot:
        """Return the same robot with masses drawn at random, each body still a rigid body.

        With d uniform in [-1, 1], anew for each body and axis, a mass is multiplied by
        1 + mass d, the second moments per mass along the axes of the body's frame by
        1 + inertia d, and the centre of mass is shifted along each axis by com d times the root
        mean square distance of the mass from it along that axis.

        Parameters
        ----------
        mass, com, inertia : float
            Relative spreads, from 0 to less than 1.
        seed : int
            The same seed gives the same robot.

        Returns
        -------
        Robot
            As of `with_mass_properties`.
        """
        from fflin.robot.mass_properties import perturbed

        return perturbed(self, seed, mass=mass, com=com, inertia=inertia)

    @property
    def used_frames(self) -> tuple[str, ...]:
        """The frames of the model that inputs and outputs are fixed in."""
        of_inputs = [name for item in self.inputs for name in item.frames]
        return (*of_inputs, *(name for item in self.outputs for name in item.frames))

    @cached_property
    def wheels(self) -> dict[str, float]:
        """{name: inertia [kg m^2]} of the wheels among its joints."""
        wheels = named_wheels(self.inputs)
        return {name: wheel.inertia for name, wheel in wheels if wheel.inertia}

    @cached_property
    def stored_momentum(self) -> tuple[tuple[int, Array], ...]:
        """Of wheels without inertia: (Pinocchio joint, momentum (3,) [N m s] in its axes)."""
        return stored_momentum(self.model, self.inputs)

    @cached_property
    def springs(self) -> Springs:
        """Stiffness, damping and rest positions (n,) in state order."""
        given = (self.stiffness, self.damping, self.rest)
        return Springs(*(np.array([x.get(name, 0.0) for name in self.joint_names]) for x in given))

    @property
    def mass(self) -> float:
        """Total mass in kg."""
        return float(sum(inertia.mass for inertia in self.model.inertias.tolist()[ROOT:]))

    def __repr__(self) -> str:
        return f"Robot('{self.name}', n={self.n}, mass={self.mass:.6g} kg)"

    def joint(self, name: str) -> Joint:
        """Return the independent joint of that name.

        Raises
        ------
        UnknownNameError
            If there is none; the message has the near names, or the leader of a mimic joint.
        """
        for joint in self.joints:
            if joint.name == name:
                return joint
        for follower in self.followers:
            if follower.joint.name == name:
                raise InputError(
                    f"joint '{name}' mimics '{follower.leader.name}'; place that one instead"
                )
        if name in (wheel for wheel, _ in named_wheels(self.inputs)):
            raise InputError(
                f"wheel '{name}' has no inertia, so that it is no joint and has no speed; give it "
                "one, or its momentum"
            )
        if any(locked.rpartition("=")[0] == name for locked in self.locked):
            raise InputError(f"joint '{name}' is locked; lock it at another value instead")
        raise unknown("joint", name, self.joint_names)

    @property
    def _bare(self) -> Robot:
        """The robot without the wheels among its joints."""
        return self._wheelless or self

    def _without_motors(self, passive: Any) -> Robot:
        """Return the robot without the torques of joints that have no motor."""
        bare = self._bare
        joints = checked_passive(passive, bare.joint, bare.joint_names, self.locked)
        inputs = tuple(item for item in self.inputs if getattr(item, "joint", None) not in joints)
        if not inputs:
            raise InputError("passive leaves no input; a model needs at least one")
        return replace(self, passive=joints, inputs=inputs)
