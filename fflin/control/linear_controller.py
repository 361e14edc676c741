"""Output feedback by a linear system: a controller from another tool, or a compensator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import InputError, listed
from fflin.base.validation import Array, instance, number, vector
from fflin.control.kalman import Compensator
from fflin.control.policies import Clock, Feedback, Policy, decider, feedback_of
from fflin.control.systems import fitted, system_of
from fflin.dynamics.aba import Aba
from fflin.dynamics.integrators import held_exponential
from fflin.dynamics.outputs import KINDS, Measuring, state_indices
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_sensed
from fflin.linear.model import LinearModel
from fflin.robot.outputs import Gyroscope
from fflin.robot.robot import Robot

# A pole counts as unstable if it grows faster than this fraction of the fastest pole.
_ROUNDING = 1e-6


def measured_at(state: StateMap) -> tuple[list[int], list[Gyroscope]]:
    """Return the state index of each output, and the gyroscopes, which are numbered after states.

    Other sensors raise `InputError`.
    """
    found, gyros = list[int](), list[Gyroscope]()
    for output in state.robot.outputs:
        if isinstance(output, Gyroscope):
            first = state.nx + 3 * len(gyros)
            found += range(first, first + 3)
            gyros.append(output)
        elif type(output) in KINDS:
            raise InputError(f"a {type(output).__name__} is measured in Python")
        else:
            found += state_indices(state, output)
    return found, gyros


class Sample(NamedTuple):
    """Law u = u0 + C (z + jump) + D dy with dy = y - y0.

    The next z, or dz/dt in continuous time, is A (z + jump) + B dy.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    u0: Array
    y0: Array
    jump: Array | float = 0.0


class Compensation:
    """Control law with a state z, advanced from sample to sample, or per stage if dt is 0."""

    def __init__(self, size: int, at: Callable[[float], Sample], dt: float = 1.0) -> None:
        self.at, self.dt = at, dt
        self.estimate: Array = np.zeros(size)  # z at the next sample or stage
        self.rates: list[Array] = [self.estimate]
        self.stages = 0

    def step(self, t: float, measure: Callable[[Sample, Array], Array]) -> Array:
        """Return the command of a sample; `measure(sample, u)` returns y."""
        by = self.at(t)
        z = self.estimate + by.jump
        u: Array = by.u0 + by.C @ z
        if by.D.any():  # acts on outputs that do not depend on u
            u = u + by.D @ (measure(by, u) - by.y0)
        after = by.A @ z + by.B @ (measure(by, u) - by.y0)
        if self.dt:
            self.estimate = after
        else:
            self.rates.append(after)
        return u

    def advance(self, weights: Array, last: bool) -> None:
        """Integrate z to the next stage from weights of z at the step's start and of its rates."""
        if not self.dt:
            self.estimate, self.stages = weights @ np.array(self.rates), self.stages + 1
            if last:
                self.rates, self.stages = [self.estimate], 0


