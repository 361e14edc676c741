"""The inputs that hold a robot in equilibrium."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import EquilibriumError, listed
from fflin.base.frozen import FrozenArrays
from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.names import ORBITAL, forces_of
from fflin.dynamics.orbital import field_of
from fflin.dynamics.state import Frame, StateMap
from fflin.linear.linearization import Linearizer
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fflin.linear.model import LinearModel

_EPS = float(np.finfo(float).eps)

# Largest share of the forces to be balanced that may be left over.
_TOLERANCE = 1e-9

# Round-off of M a and of the accelerations themselves, relative to the terms that they sum.
_ROUNDING = 1e3 * _EPS


@dataclass(frozen=True, eq=False)
class Equilibrium(FrozenArrays):
    """The inputs of least norm that hold a robot, and what they leave.

    Attributes
    ----------
    u : ndarray (nu,)
        Over the robot's inputs; takes the place of u in `linearize`.
    residual : ndarray (6 + n,)
        Generalised forces that are left, those on the base in base axes.
    input_names, input_units : tuple of str
        Of u.
    force_names, force_units : tuple of str
        Of the residual: tau_b, F_b, and tau_m of every joint.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", stiffness={"joint_1": 50.0})
    >>> held = fflin.equilibrium(robot, fflin.configuration(robot, {"joint_1": 0.2}))
    >>> round(float(held.u[6]), 6), held.input_names[6]
    (10.0, 'tau_m.joint_1')
    """

    u: Array
    residual: Array
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    force_names: tuple[str, ...]
    force_units: tuple[str, ...]

    def __str__(self) -> str:
        from fflin.base.tables import signals

        if not self.u.any():
            return "u: all zero"
        return signals("u", self.u, self.input_names, self.input_units)


def equilibrium(
    robot: Robot,
    q: Array | None = None,
    *,
    v: Array | None = None,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
) -> Equilibrium:
    r"""Find the inputs of least norm that balance all that acts on a robot at a point.

    Springs, gravity, dampers and the forces of a steady motion: whatever `linearize` knows of. In
    an orbit the pull of its field and the turning of its frame, in which the base rests; see
    `relative_equilibria` for attitudes that no torque on the base need hold.
    With f the generalised forces without u, the inputs solve

    .. math::
        \min \|u\|_2 \quad \text{subject to} \quad B(q)\,u = -f(q, v), \qquad
        u_k \ge 0 \text{ for every thruster } k.

    The norm is that of the numbers in u, each in its own unit. The rows of the balance, N m and
    N, are made comparable by the mobilities :math:`\sqrt{(M^{-1})_{ii}}`; so weighed, what is
    left must not exceed 1e-9 of what is balanced.

    Parameters
    ----------
    robot : Robot
    q : array_like (nq,), optional
        Configuration in Pinocchio's order; neutral by default.
    v : array_like (nv,), optional
        A steady motion, whose velocities in base axes do not change; at rest by default. Joints
        may move if they are rotors, see `LinearModel.ignorable`, and under gravity the base may
        turn about the vertical only.
    frame : {"hybrid", "local", "world", "lvlh", "hill"}, optional
        Axes of the inputs on the base, as in `linearize`.
    reference : pin.SE3, optional
        Placement whose axes are the reference axes, as in `linearize`; by default the base's
        own, so that in every frame the inputs on the base are in base axes, or in orbit its frame.

    Returns
    -------
    Equilibrium
        ``linearize(robot, q, v, u=result.u)`` with the same frame and reference.

    Raises
    ------
    EquilibriumError
        If no inputs balance it; names the forces that are left. Or if the motion cannot be
        steady under any inputs.
    InputError
        If a size is wrong or an entry is not a number.
    ChartError, SingularInertiaError
        As `linearize` does.

    Notes
    -----
    The bounds make it a least distance problem, which non-negative least squares solve exactly
    (C. Lawson and R. Hanson, Solving Least Squares Problems, 1974, chapter 23).

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", stiffness={"joint_1": 50.0})
    >>> q = fflin.configuration(robot, {"joint_1": 0.2})
    >>> u = fflin.equilibrium(robot, q).u
    >>> fflin.linearize(robot, q, u=u).is_equilibrium(1e-9)
    True
    """
    state = StateMap(robot, frame=frame, reference=reference)
    axes: Any = {"frame": frame, "reference": reference} if robot.orbit else {"moving": True}
    lin = Linearizer(robot, **axes, engine="python")(q, v)
    drift = lin.f0 if lin.drift is None else lin.drift
    _require_steady(lin, drift)
    actuation = Actuation(state)
    columns = actuation.columns(robot.create_data(), lin.q)

    M, acceleration = lin.M, drift[-len(lin.M) :]
    if robot.orbit:
        chart = state.chart(lin.q)
        M = state.to_base(chart, state.to_base(chart, M).T).T
        acceleration = state.to_base(chart, acceleration[:, None])[:, 0]
    mobility = np.sqrt(np.linalg.inv(M).diagonal())
    terms = np.abs(M) @ np.abs(acceleration)
    rounding, wanted = _rounding(robot, lin, M), -M @ acceleration
    wanted[np.abs(wanted) <= _ROUNDING * terms + rounding * bool(robot.orbit)] = 0.0
    one_sided = np.zeros(len(actuation.names), dtype=bool)
    one_sided[actuation.groups.get("thrust", [])] = True

    scaled, target = mobility[:, None] * columns, mobility * wanted
    u, left = _least_norm(scaled, target, one_sided)
    allowed = _TOLERANCE * float(np.linalg.norm(target))
    allowed += float(np.linalg.norm(mobility * rounding))
    pushes = forces_of(robot)
    residual = left / mobility
    if float(np.linalg.norm(left)) > allowed:
        raise _unbalanced(robot, residual, np.abs(left), pushes)
    if reference is not None or robot.orbit:
        chart = state.chart(lin.q)
        for held, _ in actuation.held:
            u[held] = chart.R @ u[held]
    units = tuple(pushes.values())
    return Equilibrium(u, residual, actuation.names, actuation.units, tuple(pushes), units)


def _require_steady(lin: LinearModel, drift: Array) -> None:
    """Refuse a motion in which something moves that the forces depend on."""
    moving = [
        f"{name} at {rate:.3g} {unit}/s"
        for name, unit, rate in zip(lin.state_names, lin.state_units, drift.tolist(), strict=True)
        if rate and name.startswith("q_m.") and name not in lin.ignorable
    ]
    if moving:
        raise EquilibriumError(
            f"no input keeps '{lin.robot}' as it is while it moves: {listed(moving)}; only rotors "
            "may, which are symmetric about their axis and have nothing fixed on them"
        )
    if lin.frame in ORBITAL:
        if np.abs(drift[:6]).max() > _TOLERANCE:
            raise EquilibriumError(
                f"no input keeps '{lin.robot}' as it is while its base moves in the orbit's frame; "
                "leave the velocity of the base out"
            )
    elif "q_b.x" not in lin.ignorable and np.abs(drift[:3]).max() > _TOLERANCE:
        raise EquilibriumError(
            f"no input keeps '{lin.robot}' as it is while it turns across gravity; it may turn "
            "about the vertical only"
        )


def _rounding(robot: Robot, lin: LinearModel, M: Array) -> Array:
    """Return how much of the forces (6 + n,) may be the rounding of terms that cancel."""
    state = StateMap(robot)
    field = field_of(robot, lin.frame)
    speed = np.abs(state.velocities(field.absolute(lin.q, lin.v) if field else lin.v))
    rate = max(float(speed[:3].max()), float(speed[6:].max(initial=0.0)))
    terms = rate * (np.abs(M) @ speed)
    stiffness, _, rest = robot.springs
    terms[6:] += stiffness * (np.abs(state.joint_positions(lin.q)) + np.abs(rest))
    return _ROUNDING * terms


def _least_norm(C: Array, d: Array, one_sided: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the least u with ``C u = d``, ``u[one_sided] >= 0``, and ``C u - d``."""
    u = _pseudo_solve(C, d)
    if (u[one_sided] < 0.0).any():
        u = _least_distance(C, u, one_sided)
        # Exactly the least on the face that was found: those that do not push stay out.
        pushing = ~one_sided | (u > _TOLERANCE * float(np.abs(u).max(initial=0.0)))
        polished: Array = np.zeros(len(u))
        polished[pushing] = _pseudo_solve(C[:, pushing], d)
        left = C @ polished - d
        most = _TOLERANCE * np.linalg.norm(d)
        if (polished[one_sided] < 0.0).any() or np.linalg.norm(left) > most:
            polished = _least_residual(C, d, one_sided)
        u = polished
    return u, C @ u - d


