"""The hot paths take no more instructions than they did, beside the same written by hand."""

import platform
import shutil
import sys

import pytest

from benchmarks import c_step
from benchmarks.instructions import BASELINE, TOLERANCE, ratios
from tests.support.c_code import needs_compiler

pytestmark = [pytest.mark.process, pytest.mark.exhaustive]


@pytest.mark.skipif(
    shutil.which("valgrind") is None, reason="valgrind is not installed"
)
@pytest.mark.skipif(
    sys.implementation.name != "cpython" or platform.machine() != "x86_64",
    reason="the baseline is of CPython on x86-64",
)
def test_hot_paths_take_no_more_instructions():
    result = ratios()
    assert result.keys() == BASELINE.keys()
    worse = {
        path: f"{ratio:.2f}, was {BASELINE[path]:.2f}"
        for path, ratio in result.items()
        if ratio > BASELINE[path] * (1.0 + TOLERANCE)
    }
    assert not worse, f"more instructions: {worse}; see benchmarks/instructions.py"


@needs_compiler
@pytest.mark.skipif(
    shutil.which("valgrind") is None, reason="valgrind is not installed"
)
def test_a_step_of_an_exported_law_costs_at_most_half_more_than_a_product(tmp_path):
    ratio = c_step.instruction_ratio(c_step.program(tmp_path))
    # A step contains the product.
    assert 1.0 <= ratio <= 1.5
