"""Policies that compute the inputs: state feedback about a point, and allocation."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.validation import Array, Vector, frozen, instance, shaped
from fflin.control.channel import Law
from fflin.control.delayed import is_delayed, law_with_memory
from fflin.control.dipole_error import note_on_dipole
from fflin.control.following import Following
from fflin.control.gain import Gain
from fflin.control.loops import (
    NOT_CORRECTED,
    Loop,
    PredictedLaw,
    Sample,
    StateMeasuring,
)
from fflin.control.policy import (
    BoundLaw,
    Command,
    Form,
    Noise,
    OutputForm,
    Policy,
    Predictor,
    Reference,
    StateForm,
    System,
    as_policy,
    block_of_feedback,
    bound,
    loop_matrix,
    states_of_gain,
    unstable_note,
)
from fflin.control.sensed_laws import sensed
from fflin.control.sensors import SensorTiming, timing_of_robot
from fflin.dynamics.coordinates import LINEAR, Chart, Frame
from fflin.dynamics.integrators import held_exponential
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import Actuation, StateMap, selection
from fflin.dynamics.state_rows import readout
from fflin.kernel.allocation import LIGHT, nearest, nearest_unbounded
from fflin.linear.fit import about_point, require_configuration_size, require_fit
from fflin.linear.holding import held_if_possible, wheel_notes
from fflin.linear.model import LinearModel, gain_map
from fflin.linear.trajectory import Trajectory
from fflin.robot.fields import input_limits, limits_of
from fflin.robot.inputs import BaseForce, JointTorque, Thruster
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from typing import Self

# Function of t, q and v that returns the reference inputs u*, and the error e relative to the
# reference.
Deviation: TypeAlias = Callable[[float, Array, Array], tuple[Array, Array]]


class Feedback(Policy):
    """Feedback of the state or of the outputs, about an operating point or along a trajectory."""

    lin: LinearModel

    @property
    def model(self) -> LinearModel | None:
        """Model about whose operating point the law acts."""
        return self.lin

    def state_map(self, robot: Robot) -> StateMap:
        """Return the robot's state map in the model's axes.

        Raise `InputError` if the model does not fit the robot.
        """
        state = StateMap(robot, reference=self.lin.reference, frame=self.lin.frame)
        require_fit(self.lin, robot, state)
        return state

    def deviation(self, robot: Robot) -> Deviation:
        """Return the function of t, q, v that returns the reference inputs u* and the error e."""
        lin = self.lin
        state = self.state_map(robot)
        S, x0 = self._robot_part(state)
        near = S.T @ x0
        return lambda _, q, v: (lin.u0, S @ state.read(q, v, near=near) - x0)

    def _robot_part(self, state: StateMap) -> tuple[Array, Array]:
        """Return the matrix that selects the model's states of a robot, and their values x0."""
        names = self.lin.robot_states
        return selection(names, state.names), self.lin.x0[: len(names)]


class OutputSensing(Policy):
    """Policy whose sensors are the outputs of the robot, with measurement noise."""

    senses_outputs: ClassVar[bool] = True

    noise: Noise | None

    @property
    def measurement_noise(self) -> Noise | None:
        """The function noise(t)."""
        return self.noise

    def with_sensor_errors(self, error: Callable[[float], Array]) -> Policy:
        """Return the law with other measurement noise."""
        noisy = copy(self)
        noisy.noise = error
        return noisy


def at_samples(terms: Sequence[Sample], dt: float) -> Callable[[float], Sample]:
    """Return a function of time [s] that returns the law at a sample; the samples repeat."""
    return lambda t: terms[round(t / dt) % len(terms)]


