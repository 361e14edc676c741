"""Files of dispersions: what they say, and file and line of what is wrong."""

import pickle

import numpy as np
import pytest
from scipy import stats

import fflin
from fflin.campaign.runs import CampaignJob


def read(tmp_path, text, head="[dispersions]\n"):
    path = tmp_path / "uncertain.toml"
    path.write_text(head + text)
    return fflin.load_dispersions(path)


def test_all_kinds_of_spreads(tmp_path):
    result = read(
        tmp_path,
        "q_b = 0.05\n"
        "r_b = {normal = 2}\n"
        '"*.mass" = {uniform = [-0.1, 0.2]}\n'
        "base.com = 0.1\n"
        "tau_b.x.fails = {values = [1, 2.5]}\n"
        'omega_b = {distribution = "t", df = 4, scale = 0.01}\n'
        "[dispersions.q_m]\n"
        "joint_1 = {uniform = [0, 0]}\n",
    )
    omega = result.pop("omega_b")
    assert dict(result) == {
        "q_b": 0.05,
        "r_b": 2,
        "*.mass": (-0.1, 0.2),
        "base.com": 0.1,
        "tau_b.x.fails": [1, 2.5],
        "q_m.joint_1": (0, 0),
    }
    assert omega.ppf(0.9) == pytest.approx(stats.t(4, scale=0.01).ppf(0.9), rel=1e-14)
    assert pickle.loads(pickle.dumps(result)) == result


def test_a_tied_spread_is_one_draw(tmp_path, robots):
    result = read(
        tmp_path, '"*.mass" = {uniform = [-0.1, 0.2], tied = true}\nq_b = 0.01\n'
    )
    assert result["*.mass"] == {"range": (-0.1, 0.2), "tied": True}
    scaled = read(tmp_path, 'q_b = {distribution = "norm", scale = 0.1, tied = true}')[
        "q_b"
    ]
    assert scaled["range"].ppf(0.5) == 0.0


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("q_b = [1, 2]", 3, r"\[1, 2\]"),
        ("q_b = true", 3, "True"),
        ("q_b = {uniform = [false, 0.1]}", 3, "False"),
        ("q_b = {distribution = 'norm', scale = false}", 3, "False"),
        ("q_b = inf", 3, "dispersion"),
        ("q_b = {}", 3, "dispersion"),
        ("q_b = {uniform = [1, 2, 3]}", 3, "dispersion"),
        ("q_b = {uniform = [1, 2], c = 3}", 3, "dispersion"),
        ("q_b = {uniform = 1}", 3, "dispersion"),
        ("q_b = {normal = [1]}", 3, "dispersion"),
        ("q_b = {values = []}", 3, "dispersion"),
        ("q_b = {unifrom = [1, 2]}", 3, "'q_b.unifrom'"),
        ("q_b = {distribution = 3}", 3, "dispersion"),
        ('q_b = {distribution = "trang"}', 3, "'trang'"),
        ('q_b = {distribution = "triang"}', 3, "'c'"),
        ('q_b = {distribution = "norm", d = 1}', 3, "'d'"),
        ('q_b = {distribution = "triang", c = 7}', 3, "c = 7"),
        ('q_b = {distribution = "ksone", n = 100000}', 3, "at most 1000"),
        ('q_b = {distribution = "norm", scale = "a"}', 3, "norm"),
        ('q_b = {distribution = "norm", scale = inf}', 3, "finite"),
        ('q_b = {distribution = "triang", c = [[0.5]]}', 3, "finite"),
        ('q_b = {distribution = "rv_histogram"}', 3, "distribution"),
        ('q_b = {distribution = "rv_continuous"}', 3, "distribution"),
        ('q_b = {distribution = "rv_discrete"}', 3, "distribution"),
        ("q_b = -1", 3, "standard deviation"),
        ("\nq_b = {uniform = [1, 0]}", 4, r"\(1, 0\)"),
        ('q_b = {normal = 0.1, tied = "yes"}', 3, "tied"),
        ("q_b = {tied = true}", 3, "dispersion"),
        ("nosuch = 1", 3, "'nosuch'"),
        ("nosuch.mass = 1", 3, r"mass\b.*'nosuch'"),
        ('\n"*.mass" = 0.9', 4, "mass"),
        ("base.inertia = {uniform = [-2, 0]}", 3, "'base.inertia.x'"),
        ("tau_b.gain = 1\nq_b.sensor = 0.1", 4, "sensors"),
        ("q_b = 0.6", 1, "attitude"),
    ],
)
def test_errors_have_file_and_line(tmp_path, robots, text, line, message):
    with pytest.raises(fflin.FflinError, match=message) as caught:
        given = read(tmp_path, "r_b = 0.01\n" + text)
        fflin.monte_carlo(
            robots["planar_detumble"], None, given, runs=100, duration=0.1
        )
    assert str(caught.value).startswith(f"{tmp_path / 'uncertain.toml'}:{line}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("", 1, "spread"),
        ("[dispersions]", 1, "spread"),
        ("dispersions = 3", 1, "spread"),
        ("\nq_b = 0.1", 2, "'q_b'"),
        ("[dispersions]\nq_b = 1\n[input]\nx = 1", 3, "'input'"),
        ("[dispersions]\nq_b = ", 2, "TOML"),
        ("[dispersions]\nq_b = 1\nq_b.sensor = 1", 3, '"q_b.sensor"'),
    ],
)
def test_a_missing_file_is_refused(tmp_path, text, line, message):
    with pytest.raises(fflin.FflinError, match=message) as caught:
        read(tmp_path, text, head="")
    assert f"uncertain.toml:{line}: " in str(caught.value)


