"""A closed loop that every simulator can be given, and where it ends in truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import fflin
from benchmarks.peers import WrongResultError
from benchmarks.robots import Array, Point, load

# [rad/s] of every coordinate alone, slow enough to end in motion
FREQUENCY, DAMPING = 0.3, 0.7
WHEEL = 3e-6  # [kg m^2]


@dataclass(frozen=True)
class Loop:
    """A robot under u = -K x from a start.

    Attributes
    ----------
    K : ndarray (nu, nx)
    x0 : ndarray (nx,)
    frame : {"hybrid", "world"}
        Axes of x and u: those of MuJoCo's coordinates, or of Drake's.
    dt, duration : float
        [s]
    held : bool
        Whether u is held from step to step, or follows the state at all times.
    mrp : bool
        Whether x has modified Rodrigues parameters in the place of q_b, as Basilisk has it.
    """

    robot: fflin.Robot
    K: Array
    x0: Array
    dt: float
    duration: float
    frame: str = "hybrid"
    held: bool = False
    mrp: bool = False

    @property
    def steps(self) -> int:
        return round(self.duration / self.dt)

    @property
    def wheels(self) -> bool:
        return len(self.K) < 6

    def at_rest(self) -> "Loop":
        """Return the loop with a start without velocities."""
        return self.but(
            x0=np.where(np.arange(len(self.x0)) < 6 + self.robot.n, self.x0, 0.0)
        )

    def but(self, **changes: object) -> "Loop":
        return replace(self, **changes)

    def command(self, x: Array) -> Array:
        """Return u (nu,) of a state (nx,)."""
        if self.mrp:
            x = x.copy()
            x[:3] /= 1.0 + np.sqrt(1.0 - x[:3] @ x[:3])
        return -self.K @ x

    @cached_property
    def policy(self) -> fflin.StateFeedback:
        return fflin.StateFeedback(
            fflin.linearize(self.robot, frame=self.frame), self.K
        )

    @property
    def options(self) -> dict[str, object]:
        """What `simulate` and `monte_carlo` are given alike."""
        sample = {"sample": self.dt} if self.held else {}
        return {"x0": self.x0, "duration": self.duration, "dt": self.dt, **sample}

    @cached_property
    def point(self) -> Point:
        """The robot unturned and at rest, its joints at the start's, as the peers load it."""
        nothing = np.zeros(6 + self.robot.n)
        return Point(self.robot, self.x0[6 : len(nothing)], nothing, nothing)

    def require_same_inertia(self, whose: str, found: Array) -> None:
        """Raise `WrongResultError` where a peer has another M (6 + n, 6 + n) at the `point`."""
        M = fflin.linearize(self.robot, self.point.q).M
        apart = np.abs(found - M).max() / np.abs(M).max()
        if not apart < 1e-10:
            raise WrongResultError(
                f"{whose} on {self.robot.name}: M differs by {apart:.1e}"
            )


def driven(name: str, dt: float, duration: float) -> Loop:
    """Return a robot that every coordinate of is driven, as if each were alone."""
    robot = load(name)
    n = 6 + robot.n
    inertia = fflin.linearize(robot).M
    # q_b is half the turn
    stiffness = np.diag([2.0] * 3 + [1.0] * (n - 3)) * FREQUENCY**2
    K = inertia @ np.hstack((stiffness, 2.0 * DAMPING * FREQUENCY * np.eye(n)))
    return Loop(robot, K, _start(n), dt, duration)


def with_wheels(name: str, dt: float, duration: float) -> Loop:
    """Return a robot of one body, turned by three wheels along its axes."""
    wheels = [fflin.ReactionWheel(axis, inertia=WHEEL) for axis in np.eye(3).tolist()]
    robot = fflin.load(name, inputs=wheels)
    n, size = 6 + robot.n, float(robot.model.inertias[1].inertia.max())
    K = np.zeros((3, 2 * n))
    K[:, :3] = -2.0 * size * FREQUENCY**2 * np.eye(3)
    K[:, n : n + 3] = -2.0 * size * DAMPING * FREQUENCY * np.eye(3)
    x0 = _start(n)
    x0[3:n] = x0[n + 3 :] = 0.0
    return Loop(robot, K, x0, dt, duration)


def welded(loop: Loop) -> pin.Inertia:
    """Return the inertia of the body with its wheels as if they were welded."""
    model = loop.robot.model
    body = pin.Inertia(model.inertias[1])
    for index in range(2, model.njoints):
        body += model.jointPlacements[index].act(model.inertias[index])
    return body


