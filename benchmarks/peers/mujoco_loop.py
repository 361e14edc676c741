"""MuJoCo in closed loop: RK4, the feedback in Python between the steps or at every stage."""

import mujoco
import numpy as np

from benchmarks.closed_loop import Loop
from benchmarks.contender import Contender
from benchmarks.peers.mujoco_peer import MujocoPoint
from benchmarks.robots import Array

REFUSALS = (ValueError,)


def contenders(loop: Loop) -> list[Contender]:
    """Return the loop in MuJoCo's ways, and its steps without feedback, all of them in C."""
    here = MujocoLoop(loop)
    floor = Contender("MuJoCo, free", loop, here.free)
    held, smooth = loop.but(held=True), loop.but(held=False)
    return [
        Contender("MuJoCo", smooth, here.at_stages, here.end),
        Contender("MuJoCo, held", held, here.between_steps, here.end),
        floor,
    ]


class MujocoLoop:
    """The robot and its feedback in MuJoCo's coordinates, which are those of `hybrid`.

    The gain acts on the quaternion's vector part as it is, whose scalar part stays positive.
    """

    def __init__(self, loop: Loop) -> None:
        if loop.wheels:
            raise ValueError(
                "a wheel is a body without mass, which MuJoCo's URDF does not support"
            )
        self.loop = loop
        here = MujocoPoint(loop.point, motors=False, any_inertia=True)
        self.model, self.data, self.order = here.model, here.data, here.order
        model, n = self.model, 6 + loop.robot.n
        model.opt.integrator, model.opt.timestep = (
            mujoco.mjtIntegrator.mjINT_RK4,
            loop.dt,
        )
        self.places = np.array([4, 5, 6, 0, 1, 2, *here.positions])  # of x in qpos
        self.by_q, self.by_v = (
            np.zeros((model.nv, model.nq)),
            np.zeros((model.nv, model.nv)),
        )
        self.by_q[np.ix_(self.order, self.places)] = -loop.K[:, :n]
        self.by_v[np.ix_(self.order, self.order)] = -loop.K[:, n:]
        self.start(loop.x0)
        self.data.qpos[:] = here.qpos
        mujoco.mj_forward(model, self.data)
        M, unit = np.zeros((model.nv, model.nv)), np.eye(model.nv)
        for column, row in zip(unit, M, strict=True):
            mujoco.mj_mulM(model, self.data, row, column)
        loop.require_same_inertia("MuJoCo", M[np.ix_(self.order, self.order)])

    def start(self, x0: Array) -> None:
        """Let the runs begin at a state (nx,)."""
        n = 6 + self.loop.robot.n
        self.qpos, self.qvel = np.zeros(self.model.nq), np.zeros(self.model.nv)
        self.qpos[3] = np.sqrt(1.0 - x0[:3] @ x0[:3])
        self.qpos[self.places], self.qvel[self.order] = x0[:n], x0[n:]

    def between_steps(self) -> None:
        """Set the input before each step, which holds it."""
        model, data, by_q, by_v = self.model, self.data, self.by_q, self.by_v
        qpos, qvel, force = data.qpos, data.qvel, data.qfrc_applied
        qpos[:], qvel[:] = self.qpos, self.qvel
        step, held, more = mujoco.mj_step, np.zeros(model.nv), np.zeros(model.nv)
        for _ in range(self.loop.steps):
            by_q.dot(qpos, out=held)
            by_v.dot(qvel, out=more)
            np.add(held, more, out=force)
            step(model, data)

    def at_stages(self) -> None:
        """Set the input in MuJoCo's callback, which it asks at each stage of a step."""
        by_q, by_v = self.by_q, self.by_v

        def control(_: object, data: "mujoco.MjData") -> None:
            data.qfrc_applied[:] = by_q @ data.qpos + by_v @ data.qvel

        mujoco.set_mjcb_control(control)
        try:
            self._run()
        finally:
            mujoco.set_mjcb_control(None)

    def free(self) -> None:
        """Step without feedback."""
        self.data.qfrc_applied[:] = 0.0
        self._run()

    def _run(self) -> None:
        self.data.qpos[:], self.data.qvel[:] = self.qpos, self.qvel
        mujoco.mj_step(self.model, self.data, self.loop.steps)

    def end(self) -> Array:
        """Return the last state (nx,)."""
        sign = np.ones(6 + self.loop.robot.n)
        sign[:3] = np.sign(self.data.qpos[3])
        return np.concatenate(
            (sign * self.data.qpos[self.places], self.data.qvel[self.order])
        )
