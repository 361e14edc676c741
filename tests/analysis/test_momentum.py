"""The reduction by conserved momenta, the generalised inertia and the generalised Jacobian."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin import BaseForce, BaseTorque, JointTorque
from tests.support.robots import BUNDLED, FRAMES, random_pose, random_tree

ARMS = [name for name in BUNDLED if name != "cubesat"]


def motors(robot):
    return [JointTorque(name) for name in robot.joint_names]


def transfer(lin, s):
    nx = len(lin.A)
    return lin.C @ np.linalg.solve(s * np.eye(nx) - lin.A, lin.B) + lin.D


def posed(robot, rng):
    return fflin.configuration(
        robot,
        {j: rng.uniform(-1, 1) for j in robot.joint_names},
        random_pose(rng, 50.0),
    )


@pytest.mark.parametrize("name", ARMS)
def test_unactuated_base_leaves_the_generalised_inertia(robots, name):
    """2n states, A = [[0, E], [0, 0]], B = [0; M*^-1], and (M^-1)_mm = M*^-1."""
    robot = robots[name]
    q = posed(robot, np.random.default_rng(1))
    lin = fflin.linearize(robot.replace(inputs=motors(robot)), q)
    reduced = fflin.momentum_reduction(lin)
    n = robot.n
    names = [
        *(f"q_m.{j}" for j in robot.joint_names),
        *(f"qdot_m.{j}" for j in robot.joint_names),
    ]
    assert list(reduced.state_names) == names and reduced.B.shape == (2 * n, n)
    assert (
        reduced.A == np.block([[np.zeros((n, n)), np.eye(n)], [np.zeros((n, 2 * n))]])
    ).all()
    M = lin.M
    schur = M[6:, 6:] - M[6:, :6] @ np.linalg.inv(M[:6, :6]) @ M[:6, 6:]
    assert fflin.generalized_inertia(lin) == pytest.approx(schur, rel=1e-9, abs=1e-9)
    assert reduced.M == pytest.approx(schur, rel=1e-9, abs=1e-9)
    assert schur @ reduced.B[n:] == pytest.approx(np.eye(n), abs=1e-8)
    assert np.linalg.inv(M)[6:, 6:] @ schur == pytest.approx(np.eye(n), abs=1e-8)
    result = fflin.controllability(reduced)
    assert result.dimension == 2 * n and result.stabilizable


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize(
    "wrench", [(), (BaseTorque(),), (BaseForce(),), (BaseTorque(), BaseForce())]
)
def test_transfer_function_is_kept(robots, name, wrench):
    """From every input to every output, with springs and dampers, in other axes too."""
    robot, rng = robots[name], np.random.default_rng(7)
    q = posed(robot, rng)
    at = dict(
        zip(
            robot.joint_names,
            fflin.linearize(robot, q).x0[6 : 6 + robot.n],
            strict=True,
        )
    )
    robot = robot.replace(
        inputs=[*wrench, *motors(robot)],
        outputs=[fflin.FullState(), fflin.FrameVelocity(robot.model.frames[-1].name)],
        stiffness={robot.joint_names[0]: 20.0},
        damping={robot.joint_names[-1]: 3.0},
        rest=at,
    )
    for frame in FRAMES:
        whole = fflin.linearize(robot, q, frame=frame, reference=pin.SE3.Identity())
        reduced = fflin.momentum_reduction(whole)
        assert len(reduced.A) == 2 * (robot.n + 3 * len(wrench))
        assert reduced.output_names == whole.output_names
        for s in (0.3 + 0.2j, 2.0 - 1.0j):
            one, two = transfer(whole, s), transfer(reduced, s)
            assert two == pytest.approx(one, abs=1e-8 * np.abs(one).max())
        sampled = fflin.momentum_reduction(whole.discretize(0.1))
        later = reduced.discretize(0.1)
        assert sampled.A == pytest.approx(later.A, abs=1e-8 * np.abs(later.A).max())
        assert sampled.B == pytest.approx(later.B, abs=1e-8 * np.abs(later.B).max())
        # What is left out of it is zero in it, and the maps undo each other.
        for rows in (reduced.momenta, reduced.coordinates):
            size = np.abs(rows).max(initial=0.0)
            assert np.abs(rows @ reduced.T).max(initial=0.0) <= 1e-9 * size
        assert reduced.S @ reduced.T == pytest.approx(np.eye(len(reduced.A)), abs=1e-12)
        assert len(reduced.momenta) == 6 - 3 * len(wrench)


def test_motions_without_momentum_match_the_reduced_model(robots):
    rng = np.random.default_rng(2)
    robot = robots["ets_vii"]
    whole = fflin.linearize(robot.replace(inputs=[BaseTorque(), *motors(robot)]))
    reduced = fflin.momentum_reduction(whole)
    z, u = rng.normal(size=len(reduced.A)), rng.normal(size=9)
    rate = whole.A @ reduced.T @ z + whole.B @ u
    assert rate == pytest.approx(reduced.T @ (reduced.A @ z + reduced.B @ u), abs=1e-12)
    # z = S x obeys the reduced model whatever the momentum.
    x = rng.normal(size=len(whole.A))
    rate = reduced.S @ (whole.A @ x + whole.B @ u)
    assert rate == pytest.approx(reduced.A @ reduced.S @ x + reduced.B @ u, abs=1e-12)


def test_random_trees_and_an_idle_joint():
    rng = np.random.default_rng(4)
    for n in (2, 7, 20):
        robot = random_tree(rng, n)
        q = posed(robot, rng)
        lin = fflin.linearize(robot.replace(inputs=motors(robot)[1:]), q)
        reduced = fflin.momentum_reduction(lin)
        assert len(reduced.A) == 2 * (n - 1)  # the idle joint keeps its momentum too
        assert reduced.S @ lin.B == pytest.approx(reduced.B, abs=0.0)
        assert reduced.M @ reduced.B[n - 1 :] == pytest.approx(np.eye(n - 1), abs=1e-9)


def test_nothing_conserved_keeps_all(robots):
    lin = fflin.linearize(robots["ets_vii"])
    reduced = fflin.momentum_reduction(lin)
    assert (
        (reduced.A == lin.A).all()
        and (reduced.B == lin.B).all()
        and not len(reduced.momenta)
    )
    assert (reduced.T == np.eye(24)).all()


def test_files_and_certificates(robots, tmp_path):
    robot = robots["ets_vii"]
    whole = fflin.linearize(robot.replace(inputs=motors(robot)))
    reduced = fflin.momentum_reduction(whole)
    assert reduced.certificate == whole.certificate
    for ending in ("npz", "mat", "json"):
        reduced.save(tmp_path / f"m.{ending}")
        back = fflin.LinearModel.load(tmp_path / f"m.{ending}")
        assert (back.A == reduced.A).all() and (back.M == reduced.M).all()
        assert fflin.controllability(back).dimension == 12
    sampled = reduced.discretize(0.1)
    assert sampled.certificate == whole.certificate and (sampled.T == reduced.T).all()
    changed = replace(reduced, A=reduced.A * 1.1)
    with pytest.raises(fflin.InputError, match="after the certificate"):
        _ = changed.certificate
    with pytest.raises(fflin.InputError, match="q_b"):
        fflin.check(robot, reduced)


def test_it_can_be_controlled(robots):
    """A gain of the reduced model settles the joints of the whole."""
    from scipy.linalg import solve_continuous_are

    robot = robots["dual_arm"]
    whole = fflin.linearize(robot.replace(inputs=motors(robot)))
    reduced = fflin.momentum_reduction(whole)
    P = solve_continuous_are(reduced.A, reduced.B, np.eye(16), np.eye(8))
    K = reduced.B.T @ P @ reduced.S
    poles = np.linalg.eigvals(whole.A - whole.B @ K)
    assert np.sum(poles.real < -1e-3) == 16
    assert np.sum(np.abs(poles) < 1e-6) == 12


def test_a_drift_is_converted(robots):
    """The base may fly on, since nothing depends on where it is; what is kept keeps its f0."""
    robot = robots["ets_vii"]
    v = fflin.velocity(robot, {"v_b.x": 0.3})
    lin = fflin.linearize(robot.replace(inputs=motors(robot)), v=v)
    reduced = fflin.momentum_reduction(lin)
    assert len(reduced.A) == 12 and np.abs(lin.f0).max() == 0.3
    assert not reduced.f0.any() and reduced.is_equilibrium()
    assert "q_m.joint_1" not in reduced.ignorable
    assert (
        fflin.momentum_reduction(fflin.linearize(robot, v=v)).ignorable == lin.ignorable
    )
    falling = fflin.linearize(robot.replace(gravity=(0.0, 0.0, -9.81)))
    assert (
        fflin.momentum_reduction(falling).f0 == falling.f0
    ).all() and falling.f0.any()


def test_drifting_points_are_refused(robots):
    robot = robots["ets_vii"].replace(
        gravity=(0.0, 0.0, -9.81), inputs=motors(robots["ets_vii"])
    )
    with pytest.raises(fflin.InputError, match="not an equilibrium"):
        fflin.momentum_reduction(fflin.linearize(robot))
    with pytest.raises(fflin.InputError, match="LinearModel"):
        fflin.momentum_reduction(None)
    with pytest.raises(fflin.InputError, match="reduc"):
        lin = fflin.linearize(
            robots["ets_vii"].replace(inputs=motors(robots["ets_vii"]))
        )
        fflin.generalized_inertia(fflin.momentum_reduction(lin))


@pytest.mark.parametrize("name", ARMS)
def test_generalised_jacobian_moves_the_frame_without_momentum(robots, name):
    """Against differences along joint motions during which the base takes up all momentum."""
    robot, rng = robots[name], np.random.default_rng(8)
    frame = robot.model.frames[-1].name
    q = posed(robot, rng)
    J = fflin.generalized_jacobian(robot, q, frame)
    assert J.shape == (6, robot.n)
    model, data = robot.model, robot.create_data()
    rates = rng.normal(size=robot.n)
    state = fflin.StateMap(robot, frame="local")
    v = state.spread(np.concatenate((np.zeros(6), rates)))
    pin.computeCentroidalMap(model, data, q)
    v[:6] = -np.linalg.solve(data.Ag[:, :6], data.Ag @ v)
    assert data.Ag @ v == pytest.approx(np.zeros(6), abs=1e-9)
    h, poses = 1e-5, []
    for t in (-h, h):
        pin.framesForwardKinematics(model, data, pin.integrate(model, q, t * v))
        poses.append(data.oMf[model.getFrameId(frame)].copy())
    turn = pin.log3(poses[1].rotation @ poses[0].rotation.T) / (2 * h)
    speed = (poses[1].translation - poses[0].translation) / (2 * h)
    assert J @ rates == pytest.approx(np.concatenate((turn, speed)), abs=1e-6)


def test_generalised_jacobian_is_the_reduced_models_output(robots):
    robot = robots["servicer_7dof"]
    robot = robot.replace(inputs=motors(robot), outputs=[fflin.FrameVelocity("tool")])
    q = fflin.configuration(robot, {"joint_2": 0.4, "joint_4": -1.1})
    reduced = fflin.momentum_reduction(
        fflin.linearize(robot, q, reference=pin.SE3.Identity())
    )
    J = fflin.generalized_jacobian(robot, q, "tool")
    data = robot.create_data()
    pin.framesForwardKinematics(robot.model, data, q)
    R = data.oMf[robot.model.getFrameId("tool")].rotation
    assert reduced.C[3:, robot.n :] == pytest.approx(J[3:], abs=1e-12)
    assert R @ reduced.C[:3, robot.n :] == pytest.approx(J[:3], abs=1e-12)
    with pytest.raises(fflin.UnknownNameError, match="tool"):
        fflin.generalized_jacobian(robot, q, "tol")


def test_the_report_lists_kept_and_removed_states():
    """A printed reduction, of a spacecraft that floats free and of one whose base is driven."""
    arm = fflin.load("planar_detumble")
    for inputs, momenta in ((motors(arm), 6), ([*motors(arm), BaseTorque()], 3)):
        lin = fflin.linearize(arm.replace(inputs=inputs))
        for model in (lin, lin.discretize(0.1)):
            reduced = fflin.momentum_reduction(model)
            assert len(reduced.momenta) == momenta
            title, *report = str(reduced).splitlines()
            assert title == repr(reduced) and title.startswith(
                "ReducedModel('planar_detumble', nx="
            )
            text = " ".join(line.strip() for line in report)
            assert (
                f"{18 - 2 * momenta} of 18 states are kept: {reduced.state_names[0]}"
                in text
            )
            assert f"{momenta} conserved momenta and the coordinates" in text


def test_the_report_states_ranks_that_are_undecided():
    arm = fflin.load("planar_detumble")
    reduced = fflin.momentum_reduction(fflin.linearize(arm.replace(inputs=motors(arm))))
    assert "note: in doubt" in str(replace(reduced, notes=("in doubt",)))
    assert "note:" not in str(reduced)
