"""Linear laws about a point that follow a trajectory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from fflin.base.errors import EquilibriumError, InputError
from fflin.base.validation import Array, instance
from fflin.control.loops import Loop, Sample, StateMeasuring, Step
from fflin.control.policy import Command, Noise, OutputForm, Policy, Reference
from fflin.control.rigid_reference import on_flexible_robot
from fflin.control.sensed_laws import sensed
from fflin.control.sensors import SensorTiming, require_timing, timing_of_robot
from fflin.control.trajectory_end import resting_end
from fflin.dynamics.aba import Aba
from fflin.dynamics.coordinates import Frame
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import Actuation, StateMap, selection
from fflin.linear.fit import require_fit
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory, refuse_periodic
from fflin.robot.robot import Robot

# Largest displacement of the base from the reference of its model [rad, m, rad/s, m/s].
_ROUNDING = 1e-9

# Times are compared with this relative tolerance, because sums of time steps are rounded.
_SAME_TIME = 1e-9


@dataclass(eq=False)
class Following(Policy):
    """Linear law that follows a trajectory: u - u*(t) = law(y - y*(t)).

    `LinearLaw.follow` describes the law and its reference.

    Parameters
    ----------
    law : Policy
        Sampled linear law about the point of its model.
    terms : sequence of Sample
        Matrices of this law at each sample of its period.
    trajectory : Trajectory
    noise : callable, optional
        Function noise(t) that returns the measurement noise.
    timing : SensorTiming, optional
        Sample times and delays that the sensors must have. By default, they may be any.
    """

    law: Policy
    terms: Sequence[Sample] = field(repr=False)
    trajectory: Trajectory
    noise: Noise | None = None
    timing: SensorTiming | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        instance("trajectory", self.trajectory, Trajectory, "a fflin.Trajectory")
        refuse_periodic(self.trajectory, "a law about a point that follows")
        if not self.law.sample_time:
            raise InputError(
                f"the {self.law.kind} is continuous, expected a sampled law to follow a "
                "trajectory; design it for lin.discretize(dt)"
            )
        same_joints = on_flexible_robot(self.lin, self.trajectory)
        self.trajectory = _with_inputs_of(self.lin, same_joints)
        self._require_fit(self.trajectory.robot)
        displacement = np.concatenate((self.lin.x0[:6], self.lin.v[:6]))
        if np.abs(displacement).max() > _ROUNDING:
            raise InputError(
                "the base of the law's model moves, or is displaced from the reference of the "
                "model, expected a base at rest at the reference; use fflin.linearize without "
                "reference= and without a velocity of the base"
            )
        moving = np.abs(self.trajectory.v[0, :6]).max() > _ROUNDING
        if self.lead and moving:
            raise InputError(
                f"the inputs are delayed by {self.lead:g} s, but the base moves at the start of "
                "the trajectory, expected a base at rest; without a delay, it may move"
            )

    @property
    def lin(self) -> LinearModel:
        """Model of the law."""
        lin = self.law.model
        assert lin is not None
        return lin

    @property
    def kind(self) -> str:
        """Name of the type of law, for messages."""
        return self.law.kind

    @property
    def model(self) -> LinearModel | None:
        """None, because the law follows a trajectory."""
        return None

    @property
    def input_delays(self) -> dict[str, float]:
        """Delay [s] of each input for which the law was designed."""
        return self.law.input_delays

    @property
    def sample_time(self) -> float:
        """Sample time [s]."""
        return self.law.sample_time

    @property
    def senses_outputs(self) -> bool:  # type: ignore[override]
        """Whether the law measures the outputs of the robot."""
        return self.law.senses_outputs

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the measured signals."""
        return self.law.sensors

    @property
    def fed_back(self) -> tuple[str, ...]:
        """Names of the states that the law feeds back."""
        return self.law.fed_back

    @property
    def measurement_noise(self) -> Noise | None:
        """The function noise(t)."""
        return self.noise

    @property
    def axes(self) -> tuple[Frame | None, pin.SE3 | None]:
        """Base axes; the reference is free."""
        return "local", None

    @property
    def reference_motion(self) -> Reference | None:
        """The trajectory and its end as a function of time."""
        return self.reference

    @property
    def followed_trajectory(self) -> Trajectory | None:
        """The trajectory."""
        return self.trajectory

    def initial_inputs_for(self, names: tuple[str, ...]) -> Array | None:
        """Return the inputs of the trajectory at its start."""
        return self.reference(0.0)[2]

    def reference_inputs(self, names: tuple[str, ...]) -> tuple[str, Array] | None:
        """Return the inputs at all knots."""
        return "on its trajectory", self.trajectory.u_base

    def with_sensor_errors(self, error: Callable[[float], Array]) -> Policy:
        """Return the law with errors of its sensors."""
        return replace(self, noise=error)

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the law."""
        return self.law.notes

    def loop_notes(self, held: float = 0.0) -> tuple[str, ...]:
        """Return the notes on the loop of the law about its point."""
        return self.law.loop_notes(held)

    @property
    def duration(self) -> float:
        """Time [s] from the first knot to the last."""
        return float(self.trajectory.t[-1] - self.trajectory.t[0])

    @property
    def lead(self) -> float:
        """Time [s] for which the robot waits at the start: the longest delay of the inputs."""
        return max(self.input_delays.values(), default=0.0)

    @cached_property
    def end(self) -> LinearModel:
        """Model at rest in the last configuration; `InputError` if no inputs hold the robot."""
        return self._resting("end", -1)

    @cached_property
    def start(self) -> LinearModel:
        """Model at rest in the first configuration."""
        return self._resting("start", 0)

    def _resting(self, where: str, knot: int) -> LinearModel:
        """Return the model at rest at a knot, in base axes; wheels keep their speeds."""
        try:
            return resting_end(self.trajectory, knot)
        except EquilibriumError as error:
            raise InputError(
                f"no inputs hold the robot at the {where} of the trajectory: {error}; give a "
                f"trajectory with another {where}"
            ) from None

    def reference(self, t: float) -> tuple[Array, Array, Array]:
        """Return the reference q, v, and u in base axes at time t [s] of the run."""
        elapsed = t - self.lead
        tolerance = _SAME_TIME * (1.0 + t)
        if elapsed > self.duration + tolerance:
            return self.end.q, self.end.v, self.end.u0
        if elapsed < -tolerance:
            return self.start.q, self.start.v, self.start.u0
        first, last = self.trajectory.t[[0, -1]].tolist()
        return self.trajectory.point(min(first + max(elapsed, 0.0), last))

    def feedforward(self, t: float) -> Array:
        """Return the command (nu,) at the sample at time t [s] that causes the reference inputs.

        Each entry is the mean of the reference input while this command acts, that is, for one
        sample time after the delay of the input.
        """
        if not self.input_delays:
            return self._mean_inputs(t)
        delays = np.array(list(self.input_delays.values()))
        command = np.zeros(len(delays))
        for delay in set(delays):
            mean = self._mean_inputs(t + delay)
            late = delays == delay
            command[late] = mean[late]
        return command

    def _mean_inputs(self, t: float) -> Array:
        """Return the mean (nu,) of the reference inputs from time t [s] over one sample."""
        dt = self.sample_time
        knots = self.trajectory.t - self.trajectory.t[0] + self.lead
        inside = (knots > t + _SAME_TIME * dt) & (knots < t + (1.0 - _SAME_TIME) * dt)
        ends = np.concatenate(([t], knots[inside], [t + dt]))
        # Between knots, inputs are constant or linear, so the middle is the mean.
        middles = 0.5 * (ends[1:] + ends[:-1])
        inputs = np.array([self.reference(middle)[2] for middle in middles])
        mean: Array = np.diff(ends) @ inputs / dt
        return mean

    @property
    def samples(self) -> int:
        """Number of samples until the reference no longer changes."""
        return int(np.ceil((self.lead + self.duration) / self.sample_time)) + 2

    def _require_fit(self, robot: Robot) -> None:
        """Raise `InputError` if the signals of a robot are not the signals of the law's model."""
        lin = self.lin
        about_point = StateMap(robot, reference=lin.reference, frame=lin.frame)
        require_fit(lin, robot, about_point, sensed=self.senses_outputs)

    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot.

        Raises
        ------
        InputError
            If the robot has other states, inputs or measured outputs than the model of the law.
            Masses may differ.
        """
        return self._loop(robot)

    def form(self, robot: Robot) -> OutputForm | None:
        """Return the matrices and the reference of each sample for the compiled loop."""
        if self.noise is not None and not self.senses_outputs:
            return None
        path = ReferencePath(self, robot)
        period = len(path.about_point)
        # The last samples have the final reference, and contain each matrix of the period.
        samples = self.samples + period - 1
        return OutputForm(self._loop(robot), path.terms, samples, period)

    def _loop(self, robot: Robot) -> Loop:
        """Return the command of the law for a robot."""
        self._require_fit(robot)
        path = ReferencePath(self, robot)
        corrected = path.about_point[0].E.size
        windup = (lambda t: path.matrices(t).E) if corrected else None
        return Loop(
            path.state,
            self.sample_time,
            path.sizes,
            path.at,
            self._noise_for(path),
            measures_state=not self.senses_outputs,
            windup=windup,
            has_sensors=self.senses_outputs,
        )

    def _noise_for(self, path: ReferencePath) -> Noise | None:
        """Return the errors of the measured values: outputs, or the full state of a robot."""
        noise = self.noise
        if noise is None or self.senses_outputs:
            return noise
        return lambda t: path.S.T @ np.asarray(noise(t))


def _with_inputs_of(lin: LinearModel, trajectory: Trajectory) -> Trajectory:
    """Return a trajectory with the inputs of a model; inputs that it lacks are zero.

    For example, a plan for wheels alone becomes a plan for wheels and a base torque, and the
    thrusts of a plan become a base torque and a base force.
    """
    robot = lin._robot
    names = trajectory.actuation.names
    known = lin.input_names
    if robot is None or names == known:
        return trajectory
    frame = trajectory.frame
    if set(names) <= set(known):
        u = trajectory.u @ selection(names, known)
    else:
        same_forces = _same_forces(trajectory, robot)
        if same_forces is None:
            return trajectory
        u = trajectory.u_base @ same_forces.T
        frame = "local"
    return Trajectory(
        robot,
        trajectory.t,
        trajectory.q,
        trajectory.v,
        u,
        hold=trajectory.hold,
        frame=frame,
    )


def _same_forces(trajectory: Trajectory, robot: Robot) -> Array | None:
    """Return the matrix from the inputs of a trajectory to inputs of a robot with the same forces.

    The inputs are in base axes. Return None if no inputs of the robot exert these forces, or if the
    matrix differs between the knots, because a thruster moves relative to the base.
    """
    given = trajectory.actuation
    wanted = Actuation(StateMap(robot))
    if given.torquers or wanted.torquers or len(given.fixed) != len(wanted.fixed):
        return None
    data = robot.create_data()
    matrix: Array | None = None
    for q in trajectory.q:
        columns = given.columns(data, q)
        inputs = wanted.columns(data, q)
        at_knot, *_ = np.linalg.lstsq(inputs, columns, rcond=None)
        error = np.abs(inputs @ at_knot - columns).max()
        if matrix is None:
            matrix = at_knot
        if (
            max(error, np.abs(at_knot - matrix).max())
            > _ROUNDING * np.abs(columns).max()
        ):
            return None
    return matrix


def _with_sensors(
    terms: Sequence[Sample], law: Following, state: StateMap
) -> list[Sample]:
    """Return a law in series with the sensors of a robot, for each sample of a common period.

    The sensors act on the differences of measured and planned outputs. So a late or held
    measurement is compared with the reference at the time of the measurement.
    """
    if not law.senses_outputs:
        return list(terms)
    require_timing(law.timing, state, law.sample_time)
    return sensed(terms, timing_of_robot(state, law.sample_time))


class ReferencePath:
    """Reference of a law for a robot: the sample matrices and the measurements at each time."""

    def __init__(self, law: Following, robot: Robot) -> None:
        self.law = law
        self.state = state = StateMap(robot, frame="local")
        names = law.lin.robot_states
        self.S = selection(names, state.names)
        self._at_rest: Array = np.zeros(robot.nv)
        self._aba: Aba | None = None
        if law.senses_outputs and any(x.FEELS_ACCELERATION for x in robot.outputs):
            # The reference accelerations belong to the robot of the trajectory.
            self._aba = Aba(StateMap(law.trajectory.robot, frame="local"))
        terms = law.terms
        if not law.senses_outputs:
            terms = [
                term._replace(B=term.B @ self.S, D=term.D @ self.S) for term in terms
            ]
        # Law about its point at each sample of its period.
        self.about_point = _with_sensors(terms, law, state)

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of states of the law, and of its measured values."""
        nz, ny = self.about_point[0].B.shape
        return nz, ny

    def matrices(self, t: float) -> Sample:
        """Return the law about its point at the sample at time t [s]."""
        sample = round(t / self.law.sample_time)
        return self.about_point[sample % len(self.about_point)]

    def at(self, t: float) -> tuple[Step, Measuring | StateMeasuring, Array]:
        """Return the step of the law, its measurements, and the state of the reference."""
        terms, measure, x = self._sample(t)
        return terms.step, measure, x

    def terms(self, t: float) -> Sample:
        """Return the matrices, with the reference inputs and measurements at time t [s]."""
        return self._sample(t)[0]

    def _sample(self, t: float) -> tuple[Sample, Measuring | StateMeasuring, Array]:
        """Return the matrices at time t [s], the measurements, and the state of the reference.

        Positions and attitudes are measured relative to the base pose of the reference.
        """
        q, v, u = self.law.reference(t)
        relative = self.state.about(self.state.origin * pin.XYZQUATToSE3(q[:7]))
        x = relative.read(q, v)
        measure: Measuring | StateMeasuring = StateMeasuring(relative)
        if self.law.senses_outputs:
            measure = Measuring(relative, q)
        a = self._at_rest
        if self._aba is not None:
            a = self._aba.acceleration(q, v, u)
        y = np.asarray(measure(x, q, v, a))
        terms = self.matrices(t)._replace(u0=self.law.feedforward(t), y0=y)
        return terms, measure, x
