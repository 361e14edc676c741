"""`fflin analyze` as a user runs it."""

import pytest

from tests.support.commands import refused, run

JOINTS = "\n".join(f'[[input]]\ntype = "joint_torque"\njoint = "joint_{i}"' for i in range(1, 7))


def test_joints_only_says_what_is_conserved(tmp_path):
    (tmp_path / "joints.toml").write_text(JOINTS)
    code, out, err = run("analyze", "ets_vii", "--inputs", "joints.toml", cwd=tmp_path)
    assert code == 0 and not err
    text = " ".join(out.split())
    assert "12 of 24 states are controllable (closed form); not stabilizable" in text
    assert "uncontrollable: angular momentum x/y/z, linear momentum x/y/z" in text
    assert "base attitude x/y/z with the joints held" in text
    assert "closed loops of the joints still turn the base" in text
    assert "6 momenta are conserved" in text and "12 states are left" in text
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize("name", ["cubesat", "dual_arm"])
def test_full_actuation_and_outputs(name):
    code, out, err = run("analyze", name, "--stiffness", "20", "--output", "base")
    assert code == 0 and not err
    assert "stabilizable" in out and "not stabilizable" not in out
    assert "none is conserved" in out and "rigid-body modes" in out
    assert max(map(len, out.splitlines())) <= 80


def test_in_orbit_its_field_acts_on_all_momenta():
    code, out, _ = run("analyze", "cubesat", "--orbit", "700e3", "--equilibrium")
    text = " ".join(out.split())
    assert code == 0
    assert "the orbit's field, the inputs, springs and dampers act on all of them" in text
    assert "orbit" not in run("analyze", "cubesat")[1]


def test_points_off_rest_are_told():
    code, out, err = run("analyze", "ets_vii", "--velocity", "omega_b.z=0.1")
    assert code == 0 and not err
    assert "not a fixed point" in out and "a point that moves on" in out


def test_bad_input_is_one_line():
    assert "did you mean joint_1" in refused("analyze", "ets_vii", "--stiffness", "joint1=3")


def test_validity_says_whether_inputs_were_cut():
    asked = (
        "validity",
        "servicer_7dof",
        "--samples",
        "8",
        "--bryson",
        "q_b=0.001",
        "--r",
        "tau_b=1",
    )
    _, free, _ = run(*asked)
    _, cut, _ = run(*asked, "--limits", "urdf")
    assert free.splitlines()[-1].endswith("--limits urdf cuts them")
    assert cut.splitlines()[-1] == "inputs were cut to the limits of the robot"
