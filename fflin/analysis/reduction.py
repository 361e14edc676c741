"""Reduced linear models: without conserved momenta, without wheels, or of chosen states."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import compress
from typing import ClassVar, TypeAlias, TypeVar

import numpy as np
import pinocchio as pin
from scipy.linalg import block_diag

from fflin.analysis import mechanics, moving_points
from fflin.analysis.ranks import (
    EPS,
    FixedPoles,
    Margin,
    Noisy,
    divisors,
    echelon,
    image,
    null_space,
)
from fflin.base.errors import InputError, StabilizabilityError, listed
from fflin.base.names import input_keys
from fflin.base.tables import counted, folded
from fflin.base.validation import Array, Indices, Mask, frozen
from fflin.dynamics.coordinates import ANGULAR, LINEAR, refuse_constraints
from fflin.dynamics.state import StateMap, selection
from fflin.linear.files import given
from fflin.linear.model import Delay, LinearModel, refuse_frozen
from fflin.robot.joints import frame_index
from fflin.robot.robot import Robot
from fflin.robot.rotors import motor_of

Make: TypeAlias = Callable[[LinearModel], LinearModel]
Part = TypeVar("Part", bound=LinearModel)

# Entries of A below this are rounding errors. So are singular values below this of a matrix that
# consists of rows of an orthonormal basis.
_ROUNDING = 1e-9

# An entry of M B_u that exceeds this fraction of its terms and of its column is not a rounding
# error.
_CLEAR = 1e-3

# `momentum_reduction` requires that the part of f0 which the reduced states cannot represent is at
# most this fraction of the largest entry of f0.
_DRIFT = 1e-9


@dataclass(frozen=True, eq=False, repr=False, init=False, kw_only=True)
class ReducedModel(LinearModel):
    """Linear model reduced to the coordinates on which inputs, springs and dampers act.

    Let x be the full state, z the reduced state, and x0 and z0 their values at the operating point.
    Then ``z = S x`` for all motions, and ``x - x0 = T (z - z0)`` for motions whose conserved
    momenta are zero. `save` writes the reduced model, but not the maps T and S.

    Attributes
    ----------
    T : ndarray (nx, nz)
        Map from the reduced state to the full state.
    S : ndarray (nz, nx)
        Map from the full state to the reduced state: selects the states of x that z also contains.
    momenta : ndarray (k, nx)
        Matrix L1 of the conserved momenta ``L1 (x - x0)``, which are zero in the reduced model.
    coordinates : ndarray (k, nx)
        Matrix L2 of the coordinates ``L2 (x - x0)`` whose rates are the conserved momenta. These
        coordinates are also zero in the reduced model.
    margin : Margin
        Certainty of the rank decision on the conserved momenta, as in `Controllability`.
    notes : tuple of str
        Ranks that rounding error leaves undecided.

    Examples
    --------
    >>> motors = [fflin.JointTorque(f"joint_{i}") for i in (1, 2, 3)]
    >>> arm = fflin.load("planar_detumble", inputs=motors)
    >>> reduced = fflin.momentum_reduction(fflin.linearize(arm))
    >>> reduced.T.shape, reduced.momenta.shape
    ((18, 6), (6, 18))
    >>> bool(abs(reduced.S @ reduced.T - np.eye(6)).max() < 1e-12)
    True
    """

    T: Array
    S: Array
    momenta: Array
    coordinates: Array
    margin: Margin
    notes: tuple[str, ...]
    # `margin` is the certainty of rank decisions, not the disk margin that titles show.
    _untitled: ClassVar[frozenset[str]] = frozenset({"margin"})

    def discretize(self, dt: float, delay: Delay = 0.0) -> LinearModel:
        """Return the discrete-time model, see `LinearModel.discretize`.

        Of a model with delayed inputs, `T` and `S` also map the commands on their way.
        """
        return self._extended(super().discretize(dt, delay))

    def with_lags(
        self, lag: Delay | None = None, output_lag: Delay | None = None
    ) -> LinearModel:
        """Return the model with the lags of its signals, see `LinearModel.with_lags`."""
        return self._extended(super().with_lags(lag, output_lag))

    def _extended(self, model: LinearModel) -> LinearModel:
        """Return a model made from this one, whose maps also contain the states that it added."""
        count = len(model.added) - len(self.added)
        if not count:
            return model
        assert isinstance(model, ReducedModel)
        none = np.zeros((len(self.momenta), count))
        return replace(
            model,
            T=block_diag(self.T, np.eye(count)),
            S=block_diag(self.S, np.eye(count)),
            momenta=np.hstack((self.momenta, none)),
            coordinates=np.hstack((self.coordinates, none)),
        )

    def _report(self) -> str:
        """Return the title, the numbers of states and conserved momenta, and the notes."""
        count = len(self.momenta)
        noun = "momentum" if count == 1 else "momenta"
        states = f"{len(self.S)} of {counted(len(self.T), 'state')} are kept: "
        notes = (f"note: {note}" for note in self.notes)
        return folded(
            [
                repr(self),
                states + listed(self.state_names),
                f"{count} conserved {noun} and the coordinates with these rates are removed",
                *notes,
            ]
        )


def momentum_reduction(
    lin: LinearModel, *, wheel_speeds: bool | None = None
) -> ReducedModel:
    r"""Remove the conserved momenta from a model, exactly.

    A momentum :math:`W M \nu` is conserved if no input, spring or damper changes it. If its initial
    value is zero, it stays zero. The reduction therefore removes each conserved momentum and the
    coordinate whose rate is this momentum. If the base is unactuated, all six momenta are removed.
    With :math:`G = -M_{bb}^{-1} M_{bm}`, the reduced model is then

    .. math::
        \nu_b = G \dot q_m, \quad M^* \ddot q_m = \tau_m - K q_m - D \dot q_m, \quad
        M^* = M_{mm} - M_{mb} M_{bb}^{-1} M_{bm}.

    See equations (9.2) and (9.3) of docs/derivation.md.

    If inputs act on the base attitude, the reduced model keeps the attitude. If inputs act on the
    base position, the reduced model keeps the position. Without springs, the reduced model is
    minimal. With springs, the reduced model may still contain vibrations that no input drives. The
    reduced model and the full model have the same transfer function from inputs to joint states.

    Reaction wheels, which ``lin.wheels`` lists, are also removed, even if they store momentum
    (9.4), but the attitude that they control is kept. The speeds and angles of three kinds of
    wheels are kept:

    - wheels whose speeds are to be controlled (9.5);
    - wheels on a carrier that rotates at the operating point;
    - wheels with friction.

    Parameters
    ----------
    lin : LinearModel
        Model about an operating point at rest, continuous or sampled.
    wheel_speeds : bool, optional
        Whether to keep wheels whose speeds the inputs can control. By default, such wheels are kept
        if inputs other than the wheels can rotate the base.

    Returns
    -------
    ReducedModel
        `LinearModel` with the maps ``T`` and ``S``. The model has 2 r states, where r is nv minus
        the number of conserved momenta. ``M`` is the inertia of the kept coordinates, with the
        removed coordinates free to move. The outputs are the outputs of `lin`. An output that
        measures a removed wheel is zero, because ``T`` sets the states of removed wheels to zero.

    Raises
    ------
    InputError
        If one of these conditions is true:

        - a momentum is conserved, but the robot moves at the operating point, so that the momentum
          is not the rate of a coordinate;
        - the state derivative f0 at the operating point is nonzero in a direction that the
          reduction removes;
        - `lin` is not a linear model.
    ModelError
        If the robot's Pinocchio model (``robot.model``) was modified after the robot was created.

    References
    ----------
    Y. Umetani and K. Yoshida, IEEE Trans. Robotics and Automation 5(3), 1989.

    Examples
    --------
    >>> motors = [fflin.JointTorque(f"joint_{i}") for i in (1, 2, 3)]
    >>> arm = fflin.load("planar_detumble", inputs=motors)
    >>> reduced = fflin.momentum_reduction(fflin.linearize(arm))
    >>> reduced.state_names[:2], len(fflin.lqr(reduced, 1.0, 1.0).poles)
    (('q_m.joint_1', 'q_m.joint_2'), 6)
    """
    whole = mechanics.checked(lin)
    refuse_frozen(whole, "momentum_reduction")
    wheels = removed_wheels(whole, wheel_speeds)
    lin = without(whole, wheels) if len(wheels) else whole
    momenta = mechanics.conserved(lin)
    _require_coordinates(lin, momenta)
    z, T = momenta.selected, momenta.T
    judged = [name not in lin.ignorable for name in lin.state_names]
    drift = float(np.abs(lin.f0 - T @ lin.f0[z])[judged].max(initial=0.0))
    if drift > _DRIFT * float(np.abs(lin.f0).max()):
        raise InputError(
            f"the operating point is not an equilibrium: |f0| is {np.abs(lin.f0).max():.3g} and "
            "drives states that the reduction removes; linearise at rest"
        )
    in_whole = selection(lin.state_names, whole.state_names)
    reduced = ReducedModel(
        **part_of(lin, np.eye(len(T))[z], T, momenta.rates.T @ lin.M @ momenta.rates),
        T=in_whole.T @ T,
        S=in_whole[z],
        momenta=momenta.momenta @ in_whole,
        coordinates=momenta.coordinates @ in_whole,
        margin=momenta.margin,
        notes=mechanics.undecided(
            lin, FixedPoles(margin=momenta.margin), "kept by the reduction", len(z)
        ),
    )
    return certified(
        reduced, whole, partial(momentum_reduction, wheel_speeds=wheel_speeds)
    )


def _require_coordinates(lin: LinearModel, momenta: mechanics.ConservedMomenta) -> None:
    """Raise `InputError` if a momentum is conserved but is not the rate of a coordinate.

    This is so if the base rotates or the joints move. The angular momentum then depends on the
    attitude, so it cannot be removed together with a coordinate.
    """
    if not lin.v.any() or len(momenta.weights) >= 6:
        return
    names = tuple(
        name for name in moving_points.conserved(lin).names if "momentum" in name
    )
    if len(names) > len(momenta.weights):
        raise InputError(
            f"no input can change {listed(mechanics.grouped(names))}, but the robot moves at the "
            "operating point, where momenta are not the rates of coordinates and cannot be removed "
            "with them; linearise at rest (v = 0), or analyse the motion with "
            "fflin.controllability"
        )


def generalized_inertia(lin: LinearModel) -> Array:
    r"""Return the generalized inertia matrix: the inertia of the joints with the base free.

    .. math:: M^* = M_{mm} - M_{mb} M_{bb}^{-1} M_{bm}

    Umetani and Yoshida defined this matrix, see (9.3) of docs/derivation.md and the reference in
    `momentum_reduction`.

    Parameters
    ----------
    lin : LinearModel
        Full model of the robot, at any velocity.

    Returns
    -------
    ndarray (n, n)
        Generalized inertia M*; its inverse is the joint block of M^-1.

    Raises
    ------
    InputError
        If the model lacks the states of the base.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> fflin.generalized_inertia(lin).shape
    (3, 3)
    """
    lin = mechanics.checked(lin)
    joints = sum(name.startswith("q_m.") for name in lin.state_names)
    if len(lin.A) != 12 + 2 * joints:
        raise InputError(
            "the model lacks the states of the base; give the unreduced model"
        )
    inertia = mechanics.floating_inertia(lin.M, np.arange(6, 6 + joints), np.arange(6))
    return (inertia + inertia.T) / 2.0


def generalized_jacobian(
    robot: Robot, q: Array | None = None, frame: str = ""
) -> Array:
    r"""Return the generalized Jacobian from joint rates to a frame's velocity.

    This Jacobian is valid if the base is free and the momentum of the robot is zero.

    .. math:: J^* = J_m + J_b G, \qquad G = -M_{bb}^{-1} M_{bm}

    Umetani and Yoshida defined this matrix, see (9.3) of docs/derivation.md and the reference in
    `momentum_reduction`.

    Parameters
    ----------
    robot : Robot
    q : array_like (nq,), optional
        Configuration; neutral by default.
    frame : str
        Name of a frame of the model.

    Returns
    -------
    ndarray (6, n)
        Jacobian from the joint rates to the angular velocity of the frame [rad/s] (rows 0 to 2) and
        the velocity of its origin [m/s] (rows 3 to 5), both in Pinocchio's world axes.

    Raises
    ------
    UnknownNameError
        If the frame is unknown.
    InputError
        If `q` is not a configuration of the robot.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> fflin.generalized_jacobian(robot, frame="hand").shape
    (6, 3)
    """
    state = StateMap(robot)
    refuse_constraints(robot, "generalized Jacobians")
    q = robot.neutral() if q is None else robot.checked_configuration(q)
    model = robot.model
    data = robot.create_data()
    index = frame_index(model, frame)
    axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    full = pin.computeFrameJacobian(model, data, q, index, axes)
    J = state.columns(np.vstack((full[LINEAR], full[ANGULAR])))
    M = state.project(pin.crba(model, data, q).T)
    return J[:, 6:] - J[:, :6] @ np.linalg.solve(M[:6, :6], M[:6, 6:])


def wheel_inputs(lin: LinearModel) -> tuple[str, ...]:
    """Return the names of the inputs of type `ReactionWheel`, with or without an inertia."""
    keys = (key.partition(".") for key in input_keys(lin))
    return tuple(name for group, _, name in keys if group == "wheel")


def ignorable_wheels(lin: LinearModel) -> tuple[Indices, Indices]:
    """Return two index arrays of wheels whose angles do not affect the other states.

    The first array contains all such wheels. The second array contains the wheels whose speeds
    do not affect the other states either.
    """
    nv = len(lin.M)
    angle_names = {f"q_m.{name}" for name in lin.wheels}
    wheels = np.flatnonzero([name in angle_names for name in lin.state_names[:nv]])
    if not len(wheels):
        return wheels, wheels
    # In the second-order form, an angle has no effect if its column of K is zero. A speed has no
    # effect if its column of D is zero. A wheel speed has an effect if the link that carries the
    # wheel rotates at the operating point, or if the wheel has friction.
    system = mechanics.second_order(lin.generator or lin)
    angle_is_ignorable = ~system.K.values[:, wheels].any(axis=0)
    speed_is_ignorable = ~system.D.values[:, wheels].any(axis=0)
    return wheels[angle_is_ignorable], wheels[angle_is_ignorable & speed_is_ignorable]


def _wheels_carried_along_orbit(lin: LinearModel) -> Indices:
    """Return the wheels whose speeds affect other states only because the base turns with an orbit.

    The result is empty if the robot moves relative to the axes of the orbit, apart from its wheels.
    """
    # The torque of such a wheel on its body is the product of the orbital rate and the wheel's
    # momentum. It is a slow disturbance of the attitude: a law that does not control the momentum
    # compensates it. The momentum then keeps its magnitude and turns relative to the body, once in
    # each revolution of the orbit.
    angles, free = ignorable_wheels(lin)
    coupled = np.setdiff1d(angles, free)
    nv = len(lin.M)
    names = lin.state_names[nv : 2 * nv]
    still = [name.removeprefix("qdot_m.") not in lin.wheels for name in names]
    if not lin.mean_motion or lin.x0[nv : 2 * nv][still].any():
        return coupled[:0]
    # Friction acts on the wheel itself.
    damping = mechanics.second_order(lin).D.values
    return coupled[[not damping[wheel, wheel] for wheel in coupled]]


def removed_wheels(
    lin: LinearModel, wheel_speeds: bool | None, *, carried: bool = False
) -> Indices:
    """Return the indices (k,) of the wheels that a design does not regulate (9.5).

    If `carried` is true, they include wheels that only the orbital rate couples to other states.
    """
    # The angles and speeds of the wheels in `free` do not affect the other states, so these wheels
    # can be removed. Without `wheel_speeds`, all of them are removed. With `wheel_speeds`, a design
    # regulates as many of them as the inputs can spin independently without a net force on the
    # rigid motions of the other bodies. By default, `wheel_speeds` is true if an input, such as a
    # thruster, exerts a torque on the whole robot, because it can then unload the wheels.
    if wheel_speeds is not None and not isinstance(wheel_speeds, bool | np.bool_):
        raise InputError(
            f"wheel_speeds is {wheel_speeds!r}, expected True, False or None"
        )
    source = lin.generator or lin
    _, free = ignorable_wheels(lin)
    slow = _wheels_carried_along_orbit(source) if carried else free[:0]
    if not len(free) + len(slow):
        return free
    if wheel_speeds is None:
        names = lin.state_names[: len(lin.M)]
        attitude = [name.startswith("q_b.") for name in names]
        torques_on_robot = mechanics.second_order(source).S.values[attitude]
        wheel_speeds = bool(torques_on_robot.any())
    if not wheel_speeds:
        return np.union1d(free, slow).astype(np.intp)
    if not len(free):
        return free
    # Combinations of inputs (nu, k) without a force on the rigid motions of the other bodies.
    forces = rigid_forces(without(source, free))
    sizes = divisors(np.linalg.norm(forces.values, axis=0))
    combinations, _ = null_space(forces @ np.diag(1.0 / sizes))
    # Motor torque on each wheel in `free` for each combination; zero for a wheel without a motor.
    torques = np.zeros((len(free), combinations.shape[1]))
    for row, index in enumerate(free):
        wheel = lin.state_names[index].removeprefix("q_m.")
        motor = motor_of(lin.input_names, wheel)
        if motor is not None:
            torques[row] = combinations[motor]
    # The combinations can spin as many wheels independently as the torques have pivots.
    independent, _ = image(torques, _ROUNDING)
    _, pivots = echelon(independent, np.ones(len(free)))
    return np.delete(free, pivots)


def regulated_part(lin: LinearModel, wheel_speeds: bool | None = None) -> LinearModel:
    """Return the model of the regulated states, or `lin` itself if all states are regulated."""
    # The model omits the `removed_wheels`. For every other wheel, it omits the angle if the angle
    # affects no other state, so the model may have fewer positions than rates. It also omits the
    # coordinates of the base position on which no input acts, and their rates.
    if lin.added:
        part = regulated_part(lin.undelayed, wheel_speeds)
        if part is lin.undelayed:
            return lin
        names = (*part.state_names, *_added_without(lin, part.state_names))
        return selected(
            lin,
            names,
            part.M,
            partial(regulated_part, wheel_speeds=wheel_speeds),
        )
    base = unpushed_positions(lin)
    if not (len(base) or wheel_inputs(lin) or lin.wheels):
        return lin
    removed = np.union1d(base, removed_wheels(lin, wheel_speeds, carried=True))
    part = without(lin, removed.astype(np.intp))
    angles = {lin.state_names[i] for i in ignorable_wheels(lin)[0]}
    rest = [name for name in part.state_names if name not in angles]
    if len(rest) == len(part.M):
        raise StabilizabilityError(
            "wheel speeds would be the only states of the reduced model; remove the damping of "
            "the wheels"
        )
    return selected(
        lin, rest, part.M, partial(regulated_part, wheel_speeds=wheel_speeds)
    )


def _added_without(lin: LinearModel, kept: Sequence[str]) -> list[str]:
    """Return the added states of a model that depend on no other states of the robot than `kept`.

    The value of a sensor with a lag depends on the states that it measures.
    """
    source = lin.generator or lin  # the matrix exponential loses exact zeros
    removed = [i for i, name in enumerate(source.robot_states) if name not in kept]
    first = len(source.robot_states)
    depends: Mask = np.any(source.A[first:, removed], axis=1)
    left_out = {*compress(source.added, depends)}
    return [name for name in lin.added if name not in left_out]


def unpushed_positions(lin: LinearModel) -> Indices:
    """Return the indices (k,) of the base positions that no input pushes, directly or by tilting.

    The result is empty if these positions or their rates affect any other state.
    """
    nv = len(lin.M)
    positions = [i for i in range(nv) if lin.state_names[i].startswith("r_b.")]
    if not positions:
        return np.zeros(0, dtype=np.intp)
    source = lin.generator or lin
    if _clearly_pushed(source, positions):
        return np.zeros(0, dtype=np.intp)
    forces = mechanics.second_order(source).S.values
    driven = np.count_nonzero(forces, axis=1)
    base = np.array([i for i in positions if not driven[i]], dtype=np.intp)
    # If the inputs hold the base against gravity, they push it in all directions, because a tilt of
    # the base turns their force.
    force = forces[positions] @ source.u0
    size = np.abs(forces[positions]) @ np.abs(source.u0)
    if np.count_nonzero(np.abs(force) > _ROUNDING * size):
        return base[:0]
    columns = np.concatenate((base, base + nv))
    on_others = np.delete(source.A[:, columns], columns, axis=0)
    if np.abs(on_others).max(initial=0.0) > _ROUNDING:
        return base[:0]  # in rotating axes, each direction affects the others
    return base


def _clearly_pushed(lin: LinearModel, positions: list[int]) -> bool:
    """Return whether inputs push all these positions, with forces far above rounding errors.

    If this quick test succeeds, as for most models, the exact test is not needed. The exact test
    computes the second-order form.
    """
    B_rates = lin.B[len(lin.M) :]
    forces = lin.M @ B_rates  # generalised force (nv, nu) of a unit of each input
    # A force may be a rounding error if it is small compared with the forces of the same input on
    # all coordinates, in units of equal size.
    size = np.sqrt(lin.M.diagonal())
    of_input = np.linalg.norm(forces / size[:, None], axis=0)
    scale_of_input = np.outer(size[positions], of_input)
    # It may also be a rounding error if it is a sum of terms that almost cancel.
    scale_of_terms = np.abs(lin.M[positions]) @ np.abs(B_rates)
    scale = np.maximum(scale_of_input, scale_of_terms)
    is_clear = np.abs(forces[positions]) > _CLEAR * scale
    return bool(is_clear.any(axis=1).all())


def rigid_forces(body: LinearModel) -> Noisy:
    """Return the input matrix (r, nu) of the r rigid motions, in which no spring is deflected."""
    system = mechanics.second_order(body)
    motions, _ = null_space(system.K.T, 1.0 / system.size)
    forces = system.S.after(motions.T)
    # Rounding leaves a small part of every coordinate in each motion.
    rounding = (
        len(motions)
        * EPS
        * (np.abs(system.S.values) / system.size[:, None]).sum(axis=0)
    )
    return forces._replace(noise=forces.noise + rounding)


def without(lin: LinearModel, removed: Indices) -> LinearModel:
    """Remove coordinates with the indices `removed` (k,), and their rates, from a model (9.4).

    If the removed states do not affect the other states, the result is exact.
    """
    nv = len(lin.M)
    kept = np.setdiff1d(np.arange(nv), removed)
    rates = nv + kept
    names = [lin.state_names[i] for i in (*kept, *rates)]
    rest = mechanics.floating_inertia(lin.M, kept, removed)
    # Set stiffness and damping to zero if they are only rounding errors of a spin.
    system = mechanics.second_order(lin)
    A = lin.A.copy()
    if not lin.dt and not system.K.values.any():
        A[nv:, :nv] = 0.0
    if not lin.dt and not system.D.values.any():
        A[nv:, nv:] = 0.0
    return selected(replace(lin, A=A), names, rest, partial(without, removed=removed))


def selected(
    lin: LinearModel, names: Sequence[str], M: Array, make: Make
) -> LinearModel:
    """Return the model with the named states, inertia M, and only the outputs of these states."""
    S = selection(names, lin.state_names)
    # Each row of P selects an output that depends only on the named states.
    P = outputs_of(lin, S)
    outputs = P.argmax(axis=1)
    values = part_of(lin, S, S.T, M)
    values["C"] = P @ lin.C @ S.T
    values["D"] = P @ lin.D
    values["y0"] = P @ lin.y0
    values["output_names"] = tuple(lin.output_names[i] for i in outputs)
    values["output_units"] = tuple(lin.output_units[i] for i in outputs)
    values["added"] = tuple(name for name in lin.added if name in names)
    if lin.output_lag.any():
        values["_output_lags"] = tuple(lin.output_lag[outputs].tolist())
    return certified(LinearModel(**values), lin, make)


def outputs_of(lin: LinearModel, S: Array) -> Array:
    """Return the selection matrix (k, ny) of the outputs that depend only on the states S x."""
    others = np.abs(lin.C - lin.C @ S.T @ S).max(axis=1, initial=0.0)
    kept: Mask = others <= 1e-12 * np.abs(lin.C).max(axis=1, initial=0.0)
    return np.eye(len(lin.C))[kept]


def part_of(lin: LinearModel, S: Array, T: Array, M: Array) -> dict[str, object]:
    """Return the fields of the model with states z = S x and inertia M, where x = T z."""
    names = tuple(lin.state_names[i] for i in S.argmax(axis=1))
    whole = {item.name: getattr(lin, item.name) for item in fields(LinearModel)}
    return whole | {
        "A": S @ lin.A @ T,
        "B": S @ lin.B,
        "C": lin.C @ T,
        "f0": S @ lin.f0,
        "x0": S @ lin.x0,
        "state_names": names,
        "state_units": tuple(lin.state_units[i] for i in S.argmax(axis=1)),
        "_ignorable": partial(
            given, tuple(name for name in names if name in lin.ignorable)
        ),
        "_wheels": partial(given, lin.wheels),
        "drift": None if lin.drift is None else S @ lin.drift,
        "_inertia": partial(given, frozen(M)),
    }


def certified(part: Part, lin: LinearModel, make: Make) -> Part:
    """Record the model from which the reduced model `part` inherits its certificate.

    By default, the recorded model is the unreduced model `lin`. If `lin` was sampled from a known
    continuous model, the recorded model is the reduced model that `make` forms from the continuous
    model.
    """
    source = lin.generator
    whole = lin
    if lin.dt and source is not None:
        whole = make(source)
    return replace(part, _source=(part.fingerprint, whole))
