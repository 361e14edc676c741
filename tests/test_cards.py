"""What notebooks show of results: short reprs, and cards that are well-formed, small and safe."""

import copy
import pickle

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base import html
from tests.support.cards import Parsed
from tests.support.robots import random_tree

# Size of a card without its page [bytes], and length of a repr.
LARGEST, LONGEST = 200_000, 3000

# Names that are markup, if they are not escaped.
ROBOT, JOINT = "<b>&amp;", '<script x="y">\'&joint'

ALLOWED = {
    *("div", "style", "span", "p", "table", "thead", "tbody", "tr", "th", "td"),
    *("details", "summary", "pre", "figure", "figcaption", "iframe"),
    *("svg", "rect", "path", "circle", "polygon", "polyline", "g", "text", "title"),
}


def renamed(robot):
    """The robot with names that are markup."""
    model = robot.model.copy()
    model.names[2] = JOINT
    frames = [f for f in model.frames if f.type == pin.FrameType.JOINT]
    model.frames[model.frames.tolist().index(frames[1])].name = JOINT
    return fflin.from_model(model, name=ROBOT)


@pytest.fixture(scope="module")
def robot():
    return renamed(fflin.load("planar_detumble"))


def results_of(robot):
    """One object of each kind, by its class."""
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin, 1.0, 1.0)
    estimator = fflin.kalman(lin, 1e-3, 1e-4)
    sampled = lin.discretize(0.1)
    compensator = fflin.lqg(
        fflin.lqr(sampled, 1.0, 1.0), fflin.kalman(sampled, 1e-3, 1e-4)
    )
    sprung = fflin.linearize(robot.replace(stiffness=10.0, damping=0.1))
    policy = fflin.StateFeedback(lin, gain.K)
    turned = pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.0, 0.0), np.zeros(3))
    q0 = fflin.configuration(robot, base=turned)
    motion = fflin.simulate(robot, policy, q0=q0, duration=1.0)
    along = fflin.linearize_trajectory(robot, motion.trajectory())
    uncertain = fflin.uncertain(robot, {"base.mass": 0.1})
    batch = fflin.sweep(robot, np.tile(robot.neutral(), (3, 1)))
    runs = {"runs": 3, "duration": 0.2, "goals": ["attitude < 1 deg"]}
    jammed = fflin.jam(robot, robot.joint_names[0])
    campaign = fflin.monte_carlo(robot, policy, {"q_b": 0.02}, **runs)
    objects = [
        *(campaign.pointing(0.05), motion.pointing(0.1)),
        fflin.error_budget(gain, lin, disturbance={"tau_b.x": 1e-3}),
        *(robot, lin, sampled, gain, estimator, compensator, policy, motion),
        *(fflin.check(robot, lin), fflin.modes(sprung), fflin.modes(sprung).modes[0]),
        *(fflin.controllability(lin), fflin.observability(lin)),
        *(fflin.gramians(sprung, duration=1.0), fflin.equilibrium(robot)),
        *(fflin.effective_masses(sprung), fflin.momentum_reduction(lin)),
        *(lin.to("mujoco"), gain.to("mujoco"), motion.trajectory(), along),
        *(fflin.sensitivity(lin), uncertain, uncertain.lft(), batch, jammed),
        *(fflin.lqr_batch(batch, 1.0, 1.0), fflin.Allocation(policy, robot)),
        *(fflin.tvlqr(along), lin.certificate),
        campaign,
    ]
    return {type(one).__name__: one for one in objects}


@pytest.fixture(scope="module")
def results(robot):
    return results_of(robot)


CARDS = (
    *("Robot", "LinearModel", "Gain", "Estimator", "Compensator", "StateFeedback"),
    *("Motion", "Check", "Modes", "Controllability", "Observability", "Equilibrium"),
    *("EffectiveMasses", "ReducedModel", "ToolModel", "ToolGain", "Trajectory"),
    *("LinearTrajectory", "Sensitivity", "Uncertain", "LFT", "LinearBatch", "Impact"),
    *("GainBatch", "GainSchedule", "Campaign", "Pointing", "CampaignPointing"),
    "ErrorBudget",
)


