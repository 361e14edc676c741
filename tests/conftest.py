"""Fixtures that several test files share."""

import os

# Matrices are small and the tests run side by side: threads would only wait for one another.
# Before NumPy is loaded, and for the processes that tests start.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
import scipy.linalg  # noqa: F401 - whose OpenBLAS is another than NumPy's
from threadpoolctl import threadpool_info

import fflin
from tests.support.robots import BUNDLED


def pytest_terminal_summary(terminalreporter):
    """Say for which processor the linear algebra was made, where its last digits come from."""
    pools = threadpool_info()
    cores = sorted({pool["architecture"] for pool in pools if pool["internal_api"] == "openblas"})
    terminalreporter.write_line(f"OpenBLAS ran its kernels for {', '.join(cores)}")


@pytest.fixture(scope="session")
def robots():
    """Every bundled robot, loaded once."""
    return {name: fflin.load(name) for name in BUNDLED}
