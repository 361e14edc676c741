"""Controllability against closed forms and exact rational arithmetic, and the names it gives."""

import re

import numpy as np
import pytest
from scipy.linalg import null_space

import fflin
from fflin import BaseForce, BaseTorque
from fflin.analysis.controllability import _named
from fflin.analysis.lasting_modes import _dominant
from tests.support import exact
from tests.support.mechanisms import mechanical, motors
from tests.support.messages import says
from tests.support.robots import BUNDLED, random_tree


def selection(lin):
    """S exactly, of inputs that each push on one coordinate."""
    S = np.round(lin.M @ lin.B[len(lin.M) :])
    assert set(np.unique(S)) <= {0.0, 1.0}
    return S


def holds_together(lin, result):
    """The laws of any answer, in units of energy."""
    nx = len(lin.A)
    assert result.dimension == len(result.controllable) == result.basis.shape[1]
    assert nx - result.dimension == len(result.uncontrollable) == len(result.rows)
    assert len(result.fixed_poles) == nx - result.dimension
    X = (lin.A - np.eye(nx)) / lin.dt if lin.dt else lin.A
    size = np.tile(np.sqrt(lin.M.diagonal()), 2)
    rows = result.rows / size
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    basis = result.basis * size[:, None]
    basis = basis / np.linalg.norm(basis, axis=0)
    A, B = X * size[:, None] / size, lin.B * size[:, None]
    scale = max(1.0, np.abs(A).max())
    assert np.abs(rows @ basis).max(initial=0.0) < 1e-9
    assert np.abs(rows @ B).max(initial=0.0) < 1e-9 * np.abs(B).max()
    assert np.abs(rows @ A @ basis).max(initial=0.0) < 1e-8 * scale
    assert not len(rows) or np.linalg.matrix_rank(rows) == len(rows)
    index = [lin.state_names.index(name) for name in result.controllable]
    assert (result.basis[index] == np.eye(result.dimension)).all()


@pytest.mark.parametrize("name", BUNDLED)
def test_no_springs_is_twice_the_rank(robots, name):
    robot = robots[name]
    joints = motors(robot)
    cases = {
        6 + robot.n: [BaseTorque(), BaseForce(), *joints],
        3 + robot.n: [BaseTorque(), *joints],
    }
    if robot.n:
        cases |= {robot.n: joints, 1: joints[-1:], 4: [BaseForce(), joints[0]]}
    for rank, inputs in cases.items():
        lin = fflin.linearize(robot.replace(inputs=inputs))
        for model in (lin, lin.discretize(0.1)):
            result = fflin.controllability(model)
            assert result.dimension == 2 * rank and result.method == "closed form"
            assert result.stabilizable == (rank == 6 + robot.n)
            assert (result.fixed_poles == (1.0 if model.dt else 0.0)).all()
            assert result.margin.kept > 1e6 and result.margin.dropped < 1e-2
            holds_together(model, result)


def test_unactuated_base_leaves_the_twelve_of_momentum(robots):
    """L1 = [0, M_b], L2 = [M_b N^-1, 0]: L1 A = 0, L2 A = L1, L B = 0."""
    robot = robots["servicer_7dof"]
    lin = fflin.linearize(robot.replace(inputs=motors(robot)))
    result = fflin.controllability(lin)
    L1, L2 = result.rows[:6], result.rows[6:]
    nv = 6 + robot.n
    N = lin.A[:nv, nv:]
    assert L1 == pytest.approx(np.hstack((np.zeros((6, nv)), lin.M[:6])), abs=1e-9)
    assert L2 == pytest.approx(
        np.hstack((lin.M[:6] @ np.linalg.inv(N), np.zeros((6, nv)))), abs=1e-9
    )
    assert result.uncontrollable[:6] == (
        *(f"angular momentum {axis}" for axis in "xyz"),
        *(f"linear momentum {axis}" for axis in "xyz"),
    )
    assert result.uncontrollable[6] == "base attitude x with the joints fixed"
    assert result.controllable == tuple(
        s for s in lin.state_names if s.startswith(("q_m", "qdot_m"))
    )
    assert says(str(result), "periodic joint motion")
    # The base moves as the joints do: v_b, omega_b = G qdot_m.
    G = -np.linalg.solve(lin.M[:6, :6], lin.M[:6, 6:])
    assert result.basis[nv : nv + 6, robot.n :] == pytest.approx(G, abs=1e-12)


