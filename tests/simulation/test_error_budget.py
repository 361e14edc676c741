"""Error budgets equal closed forms, brute-force recursions and simulated motions."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import expm
from scipy.stats import chi2

import fflin
from fflin.base.errors import InputError, UnknownNameError
from fflin.dynamics.disturbance import BaseDisturbance, phasors_of, plate_phasors
from fflin.dynamics.orbital import OrbitField
from fflin.dynamics.state_rows import attitude_rotations
from tests.control.test_multirate import W, designed

DEGREES = np.degrees(1.0)


@pytest.fixture(scope="module")
def satellite():
    """Return the model of a satellite with a torque, and its gain."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(robot)
    return robot, lin, fflin.lqr(lin)


def double_integrator(lin, gain, axis):
    """Return a, b and L of the loop angle'' = -a angle - b rate + L torque about an axis."""
    names = lin.state_names
    row = "xyz".index(axis)
    L = lin.B[names.index(f"omega_b.{axis}"), row]
    kp = gain.K[row, names.index(f"q_b.{axis}")]
    kd = gain.K[row, names.index(f"omega_b.{axis}")]
    return 0.5 * L * kp, L * kd, L


def test_a_double_integrator_has_the_variances_of_its_closed_form(satellite):
    _, lin, gain = satellite
    a, b, L = double_integrator(lin, gain, "y")
    n = 1e-4
    budget = fflin.error_budget(gain, lin, force_noise={"tau_b.y": n})
    angle = budget.error("attitude.y")["white tau_b.y"]
    assert angle == pytest.approx(DEGREES * L * n / np.sqrt(2.0 * a * b), rel=1e-9)
    rate = budget.error("omega_b.y")["white tau_b.y"]
    assert rate == pytest.approx(L * n / np.sqrt(2.0 * b), rel=1e-9)
    budget = fflin.error_budget(gain, lin, noise={"q_b": n, "omega_b": 2.0 * n})
    errors = budget.error("attitude.y")
    expected = DEGREES * n * np.sqrt(2.0 * a / b)
    assert errors["noise of q_b"] == pytest.approx(expected, rel=1e-9)
    expected = DEGREES * 2.0 * n * np.sqrt(b / (2.0 * a))
    assert errors["noise of omega_b"] == pytest.approx(expected, rel=1e-9)


def test_constants_and_sinusoids_have_the_gains_of_the_closed_form(satellite):
    _, lin, gain = satellite
    a, b, L = double_integrator(lin, gain, "z")
    d, w = 2e-5, 2.0 * np.pi * 0.03
    budget = fflin.error_budget(
        gain,
        lin,
        disturbance={"tau_b.z": d},
        bias={"omega_b.z": 3e-5, "q_b.z": 1e-4},
        periodic={"tau_b.z": (d, 0.03)},
    )
    errors = budget.error("attitude.z")
    assert errors["constant tau_b.z"] == pytest.approx(DEGREES * L * d / a, rel=1e-9)
    bias = errors["bias of omega_b.z"]
    assert bias == pytest.approx(DEGREES * 3e-5 * b / a, rel=1e-9)
    assert errors["bias of q_b.z"] == pytest.approx(DEGREES * 2e-4, rel=1e-9)
    gain_at = L / abs(a - w**2 + 1j * b * w)
    amplitude = errors["tau_b.z at 0.03 Hz"]
    assert amplitude == pytest.approx(DEGREES * d * gain_at, rel=1e-9)
    constant = errors["constant tau_b.z"] + bias + errors["bias of q_b.z"]
    expected = constant + 3.0 * amplitude / np.sqrt(2.0)
    assert errors["total"] == pytest.approx(expected, rel=1e-12)
    assert abs(budget.total[0]) < 1e-9


def test_a_vector_of_forces_keeps_its_signs_and_a_group_does_not():
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    single = [
        fflin.error_budget(gain, lin, disturbance={f"tau_b.{axis}": 1e-3}).constant
        for axis in "xyz"
    ]
    group = fflin.error_budget(gain, lin, disturbance={"tau_b": 1e-3}).constant
    assert group == pytest.approx(sum(single), rel=1e-9, abs=1e-12)
    one = fflin.error_budget(gain, lin, disturbance={"tau_b": (1e-3, -2e-3, 0)})
    other = fflin.error_budget(gain, lin, disturbance={"tau_b": (-1e-3, 2e-3, 0)})
    assert one.constant == pytest.approx(other.constant)
    assert (one.constant <= single[0] + 2.0 * single[1] + 1e-12).all()
    noisy = [
        fflin.error_budget(gain, lin, force_noise={f"tau_b.{axis}": 1e-3}).deviation
        for axis in "xyz"
    ]
    group = fflin.error_budget(gain, lin, force_noise={"tau_b": 1e-3}).deviation
    expected = np.sqrt(np.sum(np.square(noisy), axis=0))
    assert group == pytest.approx(expected, rel=1e-9, abs=1e-12)


