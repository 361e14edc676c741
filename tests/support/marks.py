"""Cases of a test that only the whole run takes."""

import pytest


def exhaustive(*cases):
    """Return the cases of a parametrised test with the mark `exhaustive`."""
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)),
            marks=pytest.mark.exhaustive,
        )
        for case in cases
    ]
