"""A plan as the arrays that the compiled loop reads."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array
from fflin.control.output_feedback import OutputFeedback, measured_states
from fflin.control.policies import StateFeedback
from fflin.control.saturation import Pulses, Wheels
from fflin.control.tracking import AT_THE_END, TrajectoryFeedback
from fflin.kernel import channel, course, forward, laws, loop, tracking
from fflin.kernel.accelerations import layout_of, loads_of
from fflin.kernel.tree import Tree
from fflin.simulation.conservation import Conserved, Course
from fflin.simulation.plan import LARGEST_SPEED, Plan
from fflin.simulation.plant import Plant
from fflin.simulation.times import LARGEST_TURN


def packed(plan: Plan, plant: Plant, conserved: Conserved, tree: Tree) -> tuple[Any, ...]:
    """Return what `kernel.loop.advance` takes of a plan whose policy and method it knows."""
    h, state, u = plan.times.dt, plant.state, plan.initial
    size, (way, speed) = 6 + state.robot.n, plan.method.shares(h)
    nodes, weights, moments = (
        np.array(each) * h for each in (plan.method.nodes, plan.method.weights, plan.method.moments)
    )
    nodes = np.minimum(nodes, plan.last_node * h)
    origins = np.array(plan.method.origins)
    start = Course(conserved, plan.method, h, plan.q, plan.v)
    kept = course.Course(
        np.concatenate((start.momentum, start.center(0.0), plan.q[:3])),
        conserved.mass * np.array(state.robot.gravity),
        np.array([1.0 / conserved.mass]),
        np.zeros(course.SUMS),
    )
    squares = np.full(state.robot.nv, LARGEST_SPEED**2)
    squares[plan.turning] = (LARGEST_TURN / h) ** 2
    sign = np.sign(plan.chart.scalar(plan.q)) if plan.chart else 0.0
    q, second = plan.q.copy(), plan.q.copy()
    return (
        _mechanics(plant, tree),
        loop.Method(h, origins, way.ravel(), speed.ravel(), nodes, weights, h * moments),
        _law(plan, plant),
        _channel(plan, plant),
        (kept, plan.project, not plant.isolated(driven=plan.law is not None)),
        loop.Watch(state.velocities(squares), np.array([float(sign)])),
        forward.Point(plan.q.copy(), state.velocities(plan.v), u.copy(), u.copy(), np.zeros(6)),
        loop.Stages(np.zeros(speed.shape[1] * size), np.zeros(size), q, second, u.copy()),
    )


def _mechanics(plant: Plant, tree: Tree) -> forward.Mechanics:
    robot, actuation = plant.robot, plant.actuation
    fixed, springs = actuation.fixed, robot.springs
    loads = loads_of(robot, actuation, tree)
    return forward.Mechanics(
        tree,
        layout_of(tree, len(loads.input)),
        loads,
        np.array(robot.gravity),
        np.array([joint.idx_q for joint in robot.joints], dtype=np.intp),
        np.array([joint.unbounded for joint in robot.joints], dtype=bool),
        np.array((springs.stiffness != 0.0) | (springs.damping != 0.0), dtype=bool),
        np.array(springs.rest),
        np.where(fixed.any(axis=0), np.abs(fixed).argmax(axis=0), -1).astype(np.intp),
        np.array([held.columns.start for held in actuation.held], dtype=np.intp),
        pin.SE3ToXYZQUAT(plant.state.origin),
        forward.Drives(*plant.drives),
    )


def _law(plan: Plan, plant: Plant) -> laws.Law:
    state, policy = plant.state, plan.policy
    none, nowhere, joints = np.zeros(0), np.zeros(0, dtype=np.intp), state.groups.q_m
    law = laws.Law(
        *(laws.NOTHING, np.array(state.axes), np.zeros(state.robot.n), none, none),
        *(none, none, none, none, nowhere, np.zeros(state.nx), none, none),
        _path(plan, plant),
    )
    if isinstance(policy, StateFeedback):
        K, offset, near = policy.terms(state)
        law = law._replace(kind=laws.STATE, near=near[joints].copy(), K=K.ravel(), offset=offset)
    if isinstance(policy, OutputFeedback):
        by, lin, count = policy.compensator, policy.lin, len(policy.compensator.A)
        law = law._replace(
            kind=laws.OUTPUT,
            near=state.read(lin.q, lin.v)[joints].copy(),
            offset=np.array(by.u0),
            A=np.array(by.A).ravel(),
            B=np.array(by.B).ravel(),
            C=np.array(by.C).ravel(),
            y0=np.array(by.y0),
            measured=np.array(measured_states(state), dtype=np.intp),
            z=np.zeros(count),
            next=np.zeros(count),
        )
    if isinstance(policy, TrajectoryFeedback):
        law = law._replace(kind=laws.TRACK)
    return law


def _path(plan: Plan, plant: Plant) -> tracking.Path:
    policy, state = plan.policy, plant.state
    none, nowhere, size, nu = np.zeros(0), np.zeros(0, dtype=np.intp), state.nx // 2, plan.initial
    point = forward.Point(plan.q.copy(), np.zeros(size), nu.copy(), none, none)
    path = tracking.Path(
        *(none, none, none, none, none, False, 0.0, False, nowhere, 0.0, 0.0, none, none, 1),
        *(np.zeros(size), np.zeros(state.nx), point),
    )
    if not isinstance(policy, TrajectoryFeedback):
        return path
    motion, schedule = policy.trajectory, policy.schedule
    way, speed = (state.velocities(each).ravel() for each in motion.flow.cubics)
    q, u = list(motion.q), list(motion.u)
    ends = plan.times.steps * plan.times.dt > policy.duration * AT_THE_END
    held = np.array([each.columns.start for each in motion.flow.held], dtype=np.intp)
    nx, gains = state.nx, schedule.passed
    pieces = (schedule.K if schedule.dt else gains.pieces).reshape(
        len(gains.starts), -1, len(nu) * nx
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
        way=way,
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


def _channel(plan: Plan, plant: Plant) -> channel.Channel:
    limits, times, names = plan.limits, plan.times, list(plant.state.names)
    bounds, none = np.zeros((2, 0)), np.zeros(0)
    w = limits.wheels or Wheels([], [], bounds, bounds, none, lambda *_: none)
    first = plant.state.groups.omega_b.start
    rows = [names.index(f"qdot_m.{name}") - first for name in w.names]
    wheels = channel.Wheels(
        *(np.array(each, dtype=np.intp) for each in (w.at, rows)),
        *(np.array(each, dtype=float) for each in (*w.torques, *w.limits, w.stiffness)),
    )
    fired = limits.pulses() if limits.pulses else Pulses([], limits.high, times.sample, times.dt)
    figures, nothing = (fired.most, fired.least, fired.quantum), (np.zeros(len(fired.places)),) * 3
    pulses = channel.Pulses._make(
        (
            *(np.array(fired.places, dtype=np.intp), np.array(fired.on_off, dtype=bool)),
            *(np.array(each, dtype=float) for each in (*figures, *nothing)),
            fired.time,
        )
    )
    held: Array = np.minimum(np.maximum(plan.initial, limits.low), limits.high)
    slots = times.delay // times.sample + 1 if times.sample else 1
    return channel.Channel(
        np.array(limits.low),
        np.array(limits.high),
        held,
        np.zeros(slots * len(held)),
        slots,
        times.sample,
        times.delay,
        wheels,
        pulses,
    )
