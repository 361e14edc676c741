"""Inertia M and M^-1, accelerations, and their derivatives by RNEA."""

import warnings
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, SingularInertiaError, listed
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.coordinates import ANGULAR, LINEAR, PIN_ANGULAR
from fflin.dynamics.orbital import GravityGradient
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.joints import ROOT
from fflin.robot.mass_properties import coordinate_names

# The coupling of a coordinate i is M_ii (M^-1)_ii. It is 1 for a decoupled coordinate. If all other
# coordinates are free, i has the inertia 1 / (M^-1)_ii. The smaller this inertia is relative to
# M_ii, the larger is the coupling. Coupling times machine epsilon is the relative error of
# (M^-1)_ii. If the sum of all couplings exceeds WARNING_COUPLING, M^-1 has fewer than nine correct
# digits; above _LARGEST_COUPLING fewer than two. Exact couplings are at least 1, so a sum below the
# number of coordinates shows that some pivots are only rounding errors.
_EPS = float(np.finfo(float).eps)
WARNING_COUPLING, _LARGEST_COUPLING = 1e-9 / _EPS, 1e-2 / _EPS

# Pinocchio's articulated-body inverse sums inertias about the base's origin. With `inertia_bounds`
# in place of M_ii, the couplings bound the rounding errors of this inverse. If their sum exceeds
# this limit, a Cholesky factor of M is used instead.
_QUICK_COUPLING = 1e-11 / _EPS

STROKE = 1.0  # [m] largest displacement of a prismatic joint for which `inertia_bounds` holds

# If M has more rows than this, LAPACK is faster than a sparse factor.
_DENSE_SIZE = 64


# Looked up once, because looking up a name in a module takes as long as factorising a small
# matrix.
_crba, _compute_inverse, _cholesky = pin.crba, pin.computeMinverse, pin.cholesky


class Inertia:
    """M^-1 at a configuration, in base axes and state order."""

    def __init__(self, state: StateMap, data: pin.Data) -> None:
        robot = state.robot
        self._state, self._model, self._data = state, robot.model, data
        # Views of an array that Pinocchio overwrites in place.
        self._inverse = data.Minv
        self._inverse_diagonal = self._inverse.diagonal()
        # If v is not a permutation of nu (mimic joints, modes), M is factorised as a dense matrix.
        self._constrained = state.S is not None
        simple = not (robot.followers or robot.modes)
        self._bounds = inertia_bounds(robot.model) if simple else None
        self._slides = [*map(attrgetter("idx_q"), filter(attrgetter("prismatic"), robot.joints))]
        # M does not depend on the base's pose. The base is placed at the origin because Pinocchio
        # works in world axes, and would lose digits if the base were far away.
        self._still = pin.neutral(robot.model)
        self.least_coupling = 0.999 * (6 + robot.n)

    def centred(self, q: Array) -> Array:
        """Return q with the base at the origin, in an array that the next call overwrites."""
        if q is not self._still:
            self._still[7:] = q[7:]
        return self._still

    def invert(self, q: Array, out: Array, *, quick: bool = False) -> None:
        """Write M^-1 (6 + n, 6 + n) at a valid configuration into a C-contiguous array."""
        still = self.centred(q)
        # The articulated-body inverse is used only if `quick`. Its rounding errors would appear in
        # entries of M^-1 K that should be exactly zero. The relative rounding errors of a Cholesky
        # factor do not depend on the scaling of M.
        bounds = self._bounds if quick else None
        if bounds is not None and (
            not self._slides or np.abs(still.take(self._slides)).max() <= STROKE
        ):
            _compute_inverse(self._model, self._data, still)
            self._state.project(self._inverse, out)
            # A zero pivot gives NaN, which makes this comparison false.
            if self.least_coupling < bounds.dot(self._inverse_diagonal) < _QUICK_COUPLING:
                return
        upper = _crba(self._model, self._data, still)
        if self._constrained or len(upper) > _DENSE_SIZE:
            M = self._state.project(upper.T)
            _invert_dense(M, out)
            coupling = M.diagonal().dot(out.diagonal())
        else:
            _cholesky.decompose(self._model, self._data)
            inverse = _cholesky.computeMinv(self._model, self._data)
            self._state.project(inverse, out)
            coupling = upper.diagonal().dot(inverse.diagonal())
        # A zero pivot gives NaN, which this condition also reports.
        if not self.least_coupling < coupling < WARNING_COUPLING:
            self._judge(coupling, self._state.project(upper.T))

    def _judge(self, coupling: float, M: Array) -> None:
        """Raise an error for a singular M, or warn of an ill-conditioned M, naming coordinates."""
        name, scale = self._state.robot.name, np.sqrt(np.maximum(M.diagonal(), 0.0))
        scale[scale == 0.0] = 1.0
        lost = not self.least_coupling < coupling < _LARGEST_COUPLING  # true for NaN as well
        mode = np.linalg.eigh(M / scale / scale[:, None])[1][:, 0]
        names = coordinate_names(self._state.robot)
        involved = listed([names[i] for i in np.argsort(-np.abs(mode)) if abs(mode[i]) > 0.1])
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

    factor, failed = dpotrf(M)
    upper = np.full_like(M, np.nan) if failed else dpotri(factor)[0]  # zero below its diagonal
    np.add(upper, upper.T, out=out)
    out.flat[:: len(M) + 1] *= 0.5


