"""C source, header and test program of a control law."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
import pinocchio as pin

from fflin.base import __version__
from fflin.base.errors import InputError
from fflin.base.record import content_digest
from fflin.base.writing import as_path, write_atomically
from fflin.export.laws import CASES, OutputLaw, StateLaw, law_of
from fflin.robot.robot import Robot

_DOUBLE = {"sqrt": "sqrt", "largest": "DBL_MAX", "two_pi": "6.283185307179586477"}
_FLOAT = {"sqrt": "sqrtf", "largest": "FLT_MAX", "two_pi": "6.283185307179586477F"}

# Largest accepted rounding error in double precision, relative to the magnitudes of the terms.
_DOUBLE_ERROR = 1e-14


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
      from the state.
    - For an output feedback, the arguments are the outputs y, and the controller memory, which the
      caller allocates.
    - For gains along a trajectory, the sample number is an additional argument.

    Parameters
    ----------
    law : Gain, StateFeedback, ScheduledFeedback, OutputFeedback, LinearController or GainSchedule
        Control law; a `Compensator` or `TrajectoryFeedback` is also accepted. Controllers and gains
        along a trajectory must be in discrete time.
    folder : path
        Folder for the files; created if it does not exist. Existing files with the same names are
        replaced only if they were written for the same type of law and the same robot.
    robot : Robot, optional
        Robot that the law controls. Give the robot only if the law was read from a file and `load`
        does not know the robot's name in this file.
    limits : "urdf", float, mapping or list, optional
        Limits at which the inputs saturate, as in `simulate`; none by default.
    name : str
        Prefix of the file names and of all names in the C code.
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
        - existing files with the same names were not written for the same law and robot;
        - an argument is invalid.
    FileError
        If a file cannot be written.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> gain = fflin.lqr(fflin.linearize(robot))
    >>> folder = fflin.write_c(gain, "flight")
    >>> sorted(path.name for path in folder.iterdir())
    ['controller.c', 'controller.h', 'controller.json', 'controller_test.c']
    """
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,40}", name):
        raise InputError(
            f"name is {name!r}, expected a letter and then letters, digits or _, for names in C"
        )
    if not isinstance(real, str) or real not in ("double", "float"):
        raise InputError(f"real is {real!r}, expected 'double' or 'float'")
    target = as_path(folder)
    tables = law_of(law, robot, limits)
    texts = _Texts(tables, name, real)
    contents = {target / file: text.encode() for file, text in texts.files().items()}
    old = next((path for path in contents if path.exists()), None)
    title = None
    with suppress(OSError, ValueError, TypeError, LookupError):
        title = json.loads((target / f"{name}.json").read_bytes())["title"]
    if old and title != texts.title:
        raise InputError(
            f"{old} exists and does not belong to the {texts.title}; give another name= (--name) "
            "or another folder, or delete the file"
        )
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target}: cannot be made: {error.strerror}") from None
    write_atomically(contents)
    return target


def digest_of(about: dict[str, object], header: bytes, source: bytes) -> str:
    """Return the digest that shows whether a law's description and code belong together."""
    parts = {"about": json.dumps(about).encode(), "header": header, "source": source}
    return content_digest(parts)


