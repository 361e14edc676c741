"""Constraints that close in motion, compared with captures and conservation laws."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.constraints import Constraints
from tests.simulation.test_constraints import GRIP, JOINTS, STEPS, off
from tests.support.robots import free_body


def arms():
    """Return a dual arm with its q and a velocity of all joints and the base."""
    robot = fflin.load("dual_arm")
    q = fflin.configuration(robot, JOINTS)
    return robot, q, 0.1 * np.random.default_rng(4).normal(size=robot.nv)


def test_a_latched_loop_keeps_momentum_and_loses_the_energy_of_the_jump():
    robot, q, v = arms()
    hit = fflin.latch(robot, GRIP, q=q, v=v)
    np.testing.assert_allclose(hit.momentum_after, hit.momentum, atol=1e-13)
    J = Constraints(hit.robot).jacobian(q)
    np.testing.assert_allclose(J @ hit.v, 0.0, atol=1e-14)
    M = pin.crba(robot.model, robot.create_data(), q)
    energies = [0.5 * rate @ M @ rate for rate in (v, hit.v)]
    assert hit.energy_lost == pytest.approx(energies[0] - energies[1], rel=1e-12)
    # The impulse on the frame changes the momenta M v.
    np.testing.assert_allclose(M @ (hit.v - v), J.T @ hit.impulse, atol=1e-13)
    assert np.abs(J @ v).max() > 0.01 and hit.event == "grip latched"


def test_a_body_that_hits_a_hinge_of_the_world_keeps_its_momentum_about_the_hinge():
    model = free_body((3.0, 4.0, 2.0)).model.copy()
    lever = pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0]))
    model.addFrame(pin.Frame("hook", 1, lever, pin.FrameType.OP_FRAME))
    robot = fflin.from_model(model, name="body")
    v = fflin.velocity(robot, {"v_b.y": 0.2})
    hit = fflin.latch(robot, fflin.Hinge("hook"), v=v)
    # About the hinge, m l v = (I + m l^2) w before and after.
    w = -50.0 * 0.5 * 0.2 / (2.0 + 50.0 * 0.5**2)
    assert hit.v[5] == pytest.approx(w, rel=1e-13)
    # The hinge takes the momentum of the centre of mass that is left over.
    change = 50.0 * (-w * 0.5 - 0.2)
    assert hit.impulse[1] == pytest.approx(change, rel=1e-12)
    assert np.abs(np.delete(hit.impulse, 1)).max() < 1e-14


def test_a_second_latch_keeps_the_first_one_closed():
    robot, q, v = arms()
    first = fflin.latch(robot, GRIP, q=q, v=v)
    second = fflin.latch(first.robot, fflin.Weld("base"), q=first.q, v=first.v)
    rows = Constraints(second.robot)
    assert len(second.robot.constraints) == 2 and second.event == "base latched"
    np.testing.assert_allclose(rows.jacobian(q) @ second.v, 0.0, atol=1e-14)
    # Orthogonal projections on a space, and then on a part of it, are one projection on the part.
    both = fflin.latch(robot, [GRIP, fflin.Weld("base")], q=q, v=v)
    np.testing.assert_allclose(second.v, both.v, atol=1e-14)


def test_approach_latch_and_release_are_phases_of_one_motion():
    robot, q, v = arms()
    approach = fflin.simulate(robot, q0=q, v0=v, duration=0.1, **STEPS)
    hit = fflin.latch(robot, GRIP, q=approach.q[-1], v=approach.v[-1])
    held = fflin.simulate(hit.robot, q0=hit.q, v0=hit.v, duration=0.2, **STEPS)
    opened = fflin.simulate(robot, q0=held.q[-1], v0=held.v[-1], duration=0.1, **STEPS)
    whole = approach.then(hit, held, opened)
    assert whole.phases == ("dual_arm", "grip latched", "grip released")
    np.testing.assert_allclose(
        whole.momentum, np.tile(whole.momentum[0], (len(whole.t), 1)), atol=1e-13
    )
    assert off(hit.robot, held)[0] < 1e-13
    rows = len(approach.t), len(approach.t) + len(held.t)
    forces = np.abs(whole.constraint_forces).max(axis=1)
    assert (forces[: rows[0]] == 0.0).all() and (forces[rows[1] :] == 0.0).all()
    assert forces[rows[0] : rows[1]].min() > 0.0
    assert any("grip latched" in note for note in whole.notes)


def test_what_cannot_latch_is_refused():
    robot, q, _ = arms()
    with pytest.raises(fflin.InputError, match="no constraint"):
        fflin.latch(robot, [])
    apart = fflin.Weld("tool_left", "tool_right", placement=pin.SE3.Identity())
    with pytest.raises(fflin.ConstraintError, match="tool_left/tool_right"):
        fflin.latch(robot, apart, q=q)


def test_a_pair_that_is_already_welded_is_refused():
    robot = fflin.load("dual_arm")
    grasp = fflin.Weld("tool_right", "tool_left", name="grasp")
    latched = fflin.latch(robot, grasp)
    again = [
        grasp,
        fflin.Weld("tool_right", "tool_left", name="second"),
        fflin.Weld("tool_left", "tool_right"),
        fflin.Spherical("tool_left", "tool_right"),
    ]
    for constraint in again:
        with pytest.raises(fflin.InputError, match=r"already welded .* 'grasp'"):
            fflin.latch(latched.robot, constraint, q=latched.q)
    held = fflin.latch(robot, fflin.Weld("base"))
    with pytest.raises(fflin.InputError, match="'base' is already welded to inertial"):
        fflin.latch(held.robot, fflin.Weld("base", name="other"))
    # A hinge may be locked afterwards.
    hinge = fflin.latch(robot, fflin.Hinge("tool_right", "tool_left"))
    assert len(fflin.latch(hinge.robot, grasp, q=hinge.q).robot.constraints) == 2
