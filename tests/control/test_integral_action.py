"""Regulators with integral action: the design, constant disturbances, anti-windup, files."""

from dataclasses import replace
from itertools import product

import control
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are, solve_discrete_are

import fflin
from tests.support.marks import exhaustive
from tests.support.motions import displaced

TORQUE = 2e-5  # [N m], such as of solar pressure


@pytest.fixture(scope="module")
def arm():
    robot = fflin.load("planar_detumble")
    return robot, fflin.linearize(robot)


@pytest.fixture(scope="module")
def body():
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    return robot, fflin.linearize(robot)


@pytest.fixture(scope="module")
def satellite():
    """A satellite with wheels, and its model with a torque on the base as a further input."""
    wheels = [
        item
        for item in fflin.load_inputs("cubesat")
        if isinstance(item, fflin.ReactionWheel)
    ]
    robot = fflin.load("cubesat", inputs=wheels)
    pushed = fflin.linearize(robot.replace(inputs=[fflin.BaseTorque(), *wheels]))
    return robot, fflin.linearize(robot), pushed


def riccati(gain, A, B):
    """Return K of SciPy for the weights of a gain and a model made by hand."""
    Q, R, N = gain.Q, gain.R, gain.N
    if gain.dt:
        P = solve_discrete_are(A, B, Q, R, s=N)
        return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + N.T)
    P = solve_continuous_are(A, B, Q, R, s=N)
    return np.linalg.solve(R, B.T @ P + N.T)


@pytest.mark.parametrize("dt", [0.0, 0.1])
@pytest.mark.parametrize(
    "signals", [["q_b"], {"q_b": 1e-3, "q_m": 1e-2}, ["q_m", "r_b.x"]]
)
def test_the_gain_solves_the_riccati_equation_of_the_extended_model(arm, dt, signals):
    _, lin = arm
    lin = lin.discretize(dt) if dt else lin
    gain = fflin.lqr(lin, integral_action=signals)
    names = [name.removeprefix("integral.") for name in gain.integrals]
    H = np.eye(len(lin.A))[[lin.state_names.index(name) for name in names]]
    k = len(H)
    none = np.zeros((len(lin.A), k))
    lower = np.hstack((dt * H, np.eye(k))) if dt else np.hstack((H, np.zeros((k, k))))
    A = np.vstack((np.hstack((lin.A, none)), lower))
    B = np.vstack((lin.B, np.zeros((k, lin.B.shape[1]))))
    expected = riccati(gain, A, B)
    assert np.abs(gain.K - expected).max() < 1e-8 * np.abs(expected).max()
    assert np.array_equal(gain.H, H)
    poles = np.linalg.eigvals(A - B @ expected)
    assert np.abs(np.sort_complex(poles) - np.sort_complex(gain.poles)).max() < 1e-5
    assert gain.residual < 1e-10


def test_a_chain_of_three_integrators_gets_the_triple_pole_of_its_closed_form(body):
    _, lin = body
    m = lin.M[3, 3]
    Q = {"r_b": 3.0, "v_b": 3.0, "q_b": 1.0, "omega_b": 1.0}
    gain = fflin.lqr(lin, Q, {"F_b": m**-2, "tau_b": 1.0}, integral_action={"r_b": 1.0})
    # (s + 1)^3 = s^3 + a s^2 + b s + c has c^2 = 1, b^2 - 2 a c = 3 and a^2 - 2 b = 3
    force = gain.K[3:]
    assert np.abs(force[:, 3:6] - 3.0 * m * np.eye(3)).max() < 1e-6 * m
    assert np.abs(force[:, 9:12] - 3.0 * m * np.eye(3)).max() < 1e-6 * m
    assert np.abs(gain.K_i[3:] - m * np.eye(3)).max() < 1e-6 * m
    assert np.sum(np.abs(gain.poles + 1.0) < 1e-3) == 9


def test_python_control_gives_the_same_gain(arm):
    _, lin = arm
    H = np.eye(3, len(lin.A))
    gain = fflin.lqr(lin, 1.0, 1.0, integral_action={"q_b": 0.1})
    Q = np.diag([1.0] * len(lin.A) + [0.1] * 3)
    expected, *_ = control.lqr(lin.A, lin.B, Q, np.eye(9), integral_action=H)
    assert np.abs(gain.K - expected).max() < 1e-7
    same = fflin.lqr(
        lin, 1.0, 1.0, integral_action={f"q_b.{axis}": 0.1 for axis in "xyz"}
    )
    assert np.array_equal(same.K, gain.K)
    matrix = fflin.lqr(lin, integral_action=H)
    named = fflin.lqr(lin, integral_action="q_b")
    assert np.array_equal(matrix.K, named.K)
    assert matrix.integrals == ("integral.y_1", "integral.y_2", "integral.y_3")


