"""Inputs that balance a robot: laws, optimality against every active set, and refusals."""

from dataclasses import FrozenInstanceError
from itertools import combinations

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.state import Actuation, StateMap
from tests.support.robots import BUNDLED, FRAMES, random_pose, random_tree


def sprung(name, rng, **fields):
    """A robot in gravity on springs that pull, at random joints and attitude."""
    robot = fflin.load(name)
    robot = robot.replace(
        stiffness={joint: rng.uniform(1, 50) for joint in robot.joint_names},
        rest={joint: rng.normal() for joint in robot.joint_names},
        gravity=rng.normal(size=3),
        **fields,
    )
    joints = {joint: rng.uniform(-2, 2) for joint in robot.joint_names}
    return robot, fflin.configuration(robot, joints, random_pose(rng, 150.0))


@pytest.mark.parametrize("name", BUNDLED)
def test_a_balanced_robot_is_at_a_fixed_point(name):
    rng = np.random.default_rng(1)
    robot, q = sprung(name, rng)
    result = fflin.equilibrium(robot, q)
    lin = fflin.linearize(robot, q, u=result.u)
    assert not fflin.linearize(robot, q).is_equilibrium()
    # Balanced to the rounding of M^-1 times the forces.
    assert np.abs(lin.f0).max() < 1e-11 * np.abs(np.linalg.solve(lin.M, result.u)).max()
    assert lin.is_equilibrium(1e-8)
    # With one force for each coordinate it is their negative: of a spring, K (q - rest).
    floating = robot.replace(gravity=(0, 0, 0))
    u = fflin.equilibrium(floating, q).u
    state = StateMap(robot)
    stiffness, _, rest = robot.springs
    expected = np.concatenate(
        (np.zeros(6), stiffness * (state.joint_positions(q) - rest))
    )
    assert u == pytest.approx(expected, rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("frame", FRAMES)
def test_axes_match_the_frame_and_reference(frame):
    rng = np.random.default_rng(2)
    robot, q = sprung("ets_vii", rng)
    for reference in (None, pin.SE3.Identity(), random_pose(rng, 100.0)):
        u = fflin.equilibrium(robot, q, frame=frame, reference=reference).u
        lin = fflin.linearize(robot, q, u=u, frame=frame, reference=reference)
        assert lin.is_equilibrium(1e-9)
        assert np.linalg.norm(u[3:6]) == pytest.approx(
            robot.mass * np.linalg.norm(robot.gravity), rel=1e-12
        )
    # Against gravity in the world's own axes.
    if frame != "local":
        u = fflin.equilibrium(robot, q, frame=frame, reference=pin.SE3.Identity()).u
        assert u[3:6] == pytest.approx(-robot.mass * np.array(robot.gravity), rel=1e-12)


def thrusters(robot, rng, count):
    frames = [f.name for f in robot.model.frames if f.type == pin.FrameType.BODY]
    return [
        fflin.Thruster(str(rng.choice(frames)), rng.normal(size=3), rng.normal(size=3))
        for _ in range(count)
    ]


def least_by_every_active_set(C, d, one_sided):
    """The least u with C u = d and u[one_sided] >= 0 over all choices of what does not push."""
    best = None
    sided = np.flatnonzero(one_sided)
    for count in range(len(sided) + 1):
        for off in combinations(sided, count):
            on = np.setdiff1d(np.arange(C.shape[1]), off)
            u = np.zeros(C.shape[1])
            u[on] = np.linalg.pinv(C[:, on]) @ d
            feasible = np.linalg.norm(C @ u - d) < 1e-9 * np.linalg.norm(d)
            better = best is None or np.linalg.norm(u) < np.linalg.norm(best)
            if feasible and better and (u[sided] > -1e-12).all():
                best = u
    return best


@pytest.mark.parametrize("trials", [12, pytest.param(60, marks=pytest.mark.exhaustive)])
def test_least_norm_against_every_active_set(trials):
    """Random thrusters on a free body and on an arm, some with torques beside them."""
    rng = np.random.default_rng(3)
    balanced = refused = bound = 0
    for trial in range(trials):
        body = fflin.load(("cubesat", "planar_detumble")[trial % 2])
        n = body.n
        fans = thrusters(body, rng, int(rng.integers(5, 11)))
        torques = [fflin.BaseTorque()] if trial % 3 else []
        robot = body.replace(
            inputs=[
                *fans[:2],
                *torques,
                *fans[2:],
                *map(fflin.JointTorque, body.joint_names),
            ],
            gravity=rng.normal(size=3),
        )
        q = fflin.configuration(robot, dict.fromkeys(robot.joint_names, 0.7))
        free = fflin.linearize(body.replace(gravity=robot.gravity), q)
        d = -free.M @ free.f0[6 + n :]
        state = StateMap(robot)
        actuation = Actuation(state)
        C = actuation.columns(robot.create_data(), q)
        one_sided = np.isin(np.arange(C.shape[1]), actuation.groups["thrust"])
        expected = least_by_every_active_set(C, d, one_sided)
        if expected is None:
            refused += 1
            with pytest.raises(fflin.EquilibriumError, match="residual forces"):
                fflin.equilibrium(robot, q, tilt=False)
            continue
        balanced += 1
        u = fflin.equilibrium(robot, q).u
        bound += bool((u[one_sided] == 0.0).any())
        assert (u[one_sided] >= 0.0).all()
        assert u == pytest.approx(expected, rel=1e-8, abs=1e-9 * np.abs(expected).max())
        # Optimal: u is C^T y, cut off at zero where a thruster would have to pull.
        active = one_sided & (u == 0.0)
        y = np.linalg.lstsq(C[:, ~active].T, u[~active], rcond=None)[0]
        pull = C.T @ y
        assert pull[~active] == pytest.approx(u[~active], abs=1e-8 * np.abs(u).max())
        assert fflin.linearize(robot, q, u=u).is_equilibrium(1e-8)
    assert balanced >= trials // 4 and refused >= trials // 12 and bound >= trials // 6


def test_the_error_names_the_remaining_modes():
    heavy = fflin.load("servicer_7dof", gravity=(0, 0, -9.81), passive=["joint_2"])
    with pytest.raises(fflin.EquilibriumError, match=r"tau_m.joint_2 -?\d+ N m"):
        fflin.equilibrium(heavy)
    heavy = fflin.load("cubesat", gravity=(0, 0, -2.0), inputs=[fflin.BaseTorque()])
    with pytest.raises(fflin.EquilibriumError, match=f"F_b.z -{2 * heavy.mass:.3g} N"):
        fflin.equilibrium(heavy)
    # The other way round, thrusters cannot pull.
    up = fflin.Thruster("base", (0, 0, 0), (0, 0, 1))
    down = fflin.Thruster("base", (0, 0, 0), (0, 0, -1))
    lifted = heavy.replace(inputs=[fflin.BaseTorque(), up])
    assert fflin.equilibrium(lifted).u[3] == pytest.approx(2.0 * heavy.mass, rel=1e-12)
    with pytest.raises(fflin.EquilibriumError, match="thrusters"):
        fflin.equilibrium(heavy.replace(inputs=[fflin.BaseTorque(), down]))


def test_required_inputs_are_shown_with_units():
    robot = fflin.load("servicer_7dof", gravity=(0.0, 0.0, -9.81))
    result = fflin.equilibrium(robot)
    lines = str(result).splitlines()
    assert lines[0].startswith("u: ") and max(map(len, lines)) <= 80
    assert f"F_b.z = {9.81 * robot.mass:.6g} N" in str(result) and "tau_b.x" not in str(
        result
    )
    assert str(fflin.equilibrium(fflin.load("cubesat"))) == "u: all zero"


def test_nothing_to_balance_takes_nothing():
    """Exactly zero, also where no input could do anything, or rounding asks for something."""
    robot = fflin.load("ets_vii", inputs=[fflin.JointTorque("joint_1")])
    result = fflin.equilibrium(robot)
    assert result.u.shape == (1,) and not result.u.any() and not result.residual.any()
    rest = dict.fromkeys(robot.joint_names, 0.3)
    sprung = robot.replace(stiffness=1e3, rest=rest)
    slightly = {joint: 0.1 + 0.2 for joint in rest}  # 0.30000000000000004
    assert (
        np.abs(fflin.equilibrium(sprung, fflin.configuration(sprung, slightly)).u).max()
        < 1e-12
    )


def flexible(**fields):
    """A robot with motors in its arm and springs alone in its panels."""
    return fflin.load(
        "servicer_7dof", passive=["panel_*"], stiffness={"panel_*": 40.0}, **fields
    )


def test_passive_joints_relax_on_their_springs():
    """As after a catch that leaves them beside their rest: nothing else pulls."""
    robot = flexible(rest={"panel_left": 0.2})
    q = fflin.configuration(
        robot, {"joint_2": 0.4, "panel_left": 0.2 + 1e-6, "panel_right": 0.3}
    )
    held = fflin.equilibrium(robot, q)
    at = StateMap(robot).joint_positions(held.q)
    expected = {"joint_2": 0.4, "panel_left": 0.2}
    assert np.array_equal(held.q[:7], q[:7]) and not held.u.any()
    assert at == pytest.approx(
        [expected.get(n, 0.0) for n in robot.joint_names], abs=1e-15
    )
    assert (
        str(held)
        == "u: all zero\ndeflections: panel_left = -1e-06 rad, panel_right = -0.3 rad"
    )
    fflin.lqr(fflin.linearize(robot, held.q, u=held.u))
    again = fflin.equilibrium(robot, held.q)
    assert again.q == pytest.approx(held.q, abs=1e-15) and str(again) == "u: all zero"
    # What a motor holds, and what hangs on no spring, stays where it is given.
    bent = fflin.load("servicer_7dof", stiffness=40.0, inputs=[fflin.JointTorque("*")])
    assert np.array_equal(fflin.equilibrium(bent, q).q, q)


@pytest.mark.parametrize("seed", range(4))
def test_passive_joints_sag_under_gravity(seed):
    """Against Pinocchio's gravity, for some joints of a tree: q and u solve the static balance."""
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, 6)
    names = list(rng.choice(tree.joint_names, 3, replace=False))
    motors = [fflin.JointTorque(name) for name in tree.joint_names if name not in names]
    robot = tree.replace(
        inputs=[fflin.BaseTorque(), fflin.BaseForce(), *motors],
        gravity=rng.normal(size=3),
        stiffness=dict.fromkeys(names, 50.0 * tree.mass),
    )
    joints = {joint: rng.uniform(-1, 1) for joint in robot.joint_names}
    q = fflin.configuration(robot, joints, random_pose(rng, 100.0))
    for frame in FRAMES:
        held = fflin.equilibrium(robot, q, frame=frame, reference=pin.SE3.Identity())
        lin = fflin.linearize(
            robot, held.q, u=held.u, frame=frame, reference=pin.SE3.Identity()
        )
        assert lin.is_equilibrium(1e-9)
        state = StateMap(robot)
        at = state.joint_positions(held.q)
        robot.model.gravity.linear = np.array(robot.gravity)
        pull = pin.computeGeneralizedGravity(robot.model, robot.create_data(), held.q)
        robot.model.gravity.linear = np.zeros(3)
        soft = [robot.joint_names.index(name) for name in names]
        spring = 50.0 * tree.mass * at[soft]
        indices = [robot.joint(name).idx_v for name in names]
        assert -spring == pytest.approx(pull[indices], abs=1e-11 * np.abs(pull).max())
        assert held.sag[soft] == pytest.approx(
            at[soft] - [joints[name] for name in names]
        )
        stiff = np.setdiff1d(range(robot.n), soft)
        assert np.array_equal(at[stiff], state.joint_positions(q)[stiff])


