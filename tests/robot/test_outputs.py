"""C, D and y0 in the chart and the frame: by `check`, by laws, and that `check` can fail."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.summary import robot_info
from tests.support.robots import FRAMES, mostly, random_point, random_pose


def watched(robot, frame):
    """A robot with every kind of output, and inputs that turn."""
    return robot.replace(
        outputs=[
            fflin.Accelerometer(frame),
            fflin.JointVelocities((robot.joint_names[1],)),
            fflin.FramePose(frame),
            fflin.BasePose(),
            fflin.FrameVelocity(frame),
            fflin.CenterOfMass(),
            fflin.Gyroscope(frame),
            fflin.JointPositions(),
            fflin.Momentum(),
        ],
        inputs=[
            fflin.Thruster(frame, (0.1, 0.2, 0.3), (1, 2, 3)),
            fflin.BaseTorque(),
            fflin.BaseForce(),
        ],
        gravity=(0.2, -0.3, -1.6),
        stiffness=2.0,
        damping=0.3,
    )


@pytest.mark.parametrize(
    "turned", [False, True], ids=["own reference", "turned reference"]
)
@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize(
    ("name", "link"),
    [
        pytest.param("servicer_7dof", "tool", marks=pytest.mark.exhaustive),
        ("ets_vii", "link_4"),
        pytest.param("dual_arm", "tool_left", marks=pytest.mark.exhaustive),
        ("panda", "panda_leftfinger"),
    ],
)
def test_check_holds_with_every_output(name, link, frame, turned):
    rng = np.random.default_rng(1)
    bare = fflin.load(name)
    robot = watched(bare, link)
    q, v, _ = random_point(bare, rng)
    reference = random_pose(rng, 100.0) if turned else None
    u = rng.normal(size=7) * 10
    lin = fflin.linearize(robot, q, v, u, frame=frame, reference=reference)
    assert lin.D.any()
    result = fflin.check(robot, lin)
    assert result.ok, result


@pytest.mark.parametrize("first", mostly(range(6), 0))
@pytest.mark.parametrize("matrix", ["C", "D", "y0"])
def test_planted_error_is_detected_in_every_row(matrix, first):
    bare = fflin.load("planar_detumble")
    robot = watched(bare, "hand")
    q, v, _ = random_point(bare, np.random.default_rng(2))
    lin = fflin.linearize(robot, q, v, np.ones(7))
    rows = (
        np.flatnonzero(np.abs(lin.D).max(axis=1))
        if matrix == "D"
        else range(len(lin.y0))
    )
    assert len(rows) >= 3
    for row in rows[first::6]:
        wrong = getattr(lin, matrix).copy()
        if matrix == "y0":
            wrong[row] += 1e-5 * max(1.0, np.abs(lin.y0).max())
        else:
            wrong[row, np.abs(wrong[row]).argmax()] *= -1.0
        result = fflin.check(robot, replace(lin, **{matrix: wrong}))
        (failure,) = result.failures
        assert failure.block in {
            f"{matrix} ({output.WORD})" for output in robot.outputs
        }
        assert str(result).startswith(f"{failure.block} is not verified: 1 of ")


def test_outputs_follow_their_laws():
    """Sums and rates that hold between outputs, states and inputs."""
    bare = fflin.load("servicer_7dof")
    robot = bare.replace(
        outputs=[
            fflin.CenterOfMass(),
            fflin.Momentum(),
            fflin.FramePose("tool"),
            fflin.FrameVelocity("tool"),
        ]
    )
    q, v, u = random_point(bare, np.random.default_rng(3))
    lin = fflin.linearize(robot, q, v, u)
    C = dict(zip(lin.output_names, lin.C, strict=True))
    y = dict(zip(lin.output_names, lin.y0, strict=True))
    for axis in "xyz":
        # Momentum is mass times the rate of the centre of mass: its rate along f0, and in C, the
        # slope over a velocity of that over the position it changes.
        assert C[f"com.{axis}"] @ lin.f0 * bare.mass == pytest.approx(
            y[f"momentum.linear.{axis}"], rel=1e-11, abs=1e-9
        )
        assert C[f"tool.position.{axis}"] @ lin.f0 == pytest.approx(
            y[f"tool.velocity.{axis}"], abs=1e-11
        )
        # The force on the base, and nothing inside, is the rate of the momentum.
        assert C[f"momentum.linear.{axis}"] @ lin.f0 == pytest.approx(
            u[3 + "xyz".index(axis)], abs=1e-8
        )
        assert C[f"momentum.linear.{axis}"] @ lin.B[:, 6:] == pytest.approx(
            np.zeros(9), abs=1e-10
        )


def test_sampled_model_keeps_its_outputs(tmp_path):
    bare = fflin.load("cubesat")
    robot = bare.replace(outputs=[fflin.Gyroscope("base"), fflin.Accelerometer("base")])
    lin = fflin.linearize(robot)
    assert lin.output_names == tuple(
        f"base.{k}.{x}" for k in ("gyroscope", "acceleration") for x in "xyz"
    )
    assert lin.output_units == ("rad/s",) * 3 + ("m/s^2",) * 3
    assert lin.D[3:, 3:] == pytest.approx(np.eye(3) / bare.mass, rel=1e-12)
    assert (lin.discretize(0.1).D == lin.D).all()
    lin.save(tmp_path / "m.npz")
    loaded = fflin.LinearModel.load(tmp_path / "m.npz")
    assert fflin.check(robot, loaded).ok
    with pytest.raises(fflin.InputError, match=r"base\.gyroscope\.x"):
        fflin.check(bare, loaded)


def test_invalid_outputs_are_reported():
    robot = fflin.load("servicer_7dof")
    for words, outputs in {
        "'tol'": [fflin.FramePose("tol")],
        "twice": [fflin.CenterOfMass(), fflin.CenterOfMass()],
        "output": [],
        "'tool'": ["tool"],
    }.items():
        with pytest.raises(fflin.FflinError, match=words):
            fflin.linearize(robot.replace(outputs=outputs))


def test_pose_of_the_base_link_is_the_base_pose():
    robot = fflin.load("cubesat", outputs=[fflin.FramePose("base"), fflin.BasePose()])
    q = fflin.configuration(robot, base=random_pose(np.random.default_rng(4), 50.0))
    lin = fflin.linearize(robot, q, reference=pin.SE3.Identity())
    assert lin.y0[:3] == pytest.approx(lin.x0[3:6], abs=1e-15)
    chart = fflin.StateMap(robot).chart(q)
    assert lin.C[3:6, :3] == pytest.approx(chart.J, rel=1e-13)


def test_both_frames_of_an_output_must_be_there(robots):
    with pytest.raises(fflin.UnknownNameError, match="'nope'"):
        robots["servicer_7dof"].replace(outputs=[fflin.RelativePose("tool", "nope")])


def test_reports_of_a_robot_show_the_fields_of_sensors_and_the_lags_of_inputs():
    outputs = [
        fflin.StarTracker(
            sample=0.25, delay=0.2, noise={"noise_equivalent_angle": 10.0}
        ),
        fflin.Gyroscope("base", lag=0.1, noise=1e-5, bias={"bias_instability": 1.0}),
    ]
    inputs = [fflin.BaseTorque(lag=0.3)]
    robot = fflin.load("cubesat", inputs=inputs, outputs=outputs)
    text = " ".join(robot_info(robot).split())
    assert (
        "outputs: star_tracker (sample 0.25 s, delay 0.2 s, noise noise_equivalent_angle 10), "
        "gyroscope:base (lag 0.1 s, noise 1e-05, bias bias_instability 1)" in text
    )
    assert "inputs (lag 0.3 s): tau_b" in text
    card = robot._repr_html_()
    assert "noise_equivalent_angle 10" in card
    assert "lag [s]" in card
    assert "lag [s]" not in fflin.load("cubesat")._repr_html_()


def test_reports_of_a_robot_show_the_pulses_of_thrusters():
    fields = {"on_off": True, "least_impulse": 0.05, "isp": 220.0, "lag": 0.02}
    fast = fflin.Thruster("base", (0, 0, 0), (1, 0, 0), "main", max=22.0, **fields)
    others = [
        fflin.Thruster("base", (0, 0, 0.1), axis, max=1.0, isp=60.0)
        for axis in ((1, 0, 0), (-1, 0, 0))
    ]
    plain = fflin.Thruster("base", (0, 0, 0.2), (0, 1, 0), "plain", max=1.0)
    robot = fflin.load("cubesat", inputs=[fast, *others, plain])
    report = robot_info(robot)
    assert max(map(len, report.splitlines())) <= 80
    text = " ".join(report.split())
    given = "on-off, least impulse 0.05 N s, isp 220 s, lag 0.02 s"
    assert f"inputs ({given}): main inputs" in text
    assert "inputs (isp 60 s): thruster_2, thruster_3" in text
    assert "plain" not in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"noise": {"noise_equivalent_angel": 8.0}}, "part of 'noise' of star_tracker"),
        ({"bias": {"angle_random_walk": 0.1}}, "part of 'bias' of star_tracker"),
    ],
)
def test_unknown_figures_of_a_data_sheet_are_refused(arguments, message):
    with pytest.raises(fflin.UnknownNameError, match=message):
        fflin.StarTracker(**arguments)


@pytest.mark.parametrize(
    ("figure", "message"),
    [
        (
            "noise = { noise_equivalent_angle = -8.0 }",
            "'noise_equivalent_angle' in 'noise' of star_tracker is -8 arc seconds, expected more",
        ),
        (
            "noise = { angle_random_walk = 0.01 }",
            "'angle_random_walk', which is for outputs in rad/s, but the unit",
        ),
        (
            "bias = { bias_instability = 0.5 }",
            "'bias_instability', which is for outputs in rad/s",
        ),
    ],
)
def test_a_wrong_figure_in_a_robot_file_is_refused_with_its_line(
    tmp_path, figure, message
):
    path = tmp_path / "sat.toml"
    path.write_text(f'urdf = "cubesat"\n[[output]]\ntype = "star_tracker"\n{figure}\n')
    with pytest.raises(fflin.InputError) as error:
        fflin.load(path)
    assert message in str(error.value)
    assert re.match(r"\S*sat\.toml:4: output 1: ", str(error.value))


def test_a_single_name_or_pattern_of_joints_is_a_list_of_one(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_text(
        'urdf = "planar_detumble"\n[[output]]\ntype = "rates"\njoints = "joint_*"\n'
    )
    (rates,) = fflin.load(path).outputs
    assert rates == fflin.JointVelocities(("joint_*",))
    assert fflin.ConstraintForce("clamp", "force.x").components == ("force.x",)
    with pytest.raises(fflin.InputError, match=r'joints is 3, .* \["wheel_\*"\]'):
        fflin.JointVelocities(3)
