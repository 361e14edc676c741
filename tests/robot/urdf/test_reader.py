"""What the reader makes of a file: the model, the mimics, and what it has to say."""

import hashlib
import math
import threading
import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.commands.cli import main
from fflin.robot.urdf import reader as expansion
from fflin.robot.urdf.description import Mimic
from fflin.robot.urdf.reader import describe, ignored
from fflin.robot.urdf.xml import parse
from tests.support.messages import says
from tests.support.reader_corpus import (
    AXIS,
    INERTIA,
    INERTIAL,
    LIMIT,
    arm,
    inertial,
    joint,
    link,
    robot,
    three,
)


def read(document, name="robot.urdf"):
    raw = document if isinstance(document, bytes) else document.encode()
    return describe(raw, Path(name))


def hinge(document, name="robot.urdf"):
    """Return placement, axis and inertia beyond the one joint of a robot."""
    model = read(document, name).model
    data = model.createData()
    q = pin.neutral(model)
    jacobian = pin.computeJointJacobian(model, data, q, 2)
    return (
        model.jointPlacements[2].homogeneous,
        jacobian[:, 6:],
        model.inertias[2].matrix(),
    )


H = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("document", "meaning"),
    [
        (b"\xef\xbb\xbf" + arm().encode(), arm()),
        (arm().replace("\n", "\r\n").encode(), arm()),
        (arm(inside='<axis xyz="0 0 -2"/>'), arm(inside='<axis xyz="0 0 -1"/>')),
        (arm(inside='<axis xyz="3 0 4"/>'), arm(inside='<axis xyz="0.6 0 0.8"/>')),
        (arm(inside=""), arm(inside='<axis xyz="1 0 0"/>')),
        (
            arm(inside=f'{AXIS}<origin xyz="1 2 3" quat_xyzw="0 0 {H} {H}"/>'),
            arm(inside=f'{AXIS}<origin xyz="1 2 3" rpy="0 0 {math.pi / 2}"/>'),
        ),
        (
            # A pitch of 90 degrees, where roll and yaw are not unique; four digits of length.
            arm(inside=f'{AXIS}<origin quat_xyzw="0 0.7071 0 0.7071"/>'),
            arm(inside=f'{AXIS}<origin rpy="0 {math.pi / 2} 0"/>'),
        ),
        (
            arm(
                child=inertial(
                    "2",
                    INERTIA.replace('ixx="1"', 'ixx="1.5"'),
                    f'<origin quat_xyzw="{H} 0 {H} 0"/>',
                )
            ),
            arm(
                child=inertial(
                    "2",
                    INERTIA.replace('izz="1"', 'izz="1.5"'),
                    '<origin xyz="0 0 0"/>',
                )
            ),
        ),
        pytest.param(
            arm(child=inertial("${1 + 1}")),
            arm(child=inertial("2")),
            marks=pytest.mark.process,
        ),
    ],
    ids=[
        "byte order mark",
        "CRLF",
        "long axis",
        "askew axis",
        "axis by default",
        "quaternion",
        "quaternion of four digits",
        "quaternion of an inertia",
        "xacro",
    ],
)
def test_two_ways_to_say_the_same(document, meaning):
    if b"${" in (document if isinstance(document, bytes) else document.encode()):
        pytest.importorskip("xacrodoc")
    for result, expected in zip(hinge(document), hinge(meaning), strict=True):
        # Six digits of mass and inertia of order one, in double precision.
        np.testing.assert_allclose(result, expected, rtol=0, atol=1e-15)


def test_the_inertia_is_turned_by_the_quaternion():
    turned = INERTIA.replace('ixx="1"', 'ixx="1.5"')
    document = arm(child=inertial("2", turned, f'<origin quat_xyzw="0 0 {H} {H}"/>'))
    moments = read(document).model.inertias[2].inertia
    np.testing.assert_allclose(moments, np.diag((1.0, 1.5, 1.0)), atol=1e-15)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_without_a_limit_nothing_is_limited(kind):
    model = read(arm(kind=kind, inside=AXIS)).model
    assert model.lowerPositionLimit[7] < -1e300 and model.upperPositionLimit[7] > 1e300
    assert model.effortLimit[6] > 1e300 and model.velocityLimit[6] > 1e300


def test_half_a_limit_is_kept():
    model = read(arm(inside=AXIS + '<limit lower="-2" upper="3" effort="4"/>')).model
    assert (model.lowerPositionLimit[7], model.upperPositionLimit[7]) == (-2.0, 3.0)
    assert model.effortLimit[6] == 4.0 and model.velocityLimit[6] > 1e300