@pytest.mark.parametrize("dt", [0.0, 0.2])
def test_by_default_the_integrals_are_slower_than_the_loop(arm, dt):
    _, lin = arm
    lin = lin.discretize(dt) if dt else lin
    without = fflin.lqr(lin)
    gain = fflin.lqr(lin, integral_action=["q_b", "q_m"])
    rates = lambda design: np.log(design.poles) / dt if dt else design.poles  # noqa: E731
    slow = np.sort(np.abs(rates(gain)))[:6]
    assert slow.max() < 0.5 * np.abs(rates(without)).min()
    assert slow.min() > 0.1 * np.abs(rates(without)).min()
    assert np.abs(gain.integral_rates).max() < 0.5 * np.abs(rates(without)).min()
    assert "integrals of q_b.x" in str(gain)


def test_the_default_weight_gives_a_slow_integral_its_rate():
    # A fast loop is a static gain for its integrals: xi' = G v with the cost v' R v.
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    lin = fflin.linearize(robot)
    slow = 1e-4 * fflin.lqr(lin, integral_action=["q_b"]).Q[12:, 12:]
    fast = fflin.lqr(lin)
    k = 3
    H = np.eye(k, 12)
    A = np.block([[lin.A, np.zeros((12, k))], [H, np.zeros((k, k))]])
    B = np.vstack((lin.B, np.zeros((k, 6))))
    Q = np.block([[fast.Q, np.zeros((12, k))], [np.zeros((k, 12)), slow]])
    P = solve_continuous_are(A, B, Q, fast.R)
    poles = np.linalg.eigvals(A - B @ np.linalg.solve(fast.R, B.T @ P))
    least = np.sort(np.abs(poles))[:3]
    # the time constant of the loop (0.2 rad/s, damping 0.7) is 1.4 / 0.2 s
    expected = 1e-2 / (3.0 * np.sqrt(2.0) / 0.2)
    assert np.abs(least / expected - 1.0).max() < 0.01


def steady(law, pushed, seconds):
    """Return the state of the linear loop under a torque on the base, after some seconds."""
    dt = law.sample_time
    held = pushed.discretize(dt)
    loop, _ = law.closed_loop()
    force = np.zeros(len(loop))
    force[: len(held.A)] = held.B[:, 0] * TORQUE
    x = np.zeros(len(loop))
    for _ in range(int(seconds / dt)):
        x = loop @ x + force
    return x


def test_a_constant_torque_leaves_no_error(satellite):
    robot, lin, pushed = satellite
    sampled = lin.discretize(0.25)
    errors = {}
    for action in (None, ["q_b"]):
        gain = fflin.lqr(sampled, integral_action=action)
        law = fflin.StateFeedback(sampled, gain)
        x = steady(law, pushed, 600.0)
        motion = fflin.simulate(
            robot,
            law,
            duration=300.0,
            dt=0.25,
            every=1200,
            disturbance={"tau_b": (TORQUE, 0.0, 0.0)},
        )
        turned = 2.0 * np.degrees(np.abs(motion.x[-1, :3]).max())
        errors[action is None] = 2.0 * np.degrees(np.abs(x[:3]).max()), turned
    assert min(errors[True]) > 0.5
    assert errors[False][0] < 1e-5
    assert errors[False][1] < 1e-3


@exhaustive
def test_with_anti_windup_the_overshoot_is_smaller_and_the_integral_returns(body):
    robot, lin = body
    gain = fflin.lqr(lin, integral_action=["q_b", "r_b"])
    law = fflin.StateFeedback(lin, gain)
    bare = fflin.StateFeedback(lin, gain)
    bare.windup = np.zeros((0, 0))
    x0 = np.zeros(12)
    x0[0] = np.sin(np.radians(60.0))
    limits = {"tau_b": 0.3 * np.abs(gain.K[:3] @ np.append(x0, np.zeros(6))).max()}
    run = {"x0": x0, "duration": 400.0, "dt": 0.1, "limits": limits, "linear": False}
    with_it, without = (fflin.simulate(robot, one, **run) for one in (law, bare))
    overshoot = -with_it.x[:, 0].min(), -without.x[:, 0].min()
    assert overshoot[0] < 0.5 * overshoot[1]
    assert overshoot[1] > 0.1
    assert np.abs(with_it.x[-1, :3]).max() < 1e-3
    # the integral acts on the inputs at the end, where all errors are gone
    assert np.abs(with_it.u[-1]).max() < 1e-3 * limits["tau_b"]


