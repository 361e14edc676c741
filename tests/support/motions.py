"""Motions for the tests of pages, made up: any poses and inputs will do for what is drawn."""

import numpy as np
import pinocchio as pin

import fflin
from fflin.dynamics.actuation import Actuation
from fflin.simulation.motion import Motion

HOME = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([0.2, 0.1, -0.3]))


def settling(robot, duration, *, reference=HOME, predicted=False):
    """A motion that settles to the reference's placement with the joints at neutral."""
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
    for each in q:
        robot.follow(each)
    x = np.array([state.to_state(each, np.zeros(robot.nv)) for each in q])
    size = len(actuation.names)
    strength = np.r_[-40, -15, 9, -20, 14, 3, rng.uniform(-5, 5, max(size - 6, 0))][:size]
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
    )
