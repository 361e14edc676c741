"""Many runs of a closed loop with what is uncertain drawn at random."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Mapping
from concurrent.futures import Executor
from contextlib import closing, nullcontext
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, unknown
from fflin.base.record import content_digest
from fflin.base.validation import number, whole
from fflin.base.version import __version__
from fflin.batch.run import Progress, failure, run_chunks
from fflin.batch.store import FileStore, MemoryStore, check_room, output_path
from fflin.batch.workers import OwnWorkers
from fflin.campaign.campaign import NOT_RUN, Campaign
from fflin.campaign.runs import CampaignJob
from fflin.campaign.tally import KINDS
from fflin.kernel.compiled import available_cores
from fflin.kernel.tree import LANES
from fflin.robot.robot import Robot
from fflin.simulation.simulate import planned

# Runs in the largest chunk, and after which it is first looked whether they are enough: chunks are
# parts of it, so that the number of runs does not depend on them.
_STAGE = 256
_GROWTH = 1.25

_OPTIONS = {*list(inspect.signature(planned).parameters)[2:]} - {
    *("duration", "events", "callback", "linear", "every", "progress")
}


def monte_carlo(
    robot: Robot,
    policy: Any,
    dispersions: Mapping[str, Any],
    *,
    runs: int,
    duration: float | None = None,
    seed: int = 0,
    until: str | None = None,
    width: float = 0.02,
    confidence: float = 0.95,
    executor: Executor | None = None,
    workers: int | None = None,
    threads: int | None = None,
    chunk: int | None = None,
    progress: Progress | None = None,
    out: str | Path | None = None,
    engine: str | None = None,
    **options: Any,
) -> Campaign:
    r"""Simulate a robot under a policy many times, with what is uncertain drawn at random.

    Each run is one of `simulate`. With numba the compiled loop does eight at a time. What is kept
    of a run does not depend on its duration, and any of them can be flown again.

    Parameters
    ----------
    robot : Robot
    policy : callable, StateFeedback, OutputFeedback, TrajectoryFeedback, GainSchedule or None
        As of `simulate`.
    dispersions : mapping
        {name, group or pattern: spread}. A name is one of

        - a state, ``q_b``, ``r_b.x``, ``q_m.*``, ``omega_b``: added to the start;
        - ``BODY.mass``, ``BODY.com``, ``BODY.inertia`` of ``base`` or the body of a joint, relative
          as in `Robot.perturbed`: the mass is multiplied by 1 + d and the inertia with it, each
          second moment per mass along the axes of its frame by 1 + d, and the centre of mass is
          shifted by d times the radius of gyration. The pseudo-inertia stays positive;
        - ``INPUT.gain``, relative, and ``INPUT.bias`` [N m|N]: (1 + d) u + b acts of a command u;
          ``INPUT.fails`` [s]: nothing acts of it from that time on;
        - ``NAME.sensor``: added to a state that a `StateFeedback` reads, or to an output that an
          `OutputFeedback` measures;
        - ``JOINT.stiffness`` and ``JOINT.damping``, relative.

        A spread is a number, the standard deviation of a normal distribution about 0; a tuple
        (least, largest), of a uniform one; a list of values, each as likely; or a frozen
        distribution of scipy.stats.
    runs : int
    duration : float, optional
        [s]; by default that of the trajectory that is followed.
    seed : int
        The same seed draws the same, whatever the number of runs, workers and chunks, and whatever
        else is dispersed.
    until : str, optional
        A condition as `Campaign.fraction` takes it, ``"attitude < 1 deg"``: no more runs are made
        once the interval of its share is no wider than `width`, which is looked at after 256 runs
        and each time there are a quarter more.
    width, confidence : float
        Of that interval.
    executor, workers, threads, progress : optional
        As of `sweep`; an executor's workers import the modules of the policy.
    chunk : int, optional
        Runs in a chunk, a multiple of 8; with `until` a part of 256.
    out : str or Path, optional
        .h5 file to write. It grows as NAME.part; the same call made again after a crash goes on
        from the chunks that are there and intact.
    engine : {"python", "compiled"}, optional
        As of `simulate`.
    **options
        Of `simulate`: x0, q0, v0, dt, method, project, sample, delay, limits, disturbance, target,
        frame, reference.

    Returns
    -------
    Campaign
        In the order of the runs. Where `out` is given, it is read from it as it is used.

    Raises
    ------
    InputError
        If a size or value is wrong, or a draw makes no robot, which is named.
    UnknownNameError
        If there is nothing of a name.
    SweepError
        If a run cannot be done or a worker dies again and again; the chunk is named.
    FileError, MissingPackageError
        If the file cannot be written.

    References
    ----------
    P. M. Wensing, S. Kim and J.-J. E. Slotine, Linear matrix inequalities for physically-consistent
    inertial parameter identification, IEEE Robotics and Automation Letters 3(1), 2018.
    """
    for name in options:
        if name not in _OPTIONS:
            raise unknown("option of monte_carlo", name, sorted(_OPTIONS))
    runs, seed = whole("runs", runs, 1), whole("seed", seed, 0)
    width, confidence = (
        number(name, value) for name, value in (("width", width), ("confidence", confidence))
    )
    for name, value in (("width", width), ("confidence", confidence)):
        if not 0.0 < value < 1.0:
            raise InputError(f"{name} is {value:g}, expected a share between 0 and 1")
    if executor is not None and workers is not None:
        raise InputError("executor and workers are both given; give either")
    if executor is not None and not hasattr(executor, "submit"):
        raise InputError(
            f"executor is a {type(executor).__name__}, expected a concurrent.futures.Executor"
        )
    for name, count in (("workers", workers), ("threads", threads), ("chunk", chunk)):
        if count is not None:
            whole(name, count, 1)
    if progress is not None and not callable(progress):
        raise InputError(f"progress is {progress!r}, expected a function progress(done, total)")
    path = None if out is None else output_path(out)
    if path is not None and path.suffix != ".h5":
        raise InputError(f"{path}: a campaign grows in a file .h5; Campaign.save writes .npz")
    job = CampaignJob(robot, policy, dispersions, seed, "", {"duration": duration, **options})
    shapes = {"drawn": (len(job.dispersions.names),), **job.shapes}
    check_room(runs, 8 * runs * sum(map(math.prod, shapes.values())), path)
    job.choose(engine, runs)
    job.require_possible(runs)
    threads = threads or available_cores()
    size = _chunk(runs, chunk, workers or threads, until is not None)
    header = {**_header(job), "seed": seed, "asked": runs}
    if until is not None:
        _campaign(MemoryStore(1, 1, shapes).arrays, header, None).met(until)  # refuses what is none
    store: FileStore | MemoryStore = MemoryStore(runs, size, shapes)
    if path is not None:
        texts = {"header": json.dumps(header), "constant": "[]"}
        store = FileStore(path, _request(job, runs, until is None), runs, size, shapes, {}, texts)
    with closing(store), OwnWorkers(int(workers)) if workers else nullcontext(executor) as others:
        if others is None and job.engine == "python":
            threads = 1
        done = runs if until is None else min(_STAGE, runs)
        while True:
            failed = run_chunks(
                *(job, job.dispersions.rows, store),
                executor=others,
                threads=threads,
                progress=progress,
                upto=done,
            )
            if failed:
                made = store.read(runs) if path is None else {}
                raise failure(
                    failed,
                    store,
                    "runs",
                    lambda kept: _campaign({k: x[kept] for k, x in made.items()}, header, job),
                )
            if done == runs or until is None:
                break
            found = _campaign(store.read(done), header, None)
            share = found.fraction(until, confidence=confidence)
            if share.high - share.low <= width:
                break
            done = min(runs, math.ceil(_GROWTH * done / _STAGE) * _STAGE)
        if path is None:
            return _campaign(store.read(done), header, job)
        for start in range(done, runs, store.chunk):
            stop = min(start + store.chunk, runs)
            store.write(
                start, stop, {k: np.full((stop - start, *of), NOT_RUN) for k, of in shapes.items()}
            )
        store.complete()
    campaign = Campaign.load(path)
    return _campaign({k: getattr(campaign, k) for k in shapes}, header, job)


def _campaign(arrays: Any, header: Any, job: CampaignJob | None) -> Campaign:
    return Campaign.of(arrays, header, job)


def _chunk(runs: int, given: int | None, workers: int, staged: bool) -> int:
    """Return how many runs a chunk has, so that all workers have several."""
    if given is None:
        shared = min(_STAGE, runs) if staged else runs
        size = _STAGE
        while size > LANES and size * 4 * workers > shared:
            size //= 2
        return size
    size = -(-given // LANES) * LANES
    if staged and _STAGE % size:
        raise InputError(f"chunk is {given}, expected a part of {_STAGE} with until, such as 32")
    return size


def _header(job: CampaignJob) -> dict[str, Any]:
    """Return what a campaign has beside its arrays."""
    plan, plant = job.plan, job.plant
    steered = set(plan.steered or plant.state.names)
    groups = dict(zip(KINDS, ("q_b", "r_b", "q_m"), strict=False))
    wheels = {f"q_m.{name}" for name in plant.robot.wheels}
    judged = [
        kind
        for kind, group in groups.items()
        if any(name.startswith(f"{group}.") for name in steered - wheels)
    ]
    return {
        "kind": "Campaign",
        "names": job.dispersions.names,
        "state_names": plant.state.names,
        "state_units": plant.state.units,
        "input_names": plant.actuation.names,
        "input_units": plant.actuation.units,
        "judged": judged,
        "robot": plant.robot.name,
        "urdf_sha256": plant.robot.urdf_sha256,
        "duration": plan.times.steps * plan.times.dt,
        "dt": plan.times.dt,
        "engine": job.engine,
    }


def _request(job: CampaignJob, runs: int, all_of_them: bool) -> str:
    """Return a hash of what the result depends on, as far as it can be told."""
    plan, robot = job.plan, job.plant.robot
    masses = [inertia.toDynamicParameters() for inertia in robot.model.inertias]
    told = [robot.urdf_sha256, robot.inputs, dict(robot.stiffness), dict(robot.damping)]
    told += [robot.gravity, plan.times, plan.known, plan.method.__name__, plan.project, runs]
    told += [job.engine, all_of_them, type(plan.policy).__name__, __version__, pin.__version__]
    arrays = {
        "masses": np.concatenate(masses),
        "start": np.concatenate((plan.q, plan.v)),
        "limits": np.concatenate((plan.limits.low, plan.limits.high)),
        # These tell seed and dispersions too.
        "drawn": job.dispersions.rows(0, min(runs, 1024)).drawn,
    }
    for at, values in enumerate(_figures(plan.policy)):
        arrays[f"policy {at}"] = values
    return content_digest({"told": repr(told), **arrays})


def _figures(policy: Any) -> list[Any]:
    """Return the arrays of a policy and of what it is made of."""
    found, left, seen = [], [policy], set[int]()
    while left:
        each = left.pop()
        if isinstance(each, np.ndarray) and each.dtype.kind in "fiu":
            found.append(each)
        elif is_dataclass(each) and not isinstance(each, Robot) and id(each) not in seen:
            seen.add(id(each))
            left += [getattr(each, item.name) for item in fields(each)]
    return found
