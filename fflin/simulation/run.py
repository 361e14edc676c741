"""One simulation: prepared, stepped, recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.progress import Progress
from fflin.base.validation import Array, number, truth, whole
from fflin.control.channel import Channel, Law, limits_of
from fflin.control.policies import Allocation, bound
from fflin.dynamics.state import Frame, StateMap
from fflin.linear.ignorable import rotor_names
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot
from fflin.simulation.conservation import Conserved
from fflin.simulation.integrators import integrator
from fflin.simulation.plant import Disturbance, Dynamics

Event = Callable[[float, Array, Array], float]

# A turn within one step [rad] beyond which no integrator follows.
_LARGEST_TURN = 1.0
_LARGEST_SPEED = 1e50  # in SI units; beyond it squares overflow
_STEP = 0.01  # [s]
_LOOK = 16  # steps between looks at the clock
_ROWS_LIMIT, _STEPS_LIMIT = 10_000_000, 10_000_000_000
_LONGEST = 1e100  # [s]; the square of its inverse is still a number


class Run:
    """One simulation; `simulate` says what its arguments mean."""

    def __init__(
        self,
        robot: Robot,
        policy: Any,
        frame: Frame | None,
        reference: pin.SE3 | None,
        disturbance: Disturbance | None,
    ) -> None:
        lin = getattr(policy, "lin", None)
        self.lin: LinearModel | None = lin if isinstance(lin, LinearModel) else None
        if self.lin is not None:
            if frame is not None or reference is not None:
                raise InputError("frame and reference are those of the policy's model; leave out")
            frame, reference = self.lin.frame, self.lin.reference
        self.robot = robot
        self.policy = policy
        self.state = StateMap(
            robot, reference=reference, frame="hybrid" if frame is None else frame
        )
        self.dynamics = Dynamics(self.state, disturbance)
        self._law = None if policy is None else bound(policy, robot)

    def begin(self, x0: Any, q0: Any, v0: Any) -> None:
        """Set the initial point."""
        robot = self.robot
        if x0 is not None:
            if q0 is not None or v0 is not None:
                raise InputError("x0 is given with q0 or v0; give either")
            self.q, self.v = self.state.to_pinocchio(x0)
        else:
            self.q = robot.neutral() if q0 is None else robot.checked_configuration(q0).copy()
            self.v = np.zeros(robot.nv) if v0 is None else robot.checked_velocity(v0).copy()
        if not np.abs(self.v).max() < _LARGEST_SPEED:
            raise InputError(
                f"the initial velocity has an entry of {np.abs(self.v).max():.3g}, expected less "
                f"than {_LARGEST_SPEED:g} [rad/s|m/s]"
            )
        self.target = None if self.lin is None else self._target(self.lin)
        near = x0 if x0 is not None else self.target
        self.near = None if near is None else np.asarray(near, dtype=float)
        self.conserved = Conserved(robot, self.q)

    def clock(
        self, duration: float, dt: float | None, every: int, sample: float | None, delay: float
    ) -> None:
        """Set the times."""
        if sample is None:
            sample = getattr(getattr(self.policy, "lin", None), "dt", None) or None
        if sample is not None:
            sample = _positive("sample", sample)
        duration, delayed = _positive("duration", duration), number("delay", delay)
        if not 0.0 <= delayed <= _LONGEST:
            raise InputError(f"delay is {delayed:g} s, expected 0 to {_LONGEST:g} s")
        every = whole("every", every, 1)
        self.fastest = 0.0 if sample else self._fastest_pole()
        chosen = dt is None
        if dt is None:
            dt = _STEP
            if self.fastest * dt > 1.0:
                dt = float(0.5 ** np.ceil(np.log2(self.fastest)))
            if sample or delayed:
                dt = _part_of(sample or delayed, dt, duration, delayed)
        self.dt = _positive("the step dt", dt)
        self.steps = max(1, round(duration / self.dt))
        if abs(self.steps * self.dt - duration) > 1e-6 * duration:
            if sample or delayed:
                raise InputError(
                    f"duration is {duration:g} s, expected a multiple of the step dt = "
                    f"{self.dt:g} s where the input is sampled or late; choose the step so"
                )
            self.steps = int(np.ceil(duration / self.dt))
            self.dt = duration / self.steps
        self.every = every
        rows = self.steps // every + 2
        wide = rows * (self.robot.nq + self.robot.nv + 2 * self.state.nx) > 50 * _ROWS_LIMIT
        if wide or self.steps > _STEPS_LIMIT:
            asked = f", which the loop's fastest pole at {self.fastest:.3g} 1/s asks for,"
            raise InputError(
                f"{duration:g} s in steps of {self.dt:g} s"
                f"{asked if chosen and self.dt < _STEP and self.fastest else ''} are "
                f"{self.steps:.3g} steps and {rows:.3g} rows; take a larger dt or `every`"
            )
        if sample is None and delayed:
            sample = self.dt
        self.sample = 0 if sample is None else self._whole("sample", sample)
        self.delay = self._whole("delay", delayed)

    def _whole(self, name: str, time: float) -> int:
        steps = round(time / self.dt)
        if abs(steps * self.dt - time) > 1e-6 * self.dt:
            raise InputError(
                f"{name} is {time:g} s, expected a multiple of the step dt = {self.dt:g} s; "
                "choose the step so"
            )
        return steps

    def actuate(self, limits: Any) -> None:
        """Set what becomes of a command."""
        names = self.dynamics.actuation.names
        self.limits = limits_of(self.dynamics.actuation, limits)
        # The model's inputs are others where they are allocated to the robot's.
        same = self.lin is not None and self.lin.input_names == names
        self.initial = self.lin.u0 if self.lin is not None and same else np.zeros(len(names))
        self.channel = None
        self.slow = (_LARGEST_TURN / self.dt) ** 2
        if self._law is not None:
            law = Law(self._law, names, self.limits, self.slow)
            self.channel = Channel(law, self.initial, *self.limits, self.sample, self.delay)

    def choose(self, method: str, project: bool) -> None:
        """Set the integrator."""
        kind = integrator(method)
        self.project = truth("project", project)
        if self.fastest * self.dt > kind.reach:
            raise InputError(
                f"the step dt is {self.dt:g} s, too large for a loop whose fastest pole is at "
                f"{self.fastest:.4g} 1/s; take at most {kind.reach / self.fastest:.2g} s, or "
                "`sample`"
            )
        self.method = kind(self.robot.model, self.dt)
        self.step = self.method.step

    def _fastest_pole(self) -> float:
        decides = self.policy.policy if isinstance(self.policy, Allocation) else self.policy
        K = getattr(decides, "K", None)
        if self.lin is None or K is None or self.lin.dt:
            return 0.0
        return float(np.abs(np.linalg.eigvals(self.lin.A - self.lin.B @ K)).max())

    def guard(self, events: Sequence[Event], callback: Any) -> None:
        """Set what ends the run and what watches it."""
        if not isinstance(events, Sequence):
            raise InputError(
                f"events is a {type(events).__name__}, expected a list of functions event(t, q, v)"
            )
        for each in (*events, *([] if callback is None else [callback])):
            if not callable(each):
                raise InputError(f"{each!r} is no function of (t, q, v), as an event would be")
        self.events, self.callback = tuple(events), callback
        # A rotor may spin as fast as it will: nothing depends on its angle.
        joints = [joint for joint in self.robot.joints if not joint.prismatic]
        rotors = rotor_names(self.robot)
        at = [joint.idx_v for joint in joints if joint.name not in rotors]
        self.turning = np.array([3, 4, 5, *at])
        self.acting: Array | None = None

    def go(self, progress: bool | None) -> str:
        """Run to the end; return why it ended before."""
        # What overflows is told as a divergence.
        with np.errstate(over="ignore", invalid="ignore"):
            return self._go(progress)

    def _go(self, progress: bool | None) -> str:
        rows = self.steps // self.every + 2
        sizes = (self.robot.nq, self.robot.nv, len(self.initial), 6)
        self.t = np.empty(rows)
        self.rows = tuple(np.empty((rows, size)) for size in sizes)
        self.count = 0
        # The momentum that the impulse from outside makes.
        self.expected = self.conserved.momentum(self.q, self.v)
        self.scalar = self.state.scalar(self.q)
        self.weights = self.dt * np.array(self.method.weights)
        self.follow = not self.dynamics.isolated(driven=self.channel is not None)
        continuous = self.channel is not None and self.channel.continuous
        self.asked = self.channel.ask if self.channel is not None and continuous else None
        bar = Progress(progress)
        stopped, step = "", 0
        try:
            for step in range(self.steps):
                self.taken = step + 1
                u = self._advance(step)
                # The square is above that of any turn, and not finite where an entry is not.
                if self.lin is not None or not float(self.v.dot(self.v)) < self.slow:
                    stopped = self._fault(step)
                if not stopped and self.events:
                    stopped = self._event(step + 1)
                if stopped:
                    break
                if step % _LOOK == 0:
                    bar.update(step + 1, self.steps)
        except KeyboardInterrupt:
            if not self.count:
                raise
            stopped = f"interrupted at t = {step * self.dt:g} s"
        finally:
            bar.close()
        if not stopped.startswith(("diverged", "interrupted")):
            self._record((step + 1) * self.dt, u)
        return stopped

    def _advance(self, step: int) -> Array:
        """Take one step; return what acted as it began."""
        t, q, v = step * self.dt, self.q, self.v
        u = self.initial if self.channel is None else self.channel.begin(step, t, q, v)
        if step % self.every == 0:
            self._record(t, u)
        if self.follow or self.asked:
            self._follow(t, q, v, u)
        else:
            self.q, self.v = self.step(self._held(u), t, q, v)
        if self.project:
            self.conserved.impose(self.q, self.v, self.expected)
        return u

    def _follow(self, t: float, q: Array, v: Array, u: Array) -> None:
        """Take one step under a law that is asked at each stage, or of which pushes are summed."""
        ask = self.asked
        stage, wrench = self.dynamics.stage, self.conserved.wrench if self.follow else None
        pushes: list[Array] = []

        def f(t: float, q: Array, v: Array) -> Array:
            # The first stage is the point that was asked about already.
            acting = ask(t, q, v) if ask and pushes else u
            a, push = stage(t, q, v, acting)
            pushes.append(wrench(q, push) if wrench else push)
            return a

        self.q, self.v = self.step(f, t, q, v)
        if wrench:
            self.expected = self.expected + self.weights.dot(pushes)

    def _held(self, u: Array) -> Any:
        """Return f(t, q, v) under an input that stays, made anew where it is another."""
        if u is not self.acting:
            self.acting, self.rate = u, self.dynamics.held(u)
        return self.rate

    def _fault(self, step: int) -> str:
        """Say what is wrong with the step that was taken; drop it where it has no meaning."""
        t = (step + 1) * self.dt
        turn = float(np.abs(self.v[self.turning]).max(initial=0.0)) * self.dt
        fast = not np.abs(self.v).max() < _LARGEST_SPEED
        if fast or not turn < _LARGEST_TURN:
            self.q, self.v = (rows[self.count - 1] for rows in self.rows[:2])
            if fast or turn > 1e3:
                return f"diverged at t = {t:g} s"
            return f"diverged at t = {t:g} s: a joint or the base turns by {turn:.2g} rad a step"
        if self.lin is None:
            return ""
        before, self.scalar = self.scalar, self.state.scalar(self.q)
        if before * self.scalar < 0.0:
            return f"left the chart at t = {t:g} s: the base turned by 180 deg from the reference"
        return ""

    def _event(self, step: int) -> str:
        t = step * self.dt
        for event in self.events:
            value = event(t, self.q.copy(), self.v.copy())
            try:
                margin = float(value)
            except (TypeError, ValueError):
                margin = math.nan
            if math.isnan(margin):
                raise InputError(f"an event gave {value!r} at t = {t:g} s, expected a number")
            if margin <= 0.0:
                return f"{getattr(event, '__name__', 'event')} at t = {t:g} s"
        return ""

    def _record(self, t: float, u: Array) -> None:
        row = self.count
        self.t[row] = t
        q, v, of_u, momentum = self.rows
        q[row], v[row], of_u[row], momentum[row] = self.q, self.v, u, self.expected
        self.count += 1
        if self.callback is not None:
            self.callback(t, self.q.copy(), self.v.copy(), u.copy())

    def _target(self, lin: LinearModel) -> Array:
        target = self.state.read(lin.q, lin.v)
        indices = [self.state.names.index(name) for name in lin.state_names]
        target[indices] = lin.x0
        return target


def _part_of(sample: float, largest: float, *times: float) -> float:
    """Return a step of which the sample and, where there is one, the other times are multiples."""
    least = int(np.ceil(sample / largest))
    for parts in range(least, least + 1000):
        dt = sample / parts
        if all(abs(round(time / dt) * dt - time) <= 1e-6 * dt for time in times):
            return dt
    return sample / least


def _positive(name: str, value: Any) -> float:
    time = number(name, value)
    if not 1.0 / _LONGEST < time <= _LONGEST:
        raise InputError(f"{name} is {time:g} s, expected more than 0 and at most {_LONGEST:g} s")
    return time
