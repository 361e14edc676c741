"""Flexible appendages and slosh: mass matrix, published frequencies, conservation, refusals."""

import math
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from scipy.special import jnp_zeros

import fflin
from fflin.base.errors import InputError
from fflin.dynamics.state import StateMap
from tests.support.robots import free_body

# Roots of cos b cosh b = -1: b = beta L of the modes of a clamped beam.
CLAMPED = (1.8751040687, 4.6940911330, 7.8547574382, 10.9955407349, 14.1371683910)


def clamped_roots(count):
    """Roots of cos b = -1 / cosh b by Newton's method, from (k - 1/2) pi."""
    b = (np.arange(1, count + 1) - 0.5) * np.pi
    for _ in range(50):
        b = b - (np.cos(b) + 1.0 / np.cosh(b)) / (-np.sin(b) - np.tanh(b) / np.cosh(b))
    return b


def beam(mass, length, stiffness, count, frame="root_joint"):
    """Euler-Bernoulli beam along x that bends along z, clamped at the frame, undamped."""
    b = clamped_roots(count)
    sigma = (np.sinh(b) - np.sin(b)) / (np.cosh(b) + np.cos(b))
    omega = b**2 * math.sqrt(stiffness / (mass * length**3))
    zero = np.zeros(count)
    translation = np.array([zero, zero, 2.0 * sigma * math.sqrt(mass) / b])
    rotation = np.array([zero, -2.0 * math.sqrt(mass) * length / b**2, zero])
    return fflin.FlexibleAppendage(
        frame, omega / (2.0 * np.pi), translation, rotation, damping=0.0, name="beam"
    )


def hub_with_rod(hub_mass, hub_inertia, mass, length):
    """One body: a hub at the origin, and a rigid thin rod along x from there."""
    hub = pin.Inertia(hub_mass, np.zeros(3), hub_inertia * np.eye(3))
    slender = mass * length**2 / 12.0 * np.diag([0.02, 1.0, 1.0])
    rod = pin.Inertia(mass, np.array([length / 2.0, 0.0, 0.0]), slender)
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    model.appendBodyToJoint(1, hub + rod, pin.SE3.Identity())
    model.addJointFrame(1)
    return fflin.from_model(model, name="hub")


def frequencies(lin):
    """Frequencies [rad/s] of the oscillations, ascending."""
    poles = np.linalg.eigvals(lin.A)
    return np.unique(np.round(np.sort(poles.imag[poles.imag > 1e-3]), 10))


@pytest.mark.parametrize(
    ("hub", "expected"),
    # 4.7300 and 7.8532 of the free-free beam, less what a light hub and eight modes leave; and a
    # hub of the mass m of the beam of length L, with the inertia m L^2 / 100.
    [((1e-4, 1e-6), (4.7295, 7.8523)), ((1.0, 0.01), (3.68184, 5.65171))],
)
def test_a_clamped_beam_on_a_hub_has_the_frequencies_of_the_free_beam(hub, expected):
    robot = hub_with_rod(*hub, 1.0, 1.0).replace(appendages=[beam(1.0, 1.0, 1.0, 8)])
    result = np.sqrt(frequencies(fflin.linearize(robot)))
    assert result[:2] == pytest.approx(expected, abs=6e-5 if hub[0] < 1.0 else 6e-6)


def test_effective_masses_of_a_beam_are_the_published_fractions():
    assert clamped_roots(5) == pytest.approx(CLAMPED, rel=1e-10)
    masses = beam(1.0, 1.0, 1.0, 3).translation[2] ** 2
    assert masses == pytest.approx((0.6131, 0.1883, 0.0648), abs=1e-4)