def test_springs_that_give_no_hold_are_reported():
    """A pendulum that stands on a spring weaker than its weight, and beside it."""
    for gravity, words in ((20.0, "hold"), (1e5, "hold|settle")):
        robot = fflin.load(
            "planar_detumble", gravity=(-gravity, 0, 0), passive=["joint_2"]
        )
        robot = robot.replace(stiffness={"joint_2": 0.01})
        with pytest.raises(
            fflin.EquilibriumError, match=f"joint_2.*{words}|{words}.*joint_2"
        ):
            fflin.equilibrium(robot, fflin.configuration(robot, {"joint_2": 0.05}))


def test_in_orbit_panels_sag_against_the_gradient():
    robot = flexible(orbit=400e3)
    turned = pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.2, 0.3), np.zeros(3))
    for reference in (None, random_pose(np.random.default_rng(5), 40.0)):
        q = fflin.configuration(robot, base=turned)
        held = fflin.equilibrium(robot, q, reference=reference)
        assert 1e-9 < np.abs(
            held.sag
        ).max() < 1e-4 and "deflections: panel_left = " in str(held)
        lin = fflin.linearize(robot, held.q, u=held.u, reference=reference)
        assert lin.is_equilibrium(1e-12)
        # The spring's torque on a panel is that of the gradient.
        bare = fflin.linearize(
            robot.replace(stiffness={}), held.q, u=held.u, reference=reference
        )
        index = robot.joint_names.index("panel_left")
        force = (bare.M @ bare.f0[-len(bare.M) :])[6 + index]
        assert 40.0 * held.sag[index] == pytest.approx(force, rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_steady_motion_of_random_trees(seed):
    """A turn about the vertical and a drift in body axes, joints at rest."""
    rng = np.random.default_rng(seed)
    robot = random_tree(rng, 5).replace(
        gravity=(0.0, 3.0, -4.0), stiffness=2.0, damping=0.1
    )
    q = fflin.configuration(
        robot, dict.fromkeys(robot.joint_names, 0.4), random_pose(rng, 120.0)
    )
    axis = pin.XYZQUATToSE3(q[:7]).rotation.T @ np.array(robot.gravity)
    v = np.zeros(robot.nv)
    v[:3], v[3:6] = rng.normal(size=3), 0.3 * axis
    u = fflin.equilibrium(robot, q, v=v).u
    lin = fflin.linearize(robot, q, v, u, moving=True)
    assert lin.is_equilibrium(1e-9)
    assert not fflin.linearize(robot, q, v, moving=True).is_equilibrium()
    # A second later: the same error dynamics.
    later = fflin.linearize(robot, pin.integrate(robot.model, q, v), v, u, moving=True)
    assert later.A == pytest.approx(lin.A, abs=1e-10 * np.abs(lin.A).max())
    v[3:6] = 0.3 * rng.normal(size=3)
    with pytest.raises(fflin.EquilibriumError, match="vertical"):
        fflin.equilibrium(robot, q, v=v)
    v[3:6], v[6] = 0.0, 0.1
    with pytest.raises(fflin.EquilibriumError, match=r"q_m.joint_0 .*0.1"):
        fflin.equilibrium(robot, q, v=v)


def test_invalid_input_is_reported():
    robot = fflin.load("cubesat")
    with pytest.raises(fflin.InputError, match=r"\(1,\)"):
        fflin.equilibrium(robot, [0.0])
    with pytest.raises(fflin.InputError, match=r"fflin\.Robot"):
        fflin.equilibrium("cubesat")
    with pytest.raises(fflin.InputError, match="hybrid"):
        fflin.equilibrium(robot, frame="body")
    result = fflin.equilibrium(robot)
    assert result.force_names[:4] == ("tau_b.x", "tau_b.y", "tau_b.z", "F_b.x")
    with pytest.raises(FrozenInstanceError):
        result.u = 0
    with pytest.raises(ValueError, match="read-only"):
        result.u[0] = 1.0


def test_disturbed_inputs_hold_the_true_robot_at_rest():
    """Only the constant part counts: the periodic part starts at zero and is left out."""
    rng = np.random.default_rng(8)
    robot, q = sprung("ets_vii", rng)
    constant = {
        "tau_b": {"constant": (0.4, -0.2, 0.3)},
        "F_b": [(3.0, -5.0, 2.0), {"constant": (1.0, 2.0, -1.0), "axes": "base"}],
    }
    true = robot.replace(disturbance=constant)
    world = pin.SE3.Identity()
    u = fflin.equilibrium(true, q, reference=world, disturbed=True).u
    motion = fflin.simulate(true, lambda t, q, v: u, q0=q, duration=0.5)
    assert np.abs(motion.v).max() < 1e-10
    wave = {"amplitude": (9.0, 9.0, 9.0), "frequency": 1.0, "phase": 1.0}
    both = robot.replace(disturbance=constant | {"tau_b": [(0.4, -0.2, 0.3), wave]})
    again = fflin.equilibrium(both, q, reference=world, disturbed=True).u
    assert np.array_equal(again, u)


def test_by_default_the_inputs_are_those_of_the_undisturbed_model():
    rng = np.random.default_rng(8)
    robot, q = sprung("ets_vii", rng)
    true = robot.replace(disturbance={"tau_b": (0.4, -0.2, 0.3)})
    held = fflin.equilibrium(true, q)
    assert np.array_equal(held.u, fflin.equilibrium(robot, q).u)
    assert fflin.linearize(true, held.q, u=held.u).is_equilibrium(1e-8)


def test_wheels_take_up_a_constant_torque():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    wheels = [x for x in robot.inputs if isinstance(x, fflin.ReactionWheel)]
    torque = np.array((2e-5, -1e-5, 3e-5))
    true = robot.replace(inputs=wheels, disturbance={"tau_b": torque})
    held = fflin.equilibrium(true, disturbed=True)
    axes = np.array([wheel.axis for wheel in wheels]).T
    assert axes @ held.u == pytest.approx(torque, abs=1e-12)
    motion = fflin.simulate(true, lambda t, q, v: held.u, duration=1.0)
    assert np.abs(motion.x[:, :3]).max() < 1e-12


def test_thrusters_that_cannot_pull_against_a_disturbance_leave_it():
    thruster = fflin.Thruster("base", (0, 0, 0), (1, 0, 0), name="jet")
    robot = fflin.load("cubesat", inputs=[thruster])
    pushed = robot.replace(disturbance={"F_b": (-0.1, 0.0, 0.0)})
    assert fflin.equilibrium(pushed, disturbed=True).u == pytest.approx([0.1])
    pulled = robot.replace(disturbance={"F_b": (0.1, 0.0, 0.0)})
    with pytest.raises(fflin.EquilibriumError, match=r"F_b.x -?0.1 N"):
        fflin.equilibrium(pulled, disturbed=True)
