"""What the report of a motion says first, and what stands in its table."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import fflin
from fflin.simulation.report import (
    _largest_forces,
    error_sizes,
    firings,
    motion_record,
    motion_report,
)
from tests.support.commands import run
from tests.support.marks import exhaustive
from tests.support.messages import says
from tests.support.motions import settling


def course(decay, *, robot="ets_vii", joint=0.5, **fields):
    """A motion whose attitude and first joint go with decay(t) from 20 degrees and `joint`."""
    robot = fflin.load(robot)
    made = settling(robot, 20.0)
    x = np.zeros_like(made.x)
    share = decay(made.t)
    x[:, 0] = np.sin(np.radians(20.0) / 2.0 * share)
    x[:, 6] = joint * share
    return replace(made, x=x, target=np.zeros(x.shape[1]), wheels=(), **fields)


def first(motion):
    """Return the headline, which may take several lines."""
    return " ".join(motion_report(motion).split(f"\n{motion.robot}:")[0].split())


def cells(motion, title):
    line = next(
        row for row in motion_report(motion).splitlines() if row.startswith(title + " ")
    )
    return line.removeprefix(title).split()


def test_a_settled_motion_reports_first_when_it_settled():
    motion = course(lambda t: np.exp(-t / 2.0))
    # 2 % of the largest is passed at 2 ln 50 = 7.82 s.
    assert first(motion).startswith("settled")
    assert says(first(motion), "7.83 s")
    assert cells(motion, "attitude") == ["deg", "20", "20", "0.000908", "7.83"]
    assert says(motion_report(motion), "ets_vii: 20 s", "2001 rows, frame hybrid")


@pytest.mark.parametrize(
    ("when", "settled"), [(18.9, True), (19.1, False), (20.5, False)]
)
def test_the_margin_is_two_percent_of_the_largest_error_for_the_last_twentieth(
    when, settled
):
    rate = math.log(50.0) / when
    motion = course(lambda t: np.exp(-rate * t))
    assert first(motion).startswith("settled" if settled else "not settled")
    assert ("not yet" in motion_report(motion)) is not settled


def test_a_motion_that_does_not_settle_reports_its_error():
    motion = course(lambda t: np.exp(-t / 10.0))
    assert says(first(motion), "not settled", "2.7 deg", "joints 3.9 deg")
    motion = course(lambda t: np.exp(-t), joint=0.0)
    x = motion.x.copy()
    x[:, 7] = 1e-3 * motion.t
    assert says(first(replace(motion, x=x)), "not settled", "joints 1.1 deg")


def test_the_headline_names_the_rates_that_the_table_calls_unsettled():
    motion = course(lambda t: np.exp(-t / 2.0))
    x = motion.x.copy()
    at = motion.state_names.index("omega_b.x")
    x[:, at] = 1e-3
    headline = " ".join(
        motion_report(replace(motion, x=x)).split("ets_vii:")[0].split()
    )
    assert headline.startswith("positions settled after 7.83")
    assert (
        says(headline, "not yet settled: omega_b 0.057 deg/s")
        and "joint rates" not in headline
    )
    assert cells(replace(motion, x=x), "omega_b")[-2:] == ["not", "yet"]
    # A rate that is not fed back never settles, and its row says so.
    loose = replace(motion, x=x, steered=("q_b.x", "q_m.joint_1"))
    assert first(loose).startswith("settled")
    assert cells(loose, "omega_b")[-2:] == ["not", "controlled"]


@pytest.mark.parametrize("size", [0.0, 1e-17, 1e-12])
def test_a_motion_that_leaves_its_target_only_by_rounding_has_settled(size):
    motion = course(lambda t: 0.0 * t)
    noise = size * np.random.default_rng(0).normal(size=motion.x.shape)
    motion = replace(motion, x=motion.x + noise)
    assert first(motion).startswith("settled") and says(first(motion), "target")
    assert "not yet" not in motion_report(motion)


def test_values_below_the_rounding_error_are_shown_as_zero():
    motion = course(lambda t: np.exp(-25.0 * t))
    assert 0.0 < motion.x[-1, 6] < 1e-199
    assert cells(motion, "joints") == ["deg", "28.6", "28.6", ".", "0.16"]


def test_a_stopped_motion_reports_the_reason_first():
    motion = course(lambda t: np.exp(-t), stopped="diverged at t = 20 s")
    assert says(first(motion), "diverged", "t = 20 s")
    free = fflin.simulate(
        fflin.load("ets_vii"), duration=1.0, dt=0.1, events=[lambda t, q, v: 0.45 - t]
    )
    assert says(first(free), "<lambda>", "t = 0.5 s")


def test_a_motion_without_a_target_has_no_verdict():
    report = motion_report(fflin.simulate(fflin.load("ets_vii"), duration=0.1))
    assert report.startswith("ets_vii: 0.1 s")
    assert not any(word in report for word in ("settled", "error", "largest inputs"))


def test_a_motion_without_a_target_tells_how_far_it_went():
    robot = fflin.load("ets_vii")
    v0 = fflin.velocity(
        robot, {"omega_b.z": 0.1, "v_b.x": 0.05, robot.joint_names[0]: 0.2}
    )
    motion = fflin.simulate(robot, v0=v0, duration=2.0)
    turned = np.degrees(2.0 * np.arcsin(np.linalg.norm(motion.x[:, :3], axis=1)))
    moved, swung = (
        np.abs(motion.x[:, part]).max(axis=1) for part in (slice(3, 6), slice(6, 12))
    )
    assert "change from the start" in motion_report(motion)
    swung = np.degrees(swung)
    for title, size in (("attitude", turned), ("position", moved), ("joints", swung)):
        assert cells(motion, title)[1:] == [f"{size.max():.3g}", f"{size[-1]:.3g}"]
    orbit = fflin.load("ets_vii", orbit=fflin.CircularOrbit(altitude=700e3))
    report = motion_report(fflin.simulate(orbit, v0=v0, duration=2.0))
    assert (
        "change from the start" in report and max(map(len, report.splitlines())) <= 80
    )


def test_no_line_is_longer_than_80_columns():
    orbit = fflin.CircularOrbit(altitude=700e3)
    motion = fflin.simulate(fflin.load("ets_vii", orbit=orbit), duration=0.1)
    long = replace(motion, energy=motion.energy - 0.000123456)
    report = motion_report(long)
    assert "Jacobi integral drift" in " ".join(report.split())
    assert max(map(len, report.splitlines())) <= 80


def pushed_by(*inputs, policy=True):
    """A cubesat beside its place and attitude, with the attitude alone controlled, or with all."""
    robot = fflin.load("cubesat", inputs=inputs)
    lin = fflin.linearize(robot)
    K = np.zeros((len(lin.u0), 12))
    K[:3, :3], K[:3, 6:9] = (
        np.diag(lin.M.diagonal()[:3]) * gain for gain in (2.0, 2.0)
    )
    law = fflin.LinearController(-K, lin) if policy else None
    x0 = np.zeros(12)
    x0[[0, 3, 9]] = 0.1, 0.01, 1e-4
    return fflin.simulate(robot, law, x0=x0, duration=30.0, target=lin)


@pytest.mark.exhaustive
def test_where_no_input_pushes_the_base_its_position_is_not_judged():
    motion = pushed_by(fflin.BaseTorque())
    message = " ".join(motion_report(motion).split("cubesat:")[0].split())
    assert message.startswith("settled") and says(message, "position")
    # In the headline, and in the rows of position and v_b.
    assert " ".join(motion_report(motion).split()).count("not controlled") == 3
    # Nor is it judged if the law does not feed it back, whatever pushes the base.
    jet = fflin.Thruster("base", (0, 0, 0), (1, 0, 0), "jet")
    for inputs in ((fflin.BaseTorque(), fflin.BaseForce()), (fflin.BaseTorque(), jet)):
        pushing = pushed_by(*inputs)
        assert first(pushing).startswith("settled")
        assert says(motion_report(pushing), "not controlled: position")


def test_wheels_are_not_joints():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    lin = fflin.linearize(robot)
    x = np.zeros(len(lin.x0))
    at = [lin.state_names.index(f"{group}.wheel_z") for group in ("q_m", "qdot_m")]
    x[at] = 60.0, 3.0
    motion = fflin.simulate(robot, x0=x, target=lin, duration=1.0)
    assert motion.x[-1, at[0]] == pytest.approx(63.0)
    report = motion_report(motion)
    assert "joint" not in report
    assert cells(motion, "wheel speeds") == ["rad/s", "3", "3", "3", "not", "yet"]
    assert first(motion).startswith("settled") and says(first(motion), "target")


def test_a_base_that_no_force_pushes_is_off_its_target_by_a_figure():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat")[-3:])  # wheels
    lin = fflin.linearize(robot)
    x0 = np.zeros(len(lin.x0))
    x0[3] = 1.0
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    message = motion_report(fflin.simulate(robot, policy, x0=x0, duration=1.0))
    assert says(
        message, "settled: attitude at the target", "not controlled: position 1 m;"
    )


def test_lengths_and_angles_of_joints_have_separate_rows():
    motion = course(lambda t: np.exp(-t))
    units = list(motion.state_units)
    units[motion.state_names.index("q_m.joint_2")] = "m"
    slides = replace(motion, state_units=tuple(units))
    rows = [
        row.split()[:2]
        for row in motion_report(slides).splitlines()
        if "joints " in row
    ]
    assert ["joints", "deg"] in rows and ["joints", "m"] in rows


def test_states_that_no_policy_controls_are_distinguished():
    steered = tuple(
        n for n in course(np.exp).state_names if n.startswith(("q_m", "qdot_m"))
    )
    motion = course(lambda t: np.exp(-t), steered=steered)
    x = motion.x.copy()
    x[:, 0] = np.sin(np.radians(15.0))
    message = first(replace(motion, x=x))
    assert message.startswith("settled") and says(
        message, "3.92 s", "not controlled: attitude 30 deg"
    )


def test_the_states_that_a_feedback_feeds_back_are_on_record():
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot)
    K = fflin.lqr(lin).K.copy()
    K[:, [lin.state_names.index(f"r_b.{axis}") for axis in "xyz"]] = 0.0
    motion = fflin.simulate(robot, fflin.StateFeedback(lin, K), duration=0.05)
    assert set(lin.state_names) - set(motion.steered) == {"r_b.x", "r_b.y", "r_b.z"}


def test_inputs_at_their_limits_all_along_are_named():
    motion = course(lambda t: np.exp(-t))
    t, u = motion.t, np.zeros_like(motion.u)
    u[:, 0], u[:, 1], u[:, 2] = 3.0, -3.0, np.where(t < 16.0, 3.0, 0.0)
    names = motion.input_names[:5]
    limits = np.array([[-3.0, 3.0], [-3.0, 3.0], [-3.0, 3.0], [0.0, 3.0], [0.0, 0.0]])
    motion = replace(motion, u=u, limit_names=names, limits=limits)
    message = motion_report(motion)
    assert says(message, "3.92 s", "tau_b.x (100 %), tau_b.y (100 %), tau_b.z (80 %)")
    assert says(message, "tau_b.y", "-3 N m", "100 %")
    assert says(message, "tau_b.z", "3 N m", "80 %")
    assert "F_b" not in message


def test_an_input_that_goes_from_limit_to_limit_is_at_its_limit_all_along():
    motion = course(lambda t: np.exp(-t / 10.0), joint=0.0)
    u = np.zeros_like(motion.u)
    u[:, 0], u[:1000, 1] = -3.0, 2.0  # all of the run, and half of it
    u[:1000, 0] = 3.0  # at the one limit or at the other
    names, limits = ("tau_b.x", "tau_b.y"), np.array([[-3.0, 3.0], [-2.0, 2.0]])
    message = first(replace(motion, u=u, limit_names=names, limits=limits))
    assert says(message, "not settled", "2.7 deg", "tau_b.x")


@pytest.mark.parametrize(
    ("options", "code", "begins"),
    [
        ((), 0, "simulate: settled: at the target throughout the run"),
        (("--rpy", 20, 0, 0), 0, "simulate: not settled: attitude "),
        (("--free",), 0, "simulate: planar_detumble: 2 s"),
        (
            ("--free", "--velocity", "joint_1=400000", "--dt", 0.01),
            1,
            "simulate: stopped: diverged at t = ",
        ),
    ],
)
def test_the_command_says_it_first_and_unsettled_is_not_a_failure(
    options, code, begins
):
    result, out, _ = run("simulate", "planar_detumble", "--duration", 2, *options)
    assert result == code
    assert out.splitlines()[0].startswith(begins)
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.exhaustive
@pytest.mark.parametrize("duration", [10.0, 30.0, *exhaustive(40.0, 50.0, 60.0)])
def test_a_robot_that_passes_through_its_target_has_not_settled(duration):
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot)
    x0 = np.zeros(12)
    x0[8] = 2.0 * np.pi / 60.0
    tumbling = fflin.simulate(robot, None, x0=x0, duration=60.0, target=lin)
    assert first(tumbling).startswith("not settled: attitude")
    K = np.zeros((6, 12))
    K[2, 2] = 2.0 * lin.M[2, 2] * (2.0 * np.pi / 40.0) ** 2  # a spring and no damper
    x0 = np.zeros(12)
    x0[2] = 0.05
    swinging = fflin.simulate(
        robot, fflin.StateFeedback(lin, K), x0=x0, duration=duration
    )
    assert first(swinging).startswith("not settled: attitude")


@pytest.mark.exhaustive
def test_a_wheel_at_its_largest_speed_is_reported_and_its_angle_is_not_a_difference():
    wheels = [
        fflin.ReactionWheel(axis, inertia=3e-6, max_speed=60.0, name=name)
        for name, axis in zip("abc", np.eye(3).tolist(), strict=True)
    ]
    robot = fflin.load("cubesat", inputs=wheels)
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin, weights="identity").K)
    q0 = fflin.configuration(robot)
    q0[3:7] = [np.sin(1.2), 0.0, 0.0, np.cos(1.2)]
    motion = fflin.simulate(
        robot, policy, q0=q0, duration=60.0, limits="urdf", linear=lin
    )
    (full,) = [item for item in motion.saturated if item.name == "qdot_m.a"]
    speed = np.abs(motion.x[:, motion.state_names.index("qdot_m.a")])
    share = (
        np.diff(motion.t, append=motion.t[-1:])[speed >= 60.0 * (1.0 - 1e-3)].sum()
        / 60.0
    )
    assert full.share == pytest.approx(share) and share > 0.1
    assert says(motion_report(motion), "a at", f"{full.limit:.3g} rad/s")
    assert "linear model" in motion_report(motion) and "q_m." not in motion_report(
        motion
    )


@pytest.mark.parametrize("every", [1, 10])
@pytest.mark.parametrize("speed", [300.0, 500.0, -900.0])
def test_the_angle_of_a_fast_wheel_counts_all_its_turns(speed, every):
    wheel = fflin.ReactionWheel((1, 0, 0), inertia=3e-6, name="fast")
    robot = fflin.load("cubesat", inputs=[wheel, fflin.BaseTorque()])
    v0 = fflin.velocity(robot, {"fast": speed})
    motion = fflin.simulate(robot, v0=v0, duration=10.0, every=every)
    angle = motion.x[:, motion.state_names.index("q_m.fast")]
    np.testing.assert_allclose(angle, speed * motion.t, rtol=1e-6, atol=1e-9)


def test_a_printed_motion_is_its_report():
    motion = fflin.simulate(fflin.load("cubesat"), duration=0.1)
    assert str(motion) == motion_report(motion) != repr(motion)


def test_errors_of_one_title_in_two_units_are_both_in_the_record():
    # seven revolute joints, and a prismatic one in the gripper
    robot = fflin.load("panda")
    lin = fflin.linearize(robot)
    q0 = fflin.configuration(robot, {"panda_joint1": 0.1, "panda_finger_joint1": 0.01})
    law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    motion = fflin.simulate(robot, law, q0=q0, duration=0.1, dt=0.01)
    errors = motion_record(motion)["errors"]
    assert [errors[f"joints [{unit}]"].initial for unit in ("rad", "m")] == [0.1, 0.01]
    assert errors["position"].unit == "m"
    assert len(errors) == len(error_sizes(motion))


def test_the_headline_states_how_near_the_target_an_error_stays():
    """0.12 deg that stay for good are within 2 % of 20 deg, and the headline says so."""
    decays = course(lambda t: np.exp(-t / 2.0), joint=0.0)
    assert says(first(decays), "to within 0.4 deg (attitude) of the target")
    assert not says(motion_report(decays), "remaining") and not says(
        motion_report(decays), "drifting"
    )
    stays = course(lambda t: np.maximum(np.exp(-t), 0.006), joint=0.0)
    assert says(motion_report(stays), "remaining: attitude 0.12 deg")
    cycle = course(
        lambda t: np.exp(-2.0 * t) + 0.006 * np.abs(np.sin(2.0 * t)), joint=0.0
    )
    assert says(
        motion_report(cycle), "remaining: attitude"
    ) and "drifting" not in motion_report(cycle)
    drifts = course(lambda t: np.exp(-2.0 * t) + 5e-4 * t, joint=0.0)
    assert says(motion_report(drifts), "drifting: attitude 0.2 deg")


def on_off(**fields):
    """A motion of a cubesat whose thruster of 1 N fires three pulses, of 0.1, 0.2 and 0.4 s."""
    jet = fflin.Thruster(
        "base", (0, 0, 0), (1, 0, 0), "jet", max=1.0, on_off=True, **fields
    )
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), jet])
    idle = np.zeros(4)
    motion = fflin.simulate(
        robot, lambda t, q, v: idle, duration=2.0, dt=0.01, sample=0.1
    )
    u = motion.u.copy()
    for start, rows in ((10, 10), (50, 20), (100, 40)):
        u[start : start + rows, 3] = 1.0
    return replace(motion, u=u)


def test_pulses_of_a_thruster_are_counted_and_are_no_saturation():
    report = motion_report(on_off(isp=100.0))
    # 0.7 N s of an exhaust of 980.665 m/s.
    assert says(report, "impulse 0.7 N s in 3 pulses, propellant 0.000714 kg")
    motion = on_off()
    assert not motion.saturated and says(
        motion_report(motion), "impulse 0.7 N s in 3 pulses"
    )
    assert "propellant" not in motion_report(motion)
    rare = replace(motion, step=0.002)  # every fifth step is recorded
    assert "pulses" not in str(firings(rare)) and firings(
        rare
    ).impulse == pytest.approx(0.7)
    with pytest.raises(fflin.InputError, match="isp"):
        fflin.Thruster("base", (0, 0, 0), (1, 0, 0), isp=-1.0)


def test_thrusters_without_pulses_saturate():
    jet = fflin.Thruster("base", (0, 0, 0), (1, 0, 0), "jet", max=1.0)
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), jet])
    motion = fflin.simulate(
        robot, lambda t, q, v: [0, 0, 0, 9.0], duration=1.0, limits="urdf"
    )
    assert [item.name for item in motion.saturated] == ["jet"]
    assert says(
        motion_report(motion), "impulse 1 N s"
    ) and "pulses" not in motion_report(motion)


def test_no_line_on_a_constraint_exceeds_80_characters():
    motion = SimpleNamespace(
        constraint_names=tuple(
            f"gripper_of_the_left_arm/handle_of_target.{kind}.{axis}"
            for kind in ("force", "torque")
            for axis in "xyz"
        ),
        constraint_forces=np.tile(np.array([3.0, 0.0, 4.0, 0.0, 0.5, 0.0]), (2, 1)),
    )
    (line,) = _largest_forces(motion)
    assert max(map(len, line.splitlines())) <= 80
    assert "5 N; largest torque: 0.5 N m" in " ".join(line.split())
