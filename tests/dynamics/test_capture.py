"""A rigid grasp: momentum, the weld, the energy lost, and the limit of a stiff one."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.robots import LINKS, MIMIC, random_point, random_pose

DEBRIS = pin.Inertia(500.0, np.array([0.1, 0.2, 0.3]), np.diag([100.0, 120.0, 90.0]))
CASES = {
    "servicer_7dof": ("tool", DEBRIS),
    "planar_detumble": ("hand", DEBRIS),
    "ets_vii": ("tool", "planar_detumble"),
    "inspector.toml": ("gripper", "ets_vii"),
}


def grasped(name, seed=0, speed=0.2):
    rng = np.random.default_rng(seed)
    frame, payload = CASES[name]
    robot = fflin.load(name)
    q, v, _ = random_point(robot, rng, speed=speed)
    options = {"q": q, "v": v, "placement": random_pose(rng, 70.0)}
    options["payload_v"] = speed * rng.standard_normal(6)
    if isinstance(payload, str):
        payload = fflin.load(payload)
        options["payload_q"], options["payload_v"], _ = random_point(
            payload, rng, speed=speed
        )
    return (
        robot,
        frame,
        payload,
        options,
        fflin.capture(robot, frame, payload, **options),
    )


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_momentum_is_kept_and_energy_lost(name):
    *_, result = grasped(name)
    size = np.abs(result.momentum).max()
    assert np.abs(result.momentum_after - result.momentum).max() < 1e-13 * size
    assert result.energy_lost > 0.0
    assert fflin.check(
        result.robot, fflin.linearize(result.robot, result.q, result.v)
    ).ok


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_weld_is_closed_and_the_impulse_changes_both(name):
    robot, frame, payload, options, result = grasped(name)
    whole = result.robot
    data = whole.create_data()
    pin.forwardKinematics(whole.model, data, result.q, result.v)
    pin.updateFramePlacements(whole.model, data)
    local = pin.ReferenceFrame.LOCAL
    grasp, held = (
        whole.model.getFrameId(item, pin.FrameType.BODY) for item in (frame, "payload")
    )
    relative = data.oMf[grasp].actInv(data.oMf[held])
    assert relative.isApprox(options["placement"], 1e-12)
    twist = pin.getFrameVelocity(whole.model, data, held, local)
    from_grasp = relative.actInv(pin.getFrameVelocity(whole.model, data, grasp, local))
    assert np.abs(twist.vector - from_grasp.vector).max() < 1e-12
    # What the robot's own motion changes by is what the impulse makes of it, joints free.
    names = [name for name in robot.model.names if name not in ("universe",)]
    v = np.concatenate(
        [
            result.v[(j := whole.model.joints[whole.model.getJointId(name)]).idx_v :][
                : j.nv
            ]
            for name in names
        ]
    )
    default = robot.create_data()
    pin.computeJointJacobians(robot.model, default, options["q"])
    pin.updateFramePlacements(robot.model, default)
    J = pin.getFrameJacobian(
        robot.model, default, robot.model.getFrameId(frame, pin.FrameType.BODY), local
    )
    J = options["placement"].toActionMatrixInverse() @ J
    M = pin.crba(robot.model, default, options["q"])
    M = np.triu(M) + np.triu(M, 1).T
    change = M @ (v - options["v"]) - J.T @ result.impulse
    assert np.abs(change).max() < 1e-9 * np.abs(M @ options["v"]).max()
    if isinstance(payload, pin.Inertia):
        before = pin.Motion(np.array(options["payload_v"]))
        impulse = payload * before - payload * pin.Motion(twist.vector)
        assert (
            np.abs(impulse.vector - result.impulse).max()
            < 1e-10 * np.abs(result.impulse).max()
        )


@pytest.mark.exhaustive
def test_it_is_the_limit_of_a_stiff_grasp():
    """A spring and damper at the grasp, the stiffer the nearer: the rest halves with its time."""
    rng = np.random.default_rng(3)
    robot = fflin.load("ets_vii")
    q, v, _ = random_point(robot, rng, speed=0.05)
    payload = pin.Inertia(200.0, np.zeros(3), np.diag([30.0, 40.0, 50.0]))
    twist = 0.05 * rng.standard_normal(6)
    result = fflin.capture(robot, "tool", payload, q=q, v=v, payload_v=twist)
    data, model = robot.create_data(), robot.model
    tool = model.frames[model.getFrameId("tool")]
    free = pin.Model()
    free.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    free.appendBodyToJoint(1, payload, pin.SE3.Identity())
    free_data = free.createData()
    pin.forwardKinematics(model, data, q)
    q_p = pin.SE3ToXYZQUAT(data.oMi[tool.parentJoint] * tool.placement)

    def rates(q, v, q_p, v_p, stiffness, damping):
        pin.forwardKinematics(model, data, q, v)
        at = data.oMi[tool.parentJoint] * tool.placement
        held = pin.XYZQUATToSE3(q_p)
        twist = tool.placement.actInv(data.v[tool.parentJoint])
        behind = at.actInv(held)
        apart = pin.log6(behind).vector
        closing = behind.act(pin.Motion(v_p)).vector - twist.vector
        pull = pin.Force(stiffness * apart + damping * closing)
        outside = pin.StdVec_Force(model.njoints, pin.Force.Zero())
        outside[tool.parentJoint] = tool.placement.act(pull)
        other = pin.StdVec_Force(2, pin.Force.Zero())
        other[1] = -behind.actInv(pull)
        a = pin.aba(model, data, q, v, np.zeros(model.nv), outside)
        return a.copy(), pin.aba(free, free_data, q_p, v_p, np.zeros(6), other).copy()

    def after(rate, steps=4000):
        """Velocity after 24 time constants of a grasp that is damped critically or more."""
        stiffness = np.array([200.0, 200.0, 200.0, 40.0, 40.0, 40.0]) * rate**2
        damping, h = 2.0 * stiffness / rate, 24.0 / rate / steps
        state = [q.copy(), v.copy(), q_p.copy(), twist.copy()]
        for _ in range(steps):
            a, b = rates(*state, stiffness, damping)
            middle = [
                pin.integrate(model, state[0], 0.5 * h * state[1]),
                state[1] + 0.5 * h * a,
                pin.integrate(free, state[2], 0.5 * h * state[3]),
                state[3] + 0.5 * h * b,
            ]
            a, b = rates(*middle, stiffness, damping)
            state = [
                pin.integrate(model, state[0], h * middle[1]),
                state[1] + h * a,
                pin.integrate(free, state[2], h * middle[3]),
                state[3] + h * b,
            ]
        return state[1]

    slow, fast = after(4e4), after(8e4)
    errors = [np.abs(item - result.v).max() for item in (slow, fast)]
    jump = np.abs(result.v - v).max()
    assert errors[1] < 0.02 * jump and 1.7 < errors[0] / errors[1] < 2.3
    assert np.abs(2.0 * fast - slow - result.v).max() < 0.1 * errors[1]


def test_the_names_of_the_payload_have_its_prefix():
    robot, payload = fflin.load("ets_vii"), fflin.load("servicer_7dof")
    payload = payload.replace(stiffness={"panel_left": 80.0})
    result = fflin.capture(robot, "tool", payload, prefix="client")
    assert result.robot.stiffness == {"client.panel_left": 80.0}
    assert "client.joint_1" in result.robot.joint_names
    assert result.robot.inputs == robot.inputs and result.energy_lost == 0.0
    S = fflin.sensitivity(fflin.linearize(result.robot))
    assert S.parameters["client.link_3.mass"].value == pytest.approx(9.5)
    again = fflin.capture(result.robot, "client.tool", DEBRIS)
    assert again.robot.mass == pytest.approx(robot.mass + payload.mass + 500.0)


def test_a_captured_payload_has_separate_parameters():
    robot = fflin.load("servicer_7dof")
    result = fflin.capture(robot, "tool", DEBRIS)
    S = fflin.sensitivity(fflin.linearize(result.robot))
    assert S.parameters["payload.mass"].value == 500.0
    assert S.parameters["link_7.mass"].value == pytest.approx(6.0)
    uncertain = fflin.uncertain(result.robot, {"payload.density": 0.1})
    heavier = uncertain.at({"payload.density": 1.1})
    again = fflin.capture(
        robot, "tool", pin.Inertia(550.0, DEBRIS.lever, 1.1 * DEBRIS.inertia)
    )
    B, wanted = (fflin.linearize(item).B for item in (heavier, again.robot))
    assert np.abs(B - wanted).max() < 1e-12 * np.abs(wanted).max()


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_errors_are_one_line():
    robot, other = fflin.load("ets_vii"), fflin.load("cubesat")
    cases = [
        (lambda: fflin.capture(robot, "claw", DEBRIS), "claw"),
        (lambda: fflin.capture(robot, "tool", 5.0), "pin.Inertia"),
        (lambda: fflin.capture("ets_vii", "tool", DEBRIS), "fflin.Robot"),
        (lambda: fflin.capture(robot, "tool", DEBRIS, prefix="tool"), "prefix"),
        (lambda: fflin.capture(robot, "tool", DEBRIS, prefix="a.b"), "dots"),
        (lambda: fflin.capture(robot, "tool", DEBRIS, payload_v=[1.0]), "payload_v"),
        (lambda: fflin.capture(robot, "tool", DEBRIS, placement=3), "placement"),
        (
            lambda: fflin.capture(robot, "tool", pin.Inertia.Zero()),
            "mass of 'payload' is 0 kg",
        ),
        (
            lambda: fflin.capture(robot, "tool", other.replace(gravity=(0, 0, -9.8))),
            "gravity",
        ),
    ]
    for call, message in cases:
        with pytest.raises(fflin.FflinError) as error:
            call()
        assert message in str(error.value) and "\n" not in str(error.value)


def test_a_robot_grasps_its_twin():
    robot = fflin.load("ets_vii")
    q, v, _ = random_point(robot, np.random.default_rng(1), speed=0.1)
    others = [fflin.load("ets_vii"), robot, robot.replace(damping=0.0)]
    first, *same = (
        fflin.capture(robot, "tool", other, q=q, payload_q=q, payload_v=v)
        for other in others
    )
    for result in same:
        assert (result.v == first.v).all() and (result.momentum == first.momentum).all()


def test_momentum_that_a_payload_stores_is_not_lost_in_silence():
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), momentum=2.0)
    with pytest.raises(fflin.InputError, match="momentum"):
        fflin.capture(
            fflin.load("ets_vii"), "tool", fflin.load("cubesat", inputs=[wheel])
        )


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_all_of_a_payload_hangs_where_it_was_on_its_base(tmp_path):
    """Its frames, rotors and mimic joints, and a root that is not at its base's origin."""
    mimic = '<mimic joint="b" multiplier="-2" offset="0.3"/>'
    document = MIMIC.format(
        links=LINKS, a="revolute", b="revolute", parent="base", mimic=mimic
    )
    (tmp_path / "r.urdf").write_text(document)
    held = fflin.load(tmp_path / "r.urdf")
    model = held.model.copy()
    model.armature = np.r_[np.zeros(6), 0.3, 0.4]
    model.jointPlacements[1] = random_pose(np.random.default_rng(2), 50.0)
    held = replace(held, model=model)
    robot = fflin.load("ets_vii", limits={"joint_1": (-1.0, 1.0)})
    at, q = (
        random_pose(np.random.default_rng(1), 70.0),
        fflin.configuration(held, {"b": 0.4}),
    )
    result = fflin.capture(robot, "tool", held, placement=at, payload_q=q)
    whole = result.robot
    assert whole.limits == robot.limits
    assert [(f.joint.name, f.multiplier, f.offset) for f in whole.followers] == [
        ("payload.a", -2.0, 0.3)
    ]
    assert (np.sort(whole.model.armature)[-2:] == (0.3, 0.4)).all()
    placed = []
    for item, point, start in ((held, q, "base"), (whole, result.q, "payload")):
        data = item.create_data()
        pin.framesForwardKinematics(item.model, data, point)
        names = [
            start,
            *(f"{start}.{x}" if item is whole else x for x in ("base", "la", "lb")),
        ]
        first, *rest = (data.oMf[item.model.getFrameId(name)] for name in names)
        placed.append([first.actInv(one) for one in rest])
    for one, other in zip(*placed, strict=True):
        assert one.isApprox(other, 1e-12)
    v = np.random.default_rng(3).normal(size=6)
    moving = fflin.capture(robot, "tool", held, placement=at, payload_v=v)
    size = np.abs(moving.momentum).max()
    assert np.abs(moving.momentum - moving.momentum_after).max() < 1e-13 * size


def test_a_robot_with_wheels_keeps_its_gravity():
    robot = fflin.load(
        "cubesat", inputs=[fflin.ReactionWheel((0, 0, 1.0), inertia=1e-3)]
    )
    robot = robot.replace(gravity=(0.0, 0.0, -9.81))
    whole = fflin.capture(robot, "base", DEBRIS).robot
    assert whole.gravity == (0.0, 0.0, -9.81) and list(whole.wheels) == ["wheel_1"]
    other = fflin.load("ets_vii")
    with pytest.raises(fflin.InputError, match=r"\(0.0, 0.0, -9.81\)"):
        fflin.capture(robot, "base", other)
