"""Linear-fractional models of robots with constraints."""

from itertools import product

import numpy as np
import pytest

import fflin
from fflin.uncertainty.derivatives import UNITS
from tests.linear.test_constraints import flexible, mimicking, with_wheels
from tests.support.commands import run
from tests.support.constrained import (
    hinged_rods,
    parallelogram,
    random_constraints,
)
from tests.support.marks import exhaustive

BENT = {"left_1": 0.4, "left_2": 0.6, "right_1": -0.4, "right_2": -0.6}
RANGES = {
    "base": {"mass": 0.2, "com.x": (-0.1, 0.1)},
    "left_2": {"density": 0.3, "com.y": (-0.05, 0.1)},
    "left_3.stiffness": (1.0, 5.0),
    "right_1.damping": (0.0, 2.0),
}


def relaxed(robot, q, **fields):
    """Return the robot with springs that are at rest at q."""
    positions = fflin.StateMap(robot).joint_positions(q)
    rest = dict(zip(robot.joint_names, positions.tolist(), strict=True))
    return robot.replace(rest=rest, **fields)


def grasping():
    """A servicer that holds its tools together, and a closed configuration."""
    held = [fflin.Weld("tool_left", "tool_right", name="grasp")]
    robot = fflin.load("dual_arm", constraints=held)
    q = fflin.configuration(robot, BENT)
    return relaxed(robot, q, stiffness={"left_3": 3.0, "right_3": 2.0}), q