@pytest.mark.parametrize("name", CARDS)
def test_a_card_is_well_formed_small_and_escapes_names(results, name):
    card = results[name]._repr_html_()
    parsed = Parsed(card)
    assert parsed.tags <= ALLOWED
    content = card
    for frame in parsed.frames:
        content = content.replace(html.escape(frame["srcdoc"]), "")
    assert len(content.encode()) < LARGEST
    assert "http://" not in content.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in content
    if name not in ("Equilibrium",):  # whose report has no names
        assert ROBOT in parsed.text
    assert name in parsed.text
    # The title of a card is not repeated below it.
    assert f"{name}(" not in parsed.text


@pytest.fixture(scope="module")
def further():
    """Laws and orbits, by their classes."""
    orbit = fflin.EllipticOrbit(perigee=500e3, eccentricity=0.05, inclination=0.9)
    sensors = [fflin.StarTracker(sample=0.5, delay=0.25), fflin.Gyroscope("base")]
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=sensors)
    model = fflin.linearize(robot).discretize(0.25)
    estimator = fflin.kalman(model, 1e-10, 1e-8)
    compensator = fflin.lqg(fflin.lqr(model), estimator)
    arm = fflin.load("planar_detumble")
    lin = fflin.linearize(arm)
    sampled = lin.discretize(0.1)
    observer = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-3, 1e-4))
    motion = fflin.simulate(arm, duration=1.0, dt=0.1)
    along = fflin.linearize_trajectory(arm, motion.trajectory())
    law = fflin.PD("q_b", "tau_b", rates="omega_b")
    feedback = fflin.StateFeedback(sampled, fflin.lqr(sampled))
    periodic = fflin.linearize_orbit(fflin.load("cubesat", orbit=orbit), steps=8)
    springs = fflin.linearize(arm.replace(stiffness=10.0, damping=0.1))
    objects = [
        *(orbit, fflin.CircularOrbit(700e3, field="dipole"), fflin.BDot(2e4), periodic),
        *(estimator, compensator, fflin.MultirateFeedback(model, compensator)),
        *(fflin.OutputFeedback(sampled, observer), fflin.Allocation(feedback, arm)),
        *(fflin.TrajectoryFeedback(motion.trajectory(), fflin.tvlqr(along)),),
        fflin.tune(lin, law, [fflin.Decay(0.1)], starts=1, steps=2),
        *(feedback.follow(motion.trajectory()), fflin.gramians(springs, duration=1.0)),
        fflin.relative_equilibria(fflin.load("cubesat", orbit=700e3))[0],
        fflin.LinearController(-fflin.lqr(lin).K, lin),
    ]
    return {type(one).__name__: one for one in objects}


def test_laws_and_orbits_have_cards(further):
    for name, result in further.items():
        card = result._repr_html_()
        parsed = Parsed(card)
        assert parsed.tags <= ALLOWED, name
        assert len(card.encode()) < LARGEST, name
        assert name in parsed.text and f"{name}(" not in parsed.text
        assert len(repr(result)) < LONGEST and "array(" not in repr(result), name
    text = Parsed(further["MultirateFeedback"]._repr_html_()).text
    assert "commands every 0.25 s" in text and "measures q_b.x, q_b.y" in text
    text = Parsed(further["EllipticOrbit"]._repr_html_()).text
    assert "elliptic orbit 500 x" in text and "51.5662 deg" in text


def test_the_norm_of_an_h_infinity_law_is_on_its_card():
    pytest.importorskip("slycot")
    lin = fflin.linearize(fflin.load("planar_detumble"))
    goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})
    law = fflin.hinf(lin, goal, measured="q_b", inputs="tau_b")
    assert f"gamma={law.gamma:.4g}, order=6" in Parsed(law._repr_html_()).text


def test_the_repr_of_every_result_is_short(results):
    for name, result in results.items():
        assert len(repr(result)) < LONGEST, name
        assert "array(" not in repr(result), name
    for name in ("Check", "Modes", "Controllability", "Observability", "Equilibrium"):
        assert repr(results[name]) == str(results[name])


def test_marks_have_titles_with_names_values_and_units(results, robot):
    lin = fflin.linearize(robot)
    parsed = Parsed(lin._repr_html_())
    value = lin.B[lin.state_names.index("omega_b.z"), 2]
    assert f"B[omega_b.z, tau_b.z] = {value:.4g} rad/s^2 per N m" in parsed.titles
    assert f"A[q_m.{JOINT}, qdot_m.{JOINT}] = 1 rad/s per rad/s" in parsed.titles
    assert all(f"{name}" in parsed.text for name in lin.state_names)
    gain = fflin.lqr(lin, 1.0, 1.0)
    titles = Parsed(gain._repr_html_()).titles
    poles = [title for title in titles if "damping" in title]
    assert len(poles) == len(np.unique(gain.poles.round(9)))
    assert any(title.startswith("K[tau_b.z, q_b.z] = ") for title in titles)
    picture = Parsed(robot._repr_html_())
    assert {"base", JOINT} <= {*picture.titles}