def test_the_arrays_of_the_bundled_inspector_are_uniform_beams_of_its_panels():
    robot = fflin.load("inspector_flexible.toml")
    assert robot.mass == pytest.approx(fflin.load("inspector").mass, rel=1e-12)
    # 12 kg and 2.1 m, clamped 0.05 m from the hinge line
    expected = beam(12.0, 2.1, 1.0, 2)
    bending = [0, 2]
    for side, sign in zip(robot.appendages, (1.0, -1.0), strict=True):
        across = expected.translation[2]
        about_hinge = -expected.rotation[1] + 0.05 * across
        assert side.translation[2, bending] == pytest.approx(across, abs=5e-5)
        assert sign * side.rotation[0, bending] == pytest.approx(about_hinge, abs=5e-5)
        ratio = expected.frequency[1] / expected.frequency[0]
        assert side.frequency[2] / side.frequency[0] == pytest.approx(ratio, rel=1e-3)
        torsion = 8.0 / np.pi**2 * 2.0 * 0.4514
        assert side.rotation[1, 1] ** 2 == pytest.approx(torsion, rel=1e-4)
    lin = fflin.linearize(robot)
    assert fflin.check(robot, lin).ok
    free = fflin.modes(lin).frequencies
    clamped = 2.0 * np.pi * np.repeat([0.25, 1.1, 1.567], 2)
    assert (np.sort(free) >= clamped - 1e-9).all()


def servicer():
    """Servicer with an array of three general modes on a panel that turns, and one on the base."""
    rng = np.random.default_rng(3)
    robot = fflin.load("servicer_7dof")
    on_panel = fflin.FlexibleAppendage(
        "panel_left_link",
        [0.2, 0.5, 0.9],
        0.4 * rng.normal(size=(3, 3)),
        0.1 * rng.normal(size=(3, 3)),
        damping=[0.01, 0.0, 0.3],
        name="left",
    )
    on_base = fflin.FlexibleAppendage(
        "base",
        [0.3, 0.8, 1.2],
        [[0.0, 6.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 8.0]],  # a torsion, and two bends
        [[3.0, 0.0, 1.0], [0.0, 1.0, 2.0], [0.0, 2.0, 0.0]],
        name="boom",
    )
    return robot, [on_panel, on_base]


def symmetric(robot, q):
    """M (6 + n, 6 + n) by CRBA, in state order."""
    upper = np.triu(pin.crba(robot.model, robot.create_data(), q))
    return StateMap(robot).project(upper + np.triu(upper, 1).T)


def postures(robot, rigid, seed):
    """The same random posture of both robots."""
    rng = np.random.default_rng(seed)
    joints = dict(zip(rigid.joint_names, rng.uniform(-1.0, 1.0, rigid.n), strict=True))
    turn = pin.SE3(pin.rpy.rpyToMatrix(*rng.normal(size=3)), rng.normal(size=3))
    return [fflin.configuration(item, joints, turn) for item in (robot, rigid)]


