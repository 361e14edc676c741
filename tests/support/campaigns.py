"""Campaigns that several test files share."""

import numpy as np
import pytest

from fflin.campaign.runs import CampaignJob


def both(robot, policy, given, runs=3, tolerance=1e-10, **options):
    """Hold the runs of eight lanes against those in Python; return those of the lanes."""
    pytest.importorskip("numba")
    options = {"duration": 3.0, "dt": 0.01} | options
    jobs = [CampaignJob(robot, policy, given, 5, name, options) for name in ("python", "compiled")]
    rows = jobs[0].dispersions.rows(0, runs)
    python, lanes = (job.run(rows, 0).arrays for job in jobs)
    for name in jobs[0].shapes:
        size = np.maximum(1.0, np.where(np.isfinite(python[name]), np.abs(python[name]), 1.0))
        assert np.array_equal(np.isinf(python[name]), np.isinf(lanes[name])), name
        with np.errstate(invalid="ignore"):
            apart = np.nan_to_num(lanes[name] - python[name], nan=0.0)
        assert (np.abs(apart) <= tolerance * size).all(), name
    return lanes
