"""Blocks of the cards in notebooks: markup, pictures and the place of the browser."""

import math
import re

import numpy as np
import pytest

from fflin.base import html, svg
from tests.support.cards import Parsed

MARKUP = '<b title="x">\'&'


def test_texts_are_escaped_in_every_block():
    axis = svg.Axis([MARKUP, f"{MARKUP}.y"], ["m", "1"])
    parts = [
        html.paragraph(MARKUP, "note"),
        html.verdict(MARKUP, True),
        html.preformatted(MARKUP),
        html.table([[MARKUP], [MARKUP]]),
        html.folded(MARKUP, html.paragraph(MARKUP)),
        html.frame(MARKUP, 100, content=f"<p>{MARKUP}</p>"),
        html.frame(MARKUP, 100, address=f"x?{MARKUP}"),
        svg.heat_map(MARKUP, np.eye(2), axis, axis),
        svg.curves(np.array([0.0, 1.0]), {MARKUP: np.array([0.0, 1.0])}, "1"),
    ]
    parsed = Parsed(html.card(MARKUP, MARKUP, *parts))
    assert "b" not in parsed.tags
    assert parsed.text.count(MARKUP) >= 10
    assert parsed.frames[0]["srcdoc"] == f"<p>{MARKUP}</p>"
    assert parsed.frames[1]["src"] == f"x?{MARKUP}"


def test_empty_parts_are_left_out():
    empty = html.card("A", "b", html.paragraph(""), html.preformatted(""), "")
    assert empty == html.card("A", "b")
    assert html.folded("more", "", html.paragraph("")) == ""
    assert html.side_by_side("", "") == ""


def test_a_card_has_a_light_and_a_dark_theme_and_no_script():
    card = html.card("A", "b")
    for selector in (
        "@media (prefers-color-scheme:dark)",
        "[data-jp-theme-light=true]",
        "[data-jp-theme-light=false]",
        ".vscode-dark",
    ):
        assert selector in card
    assert "<script" not in card and "{{" not in card
    used = {*re.findall(r"var\((--\w+)\)", card)}
    assert used and all(card.count(f"{name}:") == 4 for name in used)


@pytest.mark.parametrize("number", ["2e-08", "-1.5e-7", "residual=1.4e-13"])
def test_no_line_breaks_at_the_hyphen_of_an_exponent(number):
    text = f"a-b {number} <1/s>"
    parsed = Parsed(html.card("A", text, html.verdict(text, True)))
    assert parsed.text.count(text) == 2 and parsed.verdicts == [("good", text)]
    digits = number.lstrip("-")
    whole = number.replace(digits, f'<span class="whole">{digits}</span>')
    assert html.paragraph(text) == f"<p>a-b {whole} &lt;1/s&gt;</p>"
    assert ".whole{white-space:nowrap}" in html.card("A", text)


def test_verdicts_have_the_colour_of_their_meaning():
    kinds = [Parsed(html.verdict("x", good)).verdicts for good in (True, False, None)]
    assert kinds == [[("good", "x")], [("bad", "x")], []]


@pytest.mark.parametrize(
    ("unit", "rate"),
    [
        ("rad", "rad/s"),
        ("rad/s", "rad/s^2"),
        ("1", "1/s"),
        ("m/s", "m/s^2"),
        ("kg^0.5 m", "(kg^0.5 m)/s"),
    ],
)
def test_units_of_rates(unit, rate):
    assert svg.rate_unit(unit) == rate


def test_cells_are_where_their_entries_are():
    values = np.array([[0.0, 2.0], [-3.0, 0.0]])
    rows = svg.Axis(["r.a", "r.b"], ["m", "m"])
    columns = svg.Axis(["c.a", "c.b"], ["N", "1"])
    drawing = svg.heat_map("M", values, rows, columns)
    cells = re.findall(
        r'<rect class="((?:posi|nega)tive)" x="(\d+)" y="(\d+)".*?<title>(.*?)</title>',
        drawing,
    )
    assert cells == [
        ("positive", "13", "0", "M[r.a, c.b] = 2 m"),
        ("negative", "0", "13", "M[r.b, c.a] = -3 m per N"),
    ]


def test_a_larger_entry_has_a_stronger_colour():
    axis = svg.Axis(["a", "b", "c"], ["1"] * 3)
    drawing = svg.heat_map("M", np.diag([1.0, 10.0, 1e9]), axis, axis)
    opacities = [float(x) for x in re.findall(r'opacity="([\d.]+)"', drawing)]
    assert opacities == sorted(opacities) and opacities[-1] == 1.0
    assert opacities[0] == opacities[1] == 0.25  # a millionth and less


