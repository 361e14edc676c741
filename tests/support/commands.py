"""The command line as a user runs it: in a process of its own."""

import os
import subprocess
import sys

from tests.support.patience import PATIENCE


def run(*arguments, cwd=None, **environment):
    """Run fflin; return exit code, stdout, and stderr without its warnings, a line each."""
    done = subprocess.run(
        [sys.executable, "-m", "fflin", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, **environment},
        timeout=PATIENCE,
        check=False,
    )
    return done.returncode, done.stdout, without_warnings(done.stderr)


def without_warnings(err):
    return "".join(x for x in err.splitlines(True) if not x.startswith("fflin: warning: "))


def refused(*arguments, cwd=None):
    """Run what must be refused: exit 2, nothing on stdout, one line on stderr, which it returns."""
    code, out, err = run(*arguments, cwd=cwd)
    assert code == 2 and not out
    assert err.startswith("fflin: error: ") and err.count("\n") == 1 and err.endswith("\n")
    return err
