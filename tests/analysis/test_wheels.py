"""Models without their wheels: the quotient, which wheels stay, and closed forms beside it."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin import BaseForce, BaseTorque, JointTorque, ReactionWheel, Thruster
from fflin.analysis.controllability import require_detectable, require_stabilizable
from fflin.analysis.reduction import outputs_of, regulated_part, without
from tests.support.marks import exhaustive
from tests.support.robots import FRAMES, mostly, random_pose, random_tree
from tests.support.wheels import AXES, carrier_alone, unit, wheels

ATTITUDE = {f"{group}.{axis}" for group in ("q_b", "omega_b") for axis in "xyz"}


def held(lin):
    return {
        name.partition(".")[2] for name in lin.state_names if name.startswith("qdot_m.")
    }


def quotient_error(lin, part):
    """Largest relative error of S A = A_z S and S B = B_z, whatever the states that left do."""
    at = [lin.state_names.index(name) for name in part.state_names]
    S = np.eye(len(lin.A))[at]
    size = np.abs(lin.A).max()
    errors = (
        np.abs(S @ lin.A - part.A @ S).max() / size,
        np.abs(S @ lin.B - part.B).max(),
    )
    return max(errors)


def posed(robot, rng):
    joints = {
        name: rng.uniform(-1, 1) for name in robot.joint_names if "wheel" not in name
    }
    return fflin.configuration(robot, joints, random_pose(rng, 40.0))


def motors(robot):
    return [JointTorque(name) for name in robot.joint_names]


@pytest.mark.parametrize("count", [1, 3, 6, *exhaustive(2, 4)])
@pytest.mark.parametrize("frame", mostly(FRAMES, "hybrid"))
def test_attitude_and_joints_stay_and_the_quotient_is_exact(count, frame):
    """On a base and links, with springs and drag, whatever the momentum; sampled too."""
    rng = np.random.default_rng(count)
    for robot in (
        fflin.load("cubesat"),
        fflin.load("servicer_7dof"),
        random_tree(rng, 5),
    ):
        bodies = [
            np.linalg.eigvalsh(body.inertia)[0]
            for body in robot.model.inertias.tolist()
        ]
        default, J = (
            motors(robot),
            1e-3 * min(moment for moment in bodies if moment > 0.0),
        )
        on = [None] if robot.name != "servicer_7dof" else [None, "link_3", "panel_left"]
        added = wheels(AXES[:count], J, on)
        passive = {}
        if default:
            passive = {"stiffness": {robot.joint_names[-1]: 3.0}, "damping": 0.2}
        ship = robot.replace(inputs=[*default, *added], **passive)
        q = posed(ship, rng)
        at = fflin.linearize(ship, q).x0[6 : 6 + ship.n]
        if default:
            expected_value = dict(zip(ship.joint_names, at, strict=True))
            ship = ship.replace(
                rest={name: expected_value[name] for name in robot.joint_names}
            )
        lin = fflin.linearize(ship, q, frame=frame, reference=pin.SE3.Identity())
        for model in (lin, lin.discretize(0.1)):
            part = fflin.momentum_reduction(model)
            names = set(part.state_names)
            assert {f"q_m.{joint}" for joint in robot.joint_names} <= names
            assert {f"qdot_m.{joint}" for joint in robot.joint_names} <= names
            assert not any("wheel" in name for name in names)
            assert not any(name.startswith(("r_b", "v_b")) for name in names)
            kept = min(count, 3)
            assert (
                len(part.A) == 2 * (kept + robot.n)
                and part.M.shape == (kept + robot.n,) * 2
            )
            if count >= 3:
                assert names >= ATTITUDE
                assert quotient_error(model, part) < 1e-11
                assert fflin.controllability(part).stabilizable
            rng_x = rng.normal(size=len(model.A))
            assert part.S @ part.T == pytest.approx(np.eye(len(part.A)), abs=1e-12)
            assert part.S @ rng_x == pytest.approx(
                rng_x[[model.state_names.index(name) for name in part.state_names]]
            )


@pytest.mark.parametrize("count", [3, 4])
@pytest.mark.parametrize("speed", [0.0, 400.0])
def test_the_reduced_model_is_the_carrier_without_wheels_under_minus_a_u(count, speed):
    """Beside another robot: its base lacks J a a^T, holds the momentum, and bears -a u."""
    bare, J = fflin.load("servicer_7dof"), 0.4
    speeds = {f"wheel_{k + 1}": speed * (1.0 + k) for k in range(count)}
    ship = bare.replace(inputs=[*motors(bare), *wheels(AXES[:count], J)])
    q = fflin.configuration(ship, {"joint_2": 0.4, "joint_4": -1.1})
    lin = fflin.linearize(ship, q, fflin.velocity(ship, speeds))
    part = fflin.momentum_reduction(lin)
    assert not any("wheel" in name for name in part.state_names)
    momentum = J * sum(
        speed * (1.0 + k) * unit(axis) for k, axis in enumerate(AXES[:count])
    )
    size = np.linalg.norm(momentum) or 1.0
    stored = ReactionWheel(
        momentum if speed else (1, 0, 0), momentum=size if speed else 0.0
    )
    other = carrier_alone(bare, [(J, axis) for axis in AXES[:count]]).replace(
        inputs=[*motors(bare), BaseTorque(), stored]
    )
    beside = fflin.linearize(other, q[: other.nq])
    at = [beside.state_names.index(name) for name in part.state_names]
    A = beside.A[np.ix_(at, at)]
    assert part.A == pytest.approx(A, abs=1e-11 * max(np.abs(A).max(), 1.0))
    n = bare.n
    torques = (
        beside.B[at][:, n : n + 3] @ -np.array([unit(axis) for axis in AXES[:count]]).T
    )
    assert part.B[:, n:] == pytest.approx(torques, abs=1e-11 * np.abs(torques).max())
    assert part.B[:, :n] == pytest.approx(beside.B[at][:, :n], abs=1e-11)
    rates = [
        beside.state_names.index(name) - 6 - n for name in part.state_names[3 + n :]
    ]
    expected = np.linalg.inv(np.linalg.inv(beside.M)[np.ix_(rates, rates)])
    assert part.M == pytest.approx(expected, abs=1e-11 * np.abs(expected).max())


def test_the_inputs_determine_which_speeds_remain():
    bare = fflin.load("cubesat")
    three, four = wheels(AXES[:3], 1e-5), wheels(AXES[:4], 1e-5)
    about_x = [Thruster("base", (0, y, 0), (0, 0, 1)) for y in (0.1, -0.1)]
    all_three, all_four = ({f"wheel_{k}" for k in range(1, n)} for n in (4, 5))
    for inputs, default, asked in (
        (three, set(), 0),
        (four, set(), 1),
        ([BaseForce(), *three], set(), 0),
        ([BaseTorque(), *three], all_three, 3),
        ([BaseTorque(), BaseForce(), *four], all_four, 4),
        ([*about_x, *three], {"wheel_1"}, 1),
    ):
        lin = fflin.linearize(bare.replace(inputs=inputs))
        for model in (lin, lin.discretize(0.2)):
            assert held(regulated_part(model)) == default
            assert len(held(regulated_part(model, True))) == asked
            assert held(regulated_part(model, False)) == set()
            part = regulated_part(model, True)
            assert quotient_error(model, part) < 1e-13
            assert not any(name.startswith("q_m.") for name in part.state_names)
    with pytest.raises(fflin.InputError, match="wheel_speeds"):
        fflin.momentum_reduction(lin, wheel_speeds=3)


def test_the_speed_of_a_wheel_matters_on_a_carrier_that_turns_and_with_friction():
    """Dual spin: a turning body feels the wheel's speed; only the angle leaves."""
    bare = fflin.load("cubesat")
    ship = bare.replace(inputs=[BaseTorque(), *wheels(AXES[:1], 1e-5)])
    spun = fflin.velocity(ship, {"omega_b.x": 0.3, "wheel_1": 200.0})
    lin = fflin.linearize(ship, v=spun, moving=True)
    # it turns about the wheel's own axis
    assert held(regulated_part(lin, False)) == set()
    skew = bare.replace(inputs=[BaseTorque(), *wheels([(1, 0, 0.2)], 1e-5)])
    lin = fflin.linearize(
        skew, v=fflin.velocity(skew, {"omega_b.x": 0.3, "wheel_1": 200.0})
    )
    assert held(regulated_part(lin, False)) == {"wheel_1"}
    dragged = ship.replace(damping={"wheel_1": 1e-4})
    part = regulated_part(fflin.linearize(dragged), False)
    assert held(part) == {"wheel_1"} and "q_m.wheel_1" not in part.state_names
    sprung = ship.replace(stiffness={"wheel_1": 1e-4})
    assert "q_m.wheel_1" in regulated_part(fflin.linearize(sprung), False).state_names


