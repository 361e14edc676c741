"""The command line, in this process or, as a user runs it, in one of its own."""

import contextlib
import io
import os
import sys
import warnings
from unittest import mock

from fflin.commands import cli
from tests.support.messages import hear_lines
from tests.support.patience import finished


def run(*arguments, cwd=None, **environment):
    """Call fflin's command line; return exit code, stdout, and stderr by `without_warnings`.

    In this process: the same code from the arguments to the exit code, without the half second
    that an interpreter and its packages take to start.
    """
    code, message, complained = _called(arguments, cwd, environment)
    return code, message, without_warnings(hear_lines(complained))


def warned(*arguments, cwd=None):
    """Call a command that succeeds; return its warnings."""
    code, _, complained = _called(arguments, cwd, {})
    hear_lines(complained)
    assert code == 0, complained
    start = "fflin: warning: "
    return {
        x.removeprefix(start) for x in complained.splitlines() if x.startswith(start)
    }


def _called(arguments, cwd, environment):
    out, err = (
        io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2)
    )
    with (
        mock.patch.dict(os.environ, environment),
        _inside(cwd),
        warnings.catch_warnings(),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        warnings.resetwarnings()
        try:
            code = cli.main([*map(str, arguments)])
        except SystemExit as ended:
            code = ended.code or 0
    message, complained = (item.buffer.getvalue().decode() for item in (out, err))
    return code, message, complained


def run_in_process(*arguments, cwd=None, **environment):
    """Run fflin in a process of its own; return the same as `run`."""
    done = finished(
        [sys.executable, "-m", "fflin", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, **environment},
    )
    return done.returncode, done.stdout, without_warnings(hear_lines(done.stderr))


def without_warnings(err):
    """Return stderr without warnings and estimated times, which depend on the machine's load."""
    left_out = "fflin: warning: ", "fflin: about "
    return "".join(x for x in err.splitlines(True) if not x.startswith(left_out))


def refused(*arguments, cwd=None):
    """Run what must be refused: exit 2, nothing on stdout, one line on stderr, which it returns."""
    code, out, err = run(*arguments, cwd=cwd)
    assert code == 2 and not out
    assert (
        err.startswith("fflin: error: ") and err.count("\n") == 1 and err.endswith("\n")
    )
    return err


@contextlib.contextmanager
def _inside(folder):
    """Work in a folder, and come back."""
    before = os.getcwd()
    os.chdir(folder or before)
    try:
        yield
    finally:
        os.chdir(before)
