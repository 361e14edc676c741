"""Estimated disturbances and biases, and compensators that reject the disturbances."""

import control
import numpy as np
import pytest
import scipy.linalg as sl
from scipy.stats import chi2

import fflin
from fflin.control.lqg import require_one_integrator
from fflin.control.optimal.riccati import rates_of
from fflin.control.rejection import rejection
from tests.support.c_code import needs_compiler
from tests.support.marks import exhaustive
from tests.support.quadrotor import quadrotor

DEGREE = np.pi / 180.0
SENSORS = [fflin.BasePose(), fflin.Gyroscope("base")]
NOISE = {"q_b": 1e-9, "r_b": 1e-4, "gyroscope": 1e-9}
TORQUE_NOISE = {"tau_b": 1e-13}
BIAS_NOISE = {"gyroscope": 1e-13}
W = {"omega_b": 1e-12}
SAMPLE = 0.25


def body(outputs=SENSORS, **fields):
    return fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=outputs, **fields)


def satellite(name="cubesat"):
    """The robot with its wheels as the only actuators of the base."""
    robot = fflin.load(name)
    inputs, outputs = robot.inputs, SENSORS
    if name == "cubesat":
        inputs = fflin.load_inputs("cubesat")
    else:
        arm = tuple(x for x in robot.joint_names if x.startswith("arm"))
        outputs = [*SENSORS, fflin.JointPositions(arm)]
    kept = [item for item in inputs if not isinstance(item, fflin.Thruster)]
    return robot.replace(inputs=kept, outputs=outputs)


def estimator_of(lin, **options):
    given = {"disturbance_noise": TORQUE_NOISE, "bias_noise": BIAS_NOISE} | options
    white = {**W, "v_b": 1e-9, "qdot_m": 1e-9}
    noise = {**NOISE, "q_m": 1e-9}
    return fflin.kalman(lin, *_named(lin, white, noise), **given)


def _named(lin, white, noise):
    """Return the entries of W and V that the model has."""
    groups = [{name.split(".")[0] for name in lin.state_names}, set()]
    for name in lin.output_names:
        groups[1] |= {name.split(".")[0], name.split(".")[-2]}
    return [
        {key: value for key, value in given.items() if key in known}
        for given, known in zip((white, noise), groups, strict=True)
    ]


def rows_of(names, wanted):
    return [names.index(name) for name in wanted]


def held_input(A, B, h):
    """Return the exact effect (nx, k) of held inputs over one sample, from the exponential."""
    nx, k = B.shape
    block = np.zeros((nx + k, nx + k))
    block[:nx] = np.hstack((A, B))
    return sl.expm(block * h)[:nx, nx:]


def torque_effect(lin):
    """Return the effect (nx, 3) of external torques on the base, held over one sample."""
    source = lin.generator
    nv = len(source.M)
    B = np.zeros((len(source.A), 3))
    B[-nv:] = np.linalg.inv(source.M)[:, :3]
    if lin.dt:
        return held_input(source.A, B, lin.dt)
    return B


def test_the_closed_forms_of_single_axes():
    """Each axis of a body with a diagonal inertia is q' = w/2, w' = d/J, d' = noise.

    Noise on d alone gives Butterworth poles, the roots of s^6 = -(intensity/(4 J^2 V)).
    """
    lin = fflin.linearize(body([fflin.BasePose()]))
    J = np.diag(lin.M)[:3]
    V, intensity = 1e-6, 1e-8
    estimator = fflin.kalman(lin, 0.0, V, disturbance_noise={"tau_b": intensity})
    assert np.allclose(lin.M[:3, :3], np.diag(J), atol=1e-9 * J.max())
    expected = []
    for inertia in J:
        radius = (intensity / (4.0 * inertia**2 * V)) ** (1.0 / 6.0)
        angles = np.pi * np.array([2.0 / 3.0, 1.0, 4.0 / 3.0])
        expected += list(radius * np.exp(1j * angles))
    poles = sorted(estimator.poles, key=lambda p: (round(p.real, 9), p.imag))
    for pole in expected:
        assert np.abs(np.array(poles) - pole).min() < 1e-9 * abs(pole)
    assert len(poles) == 9