def participation(rigid, appendage, q):
    """J^T L (6 + n, k) of an appendage at a configuration of the robot without it."""
    data = rigid.create_data()
    frame = rigid.model.getFrameId(appendage.frame, pin.FrameType.BODY)
    J = pin.computeFrameJacobian(rigid.model, data, q, frame, pin.ReferenceFrame.LOCAL)
    return StateMap(rigid).columns(J).T @ np.vstack(
        (appendage.translation, appendage.rotation)
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_mass_matrix_is_the_rigid_one_bordered_by_the_participation(seed):
    rigid, appendages = servicer()
    robot = rigid.replace(appendages=appendages)
    q, q_rigid = postures(robot, rigid, seed)
    old = [
        *range(6),
        *(6 + robot.joint_names.index(name) for name in rigid.joint_names),
    ]
    expected = np.eye(6 + robot.n)
    expected[np.ix_(old, old)] = symmetric(rigid, q_rigid)
    for appendage in appendages:
        new = [6 + robot.joint_names.index(name) for name in appendage.modes]
        expected[np.ix_(old, new)] = participation(rigid, appendage, q_rigid)
        expected[np.ix_(new, old)] = expected[np.ix_(old, new)].T
    result = symmetric(robot, q)
    assert np.abs(result - expected).max() < 1e-12 * np.abs(expected).max()
    assert robot.mass == pytest.approx(rigid.mass, rel=1e-14)


def test_the_linear_model_matches_hybrid_coordinates():
    rigid, appendages = servicer()
    robot = rigid.replace(appendages=appendages)
    q, _ = postures(robot, rigid, 5)
    lin = fflin.linearize(robot, q=q, frame="local")
    M, n = symmetric(robot, q), robot.n
    K, D = np.zeros((6 + n, 6 + n)), np.zeros((6 + n, 6 + n))
    for appendage in appendages:
        for name, f, ratio in zip(
            appendage.modes, appendage.frequency, appendage.damping, strict=True
        ):
            at, omega = 6 + robot.joint_names.index(name), 2.0 * math.pi * f
            K[at, at], D[at, at] = omega**2, 2.0 * ratio * omega
    assert lin.A[6 + n :, 6 : 6 + n] == pytest.approx(
        -np.linalg.solve(M, K)[:, 6:], rel=1e-12
    )
    assert lin.A[6 + n :, 6 + n :] == pytest.approx(-np.linalg.solve(M, D), rel=1e-12)
    units = dict(zip(lin.state_names, lin.state_units, strict=True))
    assert units["q_m.boom_mode_1"] == "kg^0.5 m"
    assert units["qdot_m.boom_mode_1"] == "kg^0.5 m/s"
    assert not any("mode" in name for name in lin.input_names)


def full():
    """Servicer with appendages, a tank on springs, a pendulum and a wheel."""
    rigid, appendages = servicer()
    tank = fflin.Slosh(
        "base", 30.0, (0.1, 0.0, 0.3), frequency=0.2, damping=0.02, name="tank"
    )
    swing = fflin.Slosh(
        "base", 20.0, (0.0, 0.1, 0.0), length=0.4, axis=(1, 0, 0), name="swing"
    )
    wheel = fflin.ReactionWheel((0.0, 0.6, 0.8), inertia=0.1, name="wheel")
    return rigid.replace(
        inputs=[*rigid.inputs, wheel],
        appendages=[*appendages, tank, swing],
        gravity=(0, 0, -0.01),
    )


def displaced(robot, seed=7, size=0.1):
    """A configuration and velocity at which everything moves."""
    rng = np.random.default_rng(seed)
    state = StateMap(robot)
    return state.to_pinocchio(size * rng.normal(size=state.nx))


def test_check_holds_by_all_routes_at_rest_and_in_motion():
    robot = full()
    q, v = displaced(robot)
    for point in ({"q": q}, {"q": q, "v": v}, {"q": q, "v": v, "moving": True}):
        lin = fflin.linearize(robot, **point)
        assert fflin.check(robot, lin).ok


def test_states_are_converted_both_ways():
    robot = full()
    state = StateMap(robot)
    x = 0.1 * np.random.default_rng(2).normal(size=state.nx)
    q, v = state.to_pinocchio(x)
    assert state.to_state(q, v) == pytest.approx(x, rel=1e-13, abs=1e-15)
    mode = robot.joint("boom_mode_2")
    assert mode.value(q) == pytest.approx(
        x[state.names.index("q_m.boom_mode_2")], rel=1e-14
    )
    assert (
        fflin.configuration(robot, {"boom_mode_2": mode.value(q)})[mode.idx_q]
        == q[mode.idx_q]
    )


def test_momentum_and_energy_are_kept_without_damping():
    rigid, appendages = servicer()
    tank = fflin.Slosh("base", 30.0, (0.1, 0.0, 0.3), frequency=0.2, name="tank")
    robot = rigid.replace(appendages=[*appendages, tank], damping=0.0)
    robot = robot.replace(damping=dict.fromkeys((j.name for j in robot.modes), 0.0))
    q, v = displaced(robot, size=0.02)
    motions = [
        fflin.simulate(robot, q0=q, v0=v, duration=20.0, dt=dt, engine="python")
        for dt in (0.1, 0.05)
    ]
    for motion in motions:
        assert np.abs(motion.momentum - motion.momentum[0]).max() < 1e-13 * (
            np.abs(motion.momentum).max() + 1.0
        )
    drifts = [np.abs(motion.energy - motion.energy[0]).max() for motion in motions]
    assert drifts[0] / drifts[1] > 10.0  # of fourth order


def test_pendulum_under_thrust_swings_with_the_reduced_mass():
    # A free body of mass m0 without the liquid m1, both turning about nothing: the hinge is at the
    # centre of mass of the rest, so that a swing only shifts the body.
    m0, m1, length, thrust = 80.0, 20.0, 0.5, 30.0
    rest = pin.Inertia(m0, np.zeros(3), 1e9 * np.eye(3))
    liquid = pin.Inertia(m1, np.array([0.0, 0.0, -length]), np.zeros((3, 3)))
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    model.appendBodyToJoint(1, rest + liquid, pin.SE3.Identity())
    model.addJointFrame(1)
    robot = fflin.from_model(model, name="tank")
    robot = robot.replace(
        appendages=[
            fflin.Slosh("root_joint", m1, (0, 0, -length), length=length, name="fuel")
        ]
    )
    lin = fflin.linearize(robot, u=fflin.effort(robot, {"F_b.z": thrust}), moving=True)
    expected = math.sqrt(thrust / (m0 + m1) / length * (m0 + m1) / m0)
    result = frequencies(lin)
    assert result == pytest.approx([expected], rel=1e-6)


def test_springs_of_a_tank_match_its_frequency():
    robot = hub_with_rod(1e9, 1e9, 10.0, 1.0)
    tank = fflin.Slosh(
        "root_joint", 5.0, (0.3, 0, 0), frequency=0.4, damping=0.1, name="tank"
    )
    robot = robot.replace(appendages=[tank])
    assert robot.joint_names == ("tank_x", "tank_y")
    poles = np.linalg.eigvals(fflin.linearize(robot).A)
    oscillating = poles[poles.imag > 1e-3]
    assert np.abs(oscillating) == pytest.approx(0.8 * math.pi, rel=1e-7)
    assert -oscillating.real / np.abs(oscillating) == pytest.approx(0.1, rel=1e-7)
    lin = fflin.linearize(robot)
    assert lin.state_units[lin.state_names.index("q_m.tank_x")] == "m"


@pytest.mark.parametrize("fill", [0.05, 0.7, 2.0, 8.0])
def test_liquid_in_a_cylinder_has_the_published_moment(fill):
    # Force and moment about the bottom, walls and bottom included, of Housner's impulsive and
    # convective pressures (1957): the first mode acts at h1, by the weight of the shifted mass too.
    radius, a = 0.6, 3.0
    h = fill * radius
    tank = fflin.Slosh.cylinder(
        "base", radius, h, 900.0, a, bottom=(1, 2, 3), axis=(0, 2, 0)
    )
    k = jnp_zeros(1, 1)[0] / radius
    liquid = 900.0 * math.pi * radius**2 * h
    omega = 2.0 * math.pi * tank.frequency
    assert omega**2 == pytest.approx(a * k * math.tanh(k * h), rel=1e-9)
    assert tank.length == pytest.approx(a / omega**2, rel=1e-12)
    share = 2.0 * math.tanh(k * h) / (k * h * (k**2 * radius**2 - 1.0))
    assert tank.mass == pytest.approx(share * liquid, rel=1e-9)
    acts_at = h - (math.cosh(k * h) - 2.0) / (k * math.sinh(k * h))
    height = np.array(tank.position) - (1, 2, 3)
    assert height[1] + a / omega**2 == pytest.approx(acts_at, rel=1e-8)
    assert height[[0, 2]] == pytest.approx(0.0, abs=1e-15)
    on_springs = fflin.Slosh.cylinder("base", radius, h, 900.0, a, pendulum=False)
    assert on_springs.length is None
    with pytest.raises(InputError, match="radius of the tank"):
        fflin.Slosh.cylinder("base", -1.0, h, 900.0, a)


def test_a_mode_without_participation_swings_alone():
    robot = hub_with_rod(10.0, 1.0, 1.0, 1.0)
    flexible = fflin.FlexibleAppendage(
        "root_joint", 0.5, np.zeros((3, 1)), np.zeros((3, 1))
    )
    lin = fflin.linearize(robot.replace(appendages=[flexible]))
    rigid = fflin.linearize(robot)
    assert frequencies(lin) == pytest.approx([math.pi], rel=1e-4)
    assert lin.state_names[6] == "q_m.root_joint_mode_1"
    keep = [i for i, name in enumerate(lin.state_names) if "mode" not in name]
    assert lin.B[keep] == pytest.approx(rigid.B, rel=1e-13)


def test_wheels_and_modes_keep_each_other():
    robot = full()
    assert robot.replace(inputs=robot.inputs[:-1]).joint_names == tuple(
        name for name in robot.joint_names if name != "wheel"
    )
    assert robot.replace(appendages=[]).joint_names == tuple(
        name
        for name in robot.joint_names
        if name not in {joint.name for joint in robot.modes}
    )
    softer = robot.replace(stiffness={"boom_mode_1": 1.0, "joint_1": 5.0})
    assert softer.stiffness["boom_mode_1"] == 1.0
    assert softer.stiffness["boom_mode_2"] == robot.stiffness["boom_mode_2"]
    again = robot.replace(inputs=robot.inputs)
    assert again.stiffness == robot.stiffness


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"frequency": [0.5, -0.1]},
            "mode 2 of flexible appendage 'base' has the frequency -0.1 Hz",
        ),
        ({"frequency": [0.5, 0.0]}, "mode 2"),
        ({"damping": [0.1, 1.5]}, "mode 2"),
        ({"damping": [0.1, 0.1, 0.1]}, "shape"),
        ({"translation": np.zeros((2, 3))}, "expected \\(3, 2\\)"),
        ({"rotation": [[0, 0], [0, math.nan], [0, 0]]}, "rotation of"),
        ({"frequency": [[0.5, 0.1]]}, "expected k frequencies"),
        ({"frame": 3}, "expected a name"),
        ({"name": ""}, "expected a name"),
    ],
)
def test_wrong_numbers_are_refused_by_the_mode(change, message):
    given = {
        "frame": "base",
        "frequency": [0.5, 0.7],
        "translation": np.zeros((3, 2)),
        "rotation": np.zeros((3, 2)),
    }
    with pytest.raises(InputError, match=message):
        fflin.FlexibleAppendage(**(given | change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": 0.0}, "mass of slosh"),
        ({"frequency": None}, "neither a frequency nor a length"),
        (
            {"frequency": None, "length": 0.5, "damping": 0.1},
            "to which the ratio refers",
        ),
        ({"axis": (0, 0, 0)}, "axis of slosh 'base' is zero"),
        ({"damping": 2.0}, "ratio from 0 to 1"),
        ({"position": (0, 0)}, "three finite numbers"),
    ],
)
def test_wrong_liquids_are_refused(change, message):
    given = {"frame": "base", "mass": 5.0, "position": (0, 0, 0), "frequency": 0.5}
    with pytest.raises(InputError, match=message):
        fflin.Slosh(**(given | change))


