"""The worst loop of a set of robots, and how far the set is surely safe."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.control.closed_loop import ClosedLoop
from fflin.control.margins import delayed_model, disk_margin_of, laws_in_loop
from fflin.uncertainty import worst
from fflin.uncertainty.sampled_loops import (
    OUTPUTS,
    SampledLoops,
    measured_signals,
    sampled_law,
)
from fflin.uncertainty.worst import Channel, Loops, judged_states, part_of
from tests.support.marks import exhaustive

FOUR = {
    "base.mass": 0.2,
    "link_7": {"density": 0.3, "com.z": (-0.15, -0.11)},
    "panel_left.stiffness": (80.0, 120.0),
}


@pytest.fixture(scope="module")
def servicer():
    """A robot, its gain, four parameters, and their loops."""
    robot = fflin.load("servicer_7dof")
    uncertain = fflin.uncertain(robot, FOUR)
    gain = fflin.lqr(fflin.linearize(robot.replace(stiffness={"panel_left": 100.0})))
    return uncertain, gain, Loops(uncertain.lft(), gain.K)


def disk_of(gain):
    scale = np.sqrt(gain.R.diagonal())
    return Channel(-scale[:, None] * gain.K, 0.5 * np.eye(len(scale)), 1.0 / scale)


def whole_of(loops):
    C = loops.lft.C2
    return Channel(C, np.zeros((len(C), len(loops.K))), np.ones(len(loops.K)))


@pytest.mark.parametrize("drawn", exhaustive(80, 400))
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_no_draw_is_worse_than_the_result(servicer, drawn):
    uncertain, gain, loops = servicer
    result = uncertain.worst(gain, samples=30)
    draws, frequencies = uncertain.draws(drawn, seed=9)[0], np.geomspace(0.02, 3.0, 20)
    assert result.damping.value <= -loops.undamped(draws).max()
    assert result.gain.value >= loops.gains(whole_of(loops), draws, frequencies).max()
    assert (
        result.margin.value
        <= 1.0 / loops.gains(disk_of(gain), draws, frequencies).max()
    )
    # What is said is of the robot that is said.
    robot = uncertain.at(result.margin.parameters)
    lin = fflin.linearize(robot)
    F, scale = lin.A - lin.B @ gain.K, disk_of(gain).scale
    peaks = [
        np.linalg.norm(
            0.5 * np.eye(len(scale))
            - (gain.K / scale[:, None])
            @ np.linalg.solve(1j * w * np.eye(len(F)) - F, lin.B * scale),
            2,
        )
        for w in np.geomspace(0.01, 10.0, 800)
    ]
    assert result.margin.value == pytest.approx(1.0 / max(peaks), rel=1e-3)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_of_many_signals_the_bound_asks_no_more_of_slycot_than_it_can(
    monkeypatch, servicer
):
    slycot = pytest.importorskip("slycot")
    asked, ab13md = [], slycot.ab13md
    monkeypatch.setattr(
        slycot, "ab13md", lambda *a: asked.append(len(a[0])) or ab13md(*a)
    )
    uncertain, gain, _ = servicer
    four = uncertain.worst(gain, samples=2)
    assert 0 < len(asked) < 60 and set(asked) == {14}
    asked.clear()
    many = {
        f"link_{i}.{part}": 0.2 for i in range(1, 8) for part in ("mass", "density")
    }
    lft = fflin.uncertain(uncertain.robot, many).lft()
    bound = 1.0 / worst._safe(Loops(lft, gain.K))
    assert not asked and len(lft.D11) == 63
    assert 0.2 <= bound < 0.4 and four.safe > 1.0


SETS = {
    "planar_detumble": {
        "joint_3.stiffness": (20.0, 80.0),
        "base.mass": 0.3,
        "link_1.density": 0.4,
    },
    "cubesat": {"base.mass": 0.3, "base.inertia.zz": 0.2, "base.com.x": (-0.1, 0.1)},
}


def peak(F, B, C, D):
    """Return a gain that is reached, from a grid of frequencies and finer ones about its best."""
    result, w = (
        0.0,
        np.concatenate(((0.0,), np.abs(np.linalg.eigvals(F)), np.geomspace(1e-4, 1e3))),
    )
    for width in (0.1, 0.01, 1e-3):
        sizes = response_size(w, F, B, C, D)
        result = max(result, sizes.max())
        w = w[sizes.argmax()] * (1.0 + np.linspace(-width, width, 41))
    return result


def response_size(w, F, B, C, D):
    w = w[:, None, None]
    response = C @ np.linalg.solve(1j * w * np.eye(len(F)) - F, B) + D
    return np.linalg.norm(response, 2, axis=(1, 2))


@pytest.fixture(scope="module", params=SETS)
def springy(request):
    """An uncertain robot, a gain, and damping, disk margin and gain of some robots built again."""
    robot = fflin.load(request.param)
    if "joint_3" in robot.joint_names:
        robot = robot.replace(stiffness={"joint_3": 50.0}, damping={"joint_3": 0.1})
    uncertain, gain = (
        fflin.uncertain(robot, SETS[request.param]),
        fflin.lqr(fflin.linearize(robot)),
    )
    scale = np.sqrt(gain.R.diagonal())
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    rows, figures = np.vstack((corners, uncertain.draws(40, seed=0)[0])), []
    for delta in rows:
        lin = fflin.linearize(uncertain.at(uncertain.values(delta)))
        F, poles = lin.A - lin.B @ gain.K, np.linalg.eigvals(lin.A - lin.B @ gain.K)
        disk = peak(
            F, lin.B / scale, -scale[:, None] * gain.K, 0.5 * np.eye(len(scale))
        )
        damping = (-poles.real / np.abs(poles)).min()
        figures.append((damping, 1.0 / disk, -peak(F, lin.B, lin.C, lin.D)))
    return uncertain, gain, np.array(figures)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_no_rebuilt_corner_or_draw_is_worse_than_the_result(monkeypatch, springy):
    monkeypatch.setattr(worst, "_safe", lambda loops: np.inf)
    uncertain, gain, figures = springy
    least = uncertain.worst(gain, samples=40)
    result = np.array((least.damping.value, least.margin.value, -least.gain.value))
    assert least.tried == len(figures) + 1
    # The gains are to five digits; the damping is by eigenvalues alone.
    assert (result <= figures.min(axis=0) + 2e-5 * np.abs(result)).all()
    # The figures are those of the robots that are named.
    lin = fflin.linearize(uncertain.at(least.gain.parameters))
    named = peak(lin.A - lin.B @ gain.K, lin.B, lin.C, lin.D)
    assert least.gain.value == pytest.approx(named, rel=1e-4)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_more_samples_never_find_less(monkeypatch, springy):
    monkeypatch.setattr(worst, "_safe", lambda loops: np.inf)
    uncertain, gain, _ = springy
    assert (uncertain.draws(40, seed=3)[0][:7] == uncertain.draws(7, seed=3)[0]).all()
    result = [uncertain.worst(gain, samples=n, seed=3) for n in (1, 5, 40)]
    for fewer, more in itertools.pairwise(result):
        assert more.damping.value <= fewer.damping.value
        assert more.margin.value <= fewer.margin.value
        assert more.gain.value >= fewer.gain.value


def test_violations_are_distinguished_from_values_within_a_bound(servicer):
    uncertain, _, loops = servicer
    figures, draws = loops.figures(whole_of(loops)), uncertain.draws(12, seed=4)[0]
    exact = np.array([figures.exact(row[None])[0] for row in draws])
    for bound in exact:
        clear = np.abs(exact / bound - 1.0) > 1e-4
        assert (figures.above(draws, bound) == (exact > bound))[clear].all()


def test_the_bound_by_scaling_matches_textbooks():
    # Packard and Doyle, Automatica 29(1), 1993: of diagonal blocks the bound by D Z D^-1.
    def scaled(Z):
        d = worst.perron(Z)
        return d * Z / d.mT, worst.bound_of(Z[None], (d[:, 0], 0.0 * d[:, 0]))

    assert scaled(np.array([[1.0, 4.0], [0.25, 1.0]]))[1] == pytest.approx(
        2.0, rel=1e-6
    )
    for Z in np.random.default_rng(0).normal(size=(20, 5, 5)) + 0j:
        alike, bound = scaled(Z)
        assert np.abs(np.linalg.eigvals(Z)).max() * (1.0 - 1e-12) <= bound
        assert bound <= np.abs(np.linalg.eigvals(np.abs(Z))).max() * (1.0 + 1e-6)
        assert np.linalg.norm(alike, 2) == pytest.approx(bound)
    assert scaled(np.zeros((2, 2)))[1] == 0.0


def test_slycot_gives_the_structured_singular_value_of_its_example():
    slycot = pytest.importorskip("slycot")
    rows = (
        (-1 + 6j, 2 - 3j, 3 + 8j, 3 + 8j, -5 - 9j, -6 + 2j),
        (4 + 2j, -2 + 5j, -6 - 7j, -4 + 11j, 8 - 7j, 12 - 1j),
        (5 - 4j, -4 - 8j, 1 - 3j, -6 + 14j, 2 - 5j, 4 + 16j),
    )
    Z = np.array(2 * rows)
    blocks, kinds = [1, 1, 2, 1, 1], [1, 1, 2, 2, 2]
    # The example of AB13MD in SLICOT.
    assert slycot.ab13md(Z, blocks, kinds)[0] == pytest.approx(41.74753408, rel=1e-6)
    # Real numbers and full blocks, as `worst` asks it: what it returns makes its bound.
    blocks = np.array(blocks)
    bound = slycot.ab13md(Z, blocks, np.where(blocks == 1, 1, 2))[0]
    scalings = worst._scalings(Z, blocks)[-1]
    assert worst.bound_of(Z[None], scalings) == pytest.approx(bound, rel=1e-6)
    assert bound <= 41.74753408 * (1.0 + 1e-6)


@pytest.mark.exhaustive
def test_the_worst_loop_of_one_parameter_is_at_its_end():
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    uncertain = fflin.uncertain(robot, {"base.density": (0.5, 2.0)})
    worst = uncertain.worst(gain, samples=40)
    damping, gains = [], []
    for density in np.linspace(0.5, 2.0, 61):
        other = fflin.linearize(uncertain.at({"base.density": density}))
        F = other.A - other.B @ gain.K
        poles = np.linalg.eigvals(F)
        damping.append((-poles.real / np.abs(poles)).min())
        s = 1j * np.geomspace(1e-4, 1e1, 400)[:, None, None]
        response = np.linalg.solve(s * np.eye(12) - F, other.B[None])
        gains.append(np.linalg.norm(response, 2, axis=(1, 2)).max())
    assert worst.damping.value == pytest.approx(min(damping), rel=1e-6)
    assert worst.damping.parameters["base.density"] == pytest.approx(2.0)
    assert worst.gain.value == pytest.approx(max(gains), rel=1e-3)
    assert worst.gain.value > max(gains) * (1.0 - 1e-5)
    assert worst.unstable == 0


def test_the_bound_matches_the_structured_singular_value():
    ab13md = pytest.importorskip("slycot").ab13md
    # A real number that multiplies one signal: only at frequencies without end, where M is
    # singular for an inertia of 0, is the loop at its limit.
    robot = fflin.load("cubesat")
    gain = fflin.lqr(fflin.linearize(robot))
    worst = fflin.uncertain(robot, {"base.inertia.xx": 0.3}).worst(gain, samples=5)
    assert worst.safe == pytest.approx(1.0 / 0.3, rel=1e-6)
    # Packard and Doyle: of one full block it is the largest singular value, of a repeated one no
    # more than that; of a diagonal one the bound by D Z D^-1.
    Z = np.array([[1.0, 4.0], [0.25, 1.0]])
    assert ab13md(Z, [2], [2])[0] == pytest.approx(np.linalg.norm(Z, 2), rel=1e-6)
    assert ab13md(Z, [1, 1], [2, 2])[0] == pytest.approx(2.0, rel=1e-6)


def test_loops_within_the_stability_bound_are_stable():
    pytest.importorskip("slycot")
    robot = fflin.load("ets_vii")
    gain = fflin.lqr(fflin.linearize(robot))
    uncertain = fflin.uncertain(
        robot, {"base.mass": 0.5, "link_6.mass": 0.5, "link_6.com.z": (-0.3, 0.3)}
    )
    worst, lft = uncertain.worst(gain, samples=10), uncertain.lft()
    rng = np.random.default_rng(5)
    for delta in min(worst.safe, 1.0) * rng.uniform(-1.0, 1.0, (200, 3)):
        A, B, *_ = lft.at(delta)
        assert np.linalg.eigvals(A - B @ gain.K).real.max() < 0.0


@pytest.mark.exhaustive
def test_stability_is_guaranteed_until_the_stiffness_of_a_panel_is_zero():
    robot = fflin.load(
        "servicer_7dof",
        lock=["joint_*"],
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose()],
        stiffness={"panel_*": 100.0},
        damping={"panel_*": 1.0},
    )
    policy = fflin.PD("q_b", "tau_b", shared=True, kp=300.0, lag=0.03)
    lin = fflin.linearize(robot)
    tuned = fflin.tune(lin, policy, fflin.Margin(0.5), starts=1, steps=1)
    stiffness = {"range": 0.2, "tied": True}
    uncertain = fflin.uncertain(robot, {"panel_*.stiffness": stiffness})
    safe = uncertain.worst(tuned, samples=5).safe
    assert safe == pytest.approx(5.0, rel=1e-2)
    assert safe <= 5.0


def test_a_pole_that_crosses_the_axis_between_frequencies_of_the_grid_is_not_missed():
    """s^3 + s^2 + (2 + delta) s + 1 has its poles at +-j where delta is -1, by Routh."""
    pytest.importorskip("slycot")
    polynomial = (1.0, 1.0, 2.0, 1.0)

    def response(w):
        return (-1j * w / np.polyval(polynomial, 1j * w))[:, None, None]

    rates = np.abs(np.roots(polynomial))
    bound = worst.largest_bound(response, np.zeros((1, 1)), rates, np.array([1]))
    assert bound >= 1.0


def test_of_many_parameters_some_corners_are_tried(monkeypatch):
    """2^30 of them would not go into memory."""
    monkeypatch.setattr(worst, "product", None)
    monkeypatch.setattr(worst, "_CORNERS", 4)
    robot = fflin.load("cubesat")
    parts = ["mass", "inertia.xx", "inertia.yy"]
    uncertain = fflin.uncertain(robot, {f"base.{part}": 0.01 for part in parts})
    assert (
        uncertain.worst(fflin.lqr(fflin.linearize(robot)), samples=2).tried == 2 + 4 + 1
    )


def wheeled(others=(), **fields):
    """A cubesat with three wheels, of which a small one has another inertia."""
    sizes = (2e-4, 2e-4, 1e-4)
    axes = np.eye(3)
    pairs = zip(axes, sizes, strict=True)
    wheels = [fflin.ReactionWheel(axis, inertia=size) for axis, size in pairs]
    return fflin.load("cubesat", inputs=[*others, *wheels], **fields)


WHEELED = {
    "wheels alone": wheeled,
    "speeds regulated": lambda: wheeled([fflin.BaseTorque()]),
    "position regulated": lambda: wheeled([fflin.BaseForce()]),
    "wheels with friction": lambda: wheeled(
        [fflin.BaseTorque()], damping={"wheel_1": 1e-5}
    ),
}


@pytest.mark.parametrize(
    "layout",
    [
        "wheels alone",
        "wheels with friction",
        pytest.param("speeds regulated", marks=pytest.mark.exhaustive),
        pytest.param("position regulated", marks=pytest.mark.exhaustive),
    ],
)
@pytest.mark.exhaustive
def test_stability_matches_the_regulated_states(layout):
    """Worst figures compared with loops of robots built again, over their regulated states."""
    robot = WHEELED[layout]()
    ranges = {
        "base.density": (0.6, 1.5),
        "base.inertia.xy": (-5e-4, 5e-4),
        "wheel_3.inertia": 0.5,
    }
    gain = fflin.lqr(fflin.linearize(robot))
    uncertain = fflin.uncertain(robot, ranges)
    result = uncertain.worst(gain, samples=5)
    kept = [gain.state_names.index(name) for name in gain.regulated]
    assert len(kept) < len(gain.state_names)
    K, scale = gain.K[:, kept], np.sqrt(gain.R.diagonal())
    frequencies = np.geomspace(1e-3, 10.0, 60)
    damping, margins, gains = [], [], []
    for delta in uncertain.draws(25, seed=7)[0]:
        lin = fflin.linearize(uncertain.at(uncertain.values(delta)))
        A, B = lin.A[np.ix_(kept, kept)], lin.B[kept]
        F = A - B @ K
        poles = np.linalg.eigvals(F)
        damping.append((-poles.real / np.abs(poles)).min())
        for w in frequencies:
            x = np.linalg.solve(1j * w * np.eye(len(F)) - F, B)
            gains.append(np.linalg.norm(x, 2))
            loop = 0.5 * np.eye(len(K)) - scale[:, None] * K @ x / scale
            margins.append(1.0 / np.linalg.norm(loop, 2))
    assert result.unstable == 0 and result.safe > 0.0
    assert 0.0 < result.damping.value <= min(damping) * (1.0 + 1e-9)
    assert result.margin.value <= min(*margins, 2.0) * (1.0 + 1e-9)
    assert result.gain.value >= max(gains) * (1.0 - 1e-9)
    # The figures are of the robots at the parameters that the result names.
    lin = fflin.linearize(uncertain.at(result.damping.parameters))
    poles = np.linalg.eigvals(lin.A[np.ix_(kept, kept)] - lin.B[kept] @ K)
    assert (-poles.real / np.abs(poles)).min() == pytest.approx(
        result.damping.value, rel=1e-6
    )


def test_unstable_loops_of_wheels_are_counted():
    """Wheels whose torques are rotated about z by 60 deg: heavy robots become unstable."""
    robot = wheeled()
    gain = fflin.lqr(fflin.linearize(robot))
    angle = np.radians(60.0)
    rotation = np.eye(3)
    rotation[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    rotated = replace(gain, K=rotation @ gain.K)
    uncertain = fflin.uncertain(robot, {"base.density": (0.5, 2.0)})
    result = uncertain.worst(rotated, samples=10)
    kept = [gain.state_names.index(name) for name in gain.regulated]
    tried = [np.zeros(1), -np.ones(1), np.ones(1), *uncertain.draws(10, seed=0)[0]]
    growth = []
    for delta in tried:
        lin = fflin.linearize(uncertain.at(uncertain.values(delta)))
        loop = lin.A[np.ix_(kept, kept)] - lin.B[kept] @ rotated.K[:, kept]
        growth.append(np.linalg.eigvals(loop).real.max())
    count = np.count_nonzero(np.array(growth) >= 0.0)
    assert result.tried == len(tried) and 0 < count < len(tried)
    assert result.unstable == count and result.margin.value == 0.0
    # The limit of stability lies outside the guaranteed ranges.
    unstable = [
        abs(delta[0]) for delta, rate in zip(tried, growth, strict=True) if rate >= 0.0
    ]
    assert 0.0 < result.safe <= min(unstable)


@pytest.mark.parametrize("sign, given", [(-1.0, "Gain"), (1.0, "array")])
def test_a_gain_that_does_not_stabilise_is_refused(sign, given):
    """An array names no regulated states, so the pole at 0 of the total momentum counts."""
    robot = wheeled()
    gain = fflin.lqr(fflin.linearize(robot))
    K = sign * gain.K
    law = replace(gain, K=K) if given == "Gain" else K
    with pytest.raises(fflin.InputError, match="the middle of the ranges is unstable"):
        fflin.uncertain(robot, {"base.density": 0.2}).worst(law, samples=5)


def test_states_that_affect_regulated_states_are_judged():
    """x1 is regulated; x2 acts on x1, x3 on x2 by a parameter; nothing depends on x4."""
    robot = fflin.load("cubesat")
    lft = fflin.uncertain(robot, {"base.density": 0.2}).lft()
    A, B1, C1 = np.zeros((4, 4)), np.zeros((4, 1)), np.zeros((1, 4))
    A[0, 1], A[3, 0] = 1.0, 1.0
    B1[1], C1[0, 2] = 1.0, 1.0
    names = ("x1", "x2", "x3", "x4")
    made = replace(lft, A=A, B1=B1, C1=C1, state_names=names)
    kept = worst.judged_states(made, np.zeros((2, 4)), ("x1",))
    assert kept.tolist() == [True, True, True, False]
    fed_back = np.array([[0.0, 0.0, 0.0, 1.0]])
    assert worst.judged_states(made, fed_back, ("x1",)).all()


@pytest.fixture(scope="module")
def uncertain_arm():
    """Return a robot with two uncertain masses, and its model and gain."""
    robot = fflin.load("planar_detumble", lock=["joint_2", "joint_3"])
    model = fflin.uncertain(robot, {"base.density": 0.3, "link_1.mass": 0.1})
    lin = fflin.linearize(robot)
    return model, lin, fflin.lqr(lin, 1.0, 1.0)


@pytest.mark.exhaustive
def test_a_state_feedback_has_the_worst_loops_of_its_gain(uncertain_arm):
    model, lin, gain = uncertain_arm
    worst = model.worst(gain.K, samples=5)
    law = fflin.StateFeedback(lin, gain.K)
    policy = model.worst(law, samples=5)
    assert (policy.damping, policy.gain) == (worst.damping, worst.gain)
    assert (policy.tried, policy.safe) == (worst.tried, worst.safe)
    # As in `margins`, the inputs of a policy have the best scaling.
    robot = model.at(policy.margin.parameters)
    expected = fflin.margins(law, fflin.linearize(robot)).disk
    assert policy.margin.value == pytest.approx(expected, rel=1e-6)
    assert policy.margin.value > worst.margin.value
    # A controller without states is the same law.
    static = fflin.LinearController(-gain.K, lin)
    assert model.worst(static, samples=5) == policy


@pytest.mark.exhaustive
def test_the_worst_loop_of_a_controller_with_states_is_that_of_its_closed_loop(
    uncertain_arm,
):
    model, lin, gain = uncertain_arm
    # Each command passes a low-pass filter.
    nu, lag = len(gain.K), 0.05
    filtered = (-np.eye(nu) / lag, gain.K / lag, -np.eye(nu), np.zeros_like(gain.K))
    law = fflin.LinearController(filtered, lin)
    worst = model.worst(law, samples=5)
    poles = []
    lft = model.lft()
    for corner in model.draws(200, seed=3)[0]:
        A, B, *_ = lft.at(corner[None])
        loop = np.block([[A[0], -B[0]], [gain.K / lag, -np.eye(nu) / lag]])
        poles.append(np.linalg.eigvals(loop))
    ratios = [(-p.real / np.abs(p)).min() for p in poles]
    assert worst.damping.value <= min(ratios) + 1e-9
    A, B, *_ = lft.at(worst.damping.parameters)
    loop = np.block([[A, -B], [gain.K / lag, -np.eye(nu) / lag]])
    p = np.linalg.eigvals(loop)
    assert worst.damping.value == pytest.approx((-p.real / np.abs(p)).min(), rel=1e-9)
    assert 0.0 < worst.margin.value < model.worst(gain.K, samples=5).margin.value


@pytest.fixture(scope="module")
def sampled_satellite():
    """An uncertain satellite with a sampled and delayed model, and two laws for it."""
    outputs = [fflin.BasePose(), fflin.Gyroscope("base")]
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=outputs)
    ranges = {"base.inertia.xx": 0.2, "base.inertia.zz": 0.3}
    lin = fflin.linearize(robot)
    late = lin.discretize(0.5, delay={"tau_b.x": 0.7, "tau_b.y": 0.2})
    gain = fflin.lqr(late)
    noise = {"q_b": 1e-9, "r_b": 1e-4, "gyroscope": 1e-9}
    estimator = fflin.kalman(late, {"omega_b": 1e-9}, noise)
    laws = {
        "state": fflin.StateFeedback(late, gain),
        "output": fflin.OutputFeedback(late, fflin.lqg(gain, estimator)),
        "gain": gain,
        "integral": fflin.lqr(late, integral_action=["q_b"]),
    }
    return fflin.uncertain(robot, ranges), laws


@pytest.mark.parametrize("name", exhaustive("state", "output", "gain", "integral"))
def test_the_worst_sampled_loop_has_its_margin_its_poles_and_its_gain(
    sampled_satellite, name
):
    model, laws = sampled_satellite
    law = laws[name]
    worst = model.worst(law, samples=10)
    assert worst.unstable == 0 and np.isnan(worst.safe)
    assert "is not guaranteed" in " ".join(str(worst).split())

    def closed(parameters):
        lin = fflin.linearize(model.at(parameters))
        lin, delay = delayed_model(law, lin, None)
        return ClosedLoop(laws_in_loop(law, lin, None), lin, delay, None, "inputs")

    def figures(loop):
        F = loop.loop()[0]
        rates = np.log(np.linalg.eigvals(F)) / loop.dt
        return loop.margins().disk, (-rates.real / np.abs(rates)).min()

    disk, _ = figures(closed(worst.margin.parameters))
    assert worst.margin.value == pytest.approx(disk, rel=1e-6)
    _, damping = figures(closed(worst.damping.parameters))
    assert worst.damping.value == pytest.approx(damping, rel=1e-6)
    for delta in model.draws(8, seed=5)[0]:
        disk, damping = figures(closed(model.values(delta)))
        assert worst.margin.value <= disk * (1.0 + 1e-6)
        assert worst.damping.value <= damping + 1e-9


def test_the_gain_of_a_sampled_loop_is_that_of_its_frequency_response(
    sampled_satellite,
):
    model, laws = sampled_satellite
    worst = model.worst(laws["state"], samples=5)
    law = sampled_law(laws["state"])
    lft = model.lft()
    kept = judged_states(lft, measured_signals(lft, law), law.regulated)
    loops = SampledLoops(part_of(lft, kept), law)
    # One of the tried corners, or a better point, is the worst.
    corner = loops.exact(np.array((-1.0, -1.0)), OUTPUTS)
    assert worst.gain.value >= corner * (1.0 - 1e-5)
    F, G, _, H = loops._closed(np.array((-1.0, -1.0)))[0]
    w = np.geomspace(1e-4, np.pi / 0.5, 3000)
    gains = [
        np.linalg.norm(H @ np.linalg.solve(np.exp(0.5j * x) * np.eye(len(F)) - F, G), 2)
        for x in (0.0, *w)
    ]
    assert max(gains) == pytest.approx(corner, rel=1e-4)


def test_unstable_sampled_loops_are_counted(sampled_satellite):
    model, laws = sampled_satellite
    policy = laws["state"]
    lin = policy.lin
    # A loop that is near its limit of stability at the middle.
    factor = 0.97 * fflin.margins(policy, lin).channels[2].gain[1]
    K = policy.K * np.array((1.0, 1.0, factor))[:, None]
    worst = model.worst(fflin.StateFeedback(lin, K), samples=5)
    assert worst.unstable > 0 and worst.margin.value == 0.0
    assert worst.damping.value < 0.0
    other = fflin.linearize(fflin.load("planar_detumble")).discretize(0.1)
    law = fflin.StateFeedback(other, fflin.lqr(other))
    with pytest.raises(fflin.InputError, match="give the law of this robot"):
        model.worst(law)


def multirate_satellite(sensors):
    """Return a satellite with an uncertain inertia, and its model."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=sensors)
    model = fflin.uncertain(robot, {"base.density": 0.3})
    return model, fflin.linearize(robot).discretize(0.25, delay=0.1)


