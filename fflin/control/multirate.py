"""Kalman filters and compensators of outputs with their own sample times and delays."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from fflin.base import html
from fflin.base.tables import counted, folded, grid
from fflin.base.validation import Array, Mask, Poles, Vector
from fflin.control.estimator import EstimatingDesign, added_notes
from fflin.control.filter_problem import FilterProblem
from fflin.control.gain import summary_of_poles
from fflin.control.optimal.periodic_filter import PeriodicSolution, periodic_filter
from fflin.control.sensors import SensorTiming


@dataclass(frozen=True)
class _PeriodPoles:
    """Poles z of a period, with the length dt [s] of the period."""

    poles: Poles
    dt: float


@dataclass(frozen=True, eq=False, repr=False)
class _Periodic(EstimatingDesign):
    """Design with matrices for each of the N samples of a period."""

    poles: Poles
    output_names: tuple[str, ...]

    @property
    def samples(self) -> int:
        """Number of samples of a period."""
        raise NotImplementedError

    @property
    def period(self) -> float:
        """Time [s] after which the matrices repeat."""
        return self.samples * self.dt

    def _summary(self) -> str:
        """Return the number of poles and the slowest decay."""
        return summary_of_poles(_PeriodPoles(self.poles, self.period))


@dataclass(frozen=True, eq=False, repr=False)
class MultirateEstimator(_Periodic):
    r"""Periodic Kalman filter of outputs that are measured at different rates.

    With u and y as deviations from u0 and y0, the estimate xh of x - x0 at the sample k follows

    .. math:: \hat x_{k+1} = A \hat x_k + B u_k + L_j (y_k - C \hat x_k - D u_k)

    with the sample j = k mod N of the period. Columns of L for outputs that do not arrive at this
    sample are zero.

    Attributes
    ----------
    L, L_update : ndarray (N, nx, ny)
        Gains of the prediction and of the measurement update, ``L = A L_update``, for each sample
        of the period.
    P : ndarray (N, nx, nx)
        Covariance of the estimation error before the measurements of each sample.
    poles : ndarray (nz,) of complex
        Eigenvalues of the error dynamics over one period.
    residual : float
        Change of P over one more period, relative to its norm.
    margin : float
        1 minus the largest modulus of the poles.
    A, B, C, D : ndarray
        Matrices of the model. Its states are the states of the robot, the estimated disturbances
        and biases, and earlier values of delayed outputs: ``late_2.q_b.x`` is the output ``q_b.x``
        two samples ago.
    W, V : ndarray
        Covariances of the state disturbance and of the measurement noise.
    x0, u0, y0 : ndarray
        State, inputs and outputs at the operating point.
    dt : float
        Sample time of the model [s].
    state_names, input_names, output_names : tuple of str
    robot, urdf_sha256 : str
        Name of the robot, and SHA-256 of its URDF.
    estimated : tuple of str (nz,)
        Names of the estimated states. The entries of L, P and W are zero for other states.

    Examples
    --------
    >>> sensors = [
    ...     fflin.StarTracker(sample=0.25, delay=0.2, noise={"noise_equivalent_angle": 10.0}),
    ...     fflin.Gyroscope("base", noise={"angle_random_walk": 0.1}, bias={"bias_instability": 1}),
    ... ]
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=sensors)
    >>> model = fflin.linearize(robot).discretize(0.05)
    >>> estimator = fflin.kalman(model, {"omega_b": 1e-12})
    >>> estimator.L.shape[0], estimator.period
    (5, 0.25)
    """

    _SHAPES = (
        "A:xx B:xu C:yx D:yu L:pxy L_update:pxy P:pxx W:xx V:yy x0:x u0:u y0:y "
        "state_names:x output_names:y"
    )

    L: Array
    L_update: Array
    P: Array
    residual: float
    C: Array
    D: Array
    W: Array
    V: Array
    x0: Vector
    u0: Vector
    y0: Vector
    estimated: tuple[str, ...]

    @property
    def samples(self) -> int:
        """Number of samples of a period."""
        return len(self.L)

    @property
    def margin(self) -> float:
        """Distance of the poles of a period from the unit circle."""
        return 1.0 - float(np.abs(self.poles).max(initial=0.0))

    def _report(self) -> str:
        """Return the report with the poles and the times at which outputs arrive."""
        arrivals = [["output", "arrives at the samples"]]
        for index, name in enumerate(self.output_names):
            at = np.flatnonzero(self.L_update[:, :, index].any(axis=1))
            shown = ", ".join(map(str, at)) or "not used"
            arrivals.append([name, "all" if len(at) == self.samples else shown])
        parts = [
            folded([self._summary(), self._head()]),
            grid(arrivals, "ll"),
            f"Riccati residual {self.residual:.1e}",
        ]
        if notes := added_notes(self.state_names):
            parts.append(folded(notes))
        return "\n\n".join(parts)

    def _html_parts(self) -> list[str]:
        return [
            html.verdict(self._summary(), self.margin > 0.0),
            html.paragraph(self._head()),
            html.paragraph(f"Riccati residual {self.residual:.1e}"),
            *(html.paragraph(note) for note in added_notes(self.state_names)),
        ]

    def _head(self) -> str:
        return (
            f"{self.robot}: estimator of {len(self.estimated)} states from "
            f"{len(self.output_names)} outputs, sampled at {self.dt:g} s, with a period of "
            f"{counted(self.samples, 'sample')}"
        )


@dataclass(frozen=True, eq=False, repr=False)
class MultirateCompensator(_Periodic):
    r"""Periodic output-feedback compensator of outputs that are measured at different rates.

    .. math:: z_{k+1} = A_j z_k + B_j (y_k - y_0) + E_j (u_a - u),\qquad u_k - u_0 = C z_k

    with the sample j = k mod N of the period, and the inputs :math:`u_a` after limits are applied.

    Attributes
    ----------
    A : ndarray (N, nz, nz)
    B : ndarray (N, nz, ny)
    C : ndarray (nu, nz)
    E : ndarray (N, nz, nu)
        Gain of the anti-windup, as in `Compensator`.
    poles : ndarray of complex
        Poles of the closed loop over one period: poles of the gain and of the estimator.
    y0, u0 : ndarray
        Outputs and inputs at the operating point.
    dt : float
        Sample time [s].
    state_names, input_names, output_names : tuple of str
        Signals of the compensator. The inputs of the compensator are the outputs of the model.
    robot, urdf_sha256 : str
        Name of the robot, and SHA-256 of its URDF.
    delay : ndarray (nu,)
        Delay of the inputs [s] in the model, as in `Compensator`.
    slow_bias, pace : str
        Notes on an estimated bias and on the disk margin of the loop, as in `Compensator`.

    Examples
    --------
    >>> sensors = [fflin.StarTracker(sample=0.5, delay=0.25), fflin.Gyroscope("base")]
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=sensors)
    >>> model = fflin.linearize(robot).discretize(0.25)
    >>> estimator = fflin.kalman(model, 1e-10, 1e-8)
    >>> compensator = fflin.lqg(fflin.lqr(model), estimator)
    >>> compensator.A.shape
    (2, 9, 9)
    """

    _SHAPES = "A:pzz B:pzy C:uz E:pzu y0:y u0:u input_names:y output_names:u"

    C: Array
    E: Array
    y0: Vector
    u0: Vector
    # Files of earlier versions contain no delay.
    delay: Vector = field(default_factory=lambda: np.zeros(0))
    slow_bias: str = ""
    pace: str = ""

    @property
    def samples(self) -> int:
        """Number of samples of a period."""
        return len(self.A)

    def _report(self) -> str:
        """Return the report with the sizes and the slowest decay."""
        parts = [folded([self._summary(), self._head()])]
        if notes := self._notes():
            parts.append(folded(notes))
        return "\n\n".join(parts)

    def _notes(self) -> list[str]:
        """Return notes on estimated disturbances and biases, and on the pace of the loop."""
        notes = list(added_notes(self.state_names))
        if self.slow_bias:
            notes.append(self.slow_bias)
        if self.pace:
            notes.append(self.pace)
        return notes

    def _html_parts(self) -> list[str]:
        return [
            html.paragraph(self._summary()),
            html.paragraph(self._head()),
            *(html.paragraph(note) for note in self._notes()),
        ]

    def _head(self) -> str:
        nu, nz = self.C.shape
        return (
            f"{self.robot}: compensator with {nz} states, from {len(self.input_names)} outputs of "
            f"the robot to {nu} inputs, sampled at {self.dt:g} s, with a period of "
            f"{counted(self.samples, 'sample')}"
        )


def multirate_filter(
    problem: FilterProblem, timing: SensorTiming
) -> MultirateEstimator:
    """Return the periodic filter of outputs with a timing.

    Raise `LinAlgError` if no stable filter was found.
    """
    used = problem.seen.argmax(axis=1)
    arriving: Mask = np.array([timing.arriving(k)[used] for k in range(timing.period)])
    delays = [timing.delays[index] for index in used]
    nothing = np.zeros((len(problem.C), 0))
    inner, _, C, _, _ = _with_delays(
        problem.A, np.zeros((len(problem.A), 0)), problem.C, nothing, delays
    )
    count = len(inner) - len(problem.A)
    W = block_diag(problem.W, np.zeros((count, count)))
    scale = np.concatenate((problem.scale, np.ones(count)))
    solution = _scaled_solution(inner, C, W, problem.V, arriving, scale)
    model, seen = problem.model, problem.seen
    S = block_diag(problem.S, np.eye(count))
    plain_A, plain_B, plain_C = problem.whole()
    late = [
        delays[list(used).index(k)] if k in used else 0 for k in range(len(plain_C))
    ]
    A, B, C, D, places = _with_delays(plain_A, plain_B, plain_C, model.D, late)
    names = tuple(f"late_{ago}.{model.output_names[k]}" for k, ago in places)
    # The delay line is in the order of the used outputs, as in the estimated states.
    return MultirateEstimator._of(
        model,
        A=A,
        B=B,
        C=C,
        D=D,
        L=np.array([S.T @ inner @ K @ seen for K in solution.K]),
        L_update=np.array([S.T @ K @ seen for K in solution.K]),
        P=np.array([S.T @ P @ S for P in solution.P]),
        poles=solution.poles,
        residual=solution.residual,
        W=S.T @ W @ S,
        V=problem.covariance,
        x0=np.concatenate((model.x0, np.zeros(len(A) - len(model.x0)))),
        state_names=(*problem.state_names, *names),
        estimated=(*problem.names, *names),
    )


def _scaled_solution(
    A: Array, C: Array, W: Array, V: Array, arriving: Mask, scale: Array
) -> PeriodicSolution:
    """Return the solution of the periodic Riccati equation; `scale` (n,) scales the states."""
    solution = periodic_filter(
        A * scale / scale[:, None],
        C * scale,
        W / np.outer(scale, scale),
        V,
        arriving,
    )
    return solution._replace(
        P=solution.P * np.outer(scale, scale), K=solution.K * scale[:, None]
    )


def _with_delays(
    A: Array, B: Array, C: Array, D: Array, delays: list[int]
) -> tuple[Array, Array, Array, Array, list[tuple[int, int]]]:
    """Return the matrices of a sampled model whose outputs arrive late.

    `delays` (ny,) are in samples. The further states are earlier values of the outputs. The last
    result contains the output and the age in samples of each of these states.
    """
    n, nu = B.shape
    places = [(k, ago) for k, delay in enumerate(delays) for ago in range(1, delay + 1)]
    count = len(places)
    A_late = np.zeros((n + count, n + count))
    B_late = np.zeros((n + count, nu))
    C_late = np.hstack((C, np.zeros((len(C), count))))
    D_late = D.copy()
    A_late[:n, :n], B_late[:n] = A, B
    for at, (k, ago) in enumerate(places, start=n):
        if ago == 1:
            A_late[at, :n], B_late[at] = C[k], D[k]
        else:
            A_late[at, at - 1] = 1.0
        if ago == delays[k]:
            C_late[k] = 0.0
            C_late[k, at] = 1.0
            D_late[k] = 0.0
    return A_late, B_late, C_late, D_late, places
