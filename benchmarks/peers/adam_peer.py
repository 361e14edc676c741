"""CasADi through adam, since Pinocchio's wheels come without its CasADi binding.

Velocities and wrenches of the base in world axes, linear before angular, joints as they are
listed. The symbolic derivatives are built once; what is timed is their evaluation.
"""

import tempfile
from pathlib import Path

import casadi
import numpy as np
from adam import Representations
from adam.casadi import KinDynComputations

from benchmarks.peers import Method
from benchmarks.robots import BASE, Array, Point, plain_urdf

REFUSALS = (RuntimeError,)  # adam takes no robot without joints
NAME = "CasADi (adam)"


def at_rest(point: Point) -> list[Method]:
    dynamics, n = _dynamics(point), point.robot.n
    placement, positions = casadi.SX.sym("H", 4, 4), casadi.SX.sym("s", n)
    M = dynamics.mass_matrix(placement, positions)
    function = casadi.Function("inverse", [placement, positions], [casadi.inv(M)])
    order, unturned, q_m = _order(n), np.eye(4), point.q_m
    kept: dict[str, Array] = {}

    def call() -> None:
        kept["inverse"] = function(unturned, q_m).full()

    return [
        Method(NAME, call, lambda: kept["inverse"][np.ix_(order, order)], frame="world")
    ]


def at_point(point: Point) -> list[Method]:
    dynamics, n = _dynamics(point), point.robot.n
    nv, order, q_m = 6 + n, _order(n), point.q_m
    pose = casadi.SX.sym("pose", 6)
    positions, nu, a = (
        casadi.SX.sym(*each) for each in (("s", n), ("nu", nv), ("a", nv))
    )
    # About the unturned base, to first order.
    turned = casadi.SX.eye(3) + casadi.skew(pose[:3])
    placement = casadi.vertcat(
        casadi.horzcat(turned, pose[3:]), casadi.SX([[0, 0, 0, 1]])
    )
    M = dynamics.mass_matrix(placement, positions)
    bias = dynamics.bias_force(placement, positions, nu[:6], nu[6:])
    forces = casadi.Function("forces", [pose, positions, nu], [M, bias])
    moved = casadi.jacobian(M @ a + bias, casadi.vertcat(pose, positions, nu))
    slopes_of_forces = casadi.Function("slopes", [pose, positions, nu, a], [moved])
    still, v, u = np.zeros(6), np.empty(nv), np.empty(nv)
    v[order], u[order] = point.nu, point.u
    kept: dict[str, Array] = {}

    def call() -> None:
        M, bias = (each.full() for each in forces(still, q_m, v))
        inverse = np.linalg.inv(M)
        a = inverse @ (u - bias[:, 0])
        by_state = -inverse @ slopes_of_forces(still, q_m, v, a).full()
        kept["slopes"] = np.hstack((by_state, inverse))

    def slopes() -> Array:
        columns = np.concatenate((np.arange(nv), nv + order, 2 * nv + order))
        return kept["slopes"][np.ix_(order, columns)]

    return [Method(NAME, call, slopes, frame="world")]


def _dynamics(point: Point) -> KinDynComputations:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "robot.urdf"
        path.write_text(plain_urdf(point.robot), encoding="utf-8")
        dynamics = KinDynComputations(str(path), list(point.robot.joint_names), BASE)
    dynamics.set_frame_velocity_representation(Representations.MIXED_REPRESENTATION)
    dynamics.g = np.zeros(6)
    return dynamics


def _order(n: int) -> Array:
    return np.array([3, 4, 5, 0, 1, 2, *range(6, 6 + n)])
