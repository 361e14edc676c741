"""Conversion of linear models between fflin and other tools, by (15.1) to (15.6)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.record import Design
from fflin.base.validation import Array, Vector, instance, number, shaped, vector
from fflin.dynamics.coordinates import Frame, refuse_constraints
from fflin.dynamics.integrators import held_exponential
from fflin.dynamics.state import StateMap
from fflin.linear.constrained_exchange import chosen, require_rest
from fflin.linear.fit import require_fit
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel, StateSpace, refuse_delayed
from fflin.linear.tool_coordinates import (
    STEPPING,
    Jacobians,
    ToolCoordinates,
    tool_coordinates,
)
from fflin.robot.robot import Robot

# An entry of A or B that is exactly zero stays zero if its change, divided by the largest entry, is
# less than this fraction.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False, repr=False)
class ToolModel(StateSpace, Design):
    r"""Linear model in another tool's coordinates, ``dx/dt = f0 + A (x - x0) + B (u - u0)``.

    The state x consists of the tool's q and v. If the tool's q is on a manifold (mujoco, pinocchio,
    crocoddyl, spart), x contains a tangent vector instead of q: the difference of q from the
    operating point, in the order of v.

    Attributes
    ----------
    tool, robot : str
        Names of the tool and the robot.
    A, B, C, D, f0, x0, u0, y0, dt, state_names, ..., output_units
        The same fields as in `LinearModel`, but in the tool's coordinates.
    T : ndarray (nx, 12 + 2n)
        Matrix from state deviations of the `LinearModel` to deviations of x.
    T_left : ndarray (12 + 2n, nx)
        Inverse of T. If x contains a quaternion of four entries or mimic joints, x has more entries
        than the state of the `LinearModel`, so `T_left` is only a left inverse.
    T_u : ndarray (nu, nu)
        Matrix from input deviations of the `LinearModel` to input deviations of the tool. For a
        gain K of the `LinearModel`, the gain in the tool's coordinates is ``T_u @ K @ T_left``.
    q, v : ndarray
        Configuration and velocity of the operating point in the tool's coordinates.
    reference : str
        "fixed", or "moving" if x is the deviation from a reference that moves through the
        operating point.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> spart = lin.to("spart")
    >>> K = spart.T_u @ fflin.lqr(lin).K @ spart.T_left  # the gain in its coordinates
    >>> K.shape, spart.state_names[:3], spart.reference
    ((9, 18), ('theta.x', 'theta.y', 'theta.z'), 'fixed')
    """

    tool: str
    robot: str
    T: Array
    T_left: Array
    T_u: Array
    q: Vector
    v: Vector
    reference: str


def transform(
    robot: Robot, lin: LinearModel, tool: str, *, dt: float | None = None
) -> ToolModel:
    r"""Return a linear model in the coordinates, order and axes of another tool.

    The deviations x and u of the linear model become x' = T x and u' = T_u u in the tool's
    coordinates, see `ToolModel`. About any operating point, at rest or in motion, the matrices are

    .. math:: A' = (T A + \dot T)\,T^+ + \ldots, \qquad B' = T B\,T_u^{-1}

    :math:`T^+` is the left inverse of T. The omitted terms account for inputs in other axes and for
    the length of a quaternion; (15.1) to (15.6) of docs/derivation.md give them in full.
    docs/guide/tools.md compares the conventions of the tools.

    If the robot has constraints, the state of the result contains as many of the tool's coordinates
    as are independent: the joints that the linear model contains, and coordinates of the base that
    determine the others. The default outputs are all coordinates of the tool.

    Parameters
    ----------
    robot : Robot
    lin : LinearModel
        Model of this robot about any operating point. If the model is in discrete time, so is the
        result.
    tool : {"drake", "mujoco", "pinocchio", "crocoddyl", "spart", "euler", "euler_rates"}
        Name of the tool, or of the attitude coordinates.
    dt : float, optional
        Time step [s]; only for "mujoco" and "crocoddyl". If `dt` is given, A and B are the
        discrete-time matrices that ``mjd_transitionFD`` returns for the Euler integrator, or Fx and
        Fu of Crocoddyl's ``IntegratedActionModelEuler``. If the robot has dampers, disable
        ``eulerdamp`` in MuJoCo, because its matrices otherwise differ.

    Returns
    -------
    ToolModel

    Raises
    ------
    InputError
        If one of these conditions is true:

        - the model and the robot have different states or inputs;
        - a discrete-time model was read from a file;
        - the robot has constraints, and `dt` is given or the point is not an equilibrium at rest;
        - `dt` is out of range or not allowed for this tool.
    UnknownNameError
        If the tool is unknown.
    ChartError
        If the tool uses Euler angles and their pitch is 90 deg.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> drake = fflin.transform(robot, lin, "drake")  # or lin.to("drake")
    >>> drake.A.shape, drake.state_names[:4]
    ((19, 19), ('quat.w', 'quat.x', 'quat.y', 'quat.z'))
    >>> bool(abs(drake.T_left @ drake.A @ drake.T - lin.A).max() < 1e-12)
    True
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel").require_unchanged()
    refuse_delayed(lin, f"the conversion to {tool}")
    require_fit(lin, robot, StateMap(robot, frame=lin.frame))
    sampled = lin.dt
    whole = lin.generator
    step = step_of(tool, dt)
    if whole is None or (step and sampled):
        raise InputError(
            "the model is sampled; transform its continuous-time model instead"
        )
    if robot.constraints:
        if step:
            raise InputError(
                f"the steps of {tool} do not support constraints; leave out dt, and call "
                "discretize of the linear model first"
            )
        return _constrained_model(robot, whole, tool, sampled)
    lin, (kind, source, to, rates) = whole, _jacobians_at(robot, whole, tool)
    A, B = transformed(source, to, lin.A, lin.B)
    (q, v), states = kind.vectors(lin.q, lin.v), kind.states()
    rate: Array = to.P @ rates
    position = np.zeros(len(v)) if kind.tangent else q
    x0 = np.concatenate((position, v))
    fields: dict[str, Any] = {"C": np.eye(len(A)), "D": np.zeros(B.shape), "y0": x0}
    outputs = states
    if lin.output_names != lin.state_names:
        D = lin.D @ np.linalg.inv(source.V)
        fields = {
            "C": (lin.C @ source.P + D @ (to.H - source.H)) @ to.left,
            "D": D @ to.V,
            "y0": lin.y0,
        }
        outputs = dict(zip(lin.output_names, lin.output_units, strict=True))
    if step:
        A, B, rate = euler_step(A, B, rate, step, tool)
    f0: Array = rate
    if lin.moving:
        f0 = 0.0 * rate
    if sampled:
        A, held = held_exponential(A, np.column_stack((B, f0)), sampled)
        B, f0 = held[:, :-1], held[:, -1]
    inputs = {kind.actuation.names[i]: kind.actuation.units[i] for i in kind.inputs}
    for signal, units in (("state", states), ("input", inputs), ("output", outputs)):
        fields |= {
            f"{signal}_names": tuple(units),
            f"{signal}_units": tuple(units.values()),
        }
    T_u = np.linalg.solve(to.V, source.V)
    about = "moving" if lin.moving else "fixed"
    fields |= {
        "q": q,
        "v": v,
        "T": to.P @ source.left,
        "T_left": source.P @ to.left,
        "T_u": T_u,
    }
    fields |= {
        "A": A,
        "B": B,
        "f0": f0,
        "x0": x0,
        "u0": T_u @ lin.u0,
        "dt": step or sampled,
    }
    return ToolModel(
        tool=tool, robot=lin.robot, reference=about, verified=lin.verified, **fields
    )


