"""The figure of a periodic loop shows the response of the loop to its harmonics."""

import numpy as np
import pytest

import fflin
from fflin.control.margins import closed_loop
from fflin.control.optimal.periodic_loops import Harmonics, PeriodicLoop
from fflin.control.periodic_plots import lifted_loop
from tests.control.test_multirate import designed

SAMPLES = 3


def constant_loop():
    """Return a loop whose matrices do not change, as a loop of three samples, and its matrices."""
    F = np.array([[0.9, 0.1], [-0.2, 0.7]])
    G = np.array([[0.2], [0.5]])
    H = np.array([[-0.3, -0.4]])
    J = np.array([[0.5]])
    loop = PeriodicLoop(*(np.array([matrix] * SAMPLES) for matrix in (F, G, H, J)))
    return loop, (F, G, H, J)


def test_the_eigenloci_of_a_constant_loop_are_its_gains_at_the_harmonics():
    loop, (F, G, H, J) = constant_loop()
    lifted = lifted_loop(loop, 1.0)
    for angle, values in zip(lifted.w[::97], lifted.loci[0, ::97], strict=True):
        z = np.exp(1j * (angle + 2.0 * np.pi * np.arange(SAMPLES) / SAMPLES))
        halves = [(J + H @ np.linalg.solve(at * np.eye(2) - F, G))[0, 0] for at in z]
        expected = [(0.5 - half) / (0.5 + half) for half in halves]
        np.testing.assert_allclose(
            np.sort_complex(values), np.sort_complex(expected), rtol=1e-9
        )


def test_singular_values_of_a_constant_loop_are_its_largest_gains():
    loop, (F, G, H, J) = constant_loop()
    lifted = lifted_loop(loop, 0.5)
    for w, gain, sensitivity, together in zip(
        lifted.w[::97],
        lifted.gains[0, ::97],
        lifted.sensitivities[0, ::97],
        lifted.together[0, ::97],
        strict=True,
    ):
        z = np.exp(1j * (0.5 * w + 2.0 * np.pi * np.arange(SAMPLES) / SAMPLES))
        halves = np.array(
            [(J + H @ np.linalg.solve(at * np.eye(2) - F, G))[0, 0] for at in z]
        )
        S = 0.5 + halves
        assert gain == pytest.approx(np.abs((1.0 - S) / S).max())
        assert sensitivity == pytest.approx(np.abs(S).max())
        assert together == pytest.approx(np.abs(S).max())


@pytest.mark.exhaustive
def test_an_eigenlocus_passes_the_point_of_the_gain_margin(tmp_path):
    _, lin, compensator = designed()
    policy = fflin.MultirateFeedback(lin, compensator)
    closed = closed_loop(policy, lin, None, None)
    loop = closed.periodic(closed.with_delays(closed.delays))
    channel = fflin.margins(policy, lin).channels[0]
    lifted = lifted_loop(loop, closed.dt)
    response = Harmonics(loop.channel(0))
    for factor, w in zip(channel.gain, channel.gain_frequencies, strict=True):
        S = response.one(w * closed.dt) + 0.5 * np.eye(len(closed.laws))
        eigenvalues = np.linalg.eigvals(np.linalg.inv(S) - np.eye(len(S)))
        assert np.abs(factor * eigenvalues + 1.0).min() < 1e-5
        assert np.abs(factor * lifted.loci[0] + 1.0).min() < 0.1
    path = tmp_path / "loops.png"
    figure = fflin.plot_loops(policy, path)
    assert path.exists()
    assert len(figure.axes) == 4
    assert (
        f"disk margin {fflin.margins(policy, lin).disk:.3g}"
        in figure._suptitle.get_text()
    )
    curves = figure.axes[0].get_lines()
    np.testing.assert_array_equal(curves[0].get_ydata(), lifted.gains[0])
