"""Derivatives of a linear model's matrices with respect to the robot's parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.aba import Aba
from fflin.dynamics.chart import Standing
from fflin.dynamics.inertia import Inertia
from fflin.dynamics.rnea import Accelerations, Rates
from fflin.dynamics.state import StateMap
from fflin.linear.certificate import aba_route
from fflin.linear.model import LinearModel
from fflin.linear.output_equations import output_equations
from fflin.linear.prepared import own_reference, prepare
from fflin.linear.sampling import held_exponential, held_slopes
from fflin.linear.state_equations import assemble
from fflin.robot.outputs import CenterOfMass, Momentum
from fflin.robot.robot import Robot
from fflin.uncertainty.parameters import Parameter
from fflin.uncertainty.rate_slopes import BodySlopes, slopes_of

WEIGH = (CenterOfMass, Momentum)

# Of a difference over a parameter, relative to what M has of it.
_STEP = 2e-3
# Smaller changes by such a step, of A or B, are in their rounding.
_LEAST = 1e-6


class ModelSlopes:
    """Derivatives of the matrices of a model that is, or is sampled from, `source`."""

    def __init__(self, lin: LinearModel, robot: Robot, source: LinearModel) -> None:
        self.lin, self.robot, self._source = lin, robot, source
        own = lin.moving or bool(np.array_equal(lin.placement, own_reference(robot, lin.q)))
        own = own and robot.orbit is None
        self._how: Any = {"frame": lin.frame, "moving": lin.moving}
        self._how["reference"] = None if own else lin.reference
        ready = self._ready = prepare(robot, **self._how)
        state, data = ready.map, robot.create_data()
        self._chart = Standing() if own else state.chart(lin.q)
        self._u = ready.actuation.in_base_axes(self._chart, lin.u0)
        nu, q_m = state.velocities(lin.v), state.joint_positions(lin.q)
        self._rates = Accelerations(state, ready.actuation, data).rates(
            *(lin.q, lin.v, nu, q_m, self._u),
            np.empty((len(nu), state.nx)),
            np.empty((len(nu), len(self._u))),
        )
        inverse = np.empty((len(nu), len(nu)))
        still = lin.q.copy()
        still[:3] = 0.0
        Inertia(state, data).invert(still, inverse)
        self.bodies = BodySlopes(ready, self._rates, lin.q, lin.v, inverse)

    @cached_property
    def _of_bodies(self) -> Rates:
        return self.bodies.all()

    def over(self, parameters: Sequence[Parameter]) -> tuple[Array, ...]:
        """Return dA, dB, dC, dD, df0 and dy0 (P, ..)."""
        rates = slopes_of(parameters, self.bodies, self._of_bodies, self._u)
        # All is affine in the rates: what no parameter changes is that of none.
        ready, state, nu = self._ready, self._ready.map, self._ready.map.velocities(self.lin.v)
        count, nv = len(rates.c) + 1, len(nu)
        A, B = np.zeros((count, state.nx, state.nx)), np.zeros((count, state.nx, len(self._u)))
        with_none = Rates(*(np.zeros((count, nv)), A[:, nv:], B[:, nv:], np.zeros((count, 3))))
        for part, of_parameters in zip(with_none, rates, strict=True):
            part[:-1] = of_parameters
        f0 = assemble(
            *(state, ready.actuation, self._chart, np.broadcast_to(nu, (count, nv))),
            *(np.broadcast_to(self._u, (count, len(self._u))), with_none, A),
            moving=ready.moving,
        )
        A, B, f0 = (each[:-1] - each[-1] for each in (A, B, f0))
        if self.lin.dt:
            driven, h = np.column_stack((self._source.B, self._source.f0)), self.lin.dt
            for row in range(len(A)):
                given = np.column_stack((B[row], f0[row]))
                A[row], held = held_slopes(self._source.A, driven, h, A[row], given)
                B[row], f0[row] = held[:, :-1], held[:, -1]
        C, D, y0 = np.split(self._seen(parameters, rates), (state.nx, -1), axis=2)
        return A, B, C, D, f0, y0[..., 0]

    def _seen(self, parameters: Sequence[Parameter], rates: Rates) -> Array:
        """Return dC, dD and dy0 side by side (P, ny, ..), of outputs that feel or weigh."""
        # The robot's mass times such an output is quadratic in a parameter, with rates that are
        # linear in it: of three values the slope is exact, whatever the step.
        lin, now = self.lin, self._rates
        found = np.zeros((len(parameters), len(lin.C), lin.C.shape[1] + lin.D.shape[1] + 1))
        outputs = (o for o in self.robot.outputs if o.FEELS_ACCELERATION or type(o) in WEIGH)
        rows = [lin.output_names.index(name) for o in outputs for name, _ in o.signals]
        if not rows:
            return found
        other = replace(self.robot, model=self.robot.model.copy())
        ready = prepare(other, **self._how)
        data, point = other.create_data(), (lin.q, lin.v, ready.map.velocities(lin.v), self._u)

        def weighed(one: Parameter, by: Sequence[Array], size: float) -> Array:
            for joint, body in with_bodies(self.robot, one, size).items():
                other.model.inertias[joint] = body
            moved = Rates(*(a + size * b for a, b in zip(now, by, strict=True)))
            made = output_equations(ready, data, self._chart, moved, lin.x0, point)
            seen = np.column_stack((made["C"], made["D"], made["y0"]))[rows]
            total = pin.computeTotalMass(other.model)
            for joint in one.bodies:
                other.model.inertias[joint] = self.robot.model.inertias[joint]
            return total * seen

        total = pin.computeTotalMass(self.robot.model)
        for row, one in enumerate(parameters):
            step = 1.0 / (self.bodies.share(one.bodies) or 1.0) if one.bodies else 1.0
            mass = sum(change[0] for change in one.bodies.values())
            of = [weighed(one, [part[row] for part in rates], k * step) for k in (0.0, 1.0, 2.0)]
            slope = (4.0 * of[1] - of[2] - 3.0 * of[0]) / (2.0 * step)
            found[row, rows] = (slope - mass * of[0] / total) / total
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
    """Return the relative error of the derivatives of A and B, by fourth-order differences."""
    if not one.bodies:
        raise InputError(
            f"'{one.name}' is not a parameter of a link or body; check takes only these, such as "
            "'base.mass'"
        )
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
