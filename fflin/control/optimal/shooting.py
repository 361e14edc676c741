"""Multiple shooting: initial guess, motions of the intervals, gaps between them, Jacobians."""

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.linalg import qr

from fflin.base.errors import InputError, located
from fflin.base.rotation import rotation_matrices
from fflin.base.validation import Array, Indices, Mask
from fflin.dynamics.aba import Aba
from fflin.dynamics.closure import Closure
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.integrators import (
    DEFAULT_INTEGRATOR,
    CommutatorFree4,
    integrate_rows,
)
from fflin.dynamics.projection import ProjectedAba
from fflin.dynamics.state import StateMap
from fflin.linear.linearization import Linearizer
from fflin.linear.trajectory import cubic
from fflin.robot.inputs import JointTorque
from fflin.robot.robot import Robot

_FEWEST_STEPS, _MOST_STEPS = 4, 128

# Least number of steps per interval in a trial. Limits also apply within an interval, at the ends
# of up to this many equal parts. A part must end where a step ends, so all numbers of steps and of
# parts are powers of 2.
_STEPS = 16

# Jacobians are integrated with a quarter of the steps of the motion, but with at most this number
# of steps.
_MOST_OF_JACOBIANS = 16

# A step of h [s] multiplies the part of an error that belongs to the pole lambda by R(lambda h)
# instead of exp(lambda h). The relative difference of these factors is at most _RESOLVED h / T, so
# that it adds up to _RESOLVED over the duration T of the plan, or at most _RESOLVED |Re lambda| h.
# An interval has at most _MOST_RESOLVING steps for this reason.
_RESOLVED, _MOST_RESOLVING = 0.1, 1024

# Newton's method joins the motions of the intervals in at most this many steps.
_MOST_JOINING = 5

# A prescribed state is determined by others if its pivot is below this fraction of the largest.
_DETERMINED = 1e-6

Point = tuple[Array, Array]


class Charts(NamedTuple):
    """Independent coordinates of the steps z of the knots, nz for each knot.

    The constraints of the robot determine the other entries of z. Without constraints, all entries
    are independent.
    """

    kept: Indices  # indices (N + 1, nz) of the independent entries of z
    T: Array  # (N + 1, nx, nz): z of a knot as a linear function of its independent entries


# Configurations (N, steps + 1, nq) and velocities (N, steps + 1, nv) of the motions over N
# intervals. The first row of a motion is its knot, and each step adds a row.
Motions = tuple[Array, Array]


