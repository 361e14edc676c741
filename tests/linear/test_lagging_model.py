"""Linear models whose inputs have a lag: exact matrices, names, files and designs."""

import numpy as np
import pytest
from scipy.linalg import expm

import fflin


def satellite(lag=0.3, **fields):
    """Return a robot whose base torque has a lag, and its model without the lag."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(lag=lag)], **fields)
    return robot, fflin.linearize(robot)


@pytest.fixture(scope="module")
def arm():
    """Return the model of a moving arm, whose A is not nilpotent, with springs."""
    robot = fflin.load("planar_detumble", stiffness=2.0, damping=0.1)
    v = fflin.velocity(robot, {"joint_1": 0.3, "omega_b.z": 0.2})
    q = fflin.configuration(robot, {"joint_2": 0.5})
    return fflin.linearize(robot, q, v)


def test_names_units_and_time_constants_of_the_forces():
    inputs = [fflin.BaseTorque(lag=0.1), fflin.BaseForce()]
    robot = fflin.load("cubesat", inputs=inputs)
    lin = fflin.linearize(robot).with_lags()
    assert lin.added == tuple(f"lag.tau_b.{axis}" for axis in "xyz")
    assert lin.state_units[-3:] == ("N m",) * 3
    assert lin.lag.tolist() == [0.1, 0.1, 0.1, 0.0, 0.0, 0.0]
    assert lin.robot_states == fflin.linearize(robot).state_names
    assert not lin.B[:12, :3].any() and lin.B[:12, 3:].any()


def test_every_kind_of_input_has_a_lag():
    robot = fflin.load("planar_detumble")
    inputs = [
        fflin.BaseTorque(lag=0.1),
        fflin.BaseForce(lag=0.2),
        fflin.JointTorque("joint_1", lag=0.3),
        fflin.Thruster("base", (0, 0, 0), (1, 0, 0), "nozzle", lag=0.4),
        fflin.ReactionWheel((0, 0, 1), name="wheel", lag=0.5),
    ]
    lin = fflin.linearize(robot.replace(inputs=inputs)).with_lags()
    assert lin.lag.tolist() == [0.1] * 3 + [0.2] * 3 + [0.3, 0.4, 0.5]
    assert lin.added[-2:] == ("lag.nozzle", "lag.wheel")


def test_a_robot_file_sets_the_lag(tmp_path):
    file = tmp_path / "inputs.toml"
    file.write_text('[[input]]\ntype = "base_torque"\nlag = 0.25\n')
    assert fflin.load_inputs(file)[0].lag == 0.25
    file.write_text('[[input]]\ntype = "base_torque"\nlag = -1\n')
    with pytest.raises(fflin.InputError, match="lag is -1 s"):
        fflin.load_inputs(file)


def test_steps_equal_a_fine_integration(arm):
    """The commands arrive late, and the forces follow them by an exponential."""
    h, parts, lag = 0.1, 200, 0.15
    late = arm.with_lags({"tau_b": lag}).discretize(h, delay=0.05)
    nx, nu = arm.B.shape
    block = np.zeros((nx + nu + 1, nx + nu + 1))
    block[:nx] = np.column_stack((arm.A, arm.B, arm.f0))
    block[nx : nx + 3, nx : nx + 3] = -np.eye(3) / lag
    held = arm.B.copy()
    held[:, :3] = 0.0
    block[:nx, nx : nx + nu] = arm.B
    # Work with the forces of the lagging inputs, and with the commands of all inputs.
    whole = np.zeros((nx + 3 + nu + 1,) * 2)
    whole[:nx, :nx] = arm.A
    whole[:nx, nx : nx + 3] = arm.B[:, :3]
    whole[:nx, nx + 3 : -1] = held
    whole[:nx, -1] = arm.f0
    whole[nx : nx + 3, nx : nx + 3] = -np.eye(3) / lag
    whole[nx : nx + 3, nx + 3 : nx + 6] = np.eye(3) / lag
    fine = expm(whole * h / parts)
    rng = np.random.default_rng(3)
    x = np.append(0.1 * rng.normal(size=nx), np.zeros(3))
    z = np.append(x, np.zeros(len(late.added) - 3))
    commands = rng.normal(size=(6, nu))
    for k, u in enumerate(commands):
        for part in range(parts):
            before = commands[k - 1] if k else np.zeros(nu)
            acting = u if (part + 0.5) / parts > 0.5 else before
            x = (fine @ np.concatenate((x, acting, [1.0])))[: nx + 3]
        z = late.A @ z + late.B @ u + late.f0
        assert z[: nx + 3] == pytest.approx(x, abs=1e-11)


def test_the_model_without_lags_is_restored(arm):
    lagging = arm.with_lags(0.2)
    plain = lagging.undelayed
    for name in ("A", "B", "C", "D", "f0", "x0"):
        assert (getattr(plain, name) == getattr(arm, name)).all()
    sampled = lagging.discretize(0.1, delay=0.03).undelayed
    assert (sampled.A == arm.discretize(0.1).A).all()
    assert (sampled.B == arm.discretize(0.1).B).all()
    assert lagging.rate == pytest.approx(np.append(arm.rate, np.zeros(9)))
    with pytest.raises(fflin.InputError, match=r"give lin\.undelayed"):
        fflin.check(fflin.load("planar_detumble"), lagging)


def test_a_file_keeps_the_lags(tmp_path):
    lin = satellite()[1].with_lags().discretize(0.25, delay=0.1)
    for ending in ("mat", "npz", "json"):
        path = tmp_path / f"model.{ending}"
        lin.save(path)
        read = fflin.LinearModel.load(path)
        assert read.added == lin.added
        assert (read.lag == lin.lag).all()
        plain = satellite()[1].discretize(0.25)
        assert read.undelayed.B == pytest.approx(plain.B, rel=1e-12, abs=1e-12)


def test_accelerometers_feel_the_force_that_acts():
    inputs = [fflin.BaseForce(lag=0.2)]
    robot = fflin.load("cubesat", inputs=inputs, outputs=[fflin.Accelerometer("base")])
    plain = fflin.linearize(robot)
    lagging = plain.with_lags()
    assert plain.D.any() and not lagging.D.any()
    assert (lagging.C[:, -3:] == plain.D).all()


@pytest.mark.parametrize(
    ("lag", "message"),
    [
        (-0.1, r"lag of tau_b\.x is -0\.1 s"),
        (0.0, "no input has a lag"),
        ({"tau_b.x": -1.0}, "expected at least 0"),
    ],
)
def test_wrong_lags_are_refused(lag, message):
    lin = satellite()[1]
    with pytest.raises(fflin.InputError, match=message):
        lin.with_lags(lag)


def test_models_that_cannot_get_a_lag_are_refused(tmp_path):
    lin = satellite()[1]
    with pytest.raises(fflin.InputError, match="add the lags first"):
        lin.discretize(0.1).with_lags()
    with pytest.raises(fflin.InputError, match="already has lags"):
        lin.with_lags().with_lags()
    lin.save(tmp_path / "model.json")
    read = fflin.LinearModel.load(tmp_path / "model.json")
    with pytest.raises(fflin.InputError, match="does not contain its robot"):
        read.with_lags()
    assert read.with_lags(0.3).A == pytest.approx(lin.with_lags().A)


def test_sensors_with_a_lag_are_states():
    """The model with the lag is the model in series with first-order filters."""
    outputs = [fflin.Gyroscope("base", lag=0.2), fflin.StarTracker()]
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(lag=0.1)], outputs=outputs)
    plain = fflin.linearize(robot)
    lin = plain.with_lags()
    assert lin.added[3:] == tuple(f"lag.base.gyroscope.{axis}" for axis in "xyz")
    assert lin.state_units[-3:] == ("rad/s",) * 3
    assert lin.output_lag.tolist() == [0.2] * 3 + [0.0] * 3
    for s in (0.3j, 2.0j, 1.0 + 5.0j):
        response = lin.C @ np.linalg.solve(s * np.eye(len(lin.A)) - lin.A, lin.B)
        expected = plain.C @ np.linalg.solve(s * np.eye(12) - plain.A, plain.B)
        expected = expected / (1.0 + 0.1 * s)
        expected[:3] /= 1.0 + 0.2 * s
        assert response == pytest.approx(expected, abs=1e-12)
    for name in ("A", "B", "C", "D"):
        assert getattr(lin.undelayed, name) == pytest.approx(getattr(plain, name))
        sampled = lin.discretize(0.1, delay=0.05).undelayed
        assert (getattr(sampled, name) == getattr(plain.discretize(0.1), name)).all()


def test_a_file_keeps_the_lags_of_outputs(tmp_path):
    outputs = [fflin.Gyroscope("base", lag=0.2), fflin.Accelerometer("base", lag=0.3)]
    robot = fflin.load("cubesat", outputs=outputs)
    plain = fflin.linearize(robot)
    lin = plain.with_lags()
    lin.save(tmp_path / "lin.mat")
    read = fflin.LinearModel.load(tmp_path / "lin.mat")
    assert (read.output_lag == lin.output_lag).all()
    assert read.undelayed.C == pytest.approx(plain.C, abs=1e-12)
    assert read.undelayed.D == pytest.approx(plain.D, abs=1e-12)
    lin.discretize(0.1).save(tmp_path / "sampled.npz")
    read = fflin.LinearModel.load(tmp_path / "sampled.npz")
    with pytest.raises(fflin.InputError, match="lags of its outputs is unknown"):
        _ = read.undelayed


def test_regulators_with_wheels_leave_out_sensors_of_other_states():
    wheels = [fflin.ReactionWheel(axis, inertia=1e-5) for axis in np.eye(3)]
    outputs = [fflin.BasePose(lag=0.2), fflin.Gyroscope("base", lag=0.1)]
    robot = fflin.load("cubesat", inputs=wheels, outputs=outputs)
    lin = fflin.linearize(robot).with_lags().discretize(0.1)
    gain = fflin.lqr(lin)
    assert "lag.q_b.x" in gain.regulated and "lag.r_b.x" not in gain.regulated
    estimator = fflin.kalman(lin, {"omega_b": 1e-10}, 1e-8)
    assert not estimator.L[:, 3:6].any()
    assert estimator.L[:, :3].any()


def test_a_disturbance_that_a_lagging_accelerometer_feels_is_refused():
    outputs = [fflin.BasePose(), fflin.Accelerometer("base", lag=0.1)]
    robot = fflin.load("cubesat", outputs=outputs)
    lin = fflin.linearize(robot).with_lags().discretize(0.1)
    with pytest.raises(fflin.InputError, match="which have a lag"):
        fflin.kalman(lin, 1e-8, 1e-8, disturbance_noise={"F_b": 1e-8})


def test_sensitivities_refuse_delays():
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(lag=0.5)])
    lin = fflin.linearize(robot)
    for model in (lin, lin.with_lags()):
        with pytest.raises(
            fflin.InputError, match="sensitivity needs a model with the"
        ):
            fflin.sensitivity(model.discretize(0.25, delay=0.1))
