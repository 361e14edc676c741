"""Monte Carlo simulation of a loop with random parameters, initial states and sensor errors."""

import json
import math
import pickle
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing, suppress
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin

from fflin.base import __version__
from fflin.base.errors import FileError, InputError, require_known
from fflin.base.record import content_digest, reading
from fflin.base.validation import Array, count, instance, share, truth, whole
from fflin.batch import files
from fflin.batch.run import Execution, Progress, run_chunks
from fflin.campaign.campaign import NOT_RUN, Campaign
from fflin.campaign.replay import replay_settings
from fflin.campaign.runs import KINDS, CampaignJob, chunk_size, expect, notes_on_engine
from fflin.campaign.spreads import placed
from fflin.kernel.tree import LANES
from fflin.robot.robot import Robot
from fflin.simulation.motion import Motion
from fflin.simulation.plan import SimulationOptions
from fflin.simulation.report import pushed

# With `until`, the confidence interval is first computed after _STAGE runs. Before it is computed
# again, the number of runs is multiplied by _GROWTH and rounded up to a multiple of _STAGE. The
# chunk size must divide _STAGE, so that the number of runs does not depend on the chunk size.
_STAGE, _GROWTH = 256, 1.25

_OPTIONS = {option.name for option in fields(SimulationOptions)} - {
    "robot",
    "policy",
    "duration",
    "events",
    "callback",
    "linear",
    "every",
    "progress",
    "engine",
    "seed",
}