@pytest.mark.exhaustive
def test_the_worst_loop_of_a_multirate_law_is_that_of_margins():
    sensors = [fflin.StarTracker(sample=0.5, delay=0.25), fflin.Gyroscope("base")]
    model, lin = multirate_satellite(sensors)
    estimator = fflin.kalman(lin, {"omega_b": 1e-10}, 1e-9)
    policy = fflin.MultirateFeedback(lin, fflin.lqg(fflin.lqr(lin), estimator))
    worst = model.worst(policy, samples=4)
    assert worst.unstable == 0 and math.isnan(worst.safe)
    at = fflin.linearize(model.at(worst.margin.parameters))
    result = fflin.margins(policy, at, delay=0.1)
    assert worst.margin.value == pytest.approx(result.disk, rel=1e-5)
    for robot in model.samples(4, seed=3):
        disk = disk_margin_of(policy, fflin.linearize(robot), delay=0.1)
        assert worst.margin.value <= disk * (1.0 + 1e-6)


@pytest.mark.exhaustive
def test_the_loops_of_a_law_contain_the_delays_of_its_sensors():
    sensors = [fflin.StarTracker(delay=0.25), fflin.Gyroscope("base", delay=0.25)]
    model, lin = multirate_satellite(sensors)
    none = np.zeros((0, 0))
    gains = np.hstack((-5e-4 * np.eye(3), -5e-3 * np.eye(3)))
    system = (none, np.zeros((0, 6)), np.zeros((3, 0)), gains, lin.dt)
    policy = fflin.LinearController(system, lin)
    worst = model.worst(policy, samples=4)
    at = fflin.linearize(model.at(worst.margin.parameters))
    result = fflin.margins(policy, at, delay=0.1)
    assert worst.margin.value == pytest.approx(result.disk, rel=1e-5)
