"""The figures of a page: of what the motion has, in its units, each with its name and colour."""

import base64
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.view.page import subtitle
from fflin.view.pages import errors, panel
from tests.support.motions import led, settling
from tests.support.robots import random_pose


def floats(packed):
    return np.frombuffer(base64.b64decode(packed), dtype="<f4")


def charts(shown):
    """Return {title: {label: values}} of what a panel draws."""
    return {
        plot["title"]: {line["label"]: floats(line["values"]) for line in plot["lines"]}
        for plot in shown["plots"]
    }


def limits_drawn(shown):
    """Return {title: {label: limits}} of what a panel draws."""
    return {
        plot["title"]: {line["label"]: line["limits"] for line in plot["lines"]}
        for plot in shown["plots"]
    }


def every(motion):
    return np.arange(0, len(motion.t), 20)


def limited(motion, limits):
    """Return the motion with limits {name: (least, largest)}."""
    return replace(
        motion, limit_names=tuple(limits), limits=np.array(list(limits.values()))
    )


def test_errors_match_the_pose(robots):
    rng = np.random.default_rng(2)
    robot = robots["ets_vii"]  # its joints are continuous
    turns = dict(zip(robot.joint_names, (0.3, 3.0, -1.0, 0.0, 1.0, -3.0), strict=True))
    target = fflin.configuration(robot, turns, random_pose(rng, 50.0))
    step = np.concatenate(
        (rng.normal(size=3), np.radians(37.0) * np.array([0.6, 0, 0.8]))
    )
    v = np.concatenate((np.zeros(6), [0.1, 0.7, 0.2, 0, 0, -1.1]))
    q = pin.integrate(robot.model, target, v)
    base = pin.XYZQUATToSE3(target[:7]) * pin.SE3(pin.exp3(step[3:]), step[:3])
    q[:7] = pin.SE3ToXYZQUAT(base)
    result = errors(robot, np.array([target, q]), target[None], robot.wheels)
    np.testing.assert_allclose(result["attitude"][1], [0, 37.0], atol=1e-6)
    np.testing.assert_allclose(
        result["position"][1], [0, np.linalg.norm(step[:3])], atol=1e-12
    )
    np.testing.assert_allclose(
        result["largest joint"][1], np.degrees([0, 1.1]), atol=1e-7
    )
    assert "largest prismatic" not in result


def test_errors_from_a_moving_target_are_relative_to_the_same_instant(robots):
    robot = robots["ets_vii"]
    rng = np.random.default_rng(3)
    targets = np.array(
        [
            pin.integrate(robot.model, robot.neutral(), v)
            for v in rng.normal(size=(4, robot.nv))
        ]
    )
    step = np.concatenate(
        (np.zeros(3), np.radians(20.0) * np.array([0, 0.6, 0.8]), 0.2 * np.ones(6))
    )
    q = np.array(
        [pin.integrate(robot.model, item, s * step) for s, item in enumerate(targets)]
    )
    result = errors(robot, q, targets, robot.wheels)
    np.testing.assert_allclose(result["attitude"][1], [0, 20, 40, 60], atol=1e-6)
    np.testing.assert_allclose(
        result["largest joint"][1], np.degrees([0, 0.2, 0.4, 0.6]), atol=1e-7
    )


def test_metres_are_not_taken_for_degrees_nor_wheels_for_joints():
    robot = fflin.load("panda")  # its fingers slide
    robot = robot.replace(
        inputs=[*robot.inputs, fflin.ReactionWheel((0, 0, 1), inertia=1e-3)]
    )
    target = robot.neutral()
    q = fflin.configuration(robot, {"panda_joint2": -0.1, "panda_finger_joint1": 0.03})
    robot.joint("wheel_1").place(q, 2.0)
    result = errors(robot, np.array([q]), target[None], robot.wheels)
    assert result["largest joint"][1] == pytest.approx(np.degrees(0.1))
    assert result["largest prismatic"][1] == pytest.approx(0.03)
    motion = settling(robot, 1.0)
    shown = panel(robot, motion, every(motion), target[None])
    labels = {item["label"]: item["unit"] for item in shown["readouts"]}
    assert (
        labels["largest joint error"] == "deg"
        and labels["largest prismatic error"] == "mm"
    )
    assert subtitle(robot) == f"{robot.n - 1} joints, 1 wheel, 17.45 kg"


