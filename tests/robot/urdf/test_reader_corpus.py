"""Each entry of the corpus through the command line, in a process of limited time and memory."""

import os
import re
from collections import Counter
from dataclasses import dataclass

import pytest

from tests.support.forked import forking
from tests.support.messages import hear_lines
from tests.support.reader_corpus import ACCEPT, CASES, REFUSE, WARN

pytestmark = pytest.mark.fuzz

TIME_LIMIT = 20  # [s] of the processor
MEMORY_LIMIT = 4 * 2**30  # [B]


@dataclass(frozen=True)
class Run:
    code: int
    out: str
    err: str
    left: list[str]  # names of files that the command left behind


def run(case, folder, command_of):
    folder.mkdir()
    path = folder / f"robot{case.suffix}"
    if callable(case.document):
        path = case.document(path)
    else:
        raw = case.document
        path.write_bytes(raw if isinstance(raw, bytes) else raw.encode())
    if case.expected == REFUSE:
        command = ["linearize", str(path), "-o", str(folder / "out.npz")]
    else:
        command = ["check", str(path)]
    before = set(os.listdir(folder))
    out, err = (folder.with_suffix(f".{name}") for name in ("out", "err"))
    code = command_of(command, folder, out, err, (TIME_LIMIT, MEMORY_LIMIT))
    left = sorted(set(os.listdir(folder)) - before)
    return Run(code, out.read_text(), err.read_text(), left)


@pytest.fixture(scope="module")
def command_of():
    with forking(PYTHONWARNINGS="default") as run:
        yield run


def test_corpus_is_large_and_its_names_differ():
    assert len(CASES) >= 150
    assert not [
        name for name, n in Counter(case.name for case in CASES).items() if n > 1
    ]
    assert {case.expected for case in CASES} == {ACCEPT, WARN, REFUSE}


@pytest.mark.process
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_corpus(case, tmp_path, command_of):
    if "xacro" in case.name:
        pytest.importorskip("xacrodoc")
    result = run(case, tmp_path / str(CASES.index(case)), command_of)
    lines = hear_lines(result.err).splitlines()
    if case.expected == REFUSE:
        assert (result.code, result.out, result.left) == (2, "", [])
        assert len(lines) == 1 and lines[0].startswith("fflin: error: "), result.err
    else:
        assert result.code == 0, result.err
        assert re.search(r"^check: A and B of .*: verified", result.out, re.MULTILINE)
        assert all(line.startswith("fflin: warning: ") for line in lines), result.err
        assert len(lines) == (case.expected == WARN), result.err
    for word in case.words:
        assert word in result.err
