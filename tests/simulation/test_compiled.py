"""The compiled loop against the one in Python: the same motion to rounding, the same words."""

import itertools
import warnings
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.kernel import limits
from fflin.kernel.compiled import ENGINES
from fflin.kernel.tree import batch_tree
from fflin.simulation import lanes, run
from fflin.simulation.plan import Plan, SimulationOptions
from fflin.simulation.plant import Plant
from tests.support.measured import POSITIONS, designed
from tests.support.motions import HOME, displaced
from tests.support.motions import motion as trajectory
from tests.support.robots import (
    BUNDLED,
    FRAMES,
    LINKS,
    MIMIC,
    free_body,
    random_point,
    random_tree,
)
from tests.support.weights import unit_weights

pytest.importorskip("numba")

from fflin.kernel import loop, tree

pytestmark = pytest.mark.compiled

WHEEL = fflin.ReactionWheel(
    (0, 0, 1), name="spin", inertia=0.02, max_speed=300.0, max=0.5
)
STORING = fflin.ReactionWheel((1, 2, 2), name="storing", momentum=3.0)


def both(robot, policy=None, tolerance=1e-10, rounding=2e-14, **options):
    """Run both loops, hold one against the other, and return the compiled one's motion."""
    options = {"duration": 10.0, "dt": 0.01, "linear": False} | options
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fflin.FflinWarning)
        python, motion = (
            fflin.simulate(robot, policy, **options, engine=engine)
            for engine in ENGINES
        )
    assert (python.engine, motion.engine) == ENGINES
    assert motion.stopped == python.stopped
    for name in ("t", "q", "v", "x", "u", "energy", "momentum"):
        expected, result = getattr(python, name), getattr(motion, name)
        assert result.shape == expected.shape, name
        size = np.maximum(1.0, np.abs(expected).max(axis=0))
        if name == "momentum":
            # The sum has the rounding of its terms, the momenta of the bodies.
            size = np.maximum(size, robot.mass * np.abs(python.v).max())
        assert (np.abs(result - expected) <= tolerance * size).all(), name
    if options.get("project", True):
        assert (
            motion.momentum_drift.max() <= rounding + 2.0 * python.momentum_drift.max()
        )
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
    for method in ("cf4", "semi_implicit_euler"):
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
PASSIVE["all"] = {
    key: value for each in PASSIVE.values() for key, value in each.items()
}


@pytest.mark.parametrize("fields", PASSIVE.values(), ids=PASSIVE)
def test_forces_of_all_kinds(fields):
    robot = fflin.load("canadarm2", **fields)
    lin = fflin.linearize(robot)
    K = 0.05 * np.random.default_rng(1).normal(size=lin.B.shape[::-1])
    policy = fflin.StateFeedback(lin, K)
    # Under gravity, this loop diverges after some seconds, and rounding errors grow with it.
    both(robot, policy, x0=displaced(lin), duration=1.5)


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
    motion = both(
        robots["ets_vii"], policy, x0=x0, delay=delay, limits=limits, duration=5.0
    )
    assert motion.u[:, :3].min() == -0.5
    both(robots["ets_vii"], policy, x0=x0, delay=delay, every=7, duration=5.0)
    both(
        robots["ets_vii"],
        feedback(robots["ets_vii"]),
        sample=0.03,
        delay=delay,
        x0=x0,
        dt=0.01,
    )


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
        fflin.Thruster(
            "base", place, way, f"jet_{k}", max=0.3, on_off=on_off, least_impulse=least
        )
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
        motion = both(
            robot, policy, x0=displaced(lin), dt=0.02, delay=delay, duration=4.0
        )
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
    slew = fflin.simulate(
        robot, feedback(robot), x0=x0, duration=6.0, dt=0.1, engine="python"
    )
    path = fflin.Trajectory(robot, slew.t + 2.0, slew.q, slew.v, slew.u, frame="hybrid")
    return fflin.tvlqr(fflin.linearize_trajectory(robot, path), *unit_weights(lin))


@pytest.mark.parametrize(
    "case", [{}, {"duration": 3.0}, {"sample": 0.05, "delay": 0.05}]
)
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
        gains = fflin.tvlqr(
            along, *unit_weights(fflin.linearize(robot, q[0])), sample=0.05
        )
        both(robot, gains, dt=0.01, duration=0.4, v0=1.1 * v[0], q0=q[0])


def test_a_run_stops_at_the_same_step_with_the_same_words(robots):
    robot = robots["servicer_7dof"]
    policy = feedback(robot)
    policy = replace(policy, K=-3.0 * policy.K)
    motion = both(robot, policy, tolerance=1e-6, x0=displaced(policy.lin))
    assert motion.stopped.startswith("diverged")
    assert 20 < len(motion.t) < 1001


