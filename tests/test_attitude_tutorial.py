"""The tutorial on attitude control: its length, and its numbers computed by hand."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag, expm, solve_discrete_are, solve_discrete_lyapunov

import fflin

PAGE = Path(__file__).parents[1] / "docs" / "tutorials" / "attitude_control.md"
CELL = re.compile(r"```\{code-cell\}\n(?::[^\n]*\n)*(.*?)```", re.DOTALL)
H = 0.25  # sample time and delay [s]
LATE = 4  # commands on their way


def cells():
    return CELL.findall(PAGE.read_text(encoding="utf-8"))


def test_requirements_to_flight_code_take_24_lines_and_one_robot_file():
    files, *code = cells()
    last = next(k for k, cell in enumerate(code) if "write_c" in cell)
    lines = "".join(code[: last + 1]).splitlines()
    assert len(lines) + files.startswith("import fflin") == 24
    (toml,) = re.findall(r'toml = """(.*?)"""', files, re.DOTALL)
    assert toml.count("\n") <= 25
    commands = re.findall(r"^fflin ", PAGE.read_text("utf-8"), re.MULTILINE)
    assert 0 < len(commands) <= 10


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the cells of the page define up to the law."""
    code = cells()
    last = next(k for k, cell in enumerate(code) if "law = " in cell)
    result = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("satellite"))
        exec("".join(code[: last + 1]), result)
    return result


def by_hand():
    """Return A, B of q_b, modes, omega_b and modal rates, and B of a torque on the base.

    The numbers are those of the two files. The modes are unit masses on springs that push the base
    at its origin, and each wheel turns freely about its axis but for its motor.
    """
    axes = np.array([[1, 0, 1], [-1, 0, 1], [0, 1, 1], [0, -1, 1]]).T / np.sqrt(2.0)
    inertia = np.diag((60.0, 35.0, 70.0)) - 0.02 * axes @ axes.T
    translation = np.array([[0.0, 0.0], [0.0, 0.0], [2.2, 2.2]])
    rotation = np.array([[3.5, -3.5], [0.0, 0.0], [0.0, 0.0]])
    M = np.block(
        [
            [180.0 * np.eye(3), np.zeros((3, 3)), translation],
            [np.zeros((3, 3)), inertia, rotation],
            [translation.T, rotation.T, np.eye(2)],
        ]
    )
    inverse = np.linalg.inv(M)[3:, 3:]  # without the velocity of the base
    w = 2.0 * np.pi * 0.35
    spring = np.zeros((5, 10))
    spring[3:, 3:5] = -(w**2) * np.eye(2)
    spring[3:, 8:] = -2.0 * 0.005 * w * np.eye(2)
    A = np.zeros((10, 10))
    A[:3, 5:8] = 0.5 * np.eye(3)
    A[3:5, 8:] = np.eye(2)
    A[5:] = inverse @ spring
    torque = np.vstack((np.zeros((5, 3)), inverse[:, :3]))
    return A, -torque @ axes, torque


def sampled(A, B):
    """Return the matrices of zero-order hold."""
    n, k = B.shape
    both = np.zeros((n + k, n + k))
    both[:n, :n], both[:n, n:] = A, B
    whole = expm(H * both)
    return whole[:n, :n], whole[:n, n:]


def delayed():
    """Return the sampled model whose inputs act one sample late, as further states."""
    A, B, _ = by_hand()
    Phi, Gamma = sampled(A, B)
    late = np.block([[Phi, Gamma], [np.zeros((LATE, 10)), np.zeros((LATE, LATE))]])
    return late, np.vstack((np.zeros((10, LATE)), np.eye(LATE)))


def walk(A, G, intensity):
    """Return the sampled model of x' = A x + G d with a random walk d, and its covariance."""
    n, k = G.shape
    both = np.zeros((n + k, n + k))
    both[:n, :n], both[:n, n:] = A, G
    noise = np.zeros_like(both)
    noise[n:, n:] = intensity * np.eye(k)
    # The method of Van Loan.
    whole = expm(H * np.block([[-both, noise], [np.zeros_like(both), both.T]]))
    Phi = whole[n + k :, n + k :].T
    return Phi, Phi @ whole[: n + k, n + k :]


