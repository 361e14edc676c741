"""Linear systems from other tools: state spaces, transfer functions, matrices and files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fflin.base.errors import FflinError, FileError, InputError, listed, unknown
from fflin.base.record import FORMATS, read_record, reading, texts
from fflin.base.validation import Array, as_double, number
from fflin.base.writing import as_path, check_ending, reason
from fflin.linear.model import LinearModel

_NUMBERED = re.compile(r"([a-z]\[\d+\])?")  # the names that signals have of themselves


class System(NamedTuple):
    """A, B, C, D, dt and names; dt [s] is 0 if continuous, -1 if unknown, None if not given."""

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()


def system_of(given: Any) -> System:
    """Return the system that is given in any form of `LinearController`."""
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
    if not hasattr(given, "A") and (hasattr(given, "to_ss") or hasattr(given, "ninputs")):
        given = _realised(given)
    if not all(hasattr(given, key) for key in "ABC"):
        return _checked((), (), (), as_double("system", given))
    inputs, outputs = (
        getattr(given, f"{kind}_names", getattr(given, f"{kind}_labels", ()))
        for kind in ("input", "output")
    )
    dt = getattr(given, "dt", None)
    # SciPy's continuous systems have no names, and None for dt.
    dt = 0.0 if dt is None and not inputs else dt
    return _checked(given.A, given.B, given.C, getattr(given, "D", None), dt, inputs, outputs)


def _realised(given: Any) -> Any:
    try:
        if hasattr(given, "to_ss"):
            return given.to_ss()
        import control

        return control.ss(given)
    except Exception as error:  # each of the tools has its own
        raise InputError(
            f"the {type(given).__name__} cannot be converted to a state space: {reason(error)}; a "
            "transfer function must be proper, with no more zeros than poles"
        ) from None


def _checked(
    A: Any, B: Any, C: Any, D: Any, dt: Any = None, inputs: Any = (), outputs: Any = ()
) -> System:
    """Return a system whose sizes belong together; of D alone where A is empty."""
    of = dict(zip("ABCD", (A, B, C, 0.0 if D is None else D), strict=True))
    A, B, C, D = (np.atleast_2d(as_double(f"controller's {x}", of[x])) for x in of)
    nz = len(A) if A.size else 0
    ny, nu = (B.shape[-1], len(C)) if nz else (D.shape[-1], len(D))
    if not nz:
        A, B, C = np.zeros((0, 0)), np.zeros((0, ny)), np.zeros((nu, 0))
    elif D.size == 1 and not D.any():
        D = np.zeros((nu, ny))
    shapes = (nz, nz), (nz, ny), (nu, nz), (nu, ny)
    for key, each, shape in zip("ABCD", (A, B, C, D), shapes, strict=True):
        if each.shape != shape or not np.isfinite(each).all():
            raise InputError(
                f"{key} of the controller has shape {each.shape}, expected {shape} with finite "
                f"entries, for {nz} states, {ny} inputs (outputs of the model) and {nu} outputs"
            )
    if dt is not None:
        # True is of a system that is sampled nobody knows how, -1 MATLAB's word for it.
        dt = -1.0 if dt is True else number("controller's dt", dt)
    return System(A, B, C, D, dt, tuple(map(str, inputs)), tuple(map(str, outputs)))


def _read(path: Path) -> System:
    check_ending(path, FORMATS)
    with reading(path, "controller"):
        found, _ = read_record(path)
        if len(found) == 1 and isinstance(struct := next(iter(found.values())), dict):
            found = struct  # of MATLAB
        dt = found.get("dt", found.get("Ts"))
        dt = None if dt is None else float(np.asarray(dt).item())
        inputs, outputs = (
            texts(found.get(f"{kind}_names", found.get(f"{kind.title()}Name", ())))
            for kind in ("input", "output")
        )
    A, B, C, D = (found.get(key) for key in "ABCD")
    if any(each is None for each in (A, B, C)):
        if D is None or A is not None:
            raise FileError(
                f"{path}: the file contains {listed(sorted(found)) or 'no arrays'}, expected A, B, "
                "C, D (and Ts if sampled) or D alone; in MATLAB, save the controller K by [A, B, "
                "C, D] = ssdata(K); "
                "Ts = K.Ts; save('K.mat', 'A', 'B', 'C', 'D', 'Ts')"
            )
        A = B = C = ()
    try:
        return _checked(A, B, C, D, dt, inputs, outputs)
    except FflinError as error:
        raise type(error)(f"{path}: {error}") from None


def fitted(system: System, lin: LinearModel) -> System:
    """Return a system over all outputs and inputs of a model, in their order, by its names."""
    columns = _indices("input", system.inputs, system.D.shape[1], "output", lin.output_names)
    rows = _indices("output", system.outputs, len(system.D), "input", lin.input_names)
    nz, ny, nu = len(system.A), len(lin.output_names), len(lin.input_names)
    B, C, D = np.zeros((nz, ny)), np.zeros((nu, nz)), np.zeros((nu, ny))
    B[:, columns], C[rows], D[np.ix_(rows, columns)] = system.B, system.C, system.D
    return System(system.A, B, C, D, system.dt, lin.output_names, lin.input_names)


def _indices(
    kind: str, names: tuple[str, ...], size: int, of: str, known: Sequence[str]
) -> list[int]:
    """Return the indices of a controller's signals among the signals of a model."""
    named = not all(map(_NUMBERED.fullmatch, names))
    if size != len(names if named else known):
        raise InputError(
            f"the controller has {size} {kind}s and {len(names) if named else 'no'} names, "
            f"expected a name for each, or one {kind} for each {of} of the model: {listed(known)}"
        )
    if not named:
        return list(range(size))
    own, there = list(names), list(known)
    if not {*own} <= {*there}:  # python-control has no dots in names
        own, there = ([name.replace(".", "_") for name in each] for each in (own, there))
    for name, key in zip(names, own, strict=True):
        if key not in there:
            text = unknown(f"{of} of the model", name, known)
            raise InputError(f"{kind} of the controller: {text} (or leave out all names)")
        if own.count(key) > 1:
            raise InputError(
                f"two {kind}s of the controller are named '{name}'; give them different names"
            )
    return [there.index(key) for key in own]
