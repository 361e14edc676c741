"""Base class of policies: what simulations, campaigns and C code ask of a control law."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from itertools import compress
from types import BuiltinFunctionType, FunctionType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.validation import (
    Array,
    ArrayLike,
    Mask,
    as_double,
    function,
    instance,
    number,
    shaped,
    vector,
)
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    import pinocchio as pin

    from fflin.dynamics.coordinates import Frame
    from fflin.dynamics.state import StateMap
    from fflin.linear.trajectory import Trajectory

# Function of time t [s], configuration q and velocity v that returns the inputs u (nu,).
Command: TypeAlias = Callable[[float, Array, Array], ArrayLike]

# Function of time that returns measurement noise, one value for each sensor.
Noise: TypeAlias = Callable[[float], ArrayLike]

# Linear model that predicts a motion, and a function that returns the command (nu,) for a deviation
# from the operating point. The deviation contains the states of the robot. If the controller is in
# continuous time and has states, the deviation also contains these states, at the end.
Predictor: TypeAlias = tuple[LinearModel, Callable[[Array], Array]]

# Function of time that returns the q, v and u that a policy follows; u is in base axes.
Reference: TypeAlias = Callable[[float], tuple[Array, Array, Array]]

# A pole counts as unstable if its real part, or |z| - 1 for a sampled system, exceeds
# _ROUNDING * (1 + largest pole magnitude).
_ROUNDING = 1e-6

# Functions have no memory of their own that could be copied.
_FUNCTIONS = FunctionType, BuiltinFunctionType


# Members of `Policy` that describe the law that `bind` returns.
_DESCRIBING = (
    "form",
    "feedback_gain",
    "linear_law",
    "laws_of_period",
    "closed_loop",
    "loop_around",
    "loop_notes",
    "prediction",
)


def _provider(cls: type, name: str) -> type:
    """Return the class from which a class has a member."""
    return next(base for base in cls.__mro__ if name in vars(base))


class StateForm(NamedTuple):
    """Data of the law u = offset - K x of a robot's full state x.

    `Policy.form` returns these data, with which the compiled loop computes the commands.

    Attributes
    ----------
    offsets : ndarray (N, nu)
        Offsets at the points of the grid; N is 1 without a grid.
    gains : ndarray (N, nu, nx)
        Gains K at the points of the grid.
    x0 : ndarray (nx,)
        State near which the angles of continuous joints are unwrapped.
    grid : mapping
        {joint: values} of the grid of joint positions over which K is interpolated; may be empty.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> form = fflin.StateFeedback(lin, fflin.lqr(lin).K).form(robot)
    >>> isinstance(form, fflin.StateForm), form.gains.shape
    (True, (1, 9, 18))
    """

    offsets: Array
    gains: Array
    x0: Array
    grid: Mapping[str, Array]


class System(NamedTuple):
    """State-space system A, B, C, D with the names of its inputs and outputs.

    The sample time dt [s] is 0 in continuous time, -1 for a sampled system with unknown sample
    time, and None if it is not given.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()


def loop_matrix(law: System, plant: System) -> Array:
    """Return the matrix of the closed loop, whose first states are the states of the plant."""
    A, B, C, D, *_ = plant
    F: Array = np.block(
        [
            [A + B @ law.D @ C, B @ law.C],
            [law.B @ (C + D @ law.D @ C), law.A + law.B @ D @ law.C],
        ]
    )
    return F


def proportional(
    K: Array, dt: float, states: tuple[str, ...], inputs: tuple[str, ...]
) -> System:
    """Return the feedback u - u0 = -K (x - x0) as a system without states."""
    nu, nx = K.shape
    none = np.zeros((0, 0))
    return System(none, np.zeros((0, nx)), np.zeros((nu, 0)), -K, dt, states, inputs)


class OutputForm(NamedTuple):
    """Data of a law with a memory that computes commands from measured outputs or states."""

    loop: Any  # the bound law, a `policies.Loop`
    terms: Callable[[float], Any]  # `policies.Sample` at a time [s]
    # number of different samples from t = 0 on; None if all are the same
    samples: int | None
    # number of the last samples that repeat from then on; if it is 1, the last sample applies
    period: int = 1