def recursion(lin, gain, axis, delay, h, parts):
    """Return the step functions of one axis, with inputs that are late by whole parts of h."""
    a, b, L = double_integrator(lin, gain, axis)
    A = np.array([[0.0, 1.0], [0.0, 0.0]])
    B = np.array([[0.0], [1.0]])
    small = h / parts
    block = expm(np.block([[A, B], [np.zeros((1, 3))]]) * small)
    late = round(delay / small)
    return a, b, L, block[:2, :2], block[:2, 2], late


def test_a_sampled_loop_with_delay_equals_a_recursion_over_many_seeds(satellite):
    _, lin, gain = satellite
    h, delay, parts, runs = 0.2, 0.15, 4, 4000
    n = 1e-4
    a, b, _, phi, gamma, late = recursion(lin, gain, "x", delay, h, parts)
    rng = np.random.default_rng(1)
    state = np.zeros((2, runs))
    commands = [np.zeros(runs)] * (late + 1)
    for _ in range(400):
        angle = state[0] + 2.0 * n * rng.standard_normal(runs)
        command = -a * angle - b * (state[1] + 3.0 * n * rng.standard_normal(runs))
        for _ in range(parts):
            commands = [*commands[1:], command]
            state = phi @ state + np.outer(gamma, commands[0])
    noise = {"q_b": n, "omega_b": 3.0 * n}
    budget = fflin.error_budget(gain, lin, noise=noise, sample=h, delay=delay)
    measured = DEGREES * state[0].std()
    # The ratio of the variances has a chi-squared distribution; its two tails have 1e-6.
    low, high = np.sqrt(chi2.ppf((1e-6, 1.0 - 1e-6), runs) / runs)
    assert low < measured / budget.deviation[0] < high
    assert budget.dt == h and budget.delay == delay


@pytest.mark.exhaustive
def test_sinusoids_act_between_the_samples(satellite):
    _, lin, gain = satellite
    h, delay, parts = 0.2, 0.15, 400
    a, b, L, phi, gamma, late = recursion(lin, gain, "x", delay, h, parts)
    w, size = 2.0 * np.pi * 0.7, 1e-3
    state = np.zeros(2)
    commands = [0.0] * (late + 1)
    angles = []
    for k in range(600):
        angles.append(state[0])
        command = -a * state[0] - b * state[1]
        for i in range(parts):
            commands = [*commands[1:], command]
            t = (k + (i + 0.5) / parts) * h
            push = L * size * np.cos(w * t)
            state = phi @ state + gamma * (commands[0] + push)
    late_angles = np.array(angles[300:])
    t = h * np.arange(300, 600)
    basis = np.column_stack((np.cos(w * t), np.sin(w * t)))
    fit = np.linalg.lstsq(basis, late_angles, rcond=None)[0]
    periodic = {"tau_b.x": (size, 0.7)}
    budget = fflin.error_budget(gain, lin, periodic=periodic, sample=h, delay=delay)
    amplitude = budget.contributions[0].size[0]
    # The midpoint rule over 400 parts has a relative error of (w h / 400)^2 / 24 = 2e-7.
    assert amplitude == pytest.approx(DEGREES * np.hypot(*fit), rel=1e-5)


def test_force_noise_of_a_sampled_loop_tends_to_that_of_the_continuous_loop(satellite):
    _, lin, gain = satellite
    noise = {"tau_b": 1e-4}
    continuous = fflin.error_budget(gain, lin, force_noise=noise).deviation
    sampled = [
        fflin.error_budget(gain, lin, force_noise=noise, sample=h).deviation
        for h in (0.02, 0.01)
    ]
    far, near = (np.abs(x / continuous - 1.0).max() for x in sampled)
    # The error of the hold is of first order in h.
    assert near < 0.02 and near == pytest.approx(0.5 * far, rel=0.05)


@pytest.mark.exhaustive
def test_an_output_feedback_and_its_constant_torque(satellite):
    robot, lin, _ = satellite
    sampled = lin.discretize(0.2)
    law = fflin.OutputFeedback(
        sampled, fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-6, 1e-6))
    )
    torque = {"tau_b": (1e-5, -2e-5, 3e-5)}
    options = {"disturbance": torque, "duration": 200.0, "dt": 0.1}
    motion = fflin.simulate(robot, law, **options)
    budget = fflin.error_budget(law, lin, disturbance=torque, motion=motion)
    final = np.abs(2.0 * DEGREES * motion.x[-1, :3])
    # The angles are below 1 deg, so the nonlinear terms are of the order 1e-4.
    assert budget.constant[:3] == pytest.approx(final, rel=1e-3)
    assert np.abs(budget.simulated_mean) == pytest.approx(final, rel=1e-2)
    assert "simulated" in str(budget)


