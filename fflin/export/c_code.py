"""C code of a control law (source, header, test program), and a policy that calls the code."""

from __future__ import annotations

import ctypes
import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base import __version__
from fflin.base.errors import FileError, InputError, MissingPackageError, listed
from fflin.base.record import content_digest, reading
from fflin.base.validation import Array, frozen
from fflin.base.writing import as_path, failing, read_file, write_atomically
from fflin.control.bdot import measured_field
from fflin.control.loops import Loop, Measure, Step, next_sample
from fflin.control.policy import BoundLaw, Command, Policy
from fflin.control.sensors import SensorTiming, lags_of_robot, timing_of_robot
from fflin.dynamics.coordinates import Frame, frame_of
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap
from fflin.export.laws import CASES, Case, Law, law_of, measured
from fflin.linear.fit import require_configuration_size, require_same
from fflin.robot.robot import Robot

_DOUBLE = {
    "sqrt": "sqrt",
    "largest": "DBL_MAX",
    "smallest": "DBL_MIN",
    "two_pi": "6.283185307179586477",
}
_FLOAT = {
    "sqrt": "sqrtf",
    "largest": "FLT_MAX",
    "smallest": "FLT_MIN",
    "two_pi": "6.283185307179586477F",
}

_INVALID = 2  # status of a call, as in templates/header.h
_LARGEST = 2**26  # [bytes] largest size of each file of a law

# Valid names, without the names of headers that the code or the C library includes.
_NAME = r"(?!(features|float|math|std\w*)$)[A-Za-z][A-Za-z0-9_]{0,40}"


def write_c(
    law: object,
    folder: str | Path,
    *,
    robot: Robot | None = None,
    limits: object = None,
    name: str = "controller",
    real: str = "double",
) -> Path:
    r"""Write a control law as C99 code, with a test program.

    The function writes the code to ``NAME.h`` and ``NAME.c``, the test program to ``NAME_test.c``,
    and a description that `CLaw` reads to ``NAME.json``. The code calls no library function except
    ``sqrt``, allocates no memory and has no global variables. The header describes each entry of
    the arguments.

    The code's function ``NAME_step`` computes the inputs of one sample:

    - For a state feedback, the arguments are the measured attitude, position, joint angles and
      velocities. ``NAME_step`` computes the state in the same way as `StateMap`, then the inputs
      from the state. For a robot with constraints, the arguments are the same. The law feeds back
      the independent states only; the header names the other states.
    - For an output feedback, the arguments are the outputs y, and the controller memory, which the
      caller allocates. A state feedback with integral action also has this memory. If the inputs
      saturate at `limits`, the integrals are corrected as in `simulate`.
    - For `BDot` and `RateDamping`, the arguments are the derivative of the magnetic flux density,
      or the flux density and the angular velocity, in base axes.
    - For gains along a trajectory, for a law that follows one, and for outputs that are measured at
      different rates, the sample number is an additional argument. The gains of a periodic
      trajectory repeat. The attitudes and positions in the outputs y of a law that follows a
      trajectory are relative to the base poses of the trajectory, which ``NAME.json`` lists, at the
      sample of the measurement. The code is for the sample times and delays of the sensors of
      `robot`.

    Parameters
    ----------
    law : Gain, StateFeedback, ScheduledFeedback, OutputFeedback, LinearController or GainSchedule
        Control law; a `MultirateFeedback`, `Compensator`, `TrajectoryFeedback`, `BDot` or
        `RateDamping` is also accepted. Controllers and gains along a trajectory must be in
        discrete time.
    folder : path
        Folder for the files; created if it does not exist. Existing files with the same names are
        replaced only if they were written for the same type of law and the same robot, and if the
        header and the source were not edited since.
    robot : Robot, optional
        Robot for which the law was designed. Give it if the law does not contain the robot, and
        `load` does not return this robot for its name. Laws that were read from a file, and every
        `Compensator`, `BDot` and `RateDamping`, do not contain the robot.
    limits : "urdf", float, mapping or list, optional
        Limits at which the inputs saturate, as in `simulate`; none by default.
    name : str
        Prefix of the file names and of all names in the C code. A program cannot include the
        headers of two laws whose names differ only in upper and lower case.
    real : {"double", "float"}
        Floating-point type of the C code.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        If one of these conditions is true:

        - the law cannot be written in C;
        - the robot of the law is not known;
        - existing files with the same names were not written for the same law and robot, or were
          edited;
        - an argument is invalid.
    FileError
        If the folder or a file cannot be written.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> gain = fflin.lqr(fflin.linearize(robot))
    >>> folder = fflin.write_c(gain, "flight")
    >>> sorted(path.name for path in folder.iterdir())
    ['controller.c', 'controller.h', 'controller.json', 'controller_test.c']
    """
    if not isinstance(name, str) or not re.fullmatch(_NAME, name):
        raise InputError(
            f"name is {name!r}, expected letters, digits or _ after a letter; not float, math, std*"
        )
    if not isinstance(real, str) or real not in ("double", "float"):
        raise InputError(f"real is {real!r}, expected 'double' or 'float'")
    target = as_path(folder)
    title, texts = _texts(law_of(law, robot, limits), name, real)
    contents = {
        target / f"{name}{ending}": text.encode() for ending, text in texts.items()
    }
    with failing(target, "written"):
        old = next(
            (x for x in contents if target.exists() and x in {*target.iterdir()}), None
        )
        new = [
            directory
            for directory in (target, *target.parents)
            if not directory.exists()
        ]
    written_title = None
    with suppress(FileError, TypeError):
        written_title = _description(target / f"{name}.json")["title"]
    if old and written_title != title:
        raise InputError(
            f"{old} exists and does not belong to the {title}, or the code was edited; give "
            "another name= (--name) or another folder, or delete the files of this name"
        )
    try:
        with failing(target, "written"):
            target.mkdir(parents=True, exist_ok=True)
        write_atomically(contents)
    except BaseException:
        for directory in new:  # leave no empty folder
            with suppress(OSError):
                directory.rmdir()
        raise
    return target


