"""Fixtures that several test files share."""

import contextlib
import getpass
import os
import signal
import sys
import tempfile
from pathlib import Path

# Matrices are small and the tests run side by side: threads would only wait for one another.
# Before NumPy is loaded, and for the processes that tests start.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# What a shell runs in the background ignores Ctrl-C, and so would all that tests start and stop.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What these packages keep stays in the checkout, and out of the home directory.
os.environ.setdefault(
    "MPLCONFIGDIR", str(Path(__file__).parents[1] / ".pytest_cache/matplotlib")
)
os.environ.setdefault(
    "DASK_CONFIG", str(Path(__file__).parents[1] / ".pytest_cache/dask")
)
os.environ.setdefault("DASK_TEMPORARY_DIRECTORY", os.environ["DASK_CONFIG"])

import pytest
import scipy.linalg  # noqa: F401 - whose OpenBLAS is another than NumPy's
from threadpoolctl import threadpool_info

import fflin
from tests.support import kernels
from tests.support.browser import chromium
from tests.support.robots import BUNDLED

pytest_plugins = ["tests.support.messages"]


def pytest_terminal_summary(terminalreporter):
    """Say for which processor the linear algebra was made, where its last digits come from."""
    pools = threadpool_info()
    cores = sorted(
        {pool["architecture"] for pool in pools if pool["internal_api"] == "openblas"}
    )
    terminalreporter.write_line(f"OpenBLAS ran its kernels for {', '.join(cores)}")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """Remove the directory above those of the tests, unless one that failed is kept in it."""
    with contextlib.suppress(OSError):
        Path(tempfile.gettempdir(), f"pytest-of-{getpass.getuser()}").rmdir()


# Tests of these kinds may start Python again.
STARTING = {"process", "browser", "docs", "fuzz"}
_started: list[str] = []


def _watch(event, arguments):
    """Record each Python that is started: as an audit hook, below whatever library does it."""
    if event == "subprocess.Popen":
        program, command = str(arguments[0]), arguments[1] or ()
        if program == sys.executable or str(next(iter(command), "")) == sys.executable:
            _started.append(" ".join(map(str, command)))


def _kinds(item):
    return {marker.name for marker in item.iter_markers()}


def pytest_configure(config):
    """Compile once, before the workers begin; watch for processes that tests start."""
    if hasattr(config, "workerinput"):
        sys.addaudithook(_watch)
    elif not config.option.collectonly and kernels.wanted(
        config.option.markexpr, config.args
    ):
        kernels.prepare()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark tests that have a skipif condition.

    .ci/run repeats them after it has installed the programs that some of them need.
    """
    for item in items:
        if item.get_closest_marker("skipif"):
            item.add_marker("conditional")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Hide numba from tests that are not marked `compiled`: what ran before changes no result."""
    if "compiled" in _kinds(item):
        return (yield)
    loaded = sys.modules.get("numba")
    sys.modules["numba"] = None
    try:
        return (yield)
    finally:
        del sys.modules["numba"]
        if loaded is not None:
            sys.modules["numba"] = loaded


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Fail a test that starts Python and is not marked so: the default command is quick."""
    _started.clear()
    result = yield
    if _started and not STARTING & _kinds(item):
        pytest.fail(
            f"starts a process, expected the mark `process`: {_started[0][:200]}"
        )
    return result


@pytest.fixture(scope="session")
def robots():
    """Every bundled robot, loaded once."""
    return {name: fflin.load(name) for name in BUNDLED}


@pytest.fixture(scope="session")
def browser():
    """One Chromium for the pages of all tests."""
    with chromium() as browser:
        yield browser


@contextlib.contextmanager
def _brief_validity():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fflin.campaign.settling._CONSTANTS", 1.0)
        patch.setattr("fflin.campaign.settling._STEP_PREDICTED", 1.0)
        patch.setattr("fflin.campaign.settling._STEP", 1.0)
        patch.setattr("fflin.campaign.settling.SETTLED", 0.2)
        yield


@pytest.fixture
def brief_validity():
    """Shorten the runs of `validity`, for a test that does not judge how accurate they are.

    The runs predict one time constant instead of three, in longer steps, and have settled at a
    fifth of the start. So a region takes a tenth of the time.
    """
    with _brief_validity():
        yield


@pytest.fixture(scope="module")
def brief_validity_in_module():
    """Shorten the runs of `validity` in all tests of a module, as `brief_validity` does."""
    with _brief_validity():
        yield