def test_wheels_hold_a_torque_on_the_base():
    inputs = fflin.load_inputs("cubesat")
    wheels = [item for item in inputs if isinstance(item, fflin.ReactionWheel)]
    robot = fflin.load("cubesat", inputs=wheels)
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    torque = {"tau_b": (0.0, 0.0, 1e-6)}
    budget = fflin.error_budget(gain, lin, disturbance=torque, sample=0.25)
    law = fflin.StateFeedback(lin, gain.K)
    options = {"disturbance": torque, "duration": 150.0, "dt": 0.25, "sample": 0.25}
    motion = fflin.simulate(robot, law, **options)
    final = abs(2.0 * DEGREES * motion.x[-1, 2])
    assert budget.constant[2] == pytest.approx(final, rel=1e-3)
    assert budget.constant[2] > 0.0


@pytest.mark.compiled
def test_noise_of_a_campaign_has_the_predicted_deviation(satellite):
    robot, lin, _ = satellite
    sampled = lin.discretize(0.5)
    law = fflin.StateFeedback(sampled, fflin.lqr(sampled).K)
    count = 512
    options = {"duration": 80.0, "dt": 0.25, "delay": 0.25, "engine": "compiled"}
    runs = fflin.monte_carlo(robot, law, {"q_b.noise": 1e-5}, runs=count, **options)
    budget = fflin.error_budget(law, lin, noise={"q_b": 1e-5}, delay=0.25)
    measured = 2.0 * DEGREES * np.array(runs.x)[:, :3].std(axis=0)
    low, high = np.sqrt(chi2.ppf((1e-6, 1.0 - 1e-6), count) / count)
    ratio = measured / budget.deviation[:3]
    assert (low < ratio).all() and (ratio < high).all()


@pytest.mark.exhaustive
def test_the_report_and_the_refusals(satellite):
    _, lin, gain = satellite
    budget = fflin.error_budget(
        gain, lin, noise={"q_b": 1e-6}, disturbance={"tau_b": (1e-7, 0, 0)}
    )
    text = str(budget)
    assert "[arcsec]" in text and "noise of q_b" in text
    assert max(map(len, text.splitlines())) <= 80
    card = budget._repr_html_()
    assert "constant tau_b" in card and "arcsec" in card
    with pytest.raises(InputError, match="no cause of errors"):
        fflin.error_budget(gain, lin)
    with pytest.raises(InputError, match="unstable"):
        fflin.error_budget(gain, lin, noise={"q_b": 1e-6}, sample=1.0, delay=500.0)
    with pytest.raises(UnknownNameError):
        fflin.error_budget(gain, lin, noise={"q_c": 1e-6})
    with pytest.raises(InputError, match="at least 0"):
        fflin.error_budget(gain, lin, noise={"q_b": -1.0})
    with pytest.raises(InputError, match="more than 0"):
        fflin.error_budget(gain, lin, periodic={"tau_b.x": (1.0, 0.0)})
    with pytest.raises(UnknownNameError, match="error"):
        budget.error("attitude.w")


def test_the_delay_of_the_model_or_of_the_law_is_in_the_budget(satellite):
    """Four ways to give one delay have one result, as `simulate` has one motion."""
    _, lin, _ = satellite
    h, tau = 0.25, 0.4
    late = lin.discretize(h, delay=tau)
    policy = fflin.StateFeedback(late, fflin.lqr(late))
    causes = {"noise": {"q_b": 1e-4}, "periodic": {"tau_b.y": (1e-5, 0.05)}}
    expected = fflin.error_budget(policy, lin, delay=tau, **causes)
    assert expected.delay == pytest.approx(tau)
    for model in (lin, lin.discretize(h), late):
        budget = fflin.error_budget(policy, model, **causes)
        assert budget.delay == pytest.approx(tau)
        np.testing.assert_allclose(budget.total, expected.total, rtol=1e-9, atol=1e-15)
    early = fflin.error_budget(policy, lin, delay=0.0, **causes)
    assert early.error("attitude.y")["noise of q_b"] != pytest.approx(
        expected.error("attitude.y")["noise of q_b"], rel=1e-3
    )
    more = fflin.error_budget(policy, late, delay=0.1, **causes)
    assert more.delay == pytest.approx(tau + 0.1)


def test_a_measured_quantity_names_its_components_as_in_the_filter():
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose(), fflin.Gyroscope("base")],
    )
    model = fflin.linearize(robot).discretize(0.25)
    noise = {"q_b": 1e-9, "r_b": 1e-4, "gyroscope": 1e-9}
    estimator = fflin.kalman(model, {"omega_b": 1e-9}, noise)
    policy = fflin.OutputFeedback(model, fflin.lqg(fflin.lqr(model), estimator))
    named = fflin.error_budget(policy, model, noise={"gyroscope": 1e-5})
    listed = fflin.error_budget(policy, model, noise={"*.gyroscope.*": 1e-5})
    assert named.total.tolist() == listed.total.tolist()
    assert named.total[0] > 0.0


