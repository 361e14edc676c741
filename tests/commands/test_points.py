"""Operating point, target and start of a robot file, as the commands use them."""

import json

import numpy as np
import pytest

import fflin
from tests.support.commands import refused, run, warned

SAT = """
urdf = "servicer_7dof"
[stiffness]
"panel_*" = 100
[point]
rpy = [0, 0, 30]
position = [1, 2, 3]
joints = { joint_2 = 0.6, joint_4 = -0.8 }
[target]
joints = { joint_2 = 0.9 }
[start]
rpy = [0, 0, 40]
"""


@pytest.fixture
def sat(tmp_path):
    (tmp_path / "sat.toml").write_text(SAT)
    return tmp_path


def pose(robot, degrees, **joints):
    half = np.radians(degrees) / 2.0
    q = fflin.configuration(robot, joints)
    q[:7] = 1.0, 2.0, 3.0, 0.0, 0.0, np.sin(half), np.cos(half)
    return q


def test_a_file_gives_point_target_and_start_by_full_names(sat):
    robot = fflin.load(sat / "sat.toml")
    assert robot.point["joints"] == {"joint_2": 0.6, "joint_4": -0.8}
    assert robot.target == {"joints": {"joint_2": 0.9}}
    moved = robot.replace(
        point={"velocity": {"joint_1": 0.1}}, target={"rpy": (1, 2, 3)}
    )
    assert moved.point == {"velocity": {"qdot_m.joint_1": 0.1}}
    assert moved.target == {"rpy": (1.0, 2.0, 3.0)} and moved.start == robot.start
    locked = fflin.load(sat / "sat.toml", lock=["joint_2"])
    assert locked.point["joints"] == {"joint_4": -0.8} and locked.target["joints"] == {}
    for field in ("point", "target"):
        with pytest.raises(fflin.InputError, match=f"{field} rpy"):
            robot.replace(**{field: {"rpy": [1, 2]}})
        with pytest.raises(fflin.UnknownNameError, match=f"part of {field}"):
            robot.replace(**{field: {"joint": {}}})
    # functions are about their arguments
    assert not fflin.linearize(robot).q[7:][::2][0]


@pytest.mark.parametrize("command", ["linearize", "lqr"])
def test_commands_are_about_the_point(sat, command):
    kind = {"linearize": fflin.LinearModel, "lqr": fflin.Gain}[command]
    code, _, err = run(command, "sat.toml", "-o", "m.npz", cwd=sat)
    assert code == 0, err
    made, robot = kind.load(sat / "m.npz"), fflin.load(sat / "sat.toml")
    lin = fflin.linearize(robot, pose(robot, 30, joint_2=0.6, joint_4=-0.8))
    np.testing.assert_array_equal(made.A, lin.A)
    code, _, err = run(
        command, "sat.toml", "--joint", "joint_2=0.1", "-o", "m.npz", cwd=sat
    )
    lin = fflin.linearize(robot, pose(robot, 30, joint_2=0.1, joint_4=-0.8))
    np.testing.assert_array_equal(kind.load(sat / "m.npz").A, lin.A)


def simulated(folder, *options):
    code, _, err = run(
        "simulate", "sat.toml", "--duration", 1, "-o", "m.npz", *options, cwd=folder
    )
    assert code in (0, 1), err
    return fflin.Motion.load(folder / "m.npz")


def goal_of(motion):
    """Return q (nq,) of the motion's target."""
    state = fflin.StateMap(motion.robot, reference=motion.reference, frame=motion.frame)
    return state.to_pinocchio(motion.target)[0]


@pytest.mark.exhaustive
def test_simulate_goes_from_start_to_target(sat):
    robot = fflin.load(sat / "sat.toml")
    motion = simulated(sat)
    start = pose(robot, 40, joint_2=0.6, joint_4=-0.8)
    np.testing.assert_allclose(motion.q[0], start, atol=1e-12)
    np.testing.assert_array_equal(fflin.simulate(robot, duration=0.1).q[0], motion.q[0])
    assert motion.attitude_error[0] == pytest.approx(10.0)
    state = fflin.StateMap(robot, reference=motion.reference)
    goal = pose(robot, 30, joint_2=0.9, joint_4=-0.8)
    np.testing.assert_allclose(state.to_pinocchio(motion.target)[0], goal, atol=1e-12)


