"""No command writes over a file that it reads: every option that takes one, with every output."""

import itertools
import os

import pytest

from fflin.commands import cli
from fflin.commands.parser import OutputFile, input_file, input_name
from tests.support.commands import run
from tests.support.messages import any_wording

# Of options that every call of a command needs and that take no file.
NEEDED = {"runs": "1", "duration": "1", "vary": "base.mass=0.1"}


def commands():
    """Yield (name, options) of all commands."""
    (parsers,) = cli._parser("")._subparsers._group_actions
    for name, parser in parsers.choices.items():
        yield name, parser._actions


def pairs():
    """Yield (command, option that is read, option that is written) for all of them."""
    for name, actions in commands():
        reads = [
            action for action in actions if action.type in (input_file, input_name)
        ]
        writes = [action for action in actions if isinstance(action.type, OutputFile)]
        for read, write in itertools.product(reads, writes):
            yield pytest.param(
                name, actions, read, write, id=f"{name} {read.dest} {write.dest}"
            )


def said(action, value):
    """Return the words that give an option or an argument a value."""
    return [*action.option_strings[-1:], str(value)]


@pytest.mark.parametrize("name, actions, read, write", [*pairs()])
def test_an_output_file_is_not_an_input_file(
    name, actions, read, write, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    precious, other = tmp_path / "precious.toml", tmp_path / "other.toml"
    for item in (precious, other):
        item.write_text(item.name)  # nothing that a command could read
    (tmp_path / "symbolic.npz").symlink_to(precious)
    os.link(precious, "hard.npz")
    words = [name]
    for action in actions:
        if action is read:
            words += said(action, precious)
        elif action.required:
            words += said(action, NEEDED.get(action.dest, other))
    for target in ("precious.toml", "./precious.toml", "symbolic.npz", "hard.npz"):
        code, _, error = run(*words, *said(write, target))
        assert (
            code == 2
            and f"is the input file {precious}" in error
            and error.count("\n") == 1
        )
    assert (
        precious.read_text() == "precious.toml" and len(list(tmp_path.iterdir())) == 4
    )


def test_every_option_that_takes_a_file_says_whether_it_is_written():
    count = 0
    for name, actions in commands():
        for action in actions:
            metavar, words = str(action.metavar), action.help or ""
            takes = any(
                word in metavar for word in ("FILE", "ROBOT", "URDF", "DISPERSIONS")
            )
            reads = action.type in (input_file, input_name)
            assert takes == (reads or isinstance(action.type, OutputFile)), (
                name,
                action.dest,
            )
            if takes:
                writes = words.startswith(("write", "save", "plot", "output file"))
                assert writes == isinstance(action.type, OutputFile), (
                    name,
                    action.dest,
                )
                count += 1
    assert count > 40


@pytest.mark.parametrize("included", ["r.urdf", "in.toml"])
def test_files_that_a_robot_file_names_are_protected(
    included, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "r.urdf").write_text(
        '<robot name="r"><link name="l"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    (tmp_path / "r.toml").write_text('urdf = "r.urdf"\n')
    (tmp_path / "in.toml").write_text('[[input]]\ntype = "base_torque"\n')
    os.link(included, "m.npz")
    before = (tmp_path / included).read_bytes()
    monkeypatch.setattr("fflin.linear.linearization.linearize", None)  # the work
    command = ("linearize", "r.toml", "--inputs", "in.toml", "-o", "m.npz", "--force")
    code, _, error = run(*command)
    assert code == 2 and f"is the input file {tmp_path / included}" in error
    assert (tmp_path / included).read_bytes() == before


WRITES = {
    "linearize": ("cubesat", ".npz .mat .json"),
    "lqr": ("cubesat", ".npz .mat .json"),
    "simulate": ("cubesat --duration 0.1", ".npz .mat .json .csv"),
    "sweep": ("canadarm2 --random 2", ".npz .h5"),
    "sensitivity": ("cubesat", ".npz .mat .json"),
    "uncertain": ("cubesat --vary base.mass=0.1", ".npz .mat .json"),
}


@pytest.mark.parametrize("name", WRITES)
@pytest.mark.exhaustive
def test_a_command_replaces_only_files_of_the_same_kind(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options, endings = WRITES[name]
    command = (name, *options.split(), "-o")
    for ending in endings.split():
        path = tmp_path / f"own{ending}"
        for _ in range(2):
            code, _, error = run(*command, path)
            assert code == 0, error
        foreign = tmp_path / f"foreign{ending}"
        foreign.write_text("somebody's own\n")
        with any_wording():
            code, _, error = run(*command, foreign)
        assert code == 2 and "is not a result of fflin" in error and "--force" in error
        assert error.count("\n") == 1 and foreign.read_text() == "somebody's own\n"
        assert run(*command, foreign, "--force")[0] == 0
    if name == "linearize":
        for _ in range(2):
            assert run(*command, tmp_path / "own.csv")[0] == 0
        table = tmp_path / "foreign.A.csv"
        table.write_text("somebody's own\n")
        with any_wording():
            code, _, error = run(*command, tmp_path / "foreign.csv")
        assert (
            code == 2
            and str(table) in error
            and table.read_text() == "somebody's own\n"
        )
        assert run(*command, tmp_path / "foreign.csv", "--force")[0] == 0
    other = (
        ("lqr", "cubesat", "-o") if name != "lqr" else ("linearize", "cubesat", "-o")
    )
    path = tmp_path / "other.npz"
    assert run(*other, path)[0] == 0
    before = path.read_bytes()
    with any_wording():
        code, _, error = run(*command, path)
    assert (
        code == 2 and f"holds a {'LinearModel' if name == 'lqr' else 'Gain'}" in error
    )
    assert path.read_bytes() == before
