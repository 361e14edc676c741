"""Kalman filters about a point."""

from __future__ import annotations

import numpy as np

from fflin.analysis.controllability import require_detectable, require_disturbed
from fflin.analysis.reduction import (
    outputs_of,
    regulated_part,
    unpushed_positions,
    wheel_inputs,
)
from fflin.base.errors import DetectabilityError
from fflin.base.names import input_keys
from fflin.base.validation import Array, ArrayLike, dimension, shaped
from fflin.control.estimator import Estimator
from fflin.control.lqr import at_fixed_point
from fflin.control.optimal.riccati import solve
from fflin.control.weights import Weight, weight
from fflin.dynamics.state import selection
from fflin.linear.linear_trajectory import LinearTrajectory
from fflin.linear.model import LinearModel


def kalman(
    lin: LinearModel,
    W: Weight,
    V: Weight,
    G: ArrayLike | None = None,
    *,
    wheel_speeds: bool | None = None,
) -> Estimator:
    r"""Return the steady-state Kalman filter of a model about a fixed point.

    White noise w of intensity W acts on the state, ``dx/dt = ... + w``, and white noise n of
    intensity V on the outputs, ``y = ... + n``. For a sampled model, W and V are the covariances
    per sample. In continuous time, the covariance P of the estimation error and the gain L satisfy

    .. math:: A P + P A^T - P C^T V^{-1} C P + W = 0,\qquad L = P C^T V^{-1}

    For a sampled model, P satisfies the discrete-time Riccati equation. Both equations are solved
    by SciPy, and Newton's method refines the solution, as in `lqr`. For a model with reaction
    wheels, the filter estimates only the states that `lqr` regulates. It therefore uses only
    outputs that depend on no other states. If a model has no wheels and no input pushes the base,
    the filter estimates the base position and its rate only if outputs measure the position and the
    disturbance pushes the base.

    Parameters
    ----------
    lin : LinearModel
    W : array_like (nx, nx) or (nx,), float, or mapping
        Intensity of the disturbance, positive semidefinite: a matrix, its diagonal, or
        {name: intensity} with names of states or of their groups.
    V : array_like (ny, ny) or (ny,), float, or mapping
        Intensity of the measurement noise, positive definite, in the same forms as W, but with
        names of outputs.
    G : array_like (nx, nw), optional
        Input matrix of the disturbance; W is then (nw, nw). With ``G=lin.B``, the disturbance
        acts at the inputs, and the keys of a mapping W are names of inputs.
    wheel_speeds : bool, optional
        As in `lqr`.

    Returns
    -------
    Estimator

    Raises
    ------
    DetectabilityError
        If a mode neither decays by itself nor can be observed from the outputs; the message names
        the mode.
    EquilibriumError
        If the operating point is not a fixed point.
    InputError
        If a size or value is wrong, or if no disturbance reaches a mode that does not decay by
        itself. Without a disturbance, the filter would in time stop correcting the estimate of this
        mode.
    UnknownNameError
        If a name does not exist.
    ModelError
        If the robot's Pinocchio model (``robot.model``) was modified after the robot was created.

    References
    ----------
    R. E. Kalman and R. S. Bucy, J. Basic Engineering 83(1), 1961.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> noise = {"tau_b": 0.1, "F_b": 0.1, "tau_m": 0.01}
    >>> fflin.kalman(lin, noise, 1e-4, G=lin.B).L.shape
    (18, 18)
    """
    lin = at_fixed_point(lin)
    noise, through = disturbance(lin, W, G)
    V = weight("V", V, lin.output_names, definite=True)
    noises = V
    whole = lin
    lin = _estimated_part(lin, through @ noise, wheel_speeds)
    S = selection(lin.state_names, whole.state_names)
    seen = outputs_of(whole, S)
    require_detectable(lin)
    C = np.ascontiguousarray(lin.C)
    try:
        # NumPy's warnings are not needed, because no filter is found if W or V overflows.
        with np.errstate(over="ignore", invalid="ignore"):
            W = S @ through @ noise @ through.T @ S.T
            V = seen @ V @ seen.T
            W = 0.5 * W + 0.5 * W.T
            require_disturbed(lin, W)
            solution = solve(lin.A.T.copy(), C.T.copy(), W, V, None, lin.dt)
    except np.linalg.LinAlgError as error:
        raise DetectabilityError(
            f"no stable filter was found ({error}); scale W and V, or add outputs"
        ) from None
    L = L_update = solution.K.T
    if lin.dt:
        L_update = np.linalg.solve(C @ solution.P @ C.T + V, C @ solution.P).T
    return Estimator._of(
        solution,
        whole,
        L=S.T @ L @ seen,
        L_update=S.T @ L_update @ seen,
        P=S.T @ solution.P @ S,
        W=S.T @ W @ S,
        V=noises,
        estimated=lin.state_names,
    )


def _estimated_part(
    lin: LinearModel, disturbed: Array, wheel_speeds: bool | None
) -> LinearModel:
    """Return the model of the estimated states: the states that `lqr` regulates, or all states.

    A model without wheels whose inputs do not push the base is estimated completely if the outputs
    measure the base position and the disturbance pushes the base. `disturbed` (nx, nw) maps the
    disturbance to the state.
    """
    positions = unpushed_positions(lin)
    if len(positions) and not (wheel_inputs(lin) or lin.wheels):
        measured = lin.C[:, positions].any(axis=0).all()
        pushed = disturbed[positions + len(lin.M)].any(axis=1).all()
        if measured and pushed:
            return lin
    return regulated_part(lin, wheel_speeds)


def disturbance(
    model: LinearModel | LinearTrajectory, W: Weight, G: ArrayLike | None
) -> tuple[Array, Array]:
    """Return the intensity W (nw, nw) and the input matrix G (.., nx, nw) of the disturbance."""
    nx = len(model.state_names)
    if G is None:
        return weight("W", W, model.state_names), np.eye(nx)
    knots: tuple[int, ...] = ()
    hint = ": one column for each disturbance"
    if dimension("G", G) == model.A.ndim == 3:
        knots = model.A.shape[:1]
        hint = ": one matrix for each knot, with one column for each disturbance"
    shape = *knots, nx, max((1, *np.shape(G))[-1], 1)
    through = shaped("G", G, shape, hint)
    names = tuple(f"w_{i + 1}" for i in range(through.shape[-1]))
    if np.array_equal(through, model.B):
        names = input_keys(model)
    return weight("W", W, names), through
