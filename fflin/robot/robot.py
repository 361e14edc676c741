"""The robot that every other call speaks of: a free-flyer root and n one-degree joints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, ModelError, unknown
from fflin.base.validation import DOUBLE, NORM_TOLERANCE, Array, vector
from fflin.robot.fields import Range, checked_fields, checked_inputs, checked_passive, kept_start
from fflin.robot.frames import ROOT, find_frame
from fflin.robot.inputs import BaseForce, BaseTorque, Input, JointTorque, named_wheels
from fflin.robot.joints import Follower, Joint, check_followers_rates, followed
from fflin.robot.link_masses import LinkMass
from fflin.robot.model_checks import change_in
from fflin.robot.outputs import FullState, Output
from fflin.robot.wheels import stored_momentum, with_wheels

_CONFIGURATION = "a configuration in Pinocchio's order"

# What renormalising a unit quaternion leaves: two ulp of unity.
ROUND_OFF = 2.0 * float(np.finfo(float).eps)

# Data holds a third-order tensor of nv^3 entries among others: about 32 nv^3 bytes in all.
_DATA_BYTES_PER_NV3 = 32
_DATA_LIMIT = 2**30


class Springs(NamedTuple):
    """What springs and dampers do: -stiffness (q_m - rest) - damping qdot_m, each (n,)."""

    stiffness: Array
    damping: Array
    rest: Array


@dataclass(frozen=True, eq=False, repr=False)
class Robot:
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
        {link: its mass, centre of mass and inertia} as the URDF has them.
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
    package_dirs: tuple[Path, ...] = ()
    passive: tuple[str, ...] = ()
    weights: Mapping[str, Any] = field(default_factory=dict)
    start: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Range] = field(default_factory=dict)
    links: Mapping[str, LinkMass] = field(default_factory=dict)
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
        """Return the same robot with other inputs, passive joints or gravity.

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
            more inertia than what carries it.
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
            robot = robot._with_inputs(fields.pop("inputs"))
        joints, own = robot.joint_names, robot._bare.joint_names
        known = (robot.joint, joints, own, robot.inputs, self.urdf_damping)
        robot = replace(robot, **checked_fields(fields, *known))
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

        return self._of_model(with_bodies(self._bare.model, bodies))

    def perturbed(
        self, *, mass: float = 0.1, com: float = 0.1, inertia: float = 0.1, seed: int = 0
    ) -> Robot:
        """Return the same robot with masses drawn at random, each body still a rigid body.

        With d uniform in [-1, 1], anew for each body and axis, a mass is multiplied by
        1 + mass d, the second moments per mass along the axes of the body's frame by
        1 + inertia d, and the centre of mass is shifted by com d times the radius of gyration.

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

        model = perturbed(self._bare.model, seed, mass=mass, com=com, inertia=inertia)
        return self._of_model(model)

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
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n independent joints in state order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def n(self) -> int:
        """Number of independent joints."""
        return len(self.joints)

    @cached_property
    def nq(self) -> int:
        """Size of Pinocchio's configuration."""
        return int(self.model.nq)

    @cached_property
    def nv(self) -> int:
        """Size of Pinocchio's velocity: 6 + n, and one for each mimic joint."""
        return int(self.model.nv)

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

    def neutral(self) -> Array:
        """Return the neutral configuration (nq,): mimic joints where their leaders put them."""
        q = pin.neutral(self.model)
        self.follow(q)
        return q

    def follow(self, q: Array) -> None:
        """Put the mimic joints of a configuration where their leaders say."""
        for follower in self.followers:
            follower.place(q)

    def checked_configuration(self, q: Array) -> Array:
        """Return `q` as a valid configuration of this robot.

        Parameters
        ----------
        q : array_like (nq,)
            Configuration in Pinocchio's order. Its quaternion, the (cos, sin) of every continuous
            joint and the mimic joints are put right where they are within 1e-6.

        Returns
        -------
        ndarray (nq,)
            `q` itself where nothing was to be done, never modified.

        Raises
        ------
        InputError
            If the size is wrong, an entry is not finite, a part is not of unit length, or a mimic
            joint is not where its leader puts it.
        """
        if type(q) is not np.ndarray or q.dtype is not DOUBLE or q.shape != (self.nq,):
            q = vector("q", q, self.nq, _CONFIGURATION)
        entries = q.tolist()
        if not math.isfinite(sum(entries)):
            vector("q", q, self.nq, _CONFIGURATION)  # says which entry it is
        x, y, z, w = entries[3:7]
        worst = abs(x * x + y * y + z * z + w * w - 1.0)
        if worst > NORM_TOLERANCE:
            raise InputError(
                f"the base quaternion q[3:7] has length {np.linalg.norm(q[3:7]):.9g}, expected 1; "
                "normalise it (x, y, z, w)"
            )
        for index in self.unbounded:
            c, s = entries[index], entries[index + 1]
            excess = abs(c * c + s * s - 1.0)
            if excess > worst:
                worst = excess
                if excess > NORM_TOLERANCE:
                    raise InputError(
                        f"(cos, sin) of continuous joint '{self.unbounded[index]}', "
                        f"q[{index}:{index + 2}], has length {np.hypot(c, s):.9g}, expected 1"
                    )
        if worst > ROUND_OFF:
            q = pin.normalize(self.model, q)
        return followed(self.followers, q) if self.followers else q

    def checked_velocity(self, v: Array) -> Array:
        """Return `v` as a valid velocity (nv,), never modified.

        Raises
        ------
        InputError
            If the size is wrong, an entry is not finite, or a mimic joint does not move as its
            leader makes it.
        """
        v = vector("v", v, self.nv, "a velocity in Pinocchio's order")
        check_followers_rates(self.followers, v)
        return v

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

    def _with_inputs(self, inputs: Any) -> Robot:
        """Return the robot with other inputs, and with the wheels among them as joints."""
        bare = self._bare
        checked = checked_inputs(inputs, bare.joint, bare.joint_names, self.passive)
        wheels = [(name, wheel) for name, wheel in named_wheels(checked) if wheel.inertia]
        model, joints, followers = with_wheels(bare.model, bare.joints, bare.followers, wheels)
        names = [joint.name for joint in joints]
        of_joints: dict[str, Any] = {
            field: {name: x for name, x in getattr(self, field).items() if name in names}
            for field in ("stiffness", "damping", "rest")
        }
        return replace(
            self,
            model=model,
            joints=joints,
            followers=followers,
            inputs=checked,
            start=kept_start(self.start, names),
            _wheelless=bare if wheels else None,
            **of_joints,
        )

    def _of_model(self, model: pin.Model) -> Robot:
        """Return the robot with a model that has other masses and no wheels."""
        from fflin.robot.mass_properties import identity

        self.require_unchanged()
        told = identity(self.urdf_sha256, model, self._bare.model)
        other = replace(self._bare, model=model, urdf_sha256=told)
        if self._wheelless is None:
            return other
        return replace(self, urdf_sha256=told, _wheelless=other)._with_inputs(self.inputs)

    def require_unchanged(self) -> None:
        """Raise `ModelError` where the model was changed in place after the robot was made.

        Results prepared before the change would be of another robot than those made after it.
        """
        assert self._as_made is not None
        made = self._as_made[1]
        # Tells in a microsecond that nothing at all was changed.
        if self.model != made and (change := change_in(self.model, made)):
            raise ModelError(
                f"the model of '{self.name}' was changed after the robot was made: {change}; make "
                "a robot of it with fflin.from_model(model)"
            )

    def create_data(self) -> pin.Data:
        """Make Pinocchio's work space for this robot.

        Raises
        ------
        ModelError
            If it would take more than 1 GiB.
        """
        self.require_room()
        return self.model.createData()

    def require_room(self) -> None:
        """Raise `ModelError` where Pinocchio's work space would take more than 1 GiB."""
        size = _DATA_BYTES_PER_NV3 * self.nv**3
        if size > _DATA_LIMIT:
            raise ModelError(
                f"'{self.name}' has {self.n} joints, for which Pinocchio's Data takes about "
                f"{size / 2**30:.1f} GiB (limit 1 GiB); lock joints that do not matter"
            )

    @cached_property
    def unbounded(self) -> dict[int, str]:
        """{index of the cosine in q: joint} of the joints that turn without end."""
        joints = (*self.joints, *(follower.joint for follower in self.followers))
        return {joint.idx_q: joint.name for joint in joints if joint.unbounded}
