"""Robots with reaction wheels, and the same without them."""

import numpy as np
import pinocchio as pin

import fflin

# Three and more in skew axes; the first three and the first four turn a body about all axes.
AXES = (
    (1.0, 0.0, 0.0),
    (0.2, 1.0, 0.1),
    (-0.3, 0.1, 1.0),
    (1.0, -1.0, 1.0),
    (0, 1, 0),
    (1, 0, 1),
)
ORTHOGONAL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
PYRAMID = ((1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (-1.0, 0.0, 1.0), (0.0, -1.0, 1.0))


def unit(axis):
    return np.array(axis) / np.linalg.norm(axis)


def wheels(axes, inertia, frames=(None,)):
    """Wheels about these axes, on the frames by turns."""
    return [
        fflin.ReactionWheel(axis, frames[k % len(frames)], inertia)
        for k, axis in enumerate(axes)
    ]


def carrier_alone(robot, mounted):
    """The robot whose base lacks J a a^T of each (J, axis)."""
    model = robot.model.copy()
    body = model.inertias[1]
    taken = sum(J * np.outer(unit(axis), unit(axis)) for J, axis in mounted)
    model.inertias[1] = pin.Inertia(body.mass, body.lever, body.inertia - taken)
    return fflin.from_model(model, name=robot.name)


def spun(axes, *, others=(), J=0.02, arm=True, **fields):
    """Two descriptions of one satellite: its wheels as joints of the tree, and as `ReactionWheel`.

    The wheels have a mass, a transverse inertia and a place of their own. The inertia of the second
    satellite's hub includes the welded wheels.
    """
    hub = pin.Inertia(50.0, np.array([0.1, -0.2, 0.05]), np.diag([4.0, 5.0, 6.0]) + 0.1)
    wheel = pin.Inertia(2.0, np.array([0.0, 0.0, 0.03]), np.diag([0.6 * J, 0.6 * J, J]))
    places = []
    for k, axis in enumerate(axes):
        up = pin.Quaternion.FromTwoVectors(
            np.array([0.0, 0.0, 1.0]), unit(axis)
        ).matrix()
        places.append(pin.SE3(up, np.array([0.2 * k, -0.1, 0.3 - 0.2 * k])))
    joints = [fflin.JointTorque("arm")] if arm else []
    robots = []
    for mounted in (False, True):
        model = pin.Model()
        model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
        body = hub
        for place in places if mounted else ():
            body += place.act(wheel)
        model.appendBodyToJoint(1, body, pin.SE3.Identity())
        if arm:
            shoulder = pin.SE3(np.eye(3), np.array([0.5, 0.2, 0.0]))
            index = model.addJoint(1, pin.JointModelRX(), shoulder, "arm")
            link = pin.Inertia(3.0, np.array([0.0, 0.4, 0.1]), 0.2 * np.eye(3))
            model.appendBodyToJoint(index, link, pin.SE3.Identity())
        names = [f"wheel_{k + 1}" for k in range(len(axes))]
        for name, place in zip(names, () if mounted else places, strict=False):
            index = model.addJoint(1, pin.JointModelRUBZ(), place, name)
            model.appendBodyToJoint(index, wheel, pin.SE3.Identity())
        motors = [fflin.JointTorque(name) for name in names]
        if mounted:
            pairs = zip(names, axes, strict=True)
            motors = [
                fflin.ReactionWheel(axis, None, J, name=name) for name, axis in pairs
            ]
        robot = fflin.from_model(model, name="satellite")
        robots.append(robot.replace(inputs=[*others, *joints, *motors], **fields))
    return robots


def matched(lin, other):
    """Indices of the states and of the inputs of `lin`, in the order of `other`."""
    inputs = [name.removeprefix("tau_m.wheel") for name in lin.input_names]
    wanted = [name.removeprefix("wheel") for name in other.input_names]
    states = [lin.state_names.index(name) for name in other.state_names]
    return states, [inputs.index(name) for name in wanted]
