"""A simulated robot: its accelerations under inputs and forces, and its conserved quantities.

Without external forces the momentum about a fixed point is constant, and the centre of mass moves
along r_c(t) = r_c(0) + p t / m. In orbit the Jacobi integral (14.3) is conserved instead.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dposv

from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.validation import Array, as_double
from fflin.dynamics.aba import Aba
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.integrators import Integrator
from fflin.dynamics.orbital import OrbitField
from fflin.dynamics.state import StateMap
from fflin.kernel.forward import ActuatorFaults, apply_faults
from fflin.robot.joints import ROOT
from fflin.robot.mass_properties import require_inertia
from fflin.robot.robot import Robot

# Function of (t, q, v) that returns a generalised force (nv,) in Pinocchio's order: force and
# torque on the base in base axes, then joint forces.
Disturbance: TypeAlias = Callable[[float, Array, Array], ArrayLike]

_aba, _crba, _placement = pin.aba, pin.crba, pin.XYZQUATToSE3
# Velocity above which a disturbance need not be finite, because the motion has diverged.
_DIVERGED = 1e6
_LINEAR_FIRST = [3, 4, 5, 0, 1, 2]


def triads(actuation: Actuation) -> list[int]:
    """Return the index of the first of the three inputs of each vector on the base."""
    found = [actuation.groups[key] for key in ("tau_b", "F_b") if key in actuation.groups]
    return sorted(int(entries[0]) for entries in found)


class Plant:
    """The nonlinear robot under inputs (in the axes of the state's frame) and a disturbance."""

    def __init__(
        self,
        state: StateMap,
        disturbance: Disturbance | None = None,
        faults: ActuatorFaults | None = None,
    ) -> None:
        robot = state.robot
        require_inertia(robot)
        self.state, self.robot = state, robot
        self._aba = Aba(state)
        self.actuation = self._aba.actuation
        if disturbance is not None and not callable(disturbance):
            raise InputError(
                f"disturbance has type {type(disturbance).__name__}, expected a function of (t, q, "
                "v)"
            )
        self.disturbance = disturbance
        self._model, self._data = robot.model, robot.create_data()
        nu = len(self.actuation.names)
        self._triads = triads(self.actuation)
        self.faults = faults or ActuatorFaults(
            gain=np.ones(nu),
            bias=np.zeros(nu),
            until=np.full(nu, np.inf),
            turn=np.tile(np.eye(3).ravel(), len(self._triads)),
        )
        self._faulty = faults is not None
        self._columns = np.column_stack(
            [state.lift(self.actuation.torques(unit)) for unit in np.eye(nu)]
        )
        # Whether only u acts on the robot, with a constant input matrix.
        self._plain = (
            state.S is None
            and not self.actuation.carried
            and not robot.stored_momentum
            and not any(values.any() for values in robot.springs)
            and not any(robot.gravity)
            and not robot.orbit
        )
        self.field = self._aba.field

    def stage(self, t: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        """Return dv/dt (nv,), and the external wrench (6,) without gravity, in base axes.

        In orbit, the wrench is replaced by the power [W] of inputs, disturbance and dampers,
        followed by zeros.
        """
        if self._faulty:
            given = np.empty(len(u))
            apply_faults(self.faults, self._triads, t, u, given)
            u = given
        if self.actuation.held:  # rotated by R instead of the chart, which is singular at 180 deg
            R, u = self.state.rotation(q), u.copy()
            for held in self.actuation.held:
                u[held] = u[held].dot(R)
        if self._plain and self.disturbance is None:
            tau = self._columns.dot(u)
            return _aba(self._model, self._data, q, v, tau), tau[:6]
        force = self.actuation.columns(self._data, q) @ u
        disturbed = None
        if self.disturbance is not None:
            disturbed = self._disturbed(self.disturbance(t, q.copy(), v.copy()), t, v)
        rate = self._aba.acceleration(q, v, u, disturbed)
        push = force[_LINEAR_FIRST] if disturbed is None else force[_LINEAR_FIRST] + disturbed[:6]
        if self.field:
            nu = self.state.velocities(v)
            power = nu.dot(force) - self.robot.springs.damping.dot(nu[6:] ** 2)
            push = np.append(power if disturbed is None else power + v.dot(disturbed), np.zeros(5))
        return rate, push

    def isolated(self, *, driven: bool) -> bool:
        """Return whether no external force acts; if `driven`, wrenches of inputs count too."""
        driven = driven or bool(self.faults.bias.any())
        base = driven and (self._columns[:6].any() or self.actuation.carried)
        outside = self.disturbance is not None or any(self.robot.gravity) or self.robot.orbit
        return not (base or outside)

    def _disturbed(self, given: ArrayLike, t: float, v: Array) -> Array:
        force = as_double(f"disturbance(t, q, v) at t = {t:g} s", given)
        finite = np.isfinite(force).all() or not np.abs(v).max() < _DIVERGED
        if force.shape != (self.robot.nv,) or not finite:
            raise InputError(
                f"disturbance(t, q, v) returned shape {force.shape} at t = {t:g} s, expected "
                f"({self.robot.nv},) finite numbers: a generalised force in Pinocchio's order"
            )
        return force


class Histories(NamedTuple):
    """Histories of energy, of momentum about the centre of mass, and of the centre of mass."""

    energy: Array  # (N,)
    momentum: Array  # (N, 6)
    center: Array  # (N, 3)
    sizes: Array  # (N, 2) upper bounds of linear momentum, and of angular about the point (11.5)


class Conserved:
    """Energy, and momentum: linear, then angular about a fixed point, in world axes."""

    # The fixed point is the base's position in `start`. About the world's origin, digits would be
    # lost if the robot were far away from it.

    def __init__(self, robot: Robot, start: Array) -> None:
        self._robot, self.mass = robot, robot.mass
        self._model = robot.model
        self._data = data = robot.create_data()
        self._M = data.M[:6]  # CRBA writes into it
        self._M_bb = self._M[:, :6]
        self._start = np.concatenate((start[:3], np.zeros(4)))
        self._x, self._y, self._z = start[:3].tolist()  # numbers are faster than arrays
        self._root = robot.model.jointPlacements[ROOT]
        self._weight = robot.mass * np.array(robot.gravity) if any(robot.gravity) else None
        self._free = self._root.isIdentity(0.0)
        self._stored = robot.stored_momentum

    def about_point(self, history: Histories) -> Array:
        """Return the momentum (N, 6) about the point."""
        p, about_center = np.split(history.momentum, 2, axis=1)
        return np.hstack((p, about_center + np.cross(history.center, p)))

    def wrench(self, q: Array, push: Array) -> Array:
        """Return the wrench (6,) of a plant's push and gravity about the point, in world axes."""
        total: Array = self._base(q).toDualActionMatrix().dot(push)
        if self._weight is not None:
            near = q.copy()
            near[:7] -= self._start
            com = pin.centerOfMass(self._model, self._data, near, False)
            total[:3] += self._weight
            total[3:] += skew(com).dot(self._weight)
        return total

    def impose(self, q: Array, v: Array, momentum: Array, center: Array) -> None:
        """Set the base's position in `q` and velocity in `v` by centre of mass and momentum."""
        # r_b = r_c - R c_b and nu_b = M_bb^-1 (H_b - M_bm qdot_m). Only the deviation of the
        # momentum is solved for, so rounding errors are relative to this small correction. M is in
        # base axes, so it does not depend on the base's position.
        _crba(self._model, self._data, q)
        if self._stored:
            pin.forwardKinematics(self._model, self._data, q)
            momentum = momentum.copy()
            momentum[3:] -= self._of_wheels()
        base = _placement(q[:7])
        if not self._free:
            base = self._root * base
        base.translation = center
        # The off-diagonal block of M_bb is -m [c]x.
        position = base.act(self._M[(1, 2, 0), (5, 3, 4)] / -self.mass)
        base.translation = position
        x, y, z = (position if self._free else self._root.actInv(position)).tolist()
        q[0], q[1], q[2] = x + self._x, y + self._y, z + self._z
        lack: Array = momentum.dot(base.toActionMatrix()) - self._M.dot(v)
        v_b = v[:6]
        v_b += dposv(self._M_bb, lack, 0, 0, 1)[1]

    def histories(self, q: Array, v: Array) -> Histories:
        """Return the conserved quantities at each row of q (N, nq) and v (N, nv)."""
        model, data = self._model, self._data
        rows, q = len(q), q.copy()
        q[:, :7] -= self._start
        energy, center = np.empty(rows), np.empty((rows, 3))
        momentum, polar = np.empty((rows, 6)), np.empty(rows)
        for i, (q_i, v_i) in enumerate(zip(q, v, strict=True)):
            energy[i] = pin.computeKineticEnergy(model, data, q_i, v_i)
            pin.ccrba(model, data, q_i, v_i)
            # The momentum of CCRBA is summed about the origin and has larger rounding errors.
            momentum[i] = pin.computeCentroidalMomentum(model, data, q_i, v_i).vector
            center[i] = data.com[0]
            polar[i] = 0.5 * np.trace(data.Ig.inertia) + self.mass * center[i].dot(center[i])
            if self._stored:
                momentum[i, 3:] += self._of_wheels()
        sizes = np.sqrt(2.0 * energy[:, None] * np.column_stack((np.full(rows, self.mass), polar)))
        if self._weight is not None:
            energy -= (center + self._root.rotation @ self._start[:3]) @ self._weight
        stiffness, _, rest = self._robot.springs
        if stiffness.any():
            positions = [[joint.value(q_i) for joint in self._robot.joints] for q_i in q]
            energy += 0.5 * (np.array(positions) - rest) ** 2 @ stiffness
        return Histories(energy, momentum, center, sizes)

    def momentum_drift(self, history: Histories, expected: Array) -> Array:
        """Return the errors (N,) of the momentum, relative to the momentum's bounds (11.5)."""
        scale = history.sizes.max(axis=0)
        scale[1] += sum(float(np.linalg.norm(stored)) for _, stored in self._stored)
        missing = self.about_point(history) - expected
        sizes = np.linalg.norm(missing.reshape(-1, 2, 3), axis=2)
        relative = np.divide(sizes, scale, out=np.zeros_like(sizes), where=scale > 0.0)
        largest: Array = relative.max(axis=1)
        return largest

    def _of_wheels(self) -> Array:
        """Return the stored momentum (3,) at the last evaluated link poses, in world axes."""
        total: Array = np.zeros(3)
        for joint, stored in self._stored:
            total += self._data.oMi[joint].rotation @ stored
        return total

    def _base(self, q: Array) -> pin.SE3:
        """Return the placement of the base relative to the point."""
        placement = _placement(q[:7] - self._start)
        return placement if self._free else self._root * placement


class MomentumReference:
    """Momentum and centre of mass from the external impulse, step by step (11.2)."""

    momentum: Array  # (6,) about the point
    wrenches: tuple[Array, ...]  # (6,) about the point for each stage; the caller writes them

    def __init__(
        self, conserved: Conserved, method: type[Integrator], h: float, q: Array, v: Array
    ) -> None:
        history = conserved.histories(q[None], v[None])
        per_mass = 1.0 / conserved.mass
        self.momentum = conserved.about_point(history)[0]
        self._momentum, self._start = self.momentum, history.center[0]
        # Position and velocity of the centre of mass without external forces, as columns.
        self._line = np.column_stack((self._start, self.momentum[:3] * per_mass))
        self._time = np.ones(2)
        # Rows: the impulse; the displacement that the impulse causes; the wrenches of a step.
        # Without external forces all rows are exactly zero.
        self._stack = np.zeros((2 + len(method.weights), 6))
        self._sums, self.wrenches = self._stack[:2], tuple(self._stack[2:])
        weights, moments = h * np.array(method.weights), h * h * np.array(method.moments)
        self._after = np.array([[1.0, 0.0, *weights], [h * per_mass, 1.0, *(per_mass * moments)]])

    def center(self, t: float) -> Array:
        """Return the centre of mass (3,) relative to the point."""
        self._time[1] = t
        position: Array = self._line.dot(self._time)
        return position

    def advance(self) -> None:
        """Advance by a step under the wrenches that were written for its stages."""
        self._sums[:] = impulse, displacement = self._after.dot(self._stack)
        self.momentum = self._momentum + impulse
        self._line[:, 0] = self._start + displacement[:3]


class Jacobi(Conserved):
    """Jacobi integral in orbit: the energy in the rotating frame, compared with the work done."""

    def __init__(self, robot: Robot, start: Array, field: OrbitField) -> None:
        super().__init__(robot, start)
        self._field, self._scale = field, 0.0

    def about_point(self, history: Histories) -> Array:
        """Return zeros (N, 6); the work since the start is added to the first column."""
        return np.zeros_like(history.momentum)

    def wrench(self, q: Array, push: Array) -> Array:
        """Return a plant's push in orbit: the power (1,) and zeros (5,)."""
        return push

    def histories(self, q: Array, v: Array) -> Histories:
        """Return energies at each row, with the gravity gradient and the rotating frame."""
        found, potential = super().histories(q, v), np.empty(len(q))
        for i, q_i in enumerate(q):
            pin.forwardKinematics(self._model, self._data, q_i)
            potential[i] = self._field.potential(self._data)
        self._scale = float((np.abs(found.energy) + np.abs(potential)).max())
        return found._replace(energy=found.energy + potential)

    def momentum_drift(self, history: Histories, expected: Array) -> Array:
        """Compare the integral with its initial value plus the work; return relative errors."""
        missing = np.abs(history.energy - history.energy[0] - expected[:, 0])
        return missing / (self._scale or 1.0)


def conserved_by(robot: Robot, start: Array, field: OrbitField | None) -> Conserved:
    """Return the conserved quantities of a robot's motion from a configuration (nq,)."""
    return Conserved(robot, start) if field is None else Jacobi(robot, start, field)
