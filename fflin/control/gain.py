"""State-feedback gain with its Riccati residual, poles and margins, and its report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from scipy.linalg import block_diag

from fflin.analysis.ranks import DECAY
from fflin.base import html, svg
from fflin.base.errors import FflinError, InputError, listed, require_known
from fflin.base.names import group_of, input_keys, with_units, without_past
from fflin.base.record import Design
from fflin.base.tables import counted, cut, folded, grid, matrix, signals
from fflin.base.validation import Array, Mask, Poles, Values, Vector
from fflin.control.delayed import is_delayed, law_with_memory
from fflin.control.loop_margins import FRAGILE
from fflin.control.optimal.disk import (
    Loop,
    as_continuous,
    disk_gain,
    disk_margin,
    disk_phase,
    largest_scaled_gain,
)
from fflin.control.optimal.largest_gain import gain_crossings
from fflin.control.optimal.riccati import Solution, rates_of
from fflin.control.policy import Policy, System
from fflin.dynamics.coordinates import frame_of
from fflin.dynamics.state import StateMap, selection
from fflin.linear.fit import require_same, require_same_constraints
from fflin.linear.holding import wheel_notes
from fflin.linear.model import ControlSystem, LinearModel, gain_map, state_space
from fflin.robot.rotors import SPINNING

if TYPE_CHECKING:
    import pinocchio as pin

    from fflin.linear.exchange import ToolGain
    from fflin.robot.robot import Robot

# The report omits a gain with more entries than this, which is the number of entries of K for a
# robot with 3 joints and one input for each degree of freedom.
_LARGE = 9 * 18

# A pole of a sampled design with at most this magnitude is shown as zero. Delays cause such poles,
# and rounding errors move them, because they are multiple.
_DEADBEAT = 1e-6

# A gain whose Riccati equation has at most this relative residual has the margins of the optimal
# gain, except for errors that are small compared with them.
_SOLVED = 1e-8


@dataclass(frozen=True, eq=False, repr=False)
class ModelDesign(Design):
    """Design for a linear model ``dx/dt = A x + B u``, or for a sampled model if dt is not 0.

    `urdf_sha256` is the SHA-256 of the URDF of the robot for which the design was made.
    """

    A: Array
    B: Array
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    robot: str
    urdf_sha256: str


@dataclass(frozen=True, eq=False, repr=False)
class Gain(ModelDesign):
    r"""State-feedback gain ``u = u0 - K (x - x0)`` with its residual, poles and margins.

    Attributes
    ----------
    K : ndarray (nu, nx)
        Gain.
    P : ndarray (nx, nx)
        Cost matrix: the optimal cost of the motion from state x is ``(x - x0)' P (x - x0)``.
    poles : ndarray (nz,) of complex
        Eigenvalues of ``A - B K`` over the regulated states: [1/s] for a continuous model,
        discrete-time poles z for a sampled one.
    residual : float
        Norm of the Riccati equation's residual, relative to the sum of the norms of its terms.
    margin : float
        Distance of the poles from the stability boundary: the slowest decay rate [1/s] for a
        continuous model, 1 minus the largest modulus for a sampled model.
    method : str
        Method that computed K: "structured" (eigenproblem of half the usual size), "general"
        (SciPy's Riccati solver) or "closed form" (`acceleration_lqr`).
    A, B, Q, R, N : ndarray
        Matrices of the model, and weights on the deviations x - x0 and u - u0. N is zero if no
        cross weight was given.
    x0 : ndarray (nx,)
    u0 : ndarray (nu,)
        State and inputs at the operating point.
    dt : float
        Sample time [s]; 0 for continuous time.
    state_names, input_names, state_units, input_units : tuple of str
    frame, robot : str
        Frame of the model and name of the robot.
    weights : str
        Description of the rule that set the weights.
    regulated : tuple of str (nz,)
        Names of the states that are fed back; empty if all states are fed back. The entries of K,
        P, Q and N are zero for states that are not fed back.
    placement : ndarray (7,)
        Pose of the model's reference: position [m] and quaternion x, y, z, w.
    delay : ndarray (nu,)
        Delay of the inputs [s] in the model, see `LinearModel.discretize`; zero without a delay.
    integrals : tuple of str (k,)
        Names of the integrals, which are the last entries of `state_names`; empty without integral
        action. All matrices then belong to the model with the integrals as further states, as in
        python-control: ``u = u0 - K [x - x0; xi]``. The integrals xi follow ``d(xi)/dt = H (x -
        x0)``, or ``xi + dt H (x - x0)`` is the next xi of a sampled model.
    urdf_sha256 : str
        SHA-256 of the URDF of the robot that the gain was designed for, see `Robot`.
    dependent : tuple of str (k,)
    dependent_x0 : ndarray (k,)
        For a robot with constraints: the states that the constraints determine, see `LinearModel`,
        and their values at the operating point. The gain does not feed them back.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> gain = fflin.lqr(lin)
    >>> gain.save("gain.json")
    >>> bool((fflin.Gain.load("gain.json").K == gain.K).all()), gain.method
    (True, 'structured')
    >>> float(gain.poles.real.max()) < 0
    True
    """

    _SHAPES = "K:ux P:xx Q:xx R:uu N:xu A:xx B:xu x0:x u0:u state_names:x input_names:u"

    K: Array
    P: Array
    poles: Poles
    residual: float
    margin: float
    method: str
    Q: Array
    R: Array
    N: Array
    x0: Vector
    u0: Vector
    state_units: tuple[str, ...]
    input_units: tuple[str, ...]
    frame: str
    weights: str
    regulated: tuple[str, ...]
    placement: Vector
    # Files of earlier versions contain no delay.
    delay: Vector = field(default_factory=partial(np.zeros, 0))
    integrals: tuple[str, ...] = ()
    dependent: tuple[str, ...] = ()
    dependent_x0: Vector = field(default_factory=partial(np.zeros, 0))
    # The model for which the gain was designed; saved files do not contain it.
    _lin: LinearModel | None = field(default=None, repr=False, compare=False)
    # With default weights: returns the gain whose bandwidth is divided by a factor.
    _slower: Callable[[float], Gain] | None = field(
        default=None, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        if not self.delay.size:
            object.__setattr__(self, "delay", np.zeros(len(self.input_names)))
        super().__post_init__()
        if len(self.delay) != len(self.input_names) or self.delay.min() < 0.0:
            raise InputError(
                f"delay is {self.delay.tolist()}, expected a delay of at least 0 s for each of the "
                f"{len(self.input_names)} inputs"
            )
        states = self.regulated or self.state_names
        require_known("state", states, self.state_names)
        if len(self.dependent) != len(self.dependent_x0):
            raise InputError(
                f"dependent_x0 has {len(self.dependent_x0)} values, expected one for each of the "
                f"{len(self.dependent)} dependent states"
            )
        if self.state_names[self._size :] != self.integrals:
            raise InputError(
                f"the last states are not the integrals {listed(self.integrals)}"
            )
        if not 0 < len(self.poles) <= len(states):
            raise InputError(
                f"{len(self.poles)} poles for {len(states)} regulated states"
            )

    def _report(self) -> str:
        """Return the report with the gain, poles, residual, margins, weights and warnings."""
        nu, nx = self.K.shape
        if self.K.size <= _LARGE:
            shown = f"\n\n{matrix(self.K, self.input_names, self.state_names)}"
        else:
            shown = " is too large to show; save() (-o FILE) writes every entry"
        title = folded(
            [
                summary_of_poles(self),
                self._head(),
                f"x: {with_units(self.state_names, self.state_units)}",
                f"u: {with_units(self.input_names, self.input_units)}",
            ]
        )
        notes = [folded([f"{label}: {text}"]) for label, text in self._notes().items()]
        return "\n\n".join(
            (
                title,
                f"K ({nu} x {nx}){shown}",
                table_of_poles(self, "A - B K"),
                folded([self._figures()]),
                *notes,
            )
        )

    def _html_parts(self) -> list[str]:
        warnings = "; ".join(cautions(self))
        notes = {k: x for k, x in self._notes().items() if k != "warning"}
        lines = [html.paragraph(f"{k}: {x}", "note") for k, x in notes.items()]
        K = gain_map(self.K, self)
        return [
            html.verdict(summary_of_poles(self), self.margin > 0.0),
            html.paragraph(f"warning: {warnings}", "bad") if warnings else "",
            html.paragraph(self._head()),
            html.paragraph(self._figures()),
            html.side_by_side(poles_figure(self, "A - B K"), K),
            folded_poles(self, "A - B K"),
            *lines,
        ]

    def _head(self) -> str:
        """Return one line with the control law, its size, its frame and its sample time."""
        nu, nx = self.K.shape
        time = f"sampled at {self.dt:g} s" if self.dt else "continuous"
        law = f"u = u0 - K (x - x0), {nx} states"
        if self.integrals:
            law = (
                f"u = u0 - K [x - x0; xi], {self._size} states, "
                f"{len(self.integrals)} integrals xi"
            )
        if self.delay.any():
            time += f", delay {_range(self.delay)} s"
        head = f"{self.robot}: {law}, {nu} inputs"
        return f"{head}, frame {self.frame}, {time}"

    def _figures(self) -> str:
        """Return one line with the Riccati residual and the margins."""
        margins = self.margins
        return (
            f"Riccati residual {self.residual:.1e} ({self.method}); margins for simultaneous "
            f"changes of all inputs: gain {margins.gain[0]:.3g} to {margins.gain[1]:.3g}, phase "
            f"{margins.phase:.3g} deg (disk margin {margins.disk:.3g})"
        )

    def _notes(self) -> dict[str, str]:
        """Return the last lines of the report as {label: text}."""
        left = [
            name
            for name in self.state_names
            if self.regulated and name not in self.regulated
        ]
        not_regulated = ""
        if left:
            not_regulated = f"{listed(left)} ({_why_not_regulated(left)})"
        notes = {
            "not regulated": not_regulated,
            "held at the operating point": "; ".join(self._held()),
            "weights": self.weights,
            "warning": "; ".join(cautions(self)),
        }
        return {label: text for label, text in notes.items() if text}

    def _held(self) -> list[str]:
        """Return the inputs at the operating point, and the momentum that wheels gain there."""
        if not self.u0.any():
            return []
        inputs = signals("u0", self.u0, self.input_names, self.input_units)
        notes = [" ".join(inputs.split())]
        if self._lin is not None:
            notes += wheel_notes(self._lin)
        return notes

    @property
    def _size(self) -> int:
        """Number of states of the robot's model, without the integrals."""
        return len(self.state_names) - len(self.integrals)

    @property
    def model_states(self) -> tuple[str, ...]:
        """Names of the states of the robot's model, without the integrals."""
        return self.state_names[: self._size]

    @property
    def K_x(self) -> Array:
        """Gain (nu, nx) of the states of the robot's model."""
        return self.K[:, : self._size]

    @property
    def K_i(self) -> Array:
        """Gain (nu, k) of the integrals."""
        return self.K[:, self._size :]

    @property
    def H(self) -> Array:
        """Matrix (k, nx) whose product with x - x0 is integrated."""
        rows: Array = self.A[self._size :, : self._size]
        return rows / (self.dt or 1.0)

    @property
    def _without_integrals(self) -> StaticLoop:
        """The loop of the regulated states without integrals, with inputs scaled by R."""
        names = [name for name in self.regulated if name not in self.integrals]
        S = selection(names or self.model_states, self.state_names)
        factor = np.linalg.cholesky(self.R)
        return static_loop(
            S @ self.closed_loop @ S.T, S @ self.B, self._H_of(S), factor, self.dt
        )

    def _H_of(self, S: Array) -> Array:
        """Return H for the states that S selects."""
        rows: Array = self.A[self._size :] @ S.T
        return rows / (self.dt or 1.0)

    @property
    def integral_rates(self) -> Values:
        """Rates [1/s] at which the integrals decay if they are slower than the loop.

        They are the eigenvalues of ``G K_i``, where G is the static gain of the loop without
        integrals, from the inputs to the integrated signals.
        """
        if not self.integrals:
            return np.zeros(0, complex)
        static = self._without_integrals.gain @ np.linalg.cholesky(self.R).T
        rates: Values = np.linalg.eigvals(static @ self.K_i).astype(complex)
        return rates

    @property
    def anti_windup(self) -> Array:
        r"""Gain (k, nu) that corrects the integrals if limits change the commands.

        ``anti_windup (u_applied - u)`` is added to d(xi)/dt, or to the next xi of a sampled model.
        The gain is :math:`-K_i^+ / T_a`, with the pseudoinverse in the metric R. :math:`T_a` is the
        slowest time constant of the loop without integrals.
        """
        K_i = self.K_i
        if not K_i.size:
            return np.zeros((0, 0))
        weighted = K_i.T @ self.R
        inverse = np.linalg.solve(weighted @ K_i, weighted)
        rate = 1.0 / self._without_integrals.time
        if self.dt:
            rate = -math.expm1(-rate * self.dt)
        return -rate * inverse

    @property
    def closed_loop(self) -> Array:
        """Closed-loop matrix A - B K (nx, nx)."""
        return self.A - self.B @ self.K

    def to_control(self) -> ControlSystem:
        """Return the law as a `control.StateSpace` from x - x0 to u - u0, with signal names.

        The law is -K; integrals are states of the system.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        InputError
            If two signals differ only by a dot or an underscore, because python-control has no dots
            in names.
        """
        if not self.integrals:
            return state_space(
                ([], [], [], -self.K), self.dt, (), self.state_names, self.input_names
            )
        names = self.integrals, self.model_states, self.input_names
        return state_space(tuple(self.integral_law()[:4]), self.dt, *names)

    def integral_law(self) -> System:
        """Return the law from x - x0 to u - u0, whose states are the integrals.

        Earlier commands, if the model contains them, are also states of the law.
        """
        if is_delayed(self.state_names):
            names = self.state_names, self.input_names
            return law_with_memory(
                self.K, self.A, self.B, self.dt, *names, self.integrals
            )
        k = len(self.integrals)
        A = np.eye(k) if self.dt else np.zeros((k, k))
        B = self.A[self._size :, : self._size]
        names = self.model_states, self.input_names
        return System(A, B, -self.K_i, -self.K_x, self.dt, *names)

    def to(self, tool: str) -> ToolGain:
        """Return the gain, u0 and reference in another tool's coordinates, see `LinearModel.to`.

        Raises
        ------
        InputError
            If the gain was loaded from a file, or its model lacks some states of the robot.
        UnknownNameError
            If there is no such tool.
        """
        from fflin.linear.exchange import tool_gain

        if self.integrals:
            raise InputError(
                "the gain has integrals, which have no coordinates in other tools; convert the "
                "gain of lqr without integral_action, or use gain.to_control()"
            )
        if self._lin is None:
            raise InputError(
                "the gain was read from a file, which does not contain the model; design the "
                "gain again, or compute T_u K T_left with the matrices of lin.to(tool)"
            )
        return tool_gain(self._lin, self.K, tool)

    @cached_property
    def margins(self) -> Margins:
        """Gain and phase margins at the inputs, computed at first access."""
        largest, *_ = largest_scaled_gain(asymmetry(self))
        disk = disk_margin(largest)
        return Margins(disk, disk_gain(disk), disk_phase(disk))


class StaticLoop(NamedTuple):
    """Loop at low frequency: static gain (k, nu), and its slowest time constant [s].

    The gain is from the inputs, scaled by the inverse of `factor`, to the integrated signals.
    """

    gain: Array
    terms: Array  # (k,) sizes of the terms that the rows of `gain` are computed from
    time: float


def static_loop(
    loop: Array, B: Array, H: Array, factor: Array, dt: float
) -> StaticLoop:
    """Return the static gain and the slowest time constant of a closed loop.

    The loop is from its scaled inputs to H x. `loop` (nx, nx) is A - B K, for the sample time dt
    [s], or for continuous time if dt is 0. `factor` (nu, nu) is the lower Cholesky factor of a
    weight of the inputs. The inputs are scaled such that this weight is the identity.
    """
    # Near s = 0, the transfer function is G(s) = gain - s slope. For a first-order loop with the
    # time constant T, slope = T gain. In general, the time constants are the eigenvalues of
    # slope gain^+. For a sampled model, z - 1 replaces s, and the times are in samples.
    # `at_zero_frequency` is s I at s = 0, or z I at z = 1.
    at_zero_frequency = np.eye(len(loop)) if dt else np.zeros_like(loop)
    scaled_B = np.linalg.solve(factor, B.T).T
    static_states = np.linalg.solve(at_zero_frequency - loop, scaled_B)
    gain = H @ static_states
    slope = H @ np.linalg.solve(at_zero_frequency - loop, static_states)
    times = np.linalg.eigvals(slope @ np.linalg.pinv(gain))
    terms = np.abs(H) @ np.linalg.norm(static_states, axis=1)
    return StaticLoop(gain, terms, float(np.abs(times).max()) * (dt or 1.0))


def gain_matrix(gain: object) -> object:
    """Return K of a `Gain` or of a policy with a constant gain, and an array unchanged."""
    if isinstance(gain, Gain):
        return gain.K
    if isinstance(gain, Policy) and gain.feedback_gain is not None:
        return gain.feedback_gain
    return gain


def regulated_states(gain: object) -> tuple[str, ...]:
    """Return the names of the states that a `Gain` regulates, or () for all states."""
    if isinstance(gain, Gain):
        return tuple(name for name in gain.regulated if name not in gain.integrals)
    return ()


def model_of(gain: Gain, robot: Robot, made: str, reference: pin.SE3) -> LinearModel:
    """Linearise a robot at the operating point of a gain, with states relative to `reference`.

    If the robot and the gain have different states or inputs, raise an error whose message begins
    with `made`.
    """
    from fflin.linear.linearization import linearize

    states = without_past(gain.model_states)
    if states != gain.model_states and not gain.delay.any():
        raise InputError(
            f"{made} with delayed inputs by an earlier version, and its file does not contain the "
            "delay; design it again, or linearise the robot in Python and use "
            "fflin.StateFeedback(lin.discretize(dt, delay=...), gain)"
        )
    frame = frame_of(robot, gain.frame)
    state = StateMap(robot, reference=reference, frame=frame)
    count = len(states)
    if robot.constraints or gain.dependent:
        require_same_constraints(
            made, robot, states=count, dependent=bool(gain.dependent)
        )
        return _constrained_model(gain, state, made)
    require_same(made, state, "state", states, gain.state_units[:count])
    require_same(made, state, "input", gain.input_names, gain.input_units)
    q, v = state.to_pinocchio(gain.x0[:count])
    return linearize(robot, q, v, gain.u0, frame=frame, reference=reference)


def _constrained_model(gain: Gain, state: StateMap, made: str) -> LinearModel:
    """Linearise a robot with constraints about the point of a gain, in the states of the gain.

    Constraints without a placement hold their frames in the pose at this point.
    """
    from fflin.linear.linearization import linearize

    states = without_past(gain.model_states)
    units = dict(zip(states, gain.state_units, strict=False))
    values = dict(zip(states, gain.x0.tolist(), strict=False))
    values |= dict(zip(gain.dependent, gain.dependent_x0.tolist(), strict=True))
    names = [name for name in state.names if name in values]
    names += [name for name in values if name not in state.names]
    known = dict(zip(state.names, state.units, strict=True))
    units_of_all = tuple(units.get(name, known.get(name, "")) for name in names)
    require_same(made, state, "state", tuple(names), units_of_all)
    require_same(made, state, "input", gain.input_names, gain.input_units)
    q, v = state.to_pinocchio(np.array([values[name] for name in state.names]))
    independent = states[: len(states) // 2]
    _require_closed(made, state, q)
    try:
        return linearize(
            state.robot,
            q,
            v,
            gain.u0,
            frame=state.frame,
            reference=state.reference,
            independent=independent,
        )
    except FflinError as error:
        raise InputError(
            f"{made} with {len(independent)} independent coordinates, which do not describe the "
            "given robot with its constraints; give the robot with the constraints of the gain, "
            f"or make the gain again ({error})"
        ) from error


def _require_closed(made: str, state: StateMap, q: Array) -> None:
    """Raise `InputError` if the constraints of a robot hold other poses than at q (nq,).

    The message begins with `made`.
    """
    from fflin.dynamics.closure import NEAR, Closure

    closure = Closure(state)
    closure.constraints.settle(q)
    distance, off = closure.distance(q)
    if distance > NEAR:
        raise InputError(
            f"{made} at a posture where the given robot is off {off}; this constraint closed in "
            "another posture, or is not one of the constraints of the gain; design the gain where "
            "the constraint closes, by fflin.lqr at that q or by `fflin lqr --after FILE` with the "
            "motion before it"
        )


def sampled_for(gain: Gain, lin: LinearModel) -> LinearModel:
    """Return a continuous model, sampled with the sample time and the delays of a gain."""
    if not gain.dt:
        return lin
    delays = dict(zip(input_keys(lin), gain.delay.tolist(), strict=True))
    return lin.discretize(gain.dt, delay=delays)


def _range(delays: Array) -> str:
    """Return the least and the largest delay, or one number if both are equal."""
    least, largest = float(delays.min()), float(delays.max())
    if least == largest:
        return f"{largest:g}"
    return f"{least:g} to {largest:g}"


def make_gain(
    lin: LinearModel,
    part: LinearModel,
    solution: Solution,
    Q: Array,
    R: Array,
    N: Array,
    weights: str = "as given",
    *,
    integrals: Integrals | None = None,
) -> Gain:
    """Return the gain of `lin` from the Riccati solution of `part`.

    `part` is `lin`, or a model with only some of the states of `lin`. The gain of the other states
    is zero. With `integrals`, the solution and the weights are of the extended model.
    """
    S = selection(part.state_names, lin.state_names)
    more: dict[str, object] = {}
    names: tuple[str, ...] = ()
    if lin.dependent and lin._robot is not None:
        state = StateMap(lin._robot, reference=lin.reference, frame=lin.frame)
        x0 = dict(zip(state.names, state.read(lin.q, lin.v).tolist(), strict=True))
        more = {
            "dependent": lin.dependent,
            "dependent_x0": np.array([x0[name] for name in lin.dependent]),
        }
    if integrals is not None:
        names = integrals.names
        S = block_diag(S, np.eye(len(names)))
        more |= {
            "A": integrals.A,
            "B": integrals.B,
            "x0": np.concatenate((lin.x0, np.zeros(len(names)))),
            "state_names": (*lin.state_names, *names),
            "state_units": (*lin.state_units, *integrals.units),
            "integrals": names,
        }
    return Gain._of(
        solution,
        lin,
        K=solution.K @ S,
        P=S.T @ solution.P @ S,
        Q=S.T @ Q @ S,
        R=R,
        N=S.T @ N,
        weights=weights,
        regulated=(*part.state_names, *names),
        _lin=lin,
        **more,
    )


class Integrals(NamedTuple):
    """Names and units of integrals, and A and B of the model with the integrals as states."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    A: Array
    B: Array


def cautions(gain: Gain) -> list[str]:
    """Return warnings about a small disk margin at the inputs, and about negative thrust."""
    messages: list[str] = []
    if _may_be_fragile(gain) and gain.margins.disk < FRAGILE:
        remedy = "give a diagonal R, such as the R of the default weights"
        if gain.dt:
            remedy = "shorten dt, or slow the loop as the default weights do"
        messages.append(f"{fragility(gain.margins)}; {remedy}")
    keys = zip(input_keys(gain), gain.input_names, gain.K, gain.u0, strict=True)
    thrusters = [
        name
        for key, name, row, at in keys
        if group_of(key) == "thrust" and row.any() and at <= 0.0
    ]
    if thrusters:
        messages.append(
            f"the gain commands negative thrust ({listed(thrusters)}), which is cut at zero, so "
            "the poles and margins do not hold; design with torque and force on the base, and "
            "allocate them to the thrusters with fflin.Allocation. `fflin lqr` and `fflin "
            "simulate` do so by default if the thrusters can push in every direction"
        )
    if stopped := _stopped_rotors(gain):
        messages.append(
            f"the operating point moves {listed(stopped)}, which cannot spin forever, because it "
            "has position limits; the gain regulates its angle and so stops it; remove the limits "
            "(type continuous in the URDF) to fly it as a wheel"
        )
    return messages


def fragility(margins: Margins) -> str:
    """Return a warning about a small disk margin at the inputs of a loop."""
    if not margins.disk:
        return "the loop is unstable"
    return (
        f"the phase margin at the inputs is only {margins.phase:.2g} deg (disk margin "
        f"{margins.disk:.2g}, below {FRAGILE:g}): a small delay or model error makes the loop "
        "unstable"
    )


def _why_not_regulated(names: list[str]) -> str:
    """Return the reasons why a gain does not regulate the named states."""
    of_base = [name for name in names if name.startswith(("r_b.", "v_b."))]
    angles = [name for name in names if name.startswith("q_m.")]
    reasons = list[str]()
    if of_base:
        reasons.append("no input pushes the base there")
    if angles:
        reasons.append("the angle of a wheel has no effect on the motion")
    if len(of_base) + len(angles) < len(names):
        reasons.append(
            "no input reaches these wheel speeds, or other states determine them; "
            "wheel_speeds=True (--wheel-speeds) regulates all controllable wheel speeds"
        )
    return "; ".join(reasons)


def _stopped_rotors(gain: Gain) -> list[str]:
    """Return the names of rotors that move at the operating point but are regulated in angle."""
    lin = gain._lin
    if lin is None:
        return []
    speeds = dict(zip(lin.state_names, np.abs(lin.x0).tolist(), strict=True))
    angles = [x for x in lin.ignorable if x.startswith("q_m.") and x in gain.regulated]
    rotors = [x.removeprefix("q_m.") for x in angles]
    return [x for x in rotors if speeds.get(f"qdot_m.{x}", 0.0) > SPINNING]


class HasPoles(Protocol):
    """Design with poles: [1/s] in continuous time, z for a sample time dt [s]."""

    @property
    def poles(self) -> Poles:
        """Poles (nz,)."""

    @property
    def dt(self) -> float:
        """Sample time [s]; 0 for continuous time."""


def summary_of_poles(design: HasPoles) -> str:
    """Return the number of poles, the slowest decay and the smallest damping ratio.

    Neutral poles are counted separately.
    """
    if not len(design.poles):
        return "no poles"
    rates = rates_of(design.poles, design.dt)
    moving = ~neutral_poles(rates, design.dt)
    count = f"{len(rates)} poles"
    neutral = rates[~moving]
    if len(neutral):
        decay = max(-neutral.real.min(), 0.0)
        rounding = _smallest_decay(rates, design.dt)
        count += (
            f", {len(neutral)} of them neutral (decay {decay:.2g} 1/s, within the rounding "
            f"error of {rounding:.2g} 1/s)"
        )
    if not moving.any():
        return count
    others = rates[moving]
    damping = float((-others.real / np.abs(others)).min())
    label = "slowest decay"
    if len(neutral):
        label += " of the others"
    return (
        f"{count}, {label} {-others.real.max():.3g} 1/s, smallest damping ratio "
        f"{damping:.2g}"
    )


def neutral_poles(rates: Values, dt: float) -> Mask:
    """Return which poles (n,), given as rates [1/s], neither decay nor grow.

    Rounding errors may cause the decay of these poles. `dt` is the sample time [s], or 0.
    """
    neutral: Mask = np.abs(rates.real) <= _smallest_decay(rates, dt)
    return neutral


def _smallest_decay(rates: Values, dt: float) -> float:
    """Return the smallest decay [1/s] that exceeds rounding errors, for rates [1/s]."""
    if dt:
        return DECAY / dt
    return DECAY * float(np.abs(rates).max(initial=0.0))


def table_of_poles(design: HasPoles, matrix: str) -> str:
    """Return a table of the poles of a matrix, slowest first.

    A conjugate pair or a multiple pole has one row.
    """
    if not len(design.poles):
        return f"{matrix} has no poles"
    parts = [f"poles of {matrix}, slowest first", grid(cut(_pole_rows(design)), "l")]
    if deadbeat := int(_at_zero(design).sum()):
        parts.append(_of_delay(deadbeat))
    return "\n\n".join(parts)


def folded_poles(design: HasPoles, matrix: str) -> str:
    """Return the table of the poles of a matrix in HTML, which the reader can open."""
    if not len(design.poles):
        return ""
    table = html.table(cut(_pole_rows(design), "see poles"), "l")
    if deadbeat := int(_at_zero(design).sum()):
        table += html.paragraph(_of_delay(deadbeat))
    return html.folded(f"poles of {matrix}, slowest first", table)


def _at_zero(design: HasPoles) -> Mask:
    """Return which poles of a sampled design are zero, as those of delays are.

    The result is false for all poles if all are zero, because the table has no other rows.
    """
    zero: Mask = np.abs(design.poles) < _DEADBEAT
    if not design.dt or zero.all():
        zero = np.zeros(len(zero), dtype=bool)
    return zero


def _of_delay(count: int) -> str:
    """Return a line on poles at zero."""
    return f"{counted(count, 'pole')} at zero (delay)"


def poles_figure(design: HasPoles, matrix: str) -> str:
    """Return a map of the poles of a matrix in HTML."""
    return svg.figure(f"poles of {matrix}", svg.pole_map(design.poles, design.dt))


def _pole_rows(design: HasPoles) -> list[list[str]]:
    """Return a table of the poles, slowest first, without the poles of delays."""
    poles = design.poles[(design.poles.imag >= 0.0) & ~_at_zero(design)]
    rates = rates_of(poles, design.dt)
    pole_title = "pole" if design.dt else "pole [1/s]"
    heads = [pole_title, "frequency [rad/s]", "damping", "times"]
    rows = Counter[tuple[str, ...]]()
    for k in np.argsort(-rates.real):
        pole, rate = poles[k], rates[k]
        shown = f"{pole.real:.5g}"
        if pole.imag:
            shown += f" +- {pole.imag:.5g}i"
        rows[shown, f"{abs(rate):.4g}", f"{-rate.real / abs(rate):.4g}"] += 1
    table = [heads, *([*row, f"{count}"] for row, count in rows.items())]
    if max(rows.values()) == 1:
        table = [row[:-1] for row in table]
    return table


def asymmetry(gain: Gain) -> Loop:
    """Return the loop from changes of the inputs to (S - T)/2, in continuous time.

    S and T are the sensitivity and the complementary sensitivity at the inputs, which are scaled by
    sqrt(R_ii). The inverse of the largest gain of the loop is a lower bound of the disk margin.
    With the best scaling for each frequency, it is the disk margin. See Seiler, Packard and
    Gahinet, IEEE Control Systems 40(5), 2020.
    """
    S = _regulated(gain)
    scale = np.sqrt(gain.R.diagonal())
    if is_delayed(gain.state_names):
        return _remembered_asymmetry(gain, S, scale)
    F = S @ gain.closed_loop @ S.T
    G = S @ gain.B / scale
    H = -scale[:, None] * gain.K @ S.T
    return as_continuous(F, G, H, 0.5 * np.eye(len(H)), gain.dt)


def _remembered_asymmetry(gain: Gain, S: Array, scale: Array) -> Loop:
    """Return the loop of `asymmetry` for a model with delayed inputs.

    The law remembers its own commands, and not the changed inputs, which are on their way in the
    plant.
    """
    A = S @ gain.A @ S.T
    B = S @ gain.B
    names = gain.regulated or gain.state_names
    law = law_with_memory(gain.K @ S.T, A, B, gain.dt, names, gain.input_names)
    measured = selection(law.inputs, names)
    D = law.D @ measured
    memory = law.B @ measured
    F = np.block([[A + B @ D, B @ law.C], [memory, law.A]])
    unaffected = np.zeros((len(law.A), B.shape[1]))
    G = np.vstack((B, unaffected)) / scale
    H = scale[:, None] * np.hstack((D, law.C))
    return as_continuous(F, G, H, 0.5 * np.eye(len(H)), gain.dt)


def _regulated(gain: Gain) -> Array:
    """Return the matrix that selects the regulated states from all states."""
    return selection(gain.regulated or gain.state_names, gain.state_names)


def _may_be_fragile(gain: Gain) -> bool:
    """Return whether the disk margin may be below FRAGILE.

    Both conditions below exclude it, and are quicker than the margin itself.
    """
    if guaranteed_margin(gain) >= FRAGILE and not is_delayed(gain.state_names):
        return False
    F, G, H, D = asymmetry(gain)
    bound = 1.0 / FRAGILE
    if np.linalg.norm(D, 2) >= bound:
        return True
    _, on_axis = gain_crossings(F, G, H, D, bound)
    return bool(on_axis.any())


def guaranteed_margin(gain: Gain) -> float:
    """Return a lower bound on the disk margin, which follows from the weights and P alone.

    Let L be the loop gain at the inputs, let S = (I + L)^-1 be the sensitivity, and let W be R in
    continuous time and R + B' P B for a sampled system. At every frequency, Kalman's equality and
    the weights imply (I + L)* W (I + L) >= R - N' Q^-1 N. This bounds the largest singular value of
    S. The disk margin is at least 1 / (|S| + 1/2). See Safonov and Athans, IEEE Trans. Automatic
    Control 22(2), 1977. The inputs are scaled by sqrt(R_ii).
    """
    if gain.residual > _SOLVED:
        return 0.0
    scale = np.sqrt(gain.R.diagonal())
    least = gain.R
    if gain.N.any():
        S = _regulated(gain)
        try:
            factor = np.linalg.cholesky(S @ gain.Q @ S.T)
        except np.linalg.LinAlgError:
            return 0.0
        root = np.linalg.solve(factor, S @ gain.N)
        least = least - root.T @ root
    W = gain.R
    if gain.dt:
        W = W + gain.B.T @ gain.P @ gain.B
    with np.errstate(over="ignore", invalid="ignore"):
        least, W = (X / np.outer(scale, scale) for X in (least, W))
    if not np.isfinite(least + W).all():
        return 0.0
    lowest = float(np.linalg.eigvalsh(least)[0])
    highest = float(np.linalg.eigvalsh(W)[-1])
    if lowest <= 0.0:
        return 0.0
    return 1.0 / (math.sqrt(highest / lowest) + 0.5)


class Margins(NamedTuple):
    """Margins of gain and phase for simultaneous changes of all inputs.

    Attributes
    ----------
    disk : float
        Symmetric disk margin, at most 2; 0 at the stability boundary.
    gain : tuple of float
        Least and largest gain factor. The loop is stable if the factors at all inputs are between
        them.
    phase : float
        Phase margin [deg]. The loop is stable if the phase lag or lead at each input is smaller.
    """

    disk: float
    gain: tuple[float, float]
    phase: float
