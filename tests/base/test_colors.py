"""Colours of curves: told apart by everybody, and read on white and on a dark ground."""

import itertools

import numpy as np
import pytest

from fflin.base.figures import COLORS, GREY, curve_styles
from tests.support.color_vision import SIGHT, difference, lab, linear

# Sharma, Wu and Dalal, Color Research and Application 30(1), 2005, table 1.
PUBLISHED = [
    ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
    ((50.0, -1.0, 2.0), (50.0, 0.0, 0.0), 2.3669),
    ((50.0, 2.4900, -0.0010), (50.0, -2.4900, 0.0011), 7.2195),
    ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
    ((50.0, 2.5, 0.0), (50.0, 3.2592, 0.3350), 1.0000),
    ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ((22.7233, 20.0904, -46.6940), (23.0331, 14.9730, -42.5619), 2.0373),
    ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
]


@pytest.mark.parametrize(("one", "other", "expected"), PUBLISHED)
def test_differences_are_those_that_were_published(one, other, expected):
    assert difference(one, other) == pytest.approx(expected, abs=5e-5)
    assert difference(other, one) == pytest.approx(expected, abs=5e-5)


def test_white_and_red_have_their_published_coordinates():
    np.testing.assert_allclose(lab(linear("#ffffff")), [100, 0, 0], atol=1e-3)
    np.testing.assert_allclose(lab(linear("#ff0000")), [53.24, 80.09, 67.20], atol=0.01)


@pytest.mark.parametrize("sight", SIGHT)
def test_two_colours_of_curves_are_told_apart(sight):
    seen = {color: lab(linear(color) @ SIGHT[sight].T) for color in COLORS}
    for one, other in itertools.combinations(COLORS, 2):
        assert difference(seen[one], seen[other]) >= 15.0, (one, other)


def test_red_and_green_of_equal_lightness_would_fail_this_test():
    red, green = (
        linear(color) @ SIGHT["deuteranopia"].T for color in ("#ff7a70", "#b9b04a")
    )
    assert difference(lab(red), lab(green)) < 15.0
    assert difference(lab(linear("#ff7a70")), lab(linear("#b9b04a"))) > 30.0


@pytest.mark.parametrize("ground", ["#ffffff", "#0a0f1c"])
def test_colours_have_contrast_on_both_grounds(ground):
    def luminance(color):
        return float(linear(color) @ [0.2126, 0.7152, 0.0722])

    for color in COLORS:
        low, high = sorted((luminance(color) + 0.05, luminance(ground) + 0.05))
        assert high / low > 2.0, color


def test_up_to_eight_curves_have_colours_and_dashes_from_the_sixth_on():
    styles = curve_styles({f"joint_{k}": 1.0 for k in range(8)})
    assert [style.color for style in styles.values()] == [*COLORS]
    assert [style.dashed for style in styles.values()] == [False] * 5 + [True] * 3
    assert [style.line for style in styles.values()] == ["-"] * 5 + ["-."] * 3


def test_of_more_curves_the_eight_largest_have_colours_in_their_order():
    changes = {f"joint_{k}": 0.1 * k for k in (3, 9, 1, 7, 5, 11, 2, 8, 6, 10, 4)}
    styles = curve_styles(changes)
    named = [name for name, style in styles.items() if style.color != GREY]
    assert named == [f"joint_{k}" for k in (9, 7, 5, 11, 8, 6, 10, 4)]
    assert [styles[name].color for name in named] == [*COLORS]
    grey = [name for name, style in styles.items() if not style.is_named]
    assert grey == ["joint_3", "joint_1", "joint_2"]
