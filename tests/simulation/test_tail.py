"""Whether an error remains, grows or decays at the end of a run."""

import numpy as np
import pytest

from fflin.simulation.report import _tail

T = np.linspace(0.0, 1.0, 401)


def second_order(t, damping, frequency):
    """Return the free response of a damped oscillator that starts at 1 at rest."""
    damped = frequency * np.sqrt(1.0 - damping**2)
    phase = damped * t
    decay = np.exp(-damping * frequency * t)
    return decay * (np.cos(phase) + damping * frequency / damped * np.sin(phase))


@pytest.mark.parametrize("part", [0.8, 0.85, 0.9, 0.95])
def test_an_overshoot_at_the_end_of_a_run_is_no_drift(part):
    # The response crosses zero at this part of the run, and then overshoots by 4.3 %.
    crossing = (np.pi - np.arccos(np.sqrt(0.5))) / np.sqrt(0.5)
    t = T * crossing / part
    assert _tail(np.abs(second_order(t, np.sqrt(0.5), 1.0))) == ""


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (np.exp(-20.0 * T) + 0.1 * T, "grows"),
        (0.01 + 0.0 * T, "remains"),
        (np.exp(-20.0 * T) + 0.01, "remains"),
        (0.01 * (1.0 + 0.02 * np.sin(40.0 * np.pi * T)), "remains"),
        (0.1 * (1.0 - np.exp(-20.0 * T)), "remains"),
        (T, "grows"),
        (np.exp(-5.0 * T), ""),
        (0.0 * T, ""),
    ],
)
def test_the_tail_of_an_error_tells_drifts_from_decays(error, expected):
    assert _tail(np.abs(error)) == expected


@pytest.mark.parametrize("rows", [1, 2, 3, 5])
def test_short_runs_have_a_tail(rows):
    assert _tail(np.linspace(1.0, 0.0, rows)) in ("", "remains")