def monte_carlo(
    robot: Robot,
    policy: object,
    dispersions: Mapping[str, object],
    *,
    runs: int,
    duration: float | None = None,
    seed: int = 0,
    goals: Sequence[str] = (),
    until: str | None = None,
    width: float = 0.02,
    confidence: float = 0.95,
    executor: Executor | None = None,
    workers: int | None = None,
    threads: int | None = None,
    chunk: int | None = None,
    histories: int = 0,
    progress: Progress | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    engine: str | None = None,
    **options: object,
) -> Campaign:
    r"""Run a Monte Carlo campaign: simulate a policy many times with dispersed parameters.

    Each run is equivalent to one call of `simulate`. If numba is installed, the compiled loop
    computes eight runs at a time. To save memory, only a summary of fixed size is stored for each
    run; `Campaign.replay` simulates a run again and returns its full motion.

    Parameters
    ----------
    robot : Robot
    policy : policy, GainSchedule or None
        Policy as in `simulate`. Each run has its own copy of an object with memory, after its
        method ``reset()`` was called if it has one, so no run depends on another. An object with a
        method ``bind(robot)`` is bound anew for each run instead.
    dispersions : mapping
        Mapping {name, group or pattern: spread}, or the result of `load_dispersions`. A spread is
        one of

        - a number: the standard deviation of a normal distribution about 0;
        - a tuple (least, largest): a uniform distribution;
        - a list of values, all equally likely;
        - a frozen distribution of scipy.stats.

        A value is drawn independently for each name in a pattern or group. With
        ``{"range": spread, "tied": True}``, all names of a pattern or group share one drawn value.
        A name is one of

        - a state, or a group or pattern of states, such as ``r_b.x``, ``q_b``, ``omega_b`` or
          ``q_m.*``: the drawn value is added to the initial state.
        - ``LINK.mass``, ``LINK.density``: relative change d of the mass or density of a link, as in
          `sensitivity` and `uncertain`. A draw of ``mass`` multiplies the mass by (1 + d) at
          constant inertia about the centre of mass. A draw of ``density`` multiplies mass and
          inertia by (1 + d).
        - ``LINK.com`` [m]: shift of the centre of mass along each axis of the link. Mass and
          inertia about the centre of mass are unchanged, as for ``LINK.com.x`` in `sensitivity`
          and `uncertain`.
        - ``LINK.inertia``: relative changes d of the second moments of the mass distribution along
          the axes of the link's frame, drawn independently for each axis, as in `Robot.perturbed`.
          The moments are multiplied by (1 + d) and the mass is unchanged, so the pseudo-inertia
          stays positive definite.

          LINK is the name of a link in the URDF. The name of a joint, or ``base``, means the whole
          body that the joint carries: its link and all links fixed to this link. A pattern selects
          links only.
        - ``INPUT.gain`` (relative change d) and ``INPUT.bias`` (b, in N m or N): the actual input
          is (1 + d) u + b for a command u. ``INPUT.fails`` [s]: time of a failure after which the
          input is zero. The recorded inputs are the commands, even after a failure.
        - ``INPUT.misalignment`` [rad]: two independently drawn angles. The direction of a thruster,
          the axis of a wheel, or an axis of tau_b or F_b is rotated by these angles about two axes
          perpendicular to it.
        - ``tau_b.disturbance`` [N m] and ``F_b.disturbance`` [N]: constant torque and force on the
          base, or one of their components, such as ``tau_b.x.disturbance``. The drawn values add to
          `Robot.disturbance`, in its default axes. ``tau_b.amplitude`` and ``F_b.amplitude``:
          relative changes of the amplitudes of the periodic terms of `Robot.disturbance`, one for
          each component, such as ``tau_b.x.amplitude``.
        - ``residual_dipole.disturbance`` [A m^2], ``field_scale.disturbance`` and
          ``field_rotation.disturbance`` [rad], or components such as
          ``field_rotation.x.disturbance``: residual dipole and errors of the magnetic field. The
          drawn values add to `Robot.disturbance`.
        - ``plate_1.drag`` and ``plate_1.sunlight``: relative changes of drag and of solar pressure
          on the flat plates of `Robot.disturbance`, which are numbered from 1.
        - ``NAME.sensor``: constant offset in the measurement of a state that a `StateFeedback`
          reads, or of an output that an `OutputFeedback`, `LinearController` or
          `TrajectoryOutputFeedback` measures. ``NAME.noise``: white noise added to this measurement
          at each sample. If the spread is a number, it is the standard deviation of the noise in
          all runs. From any other spread, a standard deviation is drawn for each run.
          ``NAME.drift``: standard deviation of the random change of the sensor's bias within 1 s.
          By default, the robot's outputs declare noise and drift, see `Output`; the
          option ``noise=0`` leaves them out.
        - ``delay`` [s]: change of the argument `delay` of `simulate`. The total delay is rounded to
          whole steps; a negative total becomes 0.
        - ``JOINT.stiffness`` and ``JOINT.damping``: relative changes from the nominal values.
        - ``MODE.frequency`` and ``MODE.damping`` of flexible appendages and slosh: relative changes
          of the frequency and of the damping ratio.
    runs : int
        Number of runs.
    duration : float, optional
        Simulated time [s]; by default the duration of the followed trajectory.
    seed : int
        Random seed. The draws of a parameter depend only on the seed, not on the number of runs,
        workers and chunks or on other dispersed parameters.
    goals : sequence of str, optional
        Conditions such as ``"attitude < 1 deg"``, see `Campaign.fraction`. The printed report and
        `plot_campaign` show the success rate of each goal with its confidence interval.
    until : str, optional
        Condition for ending the campaign early. The campaign ends when the confidence interval of
        the condition's success rate is at most `width` wide. The interval is first checked after
        256 runs. Before each further check, the number of runs grows by a quarter, rounded up to a
        multiple of 256.
    width, confidence : float
        Width and confidence level of the interval for `until`. The report uses the same
        confidence level.
    executor, workers, threads, progress : optional
        As in `sweep`. The workers of an executor must be able to import the modules of the policy.
    chunk : int, optional
        Number of runs per chunk: a multiple of 8, and a divisor of 256 if `until` is given.
    histories : int, optional
        Number of evenly spaced times at which the errors and inputs of each run are recorded. The
        bands of `plot_campaign` require histories.
    out : str or Path, optional
        File to write, .h5 or .npz. The unfinished results of a .h5 file are kept in NAME.part.
        After a crash, the same call resumes from the intact chunks in NAME.part. If the file
        already contains all of these runs, it is read and nothing is simulated, even if its goals
        differ. With `until`, a complete file is not read, and the runs are simulated again.
    overwrite : bool
        Whether to replace the file `out` if a call with different arguments wrote it. By default,
        such a file is not replaced, and a `FileError` is raised.
    engine : {"python", "compiled"}, optional
        Engine that simulates the runs. The default is the compiled engine if it supports these
        runs, see `simulate`. Otherwise, `Campaign.notes` states the reason.
    **options
        Options of `simulate`: x0, q0, v0, dt, method, project, sample, delay, limits, disturbance,
        target, frame, reference.

    Returns
    -------
    Campaign
        Results in the order of the runs. If `out` is given, arrays are read from the file on
        demand.

    Raises
    ------
    InputError
        If a size or value is wrong, or the drawn values lead to an invalid robot. The message names
        the draw.
    UnknownNameError
        If a name is unknown.
    SweepError
        If a run fails or a worker dies; the message names the chunk.
    FileError
        If the file cannot be written, or if a call with different arguments wrote it and
        `overwrite` is False.
    MissingPackageError
        If a .h5 file is requested and h5py is not installed.

    References
    ----------
    P. M. Wensing, S. Kim and J.-J. E. Slotine, Linear matrix inequalities for physically-consistent
    inertial parameter identification, IEEE Robotics and Automation Letters 3(1), 2018.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> spreads = {"q_b": 0.02, "*.mass": 0.05, "tau_b.bias": 0.01}
    >>> runs = fflin.monte_carlo(robot, policy, spreads, runs=16, duration=30.0, dt=0.05)
    >>> len(runs), runs.fraction("attitude < 1 deg").value > 0.5
    (16, True)
    """
    if isinstance(robot, Motion):
        raise InputError(
            "robot has type Motion, expected a fflin.Robot; a campaign simulates one phase: give "
            "the robot of this phase, and q0 and v0 from a row of the motion"
        )
    require_known("option of monte_carlo", options, sorted(_OPTIONS))
    runs, seed = whole("runs", runs, 1), whole("seed", seed, 0)
    width, confidence = share("width", width), share("confidence", confidence)
    how = Execution(executor, workers, threads, chunk, progress)
    path = None if out is None else files.output_path(out)
    options |= {"duration": duration, "histories": count("histories", histories, 0)}
    job = CampaignJob(robot, policy, dispersions, seed, engine, options)
    shapes = {"drawn": (len(job.dispersions.names),), **job.shapes}
    size = _chunk(runs, chunk, how.count(job), staged=until is not None)
    store: files.MemoryStore | files.FileStore | None = None
    if path is None or path.suffix == ".npz":
        store = files.MemoryStore(runs, size, shapes)
    elif not files.part_of(path).exists():
        files.require_room(path, 8 * runs * sum(map(math.prod, shapes.values())))
    if how.executor:
        _require_sendable(job)
    header = _header(job) | {"seed": seed, "asked": runs, "confidence": confidence}
    none = files.MemoryStore(0, size, shapes).arrays
    header["goals"] = wanted = _goals(
        goals, until, Campaign.of(none, {**header, "goals": ()})
    )
    with placed(dispersions):
        job.dispersions.require_possible(runs)
    request = ""
    if path:
        request = _request(job, runs, header)
        earlier = None if truth("overwrite", overwrite) else _earlier(path, request)
        if earlier and until is None and len(earlier) == runs:
            note = (
                f"all runs are from {path}, which an earlier call wrote; "
                "none was simulated again"
            )
            return replace(
                earlier,
                goals=wanted,
                confidence=confidence,
                notes=(*earlier.notes, note),
                _job=job,
            )
        if store is None:
            texts = {"header": json.dumps(header)}
            store = files.FileStore(path, request, runs, size, shapes, {}, texts)
    assert store is not None
    with closing(store), how:
        expect(
            how.progress, [(job, job.dispersions.drawn(0, min(runs, LANES)), runs)], how
        )
        enough = None
        if until is not None:
            enough = partial(_is_narrow, header, until, width, confidence)
        resumed = _computed(job, store, how, header, enough)
        campaign = Campaign.of(store.complete(), header, job)
    notes = (*campaign.notes, *notes_on_engine(job, engine))
    campaign = replace(campaign, notes=notes)
    if resumed:
        note = f"{resumed:,} of {runs:,} runs are from the unfinished file of an earlier call"
        campaign = replace(campaign, notes=(*campaign.notes, note))
    if path and path.suffix == ".npz":
        campaign._save(path, request=request)
    return campaign


