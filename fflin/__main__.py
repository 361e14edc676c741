"""Run the command line, as ``fflin`` and as ``python -m fflin``."""

import gc
import signal
import sys
from pathlib import Path

from fflin.base.import_path import import_path_without, same_folder
from fflin.commands.interruption import leave, listen


def main() -> int:
    """Run the command line on the arguments of this process, and return its exit code."""
    listen()
    if not same_folder(Path(__file__).parents[1], ""):  # fflin itself is imported from there
        sys.path[:] = import_path_without("")
    gc.set_threshold(50_000)  # most of what a command makes, it keeps to its end
    try:
        from fflin.commands import cli

        code = cli.main()
    except KeyboardInterrupt as reason:
        leave(reason)
    # All is done and said.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()  # what ends with the process need not be searched for circles
    return code


if __name__ == "__main__":
    sys.exit(main())