class PointLaw(Feedback):
    """Linear law about a point, whose matrices may repeat after some samples."""

    noise: Noise | None = None

    @abstractmethod
    def terms_of_period(self) -> list[Sample]:
        """Return the matrices and offsets for each sample of the period."""

    @property
    def designed_timing(self) -> SensorTiming | None:
        """Sample times and delays that the sensors must have; None if they may be any."""
        return None

    def follow(self, trajectory: Trajectory) -> Following:
        """Return the law that follows a trajectory: u = u*(t) + law(y - y*(t)).

        The law must be sampled, and is designed about a point at rest. u*(t) are the inputs of the
        trajectory, and y*(t) its outputs, or its states for a `StateFeedback`. Positions and
        attitudes are measured relative to the base pose of the trajectory, so a slew may have any
        angle. Each command u* is the mean input of the trajectory during the sample in which it
        acts.

        After the end of the trajectory, the law holds its last configuration at rest. Only wheels
        keep their speeds. If the inputs are delayed, the robot waits at the start for the longest
        delay, so that each input of the trajectory acts at its time.

        Outputs may have their own sample times and delays. A late or held measurement is compared
        with the trajectory at the time of the measurement.

        The law keeps the matrices about its point. They fit a trajectory if the trajectory's rates
        are small compared with the bandwidth of the law, and if the joints stay near the point. For
        other trajectories, use `tvlqr` and `tvkalman`.

        A robot with flexible appendages or slosh also follows the trajectory of the same robot
        without them, or with these joints locked. The reference of the deflections is then their
        value at the operating point. The inputs of such a trajectory excite the modes, which the
        law must damp. A trajectory of the flexible robot itself leaves much smaller errors.

        Parameters
        ----------
        trajectory : Trajectory
            Trajectory for the same states, inputs and outputs as the model of the law, such as the
            result of `plan`. It may lack springs without motors, and inputs. Thrusts become the
            base torque and the base force of the model.

        Returns
        -------
        Policy
            Policy for `simulate` and campaigns. In Python and in compiled code, it keeps the
            estimates, integrals and earlier commands of the law.

        Raises
        ------
        InputError
            If the law is continuous, its base is displaced or moves at the operating point, the
            robot of the trajectory has other signals, or no inputs hold the robot at the end. Also
            if the trajectory lacks springs, and its robot has another inertia than the robot of the
            model without deflection, or the latter has accelerometers. Also
            if inputs are delayed and the base moves at the start of the trajectory, or the outputs
            of the robot have other sample times or delays than the design of a `MultirateFeedback`.
        """
        return Following(
            self, self.terms_of_period(), trajectory, self.noise, self.designed_timing
        )


