"""Periodic motions of a robot in orbit, and the linear models over one period (section 17)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.linalg import expm

from fflin.base.errors import EquilibriumError, InputError
from fflin.base.process import in_one_thread
from fflin.base.validation import Array, ArrayLike, count, positive
from fflin.dynamics.aba import Aba
from fflin.dynamics.coordinates import refuse_constraints
from fflin.dynamics.integrators import DEFAULT_INTEGRATOR
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moving_error
from fflin.linear.linear_trajectory import LinearTrajectory, along
from fflin.linear.linearization import Linearizer
from fflin.linear.trajectory import Trajectory
from fflin.robot.inputs import has_magnetorquers
from fflin.robot.joints import ROOT
from fflin.robot.orbit import TILTED_DIPOLE
from fflin.robot.outputs import FullState
from fflin.robot.robot import Robot

# Forces that the inputs cannot balance, relative to all forces, count as zero below this.
_BALANCED = 1e-9

# Momentum that wheels gain in one period, relative to the momentum that they exchange.
_PERIODIC = 1e-6

# Newton's method for a free periodic motion: the largest number of iterations, the largest relative
# error of the closed motion, and the relative size below which singular values count as zero.
_MOST_ITERATIONS, _CLOSED, _SINGULAR = 30, 1e-11, 1e-7

# The integration of a free motion takes steps of at most this many radians of the fastest pole, and
# at most this many steps in one period.
_LONGEST_STEP, _MOST_STEPS = 0.05, 40_000


@in_one_thread
def linearize_orbit(
    robot: Robot,
    q: ArrayLike | None = None,
    *,
    motion: str = "held",
    steps: int = 200,
    period: float | None = None,
) -> LinearTrajectory:
    r"""Linearise a robot over one period of its orbit, about a periodic motion.

    In an elliptic orbit, no constant inputs hold a robot at rest, so it has no equilibrium. Its
    periodic motions replace the equilibria. The errors relative to such a motion obey a linear
    model with the period of the orbit.

    Parameters
    ----------
    robot : Robot
        Robot in orbit.
    q : array_like (nq,), optional
        Configuration relative to the orbital frame with the axes ``lvlh``, in Pinocchio's order;
        neutral by default. If no input pushes the base and q[:3] is zero, the base is displaced so
        that the centre of mass is at the origin of the frame.
    motion : {"held", "free"}
        The periodic motion:

        - held: base and joints are at rest at q in the orbital frame. The inputs of least norm
          balance the gravity gradient and the acceleration of the frame. If only wheels can do
          this, they accelerate. Their initial speeds are such that their speeds are periodic;
        - free: all inputs are zero. The motion is the periodic motion nearest to q at rest, such as
          the forced pitch motion of a satellite in an elliptic orbit.
    steps : int
        Number of intervals between the knots of one period.
    period : float, optional
        Time [s] after which the magnetic field repeats in the orbital frame; by default the period
        of the orbit. If the orbit is elliptic, it must be a multiple of that period. Only fields
        for magnetorquers need another period, such as a tilted dipole, which rotates with the
        earth. Its field repeats if the ground track of the orbit does.

    Returns
    -------
    LinearTrajectory
        Model of the errors in base axes, with knots from t = 0 to one period. Its ``period`` is
        positive, and its ``multipliers`` show whether the motion is stable.

    Raises
    ------
    InputError
        If the robot is not in orbit or has constraints, `motion` is unknown, a free motion needs
        too many steps, or the field of magnetorquers does not repeat after one period.
    EquilibriumError
        If the inputs cannot hold the robot, the wheels gain momentum in every period, or no free
        periodic motion is found near q.

    Examples
    --------
    >>> orbit = fflin.EllipticOrbit(perigee=500e3, eccentricity=0.05)
    >>> robot = fflin.load("cubesat", orbit=orbit)
    >>> along = fflin.linearize_orbit(robot, steps=60)
    >>> along.A.shape, along.period == orbit.period
    ((61, 12, 12), True)
    >>> fflin.tvlqr(along, 1.0, 1e4, "periodic", sample=orbit.period / 60).K.shape
    (61, 6, 12)
    """
    if getattr(robot, "orbit", None) is None:
        raise InputError(
            f"'{getattr(robot, 'name', robot)}' is not in orbit; give it an orbit by "
            "robot.replace(orbit=fflin.EllipticOrbit(perigee=..., apogee=...)) or --orbit"
        )
    assert robot.orbit is not None
    refuse_constraints(robot, "linear models over one orbit")
    if not isinstance(motion, str) or motion not in ("held", "free"):
        raise InputError(f"motion is {motion!r}, expected 'held' or 'free'")
    steps = count("steps", steps, 8)
    period = _checked_period(robot, period)
    times = np.linspace(0.0, period, steps + 1)
    q0 = robot.neutral() if q is None else robot.checked_configuration(q).copy()
    problem = _Problem(robot)
    if not q0[:3].any() and not problem.pushes:
        q0 = problem.centred(q0)
    path = problem.held(q0, times) if motion == "held" else problem.free(q0, times)
    knots = times, path.q, path.v, path.u
    return along(Trajectory(robot, *knots, hold="smooth", period=period))


def _checked_period(robot: Robot, period: float | None) -> float:
    """Return the period [s] of the models; refuse a field that rotates without a given period."""
    orbit = robot.orbit
    assert orbit is not None
    if period is not None:
        return positive("period", period, "s")
    if orbit.field == TILTED_DIPOLE and has_magnetorquers(robot.inputs):
        raise InputError(
            f"the tilted dipole of '{robot.name}' rotates with the earth, so that its field does "
            f"not repeat after one orbit of {orbit.period:.6g} s; give period=, after which the "
            "ground track repeats, or design with field='dipole'"
        )
    return orbit.period


class _Path(NamedTuple):
    """Knots of a motion: q (N, nq), v (N, nv) and the inputs u (N, nu) in base axes."""

    q: Array
    v: Array
    u: Array


class _Problem:
    """Periodic motions of one robot in orbit."""

    def __init__(self, robot: Robot) -> None:
        assert robot.orbit is not None
        self.robot = robot
        self.period = robot.orbit.period
        self.linearizer = Linearizer(robot.replace(outputs=[FullState()]), moving=True)
        self.state = StateMap(robot, frame="local")
        self.actuation = self.linearizer.prepared.actuation
        columns = self.actuation.columns(robot.create_data(), robot.neutral())
        # Whether an input exerts a net force on the robot.
        self.pushes = bool(columns[3:6].any())

    def centred(self, q: Array) -> Array:
        """Return q with the base displaced so that the centre of mass is at the origin."""
        robot = self.robot
        q = q.copy()
        center = pin.centerOfMass(robot.model, robot.create_data(), q)
        q[:3] -= robot.model.jointPlacements[ROOT].rotation.T @ center
        return q

    def held(self, q: Array, times: Array) -> _Path:
        """Return the motion at rest at q, held by the inputs. If needed, wheels accelerate."""
        robot = self.robot
        still = np.zeros(robot.nv)
        knots = [self._balance(q, still, t, ()) for t in times.tolist()]
        rows = np.tile(q, (len(times), 1))
        if all(knot.balanced for knot in knots):
            u = np.array([knot.u for knot in knots])
            return _Path(rows, np.zeros((len(times), robot.nv)), u)
        names = robot.wheels_at(still)
        wheels = tuple(joint.idx_v for joint in robot.joints if joint.name in names)
        if not wheels:
            raise EquilibriumError(
                f"the inputs of '{robot.name}' cannot hold it at rest in its orbit, because "
                f"nothing balances {knots[0].missing or knots[len(knots) // 4].missing}; give "
                "more inputs, or motion='free'"
            )
        return self._held_by_wheels(q, times, wheels)

    def _balance(
        self, q: Array, v: Array, t: float, wheels: tuple[int, ...]
    ) -> _Balance:
        """Return the inputs that keep all velocities constant at time t, except the wheels'."""
        lin = self.linearizer(q, v, t=t)
        nv = len(lin.M)
        acceleration = lin.rate[nv:]
        M = lin.M
        mobility = np.sqrt(np.linalg.inv(M).diagonal())
        index = [
            6 + k for k, joint in enumerate(self.robot.joints) if joint.idx_v in wheels
        ]
        others = np.setdiff1d(np.arange(nv), index)
        # The inputs u cause the accelerations B u. All rows except the wheels' must vanish.
        scale = 1.0 / mobility[others]
        B = scale[:, None] * lin.B[nv:][others]
        # Linear models require that the moments of magnetorquers are zero.
        B[:, [number for _, number, _ in self.actuation.torquers]] = 0.0
        wanted = -scale * acceleration[others]
        u = np.linalg.lstsq(B, wanted, rcond=1e-12)[0]
        left = B @ u - wanted
        size = float(np.abs(wanted).max())
        floor = self.robot.orbit.mean_motion**2 * np.abs(scale).max()  # type: ignore[union-attr]
        allowed = _BALANCED * max(size, float(floor))
        missing = ""
        if np.abs(left).max() > allowed:
            worst = int(np.abs(left).argmax())
            missing = lin.state_names[nv + int(others[worst])]
        rate = acceleration + lin.B[nv:] @ u
        return _Balance(u, missing, rate[index])

    def _held_by_wheels(self, q: Array, times: Array, wheels: tuple[int, ...]) -> _Path:
        """Return the motion at rest at q, held by wheels whose speeds are periodic."""
        robot = self.robot
        index = list(wheels)

        def rate(t: float, speeds: Array) -> _Balance:
            v = np.zeros(robot.nv)
            v[index] = speeds
            balance = self._balance(q, v, t, wheels)
            if balance.missing:
                raise EquilibriumError(
                    f"the wheels of '{robot.name}' cannot hold it at rest in its orbit, because "
                    f"nothing balances {balance.missing}; give more inputs, or motion='free'"
                )
            return balance

        def flow(speeds: Array) -> Array:
            rows = [speeds]
            for start, end in pairwise(times.tolist()):
                rows.append(_runge_kutta(rate, start, end, rows[-1]))
            return np.array(rows)

        # The torques are linear in the speeds of the wheels, so one step of Newton's method finds
        # the initial speeds.
        zero = np.zeros(len(wheels))
        drift = flow(zero)
        unit = self._speed_unit(drift)
        columns = [flow(unit * e)[-1] - drift[-1] for e in np.eye(len(wheels))]
        jacobian = np.column_stack(columns) / unit - np.eye(len(wheels))
        start = np.linalg.lstsq(jacobian, -drift[-1], rcond=_PERIODIC)[0]
        speeds = flow(start)
        gained = speeds[-1] - speeds[0]
        largest = int(np.abs(gained).argmax())
        if np.abs(gained).max() > _PERIODIC * max(1e-300, float(np.ptp(speeds))):
            name = next(j.name for j in robot.joints if j.idx_v == index[largest])
            raise EquilibriumError(
                f"the wheel '{name}' gains {gained[largest]:.3g} rad/s in every period, so that "
                f"wheels alone cannot hold '{robot.name}' at this attitude; choose an attitude "
                "without a mean torque about the orbit normal, or give other inputs"
            )
        speeds[-1] = speeds[0]
        v = np.zeros((len(times), robot.nv))
        v[:, index] = speeds
        pairs = zip(times.tolist(), speeds, strict=True)
        u = np.array([rate(t, row).u for t, row in pairs])
        return _Path(self._turned_wheels(q, times, v), v, u)

    def _speed_unit(self, drift: Array) -> float:
        """Return a wheel speed [rad/s] for differences, of the size of the exchanged speeds."""
        return float(np.abs(drift).max()) or 1.0

    def _turned_wheels(self, q: Array, times: Array, v: Array) -> Array:
        """Return q (N, nq) with the angles that the wheels reach by their speeds v (N, nv)."""
        model = self.robot.model
        rows = [q]
        for k, h in enumerate(np.diff(times).tolist()):
            rows.append(pin.integrate(model, rows[-1], 0.5 * h * (v[k] + v[k + 1])))
        return np.array(rows)

    def free(self, q: Array, times: Array) -> _Path:
        """Return the periodic motion without inputs nearest to q at rest."""
        robot = self.robot
        start: tuple[Array, Array] = (q, np.zeros(robot.nv))
        lin = self.linearizer(*start)
        fastest = float(np.abs(np.linalg.eigvals(lin.A)).max())
        h = float(times[1] - times[0])
        parts = max(4, int(np.ceil(h * fastest / _LONGEST_STEP)))
        if parts * (len(times) - 1) > _MOST_STEPS:
            raise InputError(
                f"'{robot.name}' has a pole of {fastest:.3g} rad/s, so that a free motion over "
                f"one period of {self.period:.4g} s needs {parts * (len(times) - 1)} steps, more "
                f"than {_MOST_STEPS}; lock the joints that vibrate, or give motion='held'"
            )
        # Velocities are compared with positions by the mean motion.
        n = 2.0 * np.pi / self.period
        nv = len(lin.M)
        unit = np.repeat((1.0, n), nv)
        for _ in range(_MOST_ITERATIONS):
            path, transition = self._flow(start, times, parts)
            gap = moving_error(self.state, *start, path.q[-1], path.v[-1])
            gap[self._angles()] = 0.0
            scaled = gap / unit
            if np.abs(scaled).max() <= _CLOSED * (1.0 + np.abs(path.v).max() / n):
                path.q[-1] = path.q[0]
                path.v[-1] = path.v[0]
                return path
            jacobian = (transition - np.eye(2 * nv)) * unit / unit[:, None]
            step = np.linalg.lstsq(jacobian, -scaled, rcond=_SINGULAR)[0] * unit
            largest = float(np.abs(step[:3]).max())
            step *= min(1.0, 0.2 / max(largest, 1e-300))
            start = self._moved(start, step)
        raise EquilibriumError(
            f"no free periodic motion of '{robot.name}' was found near the given configuration; "
            "give q nearer to one, such as an attitude of fflin.relative_equilibria in a circular "
            "orbit, a smaller eccentricity, or motion='held'"
        )

    def _angles(self) -> list[int]:
        """Return the indices in the state of angles that need not repeat: of wheels."""
        rotors = self.robot.rotors
        return [
            6 + k for k, joint in enumerate(self.robot.joints) if joint.name in rotors
        ]

    def _moved(self, start: tuple[Array, Array], e: Array) -> tuple[Array, Array]:
        """Return q and v displaced by an error e (nx,) in base axes."""
        q, v = start
        nv = len(e) // 2
        tangent = e[:nv].copy()
        tangent[:3] *= 2.0  # from the vector part of a quaternion to a rotation
        moved = pin.integrate(self.robot.model, q, self.state.spread(tangent))
        return moved, v + self.state.spread(e[nv:])

    def _flow(
        self, start: tuple[Array, Array], times: Array, parts: int
    ) -> tuple[_Path, Array]:
        """Integrate the free motion; return its knots and the transition matrix of the errors."""
        robot = self.robot
        aba = Aba(self.state)
        none = np.zeros(len(self.actuation.names))
        h = float(times[1] - times[0]) / parts
        method = DEFAULT_INTEGRATOR(robot.model, h)

        def acceleration(t: float, q: Array, v: Array) -> Array:
            self.state.move_to(t)
            return aba.acceleration(q, v, none).copy()

        q, v = start
        rows = [start]
        transition = np.eye(2 * len(self.state.velocities(v)))
        for begin in times[:-1].tolist():
            for part in range(parts):
                t = begin + part * h
                before = q, v
                q, v = method.step(acceleration, t, q, v)
                transition = self._step_map(t, h, before, (q, v)) @ transition
            rows.append((q, v))
        knots = _Path(
            np.array([row[0] for row in rows]),
            np.array([row[1] for row in rows]),
            np.zeros((len(times), len(none))),
        )
        return knots, transition

    def _step_map(
        self,
        t: float,
        h: float,
        before: tuple[Array, Array],
        after: tuple[Array, Array],
    ) -> Array:
        """Return the transition matrix of the errors over a step, by its middle."""
        model = self.robot.model
        speed = 0.5 * (before[1] + after[1])
        q = pin.integrate(model, before[0], 0.5 * h * before[1])
        lin = self.linearizer(q, speed, t=t + 0.5 * h)
        step: Array = expm(h * lin.A)
        return step


class _Balance(NamedTuple):
    """Inputs u (nu,), the name of a velocity that they cannot hold, and accelerations of wheels."""

    u: Array
    missing: str
    wheel_rates: Array

    @property
    def balanced(self) -> bool:
        """Whether all velocities are held."""
        return not self.missing


def _runge_kutta(
    rate: Callable[[float, Array], _Balance], t: float, end: float, x: Array
) -> Array:
    """Return x at `end` by one step of the classical Runge-Kutta method."""
    h = end - t
    first = rate(t, x).wheel_rates
    second = rate(t + 0.5 * h, x + 0.5 * h * first).wheel_rates
    third = rate(t + 0.5 * h, x + 0.5 * h * second).wheel_rates
    fourth = rate(end, x + h * third).wheel_rates
    result: Array = x + h / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
    return result
