"""Model of a robot with magnetorquers, with the torques that the field allows on average."""

from dataclasses import replace

import numpy as np

from fflin.base.validation import Array
from fflin.linear.linear_trajectory import LinearTrajectory
from fflin.linear.model import LinearModel
from fflin.robot.inputs import Magnetorquer
from fflin.robot.joints import ROOT, find_frame


def mean_model(traj: LinearTrajectory) -> LinearModel:
    """Return the model at the first knot, with the mean effect of magnetorquers over one period.

    Let B be the input matrix of the magnetorquers, and W the diagonal matrix of the squares of
    their limits. At each time, the field allows the accelerations B W B', which have no part along
    the field. The returned model has the matrix B for which they are equal to their mean over the
    period. Among these, it is the matrix nearest to torques along the axes of the magnetorquers.

    The model is unchanged if no input is a magnetorquer, or if one moves relative to the base.
    """
    lin = traj[0]
    axes = _axes(traj)
    if not axes:
        return lin
    columns = [*axes]
    limits = np.array([_limit(lin, column) for column in columns])
    largest = traj.B[:, :, columns] * limits
    effects = largest @ largest.mT
    # The mean over time by the trapezoidal rule, which is accurate for periodic functions.
    fractions = np.diff(traj.t) / (traj.t[-1] - traj.t[0])
    effect = np.tensordot(fractions, 0.5 * (effects[1:] + effects[:-1]), 1)
    values, vectors = np.linalg.eigh(effect)
    root = vectors[:, -len(columns) :] * np.sqrt(values[-len(columns) :].clip(0.0))
    wanted = np.zeros((len(lin.B), len(columns)))
    inverse = np.linalg.inv(lin.M)
    wanted[len(lin.M) :] = inverse[:, :3] @ np.column_stack([*axes.values()])
    # The orthogonal matrix that brings `root` nearest to the accelerations `wanted`.
    left, _, right = np.linalg.svd(root.T @ wanted)
    mean = lin.B.copy()
    mean[:, columns] = root @ left @ right / limits
    return replace(lin, B=mean)


def mean_rule(traj: LinearTrajectory) -> str:
    """Return the text that the rule of default weights contains because of `mean_model`."""
    if not _axes(traj):
        return ""
    return "; magnetorquers count with their mean effect over one period"


def _axes(traj: LinearTrajectory) -> dict[int, Array]:
    """Return {column of B: axis (3,) in base axes} of all magnetorquers.

    It is empty if a magnetorquer moves relative to the base.
    """
    robot = traj.robot
    names = list(traj.input_names)
    axes: dict[int, Array] = {}
    for item, input_names in robot.named_inputs:
        if isinstance(item, Magnetorquer):
            joint, placement = find_frame(robot.model, item.frame)
            if joint != ROOT:
                return {}
            axes[names.index(input_names[0])] = placement.rotation @ item.axis
    return axes


def _limit(lin: LinearModel, column: int) -> float:
    """Return the limit of an input, or 1 if it has none."""
    limit = float(lin.limits.get(lin.input_names[column], 1.0))
    return limit if np.isfinite(limit) and limit > 0.0 else 1.0
