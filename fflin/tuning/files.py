"""Files of tuned laws: the matrices with the operating point, the sample time and the delay."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.record import figure, read_record, reading, text, texts
from fflin.base.validation import Array
from fflin.base.writing import as_path
from fflin.control.law_files import TUNED, in_time_of
from fflin.control.linear_controller import LinearController
from fflin.control.policy import System
from fflin.dynamics.coordinates import frame_of
from fflin.linear.linearization import linearize
from fflin.robot.robot import Robot


def record_of_law(law: LinearController) -> dict[str, object]:
    """Return the entries of the file of a law: its matrices and its operating point."""
    system, lin = law.system, law.lin
    return {
        "kind": TUNED,
        "A": system.A,
        "B": system.B,
        "C": system.C,
        "D": system.D,
        "dt": law.dt,
        "delay": lin.delay,
        "input_names": system.inputs,
        "output_names": system.outputs,
        "robot": lin.robot,
        "frame": lin.frame,
        "q": lin.q,
        "v": lin.v,
        "u0": lin.u0,
        "placement": lin.placement,
    }


def read_law(path: str | Path) -> dict[str, Any]:
    """Return the entries of a file of a tuned law, or raise `FileError` for another file."""
    target = as_path(path)
    with reading(target, "tuned law"):
        record, _ = read_record(target)
        kind = text(record.get("kind", ""))
        if kind != TUNED:
            raise ValueError(f"the file contains: {kind or 'no law of fflin'}")
    return record


def saved_law(record: Mapping[str, Any], robot: Robot) -> LinearController:
    """Return the law of a file about the operating point for which it was tuned."""
    reference = pin.XYZQUATToSE3(_vector(record, "placement"))
    lin = linearize(
        robot,
        _vector(record, "q"),
        _vector(record, "v"),
        _vector(record, "u0"),
        frame=frame_of(robot, text(record["frame"])),
        reference=reference,
    )
    names = texts(record["input_names"]), texts(record["output_names"])
    ny, nu = len(names[0]), len(names[1])
    D = np.reshape(record["D"], (nu, ny))
    A = np.atleast_2d(record["A"])
    nz = len(A) if A.size else 0
    system = System(
        np.reshape(record["A"], (nz, nz)),
        np.reshape(record["B"], (nz, ny)),
        np.reshape(record["C"], (nu, nz)),
        D,
        figure(record["dt"]),
        *names,
    )
    return LinearController(system, in_time_of(record, lin))


def _vector(record: Mapping[str, Any], key: str) -> Array:
    return np.asarray(record[key], float).ravel()
