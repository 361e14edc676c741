"""Margins of linear loops equal those of brute-force searches and of closed forms."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import fflin
from fflin.control.closed_loop import ClosedLoop, _delayed
from fflin.control.margins import laws_in_loop
from fflin.control.optimal import disk
from fflin.control.optimal.disk import best_scaling, worst_perturbation
from fflin.control.policy import System
from fflin.dynamics.delays import HeldSystem, split
from tests.support.marks import exhaustive


def satellite(inputs=None, **fields):
    """Return a robot with a base torque, and its model."""
    robot = fflin.load("cubesat", inputs=inputs or [fflin.BaseTorque()], **fields)
    return robot, fflin.linearize(robot)


def loop_of(policy, lin, **how):
    """Return the loop whose margins are computed."""
    how = {"delay": 0.0, "sample": None, "at": "inputs", **how}
    return ClosedLoop(laws_in_loop(policy, lin, how["sample"]), lin, *how.values())


def test_each_input_of_a_continuous_plant_has_its_own_delay():
    """G(jw) diag(exp(-jw T)), as long as w T is below the order of the approximation."""
    rng = np.random.default_rng(2)
    A, B = rng.normal(size=(4, 4)), rng.normal(size=(4, 3))
    C, D = rng.normal(size=(2, 4)), rng.normal(size=(2, 3))
    delays = np.array([0.3, 0.0, 0.5])
    late = _delayed(System(A, B, C, D), delays)

    def response(plant, w):
        inner = 1j * w * np.eye(len(plant.A)) - plant.A
        return plant.D + plant.C @ np.linalg.solve(inner, plant.B)

    for w in (0.4, 2.0, 9.0):
        expected = response(System(A, B, C, D), w) * np.exp(-1j * w * delays)
        assert response(late, w) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.1 + 1e-12, 0.17, 0.2, 0.33])
def test_delayed_inputs_give_the_states_of_a_fine_integration(delay):
    rng = np.random.default_rng(1)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    h, part, steps = 0.1, 100, 12
    held = HeldSystem(A, B, h, np.array([delay, 0.0]))
    Ad, Bd = held.sampled()
    commands = rng.normal(size=(steps, 2))
    z, x = np.zeros(len(Ad)), np.zeros(3)
    small = h / part
    step = expm(np.block([[A, B], [np.zeros((2, 5))]]) * small)
    for k, u in enumerate(commands):
        for i in range(part):
            time = k * h + (i + 0.5) * small - delay
            late = commands[math.floor(time / h), 0] if time > 0.0 else 0.0
            x = step[:3, :3] @ x + step[:3, 3:] @ (late, u[1])
            if i == 56:
                of_states, of_commands = held.after(0.57 * h)
                inside = of_states @ z + of_commands @ u
                assert inside == pytest.approx(x, abs=1e-12)
        z = Ad @ z + Bd @ u
        assert z[:3] == pytest.approx(x, abs=1e-12)


def test_a_delay_is_split_into_samples_and_a_rest():
    assert split(0.0, 0.1) == (0, 0.0)
    for delay in (0.01, 0.1, 0.25, 0.3):
        samples, rest = split(delay, 0.1)
        assert 0.0 < rest <= 0.1
        assert (samples - 1) * 0.1 + rest == pytest.approx(delay)


@pytest.mark.parametrize("count", [1, 2, pytest.param(3, marks=pytest.mark.exhaustive)])
def test_the_best_scaling_is_exact_for_up_to_three_channels(count):
    rng = np.random.default_rng(count)
    for _ in range(5):
        M = rng.normal(size=(count, count)) + 1j * rng.normal(size=(count, count))
        bound, d = best_scaling(M)
        assert bound == pytest.approx(np.linalg.norm(d[:, None] * M / d, 2), rel=1e-9)
        # The structured singular value is the largest spectral radius over the phases.
        phases = np.linspace(0.0, 2.0 * np.pi, 91)[:-1]
        largest = max(
            np.abs(
                np.linalg.eigvals(np.exp(1j * np.array([0.0, *rest]))[:, None] * M)
            ).max()
            for rest in itertools.product(phases, repeat=count - 1)
        )
        assert bound * (1.0 - 4e-3) < largest <= bound * (1.0 + 1e-9)
        reached, change = worst_perturbation(M, d, bound)
        assert reached == pytest.approx(bound, rel=1e-7)
        assert abs(np.linalg.det(np.eye(count) - M @ np.diag(change))) < 1e-9
        assert np.abs(change) == pytest.approx(1.0 / reached)


@pytest.mark.parametrize("count", [2, 5, 12])
def test_the_search_for_the_best_scaling_converges_quadratically(count, monkeypatch):
    # Newton's method with exact second derivatives doubles the number of digits in each step, so
    # eight steps leave a rounding error. With other second derivatives, 1e-3 is left.
    rng = np.random.default_rng(count)
    M = rng.normal(size=(count, count)) + 1j * rng.normal(size=(count, count))
    t = 1.2 * np.linalg.norm(M, 2) ** 2
    found = []
    for steps in (8, 100):
        monkeypatch.setattr(disk, "_NEWTON", steps)
        y = disk._centre(M, np.zeros(count), t)
        found.append(y - y.mean())
    assert np.abs(found[1]).max() > 0.1
    assert found[0] == pytest.approx(found[1], abs=1e-6)


def test_a_perturbation_of_many_channels_lies_between_its_bounds():
    rng = np.random.default_rng(3)
    for count in (4, 6, 9):
        M = rng.normal(size=(count, count)) + 1j * rng.normal(size=(count, count))
        bound, d = best_scaling(M)
        reached, change = worst_perturbation(M, d, bound)
        assert bound / 1.2 < reached <= bound * (1.0 + 1e-9)
        assert abs(np.linalg.det(np.eye(count) - M @ np.diag(change))) < 1e-8


def test_the_margins_of_a_double_integrator_are_those_of_its_closed_form():
    _, lin = satellite()
    gain = fflin.lqr(lin)
    margins = fflin.margins(gain, lin)
    # By symmetry, each axis is a double integrator q'' = s L u with L the inverse inertia.
    for i, channel in enumerate(margins.channels):
        names = lin.state_names
        axis = lin.input_names[i].removeprefix("tau_b.")
        kp = gain.K[i, names.index(f"q_b.{axis}")]
        kd = gain.K[i, names.index(f"omega_b.{axis}")]
        L = lin.B[names.index(f"omega_b.{axis}"), i]
        a, b = 0.5 * kp * L, kd * L
        # |a + b j w| = w^2
        w = math.sqrt(0.5 * (b * b + math.sqrt(b**4 + 4.0 * a * a)))
        phase = math.atan2(b * w, a)
        assert channel.phase == pytest.approx(math.degrees(phase), rel=1e-9)
        assert channel.phase_frequency == pytest.approx(w, rel=1e-9)
        assert channel.delay == pytest.approx(phase / w, rel=1e-9)
        assert channel.gain == (0.0, math.inf)
    assert len(margins.channels) == 3


@pytest.fixture(
    scope="module",
    params=[1, 2, pytest.param(3, marks=pytest.mark.exhaustive)],
)
def joints(request):
    """Return the model and a law of a robot whose first one to three joints are actuated."""
    names = [f"joint_{i + 1}" for i in range(request.param)]
    robot = fflin.load(
        "planar_detumble",
        inputs=[fflin.JointTorque(name) for name in names],
        stiffness={"joint_*": 2.0},
        damping={"joint_*": 0.2},
    )
    lin = fflin.linearize(robot)
    rng = np.random.default_rng(request.param)
    K = np.zeros(lin.B.T.shape)
    for row, name in enumerate(names):
        K[row, lin.state_names.index(f"q_m.{name}")] = 15.0 + 5.0 * rng.uniform()
        K[row, lin.state_names.index(f"qdot_m.{name}")] = 6.0 + rng.uniform()
    return lin, fflin.StateFeedback(lin, K)


@pytest.mark.parametrize("how", [{}, {"sample": 0.02}, {"sample": 0.05, "delay": 0.03}])
def test_disk_margins_equal_a_search_over_frequencies_and_phases(joints, how):
    lin, policy = joints
    margins = fflin.margins(policy, lin, **how)
    assert margins.stable
    loop = loop_of(policy, lin, **how)
    plant = loop.with_delays(np.full(len(lin.input_names), loop.delay))
    F, G, H, J = loop.closed(plant)
    count = len(J)

    def response(w):
        point = np.exp(1j * w * loop.dt) if loop.dt else 1j * w
        return J + H @ np.linalg.solve(point * np.eye(len(F)) - F, G)

    # The largest spectral radius over phases and frequencies near the one that is reported.
    phases = np.linspace(0.0, 2.0 * np.pi, 81)[:-1]
    turns = np.array(
        [(0.0, *rest) for rest in itertools.product(phases, repeat=count - 1)]
    )
    turns = np.exp(1j * turns)[:, :, None]
    end = np.pi / loop.dt if loop.dt else 1e3

    def largest(w, among=turns):
        return np.abs(np.linalg.eigvals(among * response(w))).max()

    for w in np.geomspace(1e-3, end, 200):
        assert largest(w, turns[::7]) <= (1.0 + 1e-6) / margins.disk
    assert largest(margins.frequency) >= (1.0 - 4e-3) / margins.disk
    # The factors make the loop oscillate at that frequency: the bound is reached.
    assert margins.disk_reached == pytest.approx(margins.disk, rel=1e-6)
    factors = np.diag(margins.factors)
    K = policy.K
    kept = np.flatnonzero(K.any(axis=1))
    assert len(kept) == count
    A, B, C, *_ = plant
    law = loop.law.D
    closed = A + B @ factors @ law @ C
    poles = np.linalg.eigvals(closed.astype(complex))
    on_boundary = np.abs(np.abs(poles) - 1.0) if loop.dt else np.abs(poles.real)
    assert on_boundary.min() < 1e-6
    for share, is_stable in ((0.999, True), (1.001, False)):
        change = 2.0 * (margins.factors - 1.0) / (margins.factors + 1.0) * share
        scaled = np.diag((1.0 + 0.5 * change) / (1.0 - 0.5 * change))
        poles = np.linalg.eigvals((A + B @ scaled @ law @ C).astype(complex))
        growth = np.abs(poles).max() - 1.0 if loop.dt else poles.real.max()
        assert (growth < 0.0) == is_stable


def felt():
    """Return a model whose outputs include an acceleration, and a law with a state that uses it."""
    robot = fflin.load(
        "planar_detumble",
        inputs=[fflin.JointTorque("joint_1")],
        outputs=[
            fflin.JointPositions(("joint_1",)),
            fflin.JointVelocities(("joint_1",)),
            fflin.Accelerometer("base"),
        ],
        stiffness={"joint_*": 2.0},
        damping={"joint_*": 0.2},
    )
    lin = fflin.linearize(robot)
    ny = len(lin.output_names)
    C = np.zeros((1, 2))
    C[0, 1] = -0.4
    B = np.zeros((2, ny))
    B[0, 2:4] = 60.0, 40.0
    B[1, 3] = 90.0
    D = np.zeros((1, ny))
    D[0, :2] = -12.0, -5.0
    A = np.array([[-3.0, 0.5], [1.0, -4.0]])
    return lin, fflin.LinearController((A, B, C, D), lin)


@pytest.mark.parametrize("how", [{}, {"sample": 0.04}, {"sample": 0.05, "delay": 0.03}])
def test_changes_of_measured_outputs_destabilise_at_their_margins(how):
    """The closed loop is built here by itself, with complex factors at the outputs."""
    lin, controller = felt()
    assert lin.D.any()
    margins = fflin.margins(controller, lin, at="outputs", **how)
    assert margins.stable and len(margins.channels) > 2
    law = controller
    if "sample" in how:
        law = controller.sampled(how["sample"])
    Ac, Bc, Cc, Dc = law.system[:4]
    A, B, C, D = lin.A, lin.B, lin.C, lin.D
    if "sample" in how:
        held = HeldSystem(A, B, how["sample"], np.full(1, how.get("delay", 0.0)))
        A, B = held.sampled()
        C, D = held.outputs(C, D)

    def growth(factors):
        """Return how far the poles are beyond the boundary; x' of u = Cc z + Dc f (C x + D u)."""
        f = np.ones(len(lin.output_names), complex)
        for channel, factor in factors.items():
            f[lin.output_names.index(channel)] = factor
        F = f[:, None] * np.hstack((C, np.zeros((len(C), len(Ac)))))
        K = np.hstack((np.zeros((1, len(A))), Cc)) + Dc @ F
        closed = np.block(
            [
                [A.astype(complex), np.zeros((len(A), len(Ac)))],
                [np.zeros((len(Ac), len(A))), Ac],
            ]
        )
        measured = F + f[:, None] * (D @ K)
        closed = closed + np.vstack((B @ K, Bc @ measured))
        kept = np.abs(closed).sum(axis=0) > 0.0
        poles = np.linalg.eigvals(closed[np.ix_(kept, kept)])
        poles = poles[np.abs(poles - (1.0 if "sample" in how else 0.0)) > 1e-6]
        return np.abs(poles).max() - 1.0 if "sample" in how else poles.real.max()

    names = [channel.name for channel in margins.channels]
    for share, is_stable in ((0.999, True), (1.001, False)):
        change = 2.0 * (margins.factors - 1.0) / (margins.factors + 1.0) * share
        factors = (1.0 + 0.5 * change) / (1.0 - 0.5 * change)
        assert (growth(dict(zip(names, factors, strict=True))) < 0.0) == is_stable
    limited = 0
    for channel in margins.channels:
        for limit, beyond in zip(channel.gain, (0.999, 1.001), strict=True):
            if 0.0 < limit < math.inf:
                assert growth({channel.name: limit * beyond}) > 0.0
                assert growth({channel.name: limit / beyond}) < 0.0
                limited += 1
        if channel.phase < 180.0:
            both = [
                growth({channel.name: np.exp(1j * math.radians(channel.phase * x))})
                for x in (0.999, 1.001, -0.999, -1.001)
            ]
            assert both[0] < 0.0 and both[2] < 0.0
            assert both[1] > 0.0 or both[3] > 0.0
            limited += 1
    assert limited


