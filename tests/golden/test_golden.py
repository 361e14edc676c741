"""The figures of the golden record, made anew by either engine."""

import numpy as np
import pytest

from tests.golden.record import cases, differences, figures, kept
from tests.support.robots import mostly

# Not without numba, and not by engine: models are made in Python.
# Each policy has a quick case with another robot.
LONG = [
    case for case in cases() if case.startswith("policies") and case.endswith("ets_vii")
]
LONG += ["policies controlled cubesat", "policies controlled_in_samples cubesat"]
LONG += ["policies shared cubesat", "campaign", "funnel", "validity"]
QUICK = [case for case in cases() if case not in LONG]
COMPILED = [case for case in cases() if not case.startswith("models")]


@pytest.fixture(scope="module")
def golden():
    """The committed record."""
    return kept()


@pytest.mark.parametrize("case", mostly(cases(), *QUICK))
def test_python_gives_the_figures_of_the_record(golden, case):
    assert not differences(case, "python", golden)


@pytest.mark.compiled
@pytest.mark.parametrize("case", COMPILED)
def test_machine_code_gives_the_figures_of_the_record(golden, case):
    pytest.importorskip("numba")
    assert not differences(case, "compiled", golden)


def test_the_golden_record_detects_changes(golden):
    case = "policies state planar_detumble"
    result = figures(case, "python")
    for key, change in (("q", 1.0 + 1e-11), ("rows", 2), ("stopped", None)):
        value = np.asarray("diverged") if change is None else result[key] * change
        assert len(differences(case, "python", golden | {f"{case}/{key}": value})) == 1
    short = {key: value for key, value in golden.items() if key != f"{case}/u"}
    assert len(differences(case, "python", short)) == 1


def test_every_policy_meets_its_limits_and_runs_end_in_all_ways(golden):
    peaks = [value.max() for key, value in golden.items() if key.endswith("largest u")]
    assert len(peaks) > 20
    assert all(np.log2(peak) % 1.0 == 0.0 or peak in (0.2, 0.3) for peak in peaks)
    assert {0, 3} <= set(golden["funnel/outcomes"].ravel().tolist())
    assert golden["validity/outcomes"].tolist().count("settled") == 8
    assert 0 < golden["campaign/met"].sum() < 64
    assert golden["stops/diverged stopped"].item().startswith("diverged")
    assert golden["stops/left stopped"].item().startswith("left the chart")
