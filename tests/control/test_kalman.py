"""The Kalman filter and the compensator."""

from dataclasses import fields

import control
import numpy as np
import pytest
import scipy.linalg as sl

import fflin


@pytest.fixture(scope="module")
def lin():
    robot = fflin.load("ets_vii")
    return fflin.linearize(
        robot.replace(
            outputs=[fflin.BasePose(), fflin.JointPositions(), fflin.Gyroscope("base")]
        )
    )


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_filter_solves_its_riccati_equation(lin, dt):
    model = lin.discretize(dt) if dt else lin
    W, V = (
        np.diag(np.linspace(1, 2, 24)) * 1e-3,
        np.diag(np.linspace(1, 3, len(lin.C))) * 1e-4,
    )
    result = fflin.kalman(model, W, V)
    assert result.residual < 1e-14 and result.margin > 0.0
    A, C, P = model.A, model.C, result.P
    if dt:
        innovation = C @ P @ C.T + V
        step = A @ (P - P @ C.T @ np.linalg.solve(innovation, C @ P)) @ A.T + W
        assert step == pytest.approx(P, rel=1e-9, abs=1e-12 * P.max())
        assert result.L == pytest.approx(A @ result.L_update, abs=1e-12)
        expected, _, _ = control.dlqe(A, np.eye(24), C, W, V)
    else:
        assert result.L == pytest.approx(np.linalg.solve(V, C @ P).T)
        expected, _, _ = control.lqe(A, np.eye(24), C, W, V)
    assert result.L == pytest.approx(
        expected, rel=1e-6, abs=1e-8 * np.abs(expected).max()
    )
    poles = np.linalg.eigvals(A - result.L @ C)
    edge = 1.0 - np.abs(poles).max() if dt else -poles.real.max()
    assert result.margin == pytest.approx(edge)


def test_P_is_the_covariance_of_the_error(lin):
    """In the steady state the error e obeys de = (A - L C) e + w - L n."""
    result = fflin.kalman(lin, {"tau_b": 1.0, "F_b": 4.0, "tau_m": 0.1}, 1e-3, G=lin.B)
    assert result.W == pytest.approx(
        lin.B @ np.diag([1] * 3 + [4] * 3 + [0.1] * 6) @ lin.B.T
    )
    F = lin.A - result.L @ lin.C
    noise = result.W + result.L @ result.V @ result.L.T
    covariance = sl.solve_continuous_lyapunov(F, -noise)
    assert result.P == pytest.approx(covariance, rel=1e-6, abs=1e-9 * covariance.max())


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_compensator_gives_the_poles_of_both(lin, dt):
    model = lin.discretize(dt) if dt else lin
    M = lin.M.diagonal()
    gain = fflin.lqr(model, 1.0, M**-2.0)
    # D is not zero where accelerations are watched.
    estimator = fflin.kalman(model, 1e-2, 1e-2)
    compensator = fflin.lqg(gain, estimator)
    plant, feedback = model.to_control(), compensator.to_control()
    loop = np.block(
        [[plant.A, plant.B @ feedback.C], [feedback.B @ plant.C, feedback.A]]
    )
    poles = np.linalg.eigvals(loop)
    for pole in compensator.poles:
        assert np.abs(poles - pole).min() < 1e-6 * abs(pole - bool(dt)) + 1e-10
    assert compensator.input_names == model.output_names


def test_a_direct_term_is_carried():
    # With springs an accelerometer shows the state too.
    robot = fflin.load("ets_vii").replace(stiffness=20.0, damping=5.0)
    robot = robot.replace(outputs=[fflin.BasePose(), fflin.JointPositions()])
    robot = robot.replace(outputs=[*robot.outputs, fflin.Accelerometer("base")])
    lin = fflin.linearize(robot)
    assert lin.D.any()
    gain = fflin.lqr(lin, 1.0, lin.M.diagonal() ** -2.0)
    c = fflin.lqg(gain, fflin.kalman(lin, 1e-2, 1e-2))
    # y = C x + D u with u = c.C z.
    loop = np.block([[lin.A, lin.B @ c.C], [c.B @ lin.C, c.A + c.B @ lin.D @ c.C]])
    poles = np.linalg.eigvals(loop)
    for pole in c.poles:
        assert np.abs(poles - pole).min() < 1e-6 * abs(pole)