def _pseudo_solve(C: Array, d: Array) -> Array:
    """Return the u of least norm among those with the least ``|C u - d|``."""
    u: Array = np.linalg.lstsq(C, d, rcond=None)[0]
    u += np.linalg.lstsq(C, d - C @ u, rcond=None)[0]
    # An input below the rounding of the largest one is noise: it counts as zero.
    u[np.abs(u) <= 16.0 * _EPS * float(np.abs(u).max(initial=0.0))] = 0.0
    return u


def _least_distance(C: Array, start: Array, one_sided: NDArray[np.bool_]) -> Array:
    """Return the least u = start + Z z with u[one_sided] >= 0, where C Z = 0."""
    from scipy.linalg import null_space
    from scipy.optimize import nnls

    # min |z| subject to G z >= h is solved by the residual r = E y - e of min |E y - e|, y >= 0,
    # with E = [G^T; h^T] and e = (0, ..., 0, 1): z = -r_z / r_e.
    Z = null_space(C)
    size = float(np.linalg.norm(start))
    E = np.vstack((Z[one_sided].T, -start[one_sided] / size))
    e = np.zeros(len(E))
    e[-1] = 1.0
    y = nnls(E, e, maxiter=100 * max(E.shape))[0]
    r = E @ y - e
    # r_e = -|r|^2, and zero where the inequalities contradict each other.
    z = -r[:-1] / r[-1] if r[-1] < -_TOLERANCE else np.zeros(Z.shape[1])
    u: Array = start + Z @ (size * z)
    return np.where(one_sided, np.maximum(u, 0.0), u)


def _least_residual(C: Array, d: Array, one_sided: NDArray[np.bool_]) -> Array:
    """Return a u with u[one_sided] >= 0 that leaves the least ``|C u - d|``."""
    from scipy.optimize import nnls

    both = np.hstack((C, -C[:, ~one_sided]))
    split = nnls(both, d, maxiter=100 * max(both.shape))[0]
    u: Array = split[: C.shape[1]]
    u[~one_sided] -= split[C.shape[1] :]
    return u


def _unbalanced(
    robot: Robot, residual: Array, sizes: Array, pushes: dict[str, str]
) -> EquilibriumError:
    """Name the forces that are left, those first that move the most."""
    named = list(pushes.items())
    left = [
        f"{named[i][0]} {residual[i]:.3g} {named[i][1]}"
        for i in np.argsort(-sizes)
        if sizes[i] > 1e-6 * sizes.max()
    ]
    return EquilibriumError(
        f"the inputs of '{robot.name}' cannot balance what acts on it here; left are "
        f"{listed(left)}; give it inputs that can (thrusters only push), or take another point"
    )