@pytest.mark.exhaustive
def test_target_options_override_the_file(sat):
    options = ("--target-rpy", 0, 0, 35, "--target-position", 1, 2, 3.5)
    motion = simulated(sat, *options, "--target-joint", "joint_4=-0.7")
    assert motion.attitude_error[0] == pytest.approx(5.0)
    x = dict(zip(motion.state_names, motion.x[0] - motion.target, strict=True))
    assert x["r_b.z"] == pytest.approx(-0.5) and x["q_m.joint_4"] == pytest.approx(-0.1)
    assert x["q_m.joint_2"] == pytest.approx(-0.3)
    assert "--target-rpy" in refused(
        *("simulate", "sat.toml", "--orbit", 5e5, "--relative-equilibrium"),
        *("--target-rpy", 0, 0, 1),
        cwd=sat,
    )
    assert "--target-rpy" in refused(
        "simulate", "sat.toml", "--free", *options[:4], cwd=sat
    )


@pytest.mark.exhaustive
def test_a_gain_holds_the_base_at_the_target(sat):
    assert run("lqr", "sat.toml", "-o", "gain.npz", cwd=sat)[0] == 0
    motion = simulated(sat, "--gain", "gain.npz")
    assert motion.attitude_error[0] == pytest.approx(10.0)
    x = dict(zip(motion.state_names, motion.x[0] - motion.target, strict=True))
    assert abs(x["r_b.z"]) < 1e-12 and x["q_m.joint_2"] == 0.0
    world = ("--reference", "world", "-o", "gain.npz")
    assert run("lqr", "sat.toml", *world, cwd=sat)[0] == 0
    assert simulated(sat, "--gain", "gain.npz").attitude_error[0] == pytest.approx(10.0)
    options = ("--gain", "gain.npz", "--target-rpy", 0, 0, 1)
    assert "--target-rpy" in refused("simulate", "sat.toml", *options, cwd=sat)


def test_sweep_is_about_the_point(sat):
    for points in (("--grid", "joint_2=0:1:2"), ("--random", 2)):
        code, _, err = run("sweep", "sat.toml", *points, "-o", "s.npz", cwd=sat)
        assert code == 0, err
        batch = fflin.LinearBatch.load(sat / "s.npz")
        robot = fflin.load(sat / "sat.toml")
        np.testing.assert_allclose(
            batch.q[:, :7], [pose(robot, 30)[:7]] * 2, atol=1e-12
        )
        if points[0] == "--grid":
            ends = [pose(robot, 30, joint_2=x, joint_4=-0.8) for x in (0.0, 1.0)]
            np.testing.assert_allclose(batch.q, ends, atol=1e-12)


def test_uncertain_is_about_the_point_at_rest(sat):
    path = sat / "sat.toml"
    path.write_text(
        path.read_text().replace("[target]", "velocity = { joint_1 = 0.1 }\n[target]")
    )
    code, _, err = run(
        "uncertain", "sat.toml", "--vary", "base.mass=0.1", "-o", "u.npz", cwd=sat
    )
    assert code == 0, err
    robot = fflin.load(path)
    lft = fflin.uncertain(robot, {"base.mass": 0.1}).lft(
        pose(robot, 30, joint_2=0.6, joint_4=-0.8)
    )
    np.testing.assert_allclose(fflin.LFT.load(sat / "u.npz").A, lft.A, atol=1e-14)


def test_none_removes_the_orbit_of_a_file_and_the_regulator_holds_in_it(tmp_path):
    """The base torque holds the gravity gradient at the default point, without any option."""
    path = tmp_path / "arm.toml"
    path.write_text('urdf = "servicer_7dof"\norbit = 550e3\n[start]\nrpy = [1, 0, 0]\n')
    for option, orbit in (((), True), (("--orbit", "none"), False)):
        code, out, _ = run("simulate", path, "--duration", "2", *option, "--json")
        assert code == 0 and (json.loads(out)["frame"] == "lvlh") is orbit
    design = json.loads(run("lqr", path, "--json")[1])
    assert np.abs(design["u0"]).max() > 1e-9
    robot = fflin.load(path)
    held = fflin.equilibrium(robot)
    assert design["u0"] == pytest.approx(held.u, rel=1e-9, abs=1e-15)
    assert "'no' is not a number" in refused("lqr", path, "--orbit", "no")