def test_a_combination_that_constant_inputs_cannot_change_is_named(arm):
    _, lin = arm
    H = np.zeros((2, len(lin.A)))
    H[0, 0], H[1, 0] = 1.0, -2.0
    with pytest.raises(fflin.StabilizabilityError, match=r"\+1 y_1 \+0.5 y_2"):
        fflin.lqr(lin, integral_action=H)
    with pytest.raises(fflin.StabilizabilityError, match=r"omega_b\.x"):
        fflin.lqr(lin, integral_action=["omega_b.x"])


def test_signals_that_are_not_regulated_are_refused(satellite):
    _, lin, _ = satellite
    with pytest.raises(fflin.StabilizabilityError, match=r"r_b\.x"):
        fflin.lqr(lin, integral_action=["r_b"])


@pytest.mark.parametrize(
    ("given", "kind"),
    [
        (["q_c"], fflin.UnknownNameError),
        ({"q_b": -1.0}, fflin.InputError),
        (np.eye(2), fflin.InputError),
    ],
)
def test_wrong_signals_are_refused(arm, given, kind):
    with pytest.raises(kind):
        fflin.lqr(arm[1], integral_action=given)


def test_outputs_can_be_integrated():
    robot = fflin.load(
        "planar_detumble",
        outputs=[fflin.BasePose(), fflin.JointPositions(), fflin.Accelerometer("base")],
    )
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin, integral_action=[lin.output_names[0]])
    assert np.abs(gain.H - lin.C[:1]).max() < 1e-15
    name = next(x for x, row in zip(lin.output_names, lin.D, strict=True) if row.any())
    with pytest.raises(fflin.InputError):
        fflin.lqr(lin, integral_action=[name])


def test_the_matrix_of_a_gain_with_integrals_is_not_taken_for_a_gain_of_states(arm):
    _, lin = arm
    gain = fflin.lqr(lin, integral_action=["q_b"])
    with pytest.raises(fflin.InputError, match="integral action"):
        fflin.StateFeedback(lin, gain.K)


def test_a_gain_returns_from_its_file(arm, tmp_path):
    robot, lin = arm
    gain = fflin.lqr(lin, integral_action=["q_b"])
    for ending in (".npz", ".mat", ".json"):
        gain.save(tmp_path / f"gain{ending}")
        same = fflin.Gain.load(tmp_path / f"gain{ending}")
        assert same.integrals == gain.integrals
        assert np.array_equal(same.K, gain.K)
        assert np.array_equal(same.anti_windup, gain.anti_windup)
        fflin.simulate(robot, fflin.StateFeedback(lin, same), duration=0.1)
    plain = fflin.lqr(lin)
    for ending in (".npz", ".mat", ".json"):
        plain.save(tmp_path / f"plain{ending}")
        assert fflin.Gain.load(tmp_path / f"plain{ending}").integrals == ()


