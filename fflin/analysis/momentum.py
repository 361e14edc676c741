"""Momentum reduction of a linear model, and generalized inertia and Jacobian of an arm."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import pinocchio as pin

from fflin.analysis.mechanics import checked, conserved, floating_inertia
from fflin.analysis.names import undecided
from fflin.analysis.ranks import Margin
from fflin.analysis.wheels import certified, leaving, part_of, picked, without
from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.names import ANGULAR, LINEAR
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel
from fflin.robot.frames import frame_index
from fflin.robot.robot import Robot

# Largest part of f0, relative to it, that the reduced state may leave out.
_DRIFT = 1e-9


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ReducedModel(LinearModel):
    """Linear model reduced to the coordinates on which inputs, springs and dampers act.

    Let z be the reduced state and x the full state; then ``z = S x`` for all motions. For motions
    with zero conserved momenta, ``x - x0 = T (z - z0)``. A saved file contains the model, but not
    the maps T and S.

    Attributes
    ----------
    T : ndarray (nx, nz)
        Map from the reduced state to the full state.
    S : ndarray (nz, nx)
        Map from the full state to the reduced state; it selects the states that have the same
        names.
    momenta : ndarray (k, nx)
        Rows L1 of the conserved momenta, which are zero in the reduced model.
    coordinates : ndarray (k, nx)
        Rows L2 of the coordinates whose rates are the momenta; they are zero in the reduced model.
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


def momentum_reduction(lin: LinearModel, *, wheel_speeds: bool | None = None) -> ReducedModel:
    r"""Remove the conserved momenta from a model, exactly.

    A momentum :math:`W M \nu` that no input, spring or damper changes stays zero if it starts at
    zero. The reduction removes it, and the coordinate that it drives. For an unactuated base these
    are all six momenta, and with :math:`G = -M_{bb}^{-1} M_{bm}`

    .. math::
        \nu_b = G \dot q_m, \quad M^* \ddot q_m = \tau_m - K q_m - D \dot q_m, \quad
        M^* = M_{mm} - M_{mb} M_{bb}^{-1} M_{bm}.

    These are equations (9.2) and (9.3) of docs/derivation.md.

    If inputs act on the attitude or on the position of the base, the states of this coordinate are
    kept. Without springs the result is minimal; with springs it may contain vibrations that no
    input drives. Its transfer function from inputs to joint states equals the full model's.

    Reaction wheels are removed as well, whatever their momentum (9.4), while the attitude that they
    control is kept. Three kinds of wheels are kept with their angles:

    - wheels whose speeds are to be controlled (9.5);
    - wheels on a carrier that rotates at the operating point;
    - wheels with friction.

    Parameters
    ----------
    lin : LinearModel
        Model about rest, continuous or sampled.
    wheel_speeds : bool, optional
        Whether to keep wheels whose speeds the inputs can control. By default they are kept if
        inputs other than the wheels can rotate the base.

    Returns
    -------
    ReducedModel
        `LinearModel` with the maps ``T`` and ``S``. It has 2 r states, where r is nv minus the
        number of conserved momenta; all states are kept if no momentum is conserved. Its ``M`` is
        the inertia of the kept coordinates while the others are free to follow. Its outputs are the
        outputs of `lin`, except outputs of removed wheels, for which ``T`` has zeros.

    Raises
    ------
    InputError
        If the operating point drifts in a removed direction, or `lin` is not a linear model.
    ModelError
        If the robot's model was changed after the linear model was made.

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
    whole = checked(lin)
    wheels = leaving(whole, wheel_speeds)
    lin = without(whole, wheels) if len(wheels) else whole
    held = conserved(lin)
    z, T = held.selected, held.T
    judged = [name not in lin.ignorable for name in lin.state_names]
    drift = float(np.abs(lin.f0 - T @ lin.f0[z])[judged].max(initial=0.0))
    if drift > _DRIFT * float(np.abs(lin.f0).max()):
        raise InputError(
            f"the operating point is not an equilibrium: |f0| is {np.abs(lin.f0).max():.3g} and "
            "drives states that the reduction removes; linearise at rest"
        )
    stays = picked(lin.state_names, whole.state_names)
    reduced = ReducedModel(
        **part_of(lin, np.eye(len(T))[z], T, held.rates.T @ lin.M @ held.rates),
        T=stays.T @ T,
        S=stays[z],
        momenta=held.momenta @ stays,
        coordinates=held.coordinates @ stays,
        margin=held.margin,
        notes=undecided(lin, held.margin, "kept by the reduction", len(z)),
    )
    return certified(reduced, whole, partial(momentum_reduction, wheel_speeds=wheel_speeds))


def generalized_inertia(lin: LinearModel) -> Array:
    r"""Return the generalized inertia: the joints' inertia while the base is free (9.3).

    .. math:: M^* = M_{mm} - M_{mb} M_{bb}^{-1} M_{bm}

    The definition is by Umetani and Yoshida, see `momentum_reduction`.

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
    lin = checked(lin)
    joints = sum(name.startswith("q_m.") for name in lin.state_names)
    if len(lin.A) != 12 + 2 * joints:
        raise InputError("the model lacks the states of the base; give the unreduced model")
    inertia = floating_inertia(lin.M, range(6, 6 + joints), range(6))
    return (inertia + inertia.T) / 2.0


def generalized_jacobian(robot: Robot, q: Array | None = None, frame: str = "") -> Array:
    r"""Return the generalized Jacobian from joint rates to a frame's velocity (9.3).

    The base is free, and the momentum of the robot is zero.

    .. math:: J^* = J_m + J_b G, \qquad G = -M_{bb}^{-1} M_{bm}

    The definition is by Umetani and Yoshida, see `momentum_reduction`.

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
        Jacobian from joint rates to angular velocity [rad/s], then velocity of the frame's origin
        [m/s], both in Pinocchio's world axes.

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
    q = robot.neutral() if q is None else robot.checked_configuration(q)
    model, data = robot.model, robot.create_data()
    index, axes = frame_index(model, frame), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    full = pin.computeFrameJacobian(model, data, q, index, axes)
    J = state.columns(np.vstack((full[LINEAR], full[ANGULAR])))
    M = state.project(pin.crba(model, data, q).T)
    return J[:, 6:] - J[:, :6] @ np.linalg.solve(M[:6, :6], M[:6, 6:])
