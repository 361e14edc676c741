"""A servicer of 600 kg, from URDF to page, campaign and LFT, with eight options in all."""

from itertools import product

import numpy as np
import pytest

import fflin
from tests.support.commands import run

HALF, LEVER = (0.6, 0.6, 0.8), (0.5, 0.5, 0.5)
DISPERSIONS = (
    '[dispersions]\n"base.mass" = 0.05\n"q_b" = 0.01\n"panel_*.stiffness" = 0.2\n'
)
COMMANDS = (
    "info servicer.toml",
    "check servicer.toml",
    "lqr servicer.toml",
    "montecarlo servicer.toml dispersions.toml --runs 8 --dt 0.05 -o runs.npz",
    "simulate servicer.toml --html motion.html -o motion.npz",
    "uncertain servicer.toml --vary base.mass=0.1 -o lft.mat",
)


def link(name, mass, size, center=(0, 0, 0)):
    """Return a box of uniform density."""
    x, y, z = (s * s for s in size)
    ixx, iyy, izz = (mass / 12.0 * s for s in (y + z, x + z, x + y))
    return (
        f'<link name="{name}"><inertial><origin xyz="{center[0]} {center[1]} {center[2]}"/>'
        f'<mass value="{mass}"/><inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" '
        f'iyz="0"/></inertial><visual><origin xyz="{center[0]} {center[1]} {center[2]}"/>'
        f'<geometry><box size="{size[0]} {size[1]} {size[2]}"/></geometry></visual></link>'
    )


def joint(name, parent, child, at, axis, limits):
    low, high, effort, velocity = limits
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at[0]} {at[1]} {at[2]}"/><axis xyz="{axis}"/>'
        f'<limit lower="{low}" upper="{high}" effort="{effort}" velocity="{velocity}"/></joint>'
    )


def urdf():
    """Return a box with two panels and an arm of seven joints; 600 kg with its wheels."""
    parts = [link("base", 480.0, (1.2, 1.2, 1.6))]
    for name, side in (("left", 1), ("right", -1)):
        parts.append(link(f"panel_{name}", 20.0, (1.0, 3.0, 0.03), (0, 1.6 * side, 0)))
        limits = (-0.3, 0.3, 0, 1)
        at = (0, 0.6 * side, 0)
        parts.append(
            joint(f"panel_{name}", "base", f"panel_{name}", at, "1 0 0", limits)
        )
    parent, at = "base", (0.6, 0, 0.5)
    for k in range(7):
        axis = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "0 0 1", "1 0 0")[k]
        limits = (-2.8, 2.8, (80, 80, 60, 40, 20, 20, 10)[k], 0.2)
        parts.append(link(f"arm_{k + 1}", 80.0 / 7.0, (0.4, 0.12, 0.12), (0.2, 0, 0)))
        parts.append(joint(f"joint_{k + 1}", parent, f"arm_{k + 1}", at, axis, limits))
        parent, at = f"arm_{k + 1}", (0.4, 0, 0)
    return f'<robot name="servicer">{"".join(parts)}</robot>'


def robot_file():
    """Return robot.toml: four wheels in a pyramid, twelve thrusters, springs, point and start."""
    lines = [
        'urdf = "servicer.urdf"',
        'passive = ["panel_*"]',
        '[stiffness]\n"panel_*" = 150.0',
        '[damping]\n"panel_*" = 1.5',
        "[point.joints]\njoint_2 = 0.6\njoint_3 = -0.9",
        "[start]\nrpy = [6.0, -4.0, 8.0]",
        "[start.joints]\njoint_2 = 0.7",
    ]
    for x, y in product((1, -1), repeat=2):
        wheel = f"axis = [{x}, {y}, 1]\ninertia = 0.05\nmax = 0.4\nmax_speed = 400.0"
        name = f"wheel_{'pm'[x < 0]}{'pm'[y < 0]}"
        lines.append(f'[[input]]\ntype = "reaction_wheel"\nname = "{name}"\n{wheel}')
    for k, s, t in product(range(3), (1, -1), (1, -1)):
        position, direction = np.zeros(3), np.zeros(3)
        position[k], position[(k + 2) % 3] = -s * HALF[k], t * LEVER[k]
        direction[k] = s
        where = f"position = {position.tolist()}\ndirection = {direction.tolist()}\nmax = 22.0"
        name = f"{'xyz'[k]}_{'pm'[s < 0]}{'pm'[t < 0]}"
        lines.append(
            f'[[input]]\ntype = "thruster"\nname = "{name}"\nframe = "base"\n{where}'
        )
    lines.append('[[input]]\ntype = "joint_torque"\njoint = "joint_*"')
    return "\n".join(lines)


@pytest.mark.compiled
def test_a_servicer_goes_from_urdf_to_page_campaign_and_lft_with_eight_options(
    tmp_path,
):
    (tmp_path / "servicer.urdf").write_text(urdf())
    (tmp_path / "servicer.toml").write_text(robot_file())
    (tmp_path / "dispersions.toml").write_text(DISPERSIONS)
    words = [word for command in COMMANDS for word in command.split()]
    assert sum(word.startswith("-") for word in words) <= 8
    for command in COMMANDS:
        code, _, err = run(*command.split(), cwd=tmp_path)
        messages = [line for line in err.splitlines() if "compiling" not in line]
        messages = [line for line in messages if not line.startswith("fflin: about")]
        assert (code, messages) == (0, []), command
    robot = fflin.load(tmp_path / "servicer.toml")
    assert robot.mass == pytest.approx(600.0)
    assert len(robot.wheels) == 4 and robot.n == 7 + 2 + 4
    assert sum(isinstance(item, fflin.Thruster) for item in robot.inputs) == 12
    motion = fflin.Motion.load(tmp_path / "motion.npz")
    # From 6, -4 and 8 deg to the point, without a command beyond its limit.
    assert motion.attitude_error[0] > 8.0 and motion.attitude_error[-1] < 0.05
    arm = [
        i for i, name in enumerate(motion.state_names) if name.startswith("q_m.joint")
    ]
    assert np.abs((motion.x[-1] - motion.target)[arm]).max() < 1e-3
    thrust = [
        i for i, name in enumerate(motion.input_names) if name[:2] in ("x_", "y_", "z_")
    ]
    assert not motion.passed and 0.0 <= motion.u[:, thrust].min()
    # The campaign has left machine code for this run of more than 20,000 steps.
    assert motion.engine == "compiled"
    page = (tmp_path / "motion.html").read_text(encoding="utf-8")
    for name in (*robot.joint_names, *(item.name for item in robot.inputs[4:16])):
        assert f'"{name}"' in page, name
    campaign = fflin.Campaign.load(tmp_path / "runs.npz")
    assert len(campaign) == 8 and not campaign.stop.any()
    assert campaign.fraction("attitude < 0.1 deg and joints < 0.01 rad").value == 1.0
    assert {"base.mass", "panel_left.stiffness", "q_b.x"} <= {*campaign.names}
    lft = fflin.LFT.load(tmp_path / "lft.mat")
    lin = fflin.linearize(robot, fflin.configuration(robot, robot.point["joints"]))
    assert lft.state_names == lin.state_names and np.abs(lft.A - lin.A).max() < 1e-9
    assert lft.parameters == ("base.mass",)
