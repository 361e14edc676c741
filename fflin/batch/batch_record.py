"""Header of a `LinearBatch` file, and the data that its models compute from the robot."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from fflin.base.errors import InputError
from fflin.base.record import reading
from fflin.base.validation import Array
from fflin.batch.files import read_rows
from fflin.dynamics.orbital import mean_motion
from fflin.linear.files import given

if TYPE_CHECKING:
    from fflin.linear.model import LinearModel
    from fflin.robot.robot import Robot

# Fields of a batch that are texts or lists of texts; a file has them as one JSON document.
_TEXTS = (
    *("state_names", "input_names", "output_names"),
    *("state_units", "input_units", "output_units"),
    *("frame", "moving", "robot", "urdf_sha256", "locked", "fflin_version", "pinocchio_version"),
)
_ARRAYS = ("A", "B_lower", "C", "D", "f0", "u0", "q", "v", "_root")
_MAYBE = ("_x0", "_y0", "_reference", "_drift")

# What a model computes when it is asked for it, by its fields' names.
_OF_ROBOT = ("_certify", "_inertia", "_ignorable", "_limits", "weights", "_robot", "mean_motion")


def texts_of(batch: Any, count: int) -> dict[str, str]:
    """Return what of a `LinearBatch` of so many points is text."""
    texts = {key: getattr(batch, key) for key in _TEXTS}
    texts |= {"_ignorable": batch[0].ignorable, "mean_motion": batch[0].mean_motion}
    return {"header": json.dumps({**texts, "points": count, "columns": batch.columns})}


def read_batch(path: Path, robot: Robot | None, *, verify: bool) -> dict[str, Any]:
    """Return the fields of a batch; see `LinearBatch.load`."""
    with reading(path, "batch"):
        arrays, constant, texts, verified = read_rows(path, verify=verify)
        record = json.loads(texts["header"])
        fields = {**_fields(arrays, record, constant), "verified": verified}
        ignorable = tuple(record["_ignorable"])
        n = float(record.get("mean_motion", 0.0))
    if robot is None:
        return fields | {
            "_asked": {
                "_certify": partial(_refuse, "certificate", fields["robot"]),
                "_inertia": partial(_refuse, "inertia M", fields["robot"]),
                "_ignorable": partial(given, ignorable),
                "_limits": dict,
                "weights": {},
                "mean_motion": n,
            }
        }
    joints = [name.removeprefix("q_m.") for name in fields["state_names"] if name[:4] == "q_m."]
    made_of = fields["urdf_sha256"], fields["locked"], tuple(joints)
    given_one = robot.urdf_sha256, robot.locked, robot.joint_names
    if (*given_one, mean_motion(robot)) != (*made_of, n):
        raise InputError(
            f"robot '{robot.name}' differs from the robot '{fields['robot']}' of the batch in its "
            "URDF, joints or orbit; give the robot that the batch was made of"
        )
    from fflin.linear.prepared import prepare

    prepared = prepare(robot, frame=fields["frame"], reference=None, moving=fields["moving"])
    return fields | {"_asked": asked_of(prepared.common)}


def asked_of(common: Mapping[str, Any]) -> dict[str, Any]:
    """Return what models ask their robot for, of what is the same about all points."""
    return {key: common[key] for key in _OF_ROBOT}


def _refuse(what: str, name: str, _: LinearModel) -> NoReturn:
    raise InputError(
        f"the {what} is not in the file and is computed from the robot; load the batch with "
        f"LinearBatch.load(path, robot), with the unchanged robot '{name}'"
    )


def _fields(
    arrays: dict[str, Array], record: dict[str, Any], constant: list[str]
) -> dict[str, Any]:
    count = int(record.pop("points"))
    columns = tuple((int(first), int(second)) for first, second in record.pop("columns"))
    rows: dict[str, Any] = {}
    for key in (*_ARRAYS, *_MAYBE):
        value = arrays[key] if key in _ARRAYS else arrays.get(key)
        if key in constant and value is not None:
            value = np.broadcast_to(value, (count, *value.shape))
        if value is not None and (value.dtype != np.float64 or len(value) != count):
            raise ValueError(f"{key} has {len(value)} rows of {value.dtype}, expected {count}")
        rows[key] = value
    texts: dict[str, Any] = {
        key: tuple(value) if isinstance(value := record[key], list) else value for key in _TEXTS
    }
    nx, nu, ny = (len(texts[f"{kind}_names"]) for kind in ("state", "input", "output"))
    shapes = {"A": (nx, nx), "B_lower": (nx // 2, nu), "C": (ny, nx), "D": (ny, nu), "f0": (nx,)}
    for key, shape in shapes.items():
        if rows[key].shape[1:] != shape:
            raise ValueError(f"{key} has shape {rows[key].shape[1:]} a point, expected {shape}")
    return {**rows, **texts, "columns": columns}