def test_blocks_keep_the_largest_entries():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(60, 60))
    names = [f"g.x{k}" for k in range(60)]
    axis = svg.Axis(names, ["m"] * 60)
    drawing = svg.heat_map("M", values, axis, axis)
    assert len(drawing) < 50_000
    block = int(re.search(r"each block of (\d+) x", drawing)[1])
    titles = Parsed(drawing).titles
    assert len(titles) == math.ceil(60 / block) ** 2
    for top in range(0, 60, block):
        part = np.abs(values[top : top + block, :block])
        i, j = np.unravel_index(part.argmax(), part.shape)
        value = values[top + i, j]
        assert f"M[g.x{top + i}, g.x{j}] = {value:.4g} m per m" in titles


def test_stable_poles_are_left_of_the_axis_and_unstable_ones_marked():
    poles = np.array([-1.0 + 2.0j, -1.0 - 2.0j, 0.0, 0.3])
    drawing = svg.pole_map(poles)
    marks = re.findall(r'class="mark( unstable)?" d="M([\d.]+) ([\d.]+)', drawing)
    assert len(marks) == 4
    xs = [float(x) for _, x, _ in marks]
    ys = [float(y) for _, _, y in marks]
    assert xs[0] == xs[1] < 95.0 == xs[2] < xs[3]
    assert ys[0] < 95.0 < ys[1]  # upwards is a positive imaginary part
    assert [bool(bad) for bad, *_ in marks] == [False, False, False, True]
    assert "-1+2i 1/s, 2.24 rad/s, damping 0.447" in Parsed(drawing).titles
    sampled = svg.pole_map(np.array([0.5, 1.1]), 0.1)
    marks = re.findall(r'class="mark( unstable)?"', sampled)
    assert marks == ["", " unstable"] and '<circle class="axis"' in sampled


def damping_curves(drawing):
    """The points (k, 2) of the curves of constant damping in a pole map, from its middle."""
    found = re.findall(r'<polyline class="damping" points="([^"]*)"', drawing)
    return [
        np.array([pair.split(",") for pair in points.split()], float) - 95.0
        for points in found
    ]


def test_curves_of_damping_pass_through_poles_of_their_ratio():
    pole = 2.0 * complex(-0.6, 0.8)
    drawing = svg.pole_map(np.array([pole, pole.conjugate(), -0.5]))
    mark = re.findall(r'class="mark" d="M([\d.]+) ([\d.]+)', drawing)[0]
    x, y = (float(entry) - 95.0 for entry in mark)
    curves = damping_curves(drawing)
    assert len(curves) == 8
    nearest = [np.hypot(*(curve - (x, y)).T).min() for curve in curves]
    # The pole has the largest modulus, so that the curve of its ratio ends there.
    assert nearest[4] < 0.2 and min(nearest[:4]) > 5.0
    assert ">0.2</text>" in drawing
    assert not damping_curves(svg.pole_map(np.array([-1.0, -2.0])))


def test_curves_of_damping_of_sampled_poles_begin_at_one():
    curves = damping_curves(svg.pole_map(np.array([0.5]), 0.1))
    assert len(curves) == 8
    for curve in curves:
        assert curve[0] == pytest.approx((88.0 / 1.1, 0.0), abs=0.1)


def test_a_repeated_pole_is_drawn_once():
    assert svg.pole_map(np.full(50, -1.0)).count("<g>") == 1


def test_curves_are_thinned_and_the_largest_are_drawn():
    t = np.linspace(0.0, 5.0, 5001)
    curves = {f"c{k}": (k + 1) * np.sin(t) for k in range(12)}
    drawing = svg.curves(t, curves, "rad")
    assert Parsed(drawing).titles == [f"c{k}" for k in range(4, 12)]
    assert len(drawing) < 30_000
    flat = svg.curves(t, {"zero": np.zeros(5001)}, "m")
    assert "nan" not in flat and "inf" not in flat


@pytest.mark.parametrize("name", ["SSH_CONNECTION", "JUPYTERHUB_USER", "CODESPACES"])
def test_kernels_of_services_are_not_local(monkeypatch, name):
    for variable in html._REMOTE:
        monkeypatch.delenv(variable, raising=False)
    assert html.browser_is_local()
    monkeypatch.setenv(name, "x")
    assert not html.browser_is_local()


def test_this_process_is_not_a_notebook():
    assert not html.in_notebook()
    assert not html.is_shown_elsewhere(object())
