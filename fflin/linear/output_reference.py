"""Independent computation of y0, C and D by finite differences of the kinematics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fflin.base.rotation import skew
from fflin.base.validation import Array, Indices, Mask
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.outputs import Measuring, state_indices
from fflin.dynamics.state import StateMap
from fflin.linear.aba_route import Route
from fflin.linear.model import LinearModel
from fflin.linear.nonlinear import Nonlinear, jacobians
from fflin.linear.scales import (
    EPS,
    FEW_ULPS,
    ROUTE_TOLERANCE,
    Blocks,
    Reference,
    Row,
    block_sizes,
    sampled,
    scales,
    spread_over,
    worst,
)
from fflin.robot.joints import find_frame

# Number of rows with the contributions of a body: its mass-weighted centre of mass, its linear
# momentum and its angular momentum.
_PER_BODY = 9


class OutputReference:
    """Independent computation of y0, C and D.

    The outputs are y = h(x, a(x, u)), where a is the acceleration. Finite differences of the
    kinematics h are combined with the ABA derivatives of a: C = dh/dx + dh/da da/dx and
    D = dh/da da/du. So the accuracy of the differences does not depend on the condition of M.

    `steps` (nx,) are the steps of the finite differences.
    """

    def __init__(
        self, model: Nonlinear, route: Route, lin: LinearModel, steps: Array
    ) -> None:
        self._route, self._lin = route, lin
        self._measuring = Measuring(route.state, lin.q)
        self._bodies = _Bodies(route.state, lin.q[:3])
        self._kinds, self._vectors = _parts(route.state)
        *_, a = model.accelerations(np.concatenate((lin.x0, lin.u0))[None])
        self._a = a[0]

        y0 = self._measuring(lin.x0, lin.q, route.v, self._a)[:, None]
        by_x, rounding, sizes = self._kinematics(steps)
        by_a = self._by_acceleration()
        at = route.accelerations
        size, nv, ones = np.abs(by_a), len(route.M), np.ones(len(y0))
        C, D = by_x + by_a @ at.by_x, by_a @ at.by_u

        def sampled_errors(x: Array, others: Sequence[Array]) -> Array:
            return sampled(self._vectors, x, others, ones)

        halves = {"positions": slice(nv), "velocities": slice(nv, 2 * nv)}
        scale = self._scale(
            C, np.abs(by_x) + size @ np.abs(at.by_x), halves, route.units
        )
        rounding += sampled_errors(
            C, [by_x + by_a @ other.by_x for other in route.samples]
        )
        self.C = Reference(C, scale, rounding)
        inputs = route.aba.actuation.groups
        units = 1.0 / route.input_mobility
        scale = self._scale(D, size @ np.abs(at.by_u), inputs, units)
        self.D = Reference(
            D, scale, sampled_errors(D, [by_a @ x.by_u for x in route.samples])
        )
        rates = np.abs(route.state.velocities(self._a))
        terms = (sizes + size @ rates)[:, None]
        scale = self._scale(y0, terms, {"y0": slice(1)}, np.ones(1))
        others = [y0 + (by_a @ (x.rates - at.rates))[:, None] for x in route.samples]
        self._y0 = Reference(y0, scale, sampled_errors(y0, others))

    def _scale(self, x: Array, terms: Array, columns: Blocks, units: Array) -> Array:
        """Return the scales of a matrix: the largest entry of the block, or the terms."""
        ones = np.ones(len(x))
        size = np.maximum(block_sizes(self._vectors, columns, x, ones, units), terms)
        return scales(self._vectors, columns, size, ones, units)

    def rows(self, lin: LinearModel) -> Iterator[Row]:
        """Compare y0, C and D of a model, with one row for each type of output."""
        for name, reference, given in (
            ("y0", self._y0, lin.y0[:, None]),
            ("C", self.C, lin.C),
            ("D", self.D, lin.D),
        ):
            errors = reference.errors(given, ROUTE_TOLERANCE)
            for word, rows in self._kinds.items():
                yield worst(
                    "outputs", f"{name} ({word})", errors[rows], ROUTE_TOLERANCE
                )

    def _kinematics(self, steps: Array) -> tuple[Array, Array, Array]:
        """Return dh/dx, its rounding errors, and the magnitudes (ny,) of the terms of h."""
        state, lin, x = self._route.state, self._lin, self._lin.x0
        groups = state.groups
        ny = len(lin.y0)
        is_curved = np.zeros(len(x), dtype=bool)
        is_curved[groups.q_b] = is_curved[groups.q_m] = True
        h = self._evaluate(x[None], self._a)[0]
        # h is linear in the accelerations, so its derivatives by velocities do not depend on them.
        # Without them, h is small, and so are its rounding errors.
        nv = len(x) // 2
        steady = np.zeros_like(self._a)
        unaccelerated = self._evaluate(x[None], steady)[0]

        def differentiate(varied: slice, a: Array) -> Array:
            """Return dh/dx for the states `varied` at the acceleration a, and repetitions of it.

            The first axis of the result is for the repetitions; see `jacobians`.
            """

            def h_of(values: Array) -> Array:
                """Return h (N, ..) for values (N, k) of the varied states."""
                points = np.tile(x, (len(values), 1))
                points[:, varied] = values
                return self._evaluate(points, a)

            derivative, repetitions = jacobians(
                h_of, x[varied], steps[varied], is_curved[varied]
            )
            return np.array([derivative, *repetitions])

        by_positions = differentiate(slice(nv), self._a)
        by_velocities = differentiate(slice(nv, None), steady)
        by_x, *again = np.concatenate((by_positions, by_velocities), axis=2)

        parts = {k: np.arange(k, k + 3) for k in range(ny, len(h), 3)}
        vectors = {**self._vectors, **parts}
        ones = np.ones(len(h))
        places = [lin.reference, *state.robot.model.jointPlacements.tolist()]
        reach = sum(float(np.linalg.norm(place.translation)) for place in places)
        reach += float(np.linalg.norm(lin.q[:3]))
        least = {"rad": 1.0, "1": 1.0, "m": reach}
        moved = np.abs(by_x) * np.abs(x)
        whole = np.abs(h) + moved.sum(axis=1)
        sizes = np.column_stack(
            (whole, np.abs(unaccelerated) + moved[:, nv:].sum(axis=1))
        )
        sizes[:ny] += np.array([least.get(unit, 0.0) for unit in lin.output_units])[
            :, None
        ]
        sizes = spread_over(vectors, sizes, ones)
        # The differences of a vector that does not depend on a variable are exactly zero.
        depends = (
            spread_over(vectors, np.abs(by_x) + np.abs(again).max(axis=0), ones) > 0.0
        )
        # But the model itself may have rounding errors of the size of h per radian, unless nothing
        # that the joint moves is measured.
        per_unit = np.zeros(by_x.shape)
        per_unit[:, groups.q_b] = 2.0
        if reach:
            per_unit[:, groups.r_b] = 1.0 / reach
        per_joint = [body.scale for body in state.robot.joints]
        per_unit[:, groups.q_m] = _moved_by(state, len(h)) * per_joint
        by_column = np.repeat(sizes, nv, axis=1)
        rounding = FEW_ULPS * EPS * by_column * (depends / steps + per_unit)
        rounding += sampled(vectors, by_x, again, ones)
        total = self._bodies.sums(h, ny, self._kinds, lin.reference.rotation)
        size = np.abs(total)
        return total @ by_x, size @ rounding, size @ sizes[:, 0]

    def _evaluate(self, x: Array, a: Array) -> Array:
        """Return h (N, ny) for states (N, nx), followed by the contributions of the bodies.

        `a` (nv,) is dv/dt as Pinocchio's ABA returns it.
        """
        _, q, v = self._route.state.points(x)
        rows = []
        for point in zip(x, q, v, strict=True):
            y = self._measuring(*point, a)
            rows.append(np.append(y, self._bodies(self._measuring)))
        return np.array(rows)

    def _by_acceleration(self) -> Array:
        """Return dh/da (ny, 6 + n); h is linear in the acceleration a."""
        state, lin, v = self._route.state, self._lin, self._route.v
        # The steps are as large as the accelerations, so that rounding errors of h are small.
        units = self._route.base_mobility
        units = units * max(
            1.0, float((np.abs(self._route.accelerations.rates) / units).max())
        )
        by_a: Array = np.zeros((len(lin.y0), len(units)))
        if not any(output.FEELS_ACCELERATION for output in state.robot.outputs):
            return by_a
        for k, unit in enumerate(units):
            step = state.spread(unit * np.eye(len(units))[k])
            ahead = self._measuring(lin.x0, lin.q, v, self._a + step)
            behind = self._measuring(lin.x0, lin.q, v, self._a - step)
            by_a[:, k] = (ahead - behind) / (2.0 * unit)
        return by_a


class _Body(NamedTuple):
    """Masses, centres of mass and inertias of the bodies, and momenta of wheels, by joint."""

    mass: Array
    lever: Array
    inertia: Array
    stored: Array


class _Bodies:
    """Contributions of the bodies to the centre of mass and to the momentum of a robot.

    The differences of a light body, such as the body of a mode, are lost in a sum over the bodies.
    So the contributions of the bodies are differentiated first, and then summed. They are three
    vectors for each body, in world axes and about `home` (3,):

    - the centre of mass, multiplied by the fraction of the robot's mass;
    - the linear momentum;
    - the angular momentum.
    """

    def __init__(self, state: StateMap, home: Array) -> None:
        robot = state.robot
        bodies = robot.model.inertias.tolist()
        self._home = home
        self._total = robot.mass
        stored = np.zeros((len(bodies), 3))
        for joint, momentum in robot.stored_momentum:
            stored[joint] += momentum
        self._body = _Body(
            np.array([[body.mass] for body in bodies]),
            np.array([body.lever for body in bodies]),
            np.array([body.inertia for body in bodies]),
            stored,
        )
        self._summed = any(
            output.WORD in ("com", "momentum") for output in robot.outputs
        )

    def __call__(self, measuring: Measuring) -> Array:
        """Return the contributions at the point that `measuring` evaluated last."""
        if not self._summed:
            return np.zeros(0)
        body, data = self._body, measuring.data
        R = np.array([place.rotation for place in data.oMi.tolist()])
        origin = np.array([place.translation for place in data.oMi.tolist()])
        twist = np.array([motion.vector for motion in data.v.tolist()])
        omega = twist[:, PIN_ANGULAR]
        speed = twist[:, PIN_LINEAR] + np.cross(omega, body.lever)
        spin = (body.inertia @ omega[..., None])[..., 0] + body.stored
        center = origin - self._home + (R @ body.lever[..., None])[..., 0]
        momentum = body.mass * (R @ speed[..., None])[..., 0]
        angular = (R @ spin[..., None])[..., 0] + np.cross(center, momentum)
        return np.hstack((body.mass / self._total * center, momentum, angular)).ravel()

    def sums(
        self, h: Array, ny: int, kinds: dict[str, list[int]], reference: Array
    ) -> Array:
        """Return the matrix (ny, ..) that sums the contributions of the bodies.

        `h` contains the outputs (ny,) and the contributions at the operating point. The matrix maps
        the derivatives of both to the derivatives of the outputs.
        """
        total = np.eye(ny, len(h))
        if not self._summed:
            return total
        center, momentum, _ = h[ny:].reshape(-1, 3, 3).sum(axis=0)
        count = len(self._body.mass)
        unit, none = np.eye(3), np.zeros((3, 3))

        def write(rows: list[int], *factors: Array) -> None:
            total[rows] = 0.0
            total[rows, ny:] = reference.T @ np.tile(np.hstack(factors), count)

        if "com" in kinds:
            write(kinds["com"], unit, none, none)
        if "momentum" in kinds:
            # The angular momentum about the centre of mass c is h - c x p.
            write(kinds["momentum"][:3], skew(momentum), -skew(center), unit)
            write(kinds["momentum"][3:], none, unit, none)
        return total


def _moved_by(state: StateMap, count: int) -> Mask:
    """Return which joints (n,) move what each row of h (count,) measures.

    The first rows of h are the outputs. The other rows, if there are any, are contributions of the
    bodies. An output that consists of states is moved by no joint.
    """
    robot = state.robot
    model = robot.model
    names = model.names.tolist()
    leaders = {
        follower.joint.name: follower.leader.name for follower in robot.followers
    }

    def movers(carrier: int) -> list[bool]:
        support = [names[joint] for joint in model.supports[carrier].tolist()]
        moving = {leaders.get(name, name) for name in support}
        return [joint.name in moving for joint in robot.joints]

    rows: list[list[bool]] = []
    for output in robot.outputs:
        size = len(output.signals) or len(state_indices(state, output))
        carriers = [find_frame(model, name).joint for name in output.frames]
        moved = [any(flags) for flags in zip(*map(movers, carriers), strict=True)]
        rows += [moved or [False] * robot.n] * size
    if count > len(rows):
        for carrier in range(model.njoints):
            rows += [movers(carrier)] * _PER_BODY
    return np.array(rows, dtype=bool).reshape(count, robot.n)


def _parts(state: StateMap) -> tuple[dict[str, list[int]], dict[int, Indices]]:
    """Return the rows of y by the name of the output, and the rows of each of its vectors."""
    kinds = dict[str, list[int]]()
    vectors = dict[int, Indices]()
    at = 0
    for output in state.robot.outputs:
        count = len(output.signals) or len(state_indices(state, output))
        kinds.setdefault(output.WORD, []).extend(range(at, at + count))
        size = 3 if output.VECTORS else 1
        for k in range(at, at + count, size):
            vectors[k] = np.arange(k, k + size)
        at += count
    return kinds, vectors
