"""Campaigns: the runs are those of `simulate`, equal for any workers, and statistics that hold."""

import csv
import io
import itertools
import os
import sys
import textwrap
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import scipy.io
from scipy import stats
from scipy.linalg import expm

import fflin
from fflin.base import process
from fflin.campaign.campaign import ARRAYS
from fflin.campaign.report import influences, worst_runs
from fflin.campaign.runs import KINDS, CampaignJob
from fflin.simulation.report import error_sizes
from tests.support.campaigns import both
from tests.support.measured import FELT, POSITIONS, designed
from tests.support.messages import any_wording, says
from tests.support.patience import finished
from tests.support.robots import BUNDLED, LINKS, MIMIC, free_body
from tests.support.weights import unit_weights

pytestmark = pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
ENGINES = ["python", pytest.param("compiled", marks=pytest.mark.compiled)]

START = {"q_b": 0.05, "r_b.x": (-0.1, 0.2), "omega_b": 0.02}


@pytest.fixture(autouse=True)
def _numba(request):
    if (
        "engine" in request.fixturenames
        and request.getfixturevalue("engine") == "compiled"
    ):
        pytest.importorskip("numba")


def feedback(robot, frame="hybrid"):
    lin = fflin.linearize(robot, frame=frame)
    return fflin.StateFeedback(lin, fflin.lqr(lin).K)


@pytest.mark.compiled
@pytest.mark.parametrize("name", BUNDLED)
def test_lanes_agree_with_single_runs(robots, name):
    robot = robots[name]
    given = START | {"*.mass": 0.1, "*.com": 0.1, "*.inertia": (-0.2, 0.2)}
    if robot.n:
        given |= {"q_m.*": 0.05, "qdot_m": 0.01}
    for frame in ("hybrid", "local"):
        lanes = both(robot, feedback(robot, frame), given)
        assert len({*lanes["largest"][:, 0]}) == 3
    lin = feedback(robot).lin
    inputs = {"*.gain": 0.1, "*.bias": 0.01, "*.sensor": 1e-3}
    both(robot, feedback(robot), inputs | {f"{lin.input_names[0]}.fails": (0.5, 2.0)})


@pytest.mark.compiled
def test_lanes_of_all_kinds_of_forces():
    spring = {"stiffness": {"joint_*": 2.0}, "damping": {"joint_*": 0.5}}
    robot = fflin.load(
        "canadarm2",
        gravity=(0.3, -0.2, -1.0),
        inputs=[
            *(fflin.JointTorque(f"joint_{k}") for k in range(1, 8)),
            fflin.Thruster("link_3", (0.2, 0.1, 0.0), (1.0, 0.5, 0.2), "jet", max=5.0),
            fflin.ReactionWheel((1, 2, 2), name="storing", momentum=3.0),
        ],
        **spring,
    )
    policy = fflin.StateFeedback(fflin.linearize(robot), np.zeros((9, 26)))
    given = {"joint_*.stiffness": (-0.5, 0.5), "*.damping": 0.1, "joint_3.mass": 0.3}
    given |= {"jet.bias": (0.1, 1.0), "wheel.bias": 0.2, "qdot_m": 0.1}
    both(robot, policy, given)


@pytest.mark.compiled
def test_wheels_with_inertia_and_their_limits():
    wheels = [
        fflin.ReactionWheel(axis, name=f"w{k}", inertia=0.02, max_speed=30.0, max=0.5)
        for k, axis in enumerate(np.eye(3).tolist())
    ]
    robot = free_body((20.0, 30.0, 40.0)).replace(inputs=wheels)
    lin = fflin.linearize(robot)
    K = np.zeros((3, lin.A.shape[0]))
    K[:, :3], K[:, 9:12] = -3.0 * np.eye(3), -8.0 * np.eye(3)
    given = {
        "q_b": 0.1,
        "base.mass": 0.1,
        "base.com": 0.1,
        "base.inertia": 0.1,
        "w0.gain": 0.2,
    }
    lanes = both(
        robot, fflin.StateFeedback(lin, K), given, limits="urdf", duration=10.0
    )
    assert lanes["largest_x"][:, 12:15].max() <= 30.0 + 1e-9


@pytest.mark.compiled
def test_mimic_joints(tmp_path):
    path = tmp_path / "gripper.urdf"
    for a, b in itertools.product(("revolute", "continuous", "prismatic"), repeat=2):
        mimic = '<mimic joint="b" multiplier="-0.7" offset="0.2"/>'
        path.write_text(MIMIC.format(links=LINKS, a=a, b=b, parent="base", mimic=mimic))
        robot = fflin.load(path)
        both(robot, feedback(robot), {"q_m": 0.3, "*.mass": 0.1}, duration=1.0)


@pytest.mark.compiled
def test_wheels_on_another_branch_do_not_change_bodies(robots):
    """The wheel's joint stands before the joints of the arm's other branch."""
    robot = robots["dual_arm"]
    first, last = robot.joint_names[0], robot.joint_names[-1]
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), first, inertia=1e-4, name="w")
    robot = robot.replace(inputs=[*robot.inputs, wheel])
    assert robot.joint_names[-1] == last and robot.joint_names.index("w") < robot.n - 1
    lin = fflin.linearize(robot)
    K = np.random.default_rng(1).normal(size=lin.B.T.shape) * 1e-3
    given = {
        "qdot_m.*": 0.1,
        f"{last}.mass": 0.3,
        f"{last}.com": 0.3,
        f"{first}.inertia": 0.2,
    }
    both(robot, fflin.StateFeedback(lin, K), given, duration=0.5)


