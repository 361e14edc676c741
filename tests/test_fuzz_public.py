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
from tests.support.fuzz_public import ODD, sound
from tests.support.messages import hear_lines, says
from tests.support.patience import finished

pytestmark = pytest.mark.fuzz

# What a function of the caller's own raises is the caller's.
CALLED = {"policy", "disturbance", "callback", "progress"}

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
    *("Modes", "Motion", "Observability", "RandomConfigurations", "ReducedModel", "Robot"),
    *("RelativeEquilibria", "RelativeEquilibrium", "ToolModel", "Validity"),
}


def call(name, arguments):
    function = functools.reduce(getattr, name.split("."), fflin)
    arguments = dict(arguments)
    owner = [arguments.pop("self")] if "self" in arguments else []
    return function(*owner, **arguments)


def test_every_public_name_is_called(calls):
    assert set(fflin.__all__) - set(calls) == {name for name in fflin.__all__ if results(name)}


@pytest.mark.parametrize("part", range(8))
def test_odd_arguments_are_refused_in_one_line_or_accepted(calls, part, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    wrong = []
    every = [
        (name, argument, odd)
        for name in sorted(calls)[part::8]
        for argument in calls[name]
        for odd in ODD.items()
        if argument != "self"
        and not (argument in CALLED and odd[0] == "type")
        and not (name in SLOW and odd[0] in WEIGHTS)
    ]
    for name, argument, (key, value) in every:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)
                call(name, calls[name] | {argument: value})
        except fflin.FflinError as error:
            said = str(error)
            if not said or "\n" in said:
                wrong.append((name, argument, key, said))
        except Exception as error:
            wrong.append((name, argument, key, repr(error)))
    assert not wrong
    assert not [path for path in tmp_path.iterdir() if path.stat().st_size == 0]


NUMBERS = ("nan", "inf", "1e300", "-1e300", "1e-300", "-1", "0", "x", "", "9" * 20, "1,5", "0x10")
OPTIONS = {
    "linearize": ("--dt", "--stiffness", "--damping", "--gravity"),
    "check": ("--stiffness", "--damping", "--rpy", "--position", "--tolerance"),
    "lqr": ("--sample", "--stiffness"),
    "modes": ("--stiffness", "--damping"),
    "sensitivity": ("--dt", "--top"),
    "uncertain": ("--vary",),
    "simulate": ("--duration", "--dt", "--delay", "--limit", "--rpy", "--q", "--sample"),
    "sweep": ("--random", "--seed", "--grid", "--range"),
    "montecarlo": ("--runs", "--seed", "--width", "--confidence", "--worst", "--duration"),
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
    ("command", "option"), [(name, option) for name, many in OPTIONS.items() for option in many]
)
def test_odd_options_end_in_one_line(command, option, capsys, recwarn, tmp_path, monkeypatch):
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
        said = capsys.readouterr().err.splitlines()
        errors = [line for line in said if not line.startswith("fflin: warning: ")]
        one = len(errors) == 1 and errors[0].startswith("fflin: error: ")
        if code not in (0, 1, 2) or (one if code != 2 else not one):
            wrong.append((value, code, said))
    assert not wrong
    assert not [item for item in recwarn if issubclass(item.category, RuntimeWarning)]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--samples", "9" * 20], "samples.*1,000,000"),
        (["--offset", "1e300"], "1e.300 m"),
        (["--spread", "1e300"], "1e.300 rad"),
        (["--attitude", "1e300"], "175 deg"),
    ],
)
def test_validity_refuses_what_would_never_end(options, said, capsys):
    import re

    assert main(["validity", "planar_detumble", *options]) == 2
    assert re.search(said, hear_lines(capsys.readouterr().err))


def test_a_run_without_end_is_refused_whatever_asks_for_it():
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, 1e6 * fflin.lqr(lin, 1.0, 1.0).K)
    with pytest.raises(fflin.InputError, match="fast pole"):
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
        for rows, said in (
            ([[1.0, 2.0], [3.0]], "rows"),
            (masked, "masked"),
            (masked[None], "masked"),
            (np.full((1, size), "x"), "real"),
            (np.zeros((1, 1, size)), "shape"),
        ):
            with pytest.raises(fflin.InputError, match=f"{name} .*{said}"):
                fflin.sweep(robot, q, **{name: rows})
