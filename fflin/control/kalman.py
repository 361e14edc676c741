"""Kalman filters about a point or along a trajectory, and LQG compensators."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from fflin.analysis.controllability import require_detectable, require_disturbed
from fflin.analysis.reduction import (
    outputs_of,
    regulated_part,
    unpushed_positions,
    wheel_inputs,
)
from fflin.base import html, svg
from fflin.base.errors import DetectabilityError, InputError, listed, located
from fflin.base.names import input_keys
from fflin.base.process import in_one_thread
from fflin.base.tables import folded
from fflin.base.validation import (
    Array,
    ArrayLike,
    Poles,
    Vector,
    dimension,
    instance,
    shaped,
)
from fflin.control.gain import (
    Gain,
    ModelDesign,
    folded_poles,
    poles_figure,
    summary_of_poles,
    table_of_poles,
)
from fflin.control.lqr import at_fixed_point
from fflin.control.optimal import differential_riccati as riccati
from fflin.control.optimal.riccati import solve
from fflin.control.trajectory_end import steady_end
from fflin.control.tvlqr import FilterSchedule, asks_steady, sample_time
from fflin.control.weights import Weight, weight
from fflin.dynamics.integrators import HEAVY, LIGHT, held_cost
from fflin.dynamics.state import selection
from fflin.linear.linear_trajectory import LinearTrajectory, along, transitions
from fflin.linear.model import ControlSystem, LinearModel, state_space


@dataclass(frozen=True, eq=False, repr=False)
class Estimator(ModelDesign):
    r"""Steady-state Kalman filter for the deviations of the state from the operating point.

    With u and y as deviations from u0 and y0, the estimate xh of x - x0 follows
    ``d(xh)/dt = A xh + B u + L (y - C xh - D u)``. For a sampled model, the right side is the
    prediction of xh for the next sample. The filtered estimate, which also uses the present
    measurement, is ``xh + L_update (y - C xh - D u)``.

    Attributes
    ----------
    L : ndarray (nx, ny)
        Filter gain.
    L_update : ndarray (nx, ny)
        Gain of the measurement update. For a sampled model, ``L = A L_update``. In continuous time,
        `L_update` equals `L`.
    P : ndarray (nx, nx)
        Covariance of the estimation error.
    poles : ndarray (nz,) of complex
        Eigenvalues of ``A - L C`` over the estimated states: [1/s] for a continuous model,
        discrete-time poles z for a sampled one.
    residual : float
        Residual of the Riccati equation, relative to the sum of the norms of its terms.
    margin : float
        Distance of the poles from the stability boundary, as in `Gain`.
    A, B, C, D : ndarray
        Matrices of the model.
    W, V : ndarray
        Covariances of the state disturbance and of the measurement noise.
    x0, u0, y0 : ndarray
        State, inputs and outputs at the operating point.
    dt : float
        Sampling time [s]; 0 for continuous time.
    state_names, input_names, output_names : tuple of str
    robot, urdf_sha256 : str
        Name of the robot, and SHA-256 of its URDF.
    estimated : tuple of str (nz,)
        Names of the estimated states; empty if all states are estimated. The entries of L, P and W
        are zero for states that are not estimated.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> estimator = fflin.kalman(lin, 1e-3, 1e-4)
    >>> bool(estimator.poles.real.max() < 0), estimator.residual < 1e-9
    (True, True)
    """

    _SHAPES = "A:xx B:xu C:yx D:yu L:xy P:xx W:xx V:yy x0:x u0:u y0:y state_names:x output_names:y"

    L: Array
    L_update: Array
    P: Array
    poles: Poles
    residual: float
    margin: float
    C: Array
    D: Array
    W: Array
    V: Array
    x0: Vector
    u0: Vector
    y0: Vector
    output_names: tuple[str, ...]
    estimated: tuple[str, ...]

    def _report(self) -> str:
        """Return the report with the poles and the states that are not estimated."""
        parts = [folded([summary_of_poles(self), self._head()])]
        parts.append(table_of_poles(self, "A - L C"))
        parts.append(f"Riccati residual {self.residual:.1e}")
        if left := self._not_estimated():
            parts.append(folded([left]))
        return "\n\n".join(parts)

    def _html_parts(self) -> list[str]:
        states = svg.Axis(self.state_names, [""] * len(self.state_names))
        outputs = svg.Axis(self.output_names, [""] * len(self.output_names))
        L = svg.heat_map("L", self.L, states, outputs)
        return [
            html.verdict(summary_of_poles(self), self.margin > 0.0),
            html.paragraph(self._head()),
            html.paragraph(f"Riccati residual {self.residual:.1e}"),
            html.side_by_side(poles_figure(self, "A - L C"), L),
            folded_poles(self, "A - L C"),
            html.paragraph(self._not_estimated(), "note"),
        ]

    def _head(self) -> str:
        count = len(self.estimated or self.state_names)
        return (
            f"{self.robot}: estimator of {count} states from {len(self.output_names)} outputs, "
            f"{_time(self.dt)}"
        )

    def _not_estimated(self) -> str:
        left = [
            name
            for name in self.state_names
            if self.estimated and name not in self.estimated
        ]
        if not left:
            return ""
        return (
            f"not estimated: {listed(left)}, which have no effect on the other states"
        )

    def to_control(self) -> ControlSystem:
        """Return a `control.StateSpace` from u - u0 and y - y0 to xh, with signal names.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        InputError
            If two signals differ only by a dot or an underscore, because python-control has no dots
            in names.
        """
        L = self.L
        both = (*self.input_names, *self.output_names)
        system = (
            self.A - L @ self.C,
            np.hstack((self.B - L @ self.D, L)),
            np.eye(len(L)),
            0.0,
        )
        return state_space(system, self.dt, self.state_names, both, self.state_names)


@dataclass(frozen=True, eq=False, repr=False)
class Compensator(ModelDesign):
    r"""Output-feedback compensator ``d(z)/dt = A z + B (y - y0)``, ``u - u0 = C z``.

    For a sampled model, ``A z + B (y - y0)`` is the value of z at the next sample. The state z is
    the estimate of x - x0.

    Attributes
    ----------
    A : ndarray (nz, nz)
    B : ndarray (nz, ny)
    C : ndarray (nu, nz)
    poles : ndarray (2 nz,) of complex
        Closed-loop poles of the model with the compensator: the poles of the gain and of the
        estimator.
    y0, u0 : ndarray
        Outputs and inputs at the operating point.
    E : ndarray (nz, nu)
        Gain of the anti-windup: ``E (u_applied - u)`` is added to dz/dt, or to the next z of a
        sampled compensator, if limits change the command. Zero without integral action, and empty
        in a compensator from a file of an older version.
    dt : float
        Sampling time [s]; 0 for continuous time.
    state_names, input_names, output_names : tuple of str
        Signals of the compensator. The inputs of the compensator are the outputs of the model.
    robot, urdf_sha256 : str
        Name of the robot, and SHA-256 of its URDF.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> compensator = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-3, 1e-4))
    >>> compensator.A.shape, bool(compensator.poles.real.max() < 0)
    ((18, 18), True)
    """

    _SHAPES = "A:zz B:zy C:uz y0:y u0:u input_names:y output_names:u"

    C: Array
    poles: Poles
    y0: Vector
    u0: Vector
    output_names: tuple[str, ...]
    E: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def _report(self) -> str:
        """Return the report with the sizes and the poles of the closed loop."""
        poles = table_of_poles(self, "the closed loop")
        title = folded([summary_of_poles(self), self._head()])
        return f"{title}\n\n{poles}"

    def _html_parts(self) -> list[str]:
        return [
            html.paragraph(summary_of_poles(self)),
            html.paragraph(self._head()),
            poles_figure(self, "the closed loop"),
            folded_poles(self, "the closed loop"),
        ]

    def _head(self) -> str:
        nu, nz = self.C.shape
        return (
            f"{self.robot}: compensator with {nz} states, from {len(self.input_names)} outputs of "
            f"the robot to {nu} inputs, {_time(self.dt)}"
        )

    def to_control(self) -> ControlSystem:
        """Return a `control.StateSpace` from y - y0 to u - u0, with signal names.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        InputError
            If two signals differ only by a dot or an underscore, because python-control has no dots
            in names.
        """
        names = self.state_names, self.input_names, self.output_names
        return state_space((self.A, self.B, self.C, 0.0), self.dt, *names)


def _time(dt: float) -> str:
    if dt:
        return f"sampled at {dt:g} s"
    return "continuous"


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


def lqg(gain: Gain, estimator: Estimator) -> Compensator:
    r"""Return the LQG compensator, which feeds back the state estimate: u - u0 = -K xh.

    .. math:: \dot z = (A - B K - L C + L D K) z + L (y - y_0),\qquad u - u_0 = -K z

    For a sampled model, xh is the prediction from earlier samples, so that one sampling time is
    available for the computation.

    If the gain has integrals, the compensator integrates the measured outputs, and the integrals
    are its last states: u - u0 = -K xh - K_i xi. A constant disturbance then leaves no error in
    these outputs, although it leaves an error in the estimate. If limits change the commands, the
    filter uses the limited inputs, and the integrals are corrected as in `StateFeedback`.

    Parameters
    ----------
    gain : Gain
    estimator : Estimator
        Estimator for the same model.

    Returns
    -------
    Compensator

    Raises
    ------
    InputError
        If gain and estimator belong to different models, the gain feeds back a state that the
        estimator does not estimate, or an integrated signal is not measured.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> sampled = lin.discretize(0.1)
    >>> compensator = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-3, 1e-4))
    >>> compensator.dt
    0.1
    """
    instance("gain", gain, Gain, "a Gain, as fflin.lqr returns it")
    e = instance(
        "estimator", estimator, Estimator, "an Estimator, as fflin.kalman returns it"
    )
    nx = len(gain.model_states)
    if gain.dt != e.dt or not (
        np.array_equal(gain.A[:nx, :nx], e.A) and np.array_equal(gain.B[:nx], e.B)
    ):
        raise InputError(
            "the gain and the estimator belong to different models; use one model for both"
        )
    names = e.estimated or e.state_names
    regulated = [name for name in gain.regulated if name not in gain.integrals]
    if missing := [name for name in regulated if name not in names]:
        raise InputError(
            f"the gain feeds back {listed(missing)}, which the estimator does not estimate; use "
            "the same wheel_speeds= for both designs"
        )
    S = selection(names, e.state_names)
    K = gain.K_x
    A: Array = S @ (e.A - e.B @ K - e.L @ (e.C - e.D @ K)) @ S.T
    B: Array = S @ e.L
    C: Array = -K @ S.T
    E = np.zeros_like(C.T)
    if gain.integrals:
        driven = S @ (e.B - e.L @ e.D)
        A, B, C = _with_integrals(gain, e, A, B, driven)
        E = np.vstack((driven, gain.anti_windup))
    return Compensator._of(
        e,
        A=A,
        B=B,
        C=C,
        E=E,
        poles=np.concatenate((gain.poles, e.poles)),
        state_names=(*names, *gain.integrals),
        input_names=e.output_names,
        output_names=e.input_names,
        verified=gain.verified and e.verified,
    )


def _with_integrals(
    gain: Gain, e: Estimator, A: Array, B: Array, driven: Array
) -> tuple[Array, Array, Array]:
    """Return A, B and C of a compensator with the integrals of measured outputs as last states.

    A and B are without integrals, and `driven` is the effect of the inputs on the estimate.
    """
    k = len(gain.integrals)
    H, measured = gain.H, e.C[~e.D.any(axis=1)]
    # combination of outputs whose value is H (x - x0)
    rows = np.linalg.lstsq(measured.T, H.T, rcond=None)[0].T
    lack = np.abs(rows @ measured - H).max(axis=1) > 1e-9 * np.abs(H).max()
    if lack.any():
        name = gain.integrals[int(lack.argmax())].removeprefix("integral.")
        raise InputError(
            f"the gain integrates {name}, which the outputs do not measure; add an output that "
            "measures it, or leave it out of integral_action"
        )
    combined = np.zeros((k, len(e.C)))
    combined[:, ~e.D.any(axis=1)] = rows
    corner = np.eye(k) if gain.dt else np.zeros((k, k))
    A = np.block([[A, -driven @ gain.K_i], [np.zeros((k, len(A))), corner]])
    B = np.vstack((B, (gain.dt or 1.0) * combined))
    S = selection(e.estimated or e.state_names, e.state_names)
    return A, B, np.hstack((-gain.K_x @ S.T, -gain.K_i))


@in_one_thread
def tvkalman(
    traj: LinearTrajectory,
    W: Weight,
    V: Weight,
    G: ArrayLike | None = None,
    P0: Weight | str = "steady",
    *,
    sample: float,
) -> FilterSchedule:
    r"""Return the time-varying Kalman filter of sampled outputs along a trajectory.

    White noise of intensity W acts on the error, and noise of covariance V on the outputs at each
    sample. Between samples, :math:`\delta u` is held. The covariance P of the estimation error is
    computed forward from P0 by (10.4) of docs/derivation.md:

    .. math:: P_{k+1} = \Phi (P - P C^T (C P C^T + V)^{-1} C P)_k \Phi^T + W_k,\qquad
              L = \Phi P C^T (C P C^T + V)^{-1}.

    Here :math:`\Phi` is the transition matrix over one sample, and :math:`W_k` is the covariance of
    the disturbance integrated over this sample.

    Parameters
    ----------
    traj : LinearTrajectory
        Trajectory of a robot whose outputs are the measurements.
    W : array_like (nx, nx) or (nx,), float, or mapping
        Intensity of the disturbance, positive semidefinite, as in `kalman`.
    V : array_like (ny, ny) or (ny,), float, or mapping
        Covariance of the measurement noise at a sample, positive definite.
    G : array_like (nx, nw) or (N, nx, nw), optional
        Input matrix of the disturbance, interpolated linearly between the knots; W is then (nw,
        nw). With ``G=traj.B``, the disturbance acts at the inputs, and the keys of a mapping W are
        names of inputs.
    P0 : "steady", or as W
        Covariance at the start. "steady" is the covariance of `kalman` about the start point. The
        start point is the first configuration, in its initial motion if this motion is steady,
        otherwise at rest, or in free fall as in `tvlqr`.
    sample : float
        Sampling time [s], which must divide the duration.

    Returns
    -------
    FilterSchedule

    Raises
    ------
    InputError
        If a size or value is wrong, if P overflows, or if the sampling time does not divide the
        duration.
    UnknownNameError
        If a name does not exist.
    EquilibriumError, DetectabilityError
        If P0 is "steady", and either no inputs can hold the robot at the start point or the model
        at this point is not detectable.

    References
    ----------
    R. E. Kalman and R. S. Bucy, J. Basic Engineering 83(1), 1961.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> noise = {"tau_b": 0.1, "F_b": 0.1, "tau_m": 0.01}
    >>> fflin.tvkalman(along, noise, 1e-4, G=along.B, sample=0.1).L.shape
    (21, 18, 18)
    """
    dt = sample_time(traj, sample)
    V = weight("V", V, traj.output_names, definite=True)
    noise, columns = disturbance(traj, W, G)
    columns = np.broadcast_to(columns, (len(traj.t), *columns.shape[-2:]))

    def intensity(t: float) -> Array:
        (input_matrix,) = traj.between(t, columns)
        spread = input_matrix @ noise @ input_matrix.T
        return 0.5 * (spread + spread.T)

    if asks_steady(P0, "P0", "a covariance"):
        start, early = steady_end(traj, 0), intensity(float(traj.t[0]))
        lin = start.of_trajectory(traj.robot)
        with located(
            "give P0, because no steady filter exists at the start of the trajectory"
        ):
            P = kalman(lin.discretize(dt), held_cost(lin.A.T, early, dt), V).P
    else:
        P = weight("P0", P0, traj.state_names)
    held = list(transitions(traj, dt))
    at_samples = along(traj.resampled(dt))
    nx = len(P)
    maps = np.array([whole for _, whole in held])
    # covariance that the disturbance adds per sample
    disturbed = np.zeros((len(held), nx, nx))
    with riccati.bounded_by("a smaller W or a larger V"):
        for covariance, (steps, _) in zip(disturbed, held, strict=True):
            early, late = (
                np.array([intensity(t) for t in times])
                for times in steps.nodes.T.tolist()
            )
            added = held_cost(
                steps.F[:, :nx, :nx].mT, HEAVY * early + LIGHT * late, steps.h
            )
            for step, step_noise in zip(steps.maps[:, :, :nx], added, strict=True):
                covariance[:] = step @ covariance @ step.T + step_noise
        stages = [
            (block_diag(process_noise, V), np.hstack((whole[:, :nx].T, C.T)))
            for process_noise, whole, C in zip(
                disturbed, maps, at_samples.C, strict=False
            )
        ]
        K, P, residual = riccati.samples_back(stages, P)
    L = K.transpose(0, 2, 1)
    return FilterSchedule._of(
        at_samples,
        L=np.concatenate((L, L[-1:])),
        P=P,
        A=maps[:, :, :nx],
        B=maps[:, :, nx:],
        W=disturbed,
        V=V,
        residual=residual,
        robot=traj.robot.name,
        urdf_sha256=traj.robot.urdf_sha256,
        dt=dt,
        verified=traj.verified,
    )


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