def filter_by_hand():
    """Return A, B, C and the gain of the predictor of states, commands, torques and biases."""
    A, _, torque = by_hand()
    Phi, W = walk(A, torque, 1e-10)
    late, push = delayed()
    # order: 10 states, 4 commands, 3 torques, 3 biases
    F = block_diag(late, np.eye(3), np.eye(3))
    F[:10, 14:17] = Phi[:10, 10:]
    G = np.vstack((push, np.zeros((6, LATE))))
    at = [*range(10), 14, 15, 16]
    cov = np.zeros((20, 20))
    cov[np.ix_(at, at)] = W
    cov[5:8, 5:8] += 1e-11 * np.eye(3)
    cov[17:, 17:] = H * np.radians(1.0 / 3600.0) ** 2 / 3600.0 * np.eye(3)
    C = np.zeros((6, 20))
    C[:3, :3] = np.eye(3)
    C[3:, 5:8] = C[3:, 17:] = np.eye(3)
    star = np.radians(10.0 / 3600.0) / 2.0
    gyro = np.radians(0.05) / 60.0 / np.sqrt(H)
    V = np.diag([star**2] * 3 + [gyro**2] * 3)
    P = solve_discrete_are(F.T, C.T, cov, V)
    return F, G, C, F @ P @ C.T @ np.linalg.inv(C @ P @ C.T + V), V


def law_by_hand():
    """Return A, B and C of the compensator u = C z, z' = A z + B y."""
    late, push = delayed()
    Q = np.zeros((14, 14))
    Q[:3, :3] = np.eye(3)
    R = 100.0 * np.eye(LATE)
    P = solve_discrete_are(late, push, Q, R)
    K = np.linalg.solve(R + push.T @ P @ push, push.T @ P @ late)
    F, G, C, L, _ = filter_by_hand()
    # The wheels exert the opposite of the estimated torque: no state is displaced.
    _, B, torque = by_hand()
    cancel = -np.linalg.pinv(B) @ torque
    # The commands on their way are then the cancelling inputs, not zero.
    steady = np.vstack((np.zeros((10, 3)), cancel))
    feedback = np.hstack((-K, K @ steady + cancel, np.zeros((LATE, 3))))
    return K, F + G @ feedback - L @ C, L, feedback


def columns(known, order):
    return [known.index(name) for name in order]


STATES = [
    *(f"q_b.{x}" for x in "xyz"),
    "q_m.left_mode_1",
    "q_m.right_mode_1",
    *(f"omega_b.{x}" for x in "xyz"),
    "qdot_m.left_mode_1",
    "qdot_m.right_mode_1",
    *(f"past_1.wheel_{k}" for k in (1, 2, 3, 4)),
]
ADDED = [
    *(f"disturbance.tau_b.{x}" for x in "xyz"),
    *(f"bias.base.gyroscope.{x}" for x in "xyz"),
]
MEASURED = [*(f"q_b.{x}" for x in "xyz"), *(f"base.gyroscope.{x}" for x in "xyz")]


def test_the_model_is_the_one_computed_by_hand(names):
    lin = names["lin"]
    A, B, _ = by_hand()
    rows = columns(lin.state_names, STATES[:10])
    assert lin.A[np.ix_(rows, rows)] == pytest.approx(A, abs=1e-12)
    assert lin.B[rows] == pytest.approx(B, abs=1e-14)
    late, push = delayed()
    rows = columns(names["model"].state_names, STATES)
    assert names["model"].A[np.ix_(rows, rows)] == pytest.approx(late, abs=1e-12)
    assert names["model"].B[rows] == pytest.approx(push, abs=1e-14)


def test_the_law_is_the_one_computed_by_hand(names):
    K, A, B, C = law_by_hand()
    gain, compensator = names["gain"], names["law"].compensator
    at = columns(gain.model_states, STATES)
    # SciPy's solver is accurate to 1e-9 of the largest entry here.
    assert gain.K_x[:, at] == pytest.approx(K, abs=1e-8 * np.abs(K).max())
    assert np.delete(gain.K_x, at, axis=1) == pytest.approx(0.0, abs=1e-10)
    z = columns(compensator.state_names, STATES + ADDED)
    y = columns(compensator.input_names, MEASURED)
    for result, hand in (
        (compensator.A[np.ix_(z, z)], A),
        (compensator.B[np.ix_(z, y)], B),
        (compensator.C[:, z], C),
    ):
        assert result == pytest.approx(hand, abs=1e-6 * np.abs(hand).max())