def test_partly_actuated_bases_are_named(robots):
    robot = robots["ets_vii"]
    for wrench, kept, lost in (
        (BaseTorque(), "q_b", "linear momentum"),
        (BaseForce(), "r_b", "angular momentum"),
    ):
        lin = fflin.linearize(robot.replace(inputs=[wrench, *motors(robot)]))
        result = fflin.controllability(lin)
        assert len(result.uncontrollable) == 6
        assert {n.rsplit(" ", 1)[0] for n in result.uncontrollable[:3]} == {lost}
        assert sum(name.startswith(kept) for name in result.controllable) == 3
        assert ("periodic joint motion" in str(result)) == (lost == "angular momentum")


def test_three_wheels_put_the_attitude_anywhere(robots):
    """Three rotors on the hub, and an arm that is not driven: momentum stays, attitude does not."""
    import pinocchio as pin

    model = pin.Model()
    base = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(
        base,
        pin.Inertia(100.0, np.zeros(3), np.diag([20.0, 30.0, 25.0])),
        pin.SE3.Identity(),
    )
    for axis, kind in zip(
        "xyz", (pin.JointModelRUBX, pin.JointModelRUBY, pin.JointModelRUBZ), strict=True
    ):
        wheel = model.addJoint(base, kind(), pin.SE3.Identity(), f"wheel_{axis}")
        model.appendBodyToJoint(
            wheel, pin.Inertia(3.0, np.zeros(3), 0.05 * np.eye(3)), pin.SE3.Identity()
        )
    robot = fflin.from_model(model, name="wheels")
    result = fflin.controllability(fflin.linearize(robot.replace(inputs=motors(robot))))
    assert result.dimension == 6
    assert result.reach == {"base attitude": 3, "base position": 0, "joints": 3}
    two = fflin.controllability(fflin.linearize(robot.replace(inputs=motors(robot, 2))))
    assert two.reach["base attitude"] == 2


def test_thrusters_are_combined(robots):
    """Two parallel thrusters off the axis: a force and a torque, and no more."""
    robot = robots["cubesat"]
    frame = robot.model.frames[-1].name
    at = [(0.1, 0.0, 0.0), (-0.1, 0.0, 0.0)]
    inputs = [fflin.Thruster(frame, position, (0, 0, 1)) for position in at]
    lin = fflin.linearize(robot.replace(inputs=inputs))
    result = fflin.controllability(lin)
    assert result.dimension == 4
    assert result.controllable == ("q_b.y", "r_b.z", "omega_b.y", "v_b.z")
    holds_together(lin, result)
    third = fflin.Thruster(frame, (0.0, 0.0, 0.0), (0, 0, 1))
    lin = fflin.linearize(robot.replace(inputs=[*inputs, third]))
    assert fflin.controllability(lin).dimension == 4
    # One alone ties force and torque: their other combination is conserved.
    lin = fflin.linearize(robot.replace(inputs=inputs[:1]))
    one = fflin.controllability(lin)
    assert one.dimension == 2
    assert any(
        "angular momentum y" in n and "linear momentum z" in n
        for n in one.uncontrollable
    )
    holds_together(lin, one)


