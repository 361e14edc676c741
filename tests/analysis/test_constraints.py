"""Analysis and designs of models of robots with constraints."""

import numpy as np
import pytest

import fflin
from tests.support.constrained import parallelogram, strut


def grasping(**fields):
    weld = fflin.Weld("tool_left", "tool_right")
    return fflin.load("dual_arm", constraints=[weld], **fields)


def test_a_loop_within_a_free_flyer_conserves_all_six_momenta():
    robot = grasping(inputs=[fflin.JointTorque("*")])
    lin = fflin.linearize(robot)
    assert fflin.controllability(lin).dimension == 4
    reduced = fflin.momentum_reduction(lin)
    assert len(reduced.momenta) == 6
    assert all(
        name.partition(".")[0] in ("q_m", "qdot_m") for name in reduced.state_names
    )
    # M* of the joints that remain, with the base free
    M = fflin.generalized_inertia(lin)
    # entries that are zero by symmetry are rounding errors
    rounding = 1e-12 * np.abs(M).max()
    np.testing.assert_allclose(reduced.M, M, rtol=1e-9, atol=rounding)
    gain = fflin.lqr(reduced)
    assert gain.poles.real.max() < 0.0


def test_a_loop_in_motion_conserves_momenta_too():
    robot = grasping(inputs=[fflin.JointTorque("*")])
    rng = np.random.default_rng(0)
    q, v = fflin.closed(robot, robot.neutral(), 0.1 * rng.normal(size=robot.nv))
    report = str(fflin.controllability(fflin.linearize(robot, q, v)))
    assert "no input can change" in report
    assert "linear momentum x/y/z" in report


def test_an_anchored_robot_conserves_no_momentum():
    robot = fflin.load(
        "dual_arm",
        constraints=[fflin.Weld("base")],
        inputs=[fflin.JointTorque("left_*")],
    )
    lin = fflin.linearize(robot)
    reduced = fflin.momentum_reduction(lin)
    # the arm without motors keeps the momenta of its four joints; the base has none
    assert len(reduced.momenta) == 4
    assert len(reduced.state_names) == 8


def test_modes_of_a_pressed_strut_have_the_frequency_and_energy_of_its_rods():
    robot = strut(1.2, 0.9, 40.0)
    u = fflin.effort(robot, {"slide": 60.0})
    modes = fflin.modes(fflin.linearize(robot, u=u, independent=["knee"]))
    (mode,) = modes.modes
    stiffness = 2.0 * (2.0 * 40.0 - 60.0 * 0.9)
    inertia = 2.0 * 1.2 * 0.9**2 / 3.0
    np.testing.assert_allclose(abs(mode.pole), np.sqrt(stiffness / inertia), rtol=1e-9)
    # both rods have the inertia m L^2/3 about their fixed ends and rotate alike
    np.testing.assert_allclose(mode.energy["base"], 0.5, atol=1e-9)
    np.testing.assert_allclose(mode.energy["knee"], 0.5, atol=1e-9)


def test_default_weights_give_no_gain_to_inputs_that_constraints_carry():
    robot = parallelogram(0.6, 1.5, 0.8, 1.1)
    gain = fflin.lqr(fflin.linearize(robot, independent=["left"]))
    assert gain.poles.real.max() < 0.0
    names = list(gain.input_names)
    carried = [names.index(name) for name in ("F_b.x", "F_b.y", "tau_b.x", "tau_b.z")]
    np.testing.assert_allclose(gain.K[carried], 0.0, atol=1e-12)
    assert np.abs(gain.K[names.index("tau_m.left")]).max() > 1e-2


def test_an_estimator_and_integral_action_work_in_the_independent_states():
    robot = grasping(outputs=["joints", "base", "gyroscope:base"])
    lin = fflin.linearize(robot)
    estimator = fflin.kalman(lin, 1e-3, 1e-4)
    assert estimator.poles.real.max() < 0.0
    gain = fflin.lqr(lin, integral_action=["q_b"])
    assert len(gain.poles) == len(lin.state_names) + 3
    assert fflin.observability(lin).dimension == len(lin.state_names)


@pytest.mark.parametrize("dt", [0.1])
def test_sampled_models_keep_their_independent_states(dt):
    lin = fflin.linearize(grasping())
    sampled = lin.discretize(dt)
    assert sampled.rank == 6
    assert sampled.independent == lin.independent
    assert np.abs(fflin.lqr(sampled).poles).max() < 1.0


@pytest.mark.parametrize(
    "function",
    [
        fflin.controllability,
        fflin.lqr,
        fflin.modes,
        fflin.momentum_reduction,
    ],
)
def test_a_model_without_states_is_refused(function):
    linkage = parallelogram(0.6, 1.5, 0.8, 1.1, gravity=0.0)
    crank = fflin.Weld("bar_end", name="crank")
    lin = fflin.linearize(linkage.replace(constraints=[*linkage.constraints, crank]))
    assert lin.state_names == ()
    with pytest.raises(fflin.InputError, match="leave no coordinate free"):
        function(lin)
    assert "none of these parameters changes A or B" in str(fflin.sensitivity(lin))
