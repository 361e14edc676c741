"""Commands of fflin in processes of limited time and memory, forked from one that has imported it.

`python -m tests.support.forked` reads a line of JSON for each command, and answers with its exit
code.
"""

import json
import os
import resource
import runpy
import subprocess
import sys
from contextlib import contextmanager

from tests.support.patience import finishing


@contextmanager
def forking(**environment):
    """Start the process that forks; yield a function that runs a command and returns its code."""
    with subprocess.Popen(
        [sys.executable, "-m", "tests.support.forked"],
        env=os.environ | environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as server:

        def run(arguments, folder, out, err, limits):
            """Run a command in a folder, its output into files; limits are in s and bytes."""
            job = [list(map(str, item)) for item in (arguments, (folder, out, err))]
            with finishing(server, f"fflin {' '.join(job[0])}"):
                print(json.dumps([*job, limits]), file=server.stdin, flush=True)
                answer = server.stdout.readline()
            return int(answer)

        yield run
        server.stdin.close()


def _serve():
    import fflin
    from fflin.commands.cli import main

    sys.argv[1:] = ["check", "cubesat"]
    with open(os.devnull, "w") as nothing:
        kept, sys.stdout = sys.stdout, nothing
        assert fflin and main(["check", "cubesat"]) == 0  # imports what commands use
        sys.stdout = kept
    for line in sys.stdin:
        arguments, (folder, *files), (seconds, size) = json.loads(line)
        if not (child := os.fork()):
            for number, name in enumerate(files, start=1):
                os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT), number)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.chdir(folder)
            resource.setrlimit(resource.RLIMIT_AS, (size, size))
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
            sys.argv[1:] = arguments
            runpy.run_module("fflin", run_name="__main__")
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(code, flush=True)


if __name__ == "__main__":
    _serve()
