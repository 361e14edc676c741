"""Sweep: linear models about many points."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base import __version__
from fflin.base.errors import FflinWarning, located
from fflin.base.record import content_digest
from fflin.base.validation import Array, ArrayLike, Indices, Mask, frozen, vector
from fflin.batch.closed_points import closed_points
from fflin.batch.configurations import Configurations, checked_points, checked_rows
from fflin.batch.files import FileStore, MemoryStore, is_constant, output_path
from fflin.batch.linear_batch import AT_ROOT, OPTIONAL, TEXTS, LinearBatch
from fflin.batch.run import Execution, Progress, Rows, run_chunks
from fflin.dynamics.coordinates import (
    SMALLEST_Q0,
    Chart,
    ReferenceChart,
    refuse_elliptic,
)
from fflin.dynamics.rnea import AccelerationDerivatives
from fflin.kernel.compiled import compiles
from fflin.kernel.limits import Task, reason_against
from fflin.kernel.tree import LANES, batch_tree
from fflin.linear.linearization import LARGEST, Linearizer, Prepared
from fflin.linear.state_equations import assemble, drift
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.dynamics.coordinates import Frame
    from fflin.kernel.derivatives import RowAccelerations

# Limits of the default chunk size: bytes (configurations plus results), and number of rows. A chunk
# must take much longer to compute than to send, and several chunks must fit into memory.
_CHUNK_BYTES, _LEAST_CHUNK_BYTES = 4 * 2**20, 2**21
_LEAST_CHUNK = 16
_LARGEST_CHUNK = 2**16

# Only one thread at a time may change the warning filters, because all threads share them.
_TURN = Lock()

# Attributes of a model whose names differ from the names of the arrays of a batch.
_ATTRIBUTES = {"_all_states": "_all_states", "_reduced_inertia": "M"}

# Attributes that identify a robot, in addition to its Pinocchio model.
_OF_THE_ROBOT = (
    "name",
    "urdf_sha256",
    "locked",
    "joints",
    "followers",
    "inputs",
    "outputs",
    "stiffness",
    "damping",
    "rest",
    "gravity",
    "orbit",
)


def sweep(
    robot: Robot,
    q: ArrayLike | Configurations,
    v: ArrayLike | None = None,
    u: ArrayLike | None = None,
    *,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    moving: bool = False,
    independent: Sequence[str] | None = None,
    engine: str | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    threads: int | None = None,
    chunk: int | None = None,
    progress: Progress | None = None,
    out: str | Path | None = None,
) -> LinearBatch:
    r"""Linearise a robot about many points.

    If numba is installed (``pip install 'fflin[fast]'``), a compiled kernel processes groups of
    eight points on all threads. If the robot is at rest and no springs, gravity or other forces
    act, only :math:`B = [0;\, M^{-1}]` depends on the point, so the kernel computes nothing else.
    The kernel also supports operating points in motion. Without numba, or if the robot has outputs
    other than its state, a `Linearizer` processes the points one by one. With `executor` or
    `workers`, the points are distributed over worker processes.

    Parameters
    ----------
    robot : Robot
    q : array_like (N, nq), Grid or RandomConfigurations
        Configurations in Pinocchio's order; see `grid` and `random_configurations`.
    v : array_like (N, nv) or (nv,), optional
        Velocities in Pinocchio's order; at rest by default.
    u : array_like (N, nu) or (nu,), optional
        Inputs of the robot; zero by default.
    frame, reference, moving : optional
        See `Linearizer`. By default the reference is the base pose at each point.
    independent : sequence of str, optional
        Coordinates of the models of a robot with constraints, see `Linearizer`. All points have the
        same coordinates. The joints of a grid keep their values, and random configurations keep
        the values of the independent joints; the other coordinates are changed such that the
        constraints hold. A random configuration that cannot be closed is drawn again.
    engine : {"python", "compiled"}, optional
        Engine that linearises the points. The default is "compiled" if numba is installed and the
        robot's outputs are its state; otherwise the default is "python".
    executor : concurrent.futures.Executor, optional
        Executor whose workers process the chunks: a process pool, a dask executor
        (``Client.get_executor()``) or an executor of mpi4py.futures. `sweep` does not shut down the
        executor.
    workers : int, optional
        Number of worker processes to start, at most one per core. Each worker imports the main
        module, so call `sweep` under ``if __name__ == "__main__":``.
    threads : int, optional
        Number of threads of the compiled code; by default one for each available core.
    chunk : int, optional
        Number of points in a chunk. By default, the number is chosen such that the result of a
        chunk takes about 4 MB. A resumed sweep uses the chunk size of its unfinished file.
    progress : callable, optional
        Function ``progress(done, total)``, called after every chunk with the numbers of finished
        points and of all points. By default, a long call shows a bar if stderr is a terminal.
    out : str or Path, optional
        File to write, .h5 or .npz. For .h5, chunks are first written to NAME.part. After a crash,
        the same call resumes with the intact chunks in NAME.part.

    Returns
    -------
    LinearBatch
        Models in the order of q. If `out` is an .h5 file, arrays are read from the file on
        demand.

    Raises
    ------
    InputError
        If a size or value is wrong (the message names the row), or the requested compiled engine
        is not available.
    UnknownNameError
        If the engine does not exist.
    ConstraintError
        If a configuration violates the constraints of the robot, or cannot be closed.
    SweepError
        If a point cannot be linearised, or a worker dies. The message names the chunks;
        `SweepError.batch` or the file contains the results of the other chunks.
    FileError
        If the file cannot be written.
    MissingPackageError
        If h5py is needed and not installed.

    Warns
    -----
    FflinWarning
        If M is ill-conditioned at some points. A single warning states how many points are
        affected.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = fflin.grid(robot, {"joint_1": np.linspace(-1, 1, 5), "joint_2": [0.0, 0.5]})
    >>> batch = fflin.sweep(robot, points)
    >>> len(batch), batch[3].B.shape
    (10, (18, 9))
    """
    how = Execution(executor, workers, threads, chunk, progress)
    path = None if out is None else output_path(out)
    refuse_elliptic(robot, "sweeps", "use fflin.linearize(robot, q, t=...)")
    linearizer = Linearizer(
        robot, frame=frame, reference=reference, moving=moving, independent=independent
    )
    residual = None
    if linearizer.constrained:
        q, residual = closed_points(linearizer, checked_points(robot, q))
    job = ChunkJob(linearizer, at_rest=v is None and u is None, engine=engine)
    task = SweepTask(job, q, v, u, residual)
    count = task.count
    size = chunk
    row = job.row_bytes
    if size is None:
        # Choose the chunk size such that all threads or workers compute about equally many chunks.
        same = how.count(job)
        size = (
            min(_CHUNK_BYTES, max(_LEAST_CHUNK_BYTES, row * count // (4 * same))) // row
        )
        size = min(max(size, _LEAST_CHUNK), _LARGEST_CHUNK)
        chunks = math.ceil(math.ceil(count / size) / same) * same
        size = math.ceil(count / chunks / _LEAST_CHUNK) * _LEAST_CHUNK
    store: FileStore | MemoryStore
    if path is None or path.suffix == ".npz":
        store = MemoryStore(count, size, task.shapes, task.given)
    else:
        store = FileStore(
            path, task.request, count, size, task.shapes, task.constants, task.header()
        )
    with closing(store), how:
        of_what = "configurations"
        run_chunks(
            job, task.rows, store, how, how.progress, of_what=of_what, made=task.batch
        )
        batch = task.batch(store.complete())
    if path is not None and path.suffix == ".npz":
        batch.save(path)
    return batch


def kernel_of(prepared: Prepared, engine: str | None) -> RowAccelerations | None:
    """Return the compiled kernel for accelerations and derivatives, or None if Python is used."""
    tree = batch_tree(prepared.robot)
    if not compiles(engine, lambda: _reason(prepared)) or tree is None:
        return None
    from fflin.kernel.derivatives import RowAccelerations

    return RowAccelerations(prepared.map, prepared.actuation, tree)


def _reason(prepared: Prepared) -> str:
    """Return why the compiled kernel cannot be used, or an empty text if it can."""
    if prepared.robot.constraints:
        return f"the constraints of '{prepared.robot.name}' need Python"
    if prepared.robot.orbit and not prepared.map.axes[1]:
        return f"in orbit, models in base axes (of '{prepared.robot.name}') need Python"
    task = Task(robots=(prepared.robot,), outputs=prepared.sensing is not None)
    return reason_against(task)


class ChunkJob:
    """Job that linearises chunks of points with the compiled kernel or with `Linearizer`.

    `Linearizer` also linearises the points that the kernel skips. The rows of a chunk contain the
    configurations q. They also contain v if velocities are given, and u0 if inputs are given.
    `at_rest` must be false if velocities or inputs are given.
    """

    def __init__(
        self, linearizer: Linearizer, *, at_rest: bool, engine: str | None = None
    ) -> None:
        self._again = partial(type(self), linearizer, at_rest=at_rest, engine=engine)
        self.linearizer = linearizer
        prepared = linearizer.prepared
        self._kernel = kernel_of(prepared, engine)
        self.threaded = self._kernel is not None
        self.notes: tuple[str, ...] = ()
        if engine is None and not self.threaded:
            self.notes = (f"linearised in Python, because {_reason(prepared)}",)
        # A and f0 are the same at all points if the robot is at rest, no forces such as springs or
        # gravity act on it (`free`), and each point is its own reference. Only B is then computed.
        self.only_inertia = at_rest and prepared.own_reference and prepared.free
        nx = prepared.map.nx
        nu = len(prepared.actuation.names)
        ny = len(prepared.common["output_names"])
        # Shapes, per point, of the arrays that differ between points.
        self.shapes: dict[str, tuple[int, ...]] = {"B_lower": (nx // 2, nu)}
        if not self.only_inertia:
            self.shapes |= {"A": (nx, nx), "f0": (nx,), "_x0": (nx,)}
            if prepared.moving:
                self.shapes["_drift"] = (nx,)
            if prepared.sensing is not None:
                self.shapes |= {"C": (ny, nx), "D": (ny, nu), "_y0": (ny,)}
        if linearizer.constrained:
            self.shapes = _constrained_shapes(linearizer)
        self.row_bytes = 8 * (
            linearizer.robot.nq + sum(map(math.prod, self.shapes.values()))
        )

    def __reduce__(self) -> tuple[object, ...]:
        # Only the arguments are pickled, because each worker allocates its own work arrays.
        return self._again, ()

    def run(self, rows: Rows, start: int, out: Mapping[str, Array]) -> list[str]:
        """Linearise about the points of a chunk; see `Job`."""
        left = self.write(rows, out)
        nv = self.shapes["B_lower"][0]
        if not len(left):
            return []
        with _TURN, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", FflinWarning)
            for row in left.tolist():
                with located(f"configuration {start + row}"):
                    if self.only_inertia:
                        self.linearizer.write_by_u(rows["q"][row], out["B_lower"][row])
                        continue
                    point = {key: values[row] for key, values in rows.items()}
                    lin = self.linearizer(point["q"], point.get("v"), point.get("u0"))
                    for key, array in out.items():
                        if key == "B_lower":
                            array[row] = lin.B[nv:]
                        else:
                            name = _ATTRIBUTES.get(key, key.removeprefix("_"))
                            array[row] = getattr(lin, name)
        return [str(note.message) for note in caught]

    def write(self, rows: Rows, out: Mapping[str, Array]) -> Indices:
        """Write results into `out` by compiled code; return the indices of the skipped rows."""
        kernel = self._kernel
        q = rows["q"]
        count = len(q)
        if kernel is None:
            return np.arange(count)
        if count < LANES:  # fill up the lanes by repeating the last row
            filled = ((0, LANES - count), (0, 0))
            more = dict[str, Array]()
            for key, array in out.items():
                more[key] = np.empty((LANES, *array.shape[1:]))
            left = self.write(
                {key: np.pad(x, filled, "edge") for key, x in rows.items()}, more
            )
            for key, array in out.items():
                array[:] = more[key][:count]
            return left[left < count]
        with np.errstate(all="ignore"):
            if self.only_inertia:
                good = kernel.write_inverse(q, out["B_lower"])
            else:
                good = self._write_anywhere(kernel, rows, out)
        return np.flatnonzero(~good)

    def _write_anywhere(
        self, kernel: RowAccelerations, rows: Rows, out: Mapping[str, Array]
    ) -> Mask:
        """Write the models about points at rest or in motion; return the mask of valid rows."""
        ready = self.linearizer.prepared
        q = rows["q"]
        A = out["A"]
        B = out["B_lower"]
        state = ready.map
        actuation = ready.actuation
        count = len(q)
        own_reference = ready.own_reference
        chart: Chart
        r_b: Array
        if own_reference:
            chart = ReferenceChart(count)
            r_b = np.zeros((count, 3))
        else:
            chart = state.charts(q)
            r_b = state.positions(q)
        nu: Array = np.zeros((count, B.shape[1]))
        u: Array = np.zeros((count, B.shape[2]))
        if "v" in rows:
            nu = state.velocities(rows["v"])
        if "u0" in rows:
            u = actuation.in_base_axes(chart, rows["u0"])
        q_m = state.joint_positions(q)
        nv = nu.shape[1]
        A[:, :nv] = ready.rest["A"][:nv]
        c, good = kernel.write(q, nu, q_m, u, A, B)
        gravity = state.field.falls(q) if state.field else state.gravity(q)
        rates = AccelerationDerivatives(c, A[:, nv:], B, gravity)
        f0 = assemble(actuation, chart, nu, u, rates, A, moving=ready.moving)
        out["_x0"][:] = state.compose(chart, r_b, q_m, nu)
        out["f0"][:] = 0.0 if ready.moving else f0
        if ready.moving:
            out["_drift"][:] = drift(state, f0, rates.gravity)
        # Comparisons with NaN are false, so rows with NaN are not valid. The upper half of A is not
        # checked, because it is finite if f0 is finite and the quaternion's scalar part q0 is not
        # close to zero.
        good = good & (np.asarray(chart.q0) >= SMALLEST_Q0).ravel()
        for values in (
            A.reshape(count, -1)[:, A[0].size // 2 :],
            B.reshape(count, -1),
            f0,
        ):
            good &= np.vecdot(values, values) < LARGEST
        return good


def _constrained_shapes(linearizer: Linearizer) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of a model of a robot with constraints."""
    ready = linearizer.prepared
    nx, d = ready.map.nx, len(linearizer.independent)
    nu, ny = len(ready.actuation.names), len(ready.common["output_names"])
    shapes: dict[str, tuple[int, ...]] = {
        "A": (2 * d, 2 * d),
        "B_lower": (d, nu),
        "C": (ny, 2 * d),
        "D": (ny, nu),
        "f0": (2 * d,),
        "_x0": (2 * d,),
        "_y0": (ny,),
        "_all_states": (nx, 2 * d),
        "_reduced_inertia": (d, d),
    }
    if ready.moving:
        shapes["_drift"] = (2 * d,)
    return shapes


