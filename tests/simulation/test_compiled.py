"""The compiled loop against the one in Python: the same motion to rounding, the same words."""

import itertools
import warnings
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.simulation import compiled, packing
from tests.support.measured import POSITIONS, designed
from tests.support.motions import HOME, displaced
from tests.support.motions import motion as trajectory
from tests.support.robots import BUNDLED, FRAMES, LINKS, MIMIC, free_body, random_point, random_tree
from tests.support.weights import unit_weights

pytest.importorskip("numba")

from fflin.kernel import tracking
from fflin.kernel.loop import advance

pytestmark = pytest.mark.compiled

WHEEL = fflin.ReactionWheel((0, 0, 1), name="spin", inertia=0.02, max_speed=300.0, max=0.5)
STORING = fflin.ReactionWheel((1, 2, 2), name="storing", momentum=3.0)


def both(robot, policy=None, tolerance=1e-10, rounding=2e-14, **options):
    """Run both loops, hold one against the other, and return the compiled one's motion."""
    options = {"duration": 10.0, "dt": 0.01, "linear": False} | options
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fflin.FflinWarning)
        python, motion = (
            fflin.simulate(robot, policy, **options, engine=engine) for engine in compiled.ENGINES
        )
    assert (python.engine, motion.engine) == compiled.ENGINES
    assert motion.stopped == python.stopped
    for name in ("t", "q", "v", "x", "u", "energy", "momentum"):
        expected, found = getattr(python, name), getattr(motion, name)
        assert found.shape == expected.shape, name
        size = np.maximum(1.0, np.abs(expected).max(axis=0))
        assert (np.abs(found - expected) <= tolerance * size).all(), name
    if options.get("project", True):
        assert motion.momentum_drift.max() <= rounding + 2.0 * python.momentum_drift.max()
        assert motion.com_drift.max() <= rounding + 2.0 * python.com_drift.max()
    return motion


def feedback(robot, frame="hybrid", reference=None):
    lin = fflin.linearize(robot, frame=frame, reference=reference)
    return fflin.StateFeedback(lin, fflin.lqr(lin).K)


@pytest.mark.parametrize("name", BUNDLED)
def test_a_bundled_robot_under_feedback_in_each_frame(robots, name):
    robot = robots[name]
    for frame, reference in zip(FRAMES, (None, HOME, HOME), strict=True):
        policy = feedback(robot, frame, reference)
        motion = both(robot, policy, x0=displaced(policy.lin))
        assert np.abs(motion.u).max() > 1e-3
        assert not motion.stopped


@pytest.mark.parametrize("seed", range(4))
def test_a_tree_that_flies_free(seed):
    rng = np.random.default_rng(seed)
    robot = random_tree(rng, 5)
    q, v, _ = random_point(robot, rng, speed=0.3)
    for method in ("cf4", "rkmk4", "semi_implicit_euler"):
        both(robot, q0=q, v0=v, duration=3.0, method=method)
    both(robot, q0=q, v0=v, duration=1.0, project=False)


ARM = [f"joint_{k}" for k in range(1, 8)]
PASSIVE = {
    "gravity": {"gravity": (0.3, -0.2, -1.0)},
    "springs": {"stiffness": {"joint_*": 2.0}, "damping": {"joint_*": 0.5}},
    "thrusters": {
        "inputs": [
            *map(fflin.JointTorque, ARM),
            fflin.Thruster("link_3", (0.2, 0.1, 0.0), (1.0, 0.5, 0.2), "jet"),
            fflin.Thruster("base", (0.1, 0.0, 0.3), (0.0, 1.0, 0.5), "other", max=0.05),
            STORING,
        ]
    },
}
PASSIVE["all"] = {key: value for each in PASSIVE.values() for key, value in each.items()}


@pytest.mark.parametrize("fields", PASSIVE.values(), ids=PASSIVE)
def test_forces_of_all_kinds(fields):
    robot = fflin.load("canadarm2", **fields)
    lin = fflin.linearize(robot)
    K = 0.05 * np.random.default_rng(1).normal(size=lin.B.shape[::-1])
    policy = fflin.StateFeedback(lin, K)
    both(robot, policy, x0=displaced(lin), duration=4.0)


