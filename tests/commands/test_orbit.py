"""Commands for robots in orbit: models over one period, magnetorquers and the B-dot law."""

import json
from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.analysis.ranks import Decision, Margin
from fflin.commands.models import _rank
from tests.support.commands import refused, run

SATELLITE = "cubesat_magnetic"
ELLIPSE = ("--orbit", "500e3/1900e3")
STILL = ("--velocity", "omega_b=0")
PERIOD = fflin.load(SATELLITE).orbit.period
SAMPLE = PERIOD / 24


def test_the_robot_file_of_a_magnetic_satellite_is_short():
    robot = fflin.load(SATELLITE)
    assert [type(item) for item in robot.inputs] == [fflin.Magnetorquer] * 3
    assert len(robot.urdf.with_name(f"{SATELLITE}.toml").read_text().splitlines()) <= 25


def orbit_of(*options):
    """Return the orbit of the magnetic satellite with options of the command line."""
    code, out, _ = run("info", SATELLITE, *options, "--json")
    assert code == 0
    return json.loads(out)["orbit"]


def test_another_altitude_keeps_the_magnetic_field_of_the_robot_file():
    orbit = orbit_of("--orbit", "600e3")
    shown = orbit["altitude"], orbit["inclination"], orbit["field"]
    assert shown == (600e3, 1.7, "dipole")
    changed = orbit_of(
        "--orbit", "600e3", "--inclination", 0.9, "--field", "tilted_dipole"
    )
    assert (changed["inclination"], changed["field"]) == (0.9, "tilted_dipole")
    turned = orbit_of("--inclination", 0.9)
    assert (turned["altitude"], turned["field"]) == (500e3, "dipole")
    ellipse = orbit_of("--orbit", "500e3/900e3")
    assert (ellipse["apogee"], ellipse["field"]) == (900e3, "dipole")
    assert orbit_of("--orbit", "400e3:mars", "--inputs", "base")["field"] is None
    assert orbit_of("--orbit", "none", "--inputs", "base") is None
    assert "magnetic field dipole, inclination 97.4028 deg" in run("info", SATELLITE)[1]


def test_a_magnetic_field_needs_an_orbit():
    error = refused("info", "cubesat", "--field", "dipole")
    assert "is not in orbit, so --field has no effect; add --orbit" in error
    error = refused("info", SATELLITE, "--orbit", "none", "--field", "dipole")
    assert "--orbit none removes the orbit" in error
    assert "--field dipole" in refused("linearize", SATELLITE, "--field", "none")


def test_controllability_and_observability_over_a_period():
    code, out, _ = run("analyze", SATELLITE, "--periodic", 8)
    assert code == 0 and out.startswith("analyze: not controllable (6/12), observable")
    assert "--periodic N" in refused("analyze", SATELLITE)
    assert "without --periodic" in refused("analyze", "cubesat", "--motion", "free")


@pytest.mark.exhaustive
def test_the_first_line_does_not_state_an_undecided_rank():
    robot = fflin.load(SATELLITE)
    result = fflin.controllability(fflin.linearize_orbit(robot, steps=8))
    assert _rank(result, "controllable") == "not controllable (6/12)"
    doubt = Margin((Decision(9.0, np.ones(6)),))
    unsure = replace(result, margin=doubt)
    assert _rank(unsure, "controllable") == "controllability undecided"


def test_linearize_at_a_time():
    code, out, _ = run("linearize", "cubesat", *ELLIPSE, "--time", 1800)
    assert code == 0 and "at t = 1800 s" in " ".join(out.split())
    code, out, _ = run("linearize", "cubesat", *ELLIPSE, "--time", 1800, "--json")
    robot = fflin.load("cubesat", orbit={"perigee": 500e3, "apogee": 1900e3})
    assert np.array_equal(json.loads(out)["A"], fflin.linearize(robot, t=1800.0).A)
    assert run("check", SATELLITE, "--time", 1000)[0] == 0


def test_the_models_of_a_circular_orbit_repeat_the_model_at_rest():
    circle = ("--orbit", "500e3", "--periodic", 8, "--json")
    record = json.loads(run("linearize", "cubesat", *circle)[1])
    lin = fflin.linearize(fflin.load("cubesat", orbit={"altitude": 500e3}))
    assert np.abs(np.array(record["A"]) - lin.A).max() < 1e-12
    assert len(record["multipliers"]) == 12


