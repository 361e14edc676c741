"""Sampled models whose inputs are delayed: exact matrices, names, files and designs."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

import fflin
from fflin.control.closed_loop import ClosedLoop
from fflin.control.margins import laws_in_loop

DELAYS = (0.03, 0.1, 0.17, 0.2, 0.33)


def satellite(inputs=None, **fields):
    """Return a robot with a base torque, or with other inputs, and its model."""
    robot = fflin.load("cubesat", inputs=inputs or [fflin.BaseTorque()], **fields)
    return robot, fflin.linearize(robot)


@pytest.fixture(scope="module")
def arm():
    """Return the model of a moving arm, whose A is not nilpotent, with springs."""
    robot = fflin.load("planar_detumble", stiffness=2.0, damping=0.1)
    v = fflin.velocity(robot, {"joint_1": 0.3, "omega_b.z": 0.2})
    q = fflin.configuration(robot, {"joint_2": 0.5})
    return fflin.linearize(robot, q, v)


def test_a_delay_of_zero_gives_the_same_model_bit_for_bit(arm):
    plain = arm.discretize(0.1)
    for delay in (0.0, {}, {"tau_b": 0.0}):
        late = arm.discretize(0.1, delay=delay)
        for name in ("A", "B", "C", "D", "f0", "x0", "u0", "y0"):
            assert (getattr(late, name) == getattr(plain, name)).all()
        assert late.state_names == plain.state_names
        assert late.added == ()
        assert not late.delay.any()
        assert late.undelayed is late


@pytest.mark.parametrize("delay", DELAYS)
def test_a_double_integrator_by_hand(delay):
    """A base force moves the base by u/m; a part of the delay splits its sample in two."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseForce()])
    lin = fflin.linearize(robot)
    h = 0.1
    late = lin.discretize(h, delay=delay)
    k = int(np.ceil(delay / h - 1e-9))
    e = delay - (k - 1) * h
    r, v, force = (
        late.state_names.index("r_b.x"),
        late.state_names.index("v_b.x"),
        late.input_names.index("F_b.x"),
    )
    oldest = late.state_names.index(f"past_{k}.F_b.x")
    mass = robot.mass
    assert late.A[v, oldest] == pytest.approx(e / mass)
    assert late.A[r, oldest] == pytest.approx((e * e / 2 + e * (h - e)) / mass)
    late_part = (h - e) / mass, (h - e) ** 2 / 2 / mass
    if k == 1:
        newer = late.B[[v, r], force]
    else:
        newer = late.A[[v, r], oldest - 1]
        assert not late.B[:12].any()
        assert late.A[oldest, oldest - 1] == 1.0
    assert newer == pytest.approx(late_part, abs=1e-16)
    assert late.B[late.state_names.index("past_1.F_b.x"), force] == 1.0


def test_a_delay_of_one_sample_shifts_the_inputs(arm):
    plain, late = arm.discretize(0.1), arm.discretize(0.1, delay=0.1)
    nx, nu = arm.B.shape
    assert (late.A[:nx, :nx] == plain.A).all()
    assert late.A[:nx, nx:] == pytest.approx(plain.B, rel=1e-12, abs=1e-14)
    assert not late.A[nx:].any() and not late.B[:nx].any()
    assert (late.B[nx:] == np.eye(nu)).all()


@pytest.mark.parametrize("delay", DELAYS)
def test_steps_equal_a_fine_integration(arm, delay):
    """The inputs and the constant f0 act on the true system at their own times."""
    h, parts = 0.1, 100
    late = arm.discretize(h, delay={"tau_b": delay, "joint_1": 0.05})
    rng = np.random.default_rng(1)
    nx, nu = arm.B.shape
    block = np.zeros((nx + nu + 1, nx + nu + 1))
    block[:nx] = np.column_stack((arm.A, arm.B, arm.f0))
    fine = expm(block * h / parts)
    x = 0.1 * rng.normal(size=nx)
    z = np.append(x, np.zeros(len(late.added)))
    delays = late.delay
    commands = rng.normal(size=(8, nu))
    for k, u in enumerate(commands):
        for part in range(parts):
            at = k * h + (part + 0.5) * h / parts - delays
            arrived = np.floor(at / h).astype(int)
            acting = np.where(arrived < 0, 0.0, commands[arrived, np.arange(nu)])
            x = (fine @ np.concatenate((x, acting, [1.0])))[:nx]
        z = late.A @ z + late.B @ u + late.f0
        assert z[:nx] == pytest.approx(x, abs=1e-11)


