"""Run the command line, as ``fflin`` and as ``python -m fflin``."""

import gc
import os
import sys

from fflin.base.process import import_path_without, same_folder


def main() -> int:
    """Run the command line on the arguments of this process, and return its exit code."""
    # With `python -m fflin` the working folder comes first on the path; leave it out before more
    # is imported, unless fflin itself is imported from there.
    if not same_folder(os.path.join(os.path.dirname(__file__), os.pardir), ""):
        sys.path[:] = import_path_without("")
    import signal

    from fflin.commands.interruption import leave, listen

    listen()
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