def test_phasors_are_the_disturbance_of_the_orbit_at_every_time():
    """Inertial vectors rotate in the orbital frame; their products are sums of sinusoids."""
    terms = [
        {"constant": (1.0, -2.0, 0.5), "axes": "inertial"},
        {"amplitude": (0.3, 1.0, -2.0), "frequency": 1e-3, "phase": 0.7},
        {
            "amplitude": (0.3, 1.0, -2.0),
            "frequency": 5e-3,
            "phase": 0.7,
            "axes": "inertial",
        },
        {"amplitude": (2.0, 1.0, 3.0), "frequency": 2e-5, "axes": "inertial"},
    ]
    disturbance = {"tau_b": terms, "F_b": [(0.0, 3.0, 1.0)]}
    robot = fflin.load("cubesat").replace(orbit=700e3, disturbance=disturbance)
    field = OrbitField(robot, "lvlh")
    on_base = BaseDisturbance(robot, field)
    q = fflin.configuration(robot, rpy=(20.0, -10.0, 70.0))
    R = pin.XYZQUATToSE3(q[:7]).rotation
    phasors = phasors_of(robot, field)
    assert min(phasor.rate for phasor in phasors) >= 0.0
    for t in (0.0, 123.0, 4000.0):
        expected = on_base.wrench(t, q)
        total = np.zeros(6)
        for name, axes, value, rate in phasors:
            real = (value * np.exp(1j * rate * t)).real
            rows = slice(0, 3) if name == "F_b" else slice(3, 6)
            total[rows] += real if axes == "base" else real @ R
        np.testing.assert_allclose(total, expected, rtol=0, atol=1e-11)


@pytest.mark.exhaustive
def test_the_disturbance_of_a_robot_gives_the_errors_of_its_simulation():
    """The linear error of a small constant and a sinusoid equals the simulated one."""
    h, f = 0.25, 0.05
    disturbance = {
        "tau_b": [
            {"constant": (2e-7, 0.0, -1e-7), "axes": "inertial"},
            {"amplitude": (0.0, 3e-7, 1e-7), "frequency": f, "axes": "inertial"},
        ]
    }
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    q = fflin.configuration(robot, rpy=(0.0, 0.0, 50.0))
    lin = fflin.linearize(robot, q)
    sampled = lin.discretize(h, delay=0.3)
    policy = fflin.StateFeedback(sampled, fflin.lqr(sampled))
    pushed = robot.replace(disturbance=disturbance)
    # The motion settles in 200 s. The second half contains whole periods of the sinusoid.
    motion = fflin.simulate(pushed, policy, q0=q, duration=400.0, dt=0.05)
    budget = fflin.error_budget(policy, lin, robot=pushed, motion=motion)
    causes = [part.cause for part in budget.contributions]
    assert causes == ["constant tau_b", "tau_b at 0.05 Hz"]
    late = motion.t >= 200.0
    mean = 2.0 * DEGREES * motion.x[late, :3].mean(axis=0)
    spread = 2.0 * DEGREES * motion.x[late, :3].std(axis=0)
    np.testing.assert_allclose(budget.constant[:3], np.abs(mean), rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(budget.deviation[:3], spread, rtol=1e-2, atol=1e-9)
    # The linear loop explains this motion, so that almost nothing is left.
    rest = fflin.error_budget(
        policy, lin, robot=pushed, motion=motion, limit_cycle=True
    ).contributions[-1]
    assert rest.kind == "simulated" and rest.cause == "simulated minus superposed"
    assert (rest.size[:3] <= 0.15 * spread + 1e-9).all()


def test_the_limit_cycle_is_the_part_of_the_motion_that_is_not_superposed(satellite):
    """Pulses of thrusters keep the satellite moving; no linear cause does."""
    robot, lin, gain = satellite
    motion = fflin.simulate(
        robot,
        fflin.StateFeedback(lin, gain.K),
        duration=10.0,
        disturbance=lambda t, q, v: {"tau_b.z": 1e-6 * np.sign(np.sin(0.5 * t))},
    )
    given = {"motion": motion, "limit_cycle": True}
    alone = fflin.error_budget(gain, lin, **given)
    (part,) = alone.contributions
    np.testing.assert_allclose(part.size[:3], motion_deviation(motion), rtol=1e-12)
    np.testing.assert_allclose(alone.total, 3.0 * part.size, rtol=1e-12)
    noise = {"tau_b.z": 1e-7}
    budget = fflin.error_budget(gain, lin, force_noise=noise, **given)
    white, rest = (x.size[2] for x in budget.contributions)
    assert np.hypot(white, rest) == pytest.approx(part.size[2], rel=1e-12)
    assert "simulated minus superposed" in str(budget)
    # A cause that is larger than the motion leaves nothing.
    noise = {"tau_b.z": 1.0}
    budget = fflin.error_budget(gain, lin, force_noise=noise, **given)
    assert budget.contributions[-1].size[2] == 0.0
    with pytest.raises(InputError, match="needs a simulated motion"):
        fflin.error_budget(gain, lin, limit_cycle=True)


def test_errors_of_a_motion_are_counted_from_the_given_time_on(satellite):
    robot, lin, gain = satellite
    motion = fflin.simulate(
        robot,
        fflin.StateFeedback(lin, gain.K),
        duration=10.0,
        disturbance=lambda t, q, v: {"tau_b.z": 1e-6},
    )
    given = {"motion": motion, "limit_cycle": True}
    half = fflin.error_budget(gain, lin, **given)
    budget = fflin.error_budget(gain, lin, **given, after=8.0)
    assert (half.after, budget.after) == (5.0, 8.0)
    assert "simulated: errors of the motion from 8 s on" in str(budget)
    late = motion.t >= 8.0 - 1e-9
    errors = np.degrees(attitude_rotations(motion.x, motion.target))[late]
    np.testing.assert_allclose(budget.simulated_mean, errors.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(
        budget.simulated_deviation, errors.std(axis=0), rtol=1e-12
    )
    np.testing.assert_allclose(
        budget.contributions[0].size[:3], errors.std(axis=0), rtol=1e-12
    )
    with pytest.raises(InputError, match="after is 10 s, expected less than the end"):
        fflin.error_budget(gain, lin, **given, after=10.0)
    with pytest.raises(InputError, match="give motion="):
        fflin.error_budget(gain, lin, bias={"q_b": 1e-6}, after=1.0)


def test_rounding_errors_of_a_budget_are_dots(satellite):
    _, lin, gain = satellite
    budget = fflin.error_budget(gain, lin, disturbance={"tau_b": (1e-3, 1e-14, 1e-12)})
    shown = [line.split()[-3:] for line in str(budget).splitlines() if "tau_b" in line]
    assert [row[1] for row in shown] == ["."]  # 1e-11 of the largest
    assert float(shown[0][0]) > 0.0 and float(shown[0][2]) > 0.0
    # A small budget has no rounding errors.
    small = fflin.error_budget(gain, lin, disturbance={"tau_b.y": 1e-14})
    assert float(str(small).splitlines()[-1].split()[-2]) > 0.0


def motion_deviation(motion):
    """Return the standard deviations [deg] of the attitude in the second half of a motion."""
    late = motion.t >= 0.5 * motion.t[-1]
    return np.degrees(attitude_rotations(motion.x, motion.target))[late].std(axis=0)


def test_an_amplitude_may_be_a_vector_with_one_phase():
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    budgets = [
        fflin.error_budget(gain, lin, periodic={"tau_b": (amplitude, 0.02)})
        for amplitude in ((1e-5, 0.0, 0.0), (0.0, 1e-5, 0.0), (1e-5, -1e-5, 0.0), 1e-5)
    ]
    x, y, both, group = (budget.contributions[0].size for budget in budgets)
    assert (both <= x + y + 1e-18).all() and (both >= np.abs(x - y) - 1e-18).all()
    assert (group >= np.hypot(x, y) - 1e-18).all()
    for wrong in (1.0, (1.0, 2.0, 3.0), ((1.0, 2.0), 0.1)):
        with pytest.raises(InputError, match="periodic 'tau_b'"):
            fflin.error_budget(gain, lin, periodic={"tau_b": wrong})


def test_a_budget_refuses_elliptic_orbits():
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], orbit=600e3)
    model = fflin.linearize(robot).discretize(10.0)
    gain = fflin.lqr(model, {"q_b": 1.0, "omega_b": 1.0}, 1e6)
    law = fflin.StateFeedback(model, gain)
    elliptic = robot.replace(orbit=fflin.EllipticOrbit(perigee=500e3, apogee=900e3))
    with pytest.raises(fflin.InputError, match="error budgets do not support elliptic"):
        fflin.error_budget(law, model, robot=elliptic, disturbance={"tau_b.x": 1e-6})


