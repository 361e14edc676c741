"""Laws of robots: reports against independent computations, uncertain models, seeds, errors."""

import copy
import sys

import numpy as np
import pytest
import scipy.linalg
from scipy.signal import StateSpace, lsim

import fflin
from fflin.control.margins import disk_margin_of
from tests.support.tuning import of_sweep

ROBOT = {
    "lock": ["joint_*"],
    "inputs": [fflin.BaseTorque()],
    "stiffness": {"panel_*": 100.0},
    "damping": {"panel_*": 1.0},
    "outputs": [fflin.BasePose()],
}
GOALS = [
    fflin.MaxGain({"tau_b": 0.01}, {"q_b": 1e-3}),
    fflin.Margin(0.75, hard=True),
    fflin.Decay(0.0035, hard=True),
    fflin.RollOff({"q_b": 1e-4}, {"tau_b": 1.0}, above=8.0, below=5.0),
    fflin.Variance({"q_b": 1e-5}, {"q_b": 1e-4, "tau_b": 0.5}, hard=True),
]
LAW = fflin.LowPass((1.0, 20.0), order=2) * fflin.PD("q_b", "tau_b", shared=True)


@pytest.fixture(scope="module")
def robot():
    return fflin.load("servicer_7dof", **ROBOT)


@pytest.fixture(scope="module")
def stiff():
    """A satellite without flexible panels, so that its plant has few states."""
    return fflin.load(
        "servicer_7dof",
        lock=["joint_*", "panel_*"],
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose()],
    )


@pytest.fixture(scope="module")
def tuned(stiff):
    goals = [GOALS[0], GOALS[1], GOALS[3]]
    return fflin.tune(fflin.linearize(stiff), LAW, goals, starts=1, steps=20)


def swept(policy, matrices, inputs, outputs, frequencies):
    """Gains of u and y to w: a disturbance at the input, computed without the code of tuning."""
    A, B, C, _ = matrices
    law = policy.system
    loop = np.block([[A + B @ law.D @ C, B @ law.C], [law.B @ C, law.A]])
    drive = np.vstack((B, np.zeros((len(law.A), B.shape[1]))))[:, inputs]
    read = np.hstack((C, np.zeros((len(C), len(law.A)))))[outputs]
    gains = []
    for w in frequencies:
        states = np.linalg.lstsq(1j * w * np.eye(len(loop)) - loop, drive, rcond=None)[
            0
        ]
        gains.append(np.linalg.norm(read @ states, 2))
    return np.array(gains)


def test_the_report_states_the_gain_of_a_sweep_and_the_margin_of_margins(tuned):
    gain, margin, _ = tuned.goals
    lin = tuned.lin
    matrices = lin.A, lin.B, lin.C, lin.D
    gains = swept(tuned, matrices, range(3), range(3), np.geomspace(1e-3, 1e2, 200))
    assert gains.max() * 0.01 / 1e-3 <= gain.worst * (1.0 + 1e-6)
    assert gains.max() * 0.01 / 1e-3 >= gain.worst * 0.98
    assert gain.value == pytest.approx(gain.check, rel=1e-6)
    assert 0.75 / fflin.margins(tuned, lin).disk == pytest.approx(
        margin.check, rel=1e-6
    )
    assert margin.met and "disk margin" in str(tuned)


def test_a_tuned_law_flies_and_is_saved(tuned, stiff, tmp_path):
    q0 = fflin.configuration(stiff, rpy=(5, 0, 0))
    motion = fflin.simulate(stiff, tuned, q0=q0, duration=2.0)
    assert motion.u.shape[1] == 3
    tuned.save(tmp_path / "law.npz")
    again = fflin.LinearController(str(tmp_path / "law.npz"), tuned.lin)
    assert np.array_equal(again.system.A, tuned.system.A)


def test_a_saved_law_is_read_with_its_delay(stiff, tmp_path):
    lin = fflin.linearize(stiff)
    goal = fflin.Margin(0.5)
    late = fflin.tune(lin, LAW, goal, dt=0.2, delay=0.1, starts=1, steps=2)
    path = tmp_path / "law.npz"
    late.save(path)
    policy = fflin.LinearController(path, lin)
    assert policy.dt == 0.2 and policy.input_delays == late.input_delays
    assert set(policy.input_delays.values()) == {0.1}


