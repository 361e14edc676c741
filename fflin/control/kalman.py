"""Kalman filters about a point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import block_diag

from fflin.analysis.controllability import require_detectable, require_disturbed
from fflin.analysis.lasting_modes import require_distinguished
from fflin.analysis.reduction import (
    outputs_of,
    regulated_part,
    unpushed_positions,
    wheel_inputs,
)
from fflin.base.errors import DetectabilityError, InputError, listed
from fflin.base.names import input_keys
from fflin.base.validation import Array, ArrayLike, dimension, shaped
from fflin.control.augmented import AddedStates, added_states
from fflin.control.data_sheet import (
    Noises,
    Sheet,
    bias_intensities,
    measurement_noise,
)
from fflin.control.estimator import BIAS, Estimator
from fflin.control.filter_problem import FilterProblem
from fflin.control.lqr import at_fixed_point
from fflin.control.multirate import MultirateEstimator, multirate_filter
from fflin.control.optimal.riccati import Solution, solve
from fflin.control.sensors import timing_of_model
from fflin.control.weights import Weight, padded, state_weight, weight
from fflin.dynamics.state import selection
from fflin.linear.linear_trajectory import LinearTrajectory
from fflin.linear.model import LinearModel


def kalman(
    lin: LinearModel,
    W: Weight,
    V: Noises | None = None,
    G: ArrayLike | None = None,
    *,
    wheel_speeds: bool | None = None,
    disturbance_noise: Mapping[str, float] | None = None,
    bias_noise: Mapping[str, Sheet] | None = None,
    disturbance_frequency: Mapping[str, float | Sequence[float]] | None = None,
) -> Estimator | MultirateEstimator:
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

    With `disturbance_noise`, the filter also estimates slowly varying disturbances w, and with
    `bias_noise`, slowly varying biases b of outputs. Both are random walks, which are added to the
    state:

    .. math:: \dot x = A x + B u + B_d w + \ldots,\quad y = C x + D u + D_d w + b + n,\quad
              \dot w = A_w w + n_w,\quad \dot b = n_b

    A_w is zero for a constant disturbance. For a sinusoidal disturbance of a known frequency s
    [rad/s], two states have the matrix ``[[0, s], [-s, 0]]``, and the first of them acts on the
    robot. For a sampled model, these equations are sampled exactly. `lqg` cancels the estimated
    disturbances, and does not feed back the biases.

    If outputs have their own `sample` or `delay`, see `StarTracker`, the filter uses each
    measurement when it arrives. Its gain is then periodic over the common multiple of the sampling
    times:

    .. math:: P_{j+1} = A (I - K_j C_j) P_j A^T + W,\\qquad
              K_j = P_j C_j^T (C_j P_j C_j^T + V_j)^{-1},\\qquad P_{j+N} = P_j

    C_j contains the outputs that arrive at the sample j. Earlier values of a delayed output are
    further states. The model must be sampled, and its sample time must divide the sample times
    and delays of all outputs.

    Parameters
    ----------
    lin : LinearModel
    W : array_like (nx, nx) or (nx,), float, or mapping
        Intensity of the disturbance, positive semidefinite: a matrix, its diagonal, or
        {name: intensity} with names of states or of their groups.
    V : array_like (ny, ny) or (ny,), float, or mapping, optional
        Intensity of the measurement noise, positive definite, in the same forms as W, but with
        names of outputs. In a mapping, the name of a measured quantity, such as ``gyroscope``,
        selects its components, and a value can be a figure of a data sheet:

        - {"angle_random_walk": x} in deg/sqrt(h), for outputs in rad/s;
        - {"velocity_random_walk": x} in m/s/sqrt(h), for outputs in m/s^2;
        - {"noise_equivalent_angle": x} in arc seconds (one standard deviation of a sample), for
          attitudes: outputs in rad, or parts of a quaternion such as ``q_b``.

        Outputs that V does not name, or all outputs without V, have the field `noise` of the
        robot's outputs.
    G : array_like (nx, nw), optional
        Input matrix of the disturbance; W is then (nw, nw). With ``G=lin.B``, the disturbance
        acts at the inputs, and the keys of a mapping W are names of inputs. Delays of the inputs do
        not delay it.
    wheel_speeds : bool, optional
        As in `lqr`.
    disturbance_noise : mapping, optional
        Disturbances to estimate, as {name: intensity of the random walk} in the squared unit of the
        disturbance per second, also for a sampled model. The names are generalised forces
        (``tau_b``, ``F_b``, ``tau_m``, with the axes of the model), or inputs and their groups. A
        torque ``tau_b`` on a satellite with reaction wheels is an external torque.
    bias_noise : mapping, optional
        Outputs with a bias to estimate, as {name: intensity of the random walk} in the squared unit
        of the output per second. The names are as in V. Values can be figures of a data sheet:

        - {"bias_instability": x} in deg/h, for outputs in rad/s: the standard deviation of the
          change of the bias within one hour;
        - {"rate_random_walk": x} in deg/h/sqrt(h), for outputs in rad/s.

        Outputs that are not named have the field `bias` of the robot's outputs, or no bias.
    disturbance_frequency : mapping, optional
        Frequencies [Hz] of the sinusoids that a disturbance contains in addition to its slowly
        varying part, as {name: frequency or list of frequencies}. The random walk of the two states
        of a sinusoid has the intensity in `disturbance_noise`.

    Returns
    -------
    Estimator or MultirateEstimator
        A `MultirateEstimator` if an output has its own `sample` or `delay`.

    Raises
    ------
    DetectabilityError
        If a mode neither decays by itself nor can be observed from the outputs; the message names
        the mode. Also if the outputs cannot distinguish a disturbance or a bias from another state,
        for example a bias of the only attitude sensor from the attitude.
    EquilibriumError
        If the operating point is not a fixed point.
    InputError
        If a size or value is wrong, or if no disturbance reaches a mode that does not decay by
        itself. Without a disturbance, the filter would in time stop correcting the estimate of this
        mode. Also if the sample times and delays of the outputs have no common grid with the
        sample time of the model; the message states the nearest times that have one.
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

    A constant torque and the bias of a gyroscope:

    >>> sensors = [fflin.BasePose(), fflin.Gyroscope("base")]
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=sensors)
    >>> sampled = fflin.linearize(robot).discretize(0.25)
    >>> noise = {
    ...     "q_b": {"noise_equivalent_angle": 10.0},
    ...     "r_b": 1e-4,
    ...     "gyroscope": {"angle_random_walk": 0.1},
    ... }
    >>> estimator = fflin.kalman(
    ...     sampled,
    ...     {"omega_b": 1e-14},
    ...     noise,
    ...     disturbance_noise={"tau_b": 1e-14},
    ...     bias_noise={"gyroscope": {"bias_instability": 1.0}},
    ... )
    >>> estimator.disturbances[0], estimator.biases[0]
    ('disturbance.tau_b.x', 'bias.base.gyroscope.x')
    """
    slow = disturbance_noise, bias_noise, disturbance_frequency
    try:
        problem = _problem(lin, W, V, G, wheel_speeds, slow)
        timing = timing_of_model(problem.model)
        if timing.is_plain:
            return _stationary(problem)
        return multirate_filter(problem, timing)
    except np.linalg.LinAlgError as error:
        raise _no_filter(error) from None