MEAN, PERIODIC = "mean of flat plates", "periodic part of flat plates"

# Mirror on the side of a satellite. Sunlight pushes it along its normal.
MIRROR = {
    "area": 0.05,
    "normal": (1, 0, 0),
    "position": (0.0, 0.3, -0.2),
    "sun": (1, 0, 0),
    "specular": 1.0,
}


@pytest.mark.parametrize("frame", ["hybrid", "world"])
def test_the_mean_torque_of_plates_without_an_orbit_is_that_of_their_forces(frame):
    """The force acts at the centre of pressure, whose lever starts at the centre of mass."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    q = fflin.configuration(robot, rpy=(0.0, 0.0, 40.0))
    lin = fflin.linearize(robot, q, frame=frame, reference=pin.SE3.Identity())
    gain = fflin.lqr(lin)
    lit = robot.replace(disturbance={"plate": [MIRROR]})
    budget = fflin.error_budget(gain, lin, robot=lit)
    (part,) = budget.contributions
    assert part.cause == MEAN and part.kind == "constant"
    cosine = np.cos(np.radians(40.0))
    force = np.array([-2.0 * 4.54e-6 * 0.05 * cosine**2, 0.0, 0.0])
    centre = pin.centerOfMass(
        robot.model, robot.create_data(), pin.neutral(robot.model)
    )
    torque = np.cross(np.array(MIRROR["position"]) - centre, force)
    if frame == "world":
        torque = pin.rpy.rpyToMatrix(0.0, 0.0, np.radians(40.0)) @ torque
    expected = fflin.error_budget(gain, lin, disturbance={"tau_b": torque})
    np.testing.assert_allclose(
        part.size[:3], expected.constant[:3], rtol=1e-9, atol=1e-15
    )


@pytest.mark.parametrize("sample", [None, 1.0])
def test_sunlight_on_one_face_in_orbit_has_the_moments_of_a_squared_half_wave(sample):
    """The torque is that of max(cos, 0)^2, with the mean 1/4 and the variance 1/8."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], orbit=600e3)
    lit = robot.replace(disturbance={"plate": [MIRROR]})
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin, {"q_b": 1.0, "omega_b": 1.0}, 1e6)
    budget = fflin.error_budget(gain, lin, robot=lit, sample=sample)
    mean, periodic = budget.contributions
    assert (mean.cause, periodic.cause) == (MEAN, PERIODIC)
    # The loop is much faster than the orbit, so that the errors follow the torque.
    assert mean.size[1:3] == pytest.approx(0.5 * periodic.size[1:3], rel=2e-3)
    assert budget.deviation[1:3] == pytest.approx(
        periodic.size[1:3] / np.sqrt(2.0), rel=1e-12
    )
    force = np.array([-0.25 * 2.0 * 4.54e-6 * 0.05, 0.0, 0.0])
    centre = pin.centerOfMass(
        robot.model, robot.create_data(), pin.neutral(robot.model)
    )
    torque = np.cross(np.array(MIRROR["position"]) - centre, force)
    expected = fflin.error_budget(
        gain, lin, disturbance={"tau_b": torque}, sample=sample
    )
    assert mean.size[1:3] == pytest.approx(expected.constant[1:3], rel=1e-3)