def test_states_that_grow_without_an_input_are_named_if_only_speeds_are_regulated():
    """Of the first-order models that speeds without angles make."""
    ship = fflin.load("cubesat").replace(inputs=[BaseTorque(), *wheels(AXES[:3], 1e-5)])
    part = regulated_part(fflin.linearize(ship))
    assert len(part.A) == 9 and len(part.M) == 6
    require_stabilizable(part)
    require_detectable(part)
    A = part.A.copy()
    A[1], A[1, 1] = 0.0, 0.5
    with pytest.raises(fflin.StabilizabilityError, match=r"q_b\.y"):
        require_stabilizable(replace(part, A=A))
    A[:, 1], A[1, 1] = 0.0, 0.5
    with pytest.raises(fflin.DetectabilityError, match=r"q_b\.y"):
        require_detectable(replace(part, A=A, C=np.delete(part.C, 1, axis=0)))


def test_the_transfer_function_to_the_kept_states_is_unchanged():
    robot = fflin.load("servicer_7dof")
    ship = robot.replace(
        inputs=[*motors(robot), *wheels(AXES[:4], 0.05)],
        outputs=[fflin.FullState(), fflin.FramePose("tool"), fflin.Gyroscope("link_3")],
        stiffness={"panel_left": 20.0},
        damping={"panel_left": 1.0},
    )
    lin = fflin.linearize(ship)
    part = without(lin, np.arange(6 + robot.n, 10 + robot.n))
    gone = {f"{group}.wheel_{k}" for group in ("q_m", "qdot_m") for k in range(1, 5)}
    assert set(lin.output_names) - set(part.output_names) == gone
    seen = [lin.output_names.index(name) for name in part.output_names]
    for s in (0.3 + 0.2j, 2.0 - 1.0j):
        whole, kept = (
            model.C @ np.linalg.solve(s * np.eye(len(model.A)) - model.A, model.B)
            + model.D
            for model in (lin, part)
        )
        assert kept == pytest.approx(whole[seen], abs=1e-10 * np.abs(whole).max())
    assert part.certificate == lin.certificate
    assert (
        without(lin.discretize(0.1), np.arange(6 + robot.n, 10 + robot.n)).generator
        is not None
    )