@pytest.mark.parametrize("name", [name for name in BUNDLED if name != "cubesat"])
def test_springs_and_dampers_against_exact_arithmetic(robots, name):
    robot, rng = robots[name], np.random.default_rng(3)
    for case in range(6):
        sprung = rng.random(robot.n) < 0.6
        damped = (rng.random(robot.n) < 0.5) & bool(case % 2)
        values = {
            j: float(rng.integers(1, 500))
            for j, s in zip(robot.joint_names, sprung, strict=True)
            if s
        }
        drag = {
            j: float(rng.integers(1, 9))
            for j, s in zip(robot.joint_names, damped, strict=True)
            if s
        }
        driven = [j for j in motors(robot) if rng.random() < 0.4] or motors(robot, 1)
        inputs = [*([BaseTorque()] if case == 2 else []), *driven]
        lin = fflin.linearize(
            robot.replace(inputs=inputs, stiffness=values, damping=drag)
        )
        K, D = (
            np.diag([0.0] * 6 + [d.get(j, 0.0) for j in robot.joint_names])
            for d in (values, drag)
        )
        expected = exact.dimension(lin.M, K, D, selection(lin))
        result = fflin.controllability(lin)
        assert result.dimension == expected, (case, values, drag, inputs)
        holds_together(lin, result)
        assert fflin.controllability(lin.discretize(0.01)).dimension == expected


