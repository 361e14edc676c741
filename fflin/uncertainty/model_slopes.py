"""What slopes of the accelerations over parameters make of the matrices of a linear model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.aba import Aba
from fflin.dynamics.chart import Chart, Standing
from fflin.dynamics.inertia import Inertia
from fflin.dynamics.rnea import Accelerations, Rates
from fflin.dynamics.state import StateMap
from fflin.linear.certificate import aba_route
from fflin.linear.model import LinearModel
from fflin.linear.output_equations import output_equations
from fflin.linear.prepared import Prepared, own_reference, prepare
from fflin.linear.sampling import held_exponential, held_slopes
from fflin.linear.state_equations import assemble
from fflin.robot.outputs import CenterOfMass, Momentum
from fflin.robot.robot import Robot
from fflin.uncertainty.parameters import Parameter
from fflin.uncertainty.rate_slopes import BodySlopes, slopes_of

# Of a difference over a parameter, relative to what M has of it.
_STEP = 2e-3
# Smaller changes by such a step, of A or B, are in their rounding.
_LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class ModelSlopes:
    """Derivatives of the matrices of a model that is continuous, or sampled from one."""

    lin: LinearModel
    robot: Robot
    _source: LinearModel
    _ready: Prepared
    _chart: Chart
    _rates: Rates
    _u: Array
    bodies: BodySlopes

    @classmethod
    def of(cls, lin: LinearModel, robot: Robot, source: LinearModel) -> ModelSlopes:
        """Prepare the slopes of a model that is, or is sampled from, `source`."""
        own = lin.moving or bool(np.array_equal(lin.placement, own_reference(robot, lin.q)))
        reference = None if own else lin.reference
        ready = prepare(robot, frame=lin.frame, reference=reference, moving=lin.moving)
        state, data = ready.map, robot.create_data()
        chart = Standing() if ready.own_reference else state.chart(lin.q)
        u = ready.actuation.in_base_axes(chart, lin.u0)
        nu, q_m = state.velocities(lin.v), state.joint_positions(lin.q)
        rates = Accelerations(state, ready.actuation, data).rates(lin.q, lin.v, nu, q_m, u)
        inverse = np.empty((len(nu), len(nu)))
        still = lin.q.copy()
        still[:3] = 0.0
        Inertia(state, data).invert(still, inverse)
        bodies = BodySlopes(ready, rates, lin.q, lin.v, inverse)
        return cls(lin, robot, source, ready, chart, rates, u, bodies)

    @cached_property
    def _of_bodies(self) -> Rates:
        return self.bodies.all()

    def over(
        self, parameters: Sequence[Parameter], weights: Array | None = None
    ) -> tuple[Array, ...]:
        """Return dA, dB, dC, dD, df0 and dy0 (P, ..), or of their sum with weights (P,) alone."""
        rates = slopes_of(parameters, self.bodies, self._of_bodies, self._u)
        weighed = self._weighed(parameters)
        if weights is not None:
            rates = Rates(*(np.tensordot(weights, part, 1)[None] for part in rates))
            weighed = np.tensordot(weights, weighed, 1)[None]
        # All is affine in the rates: what no parameter changes is that of none.
        with_none = Rates(*(np.concatenate((part, np.zeros_like(part[:1]))) for part in rates))
        ready, state, nu = self._ready, self._ready.map, self._ready.map.velocities(self.lin.v)
        count = len(rates.c) + 1
        A, lower = np.zeros((count, state.nx, state.nx)), np.zeros((count, len(nu), len(self._u)))
        f0 = assemble(
            *(state, ready.actuation, self._chart, np.broadcast_to(nu, (count, len(nu)))),
            *(np.broadcast_to(self._u, (count, len(self._u))), with_none, A, lower),
            moving=ready.moving,
        )
        B = np.concatenate((np.zeros_like(lower), lower), axis=1)
        A, B, f0 = (each[:-1] - each[-1] for each in (A, B, f0))
        C, D, y0 = self._felt(rates)
        if self.lin.dt:
            driven, h = np.column_stack((self._source.B, self._source.f0)), self.lin.dt
            for row in range(len(A)):
                given = np.column_stack((B[row], f0[row]))
                A[row], held = held_slopes(self._source.A, driven, h, A[row], given)
                B[row], f0[row] = held[:, :-1], held[:, -1]
        return A, B, C + weighed[..., :-1], D, f0, y0 + weighed[..., -1]

    def _outputs(self, ready: Prepared, rates: Rates) -> tuple[Array, Array, Array]:
        lin, data = self.lin, ready.robot.create_data()
        point = lin.q, lin.v, ready.map.velocities(lin.v), self._u
        made = output_equations(ready, data, self._chart, rates, lin.x0, point)
        return made["C"], made["D"], made["y0"]

    def _felt(self, rates: Rates) -> tuple[Array, Array, Array]:
        """Return dC, dD and dy0 of outputs that feel accelerations."""
        lin, count, sensing = self.lin, len(rates.c), self._ready.sensing
        C, D = np.zeros((count, *lin.C.shape)), np.zeros((count, *lin.D.shape))
        y = np.zeros((count, len(lin.C)))
        if sensing is not None and sensing.needs_acceleration:
            none = self._outputs(self._ready, Rates(*(np.zeros_like(part[0]) for part in rates)))
            for row in range(count):
                own = self._outputs(self._ready, Rates(*(part[row] for part in rates)))
                C[row], D[row], y[row] = (a - b for a, b in zip(own, none, strict=True))
        return C, D, y

    def _weighed(self, parameters: Sequence[Parameter]) -> Array:
        """Return (P, ny, nx + 1) of dC and dy0 of outputs that depend on masses themselves."""
        # The robot's mass times a centre of mass or a momentum is quadratic in a parameter, of
        # which three values give the slope exactly, whatever the step.
        lin, of = self.lin, (CenterOfMass | Momentum)
        found = np.zeros((len(parameters), len(lin.C), len(lin.A) + 1))
        names = [
            name for each in self.robot.outputs if isinstance(each, of) for name, _ in each.signals
        ]
        rows = [lin.output_names.index(name) for name in names]
        if not rows:
            return found
        other = replace(self.robot, model=self.robot.model.copy())
        reference = None if self._ready.own_reference else lin.reference
        ready = prepare(other, frame=lin.frame, reference=reference, moving=lin.moving)
        inertias, before = other.model.inertias, self.robot.model.inertias

        def seen(bodies: Mapping[int, pin.Inertia]) -> Array:
            for joint, body in bodies.items():
                inertias[joint] = body
            C, _, y = self._outputs(ready, self._rates)
            for joint in bodies:
                inertias[joint] = before[joint]
            return np.column_stack((C, y))[rows]

        total, now = pin.computeTotalMass(self.robot.model), seen({})
        for row, one in enumerate(parameters):
            if share := self.bodies.share(one.bodies) if one.bodies else 0.0:
                step, mass = 1.0 / share, sum(change[0] for change in one.bodies.values())
                near, far = (
                    (total + size * mass) * seen(with_bodies(self.robot, one, size))
                    for size in (step, 2.0 * step)
                )
                slope = (4.0 * near - far - 3.0 * total * now) / (2.0 * step)
                found[row, rows] = (slope - mass * now) / total
        return found


def with_bodies(robot: Robot, one: Parameter, size: float) -> dict[int, pin.Inertia]:
    """Return the bodies that so much more of a parameter changes."""
    found = {}
    for joint, change in one.bodies.items():
        changed = robot.model.inertias[joint].toDynamicParameters() + size * change
        found[joint] = pin.Inertia.FromDynamicParameters(changed)
        if not changed[0]:  # a wheel, whose centre of mass Pinocchio takes for 0 / 0
            about = changed[4:][[[0, 1, 3], [1, 2, 4], [3, 4, 5]]]
            found[joint] = pin.Inertia(0.0, np.zeros(3), about)
    return found


def difference(slopes: ModelSlopes, one: Parameter) -> float:
    """Return how far fourth-order differences of A and B over a parameter are from its slopes."""
    if not one.bodies:
        raise InputError(f"'{one.name}' is no parameter of a body; only these are checked so")
    lin, robot = slopes.lin, slopes.robot
    step = _STEP / slopes.bodies.share(one.bodies)

    def at(times: float) -> tuple[Array, Array]:
        model = robot.model.copy()
        for joint, body in with_bodies(robot, one, times * step).items():
            model.inertias[joint] = body
        state = StateMap(replace(robot, model=model), reference=lin.reference, frame=lin.frame)
        route = aba_route(state, Aba(state), lin.q, lin.v, lin.u0, moving=lin.moving)
        return held_exponential(*route[:2], lin.dt) if lin.dt else route[:2]

    (dA, dB, *_), worst = slopes.over([one]), 0.0
    for *stepped, now, exact in zip(
        *map(at, (-2.0, -1.0, 1.0, 2.0, 0.0)), (dA[0], dB[0]), strict=True
    ):
        far, near, nearer, farther = stepped
        by_steps = (far - 8.0 * near + 8.0 * nearer - farther) / (12.0 * step)
        size = max(np.abs(by_steps).max(), _LEAST * np.abs(now).max() / step)
        worst = max(worst, float(np.abs(by_steps - exact).max() / size))
    return worst