def _computed(
    job: CampaignJob,
    store: files.MemoryStore | files.FileStore,
    how: Execution,
    header: Mapping[str, object],
    enough: Callable[[dict[str, Array]], bool] | None,
) -> int:
    """Compute the runs of a store, and return how many of them it has from an earlier call.

    If `enough` is given, runs are computed in stages until it returns True for the arrays of the
    computed runs. The rows of the other runs are marked as not run.
    """
    runs = store.count
    made = partial(Campaign.of, header=header, job=job)
    done = runs if enough is None else min(_STAGE, runs)
    resumed = run_chunks(
        job, job.rows, store, how, how.progress, of_what="runs", made=made, upto=done
    )
    while enough is not None and done < runs and not enough(store.read(done)):
        done = min(runs, math.ceil(_GROWTH * done / _STAGE) * _STAGE)
        run_chunks(
            job,
            job.rows,
            store,
            how,
            how.progress,
            of_what="runs",
            made=made,
            upto=done,
        )
    shapes = {"drawn": (len(job.dispersions.names),), **job.shapes}
    for start in range(done, runs, store.chunk):
        stop = min(start + store.chunk, runs)
        unused = {
            key: np.full((stop - start, *shape), NOT_RUN)
            for key, shape in shapes.items()
        }
        store.write(start, stop, unused)
    return resumed


