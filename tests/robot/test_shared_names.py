"""Names that Pinocchio does not tell apart: a link's and a joint's, a link's and the world's."""

import numpy as np
import pinocchio as pin
import pytest

import fflin

BODY = (
    '<inertial><origin xyz="0.1 0 0.05"/><mass value="2"/>'
    '<inertia ixx="0.3" ixy="0" ixz="0" iyy="0.4" iyz="0" izz="0.5"/></inertial>'
    '<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
)


def write(path, links, joints):
    """Write a chain of links; `joints` are names and types."""
    text = [f'<link name="{name}">{BODY}</link>' for name in links]
    for (name, kind), parent, child in zip(joints, links, links[1:], strict=False):
        text.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            '<origin xyz="0.3 0.1 0" rpy="0 0.4 0"/><axis xyz="0 0 1"/></joint>'
        )
    path.write_text(f'<robot name="shared">{"".join(text)}</robot>')
    return path


REVOLUTE, FIXED = "continuous", "fixed"
NAMES = [
    (("base", "arm", "tip"), (("arm", REVOLUTE), ("tip", REVOLUTE))),
    (("base", "a", "b"), (("b", REVOLUTE), ("a", REVOLUTE))),
    (("base", "a", "b"), (("b", FIXED), ("a", REVOLUTE))),
    (("universe", "a", "b"), (("j", REVOLUTE), ("k", REVOLUTE))),
    (("base", "universe", "b"), (("j", REVOLUTE), ("k", REVOLUTE))),
]


@pytest.mark.parametrize(("links", "joints"), NAMES)
def test_a_robot_with_shared_names_is_the_robot_with_others(tmp_path, links, joints):
    shared = fflin.load(write(tmp_path / "shared.urdf", links, joints))
    plain = (
        tuple(f"link {i}" for i in range(3)),
        tuple((f"joint {i}", k) for i, k in enumerate(kind for _, kind in joints)),
    )
    other = fflin.load(write(tmp_path / "other.urdf", *plain))
    q = fflin.configuration(other, dict.fromkeys(other.joint_names, 0.3))
    for name, twin in zip(links, plain[0], strict=True):
        made = []
        for whole, link in ((shared, name), (other, twin)):
            robot = whole.replace(
                inputs=[
                    fflin.Thruster(link, (0.0, 0.2, 1.0), (1.0, 0.0, 0.0)),
                    fflin.BaseTorque(),
                ],
                outputs=[fflin.FramePose(link)],
            )
            lin = fflin.linearize(robot, q)
            assert fflin.check(robot, lin).ok
            made.append(lin)
        for key in "ABCD":
            np.testing.assert_array_equal(getattr(made[0], key), getattr(made[1], key))
        np.testing.assert_array_equal(
            fflin.generalized_jacobian(shared, q, name),
            fflin.generalized_jacobian(other, q, twin),
        )


@pytest.mark.parametrize(("links", "joints"), NAMES)
def test_each_joint_of_a_robot_with_shared_names_can_be_locked(tmp_path, links, joints):
    path = write(tmp_path / "shared.urdf", links, joints)
    for name in fflin.load(path).joint_names:
        locked = fflin.load(path, lock={name: 0.4})
        assert {frame.name for frame in locked.model.frames.tolist()} >= set(links)
        for link in links:
            robot = locked.replace(outputs=[fflin.FramePose(link)])
            assert fflin.check(robot, fflin.linearize(robot)).ok


@pytest.mark.parametrize(("links", "joints"), NAMES)
def test_wheels_modes_and_payloads_are_mounted_on_links_with_shared_names(
    tmp_path, links, joints
):
    bare = fflin.load(write(tmp_path / "shared.urdf", links, joints))
    payload = fflin.load("planar_detumble")
    for link in links:
        wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), frame=link, inertia=0.01)
        array = fflin.FlexibleAppendage(
            link, 0.5, [[0.3], [0.0], [0.0]], [[0.0], [0.1], [0.0]]
        )
        robot = bare.replace(inputs=[wheel, fflin.BaseTorque()], appendages=[array])
        whole = fflin.capture(robot, link, payload).robot
        for made in (robot, whole):
            assert {frame.name for frame in made.model.frames.tolist()} >= set(links)
            assert fflin.check(made, fflin.linearize(made)).ok
        assert whole.n == robot.n + payload.n


@pytest.mark.parametrize(("links", "joints"), NAMES)
def test_a_robot_with_shared_names_is_shown(tmp_path, links, joints):
    robot = fflin.load(write(tmp_path / "shared.urdf", links, joints))
    robot = robot.replace(
        inputs=[
            fflin.Thruster(link, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)) for link in links
        ]
    )
    motion = fflin.simulate(robot, lambda t, q, v: np.ones(3), duration=0.1)
    for tool in (None, *links):
        page = tmp_path / "motion.html"
        fflin.visualize(robot, motion, html=page, open=False, tool=tool)
        assert page.stat().st_size > 1000


def test_the_world_is_not_a_tool(tmp_path):
    robot = fflin.load("planar_detumble")
    motion = fflin.simulate(robot, duration=0.1)
    with pytest.raises(fflin.UnknownNameError, match="'universe'"):
        fflin.visualize(
            robot, motion, html=tmp_path / "a.html", open=False, tool="universe"
        )


def test_info_names_a_link_called_universe(tmp_path, capsys):
    from fflin.commands.cli import main

    path = write(tmp_path / "shared.urdf", *NAMES[3])
    assert main(["info", str(path)]) == 0
    assert "universe, j, a, k, b" in capsys.readouterr().out


def test_reduced_models_keep_the_names_of_frames():
    robot = fflin.load("ets_vii")
    before = [frame.name for frame in robot.model.frames.tolist()]
    model = robot.model.copy()
    frame = pin.Frame("camera", 2, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME)
    model.addFrame(frame, False)
    locked = fflin.from_model(model, lock=["joint_3"])
    assert {*before, "camera"} == {frame.name for frame in locked.model.frames.tolist()}
    assert [frame.name for frame in model.frames.tolist()] == [*before, "camera"]
