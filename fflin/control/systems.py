"""Linear systems of other tools: what has A, B, C, D, transfer functions, matrices and files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fflin.base.errors import FflinError, FileError, InputError, listed, unknown
from fflin.base.record import FORMATS, read_record, reading, texts
from fflin.base.validation import Array, as_double, number
from fflin.base.writing import as_path, check_ending, reason
from fflin.linear.model import LinearModel

_HOW = "in MATLAB [A, B, C, D] = ssdata(K); Ts = K.Ts; save('K.mat', 'A', 'B', 'C', 'D', 'Ts')"
_NUMBERED = re.compile(r"([a-z]\[\d+\])?")  # the names that signals have of themselves


class System(NamedTuple):
    """A, B, C, D; dt [s], 0 of continuous time, None where it is not said; names, where known."""

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()


def system_of(given: Any) -> System:
    """Return the system that is given in any of the ways that `LinearController` takes."""
    if isinstance(given, System):
        return given
    if isinstance(given, str | Path):
        return _read(as_path(given))
    if isinstance(given, tuple):
        if len(given) not in (4, 5):
            raise InputError(
                f"system is a tuple of {len(given)}, expected (A, B, C, D) or (A, B, C, D, dt)"
            )
        return _checked(*given)
    scipys = type(given).__module__.startswith("scipy.signal")
    if not hasattr(given, "A") and (scipys or hasattr(given, "ninputs")):
        given = _realised(given, scipys)
    if not all(hasattr(given, key) for key in "ABC"):
        return _checked((), (), (), as_double("system", given))
    dt = getattr(given, "dt", None)
    names = (
        tuple(getattr(given, f"{kind}_names", getattr(given, f"{kind}_labels", None)) or ())
        for kind in ("input", "output")
    )
    D = getattr(given, "D", None)
    return _checked(given.A, given.B, given.C, D, 0 if scipys and dt is None else dt, *names)


def _realised(given: Any, scipys: bool) -> Any:
    try:
        if scipys:
            return given.to_ss()
        import control

        return control.ss(given)
    except Exception as error:  # each of the tools has its own
        raise InputError(
            f"the {type(given).__name__} has no state space: {reason(error)}; a transfer function "
            "must be proper, without more zeros than poles"
        ) from None


def _checked(
    A: Any, B: Any, C: Any, D: Any, dt: Any = None, inputs: Any = (), outputs: Any = ()
) -> System:
    """Return a system whose sizes belong together; of D alone where A is empty."""
    of = dict(zip("ABCD", (A, B, C, 0.0 if D is None else D), strict=True))
    A, B, C, D = (_matrix(f"{key} of the controller", each) for key, each in of.items())
    nz = len(A) if A.size else 0
    (nu, ny) = (len(C), B.shape[1]) if nz else D.shape
    if not nz:
        A, B, C = np.zeros((0, 0)), np.zeros((0, ny)), np.zeros((nu, 0))
    elif D.size == 1 and not D.any():
        D = np.zeros((nu, ny))
    shapes = (nz, nz), (nz, ny), (nu, nz), (nu, ny)
    for key, each, shape in zip("ABCD", (A, B, C, D), shapes, strict=True):
        if each.shape != shape:
            raise InputError(
                f"{key} of the controller has shape {each.shape}, expected {shape}: {nz} states, "
                f"{ny} inputs (the model's outputs) and {nu} outputs (the model's inputs)"
            )
    for names, size in ((inputs, ny), (outputs, nu)):
        if names and len(names) != size:
            raise InputError(f"the controller has {size} signals and {len(names)} names for them")
    # -1 is MATLAB's, True everyone else's sampling time that is not known.
    if dt is True or (dt is not None and number("dt of the controller", dt) == -1.0):
        dt = -1.0
    elif dt is not None and not 0.0 <= (dt := number("dt of the controller", dt)):
        raise InputError(f"dt of the controller is {dt:g} s, expected 0 or a sampling time")
    return System(A, B, C, D, dt, tuple(map(str, inputs)), tuple(map(str, outputs)))


def _matrix(name: str, value: Any) -> Array:
    matrix = np.atleast_2d(as_double(name, value))
    if matrix.ndim > 2:
        raise InputError(f"{name} has shape {matrix.shape}, expected a matrix")
    if not np.isfinite(matrix).all():
        raise InputError(f"{name} has entries that are NaN or infinite")
    return matrix


def _read(path: Path) -> System:
    check_ending(path, FORMATS)
    with reading(path, "controller"):
        entries, _ = read_record(path)
        if len(entries) == 1 and isinstance(struct := next(iter(entries.values())), dict):
            entries = struct  # of MATLAB
        dt = entries.get("dt", entries.get("Ts"))
        names = (
            texts(entries.get(f"{kind}_names", entries.get(f"{kind.title()}Name", ())))
            for kind in ("input", "output")
        )
        rest = None if dt is None else float(np.asarray(dt).item()), *names
    keys = {*entries} & {*"ABCD"}
    if not (keys >= {*"ABC"} or keys == {"D"}):
        hint = "; a gain of fflin goes by --gain, or fflin.StateFeedback" * ("K" in entries)
        raise FileError(
            f"{path}: it has {listed(sorted(entries)) or 'no arrays'}, expected A, B, C, D, and Ts "
            f"where it is sampled, or D alone: {_HOW}{hint}"
        )
    try:
        return _checked(*(entries.get(key, None if key == "D" else ()) for key in "ABCD"), *rest)
    except FflinError as error:
        raise type(error)(f"{path}: {error}") from None


def fitted(system: System, lin: LinearModel) -> System:
    """Return a system over all outputs and inputs of a model, in their order, by its names."""
    columns = _places("input", system.inputs, system.D.shape[1], "output", lin.output_names)
    rows = _places("output", system.outputs, len(system.D), "input", lin.input_names)
    nz, ny, nu = len(system.A), len(lin.output_names), len(lin.input_names)
    B, C, D = np.zeros((nz, ny)), np.zeros((nu, nz)), np.zeros((nu, ny))
    B[:, columns], C[rows], D[np.ix_(rows, columns)] = system.B, system.C, system.D
    return System(system.A, B, C, D, system.dt, lin.output_names, lin.input_names)


def _places(
    kind: str, names: tuple[str, ...], size: int, of: str, known: tuple[str, ...]
) -> list[int]:
    """Return which signals of a model those of a controller are."""
    if all(map(_NUMBERED.fullmatch, names)):
        if size != len(known):
            raise InputError(
                f"the controller has {size} {kind}s, expected {len(known)}, one for each {of} of "
                f"the model: {listed(known)}; or name those that it has"
            )
        return list(range(size))
    # python-control has no dots in names.
    both = (names, known)
    own, there = (
        ([each.replace(".", "_") for each in of] for of in both) if ({*names} - {*known}) else both
    )
    for name, key in zip(names, own, strict=True):
        if key not in there:
            text = unknown(f"{of} of the model", name, known)
            raise InputError(f"{kind} of the controller: {text}; or leave all names out")
        if own.count(key) > 1:
            raise InputError(f"two {kind}s of the controller are called '{name}'; name them apart")
    return [there.index(key) for key in own]
