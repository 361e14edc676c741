"""Policies that compute the inputs: state feedback about a point, and allocation."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.validation import Array, frozen, instance, shaped, vector
from fflin.control.channel import Law
from fflin.control.gain import Gain
from fflin.control.policy import (
    BoundLaw,
    Command,
    Noise,
    Policy,
    Predictor,
    Reference,
    StateForm,
    as_policy,
    bound,
)
from fflin.dynamics.aba import Aba
from fflin.dynamics.coordinates import Frame
from fflin.dynamics.outputs import KINDS, Measuring, state_indices
from fflin.dynamics.state import Actuation, StateMap, selection
from fflin.dynamics.state_rows import readout
from fflin.kernel.allocation import nearest
from fflin.linear.fit import about_point, require_configuration_size, require_fit
from fflin.linear.holding import held_if_possible, wheel_notes
from fflin.linear.model import LinearModel, gain_map
from fflin.linear.trajectory import Trajectory
from fflin.robot.fields import input_limits, limits_of
from fflin.robot.outputs import Gyroscope
from fflin.robot.robot import Robot

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
        S = selection(lin.state_names, state.names)
        near = S.T @ lin.x0
        return lambda _, q, v: (lin.u0, S @ state.read(q, v, near=near) - lin.x0)


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


@dataclass(eq=False, repr=False)
class StateFeedback(Feedback):
    """State feedback ``u = u0 - K (x - x0)`` about the operating point of a model.

    The angle of a continuous joint is unwrapped, so that it differs from x0 by at most half a turn.

    Parameters
    ----------
    lin : LinearModel
        Model that K was designed for. With a reduced model, only the states of the reduced model
        are fed back. If its point is not a fixed point, but inputs can hold the robot there, u0 is
        these inputs, as in `lqr`.
    K : array_like (nu, nx) or Gain
        Gain.

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
    K: Array

    def __post_init__(self) -> None:
        hint = " (nu, nx); give the gain that was designed for this model"
        K = self.K
        if isinstance(K, Gain):
            _require_designed_for(K, self.lin)
            K = K.K
        self.K = frozen(shaped("K", K, about_point(self.lin).B.shape[::-1], hint))
        self.lin = held_if_possible(self.lin)

    def __repr__(self) -> str:
        nu, nx = self.K.shape
        time = f"dt={self.lin.dt:g} s" if self.lin.dt else "continuous"
        return f"StateFeedback('{self.lin.robot}', nx={nx}, nu={nu}, {time})"

    def _repr_html_(self) -> str:
        return html.result_card(self, gain_map(self.K, self.lin))

    @property
    def notes(self) -> tuple[str, ...]:
        """Note on the momentum that wheels gain while they hold the robot at the point."""
        return wheel_notes(self.lin)

    @property
    def feedback_gain(self) -> Array | None:
        """The gain K."""
        return self.K

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the states of the model."""
        return self.lin.state_names

    def with_sensor_errors(self, error: Callable[[float], Array]) -> Policy:
        """Return the feedback of states with errors."""
        return _Erring(self, error)

    def prediction(self, lin: LinearModel, state: StateMap) -> Predictor | None:
        """Return the predictor of the closed loop with the model `lin`."""
        K, constant, _ = self.terms(state)
        at_point = constant - K @ lin.x0
        return lin, lambda e: at_point - K @ e

    def form(self, robot: Robot) -> StateForm:
        """Return the gain of the full state."""
        K, offset, x0 = self.terms(self.state_map(robot))
        return StateForm(offset[None], K[None], x0, {})

    def terms(self, state: StateMap) -> tuple[Array, Array, Array]:
        """Return K and offset of the law u = offset - K x for a robot's full state x, and x0."""
        lin = self.lin
        S = selection(self.lin.state_names, state.names)
        return self.K @ S, lin.u0 + self.K @ lin.x0, S.T @ lin.x0

    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot.

        Raises
        ------
        InputError
            If the robot has other states or inputs than the model. Masses may differ.
        """
        state = self.state_map(robot)
        return readout(state, *self.terms(state))


def _require_designed_for(gain: Gain, lin: LinearModel) -> None:
    """Raise `InputError` if a gain was designed for a model with other signals or another point."""
    same = {
        "states": gain.state_names == lin.state_names,
        "inputs": gain.input_names == lin.input_names,
        "sampling time": bool(np.isclose(gain.dt, lin.dt)),
        "frame": gain.frame == lin.frame,
        "point": gain.x0.shape == lin.x0.shape
        and bool(np.allclose(gain.x0, lin.x0, atol=1e-9)),
        "reference": bool(np.allclose(gain.placement, lin.placement, atol=1e-9)),
    }
    different = [name for name, agrees in same.items() if not agrees]
    if different:
        raise InputError(
            f"the gain was designed for a model of '{gain.robot}' with another {different[0]} than "
            "the given model; give the model of the gain, or its matrix gain.K"
        )


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
    def feedback_gain(self) -> Array | None:
        """Gain of the inner policy."""
        return self.inner.feedback_gain

    @property
    def sample_time(self) -> float:
        """Sampling time [s] of the inner policy."""
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
        self._data = robot.create_data()
        self._design_data = allocation.design.create_data()
        self._limits = input_limits(robot, limits_of(robot))

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on a run: how the commands are realised, and the notes of the inner policy."""
        notes = self._inner.notes if self._inner else ()
        if self._design.names == self._robot.names:
            return notes
        asked, given = (
            ", ".join(actuation.groups) for actuation in (self._design, self._robot)
        )
        return (f"allocation: the commanded {asked} are realised by {given}", *notes)

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the inputs (nu,) whose generalised force is nearest to the commanded force.

        All inputs are within their limits. The difference d of the two forces has the length
        sqrt(d' M^-1 d), with the inertia M of the design.
        """
        state = self._design.state
        chart = state.unchecked_chart(q)
        command = self._design.in_base_axes(chart, self._command(t, q, v))
        force = self._design.columns(self._data, q) @ command
        # For inputs u in reference axes, the force is B_u R' u = (R B_u')' u.
        B = self._robot.columns(self._data, q)
        columns = chart.to_reference(self._robot.held, B.T).T
        M = state.project(pin.crba(state.robot.model, self._design_data, q).T)
        # With M = L L', the length of d is the Euclidean norm of L^-1 d.
        L = np.linalg.cholesky(M)
        scaled = np.linalg.solve(L, np.column_stack((columns, force)))
        return nearest(scaled[:, :-1], scaled[:, -1], *self._limits)


def next_sample(t: float, last: float, dt: float) -> float:
    """Return the time t of a sample; raise `InputError` if t is not `dt` [s] after time `last`.

    `last` is the time of the last sample, and negative before the first sample.
    """
    apart = t - last
    if last >= 0.0 and abs(apart - dt) > 1e-6 * dt:
        raise InputError(
            f"the controller is called {apart:g} s after its last sample, expected "
            f"{dt:g} s; leave out `sample`, or set `sample` to the expected value"
        )
    return t


def measured_at(state: StateMap) -> tuple[list[int], list[Gyroscope]]:
    """Return the index of each measured value, and the list of gyroscopes.

    Each measured value is a state or a rate of a gyroscope. The index of a state is its index in
    the state vector, and the indices of the gyroscope rates follow. Other sensors raise
    `InputError`.
    """
    indices, gyros = list[int](), list[Gyroscope]()
    for output in state.robot.outputs:
        if isinstance(output, Gyroscope):
            first = state.nx + 3 * len(gyros)
            indices += range(first, first + 3)
            gyros.append(output)
        elif type(output) in KINDS:
            raise InputError(f"a {type(output).__name__} is measured in Python")
        else:
            indices += state_indices(state, output)
    return indices, gyros


# Function of the command u that returns the outputs y.
Measure: TypeAlias = Callable[[Array], Array]

# Function of a controller's state z and a `Measure` that returns the command, and the next z or
# dz/dt.
Step: TypeAlias = Callable[[Array, Measure], tuple[Array, Array]]

# Function of time that returns three values: the step function of a compensator, a function that
# measures the robot's outputs, and the state near which angles are unwrapped.
At: TypeAlias = Callable[[float], tuple[Step, Measuring, Array]]


class Sample(NamedTuple):
    """Control law ``u = u0 + C (z + jump) + D (y - y0)`` of a controller with state z.

    ``A (z + jump) + B (y - y0)`` is the next z of a sampled controller, or dz/dt of a continuous
    controller. `jump` is the change of z at a sample at which the reference changes.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    u0: Array
    y0: Array
    jump: Array | float = 0.0

    def step(self, z: Array, measure: Measure) -> tuple[Array, Array]:
        """Return the command, and the next z or dz/dt."""
        z = z + self.jump
        u: Array = self.u0 + self.C @ z
        if self.D.any():
            # D acts only on outputs that do not depend on u, so `measure` can use an incomplete u.
            u = u + self.D @ (measure(u) - self.y0)
        return u, self.A @ z + self.B @ (measure(u) - self.y0)


class Loop(BoundLaw):
    """Policy that measures a robot's outputs and computes the command with a compensator.

    The compensator's state z advances at each sample, or at each stage of the integrator if dt is
    0. `sizes` contains the lengths of z and of the measured outputs y.
    """

    def __init__(
        self,
        state: StateMap,
        dt: float,
        sizes: tuple[int, int],
        at: At,
        noise: Noise | None = None,
    ) -> None:
        self.at, self.dt, self._noise, (nz, self._ny) = at, dt, noise, sizes
        self.estimate: Array = np.zeros(nz)  # z at the next sample or stage
        self.rates: list[Array] = [self.estimate]
        self.stages = 0
        self._last = -np.inf
        self._at_rest: Array = np.zeros(state.robot.nv)
        self._aba: Aba | None = None
        if any(output.FEELS_ACCELERATION for output in state.robot.outputs):
            self._aba = Aba(state)

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the command at a sample or at a stage of the integrator."""
        if self.dt:
            self._last = next_sample(t, self._last, self.dt)
        elif len(self.estimate) and len(self.rates) != self.stages + 1:
            raise InputError(
                "only fflin.simulate can integrate the states of a continuous controller; pass "
                "the LinearController itself to fflin.simulate as the policy, or sample the "
                "controller"
            )
        step, measure, near = self.at(t)
        state = measure.state
        x = measure.state.read(q, v, near=near)
        noise: Array | float = 0.0
        if self._noise is not None:
            noise = vector(
                "noise(t)", self._noise(t), self._ny, "one value for each output"
            )

        def measured(u: Array) -> Array:
            a = self._at_rest
            if aba := self._aba:
                in_base = aba.actuation.in_base_axes(state.unchecked_chart(q), u)
                a = aba.acceleration(q, v, in_base)
            return np.asarray(measure(x, q, v, a) + noise)

        u, after = step(self.estimate, measured)
        if self.dt:
            self.estimate = after
        elif len(self.estimate):
            self.rates.append(after)
        return u

    def advance(self, weights: Array, last: bool) -> None:
        """Set z to a weighted sum of z at the start of the step and of dz/dt at the past stages.

        `last` must be True at the last stage of a step. The state of a sampled compensator is not
        changed. A compensator without states may be called at some of the stages only, because its
        command may be held.
        """
        if not self.dt and len(self.estimate):
            self.estimate, self.stages = weights @ np.array(self.rates), self.stages + 1
            if last:
                self.rates = [self.estimate]
                self.stages = 0
