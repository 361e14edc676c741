"""Every page of the guide runs: its Python, its commands and its files, in their order."""

import re
import shlex
import subprocess
import sys
from pathlib import Path
from shutil import which

import numpy as np
import pytest

import fflin
from tests.support.speeds import largest_speeds

GUIDE = Path(__file__).parents[1] / "docs" / "guide"
PAGES = sorted(path.stem for path in GUIDE.glob("*.md") if path.stem != "index")
# Packages without which a page cannot run.
NEEDS = {
    "controllers": "slycot",
    "files": "pandas",
    "monte_carlo": "h5py",
    "sweeps": "h5py",
    "tuning": "slycot",
    "uncertain_models": "slycot",
}


def read(page):
    return (GUIDE / f"{page}.md").read_text(encoding="utf-8")


def script(text, folder):
    """Write the TOML blocks of a page under the names before them; return all else as a script."""
    code = ["from fflin.commands.cli import main"]
    for block in re.finditer(
        r"^```(python|sh|toml)\n(.*?)^```", text, re.DOTALL | re.MULTILINE
    ):
        language, body = block.groups()
        if language == "toml":
            name = re.findall(r"`(\w+\.toml)`", text[: block.start()])[-1]
            (folder / name).write_text(body, encoding="utf-8")
        elif language == "python":
            code.append(body)
        else:
            commands = [shlex.split(line, comments=True) for line in body.splitlines()]
            code += [
                f"assert main({words[1:]}) == 0"
                for words in commands
                if words[0] == "fflin"
            ]
    return "\n".join(code)


def check_controllers(folder, out):
    """The controller from the file settles."""
    assert "settled" in out and (folder / "hinf.html").exists()


def check_monte_carlo(folder, out):
    """The campaign is complete, its report narrow and its page small."""
    assert max(map(len, out.splitlines())) <= 80
    assert (folder / "runs.png").exists() and (
        folder / "worst.html"
    ).stat().st_size < 6e6
    campaign = fflin.Campaign.load(folder / "runs.h5")
    assert len(campaign) == 400 and campaign.goals == ("attitude < 0.1 deg",)


def check_tracking(folder, out):
    """The motion ends near its plan and within its limits."""
    motion = fflin.Motion.load(folder / "flown.npz")
    assert motion.attitude_error[0] == pytest.approx(1.0, abs=1e-9)
    assert motion.attitude_error[-1] < 0.1
    assert (np.abs(motion.u) <= np.repeat([12.0, 7.0, 6.0], 3) + 1e-9).all()
    servicer = fflin.load("servicer_7dof", lock=["panel_*"])
    slew = fflin.Trajectory.load(folder / "slew.npz", servicer)
    assert len(slew.t) == 41 and slew.residual.max() < 1e-6
    assert (largest_speeds(slew) <= 1.01 * servicer.model.velocityLimit[6:]).all()


CHECKS = {
    "controllers": check_controllers,
    "monte_carlo": check_monte_carlo,
    "tracking": check_tracking,
}


@pytest.mark.docs
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.sample] * (page == "outputs"))
        for page in PAGES
    ],
)
def test_a_page_runs(page, tmp_path):
    if page in NEEDS:
        pytest.importorskip(NEEDS[page])
    (tmp_path / "page.py").write_text(script(read(page), tmp_path), encoding="utf-8")
    # Not run as a file, which the workers of a sweep would run again.
    run = "exec(compile(open('page.py', encoding='utf-8').read(), 'page.py', 'exec'))"
    strict = ["-W", "error::UserWarning"] * (page == "controllers")
    done = subprocess.run(
        [sys.executable, *strict, "-c", run],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "undecided" not in done.stderr
    if page in CHECKS:
        CHECKS[page](tmp_path, done.stdout)


def test_pages_are_short():
    assert len(PAGES) >= 18
    for page in PAGES:
        assert read(page).count("\n") <= 200, page


@pytest.mark.docs
@pytest.mark.skipif(not which("octave"), reason="needs Octave")
def test_octave_makes_a_system_of_a_saved_model(tmp_path):
    (block,) = re.findall(
        r"^```octave\n(.*?)^```", read("files"), re.DOTALL | re.MULTILINE
    )
    lin = fflin.linearize(fflin.load("servicer_7dof"))
    lin.save(tmp_path / "model.mat")
    (tmp_path / "read.m").write_text(
        "if isempty(pkg('list', 'control')), disp('no package control'), exit, end\n"
        + block[: block.index("bode")]
        + "printf('%d %d %d %s\\n', size(sys), isct(sys), sys.stname{8});\n"
    )
    done = subprocess.run(
        ["octave", "--no-gui", "--quiet", "read.m"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    if "no package control" in done.stdout:
        pytest.skip("needs Octave's package control")
    assert done.stdout == f"30 15 1 {lin.state_names[7]}\n", done.stderr


@pytest.mark.docs
@pytest.mark.skipif(not which("octave"), reason="needs Octave")
def test_octave_reads_a_saved_model(tmp_path):
    block, _ = re.findall(
        r"^```matlab\n(.*?)^```", read("files"), re.DOTALL | re.MULTILINE
    )
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
