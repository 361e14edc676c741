"""Feedback of the robot's outputs by a linear system, whoever designed it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import InputError, listed
from fflin.base.validation import Array, instance, number
from fflin.control.compensation import Loop, Sample
from fflin.control.gain import titled
from fflin.control.policies import Policy
from fflin.control.systems import System, fitted, system_of
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_sensed
from fflin.linear.model import LinearModel, state_space
from fflin.linear.sampling import held_exponential
from fflin.robot.robot import Robot

# A pole beyond this share of the fastest is one that grows, and no rounding.
_ROUNDING = 1e-6


class OfOutputs:
    """A policy u - u0 = system (y - y0), about the point of a model that its outputs are of."""

    lin: LinearModel
    system: Any
    noise: Callable[[float], ArrayLike] | None

    @property
    def dt(self) -> float:
        """Sampling time [s]; 0 in continuous time."""
        return float(self.system.dt)

    @property
    def at(self) -> tuple[Array, Array]:
        """Inputs u0 and outputs y0 that it is about."""
        return self.lin.u0, self.lin.y0

    @property
    def terms(self) -> Sample:
        """What it does at each sample or stage."""
        A, B, C, D, *_ = self.system
        return Sample(A, B, C, D, *self.at, self.lin.C, self.lin.D)

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot, with a state of its own.

        Raises
        ------
        InputError
            If the robot has not the model's states, inputs and outputs; its masses may be others.
        """
        lin, stays = self.lin, self.terms
        state = StateMap(robot, reference=lin.reference, frame=lin.frame)
        require_sensed(lin, robot, state)
        there = Measuring(state, lin.q), state.read(lin.q, lin.v)
        return Loop(state, self.dt, self.noise, len(stays.A), lambda _: stays, lambda _: there)

    def around(self, lin: LinearModel) -> tuple[LinearModel, Array, Array]:
        """Return a model with the system's states besides, and u = offset + K e of the two."""
        (A, B, C, D, u0, y0, *_), nx = self.terms, len(lin.A)
        apart, none = lin.y0 - y0, np.zeros((nx, len(A)))
        both = replace(
            lin,
            A=np.block([[lin.A, none], [B @ lin.C, A]]),
            B=np.vstack((lin.B, B @ lin.D)),
            f0=np.concatenate((lin.f0, B @ apart)),
            x0=np.concatenate((lin.x0, np.zeros(len(A)))),
        )
        return both, np.hstack((D @ lin.C, C)), u0 + D @ apart

    @cached_property
    def loop(self) -> Array:
        """The closed loop's matrix (nx + nz, nx + nz): of the model's state and the system's."""
        lin = self.lin.discretize(self.dt) if self.dt and not self.lin.dt else self.lin
        both, K, _ = self.around(lin)
        return both.A + both.B @ K


