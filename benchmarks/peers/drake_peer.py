"""Drake: velocities and wrenches of the base in world axes, quaternions w x y z in the state."""

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import OutputPortSelection
from pydrake.systems.primitives import FirstOrderTaylorApproximation

from benchmarks.peers import Method
from benchmarks.robots import BASE, Array, Point, is_rigid, plain_urdf

REFUSALS = (RuntimeError,)


class DrakePoint:
    """A plant in continuous time with its context at the point, and where coordinates lie."""

    def __init__(self, point: Point, *, rest: bool) -> None:
        if not is_rigid(point.robot):
            raise RuntimeError(
                "Drake replaces inertias that are not physically realisable"
            )
        self.plant = plant = free_plant(plain_urdf(point.robot))
        self.context = plant.CreateDefaultContext()
        base = plant.GetBodyByName(BASE)
        start = base.floating_velocities_start_in_v()
        joints = [plant.GetJointByName(name) for name in point.robot.joint_names]
        # Angular before linear, as in the state.
        self.order = np.array(
            [*range(start, start + 6), *(j.velocity_start() for j in joints)]
        )
        self.nq, self.nv = plant.num_positions(), plant.num_velocities()
        w = base.floating_positions_start()
        q = np.zeros(self.nq)
        q[w] = 1.0
        positions = [joint.position_start() for joint in joints]
        q[positions] = point.q_m
        # About the identity the vector part of the quaternion is half the turn.
        self.turns = np.array([*range(w + 1, w + 7), *positions])
        v, force = np.zeros(self.nv), np.zeros(self.nv)
        if not rest:
            v[self.order], force[self.order] = point.nu, point.u
        plant.SetPositionsAndVelocities(self.context, np.concatenate((q, v)))
        self.port = plant.get_applied_generalized_force_input_port()
        self.port.FixValue(self.context, force)


def free_plant(urdf: str) -> MultibodyPlant:
    """Return a plant in continuous time without gravity."""
    plant = MultibodyPlant(time_step=0.0)
    Parser(plant).AddModelsFromString(urdf, "urdf")
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    return plant


def at_rest(point: Point) -> list[Method]:
    return [_taylor(DrakePoint(point, rest=True))]


def at_point(point: Point) -> list[Method]:
    return [_taylor(DrakePoint(point, rest=False))]


def _taylor(here: DrakePoint) -> Method:
    kept = {}

    def call() -> None:
        kept["system"] = FirstOrderTaylorApproximation(
            here.plant,
            here.context,
            here.port.get_index(),
            OutputPortSelection.kNoOutput,
        )

    def slopes() -> Array:
        rows = here.nq + here.order
        A, B = kept["system"].A()[rows], kept["system"].B()[rows]
        by_q = A[:, here.turns].copy()
        by_q[:, :3] /= 2.0
        return np.hstack((by_q, A[:, rows], B[:, here.order]))

    return Method("Drake FirstOrderTaylorApproximation", call, slopes, frame="world")