class PathForm(NamedTuple):
    """Data of a state feedback along a trajectory."""

    policy: Any  # a `tracking.TrajectoryFeedback`


class BDotForm(NamedTuple):
    """Data of a law that feeds back a vector of the magnetic field in base axes."""

    gain: Array  # (nu, 3); the command is its product with the vector
    # The vector is the derivative of the flux density b, or b x omega / |b|^2 with the inertial
    # angular velocity omega if the law measures the rate.
    measures_rate: bool = False


Form: TypeAlias = StateForm | OutputForm | PathForm | BDotForm


class Policy(ABC):
    """Base class of control laws for `simulate`, `monte_carlo` and the other functions.

    A subclass must define `bind`. All other members have defaults, with which a law works in
    simulations and campaigns. A law that overrides them gets more:

    - `closed_loop` limits the default step of a continuous law, and `model` together with
      `loop_around` limits the default step of a sampled law. If `model` and `feedback_gain` are
      defined, both loops follow from them;
    - reports judge the states in `fed_back`;
    - the compiled loop flies a law whose `form` returns a `StateForm`.

    A subclass that redefines `bind` does not inherit the members that describe the law, such as
    `form` and `feedback_gain`.

    A plain function policy(t, q, v) -> u is also accepted wherever a policy is.

    Examples
    --------
    An integrator whose state stops at the limit of the torque:

    >>> class PI(fflin.Policy):
    ...     def __init__(self, lin, K, rate, most):
    ...         self.lin, self.K, self.rate, self.most = lin, K, rate, most
    ...     model = property(lambda self: self.lin)
    ...     sample_time = 0.1
    ...     def bind(self, robot):
    ...         feedback = fflin.StateFeedback(self.lin, self.K).bind(robot)
    ...         state = fflin.StateMap(robot, frame=self.lin.frame)
    ...         integral = np.zeros(3)
    ...         def command(t, q, v):
    ...             u = feedback(t, q, v)
    ...             u[:3] -= integral
    ...             if np.abs(u[:3]).max() < self.most:  # otherwise the integral would wind up
    ...                 integral[:] += 0.1 * self.rate * state.to_state(q, v)[:3]
    ...             return u
    ...         return command
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> law = PI(lin, fflin.lqr(lin).K, 0.05, 2.0)
    >>> fflin.simulate(robot, law, duration=1.0).u.shape[1]
    9
    """

    # Whether the sensors of the law are the outputs of the robot, and not its states.
    senses_outputs: ClassVar[bool] = False

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        # A member that describes the law is inherited only together with the method `bind` that it
        # describes.
        binding = _provider(cls, "bind")
        for name in _DESCRIBING:
            # `issubclass` is not used, because an abstract class caches its answers, and `cls`
            # shares the cache of its base class until it is complete.
            if binding not in _provider(cls, name).__mro__:
                setattr(cls, name, vars(Policy)[name])

    @abstractmethod
    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot; each call returns one with its own memory."""

    def _repr_html_(self) -> str:
        """Return a card with the sample time, the sensors and the notes of the law."""
        time = "commands in continuous time"
        if self.sample_time:
            time = f"commands every {self.sample_time:g} s"
        facts = [time]
        if self.sensors:
            facts.append(f"measures {', '.join(self.sensors)}")
        notes = [html.paragraph(note, "note") for note in self.notes]
        return html.result_card(self, html.paragraph("; ".join(facts)), *notes)

    @property
    def kind(self) -> str:
        """Name of the type of law, for messages."""
        return type(self).__name__

    @property
    def model(self) -> LinearModel | None:
        """Linear model about whose operating point the law acts; None if there is none."""
        return None

    @property
    def input_delays(self) -> dict[str, float]:
        """Delay [s] of each input for which the law was designed, by name; empty without delays."""
        lin = self.model
        if lin is None or not lin.delay.any():
            return {}
        return dict(zip(lin.input_names, lin.delay.tolist(), strict=True))

    @property
    def feedback_gain(self) -> Array | None:
        """Gain K (nu, nx) of the states of `model`; None if the law is not a constant gain."""
        return None

    @property
    def sample_time(self) -> float:
        """Sample time [s]; 0 for continuous commands."""
        if self.model is None:
            return 0.0
        return self.model.dt

    @property
    def measurement_noise(self) -> Noise | None:
        """Function of time that returns the measurement noise, or None."""
        return None

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the measured signals; empty if the law has no sensors that could have errors."""
        return ()

    @property
    def axes(self) -> tuple[Frame | None, pin.SE3 | None]:
        """Frame and reference of the states; each is None if the law accepts any."""
        if self.model is None:
            return None, None
        return self.model.frame, self.model.reference

    @property
    def jumps(self) -> bool:
        """Whether the command of a continuous law jumps at instants between the steps."""
        return False

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the report of a motion."""
        return ()

    @property
    def inner(self) -> Policy:
        """Law that computes the commands: the policy in an `Allocation`, otherwise this law."""
        return self

    @property
    def commanded_robot(self) -> Robot | None:
        """Robot whose inputs `inner` commands, if it is not the simulated one."""
        return None

    @property
    def reference_motion(self) -> Reference | None:
        """Function of time that returns q, v and u of the motion that the law follows, or None."""
        return None

    @property
    def followed_trajectory(self) -> Trajectory | None:
        """Trajectory that the law follows, or None."""
        return None

    @property
    def fed_back(self) -> tuple[str, ...]:
        """Names of the states that the law feeds back, or () if they are unknown."""
        if self.model is None:
            return ()
        names = self.model.robot_states
        K = self.feedback_gain
        if K is None:
            return names
        return states_of_gain(names, K)

    def initial_inputs_for(self, names: tuple[str, ...]) -> Array | None:
        """Return the reference inputs at the start, or None if the law has none.

        `names` are the inputs of the robot. An allocation commands other inputs.
        """
        lin = self.model
        if lin is None or lin.input_names != names:
            return None
        return lin.u0

    def reference_inputs(self, names: tuple[str, ...]) -> tuple[str, Array] | None:
        """Return where the law has reference inputs, and these inputs (N, nu), or None."""
        initial = initial_inputs(self, names)
        if initial is None:
            return None
        return "at its target", initial[None]

    def held_for(self, seconds: float) -> Policy:
        """Return the law for commands that are held for `seconds` [s]."""
        return self

    def fresh(self) -> Policy:
        """Return the law for one more run; `bind` gives it its own memory."""
        return self

    def with_sensor_errors(self, error: Callable[[float], Array]) -> Policy:
        """Return the law with errors (ny,) at time t added to the values of its `sensors`."""
        raise InputError(f"a {type(self).__name__} has no sensors")

    def closed_loop(self) -> tuple[Array, float] | None:
        """Return the matrix of the linear closed loop and its dt [s], or None if it has none."""
        lin = self.model
        K = self.feedback_gain
        if lin is None or K is None:
            return None
        return lin.A - lin.B @ K, lin.dt

    def loop_around(self, sample: float) -> Callable[[LinearModel], Array] | None:
        """Return a function from a sampled model to the matrix of its closed loop, or None.

        `sample` is the sample time [s].
        """
        K = self.feedback_gain
        if K is None:
            return None
        return lambda model: model.A - model.B @ K

    def linear_law(self) -> System | None:
        """Return the law from deviations of its sensors to u - u0, or None if it is not linear.

        The sensors are states of `model`, or outputs if `senses_outputs` is true.
        """
        lin = self.model
        K = self.feedback_gain
        if lin is None or K is None:
            return None
        return proportional(K, lin.dt, lin.state_names, lin.input_names)

    def laws_of_period(self) -> list[System]:
        """Return the law of `linear_law` at each sample of its period; empty if it is not linear.

        A law that does not vary with time has one.
        """
        law = self.linear_law()
        return [] if law is None else [law]

    def poles_along(self) -> Array:
        """Return the poles [1/s] of the robot and of the loop along the followed trajectory."""
        return np.zeros(0)

    def prediction(self, lin: LinearModel, state: StateMap) -> Predictor | None:
        """Return the predictor of the closed loop with the model `lin`, or None.

        `lin` has the states of `state`.
        """
        return None

    def loop_notes(self, held: float = 0.0) -> tuple[str, ...]:
        """Return notes on unstable poles of the linear loop.

        `held` is the time [s] for which commands are held; 0 if the law is continuous.
        """
        lin = self.model
        K = self.feedback_gain
        if lin is None or K is None:
            return ()
        loop = lin.A - lin.B @ K
        unstable = unstable_note(
            "linear loop", loop[block_of_feedback(loop, K)], lin.dt, ""
        )
        if unstable or lin.dt or not held:
            return unstable
        sampled = lin.discretize(held)
        advice = (
            f"; the gain was designed in continuous time, but its commands are held for {held:g} "
            "s: shorten the sample time, or design the gain for it "
            f"(lin.discretize({held:g}))"
        )
        loop = sampled.A - sampled.B @ K
        return unstable_note(
            "sampled linear loop", loop[block_of_feedback(lin.A, K)], held, advice
        )

    def form(self, robot: Robot) -> Form | None:
        """Return the law as data for the compiled loop; None if it is computed in Python."""
        return None


class BoundLaw(ABC):
    """Command of a law with memory or with remarks on a run."""

    # Moves the memory of a continuous law by a stage of the integrator, see `Loop.advance`.
    advance: Callable[[Array, bool], None] | None = None
    # Corrects the memory after each command by the difference (nu,) between the limited and the
    # commanded inputs; None if the law has no such correction (anti-windup).
    correct: Callable[[Array], None] | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the report of a motion."""
        return ()

    @abstractmethod
    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the inputs (nu,)."""


@dataclass(eq=False)
class FunctionPolicy(Policy):
    """Policy that is a function of t, q and v, or an object with a method `bind`."""

    given: Any

    def __post_init__(self) -> None:
        if isinstance(self.given, type):
            name = self.given.__name__
            raise InputError(
                f"policy is the class {name}, expected an object of it: {name}(...)"
            )
        if not (callable(self.given) or callable(getattr(self.given, "bind", None))):
            raise InputError(
                f"policy has type {type(self.given).__name__}, expected policy(t, q, v) -> u, such "
                "as StateFeedback(lin, gain.K)"
            )

    @property
    def kind(self) -> str:
        """Name of the type of the function or object."""
        return type(self.given).__name__

    def bind(self, robot: Robot) -> Command:
        """Return the function, or what the method `bind` of the object returns."""
        given = self.given
        command: Command = given.bind(robot) if hasattr(given, "bind") else given
        return command

    def fresh(self) -> Policy:
        """Return a copy without the memory of an earlier run.

        The method `reset` of the copy is called if it has one. Functions are not copied.
        """
        given = self.given
        if hasattr(given, "bind") or isinstance(given, _FUNCTIONS):
            return self
        try:
            copied = deepcopy(given)
        except TypeError:  # it holds something that cannot be copied, such as a lock
            copied = given
        reset = getattr(copied, "reset", None)
        if callable(reset):
            reset()
        return FunctionPolicy(copied)


def as_policy(given: object) -> Policy:
    """Return a policy; raise `InputError` if the object is neither a policy nor a function.

    The members of a policy that a user defines are checked.
    """
    if isinstance(given, Policy):
        _check_members(given)
        return given
    return FunctionPolicy(given)


def defined_by_user(policy: Policy, name: str) -> bool:
    """Return whether a class outside fflin defines a member of a policy."""
    package = __name__.partition(".")[0]
    return _provider(type(policy), name).__module__.partition(".")[0] != package


def _check_members(policy: Policy) -> None:
    """Raise `InputError` if a member that a user defines returns a wrong type or size."""
    kind = policy.kind
    lin = policy.model
    if defined_by_user(policy, "model") and lin is not None:
        instance(f"{kind}.model", lin, LinearModel, "a fflin.LinearModel or None")
    K = policy.feedback_gain
    if defined_by_user(policy, "feedback_gain") and K is not None:
        label = f"{kind}.feedback_gain"
        shape = as_double(label, K).shape
        if lin is None and len(shape) != 2:
            raise InputError(f"{label} has shape {shape}, expected (nu, nx)")
        # Without a model, every nu and nx is accepted.
        nx, nu = shape[::-1] if lin is None else lin.B.shape
        shaped(label, K, (nu, nx), " (nu, nx), the inputs and states of its model")
    if defined_by_user(policy, "reference_motion"):
        motion = policy.reference_motion
        if motion is not None:
            label = f"{kind}.reference_motion"
            function(label, _callable(label, motion), "(t)")
    if defined_by_user(policy, "closed_loop"):
        _check_closed_loop(f"{kind}.closed_loop()", policy.closed_loop())


def _callable(name: str, value: object) -> Callable[..., object]:
    """Return a function, or raise `InputError`."""
    if not callable(value):
        raise InputError(
            f"{name} has type {type(value).__name__}, expected a function of t or None"
        )
    return value


def _check_closed_loop(label: str, closed: object) -> None:
    """Raise `InputError` if a closed loop is not None or a matrix (n, n) with its dt [s]."""
    if closed is None:
        return
    if not isinstance(closed, tuple) or len(closed) != 2:
        raise InputError(
            f"{label} returned an object of type {type(closed).__name__}, expected a matrix (n, n) "
            "and its sample time dt [s], or None"
        )
    matrix, dt = closed
    shape = as_double(label, matrix).shape
    if len(shape) != 2 or shape[0] != shape[1]:
        raise InputError(f"{label} has a matrix of shape {shape}, expected (n, n)")
    shaped(label, matrix, shape)
    if number(f"dt of {label}", dt) < 0.0:
        raise InputError(f"dt of {label} is {dt:g} s, expected 0 or more")


def initial_inputs(policy: Policy, names: tuple[str, ...]) -> Array | None:
    """Return the checked reference inputs (nu,) at the start, or None if the law has none."""
    initial = policy.initial_inputs_for(names)
    if initial is None:
        return None
    label = f"{policy.kind}.initial_inputs_for(names)"
    return vector(label, initial, len(names), "one value for each input")


def bound(policy: object, robot: Robot) -> Command:
    """Return the command function of a policy for a robot."""
    law = as_policy(policy)
    command = law.bind(robot)
    if not callable(command):
        raise InputError(
            f"{law.kind}.bind(robot) returned an object of type {type(command).__name__}, expected "
            "a function (t, q, v) -> u"
        )
    function("policy", command, "(t, q, v)")
    return command


def states_of_gain(names: tuple[str, ...], K: Array) -> tuple[str, ...]:
    """Return the names of the states that a gain K (.., nu, nx) feeds back."""
    largest = np.abs(K).reshape(-1, K.shape[-1]).max(axis=0, initial=0.0)
    return tuple(compress(names, largest))


def unstable_note(what: str, matrix: Array, dt: float, advice: str) -> tuple[str, ...]:
    """Return a note if a pole of `matrix` (n, n) is unstable; dt [s] is 0 in continuous time."""
    poles = np.linalg.eigvals(matrix)
    growth = np.abs(poles) - 1.0 if dt else poles.real
    if not (growth > _ROUNDING * (1.0 + np.abs(poles).max(initial=0.0))).any():
        return ()
    pole = complex(poles[growth.argmax()])
    unit = "" if dt else " 1/s"
    return (f"the {what} is unstable, with a pole at {pole:.4g}{unit}{advice}",)


def block_of_feedback(A: Array, K: Array) -> tuple[Mask, ...]:
    """Return the index of the block of A (nx, nx) whose poles count for stability.

    The block contains the states that the gain K (nu, nx) feeds back, and the states that affect
    them. Other states, such as the position of a base that no input pushes, may drift in a stable
    loop.
    """
    chosen = K.any(axis=0)
    # A state i affects a state j directly if A[j, i] is not zero. A chain of such effects has at
    # most nx links.
    for _ in range(len(A)):
        chosen = chosen | A[chosen].any(axis=0)
    return np.ix_(chosen, chosen)
