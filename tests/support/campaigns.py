"""Campaigns that several test files share."""

import numpy as np
import pytest

from fflin.batch.run import Execution
from fflin.campaign.runs import CampaignJob, completed


def flown(job, drawn):
    """The arrays of runs with the drawn values, one chunk after the other."""
    return completed(job, np.asarray(drawn), Execution(threads=1))


def both(robot, policy, given, runs=3, tolerance=1e-10, **options):
    """Hold the runs of eight lanes against those in Python; return those of the lanes."""
    pytest.importorskip("numba")
    options = {"duration": 3.0, "dt": 0.01} | options
    jobs = [
        CampaignJob(robot, policy, given, 5, name, options)
        for name in ("python", "compiled")
    ]
    drawn = jobs[0].dispersions.drawn(0, runs)
    python, lanes = (flown(job, drawn) for job in jobs)
    for name in jobs[0].shapes:
        size = np.maximum(
            1.0, np.where(np.isfinite(python[name]), np.abs(python[name]), 1.0)
        )
        assert np.array_equal(np.isinf(python[name]), np.isinf(lanes[name])), name
        with np.errstate(invalid="ignore"):
            apart = np.nan_to_num(lanes[name] - python[name], nan=0.0)
        assert (np.abs(apart) <= tolerance * size).all(), name
    return lanes