def test_a_free_flyer_alone_has_no_joint_error():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    motion = settling(robot, 1.0)
    shown = panel(robot, motion, every(motion), robot.neutral()[None])
    assert not any("joint" in item["label"] for item in shown["readouts"])
    assert subtitle(robot) == "0 joints, 3 wheels, 3.5 kg"


def test_plots_have_the_units_of_the_model():
    """Sliding joints are pushed, turning ones turned, and thrust is no torque."""
    robot = fflin.load("panda")
    assert {joint.prismatic for joint in robot.joints} == {True, False}
    more = [
        fflin.Thruster("panda_link0", (1, 0, 0), (0, 0, 1), "up"),
        fflin.ReactionWheel((0, 0, 1)),
    ]
    robot = robot.replace(inputs=[*robot.inputs, *more])
    motion = settling(robot, 1.0)
    shown = panel(robot, motion, every(motion), robot.neutral()[None])["plots"]
    expected = {
        ("base torque", "N m"),
        ("base force", "N"),
        ("joints", "deg"),
        ("prismatic joints", "mm"),
    }
    expected |= {("joint torques", "N m"), ("joint forces", "N")}
    expected |= {("thrusters", "N"), ("wheel torque", "N m")}
    assert {(plot["title"], plot["unit"]) for plot in shown[2:]} == expected
    drawn = charts({"plots": shown})
    for joint in robot.joints:
        source, by_key = (
            ("prismatic joints", "joint forces")
            if joint.prismatic
            else ("joints", "joint torques")
        )
        x = motion.x[every(motion), motion.state_names.index(f"q_m.{joint.name}")]
        u = motion.u[every(motion), motion.input_names.index(f"tau_m.{joint.name}")]
        factor = 1e3 if joint.prismatic else np.degrees(1.0)
        np.testing.assert_allclose(drawn[source][joint.name], factor * x, rtol=1e-6)
        np.testing.assert_allclose(drawn[by_key][joint.name], u, rtol=1e-6)


def test_wheels_have_separate_charts():
    """Speed, torque and momentum against saturation, and nothing of them among the joints."""
    wheels = [
        fflin.ReactionWheel((0, 0, 1), name=f"w{k}", inertia=1e-3 * k) for k in (1, 2)
    ]
    robot = fflin.load("planar_detumble")
    robot = robot.replace(inputs=[*robot.inputs, *wheels])
    motion = settling(robot, 1.0)
    x = motion.x.copy()
    speeds = [motion.state_names.index(f"qdot_m.w{k}") for k in (1, 2)]
    x[:, speeds] = np.outer(motion.t, [3.0, -5.0])
    motion = limited(
        replace(motion, x=x), {"qdot_m.w1": (-4.0, 4.0), "qdot_m.w2": (-99.0, 99.0)}
    )
    shown = panel(robot, motion, every(motion), np.zeros((0, robot.nq)))
    drawn, t = charts(shown), motion.t[every(motion)]
    np.testing.assert_allclose(drawn["wheel speed"]["w1"], 3.0 * t, rtol=1e-6)
    np.testing.assert_allclose(drawn["wheel momentum"]["w1"], 3e-3 * t, rtol=1e-6)
    np.testing.assert_allclose(drawn["wheel momentum"]["w2"], -10e-3 * t, rtol=1e-6)
    u = motion.u[every(motion), motion.input_names.index("w2")]
    np.testing.assert_allclose(drawn["wheel torque"]["w2"], u, rtol=1e-6)
    assert not {"w1", "w2"} & {*drawn["joints"], *drawn["joint torques"]}
    drawn = limits_drawn(shown)
    assert drawn["wheel speed"] == {"w1": [4.0], "w2": []}
    assert drawn["wheel momentum"] == {"w1": [pytest.approx(4e-3)], "w2": []}