@pytest.mark.exhaustive
def test_two_runs_with_one_seed_are_equal_bit_for_bit(stiff):
    lin = fflin.linearize(stiff)
    runs = [
        fflin.tune(lin, LAW, GOALS[:2], starts=2, steps=10, seed=7) for _ in range(2)
    ]
    assert runs[0].parameters == runs[1].parameters
    assert np.array_equal(runs[0].history, runs[1].history)


@pytest.mark.exhaustive
def test_a_sampled_law_has_the_margins_of_the_sampled_loop(stiff):
    lin = fflin.linearize(stiff)
    policy = fflin.tune(
        lin, LAW, fflin.Margin(1.0), dt=0.2, delay=0.1, starts=1, steps=20
    )
    assert policy.dt == 0.2
    margin = fflin.margins(policy, policy.lin).disk
    assert 1.0 / margin == pytest.approx(policy.goals[0].check, rel=1e-6)


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt", [None, 0.25])
def test_no_goal_is_met_that_a_sweep_does_not_meet(robot, dt):
    ranges = {"base.density": 0.2, "panel_left.density": 0.2}
    ranges["panel_*.stiffness"] = {"range": 0.2, "tied": True}
    uncertain = fflin.uncertain(robot, ranges)
    policy = fflin.tune(uncertain, LAW, GOALS, dt=dt, delay=0.1 if dt else 0.0)
    assert policy.met and policy.examined >= 209
    lft = uncertain.lft()
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    draws, _ = uncertain.draws(200, seed=99)
    frequencies = np.geomspace(1e-3, 1e2, 2000)
    for deltas in np.vstack((corners, draws)):
        lin = fflin.linearize(uncertain.at(uncertain.values(deltas)))
        if dt is not None:
            lin = lin.discretize(dt, 0.1)
        # The disk margin of an unstable loop is 0.
        assert disk_margin_of(policy, lin) >= 0.75 * (1.0 - 5e-3)
        if dt is not None:
            continue
        gains = of_sweep(policy, lft.at(deltas), frequencies)
        # Random points of another seed than those of the search may be a little worse.
        assert gains[:, 0].max() * 0.01 / 1e-3 <= policy.goals[0].worst * 1.005
        assert policy.goals[0].worst <= 1.0
        assert gains[frequencies >= 8.0, 1].max() * 1e-4 / 5.0 <= 1.0


@pytest.mark.exhaustive
def test_the_gain_grows_with_the_ranges(robot):
    values = []
    for width in (0.05, 0.4):
        uncertain = fflin.uncertain(robot, {"base.density": width})
        policy = fflin.tune(uncertain, LAW, GOALS, starts=1)
        values.append(policy.goals[0].value)
    assert values[1] > values[0]


def test_goals_that_contradict_each_other_are_named(stiff):
    lin = fflin.linearize(stiff)
    goals = [
        fflin.MaxGain({"tau_b": 0.01}, {"q_b": 1e-6}, hard=True),
        fflin.MaxGain({"q_b": 1e-2}, {"tau_b": 0.1}, hard=True),
    ]
    policy = fflin.tune(lin, LAW, goals, starts=1, steps=30)
    assert not policy.met and policy.factor > 1.0
    assert {*policy.conflict} == {goal.label for goal in goals}
    assert "contradict" in str(policy)


def test_a_step_response_follows_its_template(stiff):
    goal = fflin.Track("q_b.x", settling=60.0, within=0.05, overshoot=0.4)
    policy = fflin.tune(
        fflin.linearize(stiff), LAW, [goal, fflin.Margin(0.5)], starts=1, steps=30
    )
    assert policy.goals[0].met
    # The trapezoidal rule of the search is exact to (w h)^2 / 12 for a pole at w, here 0.1 %.
    assert policy.goals[0].value == pytest.approx(policy.goals[0].check, rel=2e-3)


def panels(stiffness, damping):
    """Linear model of the servicer with flexible panels."""
    robot = fflin.load(
        "servicer_7dof",
        lock=["joint_*"],
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose()],
        stiffness={"panel_*": stiffness},
        damping={"panel_*": damping},
    )
    return fflin.linearize(robot)


