"""An operating point of a satellite with thrusters, wheels and a watched tool."""

import numpy as np
import pinocchio as pin

import fflin
from benchmarks.peers import WrongResultError
from benchmarks.robots import load
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved

ROBOT = "servicer_7dof"


def run() -> Table:
    rng = np.random.default_rng(0)
    robot = load(ROBOT)
    thrusters = [
        fflin.Thruster(frame, rng.normal(size=3), rng.normal(size=3))
        for frame in ("base", "base", "base", "link_3", "link_5", "panel_left")
        for _ in range(2)
    ]
    wheels = [fflin.ReactionWheel(axis, inertia=0.03) for axis in np.eye(3)]
    watched = [fflin.FramePose("tool"), fflin.FrameVelocity("tool")]
    robot = robot.replace(inputs=[*thrusters, *wheels], outputs=watched)
    model, data = robot.model, robot.create_data()
    q = pin.integrate(model, pin.neutral(model), rng.normal(size=model.nv))
    v, u = rng.normal(size=model.nv), rng.normal(size=len(robot.inputs))
    linearizer = fflin.Linearizer(robot)
    if not fflin.check(robot, linearizer(q, v, u)).ok:
        raise WrongResultError(
            f"fflin on {ROBOT} with thrusters and wheels: check fails"
        )
    a, wrenches = np.zeros(model.nv), pin.StdVec_Force(model.njoints, pin.Force.Zero())
    tool = model.frames[model.getFrameId("tool", pin.FrameType.BODY)]
    carriers = {
        model.frames[model.getFrameId(item.frame)].parentJoint for item in thrusters
    }
    place = tool.parentJoint, tool.placement, pin.ReferenceFrame.LOCAL

    def bare() -> None:
        pin.crba(model, data, q)
        pin.cholesky.decompose(model, data)
        pin.cholesky.computeMinv(model, data)
        pin.computeJointJacobians(model, data, q)
        for joint in carriers:
            pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL)
        pin.nonLinearEffects(model, data, q, v)
        pin.computeRNEADerivatives(model, data, q, v, a, wrenches)
        pin.computeForwardKinematicsDerivatives(model, data, q, v, a)
        for _ in watched:
            pin.getFrameVelocityDerivatives(model, data, *place)
        pin.getFrameVelocity(model, data, *place)

    times = interleaved({"point": lambda: linearizer(q, v, u), "bare": bare})
    own = times["point"]
    return Table(
        "Equipped satellite",
        f"One linearisation of {ROBOT} at an operating point with 12 thrusters on four links, 3 "
        "wheels, and the pose and velocity of the tool as outputs. The columns are the time and "
        "its ratio to the Pinocchio calls in it.",
        ("robot", "n", "fflin [us]", "fflin / Pinocchio calls"),
        (
            (
                ROBOT,
                str(robot.n),
                figure(own.least * 1e6),
                figure(own.ratio(times["bare"])),
            ),
        ),
    )
