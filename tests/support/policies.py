"""Policies of all kinds for any robot, as (robot, policy, options of simulate)."""

from dataclasses import replace

import numpy as np

import fflin
from tests.support.motions import displaced

SAMPLE = 0.1
MEASURED = (
    *(fflin.Gyroscope("base"), fflin.BasePose()),
    *(fflin.JointPositions(), fflin.JointVelocities()),
)
JETS = [
    fflin.Thruster("base", place, way, f"jet_{k}", max=most)
    for k, (place, way, most) in enumerate(
        (np.roll(place, axis), np.roll(way, axis), most)
        for axis in range(3)
        for place, way, most in (
            *(
                ((0.0, side, 0.0), (way, 0.0, 0.0), 0.5)
                for side in (-1.0, 1.0)
                for way in (-1, 1)
            ),
            # The same again, and one that there is enough of.
            ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), None),
        )
    )
]


def coarse(values, bits=20):
    """Round to 2^-bits of the largest entry: what differs by rounding alone becomes the same.

    Gains are of LAPACK, whose last digits depend on the processor; motions under them should not.
    """
    values = np.asarray(values)
    unit = 2.0 ** (np.ceil(np.log2(np.abs(values).max())) - bits)
    return np.round(values / unit) * unit


def coarse_cost(P):
    """Round each entry (i, j) of costs (m, nx, nx) relative to the largest P_ii and P_jj.

    Gains between knots are computed from P, whose entries differ in unit by many orders, and whose
    small eigenvalues must survive: so the rounding is finer than that of gains.
    """
    largest = np.sqrt(P.diagonal(axis1=1, axis2=2).max(axis=0))
    units = 2.0 ** np.ceil(np.log2(np.where(largest > 0.0, largest, 1.0)))
    units = np.outer(units, units)
    return coarse(P / units, bits=26) * units


def coarsened(made, *names):
    """Return a design with some of its arrays rounded."""
    by_name = {name: coarse_cost if name == "P" else coarse for name in names}
    return replace(made, **{name: by_name[name](getattr(made, name)) for name in names})


def motors(robot):
    return [
        fflin.JointTorque(name)
        for name in robot.joint_names
        if name not in robot.passive
    ]


def plain(robot):
    robot = robot.replace(inputs=[fflin.BaseForce()])
    return robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce(), *motors(robot)])


def seen(robot):
    """With gyroscopes on the base and on the last link."""
    more = [fflin.Gyroscope(name) for name in robot.joint_names[-1:]]
    return robot.replace(outputs=(*more, *MEASURED) if robot.n else MEASURED[:2])


def noise(t):
    return 1e-3 * np.sin(np.arange(100.0) * (1.0 + t))


def state(robot):
    lin = fflin.linearize(robot)
    return robot, fflin.StateFeedback(lin, coarse(fflin.lqr(lin).K)), {}


def between_gains(robot):
    """Over two joints where there are, of which one may go round."""
    names = [joint.name for joint in robot.joints][:2]
    axes = {names[0]: [-0.3, 0.1, 0.2, 0.4]} | {name: [-0.2, 0.3] for name in names[1:]}
    batch = fflin.sweep(robot, fflin.grid(robot, axes))
    lin = fflin.linearize(robot)
    controller = fflin.lqr(lin)
    gains = fflin.lqr_batch(batch, controller.Q, controller.R)
    # So that they differ more.
    sizes = 1.0 + 0.1 * np.arange(len(gains))[:, None, None]
    return (
        robot,
        fflin.ScheduledFeedback(lin, replace(gains, K=coarse(sizes * gains.K))),
        {},
    )


def compensated(robot, dt=SAMPLE):
    robot = seen(robot)
    lin = fflin.linearize(robot).discretize(dt)
    gain = fflin.lqr(lin)
    controller = fflin.lqg(gain, fflin.kalman(lin, 1e-3, 1e-4))
    return robot, lin, coarsened(controller, "A", "B", "C")


def outputs(robot):
    robot, lin, controller = compensated(robot)
    size = len(lin.output_names)
    return (
        robot,
        fflin.OutputFeedback(lin, controller, lambda t: noise(t)[:size]),
        {"dt": 0.01},
    )


def controlled(robot):
    """A continuous law with a direct term: a filtered estimate, and the rates of it damped."""
    robot = seen(robot)
    lin = fflin.linearize(robot)
    controller = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-3, 1e-2))
    damping = -0.05 * np.linalg.pinv(lin.B) @ np.linalg.pinv(lin.C)
    return (
        robot,
        fflin.LinearController(
            (*map(coarse, (controller.A, controller.B, controller.C, damping)),), lin
        ),
        {},
    )


def controlled_in_samples(robot):
    robot, policy, _ = controlled(robot)
    sampled = policy.sampled(SAMPLE)
    size = len(policy.lin.output_names)
    return robot, replace(sampled, noise=lambda t: noise(t)[:size]), {"dt": 0.01}


def path(robot):
    """A slew that others follow, turned and moved from where they begin.

    A joint that goes round turns by more than half a turn.
    """
    _, policy, _ = state(robot)
    x0 = displaced(policy.lin, degrees=50.0)
    if robot.n and robot.joints[0].unbounded:
        q = fflin.configuration(robot, {robot.joint_names[0]: -0.4})
        lin = fflin.linearize(robot, q)
        policy, x0[6] = fflin.StateFeedback(lin, coarse(fflin.lqr(lin).K)), 2.9
    flown = fflin.simulate(
        robot, policy, x0=x0, duration=8.0, dt=SAMPLE, engine="python"
    )
    along = fflin.Trajectory(robot, flown.t, flown.q, flown.v, flown.u, frame="hybrid")
    start = {"x0": None, "q0": flown.q[3], "v0": flown.v[0], "linear": False}
    return fflin.linearize_trajectory(robot, along), start


def followed(robot):
    along, start = path(robot)
    return robot, coarsened(fflin.tvlqr(along), "K", "P"), start


def followed_outputs(robot):
    robot = seen(robot)
    along, start = path(robot)
    gains = coarsened(fflin.tvlqr(along, sample=SAMPLE), "K", "P")
    controller = fflin.tvkalman(along, 1e-3, 1e-4, P0=1e-4, sample=SAMPLE)
    controller = coarsened(controller, "L", "P")
    size = len(controller.output_names)
    return (
        robot,
        fflin.TrajectoryOutputFeedback(
            along, gains, controller, lambda t: noise(t)[:size]
        ),
        start,
    )


def shared(robot):
    design, policy, _ = state(robot)
    robot = design.replace(inputs=[*JETS, *motors(robot)])
    return robot, fflin.Allocation(policy, design), {"sample": SAMPLE, "dt": 0.01}


POLICIES = (
    *(state, between_gains, outputs, controlled, controlled_in_samples),
    *(followed, followed_outputs, shared),
)
