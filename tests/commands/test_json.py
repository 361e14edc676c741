"""With --json every command prints one object of one schema, with the figures of the Python API."""

import json
import shlex

import numpy as np
import pytest

import fflin
from fflin.commands import cli
from tests.support.commands import run
from tests.support.marks import exhaustive

HEAD = ["fflin", "command", "robot", "result", "files"]
ROBOT = "planar_detumble"
LOCKED = "--lock joint_2 --lock joint_3"  # for a short search


def of_modes(modes):
    return [mode.pole for mode in modes.modes]


def complex_of(item):
    return complex(item["real"], item["imag"])


class Python:
    """The same robot in Python."""

    def __init__(self, folder):
        self.folder, self.robot = folder, fflin.load(ROBOT)
        self.lin = fflin.linearize(self.robot)
        self.gain = fflin.lqr(self.lin)
        self.loop = fflin.StateFeedback(self.lin, self.gain.K)
        self.plan = fflin.Trajectory.load(folder / "plan.npz", self.robot)
        self.along = fflin.linearize_trajectory(self.robot, self.plan)
        self.short = {"duration": 0.4, "dt": 0.02, "limits": "urdf"}
        turn = fflin.velocity(self.robot, {"omega_b.z": 0.01})
        self.motion = fflin.simulate(self.robot, self.loop, v0=turn, **self.short)
        spread = fflin.load_dispersions(folder / "u.toml")
        self.campaign = fflin.monte_carlo(
            self.robot, self.loop, spread, runs=9, **self.short
        )
        self.region = fflin.validity(self.robot, self.lin, self.gain, samples=3)
        ranges = {"base.mass": 0.2}
        self.tuned = fflin.tune(
            self.lin, fflin.PD("q_b", "tau_b"), fflin.Decay(rate=0.01), starts=1
        )
        self.lft = fflin.uncertain(self.robot, ranges).lft()
        sensed = self.robot.replace(outputs=["base", "joints"])
        sampled = fflin.linearize(sensed).discretize(0.1)
        W = {"omega_b": 1e-3, "v_b": 1e-3, "qdot_m": 1e-3}
        V = {"q_b": 1e-6, "r_b": 1e-6, "q_m": 1e-6}
        self.compensator = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, W, V))


