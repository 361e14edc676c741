"""Modes of the plant that no signal of the law or the goals depends on."""

import math

import numpy as np
import pytest
import scipy.linalg

import fflin
from fflin.tuning.minimal import reduction_of
from tests.support.marks import exhaustive

LAW = fflin.PD("q_b.x", "tau_b.x")
GOALS = [
    fflin.Margin(0.5),
    fflin.Damping(0.004, band=(1.0, 10.0)),
    fflin.Decay(0.005),
    fflin.RollOff({"q_b.x": 1e-4}, {"tau_b.x": 1.0}, above=8.0, below=5.0),
]
FREQUENCY, ROTATION = 0.45, 0.05

# Eigenvalues of three modes, and the frequencies [rad/s] at which responses are compared.
RATES = (1.0, 2.0, 5.0)
GRID = np.geomspace(0.1, 30.0, 40)


def wing(name, rotation, damping, frequency=FREQUENCY):
    return fflin.FlexibleAppendage(
        "base",
        frequency=[frequency],
        damping=[damping],
        translation=[[0.0], [0.0], [0.0 if name == "both" else 0.3]],
        rotation=[[rotation], [0.0], [0.0]],
        name=name,
    )


def satellite(*wings):
    return fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose()],
        appendages=wings,
    )


def equal_wings(damping=0.003, right=-ROTATION, frequency=FREQUENCY):
    """A satellite with two wings, which are equal by default."""
    left = wing("left", ROTATION, damping)
    return satellite(left, wing("right", right, damping, frequency))


def antisymmetric():
    """The same satellite with only the motion of the wings in opposite directions."""
    return satellite(wing("both", math.sqrt(2.0) * ROTATION, 0.003))


def modes(coupling_in, coupling_out, damping=0.01, change=0.0):
    """Three modes in mixed coordinates; the couplings (3, k) are their inputs and outputs."""
    blocks = [
        np.array([[0.0, 1.0], [-(rate**2), -2.0 * damping * rate]]) for rate in RATES
    ]
    A = scipy.linalg.block_diag(*blocks)
    # A spring between the last two modes.
    A[3, 4] = A[5, 2] = change
    B, C = np.zeros((6, 2)), np.zeros((2, 6))
    B[1::2], C[:, ::2] = coupling_in, np.transpose(coupling_out)
    mix = np.linalg.qr(np.random.default_rng(3).standard_normal((6, 6)))[0]
    return (
        mix @ A @ np.linalg.inv(mix),
        mix @ B,
        C @ np.linalg.inv(mix),
        np.zeros((2, 2)),
    )


def reduced(models, inputs=(0, 1), outputs=(True, True), dt=0.0):
    used = np.append(outputs, np.zeros(6, bool))
    return reduction_of(models, dt, used, inputs)


def rates_of(reduction, model):
    """Magnitudes [rad/s] of the poles of the reduced plant, one of each pair."""
    A, _, _ = reduction.of(*model[:3])
    poles = np.linalg.eigvals(A)
    return sorted(np.abs(poles[poles.imag > 0.0]).round(9).tolist())


def response(A, B, C):
    return np.array([C @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B) for w in GRID])


FIRST = ([1.0, 0.0], [0.0, 0.0], [0.0, 0.0])
BOTH = ([1.0, 0.0], [1.0, 0.0], [1.0, 0.0])


@pytest.mark.parametrize(
    ("coupling_in", "coupling_out", "kept"),
    [
        (FIRST, BOTH, [1.0]),
        (BOTH, FIRST, [1.0]),
        (BOTH, BOTH, [1.0, 2.0, 5.0]),
        # Each mode is reached and seen, but by one input and one output only.
        (np.ones((3, 2)), ([1.0, 0.0], [0.0, 1.0], [0.0, 0.0]), [1.0, 2.0]),
        (([1.0, 0.0], [0.0, 1.0], [0.0, 0.0]), np.ones((3, 2)), [1.0, 2.0]),
        (FIRST, ([0.0, 0.0], [1.0, 0.0], [0.0, 0.0]), []),
    ],
)
@pytest.mark.parametrize("damping", [0.01, 0.0])
def test_the_reduced_plant_has_the_same_response(
    coupling_in, coupling_out, kept, damping
):
    model = modes(coupling_in, coupling_out, damping)
    reduction = reduced([model])
    assert rates_of(reduction, model) == kept
    scale = np.abs(response(*model[:3])).max() + 1e-300
    difference = response(*reduction.of(*model[:3])) - response(*model[:3])
    assert np.abs(difference).max() < 1e-9 * scale or not kept
    # Without damping, the modes that are left out do not decay, and the report says so.
    assert bool(reduction.remarks) == (damping == 0.0 and len(kept) < 3)


def test_signals_that_neither_the_law_nor_a_goal_uses_do_not_count():
    model = modes(
        ([1.0, 0.0], [0.0, 1.0], [1.0, 0.0]), ([1.0, 0.0], [1.0, 0.0], [0.0, 1.0])
    )
    assert rates_of(reduced([model]), model) == [1.0, 2.0, 5.0]
    assert rates_of(reduced([model], inputs=(0,)), model) == [1.0, 5.0]
    assert rates_of(reduced([model], outputs=(True, False)), model) == [1.0, 2.0]


def test_a_mode_that_does_not_decay_remains_if_the_law_could_use_another_input():
    model = modes(([1.0, 0.0], [0.0, 1.0], [1.0, 0.0]), BOTH, damping=0.0)
    reduction = reduced([model], inputs=(0,))
    assert rates_of(reduction, model) == [1.0, 2.0, 5.0] and not reduction.remarks