def inertia_bounds(model: pin.Model) -> Array | None:
    """Return upper bounds of the mass or moment of inertia that each coordinate moves.

    Return None if a joint is neither revolute nor prismatic.
    """
    # The moment of inertia of a body about the base's origin has an upper bound. It is the body's
    # largest principal moment, plus its mass times the squared length of the path to it. The path
    # runs from joint to joint, and includes a displacement of `STROKE` at each prismatic joint.
    joints, parents = model.joints.tolist(), model.parents.tolist()
    kinds = ["", "", *(joint.shortname()[:11] for joint in joints[ROOT + 1 :])]
    if not {*kinds} <= {"", "JointModelR", "JointModelP"}:
        return None
    distances, masses, moments = ([0.0] * len(joints) for _ in range(3))
    for index, item in enumerate(model.inertias.tolist()):
        if index > ROOT:
            step = float(np.linalg.norm(model.jointPlacements[index].translation))
            step += STROKE if kinds[index] == "JointModelP" else 0.0
            distances[index] = distances[parents[index]] + step
        masses[index] = item.mass
        # The largest row sum of an inertia matrix is a bound of its largest principal moment.
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


class AccelerationDerivatives(NamedTuple):
    """Accelerations of the base origin and the joints, in base axes, and their derivatives.

    The arrays have leading axes if there are several points.
    """

    c: Array  # (.., 6 + n) of (3.1): without gravity and omega x v_b
    slopes: Array  # (.., 6 + n, 12 + 2 n) over displacements of the state in base axes
    by_u: Array  # D_u (.., 6 + n, nu) of (3.3), u in base axes
    gravity: Array  # (.., 3) in base axes

    @property
    def by_turn(self) -> Array:
        """Derivatives (.., 6 + n, 3) over a rotation of the base: zero except in orbit (14.5)."""
        return self.slopes[..., :3]

    @property
    def by_q_m(self) -> Array:
        """D_m (.., 6 + n, n) of (3.3)."""
        return self.slopes[..., 6 : self.c.shape[-1]]

    @property
    def by_nu(self) -> Array:
        """D_nu (.., 6 + n, 6 + n) of (3.3), zero over the base's linear velocity."""
        return self.slopes[..., self.c.shape[-1] :]