def test_errors_about_other_things_name_no_file(tmp_path, robots):
    given = read(tmp_path, "q_b = 0.01")
    with pytest.raises(fflin.InputError, match="runs"):
        fflin.monte_carlo(robots["planar_detumble"], None, given, runs=0, duration=0.1)


class Given:
    """A distribution that notes how many values are drawn of it."""

    def __init__(self, ppf):
        self.inverse, self.count = ppf, 0

    def ppf(self, u):
        self.count += np.size(u)
        return self.inverse(u)


def test_a_distribution_draws_each_value_once_whatever_is_asked_for(robots):
    """Those of scipy.stats that integrate take a second for two values."""
    dispersions = [
        CampaignJob(
            robots["planar_detumble"],
            None,
            {"r_b.x": given},
            7,
            "python",
            {"duration": 1.0},
        ).dispersions
        for given in (
            Given(stats.logistic(scale=0.1).ppf),
            (-0.1, 0.1),
            Given(lambda u: u),
        )
    ]
    once, uniform, plain = dispersions
    before = [item.columns[0].inverse.__self__.count for item in (once, plain)]
    for item in (once, plain):
        item.require_possible(2100)
    assert once.drawn(3, 20).shape == (17, 1)
    parts = [once.drawn(*span) for span in ((0, 1000), (1000, 1030), (1030, 2100))]
    counts = [item.columns[0].inverse.__self__.count for item in (once, plain)]
    assert counts == [item + 2100 for item in before]
    u = plain.drawn(0, 2100)
    np.testing.assert_allclose(
        np.concatenate(parts), stats.logistic(scale=0.1).ppf(u), rtol=1e-14
    )
    np.testing.assert_allclose(uniform.drawn(5, 2100), -0.1 + 0.2 * u[5:], rtol=1e-14)


@pytest.mark.parametrize(
    ("ppf", "message"),
    [
        (lambda u: np.where(np.asarray(u) > 0.9, np.inf, 0.0), "finite"),
        (lambda u: np.where(np.asarray(u) > 0.9, np.nan, 0.0), "finite"),
        (
            lambda u: 0.0 if np.ndim(u) == 0 else np.linalg.inv(np.zeros((1, 1))),
            "no values can be drawn",
        ),
    ],
)
def test_an_invalid_dispersion_is_refused_before_the_runs(
    ppf, message, robots, monkeypatch
):
    monkeypatch.setattr("fflin.campaign.monte_carlo.run_chunks", None)  # the runs
    given = {"r_b.x": Given(ppf)}
    with pytest.raises(fflin.InputError, match=message) as caught:
        fflin.monte_carlo(
            robots["planar_detumble"], None, given, runs=100, duration=0.1
        )
    assert "r_b.x" in str(caught.value)