@pytest.mark.parametrize("how", [{"sample": 0.02}, {"sample": 0.05, "delay": 0.03}])
@pytest.mark.parametrize("at", ["inputs", "outputs"])
def test_delay_margins_are_the_delays_at_which_the_exact_sampled_loop_is_unstable(
    joints, how, at
):
    lin, policy = joints
    margins = fflin.margins(policy, lin, at=at, **how)
    loop = loop_of(policy, lin, at=at, **how)
    delays = np.full(len(lin.input_names), loop.delay)
    for index, channel in enumerate(margins.channels):
        if math.isinf(channel.delay):
            continue

        def radius(extra, index=index):
            plant = loop.delayed_plant(index, extra, delays)
            return np.abs(np.linalg.eigvals(loop.closed(plant)[0])).max()

        assert (
            radius(channel.delay * (1.0 - 1e-4))
            < 1.0
            < radius(channel.delay * (1.0 + 1e-4))
        )
        earlier = np.linspace(0.0, channel.delay, 30)[:-1]
        assert max(map(radius, earlier)) < 1.0
    assert any(math.isfinite(channel.delay) for channel in margins.channels)


def test_gain_margins_are_the_factors_at_which_the_sampled_loop_is_unstable(joints):
    lin, policy = joints
    margins = fflin.margins(policy, lin, sample=0.05, delay=0.03)
    loop = loop_of(policy, lin, sample=0.05, delay=0.03)
    plant = loop.with_delays(np.full(len(lin.input_names), 0.03))
    A, B, C, *_ = plant
    for index, channel in enumerate(margins.channels):

        def growth(factor, index=index):
            factors = np.ones(len(lin.input_names))
            factors[index] = factor
            closed = A + (B * factors) @ loop.law.D @ C
            return np.abs(np.linalg.eigvals(closed)).max() - 1.0

        high = channel.gain[1]
        assert growth(high * (1.0 - 1e-6)) < 0.0 < growth(high * (1.0 + 1e-6))
        assert channel.disk >= margins.disk * (1.0 - 1e-6)
        least = (2.0 + channel.disk) / (2.0 - channel.disk)
        assert high >= least * (1.0 - 1e-6)


