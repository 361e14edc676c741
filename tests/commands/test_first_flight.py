"""A satellite with panels, an arm, thrusters and wheels, in one URDF and one TOML, flies."""

import numpy as np
import pytest

import fflin
from fflin.robot.catalog import bundled_directory
from tests.support.commands import run

TOML = bundled_directory() / "inspector.toml"
TANK = """
[[slosh]]
name = "tank"
frame = "base"
radius = 0.3
height = 0.4
bottom = [0, 0, -0.4]
density = 1000
acceleration = 0.04
damping = 0.05 # of a tank with baffles
pendulum = false
"""


COMPILED = ("--engine", "compiled")  # a long flight takes a minute in Python


@pytest.mark.compiled
@pytest.mark.exhaustive
def test_the_inspector_flies_within_its_limits_at_the_first_try(tmp_path):
    pytest.importorskip("numba")
    files = ("--html", "a.html", "-o", "a.npz")
    code, out, err = run("simulate", TOML, *files, *COMPILED, cwd=tmp_path)
    assert (code, err) == (0, "")
    assert out.startswith("simulate: settled after ")
    assert (tmp_path / "a.html").stat().st_size < 6e6
    motion = fflin.Motion.load(tmp_path / "a.npz")
    robot = fflin.load(TOML)
    assert motion.attitude_error[0] > 19.9 and motion.attitude_error[-1] < 0.05
    assert motion.wheels == ("wheel_x", "wheel_y", "wheel_z")
    assert not motion.passed and not motion.saturated
    # By their own figures, not by what the motion says of itself.
    u = dict(zip(motion.input_names, np.abs(motion.u).max(axis=0), strict=True))
    x = dict(zip(motion.state_names, np.abs(motion.x).max(axis=0), strict=True))
    assert all(
        u[name] <= 1.0 and x[f"qdot_m.{name}"] <= 500.0 for name in motion.wheels
    )
    thrusts = [item.name for item in robot.inputs if isinstance(item, fflin.Thruster)]
    assert len(thrusts) == 8
    for name in thrusts:
        values = motion.u[:, motion.input_names.index(name)]
        assert values.min() >= 0.0 and values.max() <= 10.0
    efforts = {
        "arm_1": 60,
        "arm_2": 60,
        "arm_3": 40,
        "arm_4": 15,
        "arm_5": 15,
        "arm_6": 10,
    }
    speeds = {
        "arm_1": 0.2,
        "arm_2": 0.2,
        "arm_3": 0.2,
        "arm_4": 0.4,
        "arm_5": 0.4,
        "arm_6": 0.4,
    }
    for name, effort in efforts.items():
        assert u[f"tau_m.{name}"] <= effort and x[f"qdot_m.{name}"] <= speeds[name]
    assert not any(name.startswith("tau_m.hinge") for name in motion.input_names)
    assert motion.momentum_drift.max() < 1e-12


@pytest.mark.compiled
@pytest.mark.exhaustive
def test_the_inspector_with_flexible_arrays_and_a_tank_settles_within_its_limits(
    tmp_path,
):
    pytest.importorskip("numba")
    text = TOML.with_name("inspector_flexible.toml").read_text(encoding="utf-8")
    (tmp_path / "flexible.toml").write_text(
        text.replace("inspector.urdf", TOML.with_suffix(".urdf").as_posix()) + TANK,
        encoding="utf-8",
    )
    given = (
        "simulate",
        "flexible.toml",
        "--duration",
        "400",
        "-o",
        "a.npz",
        "--html",
        "a.html",
    )
    code, out, err = run(*given, *COMPILED, cwd=tmp_path)
    assert (code, err) == (0, "")
    assert out.startswith("simulate: settled after ")
    motion = fflin.Motion.load(tmp_path / "a.npz")
    assert motion.attitude_error[0] > 19.9 and motion.attitude_error[-1] < 0.05
    assert {"q_m.left_mode_3", "q_m.right_mode_1", "q_m.tank_y"} <= set(
        motion.state_names
    )
    assert not motion.passed and not motion.saturated
    assert motion.momentum_drift.max() < 1e-12
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert (
        '"modal amplitudes"' in page and '"left_mode_1"' in page and '"tank_x"' in page
    )