def step_of(policy, lin, name, duration):
    """Step response of an output to its reference, by SciPy."""
    law, row = policy.system, lin.output_names.index(name)
    loop = np.block(
        [[lin.A + lin.B @ law.D @ lin.C, lin.B @ law.C], [law.B @ lin.C, law.A]]
    )
    drive = -np.vstack((lin.B @ law.D, law.B))[:, [row]]
    read = np.hstack((lin.C[[row]], np.zeros((1, len(law.A)))))
    times = np.linspace(0.0, duration, 20_001)
    system = StateSpace(loop, drive, read, np.zeros((1, 1)))
    return times, lsim(system, np.ones(len(times)), times)[1]


@pytest.mark.exhaustive
@pytest.mark.parametrize(("settling", "hard"), [(9.0, True), (25.0, False)])
def test_a_step_response_equals_an_independent_simulation(settling, hard):
    lin = panels(40.0, 0.3)
    goal = fflin.Track("q_b.y", settling, within=0.02, overshoot=0.3, hard=hard)
    goals = [goal, fflin.Margin(0.6), fflin.MaxGain({"tau_b": 0.01}, {"q_b": 3e-4})]
    policy = fflin.tune(lin, LAW, goals, starts=1, steps=60)
    times, y = step_of(policy, lin, "q_b.y", 3.0 * settling)
    late = np.abs(y[times >= settling] - 1.0).max()
    ratio = max((y.max() - 1.0) / 0.3, late / 0.02)
    # The instants of SciPy lie beside the settling time, by at most 1.5e-4 of it.
    assert policy.goals[0].check == pytest.approx(ratio, rel=1e-3)
    assert not policy.goals[0].met or ratio <= 1.0
    assert policy.met == (policy.factor <= 1.0)


REFUSED = {
    "an unknown signal": (fflin.MaxGain("tau_x", "q_b"), LAW, "tau_x"),
    "noise without a lag": (
        fflin.Variance({"q_b": 1.0}, {"tau_b": 1.0}),
        fflin.PD("q_b", "tau_b"),
        "LowPass",
    ),
    "a filter alone": (fflin.Decay(0.1), fflin.LowPass(), "no signals"),
    "a filter in a sum": (
        fflin.Decay(0.1),
        fflin.LowPass() + fflin.PD("q_b", "tau_b"),
        "sum",
    ),
    "no free parameter": (
        fflin.Decay(0.1),
        fflin.PD("q_b", "tau_b", kp=1.0, kd=1.0, lag=0.1),
        "fixed",
    ),
    "a pole without input": (
        fflin.Decay(0.1),
        fflin.PD("q_b.x", "tau_b.x") * fflin.LowPass(),
        "pole",
    ),
}


@pytest.mark.parametrize("key", REFUSED)
def test_what_cannot_be_tuned_is_refused(key, stiff):
    goal, structure, word = REFUSED[key]
    lin = fflin.linearize(stiff)
    if key == "a pole without input":
        goal = fflin.MaxGain("tau_b", "q_b")
    with pytest.raises(fflin.FflinError, match=word):
        fflin.tune(lin, structure, goal, starts=1, steps=3)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: fflin.MaxGain("u", "y", below=-1.0), "positive"),
        (lambda: fflin.MaxGain("u", "y", below=([1.0], [1.0, 1.0])), "degrees"),
        (lambda: fflin.MaxGain("u", "y", below=([1.0, 0.0], [1.0, 1.0])), "zero"),
        (lambda: fflin.MaxGain("u", "y", band=(2.0, 1.0)), "band"),
        (lambda: fflin.Margin(2.5), "disk"),
        (lambda: fflin.Damping(1.5), "ratio"),
        (lambda: fflin.Track("y", 10.0, duration=5.0), "duration"),
        (lambda: fflin.Track("y", 10.0, within=5), "within is 5.*0.05 is 5 %"),
        (lambda: fflin.Track("y", 10.0, within=1.0), "within is 1"),
        (lambda: fflin.Track("y", 10.0, overshoot=20), "overshoot is 20.*0.05 is 5 %"),
        (lambda: fflin.Variance("u", {"y": 1.0}), "inputs"),
        (lambda: fflin.Tunable(3.0, least=4.0), "value"),
        (lambda: fflin.Tunable(least=4.0, largest=1.0), "bounds"),
        (lambda: fflin.PD("y", "u", ki=1.0), "ki"),
        (lambda: fflin.CustomLaw(lambda k: (), {}, "y", "u"), "parameters"),
    ],
)
def test_goals_and_structures_refuse_what_makes_no_sense(make, word):
    with pytest.raises(fflin.InputError, match=word):
        make()