def _constrained_model(
    robot: Robot, lin: LinearModel, tool: str, sampled: float
) -> ToolModel:
    """Return the model of a robot with constraints in the coordinates of a tool.

    `lin` is in continuous time, and `sampled` is the sample time of the result [s], or 0.
    """
    require_rest(lin, tool)
    at_rest = np.zeros(6 + robot.n)
    kind, source, to = _jacobians_of(robot, lin, tool, at_rest)
    rows, S, W, by_state = chosen(lin, kind, source, to)
    back = np.linalg.inv(S)
    to_inputs = np.linalg.inv(source.V)
    B: Array = S @ lin.B @ to_inputs
    A: Array = S @ lin.A @ back + B @ by_state @ back
    B = B @ to.V
    (q, v), states = kind.vectors(lin.q, lin.v), kind.states()
    position: Array = np.zeros(len(v)) if kind.tangent else q
    x0: Array = np.concatenate((position, v))
    D = lin.D @ to_inputs
    C: Array = (lin.C + D @ by_state) @ back
    y0 = lin.y0
    outputs = dict(zip(lin.output_names, lin.output_units, strict=True))
    if lin.output_names == StateMap(robot, frame=lin.frame).names:
        C = W @ back
        y0 = x0
        outputs = states
    f0 = np.zeros(len(A))
    if sampled:
        A, B = held_exponential(A, B, sampled)
    names, units = [*states], [*states.values()]
    inputs = [(kind.actuation.names[i], kind.actuation.units[i]) for i in kind.inputs]
    T_u = np.linalg.solve(to.V, source.V)
    return ToolModel(
        tool=tool,
        robot=lin.robot,
        reference="fixed",
        verified=lin.verified,
        state_names=tuple(names[row] for row in rows),
        state_units=tuple(units[row] for row in rows),
        input_names=tuple(name for name, _ in inputs),
        input_units=tuple(unit for _, unit in inputs),
        output_names=tuple(outputs),
        output_units=tuple(outputs.values()),
        A=A,
        B=B,
        C=C,
        D=D @ to.V,
        f0=f0,
        x0=x0[rows],
        u0=T_u @ lin.u0,
        y0=y0,
        dt=sampled,
        T=S,
        T_left=back,
        T_u=T_u,
        q=q,
        v=v,
    )