def test_a_continuous_loop_with_a_delay_has_the_margins_of_the_exponential(joints):
    lin, policy = joints
    tau = 0.04
    margins = fflin.margins(policy, lin, delay=tau)
    without = fflin.margins(policy, lin)
    if len(margins.channels) > 1:
        return
    # With one channel, the delay adds a phase alone.
    assert margins.channels[0].delay == pytest.approx(
        without.channels[0].delay - tau, rel=1e-8
    )
    w = margins.channels[0].phase_frequency
    lost = without.channels[0].phase - margins.channels[0].phase
    assert lost == pytest.approx(math.degrees(w * tau), rel=1e-8)


@pytest.mark.exhaustive
def test_the_bounds_of_many_channels_are_within_a_fifth():
    robot = fflin.load("canadarm2")
    lin = fflin.linearize(robot)
    sampled = lin.discretize(0.2)
    compensator = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-3, 1e-4))
    policy = fflin.OutputFeedback(sampled, compensator)
    margins = fflin.margins(policy, lin)
    assert margins.disk <= margins.disk_reached * (1.0 + 1e-9)
    assert margins.disk_reached <= 1.2 * margins.disk
    factors = margins.factors
    loop = loop_of(policy, lin)
    A, B, C, *_ = loop.with_delays(np.zeros(len(lin.input_names)))
    law = loop.law
    assert not law.D.any()
    wide = np.ones(len(lin.input_names), complex)
    wide[loop.channels] = factors
    closed = np.block([[A, (B * wide) @ law.C], [law.B @ C, law.A]])
    assert np.abs(np.abs(np.linalg.eigvals(closed)) - 1.0).min() < 1e-7
    # The gain with fixed scalings by the weights is at most as good.
    gain = fflin.lqr(sampled)
    assert fflin.margins(gain, sampled).disk >= gain.margins.disk * (1.0 - 2e-5)


