"""Many runs of a closed loop with what is uncertain drawn at random."""

from __future__ import annotations

import inspect
import json
import math
import pickle
from collections.abc import Mapping
from concurrent.futures import Executor
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, unknown
from fflin.base.record import content_digest
from fflin.base.validation import Array, share, whole
from fflin.base.version import __version__
from fflin.batch.run import Progress, check_workers, failure, run_chunks
from fflin.batch.store import FileStore, MemoryStore, check_room, output_path
from fflin.batch.workers import OwnWorkers
from fflin.campaign.campaign import NOT_RUN, Campaign
from fflin.campaign.dispersions import Draws
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
    policy : policy, GainSchedule or None
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
        - ``INPUT.misalignment`` [rad]: the direction of a thruster, the axis of a wheel or one of
          tau_b or F_b is turned about two axes across it, by an angle drawn for each;
        - ``NAME.sensor``: added to a state that a `StateFeedback` reads, or to an output that an
          `OutputFeedback` or `TrajectoryOutputFeedback` measures; ``NAME.noise``: white noise
          added to it at each sample, a number its standard deviation, and of another spread each
          run has one of its own;
        - ``delay`` [s]: added to that of `simulate`, to the next whole step and 0 or more;
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
    width, confidence = share("width", width), share("confidence", confidence)
    check_workers(executor, workers, threads, chunk, progress)
    path = None if out is None else output_path(out)
    if path is not None and path.suffix != ".h5":
        raise InputError(f"{path}: a campaign grows in a file .h5; Campaign.save writes .npz")
    job = CampaignJob(robot, policy, dispersions, seed, "", {"duration": duration, **options})
    shapes = {"drawn": (len(job.dispersions.names),), **job.shapes}
    check_room(runs, 8 * runs * sum(map(math.prod, shapes.values())), path, "runs")
    if executor or workers:
        _require_sendable(job)
    job.choose(engine, runs)
    header = {**_header(job), "seed": seed, "asked": runs}
    if until is not None:  # it is refused before anything is done
        if not isinstance(until, str):
            raise InputError(f"until is a {type(until).__name__}, expected 'attitude < 1 deg'")
        nothing = MemoryStore(1, 1, shapes).arrays
        Campaign.of(nothing, header).met(until)
    job.dispersions.require_possible(runs)
    threads = threads or available_cores()
    size = _chunk(runs, chunk, workers or threads, until is not None)
    store: Any = MemoryStore(runs, size, shapes)
    if path is not None:
        texts = {"header": json.dumps(header), "constant": "[]"}
        store = FileStore(path, _request(job, runs), runs, size, shapes, {}, texts)
    with closing(store), OwnWorkers(int(workers)) if workers else nullcontext(executor) as others:
        enough = partial(_enough, store, header, until, width, confidence)
        how: Any = {"executor": others, "progress": progress}
        how["threads"] = threads if job.engine == "compiled" else 1
        done = runs if until is None else min(_STAGE, runs)
        while not (failed := run_chunks(job, job.dispersions.rows, store, upto=done, **how)):
            if done == runs or enough(done):
                break
            done = min(runs, math.ceil(_GROWTH * done / _STAGE) * _STAGE)
        if failed:

            def others_of(kept: Array) -> Campaign:
                return Campaign.of({k: x[kept] for k, x in store.arrays.items()}, header, job)

            raise failure(failed, store, "runs", others_of)
        if path is None:
            return Campaign.of(store.read(done), header, job)
        for start in range(done, runs, store.chunk):
            stop = min(start + store.chunk, runs)
            none = {key: np.full((stop - start, *of), NOT_RUN) for key, of in shapes.items()}
            store.write(start, stop, none)
        store.complete()
    return replace(Campaign.load(path), _job=job)


def _require_sendable(job: CampaignJob) -> None:
    try:
        pickle.dumps(job)
    except Exception as error:  # what is sent has its own
        raise InputError(
            f"robot, policy or spreads cannot be sent to workers ({error}); define what they are "
            "made of at the top of a module, or leave workers and executor out"
        ) from None


def _enough(
    store: Any, header: Any, until: Any, width: float, confidence: float, done: int
) -> bool:
    """Whether the interval of what is asked for is narrow enough after so many runs."""
    found = Campaign.of(store.read(done), header).fraction(until, confidence=confidence)
    return found.high - found.low <= width


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
    wheels = {f"q_m.{name}" for name in plant.robot.wheels}
    steered = {name.partition(".")[0] for name in {*(plan.steered or plant.state.names)} - wheels}
    groups = zip(KINDS, ("q_b", "r_b", "q_m"), strict=False)
    return {
        "kind": "Campaign",
        "names": list(job.dispersions.names),
        "state_names": list(plant.state.names),
        "state_units": list(plant.state.units),
        "input_names": list(plant.actuation.names),
        "input_units": list(plant.actuation.units),
        "judged": [kind for kind, group in groups if group in steered],
        "robot": plant.robot.name,
        "urdf_sha256": plant.robot.urdf_sha256,
        "duration": plan.times.steps * plan.times.dt,
        "dt": plan.times.dt,
        "engine": job.engine,
    }


def _request(job: CampaignJob, runs: int) -> str:
    """Return a hash of what the result depends on, of which the first run tells most."""
    draws = job.dispersions.rows(0, min(runs, _STAGE))
    first = job.run(Draws(draws.drawn[:1], draws.run[:1]), 0).arrays
    told = repr((runs, job.engine, job.plant.robot.urdf_sha256, __version__, pin.__version__))
    return content_digest({"told": told, "drawn": draws.drawn, **first})