@dataclass(frozen=True, eq=False, repr=False)
class ToolGain(Design):
    """State feedback in another tool's coordinates, ``u = u0 - K (x - x0)``; see `Gain.to`.

    Attributes
    ----------
    K : ndarray (nu, nx)
        Gain. If the tool's q is on a manifold (mujoco, pinocchio, crocoddyl), ``x - x0`` consists
        of the difference of configurations that the tool computes on this manifold, and of the
        difference of velocities.
    model : ToolModel
        The model in the tool's coordinates, with names, x0, u0, and the reference `q` and `v`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> gain = fflin.lqr(fflin.linearize(robot)).to("mujoco")
    >>> gain.K.shape, gain.model.q.shape
    ((9, 18), (10,))
    """

    K: Array
    model: ToolModel

    def __repr__(self) -> str:
        nu, nx = self.K.shape
        return f"ToolGain('{self.model.robot}', '{self.model.tool}', nx={nx}, nu={nu})"


def tool_gain(lin: LinearModel, K: Array, tool: str) -> ToolGain:
    """Convert the gain K of a model to a tool's coordinates, with the same closed-loop poles."""
    model = lin.to(tool)
    whole = lin.generator
    robot = lin._robot
    assert whole is not None and robot is not None
    if robot.constraints:
        kind, source, to = _jacobians_of(robot, whole, tool, np.zeros(6 + robot.n))
        by_state = chosen(whole, kind, source, to).by_state
        turned: Array = np.linalg.solve(to.V, by_state) @ model.T_left
        return ToolGain(
            model.T_u @ K @ model.T_left + turned, model, verified=lin.verified
        )
    _, source, to, _ = _jacobians_at(robot, whole, tool)
    # The input axes of the tool may rotate relative to the input axes of the model. In this case,
    # an input that is constant in the model's axes varies with the attitude in the tool's axes
    # (15.4).
    turned = np.linalg.solve(to.V, (to.H - source.H) @ to.left)
    return ToolGain(model.T_u @ K @ model.T_left + turned, model, verified=lin.verified)


