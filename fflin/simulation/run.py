"""The Python engine: conserved quantities, and the simulation loop.

Without external forces, the momentum about a fixed point is constant. The centre of mass is then at
r_c(t) = r_c(0) + p t / m, with the linear momentum p and the mass m.

In orbit, the momentum is not constant. The Jacobi integral (14.3) is constant if inputs,
disturbance and dampers do no work. In an elliptic orbit, it changes by (17.3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dposv

from fflin.base.errors import InputError
from fflin.base.process import Progress
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.control.loops import Loop
from fflin.control.policy import BoundLaw
from fflin.dynamics.integrals import integrals
from fflin.dynamics.points import LARGEST_SPEED
from fflin.kernel.loop import StopConditions, goes_on
from fflin.robot.joints import ROOT
from fflin.simulation.lag import ActuatorLag
from fflin.simulation.plan import Plan
from fflin.simulation.plant import LARGEST_TURN, Plant

STOPS = ("", "diverged", "left the chart", "stopped")

_LOOK = 16  # steps between checks of the clock
_LARGEST_SHOWN = 1e3  # [rad] largest rotation per step that a message states

# Function of (t, q, v, u) for the accelerations and the external wrench.
Stage: TypeAlias = Callable[[float, Array, Array, Array], tuple[Array, Array]]

_crba, _placement = pin.crba, pin.XYZQUATToSE3


class Conserved:
    """Prediction of the momentum and the centre of mass from the external impulse.

    `momentum` (6,) consists of the linear momentum and the angular momentum about a fixed point,
    both in world axes. Momentum and centre of mass are advanced step by step from the initial state
    (11.2). In orbit, the first entry of `momentum` is the Jacobi integral, and the work of the
    forces replaces the impulse.
    """

    momentum: Array  # (6,) after the steps so far
    # (6,) about the fixed point at each stage; written by the caller
    wrenches: tuple[Array, ...]

    # The fixed point is the initial position of the base. Far away from the world's origin, angular
    # momentum about the origin would have large rounding errors.

    def __init__(self, plan: Plan) -> None:
        robot = plan.plant.robot
        start = plan.q[:3]
        self._robot = robot
        self._model = robot.model
        self.mass = robot.mass
        self._field, self._stored = plan.plant.field, robot.stored_momentum
        self._data = data = robot.create_data()
        self._M = data.M[:6]  # CRBA writes into this array
        self._M_bb = self._M[:, :6]
        # Subtracted from q[:7], it makes the position of the base relative to the fixed point.
        self._start = np.concatenate((start, np.zeros(4)))
        self._x, self._y, self._z = start.tolist()  # numbers are faster than arrays
        # The free-flyer joint of the model may have a placement other than the identity.
        self._root = robot.model.jointPlacements[ROOT]
        self._weight: Array | None = None
        if any(robot.gravity):
            self._weight = robot.mass * np.array(robot.gravity)
        self._root_is_identity = self._root.isIdentity(0.0)
        start_time = np.zeros(1)
        _, _, center, kept, _ = self.histories(start_time, plan.q[None], plan.v[None])
        self.momentum, self._momentum, self._center = kept[0], kept[0], center[0]
        per_mass = 1.0 / robot.mass
        # The centre of mass at time t is the first column of `_line` plus t times the second. The
        # first column is the initial centre of mass plus the displacement by the external impulse
        # so far. The second column is the initial velocity of the centre of mass.
        self._line = np.column_stack((self._center, self.momentum[:3] * per_mass))
        self._time = np.ones(2)
        # The first row of `_stack` is the external impulse so far (6,). The first three entries of
        # the second row are the displacement of the centre of mass by this impulse. The other rows
        # are the wrenches (6,) at the stages of a step. If no external forces act, all rows are
        # exactly zero.
        method, h = plan.method, plan.times.dt
        self._stack = np.zeros((2 + len(method.weights), 6))
        self._sums = self._stack[:2]
        self.wrenches = tuple(self._stack[2:])
        weights = h * np.array(method.weights)
        moments = h * h * np.array(method.moments)
        self._after = np.array(
            [[1.0, 0.0, *weights], [h * per_mass, 1.0, *(per_mass * moments)]]
        )

    def wrench(self, q: Array, push: Array) -> Array:
        """Return the wrench (6,) about the fixed point in world axes, including the weight.

        `push` (6,) is the wrench about the base, in base axes and without the weight. In orbit,
        return `push` itself, because the Jacobi integral changes by work instead of impulse.
        """
        if self._field:
            return push
        placement = _placement(q[:7] - self._start)  # of the base, from the fixed point
        if not self._root_is_identity:
            placement = self._root * placement
        total: Array = placement.toDualActionMatrix().dot(push)
        if self._weight is not None:
            q_near = q.copy()
            q_near[:7] -= self._start
            com = pin.centerOfMass(self._model, self._data, q_near, False)
            total[:3] += self._weight
            total[3:] += skew(com).dot(self._weight)
        return total

    def advance(self) -> None:
        """Advance momentum and centre of mass by a step with the current `wrenches`."""
        self._sums[:] = impulse, displacement = self._after.dot(self._stack)
        self.momentum = self._momentum + impulse
        self._line[:, 0] = self._center + displacement[:3]

    def center(self, t: float) -> Array:
        """Return the centre of mass (3,) at time t, relative to the fixed point."""
        self._time[1] = t
        center: Array = self._line.dot(self._time)
        return center

    def impose(self, t: float, q: Array, v: Array) -> None:
        """Correct the base position in `q` and the base velocity in `v`.

        After the correction, centre of mass and momentum are equal to their predictions at time t.
        """
        # Set r_b = r_c - R c_b and nu_b = M_bb^-1 (H_b - M_bm qdot_m). Here c_b is the centre of
        # mass and H_b the momentum, both relative to the base and in base axes. The second equation
        # is solved for the correction of nu_b. This correction is small, and therefore has small
        # rounding errors. M is in base axes, and therefore does not depend on the base position.
        momentum = self.momentum
        _crba(self._model, self._data, q)
        if self._stored:
            pin.forwardKinematics(self._model, self._data, q)
            momentum = momentum.copy()
            momentum[3:] -= self._of_wheels()
        base = _placement(q[:7])
        if not self._root_is_identity:
            base = self._root * base
        base.translation = self.center(t)
        # The upper right 3 x 3 block of M_bb is -m [c_b]x.
        position = base.act(self._M[(1, 2, 0), (5, 3, 4)] / -self.mass)
        base.translation = position
        if not self._root_is_identity:
            position = self._root.actInv(position)
        x, y, z = position.tolist()
        q[0], q[1], q[2] = x + self._x, y + self._y, z + self._z
        lack: Array = momentum.dot(base.toActionMatrix()) - self._M.dot(v)
        v_b = v[:6]
        v_b += dposv(self._M_bb, lack, 0, 0, 1)[1]

    def histories(
        self, t: Array, q: Array, v: Array
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Return the conserved quantities at times t (N,), for q (N, nq) and v (N, nv).

        The five arrays are, in this order,

        - the energy (N,);
        - the momentum about the centre of mass (N, 6);
        - the centre of mass (N, 3) relative to the fixed point;
        - the momentum about the fixed point (N, 6);
        - the upper bounds (2,) of linear and angular momentum (11.6).

        A momentum (6,) consists of linear and angular momentum, in world axes. In orbit, the energy
        is the Jacobi integral. The momentum about the fixed point is replaced by the Jacobi
        integral and five zeros. The bounds are replaced by the size of the largest terms of the
        Jacobi integral and a zero.
        """
        robot = self._robot
        rows = len(q)
        near = q.copy()
        near[:, :7] -= self._start
        energy, momentum, center, polar = integrals(robot, near, v)
        sizes = np.sqrt(
            2.0 * energy[:, None] * np.column_stack((np.full(rows, self.mass), polar))
        )
        scale = sizes.max(axis=0)
        for _, stored in self._stored:
            scale[1] += np.linalg.norm(stored)
        if self._weight is not None:
            energy -= (center + self._root.rotation @ self._start[:3]) @ self._weight
        stiffness, _, rest = robot.springs
        if stiffness.any():
            positions = np.column_stack([joint.values(q.T) for joint in robot.joints])
            energy += 0.5 * (positions - rest) ** 2 @ stiffness
        p, about_center = np.split(momentum, 2, axis=1)
        kept = np.hstack((p, about_center + np.cross(center, p)))
        if self._field:
            times = t.tolist()
            potential = np.array(
                [self._potential(t_i, q_i) for t_i, q_i in zip(times, q, strict=True)]
            )
            scale = np.array([(np.abs(energy) + np.abs(potential)).max(), 0.0])
            energy += potential
            kept = np.column_stack((energy, np.zeros((rows, 5))))
        return energy, momentum, center, kept, scale

    def _potential(self, t: float, q: Array) -> float:
        """Return the potential energy [J] of the orbit at time t and q."""
        assert self._field is not None
        self._field.move_to(t)
        pin.forwardKinematics(self._model, self._data, q)
        return self._field.potential(self._data)

    def _of_wheels(self) -> Array:
        """Return the stored momentum (3,) of wheels in world axes, at the link poses in `_data`."""
        total: Array = np.zeros(3)
        for joint, stored in self._stored:
            total += self._data.oMi[joint].rotation @ stored
        return total