def test_the_root_joint_takes_a_free_name():
    document = robot(
        link("root_joint"), link("root_joint_"), joint("j", "root_joint", "root_joint_")
    )
    assert list(read(document).model.names) == ["universe", "root_joint__", "j"]


@pytest.mark.parametrize(
    ("attributes", "name"), [('name="kit"', "kit"), ("", "file"), ('name=" "', "file")]
)
def test_name_of_the_model(attributes, name):
    assert (
        read(robot(link("base"), attributes=attributes), "file.urdf").model.name == name
    )


def test_names_come_through_unchanged():
    name = "a <\u00e4> & \"b\" 'c'\n \U0001f916"
    escaped = name.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    document = arm().replace('"hinge"', f'"{escaped.replace(chr(10), "&#10;")}"')
    assert read(document).model.names[2] == name


def test_mimics_are_resolved_to_the_independent_leader():
    document = three(
        '<mimic joint="j2" multiplier="2" offset="0.5"/>',
        '<mimic joint="j3" multiplier="-3" offset="1"/>',
    )
    # j1 = 2 j2 + 0.5 = 2 (-3 j3 + 1) + 0.5
    assert read(document).mimics == {
        "j1": Mimic("j3", -6.0, 2.5),
        "j2": Mimic("j3", -3.0, 1.0),
    }


def test_mimics_in_the_other_order_resolve_alike():
    document = three(
        "", '<mimic joint="j1" offset="1"/>', '<mimic joint="j2" multiplier="4"/>'
    )
    assert read(document).mimics == {
        "j2": Mimic("j1", 1.0, 1.0),
        "j3": Mimic("j1", 4.0, 4.0),
    }


@pytest.mark.parametrize(
    ("kind", "multiplier", "counted"),
    [
        ("continuous", 0.5, True),
        ("continuous", 2.0, False),
        ("continuous", -1.0, False),
        ("revolute", 2.0, True),
        ("prismatic", 0.125, True),
    ],
)
def test_turns_of_a_continuous_leader_count(tmp_path, kind, multiplier, counted):
    follow = AXIS + f'<mimic joint="j" multiplier="{multiplier}" offset="0.25"/>'
    off_axis = (
        '<inertial><origin xyz="0.5 0.25 0"/>' + INERTIAL.partition("<inertial>")[2]
    )
    path = tmp_path / "r.urdf"
    path.write_text(
        robot(
            link("a"),
            link("b", off_axis),
            link("c", off_axis),
            joint("j", "a", "b", inside=AXIS + LIMIT),
            joint("k", "b", "c", kind, '<origin xyz="1 0 0"/>' + follow),
        )
    )
    loaded = fflin.load(path)
    (leader,) = loaded.joints
    (follower,) = loaded.followers
    assert leader.unbounded is not counted
    assert loaded.model.effortLimit[leader.idx_v] == 1.0
    if counted:
        assert loaded.model.upperPositionLimit[leader.idx_q] > 1e300

    state = fflin.StateMap(loaded)
    q = fflin.configuration(loaded, {"j": 4.0})
    x = np.zeros(state.nx)
    x[6], x[-1] = 4.0, 1.0
    np.testing.assert_allclose(state.to_pinocchio(x)[0], q, atol=1e-15)
    free = pin.neutral(loaded.model)
    leader.place(free, 4.0)
    follower.joint.place(free, 4.0 * multiplier + 0.25)
    np.testing.assert_allclose(q, free, atol=1e-12)
    dense = pin.crba(loaded.model, loaded.create_data(), free)
    dense = np.triu(dense) + np.triu(dense, 1).T
    np.testing.assert_allclose(
        fflin.linearize(loaded, q).M, state.S.T @ dense @ state.S, rtol=0, atol=1e-12
    )

    # Across pi, where the stored angle of a continuous joint jumps.
    x[6] = 3.0
    q, v = state.to_pinocchio(x)
    q = loaded.checked_configuration(pin.integrate(loaded.model, q, 0.5 * v))
    np.testing.assert_allclose(q, fflin.configuration(loaded, {"j": 3.5}), atol=1e-12)


