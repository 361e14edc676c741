"""Inverse inertia M^-1, accelerations, and derivatives of the accelerations by RNEA."""

import warnings
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, SingularInertiaError, listed
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.closure import Closure
from fflin.dynamics.contact import Contact, ContactSolver
from fflin.dynamics.coordinates import ANGULAR, LINEAR, PIN_ANGULAR
from fflin.dynamics.orbital import GravityGradient
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.joints import ROOT
from fflin.robot.mass_properties import coordinate_names

# The coupling of a coordinate i is M_ii (M^-1)_ii. Coordinate i has the inertia M_ii if all other
# coordinates are locked, and the inertia 1 / (M^-1)_ii if they are free. The coupling is the ratio
# of these two inertias, and is 1 for a decoupled coordinate. The relative error of (M^-1)_ii is
# about the coupling times machine epsilon. If the sum of all couplings exceeds WARNING_COUPLING,
# M^-1 has fewer than nine correct digits. If the sum exceeds _LARGEST_COUPLING, M^-1 has fewer than
# two correct digits. Exact couplings are at least 1. So if the computed sum is less than the number
# of coordinates, some pivots of M are only rounding errors.
_EPS = float(np.finfo(float).eps)
WARNING_COUPLING, _LARGEST_COUPLING = 1e-9 / _EPS, 1e-2 / _EPS

# Pinocchio's articulated-body inverse sums inertias about the base's origin. To bound its rounding
# errors, the couplings are computed with `inertia_bounds` in place of M_ii. If the sum of these
# couplings exceeds the following limit, M^-1 is computed by a Cholesky factor of M instead.
_QUICK_COUPLING = 1e-11 / _EPS

# [m] largest displacement of a prismatic joint for which `inertia_bounds` holds
STROKE = 1.0

# If M has more rows than this, LAPACK factorises it faster than Pinocchio's sparse method.
_DENSE_SIZE = 64


# These functions are looked up once, because looking up a name in a module takes as long as
# factorising a small matrix.
_crba, _compute_inverse, _cholesky = pin.crba, pin.computeMinverse, pin.cholesky


class Inertia:
    """Computation of M^-1 at configurations of one robot, in base axes and state order."""

    def __init__(self, state: StateMap, data: pin.Data) -> None:
        robot = state.robot
        self._state = state
        self._model = robot.model
        self._data = data
        # These are views of the array `data.Minv`, which Pinocchio overwrites in place.
        self._inverse = data.Minv
        self._inverse_diagonal = self._inverse.diagonal()
        # With mimic joints or modes, v is not a permutation of nu. M is then factorised as a dense
        # matrix.
        self._constrained = state.S is not None
        simple = not (robot.followers or robot.modes)
        self._bounds = inertia_bounds(robot.model) if simple else None
        self._slides = [
            *map(attrgetter("idx_q"), filter(attrgetter("prismatic"), robot.joints))
        ]
        # M does not depend on the base's pose. Pinocchio works in world axes, and would lose digits
        # if the base were far away. So the base is placed at the origin.
        self._still: Array = pin.neutral(robot.model)
        self.least_coupling = 0.999 * (6 + robot.n)

    def centred(self, q: Array) -> Array:
        """Return q with the base in its neutral pose at the origin.

        The next call overwrites the returned array.
        """
        if q is not self._still:
            self._still[7:] = q[7:]
        return self._still

    def invert(self, q: Array, out: Array, *, quick: bool = False) -> None:
        """Write M^-1 (6 + n, 6 + n) at a configuration into the C-contiguous array `out`.

        The configuration is not checked. If `quick` is true, the articulated-body inverse is used
        at configurations at which it is accurate.
        """
        q_centred = self.centred(q)
        # For a robot with springs or dampers, `quick` should be false, because the articulated-body
        # inverse leaves rounding errors in entries of M^-1 K that should be exactly zero. Here K is
        # the stiffness. A Cholesky factor has relative rounding errors that do not depend on the
        # scaling of M.
        bounds = self._bounds if quick else None
        if bounds is not None and self._slides:
            stroke = np.abs(q_centred.take(self._slides)).max()
            if not stroke <= STROKE:
                bounds = None  # the bounds do not hold here
        if bounds is not None:
            _compute_inverse(self._model, self._data, q_centred)
            self._state.project(self._inverse, out)
            coupling = bounds.dot(self._inverse_diagonal)
            # If a pivot is zero, the coupling is NaN, and this comparison is false.
            if self.least_coupling < coupling < _QUICK_COUPLING:
                return
        # The articulated-body inverse is not accurate enough, or not asked for: factorise M.
        upper = _crba(self._model, self._data, q_centred)
        if self._constrained or len(upper) > _DENSE_SIZE:
            M = self._state.project(upper.T)
            _invert_dense(M, out)
            coupling = M.diagonal().dot(out.diagonal())
        else:
            _cholesky.decompose(self._model, self._data)
            inverse = _cholesky.computeMinv(self._model, self._data)
            self._state.project(inverse, out)
            coupling = upper.diagonal().dot(inverse.diagonal())
        # If a pivot is zero, the coupling is NaN. The negated comparison is then true.
        if not self.least_coupling < coupling < WARNING_COUPLING:
            self._judge(coupling, self._state.project(upper.T))

    def _judge(self, coupling: float, M: Array) -> None:
        """Raise an error for a singular M, or give a warning for an ill-conditioned M.

        The message names the coordinates whose motion has almost no inertia.
        """
        name = self._state.robot.name
        scale = np.sqrt(np.maximum(M.diagonal(), 0.0))
        scale[scale == 0.0] = 1.0
        # true for NaN as well
        lost = not self.least_coupling < coupling < _LARGEST_COUPLING
        mode = np.linalg.eigh(M / scale / scale[:, None])[1][:, 0]
        names = coordinate_names(self._state.robot)
        involved = listed(
            [names[i] for i in np.argsort(-np.abs(mode)) if abs(mode[i]) > 0.1]
        )
        if lost:
            raise SingularInertiaError(
                f"the mass matrix of '{name}' is singular at this configuration, because a "
                f"motion of {involved} moves no mass; choose another configuration, give the "
                "links an inertia, or lock a joint"
            )
        warnings.warn(
            f"the mass matrix of '{name}' is ill-conditioned, so A and B have a relative error "
            f"of about {coupling * _EPS:.0e}. A joint motion of {involved} moves almost no mass; "
            "check the inertias of the links",
            FflinWarning,
            stacklevel=6,
        )


