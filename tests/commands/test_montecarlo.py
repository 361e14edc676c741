"""fflin montecarlo as a user runs it."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.commands import refused, run
from tests.support.messages import says
from tests.support.patience import finished

TOML = '[dispersions]\nq_b = 0.05\n"*.mass" = 0.1\nq_m = {uniform = [-0.2, 0.2]}\n'
SHORT = ("u.toml", "--duration", "0.4", "--dt", "0.02")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "u.toml").write_text(TOML)
    return tmp_path


def test_the_command_simulates_the_motion_of_python_and_reports_it_as_text_and_json(
    folder, robots
):
    robot = robots["planar_detumble"]
    options = (
        "--runs",
        30,
        "--seed",
        4,
        "--limit",
        "tau_b=2",
        "--goal",
        "attitude < 4 deg",
    )
    command = ("montecarlo", "planar_detumble", *SHORT, *options, "--rpy", 5, 0, 0)
    code, out, err = run(*command, "-o", "runs.npz", cwd=folder)
    assert code == 0 and not err
    campaign = fflin.Campaign.load(folder / "runs.npz")
    lin, turn = fflin.linearize(robot), pin.rpy.rpyToMatrix(np.radians(5.0), 0.0, 0.0)
    expected_value = fflin.monte_carlo(
        robot,
        fflin.StateFeedback(lin, fflin.lqr(lin).K),
        fflin.load_dispersions(folder / "u.toml"),
        **{
            "q0": fflin.configuration(robot, base=pin.SE3(turn, np.zeros(3))),
            "runs": 30,
        },
        **{"seed": 4, "duration": 0.4, "dt": 0.02, "limits": ["urdf", {"tau_b": 2.0}]},
    )
    assert np.abs(expected_value.x - campaign.x).max() < 1e-9
    assert campaign.input_limits[:3] == (2.0,) * 3
    assert campaign.values("worst attitude").mean() > 5.0
    share = campaign.fraction("attitude < 4 deg")
    assert (
        f"attitude < 4 deg: {100 * share.value:.4g} % (" in out
        and "wrote runs.npz" in out
    )
    assert max(map(len, out.splitlines())) <= 80
    assert re.search(rf"^ *{campaign.worst(1)[0]} +[\d.]+ +deg", out, re.MULTILINE)
    code, out, _ = run(*command, "--worst", 2, "--json", cwd=folder)
    message = json.loads(out)
    assert message["worst"] == campaign.worst(2) and message["stopped"] == {}
    assert message["goals"] == {"attitude < 4 deg": list(share)}
    result = message["quantiles"]["worst attitude"]["0.5"]
    assert result == list(campaign.quantile("worst attitude", 0.5))
    # of 30 runs there is no bound
    assert message["quantiles"]["attitude"]["0.99"][2] is None


def test_the_report_states_that_the_robot_file_defines_the_start(folder):
    (folder / "r.toml").write_text(
        'urdf = "planar_detumble"\n[start]\nrpy = [0, 0, 5]\n'
    )
    command = ("montecarlo", "r.toml", *SHORT, "--runs", 2)
    note = "start: [start] of the robot file"
    code, out, _ = run(*command, cwd=folder)
    assert code == 0 and note in out and "replace" not in out
    _, out, _ = run(*command, "--rpy", 0, 0, 1, "--json", cwd=folder)
    [shown] = [text for text in json.loads(out)["notes"] if note in text]
    assert shown.endswith("--rpy replace entries of it")
    _, out, _ = run("montecarlo", "planar_detumble", *SHORT, "--runs", 2, cwd=folder)
    assert note not in out


def test_tables_match_the_campaign(folder):
    command = ("montecarlo", "planar_detumble", *SHORT, "--runs", 6)
    assert run(*command, "-o", "runs.npz", cwd=folder)[0] == 0
    fflin.Campaign.load(folder / "runs.npz").save(folder / "runs.csv")
    (folder / "u.csv").write_text("of another program")
    assert says(
        refused(*command, "-o", "u.csv", cwd=folder), "u.csv already exists", "--force"
    )
    assert (folder / "u.csv").read_text() == "of another program"
    code, out, _ = run(*command, "-o", "u.csv", "--force", cwd=folder)
    assert code == 0 and "wrote u.csv" in out
    assert (folder / "u.csv").read_text() == (folder / "runs.csv").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--runs", "0"), "--runs"),
        (("--runs", "1000000000000"), "1,000,000,000,000 rows.*memory"),
        (("--runs", "1000000000000", "-o", "x.h5"), "x.h5 needs .*free"),
        (("--runs", "3", "-o", "x.json"), "x.json"),
        (("--runs", "3", "--goal", "attitude < 1 m"), "deg"),
        (("--runs", "3", "--until", "nosuch < 1"), "'nosuch'"),
        (("--runs", "3", "--plot", "x.gif"), "x.gif"),
        (("--runs", "3", "-o", "x.h5", "--plot", "x.h5"), "x.h5"),
        (("--runs", "3", "--width", "2"), "width"),
        (("--runs", "3", "--delay", "1e9"), "delay"),
    ],
)
def test_invalid_input_is_one_line_and_leaves_nothing(arguments, message, folder):
    error = refused("montecarlo", "planar_detumble", *SHORT, *arguments, cwd=folder)
    assert re.search(message, error), error
    assert {x.name for x in folder.iterdir()} == {"u.toml"}


def test_noise_has_a_report_and_another_campaign_is_replaced_by_force(
    folder, monkeypatch
):
    monkeypatch.chdir(folder)
    (folder / "u.toml").write_text('[dispersions]\n"q_b.x.noise" = 1e-4\n')
    command = (
        "montecarlo",
        "planar_detumble",
        *SHORT,
        "--sample",
        "0.1",
        "--runs",
        "8",
        "-o",
        "c.npz",
    )
    code, _, error = run(*command)
    assert (code, error) == (0, "")
    before = (folder / "c.npz").read_bytes()
    code, _, error = run(*command, "--seed", "1")
    assert code == 2 and "was not written by this call" in error and "--force" in error
    assert (folder / "c.npz").read_bytes() == before
    code, _, error = run(*command, "--seed", "1", "--force")
    assert (code, error) == (0, "")
    assert fflin.Campaign.load("c.npz").seed == 1


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("none.toml", "none.toml"),
        ("bad.toml", "bad.toml:2.*'nosuch'"),
        ("kind.toml", r"kind.toml:2.*'base\.mas'; did you mean base\.mass\?$"),
        ("single.toml", r"single.toml:2.*'mas'; did you mean \*\.mass\?$"),
        ("case.toml", r"case.toml:2.*'Q_b'; did you mean q_b\?$"),
    ],
)
def test_a_bad_file_is_one_line(file, message, tmp_path):
    names = {"bad": "nosuch", "kind": '"base.mas"', "single": "mas", "case": "Q_b"}
    for stem, name in names.items():
        text = f"[dispersions]\n{name} = 1\n"
        (tmp_path / f"{stem}.toml").write_text(text)
    error = refused("montecarlo", "planar_detumble", file, "--runs", "3", cwd=tmp_path)
    assert re.search(message, error), error


INTERRUPTED = """
import os, signal, sys
from fflin.base import process
from fflin.__main__ import main
counted = process.Progress.__call__
def update(bar, done, total):
    counted(bar, done, total)
    if done >= 32:
        os.kill(os.getpid(), signal.SIG_HOW)
