"""What a robot can do: limits of the URDF, of its inputs, and given ones."""

import math
from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.robot.fields import limits_of, magnitudes_of

INF = math.inf
AT = ("base", (0, 0, 0), (1, 0, 0))


def test_the_urdf_says_efforts_speeds_and_travels():
    robot = fflin.load("servicer_7dof")
    result = limits_of(robot)
    assert result["tau_m.joint_1"] == (-300.0, 300.0)
    assert result["qdot_m.joint_5"] == (-0.4, 0.4)
    low, high = result["q_m.joint_2"]
    assert (low, high) == pytest.approx((-2.094, 2.094), abs=1e-3)
    sizes = magnitudes_of(robot)
    assert sizes["q_m.joint_2"] == high - low
    assert fflin.linearize(robot).limits == sizes
    # What is no input has no limit as one.
    arm = robot.replace(inputs=robot.inputs[2:5])
    assert [name for name in limits_of(arm) if name.startswith("tau")] == [
        f"tau_m.joint_{k}" for k in (1, 2, 3)
    ]
    assert not limits_of(fflin.load("ets_vii"))


def test_limits_of_inputs_go_before_the_urdf_and_given_ones_before_both():
    robot = fflin.load("servicer_7dof").replace(
        inputs=[
            fflin.BaseTorque(max=40.0),
            fflin.BaseForce(max=(3, 2, 1), min=-0.5),
            fflin.JointTorque("joint_1", max=7.0, min=-2.0),
            fflin.JointTorque("joint_2"),
            fflin.Thruster(*AT, max=22.0),
            fflin.Thruster(*AT, name="main"),
            fflin.ReactionWheel(
                (0, 0, 1), inertia=0.03, max=0.2, max_speed=600.0, name="spin"
            ),
            fflin.ReactionWheel((0, 1, 0), momentum=1.0, max=0.1),
        ],
        limits={
            "q_m.joint_*": 1.0,
            "joint_2": (-5.0, 6.0),
            "omega_b": 0.1,
            "main": 4.0,
        },
    )
    result = limits_of(robot)
    assert result["tau_b.y"] == (-40.0, 40.0)
    assert [result[f"F_b.{axis}"] for axis in "xyz"] == [
        (-0.5, 3.0),
        (-0.5, 2.0),
        (-0.5, 1.0),
    ]
    assert result["tau_m.joint_1"] == (-2.0, 7.0)
    assert result["tau_m.joint_2"] == (-5.0, 6.0)
    assert result["thruster_1"] == (0.0, 22.0)
    assert result["main"] == (0.0, 4.0)
    assert result["spin"] == (-0.2, 0.2)
    assert result["qdot_m.spin"] == (-600.0, 600.0)
    assert result["wheel_2"] == (-0.1, 0.1)
    assert result["q_m.joint_7"] == (-1.0, 1.0)
    assert result["q_m.panel_left"] == (-0.6, 0.6)
    assert result["omega_b.z"] == (-0.1, 0.1)
    lin = fflin.linearize(robot)
    assert lin.limits["spin"] == 0.2
    assert lin.limits["thruster_1"] == 22.0
    assert lin.limits["F_b.x"] == 0.5
    # Given limits of what is gone say nothing, and count where it comes back.
    bare = robot.replace(inputs=[fflin.BaseTorque()])
    assert "main" not in limits_of(bare)
    assert "tau_b.x" not in limits_of(bare)
    assert limits_of(bare.replace(inputs=robot.inputs)) == result


def test_a_pattern_goes_before_a_group_and_a_name_before_both():
    limits = {"tau_m.joint_7": 1.0, "tau_m": 3.0, "joint_*": 2.0}
    result = limits_of(fflin.load("servicer_7dof", limits=limits))
    assert result["tau_m.joint_7"] == (-1.0, 1.0)
    assert result["tau_m.joint_1"] == (-2.0, 2.0)
    assert result["tau_m.panel_left"] == (-3.0, 3.0)