class Loop(Compensation):
    """Policy that measures a robot's outputs relative to a reference, for a compensator."""

    def __init__(
        self, state: StateMap, dt: float, noise: Any, size: int, at: Any, there: Any
    ) -> None:
        super().__init__(size, at, dt)
        self._noise, self._there = noise, there
        self._at_rest: Array = np.zeros(state.robot.nv)
        felt = any(output.FEELS_ACCELERATION for output in state.robot.outputs)
        self._aba, self._clock = Aba(state) if felt else None, Clock(dt)

    def sample(self, t: float) -> tuple[Sample, StateMap, Array]:
        """Return the law of a sample, and the chart and state relative to which y is measured."""
        measure, near = self._there(t)
        return self.at(t), measure.state, near

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the command at a sample or a stage."""
        if self.dt:
            self._clock.tick(t)
        elif len(self.estimate) and len(self.rates) != self.stages + 1:
            raise InputError(
                "the states of a continuous controller are integrated by fflin.simulate; give it "
                "the LinearController itself as the policy, or sample the controller"
            )
        measure, near = self._there(t)
        state, x = measure.state, measure.state.read(q, v, near=near)
        noise: Any = 0.0
        if self._noise is not None:
            size = len(self.at(t).y0)
            noise = vector("noise(t)", self._noise(t), size, "one value for each output")

        def measured(_: Sample, u: Array) -> Array:
            a = self._at_rest
            if aba := self._aba:
                a = aba.acceleration(q, v, aba.actuation.in_base_axes(state.chart(q), u))
            return np.asarray(measure(x, q, v, a) + noise)

        return self.step(t, measured)


@dataclass(eq=False, repr=False)
class LinearController(Feedback):
    r"""Output feedback ``u - u0 = system (y - y0)`` by any linear controller `system`.

    .. math:: \dot z = A z + B (y - y_0),\qquad u - u_0 = C z + D (y - y_0),\qquad z(0) = 0

    y is the vector of the robot's outputs in the chart of the model, as `outputs` returns it. The
    output of the controller is added to u0. The sign is positive feedback, as for controllers
    from ``hinfsyn`` and ``h2syn``.

    A continuous controller is integrated together with the robot, in the same Runge-Kutta stages.
    If `simulate` is given `sample` or `delay`, y is held between samples and z is advanced exactly.
    A sampled controller is evaluated at its own sample times, which must be multiples of the step.
    The output u of a sampled controller is held between samples.

    Parameters
    ----------
    system : python-control or SciPy system, array_like, tuple, `Compensator` or path
        The controller, in one of these forms:

        - a state space or transfer function;
        - a gain D (nu, ny);
        - (A, B, C, D) or (A, B, C, D, dt);
        - a .mat, .npz or .json file with A, B, C, D, and dt or Ts if the controller is sampled;
        - a .mat, .npz or .json file with D alone.

        The controller's input names must be names of the model's outputs, and its output names must
        be names of the model's inputs, with dots or underscores. In a file the names are
        ``input_names`` or ``InputName``, ... Some names may be omitted. Without names, the
        controller must use all outputs and inputs of the model, in order. If the controller has no
        dt, the model's dt is used.
    lin : LinearModel
        Continuous or sampled model. The controller acts on deviations from the point of this model.
    sign : {1, -1}
        Sign of the feedback: -1 for a controller designed for negative feedback, u - u0 = -K (y -
        y0).
    noise : callable, optional
        noise(t) -> (ny,), added to y.

    Attributes
    ----------
    system : tuple of A, B, C, D, dt, inputs, outputs
        The controller over all outputs and inputs of the model, with `sign` applied.
    loop : ndarray (nx + nz, nx + nz)
        Closed-loop matrix of the model's state and z.

    Raises
    ------
    InputError
        If one of these conditions is true:

        - a size, name or sampling time does not fit the model;
        - an entry is not finite, or a transfer function is improper;
        - D acts on an output with direct feedthrough from the inputs (algebraic loop).
    FileError
        If the file cannot be read or lacks the matrices named above.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> system = -fflin.lqr(lin).K  # or a state space, a transfer function, a .mat
    >>> policy = fflin.LinearController(system, lin)
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> fflin.simulate(robot, policy, v0=v0, duration=1.0).u.shape[1]
    9
    """

    system: Any
    lin: LinearModel
    sign: float = field(default=1.0, kw_only=True)
    noise: Callable[[float], ArrayLike] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        lin = instance("lin", self.lin, LinearModel, "a fflin.LinearModel")
        if lin.moving or number("sign", self.sign) not in (1.0, -1.0):
            raise InputError(
                f"sign is {self.sign!r} and lin.moving is {lin.moving}, expected sign 1 or -1 and "
                "a model about a fixed point, with moving False"
            )
        if self.noise is not None and not callable(self.noise):
            raise InputError(f"noise is {self.noise!r}, expected noise(t) -> (ny,), a function")
        by = fitted(system_of(self.system), lin)
        felt = lin.D.any(axis=1) & by.D.any(axis=0)
        if felt.any():
            raise InputError(
                "D of the controller forms an algebraic loop with "
                f"{listed(compress(lin.output_names, felt))}, which depends directly on the "
                "inputs; set D to 0 for this output, for example with a low-pass filter"
            )
        dt = lin.dt if by.dt is None or (by.dt <= 0.0 and not len(by.A)) else by.dt
        dt = lin.dt or dt if dt < 0.0 else dt
        if dt < 0.0:
            raise InputError("the controller is sampled, but has no sampling time; give its dt [s]")
        if lin.dt and abs(dt - lin.dt) > 1e-9 * lin.dt:
            times = (
                f"sampled at dt = {each:g} s" if each else "continuous" for each in (dt, lin.dt)
            )
            raise InputError(
                "the controller is {}, the model is {}; give the continuous model, or sample both "
                "with the same dt".format(*times)
            )
        self.system = by._replace(C=self.sign * by.C, D=self.sign * by.D, dt=dt)
        self.sign = 1.0  # `system` has it from here on

    def __repr__(self) -> str:
        (nu, ny), dt = self.system.D.shape, self.dt
        time, nz = f"dt={dt:g} s" if dt else "continuous", len(self.system.A)
        return f"{type(self).__name__}('{self.lin.robot}', nz={nz}, ny={ny}, nu={nu}, {time})"

    @property
    def dt(self) -> float:
        """Sampling time [s]; 0 in continuous time."""
        return float(self.system.dt)

    @property
    def terms(self) -> Sample:
        """Matrices and offsets that apply at each sample or stage."""
        (A, B, C, D, *_), lin = self.system, self.lin
        return Sample(A, B, C, D, lin.u0, lin.y0)

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot, with a separate state z for each call.

        Raises
        ------
        InputError
            If the robot's states, inputs or outputs differ from the model's. The masses may differ.
        """
        lin, stays = self.lin, self.terms
        state = self.state_map(robot)
        require_sensed(lin, robot, state)
        there = Measuring(state, lin.q), state.read(lin.q, lin.v)
        return Loop(state, self.dt, self.noise, len(stays.A), lambda _: stays, lambda _: there)

    def around(self, lin: LinearModel) -> tuple[LinearModel, Array, Array]:
        """Return the model with the controller's states, and K and u of the law u + K e."""
        A, B, C, D, u0, y0, *_ = self.terms
        apart, none = lin.y0 - y0, np.zeros((len(lin.A), len(A)))
        both = replace(
            lin,
            A=np.block([[lin.A, none], [B @ lin.C, A]]),
            B=np.vstack((lin.B, B @ lin.D)),
            f0=np.concatenate((lin.f0, B @ apart)),
            x0=np.concatenate((lin.x0, np.zeros(len(A)))),
        )
        return both, np.hstack((D @ lin.C, C)), u0 + D @ apart

    @cached_property
    def loop(self) -> Array:
        """Closed-loop matrix (nx + nz, nx + nz) of the states of model and controller."""
        lin = self.lin.discretize(self.dt) if self.dt and not self.lin.dt else self.lin
        both, K, _ = self.around(lin)
        return both.A + both.B @ K

    def sampled(self, dt: float) -> LinearController:
        """Return the controller sampled at dt [s]; a sampled controller is unchanged."""
        by = self.system
        if by.dt or not len(by.A):
            return self
        A, B = held_exponential(by.A, by.B, dt)
        return replace(self, system=by._replace(A=A, B=B, dt=dt))