def test_harmonics_of_plates_add_to_their_wrench():
    plates = [
        {**MIRROR, "sun": (1, 0.5, 0.3), "specular": 0.3, "diffuse": 0.2},
        {"area": 0.1, "normal": (0.2, 1, 1), "density": 1e-11, "two_sided": True},
    ]
    robot = fflin.load("cubesat").replace(orbit=700e3, disturbance={"plate": plates})
    field = OrbitField(robot, "lvlh")
    on_base = BaseDisturbance(robot, field)
    q = fflin.configuration(robot, rpy=(20.0, -10.0, 10.0))
    R = pin.XYZQUATToSE3(q[:7]).rotation
    phasors = plate_phasors(robot, field, R)
    assert len(phasors) == 129
    largest = np.abs(on_base.wrench(0.0, q)).max()
    for t in (0.0, 1000.0, 4000.0):
        terms = [(value * np.exp(1j * w * t)).real for w, value in phasors.items()]
        # The rest beyond 128 harmonics is of the order 1 / 128^2.
        error = np.abs(np.sum(terms, axis=0) - on_base.wrench(t, q)).max()
        assert error < 1e-4 * largest


@pytest.mark.exhaustive
def test_the_errors_of_plates_are_those_of_a_simulated_orbit():
    plates = [
        {**MIRROR, "specular": 0.5, "diffuse": 0.2},
        {"area": 0.1, "normal": (1, 0.2, 0), "density": 1e-12, "position": (0, 0, 0.1)},
    ]
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], orbit=600e3)
    lit = robot.replace(disturbance={"plate": plates})
    lin = fflin.linearize(robot)
    period = 2.0 * np.pi / float(np.linalg.norm(OrbitField(robot, "lvlh").rate))
    h = period / 1000
    sampled = lin.discretize(h)
    gain = fflin.lqr(sampled, {"q_b": 1.0, "omega_b": 1.0}, 1e6)
    law = fflin.StateFeedback(sampled, gain)
    motion = fflin.simulate(lit, law, duration=2.0 * period, dt=h)
    budget = fflin.error_budget(law, sampled, robot=lit, motion=motion)
    # The plates turn by the error, which changes their torque by a fraction of this angle.
    np.testing.assert_allclose(
        budget.constant[1:3], np.abs(budget.simulated_mean)[1:3], rtol=0.01
    )
    np.testing.assert_allclose(
        budget.deviation[1:3], budget.simulated_deviation[1:3], rtol=0.01
    )


def wheels_with(lags):
    """Return the wheels of a satellite with lags [s]."""
    wheels = [
        item
        for item in fflin.load_inputs("cubesat")
        if isinstance(item, fflin.ReactionWheel)
    ]
    return [replace(item, lag=lag) for item, lag in zip(wheels, lags, strict=True)]


def test_equal_lags_of_allocated_inputs_lag_the_commanded_torque(satellite):
    robot, lin, gain = satellite
    lagging = robot.replace(inputs=wheels_with((0.8, 0.8, 0.8)))
    law = fflin.Allocation(fflin.StateFeedback(lin, gain), robot)
    d, f, T = 1e-6, 0.1, 0.8
    w = 2.0 * np.pi * f
    periodic = {"tau_b.y": (d, f)}
    budget = fflin.error_budget(law, lin, periodic=periodic, robot=lagging)
    a, b, L = double_integrator(lin, gain, "y")
    # The torque lags by 1 / (1 + j w T).
    late = 1.0 / (1.0 + 1j * w * T)
    response = L / abs((a + 1j * b * w) * late - w**2)
    amplitude = budget.error("attitude.y")["tau_b.y at 0.1 Hz"]
    assert amplitude == pytest.approx(DEGREES * d * response, rel=1e-9)


