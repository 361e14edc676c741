"""Frequency and damping ratio of modes as parameters, compared with relinearisation."""

import math

import numpy as np
import pytest

import fflin
from fflin.base.errors import InputError
from tests.campaign.test_monte_carlo import both
from tests.robot.test_appendages import beam, displaced, full, hub_with_rod, servicer


def free_flying():
    """Servicer with flexible appendages and a tank on springs."""
    rigid, appendages = servicer()
    tank = fflin.Slosh(
        "base", 30.0, (0.1, 0.0, 0.3), frequency=0.2, damping=0.02, name="tank"
    )
    return rigid.replace(appendages=[*appendages, tank])


NAMES = ("boom_mode_2", "left_mode_1", "tank_x")


def test_frequencies_and_ratios_match_the_appendages():
    S = fflin.sensitivity(fflin.linearize(full()))
    assert S["left_mode_3.frequency"].value == pytest.approx(0.9, rel=1e-14)
    assert S["left_mode_3.damping"].value == pytest.approx(0.3, rel=1e-14)
    assert S["tank_y.frequency"].value == pytest.approx(0.2, rel=1e-14)
    assert S["tank_y.damping"].value == pytest.approx(0.02, rel=1e-14)
    assert (S["tank_y.frequency"].unit, S["tank_y.damping"].unit) == ("Hz", "1")
    # A pendulum has no frequency of its own.
    assert "swing_x.frequency" not in S.names
    assert "swing_x.stiffness" in S.names and "boom_mode_1.stiffness" not in S.names


@pytest.mark.parametrize("part", ["frequency", "damping"])
@pytest.mark.parametrize("name", NAMES)
def test_derivatives_match_relinearised_robots(name, part):
    robot = free_flying()
    q, v = displaced(robot)
    lin = fflin.linearize(robot, q=q, v=v)
    slope = fflin.sensitivity(lin)[f"{name}.{part}"]
    h = 1e-4
    uncertain = fflin.uncertain(robot, {f"{name}.{part}": (0.01, 1.0)})
    ends = [
        fflin.linearize(uncertain.at({f"{name}.{part}": slope.value + step}), q=q, v=v)
        for step in (-h, h)
    ]
    for given, key in ((slope.dA, "A"), (slope.df0, "f0")):
        expected = (getattr(ends[1], key) - getattr(ends[0], key)) / (2.0 * h)
        assert np.abs(given).max() > 0.0
        np.testing.assert_allclose(given, expected, atol=1e-6 * np.abs(expected).max())


def test_a_changed_frequency_keeps_the_damping_ratio():
    robot = free_flying()
    uncertain = fflin.uncertain(
        robot, {"boom_mode_1.frequency": 0.2, "tank_x.damping": 0.5}
    )
    other = uncertain.at({"boom_mode_1.frequency": 0.33, "tank_x.damping": 0.03})
    omega = 2.0 * math.pi * 0.33
    assert other.stiffness["boom_mode_1"] == pytest.approx(omega**2, rel=1e-14)
    tank = 2.0 * math.pi * 0.2
    assert other.stiffness["tank_x"] == pytest.approx(30.0 * tank**2, rel=1e-14)
    assert other.damping["tank_x"] == pytest.approx(2.0 * 0.03 * 30.0 * tank, rel=1e-14)
    left = fflin.uncertain(robot, {"left_mode_3.frequency": 0.2}).at(
        {"left_mode_3.frequency": 1.0}
    )
    assert left.damping["left_mode_3"] == pytest.approx(
        2.0 * 0.3 * 2.0 * math.pi, rel=1e-14
    )
    # Of a body that is made anew too.
    both = fflin.uncertain(robot, {"boom_mode_1.frequency": 0.2, "link_7.mass": 0.1})
    made = both.at(
        {
            "boom_mode_1.frequency": 0.33,
            "link_7.mass": 1.02 * robot.pieces["link_7"].mass,
        }
    )
    assert made.stiffness["boom_mode_1"] == pytest.approx(omega**2, rel=1e-14)


def test_a_body_made_anew_keeps_the_springs_that_were_set():
    robot = free_flying().replace(stiffness={"boom_mode_1": 1.0})
    assert (
        robot.with_mass_properties({"joint_1": {"mass": 20.0}}).stiffness["boom_mode_1"]
        == 1.0
    )