@pytest.mark.parametrize("n", [1, 4, 12])
def test_random_trees_against_exact_arithmetic(n):
    rng = np.random.default_rng(n)
    for case in range(4):
        robot = random_tree(rng, n)
        at = {j: rng.uniform(-1, 1) for j in robot.joint_names}
        q = fflin.configuration(robot, at)
        stiffness = {
            j: float(rng.integers(1, 100))
            for j in robot.joint_names
            if rng.random() < 0.5
        }
        damping = {
            j: float(rng.integers(1, 5))
            for j in robot.joint_names
            if rng.random() < 0.3 * (case % 2)
        }
        inputs = motors(robot, 1 + n // 3)
        lin = fflin.linearize(
            robot.replace(inputs=inputs, stiffness=stiffness, damping=damping, rest=at),
            q,
        )
        K, D = (
            np.diag([0.0] * 6 + [d.get(j, 0.0) for j in robot.joint_names])
            for d in (stiffness, damping)
        )
        result = fflin.controllability(lin)
        assert result.dimension == exact.dimension(lin.M, K, D, selection(lin))
        holds_together(lin, result)


def repeated(rng, like, squares, drive, spread):
    """An undamped model with the given modes and modal inputs, all of them exact in floats.

    With P unimodular, M = P^T P and K = P^T diag(squares) P: the frequencies are as given.
    The coordinates are scaled by powers of two, as units do.
    """
    nv = len(squares)
    P = np.eye(nv) + np.diag(rng.integers(-1, 2, size=nv - 1), -1) @ np.diag(
        np.arange(nv) % 2
    )
    P = P[:, rng.permutation(nv)]
    P = P * 2.0 ** rng.integers(-spread, spread + 1, size=nv)
    S = P.T @ drive
    M, K = P.T @ P, P.T @ np.diag(squares) @ P
    return mechanical(M, K, np.zeros_like(M), S, like), M, K, S


@pytest.mark.parametrize("spread", [0, 8])
@pytest.mark.parametrize("seed", range(8))
def test_repeated_frequencies_against_exact_arithmetic(robots, seed, spread):
    rng = np.random.default_rng(seed)
    like = fflin.linearize(robots["ets_vii"])
    squares = np.array([0.0] * 5 + [4.0] * 3 + [9.0, 100.0, 100.0, 10000.0])
    drive = rng.integers(-2, 3, size=(12, 1 + seed % 3)) * (
        rng.random((12, 1 + seed % 3)) < 0.7
    )
    drive[0, 0] = 1
    lin, M, K, S = repeated(rng, like, squares, drive.astype(float), spread)
    groups = [squares == value for value in np.unique(squares)]
    formula = 2 * sum(np.linalg.matrix_rank(drive[group]) for group in groups)
    assert formula == exact.dimension(M, K, np.zeros_like(M), S)
    result = fflin.controllability(lin)
    assert result.dimension == formula
    assert result.stabilizable == (formula == 24)
    holds_together(lin, result)


def test_undriven_vibrations_are_named_with_their_poles(robots):
    rng = np.random.default_rng(0)
    like = fflin.linearize(robots["ets_vii"])
    squares = np.array([0.0] * 6 + [4.0, 4.0, 9.0, 16.0, 25.0, 36.0])
    drive = np.zeros((12, 7))
    drive[:6, :6] = np.eye(6)
    drive[6:10, 6] = 1.0
    lin, *_ = repeated(rng, like, squares, drive, 0)
    result = fflin.controllability(lin)
    assert result.dimension == 18
    speeds = sorted(abs(result.fixed_poles))
    assert speeds == pytest.approx([2.0, 2.0, 5.0, 5.0, 6.0, 6.0], rel=1e-9)
    assert result.fixed_poles.real == pytest.approx(0.0)
    assert np.sum(result.fixed_poles.imag) == pytest.approx(0.0)
    assert not result.stabilizable
    for speed in (2, 5, 6):
        assert (
            sum(f"vibration at {speed} rad/s" in name for name in result.uncontrollable)
            == 2
        )
    poles = np.linalg.eigvals(result.rows @ lin.A @ np.linalg.pinv(result.rows))
    assert np.sort(abs(poles)) == pytest.approx(speeds, rel=1e-6)


def test_sampling_at_a_period_loses_the_vibration(robots):
    robot = robots["servicer_7dof"]
    panel = {"panel_left": 100.0}
    lin = fflin.linearize(
        robot.replace(
            inputs=[BaseTorque(), BaseForce(), *motors(robot, 7)], stiffness=panel
        )
    )
    # Thirteen inputs and one spring; the other panel keeps its momentum.
    poles = np.linalg.eigvals(lin.A)
    speed = np.abs(poles.imag).max()
    assert fflin.controllability(lin).dimension == 28
    period = 2.0 * np.pi / speed
    assert fflin.controllability(lin.discretize(0.37 * period)).dimension == 28
    lost = fflin.controllability(lin.discretize(period))
    assert lost.dimension == 26
    assert np.sort(abs(lost.fixed_poles)) == pytest.approx(1.0, abs=1e-6)


def test_a_damped_undriven_spring_can_be_left_alone(robots):
    """Twin modes in one damping: their difference is not driven, but decays."""
    like = fflin.linearize(robots["ets_vii"])
    M = np.eye(12)
    K = np.diag([0.0] * 10 + [4.0, 4.0])
    D = 0.1 * K
    S = np.zeros((12, 11))
    S[:10, :10] = np.eye(10)
    S[10:, 10] = 1.0
    lin = mechanical(M, K, D, S, like)
    for model in (lin, lin.discretize(0.05)):
        result = fflin.controllability(model)
        assert result.dimension == 22 == exact.dimension(M, K, D, S)
        assert result.stabilizable
        holds_together(model, result)
    s = (
        result.fixed_poles
        if not model.dt
        else np.log(result.fixed_poles.astype(complex)) / 0.05
    )
    assert s.real == pytest.approx(-0.2, rel=1e-3)
    growing = mechanical(M, K, -D, S, like)
    assert not fflin.controllability(growing).stabilizable
    neutral = mechanical(M, 0.0 * K, D, S, like)
    assert not fflin.controllability(neutral).stabilizable


def test_off_rest_the_frozen_model_is_judged_and_said_so(robots):
    robot = robots["planar_detumble"]
    v = fflin.velocity(robot, {"omega_b.z": 0.2, "joint_1": 0.1})
    lin = fflin.linearize(robot.replace(inputs=motors(robot)), v=v)
    result = fflin.controllability(lin)
    assert result.method == "frozen" and "frozen" in str(result)
    reached = np.linalg.qr(result.basis)[0]
    outside = null_space(reached.T)
    assert np.abs(outside.T @ lin.B).max() < 1e-8
    # The momenta are not invariant under the frozen A, only the rows that A itself leaves out.
    others = result.rows[9:] / np.linalg.norm(result.rows[9:], axis=1, keepdims=True)
    assert result.bound == 9 and len(others) == 9 - result.dimension > 0
    assert np.abs(others @ lin.A @ reached).max() < 1e-8
    momenta = result.rows[:9] / np.linalg.norm(result.rows[:9], axis=1, keepdims=True)
    assert np.abs(momenta @ lin.A @ reached).max() > 1e-3
    full = fflin.controllability(fflin.linearize(robot, v=v))
    assert full.dimension == 12 + 2 * robot.n and full.stabilizable


@pytest.mark.exhaustive
def test_a_hundred_joints():
    rng = np.random.default_rng(5)
    robot = random_tree(rng, 100)
    at = {j: rng.uniform(-1, 1) for j in robot.joint_names}
    q = fflin.configuration(robot, at)
    for inputs, rank in (
        (robot.inputs, 106),
        (motors(robot), 100),
        (motors(robot, 7), 7),
    ):
        lin = fflin.linearize(robot.replace(inputs=inputs), q)
        result = fflin.controllability(lin)
        assert result.dimension == 2 * rank
    stiffness = {j: 50.0 for j in robot.joint_names[:10]}
    lin = fflin.linearize(
        robot.replace(inputs=motors(robot)[5:8], stiffness=stiffness, rest=at), q
    )
    K = np.diag([0.0] * 6 + [50.0] * 10 + [0.0] * 90)
    expected = exact.dimension(lin.M, K, 0.0 * K, selection(lin))
    assert fflin.controllability(lin).dimension == expected


def test_a_file_gives_the_same_answer(robots, tmp_path):
    robot = robots["dual_arm"]
    lin = fflin.linearize(
        robot.replace(inputs=motors(robot), stiffness={"left_1": 3.0})
    )
    lin.save(tmp_path / "m.json")
    result, again = map(
        fflin.controllability, (lin, fflin.LinearModel.load(tmp_path / "m.json"))
    )
    assert (
        result.rows == again.rows
    ).all() and result.uncontrollable == again.uncontrollable


def test_an_invalid_model_is_refused():
    with pytest.raises(fflin.InputError, match="LinearModel"):
        fflin.controllability(np.eye(3))


@pytest.mark.parametrize(("share", "dimension"), [(0.31, 30), (1.0, 28)])
def test_a_lost_vibration_is_lost_to_every_input(robots, share, dimension):
    robot = robots["servicer_7dof"].replace(stiffness={"panel_left": 100.0})
    lin = fflin.linearize(robot)
    period = 2.0 * np.pi / fflin.modes(lin).frequencies[-1]
    result = fflin.controllability(lin.discretize(share * period))
    assert result.dimension == dimension and result.stabilizable == (dimension == 30)


def test_states_are_named_whatever_the_basis_of_their_combinations_is():
    rng = np.random.default_rng(4)
    vectors = np.linalg.qr(rng.normal(size=(8, 2)))[0].T
    names = [f"x{k}" for k in range(8)]
    expected = _dominant(vectors, names)
    for angle in np.linspace(0.1, 3.0, 7):
        turn = np.array(
            [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
        )
        assert _dominant(turn @ vectors, names) == expected


@pytest.mark.parametrize("seed", range(5))
def test_names_of_uncontrollable_combinations_do_not_depend_on_units(seed):
    """In other units, x' = c x has the mass M / c^2, and the combinations are rows / c."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(3, 8))
    size, c = 10.0 ** rng.uniform(-2.0, 2.0, size=(2, 8))
    states = [f"x{k}" for k in range(8)]
    expected, names = _named(rows, states, size)
    result, others = _named(rows / c, states, size / c)
    terms = [re.findall(r"x\d", name) for name in names]
    assert [re.findall(r"x\d", name) for name in others] == terms
    # Each combination has a state of its own with the factor 1, and the largest terms first.
    for row, given, listed in zip(result, expected, terms, strict=True):
        (pivot,) = [k for k in range(8) if row[k] == 1.0 and given[k] == 1.0]
        assert row == pytest.approx(given * c[pivot] / c, rel=1e-9)
        sizes = np.abs(given) / size
        assert [f"x{k}" for k in np.argsort(-sizes)[:3]] == listed
