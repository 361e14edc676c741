"""Messages and reports are coloured on terminals only, and as NO_COLOR and FORCE_COLOR say."""

import contextlib
import io
import os
import re
import subprocess
import sys

import pytest

from fflin.base import terminal
from tests.support.commands import run
from tests.support.patience import finishing

VARIABLES = ("NO_COLOR", "FORCE_COLOR", "TERM")


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def environment(monkeypatch):
    """A function that sets the variables that control colours; all others of them are unset."""

    def given(**variables):
        for name in VARIABLES:
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)

    given(TERM="xterm")
    return given


@pytest.mark.parametrize(
    ("variables", "on_terminal", "in_file"),
    [
        ({"TERM": "xterm"}, True, False),
        ({}, True, False),
        ({"TERM": "dumb"}, False, False),
        ({"NO_COLOR": "1", "TERM": "xterm"}, False, False),
        ({"NO_COLOR": "", "TERM": "xterm"}, True, False),
        ({"FORCE_COLOR": "1", "TERM": "dumb"}, True, True),
        ({"FORCE_COLOR": "1", "NO_COLOR": "1"}, False, False),
    ],
)
def test_colours_follow_the_terminal_and_the_environment(
    environment, variables, on_terminal, in_file
):
    environment(**variables)
    assert terminal.shows_colors(Terminal()) == on_terminal
    assert terminal.shows_colors(io.StringIO()) == in_file
    assert not terminal.shows_colors(None)


def test_the_labels_of_messages_are_coloured(environment, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    error = terminal.color_message("fflin: error: no robot named 'error'")
    assert error == "fflin: \x1b[1;31merror\x1b[0m: no robot named 'error'"
    warning = terminal.color_message("fflin: warning: fflin: error: twice")
    assert warning == "fflin: \x1b[1;33mwarning\x1b[0m: fflin: error: twice"
    assert terminal.color_message("fflin: stopped") == "fflin: stopped"


def test_verdicts_are_coloured_and_zeros_are_dimmed(environment, monkeypatch):
    monkeypatch.setattr(sys, "stdout", Terminal())
    for text, colored in {
        "A and B are verified: 1e-9": "A and B are \x1b[1;32mverified\x1b[0m: 1e-9",
        "A is not\n  verified": "A is \x1b[1;31mnot\n  verified\x1b[0m",
        "3 comparisons FAILED": "3 comparisons \x1b[1;31mFAILED\x1b[0m",
        "wrote verified.npz": "wrote verified.npz",
        "unverified": "unverified",
        "x  .  1\ny  2  .": "x  \x1b[2m.\x1b[0m  1\ny  2  \x1b[2m.\x1b[0m",
        "An end.  A start": "An end.  A start",
    }.items():
        assert terminal.color_report(text) == colored
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    assert terminal.color_report("verified  .") == "verified  ."


def on_terminal(*arguments, **variables):
    """Run fflin with a pseudo-terminal as stdout and stderr; return what it shows."""
    import pty

    ours, theirs = pty.openpty()
    kept = {name: x for name, x in os.environ.items() if name not in VARIABLES}
    command = [sys.executable, "-m", "fflin", *arguments]
    streams = {"stdin": subprocess.DEVNULL, "stdout": theirs, "stderr": theirs}
    with (
        subprocess.Popen(command, env={**kept, **variables}, **streams) as process,
        finishing(process),
    ):
        os.close(theirs)
        shown = b""
        with contextlib.suppress(OSError):  # how Linux reports the end
            while more := os.read(ours, 4096):
                shown += more
    os.close(ours)
    return shown.decode()


@pytest.mark.process
@pytest.mark.skipif(os.name != "posix", reason="no pseudo-terminal")
def test_a_terminal_shows_colours_and_a_pipe_does_not(tmp_path):
    shown = on_terminal("check", "cubesat", TERM="xterm")
    assert re.search(r"\x1b\[1;32mverified\x1b\[0m", shown)
    assert "\x1b[1;31merror\x1b[0m: no robot" in on_terminal("info", "x1", TERM="xterm")
    assert "\x1b[2m.\x1b[0m" in on_terminal("linearize", "cubesat", TERM="xterm")
    path = tmp_path / "model.csv"
    on_terminal("linearize", "cubesat", "-o", str(path), TERM="xterm")
    tables = [table.read_text() for table in tmp_path.glob("*.csv")]
    assert len(tables) > 1 and "\x1b" not in "".join(tables)
    for variables in ({"TERM": "dumb"}, {"TERM": "xterm", "NO_COLOR": "1"}):
        assert "\x1b" not in on_terminal("check", "cubesat", **variables)
    assert "\x1b" not in on_terminal("check", "cubesat", "--json", TERM="xterm")
    code, out, _ = run("check", "cubesat")
    assert code == 0 and "verified" in out and "\x1b" not in out
