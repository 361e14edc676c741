"""Robot: a free-flyer root joint and n joints with one degree of freedom each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from fflin.base.errors import SingularInertiaError
from fflin.base.names import matching
from fflin.base.validation import Array
from fflin.robot import builder
from fflin.robot.mass_properties import (
    Piece,
    given_bodies,
    idle_coordinates,
    massless_note,
    pieces_of,
    random_bodies,
    sums_of,
)
from fflin.robot.robot_data import RobotData
from fflin.robot.rotors import (
    FlownWheels,
    flown_wheels,
    free_rotor_names,
    rotor_names,
    spin_inertia,
)


@dataclass(frozen=True, eq=False, repr=False)
class Robot(RobotData):
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
    orbit : CircularOrbit, EllipticOrbit or None
        Orbit of the robot. In orbit, Pinocchio's world is the orbital frame, see `CircularOrbit`.
    disturbance : mapping
        Torque and force on the base that act in simulations, {"tau_b" or "F_b": terms}, see
        `replace`. Linear models and control laws do not contain them.
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
    tune : mapping
        Laws, goals and settings of the command `fflin tune`, see `replace`.
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
    constraints : tuple of Weld, Hinge and Spherical
        Constraints between frames of the robot, or to inertial space, see `replace`.
    independent : tuple of str
        Coordinates that linear models of a robot with constraints keep; chosen by `linearize` if
        empty.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> heavy = robot.with_mass_properties({"base": {"mass": 900.0}})
    >>> stiff = robot.replace(stiffness={"joint_1": 50.0}, gravity=(0, 0, -1.62))
    >>> robot.n, stiff.stiffness["joint_1"], round(heavy.mass)
    (3, 50.0, 972)
    >>> pushed = robot.replace(disturbance={"tau_b": (2e-5, 0, 0)})
    >>> pushed.disturbance["tau_b"][0].constant
    (2e-05, 0.0, 0.0)
    """

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
        constraints : sequence of Weld, Hinge and Spherical
            Constraints between frames of the robot, or to inertial space, which replace all
            previous ones. A constraint without a placement holds its frames in the pose that they
            have at the first configuration at which it is used.
        independent : sequence of str
            Coordinates that linear models of a robot with constraints keep, as in `linearize`. It
            has no effect without constraints.
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
        orbit : CircularOrbit, EllipticOrbit, float, mapping or None
            Orbit of the robot, altitude [m] over the earth, or parameters {name: value} of a
            `CircularOrbit` or of an `EllipticOrbit`. None removes the orbit.
        disturbance : mapping or None
            Torque ``tau_b`` [N m] and force ``F_b`` [N] on the base that act on the true system:
            in `simulate` and in campaigns, but not in linear models, so that control laws do not
            know them. Each value is three numbers, which is a constant, or a mapping with the keys

            - ``constant`` (3,) [N m | N];
            - ``amplitude`` (3,) [N m | N], ``frequency`` [Hz] and ``phase`` [rad] (0 by default):
              the term amplitude sin(2 pi frequency t + phase);
            - ``axes``: "base", "inertial", or "orbital" in orbit. By default, the torque is in
              base axes, and the force in inertial axes, or in orbital axes in orbit. In orbit,
              inertial axes are parallel to the orbital axes at t = 0.

            A list of such mappings is their sum. In orbit with a magnetic field, further keys are

            - ``residual_dipole`` (3,) [A m^2]: a magnetic moment m in base axes, which exerts the
              torque m x b on the base;
            - ``field_scale`` and ``field_rotation`` (3,) [rad]: the true field is the field of the
              orbit, rotated by a rotation vector in the axes ``lvlh`` and multiplied by
              1 + field_scale. It acts on magnetorquers and on the residual dipole, and `BDot` and
              `RateDamping` measure it. An `Allocation` knows only the field of the orbit.

            The key ``plate`` is a mapping, or a list of
            mappings, of flat plates on which drag and solar pressure act, see (11.7) and (11.8):

            - ``area`` [m^2], ``normal`` (3,) and ``position`` (3,) [m] of the centre of pressure,
              in base axes; ``two_sided``: whether both faces are exposed, False by default;
            - for drag: ``density`` [kg/m^3], ``drag_coefficient`` (2.2 by default), and
              ``velocity`` (3,) [m/s] relative to the atmosphere, in inertial axes. In orbit, by
              default, it is the velocity of the orbit;
            - for solar pressure: ``sun`` (3,), the direction to the sun in inertial axes, and the
              reflected fractions ``specular`` and ``diffuse`` (0 by default). ``solar_pressure``
              is 4.54e-6 N/m^2 by default.

            None removes all disturbances.
        passive : sequence of str
            Names of joints without a motor. Their torques are removed from the inputs.
        wheel_joints : sequence of str
            Names of joints of the URDF that are flown as reaction wheels even if they are at rest.
            Designs do not regulate the angles of wheels, and reports do not judge them. The link of
            each joint must be balanced and symmetric about the joint axis, and the joint must have
            no spring and no position limits. Such a joint need not be named if it spins at the
            operating point.
        weights : mapping
            Default weights of `lqr` under the keys ``rule``, ``q``, ``r``, ``bryson`` and
            ``integral``. ``rule`` is "urdf" or "identity". ``q`` and ``r`` are weights, and
            ``bryson`` contains largest values: {state, input, group or pattern: value}.
            ``integral`` contains the signals that `lqr` also integrates, as its argument
            ``integral_action``: names of states or outputs, or {name: weight}.
        tune : mapping
            Laws, goals and settings of the command `fflin tune`, as in the table ``[tune]`` of a
            robot file: ``law`` and ``goal`` are sequences of mappings, ``vary`` contains ranges as
            for `uncertain`, and ``sample``, ``delay``, ``starts``, ``steps`` and ``seed`` are
            numbers. Functions ignore `tune`.
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
            - a disturbance is incomplete, or in orbital axes without an orbit;
            - both gravity and an orbit are given.
        UnknownNameError
            If a field, a joint, a frame of an input or output, or a name in `limits` does not
            exist.
        ModelError
            If the robot's Pinocchio model (``robot.model``) was modified after the robot was
            created.
        """
        return builder.replaced(self, fields)

    def merged(self, fields: Mapping[str, object]) -> Robot:
        """Return a copy with other fields; springs and limits that are not named are unchanged."""
        return builder.merged(self, fields)

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
        return self.with_bodies(given_bodies(self._bare.model, bodies))

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
        return self.with_bodies(random_bodies(self._bare.model, seed, **spreads))

    def with_bodies(self, bodies: Mapping[int, pin.Inertia]) -> Robot:
        """Return a copy with other inertias {joint index: inertia}, which include the wheels."""
        return builder.with_bodies(self, bodies)

    @cached_property
    def pieces(self) -> dict[str, Piece]:
        """Links and bodies {name: piece}, see `mass_properties.pieces_of`."""
        return pieces_of(self)

    @cached_property
    def _sums(self) -> frozenset[str]:
        """Names of the pieces that are sums of other pieces: the bodies of several links."""
        return sums_of(self.pieces)

    @cached_property
    def link_of(self) -> dict[str, str]:
        """Link names {body: link} of the bodies with one link, for which both names are valid."""
        return {
            x.body: name for name, x in self.pieces.items() if x.body not in self.pieces
        }

    def bodies_named(self, kind: str, key: str) -> list[str]:
        """Return the names of the pieces (links and bodies) that match a name or pattern.

        A body of several links is returned only if `key` is its name. `kind` is the kind of name
        for messages.
        """
        if key in self.pieces:
            return [key]
        if key in self.link_of:
            return [self.link_of[key]]
        names = [name for name in self.pieces if name not in self._sums]
        names += self.link_of
        matches = [names[i] for i in matching(kind, key, names)]
        return list(dict.fromkeys(self.link_of.get(name, name) for name in matches))

    @cached_property
    def idle_coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates that can move without kinetic energy; usually none."""
        return idle_coordinates(self)

    def require_inertia(self) -> None:
        """Raise `SingularInertiaError` if M is singular at every configuration.

        Rounding errors may hide this singularity in a factorisation of M.
        """
        if self.idle_coordinates:
            raise SingularInertiaError(massless_note(self, self.idle_coordinates))

    @cached_property
    def rotors(self) -> tuple[str, ...]:
        """Names of the joints whose body is symmetric about the joint axis."""
        return rotor_names(self)

    @cached_property
    def free_rotors(self) -> tuple[str, ...]:
        """Names of the rotors without position limits, which may spin forever."""
        return free_rotor_names(self, self.rotors)

    @cached_property
    def flown_wheels(self) -> FlownWheels:
        """Joints that are flown as reaction wheels, always or if they spin."""
        return flown_wheels(self, self.free_rotors)

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

    def _repr_html_(self) -> str:
        from fflin.robot.card import robot_card

        return robot_card(self)
