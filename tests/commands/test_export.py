"""The command export: from a saved design to C code."""

import json

import fflin
from tests.support.c_code import COMPILERS, needs_compiler, outcome
from tests.support.commands import refused, run
from tests.support.policies import compensated


@needs_compiler
def test_a_gain_and_a_compensator_become_c_code(tmp_path):
    code, _, err = run(
        "lqr", "servicer_7dof", "--sample", "0.1", "-o", tmp_path / "gain.npz"
    )
    assert (code, err) == (0, "")
    compensated(fflin.load("servicer_7dof"))[2].save(tmp_path / "by.mat")
    for file, options in (
        ("gain.npz", ("--limits", "urdf", "--real", "float", "--name", "arm")),
        ("by.mat", ()),
    ):
        folder = tmp_path / f"{file}.c"
        run("export", tmp_path / file, "-o", folder, *options)
        # once more
        code, out, err = run("export", tmp_path / file, "-o", folder, *options)
        assert (code, err) == (0, "")
        assert "_test.c" in out
        written = json.loads(
            run("export", tmp_path / file, "-o", folder, *options, "--json")[1]
        )
        assert {*written["files"]} == {*map(str, folder.iterdir())} and len(
            written["files"]
        ) == 4
        name = options[-1] if options else "controller"
        assert outcome(folder, COMPILERS[0], name)[0] == 0


def test_other_files_are_refused(tmp_path):
    run("linearize", "cubesat", "-o", tmp_path / "model.npz")
    assert "not a Gain" in refused(
        "export", tmp_path / "model.npz", "-o", tmp_path / "c"
    )
    assert "No such file" in refused(
        "export", tmp_path / "none.npz", "-o", tmp_path / "c"
    )
    assert not (tmp_path / "c").exists()


@needs_compiler
def test_a_gain_with_allocated_thrusters_is_written_for_the_wrench(tmp_path):
    robot, gain = "servicer_7dof.toml", tmp_path / "gain.npz"
    assert run("lqr", robot, "-o", gain)[0] == 0
    assert fflin.Gain.load(gain).input_names[0] == "tau_b.x"
    options = ("--robot", robot, "--limits", "urdf")
    code, out, _ = run("export", gain, *options, "-o", tmp_path / "c")
    assert code == 0 and "_test.c" in out
    assert outcome(tmp_path / "c", COMPILERS[0])[0] == 0
    header = (tmp_path / "c" / "controller.h").read_text()
    assert all(name in header for name in ("tau_b.x", "F_b.z", "tau_m.joint_7"))
    assert "back_left_top" not in header
