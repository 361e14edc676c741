"""The command export: from a saved design to C code."""

import fflin
from tests.support.c_code import COMPILERS, needs_compiler, outcome
from tests.support.commands import refused, run
from tests.support.policies import compensated


@needs_compiler
def test_a_gain_and_a_compensator_become_c_code(tmp_path):
    code, _, err = run("lqr", "servicer_7dof", "--sample", "0.1", "-o", tmp_path / "gain.npz")
    assert (code, err) == (0, "")
    compensated(fflin.load("servicer_7dof"))[2].save(tmp_path / "by.mat")
    for file, options in (
        ("gain.npz", ("--limits", "urdf", "--real", "float", "--name", "arm")),
        ("by.mat", ()),
    ):
        folder = tmp_path / f"{file}.c"
        run("export", tmp_path / file, "-o", folder, *options)
        code, out, err = run("export", tmp_path / file, "-o", folder, *options)  # once more
        assert (code, err) == (0, "")
        assert "_test.c" in out
        name = options[-1] if options else "controller"
        assert outcome(folder, COMPILERS[0], name)[0] == 0


def test_other_files_are_refused(tmp_path):
    run("linearize", "cubesat", "-o", tmp_path / "model.npz")
    assert "not a Gain" in refused("export", tmp_path / "model.npz", "-o", tmp_path / "c")
    assert "No such file" in refused("export", tmp_path / "none.npz", "-o", tmp_path / "c")
    assert not (tmp_path / "c").exists()