@pytest.mark.parametrize("share", [0.32, 0.34, 1.2])
def test_a_limit_is_drawn_where_a_curve_comes_to_a_third_of_it(robots, share):
    robot = robots["planar_detumble"]
    motion = settling(robot, 1.0)
    names = [name for name in motion.input_names if name.startswith("tau_m")]
    at = [motion.input_names.index(name) for name in names]
    u = motion.u.copy()
    u[:, at] = -1.0 - np.arange(len(at))
    most = {name: (k + 1.0) / share for k, name in enumerate(names)}
    motion = limited(
        replace(motion, u=u), {name: (-x, np.inf) for name, x in most.items()}
    )
    shown = panel(robot, motion, every(motion), robot.neutral()[None])
    expected = {
        name.partition(".")[2]: [-x] * (share > 1 / 3) for name, x in most.items()
    }
    assert limits_drawn(shown)["joint torques"] == expected


def test_rates_of_joints_are_shown_where_they_come_near_a_limit(robots):
    robot = robots["planar_detumble"]
    motion = settling(robot, 1.0)
    x = motion.x.copy()
    x[:, motion.state_names.index(f"qdot_m.{robot.joint_names[0]}")] = -0.9 * motion.t
    motion = replace(motion, x=x)
    for limit, shown in ((3.0, False), (1.0, True)):
        name = f"qdot_m.{robot.joint_names[0]}"
        plots = panel(
            robot, limited(motion, {name: (-limit, limit)}), every(motion), motion.q[:1]
        )
        rates = limits_drawn(plots).get("joint rates")
        expected = {robot.joint_names[0]: [pytest.approx(-np.degrees(1.0))]}
        assert rates == (expected if shown else None)


def test_thrusters_that_never_fire_are_not_drawn():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    motion = settling(robot, 1.0)
    u = np.zeros_like(motion.u)
    fired = [motion.input_names.index(name) for name in ("x_plus_top", "z_minus_left")]
    u[:, fired] = (1.0, 2.0)
    u[:, motion.input_names.index("y_plus_back")] = 1e-9  # what an allocation leaves
    motion = replace(motion, u=u)
    plots = panel(robot, motion, every(motion), robot.neutral()[None])["plots"]
    (plot,) = (item for item in plots if item["title"] == "thrusters")
    assert [line["label"] for line in plot["lines"]] == ["x_plus_top", "z_minus_left"]
    assert [floats(line["values"])[3] for line in plot["lines"]] == [1.0, 2.0]


def test_without_a_target_nothing_is_called_an_error(robots):
    robot = robots["planar_detumble"]
    motion = settling(robot, 1.0)
    shown = panel(robot, motion, every(motion), np.zeros((0, robot.nq)))
    labels = [item["label"] for item in shown["readouts"]]
    titles = [item["title"] for item in shown["plots"]]
    assert labels[0] == titles[0] == "attitude change"
    assert not any("error" in text for text in labels + titles)
    expected = errors(robot, motion.q[every(motion)], motion.q[:1], motion.wheels)[
        "attitude"
    ][1]
    assert expected[0] < 1e-6 < 1.0 < expected[-1]
    np.testing.assert_allclose(
        charts(shown)[titles[0]][""], expected, rtol=1e-6, atol=1e-5
    )


def test_violations_are_reported_with_their_time(robots):
    robot = robots["planar_detumble"]
    motion = settling(robot, 1.0)
    name = f"tau_m.{robot.joint_names[0]}"
    u = np.zeros_like(motion.u)
    u[700:, motion.input_names.index(name)] = 3.0
    motion = limited(replace(motion, u=u), {name: (-2.0, 2.0)})
    ((text, time),) = panel(robot, motion, every(motion), motion.q[:1])["passed"]
    assert time == motion.t[700] and text == f"{name} 3 N m at 0.35 s, limit 2"


