"""Captures and jams of robots with constraints, compared with multipliers of all rows at once."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.constraints import Constraints
from tests.simulation.test_constraints import GRIP, STEPS, dual_arm, off

LOCAL = pin.ReferenceFrame.LOCAL
BOX = pin.Inertia(40.0, np.array([0.2, 0.1, 0.0]), np.diag([3.0, 4.0, 5.0]))
TWIST = np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.015])
CLAMP = fflin.Weld("payload", "base", name="clamp")


def jacobian(robot, q, frame):
    """Return the twist (6, nv) of a frame in its own axes."""
    index = robot.model.getFrameId(frame)
    return pin.computeFrameJacobian(robot.model, robot.create_data(), q, index, LOCAL)


def inertia(robot, q):
    M = pin.crba(robot.model, robot.create_data(), q)
    return np.triu(M) + np.triu(M, 1).T


def pose(robot, q, frame):
    data = robot.create_data()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId(frame)]


def closing(M, rows, v):
    """Return the velocity after rows close, and their smallest impulses, of the whole system."""
    count = len(rows)
    system = np.block([[M, -rows.T], [rows, np.zeros((count, count))]])
    given = np.concatenate((M @ v, np.zeros(count)))
    solved = np.linalg.lstsq(system, given, None)[0]
    return solved[: len(v)], solved[len(v) :]


def test_a_robot_with_a_loop_captures_a_payload():
    robot, q, v = dual_arm()
    caught = fflin.capture(robot, "base", BOX, q=q, v=v, payload_v=TWIST)
    M = np.zeros((robot.nv + 6, robot.nv + 6))
    M[: robot.nv, : robot.nv] = inertia(robot, q)
    M[robot.nv :, robot.nv :] = BOX.matrix()
    grasp = np.hstack((jacobian(robot, q, "base"), -np.eye(6)))
    loop = np.hstack((Constraints(robot).jacobian(q), np.zeros((6, 6))))
    after, impulses = closing(M, np.vstack((grasp, loop)), np.append(v, TWIST))
    np.testing.assert_allclose(caught.v, after[: robot.nv], atol=1e-14)
    np.testing.assert_allclose(caught.impulse, impulses[:6], atol=1e-13)
    np.testing.assert_allclose(caught.momentum_after, caught.momentum, atol=1e-13)
    assert np.abs(caught.v - v).max() > 1e-3
    assert caught.robot.constraints[0].title == "grip"


def test_a_payload_that_two_grippers_hold_at_once():
    robot = fflin.load("dual_arm")
    q = fflin.configuration(robot, {"left_1": 0.4, "left_2": 0.7, "right_1": -0.3})
    v = 0.1 * np.random.default_rng(1).normal(size=robot.nv)
    hold = fflin.Weld("tool_right", "payload", name="second")
    known = {"q": q, "v": v, "payload_v": TWIST}
    caught = fflin.capture(robot, "tool_left", BOX, hold=hold, **known)
    tools = [pose(robot, q, name) for name in ("tool_left", "tool_right")]
    apart = tools[0].actInv(tools[1])
    M = np.zeros((robot.nv + 6, robot.nv + 6))
    M[: robot.nv, : robot.nv] = inertia(robot, q)
    M[robot.nv :, robot.nv :] = BOX.matrix()
    first = np.hstack((jacobian(robot, q, "tool_left"), -np.eye(6)))
    # The right tool, and the point of the payload where it is, in the same axes.
    second = np.hstack((jacobian(robot, q, "tool_right"), -apart.inverse().action))
    rows = np.vstack((first, second))
    after, impulses = closing(M, rows, np.append(v, TWIST))
    np.testing.assert_allclose(caught.v, after[: robot.nv], atol=1e-13)
    # The arms are planar, so that rows of both grippers are dependent: the smallest impulses
    # depend on the units of the rows, but the wrench on the payload does not.
    both = [pin.Force(part) for part in np.split(caught.impulse, 2)]
    total = both[0] + apart.act(both[1])
    expected = BOX.matrix() @ (TWIST - after[robot.nv :])
    np.testing.assert_allclose(total.vector, expected, atol=1e-13)
    other = [pin.Force(part) for part in np.split(impulses, 2)]
    np.testing.assert_allclose(
        (other[0] + apart.act(other[1])).vector, expected, atol=1e-13
    )


def test_holding_at_the_grasp_is_a_grasp_and_then_a_latch():
    robot, q, v = dual_arm()
    known = {"q": q, "v": v, "payload_v": TWIST}
    place = pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.0]))
    at_once = fflin.capture(
        robot, "tool_left", BOX, placement=place, hold=CLAMP, **known
    )
    first = fflin.capture(robot, "tool_left", BOX, placement=place, **known)
    second = fflin.latch(first.robot, CLAMP, q=first.q, v=first.v)
    np.testing.assert_allclose(at_once.v, second.v, atol=1e-14)
    lost = first.energy_lost + second.energy_lost
    assert at_once.energy_lost == pytest.approx(lost, rel=1e-11)
    assert [item.title for item in at_once.robot.constraints] == ["grip", "clamp"]
    assert at_once.impulse.shape == (12,) and len(str(at_once).splitlines()) >= 1


def test_a_payload_keeps_its_loop_closed():
    robot = fflin.load("planar_detumble")
    twin, twin_q, _ = dual_arm()
    caught = fflin.capture(robot, "hand", twin, payload_q=twin_q, payload_v=TWIST)
    names = [item.title for item in caught.robot.constraints]
    assert names == ["payload.grip"]
    rows = Constraints(caught.robot)
    assert np.abs(rows.residual(caught.q)).max() < 1e-12
    assert np.abs(rows.jacobian(caught.q) @ caught.v).max() < 1e-13
    # The joints of both move, and the total momentum is kept.
    np.testing.assert_allclose(caught.momentum_after, caught.momentum, atol=1e-13)
    M = inertia(twin, twin_q)
    before = np.append(TWIST, np.zeros(twin.nv - 6))
    after = np.append(
        jacobian(caught.robot, caught.q, "payload") @ caught.v,
        caught.v[caught.robot.nv - twin.nv + 6 :],
    )
    np.testing.assert_allclose((M @ (before - after))[:6], caught.impulse, atol=1e-12)


def test_a_berth_in_inertial_space_takes_the_impulse_of_a_capture():
    robot = fflin.load("dual_arm").replace(constraints=[fflin.Weld("base")])
    q = fflin.configuration(robot, {"left_1": 0.4, "left_2": 0.7})
    caught = fflin.capture(robot, "tool_left", BOX, q=q, payload_v=TWIST)
    assert np.abs(caught.v[:6]).max() < 1e-14 < np.abs(caught.v[6:]).max()
    assert np.abs(caught.momentum_after - caught.momentum).max() > 0.1
    assert caught.energy_lost > 0.0


def test_a_free_robot_that_grasps_a_held_body_feels_the_impulse_of_the_grasp_alone():
    held = fflin.load("cubesat").replace(constraints=[fflin.Weld("base")])
    robot = fflin.load("planar_detumble")
    place = pose(robot, robot.neutral(), "hand").inverse()
    q = robot.neutral()
    q[:7] = pin.SE3ToXYZQUAT(place)
    v = fflin.velocity(robot, {"v_b.x": 0.1, "joint_1": 0.2})
    caught = fflin.capture(robot, "hand", held, q=q, v=v)
    change = inertia(robot, q) @ (caught.v[: robot.nv] - v)
    J = jacobian(robot, q, "hand")
    np.testing.assert_allclose(J.T @ caught.impulse, change, atol=1e-12)
    assert np.abs(caught.impulse).max() > 0.1


@pytest.mark.parametrize("world", [False, True], ids=["loop", "world"])
def test_a_joint_of_a_loop_jams(world):
    robot, q, v = dual_arm(*([GRIP, fflin.Hinge("base")] if world else [GRIP]))
    jammed = fflin.jam(robot, "left_2", q=q, v=v)
    row = np.zeros((1, robot.nv))
    index = robot.model.joints[robot.model.getJointId("left_2")].idx_v
    row[0, index] = 1.0
    rows = np.vstack((row, Constraints(robot).jacobian(q)))
    M = inertia(robot, q)
    after, impulses = closing(M, rows, v)
    np.testing.assert_allclose(jammed.v, np.delete(after, index), atol=1e-13)
    np.testing.assert_allclose(jammed.impulse, impulses[:1], atol=1e-12)
    energies = [0.5 * rate @ M @ rate for rate in (v, after)]
    assert jammed.energy_lost == pytest.approx(energies[0] - energies[1], rel=1e-12)
    if not world:
        np.testing.assert_allclose(jammed.momentum_after, jammed.momentum, atol=1e-13)
    assert fflin.linearize(jammed.robot, jammed.q).rank == 6 + 5 * world


def test_a_loop_whose_joints_all_jam_is_one_body():
    robot, q, v = dual_arm()
    robot = robot.replace(outputs=[fflin.ConstraintForce("grip")], independent=["q_b"])
    jammed = fflin.jam(robot, ["left_*", "right_*"], q=q, v=v)
    assert jammed.robot.constraints == () and jammed.robot.n == 0
    assert jammed.robot.outputs == () and jammed.robot.independent == ()
    np.testing.assert_allclose(jammed.momentum_after, jammed.momentum, atol=1e-13)


def test_a_latch_forgets_the_chosen_coordinates():
    robot = fflin.load("dual_arm", constraints=[fflin.Hinge("base")])
    robot = robot.replace(independent=["q_b.z", "left_*", "right_*"])
    q = robot.neutral()
    assert fflin.linearize(robot, q).rank == 5
    hit = fflin.latch(robot, fflin.Weld("tool_left"), q=q)
    assert hit.robot.independent == ()


def test_phases_of_a_capture_with_a_hold_are_one_motion():
    robot, q, v = dual_arm()
    approach = fflin.simulate(robot, q0=q, v0=v, duration=0.1, **STEPS)
    end = {"q": approach.q[-1], "v": approach.v[-1]}
    caught = fflin.capture(robot, "tool_left", BOX, hold=CLAMP, payload_v=TWIST, **end)
    stack = fflin.simulate(
        caught.robot, q0=caught.q, v0=caught.v, duration=0.1, **STEPS
    )
    # The clamp opens, the arms still hold the payload.
    grasped = caught.robot.replace(constraints=[GRIP])
    opened = fflin.simulate(
        grasped, q0=stack.q[-1], v0=stack.v[-1], duration=0.1, **STEPS
    )
    motion = approach.then(caught, stack, opened)
    assert motion.phases == ("dual_arm", "payload of 40 kg caught", "clamp released")
    for robot, phase in ((caught.robot, stack), (grasped, opened)):
        residual, rate = off(robot, phase)
        assert residual < 1e-12 and rate < 1e-12
        assert phase.momentum_drift.max() < 1e-12
    later = motion.momentum[len(approach.t) :]
    np.testing.assert_allclose(later, np.tile(later[0], (len(later), 1)), atol=1e-12)


def test_what_a_capture_cannot_hold_is_refused():
    robot, q, v = dual_arm()
    with pytest.raises(fflin.ConstraintError, match="grip"):
        fflin.capture(robot, "base", BOX, q=robot.neutral())
    with pytest.raises(fflin.ConstraintError, match="grip"):
        fflin.jam(robot, "left_1", q=q, v=np.full(robot.nv, 0.1))
    far = fflin.Weld("payload", "base", placement=pin.SE3.Identity())
    with pytest.raises(fflin.ConstraintError, match="payload/base"):
        fflin.capture(robot, "tool_left", BOX, q=q, v=v, hold=far)
    same = fflin.Weld("payload", "tool_left")
    with pytest.raises(fflin.InputError, match="same body"):
        fflin.capture(robot, "tool_left", BOX, q=q, v=v, hold=same)
    with pytest.raises(fflin.InputError, match="hold is 'tool_right', expected a list"):
        fflin.capture(robot, "tool_left", BOX, q=q, v=v, hold="tool_right")