def norm_of_sweep(policy, points):
    """Largest gain of a loop from (0.01 tau_b, 1e-3 q_b) to (q_b / 0.05, tau_b)."""
    lin, law = policy.lin, policy.system
    A, B, C = lin.A, lin.B, lin.C
    nx, nz, nu, ny = len(A), len(law.A), B.shape[1], 3
    loop = np.block([[A + B @ law.D @ C, B @ law.C], [law.B @ C, law.A]])
    noise = 1e-3 * np.vstack((B @ law.D[:, :ny], law.B[:, :ny]))
    drive = np.hstack((np.vstack((0.01 * B, np.zeros((nz, nu)))), noise))
    read = np.block([[C[:ny] / 0.05, np.zeros((ny, nz))], [law.D @ C, law.C]])
    through = np.zeros((ny + nu, nu + ny))
    through[ny:, nu:] = 1e-3 * law.D[:, :ny]
    largest = 0.0
    for point in points:
        states = np.linalg.solve(point * np.eye(nx + nz) - loop, drive)
        largest = max(largest, np.linalg.norm(read @ states + through, 2))
    return largest


FULL = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})


@pytest.fixture(scope="module")
def optimal(robot):
    """The controller of full order of a satellite with flexible panels."""
    pytest.importorskip("slycot")
    return fflin.hinf(fflin.linearize(robot), FULL, measured="q_b")


def test_the_norm_of_hinf_is_that_of_a_sweep(optimal):
    swept = norm_of_sweep(optimal, 1j * np.geomspace(1e-3, 1e3, 300))
    assert optimal.gamma * 0.99 <= swept <= optimal.gamma * (1.0 + 1e-6)
    poles = np.sort(np.linalg.eigvals(optimal.loop).real)
    # No torque moves the position of the base, whose six poles are at zero.
    assert optimal.order == 10 and poles[-7] < -1e-4
    assert np.abs(poles[-6:]).max() < 1e-6


def test_the_norm_of_a_sampled_design_is_that_of_the_sampled_loop(stiff):
    pytest.importorskip("slycot")
    lin = fflin.linearize(stiff).discretize(0.2)
    policy = fflin.hinf(lin, FULL, measured="q_b")
    angles = np.concatenate((np.geomspace(1e-3, 0.5, 150), np.linspace(0.5, 3.14, 50)))
    swept = norm_of_sweep(policy, np.exp(1j * angles))
    assert policy.dt == 0.2
    assert policy.gamma * 0.99 <= swept <= policy.gamma * (1.0 + 1e-6)


def test_a_reduced_controller_keeps_the_goals_in_a_sweep(optimal):
    reduced = optimal.reduced()
    assert reduced.order < optimal.order and reduced.gamma <= 1.0
    swept = norm_of_sweep(reduced, 1j * np.geomspace(1e-2, 10.0, 3000))
    assert reduced.gamma * 0.99 <= swept <= reduced.gamma * (1.0 + 1e-6)
    poles = np.sort(np.linalg.eigvals(reduced.loop).real)
    assert poles[-7] < -1e-4


def test_a_reduced_controller_may_have_a_given_order_or_norm(optimal):
    near = optimal.reduced(below=1.01 * optimal.gamma)
    assert near.order == 8 and near.gamma <= 1.01 * optimal.gamma
    report = str(near)
    assert f"order 8; the norm of the loop is {near.gamma:.4g}" in report
    assert f"full order 10: the norm is {optimal.gamma:.4g}" in report
    # Two of the ten states do not matter, so the norm of order 8 is that of full order.
    assert optimal.reduced(8).gamma == pytest.approx(optimal.gamma, rel=1e-3)
    with pytest.raises(fflin.InputError, match="order 0"):
        optimal.reduced(0)
    with pytest.raises(fflin.InputError, match="order"):
        optimal.reduced(10)


