"""Inputs that are misaligned, noise of what is sensed, and delays that are drawn."""

import os
import signal
from itertools import product

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.campaign.campaign import ARRAYS
from fflin.campaign.dispersions import turned
from fflin.campaign.report import worst_runs
from fflin.campaign.runs import CampaignJob
from fflin.robot.equipment.assembly import turned_to
from tests.support import policies
from tests.support.campaigns import both
from tests.support.robots import BUNDLED, free_body

pytestmark = pytest.mark.filterwarnings("ignore::fflin.FflinWarning")

ENGINES = ["python", pytest.param("compiled", marks=pytest.mark.compiled)]
DRAWN = {
    policies.state: {"q_b": 0.05, "*.noise": 1e-3, "delay": (0.0, 0.15)},
    policies.outputs: {
        "q_b": 0.05,
        "*.noise": 1e-3,
        "*.sensor": 1e-3,
        "delay": [0.0, 0.07],
    },
    policies.controlled: {"q_b": 0.05, "*.sensor": 1e-3},
    policies.controlled_in_samples: {
        "q_b": 0.05,
        "*.noise": 1e-3,
        "delay": [0.0, 0.07],
    },
    policies.followed: {"q_b": 0.05},
    policies.followed_outputs: {"q_b": 0.05, "*.noise": (1e-4, 1e-3), "*.sensor": 1e-3},
    policies.between_gains: {"q_m.*": 0.2},
    policies.shared: {
        **{"q_b": 0.05, "jet_*.misalignment": 0.1, "delay": 0.05},
        **{"q_b.sensor": 0.01, "omega_b.noise": 1e-3},
    },
}


@pytest.mark.compiled
@pytest.mark.parametrize("make", DRAWN, ids=lambda make: make.__name__)
@pytest.mark.parametrize("name", BUNDLED[::3])
def test_lanes_fly_every_policy(robots, name, make):
    if make is policies.between_gains and not robots[name].n:
        pytest.skip("there are no joints to lay a grid over")
    robot, policy, options = make(policies.plain(robots[name]))
    options = {
        key: value for key, value in options.items() if key not in ("linear", "x0")
    }
    sample = {"sample": 0.1} if make is policies.state else {}
    case = {"dt": 0.02, "duration": 1.0, "method": "cf4"} | options | sample
    drawn = DRAWN[make] | {"base.mass": 0.1}
    tolerance = 1e-8 if make is policies.shared else 1e-10
    both(robot, policy, drawn, tolerance=tolerance, **case)


def equipped():
    """A robot with inputs of all kinds, two of its wheels not on the base."""
    motors = [fflin.JointTorque(f"joint_{k}") for k in range(1, 8)]
    jet = fflin.Thruster(
        "link_3", (0.2, 0.1, 0.0), (1.0, 0.5, 0.2), "jet", max=5.0, torque=0.4
    )
    storing = fflin.ReactionWheel((1, 2, 2), "link_2", name="storing", momentum=3.0)
    spin = fflin.ReactionWheel((1, -2, 1), "link_3", name="spin", inertia=1e-3)
    inputs = [fflin.BaseForce(), *motors, jet, storing, fflin.BaseTorque(), spin]
    return fflin.load("canadarm2", inputs=inputs)


@pytest.mark.compiled
def test_lanes_turn_inputs_of_all_kinds():
    robot = equipped()
    lin = fflin.linearize(robot)
    K = 0.1 * np.random.default_rng(1).normal(size=lin.B.shape[::-1])
    names = ("jet", "storing", "spin", "F_b", "tau_b.y")
    given = {f"{name}.misalignment": 0.2 for name in names} | {"joint_3.mass": 0.1}
    rates = {"omega_b": 0.3, "qdot_m.spin": 30.0}
    for frame in ("hybrid", "local"):
        lin = fflin.linearize(robot, frame=frame)
        both(robot, fflin.StateFeedback(lin, K), given | rates, duration=1.0)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_run_with_misaligned_thrusters_goes_on_past_half_a_turn(engine):
    if engine == "compiled":
        pytest.importorskip("numba")
    given = fflin.load_inputs("cubesat")
    robot = fflin.load(
        "cubesat", inputs=[x for x in given if isinstance(x, fflin.Thruster)]
    )
    design = robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    lin = fflin.linearize(design)
    policy = fflin.Allocation(fflin.StateFeedback(lin, np.zeros((6, 12))), design)
    x0 = np.zeros(12)
    # half of 170 deg; beyond 180 deg after 0.35 s
    x0[0], x0[6] = np.sin(np.radians(85.0)), 0.5
    case = {"runs": 2, "duration": 1.0, "dt": 0.05, "x0": x0, "engine": engine}
    campaign = fflin.monte_carlo(robot, policy, {"thrust.misalignment": 0.01}, **case)
    assert not campaign.stopped.any()
    # 0.5 rad/s for 1 s from 170 deg are 198.6 deg, or 161.4 deg the other way round.
    final = 360.0 - 170.0 - np.degrees(0.5)
    np.testing.assert_allclose(campaign.values("attitude"), final, atol=1e-9)
    assert (campaign.values("worst attitude") <= 180.0).all()


