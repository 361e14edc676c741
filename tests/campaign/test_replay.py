"""Repeated runs: every number of a run is the same however many runs are computed with it."""

import numpy as np
import pytest

import fflin
from fflin.campaign.runs import CampaignJob
from tests.support.robots import random_pose

pytestmark = pytest.mark.filterwarnings("ignore::fflin.FflinWarning")

BODY = """<link name="{name}"><inertial><origin xyz=".1 -.2 .05" rpy=".3 .2 .5"/>
  <mass value="{mass}"/><inertia ixx=".3" ixy=".02" ixz="-.01" iyy=".35" iyz=".03" izz=".4"/>
  </inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{name}_link"/>
  <origin xyz=".3 -.4 .2" rpy=".7 -.4 1.1"/><axis xyz="{axis}"/>
  <limit lower="-2" upper="2" effort="5" velocity="2"/></joint>"""
ARM = (
    ("shoulder", "revolute", "base", "1 2 3"),
    ("elbow", "revolute", "shoulder_link", "-3 1 2"),
    ("slide", "prismatic", "elbow_link", "2 -1 .5"),
    ("mast", "revolute", "base", "-.3 .4 -2"),
)
# Every kind of dispersion that changes an array of the compiled loop.
SPREADS = {
    "*.mass": 0.05,
    "*.com": 0.01,
    "*.inertia": 0.03,
    "*.frequency": 0.1,
    "*.gain": 0.05,
    "*.bias": 0.01,
    "tau_b.misalignment": 0.01,
    "wheel.misalignment": 0.02,
    "thrust.misalignment": 0.03,
    "*.sensor": 1e-3,
    "q_b": 0.05,
    "r_b": 0.1,
    "q_m": 0.05,
    "omega_b": 0.01,
    "v_b": 0.02,
    "qdot_m": 0.02,
}
OPTIONS = {"duration": 0.1, "dt": 0.02}
# More runs than the compiled loop computes at once.
ENGINES = [("python", 3), pytest.param("compiled", 11, marks=pytest.mark.compiled)]


@pytest.fixture(scope="module")
def oblique(tmp_path_factory):
    """A robot with two arms on oblique axes, wheels, a thruster and an appendage, and its law."""
    path = tmp_path_factory.mktemp("oblique") / "oblique.urdf"
    parts = [BODY.format(name="base", mass=20.0)]
    for index, (name, kind, parent, axis) in enumerate(ARM):
        parts.append(BODY.format(name=f"{name}_link", mass=1.0 + 0.37 * index))
        parts.append(JOINT.format(name=name, kind=kind, parent=parent, axis=axis))
    path.write_text(f'<robot name="oblique">{"".join(parts)}</robot>')
    array = fflin.FlexibleAppendage(
        "mast_link",
        [0.5, 1.0],
        [[0.2, 0.1], [0.3, -0.1], [0.1, 0.2]],
        np.zeros((3, 2)),
        name="array",
    )
    inputs = [
        fflin.BaseTorque(),
        fflin.BaseForce(),
        *(fflin.JointTorque(name) for name, *_ in ARM),
        fflin.ReactionWheel((1.0, 2.0, -1.0), "base", 0.01, name="first"),
        fflin.ReactionWheel((-1.0, 0.3, 2.0), "elbow_link", 0.02, name="second"),
        fflin.ReactionWheel((0.5, 2.0, 1.0), "base", name="gyro", momentum=2.0),
        fflin.Thruster("slide_link", (0.1, 0.2, 0.3), (1.0, 2.0, 3.0), name="jet"),
    ]
    robot = fflin.load(path, inputs=inputs, appendages=[array])
    reference = random_pose(np.random.default_rng(3), 70.0)
    q = fflin.configuration(robot, {}, reference)
    lin = fflin.linearize(robot, q, reference=reference)
    K = 0.1 * np.random.default_rng(4).normal(size=lin.B.T.shape)
    return robot, fflin.StateFeedback(lin, K)