class Recording(NamedTuple):
    """Recorded rows of a run: times, configurations, velocities, inputs and predicted momentum.

    A brief recording has no rows of the predicted momentum and centre of mass, and no forces of
    constraints.
    """

    t: Array
    q: Array
    v: Array
    u: Array
    momentum: Array  # (N, 6) from the external impulse; see `Conserved`
    center: Array  # (N, 3) predicted centre of mass
    steps: int  # number of steps that were begun
    stopped: str  # reason if the run ended early, or an empty text
    engine: str  # name of the engine
    forces: Array | None = None  # (N, r) of constraints, or None without constraints

    @property
    def is_brief(self) -> bool:
        """Whether the recording is brief."""
        return not len(self.momentum)


def _follower(plan: Plan) -> Callable[[int], None] | None:
    """Return a function that integrates the state of the policy, or None if it has no state.

    The argument is the number of stages of the present step that are computed.
    """
    command = plan.law.policy if plan.law else None
    advance = command.advance if isinstance(command, BoundLaw) else None
    if advance is None:
        return None
    weights = plan.method.step_weights(plan.times.dt)[1]
    return lambda stages: advance(
        weights[stages - 1, : stages + 1], stages == len(weights)
    )


class _Rows:
    """Rows that a run in Python records, with the momentum and the centre of mass of each row."""

    def __init__(self, plan: Plan, kept: Conserved) -> None:
        self.times = list[float]()
        self._kept = kept
        self._callback = plan.options.callback
        self._ends = np.cumsum([len(plan.q), len(plan.v), len(plan.initial), 6])
        self._rows = np.empty((plan.times.rows, self._ends[-1] + 3))
        self._constrained = plan.plant.constrained
        self._forces = list[Array]()

    def add_forces(self, forces: Array) -> None:
        """Record the forces of the constraints in the latest row, unless it already has some."""
        if len(self._forces) < len(self.times):
            self._forces.append(forces)

    def add(self, t: float, q: Array, v: Array, u: Array) -> None:
        """Record a row, and call the callback of the run."""
        kept = self._kept
        row = np.concatenate((q, v, u, kept.momentum, kept.center(t)))
        self._rows[len(self.times)] = row
        self.times.append(t)
        if self._callback:
            self._callback(t, q.copy(), v.copy(), u.copy())

    def recording(self, steps: int, stopped: str) -> Recording:
        """Return the rows of a run that ended after `steps` for the reason `stopped`."""
        parts = np.split(self._rows[: len(self.times)], self._ends, axis=1)
        q, v, u, momentum, center = parts
        forces = None
        if self._constrained is not None:
            # No step begins at the last row, so this row repeats the forces before it.
            rows = self._forces + self._forces[-1:]
            forces = np.array(rows[: len(q)])
        return Recording(
            t=np.array(self.times),
            q=q,
            v=v,
            u=u,
            momentum=momentum,
            center=center,
            steps=steps,
            stopped=stopped,
            engine="python",
            forces=forces,
        )