@pytest.mark.parametrize("signals", [(FIRST, BOTH), (BOTH, FIRST)])
def test_a_mode_that_is_hidden_in_one_model_only_remains_in_all(signals):
    nominal = modes(*signals)
    alike = modes(*signals, damping=0.03)
    # The other model connects the last two modes, but neither of them with the signals.
    coupled = modes(*signals, change=0.5)
    assert rates_of(reduced([nominal, alike, coupled]), nominal) == [1.0]
    second = ([1.0, 0.0], [1e-3, 0.0], [0.0, 0.0])
    other = modes(*(second if one is FIRST else one for one in signals))
    assert rates_of(reduced([nominal, alike, other]), nominal) == [1.0, 2.0]
    # With both changes, the second mode also connects the third one.
    models = [nominal, other, coupled]
    assert rates_of(reduced(models), nominal) == [1.0, 2.0, 5.0]


def test_a_weak_coupling_is_undecided_and_remains():
    weak = modes(([1.0, 0.0], [1e-11, 0.0], [0.0, 0.0]), BOTH)
    reduction = reduced([weak])
    assert rates_of(reduction, weak) == [1.0, 2.0]
    (remark,) = reduction.remarks
    assert "rounding errors decide" in remark and "-0.02+2j" in remark.replace(
        "-2j", "+2j"
    )
    assert not reduced([modes(([1.0, 0.0], [1e-6, 0.0], [0.0, 0.0]), BOTH)]).remarks


def test_a_plant_without_hidden_modes_is_not_transformed():
    A, B, C, D = modes(BOTH, BOTH)
    found = reduced([(A, B, C, D)]).of(A, B, C)
    for matrix, same in zip(found, (A, B, C), strict=True):
        assert np.array_equal(matrix, same)


def plant_poles(robot, **time):
    """Poles [1/s] of the plant of a law from q_b.x to tau_b.x."""
    lin = fflin.linearize(robot)
    lin = lin.discretize(time["dt"]) if time else lin
    used = np.append(np.isin(lin.output_names, ["q_b.x"]), np.zeros(len(lin.A), bool))
    inputs = [lin.input_names.index("tau_b.x")]
    model = (lin.A, lin.B, lin.C, lin.D)
    A, _, _ = reduction_of([model], lin.dt, used, inputs).of(*model[:3])
    poles = np.linalg.eigvals(A)
    return np.log(poles.astype(complex)) / lin.dt if lin.dt else poles


@pytest.mark.parametrize("time", [{}, {"dt": 0.1}], ids=["continuous", "sampled"])
def test_equal_wings_have_the_poles_of_their_antisymmetric_mode(time):
    found = plant_poles(equal_wings(), **time)
    expected = plant_poles(antisymmetric(), **time)
    assert len(found) == len(expected) == 4
    assert max(found.imag) == pytest.approx(max(expected.imag), rel=1e-9)
    # If a wing has another sign or another frequency, both modes are connected with the torque.
    assert len(plant_poles(equal_wings(right=-0.9 * ROTATION), **time)) == 6
    assert len(plant_poles(equal_wings(frequency=1.01 * FREQUENCY), **time)) == 6


def tuned(robot, goals, steps, **time):
    lin = fflin.linearize(robot) if isinstance(robot, fflin.Robot) else robot
    return fflin.tune(lin, LAW, goals, starts=1, steps=steps, **time)


@pytest.mark.parametrize(
    ("goals", "steps", "time"),
    [
        (GOALS[1:2], 2, {}),
        *exhaustive((GOALS, 15, {}), (GOALS, 15, {"dt": 0.1, "delay": 0.1})),
    ],
)
def test_the_law_of_equal_wings_is_that_of_their_antisymmetric_mode(goals, steps, time):
    found = tuned(equal_wings(), goals, steps, **time)
    expected = tuned(antisymmetric(), goals, steps, **time)
    for name, value in expected.parameters.items():
        assert found.parameters[name] == pytest.approx(value, rel=1e-9)
    for one, other in zip(found.goals, expected.goals, strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-9)
    assert not found.remarks


def test_equal_wings_without_damping_are_no_dead_end():
    found = tuned(equal_wings(damping=0.0), GOALS[:1], 3)
    assert found.met
    (remark,) = found.remarks
    assert "not decaying: pole 2.9j 1/s" in remark
    assert remark[:30] in found.report() and remark in found.record()["remarks"]


@pytest.mark.exhaustive
@pytest.mark.parametrize("tied", [True, False])
def test_wings_that_vary_together_keep_their_symmetric_mode_hidden(tied):
    ranges = {"*_mode_1.frequency": {"range": 0.05, "tied": True}}
    if not tied:
        ranges = {f"{side}_mode_1.frequency": 0.05 for side in ("left", "right")}
    goals = [fflin.MaxGain({"tau_b.x": 0.01}, {"q_b.x": 1.0})]
    plant = fflin.uncertain(equal_wings(damping=0.0 if tied else 0.003), ranges)
    found = tuned(plant, [*goals, fflin.Damping(0.004)], 10)
    assert found.met == tied and bool(found.remarks) == tied
    assert math.isfinite(found.goals[0].bound)


@pytest.mark.exhaustive
def test_the_norm_of_equal_wings_is_that_of_their_antisymmetric_mode():
    pytest.importorskip("slycot")
    goal = fflin.MaxGain(
        {"tau_b.x": 0.01, "q_b.x": 1e-3}, {"q_b.x": 0.05, "tau_b.x": 1.0}
    )
    found, expected = (
        fflin.hinf(fflin.linearize(robot), goal, measured="q_b.x", inputs="tau_b.x")
        for robot in (equal_wings(), antisymmetric())
    )
    assert found.order == expected.order == 4
    assert found.gamma == pytest.approx(expected.gamma, rel=1e-6)
