"""A joint that jams: momentum, the energy that goes, and the limit of a stiff brake."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.robots import LINKS, MIMIC, random_point

CASES = {
    "servicer_7dof": ["joint_3", "panel_left"],
    "ets_vii": "joint_2",
    "inspector.toml": "hinge_*",
}


def point(name, speed=0.2, **fields):
    robot = fflin.load(name, **fields)
    return (robot, *random_point(robot, np.random.default_rng(1), speed=speed)[:2])


def kinetic(robot, q, v):
    M = np.triu(pin.crba(robot.model, robot.create_data(), q.copy()))
    return 0.5 * v @ (M + np.triu(M, 1).T) @ v


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_momentum_is_kept_and_energy_lost(name):
    robot, q, v = point(name)
    result = fflin.jam(robot, CASES[name], q=q, v=v)
    size = np.abs(result.momentum).max()
    assert np.abs(result.momentum_after - result.momentum).max() < 1e-13 * size
    lost = kinetic(robot, q, v) - kinetic(result.robot, result.q, result.v)
    assert result.energy_lost == pytest.approx(lost, rel=1e-9) and lost > 0.0
    assert fflin.check(
        result.robot, fflin.linearize(result.robot, result.q, result.v)
    ).ok


def test_the_other_joints_are_free_and_the_impulse_is_on_the_jammed_one():
    robot, q, v = point("servicer_7dof")
    result = fflin.jam(robot, "joint_3", q=q, v=v)
    after = np.insert(result.v, 8, 0.0)  # joint_3 is the third
    M = pin.crba(robot.model, robot.create_data(), q)
    change = (np.triu(M) + np.triu(M, 1).T) @ (after - v)
    assert change[8] == pytest.approx(result.impulse[0])
    assert np.abs(np.delete(change, 8)).max() < 1e-12 * abs(change[8])
    assert result.event == "joint_3 jammed"
    assert "tau_m.joint_3" not in fflin.linearize(result.robot).input_names
    again = fflin.load("servicer_7dof", lock={"joint_3": float(q[9])})
    one, other = (fflin.linearize(item, result.q) for item in (result.robot, again))
    assert (
        one.state_names == other.state_names and np.abs(one.B - other.B).max() < 1e-15
    )


def test_it_is_the_limit_of_a_stiff_brake():
    """The joint's speed decays as exp(-t d/I): what is left of the way halves with 1/d."""
    robot, q, v = point("ets_vii", speed=0.05)
    result = fflin.jam(robot, "joint_2", q=q, v=v)

    def after(brake):
        time = 2e4 / brake
        braked = robot.replace(damping={"joint_2": brake})
        options = {"q0": q, "v0": v, "duration": time, "dt": time / 1000}
        return fflin.simulate(braked, None, **options).v[-1]

    slow, fast = (np.delete(after(brake), 7) for brake in (2e7, 4e7))
    errors = [np.abs(item - result.v).max() for item in (slow, fast)]
    jump = np.abs(result.v - np.delete(v, 7)).max()
    assert errors[1] < 0.02 * jump and 1.8 < errors[0] / errors[1] < 2.2
    assert np.abs(2.0 * fast - slow - result.v).max() < 0.1 * errors[1]


def test_a_wheel_that_seizes_gives_its_momentum_to_its_carrier():
    wheels = [fflin.ReactionWheel(axis, inertia=1e-3) for axis in np.eye(3)]
    robot = fflin.load("cubesat", inputs=[*wheels, fflin.BaseTorque()])
    robot = robot.replace(gravity=(0.0, 0.0, -1.0))
    v = fflin.velocity(robot, {"wheel_2": 300.0, "wheel_3": 10.0})
    result = fflin.jam(robot, "wheel_2", v=v)
    assert list(result.robot.wheels) == ["wheel_1", "wheel_3"]
    assert result.robot.gravity == (0.0, 0.0, -1.0)
    body = robot.model.inertias[1].inertia + 1e-3 * np.diag([1.0, 1.0, 1.0])
    assert result.v[4] == pytest.approx(0.3 / body[1, 1]) and result.impulse[0] < 0.0
    assert np.abs(result.momentum_after - result.momentum).max() < 1e-15