def test_an_appendage_that_exceeds_its_link_is_refused():
    robot = hub_with_rod(1.0, 0.1, 1.0, 1.0)
    heavy = fflin.FlexibleAppendage("root_joint", [1.0, 2.0], [[0, 0], [0, 0], [0.5, 1.5]],
                                    np.zeros((3, 2)), name="array")  # fmt: skip
    with pytest.raises(
        InputError, match="modes up to 'array_mode_2' exceed the inertia"
    ):
        robot.replace(appendages=[heavy])
    liquid = fflin.Slosh("root_joint", 2.5, (0, 0, 0), frequency=0.1)
    with pytest.raises(InputError, match="'root_joint_slosh_x'"):
        robot.replace(appendages=[liquid])
    light = fflin.FlexibleAppendage("nowhere", 1.0, np.zeros((3, 1)), np.zeros((3, 1)))
    with pytest.raises(fflin.UnknownNameError, match="nowhere"):
        robot.replace(appendages=[light])
    for value in ("array", 5, [3]):
        with pytest.raises(InputError, match="appendage"):
            robot.replace(appendages=value)
    twin = fflin.Slosh("root_joint", 0.1, (0, 0, 0), frequency=0.1)
    with pytest.raises(InputError, match="'root_joint_slosh_x' has the name of"):
        robot.replace(appendages=[twin, twin])