class SweepTask:
    """Points of a sweep, and the arrays of its result that are the same at all points."""

    def __init__(
        self,
        job: ChunkJob,
        q: ArrayLike | Configurations,
        v: ArrayLike | None,
        u: ArrayLike | None,
        residual: Array | None = None,
    ) -> None:
        self.job = job
        self._residual = residual
        self.robot = (robot := job.linearizer.robot)
        prepared = job.linearizer.prepared
        root = robot.model.jointPlacements[ROOT]
        # `_points` generates configurations on demand; it is None if q is an array. `_known`
        # contains the given arrays. A single v or u for all points is broadcast to one row per
        # point.
        points = checked_points(robot, q)
        self._points: Configurations | None = None
        self._known: dict[str, Array] = {}
        if isinstance(points, np.ndarray):
            self._known["q"] = points
        else:
            self._points = points
        self.count = count = len(points)
        if v is not None:
            every = bool(robot.followers)
            check = robot.checked_velocity
            self._known["v"] = checked_rows("v", v, robot.nv, check, count, every=every)
        if u is not None:
            nu = len(prepared.actuation.names)
            of_inputs = partial(vector, "u", size=nu, of_what="the robot's inputs")
            self._known["u0"] = checked_rows("u", u, nu, of_inputs, count)
        # `given`: the arrays in `_known` that vary between points. `shapes`: the shapes, per point,
        # of all arrays that vary between points.
        self.given = {
            key: rows for key, rows in self._known.items() if not is_constant(rows)
        }
        self.shapes = {**job.shapes, "q": (robot.nq,)}
        self.shapes |= {key: rows.shape[1:] for key, rows in self.given.items()}
        constants: dict[str, Array] = {
            **prepared.rest,
            "C": prepared.common["C"],
            "D": prepared.common["D"],
            "_root": AT_ROOT if root.isIdentity(0.0) else pin.SE3ToXYZQUAT(root),
            **{key: rows[0] for key, rows in self._known.items()},
        }
        if not prepared.own_reference:
            constants["_reference"] = prepared.common["placement"]
        # {array: value}, for the arrays that are the same at all points.
        self.constants = {
            key: row for key, row in constants.items() if key not in self.shapes
        }

    def rows(self, start: int, stop: int) -> dict[str, Array]:
        """Return the configurations, velocities and inputs of points start to stop - 1."""
        rows: dict[str, Array] = {}
        if self._points:
            rows["q"] = self._points.rows(start, stop)
        for key, values in self._known.items():
            rows[key] = values[start:stop]
        return rows

    def batch(self, arrays: Mapping[str, Array]) -> LinearBatch:
        """Assemble a batch from the arrays that vary between points."""
        count = len(arrays["q"])
        rows: dict[str, Any] = dict.fromkeys(OPTIONAL)
        for key, value in self.constants.items():
            rows[key] = np.broadcast_to(value, (count, *value.shape))
        for key in self.shapes:
            rows[key] = frozen(arrays[key].view())
        common = self.job.linearizer.prepared.common
        linearizer = self.job.linearizer
        texts = {"dependent": (), **common, **linearizer.constrained_names}
        rows |= {key: texts[key] for key in TEXTS}
        rows["joints"] = self.robot.joint_names
        if self._residual is not None:
            rows["residual"] = frozen(self._residual[:count])
        columns = list[tuple[int, int, float]]()
        for joint in self.robot.joints:
            second = joint.idx_q + 1 if joint.unbounded else -1
            columns.append((joint.idx_q, second, joint.scale))
        return LinearBatch(
            **rows, columns=tuple(columns), _asked=common, notes=self.job.notes
        )

    def header(self) -> dict[str, str]:
        """Return the header of a file of the batch."""
        example = {key: np.empty((1, *shape)) for key, shape in self.shapes.items()}
        return self.batch(example | self.rows(0, 1)).header(self.count)

    @property
    def request(self) -> str:
        """Digest of all data that determine the result: the robot, the options and the points."""
        robot, prepared = self.robot, self.job.linearizer.prepared
        inertias = [inertia.toDynamicParameters() for inertia in robot.model.inertias]
        placements = [
            placement.homogeneous for placement in robot.model.jointPlacements
        ]
        settings = [getattr(robot, key) for key in _OF_THE_ROBOT]
        settings += [prepared.map.frame, prepared.moving, prepared.own_reference]
        settings += [self.job.only_inertia, __version__, pin.__version__, self.count]
        points = dict(vars(self._points)) if self._points else {}
        settings += [type(self._points).__name__]
        points.pop("robot", None)
        axes = points.pop("axes", None) or points.pop("ranges", {})
        points |= {
            f"{at} {name}": value for at, (name, value) in enumerate(axes.items())
        }
        return content_digest(
            {
                "robot": repr(settings),
                "model": np.concatenate(
                    [np.ravel(matrix) for matrix in (*inertias, *placements)]
                ),
                "reference": pin.SE3ToXYZQUAT(prepared.map.reference),
                **self._known,
                **{f"of q: {key}": value for key, value in points.items()},
            }
        )
