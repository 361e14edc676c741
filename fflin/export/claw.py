"""Policy that calls the C code of a control law, for simulations in the loop."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import FileError, InputError, MissingPackageError
from fflin.base.record import reading
from fflin.base.validation import Array
from fflin.base.writing import as_path, read_file
from fflin.control.policies import Loop, Policy, Sample
from fflin.dynamics.coordinates import frame_of
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import Actuation, StateMap
from fflin.export.laws import measured
from fflin.export.writing import digest_of
from fflin.linear.fit import require_same, require_turns, sensed
from fflin.robot.robot import Robot

_INVALID = 2  # status of a step with invalid arguments


class CLaw:
    """Policy that compiles C code written by `write_c` and calls it.

    The C compiler of the system (``cc``) compiles the code to a shared library in a temporary
    folder.

    Parameters
    ----------
    folder : path
        Folder that `write_c` wrote.
    name : str, optional
        The `name` given to `write_c`; required only if the folder contains several control laws.
    compiler : str
        Command that runs the C compiler.

    Attributes
    ----------
    name : str
        The `name` given to `write_c`, with which all names in the C code begin.
    dt : float
        Sampling time [s] of the control law; 0 in continuous time.
    frame : str
        Axes of the inputs on the base, as in `LinearModel`.
    origin : pin.SE3 or None
        Placement relative to which the state and the inputs on the base are measured.

    Raises
    ------
    FileError
        If the folder contains no law, contains several laws and `name` is omitted, or contains
        edited files.
    MissingPackageError
        If there is no C compiler.
    InputError
        If the code cannot be compiled, or was written from a `Compensator`, which contains no
        model.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> gain = fflin.lqr(fflin.linearize(robot))
    >>> policy = fflin.CLaw(fflin.write_c(gain, "flight"))
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> fflin.simulate(robot, policy, v0=v0, duration=1.0).u.shape[1]
    9
    """

    def __init__(
        self, folder: str | Path, *, name: str | None = None, compiler: str = "cc"
    ) -> None:
        source = as_path(folder).resolve()
        self._made = partial(CLaw, source, name=name, compiler=compiler)
        found = [
            path.stem
            for path in source.glob("*.json")
            if path.with_suffix(".c").is_file() and name in (None, path.stem)
        ]
        if len(found) != 1:
            raise FileError(
                f"{source}: contains {len(found)} pairs of .json and .c files, expected one pair "
                "that fflin.write_c wrote; if there are several pairs, choose one with name="
            )
        [self.name] = found
        about, header, code = (source / f"{self.name}.{end}" for end in ("json", "h", "c"))
        with reading(about, "description of C code"):
            self._about: dict[str, Any] = json.loads(read_file(about, ".json"))
            digest = self._about.pop("sha256")
            texts = read_file(header, ".h"), read_file(code, ".c")
        if digest != digest_of(self._about, *texts):
            raise FileError(
                f"{about}: does not belong to {code.name} and {header.name}, or one of these files "
                "was edited; write them again with fflin.write_c"
            )
        self.dt: float = self._about["dt"]
        self.frame: str = self._about["frame"]
        placement = self._about["reference"]
        self.origin = None if placement is None else pin.XYZQUATToSE3(np.array(placement))
        if self._about["kind"] == "output" and placement is None:
            raise InputError(
                "the C code was written from a Compensator, which does not contain the model and "
                "its outputs; write the C code from an OutputFeedback"
            )
        self._real = ctypes.c_double if self._about["real"] == "double" else ctypes.c_float
        self._step = getattr(_compiled(code, compiler), f"{self.name}_step")

    def __reduce__(self) -> tuple[Callable[[], CLaw], tuple[()]]:
        return self._made, ()  # compiled again, since a loaded library cannot be copied

    def __repr__(self) -> str:
        about = self._about
        return f"CLaw('{self.name}', {about['kind']}, {about['real']}, dt={self.dt:g} s)"

    def bind(self, robot: Robot) -> Policy:
        """Return the function policy(t, q, v) -> u for a robot.

        Each call of `bind` returns a policy with a separate controller memory.

        Raises
        ------
        InputError
            If the robot and the C code have different states, inputs or outputs.
        """
        made = f"the C code '{self.name}' was made from the {self._about['title']}"
        state = StateMap(robot, reference=self.origin, frame=frame_of(robot, self.frame))
        actuation = Actuation(state)
        there = {
            "input": (actuation.names, actuation.units),
            "state": (state.names, state.units),
            "output": sensed(state),
        }
        for kind, (names, units) in self._about["signals"].items():
            require_same(made, robot, kind, (tuple(names), tuple(units)), there[kind])
        require_turns(made, self._about["nq"], robot)
        of_outputs = self._about["kind"] == "output"
        return _OutputLoop(self, state) if of_outputs else self._state_policy(state)

    def _state_policy(self, state: StateMap) -> Policy:
        world, n = StateMap(state.robot, frame=state.frame), state.robot.n
        real = self._real
        # C has no empty arrays, so an array for joints has at least one entry.
        given, u = (real * (13 + 2 * max(n, 1)))(), (real * len(self._about["u0"]))()
        at = [*range(7 + n), *range(7 + max(n, 1), 13 + n + max(n, 1))]
        samples = self._about["kind"] == "samples"

        def policy(t: float, q: Array, v: Array) -> Array:
            for k, value in zip(at, measured(world, q, v).tolist(), strict=True):
                given[k] = value
            sample = (ctypes.c_ulong(round(t / self.dt)),) if samples else ()
            self._check(self._step(*sample, given, u), t)
            return np.array(u)

        return policy

    def output_step(self, z: Array, y: Array, t: float) -> tuple[Array, Array]:
        """Return u and the next controller state from the controller state z and outputs y."""
        real = self._real
        memory = (real * max(len(z), 1))(*z.tolist())
        u = (real * len(self._about["u0"]))()
        self._check(self._step(memory, (real * len(y))(*y.tolist()), u), t)
        return np.array(u), np.array(memory)[: len(z)]

    def _check(self, status: int, t: float) -> None:
        if status == _INVALID:
            raise InputError(
                f"the C code of '{self.name}' returned INVALID at t = {t:g} s: an argument was not "
                "finite or too large"
            )


class _OutputLoop(Loop):
    """Control loop that calls the C code as its controller."""

    def __init__(self, law: CLaw, state: StateMap) -> None:
        about = law._about
        q, v = map(np.array, about["point"])
        there = Measuring(state, q), state.read(q, v)
        super().__init__(state, law.dt, None, about["memory"], lambda _: None, lambda _: there)
        self._law, self._u0 = law, np.array(about["u0"])

    def step(self, t: float, measure: Callable[[Sample, Array], Array]) -> Array:
        """Return the command of a sample.

        Outputs are measured twice, because an accelerometer measures accelerations under this
        command.
        """
        by = self.at(t)
        u, _ = self._law.output_step(self.estimate, measure(by, self._u0), t)
        u, self.estimate = self._law.output_step(self.estimate, measure(by, u), t)
        return u


def _compiled(source: Path, compiler: str) -> ctypes.CDLL:
    """Compile a source file, and return its shared library."""
    if not isinstance(compiler, str) or "\0" in compiler:
        raise InputError(f"compiler is {compiler!r}, expected the name of a C compiler, such as cc")
    command = shutil.which(compiler)
    if command is None:
        raise MissingPackageError(
            f"there is no C compiler '{compiler}'; install one, such as gcc, or give compiler="
        )
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "law.so"
        flags = ["-std=c99", "-O2", "-fPIC", "-shared", "-ffp-contract=off"]
        done = subprocess.run(
            [command, *flags, "-o", str(library), str(source), "-lm"],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            line = next((x for x in done.stderr.splitlines() if "error" in x), done.stderr)
            raise InputError(f"{source}: cannot be compiled: {line}")
        try:
            return ctypes.CDLL(str(library))
        except OSError as error:
            raise InputError(f"'{compiler}' made no library from {source}: {error}") from None