def test_all_of_a_link_may_be_its_modes():
    # Modes in three directions, each with nearly all the mass: what is left of the link must stay
    # heavier than nothing, since CRBA adds up inertias by their masses.
    robot = hub_with_rod(0.0, 0.0, 1.0, 1.0)
    share = math.sqrt(0.95)
    three = fflin.FlexibleAppendage(
        "root_joint",
        [0.5, 0.6, 0.7],
        share * np.eye(3),
        0.5 * share * np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]),
    )
    flexible = robot.replace(appendages=[three])
    M = symmetric(flexible, flexible.neutral())
    assert M[6:, 6:] == pytest.approx(np.eye(3), abs=1e-13)
    assert M[3:6, 6:] == pytest.approx(three.translation, abs=1e-13)
    assert M[:3, 6:] == pytest.approx(three.rotation, abs=1e-13)
    q, v = displaced(flexible, size=1e-3)
    assert fflin.check(flexible, fflin.linearize(flexible, q=q, v=v)).ok
    assert all(first < second for first, second in pairwise((0.0, *frequencies(
        fflin.linearize(flexible)))))  # fmt: skip


def test_slosh_and_modes_must_leave_mass_to_a_body():
    robot = hub_with_rod(9.0, 1.0, 1.0, 1.0)
    all_liquid = fflin.Slosh(
        "root_joint", 10.0, (0.05, 0, 0), frequency=0.1, name="tank"
    )
    along = fflin.FlexibleAppendage(
        "root_joint", 1.0, [[0.0], [0.0], [1.0]], np.zeros((3, 1))
    )
    with pytest.raises(
        InputError, match=r"without the sloshing liquid|exceed the inertia"
    ):
        robot.replace(appendages=[all_liquid, along])