def growing(policy: object) -> tuple[str, ...]:
    """Return warnings on unstable poles of a linear controller and of its linear loop."""
    said, by = list[str](), decider(policy)
    if not isinstance(by, LinearController):
        return ()
    for what in ("linear loop", "controller by itself"):
        poles = np.linalg.eigvals(by.loop if what == "linear loop" else by.system.A)
        growth = np.abs(poles) - 1.0 if by.dt else poles.real
        if (growth > _ROUNDING * (1.0 + np.abs(poles).max(initial=0.0))).any():
            pole, unit = complex(poles[growth.argmax()]), "" if by.dt else " 1/s"
            said.append(f"the {what} is unstable, with a pole at {pole:.4g}{unit}")
            poles = np.linalg.eigvals(LinearController(by.system, by.lin, sign=-1.0).loop)
            if what == "linear loop" and ((np.abs(poles) < 1) if by.dt else (poles.real < 0)).all():
                said[-1] += (
                    "; the loop is stable with the opposite sign: "
                    "set sign=-1 (--negative-feedback), "
                )
                said[-1] += "or remove this option if it is set"
    return tuple(said)


def closed_loop(policy: object) -> tuple[Array, float, tuple[str, ...]] | None:
    """Return the closed-loop matrix, dt [s] and state names of a policy with a linear loop."""
    (lin, K), by = feedback_of(policy), decider(policy)
    if isinstance(by, LinearController):
        own = (f"z_{k + 1} of the controller" for k in range(len(by.system.A)))
        return by.loop, by.dt, (*by.lin.state_names, *own)
    return None if lin is None or K is None else (lin.A - lin.B @ K, lin.dt, lin.state_names)


class OutputFeedback(LinearController):
    """Feedback of the robot's outputs by a sampled compensator, such as the result of `lqg`.

    At each sample, u - u0 = C z is applied and y is measured. The state z is then advanced to the
    next sample. Accelerometer outputs are computed with the commanded u, before saturation. The
    initial estimate of the deviation from the point is zero.

    Parameters
    ----------
    lin : LinearModel
        Sampled model that the compensator was designed for.
    compensator : Compensator
    noise : callable, optional
        noise(t) -> (ny,), added to y.

    Raises
    ------
    InputError
        If the compensator was designed for another model, or is not sampled.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> sampled = lin.discretize(0.1)
    >>> compensator = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-3, 1e-4))
    >>> policy = fflin.OutputFeedback(sampled, compensator)
    >>> fflin.simulate(robot, policy, duration=1.0).u.shape[1]
    9
    """

    def __init__(
        self,
        lin: LinearModel,
        compensator: Compensator,
        noise: Callable[[float], ArrayLike] | None = None,
    ) -> None:
        instance("lin", lin, LinearModel, "a fflin.LinearModel")
        instance("compensator", compensator, Compensator, "a Compensator, as fflin.lqg returns it")
        if not lin.dt:
            raise InputError(
                "the model must be sampled; use lin.discretize(dt), and design the gain and the "
                "estimator for it"
            )
        super().__init__(compensator, lin, noise=noise)
        self.compensator = compensator