class LinearLaw(PointLaw):
    r"""Linear law with a state z, from measured outputs or states to the inputs.

    .. math:: \dot z = A z + B (y - y_0) + E (u_a - u),\qquad u - u_0 = C z + D (y - y_0)

    Here :math:`u_a` are the inputs after limits are applied. For a sampled law, the first equation
    gives the next z. If `senses_outputs` is false, y is the state x of the model. Subclasses set
    `system`, which contains A to D, and `windup`, which is E (nz, nu) or empty.
    """

    system: System
    windup: Array = NOT_CORRECTED

    @property
    def is_gain(self) -> bool:
        """Whether the law is a gain of the states, without memory."""
        return not (self.senses_outputs or len(self.system.A))

    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot; each call returns a policy with its own z.

        Raises
        ------
        InputError
            If the robot has other states, inputs or measured outputs than the model. Masses may
            differ.
        """
        if self.is_gain:
            state = self.state_map(robot)
            return readout(state, *self._gain_terms(state))
        return self._loop(robot)

    def form(self, robot: Robot) -> Form | None:
        """Return the law as data for the compiled loop."""
        if self.is_gain:
            K, offset, x0 = self._gain_terms(self.state_map(robot))
            return StateForm(offset[None], K[None], x0, {})
        if self.noise is not None and not self.senses_outputs:
            return None
        state = self.state_map(robot)
        terms = self._periodic_terms(state)
        if len(terms) == 1:
            return OutputForm(self._loop(robot), lambda _: terms[0], None)
        return OutputForm(
            self._loop(robot),
            at_samples(terms, self.sample_time),
            len(terms),
            len(terms),
        )

    def _periodic_terms(self, state: StateMap) -> list[Sample]:
        """Return the law in series with the sensors of a robot, for each sample of a period."""
        terms = [self._terms_of(state)]
        if not self.senses_outputs:
            return terms
        return sensed(terms, timing_of_robot(state, self.sample_time))

    def _gain_terms(self, state: StateMap) -> tuple[Array, Array, Array]:
        """Return K and offset of the law u = offset - K x for a robot's full state x, and x0."""
        lin = self.lin
        K = -self.system.D
        S, x0 = self._robot_part(state)
        return K @ S, lin.u0 + K @ x0, S.T @ x0

    def _loop(self, robot: Robot) -> Loop:
        """Return the command of a law with memory or of measured outputs."""
        lin = self.lin
        state = self.state_map(robot)
        terms = self._terms_of(state)
        noise = self.noise
        measure: Measuring | StateMeasuring
        if self.senses_outputs:
            require_fit(lin, robot, state, sensed=True)
            measure = Measuring(state, lin.q)
            near = state.read(lin.q, lin.v)
        else:
            measure = StateMeasuring(state)
            near = terms.y0
            noise = self._state_noise(state)
        always = terms.step, measure, near
        windup = (lambda _: terms.E) if terms.E.size else None
        return Loop(
            state,
            self.sample_time,
            terms.B.shape,
            lambda _: always,
            noise,
            measures_state=not self.senses_outputs,
            windup=windup,
            start=terms.y0,
        )

    def _state_noise(self, state: StateMap) -> Noise | None:
        """Return the errors of a robot's full state, from the errors of the model's states."""
        noise = self.noise
        if noise is None:
            return None
        S, _ = self._robot_part(state)
        return lambda t: S.T @ np.asarray(noise(t))

    def _terms_of(self, state: StateMap) -> Sample:
        """Return the matrices for the measured outputs, or for the full state of a robot."""
        terms = self.terms()
        if self.senses_outputs:
            return terms
        S, _ = self._robot_part(state)
        return terms._replace(B=terms.B @ S, D=terms.D @ S, y0=S.T @ terms.y0)

    @property
    def sample_time(self) -> float:
        """Sample time [s]; 0 in continuous time."""
        return self.system.dt or 0.0

    def linear_law(self) -> System | None:
        """Return the law from deviations of its sensors to u - u0."""
        return self.system

    def closed_loop(self) -> tuple[Array, float] | None:
        """Return the closed-loop matrix of the model's state and z, and dt [s]."""
        return self.loop, self.sample_time

    def loop_around(self, sample: float) -> Callable[[LinearModel], Array] | None:
        """Return the function from a sampled model to its closed-loop matrix."""
        return self.sampled(sample).loop_with

    def held_for(self, seconds: float) -> Policy:
        """Return the law, sampled if it is continuous."""
        return self.sampled(seconds)

    def terms(self, _: float = 0.0) -> Sample:
        """Return the matrices and offsets, which are the same at all times."""
        lin = self.lin
        A, B, C, D = self.system[:4]
        y0 = lin.y0 if self.senses_outputs else lin.x0[: len(lin.robot_states)]
        return Sample(A, B, C, D, lin.u0, y0, E=self.windup)

    def terms_of_period(self) -> list[Sample]:
        """Return the matrices and offsets of the only sample."""
        return [self.terms()]

    def prediction(self, lin: LinearModel, state: StateMap) -> Predictor | None:
        """Return the predictor of the closed loop with the model `lin`."""
        if self.is_gain:
            K, constant, _ = self._gain_terms(state)
            nx = K.shape[1]
            at_point = constant - K @ lin.x0[:nx]
            return lin, lambda e: at_point - K @ e[:nx]
        if not self.sample_time:
            both, gains, offset = self.around(lin)
            return both, lambda e: offset + gains @ e
        C, D, y0 = self._measured(lin)
        terms = [self.terms()]
        if self.senses_outputs:
            terms = sensed(terms, timing_of_robot(state, self.sample_time))
        return lin, PredictedLaw(terms, lambda e, u: y0 + C @ e + D @ (u - lin.u0))

    def _measured(self, lin: LinearModel) -> tuple[Array, Array, Array]:
        """Return C, D and y0 of the values that the law measures of a model."""
        if self.senses_outputs:
            return lin.C, lin.D, lin.y0
        n = len(lin.robot_states)
        return np.eye(n, len(lin.A)), np.zeros_like(lin.B[:n]), lin.x0[:n]

    def around(self, lin: LinearModel) -> tuple[LinearModel, Array, Array]:
        """Return the model with the law's states added, and K and u of the law u + K e.

        e contains the errors x - x0 of the model, and the states z of the law. The inputs of the
        returned model are the limited inputs, which also drive the anti-windup.
        """
        A, B, C, D, u0, y0, _, E = self.terms()
        measured, through, values = self._measured(lin)
        # y - y0 = measured (x - x0) + through (u_a - lin.u0) + apart
        apart = values - y0
        gains = np.hstack((D @ measured, C))
        offset = u0 + D @ apart
        none = np.zeros((len(lin.A), len(A)))
        rows = np.hstack((B @ measured, A))
        inputs, drift = B @ through, B @ apart
        if E.size:
            # Add E (u_a - u), where u_a are the inputs of the model and u = offset + gains e.
            rows = rows - E @ gains
            inputs = inputs + E
            drift = drift - E @ (offset - lin.u0)
        both = replace(
            lin,
            A=np.vstack((np.hstack((lin.A, none)), rows)),
            B=np.vstack((lin.B, inputs)),
            f0=np.concatenate((lin.f0, drift)),
            x0=np.concatenate((lin.x0, np.zeros(len(A)))),
        )
        return both, gains, offset

    @property
    def loop(self) -> Array:
        """Closed-loop matrix (nx + nz, nx + nz) of the states of model and law."""
        lin = self.lin
        if self.sample_time and not lin.dt:
            lin = lin.discretize(self.sample_time)
        return self.loop_with(lin)

    def loop_with(self, lin: LinearModel) -> Array:
        """Return the closed-loop matrix of the law and another model with its signals."""
        measured, through, _ = self._measured(lin)
        return loop_matrix(self.system, System(lin.A, lin.B, measured, through))

    def sampled(self, dt: float) -> Self:
        """Return the law sampled at dt [s]; a sampled law is unchanged."""
        A, B, *_ = self.system
        if self.sample_time or not len(A):
            return self
        width = B.shape[1]
        driven = np.hstack((B, self.windup)) if self.windup.size else B
        A, driven = held_exponential(A, driven, dt)
        law = copy(self)
        law.system = self.system._replace(A=A, B=driven[:, :width], dt=dt)
        if self.windup.size:
            law.windup = driven[:, width:]
        return law


