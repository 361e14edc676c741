"""The model without the momenta that it conserves, and what the free base makes of the arm."""

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
    """A linear model in the coordinates that its inputs, springs and dampers act on.

    With z the reduced state and x that of the whole, ``x - x0 = T (z - z0)`` on the motions with
    zero conserved momenta, and always ``z = S x``. Files hold the model without these maps.

    Attributes
    ----------
    T : ndarray (nx, nz)
        From the reduced state to the whole.
    S : ndarray (nz, nx)
        From the whole state to the reduced: it picks the states of the same names.
    momenta : ndarray (k, nx)
        Rows L1: what is conserved, and zero in the reduced model.
    coordinates : ndarray (k, nx)
        Rows L2: what drifts at the rate of L1, and is held at zero in the reduced model.
    margin : Margin
        Distance from doubt of the decision on what is conserved: far above 1, far below 1.
    notes : tuple of str
        What is undecided.

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
    r"""Reduce a model to the part without its conserved momenta, exactly.

    A momentum :math:`W M \nu` that no input, spring or damper changes is zero for all time
    where it starts at zero; with the coordinate that it drives it is left out. For an
    unactuated base these are its six, and with :math:`G = -M_{bb}^{-1} M_{bm}`

    .. math::
        \nu_b = G \dot q_m, \quad M^* \ddot q_m = \tau_m - K q_m - D \dot q_m, \quad
        M^* = M_{mm} - M_{mb} M_{bb}^{-1} M_{bm}.

    Equations (9.2) and (9.3) of docs/derivation.md.

    Where attitude or position is actuated as well, its states are kept and the others left out.
    Without springs the result is minimal; a vibration that no input drives stays in it. From
    inputs to joint states it has the transfer function of the whole model.

    Reaction wheels leave too, whatever their momentum (9.4), and the attitude that they turn
    stays. Wheels whose speeds are to be held, (9.5), stay with their angles, as do those whose
    speeds matter: of a carrier that turns at the point, or with friction.

    Parameters
    ----------
    lin : LinearModel
        About rest, continuous or sampled.
    wheel_speeds : bool, optional
        Whether wheels stay whose speeds the inputs can hold; by default where inputs other than
        wheels turn the base.

    Returns
    -------
    ReducedModel
        A `LinearModel` of 2 r states, r being nv less the number of conserved momenta, with
        the maps ``T`` and ``S``. Its ``M`` is that of the kept coordinates with the others
        free to follow, and its outputs are those of `lin` but what sees wheels that have left,
        of which ``T`` has zeros. All states are kept where nothing is conserved.

    Raises
    ------
    InputError
        If the point drifts in a direction that is left out, or `lin` is no linear model.
    ModelError
        If the robot's model was changed after it was made.

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
            f"the point is no fixed point: |f0| is {np.abs(lin.f0).max():.3g} and changes what "
            "the reduction leaves out; linearise at rest"
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
    r"""Return the generalized inertia: that of the joints with the base free to follow (9.3).

    .. math:: M^* = M_{mm} - M_{mb} M_{bb}^{-1} M_{bm}

    After Umetani and Yoshida, see `momentum_reduction`.

    Parameters
    ----------
    lin : LinearModel
        Of the whole robot, at any velocity.

    Returns
    -------
    ndarray (n, n)
        ``(M^-1)_mm = M*^-1``.

    Raises
    ------
    InputError
        If the base is not among the states.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> fflin.generalized_inertia(lin).shape
    (3, 3)
    """
    lin = checked(lin)
    joints = sum(name.startswith("q_m.") for name in lin.state_names)
    if len(lin.A) != 12 + 2 * joints:
        raise InputError("the base is not among the states; take the model before its reduction")
    inertia = floating_inertia(lin.M, range(6, 6 + joints), range(6))
    return (inertia + inertia.T) / 2.0


def generalized_jacobian(robot: Robot, q: Array | None = None, frame: str = "") -> Array:
    r"""Return the generalized Jacobian: a frame's velocity per joint rate at zero momentum (9.3).

    .. math:: J^* = J_m + J_b G, \qquad G = -M_{bb}^{-1} M_{bm}

    After Umetani and Yoshida, see `momentum_reduction`.

    Parameters
    ----------
    robot : Robot
    q : array_like (nq,), optional
        Configuration; neutral by default.
    frame : str
        A frame of the model.

    Returns
    -------
    ndarray (6, n)
        Angular velocity [rad/s], then velocity of the frame's origin [m/s], both in Pinocchio's
        world axes, over the joint rates.

    Raises
    ------
    UnknownNameError
        If there is no such frame.
    InputError
        If `q` is no configuration of the robot.

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
