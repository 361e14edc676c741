"""Filters and laws of outputs with their own sample times and delays."""

from collections import deque

import numpy as np
import pytest

import fflin
from fflin.control.kalman import _problem
from fflin.control.loops import Loop
from fflin.control.multirate import multirate_filter
from fflin.control.sensors import SensorTiming
from tests.support.c_code import needs_compiler
from tests.support.marks import exhaustive

W = {"omega_b": 1e-12}


def sensors(sample=0.25, delay=0.2):
    """Return a star tracker with its own sample time and delay, and a gyroscope."""
    return [
        fflin.StarTracker(
            sample=sample, delay=delay, noise={"noise_equivalent_angle": 10.0}
        ),
        fflin.Gyroscope(
            "base", noise={"angle_random_walk": 0.1}, bias={"bias_instability": 1.0}
        ),
    ]


def satellite(outputs=None, dt=0.05):
    """Return a robot with three wheels and its sampled model."""
    given = fflin.load_inputs("cubesat")
    wheels = [item for item in given if isinstance(item, fflin.ReactionWheel)]
    robot = fflin.load("cubesat", inputs=wheels, outputs=outputs or sensors())
    return robot, fflin.linearize(robot).discretize(dt)


def designed(**arguments):
    """Return a robot, its model, and the compensator that rejects a constant torque."""
    robot, lin = satellite(**arguments)
    estimator = fflin.kalman(lin, W, disturbance_noise={"tau_b": 1e-16})
    default = fflin.lqr(lin)
    # Given weights are not made slower for the margin of the loop.
    gain = fflin.lqr(lin, default.Q, default.R, default.N)
    return robot, lin, fflin.lqg(gain, estimator)


def test_a_filter_of_equal_rates_is_the_ordinary_filter():
    """The periodic filter of outputs that arrive at each sample equals that of `kalman`."""
    outputs = [fflin.StarTracker(noise=1e-5), fflin.Gyroscope("base", noise=1e-5)]
    _, lin = satellite(outputs)
    slow = {"tau_b": 1e-12}, {"gyroscope": 1e-14}, {"tau_b": [0.01]}
    problem = _problem(lin, {"omega_b": 1e-10}, None, None, None, slow)
    expected = fflin.kalman(
        lin,
        {"omega_b": 1e-10},
        disturbance_noise=slow[0],
        bias_noise=slow[1],
        disturbance_frequency=slow[2],
    )
    assert isinstance(expected, fflin.Estimator)
    result = multirate_filter(problem, SensorTiming((1,) * 6, (0,) * 6))
    # Entries are compared with the standard deviations of the states and of the noise.
    size = np.sqrt(np.diag(expected.P))
    noise = np.sqrt(np.diag(expected.V))
    assert (np.abs(result.P[0] - expected.P) <= 1e-10 * np.outer(size, size)).all()
    for name in ("L", "L_update"):
        error = np.abs(getattr(result, name)[0] - getattr(expected, name))
        assert (error <= 1e-10 * np.outer(size, 1.0 / noise)).all()
    for name in ("A", "B", "C", "D", "W", "V"):
        assert (getattr(result, name) == getattr(expected, name)).all()
    assert result.state_names == expected.state_names


def test_names_of_late_outputs_and_the_arrivals():
    _, lin = satellite()
    estimator = fflin.kalman(lin, W)
    assert estimator.samples == 5 and estimator.period == 0.25
    assert estimator.biases == tuple(f"bias.base.gyroscope.{axis}" for axis in "xyz")
    late = [f"late_{k}.q_b.{axis}" for axis in "xyz" for k in (1, 2, 3, 4)]
    assert estimator.state_names[-12:] == tuple(late)
    arrives = estimator.L_update.any(axis=1)
    # measured at the samples 0, 5, ..., and received 4 samples later
    assert arrives[:, :3].tolist() == [[k == 4] * 3 for k in range(5)]
    assert arrives[:, 3:].all()
    assert "estimated biases" in str(estimator)
    assert "period of 5 samples" in estimator._repr_html_()