def test_mimic_joints(tmp_path):
    path = tmp_path / "gripper.urdf"
    for a, b in itertools.product(("revolute", "continuous", "prismatic"), repeat=2):
        mimic = '<mimic joint="b" multiplier="-0.7" offset="0.2"/>'
        path.write_text(MIMIC.format(links=LINKS, a=a, b=b, parent="base", mimic=mimic))
        robot = fflin.load(path, stiffness={"b": 1.0})
        policy = feedback(robot)
        both(robot, policy, x0=displaced(policy.lin), duration=2.0)


def sampled(robot, dt=0.05):
    lin = fflin.linearize(robot)
    model = lin.discretize(dt)
    gain = fflin.lqr(model, *fflin.sampled_cost(lin, dt, *unit_weights(lin)))
    return fflin.StateFeedback(model, gain.K)


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.13])
def test_samples_delay_and_limits(robots, delay):
    policy = sampled(robots["ets_vii"])
    limits = {"tau_b": (-0.5, 0.7), "tau_m": 2.0}
    x0 = displaced(policy.lin)
    motion = both(robots["ets_vii"], policy, x0=x0, delay=delay, limits=limits, duration=5.0)
    assert motion.u[:, :3].min() == -0.5
    both(robots["ets_vii"], policy, x0=x0, delay=delay, every=7, duration=5.0)
    both(robots["ets_vii"], feedback(robots["ets_vii"]), sample=0.03, delay=delay, x0=x0, dt=0.01)


def test_wheels_that_saturate():
    robot = free_body((20.0, 30.0, 40.0)).replace(inputs=[WHEEL, fflin.BaseForce()])
    lin = fflin.linearize(robot)
    K = np.zeros(lin.B.shape[::-1])
    K[0, 5] = 40.0
    x0 = displaced(lin)
    for sign in (1.0, -1.0):
        policy = fflin.StateFeedback(lin, sign * K)
        motion = both(robot, policy, x0=x0, limits="urdf", duration=20.0)
        assert np.abs(motion.v[:, -1]).max() == pytest.approx(300.0, rel=1e-6)


@pytest.mark.parametrize("least", [None, 0.004])
@pytest.mark.parametrize("on_off", [False, True])
def test_thrusters_that_fire_in_pulses(on_off, least):
    jets = [
        fflin.Thruster("base", place, way, f"jet_{k}", max=0.3, on_off=on_off, least_impulse=least)
        for k, (place, way) in enumerate(
            itertools.product(((0.1, 0, 0), (-0.1, 0, 0)), ((0, 1, 0), (0, -1, 0)))
        )
    ]
    robot = free_body((2.0, 3.0, 4.0)).replace(inputs=[*jets, fflin.BaseTorque()])
    lin = fflin.linearize(robot)
    K = np.random.default_rng(3).normal(size=lin.B.shape[::-1])
    # What acts until the first command arrives is fired too.
    held = replace(lin.discretize(0.1), u0=0.1 + 0.0 * lin.u0)
    policy = fflin.StateFeedback(held, 0.3 * K)
    for delay in (0.04, 0.24):
        motion = both(robot, policy, x0=displaced(lin), dt=0.02, delay=delay, duration=4.0)
        assert (motion.u[: round(delay / 0.02), :4] > 0.0).any(axis=0).all()


def test_joints_that_go_round_are_read_on_the_turn_of_the_target(robots):
    robot = robots["ets_vii"]
    for angle in (3.0, -3.0):
        lin = fflin.linearize(robot, fflin.configuration(robot, {"joint_1": angle}))
        x0 = lin.x0.copy()
        x0[6] += np.copysign(0.5, angle)
        both(robot, fflin.StateFeedback(lin, fflin.lqr(lin).K), x0=x0, duration=0.5)


def test_output_feedback():
    robot, lin, compensator = designed(POSITIONS)
    policy = fflin.OutputFeedback(lin, compensator)
    both(robot, policy, x0=displaced(lin), duration=10.0)


@pytest.fixture(scope="module")
def schedule():
    """A slew of a robot with joints that go round, in the axes of the world."""
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot)
    x0 = displaced(lin, degrees=50.0)
    slew = fflin.simulate(robot, feedback(robot), x0=x0, duration=6.0, dt=0.1, engine="python")
    path = fflin.Trajectory(robot, slew.t + 2.0, slew.q, slew.v, slew.u, frame="hybrid")
    return fflin.tvlqr(fflin.linearize_trajectory(robot, path), *unit_weights(lin))


