"""Constraints on the command line."""

import json

import pytest

from tests.support.commands import refused, run, warned

GRASP = ("dual_arm", "--weld", "tool_left=tool_right")


def test_a_weld_of_two_tools_reduces_the_states():
    code, out, _ = run("linearize", *GRASP, "--json")
    assert code == 0
    names = json.loads(out)["state_names"]
    assert len(names) == 16


def test_the_model_of_a_welded_base_is_checked():
    code, out, _ = run("check", "cubesat", "--weld", "base")
    assert code == 0
    assert "A and B of cubesat: verified" in out


def test_info_lists_constraints_with_their_rank_and_redundancy():
    twice = ("--weld", "tool_left", "--weld", "base", "--weld", "tool_right=tool_left")
    code, out, _ = run("info", "dual_arm", *twice)
    assert code == 0
    text = " ".join(out.split())
    assert "constraints: 18 rows of rank 14, 0 velocities remain free" in text
    assert "4 redundant rows in tool_left" in text
    assert (
        "weld 'tool_right/tool_left': frame 'tool_right' to frame 'tool_left'" in text
    )


def test_the_rank_is_in_the_json_of_info():
    code, out, _ = run("info", *GRASP, "--json")
    assert code == 0
    result = json.loads(out)
    assert result["constraints"] == ["tool_left/tool_right"]
    assert (result["rows"], result["rank"], result["free"]) == (6, 6, 8)
    assert result["redundant"] == []


def test_an_open_point_is_closed_with_a_warning(tmp_path):
    path = tmp_path / "clamped.toml"
    path.write_text(
        """
urdf = "cubesat"
[[constraint]]
type = "weld"
frame = "base"
position = [0, 0, 0]
"""
    )
    messages = warned("linearize", path, "--position", "0.2", "0", "0")
    assert any("the point is off constraint 'base' by 0.2 m" in x for x in messages)


def test_a_weld_without_a_frame_is_refused():
    message = refused("linearize", "cubesat", "--weld", "=tool")
    assert "'=tool' is not FRAME or FRAME=TO" in message


def test_a_command_without_support_for_constraints_refuses_them():
    message = refused("linearize", *GRASP, "--orbit", "5e5", "--periodic", "4")
    assert "do not support constraints" in message


@pytest.mark.exhaustive
def test_a_held_robot_is_simulated_with_its_regulator_and_its_forces():
    how = ("--duration", "0.1", "--dt", "0.05", "--joint", "left_2=0.4")
    code, out, _ = run("simulate", "dual_arm", "--weld", "base", *how)
    assert code == 0
    assert "largest force of constraint 'base'" in out


KEPT = ("q_b", "r_b", "left_1", "right_2")
NAMED = [word for name in KEPT for word in ("--independent", name)]


def test_the_independent_coordinates_can_be_named():
    code, out, _ = run("linearize", *GRASP, *NAMED, "--json")
    assert code == 0
    names = json.loads(out)["state_names"]
    assert names[6:8] == ["q_m.left_1", "q_m.right_2"]


def test_gains_have_the_named_coordinates():
    code, out, _ = run("lqr", *GRASP, *NAMED, "--json")
    assert code == 0
    names = json.loads(out)["state_names"]
    assert names[6:8] == ["q_m.left_1", "q_m.right_2"]


def test_robot_files_name_the_independent_coordinates(tmp_path):
    path = tmp_path / "grasp.toml"
    path.write_text(
        f"""
urdf = "dual_arm"
independent = {list(KEPT)}
[[constraint]]
type = "weld"
frame = "tool_left"
to = "tool_right"
"""
    )
    code, out, _ = run("linearize", path, "--json")
    assert code == 0
    assert json.loads(out)["state_names"][6:8] == ["q_m.left_1", "q_m.right_2"]
    path.write_text('urdf = "dual_arm"\nindependent = "q_b"\n')
    assert "independent is 'q_b', expected a list" in refused("linearize", path)


def test_independent_coordinates_need_constraints():
    message = refused("linearize", "dual_arm", "--independent", "q_b")
    assert "--independent needs constraints, but 'dual_arm' has none" in message


def test_too_few_independent_coordinates_are_refused():
    message = refused("linearize", *GRASP, *NAMED[:2], *NAMED[4:6])
    assert "independent names 4 coordinates, expected 8" in message