def largest_error(of, q, deltas, independent=None):
    """Return the largest error of the LFT, relative to models of the robots at rows of deltas."""
    lft = of.lft(q, independent=independent)
    independent = lft.state_names[: len(lft.A) // 2]
    errors = []
    for delta in deltas:
        if of.refusal(delta):
            continue  # not physically realisable
        lin = fflin.linearize(of.at(of.values(delta)), q, independent=independent)
        assert lin.state_names == lft.state_names
        exact = lin.A, lin.B, lin.C, lin.D
        for matrix, result in zip(exact, lft.at(delta), strict=True):
            size = np.abs(matrix).max(initial=1e-300)
            errors.append(np.abs(result - matrix).max(initial=0.0) / size)
    assert errors
    return max(errors)


def vertices_and_draws(of, count, seed):
    vertices = np.array(list(product((-1.0, 1.0), repeat=len(of.blocks))))
    chosen = np.random.default_rng(seed).permutation(len(vertices))[:count]
    return np.vstack((vertices[chosen], of.draws(count, seed=seed)[0]))


def test_vertices_and_draws_are_the_models_of_the_changed_robots():
    robot, q = grasping()
    of = fflin.uncertain(robot, RANGES)
    deltas = vertices_and_draws(of, 6, seed=1)
    assert largest_error(of, q, deltas) < 1e-12
    chosen = ["q_b", "r_b", "left_2", "right_1"]
    assert largest_error(of, q, deltas, chosen) < 1e-12
    lft = of.lft(q)
    assert lft.parameters == of.names
    assert len(lft.A) == 2 * (6 + robot.n - 6)


@pytest.mark.exhaustive
@pytest.mark.parametrize("make", [flexible, with_wheels, mimicking])
def test_robots_of_every_kind_are_the_models_of_the_changed_robots(make, tmp_path):
    robot = make(tmp_path) if make is mimicking else make()
    robot = robot.replace(gravity=(0.0, 0.0, 0.0))
    if make is with_wheels:
        # A wheel without inertia stores momentum, which is not constant in inertial space.
        robot = robot.replace(inputs=robot.inputs[1:])
    q = fflin.closed(robot, fflin.configuration(robot, {robot.joint_names[0]: 0.3}))
    names = fflin.sensitivity(fflin.linearize(robot, q)).names
    ranges = {"*.mass": 0.1}
    ranges |= {
        name: 0.2 for name in names if name.endswith((".frequency", "position.z"))
    }
    if make is with_wheels:
        ranges["wheel_x.inertia"] = 0.3
    of = fflin.uncertain(robot, ranges)
    assert largest_error(of, q, of.draws(5, seed=2)[0]) < 1e-10


@pytest.mark.exhaustive
@pytest.mark.parametrize("first", range(0, 200, 100))
def test_random_robots_are_the_models_of_the_changed_robots(first):
    """Every fifth of 200 random robots with constraints, at rest with springs."""
    for seed in range(first, first + 100, 5):
        rng = np.random.default_rng([47, seed])
        try:
            robot, q, _, _ = random_constraints(rng, count=1 + seed % 3, loads=False)
            robot = relaxed(robot, q, stiffness={"joint_1": 2.0})
            lin = fflin.linearize(robot, q)
        except fflin.ConstraintError:
            continue  # a singular posture, or constraints without effect
        names = fflin.sensitivity(lin).names
        links = [name[:-5] for name in names if name.endswith(".mass")]
        first_link, second, third = rng.choice(links, 3, replace=False)
        ranges = {
            f"{first_link}.mass": 0.3,
            f"{first_link}.com.x": (-0.2, 0.2),
            f"{second}.density": 0.3,
            f"{third}.inertia.xx": 0.1,
            "joint_1.stiffness": 0.4,
            "joint_2.damping": (0.0, 1.0),
        }
        of = fflin.uncertain(robot, ranges)
        error = largest_error(of, q, vertices_and_draws(of, 3, seed))
        assert error < 1e-10, (seed, error)


# --- closed forms


def test_a_parallelogram_is_a_fraction_of_its_masses():
    """B = 1 / (2 m L^2 / 3 + M L^2): one repetition for each mass, and none without effect."""
    crank, bar, length = 0.6, 1.5, 0.8
    robot = parallelogram(crank, bar, length, 1.1, gravity=0.0)
    ranges = {
        "bar.mass": (1.0, 2.0),
        "left.density": 0.5,
        "base.mass": 0.5,
        "bar.inertia.zz": 0.1,
    }
    of = fflin.uncertain(robot.replace(independent=["left"]), ranges)
    lft = of.lft()
    assert lft.state_names == ("q_m.left", "qdot_m.left")
    repeats = dict(zip(lft.parameters, lft.repeats, strict=True))
    # The bar does not rotate, and the base is held.
    assert repeats == {
        "bar.mass": 1,
        "left.density": 1,
        "base.mass": 0,
        "bar.inertia.zz": 0,
    }
    column = lft.input_names.index("tau_m.left")
    for mass, factor in ((1.0, 0.5), (1.7, 1.0), (2.0, 1.5)):
        _, B, _, _ = lft.at({"bar.mass": mass, "left.density": factor})
        inertia = (1.0 + factor) * crank * length**2 / 3.0 + mass * length**2
        np.testing.assert_allclose(B[1, column], 1.0 / inertia, rtol=1e-12)
    assert "base.mass" in str(lft)


def pressed_strut(mass, length, stiffness, load):
    """Two rods between hinges, with a spring at the knee, pressed by a spring that is strained."""
    build = hinged_rods(mass, length)
    press = 1e3
    return build.robot(
        "pressed_strut",
        constraints=[fflin.Hinge("foot"), fflin.Weld("slide")],
        stiffness={"knee": stiffness, "slide": press},
        rest={"slide": load / press},
        independent=["knee"],
    )


def knee_stiffness(stiffness, load, length):
    return 2.0 * (2.0 * stiffness - load * length)


@pytest.mark.parametrize("ratio", [0.0, 0.5, 0.999])
def test_a_preloaded_strut_is_a_fraction_of_its_knee_and_masses(ratio):
    """A[1, 0] = -2 (2 k - P L) / I: the geometric stiffness of the load P does not vary."""
    mass, length, stiffness = 1.2, 0.9, 40.0
    load = ratio * 2.0 * stiffness / length
    robot = pressed_strut(mass, length, stiffness, load)
    of = fflin.uncertain(robot, {"knee.stiffness": (20.0, 60.0), "knee.density": 0.4})
    lft = of.lft()
    scale = knee_stiffness(stiffness, 0.0, length)
    for k, factor in product((20.0, 33.0, 60.0), (0.6, 1.2, 1.4)):
        inertia = (1.0 + factor) * mass * length**2 / 3.0
        expected = -knee_stiffness(k, load, length) / inertia
        A, *_ = lft.at({"knee.stiffness": k, "knee.density": factor})
        assert abs(A[1, 0] - expected) * inertia < 1e-9 * scale
        lin = fflin.linearize(of.at({"knee.stiffness": k, "knee.density": factor}))
        np.testing.assert_allclose(A, lin.A, rtol=0, atol=1e-10 * scale)


def test_the_spring_that_presses_a_strut_cannot_be_uncertain():
    robot = pressed_strut(1.2, 0.9, 40.0, 10.0)
    of = fflin.uncertain(robot, {"slide.stiffness": 0.1})
    with pytest.raises(
        fflin.InputError, match=r"slide\.stiffness.*deflected by 0\.01 m"
    ):
        of.lft()


def test_loads_that_depend_on_the_masses_are_refused():
    robot = parallelogram(0.6, 1.5, 0.8, 1.1)
    of = fflin.uncertain(robot, {"bar.mass": 0.1})
    with pytest.raises(fflin.InputError, match="gravity"):
        of.lft()


def test_an_open_configuration_is_refused():
    robot, q = grasping()
    fflin.linearize(robot, q)  # stores the pose of the tools
    of = fflin.uncertain(robot, {"base.mass": 0.1})
    opened = fflin.configuration(robot, BENT | {"left_1": 0.5})
    with pytest.raises(fflin.ConstraintError, match="off constraint 'grasp'"):
        of.lft(opened)


def test_no_block_is_larger_than_the_rank_of_its_effect():
    robot, q = grasping()
    robot = robot.replace(constraints=[*robot.constraints, fflin.Hinge("base")])
    lin = fflin.linearize(robot, q)
    S = fflin.sensitivity(lin)
    G = lin._all_states[len(lin._all_states) // 2 :, len(lin.A) // 2 :]
    J = dict(zip(S._derivatives._joints, S._derivatives._jacobians() @ G, strict=True))
    for link in ("base", "left_1", "left_4", "right_2"):
        for part in ("mass", "density", "inertia.zz"):
            name = f"{link}.{part}"
            one = S._one(name)
            M_p = sum(
                J[joint].T @ np.tensordot(change, UNITS, 1) @ J[joint]
                for joint, change in one.bodies.items()
            )
            values = np.abs(np.linalg.eigvalsh(M_p))
            rank = np.count_nonzero(values > 1e-10 * max(values.max(), 1e-3))
            lft = fflin.uncertain(robot, {name: 0.1}).lft(q)
            assert lft.repeats[0] == rank, name


# --- worst cases


def test_the_bound_of_a_knee_is_its_critical_stiffness():
    """With u = -c qdot, the strut is stable from k = P L / 2 on."""
    mass, length, stiffness, load = 1.2, 0.9, 40.0, 60.0
    robot = pressed_strut(mass, length, stiffness, load)
    of = fflin.uncertain(robot, {"knee.stiffness": 0.2})
    lft = of.lft()
    K = np.zeros(lft.B2.T.shape)
    K[lft.input_names.index("tau_m.knee"), 1] = 2.0
    worst = of.worst(K, samples=5)
    critical = 0.5 * load * length
    exact = (stiffness - critical) / (0.2 * stiffness)
    assert exact / 1.02 < worst.safe <= exact * (1.0 + 1e-9)
    assert worst.unstable == 0
    assert worst.gain.parameters == {"knee.stiffness": pytest.approx(0.8 * stiffness)}
    beyond = fflin.uncertain(robot, {"knee.stiffness": 0.5}).worst(K, samples=5)
    assert beyond.unstable > 0 and beyond.safe < 1.0


@pytest.mark.parametrize(
    "law", ["gain", *exhaustive("policy", "sampled", "integral", "regulator")]
)
def test_the_worst_loop_is_that_of_the_robot_with_its_parameters(law):
    """For a law in other coordinates than those that are chosen by default."""
    robot, q = grasping()
    chosen = ["q_b", "r_b", "left_2", "right_1"]
    lin = fflin.linearize(robot, q, independent=chosen)
    assert lin.state_names != fflin.linearize(robot, q).state_names
    of = fflin.uncertain(robot, {"base.mass": 0.3, "left_2.density": 0.5})
    if law == "sampled":
        gain = fflin.lqr(lin.discretize(0.1))
    elif law == "integral":
        gain = fflin.lqr(lin, integral_action=["q_b"])
    else:
        gain = fflin.lqr(lin)
    given = fflin.StateFeedback(lin, gain) if law == "policy" else gain
    worst = of.worst(given, q, samples=3)
    assert worst.unstable == 0
    found = worst.damping
    model = fflin.linearize(of.at(found.parameters), q, independent=chosen)
    if law == "sampled":
        model = model.discretize(0.1)
    A, B = model.A, model.B
    if law == "integral":
        count = len(gain.integrals)
        A = np.block(
            [[A, np.zeros((len(A), count))], [gain.H, np.zeros((count, count))]]
        )
        B = np.vstack((B, np.zeros((count, B.shape[1]))))
    poles = np.linalg.eigvals(A - B @ gain.K)
    if law == "sampled":
        poles = np.log(poles)
    damping = (-poles.real / np.abs(poles)).min()
    assert found.value == pytest.approx(damping, rel=1e-6)


def test_a_parameter_without_effect_changes_no_loop():
    robot = parallelogram(0.6, 1.5, 0.8, 1.1, gravity=0.0)
    robot = robot.replace(independent=["left"], inputs=[fflin.JointTorque("left")])
    gain = fflin.lqr(fflin.linearize(robot))
    alone = fflin.uncertain(robot, {"bar.mass": 0.3}).worst(gain, samples=3)
    of = fflin.uncertain(robot, {"bar.mass": 0.3, "base.mass": 0.5})
    both = of.worst(gain, samples=3)
    assert both.damping.value == pytest.approx(alone.damping.value, rel=1e-9)
    assert both.safe == pytest.approx(alone.safe, rel=0.02)
    only = fflin.uncertain(robot, {"base.mass": 0.5}).worst(gain, samples=3)
    assert only.safe == np.inf


def test_commands_have_robots_with_constraints(tmp_path):
    weld = ("--weld", "tool_left=tool_right", "--joint", "left_2=0.6")
    path = tmp_path / "ranges.mat"
    code, text, complaint = run(
        "uncertain", "dual_arm", *weld, "--vary", "base.mass=0.2", "-o", path
    )
    assert code == 0, complaint
    assert "1 parameter, 16 states" in text and path.exists()
    code, text, complaint = run("sensitivity", "dual_arm", *weld, "--only", "mass")
    assert code == 0, complaint
    assert "base.mass" in text