def test_entries_that_are_rounding_errors_stay_blank():
    lin = fflin.linearize(fflin.load("planar_detumble"))
    titles = Parsed(lin._repr_html_()).titles
    assert not [x for x in titles if x.startswith("A[omega_b")]
    # The arm moves in a plane, so a torque about z accelerates nothing about x.
    assert not [x for x in titles if x.startswith("B[omega_b.x, tau_b.z]")]
    noisy = lin.A.copy()
    row, column = (lin.state_names.index(x) for x in ("q_b.x", "omega_b.y"))
    noisy[row, column] = 1e-16
    changed = copy.copy(lin)
    vars(changed)["A"] = noisy
    assert Parsed(changed._repr_html_()).titles == titles


def test_verdicts_are_green_or_red(results, robot):
    check = results["Check"]
    kinds = dict(Parsed(check._repr_html_()).verdicts)
    assert "verified, largest error" in kinds["good"]
    lin = fflin.linearize(robot)
    wrong = copy.copy(lin)
    vars(wrong)["B"] = 1.001 * lin.B
    failed = fflin.check(robot, wrong)
    kinds = dict(Parsed(failed._repr_html_()).verdicts)
    assert "not verified" in kinds["bad"] and "good" not in kinds
    assert dict(Parsed(results["Controllability"]._repr_html_()).verdicts).keys() >= {
        "good"
    }
    motors = [fflin.JointTorque(name) for name in robot.joint_names]
    arm = fflin.linearize(robot.replace(inputs=motors))
    verdicts = Parsed(fflin.controllability(arm)._repr_html_()).verdicts
    assert "good" not in dict(verdicts)
    assert (
        "not settled" in dict(Parsed(results["Motion"]._repr_html_()).verdicts)["bad"]
    )


@pytest.mark.exhaustive
def test_a_large_robot_has_small_cards():
    robot = random_tree(np.random.default_rng(1), 30)
    q, v = robot.neutral(), 0.1 * np.ones(robot.nv)
    lin = fflin.linearize(robot, q, v)
    assert np.count_nonzero(lin.A) > 2000
    card = lin._repr_html_()
    assert len(card) < LARGEST
    parsed = Parsed(card)
    assert "largest entry of each block of" in parsed.text
    # The largest entry of all is one of the titles.
    i, j = np.unravel_index(np.abs(lin.A).argmax(), lin.A.shape)
    start = f"A[{lin.state_names[i]}, {lin.state_names[j]}] = {lin.A[i, j]:.4g}"
    assert [title for title in parsed.titles if title.startswith(start)]
    assert len(robot._repr_html_()) < LARGEST
    gain = fflin.lqr(fflin.linearize(robot), 1.0, 1.0)
    assert len(gain._repr_html_()) < LARGEST
    assert len(fflin.check(robot, fflin.linearize(robot))._repr_html_()) < LARGEST
    assert len(fflin.sensitivity(fflin.linearize(robot))._repr_html_()) < LARGEST


def test_the_page_of_a_motion_is_in_its_card(results):
    motion = results["Motion"]
    (frame,) = Parsed(motion._repr_html_()).frames
    assert frame["srcdoc"].lower().startswith("<!doctype html>")
    assert "allow-same-origin" not in frame["sandbox"]
    stored = pickle.loads(pickle.dumps(motion))
    assert stored._repr_html_().count("<iframe") == 1


def test_a_motion_from_a_file_has_a_card_without_page(results, tmp_path):
    path = tmp_path / "motion.npz"
    results["Motion"].save(path)
    card = fflin.Motion.load(path)._repr_html_()
    assert not Parsed(card).frames and "not settled" in card


def test_data_from_a_file_without_digest_are_marked(tmp_path):
    gain = fflin.lqr(fflin.linearize(fflin.load("planar_detumble")), 1.0, 1.0)
    assert "not verified" not in gain._repr_html_()
    unsure = copy.copy(gain)
    object.__setattr__(unsure, "verified", False)
    kinds = [
        kind for kind, text in Parsed(unsure._repr_html_()).verdicts if "sha256" in text
    ]
    assert kinds == ["bad"]
