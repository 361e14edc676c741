"""Batch of linear models in the coordinates of another tool."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.record import Design
from fflin.base.validation import Array, Indices, frozen
from fflin.dynamics.coordinates import refuse_constraints
from fflin.dynamics.state import StateMap
from fflin.linear.exchange import ToolModel, euler_step, step_of, transformed
from fflin.linear.tool_coordinates import Jacobians, ToolCoordinates, tool_coordinates
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.batch.linear_batch import LinearBatch


@dataclass(frozen=True, eq=False, repr=False)
class ToolBatch(Design):
    r"""Linear models ``dx/dt = f0 + A (x - x0) + B (u - u0)`` in another tool's coordinates.

    The models are converted from a `LinearBatch`. See `ToolModel` for the state x.
    ``tool_batch[i]`` is the `ToolModel` of point i. The outputs are not converted, so it has none;
    for one model with its outputs, convert ``batch[i].to(tool)`` of the `LinearBatch`.

    Attributes
    ----------
    tool, robot : str
        Names of the tool and the robot.
    A, B, f0 : ndarray (N, nx, nx), (N, nx, nu), (N, nx)
    x0, u0 : ndarray (N, nx), (N, nu)
        States and inputs at the points.
    q, v : ndarray
        Configurations and velocities of the points in the tool's coordinates, one row each.
    T, T_left, T_u : ndarray (N, nx, 12 + 2n), (N, 12 + 2n, nx), (N, nu, nu)
        Matrices from the deviations of a `LinearModel` to the tool's deviations, see `ToolModel`.
    dt : float
        Time step [s]; 0 in continuous time.
    state_names, input_names, state_units, input_units : tuple of str
    reference : str
        "fixed" or "moving", see `ToolModel`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> batch = fflin.sweep(robot, fflin.grid(robot, {"joint_1": np.linspace(-1, 1, 5)}))
    >>> drake = batch.to("drake")
    >>> drake.A.shape, drake.state_names[:2]
    ((5, 19, 19), ('quat.w', 'quat.x'))
    >>> bool(abs(drake[2].A - batch[2].to("drake").A).max() < 1e-12)
    True
    """

    tool: str
    robot: str
    A: Array
    B: Array
    f0: Array
    x0: Array
    u0: Array
    q: Array
    v: Array
    T: Array
    T_left: Array
    T_u: Array
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_units: tuple[str, ...]
    reference: str

    def __len__(self) -> int:
        return len(self.A)

    def __getitem__(self, index: int) -> ToolModel:
        if not isinstance(index, int | np.integer):
            kind = type(index).__name__
            raise InputError(f"index has type {kind}, expected a whole number")
        if not -len(self) <= index < len(self):
            raise IndexError(f"index is {index}, but the batch has {len(self)} points")
        stacks = ("A", "B", "f0", "x0", "u0", "q", "v", "T", "T_left", "T_u")
        fields = {name: getattr(self, name)[index] for name in stacks}
        nx, nu = fields["B"].shape
        return ToolModel(
            **fields,
            C=np.zeros((0, nx)),
            D=np.zeros((0, nu)),
            y0=np.zeros(0),
            dt=self.dt,
            tool=self.tool,
            robot=self.robot,
            reference=self.reference,
            state_names=self.state_names,
            state_units=self.state_units,
            input_names=self.input_names,
            input_units=self.input_units,
            output_names=(),
            output_units=(),
            verified=self.verified,
        )

    def __iter__(self) -> Iterator[ToolModel]:
        return map(self.__getitem__, range(len(self)))


class _Change(NamedTuple):
    """Derivatives of the coordinates of the models and of the tool, for points that share them."""

    own: Jacobians
    to: Jacobians

    @property
    def T(self) -> Array:
        """Matrix from deviations of a model to deviations of the tool."""
        T: Array = self.to.P @ self.own.left
        return T

    @property
    def T_left(self) -> Array:
        """Left inverse of T."""
        T_left: Array = self.own.P @ self.to.left
        return T_left

    @property
    def T_u(self) -> Array:
        """Matrix from input deviations of a model to the tool's input deviations."""
        return np.linalg.solve(self.to.V, self.own.V)


