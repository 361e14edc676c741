"""MJCF files of MuJoCo: constraints, springs, motors, and what is not modelled."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.commands import refused, run

PENDULUM = """<mujoco model="pendulum">
  <compiler angle="radian"/>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="rod">
      <joint name="pivot" axis="0 1 0" stiffness="3" damping="0.2"/>
      <inertial pos="0 0 -0.5" mass="2" diaginertia="0.1 0.1 0.01"/>
    </body>
  </worldbody>
</mujoco>"""

BARS = """<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="l1" pos="0 0 1">
      <joint name="j1" axis="0 1 0"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .5 0 0" mass="1"/>
      <body name="l2" pos=".5 0 0">
        <joint name="j2" axis="0 1 0"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .3 0 .4" mass="1"/>
      </body>
    </body>
    <body name="l3" pos="1 0 1">
      <joint name="j3" axis="0 1 0" armature="0.1"/>
      <geom type="capsule" size=".03" fromto="0 0 0 -.2 0 .4" mass="1"/>
    </body>
  </worldbody>
  <equality><connect name="pin" body1="l3" body2="l2" anchor="-.2 0 .4"/></equality>
  <actuator>
    <motor joint="j1" gear="2" ctrlrange="-1 3" ctrllimited="true"/>
    <position joint="j3"/>
  </actuator>
</mujoco>"""

TWIN = """<mujoco model="twin">
  <compiler angle="radian"/>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="bus" pos="0 0 1">
      <freejoint name="root"/>
      <inertial pos="0 0 0" mass="20" diaginertia="2 3 4"/>
      <body name="a1" pos="0.3 0 0">
        <joint name="ja" axis="0 1 0"/>
        <inertial pos="0.3 0 0" mass="2" diaginertia=".01 .1 .1"/>
        <body name="a2" pos="0.6 0 0">
          <joint name="jb" axis="0 1 0"/>
          <inertial pos="0.2 0 0" mass="1" diaginertia=".01 .1 .1"/>
          <site name="tip" pos="0.4 0 0.3"/>
        </body>
      </body>
      <body name="b1" pos="0.3 0 0.8">
        <joint name="jc" axis="0 1 0"/>
        <inertial pos="0.3 0 0" mass="2" diaginertia=".01 .1 .1"/>
        <site name="end" pos="1.0 0 -0.5"/>
      </body>
    </body>
  </worldbody>
  <equality>{}</equality>
