"""Time-varying linear model along a motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fflin.base.errors import InputError, listed, located
from fflin.base.process import in_one_thread
from fflin.base.validation import Array, ArrayLike, Complex, Indices, Vector
from fflin.dynamics.integrators import GAUSS, HEAVY, LIGHT, held_exponential
from fflin.linear.check import Check, check_all
from fflin.linear.fit import require_same
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel, refuse_sampled
from fflin.linear.partition import Partition, partition_of
from fflin.linear.trajectory import Trajectory, intervals_of
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.linear.tool_trajectory import ToolTrajectory


@dataclass(frozen=True, eq=False, repr=False)
class LinearTrajectory(Trajectory):
    r"""Error dynamics along a motion, ``d(dx)/dt = A(t) dx + B(t) du``, ``dy = C dx + D du``.

    The errors dx and du are the deviations of state and inputs from the motion. The error dx is in
    the axes of the moving base, see `Linearizer` (``moving=True``). Torques and forces on the base
    in du are also in base axes. If ``dt`` is positive, the model is in discrete time: the left side
    of the first equation is then the error dx at the next knot. For a LinearTrajectory ``along``,
    ``along[k]`` is the linear model at knot k.

    Attributes
    ----------
    A : ndarray (N, nx, nx)
        State matrices at the knots. If ``dt`` is positive, A contains N - 1 discrete-time state
        matrices, each from one knot to the next.
    B : ndarray (N, nx, nu)
        Input matrices at the knots. If ``dt`` is positive, B contains N - 1 discrete-time input
        matrices, each from one knot to the next.
    C : ndarray (N, ny, nx)
        Output matrices at the knots.
    D : ndarray (N, ny, nu)
        Feedthrough matrices at the knots.
    y : ndarray (N, ny)
        Outputs along the motion.
    state_names, input_names, output_names : tuple of str
        Names of dx, du and dy.
    dt : float
        Sample time [s], during which du is constant; 0 in continuous time.
    period : float
        Time [s] after which the motion and the models repeat; 0 if they do not repeat.
    multipliers : ndarray (nx,)
        Characteristic multipliers of a periodic motion.
    switches : ndarray (S,)
        Times [s] of knots at which the independent coordinates of a robot with constraints change.
        From a switch on, the models are in the new coordinates.
    switched_names : tuple of str
        Names of dx after each switch, nx for each one.
    robot, t, q, v, u, hold, frame : see `Trajectory`

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> along[3].moving, along.discretize(0.05).dt
    (True, 0.05)
    """

    A: Array
    B: Array
    C: Array
    D: Array
    y: Array
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    dt: float = 0.0
    switches: Vector = field(default_factory=partial(np.zeros, 0), kw_only=True)
    switched_names: tuple[str, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        made = "the linear trajectory was made for another robot"
        reduced = bool(self.robot.constraints)
        state = self._aba.state
        for names in self.partition.names:
            require_same(made, state, "state", names, None, part=reduced)

    @property
    def input_units(self) -> tuple[str, ...]:
        """Units of the nu inputs."""
        return self.actuation.units

    def __len__(self) -> int:
        return len(self.A)

    def __getitem__(self, index: int) -> LinearModel:
        """Return the linear model at the knot with the given index."""
        k = range(len(self))[index]
        t = float(self.t[k])
        linearizer: Linearizer = self._linearizers[self._parts[k]]
        q, v = linearizer.on_constraints(self.q[k], self.v[k])
        lin = linearizer(q, v, self.u_base[k], t=t)
        matrices = {name: getattr(self, name)[k] for name in "ABCD"}
        if self.dt:
            time = lin.t
            lin = replace(replace(lin, t=None).discretize(self.dt), t=time)
        return replace(lin, **matrices, y0=self.y[k], verified=self.verified)

    def __iter__(self) -> Iterator[LinearModel]:
        return map(self.__getitem__, range(len(self)))

    def _remarks(self) -> list[str]:
        remarks = super()._remarks()
        if self.period:
            from fflin.linear.floquet import multiplier_text

            period = f"period {self.period:.6g} s"
            remarks = [*remarks, f"{period}; {multiplier_text(self.multipliers)}"]
        if self.robot.orbit:
            remarks = [*remarks, str(self.robot.orbit)]
        remarks += self.partition.remarks()
        return remarks

    @property
    def independent(self) -> tuple[str, ...] | None:
        """Independent coordinates of a robot with constraints, as for `linearize`; None without.

        They are the coordinates at the first knot.
        """
        if not self.robot.constraints:
            return None
        return self.state_names[: len(self.state_names) // 2]

    @property
    def partition(self) -> Partition:
        """Parts of the motion with the same independent coordinates."""
        return Partition.of(self.switches, self.state_names, self.switched_names)

    @property
    def last_part(self) -> int:
        """Index of the last part of the motion."""
        return len(self.switches)

    def knots_of(self, part: int) -> Vector:
        """Return the times [s] of the knots of a part, from its first knot to its end."""
        ends = np.append(self.switches, self.t[-1])
        begins = np.append(self.t[0], self.switches)
        within = (self.t >= begins[part]) & (self.t <= ends[part])
        knots: Vector = self.t[within]
        return knots

    def refuse_switches(self, what: str) -> None:
        """Raise `InputError` if the independent coordinates change; `what` is the feature."""
        if len(self.switches):
            raise InputError(
                f"{what} need one choice of independent coordinates along the motion, but they "
                f"change at t = {listed(f'{t:g}' for t in self.switches)} s; give independent= to "
                "linearize_trajectory, or split the trajectory there"
            )

    @cached_property
    def _parts(self) -> Indices:
        """Index (N,) of the part to which the model of each knot belongs."""
        return self._parts_at(self.t)

    def _parts_at(self, times: Array) -> Indices:
        return self.partition.parts_at(times, float(self.t[-1] - self.t[0]))

    @cached_property
    def _linearizers(self) -> tuple[Linearizer, ...]:
        """Linearizer of each part."""
        if not self.robot.constraints:
            return (Linearizer(self.robot, moving=True),)
        half = len(self.state_names) // 2
        return tuple(
            Linearizer(self.robot, moving=True, independent=names[:half])
            for names in self.partition.names
        )

    @cached_property
    def switch_maps(self) -> Array:
        """Maps (S, nx, nx) from the errors dx before each switch to the errors after it."""
        maps = np.zeros((len(self.switches), *self.A.shape[1:]))
        for part, t in enumerate(self.switches.tolist()):
            maps[part] = self.error_maps(np.array([t]), part, part + 1)[0]
        return maps

    def error_maps(self, times: Array, part: int, to: int) -> Array:
        """Return the maps (k, nx, nx) from the errors in one part's coordinates to another's.

        The coordinates of `part` must determine the motion at the times (k,).
        """
        state = self._aba.state
        rows = [state.names.index(name) for name in self.partition.names[to]]
        linearizer = self._linearizers[part]
        q, v, _ = self.points(times)
        maps = np.zeros((len(times), len(rows), len(rows)))
        for k, point in enumerate(zip(q, v, strict=True)):
            closed = linearizer.on_constraints(*point)
            maps[k] = linearizer.reduction(*closed, linearizer.independent).T[rows]
        return maps

    def matrices(self, t: float) -> tuple[Array, Array]:
        """Return A (nx, nx) and B (nx, nu) about the motion at time t [s], also between knots."""
        A, B = self.matrices_at(np.array([self._within(t)]))
        return A[0], B[0]

    def matrices_at(self, times: Array, part: int | None = None) -> tuple[Array, Array]:
        """Return A (k, nx, nx) and B (k, nx, nu) at times (k,), with one matrix pair per time.

        They are in the coordinates of the part with the given index, or of the part at each time.
        """
        times = self._within_period(times)
        k, s = intervals_of(self.t, times)
        if self.dt:
            s = 0.0 * s
        inside, knot = (s > 0.0) & (s < 1.0), k + (s == 1.0)
        A, B = self.A[knot], self.B[knot]
        parts = self._parts_at(times) if part is None else np.full(len(times), part)
        new = inside | (parts != self._parts[knot])
        for index in np.unique(parts[new]).tolist():
            rows = new & (parts == index)
            inner = times[rows]
            models = self._linearizers[index].along(*self.points(inner), inner)
            A[rows], B[rows] = models["A"], models["B"]
        return A, B

    def outputs_at(self, times: Array) -> Array:
        """Return C (k, ny, nx) at times (k,), in the coordinates of the part at each time."""
        parts = self._parts_at(times)
        C = np.zeros((len(times), *self.C.shape[1:]))
        for index in np.unique(parts).tolist():
            rows = parts == index
            linearizer = self._linearizers[index]
            C[rows] = linearizer.along(*self.points(times[rows]), times[rows])["C"]
        return C

    def between(self, t: float, *arrays: Array) -> tuple[Array, ...]:
        """Interpolate arrays that are given at the knots to the time t [s].

        If the model is in discrete time, the values at the previous knot are returned instead.
        """
        (k,), (fraction,) = intervals_of(self.t, np.array([self._within(t)]))
        if self.dt or not fraction:
            return tuple(array[k] for array in arrays)
        return tuple(
            array[k] + fraction * (array[k + 1] - array[k]) for array in arrays
        )

    def check(self, *, tolerance: float | None = None) -> Check:
        """Check the linear model at every knot by `fflin.check`, and return the largest errors.

        Parameters
        ----------
        tolerance : float, optional
            Relative tolerance for all errors, instead of the default tolerances of `check`.
        """
        title = f"{self.robot.name}, {len(self)} knots"
        return check_all(self.robot, self, title, tolerance=tolerance)

    @cached_property
    def multipliers(self) -> Complex:
        """Characteristic multipliers of a periodic motion, complex, the largest first.

        They are the eigenvalues of the transition matrix over one period. The motion is stable if
        all magnitudes are below 1. They are computed from the factors of this matrix, so that small
        multipliers are not lost beside large ones. The report states multipliers below 1e-16 of the
        largest as such.

        Raises
        ------
        InputError
            If the motion has no period.
        """
        from fflin.linear.floquet import multipliers

        values = multipliers(self._monodromy_factors())
        values.setflags(write=False)
        return values

    def _monodromy_factors(self) -> Array:
        """Return the transition matrices (k, nx, nx) from knot to knot of a periodic motion."""
        if not self.period:
            raise InputError(
                "the trajectory has no period, so it has no multipliers; linearize_orbit makes a "
                "periodic one"
            )
        if self.dt:
            return self.A
        nx = len(self.state_names)
        return np.array([whole[:, :nx] for _, whole in knot_transitions(self)])

    @in_one_thread
    def discretize(self, dt: float) -> LinearTrajectory:
        r"""Return the discrete-time model along the motion, with du constant over each sample.

        The transition matrix :math:`\Phi` solves :math:`\dot\Phi = F(t)\,\Phi` with F = [[A, B],
        [0, 0]], see (10.3) of docs/derivation.md. Each integration step uses two matrix
        exponentials of F, with A and B evaluated on the motion between the knots. The method has
        order four and is exact if F is constant. The steps are halved until the result changes by
        less than 1e-8.

        Parameters
        ----------
        dt : float
            Sample time [s]. The duration must be a multiple of dt.

        Raises
        ------
        InputError
            If the duration is not a multiple of dt, or the model is already in discrete time.
        """
        refuse_sampled(self.dt, "discretize")
        maps = np.array([transition for _, transition in transitions(self, dt)])
        nx, models = len(self.state_names), along(self.resampled(dt), self.partition)
        return replace(models, A=maps[:, :nx, :nx], B=maps[:, :nx, nx:], dt=float(dt))

    def to(self, tool: str, *, dt: float | None = None) -> ToolTrajectory:
        """Return the models at all knots in the coordinates of another tool.

        Parameters
        ----------
        tool : {"pinocchio", "crocoddyl"}
            The errors of these tools are in base axes, as here. For other tools, convert the model
            at each knot by ``along[k].to(tool)``.
        dt : float, optional
            Time step [s] of Crocoddyl: A and B are then Fx and Fu of a semi-implicit Euler step
            from each knot, see `transform`.

        Raises
        ------
        InputError
            If the tool has other axes, `dt` is not allowed for it, or the trajectory is sampled and
            `dt` is given.
        UnknownNameError
            If the tool is unknown.
        """
        from fflin.linear.tool_trajectory import tool_trajectory

        return tool_trajectory(self, tool, dt)

    @classmethod
    def load(cls, path: str | Path, robot: Robot) -> LinearTrajectory:  # type: ignore[override]
        """Read a file that `save` wrote for this robot, and restore every value bit for bit."""
        return cls._read(path, robot=robot)


def linearize_trajectory(
    robot: Robot,
    t: ArrayLike | Trajectory,
    q: ArrayLike | None = None,
    v: ArrayLike | None = None,
    u: ArrayLike | None = None,
    *,
    strict: bool = False,
    independent: Sequence[str] | None = None,
    **options: object,
) -> LinearTrajectory:
    """Linearise a robot along a motion.

    Parameters
    ----------
    robot : Robot
    t : Trajectory or array_like (N,)
        The motion as a `Trajectory`, or the times of its knots [s].
    q, v, u : array_like, optional
        Configurations, velocities and inputs at the knots, see `Trajectory`. Give q, v and u only
        if t contains times.
    strict : bool
        Whether to raise an error, instead of a warning, if the knots violate the robot's dynamics
        with a residual above 1e-2.
    independent : sequence of str, optional
        Coordinates of the models of a robot with constraints, see `Linearizer`; the same along the
        motion. By default, they are chosen at the first knot. Where another choice determines the
        motion much better, they change, see `switches` of the result.
    **options
        The options `hold` and `frame` of `Trajectory`.

    Returns
    -------
    LinearTrajectory

    Raises
    ------
    InputError
        If the arrays are not valid for `Trajectory`, or `strict` is true and the residual of the
        motion exceeds 1e-2.
    ConstraintError
        If the independent coordinates do not determine the motion at some time, which the message
        names, or the rank of the constraints changes there.

    Warns
    -----
    FflinWarning
        If the knots violate the robot's dynamics. The warning reports the largest error, the
        interval in which it occurs, and usual causes.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> along.A.shape, along.check().ok
    ((11, 18, 18), True)
    """
    if isinstance(t, Trajectory):
        if options or not q is v is u is None:
            raise InputError(
                "a trajectory is given, which already contains q, v, u, hold and frame; leave "
                "these arguments out"
            )
        motion = t if t.robot is robot else replace(t, robot=robot)
    else:
        given: dict[str, Any] = {"t": t, "q": q, "v": v, "u": u, **options}
        motion = Trajectory(robot, **given)
    motion.require(strict=strict)
    if independent is None:
        return along(motion)
    return along(motion, _partition(motion, independent))


def along(motion: Trajectory, partition: Partition | None = None) -> LinearTrajectory:
    """Return the error dynamics of a trajectory, linearised about all knots.

    If the robot has constraints, `partition` gives the coordinates. By default, they are chosen.
    """
    robot = motion.robot
    if partition is None:
        partition = _partition(motion, robot.independent or None)
    parts = partition.parts_at(motion.t, float(motion.t[-1] - motion.t[0]))
    point = motion.q, motion.v, motion.u_base, motion.t
    blocks = list[dict[str, Array]]()
    for index, names in enumerate(partition.names):
        rows = parts == index
        independent = names[: len(names) // 2] if robot.constraints else None
        linearizer = Linearizer(robot, moving=True, independent=independent)
        blocks.append(linearizer.along(*(array[rows] for array in point)))
        if robot.constraints:
            linearizer.require_same_side(blocks[-1].pop("T"), motion.t[rows])
    fields: dict[str, Any] = blocks[0]
    if len(blocks) > 1:
        fields = {
            key: np.concatenate([block[key] for block in blocks]) for key in blocks[0]
        }
    fields["state_names"] = partition.names[0]
    for key in ("input_names", "output_names"):
        fields[key] = linearizer.prepared.common[key]
    made = LinearTrajectory._of(
        motion,
        **fields,
        dt=0.0,
        switches=partition.times,
        switched_names=partition.later,
    )
    for name in ("gaps", "cubics"):
        if name in vars(motion):  # keep cached results of the same motion
            vars(made)[name] = vars(motion)[name]
    return made


def _partition(motion: Trajectory, independent: Sequence[str] | None) -> Partition:
    """Return the parts of a motion; a single one if the coordinates are given.

    Without constraints, all states are independent.
    """
    robot = motion.robot
    linearizer = Linearizer(robot, moving=True, independent=independent)
    names = linearizer.prepared.map.names
    if not robot.constraints:
        return Partition(np.zeros(0), (names,))
    if independent is not None:
        linearizer.along(motion.q[:1], motion.v[:1], motion.u_base[:1], motion.t[:1])
        return Partition(np.zeros(0), (linearizer.constrained_names["state_names"],))
    points = list[tuple[Array, Array]]()
    for t, *point in zip(motion.t.tolist(), motion.q, motion.v, strict=True):
        with located(f"at t = {t:g} s"):
            points.append(linearizer.on_constraints(*point))
    motions = [linearizer.motions(*point) for point in points]
    return partition_of(motion.t, motions, names)


# ACCURACY is the required relative accuracy of a sample's transition matrix. The integration steps
# are halved until the matrix is accurate, or until each interval has _MOST_PARTS parts. The knots
# within a sample divide the sample into intervals.
ACCURACY, _MOST_PARTS = 1e-8, 64

# Number of samples that are integrated together.
_BATCH = 64


class Steps(NamedTuple):
    """The m integration steps of a sample. In each step, F = [[A, B], [0, 0]] is constant."""

    F: Array  # (m, nx + nu, nx + nu)
    h: Array  # (m,) [s] lengths of the steps
    maps: Array  # (m, nx, nx + nu) transition matrices of the steps
    # (m, 2) [s] the two Gauss points; the first has the larger weight in F
    nodes: Array


def transitions(traj: LinearTrajectory, dt: float) -> Iterator[tuple[Steps, Array]]:
    """Yield the integration steps and the transition matrix of each sample of dt [s].

    The transition matrix (nx, nx + nu) computes the error at the end of a sample from the error and
    the input at the start.
    """
    times = traj.samples(dt)
    if times[-1] != traj.t[-1]:
        duration = float(traj.t[-1] - traj.t[0])
        nearest = duration / max(1, round(duration / dt))
        raise InputError(
            f"dt is {dt:g} s, but the duration of the trajectory, {duration:g} s, is not a "
            "multiple of dt; give a dt (--sample) that divides the duration, such as "
            f"{nearest!r}"
        )
    cuts = []
    for start, end in pairwise(times.tolist()):
        near = 1e-9 * (end - start)
        inner = traj.t[(traj.t > start + near) & (traj.t < end - near)]
        cuts.append(np.array([start, *inner, end]))
    yield from _accurate(traj, cuts)


def knot_transitions(traj: LinearTrajectory) -> Iterator[tuple[Steps, Array]]:
    """Yield the integration steps and the transition matrix from each knot to the next."""
    yield from transitions_between(traj, traj.t)


def transitions_between(
    traj: LinearTrajectory, times: Array
) -> Iterator[tuple[Steps, Array]]:
    """Yield the integration steps and the transition matrix from each time to the next.

    All knots between the first and the last of the times [s] must be among the times.
    """
    yield from _accurate(traj, [np.array(ends) for ends in pairwise(times.tolist())])


def _accurate(
    traj: LinearTrajectory, cuts: list[Array]
) -> Iterator[tuple[Steps, Array]]:
    """Yield the steps and the transition matrix of each sample, for the samples of `_through`."""
    for first in range(0, len(cuts), _BATCH):
        batch = cuts[first : first + _BATCH]
        samples = _through(traj, batch, 1)
        parts = 1
        pending = list(range(len(batch)))
        while pending and parts < _MOST_PARTS:
            parts = 2 * parts
            coarse = pending
            finer = _through(traj, [batch[k] for k in coarse], parts)
            pending = []
            for k, sample in zip(coarse, finer, strict=True):
                # Halving the steps divides the error by 16, so the remaining error is about 1/15 of
                # the change. For a safety margin, the estimate is 1/4 of the change.
                apart = np.abs(sample[1] - samples[k][1]).max(axis=0)
                if not (0.25 * apart <= ACCURACY * np.abs(sample[1]).max(axis=0)).all():
                    pending.append(k)
                samples[k] = sample
        yield from samples


def _through(
    traj: LinearTrajectory, cuts: list[Array], parts: int
) -> list[tuple[Steps, Array]]:
    """Return the steps and the transition matrix of each sample; see `transitions`.

    Each array in `cuts` contains the times of one sample: the start, the knots within the sample,
    and the end. Each interval between two times is divided into equal parts, whose number is
    `parts`. Each part has two steps, one for each exponential in (10.3).
    """
    fraction = np.arange(parts) / parts
    starts = list[Array]()
    lengths = list[Array]()
    for times in cuts:
        interval = np.diff(times)
        starts.append((times[:-1, None] + interval[:, None] * fraction).ravel())
        lengths.append(np.repeat(interval / parts, parts))
    length = np.concatenate(lengths)
    nodes = np.concatenate(starts)[:, None] + np.array(GAUSS) * length[:, None]
    A, B = traj.matrices_at(nodes.ravel())
    nx, nu = B.shape[1:]
    F = np.zeros((len(length), 2, nx + nu, nx + nu))
    F[..., :nx, :nx] = A.reshape(len(length), 2, nx, nx)
    F[..., :nx, nx:] = B.reshape(len(length), 2, nx, nu)
    mixed = (HEAVY * F + LIGHT * F[:, ::-1]).reshape(-1, nx + nu, nx + nu)
    h = np.repeat(0.5 * length, 2)
    heavy_light = np.stack((nodes, nodes[:, ::-1]), axis=2).reshape(-1, 2)
    transition, held = held_exponential(mixed[:, :nx, :nx], mixed[:, :nx, nx:], h)
    maps = np.concatenate((transition, held), axis=-1)
    interval_ends = np.concatenate([times[1:] for times in cuts])
    _change_coordinates(traj, interval_ends, maps, 2 * parts)
    ends = np.cumsum([2 * len(start) for start in starts])[:-1]
    columns = [np.split(array, ends) for array in (mixed, h, maps, heavy_light)]
    samples = list[tuple[Steps, Array]]()
    for row in zip(*columns, strict=True):
        steps = Steps(*row)
        whole = np.eye(nx + nu)
        for step in steps.maps:
            whole[:nx] = step @ whole
        samples.append((steps, whole[:nx]))
    return samples


def _change_coordinates(
    traj: LinearTrajectory, ends: Array, maps: Array, steps: int
) -> None:
    """Append the change of coordinates to the last step of each interval that ends at a switch.

    `ends` (m,) are the times of the ends of the intervals, and `maps` (m steps, nx, nx + nu) are
    the transition matrices of their steps.
    """
    near = 1e-9 * float(traj.t[-1] - traj.t[0])
    for t, change in zip(traj.switches, traj.switch_maps, strict=True):
        for interval in np.flatnonzero(np.abs(ends - t) <= near).tolist():
            last = (interval + 1) * steps - 1
            maps[last] = change @ maps[last]
