"""Conversion of a plan into the arrays of the compiled loop."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array
from fflin.control.channel import channel_of
from fflin.control.linear_controller import LinearController
from fflin.control.policies import Allocation, Gridded, Sample, StateFeedback, decider, measured_at
from fflin.control.tracking import AT_THE_END, TrajectoryFeedback, TrajectoryOutputFeedback
from fflin.dynamics.state import StateMap
from fflin.kernel import allocation, forward, loop, policies
from fflin.kernel.tree import batch_tree, empty
from fflin.robot.fields import input_limits, limits_of
from fflin.robot.joints import ROOT, find_frame
from fflin.simulation.plan import Plan
from fflin.simulation.run import Plant

SLOTS = 128  # number of samples whose noise is stored, and of steps in a slice of a campaign


def packed(plan: Plan, stop: loop.StopConditions, *, noisy: bool = False) -> loop.Arguments:
    """Return the arguments of `kernel.loop.advance` for a plan that the kernel supports.

    `stop` has rates in the order of v. The law has room for noise if it is `noisy`.
    """
    plant, times, method, u = plan.plant, plan.times, plan.method, plan.initial
    h, state = times.dt, plant.state
    size, (shift, speed) = 6 + state.robot.n, method.step_weights(h)
    mechanics = mechanics_of(plant)
    # Commands that would act only after the end of the run need no space in the delay line.
    channel = channel_of(plan.limits, u, times.sample, min(times.delay, times.steps))
    return loop.Arguments(
        robot=mechanics,
        method=loop.Method(
            h=h,
            origin=method.origins,
            shift=shift.ravel(),
            speed=speed.ravel(),
            nodes=np.minimum(np.array(method.nodes) * h, plan.last_node * h),
            weights=np.array(method.weights) * h,
            moments=h * (np.array(method.moments) * h),
        ),
        law=_law(plan, mechanics, noisy),
        channel=channel._replace(delay=[float(times.delay)]),
        # The loop writes these at its start.
        reference=forward.MomentumReference(*map(np.zeros, (12, 3, 1, forward.SUMS))),
        project=plan.project,
        pushed=not plant.isolated(driven=plan.law is not None),
        stop=stop._replace(squares=state.velocities(stop.squares)),
        point=forward.Point(
            q=plan.q, nu=state.velocities(plan.v), u=u, pushing=u, wrench=np.zeros(6)
        ),
        stages=loop.Stages(
            rates=np.zeros(speed.shape[1] * size),
            along=np.zeros(size),
            first=plan.q,
            second=plan.q,
            u=u,
        ),
    )


def mechanics_of(plant: Plant) -> forward.Mechanics:
    """Return the kernel's parameters of a robot."""
    robot, actuation, tree = plant.robot, plant.actuation, batch_tree(plant.robot)
    springs = robot.springs
    assert tree is not None
    return forward.Mechanics(
        tree=tree,
        gravity=list(robot.gravity),
        index=[joint.idx_q for joint in robot.joints],
        circling=[joint.unbounded for joint in robot.joints],
        scale=[joint.scale for joint in robot.joints],
        springy=(springs.stiffness != 0.0) | (springs.damping != 0.0),
        rest=springs.rest,
        held=[held.start for held in actuation.held],
        triads=plant.triads,
        origin=pin.SE3ToXYZQUAT(plant.state.origin),
        faults=plant.faults,
    )


