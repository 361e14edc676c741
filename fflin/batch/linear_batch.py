"""Batch of linear models of one robot about many points."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, overload

import numpy as np
import pinocchio as pin

from fflin.base import validation
from fflin.base.errors import InputError, require_known
from fflin.base.record import reading
from fflin.base.validation import ArrayLike, frozen
from fflin.base.writing import as_path
from fflin.batch.files import is_constant, read_rows, write_rows
from fflin.dynamics.orbital import mean_motion
from fflin.linear.files import given
from fflin.linear.model import LinearModel, ModelHeader
from fflin.robot.rotors import FlownWheels

if TYPE_CHECKING:
    from fflin.base.validation import Array, Indices, Mask
    from fflin.batch.tool_batch import ToolBatch
    from fflin.robot.robot import Robot

# Identity placement of the free-flyer joint in Pinocchio's universe frame: position, then
# quaternion x, y, z, w.
AT_ROOT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])

# Largest difference between joint values that count as equal [rad|m].
_SAME = 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class LinearBatch(ModelHeader):
    r"""Batch of linear models ``dx/dt = f0 + A (x - x0) + B (u - u0)``, made by `sweep`.

    ``batch[i]`` is the `LinearModel` about point i. ``batch[2:9]`` and ``batch[mask]`` are smaller
    batches. All arrays have N rows and are read-only. If an array is the same at all points, such
    as A at rest, it is stored once, and its stride over the points is zero. The upper half of B is
    always zero, so it is not stored. If the batch is in an HDF5 file, its arrays are read on
    demand.

    Attributes
    ----------
    A : ndarray (N, nx, nx)
    B_lower : ndarray (N, 6 + n, nu)
        Velocity rows of B. At rest, with the default inputs, ``B_lower`` is the inverse inertia.
    C : ndarray (N, ny, nx)
    D : ndarray (N, ny, nu)
    f0 : ndarray (N, nx)
    u0 : ndarray (N, nu)
    q : ndarray (N, nq)
    v : ndarray (N, nv)
        Configurations q and velocities v of the points, in Pinocchio's order.
    state_names, input_names, output_names : tuple of str
    state_units, input_units, output_units : tuple of str
    frame : str
    moving : bool
        See `LinearModel`.
    robot : str
        Name of the robot.
    urdf_sha256, fflin_version, pinocchio_version : str
        SHA-256 of the URDF, and versions of the packages that made the batch.
    locked : tuple of str
        Names of the locked joints.
    columns : tuple of (int, int, float)
        Two indices into q and a factor for each joint. The indices are (index, -1) for a joint with
        one angle or length, and the indices of cos and sin for a continuous joint. The factor is
        the entry of q divided by the entry of q_m; it differs from 1 only for modal amplitudes.
    verified : bool
        Whether the data are known to be unchanged. The value is False for a file without a
        checksum, or if the checksum was not verified.
    residual : ndarray (N,) or None
        Largest distance [m] or angle [rad] by which each point violates the constraints of the
        robot; None without constraints.
    dependent : tuple of str
        See `LinearModel`.
    joints : tuple of str
        Names of the joints of `columns`.
    notes : tuple of str
        Why the models were computed in Python although no engine was given.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> batch = fflin.sweep(robot, fflin.grid(robot, {"joint_1": np.linspace(-1, 1, 5)}))
    >>> batch.B_lower.shape, batch.select({"joint_1": (-1, 0)}).q.shape[0]
    ((5, 9, 9), 3)
    >>> len(batch[1:3]), batch.nearest({"joint_1": 0.4}).B.shape
    (2, (18, 9))
    """

    A: Array
    B_lower: Array
    C: Array
    D: Array
    f0: Array
    u0: Array
    q: Array
    v: Array
    columns: tuple[tuple[int, int, float], ...]
    # _x0 is None if A is the same at all points, as for a robot at rest without forces. x0 then
    # follows from q. _y0 is None if the output is the state.
    _x0: Array | None
    _y0: Array | None
    # _reference is None if the reference of each point is its own base pose. This pose follows from
    # q and _root.
    _reference: Array | None
    _root: Array
    _drift: Array | None
    # Fields of a robot with constraints.
    _all_states: Array | None
    _reduced_inertia: Array | None
    residual: Array | None
    # Further fields of each `LinearModel`: values that are the same at all points, and functions
    # that compute a field from the robot when the field is read.
    _asked: Mapping[str, object]
    verified: bool = True
    notes: tuple[str, ...] = ()
    dependent: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.q)

    @overload
    def __getitem__(self, index: int) -> LinearModel: ...
    @overload
    def __getitem__(
        self, index: slice | Sequence[int] | Indices | Mask
    ) -> LinearBatch: ...

    def __getitem__(self, index: int | slice | ArrayLike) -> LinearModel | LinearBatch:
        if isinstance(index, int | np.integer):
            if not -len(self) <= index < len(self):
                raise IndexError(
                    f"index is {index}, but the batch has {len(self)} points"
                )
            return self._model(int(index) % len(self))
        if not isinstance(index, slice):
            validation.refuse_masked("index", index)
            index = np.asarray(index)
            if index.dtype.kind not in "iub" or index.ndim != 1:
                raise InputError(
                    f"index has type {index.dtype} and shape {index.shape}, expected an integer, "
                    "a slice, a list of integers or a mask"
                )
        count = len(np.empty(len(self), dtype=bool)[index])
        rows: dict[str, Any] = {}
        for key, value in self._arrays().items():
            if is_constant(value):
                rows[key] = np.broadcast_to(value[0], (count, *value.shape[1:]))
            else:
                rows[key] = frozen(value[index])
        return replace(self, **rows)

    def __iter__(self) -> Iterator[LinearModel]:
        return map(self._model, range(len(self)))

    @property
    def B(self) -> Array:
        """Input matrices B (N, nx, nu), with zero upper halves; computed at each access."""
        upper = np.zeros(self.B_lower.shape)
        return frozen(np.concatenate((upper, self.B_lower), axis=1))

    @property
    def x0(self) -> Array:
        """States at the points (N, nx); computed at each access if all points have the same A."""
        if self._x0 is None:
            return self._states_at_rest(self.q)
        return self._x0

    @property
    def y0(self) -> Array:
        """Outputs at the points (N, ny)."""
        if self._y0 is None:
            return self.x0
        return self._y0

    @property
    def placements(self) -> Array:
        """References (N, 7) of the points: position [m] and quaternion x, y, z, w."""
        if self._reference is not None:
            return self._reference
        bases = self.q[:, :7]
        if (self._root[0] == AT_ROOT).all():
            return bases
        root = pin.XYZQUATToSE3(np.array(self._root[0]))
        placed = [
            pin.SE3ToXYZQUAT(root * pin.XYZQUATToSE3(np.array(base))) for base in bases
        ]
        return frozen(np.array(placed))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n joints in state order."""
        return self.joints

    @property
    def joint_positions(self) -> Array:
        """Joint positions (N, n) [rad|m]; angles of continuous joints are in (-pi, pi]."""
        return self._positions(self.q)

    def nearest(self, joints: Mapping[str, float]) -> LinearModel:
        """Return the model nearest to the given joint values [rad|m].

        The distance ignores joints that are not named.

        Raises
        ------
        UnknownNameError
            If a joint does not exist.
        InputError
            If a value is not a finite number, or no value is given.
        """
        distance = np.zeros(len(self))
        for label, at, turning, value in self._named(joints):
            distance += _apart(at, turning, validation.number(label, value)) ** 2
        return self[int(distance.argmin())]

    def select(self, joints: Mapping[str, float | tuple[float, float]]) -> LinearBatch:
        """Return the models in which named joints have given values or lie in given ranges [rad|m].

        Raises
        ------
        UnknownNameError
            If a joint does not exist.
        InputError
            If a value is not a number or a range, or no point of the batch matches.
        """
        mask = np.ones(len(self), dtype=bool)
        for label, at, turning, value in self._named(joints):
            if isinstance(value, tuple | list):
                low, high = validation.vector(label, value, 2, "(low, high)")
                mask &= (at >= low - _SAME) & (at <= high + _SAME)
            else:
                mask &= _apart(at, turning, validation.number(label, value)) <= _SAME
        if not mask.any():
            raise InputError(
                f"no point of the batch has {dict(joints)}; use `nearest` to find the nearest point"
            )
        return self[mask]

    def to(self, tool: str, *, dt: float | None = None) -> ToolBatch:
        """Return the models in the coordinates of another tool.

        Points whose bases have the same attitude, twist, acceleration and inputs are converted
        together, which is much faster than one at a time.

        Parameters
        ----------
        tool, dt
            See `transform`.

        Raises
        ------
        InputError
            If the batch was loaded without its robot, or `dt` is not allowed for the tool.
        UnknownNameError
            If the tool is unknown.
        ChartError
            If the tool uses Euler angles and their pitch is 90 deg at a point.
        """
        from fflin.batch.tool_batch import tool_batch

        if not len(self):
            raise InputError("the batch has no points; there is nothing to convert")
        robot = self[0]._robot
        if robot is None:
            raise InputError(
                "the batch does not contain its robot; load it with "
                "fflin.LinearBatch.load(path, robot)"
            )
        return tool_batch(robot, self, tool, dt)

    def save(self, path: str | Path) -> None:
        """Write the batch to a file, atomically.

        Parameters
        ----------
        path : str or Path
            Path that ends in .npz or .h5. An HDF5 file can later be read even if it does not fit in
            memory.

        Raises
        ------
        FileError
            If the file has another ending or cannot be written.
        MissingPackageError
            If h5py is needed and not installed.
        """
        if not len(self):
            raise InputError("the batch has no points; there is nothing to save")
        write_rows(
            as_path(path),
            self._arrays(),
            self.header(len(self)),
            checksummed=self.verified,
        )

    @staticmethod
    def load(
        path: str | Path, robot: Robot | None = None, *, verify: bool = True
    ) -> LinearBatch:
        """Read a batch that `save` or `sweep` wrote; all numbers are restored bit for bit.

        Parameters
        ----------
        path : str or Path
        robot : Robot, optional
            The robot of the batch. Without `robot`, the models have no inertia M and no
            certificate.
        verify : bool
            Whether to verify the SHA-256 checksums, for which all rows must be read. If False, an
            HDF5 file opens immediately, but `verified` is False in the result.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged, or is not a batch.
        InputError
            If `robot` is not the robot of the batch.
        MissingPackageError
            If h5py is needed and not installed.
        """
        source = as_path(path)
        with reading(source, "batch"):
            arrays, constant, texts, verified = read_rows(source, verify=verify)
            header = json.loads(texts["header"])
            values = _checked_fields(arrays, header, constant)
            ignorable = tuple(header["_ignorable"])
            # Files of earlier versions do not contain the wheels.
            wheels = None
            if "_wheels" in header:
                wheels = FlownWheels(*map(tuple, header["_wheels"]))
            n = float(header["mean_motion"])
        if robot is None:
            asked = {
                "_certify": partial(_refuse, "certificate", values["robot"]),
                "_inertia": partial(_refuse, "inertia M", values["robot"]),
                "_ignorable": partial(given, ignorable),
                "_wheels": wheels,
                "weights": {},
                "mean_motion": n,
                "dt": 0.0,
            }
            return LinearBatch(**values, _asked=asked, verified=verified)
        identity = (
            robot.urdf_sha256,
            robot.locked,
            robot.joint_names,
            mean_motion(robot),
        )
        if identity != (
            values["urdf_sha256"],
            values["locked"],
            values["joints"],
            n,
        ):
            raise InputError(
                f"robot '{robot.name}' differs from the robot '{values['robot']}' of the batch in "
                "its URDF, joints or orbit; give the robot for which the batch was made"
            )
        from fflin.linear.linearization import Prepared

        ready = Prepared(
            robot, frame=values["frame"], reference=None, moving=values["moving"]
        )
        return LinearBatch(**values, _asked=ready.common, verified=verified)

    def _arrays(self) -> dict[str, Array]:
        """Return {name: array} of all arrays of the batch; each array has one row per point."""
        held = {key: getattr(self, key) for key in (*_ARRAYS, *OPTIONAL)}
        return {key: value for key, value in held.items() if value is not None}

    def header(self, count: int) -> dict[str, str]:
        """Return the header for a file with `count` points, as one JSON document."""
        first = self[0]
        header = {key: getattr(self, key) for key in TEXTS}
        header |= {"_ignorable": first.ignorable, "mean_motion": first.mean_motion}
        header |= {"notes": self.notes, "joints": self.joints}
        wheels = (
            first._robot.flown_wheels if first._robot else self._asked.get("_wheels")
        )
        if isinstance(wheels, FlownWheels):
            header["_wheels"] = wheels
        return {
            "header": json.dumps({**header, "points": count, "columns": self.columns})
        }

    def _model(self, index: int) -> LinearModel:
        # fields without a value are None
        empty = dict.fromkeys(_EMPTY_TUPLES, ())
        common = {**dict.fromkeys(_MODEL), **empty, **self._asked}
        common |= {key: getattr(self, key) for key in (*TEXTS, "verified")}
        # `asarray` converts a row of a memory-mapped file to a plain array, without a copy.
        arrays = self._arrays().items()
        rows: dict[str, Any] = {
            key.removeprefix("_"): np.asarray(array[index]) for key, array in arrays
        }
        lower, root = rows.pop("B_lower"), rows.pop("root")
        rows["B"] = frozen(np.concatenate((np.zeros_like(lower), lower)))
        if self._x0 is None:  # x0 then follows from q
            rows["x0"] = self._states_at_rest(rows["q"][None])[0]
        rows.setdefault("y0", rows["x0"])
        rows["placement"] = base = rows.pop("reference", rows["q"][:7])
        if self._reference is None and (root != AT_ROOT).any():
            placed = pin.XYZQUATToSE3(root) * pin.XYZQUATToSE3(base)
            rows["placement"] = frozen(pin.SE3ToXYZQUAT(placed))
        rows.pop("residual", None)
        if self._reduced_inertia is not None:
            rows["_all_states"] = rows.pop("all_states")
            rows["_inertia"] = partial(given, rows.pop("reduced_inertia"))
        return LinearModel({**common, **rows})

    def _states_at_rest(self, q: Array) -> Array:
        q_m = self._positions(q)
        x0 = np.zeros((len(q), len(self.state_names)))
        x0[:, 6 : 6 + q_m.shape[1]] = q_m
        return frozen(x0)

    def _positions(self, q: Array) -> Array:
        """Return the joint positions q_m (N, n) [rad|m] at configurations q (N, nq)."""
        q_m = np.empty((len(q), len(self.columns)))
        for k, (first, second, scale) in enumerate(self.columns):
            position = q[:, first]
            if second >= 0:
                position = np.arctan2(q[:, second], q[:, first])
            q_m[:, k] = position / scale
        return q_m

    def _named(
        self, joints: Mapping[str, object]
    ) -> list[tuple[str, Array, bool, Any]]:
        """Return (label, positions (N,), flag, value) for each joint in {joint: value}.

        The label names the joint in messages. The flag is true for a continuous joint.
        """
        if not isinstance(joints, Mapping) or not joints:
            raise InputError(f"joints is {joints!r}, expected {{joint: value}}")
        require_known("joint", joints, self.joint_names)
        at = {name: self.joint_names.index(name) for name in joints}
        q_m = self.joint_positions
        turning = [second >= 0 for _, second, _ in self.columns]
        return [
            (f"joint '{x}'", q_m[:, k], turning[k], joints[x]) for x, k in at.items()
        ]