def stationary_kalman(lin: LinearModel, W: Weight, V: Noises) -> Estimator:
    """Return the filter of `kalman` for outputs that are measured at each sample.

    It estimates the states alone, also if outputs declare a bias.
    """
    try:
        return _stationary(_problem(lin, W, V, None, None, None))
    except np.linalg.LinAlgError as error:
        raise _no_filter(error) from None


def _no_filter(error: np.linalg.LinAlgError) -> DetectabilityError:
    return DetectabilityError(
        f"no stable filter was found ({error}); scale W and V, or add outputs"
    )


def _problem(
    lin: LinearModel,
    W: Weight,
    V: Noises | None,
    G: ArrayLike | None,
    wheel_speeds: bool | None,
    slow: tuple[
        Mapping[str, float] | None,
        Mapping[str, Sheet] | None,
        Mapping[str, float | Sequence[float]] | None,
    ]
    | None,
) -> FilterProblem:
    """Return the data of a filter with the arguments of `kalman`.

    `slow` contains `disturbance_noise`, `bias_noise` and `disturbance_frequency`. If it is None,
    the filter estimates no disturbances and no biases.
    """
    whole = at_fixed_point(lin)
    noise, through = disturbance(whole, W, G)
    sensed = measurement_noise(whole, V)
    covariance = weight("V", sensed, whole.output_names, definite=True)
    # Disturbances are not delayed, so they do not act on the commands that are on their way.
    model = whole.undelayed
    added = added_states(model, None, {}, None)
    if slow is not None:
        forces, biases, frequencies = slow
        added = added_states(
            model, forces, bias_intensities(model, biases), frequencies
        )
    added = added.padded(len(whole.added))
    _require_not_felt(whole, added)
    part = _estimated_part(whole, through @ noise, wheel_speeds)
    in_part = selection(part.state_names, whole.state_names)
    seen = outputs_of(whole, in_part)
    require_detectable(part)
    _require_used(whole, added, seen)
    A, C = added.extend(part.A, np.ascontiguousarray(part.C), in_part, seen)
    count = len(added.names)
    names = (*part.state_names, *added.names)
    if count:
        require_distinguished(names, A, C, count, added.poles)
    # S selects the estimated states from the states of the model and the added states.
    S = block_diag(in_part, np.eye(count))
    # NumPy's warnings are not needed, because no filter is found if W or V overflows.
    with np.errstate(over="ignore", invalid="ignore"):
        on_states = in_part @ through @ noise @ through.T @ in_part.T
        driving = block_diag(on_states, np.zeros((count, count)))
        driving = driving + S @ added.W @ S.T
        driving = 0.5 * driving + 0.5 * driving.T
        measured = seen @ covariance @ seen.T
        require_disturbed(names, part.dt, A, driving)
    return FilterProblem(
        whole, added, names, A, C, driving, measured, covariance, seen, S
    )


