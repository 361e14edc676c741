"""Output feedback by a linear system, which comes from another tool, a file or `lqg`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from fflin.base.errors import FileError, InputError, listed, located, unknown
from fflin.base.names import undotted, without_past
from fflin.base.record import read_record, reading, texts
from fflin.base.validation import (
    ArrayLike,
    Mask,
    as_double,
    instance,
    number,
    shaped,
)
from fflin.base.writing import RECORDS, as_path, check_ending, reason
from fflin.control.compensator import Compensator
from fflin.control.law_files import in_time_of_file
from fflin.control.loops import NOT_CORRECTED
from fflin.control.multirate import MultirateCompensator
from fflin.control.policies import LinearLaw, OutputSensing
from fflin.control.policy import (
    Noise,
    System,
    unstable_note,
)
from fflin.linear.fit import about_point
from fflin.linear.holding import held_if_possible, wheel_notes
from fflin.linear.model import LinearModel

# default signal names such as u[0], or no name
_NUMBERED = re.compile(r"([a-z]\[\d+\])?")


@dataclass(eq=False, repr=False)
class LinearController(OutputSensing, LinearLaw):
    r"""Output feedback ``u - u0 = system (y - y0)`` by any linear controller `system`.

    .. math:: \dot z = A z + B (y - y_0),\qquad u - u_0 = C z + D (y - y_0),\qquad z(0) = 0

    Here y is the vector of the robot's outputs in the chart of the model, as `outputs` returns it.
    The output of the controller is added to u0. Feedback is positive by default, which is the
    convention of ``hinfsyn`` and ``h2syn``; `sign` selects negative feedback.

    A continuous controller is integrated together with the robot, in the same Runge-Kutta stages.
    If `simulate` is given `sample` or `delay`, y is held between samples and z is advanced exactly.
    A sampled controller is evaluated at its own sample times, which must be multiples of the
    integration step. The output u of a sampled controller is held between samples.

    Parameters
    ----------
    system : python-control or SciPy system, array_like, tuple, `Compensator` or path
        The controller, in one of these forms:

        - a state space or transfer function;
        - a gain D (nu, ny);
        - (A, B, C, D) or (A, B, C, D, dt);
        - a .mat, .npz or .json file with A, B, C, D, and dt or Ts if the controller is sampled;
        - a .mat, .npz or .json file with D alone.

        The controller's input names must be names of the model's outputs, and its output names must
        be names of the model's inputs; underscores may replace dots. In a file, the names are in
        ``input_names`` and ``output_names``, or in ``InputName`` and ``OutputName``. A controller
        with names may use only some of the model's outputs and inputs. A controller without names
        must use all of them, in order. If the controller has no dt, the model's dt is used.
    lin : LinearModel
        Continuous or sampled model. The controller acts on deviations from the operating point of
        this model. For the file of a `Tuned` law, a continuous model is sampled with the delay of
        the law.
    sign : {1, -1}
        Sign of the feedback: 1 for positive feedback, -1 for a controller that was designed for
        negative feedback, ``u - u0 = -K (y - y0)``.
    noise : callable, optional
        Function noise(t) that returns measurement noise (ny,), which is added to y.
    anti_windup : array_like (nz, nu), optional
        Gain E of the anti-windup: if limits change the command u to u_a, ``E (u_a - u)`` is added
        to dz/dt, or to the next z of a sampled controller. By default, limits do not affect z.

    Attributes
    ----------
    system : tuple of A, B, C, D, dt, inputs, outputs
        The controller from all outputs to all inputs of the model, with `sign` applied.
    dt : float
        Sample time [s]; 0 in continuous time.
    loop : ndarray (nx + nz, nx + nz)
        Closed-loop matrix of the model's state and z.

    Raises
    ------
    InputError
        If one of these conditions is true:

        - a size, name or sample time does not fit the model;
        - an entry is not finite, or a transfer function is improper;
        - D acts on an output with direct feedthrough from the inputs (algebraic loop).
    FileError
        If the file cannot be read or does not contain the matrices listed above.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> system = -fflin.lqr(lin).K  # or a state space, a transfer function, a .mat
    >>> policy = fflin.LinearController(system, lin)
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> fflin.simulate(robot, policy, v0=v0, duration=1.0).u.shape[1]
    9
    """

    system: Any
    lin: LinearModel
    sign: float = field(default=1.0, kw_only=True)
    noise: Noise | None = field(default=None, kw_only=True)
    anti_windup: ArrayLike | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if isinstance(self.system, str | Path) and isinstance(self.lin, LinearModel):
            self.lin = in_time_of_file(as_path(self.system), self.lin)
        self.lin = lin = held_if_possible(about_point(self.lin))
        if number("sign", self.sign) not in (1.0, -1.0):
            raise InputError(
                f"sign is {self.sign!r}, expected 1, or -1 for negative feedback"
            )
        if self.noise is not None and not callable(self.noise):
            raise InputError(
                f"noise is {self.noise!r}, expected noise(t) -> (ny,), a function"
            )
        self._remembers = _remembers_commands(self.system)
        controller = _system_of(self.system)
        # Expand the system to all outputs and inputs of the model, and multiply its output by the
        # sign of the feedback.
        columns = _indices(
            "input",
            controller.inputs,
            controller.D.shape[1],
            "output",
            lin.output_names,
        )
        rows = _indices(
            "output", controller.outputs, len(controller.D), "input", lin.input_names
        )
        nz, (nu, ny) = len(controller.A), lin.D.T.shape
        B, C, D = np.zeros((nz, ny)), np.zeros((nu, nz)), np.zeros((nu, ny))
        B[:, columns] = controller.B
        C[rows] = self.sign * controller.C
        D[np.ix_(rows, columns)] = self.sign * controller.D
        late = [
            index
            for index, name in enumerate(lin.state_names)
            if name in lin.added and name.partition(".")[2] in lin.input_names
        ]
        if lin.C[:, late].any():
            raise InputError(
                "an output of the model feels delayed inputs directly, such as an accelerometer, "
                "which a law with delayed inputs cannot measure; leave out this output"
            )
        felt: Mask = np.logical_and(lin.D.any(axis=1), D.any(axis=0))
        if felt.any():
            raise InputError(
                "the controller and the model form an algebraic loop through "
                f"{listed(compress(lin.output_names, felt))}, because D of both is nonzero "
                "there; set D of the controller to 0 there, for example with a low-pass filter"
            )
        dt = controller.dt
        if dt is None or (dt <= 0.0 and not nz):
            dt = lin.dt
        # A negative dt stands for an unknown sample time. The dt of a sampled model replaces it.
        if dt < 0.0 and lin.dt:
            dt = lin.dt
        if dt < 0.0 or (lin.dt and abs(dt - lin.dt) > 1e-9 * lin.dt):
            shown = "unknown" if dt < 0.0 else f"{dt:g} s"
            raise InputError(
                f"the controller has dt = {shown}, but the model has dt = {lin.dt:g} s (0: "
                "continuous); give a controller with the dt of the model, or give the continuous "
                "model"
            )
        self.system = System(
            controller.A, B, C, D, dt, lin.output_names, lin.input_names
        )
        self.sign = 1.0  # `system` contains the sign from here on
        self.windup = NOT_CORRECTED
        if self.anti_windup is not None:
            hint = " (nz, nu): states of the controller and inputs of the model"
            self.windup = shaped(
                "anti_windup", self.anti_windup, (nz, len(lin.u0)), hint
            )

    @property
    def dt(self) -> float:
        """Sample time [s]; 0 in continuous time."""
        return self.sample_time

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on delayed inputs, and on the momentum that wheels gain at the point."""
        notes = wheel_notes(self.lin)
        if self._remembers and not self.lin.added:
            notes = (
                *notes,
                "the controller was designed for delayed inputs, but its model has no delay: "
                "commands act at once unless a delay is given (delay=, --delay)",
            )
        return notes

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the outputs of the model."""
        return self.lin.output_names

    @property
    def fed_back(self) -> tuple[str, ...]:
        """Names of the states in the measured outputs of the controller."""
        acting = self.system.B.any(axis=0) | self.system.D.any(axis=0)
        return tuple(compress(self.lin.state_names, self.lin.C[acting].any(axis=0)))

    def loop_notes(self, held: float = 0.0) -> tuple[str, ...]:
        """Return notes on unstable poles of the linear loop and of the controller by itself."""
        hint = "; if it was designed for negative feedback, set sign=-1 (--negative-feedback)"
        of_loop = unstable_note("linear loop", self.loop, self.dt, hint)
        return of_loop + unstable_note(
            "controller by itself", self.system.A, self.dt, ""
        )

    def __repr__(self) -> str:
        (nu, ny), dt = self.system.D.shape, self.dt
        time = f"dt={dt:g} s" if dt else "continuous"
        nz = len(self.system.A)
        return f"{type(self).__name__}('{self.lin.robot}', nz={nz}, ny={ny}, nu={nu}, {time})"


class OutputFeedback(LinearController):
    """Feedback of the robot's outputs by a sampled compensator, such as the result of `lqg`.

    At each sample, u - u0 = C z is applied and y is measured. The state z is then advanced to the
    next sample. Accelerometer outputs are computed with the commanded u, before saturation. The
    initial estimate of the deviation from the operating point is zero.

    Parameters
    ----------
    lin : LinearModel
        Sampled model that the compensator was designed for.
    compensator : Compensator
    noise : callable, optional
        Function noise(t) that returns measurement noise (ny,), which is added to y.

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
        self, lin: LinearModel, compensator: Compensator, noise: Noise | None = None
    ) -> None:
        if isinstance(compensator, MultirateCompensator):
            raise InputError(
                "the compensator is for outputs with their own sample or delay; use "
                "fflin.MultirateFeedback(lin, compensator)"
            )
        instance(
            "compensator",
            compensator,
            Compensator,
            "a Compensator, as fflin.lqg returns it",
        )
        windup = compensator.E if compensator.E.any() else None
        super().__init__(compensator, lin, noise=noise, anti_windup=windup)
        _require_same_delays(compensator, self.lin)
        self.compensator = compensator
        if not lin.dt:
            raise InputError(
                "the model must be sampled; use lin.discretize(dt), and design the gain and the "
                "estimator for it"
            )

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes as of a `LinearController`, and on an estimated bias that settles slowly."""
        notes = super().notes
        if self.compensator.slow_bias:
            notes = (*notes, self.compensator.slow_bias)
        return notes


def _remembers_commands(given: Any) -> bool:
    """Return whether the states of a controller, or of one in a file, contain earlier commands."""
    names: tuple[str, ...] = ()
    if isinstance(given, Compensator):
        names = given.state_names
    if isinstance(given, str | Path):
        path = as_path(given)
        check_ending(path, RECORDS)
        with reading(path, "controller"):
            names = texts(read_record(path)[0].get("state_names", ()))
    return without_past(names) != names


def _require_same_delays(compensator: Compensator, lin: LinearModel) -> None:
    """Raise `InputError` if a compensator does not estimate the commands on their way in a model.

    A command that has no effect on the feedback is not estimated.
    """
    names = compensator.state_names
    past = [name for name in names if name not in without_past(names)]
    unknown_commands = [name for name in past if name not in lin.added]
    if not unknown_commands and bool(past) == bool(lin.added):
        return
    found = "without delayed inputs"
    if past:
        found = f"with the delayed inputs {listed(past)}"
    raise InputError(
        f"the compensator was designed for a model {found}, but the given model has "
        f"{listed(lin.added) or 'none'}; give the model of the design, and "
        "simulate(delay=) for another delay of the plant"
    )


def _system_of(given: Any) -> System:
    """Return the system from any form that `LinearController` accepts."""
    if isinstance(given, System):
        return given
    if isinstance(given, str | Path):
        return _read(as_path(given))
    if isinstance(given, tuple):
        if len(given) not in (4, 5):
            raise InputError(
                f"system has {len(given)} parts, expected (A, B, C, D) or (A, B, C, D, dt)"
            )
        return _checked(*given)
    if not hasattr(given, "A") and (
        hasattr(given, "to_ss") or hasattr(given, "ninputs")
    ):
        tool = type(given).__name__
        try:
            given = (
                given.to_ss()
                if hasattr(given, "to_ss")
                else import_module("control").ss(given)
            )
        except Exception as error:  # each tool raises its own types
            raise InputError(
                f"the {tool} cannot be converted to a state space: {reason(error)}; a transfer "
                "function must be proper, with no more zeros than poles"
            ) from None
    if not all(hasattr(given, key) for key in "ABC"):
        return _checked(None, None, None, as_double("system", given))
    inputs = getattr(given, "input_names", getattr(given, "input_labels", ()))
    outputs = getattr(given, "output_names", getattr(given, "output_labels", ()))
    dt = given.dt if hasattr(given, "dt") else None
    # Continuous systems of SciPy have dt = None and no signal names. In systems of other tools,
    # dt = None means that the sample time is not given.
    if dt is None and not inputs:
        dt = 0.0
    return _checked(
        given.A, given.B, given.C, getattr(given, "D", None), dt, inputs, outputs
    )


def _checked(*given: Any) -> System:
    """Return the system, or raise `InputError` if the sizes of its matrices are inconsistent.

    If A is empty, the system is the static gain D.
    """
    *matrices, dt, inputs, outputs = System(*given)
    defaults = (), (), (), 0.0
    A, B, C, D = (
        np.atleast_2d(
            as_double(f"controller's {key}", default if matrix is None else matrix)
        )
        for key, matrix, default in zip("ABCD", matrices, defaults, strict=True)
    )
    nz = len(A) if A.size else 0
    if nz:
        ny, nu = B.shape[-1], len(C)
        if D.size == 1 and not D.any():
            D = np.zeros((nu, ny))
    else:
        ny, nu = D.shape[-1], len(D)
        A, B, C = np.zeros((0, 0)), np.zeros((0, ny)), np.zeros((nu, 0))
    hint = f", for {nz} states, {ny} inputs (outputs of the model) and {nu} outputs"
    shapes = (nz, nz), (nz, ny), (nu, nz), (nu, ny)
    for key, matrix, shape in zip("ABCD", (A, B, C, D), shapes, strict=True):
        shaped(f"{key} of the controller", matrix, shape, hint)
    if dt is not None:
        # A sampled system with unknown sample time has dt = True in python-control and -1 in
        # MATLAB.
        dt = -1.0 if dt is True else number("controller's dt", dt)
    return System(A, B, C, D, dt, tuple(map(str, inputs)), tuple(map(str, outputs)))


def _read(path: Path) -> System:
    check_ending(path, RECORDS)
    with reading(path, "controller"):
        entries, _ = read_record(path)
        if len(entries) == 1 and isinstance(
            struct := next(iter(entries.values())), dict
        ):
            entries = struct  # a MATLAB struct
        dt = entries.get("dt", entries.get("Ts"))
        if dt is not None:
            dt = float(np.asarray(dt).item())
        inputs = texts(entries.get("input_names", entries.get("InputName", ())))
        outputs = texts(entries.get("output_names", entries.get("OutputName", ())))
    A, B, C, D = (entries.get(key) for key in "ABCD")
    given = [matrix is not None for matrix in (A, B, C)]
    if not all(given) and (any(given) or D is None):
        raise FileError(
            f"{path}: the file contains {listed(sorted(entries)) or 'no arrays'}, expected A, B, "
            "C, D (and Ts if sampled) or D alone; in MATLAB, save the controller K by "
            "[A, B, C, D] = ssdata(K); Ts = K.Ts; save('K.mat', 'A', 'B', 'C', 'D', 'Ts')"
        )
    with located(str(path)):
        return _checked(A, B, C, D, dt, inputs, outputs)


def _indices(
    kind: str, names: tuple[str, ...], size: int, counterpart: str, known: Sequence[str]
) -> list[int]:
    """Return, for each signal of a controller, the index of the same signal in the model."""
    named = not all(map(_NUMBERED.fullmatch, names))
    expected = len(known)
    count = "no"
    if named:
        expected = len(names)
        count = str(expected)
    if size != expected:
        raise InputError(
            f"the controller has {size} {kind}s and {count} names for them, expected a name for "
            f"each {kind}, or one {kind} for each {counterpart} of the model: {listed(known)}"
        )
    if not named:
        return list(range(size))
    indices = list[int]()
    for name in names:
        index = _index(kind, name, counterpart, known)
        if index in indices:
            raise InputError(
                f"two {kind}s of the controller are named '{name}'; give them different names"
            )
        indices.append(index)
    return indices


def _index(kind: str, name: str, counterpart: str, known: Sequence[str]) -> int:
    """Return the index of a controller's signal among the names `known` of the model."""
    # Names in python-control cannot contain dots, so underscores may replace the dots.
    fits = [candidate for candidate in known if undotted(candidate) == undotted(name)]
    if name in fits:
        fits = [name]
    if not fits:
        text = unknown(f"{counterpart} of the model", name, known)
        raise InputError(f"{kind} of the controller: {text}; or omit all {kind} names")
    if len(fits) > 1:
        raise InputError(
            f"{kind} '{name}' of the controller is ambiguous, because an underscore may replace a "
            f"dot: it fits '{fits[0]}' and '{fits[1]}'; give the {kind} the name of the model"
        )
    return known.index(fits[0])