def test_undetectable_and_undisturbed_states_are_named(lin):
    robot = fflin.load("ets_vii")
    joints = fflin.linearize(robot.replace(outputs=[fflin.JointPositions()]))
    for model in (joints, joints.discretize(0.1)):
        words = (
            r"do not observe q_b\.x, q_b\.y, q_b\.z, r_b\.x, r_b\.y, r_b\.z and 6 more"
        )
        with pytest.raises(fflin.DetectabilityError, match=words):
            fflin.kalman(model, 1, 1)
    for words, arguments in {
        "omega_b.x": ({"q_b": 1.0}, 1),
        "V .*positive definite": (1, 0),
        "W .*positive semidefinite": (-1, 1),
        "'tau'": ({"tau": 1.0}, 1, lin.B),
        r"\(3,\)": (1, 1, np.ones(3)),
        r"\(24, 0\)": (1, 1, np.ones((24, 0))),
        "G .*rows": (1, 1, [[1.0], [1.0, 2.0]]),
        "r_b.x": (1, {"q_b": 1.0}),
        r"\(3, 2\)": (1, 1, np.ones((3, 2))),
    }.items():
        with pytest.raises(fflin.FflinError, match=words):
            fflin.kalman(lin, *arguments)
    v = fflin.velocity(robot, {"omega_b.x": 0.1})
    with pytest.raises(fflin.EquilibriumError):
        fflin.kalman(fflin.linearize(robot, None, v), 1, 1)


def test_a_position_that_no_input_pushes_is_estimated_if_it_can_be():
    """Measured and disturbed, it is estimated; otherwise the filter of the attitude remains."""
    hub = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(hub)
    gain = fflin.lqr(lin)
    assert fflin.kalman(lin, 1e-3, 1e-4).estimated == lin.state_names
    by_torque = fflin.kalman(lin, 1e-3, 1e-4, G=lin.B)
    assert by_torque.estimated == gain.regulated
    positions = [name.startswith(("r_b", "v_b")) for name in lin.output_names]
    assert sum(positions) == 6 and not by_torque.L[:, positions].any()
    assert fflin.lqg(gain, by_torque).poles.real.max() < 0.0


@pytest.mark.parametrize("name", ["ets_vii", "canadarm2", "servicer_7dof"])
def test_all_momenta_that_no_noise_excites_are_named(name):
    """Noise of the joint torques alone changes none of the six momenta of the robot."""
    lin = fflin.linearize(fflin.load(name))
    base = ", ".join(
        f"{group}.{axis}" for group in ("omega_b", "v_b") for axis in "xyz"
    )
    with pytest.raises(fflin.InputError, match=f"W does not excite {base}, whose"):
        fflin.kalman(lin, {"tau_m": 1e-6}, 1e-4, G=lin.B)


def test_parts_of_different_models_are_refused(lin):
    gain = fflin.lqr(lin, 1, 1)
    with pytest.raises(fflin.InputError, match="models"):
        fflin.lqg(gain, fflin.kalman(lin.discretize(0.1), 1, 1))
    with pytest.raises(fflin.InputError, match="Gain"):
        fflin.lqg(gain, gain)


@pytest.mark.parametrize("ending", ["npz", "mat", "json"])
def test_files_keep_every_bit(lin, tmp_path, ending):
    estimator = fflin.kalman(lin, 1, 1)
    for design in (estimator, fflin.lqg(fflin.lqr(lin, 1, 1), estimator)):
        path = tmp_path / f"design.{ending}"
        design.save(path)
        back = type(design).load(path)
        for item in fields(design):
            assert np.array_equal(
                getattr(design, item.name), getattr(back, item.name)
            ), item.name
        with pytest.raises(fflin.FileError, match=f"Gain.*{type(design).__name__}"):
            fflin.Gain.load(path)


@pytest.mark.parametrize("name", ["planar_detumble", "servicer_7dof"])
def test_an_intensity_that_overflows_is_refused(name, robots):
    lin = fflin.linearize(robots[name])
    with (
        np.errstate(all="ignore"),
        pytest.raises(fflin.DetectabilityError, match="scale"),
    ):
        fflin.kalman(lin, 1e308, 1e-4, G=lin.B)


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_reports_show_the_slowest_pole_and_the_states_that_are_not_estimated(dt):
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=1e-3)
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), fflin.BaseForce(), wheel])
    lin = fflin.linearize(robot)
    model = lin.discretize(dt) if dt else lin
    estimator = fflin.kalman(model, 1e-3, 1e-4)
    compensator = fflin.lqg(fflin.lqr(model), estimator)
    time = "sampled at 0.1 s" if dt else "continuous"
    for design in (estimator, compensator):
        rates = np.log(design.poles).real / dt if dt else design.poles.real
        first, *others = str(design).splitlines()
        assert first.startswith(
            f"{len(design.poles)} poles, slowest decay {-rates.max():.3g} 1/s"
        )
        assert time in " ".join(" ".join(others).split())
    assert "not estimated: q_m.wheel_1, which" in " ".join(str(estimator).split())
