"""Figures of loops: the responses and margins of each input, and poles that can be told apart."""

import itertools

import numpy as np
import pytest

import fflin
from fflin.control.plots import input_loops
from tests.support.figures import assert_legible, texts
from tests.support.robots import mostly

pytest.importorskip("matplotlib")


def lines(axes):
    return {line.get_label(): line for line in axes.get_lines()}


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt", [0.0, 0.5])
def test_bode_plots_are_of_the_loops_broken_one_at_a_time(dt):
    lin = fflin.linearize(fflin.load("servicer_7dof"))
    gain = fflin.lqr(lin.discretize(dt) if dt else lin)
    figure = fflin.plot_loops(gain)
    assert_legible(figure)
    sizes, phases, _ = figure.axes
    curves = sizes.get_lines()[: len(gain.K)]
    for i in (0, 4, 12):
        w, drawn = curves[i].get_data()
        others = np.arange(len(gain.K)) != i
        F = gain.A - gain.B[:, others] @ gain.K[others]
        for k in (0, 150, 399):
            s = np.exp(1j * w[k] * dt) if dt else 1j * w[k]
            L = gain.K[i] @ np.linalg.solve(s * np.eye(len(F)) - F, gain.B[:, i])
            assert drawn[k] == pytest.approx(abs(L), rel=1e-6)
            angle = next(
                line.get_ydata()[k]
                for line in phases.get_lines()
                if len(line.get_xdata()) == len(w)
                and line.get_color() == curves[i].get_color()
            )
            assert np.exp(1j * np.radians(angle)) == pytest.approx(L / abs(L), rel=1e-5)


@pytest.mark.parametrize("name", mostly(["cubesat", "canadarm2", "talos"], "cubesat"))
def test_margins_are_next_to_the_names(name):
    gain = fflin.lqr(fflin.linearize(fflin.load(name)).discretize(0.2))
    figure = fflin.plot_loops(gain)
    assert_legible(figure)
    *_, loops = input_loops(gain)
    legend = figure.legends[0]
    for text, item, name in zip(
        legend.get_texts(), loops, gain.input_names, strict=True
    ):
        low, high = item.gain
        assert (
            text.get_text() == f"{name}: {item.phase:.0f} deg, {low:.2g} to {high:.3g}"
        )
    colors = [line.get_color() for line in legend.get_lines()]
    assert len(set(colors)) == len(colors)
    assert f"(disk margin {gain.margins.disk:.3g})" in figure.get_suptitle()


def test_poles_of_a_loop_are_all_distinguished():
    poles = np.array([-640.0, -31.0, -1.0 + 0.3j, -1.0 - 0.3j, -0.2, -0.1])
    figure = fflin.plot_poles(poles)
    assert_legible(figure)
    axes = figure.axes[0]
    at = axes.transData.transform(np.column_stack((poles.real, poles.imag)))
    for one, other in itertools.combinations(at, 2):
        assert np.hypot(*(one - other)) > 8.0  # pixels: more than a marker
    inside = axes.bbox.padded(1.0)
    assert all(inside.contains(*point) for point in at)
    line = axes.get_lines()[0]
    np.testing.assert_array_equal(line.get_xdata() + 1j * line.get_ydata(), poles)


def test_poles_that_lie_together_have_plain_axes():
    axes = fflin.plot_poles([-1.0 + 2.0j, -1.0 - 2.0j, -3.0]).axes[0]
    assert axes.get_xscale() == axes.get_yscale() == "linear"
    # What rounding leaves of zero does not stretch an axis.
    assert (
        fflin.plot_poles([-1e-17 + 2.0j, -1e-17 - 2.0j, -3.0]).axes[0].get_xscale()
        == "linear"
    )
    unstable = fflin.plot_poles([-200.0, 0.5, 0.0]).axes[0]
    assert unstable.get_xlim()[1] >= 0.5 and unstable.get_xlim()[0] <= -200.0


def test_pole_map_has_the_poles_of_each_set():
    lin = fflin.linearize(fflin.load("planar_detumble"))
    gain = fflin.lqr(lin, 1.0, 1.0)
    figure = fflin.plot_poles({"open": lin, "closed": gain})
    assert_legible(figure)
    shown = lines(figure.axes[0])["closed"]
    np.testing.assert_array_equal(np.sort(shown.get_xdata()), np.sort(gain.poles.real))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "open",
        "closed",
    ]
    sampled = fflin.plot_poles(lin.discretize(0.1))
    assert sampled.axes[0].get_xlabel() == "real part"
    points = [x.get_xdata() + 1j * x.get_ydata() for x in sampled.axes[0].get_lines()]
    assert any(np.allclose(np.abs(z), 1.0) and len(z) == 201 for z in points)


