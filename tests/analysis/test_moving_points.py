"""Controllability and observability at points that the robot leaves, and along motions."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin import BaseForce, BaseTorque
from fflin.analysis import moving_points
from tests.support.mechanisms import motors
from tests.support.messages import says
from tests.support.robots import BUNDLED, FRAMES, random_point, random_tree

EXHAUSTIVE = pytest.mark.exhaustive
ARMS = [name for name in BUNDLED if name != "cubesat"]


def flown(robot, q0, v0, u=None, knots=21, duration=1.0, parts=4):
    """A motion under constant inputs and its transition matrices, by Runge and Kutta."""
    linearizer = fflin.Linearizer(robot, moving=True)
    nv, nx = robot.nv, 12 + 2 * robot.n
    state = fflin.StateMap(robot, frame="local")
    t = np.linspace(0.0, duration, knots)
    h = t[1] / parts
    q, v, Phi = [q0], [v0], [np.eye(nx)]

    def rate(start, y):
        at = pin.integrate(robot.model, start, y[:nv])
        lin = linearizer(at, y[nv : 2 * nv], u)
        J = pin.dDifference(robot.model, start, at, pin.ArgumentPosition.ARG1)
        turn = lin.A @ y[2 * nv :].reshape(nx, nx)
        acceleration = state.spread(lin.drift[nx // 2 :])
        return np.concatenate((J @ y[nv : 2 * nv], acceleration, turn.ravel()))

    for _ in t[1:]:
        y = np.concatenate((np.zeros(nv), v[-1], Phi[-1].ravel()))
        for _ in range(parts):
            one = rate(q[-1], y)
            two = rate(q[-1], y + 0.5 * h * one)
            three = rate(q[-1], y + 0.5 * h * two)
            four = rate(q[-1], y + h * three)
            y = y + h / 6.0 * (one + 2.0 * two + 2.0 * three + four)
        q.append(pin.integrate(robot.model, q[-1], y[:nv]))
        v.append(y[nv : 2 * nv])
        Phi.append(y[2 * nv :].reshape(nx, nx))
    models = [linearizer(*point, u) for point in zip(q, v, strict=True)]
    return t, np.array(q), np.array(v), np.array(Phi), models


def turned(R):
    """Rotate the rows of the three conserved vectors."""
    return np.kron(np.eye(3), R)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.3, -1.0, -9.81)])
@pytest.mark.parametrize("frame", [*FRAMES, "moving"])
def test_rows_of_the_momenta_are_constant_along_the_motion(frame, gravity):
    """L B = 0 and dL/dt + L A = S L, with dL/dt by differences on an integrated motion."""
    robot = random_tree(np.random.default_rng(3), 4)
    robot = robot.replace(
        inputs=motors(robot), gravity=gravity, stiffness=3.0, damping=0.2
    )
    q0, v0, u0 = random_point(robot, np.random.default_rng(4))
    u = u0[6:]
    h = 1e-3
    _, q, v, *_ = flown(robot, q0, v0, u, knots=5, duration=4.0 * h)
    moving = frame == "moving"
    axes = (
        {"moving": True}
        if moving
        else {"frame": frame, "reference": pin.SE3.Identity()}
    )
    models = [
        fflin.linearize(robot, *point, u, **axes) for point in zip(q, v, strict=True)
    ]
    L = [moving_points.conserved(lin).rows for lin in models]
    if moving:
        L = [
            turned(pin.XYZQUATToSE3(at[:7]).rotation) @ rows
            for at, rows in zip(q, L, strict=True)
        ]
    rate = (8.0 * (L[3] - L[1]) - (L[4] - L[0])) / (12.0 * h)  # the error is O(h^4)
    lin, rows = models[2], L[2]
    S = np.zeros((9, 9))
    S[6:, 3:6] = np.eye(3) / robot.mass
    A = lin.A
    assert np.abs(rows @ lin.B).max() < 1e-12 * np.abs(rows).max() * np.abs(lin.B).max()
    size = np.abs(rows).max() * np.abs(A).max()
    assert np.abs(rate).max() > 1e-3 * np.abs(rows).max()
    assert np.abs(rate + rows @ A - S @ rows).max() < 1e-8 * size


def random_moving(rng, name, robots):
    robot = robots[name] if name else random_tree(rng, int(rng.integers(1, 9)))
    q, v, _ = random_point(robot, rng)
    return robot, q, v


@pytest.mark.parametrize("name", [*ARMS, ""])
def test_controllability_excludes_the_conserved_momenta(robots, name):
    rng = np.random.default_rng(len(name))
    robot, q, v = random_moving(rng, name, robots)
    nx = 12 + 2 * robot.n
    for wrench, conserved in (((), 9), ((BaseTorque(),), 6), ((BaseForce(),), 0)):
        pushed = robot.replace(inputs=[*wrench, *motors(robot)])
        for axes in ({}, {"frame": "world"}, {"moving": True}):
            continuous = fflin.linearize(pushed, q, v, **axes)
            for lin in (continuous, continuous.discretize(0.01)):
                result = fflin.controllability(lin)
                assert result.bound == nx - conserved >= result.dimension
                assert result.method == "frozen"
                assert result.stabilizable is (False if conserved else None)
                text = " ".join(str(result).split()).replace("not stabilizable", "")
                assert "frozen" in text and "stabilizable" not in text
                size = np.tile(np.sqrt(lin.M.diagonal()), 2)
                rows = result.rows / size
                rows /= np.linalg.norm(rows, axis=1, keepdims=True)
                basis = result.basis * size[:, None]
                basis /= np.linalg.norm(basis, axis=0)
                assert np.abs(rows @ basis).max(initial=0.0) < 1e-8
                assert len(rows) == nx - result.dimension == np.linalg.matrix_rank(rows)
                B = lin.B * size[:, None]
                assert (
                    np.abs(rows[:conserved] @ B).max(initial=0.0)
                    < 0.05 * np.abs(B).max()
                )


@pytest.mark.parametrize("name", ARMS)
def test_inputs_on_all_coordinates_control_all_states_in_motion(robots, name):
    robot, q, v = random_moving(np.random.default_rng(1), name, robots)
    lin = fflin.linearize(
        robot.replace(inputs=[BaseTorque(), BaseForce(), *motors(robot)]), q, v
    )
    result = fflin.controllability(lin)
    assert (
        result.dimension == len(lin.A)
        and result.method == "closed form"
        and result.stabilizable
    )
    assert says(str(result), "not an equilibrium")
    # Sampling may lose states, which the frozen matrices cannot exclude.
    assert fflin.controllability(lin.discretize(0.1)).stabilizable is None


def test_the_motion_of_one_joint_leaves_seventeen_of_twenty_six(robots):
    robot = robots["canadarm2"]
    robot = robot.replace(inputs=motors(robot))
    for velocity in ({"joint_1": 0.1}, {"omega_b.z": 0.1}):
        lin = fflin.linearize(robot, v=fflin.velocity(robot, velocity))
        result = fflin.controllability(lin)
        assert result.bound == 17 and result.stabilizable is False
        assert result.uncontrollable[:9] == (
            *(f"angular momentum {axis}" for axis in "xyz"),
            *(f"linear momentum {axis}" for axis in "xyz"),
            *(f"centre of mass {axis}" for axis in "xyz"),
        )
        assert says(
            str(result), "at most 17 of 26", "linear momentum x/y/z", "robot leaves"
        )


def gap(F, size):
    """The rank of a factor in units of energy, and its singular values beside the gap."""
    F = F * size[:, None]
    F = F / np.maximum(np.linalg.norm(F, axis=0), 1e-300)
    values = np.append(np.linalg.svd(F, compute_uv=False), 0.0)
    values /= values[0]
    rank = int((values > 1e-8).sum())
    return rank, values[rank - 1], values[rank]


SWINGS = [
    ("astrobee_arm", {"omega_b.z": 0.7, "v_b.x": 0.2}, "motors"),
    pytest.param(
        "planar_detumble",
        {"omega_b.z": 0.5, "joint_1": 1.0},
        "motors",
        marks=EXHAUSTIVE,
    ),
    ("planar_detumble", {"omega_b.x": 0.4, "joint_1": 1.0}, "torques"),
    pytest.param(
        "ets_vii", {"joint_2": 1.0, "omega_b.y": 0.3}, "motors", marks=EXHAUSTIVE
    ),
]


@pytest.mark.parametrize(("name", "velocity", "kind"), SWINGS)
def test_gramians_along_a_motion_have_the_rank_of_another_integration(
    robots, name, velocity, kind
):
    robot = robots[name]
    inputs = motors(robot) + ([BaseTorque()] if kind == "torques" else [])
    robot = robot.replace(
        inputs=inputs, outputs=[fflin.JointPositions(), fflin.JointVelocities()]
    )
    t, q, v, Phi, models = flown(
        robot, robot.neutral(), fflin.velocity(robot, velocity)
    )
    reached = [Phi[-1] @ np.linalg.solve(Phi[k], lin.B) for k, lin in enumerate(models)]
    seen = [(lin.C @ Phi[k]).T for k, lin in enumerate(models)]
    size = np.tile(np.sqrt(models[-1].M.diagonal()), 2)
    traj = fflin.linearize_trajectory(
        robot, t, q, v, np.zeros((len(t), models[0].B.shape[1]))
    )
    rank, kept, lost = gap(np.hstack(reached), size)
    shown, least, hidden = gap(np.hstack(seen), 1.0 / size)
    assert kept > 1e2 * lost and least > 1e2 * hidden
    for model in (traj, traj.discretize(t[1])):
        result = fflin.controllability(model)
        assert result.method == "Gramian" and result.dimension == result.bound == rank
        assert result.stabilizable is False and result.duration == 1.0
        assert says(str(result), f"{rank} of {len(size)}", "motion of 1 s")
        rows = result.rows / size
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        F = np.hstack(reached) * size[:, None]
        assert np.abs(rows @ F).max() < 1e-6 * np.abs(F).max()
        view = fflin.observability(model)
        assert view.dimension == shown and view.detectable is False
        hiding = view.basis * size[:, None]
        hiding /= np.linalg.norm(hiding, axis=0)
        O = np.hstack(seen) / size[:, None]
        assert np.abs(O.T @ hiding).max() < 1e-6 * np.abs(O).max()


@pytest.mark.parametrize("knots", [2, pytest.param(11, marks=EXHAUSTIVE)])
def test_a_trajectory_at_rest_gives_the_closed_form(robots, knots):
    robot = robots["astrobee_arm"]
    for inputs in (motors(robot), [BaseTorque(), *motors(robot)], robot.inputs):
        chosen = robot.replace(inputs=inputs)
        lin = fflin.linearize(chosen)
        still = fflin.controllability(lin)
        q = np.tile(lin.q, (knots, 1))
        v, u = np.zeros((knots, robot.nv)), np.zeros((knots, lin.B.shape[1]))
        t = np.linspace(40.0, 43.0, knots)  # when the trajectory starts has no effect
        traj = fflin.linearize_trajectory(chosen, t, q, v, u)
        result = fflin.controllability(traj)
        assert result.dimension == still.dimension and result.duration == 3.0
        assert result.stabilizable is still.stabilizable
        seen = fflin.observability(traj)
        assert seen.dimension == len(lin.A) and seen.detectable is True


def test_states_without_effect_on_outputs_are_unobservable_in_motion(robots):
    robot = robots["ets_vii"]
    v = fflin.velocity(robot, {"joint_2": 0.4, "omega_b.x": 0.2, "v_b.y": 0.1})
    sensors = {
        9: [fflin.JointPositions(), fflin.Gyroscope(robot.model.frames[-1].name)],
        3: [fflin.FrameVelocity(robot.model.frames[-1].name), fflin.JointPositions()],
    }
    for gravity in ((0.0, 0.0, 0.0), (0.0, 0.0, -9.81)):
        for hidden, outputs in sensors.items():
            chosen = robot.replace(outputs=outputs, gravity=gravity)
            for axes in ({}, {"moving": True}):
                lin = fflin.linearize(chosen, v=v, **axes)
                for model in (lin, lin.discretize(0.05)):
                    result = fflin.observability(model)
                    assert result.bound == 24 - hidden >= result.dimension
                    assert result.detectable is False and result.method == "frozen"
                    assert result.unobservable[:3] in (
                        ("q_b.x", "q_b.y", "q_b.z"),
                        ("r_b.x", "r_b.y", "r_b.z"),
                    )
                    assert says(
                        str(result), f"at most {24 - hidden} of 24", "not detectable"
                    )
    posed = robot.replace(outputs=[fflin.BasePose(), fflin.JointPositions()])
    lin = fflin.linearize(posed, v=v)
    result = fflin.observability(lin)
    assert (
        result.dimension == 24 and result.method == "closed form" and result.detectable
    )
    sampled = fflin.observability(lin.discretize(0.1))
    assert sampled.bound == 24 and sampled.detectable is None
    assert says(str(sampled), "detectability is undecided")
    whole = fflin.linearize(robot, v=v).discretize(0.1)
    assert fflin.observability(whole).detectable is True


def test_a_trajectory_decides_controllability_that_one_point_cannot(robots):
    """Force on the base alone: the frozen matrices leave it open, the motion does not."""
    robot = robots["astrobee_arm"]
    robot = robot.replace(inputs=[BaseForce(), *motors(robot)])
    v = fflin.velocity(robot, {"omega_b.z": 0.8, "omega_b.x": 0.5})
    assert fflin.controllability(fflin.linearize(robot, v=v)).stabilizable is None
    t, q, v, Phi, models = flown(robot, robot.neutral(), v)
    reached = [Phi[-1] @ np.linalg.solve(Phi[k], lin.B) for k, lin in enumerate(models)]
    size = np.tile(np.sqrt(models[-1].M.diagonal()), 2)
    rank, kept, lost = gap(np.hstack(reached), size)
    assert rank == 16 and kept > 1e2 * lost
    traj = fflin.linearize_trajectory(robot, t, q, v, np.zeros((len(t), 5)))
    result = fflin.controllability(traj)
    assert result.dimension == 16 and result.stabilizable is True


def test_models_from_files_are_refused_only_if_the_momenta_matter(robots, tmp_path):
    robot = robots["ets_vii"]
    v = fflin.velocity(robot, {"joint_1": 0.2})
    fflin.linearize(robot.replace(inputs=motors(robot)), v=v).save(
        tmp_path / "joints.json"
    )
    loaded = fflin.LinearModel.load(tmp_path / "joints.json")
    with pytest.raises(fflin.InputError, match="from a file"):
        fflin.controllability(loaded)
    fflin.linearize(robot, v=v).save(tmp_path / "all.json")
    assert (
        fflin.controllability(fflin.LinearModel.load(tmp_path / "all.json")).dimension
        == 24
    )
    assert fflin.observability(loaded).dimension == 24


def test_in_orbit_no_momentum_is_conserved(robots):
    robot = robots["ets_vii"]
    robot = robot.replace(
        inputs=motors(robot), outputs=[fflin.JointPositions()], orbit=700e3
    )
    lin = fflin.linearize(robot, v=fflin.velocity(robot, {"joint_1": 0.1}))
    result = fflin.controllability(lin)
    assert result.bound == 24 and result.stabilizable is None
    assert says(str(result), "stabilizability is undecided")
    # The gravity gradient depends on position and attitude, so that joints may reveal them.
    view = fflin.observability(lin)
    assert view.bound == 24 and view.detectable is None


def test_momentum_that_is_not_a_rate_is_not_removed(robots):
    robot = robots["ets_vii"]
    spun = fflin.velocity(robot, {"joint_1": 0.1})
    for inputs, text in (
        (motors(robot), "angular momentum x/y/z, linear momentum x/y/z"),
        ([BaseTorque(), *motors(robot)], "no input can change linear momentum x/y/z"),
    ):
        chosen = robot.replace(inputs=inputs)
        for axes in ({}, {"moving": True}):
            with pytest.raises(fflin.InputError, match="linearise at rest") as error:
                fflin.momentum_reduction(fflin.linearize(chosen, v=spun, **axes))
            assert text in str(error.value)
        drifting = fflin.velocity(robot, {"v_b.x": 0.1})
        reduced = fflin.momentum_reduction(fflin.linearize(chosen, v=drifting))
        assert len(reduced.A) == 2 * len(inputs) + 4 * (len(inputs) == 7)


def test_a_point_that_hardly_moves_is_undecided(robots):
    robot = robots["ets_vii"]
    robot = robot.replace(inputs=motors(robot))
    for speed, doubtful in ((4e-10, True), (5e-9, True), (1e-6, False)):
        lin = fflin.linearize(robot, v=fflin.velocity(robot, {"joint_1": speed}))
        notes = " ".join(fflin.controllability(lin).notes)
        assert ("largest rate" in notes) == doubtful


def test_a_changed_model_without_robot_is_refused(robots):
    robot = robots["ets_vii"]
    lin = fflin.linearize(
        robot.replace(inputs=motors(robot)), v=fflin.velocity(robot, {"joint_1": 0.2})
    )
    with pytest.raises(fflin.InputError, match="file"):
        fflin.controllability(replace(lin, _robot=None))
