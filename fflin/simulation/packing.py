"""Conversion of a plan into the arrays of the compiled loop."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array
from fflin.control.channel import channel_of, input_limits
from fflin.control.linear_controller import LinearController
from fflin.control.policies import Allocation, Gridded, StateFeedback, measured_at
from fflin.control.tracking import AT_THE_END, TrajectoryFeedback, TrajectoryOutputFeedback
from fflin.dynamics.state import StateMap
from fflin.kernel import allocation, forward, loop, policies
from fflin.kernel.arguments import empty
from fflin.kernel.tree import Tree, batch_tree, layout_of, loads_of
from fflin.robot.fields import limits_of
from fflin.robot.joints import ROOT, find_frame
from fflin.simulation.plan import Plan
from fflin.simulation.plant import MomentumReference, Plant, conserved_by, triads
from fflin.simulation.run import stop_conditions

SLOTS = 128  # number of samples whose noise is stored, and of steps in a slice of a campaign


def packed(plan: Plan, plant: Plant) -> loop.Arguments:
    """Return the arguments of `kernel.loop.advance` for a plan that the kernel supports."""
    h, state, method = plan.times.dt, plant.state, plan.method
    tree, conserved = batch_tree(plant.robot), conserved_by(plant.robot, plan.q, plant.field)
    assert tree is not None
    size, (shift, speed) = 6 + state.robot.n, method.step_weights(h)
    start = MomentumReference(conserved, method, h, plan.q, plan.v)
    stop = stop_conditions(plan)
    mechanics = mechanics_of(plant, tree)
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
        law=_law(plan, plant, mechanics),
        # Commands that would act only after the end of the run need no space in the delay line.
        channel=channel_of(
            plan.limits, plan.initial, plan.times.sample, min(plan.times.delay, plan.times.steps)
        )._replace(delay=[float(plan.times.delay)]),
        reference=forward.MomentumReference(
            start=np.concatenate((start.momentum, start.center(0.0), plan.q[:3])),
            weight=conserved.mass * np.array(state.robot.gravity),
            per_mass=[1.0 / conserved.mass],
            sums=np.zeros(forward.SUMS),
        ),
        project=plan.project,
        pushed=not plant.isolated(driven=plan.law is not None),
        stop=stop._replace(squares=state.velocities(stop.squares)),
        point=forward.Point(
            q=plan.q,
            nu=state.velocities(plan.v),
            u=plan.initial,
            pushing=plan.initial,
            wrench=np.zeros(6),
        ),
        stages=loop.Stages(
            rates=np.zeros(speed.shape[1] * size),
            along=np.zeros(size),
            first=plan.q,
            second=plan.q,
            u=plan.initial,
        ),
    )


def mechanics_of(plant: Plant, tree: Tree) -> forward.Mechanics:
    """Return the kernel's parameters of a robot."""
    robot, actuation = plant.robot, plant.actuation
    fixed, springs = actuation.fixed, robot.springs
    loads = loads_of(robot, actuation, tree)
    return forward.Mechanics(
        tree=tree,
        layout=layout_of(tree, len(loads.input)),
        loads=loads,
        gravity=np.array(robot.gravity),
        index=_places([joint.idx_q for joint in robot.joints]),
        circling=np.array([joint.unbounded for joint in robot.joints], dtype=bool),
        scale=np.array([joint.scale for joint in robot.joints]),
        springy=np.array((springs.stiffness != 0.0) | (springs.damping != 0.0), dtype=bool),
        rest=np.array(springs.rest),
        row=_places(np.where(fixed.any(axis=0), np.abs(fixed).argmax(axis=0), -1)),
        held=_places([held.start for held in actuation.held]),
        triads=_places(triads(actuation)),
        origin=pin.SE3ToXYZQUAT(plant.state.origin),
        faults=plant.faults,
    )


def _law(plan: Plan, plant: Plant, mechanics: forward.Mechanics) -> policies.Law:
    state, policy, asking = plant.state, plan.policy, plant
    shared = isinstance(policy, Allocation)
    if shared:
        asking = Plant(StateMap(policy.design, reference=state.reference, frame=state.frame))
        policy = policy.policy
    law = no_law(state, np.zeros(len(asking.actuation.names)))
    law = law._replace(path=_path(law.path, plan, policy, asking))
    if shared:
        law = law._replace(allocation=_allocation(plant, asking, mechanics))
    if isinstance(policy, StateFeedback):
        K, offset, near = policy.terms(state)
        direct = law.filter._replace(D=-K.ravel(), u0=offset, y0=np.zeros(state.nx))
        law = law._replace(near=near[state.groups.q_m].copy(), filter=direct)
    elif isinstance(policy, Gridded):
        law = _between(law, policy, state)
    elif isinstance(policy, LinearController | TrajectoryOutputFeedback):
        law = _filtered(law, plan, policy, asking, mechanics.tree)
    elif isinstance(policy, TrajectoryFeedback):
        law = law._replace(kind=policies.TRACK)
    if isinstance(policy, StateFeedback | Gridded):
        law = law._replace(kind=policies.LINEAR, measured=np.arange(state.nx))
    size, slots = len(law.measured), SLOTS if noise_of(plan) else 1
    return law._replace(y=np.zeros(size), added=np.zeros(slots * size))


