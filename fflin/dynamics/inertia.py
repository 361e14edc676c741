"""Joint-space inertia matrix M in state order, and its inverse."""

import warnings
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, SingularInertiaError, listed
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.state import StateMap
from fflin.robot.joints import Joint
from fflin.robot.model_checks import coordinate_names
from fflin.robot.robot import Robot

# The coupling of a coordinate, M_ii (M^-1)_ii, is 1 where it is decoupled and grows as it loses
# inertia of its own; times the rounding unit it is the relative error of (M^-1)_ii. Where the sum
# over all coordinates is beyond the first figure, fewer than nine digits of M^-1 are left; beyond
# the second, fewer than two. A sum below the number of coordinates comes from pivots that are
# round-off.
_EPS = float(np.finfo(float).eps)
_WARNING_COUPLING, _LARGEST_COUPLING = 1e-9 / _EPS, 1e-2 / _EPS

# The same with the moments about the base's origin, where Pinocchio's articulated bodies are
# added up, bounds their rounding; up to here they are taken, beyond it a factor of M.
_QUICK_COUPLING = 1e-11 / _EPS

# The same for each coordinate alone, from where on it has next to no inertia of its own: of robots
# that are described well it is below 1e6.
LARGEST_SHARE = 1e9

STROKE = 1.0  # [m] that a sliding joint is taken to be out at most, for those moments

# From this size on LAPACK is quicker than a sparse factor.
_DENSE_SIZE = 64

# Relative rounding error that numbers of a URDF leave of an exact symmetry.
_ASYMMETRY = 1e-12

# Bound once: the look-up of a name in a module costs as much as a small matrix.
_crba, _decompose, _invert_factor, _compute_inverse = (
    pin.crba,
    pin.cholesky.decompose,
    pin.cholesky.computeMinv,
    pin.computeMinverse,
)


class Inertia:
    """M^-1 at a configuration, in base axes: angular, linear, joints."""

    # Between this and `least_coupling` the sum of M_ii (M^-1)_ii lies where M^-1 is good.
    warning_coupling = _WARNING_COUPLING

    def __init__(self, state: StateMap, data: pin.Data) -> None:
        robot = state.robot
        self._state, self._model, self._data = state, robot.model, data
        # Views, since Pinocchio overwrites in place what they show.
        self._inverse = data.Minv
        self._inverse_diagonal = self._inverse.diagonal()
        # By a dense factor where v is no permutation of nu.
        self._constrained = state.S is not None
        self._bounds = bounds_of(robot)
        self._in_order = np.zeros(0) if self._bounds is None else state.velocities(self._bounds)
        self._slides = [
            joint.idx_q for joint in robot.joints if joint.prismatic and joint.kind != "modal"
        ]
        # The base at the world's origin: M does not depend on where it is, but Pinocchio works in
        # world axes and would lose digits to a base far away.
        self._still = pin.neutral(robot.model)
        self.least_coupling = 0.999 * (6 + robot.n)

    def invert(self, q: Array, out: Array, *, quick: bool = False) -> None:
        """Write M^-1 (6 + n, 6 + n) at a valid configuration into a C-contiguous array."""
        still = self._still
        still[7:] = q[7:]
        # By articulated bodies only where that is asked for: their rounding, small as it is, takes
        # from a slope M^-1 K the exactness of what M^-1 leaves alone. Else by a Cholesky factor,
        # whose rounding no scaling of M changes.
        bounds = self._bounds if quick else None
        if bounds is not None and (
            not self._slides or np.abs(still.take(self._slides)).max() <= STROKE
        ):
            _compute_inverse(self._model, self._data, still)
            self._state.project(self._inverse, out)
            # Written so that NaN, from a pivot that is zero, fails too.
            if self.least_coupling < bounds.dot(self._inverse_diagonal) < _QUICK_COUPLING:
                return
        upper = _crba(self._model, self._data, still)
        if self._constrained or len(upper) > _DENSE_SIZE:
            M = self._state.project(upper.T)
            _invert_dense(M, out)
            coupling = M.diagonal().dot(out.diagonal())
        else:
            _decompose(self._model, self._data)
            inverse = _invert_factor(self._model, self._data)
            self._state.project(inverse, out)
            coupling = upper.diagonal().dot(inverse.diagonal())
        # Written so that NaN, from a pivot that is zero, fails too.
        if not self.least_coupling < coupling < _WARNING_COUPLING:
            self._judge(coupling, self._state.project(upper.T), out)
        elif self._bounds is not None and not self._in_order.dot(out.diagonal()) < LARGEST_SHARE:
            self._name_the_lightest(1.0 / out.diagonal())

    def _name_the_lightest(self, inertias: Array) -> None:
        name, allowed = self._state.robot.name, self._in_order
        worst = int((inertias / allowed).argmin())
        warnings.warn(
            f"the mass matrix of '{name}': {coordinate_names(self._state.robot)[worst]} has an "
            "inertia of only "
            f"{inertias[worst]:.1e} in SI units; the mass and position of its links suggest up to "
            f"{allowed[worst]:.1e}. As a result, B has entries of {1.0 / inertias[worst]:.1e}. "
            "Give the links their inertia, check that joint positions are in metres, or lock the "
            "joint",
            FflinWarning,
            stacklevel=6,
        )

    def _judge(self, coupling: float, M: Array, inverse: Array) -> None:
        """Refuse a singular M, or warn of an ill-conditioned M, by coordinate names."""
        name, scale = self._state.robot.name, np.sqrt(np.maximum(M.diagonal(), 0.0))
        scale[scale == 0.0] = 1.0
        lost = not self.least_coupling < coupling < _LARGEST_COUPLING  # or NaN
        if lost:
            mode = np.linalg.eigh(M / scale / scale[:, None])[1][:, 0]
        else:  # the same by powers of the inverse, at a tenth of the price
            stretched = inverse * scale * scale[:, None]
            mode = stretched[int(stretched.diagonal().argmax())]
            for _ in range(20):
                mode = stretched @ mode
                mode /= np.linalg.norm(mode)
        names = coordinate_names(self._state.robot)
        involved = listed([names[i] for i in np.argsort(-np.abs(mode)) if abs(mode[i]) > 0.1])
        if lost:
            raise SingularInertiaError(
                f"the mass matrix of '{name}' is singular at this configuration: a motion of "
                f"{involved} moves no mass; choose another configuration, give the links an "
                "inertia, or lock one of the joints"
            )
        warnings.warn(
            f"the mass matrix of '{name}' is ill-conditioned, so that A and B have a relative "
            f"error of about {coupling * _EPS:.0e}: {involved} move almost no mass relative to "
            "each other; check the inertias of the links",
            FflinWarning,
            stacklevel=6,
        )