class Accelerations:
    """Solution of ``M nudot + b = B u`` of a robot, with its derivatives, in base axes."""

    def __init__(self, state: StateMap, actuation: Actuation, data: pin.Data) -> None:
        robot = state.robot
        self._state, self._actuation, self._data = state, actuation, data
        self._model, self._nv = robot.model, 6 + robot.n
        self.inertia = Inertia(state, data)
        self._springs = robot.springs
        self._resists = bool(np.any(robot.springs))
        # Derivatives of M a + b - B u - springs over the displacements of the state. They are
        # stored transposed, so that their parts are contiguous. The first six rows, for attitude
        # and position of the base, are zero without an orbit.
        rows = np.zeros((2 * self._nv, self._nv))
        self._force_slopes = rows.T
        self._by_turn, self._by_q_m, self._by_nu = rows[:3], rows[6 : self._nv], rows[self._nv :]
        self._by_linear = self._by_nu[LINEAR]
        # Views of the diagonals to which stiffness and damping are added.
        self._of_stiffness = np.einsum("ii->i", self._by_q_m[:, 6:])
        self._of_damping = np.einsum("ii->i", self._by_nu[6:, 6:])
        self._minus_inverse = np.empty((self._nv, self._nv))
        self._stored = [(mounted, skew(momentum)) for mounted, momentum in robot.stored_momentum]
        self._field = state.field
        self._still = np.zeros(robot.nv)

    def rates(
        self, q: Array, v: Array, nu: Array, u: Array, slopes: Array, by_u: Array
    ) -> AccelerationDerivatives:
        """Return the accelerations and their derivatives at q, v and u in base axes.

        `nu` is v in state order. The derivatives are written into the C-contiguous arrays `slopes`
        and `by_u`.
        """
        model, data, state, actuation = self._model, self._data, self._state, self._actuation
        tide = self._field and GravityGradient.at(self._field, q)
        # The base's placement and linear velocity are left out, because c does not depend on them
        # in base axes. Large values would also make Pinocchio's derivatives less accurate. Gravity
        # is left out as well, because it accelerates all parts of the robot alike (equivalence
        # principle).
        q_still, v_still = self.inertia.centred(q), self._still
        v_still[3:] = v[3:]
        if tide:
            v_still[PIN_ANGULAR] += tide.spin
            pull, pull_by_q, pull_by_turn = tide.force(model, data, q_still)
        inverse = by_u if actuation.default else np.empty((self._nv, self._nv))
        self.inertia.invert(q_still, inverse, quick=not self._resists)
        columns = actuation.columns(data, q_still)
        bias = pin.nonLinearEffects(model, data, q_still, v_still)
        wrenches = actuation.wrenches(u)
        if self._stored:
            wrenches, turning, turning_by_q, turning_by_v = self._gyroscopic(
                q_still, v_still, wrenches
            )
            bias = bias - turning
        if tide:
            bias = bias - pull
        force = (u if actuation.default else columns.dot(u)) - state.forces(bias)
        if self._resists:
            force[6:] += self._springs.force(state.joint_positions(q), nu[6:])
        c = inverse.dot(force)

        # Derivatives of M a + b - B u - springs (3.3), (7.1). The wrenches are constant in the
        # frames of their links, so RNEA's derivatives include -d(B u)/dq.
        external = () if wrenches is None else (wrenches,)
        by_q, by_v, _ = pin.computeRNEADerivatives(
            model, data, q_still, v_still, state.spread(c), *external
        )
        if self._stored:
            by_q, by_v = by_q - turning_by_q, by_v - turning_by_v
        if tide:
            by_q = by_q - pull_by_q
        state.project_transposed(by_q, self._by_q_m)
        state.project_transposed(by_v, self._by_nu)
        self._by_linear[:] = 0.0
        if self._resists:
            self._of_stiffness += self._springs.stiffness
            self._of_damping += self._springs.damping
        if tide:
            by_spin = self._by_nu[ANGULAR].T.dot(skew(tide.spin))
            self._by_turn[:] = (by_spin - state.forces(pull_by_turn)).T
        np.negative(inverse, self._minus_inverse).dot(self._force_slopes, slopes)
        if not actuation.default:
            inverse.dot(columns, by_u)
        return AccelerationDerivatives(c, slopes, by_u, tide.fall if tide else state.gravity(q))

    def _gyroscopic(
        self, q: Array, v: Array, wrenches: pin.StdVec_Force | None
    ) -> tuple[pin.StdVec_Force, Array, Array, Array]:
        r"""Return the gyroscopic torques :math:`-\omega \times h` of stored momentum.

        Return four results: the wrenches on all joints, with the gyroscopic torques added; the
        torques as a generalised force (nv,); and its derivatives (nv, nv) over q and over v. The
        derivative over q excludes the change of the Jacobian, because RNEA's derivatives with these
        wrenches already include it.
        """
        model, data, nv = self._model, self._data, len(v)
        # Let J be the angular Jacobian of a link, in the axes of the link. The torque h x omega
        # then gives the generalised force J^T [h]x J v (6.3).
        if wrenches is None:
            wrenches = pin.StdVec_Force(model.njoints, pin.Force.Zero())
        force, by_q, by_v = np.zeros(nv), np.zeros((nv, nv)), np.zeros((nv, nv))
        pin.computeForwardKinematicsDerivatives(model, data, q, v, np.zeros(nv))
        for joint, momentum in self._stored:
            slopes = pin.getJointVelocityDerivatives(model, data, joint, pin.ReferenceFrame.LOCAL)
            turned, jacobian = (part[PIN_ANGULAR] for part in slopes)
            torque = momentum @ data.v[joint].angular
            wrenches[joint] += pin.Force(np.zeros(3), torque)
            force += jacobian.T @ torque
            by_q += jacobian.T @ momentum @ turned
            by_v += jacobian.T @ momentum @ jacobian
        return wrenches, force, by_q, by_v