def _invert_dense(M: Array, out: Array) -> None:
    from scipy.linalg.lapack import dpotrf, dpotri

    # `dpotri` returns the upper triangle of the inverse, and zeros below the diagonal. If M is not
    # positive definite, `upper` is NaN.
    factor, failed = dpotrf(M)
    upper = np.full_like(M, np.nan) if failed else dpotri(factor)[0]
    np.add(upper, upper.T, out=out)
    out.flat[:: len(M) + 1] *= 0.5


def inertia_bounds(model: pin.Model) -> Array | None:
    """Return upper bounds (nv,) of the masses and moments of inertia that the coordinates move.

    The moments of inertia are about the base's origin. Return None if a joint is neither revolute
    nor prismatic.
    """
    # By the parallel axis theorem, the moment of inertia of a body about the base's origin is at
    # most its largest principal moment plus m r^2. Here m is the mass of the body, and r is the
    # distance of its centre of mass from the base's origin. This distance is at most the length of
    # the path from the base's origin through the joints to the centre of mass, with a displacement
    # of `STROKE` at each prismatic joint.
    joints, parents = model.joints.tolist(), model.parents.tolist()
    kinds = ["", "", *(joint.shortname()[:11] for joint in joints[ROOT + 1 :])]
    if not {*kinds} <= {"", "JointModelR", "JointModelP"}:
        return None
    distances, masses, moments = ([0.0] * len(joints) for _ in range(3))
    for index, item in enumerate(model.inertias.tolist()):
        if index > ROOT:
            step = float(np.linalg.norm(model.jointPlacements[index].translation))
            if kinds[index] == "JointModelP":
                step += STROKE
            distances[index] = distances[parents[index]] + step
        masses[index] = item.mass
        # The largest principal moment is at most the largest row sum of the absolute values of the
        # inertia matrix.
        turning = float(np.abs(item.inertia).sum(axis=0).max())
        arm = distances[index] + float(np.linalg.norm(item.lever))
        moments[index] = item.mass * arm**2 + turning
    bounds: Array = np.empty(model.nv)
    for index in range(len(joints) - 1, ROOT, -1):
        moved = masses if kinds[index] == "JointModelP" else moments
        bounds[joints[index].idx_v] = moved[index]
        masses[parents[index]] += masses[index]
        moments[parents[index]] += moments[index]
    bounds[:3], bounds[3:6] = masses[1], moments[1]
    return bounds


class Turning(NamedTuple):
    """Rotation and field of the orbital frame, in base axes (.., 3) and (.., 3, 3)."""

    spin: Array  # Omega [rad/s]
    spin_change: Array  # its derivative [rad/s^2]
    pull: Array  # K of (14.2) or (17.1) [1/s^2]


