"""Effective masses of the vibration modes of a robot whose base is fixed."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.linalg import block_diag

from fflin.analysis.mechanics import floating_inertia
from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.tables import counted, folded, grid
from fflin.base.validation import Array, FrozenArrays, instance
from fflin.dynamics.closure import Closure
from fflin.dynamics.coordinates import ANGULAR, LINEAR
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel

# Two frequencies count as equal if their relative difference is at most this.
_EQUAL = 1e-9

# In `_separated`, the squares of singular values are effective masses or moments of inertia. A
# square is a rounding error if it is at most this fraction of the sum over all modes. In the
# tables, a value is a rounding error if it is at most 100 times this fraction of the total.
_ROUNDING = 1e-14


@dataclass(frozen=True, eq=False, repr=False)
class EffectiveMasses(html.Reported, FrozenArrays):
    """Effective masses of the vibration modes with the base clamped; ``print`` shows a table.

    All quantities refer to the origin of the base frame and are expressed in its axes. Entries for
    translation come before entries for rotation.

    Attributes
    ----------
    frequencies : ndarray (k,)
        Natural frequencies [rad/s] of the clamped modes, ascending.
    participation : ndarray (6, k)
        Modal participation factors L for unit modal mass; rows 0 to 2 [kg^1/2], rows 3 to 5
        [kg^1/2 m].
    free : ndarray (6, 6)
        Part of the rigid robot's inertia that the base does not feel, because joints without a
        spring do not transmit it.
    residual : ndarray (6, 6)
        Apparent inertia of the base if all joints are free to move.
    total : ndarray (6, 6)
        Inertia of the rigid robot: the sum of `free`, `residual` and the contributions of all
        modes.
    robot : str
        Name of the robot.

    Examples
    --------
    >>> springs = {"panel_left": 100.0, "panel_right": 90.0}  # N m/rad
    >>> robot = fflin.load("servicer_7dof", stiffness=springs)
    >>> found = fflin.effective_masses(fflin.linearize(robot))
    >>> found.frequencies.round(2), found.masses.shape
    (array([0.83, 0.87]), (2, 3))
    """

    frequencies: Array
    participation: Array
    free: Array
    residual: Array
    total: Array
    robot: str

    @property
    def masses(self) -> Array:
        """Effective masses (k, 3) along x, y and z [kg]."""
        return self.participation[:3].T ** 2

    @property
    def inertias(self) -> Array:
        """Effective moments of inertia (k, 3) about x, y and z [kg m^2]."""
        return self.participation[3:].T ** 2

    def __str__(self) -> str:
        """Show a table of effective masses and a table of moments of inertia, with percentages."""
        head = (
            f"{self.robot}, base clamped: {counted(len(self.frequencies), 'mode')}; effective "
            "masses and moments of inertia about the origin of the base frame, in base axes"
        )
        parts = [folded([head])]
        for values, unit, at in ((self.masses, "kg", 0), (self.inertias, "kg m^2", 3)):
            others = dict[str, Array]()
            if self.free.any():
                others["free joints"] = self.free
            others |= {"residual": self.residual, "total": self.total}
            total = self.total.diagonal()[at : at + 3]
            titles = [title for axis in "xyz" for title in (f"{axis} [{unit}]", "%")]
            rows = [["rad/s", *titles]]
            for w, mode in zip(self.frequencies, values, strict=True):
                rows.append([f"{w:.6g}", *_cells(mode, total)])
            for name, matrix in others.items():
                rows.append([name, *_cells(matrix.diagonal()[at : at + 3], total)])
            parts.append(grid(rows, "r"))
        return "\n\n".join(parts)


def effective_masses(lin: LinearModel) -> EffectiveMasses:
    r"""Return the effective masses of a robot's vibration modes with its base clamped.

    Let K be the stiffness of the joint springs, and M the mass matrix in base axes with the
    subscripts b for the base and m for the joints. Joints without a spring are condensed out of M,
    which gives :math:`\tilde M`. With the base at rest, the frequencies, shapes and participation
    factors of the modes follow from

    .. math::
        K \phi_i = \omega_i^2 \tilde M_{mm} \phi_i, \qquad \phi_i^T \tilde M_{mm} \phi_i = 1,
        \qquad L_i = \tilde M_{bm} \phi_i.

    If the base is accelerated along axis d, mode i exerts the same force on the base as a single
    mass :math:`L_{di}^2` [kg] on a spring. This mass is the effective mass of mode i. For rotation
    about d, :math:`L_{di}^2` is the effective moment of inertia [kg m^2]. The contributions of all
    modes, the joints without springs (free) and the residual add up to the inertia of the rigid
    robot:

    .. math::
        \textstyle\sum_i L_i L_i^T + M_{free} + M_{res} = M_{bb}, \qquad
        M_{res} = M_{bb} - M_{bm} M_{mm}^{-1} M_{mb}.

    The natural frequencies with the base clamped are lower than with a free base, for which `modes`
    computes them. If several modes have the same frequency, only the sum of their effective masses
    is unique, so the first of these modes is given the largest possible mass.

    Parameters
    ----------
    lin : LinearModel
        Full model about any operating point. Only the springs, the configuration and constraints
        within the robot affect the result: velocity, gravity, dampers and inputs are ignored.

    Returns
    -------
    EffectiveMasses
        Frequencies, participation factors and the parts of the inertia.

    Raises
    ------
    InputError
        If the model lacks the robot's springs because it is reduced or was loaded from a file, or
        the robot is held in inertial space.
    ModelError
        If the robot's Pinocchio model (``robot.model``) was modified after the robot was created.

    References
    ----------
    A. Girard and N. Roy, Structural Dynamics in Industry, 2008, chapter 5.

    Examples
    --------
    >>> robot = fflin.load("servicer_7dof", stiffness={"panel_left": 100.0, "panel_right": 100.0})
    >>> found = fflin.effective_masses(fflin.linearize(robot))
    >>> parts = found.participation @ found.participation.T + found.free + found.residual
    >>> bool(abs(parts - found.total).max() < 1e-9)
    True
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    lin.require_unchanged()
    robot = lin._robot
    if robot is None or len(lin.M) + lin.rank != 6 + robot.n:
        raise InputError(
            "effective masses need the springs of the robot, which a reduced model and a model "
            "from a file do not contain; give the model that fflin.linearize returns"
        )
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    stiffness = robot.springs.stiffness
    if lin.rank:
        M, stiffness = _constrained(state, lin.q)
    else:
        chart = state.chart(lin.q)
        M = state.to_base(chart, state.to_base(chart, lin.M).T)
    order = np.arange(len(M))
    order[:6] = np.r_[order[LINEAR], order[ANGULAR]]
    M = M[np.ix_(order, order)]
    springs = 6 + np.flatnonzero(stiffness)
    others = 6 + np.flatnonzero(stiffness == 0.0)
    kept = np.r_[:6, springs]
    floating = floating_inertia(M, kept, others)
    base, joints = np.arange(6), np.arange(6, len(kept))
    # The joint coordinates are scaled so that K is the identity. Low frequencies then keep their
    # full relative accuracy.
    soft = 1.0 / np.sqrt(stiffness[springs - 6])
    M_mm = floating[6:, 6:] * np.outer(soft, soft)
    squares, vectors = np.linalg.eigh((M_mm + M_mm.T) / 2.0)
    squares, vectors = squares[::-1], vectors[:, ::-1]
    frequencies = 1.0 / np.sqrt(squares)
    return EffectiveMasses(
        frequencies,
        _separated(frequencies, floating[:6, 6:] * soft @ vectors * frequencies),
        M[:6, :6] - floating[:6, :6],
        floating_inertia(floating, base, joints),
        M[:6, :6],
        lin.robot,
    )