class _Texts:
    """Files of a law, made from the templates of this folder."""

    def __init__(self, law: StateLaw | OutputLaw, name: str, real: str) -> None:
        self.law, self.name, self.real, self.cases = law, name, real, law.cases()
        # For single precision, the bound is the unit roundoff times the number of operations.
        self.error = _DOUBLE_ERROR if real == "double" else law.operations * 2.0**-24
        bounds = self.error * np.max([case.scale for case in self.cases], axis=0)
        sizes = [f"{x:.2e} {unit}" for x, unit in zip(bounds, law.inputs[1], strict=False)]
        robot = law.robot
        self.kind = "state" if isinstance(law, StateLaw) else "output"
        self.title = f"{law.title} of '{robot.name if robot else 'unknown'}'"
        self.words: dict[str, object] = {
            **(_DOUBLE if real == "double" else _FLOAT),
            **{"name": name, "NAME": name.upper(), "real": real, "count": CASES},
            **{"law": law.title, "frame": law.frame or "not known"},
            "robot": _plain(robot.name if robot else "unknown"),
            "sha256": (robot.urdf_sha256 if robot else "") or "not known",
            "world": ", the orbital frame" if robot and robot.orbit else "",
            "fflin_version": __version__,
            "pinocchio_version": pin.__version__,
            "sample_time": f"{law.dt!r} s" if law.dt else "none, the law is continuous in time",
            "error": f"{self.error:.2g}",
            "tolerances": _listed("u", law.inputs[0], sizes),
            "inputs": len(law.inputs[0]),
            "input_list": _listed("u", *law.inputs),
            "u0": self.array(law.u0),
            "low": self.array(law.limits[0]),
            "high": self.array(law.limits[1]),
            "row": "0",
        }
        self.words |= self._state(law) if isinstance(law, StateLaw) else self._output(law)

    def files(self) -> dict[str, str]:
        """Return the files as {file name: content}."""
        self.words["interface"] = self._filled(f"{self.kind}_interface.h")
        self.words["limiting"] = self._filled("limiting.c").rstrip()
        self.words |= self._vectors()
        self.words["run"] = self._filled(f"{self.kind}_run.c")
        law, lin = self.law, self.law.lin
        follows = isinstance(law, StateLaw) and law.follows
        header, source = self._filled("header.h"), self._filled(f"{self.kind}_law.c")
        about: dict[str, object] = {
            **{"title": self.title, "real": self.real, "frame": law.frame, "dt": law.dt},
            "kind": "samples" if follows else self.kind,
            "signals": {"input": law.inputs, self.kind: law.signals},
            "nq": len(lin.q) if lin else law.robot.nq if law.robot else 0,
            "u0": law.u0[0].tolist(),
            "memory": len(law.terms.A) if isinstance(law, OutputLaw) else 0,
            "reference": None if lin is None else lin.placement.tolist(),
            "point": None if lin is None else [lin.q.tolist(), lin.v.tolist()],
        }
        about["sha256"] = digest_of(about, header.encode(), source.encode())
        return {
            f"{self.name}.h": header,
            f"{self.name}.c": source,
            f"{self.name}_test.c": self._filled("test.c"),
            f"{self.name}.json": json.dumps(about, indent=1) + "\n",
        }

    def _filled(self, template: str) -> str:
        text = files("fflin.export").joinpath("templates", template).read_text("utf-8")
        return Template(text).substitute(self.words)

    def _vectors(self) -> dict[str, object]:
        """Return the values that fill the template of the test program."""
        law, rows, nu = self.law, [], len(self.law.inputs[0])
        for case in self.cases:
            out = case.out.copy()
            out[:nu] = np.clip(out[:nu], *law.limits)
            numbers = map(self.array, (case.given, out, self.error * case.scale))
            status = int((out != case.out).any())
            rows.append(f"{{{case.sample}UL, {', '.join(numbers)}, {status}}}")
        given, out = self.cases[0].given, self.cases[0].out
        names = [*map(_plain, law.inputs[0]), *(f"next z[{k}]" for k in range(len(out) - nu))]
        return {
            "vectors": "{\n" + ",\n".join(rows) + "}",
            "ins": len(given),
            "outs": len(out),
            "out_names": ",\n".join(f'    "{each}"' for each in names),
        }

    def _state(self, law: StateLaw) -> dict[str, object]:
        state, (rows, nx), follows = law.state, law.x0.shape, law.follows
        n = state.robot.n
        words: dict[str, object] = {
            **{"joints": n, "joints_max": max(n, 1), "states": nx},
            **{"rows": rows, "gains": len(law.K)},
            "state_list": _listed("x", *law.signals),
            "joint_list": _listed("joints", state.names[6 : 6 + n], state.units[6 : 6 + n]),
            "reference": self.array(law.placements),
            "x0": self.array(law.x0),
            "K": self.array(law.K),
            "in_reference_axes": _whole(state.axes),
            "continuous": _whole(joint.unbounded for joint in state.robot.joints),
            **dict.fromkeys(("interpolation", "gains_between", "sample_argument"), ""),
            **dict.fromkeys(("sample_given", "sample_comment"), ""),
            "feedback": f"feed_back({'(int)row' if follows else 0}, 1, x, u);",
        }
        if follows:
            words |= {
                "sample_argument": "unsigned long sample, ",
                "sample_given": "given->sample, ",
                "sample_comment": "sample counts sample times from the start, 0.",
                "row": f"(sample < {rows - 1}UL ? sample : {rows - 1}UL)",
            }
        if law.axes:
            joints, sizes = state.robot.joint_names, [len(values) for values in law.axes.values()]
            padded = [np.pad(x, (0, max(sizes) - len(x))) for x in law.axes.values()]
            self.words |= {
                **{"axis_count": len(sizes), "axis_room": max(sizes), "corners": 2 ** len(sizes)},
                "axis_joint": _whole(joints.index(name) for name in law.axes),
                "axis_size": _whole(sizes),
                "axis_points": self.array(padded),
            }
            words["interpolation"] = self._filled("interpolation.c")
            words["feedback"] = "feed_back_between(measured, x, u);"
            words["gains_between"] = ", K interpolated linearly between joint angles"
        return words

    def _output(self, law: OutputLaw) -> dict[str, object]:
        by = law.terms
        return {
            **{"states": len(by.A), "states_max": max(len(by.A), 1), "outputs": len(by.y0)},
            "output_list": _listed("y", *law.signals),
            # C has no empty arrays: a matrix without rows or columns gets a zero row or column.
            **{
                key: self.array(np.pad(x, [(0, int(not size)) for size in x.shape]))
                for key, x in zip("ABCD", by[:4], strict=True)
            },
            "y0": self.array(by.y0),
            "continuous": _whole(law.continuous),
        }

    def array(self, values: object) -> str:
        """Return the C initialiser of an array."""
        values = np.asarray(values)
        if values.ndim > 1:
            return "{\n" + ",\n".join(map(self.array, values)) + "}"
        if self.real == "float":
            with np.errstate(over="ignore"):
                narrow = values.astype(np.float32)
            if (np.isfinite(values) & ~np.isfinite(narrow)).any():
                raise InputError(
                    "the law has numbers that are too large for a float; use real='double'"
                )
            values = narrow.astype(float)
        end = "F" if self.real == "float" else ""
        shown = ", ".join(f"{x!r}{end}" for x in values.tolist())
        return "{" + shown.replace(f"inf{end}", "NO_LIMIT") + "}"


def _whole(values: Iterable[int]) -> str:
    return "{" + (", ".join(str(int(x)) for x in values) or "0") + "}"


def _plain(text: str) -> str:
    """Replace the characters of a text that may be invalid in comments and strings of C."""
    return re.sub(r"[^\w .,+^()\[\]/-]", "_", text, flags=re.ASCII)


def _listed(array: str, names: Sequence[str], units: Sequence[str]) -> str:
    """Return the lines of a C comment with index, name and unit of each entry of an array."""
    return "\n".join(
        f" *   {array}[{k}]  {_plain(name)} [{_plain(unit) or '-'}]"
        for k, (name, unit) in enumerate(zip(names, units, strict=True))
    )