def test_the_noise_of_sensors_is_the_default():
    """V and bias_noise follow from the outputs; given values take precedence."""
    _, lin = satellite()
    default = fflin.kalman(lin, W)
    arcsec = np.pi / 180.0 / 3600.0
    walk = np.pi / 180.0 / 60.0 * 0.1
    assert np.diag(default.V)[:3] == pytest.approx((5.0 * arcsec) ** 2)
    assert np.diag(default.V)[3:] == pytest.approx(walk**2 / 0.05)
    given = fflin.kalman(
        lin,
        W,
        {
            "q_b": {"noise_equivalent_angle": 10.0},
            "gyroscope": {"angle_random_walk": 0.1},
        },
        bias_noise={"gyroscope": {"bias_instability": 1.0}},
    )
    assert (given.L == default.L).all()
    other = fflin.kalman(lin, W, {"q_b": 1e-6})
    assert np.diag(other.V)[:3] == pytest.approx(1e-6)
    assert np.diag(other.V)[3:] == pytest.approx(walk**2 / 0.05)


def test_the_density_of_a_slow_sensor_counts_per_its_own_sample():
    outputs = [
        fflin.StarTracker(noise=1e-5),
        fflin.Gyroscope("base", sample=0.2, noise={"angle_random_walk": 0.1}),
    ]
    _, lin = satellite(outputs)
    walk = np.pi / 180.0 / 60.0 * 0.1
    assert np.diag(fflin.kalman(lin, W).V)[3:] == pytest.approx(walk**2 / 0.2)


def test_outputs_without_noise_need_V():
    _, lin = satellite([fflin.StarTracker(noise=1e-5), fflin.Gyroscope("base")])
    with pytest.raises(fflin.InputError, match="V is missing, and the outputs"):
        fflin.kalman(lin, W)
    assert fflin.kalman(lin, W, {"gyroscope": 1e-10}).V[0, 0] == pytest.approx(1e-10)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sample": 0.12}, r"nearest times with a common grid are 0\.1 and 0\.15 s"),
        ({"delay": 0.21}, r"delay of output q_b\.x is 0\.21 s, which has no common"),
        ({"sample": 0.01}, r"nearest times with a common grid are 0\.05 and 0\.1 s"),
        ({"delay": 30.0}, "more than 500 samples"),
    ],
)
def test_times_without_a_common_grid_are_refused(arguments, message):
    robot, lin = satellite(sensors(**arguments))
    with pytest.raises(fflin.InputError, match=message):
        fflin.kalman(lin, W)
    with pytest.raises(fflin.InputError, match=message):
        fflin.simulate(robot, ordinary(lin), duration=1.0)


def ordinary(lin):
    """Return a law without memory of the measured rates."""
    gain = np.zeros((3, 6))
    gain[:, 3:] = 1e-3 * np.eye(3)
    return fflin.LinearController(
        (np.zeros((0, 0)), np.zeros((0, 6)), np.zeros((3, 0)), gain, lin.dt), lin
    )


def test_a_pattern_that_hardly_ever_repeats_is_refused():
    outputs = [
        fflin.StarTracker(sample=0.01 * 31, noise=1e-5),
        fflin.Gyroscope("base", sample=0.01 * 37, noise=1e-5),
    ]
    _, lin = satellite(outputs, dt=0.01)
    with pytest.raises(fflin.InputError, match=r"nearest sample with a common grid"):
        fflin.kalman(lin, W)


def test_wrong_properties_of_sensors_are_refused():
    with pytest.raises(fflin.InputError, match="sample of star_tracker is 0 s"):
        fflin.StarTracker(sample=0.0)
    with pytest.raises(fflin.InputError, match=r"delay of gyroscope is -1 s"):
        fflin.Gyroscope("base", delay=-1.0)
    with pytest.raises(fflin.InputError, match="noise of star_tracker is -1"):
        fflin.StarTracker(noise=-1.0)
    message = "for outputs in rad/s, but .* output is 1; give noise_equivalent_angle"
    with pytest.raises(fflin.InputError, match=message):
        fflin.StarTracker(noise={"angle_random_walk": 1.0})


