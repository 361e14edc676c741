"""Errors that outputs declare reach every law that measures outputs, whatever wraps it."""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

import fflin
from fflin.control.following import Following
from fflin.control.mpc import OutputMpc

# A class and its bases, in the text of a module.
CLASS = re.compile(r"^class (\w+)\(([^)]*)\)", re.MULTILINE)

# Members with which simulations and campaigns give a law the errors of its sensors.
SENSING = (
    "bind",
    "form",
    "sensors",
    "senses_outputs",
    "measurement_noise",
    "with_sensor_errors",
)

SAMPLE = 0.25
NOTE = (
    "measurements contain the noise of q_b, r_b, base.gyroscope and the drifting bias of "
    "base.gyroscope that the outputs declare (seed {seed}; noise=0 leaves them out)"
)

# Base classes, and laws that measure states or the magnetic field. A law in C code measures outputs
# itself and does not receive the errors that the robot declares.
WITHOUT_OUTPUTS = {
    "Feedback",
    "OutputSensing",
    "LinearLaw",
    "PointLaw",
    "StateFeedback",
    "ScheduledFeedback",
    "TrajectoryFeedback",
    "Mpc",
    "TrajectoryMpc",
    "FunctionPolicy",
    "BDot",
    "RateDamping",
    "CLaw",
    "_Bound",  # the policy of one run of a campaign, whose errors are already added
    "_Erring",
    "_MagneticLaw",
    "_Predictive",
}


def satellite():
    """Return a satellite whose sensors declare noise and a drifting bias."""
    return fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque(), fflin.BaseForce()],
        outputs=[
            fflin.BasePose(noise=1e-5),
            fflin.Gyroscope("base", noise=1e-5, bias=1e-6),
        ],
    )


def resting(robot):
    """Return a trajectory at rest."""
    knots = SAMPLE * np.arange(5)
    q = np.tile(fflin.configuration(robot), (len(knots), 1))
    v = np.zeros((len(knots), robot.nv))
    return fflin.Trajectory(robot, knots, q, v, np.zeros((len(knots), 6)))


def designed(robot):
    """Return the sampled model of a robot and its compensator."""
    model = fflin.linearize(robot).discretize(SAMPLE)
    estimator = fflin.kalman(model, {"omega_b": 1e-10, "v_b": 1e-8})
    return model, fflin.lqg(fflin.lqr(model), estimator)


def output_feedback(robot):
    return fflin.OutputFeedback(*designed(robot))


def linear_controller(robot):
    model, compensator = designed(robot)
    return fflin.LinearController(compensator, model)


def late(robot):
    """Return the robot with a position sensor that is slow and late."""
    pose, gyroscope = robot.outputs
    slow = fflin.BasePose(noise=pose.noise, sample=2 * SAMPLE, delay=SAMPLE)
    return robot.replace(outputs=[slow, gyroscope])


def multirate_feedback(robot):
    return fflin.MultirateFeedback(*designed(robot))


def output_mpc(robot):
    pytest.importorskip("daqp")
    model = fflin.linearize(robot).discretize(SAMPLE)
    estimator = fflin.kalman(model, {"omega_b": 1e-10, "v_b": 1e-8})
    return fflin.mpc(
        fflin.linearize(robot),
        sample=SAMPLE,
        horizon=2,
        limits={"tau_b": 1.0, "F_b": 1.0},
        disturbance=estimator,
    )


def along_trajectory(robot):
    along = fflin.linearize_trajectory(robot, resting(robot))
    gains = fflin.tvlqr(along, sample=SAMPLE)
    estimator = fflin.tvkalman(along, 1e-8, 1e-10, sample=SAMPLE)
    return fflin.TrajectoryOutputFeedback(along, gains, estimator)


def following(robot):
    return output_feedback(robot).follow(resting(robot))


def following_at_different_rates(robot):
    return multirate_feedback(robot).follow(resting(robot))


def allocation(law):
    """Return a function of a robot that returns the allocation of a law."""
    return lambda robot: fflin.Allocation(law(robot), robot)


# {name: class of the law, function of a robot that returns the law, function of a robot}
LAWS = {
    "output feedback": (fflin.OutputFeedback, output_feedback),
    "linear controller": (fflin.LinearController, linear_controller),
    "different rates": (fflin.MultirateFeedback, multirate_feedback),
    "predictive": (OutputMpc, output_mpc),
    "along a trajectory": (fflin.TrajectoryOutputFeedback, along_trajectory),
    "following": (Following, following),
    "following at different rates": (Following, following_at_different_rates),
    "allocation": (fflin.Allocation, allocation(output_feedback)),
    "allocation of following": (fflin.Allocation, allocation(following)),
    "allocation along a trajectory": (fflin.Allocation, allocation(along_trajectory)),
}
COMPILED = [name for name in LAWS if name != "predictive"]
DELAYED = {"different rates", "following at different rates"}