@pytest.mark.compiled
def test_outputs_samples_delay_and_limits(robots):
    robot, lin, compensator = designed(POSITIONS)
    policy = fflin.OutputFeedback(lin, compensator)
    both(robot, policy, {"q_m": 0.02, "*.sensor": 1e-3, "*.mass": 0.05})
    limits = {"tau_b": (-0.5, 0.7), "tau_m": 2.0}
    sampled = {"sample": 0.05, "delay": 0.02, "limits": limits}
    both(robots["ets_vii"], feedback(robots["ets_vii"]), START, **sampled)


def test_a_compensator_that_feels_acceleration_runs_in_python():
    robot, lin, compensator = designed(FELT)
    policy = fflin.OutputFeedback(lin, compensator)
    given = {"q_m": 0.01, "base.mass": 0.1, "*.sensor": 1e-3}
    campaign = fflin.monte_carlo(robot, policy, given, runs=2, duration=0.2)
    assert campaign.engine == "python"
    assert np.array_equal(campaign.replay(1).q[-1], campaign.q[1])


@pytest.mark.compiled
def test_along_a_trajectory(robots):
    robot = robots["ets_vii"]
    slew = fflin.simulate(
        robot, feedback(robot), q0=robot.neutral(), duration=2.0, dt=0.1
    )
    path = fflin.Trajectory(robot, slew.t, slew.q, slew.v, slew.u, frame="hybrid")
    along = fflin.linearize_trajectory(robot, path)
    schedule = fflin.tvlqr(along, *unit_weights(fflin.linearize(robot)))
    lanes = both(
        robot, schedule, {"q_b": 0.05, "q_m": 0.1, "*.mass": 0.05}, duration=2.5
    )
    assert (lanes["errors"][:, 0] < lanes["largest"][:, 0]).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_a_run_is_flown_again_to_the_last_bit_and_keeps_its_momentum(robots, engine):
    robot = robots["servicer_7dof"]
    given = START | {"*.mass": 0.1, "base.inertia": 0.1, "base.com": 0.2, "qdot_m": 0.1}
    case = {"runs": 11, "duration": 2.0, "dt": 0.02, "engine": engine, "seed": 3}
    campaign = fflin.monte_carlo(robot, None, given, **case)
    for run in (0, 10):
        motion = campaign.replay(run)
        assert motion.engine == campaign.engine == engine
        for name in ("q", "v", "u"):
            assert np.array_equal(
                getattr(motion, name)[-1], getattr(campaign, name)[run]
            ), name
        # The state is read from these by other code.
        np.testing.assert_allclose(
            motion.x[-1], campaign.x[run], rtol=1e-13, atol=1e-15
        )
        assert motion.momentum_drift.max() < 1e-13 and motion.com_drift.max() < 1e-13
    masses = campaign.values("drawn base.mass")
    assert motion.energy[0] > 0.0 and len({*masses}) == 11
    # The same robot and start by other ways: what `simulate` makes of them is the same run.
    job = campaign._job
    plant, _, q, v = job.dispersions.one(campaign.drawn[10])
    assert plant.robot.mass != robot.mass
    base = plant.robot.model.inertias[1]
    assert base.mass == pytest.approx(
        robot.model.inertias[1].mass * (1.0 + masses[10]), rel=1e-14
    )
    other = fflin.simulate(plant.robot, None, q0=q, v0=v, duration=2.0, dt=0.02)
    assert np.abs(other.q[-1] - campaign.q[10]).max() < 1e-12