def no_law(state: StateMap, u: Array) -> policies.Law:
    """Return a law that gives no commands; it only computes states and errors."""
    law = empty(policies.LAW)
    q, nu = np.zeros(state.robot.nq), np.zeros(state.nx // 2)
    point = law.path.point._replace(q=q, nu=nu, u=np.zeros(len(u)))
    return law._replace(
        kind=policies.NOTHING,
        turned=list(state.axes),
        origin=pin.SE3ToXYZQUAT(state.origin),
        near=np.zeros(state.robot.n),
        x=np.zeros(state.nx),
        u=u,
        path=law.path._replace(along=np.zeros(len(nu)), e=np.zeros(state.nx), point=point),
    )


def _law(plan: Plan, mechanics: forward.Mechanics, noisy: bool) -> policies.Law:
    """Return the law of a plan's policy; with an allocation, of the robot `asking`."""
    asking, policy, state = plan.plant, decider(plan.policy), plan.plant.state
    if isinstance(plan.policy, Allocation):
        asking = Plant(StateMap(plan.policy.design, reference=state.reference, frame=state.frame))
    law = no_law(state, np.zeros(len(asking.actuation.names)))
    if isinstance(plan.policy, Allocation):
        law = law._replace(allocation=_allocation(plan.plant, asking, mechanics))
    if isinstance(policy, LinearController | TrajectoryOutputFeedback):
        law = _filtered(law, plan, policy, asking, mechanics)
    elif isinstance(policy, TrajectoryFeedback):
        law = law._replace(kind=policies.TRACK, path=_path(law.path, plan, policy, asking.state))
    elif isinstance(policy, StateFeedback | Gridded):
        law = law._replace(kind=policies.LINEAR, measured=np.arange(state.nx))
        x0 = policy.lin.x0
        direct, grid = law.filter, law.grid
        if isinstance(policy, StateFeedback):
            K, offset, x0 = policy.terms(state)
            direct = direct._replace(D=-K.ravel(), u0=offset, y0=np.zeros(state.nx))
        else:
            grid = _grid(policy, state.robot.joint_names)
        law = law._replace(filter=direct, grid=grid, near=x0[state.groups.q_m].copy())
    size, slots = len(law.measured), SLOTS if noisy or plan.noise else 1
    return law._replace(y=np.zeros(size), added=np.zeros(slots * size))


def _grid(policy: Gridded, joints: tuple[str, ...]) -> policies.Grid:
    axes, gains = policy.table()
    sizes = [len(values) for values in axes.values()]
    return policies.Grid(
        joint=[joints.index(name) for name in axes],
        first=np.cumsum([0, *sizes]),
        values=np.concatenate(list(axes.values())),
        stride=[np.prod(sizes[axis + 1 :]) for axis in range(len(sizes))],
        K=gains.ravel(),
        offset=(policy.lin.u0 + gains @ policy.lin.x0).ravel(),
        at=np.zeros(len(sizes)),
    )


def _filtered(
    law: policies.Law,
    plan: Plan,
    policy: LinearController | TrajectoryOutputFeedback,
    asking: Plant,
    mechanics: forward.Mechanics,
) -> policies.Law:
    """Return the law of a compensator, with one row of its matrices for each sample."""
    state, times, rows = asking.state, plan.times, 1
    loop = policy.bind(asking.robot)
    if isinstance(policy, TrajectoryOutputFeedback):
        rows = min(len(policy.filter.A) + 2, -(-times.steps // times.sample))
    samples = [loop.sample(k * times.sample * times.dt) for k in range(rows)]
    _, charts, near = zip(*samples, strict=True)
    nz, stages = len(samples[0][0].A), 1 if times.sample else 1 + len(plan.method.nodes)
    terms = [by._replace(jump=np.broadcast_to(by.jump, nz)) for by, *_ in samples]
    compensator = {
        key: np.concatenate([getattr(by, key).ravel() for by in terms]) for key in Sample._fields
    }
    measured, gyros = measured_at(state)
    frames = [find_frame(asking.robot.model, gyro.frame) for gyro in gyros]
    axes = mechanics.tree.axes
    turns = [axes[f.joint - ROOT].T @ f.placement.rotation for f in frames]
    return law._replace(
        kind=policies.LINEAR,
        origin=np.concatenate([pin.SE3ToXYZQUAT(chart.origin) for chart in charts]),
        near=np.concatenate([x[state.groups.q_m] for x in near]),
        filter=policies.Filter(**compensator, z=np.zeros(nz), rates=np.zeros(stages * nz)),
        measured=measured,
        gyros=[frame.joint - ROOT for frame in frames],
        gyro_axes=np.array([turn.ravel("F") for turn in turns]).ravel(),
        x=np.zeros(state.nx + 3 * len(gyros)),
    )


def _allocation(plant: Plant, asking: Plant, giving: forward.Mechanics) -> allocation.Allocation:
    """Return the allocation of commands for the robot `asking` to inputs of the robot `giving`."""
    asks, size = mechanics_of(asking), plant.state.nx // 2
    least, most = input_limits(plant.robot, limits_of(plant.robot))
    point = empty(forward.POINT)._replace(
        q=np.zeros(plant.robot.nq), pushing=np.zeros(len(asking.actuation.names))
    )
    return allocation.Allocation(
        asking=asks,
        giving=giving,
        point=point,
        work=np.zeros(max(asks.tree.size, giving.tree.size)),
        problem=allocation.least_squares(least, most, size),
    )


def _path(
    path: policies.Path, plan: Plan, policy: TrajectoryFeedback, state: StateMap
) -> policies.Path:
    """Return a trajectory and its gains; if it ends before the run, with the rest at its end."""
    motion, schedule = policy.trajectory, policy.schedule
    shift, speed = (state.velocities(each).ravel() for each in motion.cubics)
    q, u, held = list(motion.q), list(motion.u), [each.start for each in motion.actuation.held]
    ends = plan.times.steps * plan.times.dt > policy.duration * AT_THE_END
    pieces = schedule.K if schedule.dt else schedule.pieces
    pieces = pieces.reshape(len(schedule.starts), -1, len(u[0]) * state.nx)
    if ends:
        last = np.zeros_like(pieces[:1])
        last[0, 0] = policy.end_gain.ravel()
        pieces = np.concatenate((pieces, last))
        q.append(policy.end.q)
        u.append(policy.end.u0.copy())
        speed = np.append(speed, state.velocities(policy.end.v))
        for at in held:
            u[-1][at : at + 3] = rotation_matrix(q[-1][3:7]) @ u[-1][at : at + 3]
    return path._replace(
        t=motion.t,
        q=np.concatenate(q),
        u=np.concatenate(u),
        shift=shift,
        speed=speed,
        hold=motion.hold == "previous",
        ahead=policy.ahead,
        ends=bool(ends),
        held=held,
        over=policy.over,
        last=float(schedule.t[-1] - schedule.t[0]),
        starts=schedule.starts,
        K=pieces.ravel(),
        order=pieces.shape[1],
    )
