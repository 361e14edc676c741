"""Robot: a free-flyer root joint and n joints with one degree of freedom."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, unknown
from fflin.base.validation import Array
from fflin.robot.equipment.appendages import Appendage
from fflin.robot.equipment.assembly import with_appendages, with_inputs
from fflin.robot.equipment.mounting import difference, stored_momentum
from fflin.robot.fields import Range, Scope, checked_fields, checked_passive
from fflin.robot.inputs import BaseForce, BaseTorque, Input, JointTorque, named_wheels
from fflin.robot.joints import ROOT, Coordinates, Follower, Joint, find_frame
from fflin.robot.mass_properties import (
    LinkMass,
    Piece,
    given_bodies,
    idle_coordinates,
    pieces_of,
    random_bodies,
)
from fflin.robot.orbit import CircularOrbit
from fflin.robot.outputs import FullState, Output


class Springs(NamedTuple):
    """Springs and dampers of the force -stiffness (q_m - rest) - damping qdot_m, each (n,)."""

    stiffness: Array
    damping: Array
    rest: Array

    def force(self, q_m: Array, rates: Array) -> Array:
        """Return the force (.., n) on joints at q_m (.., n) that move at rates (.., n)."""
        return self.stiffness * (self.rest - q_m) - self.damping * rates


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Coordinates):
    """Free-floating robot, made by `load` or `from_model`.

    Attributes
    ----------
    model : pin.Model
        Pinocchio model with a free-flyer root joint and zero gravity. Mimic joints and reaction
        wheels with an inertia are ordinary joints of `model`. The model must not be changed; use
        `from_model` to make a robot from another model.
    name : str
        Name or file stem by which the robot was loaded.
    urdf : Path or None
        File from which the robot was read.
    urdf_sha256 : str
        Hash of the URDF, and of the masses if they were changed; empty if there is no URDF.
    joints : tuple of Joint
        The n independent joints in state order, which is Pinocchio's order.
    followers : tuple of Follower
        The mimic joints, each with the independent joint that it follows.
    notes : tuple of str
        Warnings that were issued when the robot was read.
    locked : tuple of str
        "joint=value" [rad|m] of each welded joint.
    urdf_damping : mapping
        {joint: viscous damping [N m s/rad | N s/m]} from the file, including the damping of the
        joint's mimic joints. The damping is part of the model only if `damping` is "urdf".
    inputs : tuple of Input
        Inputs of the robot; by default torque and force on the base and the torque of every joint.
    outputs : tuple of Output
        Measured outputs of the robot; by default the full state.
    stiffness, damping : mapping
        {joint: value [N m/rad | N/m], [N m s/rad | N s/m]} of springs and dampers.
    rest : mapping
        {joint: position [rad|m]} at which a spring is relaxed; 0 for joints not named.
    gravity : tuple of float (3,)
        Uniform acceleration [m/s^2] in Pinocchio's world axes. `model` itself has no gravity.
    orbit : CircularOrbit or None
        Orbit of the robot; Pinocchio's world is then the orbit's frame, see `CircularOrbit`.
    package_dirs : tuple of Path
        Folders that are searched for ``package://`` meshes when the robot is drawn.
    passive : tuple of str
        Joints without a motor.
    weights : mapping
        Default weights of `lqr`, which replace the weights of the rule "urdf" or "identity", see
        `replace`.
    point : mapping
        Operating point of the command line, see `replace`.
    target : mapping
        Target state of the commands `simulate` and `montecarlo`, see `replace`.
    start : mapping
        Default initial state of `simulate` and `visualize`, see `replace`.
    limits : mapping
        Limits {name of an input or state: (least, largest)}, which replace limits of the URDF and
        of the inputs.
    links : mapping
        {link: LinkMass}: mass properties of all links with mass, as given in the URDF.
    file_joints : tuple of str
        All joints of the file, including fixed joints.
    attached : tuple of (str, Robot)
        Grasped robots, each with the prefix of its names.
    appendages : tuple of FlexibleAppendage and Slosh
        Flexible appendages and slosh, whose modes are among the joints.

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
    point: Mapping[str, Any] = field(default_factory=dict)
    target: Mapping[str, Any] = field(default_factory=dict)
    start: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Range] = field(default_factory=dict)
    links: Mapping[str, LinkMass] = field(default_factory=dict)
    file_joints: tuple[str, ...] = ()
    attached: tuple[tuple[str, Robot], ...] = ()
    appendages: tuple[Appendage, ...] = ()
    # Where some of its joints are wheels or modes: the same robot without them.
    _unequipped: Robot | None = None
    # Wheels and modes that it had before its inputs or appendages were replaced.
    _removed: tuple[str, ...] = ()
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
        """Return a copy of the robot with other inputs, passive joints, gravity or orbit.

        Parameters
        ----------
        inputs : sequence of Input
            Inputs of the robot, in the order of u. Wheels with an inertia become joints of the
            robot; previous wheels that are not among the new inputs are removed. The joint of a
            `JointTorque` may be a pattern, ``*``, for all matching joints that have a motor.
        appendages : sequence of FlexibleAppendage and Slosh
            Flexible appendages and slosh of the robot, whose modes become passive joints.
            Previous appendages are removed.
        outputs : sequence of Output
            Measured outputs of the robot, in the order of y.
        stiffness : mapping or float
            {joint: K [N m/rad | N/m]}, or one value for all joints except wheels. In all
            mappings, a name may be a pattern, ``hinge_*``.
        damping : mapping, float or "urdf"
            {joint: D [N m s/rad | N s/m]}, one value for all joints except wheels, or "urdf" for
            the damping of the URDF.
        rest : mapping
            {joint: position [rad|m]} at which its spring is relaxed.
        gravity : sequence of float (3,)
            Uniform acceleration [m/s^2] in Pinocchio's world axes.
        orbit : CircularOrbit, float, mapping or None
            Orbit of the robot, an altitude over the earth [m], or {parameter: value} of an orbit.
        passive : sequence of str
            Names of joints without a motor; the torques of these joints are removed from the
            inputs.
        weights : mapping
            Default weights of `lqr`: ``rule`` ("urdf" or "identity"), and ``q``, ``r``,
            ``bryson``, each {state, input, group or pattern: weight or largest value}.
        point : mapping
            Operating point of `fflin linearize`, `fflin check`, `fflin lqr` and others: ``joints``
            {joint: position [rad|m]}, ``rpy`` (3,) [deg] about fixed axes, ``position`` (3,) [m]
            of the base, ``velocity`` {joint or state: rate}, as in `fflin.velocity`. Functions
            ignore `point`; their arguments define the operating point.
        target : mapping
            Target state of the commands `simulate` and `montecarlo`, with the keys of `point`.
            Omitted parts are as in `point`.
        start : mapping
            Default initial state of `simulate`, with the keys of `point`. Omitted parts are as in
            `point`.
        limits : mapping
            {key: limit}. A key is a name, a group or a pattern of inputs or states. A limit is a
            largest magnitude, or a pair (least, largest).
            Limits given here replace the limits of the URDF and of the inputs.

        Returns
        -------
        Robot

        Raises
        ------
        InputError
            If one of these conditions is true:

            - a value is negative or not a number;
            - a wheel has a larger inertia than the link that carries it;
            - both gravity and an orbit are given.
        UnknownNameError
            If a field, a joint, a frame of an input or output, or a name in `limits` does not
            exist.
        ModelError
            If the robot's Pinocchio model was changed after `load`.
        """
        self.require_unchanged()
        robot = self
        if "passive" in fields:
            robot = robot._without_motors(fields.pop("passive"))
        if "inputs" in fields:
            robot = with_inputs(robot, fields.pop("inputs"))
        if "appendages" in fields:
            robot = with_appendages(robot, fields.pop("appendages"))
        joints, own = robot.joint_names, robot._bare.joint_names
        scope = Scope(robot.joint, joints, own, robot.inputs, self.urdf_damping)
        checked = checked_fields(fields, scope)
        for key in ("stiffness", "damping"):
            if key in checked:  # modes keep theirs unless they are named
                old = getattr(robot, key)
                kept = {joint.name: old[joint.name] for joint in robot.modes if joint.name in old}
                checked[key] = kept | checked[key]
        robot = replace(robot, **checked)
        if robot.orbit and any(robot.gravity):
            raise InputError(
                f"'{self.name}' has both uniform gravity and an orbit, which includes the gravity "
                "of its central body; leave one out"
            )
        for name in robot.used_frames:
            find_frame(robot.model, name)
        return robot

    def with_mass_properties(self, bodies: Mapping[str, Any]) -> Robot:
        """Return a copy of the robot with other masses, centres of mass or inertias.

        Parameters
        ----------
        bodies : mapping
            {body: {"mass": m [kg], "com": (3,) [m], "inertia": (3, 3) [kg m^2] about the centre of
            mass} or pin.Inertia}, in the axes of the body's joint.

            The name of a body is its joint, ``base``, a pattern, or its link if the body has only
            one link. Links that are fixed to each other form one body. Give the properties of the
            whole body, including its wheels.

            Omitted properties are unchanged. A mass without an inertia scales the inertia in
            proportion, like a change of density.

        Returns
        -------
        Robot
            A robot with the same meshes, names and inputs, and another ``urdf_sha256``.

        Raises
        ------
        InputError
            If a mass is not positive, or an inertia is not physically realisable or less than
            the inertia of the wheels in the body.
        UnknownNameError
            If there is no such body or property.
        """
        return self.with_bodies(given_bodies(self._bare.model, bodies))

    def perturbed(
        self, *, mass: float = 0.1, com: float = 0.1, inertia: float = 0.1, seed: int = 0
    ) -> Robot:
        """Return a copy of the robot with random, physically realisable mass properties.

        A number d is drawn uniformly from [-1, 1], independently for each body and axis:

        - The mass is multiplied by ``1 + mass * d``.
        - The second moments per mass along the axes of the body's frame are multiplied by ``1 +
          inertia * d``.
        - The centre of mass is shifted along each axis by ``com * d`` times the root-mean-square
          distance of the mass from the centre of mass along this axis.

        Parameters
        ----------
        mass, com, inertia : float
            Relative spreads, from 0 to less than 1.
        seed : int
            Seed of the random numbers; the same seed gives the same robot.

        Returns
        -------
        Robot
            Robot as returned by `with_mass_properties`.
        """
        spreads = {"mass": mass, "com": com, "inertia": inertia}
        return self.with_bodies(random_bodies(self._bare.model, seed, **spreads))

    def with_bodies(self, bodies: Mapping[int, pin.Inertia]) -> Robot:
        """Return the robot with other bodies {joint: body}, including wheels."""
        self.require_unchanged()
        bare = self._bare
        model = bare.model.copy()
        for joint, body in bodies.items():
            model.inertias[joint] = body
        masses, before = (
            b"".join(body.toDynamicParameters().tobytes() for body in each.inertias.tolist())
            for each in (model, bare.model)
        )
        digest = self.urdf_sha256
        if masses != before:
            digest = sha256(digest.encode() + masses).hexdigest()
        other = replace(bare, model=model, urdf_sha256=digest)
        if bare is self:
            return other
        whole = replace(self, urdf_sha256=digest, _unequipped=other)
        changed: Robot = with_inputs(whole, self.inputs)
        if not self.modes:
            return changed
        # On the same joints, so that a configuration keeps its amplitudes.
        model, own = self.model.copy(), self.model.inertias
        for joint in bodies:
            at = self.model.getJointId(bare.model.names[joint]) if joint > ROOT else ROOT
            mounted = difference(bare.model.inertias[joint], own[at])
            model.inertias[at] = difference(other.model.inertias[joint], mounted)
            if model.inertias[at].mass <= 0.0:
                return changed
        return replace(changed, model=model, joints=self.joints, followers=self.followers)

    @cached_property
    def pieces(self) -> dict[str, Piece]:
        """{name: piece} of the links, and of bodies of several links, on the model's joints."""
        # Wheels stand between the joints of the whole robot.
        names, at = self._bare.model.names, self.model.getJointId
        now = [at(name) if joint > ROOT else joint for joint, name in enumerate(names)]
        found = self._links_and_bodies[0]
        return {name: each._replace(joint=now[each.joint]) for name, each in found.items()}

    @property
    def link_of(self) -> dict[str, str]:
        """{body: link} of the bodies with one link; both names mean the same body."""
        return self._links_and_bodies[1]

    @cached_property
    def _links_and_bodies(self) -> tuple[dict[str, Piece], dict[str, str]]:
        return pieces_of(self._bare.model, self.links)

    @property
    def used_frames(self) -> tuple[str, ...]:
        """Names of the model's frames that inputs and outputs use."""
        of_inputs = [name for item in self.inputs for name in item.frames]
        return (*of_inputs, *(name for item in self.outputs for name in item.frames))

    @cached_property
    def idle_coordinates(self) -> tuple[str, ...]:
        """Coordinates that can move together without moving mass; usually none."""
        return idle_coordinates(self)

    @cached_property
    def wheels(self) -> dict[str, float]:
        """{name: inertia [kg m^2]} of the wheels among the joints."""
        wheels = named_wheels(self.inputs)
        return {name: wheel.inertia for name, wheel in wheels if wheel.inertia}

    @cached_property
    def stored_momentum(self) -> tuple[tuple[int, Array], ...]:
        """Momentum of wheels without inertia: (joint index, vector (3,) [N m s] in joint axes)."""
        return stored_momentum(self.model, self.inputs)

    @cached_property
    def springs(self) -> Springs:
        """Stiffness, damping and rest positions (n,) in state order."""
        given = (self.stiffness, self.damping, self.rest)
        return Springs(*(np.array([x.get(name, 0.0) for name in self.joint_names]) for x in given))

    @property
    def mass(self) -> float:
        """Total mass [kg]."""
        return float(sum(inertia.mass for inertia in self.model.inertias.tolist()[ROOT:]))

    def __repr__(self) -> str:
        return f"Robot('{self.name}', n={self.n}, mass={self.mass:.6g} kg)"

    def joint(self, name: str) -> Joint:
        """Return the independent joint with the given name.

        Raises
        ------
        UnknownNameError
            If there is no such joint; the message suggests similar names.
        InputError
            If the joint is a mimic joint, a wheel without inertia or a locked joint.
        """
        for joint in self.joints:
            if joint.name == name:
                return joint
        for follower in self.followers:
            if follower.joint.name == name:
                raise InputError(
                    f"joint '{name}' mimics '{follower.leader.name}'; give "
                    f"'{follower.leader.name}' instead"
                )
        if name in (wheel for wheel, _ in named_wheels(self.inputs)):
            raise InputError(
                f"wheel '{name}' has no inertia, so it is not a joint and has no speed; give the "
                "wheel an inertia, or its momentum"
            )
        if any(locked.rpartition("=")[0] == name for locked in self.locked):
            raise InputError(f"joint '{name}' is locked; unlock it, or leave it out here")
        raise unknown("joint", name, self.joint_names)

    @cached_property
    def modes(self) -> tuple[Joint, ...]:
        """Joints that are modes of flexible appendages or slosh."""
        return tuple(joint for joint in self.joints if joint.mode)

    @property
    def _bare(self) -> Robot:
        """The robot without the wheels and modes among its joints."""
        return self._unequipped or self

    def _without_motors(self, passive: Any) -> Robot:
        """Return the robot without the torques of joints that have no motor."""
        bare = self._bare
        joints = checked_passive(passive, bare.joint, bare.joint_names)
        inputs = tuple(item for item in self.inputs if getattr(item, "joint", None) not in joints)
        if not inputs:
            raise InputError(
                "all inputs are torques of passive joints; a model needs at least one input"
            )
        return replace(self, passive=joints, inputs=inputs)