def test_continuous_designs_with_slow_sensors_are_refused():
    robot, lin = satellite()
    continuous = fflin.linearize(robot)
    with pytest.raises(fflin.InputError, match="continuous; use a sampled one"):
        fflin.kalman(continuous, W, 1e-8)
    gain = fflin.lqr(lin, integral_action=["q_b"])
    with pytest.raises(fflin.InputError, match="use disturbance_noise= of kalman"):
        fflin.lqg(gain, fflin.kalman(lin, W))
    compensator = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, W))
    with pytest.raises(fflin.InputError, match="MultirateFeedback"):
        fflin.OutputFeedback(lin, compensator)
    with pytest.raises(fflin.InputError, match="another sample time"):
        fflin.MultirateFeedback(continuous.discretize(0.25), compensator)


def test_the_simulated_loop_equals_one_with_queues():
    """Each measurement is queued, arrives late and is used once, by hand in the linear loop."""
    robot, lin, law = designed()
    policy = fflin.MultirateFeedback(lin, law)
    q0 = fflin.configuration(robot, rpy=(1e-3, 0, -2e-3))
    motion = fflin.simulate(robot, policy, q0=q0, duration=5.0, dt=0.05, noise=0.0)
    e = motion.x[0] - lin.x0
    z = np.zeros(law.A.shape[1])
    queue = deque([np.zeros(3)] * 4)
    for k, row in enumerate(motion.prediction):
        assert row - lin.x0 == pytest.approx(e, abs=1e-12)
        y = lin.C @ e
        queue.append(y[:3])
        received = np.concatenate((queue.popleft(), y[3:]))
        if k % 5 != 4:
            received[:3] = 1e3  # the law must not read it
        u = law.C @ z
        z = law.A[k % 5] @ z + law.B[k % 5] @ received
        e = lin.A @ e + lin.B @ u
    attitude = np.abs(motion.x - motion.prediction)[:, :3]
    assert attitude.max() < 1e-8


@pytest.mark.exhaustive
def test_a_constant_torque_leaves_no_attitude_error():
    """The loop of the exact sampled plant with queues settles at zero, over one period."""
    _, lin = satellite()
    estimator = fflin.kalman(lin, W, disturbance_noise={"tau_b": 1e-16})
    law = fflin.lqg(fflin.lqr(lin), estimator)
    rows = [
        lin.state_names.index(f"{x}.{axis}")
        for x in ("q_b", "omega_b")
        for axis in "xyz"
    ]
    A, B, C = lin.A[np.ix_(rows, rows)], lin.B[rows], lin.C[:, rows]
    column = estimator.state_names.index("disturbance.tau_b.x")
    push = 1e-6 * estimator.A[rows, column : column + 1]  # of 1e-6 N m
    nz = law.A.shape[1]
    size = 6 + nz + 12

    def after(state, constant):
        """Return the states (n, k) after a period; a disturbance acts if `constant` is 1."""
        e, z, past = np.split(state, (6, 6 + nz))
        queue = deque(np.split(past, 4))
        for k in range(5):
            y = C @ e
            queue.append(y[:3])
            received = np.vstack((queue.popleft(), y[3:]))
            u = law.C @ z
            z = law.A[k] @ z + law.B[k] @ received
            e = A @ e + B @ u + constant * push
        return np.vstack((e, z, *queue))

    period = after(np.eye(size), 0.0)
    assert np.abs(np.linalg.eigvals(period)).max() < 1.0
    steady = np.linalg.solve(np.eye(size) - period, after(np.zeros((size, 1)), 1.0))
    assert np.abs(steady[:6]).max() < 1e-12
    torque = steady[6 + law.state_names.index("disturbance.tau_b.x")]
    assert torque == pytest.approx(1e-6, rel=1e-9)