def test_names_units_and_delays_of_the_added_states():
    _, lin = satellite([fflin.BaseTorque(), fflin.BaseForce()])
    late = lin.discretize(0.1, delay={"tau_b": 0.15, "F_b.z": 0.1})
    assert late.added == (
        *(f"past_{k}.tau_b.{axis}" for axis in "xyz" for k in (1, 2)),
        "past_1.F_b.z",
    )
    assert late.state_names == (*lin.state_names, *late.added)
    assert late.robot_states == lin.state_names
    assert late.state_units[-7:] == ("N m",) * 6 + ("N",)
    assert late.delay.tolist() == [0.15, 0.15, 0.15, 0.0, 0.0, 0.1]
    assert late.A.shape == (19, 19) and late.C.shape == (12, 19)


@pytest.mark.exhaustive
def test_a_held_point_stays_a_fixed_point():
    """The commands on their way are u0 at the operating point."""
    robot = fflin.load("planar_detumble", gravity=(0.0, 0.0, -9.81))
    point = fflin.equilibrium(robot)
    lin = fflin.linearize(robot, point.q, None, point.u)
    late = lin.discretize(0.05, delay=0.08)
    assert lin.u0.any()
    assert late.is_equilibrium()
    assert np.abs(late.f0).max() < 1e-12
    assert late.x0[len(lin.x0) :] == pytest.approx(np.repeat(lin.u0, 2))
    assert fflin.lqr(late).u0 == pytest.approx(lin.u0)
    # From a point without inputs, the design finds the inputs that hold the robot.
    fallen = fflin.linearize(robot).discretize(0.05, delay=0.08)
    assert fflin.lqr(fallen).K == pytest.approx(fflin.lqr(late).K, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("delay", [0.05, 0.25])
def test_outputs_with_feedthrough_see_the_input_that_has_arrived(delay):
    _, lin = satellite([fflin.BaseForce()], outputs=[fflin.Accelerometer("base")])
    late = lin.discretize(0.1, delay=delay)
    oldest = f"past_{int(np.ceil(delay / 0.1))}."
    at = [i for i, name in enumerate(late.state_names) if name.startswith(oldest)]
    assert (late.C[:, at] == lin.D).all()
    assert not late.D.any()


def test_sampling_at_a_delay_keeps_the_model_without_it(arm):
    late = arm.discretize(0.1, delay=0.17)
    plain = arm.discretize(0.1)
    for model in (late, replace(late, _source=None)):
        same = model.undelayed
        assert same.state_names == plain.state_names and same.added == ()
        assert not same.delay.any()
        for name in ("A", "B", "C", "D", "f0", "x0"):
            expected = getattr(plain, name)
            assert getattr(same, name) == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize("ending", ["npz", "mat", "json"])
def test_files_keep_the_delay(arm, tmp_path, ending):
    late = arm.discretize(0.1, delay={"tau_b": 0.17})
    path = tmp_path / f"m.{ending}"
    late.save(path)
    read = fflin.LinearModel.load(path)
    assert read.added == late.added and (read.delay == late.delay).all()
    for name in ("A", "B", "C", "D", "f0", "x0", "M"):
        assert (getattr(read, name) == getattr(late, name)).all()
    assert read.undelayed.B == pytest.approx(late.undelayed.B, abs=1e-14)


def test_tables_name_the_states_of_delayed_inputs(arm, tmp_path):
    late = arm.discretize(0.1, delay={"tau_b": 0.1})
    late.save(tmp_path / "m.csv")
    rows = (tmp_path / "m.M.csv").read_text().splitlines()
    assert [row.partition(",")[0] for row in rows[1:]] == list(arm.state_names[9:])
    assert "past_1.tau_b.x" in (tmp_path / "m.A.csv").read_text().splitlines()[0]


def test_impossible_delays_are_refused(arm):
    with pytest.raises(fflin.InputError, match="at least 0 and at most 500 samples"):
        arm.discretize(0.1, delay=-0.1)
    with pytest.raises(fflin.InputError, match=r"at most 500 samples of 0\.1 s"):
        arm.discretize(0.1, delay=51.0)
    with pytest.raises(fflin.UnknownNameError, match="tau_c"):
        arm.discretize(0.1, delay={"tau_c": 0.1})
    with pytest.raises(fflin.InputError, match="delay"):
        arm.discretize(0.1, delay="0.1")


def test_python_control_and_scipy_take_the_delayed_model():
    _, lin = satellite()
    late = lin.discretize(0.1, delay=0.17)
    assert late.to_scipy().A.shape == (18, 18)
    control = pytest.importorskip("control")
    system = late.to_control()
    assert isinstance(system, control.StateSpace)
    assert system.state_labels[-1] == "past_2_tau_b_z"


def optimal_cost(lin, h, delay, Q, R, commands, x):
    """Return the integral of the cost over the samples of `commands`, by quadrature."""
    nx, nu = lin.B.shape
    block = np.zeros((nx + nu, nx + nu))
    block[:nx] = np.hstack((lin.A, lin.B))
    total = 0.0
    for k, u in enumerate(commands):
        total += h * u @ R @ u
        pieces = [(0.0, delay % h, 1), (delay % h, h, 0)]
        for begin, end, late in pieces:
            ago = k - int(delay // h) - late
            acting = commands[ago] if ago >= 0 else np.zeros(nu)
            start = np.append(x, acting)

            def density(t, start=start):
                at = (expm(block * t) @ start)[:nx]
                return at @ Q @ at

            total += quad_vec(density, 0.0, end - begin, epsrel=1e-12)[0]
            x = (expm(block * (end - begin)) @ start)[:nx]
    return total, x


def test_the_sampled_cost_is_the_integral_of_the_cost():
    _, lin = satellite()
    h, delay = 0.2, 0.27
    rng = np.random.default_rng(2)
    Q = np.diag(rng.uniform(0.5, 2.0, 12))
    R = np.diag(rng.uniform(0.5, 2.0, 3))
    late = lin.discretize(h, delay)
    cost = fflin.sampled_cost(lin, h, Q, R, delay=delay)
    commands = rng.normal(size=(5, 3))
    x = 0.1 * rng.normal(size=12)
    expected, end = optimal_cost(lin, h, delay, Q, R, commands, x)
    z = np.append(x, np.zeros(6))
    total = 0.0
    for u in commands:
        total += z @ cost.Q @ z + 2 * z @ cost.N @ u + u @ cost.R @ u
        z = late.A @ z + late.B @ u
    assert z[:12] == pytest.approx(end, abs=1e-12)
    assert total == pytest.approx(expected, rel=1e-9)


def test_default_weights_are_those_of_the_continuous_cost():
    _, lin = satellite()
    late = lin.discretize(0.1, 0.17)
    gain = fflin.lqr(late)
    assert gain.residual < 1e-12 and np.abs(gain.poles).max() < 1.0
    assert gain.regulated[-1] == "past_2.tau_b.z"
    assert fflin.lqr(late, weights="identity").residual < 1e-12
    held = gain.Q[np.ix_(range(12), range(12))]
    assert np.linalg.eigvalsh(held).min() > -1e-12 * np.abs(held).max()


def test_a_long_delay_lowers_the_default_bandwidth():
    """The loop keeps the margins that it has without a delay."""
    _, lin = satellite()
    slow, fast = (fflin.lqr(lin.discretize(0.5, delay)) for delay in (2.0, 0.0))
    assert np.abs(slow.poles).max() > np.abs(fast.poles).max()
    assert slow.margins.disk > 0.9 * fast.margins.disk


def test_weights_name_the_states_of_the_robot():
    _, lin = satellite()
    late = lin.discretize(0.1, 0.17)
    named = fflin.lqr(late, {"q_b": 4.0, "omega_b": 1.0}, 1.0)
    assert not named.Q[12:].any() and not named.Q[:, 12:].any()
    diagonal = np.r_[np.full(3, 4.0), np.zeros(3), np.ones(3), np.zeros(3)]
    for Q in (diagonal, np.diag(diagonal), np.append(diagonal, np.zeros(6))):
        assert fflin.lqr(late, Q, 1.0).K == pytest.approx(named.K)
    with pytest.raises(fflin.InputError, match="past_2"):
        fflin.bryson(late, {"past_2.tau_b.x": 1.0, "tau_b": 1.0})
    with pytest.raises(fflin.UnknownNameError, match="past"):
        fflin.lqr(late, {"past_9.tau_b.x": 1.0}, 1.0)


def test_the_optimal_gain_predicts_the_state():
    """With a whole number of samples, the gain is that of the undelayed model, times the state
    that the commands on their way will bring; see Alevisakis and Seborg, 1973."""
    _, lin = satellite()
    h, samples = 0.2, 3
    plain = lin.discretize(h)
    late = lin.discretize(h, samples * h)
    Q = np.diag([1.0] * 3 + [0.0] * 3 + [1.0] * 3 + [0.0] * 3)
    gain, of_late = fflin.lqr(plain, Q, 1.0), fflin.lqr(late, Q, 1.0)
    power = np.linalg.matrix_power
    assert of_late.K[:, :12] == pytest.approx(
        gain.K @ power(plain.A, samples), abs=1e-9
    )
    for k in range(1, samples + 1):
        at = [late.state_names.index(f"past_{k}.tau_b.{axis}") for axis in "xyz"]
        expected = gain.K @ power(plain.A, k - 1) @ plain.B
        assert of_late.K[:, at] == pytest.approx(expected, abs=1e-9)


@pytest.mark.exhaustive
@pytest.mark.parametrize("delay", [0.0, *DELAYS])
def test_the_loop_is_that_of_the_margins(delay):
    """Poles and disk margin equal those of the continuous plant with exact delays."""
    _, lin = satellite()
    late = lin.discretize(0.1, delay)
    gain = fflin.lqr(late)
    loop = ClosedLoop(laws_in_loop(gain, lin, None), lin, 0.0, None, "inputs")
    plant = loop.with_delays(np.full(3, delay))
    poles = np.linalg.eigvals(loop.closed(plant)[0])
    lasting = gain.poles[np.abs(gain.poles) > 0.05]
    apart = np.abs(lasting[:, None] - poles).min(axis=1)
    assert apart.max() < 1e-8
    for model, given in ((late, 0.0), (lin, delay)):
        margins = fflin.margins(gain, model, delay=given)
        assert margins.stable
        assert margins.delay == pytest.approx(delay)
        assert margins.channels[0].name == "tau_b.x"


def single_axis():
    """Return the model of a rotation about one axis."""
    robot = fflin.load("cubesat", inputs=[fflin.ReactionWheel((0, 0, 1), name="w")])
    return fflin.momentum_reduction(fflin.linearize(robot))


@pytest.mark.parametrize("delay", DELAYS)
def test_the_disk_margin_of_one_channel_is_that_of_the_gain(delay):
    """`Gain.margins` follows from A - B K, `margins` from the continuous plant."""
    lin = single_axis()
    late = lin.discretize(0.2, delay)
    gain = fflin.lqr(late, {"q_b": 1.0, "omega_b": 0.1}, 10.0)
    margins = fflin.margins(gain, late)
    # Both peaks are accurate to 1e-5.
    assert margins.disk == pytest.approx(gain.margins.disk, rel=2e-5)
    assert fflin.margins(gain, lin, delay).disk == pytest.approx(margins.disk, rel=2e-5)


def test_a_delay_beyond_the_delay_margin_makes_the_loop_unstable():
    lin = single_axis()
    late = lin.discretize(0.2, 0.33)
    gain = fflin.lqr(late, {"q_b": 1.0, "omega_b": 0.1}, 10.0)
    margin = fflin.margins(gain, late).channels[0].delay

    def radius(delay):
        loop = ClosedLoop(laws_in_loop(gain, lin, None), lin, delay, None, "inputs")
        F = loop.closed(loop.with_delays(np.full(1, delay)))[0]
        return np.abs(np.linalg.eigvals(F)).max()

    assert radius(0.33 + margin * (1.0 - 1e-4)) < 1.0
    assert radius(0.33 + margin * (1.0 + 1e-4)) > 1.0


def test_filters_know_the_commands_on_their_way():
    _, lin = satellite()
    late = lin.discretize(0.1, 0.17)
    noise = {"omega_b": 1e-6, "v_b": 1e-6}
    filter_ = fflin.kalman(late, noise, 1e-4)
    plain = fflin.kalman(late.undelayed, noise, 1e-4)
    assert filter_.P[:12, :12] == pytest.approx(plain.P, rel=1e-8, abs=1e-14)
    assert np.abs(filter_.P[12:]).max() < 1e-15
    assert np.abs(filter_.L[12:]).max() < 1e-12
    assert filter_.L[:12] == pytest.approx(plain.L, rel=1e-7, abs=1e-12)
    through = fflin.kalman(late, {"tau_b": 1e-6}, 1e-4, G=late.B)
    assert not through.W[12:].any()
    B = late.undelayed.B
    assert through.W[:12, :12] == pytest.approx(1e-6 * B @ B.T)
    same = fflin.kalman(late, {"tau_b": 1e-6}, 1e-4, G=B)
    assert (same.W == through.W).all()


def test_a_compensator_of_a_delayed_model_has_the_poles_of_gain_and_filter():
    _, lin = satellite()
    late = lin.discretize(0.1, 0.17)
    gain = fflin.lqr(late)
    noise = {"omega_b": 1e-6, "v_b": 1e-6}
    compensator = fflin.lqg(gain, fflin.kalman(late, noise, 1e-4))
    n = len(compensator.A)
    at = [late.state_names.index(name) for name in compensator.state_names]
    seen = [i for i, name in enumerate(compensator.input_names)]
    A = late.A[np.ix_(at, at)]
    B, C = late.B[at], late.C[np.ix_(seen, at)]
    loop = np.block([[A, B @ compensator.C], [compensator.B @ C, compensator.A]])
    assert loop.shape == (2 * n, 2 * n)
    poles = np.linalg.eigvals(loop)
    for pole in compensator.poles[np.abs(compensator.poles) > 0.1]:
        assert np.abs(poles - pole).min() < 1e-6


def test_analyses_of_a_delayed_model():
    _, lin = satellite()
    late, plain = lin.discretize(0.1, 0.17), lin.discretize(0.1)
    for analysis in (fflin.controllability, fflin.observability):
        assert analysis(late).dimension == analysis(plain).dimension
    for function in (fflin.momentum_reduction, fflin.modes):
        with pytest.raises(
            fflin.InputError, match=r"past_1\.tau_b\.x, .* lin\.undelayed"
        ):
            function(late)
    with pytest.raises(fflin.InputError, match=r"lin\.undelayed"):
        late.to("drake")
    robot, gain = satellite()[0], fflin.lqr(late)
    with pytest.raises(fflin.InputError, match=r"lin\.undelayed"):
        fflin.validity(robot, late, gain)


def test_a_mode_that_no_input_stabilises_is_named_as_without_a_delay():
    robot = fflin.load("cubesat", inputs=[fflin.BaseForce()])
    lin = fflin.linearize(robot)
    with pytest.raises(fflin.StabilizabilityError, match="angular momentum"):
        fflin.lqr(lin.discretize(0.1, 0.17), 1.0, 1.0)


def test_reduced_models_are_sampled_with_a_delay():
    motors = [fflin.JointTorque(f"joint_{i}") for i in (1, 2, 3)]
    arm = fflin.load("planar_detumble", inputs=motors)
    reduced = fflin.momentum_reduction(fflin.linearize(arm)).discretize(0.1, 0.15)
    assert reduced.T.shape == (24, 12)
    assert reduced.S @ reduced.T == pytest.approx(np.eye(12))
    whole = fflin.linearize(arm).discretize(0.1, 0.15)
    assert reduced.A == pytest.approx(reduced.S @ whole.A @ reduced.T, abs=1e-12)
    assert fflin.lqr(reduced, 1.0, 1.0).residual < 1e-12


def test_wheels_are_left_out_of_delayed_designs():
    wheels = [
        fflin.ReactionWheel(axis, inertia=0.001, name=f"w{k}")
        for k, axis in enumerate(np.eye(3))
    ]
    _, lin = satellite(wheels)
    late, plain = lin.discretize(0.1, 0.17), lin.discretize(0.1)
    gain, of_plain = fflin.lqr(late), fflin.lqr(plain)
    assert gain.regulated == (*of_plain.regulated, *late.added)
    kept = [late.state_names.index(name) for name in gain.regulated]
    left = np.setdiff1d(np.arange(len(late.A)), kept)
    assert not gain.K[:, left].any()
    assert gain.K.shape == (3, len(late.A))


def test_files_of_earlier_versions_have_no_delay(arm, tmp_path):
    path = tmp_path / "m.json"
    arm.discretize(0.1).save(path)
    entries = json.loads(path.read_text())
    for key in ("added", "delay", "sha256"):
        del entries[key]
    path.write_text(json.dumps(entries))
    read = fflin.LinearModel.load(path)
    assert read.added == () and not read.delay.any()
    assert read.undelayed is read
