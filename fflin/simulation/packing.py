"""A plan as the arrays that the compiled loop reads."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fflin.base.rotation import conjugate, product_matrix, quaternion_product, rotation_matrix
from fflin.base.validation import Array
from fflin.control.output_feedback import OutputFeedback, measured_states
from fflin.control.policies import StateFeedback
from fflin.control.tracking import TrajectoryFeedback
from fflin.dynamics.state import StateMap
from fflin.kernel import channel, course, forward, laws, loop, tracking
from fflin.kernel.accelerations import layout_of, loads_of
from fflin.kernel.tree import Tree
from fflin.robot.frames import ROOT
from fflin.simulation.conservation import Conserved, Course
from fflin.simulation.plan import LARGEST_SPEED, Plan
from fflin.simulation.plant import Plant
from fflin.simulation.times import LARGEST_TURN


class Seen:
    """The world as seen from the reference, in which the kernel has the base, and back.

    Momentum and centre of mass are those of `Conserved`.
    """

    def __init__(self, state: StateMap) -> None:
        self._state, self._origin = state, state.origin
        self._R = state.reference.rotation
        self._root = state.robot.model.jointPlacements[ROOT].translation

    def from_reference(self, q: Array) -> Array:
        """Return q (nq,) with the base as seen from the reference."""
        seen = q.copy()
        seen[:3] = self._state.positions(q)
        seen[3:7] = quaternion_product(self._state.origin_quaternion, q[3:7])
        return seen

    def in_world(self, q: Array) -> Array:
        """Return rows q (N, nq) in Pinocchio's coordinates."""
        if self._origin.isIdentity(0.0):
            return q
        rows = q.copy()
        rows[:, :3] = (q[:, :3] - self._origin.translation) @ self._origin.rotation
        rows[:, 3:7] = q[:, 3:7] @ product_matrix(conjugate(self._state.origin_quaternion)).T
        return rows

    def vector(self, a: Array) -> Array:
        """Return a vector (3,) of the world in reference axes."""
        turned: Array = a @ self._R
        return turned

    def kept(self, momentum: Array, center: Array) -> Array:
        """Return momentum (6,) and centre of mass (3,), together in reference axes."""
        p, angular = np.split(momentum, 2)
        turned = p, angular - np.cross(self._root, p), center - self._root
        return np.concatenate([self.vector(each) for each in turned])

    def kept_in_world(self, kept: Array) -> tuple[Array, Array]:
        """Return rows (N, 6) of momentum and (N, 3) of the centre of mass."""
        p, angular, center = (part @ self._R.T for part in np.split(kept, 3, axis=1))
        return np.hstack((p, angular + np.cross(self._root, p))), center + self._root


class Packed(NamedTuple):
    """What `kernel.loop.advance` takes, but for the slice of the run and its rows."""

    robot: forward.Mechanics
    method: loop.Method
    law: laws.Law
    channel: channel.Channel
    course: tuple[course.Course, bool, bool]
    watch: loop.Watch
    point: forward.Point
    stages: loop.Stages


def packed(plan: Plan, plant: Plant, conserved: Conserved, tree: Tree) -> Packed:
    """Return a plan, whose policy and method the kernel knows, as arrays of its own."""
    seen, h, state = Seen(plant.state), plan.times.dt, plant.state
    size = 6 + state.robot.n
    way, speed = plan.method.shares(h)
    method = loop.Method(
        h,
        np.array(plan.method.origins),
        way.ravel(),
        speed.ravel(),
        h * np.array(plan.method.nodes),
        h * np.array(plan.method.weights),
        h * h * np.array(plan.method.moments),
        bool(way[-1].any()),
    )
    q, start = seen.from_reference(plan.q), Course(conserved, plan.method, h, plan.q, plan.v)
    kept = course.Course(
        np.append(seen.kept(start.momentum, start.center(0.0)), q[:3]),
        conserved.mass * seen.vector(np.array(state.robot.gravity)),
        np.array([1.0 / conserved.mass]),
        np.zeros(course.SUMS),
    )
    turning = np.zeros(state.robot.nv)
    turning[plan.turning] = 1.0
    squares = np.where(state.velocities(turning), (LARGEST_TURN / h) ** 2, LARGEST_SPEED**2)
    sign = float(np.sign(plan.chart.scalar(plan.q))) if plan.chart else 0.0
    u = plan.initial
    return Packed(
        _mechanics(plant, tree),
        method,
        _law(plan, plant),
        _channel(plan, plant),
        (kept, plan.project, not plant.isolated(driven=plan.law is not None)),
        loop.Watch(squares, np.array([sign])),
        forward.Point(q, state.velocities(plan.v), u.copy(), u.copy()),
        loop.Stages(np.zeros(speed.shape[1] * size), np.zeros(size), q.copy(), q.copy(), u.copy()),
    )


