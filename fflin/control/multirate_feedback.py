"""Feedback of outputs with their own sample times and delays."""

from __future__ import annotations

from itertools import compress

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, Mask, instance
from fflin.control.loops import NOT_CORRECTED, Loop, PredictedLaw, Sample
from fflin.control.multirate import MultirateCompensator
from fflin.control.policies import OutputSensing, PointLaw, at_samples
from fflin.control.policy import Command, Noise, OutputForm, Predictor, System
from fflin.control.sensed_laws import sensed
from fflin.control.sensors import (
    SensorTiming,
    require_timing,
    timing_of_model,
    timing_of_robot,
)
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap
from fflin.linear.fit import about_point, require_fit
from fflin.linear.holding import held_if_possible
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot


class MultirateFeedback(OutputSensing, PointLaw):
    """Feedback of outputs that are measured at different rates, by the compensator of `lqg`.

    At each sample of the model, u - u0 = C z is applied, and the measurements that arrive correct
    z. The sensors of the simulated robot have the sample times and delays of its outputs.

    Parameters
    ----------
    lin : LinearModel
        Sampled model that the compensator was designed for.
    compensator : MultirateCompensator
    noise : callable, optional
        Function noise(t) that returns measurement noise (ny,), which is added to y.

    Raises
    ------
    InputError
        If the compensator was designed for a model with other signals or another sample time.

    Examples
    --------
    >>> sensors = [fflin.StarTracker(sample=0.5, delay=0.25), fflin.Gyroscope("base")]
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=sensors)
    >>> model = fflin.linearize(robot).discretize(0.25)
    >>> compensator = fflin.lqg(fflin.lqr(model), fflin.kalman(model, 1e-10, 1e-8))
    >>> policy = fflin.MultirateFeedback(model, compensator)
    >>> fflin.simulate(robot, policy, duration=1.0).u.shape[1]
    3
    """

    def __init__(
        self,
        lin: LinearModel,
        compensator: MultirateCompensator,
        noise: Noise | None = None,
    ) -> None:
        self.compensator = instance(
            "compensator",
            compensator,
            MultirateCompensator,
            "a MultirateCompensator, as fflin.lqg returns it for outputs with their own sample or "
            "delay; use fflin.OutputFeedback for other compensators",
        )
        self.lin = lin = held_if_possible(about_point(lin))
        # Gain (nu, ny) of the received outputs, which `unload_wheels` adds to the commands.
        self.feedthrough: Array = np.zeros(
            (len(lin.input_names), len(lin.output_names))
        )
        self.noise = noise
        if noise is not None and not callable(noise):
            raise InputError(
                f"noise is {noise!r}, expected noise(t) -> (ny,), a function"
            )
        same = {
            "outputs": compensator.input_names == lin.output_names,
            "inputs": compensator.output_names == lin.input_names,
            "sample time": abs(compensator.dt - lin.dt) <= 1e-9 * compensator.dt,
        }
        different = [name for name, agrees in same.items() if not agrees]
        if different:
            raise InputError(
                f"the compensator was designed for a model of '{compensator.robot}' with another "
                f"{different[0]} than the given model; give the model of the design"
            )

    @property
    def sample_time(self) -> float:
        """Sample time [s]."""
        return self.lin.dt

    @property
    def notes(self) -> tuple[str, ...]:
        """Note on an estimated bias that settles slowly."""
        return (self.compensator.slow_bias,) if self.compensator.slow_bias else ()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the outputs of the model."""
        return self.lin.output_names

    @property
    def fed_back(self) -> tuple[str, ...]:
        """Names of the states in the measured outputs."""
        lin = self.lin
        used: Mask = np.any(self.compensator.B, axis=(0, 1))
        used = used | np.any(self.feedthrough, axis=0)
        felt: Mask = np.any(lin.C[used], axis=0)
        return tuple(compress(lin.state_names, felt))

    @property
    def designed_timing(self) -> SensorTiming | None:
        """Sample times and delays of the design; None if the model's robot is unknown."""
        return None if self.lin._robot is None else timing_of_model(self.lin)

    def terms_of_period(self) -> list[Sample]:
        """Return the matrices and offsets for each sample of the period."""
        law = self.compensator
        lin = self.lin
        D = self.feedthrough
        corrected = law.E.any()
        return [
            Sample(A, B, law.C, D, lin.u0, lin.y0, E=E if corrected else NOT_CORRECTED)
            for A, B, E in zip(law.A, law.B, law.E, strict=True)
        ]

    def laws_of_period(self) -> list[System]:
        """Return the law at each sample of the period, from the received outputs to the inputs."""
        names = self.lin.output_names, self.lin.input_names
        return [
            System(term.A, term.B, term.C, term.D, self.lin.dt, *names)
            for term in self.terms_of_period()
        ]

    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot; each call returns a policy with its own z.

        Raises
        ------
        InputError
            If the robot has other states, inputs or measured outputs than the model, or its outputs
            have other sample times or delays.
        """
        lin = self.lin
        state = self.state_map(robot)
        require_fit(lin, robot, state, sensed=True)
        require_timing(self.designed_timing, state, lin.dt)
        terms = self.terms_of_period()
        at = at_samples(terms, lin.dt)
        measure = Measuring(state, lin.q)
        near = state.read(lin.q, lin.v)
        windup = (lambda t: at(t).E) if terms[0].E.size else None
        return Loop(
            state,
            lin.dt,
            self.compensator.B.shape[1:],
            lambda t: (at(t).step, measure, near),
            self.noise,
            windup=windup,
            start=lin.y0,
        )

    def form(self, robot: Robot) -> OutputForm:
        """Return the law with its sensors as data for the compiled loop."""
        terms = self._sensed_terms(self.state_map(robot))
        at = at_samples(terms, self.lin.dt)
        return OutputForm(self.bind(robot), at, len(terms), len(terms))

    def _sensed_terms(self, state: StateMap) -> list[Sample]:
        """Return the law in series with the sensors of a robot, for each sample of a period."""
        return sensed(self.terms_of_period(), timing_of_robot(state, self.lin.dt))

    def prediction(self, lin: LinearModel, state: StateMap) -> Predictor | None:
        """Return the predictor of the closed loop with the model `lin`."""
        C, D, y0, u0 = lin.C, lin.D, lin.y0, lin.u0
        return lin, PredictedLaw(
            self._sensed_terms(state), lambda e, u: y0 + C @ e + D @ (u - u0)
        )

    def __repr__(self) -> str:
        count, nz, ny = self.compensator.B.shape
        return (
            f"{type(self).__name__}('{self.lin.robot}', nz={nz}, ny={ny}, "
            f"nu={len(self.lin.u0)}, dt={self.lin.dt:g} s, period={count})"
        )
