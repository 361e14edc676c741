"""Figures of the loops of linear laws show the loop gains of the exact sampled plant."""

import numpy as np
import pytest

import fflin
from fflin.base.errors import InputError
from fflin.control import plots
from fflin.control.margins import closed_loop, margins_at_once
from fflin.control.plots import critical_phases, loop_responses, phase_of, smooth
from fflin.control.policy import FunctionPolicy
from fflin.dynamics.delays import HeldSystem


@pytest.fixture(scope="module")
def satellite():
    """Return the model of a satellite with a torque, and its state feedback."""
    lin = fflin.linearize(fflin.load("cubesat", inputs=[fflin.BaseTorque()]))
    return lin, fflin.StateFeedback(lin, fflin.lqr(lin).K)


def axis_gain(lin, law):
    """Return a, b of the loop gain (a + b s)/s^2 of the axis x."""
    names = lin.state_names
    L = lin.B[names.index("omega_b.x"), 0]
    kp = law.K[0, names.index("q_b.x")]
    return 0.5 * L * kp, L * law.K[0, names.index("omega_b.x")]


def test_a_continuous_loop_has_the_loop_gain_of_its_closed_form(satellite):
    lin, law = satellite
    w, response = loop_responses(closed_loop(law, lin, 0.0, None))
    a, b = axis_gain(lin, law)
    expected = (a + 1j * b * w) / (1j * w) ** 2
    np.testing.assert_allclose(response[:, 0], expected, rtol=1e-6)


def test_a_delayed_continuous_loop_has_the_phase_of_the_delay(satellite):
    lin, law = satellite
    w, response = loop_responses(closed_loop(law, lin, 0.3, None))
    a, b = axis_gain(lin, law)
    expected = (a + 1j * b * w) / (1j * w) ** 2 * np.exp(-0.3j * w)
    # The approximation of the delay is exact up to an angle of 6 rad.
    low = 0.3 * w < 6.0
    np.testing.assert_allclose(response[low, 0], expected[low], rtol=1e-6)


def test_a_sampled_loop_has_the_response_of_the_held_plant(satellite):
    lin, law = satellite
    h, delay = 0.5, 0.3
    w, response = loop_responses(closed_loop(law, lin, delay, h))
    a, b = axis_gain(lin, law)
    A = np.array([[0.0, 1.0], [0.0, 0.0]])
    held = HeldSystem(A, np.array([[0.0], [1.0]]), h, np.array([delay]))
    Ad, Bd = held.sampled()
    C = np.zeros((1, len(Ad)))
    C[0, :2] = a, b
    for k in (0, 150, 300, 398):
        z = np.exp(1j * w[k] * h)
        value = (C @ np.linalg.solve(z * np.eye(len(Ad)) - Ad, Bd))[0, 0]
        assert response[k, 0] == pytest.approx(value, rel=1e-6)
    assert w[-1] == pytest.approx(np.pi / h)


@pytest.mark.parametrize(
    ("angles", "marks"),
    [
        ([-290.0, -95.0], [-180.0]),
        ([-90.0, -80.0], [-180.0]),
        ([-290.0, 80.0], [-180.0, 180.0]),
        ([-700.0, -170.0], [-540.0, -180.0]),
        ([540.0, 625.0], [540.0]),
        ([], [-180.0]),
    ],
)
def test_critical_points_repeat_every_360_deg_within_180_deg_of_a_curve(angles, marks):
    assert critical_phases(np.array(angles)).tolist() == marks


@pytest.mark.parametrize("how", [(0.0, None), (0.3, None), (0.2, 0.25), (0.9, 0.25)])
def test_the_phase_margin_is_the_distance_of_the_curve_from_a_critical_point(
    how, satellite
):
    lin, law = satellite
    _, response = loop_responses(closed_loop(law, lin, *how))
    margins = fflin.margins(law, lin, delay=how[0], sample=how[1])
    for values, channel in zip(response.T, margins.channels, strict=True):
        angles, decibels = phase_of(values), 20.0 * np.log10(np.abs(values))
        marks = critical_phases(angles[np.abs(decibels) < 60.0])
        crossing = np.interp(0.0, -decibels, angles)
        assert -360.0 < crossing <= 0.0 and np.allclose(marks % 360.0, 180.0)
        assert np.abs(marks - crossing).min() == pytest.approx(channel.phase, abs=0.1)


