"""A and B by the derivatives of ABA, and the scales and rounding errors of their entries."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array, frozen
from fflin.dynamics.aba import Aba, scaled_inverse
from fflin.dynamics.coordinates import ANGULAR, LINEAR, PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.rnea import Inertia
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel
from fflin.linear.scales import EPS, FEW_ULPS, Reference, sampled, scales, spread_over
from fflin.linear.tool_coordinates import ToolCoordinates
from fflin.robot.robot import Robot

# To sample their rounding errors, the ABA derivatives are computed again at _SAMPLES points that
# differ by _NUDGE. This changes the exact derivatives by about as much as ten units in the last
# place of the arguments.
_NUDGE, _SAMPLES = 1e-14, 3


class Dynamics(NamedTuple):
    """Accelerations (6 + n,) and their derivatives in base axes."""

    rates: Array
    by_q: Array
    by_v: Array
    by_u: Array


def _dynamics(
    aba: Aba, q: Array, v: Array, u: Array, inertia: Array | None = None
) -> Dynamics:
    """Return the accelerations by ABA and their derivatives; `u` is in base axes.

    If M (6 + n, 6 + n) in base axes is given as `inertia`, the result contains M^-1 in place of the
    inverse that ABA computes. If links are far apart, ABA is less accurate than CRBA.
    """
    state = aba.state
    # Pinocchio differentiates about the world's origin, and loses accuracy if the base is distant.
    # So place the base at the world's origin. This is allowed, because A and B do not depend on the
    # position of the base, even in orbit. But the linear acceleration in base axes does, and a
    # robot that is anchored in inertial space stays where it is.
    anchored = state.robot.anchored
    q, slow = q.copy(), v.copy()
    if not anchored and (not state.field or state.axes[1]):
        q[:3] = 0.0
    relative = not (state.field or anchored)
    if relative:
        # Without an orbit, the dynamics do not depend on the linear velocity of the base, except
        # for the rotation of the base axes, which adds -omega x v to the rate of this velocity.
        slow[PIN_LINEAR] = 0.0
    by_q, by_v, by_u = aba.slopes(q, slow, u)
    (rates,) = state.velocities(aba.accelerations(q[None], slow[None], u[None]))
    if inertia is not None:
        residual = inertia @ aba.inverse - np.eye(len(inertia))
        change = scaled_inverse(inertia) @ residual @ inertia
        rates, by_u = rates - change @ rates, by_u - change @ by_u
        # The columns of the base's position and of its linear velocity do not contain M^-1.
        others = np.r_[ANGULAR, 6 : len(inertia)]
        by_q[:, others] -= change @ by_q[:, others]
        by_v[:, others] -= change @ by_v[:, others]
    if relative:
        linear, angular = v[PIN_LINEAR], v[PIN_ANGULAR]
        rates[LINEAR] -= np.cross(angular, linear)
        by_v[:, LINEAR] = 0.0
        by_v[LINEAR, LINEAR] = -skew(angular)
        by_v[LINEAR, ANGULAR] += skew(linear)
    return Dynamics(rates, by_q, by_v, by_u)


class Accelerations(NamedTuple):
    """Accelerations (6 + n,) in base axes, and their derivatives by the state and the inputs."""

    rates: Array
    by_x: Array
    by_u: Array


class Route:
    """A and B by the derivatives of ABA at the point of a model.

    Attributes
    ----------
    A, B : Reference
        The matrices with their scales and rounding errors.
    sums_A, sums_B : ndarray (nx, nx) and (nx, nu)
        Sums of the magnitudes of the terms of A and B, to which rounding errors are relative.
    accelerations : Accelerations
        Accelerations and their derivatives.
    samples : list of Accelerations
        The same with other rounding errors.
    rates_error : ndarray (6 + n,)
        Rounding errors of the accelerations.
    mobility, base_mobility : ndarray (6 + n,)
        Mobilities sqrt((M^-1)_ii) in the axes of the frame and of the base: the speed of coordinate
        i at a kinetic energy of 1/2 J, if all other coordinates are free. They make accelerations
        of different coordinates comparable.
    input_mobility : ndarray (nu,)
        sqrt(b^T M^-1 b), where b is the generalised force of a unit input.
    frame_size : ndarray (nx, nx)
        Magnitudes of the matrix that transforms small displacements to the state.
    units : ndarray (nx,)
        Units of the states, in which different states are comparable.
    """

    def __init__(self, robot: Robot, lin: LinearModel) -> None:
        self.state = state = StateMap(
            robot, reference=lin.reference, frame=lin.frame, t=lin.time
        )
        self.aba = Aba(state)
        self.q = robot.checked_configuration(lin.q)
        self.v = robot.checked_velocity(lin.v)
        self.nu = state.velocities(self.v)
        self._u = self.aba.actuation.in_base_axes(state.chart(self.q), lin.u0)
        self._own = ToolCoordinates(state, moving=lin.moving)
        self.M = inertia_matrix(robot, lin)
        inverse = scaled_inverse(self.M)
        self.mobility = np.sqrt(inverse.diagonal())
        self.base_mobility = np.sqrt(_in_base(state, self.q, inverse).diagonal())
        self.units = np.concatenate((self.mobility, self.mobility))

        # To sample the rounding errors, the derivatives are computed again at points that differ by
        # _NUDGE, and with M^-1 of CRBA in place of ABA's M^-1.
        dynamics = _dynamics(self.aba, self.q, self.v, self._u)
        inertia = _in_base(state, self.q, self.M)
        others = []
        if not robot.constraints:
            others.append(_dynamics(self.aba, self.q, self.v, self._u, inertia))
        rng = np.random.default_rng(0)
        others += [_dynamics(self.aba, *self._nudged(rng)) for _ in range(_SAMPLES)]
        self.at = self._own.jacobians(self.q, self.nu, self._u, dynamics.rates)
        self.frame_size = _whole(self.at.P, len(self.M))
        self._accelerations(dynamics, others)
        self._matrices(dynamics, others, inverse)

    def _accelerations(self, dynamics: Dynamics, others: list[Dynamics]) -> None:
        self.accelerations = self._by_state(dynamics)
        self.samples = [self._by_state(other) for other in others]
        parts = {"omega_b": ANGULAR, "v_b": LINEAR, "qdot_m": slice(6, None)}
        rates = [other.rates[:, None] for other in self.samples]
        self.rates_error = sampled(
            parts, dynamics.rates[:, None], rates, self.base_mobility
        )[:, 0]

    def _by_state(self, dynamics: Dynamics) -> Accelerations:
        by_y = np.hstack((dynamics.by_q, dynamics.by_v)) + dynamics.by_u @ self.at.H
        return Accelerations(
            dynamics.rates, by_y @ self.at.left, dynamics.by_u @ self.at.V
        )

    def _matrices(
        self, dynamics: Dynamics, others: list[Dynamics], inverse: Array
    ) -> None:
        groups = self.state.groups._asdict()
        inputs = self.aba.actuation.groups
        nv = len(self.M)
        A, B = self._assembled(dynamics)
        more = [self._assembled(other) for other in others]
        lower = B[nv:]
        free = lower
        if self.state.robot.constraints:
            # An input without effect on the constrained robot has an effect on the free one.
            data = self.state.robot.create_data()
            forces = self.aba.actuation.columns(data, self.q)
            chart = self.state.chart(self.q)
            free = inverse @ self.state.to_frame(chart, forces)
        mobility = np.sqrt(np.einsum("ik,ij,jk->k", free, self.M, free))
        self.input_mobility = np.where(mobility > 0.0, mobility, 1.0)

        sums_A, sums_B = self._sums(dynamics)
        # The derivatives of the accelerations are sums of entries of M^-1 times derivatives of
        # generalised forces.
        weights = np.abs(inverse)
        terms_A = np.vstack((sums_A[:nv], weights @ np.abs(self.M @ A[nv:])))
        if self.aba.field:
            # In orbit, the terms of the rotating frame may cancel, for example those of a wheel.
            terms_A[nv:] += weights @ np.hstack(self.aba.field.derivative_sizes(self.M))
        terms_B = np.vstack((sums_B[:nv], weights @ np.abs(self.M @ B[nv:])))
        # Rounding errors of the model's constants, such as the placements of joints, do not change
        # with the operating point. They change the entries of M, relative to these entries.
        sums_A[nv:] += weights @ (np.abs(self.M) @ np.abs(A[nv:]))
        sums_B[nv:] += weights @ (np.abs(self.M) @ np.abs(lower))
        self.sums_A, self.sums_B = sums_A, sums_B
        units = self.units
        input_units = 1.0 / self.input_mobility
        size = np.maximum(spread_over(groups, A, units), terms_A)
        scale = scales(groups, groups, size, units, units)
        rounding = FEW_ULPS * EPS * sums_A
        rounding += sampled(groups, A, [x for x, _ in more], units)
        self.A = Reference(A, scale, rounding)
        size = np.maximum(spread_over(groups, B, units), terms_B)
        scale = scales(groups, inputs, size, units, input_units)
        rounding = FEW_ULPS * EPS * sums_B
        rounding += sampled(groups, B, [x for _, x in more], units)
        self.B = Reference(B, scale, rounding)

    def _assembled(self, dynamics: Dynamics) -> tuple[Array, Array]:
        return _assembled(self._own, self.q, self.nu, self._u, dynamics)

    def _nudged(self, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Return q, v and the inputs in base axes, changed by _NUDGE."""
        state = self.state
        stiffness, _, rest = state.robot.springs
        unit = np.array([1.0 / joint.scale for joint in state.robot.joints])
        # The rounding error of a spring's force is relative to the deflection of the spring.
        deflection = np.abs(state.joint_positions(self.q) - rest)
        unit = np.where(stiffness > 0.0, np.minimum(unit, deflection), unit)
        size = np.concatenate((np.ones(6), unit))

        def nudges(count: int) -> Array:
            signs: Array = rng.choice((-1.0, 1.0), count)
            return _NUDGE * signs

        displacement = state.spread(nudges(len(size)) * size)
        nu = self.nu * (1.0 + nudges(len(size)))
        u = self._u * (1.0 + nudges(len(self._u)))
        q = pin.integrate(state.robot.model, self.q, displacement)
        return q, state.spread(nu), u

    def _sums(self, dynamics: Dynamics) -> tuple[Array, Array]:
        """Sum the magnitudes of the terms of A and B when they are transformed to the frame."""
        nv = len(self.M)
        at = self.at
        A, B = np.zeros((2 * nv, 2 * nv)), np.zeros((2 * nv, len(self._u)))
        A[:nv, nv:] = np.eye(nv)
        A[ANGULAR, ANGULAR] = A[LINEAR, LINEAR] = _norm(self.nu[ANGULAR])
        A[LINEAR, ANGULAR] = _norm(self.nu[LINEAR])
        A[nv:] = np.hstack((np.abs(dynamics.by_q), np.abs(dynamics.by_v)))
        B[nv:] = np.abs(dynamics.by_u)
        P = self.frame_size
        left = _whole(at.left, nv)
        A = (P @ (A + B @ np.abs(at.H)) + _whole(at.rate, nv)) @ left
        return A, P @ B @ np.abs(at.V)

    def rate_terms(self, faster: Array) -> Array:
        """Sum the magnitudes of the terms of f (nx,), with the velocities increased by `faster`."""
        state, aba = self.state, self.aba
        v = self.v.copy()
        v[PIN_LINEAR] = 0.0
        v = state.spread(np.abs(state.velocities(v)) + faster)
        if state.field:
            v = state.field.absolute(self.q, v)
        low = aba.terms(self.q, v, self._u)
        low[LINEAR] += _norm(self.nu[ANGULAR]) * _norm(self.nu[LINEAR])
        turned = np.concatenate((np.abs(self.nu) + faster, low))
        terms: Array = self.frame_size @ turned
        return terms


