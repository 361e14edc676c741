"""Commands that design, save and fly regulators of delayed inputs."""

import json

import numpy as np
import pytest

import fflin
from fflin.commands.cli import main
from tests.support.commands import run

ROBOT = "planar_detumble"
LOOP = ("--rpy", 0, 0, 10, "--duration", 4)


def delayed_law(sample, delay):
    """Return the model with delayed inputs and its default regulator."""
    lin = fflin.linearize(fflin.load(ROBOT))
    late = lin.discretize(sample, delay=delay)
    return late, fflin.lqr(late)


def flown(late, gain, **settings):
    """Return the states of the motion that the command simulates."""
    robot = fflin.load(ROBOT)
    q0 = fflin.configuration(robot, rpy=(0, 0, 10))
    policy = fflin.StateFeedback(late, gain)
    return fflin.simulate(robot, policy, q0=q0, duration=4.0, **settings).x


@pytest.mark.parametrize(
    ("options", "sample"),
    [(("--sample", 0.2), 0.2), ((), 0.3)],
    ids=["sample", "delay alone"],
)
def test_simulate_designs_its_law_for_the_delay(tmp_path, options, sample):
    duration = ("--rpy", 0, 0, 10, "--duration", 6, "--dt", 0.05)
    code, _, err = run(
        *("simulate", ROBOT, *duration, *options, "--delay", 0.3, "-o", "m.npz"),
        cwd=tmp_path,
    )
    assert code == 0, err
    late, gain = delayed_law(sample, 0.3)
    robot = fflin.load(ROBOT)
    expected = fflin.simulate(
        robot,
        fflin.StateFeedback(late, gain),
        q0=fflin.configuration(robot, rpy=(0, 0, 10)),
        duration=6.0,
        dt=0.05,
    )
    motion = fflin.Motion.load(tmp_path / "m.npz")
    assert np.array_equal(motion.u, expected.u)
    assert np.array_equal(motion.x, expected.x)


@pytest.mark.parametrize("integral", [(), ("--integral", "q_b.z")])
@pytest.mark.exhaustive
def test_a_saved_gain_of_delayed_inputs_flies(tmp_path, integral, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    design = ["lqr", ROBOT, "--sample", "0.2", "--delay", "0.3", *integral]
    assert main([*design, "-o", "gain.json"]) == 0
    assert "sampled at 0.2 s, delay 0.3 s" in " ".join(capsys.readouterr().out.split())
    late, _ = delayed_law(0.2, 0.3)
    gain = fflin.lqr(late, integral_action=[*integral[1:]] or None)
    loaded = fflin.Gain.load("gain.json")
    assert np.array_equal(loaded.delay, late.delay)
    loop = [str(x) for x in LOOP]
    assert main(["simulate", ROBOT, *loop, "--gain", "gain.json", "-o", "m.npz"]) == 0
    motion = fflin.Motion.load("m.npz")
    assert np.array_equal(motion.x, flown(late, gain))
    # --delay changes the delay of the plant, and not the law.
    other = ["--gain", "gain.json", "--delay", "0.4", "--dt", "0.1", "--json"]
    capsys.readouterr()
    assert main(["simulate", ROBOT, *loop, *other, "-o", "other.npz"]) == 0
    margins = json.loads(capsys.readouterr().out)["margins"]
    motion = fflin.Motion.load("other.npz")
    assert np.array_equal(motion.x, flown(late, gain, delay=0.4, dt=0.1))
    lin = fflin.linearize(fflin.load(ROBOT))
    assert margins["disk"] == fflin.margins(gain, lin, delay=0.4).disk


def test_c_code_of_a_saved_gain_contains_its_delay(tmp_path):
    late, gain = delayed_law(0.2, 0.3)
    gain.save(tmp_path / "gain.npz")
    loaded = fflin.Gain.load(tmp_path / "gain.npz")
    robot = fflin.load(ROBOT)
    laws = {"file": loaded, "policy": fflin.StateFeedback(late, gain)}
    for name, law in laws.items():
        folder = fflin.write_c(law, tmp_path / name, robot=robot)
        about = json.loads(next(folder.glob("*.json")).read_text())
        assert about["delay"] == late.delay.tolist()
        assert about["memory"] == 2 * len(late.u0)
