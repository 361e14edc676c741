"""`fflin analyze` as a user runs it."""

import pytest

from tests.support.commands import refused, run
from tests.support.messages import says

JOINTS = "\n".join(
    f'[[input]]\ntype = "joint_torque"\njoint = "joint_{i}"' for i in range(1, 7)
)


def test_a_model_with_joint_torques_only_names_the_conserved_quantities(tmp_path):
    (tmp_path / "joints.toml").write_text(JOINTS)
    code, out, err = run("analyze", "ets_vii", "--inputs", "joints.toml", cwd=tmp_path)
    assert code == 0 and not err
    assert says(out, "12 of 24", "not stabilizable")
    assert says(out, "angular momentum x/y/z, linear momentum x/y/z")
    assert says(out, "base attitude x/y/z")
    assert says(out, "periodic joint motion")
    assert says(out, "6 components of the momentum") and says(out, "12 states")
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize("name", ["cubesat", "dual_arm"])
def test_full_actuation_and_outputs(name):
    code, out, err = run("analyze", name, "--stiffness", "20", "--output", "base")
    assert code == 0 and not err
    assert "stabilizable" in out and "not stabilizable" not in out
    assert says(out, "no momentum is conserved") and "rigid-body modes" in out
    assert max(map(len, out.splitlines())) <= 80


def test_in_orbit_its_field_acts_on_all_momenta():
    code, out, _ = run("analyze", "cubesat", "--orbit", "700e3", "--equilibrium")
    assert code == 0
    assert says(out, "the orbit, inputs, springs or dampers")
    assert "orbit" not in run("analyze", "cubesat")[1]


def test_points_off_rest_are_reported(tmp_path):
    code, out, err = run("analyze", "ets_vii", "--velocity", "omega_b.z=0.1")
    assert code == 0 and not err
    assert (
        says(out.splitlines()[0], "controllable, observable")
        and "not an equilibrium" in out
    )
    (tmp_path / "joints.toml").write_text(JOINTS)
    moving = (
        "analyze",
        "ets_vii",
        "--inputs",
        "joints.toml",
        "--velocity",
        "joint_1=0.1",
    )
    code, out, err = run(*moving, cwd=tmp_path)
    assert code == 0 and not err
    assert says(out, "analyze: not controllable (at most 15/24)", "of the frozen A")
    assert says(out, "at most 15 of 24", "frozen at this point", "not stabilizable")
    assert says(out, "no reduction", "linearise at rest")
    assert "stabilizable" not in " ".join(out.split()).replace("not stabilizable", "")


def test_invalid_input_is_one_line():
    assert "joint_1" in refused("analyze", "ets_vii", "--stiffness", "joint1=3")


@pytest.mark.exhaustive
def test_validity_says_whether_inputs_were_cut(brief_validity):
    asked = ("validity", "servicer_7dof", "--samples", "1")
    _, free, _ = run(*asked)
    _, cut, _ = run(*asked, "--limits", "urdf")
    assert says(free.splitlines()[-1], "--limits urdf")
    assert says(cut.splitlines()[-1], "limits")


def test_wheels_change_the_momentum_of_the_other_bodies(tmp_path):
    """Wheels alone cannot change the 3 linear momenta of the body that carries them."""
    wheels = [
        f'[[input]]\ntype = "reaction_wheel"\naxis = {axis}\ninertia = 1e-3\n'
        for axis in ([1, 0, 0], [0, 1, 0], [0, 0, 1])
    ]
    (tmp_path / "wheels.toml").write_text("".join(wheels))
    code, out, _ = run("analyze", "cubesat", "--inputs", "wheels.toml", cwd=tmp_path)
    assert code == 0
    assert says(
        out, "3 components of the momentum of the robot without its wheels cannot be"
    )
