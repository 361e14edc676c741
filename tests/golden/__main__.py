"""Compare fflin with the golden record, or make the record anew."""

import argparse
import sys
from importlib.util import find_spec

import numpy as np

from tests.golden.record import ENGINES, PATH, cases, differences, kept, record


def main():
    """Return the exit status: 1 where something differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--check", action="store_true", help="compare both engines with the record"
    )
    what.add_argument(
        "--write", action="store_true", help="make the record anew, in Python"
    )
    parser.add_argument("--engine", choices=ENGINES, help="compare this one alone")
    options = parser.parse_args()
    if options.write:
        np.savez_compressed(PATH, **record())
        print(f"{PATH}: {PATH.stat().st_size / 1024:.0f} kB")
        return 0
    golden, message = kept(), []
    engines = ENGINES if find_spec("numba") else ENGINES[:1]
    for engine in [options.engine] if options.engine else engines:
        for case in cases():
            message += [
                f"{engine}: {line}" for line in differences(case, engine, golden)
            ]
    print("\n".join(message) or "as in the record")
    return int(bool(message))


sys.exit(main())