class Shooting:
    """Multiple shooting over N intervals between equally spaced knots.

    `t` (N + 1,) contains the times [s] of the knots. Inputs are constant over an interval if `held`
    is True, and linear otherwise. The angles of the joints `wheels`, by
    default the wheels of the robot, are free.
    """

    # A step z (nx,) from one point to another has the order of the state of a linear model, in base
    # axes. Its first three entries are a rotation vector, which is 2 q_b to first order.

    def __init__(
        self, robot: Robot, t: Array, held: bool, wheels: Iterable[str] | None = None
    ) -> None:
        self.state = StateMap(robot, frame="local")
        self.t = t
        self.held = held
        self.steps = _FEWEST_STEPS
        # Least number of steps per interval that resolve all poles of the robot, see `refine`.
        self.resolving = 1
        self.h = np.diff(t)
        self._aba = Aba(self.state)
        # Projection on the constraints of the robot, or None if it has none.
        self._projected: ProjectedAba | None = None
        if robot.constraints:
            self._aba = self._projected = ProjectedAba(self.state)
        self._linearizer = Linearizer(robot, moving=True)
        free = robot.wheels if wheels is None else wheels
        self.wheels = [self.state.names.index(f"q_m.{name}") for name in free]
        # Positions of joints with springs but without motors, such as modes of flexible appendages.
        self.deflections = [
            self.state.names.index(f"q_m.{name}") for name in passive_springs(robot)
        ]
        self._size = np.where(np.arange(self.state.nx) < 3, 2.0, 1.0)

    def between(self, start: Point, end: Point) -> Array:
        """Return the step z (nx,) from `start` to `end`, with zero change of the wheel angles."""
        z = self._step_between(start, end)
        z[self.wheels] = 0.0
        return z

    def _step_between(self, start: Point, end: Point) -> Array:
        """Return the step z (nx,) from `start` to `end`."""
        state = self.state
        difference = pin.difference(state.robot.model, start[0], end[0])
        return np.concatenate(
            (state.velocities(difference), state.velocities(end[1] - start[1]))
        )

    def moved(self, q: Array, v: Array, z: Array) -> Point:
        """Return the knots q, v after steps z (N + 1, nx), one for each knot."""
        difference, rates = np.split(z, 2, axis=1)
        moved_q = integrate_rows(
            self.state.robot.model, q, self.state.spread(difference)
        )
        return self._closed(moved_q, v + self.state.spread(rates))

    def _closed(self, q: Array, v: Array) -> Point:
        """Return points (k, nq), (k, nv) on the constraints of the robot, near given points."""
        if self._projected is None:
            return q, v
        return self._projected.closed(q, v)

    def charts(self, q: Array, v: Array) -> Charts:
        """Return the independent coordinates of the steps of the knots q, v."""
        nx = self.state.nx
        if self._projected is None:
            kept = np.broadcast_to(np.arange(nx), (len(q), nx))
            return Charts(kept, np.broadcast_to(np.eye(nx), (len(q), nx, nx)))
        reductions = [
            self._linearizer.reduction(*point) for point in zip(q, v, strict=True)
        ]
        kept = np.array([reduction.kept for reduction in reductions])
        maps = np.array([reduction.T for reduction in reductions])
        return Charts(kept, self._size[:, None] * maps / self._size[kept][:, None])

    def determining(self, end: Point, asked: Mask) -> Mask:
        """Return prescribed states (nx,) that determine all prescribed states near a goal.

        `asked` (nx,) is True for the prescribed states. Without constraints, no state determines
        another one.
        """
        if self._projected is None:
            return asked
        rows = np.flatnonzero(asked)
        (T,) = self.charts(end[0][None], end[1][None]).T
        R, order = qr(T[rows].T, mode="r", pivoting=True)
        sizes = np.abs(R.diagonal())
        rank = int((sizes > _DETERMINED * sizes.max(initial=0.0)).sum())
        determining = np.zeros_like(asked)
        determining[rows[order[:rank]]] = True
        return determining

    def motions(
        self, q: Array, v: Array, u: Array, steps: int = 0, t: Array | None = None
    ) -> Motions:
        """Integrate each interval from its first knot; q, v and the inputs u have N + 1 rows each.

        By default, each interval has the number of steps that `refine` found, but at least _STEPS.
        `t` (N,) contains the times of the first knots, by default of all intervals of the plan.
        """
        q = q[:-1]
        v = v[:-1]
        first = u[:-1]
        steps = steps or max(self.steps, _STEPS)
        h = self.h[0]
        begin = self.t[:-1] if t is None else t
        change = 0.0 * first if self.held else np.diff(u, axis=0)
        method = DEFAULT_INTEGRATOR(self.state.robot.model, h / steps, len(q))
        points = [(q, v)]

        def rate(t: float, q: Array, v: Array) -> Array:
            return self._aba.accelerations(q, v, first + t / h * change, begin + t)

        for step in range(steps):
            end = method.step(rate, step * method.dt, *points[-1])
            points.append(self._closed(*end))
        configurations, speeds = zip(*points, strict=True)
        return np.stack(configurations, axis=1), np.stack(speeds, axis=1)

    def missed(self, q: Array, v: Array, motions: Motions) -> Array:
        """Return the gaps (N, nx): the steps from a knot to the end of the motion before it."""
        configurations, velocities = motions
        gaps = []
        for k in range(1, len(q)):
            end = configurations[k - 1, -1], velocities[k - 1, -1]
            gaps.append(self.between((q[k], v[k]), end))
        return np.array(gaps)

    def flown(self, start: Point, u: Array) -> Point:
        """Integrate the motion from a point under the inputs u; return q and v at the knots."""
        q, v = (np.tile(values, (len(u), 1)) for values in start)
        for k in range(len(u) - 1):
            ends = slice(k, k + 2)
            motions = self.motions(q[ends], v[ends], u[ends], t=self.t[k : k + 1])
            q[k + 1], v[k + 1] = motions[0][0, -1], motions[1][0, -1]
        return q, v

    def joined(
        self, start: Point, q: Array, v: Array, u: Array, rounding: float
    ) -> Point | None:
        """Return the knots of the motion from a point under the inputs u.

        The knots q, v must be near this motion. Newton's method moves them until no gap exceeds
        `rounding`, relative to the state. Return None if it does not converge.
        """
        ends, _ = self.jacobians(q, v, u)
        charts = self.charts(q, v)
        nz = charts.kept.shape[1]
        q = q.copy()
        v = v.copy()
        for _ in range(_MOST_JOINING):
            q[0], v[0] = start
            configurations, velocities = self.motions(q, v, u)
            step = np.zeros(nz)
            z = np.zeros((len(q), self.state.nx))
            largest = 0.0
            for k in range(1, len(q)):
                end = configurations[k - 1, -1], velocities[k - 1, -1]
                gap = self._step_between((q[k], v[k]), end)
                size = 1.0 + np.abs(self.state.velocities(v[k])).max()
                largest = max(largest, float(np.abs(gap).max()) / size)
                step = ends[k - 1, :, :nz] @ step + gap[charts.kept[k]]
                z[k] = charts.T[k] @ step
            if largest <= rounding:
                return q, v
            if not np.isfinite(z).all():
                return None
            q, v = self.moved(q, v, z)
        return None

    def limited_values(self, q: Array, v: Array) -> Array:
        """Return the values (.., nx) of the states that can have limits: joint positions and rates.

        The values of the base are zero.
        """
        state = self.state
        n = state.robot.n
        values = np.zeros((*q.shape[:-1], state.nx))
        values[..., 6 : 6 + n] = state.joint_positions(q)
        values[..., state.nx - n :] = state.velocities(v)[..., 6:]
        return values

    def inside(self, motions: Motions, parts: int) -> Array:
        """Divide each interval into equal parts; return `limited_values` at the end of each part.

        The values have the shape (N, parts, nx).
        """
        q, v = motions
        every = (q.shape[1] - 1) // parts
        return self.limited_values(q[:, every::every], v[:, every::every])

    def refine(self, q: Array, v: Array, u: Array, accuracy: float) -> None:
        """Double the number of steps until the interval ends have the given accuracy [rad, m, s].

        The accuracy of a wheel's rate is relative to its largest rate, if this exceeds 1 rad/s.
        The steps resolve all poles of the robot, also of modes that the given motion does not
        excite. Otherwise, their number is at most _MOST_STEPS.
        """
        nx = self.state.nx
        tolerance = np.full(nx, accuracy)
        rates = self.state.velocities(v)
        for i in self.wheels:
            tolerance[nx // 2 + i] *= max(1.0, np.abs(rates[:, i]).max())
        self.resolving = self._resolving(q, v, u)
        self.steps = max(_FEWEST_STEPS, self.resolving)
        missed = self.missed(q, v, self.motions(q, v, u, self.steps))
        while self.steps < _MOST_STEPS:
            self.steps *= 2
            before = missed
            missed = self.missed(q, v, self.motions(q, v, u, self.steps))
            if (np.abs(missed - before) <= tolerance).all():
                break

    def jacobians(
        self,
        q: Array,
        v: Array,
        u: Array,
        parts: int = 1,
        charts: Charts | None = None,
    ) -> tuple[Array, Array]:
        """Return the Jacobians of the interval ends, and of points within the intervals.

        The first array (N, nz, nz + 2 nu) contains the Jacobians of the interval ends, in the
        independent coordinates of the next knot, with respect to three vectors: the step of the
        first knot in its independent coordinates, the inputs at the first knot, and the inputs at
        the next knot. The second array (N, parts - 1, nx, nz + 2 nu) contains the Jacobians of the
        points that divide each interval into equal parts.
        """
        # Integrate dZ/dt = A Z + G along the motions by Runge-Kutta steps. Z contains the Jacobians
        # of all intervals, and G = [0, (1 - s) B, s B], because the input is (1 - s) times the
        # input at the first knot plus s times the input at the next knot. A and B are computed at
        # the stages of these steps: the beginning, the middle and the end of each step. If fast
        # poles require it, a step has substeps, between which A and B are interpolated.
        N = len(self.h)
        nx = len(self._size)
        nu = u.shape[1]
        if charts is None:
            charts = self.charts(q, v)
        nz = charts.kept.shape[1]
        steps = min(self.steps // 4, _MOST_OF_JACOBIANS)
        substeps = max(1, self.resolving // steps)
        stages = 2 * steps + 1  # of an interval; neighbouring steps share a stage
        s = np.arange(stages) / (2.0 * steps)
        times = self.t[:-1, None] + s * self.h[:, None]
        if self.held:
            s = np.zeros(stages)  # the input of the first knot is held
        fine = max(4 * steps, self.resolving)
        q, v = self.motions(q, v, u, fine)
        every = fine // (2 * steps)
        q = q[:, ::every]
        v = v[:, ::every]
        inputs = u[:-1, None] + s[:, None] * np.diff(u, axis=0)[:, None]
        points = [rows.reshape(-1, rows.shape[-1]) for rows in (q, v, inputs)]
        along, driven = self._models(points[0], points[1], points[2], times.ravel())
        A = along.reshape(N, stages, nx, nx)
        B = driven.reshape(N, stages, nx, nu)
        A = self._size[:, None] * A / self._size
        s = s[:, None, None]
        by_step = np.zeros((N, stages, nx, nz))
        G = np.concatenate((by_step, (1.0 - s) * B, s * B), axis=3)

        h = self.h[0] / (steps * substeps)
        Z: Array = np.zeros((N, nx, nz + 2 * nu))
        Z[:, :, :nz] = charts.T[:-1]
        # Points within the interval, in substeps from its beginning. The Jacobians at these points
        # are interpolated by a cubic polynomial over each substep.
        inner_points = np.arange(1, parts) / parts * (steps * substeps)
        inside = list[Array]()
        for step in range(steps * substeps):
            first = 2 * (step // substeps)
            last = first + 2
            part = step % substeps / substeps, 1.0 / substeps
            rate = partial(_rate, A[:, first : last + 1], G[:, first : last + 1], *part)
            before = Z
            Z = CommutatorFree4.vector_step(rate, h, Z)
            coefficients = cubic(before, Z, h * rate(0.0, before), h * rate(1.0, Z))
            in_step = (inner_points >= step) & (inner_points < step + 1)
            powers = (inner_points[in_step] - step)[:, None] ** np.arange(4)
            inside.append(np.einsum("ij,kjlm->kilm", powers, coefficients))
        ends = np.take_along_axis(Z, charts.kept[1:, :, None], axis=1)
        return ends, np.concatenate(inside, axis=1)

    def _resolving(self, q: Array, v: Array, u: Array) -> int:
        """Return the number of steps per interval that resolve the poles at the knots q, v."""
        some = [0, len(q) // 2, -1]
        A, _ = self._models(q[some], v[some], u[some], self.t[some])
        poles = np.linalg.eigvals(A)
        if not np.isfinite(poles).all():
            return 1
        tolerance = _RESOLVED * np.maximum(1.0 / self.t[-1], np.abs(poles.real))
        steps = 1
        while True:
            h = self.h[0] / steps
            error = np.abs(CommutatorFree4.factor(h * poles) * np.exp(-h * poles) - 1.0)
            slow = error <= h * tolerance
            if slow.all() or steps == _MOST_RESOLVING:
                break
            steps *= 2
        frequency = float(np.abs(poles.imag[~slow]).max(initial=0.0)) / (2.0 * np.pi)
        if frequency > 0.0:
            raise InputError(
                f"a mode of {frequency:.3g} Hz oscillates {self.h[0] * frequency:.3g} times "
                "between two knots, which is too often to integrate; give more knots, or omit the "
                "mode"
            )
        return steps

    def spring_rates(self, q: Array, v: Array, u: Array) -> Array:
        """Return the squared frequency [1/s^2] of each deflection at the start of a motion."""
        if not self.deflections:
            return np.zeros(0)
        A = self._models(q[:1], v[:1], u[:1], self.t[:1])[0][0]
        rows = self.state.nx // 2 + np.array(self.deflections, int)
        rates: Array = np.abs(A[rows, self.deflections])
        return rates

    def _models(self, q: Array, v: Array, u: Array, t: Array) -> tuple[Array, Array]:
        """Return A (k, nx, nx) and B (k, nx, nu) of the errors about k points at times t (k,)."""
        if self._projected is not None:
            return self._linearizer.tangent_along(q, v, u)
        models = self._linearizer.along(q, v, u, t)
        return models["A"], models["B"]

    def guess(self, start: Point, end: Point) -> tuple[Array, Array, Array]:
        """Return knots q, v on a cubic curve between two points, and approximate inputs u."""
        model = self.state.robot.model
        T = self.t[-1]
        s = self.t[:, None] / T
        rates = np.array((T * start[1], T * end[1]))
        turned = rotation_matrices(np.array((start[0][3:7], end[0][3:7])))
        rates[:, PIN_LINEAR] = (turned @ rates[:, PIN_LINEAR, None])[..., 0]
        mean = rates.mean(axis=0)
        difference = pin.difference(model, start[0], end[0])
        difference[PIN_LINEAR] = end[0][:3] - start[0][:3]
        # Add full turns, so that the rotation fits the mean angular velocity.
        turn = pin.log3(turned[0].T @ turned[1])
        axis = turn if turn.any() else mean[PIN_ANGULAR]
        axis = axis / (np.linalg.norm(axis) or 1.0)
        rounds = np.round((mean[PIN_ANGULAR] - turn) @ axis / (2.0 * np.pi))
        difference[PIN_ANGULAR] = turn + 2.0 * np.pi * rounds * axis
        # The final rate of the rotation vector is a least-squares solution, because the Jacobian of
        # the exponential map is singular after full rotations about the axis.
        jacobian = pin.Jexp3(difference[PIN_ANGULAR])
        rates[1, PIN_ANGULAR] = np.linalg.lstsq(
            jacobian, rates[1, PIN_ANGULAR], rcond=1e-6
        )[0]
        # The displacement from the start is the cubic polynomial c1 s + c2 s^2 + c3 s^3.
        c1 = rates[0]
        c2 = 3 * difference - 2 * rates[0] - rates[1]
        c3 = rates.sum(axis=0) - 2 * difference
        displacements = s * (c1 + s * (c2 + s * c3))
        v = (c1 + s * (2 * c2 + 3 * s * c3)) / T
        q = np.array([pin.integrate(model, start[0], step) for step in displacements])
        q[:, :3] = start[0][:3] + displacements[:, PIN_LINEAR]
        for turn, rate in zip(
            displacements[:, PIN_ANGULAR], v[:, PIN_ANGULAR], strict=True
        ):
            rate[:] = pin.Jexp3(turn) @ rate
        v[:, PIN_LINEAR] = (v[:, None, PIN_LINEAR] @ rotation_matrices(q[:, 3:7]))[:, 0]
        q[-1], v[-1] = end
        q, v = self.near(q, v)
        return q, v, self.inputs(self.t, q, v)

    def near(self, q: Array, v: Array) -> Point:
        """Return the knots on the constraints that are nearest to q, v; `InputError` if none are.

        The joints stay within their position limits.
        """
        if self._projected is None:
            return q, v
        closure = Closure(self.state)
        closed = q.copy()
        for row, t in zip(closed, self.t.tolist(), strict=True):
            with located(f"the motion at which the search begins, at t = {t:g} s"):
                row[:] = closure.nearest(row)
        return self._closed(closed, v)

    def inputs(self, t: Array, q: Array, v: Array) -> Array:
        """Return inputs (K, nu) that approximately cause a motion q (K, nq), v (K, nv)."""
        u = np.zeros((len(q), len(self._aba.actuation.names)))
        wanted = np.gradient(v, t, axis=0) - self._aba.accelerations(q, v, u, t)
        half = self.state.nx // 2
        A, B = self._models(q, v, u, t)
        rates = self.state.velocities(wanted)[..., None]
        # The deflections of springs without motors are unknowns as well: they transmit the forces
        # that move the masses on the springs. Without them, the inputs would leave these masses
        # behind, and be too small for the motion of the robot.
        deflected = A[:, half:, self.deflections]
        size = np.abs(deflected).max(axis=1, keepdims=True, initial=0.0)
        by_u = np.concatenate(
            (B[:, half:], deflected / np.where(size > 0.0, size, 1.0)), axis=2
        )
        # The wheels accelerate as needed. Wheels are light, so with their rows, the least-squares
        # problem would be about standing wheels instead of the motion of the base and the joints.
        kept = np.delete(np.arange(half), self.wheels)
        by_u, rates = by_u[:, kept], rates[:, kept]
        solution = (np.linalg.pinv(by_u, 1e-9) @ rates)[..., 0]
        inputs: Array = solution[:, : u.shape[1]]
        return inputs


def passive_springs(robot: Robot) -> list[str]:
    """Return the joints with springs but without a motor, such as modes of appendages."""
    motors = {item.joint for item in robot.inputs if isinstance(item, JointTorque)}
    return [
        name
        for name, stiffness in robot.stiffness.items()
        if stiffness and name not in motors
    ]


def _rate(
    A: Array, G: Array, begin: float, length: float, node: float, Z: Array
) -> Array:
    """Return A Z + G at the fraction `node` of a substep.

    The second axis of A and G is the beginning, the middle and the end of a step, between which
    they are interpolated by a parabola. `begin` and `length` are fractions of the step.
    """
    at = begin + node * length
    weights = (
        (1.0 - at) * (1.0 - 2.0 * at),
        4.0 * at * (1.0 - at),
        at * (2.0 * at - 1.0),
    )
    along, driven = (
        sum(weight * values[:, k] for k, weight in enumerate(weights) if weight)
        for values in (A, G)
    )
    rate: Array = along @ Z + driven
    return rate