process.Progress.__call__ = update
if __name__ == "__main__":
    sys.exit(main())
"""


@pytest.mark.compiled
@pytest.mark.process
@pytest.mark.parametrize("how", ["INT", "KILL"])
def test_the_same_command_goes_on_after_ctrl_c_and_a_kill(folder, how):
    pytest.importorskip("h5py")
    command = [
        "montecarlo",
        "planar_detumble",
        *SHORT,
        "--runs",
        "90",
        "--threads",
        "1",
    ]
    out, part = ["-o", "x.h5"], "x.h5.part"
    done = _interrupted([*command, *out], how, folder)
    assert {x.name for x in folder.iterdir()} == {"u.toml", part}
    if how == "INT":
        assert done.returncode == 130 and not done.stdout
        last = done.stderr.splitlines()[-1]
        assert re.fullmatch(rf"fflin: stopped .*\b90 .*{part}", last)
    error = refused(*command, *out, "--seed", "1", cwd=folder)
    assert part in error
    assert run(*command, *out, cwd=folder)[0] == 0
    assert run(*command, "-o", "y.h5", cwd=folder)[0] == 0
    one, two = (fflin.Campaign.load(folder / f"{name}.h5") for name in "xy")
    assert np.array_equal(one.x, two.x) and len(one) == 90
    assert {x.name for x in folder.iterdir()} == {"u.toml", "x.h5", "y.h5"}


def _interrupted(command, how, folder):
    script = INTERRUPTED.replace("SIG_HOW", f"SIG{how}")
    return finished(
        [sys.executable, "-c", script, *command],
        cwd=folder,
        capture_output=True,
        text=True,
    )


@pytest.mark.process
def test_ctrl_c_without_a_file_says_that_nothing_is_kept(folder):
    done = _interrupted(
        ["montecarlo", "planar_detumble", *SHORT, "--runs", "90"], "INT", folder
    )
    assert done.returncode == 130
    last = done.stderr.splitlines()[-1]
    assert re.fullmatch(r"fflin: stopped .*\b90 .*", last)


@pytest.mark.compiled
@pytest.mark.process
def test_the_same_command_goes_on_after_a_killed_worker(folder):
    pytest.importorskip("h5py")
    script = (
        "import os, signal, multiprocessing as mp\n"
        "from fflin.batch import files\n"
        "keep = files.FileStore.write\n"
        "def write(self, *given):\n"
        "    keep(self, *given)\n"
        "    if not os.path.exists('died'):\n"
        "        open('died', 'w').close()\n"
        "        os.kill(mp.active_children()[0].pid, signal.SIGKILL)\n"
        "if __name__ == '__main__':\n"
        "    import sys\n"
        "    from fflin.__main__ import main\n"
        "    files.FileStore.write = write\n"
        "    sys.exit(main())\n"
    )
    (folder / "main.py").write_text(script)
    command = [
        "montecarlo",
        "planar_detumble",
        *SHORT,
        "--runs",
        "90",
        "--workers",
        "2",
    ]
    done = finished(
        [sys.executable, "main.py", *command, "-o", "x.h5"],
        cwd=folder,
        capture_output=True,
        text=True,
        env=os.environ,
    )
    assert (done.returncode, (folder / "died").exists()) == (2, True), done.stderr
    last = done.stderr.splitlines()[-1]
    assert re.fullmatch(
        r"fflin: error: .*chunks.* \d+ to \d+: .*died.*x\.h5\.part.*", last
    ), last
    assert run(*command[:-2], "-o", "x.h5", cwd=folder)[0] == 0
    assert run(*command[:-2], "-o", "y.h5", cwd=folder)[0] == 0
    one, two = (fflin.Campaign.load(folder / f"{name}.h5") for name in "xy")
    assert np.array_equal(one.x, two.x)


@pytest.mark.process
def test_a_full_disk_is_reported_and_leaves_no_file(folder):
    pytest.importorskip("h5py")
    small = folder / "small"
    small.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", small], check=False
    ).returncode:
        pytest.skip("no right to mount a small disk")
    try:
        command = ["montecarlo", "planar_detumble", *SHORT]
        error = refused(*command, "--runs", "2000", "-o", small / "x.h5", cwd=folder)
        assert re.search(r"x\.h5 needs .*[1-9].* MB.*free", error)
        code, _, err = run(
            *command, "--runs", "8", "--plot", small / "x.png", cwd=folder
        )
        assert code in (0, 2) and ("No space left" in err) == (code == 2)
        code, out, err = run(
            *command, "--runs", "8", "--html", small / "x.html", cwd=folder
        )
        assert code == 2 and says(out, "none")
        assert err.endswith("x.html: cannot be written: No space left on device\n")
        assert not {x.name for x in small.iterdir()} - {"x.png"}
    finally:
        subprocess.run(["umount", small], check=True)


@pytest.mark.exhaustive
def test_the_engine_is_chosen(folder):
    command = ("montecarlo", "planar_detumble", *SHORT, "--runs", 2, "--engine")
    assert run(*command, "python", "-o", "runs.npz", cwd=folder)[0] == 0
    assert fflin.Campaign.load(folder / "runs.npz").engine == "python"
    assert "--engine" in refused(*command, "fortran", cwd=folder)


def test_a_motion_instead_of_a_robot_is_refused_with_advice():
    robot = fflin.load("planar_detumble")
    motion = fflin.simulate(robot, duration=0.1, dt=0.05)
    with pytest.raises(fflin.InputError, match=r"Motion.* one phase"):
        fflin.monte_carlo(motion, None, {"q_b": 0.1}, runs=1)
