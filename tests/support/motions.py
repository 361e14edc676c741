"""Motions that several test files share, and what starts them."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import fflin
from fflin.dynamics.aba import Aba
from fflin.dynamics.state import Actuation
from fflin.simulation.motion import Motion
from tests.support.robots import random_point
from tests.support.weights import unit_weights

HOME = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([0.2, 0.1, -0.3]))


def settling(robot, duration, *, reference=HOME, predicted=False):
    """A motion that settles to the reference's placement with the joints at neutral.

    Made up: any poses and inputs will do for what is drawn.
    """
    state = fflin.StateMap(robot, reference=reference)
    actuation = Actuation(state)
    t = np.linspace(0, duration, 2001)
    rng = np.random.default_rng(0)
    v = np.r_[0.3, -0.2, 0.1, 0.5, 0.2, -0.1, rng.uniform(-0.7, 0.7, robot.nv - 6)]
    target = np.zeros(state.nx)
    home = state.to_pinocchio(target)[0]
    home[7:] = robot.neutral()[7:]
    decay = np.exp(-t / 5)
    q = [pin.integrate(robot.model, home, s * v) for s in decay]
    for item in q:
        robot.follow(item)
    x = np.array([state.to_state(item, np.zeros(robot.nv)) for item in q])
    size = len(actuation.names)
    strength = np.r_[-40, -15, 9, -20, 14, 3, rng.uniform(-5, 5, max(size - 6, 0))][
        :size
    ]
    u = np.outer(decay, strength)
    if "thrust" in actuation.groups:
        u = np.abs(u)
    return Motion(
        t=t,
        q=np.array(q),
        v=np.zeros((len(t), robot.nv)),
        x=x,
        u=u,
        target=state.to_state(home, np.zeros(robot.nv)),
        prediction=0.9 * x if predicted else np.zeros((0, state.nx)),
        energy=np.zeros(len(t)),
        momentum=np.zeros((len(t), 6)),
        momentum_drift=np.full(len(t), 1e-13),
        placement=pin.SE3ToXYZQUAT(reference),
        state_names=state.names,
        input_names=actuation.names,
        state_units=state.units,
        input_units=actuation.units,
        frame="hybrid",
        robot=robot.name,
        urdf_sha256=robot.urdf_sha256,
        stopped="",
        wheels=tuple(robot.wheels),
        wheel_inertias=np.array(list(robot.wheels.values())),
        modes=tuple(joint.name for joint in robot.modes),
        mode_rotations=np.array([joint.rotation for joint in robot.modes]),
    )


def led(motion, rows=250):
    """The motion as one that follows what it does itself so many rows later."""
    ahead = np.minimum(np.arange(len(motion.t)) + rows, len(motion.t) - 1)
    return replace(motion, target=motion.x[ahead])


def motion(robot, start=None, duration=0.4, knots=81):
    """A motion of the robot under inputs that change slowly, to 1e-10."""
    q0, v0, u0 = random_point(robot, np.random.default_rng(1))
    v0 = 0.3 * v0
    if start is not None:
        q0, v0 = start
    state = fflin.StateMap(robot, frame="local")
    aba = Aba(state)
    t = np.linspace(0.0, duration, knots)

    def inputs(time):
        return 0.1 * u0 * np.cos(3 * time)

    def rate(time, y):
        # In the tangent at the beginning of each interval the motion is short: no singularity.
        q = pin.integrate(robot.model, rate.q, y[: robot.nv])
        v = y[robot.nv :]
        slope = pin.dDifference(robot.model, rate.q, q, pin.ArgumentPosition.ARG1) @ v
        return np.concatenate((slope, aba.acceleration(q, v, inputs(time))))

    q, v = [q0], [v0]
    for before, after in pairwise(t):
        rate.q = q[-1]
        y = solve_ivp(
            rate,
            (before, after),
            np.concatenate((np.zeros(robot.nv), v[-1])),
            rtol=1e-11,
            atol=1e-12,
        ).y[:, -1]
        q.append(pin.integrate(robot.model, q[-1], y[: robot.nv]))
        v.append(y[robot.nv :])
    return t, np.array(q), np.array(v), np.array([inputs(time) for time in t])


def regulated(name, **fields):
    robot = fflin.load(name, **fields)
    lin = fflin.linearize(robot)
    return robot, lin, fflin.lqr(lin, *unit_weights(lin))


def displaced(lin, degrees=30.0, offset=0.5, spread=0.3):
    """A state that is turned, moved and bent from the point."""
    n = len(lin.x0) // 2 - 6
    x = lin.x0.copy()
    x[:3] = math.sin(math.radians(degrees) / 2.0) * np.array([2.0, -1.0, 2.0]) / 3.0
    x[3:6] = offset * np.array([1.0, 2.0, -2.0]) / 3.0
    x[6 : 6 + n] += spread
    return x


def strong_thrusters():
    """The thrusters of the cubesat, each as strong as it is asked to be."""
    inputs = fflin.load_inputs("cubesat")
    return [replace(x, max=None) for x in inputs if isinstance(x, fflin.Thruster)]


def swung(robot, duration=4.0, *, size=0.1, spin=0.0, sample=None):
    """A motion under joint torques that swing, and come to nothing at the end."""
    nu = len(fflin.linearize(robot).u0)

    def policy(t, q, v):
        return size * np.sin(2.0 * np.pi * t / duration) * np.cos(np.arange(nu))

    v0 = np.zeros(robot.nv)
    v0[3:6] = spin
    return fflin.simulate(
        robot, policy, v0=v0, duration=duration, dt=0.01, frame="local", sample=sample
    )


def beside(robot, traj, size, seed=3):
    """A start beside that of a trajectory, by some of the size in every direction."""
    step = size * np.random.default_rng(seed).standard_normal(robot.nv)
    return pin.integrate(robot.model, traj.q[0], step), traj.v[0] + 0.3 * step


def tracked(robot, duration=4.0, *, run=None, off=0.02, size=0.1, **options):
    """A trajectory and a run of the feedback along it that begins beside it."""
    traj = swung(robot, duration, size=size, spin=0.05).trajectory().resampled(0.05)
    schedule = fflin.tvlqr(fflin.linearize_trajectory(robot, traj))
    q0, v0 = beside(robot, traj, off)
    return traj, fflin.simulate(robot, schedule, q0=q0, v0=v0, duration=run, **options)
