"""Waits of the tests: they end when nothing happens, and go on while something does."""

import subprocess
import sys
from itertools import count

import pytest

from tests.support.patience import Patience, finished, finishing, wait_until

pytestmark = pytest.mark.process


class Scripted:
    """A family of processes that takes as much processor time [s] from look to look."""

    def __init__(self, step, state=False):
        self._taken, self._state = count(0.0, step), state

    def processor_time(self):
        return next(self._taken)

    def busy(self):
        return self._state


def reasons(family, looks):
    """Return what is said at looks ten seconds apart."""
    now = count(0.0, 10.0)
    patience = Patience("the moon", 600.0, 60.0, family, lambda: next(now))
    return [patience.out() for _ in range(looks)]


def test_a_busy_process_is_awaited():
    """On a processor shared by fifty a minute has a second, on one shared by more none at all."""
    assert not any(reasons(Scripted(0.2), 1000))
    assert not any(reasons(Scripted(0.0, state=True), 1000))


def test_an_idle_process_is_stopped_after_a_minute():
    message = reasons(Scripted(0.001), 8)
    assert message[:6] == [""] * 6
    assert "the moon" in message[6]


def test_an_endless_computation_is_stopped():
    message = reasons(Scripted(10.0), 62)
    assert message[:60] == [""] * 60
    assert "the moon" in message[61]


def test_a_condition_that_never_holds_is_named():
    with pytest.raises(AssertionError, match="the moon"):
        wait_until(lambda: False, "the moon", stall=0.2)


@pytest.mark.parametrize(
    ("code", "watch"),
    [
        ("import time; time.sleep(9999)", {"stall": 0.3}),
        ("while True: pass", {"limit": 0.2}),
    ],
)
def test_a_process_that_never_ends_is_killed_and_named(code, watch):
    command = [sys.executable, "-S", "-c", code]
    with pytest.raises(AssertionError, match=code.split()[0]):
        finished(command, watch=watch)


def test_reading_from_a_hanging_process_ends():
    command = [sys.executable, "-S", "-c", "import time; time.sleep(9999)"]
    with (
        pytest.raises(AssertionError, match="its first line"),
        subprocess.Popen(command, stdout=subprocess.PIPE) as process,
        finishing(process, "its first line", stall=0.3),
    ):
        assert not process.stdout.readline()


def test_a_command_in_process_agrees_with_a_subprocess():
    code = "import sys; print(input()); sys.exit('no')"
    done = finished(
        [sys.executable, "-S", "-c", code],
        input="yes\n",
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (1, "yes\n", "no\n")
