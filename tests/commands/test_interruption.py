"""Ctrl-C in real processes: one line and exit 130, at whatever instant it comes."""

import os
import signal
import subprocess
import sys
from contextlib import suppress

import pytest

from tests.support.patience import finished, in_own_session

pytestmark = pytest.mark.process

# None of these is done by the last instant, so that the end is always Ctrl-C's.
LONG = {
    "sweep": "sweep ets_vii --random 300000 --velocity joint_1=0.3 -o x.h5",
    "sweep by processes": "sweep ets_vii --random 300000 --workers 2 -o x.h5",
    "validity": "validity ets_vii --samples 30000",
    # It draws all displacements before it starts its processes, in 0.1 ms each.
    "validity by processes": "validity ets_vii --samples 30000 --jobs 2",
    "simulate": "simulate ets_vii --rpy 10 0 0 --duration 9000 -o x.npz",
    "view": "view ets_vii --no-open",
}

# Instants, told by how many modules are imported by then: from fflin's first on.
INSTANTS = (1, 40, 150, 200, 270, 400)

# Of processes of its own, as these start.
LATER = (700, 1000, 1300)


def interrupted(command, instant, folder):
    """Send Ctrl-C to a command and all its processes; return its exit code and what it said.

    The interpreter tells on stderr what it has imported, so that an instant is one of the
    command's own and not of the clock.
    """
    arguments = [sys.executable, "-X", "importtime", "-m", "fflin", *command.split()]
    message, seen = [], -(10**6)
    with in_own_session(arguments, folder, stdout=subprocess.DEVNULL) as process:
        try:
            # It ends with the last process that has it.
            for line in process.stderr:
                # A line of another process may begin before this one's, and end after it.
                default = line[max(0, line.find("fflin: ")) :]
                if default.strip() and not default.startswith("import time:"):
                    message.append(default)
                seen = 0 if line.endswith(" fflin.commands\n") else seen + 1
                if seen == instant:
                    with suppress(ProcessLookupError):
                        os.killpg(process.pid, signal.SIGINT)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    assert seen >= instant
    return process.returncode, message


@pytest.mark.compiled
@pytest.mark.process
@pytest.mark.parametrize(
    "name, instant",
    [
        *((name, instant) for name in LONG for instant in INSTANTS),
        *(("validity by processes", instant) for instant in LATER),
    ],
)
def test_it_ends_every_command_at_every_instant(name, instant, tmp_path):
    if "sweep" in name:
        pytest.importorskip("h5py")
        pytest.importorskip("numba")
    command = LONG[name]
    code, message = interrupted(command, instant, tmp_path)
    if command.startswith("view") and code == 0:  # Ctrl-C is the way to end it
        assert message[-1].endswith("(Ctrl-C ends)\n")
    else:
        assert code == 130
        assert message[-1].startswith(("fflin: stopped", "fflin: interrupted at t = "))
    assert all(line.startswith("fflin: ") for line in message), message
    assert {entry.name for entry in tmp_path.iterdir()} <= {"x.h5.part", "x.npz"}


LOSING = """
import os, signal, sys, weakref
from fflin.__main__ import leave, listen

class Thing:
    pass

def lose(_):
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(10):
        pass

def main():
    thing = Thing()
    {where}
    for _ in range(10):
        pass
    print("went on")

listen()
try:
    main()
except KeyboardInterrupt as reason:
    leave(reason)
"""


@pytest.mark.process
@pytest.mark.parametrize(
    "where",
    [
        "kept = weakref.ref(thing, lose); del thing",
        "Thing.__del__ = lose; del thing",
        "import interrupted_module",
        "import swallowing_module",
        "__import__('importlib').import_module('swallowing_module')",
    ],
)
def test_it_is_not_lost_in_callbacks_and_imports(where, tmp_path):
    send = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nfor _ in range(10): pass\n"
    (tmp_path / "interrupted_module.py").write_text(send)
    (tmp_path / "swallowing_module.py").write_text(
        "try:\n    import interrupted_module\nexcept BaseException:\n    pass\n"
    )
    (tmp_path / "program.py").write_text(LOSING.format(where=where))
    done = finished(
        [sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "fflin: stopped\n")


@pytest.mark.process
def test_where_it_is_ignored_it_stays_so():
    program = "import signal; from fflin.__main__ import listen; listen()\n"
    program += "raise SystemExit(signal.getsignal(signal.SIGINT) is not signal.SIG_IGN)"
    done = finished(
        [sys.executable, "-c", program],
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    assert done.returncode == 0