def curves_of(axes, label):
    """The curves with a label, as complex numbers."""
    found = [line for line in axes.get_lines() if line.get_label() == label]
    return [line.get_xdata() + 1j * line.get_ydata() for line in found]


@pytest.mark.parametrize("scale", [1.0, 300.0])
@pytest.mark.exhaustive
def test_rays_of_damping_are_labelled_at_the_edge_of_the_axes(scale):
    figure = fflin.plot_poles([-1.0 + 2.0j, -1.0 - 2.0j, -3.0 * scale])
    assert_legible(figure)
    axes = figure.axes[0]
    rays = curves_of(axes, "_damping")
    assert len(rays) == 8
    ratios = []
    for ray in rays:
        ratio = -ray[1:].real / np.abs(ray[1:])
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-12)
        ratios.append(round(ratio[0], 12))
        # A ray ends at the left, upper or lower edge.
        left, bottom, top = axes.get_xlim()[0], *axes.get_ylim()
        end = ray[-1]
        distances = [abs(end.real - left), abs(end.imag - top), abs(end.imag - bottom)]
        assert min(distances) < 1e-9 * abs(end)
    assert sorted(set(ratios)) == [0.2, 0.4, 0.6, 0.8]
    labels = [
        text
        for text, _ in texts(figure)
        if text.startswith("\N{GREEK SMALL LETTER ZETA}")
    ]
    assert labels and len(set(labels)) == len(labels)
    for circle in curves_of(axes, "_natural frequency"):
        np.testing.assert_allclose(np.abs(circle), abs(circle[0]), rtol=1e-12)


def test_real_poles_have_no_rays():
    axes = fflin.plot_poles([-1.0, -2.0]).axes[0]
    assert not curves_of(axes, "_damping")


def test_sampled_poles_have_spirals_of_damping():
    figure = fflin.plot_poles([0.5 + 0.2j, 0.5 - 0.2j], dt=0.5)
    assert_legible(figure)
    axes = figure.axes[0]
    spirals = curves_of(axes, "_damping")
    assert len(spirals) == 8
    for spiral in spirals:
        rates = np.log(spiral[1:-1]) / 0.5
        ratio = -rates.real / np.abs(rates)
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
    # pi / dt = 6.28 rad/s
    assert "1.26 rad/s" in [text for text, _ in texts(figure)]


@pytest.mark.exhaustive
def test_poles_of_a_sampled_loop_are_shown_as_rates():
    lin = fflin.linearize(fflin.load("canadarm2"))
    gain = fflin.lqr(lin.discretize(0.1))
    figure = fflin.plot_loops(gain)
    axes = figure.axes[2]
    shown = axes.get_lines()[0]
    z = np.exp(0.1 * (shown.get_xdata() + 1j * shown.get_ydata()))
    np.testing.assert_allclose(
        np.sort_complex(z), np.sort_complex(gain.poles), rtol=1e-12
    )
    assert "poles of A - B K as ln(z)/dt" in [text for text, _ in texts(figure)]


def test_an_object_without_poles_gives_a_one_line_error():
    masked = np.ma.masked_array([-1.0, -2.0], mask=[True, False])
    for given in (3, np.zeros((3, 3)), [], {}, {"a": 5.0}, [np.nan], None):
        with pytest.raises(fflin.InputError, match="poles has type"):
            fflin.plot_poles(given)
    with pytest.raises(fflin.InputError, match="masked"):
        fflin.plot_poles(masked)


@pytest.mark.exhaustive
def test_figures_are_drawn_in_place_of_the_users_axes(tmp_path):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    lin = fflin.linearize(fflin.load("planar_detumble"))
    gain = fflin.lqr(lin)
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(14, 9))
    part = fflin.plot_poles(gain, axes=left)
    fflin.plot_matrices(lin, axes=right)
    assert part in figure.subfigs
    assert left not in figure.axes
    # A pole map has one panel. The matrices have two, and a colour bar.
    assert len(part.axes) == 1
    assert len(figure.subfigs) == 2
    figure.savefig(tmp_path / "both.png")
    pyplot.close(figure)
    with pytest.raises(fflin.InputError, match="matplotlib axes"):
        fflin.plot_poles(gain, axes="left")
