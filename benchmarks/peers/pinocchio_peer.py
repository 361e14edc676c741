"""Pinocchio called by hand: what is beneath fflin."""

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dpotrf, dpotri

from benchmarks.peers import Method
from benchmarks.robots import Array, Point

REFUSALS = ()
FLOOR = "crba + LAPACK"


def at_rest(point: Point) -> list[Method]:
    model, data, q = point.robot.model, point.robot.create_data(), point.q
    order = point.order
    kept: dict[str, Array] = {}

    def floor() -> None:
        factor, _ = dpotrf(pin.crba(model, data, q))
        kept["inverse"], _ = dpotri(factor)

    def slopes() -> Array:
        upper = np.triu(kept["inverse"])
        return (upper + np.triu(upper, 1).T)[np.ix_(order, order)]

    return [Method(FLOOR, floor, slopes)]


def at_point(point: Point) -> list[Method]:
    model, data, order = point.robot.model, point.robot.create_data(), point.order
    q, v = point.q, point.v
    tau = np.zeros(model.nv)
    tau[order] = point.u
    kept: dict[str, tuple[Array, Array, Array]] = {}

    def call() -> None:
        kept["all"] = pin.computeABADerivatives(model, data, q, v, tau)

    def slopes() -> Array:
        by_q, by_v, inverse = kept["all"]
        return np.hstack(
            [block[np.ix_(order, order)] for block in (by_q, by_v, inverse)]
        )

    return [Method("Pinocchio ABA derivatives", call, slopes, frame="local")]
