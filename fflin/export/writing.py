"""C source, header and test program of a control law."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
import pinocchio as pin

from fflin.base import __version__
from fflin.base.errors import InputError
from fflin.base.record import content_digest
from fflin.base.writing import as_path, write_atomically
from fflin.dynamics.state import StateMap
from fflin.export.laws import CASES, Law, law_of
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
    title, texts = _texts(law_of(law, robot, limits), name, real)
    contents = {target / f"{name}{ending}": text.encode() for ending, text in texts.items()}
    old = next((path for path in contents if path.exists()), None)
    there = None
    with suppress(OSError, ValueError, TypeError, LookupError):
        there = json.loads((target / f"{name}.json").read_bytes())["title"]
    if old and there != title:
        raise InputError(
            f"{old} exists and does not belong to the {title}; give another name= (--name) or "
            "another folder, or delete the file"
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


def _texts(law: Law, name: str, real: str) -> tuple[str, dict[str, str]]:
    """Return the title of a law, and {ending: text} of its files, made from the templates."""
    state, lin, tables, robot = law.state, law.lin, law.tables, law.robot
    names, units = law.inputs
    known_as, kind = robot.name if robot else "unknown", "state" if state else "output"
    title = f"{law.title} of '{known_as}'"
    # For single precision, the bound is the unit roundoff times the number of operations.
    error = _DOUBLE_ERROR if real == "double" else law.operations * 2.0**-24
    bounds = error * np.max([case.scale for case in law.cases], axis=0)
    sizes = [f"{x:.2e} {unit}" for x, unit in zip(bounds, units, strict=False)]
    array = partial(_array, real=real)
    words: dict[str, object] = {
        **(_DOUBLE if real == "double" else _FLOAT),
        # C has no empty arrays: a table without rows or columns gets a row or column of zeros.
        **{
            key: array(np.pad(table, [(0, int(not size)) for size in table.shape]))
            for key, table in tables.items()
        },
        **{"name": name, "NAME": name.upper(), "real": real, "count": CASES},
        **{"law": law.title, "frame": law.frame or "not known", "robot": _plain(known_as)},
        "sha256": (robot.urdf_sha256 if robot else "") or "not known",
        "world": ", the orbital frame" if robot and robot.orbit else "",
        **{"fflin_version": __version__, "pinocchio_version": pin.__version__},
        "sample_time": f"{law.dt!r} s" if law.dt else "none, the law is continuous in time",
        "error": f"{error:.2g}",
        "tolerances": _listed("u", names, sizes),
        **{"inputs": len(names), "input_list": _listed("u", names, units), "row": "0"},
        f"{kind}_list": _listed("x" if state else "y", *law.signals),
        "continuous": _whole(law.continuous),
        **_test_words(law, array, error),
    }
    if state:
        words |= _state_words(law, state, array)
        words["interpolation"] = _filled("interpolation.c", words) if law.axes else ""
    else:
        nz = len(tables["A"])
        words |= {"states": nz, "states_max": max(nz, 1), "outputs": len(tables["y0"])}
    words["interface"] = _filled(f"{kind}_interface.h", words)
    words["limiting"] = _filled("limiting.c", words).rstrip()
    words["run"] = _filled(f"{kind}_run.c", words)
    header, source = _filled("header.h", words), _filled(f"{kind}_law.c", words)
    about: dict[str, object] = {
        **{"title": title, "real": real, "frame": law.frame, "dt": law.dt},
        "kind": "samples" if len(tables["u0"]) > 1 else kind,
        "signals": {"input": law.inputs, kind: law.signals},
        "nq": len(lin.q) if lin else robot.nq if robot else 0,
        "u0": tables["u0"][0].tolist(),
        "memory": 0 if state else len(tables["A"]),
        "reference": None if lin is None else lin.placement.tolist(),
        "point": None if lin is None else [lin.q.tolist(), lin.v.tolist()],
    }
    about["sha256"] = digest_of(about, header.encode(), source.encode())
    described = json.dumps(about, indent=1) + "\n"
    test = _filled("test.c", words)
    return title, {".h": header, ".c": source, "_test.c": test, ".json": described}


def _test_words(law: Law, array: Callable[[object], str], error: float) -> dict[str, object]:
    """Return the words of the test program, with the relative error of its results."""
    (names, _), vectors = law.inputs, []
    for case in law.cases:
        out = case.out.copy()
        out[: len(names)] = np.clip(out[: len(names)], law.tables["low"], law.tables["high"])
        numbers = map(array, (case.given, out, error * case.scale))
        status = int((out != case.out).any())
        vectors.append(f"{{{case.sample}UL, {', '.join(numbers)}, {status}}}")
    outs = [*map(_plain, names), *(f"next z[{k}]" for k in range(len(out) - len(names)))]
    return {
        "vectors": "{\n" + ",\n".join(vectors) + "}",
        **{"ins": len(case.given), "outs": len(outs)},
        "out_names": ",\n".join(f'    "{each}"' for each in outs),
    }


def _state_words(law: Law, state: StateMap, array: Callable[[object], str]) -> dict[str, object]:
    """Return the words of a state law alone."""
    robot, rows = state.robot, len(law.tables["u0"])
    n, sizes = robot.n, [len(values) for values in law.axes.values()]
    words: dict[str, object] = {
        **{"joints": n, "joints_max": max(n, 1), "states": state.nx},
        **{"rows": rows, "gains": len(law.tables["K"])},
        "joint_list": _listed("joints", state.names[6 : 6 + n], state.units[6 : 6 + n]),
        "in_reference_axes": _whole(state.axes),
        **dict.fromkeys(("gains_between", "sample_argument", "sample_given"), ""),
        **{"sample_comment": "", "feedback": "feed_back(0, 1, x, u);"},
    }
    if rows > 1:
        words |= {
            "sample_argument": "unsigned long sample, ",
            "sample_given": "given->sample, ",
            "sample_comment": "sample counts sample times from the start, 0.",
            "row": f"(sample < {rows - 1}UL ? sample : {rows - 1}UL)",
            "feedback": "feed_back((int)row, 1, x, u);",
        }
    if law.axes:
        padded = [np.pad(x, (0, max(sizes) - len(x))) for x in law.axes.values()]
        words |= {
            **{"axis_count": len(sizes), "axis_room": max(sizes), "corners": 2 ** len(sizes)},
            "axis_joint": _whole(robot.joint_names.index(axis) for axis in law.axes),
            **{"axis_size": _whole(sizes), "axis_points": array(padded)},
            "feedback": "feed_back_between(measured, x, u);",
            "gains_between": ", K interpolated linearly between joint angles",
        }
    return words


def _filled(template: str, words: dict[str, object]) -> str:
    text = files("fflin.export").joinpath("templates", template).read_text("utf-8")
    return Template(text).substitute(words)


def _array(values: object, real: str) -> str:
    """Return the C initialiser of an array."""
    values = np.asarray(values)
    if values.ndim > 1:
        return "{\n" + ",\n".join(_array(row, real) for row in values) + "}"
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
