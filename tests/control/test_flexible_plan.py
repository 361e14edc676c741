"""Plans of satellites with flexible appendages."""

import numpy as np
import pytest
import scipy.linalg

import fflin
from fflin.control.optimal.controlled_ends import controlled_ends
from fflin.control.optimal.shooting import Shooting
from tests.support.robots import winged_satellite

HALF_TURN = np.linspace(0.0, 24.0, 13)


def guess(robot, t=HALF_TURN):
    """Return the shooting of a roll of 30 deg, and its guess."""
    shooting = Shooting(robot, t, True)
    goal = fflin.configuration(robot, rpy=(30, 0, 0)), np.zeros(robot.nv)
    first = shooting.guess((robot.neutral(), np.zeros(robot.nv)), goal)
    return shooting, first


@pytest.mark.parametrize("frequency", [0.35, 3.0])
def test_jacobians_of_intervals_resolve_modes_that_are_not_excited(tmp_path, frequency):
    robot = winged_satellite(tmp_path, frequency)
    t = np.array([0.0, 2.0, 4.0])
    shooting = Shooting(robot, t, True)
    q = np.tile(robot.neutral(), (3, 1))
    v = np.zeros((3, robot.nv))
    u = np.zeros((3, 4))
    shooting.refine(q, v, u, 1e-6)
    ends, _ = shooting.jacobians(q, v, u)
    lin = fflin.linearize(robot, frame="local")
    size = np.where(np.arange(len(lin.A)) < 3, 2.0, 1.0)
    exact = size[:, None] * scipy.linalg.expm(2.0 * lin.A) / size
    modes = [i for i, name in enumerate(lin.state_names) if "mode" in name]
    difference = (ends[0, :, : len(exact)] - exact)[np.ix_(modes, modes)]
    assert np.abs(difference).max() < 0.05 * np.abs(exact[np.ix_(modes, modes)]).max()


def test_a_guess_moves_the_mass_of_the_wings(tmp_path):
    """The guess has the torques of the rigid satellite: springs carry the wings along."""
    _, (_, _, rigid) = guess(winged_satellite(tmp_path, None))
    _, (_, _, flexible) = guess(winged_satellite(tmp_path))
    assert flexible == pytest.approx(rigid, abs=1e-6 * np.abs(rigid).max())


def test_torques_choose_one_of_two_equal_wings(tmp_path):
    robot = winged_satellite(tmp_path)
    shooting, first = guess(robot)
    shooting.refine(*first, 1e-6)
    nx = shooting.state.nx
    wheels = [*shooting.wheels, *(nx // 2 + i for i in shooting.wheels)]
    # r_b and v_b are prescribed, although the momentum determines them
    asked = ~np.isin(np.arange(nx), wheels)
    chosen, importance = controlled_ends(shooting, *first, np.full(4, 100.0), asked)
    left = [shooting.state.names[i] for i in np.flatnonzero(asked & ~chosen)]
    assert left == ["q_m.right_mode_1", "qdot_m.right_mode_1"]
    assert (importance[:6] == 1.0).all()
    assert importance[shooting.deflections].min() > 100.0


def test_a_mode_that_is_too_fast_for_the_knots_is_named(tmp_path):
    robot = winged_satellite(tmp_path, 100.0)
    goal = fflin.configuration(robot, rpy=(30, 0, 0))
    with pytest.raises(fflin.InputError, match=r"oscillates .* give more knots"):
        fflin.plan(robot, (goal, None), 24.0, knots=13, free=["r_b", "v_b"])


@pytest.mark.exhaustive
@pytest.mark.parametrize(("frequency", "angle"), [(1.1, 5), (0.35, 120)])
def test_a_slew_of_a_flexible_satellite_ends_at_rest_and_is_tracked(
    tmp_path, frequency, angle
):
    robot = winged_satellite(tmp_path, frequency)
    goal = fflin.configuration(robot, rpy=(angle, 0, 0))
    duration = 40.0 if angle < 100 else 80.0
    knots = 21 if angle < 100 else 41
    motion = fflin.plan(robot, (goal, None), duration, knots=knots, free=["r_b", "v_b"])
    assert motion.optimality.stationary
    assert motion.residual.max() < 1e-5
    modes = [robot.joint(name) for name in ("left_mode_1", "right_mode_1")]
    deflections = motion.q[:, [joint.idx_q for joint in modes]]
    assert np.abs(deflections[-1]).max() < 1e-3 * np.abs(deflections).max()
    model = fflin.linearize(robot).discretize(0.25)
    law = fflin.StateFeedback(model, fflin.lqr(model))
    duration += 10.0
    flown = fflin.simulate(robot, law.follow(motion), duration=duration, dt=0.05)
    assert flown.attitude_error[-1] < 1e-3  # [deg]