def test_the_lft_is_exact_in_frequency_and_ratio():
    robot = free_flying()
    uncertain = fflin.uncertain(
        robot,
        {
            "boom_mode_*.frequency": 0.2,
            "left_mode_1.frequency": (0.1, 0.5),
            "left_mode_1.damping": (0.0, 0.05),
            "tank_x.damping": 0.5,
            "tank_x.frequency": 0.1,
            "base.mass": 0.1,
        },
    )
    form = uncertain.lft()
    assert form.repeats[0] == 2.0
    for delta in uncertain.draws(4, seed=5)[0]:
        lin = fflin.linearize(uncertain.at(uncertain.values(delta)))
        A, B, *_ = form.at(uncertain.values(delta))
        np.testing.assert_allclose(A, lin.A, atol=1e-11 * np.abs(lin.A).max())
        np.testing.assert_allclose(B, lin.B, atol=1e-11 * np.abs(lin.B).max())


def test_frequencies_of_zero_or_less_are_refused():
    with pytest.raises(InputError, match="expected values above 0"):
        fflin.uncertain(free_flying(), {"boom_mode_1.frequency": (0.0, 1.0)})
    with pytest.raises(fflin.UnknownNameError, match=r"swing_x\.frequency"):
        fflin.uncertain(full(), {"swing_x.frequency": 0.1})


def beam_on_hub():
    robot = hub_with_rod(10.0, 2.0, 1.0, 2.0).replace(
        appendages=[beam(1.0, 2.0, 5.0, 2)]
    )
    return robot.replace(damping={"beam_mode_1": 0.1})


DISPERSED = {
    "beam_mode_*.frequency": 0.2,
    "beam_mode_1.damping": (-0.5, 0.5),
    "base.mass": 0.01,
}


def test_runs_of_a_campaign_have_their_frequencies_and_ratios():
    robot = beam_on_hub()
    policy = fflin.StateFeedback(fflin.linearize(robot), np.zeros((6, 16)))
    start = {
        "q0": fflin.configuration(robot, {"beam_mode_1": 0.05}),
        "duration": 1.0,
        "dt": 0.01,
    }
    given = {name: spread for name, spread in DISPERSED.items() if name != "base.mass"}
    made = fflin.monte_carlo(robot, policy, given, runs=3, engine="python", **start)
    for run, drawn in enumerate(made.drawn):
        d = dict(zip(made.names, drawn, strict=True))
        factors = {
            name: 1.0 + d[f"{name}.frequency"]
            for name in ("beam_mode_1", "beam_mode_2")
        }
        stiffness = {name: f**2 * robot.stiffness[name] for name, f in factors.items()}
        damping = 0.1 * factors["beam_mode_1"] * (1.0 + d["beam_mode_1.damping"])
        other = robot.replace(stiffness=stiffness, damping={"beam_mode_1": damping})
        motion = fflin.simulate(other, policy, engine="python", **start)
        assert np.abs(motion.q[-1, 7:]).max() > 1e-3
        np.testing.assert_allclose(made.q[run], motion.q[-1], atol=1e-13)


@pytest.mark.compiled
def test_compiled_runs_have_their_frequencies_and_ratios():
    robot = beam_on_hub()
    policy = fflin.StateFeedback(fflin.linearize(robot), np.zeros((6, 16)))
    both(robot, policy, DISPERSED | {"qdot_m": 0.02})


@pytest.mark.parametrize(
    ("name", "message"),
    [("wheel", "no frequency"), ("swing_x", "is 0"), ("joint_1", "no frequency")],
)
def test_frequencies_that_do_not_exist_are_not_dispersed(name, message):
    robot = full()
    policy = fflin.StateFeedback(
        fflin.linearize(robot), np.zeros((16, 2 * (6 + robot.n)))
    )
    with pytest.raises((InputError, fflin.UnknownNameError), match=message):
        fflin.monte_carlo(
            robot, policy, {f"{name}.frequency": 0.1}, runs=2, duration=1.0
        )


def test_a_changed_body_keeps_the_coordinates_of_its_modes():
    rigid, appendages = servicer()
    robot = rigid.replace(appendages=appendages)
    body = rigid.model.inertias[1]
    given = {"base": {"mass": 1.1 * body.mass, "com": body.lever + 0.01}}
    changed = robot.with_mass_properties(given)
    assert changed.joints == robot.joints
    mounted = rigid.with_mass_properties(given).replace(appendages=appendages)
    q = fflin.configuration(changed, {"joint_2": 0.4, "boom_mode_1": 0.02})
    other = fflin.configuration(mounted, {"joint_2": 0.4})
    expected = fflin.linearize(mounted, other).A
    changed_at_rest = fflin.configuration(changed, {"joint_2": 0.4})
    result = fflin.linearize(changed, changed_at_rest)
    np.testing.assert_allclose(result.A, expected, atol=1e-11 * np.abs(expected).max())
    assert fflin.check(changed, fflin.linearize(changed, q)).ok