# Of each command: what it is given, and pairs of a figure that it prints and that of Python.
CASES = {
    "robots": ("", lambda x, py: [(x["robots"][ROBOT]["mass"], py.robot.mass)]),
    "info": (
        ROBOT,
        lambda x, py: [
            (x["mass"], py.robot.mass),
            (len(x["state_names"]), len(py.lin.A)),
        ],
    ),
    "init": (f"{ROBOT} -o own.toml", lambda x, py: []),
    "linearize": (ROBOT, lambda x, py: [(x["A"], py.lin.A), (x["B"], py.lin.B)]),
    "check": (ROBOT, lambda x, py: [(len(x["rows"]), len(py.check.rows))]),
    "analyze": (
        ROBOT,
        lambda x, py: [
            (
                x["controllability"]["dimension"],
                fflin.controllability(py.lin).dimension,
            ),
            (x["observability"]["dimension"], fflin.observability(py.lin).dimension),
        ],
    ),
    "modes": (
        f"{ROBOT} --stiffness joint_1=3",
        lambda x, py: [
            (
                list(map(complex_of, (m["pole"] for m in x["modes"]["modes"]))),
                of_modes(py.sprung),
            )
        ],
    ),
    "equilibrium": (
        f"{ROBOT} --stiffness joint_1=3 --joint joint_1=0.2",
        lambda x, py: [
            (x["u"], py.held.u),
            (x["q"], py.held.q),
            (x["largest_real_part"], 0.0),
        ],
    ),
    "plan": (
        f"{ROBOT} {LOCKED} --target-joint joint_1=0.3 --duration 20 --knots 5 -o slew.npz",
        lambda x, py: [(x["u"], py.slew.u), (x["q"], py.slew.q)],
    ),
    "validity": (
        f"{ROBOT} --samples 3",
        lambda x, py: [
            (list(x["holds"].values()), list(py.region.holds.values())),
            (x["rate"], py.region.rate),
        ],
    ),
    "sensitivity": (
        ROBOT,
        lambda x, py: [(x["dA"][0], fflin.sensitivity(py.lin)[x["parameters"][0]].dA)],
    ),
    "uncertain": (
        f"{ROBOT} --vary base.mass=0.2",
        lambda x, py: [(x["A"], py.lft.A), (x["D11"], py.lft.D11)],
    ),
    "funnel": (
        f"{ROBOT} --schedule gains.npz --goal attitude=1 --knots 2 --samples 2 --threads 1",
        lambda x, py: [(x["P"], py.funnel.P), (x["tried"], py.funnel.tried)],
    ),
    "lqr": (ROBOT, lambda x, py: [(x["K"], py.gain.K), (x["P"], py.gain.P)]),
    "lqg": (
        f"{ROBOT} --output base --output joints --noise q_b=1e-3 --noise r_b=1e-3 "
        "--noise q_m=1e-3 --process-noise omega_b=1e-3 --process-noise v_b=1e-3 "
        "--process-noise qdot_m=1e-3 --sample 0.1",
        lambda x, py: [(x["A"], py.compensator.A), (x["C"], py.compensator.C)],
    ),
    "tvlqr": (
        f"{ROBOT} --trajectory plan.npz",
        lambda x, py: [(x["K"], py.schedule.K), (x["t"], py.schedule.t)],
    ),
    "simulate": (
        f"{ROBOT} --velocity omega_b.z=0.01 --duration 0.4 --dt 0.02",
        lambda x, py: [
            (x["x"], py.motion.x[-1]),
            (x["errors"]["attitude"]["final"], py.motion.attitude_error[-1]),
            (x["energy"], py.motion.energy[[0, -1]]),
        ],
    ),
    "tune": (
        f"{ROBOT} --law pd --goal 'decay rate=0.01' --starts 1",
        lambda x, py: [
            (x["parameters"]["kp.tau_b.x"], py.tuned.parameters["kp.tau_b.x"])
        ],
    ),
    "export": ("gain.npz -o flight", lambda x, py: []),
    "sweep": (f"{ROBOT} --random 3 -o many.npz", lambda x, py: [(x["points"], 3)]),
    "montecarlo": (
        f"{ROBOT} u.toml --runs 9 --duration 0.4 --dt 0.02",
        lambda x, py: [
            (x["quantiles"]["attitude"]["0.5"], py.campaign.quantile("attitude", 0.5)),
            (x["worst"], py.campaign.worst(3)),
        ],
    ),
}


@pytest.fixture(scope="module")
def python(tmp_path_factory, brief_validity_in_module):
    folder = tmp_path_factory.mktemp("json")
    (folder / "u.toml").write_text('[dispersions]\n"q_m" = 0.05\n"omega_b.z" = 0.02\n')
    robot = fflin.load(ROBOT)
    fflin.lqr(fflin.linearize(robot)).save(folder / "gain.npz")
    spin = fflin.velocity(robot, {"omega_b.z": 0.05})
    fflin.simulate(robot, v0=spin, duration=0.1).trajectory().save(folder / "plan.npz")
    session = Python(folder)
    session.check = fflin.check(robot, session.lin)
    session.schedule = fflin.tvlqr(session.along)
    session.schedule.save(folder / "gains.npz")
    session.sprung = fflin.modes(
        fflin.linearize(fflin.load(ROBOT, stiffness={"joint_1": 3.0}))
    )
    sprung = fflin.load(ROBOT, stiffness={"joint_1": 3.0})
    session.held = fflin.equilibrium(
        sprung, fflin.configuration(sprung, {"joint_1": 0.2})
    )
    locked = fflin.load(ROBOT, lock=["joint_2", "joint_3"])
    end = fflin.configuration(locked, {"joint_1": 0.3})
    session.slew = fflin.plan(locked, (end, None), 20.0, knots=5)
    goal = {"knots": 2, "samples": 2, "threads": 1, "limits": "urdf"}
    session.funnel = fflin.funnel(robot, session.schedule, {"attitude": 1.0}, **goal)
    return session