def no_law(state: StateMap, u: Array) -> policies.Law:
    """Return a law that gives no commands; it only computes states and errors."""
    law = empty(policies.LAW)
    q, nu = np.zeros(state.robot.nq), np.zeros(state.nx // 2)
    point = law.path.point._replace(q=q, nu=nu, u=np.zeros(len(u)))
    return law._replace(
        kind=policies.NOTHING,
        turned=np.array(state.axes),
        origin=pin.SE3ToXYZQUAT(state.origin),
        near=np.zeros(state.robot.n),
        x=np.zeros(state.nx),
        u=u,
        path=law.path._replace(along=np.zeros(len(nu)), e=np.zeros(state.nx), point=point),
    )


def noise_of(plan: Plan) -> Any:
    """Return the measurement noise(t) of a plan's policy, or None."""
    policy = plan.policy.policy if isinstance(plan.policy, Allocation) else plan.policy
    known = isinstance(policy, LinearController | TrajectoryOutputFeedback)
    return policy.noise if known else None


def _between(law: policies.Law, policy: Gridded, state: StateMap) -> policies.Law:
    axes, gains = policy.table()
    x0, joints = policy.lin.x0, state.robot.joint_names
    sizes = [len(values) for values in axes.values()]
    grid = policies.Grid(
        joint=_places([joints.index(name) for name in axes]),
        first=_places(np.cumsum([0, *sizes])),
        values=np.concatenate(list(axes.values())),
        stride=_places([np.prod(sizes[axis + 1 :]) for axis in range(len(sizes))]),
        K=gains.ravel(),
        offset=(policy.lin.u0 + gains @ x0).ravel(),
        at=np.zeros(len(sizes)),
    )
    return law._replace(near=x0[state.groups.q_m].copy(), grid=grid)


def _filtered(
    law: policies.Law, plan: Plan, policy: Any, asking: Plant, tree: Tree
) -> policies.Law:
    state, joints, times = asking.state, asking.state.groups.q_m, plan.times
    loop, rows = policy.bind(asking.robot), 1
    if isinstance(policy, TrajectoryOutputFeedback):
        rows = min(len(policy.filter.A) + 2, -(-times.steps // times.sample))
    samples = [loop.sample(k * times.sample * times.dt) for k in range(rows)]
    nz, stages = len(samples[0][0].A), 1 if times.sample else 1 + len(plan.method.nodes)
    first = samples[0][0]
    compensator = {
        key: np.concatenate(
            [
                np.broadcast_to(getattr(by, key), np.shape(getattr(first, key)) or nz).ravel()
                for by, *_ in samples
            ]
        )
        for key in ("A", "B", "C", "D", "u0", "y0", "jump")
    }
    measured, gyros = measured_at(state)
    frames = [find_frame(asking.robot.model, gyro.frame) for gyro in gyros]
    turns = [tree.axes[f.joint - ROOT].T @ f.placement.rotation for f in frames]
    return law._replace(
        kind=policies.LINEAR,
        origin=np.concatenate([pin.SE3ToXYZQUAT(chart.origin) for _, chart, _ in samples]),
        near=np.concatenate([x[joints] for *_, x in samples]),
        filter=policies.Filter(**compensator, z=np.zeros(nz), rates=np.zeros(stages * nz)),
        measured=_places(measured),
        gyros=policies.Gyros(
            _places([frame.joint - ROOT for frame in frames]),
            np.array([turn.ravel("F") for turn in turns]).ravel(),
        ),
        x=np.zeros(state.nx + 3 * len(gyros)),
    )


def _allocation(plant: Plant, asking: Plant, giving: forward.Mechanics) -> allocation.Allocation:
    """Return the allocation of commands for the robot `asking` to inputs of the robot `giving`."""
    tree = batch_tree(asking.robot)
    assert tree is not None
    size, asks = plant.state.nx // 2, mechanics_of(asking, tree)
    least, most = input_limits(plant.robot, limits_of(plant.robot))
    point = empty(forward.POINT)._replace(
        q=np.zeros(plant.robot.nq), pushing=np.zeros(len(asking.actuation.names))
    )
    return allocation.Allocation(
        asking=asks,
        giving=giving,
        point=point,
        work=np.zeros(max(asks.layout.size, giving.layout.size)),
        problem=allocation.least_squares(least, most, size),
    )


def _path(path: policies.Path, plan: Plan, policy: object, asking: Plant) -> policies.Path:
    state, count = asking.state, len(asking.actuation.names)
    if type(policy) is not TrajectoryFeedback:
        return path
    motion, schedule = policy.trajectory, policy.schedule
    shift, speed = (state.velocities(each).ravel() for each in motion.cubics)
    q, u = list(motion.q), list(motion.u)
    ends = plan.times.steps * plan.times.dt > policy.duration * AT_THE_END
    held = _places([each.start for each in motion.actuation.held])
    nx, gains = state.nx, schedule.interpolant
    pieces = (schedule.K if schedule.dt else gains.pieces).reshape(
        len(gains.starts), -1, count * nx
    )
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
        t=np.array(motion.t),
        q=np.concatenate(q),
        u=np.concatenate(u),
        shift=shift,
        speed=speed,
        hold=motion.hold == "previous",
        ahead=policy.ahead,
        ends=bool(ends),
        held=held,
        over=policy.over,
        last=gains.last - gains.first,
        starts=np.array(gains.starts),
        K=np.array(pieces).ravel(),
        order=pieces.shape[1],
    )


def _places(indices: object) -> Any:
    return np.array(indices, dtype=np.intp)