def test_different_lags_of_allocated_inputs_are_neglected_with_a_warning(satellite):
    robot, lin, gain = satellite
    lagging = robot.replace(inputs=wheels_with((0.1, 0.1, 0.2)))
    law = fflin.Allocation(fflin.StateFeedback(lin, gain), robot)
    causes = {"periodic": {"tau_b.y": (1e-6, 0.1)}}
    with pytest.warns(fflin.FflinWarning, match="lags of 0.1 to 0.2 s") as record:
        budget = fflin.error_budget(law, lin, robot=lagging, **causes)
    assert record[0].filename == __file__
    expected = fflin.error_budget(law, lin, **causes)
    np.testing.assert_allclose(budget.total, expected.total, rtol=1e-12)


def test_the_lags_of_the_given_robot_are_in_the_budget(satellite):
    robot, lin, gain = satellite
    lagging = robot.replace(inputs=[fflin.BaseTorque(lag=0.4)])
    noise = {"q_b": 1e-5}
    budget = fflin.error_budget(gain, lin, noise=noise, robot=lagging)
    expected = fflin.error_budget(gain, lin.with_lags({"tau_b": 0.4}), noise=noise)
    np.testing.assert_allclose(budget.total, expected.total, rtol=1e-12)
    assert budget.total[0] > 1.01 * fflin.error_budget(gain, lin, noise=noise).total[0]


class Recursion:
    """Deviations of a satellite, a law at two rates and its sensors; one column for each run."""

    def __init__(self, **noise):
        _, self.lin, compensator = designed()
        if noise:
            estimator = fflin.kalman(self.lin, W, **noise)
            compensator = fflin.lqg(fflin.lqr(self.lin), estimator)
        self.policy = fflin.MultirateFeedback(self.lin, compensator)
        law, lin = self.policy.compensator, self.lin
        names = [f"{group}.{axis}" for group in ("q_b", "omega_b") for axis in "xyz"]
        self.kept = [lin.state_names.index(name) for name in names]
        self.A = lin.A[np.ix_(self.kept, self.kept)]
        self.B, self.C = lin.B[self.kept], lin.C[:, self.kept]
        self.law = law

    def run(self, samples, runs, errors, push=None):
        """Return the attitudes (samples, 3, runs) [deg]; errors() returns those of the outputs."""
        law, late = self.law, 4
        x, z = np.zeros((6, runs)), np.zeros((law.A.shape[1], runs))
        seen = np.zeros((late + 1, 6, runs))
        held = np.zeros((6, runs))
        attitudes = []
        for k in range(samples):
            attitudes.append(np.degrees(2.0) * x[:3])
            seen = np.roll(seen, 1, axis=0)
            seen[0] = self.C @ x + errors()
            held[3:] = seen[0, 3:]
            if k % 5 == late:
                held[:3] = seen[late, :3]
            u = law.C @ z
            j = k % len(law.A)
            z = law.A[j] @ z + law.B[j] @ held
            x = self.A @ x + self.B @ u
            if push is not None:
                x = x + push(k)
        return np.array(attitudes)


@pytest.mark.exhaustive
def test_the_budget_of_a_law_at_two_rates_equals_a_recursion():
    loop = Recursion()
    rng = np.random.default_rng(4)
    size = np.array([2e-5] * 3 + [3e-6] * 3)[:, None]
    budget = fflin.error_budget(
        loop.policy,
        loop.lin,
        noise={"q_b": 2e-5, "gyroscope": 3e-6},
    )
    samples, runs = 4000, 400
    attitudes = loop.run(samples, runs, lambda: size * rng.standard_normal((6, runs)))
    # The last ten periods of all runs are about 400 independent samples, an error of 4 %.
    late = np.sqrt((attitudes[-50:] ** 2).mean(axis=(0, 2)))
    assert late == pytest.approx(budget.deviation[:3], rel=0.12)
    periodic = fflin.error_budget(
        loop.policy, loop.lin, periodic={"wheel_y": (1e-4, 0.02)}
    )
    # A held input has the sinusoid of the forces up to (w h)^2/24 and half a sample of lag.
    angle = 2.0 * np.pi * 0.02 * loop.lin.dt
    column = loop.B[:, [1]]
    attitudes = loop.run(
        20000,
        1,
        lambda: 0.0,
        lambda k: 1e-4 * column * np.sin(angle * (k + 0.5)),
    )
    rms = np.sqrt((attitudes[-10000:, 1, 0] ** 2).mean())
    expected = periodic.error("attitude.y")["wheel_y at 0.02 Hz"] / np.sqrt(2.0)
    assert rms == pytest.approx(expected, rel=1e-3)


