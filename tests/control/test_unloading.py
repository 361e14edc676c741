"""Unloading of wheels by external torques, beside laws with integrals, filters and delays."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.dynamics.delays import HeldSystem
from tests.support.marks import exhaustive

SAMPLE = 0.25
RATE = 0.04  # 1/s
SPEEDS = {"wheel_x": 300.0, "wheel_y": -200.0, "wheel_z": 150.0}  # rad/s


def cubesat():
    """Return the cubesat with wheels alone, with a base torque as well, and with thrusters."""
    inputs = fflin.load_inputs("cubesat")
    wheels = [item for item in inputs if isinstance(item, fflin.ReactionWheel)]
    outputs = [
        fflin.BasePose(),
        fflin.Gyroscope("base"),
        fflin.JointVelocities(("wheel_*",)),
    ]
    flown = fflin.load("cubesat", inputs=inputs, outputs=outputs)
    alone = flown.replace(inputs=wheels)
    design = flown.replace(inputs=[fflin.BaseTorque(), *wheels])
    return alone, design, flown


def state_law(robot, *, delay=0.0):
    """Return a state feedback with integral action."""
    model = fflin.linearize(robot).discretize(SAMPLE, delay=delay)
    return fflin.StateFeedback(model, fflin.lqr(model, integral_action=["q_b"]))


def output_law(robot, *, delay=0.0, integral=False):
    """Return an LQG law that integrates the attitude or estimates a constant torque."""
    model = fflin.linearize(robot).discretize(SAMPLE, delay=delay)
    gain = fflin.lqr(model, integral_action=["q_b"] if integral else None)
    variances = {"q_b": 1e-10, "r_b": 1e-8, "gyroscope": 1e-12, "qdot_m": 1.0}
    estimator = fflin.kalman(
        model,
        {"omega_b": 1e-12},
        variances,
        disturbance_noise=None if integral else {"tau_b": 1e-12},
    )
    return fflin.OutputFeedback(model, fflin.lqg(gain, estimator))


LAWS = {
    "state feedback": state_law,
    "estimated disturbance": output_law,
    "integral action": lambda robot, **options: output_law(
        robot, integral=True, **options
    ),
}


def momenta(robot, motion):
    """Return the total angular momentum (N, 3) [N m s] in inertial axes."""
    measured = robot.replace(outputs=[fflin.Momentum()])
    lin = fflin.linearize(measured)
    rows = zip(motion.q, motion.v, strict=True)
    return np.array([fflin.outputs(measured, lin, q, v)[:3] for q, v in rows])


@pytest.mark.parametrize(
    "kind", ["estimated disturbance", *exhaustive("state feedback", "integral action")]
)
def test_the_speeds_of_wheels_decay_with_the_rate_and_the_attitude_stays(kind):
    """Over a sample of held torques, a speed s becomes s - k h s. Nothing else moves."""
    alone, design, _ = cubesat()
    law = fflin.unload_wheels(LAWS[kind](alone), design, RATE)
    v0 = fflin.velocity(design, SPEEDS)
    motion = fflin.simulate(design, law, v0=v0, duration=10.0, dt=SAMPLE)
    steps = np.arange(len(motion.t))
    decay = (1.0 - RATE * SAMPLE) ** steps
    assert motion.v[:, 6:] == pytest.approx(decay[:, None] * v0[6:], abs=1e-6)
    assert motion.attitude_error.max() < 1e-8
    # The momentum that is left is the momentum of the wheels.
    left = momenta(design, motion)
    assert np.abs(left[-1]).max() == pytest.approx(decay[-1] * np.abs(left[0]).max())


@pytest.mark.parametrize("delay", [0.25, *exhaustive(0.0, 0.1)])
def test_the_loop_keeps_its_poles_and_gains_those_of_the_wheels(delay):
    alone, design, _ = cubesat()
    law = state_law(alone, delay=delay)
    unloading = fflin.unload_wheels(law, design, RATE)
    poles = np.linalg.eigvals(unloading.loop)
    # Without a delay, each wheel has the pole 1 - k h. With a delay tau = (m - 1) h + e, e in
    # (0, h], its speed obeys z^m (z - 1) = -k ((h - e) z + e).
    m = int(np.ceil(delay / SAMPLE))
    e = delay - (m - 1) * SAMPLE
    polynomial = np.zeros(m + 2)
    polynomial[[0, 1]] = 1.0, -1.0
    if delay:
        polynomial[-2:] += RATE * np.array((SAMPLE - e, e))
    else:
        polynomial = np.array((1.0, -1.0 + RATE * SAMPLE))
    slowest = np.roots(polynomial)
    slowest = slowest[np.abs(slowest).argmax()]
    assert np.sum(np.abs(poles - slowest) < 1e-6) == 3
    for pole in np.linalg.eigvals(law.loop):
        # Poles of the angles of the wheels at 1 are defective, hence not exact.
        accuracy = 1e-3 if abs(pole - 1.0) < 1e-3 else 1e-6
        assert np.abs(poles - pole).min() < accuracy


def lagging_cubesat(lag):
    """Return the first two robots of `cubesat` with the same lag of all inputs."""
    alone, design, _ = cubesat()
    robots = []
    for robot in (alone, design):
        inputs = [replace(item, lag=lag) for item in robot.inputs]
        robots.append(robot.replace(inputs=inputs))
    return robots


@pytest.mark.parametrize("delay", [0.1, *exhaustive(0.0, 0.25)])
def test_the_loop_with_lags_keeps_its_poles_and_gains_those_of_the_wheels(delay):
    """The speed s of a wheel and its lagging acceleration a obey s' = a, a' = (-k s - a) / T."""
    lag = 0.5
    alone, design = lagging_cubesat(lag)
    model = fflin.linearize(alone).with_lags().discretize(SAMPLE, delay=delay)
    law = fflin.StateFeedback(model, fflin.lqr(model, integral_action=["q_b"]))
    unloading = fflin.unload_wheels(law, design, RATE)
    poles = np.linalg.eigvals(unloading.loop)
    A, B = np.array(((0.0, 1.0), (0.0, -1.0 / lag))), np.array(((0.0,), (1.0 / lag,)))
    F, G = HeldSystem(A, B, SAMPLE, np.array([delay])).sampled()
    F[:, 0] -= RATE * G[:, 0]
    slowest = np.linalg.eigvals(F)
    slowest = slowest[np.abs(slowest).argmax()]
    assert np.sum(np.abs(poles - slowest) < 1e-6) == 3
    for pole in np.linalg.eigvals(law.loop):
        accuracy = 1e-3 if abs(pole - 1.0) < 1e-3 else 1e-6
        assert np.abs(poles - pole).min() < accuracy


@pytest.mark.parametrize("make", [*exhaustive("state"), "output"])
def test_lagging_wheels_are_unloaded_and_the_attitude_stays(make):
    alone, design = lagging_cubesat(0.5)
    model = fflin.linearize(alone).with_lags().discretize(SAMPLE)
    gain = fflin.lqr(model)
    law = fflin.StateFeedback(model, gain)
    if make == "output":
        variances = {"q_b": 1e-10, "r_b": 1e-8, "gyroscope": 1e-12, "qdot_m": 1.0}
        estimator = fflin.kalman(model, {"omega_b": 1e-12}, variances)
        law = fflin.OutputFeedback(model, fflin.lqg(gain, estimator))
    unloading = fflin.unload_wheels(law, design, RATE)
    v0 = fflin.velocity(design, SPEEDS)
    motion = fflin.simulate(design, unloading, v0=v0, duration=15.0, dt=0.125)
    assert motion.attitude_error.max() < 1e-6
    ratio = motion.v[-1, 6:] / v0[6:]
    assert ratio == pytest.approx(ratio.mean(), rel=1e-4)
    assert 0.5 < ratio.mean() < 0.6


def multirate_law(robot):
    """Return LQG of a slow and late star tracker."""
    model = fflin.linearize(robot).discretize(SAMPLE, delay=0.1)
    noise = {"q_b": 1e-10, "gyroscope": 1e-10, "qdot_m": 1e-6}
    estimator = fflin.kalman(
        model, {"omega_b": 1e-10}, noise, disturbance_noise={"tau_b": 1e-14}
    )
    default = fflin.lqr(model)
    gain = fflin.lqr(model, default.Q, default.R, default.N)
    return fflin.MultirateFeedback(model, fflin.lqg(gain, estimator))


def with_star_tracker(robot, sample=0.5):
    outputs = [
        fflin.StarTracker(sample=sample, delay=0.25),
        *robot.outputs[1:],
    ]
    return robot.replace(outputs=outputs)


@pytest.mark.exhaustive
def test_a_multirate_law_unloads_the_wheels_and_the_attitude_stays():
    alone, design, _ = map(with_star_tracker, cubesat())
    unloading = fflin.unload_wheels(multirate_law(alone), design, RATE)
    v0 = fflin.velocity(design, SPEEDS)
    motion = fflin.simulate(design, unloading, v0=v0, duration=30.0, dt=0.05)
    assert motion.attitude_error.max() < 1e-9
    # the delay holds the first command back
    factor = (1.0 - RATE * SAMPLE) ** (30.0 / SAMPLE)
    np.testing.assert_allclose(motion.v[-1, 6:], factor * v0[6:], rtol=0.02)


def test_a_multirate_law_of_other_sensors_is_refused():
    alone, design, _ = map(with_star_tracker, cubesat())
    other = with_star_tracker(design, sample=0.25)
    with pytest.raises(fflin.InputError, match="other sample times or delays"):
        fflin.unload_wheels(multirate_law(alone), other, RATE)


def test_inputs_that_unload_accelerate_only_wheels():
    alone, design, _ = cubesat()
    law = state_law(alone)
    unloading = fflin.unload_wheels(law, design, RATE)
    lin = unloading.lin
    wheels = np.array([name.startswith("qdot_m.wheel") for name in lin.robot_states])
    gain = unloading.system.D[:, wheels]
    accelerations = fflin.linearize(design).B @ gain
    assert accelerations[wheels] == pytest.approx(-RATE * np.eye(3), abs=1e-9)
    assert np.abs(accelerations[~wheels]).max() < 1e-12
    # Inputs that accelerate only wheels leave the integrals alone, also if limits change them.
    assert np.abs(unloading.windup).max() > 0.1 * np.abs(law.windup).max() > 0.0
    size = np.abs(unloading.windup).max() * np.abs(gain).max()
    assert np.abs(unloading.windup @ gain).max() < 1e-9 * size
    assert unloading.windup[:, 3:] == pytest.approx(law.windup)


@pytest.mark.exhaustive
def test_thrusters_unload_wheels_while_integrals_hold_the_attitude():
    """The total momentum goes to its target, and the attitude error stays below 1e-5 deg."""
    alone, design, flown = cubesat()
    point = fflin.velocity(alone, {"wheel_y": 100.0})
    model = fflin.linearize(alone, v=point).discretize(SAMPLE, delay=SAMPLE)
    law = fflin.StateFeedback(model, fflin.lqr(model, integral_action=["q_b"]))
    policy = fflin.Allocation(fflin.unload_wheels(law, design, RATE), design)
    v0 = fflin.velocity(flown, SPEEDS)
    options = {"v0": v0, "duration": 60.0, "dt": 0.125, "delay": SAMPLE}
    motion = fflin.simulate(flown, policy, **options)
    momentum = momenta(flown, motion)
    target = 3e-6 * 100.0 * np.array((0.0, 1.0, 0.0))
    first, last = (np.abs(momentum[k] - target).max() for k in (0, -1))
    assert last < np.exp(-0.95 * RATE * 60.0) * first
    assert motion.attitude_error.max() < 1e-5
    assert motion.u[:, :12].max() > 1e-4
    assert motion.u[:, :12].min() >= 0.0


@pytest.mark.exhaustive
def test_a_constant_torque_leaves_the_momentum_torque_over_rate():
    alone, design, _ = cubesat()
    torque = 2e-6
    pushed = design.replace(disturbance={"tau_b": [torque, 0.0, 0.0]})
    law = fflin.unload_wheels(output_law(alone), design, RATE)
    motion = fflin.simulate(pushed, law, duration=300.0, dt=SAMPLE)
    assert momenta(pushed, motion)[-1] == pytest.approx(
        [torque / RATE, 0.0, 0.0], abs=1e-3 * torque / RATE
    )
    assert motion.attitude_error[-1] < 1e-3


@pytest.mark.compiled
@pytest.mark.parametrize("kind", LAWS)
def test_compiled_code_unloads_as_python_does(kind):
    alone, design, flown = cubesat()
    law = fflin.unload_wheels(LAWS[kind](alone, delay=0.25), design, RATE)
    policy = fflin.Allocation(law, design)
    robot = flown
    options = {
        "q0": fflin.configuration(robot, rpy=(1, -1, 2)),
        "v0": fflin.velocity(robot, SPEEDS),
        "duration": 10.0,
        "dt": 0.05,
    }
    python, compiled = (
        fflin.simulate(robot, policy, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    assert compiled.q == pytest.approx(python.q, abs=1e-9)
    assert compiled.u == pytest.approx(python.u, abs=1e-9)


def slew_of(alone):
    """Return a slew of 8 s by wheel_z, from rest to rest."""

    def bang_bang(t, q, v):
        return np.array((0.0, 0.0, 2e-5 if t < 3.999 else -2e-5))

    return fflin.simulate(
        alone, bang_bang, duration=8.0, sample=0.5, dt=0.5
    ).trajectory()


def test_a_law_that_unloads_follows_a_slew_of_the_wheels():
    alone, design, _ = cubesat()
    law = fflin.unload_wheels(state_law(alone), design, RATE)
    policy = law.follow(slew_of(alone))
    motion = fflin.simulate(design, policy, duration=12.0, dt=SAMPLE)
    assert motion.attitude_error.max() < 1e-9
    assert np.abs(motion.q[-1][5]) > 0.01


@pytest.mark.compiled
@pytest.mark.exhaustive
def test_thrusters_unload_wheels_during_a_slew_in_both_engines():
    alone, design, flown = cubesat()
    law = fflin.unload_wheels(output_law(alone, delay=SAMPLE), design, RATE)
    policy = fflin.Allocation(law.follow(slew_of(alone)), design)
    v0 = fflin.velocity(flown, SPEEDS)
    options = {"v0": v0, "duration": 16.0, "dt": 0.125}
    python, compiled = (
        fflin.simulate(flown, policy, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    # The momentum of the wheels turns with the base, a torque that the plan does not contain.
    assert python.attitude_error.max() < 0.1
    assert np.abs(python.v[-1, 6:]).max() < 0.7 * 300.0
    assert compiled.q == pytest.approx(python.q, abs=1e-9)
    assert compiled.u == pytest.approx(python.u, abs=1e-9)


def magnetic_satellite():
    """The cubesat with three magnetorquers and three wheels, its law, and the unloading design."""
    orbit = fflin.CircularOrbit(500e3, inclination=1.7, field="dipole")
    rods = [fflin.Magnetorquer(axis, max=0.2) for axis in np.eye(3)]
    inputs = fflin.load_inputs("cubesat")
    wheels = [item for item in inputs if isinstance(item, fflin.ReactionWheel)]
    robot = fflin.load("cubesat", orbit=orbit, inputs=[*rods, *wheels])
    lin = fflin.linearize(robot.replace(inputs=wheels)).discretize(1.0)
    K = fflin.lqr(lin).K.copy()
    K[:, -3:] = (
        0.0  # otherwise the law unloads by the gravity gradient, and tilts the robot
    )
    law = fflin.StateFeedback(lin, K)
    return robot, law, robot.replace(inputs=[fflin.BaseTorque(), *wheels])


def test_magnetorquers_realise_the_torque_across_the_field_and_wheels_the_rest():
    """The allocated inputs cause the nearest accelerations of all bodies, within their limits."""
    robot, law, design = magnetic_satellite()
    unloading = fflin.unload_wheels(law, design, 1e-3)
    v = fflin.velocity(robot, {"wheel_x": 300.0, "wheel_y": -200.0, "wheel_z": 150.0})
    q = fflin.configuration(robot, rpy=(0.1, -0.1, 0.1))
    t = 700.0
    commanded = unloading.bind(design)(t, q, v)
    u = fflin.Allocation(unloading, design).bind(robot)(t, q, v)
    lin = fflin.linearize(robot, q, v, t=t)
    wanted = fflin.linearize(design, q, v)
    rates = slice(len(lin.M), None)
    M = lin.M
    columns, target = lin.B[rates], wanted.B[rates] @ commanded
    # The gradient of (columns u - target)' M (columns u - target) vanishes.
    gradient = columns.T @ M @ (columns @ u - target)
    size = np.abs(columns.T @ M) @ np.abs(target)
    assert (np.abs(gradient) < 1e-6 * size.max()).all()
    assert np.abs(u[:3]).max() < 0.2
    forces = M @ columns
    moment = forces[:3, :3] @ u[:3]
    b = np.cross(forces[:3, 0], forces[:3, 1])  # along the field
    assert abs(moment @ b) < 1e-9 * np.linalg.norm(moment) * np.linalg.norm(b)


@pytest.mark.exhaustive
def test_magnetorquers_unload_wheels_while_the_attitude_stays():
    robot, law, design = magnetic_satellite()
    policy = fflin.Allocation(fflin.unload_wheels(law, design, 2e-3), design)
    v0 = fflin.velocity(robot, {"wheel_x": 300.0, "wheel_y": -200.0, "wheel_z": 150.0})
    duration = math.floor(0.8 * robot.orbit.period)
    options = {"duration": duration, "dt": 1.0, "limits": "urdf"}
    motion = fflin.simulate(robot, policy, v0=v0, **options)
    assert motion.attitude_error.max() < 1.0
    assert (np.abs(motion.v[-1, 6:]) < 0.1 * np.abs(v0[6:])).all()


@pytest.mark.parametrize(
    ("rate", "change"),
    [(0.1, "lowers"), *exhaustive((5.0, "unstable"), (1e-3, ""))],
)
def test_a_rate_that_takes_the_margin_away_gives_a_warning(rate, change):
    """The message states the margins that `margins` computes; k h = 1.25 exceeds a delay of h."""
    alone, design, _ = cubesat()
    law = state_law(alone, delay=SAMPLE)
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always", fflin.FflinWarning)
        unloading = fflin.unload_wheels(law, design, rate)
    text = "".join(str(item.message) for item in record)
    before = fflin.margins(law, law.lin).disk
    after = fflin.margins(unloading, unloading.lin)
    assert change in text and bool(text) == bool(change)
    assert bool(text) == (after.disk < 0.8 * before)
    assert after.stable == (rate * SAMPLE < 1.0)
    if text:
        assert f"{before:.3g}" in text
    if change == "lowers":
        assert f"to {after.disk:.3g};" in text


def test_laws_and_robots_that_cannot_unload_are_refused():
    alone, design, flown = cubesat()
    law = state_law(alone)
    with pytest.raises(fflin.InputError, match="law has type float"):
        fflin.unload_wheels(1.0, design, RATE)
    with pytest.raises(fflin.InputError, match="rate is -1 1/s"):
        fflin.unload_wheels(law, design, -1.0)
    with pytest.raises(fflin.InputError, match="change only 0 of 3"):
        fflin.unload_wheels(law, alone, RATE)
    with pytest.raises(fflin.InputError, match="change only 0 of 3"):
        fflin.unload_wheels(law, flown, RATE)
    with pytest.raises(fflin.InputError, match="other states than 'planar_detumble'"):
        fflin.unload_wheels(law, fflin.load("planar_detumble"), RATE)
    lin = fflin.linearize(design).discretize(SAMPLE)
    regulated = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    with pytest.raises(fflin.InputError, match="already feeds back qdot_m"):
        fflin.unload_wheels(regulated, design, RATE)
    with_torque = fflin.StateFeedback(lin, fflin.lqr(lin, wheel_speeds=False).K)
    with pytest.raises(fflin.InputError, match="law commands tau_b"):
        fflin.unload_wheels(with_torque, alone, RATE)
    blind = alone.replace(outputs=[fflin.BasePose(), fflin.Gyroscope("base")])
    model = fflin.linearize(blind).discretize(SAMPLE)
    estimator = fflin.kalman(model, {"omega_b": 1e-12}, 1e-8)
    feedback = fflin.OutputFeedback(model, fflin.lqg(fflin.lqr(model), estimator))
    unseen = design.replace(outputs=blind.outputs)
    with pytest.raises(fflin.InputError, match="does not measure qdot_m"):
        fflin.unload_wheels(feedback, unseen, RATE)
    with pytest.raises(fflin.InputError, match="other outputs than 'cubesat'"):
        fflin.unload_wheels(feedback, design, RATE)
    wheelless = fflin.load("planar_detumble")
    model = fflin.linearize(wheelless).discretize(SAMPLE)
    plain = fflin.StateFeedback(model, fflin.lqr(model).K)
    with pytest.raises(fflin.InputError, match="has no wheels"):
        fflin.unload_wheels(plain, wheelless, RATE)
    late = fflin.linearize(alone).discretize(SAMPLE, {"wheel_x": 0.1})
    mixed = fflin.StateFeedback(late, fflin.lqr(late))
    with pytest.raises(fflin.InputError, match="expected one delay of all inputs"):
        fflin.unload_wheels(mixed, design, RATE)
    slow = [replace(wheel, lag=0.5) for wheel in alone.inputs]
    lagging = alone.replace(inputs=slow)
    aware = fflin.linearize(alone).with_lags({"wheel_x": 0.5}).discretize(SAMPLE)
    with pytest.raises(fflin.InputError, match="inputs of the law have the lags"):
        fflin.unload_wheels(fflin.StateFeedback(aware, fflin.lqr(aware)), design, RATE)
    unaware = fflin.linearize(lagging).discretize(SAMPLE)
    law = fflin.StateFeedback(unaware, fflin.lqr(unaware))
    torque = lagging.replace(inputs=[fflin.BaseTorque(), *slow])
    with pytest.raises(fflin.InputError, match="expected one lag of all inputs"):
        fflin.unload_wheels(law, torque, RATE)