def _is_narrow(
    header: Mapping[str, object],
    until: str,
    width: float,
    confidence: float,
    arrays: dict[str, Array],
) -> bool:
    """Return whether the confidence interval of a condition is at most `width` wide."""
    interval = Campaign.of(arrays, header).fraction(until, confidence=confidence)
    return interval.high - interval.low <= width


def _chunk(runs: int, given: int | None, workers: int, *, staged: bool) -> int:
    """Return the number of runs per chunk; if `staged` is true, it must divide _STAGE."""
    if given is None:
        if staged:
            runs = min(_STAGE, runs)
        return chunk_size(runs, workers)
    size = -(-given // LANES) * LANES
    if staged and _STAGE % size:
        raise InputError(
            f"chunk is {given}, but with until it must be a divisor of {_STAGE}, such as 32"
        )
    return size


def _require_sendable(job: CampaignJob) -> None:
    try:
        pickle.dumps(job)
    except Exception as error:  # pickling may raise any exception
        raise InputError(
            f"robot, policy or spreads cannot be sent to workers ({error}); define their classes "
            "and functions at the top level of a module, or leave workers and executor out"
        ) from None


def _goals(given: object, until: str | None, none: Campaign) -> tuple[str, ...]:
    """Return the goals, including `until`.

    Each goal is evaluated on the empty campaign `none`, so that an invalid goal raises an error.
    """
    listed = [given] if isinstance(given, str) else given
    goals: list[str] = [
        *instance("goals", listed, Sequence, "a list such as ['attitude < 1 deg']")
    ]
    if until is not None:
        goals.append(until)
    for goal in goals:
        none.met(instance("a goal", goal, str, "a text such as 'attitude < 1 deg'"))
    return tuple(dict.fromkeys(goals))


def _earlier(path: Path, request: str) -> Campaign | None:
    """Return the campaign that a call with the same `request` wrote, or None if there is no file.

    Raise `FileError` if a different call wrote the file, or if the file cannot be read.
    """
    if not path.is_file():
        return None
    with suppress(FileError), reading(path, "Campaign"):
        if files.read_rows(path, verify=False)[2].get("request") == request:
            return Campaign.load(path)
    raise FileError(
        f"{path} exists and was not written by this call; name another file, or replace the file "
        "with overwrite=True (--force)"
    )


def _header(job: CampaignJob) -> dict[str, object]:
    """Return the header of a job's campaign: the fields that the job defines, except arrays."""
    plan = job.plan
    plant = job.plant
    robot = job.plant.robot
    judged = list[str]()
    fed_back = np.isin(plant.state.names, plan.steered or plant.state.names)
    for number, (kind, part) in enumerate(
        zip(KINDS, plant.state.groups[:3], strict=False)
    ):
        if fed_back[part][job.kinds[part] == number].any():
            judged.append(kind)
    x_end = job.target if job.target.ndim == 1 else job.target[-1]
    if "position" in judged and not pushed(plant.actuation):
        judged.remove("position")
    return {
        "kind": "Campaign",
        "names": job.dispersions.names,
        "state_names": plant.state.names,
        "state_units": plant.state.units,
        "input_names": plant.actuation.names,
        "input_units": plant.actuation.units,
        "judged": judged,
        "robot": robot.name,
        "urdf_sha256": robot.urdf_sha256,
        "duration": plan.times.steps * plan.times.dt,
        "dt": plan.times.dt,
        "notes": list(plan.times.notes),
        "engine": job.engine,
        "times": (job.steps * plan.times.dt).tolist(),
        "input_limits": np.fmax(-plan.limits.low, plan.limits.high).tolist(),
        "wheels": [name for name in robot.joint_names if name in plan.flown],
        "modes": [joint.name for joint in robot.modes],
        "x_end": x_end.tolist(),
        "replay_settings": replay_settings(job.given, job.options),
    }


def _request(job: CampaignJob, runs: int, header: Mapping[str, object]) -> str:
    """Return a digest that identifies the runs of a call.

    The digest covers the robot, the policy, the options, the first drawn values, and the versions
    of fflin and Pinocchio. The goals and the confidence level are excluded.
    """
    drawn = job.dispersions.drawn(0, min(runs, _STAGE))
    kept = {
        key: value
        for key, value in header.items()
        if key not in ("goals", "confidence")
    }
    call = repr((kept, __version__, pin.__version__))
    return content_digest(
        {"call": call, "drawn": drawn, "first": job.digest(drawn[:1])}
    )
