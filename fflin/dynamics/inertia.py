"""The joint-space inertia M in state order, and its inverse."""

import warnings

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, SingularInertiaError, listed
from fflin.base.validation import Array
from fflin.dynamics.inertia_bounds import STROKE, inertia_bounds
from fflin.dynamics.state import StateMap
from fflin.robot.massless import coordinate_names

# M_ii (M^-1)_ii is 1 for a decoupled coordinate, more for any other, and grows as a coordinate
# loses inertia of its own; times the rounding unit it is the relative error of (M^-1)_ii. Of the
# sum over the coordinates: beyond the second figure less than two digits of M^-1 are left, beyond
# the first less than nine, and a sum below their number comes of pivots that are round-off.
_EPS = float(np.finfo(float).eps)
_WARNING_COUPLING, _LARGEST_COUPLING = 1e-9 / _EPS, 1e-2 / _EPS

# The same with the moments about the base's origin, where Pinocchio's articulated bodies are
# added up, bounds their rounding; up to here they are taken, beyond it a factor of M.
_QUICK_COUPLING = 1e-11 / _EPS

# From this size on LAPACK is quicker than a sparse factor.
_DENSE_SIZE = 64

# Bound once: the look-up of a name in a module costs as much as a small matrix.
_crba, _decompose, _invert_factor, _compute_inverse = (
    pin.crba,
    pin.cholesky.decompose,
    pin.cholesky.computeMinv,
    pin.computeMinverse,
)


class Inertia:
    """M^-1 at a configuration, in base axes: angular, linear, joints.

    By Pinocchio's articulated bodies where these are sure to lose no digit that matters, else by
    a Cholesky factor of CRBA's M. Scaling M by its diagonal before it is factored would gain
    nothing, since the rounding of a Cholesky factorisation is invariant under it.

    Parameters
    ----------
    state : StateMap
        Order of the coordinates.
    data : pin.Data
        Work space, overwritten at each call.

    Attributes
    ----------
    least_coupling, warning_coupling : float
        Between these the sum of M_ii (M^-1)_ii lies where M^-1 is good.
    """

    warning_coupling = _WARNING_COUPLING

    def __init__(self, state: StateMap, data: pin.Data) -> None:
        self._state = state
        self._data = data
        self._model = state.robot.model
        # Views, since Pinocchio overwrites in place what they show.
        self._inverse = data.Minv
        self._inverse_diagonal = self._inverse.diagonal()
        self._constrained = bool(state.robot.followers)
        self._bounds = None if self._constrained else inertia_bounds(state.robot)
        self._slides = [joint.idx_q for joint in state.robot.joints if joint.prismatic]
        # The base at the world's origin: M does not depend on where it is, but Pinocchio works in
        # world axes and would lose digits to a base far away.
        self._still = pin.neutral(state.robot.model)
        self.least_coupling = 0.999 * (6 + state.robot.n)

    def invert(self, q: Array, out: Array, *, quick: bool = False) -> None:
        """Write M^-1 (6 + n, 6 + n) at a valid configuration into a C-contiguous array.

        By articulated bodies only where `quick` is asked for: their rounding, small as it is,
        takes from a slope M^-1 K the exactness of what M^-1 leaves alone.

        Raises
        ------
        SingularInertiaError
            If a joint moves no mass, named.
        """
        still = self._still
        still[7:] = q[7:]
        bounds = self._bounds if quick else None
        if bounds is not None and (not self._slides or self._within_stroke(still)):
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
            self._judge(coupling, self._state.project(upper.T))

    def _within_stroke(self, q: Array) -> bool:
        return all(abs(q[index]) <= STROKE for index in self._slides)

    def _judge(self, coupling: float, M: Array) -> None:
        # Written so that NaN, from a pivot that is zero, fails too.
        if not self.least_coupling < coupling < _LARGEST_COUPLING:
            raise _singular(self._state, M)
        if coupling > _WARNING_COUPLING:
            warnings.warn(
                f"M of '{self._state.robot.name}' is ill-conditioned: A and B have a relative "
                f"error of about {coupling * _EPS:.0e}; {_involved(self._state, M)} hardly move "
                "mass against each other",
                FflinWarning,
                stacklevel=6,
            )


def _invert_dense(M: Array, out: Array) -> None:
    from scipy.linalg.lapack import dpotrf, dpotri

    factor, failed = dpotrf(M)
    upper = np.full_like(M, np.nan) if failed else dpotri(factor)[0]  # zero below its diagonal
    np.add(upper, upper.T, out=out)
    out.flat[:: len(M) + 1] *= 0.5


def _singular(state: StateMap, M: Array) -> SingularInertiaError:
    return SingularInertiaError(
        f"M of '{state.robot.name}' is singular at this configuration: {_involved(state, M)} can "
        "move together without moving mass; choose another configuration, give the links an "
        "inertia, or lock one of them"
    )


def _involved(state: StateMap, M: Array) -> str:
    """Name the coordinates of the motion with the least inertia."""
    diagonal = M.diagonal()
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    mode = np.linalg.eigh(scale[:, None] * M * scale)[1][:, 0]
    names = coordinate_names(state.robot)
    return listed([names[i] for i in np.argsort(-np.abs(mode)) if abs(mode[i]) > 0.1])