def _start(n: int) -> Array:
    x0 = np.zeros(2 * n)
    x0[:3], x0[6:n], x0[n : n + 3] = (0.15, -0.1, 0.05), 0.2, (0.05, -0.02, 0.03)
    return x0


def true_end(loop: Loop) -> Array:
    """Return the last state (nx,) by SciPy's DOP853 of Pinocchio's accelerations."""
    truth = Equations(loop)
    y = truth.start(loop.x0)
    if not loop.held:
        return truth.state(_flow(truth.rate(loop.command), y, loop.duration))
    for _ in range(loop.steps):
        u = loop.command(truth.state(y))
        y = _flow(truth.rate(lambda x, u=u: u), y, loop.dt)
    return truth.state(y)


def _flow(rate: Callable[[float, Array], Array], y: Array, seconds: float) -> Array:
    found = solve_ivp(rate, (0.0, seconds), y, "DOP853", rtol=1e-12, atol=1e-13)
    end = found.y[:, -1]
    end[:4] /= np.linalg.norm(end[:4])
    return end


class Equations:
    """The equations of motion over y = (quaternion xyzw, r_b, q_m, local velocity)."""

    def __init__(self, loop: Loop) -> None:
        self.loop, self.model = loop, loop.robot.model
        self.data, self.n = self.model.createData(), loop.robot.n
        joints = [
            self.model.joints[self.model.getJointId(j.name)] for j in loop.robot.joints
        ]
        self._joints = [(joint.idx_q, joint.nq) for joint in joints]
        self._order = np.array([3, 4, 5, 0, 1, 2, *(joint.idx_v for joint in joints)])

    def start(self, x: Array) -> Array:
        n, R = 6 + self.n, pin.Quaternion(_w(x), *x[:3]).matrix()
        turned = R.T if self.loop.frame == "world" else np.eye(3)
        rates = turned @ x[n : n + 3], R.T @ x[n + 3 : n + 6], x[n + 6 :]
        return np.concatenate((x[:3], [_w(x)], x[3:n], *rates))

    def state(self, y: Array) -> Array:
        """Return x (nx,) in the loop's frame."""
        n, R = 7 + self.n, _rotation(y)
        turned = R if self.loop.frame == "world" else np.eye(3)
        rates = turned @ y[n : n + 3], R @ y[n + 3 : n + 6], y[n + 6 :]
        return np.concatenate((np.sign(y[3]) * y[:3], y[4:n], *rates))

    def rate(
        self, command: Callable[[Array], Array]
    ) -> Callable[[float, Array], Array]:
        """Return dy/dt of y under a command u of the state."""
        model, order, n = self.model, self._order, 7 + self.n
        q, v, tau = np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.nv)
        world = self.loop.frame == "world"

        def rate(_: float, y: Array) -> Array:
            u, R = command(self.state(y)), _rotation(y)
            q[:3], q[3:7] = y[4:7], y[:4] / np.linalg.norm(y[:4])
            for (at, width), angle in zip(self._joints, y[7:n], strict=True):
                q[at : at + width] = (
                    angle if width == 1 else (np.cos(angle), np.sin(angle))
                )
            v[order] = y[n:]
            if self.loop.wheels:
                tau[order[6:]] = u
            else:
                torque = R.T @ u[:3] if world else u[:3]
                tau[order] = np.concatenate((torque, R.T @ u[3:6], u[6:]))
            omega, vector = y[n : n + 3], y[:3]
            turning = 0.5 * np.append(
                y[3] * omega + np.cross(vector, omega), -vector @ omega
            )
            moving = R @ y[n + 3 : n + 6]
            a = pin.aba(model, self.data, q, v, tau)[order]
            return np.concatenate((turning, moving, y[n + 6 :], a))

        return rate


def _rotation(y: Array) -> Array:
    x, y, z, w = y[:4] / np.linalg.norm(y[:4])
    return pin.Quaternion(w, x, y, z).matrix()


def _w(x: Array) -> float:
    return float(np.sqrt(1.0 - x[:3] @ x[:3]))


def error(loop: Loop, x: Array, expected: Array) -> float:
    """Return the largest error of a last state, relative to the largest entry of the start.

    Wheels are left out: their speeds have the momentum that the body has not, far from 1.
    """
    kept, n = np.ones(len(x), bool), 6 + loop.robot.n
    kept[6:n] = kept[n + 6 :] = not loop.wheels
    worst = float((np.abs(x - expected) / np.abs(loop.x0).max())[kept].max())
    return worst if np.isfinite(x).all() else np.inf