def _robot_stage(plant: Plant, rows: _Rows) -> Stage:
    """Return the function for the accelerations of the robot, with its constraints."""
    constrained = plant.constrained
    if constrained is None:
        return plant.stage

    def stage(t: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        result = plant.constrained_stage(t, q, v, u)
        rows.add_forces(constrained.forces)
        return result

    return stage


def _lagged(plan: Plan, stage: Stage) -> Stage:
    """Return the function `stage` of a run, with the lags of actuators and sensors."""
    plant, times = plan.plant, plan.times
    acting = stage
    if plant.lags.any():
        held = plan.law is None or times.sample > 0
        initial = np.clip(plan.initial, plan.limits.low, plan.limits.high)
        lag = ActuatorLag(plant.lags, initial, plan.method, times.dt, held=held)

        def acting(t: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
            return stage(t, q, v, lag.acting(u))

    command = plan.law.policy if plan.law else None
    if not (isinstance(command, Loop) and command.lag):
        return acting
    weights = plan.method.step_weights(times.dt)[1]

    def observed(t: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        rate, push = acting(t, q, v, u)
        command.observe(t, q, v, rate, weights)
        return rate, push

    return observed


def _corrected(
    plan: Plan, kept: Conserved, t: float, q: Array, v: Array
) -> tuple[Array, Array]:
    """Return q and v at the end of a step, on the constraints and with the predicted momentum."""
    constrained = plan.plant.constrained
    if constrained is not None:
        q, v = constrained.close(q, v)
    if plan.project:
        kept.impose(t, q, v)
    return q, v


# A diverging motion may overflow before it is stopped, so NumPy's warnings are suppressed.
@np.errstate(over="ignore", invalid="ignore")
def go(plan: Plan, hint: str = "") -> Recording:
    """Simulate a plan in Python; the progress bar of a long run shows the text `hint`."""
    plant, times, law, q, v = plan.plant, plan.times, plan.law, plan.q, plan.v
    dt = times.dt
    kept = Conserved(plan)
    applied = None if law is None else plan.applied_by(law)
    ask = partial(applied, 0) if applied and not times.sample else None
    take = plan.method(plant.robot.model, dt).step
    follow = _follower(plan)
    pushed = not plant.isolated(driven=law is not None)
    rows = _Rows(plan, kept)
    stage = _lagged(plan, _robot_stage(plant, rows))
    t, stages = 0.0, 0

    def acceleration(t: float, q: Array, v: Array) -> Array:
        nonlocal stages
        # At the first stage of a step, `u` already contains the inputs. At later stages, the inputs
        # of a continuous policy are computed again.
        inputs = u
        if ask and stages:
            inputs = ask(min(t, last), q, v)
        a, push = stage(t, q, v, inputs)
        if pushed:
            kept.wrenches[stages][:] = kept.wrench(q, push)
        stages += 1
        if follow:
            follow(stages)
        return a

    ending = ending_of(plan, stop_conditions(plan))
    bar = Progress(plan.options.progress)
    try:
        for step in range(times.steps):
            u = applied(step, t, q, v) if applied else plan.initial
            if step % times.every == 0:
                rows.add(t, q, v, u)
            stages = 0
            last = t + plan.last_node * dt
            plant.step = (t, dt)
            q, v = take(acceleration, t, q, v)
            if pushed:
                kept.advance()
            t = (step + 1) * dt
            q, v = _corrected(plan, kept, t, q, v)
            if stopped := ending(t, q, v):
                break
            if step % _LOOK == 0:
                bar(step + 1, times.steps, hint=hint)
    except KeyboardInterrupt:
        if not rows.times:
            raise
        stopped = f"interrupted at t = {step * dt:g} s"
    finally:
        bar.close()
    if not stopped.startswith(("diverged", "interrupted")):
        rows.add(t, q, v, u)
    return rows.recording(step + 1, stopped)


def stop_conditions(plan: Plan) -> StopConditions:
    """Return the stop conditions of a run; `squares` has the squared limits of the entries of v."""
    squares = np.full(len(plan.v), LARGEST_SPEED**2)
    squares[plan.plant.turning] = plan.times.slow
    # A policy is defined at every attitude. So only a comparison with a linear model ends a run in
    # which the base leaves the attitude chart.
    sign = 0.0
    if plan.within_chart:
        sign = float(np.sign(plan.plant.state.scalar(plan.q)))
    return StopConditions(squares=squares, sign=[sign])


def ending_of(plan: Plan, stop: StopConditions) -> Callable[[float, Array, Array], str]:
    """Return a function of (t, q, v) that checks whether the run ends.

    The function returns the reason, or an empty text if the run continues.
    """
    # Use lists, because reading an entry of a list is faster than reading an entry of an array.
    stop = stop._replace(squares=stop.squares.tolist())
    any_attitude = stop._replace(sign=[0.0])
    origin = [0.0, 0.0, 0.0, *plan.plant.state.origin_quaternion.tolist()]

    constrained = plan.plant.constrained

    def ending(t: float, q: Array, v: Array) -> str:
        place, rates = q.tolist(), v.tolist()
        if constrained is not None and not constrained.independent():
            return singular_at(t)
        if goes_on(stop, origin, place, rates):
            for event in plan.events:
                value = event(t, q.copy(), v.copy())
                try:
                    margin = float(value)
                except (TypeError, ValueError):
                    margin = math.nan
                if math.isnan(margin):
                    raise InputError(
                        f"an event returned {value!r} at t = {t:g} s, expected a number"
                    )
                if margin <= 0.0:
                    return f"{getattr(event, '__name__', 'event')} at t = {t:g} s"
            return ""
        # If the velocities alone do not end the run, the attitude does.
        if goes_on(any_attitude, origin, place, rates):
            return f"left the chart at t = {t:g} s: the base rotated by 180 deg from the reference"
        dt = plan.times.dt
        turn = float(np.abs(v[plan.plant.turning]).max()) * plan.times.dt
        shown = ""
        if LARGEST_TURN <= turn <= _LARGEST_SHOWN:
            shown = f": a joint or the base rotates by {turn:.2g} rad per step"
        advice = "give a smaller dt; if that does not help, the loop itself is unstable"
        return f"diverged at t = {t:g} s in steps of {dt:g} s{shown}; {advice}"

    return ending


def singular_at(t: float) -> str:
    """Return the message for constraints that become singular at time t [s]."""
    return (
        f"diverged at t = {t:g} s: the constraints are singular, because one of them follows from "
        "the others at this configuration, so their forces are not determinate there"
    )


def stop_of(message: str) -> int:
    """Return the index in STOPS for the message with which a run ended."""
    for index, start in enumerate(STOPS):
        if start and message.startswith(start):
            return index
    if message:
        return len(STOPS) - 1
    return 0