def test_the_values_of_a_run_are_the_same_alone_and_among_others(oblique):
    robot, policy = oblique
    job = CampaignJob(robot, policy, SPREADS, 7, "python", OPTIONS)
    drawn = job.dispersions.drawn(0, 20)
    together = job.dispersions.in_lanes(drawn)
    assert together.keys() >= {
        "q",
        "nu",
        "bodies",
        "fixed",
        "wrench",
        "stored",
        "turn",
        "stiffness",
    }
    for count in (1, 2, 7):
        for first in range(0, 20 - count, 6):
            part = slice(first, first + count)
            for key, values in job.dispersions.in_lanes(drawn[part]).items():
                assert np.array_equal(values, together[key][part]), (key, count, first)


@pytest.mark.parametrize(("engine", "runs"), ENGINES)
def test_a_run_on_oblique_axes_is_repeated_bit_for_bit(oblique, engine, runs):
    if engine == "compiled":
        pytest.importorskip("numba")
    robot, policy = oblique
    campaign = fflin.monte_carlo(
        robot, policy, SPREADS, runs=runs, engine=engine, **OPTIONS
    )
    assert campaign.engine == engine
    for run in (0, runs - 1):
        motion = campaign.replay(run)
        for name in ("q", "v", "u"):
            assert np.array_equal(
                getattr(motion, name)[-1], getattr(campaign, name)[run]
            ), name


def _pushed(t, q, v):
    return np.full(len(v), 1e-3)


def test_a_run_of_a_file_is_repeated_bit_for_bit(oblique, tmp_path):
    robot, policy = oblique
    spreads = {**SPREADS, "*.mass": {"range": 0.05, "tied": True}, "q_b.noise": 1e-3}
    options = {
        **OPTIONS,
        "sample": 0.04,
        "limits": {"tau_b": 5.0},
        "v0": np.full(robot.nv, 1e-2),
        "disturbance": _pushed,
    }
    made = fflin.monte_carlo(robot, policy, spreads, runs=3, engine="python", **options)
    made.save(tmp_path / "runs.npz")
    loaded = fflin.Campaign.load(tmp_path / "runs.npz")
    with pytest.raises(fflin.InputError, match="disturbance="):
        loaded.replay(2, robot=robot, policy=policy)
    motion = loaded.replay(2, robot=robot, policy=policy, disturbance=_pushed)
    same = made.replay(2)
    for name in ("q", "v", "u"):
        assert np.array_equal(getattr(motion, name), getattr(same, name)), name
    half = fflin.StateFeedback(policy.lin, 0.5 * policy.K)
    with pytest.warns(fflin.FflinWarning, match="differs"):
        loaded.replay(2, robot=robot, policy=half, disturbance=_pushed)


def test_runs_of_another_robot_are_not_repeated(oblique, tmp_path):
    robot, policy = oblique
    made = fflin.monte_carlo(
        robot, policy, {"q_b": 0.01}, runs=1, engine="python", **OPTIONS
    )
    made.save(tmp_path / "runs.npz")
    loaded = fflin.Campaign.load(tmp_path / "runs.npz")
    with pytest.raises(fflin.InputError, match="another URDF"):
        loaded.replay(0, robot=fflin.load("cubesat"), policy=policy)
    fewer = robot.replace(appendages=[])
    with pytest.raises(
        fflin.InputError, match="the robot or policy differs from the campaign"
    ):
        loaded.replay(0, robot=fewer, policy=None)


class Remembering:
    """A sampled policy whose command depends on how often it was called."""

    def __init__(self, resets):
        self.calls = 0
        if resets:
            self.reset = self.forget

    def forget(self):
        self.calls = 0

    def __call__(self, t, q, v):
        self.calls += 1
        return np.array([0.01 * self.calls, 0.0, 0.0])


@pytest.mark.parametrize("resets", [False, True])
def test_a_policy_with_memory_starts_each_run_anew(resets):
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    policy = Remembering(resets)
    options = {"duration": 0.5, "dt": 0.05, "sample": 0.1}
    flown = fflin.monte_carlo(robot, policy, {"q_b.x": [0.0]}, runs=3, **options)
    assert policy.calls == 0
    expected = fflin.simulate(robot, Remembering(resets), **options)
    for run in range(3):
        motion = flown.replay(run)
        assert np.array_equal(motion.u, expected.u) and np.array_equal(
            motion.v, expected.v
        )
    assert np.ptp(flown.values("worst tau_b.x")) == 0.0
