"""Robots with reaction wheels, and the same without them."""

import numpy as np
import pinocchio as pin

import fflin

# Three and more in skew axes; the first three and the first four turn a body about all axes.
AXES = ((1.0, 0.0, 0.0), (0.2, 1.0, 0.1), (-0.3, 0.1, 1.0), (1.0, -1.0, 1.0), (0, 1, 0), (1, 0, 1))
ORTHOGONAL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
PYRAMID = ((1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (-1.0, 0.0, 1.0), (0.0, -1.0, 1.0))


def unit(axis):
    return np.array(axis) / np.linalg.norm(axis)


def wheels(axes, inertia, frames=(None,)):
    """Wheels about these axes, on the frames by turns."""
    return [
        fflin.ReactionWheel(axis, frames[k % len(frames)], inertia) for k, axis in enumerate(axes)
    ]


def carrier_alone(robot, mounted):
    """The robot whose base lacks J a a^T of each (J, axis)."""
    model = robot.model.copy()
    body = model.inertias[1]
    taken = sum(J * np.outer(unit(axis), unit(axis)) for J, axis in mounted)
    model.inertias[1] = pin.Inertia(body.mass, body.lever, body.inertia - taken)
    return fflin.from_model(model, name=robot.name)