def _norm(x: Array) -> float:
    return float(np.linalg.norm(x))


def _whole(x: Array, nv: int) -> Array:
    """Return the magnitudes of a matrix, with the blocks (3, 3) of the base at their largest entry.

    The rounding error of an entry of a rotation matrix is relative to 1, not to the entry.
    """
    sizes = np.abs(x)
    starts = (0, 3, nv, nv + 3)
    for i in starts:
        for j in starts:
            sizes[i : i + 3, j : j + 3] = sizes[i : i + 3, j : j + 3].max()
    return sizes


def scaled_condition(M: Array) -> float:
    """Return the condition number of M scaled to a unit diagonal."""
    scale = 1.0 / np.sqrt(M.diagonal())
    return float(np.linalg.cond(scale[:, None] * M * scale))


def inertia_residual(M: Array, inverse: Array) -> float:
    """Return the largest magnitude in ``M M^-1 - I``, with M scaled to a unit diagonal."""
    scale = np.sqrt(M.diagonal())
    residual = M @ inverse - np.eye(len(M))
    return float(np.abs(residual * scale / scale[:, None]).max())


def inertia_matrix(robot: Robot, lin: LinearModel) -> Array:
    """Return M (6 + n, 6 + n) of a linear model, in state order and in the frame's axes."""
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    upper = pin.crba(robot.model, robot.create_data(), lin.q)
    return frozen(_in_frame(state, lin.q, state.project(upper.T)))