@pytest.mark.parametrize("case", [{}, {"duration": 3.0}, {"sample": 0.05, "delay": 0.05}])
def test_feedback_along_a_trajectory(robots, schedule, case):
    q = schedule.q[0].copy()
    q[:3] += 0.1
    q[7:9] = np.cos(2.0), np.sin(2.0)
    both(robots["ets_vii"], schedule, q0=q, **case)
    both(robots["ets_vii"].replace(gravity=(0.0, 0.01, 0.0)), schedule, duration=3.0)


def test_a_trajectory_is_followed_from_sample_to_sample(robots):
    robot = robots["astrobee_arm"]
    t, q, v, u = trajectory(robot, duration=0.4, knots=9)
    for inputs in (u, u[:-1]):
        along = fflin.linearize_trajectory(robot, t, q, v, inputs)
        gains = fflin.tvlqr(along, *unit_weights(fflin.linearize(robot, q[0])), sample=0.05)
        both(robot, gains, dt=0.01, duration=0.4, v0=1.1 * v[0], q0=q[0])


STOPS = {
    "left the chart": lambda lin: {"x0": displaced(lin, degrees=60.0), "turn": 2.0},
    "diverged": lambda lin: {"x0": displaced(lin), "gain": -3.0},
}


@pytest.mark.parametrize("words", STOPS)
def test_a_run_stops_at_the_same_step_with_the_same_words(robots, words):
    robot = robots["servicer_7dof"]
    policy = feedback(robot)
    case = STOPS[words](policy.lin)
    case["x0"][6 + robot.n] += case.pop("turn", 0.0)
    policy = replace(policy, K=case.pop("gain", 0.0) * policy.K)
    motion = both(robot, policy, tolerance=1e-6, **case)
    assert motion.stopped.startswith(words)
    assert 20 < len(motion.t) < 1001


def test_an_orbit_costs_no_digits(robots):
    robot = robots["canadarm2"]
    reference = pin.SE3(HOME.rotation, np.array([7e6, 1e5, -2e5]))
    lin = fflin.linearize(
        robot, np.array([*reference.translation, *robot.neutral()[3:]]), reference=reference
    )
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    x0 = displaced(lin)
    # A place is rounded to 1e-9 m there, and so is what the feedback sees of it.
    both(robot, policy, 1e-7, 1e-8, x0=x0, duration=3.0)


def test_ctrl_c_keeps_what_is_done(robots, monkeypatch):
    count = itertools.count()

    def update(self, done, total):
        if next(count) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(compiled.Progress, "update", update)
    motion = fflin.simulate(robots["cubesat"], duration=500.0, dt=0.01, engine="compiled")
    assert motion.stopped == f"interrupted at t = {motion.t[-1] + 0.01:g} s"
    assert 4 * 16 <= len(motion.t) < 1e6


def nothing(t, q, v):
    return np.zeros(9)


def test_what_cannot_be_compiled_says_why(robots):
    robot, options = robots["planar_detumble"], {"duration": 0.1, "engine": "compiled"}
    cases = (
        ({"policy": nothing}, "a function decides in Python"),
        ({"callback": print}, "callbacks"),
        ({"events": [lambda t, q, v: 1.0]}, "events"),
        ({"disturbance": lambda t, q, v: np.zeros(robot.nv)}, "disturbances"),
    )
    for more, words in cases:
        with pytest.raises(fflin.InputError, match=words):
            fflin.simulate(robot, **options, **more)
        assert fflin.simulate(robot, **(options | {"engine": None}), **more).engine == "python"
    with pytest.raises(fflin.UnknownNameError, match="compiled"):
        fflin.simulate(robot, duration=0.1, engine="compile")
    monkeypatched = pytest.MonkeyPatch()
    with monkeypatched.context() as patch:
        patch.setattr(compiled, "numba_is_there", lambda: False)
        with pytest.raises(fflin.InputError, match="numba"):
            fflin.simulate(robot, **options)


