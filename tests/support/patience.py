"""Waiting, so long that no load of the machine makes a difference."""

import time

PATIENCE = 600.0  # [s]


def wait_until(done):
    """Wait for a condition."""
    end = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.02)