def digest_of(about: dict[str, object], header: bytes, source: bytes) -> str:
    """Return the SHA-256 of a law's description, header and source, to detect any change."""
    return content_digest(
        {"about": json.dumps(about).encode(), "header": header, "source": source}
    )


def _description(path: Path) -> dict[str, Any]:
    """Return the description of C code, or raise `FileError` if a file was edited."""
    with reading(path, "description of C code"):
        # A later call may write the code again.
        read = partial(read_file, limit=_LARGEST, replaceable=True)
        about: dict[str, Any] = json.loads(read(path, ".json"))
        header = read(path.with_suffix(".h"), "C header")
        code = read(path.with_suffix(".c"), "C")
        if about.pop("sha256") != digest_of(about, header, code):
            raise FileError(
                f"{path}: does not belong to its .c and .h files, or one of these files was "
                "edited; delete them, and write them again with fflin.write_c"
            )
    return about


class CLaw(Policy):
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
        Sample time [s] of the control law; 0 in continuous time.
    frame : str
        Axes of the inputs on the base, as in `LinearModel`.
    origin : pin.SE3 or None
        Placement relative to which the state and the inputs on the base are measured.
    initial_inputs : ndarray (nu,)
        Inputs at the target or, for a trajectory, at its first sample. If commands are delayed,
        these inputs act until the first command arrives.

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
        with failing(as_path(folder), "read"):
            source = as_path(folder).resolve()
            pairs = sorted(x.stem for x in source.iterdir() if x.suffix == ".json")
            names = [
                x for x in pairs if name in (None, x) and (source / f"{x}.c").is_file()
            ]
        self._made = partial(CLaw, source, name=name, compiler=compiler)
        if not names:
            wanted = f"C code named '{name}'" if name else "C code"
            raise FileError(f"{source}: contains no {wanted} that fflin.write_c wrote")
        if len(names) > 1:
            raise FileError(
                f"{source}: contains the laws {listed(names)}; choose one with name="
            )
        [self.name] = names
        self._about = _description(source / f"{self.name}.json")
        self.dt: float = self._about["dt"]
        self.frame: Frame = self._about["frame"]
        self.initial_inputs: Array = frozen(np.array(self._about["u0"], dtype=float))
        placement = self._about["reference"]
        self.origin = (
            None if placement is None else pin.XYZQUATToSE3(np.array(placement))
        )
        known = placement is not None or "points" in self._about
        if self._about["kind"] == "output" and not known:
            raise InputError(
                "the C code was written from a Compensator, which does not contain the model and "
                "its outputs; write the C code from an OutputFeedback"
            )
        self._real = np.float64 if self._about["real"] == "double" else np.float32
        self._step = getattr(
            _compiled(source / f"{self.name}.c", compiler), f"{self.name}_step"
        )

    @property
    def sample_time(self) -> float:
        """Sample time [s]; 0 in continuous time."""
        return self.dt

    @property
    def input_delays(self) -> dict[str, float]:
        """Delay [s] of each input in the model for which the law was designed."""
        names, _ = self._about["signals"]["input"]
        return dict(zip(names, self._about.get("delay", ()), strict=False))

    @property
    def axes(self) -> tuple[Frame | None, pin.SE3 | None]:
        """Frame and reference of the code."""
        return self.frame, self.origin

    def initial_inputs_for(self, names: tuple[str, ...]) -> Array | None:
        """Return the inputs of the code at its target."""
        return self.initial_inputs

    def __reduce__(self) -> tuple[Callable[[], CLaw], tuple[()]]:
        # compile again, because a loaded library cannot be copied
        return self._made, ()

    def __repr__(self) -> str:
        about = self._about
        return (
            f"CLaw('{self.name}', {about['kind']}, {about['real']}, dt={self.dt:g} s)"
        )

    def bind(self, robot: Robot) -> Command:
        """Return the function policy(t, q, v) -> u for a robot.

        Each call of `bind` returns a policy with a separate controller memory.

        Raises
        ------
        InputError
            If the robot and the C code have different states, inputs or outputs.
        """
        made = f"the C code '{self.name}' was made from the {self._about['title']}"
        state = StateMap(
            robot, reference=self.origin, frame=frame_of(robot, self.frame)
        )
        magnetic = self._about["kind"] == "magnetic"
        for kind, (names, units) in self._about["signals"].items():
            if magnetic and kind != "input":
                continue
            require_same(made, state, kind, tuple(names), tuple(units))
        require_configuration_size(made, self._about["nq"], robot)
        if magnetic:
            return self._magnetic_command(robot)
        if self._about["kind"] == "output":
            return self._output_loop(state)
        world = StateMap(robot, frame=state.frame)
        n = robot.n
        # C has no empty arrays. So the C arrays for the joints have one entry if there is no joint.
        room = max(n, 1)
        given, u = (
            np.zeros(size, self._real)
            for size in (13 + 2 * room, len(self._about["u0"]))
        )
        at = [*range(7 + n), *range(7 + room, 13 + n + room)]
        if self._about["memory"]:
            return _Remembering(self, world, given, at, u)

        def policy(t: float, q: Array, v: Array) -> Array:
            given[at] = measured(world, q, v)
            self._call(t, *self._sample(t), given.ctypes, u.ctypes)
            return u.astype(float)

        return policy

    def _magnetic_command(self, robot: Robot) -> Command:
        """Return the command of a law of the magnetic field, which is measured without errors."""
        measure = measured_field(robot, rate=self._about["measures_rate"])
        u = np.zeros(len(self._about["u0"]), self._real)

        def policy(t: float, q: Array, v: Array) -> Array:
            y = measure(t, q, v).astype(self._real)
            self._call(t, y.ctypes, u.ctypes)
            return u.astype(float)

        return policy

    def _output_loop(self, state: StateMap) -> Loop:
        """Return the command of an output law, which measures relative to its reference."""
        sizes = (self._about["memory"], 0)
        self._require_timing(state)
        start = np.array(self._about["y0"]) if "y0" in self._about else None

        def at_point(t: float) -> tuple[Step, Measuring, Array]:
            return partial(self._output_step, t), measuring, x

        def along(t: float) -> tuple[Step, Measuring, Array]:
            row = min(round(t / self.dt), len(q) - 1)
            relative = state.about(state.origin * pin.XYZQUATToSE3(q[row, :7]))
            x = relative.read(q[row], v[row])
            return partial(self._output_step, t), Measuring(relative, q[row]), x

        if "points" in self._about:
            q, v = (np.array(self._about["points"][key]) for key in "qv")
            # `Loop` refuses sensors with a lag, and late sensors for code of earlier versions,
            # which compares all outputs with the plan at the same time.
            if lags_of_robot(state).any() or "timing" not in self._about:
                start = None
            return Loop(state, self.dt, sizes, along, start=start)
        q, v = map(np.array, self._about["point"])
        measuring = Measuring(state, q)
        x = state.read(q, v)
        return Loop(state, self.dt, sizes, at_point, start=start)

    def _require_timing(self, state: StateMap) -> None:
        """Raise `InputError` if a robot has sensors with other times than the code."""
        timing = self._about.get("timing")
        if timing is None:
            return
        written = SensorTiming(tuple(timing["periods"]), tuple(timing["delays"]))
        if timing_of_robot(state, self.dt) != written:
            raise InputError(
                f"the outputs of '{state.robot.name}' have other sample times or delays than the "
                f"outputs for which the C code '{self.name}' was written; write it with "
                "robot= for this robot"
            )

    def _sample(self, t: float) -> tuple[object, ...]:
        """Return the number of the sample at time t [s], if the code needs it."""
        numbered = self._about["kind"] == "samples" or "points" in self._about
        if numbered or self._about.get("period", 1) > 1:
            return (ctypes.c_ulong(round(t / self.dt)),)
        return ()

    def _output_step(self, t: float, z: Array, measure: Measure) -> tuple[Array, Array]:
        """Return the command u of a sample, and the next controller state.

        z is the controller state, and `measure(u)` returns the outputs under the inputs u. The C
        code is called twice, because accelerometers measure the effect of the command. The outputs
        for the second call are measured under the command from the first call.
        """
        u = np.array(self._about["u0"])
        for _ in range(2):
            memory = np.append(z, 0.0).astype(self._real)
            out = np.zeros(len(u), self._real)
            y = measure(u).astype(self._real)
            self._call(t, memory.ctypes, *self._sample(t), y.ctypes, out.ctypes)
            u = out.astype(float)
        return u, memory[:-1].astype(float)

    def _call(self, t: float, *arguments: object) -> None:
        """Call the C code at time t [s], or raise `InputError` if an argument is invalid."""
        if self._step(*arguments) == _INVALID:
            raise InputError(
                f"the C code of '{self.name}' returned INVALID at t = {t:g} s: an argument was not "
                "finite or too large"
            )


