"""The outputs of the nonlinear model, out of elementary kinematics in the world.

The route by which C and D are checked, and nothing of the one by which they are made.
"""

from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.outputs import Carried, carried, states_of
from fflin.dynamics.state import StateMap
from fflin.robot.outputs import (
    Accelerometer,
    CenterOfMass,
    FramePose,
    FrameVelocity,
    Gyroscope,
    Momentum,
    Output,
)


class Measuring:
    """The outputs y of a robot at any state near a point.

    Parameters
    ----------
    state : StateMap
    q : ndarray (nq,)
        The point, from which rotation vectors are counted.
    """

    def __init__(self, state: StateMap, q: Array) -> None:
        self.state = state
        self._data = state.robot.create_data()
        self._gravity = np.array(state.robot.gravity)
        self._frames: dict[Any, Carried] = {}
        self._attitudes: dict[Any, Array] = {}
        pin.forwardKinematics(state.robot.model, self._data, q)
        for output in state.robot.outputs:
            if isinstance(output, FramePose | FrameVelocity | Gyroscope | Accelerometer):
                frame = carried(state.robot, output.frame)
                self._frames[output] = frame
                placement = self._data.oMi[frame.joint] * frame.placement
                self._attitudes[output] = np.array(placement.rotation)

    def __call__(self, x: Array, q: Array, v: Array, a: Array) -> Array:
        """Return y (ny,); `a` (nv,) is dv/dt as Pinocchio's ABA returns it."""
        pin.forwardKinematics(self.state.robot.model, self._data, q, v, a)
        parts = [self._one(output, x) for output in self.state.robot.outputs]
        return np.concatenate([np.ravel(part) for part in parts])

    def _one(self, output: Output, x: Array) -> Array:
        model, data, reference = self.state.robot.model, self._data, self.state.reference
        if output in self._frames:
            return self._of_frame(output, self._frames[output])
        if isinstance(output, CenterOfMass | Momentum):
            links = range(1, model.njoints)
            mass = sum(model.inertias[i].mass for i in links)
            moments = [
                model.inertias[i].mass * data.oMi[i].act(model.inertias[i].lever) for i in links
            ]
            com = sum(moments) / mass
            if isinstance(output, CenterOfMass):
                return reference.actInv(com)
            momenta = [data.oMi[i].act(model.inertias[i] * data.v[i]) for i in links]
            linear = sum(h.linear for h in momenta)
            angular = sum(h.angular for h in momenta) - np.cross(com, linear)
            for joint, stored in self.state.robot.stored_momentum:
                angular += data.oMi[joint].rotation @ stored
            return np.concatenate((reference.rotation.T @ angular, reference.rotation.T @ linear))
        return x[states_of(self.state, output)]

    def _of_frame(self, output: Output, frame: Carried) -> Array:
        data, reference = self._data, self.state.reference
        placement = data.oMi[frame.joint] * frame.placement
        velocity = frame.placement.actInv(data.v[frame.joint])
        if isinstance(output, FramePose):
            turned = pin.log3(self._attitudes[output].T @ placement.rotation)
            return np.concatenate((reference.actInv(placement.translation), turned))
        if isinstance(output, FrameVelocity):
            linear = reference.rotation.T @ placement.rotation @ velocity.linear
            return np.concatenate((velocity.angular, linear))
        if isinstance(output, Gyroscope):
            return velocity.angular
        rate = frame.placement.actInv(data.a[frame.joint]).linear
        felt = rate + np.cross(velocity.angular, velocity.linear)
        return felt - placement.rotation.T @ self._gravity