def test_a_file_tells_the_wheels_as_well(tmp_path):
    ship = fflin.load("cubesat").replace(inputs=[BaseTorque(), *wheels(AXES[:3], 1e-5)])
    for lin in (fflin.linearize(ship), fflin.linearize(ship).discretize(0.1)):
        lin.save(tmp_path / "m.npz")
        back = fflin.LinearModel.load(tmp_path / "m.npz")
        for speeds in (None, False, True):
            part, again = regulated_part(lin, speeds), regulated_part(back, speeds)
            assert again.state_names == part.state_names and (again.A == part.A).all()


def test_joints_that_are_rotors_stay_joints():
    """The last joint of an arm may be symmetric about its axis; its motor is to be held."""
    arm = fflin.load("ets_vii")
    lin = fflin.linearize(arm.replace(inputs=[*motors(arm), *wheels(AXES[:3], 0.1)]))
    assert "q_m.joint_6" in lin.ignorable
    assert {"q_m.joint_6", "qdot_m.joint_6"} <= set(
        fflin.momentum_reduction(lin).state_names
    )
    plain = fflin.linearize(arm)
    assert regulated_part(plain) is plain


@pytest.mark.compiled
@pytest.mark.parametrize(
    "name, J", [("servicer_7dof", 0.4), ("cubesat", 1e-5), ("ets_vii", 0.5)]
)
@pytest.mark.parametrize("speed", [1.0, 4000.0])
@pytest.mark.parametrize("net", [True, False])
def test_rounding_errors_of_a_spin_are_not_springs(name, J, speed, net):
    """Balanced wheels and others: the reduction keeps as many states as at rest."""
    bare = fflin.load(name)
    axes = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]  # whose sum is zero
    ship = bare.replace(inputs=[*motors(bare), *wheels(axes, J)])
    rng = np.random.default_rng(3)
    speeds = {f"wheel_{k + 1}": speed * (1.0 + k * net) for k in range(4)}
    linearizer = fflin.Linearizer(ship)
    for _ in range(3):
        q = fflin.configuration(
            ship, {joint: rng.normal() for joint in bare.joint_names}
        )
        still, spun = (linearizer(q, v) for v in (None, fflin.velocity(ship, speeds)))
        expected = fflin.momentum_reduction(still)
        result = fflin.momentum_reduction(spun)
        assert result.state_names == expected.state_names
        assert len(result.momenta) == len(expected.momenta) == 3 and not result.notes


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_the_outputs_of_a_reduced_model_do_not_depend_on_their_units(unit):
    """An output is kept if its other entries of C are rounding errors of its largest entry."""
    lin = fflin.linearize(fflin.load("cubesat"))
    C = np.zeros((2, len(lin.A)))
    C[:, 0] = unit
    C[:, -1] = unit * np.array([1e-14, 1e-9])
    model = replace(
        lin,
        C=C,
        D=np.zeros((2, lin.B.shape[1])),
        output_names=("kept", "removed"),
        output_units=("1", "1"),
        y0=np.zeros(2),
    )
    S = np.eye(len(lin.A))[:-1]
    assert outputs_of(model, S).tolist() == [[1.0, 0.0]]
