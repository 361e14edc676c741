"""Multiple shooting: the initial guess, the gaps between intervals, and their Jacobians."""

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrices
from fflin.base.validation import Array
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.state import StateMap
from fflin.linear.flow import Flow
from fflin.linear.linearization import Linearizer
from fflin.robot.robot import Robot

_FEWEST_STEPS, _MOST_STEPS = 4, 128

# Jacobians are integrated in a quarter of the steps of the motion, but in at most this number.
_MOST_OF_JACOBIANS = 16

Point = tuple[Array, Array]


class Shooting:
    """Multiple shooting from knots at times t (N + 1,), the initial points of N motions."""

    # A step from one point to another is z = (theta_b, r_b, q_m, nu) (nx,) in base axes. It has
    # the states of the linear models, but the rotation vector theta_b replaces 2 q_b.

    def __init__(self, robot: Robot, t: Array, held: bool) -> None:
        self.state, self.t, self.held = StateMap(robot, frame="local"), t, held
        self.steps = _FEWEST_STEPS
        self.h = np.diff(t)
        # The engine is fixed, so that a plan is the same bit for bit whatever ran before.
        self._linearizer = Linearizer(robot, moving=True)
        self.wheels = [self.state.names.index(f"q_m.{name}") for name in robot.wheels]
        self._size = np.where(np.arange(self.state.nx) < 3, 2.0, 1.0)

    def between(self, start: Point, end: Point) -> Array:
        """Return the step z (nx,) from one point to another, in which wheel angles are zero."""
        state = self.state
        difference = pin.difference(state.robot.model, start[0], end[0])
        z = np.concatenate((state.velocities(difference), state.velocities(end[1] - start[1])))
        z[self.wheels] = 0.0
        return z

    def moved(self, q: Array, v: Array, z: Array) -> Point:
        """Return the knots after a step z (N + 1, nx)."""
        model, (difference, rates) = self.state.robot.model, np.split(z, 2, axis=1)
        differences = self.state.spread(difference)
        rows = [pin.integrate(model, *each) for each in zip(q, differences, strict=True)]
        return np.array(rows), v + self.state.spread(rates)

    def missed(self, q: Array, v: Array, u: Array) -> Array:
        """Return the gaps (N, nx) between the ends of the intervals and the next knots."""
        return self.apart(q, v, self.parts(q, v, u, 1))

    def apart(self, q: Array, v: Array, parts: Point) -> Array:
        """Return the gaps (N, nx) between the last parts of the intervals and the next knots."""
        knots, ends = zip(q[1:], v[1:], strict=True), (each[:, -1] for each in parts)
        return np.array(
            [self.between(*pair) for pair in zip(knots, zip(*ends, strict=True), strict=True)]
        )

    def parts(self, q: Array, v: Array, u: Array, count: int) -> Point:
        """Return q and v (N, count, ..) at equal parts of the motion from each knot to its end."""
        flow, knots = self._flow(q, v, u), list(zip(q, v, strict=True))[:-1]
        rows = [self._interval(flow, k, knot, count) for k, knot in enumerate(knots)]
        return np.array([row[0] for row in rows]), np.array([row[1] for row in rows])

    def flown(self, start: Point, u: Array, parts: int = 1) -> Point:
        """Return q and v of the motion from a point under inputs, `parts` rows per interval."""
        N, (q, v) = len(self.t) - 1, ([each] for each in start)
        flow = self._flow(np.tile(q, (N + 1, 1)), np.tile(v, (N + 1, 1)), u)
        for k in range(N):
            rows = self._interval(flow, k, (q[-1], v[-1]), parts)
            q.extend(rows[0])
            v.extend(rows[1])
        return np.array(q), np.array(v)

    def _interval(self, flow: Flow, k: int, at: Point, parts: int) -> tuple[list[Array], ...]:
        """Return q and v at the ends of equal parts of an interval."""
        q, v, steps = list[Array](), list[Array](), max(1, self.steps // parts)
        for part in range(parts):
            at = flow.end(k, steps, *at, (part / parts, (part + 1) / parts))
            q.append(at[0])
            v.append(at[1])
        return q, v

    def refine(self, q: Array, v: Array, u: Array, accuracy: float) -> None:
        """Increase the number of steps until interval ends have this accuracy [rad, m, s]."""
        self.steps = _FEWEST_STEPS
        missed = self.missed(q, v, u)
        while self.steps < _MOST_STEPS:
            self.steps *= 2
            before, missed = missed, self.missed(q, v, u)
            if np.abs(missed - before).max() <= accuracy:
                break

    def jacobians(
        self, q: Array, v: Array, u: Array, parts: int = 1
    ) -> tuple[Array, Array, Array, Array]:
        """Return Jacobians of interval ends with respect to z and the inputs at both knots.

        The last array (N, parts - 1, nx, nx + 2 nu) contains the Jacobians, side by side, of the
        points between the equal parts of the intervals.
        """
        # Runge-Kutta steps of dZ/dt = A Z + B along the motions, for all intervals at once.
        flow, (nx, nu), steps = self._flow(q, v, u), (len(self._size), u.shape[1]), self.steps // 4
        steps = min(steps, _MOST_OF_JACOBIANS)
        h: Array = self.h[:, None, None] / steps
        Z = np.tile(np.eye(nx, nx + 2 * nu), (len(q) - 1, 1, 1))
        fractions, inside = np.arange(1, parts) / parts * steps, list[Array]()
        at = list(zip(q, v, strict=True))[:-1]

        def rates(half: int) -> tuple[Array, Array]:
            late = half / (2.0 * steps)
            if half:
                part = (late - 0.5 / steps, late)
                at[:] = [flow.end(k, 2, *x, part) for k, x in enumerate(at)]
            late = 0.0 if self.held else late
            new = u[:-1] + late * np.diff(u, axis=0)
            models = [self._linearizer(*x, each) for x, each in zip(at, new, strict=True)]
            A, B = (np.array([getattr(lin, name) for lin in models]) for name in "AB")
            driven = np.concatenate((np.zeros_like(A), (1.0 - late) * B, late * B), axis=2)
            return self._size[:, None] * A / self._size, driven

        last = rates(0)
        for step in range(steps):
            F = last, rates(2 * step + 1), rates(2 * step + 2)
            total, rate, before = np.zeros_like(Z), np.zeros_like(Z), Z
            last = F[2]
            for i, fraction, weight in ((0, 0.0, 1.0), (1, 0.5, 2.0), (1, 0.5, 2.0), (2, 1.0, 1.0)):
                rate = F[i][0] @ (Z + fraction * h * rate) + F[i][1]
                total = total + weight * rate
            Z = Z + h / 6.0 * total
            begin, end = (h * (f[0] @ z + f[1]) for f, z in ((F[0], before), (last, Z)))
            for s in (
                fractions[(fractions >= step) & (fractions < step + 1)] - step
            ):  # cubics of Hermite
                bend = (
                    s * (1.0 - s) * ((1.0 - s) * begin - s * end + (2.0 * s - 1.0) * (Z - before))
                )
                inside.append(before + s * (Z - before) + bend)
        A, B, D = np.split(Z, (nx, nx + nu), axis=2)
        return A, B, D, np.array(inside).reshape(parts - 1, *Z.shape).swapaxes(0, 1)

    def guess(self, start: Point, end: Point) -> tuple[Array, Array, Array]:
        """Return knots on cubics between two points, and approximate inputs for them."""
        model, T = self.state.robot.model, self.t[-1]
        s, rates = self.t[:, None] / T, np.array((T * start[1], T * end[1]))
        turned = rotation_matrices(np.array((start[0][3:7], end[0][3:7])))
        rates[:, PIN_LINEAR] = (turned @ rates[:, PIN_LINEAR, None])[..., 0]
        difference, mean = pin.difference(model, start[0], end[0]), rates.mean(axis=0)
        difference[PIN_LINEAR] = end[0][:3] - start[0][:3]
        turn = pin.log3(turned[0].T @ turned[1])
        axis = turn if turn.any() else mean[PIN_ANGULAR]
        axis = axis / (np.linalg.norm(axis) or 1.0)
        rounds = np.round((mean[PIN_ANGULAR] - turn) @ axis / (2.0 * np.pi))
        difference[PIN_ANGULAR] = turn + 2.0 * np.pi * rounds * axis
        # Final rate of the rotation vector. Its Jacobian is singular after whole turns about the
        # axis.
        jacobian = pin.Jexp3(difference[PIN_ANGULAR])
        rates[1, PIN_ANGULAR] = np.linalg.lstsq(jacobian, rates[1, PIN_ANGULAR], rcond=1e-6)[0]
        late, bend = 3 * difference - 2 * rates[0] - rates[1], rates.sum(axis=0) - 2 * difference
        displacements = s * (rates[0] + s * (late + s * bend))
        v = (rates[0] + s * (2 * late + 3 * s * bend)) / T
        q = np.array([pin.integrate(model, start[0], step) for step in displacements])
        q[:, :3] = start[0][:3] + displacements[:, PIN_LINEAR]
        for turn, rate in zip(displacements[:, PIN_ANGULAR], v[:, PIN_ANGULAR], strict=True):
            rate[:] = pin.Jexp3(turn) @ rate
        v[:, PIN_LINEAR] = (v[:, None, PIN_LINEAR] @ rotation_matrices(q[:, 3:7]))[:, 0]
        q[-1], v[-1] = end
        u = np.zeros((len(q), len(self._linearizer().u0)))
        flow = self._flow(q, v, u)
        for k, rate in enumerate(np.gradient(v, self.t, axis=0)):
            wanted = self.state.velocities(rate - flow.rate(q[k], v[k], u[k]))
            B = self._linearizer(q[k], v[k]).B[len(wanted) :]
            u[k] = np.linalg.lstsq(B, wanted, rcond=1e-9)[0]
        return q, v, u

    def _flow(self, q: Array, v: Array, u: Array) -> Flow:
        return Flow(self.state, self.t, q, v, u, self.held)