def from_tool(
    robot: Robot,
    tool: str,
    q: Array,
    v: Array | None = None,
    u: Array | None = None,
    *,
    A: Array | None = None,
    B: Array | None = None,
    dt: float | None = None,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    moving: bool = False,
) -> LinearModel:
    """Return a linear model from another tool's operating point and matrices.

    Parameters
    ----------
    robot : Robot
    tool, dt
        See `transform`; dt is the time step for which A and B were computed.
    q, v : array_like
        Configuration and velocity in the tool's coordinates; v is zero by default. For "spart", in
        SPART's notation, q consists of R0 (column by column), r0 and qm, and v consists of u0 and
        um.
    u : array_like (nu,), optional
        Inputs of the robot in the tool's order and axes; zero by default.
    A, B : array_like, optional
        Matrices of the tool at this operating point, see `ToolModel`; by default fflin computes A
        and B.
    frame, reference, moving
        Options of the returned model, see `linearize`.

    Returns
    -------
    LinearModel
        Model in the coordinates of fflin, with the operating point ``q``, ``v`` and ``u0``. `check`
        and ``certificate`` show how accurate A and B are.

    Raises
    ------
    InputError
        If an argument has a wrong size, an entry is not finite, or an attitude is not a rotation.
    UnknownNameError
        If the tool is unknown.
    ChartError
        If the base is rotated by 180 deg from the reference, or the tool uses Euler angles and
        their pitch is 90 deg.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> mujoco = lin.to("mujoco")
    >>> back = fflin.from_tool(robot, "mujoco", mujoco.q, mujoco.v, A=mujoco.A, B=mujoco.B)
    >>> bool(abs(back.B - lin.B).max() < 1e-13)
    True
    """
    refuse_constraints(robot, f"models from {tool}")
    q, v = tool_coordinates(robot, tool).to_pinocchio(q, v)
    about = partial(
        linearize, robot, q, v, frame=frame, reference=reference, moving=moving
    )
    lin, step = about(), step_of(tool, dt)
    if u is not None:
        u = vector("u", u, len(lin.u0), "the robot's inputs, as the tool has them")
        _, source, to, _ = _jacobians_at(robot, lin, tool)
        lin = about(np.linalg.solve(source.V, to.V @ u))
    if A is None and B is None:
        return lin
    _, source, to, rates = _jacobians_at(robot, lin, tool)
    ours = transformed(source, to, lin.A, lin.B)
    if step:
        ours = euler_step(*ours, to.P @ rates, step, tool)[:2]
    changes = []
    for name, given, expected in zip("AB", (A, B), ours, strict=True):
        change = expected if given is None else shaped(name, given, expected.shape)
        change = change - expected
        # use only the velocity rows, because the position rows follow from them
        if step:
            nv = len(change) // 2
            change = np.vstack((0.0 * change[:nv], change[nv:] / step))
        changes.append(change)
    source, to = (
        jacobians._replace(rate=0.0 * jacobians.rate, extra=0.0 * jacobians.extra)
        for jacobians in (source, to)
    )
    matrices = []
    for old, new in zip((lin.A, lin.B), transformed(to, source, *changes), strict=True):
        noise = (old == 0.0) & (np.abs(new) < _ROUNDING * np.abs(old).max())
        matrices.append(np.where(noise, 0.0, old + new))
    return replace(lin, A=matrices[0], B=matrices[1])