def loops_by_hand(frequencies):
    """Return the response of the loop at each wheel, with the loops of the others closed."""
    _, A, B, C = law_by_hand()
    late, push = delayed()
    rows = filter_by_hand()[2][:, :14]
    z = np.exp(1j * frequencies * H)[:, None, None]
    responses = []
    for k in range(LATE):
        others = np.eye(LATE)
        others[k, k] = 0.0
        F = np.block([[late, push @ others @ C], [B @ rows, A]])
        G = np.append(push[:, k], np.zeros(len(A)))
        output = np.append(np.zeros(len(late)), -C[k])  # negative feedback
        responses.append(
            np.linalg.solve(z * np.eye(len(F)) - F, G[:, None])[..., 0] @ output
        )
    return responses


@pytest.mark.exhaustive
def test_disk_margins_are_those_computed_by_hand(names):
    margins = fflin.margins(names["law"], names["lin"])
    # Relative steps of 5e-4 miss at most 1e-6 of the peak at 0.045 and 0.062 rad/s.
    responses = loops_by_hand(np.geomspace(0.03, 0.08, 2000))
    for channel, loop in zip(margins.channels, responses, strict=True):
        S = 1.0 / (1.0 + loop)
        disk = 1.0 / np.abs(S - 0.5).max()  # (S - T)/2 with T = 1 - S
        assert channel.disk == pytest.approx(disk, rel=1e-5)


def test_errors_by_noise_are_those_computed_by_hand(names):
    _, A, B, C = law_by_hand()
    late, push = delayed()
    _, _, measured, _, V = filter_by_hand()
    whole = np.block([[late, push @ C], [B @ measured[:, :14], A]])
    noise = np.vstack((np.zeros((14, 3)), B[:, :3]))
    covariance = solve_discrete_lyapunov(whole, noise @ V[:3, :3] @ noise.T)
    budget = fflin.error_budget(
        names["law"], names["lin"], noise={"q_b": float(np.sqrt(V[0, 0]))}
    )
    for k, axis in enumerate("xyz"):
        sigma = np.degrees(2.0 * np.sqrt(covariance[k, k]))
        result = budget.error(f"attitude.{axis}")["noise of q_b"]
        assert result == pytest.approx(sigma, rel=1e-5)


@pytest.mark.exhaustive
def test_python_control_gives_the_same_gain_and_phase_margins(names):
    control = pytest.importorskip("control")
    margins = fflin.margins(names["law"], names["lin"])
    frequencies = np.geomspace(1e-3, np.pi / H, 3000)
    responses = loops_by_hand(frequencies)
    for channel, loop in zip(margins.channels, responses, strict=True):
        phase = np.degrees(np.unwrap(np.angle(loop)))
        gain, phase, *_ = control.margin(np.abs(loop), phase, frequencies)
        assert channel.gain[1] == pytest.approx(gain, rel=1e-3)
        assert channel.phase == pytest.approx(phase, rel=1e-3)


@pytest.mark.exhaustive
def test_noise_of_modal_rates_makes_a_fast_filter_robust_to_frequencies(names):
    """Check the table of the guide on attitude control."""
    model, gain, noise = names["model"], names["gain"], names["noise"]
    slow = {
        "disturbance_noise": {"tau_b": 1e-10},
        "bias_noise": {"gyroscope": {"bias_instability": 1.0}},
    }
    wings = {"range": 0.1, "tied": True}
    ranges = {"base.density": 0.2, "*_mode_*.frequency": wings}
    family = fflin.uncertain(names["satellite"], ranges).samples(8)
    models = [names["lin"], *map(fflin.linearize, family)]
    modes = {"qdot_m.*_mode_*": 1e-7}
    rows = [{"omega_b": 1e-11}, {"omega_b": 1e-9}, {"omega_b": 1e-9} | modes]
    shown = []
    for W in rows:
        estimator = fflin.kalman(model, W, noise, **slow)
        law = fflin.OutputFeedback(model, fflin.lqg(gain, estimator))
        nominal, *others = (fflin.margins(law, lin).disk for lin in models)
        shown.append(f"| {nominal:.2f} | {min(others):.2f} |")
    assert shown == ["| 0.93 | 0.86 |", "| 0.93 | 0.03 |", "| 1.06 | 1.01 |"]
    guide = (PAGE.parents[1] / "guide" / PAGE.name).read_text("utf-8")
    for W, row in zip(rows, shown, strict=True):
        text = str(W).replace("'", '"').replace("e-09", "e-9").replace("e-07", "e-7")
        assert f"| `{text}` {row}" in guide
