"""The figure of a campaign shows its figures."""

from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.campaign.report import worst_runs

pytest.importorskip("matplotlib")
pytestmark = pytest.mark.filterwarnings("ignore::fflin.FflinWarning")


@pytest.fixture(scope="module")
def campaign(robots):
    robot = robots["ets_vii"]
    lin = fflin.linearize(robot)
    return fflin.monte_carlo(
        robot,
        fflin.StateFeedback(lin, fflin.lqr(lin).K),
        {"q_b": 0.05, "tau_b.x.gain": [0.0, 0.0, 0.0, 0.0, -60.0]},
        runs=40,
        duration=4.0,
        dt=0.02,
        histories=21,
        limits={"F_b": 0.5},
        goals=["attitude < 3 deg and worst position < 1 m"],
        seed=3,
    )


def of(figure, title):
    [axes] = [ax for ax in figure.axes if ax.get_title() == title]
    return axes


@pytest.mark.compiled
def test_bands_hold_their_share_of_the_runs_and_the_worst_are_on_top(campaign):
    figure = fflin.plot_campaign(campaign, worst=2)
    axes = of(figure, "attitude error")
    history = campaign.error_history[..., 0]
    half, *worst = [x for x in axes.get_lines() if not x.get_label().startswith("goal")]
    ordered = np.sort(history, axis=0)
    assert np.array_equal(half.get_ydata(), ordered[19])
    assert [x.get_label() for x in worst] == [f"run {run}" for run in campaign.worst(2)]
    for line, run in zip(worst, campaign.worst(2), strict=True):
        known = np.isfinite(history[run])
        assert np.array_equal(line.get_ydata()[known], history[run][known])
    whole, most, middle = axes.collections
    assert campaign.stopped.any()
    for band, low, high in ((whole, 0, 39), (most, 1, 37), (middle, 9, 29)):
        at = band.get_paths()[0].vertices
        top = 1.15 * history[np.isfinite(history)].max()
        for k, t in enumerate(campaign.times):
            value = at[np.isclose(at[:, 0], t), 1]
            assert value.min() == pytest.approx(min(ordered[low, k], top))
            assert value.max() == pytest.approx(min(ordered[high, k], top))


@pytest.mark.exhaustive
def test_goals_limits_and_histograms(campaign):
    figure = fflin.plot_campaign(campaign)
    goal = "goal or limit"
    bounds = [
        x for x in of(figure, "attitude error").get_lines() if x.get_label() == goal
    ]
    assert [x.get_ydata()[0] for x in bounds] == [3.0]
    limits = [
        x for x in of(figure, "largest |F_b|").get_lines() if x.get_label() == goal
    ]
    assert [x.get_ydata()[0] for x in limits] == [0.5]
    assert not [
        x for x in of(figure, "largest |tau_b|").get_lines() if x.get_label() == goal
    ]
    [position] = [x for x in figure.axes if x.get_xlabel() == "position error [m]"]
    assert [
        x.get_xdata()[0] for x in position.get_lines() if x.get_label() == goal
    ] == [1.0]
    counts = [
        int(sum(bar.get_height() for bar in bars)) for bars in position.containers
    ]
    assert counts == [int((~campaign.stopped).sum())] * 2
    bars = of(figure, "correlation with attitude").containers[0]
    sizes = sorted(campaign.sensitivity().values(), key=abs)
    assert [bar.get_width() for bar in bars] == sizes[-10:]
    assert (
        "% confidence" in figure.get_suptitle() and "diverged" in figure.get_suptitle()
    )


@pytest.mark.exhaustive
def test_without_histories_and_with_none_that_ended(robots, campaign, tmp_path):
    robot = robots["planar_detumble"]
    few = fflin.monte_carlo(robot, None, {"omega_b": 0.01}, runs=3, duration=0.1)
    figure = fflin.plot_campaign(few, tmp_path / "few.svg")
    assert len(figure.axes) == 4 and (tmp_path / "few.svg").stat().st_size > 1000
    lost = np.flatnonzero(campaign.stopped)
    arrays = {
        name: getattr(campaign, name)[lost]
        for name in fflin.Campaign.__annotations__
        if isinstance(getattr(campaign, name, None), np.ndarray)
    }
    header = {name: getattr(campaign, name) for name in fflin.Campaign.__annotations__}
    fflin.plot_campaign(fflin.Campaign.of(arrays, header), tmp_path / "lost.png")
    with pytest.raises(fflin.InputError, match="Campaign"):
        fflin.plot_campaign(3)


@pytest.mark.compiled
def test_errors_of_joints_are_in_degrees(robots):
    robot = robots["planar_detumble"]
    lin = fflin.linearize(robot)
    runs = fflin.monte_carlo(
        robot,
        fflin.StateFeedback(lin, fflin.lqr(lin).K),
        {"q_m": 0.1},
        runs=8,
        duration=2.0,
        dt=0.02,
        histories=11,
        goals=["joints < 0.05 and worst joint rates < 20 deg/s and settle < 40"],
        seed=1,
    )
    values, unit = runs.figure("joints")
    assert unit == "rad"  # every joint is revolute
    rows = {line.split("  ")[0]: line.split() for line in str(runs).splitlines()}
    assert rows["joints"][1:3] == [
        "deg",
        f"{np.degrees(runs.quantile('joints', 0.5).value):.3g}",
    ]
    assert rows["joint rates"][2] == rows["omega_b"][1] == "deg/s"
    # A number without a unit is in the unit of the figure, which the report adds.
    goal = "joints < 0.05 rad and worst joint rates < 20 deg/s and settle < 40 s:"
    assert goal in " ".join(str(runs).split())
    assert worst_runs(runs, 1)[1].splitlines()[1].split()[1:3] == [
        f"{np.degrees(values.max()):.3g}",
        "deg",
    ]
    axes = of(fflin.plot_campaign(runs), "joints error")
    history = np.degrees(runs.error_history[..., 2])
    half, *_ = axes.get_lines()
    assert axes.get_ylabel() == "[deg]"
    assert np.array_equal(half.get_ydata(), np.sort(history, axis=0)[3])
    [goal_line] = [x for x in axes.get_lines() if x.get_label() == "goal or limit"]
    assert goal_line.get_ydata()[0] == np.degrees(0.05)


def test_a_robot_with_prismatic_joints_has_errors_in_two_units(robots):
    robot = robots["planar_detumble"]
    runs = fflin.monte_carlo(robot, None, {"q_m": 0.1}, runs=2, duration=0.1)
    units = [
        "m" if "joint_2" in name else unit
        for name, unit in zip(runs.state_names, runs.state_units, strict=True)
    ]
    mixed = replace(runs, state_units=tuple(units))
    assert mixed.figure("joints")[1] == "rad|m"
    assert mixed.met("joints < 10 rad").all() and mixed.met("joints < 10 m").all()