def test_a_continuous_controller_is_sampled_for_its_margins(joints):
    lin, policy = joints
    # A first-order lag of the law of state feedback.
    K = policy.K
    count = len(K)
    fast = 50.0 * np.eye(count)
    system = (-fast, -fast @ K, np.eye(count), np.zeros(K.shape))
    controller = fflin.LinearController(system, lin)
    held = fflin.margins(controller, lin, sample=0.01)
    explicit = fflin.margins(controller.sampled(0.01), lin)
    assert held.disk == pytest.approx(explicit.disk, rel=1e-9)
    assert held.dt == 0.01 and held.disk < fflin.margins(controller, lin).disk


def test_an_unstable_loop_has_no_margins():
    _, lin = satellite()
    policy = fflin.StateFeedback(lin, -np.array(fflin.lqr(lin).K))
    margins = fflin.margins(policy, lin)
    assert not margins.stable and margins.disk == 0.0 and not margins.channels
    assert "the loop is unstable" in str(margins)


def test_margins_of_laws_that_do_not_fit_are_refused():
    robot, lin = satellite()
    gain = fflin.lqr(lin)
    other = fflin.linearize(robot.replace(inputs=[fflin.BaseForce()]))
    with pytest.raises(
        fflin.InputError, match="law and the model have different inputs"
    ):
        fflin.margins(gain, other)
    with pytest.raises(fflin.InputError, match="expected a linear law about a point"):
        fflin.margins(lambda t, q, v: np.zeros(3), lin)
    with pytest.raises(fflin.InputError, match="have different sample times"):
        fflin.margins(gain, lin.discretize(0.1), sample=0.2)
    with pytest.raises(fflin.InputError, match="delay is -1 s, expected at least 0"):
        fflin.margins(gain, lin, delay=-1.0)
    with pytest.raises(fflin.InputError, match="expected 'inputs' or 'outputs'"):
        fflin.margins(gain, lin, at="all")


