"""Whatever a public call is given, it answers: with a result, or with one line of its own error."""

import functools
import math
import os
import resource
import sys
import warnings

import numpy as np
import pytest

import fflin
from fflin.commands.cli import main
from tests.support.fuzz_public import ODD, light, sound
from tests.support.messages import hear_lines, says
from tests.support.patience import finished

pytestmark = pytest.mark.fuzz

# What a function of the caller's own raises is the caller's.
CALLED = {"policy", "disturbance", "callback", "progress", "guess"}

# Weights, some of which need seconds; where they are designed with, the quick lqr answers for all.
SLOW, WEIGHTS = (
    {"tvlqr", "tvkalman", "lqr_batch", "ScheduledFeedback"},
    {"scalar", "zero", "tiny", "huge", "many"},
)


@pytest.fixture(scope="module")
def calls(tmp_path_factory):
    return sound(tmp_path_factory.mktemp("fuzz"))


def results(name):
    """Classes that only functions make: nobody calls them."""
    made = getattr(fflin, name)
    return isinstance(made, type) and (
        issubclass(made, Exception) or name in RESULTS or name.endswith("Batch")
    )


RESULTS = {
    "ToolGain",
    "ToolSchedule",
    "ToolTrajectory",
    "Pointing",
    "PointingError",
    "CampaignPointing",
    "ErrorBudget",
    *("Tuned", "GoalValue", "HInfinity", "Structure", "Goal"),
    "Contribution",
    "MultirateCompensator",
    "MultirateEstimator",
    "Margins",
    "ChannelMargins",
    *(
        "Campaign",
        "Capture",
        "Certificate",
        "EffectiveMasses",
        "Check",
        "Compensator",
        "Controllability",
        "Equilibrium",
        "Estimator",
    ),
    *("FilterSchedule", "Funnel"),
    *(
        "Gain",
        "GainSchedule",
        "Gramians",
        "Grid",
        "Impact",
        "LinearModel",
        "LinearTrajectory",
        "Mode",
    ),
    *("LFT", "Sensitivity", "Uncertain"),
    *(
        "Modes",
        "Motion",
        "Observability",
        "Policy",
        "StateForm",
        "RandomConfigurations",
        "ReducedModel",
        "Robot",
    ),
    *("RelativeEquilibria", "RelativeEquilibrium", "ToolModel", "Validity"),
}


def call(name, arguments):
    function = functools.reduce(getattr, name.split("."), fflin)
    arguments = dict(arguments)
    owner = [arguments.pop("self")] if "self" in arguments else []
    return function(*owner, **arguments)


def test_every_public_name_is_called(calls):
    assert set(fflin.__all__) - set(calls) == {
        name for name in fflin.__all__ if results(name)
    }