def inverse_inertia(state: StateMap, lin: LinearModel) -> Array:
    """Return M^-1 (6 + n, 6 + n) at the point of a linear model, in the frame's axes."""
    nv = 6 + state.robot.n
    inverse: Array = np.empty((nv, nv))
    Inertia(state, state.robot.create_data()).invert(lin.q, inverse)
    return _in_frame(state, lin.q, inverse)


def _in_base(state: StateMap, q: Array, matrix: Array) -> Array:
    """Transform M or its inverse (6 + n, 6 + n) from the axes of the frame to base axes."""
    chart = state.chart(q)
    return state.to_base(chart, state.to_base(chart, matrix).T).T


def _in_frame(state: StateMap, q: Array, matrix: Array) -> Array:
    """Transform M or its inverse (6 + n, 6 + n) from base axes to the axes of the frame."""
    chart = state.chart(q)
    return state.to_frame(chart, state.to_frame(chart, matrix).T).T


def aba_route(
    aba: Aba, q: Array, v: Array, u: Array, *, moving: bool = False
) -> tuple[Array, Array, Array]:
    """Return A and B from ABA's derivatives, see (4.9), (15.3), (15.4); also return ABA's M^-1.

    `u` is in the axes of the frame. M^-1 (6 + n, 6 + n) is in base axes.
    """
    state = aba.state
    nu = state.velocities(v)
    u = aba.actuation.in_base_axes(state.chart(q), u)
    dynamics = _dynamics(aba, q, v, u)
    A, B = _assembled(ToolCoordinates(state, moving=moving), q, nu, u, dynamics)
    return A, B, aba.inverse


def _assembled(
    coordinates: ToolCoordinates, q: Array, nu: Array, u: Array, dynamics: Dynamics
) -> tuple[Array, Array]:
    """Assemble A and B from the derivatives of the accelerations; `nu` and `u` are in base axes."""
    state = coordinates.state
    nv = len(nu)
    jacobians = coordinates.jacobians(q, nu, u, dynamics.rates)
    # Assemble A_y and B_y of (4.9). The upper half of A_y is the kinematics of a small displacement
    # in axes that rotate with the base.
    A, B = np.zeros((state.nx, state.nx)), np.zeros((state.nx, len(u)))
    A[ANGULAR, ANGULAR] = A[LINEAR, LINEAR] = -skew(nu[ANGULAR])
    A[LINEAR, ANGULAR] = -skew(nu[LINEAR])
    A[:nv, nv:] = np.eye(nv)
    A[nv:] = np.hstack((dynamics.by_q, dynamics.by_v))
    B[nv:] = dynamics.by_u
    A = (jacobians.P @ (A + B @ jacobians.H) + jacobians.rate) @ jacobians.left
    return A, jacobians.P @ B @ jacobians.V
