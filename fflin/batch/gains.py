"""Linear quadratic regulators about many points, and gain scheduling between these points."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fflin.base.errors import InputError, located
from fflin.base.names import input_keys
from fflin.base.record import Design
from fflin.base.validation import Array, Vector, instance, vector
from fflin.batch.files import is_constant
from fflin.batch.linear_batch import LinearBatch
from fflin.control.gain import Gain
from fflin.control.lqr import regulator
from fflin.control.optimal.riccati import Solution, half_size
from fflin.control.policies import Feedback
from fflin.control.policy import Command, StateForm
from fflin.control.weights import weight
from fflin.linear.fit import line_up
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from scipy.interpolate import RegularGridInterpolator

    from fflin.control.weights import Weight
    from fflin.robot.robot import Robot


@dataclass(frozen=True, eq=False, repr=False)
class GainBatch(Design):
    """State-feedback gains ``u = u0 - K (x - x0)`` about N points, made by `lqr_batch`.

    Attributes
    ----------
    K : ndarray (N, nu, nx)
        Gains.
    residual : ndarray (N,)
        Residual of each Riccati equation, see `Gain`.
    margin : ndarray (N,)
        Slowest decay rate [1/s] of each closed loop.
    joint_positions : ndarray (N, n)
        Joint positions of the points [rad|m].
    joint_names, state_names, input_names : tuple of str
    frame, robot : str

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> batch = fflin.sweep(robot, fflin.grid(robot, {"joint_1": [-0.5, 0.0, 0.5]}))
    >>> gains = fflin.lqr_batch(batch, 1.0, 1.0)
    >>> gains.gain([0.25, 0.0, 0.0]).shape, bool(gains.margin.min() > 0)
    ((9, 18), True)
    """

    K: Array
    residual: Vector
    margin: Vector
    joint_positions: Array
    joint_names: tuple[str, ...]
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    frame: str
    robot: str

    def __len__(self) -> int:
        return len(self.K)

    @property
    def grid(self) -> dict[str, Array]:
        """Axes of the grid as {joint: values [rad|m]}; only joints that vary are included.

        Raises
        ------
        InputError
            If the points are not on a grid, or are all the same.
        """
        return dict(self._axes)

    def gain(self, joints: Array) -> Array:
        """Return K (nu, nx) at joint positions (n,) by linear interpolation.

        Outside the grid, the gain at the nearest edge of the grid is returned.

        Raises
        ------
        InputError
            If `joints` does not contain n finite numbers, or if the points of the batch are all the
            same or not on a grid.
        """
        return self._between(
            vector("joints", joints, len(self.joint_names), "the joint positions")
        )

    def _between(self, joints: Array) -> Array:
        """Return K at joint positions (n,), which are clamped to the range of the grid."""
        point = []
        for name, values in self._axes.items():
            position = joints[self.joint_names.index(name)]
            point.append(min(max(position, values[0]), values[-1]))
        K: Array = self._interpolator(point)[0]
        return K

    @cached_property
    def _axes(self) -> dict[str, Array]:
        """Axes of the grid, see `grid`; raise `InputError` if the points are not a full grid."""
        columns = dict(zip(self.joint_names, self.joint_positions.T, strict=True))
        axes = {
            name: np.unique(column)
            for name, column in columns.items()
            if np.ptp(column) > 0.0
        }
        if not axes:
            raise InputError(
                "all points of the batch are the same, expected a grid; make the points with "
                "fflin.grid"
            )
        # On a full grid, each combination of the axis values occurs exactly once.
        different_points = len(np.unique(self.joint_positions, axis=0))
        grid_points = math.prod(len(values) for values in axes.values())
        if different_points < len(self) or len(self) != grid_points:
            raise InputError(
                f"interpolation needs all points of a grid over {', '.join(axes)}, but the "
                f"{len(self)} points of the batch are not a full grid; make the points with "
                "fflin.grid"
            )
        return axes

    @cached_property
    def _interpolator(self) -> RegularGridInterpolator:
        from scipy.interpolate import RegularGridInterpolator

        # Sort the rows, because the interpolator expects that the last joint varies fastest.
        order = np.lexsort(self.joint_positions.T[::-1])
        shape = [len(values) for values in self._axes.values()]
        K = self.K[order].reshape(*shape, *self.K.shape[1:])
        return RegularGridInterpolator(tuple(self._axes.values()), K, method="linear")


# Unit of the inputs of magnetorquers alone.
_MOMENT = "A m^2"


def lqr_batch(batch: LinearBatch, Q: Weight, R: Weight) -> GainBatch:
    r"""Return the linear quadratic regulator about every point of a batch.

    Each gain is computed by the method of `lqr`. For fully actuated models at rest, the computation
    takes half the time of a call of `lqr` per point, because no model and no `Gain` are created for
    the point.

    Parameters
    ----------
    batch : LinearBatch
    Q, R : array_like, float or mapping
        Weights as in `lqr`, the same for all points.

    Returns
    -------
    GainBatch

    Raises
    ------
    InputError
        If a weight has a wrong size or sign, or the robot has magnetorquers.
    EquilibriumError, StabilizabilityError
        If no regulator exists about a point; the message names the point.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> batch = fflin.sweep(robot, fflin.grid(robot, {"joint_1": [-0.5, 0.0, 0.5]}))
    >>> fflin.lqr_batch(batch, 1.0, 1.0).K.shape
    (3, 9, 18)
    """
    instance("batch", batch, LinearBatch, "a LinearBatch; fflin.sweep returns one")
    if not len(batch):
        raise InputError(
            "the batch has no points; give a batch with at least one point"
        )
    batch[0].require_unchanged()
    if _MOMENT in batch.input_units:
        raise InputError(
            "lqr_batch does not support magnetorquers, whose torques depend on time, but "
            f"'{batch.robot}' has some; use linearize_orbit, then tvlqr with 'periodic'"
        )
    Q = weight("Q", Q, batch.state_names)
    R = weight("R", R, input_keys(batch), definite=True)
    nv, nu = batch.B_lower.shape[1:]
    K: Array = np.empty((len(batch), nu, 2 * nv))
    residual, margin = np.empty((2, len(batch)))
    # Only a batch of points at rest stores a single A and a single f0 for all points. If this f0 is
    # zero, every point is an equilibrium.
    at_rest = is_constant(batch.A) and is_constant(batch.f0) and not batch.f0[0].any()
    direct = at_rest and nu >= nv
    for index, L in enumerate(batch.B_lower):
        B = np.concatenate((np.zeros_like(L), L))
        solution: Solution | Gain | None = None
        if direct:
            solution = half_size(batch.A[0], B, Q, R)
        if solution is None:
            with located(f"point {index}"):
                solution = regulator(batch[index], Q, R)
        K[index] = solution.K
        residual[index] = solution.residual
        margin[index] = solution.margin
    return GainBatch._of(batch, K=K, residual=residual, margin=margin)


@dataclass(eq=False)
class ScheduledFeedback(Feedback):
    """Gain-scheduled feedback ``u = u0 - K(q_m) (x - x0)``, interpolated over a grid.

    Parameters
    ----------
    lin : LinearModel
        Linear model about the target state.
    gains : GainBatch
        Gains of the same robot, on a grid of its joint positions. If the robot has captured or
        released an object since the gains were designed, `line_up` matches the states and inputs of
        `gains` with the states and inputs of `lin`.

    Raises
    ------
    InputError
        If the states and inputs of `gains` and `lin` cannot be matched, or the gains are not on a
        grid.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> batch = fflin.sweep(robot, fflin.grid(robot, {"joint_1": [-0.5, 0.0, 0.5]}))
    >>> policy = fflin.ScheduledFeedback(lin, fflin.lqr_batch(batch, 1.0, 1.0))
    >>> fflin.simulate(robot, policy, duration=0.5).u.shape[1]
    9
    """

    lin: LinearModel
    gains: GainBatch

    def __post_init__(self) -> None:
        instance("lin", self.lin, LinearModel, "a LinearModel")
        instance("gains", self.gains, GainBatch, "a GainBatch")
        lin, gains = self.lin, self.gains
        columns = [
            k for k, x in enumerate(gains.joint_names) if f"q_m.{x}" in lin.state_names
        ]
        lined = replace(
            gains,
            K=line_up(gains, lin),
            state_names=lin.state_names,
            input_names=lin.input_names,
            joint_names=tuple(gains.joint_names[k] for k in columns),
            joint_positions=gains.joint_positions[:, columns],
        )
        self.gains = lined
        _ = lined.grid

    def table(self) -> tuple[dict[str, Array], Array]:
        """Return the grid axes {joint: values} and the gains (N, nu, nx) in grid order."""
        gains = self.gains
        return gains.grid, gains._interpolator.values.reshape(gains.K.shape)

    def form(self, robot: Robot) -> StateForm:
        """Return the grid and its gains."""
        self.state_map(robot)
        grid, gains = self.table()
        lin = self.lin
        return StateForm(lin.u0 + gains @ lin.x0, gains, lin.x0, grid)

    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot; see `StateFeedback.bind` for errors."""
        lin, gains = self.lin, self.gains
        state = self.state_map(robot)
        joints = [robot.joint(name) for name in gains.joint_names]

        def policy(_: float, q: Array, v: Array) -> Array:
            K = gains._between(np.array([joint.values(q) for joint in joints]))
            u: Array = lin.u0 - K.dot(state.to_state(q, v, near=lin.x0) - lin.x0)
            return u

        return policy