@dataclass(eq=False, repr=False)
class StateFeedback(LinearLaw):
    """State feedback ``u = u0 - K (x - x0)`` about the operating point of a model.

    Of a model with delayed inputs, see `LinearModel.discretize`, x contains earlier commands. The
    law remembers them, as they are after limits are applied.

    The angle of a continuous joint is unwrapped, so that it differs from x0 by at most half a turn.

    Parameters
    ----------
    lin : LinearModel
        Model that K was designed for. With a reduced model, only the states of the reduced model
        are fed back. If its point is not a fixed point, but inputs can hold the robot there, u0 is
        these inputs, as in `lqr`.
    K : array_like (nu, nx) or Gain
        Gain. A `Gain` with integral action gives ``u = u0 - K (x - x0) - K_i xi``, with integrals
        xi that are zero at the start. If limits change the commands, ``Gain.anti_windup`` corrects
        the integrals.

    Raises
    ------
    InputError
        If K has a wrong shape or was designed for another model, or the model is about a moving
        reference (``moving=True``).

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> q0 = fflin.configuration(robot, {"joint_1": 0.3})
    >>> fflin.simulate(robot, policy, q0=q0, duration=1.0).u.shape[1]
    9
    """

    lin: LinearModel
    K: Any  # array (nu, nx) once the policy is made

    def __post_init__(self) -> None:
        hint = (
            " (nu, nx); give the gain that was designed for this model. A gain with integral "
            "action must be given itself, not its matrix gain.K"
        )
        gain = self.K
        K = gain
        if isinstance(gain, Gain):
            _require_designed_for(gain, self.lin)
            K = gain.K_x
        self.K = frozen(shaped("K", K, about_point(self.lin).B.shape[::-1], hint))
        self.lin = lin = held_if_possible(self.lin)
        self.system = law_with_memory(
            self.K, lin.A, lin.B, lin.dt, lin.state_names, lin.input_names
        )
        if lin.added:
            # The law remembers the inputs after limits are applied.
            self.windup = lin.B[len(lin.robot_states) :]
        self.integrals: tuple[str, ...] = ()
        if isinstance(gain, Gain) and gain.integrals:
            self.integrals = gain.integrals
            self.system = gain.integral_law()
            past = self.windup.reshape(-1, len(lin.u0))
            self.windup = np.vstack((past, gain.anti_windup))

    def __repr__(self) -> str:
        nu, nx = self.K.shape
        time = f"dt={self.lin.dt:g} s" if self.lin.dt else "continuous"
        more = f" integrals={len(self.integrals)}," if self.integrals else ""
        return f"StateFeedback('{self.lin.robot}', nx={nx}, nu={nu},{more} {time})"

    def _repr_html_(self) -> str:
        return html.result_card(self, gain_map(self.K, self.lin))

    @property
    def notes(self) -> tuple[str, ...]:
        """Note on the momentum that wheels gain while they hold the robot at the point."""
        return wheel_notes(self.lin)

    def of_part(self, part: LinearModel) -> Self:
        """Return the feedback of the states of a reduced model, which contains all fed-back states.

        `part` contains some of the states of `lin`.
        """
        S = selection(part.state_names, self.lin.state_names)
        law = copy(self)
        law.lin = part
        law.K = self.K @ S.T
        law.system = self.system._replace(
            B=self.system.B @ S.T, D=self.system.D @ S.T, inputs=part.state_names
        )
        return law

    @property
    def feedback_gain(self) -> Array | None:
        """The gain K, or None if the law also has integrals."""
        return self.K if self.is_gain else None

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the states of the robot in the model."""
        return self.lin.robot_states

    @property
    def fed_back(self) -> tuple[str, ...]:
        """Names of the states that the law feeds back or integrates."""
        used = np.vstack((self.system.D, self.system.B))
        return states_of_gain(self.lin.robot_states, used)

    def loop_notes(self, held: float = 0.0) -> tuple[str, ...]:
        """Return notes on unstable poles of the linear loop."""
        if self.is_gain:
            return super().loop_notes(held)
        A, B, C, D = self.system[:4]
        loop = self.loop
        # The law does not measure the commands that are on their way in the plant.
        unmeasured = len(loop) - len(A) - D.shape[1]
        D, B = (np.pad(matrix, ((0, 0), (0, unmeasured))) for matrix in (D, B))
        used = np.block([[D, C], [B, np.eye(len(A))]])
        part = loop[block_of_feedback(loop, used)]
        return unstable_note("linear loop", part, self.sample_time, "")

    def with_sensor_errors(self, error: Callable[[float], Array]) -> Policy:
        """Return the feedback of states with errors."""
        if self.is_gain:
            return _Erring(self, error)
        noisy = copy(self)
        noisy.noise = error
        return noisy


def _require_designed_for(gain: Gain, lin: LinearModel) -> None:
    """Raise `InputError` if a gain was designed for a model with other signals or another point."""
    same = {
        "states": gain.model_states == lin.state_names,
        "inputs": gain.input_names == lin.input_names,
        "sample time": bool(np.isclose(gain.dt, lin.dt)),
        "delay": _is_same_delay(gain, lin),
        "frame": gain.frame == lin.frame,
        "point": len(gain.model_states) == len(lin.x0)
        and bool(np.allclose(gain.x0[: len(lin.x0)], lin.x0, atol=1e-9)),
        "reference": bool(np.allclose(gain.placement, lin.placement, atol=1e-9)),
    }
    different = [name for name, agrees in same.items() if not agrees]
    if different:
        raise InputError(
            f"the gain was designed for a model of '{gain.robot}' with another {different[0]} than "
            "the given model; give the model of the gain, or its matrix gain.K"
        )


def _is_same_delay(gain: Gain, lin: LinearModel) -> bool:
    """Return whether a gain and a model have the same delays.

    Gains from files of earlier versions contain no delay, so that theirs may be any.
    """
    if not gain.delay.any() and is_delayed(gain.state_names):
        return True
    same: bool = gain.delay.shape == lin.delay.shape
    return same and bool(np.allclose(gain.delay, lin.delay, atol=1e-9))


@dataclass(eq=False)
class _Erring(Policy):
    """State feedback of a model's states with errors."""

    feedback: StateFeedback
    error: Callable[[float], Array]

    @property
    def model(self) -> LinearModel | None:
        """Model of the feedback."""
        return self.feedback.lin

    def bind(self, robot: Robot) -> Command:
        """Return the command with the errors of the sensors."""
        command = self.feedback.bind(robot)
        K = self.feedback.K
        return lambda t, q, v: np.asarray(command(t, q, v)) - K @ self.error(t)