def test_a_constant_torque_leaves_a_law_that_estimates_it_without_error():
    loop = Recursion()
    budget = fflin.error_budget(
        loop.policy,
        loop.lin,
        disturbance={"tau_b": (2e-5, 0.0, 1e-5)},
        bias={"gyroscope": 3e-5, "q_b.x": 1e-5},
    )
    errors = budget.error("attitude.x")
    assert errors["constant tau_b"] < 1e-9
    assert errors["bias of gyroscope"] < 1e-9
    assert errors["bias of q_b.x"] == pytest.approx(np.degrees(2e-5), rel=1e-6)


def drifting_gyroscope(bias):
    """Return a satellite, its sampled model, and the law for a gyroscope with this drift."""
    rates = fflin.Gyroscope("base", bias=bias)
    robot = fflin.load("cubesat", outputs=[fflin.StarTracker(noise=1e-5), rates])
    robot = robot.replace(inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(robot).discretize(0.2)
    estimator = fflin.kalman(lin, {"omega_b": 1e-10}, {"gyroscope": 1e-10})
    return robot, lin, fflin.lqg(fflin.lqr(lin), estimator)


def test_the_drift_of_a_bias_acts_by_its_step_responses():
    robot, lin, law = drifting_gyroscope(2e-4)
    policy = fflin.OutputFeedback(lin, law)
    budget = fflin.error_budget(policy, lin, robot=robot)
    drift = budget.error("attitude.y")["drift of base.gyroscope.*"]
    # All steps of the bias in the past add their responses.
    kept = [*range(3), *range(6, 9)]
    x, z = np.zeros(6), np.zeros(len(law.A))
    bias = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    power = 0.0
    for _ in range(4000):
        power += np.degrees(2.0 * x[1]) ** 2
        y = lin.C[:, kept] @ x + bias
        u = law.C @ z
        z = law.A @ z + law.B @ y
        x = lin.A[np.ix_(kept, kept)] @ x + lin.B[kept] @ u
    assert abs(x).max() < 1e-9
    assert drift == pytest.approx(2e-4 * np.sqrt(lin.dt * power), rel=1e-6)
    noise = budget.error("attitude.y")["noise of q_b"]
    assert budget.deviation[1] == pytest.approx(np.hypot(drift, noise), rel=1e-12)


@pytest.mark.exhaustive
def test_the_drift_of_a_bias_acts_on_a_law_at_two_rates():
    # With a large bias noise, the estimate of the bias settles within the simulated time.
    loop = Recursion(bias_noise={"gyroscope": 1e-6})
    outputs = [
        replace(output, bias=2e-6 if isinstance(output, fflin.Gyroscope) else None)
        for output in loop.lin._robot.outputs
    ]
    robot = loop.lin._robot.replace(outputs=outputs)
    budget = fflin.error_budget(loop.policy, loop.lin, robot=robot)
    (drift,) = [x for x in budget.contributions if x.cause.startswith("drift of")]
    # Columns are the axes of the bias and the samples of the period at which it steps.
    step = 2e-6 * np.sqrt(loop.lin.dt) * np.repeat(np.eye(6)[:, 3:], 5, axis=1)
    first = np.tile(np.arange(5), 3)
    now = iter(range(6_000))
    responses = loop.run(6_000, 15, lambda: step * (next(now) >= first))
    variances = np.sum(np.square(responses), axis=(0, 2)) / 5.0
    assert abs(responses[-1]).max() < 1e-9 * abs(responses).max()
    assert drift.size[:3] == pytest.approx(np.sqrt(variances), rel=1e-7)


def test_the_drift_of_a_bias_that_the_law_does_not_reject_is_named():
    robot, _, _ = drifting_gyroscope(1e-6)
    _, lin, law = drifting_gyroscope(None)
    budget = fflin.error_budget(fflin.OutputFeedback(lin, law), lin, robot=robot)
    assert [part.cause for part in budget.contributions] == ["noise of q_b"]
    text = " ".join(str(budget).split())
    assert "left out: drift of the bias of base.gyroscope.*" in text


def test_the_budget_of_a_robot_with_lags_needs_no_input_of_force():
    budgets = []
    for others in ([], [fflin.BaseForce()]):
        inputs = [fflin.BaseTorque(lag=0.3), *others]
        robot = fflin.load("cubesat", inputs=inputs, outputs=[fflin.BasePose()])
        lin = fflin.linearize(robot).with_lags().discretize(0.1)
        gain = fflin.lqr(lin)
        estimator = fflin.kalman(lin, {"omega_b": 1e-8, "v_b": 1e-8}, 1e-6)
        law = fflin.OutputFeedback(lin, fflin.lqg(gain, estimator))
        budgets.append(fflin.error_budget(law, lin, noise={"q_b": 1e-4}))
    first, second = budgets
    assert first.total[:3].min() > 0.0
    np.testing.assert_allclose(first.total[:3], second.total[:3], rtol=1e-6)