def test_an_orbit_loses_no_accuracy(robots):
    robot = robots["canadarm2"]
    reference = pin.SE3(HOME.rotation, np.array([7e6, 1e5, -2e5]))
    lin = fflin.linearize(
        robot,
        np.array([*reference.translation, *robot.neutral()[3:]]),
        reference=reference,
    )
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    x0 = displaced(lin)
    # A place is rounded to 1e-9 m there, and so is what the feedback sees of it.
    both(robot, policy, 1e-7, 1e-8, x0=x0, duration=3.0)


def test_ctrl_c_keeps_finished_work(robots, monkeypatch):
    count = itertools.count()

    def update(self, done, total):
        if next(count) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(lanes.Progress, "__call__", update)
    motion = fflin.simulate(
        robots["cubesat"], duration=500.0, dt=0.01, engine="compiled"
    )
    assert motion.stopped == f"interrupted at t = {motion.t[-1] + 0.01:g} s"
    assert 4 * 16 <= len(motion.t) < 1e6


@pytest.mark.parametrize("every", [1, 7, 60, 100, 1000])
@pytest.mark.parametrize("memory", [1, 2**22])
def test_recorded_rows_do_not_depend_on_the_slices(robots, monkeypatch, every, memory):
    robot, calls = robots["cubesat"], []
    policy = feedback(robot)
    options = {
        "x0": displaced(policy.lin),
        "duration": 1.0,
        "dt": 0.01,
        "linear": False,
    }
    motion = fflin.simulate(robot, policy, **options, engine="compiled")
    kernel = lanes.kernel
    counted = lambda *names: lambda *a: [calls.append(a), kernel(*names)(*a)]  # noqa: E731
    monkeypatch.setattr(lanes, "kernel", counted)
    monkeypatch.setattr(lanes, "_MEMORY", memory)
    result = fflin.simulate(robot, policy, **options, every=every, engine="compiled")
    chosen = np.append(np.arange(0, 100, every), 100)
    for name in ("t", "q", "v", "u"):
        np.testing.assert_array_equal(
            getattr(result, name), getattr(motion, name)[chosen]
        )
    # Each call fills its memory: one row, or all rows of the run.
    assert len(calls) == (-(-100 // every) if memory == 1 else 1)


def test_limits_of_modal_rates_are_scaled_like_the_rates():
    robot = fflin.load("inspector_flexible.toml")
    plan = Plan(SimulationOptions(robot=robot, policy=None, duration=0.2, dt=0.01))
    stop = run.stop_conditions(plan)
    limits = plan.plant.state.velocities(np.sqrt(stop.squares))
    assert limits.min() < 0.5 * limits.max()
    np.testing.assert_allclose(
        lanes.packed(plan, stop).stop.squares, limits**2, rtol=1e-15
    )


def nothing(t, q, v):
    return np.zeros(9)


def test_a_policy_that_cannot_be_compiled_gives_the_reason(robots):
    robot, options = robots["planar_detumble"], {"duration": 0.1, "engine": "compiled"}
    cases = (
        ({"policy": nothing}, "Python"),
        ({"callback": print}, "callbacks"),
        ({"events": [lambda t, q, v: 1.0]}, "events"),
        ({"disturbance": lambda t, q, v: np.zeros(robot.nv)}, "disturbances"),
    )
    for more, words in cases:
        with pytest.raises(fflin.InputError, match=words):
            fflin.simulate(robot, **options, **more)
        assert (
            fflin.simulate(robot, **(options | {"engine": None}), **more).engine
            == "python"
        )
    with pytest.raises(fflin.UnknownNameError, match="compiled"):
        fflin.simulate(robot, duration=0.1, engine="compile")
    monkeypatched = pytest.MonkeyPatch()
    with monkeypatched.context() as patch:
        patch.setattr(limits, "numba_is_there", lambda: False)
        with pytest.raises(fflin.InputError, match="numba"):
            fflin.simulate(robot, **options)


def test_a_long_run_goes_compiled_if_its_machine_code_is_there(
    robots, monkeypatch, tmp_path
):
    robot = robots["cubesat"]
    for kept, longest, engine in (
        (True, 10, "python"),
        (False, 9, "python"),
        (True, 9, "compiled"),
    ):
        monkeypatch.setattr(lanes, "is_kept", lambda *_, kept=kept: kept)
        monkeypatch.setattr(lanes, "LONG", longest)
        motion = fflin.simulate(robot, duration=0.1, dt=0.01)
        assert motion.engine == engine
        motion.save(tmp_path / "motion.npz")
        assert fflin.Motion.load(tmp_path / "motion.npz").engine == engine


def test_eight_lanes_are_eight_runs(robots):
    """Each with a start, masses and forces of its own."""
    jet = fflin.Thruster("link_2", (0.2, 0.1, 0.0), (1.0, 0.5, 0.2), "jet")
    robot = robots["ets_vii"].replace(inputs=[*robots["ets_vii"].inputs, jet, STORING])
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    starts, masses, gains = np.random.default_rng(6).uniform(0.8, 1.2, (3, 8))
    plans, runs = [], []
    for share, mass, gain in zip(starts, masses, gains, strict=True):
        model = robot.model.copy()
        for joint in range(1, model.njoints):
            model.inertias[joint] = pin.Inertia.FromDynamicParameters(
                mass * model.inertias[joint].toDynamicParameters()
            )
        copy = fflin.from_model(model, inputs=robot.inputs)
        options = {
            "x0": share * displaced(lin),
            "duration": 2.0,
            "dt": 0.01,
            "linear": False,
        }
        plan = Plan(SimulationOptions(robot=copy, policy=policy, **options))
        plant = plan.plant
        faults = plant.faults._replace(gain=np.full(len(plant.faults.gain), gain))
        plans.append(plan.replace(plant=Plant(plant.state, faults=faults)))
        start = {"q": plan.q, "nu": plant.state.velocities(plan.v)}
        runs.append(start | {"bodies": batch_tree(copy).bodies} | faults._asdict())
    together, kept = lanes.LaneLoop(plans[0]), Kept()
    out = {"end": np.empty(8)}
    together.fly(
        kept, out, {key: np.array([each[key] for each in runs]) for key in runs[0]}
    )
    assert (out["end"] == 200.0).all()
    first, second, third = together.ends[:3]
    rows = np.concatenate(kept.slices).transpose(0, 2, 1)
    q, u = rows[..., :first], rows[..., second:third]
    for lane, plan in enumerate(plans):
        motion = run.go(plan)
        np.testing.assert_allclose(q[:20, lane], motion.q[:200:10], rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            u[:20, lane], motion.u[:200:10], rtol=1e-11, atol=1e-11
        )
        np.testing.assert_allclose(q[-1, lane], motion.q[-1], rtol=0, atol=1e-12)
    assert np.ptp(q[-1, :, :7], axis=0).min() > 1e-4


class Kept(lanes.Statistics):
    """Every tenth row of eight runs, in slices of 150 steps, and the last."""

    every, span = 10, 150

    def __init__(self):
        self.slices = []

    def add(self, first, rows):
        self.slices.append(rows.copy())

    def outcome(self, done, stop):
        return {"end": np.full(8, float(done))}


def test_arguments_are_laid_out_or_refused():
    given = loop.Wheels(*(np.array([k]) for k in range(7)))
    wheels, words, _ = tree.laid_out(given, loop.WHEELS)
    assert wheels.at.dtype == np.intp and wheels.stiffness.dtype == float
    assert len(words) == loop.WHEELS.size == 14 and words[1::2].tolist() == [1] * 7
    with pytest.raises(AssertionError):
        tree.laid_out(given._replace(at=np.zeros((1, 1))), loop.WHEELS)


def test_a_command_that_is_not_a_number_is_refused(robots):
    robot = robots["cubesat"]
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, np.full(lin.B.shape[::-1], 1e308))
    x0 = displaced(lin, offset=100.0)
    options = {"x0": x0, "sample": 0.01, "duration": 0.1, "linear": False}
    message = []
    for engine in ENGINES:
        with np.errstate(over="ignore"), pytest.raises(fflin.InputError) as caught:
            fflin.simulate(robot, policy, **options, engine=engine)
        message.append(str(caught.value))
    assert message[0] == message[1]
    assert "tau_b.x" in message[0]


def test_a_long_run_in_python_estimates_the_duration_of_the_compiled_loop(
    robots, monkeypatch, caplog
):
    monkeypatch.setattr("fflin.simulation.simulate.LONG_RUN", 0.0)
    options = {"duration": 0.1, "linear": False}
    fflin.simulate(robots["cubesat"], **options, engine="python")
    (record,) = caplog.records
    assert "--engine compiled" in record.message
    fflin.simulate(robots["cubesat"], **options, events=[lambda t, q, v: 1.0])
    assert len(caplog.records) == 1  # which the compiled loop does not do


def test_a_run_in_python_names_the_compiled_loop_if_it_can_run_there(
    robots, monkeypatch
):
    hints = []

    class Bar:
        def __init__(self, shown):
            pass

        def __call__(self, done, total, hint):
            hints.append(hint)

        def close(self):
            pass

    monkeypatch.setattr(run, "Progress", Bar)
    options = {"duration": 0.1, "linear": False, "engine": "python"}
    fflin.simulate(robots["cubesat"], **options)
    assert hints == ["(faster: --engine compiled) "]
    fflin.simulate(robots["cubesat"], **options, events=[lambda t, q, v: 1.0])
    assert hints[1:] == [""]  # the compiled loop calls no events