@pytest.mark.parametrize("size", [1e160, 1e200, 1e300])
def test_huge_participation_is_refused_by_the_mode(size):
    huge = fflin.FlexibleAppendage(
        "root_joint", 1.0, [[size], [0.0], [0.0]], np.zeros((3, 1))
    )
    with (
        np.errstate(over="ignore"),
        pytest.raises(InputError, match="'root_joint_mode_1'"),
    ):
        hub_with_rod(9.0, 1.0, 1.0, 1.0).replace(appendages=[huge])


@pytest.mark.parametrize("name", ["*", "a[1]", " ", "a\nb"])
def test_invalid_names_are_refused(name):
    with pytest.raises(InputError, match="of an appendage is"):
        fflin.FlexibleAppendage(
            "base", 1.0, np.zeros((3, 1)), np.zeros((3, 1)), name=name
        )


def test_a_mode_far_from_its_frame_keeps_its_place():
    # r = c x t rounds with the distance of the frame; what is left of it is no screw.
    far = pin.SE3(np.eye(3), np.array([1e3, 370.0, 210.0]))
    model = hub_with_rod(9.0, 1.0, 1.0, 1.0).model.copy()
    model.addFrame(pin.Frame("far", 1, far, pin.FrameType.OP_FRAME))
    robot = fflin.from_model(model, name="hub")
    t = np.array([[0.0], [0.0], [1.0]])
    r = -np.cross(far.translation, t[:, 0])[:, None]
    mode = fflin.FlexibleAppendage("far", 1.0, t, r, name="mode")
    flexible = robot.replace(appendages=[mode])
    M = symmetric(flexible, flexible.neutral())
    assert M[3:6, 6] == pytest.approx(t[:, 0], abs=1e-12)
    assert M[:3, 6] == pytest.approx(0.0, abs=1e-9)


def test_any_axis_of_a_tank_is_a_direction():
    for length in (1e-200, 1e200):
        tank = fflin.Slosh("base", 1.0, (0, 0, 0), frequency=1.0, axis=(0, 0, length))
        assert tank.axes == pytest.approx(np.eye(3))


def test_the_eigenvalue_of_a_refused_appendage_is_the_one_of_its_definition():
    """Compare the message of a mode with too large a moment with its definition."""
    hub = free_body((2.0, 3.0, 4.0))
    body = hub.model.inertias[1]
    turns = np.array([0.0, 0.0, 3.0])
    array = fflin.FlexibleAppendage(
        "base", [1.0], np.zeros((3, 1)), turns[:, None], name="array"
    )
    size = np.sqrt(np.trace(body.inertia) / (2.0 * body.mass))  # radius of gyration
    M = np.diag((*[body.mass] * 3, *np.diag(body.inertia) / size**2))
    L = np.concatenate((np.zeros(3), turns / size))
    expected = np.linalg.eigvalsh(M - np.outer(L, L))[0] / np.linalg.eigvalsh(M)[-1]
    with pytest.raises(fflin.InputError) as refusal:
        hub.replace(appendages=[array])
    assert f"has the eigenvalue {expected:.2g}, relative to" in str(refusal.value)
    assert "about the centre of mass with the radius of gyration" in str(refusal.value)