def _stationary(problem: FilterProblem) -> Estimator:
    """Return the filter of outputs that are measured at each sample."""
    whole, added = problem.model, problem.added
    A, C, S, seen = problem.A, problem.C, problem.S, problem.seen
    with np.errstate(over="ignore", invalid="ignore"):
        solution = _solved(A, C, problem.W, problem.V, whole.dt, added.size)
    L = L_update = solution.K.T
    if whole.dt:
        innovation = C @ solution.P @ C.T + problem.V
        L_update = np.linalg.solve(innovation, C @ solution.P).T
    A, B, C = problem.whole()
    return Estimator._of(
        solution,
        whole,
        A=A,
        B=B,
        C=C,
        x0=np.concatenate((whole.x0, np.zeros(len(added.names)))),
        state_names=problem.state_names,
        L=S.T @ L @ seen,
        L_update=S.T @ L_update @ seen,
        P=S.T @ solution.P @ S,
        W=S.T @ problem.W @ S,
        V=problem.covariance,
        estimated=problem.names,
    )


def _solved(A: Array, C: Array, W: Array, V: Array, dt: float, size: Array) -> Solution:
    """Solve the Riccati equation of the filter; `size` (k,) scales the last k states."""
    if not len(size):
        return solve(A.T.copy(), C.T.copy(), W, V, None, dt)
    scale = np.concatenate((np.ones(len(A) - len(size)), size))
    solution = solve(
        (A * scale / scale[:, None]).T.copy(),
        (C * scale).T.copy(),
        W / np.outer(scale, scale),
        V,
        None,
        dt,
    )
    return solution._replace(
        P=solution.P * np.outer(scale, scale), K=solution.K * scale
    )


def _require_not_felt(lin: LinearModel, added: AddedStates) -> None:
    """Raise `InputError` if a disturbance acts directly on an output that has a lag."""
    disturbing = [not name.startswith(BIAS) for name in added.names]
    felt = added.C[:, disturbing].any(axis=1) & (lin.output_lag > 0.0)
    if felt.any():
        names = [lin.output_names[i] for i in np.flatnonzero(felt)]
        raise InputError(
            f"disturbances act directly on {listed(names)}, which have a lag; leave out the lag or "
            "disturbance_noise"
        )


def _require_used(lin: LinearModel, added: AddedStates, seen: Array) -> None:
    """Raise `InputError` if a bias belongs to an output that the filter does not use."""
    unused = np.flatnonzero(~seen.any(axis=0))
    biased = [
        lin.output_names[i] for i in unused if BIAS + lin.output_names[i] in added.names
    ]
    if biased:
        raise InputError(
            f"the filter does not use {listed(biased)}, which depend on states that it does not "
            "estimate, so it cannot estimate their bias; remove them from bias_noise"
        )


def _estimated_part(
    lin: LinearModel, disturbed: Array, wheel_speeds: bool | None
) -> LinearModel:
    """Return the model of the estimated states: the states that `lqr` regulates, or all states.

    A model without wheels whose inputs do not push the base is estimated completely if the outputs
    measure the base position and the disturbance pushes the base. `disturbed` (nx, nw) maps the
    disturbance to the state.
    """
    positions = unpushed_positions(lin.undelayed)
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
        return state_weight("W", W, model), np.eye(nx)
    knots: tuple[int, ...] = ()
    hint = ": one column for each disturbance"
    if dimension("G", G) == model.A.ndim == 3:
        knots = model.A.shape[:1]
        hint = ": one matrix for each knot, with one column for each disturbance"
    shape = *knots, nx, max((1, *np.shape(G))[-1], 1)
    through = shaped("G", G if knots else padded(G, model), shape, hint)
    names = tuple(f"w_{i + 1}" for i in range(through.shape[-1]))
    at_inputs = np.array_equal(through, model.B)
    if isinstance(model, LinearModel) and model.added:
        undelayed = np.asarray(padded(model.undelayed.B, model))
        if at_inputs:
            through = undelayed
        at_inputs = np.array_equal(through, undelayed)
    if at_inputs:
        names = input_keys(model)
    return weight("W", W, names), through