class AccelerationDerivatives(NamedTuple):
    """Accelerations c of the base and the joints (3.1), and their derivatives, in base axes.

    The arrays have leading axes (..) if there are several points.
    """

    c: Array  # (.., 6 + n); dnu/dt follows from c by (3.2), or by (14.2) in orbit
    # Derivatives (.., 6 + n, 12 + 2 n) of c with respect to displacements of the state. The
    # displacements are in base axes.
    slopes: Array
    by_u: Array  # D_u (.., 6 + n, nu) of (3.3), for u in base axes
    gravity: Array  # (.., 3) [m/s^2] in base axes; `GravityGradient.fall` in orbit

    @property
    def by_turn(self) -> Array:
        """D_theta (.., 6 + n, 3) of (14.5), for rotations of the base.

        It is zero without an orbit, unless a constraint anchors the robot in inertial space.
        """
        return self.slopes[..., :3]

    @property
    def by_position(self) -> Array:
        """D_p (.., 6 + n, 3), for displacements of the base; zero unless the robot is anchored."""
        return self.slopes[..., 3:6]

    @property
    def by_q_m(self) -> Array:
        """D_m (.., 6 + n, n) of (3.3)."""
        return self.slopes[..., 6 : self.c.shape[-1]]

    @property
    def by_nu(self) -> Array:
        """D_nu (.., 6 + n, 6 + n) of (3.3).

        Its columns for v_b are zero, unless a constraint anchors the robot in inertial space.
        """
        return self.slopes[..., self.c.shape[-1] :]