def test_a_direction_is_turned_about_two_axes_across_it():
    rng = np.random.default_rng(0)
    for direction in (*np.eye(3), *rng.normal(size=(3, 3))):
        along = direction / np.linalg.norm(direction)
        axes, angles = turned_to(along), rng.normal(size=(5, 2))
        for result, (a, b) in zip(turned(along, angles), angles, strict=True):
            expected = pin.exp3(a * axes[:, 0] + b * axes[:, 1]) @ along
            np.testing.assert_allclose(result, expected, atol=1e-15)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_body_goes_where_its_jet_points(engine):
    if engine == "compiled":
        pytest.importorskip("numba")
    jet = fflin.Thruster("base", (0.0, 0.0, 0.0), (0.0, 2.0, 0.0), "jet", max=3.0)
    robot = free_body((2.0, 3.0, 4.0)).replace(inputs=[jet, fflin.BaseForce()])
    for name, u, along in (
        ("thrust.jet", [2.0, 0.0, 0.0, 0.0], (0.0, 1.0, 0.0)),
        ("F_b.x", [0.0, 2.0, 0.0, 0.0], (1.0, 0.0, 0.0)),
        ("F_b.z", [0.0, 0.0, 0.0, 2.0], (0.0, 0.0, 1.0)),
    ):
        policy = fflin.StateFeedback(fflin.linearize(robot), np.zeros((4, 12)))
        policy.lin.__dict__["u0"] = np.array(u)
        given = {f"{name}.misalignment": 0.3}
        campaign = fflin.monte_carlo(
            *(robot, policy, given),
            **{"runs": 3, "duration": 1.0, "dt": 0.1, "engine": engine},
        )
        assert campaign.names == (f"{name}.misalignment.1", f"{name}.misalignment.2")
        expected = 2.0 / robot.mass * turned(np.array(along), np.array(campaign.drawn))
        np.testing.assert_allclose(campaign.v[:, :3], expected, rtol=0, atol=1e-12)


def turned_by_noise(engine, size=0.05, **more):
    """A body whose torque about x is the noise of its rate."""
    robot = free_body((2.0, 3.0, 4.0)).replace(inputs=[fflin.BaseTorque()])
    K = np.zeros((3, 12))
    K[0, 6] = 1.0
    policy = fflin.StateFeedback(fflin.linearize(robot), K)
    options = {"duration": 40.0, "dt": 0.1, "sample": 0.2, "engine": engine, "runs": 20}
    return fflin.monte_carlo(
        robot, policy, {"omega_b.x.noise": size}, **(options | more)
    )


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", ENGINES)
def test_sensor_errors_act_on_the_policy_that_an_allocation_realises(engine):
    if engine == "compiled":
        pytest.importorskip("numba")
    robot = free_body((2.0, 3.0, 4.0)).replace(
        inputs=[fflin.BaseTorque(), fflin.BaseForce()]
    )
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.acceleration_lqr(lin, 0.04, 0.2, 1.0).K)
    given = {"q_b.x.sensor": (0.02, 0.03), "omega_b.noise": 1e-3}
    run = {"runs": 3, "duration": 60.0, "dt": 0.1, "sample": 0.2, "engine": engine}
    ends = [
        fflin.monte_carlo(robot, item, given, **run)
        for item in (policy, fflin.Allocation(policy, robot))
    ]
    # The attitude that is read as zero is minus the error of the sensor.
    offset = ends[0].values("drawn q_b.x.sensor")
    np.testing.assert_allclose(ends[0].values("q_b.x"), -offset, atol=4e-3)
    np.testing.assert_allclose(ends[1].x, ends[0].x, rtol=0, atol=1e-9)
    replayed = ends[1].replay(1)
    assert np.array_equal(replayed.q[-1], ends[1].q[1]) and len(replayed.target)


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", ENGINES)
def test_noise_is_white_and_each_run_has_its_own(engine):
    if engine == "compiled":
        pytest.importorskip("numba")
    campaign = turned_by_noise(engine)
    heard = []
    for run in range(20):
        motion = campaign.replay(run)
        assert np.array_equal(motion.q[-1], campaign.q[run])
        heard.append((-motion.u[:-1, 0] - motion.v[:-1, 3])[::2])
        assert np.array_equal(motion.u[:-1:2], motion.u[1::2])
    heard = np.array(heard)
    assert heard.shape == (20, 200)
    count = heard.size
    assert heard.mean() == pytest.approx(0.0, abs=4.0 * 0.05 / count**0.5)
    assert heard.std() == pytest.approx(0.05, rel=4.0 / (2.0 * count) ** 0.5)
    for a, b in ((heard[:, 1:], heard[:, :-1]), (heard[1:], heard[:-1])):
        assert (a * b).mean() == pytest.approx(0.0, abs=4.0 * 0.05**2 / a.size**0.5)
    assert campaign.names == ("noise", "omega_b.x.noise")
    assert set(campaign.values("drawn omega_b.x.noise")) == {0.05}


