"""Error dynamics about a reference that moves: laws, closed forms, and `check`."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base.rotation import skew
from tests.support.robots import random_point


@pytest.mark.parametrize("name", ["cubesat", "servicer_7dof", "ets_vii", "panda"])
def test_check_holds_at_random_points(name):
    rng = np.random.default_rng(1)
    robot = fflin.load(name)
    for gravity in ((0, 0, 0), (0.3, -1.0, -3.7)):
        q, v, u = random_point(robot, rng)
        flying = robot.replace(gravity=gravity)
        lin = fflin.linearize(flying, q, v, u, moving=True)
        assert lin.moving and lin.frame == "local" and not lin.f0.any()
        result = fflin.check(flying, lin)
        assert result.ok, result


def test_kinematics_match_a_turning_reference():
    robot = fflin.load("cubesat")
    q, v, u = random_point(robot, np.random.default_rng(2))
    lin = fflin.linearize(robot, q, v, u, moving=True)
    w, linear = v[3:6], v[:3]
    E, O = np.eye(3), np.zeros((3, 3))
    assert lin.A[:6] == pytest.approx(
        np.block([[-skew(w), O, E / 2, O], [-2 * skew(linear), -skew(w), O, E]]),
        abs=1e-15,
    )


def test_error_of_two_motions_follows_the_model():
    """Two nearby motions of the robot: their error grows as the time-varying model says."""
    robot = fflin.load("canadarm2")
    rng = np.random.default_rng(3)
    q, v, u = random_point(robot, rng)
    v *= 0.3
    state = fflin.StateMap(robot)
    model, data = robot.model, robot.create_data()
    tau = state.lift(u)

    def step(q, v, h):
        # Fourth order by four small second-order steps is not needed: h^3 is below the error.
        a = pin.aba(model, data, q, v, tau)
        middle = pin.integrate(model, q, h / 2 * v + h * h / 8 * a)
        a_middle = pin.aba(model, data, middle, v + h / 2 * a, tau)
        return pin.integrate(model, q, h * v + h * h / 2 * a_middle), v + h * a_middle

    def error(q, v, q1, v1):
        relative = fflin.StateMap(
            robot, reference=pin.XYZQUATToSE3(q[:7]), frame="local"
        )
        return relative.to_state(q1, v1) - relative.to_state(q, v)

    lin = fflin.linearize(robot, q, v, u, moving=True)
    dx = 1e-5 * rng.normal(size=len(lin.x0))
    relative = fflin.StateMap(robot, reference=lin.reference, frame="local")
    q1, v1 = relative.to_pinocchio(lin.x0 + dx)
    h = 1e-4
    ahead = error(*step(q, v, h), *step(q1, v1, h))
    behind = error(*step(q, v, -h), *step(q1, v1, -h))
    rate = (ahead - behind) / (2 * h)
    # First order in dx (1e-5) and second in h.
    assert rate == pytest.approx(lin.A @ dx, abs=3e-4 * np.abs(rate).max())


def test_steady_spin_of_an_axisymmetric_body_has_its_nutation():
    """J1 = J2: about a spin s of the third axis the body nutates at (J3 - J1) / J1 s."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    inertia = pin.Inertia(10.0, np.zeros(3), np.diag([2.0, 2.0, 1.0]))
    model.appendBodyToJoint(1, inertia, pin.SE3.Identity())
    robot = fflin.from_model(model)
    v = fflin.velocity(robot, {"omega_b.z": 0.8})
    lin = fflin.linearize(robot, None, v, moving=True)
    poles = np.linalg.eigvals(lin.A[6:9, 6:9])
    assert np.sort(poles.imag) == pytest.approx([-0.4, 0.0, 0.4], abs=1e-12)


def test_moving_is_saved_and_options_that_contradict_are_refused(tmp_path):
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot, None, np.arange(6.0), moving=True)
    for ending in (".npz", ".mat", ".json"):
        lin.save(tmp_path / f"m{ending}")
        loaded = fflin.LinearModel.load(tmp_path / f"m{ending}")
        assert loaded.moving is True and fflin.check(robot, loaded).ok
    for options in ({"frame": "world"}, {"reference": pin.SE3.Identity()}):
        with pytest.raises(fflin.InputError, match="moving=True"):
            fflin.linearize(robot, moving=True, **options)