def falling_without_tilt(folder):
    """Write a robot whose centre of mass is aside, held up by a thrust and a base torque."""
    path = folder / "hover.toml"
    path.write_text(
        'urdf = "planar_detumble"\ngravity = [0, 0, -1]\n'
        '[[input]]\ntype = "base_torque"\n'
        '[[input]]\ntype = "thruster"\nframe = "base"\nposition = [0, 0, 0]\n'
        "direction = [0.1, 0, 1]\n"
        '[[input]]\ntype = "joint_torque"\njoint = "*"\n'
    )
    return path


@pytest.mark.parametrize("command", ["linearize", "equilibrium", "lqr", "simulate"])
def test_an_option_keeps_the_attitude_of_an_equilibrium(tmp_path, command):
    path = falling_without_tilt(tmp_path)
    options = [] if command in ("equilibrium", "simulate") else ["--equilibrium"]
    if command == "simulate":
        options = ["--equilibrium", "--duration", 1]
    code, _, err = run(command, path, *options)
    assert code == 0, err
    err = refused(command, path, *options, "--no-tilt")
    assert "cannot balance the forces" in err and "F_b" in err


def test_the_gain_of_lqr_keeps_the_attitude_only_if_asked(tmp_path):
    path = falling_without_tilt(tmp_path)
    assert run("lqr", path)[0] == 0
    assert "F_b.x" in refused("lqr", path, "--no-tilt")


def test_inputs_beyond_their_limits_are_named_at_the_operating_point(tmp_path):
    weak = tmp_path / "weak.toml"
    weak.write_text('urdf = "servicer_7dof"\ngravity = [0, 0, -1]\n[limits]\nF_b = 5\n')
    robot = fflin.load(weak)
    held = fflin.equilibrium(robot)
    force = held.u[held.input_names.index("F_b.z")]
    (message,) = warned("linearize", weak, "--equilibrium")
    assert f"F_b.z = {force:.3g} N (limits -5 to 5 N)" in message
    (message,) = warned("check", weak, "--effort", "F_b.x=6", "--effort", "F_b.y=5")
    assert "F_b.x = 6 N (limits -5 to 5 N)" in message and "F_b.y" not in message
    with pytest.warns(fflin.FflinWarning, match="beyond their limits: F_b.x = 6 N"):
        fflin.effort(robot, {"F_b.x": 6.0})
    assert warned("linearize", weak, "--effort", "F_b.x=4") == set()


def test_all_missing_keys_of_a_thruster_are_named_at_once(tmp_path):
    path = tmp_path / "thrust.toml"
    path.write_text('urdf = "cubesat"\n[[input]]\ntype = "thruster"\nframe = "base"\n')
    err = " ".join(refused("info", path).split())
    assert "the keys position, direction are missing; add these keys" in err
    assert "position = [0, 0, 0] is the origin of the frame" in err


def test_the_option_for_a_tilt_is_refused_where_it_has_no_effect(tmp_path):
    path = falling_without_tilt(tmp_path)
    gain = tmp_path / "gain.npz"
    assert run("lqr", path, "-o", gain)[0] == 0
    for option in ("--tilt", "--no-tilt"):
        err = refused("simulate", path, "--gain", gain, option)
        assert f"remove {option}" in err


@pytest.mark.parametrize("option", ["--tilt", "--no-tilt"])
@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("linearize", ["--equilibrium"]),
        ("equilibrium", []),
        ("lqr", []),
        ("simulate", ["--duration", 1]),
    ],
)
def test_the_option_for_a_tilt_is_refused_without_gravity(command, options, option):
    err = " ".join(refused(command, "planar_detumble", *options, option).split())
    assert "'planar_detumble' has no gravity" in err and f"remove {option}" in err


def test_the_option_for_a_tilt_needs_an_equilibrium(tmp_path):
    path = falling_without_tilt(tmp_path)
    for command in ("linearize", "check", "modes"):
        err = refused(command, path, "--no-tilt")
        assert "without --equilibrium" in err and "remove --no-tilt" in err
    assert "remove --tilt" in refused("simulate", path, "--free", "--tilt")