@dataclass(frozen=True, eq=False, repr=False)
class LinearController(OfOutputs):
    r"""The feedback ``u - u0 = system (y - y0)`` of the robot's outputs by any linear system.

    .. math:: \dot z = A z + B (y - y_0),\qquad u - u_0 = C z + D (y - y_0),\qquad z(0) = 0

    y is what the robot's outputs measure, in the chart of the model, and what the system gives is
    added to u0: positive feedback, as python-control's `hinfsyn` and `h2syn` and MATLAB's
    ``hinfsyn`` have it. A system that was designed for negative feedback takes ``sign=-1``.

    In continuous time z is integrated along with the robot, stage by stage of the same method;
    where `simulate` is given `sample` or `delay`, y is held over each sample, and z exact. A
    sampled system is asked at its own times, a multiple of the step, and u is held between them.

    Parameters
    ----------
    system : control.StateSpace or TransferFunction, scipy.signal system, array_like, tuple or path
        A gain D (nu, ny), (A, B, C, D) or (A, B, C, D, dt), a `Compensator`, or a .mat, .npz or
        .json file with A, B, C, D, and dt or Ts where it is sampled, or with D alone. Where it has
        names (``input_names``, ``InputName``), they are outputs and inputs of the model, with dots
        or underscores, and need not be all of them; without names all are there, in order. Where
        no dt is said, it is the model's.
    lin : LinearModel
        The model about whose point it acts, continuous or sampled.
    sign : {1, -1}
        Of what the system gives.
    noise : callable, optional
        noise(t) -> (ny,), added to y.

    Attributes
    ----------
    system : tuple of A, B, C, D, dt, inputs, outputs
        Over all outputs and inputs of the model, its sign included.
    loop : ndarray (nx + nz, nx + nz)
        The matrix of the linear loop, of the model's state and z.

    Raises
    ------
    InputError
        If a size, name or sampling time does not fit the model, an entry is not finite, a transfer
        function is improper, or D acts on an output that feels the input at once.
    FileError
        If the file cannot be read or lacks what is named above.
    """

    system: Any
    lin: LinearModel
    sign: float = field(default=1.0, kw_only=True)
    noise: Callable[[float], ArrayLike] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        lin = instance("lin", self.lin, LinearModel, "a fflin.LinearModel")
        if lin.moving:
            raise InputError("the model is about a moving reference, expected one that stays")
        if number("sign", self.sign) not in (1.0, -1.0):
            raise InputError(f"sign is {self.sign:g}, expected 1 or -1")
        by = fitted(system_of(self.system), lin)
        dt = self._time(by)
        felt = lin.D.any(axis=1) & by.D.any(axis=0)
        if felt.any():
            names = [name for name, each in zip(lin.output_names, felt, strict=True) if each]
            raise InputError(
                f"D of the controller acts on {listed(names)}, which feels the input at once: an "
                "algebraic loop; take D = 0 there, such as behind a low-pass filter"
            )
        of = by._replace(C=self.sign * by.C, D=self.sign * by.D, dt=dt)
        for array in of[:4]:
            array.setflags(write=False)
        object.__setattr__(self, "system", of)
        object.__setattr__(self, "sign", 1.0)

    def _time(self, by: System) -> float:
        lin, dt = self.lin, by.dt
        if dt is None or (dt == 0.0 and not len(by.A)):
            return lin.dt
        if dt < 0.0 and not lin.dt:
            raise InputError("the controller is sampled and does not say its dt; give it one")
        dt = lin.dt if dt < 0.0 else dt
        if lin.dt and abs(dt - lin.dt) > 1e-9 * lin.dt:
            time = f"sampled at dt = {dt:g} s" if dt else "continuous"
            raise InputError(
                f"the controller is {time}, the model sampled at dt = {lin.dt:g} s; give the "
                "continuous model, or sample both alike"
            )
        return dt

    def __repr__(self) -> str:
        return titled(self, nz=len(self.system.A), ny=len(self.lin.y0), nu=len(self.lin.u0))

    @property
    def robot(self) -> str:
        """Name of the model's robot."""
        return self.lin.robot

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be said of poles that grow, of the loop and of the system by itself."""
        said = []
        for what, A in (
            ("the linear loop", self.loop),
            ("the controller by itself", self.system.A),
        ):
            poles = np.linalg.eigvals(A)
            growth = np.abs(poles) - 1.0 if self.dt else poles.real
            if (growth > _ROUNDING * (1.0 + np.abs(poles).max(initial=0.0))).any():
                pole, unit = complex(poles[growth.argmax()]), "" if self.dt else " 1/s"
                said.append(f"{what} is unstable, with a pole at {pole:.4g}{unit}")
        return tuple(said)

    def sampled(self, dt: float) -> LinearController:
        """Return it in samples of dt [s], y held between them; itself where it is sampled."""
        by = self.system
        if by.dt or not len(by.A):
            return self
        A, B = held_exponential(by.A, by.B, dt)
        return replace(self, system=by._replace(A=A, B=B, dt=dt))

    def to_control(self) -> Any:
        """Return it as a `control.StateSpace` from y - y0 to u - u0, with signal names.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        """
        *matrices, dt, inputs, outputs = self.system
        names = [f"z_{k + 1}" for k in range(len(self.system.A))]
        return state_space(matrices, dt, names, inputs, outputs)
