"""Controllers of the nominal robot on another: run where the names agree."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.marks import exhaustive
from tests.support.messages import says
from tests.support.motions import displaced, motion
from tests.support.weights import unit_weights

SPREAD = {"mass": 0.1, "com": 0.1, "inertia": 0.1}


@pytest.fixture(scope="module")
def nominal():
    robot = fflin.load("ets_vii")
    return robot, fflin.linearize(robot)


@pytest.mark.parametrize("dt", [0.1, *exhaustive(0.0)])
def test_a_feedback_of_the_nominal_robot_runs_on_another(nominal, dt):
    robot, lin = nominal
    other = robot.perturbed(**SPREAD, seed=4)
    lin = lin.discretize(dt) if dt else lin
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    x0 = displaced(lin)
    run = fflin.simulate(other, policy, x0=x0, duration=40.0)
    assert run.attitude_error[-1] < 0.5 < 29.0 < run.attitude_error[0]
    # The motion is that of the other robot under the bound law.
    plain = policy.bind(robot)
    same = fflin.simulate(
        other, plain, x0=x0, duration=40.0, sample=dt or None, dt=run.t[1]
    )
    np.testing.assert_allclose(run.x, same.x, atol=1e-12)
    assert run.urdf_sha256 == other.urdf_sha256


@pytest.mark.exhaustive
def test_measured_feedback_runs_on_another_robot(nominal):
    robot, _ = nominal
    sampled = fflin.linearize(robot).discretize(0.1)
    weights = unit_weights(sampled)
    law = fflin.lqg(fflin.lqr(sampled, *weights), fflin.kalman(sampled, 1.0, 1.0))
    policy = fflin.OutputFeedback(sampled, law)
    run = fflin.simulate(
        robot.perturbed(**SPREAD), policy, x0=displaced(sampled), duration=60.0
    )
    assert run.attitude_error[-1] < 1.0


@pytest.mark.exhaustive
def test_schedules_and_allocations_run_on_another_robot():
    robot = fflin.load("ets_vii")
    t, q, v, u = motion(robot)
    along = fflin.linearize_trajectory(robot, t, q, v, u)
    policy = fflin.TrajectoryFeedback(along, fflin.tvlqr(along, 1.0, 1e-3, 1.0))
    other = robot.perturbed(**SPREAD, seed=1)
    run = fflin.simulate(
        other, policy, q0=q[0], v0=v[0], duration=0.4, dt=0.005, frame="local"
    )
    # Exact at the start, off by what the masses are off.
    exact = fflin.simulate(
        robot, policy, q0=q[0], v0=v[0], duration=0.4, dt=0.005, frame="local"
    )
    np.testing.assert_allclose(run.u[0], exact.u[0], atol=1e-9)
    assert np.abs(run.u[-1] - exact.u[-1]).max() > 1e-3

    lin = fflin.linearize(robot)
    law = fflin.Allocation(fflin.StateFeedback(lin, fflin.lqr(lin).K), robot)
    apart = fflin.simulate(
        other, law, x0=displaced(lin), duration=0.2, dt=0.05, sample=0.05
    )
    plain = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    same = fflin.simulate(
        other, plain, x0=displaced(lin), duration=0.2, dt=0.05, sample=0.05
    )
    np.testing.assert_allclose(apart.x, same.x, atol=1e-9)


def test_an_allocation_weighs_with_the_masses_that_it_knows():
    cubesat = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    thrusters = [item for item in cubesat.inputs if isinstance(item, fflin.Thruster)][
        :7
    ]
    robot = fflin.load("cubesat", inputs=thrusters)
    design = robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    other = robot.with_mass_properties({"base": {"mass": 1.0}})
    wanted = np.array([1e-3, -2e-3, 1e-3, 0.1, 0.05, -0.1])
    law = fflin.Allocation(lambda t, q, v: wanted, design)
    q, v = robot.neutral(), np.zeros(robot.nv)
    np.testing.assert_array_equal(
        law.bind(other)(0.0, q, v), law.bind(robot)(0.0, q, v)
    )


class Renamed:
    """A robot whose joint is another."""

    def __new__(cls, robot, **change):
        model = robot.model.copy()
        for index, name in change.get("names", {}).items():
            model.names[index] = name
        return fflin.from_model(model, name="other")


def test_models_with_other_names_are_refused_with_the_names(nominal):
    robot, lin = nominal
    policy = fflin.StateFeedback(lin, np.zeros(lin.B.T.shape))

    def said(other, law=policy):
        with pytest.raises(fflin.InputError) as caught:
            fflin.simulate(other, law, duration=0.1)
        return str(caught.value)

    other = Renamed(robot, names={3: "elbow"})
    assert says(said(other), "'other'", "lacks the", "q_m.joint_2")
    fewer = robot.replace(inputs=robot.inputs[:-1])
    assert says(said(fewer), "lacks the", "tau_m.joint_6;")
    turned = robot.replace(inputs=robot.inputs[::-1])
    assert says(said(turned), "order")
    few = fflin.linearize(fewer)
    law = fflin.StateFeedback(few, np.zeros(few.B.T.shape))
    assert says(said(robot, law), "also has the", "tau_m.joint_6;")
    assert says(
        said(fflin.load("cubesat")),
        "lacks the",
        "q_m.joint_1, q_m.joint_2, q_m.joint_3, q_m.joint_4, q_m.joint_5, q_m.joint_6",
    )


def test_joints_of_another_kind_are_refused():
    def arm(joint):
        model = pin.Model()
        model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
        model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
        at = model.addJoint(1, joint, pin.SE3.Identity(), "arm")
        model.appendBodyToJoint(at, pin.Inertia.Random(), pin.SE3.Identity())
        return fflin.from_model(model, name=joint.shortname())

    pin.seed(0)
    lin = fflin.linearize(arm(pin.JointModelRZ()))
    policy = fflin.StateFeedback(lin, np.zeros(lin.B.T.shape))
    with pytest.raises(fflin.InputError, match=r"q_m\.arm in m, not rad"):
        fflin.simulate(arm(pin.JointModelPZ()), policy, duration=0.1)
    with pytest.raises(fflin.InputError, match="continuous"):
        fflin.simulate(arm(pin.JointModelRUBZ()), policy, duration=0.1)


def test_a_trajectory_of_other_inputs_is_refused():
    robot = fflin.load("planar_detumble")
    t, q, v, u = motion(robot)
    along = fflin.linearize_trajectory(robot, t, q, v, u)
    policy = fflin.TrajectoryFeedback(along, fflin.tvlqr(along, 1.0, 1.0, 1.0))
    fewer = robot.replace(inputs=robot.inputs[1:])
    with pytest.raises(fflin.InputError, match=r"'planar_detumble'.*tau_b"):
        fflin.simulate(fewer, policy, duration=0.1)


def test_measurements_of_other_names_are_refused(nominal):
    robot, _ = nominal
    sampled = fflin.linearize(robot).discretize(0.1)
    weights = unit_weights(sampled)
    law = fflin.lqg(fflin.lqr(sampled, *weights), fflin.kalman(sampled, 1.0, 1.0))
    other = robot.replace(outputs=[fflin.JointPositions(robot.joint_names)])
    with pytest.raises(fflin.InputError, match=r"q_b\.x, q_b\.y"):
        fflin.simulate(other, fflin.OutputFeedback(sampled, law), duration=0.1)
