"""MuJoCo: linear velocity and force of the base in world axes, angular ones in base axes.

The free joint and its actuators are added to the URDF; gravity, contacts and limits are off, and
damping and armature zero. Its quaternions are w x y z.
"""

import mujoco
import numpy as np
import pinocchio as pin

import fflin
from benchmarks.peers import Method
from benchmarks.robots import BASE, Array, Point, plain_urdf

REFUSALS = (ValueError,)
FREE = "free flyer"
STEP = 1e-2  # [s]
DIFFERENCE = 1e-6


class MujocoPoint:
    """A model and its data, and where the coordinates of the point lie in them."""

    def __init__(
        self, point: Point, *, motors: bool = True, any_inertia: bool = False
    ) -> None:
        spec = mujoco.MjSpec.from_string(plain_urdf(point.robot))
        spec.compiler.fusestatic, spec.compiler.balanceinertia = False, any_inertia
        spec.body(BASE).add_freejoint(name=FREE)
        names = point.robot.joint_names
        targets = [(FREE, axis) for axis in range(6)] + [(name, 0) for name in names]
        for joint, axis in targets if motors else ():
            _motor(spec, joint, axis)
        self.model = model = spec.compile()
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        model.opt.gravity[:] = 0.0
        model.opt.timestep = STEP
        model.dof_damping[:] = model.dof_armature[:] = 0.0
        self.data = mujoco.MjData(model)
        if any_inertia:
            self._restore_inertias(point.robot)
        self.nv = model.nv
        joints = [model.joint(name) for name in names]
        self.order = np.array([3, 4, 5, 0, 1, 2, *(int(j.dofadr[0]) for j in joints)])
        # Motors: force, torque, then the joints in state order.
        self.inputs = np.array([3, 4, 5, 0, 1, 2, *range(6, self.nv)])
        self.qpos = np.zeros(model.nq)
        self.qpos[3] = 1.0
        self.positions = [int(j.qposadr[0]) for j in joints]
        self.qpos[self.positions] = point.q_m
        self.qvel, self.ctrl = np.zeros(self.nv), np.zeros(self.nv)
        self.qvel[self.order] = point.nu
        self.ctrl[self.inputs] = point.u

    def _restore_inertias(self, robot: fflin.Robot) -> None:
        """Undo what the compiler makes of an inertia that no rigid body can have."""
        names = [BASE, *(f"link {name}" for name in list(robot.model.names)[2:])]
        for name, inertia in zip(names, robot.model.inertias.tolist()[1:], strict=True):
            moments, axes = np.linalg.eigh(inertia.inertia)
            if 2.0 * moments[2] > moments.sum():
                axes[:, 2] *= np.linalg.det(axes)
                body = self.model.body(name)
                body.inertia[:], body.iquat[:] = (
                    moments,
                    np.roll(pin.Quaternion(axes).coeffs(), 1),
                )
        mujoco.mj_setConst(self.model, self.data)


def _motor(spec: "mujoco.MjSpec", joint: str, axis: int) -> None:
    gear = np.zeros(6)
    gear[axis] = 1.0
    spec.add_actuator(
        name=f"{joint} {axis}",
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gear=gear,
    )


def at_rest(point: Point) -> list[Method]:
    here = MujocoPoint(point)
    model, data, order, qpos = here.model, here.data, here.order, here.qpos
    nv = here.nv
    unit, inverse = np.eye(nv), np.zeros((nv, nv))
    kept: dict[str, Array] = {}
    fill_inertia = getattr(mujoco, "mj_makeM", mujoco.mj_crb)

    def by_hand() -> None:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        fill_inertia(model, data)
        mujoco.mj_factorM(model, data)
        mujoco.mj_solveM(model, data, inverse, unit)
        kept["B"] = B = np.zeros((2 * nv, nv))
        B[nv:] = inverse

    def slopes() -> Array:
        return kept["B"][nv:][np.ix_(order, order)]

    here.qvel[:] = here.ctrl[:] = 0.0
    return [
        Method("MuJoCo by hand", by_hand, slopes),
        _transition(MujocoPoint(point), rest=True),
    ]


def at_point(point: Point) -> list[Method]:
    return [_transition(MujocoPoint(point), rest=False)]


def _transition(here: MujocoPoint, *, rest: bool) -> Method:
    model, data, order, nv = here.model, here.data, here.order, here.nv
    A, B = np.zeros((2 * nv, 2 * nv)), np.zeros((2 * nv, nv))
    if rest:
        here.qvel[:] = here.ctrl[:] = 0.0

    def call() -> None:
        data.qpos[:], data.qvel[:], data.ctrl[:] = here.qpos, here.qvel, here.ctrl
        mujoco.mjd_transitionFD(model, data, DIFFERENCE, False, A, B, None, None)

    def slopes() -> Array:
        # One step of Euler: v+ = v + h a(q, v, u), so that the rows of v+ hold a's slopes.
        lower = A[nv:] / STEP
        by_q, by_v = lower[:, :nv], lower[:, nv:] - np.eye(nv) / STEP
        by_u = B[nv:, here.inputs] / STEP
        blocks = (by_q[:, order], by_v[:, order], by_u)
        return np.hstack([block[order] for block in blocks])

    return Method("MuJoCo mjd_transitionFD", call, slopes, tolerance=1e-3)