def _mechanics(plant: Plant, tree: Tree) -> forward.Mechanics:
    robot, actuation = plant.robot, plant.actuation
    fixed, springs = actuation.fixed, robot.springs
    loads = loads_of(robot, actuation, tree)
    return forward.Mechanics(
        tree,
        layout_of(tree, len(loads.input)),
        loads,
        Seen(plant.state).vector(np.array(robot.gravity)),
        np.array([joint.idx_q for joint in robot.joints], dtype=np.intp),
        np.array([joint.unbounded for joint in robot.joints], dtype=bool),
        np.array((springs.stiffness != 0.0) | (springs.damping != 0.0), dtype=bool),
        np.array(springs.rest),
        np.where(fixed.any(axis=0), np.abs(fixed).argmax(axis=0), -1).astype(np.intp),
        np.array([held.columns.start for held in actuation.held], dtype=np.intp),
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
    policy, state, seen = plan.policy, plant.state, Seen(plant.state)
    none, nowhere, size, nu = np.zeros(0), np.zeros(0, dtype=np.intp), state.nx // 2, plan.initial
    point = forward.Point(plan.q.copy(), np.zeros(size), nu.copy(), none)
    path = tracking.Path(
        *(none, none, none, none, none, False, False, nowhere, 0.0, none, none, 1),
        *(np.zeros(size), np.zeros(state.nx), point),
    )
    if not isinstance(policy, TrajectoryFeedback):
        return path
    motion, schedule = policy.trajectory, policy.schedule
    way, speed = (state.velocities(each).ravel() for each in motion.flow.cubics)
    q, u = list(motion.q), list(motion.u)
    steps, dt = plan.times.steps, plan.times.dt
    ends = max(steps * dt, (steps - 1) * dt + dt) > policy.duration
    held = np.array([each.columns.start for each in motion.flow.held], dtype=np.intp)
    if ends:
        q.append(policy.end.q)
        u.append(policy.end.u0.copy())
        speed = np.append(speed, state.velocities(policy.end.v))
        for at in held:
            u[-1][at : at + 3] = rotation_matrix(q[-1][3:7]) @ u[-1][at : at + 3]
    pieces = schedule.K[:, None] if schedule.dt else schedule.quartics
    return path._replace(
        t=np.array(motion.t),
        q=np.concatenate([seen.from_reference(each) for each in q]),
        u=np.concatenate(u),
        way=way,
        speed=speed,
        hold=motion.hold == "previous",
        ends=bool(ends),
        held=held,
        last=float(schedule.t[-1] - schedule.t[0]),
        starts=np.array(schedule.starts),
        K=np.array(pieces).ravel(),
        order=pieces.shape[1],
    )


def _channel(plan: Plan, plant: Plant) -> channel.Channel:
    limits, times, names = plan.limits, plan.times, list(plant.state.names)
    w, pulses = limits.wheels, limits.pulses and limits.pulses()
    none, nowhere = np.zeros(0), np.zeros(0, dtype=np.intp)
    wheels = channel.Wheels(nowhere, nowhere, none, none, none, none, none)
    if w is not None:
        first = plant.state.groups.omega_b.start
        rows = [names.index(f"qdot_m.{name}") - first for name in w.names]
        wheels = channel.Wheels(
            np.array(w.at, dtype=np.intp),
            np.array(rows, dtype=np.intp),
            *(np.array(each, dtype=float) for each in (*w.torques, *w.limits, w.stiffness)),
        )
    fired = channel.Pulses(nowhere, none.astype(bool), none, none, none, none, none, none, 1.0)
    if pulses is not None:
        most, least, quantum = (
            np.array(each, dtype=float) for each in (pulses.most, pulses.least, pulses.quantum)
        )
        at, on_off = np.array(pulses.places, dtype=np.intp), np.array(pulses.on_off, dtype=bool)
        left, level, end = np.zeros((3, len(at)))
        fired = channel.Pulses(
            at, on_off, most, least, quantum, left, level, end, float(pulses.time)
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
        fired,
    )
