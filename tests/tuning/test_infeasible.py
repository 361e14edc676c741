"""Goals that contradict each other: the least factor, the goals that are named, the messages."""

import numpy as np
import pytest

import fflin

LAW = fflin.PD("q_b", "tau_b", shared=True)


@pytest.fixture(scope="module")
def lin():
    robot = fflin.load(
        "cubesat", inputs=[fflin.BaseTorque()], outputs=[fflin.BasePose()]
    )
    return fflin.linearize(robot)


def inertia(lin):
    """Largest principal moment of inertia of a rigid satellite."""
    C = lin.C[[name.startswith("q_b") for name in lin.output_names]]
    return 1.0 / np.linalg.svd(C @ lin.A @ lin.B, compute_uv=False)[-1]


def deflection(largest):
    """The gain from a torque to the attitude is 1 / kp at the frequency 0."""
    return fflin.MaxGain("tau_b", "q_b", below=largest)


def effort(largest):
    """The gain from the measurement to the torque is kp + kd / lag at high frequencies."""
    return fflin.MaxGain("q_b", "tau_b", below=largest)


def pairs(seed, lin):
    """Goals of which the first two contradict each other in closed form, in a random order."""
    rng = np.random.default_rng(seed)
    J = inertia(lin)
    rate, gap = 10.0 ** rng.uniform(-1.5, 0.5), rng.uniform(1.3, 30.0)
    if seed % 2:
        # kp >= 1 / largest, but kp + kd / lag < kp.
        stiffness = J * rate**2
        two = [deflection(1.0 / stiffness), effort(stiffness / gap)]
    else:
        # The poles of lag J s^3 + J s^2 + (lag kp + kd) s + kp are left of -rate only if
        # kp + kd / lag > 3 rate^2 J.
        two = [fflin.Decay(rate), effort(3.0 * rate**2 * J / gap)]
    others = [fflin.Margin(rng.uniform(0.1, 0.5)), fflin.Damping(rng.uniform(0.1, 0.4))]
    goals = [*two, *others[: rng.integers(0, 3)]]
    hard = rng.random(len(goals)) < 0.3
    for goal, flag in zip(goals, hard, strict=True):
        object.__setattr__(goal, "hard", bool(flag))
    return goals, [goals[index] for index in rng.permutation(len(goals))]


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(12))
def test_the_pair_that_is_named_contradicts_in_closed_form(seed, lin):
    goals, mixed = pairs(seed, lin)
    tuned = fflin.tune(lin, LAW, mixed, starts=1, steps=30, seed=seed)
    assert not tuned.met and tuned.factor > 1.0
    assert {*tuned.conflict} == {goal.label for goal in goals[:2]}
    assert "contradict each other" in str(tuned).replace("\n  ", " ")


@pytest.mark.exhaustive
def test_a_goal_that_no_law_meets_is_named_alone(lin):
    # The sensitivity is 1 at high frequencies.
    sensitivity = fflin.MaxGain("q_b", "error.q_b", below=0.9)
    goals = [fflin.Margin(0.2), fflin.Decay(0.01), sensitivity]
    tuned = fflin.tune(lin, LAW, goals, starts=1, steps=20)
    assert tuned.conflict == (sensitivity.label,)
    assert tuned.factor >= 1.0 / 0.9 - 1e-9
    assert "even without the other goals" in str(tuned).replace("\n  ", " ")


def three(factor=1.0):
    """Goals that are met two at a time, but not together, with relaxed limits."""
    return [
        fflin.Margin(1.0 / factor, hard=True),
        fflin.MaxGain({"tau_b": 0.01}, {"q_b": 3e-5 * factor}),
        fflin.RollOff({"q_b": 1e-4}, {"tau_b": 1.0}, 8.0, 0.03 * factor),
    ]


@pytest.fixture(scope="module")
def stiff():
    robot = fflin.load(
        "servicer_7dof",
        lock=["joint_*", "panel_*"],
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose()],
    )
    return fflin.linearize(robot)


