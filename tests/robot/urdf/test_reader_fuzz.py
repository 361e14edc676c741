"""A fuzz run of the reader; FFLIN_FUZZ_COUNT and FFLIN_FUZZ_SEED change it."""

import os
import re
import sys
from pathlib import Path

import pytest

from tests.support.patience import LIMIT, finished

pytestmark = pytest.mark.fuzz


@pytest.mark.process
def test_fuzz(tmp_path):
    count = int(os.environ.get("FFLIN_FUZZ_COUNT", "10000"))
    seed = os.environ.get("FFLIN_FUZZ_SEED", "1")
    result = finished(
        # In a process of its own, for a crash must not take the tests along.
        [
            *("sh", "-c", 'ulimit -v 4194304; exec "$@"', "sh"),
            *(
                sys.executable,
                "-m",
                "tests.support.fuzz_reader",
                str(count),
                seed,
                str(tmp_path),
            ),
        ],
        capture_output=True,
        text=True,
        errors="replace",
        watch={"limit": LIMIT + count},
        cwd=Path(__file__).parents[3],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
    )
    last = tmp_path / "last.urdf"
    assert (result.returncode, result.stderr) == (0, ""), f"on {last}: {result.stderr}"
    counts = re.fullmatch(r"accepted (\d+), refused (\d+)\n", result.stdout)
    assert counts, result.stdout  # nothing else was printed
    accepted, refused = map(int, counts.groups())
    assert accepted + refused == count
    # Enough of both, or the mutations would not be near to the border.
    assert min(accepted, refused) > 0.01 * count
