"""The joint-space inertia M in state order, and its inverse."""

import numpy as np
import pinocchio as pin

from fflin.errors import SingularInertiaError
from fflin.linear_model import LinearModel
from fflin.model import Robot
from fflin.state import StateMap
from fflin.validation import Array

# M_ii (M^-1)_ii is 1 for a decoupled coordinate and grows as it loses inertia of its own; times
# the rounding unit it is the relative error of (M^-1)_ii. Where the sum over the coordinates
# passes this, less than two digits of M^-1 are left.
_LARGEST_COUPLING = 1e-2 / float(np.finfo(float).eps)

# Bound once: the look-up of a name in a module costs as much as a small matrix.
_crba, _decompose, _compute_inverse = (
    pin.crba,
    pin.cholesky.decompose,
    pin.cholesky.computeMinv,
)


class Inertia:
    """M at a configuration, by CRBA, and M^-1, by the sparse Cholesky factor of M.

    Base axes: angular, linear, joints. Scaling M by its diagonal before it is factored would
    gain nothing, since the rounding of a Cholesky factorisation is invariant under it.

    Parameters
    ----------
    state : StateMap
        Order of the coordinates.
    data : pin.Data
        Work space, overwritten at each call.
    """

    def __init__(self, state: StateMap, data: pin.Data) -> None:
        self._state = state
        self._data = data
        self._model = state.robot.model
        # A view, since Pinocchio overwrites M in place; transposed, it is C-contiguous.
        self._M = data.M.T
        self._diagonal = self._M.diagonal()
        self._constrained = bool(state.robot.followers)

    def invert(self, q: Array, out: Array) -> None:
        """Write M^-1 (6 + n, 6 + n) at a valid configuration into a C-contiguous array.

        Raises
        ------
        SingularInertiaError
            If a joint moves no mass, named.
        """
        model, data = self._model, self._data
        _crba(model, data, q)
        if self._constrained:
            self._invert_projected(out)
            return
        _decompose(model, data)
        inverse = _compute_inverse(model, data)
        # Written so that NaN, from a pivot that is zero or negative, fails too.
        if not self._diagonal.dot(inverse.diagonal()) < _LARGEST_COUPLING:
            raise _singular(self._state, self._state.project(self._M))
        self._state.project(inverse, out)

    def _invert_projected(self, out: Array) -> None:
        """Invert S^T M S, which is dense, where joints mimic others."""
        from scipy.linalg.lapack import dpotrf, dpotri

        M = self._state.project(self._M)
        factor, failed = dpotrf(M)
        upper = np.full_like(M, np.nan) if failed else dpotri(factor)[0]
        np.copyto(out, np.triu(upper) + np.triu(upper, 1).T)
        if not M.diagonal().dot(out.diagonal()) < _LARGEST_COUPLING:
            raise _singular(self._state, M)


def inertia_matrix(robot: Robot, lin: LinearModel) -> Array:
    """Return M (6 + n, 6 + n) of a linear model, in state order and in the frame's axes."""
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    M = state.project(pin.crba(robot.model, robot.create_data(), lin.q).T)
    chart = state.chart(lin.q)
    state.to_frame(chart, M)
    state.to_frame(chart, M.T)
    M.setflags(write=False)
    return M


def _singular(state: StateMap, M: Array) -> SingularInertiaError:
    robot = state.robot
    names = ["the base"] * 6 + [f"joint '{name}'" for name in robot.joint_names]
    diagonal = M.diagonal()
    massless = [names[i] for i in np.flatnonzero(~(diagonal > 0.0))]
    if massless:
        verb = "moves" if len(set(massless)) == 1 else "move"
        return SingularInertiaError(
            f"M of '{robot.name}' cannot be inverted: {_enumerate(massless)} {verb} no mass; "
            "give the links beyond an inertia, or lock what needs none"
        )
    scale = 1.0 / np.sqrt(diagonal)
    mode = np.linalg.eigh(scale[:, None] * M * scale)[1][:, 0]
    involved = [names[i] for i in np.argsort(-np.abs(mode)) if abs(mode[i]) > 0.1]
    return SingularInertiaError(
        f"M of '{robot.name}' is singular at this configuration: {_enumerate(involved)} can move "
        "together without moving mass; choose another configuration, give the links an inertia, "
        "or lock one of them"
    )


def _enumerate(names: list[str]) -> str:
    names = list(dict.fromkeys(names))
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