def test_damping_and_friction_are_recorded_and_noted():
    result = read(arm(inside=AXIS + '<dynamics damping="0.25" friction="0.5"/>'))
    assert result.joints["hinge"].damping == 0.25
    texts = [note for _, _, note in ignored(result.joints, "arm")]
    assert ["damping" in text for text in texts] == [True, False]
    assert all("'hinge'" in text for text in texts)
    assert read(arm()).notes == (*ignored(read(arm()).joints, "arm"),) == ()


def test_notes_name_six_joints_and_count_the_rest():
    links = [link(f"l{k}") for k in range(9)]
    damped = AXIS + '<dynamics damping="1"/>'
    joints = [joint(f"j{k}", "l0", f"l{k}", inside=damped) for k in range(1, 9)]
    ((_, _, note),) = ignored(read(robot(*links, *joints)).joints, "robot")
    assert says(note, "'j1', 'j2', 'j3', 'j4', 'j5', 'j6'", "2 more")


def test_blanks_at_the_end_of_a_name_are_seen():
    with pytest.raises(fflin.UrdfError, match="base2"):
        read(robot(link("base "), link("base2"), joint("j", "base", "base2")))


def test_hash_is_of_the_file(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_bytes(arm().replace("\n", "\r\n").encode())
    assert fflin.load(path).urdf_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_load_warns_and_keeps_the_notes(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(arm(inside=AXIS + '<dynamics damping="1"/>'))
    with pytest.warns(fflin.FflinWarning, match="'hinge'") as caught:
        loaded = fflin.load(path)
    assert [warning.filename for warning in caught] == [__file__]
    assert loaded.notes == tuple(str(warning.message) for warning in caught)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fflin.FflinWarning)
        assert fflin.load(path).notes == loaded.notes


def test_damping_that_is_asked_for_is_not_warned_of(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(arm(inside=AXIS + '<dynamics damping="1" friction="2"/>'))
    with pytest.warns(fflin.FflinWarning) as caught:
        loaded = fflin.load(path, damping="urdf")
    (note,) = loaded.notes
    assert [str(warning.message) for warning in caught] == [note]
    assert "Coulomb friction" in note
    assert loaded.damping == {"hinge": 1.0}


def test_info_lists_the_warnings(tmp_path):
    from fflin.robot.summary import robot_info

    path = tmp_path / "r.urdf"
    path.write_text(arm(inside=AXIS + '<dynamics damping="1"/>'))
    with pytest.warns(fflin.FflinWarning):
        text = robot_info(fflin.load(path))
    assert says(text, "r: ", "'hinge'")


def test_info_lists_mimic_joints_and_their_children(tmp_path):
    from fflin.robot.summary import robot_info

    path = tmp_path / "r.urdf"
    path.write_text(three("", '<mimic joint="j1" multiplier="0.5" offset="-2"/>'))
    lines = robot_info(fflin.load(path)).splitlines()
    rows = [line for line in lines if line.lstrip().startswith("j")][-3:]
    assert [len(row) - len(row.lstrip()) for row in rows] == [2, 4, 6]
    assert "mimics j1 * 0.5 - 2" in rows[1]
    assert "continuous" in rows[2]


def test_without_xacrodoc_one_line_says_how(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "xacrodoc", None)
    with pytest.raises(fflin.MissingPackageError, match=r"'fflin\[xacro\]'"):
        read(arm(child=inertial("${1 + 1}")))
    with pytest.raises(fflin.MissingPackageError):
        read(arm(), "robot.xacro")
    read(arm())


@pytest.mark.process
@pytest.mark.parametrize(
    "endless",
    [
        inertial("${[None for i in range(10**15)]}"),
        inertial("${9**9**9}"),
        '<xacro:macro name="a" params="n"><xacro:if value="${n}"><xacro:a n="${n - 1}"/>'
        '<xacro:a n="${n - 1}"/></xacro:if></xacro:macro><xacro:a n="60"/>',
    ],
)
def test_a_xacro_without_end_is_one_line(endless, monkeypatch):
    """In Python, inside a call that holds the interpreter, and by macros."""
    pytest.importorskip("xacrodoc")
    monkeypatch.setattr(expansion, "XACRO_LIMIT", 1.0)
    with pytest.raises(fflin.UrdfError, match=r"xacro.* 1 s"):
        read(
            arm(
                child=endless,
                attributes='name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"',
            )
        )


@pytest.mark.process
def test_xacro_includes_from_its_own_folder(tmp_path):
    pytest.importorskip("xacrodoc")
    namespace = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts/arm.xacro").write_text(
        robot(inertial("3"), attributes=namespace)
    )
    path = tmp_path / "r.xacro"
    include = '<xacro:include filename="parts/arm.xacro"/>'
    for _ in range(2):  # nothing of the first expansion is left over
        path.write_text(arm(child=include, attributes=f'name="r" {namespace}'))
        assert describe(path.read_bytes(), path).model.inertias[2].mass == 3.0


def test_lines_of_elements():
    root = parse(b"<robot>\n\n<a\n b='1'/>\n<c><d/></c></robot>", "f")
    assert [(e.tag, e.line) for e in root.iterate()] == [("a", 3), ("c", 5), ("d", 5)]


def test_the_stack_size_of_threads_is_left_as_it_was():
    before = threading.stack_size()
    links = [link(f"l{k}") for k in range(200)]
    joints = [joint(f"j{k}", f"l{k}", f"l{k + 1}", "fixed") for k in range(199)]
    assert read(robot(*links, *joints)).model.inertias[1].mass == 200.0
    assert threading.stack_size() == before


def test_wrong_and_infinite_limits_are_ignored():
    for limit in (
        'lower="-inf" upper="inf" effort="inf"',
        'lower="" upper="-" effort="-1"',
    ):
        model = read(arm(inside=f"{AXIS}<limit {limit}/>")).model
        assert (
            model.lowerPositionLimit[7] < -1e300 and model.upperPositionLimit[7] > 1e300
        )
        assert model.effortLimit[6] > 1e300


def test_a_note_is_reported_once_for_all_its_lines():
    document = robot(
        *(link(name) for name in "abc"), joint("j", "a", "b"), joint("k", "a", "c")
    )
    (note,) = read(
        document.replace('<mass value="1"', '<mass unit="kg" value="1"')
    ).notes
    assert says(note, "robot.urdf:2: ", "'unit'", "<mass>", "2 more times")


def test_limit_given_is_the_limit():
    model = read(arm(inside=AXIS + LIMIT)).model
    assert (model.lowerPositionLimit[7], model.upperPositionLimit[7]) == (-1.0, 1.0)


def _with_an_argument(folder):
    """A xacro file whose arm has the mass of the argument `arm`, and a robot file that sets it."""
    namespace = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
    declared = '<xacro:arg name="arm" default="3"/>'
    path = folder / "r.xacro"
    path.write_text(
        arm(child=inertial("$(arg arm)"), attributes=f'name="r" {namespace}').replace(
            "<link", f"{declared}<link", 1
        )
    )
    toml = folder / "r.toml"
    toml.write_text('urdf = "r.xacro"\n[xacro]\narm = 5\n')
    return path, toml


@pytest.mark.process
def test_arguments_of_xacro_are_given_in_python_and_in_robot_files(tmp_path):
    pytest.importorskip("xacrodoc")
    path, toml = _with_an_argument(tmp_path)
    cases = {
        3.0: fflin.load(path),
        4.0: fflin.load(path, xacro={"arm": 4}),
        5.0: fflin.load(toml),
        6.5: fflin.load(toml, xacro={"arm": "6.5"}),
    }
    for mass, loaded in cases.items():
        assert loaded.model.inertias[2].mass == mass
    assert len({item.urdf_sha256 for item in cases.values()}) == 4
    with pytest.raises(fflin.UnknownNameError, match="arn"):
        fflin.load(path, xacro={"arn": 4})
    assert main(["info", str(path), "--xacro", "arm=4"]) == 0


def test_arguments_of_xacro_need_a_xacro_file(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(arm())
    with pytest.raises(fflin.InputError, match="does not use xacro"):
        fflin.load(path, xacro={"arm": 4})
    with pytest.raises(fflin.InputError, match="a text, a number or a boolean"):
        fflin.load(path, xacro={"arm": [4]})


def test_inertias_may_be_written_in_full():
    full = 'iyx="0.1" izx="0.2" izy="0.3" ixy="0.1" ixz="0.2" iyz="0.3"'
    written = '<inertia ixx="2" iyy="2" izz="2" {}/>'
    text = arm(child=inertial("1").replace(INERTIA, written.format(full)))
    inertia = read(text).links["arm"].inertia
    expected = [[2.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 2.0]]
    assert inertia.tolist() == expected
    with pytest.raises(fflin.UrdfError, match=r"izx .* is 0\.5, but ixz is 0\.2"):
        read(text.replace('izx="0.2"', 'izx="0.5"'))
