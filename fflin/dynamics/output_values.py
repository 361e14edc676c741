"""The outputs of the nonlinear model, out of elementary kinematics in the world.

The route by which C and D are checked, and nothing of the one by which they are made.
"""

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.output_kinds import KINDS, World
from fflin.dynamics.outputs import carried, states_of
from fflin.dynamics.state import StateMap


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
        robot = state.robot
        self._world = World(
            robot.model,
            robot.create_data(),
            state.reference,
            np.array(robot.gravity),
            robot.stored_momentum,
        )
        pin.forwardKinematics(robot.model, self._world.data, q)
        frames = [tuple(carried(robot, name) for name in output.frames) for output in robot.outputs]
        attitudes = [
            tuple(np.array(self._world.placement(frame).rotation) for frame in group)
            for group in frames
        ]
        self._outputs = tuple(zip(robot.outputs, frames, attitudes, strict=True))

    def __call__(self, x: Array, q: Array, v: Array, a: Array) -> Array:
        """Return y (ny,); `a` (nv,) is dv/dt as Pinocchio's ABA returns it."""
        world = self._world
        pin.forwardKinematics(world.model, world.data, q, v, a)
        return np.concatenate(
            [
                KINDS[type(output)][1](world, frames, attitudes)
                if type(output) in KINDS
                else x[states_of(self.state, output)]
                for output, frames, attitudes in self._outputs
            ]
        )