class Accelerations:
    """Solution c of the equations of motion ``M c + b = B_u u`` (3.1), with its derivatives.

    Springs and dampers add their forces to the right side. If the robot has constraints, their
    `closure` must be given. The accelerations and derivatives are then constrained.
    """

    def __init__(
        self,
        state: StateMap,
        actuation: Actuation,
        data: pin.Data,
        closure: Closure | None = None,
    ) -> None:
        robot = state.robot
        self._state, self._actuation, self._data = state, actuation, data
        self._contacts = ContactSolver(closure) if closure is not None else None
        # Constraint forces at the last point of `rates`; None for a robot without constraints.
        self.contact: Contact | None = None
        self._model = robot.model
        self._nv = 6 + robot.n
        self.inertia = Inertia(state, data)
        self._springs = robot.springs
        self._resists = bool(np.any(robot.springs))
        # `rows` contains the derivatives, at constant c, of M c + b - B_u u minus the forces of
        # springs and dampers. Each row contains the derivative with respect to one component of the
        # state displacement, so the blocks for q_m and for nu are C-contiguous. The first three
        # rows are for the attitude of the base, and are zero without an orbit. The next three rows
        # are for the position of the base, and are always zero.
        rows = np.zeros((2 * self._nv, self._nv))
        self._force_slopes = rows.T
        self._by_turn = rows[:3]
        self._by_q_m = rows[6 : self._nv]
        self._by_nu = rows[self._nv :]
        self._by_linear = self._by_nu[LINEAR]
        # These are views of the diagonals to which stiffness and damping are added.
        self._of_stiffness = np.einsum("ii->i", self._by_q_m[:, 6:])
        self._of_damping = np.einsum("ii->i", self._by_nu[6:, 6:])
        self._minus_inverse = np.empty((self._nv, self._nv))
        self._stored = [
            (mounted, skew(momentum)) for mounted, momentum in robot.stored_momentum
        ]
        self._field = state.field
        self._still = np.zeros(robot.nv)
        # Rotation of the orbital frame at the last point of `rates`; None without an orbit.
        self.turning: Turning | None = None

    def rates(
        self, q: Array, v: Array, nu: Array, u: Array, slopes: Array, by_u: Array
    ) -> AccelerationDerivatives:
        """Return the accelerations c and their derivatives in base axes, at q, v and u.

        u is in base axes too, and `nu` is v in state order. The derivatives are written to the
        C-contiguous arrays `slopes` and `by_u`, and the result refers to these arrays.
        """
        model = self._model
        data = self._data
        state = self._state
        actuation = self._actuation
        tide = self._field and GravityGradient.at(self._field, q)
        # Here, the base is in its neutral pose and has no linear velocity, because large values
        # would make Pinocchio's derivatives less accurate. Without an orbit, c does not depend on
        # the pose and linear velocity of the base. In orbit, c depends on the attitude only through
        # `tide`. Gravity is zero as well, because uniform gravity accelerates all parts of the
        # robot alike (equivalence principle).
        q_still = self.inertia.centred(q)
        v_still = self._still
        v_still[3:] = v[3:]
        if tide:
            v_still[PIN_ANGULAR] += tide.spin
            pull, pull_by_q, pull_by_turn = tide.force(model, data, q_still)
        inverse = by_u if actuation.default else np.empty((self._nv, self._nv))
        self.inertia.invert(q_still, inverse, quick=not self._resists)
        columns = actuation.columns(data, q_still, self._turned_flux(q))
        bias = pin.nonLinearEffects(model, data, q_still, v_still)
        wrenches = actuation.wrenches(u)
        if self._stored:
            wrenches, turning, turning_by_q, turning_by_v = self._gyroscopic(
                q_still, v_still, wrenches
            )
            bias = bias - turning
        if tide:
            bias = bias - pull
        force = u if actuation.default else columns.dot(u)
        force = force - state.forces(bias)
        if self._resists:
            force[6:] += self._springs.force(state.joint_positions(q), nu[6:])
        c = inverse.dot(force)
        if self._contacts is not None:
            self.contact = self._contacts.contact(q, v, nu, c, inverse)
            c = self.contact.c
            wrenches = self.contact.added_to(wrenches)

        # Derivatives of M c + b - B_u u minus the forces of springs and dampers (3.3), (7.1). The
        # wrenches of inputs are constant in the frames of their links. So the derivatives of RNEA
        # with these wrenches include -d(B_u u)/dq.
        external = () if wrenches is None else (wrenches,)
        by_q, by_v, _ = pin.computeRNEADerivatives(
            model, data, q_still, v_still, state.spread(c), *external
        )
        if self._stored:
            by_q, by_v = by_q - turning_by_q, by_v - turning_by_v
        if tide:
            by_q = by_q - pull_by_q
        self._write_force_slopes(by_q, by_v)
        if tide:
            by_spin = self._by_nu[ANGULAR].T.dot(skew(tide.spin))
            self._by_turn[:] = (by_spin - state.forces(pull_by_turn)).T
        np.negative(inverse, self._minus_inverse).dot(self._force_slopes, slopes)
        if not actuation.default:
            inverse.dot(columns, by_u)
        if self._contacts is not None and self.contact is not None:
            self._contacts.differentiate(
                self.contact, q, v, nu, -self._minus_inverse, slopes, by_u
            )
        gravity = tide.fall if tide else state.gravity(q)
        if tide:
            self.turning = Turning(tide.spin, tide.spin_change, tide.pull)
        return AccelerationDerivatives(c, slopes, by_u, gravity)

    def _write_force_slopes(self, by_q: Array, by_v: Array) -> None:
        """Write the derivatives (nv, nv) of RNEA, with springs and dampers, in state order."""
        self._state.project_transposed(by_q, self._by_q_m)
        self._state.project_transposed(by_v, self._by_nu)
        self._by_linear[:] = 0.0
        if self._resists:
            self._of_stiffness += self._springs.stiffness
            self._of_damping += self._springs.damping

    def _turned_flux(self, q: Array) -> Array | None:
        """Return the magnetic flux density (3,) for a base in its neutral attitude.

        It is turned together with the base, from the attitude of the base in q. Return None without
        magnetorquers.
        """
        if not self._actuation.torquers:
            return None
        base = pin.XYZQUATToSE3(q[:7]).rotation
        root = self._model.jointPlacements[ROOT].rotation
        flux: Array = root @ (root @ base).T @ self._actuation.flux(self._state.t)
        return flux

    def _gyroscopic(
        self, q: Array, v: Array, wrenches: pin.StdVec_Force | None
    ) -> tuple[pin.StdVec_Force, Array, Array, Array]:
        r"""Return the gyroscopic torques :math:`h \times \omega` of wheels without inertia (6.3).

        The four results are:

        - the wrenches on all joints, to which the gyroscopic torques are added;
        - the generalised force (nv,) of the gyroscopic torques;
        - the derivatives (nv, nv) of this force with respect to q;
        - the derivatives (nv, nv) of this force with respect to v.

        The derivatives with respect to q exclude the change of the Jacobian, because the
        derivatives of RNEA with these wrenches already include it.
        """
        model = self._model
        data = self._data
        nv = len(v)
        # With the angular Jacobian J of a link in the axes of the link, the torque h x omega has
        # the generalised force J^T [h]x J v (6.3).
        if wrenches is None:
            wrenches = pin.StdVec_Force(model.njoints, pin.Force.Zero())
        force, by_q, by_v = np.zeros(nv), np.zeros((nv, nv)), np.zeros((nv, nv))
        pin.computeForwardKinematicsDerivatives(model, data, q, v, np.zeros(nv))
        for joint, momentum in self._stored:
            slopes = pin.getJointVelocityDerivatives(
                model, data, joint, pin.ReferenceFrame.LOCAL
            )
            turned, jacobian = (part[PIN_ANGULAR] for part in slopes)
            torque = momentum @ data.v[joint].angular
            wrenches[joint] += pin.Force(np.zeros(3), torque)
            force += jacobian.T @ torque
            by_q += jacobian.T @ momentum @ turned
            by_v += jacobian.T @ momentum @ jacobian
        return wrenches, force, by_q, by_v