def test_a_body_that_is_drawn_is_a_body(robots):
    given = {"*.mass": (-0.9, 2.0), "*.com": 0.5, "*.inertia": (-0.9, 3.0)}
    job = CampaignJob(robots["canadarm2"], None, given, 0, "python", {"duration": 1.0})
    bodies = job.dispersions.bodies(job.dispersions.drawn(0, 200))
    assert len(bodies) == 8
    for mass, _, inertia in bodies.values():
        second = (
            0.5 * np.trace(inertia, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            - inertia
        )
        assert (mass > 0.0).all()
        assert np.linalg.eigvalsh(second).min() > 0.0


SCRIPT = """
    import os, sys, fflin
    def main(path, workers, after):
        def progress(done, total):
            if done >= after:
                os._exit(9)
        robot = fflin.load("planar_detumble")
        lin = fflin.linearize(robot)
        policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
        given = {"q_b": 0.05, "*.mass": 0.1, "q_m": (-0.2, 0.2)}
        fflin.monte_carlo(robot, policy, given, runs=90, duration=0.4, dt=0.02, chunk=16,
                          workers=workers, progress=progress, out=path)
    if __name__ == "__main__":
        main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
"""


@pytest.mark.compiled
@pytest.mark.process
def test_a_campaign_is_the_same_on_any_workers_and_after_a_kill(tmp_path):
    pytest.importorskip("h5py")
    script = tmp_path / "campaign.py"
    script.write_text(textwrap.dedent(SCRIPT))

    def run(name, workers, after=1000):
        command = [
            sys.executable,
            "-W",
            "ignore",
            script,
            tmp_path / name,
            workers,
            after,
        ]
        return finished(list(map(str, command)), env=os.environ).returncode

    for name, workers in (("one.h5", 1), ("three.h5", 3)):
        assert run(name, workers) == 0
    assert run("killed.h5", 2, 40) == 9
    assert (
        not (tmp_path / "killed.h5").exists() and (tmp_path / "killed.h5.part").exists()
    )
    assert run("killed.h5", 1) == 0
    one, *others = (
        fflin.Campaign.load(tmp_path / f"{name}.h5")
        for name in ("one", "three", "killed")
    )
    robot = fflin.load("planar_detumble")
    given = {"q_b": 0.05, "*.mass": 0.1, "q_m": (-0.2, 0.2)}
    case = {"duration": 0.4, "dt": 0.02, "threads": 2, "engine": one.engine}
    few = fflin.monte_carlo(robot, feedback(robot), given, runs=27, chunk=8, **case)
    for name in ARRAYS:
        for other in others:
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
        assert np.array_equal(getattr(one, name)[:27], getattr(few, name)), name
    assert len(one) == 90 and one.names == few.names


@pytest.mark.compiled
def test_any_executor_does_it(robots):
    robot, case = robots["planar_detumble"], {"runs": 20, "duration": 0.2, "chunk": 8}
    point = fflin.monte_carlo(robot, feedback(robot), {"q_b": 0.05}, **case)
    with ThreadPoolExecutor(2) as executor:
        expected_value = fflin.monte_carlo(
            robot,
            feedback(robot),
            {"q_b": 0.05},
            executor=executor,
            engine=point.engine,
            **case,
        )
    assert all(
        np.array_equal(getattr(point, name), getattr(expected_value, name))
        for name in ARRAYS
    )
    assert np.array_equal(expected_value.replay(19).q[-1], point.q[19])


@pytest.mark.compiled
def test_another_campaign_does_not_go_on_in_a_file(tmp_path, robots):
    pytest.importorskip("h5py")

    def stop(done, total):
        raise KeyboardInterrupt

    robot, case = robots["planar_detumble"], {"runs": 24, "duration": 0.1, "chunk": 8}
    case["out"] = tmp_path / "runs.h5"
    with pytest.raises(KeyboardInterrupt):
        fflin.monte_carlo(robot, None, {"omega_b": 0.1}, progress=stop, **case)
    with pytest.raises(fflin.FileError, match="campaign"):
        fflin.monte_carlo(robot, None, {"omega_b": 0.1}, seed=1, **case)
    campaign = fflin.monte_carlo(robot, None, {"omega_b": 0.1}, **case)
    assert len(campaign) == 24 and np.isfinite(campaign.q).all()
    assert np.array_equal(campaign.replay(23).q[-1], campaign.q[23])


def test_a_dispersion_does_not_change_the_draws_of_another(robots):
    robot, case = robots["planar_detumble"], {"runs": 5, "duration": 0.02}
    one = fflin.monte_carlo(robot, None, {"omega_b.x": 0.1}, **case)
    two = fflin.monte_carlo(robot, None, {"base.mass": 0.1, "omega_b": 0.1}, **case)
    name = "drawn omega_b.x"
    assert np.array_equal(one.values(name), two.values(name))
    other = fflin.monte_carlo(robot, None, {"omega_b.x": 0.1}, seed=1, **case)
    assert not np.isin(one.values(name), other.values(name)).any()


def test_each_kind_of_spread_has_its_distribution(robots):
    given = {
        "q_b.x": 0.05,
        "q_b.y": (-0.1, 0.2),
        "r_b.z": [1.0, 2.0, 4.0],
        "r_b.y": stats.gamma(3.0, scale=0.1),
    }
    job = CampaignJob(
        robots["planar_detumble"], None, given, 0, "python", {"duration": 1.0}
    )
    settings = dict(
        zip(job.dispersions.names, job.dispersions.drawn(0, 4000).T, strict=True)
    )
    for name, expected in (
        ("q_b.x", stats.norm(0.0, 0.05)),
        ("q_b.y", stats.uniform(-0.1, 0.3)),
        ("r_b.y", given["r_b.y"]),
    ):
        assert stats.kstest(settings[name], expected.cdf).pvalue > 1e-3, name
    values, counts = np.unique(settings["r_b.z"], return_counts=True)
    assert values.tolist() == [1.0, 2.0, 4.0]
    assert stats.chisquare(counts).pvalue > 1e-3
    assert np.abs(np.corrcoef(list(settings.values())) - np.eye(4)).max() < 0.06


@pytest.mark.compiled
def test_a_failed_input_does_nothing_from_then_on(robots):
    robot, lin = robots["planar_detumble"], fflin.linearize(robots["planar_detumble"])
    u = np.zeros(lin.B.shape[1])
    u[2] = 0.5
    for engine in ("python", "compiled"):
        if engine == "compiled":
            pytest.importorskip("numba")
        spins = []
        for failing in (1.0, 9.0):
            campaign = fflin.monte_carlo(
                robot,
                fflin.StateFeedback(replace(lin, u0=u), np.zeros(lin.B.shape[::-1])),
                {"tau_b.z.fails": [failing]},
                runs=1,
                duration=2.0,
                dt=0.01,
                engine=engine,
            )
            spins.append(campaign.v[0, 5])
        assert spins[0] == pytest.approx(0.5 * spins[1], rel=1e-2)
        assert spins[0] != 0.0


def linear_loop():
    """A body that is pushed along x alone, and how it takes a start to the end after 4 s."""
    robot = free_body((2.0, 3.0, 4.0)).replace(inputs=[fflin.BaseForce()])
    lin = fflin.linearize(robot)
    K = np.zeros((3, 12))
    K[0, 3], K[0, 9] = 30.0, 60.0
    moved = expm(4.0 * (lin.A - lin.B @ K))
    return robot, fflin.StateFeedback(lin, K), moved[3, [3, 9]]


@pytest.mark.compiled
def test_intervals_hold_the_known_answer_as_often_as_they_say():
    robot, policy, row = linear_loop()
    spread, held = (
        {"r_b.x": 0.2, "v_b.x": 0.1},
        {"mean": 0, "half": 0, "most": 0, "share": 0},
    )
    truth = stats.norm(0.0, float(np.hypot(*(row * [0.2, 0.1]))))
    bound = float(truth.ppf(0.7))
    for seed in range(200):
        campaign = fflin.monte_carlo(
            robot, policy, spread, runs=64, duration=4.0, dt=0.2, seed=seed, threads=1
        )
        result = {
            "mean": (campaign.mean("r_b.x", confidence=0.9), 0.0),
            "half": (campaign.quantile("r_b.x", 0.5, confidence=0.9), 0.0),
            "most": (campaign.quantile("r_b.x", 0.9, confidence=0.9), truth.ppf(0.9)),
            "share": (
                campaign.fraction(f"r_b.x < {bound:.17g} m", confidence=0.9),
                0.7,
            ),
        }
        for name, (item, answer) in result.items():
            held[name] += item.low <= answer <= item.high
    # Of a binomial of 200 and 0.9, less than 165 or, of the mean, more than 194 has 1e-3.
    assert min(held.values()) >= 165
    assert held["mean"] <= 194


@pytest.mark.parametrize("engine", ENGINES)
def test_runs_that_diverge_are_counted_and_are_in_no_figure(robots, engine):
    robot = robots["ets_vii"]
    given = START | {"tau_b.x.gain": [0.0, 0.0, -60.0]}
    case = {"runs": 12, "duration": 4.0, "dt": 0.02, "engine": engine, "seed": 1}
    campaign = fflin.monte_carlo(robot, feedback(robot), given, **case)
    lost = int(campaign.stopped.sum())
    assert 0 < lost < 12
    assert campaign.fraction("attitude < 360 deg").value == (12 - lost) / 12
    for name in ("q", "v", "x", "u", "largest_x", "largest_u", "errors", "largest"):
        assert np.isfinite(getattr(campaign, name)).all(), name
    assert np.isposinf(campaign.values("worst attitude")[campaign.stopped]).all()
    assert np.isposinf(campaign.settle[campaign.stopped]).all()
    assert np.isfinite(campaign.mean("attitude")).all()
    assert np.isfinite(campaign.quantile("q_b.x", 0.5).value)
    assert np.isfinite(list(campaign.sensitivity().values())).all()
    assert {*campaign.worst(lost)} == {*np.flatnonzero(campaign.stopped).tolist()}
    message = str(campaign)
    assert says(message, f"{12 - lost} ") and "nan" not in message
    first = campaign.worst(1)[0]
    motion = campaign.replay(first)
    assert motion.stopped and campaign.end[first] < 4.0
    assert np.array_equal(motion.q[-1], campaign.q[first])


@pytest.mark.compiled
def test_lanes_stop_as_single_runs_do(robots):
    robot = robots["ets_vii"]
    given = START | {"tau_b.x.gain": [0.0, -60.0]}
    lanes = both(robot, feedback(robot), given, runs=19, tolerance=1e-5, duration=9.0)
    assert {*lanes["stop"]} >= {0.0} and 0 < (lanes["stop"] > 0).sum() < 19


@pytest.mark.compiled
def test_it_stops_when_the_interval_is_narrow_enough(robots, tmp_path):
    robot, policy, _ = linear_loop()
    spread = {"r_b.x": 0.2}
    case = {"duration": 1.0, "dt": 0.5, "until": "position < 1 m", "width": 0.01}
    campaign = fflin.monte_carlo(robot, policy, spread, runs=4000, **case)
    share = campaign.fraction("position < 1 m")
    assert len(campaign) < 4000 and campaign.asked == 4000
    assert share.high - share.low <= 0.01
    assert says(str(campaign), "4,000")
    other = fflin.monte_carlo(
        robot, policy, spread, runs=4000, out=tmp_path / "c.h5", chunk=32, **case
    )
    assert np.array_equal(other.x, campaign.x)
    assert len(fflin.Campaign.load(tmp_path / "c.h5")) == len(campaign)


@pytest.fixture(scope="module")
def campaign(robots):
    robot = robots["ets_vii"]
    return fflin.monte_carlo(
        robot, feedback(robot), START, runs=40, duration=6.0, dt=0.02
    )


@pytest.mark.compiled
@pytest.mark.parametrize("ending", [".npz", ".h5"])
def test_it_is_saved_and_loaded_to_the_last_bit(campaign, ending, tmp_path):
    if ending == ".h5":
        pytest.importorskip("h5py")
    campaign.save(tmp_path / f"runs{ending}")
    again = fflin.Campaign.load(tmp_path / f"runs{ending}")
    assert (again.names, again.asked, again.judged) == (
        campaign.names,
        40,
        campaign.judged,
    )
    for name in ARRAYS:
        assert np.array_equal(getattr(again, name), getattr(campaign, name))
    assert str(again) == str(campaign)
    with pytest.raises(fflin.InputError, match="loaded from a file"):
        again.replay(0)
    content = bytearray((tmp_path / f"runs{ending}").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / f"runs{ending}").write_bytes(content)
    with any_wording(), pytest.raises(fflin.FileError):
        fflin.Campaign.load(tmp_path / f"runs{ending}")


def test_its_tables_have_every_figure_with_its_unit(tmp_path):
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    given, options = (
        {"q_b": 0.02},
        {"runs": 3, "duration": 0.2, "dt": 0.05, "engine": "python"},
    )
    campaign = fflin.monte_carlo(robot, policy, given, **options)
    for ending in ("csv", "mat"):
        campaign.save(tmp_path / f"runs.{ending}")
    with pytest.raises(fflin.FileError, match="expected one of"):
        fflin.Campaign.load(tmp_path / "runs.csv")
    names, *rows = csv.reader((tmp_path / "runs.csv").read_text().splitlines())
    saved = scipy.io.loadmat(tmp_path / "runs.mat", simplify_cells=True)
    assert saved["columns"].tolist() == names
    values = np.array(rows, dtype=float)
    np.testing.assert_array_equal(saved["runs"], values)
    columns = dict(zip(names, values.T, strict=True))
    shown = {
        "attitude [deg]": "attitude",
        "settle joints [s]": "settle joints",
        "end [s]": "end",
    }
    shown |= {"worst tau_b.x [N m]": "worst tau_b.x", "omega_b.z [rad/s]": "omega_b.z"}
    shown |= {f"drawn {name}": f"drawn {name}" for name in campaign.names}
    for column, name in shown.items():
        np.testing.assert_array_equal(columns[column], campaign.values(name))
    assert (columns["stop"] == 0.0).all()


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", ENGINES)
def test_histories_match_the_motions(robots, engine, tmp_path):
    robot = robots["ets_vii"]
    given = START | {"tau_b.x.gain": [0.0, 0.0, -60.0]}
    case = {"runs": 12, "duration": 4.0, "dt": 0.02, "engine": engine, "seed": 1}
    campaign = fflin.monte_carlo(
        robot,
        feedback(robot),
        given,
        histories=9,
        out=tmp_path / "runs.npz",
        limits={"F_b": 20},
        **case,
    )
    assert campaign.times == pytest.approx(np.arange(9) * 0.5)
    assert campaign.input_limits == (*[np.inf] * 3, *[20.0] * 3, *[np.inf] * 6)
    assert np.array_equal(
        fflin.Campaign.load(tmp_path / "runs.npz").error_history[:, -1],
        (np.where(campaign.stopped[:, None], np.inf, campaign.errors)),
    )
    assert {*campaign.stopped} == {True, False}
    for run in range(12):
        motion = campaign.replay(run)
        rows = np.arange(0, len(motion.t), 25)
        errors, inputs = campaign.error_history[run], campaign.input_history[run]
        assert errors[: len(rows), 0] == pytest.approx(
            motion.attitude_error[rows], abs=1e-12
        )
        sizes = np.abs(motion.error[rows, 3:6]).max(axis=1)
        assert errors[: len(rows), 1] == pytest.approx(sizes, abs=1e-12)
        assert np.array_equal(inputs[: len(rows)], motion.u[rows])
        assert np.isposinf(errors[len(rows) :]).all() and not inputs[len(rows) :].any()


@pytest.mark.compiled
def test_goals_appear_in_the_report_with_the_worst_run(robots):
    robot = robots["ets_vii"]
    goals = ["position < 1 mm and settle < 5 s", "attitude > 0 deg"]
    case = {"runs": 30, "duration": 6.0, "dt": 0.02, "goals": goals, "confidence": 0.9}
    campaign = fflin.monte_carlo(
        robot, feedback(robot), START, until="attitude < 2 deg", **case
    )
    settings = ["position", "settle", "attitude", "worst attitude", "worst position"]
    assert [*influences(campaign)] == settings
    assert "rank correlations with position, worst position: " in str(campaign)
    assert (
        campaign.goals == (*goals, "attitude < 2 deg") and campaign.about == "position"
    )
    assert campaign.worst(1) == [int(campaign.values("position").argmax())]
    share = campaign.fraction("attitude < 2 deg", confidence=0.9)
    assert f"attitude < 2 deg: {100 * share.value:.4g} % (" in str(campaign)
    assert "at 90 % confidence)" in str(campaign)


@pytest.mark.compiled
def test_figures_match_the_motions(campaign):
    run = campaign.worst(1)[0]
    motion = campaign.replay(run)
    settings = {
        name: campaign.values(name)[run]
        for name in ("attitude", "worst attitude", "position")
    }
    assert settings["attitude"] == pytest.approx(motion.attitude_error[-1], rel=1e-14)
    assert settings["worst attitude"] == pytest.approx(
        motion.attitude_error.max(), rel=1e-12
    )
    assert settings["position"] == pytest.approx(
        np.abs(motion.error[-1, 3:6]).max(), rel=1e-12
    )
    assert campaign.values("worst tau_b.x")[run] == np.abs(motion.u[:, 0]).max()
    assert campaign.values("worst attitude").max() == settings["worst attitude"]


@pytest.mark.compiled
def test_the_time_to_settle_matches_the_motions_table(robots):
    robot = robots["planar_detumble"]
    campaign = fflin.monte_carlo(
        robot,
        feedback(robot),
        {"q_b": 0.05, "r_b": 0.1},
        runs=3,
        duration=60.0,
        dt=0.05,
    )
    for run in range(3):
        motion = campaign.replay(run)
        made = {item.title: item for item in error_sizes(motion)}
        # A motion and a campaign call the kinds of error by the same names.
        assert [*made] == [*KINDS]
        for title, course in made.items():
            when = np.inf if course.settled is None else course.settled
            result = campaign.values(f"settle {title}")[run]
            assert result == pytest.approx(when, rel=1e-12), title
    for former, name in (
        ("turning", "omega_b"),
        ("moving", "v_b"),
        ("rates", "joint rates"),
    ):
        for settings in ("", "worst ", "settle "):
            assert np.array_equal(
                campaign.values(settings + former), campaign.values(settings + name)
            )
        assert campaign.met(f"worst {former} < 1").all()
    assert np.isfinite(campaign.values("settle")).any()


@pytest.mark.exhaustive
def test_a_report_is_within_80_columns(campaign):
    assert max(map(len, str(campaign).splitlines())) <= 80
    assert "|q_b." in str(campaign)
    first = next(iter(campaign.sensitivity("worst position")))
    assert first in ("r_b.x", "|r_b.x|")


@pytest.mark.exhaustive
def test_conditions(campaign):
    degrees = campaign.values("attitude")
    assert np.array_equal(campaign.met("attitude < 1 deg"), degrees < 1.0)
    assert np.array_equal(campaign.met("attitude<0.01 rad"), np.radians(degrees) < 0.01)
    assert np.array_equal(
        campaign.met("position <= 3 mm"), campaign.values("position") <= 3e-3
    )
    two = campaign.met("worst q_b.x > 0.05 and drawn r_b.x >= 0")
    assert np.array_equal(
        two,
        (campaign.values("worst q_b.x") > 0.05) & (campaign.values("drawn r_b.x") >= 0),
    )
    assert campaign.fraction(two).value == two.mean()
    for text, message in (
        ("attitude < 1 m", "deg"),
        ("attitude", "NAME < NUMBER UNIT"),
        ("attitude < x", "NAME < NUMBER UNIT"),
    ):
        with pytest.raises(fflin.InputError, match=message):
            campaign.fraction(text)
    with pytest.raises(fflin.UnknownNameError, match="attitude"):
        campaign.fraction("atitude < 1 deg")
    with pytest.raises(fflin.InputError, match=r"\(40,\)"):
        campaign.fraction([True])


BAD = [
    ({"given": {}}, "dispersions"),
    ({"given": 3}, "dispersions"),
    ({"given": {"nosuch": 1.0}}, "'nosuch'.*mass"),
    ({"given": {"nosuch.mass": 1.0}}, "mass.*base"),
    ({"given": {"q_b": -1.0}}, "standard deviation"),
    ({"given": {"q_b": (1.0, 0.0)}}, "least, largest"),
    ({"given": {"q_b": []}}, "values"),
    ({"given": {"q_b": stats.gamma}}, "frozen"),
    ({"given": {"q_b": 0.6}}, "attitude"),
    ({"given": {"base.mass": 0.5}}, "'base.mass'"),
    ({"given": {"base.inertia": (-2.0, 0.0)}}, "robot"),
    ({"given": {"*.stiffness": 0.1}}, "is 0"),
    ({"given": {"q_b.sensor": 0.1}}, "sensors"),
    ({"runs": 0}, "runs"),
    ({"runs": 1.5}, r"1\.5"),
    ({"runs": 10**12}, "1,000,000,000,000 rows.*memory"),
    ({"seed": -1}, "seed"),
    ({"width": 2.0}, "width"),
    ({"until": "nosuch < 1"}, "nosuch"),
    ({"until": "attitude < 1 deg", "chunk": 24}, "chunk"),
    ({"duration": None}, "duration"),
    ({"durations": 1.0}, "'durations'"),
    ({"engine": "gpu"}, "engine"),
    ({"out": "runs.csv"}, "runs.csv"),
    ({"histories": -1}, "histories"),
    ({"goals": 3}, "goals"),
    ({"goals": [3]}, "goal"),
    ({"goals": ["attitude < 1 m"]}, "deg"),
    ({"workers": 2, "executor": 3}, "workers"),
]


@pytest.mark.parametrize("case, message", BAD, ids=[message for _, message in BAD])
def test_invalid_input_is_one_line(robots, case, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = {"given": {"q_b": 0.01}, "runs": 100, "duration": 0.1} | case
    with pytest.raises(fflin.FflinError, match=message) as caught:
        fflin.monte_carlo(
            robots["planar_detumble"], None, options.pop("given"), **options
        )
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_policy_in_python_runs_in_python(robots):
    robot = robots["planar_detumble"]
    campaign = fflin.monte_carlo(
        robot,
        lambda t, q, v: -0.5 * np.ones(6 + robot.n),
        {"q_b": 0.01},
        runs=3,
        duration=0.1,
    )
    assert campaign.engine == "python" and campaign.largest_u.max() == 0.5


def test_an_object_that_cannot_be_pickled_is_named(robots):
    def nothing(t, q, v):
        return np.zeros(9)

    with pytest.raises(fflin.InputError, match="nothing"):
        fflin.monte_carlo(
            robots["planar_detumble"],
            nothing,
            {"q_b": 0.01},
            runs=2,
            duration=0.1,
            workers=1,
        )


@pytest.mark.compiled
def test_stored_data_do_not_grow_with_the_duration(robots):
    robot = robots["planar_detumble"]
    short, long = (
        fflin.monte_carlo(
            robot, None, {"q_b": 0.01}, runs=2, duration=duration, dt=0.01
        )
        for duration in (0.1, 3.0)
    )
    for name in ARRAYS:
        assert getattr(short, name).shape == getattr(long, name).shape


@pytest.mark.compiled
def test_the_world_may_be_far_away():
    pytest.importorskip("numba")
    robot = fflin.load("planar_detumble")
    reference = pin.SE3(np.eye(3), np.array([7e6, 0.0, 0.0]))
    q = np.array([7e6, *robot.neutral()[1:]])
    lin = fflin.linearize(robot, q, reference=reference)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    both(robot, policy, {"q_b": 0.01, "r_b": 0.01}, tolerance=1e-7, duration=1.0)


@pytest.mark.compiled
def test_warnings_are_given_once(robots):
    robot = robots["ets_vii"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fflin.monte_carlo(
            robot, feedback(robot), START, runs=20, duration=0.1, limits=1e-9
        )
    assert len([str(item.message) for item in caught]) <= 1


@pytest.mark.compiled
def test_a_mean_over_runs_that_did_not_settle_is_refused(robots):
    robot = robots["cubesat"]
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    drawn = {"q_b": 0.05, "tau_b.x.fails": (1.0, 2.0)}
    result = fflin.monte_carlo(robot, policy, drawn, runs=8, duration=4.0, dt=0.05)
    with pytest.raises(fflin.InputError, match=r"'settle'.*\d of 8"):
        result.mean("settle")
    with pytest.raises(fflin.InputError, match="times"):
        fflin.monte_carlo(robot, policy, {"tau_b.x.fails": 3.0}, runs=1, duration=1.0)
    noisy = {"q_b": 0.05, "q_b.x.noise": 1e-4}
    result = fflin.monte_carlo(
        robot, policy, noisy, runs=8, duration=1.0, dt=0.05, sample=0.05
    )
    assert "noise" in result.names and {
        key.strip("|") for key in result.sensitivity()
    } == {*("q_b.x", "q_b.y", "q_b.z", "q_b.x.noise")}


@pytest.mark.compiled
def test_runs_that_a_file_has_are_not_flown_again(robots, tmp_path, monkeypatch):
    robot = robots["cubesat"]
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    options = {"duration": 1.0, "dt": 0.05, "out": tmp_path / "c.h5"}
    before = fflin.monte_carlo(robot, policy, {"q_b": 0.05}, runs=16, **options)
    with monkeypatch.context() as patch:
        patch.setattr("fflin.campaign.monte_carlo.run_chunks", None)
        goals = ["attitude < 1 deg"]
        after = fflin.monte_carlo(
            robot, policy, {"q_b": 0.05}, runs=16, goals=goals, **options
        )
        assert after.goals == tuple(goals) and (after.x == before.x).all()
        assert (after.replay(3).x[-1] == before.x[3]).all()


@pytest.mark.parametrize("ending", [".h5", ".npz"])
def test_a_file_of_anything_else_is_replaced_only_on_request(
    ending, robots, tmp_path, monkeypatch
):
    pytest.importorskip("h5py")
    path = tmp_path / f"c{ending}"

    def fly(**changes):
        options = {
            "runs": 2,
            "duration": 0.1,
            "engine": "python",
            "out": path,
            **changes,
        }
        return fflin.monte_carlo(
            robots["planar_detumble"], None, {"omega_b": 0.1}, **options
        )

    np.savez(tmp_path / "other.npz", x=1.0)
    foreign = b"notes", (tmp_path / "other.npz").read_bytes()
    for content in foreign:
        path.write_bytes(content)
        with (
            pytest.raises(fflin.FileError, match="was not written by this call"),
            monkeypatch.context() as no,
        ):
            no.setattr("fflin.campaign.monte_carlo.run_chunks", None)  # the runs
            fly()
        assert path.read_bytes() == content and len(list(tmp_path.iterdir())) == 2
    first = fly(overwrite=True)
    before = path.read_bytes()
    for changes in (
        {"seed": 1},
        {"runs": 3},
        {"duration": 0.2},
        {"until": "end > 0", "seed": 1},
    ):
        with (
            pytest.raises(fflin.FileError, match="was not written by this call"),
            monkeypatch.context() as no,
        ):
            no.setattr("fflin.campaign.monte_carlo.run_chunks", None)  # the runs
            fly(**changes)
        assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 2
    assert np.array_equal(fly().q, first.q)
    assert np.array_equal(fly(until="end > 0").q, first.q)
    assert not np.array_equal(fly(seed=1, overwrite=True).q, first.q)
    assert fflin.Campaign.load(path).seed == 1


@pytest.mark.compiled
def test_a_file_of_another_policy_or_robot_is_refused_before_compiling(
    robots, tmp_path, monkeypatch
):
    pytest.importorskip("numba")
    pytest.importorskip("h5py")
    robot = robots["planar_detumble"]
    lin = fflin.linearize(robot)
    K, path = fflin.lqr(lin).K, tmp_path / "c.h5"

    def fly(gain=1.0, robot=robot, **changes):
        options = {
            "runs": 8,
            "duration": 0.2,
            "dt": 0.02,
            "engine": "compiled",
            "out": path,
        }
        policy = fflin.StateFeedback(lin, gain * K)
        return fflin.monte_carlo(robot, policy, {"q_b": 0.05}, **options | changes)

    first, before = fly(), path.read_bytes()
    monkeypatch.setattr("fflin.simulation.lanes.kernel", None)  # which compiles
    heavier = robot.perturbed(mass=1e-6, com=0.0, inertia=0.0)
    for changes in (
        {"gain": 1.0 + 1e-9},
        {"robot": heavier},
        {"limits": 1e3},
        {"x0": lin.x0 + 1e-9},
        {"delay": 0.02, "sample": 0.02},
        {"seed": 1},
        {"histories": 3},
    ):
        with pytest.raises(fflin.FileError, match="was not written by this call"):
            fly(**changes)
        assert path.read_bytes() == before
    assert np.array_equal(fly().x, first.x)


@pytest.mark.compiled
def test_uncontrolled_states_are_not_judged_in_campaigns():
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(robot)
    K = np.zeros((3, 12))
    K[:, :3] = K[:, 6:9] = 2.0 * np.diag(lin.M.diagonal()[:3])
    options = {"runs": 4, "duration": 30.0, "dt": 0.05}
    law = fflin.LinearController(-K, lin)
    runs = fflin.monte_carlo(robot, law, {"q_b": 0.05, "v_b": 0.01}, **options)
    assert runs.judged == ("attitude",) and np.isfinite(runs.values("settle")).all()
    motion = runs.replay(0)
    assert str(motion).startswith("settled after ")
    # What has not settled is told as it is of a motion.
    assert np.isinf(runs.values("settle position")).all()
    row = next(line for line in str(runs).splitlines() if line.startswith("position "))
    assert row.endswith(" not yet")
    late = replace(runs, settle=np.full_like(runs.settle, np.inf))
    assert not any(
        "inf" in line.split()
        for line in [*str(late).splitlines(), *worst_runs(late, 2)]
    )
    assert " not yet " in worst_runs(late, 1)[1]


def wheels_of(robot):
    """The robot with a wheel on each axis and no other inputs."""
    return robot.replace(
        inputs=[
            fflin.ReactionWheel(name=name, axis=axis, inertia=2e-4)
            for name, axis in zip("xyz", np.eye(3).tolist(), strict=True)
        ]
    )


def test_the_table_shows_wheels_and_omits_columns_of_zeros():
    robot = wheels_of(fflin.load("cubesat"))
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    options = {"runs": 4, "duration": 1.0, "dt": 0.05, "engine": "python"}
    campaign = fflin.monte_carlo(robot, policy, {"q_b": 0.02}, **options)
    rates = [campaign.state_names.index(f"qdot_m.{name}") for name in "xyz"]
    largest = np.abs(campaign.x[:, rates]).max(axis=1)
    assert np.array_equal(campaign.values("wheel speeds"), largest)
    worst = campaign.largest_x[:, rates].max(axis=1)
    assert np.array_equal(campaign.values("worst wheel speeds"), worst)
    rows = [row.split("  ")[0] for row in str(campaign).splitlines()]
    assert "wheel speeds" in rows
    assert "joints" not in rows
    assert "attitude" in rows


def test_a_message_from_an_earlier_call_is_reported(tmp_path):
    pytest.importorskip("h5py")
    robot = fflin.load("planar_detumble")
    call = {
        "runs": 4,
        "duration": 0.1,
        "dt": 0.05,
        "engine": "python",
        "out": tmp_path / "a.h5",
    }
    first = fflin.monte_carlo(robot, None, {"q_b": 0.02}, **call)
    again = fflin.monte_carlo(robot, None, {"q_b": 0.02}, **call)
    assert again.notes[: len(first.notes)] == first.notes
    assert "none was simulated again" in again.notes[-1]


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_shows_the_progress_of_runs(monkeypatch, terminal):
    class Stderr(io.StringIO):
        def isatty(self):
            return terminal

    monkeypatch.setattr(process, "_PATIENCE", 0.0)
    monkeypatch.setattr(process, "_INTERVAL", 0.0)
    monkeypatch.setattr(sys, "stderr", Stderr())
    robot = fflin.load("planar_detumble")
    call = {"runs": 16, "duration": 0.1, "dt": 0.05, "engine": "python", "chunk": 8}
    fflin.monte_carlo(robot, None, {"q_b": 0.02}, **call)
    assert ("50%" in sys.stderr.getvalue()) == terminal


def test_a_resumed_campaign_says_how_many_runs_it_keeps(tmp_path):
    pytest.importorskip("h5py")
    robot = fflin.load("planar_detumble")
    call = {"runs": 24, "duration": 0.1, "dt": 0.05, "engine": "python", "chunk": 8}
    call["out"] = tmp_path / "a.h5"

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fflin.monte_carlo(robot, None, {"q_b": 0.02}, progress=stop, **call)
    campaign = fflin.monte_carlo(robot, None, {"q_b": 0.02}, **call)
    assert (
        campaign.notes[-1]
        == "8 of 24 runs are from the unfinished file of an earlier call"
    )