def test_fields_lose_the_entries_of_the_jammed_joint():
    robot = fflin.load(
        "ets_vii",
        stiffness=2.0,
        limits={"tau_m": 5.0, "q_m.joint_2": 1.0},
        weights={"q": {"q_m.joint_2": 4.0}},
        outputs=[
            fflin.JointPositions(("joint_2", "joint_3")),
            fflin.JointVelocities(("joint_2",)),
        ],
        passive=["joint_1", "joint_2"],
        start={"joints": {"joint_2": 0.3, "joint_3": 0.1}},
    )
    left = fflin.jam(
        robot, "joint_2", q=fflin.configuration(robot, {"joint_2": 0.3})
    ).robot
    assert left.locked == ("joint_2=0.3",) and left.passive == ("joint_1",)
    assert "joint_2" not in left.stiffness and len(left.stiffness) == 5
    assert not any("joint_2" in name for name in left.limits) and len(left.limits) == 4
    assert left.weights == {"q": {}} and left.start["joints"] == {"joint_3": 0.1}
    assert left.outputs == (fflin.JointPositions(("joint_3",)),)
    fflin.lqr(fflin.linearize(left.replace(passive=[])))


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_mimic_joints_stop_with_their_leader(tmp_path):
    mimic = '<mimic joint="b" multiplier="-2" offset="0.3"/>'
    document = MIMIC.format(
        links=LINKS, a="revolute", b="revolute", parent="base", mimic=mimic
    )
    (tmp_path / "r.urdf").write_text(document)
    robot = fflin.load(tmp_path / "r.urdf")
    q = fflin.configuration(robot, {"b": 0.4})
    v = fflin.velocity(robot, {"b": 0.5, "omega_b.z": 0.1})
    result = fflin.jam(robot, "b", q=q, v=v)
    assert result.robot.n == 0 and not result.robot.followers
    size = np.abs(result.momentum).max()
    assert np.abs(result.momentum - result.momentum_after).max() < 1e-13 * size
    assert result.energy_lost == pytest.approx(
        kinetic(robot, q, v) - kinetic(result.robot, result.q, result.v)
    )


def test_joints_of_the_payload_may_jam_too():
    robot, payload = fflin.load("ets_vii"), fflin.load("servicer_7dof")
    caught = fflin.capture(robot, "tool", payload)
    left = fflin.jam(caught.robot, "payload.panel_left", q=caught.q, v=caught.v)
    assert left.robot.n == caught.robot.n - 1
    from fflin.view.shapes import shapes

    assert len(shapes(left.robot)[0]) == len(shapes(caught.robot)[0])


@pytest.mark.parametrize(
    "payload", [pin.Inertia(5.0, np.zeros(3), np.eye(3)), "cubesat"]
)
def test_a_link_of_the_payload_never_replaces_a_whole_body(payload):
    """A model of other origin has no links, so the body that grasps keeps its own name."""
    model = fflin.load("planar_detumble").model
    robot = fflin.from_model(model)
    held = fflin.load(payload) if isinstance(payload, str) else payload
    caught = fflin.capture(robot, "hand", held).robot
    bodies = zip(caught.model.names, caught.model.inertias, strict=True)
    masses = {name: body.mass for name, body in bodies if body.mass}
    result = {name: piece.mass for name, piece in caught.pieces.items()}
    assert [*result] == ["base", *[*masses][1:]]
    assert [*result.values()] == [*masses.values()]
    heavier = caught.with_mass_properties({"joint_3": {"mass": 100.0}})
    assert heavier.mass == pytest.approx(caught.mass + 100.0 - result["joint_3"])


def test_a_joint_of_the_payload_keeps_its_spring():
    robot = fflin.load("ets_vii", stiffness=3.0)
    caught = fflin.capture(robot, "tool", robot.replace(stiffness=4.0))
    left = fflin.jam(caught.robot, "joint_2", q=caught.q, v=caught.v).robot
    assert left.stiffness["payload.joint_2"] == 4.0 and "joint_2" not in left.stiffness


def test_errors_are_one_line():
    robot = fflin.load("ets_vii")
    only = robot.replace(inputs=[fflin.JointTorque("joint_1")])
    for call, message in [
        (lambda: fflin.jam(robot, "elbow"), "elbow"),
        (lambda: fflin.jam(robot, []), "joints"),
        (lambda: fflin.jam("ets_vii", "joint_1"), "fflin.Robot"),
        (lambda: fflin.jam(robot, "joint_1", v=[1.0]), "v"),
        (lambda: fflin.jam(only, "joint_1"), "input"),
    ]:
        with pytest.raises(fflin.FflinError) as error:
            call()
        assert message in str(error.value) and "\n" not in str(error.value)