def test_no_norm_below_that_of_full_order_is_promised(optimal):
    least = rf"{optimal.gamma:.4g}, and no lower order .*; give below=0.0"
    with pytest.raises(fflin.InputError, match=least) as error:
        optimal.reduced(below=0.5 * optimal.gamma)
    proposed = float(str(error.value).split("below=")[1].split()[0])
    assert optimal.gamma <= proposed < 1.001 * optimal.gamma
    assert optimal.reduced(below=proposed).gamma <= proposed


def test_the_norm_is_required_if_goals_do_not_hold_with_all_states(stiff):
    pytest.importorskip("slycot")
    goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 1e-4, "tau_b": 1e-2})
    full = fflin.hinf(fflin.linearize(stiff), goal, measured="q_b")
    assert full.gamma > 1.0
    with pytest.raises(fflin.InputError, match=r"do not hold .*below=") as error:
        full.reduced()
    proposed = float(str(error.value).split("below=")[1])
    assert full.gamma < proposed
    reduced = full.reduced(below=proposed)
    assert reduced.gamma <= proposed and reduced.order <= full.order


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt", [0.0, 0.5])
def test_a_search_begins_at_a_reduced_controller_and_improves_it(robot, dt):
    pytest.importorskip("slycot")
    lin = fflin.linearize(robot)
    model = lin.discretize(dt) if dt else lin
    small = fflin.hinf(model, FULL, measured="q_b").reduced(8)
    law = fflin.StateSpaceLaw(8, "q_b", "tau_b", start=small)
    first = fflin.tune(model, law, FULL, starts=1, steps=1)
    later = fflin.tune(model, law, FULL, starts=1, steps=10)
    assert first.goals[0].worst <= small.gamma * (1.0 + 1e-9)
    assert later.goals[0].worst <= first.goals[0].worst
    for order, signals, word in (
        (6, "q_b", "8 states"),
        (8, "q_b.x", "start measures q_b.y"),
    ):
        with pytest.raises(fflin.InputError, match=word):
            other = fflin.StateSpaceLaw(order, signals, "tau_b", start=small)
            fflin.tune(model, other, FULL, starts=1, steps=1)


def test_states_that_do_not_affect_the_goals_are_not_counted(optimal):
    A, B, C, D = optimal._design.law
    idle = np.zeros((len(A), 2))
    padded = copy.copy(optimal)
    law = (
        np.block([[A, idle], [idle.T, -np.eye(2)]]),
        np.vstack((B, idle.T @ B)),
        np.hstack((C, C @ idle)),
        D,
    )
    padded._design = optimal._design._replace(law=law)
    padded.order = optimal.order + 2
    assert padded.reduced(8).gamma == pytest.approx(optimal.gamma, rel=1e-3)
    with pytest.raises(fflin.InputError, match="states of the controller affect"):
        padded.reduced(optimal.order + 1)


def test_hinf_is_no_worse_than_tune(optimal):
    law = fflin.PD("q_b", "tau_b", shared=True)
    tuned = fflin.tune(optimal.lin, law, FULL, starts=1, steps=15)
    assert optimal.gamma <= 1.01 * tuned.goals[0].value
    assert tuned.goals[0].least == optimal.gamma
    assert f"all linear controllers is {optimal.gamma:.4g}" in " ".join(
        tuned.report().split()
    )


REFUSED_BY_HINF = {
    "a band": (fflin.MaxGain("tau_b", "q_b", band=(1.0, 2.0)), "q_b", "band"),
    "a free command": (fflin.MaxGain(("tau_b", "q_b"), "q_b"), "q_b", "tau_b.x"),
    "an exact measurement": (FULL, "*", "r_b.x"),
}


@pytest.mark.parametrize("key", REFUSED_BY_HINF)
def test_what_hinf_cannot_solve_is_refused(key, stiff):
    goal, measured, word = REFUSED_BY_HINF[key]
    with pytest.raises(fflin.InputError, match=word):
        fflin.hinf(fflin.linearize(stiff), goal, measured=measured)


