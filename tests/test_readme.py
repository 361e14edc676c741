"""What the README and the guide show must run, as it stands there."""

import re
import shlex
import subprocess
import sys
from pathlib import Path
from shutil import which

import numpy as np
import pytest

import fflin

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def code_blocks(language, text=README):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize(
    "page",
    [
        "README.md",
        *("docs/index.md", "docs/peers.md"),
        *(f"docs/{name}.md" for name in ("guide", "tools", "uncertainty", "mpc", "catch")),
    ],
)
def test_python_examples_run(tmp_path, page):
    text = (ROOT / page).read_text(encoding="utf-8")
    (tmp_path / "example.py").write_text("\n".join(code_blocks("python", text)))
    done = subprocess.run(
        [sys.executable, "example.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "undecided" not in done.stderr


def test_the_page_on_controllers_runs(tmp_path):
    """Its robot, its code, and the command that flies the file that this leaves."""
    pytest.importorskip("slycot")
    text = (ROOT / "docs" / "controllers.md").read_text(encoding="utf-8")
    (toml,), (line,) = code_blocks("toml", text), code_blocks("sh", text)
    (tmp_path / "stowed.toml").write_text(toml)
    (tmp_path / "example.py").write_text("\n".join(code_blocks("python", text)))
    for command in (["-W", "error::UserWarning", "example.py"], ["-m", *shlex.split(line)]):
        done = subprocess.run(
            [sys.executable, *command], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    assert "settled" in done.stdout and (tmp_path / "hinf.html").exists()


def test_inputs_of_the_guide_are_read(tmp_path):
    text = (ROOT / "docs" / "guide.md").read_text(encoding="utf-8")
    block, whole, _ = code_blocks("toml", text)
    (tmp_path / "mysat.toml").write_text(whole)
    mysat = fflin.load(tmp_path / "mysat.toml")
    assert mysat.limits["q_m.joint_2"] == (-1.5, 1.5) and mysat.stiffness["panel_left"] == 100.0
    assert len(fflin.linearize(mysat).u0) == 13
    path = tmp_path / "inputs.toml"
    path.write_text(block)
    robot = fflin.load("servicer_7dof", inputs=fflin.load_inputs(path))
    names = fflin.linearize(robot).input_names
    assert names[3:] == ("tau_m.joint_1", "nozzle", "wheel_z")


def test_the_campaign_of_the_guide_runs(tmp_path):
    pytest.importorskip("h5py")
    text = (ROOT / "docs" / "guide.md").read_text(encoding="utf-8")
    *_, toml = code_blocks("toml", text)
    (tmp_path / "uncertain.toml").write_text(toml)
    [line] = [x for block in code_blocks("sh", text) for x in block.splitlines() if "monte" in x]
    done = subprocess.run(
        [sys.executable, "-m", *shlex.split(line)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert {x.name for x in tmp_path.iterdir()} == {
        *("uncertain.toml", "runs.h5", "runs.png", "worst.html")
    }
    assert (tmp_path / "worst.html").stat().st_size < 6e6
    campaign = fflin.Campaign.load(tmp_path / "runs.h5")
    assert len(campaign) == 400 and campaign.goals == ("attitude < 0.1 deg",)


@pytest.mark.skipif(not which("octave"), reason="needs Octave")
def test_octave_reads_the_model_as_the_guide_says(tmp_path):
    (block,) = code_blocks("matlab", (ROOT / "docs" / "guide.md").read_text(encoding="utf-8"))
    robot = fflin.load("servicer_7dof")
    lin = fflin.linearize(robot, v=fflin.velocity(robot, {"joint_1": 0.1}))
    lin.save(tmp_path / "model.mat")
    # `ss` belongs to a toolbox; this one takes the same arguments and looks at them.
    (tmp_path / "ss.m").write_text(
        "function sys = ss(A, B, C, D, dt, varargin)\n"
        "  printf('%.17g %.17g %d %g\\n', sum(A(:)), B(end, end), columns(D), dt);\n"
        "  assert(all(cellfun(@(x) ischar(x) || iscellstr(x), varargin)));\n"
        "  names = struct(); for k = 1:2:numel(varargin), "
        "names.(varargin{k}) = varargin{k + 1}; end\n"
        "  assert(numel(names.StateName) == rows(A) && numel(names.StateUnit) == rows(A));\n"
        "  assert(numel(names.InputName) == columns(B) && numel(names.InputUnit) == columns(B));\n"
        "  assert(numel(names.OutputName) == rows(C) && numel(names.OutputUnit) == rows(C));\n"
        "  printf('%s %s', names.StateName{8}, names.InputUnit{1});\n"
        "end\n"
    )
    script = block[: block.index("bode")]
    (tmp_path / "read.m").write_text(script.replace("sys = ss", "ss_made = 0; ss"))
    done = subprocess.run(
        ["octave", "--no-gui", "--quiet", "read.m"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    numbers, words = done.stdout.splitlines()
    total, corner, inputs, dt = map(float, numbers.split())
    assert total == pytest.approx(lin.A.sum(), rel=1e-12)
    assert (corner, inputs, dt) == (lin.B[-1, -1], 15, 0.0)
    assert words == f"{lin.state_names[7]} N m"


def test_links_lead_somewhere():
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("**/*.md")):
        prose = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for link in re.findall(r"\]\((?!http)([^)#]+)", prose):
            assert (page.parent / link).exists(), f"{page.name}: {link}"


def test_commands_run(tmp_path):
    commands = [
        shlex.split(line)
        for block in code_blocks("sh")
        for line in block.splitlines()
        if line.startswith("fflin ")
    ]
    assert len(commands) >= 4
    for command in commands:
        done = subprocess.run(
            [sys.executable, "-m", *command],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr


def test_the_chain_of_the_tutorial_runs(tmp_path):
    """Its file, code and commands in their order; the flown motion ends near to the plan."""
    text = (ROOT / "docs" / "tracking.md").read_text(encoding="utf-8")
    (toml,) = code_blocks("toml", text)
    (tmp_path / "detumble.toml").write_text(toml)
    for language, block in re.findall(r"```(sh|python)\n(.*?)```", text, re.DOTALL):
        if language == "python":
            commands = [["-c", "import fflin; robot = fflin.load('detumble.toml')\n" + block]]
        else:
            commands = [["-m", *shlex.split(line)] for line in block.splitlines()]
        for command in commands:
            done = subprocess.run(
                [sys.executable, *command],
                cwd=tmp_path,
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, done.stderr
    motion = fflin.Motion.load(tmp_path / "flown.npz")
    assert motion.attitude_error[0] == pytest.approx(1.0, abs=1e-9)
    assert motion.attitude_error[-1] < 0.1
    assert (np.abs(motion.u) <= np.repeat([12.0, 7.0, 6.0], 3) + 1e-9).all()
    slew = fflin.Trajectory.load(
        tmp_path / "slew.npz", fflin.load("servicer_7dof", lock=["panel_*"])
    )
    # The last knot is the goal, met to 1e-6, over a step's way of some 0.1.
    assert (np.abs(slew.v[:, 6:]) <= 0.4 + 1e-6).all() and slew.residual.max() < 1e-5


def test_two_commands_set_up_from_nothing():
    """One for the main job, one for the tests; what they install is what the project declares."""
    setups = [line for block in code_blocks("sh") for line in block.splitlines() if "venv" in line]
    assert len(setups) == 2
    job, tests = setups
    # With matplotlib, so that every command further down runs after it.
    assert job.startswith("python3 -m venv .venv && .venv/bin/pip install -q -e '.[plot]' && ")
    # The part behind the installation, in this environment.
    for step in job.split(" && ")[2:]:
        arguments = shlex.split(step.removeprefix(".venv/bin/fflin "))
        done = subprocess.run(
            [sys.executable, "-m", "fflin", *arguments], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0 and done.stdout
    assert tests.endswith(".venv/bin/pytest")


def test_every_bundled_robot_is_named():
    from fflin.robot.catalog import find_robot

    for name in fflin.list_robots():
        if find_robot(name).origin == "fflin":
            assert f"`{name}`" in README
