"""C compilers of this machine, and test programs of exported laws."""

import shutil
import subprocess

import pytest

COMPILERS = [item for item in ("gcc", "clang") if shutil.which(item)]
FLAGS = [
    *("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion"),
    *("-pedantic", "-Werror", "-O1"),
]

# `CLaw` calls cc, and other tests call gcc and clang by name.
needs_compiler = pytest.mark.skipif(
    not (COMPILERS and shutil.which("cc")),
    reason="no C compiler (cc, and gcc or clang)",
)


def outcome(folder, compiler, name="controller"):
    """Compile the test program of a folder without a warning; return its exit code and output."""
    program = folder / f"{name}_{compiler}"
    sources = (folder / f"{name}.c", folder / f"{name}_test.c")
    subprocess.run(
        [compiler, *FLAGS, "-o", program, *sources, "-lm"], check=True, timeout=60
    )
    done = subprocess.run(
        [program], capture_output=True, text=True, timeout=60, check=False
    )
    return done.returncode, done.stdout
