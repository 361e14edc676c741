"""Robot: a free-flyer root joint and n joints with one degree of freedom each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, require_known, unknown
from fflin.base.validation import Array
from fflin.robot import mass_properties
from fflin.robot.card import robot_card
from fflin.robot.equipment.appendages import Appendage
from fflin.robot.equipment.assembly import equipped, stored_momentum, with_appendages
from fflin.robot.fields import FIELDS, Range, checked_names, pulsed_thrusters
from fflin.robot.inputs import (
    BaseForce,
    BaseTorque,
    Input,
    JointTorque,
    named_inputs,
    named_wheels,
)
from fflin.robot.joints import ROOT, Coordinates, Joint, find_frame
from fflin.robot.orbit import CircularOrbit
from fflin.robot.outputs import FullState, Output
from fflin.robot.rotors import (
    flown_wheels,
    free_rotor_names,
    require_free_rotors,
    rotor_names,
    spin_inertia,
)


class Springs(NamedTuple):
    """Stiffness, damping and rest positions, each (n,), of the springs and dampers of joints."""

    stiffness: Array
    damping: Array
    rest: Array

    def force(self, q_m: Array, rates: Array) -> Array:
        """Return the forces (.., n) of springs and dampers at joint positions and rates (.., n)."""
        return self.stiffness * (self.rest - q_m) - self.damping * rates


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Coordinates):
    """Free-floating robot, made by `load` or `from_model`.

    Attributes
    ----------
    model : pin.Model
        Pinocchio model with a free-flyer root joint. ``model.gravity`` is zero even under gravity,
        which is in `gravity`: for Pinocchio's own functions, set it in a copy. Mimic joints and
        reaction wheels with an inertia are ordinary joints of `model`. The model must not be
        modified; to use another model, make another robot by `from_model`.
    name : str
        Name of the robot, or the file name of its URDF without the extension.
    urdf : Path or None
        URDF file from which the robot was read; None if there is no URDF.
    urdf_sha256 : str
        Hash of the URDF, and of the mass properties if they were changed; empty if there is no
        URDF.
    joints : tuple of Joint
        The n independent joints in state order, which is Pinocchio's order.
    followers : tuple of Follower
        The mimic joints, each with the independent joint that it follows.
    notes : tuple of str
        Warnings that were issued when the robot was read.
    locked : tuple of str
        Text "joint=value" [rad|m] for each welded joint.
    urdf_damping : mapping
        Viscous damping {joint: value [N m s/rad | N s/m]} from the URDF, including the damping of
        the joint's mimic joints. The robot has this damping only if `replace` or `load` was given
        ``damping="urdf"``.
    inputs : tuple of Input
        Inputs of the robot; by default torque and force on the base and the torque of every joint.
    outputs : tuple of Output
        Measured outputs of the robot; by default the full state.
    stiffness, damping : mapping
        Stiffness {joint: value [N m/rad | N/m]} of the springs, and damping {joint: value
        [N m s/rad | N s/m]} of the dampers.
    rest : mapping
        Positions {joint: value [rad|m]} at which the springs are relaxed; 0 for all other joints.
    gravity : tuple of float (3,)
        Uniform gravitational acceleration [m/s^2] in Pinocchio's world axes. `model` itself has
        zero gravity.
    orbit : CircularOrbit or None
        Orbit of the robot. In orbit, Pinocchio's world is the orbital frame, see `CircularOrbit`.
    package_dirs : tuple of Path
        Folders that are searched for ``package://`` meshes when the robot is drawn.
    xacro : mapping
        Arguments {name: text} with which a xacro file was expanded.
    passive : tuple of str
        Joints without a motor.
    wheel_joints : tuple of str
        Joints of the URDF that are flown as reaction wheels even at rest, see `replace`.
    weights : mapping
        Default weights of `lqr`, which take precedence over the weights of the rule "urdf" or
        "identity"; see `replace`.
    point : mapping
        Default operating point of commands such as `fflin linearize`, see `replace`.
    target : mapping
        Target state of the commands `fflin simulate` and `fflin montecarlo`, see `replace`.
    start : mapping
        Default initial state of `simulate` and `visualize`, see `replace`.
    limits : mapping
        Limits {name: pair (least, largest)} of inputs and states, which replace limits of the URDF
        and of the inputs.
    links : mapping
        Mass properties of all links with mass, as given in the URDF, by the names of the links.
    file_joints : tuple of str
        All joints of the file, including fixed joints.
    attached : tuple of (str, Robot)
        Grasped payload robots, each in a pair with the prefix of its names.
    appendages : tuple of FlexibleAppendage and Slosh
        Flexible appendages and slosh. Their modes are among the joints.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> heavy = robot.with_mass_properties({"base": {"mass": 900.0}})
    >>> stiff = robot.replace(stiffness={"joint_1": 50.0}, gravity=(0, 0, -1.62))
    >>> robot.n, stiff.stiffness["joint_1"], round(heavy.mass)
    (3, 50.0, 972)
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
    orbit: CircularOrbit | None = None
    package_dirs: tuple[Path, ...] = ()
    xacro: Mapping[str, str] = field(default_factory=dict)
    passive: tuple[str, ...] = ()
    wheel_joints: tuple[str, ...] = ()
    weights: Mapping[str, Any] = field(default_factory=dict)
    point: Mapping[str, Any] = field(default_factory=dict)
    target: Mapping[str, Any] = field(default_factory=dict)
    start: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Range] = field(default_factory=dict)
    links: Mapping[str, mass_properties.LinkMass] = field(default_factory=dict)
    file_joints: tuple[str, ...] = ()
    attached: tuple[tuple[str, Robot], ...] = ()
    appendages: tuple[Appendage, ...] = ()
    # The robot without the joints of wheels and modes; None if no joint is a wheel or mode. Its
    # fields such as `inputs` and `stiffness` may be outdated.
    _unequipped: Robot | None = None

    def __post_init__(self) -> None:
        if self._as_made is None or self._as_made[0] is not self.model:
            object.__setattr__(self, "_as_made", (self.model, self.model.copy()))
        if not self.inputs:
            # Default: one force or torque for each degree of freedom.
            default = (BaseTorque(), BaseForce(), *map(JointTorque, self.joint_names))
            object.__setattr__(self, "inputs", default)

    def replace(self, **fields: object) -> Robot:
        """Return a copy of the robot with other inputs, springs, gravity, orbit or other fields.

        Parameters
        ----------
        inputs : sequence of Input
            Inputs of the robot, in the order of u; they replace all previous inputs. Wheels with an
            inertia become joints of the robot, and wheels that are no longer among the inputs are
            removed. The joint of a `JointTorque` may be a pattern such as ``*``, which stands for
            all matching joints with a motor.
        appendages : sequence of FlexibleAppendage and Slosh
            Flexible appendages and slosh of the robot, which replace all previous ones. Their
            modes become joints without motors.
        outputs : sequence of Output
            Measured outputs of the robot, in the order of y.
        stiffness : mapping or float
            Spring stiffness {joint: value [N m/rad | N/m]}, or one value for all joints except
            wheels. In this and all other mappings, a name may be a pattern such as ``hinge_*``.
        damping : mapping, float or "urdf"
            Viscous damping {joint: value [N m s/rad | N s/m]}, one value for all joints except
            wheels, or "urdf" for the damping of the URDF.
        rest : mapping
            Positions {joint: position [rad|m]} at which the springs are relaxed.
        gravity : sequence of float (3,)
            Uniform gravitational acceleration [m/s^2] in Pinocchio's world axes.
        orbit : CircularOrbit, float, mapping or None
            Orbit of the robot, altitude [m] over the earth, or parameters {name: value} of a
            `CircularOrbit`. None removes the orbit.
        passive : sequence of str
            Names of joints without a motor. Their torques are removed from the inputs.
        wheel_joints : sequence of str
            Names of joints of the URDF that are flown as reaction wheels even if they are at rest.
            Designs do not regulate the angles of wheels, and reports do not judge them. The link of
            each joint must be balanced and symmetric about the joint axis, and the joint must have
            no spring and no position limits. Such a joint need not be named if it spins at the
            operating point.
        weights : mapping
            Default weights of `lqr` under its keywords ``rule``, ``q``, ``r`` and ``bryson``.
            ``rule`` is "urdf" or "identity". ``q`` and ``r`` are weights, and ``bryson`` contains
            largest values: {state, input, group or pattern: value}.
        point : mapping
            Default operating point of commands such as `fflin linearize`, `fflin check` and
            `fflin lqr`. Functions ignore `point`, because their arguments define the operating
            point. The keys, all optional, are

            - ``joints``: {joint: position [rad|m]};
            - ``rpy`` (3,): roll, pitch and yaw [deg] of the base about fixed axes;
            - ``position`` (3,): position of the base [m];
            - ``velocity``: {joint or state: rate}, as in `fflin.velocity`.
        target : mapping
            Target state of the commands `fflin simulate` and `fflin montecarlo`, with the same
            keys as `point`. Omitted keys are taken from `point`.
        start : mapping
            Default initial state of `simulate`, with the same keys as `point`. Omitted keys are
            taken from `point`.
        limits : mapping
            Limits {name: limit}, which replace the limits of the URDF and of the inputs. A name
            is an input, a state, a group or a pattern. A limit is a largest magnitude, or a pair
            (least, largest).

        Returns
        -------
        Robot

        Raises
        ------
        InputError
            If one of these conditions is true:

            - a value is negative or not a number;
            - a wheel has a larger inertia than the link that carries it;
            - a joint in `wheel_joints` cannot spin freely;
            - both gravity and an orbit are given.
        UnknownNameError
            If a field, a joint, a frame of an input or output, or a name in `limits` does not
            exist.
        ModelError
            If the robot's Pinocchio model (``robot.model``) was modified after the robot was
            created.
        """
        return self._replaced(fields, merged=False)

    def merged(self, fields: Mapping[str, object]) -> Robot:
        """Return a copy with other fields; springs and limits that are not named are unchanged."""
        if self.passive and isinstance(given := fields.get("passive"), list | tuple):
            fields = {**fields, "passive": [*self.passive, *given]}
        return self._replaced(fields, merged=True)

    def _replaced(self, fields: Mapping[str, object], *, merged: bool) -> Robot:
        self.require_unchanged()
        require_known("field of a robot", fields, FIELDS)
        robot = self
        if "passive" in fields:
            robot = replace(
                self, passive=checked_names("passive", fields["passive"], self._bare)
            )
            driven = [
                x for x in self.inputs if getattr(x, "joint", None) not in robot.passive
            ]
            fields = {"inputs": driven, **fields}
        if "wheel_joints" in fields:
            named = checked_names("wheel_joints", fields["wheel_joints"], self._bare)
            robot = replace(robot, wheel_joints=named)
        if "inputs" in fields:
            robot = equipped(robot, inputs=fields["inputs"])
        if "appendages" in fields:
            robot = with_appendages(robot, fields["appendages"])
        checked = {
            k: check(x, robot) for k, x in fields.items() if (check := FIELDS[k])
        }
        # A given table replaces the old table. If `merged` is true, the old entries of all joints
        # that the new table does not name stay. Otherwise, only those of modes stay.
        modes = {joint.name for joint in robot.modes}
        tables = ["stiffness", "damping"]
        if merged:
            tables += ["rest", "limits"]
        for key in tables:
            if key in checked:
                kept = {
                    k: x for k, x in getattr(robot, key).items() if merged or k in modes
                }
                checked[key] = kept | checked[key]
        robot = replace(robot, **checked)
        if robot.orbit and any(robot.gravity):
            raise InputError(
                f"'{self.name}' has both uniform gravity and an orbit, but an orbit already "
                "includes the gravity of its central body; leave one of them out"
            )
        for name in robot.used_frames:
            find_frame(robot.model, name)
        require_free_rotors(robot)
        return robot

    def with_mass_properties(self, bodies: Mapping[str, object]) -> Robot:
        """Return a copy of the robot with other masses, centres of mass or inertias.

        Parameters
        ----------
        bodies : mapping
            New mass properties {body: properties} in the axes of the body's joint. The properties
            are a pin.Inertia, or a mapping with any of the keys

            - ``mass`` [kg];
            - ``com`` (3,) [m], the centre of mass;
            - ``inertia`` (3, 3) [kg m^2] about the centre of mass.

            Links that are fixed to each other form one body, named by its joint or ``base``. A body
            with only one link can also be named by this link. A pattern selects several bodies.
            Give the properties of the whole body, including its wheels.

            Omitted properties are unchanged. But if a mass is given without an inertia, the
            inertia is scaled in proportion to the mass, as for a change of density.

        Returns
        -------
        Robot
            A robot with the same meshes, names and inputs, but with another ``urdf_sha256``.

        Raises
        ------
        InputError
            If a mass is not positive, an inertia is not physically realisable, or the inertia of a
            body is less than the inertia of its wheels.
        UnknownNameError
            If a body or property does not exist.
        """
        return self.with_bodies(mass_properties.given_bodies(self._bare.model, bodies))

    def perturbed(
        self,
        *,
        mass: float = 0.1,
        com: float = 0.1,
        inertia: float = 0.1,
        seed: int = 0,
    ) -> Robot:
        """Return a copy of the robot with random, physically realisable mass properties.

        The properties of each body are changed by random numbers d, each drawn independently and
        uniformly from [-1, 1]:

        - The mass is multiplied by ``1 + mass * d``.
        - For each axis of the body's frame, the second moment along this axis per unit mass is
          multiplied by ``1 + inertia * d``.
        - Along each axis, the centre of mass is shifted by ``com * d`` times the root-mean-square
          distance of the body's mass elements from the centre of mass along this axis.

        Parameters
        ----------
        mass, com, inertia : float
            Relative spreads, from 0 to less than 1.
        seed : int
            Seed of the random numbers; the same seed gives the same robot.

        Returns
        -------
        Robot
            Copy of the robot with the changed mass properties.
        """
        spreads = {"mass": mass, "com": com, "inertia": inertia}
        return self.with_bodies(
            mass_properties.random_bodies(self._bare.model, seed, **spreads)
        )

    def with_bodies(self, bodies: Mapping[int, pin.Inertia]) -> Robot:
        """Return a copy with other inertias {joint index: inertia}, which include the wheels."""
        self.require_unchanged()
        bare = self._bare
        model = bare.model.copy()
        for joint, body in bodies.items():
            model.inertias[joint] = body
        digest = self.urdf_sha256
        masses = mass_properties.dynamic_parameters(model)
        if masses != mass_properties.dynamic_parameters(bare.model):
            digest = sha256(digest.encode() + masses).hexdigest()
        other = replace(bare, model=model, urdf_sha256=digest)
        if bare is self:
            return other
        changed: Robot = equipped(self, other)
        if not self.modes:
            return changed
        # `changed` has new joints for the modes. Use the old joints instead, so that the modal
        # amplitudes in q have the same meaning as before.
        model = self.model.copy()
        inertias = self.model.inertias
        for joint in bodies:
            at = ROOT
            if joint > ROOT:
                at = self.model.getJointId(bare.model.names[joint])
            mounted = bare.model.inertias[joint] - inertias[at]
            model.inertias[at] = other.model.inertias[joint] - mounted
            if model.inertias[at].mass <= 0.0:
                return changed
        return replace(
            changed, model=model, joints=self.joints, followers=self.followers
        )

    pieces = cached_property(mass_properties.pieces_of)
    _sums = cached_property(mass_properties.sums_of)

    @cached_property
    def link_of(self) -> dict[str, str]:
        """Link names {body: link} of the bodies with one link, for which both names are valid."""
        return {
            x.body: name for name, x in self.pieces.items() if x.body not in self.pieces
        }

    @property
    def used_frames(self) -> tuple[str, ...]:
        """Names of the frames at which inputs and outputs are mounted."""
        of_inputs = [name for item in self.inputs for name in item.frames]
        return (*of_inputs, *(name for item in self.outputs for name in item.frames))

    @cached_property
    def named_inputs(self) -> tuple[tuple[Input, tuple[str, ...]], ...]:
        """Each input with the names of its entries in u."""
        return tuple(named_inputs(self.inputs))

    pulsed_thrusters = cached_property(pulsed_thrusters)
    idle_coordinates = cached_property(mass_properties.idle_coordinates)
    rotors = cached_property(rotor_names)
    free_rotors = cached_property(free_rotor_names)
    flown_wheels = cached_property(flown_wheels)

    @cached_property
    def reaction_wheels(self) -> dict[str, float]:
        """Inertias {name: inertia [kg m^2]} of the inputs `ReactionWheel` that are joints."""
        wheels = named_wheels(self.inputs)
        return {name: wheel.inertia for name, wheel in wheels if wheel.inertia}

    @cached_property
    def wheels(self) -> dict[str, float]:
        """Inertias {name: inertia [kg m^2]} of the joints that are always flown as wheels.

        These are the inputs `ReactionWheel` with an inertia, and the joints in `wheel_joints`.
        """
        return self.wheels_at(np.zeros(self.nv))

    def wheels_at(self, v: Array) -> dict[str, float]:
        """Return inertias {name: inertia [kg m^2]} of the joints that are flown as wheels.

        `v` (nv,) is the velocity at the operating point. The joints are the robot's `wheels`, and
        the rotors without position limits that spin at v.
        """
        speeds = {joint.name: float(v[joint.idx_v]) for joint in self.joints}
        known = self.reaction_wheels
        names = self.flown_wheels.at(speeds)
        return {x: known.get(x) or spin_inertia(self, x) for x in names}

    stored_momentum = cached_property(stored_momentum)

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
    def mass(self) -> float:
        """Total mass [kg]."""
        return float(pin.computeTotalMass(self.model))

    def __repr__(self) -> str:
        return f"Robot('{self.name}', n={self.n}, mass={self.mass:.6g} kg)"

    def _repr_html_(self) -> str:
        return robot_card(self)

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
    def _bare(self) -> Robot:
        """The robot without the joints of wheels and modes; `self` if it has no such joints."""
        return self._unequipped or self
