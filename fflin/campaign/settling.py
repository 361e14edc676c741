"""Settling of a regulated robot from random displacements, measured with an error norm.

The norm of a deviation z is sqrt(z' P z), where z' P z is a Lyapunov function of the linear loop.
In a continuous loop, z' Q z is the rate at which z' P z decreases. In a sampled loop, z' Q z is the
decrease of z' P z from one sample to the next. Q is diagonal, and z' Q z has the unit of energy.
"""

import math
from collections.abc import Callable, Mapping
from functools import cached_property, partial

import numpy as np

from fflin.analysis.reduction import regulated_part
from fflin.base.errors import ConstraintError, InputError
from fflin.base.rotation import quaternion_product
from fflin.base.validation import Array, Indices, Mask, as_double, instance
from fflin.batch.run import Execution, Progress
from fflin.campaign.runs import EDGE, CampaignJob, completed
from fflin.control.gain import Gain, gain_matrix, regulated_states
from fflin.control.policies import StateFeedback
from fflin.control.policy import Policy
from fflin.dynamics.integrators import DEFAULT_INTEGRATOR, held_exponential
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_fit
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel, refuse_delayed, refuse_frozen
from fflin.robot.robot import Robot
from fflin.simulation.constrained import Constrained
from fflin.simulation.pace import Pace, Poles
from fflin.simulation.run import STOPS

# A run has settled if its error is at most SETTLED times the initial error, and diverged if its
# error is at least DIVERGED times the initial error.
SETTLED, DIVERGED = 1e-3, 1e3
# _CONSTANTS: duration of a run that is compared with the prediction, in time constants of the
# slowest pole. PATIENCE: largest duration of a random run, in settling times of the slowest pole.
_CONSTANTS, PATIENCE = 3.0, 3.0
# Time steps times the fastest rate, which is `pace` [1/s] in `Loop.runs`. Runs that are compared
# with the prediction have shorter steps, so that their relative integration error is about 1e-8.
_STEP, _STEP_PREDICTED = 0.25, 0.1
_WIDEST = 10.0  # largest joint displacement [rad|m] to which the step is adapted
# Number of stages in which a displacement is applied to a robot with constraints.
_STAGES = 8
# The steps of a diverging run are shortened by the factor _FINER, at most _FINEST times.
_FINER, _FINEST = 8, 2
_MOST_STEPS = 1_000_000
# approximate number of comparisons with the prediction in a run of a continuous loop
_CHECKS = 60

OUTCOMES = ("slow", "settled", "chart", "diverged", "singular")