def _invert_dense(M: Array, out: Array) -> None:
    from scipy.linalg.lapack import dpotrf, dpotri

    factor, failed = dpotrf(M)
    upper = np.full_like(M, np.nan) if failed else dpotri(factor)[0]  # zero below its diagonal
    np.add(upper, upper.T, out=out)
    out.flat[:: len(M) + 1] *= 0.5


# Robots do not change, so each is bounded once.
_BOUNDS: WeakKeyDictionary[Robot, Array | None] = WeakKeyDictionary()


def bounds_of(robot: Robot) -> Array | None:
    """Return `inertia_bounds` of a robot; None also if it has mimic joints or modes."""
    if robot not in _BOUNDS:
        _BOUNDS[robot] = None if robot.followers or robot.modes else inertia_bounds(robot.model)
    return _BOUNDS[robot]


def inertia_bounds(model: pin.Model) -> Array | None:
    """Bound what each coordinate of a free flyer moves: its mass, or its moment."""
    # A body's moment about the base's origin is at most its largest principal moment and its mass
    # times the square of the way to it, from joint to joint, sliding ones being within `STROKE`.
    joints = model.joints.tolist()
    slides = [joint.shortname().startswith("JointModelP") for joint in joints]
    if not all(joint.shortname()[:11] in ("JointModelR", "JointModelP") for joint in joints[2:]):
        return None
    inertias, parents = model.inertias.tolist(), model.parents.tolist()
    places = model.jointPlacements.tolist()
    ways = [0.0] * len(joints)
    for index in range(2, len(joints)):
        step = float(np.linalg.norm(places[index].translation)) + STROKE * slides[index]
        ways[index] = ways[parents[index]] + step
    masses = [item.mass for item in inertias]
    moments = [
        # The largest sum of a row is no less than the largest principal moment.
        item.mass * (way + float(np.linalg.norm(item.lever))) ** 2
        + float(np.abs(item.inertia).sum(axis=0).max())
        for item, way in zip(inertias, ways, strict=True)
    ]
    bounds: Array = np.empty(model.nv)
    for index in range(len(joints) - 1, 1, -1):
        bounds[joints[index].idx_v] = masses[index] if slides[index] else moments[index]
        masses[parents[index]] += masses[index]
        moments[parents[index]] += moments[index]
    bounds[:3], bounds[3:6] = masses[1], moments[1]
    return bounds


def rotor_names(robot: Robot) -> tuple[str, ...]:
    """Return the names of rotors: symmetric joints that carry no other joint."""
    model = robot.model
    index_of = {joint.name: model.getJointId(joint.name) for joint in robot.joints}
    named = set(robot.used_frames)
    # What carries another joint, leads one, has a spring, or has something fixed on it.
    busy = set(model.parents.tolist())
    busy |= {index_of[follower.leader.name] for follower in robot.followers}
    busy |= {index_of[name] for name, stiffness in robot.stiffness.items() if stiffness}
    if named:
        busy |= {frame.parentJoint for frame in model.frames if frame.name in named}
    free = (joint for joint in robot.joints if index_of[joint.name] not in busy)
    return tuple(joint.name for joint in free if _is_symmetric(robot, joint, index_of[joint.name]))


def _is_symmetric(robot: Robot, joint: Joint, index: int) -> bool:
    """Return whether the body of a joint is symmetric about the joint axis."""
    if joint.prismatic:
        return False
    pin_joint = robot.model.joints[index]
    data = pin_joint.createData()
    pin_joint.calc(data, robot.neutral())
    linear, axis = np.split(np.asarray(data.S).ravel(), 2)
    if linear.any():  # a screw
        return False
    body, turn = robot.model.inertias[index], skew(axis)
    inertia = body.inertia
    uneven = float(np.abs(turn @ inertia - inertia @ turn).max())
    largest = float(np.abs(inertia).max())
    offset = body.mass * float(np.square(turn @ body.lever).sum())
    return uneven <= _ASYMMETRY * largest and offset <= _ASYMMETRY**2 * largest