@dataclass(eq=False)
class Allocation(Policy):
    """Allocation of a policy's commands to thrusters and motors within their limits.

    The policy commands the inputs of the robot `design`, such as torque and force on the base. The
    thrusters and motors of the simulated robot then produce the generalised force that is closest
    to the commanded force, without negative thrust and without exceeding an input limit. The
    squared distance between the two forces is e^T M e. Here e is the difference between the
    accelerations that the two forces cause, and M is the inertia of the robot.

    If `design` has inputs that push the robot, such as a force on the base, a force that was not
    commanded is an error, too. Otherwise a translation of the robot counts only one thousandth, so
    thrusters also realise a torque that they exert only together with a force. Among the inputs
    that exert the torque, those with the smallest force are used. The force moves passive joints;
    motors hold their joints against it.

    Parameters
    ----------
    policy : policy or StateFeedback
    design : Robot
        The simulated robot, but with the inputs that the policy commands.

    Examples
    --------
    >>> cubesat = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    >>> wheels = [each for each in cubesat.inputs if isinstance(each, fflin.ReactionWheel)]
    >>> design = cubesat.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce(), *wheels])
    >>> sampled = fflin.linearize(design).discretize(0.1)
    >>> law = fflin.StateFeedback(sampled, fflin.lqr(sampled).K)
    >>> fflin.simulate(cubesat, fflin.Allocation(law, design), duration=0.2).u.shape[1]
    15
    """

    policy: object
    design: Robot

    @property
    def commanded_robot(self) -> Robot | None:
        """The robot `design`."""
        return self.design

    @property
    def inner(self) -> Policy:
        """The policy whose commands are allocated."""
        return as_policy(self.policy)

    @property
    def model(self) -> LinearModel | None:
        """Model of the inner policy."""
        return self.inner.model

    @property
    def input_delays(self) -> dict[str, float]:
        """Delays of the inputs of `design` for which the inner policy was designed."""
        return self.inner.input_delays

    @property
    def feedback_gain(self) -> Array | None:
        """Gain of the inner policy."""
        return self.inner.feedback_gain

    @property
    def sample_time(self) -> float:
        """Sample time [s] of the inner policy."""
        return self.inner.sample_time

    @property
    def measurement_noise(self) -> Noise | None:
        """Measurement noise of the inner policy."""
        return self.inner.measurement_noise

    @property
    def senses_outputs(self) -> bool:  # type: ignore[override]
        """Whether the sensors of the inner policy are outputs."""
        return self.inner.senses_outputs

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors of the inner policy."""
        return self.inner.sensors

    @property
    def axes(self) -> tuple[Frame | None, pin.SE3 | None]:
        """Frame and reference of the inner policy."""
        return self.inner.axes

    @property
    def reference_motion(self) -> Reference | None:
        """Motion that the inner policy follows."""
        return self.inner.reference_motion

    @property
    def followed_trajectory(self) -> Trajectory | None:
        """Trajectory that the inner policy follows."""
        return self.inner.followed_trajectory

    @property
    def fed_back(self) -> tuple[str, ...]:
        """States that the inner policy feeds back."""
        return self.inner.fed_back

    def poles_along(self) -> Array:
        """Return the poles of the inner policy's loop along its trajectory."""
        return self.inner.poles_along()

    def linear_law(self) -> System | None:
        """Return the law of the inner policy, without limits."""
        return self.inner.linear_law()

    def laws_of_period(self) -> list[System]:
        """Return the laws of the inner policy, without limits."""
        return self.inner.laws_of_period()

    def closed_loop(self) -> tuple[Array, float] | None:
        """Return the closed loop of the inner policy, without limits."""
        return self.inner.closed_loop()

    def loop_around(self, sample: float) -> Callable[[LinearModel], Array] | None:
        """Return the closed loop of the inner policy about a model."""
        return self.inner.loop_around(sample)

    def loop_notes(self, held: float = 0.0) -> tuple[str, ...]:
        """Return the notes on the loop of the inner policy."""
        return self.inner.loop_notes(held)

    def held_for(self, seconds: float) -> Policy:
        """Return the allocation of commands that are held."""
        return replace(self, policy=self.inner.held_for(seconds))

    def fresh(self) -> Policy:
        """Return the allocation of an inner policy without memory of earlier runs."""
        return replace(self, policy=self.inner.fresh())

    def with_sensor_errors(self, error: Callable[[float], Array]) -> Policy:
        """Return the allocation of an inner policy whose sensors have errors."""
        return replace(self, policy=self.inner.with_sensor_errors(error))

    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot.

        Raises
        ------
        InputError
            If the simulated robot and `design` have different joints.
        """
        instance("design", self.design, Robot, "a fflin.Robot")
        if self.design.joint_names != robot.joint_names:
            raise InputError(
                f"the design's joints differ from the joints of '{robot.name}'; give the same "
                "robot, with other inputs, as the design"
            )
        require_configuration_size(
            f"the design was made for '{self.design.name}'", self.design.nq, robot
        )
        return AllocatedPolicy(self, robot)


def translation_excess(design: Robot, robot: Robot) -> Vector:
    """Return the part (6 + n,) of a translation's force that is not an error of an `Allocation`.

    It is zero if an input of the design pushes the robot, and for joints without a motor.
    """
    excess = np.zeros(6 + robot.n)
    if any(isinstance(item, BaseForce | Thruster) for item in design.inputs):
        return excess
    motors = {item.joint for item in robot.inputs if isinstance(item, JointTorque)}
    excess[:6] = 1.0 - LIGHT
    excess[6:] = [(1.0 - LIGHT) * (name in motors) for name in robot.joint_names]
    return excess


class AllocatedPolicy(BoundLaw):
    """Policy that realises the commands of an `Allocation` with the inputs of a robot."""

    def __init__(self, allocation: Allocation, robot: Robot) -> None:
        frame, reference = allocation.axes
        self._design = Actuation(
            StateMap(allocation.design, reference=reference, frame=frame)
        )
        self._robot = Actuation(StateMap(robot, reference=reference, frame=frame))
        names = self._design.names
        free = np.full(len(names), np.inf)
        inner = bound(allocation.policy, allocation.design)
        self._command = Law(inner, names, (-free, free), np.inf)
        self._inner = inner if isinstance(inner, BoundLaw) else None
        self.advance = self._inner.advance if self._inner else None
        if self._inner and self._inner.correct:
            self.correct = self._correct
        self._data = robot.create_data()
        self._design_data = allocation.design.create_data()
        self._law = allocation.inner
        self._limits = input_limits(robot, limits_of(robot))
        excess = translation_excess(allocation.design, robot)
        self._excess = excess[:, np.newaxis]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on a run: how the commands are realised, and the notes of the inner policy."""
        notes = self._inner.notes if self._inner else ()
        if self._design.names == self._robot.names:
            return notes
        asked, given = (
            ", ".join(actuation.groups) for actuation in (self._design, self._robot)
        )
        notes = (f"allocation: the commanded {asked} are realised by {given}", *notes)
        if isinstance(self._law, StateFeedback):
            robot = self._robot.state.robot
            notes += note_on_dipole(robot, self._law.lin, self._law.K)
        return notes

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the inputs (nu,) whose generalised force is nearest to the commanded force.

        All inputs are within their limits. The difference d of the two forces has the length
        sqrt(d' M^-1 d), with the inertia M of the design. `translation_excess` is left out of d.
        """
        state = self._design.state
        chart = state.unchecked_chart(q)
        command = self._design.in_base_axes(chart, self._command(t, q, v))
        force = self._design.columns(self._data, q, _flux(self._design, t)) @ command
        columns = self._columns(self._robot, chart, q, t)
        M = state.project(pin.crba(state.robot.model, self._design_data, q).T)
        # The columns of M for a translation are the forces that accelerate the whole robot by
        # 1 m/s^2 without rotation.
        translation = columns[LINEAR] / M[LINEAR, LINEAR][0, 0]
        columns = columns - self._excess * M[:, LINEAR] @ translation
        # With M = L L', the length of d is the Euclidean norm of L^-1 d.
        L = np.linalg.cholesky(M)
        scaled = np.linalg.solve(L, np.column_stack((columns, force)))
        allocated = nearest(scaled[:, :-1], scaled[:, -1], *self._limits)
        if self.correct:
            asked = np.linalg.solve(L, self._columns(self._design, chart, q, t))
            self._shortfall = allocated, scaled, asked
        return allocated

    def _columns(self, actuation: Actuation, chart: Chart, q: Array, t: float) -> Array:
        """Return the generalised forces (6 + n, k) of unit inputs, in the axes of the inputs."""
        # For inputs u in reference axes, the force is B_u R' u = (R B_u')' u.
        B = actuation.columns(self._data, q, _flux(actuation, t))
        return chart.to_reference(actuation.held, B.T).T

    def _correct(self, difference: Array) -> None:
        """Correct the inner policy by the part of its commands that is not achieved.

        The difference of the achieved and the wanted generalised force is mapped to the inputs of
        `design` whose force is nearest to it.
        """
        allocated, scaled, asked = self._shortfall
        lack = scaled[:, :-1] @ (allocated + difference) - scaled[:, -1]
        assert self._inner is not None
        assert self._inner.correct is not None
        self._inner.correct(nearest_unbounded(asked, lack))


def _flux(actuation: Actuation, t: float) -> Array | None:
    """Return the magnetic flux density (3,) [T] at time t [s], or None without magnetorquers."""
    return actuation.flux(t) if actuation.torquers else None