def test_an_ordinary_law_feels_the_sensors():
    """It receives the latest value of each sensor, and its prediction contains this."""
    robot, lin = satellite(sensors(sample=0.5, delay=0.25), dt=0.25)
    plain = robot.replace(outputs=[fflin.StarTracker(), fflin.Gyroscope("base")])
    model = fflin.linearize(plain).discretize(0.25)
    law = fflin.lqg(fflin.lqr(model), fflin.kalman(model, 1e-8, 1e-8))
    policy = fflin.OutputFeedback(model, law)
    q0 = fflin.configuration(robot, rpy=(1e-3, 0, 0))
    late = fflin.simulate(robot, policy, q0=q0, duration=10.0, dt=0.05, noise=0.0)
    soon = fflin.simulate(plain, policy, q0=q0, duration=10.0, dt=0.05)
    assert np.abs(late.x - soon.x)[:, :3].max() > 1e-7
    assert np.abs(late.x - late.prediction)[:, :3].max() < 1e-9
    assert lin.output_names == model.output_names


def test_laws_without_a_value_at_the_start_are_refused():
    robot, _ = satellite()
    with pytest.raises(
        fflin.InputError, match="laws along a trajectory do not support"
    ):
        Loop(fflin.StateMap(robot), 0.05, (0, 6), lambda _: None)


def test_files_keep_the_designs(tmp_path):
    _, lin, law = designed()
    estimator = fflin.kalman(lin, W)
    for ending in ("npz", "json", "mat"):
        estimator.save(tmp_path / f"e.{ending}")
        law.save(tmp_path / f"c.{ending}")
        read = fflin.MultirateEstimator.load(tmp_path / f"e.{ending}")
        assert (read.L == estimator.L).all() and read.estimated == estimator.estimated
        assert (
            fflin.MultirateCompensator.load(tmp_path / f"c.{ending}").A == law.A
        ).all()


def test_a_robot_file_contains_the_sensors(tmp_path):
    file = tmp_path / "satellite.toml"
    head = 'urdf = "cubesat"\n'
    file.write_text(
        head
        + "[[output]]\n"
        + 'type = "star_tracker"\nsample = 0.25\ndelay = 0.2\n'
        + "noise = {noise_equivalent_angle = 10.0}\n"
        + "[[output]]\n"
        + 'type = "gyroscope"\nframe = "base"\nnoise = {angle_random_walk = 0.1}\n'
        + "bias = {bias_instability = 1.0}\n"
    )
    assert fflin.load(file).outputs == tuple(sensors())
    file.write_text(head + '[[output]]\nframe = "base"\n')
    with pytest.raises(fflin.InputError, match="the key 'type' is missing"):
        fflin.load(file)
    file.write_text(head + 'outputs = "state"\n[[output]]\ntype = "star_tracker"\n')
    with pytest.raises(fflin.InputError, match="both outputs and"):
        fflin.load(file)
    star = fflin.load("cubesat", outputs="star_tracker")
    assert star.outputs == (fflin.StarTracker(),)


def test_check_holds_for_a_star_tracker():
    robot, _ = satellite()
    assert fflin.check(robot, fflin.linearize(robot)).ok


@needs_compiler
def test_the_C_code_equals_python(tmp_path):
    robot, lin, law = designed()
    policy = fflin.MultirateFeedback(lin, law)
    code = fflin.CLaw(fflin.write_c(policy, tmp_path / "law", limits=5e-5))
    q0 = fflin.configuration(robot, rpy=(3, 0, -2))
    options = {"q0": q0, "duration": 20.0, "dt": 0.05}
    expected = fflin.simulate(robot, policy, limits=5e-5, noise=0.0, **options)
    result = fflin.simulate(robot, code, **options)
    size = np.abs(expected.u).max()
    assert size == pytest.approx(5e-5)
    assert np.abs(result.u - expected.u).max() < 1e-12 * size


@pytest.mark.compiled
@pytest.mark.parametrize("noisy", [False, True])
def test_the_compiled_engine_equals_python(noisy):
    robot, lin, law = designed()
    noise = None
    if noisy:
        errors = 1e-5 * np.random.default_rng(0).normal(size=(401, 6))
        noise = lambda t: errors[round(t / 0.05)]  # noqa: E731
    policy = fflin.MultirateFeedback(lin, law, noise=noise)
    q0 = fflin.configuration(robot, rpy=(3, 0, -2))
    options = {"q0": q0, "duration": 20.0, "dt": 0.05, "limits": "urdf"}
    python = fflin.simulate(robot, policy, **options)
    compiled = fflin.simulate(robot, policy, engine="compiled", **options)
    assert compiled.engine == "compiled"
    assert np.abs(compiled.u - python.u).max() < 1e-12 * np.abs(python.u).max()