def _constrained(state: StateMap, q: Array) -> tuple[Array, Array]:
    """Return M and the stiffnesses of a robot with constraints, in coordinates without coupling.

    The coordinates after the six of the base are motions of the joints that the constraints permit.
    They have unit inertia, and K is diagonal in them.
    """
    robot = state.robot
    if robot.anchored:
        raise InputError(
            f"effective masses are defined for a base that is free to move, but '{robot.name}' is "
            "held in inertial space; remove this constraint"
        )
    M = state.project(pin.crba(robot.model, robot.create_data(), q).T)
    rows = Closure(state).tangent(q).rows[:, 6:]
    scale = 1.0 / np.sqrt(M.diagonal()[6:])
    _, _, motions = np.linalg.svd(rows * scale)
    joints = scale[:, None] * motions[len(rows) :].T
    factor = np.linalg.cholesky(joints.T @ M[6:, 6:] @ joints)
    joints = np.linalg.solve(factor, joints.T).T
    springs = np.sqrt(robot.springs.stiffness)[:, None] * joints
    _, sizes, turned = np.linalg.svd(springs)
    joints = joints @ turned.T
    stiffness = np.zeros(joints.shape[1])
    stiffness[: len(sizes)] = sizes**2
    stiffness[stiffness <= _ROUNDING * stiffness.max(initial=0.0)] = 0.0
    basis = block_diag(np.eye(6), joints)
    return basis.T @ M @ basis, stiffness


def _separated(frequencies: Array, L: Array) -> Array:
    """Combine modes of equal frequency so that the first has the largest effective mass.

    The columns of L (6, k) are the participation factors of the modes.
    """
    L = L.copy()
    first = 0
    while first < len(frequencies):
        near = frequencies <= (1.0 + _EQUAL) * frequencies[first]
        last = int(np.count_nonzero(near))
        group = L[:, first:last]
        # Combine the modes so that as few of them as possible have effective mass. Then combine the
        # modes without effective mass so that as few of them as possible have an effective moment
        # of inertia.
        for rows in (slice(0, 3), slice(3, 6)):
            _, sizes, turned = np.linalg.svd(group[rows])
            group[:] = group @ turned.T
            heavy = np.count_nonzero(sizes**2 > _ROUNDING * (L[rows] ** 2).sum())
            group = group[:, heavy:]
        first = last
    return L


def _cells(values: Array, total: Array) -> list[str]:
    """Format each value and its percentage of the total, or two dots for a rounding error."""
    cells = []
    for value, whole in zip(values.tolist(), total.tolist(), strict=True):
        if abs(value) > 1e2 * _ROUNDING * whole:
            cells += [f"{value:.4g}", f"{100.0 * value / whole:.1f}"]
        else:
            cells += [".", "."]
    return cells
