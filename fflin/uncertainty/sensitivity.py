"""Exact derivatives of a linear model over the parameters of its robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.frozen import FrozenArrays
from fflin.base.tables import grid
from fflin.base.validation import Array, as_double, numbers
from fflin.dynamics.aba import Aba
from fflin.dynamics.chart import Chart, Standing
from fflin.dynamics.inertia import Inertia
from fflin.dynamics.rnea import Accelerations, Rates
from fflin.dynamics.state import StateMap
from fflin.linear.certificate import aba_route
from fflin.linear.model import LinearModel
from fflin.linear.output_equations import output_equations
from fflin.linear.prepared import Prepared, own_reference, prepare
from fflin.linear.state_equations import assemble
from fflin.robot.outputs import CenterOfMass, Momentum
from fflin.robot.robot import Robot
from fflin.uncertainty.parameters import Parameters
from fflin.uncertainty.rate_slopes import BodySlopes, slopes_of

# Poles closer than this, relative to the largest, have no derivative of their own.
_EQUAL = 1e-6

_SHOWN = 15

# Of a difference over a parameter, relative to what M has of it.
_STEP = 2e-3
# Smaller changes by such a step, of A or B, are in their rounding.
_LEAST = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Slope(FrozenArrays):
    """Derivatives of a linear model over one parameter, or along a direction of several.

    Attributes
    ----------
    name, unit : str
        Of the parameter; what is derived is per unit of it.
    value : float
        What the parameter is; of a direction 0.
    dA, dB, dC, dD : ndarray
        Of the shape of A, B, C and D.
    df0, dy0 : ndarray (nx,), (ny,)
        Of the state's rate and the outputs at the point, state and inputs held. Of a model with
        `moving`, df0 is the rate at which a robot with other parameters leaves the reference.
    """

    name: str
    unit: str
    value: float
    dA: Array
    dB: Array
    dC: Array
    dD: Array
    df0: Array
    dy0: Array

    def __repr__(self) -> str:
        return f"Slope('{self.name}' = {self.value:.6g} {self.unit}, nx={len(self.dA)})"


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity:
    """Derivatives of a linear model over every parameter of its robot; ``S["arm.mass"].dA``.

    The parameters are, of each link by its name in the URDF, and of each body, links that are
    fixed to each other, by its joint or as ``base``:

    - ``LINK.mass`` [kg], its centre of mass and inertia about it held;
    - ``LINK.com.x`` [m] in the link's axes, mass and inertia about it held;
    - ``LINK.inertia.xx`` .. ``.yz`` [kg m^2] about the centre of mass, in the axes of the URDF's
      <inertial>; of a body, in its joint's;
    - ``LINK.density``, of the whole link, relative;

    and ``JOINT.stiffness``, ``JOINT.damping``, ``THRUSTER.position.x`` [m],
    ``THRUSTER.direction.x`` (what of it turns the unit vector) and ``WHEEL.inertia``, which the
    carrier's inertia counts.

    Attributes
    ----------
    lin : LinearModel
    parameters : Parameters
        {name: Parameter} in the robot's order.
    """

    lin: LinearModel
    parameters: Parameters
    _ready: Prepared = field()
    _rates: Rates = field()
    _bodies: BodySlopes = field()
    _u: Array = field()

    def __repr__(self) -> str:
        return f"Sensitivity('{self.lin.robot}', {len(self.parameters)} parameters)"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.parameters)

    @cached_property
    def _of_bodies(self) -> Rates:
        return self._bodies.all()

    def __getitem__(self, name: str) -> Slope:
        """Return the derivatives over one parameter."""
        found = self.parameters.find(name)
        if len(found) > 1:
            raise InputError(f"'{name}' stands for {len(found)} parameters; take along({{...}})")
        one = self.parameters[found[0]]
        return self._slope(one.name, one.unit, one.value, {one.name: 1.0})

    def along(self, direction: Mapping[str, float]) -> Slope:
        """Return the derivatives along a direction.

        Parameters
        ----------
        direction : mapping
            {parameter or pattern: change of it for a unit of the direction, in its unit}.
            ``{"payload.density": 0.1}`` is a payload that is heavier by a tenth, all of its
            inertia with it; ``{"panel_*.stiffness": 1.0}`` all of these at once.
        """
        given = numbers("direction", direction, "parameter", "change")
        named = {name: value for key, value in given.items() for name in self.parameters.find(key)}
        if not named:
            raise InputError("direction is empty, expected {parameter: change}")
        return self._slope(" + ".join(given), "1", 0.0, named)

    def _slope(self, name: str, unit: str, value: float, weights: Mapping[str, float]) -> Slope:
        rates = self._rates_of(list(weights))
        sums = [np.tensordot([*weights.values()], part, 1)[None] for part in rates]
        matrices = self._assembled(Rates(*sums))
        return Slope(name, unit, value, *(each[0] for each in matrices))

    @cached_property
    def _all(self) -> tuple[Array, ...]:
        return self._assembled(self._rates_of(list(self.parameters)))

    @property
    def dA(self) -> Array:
        """Derivatives (P, nx, nx) of A over each parameter."""
        return self._all[0]

    @property
    def dB(self) -> Array:
        """Derivatives (P, nx, nu) of B over each parameter."""
        return self._all[1]

    @property
    def df0(self) -> Array:
        """Derivatives (P, nx) of f0 over each parameter."""
        return self._all[4]

    def poles(self, gain: Any = None) -> tuple[Array, Array]:
        """Return the poles (nx,) of A - B K and their derivatives (P, nx).

        Parameters
        ----------
        gain : Gain or array_like (nu, nx), optional
            K; zero by default.

        Returns
        -------
        poles, slopes : ndarray
            NaN where poles coincide, which have no derivative: they part like a root.
        """
        lin = self.lin
        K = np.zeros(lin.B.T.shape) if gain is None else getattr(gain, "K", gain)
        K = as_double("gain", K)
        if K.shape != lin.B.T.shape:
            raise InputError(f"gain has shape {K.shape}, expected {lin.B.T.shape} (nu, nx)")
        from scipy.linalg import eig

        poles, left, right = eig(lin.A - lin.B @ K, left=True)
        changes = self.dA - self.dB @ K
        slopes = np.einsum("ik,pij,jk->pk", left.conj(), changes, right, optimize=True)
        slopes = slopes / np.einsum("ik,ik->k", left.conj(), right)
        apart = np.abs(poles[:, None] - poles)
        np.fill_diagonal(apart, np.inf)
        slopes[:, apart.min(axis=1) <= _EQUAL * max(np.abs(poles).max(), _EQUAL)] = np.nan
        return poles, slopes

    def check(self, names: Sequence[str] | None = None) -> dict[str, float]:
        """Hold derivatives of A and B against differences of another route to them.

        The robot is changed by small steps, and A and B are built from the derivatives of ABA.

        Parameters
        ----------
        names : sequence of str, optional
            Parameters of bodies; all of them by default.

        Returns
        -------
        dict
            {parameter: largest difference, relative to what it changes of A and B}: of the order
            1e-9, the differences' own.
        """
        if names is None:
            names = [name for name, one in self.parameters.items() if one.bodies]
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            raise InputError(f"names is {names!r}, expected several, such as ['base.mass']")
        return {name: _difference(self, self[name].name) for name in names}

    def __str__(self) -> str:
        """Tell what 10 % of each parameter changes, the most first; 1 cm of a centre of mass."""
        return _table(self)

    def _rates_of(self, names: list[str]) -> Rates:
        parameters = [self.parameters[name] for name in names]
        return slopes_of(parameters, self._bodies, self._of_bodies, self._u)

    def _assembled(self, rates: Rates) -> tuple[Array, ...]:
        """Return dA, dB, dC, dD, df0, dy0 of slopes (k, ..) of the rates."""
        ready, lin, state = self._ready, self.lin, self._ready.map
        # All is affine in the rates: what no parameter changes is that of none.
        with_none = Rates(*(np.concatenate((part, np.zeros_like(part[:1]))) for part in rates))
        count, nu = len(rates.c) + 1, state.velocities(lin.v)
        chart = Standing() if ready.own_reference else state.chart(lin.q)
        A, lower = np.zeros((count, state.nx, state.nx)), np.zeros((count, len(nu), len(self._u)))
        f0 = assemble(
            *(state, ready.actuation, chart, np.broadcast_to(nu, (count, len(nu)))),
            *(np.broadcast_to(self._u, (count, len(self._u))), with_none, A, lower),
            moving=ready.moving,
        )
        B = np.concatenate((np.zeros_like(lower), lower), axis=1)
        A, B, f0 = (each[:-1] - each[-1] for each in (A, B, f0))
        C, D, y0 = self._seen(chart, rates)
        return A, B, C, D, f0, y0

    def _seen(self, chart: Chart, rates: Rates) -> tuple[Array, Array, Array]:
        """Return dC, dD and dy0, which are not zero where accelerations are felt."""
        ready, lin, count = self._ready, self.lin, len(rates.c)
        C, D = np.zeros((count, *lin.C.shape)), np.zeros((count, *lin.D.shape))
        y, sensing, state = np.zeros((count, len(lin.C))), ready.sensing, ready.map
        if sensing is None or not sensing.needs_acceleration:
            return C, D, y
        point = lin.q, lin.v, state.velocities(lin.v), self._u
        data = ready.robot.create_data()

        def seen(one: Rates) -> list[Array]:
            made = output_equations(ready, data, chart, one, lin.x0, point)
            return [made[key] for key in ("C", "D", "y0")]

        # Affine in the rates, as all else.
        none = seen(Rates(*(np.zeros_like(part[0]) for part in rates)))
        for row in range(count):
            own = seen(Rates(*(part[row] for part in rates)))
            C[row], D[row], y[row] = (a - b for a, b in zip(own, none, strict=True))
        return C, D, y


def sensitivity(lin: LinearModel) -> Sensitivity:
    r"""Differentiate a linear model over the parameters of its robot, exactly.

    M and RNEA are linear in the dynamic parameters of bodies, so that derivatives of A, B and f0
    are those of the linear model's own equations:
    :math:`(M^{-1})_p = -M^{-1} M_p M^{-1}` and so on; docs/derivation.md has them.

    Parameters
    ----------
    lin : LinearModel
        Continuous, made by `linearize` in this session, about any point and in any frame.

    Returns
    -------
    Sensitivity
        Derivatives are computed when they are asked for.

    Raises
    ------
    InputError
        If the model is sampled, is from a file, or watches what depends on masses itself
        (`CenterOfMass`, `Momentum`).
    ModelError
        If the robot was changed after the model was made.
    """
    if not isinstance(lin, LinearModel):
        raise InputError(f"lin is a {type(lin).__name__}, expected a LinearModel of linearize")
    robot = lin._robot
    if robot is None:
        raise InputError("the model is from a file, without its robot; make it with linearize")
    if lin.dt:
        raise InputError("the model is sampled; take the continuous one, and sample what it gives")
    if any(isinstance(output, CenterOfMass | Momentum) for output in robot.outputs):
        raise InputError(
            "the outputs have the centre of mass or the momentum, which depend on masses "
            "themselves; leave them out with robot.replace(outputs=...)"
        )
    lin.require_unchanged()
    return _made(lin, robot)


def _made(lin: LinearModel, robot: Robot) -> Sensitivity:
    own = lin.moving or bool(np.array_equal(lin.placement, own_reference(robot, lin.q)))
    own = own and robot.orbit is None
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
    return Sensitivity(lin, Parameters(robot), ready, rates, bodies, u)


def _difference(found: Sensitivity, name: str) -> float:
    """Return how far fourth-order differences over a parameter of bodies are from its slope."""
    lin, one = found.lin, found.parameters[name]
    if not one.bodies:
        raise InputError(f"'{name}' is no parameter of a body; only these are checked so")
    robot = found._ready.robot
    step = _STEP / found._bodies.share(one.bodies)

    def at(times: float) -> tuple[Array, Array]:
        model = robot.model.copy()
        for joint, d in one.bodies.items():
            changed = model.inertias[joint].toDynamicParameters() + times * step * d
            body = pin.Inertia.FromDynamicParameters(changed)
            if not changed[0]:  # a wheel, whose centre of mass Pinocchio takes for 0 / 0
                about = changed[4:][[[0, 1, 3], [1, 2, 4], [3, 4, 5]]]
                body = pin.Inertia(0.0, np.zeros(3), about)
            model.inertias[joint] = body
        state = StateMap(replace(robot, model=model), reference=lin.reference, frame=lin.frame)
        return aba_route(state, Aba(state), lin.q, lin.v, lin.u0, moving=lin.moving)[:2]

    slope, worst = found[name], 0.0
    for *stepped, now, exact in zip(
        *map(at, (-2.0, -1.0, 1.0, 2.0, 0.0)), (slope.dA, slope.dB), strict=True
    ):
        far, near, nearer, farther = stepped
        by_steps = (far - 8.0 * near + 8.0 * nearer - farther) / (12.0 * step)
        size = max(np.abs(by_steps).max(), _LEAST * np.abs(now).max() / step)
        worst = max(worst, float(np.abs(by_steps - exact).max() / size))
    return worst


def _table(found: Sensitivity) -> str:
    lin, sizes = found.lin, [max(np.abs(x).max(), 1e-300) for x in (found.lin.A, found.lin.B)]
    rows = []
    for one, dA, dB in zip(found.parameters.values(), found.dA, found.dB, strict=True):
        small = one.part.partition(".")[0] in ("com", "position")
        step = 0.01 if small else 0.1 * (abs(one.value) or float(one.part[:9] == "direction"))
        effect = [step * np.abs(d).max() / size for d, size in zip((dA, dB), sizes, strict=True)]
        if max(effect) > 0.0:
            change = f"{step:.3g} {one.unit}"
            rows.append((max(effect), one.name, f"{one.value:.5g}", change, *effect))
    rows.sort(key=lambda row: -row[0])
    most = [(*row[1:4], *(f"{100.0 * x:.2g} %" for x in row[4:])) for row in rows[:_SHOWN]]
    title = f"{lin.robot}: what changes A and B most, of their largest entries, to first order"
    return f"{title}\n" + grid([("parameter", "is", "changed by", "A", "B"), *most], "lrrrr")
