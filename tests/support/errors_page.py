"""The rows of the tables in docs/errors.md: a class, its sentence, why it comes, what to do."""

import re
import textwrap
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "errors.md"
ROW = re.compile(r"^\| `(\w+)`: (.*?) \| ", re.MULTILINE)
LONGEST = 160


def rows():
    """Return class and sentence of each row; dots in a sentence stand for what may differ."""
    result = ROW.findall(PAGE.read_text(encoding="utf-8"))
    return [(kind, re.sub(r"\\([|<])", r"\1", words)) for kind, words in result]


def agrees(row, kind, sentence):
    """Whether a row has this class and this sentence."""
    pattern = ".*".join(map(re.escape, re.split(r" ?\.\.\.", row[1])))
    return row[0] == kind and re.fullmatch(pattern, sentence) is not None


def write(heard):
    """Put the sentences that the rows' tests met into the rows that say something else."""
    message = {}
    for test, sentences in heard.items():
        row = re.fullmatch(r"tests/test_errors_page\.py::.*\[row_(\d+)\]", test)
        if row:
            message[int(row[1])] = sentences[0].partition(": ")[::2]
    for k, row in enumerate(rows() if message else []):
        if k in message and not agrees(row, *message[k]):
            _replace(k, *message[k])


def _replace(k, kind, sentence):
    text = PAGE.read_text(encoding="utf-8")
    row = list(ROW.finditer(text))[k]
    words = re.sub(
        r"[|<]", r"\\\g<0>", textwrap.shorten(sentence, LONGEST, placeholder=" ...")
    )
    PAGE.write_text(
        text[: row.start()] + f"| `{kind}`: {words} | " + text[row.end() :], "utf-8"
    )