def test_the_group_of_all_joints_leaves_wheels_out():
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=0.03, max_speed=600.0, name="spin")
    robot = fflin.load("servicer_7dof", inputs=[wheel])
    result = limits_of(robot.replace(limits={"qdot_m": 0.5, "qdot_m.joint_*": 0.2}))
    assert result["qdot_m.panel_left"] == (-0.5, 0.5)
    assert result["qdot_m.joint_1"] == (-0.2, 0.2)
    assert result["qdot_m.spin"] == (-600.0, 600.0)
    assert limits_of(robot.replace(limits={"qdot_m.spin": 50}))["qdot_m.spin"] == (
        -50.0,
        50.0,
    )


def test_limits_are_kept_in_files_of_models(tmp_path):
    inputs = [fflin.BaseTorque(max=4.0), *fflin.load("cubesat").inputs[1:]]
    lin = fflin.linearize(fflin.load("cubesat", inputs=inputs))
    assert lin.limits == {f"tau_b.{axis}": 4.0 for axis in "xyz"}
    for ending in (".npz", ".mat", ".json"):
        lin.save(tmp_path / f"m{ending}")
        assert fflin.LinearModel.load(tmp_path / f"m{ending}").limits == lin.limits


def test_limits_make_no_second_input():
    with pytest.raises(fflin.InputError, match="twice"):
        fflin.load(
            "cubesat", inputs=[fflin.BaseForce(max=1.0), fflin.BaseForce(max=2.0)]
        )
    assert fflin.Thruster(*AT, max=2) == fflin.Thruster(*AT, max=2.0)
    assert replace(fflin.Thruster(*AT), max=2.0, on_off=True).on_off


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fflin.BaseTorque(max=-1.0), "base_torque"),
        (lambda: fflin.BaseTorque(max=(1, 0, 1)), "base_torque"),
        (lambda: fflin.BaseForce(max=(1, 2)), r"\(1, 2\)"),
        (lambda: fflin.JointTorque("a", max=1, min=2), "min"),
        (lambda: fflin.JointTorque("a", max=(1, 2, 3)), "joint_torque"),
        (lambda: fflin.JointTorque("a", max=math.nan), "nan"),
        (lambda: fflin.Thruster(*AT, max=1, min=-1), "-1"),
        (lambda: fflin.Thruster(*AT, on_off=True), "on_off"),
        (lambda: fflin.Thruster(*AT, on_off=True, max=2, min=1), "on_off.* min"),
        (lambda: fflin.Thruster(*AT, on_off="yes", max=2), "on_off"),
        (lambda: fflin.Thruster(*AT, least_impulse=0), "least_impulse"),
        (lambda: fflin.Thruster(*AT, torque=math.inf), "thruster torque"),
        (lambda: fflin.ReactionWheel((1, 0, 0), max_speed=3), "max_speed"),
        (
            lambda: fflin.ReactionWheel((1, 0, 0), inertia=1, max_speed=-3),
            "max_speed",
        ),
    ],
)
def test_invalid_limits_are_refused_in_one_line(make, message):
    with pytest.raises(fflin.InputError, match=message):
        make()


@pytest.mark.parametrize(
    ("limits", "error", "message"),
    [
        ({"nosuch": 1.0}, fflin.UnknownNameError, "'nosuch'"),
        ({"tau_b": -1.0}, fflin.InputError, "-1.0"),
        ({"tau_b": (2.0, 1.0)}, fflin.InputError, r"\(2.0, 1.0\)"),
        ({"tau_b": "much"}, fflin.InputError, "'much'"),
    ],
)
def test_invalid_limit_arguments_are_refused_in_one_line(limits, error, message):
    with pytest.raises(error, match=message):
        fflin.load("cubesat", limits=limits)


URDF = """<robot name="arm"><link name="base">{0}</link><link name="a">{0}</link>
  <link name="b">{0}</link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="a"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="0" velocity="0"/></joint>
  <joint name="elbow" type="revolute"><parent link="a"/><child link="b"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="0" velocity="2"/></joint>
</robot>""".format(
    '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    "</inertial>"
)