def test_outputs_that_no_input_moves_are_refused():
    # The torque acts about the centre of mass, which is at the origin of the base.
    robot = fflin.load(
        "cubesat", inputs=[fflin.BaseTorque()], outputs=[fflin.BasePose()]
    )
    with pytest.raises(fflin.InputError, match="move no measured output"):
        fflin.hinf(fflin.linearize(robot), FULL, measured="r_b")


def test_a_plant_that_cannot_be_stabilised_is_refused(stiff):
    pytest.importorskip("slycot")
    goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, ("q_b.x", "tau_b.y"))
    with pytest.raises(fflin.InputError, match="stabilise"):
        fflin.hinf(fflin.linearize(stiff), goal, measured="q_b.x", inputs="tau_b.y")


def test_hinf_without_slycot_names_the_package(stiff, monkeypatch):
    monkeypatch.setitem(sys.modules, "slycot", None)
    with pytest.raises(fflin.MissingPackageError, match="robust"):
        fflin.hinf(fflin.linearize(stiff), FULL, measured="q_b")


def swept_margin(policy, system, frequencies, delay):
    """Disk margin of a loop with one channel at a time: 1 / max |S - T| / 2, by a sweep."""
    A, B, C = system
    law, dt = policy.system, policy.system.dt
    unit = np.eye(B.shape[1])
    largest = 0.0
    for w in frequencies:
        z = np.exp(1j * w * dt)
        plant = C @ np.linalg.solve(z * np.eye(len(A)) - A, B) / z**delay
        inner = np.linalg.solve(z * np.eye(len(law.A)) - law.A, law.B)
        S = np.linalg.inv(unit - (law.C @ inner + law.D) @ plant)
        largest = max(largest, np.linalg.norm(2.0 * S - unit, 2) / 2.0)
    return 1.0 / largest


def test_the_lags_of_a_robot_are_in_the_tuned_loop():
    """The zero-order hold of the plant with its lags is computed without models of fflin."""
    late, sensed, h = 0.3, 0.1, 0.2
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque(lag=late)],
        outputs=[fflin.StarTracker(lag=sensed)],
    )
    lin = fflin.linearize(robot)
    goals = [fflin.Margin(0.75, hard=True), fflin.Decay(0.05)]
    law = fflin.PD("q_b", "tau_b", shared=True)
    tuned = fflin.tune(lin, law, goals, dt=h, delay=h, starts=1, steps=20)
    nx, unit = len(lin.A), np.eye(3)
    A = np.zeros((nx + 6, nx + 6))
    A[:nx, :nx], A[:nx, nx : nx + 3] = lin.A, lin.B
    A[nx : nx + 3, nx : nx + 3] = -unit / late
    A[nx + 3 :, :nx], A[nx + 3 :, nx + 3 :] = lin.C / sensed, -unit / sensed
    B = np.zeros((nx + 6, 3))
    B[nx : nx + 3] = unit / late
    held = scipy.linalg.expm(h * np.block([[A, B], [np.zeros((3, nx + 9))]]))
    system = (
        held[: nx + 6, : nx + 6],
        held[: nx + 6, nx + 6 :],
        np.eye(3, nx + 6, nx + 3),
    )
    margin = swept_margin(tuned, system, np.geomspace(0.01, np.pi / h, 2000), 1)
    assert tuned.goals[0].met
    assert 0.75 / margin == pytest.approx(tuned.goals[0].value, rel=1e-3)
    assert fflin.margins(tuned, lin).disk == pytest.approx(margin, rel=1e-3)


@pytest.mark.exhaustive
def test_the_lags_of_a_robot_are_in_uncertain_plants():
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque(lag=0.5)],
        outputs=[fflin.StarTracker(lag=0.1)],
    )
    uncertain = fflin.uncertain(robot, {"base.mass": 0.2})
    law = fflin.PD("q_b", "tau_b", shared=True)
    margin = fflin.Margin(0.75, hard=True)
    tuned = fflin.tune(uncertain, law, [margin, fflin.Decay(0.2)], starts=1, steps=20)
    worst = min(
        fflin.margins(tuned, fflin.linearize(uncertain.at({"base.mass": mass}))).disk
        for mass in (robot.mass * 0.8, robot.mass, robot.mass * 1.2)
    )
    assert worst >= 0.75 * (1.0 - 1e-6)