# Names of a batch's fields, grouped by type. Arrays have one row per point. The fields in TEXTS are
# the same at all points; a file stores them in its header.
_KINDS = {item.name: str(item.type) for item in fields(LinearBatch)}
_MODEL = {item.name for item in fields(LinearModel)} - {"verified"}
# Fields of a model that are empty in a model of a batch.
_EMPTY_TUPLES = ("added", "dependent", "_delays", "_lags", "_output_lags")
_ARRAYS = [key for key, kind in _KINDS.items() if kind == "Array"]
OPTIONAL = [key for key, kind in _KINDS.items() if kind == "Array | None"]
_TYPES = [key for key, kind in _KINDS.items() if "Array" not in kind]
TEXTS = [key for key in _TYPES if key in _MODEL]


def _checked_fields(
    arrays: dict[str, Array], header: dict[str, Any], constant: list[str]
) -> dict[str, Any]:
    """Return the fields of a batch from its file; raise `ValueError` for a wrong shape or type."""
    count = int(header["points"])
    values: dict[str, Any] = dict.fromkeys(OPTIONAL)
    for key in (*_ARRAYS, *(arrays.keys() & set(OPTIONAL))):
        array = arrays[key]
        if key in constant:
            array = np.broadcast_to(array, (count, *array.shape))
        if array.dtype != np.float64 or len(array) != count:
            raise ValueError(
                f"{key} has {len(array)} rows of {array.dtype}, expected {count}"
            )
        values[key] = frozen(array)
    # Files of earlier versions do not contain these.
    header = {"dependent": [], "joints": _joints(header["state_names"]), **header}
    for key in (*TEXTS, "joints"):
        values[key] = header[key]
        if isinstance(header[key], list):
            values[key] = tuple(header[key])
    values["columns"] = tuple(
        (int(a), int(b), float(scale)) for a, b, scale in header["columns"]
    )
    # Files of earlier versions do not contain notes.
    values["notes"] = tuple(map(str, header.get("notes", ())))
    nx, nu, ny = (len(values[f"{kind}_names"]) for kind in ("state", "input", "output"))
    shapes = {
        "A": (nx, nx),
        "B_lower": (nx // 2, nu),
        "C": (ny, nx),
        "D": (ny, nu),
        "f0": (nx,),
    }
    for key, shape in shapes.items():
        if values[key].shape[1:] != shape:
            raise ValueError(
                f"{key} has shape {values[key].shape[1:]} per point, expected {shape}"
            )
    return values


def _apart(at: Array, turning: bool, value: float) -> Array:
    """Return the distances (N,) between a joint's positions, `at` (N,), and the position `value`.

    If `turning` is true, the joint is continuous, and the distance is the shorter arc between the
    two angles.
    """
    distance: Array = at - value
    if turning:
        distance -= 2.0 * np.pi * np.round(distance / (2.0 * np.pi))
    return np.abs(distance)


def _joints(state_names: Sequence[str]) -> tuple[str, ...]:
    return tuple(
        name.removeprefix("q_m.") for name in state_names if name.startswith("q_m.")
    )


def _refuse(what: str, name: str, _: LinearModel) -> NoReturn:
    raise InputError(
        f"the {what} is computed from the robot, which the file does not contain; load the batch "
        f"with LinearBatch.load(path, robot), where robot is the unchanged '{name}'"
    )
