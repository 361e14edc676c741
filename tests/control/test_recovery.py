"""Process noise of a filter that gives the loop its margin, and compensators in files."""

import numpy as np
import pytest

import fflin
from fflin.analysis.output_hints import with_outputs
from fflin.control.lqg import compensator_of, disk_margin_with
from fflin.control.recovery import input_noise, recovering_filter
from fflin.control.saved_compensators import feedback_of, sampled_compensator
from fflin.control.slower_weights import LEAST_DISK


@pytest.fixture(scope="module")
def model():
    noise = {"noise_equivalent_angle": 10.0}
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.StarTracker(noise=noise)],
    )
    return fflin.linearize(robot).discretize(0.25)


def loop(model, inertia_of_weights=1e-4):
    """Return the regulator and the function that designs its filter."""
    gain = fflin.lqr(model, {"q_b": 1.0}, {"tau_b": 1.0 / inertia_of_weights})

    def filter_of(W):
        return fflin.kalman(model, W, G=model.B)

    return gain, filter_of


def disk(model, gain, filter_of, factor):
    compensator = compensator_of(gain, filter_of(input_noise(gain, factor)), None)
    return disk_margin_with(model, compensator)


def test_the_noise_is_the_least_power_of_ten_with_the_margin(model):
    gain, filter_of = loop(model)
    estimator, factor = recovering_filter(gain, model, filter_of)
    assert disk(model, gain, filter_of, factor) >= LEAST_DISK
    assert disk(model, gain, filter_of, 0.1 * factor) < LEAST_DISK
    expected = filter_of(input_noise(gain, factor))
    assert np.array_equal(estimator.L, expected.L)


def test_more_noise_at_the_inputs_raises_the_margin_towards_the_regulator(model):
    gain, filter_of = loop(model)
    margins = [disk(model, gain, filter_of, 10.0**k) for k in (-8, -6, -4)]
    assert margins == sorted(margins)
    assert margins[-1] < fflin.margins(gain, model).disk


def test_a_saved_compensator_keeps_its_delay_and_is_flown_as_designed(tmp_path):
    robot = fflin.load(
        "cubesat", inputs=[fflin.BaseTorque()], outputs=[fflin.BasePose()]
    )
    lin = fflin.linearize(robot)
    late = lin.discretize(0.25, delay=0.4)
    compensator = fflin.lqg(fflin.lqr(late), fflin.kalman(late, 1e-10, 1e-8))
    compensator.save(tmp_path / "law.mat")
    saved = sampled_compensator(tmp_path / "law.mat")
    assert np.array_equal(saved.delay, [0.4, 0.4, 0.4])
    policy = feedback_of(saved, lin)
    assert np.array_equal(policy.lin.A, late.A)
    assert np.array_equal(policy.loop, fflin.OutputFeedback(late, compensator).loop)


def test_a_compensator_leaves_further_inputs_of_the_robot_unchanged():
    outputs = [fflin.BasePose()]
    torque = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=outputs)
    model = fflin.linearize(torque).discretize(0.25, delay=0.25)
    noise = {"disturbance_noise": {"tau_b": 1e-12}}
    estimator = fflin.kalman(model, {"omega_b": 1e-10}, 1e-8, **noise)
    compensator = fflin.lqg(fflin.lqr(model), estimator)
    both = torque.replace(inputs=[fflin.BaseForce(), fflin.BaseTorque()])
    policy = feedback_of(compensator, fflin.linearize(both))
    names = policy.lin.input_names
    rows = [names.index(name) for name in compensator.output_names]
    assert np.array_equal(policy.system.C[rows], compensator.C)
    assert np.array_equal(policy.windup[:, rows], compensator.E)
    others = [i for i in range(len(names)) if i not in rows]
    assert others and not policy.system.C[others].any()
    assert not policy.windup[:, others].any()
    assert policy.lin.delay[rows].tolist() == [0.25] * 3
    assert not policy.lin.delay[others].any()


def test_a_multirate_filter_reports_a_bias_that_settles_slowly():
    def note(bias):
        sensors = [
            fflin.StarTracker(
                sample=0.5, delay=0.25, noise={"noise_equivalent_angle": 10.0}
            ),
            fflin.Gyroscope(
                "base",
                noise={"angle_random_walk": 0.1},
                bias={"bias_instability": bias},
            ),
        ]
        robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=sensors)
        model = fflin.linearize(robot).discretize(0.25)
        gain = fflin.lqr(model, {"q_b": 1.0}, {"tau_b": 1e4})
        compensator = fflin.lqg(gain, fflin.kalman(model, {"omega_b": 1e-10}))
        assert fflin.MultirateFeedback(model, compensator).notes == tuple(
            filter(None, [compensator.slow_bias])
        )
        return compensator.slow_bias

    assert note(100.0) == ""
    # The time constant is angle random walk over bias instability, 0.1 h/sqrt(h) / 1 deg/h.
    assert "time constant of 3" in note(1.0) and "bias.base.gyroscope" in note(1.0)


@pytest.mark.parametrize(
    ("message", "hint"),
    [
        ("no q_b.x, omega_b.x", 'type = "star_tracker"'),
        ("no q_b.x, r_b.z", 'type = "base"'),
        ("no q_m.a, qdot_m.a", 'type = "joints", joints = ["a"]'),
        ("no qdot_m.a", 'type = "rates", joints = ["a"]'),
        (
            "no " + ", ".join(f"qdot_m.wheel_{k}" for k in range(5)),
            'joints = ["wheel_*"]',
        ),
    ],
)
def test_the_output_that_measures_the_states_of_a_message_is_named(message, hint):
    text = with_outputs(message)
    assert text.startswith(f"{message}, such as [[output]] (type = ")
    assert f"{hint})" in text and text.count("[[output]]") == 1


def test_a_message_without_states_does_not_change():
    assert with_outputs("") == ""
    assert with_outputs("nothing to add") == "nothing to add"