def test_the_quicker_loop_is_taken_and_the_motion_says_which(robots, monkeypatch, tmp_path):
    robot = robots["cubesat"]
    for pays, engine in ((False, "python"), (True, "compiled")):
        monkeypatch.setattr(compiled, "loop_pays", lambda steps, pays=pays: pays and steps == 10)
        motion = fflin.simulate(robot, duration=0.1, dt=0.01)
        assert motion.engine == engine
        motion.save(tmp_path / "motion.npz")
        assert fflin.Motion.load(tmp_path / "motion.npz").engine == engine
    monkeypatch.setattr(compiled, "_LARGEST_FACTOR", 0)
    assert fflin.simulate(robot, duration=0.1, dt=0.01).engine == "python"


# What is the same for all lanes.
SHARED = {"turns", "slides", "factor", "axes", "armature", "share", "weights", "moments", "nodes"}
SHARED |= {"values"}


def in_lanes(runs):
    """The parts of eight runs side by side."""
    first = runs[0]
    if isinstance(first, np.ndarray):
        return np.column_stack(runs).copy() if first.dtype == float else first
    if isinstance(first, tracking.Path):
        return first._replace(e=in_lanes([each.e for each in runs]))
    if not isinstance(first, tuple):
        return first
    names = getattr(first, "_fields", range(len(first)))
    parts = [
        own[0] if name in SHARED else in_lanes(own)
        for name, own in zip(names, zip(*runs, strict=True), strict=True)
    ]
    return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)


def test_eight_lanes_are_eight_runs(robots, monkeypatch):
    """Each with a start, masses and gains of its own."""
    jet = fflin.Thruster("link_2", (0.2, 0.1, 0.0), (1.0, 0.5, 0.2), "jet")
    inputs = [*robots["ets_vii"].inputs, jet, STORING]
    runs, motions, given = [], [], packing.packed

    def packed(*arguments):
        runs.append(given(*arguments))
        return deepcopy(runs[-1])

    monkeypatch.setattr(packing, "packed", packed)
    for share in np.linspace(0.8, 1.2, 8):
        model = robots["ets_vii"].model.copy()
        for joint in range(1, model.njoints):
            model.inertias[joint] = pin.Inertia.FromDynamicParameters(
                share * model.inertias[joint].toDynamicParameters()
            )
        robot = fflin.from_model(model, inputs=inputs, stiffness={"joint_1": 10.0 * share})
        lin = fflin.linearize(robot)
        policy = fflin.StateFeedback(lin, share * fflin.lqr(lin).K)
        options = {"x0": share * displaced(lin), "dt": 0.01, "linear": False}
        motions.append(fflin.simulate(robot, policy, duration=2.0, **options, engine="compiled"))
    parts = in_lanes(runs)
    clock, width = np.zeros(1, dtype=np.intp), robot.nq + 6 + robot.n + len(lin.u0) + 9
    rows, work = np.empty((21 * width, 8)), np.empty((parts[0].layout.size, 8))
    advance(*parts, clock, 150, 10, rows, work)
    advance(*parts, clock, 200, 10, rows[15 * width :], work)
    for lane, motion in enumerate(motions):
        found = rows[: 20 * width, lane].reshape(20, width)
        np.testing.assert_allclose(found[:, : robot.nq], motion.q[:200:10], rtol=0, atol=1e-12)
        u = found[:, robot.nq + 6 + robot.n : -9]
        np.testing.assert_allclose(u, motion.u[:200:10], rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(parts[6].q[:, lane], motion.q[-1], rtol=0, atol=1e-12)
    assert np.ptp(parts[6].q[:7], axis=1).min() > 1e-4


def test_a_command_that_is_no_number_is_told(robots):
    robot = robots["cubesat"]
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, np.full(lin.B.shape[::-1], 1e308))
    x0 = displaced(lin, offset=100.0)
    options = {"x0": x0, "sample": 0.01, "duration": 0.1, "linear": False}
    said = []
    for engine in compiled.ENGINES:
        with np.errstate(over="ignore"), pytest.raises(fflin.InputError) as caught:
            fflin.simulate(robot, policy, **options, engine=engine)
        said.append(str(caught.value))
    assert said[0] == said[1]
    assert "tau_b.x" in said[0]
