"""Bodies and constraints that may change between two phases of a motion."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.impact import inertia_at
from fflin.robot.loading import body_alone

BOX = pin.Inertia(60.0, np.array([0.3, 0.0, 0.0]), np.diag([6.0, 8.0, 9.0]))
BENT = {"left_1": 0.4, "left_2": 0.6, "right_1": -0.4, "right_2": -0.6}
GRASP = fflin.Weld("tool_right", "tool_left", name="grasp")
HOW = {"duration": 0.1, "dt": 0.05, "engine": "python"}
SPIN = {"omega_b.z": 0.02, "left_3": 0.05}


@pytest.fixture(scope="module")
def servicer():
    return fflin.load("dual_arm")


@pytest.fixture(scope="module")
def drift(servicer):
    q = fflin.configuration(servicer, BENT)
    v = fflin.velocity(servicer, SPIN)
    return fflin.simulate(servicer, q0=q, v0=v, **HOW)


@pytest.fixture(scope="module")
def caught(servicer, drift):
    end = {"q": drift.q[-1], "v": drift.v[-1]}
    twist = [0.005, 0.0, -0.005, 0.0, 0.01, 0.0]
    return fflin.capture(servicer, "tool_left", BOX, payload_v=twist, **end)


@pytest.fixture(scope="module")
def held(caught):
    return fflin.simulate(caught.robot, q0=caught.q, v0=caught.v, **HOW)


def after(motion, robot):
    """Simulate a robot from the last row of a motion."""
    return fflin.simulate(robot, q0=motion.q[-1], v0=motion.v[-1], **HOW)


def refusal(motion, *later):
    with pytest.raises(fflin.InputError) as error:
        motion.then(*later)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_payload_needs_a_capture(drift, caught, held):
    with_box = after(drift, caught.robot)
    text = refusal(drift, with_box)
    assert "'payload' of 60 kg" in text and "fflin.capture" in text
    assert drift.then(caught, held).phases[1] == "payload of 60 kg caught"


def test_a_release_is_named_and_conserves_the_momentum(servicer, drift, caught, held):
    free = after(held, servicer)
    whole = drift.then(caught, held, free)
    assert whole.phases[-1] == "payload released"
    # The momentum of the robot before the release is the sum of robot and payload.
    frame = caught.robot.model.getFrameId("payload", pin.FrameType.BODY)
    data = caught.robot.create_data()
    q, v = held.q[-1], held.v[-1]
    local = pin.ReferenceFrame.LOCAL
    J = pin.computeFrameJacobian(caught.robot.model, data, q, frame, local)
    momentum = BOX.matrix() @ J @ v
    expected = inertia_at(caught.robot, q) @ v - J.T @ momentum
    assert inertia_at(servicer, q) @ v == pytest.approx(expected, abs=1e-11)


def test_a_release_of_constraint_and_payload_is_one_phase(servicer, caught, held):
    latched = fflin.latch(caught.robot, GRASP, q=held.q[-1], v=held.v[-1])
    loop = fflin.simulate(latched.robot, q0=latched.q, v0=latched.v, **HOW)
    whole = held.then(latched, loop, after(loop, servicer))
    assert whole.phases[1:] == ("grasp latched", "grasp, payload released")
    assert loop.then(after(loop, caught.robot)).phases[1] == "grasp released"


def test_a_perturbed_payload_is_released(servicer, held, caught):
    heavy = caught.robot.perturbed(mass=0.05, com=0.02, inertia=0.05, seed=1)
    bare = servicer.perturbed(mass=0.05, com=0.02, inertia=0.05, seed=1)
    together = after(held, heavy)
    assert together.then(after(together, bare)).phases[1] == "payload released"
    other = servicer.perturbed(mass=0.05, seed=2)
    assert "begins with another robot" in refusal(together, after(together, other))


def test_a_payload_with_joints_is_released(servicer, drift):
    end = {"q": drift.q[-1], "v": drift.v[-1]}
    other = fflin.load("planar_detumble").replace(gravity=servicer.gravity)
    caught = fflin.capture(servicer, "tool_left", other, **end)
    held = fflin.simulate(caught.robot, q0=caught.q, v0=caught.v, **HOW)
    joints = [caught.robot.model.getJointId(name) for name in servicer.model.names[1:]]
    joints = [caught.robot.model.joints[index] for index in joints]
    q = [held.q[-1][joint.idx_q :][: joint.nq] for joint in joints]
    v = [held.v[-1][joint.idx_v :][: joint.nv] for joint in joints]
    free = fflin.simulate(servicer, q0=np.concatenate(q), v0=np.concatenate(v), **HOW)
    assert drift.then(caught, held, free).phases[-1] == "payload released"


def test_other_masses_are_refused(servicer, drift, caught, held):
    other = servicer.perturbed(mass=0.05, seed=1)
    text = refusal(drift, after(drift, other))
    assert f"mass {other.mass:.6g} kg instead of {servicer.mass:.6g} kg" in text
    end = {"q": drift.q[-1], "v": drift.v[-1]}
    impact = fflin.capture(other, "tool_left", BOX, **end)
    assert "caught' begins with another robot" in refusal(drift, impact, held)


def test_a_displaced_centre_of_mass_and_another_inertia_are_refused():
    body = pin.Inertia(100.0, np.zeros(3), np.diag([10.0, 20.0, 30.0]))
    moved = pin.Inertia(100.0, np.array([0.02, 0.0, 0.0]), np.diag([10.0, 20.0, 30.0]))
    stiff = pin.Inertia(100.0, np.zeros(3), np.diag([10.0, 21.0, 30.0]))
    first, other, third = (
        fflin.simulate(body_alone(inertia, "box"), **HOW)
        for inertia in (body, moved, stiff)
    )
    assert "displaced by 0.02 m" in refusal(first, other)
    assert "the inertia that 'root_joint' moves differs" in refusal(first, third)
    assert len(first.then(first).phases) == 2


def test_a_joint_may_be_locked_only_where_it_is(servicer):
    q = fflin.configuration(servicer, BENT)
    rest = fflin.simulate(servicer, q0=q, **HOW)
    others = {name: value for name, value in BENT.items() if name != "left_1"}

    def locked_at(angle):
        robot = fflin.load("dual_arm", lock={"left_1": angle})
        return fflin.simulate(robot, q0=fflin.configuration(robot, others), **HOW)

    assert rest.then(locked_at(0.4)).phases == ("dual_arm", "dual_arm")
    assert "centre of mass is displaced" in refusal(rest, locked_at(0.5))


def test_a_constraint_that_closes_without_an_impact_is_named(servicer):
    rest = fflin.simulate(servicer, q0=fflin.configuration(servicer, BENT), **HOW)
    welded = servicer.replace(constraints=[GRASP])
    assert rest.then(after(rest, welded)).phases[1] == "grasp closed"