class _Remembering(BoundLaw):
    """Command of the C code of a state law with a memory."""

    def __init__(
        self, law: CLaw, world: StateMap, given: Any, at: list[int], u: Any
    ) -> None:
        self._law, self._world, self._given, self._at = law, world, given, at
        self._memory: Any = np.zeros(law._about["memory"], law._real)
        self._u = u
        self._last = -np.inf

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the inputs (nu,) of a sample, and advance the memory."""
        self._last = next_sample(t, self._last, self._law.dt)
        self._given[self._at] = measured(self._world, q, v)
        sample = self._law._sample(t)
        self._law._call(
            t, self._memory.ctypes, *sample, self._given.ctypes, self._u.ctypes
        )
        command: Array = self._u.astype(float)
        return command


def _compiled(source: Path, compiler: str) -> ctypes.CDLL:
    """Compile a C source file to a shared library, and return the loaded library."""
    if not isinstance(compiler, str) or "\0" in compiler:
        raise InputError(
            f"compiler is {compiler!r}, expected the name of a C compiler, such as cc"
        )
    program = shutil.which(compiler)
    if program is None:
        raise MissingPackageError(
            f"there is no C compiler '{compiler}'; install one, such as gcc, or give compiler="
        )
    try:
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder) / "law.so"
            flags = ["-std=c99", "-O2", "-fPIC", "-shared", "-ffp-contract=off"]
            command = [program, *flags, "-o", str(library), str(source), "-lm"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                line = next(
                    (x for x in done.stderr.splitlines() if "error" in x), done.stderr
                )
                raise InputError(f"{source}: cannot be compiled: {line}")
            return ctypes.CDLL(str(library))
    except OSError as error:
        raise InputError(
            f"'{compiler}' made no library from {source}: {error}"
        ) from None


def _texts(law: Law, name: str, real: str) -> tuple[str, dict[str, str]]:
    """Return the title of a law, and the texts of its four files as {file ending: text}."""
    state, tables, robot = law.state, law.tables, law.robot
    names, units = law.inputs
    kind = law.kind
    title = f"{law.title} of '{robot.name}'"
    frame = _frame_of(law)
    # Largest rounding error that the test program accepts, relative to `Case.scale`, the sum of the
    # magnitudes of the terms. In single precision, the error is the unit roundoff 2^-24 times the
    # number of operations.
    error = 1e-14 if real == "double" else law.operations * 2.0**-24
    bounds = error * np.max([case.scale for case in law.cases], axis=0)
    sizes = [f"{x:.2e} {unit}" for x, unit in zip(bounds, units, strict=False)]
    array = partial(_array, real=real)
    vectors = [_vector(case, law, error, array) for case in law.cases]
    outs = [
        *map(_plain, names),
        *(f"next z[{k}]" for k in range(law.memory)),
    ]
    of_type = _DOUBLE if real == "double" else _FLOAT
    signal = "x" if state else "y"
    words: dict[str, object] = {
        **of_type,
        **{key: array(table) for key, table in tables.items()},
        "name": name,
        "NAME": name.upper(),
        "real": real,
        "count": CASES,
        "law": law.title,
        "frame": frame or "not known",
        "dependent": _dependent_comment(law),
        "robot": _plain(robot.name),
        "sha256": robot.urdf_sha256 or "not known",
        "world": ", the orbital frame" if robot.orbit else "",
        "fflin_version": __version__,
        "pinocchio_version": pin.__version__,
        "sample_time": f"{law.dt!r} s"
        if law.dt
        else "none, the law is continuous in time",
        "error": f"{error:.2g}",
        "tolerances": _listed("u", names, sizes),
        "inputs": len(names),
        "input_list": _listed("u", names, units),
        **_sample_words(len(tables["u0"]), repeats=law.repeats),
        f"{kind}_list": _listed(signal, *law.signals),
        "vectors": "{\n" + ",\n".join(vectors) + "}",
        "ins": len(law.cases[0].given),
        "outs": len(outs),
        "out_names": ",\n".join(f'    "{out_name}"' for out_name in outs),
    }
    words |= dict.fromkeys(("windup", "windup_next", "windup_comment"), "")
    words |= _period_words(law.period)
    if tables["E"].size:
        words["windup"] = _filled("windup.c", words)
        words["windup_next"] = _filled("windup_next.c", words)
        words["windup_comment"] = "\n * plus E times the change of u by the limits"
    if state:
        words |= _state_words(law, state)
        words["interpolation"] = (
            _filled("interpolation.c", words) if "axis_size" in tables else ""
        )
        words |= _memory_words(words, law.memory, str(words["sample_given"]))
    elif law.magnetic is not None:
        words |= {"outputs": len(law.signals[0])}
        words |= _magnetic_words(words, measures_rate=law.magnetic.measures_rate)
    else:
        nz = law.memory
        outputs = tables["y0"].shape[1]
        words |= {"states": nz, "states_max": max(nz, 1), "outputs": outputs}
        comment = _sample_comment(law, name, str(words["sample_comment"]))
        words["sample_comment"] = comment
    words["interface"] = _filled(f"{kind}_interface.h", words)
    words["limiting"] = _filled("limiting.c", words).rstrip()
    words["run"] = _filled(f"{kind}_run.c", words)
    header, source = _filled("header.h", words), _filled(f"{kind}_law.c", words)
    about = _about(law, title, real, frame)
    about["sha256"] = digest_of(about, header.encode(), source.encode())
    code = {".h": header, ".c": source, "_test.c": _filled("test.c", words)}
    return title, {**code, ".json": json.dumps(about, indent=1) + "\n"}


def _magnetic_words(
    words: dict[str, object], *, measures_rate: bool
) -> dict[str, object]:
    """Return {placeholder: text} for placeholders that occur only in templates of magnetic laws."""
    if measures_rate:
        return {
            "formula": "u = D (b x omega) / |b|^2, with the magnetic flux density b and the "
            "inertial angular\n * velocity omega, both in base axes.",
            "vector_code": _filled("rate_damping.c", words),
        }
    return {
        "formula": "u = D db/dt, with the derivative of the magnetic flux density b in base "
        "axes, such as\n * the difference of two measurements divided by the time between them.",
        "vector_code": _filled("flux_rate.c", words),
    }


def _dependent_comment(law: Law) -> str:
    """Return the comment on the states that constraints determine; empty without constraints."""
    if law.state is None or law.lin is None or not law.lin.dependent:
        return ""
    lines = [f"\n *   {_plain(name)}" for name in law.lin.dependent]
    return (
        "\n * Constraints of the robot determine the following states from the others. The law\n"
        f" * does not feed them back, and their measured values have no effect:{''.join(lines)}"
    )


def _frame_of(law: Law) -> str:
    """Return the frame of a law; empty if it is not known."""
    if law.state:
        return law.state.frame
    if law.lin:
        return law.lin.frame
    if law.magnetic:
        return "lvlh"
    return "local" if law.points else ""


def _about(law: Law, title: str, real: str, frame: str) -> dict[str, object]:
    """Return the description of a law that `CLaw` reads, without its SHA-256."""
    state, lin, robot = law.state, law.lin, law.robot
    kind = law.kind
    u0 = law.tables["u0"]
    initial = u0[0] if law.initial is None else law.initial
    about: dict[str, object] = {
        "title": title,
        "real": real,
        "frame": frame,
        "dt": law.dt,
        "kind": "samples" if state and len(u0) > 1 else kind,
        "signals": {"input": law.inputs, kind: law.signals},
        "nq": robot.nq,
        "u0": initial.tolist(),
        "memory": law.memory,
        "reference": None,
        "point": None,
    }
    if lin is not None:
        about["nq"] = len(lin.q)
        about["reference"] = lin.placement.tolist()
        about["point"] = [lin.q.tolist(), lin.v.tolist()]
        if lin.delay.any():
            about["delay"] = lin.delay.tolist()
    if law.magnetic is not None:
        about["measures_rate"] = law.magnetic.measures_rate
    elif not state:
        about |= {"period": law.period, "y0": law.tables["y0"][0].tolist()}
    if law.delay:
        about["delay"] = list(law.delay)
    if law.points:
        q, v = law.points
        about["points"] = {"q": q.tolist(), "v": v.tolist()}
    if law.timing is not None:
        about["timing"] = law.timing._asdict()
    return about


def _period_words(period: int) -> dict[str, object]:
    """Return {placeholder: text} for an output law with a table for each sample of a period."""
    words: dict[str, object] = dict.fromkeys(
        ("tables", "table", "table_row", "table_comment"), ""
    )
    if period > 1:
        words |= {
            "sample_argument": "unsigned long sample, ",
            "sample_given": "given->sample, ",
            "tables": f"[{period}]",
            "table": "[table]",
            "table_row": f"    const unsigned long table = sample % {period}UL;\n",
            "table_comment": "One table for each sample of a period. ",
        }
    return words


def _sample_comment(law: Law, name: str, rows: str) -> str:
    """Return the comment on the samples of an output law; `rows` is the comment on its rows."""
    lines = [rows.strip()]
    if law.points:
        lines += [
            "Attitudes and positions in y are relative to the base pose of the trajectory at",
            f"the sample at which they were measured; {name}.json lists the base poses.",
        ]
    if law.period > 1:
        counts = "" if rows else "sample counts from 0. "
        lines.append(f"{counts}A and B repeat after {law.period} samples.")
    if law.timing is not None and not law.timing.is_plain:
        lines += [
            "y contains the latest value of each output that arrived, and before the first one",
            "y0 of the first sample.",
        ]
    return "".join(f"\n * {line}" for line in lines if line)


def _vector(case: Case, law: Law, error: float, array: Callable[[Array], str]) -> str:
    """Return the C initialiser of a test case, whose results are within the limits of the law."""
    tables = law.tables
    nu = len(tables["low"])
    out = case.out.copy()
    out[:nu] = np.clip(out[:nu], tables["low"], tables["high"])
    cut = (out - case.out)[:nu]
    scale = case.scale.copy()
    E = tables["E"]
    if E.ndim > 2:  # one matrix for each sample of a period
        E = E[case.sample % len(E)]
    if E.size:
        out[nu:] += E @ cut
        scale[nu:] += np.abs(E) @ scale[:nu]
    numbers = map(array, (case.given, out, error * scale))
    return f"{{{case.sample}UL, {', '.join(numbers)}, {int(cut.any())}}}"


def _sample_words(rows: int, *, repeats: bool) -> dict[str, object]:
    """Return {placeholder: text} for the number of the sample of a law with rows for samples."""
    words: dict[str, object] = {
        "rows": rows,
        "row": "0",
        **dict.fromkeys(("sample_argument", "sample_given", "sample_comment"), ""),
    }
    if rows > 1:
        last = rows - 1
        words |= {
            "row": f"(sample < {last}UL ? sample : {last}UL)",
            "sample_argument": "unsigned long sample, ",
            "sample_given": "given->sample, ",
            "sample_comment": f" sample counts from 0; the last row applies from {last} on.",
        }
    if repeats:
        words |= {
            "sample_comment": f" sample counts from 0; the rows repeat after {rows} samples.",
            "row": f"(sample % {rows}UL)",
        }
    return words


def _state_words(law: Law, state: StateMap) -> dict[str, object]:
    """Return {placeholder: text} for placeholders that occur only in templates of state laws."""
    n = state.robot.n
    points = law.tables.get("axis_points")
    words: dict[str, object] = {
        "joints": n,
        "joints_max": max(n, 1),
        "states": state.nx,
        "gains": len(law.tables["K"]),
        "joint_list": _listed("joints", state.names[6 : 6 + n], state.units[6 : 6 + n]),
        "gains_between": "",
        "feedback": "feed_back(0, 1, x, u);",
    }
    if len(law.tables["K"]) > 1:
        words["feedback"] = "feed_back((int)row, 1, x, u);"
    if points is not None:
        axes, room = points.shape
        joints = ", ".join(
            _plain(state.robot.joint_names[i]) for i in law.tables["axis_joint"]
        )
        words |= {
            "axis_count": axes,
            "axis_room": room,
            "corners": 2**axes,
            "feedback": "feed_back_between(measured, x, u);",
            "gains_between": f", K interpolated linearly over {joints}, constant outside",
        }
    return words


def _memory_words(
    words: dict[str, object], memory: int, sample: str
) -> dict[str, object]:
    """Return {placeholder: text} for the memory of a state law; empty texts without memory."""
    keys = ("interface", "comment", "argument", "tables", "start", "local", "feedback")
    texts: dict[str, object] = {
        **dict.fromkeys((f"memory_{key}" for key in (*keys, "next", "run")), ""),
        "run_step": f"return {words['name']}_step({sample}&m, out);",
    }
    if not memory:
        return texts
    name, upper = words["name"], words["NAME"]
    words = words | {"memory": memory}
    texts |= {
        "memory_interface": _filled("memory_interface.h", words),
        "memory_comment": ", and the memory is unchanged.\n * Call once every sample time. The "
        "inputs also contain C z of the memory z. Then the next z is\n * A z + B (x - x0)"
        f"{words['windup_comment']}",
        "memory_argument": f"{name}_memory *memory, ",
        "memory_local": f", next[{upper}_MEMORY_MAX]",
        "memory_run": f"    {name}_memory memory;\n    int status;\n\n"
        f"    {name}_start(&memory);\n    for (i = 0; i < {upper}_MEMORY; i++) {{\n"
        "        memory.z[i] = *in++;\n    }\n",
        "run_step": f"status = {name}_step(&memory, {sample}&m, out);\n"
        f"    for (i = 0; i < {upper}_MEMORY; i++) {{\n"
        f"        out[{upper}_INPUTS + i] = memory.z[i];\n    }}\n    return status;",
    }
    for part in ("tables", "start", "feedback", "next"):
        texts[f"memory_{part}"] = _filled(f"memory_{part}.c", words)
    return texts


def _filled(template: str, words: dict[str, object]) -> str:
    text = files("fflin.export").joinpath("templates", template).read_text("utf-8")
    return Template(text).substitute(words)


def _array(values: Array, real: str) -> str:
    """Return the C initialiser of an array."""
    # C has no empty arrays. So an array without rows or columns gets a row or a column of zeros.
    values = np.pad(values, [(0, int(not size)) for size in values.shape])
    if values.ndim > 1:
        return "{\n" + ",\n".join(_array(row, real) for row in values) + "}"
    if values.dtype.kind != "f":
        return "{" + ", ".join(str(int(x)) for x in values) + "}"
    if real == "float":
        with np.errstate(over="ignore"):
            narrow = values.astype(np.float32)
        if (np.isfinite(values) & ~np.isfinite(narrow)).any():
            raise InputError(
                "the law has numbers that are too large for a float; use real='double'"
            )
        values = narrow.astype(float)
    end = "F" if real == "float" else ""
    shown = ", ".join(f"{x!r}{end}" for x in values.tolist())
    return "{" + shown.replace(f"inf{end}", "NO_LIMIT") + "}"


def _plain(text: str) -> str:
    """Replace by "_" each character that may be invalid in a C comment or a C string."""
    return re.sub(r"[^\w .,+^()\[\]/-]", "_", text, flags=re.ASCII)


def _listed(array: str, names: Sequence[str], units: Sequence[str]) -> str:
    """Return lines of a C comment, one for each entry of an array, with its name and unit."""
    return "\n".join(
        f" *   {array}[{k}]  {_plain(name)} [{_plain(unit) or '-'}]"
        for k, (name, unit) in enumerate(zip(names, units, strict=True))
    )