def varied(seed=4):
    """Return a model, and a law whose gain is 20 % off, near instability at slow samples."""
    lin = fflin.linearize(fflin.load("planar_detumble"))
    K = np.array(fflin.lqr(lin).K)
    K *= 1.0 + 0.2 * np.random.default_rng(seed).standard_normal(K.shape)
    return lin, fflin.StateFeedback(lin, K)


@pytest.mark.parametrize("seed", [4, *exhaustive(*range(5, 14))])
def test_no_part_of_a_sample_below_the_delay_margin_makes_a_loop_unstable(seed):
    lin, policy = varied(seed)
    margins = fflin.margins(policy, lin, sample=0.3)
    loop = loop_of(policy, lin, sample=0.3)
    none = np.zeros(len(lin.input_names))
    for index, channel in enumerate(margins.channels):
        most = min(channel.delay, 3.0)
        for extra in np.linspace(0.0, most, 40)[1:-1]:
            F = loop.closed(loop.delayed_plant(index, extra, none))[0]
            assert np.abs(np.linalg.eigvals(F)).max() < 1.0


@pytest.mark.parametrize("delay", [1e-6, 1e-3])
@pytest.mark.exhaustive
def test_a_short_delay_changes_the_margins_of_a_continuous_loop_a_little(delay):
    lock = fflin.load("canadarm2").joint_names[2:]
    lin = fflin.linearize(fflin.load("canadarm2", lock=lock))
    gain = fflin.lqr(lin)
    without = fflin.margins(gain, lin)
    short = fflin.margins(gain, lin, delay=delay)
    assert short.stable and short.disk == pytest.approx(without.disk, rel=0.01)
    for one, other in zip(short.channels, without.channels, strict=True):
        assert one.phase == pytest.approx(other.phase, abs=0.2)
        assert one.delay == pytest.approx(other.delay - delay, rel=1e-2)


