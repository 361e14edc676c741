"""Equilibria: inputs and spring deflections at rest, and attitudes at rest in an orbit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base import html
from fflin.base.errors import EquilibriumError, InputError, SingularInertiaError, listed
from fflin.base.tables import grid, signals
from fflin.base.validation import Array, Complex, FrozenArrays, Indices, instance, truth
from fflin.dynamics.coordinates import (
    ANGULAR,
    LINEAR,
    ORBITAL,
    PIN_ANGULAR,
    PIN_LINEAR,
    Frame,
    forces_of,
    frame_of,
    refuse_constraints,
    refuse_elliptic,
    refuse_orbit,
)
from fflin.dynamics.disturbance import BaseDisturbance
from fflin.dynamics.orbital import OrbitField, mean_motion
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.constrained_equilibrium import ConstrainedBalance
from fflin.linear.least_norm import EPS, TOLERANCE, least_norm
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

# Forces and principal moments of inertia are sums of terms. Their assumed rounding error is this
# fraction of the magnitude of the terms. The same number is the largest spring deflection
# [rad or m] that is not shown.
_ROUNDING = 1e3 * float(np.finfo(float).eps)


# Largest number of steps of the search for a tilt, and the length [rad] of its longest step. A
# direction of the tilt counts as without effect if its effect is below this fraction of the
# largest; this removes the rotation about the vertical.
_MOST_TILTS, _LONGEST_TILT, _SMALL_EFFECT = 50, 0.5, 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class Equilibrium(html.Reported, FrozenArrays):
    """Result of `equilibrium`: minimum-norm inputs, spring deflections and residual forces.

    Attributes
    ----------
    q : ndarray (nq,)
        Equilibrium configuration, to be given to `linearize` as q. This configuration differs from
        the given configuration by the spring deflections of joints without a motor, and by the
        tilt of the base. In orbit, the base may be displaced, see `equilibrium`.
    u : ndarray (nu,)
        Minimum-norm inputs, to be given to `linearize` as u.
    sag : ndarray (n,)
        Deflection of each joint from its given position [rad | m].
    tilt : ndarray (3,)
        Rotation vector [rad] from the given attitude of the base to the attitude in q, in base
        axes. It is nonzero only under gravity, see `equilibrium`.
    residual : ndarray (6 + n,)
        Generalised forces that the inputs do not balance. Forces on the base are in base axes.
    input_names, input_units : tuple of str
        Names and units of u.
    force_names, force_units : tuple of str
        Names and units of the residual: tau_b, F_b, and tau_m of every joint.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", stiffness={"joint_1": 50.0})
    >>> held = fflin.equilibrium(robot, fflin.configuration(robot, {"joint_1": 0.2}))
    >>> round(float(held.u[6]), 6), held.input_names[6]
    (10.0, 'tau_m.joint_1')
    >>> soft = fflin.load("planar_detumble", passive=["joint_1"], stiffness={"joint_1": 50.0})
    >>> print(fflin.equilibrium(soft, fflin.configuration(soft, {"joint_1": 0.2})))
    u: all zero
    deflections: joint_1 = -0.2 rad
    """

    q: Array
    u: Array
    sag: Array
    tilt: Array
    residual: Array
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    force_names: tuple[str, ...]
    force_units: tuple[str, ...]

    def __str__(self) -> str:
        text = "u: all zero"
        if self.u.any():
            text = signals("u", self.u, self.input_names, self.input_units)
        if self.tilt.any():
            angles = np.degrees(self.tilt)
            text += f"\n{signals('tilt of the base', angles, ('x', 'y', 'z'), ('deg',) * 3)}"
        if not (shown := np.where(np.abs(self.sag) > _ROUNDING, self.sag, 0.0)).any():
            return text
        names = [name.partition(".")[2] for name in self.force_names[6:]]
        units = ["m" if unit == "N" else "rad" for unit in self.force_units[6:]]
        return f"{text}\n{signals('deflections', shown, names, units)}"


_PERIODIC = (
    "fflin.linearize_orbit finds periodic motions and the inputs that hold the robot"
)


def equilibrium(
    robot: Robot,
    q: Array | None = None,
    *,
    v: Array | None = None,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    tilt: bool = True,
    disturbed: bool = False,
    forces: Mapping[str, float] | None = None,
) -> Equilibrium:
    r"""Compute the spring deflections and the minimum-norm inputs that balance all forces.

    The balanced forces are the forces that `linearize` also includes: springs, gravity, dampers,
    and the inertial forces of a steady motion. With `disturbed`, they also include the constant
    part of `Robot.disturbance`. In orbit, the base is at rest in the rotating orbital frame, and
    the forces include the gravity gradient and the inertial forces of this frame. To find
    attitudes at which the base needs no torque in orbit, use `relative_equilibria`.

    Let f be the generalised forces on the robot without the inputs u, and B the matrix from u to
    generalised forces. The inputs solve

    .. math::
        \min \|u\|_2 \quad \text{subject to} \quad B(q)\,u = -f(q, v), \qquad
        u_k \ge 0 \text{ for every thruster } k.

    The norm of u is the norm of its numerical values in SI units. The force balance has rows in N m
    and in N. To make these rows comparable, row i is scaled by :math:`\sqrt{(M^{-1})_{ii}}`, with
    the inertia matrix M. The scaled residual must not exceed 1e-9 of the balanced forces, or its
    accelerations must be so small that `LinearModel.is_equilibrium` counts them as zero.

    If no inputs balance all forces, but the robot has reaction wheels, the wheels may accelerate:
    only the forces on the other coordinates are balanced. The wheels then gain momentum.

    In orbit, a base at the origin of the orbital frame needs a force if its origin is not the
    centre of mass. If no input pushes the base, it is displaced so that the centre of mass is on
    the orbit.

    A joint with a spring but without a `JointTorque` deflects, unless another input balances the
    force on the joint. Newton's method finds the deflected position. Its Jacobian is
    :math:`M\,\partial\dot\nu/\partial q_m`, with the acceleration :math:`\dot\nu` of the robot.

    Under gravity, the inputs may balance the forces at another attitude only, such as a robot with
    rotors whose arm is stretched out. If a force on the base is missing at the given attitude, the
    base is tilted until the inputs balance all forces, with the smallest rotation in each step.

    Parameters
    ----------
    robot : Robot
    q : array_like (nq,), optional
        Configuration in Pinocchio's order; neutral by default.
    v : array_like (nv,), optional
        Velocity of a steady motion, which must be constant in base axes; at rest by default. Only
        joints that are rotors may move, see `LinearModel.ignorable`. Under gravity, the base may
        rotate only about the vertical.
    frame : {"hybrid", "local", "world", "lvlh", "hill"}, optional
        Axes of the inputs on the base, as in `linearize`.
    reference : pin.SE3, optional
        Placement whose axes are the reference axes, as in `linearize`. The default is the base
        placement; inputs on the base are then in base axes for any `frame`. For a robot in orbit,
        the default is the orbital frame.
    tilt : bool
        Whether the base may be tilted under gravity, by less than 90 deg. A base that moves is
        never tilted.
    disturbed : bool
        Whether the inputs also balance the constant part of `Robot.disturbance`, and the forces of
        its flat plates at t = 0. Such inputs show what the actuators must hold. By default, the
        inputs are the inputs of a control law, which does not know the disturbance; a linear model
        does not contain it either. Inertial axes are the axes at t = 0.
    forces : mapping, optional
        Forces [N] and torques [N m] that constraints must exert, such as
        ``{"grasp.force.x": 5.0}``, with the names and axes of `ConstraintForce`. The other
        forces in a loop follow from the inputs of minimum norm.

    Returns
    -------
    Equilibrium
        Result whose q and u define the operating point of
        ``linearize(robot, result.q, v, u=result.u)``. Give `linearize` the same `frame` and
        `reference`.

    Raises
    ------
    EquilibriumError
        If one of these conditions is true:

        - no inputs balance the forces, at the given attitude or at any that the search reaches;
          the message names the residual forces at the given attitude;
        - springs are too weak for their load, or Newton's method does not converge;
        - no inputs can make the motion steady.
    InputError
        If an argument has a wrong size or an entry that is not a number.
    ChartError, SingularInertiaError
        Under the same conditions as in `linearize`.

    Notes
    -----
    For a robot with constraints, the forces are balanced in the independent coordinates, which name
    the residual. The robot must be at rest, and must not be in orbit. Joints do not deflect: if
    springs act on joints without a motor, q must be a configuration at which they are balanced.

    The bounds of thrusters turn the minimisation into a least-distance problem, which non-negative
    least squares solve exactly (Lawson and Hanson, Solving Least Squares Problems, 1974,
    chapter 23).

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", stiffness={"joint_1": 50.0})
    >>> q = fflin.configuration(robot, {"joint_1": 0.2})
    >>> held = fflin.equilibrium(robot, q)
    >>> fflin.linearize(robot, held.q, u=held.u).is_equilibrium(1e-9)
    True
    """
    state = StateMap(robot, frame=frame, reference=reference)
    refuse_elliptic(robot, "equilibria", _PERIODIC)
    tilt = truth("tilt", tilt)
    if forces and not robot.constraints:
        raise InputError(
            f"forces is given, but '{robot.name}' has no constraints that exert forces; leave out "
            "forces"
        )
    pushed = BaseDisturbance(robot, state.field, constant=True)
    if not truth("disturbed", disturbed):
        pushed.clear()
    given = robot.neutral() if q is None else robot.checked_configuration(q)
    if robot.constraints:
        refuse_orbit(robot, "equilibria of robots with constraints")
        _require_rest(robot, v)
        disturbance = pushed.wrench(0.0, given)
        held = ConstrainedBalance(robot, given, disturbance, forces or {})
        if not held.holds:
            raise _unbalanced(robot, held.left, held.residual, held.names)
        u = _in_frame(state, held.lin.q, held.u, reference)
        still = np.zeros(robot.n), np.zeros(3)
        return Equilibrium(
            held.lin.q,
            u,
            *still,
            held.residual,
            held.lin.input_names,
            held.lin.input_units,
            tuple(held.names),
            tuple(held.names.values()),
        )
    # put the reference at the base, so that forces and inputs are in base axes
    if robot.orbit:
        base_pose = robot.model.jointPlacements[ROOT] * pin.XYZQUATToSE3(given[:7])
        linearizer = Linearizer(robot, frame=frame, reference=base_pose)
    else:
        linearizer = Linearizer(robot, moving=True)
    problem = _Problem(linearizer, state, pushed, v)
    balance = first = _settled(problem, given, spun=False)
    if tilt and first.asks_tilt:
        balance = _tilted(problem, first)
    balance = _with_other_points(problem, balance, given)
    if not balance.holds:
        balance = first
    pushes = forces_of(robot)
    if not balance.holds:
        raise _unbalanced(robot, balance.left, balance.residual, pushes)
    at = balance.lin.q
    u = _in_frame(state, at, balance.u, reference)
    actuation = Actuation(state)
    rotation = np.zeros(3)
    if (at[3:7] != given[3:7]).any():
        before, after = pin.Quaternion(given[3:7]), pin.Quaternion(at[3:7])
        rotation = pin.log3(before.matrix().T @ after.matrix())
    names = actuation.names, actuation.units, tuple(pushes), tuple(pushes.values())
    sag = state.joints_apart(given, at)
    return Equilibrium(at, u, sag, rotation, balance.residual, *names)


class _Problem(NamedTuple):
    """Robot, as its linearizer, with the velocity and the disturbances of an equilibrium."""

    linearizer: Linearizer
    state: StateMap
    disturbance: BaseDisturbance
    v: Array | None

    def disturbance_at(self, q: Array) -> Array:
        """Return the generalised force (6 + n,) of the disturbances, in base axes."""
        forces: Array = np.zeros(6 + self.state.robot.n)
        wrench = self.disturbance.wrench(0.0, q)
        forces[ANGULAR], forces[LINEAR] = wrench[PIN_ANGULAR], wrench[PIN_LINEAR]
        return forces


def _pushed(linearizer: Linearizer) -> bool:
    """Return whether a robot has inputs that exert a force on the base."""
    return not {"F_b", "thrust"}.isdisjoint(linearizer.prepared.actuation.groups)


def on_orbit(robot: Robot, q: Array, frame: Frame) -> Array:
    """Return q (nq,) with the base displaced so that the centre of mass is on the orbit.

    The base is displaced in the plane that is perpendicular to the orbit.
    """
    placed = q.copy()
    root = robot.model.jointPlacements[ROOT]
    along = OrbitField(robot, frame).axes[:, 1]
    center = pin.centerOfMass(robot.model, robot.create_data(), q)
    placed[:3] -= root.rotation.T @ (center - (center @ along) * along)
    return placed


def _with_other_points(problem: _Problem, balance: _Balance, given: Array) -> _Balance:
    """Return `balance` if it holds, or a balance with accelerating wheels or on the orbit."""
    robot = problem.linearizer.robot
    wheels = balance.lin.wheels
    # configuration, and whether the wheels may accelerate
    attempts = list[tuple[Array, bool]]()
    if wheels:
        attempts.append((given, True))
    if robot.orbit and not given[:3].any() and not _pushed(problem.linearizer):
        centered = on_orbit(robot, given, problem.state.frame)
        attempts.append((centered, False))
        if wheels:
            attempts.append((centered, True))
    for at, spun in attempts:
        if balance.holds:
            break
        balance = _settled(problem, at, spun=spun)
    return balance


def _in_frame(state: StateMap, q: Array, u: Array, reference: pin.SE3 | None) -> Array:
    """Return inputs u (nu,) in base axes in the axes of the inputs of `linearize`."""
    robot = state.robot
    if reference is None and not robot.orbit:
        return u
    base = robot.model.jointPlacements[ROOT] * pin.XYZQUATToSE3(q[:7])
    R = state.reference.rotation.T @ base.rotation
    turned = u.copy()
    for columns in Actuation(state).held:
        turned[columns] = R @ u[columns]
    return turned


def _require_rest(robot: Robot, v: Array | None) -> None:
    """Raise `InputError` if a robot with constraints moves."""
    if v is not None and np.any(robot.checked_velocity(v)):
        raise InputError(
            f"'{robot.name}' has constraints, so that equilibria are computed only at rest; leave "
            "out v"
        )


def _unbalanced(
    robot: Robot, left: Array, residual: Array, names: Mapping[str, str]
) -> EquilibriumError:
    """Return the error that lists the residual forces, the largest first.

    `left` contains the residual in comparable units, and `names` the names with their units.
    """
    sizes, named = np.abs(left), list(names.items())
    forces = [
        f"{named[i][0]} {residual[i]:.3g} {named[i][1]}"
        for i in np.argsort(-sizes)  # the largest scaled force first
        if sizes[i] > 1e-6 * sizes.max()
    ]
    advice = "add inputs that balance these forces (thrusters cannot pull)"
    if any(robot.gravity) and any(force.startswith("F_b") for force in forces):
        advice += ", set gravity to zero if the robot falls freely"
    return EquilibriumError(
        f"the inputs of '{robot.name}' cannot balance the forces on it at this point; residual "
        f"forces: {listed(forces)}; {advice}, or choose another point"
    )


def _settled(problem: _Problem, given: Array, *, spun: bool) -> _Balance:
    """Return the balance after joints with a spring but without a motor have deflected.

    If `spun`, the inputs may accelerate the wheels of the robot, so that the wheels gain momentum.
    """
    linearizer, state, v = problem.linearizer, problem.state, problem.v
    robot = linearizer.robot
    pushes, motors = forces_of(robot), set(Actuation(state).names)
    free = {f"tau_m.{name}" for name, k in robot.stiffness.items() if k} - motors
    soft = np.array([name in free for name in pushes])
    balance = _Balance(problem, given, spun=spun)
    tolerance = balance.tolerance
    for _ in range(20):  # Newton's method, which needs a few steps
        loose = soft & (np.abs(balance.residual) > tolerance)
        if not loose.any():
            break
        lin, step = linearizer(balance.lin.q, v, balance.u), np.zeros(len(soft))
        hold = -(lin.M @ lin.A[-len(soft) :, : len(soft)])[np.ix_(soft, soft)]
        scale = np.sqrt(robot.springs.stiffness[soft[6:]])
        if np.linalg.eigvals(hold / np.outer(scale, scale)).real.min() <= TOLERANCE:
            weak = listed([robot.joint_names[i] for i in np.flatnonzero(soft[6:])])
            raise EquilibriumError(
                f"the springs of {weak} are too weak to hold '{robot.name}' at this "
                "configuration; make them stiffer, or choose another point"
            )
        step[soft] = np.linalg.solve(hold, balance.residual[soft])
        at = pin.integrate(robot.model, lin.q, state.spread(step))
        at[:7] = given[:7]
        balance = _Balance(problem, at, spun=spun)
        tolerance = np.maximum(tolerance, balance.tolerance)
    balance.left[soft & ~loose] = 0.0
    return balance


def _tilted(problem: _Problem, start: _Balance) -> _Balance:
    """Tilt the base by Gauss-Newton steps until the inputs balance the forces.

    Return `start` if no attitude within 90 deg is found.
    """
    balance = start
    level = pin.Quaternion(start.lin.q[3:7]).matrix()
    for _ in range(_MOST_TILTS):
        step = balance.tilt_step()
        # A long step is shortened, because the force changes its sign beyond 90 deg.
        step *= min(
            1.0, _LONGEST_TILT / max(float(np.linalg.norm(step)), _LONGEST_TILT)
        )
        q = balance.lin.q.copy()
        rotation = pin.Quaternion(q[3:7]).matrix() @ pin.exp3(step)
        q[3:7] = pin.Quaternion(rotation).coeffs()
        balance = _settled(problem, q, spun=False)
        if np.linalg.norm(pin.log3(level.T @ rotation)) >= 0.5 * np.pi:
            return start
        if balance.holds:
            return balance
    return start


class _Balance:
    """Minimum-norm inputs that balance the forces at a point, and the residual forces.

    Inputs and forces on the base are in base axes. If `spun`, the wheels may accelerate. The rows
    of their forces are then zero, and their inertial forces are taken out of all other rows.
    """

    def __init__(self, problem: _Problem, q: Array, *, spun: bool = False) -> None:
        linearizer = problem.linearizer
        robot, actuation = linearizer.robot, linearizer.prepared.actuation
        self.robot = robot
        self.lin = lin = linearizer(q, problem.v)
        drift = lin.rate
        _require_steady(lin, drift)
        columns = actuation.columns(robot.create_data(), lin.q)
        # The torques of magnetorquers change with time, so they hold no equilibrium.
        torquers = [index for _, index, _ in actuation.torquers]
        if torquers:
            columns = columns.copy()
            columns[:, torquers] = 0.0
        M = lin.M
        acceleration = drift[-len(lin.M) :]
        inverse = np.linalg.inv(M)
        mobility = np.sqrt(inverse.diagonal())
        terms = _ROUNDING * (np.abs(M) @ np.abs(acceleration))
        # Compute bounds (6 + n,) of the rounding errors in the forces, because large terms may
        # cancel in the forces.
        state, springs = linearizer.prepared.map, robot.springs
        absolute = lin.v
        if state.field:
            absolute = state.field.absolute(lin.q, lin.v)
        speed = np.abs(state.velocities(absolute))
        rounding = max(speed[:3].max(), speed[6:].max(initial=0.0)) * (
            np.abs(M) @ speed
        )
        farthest = np.abs(state.joint_positions(lin.q)) + np.abs(springs.rest)
        rounding[6:] += springs.stiffness * farthest
        rounding, wanted = _ROUNDING * rounding, -M @ acceleration
        noise = terms
        if robot.orbit:
            noise = terms + rounding
        wanted[np.abs(wanted) <= noise] = 0.0
        wanted -= problem.disturbance_at(lin.q)
        if spun:
            wheels = np.array(
                [6 + robot.joint_names.index(name) for name in lin.wheels]
            )
            others = _without_wheels(M, wheels)
            columns, wanted = others @ columns, others @ wanted
            terms, rounding = np.abs(others) @ terms, np.abs(others) @ rounding
        thrusts: Indices | list[int] = actuation.groups.get("thrust", [])
        target = mobility * wanted
        scaled = mobility[:, None] * columns
        self.u, self.left = least_norm(scaled, target, thrusts)
        one_sided = np.isin(np.arange(len(self.u)), thrusts)
        self._pushing = scaled[:, ~one_sided | (self.u > 0.0)]
        self._by_tilt = mobility[:, None] * (M @ lin.A[-len(M) :, :3])
        self.residual, self.tolerance = self.left / mobility, rounding + terms
        self._allowed = TOLERANCE * float(np.linalg.norm(target))
        self._allowed += float(np.linalg.norm(mobility * rounding))
        self._to_rates = inverse / mobility
        if spun:
            self._to_rates[wheels] = 0.0

    @property
    def holds(self) -> bool:
        """Whether the inputs balance the forces.

        The residual forces must be rounding errors, or so small that their accelerations count as
        zero in `LinearModel.is_equilibrium`.
        """
        rates = np.abs(self._to_rates @ self.left).max(initial=0.0)
        small = float(np.linalg.norm(self.left)) <= self._allowed
        return small or bool(rates <= self.lin.bound(TOLERANCE))

    @property
    def asks_tilt(self) -> bool:
        """Whether a base at rest lacks a force against gravity."""
        lacking = float(np.linalg.norm(self.left[LINEAR])) > self._allowed
        return lacking and not self.lin.v[:6].any() and any(self.robot.gravity)

    def tilt_step(self) -> Array:
        """Return the smallest rotation (3,) [rad] of the base that removes the residual forces.

        The rotation is in base axes, and the residual forces are linearised in it. The inputs
        balance what they can, so only the part of a change that they cannot balance counts.
        """
        basis, sizes, _ = np.linalg.svd(self._pushing)
        rank = int((sizes > EPS * len(basis) * sizes.max(initial=0.0)).sum())
        beyond = basis[:, rank:].T
        # A (nv, 3) is the derivative of the accelerations with respect to q_b, half the rotation.
        effect = 0.5 * beyond @ self._by_tilt
        step: Array = np.linalg.lstsq(effect, -beyond @ self.left, rcond=_SMALL_EFFECT)[
            0
        ]
        return step


def _without_wheels(M: Array, wheels: Indices) -> Array:
    """Return the matrix (nv, nv) that maps forces to forces on the robot with free wheels.

    By the equation of motion, a free wheel takes the acceleration that its torque and the other
    accelerations give it. Its inertial force then acts on the other coordinates.
    """
    others = np.setdiff1d(np.arange(len(M)), wheels)
    result = np.zeros_like(M)
    result[others, others] = 1.0
    across = np.linalg.solve(M[np.ix_(wheels, wheels)], M[np.ix_(wheels, others)])
    result[np.ix_(others, wheels)] = -across.T
    return result


def _require_steady(lin: LinearModel, drift: Array) -> None:
    """Raise `EquilibriumError` if the motion of a joint or of the base changes the forces.

    `drift` (nx,) is the state derivative. Under gravity, it excludes rotation about the vertical.
    The error is raised in three cases:

    - A joint that is not a rotor moves.
    - In orbit, the base moves relative to the orbital frame.
    - Under gravity, the base rotates about an axis that is not vertical.
    """
    moving = [
        f"{name} at {rate:.3g} {unit}/s"
        for name, unit, rate in zip(
            lin.state_names, lin.state_units, drift.tolist(), strict=True
        )
        if rate and name.startswith("q_m.") and name not in lin.ignorable
    ]
    orbiting = lin.frame in ORBITAL
    turns, moves = np.abs(drift[:6]).reshape(2, 3).max(axis=1)
    if moving:
        reason = (
            f"joints move ({listed(moving)}), but only rotors may move, which are joints whose "
            "link is symmetric about the axis and carries nothing; set all other joint rates to "
            "0"
        )
    elif orbiting and max(turns, moves) > TOLERANCE:
        reason = "the base moves in the orbital frame; remove the velocity of the base"
    elif not orbiting and "q_b.x" not in lin.ignorable and turns > TOLERANCE:
        reason = (
            "under gravity, the base may rotate only about the vertical; change the angular "
            "velocity of the base"
        )
    else:
        return
    raise EquilibriumError(
        f"the motion of '{lin.robot}' is not steady under any input: {reason}"
    )


@dataclass(frozen=True, eq=False, repr=False)
class RelativeEquilibrium(FrozenArrays):
    """Relative equilibrium: an attitude at rest in the orbital frame, with fixed joints.

    Attributes
    ----------
    q : ndarray (nq,)
        Configuration in which the centre of mass is on the orbit. ``equilibrium(robot, q).u``
        returns the inputs that hold the joints at q.
    moments : ndarray (3,)
        Principal moments of inertia [kg m^2] about three axes through the centre of mass: the
        radial axis, the along-track axis and the orbit normal.
    poles : ndarray (6,)
        Poles [rad/s] of the attitude motion with fixed joints: two of pitch, then four of roll and
        yaw.
    stable : bool or None
        True if no pole has a positive real part, False if a pole has one, None if rounding error
        leaves the sign undecided.
    margin : float
        Smallest of the quantities that must be positive for stability, divided by its rounding
        error. The equilibrium is stable if `margin` is above 1, and unstable if `margin` is below
        -1.

    Examples
    --------
    >>> robot = fflin.load("servicer_7dof", orbit=fflin.CircularOrbit(altitude=700e3))
    >>> best = fflin.relative_equilibria(robot)[0]
    >>> bool(best.moments.argmin() == 0), best.poles.shape  # the longest axis to the body
    (True, (6,))
    """

    q: Array
    moments: Array
    poles: Complex
    stable: bool | None
    margin: float

    @property
    def stability(self) -> str:
        """The word "stable", "unstable" or "undecided"."""
        return {True: "stable", False: "unstable", None: "undecided"}[self.stable]

    def __repr__(self) -> str:
        moments = ", ".join(f"{moment:.5g}" for moment in self.moments)
        return f"RelativeEquilibrium({self.stability}, moments=({moments}) kg m^2)"

    def _repr_html_(self) -> str:
        return html.result_card(self)


class RelativeEquilibria(html.Reported, tuple[RelativeEquilibrium, ...]):
    """Tuple of the 24 relative equilibria, most stable first; ``print`` shows a table.

    Examples
    --------
    >>> robot = fflin.load("servicer_7dof", orbit=fflin.CircularOrbit(altitude=700e3))
    >>> found = fflin.relative_equilibria(robot)
    >>> sum(bool(each.stable) for each in found)
    4
    """

    __slots__ = ()

    def __str__(self) -> str:
        """Show a table with one row for each group of four equivalent attitudes."""
        rows = [["radial", "along", "normal [kg m^2]", "", "growth [1/s]"]]
        for one in self[::4]:
            sizes = [f"{moment:.5g}" for moment in one.moments]
            rate = 0.0
            if one.stable is False:
                rate = float(one.poles.real.max())
            growth = f"{rate:.4g}" if rate else "."
            rows.append([*sizes, one.stability, growth])
        title = "principal moments of inertia; each row stands for 4 attitudes"
        return f"{title}\n{grid(rows, 'rrrlr')}"


def relative_equilibria(
    robot: Robot, q: Array | None = None, *, frame: Frame | None = None
) -> RelativeEquilibria:
    r"""List the attitudes in which a robot with fixed joints stays at rest in its orbital frame.

    In each of the 24 attitudes, the principal axes of inertia are parallel to the axes of the
    orbital frame. Let n be the orbital rate, and :math:`I_r, I_a, I_n` the moments of inertia about
    the radial axis, the along-track axis and the orbit normal. The poles :math:`\lambda` are the
    roots of two equations, the first for pitch and the second for roll and yaw, see (14.8) of
    docs/derivation.md:

    .. math::
        \lambda^2 = -3 n^2 (I_a - I_r)/I_n, \qquad
        \lambda^4 + (1 + 3 k_a + k_a k_r)\,n^2 \lambda^2 + 4 k_a k_r\,n^4 = 0, \qquad
        k_a = (I_n - I_r)/I_a, \quad k_r = (I_n - I_a)/I_r.

    If all poles are imaginary and simple, the body librates about the equilibrium.

    Parameters
    ----------
    robot : Robot
        Robot in orbit.
    q : array_like (nq,), optional
        Configuration that provides the joint positions; neutral by default.
    frame : {"lvlh", "hill"}, optional
        Orbital frame in which `q` of each result is expressed; "lvlh" by default.

    Returns
    -------
    RelativeEquilibria
        Tuple of 24 `RelativeEquilibrium`, most stable first.

    Raises
    ------
    InputError
        If the robot is not in orbit, its wheels store momentum, or an argument is invalid.
    SingularInertiaError
        If the robot has no inertia about an axis.

    References
    ----------
    D. B. DeBra and R. H. Delp, Rigid body attitude stability and natural frequencies in a circular
    orbit, J. Astronautical Sciences 8, 1961. P. C. Hughes, Spacecraft Attitude Dynamics, 1986.

    Examples
    --------
    >>> robot = fflin.load("servicer_7dof", orbit=fflin.CircularOrbit(altitude=700e3))
    >>> found = fflin.relative_equilibria(robot)
    >>> len(found), found[0].stable
    (24, True)
    """
    instance("robot", robot, Robot, "a fflin.Robot")
    refuse_constraints(robot, "relative equilibria")
    if robot.orbit is None:
        raise InputError(
            f"'{robot.name}' is not in orbit; give it an orbit by "
            "robot.replace(orbit=fflin.CircularOrbit(altitude=...)) or --orbit"
        )
    refuse_elliptic(robot, "relative equilibria", _PERIODIC)
    if robot.stored_momentum:
        raise InputError(
            f"wheels of '{robot.name}' store momentum, whose gyroscopic torque is not considered "
            "here; set momentum=0, or use fflin.equilibrium at an attitude"
        )
    q = robot.neutral() if q is None else robot.checked_configuration(q).copy()
    q[:7] = pin.SE3ToXYZQUAT(pin.SE3.Identity())
    data = robot.create_data()
    root = robot.model.jointPlacements[ROOT]
    pin.ccrba(robot.model, data, q, np.zeros(robot.nv))
    center = root.actInv(data.com[0])
    sizes, axes = np.linalg.eigh(root.rotation.T @ data.Ig.inertia @ root.rotation)
    if sizes[0] <= _ROUNDING * sizes[2]:
        raise SingularInertiaError(
            f"'{robot.name}' has no inertia about one axis; give the link an inertia about every "
            "axis"
        )
    n = mean_motion(robot)
    equilibria = []
    field = OrbitField(robot, frame_of(robot, frame))
    rounding = _ROUNDING * (sizes[2] / sizes[0]) ** 2
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        principal_axes = axes[:, order] * signs
        if np.linalg.det(principal_axes) < 0.0:
            continue
        R = field.axes @ principal_axes.T
        at = q.copy()
        moments = sizes[list(order)]
        at[:7] = pin.SE3ToXYZQUAT(root.inverse() * pin.SE3(R, -R @ center))
        radial, along, normal = moments.tolist()
        pitch = 3.0 * (along - radial) / normal
        k_a, k_r = (normal - radial) / along, (normal - along) / radial
        b, c = 1.0 + 3.0 * k_a + k_a * k_r, 4.0 * k_a * k_r
        # Solve the equation (14.8) of roll and yaw, mu^2 + b mu + c = 0 with mu = lambda^2 / n^2.
        # To avoid cancellation, compute the root `larger` of larger magnitude first. The
        # other root is c / larger.
        apart = np.sqrt(complex(b * b - 4.0 * c))
        if b < 0.0:
            apart = -apart
        larger = -0.5 * (b + apart)
        smaller = c / larger if larger else 0.0
        squares = np.array([-pitch, larger, smaller], dtype=complex)
        roots = n * np.sqrt(squares)
        poles = np.column_stack((roots, -roots)).ravel()
        # No pole is unstable if all values of mu are real and negative. For pitch, mu = -`pitch`.
        # For roll and yaw, the sum of both values is -b, their product is c, and they are real if
        # b^2 - 4 c is positive.
        margin = float(min(pitch, c, b, b * b - 4.0 * c) / rounding)
        stable = None if abs(margin) <= 1.0 else margin > 0.0
        equilibria.append(RelativeEquilibrium(at, moments, poles, stable, margin))
    return RelativeEquilibria(
        sorted(equilibria, key=lambda one: (-one.margin, *one.moments))
    )