def test_weights_of_the_robot_name_the_integrated_signals(arm):
    robot, lin = arm
    expected = fflin.lqr(lin, integral_action=["q_b"])
    weighed = fflin.linearize(robot.replace(weights={"integral": ["q_b"]}))
    assert np.array_equal(fflin.lqr(weighed).K, expected.K)
    assert np.array_equal(fflin.lqr(lin, weights={"integral": ["q_b"]}).K, expected.K)
    assert not fflin.lqr(weighed, 1.0, 1.0).integrals
    given = fflin.lqr(lin, integral_action={"q_b": 1e-3})
    weighed = fflin.linearize(robot.replace(weights={"integral": {"q_b": 1e-3}}))
    assert np.array_equal(fflin.lqr(weighed).K, given.K)
    for wrong in ({"integral": 3.0}, {"integral": {"q_b": -1.0}}):
        with pytest.raises(fflin.InputError):
            robot.replace(weights=wrong)


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_margins_and_control_have_the_loop_with_integrals(arm, dt):
    _, lin = arm
    lin = lin.discretize(dt) if dt else lin
    gain = fflin.lqr(lin, integral_action=["q_b"])
    law = fflin.StateFeedback(lin, gain)
    one, other = fflin.margins(law, lin), fflin.margins(gain, lin)
    assert one.disk == other.disk
    without = fflin.margins(fflin.StateFeedback(lin, gain.K_x), lin)
    assert abs(without.channels[0].phase - one.channels[0].phase) > 1.0
    system = gain.to_control()
    loop = control.feedback(
        control.ss(lin.A, lin.B, np.eye(len(lin.A)), 0, dt), system, 1
    )
    poles = np.sort_complex(np.linalg.eigvals(loop.A))
    expected = np.sort_complex(np.linalg.eigvals(law.closed_loop()[0]))
    assert np.abs(poles - expected).max() < 1e-5


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("dt", "limits"), [*product([0.0, 0.1], [None, {"tau_b": 0.2}])]
)
def test_both_engines_fly_the_integrals(arm, dt, limits):
    pytest.importorskip("numba")
    robot, lin = arm
    lin = lin.discretize(dt) if dt else lin
    law = fflin.StateFeedback(lin, fflin.lqr(lin, integral_action=["q_b"]))
    x0 = displaced(lin, degrees=30.0)
    one, other = (
        fflin.simulate(
            robot, law, x0=x0, duration=10.0, dt=0.02, limits=limits, engine=engine
        )
        for engine in ("python", "compiled")
    )
    assert np.abs(one.x - other.x).max() < 1e-12
    assert np.abs(one.u - other.u).max() < 1e-12


def compensated(robot, lin, dt, action):
    """Return the output feedback of a satellite with wheels, star tracker and gyroscope."""
    seen = robot.replace(outputs=[fflin.BasePose(), fflin.Gyroscope("base")])
    held = fflin.linearize(seen).discretize(dt)
    gain = fflin.lqr(held, integral_action=action)
    estimator = fflin.kalman(held, 1e-6, 1e-6)
    return seen, held, gain, fflin.lqg(gain, estimator)


@exhaustive
def test_output_feedback_integrates_the_measured_outputs(satellite):
    robot, _, _ = satellite
    seen, held, gain, compensator = compensated(robot, None, 0.25, ["q_b"])
    law = fflin.OutputFeedback(held, compensator)
    assert compensator.state_names[-3:] == gain.integrals
    # separation: the poles of the loop are those of the regulator and of the filter
    loop = law.loop
    regulated = [i for i, x in enumerate(held.state_names) if x in gain.regulated]
    kept = [*regulated, *range(len(held.A), len(loop))]
    poles = np.linalg.eigvals(loop[np.ix_(kept, kept)])
    for pole in compensator.poles:
        assert np.abs(poles - pole).min() < 1e-4
    finals = []
    for action in (["q_b"], None):
        seen, held, _, compensator = compensated(robot, None, 0.25, action)
        law = fflin.OutputFeedback(held, compensator)
        motion = fflin.simulate(
            seen,
            law,
            duration=400.0,
            dt=0.25,
            every=1600,
            disturbance={"tau_b": (TORQUE, 0.0, 0.0)},
        )
        finals.append(2.0 * np.degrees(np.abs(motion.x[-1, :3]).max()))
    assert finals[0] < 1e-3
    assert finals[1] > 0.1


def test_the_filter_of_an_integrating_law_uses_the_limited_inputs(satellite):
    robot, _, _ = satellite
    _, held, gain, compensator = compensated(robot, None, 0.25, ["q_b"])
    size = len(compensator.A) - 3
    kept = [held.state_names.index(name) for name in compensator.state_names[:size]]
    assert np.abs(compensator.E[:size] - held.B[kept]).max() < 1e-12
    assert np.array_equal(compensator.E[size:], gain.anti_windup)
    # with E, the next estimate is the prediction of the model with the applied inputs
    random = np.random.default_rng(3)
    z, applied = random.normal(size=len(compensator.A)), random.normal(size=3)
    commanded = compensator.C @ z
    e = fflin.kalman(held, 1e-6, 1e-6)
    x = np.zeros(len(held.A))
    x[kept] = z[:size]
    expected = held.A @ x + held.B @ applied - e.L @ (held.C @ x)
    result = compensator.A @ z + compensator.E @ (applied - commanded)
    assert np.abs(result[:size] - expected[kept]).max() < 1e-9
    outputs = random.normal(size=len(held.C))
    q_b = [held.output_names.index(f"q_b.{axis}") for axis in "xyz"]
    assert np.abs(compensator.B[size:] @ outputs - 0.25 * outputs[q_b]).max() < 1e-12


