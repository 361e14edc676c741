"""Crocoddyl: the forward dynamics of Pinocchio's model, every coordinate actuated, no costs."""

import crocoddyl
import numpy as np

from benchmarks.peers import Method
from benchmarks.robots import Array, Point

REFUSALS = ()


def at_rest(point: Point) -> list[Method]:
    return [_method(point, np.zeros(point.robot.nv), np.zeros(point.robot.nv))]


def at_point(point: Point) -> list[Method]:
    tau = np.zeros(point.robot.nv)
    tau[point.order] = point.u
    return [_method(point, point.v, tau)]


def _method(point: Point, v: Array, tau: Array) -> Method:
    state = crocoddyl.StateMultibody(point.robot.model)
    actuation = crocoddyl.ActuationModelFull(state)
    costs = crocoddyl.CostModelSum(state, actuation.nu)
    model = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
    data = model.createData()
    x = np.concatenate((point.q, v))
    nv, order = point.robot.nv, point.order

    def call() -> None:
        model.calc(data, x, tau)
        model.calcDiff(data, x, tau)

    def slopes() -> Array:
        blocks = (data.Fx[:, :nv], data.Fx[:, nv:], data.Fu)
        return np.hstack([block[np.ix_(order, order)] for block in blocks])

    return Method("Crocoddyl calc + calcDiff", call, slopes, frame="local")
