"""Linear model: matrices, names and units of the signals, and certificate."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base import html, svg
from fflin.base.errors import FflinWarning, InputError, optional_package
from fflin.base.names import by_name, input_keys, lag_name, past_name, undotted
from fflin.base.validation import (
    Array,
    ArrayLike,
    Result,
    Vector,
    frozen,
    number,
    numbers,
    positive,
)
from fflin.base.writing import as_path
from fflin.dynamics.delays import HeldSystem, split
from fflin.dynamics.integrators import held_exponential
from fflin.dynamics.outputs import sensors_by_signal
from fflin.dynamics.state import StateMap
from fflin.robot.inputs import lags_of

if TYPE_CHECKING:
    import control
    from scipy import signal

    from fflin import ToolModel
    from fflin.dynamics.coordinates import Frame
    from fflin.robot.robot import Robot

ControlSystem: TypeAlias = "control.StateSpace"

# Delay of the inputs [s]: one for all inputs, or {name, group or pattern of inputs: delay}.
Delay: TypeAlias = float | Mapping[str, float]

# A delay may have at most this many samples, because each sample adds a state for each input.
MOST_SAMPLES = 500


@dataclass(frozen=True)
class Certificate:
    """Residuals that show how accurate a linear model is.

    In an accurate model, the residuals are of the order of round-off errors; see `condition`.

    Attributes
    ----------
    condition : float
        Condition number of the inertia matrix M after scaling to a unit diagonal. Residuals of
        about this number times machine precision are expected.
    inertia_residual : float
        Largest entry of M M^-1 - I, where M is scaled to a unit diagonal.
    route_A, route_B : float
        Largest difference between A (or B) and the matrix that follows from Pinocchio's ABA
        derivatives, relative to the scale of the entry; see `check`.
    f0 : float
        Largest entry of the state derivative at the operating point; 0 at a fixed point.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> figures = lin.certificate
    >>> figures.route_A < 1e-12, figures.inertia_residual < 1e-12
    (True, True)
    """

    condition: float
    inertia_residual: float
    route_A: float
    route_B: float
    f0: float


@dataclass(frozen=True, eq=False, repr=False)
class StatesAndInputs(Result):
    """Names and units of states and inputs."""

    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_units: tuple[str, ...]


@dataclass(frozen=True, eq=False, repr=False)
class SignalNames(StatesAndInputs):
    """Names and units of the signals of linear models."""

    output_names: tuple[str, ...]
    output_units: tuple[str, ...]


@dataclass(frozen=True, eq=False, repr=False)
class ModelHeader(SignalNames):
    """Frame, robot and package versions for which linear models were computed."""

    frame: Frame
    moving: bool
    robot: str
    urdf_sha256: str
    locked: tuple[str, ...]
    fflin_version: str
    pinocchio_version: str


@dataclass(frozen=True, eq=False, repr=False)
class StateSpace(SignalNames):
    """Matrices of a linear model about a point, with names and units of the signals."""

    A: Array
    B: Array
    C: Array
    D: Array
    f0: Vector
    x0: Vector
    u0: Vector
    y0: Vector
    dt: float

    def _html_parts(self) -> list[str]:
        rates = self.state_units
        if not self.dt:
            rates = tuple(map(svg.rate_unit, rates))
        states = svg.Axis(self.state_names, self.state_units)
        rows = svg.Axis(self.state_names, rates)
        outputs = svg.Axis(self.output_names, self.output_units)
        inputs = _input_axis(self)
        maps = (
            svg.heat_map("A", self.A, rows, states),
            svg.heat_map("B", self.B, rows, inputs),
        )
        is_state = np.array_equal(self.C, np.eye(len(self.x0))) and not self.D.any()
        of_outputs = ""
        if not is_state:
            of_outputs = html.side_by_side(
                svg.heat_map("C", self.C, outputs, states),
                svg.heat_map("D", self.D, outputs, inputs),
            )
        table = [["signal", "", "unit", "operating point"]]
        values = (("state", states, self.x0), ("input", inputs, self.u0))
        for kind, axis, point in values:
            for name, unit, value in zip(*axis, point.tolist(), strict=True):
                table.append([name, kind, unit, f"{value:.6g}"])
        return [
            *super()._html_parts(),
            html.side_by_side(*maps),
            of_outputs,
            html.folded("states and inputs", html.table(table, "lll")),
        ]


class Signals(Protocol):
    """Model or design with names and units of states and inputs."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""

    @property
    def state_units(self) -> tuple[str, ...]:
        """Units of the states."""

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs."""

    @property
    def input_units(self) -> tuple[str, ...]:
        """Units of the inputs."""


def _input_axis(lin: Signals) -> svg.Axis:
    return svg.Axis(input_keys(lin), lin.input_units)


def gain_map(K: Array, lin: Signals) -> str:
    """Return a heat map in HTML of a gain (nu, nx) from states to inputs."""
    states = svg.Axis(lin.state_names, lin.state_units)
    return svg.heat_map("K", K, _input_axis(lin), states)


@dataclass(frozen=True, eq=False, repr=False, init=False)
class LinearModel(ModelHeader, StateSpace):
    r"""Linear model about an operating point, ``dx/dt = f0 + A (x - x0) + B (u - u0)``.

    The output is ``y = y0 + C (x - x0) + D (u - u0)``. If ``dt > 0``, the model is in discrete
    time: the left side of the state equation is then ``x - x0`` at the next sample, and f0 is the
    constant term of each step. Arrays are read-only.

    Attributes
    ----------
    A : ndarray (nx, nx)
        State matrix.
    B : ndarray (nx, nu)
        Input matrix.
    C : ndarray (ny, nx)
        Output matrix.
    D : ndarray (ny, nu)
        Feedthrough matrix.
    f0 : ndarray (nx,)
        State derivative of the nonlinear model at the operating point; exactly zero at a fixed
        point.
    x0, u0, y0 : ndarray (nx,), (nu,), (ny,)
        State, input and output at the operating point.
    dt : float
        Sample time [s]; 0 for continuous time.
    state_names, input_names, output_names : tuple of str
        Names of states, inputs and outputs.
    state_units, input_units, output_units : tuple of str
        Units of states, inputs and outputs.
    frame : str
        Axes of velocities and wrenches, see `StateMap`: "hybrid", "local" or "world"; in orbit
        "lvlh" or "hill".
    moving : bool
        Whether the state is the error relative to a reference that moves through the operating
        point.
    placement : ndarray (7,)
        The placement `reference`: position [m] and quaternion x, y, z, w.
    drift : ndarray (nx,) or None
        State derivative of a moving reference, or None if the reference is fixed. The attitude rate
        excludes rotation about the direction of gravity, because this rotation does not affect the
        dynamics. If the reference moves, f0 is zero.
    q : ndarray (nq,)
        Configuration at the operating point in Pinocchio's order.
    v : ndarray (nv,)
        Velocity at the operating point in Pinocchio's order.
    robot : str
        Name of the robot.
    urdf_sha256 : str
        Hash of the URDF as it was read; empty if there is no URDF.
    locked : tuple of str
        Text "joint=value" [rad|m] for each welded joint.
    fflin_version, pinocchio_version : str
        Versions of the packages that made the model.
    verified : bool
        True for a model computed in this session, or read from a file with a valid SHA-256 digest.
        False for a model read from a file without a digest, and for every result computed from
        such a model.
    weights : mapping
        Default weights of `lqr`, with the keys of `weights` in `Robot.replace`.
    mean_motion : float
        Mean motion of the robot's orbit [rad/s]; 0 without an orbit.
    t : float or None
        Time [s] for which the model holds, if the robot is in an elliptic orbit or has
        magnetorquers. None if the model does not depend on time.
    added : tuple of str
        Names of the last states, which are not states of the robot: the forces of inputs with a
        lag, see `with_lags`, and the earlier commands of a model with delayed inputs, see
        `discretize`.
    delay : ndarray (nu,)
        Delay of each input [s].
    dependent : tuple of str
        States of the robot that the model does not contain, because the constraints determine them
        from the states of the model.
    lag : ndarray (nu,)
        Time constant of the lag of each input [s] in the model; 0 if the model has no lag.
    output_lag : ndarray (ny,)
        Time constant of the lag of each output [s] in the model; 0 if the model has no lag.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> lin.state_names[:3], lin.input_units[0]
    (('q_b.x', 'q_b.y', 'q_b.z'), 'N m')
    >>> sampled = lin.discretize(0.1)
    >>> lin.save("model.mat")
    >>> fflin.LinearModel.load("model.mat").dt, sampled.dt
    (0.0, 0.1)
    """

    q: Array
    v: Array
    placement: Array
    _inertia: Callable[[LinearModel], Array] = field()
    _certify: Callable[[LinearModel], Certificate] = field()
    _ignorable: Callable[[LinearModel], tuple[str, ...]] | None = None
    _wheels: Callable[[LinearModel], tuple[str, ...]] | None = None
    drift: Array | None = None
    # Fingerprint of this model, and the source model, which has the certificate. The field is None
    # if this model has its own certificate. The source of a discretised model is the
    # continuous-time model, because the matrix exponential loses exact zeros. The source of a model
    # from a file is the model as read from the file. The source of a reduced model is the model
    # before the reduction. If that model is discretised, the source of the reduced model is the
    # reduced continuous-time model.
    _source: tuple[str, LinearModel] | None = None
    verified: bool = True
    _limits: Callable[[], Mapping[str, float]] | None = None
    weights: Mapping[str, Any] = field(default_factory=dict)
    _robot: Robot | None = None  # robot of the model; None for a model from a file
    mean_motion: float = 0.0
    added: tuple[str, ...] = ()
    dependent: tuple[str, ...] = ()
    # Map (12 + 2 n, nx) from the states to all states of a robot with constraints.
    _all_states: Array | None = None
    _delays: tuple[float, ...] = ()  # empty if no input is delayed
    _lags: tuple[float, ...] = ()  # empty if no input has a lag
    _output_lags: tuple[float, ...] = ()  # empty if no output has a lag
    t: float | None = None

    def __init__(
        self, shared: Mapping[str, object] | None = None, /, **fields: object
    ) -> None:
        # The generated `__init__` of a frozen dataclass would set three dozen fields one by one,
        # which takes as long as the dynamics of a small robot. So this method sets all fields at
        # once. The arrays in `shared` must be read-only, because they are not copied.
        for name, value in fields.items():
            if isinstance(value, np.ndarray) and value.flags.writeable:
                fields[name] = frozen(value.copy())
        vars(self).update(shared or {}, **fields)

    def __getattr__(self, name: str) -> object:
        # `shared["_computed"]` is {field: function of the model}. These fields are computed at the
        # first access, because the computation of each takes as long as the dynamics.
        make = vars(self).get("_computed", {}).get(name)
        if make is None:
            raise AttributeError(f"'LinearModel' object has no attribute '{name}'")
        return vars(self).setdefault(name, make(self))

    @property
    def reference(self) -> pin.SE3:
        """Placement oMref relative to which the attitude and position of the base are measured."""
        return pin.XYZQUATToSE3(self.placement)

    @property
    def time(self) -> float:
        """Time [s] for which the model holds; 0 if it does not depend on time."""
        return 0.0 if self.t is None else self.t

    @cached_property
    def M(self) -> Array:
        """Joint-space inertia matrix (6 + n, 6 + n) in state order, in the axes of `frame`."""
        return self._inertia(self)

    @property
    def fingerprint(self) -> str:
        """Hash of A, B and f0, used to detect later changes of these matrices."""
        digest = sha256()
        for array in (self.A, self.B, self.f0):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def require_unchanged(self) -> None:
        """Raise `ModelError` if the robot's Pinocchio model was modified after its creation."""
        if self._robot is not None:
            self._robot.require_unchanged()

    @property
    def generator(self) -> LinearModel | None:
        """The model itself, or the continuous-time model from which it was discretised.

        The value is None for a discrete-time model that was read from a file, or whose matrices
        were changed.
        """
        if not self.dt:
            return self
        if self._source is None or self._source[0] != self.fingerprint:
            return None
        return self._source[1].generator

    @property
    def rate(self) -> Array:
        """State derivative (nx,) at the operating point, also of a discrete-time model.

        For a model with ``moving=True``, the value is `drift`, the state derivative of the
        reference. For a discrete-time model, the value is f0 of its continuous-time model. If that
        model is unknown (see `generator`), the value is f0 / dt, the mean over one sample.
        """
        if self.drift is not None:
            return self.drift
        source = self.generator
        if source is None:
            return self.f0 / self.dt
        return np.append(source.f0, np.zeros(len(self.x0) - len(source.x0)))

    @property
    def rank(self) -> int:
        """Rank of the constraints: the number of velocities that they remove; 0 without any."""
        return len(self.dependent) // 2

    @property
    def independent(self) -> tuple[str, ...] | None:
        """Independent coordinates of a robot with constraints, as for `linearize`; None without.

        They are the positions among the states.
        """
        if not self.dependent:
            return None
        states = self.robot_states
        return states[: len(states) // 2]

    @property
    def delay(self) -> Array:
        """Delay (nu,) of each input [s]."""
        if not self._delays:
            return np.zeros(len(self.input_names))
        return np.array(self._delays)

    @property
    def lag(self) -> Array:
        """Time constant (nu,) of the lag of each input in the model [s]; 0 without a lag."""
        if not self._lags:
            return np.zeros(len(self.input_names))
        return np.array(self._lags)

    @property
    def output_lag(self) -> Array:
        """Time constant (ny,) of the lag of each output in the model [s]; 0 without a lag."""
        if not self._output_lags:
            return np.zeros(len(self.output_names))
        return np.array(self._output_lags)

    @property
    def robot_states(self) -> tuple[str, ...]:
        """Names of the states without those in `added`."""
        return self.state_names[: len(self.state_names) - len(self.added)]

    @cached_property
    def undelayed(self) -> LinearModel:
        """The model without delays and lags of its inputs; the model itself if it has none.

        Its states are the states of the robot. Its inputs, which are constant in time, have the
        same effect as constant commands of the model with delays and lags.
        """
        if not self.added:
            return self
        source = self.generator
        if self.dt and source is not None:
            return source.undelayed.discretize(self.dt)
        C, D = self._without_output_lags()
        count = len(self.robot_states)
        B = self.B[:count].copy()
        for at, name in enumerate(self.added, count):
            signal = name.partition(".")[2]
            if signal in self.input_names:
                index = self.input_names.index(signal)
                B[:, index] += self.A[:count, at]
                D[:, index] += C[:, at]
        drift = self.drift
        plain = replace(
            self,
            A=self.A[:count, :count],
            B=B,
            C=C[:, :count],
            D=D,
            f0=self.f0[:count],
            x0=self.x0[:count],
            state_names=self.state_names[:count],
            state_units=self.state_units[:count],
            drift=None if drift is None else drift[:count],
            added=(),
            _delays=(),
            _lags=(),
            _output_lags=(),
        )
        return replace(plain, _source=(plain.fingerprint, self))

    def _without_output_lags(self) -> tuple[Array, Array]:
        """Return C and D of the outputs without lags: y = y_s + T d(y_s)/dt."""
        C, D = self.C.copy(), self.D.copy()
        lags = self.output_lag
        if lags.any() and self.dt:
            raise InputError(
                "the model without the lags of its outputs is unknown, because the sampled model "
                "was read from a file or changed; linearise the robot again"
            )
        for row in np.flatnonzero(lags):
            at = self.state_names.index(lag_name(self.output_names[row]))
            C[row] += lags[row] * self.A[at]
            D[row] = lags[row] * self.B[at]
        return C, D

    @cached_property
    def certificate(self) -> Certificate:
        """Residuals of the model, computed at the first access."""
        if self._source is None:
            return self._certify(self)
        fingerprint, source = self._source
        if self.fingerprint != fingerprint:
            raise InputError(
                "A, B or f0 was changed after the certificate was computed; check the model with "
                "fflin.check(robot, lin)"
            )
        return source.certificate

    @cached_property
    def ignorable(self) -> tuple[str, ...]:
        """Names of the states that do not affect the dynamics, as derived from the robot.

        The ignorable states are:

        - the base position, except in orbit;
        - the angles of rotors, which are joints whose link is symmetric about the joint axis and
          carries no other link;
        - the base attitude, for `moving` models without gravity.
        """
        if self._ignorable is None:
            return ()
        return self._ignorable(self)

    @cached_property
    def wheels(self) -> tuple[str, ...]:
        """Names of the joints that are flown as reaction wheels.

        Designs do not regulate the angles of these joints, because no other state depends on them.
        The joints are:

        - each `ReactionWheel` with an inertia;
        - the joints in `Robot.wheel_joints`;
        - the rotors without position limits that spin at the operating point, see `ignorable`.
        """
        if self._wheels is not None:
            return self._wheels(self)
        # A model from another source than `linearize` is known only by its names.
        keys = (key.partition(".") for key in input_keys(self))
        named = (name for group, _, name in keys if group == "wheel")
        return tuple(name for name in named if f"qdot_m.{name}" in self.state_names)

    @cached_property
    def limits(self) -> Mapping[str, float]:
        """Limits {name of an input or state: limit} from the URDF, the inputs and `Robot.limits`.

        The limit of an input is its largest force or torque. The limit of a joint velocity in
        ``qdot_m`` is the largest speed [rad/s | m/s]. The limit of a joint position in ``q_m`` is
        the difference between its upper and lower limits [rad | m].
        """
        if self._limits is None:
            return {}
        return self._limits()

    def is_equilibrium(self, tol: float = 1e-9) -> bool:
        """Return whether the operating point is a fixed point or a relative equilibrium.

        In both cases, A and B are constant in time. At a relative equilibrium, coordinates that are
        `ignorable` move at constant rates, and all other coordinates are at rest. For example, a
        rotor spins, or the base has a constant velocity.

        By default, the state derivative `rate` is tested. For a model with ``moving=True``, f0 is
        always zero, so the motion of the reference is tested instead:

        - the velocities of the reference in base axes must be constant;
        - all joints except rotors must be at rest;
        - under gravity, the base may rotate only about the vertical.

        Parameters
        ----------
        tol : float
            Largest permitted rate, in SI units, of a coordinate that is not ignorable. In orbit
            the tolerance is multiplied by the mean motion, because the gravity gradient causes only
            small accelerations.
        """
        judged = [name not in self.ignorable for name in self.state_names]
        return bool(
            np.abs(self.rate[judged]).max(initial=0.0) <= self.bound(number("tol", tol))
        )

    def bound(self, tol: float) -> float:
        """Return the largest rate at an equilibrium: `tol`, or `tol` times mean motion in orbit."""
        return tol * min(1.0, self.mean_motion or 1.0)

    def with_lags(
        self, lag: Delay | None = None, output_lag: Delay | None = None
    ) -> LinearModel:
        r"""Return the model with the lags of its inputs and outputs.

        The force :math:`u_a` of an input with the time constant T is a further state:

        .. math:: \dot u_a = (u - u_a) / T,\qquad \dot x = A x + B u_a

        The state ``lag.tau_b.x`` is the torque that acts for the command ``tau_b.x``. Likewise, the
        value :math:`y_s` of a sensor with the time constant T is a state,
        :math:`\dot y_s = (y - y_s) / T`. Designs for this model contain the lags. A `StateFeedback`
        computes the forces from its own commands, so they need no sensor. Simulations contain the
        lags of the robot's inputs and outputs, whatever the law.

        Parameters
        ----------
        lag : float or mapping, optional
            Time constant T [s]: one for all inputs, or {name, group or pattern: T} with names of
            inputs.
        output_lag : float or mapping, optional
            Time constant T [s] of outputs, in the same forms with names of outputs. If both
            arguments are omitted, the lags are the fields `lag` of the robot's inputs and outputs.

        Returns
        -------
        LinearModel
            Continuous model, whose `added` states are the forces and the values of the sensors. Its
            `undelayed` is the model without lags.

        Raises
        ------
        InputError
            If the model is sampled or already has lags, or a time constant is negative. Also if no
            input and no output has a lag, or the model was read from a file and both arguments are
            missing.
        UnknownNameError
            If there is no such input or output.

        Examples
        --------
        >>> robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(lag=0.1)])
        >>> lin = fflin.linearize(robot).with_lags()
        >>> lin.added
        ('lag.tau_b.x', 'lag.tau_b.y', 'lag.tau_b.z')
        >>> sampled = lin.discretize(0.25, delay=0.1)
        >>> fflin.lqr(sampled).K.shape
        (3, 18)
        """
        if self.dt:
            raise InputError(
                f"the model is sampled at dt = {self.dt:g} s, expected a continuous model; add the "
                "lags first: lin.with_lags().discretize(dt)"
            )
        if self.added:
            raise InputError("the model already has lags; give lin.undelayed")
        lags, output_lags = _chosen_lags(self, lag, output_lag)
        model = _lagging_inputs(self, lags)
        model = _lagging_outputs(model, output_lags)
        return replace(model, _source=(model.fingerprint, self))

    def discretize(self, dt: float, delay: Delay = 0.0) -> LinearModel:
        r"""Return the discrete-time model, with the input held constant between samples.

        .. math::
            A_d = e^{A h}, \quad [B_d, f_d] = \int_0^h e^{A s}\,ds\,[B, f_0]

        At rest A^2 = 0, so that the series of the exponential ends after two terms:
        :math:`A_d = E + A h` and :math:`B_d = B h + A B h^2/2`, with the identity E; see (2.2) of
        docs/derivation.md.

        A and B of the operating point are used over the whole sample. If this point moves, as a
        joint that turns, they change meanwhile, so the result has an error that grows with the
        square of `dt` (1 % of A at 20 ms and 2 rad/s). For a motion, use
        `LinearTrajectory.discretize`.

        With a delay :math:`(k - 1) h + e`, where :math:`0 < e \le h`, a command acts from this time
        after its sample. The commands of the last k samples are further states:

        .. math:: x_{+} = e^{A h} x + e^{A (h - e)}\,\Gamma(e)\,u_{-k} + \Gamma(h - e)\,u_{-(k-1)},
                  \qquad \Gamma(s) = \int_0^s e^{A t}\,dt\,B

        The state ``past_2.tau_b.x`` is the command of the input ``tau_b.x`` two samples ago.

        Parameters
        ----------
        dt : float
            Sample time h [s], positive.
        delay : float or mapping, optional
            Delay [s] from a sample to the time from which its command acts: one for all inputs, or
            {name, group or pattern: delay} with names of inputs. The delay may be any fraction or
            multiple of `dt`.

        Returns
        -------
        LinearModel
            Discrete-time model with sample time ``dt``. Its `certificate` is the certificate of
            the continuous-time model. Its `added` states are the commands on their way.

        Raises
        ------
        InputError
            If `dt` is not positive, a delay is negative or longer than 500 samples, or the model is
            already in discrete time.
        UnknownNameError
            If there is no such input.
        ModelError
            If the robot's Pinocchio model (``robot.model``) was modified after the robot was
            created.

        Examples
        --------
        >>> lin = fflin.linearize(fflin.load("planar_detumble"))
        >>> late = lin.discretize(0.1, delay={"tau_b": 0.15})
        >>> late.added[:2], len(late.state_names)
        (('past_1.tau_b.x', 'past_2.tau_b.x'), 24)
        >>> fflin.lqr(late).K.shape
        (9, 24)
        """
        self.require_unchanged()
        dt = positive("dt", dt, "s")
        refuse_sampled(self.dt, "discretize")
        refuse_frozen(self, "discretize")
        delays = delays_of(self, delay, dt)
        Ad, held = held_exponential(self.A, np.column_stack((self.B, self.f0)), dt)
        if not (np.isfinite(Ad).all() and np.isfinite(held).all()):
            raise InputError(
                f"dt is {dt:g} s, over which the model's response overflows; give a smaller dt"
            )
        sampled = replace(self, A=Ad, B=held[:, :-1], f0=held[:, -1], dt=dt)
        if any(split(each, dt).samples for each in delays):
            sampled = _delayed(self, sampled, delays)
        return replace(sampled, _source=(sampled.fingerprint, self))

    def to(self, tool: str, *, dt: float | None = None) -> ToolModel:
        """Return the model in the coordinates of another tool, see `transform`."""
        from fflin import transform

        if self._robot is None:
            raise InputError(
                "the model does not contain its robot; use fflin.transform(robot, lin, tool)"
            )
        return transform(self._robot, self, tool, dt=dt)

    def to_scipy(self) -> signal.StateSpace:
        """Return the model of the deviations from x0 and u0 as a `scipy.signal.StateSpace`.

        Signal names and f0 are omitted, because a `StateSpace` cannot contain them.
        """
        from scipy.signal import StateSpace

        self.require_unchanged()
        refuse_frozen(self, "to_scipy")
        matrices = (self.A, self.B, self.C, self.D)
        if self.dt:
            return StateSpace(*matrices, dt=self.dt)
        return StateSpace(*matrices)

    def to_control(self) -> ControlSystem:
        """Return the model of the deviations from x0 and u0 as a `control.StateSpace`.

        The `StateSpace` has the signal names of the model. The constant f0 is omitted.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        InputError
            If two signals differ only by a dot or an underscore, because python-control has no dots
            in names.
        ModelError
            If the robot's Pinocchio model (``robot.model``) was modified after the robot was
            created.
        """
        self.require_unchanged()
        refuse_frozen(self, "to_control")
        matrices = (self.A, self.B, self.C, self.D)
        return state_space(
            matrices, self.dt, self.state_names, self.input_names, self.output_names
        )

    def save(self, path: str | Path) -> None:
        """Write the model and its certificate to a file, atomically.

        The file does not contain the sample times and delays of outputs. If an output has them,
        an `FflinWarning` is given, because `kalman` then designs for other sensors.

        Parameters
        ----------
        path : str or Path
            Path that ends in .npz, .mat, .json or .csv. For .csv, each matrix is written to a
            separate file, such as NAME.A.csv; these tables are for other programs, and `load` does
            not read them.

        Raises
        ------
        FileError
            If the path has another ending or the file cannot be written.
        InputError
            If a value is not finite.
        """
        from fflin.linear.files import record_of, write_model

        outputs = () if self._robot is None else self._robot.outputs
        if any(item.sample is not None or item.delay for item in outputs):
            warnings.warn(
                "the file does not contain the sample times and delays of the outputs, so kalman "
                "of the loaded model assumes that each sample measures all outputs at once",
                FflinWarning,
                stacklevel=2,
            )
        write_model(as_path(path), record_of(self), checksummed=self.verified)

    @staticmethod
    def load(path: str | Path) -> LinearModel:
        """Read a .npz, .mat or .json file that `save` wrote, and restore every value bit for bit.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged or does not contain a linear model.
        """
        from fflin.linear.files import given, read_model

        values, certificate = read_model(as_path(path), Certificate)
        lin = LinearModel(**values, _certify=partial(given, certificate))
        # Record the fingerprint of the values in the file. If A, B or f0 is changed later, the
        # certificate of the file is then refused.
        return replace(lin, _source=(lin.fingerprint, lin))


def state_space(
    matrices: Sequence[ArrayLike], dt: float, *signals: Sequence[str]
) -> ControlSystem:
    """Return a `control.StateSpace` with the matrices A, B, C, D and the names of all signals."""
    control = optional_package("control", "to_control needs python-control", "control")
    kinds = ("states", "inputs", "outputs")
    states, inputs, outputs = (
        _labels(*group) for group in zip(kinds, signals, strict=True)
    )
    return control.ss(*matrices, dt, states=states, inputs=inputs, outputs=outputs)


def _labels(kind: str, names: Sequence[str]) -> list[str]:
    """Return names for python-control, or raise `InputError` if two signals get the same name."""
    labels = dict[str, str]()
    for name in names:
        label = undotted(name)
        if label in labels:
            raise InputError(
                f"the {kind} '{labels[label]}' and '{name}' both get the name '{label}' in "
                "python-control, whose names contain no dots; rename one of them, such as its joint"
            )
        labels[label] = name
    return list(labels)


def refuse_sampled(dt: float, do: str) -> None:
    """Raise `InputError` for a discrete-time model, for which dt > 0.

    `do` is the verb of the error message, such as "check".
    """
    if dt:
        raise InputError(
            f"the model is already sampled, at dt = {dt:g} s; {do} the continuous-time model "
            "instead"
        )


def refuse_fixed(lin: LinearModel, what: str) -> None:
    """Raise `InputError` for a model without states, of a robot whose constraints fix it."""
    if not len(lin.A):
        raise InputError(
            f"{what} needs a model with states, but the constraints of '{lin.robot}' leave no "
            "coordinate free; remove a constraint"
        )


def refuse_frozen(lin: LinearModel, what: str) -> None:
    """Raise `InputError` for a model that holds at one time only.

    The models of robots in elliptic orbits and of robots with magnetorquers depend on time.

    `what` is the function or the feature that needs a model for all times.
    """
    if lin.t is not None:
        raise InputError(
            f"{what} needs a model that does not depend on time, but the model of '{lin.robot}' "
            f"holds only at t = {lin.t:g} s, because of an elliptic orbit or of magnetorquers; use "
            "linearize_orbit, then tvlqr or tvkalman with 'periodic', or fflin tvlqr --periodic N"
        )


def delays_of(lin: LinearModel, delay: Delay, dt: float) -> list[float]:
    """Return the delay of each input [s], or raise `InputError` if one is not possible."""
    if isinstance(delay, Mapping):
        values = numbers("delay", delay, "input", "delay of")
        value_at = by_name("input", values, input_keys(lin))
        delays = [value_at.get(index, 0.0) for index in range(len(lin.input_names))]
    else:
        delays = [number("delay", delay)] * len(lin.input_names)
    for name, value in zip(lin.input_names, delays, strict=True):
        if not 0.0 <= value <= MOST_SAMPLES * dt:
            raise InputError(
                f"delay of {name} is {value:g} s, expected at least 0 and at most {MOST_SAMPLES} "
                f"samples of {dt:g} s"
            )
    return delays


def _delayed(
    lin: LinearModel, sampled: LinearModel, delays: list[float]
) -> LinearModel:
    """Return the model `sampled` of the continuous model `lin` with delayed inputs."""
    held = HeldSystem(lin.A, lin.B, sampled.dt, np.array(delays))
    A, B = held.sampled()
    C, D = held.outputs(lin.C, lin.D)
    samples = [delay.samples for delay in held.delays]
    inputs = np.repeat(np.arange(len(delays)), samples)
    ago = [k for count in samples for k in range(1, count + 1)]
    added = tuple(
        past_name(k, lin.input_names[index])
        for k, index in zip(ago, inputs.tolist(), strict=True)
    )
    nothing = np.zeros(len(added))
    return replace(
        sampled,
        A=A,
        B=B,
        C=C,
        D=D,
        f0=np.append(sampled.f0, nothing),
        x0=np.append(lin.x0, lin.u0[inputs]),
        drift=None if lin.drift is None else np.append(lin.drift, nothing),
        state_names=(*lin.state_names, *added),
        state_units=(*lin.state_units, *(lin.input_units[index] for index in inputs)),
        added=(*lin.added, *added),
        _delays=tuple(delays),
    )


def _chosen_lags(
    lin: LinearModel, lag: Delay | None, output_lag: Delay | None
) -> tuple[list[float], list[float]]:
    """Return the time constants [s] of all inputs and outputs; at least one is positive."""
    if lag is None and output_lag is None:
        if lin._robot is None:
            raise InputError(
                "the model does not contain its robot, so the lags of its inputs are unknown; give "
                "lag="
            )
        state = StateMap(lin._robot, reference=lin.reference, frame=lin.frame)
        sensors = sensors_by_signal(state)
        lag = dict(zip(input_keys(lin), lags_of(lin._robot.named_inputs), strict=True))
        output_lag = {name: sensors[name].lag or 0.0 for name in lin.output_names}
    lags = _lags_by_name("input", lag, input_keys(lin))
    output_lags = _lags_by_name("output", output_lag, lin.output_names)
    if not any((*lags, *output_lags)):
        raise InputError(
            "no input has a lag; set the field lag of an input or output, such as "
            "fflin.BaseTorque(lag=0.1), or give lag="
        )
    return lags, output_lags


def _lags_by_name(kind: str, lag: Delay | None, names: Sequence[str]) -> list[float]:
    """Return the time constant [s] of each input or output with the given names."""
    if isinstance(lag, Mapping):
        values = numbers("lag", lag, kind, "lag of")
        value_at = by_name(kind, values, names)
        lags = [value_at.get(index, 0.0) for index in range(len(names))]
    else:
        lags = [0.0 if lag is None else number("lag", lag)] * len(names)
    for name, value in zip(names, lags, strict=True):
        if value < 0.0:
            raise InputError(f"lag of {name} is {value:g} s, expected at least 0")
    return lags


def _lagging_inputs(lin: LinearModel, lags: list[float]) -> LinearModel:
    """Return a continuous model with the forces of inputs with a lag as further states."""
    late = np.flatnonzero(lags)
    if not len(late):
        return lin
    rates = 1.0 / np.array(lags)[late]
    count = len(late)
    nx, nu = lin.B.shape
    direct = np.ones(nu)
    direct[late] = 0.0
    driven: Array = np.zeros((count, nu))
    driven[np.arange(count), late] = rates
    nothing = np.zeros(count)
    return replace(
        lin,
        A=np.block([[lin.A, lin.B[:, late]], [np.zeros((count, nx)), -np.diag(rates)]]),
        B=np.vstack((lin.B * direct, driven)),
        C=np.hstack((lin.C, lin.D[:, late])),
        D=lin.D * direct,
        f0=np.append(lin.f0, nothing),
        x0=np.append(lin.x0, lin.u0[late]),
        drift=None if lin.drift is None else np.append(lin.drift, nothing),
        state_names=(
            *lin.state_names,
            *(lag_name(lin.input_names[index]) for index in late),
        ),
        state_units=(*lin.state_units, *(lin.input_units[index] for index in late)),
        added=tuple(lag_name(lin.input_names[index]) for index in late),
        _lags=tuple(lags),
    )


def _lagging_outputs(lin: LinearModel, lags: list[float]) -> LinearModel:
    """Return a continuous model with the values of sensors with a lag as further states."""
    late = np.flatnonzero(lags)
    if not len(late):
        return lin
    rates = 1.0 / np.array(lags)[late]
    count = len(late)
    ny, nx = lin.C.shape
    direct: Array = np.ones((ny, 1))
    direct[late] = 0.0
    selected = np.zeros((ny, count))
    selected[late, np.arange(count)] = 1.0
    nothing = np.zeros(count)
    names = tuple(lag_name(lin.output_names[index]) for index in late)
    return replace(
        lin,
        A=np.block(
            [
                [lin.A, np.zeros((nx, count))],
                [rates[:, None] * lin.C[late], -np.diag(rates)],
            ]
        ),
        B=np.vstack((lin.B, rates[:, None] * lin.D[late])),
        C=np.hstack((direct * lin.C, selected)),
        D=direct * lin.D,
        f0=np.append(lin.f0, nothing),
        x0=np.append(lin.x0, lin.y0[late]),
        drift=None if lin.drift is None else np.append(lin.drift, nothing),
        state_names=(*lin.state_names, *names),
        state_units=(*lin.state_units, *(lin.output_units[index] for index in late)),
        added=(*lin.added, *names),
        _output_lags=tuple(lags),
    )


def refuse_delayed(lin: LinearModel, what: str) -> None:
    """Raise `InputError` for a model with delays or lags; `what` is the subject of the message."""
    if lin.added:
        raise InputError(
            f"{what} needs a model with the states of the robot alone, but this model has "
            f"{len(lin.added)} states of delays or lags ({lin.added[0]}, ...); give lin.undelayed"
        )