class Loop:
    """Regulated robot with a linear model and a feedback of the model's states.

    The feedback is ``u = u0 - K (z - z0)`` for the states z of the model. `InputError` is raised if
    the loop cannot settle at the operating point.
    """

    def __init__(self, robot: Robot, lin: LinearModel, gain: object) -> None:
        instance("robot", robot, Robot, "a fflin.Robot")
        instance("lin", lin, LinearModel, "a fflin.LinearModel")
        if isinstance(gain, Policy) and gain.feedback_gain is None:
            raise InputError(
                f"gain is a {gain.kind}, expected a gain of the states, as from fflin.lqr; use "
                "fflin.monte_carlo for the range of other laws"
            )
        refuse_delayed(lin, "the comparison of linear and nonlinear motions")
        refuse_frozen(lin, "the comparison of linear and nonlinear motions")
        # A gain with integral action must be given itself, because its matrix has more columns.
        has_integrals = isinstance(gain, Gain) and bool(gain.integrals)
        K = gain if has_integrals else as_double("gain", gain_matrix(gain))
        policy = StateFeedback(lin, K)
        kept = regulated_states(gain)
        part = regulated_part(lin, any(f"qdot_m.{name}" in kept for name in lin.wheels))
        # omit states that are not fed back and cannot settle
        if part.state_names == kept:
            policy = policy.of_part(part)
            lin = part
        self.robot, self.lin, self.policy = robot, lin, policy
        # Map between (q, v) and the full state of the robot, in the frame of the model.
        self.state = state = StateMap(robot, reference=lin.reference, frame=lin.frame)
        require_fit(lin, robot, state)
        if not len(lin.x0):
            raise InputError(
                f"the model of '{lin.robot}' has no states, so nothing can settle"
            )
        if lin.moving or not lin.is_equilibrium() or lin.v.any():
            raise InputError(
                "the operating point is not an equilibrium at rest, so the loop cannot settle "
                "there; linearise about an equilibrium"
            )
        # Full state (nx,) at the operating point, and indices of the model's states in the full
        # state.
        self.start = state.to_state(lin.q, lin.v)
        half = state.nx // 2
        # Constraints of the robot, and the indices of the coordinates that they determine.
        self._held: Constrained | None = None
        self._dependent: Indices = np.zeros(0, dtype=np.intp)
        if robot.constraints:
            self._held = Constrained(state, lin.q)
            names = [name for name in state.names[:half] if name in lin.dependent]
            indices = [state.names.index(name) for name in names]
            self._dependent = np.array(indices, dtype=np.intp)
        self.model_states = np.array(
            [state.names.index(name) for name in lin.state_names]
        )
        # State matrix of the linear loop, whose last states are the integrals of the policy, and
        # its slowest decay rate [1/s].
        self.rate: Array = policy.loop_with(lin)
        poles = np.linalg.eigvals(self.rate)
        self.decay = -float(poles.real.max())
        if lin.dt:
            self.decay = -math.log(max(float(np.abs(poles).max()), 1e-300)) / lin.dt
        if not self.decay > 0.0:
            raise InputError(
                f"the linear loop is not stable: a mode grows at {-self.decay:.3g} 1/s; "
                "design the gain with fflin.lqr"
            )

    @cached_property
    def weight(self) -> Array:
        """Matrix P of the Lyapunov function of the linear loop, for zero integrals."""
        from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

        names, full = self.lin.state_names, self.state.names
        root_of = dict(
            zip(names[-len(self.lin.M) :], np.sqrt(self.lin.M.diagonal()), strict=True)
        )
        # Q contains the weights of velocities and coordinates. `root_of` is {velocity: square root
        # of its weight}, and the weight is a diagonal entry of M. `size` contains the square root
        # of the weight of each coordinate: the root for its velocity times the decay rate of the
        # loop. Coordinates and velocities are matched by name, because a velocity can be a state of
        # the model even if its coordinate is not.
        rates = dict(zip(full, full[len(full) // 2 :], strict=False))
        size = [
            self.decay * root_of[rates[name]] for name in names if name not in root_of
        ]
        roots = [*size, *root_of.values(), *(0.0 for _ in self.policy.integrals)]
        Q = np.diag(np.array(roots) ** 2)
        P: Array
        if self.lin.dt:
            P = solve_discrete_lyapunov(self.rate.T, Q)
        else:
            P = solve_continuous_lyapunov(self.rate.T, -Q)
        P = P[: len(names), : len(names)]
        return (P + P.T) / 2.0

    def size(self, error: Array) -> Array:
        """Return the norm of deviations (.., nz) of the model's states."""
        square: Array = ((error @ self.weight) * error).sum(axis=-1)
        return np.sqrt(np.maximum(square, 0.0))

    def displaced(
        self, rng: np.random.Generator, attitude: float, position: float, joint: float
    ) -> Array:
        """Return a state (nx,) in which the states of the model are displaced at random.

        The displacements of the base are `attitude` [deg] and `position` [m]. The largest
        displacement of a joint is `joint` [rad|m]. If the robot has constraints, the independent
        states are displaced, and the other states follow.

        Raises
        ------
        ConstraintError
            If the constraints cannot be closed.
        """
        axis, along = (
            vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3))
        )
        spread = rng.uniform(-1.0, 1.0, size=self.robot.n)
        spread /= np.abs(spread).max(initial=1e-300)

        def moved(level: float) -> Array:
            """Return the state after a fraction of the displacement."""
            turn = level * np.radians(attitude) / 2.0
            rotation = np.array((*(np.sin(turn) * axis), np.cos(turn)))
            return self._moved(
                rotation, level * position * along, level * joint * spread
            )

        x = self.start.copy()
        if self._held is None:
            x[self.model_states] = moved(1.0)[self.model_states]
            return x
        # Newton's method begins at the configuration that was closed before.
        for level in np.linspace(0.0, 1.0, _STAGES + 1)[1:].tolist():
            x[self.model_states] = moved(level)[self.model_states]
            q, v = self.state.to_pinocchio(x)
            try:
                q, v = self._held.completed(q, v, self._dependent)
            except np.linalg.LinAlgError:
                raise ConstraintError("the constraints are singular") from None
            x = self.state.read(q, v, near=x)
        return x

    def _moved(self, rotation: Array, position: Array, joints: Array) -> Array:
        """Return the state (nx,) at the start after displacements of all coordinates.

        `rotation` (4,) is a quaternion, `position` is (3,), and `joints` is (n,).
        """
        g = self.state.groups
        moved = self.start.copy()
        q_b = moved[g.q_b]
        q0 = np.sqrt(1.0 - float(q_b @ q_b))
        turned = quaternion_product(np.array((*q_b, q0)), rotation)
        moved[g.q_b] = turned[:3] * np.copysign(1.0, turned[3])
        moved[g.r_b] += position
        moved[g.q_m] += joints
        return moved

    def residual(self, starts: Array) -> float:
        """Return the largest distance [m|rad] of states (N, nx) from the constraints."""
        if self._held is None:
            return 0.0
        rows = (self.state.to_pinocchio(x)[0] for x in starts)
        sizes = [np.abs(self._held.constraints.residual(q)).max() for q in rows]
        return float(max(sizes))

    def runs(
        self,
        predicts: bool,
        limits: object,
        joint: float,
        engine: str | None,
        fine: int = 0,
    ) -> CampaignJob:
        """Return a job that simulates the loop from displaced states.

        If `predicts` is true, a run lasts _CONSTANTS time constants, and is compared with the
        linear loop. If `predicts` is false, a run ends when it settles or diverges, or after
        PATIENCE settling times. `joint` is the largest displacement of a joint [rad|m]. `fine` is
        the number of times that the steps are shortened by the factor _FINER.
        """
        lin, decay = self.lin, self.decay
        # `fastest` is the fastest rate in a run. A continuous loop is open only at saturation, so
        # `fastest` is the larger of the open-loop and the closed-loop rates. A sampled loop is open
        # between samples, so `fastest` is twice the fastest open-loop rate. In both cases, the
        # decay rate of the closed loop is also taken into account, by the term 4 * decay in `pace`.
        free = linearize(
            self.robot, lin.q, lin.v, lin.u0, frame=lin.frame, reference=lin.reference
        )
        matrices = [free.A] if lin.dt else [free.A, self.rate]
        poles = [np.linalg.eigvals(matrix) for matrix in matrices]
        factor = 2.0 if lin.dt else 1.0
        fastest = factor * max(float(np.abs(values).max()) for values in poles)
        time_constants = _CONSTANTS if predicts else PATIENCE * math.log(1.0 / SETTLED)
        horizon = time_constants / decay
        pace = max(fastest, 4.0 * decay) * min(max(joint, 1.0), _WIDEST)
        # The step must also be short enough for the damping of all modes.
        limits_of_step = [Poles("robot and the loop", values) for values in poles]
        step = _STEP_PREDICTED if predicts else _STEP
        dt, _ = Pace(limits_of_step, DEFAULT_INTEGRATOR, horizon).step(step / pace)
        every = 1
        if lin.dt:
            every = math.ceil(lin.dt / dt)
            dt = lin.dt / every
        if not horizon / dt <= _MOST_STEPS:
            raise InputError(
                f"the loop's fastest pole is at {fastest:.3g} 1/s and its slowest at {decay:.3g} "
                f"1/s: a run would take {horizon / dt:.3g} steps, expected at most "
                f"{_MOST_STEPS:,}; give a gain with poles of more similar speed, or add damping"
            )
        if predicts and not lin.dt:
            every = max(1, int(horizon / dt / _CHECKS))
        checks = math.ceil(horizon / (dt * every) - 1e-9)
        finer = _FINER**fine
        dt, every = dt / finer, every * finer
        options = {"q0": lin.q, "v0": lin.v, "dt": dt, "duration": dt * every * checks}
        # Without `limits`, inputs do not saturate, and thrusts can be negative.
        options |= {
            "limits": limits,
            "unlimited": limits is None,
            "project": not predicts,
        }
        # The linear loop predicts rotations of less than 180 deg only.
        options |= {"within_chart": True}
        histories = 1
        transition = None
        if predicts:
            histories = checks + 1
            transition = self._transition(dt, every)
        options |= {"histories": histories}
        judge = partial(self._judged, transition)
        over = None if predicts else self._is_over
        return CampaignJob(
            self.robot, self.policy, None, 0, engine, options, judge, over
        )

    def _transition(self, dt: float, every: int) -> Array:
        """Return the transition matrix of the linear loop from one check to the next.

        In a sampled loop, there is one check per sample, and the matrix is A - B K.
        """
        if self.lin.dt:
            return self.rate
        return held_exponential(self.rate, np.zeros((len(self.rate), 0)), dt * every)[0]

    def _is_over(self, first: Array, e: Array) -> Mask:
        """Return the mask (N,) of settled or diverged runs.

        `first` (N, nx) are the initial state errors, and `e` (N, nx) the present state errors.
        """
        first, size = (self.size(states[:, self.model_states]) for states in (first, e))
        over: Mask = (size <= SETTLED * first) | ~(size < DIVERGED * first)
        return over

    def _judged(
        self, step: Array | None, runs: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Return {"outcome": indices (N,) into OUTCOMES, "error": relative prediction errors (N,)}.

        `step` is the transition matrix of the linear loop from one history entry to the next. If
        `step` is None, runs are not compared with the linear loop. The prediction error is NaN if a
        run leaves the chart, diverges or becomes singular.
        """
        e, stop = runs["state_errors"][..., self.model_states], runs["stop"]
        last = self.size(runs["x"][:, self.model_states] - self.lin.x0)
        first = self.size(e[:, 0])
        turned = (stop == STOPS.index("left the chart")) | (
            runs["largest"][:, 0] > EDGE
        )
        diverged = (stop == STOPS.index("diverged")) | ~(last < DIVERGED * first)
        # A run that was stopped, and has neither settled nor diverged, has reached a posture at
        # which the rank of the constraints changes.
        singular = (stop == STOPS.index("stopped")) & (self._held is not None)
        ends = [turned, diverged, last <= SETTLED * first, singular]
        code = np.select(ends, [2, 3, 1, 4], 0)
        apart = np.zeros(len(e))
        if step is not None:
            nx = e.shape[-1]
            integrals = np.zeros((len(e), len(step) - nx))
            predicted = np.hstack((e[:, 0], integrals))
            for now in e.swapaxes(0, 1):
                apart = np.maximum(apart, self.size(now - predicted[:, :nx]))
                predicted = predicted @ step.T
        return {"outcome": code, "error": np.where(code > 1, np.nan, apart / first)}


def settle(
    runs_of: Callable[..., CampaignJob],
    starts: Array,
    how: Execution,
    progress: Progress | None = None,
) -> dict[str, Array]:
    """Return the results of runs; diverging runs are repeated with shorter steps.

    `runs_of(fine=k)` returns a job whose steps have been shortened k times. `starts` (N, nx)
    contains the initial deviations.
    """
    arrays, left = dict[str, Array](), np.arange(len(starts))
    for fine in range(_FINEST + 1):
        shown_progress = None if fine else progress
        results = completed(runs_of(fine=fine), starts[left], how, shown_progress)
        for key, values in results.items():
            arrays.setdefault(key, values)[left] = values
        left = left[results["outcome"] == OUTCOMES.index("diverged")]
        if not len(left):
            break
    return arrays