def test_an_output_that_feels_the_input_keeps_its_feedthrough_when_delayed():
    rng = np.random.default_rng(2)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 1))
    C, D = rng.normal(size=(1, 3)), np.ones((1, 1))
    held = HeldSystem(A, B, 0.1, np.array([0.13]))
    Ad, Bd = held.sampled()
    z, u = np.zeros(len(Ad)), rng.normal(size=6)
    for k in range(5):
        for s in (0.0, 0.02, 0.05, 0.09):
            Cs, Ds = held.outputs(C, D, s)
            arrived = math.floor((k * 0.1 + s - 0.13) / 0.1 + 1e-9)
            of_states, of_commands = held.after(s)
            x = of_states @ z + of_commands @ u[k : k + 1]
            expected = C @ x + (u[arrived] if arrived >= 0 else 0.0)
            assert Cs @ z + Ds @ u[k : k + 1] == pytest.approx(expected)
        z = Ad @ z + Bd @ u[k : k + 1]


def test_loops_without_gain_and_delays_of_many_samples_are_refused():
    lin = fflin.linearize(fflin.load("planar_detumble"))
    gain = fflin.lqr(lin)
    nothing = fflin.StateFeedback(lin, 0.0 * np.array(gain.K))
    with pytest.raises(fflin.InputError, match="the law has no gain"):
        fflin.margins(nothing, lin)
    with pytest.raises(fflin.InputError, match=r"more than 500 samples of 0\.1 s"):
        fflin.margins(gain, lin, sample=0.1, delay=1e5)
    for factor, sample, joint in ((6.0, 0.15, 1), (4.0, 0.2, 3)):
        K = np.array(gain.K)
        K[lin.input_names.index(f"tau_m.joint_{joint}")] *= factor
        margins = fflin.margins(fflin.StateFeedback(lin, K), lin, sample=sample)
        assert not margins.stable or min(x.delay for x in margins.channels) < 0.2


@pytest.mark.exhaustive
def test_a_model_without_delay_gets_the_delay_of_the_law(tmp_path):
    """The margins belong to the loop that `simulate` flies, unless a delay is given."""
    robot, lin = satellite()
    late = lin.discretize(0.25, delay={"tau_b.x": 0.1, "tau_b.y": 0.25, "tau_b.z": 0.4})
    gain = fflin.lqr(late)
    expected = fflin.margins(gain, late)
    early = fflin.margins(gain, lin, delay=0.0)
    assert early.disk > expected.disk + 1e-3
    for law in (gain, fflin.StateFeedback(late, gain)):
        for model in (lin, lin.discretize(0.25)):
            found = fflin.margins(law, model)
            assert found.delay == pytest.approx(0.4)
            assert found.disk == pytest.approx(expected.disk, rel=1e-9)
    gain.save(tmp_path / "gain.json")
    loaded = fflin.Gain.load(tmp_path / "gain.json")
    assert np.array_equal(loaded.delay, late.delay)
    assert fflin.margins(loaded, lin).disk == pytest.approx(expected.disk, rel=1e-9)
    # A file of an earlier version does not contain the delay.
    record = json.loads((tmp_path / "gain.json").read_text())
    for entry in ("delay", "sha256"):
        del record[entry]
    (tmp_path / "old.json").write_text(json.dumps(record))
    old = fflin.Gain.load(tmp_path / "old.json")
    with pytest.raises(fflin.InputError, match="designed for delayed inputs"):
        fflin.margins(old, lin)
    with pytest.raises(fflin.InputError, match="by an earlier version"):
        fflin.write_c(old, tmp_path / "c", robot=robot)
    assert fflin.StateFeedback(late, old).input_delays == law.input_delays
    assert fflin.margins(old, late).disk == pytest.approx(expected.disk, rel=1e-9)
    assert fflin.margins(old, lin, delay=0.4).stable