def _jacobians_at(
    robot: Robot, lin: LinearModel, tool: str
) -> tuple[ToolCoordinates, Jacobians, Jacobians, Array]:
    """Return the tool's coordinates, the model's Jacobians, the tool's Jacobians, and dy/dt.

    The Jacobians are derivatives with respect to y (15.1). All are at the operating point of `lin`.
    """
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    if lin.state_names != state.names:
        raise InputError(
            "lin lacks some states of the robot; use the full model of the robot"
        )
    model_coordinates = ToolCoordinates(state, moving=lin.moving)
    nu = state.velocities(lin.v)
    dy = lin.drift
    if dy is None:
        # f0 = P dy/dt, and the accelerations do not affect the left inverse of P.
        u = model_coordinates.actuation.in_base_axes(state.chart(lin.q), lin.u0)
        at_rest = model_coordinates.jacobians(lin.q, nu, u, np.zeros_like(nu))
        dy = at_rest.left @ lin.f0
    acceleration = dy[len(nu) :]
    kind, from_y, to_tool = _jacobians_of(robot, lin, tool, acceleration)
    return kind, from_y, to_tool, np.append(nu, acceleration)


def _jacobians_of(
    robot: Robot, lin: LinearModel, tool: str, acceleration: Array
) -> tuple[ToolCoordinates, Jacobians, Jacobians]:
    """Return the tool's coordinates, and the Jacobians of the model and of the tool.

    The accelerations (6 + n,) are in base axes.
    """
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    model_coordinates = ToolCoordinates(state, moving=lin.moving)
    other_coordinates = tool_coordinates(robot, tool, moving=lin.moving)
    nu = state.velocities(lin.v)
    u = model_coordinates.actuation.in_base_axes(state.chart(lin.q), lin.u0)
    point = lin.q, nu, u, acceleration
    from_y = model_coordinates.jacobians(*point)
    return other_coordinates, from_y, other_coordinates.jacobians(*point)


def transformed(
    source: Jacobians, to: Jacobians, A: Array, B: Array
) -> tuple[Array, Array]:
    """Transform A and B by (15.3) to (15.5).

    `source` contains the Jacobians of the present coordinates, and `to` contains the Jacobians of
    the new coordinates.
    """
    B = source.left @ B @ np.linalg.inv(source.V)
    A = source.left @ (A @ source.P - source.rate) + B @ (to.H - source.H)
    return (to.P @ A + to.rate) @ to.left + to.extra, to.P @ B @ to.V


def step_of(tool: str, dt: float | None) -> float:
    """Check the time step dt [s] of a tool, and return dt, or 0 if dt is None."""
    h = 0.0 if dt is None else number("dt", dt)
    if dt is not None and (not 0.0 < h < 1e3 or str(tool) not in STEPPING):
        raise InputError(
            f"dt is {h:g} s for {tool}, but only {' and '.join(STEPPING)} have a dt, a positive "
            "time step below 1000 s"
        )
    return h


def euler_step(
    A: Array, B: Array, rate: Array, h: float, tool: str
) -> tuple[Array, Array, Array]:
    """Return A, B and f0 of a semi-implicit Euler step of h [s] (15.6).

    A, B and `rate`, the derivative dx'/dt, are in the coordinates of MuJoCo or Crocoddyl. For the
    base, linear rows precede angular rows.
    """
    v, a = np.split(rate, 2)
    nv = len(v)
    moved = h * (v + h * a)
    K = np.eye(nv)
    G = h * np.eye(nv)
    if tool == "mujoco":
        K[3:6, 3:6] = pin.exp3(-moved[3:6])
        G[3:6, 3:6] = h * pin.Jexp3(moved[3:6])
    else:
        K[:6, :6] = pin.exp6(-moved[:6]).toActionMatrix()
        G[:6, :6] = h * pin.Jexp6(moved[:6])
    # The step computes the new velocities first, and from them the new positions.
    old_velocities = np.eye(nv, 2 * nv, nv)  # [0 I]
    A, B = h * A[nv:] + old_velocities, h * B[nv:]
    A, B = np.vstack((G @ A, A)), np.vstack((G @ B, B))
    A[:nv, :nv] += K
    return A, B, np.concatenate((moved, h * a))