def pair(name):
    """Return a robot and its law."""
    robot = satellite()
    if name in DELAYED:
        robot = late(robot)
    return robot, LAWS[name][1](robot)


def policies():
    """Return {name: class} for the policies of fflin, and import only their modules."""
    package = Path(fflin.__file__).parent
    modules, bases = {}, {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        for name, parents in CLASS.findall(path.read_text(encoding="utf-8")):
            modules[name] = ".".join(parts)
            bases[name] = set(re.findall(r"\w+", parents))
    names = {"Policy"}
    while True:
        further = {name for name, parents in bases.items() if parents & names}
        if further <= names:
            break
        names |= further
    names -= {"Policy"}
    return {
        name: getattr(importlib.import_module(modules[name]), name) for name in names
    }


def is_same_law(kind, tested):
    """Return whether a class senses as a tested class, from which it is derived."""
    return issubclass(kind, tested) and all(
        getattr(kind, member) is getattr(tested, member) for member in SENSING
    )


def test_these_tests_contain_every_law_that_measures_outputs():
    """A new class of policies must be added to LAWS or to WITHOUT_OUTPUTS."""
    classes = policies()
    assert len(classes) > 20
    missing = []
    for name, kind in classes.items():
        tested = any(is_same_law(kind, law) for law, _ in LAWS.values())
        if tested == (name in WITHOUT_OUTPUTS):
            missing.append(name)
        if name in WITHOUT_OUTPUTS - {"OutputSensing"}:
            assert kind.senses_outputs is False
    assert not missing
    assert set(classes) >= WITHOUT_OUTPUTS


@pytest.mark.parametrize("name", LAWS)
def test_declared_errors_act_and_can_be_left_out(name):
    robot, policy = pair(name)
    assert isinstance(policy, LAWS[name][0]) and policy.senses_outputs
    noisy, same, other, quiet = (
        fflin.simulate(
            robot, policy, duration=1.0, dt=SAMPLE, engine="python", **options
        )
        for options in ({}, {}, {"seed": 1}, {"noise": 0.0})
    )
    assert (noisy.u == same.u).all()
    assert np.abs(noisy.u - other.u).max() > 1e-7
    # The robot rests at its target.
    assert np.abs(quiet.u).max() < 1e-12
    assert NOTE.format(seed=0) in noisy.notes
    assert NOTE.format(seed=1) in other.notes
    assert not any("declare" in note for note in quiet.notes)


def test_an_allocation_measures_the_outputs_of_its_design():
    """The simulated robot may lack the outputs; its own declared errors take precedence."""
    design, policy = pair("allocation")
    options = {"duration": 1.0, "dt": SAMPLE, "engine": "python"}
    expected = fflin.simulate(design, policy, **options)
    without = fflin.simulate(
        design.replace(outputs=[fflin.FullState()]), policy, **options
    )
    assert NOTE.format(seed=0) in without.notes
    assert (without.u == expected.u).all() and expected.u.any()
    pose = fflin.BasePose(noise=2e-5)
    gyroscope = fflin.Gyroscope("base", noise=2e-5, bias=2e-6)
    noisier = design.replace(outputs=[pose, gyroscope])
    doubled = fflin.simulate(noisier, policy, **options)
    twice = fflin.simulate(design, policy, **options, noise=2.0)
    assert (doubled.u == twice.u).all()


def campaign(robot, policy, **options):
    spreads = {"omega_b": 0.0}
    options = {"engine": "python", "runs": 2, "duration": 1.0, "dt": SAMPLE, **options}
    return fflin.monte_carlo(robot, policy, spreads, **options)


@pytest.mark.parametrize("name", LAWS)
def test_each_run_of_a_campaign_draws_its_own_errors(name):
    robot, policy = pair(name)
    runs = campaign(robot, policy)
    assert {"q_b.x.noise", "base.gyroscope.z.drift"} <= set(runs.names)
    first, second = runs.x
    assert np.abs(first - second).max() > 1e-9
    quiet = campaign(robot, policy, noise=0.0)
    assert not any("noise" in key or "drift" in key for key in quiet.names)


@pytest.mark.exhaustive
@pytest.mark.compiled
@pytest.mark.parametrize("name", COMPILED)
def test_both_engines_draw_the_same_errors(name):
    robot, policy = pair(name)
    python, compiled = (
        fflin.simulate(robot, policy, duration=10.0, dt=SAMPLE, engine=engine)
        for engine in ("python", "compiled")
    )
    assert np.abs(python.x).max() > 1e-6
    assert compiled.x == pytest.approx(python.x, rel=1e-9, abs=1e-13)
    assert NOTE.format(seed=0) in compiled.notes
    ends = [
        campaign(robot, policy, runs=9, engine=engine).x
        for engine in ("python", "compiled")
    ]
    assert np.abs(ends[0]).max() > 1e-9
    assert ends[1] == pytest.approx(ends[0], rel=1e-9, abs=1e-13)
