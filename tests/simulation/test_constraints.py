"""Simulation of robots whose frames are held: closed forms, conserved quantities, phases."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.constraints import Constraints
from tests.support.marks import exhaustive
from tests.support.robots import free_body, random_tree

GRIP = fflin.Weld("tool_left", "tool_right", name="grip")
JOINTS = {
    "left_1": 0.4,
    "left_2": 0.7,
    "left_3": -0.5,
    "right_1": -0.3,
    "right_2": -0.6,
    "right_3": 0.8,
}
STEPS = {"dt": 0.05, "engine": "python"}


def dual_arm(*constraints):
    """Return a dual arm with constraints, and a closed q and v in motion."""
    robot = fflin.load("dual_arm").replace(constraints=constraints or [GRIP])
    q = fflin.closed(robot, fflin.configuration(robot, JOINTS))
    rates = 0.1 * np.random.default_rng(0).normal(size=robot.nv)
    return robot, *fflin.closed(robot, q, rates)


def off(robot, motion):
    """Return the largest residual and the largest rate of the rows in a motion."""
    rows = Constraints(robot)
    residuals = [np.abs(rows.residual(q)).max() for q in motion.q]
    rates = [
        np.abs(rows.jacobian(q) @ v).max()
        for q, v in zip(motion.q, motion.v, strict=True)
    ]
    return max(residuals), max(rates)


def test_a_loop_in_motion_stays_closed_and_keeps_momentum_and_energy():
    robot, q, v = dual_arm()
    motion = fflin.simulate(robot, q0=q, v0=v, duration=0.5, **STEPS)
    residual, rate = off(robot, motion)
    # Rounding errors of positions and rates below 10 m and 1 rad/s.
    assert residual < 1e-13 and rate < 1e-13
    assert motion.momentum_drift.max() < 1e-12 and motion.com_drift.max() < 1e-12
    # The method has order 4: 10 steps of 0.05 s at 0.1 rad/s.
    assert np.ptp(motion.energy) < 1e-9 * motion.energy[0]
    assert np.ptp(motion.x[:, 6:14], axis=0).min() > 1e-3


@pytest.mark.parametrize(
    "constraints",
    [
        pytest.param((GRIP,), id="loop"),
        pytest.param((fflin.Hinge("tool_left", axis=(1, 1, 0)),), id="inertial"),
    ],
)
def test_the_integrator_keeps_its_order(constraints):
    robot, q, v = dual_arm(*constraints)
    ends = [
        fflin.simulate(robot, q0=q, v0=v, duration=0.8, dt=dt, engine="python").x[-1]
        for dt in (0.4, 0.2, 0.1)
    ]
    first, second = (np.abs(a - b).max() for a, b in pairwise(ends))
    # Halving the step divides the error by 16; the next term changes this by less than 20 %.
    assert first / second == pytest.approx(16.0, rel=0.2)


PIVOT = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))


def hung(kind, **values):
    """Return a pendulum whose point 0.5 m above the centre of mass is held in the world."""
    model = free_body((3.0, 4.0, 2.0)).model.copy()
    model.addFrame(pin.Frame("pivot", 1, PIVOT, pin.FrameType.OP_FRAME))
    robot = fflin.from_model(model, name="pendulum")
    constraint = kind("pivot", placement=PIVOT, name="pivot", **values)
    return robot.replace(gravity=(0.0, 0.0, -9.0), constraints=[constraint])


def test_a_body_on_a_hinge_swings_as_a_pendulum():
    # (I + m l^2) d2a/dt2 = -m g l sin a about x, with the energy integral for the rate.
    robot = hung(fflin.Hinge, axis=(1.0, 0.0, 0.0))
    inertia, weight = 3.0 + 50.0 * 0.5**2, 50.0 * 9.0
    q = fflin.closed(robot, fflin.configuration(robot, rpy=(60, 0, 0)))
    motion = fflin.simulate(robot, q0=q, duration=0.5, dt=0.01, engine="python")
    angle = 2.0 * np.arcsin(motion.x[:, 0])
    rate = motion.x[:, 6]
    fallen = np.cos(angle) - np.cos(angle[0])
    # Order 4 in steps of 0.01 s at 3.4 rad/s.
    np.testing.assert_allclose(
        rate**2, 2.0 * weight * 0.5 * fallen / inertia, atol=1e-7
    )
    assert np.abs(motion.x[-1, 1:3]).max() < 1e-13
    # The pivot carries the weight and the centripetal force, along the body's z axis, and the
    # force of the tangential acceleration across it.
    named = dict(
        zip(motion.constraint_names, motion.constraint_forces[:-1].T, strict=True)
    )
    angle, rate = angle[:-1], rate[:-1]
    along = weight * np.cos(angle) + 50.0 * 0.5 * rate**2
    across = weight * np.sin(angle) * (1.0 - 50.0 * 0.5**2 / inertia)
    # In axes of the world, in which the placement has no rotation.
    y = across * np.cos(angle) - along * np.sin(angle)
    z = along * np.cos(angle) + across * np.sin(angle)
    np.testing.assert_allclose(named["pivot.force.x"], 0.0, atol=1e-9)
    np.testing.assert_allclose(named["pivot.force.y"], y, atol=1e-4)
    np.testing.assert_allclose(named["pivot.force.z"], z, atol=1e-4)


def test_the_reaction_of_the_world_is_part_of_the_expected_momentum():
    robot = hung(fflin.Spherical)
    q = fflin.closed(robot, fflin.configuration(robot, rpy=(20, 10, 0)))
    motion = fflin.simulate(robot, q0=q, duration=0.2, dt=0.005, engine="python")
    assert np.ptp(motion.momentum, axis=0).max() > 1.0
    # The impulse is integrated with order 4, as the motion.
    assert motion.momentum_drift.max() < 1e-8
    assert np.ptp(motion.energy) < 1e-8 * np.abs(motion.energy).max()


def test_redundant_rows_change_no_motion_and_the_note_names_them():
    again = fflin.Weld("tool_left", "tool_right", name="again")
    robot, q, v = dual_arm()
    twice, _, _ = dual_arm(GRIP, again)
    once = fflin.simulate(robot, q0=q, v0=v, duration=0.3, **STEPS)
    both = fflin.simulate(twice, q0=q, v0=v, duration=0.3, **STEPS)
    np.testing.assert_allclose(both.x, once.x, rtol=0.0, atol=1e-12)
    # Both constraints have the same rows, so the smallest forces are one half on each.
    half = 0.5 * once.constraint_forces
    np.testing.assert_allclose(
        both.constraint_forces, np.hstack((half, half)), atol=1e-12
    )
    assert any(
        "forces of grip, again are not determinate" in note for note in both.notes
    )
    assert not any("determinate" in note for note in once.notes)


def test_a_released_loop_is_a_phase():
    robot, q, v = dual_arm()
    held = fflin.simulate(robot, q0=q, v0=v, duration=0.2, **STEPS)
    free = robot.replace(constraints=[])
    opened = fflin.simulate(free, q0=held.q[-1], v0=held.v[-1], duration=0.2, **STEPS)
    whole = held.then(opened)
    assert whole.phases == ("dual_arm", "grip released")
    assert whole.constraint_names == held.constraint_names
    rows = len(held.t)
    assert (whole.constraint_forces[:rows] == held.constraint_forces).all()
    assert (whole.constraint_forces[rows:] == 0.0).all()
    assert np.ptp(whole.momentum, axis=0).max() < 1e-13
    # Without the forces of the grip, the tools move apart.
    assert off(robot, opened)[1] > 1e-3


def test_forces_are_saved_and_appear_in_the_report(tmp_path):
    robot, q, v = dual_arm()
    motion = fflin.simulate(robot, q0=q, v0=v, duration=0.1, **STEPS)
    for ending in ("npz", "json", "mat"):
        path = tmp_path / f"motion.{ending}"
        motion.save(path)
        again = fflin.Motion.load(path)
        assert again.constraint_names == motion.constraint_names
        np.testing.assert_array_equal(again.constraint_forces, motion.constraint_forces)
    force = np.linalg.norm(motion.constraint_forces[:, :3], axis=1).max()
    assert f"largest force of constraint 'grip': {force:.4g} N" in str(motion)


def test_a_start_off_the_constraints_is_refused_by_name():
    robot, q, _ = dual_arm()
    bent = pin.integrate(robot.model, q, np.full(robot.nv, 1e-3))
    with pytest.raises(fflin.ConstraintError, match="grip"):
        fflin.simulate(robot, q0=bent, duration=0.1, **STEPS)
    with pytest.raises(fflin.ConstraintError, match="grip"):
        fflin.simulate(robot, q0=q, v0=np.full(robot.nv, 0.1), duration=0.1, **STEPS)


def parallelogram():
    """Return a parallelogram of links of 1 m and 2 m between pivots of the base, held in the world.

    Its cranks turn at a constant rate, because the coupler only translates.
    """
    model = pin.Model()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.addJointFrame(root)
    body = pin.Inertia(2.0, np.zeros(3), 0.2 * np.eye(3))
    model.appendBodyToJoint(root, body, pin.SE3.Identity())

    def along(x):
        return pin.SE3(np.eye(3), np.array([x, 0.0, 0.0]))

    tips = {}
    links = (
        ("crank", root, 0.0, 1.0),
        ("coupler", 2, 1.0, 2.0),
        ("follower", root, 2.0, 1.0),
    )
    for name, parent, x, length in links:
        joint = model.addJoint(parent, pin.JointModelRZ(), along(x), name)
        model.appendBodyToJoint(joint, body, along(0.5 * length))
        tips[name] = pin.Frame(
            f"{name}_tip", joint, along(length), pin.FrameType.OP_FRAME
        )
    for tip in tips.values():
        model.addFrame(tip)
    model.addFrame(pin.Frame("base", root, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    held = fflin.Weld("base", placement=pin.SE3.Identity())
    joint = fflin.Spherical("coupler_tip", "follower_tip", placement=pin.SE3.Identity())
    robot = fflin.from_model(model, name="parallelogram")
    return robot.replace(constraints=[held, joint])


def turning(start):
    """Return a parallelogram with its q and v, at a crank angle [rad] and 1 rad/s towards zero."""
    robot = parallelogram()
    angles = {"crank": start, "coupler": -start, "follower": start}
    rates = {"crank": -1.0, "coupler": 1.0, "follower": -1.0}
    return robot, fflin.configuration(robot, angles), fflin.velocity(robot, rates)


def test_a_parallelogram_turns_at_a_constant_rate():
    robot, q, v = turning(1.0)
    motion = fflin.simulate(robot, q0=q, v0=v, duration=0.4, **STEPS)
    # Of 6 + 3 rows, the row across the plane is redundant.
    crank = motion.state_names.index("q_m.crank")
    # Order 4: the angles of the other links bend the rates of single links, not of the motion.
    np.testing.assert_allclose(motion.x[:, crank], 1.0 - motion.t, rtol=0.0, atol=1e-8)


def test_a_run_into_a_singular_posture_stops_and_says_so():
    # After 0.1 s, all links are on one line, where two of the constraints become one.
    robot, q, v = turning(0.1)
    motion = fflin.simulate(robot, q0=q, v0=v, duration=0.4, **STEPS)
    assert motion.t[-1] < 0.151 and "singular" in motion.stopped
    with pytest.raises(fflin.ConstraintError, match="singular"):
        fflin.simulate(*turning(0.0)[:1], q0=turning(0.0)[1], duration=0.1, **STEPS)


def test_a_row_that_vanishes_as_a_whole_is_a_singular_posture():
    # After 0.2 s, the row along the links vanishes: it does not follow from other rows.
    robot, q, v = turning(0.2)
    motion = fflin.simulate(robot, q0=q, v0=v, duration=0.4, **STEPS)
    assert motion.t[-1] < 0.251 and "singular" in motion.stopped


def test_orbits_and_loops_go_together_and_the_world_is_refused():
    robot, q, v = dual_arm()
    circling = robot.replace(orbit=500e3)
    motion = fflin.simulate(circling, q0=q, v0=v, duration=0.2, **STEPS)
    residual, rate = off(circling, motion)
    assert residual < 1e-13 and rate < 1e-13
    with pytest.raises(fflin.InputError, match="in orbit"):
        circling.replace(constraints=[fflin.Weld("tool_left")])


def random_robot(rng):
    """Return a random tree with one to three random constraints, and a closed q and v."""
    tree = random_tree(rng, int(rng.integers(3, 8)))
    model = tree.model.copy()
    for index in range(1, model.njoints):
        model.addJointFrame(index)
    names = list(model.names)[1:]
    items = []
    for number in range(int(rng.integers(1, 4))):
        kind = (fflin.Weld, fflin.Hinge, fflin.Spherical)[int(rng.integers(3))]
        one, other = rng.choice(len(names), 2, replace=False).tolist()
        to = names[other] if rng.random() < 0.8 else None
        items.append(kind(names[one], to, name=f"c{number}"))
    if rng.random() < 0.3:
        # A copy of a constraint adds only redundant rows.
        items.append(type(items[0])(items[0].frame, items[0].to, name="copy"))
    robot = fflin.from_model(model, name="random").replace(constraints=items)
    q = pin.integrate(model, robot.neutral(), rng.uniform(-1.0, 1.0, robot.nv))
    return robot, *fflin.closed(robot, q, 0.3 * rng.normal(size=robot.nv))


@pytest.mark.parametrize(
    "seed", [*range(3), *exhaustive(*range(3, 200))], ids=lambda seed: f"seed{seed}"
)
def test_random_constraints_stay_closed_and_loops_keep_momentum(seed):
    rng = np.random.default_rng(seed)
    try:
        robot, q, v = random_robot(rng)
        motion = fflin.simulate(
            robot, q0=q, v0=v, duration=0.02, dt=0.005, engine="python"
        )
    except fflin.ConstraintError as error:
        # By chance, random constraints are singular or hold nothing; then they are refused.
        assert "singular" in str(error) or "no effect" in str(error)
        return
    if motion.stopped:
        assert "singular" in motion.stopped or "diverged" in motion.stopped
        return
    residual, rate = off(robot, motion)
    # Rounding errors at rates of up to 100 rad/s.
    speed = 1.0 + np.abs(motion.v).max()
    assert residual < 1e-12 and rate < 1e-12 * speed
    if not robot.anchored:
        assert motion.momentum_drift.max() < 1e-12