@pytest.mark.parametrize("spread", [0.05, (0.01, 0.05)])
def test_the_worst_runs_of_noise_are_reported_by_its_deviation(spread):
    """The seed of a run's noise is drawn too and is none of what errors come of."""
    campaign = turned_by_noise("python", spread, runs=4, duration=1.0)
    rows = worst_runs(campaign, 2)[1].splitlines()
    for run, row in zip(campaign.worst(2), rows[-2:], strict=True):
        drawn = f"omega_b.x.noise = {campaign.values('drawn omega_b.x.noise')[run]:.3g}"
        assert row.rstrip().endswith(" -" if spread == 0.05 else drawn)


@pytest.mark.compiled
def test_noise_is_the_same_for_any_chunks_and_threads_and_whatever_else_ends():
    pytest.importorskip("numba")
    whole = turned_by_noise("compiled", 15.0)
    parts = turned_by_noise("compiled", 15.0, chunk=8, threads=2, runs=9)
    assert len({*whole.end}) > 5  # runs diverge at different times
    for name in ARRAYS:
        assert np.array_equal(getattr(whole, name)[:9], getattr(parts, name)), name
    for run in range(20):
        assert np.array_equal(whole.replay(run).q[-1], whole.q[run])


@pytest.mark.compiled
def test_a_drawn_delay_is_the_delay_of_its_run(robots):
    robot = robots["planar_detumble"]
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    case = {"dt": 0.01, "sample": 0.04, "duration": 1.0, "x0": lin.x0 + 0.01}
    given = {"delay": [-0.03, 0.0, 0.016, 0.1]}
    for engine, delay in product(("python", "compiled"), (0.0, 0.02)):
        if engine == "compiled":
            pytest.importorskip("numba")
        options = {**case, "delay": delay, "engine": engine}
        campaign = fflin.monte_carlo(robot, policy, given, runs=12, **options)
        for run, late in enumerate(campaign.values("drawn delay").tolist()):
            options["delay"] = max(0.0, round((delay + late) / 0.01) * 0.01)
            motion = fflin.simulate(robot, policy, **options)
            np.testing.assert_allclose(
                campaign.q[run], motion.q[-1], rtol=0, atol=1e-12
            )
        assert len({*campaign.values("drawn delay")}) == 4


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"q_b.noise": 0.1}, "noise"),
        ({"delay": 0.1}, "delay"),
        ({"q_b.noise": -0.1}, "standard deviation"),
        ({"joint_7.misalignment": 0.1}, "misalignment"),
        ({"tau_m.joint_2.misalignment": 0.1}, "motor"),
        ({"delay.x": 0.1}, "delay.x"),
    ],
)
def test_a_quantity_that_cannot_be_dispersed_is_refused(robots, given, words):
    robot = robots["planar_detumble"]
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    with pytest.raises(fflin.FflinError, match=words):
        CampaignJob(robot, policy, given, 0, "python", {"duration": 1.0})


@pytest.fixture(scope="module")
def dask():
    """A client of a local cluster of two processes."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


@pytest.mark.process
def test_dask_flies_the_same(robots, dask):
    robot = robots["planar_detumble"]
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    given = {"q_b": 0.05, "*.mass": 0.1, "q_b.noise": 1e-3, "delay": [0.0, 0.02]}
    case = {"runs": 20, "duration": 0.2, "dt": 0.02, "sample": 0.04, "engine": "python"}
    campaign = fflin.monte_carlo(robot, policy, given, **case)
    expected_value = fflin.monte_carlo(
        robot, policy, given, executor=dask.get_executor(), chunk=8, **case
    )
    assert all(
        np.array_equal(getattr(campaign, name), getattr(expected_value, name))
        for name in ARRAYS
    )
    assert np.array_equal(expected_value.replay(19).q[-1], campaign.q[19])


@pytest.mark.process
def test_a_lost_worker_of_dask_is_reported(robots, dask):
    robot = robots["planar_detumble"]
    case = {"runs": 64, "duration": 0.2, "dt": 0.02, "engine": "python", "chunk": 8}
    campaign = fflin.monte_carlo(robot, None, {"q_b": 0.05}, **case)
    processes = list(dask.run(os.getpid).values())

    def kill(done, total):
        if processes:
            os.kill(processes.pop(), signal.SIGKILL)
            processes.clear()

    with pytest.warns(fflin.FflinWarning, match="1 worker of the executor ended"):
        expected_value = fflin.monte_carlo(
            robot,
            None,
            {"q_b": 0.05},
            executor=dask.get_executor(),
            progress=kill,
            **case,
        )
    assert np.array_equal(campaign.q, expected_value.q)