def test_an_integrated_signal_must_be_measured(satellite):
    robot, _, _ = satellite
    gyro = robot.replace(outputs=[fflin.Gyroscope("base"), fflin.FullState()])
    held = fflin.linearize(gyro).discretize(0.25)
    gain = fflin.lqr(held, integral_action=["q_b"])
    estimator = fflin.kalman(held, 1e-6, 1e-6)
    fflin.lqg(gain, estimator)
    blind = fflin.linearize(
        robot.replace(outputs=[fflin.Gyroscope("base"), fflin.JointVelocities()])
    )
    with pytest.raises(fflin.InputError, match="do not measure"):
        unmeasured(gain, estimator, blind.discretize(0.25))


def unmeasured(gain, estimator, held):
    """Design a compensator with an estimator whose outputs do not contain the attitude."""
    rows = {"C": held.C, "D": held.D, "y0": held.y0, "output_names": held.output_names}
    shapes = {name: np.zeros((len(held.A), len(held.y0))) for name in ("L", "L_update")}
    V = np.eye(len(held.y0))
    return fflin.lqg(gain, replace(estimator, **rows, **shapes, V=V))


@exhaustive
def test_validity_flies_the_integrals_and_predicts_them(arm):
    robot, lin = arm
    gain = fflin.lqr(lin, integral_action=["q_b"])
    result = fflin.validity(robot, lin, gain, samples=4, seed=1)
    # the error of the right prediction is of second order, that of a wrong one of first order
    power = float(
        " ".join(str(result).split()).partition("to the power ")[2].split()[0]
    )
    assert 1.9 < power < 2.1


@pytest.mark.exhaustive
def test_uncertain_loops_contain_the_integrals(arm):
    robot, lin = arm
    gain = fflin.lqr(lin, integral_action=["q_b"])
    model = fflin.uncertain(robot, {"base.density": 0.2})
    with_it, without = (model.worst(one, samples=5) for one in (gain, fflin.lqr(lin)))
    assert with_it.margin.value < without.margin.value
    density = with_it.margin.parameters["base.density"]
    lft = model.lft()
    A, B, _, _ = lft.at({"base.density": density})
    size = len(A)
    extended = gain.A.copy(), gain.B.copy()
    extended[0][:size, :size], extended[1][:size] = A, B
    worst = replace(gain, A=extended[0], B=extended[1])
    assert abs(worst.margins.disk - with_it.margin.value) < 1e-6


def test_derivatives_of_poles_contain_the_integrals(arm):
    _, lin = arm
    gain = fflin.lqr(lin, integral_action=["q_b", "r_b", "q_m"])
    sensitivity = fflin.sensitivity(lin)
    poles, derivatives = sensitivity.poles(gain)
    expected = np.sort_complex(gain.poles)
    assert np.abs(np.sort_complex(poles) - expected).max() < 1e-6
    assert derivatives.shape[1] == len(gain.A)


def test_a_robot_file_names_the_integrated_signals(tmp_path):
    file = tmp_path / "arm.toml"
    for text, expected in (
        ('integral = ["q_b"]', ["q_b"]),
        ("integral = {q_b = 1e-3}", {"q_b": 1e-3}),
    ):
        file.write_text(f'urdf = "planar_detumble"\n[weights]\n{text}\n')
        lin = fflin.linearize(fflin.load(file))
        given = fflin.lqr(
            fflin.linearize(fflin.load("planar_detumble")), integral_action=expected
        )
        assert np.array_equal(fflin.lqr(lin).K, given.K)


@exhaustive
def test_an_allocated_satellite_returns_from_a_constant_torque():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    wheels = [x for x in robot.inputs if isinstance(x, fflin.ReactionWheel)]
    design = robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce(), *wheels])
    lin = fflin.linearize(design).discretize(0.25)
    run = {"duration": 200.0, "dt": 0.25, "every": 800, "linear": False}
    pushed = {"disturbance": {"tau_b": (TORQUE, 0.0, 0.0)}}
    finals = []
    for action in (["q_b"], None):
        law = fflin.StateFeedback(lin, fflin.lqr(lin, integral_action=action))
        motion = fflin.simulate(robot, fflin.Allocation(law, design), **run, **pushed)
        finals.append(2.0 * np.degrees(np.abs(motion.x[-1, :3]).max()))
    assert finals[0] < 1e-2 * finals[1]