def errors_of_runs(runs, samples, seed):
    """Return the estimation errors (runs, n) of a filter after some samples, and their P.

    The true sensors are queues. The errors are of the estimated states without late outputs.
    """
    _, lin = satellite()
    estimator = fflin.kalman(lin, W, disturbance_noise={"tau_b": 1e-16})
    names = estimator.estimated
    rows = [estimator.state_names.index(name) for name in names]
    n = len(rows) - 12
    A = estimator.A[np.ix_(rows, rows)]
    C = lin.C[:, rows[: n - 6]]
    C = np.hstack((C, np.zeros((6, 3)), np.vstack((np.zeros((3, 3)), np.eye(3)))))
    L, P = estimator.L[:, rows], estimator.P[:, rows][:, :, rows]
    rng = np.random.default_rng(seed)
    scale = np.sqrt(np.diag(P[0]))

    def drawn(covariance, count):
        size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return size * (rng.normal(size=(count, len(size))) @ root.T)

    driving = estimator.W[np.ix_(rows, rows)][:n, :n]
    start = drawn(P[0], runs)
    x, estimate = start[:, :n], np.zeros((runs, len(rows)))
    # The states late_4 to late_1 of each axis are the queue, the oldest first.
    past = start[:, n:].reshape(runs, 3, 4)
    queue = deque(past[:, :, k] for k in (3, 2, 1, 0))
    deviations = np.sqrt(np.diag(estimator.V))
    for k in range(samples):
        y = x @ C.T
        queue.append(y[:, :3])
        received = np.hstack((queue.popleft(), y[:, 3:]))
        received = received + deviations * rng.normal(size=(runs, 6))
        predicted = np.hstack(
            (estimate[:, [n + 3, n + 7, n + 11]], (estimate[:, :n] @ C.T)[:, 3:])
        )
        estimate = estimate @ A.T + (received - predicted) @ L[k % 5].T
        x = x @ A[:n, :n].T + drawn(driving, runs)
    assert scale.all()
    return x - estimate[:, :n], P[samples % 5][:n, :n], names[:n]


@pytest.mark.parametrize("samples", [13, *exhaustive(500, 2001)])
def test_the_filter_is_consistent(samples):
    """NEES is within its band of 95 %, and each bias within 1.96 sigma in 95 +- 2 % of the runs."""
    runs = 1000 if samples > 13 else 200
    errors, P, names = errors_of_runs(runs, samples, seed=samples)
    n = len(names)
    size = np.sqrt(np.diag(P))
    whitened = np.linalg.solve(
        np.linalg.cholesky(P / np.outer(size, size)), (errors / size).T
    )
    nees = (whitened**2).sum(axis=0)
    assert abs(nees.mean() - n) < 1.96 * np.sqrt(2.0 * n / runs)
    if runs == 1000:
        for index, name in enumerate(names):
            if name.startswith("bias."):
                inside = np.abs(errors[:, index]) < 1.96 * size[index]
                assert 0.93 < inside.mean() < 0.97


def test_designs_for_other_sensors_are_refused(tmp_path):
    _, lin, compensator = designed()
    law = fflin.MultirateFeedback(lin, compensator)
    other, _ = satellite(sensors(sample=0.5))
    with pytest.raises(fflin.InputError, match="other sample times or delays"):
        law.bind(other)
    with pytest.warns(fflin.FflinWarning, match="does not contain the sample times"):
        lin.save(tmp_path / "model.npz")


def test_filters_along_trajectories_refuse_slow_sensors():
    robot, _ = satellite()
    rest = np.tile(robot.neutral(), (3, 1)), np.zeros((3, robot.nv)), np.zeros((3, 3))
    motion = fflin.Trajectory(robot, [0.0, 0.5, 1.0], *rest)
    along = fflin.linearize_trajectory(robot, motion)
    with pytest.raises(fflin.InputError, match="tvkalman measures all outputs every"):
        fflin.tvkalman(along, 1e-8, 1e-8, sample=0.05)
