"""The snapshot of sentences: what it takes for the same, what it keeps, and how it is written."""

import json
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import fflin
from tests.support import errors_page, messages
from tests.support.patience import LIMIT

HEAR = "from tests.support.messages import hear\n"


@pytest.mark.parametrize(
    ("one", "other", "agree"),
    [
        ("dt is 0.5 s", "dt is 1e-6 s", True),
        ("drift -1.23e-16 of 4,010 m", "drift 7.1e-15 of 4.0 m", True),
        ("dt is 0, expected 1,000 or 2", "dt is 1e-3, expected 4 or 5", True),
        ("no joint 'a' of 6", "no joint 'b_1' of 7", True),
        (
            "the robot's base and the arm's tip",
            "the robot's base or the arm's tip",
            False,
        ),
        ("12 states", "12 states, 3 inputs", False),
        ("dt is 0.5 s", "dt was 0.5 s", False),
        ("InputError: dt is 1 s", "FileError: dt is 1 s", False),
    ],
)
def test_a_template_has_neither_figures_nor_quoted_names(one, other, agree):
    assert (messages.template(one) == messages.template(other)) == agree


def test_folders_of_this_machine_are_not_noted(tmp_path):
    messages.hear(
        f"{tmp_path / 'a.npz'}: cannot be read; {messages.ROOT}/b", "FileError"
    )
    assert messages.HEARD.pop() == "FileError: TMP/a.npz: cannot be read; ROOT/b"


def test_errors_and_warnings_are_heard_with_their_class():

    with pytest.raises(fflin.UnknownNameError, match="joint_9"):
        fflin.configuration(fflin.load("ets_vii"), {"joint_9": 0.1})
    with pytest.warns(fflin.FflinWarning, match="mind"):
        warnings.warn("mind this", fflin.FflinWarning, stacklevel=1)
    with pytest.raises(ZeroDivisionError):
        print(1 / 0)
    assert messages.says("one\nlarge number:\n  7 rad\n", "number", "7 rad")
    assert not messages.says("one\nlarge number:\n", "rad")
    first, *others = messages.HEARD
    assert first.startswith("UnknownNameError: ") and "'joint_9'" in first
    assert others == ["FflinWarning: mind this", "large number: 7 rad"]


def test_sentences_are_added_and_removed_only_after_all_tests(tmp_path):
    path = tmp_path / "messages.json"
    path.write_text(json.dumps(["A 1", "C 1"]))
    snapshot = messages.Snapshot(path)
    assert snapshot.missing(["A 2", "B 1"]) == ["B 1"]
    snapshot.write(["A 2", "B 1"], whole=False)
    assert json.loads(path.read_text()) == ["A 1", "B 1", "C 1"]
    snapshot.write(["A 2", "B 1"], whole=True)
    assert json.loads(path.read_text()) == ["A 1", "B 1"]


def test_a_row_of_the_page_takes_the_new_sentence(tmp_path, monkeypatch):
    page = tmp_path / "errors.md"
    page.write_text(
        "| `InputError`: dt is ... s | why | do |\n| `FileError`: old | why | do |\n"
    )
    monkeypatch.setattr(errors_page, "PAGE", page)
    test = "tests/test_errors_page.py::test_row[row_{:02d}]".format
    errors_page.write(
        {test(0): ["InputError: dt is 3 s"], test(1): ["FileError: a|b: no <link>"]}
    )
    first, second = page.read_text().splitlines()
    assert first == "| `InputError`: dt is ... s | why | do |"
    assert second == r"| `FileError`: a\|b: no \<link> | why | do |"
    assert errors_page.rows()[1] == ("FileError", "a|b: no <link>")


@pytest.mark.process
def test_a_command_writes_the_messages_of_all_workers(tmp_path):
    def run(*options):
        root = Path(__file__).parents[1]
        command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.support.messages"]
        done = subprocess.run(
            [*command, "-c", "pytest.ini", "-p", "no:cacheprovider", *options],
            cwd=tmp_path,
            env={"PYTHONPATH": str(root), "PATH": ""},
            capture_output=True,
            text=True,
            timeout=LIMIT,
            check=False,
        )
        return done.returncode, done.stdout + done.stderr

    def tests(**sentences):
        item = [
            f"def test_{name}():\n    hear({message!r})\n"
            for name, message in sentences.items()
        ]
        (tmp_path / "tests" / "test_it.py").write_text(HEAR + "".join(item))

    def noted():
        return json.loads((tmp_path / "tests" / "messages.json").read_text())

    (tmp_path / "tests").mkdir()
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    tests(one="InputError: dt is 1", two="K is 2")
    assert run("-n", "2", "--write-messages")[0] == 0
    assert noted() == ["InputError: dt is 1", "K is 2"]
    tests(one="InputError: dt is 5", two="K is 2")
    assert run()[0] == 0
    tests(one="InputError: dt is one", other="L is 3")
    code, out = run()
    assert code == 1 and messages.COMMAND in out
    assert (
        "  InputError: dt is one" in out and "  L is 3" in out and "K is 2" not in out
    )
    assert run("--write-messages", "-k", "one")[0] == 0
    assert noted() == ["InputError: dt is 1", "InputError: dt is one", "K is 2"]
    assert run("--write-messages")[0] == 0
    assert noted() == ["InputError: dt is one", "L is 3"]


def test_a_sentence_is_noted_once_for_all_its_figures():
    messages.hear("K has shape (3, 3)")
    messages.hear("K has shape (5, 3)")
    messages.hear("Q has shape (5, 3)")
    assert messages.HEARD == ["K has shape (3, 3)", "Q has shape (5, 3)"]
