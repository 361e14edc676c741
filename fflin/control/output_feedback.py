"""Output feedback by a compensator that estimates the state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.control.kalman import Compensator, kalman
from fflin.control.linear_controller import Compensation, LinearController, Loop, Sample
from fflin.control.policies import Policy
from fflin.control.tracking import TrajectoryFeedback
from fflin.control.tvkalman import FilterSchedule
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_same, sensed
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot


class OutputFeedback(LinearController):
    """Feedback of the robot's outputs by a sampled compensator, such as the result of `lqg`.

    At each sample, u - u0 = C z is applied. Then y is measured, and z is advanced to the next
    sample. Accelerometer outputs are computed with the commanded u, before saturation. The initial
    estimate of the deviation from the point is zero.

    Parameters
    ----------
    lin : LinearModel
        Sampled model that the compensator was designed for.
    compensator : Compensator
    noise : callable, optional
        noise(t) -> (ny,), added to y.

    Raises
    ------
    InputError
        If the compensator was designed for another model, or is not sampled.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> sampled = lin.discretize(0.1)
    >>> compensator = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-3, 1e-4))
    >>> policy = fflin.OutputFeedback(sampled, compensator)
    >>> fflin.simulate(robot, policy, duration=1.0).u.shape[1]
    9
    """

    def __init__(
        self,
        lin: LinearModel,
        compensator: Compensator,
        noise: Callable[[float], ArrayLike] | None = None,
    ) -> None:
        if not isinstance(lin, LinearModel) or not isinstance(compensator, Compensator):
            raise InputError(
                f"OutputFeedback got a {type(lin).__name__} and a {type(compensator).__name__}, "
                "expected a LinearModel and a Compensator, as fflin.lqg returns it"
            )
        if not lin.dt or lin.moving:
            raise InputError(
                "the model must be sampled and about a fixed point; use lin.discretize(dt), and "
                "design the gain and the estimator for it"
            )
        signals = (compensator.input_names, compensator.output_names, compensator.dt)
        if signals != (lin.output_names, lin.input_names, lin.dt):
            raise InputError(
                f"the compensator was designed for another model than '{lin.robot}' with "
                f"{len(lin.output_names)} outputs at dt = {lin.dt:g} s; use one model for both"
            )
        super().__init__(compensator, lin, noise=noise)
        vars(self)["compensator"] = compensator


@dataclass(frozen=True, eq=False)
class TrajectoryOutputFeedback(TrajectoryFeedback):
    r"""Feedback ``u = u*(t) - K(t) eh`` of the estimated error relative to a trajectory.

    At each sample, u is applied. Then y is measured, and the filter advances the estimate eh to
    the next sample, as in `OutputFeedback`. Positions and attitudes are measured relative to the
    base pose of the trajectory. The policy that `bind` returns has an attribute ``estimate``
    (nx,): the estimate for the next sample.

    Parameters
    ----------
    trajectory : LinearTrajectory
    schedule : GainSchedule
        Result of `tvlqr` with a sampling time.
    filter : FilterSchedule
        Result of `tvkalman` with the same sampling time.
    noise : callable, optional
        noise(t) -> (ny,), added to y.

    Raises
    ------
    InputError
        If the gains and the filter differ in sampling time or trajectory.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> filtered = fflin.tvkalman(along, 1e-3, 1e-4, sample=0.1)
    >>> policy = fflin.TrajectoryOutputFeedback(along, fflin.tvlqr(along, sample=0.1), filtered)
    >>> fflin.simulate(robot, policy, duration=1.0).u.shape[1]
    9
    """

    filter: FilterSchedule
    noise: Callable[[float], ArrayLike] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.filter, FilterSchedule):
            raise InputError(
                f"filter is a {type(self.filter).__name__}, expected a FilterSchedule, as "
                "fflin.tvkalman returns it"
            )
        gains, seen = self.schedule, self.filter
        if not (gains.dt and gains.dt == seen.dt and np.array_equal(gains.A, seen.A)):
            raise InputError(
                f"the gains are sampled at dt = {gains.dt:g} s, the filter at {seen.dt:g} s, "
                "expected the same sample= and the same trajectory for both"
            )

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot, with a separate estimate for each call.

        Raises
        ------
        InputError
            If the robot's states, inputs or outputs differ from the trajectory's.
        """
        super().bind(robot)  # refuses another robot
        origin, home = self.trajectory.robot, StateMap(robot, frame="local")
        own = sensed(StateMap(origin, frame="local"))
        made = f"the trajectory is a motion of '{origin.name}'"
        require_same(made, robot, "output", own, sensed(home))

        def there(t: float) -> tuple[Measuring, Array]:
            q, v, _ = self.reference(t)
            state = home.about(home.origin * pin.XYZQUATToSE3(q[:7]))
            return Measuring(state, q), state.read(q, v)

        return Loop(home, self.filter.dt, self.noise, self._size, self._sample, there)

    def law(self) -> Callable[[float, Array], Array]:
        """Return law(t, e) -> u at the samples, with the outputs of the linear models."""
        law = Compensation(self._size, self._sample)
        return lambda t, e: law.step(
            t, lambda by, u: by.y0 + by.seen @ (e + by.jump) + by.through @ (u - by.u0)
        )

    @property
    def _size(self) -> int:
        return len(self.filter.state_names)

    @cached_property
    def _rest(self) -> tuple[LinearModel, Array]:
        """The model after the end, and the gain of its steady filter."""
        lin, seen = self.end.discretize(self.filter.dt), self.filter
        return lin, kalman(lin, seen.W[-1], seen.V).L

    def _sample(self, t: float) -> Sample:
        gains, seen, dt = self.schedule, self.filter, self.filter.dt
        k, jump = round(t / dt), np.zeros(self._size)
        if k < len(seen.A):
            A, B, K, L, C, D = (x[k] for x in (seen.A, seen.B, gains.K, seen.L, seen.C, seen.D))
            # Held, an input that changes does most like its mean.
            u = self.reference(t + 0.5 * dt * (self.trajectory.hold == "linear"))[2]
            y = seen.y[k]
        else:
            (lin, L), K = self._rest, self.end_gain
            A, B, C, D, u, y = lin.A, lin.B, lin.C, lin.D, lin.u0, lin.y0
            if k == len(seen.A):
                # From here on the error is counted from rest.
                stop = self.reference(self.duration)[1] - lin.v
                jump[len(jump) // 2 :] = StateMap(self.trajectory.robot).velocities(stop)
        return Sample(A - B @ K - L @ (C - D @ K), L, -K, 0.0 * D.T, u, y, C, D, jump)
