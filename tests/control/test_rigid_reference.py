"""Trajectories of a rigid robot that the law of a flexible robot follows."""

import numpy as np
import pytest
import scipy.linalg

import fflin
from tests.support.robots import winged_satellite

SAMPLE = 0.25
TURN = 8.0  # s
TORQUE = 0.05  # N m
ROLL = np.array((1.0, -1.0, 0.0, 0.0))  # wheels that roll the satellite


def slew(rigid):
    """Return a roll from rest to rest by wheels that accelerate, then brake."""

    def bang_bang(t, q, v):
        early = t < 0.5 * TURN * (1.0 - 1e-12)
        return (TORQUE if early else -TORQUE) * ROLL

    motion = fflin.simulate(rigid, bang_bang, duration=TURN, sample=0.5, dt=0.5)
    return motion.trajectory()


def state_feedback(robot):
    """Return a feedback of roll, roll rate and deflections by the wheels that roll the satellite.

    Torques of these wheels in the direction of ROLL turn the satellite the other way.
    """
    model = fflin.linearize(robot).discretize(SAMPLE)
    gains = {"q_b.x": -20.0, "omega_b.x": -15.0, "q_m.left_mode_1": 2.0}
    row = np.array([gains.get(name, 0.0) for name in model.state_names])
    return fflin.StateFeedback(model, np.outer(ROLL, row))


def roll_of(q):
    """Return the angle (k,) [rad] of configurations that only roll."""
    return 2.0 * np.arctan2(q[:, 3], q[:, 6])


def predicted(robot, law, trajectory, count):
    """Return (roll, modes) (count + 1, 3) and the errors of roll of an own linear loop for rolls.

    A roll about a fixed axis has no gyroscopic torque, so the linear model holds at any angle if
    q_b is replaced by half the angle. The reference of the wings is no deflection.
    """
    lin = fflin.linearize(robot)
    nx, nu = lin.B.shape
    exact = scipy.linalg.expm(
        SAMPLE * np.block([[lin.A, lin.B], [np.zeros((nu, nx + nu))]])
    )
    A, B = exact[:nx, :nx], exact[:nx, nx:]
    names = list(lin.state_names)
    roll = names.index("q_b.x")
    left = names.index("q_m.left_mode_1")
    times = np.minimum(SAMPLE * np.arange(count + 1), TURN)
    q, v, u = trajectory.points(times)
    u[times >= TURN] = 0.0
    reference = np.zeros((count + 1, nx))
    reference[:, roll] = 0.5 * roll_of(q)
    reference[:, names.index("omega_b.x")] = v[:, 3]
    for joint in trajectory.robot.joints:
        reference[:, names.index(f"q_m.{joint.name}")] = joint.values(q.T)
        reference[:, names.index(f"qdot_m.{joint.name}")] = v[:, joint.idx_v]
    x = np.zeros((count + 1, nx))
    for k in range(count):
        command = u[k] - law.K @ (x[k] - reference[k])
        x[k + 1] = A @ x[k] + B @ command
    errors = 2.0 * (x - reference)[:, roll]
    return x[:, [roll, left, left + 1]] * (2.0, 1.0, 1.0), errors


def test_a_flexible_satellite_flies_a_rigid_plan_as_its_linear_model_predicts(tmp_path):
    robot = winged_satellite(tmp_path)
    trajectory = slew(winged_satellite(tmp_path, None))
    law = state_feedback(robot)
    count = 48
    motion = fflin.simulate(
        robot, law.follow(trajectory), duration=count * SAMPLE, dt=SAMPLE / 4
    )
    joints = [robot.joint(f"{side}_mode_1") for side in ("left", "right")]
    modes = [joint.values(motion.q.T) for joint in joints]
    flown = np.array((roll_of(motion.q), *modes)).T[::4]
    expected, error = predicted(robot, law, trajectory, count)
    assert np.abs(error).max() > 1e-5
    assert flown == pytest.approx(expected, abs=2e-7)


def test_the_reference_is_the_rigid_motion_between_knots(tmp_path):
    robot = winged_satellite(tmp_path)
    trajectory = slew(winged_satellite(tmp_path, None))
    followed = state_feedback(robot).follow(trajectory).followed_trajectory
    t = 0.3 + trajectory.t[:-1]
    q, v, u = trajectory.points(t)
    q_followed, v_followed, u_followed = followed.points(t)
    assert (u_followed == u).all()
    wings = [robot.joint(f"{side}_mode_1") for side in ("left", "right")]
    for values, expected, part in ((q_followed, q, "idx_q"), (v_followed, v, "idx_v")):
        columns = [getattr(joint, part) for joint in wings]
        assert not values[:, columns].any()
        assert np.delete(values, columns, axis=1) == pytest.approx(expected, abs=1e-15)


def at_rest(robot):
    """Return the trajectory of a robot at rest."""
    q = np.tile(robot.neutral(), (2, 1))
    nu = len(fflin.linearize(robot).input_names)
    return fflin.Trajectory(
        robot, [0.0, 1.0], q, np.zeros((2, robot.nv)), np.zeros((2, nu))
    )


def test_inputs_that_the_rigid_plan_lacks_are_zero(tmp_path):
    rigid = winged_satellite(tmp_path, None)
    robot = winged_satellite(tmp_path)
    robot = robot.replace(inputs=[fflin.BaseTorque(), *robot.inputs])
    model = fflin.linearize(robot).discretize(SAMPLE)
    law = fflin.StateFeedback(model, np.zeros((7, len(model.A))))
    u = law.follow(slew(rigid)).feedforward(0.0)
    assert u == pytest.approx([0.0, 0.0, 0.0, *(TORQUE * ROLL)], abs=1e-15)


def test_a_trajectory_without_a_motor_joint_is_refused():
    robot = fflin.load("planar_detumble")
    locked = fflin.load("planar_detumble", lock=["joint_1"])
    model = fflin.linearize(robot).discretize(SAMPLE)
    law = fflin.StateFeedback(model, np.zeros((len(model.input_names), len(model.A))))
    with pytest.raises(fflin.InputError, match="joint_1 must be controlled"):
        law.follow(at_rest(locked))


def test_a_rigid_plan_of_another_inertia_is_refused(tmp_path):
    robot = winged_satellite(tmp_path)
    rigid = winged_satellite(tmp_path, None).perturbed(mass=0.01, com=0, inertia=0)
    with pytest.raises(fflin.InputError, match=r"mass or inertia differs by .* %"):
        state_feedback(robot).follow(at_rest(rigid))


def test_a_rigid_plan_is_refused_by_accelerometers(tmp_path):
    rigid = winged_satellite(tmp_path, None)
    robot = winged_satellite(tmp_path).replace(outputs=[fflin.Accelerometer("base")])
    with pytest.raises(fflin.InputError, match="accelerometers measure"):
        state_feedback(robot).follow(at_rest(rigid))


def test_a_rigid_plan_with_other_inputs_is_refused(tmp_path):
    rigid = winged_satellite(tmp_path, None)
    rigid = rigid.replace(inputs=[fflin.BaseTorque(), *rigid.inputs])
    with pytest.raises(fflin.InputError, match=r"inputs tau_b.x, .* does not command"):
        state_feedback(winged_satellite(tmp_path)).follow(at_rest(rigid))