def test_a_resonance_between_two_points_is_drawn_with_its_peak_and_its_phase():
    damping = 2e-3

    def gain(w):
        return (0.1 / (1.0 - w**2 + 2j * damping * w))[:, None]

    w, response = smooth(np.geomspace(0.1, 10.0, 100), gain)
    np.testing.assert_array_equal(response, gain(w))
    assert (np.diff(w) > 0.0).all() and len(w) < 300
    assert np.abs(response).max() == pytest.approx(0.1 / (2.0 * damping), rel=0.01)
    angles = phase_of(response[:, 0])
    assert angles[0] - angles[-1] == pytest.approx(180.0, abs=0.5)
    assert np.abs(np.diff(angles)).max() < 40.0


@pytest.mark.exhaustive
def test_the_figure_shows_the_curves_and_the_margins(satellite, tmp_path):
    lin, law = satellite
    path = tmp_path / "loops.png"
    figure = fflin.plot_loops(law, path, delay=0.2, sample=0.25)
    assert path.stat().st_size > 10_000
    _, response = loop_responses(closed_loop(law, lin, 0.2, 0.25))
    titles = {panel.get_title(): panel for panel in figure.axes}
    sizes = titles["loop gain"].get_lines()[0].get_ydata()
    np.testing.assert_allclose(sizes, np.abs(response[:, 0]))
    curve = titles["sensitivity 1/(1 + L)"].get_lines()[0].get_ydata()
    np.testing.assert_allclose(10 ** (curve / 20.0), np.abs(1 / (1 + response[:, 0])))
    nichols = titles["Nichols plot"].get_lines()[0]
    decibels = 20.0 * np.log10(np.abs(response[:, 0]))
    np.testing.assert_allclose(nichols.get_ydata(), decibels)
    cosine = np.cos(np.radians(nichols.get_xdata()))
    np.testing.assert_allclose(cosine, np.cos(np.angle(response[:, 0])), atol=1e-9)
    margins = fflin.margins(law, lin, delay=0.2, sample=0.25)
    assert f"disk margin {margins.disk:.3g}" in figure.get_suptitle()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[0].startswith(f"tau_b.x: {margins.channels[0].phase:.0f} deg")


@pytest.mark.exhaustive
def test_output_feedback_unstable_loops_and_laws_without_a_model(satellite):
    lin, law = satellite
    sampled = lin.discretize(0.2)
    compensator = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-6, 1e-6))
    figure = fflin.plot_loops(fflin.OutputFeedback(sampled, compensator), lin=lin)
    assert "sampled at 0.2 s" in figure.get_suptitle()
    late = fflin.plot_loops(law, delay=15.0, sample=0.25)
    assert "unstable" in late.get_suptitle()
    with pytest.raises(InputError, match="lin="):
        fflin.plot_loops(FunctionPolicy(lambda t, q, v: np.zeros(3)))


@pytest.mark.parametrize("how", [(0.0, None), (0.2, 0.25)])
def test_the_line_of_a_report_has_the_margins_of_all_inputs(satellite, how):
    lin, law = satellite
    margins = fflin.margins(law, lin, *how)
    together = margins_at_once(law, *how)
    assert together.disk == pytest.approx(margins.disk, rel=1e-9)
    assert together.gain == pytest.approx(margins.gain, rel=1e-9)
    assert together.phase == pytest.approx(margins.phase, rel=1e-9)
    assert margins_at_once(law, 15.0, 0.25).disk == 0.0


def test_an_unknown_format_is_refused_before_the_loop_is_computed(
    satellite, monkeypatch
):
    monkeypatch.setattr(plots, "closed_loop", None)
    _, law = satellite
    with pytest.raises(fflin.FileError, match="ends in"):
        fflin.plot_loops(law, "loops.txt")