@pytest.mark.parametrize(
    "command",
    [*(name for name in CASES if name != "funnel"), *exhaustive("funnel")],
)
def test_json_has_one_schema_and_the_figures_of_python(command, python):
    words, figures = CASES[command]
    code, out, err = run(command, *shlex.split(words), "--json", cwd=python.folder)
    assert code == 0 and "error" not in err and out.count("\n") == 1
    message = json.loads(out, parse_constant=pytest.fail)  # NaN is no JSON
    assert list(message)[: len(HEAD)] == HEAD
    assert (message["fflin"], message["command"]) == (fflin.__version__, command)
    assert message["robot"] == (None if command == "robots" else ROBOT)
    assert message["result"] and "\n" not in message["result"]
    for shown, session in figures(message, python):
        # Relative to the largest: two runs of an integrator differ by its rounding.
        assert np.shape(shown) == np.shape(session)
        assert np.abs(np.subtract(shown, session)).max() <= 1e-9 * max(
            np.abs(session).max(), 1e-3
        )
    for name in message["files"]:
        assert (python.folder / name).stat().st_size


def test_every_command_but_view_is_tried():
    assert {name for names in cli.TASKS.values() for name in names} - {"view"} == {
        *CASES
    }


def test_the_first_paragraph_of_the_text_is_the_result(python):
    text, message = (run("lqr", ROBOT, *more)[1] for more in ((), ("--json",)))
    assert f"lqr: {json.loads(message)['result']}" == " ".join(
        text.split("\n")[0].split()
    )


def test_an_error_leaves_stdout_empty_and_a_failed_check_prints_json(python):
    assert run("lqr", "nosuch", "--json")[:2] == (2, "")
    code, out, _ = run("check", ROBOT, "--tolerance", 1e-30, "--json")
    assert code == 1 and json.loads(out)["ok"] is False
    worst = max(row["error"] for row in json.loads(out)["rows"])
    assert json.loads(out)["max_error"] == worst > 0.0


def test_nonfinite_values_are_null():
    from fflin.commands.cli import plain

    assert plain({"a": np.array([1.0, np.inf]), "_b": 1}) == {"a": [1.0, None]}
    assert plain(np.array([1.0 + 2.0j])) == [{"real": 1.0, "imag": 2.0}]


def test_info_has_the_momentum_of_the_wheels_and_the_authority_of_the_thrusters(
    tmp_path,
):
    wheels = "".join(
        f"[[input]]\ntype = 'reaction_wheel'\naxis = {axis}\ninertia = 1e-5\nmax_speed = 300.0\n"
        for axis in np.eye(3).tolist()
    )
    thrusters = "".join(
        f"[[input]]\ntype = 'thruster'\nframe = 'base'\nmax = 2.0\n"
        f"position = {(0.5 * side * lever).tolist()}\ndirection = {(way * along).tolist()}\n"
        for lever, along in zip(np.roll(np.eye(3), 1, axis=0), np.eye(3), strict=True)
        for side in (1, -1)
        for way in (1, -1)
    )
    text = (
        f"urdf = 'cubesat.urdf'\n[point.velocity]\nwheel_1 = 100.0\n{wheels}{thrusters}"
    )
    urdf = fflin.load("cubesat").urdf
    (tmp_path / "cubesat.urdf").write_bytes(urdf.read_bytes())
    (tmp_path / "sat.toml").write_text(text)
    code, out, err = run("info", "sat.toml", "--json", cwd=tmp_path)
    assert (code, err) == (0, "")
    result = json.loads(out)
    momentum = result["wheel_momentum"]
    assert momentum["wheels"] == momentum["axes"] == 3
    assert momentum["total"] == pytest.approx([1e-3, 0.0, 0.0])
    assert momentum["least"] == pytest.approx(3e-3)
    reach = result["thruster_authority"]
    assert (reach["thrusters"], reach["every_way"]) == (12, True)
    assert reach["least_force"] == pytest.approx(4.0) and reach[
        "least_torque"
    ] == pytest.approx(2.0)