def test_the_model_of_magnetorquers_is_shown_without_its_poles():
    code, out, _ = run("linearize", SATELLITE, "--time", 1000)
    assert code == 0 and "at t = 1000 s" in out and "unstable poles" not in out


@pytest.mark.exhaustive
def test_the_models_of_one_period_and_their_multipliers(tmp_path):
    command = ("linearize", "cubesat", *ELLIPSE, "--periodic", 8)
    code, out, _ = run(*command, "-o", "models.npz", cwd=tmp_path)
    assert code == 0 and "magnitudes of all multipliers: " in " ".join(out.split())
    robot = fflin.load("cubesat", orbit={"perigee": 500e3, "apogee": 1900e3})
    expected = fflin.linearize_orbit(robot, steps=8)
    along = fflin.LinearTrajectory.load(tmp_path / "models.npz", robot)
    assert np.array_equal(along.A, expected.A) and along.period == expected.period
    assert len(json.loads(run(*command, "--json")[1])["multipliers"]) == 12


@pytest.mark.exhaustive
def test_a_free_motion_and_checks_of_one_period():
    command = ("linearize", "cubesat", *ELLIPSE, "--periodic", 8)
    assert run("check", *command[1:])[0] == 0
    robot = fflin.load("cubesat", orbit={"perigee": 500e3, "apogee": 1900e3})
    record = json.loads(run(*command, "--motion", "free", "--json")[1])
    free = fflin.linearize_orbit(robot, steps=8, motion="free")
    assert np.allclose(record["q"], free.q, atol=1e-12)


@pytest.mark.exhaustive
def test_a_periodic_schedule_from_the_command_line(tmp_path):
    design = ("--periodic", 8, "--sample", repr(SAMPLE), "--r", "dipole=1e6")
    code, out, _ = run("tvlqr", SATELLITE, *design, "-o", "gains.npz", cwd=tmp_path)
    assert code == 0 and "repeats after 5676.98 s" in " ".join(out.split())
    assert fflin.GainSchedule.load(tmp_path / "gains.npz").period == PERIOD


@pytest.mark.exhaustive
def test_a_periodic_schedule_is_simulated_from_a_file_or_designed_first(tmp_path):
    design = ("--periodic", 8, "--sample", repr(SAMPLE), "--r", "dipole=1e6")
    run("tvlqr", SATELLITE, *design, "-o", "gains.npz", cwd=tmp_path)
    flight = ("--rpy", 3, 2, -3, *STILL, "--duration", repr(SAMPLE), "--json")
    both = []
    for law in (("--schedule", "gains.npz"), design):
        code, out, err = run("simulate", SATELLITE, *law, *flight, cwd=tmp_path)
        assert code == 0, err
        both.append(json.loads(out)["x"])
    assert both[0] == both[1]
    assert max(map(abs, both[0][:3])) < 0.04  # the run begins at --rpy


def test_a_regulator_is_allocated_to_magnetorquers_by_default():
    code, out, _ = run("lqr", SATELLITE, "--sample", 10)
    assert code == 0 and "the part of tau_b across the magnetic" in " ".join(
        out.split()
    )
    flight = ("--sample", 10, "--dt", 10, "--duration", 50)
    code, out, _ = run("simulate", SATELLITE, *flight)
    assert code == 0 and "the commanded tau_b are realised by dipole" in out
    assert "magnetorquers; use" in refused("lqr", SATELLITE, "--no-allocate")
    assert "none; define" in refused("lqr", "ets_vii", "--allocate")


@pytest.mark.exhaustive
def test_a_gain_from_a_file_is_allocated_to_magnetorquers(tmp_path):
    run("lqr", SATELLITE, "--sample", 10, "-o", "g.npz", cwd=tmp_path)
    flight = ("--gain", "g.npz", "--dt", 10, "--duration", 100)
    code, out, _ = run("simulate", SATELLITE, *flight, cwd=tmp_path)
    assert code == 0 and "the commanded tau_b are realised by dipole" in out