FILTERED = fflin.LowPass((0.5, 30.0), order=2) * LAW


@pytest.mark.exhaustive
def test_no_pair_is_named_if_the_goals_are_met_two_at_a_time(stiff):
    goals = three()
    tuned = fflin.tune(stiff, FILTERED, goals, starts=2, steps=60)
    assert {*tuned.conflict} == {goal.label for goal in goals}
    assert "no law that meets all" in str(tuned).replace("\n  ", " ")
    for index in range(3):
        pair = [*goals[:index], *goals[index + 1 :]]
        assert fflin.tune(stiff, FILTERED, pair, starts=2, steps=60).met


@pytest.mark.exhaustive
def test_the_least_factor_with_a_hard_goal_is_that_without(stiff):
    soft = [fflin.Margin(1.0), *three()[1:]]
    free = fflin.tune(stiff, FILTERED, soft, starts=2, steps=60)
    tuned = fflin.tune(stiff, FILTERED, three(), starts=2, steps=60)
    assert tuned.factor == pytest.approx(free.factor, rel=1e-3)
    relaxed = three(1.001 * tuned.factor)
    start = tuned.relaxed
    assert fflin.tune(stiff, FILTERED, relaxed, starts=1, steps=5, start=start).met


@pytest.mark.exhaustive
def test_the_law_of_the_factor_meets_the_relaxed_goals(lin):
    def goals(factor):
        return [deflection(0.5 * factor), effort(0.1 * factor)]

    tuned = fflin.tune(lin, LAW, goals(1.0), starts=1, steps=15)
    relaxed = goals(1.001 * tuned.factor)
    start = tuned.relaxed
    assert fflin.tune(lin, LAW, relaxed, starts=1, steps=1, start=start).met
    assert not fflin.tune(lin, LAW, goals(1.0), starts=1, steps=1, start=start).met


def test_the_relaxed_law_of_goals_that_hold_is_the_law(lin):
    tuned = fflin.tune(lin, LAW, fflin.Decay(0.01), starts=1, steps=5)
    assert tuned.met and tuned.relaxed == tuned.parameters and tuned.conflict == ()


@pytest.mark.parametrize(
    ("law", "start", "word"),
    [
        (LAW, {"kq": 1.0}, "give values of kp"),
        (LAW, {"kp": "much"}, "kp"),
        (fflin.PD("q_b", "tau_b", shared=True, kp=(1.0, 2.0)), {"kp": 3.0}, "1 to 2"),
        (fflin.PD("q_b", "tau_b", shared=True, kp=1.0), {"kp": 3.0}, "fixes"),
        (LAW, [1.0], "name"),
    ],
)
def test_wrong_start_values_are_refused(law, start, word, lin):
    with pytest.raises(fflin.InputError, match=word):
        fflin.tune(lin, law, fflin.Decay(0.01), starts=1, steps=1, start=start)


def test_goals_without_poles_in_their_band_hold(lin):
    far = fflin.Damping(0.5, band=(1e5, 1e6))
    tuned = fflin.tune(lin, LAW, far, starts=1, steps=3)
    assert tuned.met and tuned.factor == 0.0


def test_the_message_states_how_many_starts_were_unstable(lin):
    law = fflin.PD("q_b", "tau_b", shared=True, kp=(-2.0, -1.0), kd=1.0, lag=0.1)
    with pytest.raises(fflin.InputError, match="none of 2 starts reached a stable"):
        fflin.tune(lin, law, fflin.Decay(0.1), starts=2, steps=3)


def test_the_message_names_the_pole_that_no_law_moves(lin):
    law = fflin.PD("q_b.x", "tau_b.x")
    with pytest.raises(fflin.InputError, match="no law of this structure is stable"):
        fflin.tune(lin, law, fflin.MaxGain("tau_b", "q_b"), starts=1, steps=3)
