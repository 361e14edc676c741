"""Derivatives of A, B, C, D and f0 over the parameters of a robot."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.inputs import named_inputs
from tests.support.complex_crba import inertia, motions
from tests.support.messages import says
from tests.support.orbits import in_orbit
from tests.support.robots import BUNDLED, mostly, random_point, random_pose

H = 1e-30


def changed(robot, bodies, size):
    model = robot.model.copy()
    for joint, change in bodies.items():
        parameters = model.inertias[joint].toDynamicParameters() + size * change
        model.inertias[joint] = pin.Inertia.FromDynamicParameters(parameters)
    return replace(robot, model=model)


def fourth_order(source, step):
    return (
        8.0 * (source(step) - source(-step))
        - (source(2.0 * step) - source(-2.0 * step))
    ) / (12.0 * step)


def everything(lin):
    f0 = lin.f0 if lin.drift is None else lin.drift
    return [lin.A, lin.B, lin.C, lin.D, f0, lin.y0]


def derived(slope):
    return [slope.dA, slope.dB, slope.dC, slope.dD, slope.df0, slope.dy0]


@pytest.mark.parametrize("name", BUNDLED)
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_at_rest_as_by_complex_steps(name):
    robot = fflin.load(name)
    assert not robot.followers
    rng = np.random.default_rng(1)
    q, *_ = random_point(robot, rng)
    lin = fflin.linearize(robot, q)
    S, joints = fflin.sensitivity(lin), motions(robot.model, np.r_[[0.0] * 3, q[3:]])
    M = np.linalg.inv(robot_inverse(robot, lin))
    inverse = np.linalg.inv(M)
    order = [3, 4, 5, 0, 1, 2, *(joint.idx_v for joint in robot.joints)]
    columns = fflin.Linearizer(robot).prepared.actuation.columns(robot.create_data(), q)
    bodies = {j: robot.model.inertias[j].toDynamicParameters() + 0j for j in joints}
    for parameter in S.parameters.values():
        if not parameter.bodies or parameter.name.endswith(".yz"):
            continue
        stepped = dict(bodies)
        for joint, change in parameter.bodies.items():
            stepped[joint] = bodies[joint] + 1j * H * change
        M_p = inertia(robot.model, joints, stepped)[np.ix_(order, order)].imag / H
        expected = -inverse @ M_p @ inverse @ columns
        got = S[parameter.name].dB[6 + robot.n :]
        assert np.abs(got - expected).max() < 1e-10 * np.abs(expected).max()


def robot_inverse(robot, lin):
    """Return M^-1 in base axes, by CRBA."""
    data, order = (
        robot.create_data(),
        [3, 4, 5, 0, 1, 2, *(j.idx_v for j in robot.joints)],
    )
    q = lin.q.copy()
    q[:3] = 0.0
    M = pin.crba(robot.model, data, q)
    return np.linalg.inv(M[np.ix_(order, order)])


@pytest.mark.parametrize(
    ("frame", "moving"),
    [("hybrid", False), ("world", False), ("local", False), ("local", True)],
)
@pytest.mark.parametrize(
    "name",
    mostly(
        ["ets_vii", "servicer_7dof", "inspector", "planar_detumble"],
        *("servicer_7dof", "planar_detumble"),
    ),
)
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_in_motion_as_by_differences(name, frame, moving):
    robot = fflin.load(name)
    rng = np.random.default_rng(2)
    if name == "servicer_7dof":
        robot = robot.replace(stiffness={"panel_*": 80.0}, damping={"panel_*": 3.0})
        outputs = [
            fflin.FullState(),
            fflin.Accelerometer("tool"),
            fflin.FramePose("tool"),
        ]
        robot = robot.replace(outputs=outputs)
    if name == "planar_detumble":
        robot = robot.replace(gravity=(1.0, 2.0, -9.0))
    q, v, _ = random_point(robot, rng, degrees=50.0, speed=0.5)
    u = rng.standard_normal(len(fflin.linearize(robot).input_names))
    reference = None if moving else pin.SE3.Random()

    def of(other):
        return fflin.linearize(
            other, q, v, u, frame=frame, moving=moving, reference=reference
        )

    S = fflin.sensitivity(of(robot))
    names = [n for n, one in S.parameters.items() if one.bodies]
    for name in rng.choice(names, 12, replace=False):
        one = S.parameters[name]
        joints = motions(robot.model, np.r_[[0.0] * 3, q[3:]])
        kept = {j: robot.model.inertias[j].toDynamicParameters() for j in joints}
        none = {j: 0.0 * item for j, item in kept.items()}
        M_p = inertia(robot.model, joints, none | one.bodies)
        step = (
            2e-3
            / np.abs(
                np.linalg.eigvals(
                    np.linalg.solve(inertia(robot.model, joints, kept), M_p)
                )
            ).max()
        )

        def at(size, one=one):
            result = everything(of(changed(robot, one.bodies, size)))
            return np.concatenate([part.ravel() for part in result])

        expected = fourth_order(at, step)
        got = np.concatenate([part.ravel() for part in derived(S[name])])
        rounding = 1e-13 * np.abs(at(0.0)).max() / step
        assert np.abs(got - expected).max() < 2e-8 * np.abs(expected).max() + rounding


def test_springs_dampers_thrusters_and_wheels():
    robot = fflin.load("inspector.toml")
    rng = np.random.default_rng(3)
    q, v, _ = random_point(robot, rng, degrees=40.0, speed=0.3)
    inputs = list(robot.inputs)
    u = rng.standard_normal(len(fflin.linearize(robot).input_names))
    S = fflin.sensitivity(fflin.linearize(robot, q, v, u))
    hinge = "hinge_left_1"
    thrusters = [i for i, item in enumerate(inputs) if isinstance(item, fflin.Thruster)]
    wheels = [
        i for i, item in enumerate(inputs) if isinstance(item, fflin.ReactionWheel)
    ]

    def with_input(at, **fields):
        others = list(inputs)
        others[at] = replace(others[at], **fields)
        return robot.replace(inputs=others)

    def tilted(size):
        item = inputs[thrusters[0]]
        return with_input(
            thrusters[0], direction=np.add(item.direction, (0.0, size, 0.0))
        )

    def shifted(size):
        item = inputs[thrusters[1]]
        return with_input(
            thrusters[1], position=np.add(item.position, (0.0, 0.0, size))
        )

    names = fflin.linearize(robot).input_names
    first = names.index(named_inputs(inputs)[thrusters[0]][1][0])
    wheel = inputs[wheels[0]].name
    K, D = robot.stiffness[hinge], robot.damping[hinge]
    cases = {
        f"{hinge}.stiffness": (
            lambda s: robot.replace(stiffness={**robot.stiffness, hinge: K + s}),
            1.0,
        ),
        f"{hinge}.damping": (
            lambda s: robot.replace(damping={**robot.damping, hinge: D + s}),
            0.01,
        ),
        f"{names[first]}.direction.y": (tilted, 3e-3),
        f"{names[first + 1]}.position.z": (shifted, 1e-2),
        f"{wheel}.inertia": (
            lambda s: with_input(wheels[0], inertia=inputs[wheels[0]].inertia + s),
            1e-4,
        ),
    }
    rounding = 1e-14 * np.abs(S.lin.A).max()
    for name, (source, step) in cases.items():
        expected = [
            fourth_order(
                lambda s, k=k, source=source: everything(
                    fflin.linearize(source(s), q, v, u)
                )[k],
                step,
            )
            for k in (0, 1, 4)
        ]
        slope = S[name]
        for got, wanted in zip((slope.dA, slope.dB, slope.df0), expected, strict=True):
            assert (
                np.abs(got - wanted).max()
                <= 1e-8 * np.abs(wanted).max() + rounding / step
            ), name
        assert max(np.abs(wanted).max() for wanted in expected) > 0.0


def test_a_single_body_in_closed_form():
    robot = fflin.load("cubesat")
    S = fflin.sensitivity(fflin.linearize(robot))
    lin = S.lin
    about = lin.B[6:9, :3]
    density = S["base.density"]
    assert np.abs(density.dB[6:9, :3] + about).max() < 1e-12 * np.abs(about).max()
    xx = S["base.inertia.xx"].dB[6:9, :3]
    assert np.abs(xx + np.outer(about[:, 0], about[0])).max() < 1e-12 * np.abs(xx).max()
    assert not S.dA.any() and not S.df0.any()


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_links_that_are_fixed_to_each_other_have_separate_parameters():
    robot = fflin.load("planar_detumble")
    S = fflin.sensitivity(fflin.linearize(robot))
    parts = S["link_3.density"].dB + S["hand.density"].dB + S["target.density"].dB
    assert np.abs(parts - S["joint_3.density"].dB).max() < 1e-12 * np.abs(parts).max()
    heavier = S.along({"target.mass": 5.0, "hand.*": 0.0})
    alone = 5.0 * S["target.mass"].dB  # differs by rounding: BLAS adds in another order
    assert np.abs(heavier.dB - alone).max() < 1e-12 * np.abs(alone).max()
    assert S.parameters["target.mass"].value == pytest.approx(50.0)
    locked = fflin.sensitivity(
        fflin.linearize(fflin.load("servicer_7dof", lock=["joint_3"]))
    )
    assert locked.parameters["link_3.mass"].value == pytest.approx(9.5)


def test_the_spring_of_a_joint_whose_body_has_several_links_matches_a_pattern_too():
    robot = fflin.load("planar_detumble", stiffness=2.0, damping=0.1)
    parameters = fflin.sensitivity(fflin.linearize(robot)).parameters
    for part in ("stiffness", "damping"):
        springs = [f"joint_{k}.{part}" for k in (1, 2, 3)]
        assert parameters.find(f"*.{part}") == parameters.ranked(part) == springs
    assert "joint_3.mass" not in parameters.find("*.mass")


def test_a_robot_of_other_masses_is_known_by_its_bodies():
    robot = fflin.load("servicer_7dof").with_mass_properties({"link_3": {"mass": 20.0}})
    S = fflin.sensitivity(fflin.linearize(robot))
    assert S.parameters["link_3.mass"].value == pytest.approx(20.0)
    assert S["joint_3.mass"].name == "link_3.mass"


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_poles_move_as_differences_say():
    robot = fflin.load("servicer_7dof").replace(stiffness={"panel_*": 80.0})
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    poles, slopes = fflin.sensitivity(lin).poles(gain)
    at = list(fflin.sensitivity(lin).names).index("link_2.mass")
    change = {2 + 1: None}
    S = fflin.sensitivity(lin)
    bodies, step = S.parameters["link_2.mass"].bodies, 1e-3
    assert change.keys() == bodies.keys()

    def poles_at(size):
        other = fflin.linearize(changed(robot, bodies, size))
        result = np.linalg.eigvals(other.A - other.B @ gain.K)
        return result[np.abs(result[:, None] - poles).argmin(axis=0)]

    expected = fourth_order(poles_at, step)
    sure = np.isfinite(slopes[at])
    assert sure.sum() > 20
    # What rounding of poles leaves of a difference of steps of a gram.
    assert (
        np.abs(slopes[at] - expected)[sure].max() < 1e-6 * np.abs(expected).max() + 1e-8
    )


def test_correct_models_pass_check_and_wrong_models_fail():
    robot = fflin.load("ets_vii")
    q, v, _ = random_point(robot, np.random.default_rng(4), degrees=30.0, speed=0.2)
    S = fflin.sensitivity(fflin.linearize(robot, q, v))
    names = ["link_2.mass", "base.com.x", "link_4.inertia.xy"]
    assert max(S.check(names).values()) < 1e-7
    by_q_m = slice(6, 6 + robot.n)
    S._derivatives._of_bodies.slopes[..., by_q_m] *= 1.001
    S._derivatives._of_bodies.by_u[:] *= 1.001
    assert min(S.check(names).values()) > 1e-6


def test_errors_are_one_line():
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot)
    S = fflin.sensitivity(lin)
    with pytest.raises(fflin.UnknownNameError, match=r"link_2\.mass"):
        S["link_2.mas"]
    with pytest.raises(fflin.InputError, match="along"):
        S["link_2.*"]
    with pytest.raises(fflin.InputError, match=r"\(2, 2\)"):
        S.poles(np.zeros((2, 2)))
    with pytest.raises(fflin.InputError, match="empty"):
        S.along({})
    assert all(len(line) <= 80 for line in str(S).splitlines())


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_its_check_takes_wheels_whose_bodies_have_no_mass():
    robot = fflin.load("robots/inspector.toml")
    result = fflin.sensitivity(fflin.linearize(robot)).check(
        ["wheel_x.inertia", "wheel_z.inertia"]
    )
    assert len(result) == 2 and max(result.values()) < 1e-8


def test_a_body_whose_joint_has_a_dot_in_its_name_is_found_by_it():
    held = fflin.load("ets_vii")
    robot = fflin.capture(
        fflin.load("servicer_7dof"), "tool", held, prefix="client"
    ).robot
    S = fflin.sensitivity(fflin.linearize(robot))
    assert S["client.joint_3.mass"].name == "client.link_3.mass"


def test_a_thruster_that_burns_on_a_link_and_a_spring_out_of_rest():
    robot = fflin.load("ets_vii")
    q, v, _ = random_point(robot, np.random.default_rng(2), degrees=60.0)
    jet = fflin.Thruster("tool", (0.1, 0.2, -0.1), (0.0, 0.6, 0.8), name="jet")
    robot = robot.replace(
        inputs=[jet], stiffness={"joint_3": 5.0}, rest={"joint_3": 0.7}
    )

    def moved(step):
        return robot.replace(inputs=[replace(jet, position=(0.1 + step, 0.2, -0.1))])

    def stiffer(step):
        return robot.replace(stiffness={"joint_3": 5.0 + step})

    S = fflin.sensitivity(fflin.linearize(robot, q, v, [3.0]))
    for name, source in (("jet.position.x", moved), ("joint_3.stiffness", stiffer)):
        # In both all is linear.
        ends = [
            everything(fflin.linearize(source(step), q, v, [3.0]))
            for step in (0.5, -0.5)
        ]
        for high, low, got in zip(*ends, derived(S[name]), strict=True):
            expected = high - low
            assert np.abs(got - expected).max() <= 1e-10 * np.abs(expected).max(), name


def test_rotors_are_not_parameters_of_bodies():
    model = fflin.load("ets_vii").model.copy()
    model.armature = np.r_[np.zeros(6), np.linspace(0.1, 2.0, model.nv - 6)]
    robot = fflin.from_model(model)
    q, v, u = random_point(robot, np.random.default_rng(2))
    result = fflin.sensitivity(fflin.linearize(robot, q, v, u)).check(
        ["base.mass", "joint_3.com.x"]
    )
    assert max(result.values()) < 1e-8


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_table_shows_the_effect_of_a_ten_percent_change_in_descending_order():
    S = fflin.sensitivity(fflin.linearize(fflin.load("servicer_7dof")))
    _, rows = S.table(len(S.names)).split("B [%]\n")
    rows = rows.splitlines()
    shares = [float(row.split()[-1]) for row in rows]
    assert shares == sorted(shares, reverse=True) and len(rows) == 80
    largest = np.abs(S.lin.B).max()
    for name, step in (
        ("link_7.density", 0.1),
        ("link_3.mass", 0.95),
        ("link_7.com.x", 0.01),
    ):
        [row] = [row for row in rows if row.split()[0] == name]
        expected = 100.0 * step * np.abs(S[name].dB).max() / largest
        assert float(row.split()[-1]) == pytest.approx(expected, rel=0.05)
    assert S.table(3).splitlines()[-1] == "... and 77 more, see --top"
    with pytest.raises(fflin.InputError, match="top"):
        S.table(0)


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_table_ranks_links_or_the_requested_parameters():
    S = fflin.sensitivity(fflin.linearize(fflin.load("planar_detumble")))

    def shown(only=None):
        return [
            row.split() for row in S.table(999, only).split("B [%]\n")[1].splitlines()
        ]

    # joint_3 is hand and target together.
    assert "joint_3.density" in S.names and "joint_3.stiffness" in S.names
    owners = {row[0].partition(".")[0] for row in shown()}
    assert owners == {"base", "link_1", "link_2", "link_3", "hand", "target"}
    assert {row[0] for row in shown("mass")} == {f"{name}.mass" for name in owners}
    assert shown("*.mass") == shown("mass")
    assert shown("link_2.mass") == [
        row for row in shown("link_?.mass") if "_2" in row[0]
    ]
    assert {row[0].partition(".")[0] for row in shown("hand")} == {"hand"}
    assert {row[0][:13] for row in shown("hand.inertia*")} == {"hand.inertia."}
    assert [row[0] for row in shown("joint_3.density")] == ["joint_3.density"]
    # name, no unit, 1, 0.1, and A and B
    assert {len(row) for row in shown("density")} == {6}
    with pytest.raises(fflin.UnknownNameError, match="'masss'"):
        S.table(3, "masss")
    assert says(S.table(3, "joint_1.stiffness"), "none of these")


@pytest.mark.parametrize("torque", [0.0, -0.3])
@pytest.mark.parametrize("axis", "xyz")
def test_every_place_and_direction_of_a_thruster(axis, torque):
    robot, at = fflin.load("ets_vii"), "xyz".index(axis)
    where, along = np.array((0.1, 0.2, -0.1)), np.array((0.48, 0.6, 0.64))
    jet = fflin.Thruster("link_4", where, along, name="jet", torque=torque)
    q = random_point(robot, np.random.default_rng(3), degrees=60.0)[0]

    def B(**fields):
        return fflin.linearize(robot.replace(inputs=[replace(jet, **fields)]), q).B

    S = fflin.sensitivity(fflin.linearize(robot.replace(inputs=[jet]), q))
    unit = np.eye(3)[at]
    slope = S[f"jet.position.{axis}"]
    assert slope.unit == "m" and slope.value == where[at]
    expected = B(position=where + 0.5 * unit) - B(position=where - 0.5 * unit)
    assert np.abs(slope.dB - expected).max() < 1e-12 * np.abs(B()).max()
    expected = fourth_order(lambda s: B(direction=along + s * unit), 3e-3)
    got = S[f"jet.direction.{axis}"].dB
    assert np.abs(got - expected).max() < 1e-8 * np.abs(expected).max()
    assert ("jet.torque" in S.parameters) == bool(torque)
    if torque:
        expected = B(torque=0.5) - B(torque=-0.5)
        got = S["jet.torque"].dB
        assert np.abs(got - expected).max() < 1e-12 * np.abs(B()).max()
        drawn = fflin.uncertain(
            robot.replace(inputs=[jet]), {"jet.torque": 0.5}
        ).samples(3, seed=1)
        assert all(0.15 < -item.inputs[0].torque < 0.45 for item in drawn)


def test_in_orbit_masses_change_the_gravity_gradient():
    robot, rng = in_orbit(fflin.load("servicer_7dof")), np.random.default_rng(6)
    joints = {name: rng.uniform(-1.0, 1.0) for name in robot.joint_names}
    for speed, frame in ((0.0, "hill"), (0.4, "lvlh")):
        base = random_pose(rng, 100.0)
        q = fflin.configuration(robot, joints, base)
        v = speed * rng.normal(size=robot.nv)
        for reference in (None, base):
            lin = fflin.linearize(robot, q, v, frame=frame, reference=reference)
            result = fflin.sensitivity(lin).check(
                ["link_3.mass", "base.inertia.xy", "link_7.com.x"]
            )
            assert max(result.values()) < 2e-9
