"""The joint-space inertia in complex numbers, out of nothing but placements and axes of joints.

With a step i h in a parameter, the imaginary part is its derivative to the last digit.
"""

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew


def spatial(parameters):
    """Return the spatial inertia (6, 6), linear first, of dynamic parameters (10,)."""
    m, first = parameters[0], parameters[1:4]
    xx, xy, yy, xz, yz, zz = parameters[4:]
    C = np.array(
        [[0, -first[2], first[1]], [first[2], 0, -first[0]], [-first[1], first[0], 0]]
    )
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.block([[m * np.eye(3), -C], [C, about]])


def motions(model, q):
    """Return by joint the motion (6, nv) of its frame in its axes, linear first."""
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    result = {}
    for joint in range(1, model.njoints):
        place, J = data.oMi[joint], np.zeros((6, model.nv))
        at = joint
        while at:
            relative = place.actInv(data.oMi[at])
            R, p = relative.rotation, relative.translation
            X = np.block([[R, skew(p) @ R], [np.zeros((3, 3)), R]])
            default = model.joints[at]
            S = np.eye(6) if at == 1 else axis_of(default)
            J[:, default.idx_v : default.idx_v + default.nv] = X @ S
            at = model.parents[at]
        result[joint] = J
    return result


def axis_of(joint):
    """Return the motion (6, 1) of a joint of one degree of freedom in its own axes."""
    data = joint.createData()
    joint.calc(data, np.array([1.0, 0.0]) if joint.nq == 2 else np.zeros(1))
    return np.array(data.S).reshape(6, 1)


def inertia(model, joints, bodies):
    """Return M (nv, nv) of motions by joint and dynamic parameters by joint."""
    return sum(J.T @ spatial(bodies[joint]) @ J for joint, J in joints.items())