def fault(name, arguments):
    """What is wrong with the answer to a call: "" if it is a result or an error in one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", fflin.FflinWarning)
            warnings.simplefilter("error", RuntimeWarning)
            call(name, arguments)
    except fflin.FflinError as error:
        message = str(error)
        printable = message.encode("utf-8", "ignore").decode() == message
        return "" if message and "\n" not in message and printable else repr(message)
    except Exception as error:
        return repr(error)
    return ""


@pytest.mark.sample
def test_each_light_function_refuses_one_odd_value_or_accepts_it(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    odd = list(ODD.items())
    wrong, turn = [], 0
    made = light(tmp_path)
    for name in sorted(made):
        taken = [
            argument for argument in made[name] if argument not in ("self", *CALLED)
        ]
        if not taken:
            continue
        # Each call takes the next value and another argument than the call before.
        argument = taken[turn % len(taken)]
        key, value = odd[turn * 7 % len(odd)]
        turn += 1
        if message := fault(name, made[name] | {argument: value}):
            wrong.append((name, argument, key, message))
    assert turn > 60
    assert not wrong


# Each of these was an error of Python, or took memory or time without end.
FOUND = [
    ("capture", "prefix", "surrogate"),
    ("from_model", "name", "surrogate"),
    ("gramians", "duration", "largest"),
    ("kalman", "W", "largest"),
    ("Robot.joint", "name", "array"),
    ("Slosh", "frequency", "huge"),
    ("Slosh", "length", "huge"),
    ("Slosh.cylinder", "pendulum", "array"),
    ("sampled_cost", "dt", "largest"),
    ("Sensitivity.table", "only", "array"),
    ("Trajectory.resampled", "dt", "huge"),
    ("Uncertain.samples", "n", "trillion"),
    ("CircularOrbit.from_json", "text", "word"),
    ("LinearModel.save", "path", "surrogate"),
    ("CLaw", "folder", "surrogate"),
    ("Motion.trajectory", "robot", "array"),
]


@pytest.mark.sample
def test_values_that_once_broke_a_call_are_refused(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    made = light(tmp_path) | {"CLaw": {"folder": tmp_path}}
    for name, argument, key in FOUND:
        assert not fault(name, made[name] | {argument: ODD[key]}), (name, argument, key)
    for name, argument, key in FOUND[:-3]:
        with pytest.raises(fflin.FflinError), np.errstate(all="ignore"):
            call(name, made[name] | {argument: ODD[key]})


@pytest.mark.sample
def test_a_trajectory_is_not_sampled_more_slowly_than_it_lasts():
    robot = fflin.load("cubesat")
    rows = [np.zeros((3, robot.nv)), np.zeros((3, 6))]
    still = fflin.linearize_trajectory(
        robot, [0.0, 0.1, 0.2], np.tile(robot.neutral(), (3, 1)), *rows
    )
    for sample in (10**12, 0.21):
        with pytest.raises(fflin.InputError, match=r"at most the duration of 0\.2 s"):
            fflin.tvlqr(still, 1.0, 1.0, 1.0, sample)
    assert fflin.tvlqr(still, 1.0, 1.0, 1.0, 0.2).dt == 0.2
    with pytest.raises(fflin.InputError, match="smaller weights"):
        fflin.tvlqr(still, 1.0, 1.0, 1e300)


@pytest.mark.sample
def test_costs_over_long_times_do_not_overflow():
    # The integral of e^(-2 t) over any long time is 1/2.
    from fflin.dynamics.integrators import held_cost

    for h in (1e3, 1e300, 1e308):
        cost = held_cost(np.array([[-1.0]]), np.eye(1), h)
        assert cost[0, 0] == pytest.approx(0.5, rel=1e-12)


@pytest.mark.parametrize("part", range(8))
def test_odd_arguments_are_refused_in_one_line_or_accepted(
    calls, part, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    wrong = []
    every = [
        (name, argument, odd)
        for name in sorted(calls)[part::8]
        for argument in calls[name]
        for odd in ODD.items()
        if argument != "self"
        and not (argument in CALLED and odd[0] == "type")
        # Worker processes are started, which takes seconds.
        and not (argument == "workers" and odd[0] in ("five", "trillion"))
        and not (name in SLOW and odd[0] in WEIGHTS)
    ]
    for name, argument, (key, value) in every:
        if message := fault(name, calls[name] | {argument: value}):
            wrong.append((name, argument, key, message))
    assert not wrong
    assert not [path for path in tmp_path.iterdir() if path.stat().st_size == 0]


NUMBERS = (
    "nan",
    "inf",
    "1e300",
    "-1e300",
    "1e-300",
    "-1",
    "0",
    "x",
    "",
    "9" * 20,
    "1,5",
    "0x10",
)
OPTIONS = {
    "linearize": ("--dt", "--stiffness", "--damping", "--gravity"),
    "check": ("--stiffness", "--damping", "--rpy", "--position", "--tolerance"),
    "lqr": ("--sample", "--stiffness"),
    "modes": ("--stiffness", "--damping"),
    "sensitivity": ("--dt", "--top"),
    "uncertain": ("--vary",),
    "simulate": (
        "--duration",
        "--dt",
        "--delay",
        "--limit",
        "--rpy",
        "--q",
        "--sample",
    ),
    "sweep": ("--random", "--seed", "--grid", "--range"),
    "montecarlo": (
        "--runs",
        "--seed",
        "--width",
        "--confidence",
        "--worst",
        "--duration",
    ),
}
NAMED = {"--limit": "tau_m=", "--q": "q_b=", "--r": "tau_b=", "--range": "joint_1=0:"}
NAMED |= {"--grid": "joint_1=0:1:", "--vary": "base.mass="}
SOUND = {"simulate": ["--duration", "0.02"], "sweep": ["--random", "2"]}
SOUND["montecarlo"] = ["--runs", "2", "--duration", "0.02", "uncertain.toml"]


def arguments_of(command, option, value):
    sound = [] if option == "--grid" else SOUND.get(command, [])
    values = [value] * (3 if option in ("--gravity", "--rpy", "--position") else 1)
    values[0] = NAMED.get(option, "") + values[0]
    return [command, "planar_detumble", *sound, option, *values]


@pytest.mark.parametrize(
    ("command", "option"),
    [(name, option) for name, many in OPTIONS.items() for option in many],
)
def test_odd_options_end_in_one_line(
    command, option, capsys, recwarn, tmp_path, monkeypatch
):
    wrong = []
    monkeypatch.chdir(tmp_path)
    (tmp_path / "uncertain.toml").write_text("[dispersions]\nq_b = 0.01\n")
    for value in NUMBERS:
        try:
            code = main(arguments_of(command, option, value))
        except SystemExit as leaving:
            code = leaving.code
        except Exception as error:
            wrong.append((value, repr(error)))
            continue
        message = capsys.readouterr().err.splitlines()
        errors = [line for line in message if not line.startswith("fflin: warning: ")]
        one = len(errors) == 1 and errors[0].startswith("fflin: error: ")
        if code not in (0, 1, 2) or (one if code != 2 else not one):
            wrong.append((value, code, message))
    assert not wrong
    assert not [item for item in recwarn if issubclass(item.category, RuntimeWarning)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--samples", "9" * 20], "samples.*1,000,000"),
        (["--offset", "1e300"], "1e.300 m"),
        (["--spread", "1e300"], "1e.300 rad"),
        (["--attitude", "1e300"], "175 deg"),
    ],
)
def test_validity_refuses_loops_that_never_settle(options, message, capsys):
    import re

    assert main(["validity", "planar_detumble", *options]) == 2
    assert re.search(message, hear_lines(capsys.readouterr().err))


def test_a_run_without_end_is_refused_whatever_asks_for_it():
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, 1e6 * fflin.lqr(lin, 1.0, 1.0).K)
    with pytest.raises(fflin.InputError, match="requires this step"):
        fflin.simulate(robot, policy, duration=60.0)
    for duration in (1e308, 1e90, math.inf):
        for options in ({}, {"delay": 1.0}, {"sample": 0.1}, {"every": 10**80}):
            with pytest.raises(fflin.InputError, match=r"duration|steps|every"):
                fflin.simulate(robot, duration=duration, **options)


@pytest.mark.sample
def test_weights_beyond_all_numbers_give_no_filter():
    lin = fflin.linearize(fflin.load("planar_detumble"))
    for model in (lin, lin.discretize(0.1)):
        for W, V in ((1e308, 1.0), (1.0, 1e308), (1e308, 1e308), (1e308, 1e-308)):
            try:
                assert np.isfinite(fflin.kalman(model, W, V).L).all()
            except fflin.FflinError as error:
                assert str(error)


def run(code, **environment):
    return finished(
        [sys.executable, "-W", "ignore", "-c", code],
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )


@pytest.mark.process
def test_a_backend_that_does_not_exist_is_named(tmp_path):
    code = (
        "import sys; from fflin.commands.cli import main; "
        "sys.exit(main(['simulate', 'planar_detumble', "
        f"'--duration', '0.1', '--plot', {str(tmp_path / 'a.png')!r}]))"
    )
    done = run(code, MPLBACKEND="nosuch")
    assert done.returncode == 2
    assert "'nosuch'" in done.stderr
    assert says(done.stderr.rstrip(), "MPLBACKEND")
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.process
@pytest.mark.skipif(not hasattr(resource, "RLIMIT_AS"), reason="no limit of memory")
def test_a_motion_that_does_not_fit_into_the_memory_is_refused():
    code = (
        "import resource, fflin\n"
        "robot = fflin.load('planar_detumble')\n"
        "fflin.simulate(robot, duration=0.1)\n"
        "pages = int(open('/proc/self/statm').read().split()[0])\n"
        "limit = pages * resource.getpagesize() + 2**28\n"
        "resource.setrlimit(resource.RLIMIT_AS, (limit, limit))\n"
        "try: fflin.simulate(robot, duration=5e6, dt=1.0, every=1)\n"
        "except fflin.InputError as error: print(error)\n"
    )
    done = run(code, OPENBLAS_NUM_THREADS="1")
    assert says(done.stdout, "memory"), done.stderr


def test_rows_of_a_sweep_are_refused_as_those_of_one_point():
    robot = fflin.load("planar_detumble")
    q = [robot.neutral()]
    for name, size in (("v", robot.nv), ("u", 6 + robot.n)):
        masked = np.ma.masked_array(np.zeros(size), mask=[True] * size)
        for rows, message in (
            ([[1.0, 2.0], [3.0]], "rows"),
            (masked, "masked"),
            (masked[None], "masked"),
            (np.full((1, size), "x"), "real"),
            (np.zeros((1, 1, size)), "shape"),
        ):
            with pytest.raises(fflin.InputError, match=f"{name} .*{message}"):
                fflin.sweep(robot, q, **{name: rows})
