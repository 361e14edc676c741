"""The command: ``python -m benchmarks [CASE ...] [--readme]``."""

import argparse
import importlib
import logging
import os
import sys
import time
import warnings

from benchmarks import tables
from benchmarks.cases import ORDER

COMMAND = "python -m benchmarks --readme"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(ORDER))
    parser.add_argument(
        "--readme",
        action="store_true",
        help="run all, write results.md and the README's tables",
    )
    arguments = parser.parse_args()
    wrong = [case for case in arguments.cases if case not in ORDER]
    if wrong or (arguments.cases and arguments.readme):
        parser.error(
            f"CASE is one of {', '.join(ORDER)}; --readme takes none, it runs all"
        )
    # Before a case loads BLAS or OpenMP: one thread, for all alike.
    os.environ |= {
        f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")
    }
    # of robots whose inertias are not rigid, told once is enough
    warnings.simplefilter("ignore")
    logging.getLogger("drake").setLevel(logging.ERROR)
    made = []
    for case in arguments.cases or ORDER:
        start = time.perf_counter()
        table = importlib.import_module(f"benchmarks.cases.{case}").run()
        print(table.markdown())
        print(f"{case}: {time.perf_counter() - start:.0f} s", file=sys.stderr)
        made.append(table)
    if arguments.readme:
        tables.RESULTS.write_text(tables.document(made, COMMAND), encoding="utf-8")
        tables.insert_in_readme(made, COMMAND)
    else:
        print(tables.machine())


if __name__ == "__main__":
    main()
