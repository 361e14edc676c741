"""Fixtures that several test files share."""

import contextlib
import getpass
import os
import signal
import tempfile
from pathlib import Path

# Matrices are small and the tests run side by side: threads would only wait for one another.
# Before NumPy is loaded, and for the processes that tests start.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# What a shell runs in the background ignores Ctrl-C, and so would all that tests start and stop.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What these packages keep stays in the checkout, and out of the home directory.
os.environ.setdefault("MPLCONFIGDIR", str(Path(__file__).parents[1] / ".pytest_cache/matplotlib"))
os.environ.setdefault("DASK_CONFIG", str(Path(__file__).parents[1] / ".pytest_cache/dask"))
os.environ.setdefault("DASK_TEMPORARY_DIRECTORY", os.environ["DASK_CONFIG"])

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


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """Remove the directory above those of the tests, unless one that failed is kept in it."""
    with contextlib.suppress(OSError):
        Path(tempfile.gettempdir(), f"pytest-of-{getpass.getuser()}").rmdir()


@pytest.fixture(scope="session")
def robots():
    """Every bundled robot, loaded once."""
    return {name: fflin.load(name) for name in BUNDLED}