def with_tracker(**times):
    """A satellite with a torque and a star tracker with given times."""
    return fflin.load(
        "cubesat", inputs=[fflin.BaseTorque()], outputs=[fflin.StarTracker(**times)]
    )


@pytest.mark.parametrize(
    ("times", "dt", "word"),
    [
        ({"sample": 0.4}, 0.1, "dt=0.4"),
        ({"sample": 0.4}, None, "the law is continuous"),
        ({"delay": 0.2}, None, "dt=0.2"),
        ({"delay": 0.25}, 0.1, "0.2 and 0.3"),
    ],
)
def test_sensors_with_other_sample_times_than_the_law_are_refused(times, dt, word):
    law = fflin.PD("q_b", "tau_b", shared=True)
    lin = fflin.linearize(with_tracker(**times))
    with pytest.raises(fflin.InputError, match=word):
        fflin.tune(lin, law, fflin.Decay(0.1), dt=dt)


def test_a_sensor_with_the_sample_time_of_the_law_is_accepted():
    law = fflin.PD("q_b", "tau_b", shared=True)
    lin = fflin.linearize(with_tracker(sample=0.1))
    assert fflin.tune(lin, law, fflin.Decay(0.1), dt=0.1, starts=1, steps=5).met


def test_the_delay_of_a_sensor_acts_like_the_same_delay_of_the_inputs():
    law = fflin.PD("q_b", "tau_b", shared=True)
    goals = [fflin.Margin(0.9), fflin.MaxGain("tau_b", "q_b", below=60.0)]
    late = fflin.linearize(with_tracker(delay=0.4))
    plain = fflin.linearize(with_tracker())
    sensed = fflin.tune(late, law, goals, dt=0.2, starts=1, steps=4)
    acted = fflin.tune(plain, law, goals, dt=0.2, delay=0.4, starts=1, steps=4)
    for goal, other in zip(sensed.goals, acted.goals, strict=True):
        assert goal.value == pytest.approx(other.value, rel=1e-6)
    margin = fflin.margins(sensed, sensed.lin).disk
    assert 0.9 / margin == pytest.approx(sensed.goals[0].check, rel=1e-6)
    # Without the delay, the margin of the loop is larger.
    assert fflin.margins(sensed, plain.discretize(0.2)).disk > 1.05 * margin


def test_the_delay_of_a_sensor_is_in_the_norm_of_hinf():
    pytest.importorskip("slycot")
    goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})
    lin = fflin.linearize(with_tracker(delay=0.4)).discretize(0.2)
    other = fflin.linearize(with_tracker()).discretize(0.2, delay=0.4)
    policy, delayed = fflin.hinf(lin, goal), fflin.hinf(other, goal)
    assert policy.gamma == pytest.approx(delayed.gamma, rel=5e-3)
    assert (
        policy.gamma
        > 1.02 * fflin.hinf(fflin.linearize(with_tracker()).discretize(0.2), goal).gamma
    )


def test_the_lags_of_a_robot_are_in_the_loop_of_hinf():
    pytest.importorskip("slycot")
    goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})
    robot = fflin.load(
        "cubesat", inputs=[fflin.BaseTorque(lag=1.0)], outputs=[fflin.BasePose()]
    )
    lin = fflin.linearize(robot)
    design = fflin.hinf(lin, goal, measured="q_b")
    aware = fflin.hinf(lin.with_lags(), goal, measured="q_b")
    assert design.gamma == aware.gamma
    assert design.order == aware.order > len(lin.A) - 6


@pytest.mark.parametrize("design", ["tune", "hinf"])
def test_a_model_of_one_time_is_refused(design):
    orbit = fflin.EllipticOrbit(perigee=500e3, apogee=900e3)
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose()],
        orbit=orbit,
    )
    lin = fflin.linearize(robot)
    goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})
    with pytest.raises(fflin.InputError, match="does not depend on time"):
        if design == "hinf":
            fflin.hinf(lin, goal, measured="q_b")
        else:
            fflin.tune(lin, fflin.PD("q_b", "tau_b"), goal)