@pytest.mark.exhaustive
def test_a_satellite_detumbles_and_points_to_the_earth(tmp_path):
    flight = ("--sample", 10, "--dt", 10, "--duration", 18000, "-o", "m.npz")
    assert run("simulate", SATELLITE, *flight, cwd=tmp_path)[0] == 0
    motion = fflin.Motion.load(tmp_path / "m.npz")
    assert np.degrees(np.linalg.norm(motion.v[0, 3:6])) > 5.0
    late = motion.t > 3.0 * PERIOD
    assert late.any() and motion.attitude_error[late].max() < 5.0
    assert np.abs(motion.u).max() <= 0.2


def test_the_b_dot_law(tmp_path):
    command = ("simulate", SATELLITE, "--bdot", 2e4, "--dt", 5)
    code, out, _ = run(*command, "--duration", 100)
    assert code == 0 and "not detumbled: the run is shorter" in " ".join(out.split())
    assert "replace the regulator" in refused(
        *command, "--sample", 20, "--r", "dipole=1"
    )
    assert "magnetorquers" in refused("simulate", "cubesat", "--bdot", 1)
    other = ("simulate", SATELLITE, "--rate-damping", 3e-5, "--dt", 5)
    assert run(*other, "--duration", 100)[0] == 0
    assert "remove --bdot" in refused(*other, "--bdot", 2e4)


@pytest.mark.exhaustive
def test_the_b_dot_law_detumbles():
    command = ("simulate", SATELLITE, "--bdot", 2e4, "--dt", 10, "--json")
    record = json.loads(run(*command, "--duration", 12000)[1])
    assert PERIOD < record["detumbling_time"] < 12000.0


@pytest.mark.compiled
@pytest.mark.exhaustive
def test_a_campaign_from_detumbling_to_the_earth(tmp_path):
    spread = '[dispersions]\n"base.mass" = 0.02\nomega_b = 0.02\n'
    (tmp_path / "spread.toml").write_text(spread)
    command = ("montecarlo", SATELLITE, "spread.toml", "--runs", 8, "--sample", 10)
    options = ("--dt", 5, "--duration", 20000, "--goal", "attitude < 5 deg", "--json")
    code, out, err = run(*command, *options, cwd=tmp_path)
    assert code == 0, err
    (goal,) = json.loads(out)["goals"].values()
    assert goal[0] == 1.0


def test_errors_of_periodic_models():
    for command in ("linearize", "tvlqr"):
        text = refused(command, "cubesat", "--periodic", 8)
        assert "not in orbit" in text
    both = ("--periodic", 8, "--trajectory", "m.npz")
    assert "remove --trajectory" in refused("tvlqr", SATELLITE, *both)
    assert "neither --trajectory" in refused("tvlqr", SATELLITE)
    assert "without --periodic" in refused("linearize", SATELLITE, "--motion", "free")
    assert "without --periodic" in refused("linearize", SATELLITE, "--period", 60)
    short = refused("linearize", SATELLITE, "--periodic", 8, "--period", 60)
    assert "differs from the field one period later" in short
    wrong = refused("tvlqr", SATELLITE, "--periodic", 8, "--sample", 60)
    assert "59.75766345816693" in wrong


@pytest.mark.exhaustive
def test_default_weights_of_a_periodic_regulator_are_those_of_python(tmp_path):
    """No weights are in the file, so the limits of the magnetorquers set them in both."""
    path = fflin.load(SATELLITE).urdf.with_name(f"{SATELLITE}.toml")
    lines = path.read_text().splitlines()
    kept = [line for line in lines if not line.startswith("weights")]
    assert len(kept) < len(lines)
    text = "\n".join(kept).replace("cubesat.urdf", "cubesat")
    (tmp_path / "plain.toml").write_text(text)
    design = ("--periodic", 8, "--sample", repr(PERIOD / 16))
    code, _, err = run("tvlqr", "plain.toml", *design, "-o", "gains.npz", cwd=tmp_path)
    assert code == 0, err
    saved = fflin.GainSchedule.load(tmp_path / "gains.npz")
    robot = fflin.load(SATELLITE).replace(weights={})
    along = fflin.linearize_orbit(robot, steps=8)
    schedule = fflin.tvlqr(along, Qf="periodic", sample=PERIOD / 16)
    assert saved.weights == schedule.weights
    assert "mean effect over one period" in schedule.weights
    assert saved.K == pytest.approx(schedule.K, rel=1e-12)