def test_a_gain_of_another_delay_or_of_a_negative_one_is_refused():
    _, lin = satellite()
    gain = fflin.lqr(lin.discretize(0.25, delay=0.3))
    with pytest.raises(fflin.InputError, match="another delay"):
        fflin.StateFeedback(lin.discretize(0.25, delay=0.35), gain)
    with pytest.raises(fflin.InputError, match="at least 0 s"):
        replace(gain, delay=-gain.delay)


@pytest.mark.exhaustive
def test_the_margins_of_an_allocation_are_those_of_its_inner_policy():
    robot, lin = satellite()
    late = lin.discretize(0.25, delay=0.1)
    for gain in (fflin.lqr(late), fflin.lqr(late, integral_action=["q_b"])):
        policy = fflin.StateFeedback(late, gain)
        expected = fflin.margins(policy, late)
        for model in (lin, late):
            found = fflin.margins(fflin.Allocation(policy, robot), model)
            assert found.disk == pytest.approx(expected.disk, rel=1e-9)


def test_the_margins_of_an_allocation_need_the_model_of_its_design():
    thruster = fflin.Thruster("base", (0.1, 0, 0), (0, 1, 0), max=0.1, lag=0.05)
    robot = fflin.load("cubesat", inputs=[thruster])
    design = robot.replace(inputs=[fflin.BaseTorque()])
    model = fflin.linearize(design).discretize(0.25)
    law = fflin.Allocation(fflin.StateFeedback(model, fflin.lqr(model)), design)
    message = r"model of its design, and the lag .* lin\.with_lags\({'tau_b': 0.05}\)"
    with pytest.raises(fflin.InputError, match=message):
        fflin.margins(law, fflin.linearize(robot))


@pytest.mark.parametrize("sample", [None, *exhaustive(0.5)])
def test_a_model_may_have_more_outputs_than_the_law_measures(sample):
    wheels = [fflin.ReactionWheel(axis, inertia=1e-5) for axis in np.eye(3)]
    sensors = [fflin.StarTracker(sample=sample), fflin.Gyroscope("base")]
    robot = fflin.load("cubesat", inputs=wheels, outputs=sensors)
    more = [fflin.JointVelocities(("wheel_*",)), *reversed(sensors)]
    model = fflin.linearize(robot).discretize(0.25)
    noise = {"v_b": 1e-6, "omega_b": 1e-10}
    compensator = fflin.lqg(fflin.lqr(model), fflin.kalman(model, noise, 1e-8))
    flown = fflin.OutputFeedback if sample is None else fflin.MultirateFeedback
    law = flown(model, compensator)
    larger = fflin.linearize(robot.replace(outputs=more))
    assert larger.output_names[0] == "qdot_m.wheel_1"
    margins = [fflin.margins(law, lin) for lin in (model, larger)]
    # The loops have the same states, signals and matrices.
    assert margins[0].disk == pytest.approx(margins[1].disk, rel=1e-9)
    assert 0.3 < margins[1].disk < 1.0
    causes = {"noise": {"gyroscope": 1e-5}}
    budgets = [fflin.error_budget(law, lin, **causes) for lin in (model, larger)]
    assert budgets[0].total[:3] == pytest.approx(budgets[1].total[:3], rel=1e-9)
    gyroscope = fflin.linearize(robot.replace(outputs=sensors[1:]))
    with pytest.raises(fflin.InputError, match="the law measures q_b"):
        fflin.margins(law, gyroscope)