def test_efforts_and_velocities_of_zero_are_reported_once_and_ignored(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    with pytest.warns(fflin.FflinWarning) as messages:
        robot = fflin.load(path)
    message = [str(item.message) for item in messages]
    assert message == [
        "arm: effort 0 of joints 'hinge', 'elbow': no limit (or passive)",
        "arm: velocity 0 of joint 'hinge': no limit (or passive)",
    ]
    assert tuple(message) == robot.notes
    assert not {"tau_m.hinge", "tau_m.elbow", "qdot_m.hinge"} & set(limits_of(robot))
    assert limits_of(robot)["qdot_m.elbow"] == (-2.0, 2.0)
    path.write_text(
        URDF.replace('effort="0"', 'effort="3"').replace('velocity="0"', "")
    )
    assert not fflin.load(path).notes


def test_toml_files_have_limits(tmp_path):
    path = tmp_path / "inputs.toml"
    path.write_text(
        """
[[input]]
type = "base_torque"
max = 40
[[input]]
type = "base_force"
max = [3, 2, 1.5]
min = -1
[[input]]
type = "thruster"
frame = "base"
position = [0, 0, 0]
direction = [1, 0, 0]
max = 22
on_off = true
least_impulse = 0.1
torque = -0.02
[[input]]
type = "reaction_wheel"
axis = [0, 0, 1]
inertia = 1e-3
max = 0.2
max_speed = 600
"""
    )
    assert fflin.load_inputs(path) == (
        fflin.BaseTorque(max=40.0),
        fflin.BaseForce(max=(3.0, 2.0, 1.5), min=-1.0),
        fflin.Thruster(*AT, max=22.0, on_off=True, least_impulse=0.1, torque=-0.02),
        fflin.ReactionWheel((0, 0, 1), inertia=1e-3, max=0.2, max_speed=600.0),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("type = 'base_torque'\nmax = 'a'", ":3: .*'a'"),
        ("type = 'base_torque'\nmax = -2", ":3: .*base_torque"),
        ("type = 'joint_torque'\njoint = 'a'\nmax = [1, 2, 3]", ":4: .*max"),
        (
            "type = 'joint_torque'\njoint = 'a'\nmin = 3\nmax = 1",
            ":4: .*min",
        ),
        ("type = 'joint_torque'\njoint = 'a'\nlimit = 1", ":4: .*'l"),
    ],
)
def test_wrong_limits_in_toml_files_are_reported_with_their_line(
    tmp_path, text, message
):
    path = tmp_path / "inputs.toml"
    path.write_text(f"[[input]]\n{text}\n")
    with pytest.raises(fflin.FflinError, match=message):
        fflin.load_inputs(path)


def test_the_range_of_a_travel_may_be_open_or_one_sided(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        URDF.replace('lower="-1"', 'lower="0.5"', 1).replace('upper="1"', 'upper="inf"')
    )
    robot = fflin.load(path)
    assert limits_of(robot)["q_m.hinge"] == (0.5, INF)
    assert limits_of(robot)["q_m.elbow"] == (-1.0, INF)
    assert "q_m.elbow" not in magnitudes_of(robot)
    assert np.isfinite(list(fflin.linearize(robot).limits.values())).all()


def test_one_side_of_a_motor_leaves_the_other_to_the_urdf():
    robot = fflin.load("servicer_7dof")
    effort = limits_of(robot)["tau_m.joint_1"][1]
    limited = robot.replace(
        inputs=[fflin.JointTorque("joint_1", min=-1.0), fflin.BaseTorque()]
    )
    assert limits_of(limited)["tau_m.joint_1"] == (-1.0, effort)


def test_limits_of_groups_have_the_order_of_the_state():
    robot = fflin.load("planar_detumble")
    groups = {"qdot_m": 2.0, "q_m": 1.0}
    names = [name.partition(".")[0] for name in robot.replace(limits=groups).limits]
    assert names == ["q_m"] * robot.n + ["qdot_m"] * robot.n
