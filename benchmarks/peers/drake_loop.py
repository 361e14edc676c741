"""Drake in closed loop: RK3 of fixed step, the feedback by its own gain or by a law in Python."""

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import MatrixGain, ZeroOrderHold

from benchmarks.closed_loop import Loop
from benchmarks.contender import Contender
from benchmarks.peers.drake_peer import DrakePoint
from benchmarks.robots import Array

REFUSALS = (RuntimeError,)


def contenders(loop: Loop) -> list[Contender]:
    """Return the loop in Drake's ways.

    Its own gain acts on its own coordinates, which is the law of the frame `world`.
    """
    own = loop.but(frame="world")
    ways = {
        "Drake": DrakeLoop(own.but(held=False)),
        "Drake, held": DrakeLoop(own.but(held=True)),
        "Drake, in Python": DrakeLoop(loop.but(held=False)),
    }
    return [
        Contender(name, each.loop, each.run, each.end) for name, each in ways.items()
    ]


class DrakeLoop:
    """The plant under a feedback: Drake's gain in the frame `world`, else a law in Python."""

    def __init__(self, loop: Loop) -> None:
        if loop.wheels:
            raise RuntimeError(
                "a wheel is a body without mass, which Drake does not support"
            )
        self.loop = loop
        self.here = here = DrakePoint(loop.point, rest=True)
        M = here.plant.CalcMassMatrix(here.context)
        loop.require_same_inertia("Drake", M[np.ix_(here.order, here.order)])
        # of x in Drake's state
        self.places = np.append(here.turns, here.nq + here.order)
        self.simulator, self.plant = self.closed(here.plant.Clone())
        self.start = self.state(loop.x0)

    def closed(self, plant: MultibodyPlant) -> tuple[Simulator, MultibodyPlant]:
        """Return what simulates a plant under the feedback, and the plant within it."""
        builder, here, loop = DiagramBuilder(), self.here, self.loop
        plant = builder.AddSystem(plant)
        if loop.frame == "world":
            gain = np.zeros((here.nv, here.nq + here.nv))
            gain[np.ix_(here.order, self.places)] = -loop.K
            law = builder.AddSystem(MatrixGain(gain))
        else:
            law = builder.AddSystem(_Law(self))
        builder.Connect(plant.get_state_output_port(), law.get_input_port(0))
        source = law.get_output_port(0)
        if loop.held:
            hold = builder.AddSystem(ZeroOrderHold(loop.dt, here.nv))
            builder.Connect(source, hold.get_input_port())
            source = hold.get_output_port()
        builder.Connect(source, plant.get_applied_generalized_force_input_port())
        simulator = Simulator(builder.Build())
        integrator = ResetIntegratorFromFlags(simulator, "runge_kutta3", loop.dt)
        integrator.set_fixed_step_mode(True)
        return simulator, plant

    def state(self, x: Array) -> Array:
        """Return Drake's state of a state (nx,) in the loop's frame."""
        n, found = 6 + self.loop.robot.n, np.zeros(self.here.nq + self.here.nv)
        w = self.here.turns[0] - 1
        found[self.places], found[w] = x, np.sqrt(1.0 - x[:3] @ x[:3])
        if self.loop.frame != "world":
            found[self.places[n : n + 3]] = _rotation(found[w : w + 4]) @ x[n : n + 3]
        return found

    def seen(self, state: Array) -> Array:
        """Return the state (nx,) in the loop's frame of Drake's."""
        n, w = 6 + self.loop.robot.n, self.here.turns[0] - 1
        x = state[self.places]
        x[:3] *= np.sign(state[w])
        if self.loop.frame != "world":
            x[n : n + 3] = _rotation(state[w : w + 4]).T @ x[n : n + 3]
        return x

    def run(self) -> None:
        context = self.simulator.get_mutable_context()
        context.SetTime(0.0)
        own = self.plant.GetMyMutableContextFromRoot(context)
        self.plant.SetPositionsAndVelocities(own, self.start)
        self.simulator.Initialize()
        self.simulator.AdvanceTo(self.loop.duration)

    def end(self) -> Array:
        """Return the last state (nx,) in the loop's frame."""
        own = self.plant.GetMyContextFromRoot(self.simulator.get_context())
        return self.seen(self.plant.GetPositionsAndVelocities(own))


class _Law(LeafSystem):
    """The feedback of the frame `hybrid`: the torque in base axes, Drake's in the world's."""

    def __init__(self, owner: DrakeLoop) -> None:
        super().__init__()
        here = owner.here
        self._K, self._owner, self._order = owner.loop.K, owner, here.order
        self._w = here.turns[0] - 1
        self._state = self.DeclareVectorInputPort("x", here.nq + here.nv)
        self.DeclareVectorOutputPort("u", here.nv, self._command)

    def _command(self, context: Context, output: BasicVector) -> None:
        state = self._state.Eval(context)
        u = -self._K @ self._owner.seen(state)
        u[:3] = _rotation(state[self._w : self._w + 4]) @ u[:3]
        force = output.get_mutable_value()
        force[self._order] = u


def _rotation(quaternion: Array) -> Array:
    return RotationMatrix(Quaternion(quaternion / np.linalg.norm(quaternion))).matrix()