def test_references_include_joints_and_wheels():
    wheel = fflin.ReactionWheel((0, 0, 1), name="w", inertia=1e-3)
    robot = fflin.load("planar_detumble")
    robot = robot.replace(inputs=[*robot.inputs, wheel])
    motion = settling(robot, 1.0)
    x = motion.x.copy()
    x[:, motion.state_names.index("qdot_m.w")] = np.sin(motion.t)
    motion = led(replace(motion, x=x))
    rows = every(motion)
    goal = np.tile(robot.neutral(), (len(rows), 1))
    shown = panel(robot, motion, rows, goal)
    followed = {
        plot["title"]: {
            line["label"]: floats(line["reference"]) for line in plot["lines"]
        }
        for plot in shown["plots"]
    }
    for joint in robot.joint_names[:3]:
        expected = motion.target[rows, motion.state_names.index(f"q_m.{joint}")]
        expected = np.degrees(expected)
        np.testing.assert_allclose(followed["joints"][joint], expected, rtol=1e-6)
    speed = motion.target[rows, motion.state_names.index("qdot_m.w")]
    np.testing.assert_allclose(followed["wheel speed"]["w"], speed, rtol=1e-6)
    np.testing.assert_allclose(followed["wheel momentum"]["w"], 1e-3 * speed, rtol=1e-6)
    assert not any(item.size for item in followed["joint torques"].values())
    assert shown["rest"] == motion.t[-251]
    titles = [plot["title"] for plot in shown["plots"]]
    assert titles[:3] == ["attitude error", "position error", "largest joint error"]
    # Of a target that stands still nothing is said to be followed.
    shown = panel(robot, motion, rows, robot.neutral()[None])
    assert shown["rest"] is None
    assert not any(
        line["reference"] for plot in shown["plots"] for line in plot["lines"]
    )


@pytest.mark.parametrize(
    ("momentum", "center", "text"),
    [
        (9e-10, 9e-10, "momentum conserved"),
        (2e-9, 0.0, "momentum drifts by 2.0e-09"),
        (0.0, 2e-9, "centre of mass drifts by 2.0e-09 m"),
    ],
)
def test_one_mark_tells_whether_momentum_is_conserved(robots, momentum, center, text):
    robot = robots["planar_detumble"]
    motion = settling(robot, 1.0)
    rows = np.zeros(len(motion.t))
    rows[77] = 1.0
    motion = replace(motion, momentum_drift=momentum * rows, com_drift=center * rows)
    shown = panel(robot, motion, every(motion), motion.q[:1])
    assert not any("drift" in each["label"] for each in shown["readouts"])
    mark = shown["conserved"]
    assert (mark["holds"], mark["text"]) == (text == "momentum conserved", text)
    for drift in (f"{momentum:.1e}", f"{center:.1e} m"):
        assert drift in mark["details"]
    # From far away, a single unit of rounding is more.
    q = motion.q.copy()
    q[5, 0] = 1e4
    shown = panel(robot, replace(motion, q=q), every(motion), motion.q[:1])
    assert shown["conserved"]["holds"] is (momentum < 1e-9)


def test_lengths_are_in_mm_until_they_are_long(robots):
    robot = robots["planar_detumble"]
    motion = settling(robot, 1.0)
    for shift, unit, factor in ((3.0, "mm", 1e3), (30.0, "m", 1.0)):
        q = motion.q.copy()
        q[:, :3] = np.outer(motion.t, [0.0, shift, 0.0])
        shown = panel(robot, replace(motion, q=q), every(motion), q[:1])
        (readout,) = (x for x in shown["readouts"] if x["label"] == "position error")
        assert readout["unit"] == unit
        last = floats(readout["values"])[-1]
        assert last == pytest.approx(factor * shift)