</mujoco>"""


def load(tmp_path, text, name="robot.xml", **fields):
    path = tmp_path / name
    path.write_text(text)
    return fflin.load(path, **fields)


def test_a_fixed_root_is_a_weld_of_the_base(tmp_path):
    robot = load(tmp_path, PENDULUM)
    assert [item.title for item in robot.constraints] == ["world"]
    lin = fflin.linearize(robot)
    assert lin.state_names == ("q_m.pivot", "qdot_m.pivot")
    # inertia 0.1 + m l^2, stiffness 3 + m g l
    inertia = 0.1 + 2 * 0.25
    A = [[0, 1], [-(3 + 2 * 9.81 * 0.5) / inertia, -0.2 / inertia]]
    np.testing.assert_allclose(lin.A, A, atol=1e-12)
    np.testing.assert_allclose(lin.B[:, -1], (0, 1 / inertia), atol=1e-12)
    assert fflin.check(robot, lin).ok


def test_several_bodies_of_the_world_form_a_closed_loop(tmp_path):
    with pytest.warns(fflin.FflinWarning) as caught:
        robot = load(tmp_path, BARS)
    assert [str(item.message) for item in caught] == [
        "robot.xml: not modelled: contacts of geoms; 1 actuator other than motors "
        "(position)"
    ]
    lin = fflin.linearize(robot)
    assert (lin.rank, len(lin.state_names)) == (8, 2)
    assert fflin.check(robot, lin).ok
    assert robot.passive == ("j2",)
    assert [item.joint for item in robot.inputs] == ["j1", "j3"]
    assert robot.inputs[0].ranges == ((-2.0, 6.0),)
    # l1 and l3 have equal lengths 0.5 and sqrt(0.2), so the loop is no parallelogram, but
    # at this posture C has the ratios of a planar loop of three hinges.
    rates = dict(zip(lin.output_names, lin.C[:, 0], strict=True))
    q = fflin.configuration(robot, {"j1": 1e-6})
    closed = fflin.closed(robot, q)
    slope = closed[7:] / closed[7]
    expected = [rates[f"q_m.{name}"] for name in ("j1", "j2", "j3")]
    np.testing.assert_allclose(slope, np.array(expected) / expected[0], rtol=1e-5)


EQUALITIES = {
    "connect": '<connect name="loop" body1="a2" body2="b1" anchor="0.4 0 0.3"/>',
    "weld": '<weld name="loop" body1="a2" body2="b1"/>',
    "relpose": '<weld name="loop" body1="a2" body2="b1" relpose="-0.6 0 0.8 1 0 0 0"/>',
    "sites": '<connect name="loop" site1="tip" site2="end"/>',
    "world": '<connect name="loop" body1="bus" anchor="0 0 0"/>',
}


@pytest.mark.parametrize("kind", EQUALITIES)
def test_equalities_of_a_free_robot_are_closed_at_the_start(tmp_path, kind):
    robot = load(tmp_path, TWIN.format(EQUALITIES[kind]))
    (item,) = robot.constraints
    assert item.title == "loop"
    assert isinstance(
        item, fflin.Weld if "weld" in EQUALITIES[kind] else fflin.Spherical
    )
    q = fflin.configuration(robot, base=pin.SE3(np.eye(3), np.array((0.0, 0.0, 1.0))))
    lin = fflin.linearize(robot, q)
    assert fflin.check(robot, lin).ok


def test_anchors_agree_with_those_of_pinocchio(tmp_path):
    robot = load(tmp_path, TWIN.format(EQUALITIES["connect"]))
    _, points, _ = pin.buildModelAndConstraintsFromMJCF(str(tmp_path / "robot.xml"))
    (item,) = robot.constraints
    frame = robot.model.frames[robot.model.getFrameId(item.frame)]
    np.testing.assert_allclose(
        frame.placement.translation, points[0].joint2_placement.translation, atol=1e-15
    )
    np.testing.assert_allclose(
        item.placement.translation, points[0].joint1_placement.translation, atol=1e-15
    )


def test_an_inactive_equality_is_ignored(tmp_path):
    text = EQUALITIES["weld"].replace("/>", ' active="false"/>')
    assert not load(tmp_path, TWIN.format(text)).constraints


def test_one_warning_lists_what_is_not_modelled(tmp_path):
    text = TWIN.format('<joint joint1="ja" joint2="jb"/>')
    more = """<tendon><fixed name="t"><joint joint="ja" coef="1"/></fixed></tendon>
    <contact><exclude body1="a1" body2="b1"/></contact></mujoco>"""
    with pytest.warns(fflin.FflinWarning) as caught:
        load(tmp_path, text.replace("</mujoco>", more))
    assert [str(item.message) for item in caught] == [
        "robot.xml: not modelled: tendons; contact pairs; equality constraints other than "
        "connect and weld (joint)"
    ]


def test_motors_of_a_free_robot_have_limits(tmp_path):
    motors = """<actuator><motor joint="jb" gear="-5" ctrlrange="-2 1"/>
    <motor joint="ja" ctrlrange="-1 1" ctrllimited="false"/></actuator></mujoco>"""
    robot = load(tmp_path, TWIN.format("").replace("</mujoco>", motors))
    limits = {item.joint: (item.min, item.max) for item in robot.inputs[2:]}
    assert limits == {"ja": (None, None), "jb": (-5.0, 10.0)}
    assert robot.inputs[:2] == (fflin.BaseTorque(), fflin.BaseForce())
    assert set(robot.passive) == {"jc", "jd"} & set(robot.joint_names)


def test_motors_in_default_classes_are_in_the_warning(tmp_path):
    text = TWIN.format("").replace(
        "<worldbody>", '<default><motor gear="2"/></default><worldbody>'
    )
    with pytest.warns(fflin.FflinWarning, match="gear and ctrlrange of motors in"):
        load(tmp_path, text)


def test_a_robot_file_may_name_an_mjcf_file(tmp_path):
    (tmp_path / "robot.xml").write_text(TWIN.format(EQUALITIES["connect"]))
    robot = load(tmp_path, 'urdf = "robot.xml"\ngravity = [0, 0, -1.62]\n', "moon.toml")
    assert robot.name == "moon"
    assert robot.gravity == (0.0, 0.0, -1.62)
    assert len(robot.constraints) == 1


def test_the_armature_is_kept_on_a_fixed_base(tmp_path):
    with pytest.warns(fflin.FflinWarning):
        robot = load(tmp_path, BARS)
    assert robot.model.armature[robot.joint("j3").idx_v] == 0.1


def test_a_command_reads_the_file(tmp_path):
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM)
    code, out, _ = run("linearize", path)
    assert code == 0
    assert "A (2 x 2)" in out


def test_included_files_are_read_as_one_file(tmp_path):
    whole = tmp_path / "whole.xml"
    whole.write_text(BARS)
    start = BARS.index('<body name="l1"')
    end = BARS.index("</worldbody>")
    (tmp_path / "parts").mkdir()
    bodies = BARS[start:end]
    (tmp_path / "parts" / "bodies.xml").write_text(
        f"<mujocoinclude>{bodies}</mujocoinclude>"
    )
    # Paths are relative to the main file, also in an included file.
    (tmp_path / "parts" / "all.xml").write_text(
        '<mujocoinclude><include file="parts/bodies.xml"/></mujocoinclude>'
    )
    split = tmp_path / "split.xml"
    split.write_text(f'{BARS[:start]}<include file="parts/all.xml"/>{BARS[end:]}')
    with pytest.warns(fflin.FflinWarning, match="not modelled"):
        one, two = fflin.load(whole), fflin.load(split)
    assert two.joint_names == one.joint_names
    lin, again = (fflin.linearize(robot) for robot in (one, two))
    np.testing.assert_array_equal(again.A, lin.A)
    assert [item.title for item in two.constraints] == ["world", "pin"]


def test_an_error_in_an_included_file_names_that_file(tmp_path):
    (tmp_path / "part.xml").write_text("<mujocoinclude><body></mujocoinclude>")
    path = tmp_path / "whole.xml"
    path.write_text('<mujoco><include file="part.xml"/></mujoco>')
    with pytest.raises(fflin.UrdfError, match=r"part\.xml.*not well-formed"):
        fflin.load(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PENDULUM[:90], "not well-formed XML"),
        (PENDULUM.replace('"2"', '"two"'), "Pinocchio cannot build the model"),
        ("<mujoco><include file='a.xml'/></mujoco>", "cannot be read: No such file"),
        ("<mujoco><include/></mujoco>", "<include> has no attribute file"),
        (
            "<mujoco><include file='bad.xml'/></mujoco>",
            "includes the file 'bad.xml' twice",
        ),
        ("<mujoco><replicate/></mujoco>", "<replicate> is not supported"),
        (
            TWIN.format('<weld body1="a2" body2="c"/>'),
            "body2 is 'c', which the file does not define",
        ),
        (
            TWIN.format('<weld body2="a2"/>'),
            "body1 is '', expected a moving body; swap the bodies",
        ),
        (
            TWIN.format("").replace("</worldbody>", '<body name="other"/></worldbody>'),
            "a free joint in a file with several bodies",
        ),
        (
            PENDULUM.replace('axis="0 1 0"', 'type="ball"'),
            "is a Spherical of 3 degrees of freedom, expected 1",
        ),
    ],
)
def test_bad_files_give_one_clear_line(tmp_path, text, message):
    path = tmp_path / "bad.xml"
    path.write_text(text)
    line = refused("linearize", path)
    assert message in line
    assert line.count("\n") == 1