@pytest.mark.parametrize("dt", [0.0, SAMPLE])
def test_the_filter_of_one_axis_equals_a_filter_by_hand(dt):
    """Attitude q, rate w, torque d and gyroscope bias b of one axis, by python-control."""
    lin = fflin.linearize(body())
    estimator = estimator_of(lin.discretize(dt) if dt else lin)
    J = lin.M[0, 0]
    A = np.array([[0, 0.5, 0, 0], [0, 0, 1 / J, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    C = np.array([[1.0, 0, 0, 0], [0, 1, 0, 1]])
    random_walks = np.diag([0.0, 0.0, 1e-13, 1e-13])
    white = np.diag([0.0, 1e-12, 0.0, 0.0])
    # python-control needs states and outputs of comparable sizes.
    unit, noise = np.array([1e-5, 1e-5, 1e-7, 1e-6]), np.sqrt(1e-9)
    F, H = A * unit / unit[:, None], C * unit / noise
    if dt:
        times, weights = np.polynomial.legendre.leggauss(8)
        times, weights = 0.5 * dt * (times + 1.0), 0.5 * dt * weights
        steps = [sl.expm(A * t) for t in times]
        walks = sum(
            w * E @ random_walks @ E.T for w, E in zip(weights, steps, strict=True)
        )
        driving = (white + walks) / np.outer(unit, unit)
        L, P, _ = control.dlqe(sl.expm(F * dt), np.eye(4), H, driving, np.eye(2))
    else:
        driving = (white + random_walks) / np.outer(unit, unit)
        L, P, _ = control.lqe(F, np.eye(4), H, driving, np.eye(2))
    L, P = unit[:, None] * L / noise, P * np.outer(unit, unit)
    states = ("q_b.x", "omega_b.x", "disturbance.tau_b.x", "bias.base.gyroscope.x")
    at = rows_of(estimator.state_names, states)
    seen = rows_of(estimator.output_names, ("q_b.x", "base.gyroscope.x"))
    size = np.sqrt(P.diagonal())
    result = estimator.P[np.ix_(at, at)] / np.outer(size, size)
    assert result == pytest.approx(P / np.outer(size, size), abs=1e-9)
    assert estimator.L[np.ix_(at, seen)] / size[:, None] == pytest.approx(
        L / size[:, None], rel=1e-8, abs=1e-9 * np.abs(L / size[:, None]).max()
    )
    assert estimator.residual < 1e-13
    others = [i for i in range(len(estimator.P)) if i not in at]
    assert np.abs(estimator.P[np.ix_(at, others)]).max() < 1e-9 * P.max()


@pytest.mark.parametrize("dt", [0.0, SAMPLE])
def test_a_disturbance_that_is_also_an_input_acts_as_this_input(dt):
    lin = fflin.linearize(body([*SENSORS, fflin.Accelerometer("base")]))
    model = lin.discretize(dt) if dt else lin
    noise = {**NOISE, "acceleration": 1e-8}
    estimator = fflin.kalman(model, W, noise, disturbance_noise=TORQUE_NOISE)
    nx = len(lin.A)
    scale = np.abs(model.B).max()
    assert np.abs(estimator.A[:nx, nx:] - model.B).max() < 1e-12 * scale
    assert np.abs(estimator.C[:, nx:] - model.D).max() < 1e-12


def test_an_accelerometer_feels_an_external_force():
    """The acceleration at the centre of mass is F/m, although no input pushes the base."""
    robot = body([fflin.BasePose(), fflin.Accelerometer("base")])
    lin = fflin.linearize(robot)
    estimator = fflin.kalman(
        lin, {"omega_b": 1e-9, "v_b": 1e-9}, 1e-6, disturbance_noise={"F_b.y": 1e-6}
    )
    row = lin.output_names.index("base.acceleration.y")
    assert estimator.C[row, -1] == pytest.approx(1.0 / robot.mass, rel=1e-12)


@pytest.mark.parametrize("dt", [0.0, SAMPLE])
@pytest.mark.parametrize("frequency", [None, 0.01])
@pytest.mark.parametrize("name", ["cubesat", "inspector.toml"])
def test_the_regulator_equations_hold(dt, frequency, name):
    """K Pi + Gamma of the compensator belongs to Pi and Gamma that solve both equations."""
    lin = fflin.linearize(satellite(name))
    model = lin.discretize(dt) if dt else lin
    options = {"disturbance_frequency": {"tau_b": frequency}} if frequency else {}
    estimator = estimator_of(model, **options)
    gain = fflin.lqr(model)
    compensator = fflin.lqg(gain, estimator)
    # the same equations as one linear system for [Pi; Gamma]
    nx = len(lin.A)
    at = rows_of(gain.state_names, gain.regulated)
    states = rows_of(estimator.state_names, estimator.disturbances)
    A, B = gain.A[np.ix_(at, at)], gain.B[at]
    acting = estimator.A[np.ix_(at, states)]
    A_w = estimator.A[np.ix_(states, states)]
    kept = [x for x in gain.regulated if x.startswith(("q_b.", "r_b."))]
    kept += [x for x in gain.regulated if x.startswith("q_m.arm")]
    H = np.eye(len(at))[rows_of(gain.regulated, kept)]
    nr, nu, nw = len(A), B.shape[1], len(states)
    motion = np.hstack(
        (np.kron(np.eye(nw), A) - np.kron(A_w.T, np.eye(nr)), np.kron(np.eye(nw), B))
    )
    hold = np.hstack((np.kron(np.eye(nw), H), np.zeros((nw * len(H), nw * nu))))
    right = np.concatenate((-acting.T.ravel(), np.zeros(nw * len(H))))
    solution = np.linalg.lstsq(np.vstack((motion, hold)), right, rcond=1e-13)[0]
    Pi = solution[: nw * nr].reshape(nw, nr).T
    Gamma = solution[nw * nr :].reshape(nw, nu).T
    change = A @ Pi - Pi @ A_w + B @ Gamma + acting
    assert np.abs(change).max() < 1e-9 * np.abs(acting).max()
    z = rows_of(compensator.state_names, compensator.disturbances)
    expected = gain.K[:, at] @ Pi + Gamma
    assert compensator.C[:, z] == pytest.approx(
        expected, abs=1e-7 * np.abs(expected).max()
    )
    biases = rows_of(compensator.state_names, compensator.biases)
    assert not compensator.C[:, biases].any()
    assert len(compensator.biases) == 3 and nx + nw + 3 == len(estimator.A)


def test_the_cheapest_inputs_that_hold_a_state_are_chosen():
    """Two inputs push a double integrator; the cheaper takes the share 1/R of each."""
    A = np.array([[0.0, 1.0], [0.0, 0.0]])
    B = np.array([[0.0, 0.0], [1.0, 1.0]])
    acting = (np.array([[0.0], [3.0]]), np.zeros((1, 1)))
    result = rejection(
        A, B, acting, np.eye(2)[:1], (np.eye(2), np.diag([1.0, 2.0])), 0.0
    )
    assert result.Gamma.ravel() == pytest.approx([-2.0, -1.0], rel=1e-12)
    assert np.abs(result.Pi).max() < 1e-12 and not result.displaced.any()


@pytest.mark.parametrize("dt", [0.0, SAMPLE])
def test_the_compensator_has_the_poles_of_the_disturbance(dt):
    lin = fflin.linearize(satellite().replace(outputs=[fflin.BasePose()]))
    model = lin.discretize(dt) if dt else lin
    frequency = 0.02
    options = {"disturbance_noise": TORQUE_NOISE}
    options |= {"disturbance_frequency": {"tau_b": frequency}}
    estimator = fflin.kalman(model, W, 1e-9, **options)
    compensator = fflin.lqg(fflin.lqr(model), estimator)
    poles = np.linalg.eigvals(compensator.A)
    rate = 2.0 * np.pi * frequency
    constant, periodic = 0.0, 1j * rate
    if dt:
        constant, periodic = 1.0, np.exp(1j * rate * dt)
    for pole in (constant, periodic):
        assert (np.abs(poles - pole) < 1e-7).sum() == 3


@pytest.mark.parametrize("name", ["cubesat", "inspector.toml"])
def test_a_constant_torque_leaves_no_attitude_error_in_the_linear_loop(name):
    model = fflin.linearize(satellite(name)).discretize(SAMPLE)
    gain = fflin.lqr(model)
    compensator = fflin.lqg(gain, estimator_of(model))
    without = estimator_of(model, disturbance_noise=None, bias_noise=None)
    without = fflin.lqg(gain, without)
    torque = torque_effect(model) @ np.array([2e-5, -1e-5, 1e-5])
    bias = np.zeros(len(model.C))
    bias[rows_of(model.output_names, [f"base.gyroscope.{x}" for x in "xyz"])] = 3e-5
    at = rows_of(model.state_names, gain.regulated)
    errors = []
    for law in (compensator, without):
        A, B = model.A[np.ix_(at, at)], model.B[at]
        C = model.C[:, at]
        loop = np.block([[A, B @ law.C], [law.B @ C, law.A + law.B @ model.D @ law.C]])
        driven = np.concatenate((torque[at], law.B @ bias))
        steady = np.linalg.solve(np.eye(len(loop)) - loop, driven)
        attitude = steady[[gain.regulated.index(f"q_b.{x}") for x in "xyz"]]
        errors.append(2.0 * np.abs(attitude).max() / DEGREE)
    assert errors[0] < 1e-5
    assert errors[1] > 1e-2


def test_a_periodic_torque_leaves_no_error_at_the_samples():
    """The exact response of the loop to a sinusoid of the known frequency."""
    frequency = 0.01
    model = fflin.linearize(satellite()).discretize(SAMPLE)
    gain = fflin.lqr(model)
    estimator = estimator_of(model, disturbance_frequency={"tau_b": [frequency]})
    constant = fflin.lqg(gain, estimator_of(model))
    periodic = fflin.lqg(gain, estimator)
    pole = 2j * np.pi * frequency
    source = model.generator
    acting = np.zeros(len(source.A))
    acting[-len(source.M) :] = np.linalg.inv(source.M)[:, 0] * 2e-5
    # x' = A x + b e^(p t) gives x_k+1 = e^(A h) x_k + g e^(p h k)
    block = np.zeros((len(source.A) + 1, len(source.A) + 1), dtype=complex)
    block[:-1, :-1], block[:-1, -1], block[-1, -1] = source.A, acting, pole
    forcing = sl.expm(block * SAMPLE)[:-1, -1]
    z = np.exp(pole * SAMPLE)
    at = rows_of(model.state_names, gain.regulated)
    errors = []
    for law in (periodic, constant):
        A, B, C = model.A[np.ix_(at, at)], model.B[at], model.C[:, at]
        loop = np.block([[A, B @ law.C], [law.B @ C, law.A]])
        driven = np.concatenate((forcing[at], np.zeros(len(law.A))))
        steady = np.linalg.solve(z * np.eye(len(loop)) - loop, driven)
        attitude = steady[gain.regulated.index("q_b.x")]
        errors.append(2.0 * abs(attitude) / DEGREE)
    assert errors[0] < 1e-8
    assert errors[1] > 1e-2


@pytest.mark.exhaustive
def test_a_constant_torque_is_rejected_in_the_simulation_with_wheels():
    robot = satellite()
    model = fflin.linearize(robot).discretize(SAMPLE)
    gain = fflin.lqr(model)
    law = fflin.OutputFeedback(model, fflin.lqg(gain, estimator_of(model)))
    torque = {"tau_b.x": 2e-5, "tau_b.y": -1e-5}
    motion = fflin.simulate(
        robot, law, duration=200.0, dt=0.05, every=20, disturbance=torque
    )
    assert motion.attitude_error.max() > 0.05
    assert motion.attitude_error[-1] < 1e-3
    assert not motion.stopped


@pytest.mark.exhaustive
def test_a_constant_torque_is_rejected_in_the_simulation_with_wings_and_wheels():
    robot = satellite("inspector.toml")
    model = fflin.linearize(robot).discretize(SAMPLE)
    estimator = fflin.kalman(
        model,
        {"omega_b": 1e-12, "qdot_m": 1e-12},
        {**NOISE, "q_m": 1e-9},
        disturbance_noise={"tau_b": 1e-8},
        bias_noise=BIAS_NOISE,
    )
    law = fflin.OutputFeedback(model, fflin.lqg(fflin.lqr(model), estimator))
    motion = fflin.simulate(
        robot,
        law,
        q0=robot.neutral(),
        duration=100.0,
        dt=0.0125,
        every=400,
        disturbance={"tau_b.x": 2e-5, "tau_b.z": 2e-3},
    )
    assert motion.attitude_error.max() > 1e-3
    assert motion.attitude_error[-1] < 1e-3


@pytest.fixture(scope="module")
def runs():
    """Errors (runs, n) of the estimate after 1,000 seeded runs of the closed linear loop."""
    rng = np.random.default_rng(46)
    model = fflin.linearize(body()).discretize(SAMPLE)
    gain = fflin.lqr(model)
    estimator = estimator_of(model)
    law = fflin.lqg(gain, estimator)
    names = estimator.estimated
    at = rows_of(estimator.state_names, names)
    A, B = estimator.A[np.ix_(at, at)], estimator.B[at]
    C, P = estimator.C[:, at], estimator.P[np.ix_(at, at)]
    used = estimator.L.any(axis=0)
    driving = np.linalg.cholesky(estimator.W[np.ix_(at, at)] + 1e-30 * np.eye(len(at)))
    noise = np.sqrt(estimator.V.diagonal())
    count = 1000
    truth = rng.normal(size=(count, len(at))) @ np.linalg.cholesky(P).T
    estimate = np.zeros_like(truth)
    for _ in range(400):
        u = estimate @ law.C.T
        y = truth @ C.T + rng.normal(size=(count, len(noise))) * noise
        y[:, ~used] = 0.0
        estimate = estimate @ law.A.T + y @ law.B.T
        truth = truth @ A.T + u @ B.T + rng.normal(size=truth.shape) @ driving.T
    return names, truth - estimate, P


@pytest.mark.parametrize("axis", "xyz")
@pytest.mark.parametrize("state", ["bias.base.gyroscope", "disturbance.tau_b"])
def test_biases_and_torques_are_within_their_covariance_in_95_of_100_runs(
    runs, state, axis
):
    names, error, P = runs
    i = names.index(f"{state}.{axis}")
    inside = np.abs(error[:, i]) <= 1.96 * np.sqrt(P[i, i])
    assert 0.93 <= inside.mean() <= 0.97


def test_the_normalised_error_squared_is_within_its_chi_square_band(runs):
    _, error, P = runs
    count, n = error.shape
    scale = np.sqrt(P.diagonal())
    scaled = error / scale
    nees = (scaled @ np.linalg.inv(P / np.outer(scale, scale)) * scaled).sum(axis=1)
    low, high = chi2.ppf([0.025, 0.975], count * n) / count
    assert low <= nees.mean() <= high


def test_states_that_the_outputs_cannot_distinguish_are_named():
    lin = fflin.linearize(body())
    for model in (lin, lin.discretize(SAMPLE)):
        for words, options in {
            r"cannot distinguish bias\.q_b\.x from q_b\.x;": {
                "bias_noise": {"q_b.x": 1e-9}
            },
            r"do not show disturbance\.F_b\.x, ": {"disturbance_noise": {"F_b": 1e-9}},
        }.items():
            with pytest.raises(fflin.DetectabilityError, match=words):
                fflin.kalman(model, W, NOISE, **options)
    # A bias of the attitude and a periodic torque are distinguished from a constant attitude only
    # by the gyroscope.
    two = [fflin.BasePose(), fflin.FramePose("base")]
    lin = fflin.linearize(body(two))
    noise = {"q_b": 1e-9, "r_b": 1e-4, "rotation": 1e-9, "position": 1e-4}
    estimator = fflin.kalman(lin, W, noise, bias_noise={"q_b": 1e-12})
    assert estimator.biases == ("bias.q_b.x", "bias.q_b.y", "bias.q_b.z")
    with pytest.raises(
        fflin.DetectabilityError, match=r"rotation\.x from q_b\.x and bias\.q_b"
    ):
        fflin.kalman(lin, W, noise, bias_noise={"q_b": 1e-12, "rotation": 1e-12})


def test_a_disturbance_that_no_input_can_reject_is_named(tmp_path):
    """A drone must tilt to resist a wind, so its attitude cannot stay at zero."""
    robot = quadrotor(tmp_path, arm=False, outputs=[fflin.BasePose()])
    lin = fflin.linearize(robot, u=fflin.equilibrium(robot).u)
    gain = fflin.lqr(lin)
    noise = {"q_b": 1e-8, "r_b": 1e-6}
    wind = {"F_b.x": 1e-4, "F_b.z": 1e-4}
    estimator = fflin.kalman(lin, 1e-6, noise, disturbance_noise=wind)
    words = r"no input can reject the disturbance F_b\.x: it displaces q_b\.y in"
    with pytest.raises(fflin.InputError, match=words):
        fflin.lqg(gain, estimator)
    compensator = fflin.lqg(gain, estimator, zero_error=["r_b"])
    # The steady state of the loop under the wind: no error of the position, a tilt F/(m g)
    loop = np.block(
        [[lin.A, lin.B @ compensator.C], [compensator.B @ lin.C, compensator.A]]
    )
    force = np.zeros(len(lin.A))
    force[lin.state_names.index("v_b.x")] = 0.1 / robot.mass
    driven = np.concatenate((force, np.zeros(len(compensator.A))))
    steady = np.linalg.solve(loop, -driven)
    position = [lin.state_names.index(f"r_b.{axis}") for axis in "xyz"]
    assert np.abs(steady[position]).max() < 1e-9
    tilt = 2.0 * steady[lin.state_names.index("q_b.y")]
    assert tilt == pytest.approx(-0.1 / (robot.mass * 9.81), rel=1e-9)
    with pytest.raises(fflin.UnknownNameError, match="q_m"):
        fflin.lqg(gain, estimator, zero_error=["q_m"])


@pytest.mark.parametrize("dt", [0.0, SAMPLE])
def test_a_force_on_a_spring_displaces_the_spring_and_no_motor(dt):
    robot = satellite("inspector.toml")
    lin = fflin.linearize(robot.replace(outputs=[*SENSORS, fflin.JointPositions()]))
    model = lin.discretize(dt) if dt else lin
    estimator = estimator_of(
        model, disturbance_noise={"hinge_left_1": 1e-9}, bias_noise=None
    )
    gain = fflin.lqr(model)
    compensator = fflin.lqg(gain, estimator)
    assert compensator.disturbances == ("disturbance.tau_m.hinge_left_1",)
    # The spring of 60 N m/rad carries the torque, so no input acts in the steady state.
    at = rows_of(gain.state_names, gain.regulated)
    Pi = np.zeros(len(at))
    Pi[gain.regulated.index("q_m.hinge_left_1")] = 1.0 / 60.0
    expected = gain.K[:, at] @ Pi
    assert compensator.C[:, -1] == pytest.approx(
        expected, abs=1e-7 * np.abs(expected).max()
    )
    words = r"tau_m\.hinge_left_1: it displaces q_m\.hinge_left_1 in"
    for names in ("q_m", ["q_m.hinge_left_1"]):
        with pytest.raises(fflin.InputError, match=words):
            fflin.lqg(gain, estimator, zero_error=names)


@pytest.mark.parametrize("delay", [0.0, 0.3])
def test_under_limits_the_filter_predicts_with_the_applied_inputs(delay):
    """A z + B dy + E (applied - commanded) is the prediction of the filter."""
    lin = fflin.linearize(body()).discretize(SAMPLE, delay=delay)
    estimator = estimator_of(lin)
    law = fflin.OutputFeedback(lin, fflin.lqg(fflin.lqr(lin), estimator))
    compensator = law.compensator
    rng = np.random.default_rng(3)
    z = rng.normal(size=len(compensator.A))
    dy = rng.normal(size=len(estimator.C))
    applied = 0.1 * rng.normal(size=3)
    S = np.eye(len(estimator.A))[
        rows_of(estimator.state_names, compensator.state_names)
    ]
    xh = S.T @ z
    innovation = dy - estimator.C @ xh - estimator.D @ applied
    expected = S @ (estimator.A @ xh + estimator.B @ applied + estimator.L @ innovation)
    commanded = compensator.C @ z
    next_z = compensator.A @ z + compensator.B @ dy
    next_z += law.windup @ (applied - commanded)
    assert np.abs(next_z - expected).max() < 1e-12 * np.abs(expected).max()
    assert np.abs(law.windup).max() > 0.01 * np.abs(estimator.B).max()


@pytest.mark.parametrize("delay", [0.1, 0.25, 0.6])
def test_a_constant_torque_leaves_no_error_with_delayed_inputs(delay):
    """The torque itself is not delayed."""
    lin = fflin.linearize(body())
    late = lin.discretize(SAMPLE, delay=delay)
    estimator = estimator_of(late, disturbance_noise={"tau_b": 1e-10}, bias_noise=None)
    law = fflin.OutputFeedback(late, fflin.lqg(fflin.lqr(late), estimator))
    loop, _ = law.closed_loop()
    pushed = np.zeros(len(loop))
    pushed[:12] = lin.discretize(SAMPLE).B[:, 0] * 2e-5
    x = np.zeros(len(loop))
    attitudes = []
    for _ in range(2000):
        x = loop @ x + pushed
        attitudes.append(np.abs(x[:3]).max())
    assert attitudes[-1] < 1e-5 * max(attitudes)
    assert max(attitudes) > 1e-6
    estimate = x[len(late.A) :][
        law.compensator.state_names.index("disturbance.tau_b.x")
    ]
    assert estimate == pytest.approx(2e-5, rel=1e-5)


def test_integral_action_and_an_estimated_disturbance_are_refused():
    words = r"integral\.q_b\.x.*disturbance\.tau_b\.x.*two integrators for one channel"
    with pytest.raises(fflin.InputError, match=words):
        require_one_integrator(["integral.q_b.x"], ["disturbance.tau_b.x"])
    require_one_integrator(["integral.q_b.x"], [])
    require_one_integrator([], ["disturbance.tau_b.x"])


def test_wrong_disturbances_and_biases_are_refused():
    lin = fflin.linearize(body())
    sampled = lin.discretize(SAMPLE)
    for words, options in {
        "disturbance_noise of 'tau_b' is 0": {"disturbance_noise": {"tau_b": 0.0}},
        "'tau'": {"disturbance_noise": {"tau": 1.0}},
        "mapping": {"disturbance_noise": 1.0},
        "bias_noise of 'gyroscope' is -1": {"bias_noise": {"gyroscope": -1.0}},
        "'omega_b'": {"bias_noise": {"omega_b": 1.0}},
        "disturbance_noise has no intensity": {
            "disturbance_frequency": {"tau_b.x": 1e-3}
        },
        "less than half the sampling frequency, 2 Hz": {
            "disturbance_noise": TORQUE_NOISE,
            "disturbance_frequency": {"tau_b": [0.1, 2.5]},
        },
        "a frequency twice": {
            "disturbance_noise": TORQUE_NOISE,
            "disturbance_frequency": {"tau_b": [0.1, 0.1]},
        },
        "is -0.1 Hz": {
            "disturbance_noise": TORQUE_NOISE,
            "disturbance_frequency": {"tau_b": -0.1},
        },
        "expected one": {
            "bias_noise": {"gyroscope": {"bias_instability": 1, "rate_random_walk": 1}}
        },
        "for outputs in rad/s": {"bias_noise": {"r_b": {"bias_instability": 1}}},
        "'bias_instabilty'": {"bias_noise": {"gyroscope": {"bias_instabilty": 1}}},
    }.items():
        with pytest.raises(fflin.FflinError, match=words):
            fflin.kalman(sampled, W, NOISE, **options)
    noise = {**NOISE, "q_b": {"noise_equivalent_angle": 5.0}}
    with pytest.raises(fflin.InputError, match="continuous"):
        fflin.kalman(lin, W, noise)
    wheeled = satellite().replace(outputs=[*SENSORS, fflin.JointVelocities()])
    with pytest.raises(fflin.InputError, match="does not use qdot_m"):
        fflin.kalman(
            fflin.linearize(wheeled),
            W,
            {**NOISE, "qdot_m": 1.0},
            bias_noise={"qdot_m": 1.0},
        )


def test_a_sampled_model_from_a_file_estimates_biases_but_no_disturbances(tmp_path):
    model = fflin.linearize(body()).discretize(SAMPLE)
    model.save(tmp_path / "model.npz")
    read = fflin.LinearModel.load(tmp_path / "model.npz")
    biased = [
        fflin.kalman(lin, W, NOISE, bias_noise=BIAS_NOISE) for lin in (model, read)
    ]
    assert biased[0].L == pytest.approx(biased[1].L, rel=1e-9)
    with pytest.raises(fflin.InputError, match="continuous model"):
        fflin.kalman(read, W, NOISE, disturbance_noise=TORQUE_NOISE)


def test_figures_of_data_sheets_are_converted():
    """The standard deviations of an error that accumulates for one hour, by hand."""
    model = fflin.linearize(body()).discretize(SAMPLE)
    noise = {
        "q_b": {"noise_equivalent_angle": 10.0},
        "r_b": 1e-4,
        "gyroscope": {"angle_random_walk": 0.3},
    }
    estimator = fflin.kalman(
        model, W, noise, bias_noise={"gyroscope": {"bias_instability": 2.0}}
    )
    V = dict(zip(model.output_names, estimator.V.diagonal(), strict=True))
    # half of 10 arc seconds
    assert np.sqrt(V["q_b.y"]) == pytest.approx(10.0 / 3600.0 * DEGREE / 2.0)
    # the angle after 1 h of samples, each of which counts for one sample time
    samples = 3600.0 / SAMPLE
    angle = np.sqrt(samples * V["base.gyroscope.z"]) * SAMPLE
    assert angle == pytest.approx(0.3 * DEGREE)
    bias = estimator.state_names.index("bias.base.gyroscope.x")
    drift = np.sqrt(estimator.W[bias, bias] * samples)
    assert drift == pytest.approx(2.0 * DEGREE / 3600.0)
    walk = fflin.kalman(
        model, W, noise, bias_noise={"gyroscope": {"rate_random_walk": 2.0}}
    )
    assert walk.W == pytest.approx(estimator.W)


@pytest.mark.parametrize("ending", ["npz", "mat", "json"])
def test_reports_and_files_keep_disturbances_and_biases(ending, tmp_path):
    model = fflin.linearize(body()).discretize(SAMPLE)
    estimator = estimator_of(model, disturbance_frequency={"tau_b.x": 1.65e-4})
    compensator = fflin.lqg(fflin.lqr(model), estimator)
    for design in (estimator, compensator):
        text = " ".join(str(design).split())
        assert "estimated disturbances: tau_b.x, tau_b.x.0.000165Hz, " in text
        assert "estimated biases: base.gyroscope.x, base.gyroscope.y, " in text
        assert "estimated biases" in design._repr_html_()
        path = tmp_path / f"design.{ending}"
        design.save(path)
        back = type(design).load(path)
        assert back.disturbances == design.disturbances
        assert back.biases == design.biases
        assert np.array_equal(back.A, design.A)
    assert compensator.to_control().nstates == len(compensator.A)


@exhaustive
@needs_compiler
def test_the_exported_law_equals_python_over_ten_thousand_samples(tmp_path):
    robot = satellite()
    model = fflin.linearize(robot).discretize(SAMPLE)
    estimator = estimator_of(model, disturbance_frequency={"tau_b.x": 1e-3})
    law = fflin.OutputFeedback(model, fflin.lqg(fflin.lqr(model), estimator))
    code = fflin.CLaw(fflin.write_c(law, tmp_path))
    ours, theirs = (policy.bind(robot) for policy in (law, code))
    rng = np.random.default_rng(5)
    difference = largest = 0.0
    for k in range(10_000):
        rpy = 2.0 * rng.normal(size=3)
        q = fflin.configuration(robot, rpy=rpy)
        v = 1e-2 * rng.normal(size=robot.nv)
        one, other = (policy(k * SAMPLE, q, v) for policy in (ours, theirs))
        difference = max(difference, np.abs(one - other).max())
        largest = max(largest, np.abs(one).max())
    assert difference < 1e-12 * max(largest, 1.0)
    assert largest > 1e-3


def test_a_bias_that_settles_far_slower_than_the_loop_is_noted(tmp_path):
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose(), fflin.Gyroscope("base")],
    )
    lin = fflin.linearize(robot).discretize(0.25)
    gain = fflin.lqr(lin)
    loop = -rates_of(gain.poles, 0.25).real.min()
    noise = {"q_b": 1e-10, "r_b": 1e-4, "gyroscope": 1e-10}

    def compensator(bias):
        estimator = fflin.kalman(
            lin, {"omega_b": 1e-12}, noise, bias_noise={"gyroscope.x": bias}
        )
        return estimator, fflin.lqg(gain, estimator)

    estimator, slow = compensator(1e-18)
    # The bias is the only slow state of the filter.
    decay = (-rates_of(estimator.poles, 0.25).real).min()
    assert 0.0 < 10.0 * decay < loop
    expected = f"settles with a time constant of {1.0 / decay:.3g} s"
    assert slow.slow_bias.startswith("the estimate of bias.")
    assert expected in slow.slow_bias and "gyroscope.x" in slow.slow_bias
    assert expected in " ".join(str(slow).split())
    slow.save(tmp_path / "law.json")
    assert fflin.Compensator.load(tmp_path / "law.json").slow_bias == slow.slow_bias
    policy = fflin.OutputFeedback(lin, slow)
    motion = fflin.simulate(robot, policy, duration=1.0)
    assert slow.slow_bias in motion.notes
    fast = compensator(1e-11)[1]
    assert not fast.slow_bias and not fflin.OutputFeedback(lin, fast).notes
    without = fflin.lqg(gain, fflin.kalman(lin, {"omega_b": 1e-12}, noise))
    assert not without.slow_bias