def tool_batch(
    robot: Robot, batch: LinearBatch, tool: str, dt: float | None
) -> ToolBatch:
    """Convert the models of a batch; see `LinearBatch.to`."""
    step = step_of(tool, dt)
    refuse_constraints(robot, f"batches in the coordinates of {tool}")
    kind = tool_coordinates(robot, tool, moving=batch.moving)
    points = _Points(robot, batch, kind)
    stacks: dict[str, Array] = {}
    for rows in points.groups():
        change, rates = points.change(rows)
        A, B = transformed(change.own, change.to, batch.A[rows], batch.B[rows])
        rate = rates @ change.to.P.T
        if step:
            stepped = [
                euler_step(*matrices, step, tool)
                for matrices in zip(A, B, rate, strict=True)
            ]
            A, B, rate = (np.array(matrices) for matrices in zip(*stepped, strict=True))
        if batch.moving:
            rate = np.zeros_like(rate)
        converted = {
            "A": A,
            "B": B,
            "f0": rate,
            "u0": batch.u0[rows] @ change.T_u.T,
            "T": change.T[None],
            "T_left": change.T_left[None],
            "T_u": change.T_u[None],
        }
        for name, value in converted.items():
            if name not in stacks:
                stacks[name] = np.empty((len(batch), *value.shape[1:]))
            stacks[name][rows] = value
    vectors = [kind.vectors(q, v) for q, v in zip(batch.q, batch.v, strict=True)]
    q, v = (np.array(values) for values in zip(*vectors, strict=True))
    positions = np.zeros_like(v) if kind.tangent else q
    for stack in stacks.values():
        frozen(stack)
    return ToolBatch(
        tool=tool,
        robot=batch.robot,
        **stacks,
        x0=frozen(np.hstack((positions, v))),
        q=frozen(q),
        v=frozen(v),
        dt=step,
        state_names=tuple(kind.states()),
        input_names=tuple(kind.actuation.names[i] for i in kind.inputs),
        state_units=tuple(kind.states().values()),
        input_units=tuple(kind.actuation.units[i] for i in kind.inputs),
        reference="moving" if batch.moving else "fixed",
        verified=batch.verified,
    )


class _Points:
    """Points of a batch, and the quantities that determine their change of coordinates.

    The derivatives of the coordinates depend on the attitude, the twist and the acceleration of the
    base and on the wrench of the inputs on it, but not on the joints. So points that share these
    share the change of coordinates.
    """

    def __init__(self, robot: Robot, batch: LinearBatch, kind: ToolCoordinates) -> None:
        self._robot, self._batch, self._kind = robot, batch, kind
        state = StateMap(robot, frame=batch.frame)
        self._nu = state.velocities(batch.v)
        nv = self._nu.shape[1]
        base = slice(nv, nv + 6)
        # The rates of the base: the rates of a moving reference, or f0 in the axes of the frame.
        drift = batch.f0 if batch._drift is None else batch._drift
        self._placements = batch.placements
        moves_base = kind.actuation.fixed[:6].any(axis=0)
        attitudes = batch.q[:, 3:7], self._placements[:, 3:7]
        self._key = np.hstack(
            (*attitudes, self._nu[:, :6], drift[:, base], batch.u0[:, moves_base])
        )
        self._drift = drift

    def groups(self) -> list[Indices]:
        """Return the indices of the points that share a change of coordinates."""
        _, group = np.unique(self._key + 0.0, axis=0, return_inverse=True)
        order = np.argsort(group.ravel(), kind="stable")
        return np.split(order, np.flatnonzero(np.diff(group.ravel()[order])) + 1)

    def change(self, rows: Indices) -> tuple[_Change, Array]:
        """Return the change of coordinates of a group, and the rates dy/dt of its points."""
        batch = self._batch
        first = rows[0]
        reference = pin.XYZQUATToSE3(self._placements[first])
        state = StateMap(self._robot, reference=reference, frame=batch.frame)
        model_coordinates = ToolCoordinates(state, moving=batch.moving)
        nu, q, drift = self._nu[first], batch.q[first], self._drift[rows]
        u = model_coordinates.actuation.in_base_axes(state.chart(q), batch.u0[first])
        if batch._drift is None:  # f0 = P dy/dt
            drift = drift @ model_coordinates.jacobians(q, nu, u, 0.0 * nu).left.T
        accelerations = drift[:, len(nu) :]
        at = q, nu, u, accelerations[0]
        change = _Change(model_coordinates.jacobians(*at), self._kind.jacobians(*at))
        return change, np.hstack((self._nu[rows], accelerations))