@pytest.mark.compiled
@pytest.mark.parametrize("limits", [None, {"tau_b": 0.05}])
def test_campaigns_of_both_engines_agree(arm, limits):
    pytest.importorskip("numba")
    robot, lin = arm
    lin = lin.discretize(0.1)
    law = fflin.StateFeedback(lin, fflin.lqr(lin, integral_action=["q_b"]))
    spread = {
        "q_b": 0.05,
        "base.density": 0.1,
        "q_b.sensor": 1e-3,
        "omega_b.noise": 1e-4,
    }
    one, other = (
        fflin.monte_carlo(
            robot,
            law,
            spread,
            runs=9,
            duration=5.0,
            dt=0.02,
            seed=4,
            limits=limits,
            engine=engine,
        )
        for engine in ("python", "compiled")
    )
    for name in ("largest_x", "largest_u"):
        assert np.abs(getattr(one, name) - getattr(other, name)).max() < 1e-12


def test_reports_and_notes_know_the_integrals(arm, satellite):
    _, lin = arm
    gain = fflin.lqr(lin, integral_action=["q_b"])
    law = fflin.StateFeedback(lin, gain)
    assert "integrals=3" in repr(law)
    assert "3 integrals xi" in str(gain)
    assert "integral" in gain._repr_html_()
    assert not law.loop_notes()
    wrong = replace(gain, K=np.hstack((gain.K_x, -gain.K_i)))
    assert "unstable" in fflin.StateFeedback(lin, wrong).loop_notes()[0]
    _, wheels, _ = satellite
    gain = fflin.lqr(wheels, integral_action=["q_b"])
    law = fflin.StateFeedback(wheels, gain)
    assert set(law.fed_back) == {*gain.regulated} - {*gain.integrals}
    assert not law.loop_notes()
    with pytest.raises(fflin.InputError, match="integrals"):
        gain.to("drake")


@pytest.mark.exhaustive
def test_the_worst_loops_of_a_law_with_integrals_are_those_of_its_gain(arm):
    """The integrals are states of the gain's model, or of the law: one loop."""
    robot, lin = arm
    gain = fflin.lqr(lin, integral_action=["q_b"])
    uncertain = fflin.uncertain(robot, {"base.density": 0.2})
    by_gain = uncertain.worst(gain)
    by_law = uncertain.worst(fflin.StateFeedback(lin, gain))
    for name in ("damping", "gain"):
        expected = getattr(by_gain, name).value
        assert getattr(by_law, name).value == pytest.approx(expected, rel=1e-6)
    # The inputs of a law have the best scaling, and those of a gain the scaling by its weights.
    robot = uncertain.at(by_law.margin.parameters)
    expected = fflin.margins(gain, fflin.linearize(robot)).disk
    assert by_law.margin.value == pytest.approx(expected, rel=1e-6)
    assert by_law.margin.value >= by_gain.margin.value * (1.0 - 1e-6)
    compensator = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-3, 1e-4))
    with pytest.raises(fflin.InputError, match="LinearController"):
        uncertain.worst(compensator)


def test_an_empty_list_switches_the_integrals_of_the_robot_off(arm):
    robot = fflin.load("planar_detumble", weights={"integral": ["q_b"]})
    lin = fflin.linearize(robot)
    assert fflin.lqr(lin).integrals
    plain = fflin.lqr(arm[1])
    for given in ({"integral_action": []}, {"weights": {"integral": []}}):
        gain = fflin.lqr(lin, **given)
        assert not gain.integrals and np.array_equal(gain.K, plain.K)
    explicit = fflin.lqr(lin, 1.0, 1.0, integral_action={})
    assert np.array_equal(explicit.K, fflin.lqr(arm[1], 1.0, 1.0).K)


def test_a_quantity_names_its_components_as_in_the_filter():
    outputs = [fflin.FramePose("hand"), fflin.Gyroscope("base")]
    lin = fflin.linearize(fflin.load("planar_detumble", outputs=outputs))
    named = fflin.lqr(lin, integral_action=["rotation"])
    listed = fflin.lqr(lin, integral_action=["*.rotation.*"])
    assert len(named.integrals) == 3 and named.integrals == listed.integrals
    assert np.array_equal(named.K, listed.K)
    weighted = fflin.lqr(lin, integral_action={"rotation": 1e-3})
    assert np.allclose(weighted.Q[-3:, -3:], 1e-3 * np.eye(3))
    # A regulated attitude has no constant rate, so that a rate cannot be integrated.
    with pytest.raises(fflin.StabilizabilityError, match=r"base\.gyroscope"):
        fflin.lqr(lin, integral_action=["gyroscope"])
